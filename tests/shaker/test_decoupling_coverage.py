"""Whether the intervals of a model from releases hold the truth as often as they say, by repeated simulation."""

import numpy as np
import pytest
from numpy.typing import NDArray

from shaker.decoupling.fit import fit_steps
from shaker.release.record import StepRecord
from shaker.release.response import pole_responses

LOADS = ("Fx", "Fy")
FREQUENCY_HZ, DAMPING, LAG_HZ, RATE_HZ = np.array([850.0, 1010.0]), np.array([0.02, 0.025]), 2500.0, 50e3
SHOW, DRIVE = np.array([[2.0, 0.15], [-0.1, 1.0]]), np.array([[1.0, 0.1], [-0.08, 1.0]])
SIZE = np.array([10.0, 8.0])
PROBED_HZ = np.array([0.0, 500.0, 840.0, 1020.0, 1500.0])
FloatArray = NDArray[np.float64]


def _true_model() -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles (5,), the conjugates and the lag among them, and residues (5, 2, 2) of modes behind a common lag."""
    omega, corner = 2.0 * np.pi * FREQUENCY_HZ, 2.0 * np.pi * LAG_HZ
    upper = omega * (-DAMPING + 1j * np.sqrt(1.0 - DAMPING**2))
    swing = omega**2 * corner / ((upper - upper.conj()) * (upper + corner))
    lag = omega**2 * corner / (corner**2 - 2.0 * DAMPING * omega * corner + omega**2)
    own = np.einsum("cm,m,md->mcd", SHOW, swing, DRIVE)
    last = np.einsum("cm,m,md->cd", SHOW, lag, DRIVE)[None]
    return np.concatenate([upper, upper.conj(), [-corner + 0j]]), np.concatenate([own, own.conj(), last])


def _releases(seed: int) -> list[StepRecord]:
    """Two releases of each load along lines of about 0.3 ms, noise 1 % of each output's own change."""
    rng = np.random.default_rng(seed)
    poles, residues = _true_model()
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


def _scores(seed: int) -> dict[str, FloatArray]:
    """Deviations from the truth over standard uncertainties: poles, residues, response."""
    model = fit_steps(_releases(seed)).model
    poles, residues = _true_model()
    order, u = np.argsort(model.frequency_hz), model.u
    assert len(order) == 2
    assert len(model.real_hz) == 1
    found = [
        (model.frequency_hz[order] - FREQUENCY_HZ) / u.frequency_hz[order],
        (model.damping_ratio[order] - DAMPING) / u.damping_ratio[order],
        (model.real_hz - LAG_HZ) / u.real_hz,
    ]
    residue = model.residue[order] - residues[:2]
    parts = [residue.real / u.residue[order].real, residue.imag / u.residue[order].imag]
    truth = np.einsum("kp,pcd->kcd", 1.0 / (2j * np.pi * PROBED_HZ[:, None] - poles), residues)
    difference, responses = model.response(PROBED_HZ) - truth, []
    for d in range(2):
        slope, covariance = model.column_sensitivity(d, PROBED_HZ)
        for turn in (1.0, 1j):
            row = (turn * slope).real
            spread = np.einsum("kcp,pq,kcq->kc", row, covariance, row)
            clear = spread > 1e-12 * spread.max()
            responses.append(((turn * difference[:, :, d]).real[clear] / np.sqrt(spread[clear])).ravel())
    return {"poles": np.concatenate(found), "residues": np.ravel(parts), "response": np.concatenate(responses)}


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    trials = [_scores(seed) for seed in range(7)]
    for name, least in (("poles", 0.88), ("residues", 0.9), ("response", 0.9)):
        score = np.concatenate([trial[name] for trial in trials])
        assert 0.8 < np.sqrt(np.mean(score**2)) < 1.25, name
        assert np.mean(np.abs(score) < 1.96) > least, name
