"""Rolling shutters and long exposures: what moves while frames are exposed is found as it was, or refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.base import Settings
from fusion.errors import InputError
from fusion.phasors.phasor_notices import (
    EXPOSURE_REFUSED,
    FRAMES_FREE_RUNNING,
    MOTION_BLUR,
    PAIR_BODY_DEFORMS,
    ROLLING_SHUTTER,
)
from fusion.phasors.stereo_motion import PhaseRotated
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.recording_notices import KEY_NOT_APPLICABLE
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import SimulationOptions, rendered_run, write_run
from fusion.simulate.world import Draws, make_world
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.sine_fit import fit_sines

HERTZ, FRAMES = 80.0003, 28


def recorded(folder: Path, row_time: float, exposure_s: float, growth: float, **changes: Any) -> Path:
    """Render the demo's top face at one line, `growth` times its motion, everything as stated."""
    preset = read_preset(Preset, "demo")
    line = tuple(growth * phasor for phasor in preset.acceleration[0])
    (top, _) = preset.stereo
    preset = replace(
        preset, multiples=(1,), acceleration=(line,), exposure_s=exposure_s, frames=FRAMES,
        stereo=(replace(top, row_time=row_time, **changes),),
    ).reduced(None, 0.5)  # fmt: skip
    draws = Draws(5, systematic=False)
    options = SimulationOptions(systematic_errors=False, trigger_jitter=False)
    return write_run(folder, rendered_run(preset), make_world(preset, draws, 0.0), draws, options)


def evaluated(run: Path) -> Evaluation:
    return evaluate_recording(load_manifest(run), Settings(device="cpu"), {})


def errors(run: Path, evaluation: Evaluation) -> np.ndarray:
    """Errors (6,) of the displacement of the load, less what the trigger's instants leave open, in its u."""
    reported = json.loads((run / "truth.json").read_text())["acceleration"]["load"]
    true = -(np.array(reported["re"]) + 1j * np.array(reported["im"]))[0] / (2.0 * np.pi * HERTZ) ** 2
    (pair,) = evaluation.stereo
    value = pair.phasors.value[0]
    late = np.angle(value[2] / true[2])
    assert abs(late) < 2.0 * np.pi * HERTZ * 10e-6
    return (value * np.exp(-1j * late) - true) / pair.phasors.u_re[0]


@pytest.mark.slow
def test_rows_of_one_camera_are_exposed_in_turn_and_its_film_needs_no_trigger(tmp_path):
    """The simulator moves every row of the face; 0.16 mm off in the first frame would change z by 0.04 %."""
    run = recorded(tmp_path, 2e-5, 60e-6, 2.0, surface_uncertainty=(2e-4, 1e-3))
    evaluation = evaluated(run)
    assert ROLLING_SHUTTER.code in [notice.code for notice in evaluation.notices]
    assert np.abs(errors(run, evaluation)).max() < 4.0
    manifest = run / "recording.toml"
    stated = manifest.read_text().replace('trigger = "camera_trigger"', "frame_rate = 38.36")  # 38.345 Hz
    manifest.write_text(stated)
    with pytest.raises(InputError) as error:  # the lasers measure the load's phase, too
        load_manifest(run)
    assert (error.value.code, error.value.key) == (KEY_NOT_APPLICABLE.code, "images.top.frame_rate")
    manifest.write_text(re.sub(r'\[\[daq\.channel\]\]\nname = "velocity.*?(?=\[\[)', "", stated, flags=re.DOTALL))
    free = evaluated(run)
    (pair,) = evaluation.stereo
    size, u = np.abs(pair.phasors.value[0, 2]), pair.phasors.u_re[0, 2]
    (other,) = free.stereo
    assert abs(np.abs(other.phasors.value[0, 2]) - size) < 4.0 * u
    (element,) = (e for e, c in enumerate(free.element.elements) if c == (2, 2))
    found = free.element.polar[0][element]
    assert found.expanded_phase_rad > np.pi
    assert not found.region.holds_zero
    assert FRAMES_FREE_RUNNING.code in [notice.code for notice in free.notices]


def test_turned_poses_hold_the_motion_of_cells_that_see_it_at_their_own_times():
    rng, hertz = np.random.default_rng(2), np.array([80.0, 250.0])
    root = rng.normal(size=(40, 6, 8))
    information, delay_s = root @ root.swapaxes(1, 2), rng.uniform(0.0, 9e-3, 40)  # two periods of the second line
    motion, time_s = rng.normal(size=(2, 6, 2)) @ [1.0, 1j], np.arange(30) / 38.3
    turn = np.exp(2j * np.pi * np.multiply.outer(hertz, delay_s))
    at_cells = np.einsum("kc,ki,kf->fci", turn, motion, np.exp(2j * np.pi * np.multiply.outer(hertz, time_s))).real
    sums = np.einsum("kc,cij,fcj->fki", turn.conj(), information, at_cells)
    pose = np.linalg.solve(information.sum(axis=0), sums[..., None])[..., 0]
    known = 0.1 * motion  # what is known is in the frames no more
    one = np.broadcast_to(np.eye(6), (2, 6, 6)).astype(complex)
    turned = PhaseRotated(0.9 * pose, one, known, np.eye(6), np.zeros(1), 21)
    fit = fit_sines(time_s, rng.normal(size=(30, 6)), hertz, MOTION_COMPONENTS, component_units(0))
    np.testing.assert_allclose(turned.motion(time_s, fit).value, motion, atol=1e-9)


def test_points_of_a_rolling_shutter_are_refused(make_campaign):
    with pytest.raises(InputError, match=r"points\.base\.stereo: "):
        load_manifest(
            make_campaign(replace=(("rig.toml", 'body = "base"', 'body = "base"\nrow_time = [1e-5, -1e-5]'),))
        )


@pytest.mark.slow
def test_rows_exposed_one_after_the_other_are_taken_back_to_one_instant(tmp_path):
    run = recorded(tmp_path, 20e-6, 60e-6, 1.0)
    assert "2.38 ms (68.5° at 80 Hz)" in str(check(load_manifest(run)))
    found = evaluated(run)
    assert np.abs(errors(run, found)).max() < 4.5
    codes = {notice.code for notice in found.notices}
    assert ROLLING_SHUTTER.code in codes
    assert PAIR_BODY_DEFORMS.code not in codes
    assert not any("rigid" in notice.text for notice in found.notices)
    rig = run.parent / "rig.toml"
    rig.write_text(rig.read_text().replace("row_time = 2e-05", "row_time = 1e-03"))
    with pytest.raises(InputError, match=r"stereo\.top\.row_time: .*0\.02608 s") as error:
        evaluated(run)
    assert error.value.code == EXPOSURE_REFUSED.code


@pytest.mark.slow
def test_the_blur_of_long_exposures_is_taken_off(tmp_path):
    run = recorded(tmp_path, 0.0, 4e-3, 3.0)
    found = evaluated(run)
    assert np.abs(errors(run, found)).max() < 4.5
    (pair,) = found.stereo
    assert pair.phasors.u_re[0, 2] < 5e-4 * abs(pair.phasors.value[0, 2])
    (notice,) = (notice for notice in found.notices if notice.code == MOTION_BLUR.code)
    assert notice.values["exposure_ms"] == pytest.approx(4.0)
