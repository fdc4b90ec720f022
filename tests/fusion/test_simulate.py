"""The simulated campaign: rigid-body physics by hand and by numeric differentiation, files against formulas."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from contracts import refused, slow
from support import complex_of, folder_contents, truth_of

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.simulate import PRESETS, simulate
from fusion.simulate.preset import PartSpec, Preset, read_preset
from fusion.simulate.world import (
    Draws,
    SimulatedMotion,
    TruePart,
    acceleration_at,
    base_motion,
    harmonic,
    make_world,
    velocity_at,
    wrench,
)
from photogram.geometry import rotation_from_vector

GRAVITY = np.array([0.0, 0.0, -9.8125])
FREQUENCY = np.array([40.0, 120.0])
PART = TruePart(2.0, np.array([0.01, -0.02, 0.05]), np.array([[3e-3, 1e-4, 0], [1e-4, 4e-3, 2e-4], [0, 2e-4, 5e-3]]))


def _motion() -> SimulatedMotion:
    """A motion so small that terms of second order vanish."""
    rng = np.random.default_rng(3)
    amplitude = np.array([3.0, 2.0, 40.0, 30.0, 20.0, 10.0]) * 1e-3
    phasors = amplitude * np.exp(2j * np.pi * rng.uniform(size=(2, 6)))
    return SimulatedMotion(FREQUENCY, phasors)


def _derivatives(values: np.ndarray, step: float) -> np.ndarray:
    """Second derivative of samples (7, ...) at the middle one, sixth order."""
    weights = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * step**2)
    return np.tensordot(weights, values, axes=1)


def test_wrench_agrees_with_momentum_differentiated_numerically() -> None:
    motion, step = _motion(), 2e-5
    for time in (0.0, 0.0031, 0.0127):
        stencil = time + step * np.arange(-3, 4)
        poses = motion.pose(stencil)
        rotation = rotation_from_vector(poses[:, 3:])
        centre = poses[:, :3] + rotation @ PART.centre_of_mass_m
        force = PART.mass_kg * (_derivatives(centre, step) - GRAVITY)
        spin = _derivatives(poses[:, 3:], step)
        moment = PART.inertia_kgm2 @ spin
        body_force = rotation[3].T @ force
        expected = np.concatenate([body_force, moment + np.cross(PART.centre_of_mass_m, body_force)])
        still = -PART.mass_kg * GRAVITY
        expected -= np.concatenate([still, np.cross(PART.centre_of_mass_m, still)])
        found = harmonic(np.array(time), FREQUENCY, wrench(motion, [PART], GRAVITY))
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-7)


def test_laser_and_accelerometer_measure_the_moving_point() -> None:
    motion, step = _motion(), 2e-5
    point, direction = np.array([0.03, -0.04, 0.06]), np.array([0.36, 0.48, 0.8])
    velocity = velocity_at(motion, point, direction)
    reading = acceleration_at(motion, point, direction, GRAVITY)
    for time in (0.0, 0.0043):
        poses = motion.pose(time + step * np.arange(-3, 4))
        rotation = rotation_from_vector(poses[:, 3:])
        path = poses[:, :3] + rotation @ point
        speed = (path[4] - path[2]) / (2 * step) @ direction
        assert harmonic(np.array(time), FREQUENCY, velocity[:, None])[0] == pytest.approx(speed, rel=1e-3)
        felt = rotation[3].T @ (_derivatives(path, step) - GRAVITY) @ direction + GRAVITY @ direction
        assert harmonic(np.array(time), FREQUENCY, reading[:, None])[0] == pytest.approx(felt, rel=1e-3, abs=1e-7)


def test_base_moves_below_an_undamped_mount_by_one_minus_the_squared_ratio() -> None:
    motion = _motion()
    base = base_motion(motion, np.full(6, 400.0), 0.0)
    factor = 1 - (FREQUENCY / 400.0) ** 2
    np.testing.assert_allclose(base.acceleration, motion.acceleration * factor[:, None], rtol=1e-12)


def test_without_errors_everything_is_as_stated() -> None:
    draws = Draws(1, False)
    world = make_world(read_preset(Preset, "demo"), draws, 0.0)
    assert not any(any(values) for values in draws.values.values())
    stereo = world.stereo[0]
    np.testing.assert_allclose((stereo.left_from_sensor @ stereo.sensor_from_left).pose, 0, atol=1e-15)
    np.testing.assert_array_equal(stereo.rig.left.parameters, stereo.nominal.left.parameters)
    np.testing.assert_allclose(np.diff(world.trigger_s), 1 / 38.345, rtol=1e-12)


def test_errors_are_drawn_with_the_stated_spread() -> None:
    drawn = np.array([[Draws(seed, True).normal("a", 2.0)] for seed in range(2000)])
    assert drawn.std() == pytest.approx(2.0, rel=5 / np.sqrt(4000))
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    pairs = np.array([Draws(seed, True).covariant("b", covariance) for seed in range(2000)])
    np.testing.assert_allclose(np.cov(pairs.T), covariance, atol=0.6)
    assert Draws(1, True).normal("a", 1.0) != Draws(1, True).normal("b", 1.0)


def test_published_numbers_of_the_large_preset() -> None:
    preset = read_preset(Preset, "nitsche2018")
    amplitude = np.abs(np.array(preset.acceleration))[:, 2]
    assert amplitude[[0, 3]] == pytest.approx([189.3217, 0.9596])
    assert (preset.load.mass, preset.internal.mass) == (6.9605, 0.769)
    assert (preset.frames, preset.camera_rate_hz, preset.daqs[0].sample_rate_hz) == (211, 52.874, 51200.0)
    assert amplitude[0] / (2 * np.pi * preset.fundamental_hz) ** 2 == pytest.approx(0.4248e-3, rel=1e-3)


def test_a_preset_inherits_missing_keys() -> None:
    whole, sweep = read_preset(Preset, "nitsche2018"), read_preset(Preset, "sweep", lag_s=1e-3)
    assert (sweep.name, sweep.lag_s, sweep.serial, sweep.stereo) == ("sweep", 1e-3, whole.serial, whole.stereo)
    assert (sweep.load.centre_of_mass, sweep.load.mass) == ((0.0, 0.0, 0.0), whole.load.mass)
    laser = sweep.daqs[0].channels[7]
    assert (laser.quantity, laser.point) == ("velocity", (0.03394, -0.03394, 0.0973))
    assert laser.stated["scale_uncertainty"] == 5e-4
    for key, value in {"weight": 9.81, "mass": "heavy"}.items():
        refused(key, read_preset, PartSpec, "demo.load", **{key: value})


@pytest.mark.parametrize("name", ["demo", "nitsche2018"])
def test_camera_rate_aliases_every_line_apart(name: str) -> None:
    preset = read_preset(Preset, name)
    time = np.arange(preset.frames) / preset.camera_rate_hz
    angle = 2 * np.pi * time[:, None] * preset.frequencies_hz
    design = np.column_stack([np.ones_like(time), np.cos(angle), np.sin(angle)])
    assert np.linalg.cond(design) < 3
    beat = np.abs(preset.fundamental_hz - preset.camera_rate_hz * round(preset.fundamental_hz / preset.camera_rate_hz))
    assert beat * preset.frames / preset.camera_rate_hz > 1.99


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "small"
    return simulate(out, "demo", 3, frames=4, image_scale=0.3)


def test_recording_is_complete_and_its_manifest_valid(small: Path) -> None:
    manifest = load_manifest(small)
    assert [len(images.left) for images in manifest.images] == [4, 4]
    image = tifffile.imread(manifest.images[0].left[0])
    assert image.dtype == np.uint16
    assert image.max() < 1023
    truth = truth_of(small)
    assert np.shape(truth["motion"]["top"]) == (4, 6)
    assert np.shape(truth["sensitivity"]["re"]) == (3, 6, 6)
    assert "top.calibration" in truth["drawn"]


def _differ(one: dict[str, bytes], other: dict[str, bytes]) -> None:
    """Hold two campaigns of unlike seeds to be of the same files, whose truth and data are not the same."""
    assert one.keys() == other.keys()
    changed = {name.rpartition("/")[2] for name in one if one[name] != other[name]}
    assert "truth.json" in changed
    data = {"0000.tif", "channels.h5", "accelerometers.h5", "readings.csv", "outputs.h5", "models.json"}
    assert changed & {*data, "Messung_0001.csv"}


@pytest.mark.parametrize("preset", ["demo", "files", "matrix", "steps"])
def test_the_same_seed_gives_the_same_bytes(preset: str, tmp_path: Path) -> None:
    small = {"frames": 3, "image_scale": 0.3}
    switches = {"demo": small, "files": {**small, "recordings": 1}, "matrix": {"recordings": 1}}.get(preset, {})
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        simulate(tmp_path / name, preset, seed, **switches)
    one, same, other = (folder_contents(tmp_path / name) for name in ("one", "same", "other"))
    assert one == same
    _differ(one, other)


@pytest.mark.parametrize("preset", ["rotation", "chirp", *slow("orientations", "loads", "elastomer")])
def test_the_command_replaces_only_an_earlier_simulation(
    preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "it"
    run = ["simulate", str(out), "--preset", preset]
    assert main(run) == 0
    assert str(out) in capsys.readouterr().out
    first = folder_contents(out)
    assert main(run) == 2
    assert main([*run, "--force"]) == 0
    assert folder_contents(out) == first  # the same seed, the same bytes
    assert main([*run, "--force", "--seed", "2"]) == 0
    _differ(first, folder_contents(out))
    assert preset != "chirp" or main(["check", str(out)]) == 0
    (out / "thesis.txt").write_text("mine")
    refused(r"expected a new folder.*found thesis.txt in it", simulate, out, preset, 1, error=InputError)
    assert (out / "thesis.txt").read_text() == "mine"


def test_a_wrong_call_names_its_argument(tmp_path: Path) -> None:
    for preset, switches, said in (
        ("nitsche", {}, f"preset: expected one of {', '.join(PRESETS)}, found 'nitsche'"),
        ("demo", {"frames": 2}, "frames: expected at least 3"),
        ("demo", {"image_scale": 2}, "image_scale: expected"),
        ("steps", {"frames": 4}, "frames: expected one of the presets demo, .*, found steps"),
    ):
        refused(said, simulate, tmp_path / "x", preset, 1, **switches)
    assert not any(tmp_path.iterdir())


def test_noise_free_channels_are_the_truth(tmp_path: Path) -> None:
    plain = dict.fromkeys(("channel_noise", "systematic_errors", "trigger_jitter"), False)
    folder = simulate(tmp_path / "exact", "demo", 1, frames=3, image_scale=0.3, **plain)
    truth = truth_of(folder)
    with h5py.File(folder / "vibrometer.h5") as file:
        samples, rate = file["velocity_1"][:], file["velocity_1"].attrs["sample_rate"]
        trigger = file["camera_trigger"][:]
    time = np.arange(len(samples)) / rate
    a = complex_of(truth["acceleration"]["load"])
    at_point = a[:, 2] - a[:, 4] * 0.033  # z of a + α × r at (0.033, 0, ·)
    omega = 2 * np.pi * np.array(truth["frequencies"])
    expected = np.sin(np.outer(time, omega) + np.angle(at_point)) @ (np.abs(at_point) / omega)
    np.testing.assert_allclose(samples * 0.1, expected, atol=0.1 * 20 / 2**16 * 0.51)
    rising = np.flatnonzero((trigger[1:] > 2.5) & (trigger[:-1] < 2.5)) + 1
    edges = np.array(truth["exposure_middle_s"]) - 30e-6
    assert ((time[rising] >= edges) & (time[rising] - edges < 1 / rate)).all()
