"""Fusion against dense generalised least squares, refits, Monte Carlo coverage and the traps of common errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from fusion.estimation.fuse import fuse, fuse_sources
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.measurement_model import ChainUncertainty, Observation, Reading, observe_channels, observe_stereo
from shaker.sine.phasor import Phasors

FREQUENCY = np.array([106.25, 212.5])
TRUTH = np.array(
    [[0.5, -0.3j, 189.0, 4.0j, -3.0, 1.0], [0.01, 0.02, 0.9 - 0.2j, 0.1, 0.05j, 0.02]], dtype=np.complex128
)
CIRCLE = [(0.04 * np.cos(a), 0.04 * np.sin(a), 0.03) for a in 2 * np.pi * np.arange(8) / 8]


def phasors(value: np.ndarray, sigma: np.ndarray | float, unit: str) -> Phasors:
    lines, count = value.shape
    sd = np.broadcast_to(sigma, (lines, count))
    covariance = np.tile(sd, (1, 2))[:, :, None] ** 2 * np.eye(2 * count)
    names = tuple(f"c{i}" for i in range(count))
    return Phasors(FREQUENCY[:lines], value.astype(complex), covariance, names, (unit,) * count, np.full(lines, 200.0))


def channel(**changes: Any) -> Any:
    base = {
        "name": "v", "quantity": "velocity", "body": "load", "point": (0.0, 0.0, 0.0), "point_uncertainty": (0.0,) * 3,
        "direction": (0.0, 0.0, 1.0), "direction_uncertainty": 0.0, "scale_uncertainty": 0.0, "common": "laser",
        "individual_uncertainty": 0.0, "transverse_sensitivity": 0.0, "delay_uncertainty": 0.0, "channel": None,
    }  # fmt: skip
    return SimpleNamespace(**(base | changes))


def with_values(observation: Observation, value: np.ndarray) -> Observation:
    return replace(observation, phasors=replace(observation.phasors, value=value))


def lasers(points: Sequence[tuple[float, ...]], sigma: float, truth: np.ndarray = TRUTH, **stated: Any) -> Observation:
    """Lasers in z without any error; `sigma` is relative to the driven velocity of each line."""
    lines = len(truth)
    size = np.abs(truth[:, 2:3]) / (2 * np.pi * FREQUENCY[:lines, None])
    blank = phasors(np.zeros((lines, 1)), sigma * size, "m/s")
    items = [Reading(channel(name=f"p{i}", point=p, **stated), blank, ChainUncertainty()) for i, p in enumerate(points)]
    (observation,) = observe_channels(items)
    return with_values(observation, np.einsum("kmj,kj->km", observation.design, truth))


def camera(sigma_m: float = 1e-9, truth: np.ndarray = TRUTH, **stated: Any) -> Observation:
    base = {"body": "load", "scale_uncertainty": 0.0, "pose_uncertainty": (0.0,) * 6, "delay_uncertainty": 0.0}
    omega2 = (2 * np.pi * FREQUENCY[: len(truth), None]) ** 2
    sd = sigma_m * np.array([1, 1, 3, 30, 30, 10.0])
    return observe_stereo("top", SimpleNamespace(**(base | stated)), phasors(-truth / omega2, sd, "m"))


def noisy(observation: Observation, rng: np.random.Generator, common: bool = True) -> Observation:
    """Draw the common errors of an observation, bilinear in the truth, and its noise."""
    value = observation.phasors.value.copy()
    for error in observation.common if common else ():
        value += rng.normal() * error.effect(TRUTH[: len(value)])
    sd = np.sqrt(observation.phasors.covariance.diagonal(axis1=1, axis2=2))[:, : value.shape[1]]
    return with_values(observation, value + sd * (rng.normal(size=value.shape) + 1j * rng.normal(size=value.shape)))


CAMERA = {"scale_uncertainty": 2e-4, "pose_uncertainty": (1e-4,) * 3 + (5e-4,) * 3, "delay_uncertainty": 1e-6}
LASER = {
    "scale_uncertainty": 2.5e-4, "delay_uncertainty": 5e-7, "individual_uncertainty": 1e-4,
    "point_uncertainty": (1e-3,) * 3, "direction_uncertainty": 5e-3,
}  # fmt: skip


def test_without_errors_the_truth_comes_back() -> None:
    result = fuse([camera(**CAMERA), lasers(CIRCLE, 1e-6, **LASER)])
    np.testing.assert_allclose(result.phasors.value, TRUTH, rtol=1e-9, atol=1e-9)
    assert result.chi2 < 1e-9
    assert result.observed.all()
    total = np.sum([c.covariance for c in result.contributions], axis=0)
    np.testing.assert_allclose(total, result.phasors.covariance)
    assert result.dof == 2 * (2 * 14 - 12)


def test_equals_generalised_least_squares_with_the_common_errors_in_the_covariance() -> None:
    rng = np.random.default_rng(1)
    system = build_system([noisy(camera(**CAMERA), rng), noisy(lasers(CIRCLE, 1e-4, **LASER), rng)])
    solution = solve(system)
    spread = system.noise + solution.effects @ solution.effects.T
    weight = np.linalg.inv(spread)
    design = system.design
    covariance = np.linalg.inv(design.T @ weight @ design)
    estimate = covariance @ design.T @ weight @ system.readings
    np.testing.assert_allclose(solution.acceleration, system.acceleration(estimate), rtol=1e-7, atol=1e-7)
    residual = system.readings - design @ estimate
    assert solution.chi2 == pytest.approx(residual @ weight @ residual, rel=1e-6)
    expected = system.expand @ covariance @ system.expand.T
    np.testing.assert_allclose(solution.gain @ spread @ solution.gain.T, expected, rtol=1e-5, atol=1e-12)


def test_leave_one_out_equals_a_fit_without_the_instrument() -> None:
    rng = np.random.default_rng(2)
    stated = {"individual_uncertainty": 1e-3, "scale_uncertainty": 1e-3}
    every = noisy(lasers(CIRCLE, 1e-3, TRUTH[:1], **stated), rng)
    result = fuse([every])
    less = replace(
        every,
        phasors=replace(every.phasors, value=np.where(np.arange(8) > 0, every.phasors.value, np.nan)),
    )
    others = fuse([less])
    system = build_system([less])
    solution = solve(system)
    row = build_system([every])
    first = row.member == 0
    predicted = row.design[first] @ np.linalg.lstsq(row.expand, np.concatenate(
        [solution.acceleration[0].real, solution.acceleration[0].imag]), rcond=None)[0]  # fmt: skip
    effects = row.effects(solution.acceleration)
    gain = row.design[first] @ np.linalg.pinv(row.expand) @ solution.gain
    # Every error acts on both sides of the difference: reading 0 and its prediction from the rest.
    through = effects[first] - gain @ effects[~first]
    spread = row.noise[np.ix_(first, first)] + gain @ solution.noise @ gain.T + through @ through.T
    difference = row.readings[first] - predicted
    expected = np.sqrt(difference @ np.linalg.solve(spread, difference) / 2)
    assert others.dof == result.dof - 2
    assert result.consistency[0].normalised_deviation == pytest.approx(expected, rel=1e-3)


def test_peelles_puzzle_is_no_trap() -> None:
    # Eight lasers, noise 2e-7, common scale 2.5e-4, scatter 1e-3 that nobody stated: a covariance built from the
    # readings gives a mean tens of per cent low.
    rng = np.random.default_rng(3)
    truth = np.array([[0, 0, 189.0, 0, 0, 0]], dtype=complex)
    errors = []
    for _ in range(20):
        clean = lasers(CIRCLE, 2e-7, truth, scale_uncertainty=2.5e-4)
        scatter = 1e-3 * rng.normal(size=8)
        result = fuse([with_values(clean, clean.phasors.value * (1 + scatter))])
        value = result.phasors.value[0, 2] / 189.0
        assert value == pytest.approx(1 + scatter.mean(), abs=2e-5)
        assert result.phasors.u_re[0, 2] / 189.0 == pytest.approx(np.hypot(2.5e-4, 1e-3 / np.sqrt(8)), rel=0.6)
        errors.append(value - 1)
    assert abs(np.mean(errors)) < 3 * 1e-3 / np.sqrt(8 * 20)


@pytest.mark.parametrize("laser", [0, 5])
def test_one_laser_three_per_cent_off_is_named_and_covered(laser: int) -> None:
    rng = np.random.default_rng(4)
    array = noisy(lasers(CIRCLE, 1e-5, **LASER), rng)
    gain = np.where(np.arange(8) == laser, 1.03, 1.0)
    result = fuse([with_values(array, array.phasors.value * gain)])
    worst = max(result.consistency, key=lambda test: test.normalised_deviation)
    assert worst.instrument == f"p{laser}"
    assert abs(worst.ratio) == pytest.approx(1.03, abs=2e-3)
    warning = next(notice for notice in result.notices if notice.severity == "warning")
    assert f"p{laser} lies" in warning.text
    u = np.hypot(result.phasors.u_re[0, 2], result.phasors.u_im[0, 2])
    assert abs(result.phasors.value[0, 2] - TRUTH[0, 2]) < 2 * u
    assert "without it all others agree" in warning.text
    assert f"individual scale p{laser} would have to be 0.03 " in warning.text
    assert [test.instrument for test in result.consistency if test.suspect] == [f"p{laser}"]
    assert any(entry.label == "laser: unexplained scatter" for entry in result.contributions)


def test_an_artefact_at_a_harmonic_leaves_the_fundamental_alone() -> None:
    rng = np.random.default_rng(8)
    false = noisy(camera(**CAMERA), rng)
    value = false.phasors.value.copy()
    value[1, 2] *= 30.0
    seen = [with_values(false, value), noisy(lasers(CIRCLE, 1e-5, **LASER), rng)]
    result = fuse(seen)
    error = np.abs(result.phasors.value[:, 2] - TRUTH[:, 2])
    u = np.hypot(result.phasors.u_re, result.phasors.u_im)[:, 2]
    assert u[0] < 5e-4 * 189.0
    assert error[0] < 3 * u[0]
    assert u[1] > 0.5 * abs(TRUTH[1, 2])
    assert error[1] < 3 * u[1]
    warning = next(notice for notice in result.notices if notice.severity == "warning")
    assert "stereo top lies" in warning.text
    assert "laser as a whole lies" in warning.text


def test_errors_of_one_instrument_are_known_from_all_lines() -> None:
    # A laser's delay of 2.5 standard uncertainties shows against an exact camera at both lines and is taken off.
    exact = camera(1e-13, scale_uncertainty=1e-9)
    late = lasers([(0.0, 0.0, 0.04)], 5e-6, delay_uncertainty=5e-7)
    late = with_values(late, late.phasors.value * np.exp(-2j * np.pi * FREQUENCY[:, None] * 1.25e-6))
    result = fuse([exact, late])
    delay = next(unknown for unknown in result.unknowns if unknown.name == "laser: delay")
    assert delay.estimate == pytest.approx(2.5, rel=1e-2)
    assert (delay.u, delay.unit) == (5e-7, "s")
    assert delay.remaining < 0.1


def test_regions_cover_and_tests_pass_as_often_as_they_claim() -> None:
    rng = np.random.default_rng(5)
    inside, failed, trials = np.zeros(6), 0, 300
    clean = [camera(**CAMERA), lasers(CIRCLE[:3], 1e-5, **LASER)]
    for _ in range(trials):
        result = fuse([noisy(observation, rng) for observation in clean])
        failed += any(notice.severity == "warning" for notice in result.notices)
        error = result.phasors.value[0] - TRUTH[0]
        for component in range(6):
            pair = [component, component + 6]
            spread = result.phasors.covariance[0][np.ix_(pair, pair)]
            stacked = np.array([error[component].real, error[component].imag])
            inside[component] += stacked @ np.linalg.solve(spread, stacked) < chi2.ppf(0.95, 2)
    # 300 trials: 95 % give 285 ± 3.8; four standard deviations.
    assert np.all(np.abs(inside - 0.95 * trials) < 16), inside
    assert failed <= 12


def test_transverse_motion_that_nobody_sees_is_in_the_uncertainty() -> None:
    # Eight lasers in z that point up to 5 mrad aside, on a body that also moves 0.3 % sideways.
    rng = np.random.default_rng(9)
    clean = lasers(CIRCLE, 1e-6, **LASER)
    for _ in range(40):
        result = fuse([noisy(clean, rng)])
        assert not any(notice.severity == "warning" for notice in result.notices)
    hidden = next(entry for entry in result.contributions if entry.label == "unobserved motion")
    # 2 % of z in x and in y, each half real and half imaginary, times 5 mrad, over eight lasers.
    assert np.sqrt(hidden.covariance[0, 2, 2]) == pytest.approx(0.02 * 189.0 * 5e-3 / np.sqrt(8), rel=0.05)


def test_fused_is_no_worse_than_the_best_instrument() -> None:
    rng = np.random.default_rng(6)
    sources = fuse_sources([noisy(camera(**CAMERA), rng), noisy(lasers(CIRCLE, 1e-5, **LASER), rng)], "load")
    assert [found.source for found in sources] == ["fused", "photogrammetry", "vibrometer"]
    fused, optical, laser = (found.phasors.u_re[0, 2] for found in sources)
    assert fused <= min(optical, laser) * (1 + 1e-6)
    np.testing.assert_array_equal(sources[2].observed[0], [False, False, True, True, True, False])
    assert np.isnan(sources[2].phasors.value[0, 0])
    assert "x, y, rz" in sources[2].notices[0].text


@pytest.mark.parametrize(
    ("points", "observed"),
    [
        ([(0.0, 0.0, 0.04)], "z"),
        ([(0.03, 0.0, 0.04)], ""),
        ([(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0)], "z ry"),
        ([(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.0, 0.03, 0.0)], "z rx ry"),
    ],
)
def test_only_what_the_geometry_determines_is_given(points: list[tuple[float, ...]], observed: str) -> None:
    result = fuse([lasers(points, 1e-5, scale_uncertainty=1e-3)])
    names = [name for name, seen in zip(result.phasors.channels, result.observed[0], strict=True) if seen]
    assert " ".join(names) == observed
    np.testing.assert_allclose(result.phasors.value[0, result.observed[0]], TRUTH[0, result.observed[0]], rtol=1e-9)


def test_lines_that_a_camera_cannot_use_are_left_to_the_others() -> None:
    dropped = camera(**CAMERA)
    value = dropped.phasors.value.copy()
    value[1] = np.nan
    covariance = dropped.phasors.covariance.copy()
    covariance[1] = np.nan
    dropped = replace(dropped, phasors=replace(dropped.phasors, value=value, covariance=covariance))
    result = fuse([dropped, lasers(CIRCLE, 1e-6, **LASER)])
    assert result.observed.tolist() == [[True] * 6, [False, False, True, True, True, False]]
    assert np.isfinite(result.phasors.covariance[0]).all()
    nothing = fuse([dropped])
    assert not nothing.observed[1].any()


def test_an_instrument_without_stated_uncertainty_is_compared_not_fused() -> None:
    silent = lasers([(0.0, 0.0, 0.04)], 1e-7)
    biased = with_values(silent, silent.phasors.value * 1.01)
    result = fuse([camera(**CAMERA), biased])
    assert result.instruments == ("stereo top",)
    np.testing.assert_allclose(result.phasors.value, TRUTH, rtol=1e-9, atol=1e-9)
    test = next(test for test in result.consistency if not test.used)
    assert abs(test.ratio) == pytest.approx(1.01, rel=1e-6)
    assert test.normalised_deviation > 10
    alone = fuse([biased])
    assert any("noise only" in notice.text for notice in alone.notices)


def test_channels_whose_noise_is_one_and_the_same_are_no_obstacle() -> None:
    array = lasers(CIRCLE, 1e-5, **LASER)
    size = array.phasors.covariance[:, :1, :1]
    one = np.kron(np.eye(2), np.ones((8, 8)))
    result = fuse([replace(array, phasors=replace(array.phasors, covariance=size * one))])
    np.testing.assert_allclose(result.phasors.value[0, 2], TRUTH[0, 2], rtol=1e-9)


def test_effects_of_another_shape_are_refused() -> None:
    entry = SimpleNamespace(body="load", scale_uncertainty=None, pose_uncertainty=(0.0,) * 6, delay_uncertainty=0.0)
    with pytest.raises(ValueError, match=r"offset of stereo top: calibration 0: expected an array of shape \(2, 6\)"):
        observe_stereo("top", entry, camera().phasors, {"calibration": np.zeros((3, 1, 6), complex)})


def test_no_instrument_of_the_body_is_refused() -> None:
    with pytest.raises(ValueError, match="body base"):
        fuse([camera(**CAMERA)], "base")
