"""Transfer functions of periodic excitation: exact without noise, covered with it, honest about what periods show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from oscillator_factory import F0_HZ, chirp, deviations, periodic, record, transmissibility
from scipy.stats import f as fisher

from shaker.frf.periodic import transfer_periodic
from shaker.frf.result import TransferFunction, TransferRecord, pooled_scatter

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
RATE, LENGTH = 12800.0, 4096


@cache
def clean_pair(period: float, periods: float) -> tuple[FloatArray, FloatArray]:
    harmonic, phasor = chirp(period, RATE, (200.0, 3000.0))
    samples = int(periods * LENGTH)
    both = np.column_stack([phasor, phasor * transmissibility(harmonic * RATE / period)])
    base, top = periodic(harmonic, both, period, samples).T
    return base, top


def chirp_record(period: float, periods: float = 4.0, noise: float = 0.0, seed: int = 0) -> TransferRecord:
    return record(*clean_pair(period, periods), RATE, noise, seed)


def error(found: TransferFunction) -> ComplexArray:
    return found.ratio.value[:, 0] - transmissibility(found.ratio.frequency_hz)


@pytest.mark.parametrize(("period", "exact"), [(4096.0, 1e-9), (4096.0 * (1 + 20e-6), 1e-5), (4093.2, 1e-5)])
def test_a_chirp_without_noise_gives_the_transfer_function_whatever_its_period(period: float, exact: float) -> None:
    found = transfer_periodic(chirp_record(period, 4.1), LENGTH / RATE)
    truth = transmissibility(found.ratio.frequency_hz)
    assert found.ratio.frequency_hz[0] == pytest.approx(200.0, abs=4.0)
    assert found.ratio.frequency_hz[-1] == pytest.approx(3000.0, abs=4.0)
    assert found.line_spacing_hz == pytest.approx(RATE / period, rel=1e-9)
    assert np.max(np.abs(found.ratio.value[:, 0] / truth - 1.0)) < exact


@pytest.mark.parametrize("period", [4096.0, 4096.0 * (1 + 20e-6)])
def test_regions_of_95_percent_cover_every_line_as_often(period: float) -> None:
    inside, size = [], []
    for seed in range(6):
        found = transfer_periodic(chirp_record(period, 4.0, 1e-2, seed), LENGTH / RATE)
        lengths = deviations(error(found), found.channel_covariance("top"))
        inside.append(lengths < fisher.ppf(0.95, 2, found.ratio.dof))
        size.append(lengths)
    # Some 900 lines a record, noise pooled over nine: the share's standard deviation is about 0.4 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)
    assert np.mean(size) == pytest.approx(1.04, abs=0.06)


def test_noise_on_the_reference_does_not_bias_the_ratio() -> None:
    close = []
    for seed in range(10):
        found = transfer_periodic(chirp_record(4096.0, 4.0, 0.1, seed), LENGTH / RATE)
        near = np.abs(found.ratio.frequency_hz - F0_HZ) < 12.0
        relative = error(found)[near] / transmissibility(found.ratio.frequency_hz[near])
        close.append(np.mean(relative) / np.sqrt(np.mean(found.ratio.u_re[near] ** 2) / np.count_nonzero(near)))
    # H1 would read low by N_x/S_xx, here half a per cent.
    assert abs(np.mean(close)) < 3.0


def test_a_line_with_mains_keeps_its_own_uncertainty() -> None:
    clean = chirp_record(4096.0, 6.0, 1e-3)
    time = np.arange(len(clean.reference)) / RATE
    hum = clean.responses + 0.3 * np.cos(2 * np.pi * 650.7 * time)[:, None]
    found = transfer_periodic(replace(clean, responses=hum), LENGTH / RATE)
    near = np.argmin(np.abs(found.ratio.frequency_hz - 650.7))
    far = np.abs(found.ratio.frequency_hz - 650.7) > 100.0
    assert found.ratio.u_re[near, 0] > 30.0 * np.median(found.ratio.u_re[far, 0])
    assert deviations(error(found), found.channel_covariance("top"))[near] < 20.0


def test_a_structure_not_settled_is_told_and_leaving_the_period_out_cures_it() -> None:
    settled = chirp_record(4096.0, 5.0, 1e-3)
    time = np.arange(len(settled.reference)) / RATE
    decaying = 5.0 * np.exp(-np.pi * F0_HZ / 66.0 * time) * np.cos(2 * np.pi * F0_HZ * time)
    unsettled = replace(settled, responses=settled.responses + decaying[:, None])
    told = [n for n in transfer_periodic(unsettled, LENGTH / RATE).notices if n.severity == "warning"]
    assert [n.where for n in told] == ["top"]
    assert "had not settled" in told[0].text
    cured = transfer_periodic(unsettled, LENGTH / RATE, settle_periods=1)
    assert not [n for n in cured.notices if n.severity == "warning"]
    assert cured.averages[0] == 4.0


def test_a_response_that_drifts_over_the_periods_is_told() -> None:
    steady = chirp_record(4096.0, 6.0, 1e-3)
    grows = 1.0 + 1e-2 * np.arange(len(steady.reference)) / len(steady.reference)
    both = replace(steady, reference=steady.reference * grows, responses=steady.responses * grows[:, None])
    texts = [n.text for n in transfer_periodic(both, LENGTH / RATE).notices]
    assert any("amplitude changes by" in text for text in texts)
    one = replace(steady, responses=steady.responses * grows[:, None])
    assert any("drifts over the periods" in n.text for n in transfer_periodic(one, LENGTH / RATE).notices)


def test_distortions_of_a_multisine_are_told_at_the_lines_it_leaves_out() -> None:
    harmonic = np.setdiff1d(np.arange(81.0, 700.0, 2.0), np.arange(81.0, 700.0, 2.0)[3::4])
    rng = np.random.default_rng(5)
    phasor = np.exp(2j * np.pi * rng.random(len(harmonic))) / np.sqrt(len(harmonic))
    base = periodic(harmonic, phasor, 4096.0, 4 * LENGTH)
    straight = record(base, 2.0 * base, RATE, 1e-4)
    bent = record(base, 2.0 * base + 0.02 * base**2, RATE, 1e-4)
    found = transfer_periodic(straight, LENGTH / RATE)
    np.testing.assert_allclose(found.ratio.frequency_hz, harmonic * RATE / LENGTH, rtol=1e-12)
    assert not [n for n in found.notices if n.severity == "warning"]
    told = [n.text for n in transfer_periodic(bent, LENGTH / RATE).notices if n.severity == "warning"]
    assert len(told) == 1
    assert "even lines" in told[0]
    assert "odd" not in told[0]


def test_several_responses_share_what_the_reference_does_to_them() -> None:
    # Noise of the reference alone: two equal responses have the same error.
    clean = chirp_record(4096.0, 5.0)
    noisy = clean.reference + 1e-2 * np.random.default_rng(3).standard_normal(len(clean.reference))
    twice = TransferRecord(
        noisy, np.repeat(clean.responses, 2, axis=1), RATE, "base", "N", ("a", "b"), ("m/s^2", "m/s^2")
    )
    found = transfer_periodic(twice, LENGTH / RATE).ratio
    assert found.unit == ("(m/s^2)/N", "(m/s^2)/N")
    np.testing.assert_allclose(found.covariance[:, 0, 1], found.covariance[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(found.covariance[:, 0, 3], 0.0, atol=1e-6 * found.covariance[:, 0, 0].max())


@settings(max_examples=10, deadline=None)
@given(gain=st.floats(0.01, 100.0), other=st.floats(-50.0, -0.1), shift=st.integers(1, 2000))
def test_scales_move_the_ratio_and_a_common_shift_does_not(gain: float, other: float, shift: int) -> None:
    data = CHIRP
    found = transfer_periodic(data, LENGTH / RATE)
    scaled = replace(data, reference=data.reference * gain, responses=data.responses * other)
    np.testing.assert_allclose(
        transfer_periodic(scaled, LENGTH / RATE).ratio.value, found.ratio.value * (other / gain), rtol=1e-9
    )
    shifted = replace(data, reference=np.roll(data.reference, shift), responses=np.roll(data.responses, shift, axis=0))
    moved = transfer_periodic(shifted, LENGTH / RATE).ratio
    np.testing.assert_allclose(moved.value, found.ratio.value, atol=5e-2 * np.abs(found.ratio.value).max())
    assert np.median(np.abs(moved.value - found.ratio.value) / found.ratio.u_re) < 2.0


CHIRP = chirp_record(4096.0, 4.0, 1e-3)


def test_channels_may_stand_in_any_order() -> None:
    three = replace(
        CHIRP,
        responses=np.column_stack([CHIRP.responses, 2.0 * CHIRP.reference, np.roll(CHIRP.responses, 5)]),
        channels=("a", "b", "c"),
        unit=("m/s^2",) * 3,
    )
    turned = replace(three, responses=three.responses[:, ::-1], channels=("c", "b", "a"))
    one, other = (transfer_periodic(data, LENGTH / RATE).ratio for data in (three, turned))
    np.testing.assert_allclose(other.select(["a", "b", "c"]).value, one.value, rtol=1e-12)
    np.testing.assert_allclose(other.select(["a", "b", "c"]).covariance, one.covariance, rtol=1e-9, atol=1e-20)


def test_a_loud_line_of_two_periods_and_two_channels_still_has_a_covariance_that_inverts() -> None:
    rng = np.random.default_rng(3)
    error = rng.standard_normal((200, 2)) + 1j * rng.standard_normal((200, 2))
    error[100] *= 30.0
    scatter = error[:, :, None] * error[:, None, :].conj()
    pooled, number = pooled_scatter(scatter, np.ones((200, 2), dtype=np.complex128), 2.0)
    assert number[100] == 1.0
    assert np.linalg.eigvalsh(pooled)[:, 0].min() > 0.0
    assert pooled[100, 0, 0].real > 100.0 * pooled[99, 0, 0].real


def test_what_cannot_be_estimated_is_refused_with_a_reason() -> None:
    with pytest.raises(ValueError, match="at least 2 whole periods after 3"):
        transfer_periodic(CHIRP, LENGTH / RATE, settle_periods=3)
    with pytest.raises(ValueError, match="period_s"):
        transfer_periodic(CHIRP, 1e-4)
    noise = replace(CHIRP, reference=np.random.default_rng(1).standard_normal(len(CHIRP.reference)))
    with pytest.raises(ValueError, match=r"period of the reference within|excites lines"):
        transfer_periodic(noise, LENGTH / RATE)
    with pytest.raises(ValueError, match="found NaN in top"):
        replace(CHIRP, responses=np.where(np.arange(len(CHIRP.reference))[:, None] == 7, np.nan, CHIRP.responses))
    with pytest.raises(ValueError, match="names that differ"):
        replace(CHIRP, channels=("base",))
