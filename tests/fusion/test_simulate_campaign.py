"""Simulated campaigns: what recordings share and what they do not, points against the motion, wrenches by hand."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.recording.load import load_manifest
from fusion.simulate import simulate
from fusion.simulate.sines import ROCKING_HZ, runs, wrench_direction
from fusion.simulate.world import Draws, face_points, make_world, point_series
from photogram.geometry import rotation_from_vector
from photogram.point_tables import read_point_tables


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """The first frequency of the sweep: two mountings, two recordings of each."""
    folder = simulate(tmp_path_factory.mktemp("sweep") / "campaign", "sweep", 5, recordings=4)
    return tuple(sorted(folder.glob("Fz-*")))


def _truth(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return found


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def test_sweep_is_the_published_plan() -> None:
    plan = runs("sweep")
    frequencies = sorted({run.nominal_hz[0] for run in plan})
    assert (len(plan), len(frequencies), frequencies[0], frequencies[-1]) == (48, 12, 53.7, 1020.3)
    assert ROCKING_HZ in [pytest.approx(f) for f in frequencies]
    assert {(run.mounting, run.nominal_hz) for run in plan} == {(m, (f,)) for m in "12" for f in frequencies}
    assert len({run.preset.recording for run in plan}) == 48
    lasers = [spec.point for spec in plan[0].preset.daqs[0].channels if spec.quantity == "velocity"]
    assert np.hypot(*np.array(lasers)[:, :2].T) == pytest.approx([0.022] * 4 + [0.048] * 4, abs=1e-5)


def test_manifests_are_valid_and_name_every_file(sweep: tuple[Path, ...]) -> None:
    for folder in sweep:
        manifest = load_manifest(folder)
        assert manifest.mounting == _truth(folder)["mounting"]
        written = {path.resolve() for path in folder.iterdir()} - {(folder / "truth.json").resolve()}
        assert written <= set(manifest.files)


def test_errors_last_as_long_as_what_they_belong_to(sweep: tuple[Path, ...]) -> None:
    drawn = [_truth(folder)["drawn"] for folder in sweep]
    mountings = [_truth(folder)["mounting"] for folder in sweep]
    assert mountings == ["1", "1", "2", "2"]
    for name in ("laser.scale", "load.mass", "top.pose", "vibrometer.clock", "internal.centre_of_mass"):
        assert drawn[0][name] == drawn[1][name] == drawn[2][name] != [0.0]
    for name in ("velocity_3.point", "velocity_3.direction", "load.centre_of_mass", "acceleration_x.transverse"):
        assert drawn[0][name] == drawn[1][name]
        assert drawn[0][name] != drawn[2][name]
        assert drawn[2][name] == drawn[3][name]
    records = [(folder / "vibrometer.h5").read_bytes() for folder in sweep]
    assert len({hashlib.sha256(record).digest() for record in records}) == 4


def test_recordings_of_one_frequency_are_repeats(sweep: tuple[Path, ...]) -> None:
    driven = [_complex(_truth(folder)["load"])[0, 2] for folder in sweep]
    assert np.ptp(np.abs(driven)) < 0.025 * np.abs(driven[0])
    assert np.ptp(np.angle(driven)) > 0.1
    sensitivities = [_complex(_truth(folder)["sensitivity"]) for folder in sweep]
    for other in sensitivities[1:]:
        np.testing.assert_array_equal(other, sensitivities[0])


def test_the_lag_is_the_published_one() -> None:
    """Phase and magnitude of a first-order lag of 50 µs: −0.25 rad at 805.5 Hz, 95.3 % at 1000 Hz."""
    last = {run.nominal_hz[0]: run for run in runs("sweep")}
    curve = {}
    for frequency in (53.7, 805.5, 1020.3):
        world = make_world(last[frequency].preset, Draws(1, False), 0.0)
        curve[frequency] = world.sensitivity[0, 2, 2]
    assert np.angle(curve[805.5]) == pytest.approx(-0.25, abs=0.01)
    assert abs(curve[1020.3]) / abs(curve[53.7]) == pytest.approx(0.953, abs=2e-3)


def test_points_follow_the_body_in_the_frame_of_the_left_camera() -> None:
    """Every point is moved by hand: x' = R x + t, then into the stated frame, blurred by sinc(fT)."""
    run, draws = runs("sweep")[0], Draws(3, False)
    world = make_world(run.preset, draws, 0.0)
    setup = run.preset.stereo[0]
    series, rest = point_series(world, setup, draws, False), face_points(setup)
    frequency, exposure = world.motion["load"].frequency_hz, run.preset.exposure_s
    time = world.trigger_s[7] + exposure / 2
    lines = world.motion["load"].displacement * np.sinc(frequency * exposure)[:, None]
    pose = sum((line * np.exp(2j * np.pi * f * time)).real for line, f in zip(lines, frequency, strict=True))
    moved = rest @ rotation_from_vector(pose[3:]).T + pose[:3]
    between, seen = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (moved, series[7]))
    np.testing.assert_allclose(seen, between, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(series, axis=-1), setup.focal_px * setup.pixel_m, rtol=0.15)
    assert series.shape == (48, 40, 3)


def test_point_tables_are_read_back(sweep: tuple[Path, ...]) -> None:
    entry = load_manifest(sweep[0]).points[0]
    table = read_point_tables(entry.files, entry.columns, entry.valid_status, entry.scale)
    assert table.position_m.shape == (48, 40, 3)
    assert np.isfinite(table.position_m).all()


def test_a_mass_on_an_arm_loads_the_moment_by_hand() -> None:
    """2.047 kg at 0.2 m along x on a total of 11.0605 kg: Fz = 11.0605 N, My = −0.4094 N·m per m/s²."""
    run = runs("matrix")[1]
    assert run.direction == (0.0, 0.0, 11.0605, 0.0, -0.4094, 0.0)
    assert run.driven == 4
    assert wrench_direction(run.parts, (0.0, 1.0, 0.0))[5] == pytest.approx(2.047 * 0.2, abs=1e-4)


def test_the_matrix_campaign_excites_six_components_independently() -> None:
    """Rank of the loads in shares of their capacities, line by line: the smallest singular value is far from zero."""
    loads = []
    for run in runs("matrix"):
        world = make_world(run.preset, Draws(1, False, mounting=run.mounting), 0.0)
        loads.append(world.load_wrench / np.array(run.preset.capacity))
    values = np.linalg.svd(np.stack(loads, axis=1), compute_uv=False)
    assert values.shape == (3, 6)
    assert (values[:, -1] > 0.1 * values[:, 0]).all()


def test_matrix_rigs_differ_in_gravity_only(tmp_path: Path) -> None:
    folders = sorted(simulate(tmp_path / "matrix", "matrix", 2).glob("*/"))
    manifests = [load_manifest(folder) for folder in folders]
    downs = [manifest.rig.environment.gravity for manifest in manifests if manifest.rig.environment is not None]
    assert downs[0] == (0.0, 0.0, -9.8125)
    assert downs[4] == (-9.8125, 0.0, 0.0)
    assert downs[6] == (0.0, -9.8125, 0.0)
    assert len({manifest.mounting for manifest in manifests}) == 8
    assert len({manifest.rig.model_dump_json(include={"sensor", "load"}) for manifest in manifests}) == 1
    drawn = [_truth(folder)["drawn"] for folder in folders]
    assert drawn[1]["moment mass.mass"] == drawn[7]["moment mass.mass"]
    assert drawn[1]["moment mass.centre_of_mass"] != drawn[7]["moment mass.centre_of_mass"]
