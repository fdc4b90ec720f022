"""Whether the intervals of a model from releases hold the truth as often as they say, by repeated simulation."""

import numpy as np
import pytest
from contracts import coverage_contract
from decoupling_factory import FloatArray, Sensor

from shaker.decoupling.fit import fit_steps

LINES_HZ = np.array([0.0, 100.0, 500.0, 840.0, 1500.0])


@pytest.mark.slow
@pytest.mark.parametrize("lag_hz", [2500.0, 8000.0])
def test_intervals_hold_the_truth_as_often_as_they_say(lag_hz: float) -> None:
    """Of modes, and of each output over its own load: with a lag that shows, and one that slower releases hide."""
    sensor = Sensor(
        loads=("Fx", "Fy"),
        frequency_hz=np.array([850.0, 1010.0]),
        damping=np.array([0.02, 0.025]),
        lag_hz=lag_hz,
        drive=np.array([[1.0, 0.1], [-0.08, 1.0]]),
        show=np.array([[2.0, 0.15], [-0.1, 1.0]]),
        size=np.array([10.0, 8.0]),
        rate_hz=50e3,
        release_s=0.3e-3,
        onset_s=5e-3,
        count=1500,
    )

    def estimate(seed: int) -> tuple[FloatArray, FloatArray]:
        model = fit_steps(sensor.releases(seed)).model
        order, u = np.argsort(model.frequency_hz), model.u
        assert len(order) == 2
        values = [model.frequency_hz[order], model.damping_ratio[order]]
        spreads = [u.frequency_hz[order], u.damping_ratio[order]]
        response = model.response(LINES_HZ)
        for d in range(2):
            slope, covariance = model.column_sensitivity(d, LINES_HZ)
            own, rows = response[:, d, d], slope[:, d]
            values += [own.real, own.imag[1:]]
            parts = rows.real, rows.imag[1:]
            spreads += [np.sqrt(np.einsum("kp,pq,kq->k", part, covariance, part)) for part in parts]
        return np.concatenate(values), 1.96 * np.concatenate(spreads)

    truth = [sensor.frequency_hz, sensor.damping]
    for d in range(2):
        own = sensor.response(LINES_HZ)[:, d, d]
        truth += [own.real, own.imag[1:]]
    coverage_contract(estimate, np.concatenate(truth), 10, cautious=True)
