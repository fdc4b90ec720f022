"""Instruments that contradict each other: scatter, differences, suspects, and what none of them tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import acceptance, coverage_contract
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_factory import (
    AXIAL,
    BARE,
    CIRCLE,
    TRUTH,
    beam,
    camera,
    drop_readings,
    lasers,
    rotated_frame,
    simulated_readings,
    triaxial,
    with_values,
)
from scipy.optimize import brentq
from scipy.stats import binom, chi2, f, ncf, ncx2, t
from support import region_distance

from fusion.estimation.consistent_solution import INCONSISTENCY, missing_covariance
from fusion.estimation.estimation_notices import (
    GROSS_ERROR,
    INSTRUMENTS_DISAGREE,
    INSTRUMENTS_DISPUTED,
    SINGLE_ERROR_NOT_ASSESSED,
)
from fusion.estimation.fuse import Acceleration, fuse, fuse_sources, untested
from fusion.estimation.instrument_consistency import estimate_explanations, evaluate_suspicion, stated_covariance
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import as_complex
from fusion.estimation.variance_components import Contrasts, EstimatedNoise, variance_components
from fusion.sensitivity.load_phasors import load_phasors
from fusion.sensitivity.moving_body import Body, make_moving_part
from shakercal._common.notices import Notice

TURN_RAD = 5e-3


def expanded(result: Acceleration, component: int) -> float:
    """U of the complex value at the first line, with the t-factor of its degrees of freedom."""
    u = np.hypot(result.phasors.u_re[0, component], result.phasors.u_im[0, component])
    return float(u * t.ppf(0.975, min(result.uncertainty.dof()[0, component], 1e6)))


def error(result: Acceleration, component: int, truth: np.ndarray = TRUTH) -> float:
    return float(abs(result.phasors.value[0, component] - truth[0, component]))


def warning(result: Acceleration) -> Notice:
    return next(notice for notice in result.notices if notice.severity == "warning")


def scattered(noise: float, count: int, seed: int) -> tuple[Contrasts, float]:
    """Contrasts of repeated readings of one constant, and their sample variance."""
    values = np.random.default_rng(seed).normal(size=count)
    across = np.linalg.svd(np.ones((count, 1)))[0][:, 1:]
    spread = noise * np.eye(count - 1)
    return Contrasts(across.T @ values, spread, np.eye(count - 1)[None]), float(np.var(values, ddof=1))


@pytest.mark.parametrize("noise", [1e-12, 0.2])
def test_one_component_is_the_excess_of_the_sample_variance(noise):
    group, variance = scattered(noise, 9, 1)
    (component,), (dof,) = variance_components([group])
    assert component == pytest.approx(variance - noise, rel=1e-5)
    # Satterthwaite: the variance 2 s⁴/8 of the estimate as 2 θ²/ν.
    assert dof == pytest.approx(8 * ((variance - noise) / variance) ** 2, rel=1e-4)
    assert variance_components([replace(group, covariance=10.0 * np.eye(8))])[0][0] == 0.0


def test_the_same_errors_at_all_lines_count_once():
    group, variance = scattered(1e-12, 9, 2)
    (component,), (dof,) = variance_components([group] * 4)
    assert component == pytest.approx(variance, rel=1e-5)
    assert dof == pytest.approx(8.0, rel=1e-4)


def test_an_instrument_that_cannot_test_itself_has_no_scatter_of_its_own():
    rng = np.random.default_rng(3)
    seen = simulated_readings([camera(), lasers(3), triaxial()], rng)
    seen[0] = rotated_frame(seen[0], 1, 0.02)
    result = fuse(seen)
    assert result.scatter == ()
    assert any(c.label == "inconsistency of instruments" for c in result.uncertainty.random)


@pytest.mark.parametrize("spread", [1.0, 1.0j])
def test_scatter_of_amplitudes_is_told_from_that_of_phases(spread):
    rng = np.random.default_rng(4)
    (clean,) = simulated_readings([lasers(8, 2e-7, AXIAL, **BARE)], rng, AXIAL)
    value = clean.phasors.value * (1 + 1e-3 * spread * rng.normal(size=8))
    (found,) = fuse([with_values(clean, value)]).scatter
    large, small = (found.amplitude, found.phase) if spread == 1.0 else (found.phase, found.amplitude)
    np.testing.assert_allclose(large, 1e-3, rtol=0.6)
    assert np.all(small < 1e-5)
    # Eight readings, three components; the second line repeats what the first one says.
    np.testing.assert_allclose(found.dof, 5.0, rtol=5e-2)


def test_scatter_at_a_harmonic_stays_there():
    rng = np.random.default_rng(5)
    (clean,) = simulated_readings([lasers(8, 1e-5, AXIAL, **BARE)], rng, AXIAL)
    value = clean.phasors.value * (1 + np.array([[1e-4], [0.1]]) * rng.normal(size=(2, 8)))
    (found,) = fuse([with_values(clean, value)]).scatter
    assert found.amplitude[0] < 3e-4
    assert found.amplitude[1] == pytest.approx(0.1, rel=0.6)


def test_two_instruments_of_different_scale_are_both_covered_and_nothing_else_is():
    rng = np.random.default_rng(6)
    optical, array = simulated_readings([camera(), lasers(8)], rng)
    agreed = fuse([optical, array])
    result = fuse([optical, with_values(array, array.phasors.value * 1.002)])
    assert {test.instrument for test in result.consistency if test.suspect} == {"stereo top", "laser as a whole"}
    for truth in (TRUTH, 1.002 * TRUTH):
        assert error(result, 2, truth) < expanded(result, 2) < 0.006 * 189.0
    for component in (0, 1, 5):
        assert expanded(result, component) == pytest.approx(expanded(agreed, component), rel=0.1)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("others", ["triaxial", "beam", "both"])
def test_a_turned_camera_is_named_and_covered(others, axis):
    rng = np.random.default_rng(7)
    more = {"triaxial": [triaxial()], "beam": [beam()], "both": [beam(), triaxial()]}[others]
    seen = simulated_readings([camera(), lasers(3), *more], rng)
    result = fuse([rotated_frame(seen[0], axis, 5e-3), *seen[1:]])
    if others == "beam" and axis == 0:
        # A beam along x says nothing of a turn about x, and the report says so.
        assert "stereo top: pose rotation x" in {row.name for row in untested(result)}
        return
    suspects = {test.instrument for test in result.consistency if test.suspect}
    assert "stereo top" in suspects
    assert len(suspects) == (1 if others == "both" and axis == 1 else 2)
    assert warning(result).code == INSTRUMENTS_DISAGREE.code
    assert f"stereo top: pose rotation {'xy'[axis]} of 0.00" in warning(result).values["causes"]
    assert error(result, 1 - axis) < expanded(result, 1 - axis)
    for component in range(6):
        assert error(result, component) < 1.6 * expanded(result, component)


def test_axial_beams_alone_do_not_test_a_turn_and_the_result_says_so():
    seen = simulated_readings([camera(), lasers(8)], np.random.default_rng(8))
    result = fuse([rotated_frame(seen[0], 1, 5e-3), *seen[1:]])
    assert not any(notice.severity == "warning" for notice in result.notices)
    rows = {row.name: row for row in untested(result)}
    assert {"stereo top: pose rotation x", "stereo top: pose rotation y"} <= set(rows)
    row = rows["stereo top: pose rotation y"]
    assert (row.component, row.u, row.unit) == ("x", 5e-4, "rad")
    assert row.share > 0.9
    assert row.relative == pytest.approx(5e-4 * 189.0 / abs(result.phasors.value[0, 0]), rel=1e-3)


@given(st.integers(0, 10_000))
@settings(max_examples=5, deadline=None, derandomize=True)
def test_whatever_is_missing_or_wrong_values_have_uncertainties(seed):
    rng = np.random.default_rng(seed)
    every = [camera(), lasers(int(rng.integers(1, 9))), triaxial(), beam()]
    seen = []
    for observation in simulated_readings([o for o in every if rng.random() < 0.7] or [lasers(8)], rng):
        value = observation.phasors.value * (1 + 10 ** rng.uniform(-5, 1) * rng.normal(size=len(observation.members)))
        gone = (rng.random(value.shape) < 0.15) | np.array([[False], [seed % 3 == 0]])
        seen.append(drop_readings(with_values(observation, value), gone))
    for result in fuse_sources(seen, "load"):
        assert np.array_equal(np.isfinite(result.phasors.value), result.observed)
        variances = result.phasors.covariance.diagonal(axis1=1, axis2=2)
        assert np.array_equal(variances >= 0.0, np.tile(result.observed, (1, 2)))


def both_parts(component: int) -> np.ndarray:
    """Places of a component's real and imaginary part, for rows and columns."""
    return np.ix_([component, component + 6], [component, component + 6])


def disagreement(result: Acceleration) -> np.ndarray:
    """Covariance (12, 12) at the first line of what instruments differ by."""
    return np.asarray(next(c.covariance[0] for c in result.uncertainty.random if c.label == INCONSISTENCY))


def covered(result: Acceleration, truth: np.ndarray = TRUTH) -> np.ndarray:
    """Which components' 95 % regions hold the truth at the first line."""
    return np.array(region_distance(result.phasors.value[0], truth[0], result.uncertainty)) <= 1.0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_camera_that_may_be_turned_is_so_in_rotations_too(axis):
    """Two instruments that differ by 5 mrad as one of 1 mrad would: half of the excess variance is each one's."""
    seen = simulated_readings([camera(), lasers(3), triaxial()], np.random.default_rng(1), drawn=False)
    result = fuse([rotated_frame(seen[0], axis, TURN_RAD), *seen[1:]])
    # The camera states 0.5 mrad, the accelerometer 0.5 mrad and 1 mrad / √2 across its axis.
    stated = 0.5e-3**2 + 0.5e-3**2 + 1e-3**2 / 2.0
    turn = np.sqrt((TURN_RAD**2 - stated) / 2.0)
    # A turn about x takes ry into rz, a turn about y takes rx into rz, of which only the camera tells.
    across = TRUTH[0, 4 - axis]
    along = np.array([across.real, across.imag]) / abs(across)
    found = float(along @ disagreement(result)[both_parts(5)] @ along)
    assert np.sqrt(found) == pytest.approx(turn * abs(across), rel=0.15)
    assert np.all(covered(result))


def test_an_instrument_that_two_others_contradict_is_alone_in_doubt():
    seen = simulated_readings([camera(), lasers(3), beam(), triaxial()], np.random.default_rng(2), drawn=False)
    found = disagreement(fuse([rotated_frame(seen[0], 1, TURN_RAD), *seen[1:]]))
    # All of the excess is the camera's; what the other two state between them is 0.43 mrad.
    turn = np.sqrt(TURN_RAD**2 - 0.5e-3**2 - 0.43e-3**2)
    assert np.sqrt(found[11, 11]) == pytest.approx(turn * abs(TRUTH[0, 3]), rel=0.15)


@given(st.integers(0, 10_000), st.integers(2, 4))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_what_is_missing_is_the_least_that_makes_up_for_what_is_wanted(seed, rank):
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-6, 6, (2, 3, 1))
    half = rng.normal(size=(2, 6, rank)) * np.concatenate([size, size], axis=1)
    wanted = half @ half.swapaxes(1, 2)
    scale = np.sqrt(np.einsum("kii->ki", wanted))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(missing_covariance(wanted, 0.0 * wanted) / scale, wanted / scale, atol=1e-6)
    assert np.max(np.abs(missing_covariance(wanted, 1.001 * wanted) / scale)) <= 1e-9
    # Real and imaginary part of each value, allowed for in one direction of the plane only.
    angle = rng.uniform(0.0, np.pi)
    direction, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    allowed = np.zeros((2, 6, 6))
    blocks = [np.ix_([0, 1], [value, value + 3], [value, value + 3]) for value in range(3)]
    for both in blocks:
        allowed[both] = 1e3 * np.trace(wanted[both], axis1=1, axis2=2)[:, None, None] * np.outer(direction, direction)
    missing = missing_covariance(wanted, allowed)
    for both in blocks:
        some = np.trace(wanted[both], axis1=1, axis2=2)[:, None]
        made_up = np.linalg.eigvalsh(missing[both] + allowed[both] - wanted[both]) / some
        assert min(np.min(np.linalg.eigvalsh(missing[both]) / some), np.min(made_up)) >= -1e-6
        least = np.einsum("i,kij,j->k", across, missing[both] - wanted[both], across)
        assert np.max(np.abs(least) / some[:, 0]) < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_where_a_turn_is_noticed_every_component_is_covered(axis):
    rng = np.random.default_rng(3)
    clean, held = [camera(), lasers(3), triaxial()], []
    for _ in range(60):
        seen = simulated_readings(clean, rng)
        result = fuse([rotated_frame(seen[0], axis, TURN_RAD), *seen[1:]])
        if any(notice.severity == "warning" for notice in result.notices):
            held.append(covered(result))
    # Of a 5 σ contradiction 7 in 10 or more are beyond the limit for all unknowns together.
    assert len(held) >= 42
    assert np.all(np.sum(held, axis=0) >= binom.ppf(0.001, len(held), 0.95))


@pytest.mark.slow
def test_eight_lasers_with_unstated_scatter_are_unbiased_and_covered():
    rng, clean, errors, spread = np.random.default_rng(11), lasers(8, 2e-7, AXIAL, **BARE), [], []
    unit = AXIAL[0, 2] / abs(AXIAL[0, 2])
    along = np.array([unit.real, unit.imag])

    def estimate(_: int) -> tuple[complex, np.ndarray]:
        (read,) = simulated_readings([clean], rng, AXIAL)
        result = fuse([with_values(read, read.phasors.value * (1 + 1e-3 * rng.normal(size=8)))])
        value, covariance = result.phasors.value[0, 2], result.phasors.covariance[0][both_parts(2)]
        dof = min(float(result.uncertainty.dof()[0, 2]), 1e6)
        errors.append(((value - AXIAL[0, 2]) / unit).real)
        spread.append(t.ppf(0.975, dof) * np.sqrt(along @ covariance @ along))
        return value, result.uncertainty.regions(result.phasors.value)[0, 2] / chi2.ppf(0.95, 2)

    coverage_contract(estimate, AXIAL[0, 2], 200, cautious=True)
    assert np.median(spread) / np.quantile(np.abs(errors), 0.95) < 1.2
    assert abs(np.mean(errors)) / 189.0 < 1e-4
    low, high = acceptance(len(errors))
    assert low <= np.sum(np.abs(errors) <= np.array(spread)) <= high


def scaled(observation: Observation, factor: float, member: int | None = None) -> Observation:
    """An instrument, or one channel of it, that reads too much."""
    factors = np.ones(len(observation.members))
    factors[slice(None) if member is None else member] = factor
    return with_values(observation, observation.phasors.value * factors)


CENTRE = lasers([(0.0, 0.0, 0.04)])


@pytest.mark.parametrize("wrong", [0, 1])
def test_two_instruments_thirty_per_cent_apart_give_both_values_and_no_mean(wrong):
    """Of several absurd causes the largest (a laser displaced by 0.78 m) was taken for the true one: u stayed 2e-4."""
    seen = simulated_readings([camera(), lasers([(0.03, 0.0, 0.04)])], np.random.default_rng(1))
    seen[wrong] = scaled(seen[wrong], 1.3)
    fused, *single = fuse_sources(seen, "load")
    assert not fused.observed[0, 2]
    assert np.isnan(fused.phasors.value[0, 2])
    assert fused.disputed is not None
    assert fused.disputed[0, 2]
    assert {one.suspect for one in fused.explanations} == {"stereo top", "p0"}
    assert all(one.gross for one in fused.explanations)
    notice = warning(fused)
    assert notice.code == INSTRUMENTS_DISPUTED.code
    assert "z" in notice.values["components"].split(", ")
    assert "gross" in notice.values["causes"]
    assert single[0].phasors.value[0, 2].real == pytest.approx(189.0 * (1.3 if wrong == 0 else 1.0), rel=2e-3)
    load = load_phasors(fused, Body((make_moving_part("cube", 1.0, (0.0, 0.0, 0.03), np.eye(3) * 1e-3),)))
    assert not load.observed.any()


def test_the_values_of_a_dispute_are_its_explanations():
    optical, beams = simulated_readings([camera(), lasers(3)], np.random.default_rng(1))
    result = fuse([optical, scaled(beams, 1.3)])
    assert [abs(one.value[0, 2]) for one in result.explanations] == pytest.approx([1.3 * 189.0, 189.0], rel=2e-3)


def test_what_one_of_three_gets_grossly_wrong_is_left_out_and_nothing_else():
    rng = np.random.default_rng(2)
    seen = simulated_readings([camera(), lasers(3), triaxial(), beam()], rng)
    right = fuse([seen[0], *seen[2:]])
    result = fuse([seen[0], scaled(seen[1], 1.3), *seen[2:]])
    (left,) = (test for test in result.consistency if test.left_out)
    assert left.instrument == "laser as a whole"
    assert not left.used
    assert (warning(result).code, warning(result).where) == (GROSS_ERROR.code, "laser as a whole")
    np.testing.assert_allclose(result.phasors.value, right.phasors.value, rtol=1e-9)
    np.testing.assert_allclose(result.phasors.covariance, right.phasors.covariance, rtol=1e-6)
    assert result.instruments == ("stereo top", "triaxial", "side")


def test_explanations_are_what_a_fit_without_the_suspect_finds():
    """Against a dense generalised least squares of the other readings with the same linearised common errors."""
    system = build_system(simulated_readings([camera(), lasers(3), triaxial()], np.random.default_rng(3)))
    solution = solve(system)
    rows = np.flatnonzero(system.observation == 1)
    rest = np.flatnonzero(system.observation != 1)
    one = evaluate_suspicion(system, solution, ("laser",), rows)
    spread = solution.noise + solution.effects @ solution.effects.T
    weight = np.linalg.inv(spread[np.ix_(rest, rest)])
    normal = np.linalg.inv(system.design[rest].T @ weight @ system.design[rest])
    (found,) = estimate_explanations(system, solution, [one])
    expected = system.acceleration(normal @ system.design[rest].T @ weight @ system.readings[rest])
    np.testing.assert_allclose(found.value, expected, rtol=1e-6, atol=1e-6)
    covariance = (system.expand @ normal @ system.expand.T)[:12, :12]
    np.testing.assert_allclose(found.covariance[0], covariance, rtol=1e-4, atol=1e-9)
    # Ten times the stated uncertainties of the laser's readings, as another covariance.
    more = spread.copy()
    more[np.ix_(rows, rows)] += 99.0 * spread[np.ix_(rows, rows)]
    weight = np.linalg.inv(more)
    normal = np.linalg.inv(system.design.T @ weight @ system.design)
    tenfold = system.acceleration(normal @ system.design.T @ weight @ system.readings)
    change = as_complex(one.tenfold_change.reshape(-1, 12))
    np.testing.assert_allclose(solution.acceleration + change, tenfold, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (-1.0, "its sign were reversed"),
        (9.80665, "values in m/s² were treated as values in g"),
        (1 / 9.80665, "values in g were treated as values in m/s²"),
    ],
)
@pytest.mark.parametrize("alone", [False, True])
def test_a_reversed_channel_and_a_mistaken_unit_are_named(factor, words, alone):
    second = replace(lasers(3, common="second", scale_uncertainty=2.5e-4), members=("q0", "q1", "q2"))
    clean = [camera(), CENTRE, *([] if alone else [second])]
    seen = simulated_readings(clean, np.random.default_rng(4))
    result = fuse([seen[0], scaled(seen[1], factor), *seen[2:]])
    assert f"as if {words}" in warning(result).text  # names of MISTAKES, which are data
    assert any(test.instrument == "p0" and test.suspect for test in result.consistency)


def test_two_exchanged_channels_are_named():
    (optical, axes) = simulated_readings([camera(), triaxial()], np.random.default_rng(5))
    value = axes.phasors.value[:, [2, 1, 0]]
    result = fuse([optical, with_values(axes, value)])
    assert "ax and az" in warning(result).values["checks"]
    assert "triaxial as a whole" in {test.instrument for test in result.consistency if test.suspect}


GROSS_CASES = {
    "one of two": ([camera(), CENTRE], 1, None, 2.5e-4),
    "the other of two": ([camera(), CENTRE], 0, None, 2e-4),
    "one of three": ([camera(), CENTRE, triaxial()], 2, None, 2e-3),
    "the camera of three": ([camera(), CENTRE, triaxial()], 0, None, 2e-4),
    "one of four": ([camera(), lasers(3), triaxial(), beam()], 1, None, 2.5e-4),
    "a channel of four": ([camera(), lasers(3), triaxial(), beam()], 2, 2, 1e-3),
}


def wrong_by(case: str, times: float, trials: int) -> tuple[int, int, int]:
    """How many of the trials hold the true z or give none, name the right suspect, and do one of both."""
    clean, bad, member, u = GROSS_CASES[case]
    rng, held, named, either = np.random.default_rng(int(times)), 0, 0, 0
    members = clean[bad].members if member is None else clean[bad].members[member : member + 1]
    right = {clean[bad].title, f"{clean[bad].title} as a whole", *members}
    for _ in range(trials):
        seen = simulated_readings(clean, rng)
        seen[bad] = scaled(seen[bad], 1.0 + times * u, member)
        result = fuse(seen)
        holds = not result.observed[0, 2] or covered(result)[2]
        names = bool(right & {test.instrument for test in result.consistency if test.suspect})
        held, named, either = held + holds, named + names, either + (holds or names)
    return held, named, either


MANY = [pytest.param(times, 40, marks=pytest.mark.slow) for times in (5.0, 10.0, 30.0, 1000.0)]


@pytest.mark.parametrize(("times", "trials"), [(10.0, 3), (1000.0, 3), *MANY])
@pytest.mark.parametrize("case", list(GROSS_CASES))
def test_gross_errors_are_covered_or_named(case, times, trials):
    """Five standard uncertainties of one are 2 to 4 of a difference of two: what no test at 1 % tells from chance."""
    held, named, either = wrong_by(case, times, trials)
    if times > 5.0:
        assert held >= binom.ppf(0.001, trials, 0.9)
        assert either >= binom.ppf(0.001, trials, 0.97)
    else:
        assert held >= named - 2
    if times > 10.0:
        assert named >= binom.ppf(0.001, trials, 0.97)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["one of two", "one of three", "one of four"])
def test_where_all_is_as_stated_alarms_are_rare_and_u_is_not_enlarged(case):
    clean, rng, trials = GROSS_CASES[case][0], np.random.default_rng(6), 200
    alarms, spread, held = 0, [], []
    for _ in range(trials):
        result = fuse(simulated_readings(clean, rng))
        alarms += any(notice.severity == "warning" for notice in result.notices)
        spread.append(expanded(result, 2))
        held.append(covered(result))
    assert alarms <= binom.isf(0.001, trials, 0.01)
    # Where readings deviate by chance U is as large as they deviate: the share of such records counts, not their mean.
    assert np.sum(np.array(spread) > 1.02 * np.median(spread)) <= binom.isf(0.001, trials, 0.01)
    low, high = acceptance(trials, 6)
    assert np.all((np.sum(held, axis=0) >= low) & (np.sum(held, axis=0) <= high))


REGION = float(np.sqrt(chi2.ppf(0.95, 2)))


def circle(count: int) -> Observation:
    """Equal laser points on a circle, each with an error of its own alone, u = 1e-4."""
    return lasers(CIRCLE[:: 8 // count], 1e-6, AXIAL, common="laser", individual_uncertainty=1e-4)


@pytest.mark.parametrize(("count", "components"), [(4, {"z", "rx", "ry"}), (8, {"rx", "ry"})])
def test_what_five_u_of_one_point_of_a_circle_move_beyond_u_is_told(count, components):
    """Of n points z has 1/n of a reading's variance, a rotation 2/n over r²: 5/√n, 5·√(2/n) of their u on its axis."""
    result = fuse([circle(count)])
    assert {one.component for one in result.unnoticed} == components
    for one in result.unnoticed:
        moved = 5.0 * np.sqrt((1.0 if one.component == "z" else 2.0) / count) / REGION
        assert one.shift == pytest.approx(moved, rel=1e-3)
    assert {one.channel for one in result.unnoticed if one.component == "ry"} == {"p0", f"p{count // 2}"}
    (notice,) = (notice for notice in result.notices if notice.code == SINGLE_ERROR_NOT_ASSESSED.code)
    assert notice.values["limit"] == 5.0
    assert f"{5.0 * np.sqrt(2.0 / count) / REGION:.2g} U (p0, p{count // 2})" in notice.possible_size


def test_an_error_that_the_test_sees_is_not_unnoticed():
    """Of two readings with weights w the test sees an error z of noncentrality z²·(1 - w) in 80 % at λ."""
    weights = (0.32, 0.68)
    two = [
        lasers([(0.0, 0.0, 0.03)], 1e-6, AXIAL[:1], common=f"head {w}", individual_uncertainty=1e-4 / np.sqrt(w))
        for w in weights
    ]
    known = [replace(one, phasors=replace(one.phasors, dof=np.full(1, np.inf))) for one in two]
    result = fuse([replace(one, members=(name,)) for one, name in zip(known, "ab", strict=True)])
    limit = brentq(lambda power: ncx2.sf(chi2.isf(0.01, 2), 2, power) - 0.8, 1.0, 50.0)
    z = [min(5.0, np.sqrt(limit / (1.0 - w))) for w in weights]
    assert z[0] < 4.6
    expected = [a * np.sqrt(w) / REGION for a, w in zip(z, weights, strict=True)]
    assert [one.shift for one in result.unnoticed] == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_what_is_told_to_be_unnoticed_is():
    """One of four points 5 u high, 2.5 of their one contrast: ry lies 5/√2 of its u off wherever no test sees it."""
    rng, silent = np.random.default_rng(18), []
    for _ in range(200):
        (drawn,) = simulated_readings([circle(4)], rng, AXIAL)
        result = fuse([scaled(drawn, 1.0 + 5e-4, 0)])
        if not any(notice.severity == "warning" for notice in result.notices):
            silent.append(covered(result, AXIAL)[[3, 4]])
    assert len(silent) > 0.2 * 200
    for held, share in zip(np.sum(silent, axis=0), (0.95, ncx2.cdf(REGION**2, 2, 12.5)), strict=True):
        assert binom.ppf(0.001, len(silent), share) <= held <= binom.isf(0.001, len(silent), share)


# Noise whose covariance was estimated.


@pytest.mark.parametrize("dof", [6.0, 27.0])
def test_the_test_of_a_reading_with_estimated_noise_is_exact(dof):
    """Against one that is known (x² + y²)/s² is 2·F(2, ν), Hotelling's case; against one as bad 2·F(2, 2ν) by Welch."""
    sure, weak, other = (
        lasers([(0.0, 0.0, 0.03)], noise, AXIAL[:1], common=name, scale_uncertainty=1e-9)
        for noise, name in ((1e-7, "sure"), (1e-3, "weak"), (1e-3, "other"))
    )
    weak, other = (replace(one, phasors=replace(one.phasors, dof=np.full(1, dof))) for one in (weak, other))
    for two, m in (((sure, weak), dof), ((other, weak), 2.0 * dof)):
        system = build_system([replace(one, members=(str(place),)) for place, one in enumerate(two)])
        solution = solve(system)
        noise = EstimatedNoise.from_system(system, solution.effects)
        assert solution.dof == 2
        assert noise.p_value(9.0, 2, solution.projector) == pytest.approx(f.sf(4.5, 2, m), rel=0.02)
        limit = noise.detectable_noncentrality(2, solution.projector, 0.8)
        assert ncf.sf(f.isf(0.01, 2, m), 2, m, limit) == pytest.approx(0.8, rel=0.01)


def estimated(trial: int, dof: int) -> list[Observation]:
    """Camera and channels as stated; the camera's noise and its covariance drawn, Re and Im with one Wishart matrix."""
    rng = np.random.default_rng([20, trial])
    root = 3e-8 * np.array([1, 1, 3, 30, 30, 10.0])[:, None] * np.linalg.cholesky(0.5 * np.eye(6) + 0.5)
    stereo, *others = simulated_readings([camera(1e-15), lasers(4, 1e-4), triaxial()], rng)
    samples = root @ rng.normal(size=(2, 6, dof))
    covariance = np.kron(np.eye(2), samples @ samples.swapaxes(1, 2) / dof)
    value = stereo.phasors.value + (rng.normal(size=(2, 6)) + 1j * rng.normal(size=(2, 6))) @ root.T
    known = replace(stereo.phasors, value=value, covariance=covariance, dof=np.full(2, float(dof)))
    return [replace(stereo, phasors=known), *others]


@pytest.mark.parametrize("dof", [12, pytest.param(27, marks=pytest.mark.slow)])
def test_instruments_whose_noise_was_estimated_agree_as_often_as_the_test_says(dof):
    found, plain = [], []
    for trial in range(150):
        system = build_system(estimated(trial, dof))
        solution = solve(system)
        noise = EstimatedNoise.from_system(system, solution.effects)
        found.append(noise.p_value(solution.chi2, solution.dof, solution.projector))
        plain.append(chi2.sf(solution.chi2, solution.dof))
    for share in (0.01, 0.05, 0.2):
        held = np.sum(np.array(found) < share)
        assert binom.ppf(1e-3, len(found), share) <= held <= binom.isf(1e-3, len(found), share)
    # As if the noise were known the test fails too often.
    assert np.mean(np.array(plain) < 0.05) > {12: 0.15, 27: 0.07}[dof]


def test_the_cause_of_a_contradiction_is_named_where_noise_was_estimated():
    """What readings still differ by once the turn is free is noise; as if that were known, a quarter had no cause."""
    named = []
    for trial in range(24):
        stereo, *others = estimated(trial, 8)
        result = fuse([rotated_frame(stereo, 1, 3.5e-3), *others])
        causes = [n.values["causes"] for n in result.notices if n.code == INSTRUMENTS_DISAGREE.code]
        named += ["pose rotation y" in text for text in causes]
    assert len(named) > 4
    assert np.mean(named) > 0.9


@pytest.mark.slow
def test_what_estimated_weights_cost_is_in_u():
    """Errors over u have the mean square of Student's t, 12/10, or less; without what weights cost they are beyond."""
    found, plain = [], []
    for trial in range(400):
        seen = estimated(trial, 12)
        solution, result = solve(build_system(seen)), fuse(seen)
        variance = np.diagonal(stated_covariance(solution, solution.gain.reshape(2, 12, -1))[0])
        off = np.abs(result.phasors.value[0] - TRUTH[0]) ** 2
        found.append(off / (result.phasors.u_re[0] ** 2 + result.phasors.u_im[0] ** 2))
        plain.append(off / (variance[:6] + variance[6:]))
    allowed = 1.2 + 3.0 * np.std(found, axis=0) / np.sqrt(len(found))
    assert np.all(np.mean(found, axis=0) < allowed)
    assert np.max(np.mean(plain, axis=0) - allowed) > 0.0
