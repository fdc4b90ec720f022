"""Numbers of a pooled model with uncertainty: its parameters and its indices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.coverage import coverage_factor
from fusion.step.pool import Pooled
from shaker.models.indices.indices import indices
from shaker.models.indices.result import LABELS, Indices, unit_of
from shaker.models.indices.uncertain import SETTLING, moving_figures, settling_u


@dataclass(frozen=True)
class Figure:
    """A number with its standard uncertainty and the degrees of freedom behind that; `name` for files.

    `u` is NaN where it is not known.
    """

    name: str
    label: str
    value: float
    u: float
    dof: float
    unit: str

    @property
    def k(self) -> float:
        """Return the coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> float:
        """Return U = k·u."""
        return self.k * self.u


def parameter_figures(pooled: Pooled, unit: str) -> tuple[Figure, ...]:
    """Return the parameters of a pooled model, its residues in `unit` per second."""
    model = pooled.model
    u, dof = pooled.spread(np.eye(len(model.vector)))
    found = []
    for name, value, spread, freedom in zip(model.names, model.vector.tolist(), u, dof, strict=True):
        own = "Hz" if "_hz_" in name else f"{unit}/s" if "residue" in name else "1"
        found.append(Figure(name, _label(name), value, float(spread), float(freedom), own))
    return tuple(found)


def index_figures(
    pooled: Pooled, nominal: float | None, unit: str, sample_rate_hz: float
) -> tuple[Indices, tuple[Figure, ...]]:
    """Return the indices of a pooled model, and those that it has as figures with uncertainty.

    `nominal`: the gain that the sensor should have, None where nobody states it: then no band against it. Settling
    times jump by half periods: their uncertainty is `settling_u`'s, with the degrees of freedom of the damping.
    """
    found = indices(pooled.model.system, nominal or 1.0, sample_rate_hz)
    names, moving = moving_figures(pooled.model, found)
    spread = zip(names, *(part.tolist() for part in pooled.spread(pooled.model.jacobian(moving)[1])), strict=True)
    known = {name: (u, dof) for name, u, dof in spread}
    of_damping = known.get("damping_ratio", (0.0, np.inf))[1]
    known |= {name: (settling_u(pooled.model, tolerance), of_damping) for name, tolerance in SETTLING.items()}
    figures = []
    for name, value in found.figures().items():
        if value is not None and np.isfinite(value) and (nominal is not None or "nominal" not in name):
            own = unit if name == "static_gain" else unit_of(name) or "1"
            figures.append(Figure(name, LABELS[name], value, *known.get(name, (np.nan, np.inf)), own))
    return found, tuple(figures)


def _label(name: str) -> str:
    """Words for a parameter."""
    kind, _, number = name.rpartition("_")
    words = {
        "frequency_hz": "natural frequency of mode",
        "damping_ratio": "damping ratio of mode",
        "residue_re": "residue, real part, of mode",
        "residue_im": "residue, imaginary part, of mode",
        "real_hz": "real pole",
        "real_residue": "residue of real pole",
    }
    return f"{words[kind]} {number}"
