"""Trigger edges, the periodic model and clock ties against simulated instants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shaker.timebase.edges import Edges, find_edges
from shaker.timebase.tie import tie_clocks
from shaker.timebase.trigger import TriggerFit, fit_trigger

PERIOD_S = 1.0 / 52.874
EDGES = 211


def _pulses(
    instants: np.ndarray, rate: float, length_s: float, width_s: float = 5e-3, noise: float = 0.0
) -> np.ndarray:
    """Rectangular pulses as a multiplexed or latched input sees them: no sample on the rise."""
    signal = np.zeros(int(length_s * rate))
    for instant in instants:
        signal[max(0, int(np.ceil(instant * rate))) : max(0, int(np.ceil((instant + width_s) * rate)))] = 5.0
    return signal + noise * np.random.default_rng(0).normal(size=len(signal))


def _band_limited(instants: np.ndarray, rate: float, length_s: float, width_s: float = 5e-3) -> np.ndarray:
    """The same pulses through an ideal low-pass at 0.45 of the rate: the integral of sinc, from its closed form."""
    from scipy.special import sici

    time = np.arange(int(length_s * rate)) / rate
    signal = np.zeros(len(time))
    cutoff = 2.0 * np.pi * 0.45 * rate
    for instant in instants:
        signal += (sici(cutoff * (time - instant))[0] - sici(cutoff * (time - instant - width_s))[0]) / np.pi
    return 5.0 * signal


def _latched(instants: np.ndarray, rate: float, length_s: float) -> Edges:
    """Edges of the same pulses without the samples: the first sample after each instant is the first that is high."""
    upper = np.ceil(instants * rate) / rate
    return Edges(upper - 1.0 / rate, upper, upper - 0.5 / rate, "sampled", 0.0, length_s, 2.5)


def _two_clocks(rng: np.random.Generator, jitter_s: float = 0.0) -> tuple[TriggerFit, TriggerFit, float, float, float]:
    """Return fits of both DAQs, the true rate, and the middle edge on the other and on the base clock."""
    ppm = 17e-6
    first, begin = 0.1 + rng.uniform(0.0, PERIOD_S), rng.uniform(0.0, 0.05)
    instants = first + PERIOD_S * np.arange(EDGES) + jitter_s * rng.normal(size=EDGES)
    base = fit_trigger(_latched(instants, 51_200.0, 4.3))
    other = fit_trigger(_latched((instants - begin) * (1.0 + ppm), 50_000.0, 4.2))
    middle = first + PERIOD_S * (EDGES // 2)
    return base, other, 1.0 / (1.0 + ppm), (middle - begin) * (1.0 + ppm), middle


def test_edge_lies_between_the_samples_that_see_it() -> None:
    rng = np.random.default_rng(1)
    instants = 0.05 + PERIOD_S * np.arange(20) + rng.uniform(0.0, 1e-3)
    edges = find_edges(_pulses(instants, 51_200.0, 0.5, noise=0.05), 51_200.0)
    assert edges.kind == "sampled"
    assert len(edges.lower_s) == 20
    assert np.all(edges.lower_s < instants)
    assert np.all(instants <= edges.upper_s)
    np.testing.assert_allclose(edges.upper_s - edges.lower_s, 1.0 / 51_200.0)
    ends = find_edges(_pulses(instants, 51_200.0, 0.5), 51_200.0, edge="falling")
    assert np.all((ends.lower_s < instants + 5e-3) & (instants + 5e-3 <= ends.upper_s + 1e-12))


@pytest.mark.parametrize("width_s", [2e-4, 5e-3, 1.8e-2])
def test_default_threshold_copes_with_any_duty(width_s: float) -> None:
    # 1 %, 26 % and 95 % of the period; the 5 % and 95 % quantiles coincide for the first and the last.
    instants = 0.05 + PERIOD_S * np.arange(20)
    edges = find_edges(_pulses(instants, 51_200.0, 0.45, width_s, noise=0.02), 51_200.0)
    assert len(edges.lower_s) == 20
    assert edges.threshold == pytest.approx(2.5, abs=0.2)


def test_noise_at_the_threshold_counts_once() -> None:
    rng = np.random.default_rng(2)
    ramp = np.clip(np.sin(2 * np.pi * 10.0 * np.arange(20_000) / 20_000.0) * 3.0, -1.0, 1.0)
    edges = find_edges(ramp + 0.03 * rng.normal(size=len(ramp)), 20_000.0)
    assert len(edges.estimate_s) == 9  # the one at the very start has no low sample before it


def test_threshold_out_of_reach_is_refused() -> None:
    with pytest.raises(ValueError, match="threshold: expected a level that the signal crosses, found 7"):
        find_edges(_pulses(np.array([0.1, 0.2]), 1e4, 0.3), 1e4, threshold=7.0)
    with pytest.raises(ValueError, match="samples: expected numbers, found 1 NaN"):
        find_edges(np.array([0.0, np.nan, 1.0]), 1e4)


def test_band_limited_edges_have_no_bias() -> None:
    rng = np.random.default_rng(3)
    deviations = []
    for _ in range(2):
        first = 0.05 + rng.uniform(0.0, 1e-3)
        instants = first + PERIOD_S * np.arange(60)
        edges = find_edges(_band_limited(instants, 51_200.0, 1.3), 51_200.0)
        assert edges.kind == "resolved"
        fit = fit_trigger(edges)
        deviations.append(fit.time_s(np.array(30)) - instants[30])
    # A sample is 19.5 us; half of it is the bias of the naive reading.
    assert np.max(np.abs(deviations)) < 0.1e-6


def test_start_period_and_numbers_are_found() -> None:
    rng = np.random.default_rng(4)
    first = 0.1 + rng.uniform(0.0, PERIOD_S)
    fit = fit_trigger(find_edges(_pulses(first + PERIOD_S * np.arange(EDGES), 51_200.0, 4.3), 51_200.0))
    assert fit.edges == EDGES
    assert fit.start_s == pytest.approx(first, abs=1e-6)
    assert fit.period_s == pytest.approx(PERIOD_S, abs=5e-9)
    assert fit.idle_before
    assert fit.idle_after
    assert not fit.missing
    assert not fit.spurious
    assert fit.jitter_s < 1e-6
    assert not fit.notices


def test_missing_doubled_and_stray_edges_are_survived() -> None:
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(5):
        instants = 0.1 + rng.uniform(0.0, PERIOD_S) + PERIOD_S * np.arange(EDGES)
        keep = rng.uniform(size=EDGES) > 0.1
        keep[[0, -1]] = True
        doubled = instants[rng.uniform(size=EDGES) < 0.05] + 0.5e-3
        stray = rng.uniform(instants[0], instants[-1], 10)
        all_edges = np.sort(np.concatenate([instants[keep], doubled, stray]))
        fit = fit_trigger(find_edges(_pulses(all_edges, 51_200.0, 4.3, 2e-4), 51_200.0))
        assert fit.edges == EDGES
        assert set(fit.missing) == set(np.flatnonzero(~keep))
        assert fit.spurious > 0
        assert any("missing" in n.text for n in fit.notices)
        assert fit.doubled == 0 or any(n.text == f"{fit.doubled} doubled edges were dropped" for n in fit.notices)
        errors.append(fit.time_s(np.array(105)) - instants[105])
    assert np.sqrt(np.mean(np.square(errors))) < 0.2e-6


def test_jitter_is_measured() -> None:
    rng = np.random.default_rng(6)
    for jitter in (2e-6, 100e-6):
        found = []
        for _ in range(6):
            instants = 0.1 + PERIOD_S * np.arange(EDGES) + jitter * rng.normal(size=EDGES)
            found.append(fit_trigger(_latched(instants, 51_200.0, 4.3)).jitter_s)
        assert np.mean(found) == pytest.approx(jitter, rel=0.3)


@pytest.mark.parametrize(
    ("seed", "cases", "bias", "scatter"),
    [(7, 5, 0.06e-6, 0.13e-6), pytest.param(17, 30, 0.038e-6, 0.125e-6, marks=pytest.mark.slow)],
)
def test_clock_offset_and_rate_without_jitter(seed: int, cases: int, bias: float, scatter: float) -> None:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(cases):
        base, other, true_rate, there, here = _two_clocks(rng)
        tie = tie_clocks(base, other)
        error = float(tie.to_base_s(np.array(there))) - here
        found.append((error, tie.rate - true_rate, error / float(tie.u_to_base_s(np.array(there)))))
        assert tie.shift == 0
    offset, rate, normalised = np.array(found).T
    assert np.sqrt(np.mean(offset**2)) < 0.10e-6
    assert abs(np.mean(offset)) < bias
    assert np.sqrt(np.mean(rate**2)) < scatter
    assert np.max(np.abs(normalised)) < 4.0


def test_roles_of_the_clocks_can_be_exchanged() -> None:
    base, other, _, there, _ = _two_clocks(np.random.default_rng(8))
    forward, backward = tie_clocks(base, other), tie_clocks(other, base)
    assert forward.rate * backward.rate == pytest.approx(1.0, abs=1e-12)
    back = backward.to_base_s(forward.to_base_s(np.array(there)))
    assert float(back) == pytest.approx(there, abs=1e-11)
    u = float(forward.u_to_base_s(np.array(there)))
    assert float(backward.u_to_base_s(forward.to_base_s(np.array(there)))) == pytest.approx(u, rel=1e-3)


def _fit(first: float, edges: int, *, before: bool, after: bool, missing: tuple[int, ...] = ()) -> TriggerFit:
    number = np.setdiff1d(np.arange(edges), missing)
    return TriggerFit(
        start_s=first,
        period_s=0.02,
        number=number,
        lower_s=first + 0.02 * number - 1e-5,
        upper_s=first + 0.02 * number + 1e-5,
        edge_s=first + 0.02 * number,
        correction_s=np.zeros(len(number)),
        kind="sampled",
        covariance=np.diag([1e-14, 1e-20]),
        jitter_s=0.0,
        missing=missing,
        doubled=0,
        spurious=0,
        idle_before=before,
        idle_after=after,
        resolution_s=2e-5,
        open_s=0.0,
        notices=(),
    )


@pytest.mark.parametrize(
    ("base", "other", "shift"),
    [
        # both saw the burst begin; the other stopped early
        (_fit(0.1, 100, before=True, after=True), _fit(0.3, 60, before=True, after=False), 0),
        # the other began late and both saw the end
        (_fit(0.1, 100, before=True, after=True), _fit(0.01, 60, before=False, after=True), 40),
        # equal numbers within a burst that the base saw whole
        (_fit(0.1, 100, before=True, after=True), _fit(0.01, 100, before=False, after=False), 0),
        # neither saw an end, but both saw the same pause
        (
            _fit(0.01, 100, before=False, after=False, missing=(50, 51)),
            _fit(0.01, 90, before=False, after=False, missing=(43, 44)),
            7,
        ),
    ],
)
def test_whole_period_shift_is_decided(base: TriggerFit, other: TriggerFit, shift: int) -> None:
    tie = tie_clocks(base, other)
    assert tie.shift == shift
    middle = other.edges // 2
    deviation = tie.to_base_s(other.time_s(np.array(middle))) - base.time_s(np.array(middle + shift))
    assert abs(deviation) < 0.1 * tie.u_to_base_s(other.time_s(np.array(middle)))
    assert tie_clocks(other, base).shift == -shift


def test_undecided_shift_is_refused_and_start_times_decide_it() -> None:
    base = _fit(0.010, 100, before=False, after=False)
    other = _fit(0.004, 90, before=False, after=False)
    with pytest.raises(ValueError, match=r"shift: expected .*189 whole-period shifts from -89 to 99"):
        tie_clocks(base, other)
    assert tie_clocks(base, other, start_difference_s=0.126).shift == 6
    assert tie_clocks(base, other, shift=3).shift == 3
    with pytest.raises(ValueError, match="whole-period shifts"):
        tie_clocks(base, other, start_difference_s=0.117)


def test_another_period_is_no_partner() -> None:
    base = _fit(0.1, 100, before=True, after=True)
    other = fit_trigger(find_edges(_pulses(0.1 + 0.03 * np.arange(20), 1e4, 0.8), 1e4))
    with pytest.raises(ValueError, match=r"other: expected the trigger period of the base clock, 0\.02 s, found 0\.0"):
        tie_clocks(base, other)


@pytest.mark.parametrize(
    ("instants", "found"),
    [
        ([0.1, 0.2], "edges: expected at least 3 edges, found 2"),
        ([0.05, 0.1, 0.73], "edges: expected at least 3 edges of one period and half of all, found 2 of 3"),
    ],
)
def test_edges_without_a_period_are_refused(instants: list[float], found: str) -> None:
    with pytest.raises(ValueError, match=found):
        fit_trigger(find_edges(_pulses(np.array(instants), 1e4, 1.0), 1e4))


@settings(max_examples=15, deadline=None)
@example(first=0.19, period=0.005, count=5)
@example(first=0.1, period=0.02, count=60)
@given(st.floats(0.02, 0.2), st.floats(5e-3, 0.05), st.integers(5, 60))
def test_noise_free_trigger_lies_within_one_sample(first: float, period: float, count: int) -> None:
    instants = first + period * np.arange(count)
    length = first + period * (count + 1)
    fit = fit_trigger(find_edges(_pulses(instants, 20_000.0, length, 0.4 * period), 20_000.0))
    assert fit.edges == count
    np.testing.assert_allclose(fit.time_s(np.arange(count)), instants, atol=1.0 / 20_000.0)
