"""Resonance and damping of a sensor over the mass it carries, with their uncertainties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.load_series.chain_poles import upper_poles
from shaker.models.load_series.model import LoadModel


@dataclass(frozen=True)
class LoadCurve:
    """Modes over load masses (K,) in kg: natural frequencies in Hz and damping ratios, first and second mode.

    `frequency_hz`, `damping_ratio` and their standard uncertainties (K, 2), NaN where there is no second mode or no
    covariance. f = |p|/2π, ζ = -Re p/|p| of the poles p of `LoadModel.system`.
    """

    load_mass: FloatArray
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    u_frequency_hz: FloatArray
    u_damping_ratio: FloatArray

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "damping_ratio", "u_frequency_hz", "u_damping_ratio"):
            check_shape(name, getattr(self, name), (len(self.load_mass), 2))


def load_curve(model: LoadModel, load_mass: FloatArray, u_load_mass: FloatArray | None = None) -> LoadCurve:
    """Return frequencies and dampings of both modes over load masses (K,).

    Uncertainties by the model's covariance and those of the load masses (K,), none by default.
    """
    masses = np.asarray(load_mass, dtype=np.float64)
    if model.total_covariance is None:
        values = _modes(model, masses)
        spread = np.full_like(values, np.nan)
    else:
        values, covariance = model.propagate(lambda changed: _modes(changed, masses))
        spread = np.sqrt(np.diag(covariance))
        if u_load_mass is not None and np.any(u_load_mass > 0):
            change = _modes(model, masses + u_load_mass) - _modes(model, np.maximum(masses - u_load_mass, 0.0))
            spread = np.hypot(spread, 0.5 * change)
    f, z = values.reshape(2, len(masses), 2)
    u_f, u_z = spread.reshape(2, len(masses), 2)
    return LoadCurve(masses, f, z, np.where(np.isnan(f), np.nan, u_f), np.where(np.isnan(z), np.nan, u_z))


def first_mode_hz(model: LoadModel, load_mass: float) -> float:
    """Return the natural frequency of the lowest mode with a load mass, in Hz."""
    poles, _ = upper_poles(model.vector, model.moving_mass, load_mass)
    return float(np.abs(poles[0])) / (2.0 * np.pi) if len(poles) else float("nan")


def rigid_formula_hz(model: LoadModel, load_mass: float) -> float:
    """Return √(k/(m_E + m_L))/2π in Hz: what the stiffness would mean were the load rigid (eq. 6)."""
    return float(np.sqrt(model.stiffness / (model.moving_mass + load_mass)) / (2.0 * np.pi))


def _modes(model: LoadModel, masses: FloatArray) -> FloatArray:
    """Frequencies, then damping ratios, (2 K 2,) of the modes by size; NaN for a second one that is not there."""
    found = np.full((2, len(masses), 2), np.nan)
    for place, mass in enumerate(masses):
        upper, _ = upper_poles(model.vector, model.moving_mass, float(mass))
        found[0, place, : len(upper)] = np.abs(upper) / (2.0 * np.pi)
        found[1, place, : len(upper)] = -upper.real / np.abs(upper)
    return np.asarray(found.ravel())
