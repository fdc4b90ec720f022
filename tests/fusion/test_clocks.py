"""Clocks whose edges are nearly locked, and a line that frames and channels see: what is reached, what is left alone.

Recordings are drawn by `benchmarks/clocks.py`: edges, samples and poses at instants that no formula of the estimate
enters. Bounds: Rife and Boorstyn's for a frequency; rectangular distributions over what edges leave open; the exact
posterior of edges, period and phases, integrated on a grid.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, chi2

from fusion.estimation.fuse import fuse
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.uncertainty import real_stack
from fusion.phasors.clocks import frame_interval, period_from_motion, refine_ties, tie_clocks_by_motion
from fusion.sensitivity.analyse import with_estimates
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.violations import violations
from fusion.simulate.world import Draws, make_world
from shaker.signal_notices import CONTRADICTORY_PERIOD


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        yield importlib.import_module("clocks")


@pytest.fixture(scope="module")
def locked(benchmark: ModuleType) -> Any:
    """A recording whose edges fall on one place."""
    return benchmark.simulate(benchmark.CASES["0"], np.random.default_rng(2))


def test_frames_determine_their_distance_as_well_as_their_noise_allows(benchmark: ModuleType) -> None:
    rng, errors, stated = np.random.default_rng(3), [], []
    for _ in range(3):
        one = benchmark.simulate(benchmark.CASES["0"], rng)
        true_s = float(np.mean(np.diff(one.middle_s)))
        found = period_from_motion(one.base, [one.motion], one.lines)
        assert found is not None
        errors.append(found[0] / true_s - 1.0)
        stated.append(found[1] / true_s)
    low, high = np.sqrt(chi2.ppf([1e-3, 1.0 - 1e-3], 3) / 3.0)
    assert low < np.sqrt(np.mean(np.square(errors))) / benchmark.bound() < high
    assert 0.85 < np.sqrt(np.mean(np.square(stated))) / benchmark.bound() < 1.2


def test_edges_that_pass_one_sample_determine_all_instants_for_a_given_period(benchmark: ModuleType) -> None:
    """Sure to a step from edge to edge, 0.9/95 of a sample of 39 us, and to what the period leaves over a second."""
    rng = np.random.default_rng(5)
    while True:  # one in ten draws has no such edge
        one = benchmark.simulate(benchmark.CASES["0.9"], rng)
        upper = one.base.triggers["vibrometer", "camera"].upper_s * benchmark.RATE_HZ
        samples = np.rint(upper - benchmark.WHOLE * np.arange(benchmark.FRAMES))
        if 20 < np.count_nonzero(samples == samples[0]) < 76:
            break
    before, after = benchmark.both(one)
    assert before.errors[0, 1] > 2e-6
    assert after.errors[0, 1] < 0.5e-6
    assert abs(after.errors[0, 0]) < 2.5 * after.errors[0, 1]
    assert after.errors[1, 1] == pytest.approx(benchmark.bound(), rel=0.35)
    assert after.errors[1, 1] < 0.1 * before.errors[1, 1]
    assert after.errors[3, 1] < 0.5 * before.errors[3, 1]


def test_the_tie_includes_the_uncertainty_of_locked_edges(benchmark: ModuleType, locked: Any) -> None:
    """Edges at one place: a sample, rectangular, in each block; the tie has the difference, the frames the first."""
    one = locked
    base, lines = refine_ties(one.base, one.lines)
    tied, (motion,), _ = tie_clocks_by_motion(one.manifest, base, [one.motion], lines)
    of_frames = {e.name: e for e in tied.sight_errors(motion.sight)}
    of_tie = {e.name: e for e in tied.tie_errors("bridge")}
    gap_s = 1.0 / benchmark.RATE_HZ / np.sqrt(12.0)
    assert of_frames["camera: time"].u == pytest.approx(gap_s, rel=0.1)
    assert of_tie["camera: time"].offset_s == pytest.approx(of_frames["camera: time"].offset_s, rel=0.25)
    assert of_tie["clock bridge: time"].u == pytest.approx(gap_s, rel=0.1)
    # Before: as if both were independent.
    assert {e.name.split(":")[0] for e in base.tie_errors("bridge")} == {"clock bridge"}


def test_phases_reduce_the_uncertainty_of_the_bridge(benchmark: ModuleType) -> None:
    """Edges pass no sample of the first block, and many of the bridge: frames and laser see one motion to 0.16 us."""
    rng = np.random.default_rng(11)
    while True:  # one in three draws
        one = benchmark.simulate(benchmark.CASES["0.6, bridge at 20 kHz"], rng)
        upper = one.base.triggers["vibrometer", "camera"].upper_s * benchmark.RATE_HZ
        if len(set(np.rint(upper - benchmark.WHOLE * np.arange(benchmark.FRAMES)))) == 1:
            break
    _, after = benchmark.both(one)
    tie, lag = after.errors[3], after.errors[5]
    least = benchmark.least_u(one, rng, True)[1]
    assert tie[1] > 4e-6  # by the edges, rectangular over 0.4 of a sample
    assert abs(tie[0]) > 2.0 * lag[1]
    assert lag[1] < 0.5e-6
    assert 0.6 < lag[1] / least < 1.6  # the average of many draws is no smaller
    assert abs(lag[0]) < 2.5 * lag[1]


def test_outputs_are_least_squares_with_the_instruments(benchmark: ModuleType) -> None:
    """As if each output were a further reading, of a motion of its own: y_o - C_oy·P·y by the covariance of all."""
    phasors = importlib.import_module("simulated_phasors")
    case = next(case for case in phasors.CASES if case.one_clock)
    inputs, _ = phasors.simulate_phasors(phasors.case_setup(case), Draws(3, True))
    found = with_estimates(inputs.outputs, fuse(inputs.observations))
    system = build_system([o for o in inputs.observations if o.body == "load"])
    solved = solve(system)
    effects = {i.name: i.effect for i in inputs.outputs.uncertainty.influences}
    lines, size = effects["clock bridge: time"].shape
    shared = np.array([effects.get(c.name, np.zeros((lines, size))) for c in system.common]).reshape(-1, lines * size)
    across = shared.T @ solved.effects.T @ solved.projector
    value = real_stack(inputs.outputs.phasors.value).ravel() - across @ system.readings
    lost = (across @ solved.effects @ shared).reshape(lines, size, lines, size)
    assert real_stack(found.phasors.value).ravel() == pytest.approx(value, rel=1e-6, abs=1e-12 * np.abs(value).max())
    for line in range(lines):
        left = inputs.outputs.phasors.covariance[line] - lost[line, :, line]
        assert found.phasors.covariance[line] == pytest.approx(left, rel=1e-5, abs=1e-7 * np.diag(left).max())
    clock = "clock bridge: time"
    (after,) = (i.effect for i in found.uncertainty.influences if i.name == clock)
    assert np.linalg.norm(after) < 0.9 * np.linalg.norm(effects[clock])


def test_a_late_clock_turns_outputs_and_leaves_their_size(benchmark: ModuleType) -> None:
    phasors = importlib.import_module("simulated_phasors")
    case = next(case for case in phasors.CASES if case.one_clock)
    inputs, _ = phasors.simulate_phasors(phasors.case_setup(case), Draws(3, True))
    fused, clock, late_s = fuse(inputs.observations), "clock bridge: time", 5e-6
    estimates = tuple(replace(u, estimate=late_s / u.u if u.name == clock else 0.0) for u in fused.unknowns)
    updated = with_estimates(inputs.outputs, replace(fused, unknowns=estimates)).phasors.value
    frequency, before = inputs.outputs.phasors.frequency_hz, inputs.outputs.phasors.value
    assert np.abs(updated / before) == pytest.approx(1.0, abs=1e-9)
    angle = np.abs(np.angle(updated / before))
    assert angle == pytest.approx(np.broadcast_to(2.0 * np.pi * late_s * frequency[:, None], angle.shape), rel=1e-6)


def test_sufficient_edges_are_used_unchanged(benchmark: ModuleType) -> None:
    one = benchmark.simulate(benchmark.CASES["no lock: 500.382 samples"], np.random.default_rng(1))
    base, motions, lines = tie_clocks_by_motion(one.manifest, one.base, [one.motion], one.lines)
    assert base is one.base
    assert motions == (one.motion,)
    assert lines is one.lines


def test_a_motion_that_contradicts_the_edges_is_reported_and_not_used(benchmark: ModuleType, locked: Any) -> None:
    one = locked
    number, sight = np.arange(benchmark.FRAMES), one.motion.sight
    line = benchmark.LINE_HZ * (1.0 + 1e-4)  # not what drives the channels
    pose = np.real(np.exp(2j * np.pi * line * one.middle_s)[:, None] * one.truth)
    other = replace(one.motion, motion=replace(one.motion.motion, pose=pose - pose[0]))
    base, (motion,), _ = tie_clocks_by_motion(one.manifest, one.base, [other], one.lines)
    before, after = (b.triggers["vibrometer", "camera"] for b in (one.base, base))
    assert after.time_s(number) == pytest.approx(before.time_s(number), abs=0.0)
    assert motion.sight.time_s == pytest.approx(sight.time_s, abs=0.0)
    assert base.ties["bridge"].rate == pytest.approx(one.base.ties["bridge"].rate, abs=1e-5)
    (notice,) = (n for n in after.notices if n.severity == "warning")
    assert (notice.code, notice.values["direction"]) == (CONTRADICTORY_PERIOD.code, "longer")
    assert notice.values["relative_difference"] == pytest.approx(1e-4, rel=0.05)


def test_less_than_two_beats_determine_no_period(benchmark: ModuleType, locked: Any) -> None:
    one = locked
    distance_s = float(np.mean(np.diff(one.middle_s)))
    slow = 2.0 / distance_s + 1.5 / (benchmark.FRAMES * distance_s)  # 1.5 beats
    assert frame_interval(one.motion, replace(one.lines, frequency_hz=np.array([slow]))) is None
    assert frame_interval(one.motion, one.lines) is not None


def test_simulated_frames_drift_past_the_samples_as_requested() -> None:
    preset = read_preset(Preset, "sweep")
    world = make_world(preset, Draws(1, False, violations=violations(("locked-clocks=0.4",), preset)), 0.0)
    sample_position = world.trigger_s * preset.daqs[0].sample_rate_hz
    assert (sample_position - sample_position[0] - np.rint(sample_position - sample_position[0]))[-1] == pytest.approx(
        0.4, abs=1e-6
    )
    assert np.ptp(np.diff(sample_position)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["0.3", "0.9"])
def test_locked_clocks_err_as_they_state(name: str, benchmark: ModuleType) -> None:
    draws, rng = 20, np.random.default_rng(6)
    found = [benchmark.both(benchmark.simulate(benchmark.CASES[name], rng))[1] for _ in range(draws)]
    error, u = np.array([one.errors for one in found]).transpose(2, 1, 0)
    inside = np.sum(np.abs(error) <= 2.0 * u, axis=1)
    assert inside.min() >= binom.ppf(1e-3 / 6, draws, 0.95)
    low, high = np.sqrt(chi2.ppf([1e-3, 1.0 - 1e-3], draws) / draws)
    assert low < np.sqrt(np.mean((error[1] / u[1]) ** 2)) < high  # the rate, whose error is normal
    assert not any(one.contradicted for one in found)
