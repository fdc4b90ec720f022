"""Instruments that contradict each other: scatter, differences, suspects, and what none of them tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from contracts import acceptance, coverage_contract
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_factory import (
    AXIAL,
    BARE,
    TRUTH,
    beam,
    camera,
    lasers,
    measured,
    triaxial,
    turned,
    with_values,
    without,
)
from scipy.stats import binom, chi2, t

from fusion.estimation.consistency import not_allowed_for
from fusion.estimation.fuse import INCONSISTENCY, Acceleration, fuse, fuse_sources, untested
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import region_factor
from fusion.estimation.variance_components import Contrasts, variance_components

TURN_RAD = 5e-3


def expanded(result: Acceleration, component: int) -> float:
    """U of the complex value at the first line, with the t-factor of its degrees of freedom."""
    u = np.hypot(result.phasors.u_re[0, component], result.phasors.u_im[0, component])
    return float(u * t.ppf(0.975, min(result.uncertainty.dof()[0, component], 1e6)))


def error(result: Acceleration, component: int, truth: np.ndarray = TRUTH) -> float:
    return float(abs(result.phasors.value[0, component] - truth[0, component]))


def warning(result: Acceleration) -> str:
    return next(notice.text for notice in result.notices if notice.severity == "warning")


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
    assert variance_components([replace(group, spread=10.0 * np.eye(8))])[0][0] == 0.0


def test_the_same_errors_at_all_lines_count_once():
    group, variance = scattered(1e-12, 9, 2)
    (component,), (dof,) = variance_components([group] * 4)
    assert component == pytest.approx(variance, rel=1e-5)
    assert dof == pytest.approx(8.0, rel=1e-4)


def test_an_instrument_that_cannot_test_itself_has_no_scatter_of_its_own():
    rng = np.random.default_rng(3)
    seen = measured([camera(), lasers(3), triaxial()], rng)
    seen[0] = turned(seen[0], 1, 0.02)
    result = fuse(seen)
    assert result.scatter == ()
    assert any(c.label == "inconsistency of instruments" for c in result.uncertainty.random)


@pytest.mark.parametrize("spread", [1.0, 1.0j])
def test_scatter_of_amplitudes_is_told_from_that_of_phases(spread):
    rng = np.random.default_rng(4)
    (clean,) = measured([lasers(8, 2e-7, AXIAL, **BARE)], rng, AXIAL)
    value = clean.phasors.value * (1 + 1e-3 * spread * rng.normal(size=8))
    (found,) = fuse([with_values(clean, value)]).scatter
    large, small = (found.amplitude, found.phase) if spread == 1.0 else (found.phase, found.amplitude)
    np.testing.assert_allclose(large, 1e-3, rtol=0.6)
    assert np.all(small < 1e-5)
    # Eight readings, three components; the second line repeats what the first one says.
    np.testing.assert_allclose(found.dof, 5.0, rtol=5e-2)


def test_scatter_at_a_harmonic_stays_there():
    rng = np.random.default_rng(5)
    (clean,) = measured([lasers(8, 1e-5, AXIAL, **BARE)], rng, AXIAL)
    value = clean.phasors.value * (1 + np.array([[1e-4], [0.1]]) * rng.normal(size=(2, 8)))
    (found,) = fuse([with_values(clean, value)]).scatter
    assert found.amplitude[0] < 3e-4
    assert found.amplitude[1] == pytest.approx(0.1, rel=0.6)


def test_two_instruments_of_different_scale_are_both_covered_and_nothing_else_is():
    rng = np.random.default_rng(6)
    optical, array = measured([camera(), lasers(8)], rng)
    agreed = fuse([optical, array])
    result = fuse([optical, with_values(array, array.phasors.value * 1.01)])
    assert {test.instrument for test in result.consistency if test.suspect} == {"stereo top", "laser as a whole"}
    for truth in (TRUTH, 1.01 * TRUTH):
        assert error(result, 2, truth) < expanded(result, 2) < 0.03 * 189.0
    for component in (0, 1, 5):
        assert expanded(result, component) == pytest.approx(expanded(agreed, component), rel=0.1)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("others", ["triaxial", "beam", "both"])
def test_a_turned_camera_is_named_and_covered(others, axis):
    rng = np.random.default_rng(7)
    more = {"triaxial": [triaxial()], "beam": [beam()], "both": [beam(), triaxial()]}[others]
    seen = measured([camera(), lasers(3), *more], rng)
    result = fuse([turned(seen[0], axis, 5e-3), *seen[1:]])
    if others == "beam" and axis == 0:
        # A beam along x says nothing of a turn about x, and the report says so.
        assert "stereo top: pose rotation x" in {row.name for row in untested(result)}
        return
    suspects = {test.instrument for test in result.consistency if test.suspect}
    assert "stereo top" in suspects
    assert len(suspects) == (1 if others == "both" and axis == 1 else 2)
    assert f"stereo top: pose rotation {'xy'[axis]} would have to be 0.00" in warning(result)
    assert "U was enlarged" in warning(result)
    assert error(result, 1 - axis) < expanded(result, 1 - axis)
    for component in range(6):
        assert error(result, component) < 1.6 * expanded(result, component)


def test_axial_beams_alone_do_not_test_a_turn_and_the_result_says_so():
    seen = measured([camera(), lasers(8)], np.random.default_rng(8))
    result = fuse([turned(seen[0], 1, 5e-3), *seen[1:]])
    assert not any(notice.severity == "warning" for notice in result.notices)
    rows = {row.name: row for row in untested(result)}
    assert {"stereo top: pose rotation x", "stereo top: pose rotation y"} <= set(rows)
    row = rows["stereo top: pose rotation y"]
    assert (row.component, row.u, row.unit) == ("x", 5e-4, "rad")
    assert row.share > 0.9
    assert row.relative == pytest.approx(5e-4 * 189.0 / abs(result.phasors.value[0, 0]), rel=1e-3)
    (text,) = (notice.text for notice in result.notices if "not tested" in notice.text)
    assert "stereo top: pose rotation y (100% of the variance of x)" in text


def test_where_instruments_agree_fused_is_no_worse_than_the_best_of_them():
    rng = np.random.default_rng(9)
    for _ in range(5):
        fused, *single = fuse_sources(measured([camera(), lasers(8), triaxial()], rng), "load")
        assert not any(notice.severity == "warning" for notice in fused.notices)
        for component in range(6):
            best = min(expanded(one, component) for one in single if one.observed[0, component])
            assert expanded(fused, component) <= best * (1 + 1e-3)
    # One kind of instrument alone is the fused result.
    fused, single = fuse_sources(measured([lasers(8)], np.random.default_rng(10)), "load")
    assert single.source == "vibrometer"
    np.testing.assert_array_equal(single.phasors.value, fused.phasors.value)


@given(st.integers(0, 10_000))
@settings(max_examples=12, deadline=None, derandomize=True)
def test_whatever_is_missing_or_wrong_values_have_uncertainties(seed):
    rng = np.random.default_rng(seed)
    every = [camera(), lasers(int(rng.integers(1, 9))), triaxial(), beam()]
    seen = []
    for observation in measured([o for o in every if rng.random() < 0.7] or [lasers(8)], rng):
        value = observation.phasors.value * (1 + 10 ** rng.uniform(-5, 1) * rng.normal(size=len(observation.members)))
        gone = (rng.random(value.shape) < 0.15) | np.array([[False], [seed % 3 == 0]])
        seen.append(without(with_values(observation, value), gone))
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


def covered(result: Acceleration) -> np.ndarray:
    """Which components' 95 % regions hold the truth at the first line."""
    covariance, dof = result.uncertainty.covariance[0], result.uncertainty.dof()[0]
    error = result.phasors.value[0] - TRUTH[0]
    parts = np.stack([error.real, error.imag], axis=1)
    squares = [p @ np.linalg.solve(covariance[both_parts(c)], p) for c, p in enumerate(parts)]
    return np.array([square <= region_factor(float(nu)) ** 2 for square, nu in zip(squares, dof, strict=True)])


@pytest.mark.parametrize("axis", [0, 1])
def test_a_camera_that_may_be_turned_is_so_in_rotations_too(axis):
    """Two instruments that differ by 5 mrad as one of 1 mrad would: half of the excess variance is each one's."""
    seen = measured([camera(), lasers(3), triaxial()], np.random.default_rng(1), drawn=False)
    result = fuse([turned(seen[0], axis, TURN_RAD), *seen[1:]])
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
    seen = measured([camera(), lasers(3), beam(), triaxial()], np.random.default_rng(2), drawn=False)
    found = disagreement(fuse([turned(seen[0], 1, TURN_RAD), *seen[1:]]))
    # All of the excess is the camera's; what the other two state between them is 0.43 mrad.
    turn = np.sqrt(TURN_RAD**2 - 0.5e-3**2 - 0.43e-3**2)
    assert np.sqrt(found[11, 11]) == pytest.approx(turn * abs(TRUTH[0, 3]), rel=0.15)


@given(st.integers(0, 10_000), st.integers(2, 4))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_what_is_missing_is_the_least_that_makes_up_for_what_is_wanted(seed, rank):
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-6, 6, (2, 3, 1))
    half = rng.normal(size=(2, 6, rank)) * np.concatenate([size, size], axis=1)
    wanted = half @ half.swapaxes(1, 2)
    scale = np.sqrt(np.einsum("kii->ki", wanted))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(not_allowed_for(wanted, 0.0 * wanted) / scale, wanted / scale, atol=1e-6)
    assert np.max(np.abs(not_allowed_for(wanted, 1.001 * wanted) / scale)) <= 1e-9
    # Real and imaginary part of each value, allowed for in one direction of the plane only.
    angle = rng.uniform(0.0, np.pi)
    direction, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    allowed = np.zeros((2, 6, 6))
    blocks = [np.ix_([0, 1], [value, value + 3], [value, value + 3]) for value in range(3)]
    for both in blocks:
        allowed[both] = 1e3 * np.trace(wanted[both], axis1=1, axis2=2)[:, None, None] * np.outer(direction, direction)
    missing = not_allowed_for(wanted, allowed)
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
        seen = measured(clean, rng)
        result = fuse([turned(seen[0], axis, TURN_RAD), *seen[1:]])
        if any(notice.severity == "warning" for notice in result.notices):
            held.append(covered(result))
    # Of a 5 σ contradiction 7 in 10 or more are beyond the limit for all unknowns together.
    assert len(held) >= 42
    assert np.all(np.sum(held, axis=0) >= binom.ppf(0.001, len(held), 0.95))


def judged(make: Callable[[], list[Observation]], truth: np.ndarray, *, cautious: bool) -> list[np.ndarray]:
    """Hold the driven value to its contract; return errors along the true phasor and their U (200,)."""
    unit, errors, spread = truth[0, 2] / abs(truth[0, 2]), [], []

    def estimate(_: int) -> tuple[complex, np.ndarray]:
        result = fuse(make())
        value, covariance = result.phasors.value[0, 2], result.phasors.covariance[0][both_parts(2)]
        dof = min(float(result.uncertainty.dof()[0, 2]), 1e6)
        errors.append(((value - truth[0, 2]) / unit).real)
        along = np.array([unit.real, unit.imag])
        spread.append(t.ppf(0.975, dof) * np.sqrt(along @ covariance @ along))
        return value, covariance * region_factor(dof) ** 2 / chi2.ppf(0.95, 2)

    coverage_contract(estimate, truth[0, 2], 200, cautious=cautious)
    assert np.median(spread) / np.quantile(np.abs(errors), 0.95) < 1.2
    return [np.array(errors), np.array(spread)]


@pytest.mark.slow
def test_eight_lasers_with_unstated_scatter_are_unbiased_and_covered():
    rng = np.random.default_rng(11)
    clean = lasers(8, 2e-7, AXIAL, **BARE)

    def make() -> list[Observation]:
        (read,) = measured([clean], rng, AXIAL)
        return [with_values(read, read.phasors.value * (1 + 1e-3 * rng.normal(size=8)))]

    errors, spread = judged(make, AXIAL, cautious=True)
    assert abs(errors.mean()) / 189.0 < 1e-4
    low, high = acceptance(len(errors))
    assert low <= np.sum(np.abs(errors) <= spread) <= high


@pytest.mark.slow
def test_nothing_is_inflated_where_all_is_as_stated():
    rng, clean = np.random.default_rng(12), [camera(), lasers(8), triaxial()]
    judged(lambda: measured(clean, rng), TRUTH, cautious=False)
