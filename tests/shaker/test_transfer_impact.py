"""Transfer functions of blows: exact under any window, hits that do not count left out, a real beam."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from oscillator_factory import F0_HZ, ZETA, accelerance, blow, deviations
from scipy.stats import f as fisher

from shaker.frf.impact import transfer_impact
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.identification.measured import MeasuredCurve
from shaker.identification.oscillator import fit_resonance
from shaker.io import read_channels

RATE = 25600.0
BAND = (500.0, 2500.0)


def blows(count: int, noise: float = 0.0, seed: int = 0) -> TransferRecord:
    """Blows half a second apart, of different height and width, noise a share of the largest force and response."""
    rng = np.random.default_rng(seed)
    pairs = [blow(12800, RATE, 2560, 100 * rng.uniform(0.6, 1.2), 8e-5 * rng.uniform(0.9, 1.2)) for _ in range(count)]
    force, response = (np.concatenate(part) for part in zip(*pairs, strict=True))
    force += noise * 100.0 * rng.standard_normal(len(force))
    response += noise * np.abs(response).max() * rng.standard_normal(len(force))
    return TransferRecord(force, response[:, None], RATE, "hammer", "N", ("top",), ("m/s^2",))


def error(found: TransferFunction) -> NDArray[np.complex128]:
    s = np.asarray(found.added_decay_per_s + 2j * np.pi * found.ratio.frequency_hz, dtype=np.complex128)
    return found.ratio.value[:, 0] - accelerance(s)


@pytest.mark.parametrize(("window_s", "decay"), [(0.38, 0.0), (0.1, 120.0), (0.05, 300.0)])
def test_an_exponential_window_moves_the_transfer_function_to_another_s_and_no_more(
    window_s: float, decay: float
) -> None:
    found = transfer_impact(blows(2), window_s, pretrigger_s=0.002, added_decay_per_s=decay, band_hz=BAND)
    assert np.max(np.abs(error(found))) < 2e-4 * np.max(np.abs(found.ratio.value))
    # Without the window taken off, damping would read a/ω₀ too high.
    fit = fit_resonance(MeasuredCurve.of(found, "top", BAND), "accelerance")
    assert fit.frequency_hz == pytest.approx(F0_HZ, rel=1e-5)
    assert fit.damping_ratio == pytest.approx(ZETA, rel=1e-3)


def test_a_window_is_taken_only_where_the_response_outlasts_it() -> None:
    assert transfer_impact(blows(3, 1e-3), 0.38).added_decay_per_s == 0.0
    short = transfer_impact(blows(3, 1e-3), 0.05)
    # Decay of the oscillator: 70.3/s.
    assert 50.0 < short.added_decay_per_s < 250.0
    assert any("exponential window" in n.text for n in short.notices)


def test_regions_of_95_percent_cover() -> None:
    inside = []
    for seed in range(8):
        found = transfer_impact(blows(5, 1e-3, seed), 0.3, band_hz=BAND)
        inside.append(deviations(error(found), found.channel_covariance("top")) < fisher.ppf(0.95, 2, found.ratio.dof))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_noise_of_the_force_common_to_all_lines_of_a_hit_counts_once() -> None:
    """On resonance the force's noise rules, of which five hits tell 2·(5 - 1) degrees of freedom and no more."""
    inside = []
    for seed in range(24):
        found = transfer_impact(blows(5, 1e-3, 40 + seed), 0.3, band_hz=BAND)
        near = np.abs(found.ratio.frequency_hz - F0_HZ) < 5.0
        dof = found.ratio.dof
        assert dof is not None
        assert np.max(dof[near]) < 0.6 * np.median(dof)
        length = deviations(error(found), found.channel_covariance("top"))
        inside.append(np.mean(length[near] < fisher.ppf(0.95, 2, dof[near])))
    # Lines of one record share that noise: 24 independent trials, standard deviation of the share 4.5 %.
    assert np.mean(inside) > 0.95 - 3.0 * 0.045


def test_a_single_blow_has_the_uncertainty_of_the_noise_before_it() -> None:
    inside = []
    for seed in range(8):
        found = transfer_impact(blows(1, 1e-3, seed), 0.3, band_hz=BAND)
        inside.append(deviations(error(found), found.channel_covariance("top")) < fisher.ppf(0.95, 2, found.ratio.dof))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.025)
    assert any("a single hit" in n.text for n in found.notices)
    blind = transfer_impact(blows(1, 1e-3), 0.3, pretrigger_s=0.0, band_hz=BAND)
    assert np.isnan(blind.ratio.covariance).all()


def test_double_hits_overloads_and_cut_windows_do_not_count() -> None:
    data = blows(5, 1e-3)
    force = data.reference.copy()
    force[12800 + 2560 + 700 : 12800 + 2560 + 720] += 20.0
    found = transfer_impact(replace(data, reference=force), 0.39, band_hz=BAND)
    told = [n.text for n in found.notices if n.severity == "warning"]
    assert len(told) == 1
    assert "hit 2" in told[0]
    assert "second pulse" in told[0]
    assert found.averages[0] == 4.0
    clipped = replace(data, responses=np.minimum(data.responses, 0.7 * data.responses.max()))
    few = transfer_impact(clipped, 0.39, band_hz=BAND)
    assert any("overloaded" in n.text for n in few.notices)
    assert few.averages[0] < 5.0
    late = transfer_impact(data, 0.45, band_hz=BAND)
    assert any("record ends before" in n.text for n in late.notices)


def test_nothing_but_noise_and_hits_that_do_not_count_are_refused() -> None:
    noise = np.random.default_rng(2).standard_normal(20000)
    quiet = TransferRecord(noise, noise[:, None], RATE, "hammer", "N", ("top",), ("m/s^2",))
    with pytest.raises(ValueError, match="only noise in hammer"):
        transfer_impact(quiet, 0.1)
    with pytest.raises(ValueError, match="record ends before"):
        transfer_impact(blows(1), 0.45)
    with pytest.raises(ValueError, match="duration_s"):
        transfer_impact(blows(1), 0.001)


def test_scales_and_polarity_move_the_ratio() -> None:
    data = blows(3, 1e-3)
    one = transfer_impact(data, 0.3, band_hz=BAND).ratio.value
    other = transfer_impact(replace(data, reference=-3.0 * data.reference), 0.3, band_hz=BAND).ratio.value
    np.testing.assert_allclose(other, -one / 3.0, rtol=1e-9)


def beam(data_dir: Path, name: str) -> TransferRecord:
    """Hammer and accelerometer of the tutorial's beam; labels of units are the files' own."""
    channels = read_channels(data_dir / "undersampled_video" / name)
    force, acceleration = channels["Force (Trigger)"], channels["Acceleration (Trigger)"]
    samples = acceleration.samples[:, None] * 9.80665
    return TransferRecord(force.samples, samples, force.sample_rate_hz, "force", "N", ("acceleration",), ("m/s^2",))


def test_the_modes_of_a_real_beam(data_dir: Path) -> None:
    found = transfer_impact(beam(data_dir, "acceleration.lvm"), 0.999, pretrigger_s=5e-4)
    for low, high, known, within in (
        (10.0, 30.0, 18.0, 0.5),
        (650.0, 740.0, 695.6, 0.3),
        (1800.0, 2000.0, 1897.9, 0.3),
    ):
        fit = fit_resonance(MeasuredCurve.of(found, "acceleration", (low, high)), "accelerance", residual_terms=True)
        assert fit.frequency_hz == pytest.approx(known, abs=within)
    assert found.added_decay_per_s > 0.0


def test_the_overload_of_a_real_record_is_told(data_dir: Path) -> None:
    with pytest.raises(ValueError, match="overloaded"):
        transfer_impact(beam(data_dir, "camera.lvm"), 0.999, pretrigger_s=5e-4)
