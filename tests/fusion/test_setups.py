"""Points measured one after another come out as if they had been measured at once; a scan is such a recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support import block, edit, evaluated, undescribed_datasets, write_daq
from take_factory import (
    FREQUENCY_HZ,
    LOAD,
    POINTS,
    RATE_HZ,
    RIG,
    SENSITIVITY,
    Shot,
    head,
    laser,
    output,
    reference,
    signals,
    take,
    write_takes,
)

from fusion.cli import main
from fusion.commands.options import EXIT_DONE
from fusion.phasors.phasor_notices import (
    HARMONIC_UNRESOLVED,
    LARGE_REFERENCE_DRIFT,
    REFERENCE_DRIFT,
    TAKE_FREQUENCY_DIFFERS,
    TAKES_SCATTER,
)
from fusion.planning.check import check
from fusion.recording.daq_records import read_set_ups
from fusion.recording.load import load_manifest
from fusion.recording.placement import unit_direction
from fusion.report.recording_report import result_tables, write_h5
from fusion.report.tables import acceleration
from fusion.sensitivity.analyse import ESTIMATE_NOISE, Evaluation

SEEN = [2, 3, 4]  # z, rx, ry
HARMONICS = {2: 0.01, 3: 0.004}


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """One laser point per take; level drifts, phase is whatever it was when the recording was started."""
    rng = np.random.default_rng(5)
    levels = (1.0 + 0.005 * rng.normal(size=8)) * np.exp(2j * np.pi * rng.random(8))
    levels[0] = 1.0
    frequencies = FREQUENCY_HZ * (1.0 + 2e-6 * rng.normal(size=8))
    driven = zip(POINTS, levels.tolist(), frequencies.tolist(), strict=True)
    shots = [Shot([point], level, frequency, HARMONICS) for point, level, frequency in driven]
    return evaluated(write_takes(tmp_path_factory.mktemp("eight"), shots, rng, top=True))


def test_eight_points_one_after_another_give_the_motion(eight):
    """The phase of every take and its level are those of the first; what is stated of the drift covers what is left."""
    load = acceleration(eight, "load", "fused")
    assert load.observed[0].tolist() == [False, False, True, True, True, False]
    error = (load.phasors.value[0] - LOAD)[SEEN]
    u = np.sqrt(load.phasors.covariance[0].diagonal())
    assert np.all(np.abs(error.real) < 2.0 * u[SEEN])
    assert np.all(np.abs(error.imag) < 2.0 * u[6:][SEEN])
    assert abs(error[0] / LOAD[2]) < 2e-6  # noise: the drift itself is taken off
    assert load.instruments == ("laser",)
    assert {f"take {number}: velocity_1" for number in range(1, 9)} <= {test.instrument for test in load.consistency}


def test_every_number_of_takes_has_unit_words_and_named_axes(eight, tmp_path):
    write_h5(tmp_path / "result.h5", eight, [])
    with h5py.File(tmp_path / "result.h5") as file:
        assert undescribed_datasets(file) == []
        take = next(group for group in file["set_ups"].values() if isinstance(group, h5py.Group))
        assert take["factor"].attrs["units"] == "1"
        assert [axis[0].name.rpartition("/")[2] for axis in take["drift"].dims] == ["frequency_hz"]


def test_the_drift_between_takes_is_part_of_the_uncertainty(eight):
    load = acceleration(eight, "load", "fused")
    size = abs(LOAD[2])
    budget = {part.label: np.sqrt(part.covariance[0, 2, 2]) / size for part in load.uncertainty.grouped()}
    # By hand: eight points, each with what its take drifted by, and three unknowns.
    variance = np.array([take.drift[0] for take in eight.set_ups]) ** 2 / 3.0 + 1e-14
    points = np.array(POINTS)
    geometry = np.column_stack([np.ones(8), points[:, 1], -points[:, 0]])
    at_point = np.abs(geometry @ LOAD[SEEN])
    covariance = np.linalg.inv(geometry.T @ (geometry / (variance * at_point**2)[:, None]))
    assert budget["drift between takes"] == pytest.approx(np.sqrt(covariance[0, 0]) / size, rel=0.02)
    assert budget["reference noise"] < 2e-6
    assert {part.type for part in load.uncertainty.grouped() if part.label == "reference noise"} == {"A"}
    drift = [take.drift[0] for take in eight.set_ups]
    assert drift[0] == 0.0
    assert np.std(drift) == pytest.approx(0.005, rel=0.6)
    codes = REFERENCE_DRIFT.code, LARGE_REFERENCE_DRIFT.code
    assert {notice.where for notice in eight.notices if notice.code in codes} == {
        t.name for t in eight.set_ups if abs(t.drift[0]) > 1e-3
    }


def test_output_of_all_takes_is_one_and_gives_the_sensitivity(eight):
    found = eight.sensitivity
    assert eight.outputs.phasors.channels == ("Fz",)
    value, covariance = found.value[0, 0, 2], found.covariance[0, 0, 2]
    error = np.array([(value - SENSITIVITY).real, (value - SENSITIVITY).imag])
    assert error @ np.linalg.solve(covariance, error) < 9.0
    assert value == pytest.approx(SENSITIVITY, rel=3e-4)


def test_harmonics_are_referred_by_the_reference_at_their_own_line(eight):
    load = acceleration(eight, "load", "fused")
    assert eight.lines.multiple.tolist() == [1, 2, 3]
    for line, (multiple, share) in enumerate(HARMONICS.items(), 1):
        error = load.phasors.value[line, 2] - share * LOAD[2]
        assert abs(error) < 3.0 * np.sqrt(load.phasors.covariance[line, 2, 2])
        assert abs(error) < 2e-3 * share * abs(LOAD[2]), multiple


def test_everything_says_which_take_it_is_of(eight):
    assert [clock.daq for clock in eight.clocks] == [f"take {number}: daq" for number in range(1, 9)]
    names = [channel.name for channel in eight.channels]
    assert names[:3] == ["take 1: drive", "take 1: Fz", "take 1: velocity_1"]
    assert len(set(names)) == 24
    assert [take.name for take in eight.set_ups] == [f"take {number}" for number in range(1, 9)]
    phases = [channel.phasors.value[0, 0] for channel in eight.channels if channel.name.endswith("Fz")]
    assert np.ptp(np.angle(phases)) < 1e-4  # all on the time base of the first take
    assert set(result_tables(eight)) == {"sensitivity.csv", "acceleration.csv", "load.csv"}


def test_takes_cut_from_one_recording_give_what_the_recording_gives(tmp_path):
    """The same samples, once as one take of eight lasers and once as eight takes of one."""
    rng = np.random.default_rng(8)
    values = signals(Shot(POINTS), rng)
    folder = tmp_path / "takes"
    folder.mkdir()
    (tmp_path / "rig.toml").write_text(RIG)
    write_daq(folder / "all.h5", RATE_HZ, values)
    (folder / "recording.toml").write_text(head() + take("all.h5", POINTS, at=""))
    whole = evaluated(folder)
    common, *lasers = take("all.h5", POINTS).split('[[take.daq.channel]]\nname = "velocity_')
    text = "".join(f'{common}[[take.daq.channel]]\nname = "velocity_{laser}' for laser in lasers)
    (folder / "recording.toml").write_text(head() + text)
    takes = evaluated(folder)
    assert len(takes.set_ups) == 8
    assert whole.set_ups == ()
    for one, eight in zip(whole.accelerations, takes.accelerations, strict=True):
        assert (one.body, one.source) == (eight.body, eight.source)
        size = abs(one.phasors.value[0, 2])
        np.testing.assert_allclose(eight.phasors.value[0], one.phasors.value[0], rtol=0, atol=3e-6 * size)
        # Reference noise, which cancels here, may add to what is stated; nothing else does.
        u, stated = np.sqrt(one.phasors.covariance[0, 2, 2]), np.sqrt(eight.phasors.covariance[0, 2, 2])
        assert u * (1.0 - 1e-6) <= stated < u * 1.02
    np.testing.assert_allclose(takes.sensitivity.value[0, 0, 2], whole.sensitivity.value[0, 0, 2], rtol=3e-6)


def test_a_channel_in_every_take_is_one_reading_and_its_scatter_counts(tmp_path):
    """An output whose gain jumps from take to take says so, and its uncertainty grows with it."""
    rng = np.random.default_rng(11)
    shots = [Shot([point]) for point in POINTS[:5]]
    folder = write_takes(tmp_path, shots, rng, harmonics=[1])
    gains = 1.0 + 0.01 * np.array([1.0, -1.2, 0.4, 0.9, -0.7])
    for number, (shot, gain) in enumerate(zip(shots, gains, strict=True), 1):
        values = signals(shot, rng)
        write_daq(folder / f"{number}.h5", RATE_HZ, values | {"Fz": gain * values["Fz"]})
    found = evaluated(folder)
    u = np.sqrt(found.outputs.uncertainty.random[0].covariance[0, 0, 0]) / abs(found.outputs.phasors.value[0, 0])
    assert u * np.sqrt(2.0) == pytest.approx(np.std(gains, ddof=1) / np.sqrt(5.0), rel=0.05)
    assert found.outputs.uncertainty.random[0].dof[0] == pytest.approx(4.0, rel=0.01)
    assert ("Fz", TAKES_SCATTER.code) in {(notice.where, notice.code) for notice in found.notices}


def test_a_large_drift_and_another_frequency_are_warnings(tmp_path):
    rng = np.random.default_rng(3)
    shots = [Shot(POINTS[:1]), Shot(POINTS[1:2], 1.05), Shot(POINTS[2:3], frequency_hz=FREQUENCY_HZ * 1.0005)]
    found = evaluated(write_takes(tmp_path, shots, rng, harmonics=[1]))
    notices = {(notice.where, notice.code): notice for notice in found.notices}
    drift = notices["take 2", LARGE_REFERENCE_DRIFT.code]
    assert drift.values["reference"] == "drive"
    assert drift.values["drift_percent"] == pytest.approx(5.0, rel=1e-2)
    frequency = notices["take 3", TAKE_FREQUENCY_DIFFERS.code]
    assert frequency.values["frequency_hz"] / frequency.values["first_hz"] == pytest.approx(1.0005, abs=2e-6)


def _without_reference(folder: Path) -> None:
    text = (folder / "recording.toml").read_text()
    before, _, after = text.rpartition("reference = true")
    (folder / "recording.toml").write_text(f"{before}reference = false{after}")


def _second(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], **shot: Any) -> Callable[[Path], None]:
    """Change the samples of the second take."""
    values = signals(Shot(POINTS[1:2], **shot), np.random.default_rng(0))
    return lambda folder: write_daq(folder / "2.h5", RATE_HZ, change(values))


def _drive(factor: float) -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Put noise in place of the reference."""
    return lambda values: values | {"drive": factor * np.random.default_rng(0).normal(size=len(values["drive"]))}


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_without_reference, "take[2].daq: "),
        (_second(_drive(1e-3)), "take[2].daq.daq.channel.drive.reference: "),
        (_second(_drive(0.0)), "2.h5: drive: "),
        (_second(dict, frequency_hz=160.0), "excitation.frequencies: "),
        (_second(lambda values: {"Fz": values["Fz"]}), "take[2].daq.daq.file: 2.h5"),
    ],
)
def test_wrong_takes_are_one_sentence(tmp_path, refused, damage, sentence):
    folder = write_takes(tmp_path, [Shot(POINTS[:1]), Shot(POINTS[1:2])], np.random.default_rng(2))
    damage(folder)
    assert sentence in refused("run", folder)
    assert not (folder / "results").exists()


def test_check_and_lines_know_takes(tmp_path, capsys):
    shots = [Shot(POINTS[:1], harmonics=HARMONICS), Shot(POINTS[1:2])]
    folder = write_takes(tmp_path, shots, np.random.default_rng(2))
    assert main(["check", str(folder)]) == EXIT_DONE
    reported = capsys.readouterr().out
    assert re.search("takes: 2, .* drive", reported)
    assert "2.h5" in reported
    assert re.search("load: .*laser", reported)
    assert main(["lines", str(folder)]) == EXIT_DONE
    reported = capsys.readouterr().out  # of the first take
    assert "fundamental" in reported
    assert "harmonic 3" in reported


def test_reference_at_a_weak_harmonic_leaves_that_line_to_the_other_takes(tmp_path):
    """Where the reference does not stand out, a take says nothing at that line instead of noise."""
    rng = np.random.default_rng(4)
    strong, weak = Shot(POINTS[:1], harmonics={2: 1e-3}), Shot(POINTS[1:2], harmonics={2: 0.0})
    found = evaluated(write_takes(tmp_path, [strong, weak], rng, harmonics=[2]))
    referred = {channel.name: channel.phasors.value[:, 0] for channel in found.channels}
    assert np.isfinite(referred["take 1: velocity_1"]).all()
    assert np.isfinite(referred["take 2: velocity_1"]).tolist() == [True, False]


def test_a_harmonic_that_folds_in_one_take_is_left_out_of_all(tmp_path):
    """Sampled at four times the line, its third harmonic cannot be separated from it."""
    slow = Shot(POINTS[1:2], rate_hz=4.0 * FREQUENCY_HZ, samples=1200)
    found = evaluated(write_takes(tmp_path, [Shot(POINTS[:1], harmonics=HARMONICS), slow], np.random.default_rng(2)))
    assert found.lines.multiple.tolist() == [1]
    notices = [notice.values for notice in found.notices if notice.code == HARMONIC_UNRESOLVED.code]
    assert {"take": "take 2", "order": 3, "fundamental_hz": 106.25} in notices


def test_an_output_can_be_the_reference_and_its_noise_then_cancels_in_the_ratio(tmp_path):
    rng = np.random.default_rng(9)
    folder = write_takes(tmp_path, [Shot([point]) for point in POINTS], rng, harmonics=[1])
    edit(folder / "recording.toml", "reference = true", "reference = false")
    edit(folder / "recording.toml", 'channel = "Fz"', 'channel = "Fz"\nreference = true')
    found = evaluated(folder)
    ratio = found.sensitivity
    assert ratio.value[0, 0, 2] == pytest.approx(SENSITIVITY, rel=1e-5)
    load = acceleration(found, "load", "fused")
    noise = {part.label: part.covariance[0] for part in load.uncertainty.grouped()}["reference noise"]
    # Takes tell of it, and lend the output their own noise instead: together no more than without.
    entries = [entry for entry in ratio.budget if entry.label in ("reference noise", ESTIMATE_NOISE)]
    assert [entry.type for entry in entries] == ["A", "A"]
    # By hand: equal noise of all; that of the first reference is in all points but the first, and in the output.
    others = np.arange(8) > 0
    covariance = np.diag(1.0 + others) + np.outer(others, others)
    geometry = np.column_stack([np.ones(8), np.array(POINTS)[:, 1], -np.array(POINTS)[:, 0]])
    gain = np.linalg.pinv(np.linalg.cholesky(np.linalg.inv(covariance)).T @ geometry)[0]
    gain = gain @ np.linalg.cholesky(np.linalg.inv(covariance)).T
    share = np.linalg.norm(gain) / np.linalg.norm([1.0 - gain[0], *gain[1:]])
    along = np.sqrt((noise[2, 2] + noise[8, 8]) / 2.0) / abs(LOAD[2])
    assert np.linalg.norm([e.u_relative[0, 0] for e in entries]) == pytest.approx(along * share, rel=0.15)


ORIGIN = (0.0, 0.0, 0.05)  # of the file's coordinates in the sensor frame
DAQ = {"name": "scan", "file": "Scan_time.asc"}
SCANNED = POINTS[:4]
BLOCKS = ("velocity_1", "drive", "Fz")


def _scan(folder: Path, rng: np.random.Generator, points: int = 4) -> Path:
    """Write a scan in the layout of the published description: points from line 19, acquisition, blocks."""
    takes = []
    for number, point in enumerate(SCANNED[:points]):
        level = complex((1.0 + 2e-3 * number) * np.exp(1j * number))
        takes.append(signals(Shot([point], level, samples=3000), rng))
    lines = ["Scanning vibrometer"] * 18
    lines += [" ".join(f"{x:.12f}" for x in np.subtract(point, ORIGIN)) for point in SCANNED[:points]]
    lines += ["", f"3000 {1.0 / RATE_HZ:.9g}"]
    for name in BLOCKS:
        lines.append(f"block {name}")
        lines += [" ".join(f"{x:.9e}" for x in row) for row in np.column_stack([take[name] for take in takes])]
    recording = folder / "takes"
    recording.mkdir()
    (folder / "rig.toml").write_text(RIG)
    (recording / "Scan_time.asc").write_text("\n".join(lines) + "\n")
    return recording


def _text(folder: Path, *channels: str) -> Path:
    (folder / "recording.toml").write_text(head() + block("[daq]", **DAQ) + "".join(channels))
    return folder


def _short(folder: Path) -> Path:
    """Channels by their block: recorded at every point."""
    return _text(folder, laser("1", ORIGIN), reference("2"), output("3"))


def _seen(number: int, point: Sequence[float], at: str = "") -> str:
    return laser(f"1/{number}", point, at) + reference(f"2/{number}", at) + output(f"3/{number}", at)


def _long(folder: Path) -> Path:
    """Every channel by block and point, lasers with their own place."""
    return _text(folder, *(_seen(number, point) for number, point in enumerate(SCANNED, 1)))


def _blocks(folder: Path) -> Path:
    """The same as blocks of takes."""
    daq = block("[take]") + block("[take.daq]", **DAQ)
    text = "".join(daq + _seen(number, point, "take.") for number, point in enumerate(SCANNED, 1))
    (folder / "recording.toml").write_text(head() + text)
    return folder


def test_every_point_of_a_scan_is_a_take(tmp_path):
    folder = _scan(tmp_path, np.random.default_rng(6))
    found = [evaluated(describe(folder)) for describe in (_short, _long, _blocks)]
    values = [f.accelerations[0].phasors.value[0] for f in found]
    assert [len(f.set_ups) for f in found] == [4, 4, 4]
    for value in values[1:]:
        np.testing.assert_allclose(value, values[0], rtol=1e-9)
    np.testing.assert_allclose(values[0][2:5], LOAD[2:5], atol=1e-4 * abs(LOAD[2]))
    assert [f"{take.drift[0]:.4f}" for take in found[0].set_ups] == ["0.0000", "0.0020", "0.0040", "0.0060"]


def test_points_are_placed_where_the_file_says_and_counted_by_check(tmp_path, capsys):
    folder = _short(_scan(tmp_path, np.random.default_rng(6)))
    takes = read_set_ups(load_manifest(folder))
    placed = [take.records[0].entry.channel[0].point for take in takes]
    np.testing.assert_allclose(np.array(placed, dtype=np.float64), SCANNED, atol=1e-9)
    assert {take.records[0].entry.channel[1].point for take in takes} == {(0.0, 0.0, -0.1)}  # the reference stays
    assert main(["check", str(folder)]) == EXIT_DONE
    reported = capsys.readouterr().out
    assert re.search("3000 samples at 4000 Hz, .* 4 points", reported)
    assert re.search("takes: 4, .* 2", reported)
    assert "laser: z rx ry" in reported


def test_every_point_of_a_scan_has_its_own_direction_to_the_mirror_of_its_head(tmp_path, refused):
    folder = _scan(tmp_path, np.random.default_rng(6))
    mirror = np.array([0.01, -0.02, 0.55])
    rig = RIG + block("head.psv", mirror=mirror.tolist(), rotation_uncertainty=1e-3)
    (folder.parent / "rig.toml").write_text(rig)
    own = laser("1", ORIGIN) + 'head = "psv"\n'
    aimed = own.replace("direction = [0.0, 0.0, 1.0]\n", "")
    takes = read_set_ups(load_manifest(_text(folder, aimed, reference("2"), output("3"))))
    lines = mirror - np.array(SCANNED)
    found = [unit_direction(take.records[0].entry.channel[0]) for take in takes]
    np.testing.assert_allclose(found, lines / np.linalg.norm(lines, axis=1, keepdims=True), atol=1e-9)
    assert "head psv: mirror at (0.01, −0.02, 0.55) m, 4 channels or points" in check(load_manifest(folder)).contents
    reported = refused("run", _text(folder, own, reference("2"), output("3")))
    assert "daq.scan.channel.1.direction: " in reported
    assert "head psv" in reported


def test_a_scan_of_one_point_needs_no_reference(tmp_path):
    folder = _scan(tmp_path, np.random.default_rng(6), points=1)
    assert evaluated(_text(folder, laser("1", SCANNED[0]))).set_ups == ()


@pytest.mark.parametrize(
    ("channels", "sentence"),
    [
        ([laser("1", ORIGIN)], "recording.toml: daq: "),
        ([laser("1/9", ORIGIN)], "Scan_time.asc: 1/9: "),
        ([laser("7", ORIGIN)], "Scan_time.asc: 7: "),
        ([laser(name, ORIGIN) for name in ("1", "1/2")], "daq.scan.channel.1/2: "),
    ],
)
def test_wrong_scans_are_one_sentence(tmp_path, refused, channels, sentence):
    folder = _text(_scan(tmp_path, np.random.default_rng(6)), *channels)
    assert sentence in refused("run", folder)
