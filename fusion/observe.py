"""Instruments as rows of one linear model per line: measured phasors = design · acceleration + common errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shaker.signals.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

Kind = Literal["photogrammetry", "vibrometer", "accelerometer"]


@dataclass(frozen=True)
class CommonError:
    """One real unknown that several readings share, with a normal prior of zero mean and standard uncertainty `u`.

    `name` identifies the unknown: equal names in several observations are the same unknown. `label` groups it in a
    budget. Its effect on the phasors for one standard uncertainty is slope · A + offset, with `slope` (K, M, 6) and
    `offset` (K, M), so that it follows the estimate A (K, 6) and never the readings.
    """

    name: str
    label: str
    u: float
    slope: ComplexArray
    offset: ComplexArray

    def effect(self, acceleration: ComplexArray) -> ComplexArray:
        """Return the change (K, M) of the phasors for one standard uncertainty, at the acceleration (K, 6)."""
        return np.asarray(np.einsum("kmj,kj->km", self.slope, acceleration) + self.offset)


@dataclass(frozen=True)
class Observation:
    """Readings of one body by one instrument (a stereo pair, or the channels that share a chain).

    `phasors` (K lines, M channels; NaN where a line is not usable), `design` (K, M, 6) complex:
    phasors = design · [x y z rx ry rz accelerations at the sensor origin]. `members` (M,): the name under which each
    row is tested for consistency. `stated`: some systematic uncertainty is stated, so it takes part in the fusion.
    """

    name: str
    kind: Kind
    body: str
    phasors: Phasors
    design: ComplexArray
    common: tuple[CommonError, ...]
    members: tuple[str, ...]
    stated: bool
