"""Aliases, exposure, lines that fold, and the planner of rates against formulas, Fisher's information and searches."""

import numpy as np
import pytest
from contracts import refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import sici

from shaker.lines.rate_planner import (
    PREFERRED,
    RateScan,
    Sampling,
    amplitude_covariance,
    best_rates,
    candidate_rates,
    condition_over_rate,
    fewest_rates,
    lines_of,
    plan_at,
    rms_uncertainty,
    scan_rates,
)
from shaker.signal_notices import ALIASED_LINE, ALIASED_LINE_OTHER_RATE
from shaker.sine import aliasing
from shaker.sine.aliasing import (
    CLEAR_BINS,
    alias_frequency,
    condition_number,
    find_aliased_harmonics,
    nearest_clear_rate,
    sampling_grid,
    separation_bins,
    sine_columns,
    usable_lines,
)
from shaker.sine.sine_fit import fit_sines

CAMERA_HZ = 52.874


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 5000.0), st.floats(10.0, 1000.0), st.integers(0, 30))
def test_alias_is_periodic_even_and_below_nyquist(frequency, rate, turns):
    alias = float(alias_frequency(frequency, rate))
    assert 0.0 <= alias <= rate / 2.0 * (1.0 + 1e-12)
    assert float(alias_frequency(turns * rate + frequency, rate)) == pytest.approx(alias, abs=1e-8)
    assert float(alias_frequency(-frequency, rate)) == pytest.approx(alias, abs=1e-8)
    line, seen = (np.cos(2 * np.pi * f * np.arange(50) / rate) for f in (frequency, alias))
    np.testing.assert_allclose(line, seen, atol=1e-9)


def test_ideal_sampling_has_condition_one_and_all_published_lines_are_usable():
    columns = sine_columns(np.arange(1000) / 1000.0, np.array([100.0, 200.0, 300.0]))
    assert condition_number(columns.T @ columns) == pytest.approx(1.0, abs=1e-9)
    mask, notices = usable_lines(np.arange(211) / CAMERA_HZ, 106.25 * np.arange(1, 5))
    assert mask.all()
    assert not notices
    scattered = np.sort(np.random.default_rng(0).uniform(0.0, 4.0, 200))  # off any grid nothing folds
    assert usable_lines(scattered, np.array([70.0, 130.0]))[0].all()


@pytest.mark.parametrize(
    ("lines", "rate", "dropped", "neighbour", "distance_hz"),
    [
        ([100.0, 150.0], 50.0, 100.0, "zero", 0.0),
        ([100.0, 130.0], 200.0, 100.0, "the Nyquist frequency", 0.0),
        ([70.0, 130.0], 200.0, 130.0, "the line 70 Hz (at 70 Hz)", 0.0),
        ([30.0, 230.05], 200.0, 230.05, "the line 30 Hz (at 30 Hz)", 0.05),
    ],
)
def test_aliased_line_is_dropped_by_name(lines, rate, dropped, neighbour, distance_hz):
    mask, notices = usable_lines(np.arange(400) / rate, np.array(lines))
    assert not mask[lines.index(dropped)]
    (notice,) = (n for n in notices if n.where == f"{dropped:.6g} Hz")
    assert notice.code in (ALIASED_LINE.code, ALIASED_LINE_OTHER_RATE.code)
    assert notice.values["neighbour"] == neighbour
    assert notice.values["distance_hz"] == pytest.approx(distance_hz, abs=1e-9)


def test_harmonics_that_fold_onto_a_line_are_named():
    # The real record at 200 Hz: the fourth and sixth harmonic of 120 Hz come back at 80 Hz, like 120 Hz itself.
    folds = find_aliased_harmonics(120.0, [100.0, 120.0, 150.0], 200.0, 0.05, max_multiple=6)
    assert [(fold.frequency_hz, fold.multiple, fold.fundamental_hz) for fold in folds] == [
        (480.0, 4, 120.0),
        (720.0, 6, 120.0),
    ]
    assert all(fold.alias_hz == pytest.approx(80.0) for fold in folds)
    assert not find_aliased_harmonics(106.25, [106.25], CAMERA_HZ, 0.25, max_multiple=20)


def test_grid_with_gaps_is_recognised():
    index = np.array([0, 1, 2, 5, 6, 9, 10])
    grid = sampling_grid(3.0 + index / 50.0)
    assert grid is not None
    np.testing.assert_array_equal(grid.index, index)
    assert (grid.rate_hz, grid.start_s) == pytest.approx((50.0, 3.0))
    assert sampling_grid(np.array([0.0, 1.0, 2.3, 3.0])) is None
    assert sampling_grid(np.array([0.0, 1.0, 0.5])) is None


STEP_HZ = 0.01
LINES = st.lists(st.integers(2, 120), min_size=1, max_size=4, unique=True).map(
    lambda tenths: 8.0 * np.array(tenths, dtype=np.float64)
)


def _first_clear(lines: np.ndarray, rate: float, frames: int, bins: float) -> float | None:
    """Look at every multiple of the step within a fifth of the rate, nearest first, written with complex phases."""
    steps = np.arange(np.ceil(0.8 * rate / STEP_HZ), np.floor(1.2 * rate / STEP_HZ) + 1) * STEP_HZ
    for candidate in sorted(steps, key=lambda r: abs(r - rate)):
        turns = np.concatenate([[0.0], lines, -lines]) / candidate
        angle = np.abs(np.angle(np.exp(2j * np.pi * np.subtract.outer(turns, turns))))[~np.eye(len(turns), dtype=bool)]
        if angle.min() >= 2.0 * np.pi * bins / frames:
            return float(candidate)
    return None


@settings(max_examples=25, deadline=None)
@example(np.array([16.0, 24.0, 696.0]), 77.0, 20)  # at 76.8 Hz exactly as far apart as asked
@given(LINES, st.floats(20.0, 90.0), st.integers(20, 300))
def test_nearest_clear_rate_is_that_of_an_exhaustive_search(lines, rate, frames):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(aliasing, "_RATE_STEP_HZ", STEP_HZ)
        found = nearest_clear_rate(lines, rate, frames)
    change = np.nan if found is None else abs(found - rate)
    # Lines may be exactly as far apart as asked, where rounding decides: what is a hair stricter or laxer answers too
    expected = [_first_clear(lines, rate, frames, CLEAR_BINS * (1 + hair)) for hair in (-1e-9, 1e-9)]
    changes = [np.nan if each is None else abs(each - rate) for each in expected]
    assert np.isclose(change, changes, rtol=0, atol=1e-6, equal_nan=True).any()


@settings(max_examples=25, deadline=None)
@given(LINES, st.floats(20.0, 90.0), st.integers(40, 300))
def test_a_clear_rate_makes_every_line_usable(lines, rate, frames):
    found = nearest_clear_rate(lines, rate, frames)
    if found is None:
        return
    mask, notices = usable_lines(np.arange(frames) / found, lines)
    assert mask.all()
    assert not notices
    assert np.linalg.cond(sine_columns(np.arange(frames) / found, lines)) < 3.3


def test_a_clear_rate_is_returned_unchanged_and_an_unresolvable_line_has_no_better_rate():
    refused("^rate_hz: .*-1", nearest_clear_rate, np.array([100.0]), -1.0, 211)
    assert nearest_clear_rate(106.25 * np.arange(1, 6), 52.874, 211) == 52.874
    assert nearest_clear_rate(np.array([100.0, 100.01]), 53.0, 211) is None
    # Halving the rate doubles the record, but nobody would call it the same measurement.
    assert nearest_clear_rate(np.array([0.2]), 53.0, 211) is None


def test_the_notice_of_a_dropped_line_names_the_cure():
    lines = 106.25 * np.arange(1, 6)
    mask, notices = usable_lines(np.arange(211) / 53.125, lines)
    assert not mask.any()
    assert notices[0].code == ALIASED_LINE_OTHER_RATE.code
    assert (notices[0].values["better_rate_hz"], notices[0].values["separated"]) == (52.968, "all lines")
    assert usable_lines(np.arange(211) / 52.968, lines)[0].all()
    # Where not all lines can be separated, it cures the one it names.
    _, notices = usable_lines(np.arange(211) / 53.125, np.array([70.0, 106.25, 70.001]))
    by_line = {notice.where: notice for notice in notices}
    assert by_line["106.25 Hz"].values["separated"] == "this line"
    assert by_line["70.001 Hz"].code == ALIASED_LINE.code


PUBLISHED = Sampling(frames=211, exposure_s=40e-6)
RATES = np.arange(41_000, 82_000, 7) * 1e-3


def _inverse_fisher(frequency: np.ndarray, rate: float, frames: int, phase: float) -> np.ndarray:
    """Cramér-Rao bounds of the amplitudes (K,), with white noise of unit variance, from derivatives of the signal."""
    angle = 2.0 * np.pi * np.outer(np.arange(frames) / rate, frequency) + phase
    derivatives = np.column_stack([np.ones(frames), np.cos(angle), -np.sin(angle)])  # offset, amplitudes, phases
    return np.diag(np.linalg.inv(derivatives.T @ derivatives))[1 : len(frequency) + 1]


@pytest.mark.parametrize(("rate", "frames"), [(CAMERA_HZ, 211), (57.565, 211), (53.0244, 211), (66.0, 24)])
def test_white_noise_gives_the_cramer_rao_bound(rate, frames):
    frequency = 106.25 * np.arange(1, 3)
    covariance, _ = amplitude_covariance(frequency, rate, frames)
    # Two phases a quarter of a turn apart have the mean variance of all phases.
    bound = np.mean([_inverse_fisher(frequency, rate, frames, phase) for phase in (0.4, 0.4 + np.pi / 2.0)], axis=0)
    np.testing.assert_allclose(rms_uncertainty(covariance) ** 2, bound, rtol=1e-9)


@pytest.mark.parametrize("rate", [CAMERA_HZ, 57.565, 53.0244])
def test_coloured_noise_gives_the_exact_covariance(rate):
    """The density (2/r)·c/f up to r/2 has the generalised autocovariance -(2c/r)·Cin(πm), Cin(x) = γ + ln x - Ci(x)."""
    frames, corner, frequency = 211, 5.0, 106.25 * np.arange(1, 4)
    lag = np.pi * np.arange(1, frames)
    entire = np.concatenate([[0.0], np.euler_gamma + np.log(lag) - sici(lag)[1]])
    number = np.arange(frames)
    noise = np.eye(frames) - 2.0 * corner / rate * entire[np.abs(np.subtract.outer(number, number))]
    solve = np.linalg.pinv(sine_columns(number / rate, frequency))
    exact = 2.0 / frames * np.diag(solve @ noise @ solve.T)[:-1].reshape(-1, 2)
    covariance, _ = amplitude_covariance(frequency, rate, frames, corner)
    np.testing.assert_allclose(np.diagonal(covariance, axis1=1, axis2=2), exact, rtol=2e-3)


def test_published_case():
    far = plan_at(lines_of([106.25], 1), 61.0, Sampling(2000, corner_hz=5.0))  # from everything: the density there
    expected = np.sqrt(2.0 / 2000 * (1.0 + 5.0 / float(alias_frequency(106.25, 61.0))))
    assert far.u_amplitude[0] == pytest.approx(expected, rel=1e-3)
    plan = plan_at(lines_of([106.25], 4), CAMERA_HZ, PUBLISHED)
    np.testing.assert_allclose(plan.lines.frequency_hz, [106.25, 212.5, 318.75, 425.0])
    np.testing.assert_allclose(plan.alias_hz, [0.502, 1.004, 1.506, 2.008], atol=1e-9)
    np.testing.assert_allclose(plan.distance_hz, 0.502, atol=1e-9)
    assert (plan.neighbour_hz[3], plan.distance_bins) == (318.75, pytest.approx(0.502 * 211 / CAMERA_HZ))
    assert plan.duration_s == pytest.approx(3.9906, abs=1e-4)
    assert plan.condition == pytest.approx(
        np.linalg.cond(sine_columns(np.arange(211) / CAMERA_HZ, plan.lines.frequency_hz))
    )
    np.testing.assert_allclose(plan.gain, np.sinc(plan.lines.frequency_hz * 40e-6))
    assert not plan.aliased_harmonics
    # Drift and 1/f noise rule there: three times the uncertainty that white noise alone would leave.
    white = plan_at(lines_of([106.25], 4), CAMERA_HZ, Sampling(211, 40e-6, corner_hz=0.0))
    assert plan.u_amplitude[0] / white.u_amplitude[0] == pytest.approx(np.sqrt(1.0 + 5.0 / 0.502), rel=0.1)


@settings(max_examples=20, deadline=None)
@given(st.floats(20.0, 400.0), st.floats(40.0, 82.0), st.integers(1, 12))
def test_multiples_of_the_rate_have_no_effect(frequency, rate, turns):
    sampling = Sampling(211, harmonics=1)
    first, shifted = (plan_at(lines_of([f], 1), rate, sampling) for f in (frequency, frequency + turns * rate))
    np.testing.assert_allclose(shifted.alias_hz, first.alias_hz, atol=1e-8)
    np.testing.assert_allclose(shifted.distance_hz, first.distance_hz, atol=1e-8)
    if first.condition < 100.0:
        np.testing.assert_allclose(shifted.u_amplitude, first.u_amplitude, rtol=1e-5)


def test_coinciding_lines_are_infinitely_uncertain_and_exposure_reduces_gain():
    plan = plan_at(lines_of([100.0], 1), 50.0, Sampling(211))
    assert np.isinf(plan.u_amplitude).all()
    assert np.isinf(plan.condition)
    assert plan.neighbour_hz[0] == 0.0
    lines = lines_of([1020.3], 1)
    sharp, smeared = (plan_at(lines, 79.427, Sampling(211, exposure, 1)) for exposure in (0.0, 400e-6))
    assert smeared.u_amplitude[0] / sharp.u_amplitude[0] == pytest.approx(1.0 / np.sinc(1020.3 * 400e-6))


def test_harmonics_count_once_and_unfitted_ones_that_fold_are_named():
    lines = lines_of([50.0, 100.0], 3)
    assert (lines.frequency_hz.tolist(), lines.fundamentals_hz.tolist()) == ([50, 100, 200, 150, 300], [50, 100])
    assert lines_of([53.7], 3).frequency_hz == pytest.approx([53.7, 107.4, 161.1])
    # 4·120 and 6·120 Hz come back at 80 Hz, like 120 Hz itself.
    plan = plan_at(lines_of([120.0], 3), 200.0, Sampling(400))
    assert {fold.frequency_hz for fold in plan.aliased_harmonics} >= {480.0, 720.0}


def test_condition_over_rate_is_that_of_the_design_matrices():
    lines = lines_of([375.9], 5)
    rates = np.sort(np.random.default_rng(0).uniform(41.0, 82.0, 40))
    for frames in (211, 210):
        direct = [np.linalg.cond(sine_columns(np.arange(frames) / rate, lines.frequency_hz)) for rate in rates]
        np.testing.assert_allclose(condition_over_rate(lines, rates, frames), direct, rtol=1e-6)
    assert condition_over_rate(lines, np.array([375.9 / 7.0]), 211)[0] > 1e6


def test_margins_are_separations_less_the_tolerance():
    lines = lines_of([106.25], 5)
    exact = scan_rates(lines, RATES, Sampling(211, tolerance=0.0))
    direct = [separation_bins(lines.frequency_hz, rate, 211) for rate in RATES]
    np.testing.assert_allclose(exact.margin_bins, direct, atol=1e-6)
    rough = scan_rates(lines, RATES, Sampling(211, tolerance=1e-4))
    assert np.all(rough.margin_bins < exact.margin_bins)
    # Frequencies anywhere within the tolerance keep what the margin promises.
    for i in np.flatnonzero(rough.clear)[::97]:
        for shift in (-1e-4, 1e-4):
            assert separation_bins(lines.frequency_hz * (1.0 + shift), RATES[i], 211) >= CLEAR_BINS - 1e-9


def test_best_rates_are_clear_preferred_and_distinct():
    lines, sampling = lines_of([106.25], 5), Sampling(211, tolerance=1e-4)
    scan = scan_rates(lines, RATES, sampling)
    chosen = best_rates(scan)
    assert len(chosen) == 3
    assert min(abs(a - b) for a in chosen for b in chosen if a != b) > 0.02 * 40.9
    worst = [plan_at(lines, rate, sampling).u_amplitude.max() for rate in chosen]
    for rate in chosen:
        plan = plan_at(lines, rate, sampling)
        assert plan.distance_bins > CLEAR_BINS
        assert PREFERRED[0] <= plan.alias_hz[0] / rate <= PREFERRED[1]
        assert not plan.aliased_harmonics
    together = scan_rates(lines_of([100.0, 100.001], 1), RATES, Sampling(211))
    assert best_rates(together) == fewest_rates([together]) == ()
    # No other good rate is better by more than the 5 % that the distance between the lines may cost.
    others = [plan_at(lines, float(rate), sampling).u_amplitude.max() for rate in RATES[scan.good][::41]]
    assert worst[0] <= 1.07 * min(others)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 8))
def test_few_rates_serve_every_point_that_can_be_served(seed, points, rates):
    rng = np.random.default_rng(seed)
    grid = np.arange(1.0, rates + 1.0)
    scans = [
        RateScan(
            grid, 3.0 * rng.random(rates), 1.0 + rng.random(rates), rng.integers(0, 2, rates), rng.random(rates) < 0.7
        )
        for _ in range(points)
    ]
    chosen = fewest_rates(scans)
    served = [index for _, indices in chosen for index in indices]
    assert sorted(served) == [i for i, scan in enumerate(scans) if scan.good.any()]
    for rate, indices in chosen:
        assert all(scans[i].good[int(rate) - 1] for i in indices)
    common = np.all([scan.good for scan in scans], axis=0)
    if common.any():
        assert len(chosen) == 1


def test_one_rate_serves_all_twelve_frequencies_of_a_sweep():
    sampling = Sampling(211, 40e-6, tolerance=1e-4)
    points = [lines_of([f], 5) for f in np.linspace(53.7, 1020.3, 12)]
    rates = candidate_rates(points, sampling, (41.0, 82.0), 1e-3)
    assert np.diff(rates).max() <= 41.0 * 82.0 / (211 * 2 * 5101.5)  # never wider than a narrow meeting of two lines
    ((rate, indices),) = fewest_rates([scan_rates(lines, rates, sampling) for lines in points])
    assert indices == tuple(range(12))
    for lines in points:
        plan = plan_at(lines, rate, sampling)
        assert plan.condition < 3.0
        assert PREFERRED[0] <= plan.alias_hz[0] / rate <= PREFERRED[1]


def test_wrong_calls_are_refused_by_name():
    lines = [lines_of([106.25], 5)]
    refused("limits_hz", candidate_rates, lines, PUBLISHED, (50.0, 40.0), 1e-3)
    refused("step_hz", candidate_rates, lines, PUBLISHED, (40.0, 50.0), 0.0)
    refused("^limits_hz: ", candidate_rates, lines, PUBLISHED, (40.1, 40.4), 0.5)
    refused("^frames, harmonics: .* 4 ", Sampling, 3)
    refused("^exposure_s: .*-1", Sampling, 211, -1.0)
    refused("^fundamentals_hz: ", lines_of, [106.25, -1.0], 5)
    refused("^frames: .* 11 ", amplitude_covariance, 106.25 * np.arange(1, 6), CAMERA_HZ, 11)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [CAMERA_HZ, 57.565, 43.901])
def test_simulated_scatter_equals_the_planned_one(rate):
    """Standard deviation of the fundamental's amplitude over fits of simulated frames."""
    rng = np.random.default_rng(2)
    plan = plan_at(lines_of([106.25], 5), rate, PUBLISHED)
    time, length = np.arange(211) / rate, 16 * 211
    density = np.concatenate([[0.0], 5.0 / np.fft.rfftfreq(length, 1.0 / rate)[1:]])
    found = []
    for _ in range(500):
        white = np.fft.rfft(rng.normal(size=(length, 10)), axis=0)
        pink = np.fft.irfft(white * np.sqrt(density)[:, None], length, axis=0)
        phase = rng.uniform(0.0, 2.0 * np.pi, 10)
        clean = 100.0 * plan.gain[0] * np.cos(2.0 * np.pi * 106.25 * time[:, None] + phase)
        values = clean + rng.normal(size=(211, 10)) + pink[:211]
        fit = fit_sines(time, values, plan.lines.frequency_hz, [str(i) for i in range(10)], ["m"] * 10)
        found.append(np.abs(fit.phasors.value[0]) / plan.gain[0])
    assert np.std(np.concatenate(found)) / plan.u_amplitude[0] == pytest.approx(1.0, abs=0.03)
