"""Lines found and refined, against simulated records."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.lines.frequencies import find_lines
from shaker.sine.fit import fit_sines
from shaker.sine.solve import SineModel

RATE = 12_800.0
TRUE_HZ = 106.2495


def _record(
    rng: np.random.Generator, amplitudes: dict[int, float], noise: float = 0.5, seconds: float = 4.0
) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(int(seconds * RATE)) / RATE
    values = noise * rng.normal(size=len(time))
    for multiple, amplitude in amplitudes.items():
        values += amplitude * np.cos(2 * np.pi * multiple * TRUE_HZ * time + rng.uniform(0.0, 2 * np.pi))
    return time, values


def _refined(time: np.ndarray, values: np.ndarray, start: float, multiples: tuple[int, ...]) -> tuple[float, float]:
    """Return a fundamental refined jointly with its harmonics, and its standard uncertainty."""
    names = [str(c) for c in range(values.shape[1])]
    model = SineModel(free=(0,) * len(multiples))
    fit = fit_sines(time, values, start * np.array(multiples, dtype=float), names, names, model=model)
    return float(fit.phasors.frequency_hz[0]), float(fit.u_frequency_hz[0])


def test_published_excitation_is_found() -> None:
    # 189.3 m/s^2 with 0.96 m/s^2 at the fourth harmonic, nominal 106.25 Hz.
    time, values = _record(np.random.default_rng(0), {1: 189.3217, 4: 0.9596})
    lines = find_lines(time, values, [106.25])
    assert lines.multiple.tolist() == [1, 4]
    assert lines.nominal_hz.tolist() == [106.25, 106.25]
    np.testing.assert_allclose(lines.frequency_hz, [TRUE_HZ, 4 * TRUE_HZ], atol=6 * lines.u_frequency_hz[1])
    assert lines.u_frequency_hz[1] == pytest.approx(4 * lines.u_frequency_hz[0])
    assert "fundamental" in lines.why[0]
    assert "harmonic 4 of 106.25 Hz stands out" in lines.why[1]
    assert not lines.notices


def test_harmonics_of_a_ten_thousandth_are_found_and_nothing_else() -> None:
    for seed in range(3):
        time, values = _record(np.random.default_rng(seed), {1: 100.0, 2: 0.01, 5: 0.012}, noise=0.1)
        assert find_lines(time, values, [106.25]).multiple.tolist() == [1, 2, 5]


def test_noise_alone_adds_no_harmonic() -> None:
    rng = np.random.default_rng(1)
    extra = sum(
        len(find_lines(*_record(rng, {1: 100.0}, noise=1.0, seconds=1.0), [106.25]).multiple) - 1 for _ in range(40)
    )
    # Expected 0.04 at the stated 1e-3 per record.
    assert extra <= 1


def test_rounding_is_no_harmonic() -> None:
    time, values = _record(np.random.default_rng(2), {1: 190.0}, noise=0.0)
    assert find_lines(time, values, [106.25]).multiple.tolist() == [1]


def test_refined_frequency_reaches_the_bound() -> None:
    rng = np.random.default_rng(3)
    seconds, noise, amplitude = 1.0, 1.0, 10.0
    errors, stated = [], []
    for _ in range(80):
        time, values = _record(rng, {1: amplitude}, noise, seconds)
        refined = _refined(time, values[:, None], 106.3, (1,))
        errors.append(refined[0] - TRUE_HZ)
        stated.append(refined[1])
    # Rife and Boorstyn 1974: var f = 6 σ² / (π² a² N T²) for real sines.
    bound = np.sqrt(6.0 * noise**2 / (np.pi**2 * amplitude**2 * seconds * RATE)) / seconds
    assert np.std(errors) == pytest.approx(bound, rel=0.25)
    assert abs(np.mean(errors)) < 4.0 * bound / np.sqrt(80)
    assert np.mean(stated) == pytest.approx(bound, rel=0.1)


def test_harmonics_and_channels_sharpen_the_frequency() -> None:
    rng = np.random.default_rng(4)
    time, values = _record(rng, {1: 1.0, 3: 1.0}, 1.0, 1.0)
    alone = _refined(time, values[:, None], 106.25, (1,))
    joint = _refined(time, values[:, None], 106.25, (1, 3))
    pair = np.stack([values, 1e-3 * _record(rng, {1: 1.0, 3: 1.0}, 1.0, 1.0)[1]], axis=1)
    two = _refined(time, pair, 106.25, (1, 3))
    assert joint[1] == pytest.approx(alone[1] / np.sqrt(10.0), rel=0.15)
    assert two[1] == pytest.approx(joint[1] / np.sqrt(2.0), rel=0.15)


@settings(max_examples=8, deadline=None)
@given(st.floats(0.1, 10.0), st.floats(-1e-3, 1e-3))
def test_frequency_follows_the_clock(scale: float, stretch: float) -> None:
    time, values = _record(np.random.default_rng(5), {1: 10.0}, 0.1, 0.5)
    plain = _refined(time, values[:, None], 106.25, (1,))
    other = _refined(time * (1 + stretch), scale * values[:, None], 106.25, (1,))
    assert other[0] * (1 + stretch) == pytest.approx(plain[0], rel=1e-9)


def test_several_fundamentals_share_a_harmonic_once() -> None:
    time = np.arange(40_000) / 10_000.0
    rng = np.random.default_rng(6)
    values = 0.01 * rng.normal(size=len(time))
    for f, a in ((100.0, 1.0), (150.0, 1.0), (300.0, 0.1)):
        values += a * np.sin(2 * np.pi * f * time)
    lines = find_lines(time, values, [150.0, 100.0])
    np.testing.assert_allclose(lines.frequency_hz, [100.0, 150.0, 300.0], atol=1e-3)
    assert lines.multiple.tolist() == [1, 1, 2]


def test_listed_harmonics_are_taken_as_they_are() -> None:
    time, values = _record(np.random.default_rng(7), {1: 100.0})
    lines = find_lines(time, values, [106.25], [2, 3, 100])
    assert lines.multiple.tolist() == [1, 2, 3]
    assert "asked for" in lines.why[1]
    assert "harmonic 100 of 106.25 Hz lies above 6272 Hz" in lines.notices[0].text
    with pytest.raises(ValueError, match="harmonics: expected multiples of 1 and above, found 0"):
        find_lines(time, values, [106.25], [0])


def test_mains_is_told_and_is_no_line() -> None:
    time, values = _record(np.random.default_rng(8), {1: 100.0})
    lines = find_lines(time, values + 0.5 * np.sin(2 * np.pi * 50.01 * time), [106.25])
    assert lines.multiple.tolist() == [1]
    assert [n.severity for n in lines.notices] == ["info"]
    assert "mains hum (50 Hz)" in lines.notices[0].text
    assert [origin.kind for origin in lines.others.origin] == ["mains"]
    # Rife and Boorstyn 1974 as below, for noise as strong as the hum: 0.9 mHz, and 3 mm/s² for its amplitude
    # (σ·sqrt(2/N)); the window through which the spectrum is seen may cost up to half of it more.
    bound_hz, bound = np.sqrt(6.0 / len(time)) / (np.pi * 4.0), 0.5 * np.sqrt(2.0 / len(time))
    assert 1.0 < lines.others.u_frequency_hz[0] / bound_hz < 2.0
    np.testing.assert_allclose(lines.others.frequency_hz, [50.01], atol=4.0 * 1.5 * bound_hz)
    np.testing.assert_allclose(lines.others.amplitude, [[0.5]], atol=4.0 * 1.5 * bound)


def test_a_neighbour_that_leaks_is_fitted_too() -> None:
    rng = np.random.default_rng(20)
    time = np.arange(12_800) / RATE
    error: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(12):
        hum = 0.02 * np.cos(2 * np.pi * 50.03 * time + rng.uniform(0.0, 2 * np.pi))
        values = np.cos(2 * np.pi * 53.7 * time) + hum + 0.01 * rng.normal(size=len(time))
        lines = find_lines(time, values, [53.7])
        assert lines.multiple.tolist() == [1]
        np.testing.assert_allclose(lines.nuisance_hz, [50.03], atol=0.05)
        assert abs(lines.frequency_hz[0] - 53.7) < 5 * lines.u_frequency_hz[0]
        for use, found in error.items():
            frequency = np.append(53.7, lines.nuisance_hz if use else [])
            fit = fit_sines(time, values[:, None], frequency, ["a"], ["m/s^2"])
            found.append(abs(fit.phasors.value[0, 0] - 1.0))
    # Noise alone: 0.01·sqrt(4/12800) = 1.8e-4 for both quadratures; the hum leaks up to 0.02/(π·3.7) = 1.7e-3.
    assert np.sqrt(np.mean(np.square(error[True]))) < 2.6e-4
    assert np.sqrt(np.mean(np.square(error[False]))) > 1e-3


def test_everything_else_is_in_the_list_with_a_reason() -> None:
    time, values = _record(np.random.default_rng(21), {1: 100.0, 2: 1.0, 25: 0.2})
    rng = np.random.default_rng(22)
    for frequency, amplitude in ((TRUE_HZ / 2, 0.2), (150.06, 0.2), (777.7, 0.2)):
        values += amplitude * np.cos(2 * np.pi * frequency * time + rng.uniform(0.0, 2 * np.pi))
    lines = find_lines(time, values, [106.25])
    assert lines.multiple.tolist() == [1, 2]
    assert [o.kind for o in lines.others.origin] == ["sub-harmonic", "mains", "unexplained", "harmonic"]
    assert lines.others.origin[-1].multiple == 25
    assert all("dB over the noise floor" in why for why in lines.others.why)
    assert "and 1 more" in lines.notices[0].text


def test_absent_fundamental_is_refused() -> None:
    time, values = _record(np.random.default_rng(9), {1: 100.0})
    with pytest.raises(ValueError, match=r"nominal_hz: expected 120 Hz to stand out of the spectrum"):
        find_lines(time, values, [120.0])


def test_undersampled_fundamental_is_found_at_its_alias() -> None:
    rng = np.random.default_rng(10)
    time = np.arange(211) / 52.874
    values = np.cos(2 * np.pi * TRUE_HZ * time + 1.0) + 0.005 * rng.normal(size=211)
    lines = find_lines(time, values, [106.25], [1])
    assert lines.frequency_hz[0] == pytest.approx(TRUE_HZ, abs=5 * lines.u_frequency_hz[0])
    # The published bound for comparison: 7e-5 Hz at the published noise.
    assert lines.u_frequency_hz[0] < 3e-4


def test_gaps_are_allowed_and_scattered_times_are_not() -> None:
    time, values = _record(np.random.default_rng(11), {1: 100.0}, 0.5, 1.0)
    values[1000:1200] = np.nan
    assert find_lines(time, values, [106.25]).frequency_hz[0] == pytest.approx(TRUE_HZ, abs=1e-3)
    with pytest.raises(ValueError, match="time_s: expected ascending times on a uniform grid"):
        find_lines(np.sort(np.random.default_rng(0).uniform(0, 1, 500)), values[:500], [106.25])


def test_dead_channels_are_passed_over() -> None:
    time, values = _record(np.random.default_rng(12), {1: 100.0}, 0.5, 1.0)
    both = np.stack([np.full(len(time), 3.0), values], axis=1)
    assert find_lines(time, both, [106.25]).frequency_hz[0] == find_lines(time, values, [106.25]).frequency_hz[0]
    with pytest.raises(ValueError, match="values: expected a channel that changes"):
        find_lines(time, both[:, 0], [106.25])
