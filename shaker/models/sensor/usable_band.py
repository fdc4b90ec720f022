"""Up to which frequency the static sensitivity is enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.models.sensor.sensor_model import Load, SensorModel

Limit = Literal["rise", "drop", "phase", "nothing"]

_LIMITS: tuple[Limit, Limit, Limit] = ("rise", "drop", "phase")
_POINTS_PER_DECADE = 200


@dataclass(frozen=True)
class UsableBand:
    """Frequencies from 0 to `upper_hz` at which the output stays within what is permitted of its static value.

    `permitted`: relative deviation of the magnitude; `permitted_phase_rad`: of the phase, None where any is permitted;
    `limit`: what ends the band. `upper_hz` is infinite where nothing does.
    """

    upper_hz: float
    u_upper_hz: float
    permitted: float
    permitted_phase_rad: float | None
    limit: Limit


def usable_band(
    model: SensorModel, load: Load, permitted: float, permitted_phase_rad: float | None = None
) -> UsableBand:
    """Return the band in which `output_factor` keeps within ± `permitted` of its value at f → 0, with its uncertainty.

    The factor (1 + m_i/m) of a moving base is the same at all frequencies and no deviation here. Light damping and no
    chain give f = f₀√(p/(1 + p)) for a force on the load: 0.2182 f₀ at 5 %, 0.3015 f₀ at 10 %. The edge moves with the
    parameters by -(∂Λ/∂θ)/(∂Λ/∂f), Λ the logarithm of the magnitude, or the phase.
    """
    if not 0.0 < permitted < 1.0:
        raise ValueError(f"permitted: expected a share between 0 and 1, found {permitted:g}")
    if permitted_phase_rad is not None and not 0.0 < permitted_phase_rad < np.pi:
        raise ValueError(f"permitted_phase_rad: expected more than 0 and less than π, found {permitted_phase_rad:g}")
    from scipy import optimize

    def excess(frequency_hz: FloatArray) -> FloatArray:
        ratio = model.output_factor(frequency_hz, load) / model.output_factor(np.zeros(1), load)
        size = np.abs(ratio)
        turned = np.abs(np.angle(ratio)) - (np.inf if permitted_phase_rad is None else permitted_phase_rad)
        return np.stack([size - 1.0 - permitted, 1.0 - permitted - size, turned])

    grid = _grid(model, load)
    outside = excess(grid) > 0.0
    if not outside.any():
        return UsableBand(np.inf, 0.0, permitted, permitted_phase_rad, "nothing")
    last = int(np.argmax(outside.any(axis=0)))
    first = float(grid[last - 1]) if last else 0.0
    edges = []
    for i in np.flatnonzero(outside[:, last]).tolist():
        edge = optimize.brentq(lambda f, i=i: excess(np.array([f]))[i, 0], first, grid[last], xtol=1e-9 * grid[last])
        edges.append((float(edge), i))
    upper, which = min(edges)
    u = _edge_uncertainty(model, load, upper, phase=which == 2)
    return UsableBand(upper, u, permitted, permitted_phase_rad, _LIMITS[which])


def _edge_uncertainty(model: SensorModel, load: Load, edge_hz: float, *, phase: bool) -> float:
    """Return the standard uncertainty of a band's edge from the model's covariance."""
    at, turn = np.array([edge_hz]), -1j if phase else 1.0
    slopes = model.log_slopes(at, load) - model.log_slopes(np.zeros(1), load)
    moved = (turn * slopes @ model.covariance_root(load)).real
    by_frequency = float((turn * model.log_frequency_slope(at, load)).real[0])
    return float(np.linalg.norm(moved) / abs(by_frequency))


def _grid(model: SensorModel, load: Load) -> FloatArray:
    """Return frequencies from far below to far above all time constants, dense enough to meet the first edge."""
    chain = model.chain
    times = [model.damping / model.stiffness, chain.delay_s, chain.lag_s, abs(chain.square_s2) ** 0.5]
    times += [1.0 / (2.0 * np.pi * model.resonance_hz(load))] if load.drive == "force" else []
    scales = [1.0 / (2.0 * np.pi * abs(time)) for time in times if time != 0.0] or [1.0]
    low, high = 1e-3 * min(scales), 1e2 * max(scales)
    return np.geomspace(low, high, int(_POINTS_PER_DECADE * np.log10(high / low)) + 1)
