"""Simulated campaigns: what recordings share and what they do not, points against the motion, wrenches by hand."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.base import InputError
from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.simulate import simulate_campaign
from fusion.simulate.sines import ROCKING_HZ, laser_points, wrench_direction
from fusion.simulate.world import CampaignDraws, face_points, make_world, point_series
from fusion.simulate.write import CAMPAIGNS
from photogram.geometry import rotation_from_vector
from photogram.point_tables import read_point_tables


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """The first frequency of the sweep: two mountings, two recordings of each."""
    return simulate_campaign(tmp_path_factory.mktemp("sweep") / "campaign", "sweep", 5, recordings=4)


def _truth(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return found


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def test_sweep_is_the_published_plan() -> None:
    runs = CAMPAIGNS["sweep"]()
    assert len(runs) == 48
    frequencies = sorted({run.nominal_hz[0] for run in runs})
    assert len(frequencies) == 12
    assert (frequencies[0], frequencies[-1]) == (53.7, 1020.3)
    assert ROCKING_HZ in [pytest.approx(f) for f in frequencies]
    assert {(run.mounting, run.nominal_hz) for run in runs} == {(m, (f,)) for m in "12" for f in frequencies}
    assert len(laser_points()) == 8
    assert len({run.preset.recording for run in runs}) == 48


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
    last = {run.nominal_hz[0]: run for run in CAMPAIGNS["sweep"]()}
    curve = {}
    for frequency in (53.7, 805.5, 1020.3):
        world = make_world(last[frequency].preset, CampaignDraws(1, False), 0.0)
        curve[frequency] = world.sensitivity[0, 2, 2]
    assert np.angle(curve[805.5]) == pytest.approx(-0.25, abs=0.01)
    assert abs(curve[1020.3]) / abs(curve[53.7]) == pytest.approx(0.953, abs=2e-3)


def test_points_follow_the_body_in_the_frame_of_the_left_camera() -> None:
    """Every point is moved by hand: x' = R x + t, then into the stated frame, blurred by sinc(fT)."""
    run = CAMPAIGNS["sweep"]()[0]
    draws = CampaignDraws(3, False, mounting="1", recording="a")
    world = make_world(run.preset, draws, 0.0)
    setup = run.preset.points[0]
    series = point_series(world, setup, draws, False)
    rest = face_points(setup)
    manifest_pose = run.preset.points[0]
    frequency, exposure = world.motion["load"].frequency_hz, run.preset.exposure_s
    time = world.trigger_s[7] + exposure / 2
    lines = world.motion["load"].displacement * np.sinc(frequency * exposure)[:, None]
    pose = sum((line * np.exp(2j * np.pi * f * time)).real for line, f in zip(lines, frequency, strict=True))
    moved = rest @ rotation_from_vector(pose[3:]).T + pose[:3]
    between = np.linalg.norm(moved[:, None] - moved[None], axis=-1)
    seen = series.position_m[7]
    np.testing.assert_allclose(np.linalg.norm(seen[:, None] - seen[None], axis=-1), between, atol=1e-12)
    distance = manifest_pose.focal_px * manifest_pose.pixel_m
    np.testing.assert_allclose(np.linalg.norm(series.position_m, axis=-1), distance, rtol=0.15)
    assert series.position_m.shape == (48, 40, 3)


def test_point_tables_are_read_back(sweep: tuple[Path, ...]) -> None:
    entry = load_manifest(sweep[0]).points[0]
    table = read_point_tables(entry.files, entry.columns, entry.valid_status, entry.scale)
    assert table.position_m.shape == (48, 40, 3)
    assert np.isfinite(table.position_m).all()


def test_a_mass_on_an_arm_loads_the_moment_by_hand() -> None:
    """2.047 kg at 0.2 m along x on a total of 11.0605 kg: Fz = 11.0605 N, My = −0.4094 N·m per m/s²."""
    run = CAMPAIGNS["matrix"]()[1]
    assert run.direction == (0.0, 0.0, 11.0605, 0.0, -0.4094, 0.0)
    assert run.driven == 4
    assert wrench_direction(run.parts, (0.0, 1.0, 0.0))[5] == pytest.approx(2.047 * 0.2, abs=1e-4)


def test_the_matrix_campaign_excites_six_components_independently() -> None:
    """Rank of the loads in shares of their capacities, line by line: the smallest singular value is far from zero."""
    loads = []
    for run in CAMPAIGNS["matrix"]():
        world = make_world(run.preset, CampaignDraws(1, False, mounting=run.mounting), 0.0)
        loads.append(world.load_wrench / np.array(run.preset.capacity))
    values = np.linalg.svd(np.stack(loads, axis=1), compute_uv=False)
    assert values.shape == (3, 6)
    assert (values[:, -1] > 0.1 * values[:, 0]).all()


def test_matrix_rigs_differ_in_gravity_only(tmp_path: Path) -> None:
    folders = simulate_campaign(tmp_path / "matrix", "matrix", 2)
    manifests = [load_manifest(folder) for folder in folders]
    downs = [manifest.rig.environment.gravity for manifest in manifests if manifest.rig.environment is not None]
    assert downs[0] == (0.0, 0.0, -9.8125)
    assert downs[4] == (-9.8125, 0.0, 0.0)
    assert downs[6] == (0.0, -9.8125, 0.0)
    assert len({manifest.mounting for manifest in manifests}) == 8
    assert (
        len({json.dumps(manifest.rig.model_dump(include={"sensor", "load"}, mode="json")) for manifest in manifests})
        == 1
    )
    drawn = [_truth(folder)["drawn"] for folder in folders]
    assert drawn[1]["moment mass.mass"] == drawn[7]["moment mass.mass"]
    assert drawn[1]["moment mass.centre_of_mass"] != drawn[7]["moment mass.centre_of_mass"]


def test_the_same_seed_gives_the_same_files_and_another_folder_is_refused(tmp_path: Path) -> None:
    digests = []
    for name in ("one", "two"):
        (folder,) = simulate_campaign(tmp_path / name, "matrix", 4, recordings=1)
        digests.append([hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())])
    assert digests[0] == digests[1]
    simulate_campaign(tmp_path / "one", "sweep", 4, recordings=1)  # an earlier simulation is replaced
    (tmp_path / "one" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"found thesis.txt in it"):
        simulate_campaign(tmp_path / "one", "sweep", 4, recordings=1)
    with pytest.raises(ValueError, match="preset: expected one of sweep, matrix"):
        simulate_campaign(tmp_path / "x", "demo", 1)


def test_the_command_writes_a_campaign_and_counts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    every = CAMPAIGNS["matrix"]()
    monkeypatch.setitem(CAMPAIGNS, "matrix", lambda: every[:1])
    assert main(["simulate", str(tmp_path / "m"), "--preset", "matrix", "--quiet"]) == 0
    assert capsys.readouterr().out == f"simulated campaign: {tmp_path / 'm'}, 1 recording\n"
    assert load_manifest(tmp_path / "m" / "1-z").excitation.kind == "multisine"
