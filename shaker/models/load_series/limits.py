"""How much load a sensor bears before its resonance, or a formula for it, is off by more than permitted."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from shaker._checks import FloatArray
from shaker.models.load_series.characteristics import first_mode_hz, rigid_formula_hz
from shaker.models.load_series.model import LoadModel

ROUNDING = 1e-9
"""Relative uncertainty that only the rounding of a root makes."""
HEAVIEST = 1e4
"""Load mass over the moving mass up to which limits are looked for."""


class LoadLimit(NamedTuple):
    """A load mass in kg (kg·m² of a moment) with its standard uncertainty, NaN where that is not known."""

    load_mass: float
    u: float


def formula_limit(model: LoadModel, permitted: float) -> LoadLimit | None:
    """Return the load mass from which √(k/(m_E + m_L)) is too high by more than a share `permitted` of the resonance.

    None where it never is: a rigid load, or a coupling that is stiff enough. For large loads the formula is too high by
    √(1 + k/k_L).
    """
    _check_share(permitted)

    def beyond(changed: LoadModel, load: float) -> float:
        return rigid_formula_hz(changed, load) / first_mode_hz(changed, load) - 1.0 - permitted

    return _limit(model, beyond)


def change_limit(model: LoadModel, permitted: float) -> LoadLimit | None:
    """Return the load mass that lowers the resonance by a share `permitted` of that without load."""
    _check_share(permitted)

    def beyond(changed: LoadModel, load: float) -> float:
        return 1.0 - permitted - first_mode_hz(changed, load) / first_mode_hz(changed, 0.0)

    return _limit(model, beyond)


def frequency_limit(model: LoadModel, wanted_hz: float) -> LoadLimit | None:
    """Return the load mass up to which the resonance stays at or above `wanted_hz`, None where it never is."""
    if not wanted_hz > 0:
        raise ValueError(f"wanted_hz: expected a frequency above 0, found {wanted_hz}")
    if first_mode_hz(model, 0.0) < wanted_hz:
        return None
    return _limit(model, lambda changed, load: wanted_hz / first_mode_hz(changed, load) - 1.0)


def _check_share(permitted: float) -> None:
    """Refuse what is no share."""
    if not 0.0 < permitted < 1.0:
        raise ValueError(f"permitted: expected a share between 0 and 1, found {permitted}")


def _limit(model: LoadModel, beyond: Callable[[LoadModel, float], float]) -> LoadLimit | None:
    """The root of a function of the load that rises from below zero, with its uncertainty by the model's covariance."""
    from scipy.optimize import brentq

    def root(changed: LoadModel) -> float:
        low, high = 0.0, 1e-3 * changed.moving_mass
        while beyond(changed, high) <= 0.0:
            low, high = high, 2.0 * high
            if high > HEAVIEST * changed.moving_mass:
                return float("nan")
        return float(brentq(lambda load: beyond(changed, load), low, high, xtol=1e-14 * changed.moving_mass))

    value = root(model)
    if np.isnan(value):
        return None
    if model.total_covariance is None:
        return LoadLimit(value, float("nan"))

    def at(changed: LoadModel) -> FloatArray:
        return np.array([root(changed)])

    u = float(np.sqrt(model.propagate(at)[1][0, 0]))
    return LoadLimit(value, u if u > ROUNDING * value else 0.0)
