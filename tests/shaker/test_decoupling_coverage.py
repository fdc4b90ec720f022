"""Whether the intervals of a model from releases hold the truth as often as they say, by repeated simulation."""

import numpy as np
import pytest
from contracts import coverage_contract
from numpy.typing import NDArray

from shaker.decoupling.fit import fit_steps
from shaker.release.record import StepRecord
from shaker.release.response import pole_responses

LOADS = ("Fx", "Fy")
FREQUENCY_HZ, DAMPING, RATE_HZ = np.array([850.0, 1010.0]), np.array([0.02, 0.025]), 50e3
SHOW, DRIVE = np.array([[2.0, 0.15], [-0.1, 1.0]]), np.array([[1.0, 0.1], [-0.08, 1.0]])
SIZE = np.array([10.0, 8.0])
PROBED_HZ = np.array([100.0, 500.0, 840.0, 1500.0])
FloatArray = NDArray[np.float64]


def _true_model(lag_hz: float) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles (5,), the conjugates and the lag among them, and residues (5, 2, 2) of modes behind a common lag."""
    omega, corner = 2.0 * np.pi * FREQUENCY_HZ, 2.0 * np.pi * lag_hz
    upper = omega * (-DAMPING + 1j * np.sqrt(1.0 - DAMPING**2))
    swing = omega**2 * corner / ((upper - upper.conj()) * (upper + corner))
    lag = omega**2 * corner / (corner**2 - 2.0 * DAMPING * omega * corner + omega**2)
    own = np.einsum("cm,m,md->mcd", SHOW, swing, DRIVE)
    last = np.einsum("cm,m,md->cd", SHOW, lag, DRIVE)[None]
    return np.concatenate([upper, upper.conj(), [-corner + 0j]]), np.concatenate([own, own.conj(), last])


def _releases(seed: int, lag_hz: float) -> list[StepRecord]:
    """Two releases of each load along lines of about 0.3 ms, noise 1 % of each output's own change."""
    rng = np.random.default_rng(seed)
    poles, residues = _true_model(lag_hz)
    noise, time_s = 0.01 * SIZE * np.diag(SHOW @ DRIVE), np.arange(1500) / RATE_HZ
    records = []
    for d, name in enumerate(LOADS):
        for k in range(2):
            onset_s, duration_s = 5e-3 + rng.uniform(0.0, 1e-4), 0.3e-3 * rng.uniform(0.8, 1.2)
            amplitude = -float(SIZE[d]) * rng.uniform(0.9, 1.0)
            answer = pole_responses(poles, time_s, onset_s, duration_s) @ residues[:, :, d]
            samples = amplitude * answer.real.T + noise[:, None] * rng.standard_normal((2, len(time_s)))
            records.append(StepRecord(f"{name}-{k}", LOADS, "V", samples, RATE_HZ, name, amplitude))
    return records


def _estimate(seed: int, lag_hz: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies, damping ratios, static gains, and Re and Im of each output over its own load, with U."""
    model = fit_steps(_releases(seed, lag_hz)).model
    order, u = np.argsort(model.frequency_hz), model.u
    assert len(order) == 2
    values = [model.frequency_hz[order], model.damping_ratio[order]]
    spreads = [u.frequency_hz[order], u.damping_ratio[order]]
    lines_hz = np.append(0.0, PROBED_HZ)
    response = model.response(lines_hz)
    for d in range(2):
        slope, covariance = model.column_sensitivity(d, lines_hz)
        own, rows = response[:, d, d], slope[:, d]
        for value, row in ((own.real, rows.real), (own.imag[1:], rows.imag[1:])):
            values.append(value)
            spreads.append(np.sqrt(np.einsum("kp,pq,kq->k", row, covariance, row)))
    return np.concatenate(values), 1.96 * np.concatenate(spreads)


@pytest.mark.slow
@pytest.mark.parametrize("lag_hz", [2500.0, 8000.0])
def test_intervals_hold_the_truth_as_often_as_they_say(lag_hz: float) -> None:
    """With a lag that shows, and with one that the records hardly tell from slower releases."""
    poles, residues = _true_model(lag_hz)
    lines_hz = np.append(0.0, PROBED_HZ)
    response = np.einsum("kp,pcd->kcd", 1.0 / (2j * np.pi * lines_hz[:, None] - poles), residues)
    truth = [FREQUENCY_HZ, DAMPING]
    for d in range(2):
        truth += [response[:, d, d].real, response[1:, d, d].imag]
    coverage_contract(lambda seed: _estimate(seed, lag_hz), np.concatenate(truth), 10, cautious=True)
