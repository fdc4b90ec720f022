"""Scatter of readings beyond their stated uncertainties."""

from __future__ import annotations

import numpy as np

from shakercal._common.arrays import FloatArray

_ROUNDING = 1e-12  # scatter over that of equal weights, below which it is none


def additional_scatter(deviation: FloatArray, u: FloatArray, dof: int) -> float:
    """Return the standard deviation τ with Σ d²/(u² + τ²) = dof, 0 without scatter.

    It belongs to deviations (N,) from a mean or model with stated uncertainties (N,) (Paule and Mandel, J. Res. NBS 87
    (1982) 377).
    """
    from scipy.optimize import brentq

    def beyond(tau: float) -> float:
        return float(np.sum(deviation**2 / (u**2 + tau**2))) - dof

    high = float(np.sqrt(np.sum(deviation**2) / dof))
    low = _ROUNDING * high
    return float(brentq(beyond, low, high * (1.0 + 1e-9))) if high > 0.0 and beyond(low) > 0.0 else 0.0
