"""Simulated campaigns of loads on a sensor's springs: motion against state space, what recordings share, the sines."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from support import state

from fusion.recording.load import load_manifest
from fusion.simulate.chirp import Chirp, Suspension, mass_matrix, sine_run, write_chirps, write_masses, write_pitching
from fusion.simulate.preset import read_preset
from fusion.simulate.world import Draws, TruePart, make_world, true_part

AXIAL, PITCHING = read_preset(Suspension, "masses"), read_preset(Suspension, "pitching")
QUICK = read_preset(Chirp, "chirp.chirp", sample_rate_hz=12800.0, period_s=0.32, periods=3, band_hz=(900.0, 2200.0))


def _truth(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return found


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def _parts(stand: Suspension, name: str) -> tuple[TruePart, TruePart]:
    draws = Draws(1, True)
    return true_part(stand.loads[name], draws), true_part(stand.internal, draws)


def test_axial_motion_is_that_of_one_oscillator() -> None:
    load, internal = _parts(AXIAL, "4kg")
    mass, (k,), (b,) = load.mass_kg + internal.mass_kg, AXIAL.stiffness, AXIAL.damping
    frequency = np.array([1.0, 300.0, 1509.0, 3000.0])
    s = 2j * np.pi * frequency
    found = AXIAL.transfer(load, internal, (0.03, 0.0, 0.1), frequency)
    np.testing.assert_allclose(found, (k + b * s) / (mass * s * s + b * s + k), rtol=1e-12)
    resonance = AXIAL.resonances_hz(load, internal)
    assert resonance == pytest.approx([np.sqrt(k / mass) / (2 * np.pi)], rel=1e-12)


@pytest.mark.parametrize("name", ["4kg", "7kg"])
def test_pitching_motion_is_that_of_two_coupled_equations_in_state_space(name: str) -> None:
    load, internal = _parts(PITCHING, name)
    m, c, inertia = load.mass_kg, load.centre_of_mass_m[2], load.inertia_kgm2[1, 1]
    # About the origin, x to the right, turn about y: the centre of mass at height c moves by x + c·turn; what its
    # other coordinate adds to the moment of inertia is m·x_c².
    own = inertia + m * (c * c + load.centre_of_mass_m[0] ** 2)
    matrix = np.array([[m + internal.mass_kg, m * c], [m * c, own]])
    k, b = np.diag(PITCHING.stiffness), np.diag(PITCHING.damping)
    # z = q - (x_base, 0): M z'' + b z' + k z = -M (x_base'', 0), reading = x_base'' + z_x'' + height·turn''.
    inverse = np.linalg.inv(matrix)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ k, -inverse @ b]])
    push = np.array([0.0, 0.0, -1.0, 0.0])
    frequency = np.array([500.0, 1180.0, 1480.0, 1560.0, 2100.0])
    for point in PITCHING.tops.values():
        row = np.array([1.0, point[2]])
        output = np.hstack([-row @ inverse @ k, -row @ inverse @ b])
        expected = [output @ np.linalg.solve(2j * np.pi * f * np.eye(4) - a, push) for f in frequency]
        np.testing.assert_allclose(PITCHING.transfer(load, internal, point, frequency), expected, rtol=1e-9)


def test_mass_matrix_holds_newton_and_euler() -> None:
    load, _ = _parts(PITCHING, "4kg")
    rng = np.random.default_rng(4)
    a, alpha = rng.standard_normal((2, 3))
    force = load.mass_kg * (a + np.cross(alpha, load.centre_of_mass_m))
    moment = np.cross(load.centre_of_mass_m, force) + load.inertia_kgm2 @ alpha
    np.testing.assert_allclose(mass_matrix(load) @ [*a, *alpha], [*force, *moment], rtol=1e-12)


def test_resonances_overlap_for_one_pitching_load_and_stand_apart_for_the_other() -> None:
    apart = {}
    for name in PITCHING.loads:
        load, internal = _parts(PITCHING, name)
        inertia = (mass_matrix(load) + mass_matrix(internal))[np.ix_((0, 4), (0, 4))]
        widths = np.linalg.eigvals(np.linalg.solve(inertia, np.diag(PITCHING.damping))).real / (2 * np.pi)
        apart[name] = np.diff(PITCHING.resonances_hz(load, internal))[0] / widths.mean()
    assert apart["7kg"] < 1.5
    assert apart["4kg"] > 10.0


def test_the_campaign_has_one_sensor_two_loads_and_its_truth(tmp_path: Path) -> None:
    folder = tmp_path
    write_masses(folder, 3, stand=replace(AXIAL, chirp=QUICK), steps=(19,))
    manifests = {path.parent.name: load_manifest(path.parent) for path in folder.glob("*/recording.toml")}
    assert sorted(manifests) == ["Fz-1020.3", "chirp-4kg", "chirp-9kg"]
    assert len({manifest.rig.sensor.model_dump_json() for manifest in manifests.values() if manifest.rig.sensor}) == 1
    loads = [manifest.rig.load.mass for manifest in manifests.values() if manifest.rig.load]
    assert sorted(loads) == [4.236, 8.798, 8.798]
    truth = _truth(folder)
    assert truth["load_mass_kg"]["4kg"] == 4.236 + truth["drawn"]["load 4 kg.mass"][0] != 4.236
    assert truth["internal_mass_kg"] == 0.769 + truth["drawn"]["internal.mass"][0] != 0.769
    assert truth["stiffness"] == {"z": 4.5e8}
    assert truth["chain_lag_s"] == 50e-6
    for own in ("base.scale", "top_1.delay", "daq.clock"):
        assert _truth(folder / "chirp-4kg")["drawn"][own] == _truth(folder / "chirp-9kg")["drawn"][own]


def test_the_recorded_chirp_holds_the_transfer_function(tmp_path: Path) -> None:
    quiet = replace(QUICK, noise=0.0, periods=6)
    write_chirps(tmp_path, replace(AXIAL, chirp=quiet), Draws(1, False))
    truth = _truth(tmp_path / "chirp-9kg")
    with h5py.File(tmp_path / "chirp-9kg" / "accelerometers.h5") as file:
        last = {name: np.fft.rfft(file[name][-4096:].astype(np.float64)) for name in ("base", "top_1")}
    lines = np.rint(np.array(truth["frequency_hz"]) * quiet.period_s).astype(int)
    ratio = (last["top_1"] / last["base"])[lines]
    expected = _complex(truth["transfer"]["top_1"])
    # What is left is the amplifier above, a Butterworth filter of order 4 at 20 kHz: a delay of about 2.613/ω.
    turned = ratio / expected * np.exp(2.613j * np.array(truth["frequency_hz"]) / 20e3)
    np.testing.assert_allclose(turned, 1.0, atol=2e-3)


def test_sines_move_on_the_same_spring_and_fall_as_published() -> None:
    draws = Draws(2, True, mounting="1", recording="")
    load = true_part(AXIAL.loads["9kg"], draws)
    internal = true_part(AXIAL.internal, draws)
    for step in (15, 19):
        run = sine_run(AXIAL, step, draws)
        world = make_world(run.preset, draws, 0.0)
        lines = run.preset.frequencies_hz
        over_base = world.motion["load"].acceleration[:, 2] / world.motion["base"].acceleration[:, 2]
        expected = AXIAL.transfer(load, internal, (0.0, 0.0, 0.1), lines)
        np.testing.assert_allclose(over_base, expected, rtol=1e-9)
        falling = world.outputs[0, 2] / world.load_wrench[0, 2]
        published = {805.5: (0.9694, -0.25), 1020.3: (0.953, -0.32)}[round(run.nominal_hz[0], 1)]
        shape = falling / (world.static_stated[2, 2] * (1.0 + draws.values["static_sensitivity"][14]))
        assert abs(shape) == pytest.approx(published[0], abs=1e-3)
        assert np.angle(shape) == pytest.approx(published[1], abs=9e-3)


def test_the_same_seed_gives_the_same_files(tmp_path: Path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        (tmp_path / name).mkdir()
        write_pitching(tmp_path / name, seed, replace(PITCHING, chirp=QUICK))
    one, same, other = (state(tmp_path / name) for name in "abc")
    assert len(one) == 11
    assert one == same
    assert one["truth.json"] != other["truth.json"]
