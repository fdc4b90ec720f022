"""Load at the sensor origin and the complex ratio of the sensor's outputs to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.fuse import Contribution
from fusion.notices import AnyNotice
from shaker.signals.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

LOAD_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
LOAD_UNITS = ("N", "N", "N", "N.m", "N.m", "N.m")


@dataclass(frozen=True)
class LoadResult:
    """Wrench phasors at the sensor origin (K, 6) in N and N.m, NaN where not `observed` (K, 6), and their budget."""

    phasors: Phasors
    observed: BoolArray
    contributions: tuple[Contribution, ...]
    notices: tuple[AnyNotice, ...]


@dataclass(frozen=True)
class BudgetEntry:
    """One contribution to the driven component's ratio: relative standard uncertainty of the magnitude, phase (K, C)."""

    label: str
    type: Literal["A", "B"]
    u_relative: FloatArray
    u_phase_rad: FloatArray


@dataclass(frozen=True)
class Sensitivity:
    """Complex ratios of C sensor outputs to six load components at K lines.

    `value` (K, C, 6), NaN where not determined; `observed` (C, 6); `covariance` (K, C, 6, 2, 2) of (Re, Im);
    `dof` (K,); `unit` of the outputs ("V/V"), so that an element's unit is (unit)/N or (unit)/(N.m); `kind` per line;
    `budget` of the driven component.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    observed: BoolArray
    covariance: FloatArray
    dof: FloatArray
    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    kind: tuple[Literal["ratio", "matrix", "harmonic"], ...]
    budget: tuple[BudgetEntry, ...]
    notices: tuple[AnyNotice, ...]
