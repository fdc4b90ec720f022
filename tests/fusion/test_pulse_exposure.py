"""Cameras that expose as long as the trigger is active: the width of its pulses measured, used and reported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import AT_ORIGIN, block, channel, evaluated, recording_head, write_daq

from fusion.cli import main
from fusion.errors import InputError
from fusion.instruments.stereo import Exposure
from fusion.phasors.phasor_notices import EXPOSURE_REFUSED
from fusion.phasors.timing import Sight, TimeBase, frame_sight, tie_daqs
from fusion.planning.check import check
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import load_manifest
from fusion.report.tables import clocks_table, stereo_table
from fusion.sensitivity.analyse import Evaluation
from photogram.geometry import rotation_from_vector

FREQUENCY_HZ = 106.2507
OMEGA = 2 * np.pi * FREQUENCY_HZ
MOTION = np.array([4e-6 + 3e-6j, -2e-6, 2.4e-4 * np.exp(0.7j), 3e-5j, 2e-5 - 1e-5j, 1e-5])  # m and rad
RATE_HZ, FRAME_RATE_HZ, FIRST_EDGE_S, DELAY_S = 20_000.0, 49.7, 0.02131, 3e-6
WIDTH_S = 2.3137e-3
"""A quarter of a period of the motion: 9 % of the amplitude is lost, and the middles move by 0.77 rad."""

STATED = {"rotation": np.eye(3).tolist(), "translation": [0.0] * 3, "scale_uncertainty": 1e-6, "delay": DELAY_S}
RECORDING = (
    recording_head("pulses", harmonics=[])
    + channel("z", "acceleration", body="load", **AT_ORIGIN)
    + channel("camera_trigger", "trigger")
    + block("[points]", stereo="base", files="points.csv", columns=["frame", "id_x", "x", "y", "z"],
            trigger="camera_trigger")
)  # fmt: skip


@dataclass(frozen=True)
class Shot:
    """What the synthetic recording is like: width of the pulses, number of frames, input filter, record's end."""

    width_s: float = WIDTH_S
    frames: int = 40
    filtered: bool = False
    end_s: float = 0.05


def _filter_step(place: np.ndarray) -> np.ndarray:
    """A rise behind a decimation filter, half amplitude at half the sampling rate; place in samples."""
    fine = np.arange(-24 * 64, 24 * 64 + 1) / 64.0
    taps = np.sinc(fine) * np.kaiser(len(fine), 8.0)
    return np.interp(place - 0.5 / 64.0, fine, np.cumsum(taps) / taps.sum(), left=0.0, right=1.0)


def _rig(exposure: float | str) -> str:
    return block(format=1, name="points") + block("stereo.base", body="base", exposure=exposure, **STATED)


def _write(folder: Path, shot: Shot, of_pair: float | str, **override: Any) -> Path:
    """Write points of a body in motion, exposed while the trigger is high, and return the recording's folder."""
    rng = np.random.default_rng(31)
    run = folder / "campaign" / "run"
    run.mkdir(parents=True, exist_ok=True)
    (run.parent / "rig.toml").write_text(_rig(of_pair), encoding="utf-8")
    (run / "recording.toml").write_text(RECORDING + block(**override), encoding="utf-8")
    edge_s = FIRST_EDGE_S + np.arange(shot.frames) / FRAME_RATE_HZ
    phase = np.exp(1j * OMEGA * (edge_s + DELAY_S + shot.width_s / 2))[:, None]
    pose = np.sinc(FREQUENCY_HZ * shot.width_s) * (MOTION * phase).real
    rest = np.column_stack([*(axis.ravel() for axis in np.meshgrid([-0.05, 0.0, 0.06], [-0.04, 0.05])), np.zeros(6)])
    seen = np.einsum("fij,nj->fni", rotation_from_vector(pose[:, 3:]), rest) + pose[:, None, :3]
    seen += 1e-8 * rng.normal(size=seen.shape)
    number = np.indices((shot.frames, 6)).reshape(2, -1).T
    rows = np.column_stack([number, seen.reshape(-1, 3)])
    np.savetxt(run / "points.csv", rows, fmt=["%d"] * 2 + ["%.12f"] * 3, delimiter=",", header="frame,id_x,x,y,z")
    time_s = np.arange(int((edge_s[-1] + shot.end_s) * RATE_HZ)) / RATE_HZ
    step = _filter_step if shot.filtered else lambda x: np.where(x >= 0.0, 1.0, 0.0)
    trigger = 2e-3 * rng.normal(size=len(time_s))
    for edge in edge_s:
        near = slice(max(int((edge - 2e-3) * RATE_HZ), 0), int((edge + shot.width_s + 2e-3) * RATE_HZ))
        place = time_s[near] * RATE_HZ
        trigger[near] += 5.0 * (step(place - edge * RATE_HZ) - step(place - (edge + shot.width_s) * RATE_HZ))
    z = np.cos(OMEGA * time_s) + 1e-4 * rng.normal(size=len(time_s))
    write_daq(run / "daq.h5", RATE_HZ, {"z": z, "camera_trigger": trigger})
    return run


def _base(evaluation: Evaluation) -> np.ndarray:
    found = next(a for a in evaluation.accelerations if (a.body, a.source) == ("base", "photogrammetry"))
    return found.phasors.value[0]


def _seen(run: Path, frames: int = 40) -> tuple[Sight, TimeBase]:
    manifest = load_manifest(run)
    base = tie_daqs(manifest, read_daqs(manifest))
    return frame_sight(manifest, base, manifest.points[0], frames), base


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("width_s", [WIDTH_S, 413e-6])
def test_the_exposure_is_the_width_recorded(tmp_path, filtered, width_s):
    sight, base = _seen(_write(tmp_path, Shot(width_s=width_s, filtered=filtered), "pulse"))
    exposure = sight.exposure
    assert abs(exposure.length_s - width_s) < 4.0 * exposure.u_length_s
    assert exposure.u_length_s < 0.05 / RATE_HZ
    true_s = FIRST_EDGE_S + np.arange(40) / FRAME_RATE_HZ + DELAY_S + width_s / 2
    trigger = base.first_with("camera_trigger")[1]
    u = np.hypot(trigger.u_time_s(np.asarray(20)), exposure.u_length_s / 2)
    assert np.max(np.abs(sight.time_s - true_s)) < 4.0 * u


def test_a_stated_exposure_is_exact(tmp_path):
    sight, _ = _seen(_write(tmp_path, Shot(), "pulse", exposure=1e-3))
    assert sight.exposure == Exposure("camera_trigger", 1e-3, 0.0)


def test_a_run_is_that_with_the_width_stated(tmp_path):
    measured, stated = (evaluated(_write(tmp_path, Shot(), exposure)) for exposure in ("pulse", WIDTH_S))
    (pair,) = measured.stereo
    assert abs(pair.exposure_s - WIDTH_S) < 4.0 * pair.u_exposure_s
    assert (stated.stereo[0].exposure_s, stated.stereo[0].u_exposure_s) == (WIDTH_S, 0.0)
    (width,) = Exposure("camera_trigger", pair.exposure_s, pair.u_exposure_s).errors(np.array([FREQUENCY_HZ]))
    ratio = _base(measured)[2] / _base(stated)[2] - 1.0
    assert abs(ratio) < 4.0 * abs(width.effect[0, 0])
    error = _base(measured) / (-(OMEGA**2) * MOTION) - 1.0
    assert abs(error[2]) < 1e-3
    labels = {c.label for a in measured.accelerations if a.body == "base" for c in a.uncertainty.grouped()}
    assert "camera_trigger: pulse width" in labels
    assert not any("pulse width" in c.label for a in stated.accelerations for c in a.uncertainty.grouped())


def test_the_effect_of_a_width_is_that_of_evaluating_with_another(tmp_path):
    u_s = 2e-6
    run = _write(tmp_path, Shot(), WIDTH_S - u_s / 2)
    before = _base(evaluated(run))
    (run.parent / "rig.toml").write_text(_rig(WIDTH_S + u_s / 2), encoding="utf-8")
    ratio = _base(evaluated(run)) / before - 1.0
    (expected,) = Exposure("camera_trigger", WIDTH_S, u_s).errors(np.array([FREQUENCY_HZ]))
    np.testing.assert_allclose(ratio, np.repeat(expected.effect, 6), rtol=2e-3)


def test_every_run_tells_the_width(tmp_path):
    evaluation = evaluated(_write(tmp_path, Shot(), 40e-6))
    (clock,) = evaluation.clocks
    assert clock.pulse_width_s == pytest.approx(WIDTH_S, abs=2e-6)
    table = clocks_table(evaluation)
    (cell,) = next(row[1:] for row in table.rows if row[0] == "pulse width / µs")
    assert str(cell).startswith("2313.")
    pairs = stereo_table(evaluation.stereo)
    assert ("exposure / µs", "40") in pairs.rows
    assert not any("pulse" in notice.text for notice in evaluation.notices)


def test_check_tells_what_the_exposure_will_be(tmp_path):
    reported = str(check(load_manifest(_write(tmp_path, Shot(), "pulse"))))
    assert "(2313." in reported
    assert "(2313." not in str(check(load_manifest(_write(tmp_path, Shot(), 1e-3))))


@pytest.mark.parametrize(
    ("shot", "reason"), [(Shot(width_s=0.9 / RATE_HZ), "1.5 samples"), (Shot(frames=3, end_s=1e-3), "3 edges")]
)
def test_pulses_that_cannot_be_measured_are_refused(tmp_path, shot, reason, capsys):
    run = _write(tmp_path, shot, "pulse")
    assert main(["run", str(run)]) == 2
    reported = capsys.readouterr().err
    assert EXPOSURE_REFUSED.code in reported
    assert "rig.toml: stereo.base.exposure: " in reported
    assert reason in reported
    assert any("stereo.base.exposure" in problem for problem in check(load_manifest(run)).problems)
    run = _write(tmp_path, shot, 1e-3, exposure="pulse")
    with pytest.raises(InputError, match=r"recording\.toml: points\.base\.exposure: ") as error:
        _seen(run, shot.frames)
    assert error.value.code == EXPOSURE_REFUSED.code
    manifest = load_manifest(run)
    base = tie_daqs(manifest, read_daqs(manifest))
    assert base.results()[0].pulse_width_s is None
