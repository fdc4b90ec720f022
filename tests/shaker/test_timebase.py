"""Trigger edges, the periodic model, pulses and clock ties against simulated instants.

First clean signals, then what makes ties hard: jitter, filters, damage, locked sampling.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Literal

import numpy as np
import pytest
from contracts import refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from shaker.signal_notices import (
    CONTRADICTORY_PERIOD,
    DOUBLED_EDGES,
    LOCKED_EDGES,
    MISSING_EDGES,
    START_TIMES_DISAGREE,
    STRAY_EDGES,
)
from shaker.timebase.edges import Edges, Posterior, Slopes, find_edges, line_posterior
from shaker.timebase.tie import ClockTie, decide_shift, edge_instants, tie_clocks
from shaker.timebase.trigger import TriggerFit, fit_trigger, pulse_width

PERIOD_S = 1.0 / 52.874
EDGES, FEW = 211, 80
RATE_HZ, OTHER_HZ = 51_200.0, 50_000.0
PPM, LATER_S = 17e-6, 0.03

Rise = Callable[[np.ndarray], np.ndarray]


def _latched(instants: np.ndarray, rate: float, length_s: float = 2.0) -> Edges:
    """Edges as an input without any rise gives them: the next sample is the first that is high."""
    upper = np.ceil(instants * rate) / rate
    return Edges(upper - 1.0 / rate, upper, upper - 0.5 / rate, "sampled", 0.0, length_s, 0.5)


def _pulses(instants, rate, length_s, width_s=0.005, noise=0.0):
    """Rectangular pulses as a multiplexed or latched input sees them: no sample on the rise."""
    signal = np.zeros(int(length_s * rate))
    for instant in instants:
        signal[max(0, int(np.ceil(instant * rate))) : max(0, int(np.ceil((instant + width_s) * rate)))] = 5.0
    return signal + noise * np.random.default_rng(0).normal(size=len(signal))


def _band_limited(instants: np.ndarray, rate: float, length_s: float, width_s: float = 5e-3) -> np.ndarray:
    """The same pulses through an ideal low-pass at 0.45 of the rate: the integral of sinc, from its closed form.

    Ringing is left out 4096 samples away, where it is 5e-5 of a pulse and moves a crossing by a nanosecond.
    """
    from scipy.special import sici

    time = np.arange(int(length_s * rate)) / rate
    signal, cutoff = np.zeros(len(time)), 2.0 * np.pi * 0.45 * rate
    for instant in instants:
        near = slice(max(0, int(instant * rate) - 4096), int((instant + width_s) * rate) + 4096)
        since = time[near] - instant
        signal[near] += (sici(cutoff * since)[0] - sici(cutoff * (since - width_s))[0]) / np.pi
    return 5.0 * signal


def _two_clocks(rng: np.random.Generator) -> tuple[TriggerFit, TriggerFit, float, float]:
    """Return fits of both DAQs, and the middle edge on the other and on the base clock."""
    first, begin = 0.1 + rng.uniform(0.0, PERIOD_S), rng.uniform(0.0, 0.05)
    instants = first + PERIOD_S * np.arange(EDGES)
    base = fit_trigger(_latched(instants, RATE_HZ, 4.3))
    other = fit_trigger(_latched((instants - begin) * (1.0 + PPM), OTHER_HZ, 4.2))
    return base, other, (instants[EDGES // 2] - begin) * (1.0 + PPM), instants[EDGES // 2]


def test_edge_lies_between_the_samples_that_see_it():
    instants = 0.05 + PERIOD_S * np.arange(20) + np.random.default_rng(1).uniform(0.0, 1e-3)
    edges = find_edges(_pulses(instants, 51_200.0, 0.5, noise=0.05), 51_200.0)
    assert (edges.kind, len(edges.lower_s)) == ("sampled", 20)
    assert np.all(edges.lower_s < instants)
    assert np.all(instants <= edges.upper_s)
    np.testing.assert_allclose(edges.upper_s - edges.lower_s, 1.0 / 51_200.0)
    ends = find_edges(_pulses(instants, 51_200.0, 0.5), 51_200.0, edge="falling")
    assert np.all((ends.lower_s < instants + 5e-3) & (instants + 5e-3 <= ends.upper_s + 1e-12))


@pytest.mark.parametrize("width_s", [2e-4, 5e-3, 1.8e-2])
def test_default_threshold_copes_with_any_duty(width_s):
    # 1 %, 26 % and 95 % of the period; the 5 % and 95 % quantiles coincide for the first and the last.
    instants = 0.05 + PERIOD_S * np.arange(20)
    edges = find_edges(_pulses(instants, 51_200.0, 0.45, width_s, noise=0.02), 51_200.0)
    assert (len(edges.lower_s), edges.threshold) == (20, pytest.approx(2.5, abs=0.2))


def test_noise_at_the_threshold_counts_once_and_one_out_of_reach_is_refused():
    rng = np.random.default_rng(2)
    ramp = np.clip(np.sin(2 * np.pi * 10.0 * np.arange(20_000) / 20_000.0) * 3.0, -1.0, 1.0)
    edges = find_edges(ramp + 0.03 * rng.normal(size=len(ramp)), 20_000.0)
    assert len(edges.estimate_s) == 9  # the one at the very start has no low sample before it
    with pytest.raises(ValueError, match=r"^threshold: .* 7 "):
        find_edges(_pulses(np.array([0.1, 0.2]), 1e4, 0.3), 1e4, threshold=7.0)
    refused("^samples: .* 1 ", find_edges, np.array([0.0, np.nan, 1.0]), 1e4)


def test_band_limited_edges_have_no_bias():
    for late in np.random.default_rng(3).uniform(0.0, 1e-3, 2):
        instants = 0.05 + late + PERIOD_S * np.arange(60)
        edges = find_edges(_band_limited(instants, 51_200.0, 1.3), 51_200.0)
        assert edges.kind == "resolved"
        # A sample is 19.5 us; half of it is the bias of the naive reading.
        assert abs(fit_trigger(edges).time_s(np.array(30)) - instants[30]) < 0.1e-6


def test_start_period_and_numbers_are_found():
    first = 0.1 + np.random.default_rng(4).uniform(0.0, PERIOD_S)
    fit = fit_trigger(find_edges(_pulses(first + PERIOD_S * np.arange(EDGES), 51_200.0, 4.3), 51_200.0))
    assert (fit.edges, fit.start_s) == (EDGES, pytest.approx(first, abs=1e-6))
    assert fit.period_s == pytest.approx(PERIOD_S, abs=5e-9)
    assert (fit.idle_before, fit.idle_after, fit.missing, fit.spurious, fit.notices) == (True, True, (), 0, ())
    assert fit.jitter_s < 1e-6


def test_missing_doubled_and_stray_edges_are_survived():
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
        assert (fit.edges, set(fit.missing)) == (EDGES, set(np.flatnonzero(~keep)))
        assert fit.spurious > 0
        values = {notice.code: notice.values for notice in fit.notices}
        assert values[MISSING_EDGES.code]["missing"] == len(fit.missing)
        assert values[STRAY_EDGES.code]["stray"] == fit.spurious
        assert values.get(DOUBLED_EDGES.code, {"doubled": 0})["doubled"] == fit.doubled
        errors.append(fit.time_s(np.array(105)) - instants[105])
    assert np.sqrt(np.mean(np.square(errors))) < 0.2e-6


def test_scatter_is_distinguished_from_sampling():
    """30 ns of a quartz against 0.1 of a sample, few edges and many, any place between the samples."""
    rng = np.random.default_rng(26)
    for rate_hz, count in ((8_000.0, 48), (51_200.0, 211)):
        for jitter, scatters in ((0.0, False), (1e-2 / rate_hz / count, False), (0.1 / rate_hz, True)):
            for _ in range(2):
                instants = 0.1 + PERIOD_S * (rng.uniform() + np.arange(count)) + jitter * rng.normal(size=count)
                fit = fit_trigger(_latched(instants, rate_hz, 4.3))
                assert fit.jitter_detected is scatters
                assert not scatters or fit.jitter_s == pytest.approx(jitter, rel=0.5)


@pytest.mark.parametrize(
    ("seed", "cases", "bias", "scatter"),
    [(7, 2, 0.06e-6, 0.13e-6), pytest.param(17, 30, 0.038e-6, 0.125e-6, marks=pytest.mark.slow)],
)
def test_clock_offset_and_rate_without_jitter(seed, cases, bias, scatter):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(cases):
        base, other, other_s, base_s = _two_clocks(rng)
        tie = tie_clocks(base, other)
        error = float(tie.to_base_s(np.array(other_s))) - base_s
        found.append((error, tie.rate - 1.0 / (1.0 + PPM), error / float(tie.u_to_base_s(np.array(other_s)))))
        assert tie.shift == 0
    offset, rate, normalised = np.array(found).T
    assert np.sqrt(np.mean(offset**2)) < 0.10e-6
    assert abs(np.mean(offset)) < bias
    assert np.sqrt(np.mean(rate**2)) < scatter
    assert np.max(np.abs(normalised)) < 4.0


def test_roles_of_the_clocks_can_be_exchanged():
    base, other, other_s, _ = _two_clocks(np.random.default_rng(8))
    forward, backward = tie_clocks(base, other), tie_clocks(other, base)
    assert forward.rate * backward.rate == pytest.approx(1.0, abs=1e-12)
    back = backward.to_base_s(forward.to_base_s(np.array(other_s)))
    assert float(back) == pytest.approx(other_s, abs=1e-11)
    u = float(forward.u_to_base_s(np.array(other_s)))
    assert float(backward.u_to_base_s(forward.to_base_s(np.array(other_s)))) == pytest.approx(u, rel=1e-3)


def _fit(first: float, edges: int, *, before: bool, after: bool, missing: tuple[int, ...] = ()) -> TriggerFit:
    number = np.setdiff1d(np.arange(edges), missing)
    fit = fit_trigger(_latched(first + 0.02 * number, RATE_HZ + 0.7))
    assert fit.missing == missing
    return replace(fit, idle_before=before, idle_after=after)


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
def test_whole_period_shift_is_decided(base, other, shift):
    tie = tie_clocks(base, other)
    assert tie.shift == shift
    middle = other.edges // 2
    deviation = tie.to_base_s(other.time_s(np.array(middle))) - base.time_s(np.array(middle + shift))
    assert abs(deviation) < 0.2 * tie.u_to_base_s(other.time_s(np.array(middle)))
    assert tie_clocks(other, base).shift == -shift


def test_undecided_shift_is_refused_and_start_times_decide_it():
    base = _fit(0.010, 100, before=False, after=False)
    other = _fit(0.004, 90, before=False, after=False)
    refused("^shift: .*189 .*-89 to 99", tie_clocks, base, other)
    assert (tie_clocks(base, other, start_difference_s=0.126).shift, tie_clocks(base, other, shift=3).shift) == (6, 3)
    refused("^shift: ", tie_clocks, base, other, start_difference_s=0.117)
    slow = fit_trigger(find_edges(_pulses(0.1 + 0.03 * np.arange(20), 1e4, 0.8), 1e4))
    refused(r"^other: .* 0\.02 s, found 0\.0", tie_clocks, replace(base, period_s=0.02), slow)


def test_edges_without_a_period_are_refused():
    refused("^edges: .* 3 .*2 of 3$", fit_trigger, find_edges(_pulses([0.05, 0.1, 0.73], 1e4, 1.0), 1e4))
    refused("^edges: .* 3 .* 2$", fit_trigger, find_edges(_pulses([0.1, 0.2], 1e4, 1.0), 1e4))


@settings(max_examples=15, deadline=None)
@example(first=0.19, period=0.005, count=5)
@example(first=0.1, period=0.02, count=60)
@given(st.floats(0.02, 0.2), st.floats(5e-3, 0.05), st.integers(5, 60))
def test_noise_free_trigger_lies_within_one_sample(first, period, count):
    instants = first + period * np.arange(count)
    length = first + period * (count + 1)
    fit = fit_trigger(find_edges(_pulses(instants, 20_000.0, length, 0.4 * period), 20_000.0))
    assert fit.edges == count
    np.testing.assert_allclose(fit.time_s(np.arange(count)), instants, atol=1.0 / 20_000.0)


def _ramp(x: np.ndarray) -> np.ndarray:
    """A linear rise over three samples."""
    return np.clip(x / 3.0 + 0.5, 0.0, 1.0)


def _charging(x: np.ndarray) -> np.ndarray:
    """An RC input, time constant two samples, half way at 0."""
    return 1.0 - np.exp(-np.maximum(x / 2.0 + np.log(2.0), 0.0))


TAP_POSITIONS = np.arange(-24 * 64, 24 * 64 + 1) / 64.0
TAPS = np.sinc(TAP_POSITIONS) * np.kaiser(len(TAP_POSITIONS), 8.0)


def _half_band(x: np.ndarray) -> np.ndarray:
    """A delta-sigma converter's decimation filter: half amplitude at half the sampling rate."""
    return np.interp(x - 0.5 / 64.0, TAP_POSITIONS, np.cumsum(TAPS) / TAPS.sum(), left=0.0, right=1.0)


def _shaped(
    rise: Rise, instants: np.ndarray, rng: np.random.Generator, width_s: float = 2e-3, rate: float = RATE_HZ
) -> np.ndarray:
    """Pulses with that rise on a little noise."""
    signal = 1e-3 * rng.normal(size=int((instants[-1] + 0.05) * rate))
    near = np.arange(-60, int(width_s * rate) + 60)
    for instant in instants:
        index = int(instant * rate) + near
        signal[index] += rise(index - instant * rate) - rise(index - (instant + width_s) * rate)
    return signal


def _filtered(rise: Rise, instants: np.ndarray, rate: float, rng: np.random.Generator) -> TriggerFit:
    """The trigger found in pulses of 2 ms with that rise."""
    return fit_trigger(find_edges(_shaped(rise, instants, rng, rate=rate), rate, threshold=0.5))


def _instants(rng: np.random.Generator, jitter_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Instants with jitter on the first clock, and the same on the second."""
    true = 0.1 + rng.uniform(0.0, PERIOD_S) + PERIOD_S * np.arange(FEW) + jitter_s * rng.normal(size=FEW)
    return true, (true - LATER_S) * (1.0 + PPM)


def _deviation(tie: ClockTie) -> tuple[float, float]:
    """Error in the middle of the common edges, and over its stated uncertainty."""
    middle_s = np.array(tie.middle_s)
    error = float(tie.to_base_s(middle_s)) - (tie.middle_s / (1.0 + PPM) + LATER_S)
    return error, error / float(tie.u_to_base_s(middle_s))


@pytest.mark.parametrize("external", [None, Slopes(np.array([0.25]), np.array([[0.05**-2]]))])
def test_posterior_is_that_of_direct_integration(external):
    """Even over lines that pass through all intervals, times the normal density of an external slope."""
    position, centre = np.array([-1.0, -0.3, 0.4, 1.0]), np.array([0.3, -0.2, 0.1, 0.35])
    m, h = np.meshgrid(np.linspace(-1, 1, 801), np.linspace(-1, 1, 801), indexing="ij")
    line = m[..., None] + h[..., None] * position
    weight = np.all((line > centre[:, None, None].T - 0.5) & (line <= centre[:, None, None].T + 0.5), axis=-1)
    weight = weight * (1.0 if external is None else np.exp(-0.5 * ((h - 0.25) / 0.05) ** 2))
    mean = np.array([np.sum(weight * m), np.sum(weight * h)]) / weight.sum()
    spread = np.sqrt(
        np.array([np.sum(weight * (m - mean[0]) ** 2), np.sum(weight * (h - mean[1]) ** 2)]) / weight.sum()
    )
    start = Posterior(np.zeros(2), 0.3 * np.eye(2), 1e-4)
    found = line_posterior(position, (centre - 0.5)[None], (centre + 0.5)[None], start, 1e-12, external)
    np.testing.assert_allclose(found.mean, mean, atol=0.25 * spread.min())
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), spread, rtol=0.12)


def test_an_external_period_shows_where_edges_pass_a_sample():
    drift = 0.8 / (FEW - 1)  # samples from edge to edge
    for phase in (0.7, 0.5, 0.3):  # of a sample, of the first: a later one is the next sample's
        instants = (5000.0 + phase) / RATE_HZ + (968.0 + drift) / RATE_HZ * np.arange(FEW)
        alone = fit_trigger(_latched(instants, RATE_HZ))
        combined = alone.with_period((968.0 + drift) / RATE_HZ, 1e-8 / RATE_HZ)
        error = combined.time_s(np.arange(FEW)) - instants
        assert np.max(np.abs(error)) < 0.75 * drift / RATE_HZ
        assert float(combined.u_time_s(np.array(40))) < 0.5 * drift / RATE_HZ
        assert float(alone.u_time_s(np.array(40))) > 4.0 * drift / RATE_HZ
    wrong = alone.with_period((968.0 + drift) / RATE_HZ * (1.0 + 1e-4), 1e-8 / RATE_HZ)
    assert wrong.time_s(np.array(40)) == alone.time_s(np.array(40))
    assert wrong.notices[-1].code == CONTRADICTORY_PERIOD.code
    assert wrong.notices[-1].values["direction"] == "longer"
    assert wrong.notices[-1].values["relative_difference"] == pytest.approx(1e-4, rel=0.05)


def test_the_shape_of_a_locked_rise_moves_no_exposure():
    """Crossings err by up to a tenth of a sample along with their place; single exposures do not follow them."""
    rng = np.random.default_rng(43)
    instants = 0.1 + rng.uniform(0.0, PERIOD_S) + 968.005 / RATE_HZ * np.arange(FEW)  # 0.4 of a sample in all
    fit = _filtered(_charging, instants, RATE_HZ, rng)
    assert fit.jitter_s > 1.5 * fit.resolution_s / np.sqrt(12.0)  # with which single edges would count
    found = edge_instants(fit, np.arange(FEW))
    assert np.median(found.model_share) > 0.9
    shape_s = np.ptp(fit.edge_s - instants)
    straight = edge_instants(fit.with_period(968.005 / RATE_HZ, 1e-9 / RATE_HZ), np.arange(FEW)).time_s - instants
    assert shape_s > 0.5e-6
    assert np.std(straight) < 0.3 * np.std(fit.edge_s - instants)


@pytest.mark.parametrize("rise", [_ramp, _charging, _half_band])
def test_observed_rise_is_followed(rise):
    rng = np.random.default_rng(21)
    first, second = _instants(rng)
    base, other = _filtered(rise, first, RATE_HZ, rng), _filtered(rise, second, OTHER_HZ, rng)
    assert base.kind == other.kind == "resolved"
    assert abs(base.time_s(np.array(40)) - first[40]) < 0.15e-6  # a sample is 19.5 us
    error, normalised = _deviation(tie_clocks(base, other))
    assert abs(error) < 0.15e-6
    assert abs(normalised) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("rise", "noise"), [(_charging, 1e-3), (_charging, 0.02), (_half_band, 1e-3)])
def test_the_uncertainty_includes_the_undetermined_rise_shape(rise, noise):
    rng, normalised, models = np.random.default_rng(41), [], []
    for _ in range(60):
        first, second = _instants(rng)
        base, other = (
            fit_trigger(find_edges(signal + noise * rng.normal(size=len(signal)), rate, threshold=0.5))
            for signal, rate in (
                (_shaped(rise, first, rng), RATE_HZ),
                (_shaped(rise, second, rng, rate=OTHER_HZ), OTHER_HZ),
            )
        )
        middle = np.array(FEW // 2)
        models.append(float((base.time_s(middle) - first[FEW // 2]) / base.u_time_s(middle)))
        normalised.append(_deviation(tie_clocks(base, other))[1])
    for found in (normalised, models):
        assert np.sqrt(np.mean(np.square(found))) < 1.15


@pytest.mark.parametrize(
    ("rise", "samples"), [(None, 968.0), *product((_ramp, _charging, _half_band), (968.0, 968.002, 968.5))]
)
def test_locked_edges_are_covered_and_reported(rise, samples):
    """Slowly drifting edges (968.002 samples) do not put their drift down to the shape of the rise; None: no rise."""
    rng = np.random.default_rng(42)
    for phase in (0.02, 0.5, 0.97):
        instants = (5000.0 + phase + samples * np.arange(FEW)) / RATE_HZ
        fit = fit_trigger(_latched(instants, RATE_HZ)) if rise is None else _filtered(rise, instants, RATE_HZ, rng)
        for edge in (0, FEW // 2, FEW - 1):
            deviation = float(fit.time_s(np.array(edge))) - instants[edge]
            assert abs(deviation) < 2.0 * float(fit.u_time_s(np.array(edge)))
        assert LOCKED_EDGES.code in [notice.code for notice in fit.notices]


def _deviations(seed: int, draws: int, jitter_s: float) -> np.ndarray:
    """Errors of ties by intervals (2, draws), and over their stated uncertainties."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(draws):
        first, second = _instants(rng, jitter_s)
        tie = tie_clocks(fit_trigger(_latched(first, RATE_HZ)), fit_trigger(_latched(second, OTHER_HZ)))
        found.append(_deviation(tie))
    return np.array(found).T


def test_common_jitter_cancels_between_intervals():
    errors, normalised = _deviations(22, 3, 100e-6)
    # Two models one by one would err by 100 us·sqrt(2 / 80) = 16 us; two roundings by 5.7 us·sqrt(2 / 80) = 0.9 us.
    assert np.sqrt(np.mean(np.square(errors))) < 1.3e-6
    assert np.max(np.abs(normalised)) < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("jitter_s", [2e-6, 20e-6])
def test_stated_uncertainty_is_calibrated_under_jitter(jitter_s):
    normalised = _deviations(23, 20, jitter_s)[1]
    low, high = np.sqrt(chi2.ppf([1e-3, 1.0 - 1e-3], 20) / 20)
    assert low < np.sqrt(np.mean(np.square(normalised))) < high


@pytest.mark.slow
def test_stated_uncertainty_is_as_large_as_the_errors():
    """Few edges, slowly sampled: start, period, jitter (1e-4 to 0.03 of a sample) and second start drawn anew."""
    rng, edges, rates = np.random.default_rng(31), 48, (8000.0, 7600.0)
    models, ties = [], []
    for _ in range(150):
        period, jitter_s = PERIOD_S * (1.0 + rng.uniform(-0.03, 0.03)), 4e-6 * np.exp(-6.0 * rng.random())
        middle = 0.2 + rng.uniform(0.0, period) + period * (edges - 1) / 2.0
        instants = middle + period * (np.arange(edges) - (edges - 1) / 2.0) + jitter_s * rng.normal(size=edges)
        later, rate = rng.uniform(0.0, 0.05), 1.0 + PPM * rng.normal()
        middles = (middle, (middle - later) / rate)
        base, other = fits = [
            fit_trigger(_latched(t, hz)) for t, hz in zip((instants, (instants - later) / rate), rates, strict=True)
        ]
        half = np.array((edges - 1) / 2.0)
        models += [
            (float(fit.time_s(half)) - t) / float(fit.u_time_s(half)) for fit, t in zip(fits, middles, strict=True)
        ]
        tie, other_s = tie_clocks(base, other, 0), np.array(middles[1])
        of_rate = (tie.rate - rate) / float(np.sqrt(tie.covariance[1, 1]))
        ties.append([(float(tie.to_base_s(other_s)) - middle) / float(tie.u_to_base_s(other_s)), of_rate])
    for normalised in (np.array(models), *np.array(ties).T):
        assert 0.9 < np.sqrt(np.mean(np.square(normalised))) < 1.1
        assert 0.92 < np.mean(np.abs(normalised) < 2.0) <= 0.99
    # Nearer to normal than to uniform errors, of which all would be within 1.73 u: k = 1.65 would hold too few.
    assert np.mean(np.abs(np.array(ties)) < np.sqrt(3.0)) < 0.95


def test_resolved_edges_replace_the_period_of_the_others():
    rng = np.random.default_rng(24)
    first, second = _instants(rng, jitter_s=20e-6)
    base, other = fit_trigger(_latched(first, RATE_HZ)), _filtered(_half_band, second, OTHER_HZ, rng)
    assert (base.kind, other.kind) == ("sampled", "resolved")
    tie = tie_clocks(base, other)
    error, normalised = _deviation(tie)
    assert abs(error) < 0.6e-6
    assert abs(normalised) < 3.5
    assert (tie.pairs, tie.decided_by) == (FEW, "burst start and end")


def test_jitter_decides_the_shift_alone():
    first, _ = _instants(np.random.default_rng(26), jitter_s=30e-6)
    base = fit_trigger(_latched((first - first[0] + 0.5 * PERIOD_S)[:70], RATE_HZ, 69.6 * PERIOD_S))
    later = first - first[9] + 0.4 * PERIOD_S
    other = fit_trigger(_latched(later[9:79], OTHER_HZ, 69.7 * PERIOD_S))
    assert not any((base.idle_before, base.idle_after, other.idle_before, other.idle_after))
    assert decide_shift(base, other, None) == (9, "jitter")
    assert decide_shift(other, base, None)[0] == -9


def test_contradicting_ends_are_refused_by_name():
    first, second = _instants(np.random.default_rng(27))
    base = fit_trigger(_latched(first, RATE_HZ))
    other = fit_trigger(_latched(second[2:], OTHER_HZ))  # two edges lost at its start, though it was recording
    refused("^shift: .*80 and 78 .*2 and 0; .*first_edge", tie_clocks, base, other)
    tie = tie_clocks(base, other, start_difference_s=LATER_S)
    assert (tie.shift, tie.decided_by) == (2, "start times")
    assert not tie.notices
    (notice,) = tie_clocks(base, other, shift=0, start_difference_s=LATER_S).notices
    assert notice.code == START_TIMES_DISAGREE.code
    assert notice.values == {"start_time_edge": 2, "evidence": "first_edge", "used_edge": 0}


def test_single_gaps_that_coincide_by_chance_do_not_decide():
    first, _ = _instants(np.random.default_rng(28))
    instants = first - first[0] + 0.5 * PERIOD_S
    base = fit_trigger(_latched(np.delete(instants[:70], [20, 41, 60]), RATE_HZ, 69.6 * PERIOD_S))
    other = fit_trigger(_latched(np.delete(instants[:70], [9, 15, 33]), OTHER_HZ, 69.6 * PERIOD_S))
    refused("^shift: ", decide_shift, base, other, None)


def _jump(x: np.ndarray) -> np.ndarray:
    """A latched input."""
    return np.where(x >= 0.0, 1.0, 0.0)


def _brick_wall(x: np.ndarray) -> np.ndarray:
    """An ideal low-pass at half the sampling rate, which rings for hundreds of samples."""
    position = np.arange(-400 * 16, 400 * 16 + 1) / 16.0
    taps = np.sinc(position)
    return np.interp(x - 0.5 / 16.0, position, np.cumsum(taps) / taps.sum(), left=0.0, right=1.0)


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
def test_short_pulses_are_as_uncertain_as_stated(rise, samples):
    rng = np.random.default_rng(32)
    for long in samples:
        found = pulse_width(_shaped(rise, _instants(rng)[0], rng, long / RATE_HZ), RATE_HZ)
        assert abs(found.width_s * RATE_HZ - long) < 2.5 * found.u_width_s * RATE_HZ
        assert found.u_width_s * RATE_HZ < max(0.02, 0.3 / long)


@pytest.mark.parametrize(("rise", "samples"), [(_jump, 0.8), (_half_band, 2.0), (_ramp, 4.4), (_charging, 8.2)])
def test_pulses_that_do_not_settle_are_refused(rise, samples):
    rng = np.random.default_rng(33)
    signal = _shaped(rise, _instants(rng)[0], rng, samples / RATE_HZ)
    refused(r"^samples: .*[\d.]+ samples", pulse_width, signal, RATE_HZ)


@pytest.mark.parametrize("rise", [_jump, _half_band])
def test_pulse_width(rise):
    rng = np.random.default_rng(29)
    width = 2e-3
    signal = _shaped(rise, _instants(rng)[0], rng, width)
    found = pulse_width(signal, RATE_HZ)
    assert (found.pulses, found.width_s) == (FEW, pytest.approx(width, abs=0.5e-6))
    assert abs(found.width_s - width) < 4.0 * found.u_width_s
    # The pauses of the inverted signal are the same pulses.
    assert pulse_width(-signal, RATE_HZ, edge="falling").width_s == pytest.approx(found.width_s, abs=1e-9)
    pause = pulse_width(signal, RATE_HZ, edge="falling")
    assert pause.width_s == pytest.approx(PERIOD_S - width, abs=1e-6)
    # A fit of the same edges stands for theirs; one of other edges does not.
    of_these, of_others = (fit_trigger(find_edges(samples, RATE_HZ)) for samples in (signal, np.roll(signal, 10)))
    for begun in (of_these, of_others):
        assert pulse_width(signal, RATE_HZ, begin_fit=begun).width_s == pytest.approx(found.width_s, abs=1e-9)


def test_instants_follow_edges_that_jitter():
    rng = np.random.default_rng(30)
    first, second = _instants(rng, jitter_s=20e-6)
    base, other = fit_trigger(_latched(first, RATE_HZ)), _filtered(_half_band, second, OTHER_HZ, rng)
    number = np.arange(FEW)
    model, alone = base.time_s(number) - first, edge_instants(base, number)
    both = edge_instants(base, number, [(other, tie_clocks(base, other))])
    assert np.std(model) > 15e-6
    assert np.std(alone.time_s - first) < 6.5e-6  # 19.5 us / sqrt(12) = 5.6 us
    assert np.std(both.time_s - first) < 0.35e-6
    assert 0.7 < np.std((alone.time_s - first) / alone.u_time_s) < 1.4
    assert np.max(np.abs(both.time_s - first) / both.u_time_s) < 4.0
    assert np.all(both.u_time_s < 1e-6)
    steady = fit_trigger(_latched(_instants(np.random.default_rng(31))[0], RATE_HZ))  # without jitter, the model's
    np.testing.assert_allclose(edge_instants(steady, number).time_s, steady.time_s(number), atol=0.2e-6)


@settings(max_examples=10, deadline=None)
@given(st.floats(-100.0, 100.0).filter(lambda x: abs(x) > 1e-3), st.floats(-50.0, 50.0), st.integers(0, 1000))
def test_edges_do_not_depend_on_scale_level_and_sign(scale, level, seed):
    instants = 0.01 + 0.004 * np.arange(6) + np.random.default_rng(seed).uniform(0.0, 1e-4)
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
def test_later_records_move_the_offset_alone(base_lag_s, other_lag_s):
    first, second = _instants(np.random.default_rng(32))
    base, other = fit_trigger(_latched(first, RATE_HZ)), fit_trigger(_latched(second, OTHER_HZ))
    tie, moved = tie_clocks(base, other), tie_clocks(base.delay_by(base_lag_s), other.delay_by(other_lag_s))
    middle_s = tie.middle_s
    u = float(tie.u_to_base_s(np.array(middle_s)))
    deviation = moved.to_base_s(np.array(middle_s + other_lag_s)) - base_lag_s - tie.to_base_s(np.array(middle_s))
    assert abs(float(deviation)) < 0.1 * u
    assert float(moved.u_to_base_s(np.array(middle_s + other_lag_s))) == pytest.approx(u, rel=0.1)


@pytest.mark.slow
def test_noise_of_ties_is_independent_for_records_with_equal_starts():
    """Edges resolved between the samples, four records of each start: what scatters among them is the `noise` of it."""
    rng, scatter, stated, whole = np.random.default_rng(8), [], [], []
    for _ in range(12):
        first, begin = 0.1 + rng.uniform(0.0, PERIOD_S), rng.uniform(0.0, 0.05)
        instants = first + PERIOD_S * np.arange(FEW)
        clean = [
            _band_limited(instants if rate == RATE_HZ else (instants - begin) * (1.0 + PPM), rate, 1.8)
            for rate in (RATE_HZ, OTHER_HZ)
        ]
        middle, found = np.asarray((instants[FEW // 2] - begin) * (1.0 + PPM)), []
        for _ in range(4):
            fits = [
                fit_trigger(find_edges(signal + 0.1 * rng.standard_normal(len(signal)), rate))
                for signal, rate in zip(clean, (RATE_HZ, OTHER_HZ), strict=True)
            ]
            tie = tie_clocks(*fits, start_difference_s=begin)
            found.append(float(tie.to_base_s(middle)))
            row = np.array([1.0, float(middle)])
            stated.append(row @ tie.noise @ row)
            whole.append(row @ tie.covariance @ row)
        scatter.append(np.var(found, ddof=1))
    assert 0.65 < np.sqrt(np.mean(scatter) / np.mean(stated)) < 1.5
    assert np.all(np.array(stated) <= np.array(whole))


def test_uncertainty_from_sampling_is_no_noise():
    base, other, _, _ = _two_clocks(np.random.default_rng(2))
    assert not tie_clocks(base, other).noise.any()
    # A rate found otherwise takes its share off both.
    tie = replace(tie_clocks(base, other), noise=0.5 * tie_clocks(base, other).covariance)
    left = tie.with_rate(tie.rate, 1e-9)
    assert left.noise[1, 1] == pytest.approx(0.5 * tie.covariance[1, 1] * (1e-18 / (tie.covariance[1, 1] + 1e-18)) ** 2)
    assert np.linalg.eigvalsh(left.covariance - left.noise).min() > -1e-30


SLOW_HZ, START_S, CAMERA_S, PULSES = 25_600.0, 0.01234, 1.0 / 21.3, 24
Pulse = Sequence[tuple[float, float]]


def _bounced(pulses: Sequence[Pulse], edge: str) -> np.ndarray:
    """Sample pulses that are each high from and to some times after its true edge."""
    time = np.arange(int((START_S + PULSES * CAMERA_S + 0.05) * SLOW_HZ)) / SLOW_HZ
    high = np.zeros(len(time), dtype=np.bool_)
    for k, pulse in enumerate(pulses):
        for begin, end in pulse:
            high |= (time >= START_S + k * CAMERA_S + begin) & (time < START_S + k * CAMERA_S + end)
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(time))
    return np.asarray(noise + np.where(high == (edge == "rising"), 5.0, 0.0))


def _some(share: float, bounced: Pulse) -> list[Pulse]:
    chosen = np.random.default_rng(7).permutation(PULSES) < share * PULSES
    return [bounced if one else [(0.0, 2e-3)] for one in chosen]


TWICE: Pulse = [(0.0, 2e-4), (3.5e-4, 2e-3)]


@pytest.mark.parametrize("edge", ["rising", "falling"])
@pytest.mark.parametrize(
    ("pulses", "doubled"),
    [
        ([TWICE] * PULSES, 24),
        ([[(0.0, 1e-3), (0.12 * CAMERA_S, 0.12 * CAMERA_S + 1e-3)]] * PULSES, 24),
        ([[(0.0, 3e-4), (6e-4, 8e-4), (9.5e-4, 2e-3)]] * PULSES, 48),
        ([[(0.0, 2e-3), (2.3e-3, 2.6e-3)]] * PULSES, 24),
        ([[(0.0, 0.5 * CAMERA_S), (0.5 * CAMERA_S + 3e-4, 0.5 * CAMERA_S + 6e-4)]] * PULSES, 24),
        ([[(0.0, 0.95 * CAMERA_S)]] * PULSES, 0),
        *((_some(share, TWICE), round(share * PULSES)) for share in (0.125, 0.25, 0.5, 0.75)),
    ],
)
def test_the_first_edge_of_bouncing_pulses_counts(
    pulses: list[Pulse], doubled: int, edge: Literal["rising", "falling"]
) -> None:
    fit = fit_trigger(find_edges(_bounced(pulses, edge), SLOW_HZ, edge=edge))
    assert (fit.edges, fit.doubled, fit.spurious, fit.missing) == (PULSES, doubled, 0, ())
    assert abs(fit.start_s - START_S) < 3.0 * float(fit.u_time_s(np.asarray(0))) < 1e-5
    assert fit.period_s == pytest.approx(CAMERA_S, rel=1e-5)


@pytest.mark.parametrize("distance", [0.22, 0.3, 0.4])
def test_two_pulses_at_comparable_distances_are_refused(distance: float) -> None:
    """Of two cameras on one line, or of pulses that come twice, no distance says which edges are meant."""
    gap_s = distance * CAMERA_S
    edges = find_edges(_bounced([[(0.0, 1e-3), (gap_s, gap_s + 1e-3)]] * PULSES, "rising"), SLOW_HZ)
    with pytest.raises(ValueError, match=r"^edges: .*alternate") as caught:
        fit_trigger(edges)
    distances = [float(number) for number in re.findall(r"\d+\.\d+", str(caught.value))]
    assert distances == pytest.approx([gap_s, CAMERA_S - gap_s], abs=1.0 / SLOW_HZ)


def test_bursts_and_lost_pulses_are_no_bounces() -> None:
    pulse: Pulse = [(0.0, 1e-3)]
    for present in (lambda k: k % 10 < 5, lambda k: k not in (5, 9)):
        fit = fit_trigger(find_edges(_bounced([pulse if present(k) else [] for k in range(PULSES)], "rising"), SLOW_HZ))
        assert (fit.doubled, fit.spurious) == (0, 0)
        assert fit.period_s == pytest.approx(CAMERA_S, rel=1e-4)
