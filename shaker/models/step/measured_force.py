"""The release as a force channel measured it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.models.step.levels import correlation_factor
from shaker.models.step.locate import Location, locate
from shaker.models.step.shapes import load_share

_LENGTHS = 3.0  # of the release on either side that the fit takes


@dataclass(frozen=True)
class ForceReading:
    """Onset and length in s of the load's change, and the change in N or N·m, with standard uncertainties.

    `shape`: the better of a straight ramp and half a cosine.
    """

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    change: float
    u_change: float
    shape: Literal["ramp", "smooth"]


def read_force(force: FloatArray, sample_rate_hz: float, start_s: float) -> ForceReading:
    """Return what a force channel (N,), its first sample at `start_s`, shows of a release.

    Least squares of level, change, middle and length of `load_share` around the release.
    """
    place = locate(force)
    readings = [_fitted(force, sample_rate_hz, start_s, place, shape) for shape in ("ramp", "smooth")]
    return min(readings, key=lambda reading: reading[1])[0]


def _fitted(
    force: FloatArray, sample_rate_hz: float, start_s: float, place: Location, shape: Literal["ramp", "smooth"]
) -> tuple[ForceReading, float]:
    """Return the reading of one shape and its sum of squares."""
    from scipy.optimize import least_squares

    length = max((place.high - place.low) / 0.8, 2.0)
    low = max(0, int(place.low - _LENGTHS * length - 8))
    high = min(len(force), int(place.high + _LENGTHS * length + 8))
    number = np.arange(low, high, dtype=np.float64)
    start = [place.baseline, place.steady - place.baseline, 0.5 * (place.low + place.high), length]

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray(x[0] + x[1] * load_share(shape, number, x[2] - 0.5 * x[3], x[3]) - force[low:high])

    bounds = ([-np.inf, -np.inf, low, 0.1], [np.inf, np.inf, high, 2.0 * (high - low)])
    scale = [abs(start[1]), abs(start[1]), length, length]
    found = least_squares(residual, start, bounds=bounds, x_scale=scale, diff_step=1e-5)
    variance = 2.0 * found.cost / max(len(number) - 4, 1) * correlation_factor(found.fun)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    half = np.array([0.0, 0.0, 1.0, -0.5])
    u = np.sqrt(np.diagonal(covariance))
    reading = ForceReading(
        onset_s=start_s + float(half @ found.x) / sample_rate_hz,
        u_onset_s=float(np.sqrt(half @ covariance @ half)) / sample_rate_hz,
        release_s=float(found.x[3]) / sample_rate_hz,
        u_release_s=float(u[3]) / sample_rate_hz,
        change=float(found.x[1]),
        u_change=float(u[1]),
        shape=shape,
    )
    return reading, float(found.cost)
