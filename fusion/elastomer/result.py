"""What is computed of an elastic element."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.elastomer.definition import Definition
from fusion.notices import Notice
from shaker._checks import FloatArray
from shaker.models.elastomer.element import FrameModel
from shaker.models.elastomer.platform_fit import PlatformFit
from shaker.models.elastomer.solid import SolidModel


class Fact(NamedTuple):
    """A number of the beam formulas: `printed` by the publication's formula, `right` by what stands in its place."""

    name: str
    label: str
    printed: float | None
    right: float | None
    unit: str
    remark: str


@dataclass(frozen=True)
class Column:
    """Natural frequencies by one model or measurement: `frequency_hz`, `u_hz` (6,), NaN where there is none.

    `kind`: "formula", "frame", "solid", "measured" or "stated". `u_hz` 0 of what is computed or given without it.
    """

    name: str
    kind: str
    frequency_hz: FloatArray
    u_hz: FloatArray


@dataclass(frozen=True)
class SolidStudy:
    """The solid on meshes of growing refinement, and on the last but one of them with a platform that does not bend."""

    refinements: tuple[int, ...]
    meshes: tuple[SolidModel, ...]
    rigid: SolidModel

    @property
    def finest(self) -> SolidModel:
        """The solution that counts."""
        return self.meshes[-1]


@dataclass(frozen=True)
class Mounted:
    """Sensor between hand and pedestal: modes (N,) of the chain, and over the hand's mass (H,) joined without spring.

    `stiffness`, `mass`: of the sensor along the direction, as the frame has them.
    """

    direction: str
    stiffness: float
    mass: float
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    hand_mass: FloatArray
    mounted_hz: FloatArray


@dataclass(frozen=True)
class ElementEvaluation:
    """An element with its models side by side; `sensitivity`: relative change of the six frequencies per change."""

    name: str
    definition: Definition
    facts: tuple[Fact, ...]
    frame: FrameModel
    sensitivity: dict[str, FloatArray]
    solid: SolidStudy | None
    columns: tuple[Column, ...]
    fits: tuple[PlatformFit, ...]
    mounted: Mounted | None
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float

    @property
    def spread(self) -> FloatArray:
        """How far apart the columns are, `spread` of them (6,)."""
        return spread(self.columns)


def spread(columns: Sequence[Column]) -> FloatArray:
    """Return (max - min)/max (6,) over columns, NaN where fewer than two have a value: as the paper's Table 6."""
    values = np.stack([column.frequency_hz for column in columns])
    filled = np.isfinite(values)
    highest = np.max(np.where(filled, values, -np.inf), axis=0)
    lowest = np.min(np.where(filled, values, np.inf), axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(filled.sum(axis=0) > 1, (highest - lowest) / highest, np.nan))
