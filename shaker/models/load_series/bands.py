"""How far a loaded sensor can be used as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.frequency import band_end, gain_curve
from shaker.models.load_series.model import LoadModel

TOLERANCES = (0.05, 0.10)
"""Departures of the gain from that at rest for which bands are given."""
SMALLEST_DAMPING = 1e-4
"""Damping ratio that stands for none: bands do not depend on it."""


def working_bands(model: LoadModel, load_mass: float, tolerances: tuple[float, ...] = TOLERANCES) -> FloatArray:
    """Return the frequencies (T,) in Hz up to which |H| stays within each tolerance of |H(0)|, NaN if it always does.

    A model without damping, as resonances alone tell it, has the same bands as one of very light damping.
    """
    if model.damping == 0.0:
        light = 2.0 * SMALLEST_DAMPING * np.sqrt(model.stiffness * model.moving_mass)
        other = None
        if model.coupling_stiffness is not None:
            other = light * model.coupling_stiffness / model.stiffness
        model = replace(model, damping=light, coupling_damping=other)
    system = model.system(load_mass)
    curve, level = gain_curve(system), system.static_gain
    ends = [band_end(curve, level, tolerance) for tolerance in tolerances]
    return np.array([np.nan if end is None or np.isinf(end) else end for end in ends])
