"""A small recording of points and a laser: a drive that grows, and a camera rate that folds it onto zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from contracts import refused
from support import AT_ORIGIN, block, channel, evaluated, recording_head, write_daq

from fusion.cli import main
from fusion.errors import ComputeError
from fusion.phasors.phasor_notices import LINE_UNSTEADY, LINES_UNRESOLVED, PAIR_REJECTED
from fusion.phasors.steadiness import line_stationarity, stationarity_notices
from fusion.phasors.stereo_phasors import unresolved_fundamentals
from fusion.report.recording_report import write_h5
from fusion.report.tables import drift_table
from fusion.sensitivity.analyse import Evaluation
from shaker.lines.frequencies import LineFrequencies
from shaker.signal_notices import INSEPARABLE_LINE
from shaker.timebase.tie import ClockTie
from shakercal._common.notices import Notice

DRIVEN_HZ, DAQ_HZ, SAMPLES, FRAMES = 106.25, 10_000.0, 14_000, 64
FOLDING_HZ, CLEAR_HZ = 53.125, 49.7
AMPLITUDE_M = 2.4e-4

RIG = block(format=1, name="points and a laser") + block(
    "stereo.base", body="base", rotation=np.eye(3).tolist(), translation=[0.0] * 3, scale_uncertainty=2e-4,
    exposure=40e-6,
)  # fmt: skip
LASER = channel("laser", "velocity", body="base", **AT_ORIGIN, scale=1.0, scale_uncertainty=5e-4)
POINTS = block("[points]", stereo="base", files="points/frame_*.txt", columns=["x0", "y0", "z0", "x", "y", "z"],
               trigger="camera_trigger")  # fmt: skip


def recording(
    folder: Path,
    frame_hz: float,
    *,
    laser: bool,
    harmonics: Sequence[int] = (),
    overtone: float = 0.0,
    growth: float = 0.0,
) -> Path:
    """Write a recording of a base that moves along z, and return its folder.

    `overtone`: third harmonic over the driven line; `growth`: relative change of the amplitude per second.
    """
    rng = np.random.default_rng(1)
    place = folder / "campaign" / "drive"
    (place / "points").mkdir(parents=True)
    (place.parent / "rig.toml").write_text(RIG, encoding="utf-8")
    text = recording_head("folded", harmonics=harmonics) + channel("camera_trigger", "trigger")
    (place / "recording.toml").write_text(text + (LASER if laser else "") + POINTS, encoding="utf-8")
    first_s = 0.0213
    middle_s = first_s + np.arange(FRAMES) / frame_hz + 20e-6
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 5), np.linspace(-0.04, 0.04, 4))
    rest = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    angle = 2.0 * np.pi * DRIVEN_HZ * middle_s
    height = AMPLITUDE_M * (1.0 + growth * middle_s) * (np.cos(angle) + overtone * np.cos(3.0 * angle))
    for frame, z in enumerate(height):
        seen = rest + [0.0, 0.0, z] + 1e-6 * rng.normal(size=rest.shape)
        np.savetxt(place / "points" / f"frame_{frame:03d}.txt", np.column_stack([rest, seen]), fmt="%.9f")
    time_s = np.arange(SAMPLES) / DAQ_HZ
    turns = (time_s - first_s) * frame_hz
    signals = {"camera_trigger": 5.0 * ((turns >= 0) & (turns < FRAMES) & (np.mod(turns, 1.0) < 0.25))}
    if laser:
        omega = 2.0 * np.pi * DRIVEN_HZ
        velocity = -omega * AMPLITUDE_M * (np.sin(omega * time_s) + 3 * overtone * np.sin(3 * omega * time_s))
        signals["laser"] = velocity * (1.0 + growth * time_s) + 1e-5 * rng.normal(size=SAMPLES)
    write_daq(place / "daq.h5", DAQ_HZ, signals)
    return place


GROWTH = 4e-3  # per second


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return evaluated(recording(tmp_path_factory.mktemp("grown"), CLEAR_HZ, laser=True, growth=GROWTH))


def test_the_change_over_each_record_is_found_and_told(grown):
    laser, pair = line_stationarity(grown.channels, grown.stereo, grown.lines, grown.clocks)
    assert (laser.name, pair.name) == ("laser", "stereo pair base")
    assert laser.frequency_hz == pytest.approx(DRIVEN_HZ, rel=1e-6)
    assert laser.amplitude == pytest.approx(GROWTH * 1.4 * 147 / 148.75, rel=0.005)  # 147 whole periods of 1.4 s
    assert laser.u_amplitude < 1e-5
    assert laser.chance < 1e-6
    assert abs(pair.amplitude - GROWTH * 64 / CLEAR_HZ) < 4.0 * pair.u_amplitude
    assert abs(pair.phase_rad) < 4.0 * pair.u_phase_rad
    assert laser.whole
    assert pair.whole
    (notice,) = (notice for notice in grown.notices if notice.code == LINE_UNSTEADY.code)
    assert notice.severity == "warning"
    assert notice.values["quantity"] == "amplitude"
    assert notice.values["frequency_hz"] == pytest.approx(106.25, rel=1e-6)
    assert notice.values["changes"].startswith("+0.55 % in laser")
    table = drift_table(grown)
    assert [row[0] for row in table.rows] == [laser.name, pair.name]
    assert "0.552" in table.rows[0][4]
    assert table.rows[0][6] == "below 0.0001"


def test_the_blocks_stand_in_the_result_file(grown, tmp_path):
    write_h5(tmp_path / "result.h5", grown, ())
    with h5py.File(tmp_path / "result.h5") as file:
        group = file["channels/daq-laser/stationarity"]
        assert group["value"].shape == (len(group["time_s"]), len(grown.lines.frequency_hz), 1)
        assert group.attrs["whole"]
        assert file["stereo/base/stationarity/u_amplitude_per_s"].shape == (len(grown.lines.frequency_hz), 6)


def test_a_steady_drive_at_a_clear_rate_needs_no_notice(tmp_path):
    steady = evaluated(recording(tmp_path, CLEAR_HZ, laser=True))
    changes = line_stationarity(steady.channels, steady.stereo, steady.lines, steady.clocks)
    assert len(changes) == 2
    assert stationarity_notices(changes) == ()
    assert len(steady.stereo) == 1
    assert not [notice for notice in steady.notices if notice.where.startswith("stereo pair base, 106.25 Hz")]


def test_the_rate_of_a_tied_clock_is_part_of_a_phase(grown):
    (clock,) = grown.clocks
    tie = ClockTie(0.0, 1.0, np.diag([1e-14, 25e-12]), 0, "numbers", 64, 0.7, ())
    alone = line_stationarity(grown.channels, (), grown.lines, grown.clocks)[0]
    tied = line_stationarity(grown.channels, (), grown.lines, (replace(clock, tie=tie),))[0]
    # 5 ppm over 147 periods.
    assert tied.u_phase_rad == pytest.approx(np.hypot(alone.u_phase_rad, 5e-6 * 2 * np.pi * 147), rel=1e-3)
    assert tied.u_amplitude == alone.u_amplitude


def test_the_rate_of_the_trigger_is_part_of_a_phase_that_frames_show(grown):
    (pair,) = line_stationarity((), grown.stereo, grown.lines, ())
    (vague,) = line_stationarity((), (replace(grown.stereo[0], u_rate=2e-6),), grown.lines, ())
    length, known = grown.stereo[0].stationarity.length_s, grown.stereo[0].u_rate
    open_ = 2 * np.pi * DRIVEN_HZ * length
    expected = np.sqrt(pair.u_phase_rad**2 + (2e-6 * open_) ** 2 - (known * open_) ** 2)
    assert vague.u_phase_rad == pytest.approx(expected, rel=1e-3)
    # A drift of twice that is none.
    drifted = replace(vague, amplitude=0.0, phase_rad=2.0 * vague.u_phase_rad, wander=0.0)
    assert stationarity_notices((drifted,)) == ()
    (notice,) = stationarity_notices((replace(drifted, phase_rad=50.0 * vague.u_phase_rad),))
    assert (notice.code, notice.values["quantity"]) == (LINE_UNSTEADY.code, "phase")


def test_a_vibrometer_goes_on_where_the_cameras_lose_the_line(tmp_path):
    evaluation = evaluated(recording(tmp_path, FOLDING_HZ, laser=True))
    assert evaluation.stereo == ()
    assert any(notice.where == "stereo pair base, 106.25 Hz" for notice in evaluation.notices)
    rejected = [notice for notice in evaluation.notices if notice.code == PAIR_REJECTED.code]
    assert [notice.where for notice in rejected] == ["stereo pair base"]
    (fused,) = [a for a in evaluation.accelerations if a.source == "fused"]
    expected = AMPLITUDE_M * (2.0 * np.pi * DRIVEN_HZ) ** 2
    assert abs(abs(fused.phasors.value[0, 2]) / expected - 1.0) < 1e-3


def test_a_harmonic_that_folds_onto_zero_is_left_to_the_laser(tmp_path):
    evaluation = evaluated(recording(tmp_path, 0.75 * DRIVEN_HZ, laser=True, harmonics=[3], overtone=0.2))
    assert evaluation.stereo[0].usable.tolist() == [True, False]
    rejected = [notice for notice in evaluation.notices if notice.where.startswith("stereo pair base, ")]
    assert [notice.where for notice in rejected] == ["stereo pair base, 318.75 Hz"]
    (fused,) = [a for a in evaluation.accelerations if a.source == "fused"]
    omega = 2.0 * np.pi * DRIVEN_HZ
    expected = -AMPLITUDE_M * np.array([1.0, 0.2 * 9.0]) * omega**2
    np.testing.assert_allclose(fused.phasors.value[:, 2], expected, rtol=2e-3)
    assert fused.chi2 < 20.0


def test_cameras_alone_fail_in_one_sentence(tmp_path, capsys):
    place = recording(tmp_path, FOLDING_HZ, laser=False)
    error = refused("106[.]25 Hz", evaluated, place, error=ComputeError)
    assert (error.code, error.values["frequencies"]) == (LINES_UNRESOLVED.code, "106.25 Hz")
    assert not str(error.values["reasons"]).endswith(".)")
    assert main(["run", str(place), "--quiet"]) == 1
    reported = capsys.readouterr().err.strip()
    assert reported.count("\n") == 0
    assert LINES_UNRESOLVED.code in reported
    assert "Traceback" not in reported


def test_reasons_of_lost_lines_are_those_of_these_lines_only():
    frequency_hz = np.array([80.0, 180.0])
    lines = LineFrequencies(frequency_hz, np.zeros(2), frequency_hz[:1].repeat(2), np.array([1, 2]), ("", ""), ())
    folded = [Notice(INSEPARABLE_LINE, f"stereo pair top, {hertz:g} Hz", frequency_hz=hertz) for hertz in (80.0, 180.0)]
    with pytest.raises(ComputeError) as raised:
        unresolved_fundamentals((), lines, folded)
    reason = folded[0].text.removesuffix(".")
    assert (raised.value.code, raised.value.values["reasons"]) == (LINES_UNRESOLVED.code, f" ({reason})")
