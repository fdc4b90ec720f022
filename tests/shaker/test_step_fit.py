"""Models identified from simulated releases: against the truth, against bounds, and with honest intervals."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from contracts import coverage_contract
from scipy.optimize import brentq
from step_fit_factory import (
    AMPLITUDE,
    RATE_HZ,
    SENSOR,
    answered,
    model_of,
    record_of,
    released,
    ring_rms,
    rough,
    sensor,
)

from shaker.arrays import FloatArray
from shaker.lti.system import ModalModel
from shaker.release.fit import fit_step
from shaker.release.sim import StepFit

ONSET = 0.0100026


@cache
def clean() -> FloatArray:
    """The published case, released between two samples."""
    return released(sensor(*SENSOR), onset_s=ONSET)


def fitted(level_db: float, seed: int, method: str = "pencil") -> StepFit:
    output = clean()
    record = record_of(output, ring_rms(output, ONSET) * 10 ** (-level_db / 20), seed)
    return fit_step(record, "Fz", reading=rough(record, ONSET), modes=1, real_poles=1, method=method)  # type: ignore[arg-type]


def scores(fit: StepFit) -> FloatArray:
    """Return errors of frequency, damping and low-pass over their standard uncertainties, and of the static gain."""
    model, u = model_of(fit)
    gain, variance = model.propagate(lambda m: np.array([m.static_gain]))
    own = (model.vector[[0, 1, 4]] - np.array([1700.0, 0.015, 6000.0])) / u[[0, 1, 4]]
    return np.append(own, (gain[0] - 1.0) / np.sqrt(variance[0, 0]))


@pytest.mark.parametrize(("level", "frequency", "damping"), [(60, 2e-6, 1e-4), (40, 2e-5, 1e-3), (20, 2e-4, 5e-3)])
def test_published_case_within_its_bars(level: int, frequency: float, damping: float) -> None:
    errors = []
    for seed in range(9):
        model, _ = model_of(fitted(level, seed))
        errors.append([abs(model.frequency_hz[0] / 1700.0 - 1.0), abs(model.damping_ratio[0] / 0.015 - 1.0)])
    assert np.all(np.median(errors, axis=0) < [frequency, damping])
    if level < 60:
        assert np.all(np.max(errors, axis=0) < [frequency, 3 * damping])


def test_uncertainty_is_the_cramer_rao_bound_of_a_decaying_sine() -> None:
    """The variance is 2 s² Δ (2σ)³/A² for the decay rate σ of A·exp(-σt)·cos(ωt) in white noise, and the same for ω."""
    model, u = model_of(fitted(40, 1))
    decay, noise = 2 * np.pi * 1700.0 * 0.015, ring_rms(clean(), ONSET) * 0.01
    amplitude = 2 * abs(model.residue[0] / model.poles[0])
    bound = np.sqrt(2 * noise**2 / RATE_HZ * (2 * decay) ** 3) / amplitude
    np.testing.assert_allclose(u[:2], [bound / (2 * np.pi), bound / (2 * np.pi * 1700.0)], rtol=0.05)


def test_both_starts_reach_the_same_optimum() -> None:
    pencil, arx = (model_of(fitted(40, 3, method))[0] for method in ("pencil", "arx"))
    np.testing.assert_allclose(arx.vector, pencil.vector, rtol=1e-4)


def test_intervals_hold_the_truth() -> None:
    """Errors at 40 dB over their u: resonance, damping, low-pass, static gain."""
    coverage_contract(lambda seed: (scores(fitted(40, 100 + seed)), np.full(4, 1.96)), np.zeros(4), 16)


def band_hz(model: ModalModel) -> float:
    """Return where the gain first exceeds that at rest by 5 %."""
    return float(brentq(lambda hz: abs(model.response(np.array([hz]))[0] / model.static_gain) - 1.05, 10.0, 1500.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "low_pass", "level"),
    [(0.0, (6000.0,), 40), (0.0, (), 40), (0.0, (6000.0,), 25), (1.5e-4, (6000.0,), 40), (4e-4, (6000.0,), 40)],
)
def test_intervals_hold_whatever_the_release_was(length: float, low_pass: tuple[float, ...], level: int) -> None:
    """Structure and release by rule, record by record: resonance, damping, static gain, ±5 % band."""
    true = sensor(*SENSOR[:1], low_pass)
    modal = ModalModel.from_system(true)
    truth = np.array([1700.0, 0.015, 1.0, band_hz(modal)])
    output = released(true, onset_s=ONSET, length_s=length)
    noise = ring_rms(released(true, onset_s=ONSET), ONSET) * 10 ** (-level / 20)

    def estimate(trial: int) -> tuple[FloatArray, FloatArray]:
        model, _ = model_of(fit_step(record_of(output, noise, 2000 + trial), "Fz"))
        value, covariance = model.propagate(
            lambda m: np.array([m.frequency_hz[0], m.damping_ratio[0], m.static_gain, band_hz(m)])
        )
        return value, 1.96 * np.sqrt(np.diag(covariance))

    coverage_contract(estimate, truth, 12)


def test_coloured_noise_enlarges_the_uncertainty() -> None:
    """Noise that a filter at 5 kHz leaves of white one has its density, not its variance, at the mode."""
    from scipy.signal import butter, sosfilt

    output, found = clean(), []
    for seed in range(12):
        white = np.random.default_rng(seed).standard_normal(len(output) + 500)
        noise = 2e-3 * sosfilt(butter(4, 5e3, fs=RATE_HZ, output="sos"), white)[500:]
        record = record_of(output + noise, 0.0, 0)
        fit = fit_step(record, "Fz", reading=rough(record, ONSET), modes=1, real_poles=1)
        assert any("coloured" in notice.text for notice in fit.notices)
        found.append(scores(fit)[:2])
    assert 0.6 < np.sqrt(np.mean(np.square(found))) < 1.5


def test_a_coarse_converter_is_in_the_uncertainty_of_the_gain() -> None:
    output, step = clean(), AMPLITUDE / 100
    for offset in (0.0, 0.3, 0.6):
        record = record_of(output, 1e-5, 1)
        samples = step * np.round(record.samples / step + offset)
        coarse = type(record)("coarse", ("Fz",), "mV", samples, RATE_HZ, "Fz", AMPLITUDE)
        found = scores(fit_step(coarse, "Fz", reading=rough(coarse, ONSET), modes=1, real_poles=1))
        assert abs(found[3]) < 2.5


@pytest.mark.parametrize("length", [0.0, 4e-4])
def test_two_modes_and_a_release_that_takes_its_time(length: float) -> None:
    """The release's length is found, and the poles are those of the sensor whatever it was."""
    modes = ((450.0, 0.004), (1120.0, 0.008))
    output = released(sensor(modes, (6000.0,)), onset_s=0.0200012, length_s=length, count=12000)
    record = record_of(output, 1e-3, 5)
    fit = fit_step(record, "Fz", reading=rough(record, 0.0200012, length, 5e-4), modes=2, real_poles=1)
    model, u = model_of(fit)
    truth = np.array([450.0, 1120.0, 0.004, 0.008])
    assert np.all(np.abs(model.vector[:4] - truth) < 4 * u[:4])
    np.testing.assert_allclose(model.vector[:2], truth[:2], rtol=3e-5)
    assert abs(fit.release_s - length) < max(4 * fit.u_release_s, 3e-5)


def test_order_is_found_by_rule() -> None:
    """One mode and two modes, each with a low-pass filter, at 40 dB."""
    record = record_of(clean(), 2e-3, 2)
    assert fit_step(record, "Fz", reading=rough(record, ONSET)).order == 3
    both = released(sensor(((900.0, 0.01), (1700.0, 0.015)), (6000.0,)), onset_s=ONSET)
    record = record_of(both, 2e-3, 2)
    two, _ = model_of(fit_step(record, "Fz", reading=rough(record, ONSET, rise_s=3e-4)))
    np.testing.assert_allclose(two.frequency_hz, [900.0, 1700.0], rtol=2e-3)


def test_measured_force_needs_no_onset() -> None:
    """A force of any shape, sampled: the exact answer to it comes from scipy's matrix exponential."""
    time_s = np.arange(4000) / RATE_HZ
    force = AMPLITUDE * np.clip((time_s - 0.01) / 7e-4, 0, 1) * (1 + 0.1 * np.sin(900 * time_s))
    output = answered(sensor(*SENSOR), force / AMPLITUDE, 1 / RATE_HZ)
    record = record_of(output, 3e-4, 7, force=force + 3.0)
    fit = fit_step(record, "Fz", reading=rough(record, 0.01, 7e-4), modes=1, real_poles=1)
    assert np.all(np.abs(scores(fit)) < 4.0)
    assert fit.u_release_s == 0.0


def test_load_uncertainty_joins_the_gain() -> None:
    output = clean()
    record = record_of(output, 1e-3, 1)
    doubtful = type(record)("r", ("Fz",), "mV", record.samples, RATE_HZ, "Fz", AMPLITUDE, u_amplitude=0.01)
    fit = fit_step(doubtful, "Fz", reading=rough(doubtful, ONSET), modes=1, real_poles=1)
    gain, variance = model_of(fit)[0].propagate(lambda model: np.array([model.static_gain]))
    assert np.sqrt(variance[0, 0]) / gain[0] == pytest.approx(0.01, rel=0.02)


def test_an_unstable_mode_is_told() -> None:
    time_s = np.arange(4000) / RATE_HZ
    after = np.maximum(time_s - 0.01, 0.0)
    output = np.where(after > 0, 1.0 - np.exp(20 * after) * np.cos(2 * np.pi * 1500 * after), 0.0)
    record = record_of(output, 1e-3, 1)
    fit = fit_step(record, "Fz", reading=rough(record, 0.01), modes=1, real_poles=0)
    assert any("unstable" in notice.text for notice in fit.notices)
    assert fit.model is not None
    assert fit.model.damping_ratio[0] == pytest.approx(-20 / (2 * np.pi * 1500), rel=0.05)


def test_no_ring_and_no_force_are_refused() -> None:
    record = record_of((np.arange(4000) / RATE_HZ > 0.01).astype(float), 1e-2, 1)
    with pytest.raises(ValueError, match="no oscillation above the noise"):
        fit_step(record, "Fz", reading=rough(record, 0.01))
    record = record_of(clean(), 1e-3, 1)
    with pytest.raises(ValueError, match="release: expected"):
        fit_step(record, "Fz", reading=rough(record, ONSET), release="measured")


def test_a_record_without_noise_gives_the_sensor() -> None:
    """What is left is rounding and the 2 µs over which the simulated load goes; nothing is added to explain it."""
    record = record_of(clean(), 0.0, 0)
    fit = fit_step(record, "Fz", reading=rough(record, ONSET), release="step")
    assert fit.model is not None
    assert fit.order == 3
    np.testing.assert_allclose(fit.model.vector[[0, 1]], [1700.0, 0.015], rtol=1e-7)
    assert fit.model.real_hz[0] == pytest.approx(6000.0, rel=1e-4)
    assert fit.model.static_gain == pytest.approx(1.0, rel=1e-7)


def test_a_shape_of_the_release_that_fits_as_well_is_told() -> None:
    """In noise a line and half a cosine of 0.4 ms leave the same residual, with other low-pass filters."""
    output = released(sensor(*SENSOR), onset_s=ONSET, length_s=4e-4)
    fit = fit_step(record_of(output, 0.02, 4), "Fz", reading=rough(record_of(output, 0.02, 4), ONSET, 4e-4))
    assert fit.shape in ("ramp", "smooth")
    assert any("does not tell whether the release is" in notice.text for notice in fit.notices)
