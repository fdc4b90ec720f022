"""The rise time of a response from its fitted beginning."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.step.beginning import Beginning

_FROM, _TO = 0.1, 0.9
_GRID = 800
_PERIODS = 1.5


def rise_time(fit: Beginning) -> tuple[float, float] | None:
    """Return how long the fitted curve takes from 10 % to 90 % of its change, first crossings, and its uncertainty.

    None where the curve does not get there. A crossing t of the level b + share·Σg moves by -(∂(y - level)/∂θ)/(dy/dt)
    with the parameters θ of the fit.
    """
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    crossings = [_crossing_s(fit, share) for share in (_FROM, _TO)]
    if crossings[0] is None or crossings[1] is None:
        return None
    times = np.array(crossings)
    vector, u = fit.vector, np.sqrt(np.maximum(np.diagonal(fit.covariance), 0.0))
    here = _above(fit, times)
    slopes = np.zeros((2, len(u)))
    for place in np.flatnonzero(u):
        moved = vector.copy()
        moved[place] += 1e-2 * u[place]
        slopes[:, place] = (_above(fit.with_vector(moved), times) - here) / (1e-2 * u[place])
    by = -slopes / fit.speed(times)[:, None]
    gradient = by[1] - by[0]
    return float(times[1] - times[0]), float(np.sqrt(max(gradient @ fit.covariance @ gradient, 0.0)))


def _crossing_s(fit: Beginning, share: float) -> float | None:
    """Return when the fitted curve first passes a share of its change, None where it does not soon."""
    span = fit.release_s + 4.0 * fit.lag_s + _PERIODS / float(np.min(fit.frequency_hz))
    time = fit.onset_s + np.linspace(0.0, span, _GRID)
    change = fit.steady - fit.linear[0]
    relative = (fit.at(time) - fit.linear[0]) / change
    above = np.flatnonzero(relative >= share)
    if not above.size or above[0] == 0:
        return None
    after = int(above[0])
    low, high = relative[after - 1], relative[after]
    return float(time[after - 1] + (share - low) / (high - low) * (time[after] - time[after - 1]))


def _above(fit: Beginning, time_s: FloatArray) -> FloatArray:
    """Return the curve above the levels of 10 % and 90 % (2,) at two times (2,)."""
    shares = np.array([_FROM, _TO])
    return np.asarray(fit.at(time_s) - fit.linear[0] - shares * (fit.steady - fit.linear[0]))
