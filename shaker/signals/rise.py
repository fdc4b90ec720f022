"""Crossings of a resolved rise: what its shape adds to the reconstruction, learnt from all edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape

_TERMS = (0, 2, 4, 6, 8)
_EDGES_PER_TERM = 8
_CONDITION = 1e3


@dataclass(frozen=True)
class RiseFit:
    """Line through edges: mean (2,) and covariance (2, 2) of its two coefficients, `correction_s` (E,) of every edge.

    `scatter_s` is the standard deviation of the corrected edges about the line.
    """

    mean: FloatArray
    covariance: FloatArray
    correction_s: FloatArray
    scatter_s: float

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (2, 2))
        check_shape("correction_s", self.correction_s, (None,))


def fit_resolved(time_s: FloatArray, place: FloatArray, phases: Sequence[FloatArray]) -> RiseFit:
    """Fit time_s (E,) = m + h·place + Σ a_j sin(π j φ) with the phase φ (E,) of each crossing between two samples.

    A rise that is not band-limited (a ramp, an exponential) leaves the reconstruction with an error that depends on
    where the crossing lies between two samples, and only on that; it vanishes where a sample is the crossing (φ = 0 or
    1), hence the sines. One series for each array of `phases`; its length follows from the data (Schwarz criterion), 0
    for a band-limited input. The idea is that of the effective point-spread function (Anderson & King, PASP 112, 2000).
    """
    line = np.stack([np.ones_like(place), place], axis=1)
    best, best_score = None, np.inf
    for terms in _TERMS:
        order = np.arange(1, terms + 1)
        series = [np.sin(np.pi * order * phase[:, None]) for phase in phases]
        columns = np.concatenate([line, *series], axis=1)
        if terms and (columns.shape[1] * _EDGES_PER_TERM > len(time_s) or np.linalg.cond(columns) > _CONDITION):
            break
        fit, squares = _least_squares(columns, time_s)
        score = len(time_s) * np.log(squares + 1e-300) + columns.shape[1] * np.log(len(time_s))
        if best is None or score < best_score:
            best, best_score = fit, score
    assert best is not None
    return best


def _least_squares(columns: FloatArray, time: FloatArray) -> tuple[RiseFit, float]:
    """Return the fit of one set of columns and its sum of squares."""
    inverse = np.linalg.inv(columns.T @ columns)
    centre = float(time.mean())
    value = inverse @ (columns.T @ (time - centre))
    residual = time - centre - columns @ value
    squares = float(residual @ residual)
    variance = squares / max(len(time) - columns.shape[1], 1)
    mean = value[:2] + np.array([centre, 0.0])
    return RiseFit(mean, variance * inverse[:2, :2], columns[:, 2:] @ value[2:], float(np.sqrt(variance))), squares
