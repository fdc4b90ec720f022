"""Ties of two clocks where jitter, filters, damage or locked sampling make them hard, against simulated instants."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.timebase.edges import Edges, find_edges
from shaker.timebase.tie import ClockTie, decide_shift, edge_instants, tie_clocks
from shaker.timebase.trigger import Posterior, fit_trigger, line_posterior, pulse_width

PERIOD_S = 1.0 / 52.874
EDGES = 80
RATE_HZ = 51_200.0
OTHER_HZ = 50_000.0
PPM = 17e-6
LATER_S = 0.03

Rise = Callable[[np.ndarray], np.ndarray]


def _ramp(x: np.ndarray) -> np.ndarray:
    """A linear rise over three samples."""
    return np.clip(x / 3.0 + 0.5, 0.0, 1.0)


def _charging(x: np.ndarray) -> np.ndarray:
    """An RC input, time constant two samples, half way at 0."""
    return 1.0 - np.exp(-np.maximum(x / 2.0 + np.log(2.0), 0.0))


def _half_band(x: np.ndarray) -> np.ndarray:
    """A delta-sigma converter's decimation filter: half amplitude at half the sampling rate."""
    place = np.arange(-24 * 64, 24 * 64 + 1) / 64.0
    taps = np.sinc(place) * np.kaiser(len(place), 8.0)
    return np.interp(x - 0.5 / 64.0, place, np.cumsum(taps) / taps.sum(), left=0.0, right=1.0)


def _latched(instants: np.ndarray, rate: float, length_s: float = 2.0) -> Edges:
    """Edges as an input without any rise gives them: the next sample is the first that is high."""
    upper = np.ceil(instants * rate) / rate
    return Edges(upper - 1.0 / rate, upper, upper - 0.5 / rate, "sampled", 0.0, length_s, 0.5)


def _filtered(rise: Rise, instants: np.ndarray, rate: float, noise: float, rng: np.random.Generator) -> Edges:
    """Edges found in pulses of 2 ms with that rise."""
    signal = noise * rng.normal(size=int((instants[-1] + 0.05) * rate))
    near = np.arange(-40, int(2e-3 * rate) + 40)
    for instant in instants:
        index = int(instant * rate) + near
        signal[index] += rise(index - instant * rate) - rise(index - (instant + 2e-3) * rate)
    return find_edges(signal, rate, threshold=0.5)


def _instants(rng: np.random.Generator, jitter_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Instants with jitter on the first clock, and the same on the second."""
    true = 0.1 + rng.uniform(0.0, PERIOD_S) + PERIOD_S * np.arange(EDGES) + jitter_s * rng.normal(size=EDGES)
    return true, (true - LATER_S) * (1.0 + PPM)


def _deviation(tie: ClockTie) -> tuple[float, float]:
    """Error in the middle of the common edges, and over its stated uncertainty."""
    there = np.array(tie.middle_s)
    error = float(tie.to_base_s(there)) - (tie.middle_s / (1.0 + PPM) + LATER_S)
    return error, error / float(tie.u_to_base_s(there))


def test_posterior_is_that_of_direct_integration() -> None:
    place, centre = np.array([-1.0, -0.3, 0.4, 1.0]), np.array([0.3, -0.2, 0.1, 0.35])
    lower, upper = centre - 0.5, centre + 0.5
    # Without jitter the posterior is uniform over the polygon of all lines that pass through every interval.
    m, h = np.meshgrid(np.linspace(-1, 1, 601), np.linspace(-1, 1, 601), indexing="ij")
    line = m[..., None] + h[..., None] * place
    inside = np.all((line > lower) & (line <= upper), axis=-1)
    corner = np.stack([m[inside], h[inside]])
    start = Posterior(np.zeros(2), 0.3 * np.eye(2), 1e-4)
    found = line_posterior(place, lower[None], upper[None], start, 1e-4)
    scale = np.sqrt(np.diag(np.cov(corner)))
    # The jitter is unknown, so that the posterior may be a little wider.
    np.testing.assert_allclose(found.mean, corner.mean(axis=1), atol=0.25 * scale.min())
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), scale, rtol=0.35)


@pytest.mark.parametrize("rise", [_ramp, _charging, _half_band])
def test_observed_rise_is_followed(rise: Rise) -> None:
    rng = np.random.default_rng(21)
    first, second = _instants(rng)
    base = fit_trigger(_filtered(rise, first, RATE_HZ, 1e-3, rng))
    other = fit_trigger(_filtered(rise, second, OTHER_HZ, 1e-3, rng))
    assert base.kind == other.kind == "resolved"
    assert abs(base.time_s(np.array(40)) - first[40]) < 0.15e-6  # a sample is 19.5 us
    error, normalised = _deviation(tie_clocks(base, other))
    assert abs(error) < 0.15e-6
    assert abs(normalised) < 4.0


def test_common_jitter_cancels_between_intervals() -> None:
    rng = np.random.default_rng(22)
    errors, normalised = [], []
    for _ in range(3):
        first, second = _instants(rng, jitter_s=100e-6)
        tie = tie_clocks(fit_trigger(_latched(first, RATE_HZ)), fit_trigger(_latched(second, OTHER_HZ)))
        error, ratio = _deviation(tie)
        errors.append(error)
        normalised.append(ratio)
    # Two models one by one would err by 100 us·sqrt(2 / 80) = 16 us; two roundings by 5.7 us·sqrt(2 / 80) = 0.9 us.
    assert np.sqrt(np.mean(np.square(errors))) < 1.3e-6
    assert np.max(np.abs(normalised)) < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("jitter_s", [2e-6, 20e-6])
def test_stated_uncertainty_is_calibrated_under_jitter(jitter_s: float) -> None:
    rng = np.random.default_rng(23)
    normalised = []
    for _ in range(40):
        first, second = _instants(rng, jitter_s)
        tie = tie_clocks(fit_trigger(_latched(first, RATE_HZ)), fit_trigger(_latched(second, OTHER_HZ)))
        normalised.append(_deviation(tie)[1])
    # 40 draws: the standard deviation scatters by 11 %.
    assert 0.65 < np.sqrt(np.mean(np.square(normalised))) < 1.4


def test_resolved_edges_stand_for_the_period_of_the_others() -> None:
    rng = np.random.default_rng(24)
    first, second = _instants(rng, jitter_s=20e-6)
    base = fit_trigger(_latched(first, RATE_HZ))
    other = fit_trigger(_filtered(_half_band, second, OTHER_HZ, 1e-3, rng))
    assert (base.kind, other.kind) == ("sampled", "resolved")
    tie = tie_clocks(base, other)
    error, normalised = _deviation(tie)
    assert abs(error) < 0.6e-6
    assert abs(normalised) < 3.5
    assert tie.pairs == EDGES
    assert tie.decided_by == "burst start and end"


def test_locked_sampling_is_covered_and_told() -> None:
    period = 968.0 / RATE_HZ
    for place in (0.02, 0.5, 0.97):
        instants = (5000.0 + place) / RATE_HZ + period * np.arange(EDGES)
        fit = fit_trigger(_latched(instants, RATE_HZ))
        deviation = float(fit.time_s(np.array(40))) - instants[40]
        assert abs(deviation) < 2.0 * float(fit.u_time_s(np.array(40)))
        assert float(fit.u_time_s(np.array(40))) > 5e-6
        assert any("same places between two samples" in notice.text for notice in fit.notices)


def test_jitter_decides_what_nothing_else_does() -> None:
    rng = np.random.default_rng(26)
    first, _ = _instants(rng, jitter_s=30e-6)
    base = fit_trigger(_latched((first - first[0] + 0.5 * PERIOD_S)[:70], RATE_HZ, 69.6 * PERIOD_S))
    later = first - first[9] + 0.4 * PERIOD_S
    other = fit_trigger(_latched(later[9:79], OTHER_HZ, 69.7 * PERIOD_S))
    assert not any((base.idle_before, base.idle_after, other.idle_before, other.idle_after))
    assert decide_shift(base, other).edges == 9
    assert decide_shift(base, other).decided_by == "jitter"
    assert decide_shift(other, base).edges == -9


def test_contradicting_ends_are_refused_by_name() -> None:
    first, second = _instants(np.random.default_rng(27))
    base = fit_trigger(_latched(first, RATE_HZ))
    other = fit_trigger(_latched(second[2:], OTHER_HZ))  # two edges lost at its start, though it was recording
    with pytest.raises(
        ValueError, match=r"shift: .*80 and 78 edges whose ends of the burst say 2 and 0; give first_edge"
    ):
        tie_clocks(base, other)
    tie = tie_clocks(base, other, start_difference_s=LATER_S)
    assert (tie.shift, tie.decided_by) == (2, "start times")
    assert not tie.notices
    told = tie_clocks(base, other, shift=0, start_difference_s=LATER_S).notices
    assert "start times put edge 0 at edge 2 of the first clock, first_edge at 0" in told[0].text


def test_single_gaps_that_coincide_by_chance_decide_nothing() -> None:
    first, _ = _instants(np.random.default_rng(28))
    place = first - first[0] + 0.5 * PERIOD_S
    base = fit_trigger(_latched(np.delete(place[:70], [20, 41, 60]), RATE_HZ, 69.6 * PERIOD_S))
    other = fit_trigger(_latched(np.delete(place[:70], [9, 15, 33]), OTHER_HZ, 69.6 * PERIOD_S))
    with pytest.raises(ValueError, match="whole-period shifts"):
        decide_shift(base, other)


def _jump(x: np.ndarray) -> np.ndarray:
    """A latched input."""
    return np.where(x >= 0.0, 1.0, 0.0)


def _brick_wall(x: np.ndarray) -> np.ndarray:
    """An ideal low-pass at half the sampling rate, which rings for hundreds of samples."""
    place = np.arange(-400 * 16, 400 * 16 + 1) / 16.0
    taps = np.sinc(place)
    return np.interp(x - 0.5 / 16.0, place, np.cumsum(taps) / taps.sum(), left=0.0, right=1.0)


def _pulses(rise: Rise, first: np.ndarray, width: float, rng: np.random.Generator) -> np.ndarray:
    """Pulses of a width in s with that rise on a little noise."""
    signal = 1e-3 * rng.normal(size=int((first[-1] + 0.05) * RATE_HZ))
    near = np.arange(-60, int(width * RATE_HZ) + 60)
    for instant in first:
        index = int(instant * RATE_HZ) + near
        signal[index] += rise(index - instant * RATE_HZ) - rise(index - (instant + width) * RATE_HZ)
    return signal


@pytest.mark.parametrize(
    ("rise", "samples"),
    [
        (_jump, (1.7, 2.3, 6.3)),
        (_half_band, (5.3, 8.2, 12.3)),
        (_brick_wall, (5.3, 24.3, 51.0)),
        (_ramp, (16.6, 51.0)),  # 51 of 968 samples: the 95 % quantile lies on the rise
        (_charging, (24.3,)),
    ],
)
def test_short_pulses_are_as_uncertain_as_stated(rise: Rise, samples: tuple[float, ...]) -> None:
    rng = np.random.default_rng(32)
    for long in samples:
        found = pulse_width(_pulses(rise, _instants(rng)[0], long / RATE_HZ, rng), RATE_HZ)
        assert abs(found.width_s * RATE_HZ - long) < 2.5 * found.u_width_s * RATE_HZ
        assert found.u_width_s * RATE_HZ < max(0.02, 0.3 / long)


@pytest.mark.parametrize(("rise", "samples"), [(_jump, 0.8), (_half_band, 2.0), (_ramp, 4.4), (_charging, 8.2)])
def test_pulses_that_do_not_settle_are_refused(rise: Rise, samples: float) -> None:
    rng = np.random.default_rng(33)
    signal = _pulses(rise, _instants(rng)[0], samples / RATE_HZ, rng)
    with pytest.raises(ValueError, match=r"samples: expected pulses of at least [\d.]+ samples, .* found some of"):
        pulse_width(signal, RATE_HZ)


@pytest.mark.parametrize("rise", [_jump, _half_band])
def test_pulse_width(rise: Rise) -> None:
    rng = np.random.default_rng(29)
    first, _ = _instants(rng)
    width = 2e-3
    signal = _pulses(rise, first, width, rng)
    found = pulse_width(signal, RATE_HZ)
    assert found.pulses == EDGES
    assert found.width_s == pytest.approx(width, abs=0.5e-6)
    assert abs(found.width_s - width) < 4.0 * found.u_width_s
    # The pauses of the inverted signal are the same pulses.
    assert pulse_width(-signal, RATE_HZ, edge="falling").width_s == pytest.approx(found.width_s, abs=1e-9)
    pause = pulse_width(signal, RATE_HZ, edge="falling")
    assert pause.width_s == pytest.approx(PERIOD_S - width, abs=1e-6)


def test_instants_follow_edges_that_jitter() -> None:
    rng = np.random.default_rng(30)
    first, second = _instants(rng, jitter_s=20e-6)
    base = fit_trigger(_latched(first, RATE_HZ))
    other = fit_trigger(_filtered(_half_band, second, OTHER_HZ, 1e-3, rng))
    number = np.arange(EDGES)
    model = base.time_s(number) - first
    alone = edge_instants(base, number)
    both = edge_instants(base, number, [(other, tie_clocks(base, other))])
    assert np.std(model) > 15e-6
    assert np.std(alone.time_s - first) < 6.5e-6  # 19.5 us / sqrt(12) = 5.6 us
    assert np.std(both.time_s - first) < 0.3e-6
    assert 0.7 < np.std((alone.time_s - first) / alone.u_time_s) < 1.4
    assert np.max(np.abs(both.time_s - first) / both.u_time_s) < 4.0
    assert np.all(both.u_time_s < 1e-6)


def test_instants_follow_the_model_without_jitter() -> None:
    first, _ = _instants(np.random.default_rng(31))
    fit = fit_trigger(_latched(first, RATE_HZ))
    found = edge_instants(fit, np.arange(EDGES))
    np.testing.assert_allclose(found.time_s, fit.time_s(np.arange(EDGES)), atol=0.2e-6)


@settings(max_examples=10, deadline=None)
@given(st.floats(-100.0, 100.0).filter(lambda x: abs(x) > 1e-3), st.floats(-50.0, 50.0), st.integers(0, 1000))
def test_edges_do_not_depend_on_scale_level_and_sign(scale: float, level: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    instants = 0.01 + 0.004 * np.arange(6) + rng.uniform(0.0, 1e-4)
    signal = np.zeros(800)
    for instant in instants:
        near = np.arange(800) - instant * 2e4
        signal += _ramp(near) - _ramp(near - 30.0)
    plain = find_edges(signal, 2e4)
    other = find_edges(level + scale * signal, 2e4, edge="rising" if scale > 0.0 else "falling")
    np.testing.assert_allclose(other.estimate_s, plain.estimate_s, atol=1e-9)
    np.testing.assert_array_equal(other.upper_s, plain.upper_s)


@settings(max_examples=3, deadline=None)
@given(st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_later_records_move_the_offset_alone(base_lag_s: float, other_lag_s: float) -> None:
    first, second = _instants(np.random.default_rng(32))
    base, other = fit_trigger(_latched(first, RATE_HZ)), fit_trigger(_latched(second, OTHER_HZ))
    tie, moved = tie_clocks(base, other), tie_clocks(base.later_by(base_lag_s), other.later_by(other_lag_s))
    there = tie.middle_s
    u = float(tie.u_to_base_s(np.array(there)))
    deviation = moved.to_base_s(np.array(there + other_lag_s)) - base_lag_s - tie.to_base_s(np.array(there))
    assert abs(float(deviation)) < 0.1 * u
    assert float(moved.u_to_base_s(np.array(there + other_lag_s))) == pytest.approx(u, rel=0.1)
