"""The masses of a series of loads as named unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape


@dataclass(frozen=True)
class SeriesMasses:
    """Moving mass and the load masses (R,) of R records in kg, with their errors by name.

    `names` (Q,) of what is uncertain; one standard uncertainty of it changes the moving mass by `moving_effect` (Q,)
    and the load masses by `load_effect` (R, Q), so that an adapter that two records share is one unknown.
    """

    moving: float
    load: FloatArray
    names: tuple[str, ...]
    moving_effect: FloatArray
    load_effect: FloatArray

    def __post_init__(self) -> None:
        if not self.moving > 0:
            raise ValueError(f"moving: expected a mass above 0, found {self.moving}")
        check_shape("load", self.load, (None,))
        if np.any(self.load < 0):
            raise ValueError(f"load: expected masses of at least 0, found {float(np.min(self.load))}")
        check_shape("moving_effect", self.moving_effect, (len(self.names),))
        check_shape("load_effect", self.load_effect, (len(self.load), len(self.names)))

    @property
    def u_moving(self) -> float:
        """Standard uncertainty of the moving mass."""
        return float(np.linalg.norm(self.moving_effect))

    @property
    def u_load(self) -> FloatArray:
        """Standard uncertainties of the load masses (R,)."""
        return np.asarray(np.linalg.norm(self.load_effect, axis=1))

    @property
    def is_single(self) -> bool:
        """Whether all records carry one load mass, but for 0.1 %."""
        return bool(np.ptp(self.load) <= 1e-3 * np.max(self.load, initial=0.0))

    def at(self, deviates: FloatArray) -> tuple[float, FloatArray]:
        """Return moving and load masses with every named error (Q,) at so many of its standard uncertainties."""
        return self.moving + float(self.moving_effect @ deviates), self.load + self.load_effect @ deviates


def stated_masses(moving: float, u_moving: float, load: FloatArray, u_load: FloatArray | None = None) -> SeriesMasses:
    """Return masses whose errors are independent: the moving mass, and every load mass (R,) that differs."""
    loads = np.asarray(load, dtype=np.float64)
    spread = np.zeros(len(loads)) if u_load is None else np.asarray(u_load, dtype=np.float64)
    names, rows, moved = [], [], []
    if u_moving > 0.0:
        names.append("moving mass")
        moved.append(u_moving)
        rows.append(np.zeros(len(loads)))
    for value in np.unique(loads[spread > 0.0]):
        names.append(f"load mass {value:.6g} kg")
        moved.append(0.0)
        rows.append(np.where(loads == value, spread, 0.0))
    effect = np.array(rows).reshape(len(names), len(loads)).T
    return SeriesMasses(float(moving), loads, tuple(names), np.array(moved, dtype=np.float64), effect)
