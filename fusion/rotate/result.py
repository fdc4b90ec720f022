"""What an evaluated rotation test consists of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.coverage import coverage_factor
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.rotate.scatter import Repeats
from shaker._checks import FloatArray
from shaker.models.weights.gravity import Known
from shaker.models.weights.harmonics import AngleFit
from shaker.models.weights.load_mass import WeightFit
from shaker.models.weights.turning import SensorOutputs

JOINT = "joint"
"""Component of a mass that all force channels tell together."""


class Column(NamedTuple):
    """One column of a recording's table that is used: the sensor's channel, its unit as written, load or output."""

    channel: str
    unit: str
    is_load: bool


@dataclass(frozen=True)
class RotationRecording:
    """One recording: readings over the angle in the sensor's unit or in N and N·m, and the fit to them.

    `name`: of its folder. `unit` (C,), of every channel. `load` (N, 6): the readings as loads by the calibration
    matrix `inverse` (6, C), NaN where that does not tell a component.
    """

    name: str
    manifest: Manifest
    with_load: bool
    unit: tuple[str, ...]
    fit: AngleFit
    inverse: FloatArray
    load: FloatArray

    @property
    def state(self) -> str:
        """Return what was on the sensor, in words."""
        return "with load" if self.with_load else "without load"

    @property
    def told(self) -> list[int]:
        """Return the places of the load components that the channels tell."""
        return [int(i) for i in np.flatnonzero(np.isfinite(self.load).all(axis=0))]


@dataclass(frozen=True)
class Quantity:
    """One number of the result with its standard uncertainty and the degrees of freedom behind that.

    `name` for files, `label` for readers; `component`: Fx … Mz, x, y, z, or all forces together ("joint"); `recording`:
    the folder of the one it belongs to, empty where it rests on several. `budget`: standard uncertainty by cause.
    """

    name: str
    label: str
    component: str
    value: float
    u: float
    dof: float
    unit: str
    recording: str
    budget: dict[str, float]

    @property
    def k(self) -> float:
        """Return the coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> float:
        """Return U = k·u."""
        return self.k * self.u


@dataclass(frozen=True)
class RotationEvaluation:
    """All recordings of one sensor on the head, what they weigh, and their surroundings.

    `repeats`: of each state that was recorded more than once.
    """

    name: str
    recordings: tuple[RotationRecording, ...]
    outputs: SensorOutputs
    gravity: Known
    air: Known
    weights: WeightFit
    quantities: tuple[Quantity, ...]
    repeats: tuple[Repeats, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float

    def find(self, name: str, component: str = JOINT, recording: str = "") -> Quantity | None:
        """Return a quantity, None where the recordings do not tell it."""
        wanted = (name, component, recording)
        return next((q for q in self.quantities if (q.name, q.component, q.recording) == wanted), None)
