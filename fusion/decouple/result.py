"""What an evaluated decoupling consists of, and what a user may choose about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.manifest import Manifest
from fusion.notices import Notice
from shaker._checks import FloatArray
from shaker.models.decoupling.crosstalk import Crosstalk
from shaker.models.decoupling.filter import DecouplingFilter
from shaker.models.decoupling.step_result import MultiFit

K = 2.0
"""Coverage factor of all expanded uncertainties."""


@dataclass(frozen=True)
class DecoupleSettings:
    """Choices that change results: wanted frequency in Hz (None: half that of the lowest mode) and damping ratio of the
    loads behind the filter; `seed` of what is drawn."""

    frequency_hz: float | None = None
    damping_ratio: float = 0.6
    seed: int = 1

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        wanted = "half that of the lowest mode" if self.frequency_hz is None else self.frequency_hz
        return {"frequency_hz": wanted, "damping_ratio": self.damping_ratio, "seed": self.seed}


@dataclass(frozen=True)
class DecoupleEvaluation:
    """Records of all loads, the model of all outputs, the filter, and cross-talk at every stage.

    `capacity` (D,): rated loads of the model's components, None where rig.toml states none; `noise_gain` (D,): noise of
    each load behind the filter over that with the static matrix alone, `noise` (D,) behind the filter in N or N·m;
    `deviation` (K,): largest |D·H - T| over all elements, in rated loads, at the frequencies of the cross-talk.
    """

    name: str
    manifests: tuple[Manifest, ...]
    fit: MultiFit
    decoupler: DecouplingFilter
    stages: tuple[Crosstalk, ...]
    capacity: FloatArray | None
    noise: FloatArray
    noise_gain: FloatArray
    deviation: FloatArray
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float

    @property
    def frequency_hz(self) -> FloatArray:
        """Return the frequencies (K,) of the cross-talk."""
        return self.stages[0].frequency_hz

    @property
    def scale(self) -> FloatArray:
        """Return what loads (D,) are compared in: rated loads, without them 1 N and 1 N·m."""
        return np.ones(len(self.fit.model.components)) if self.capacity is None else self.capacity

    def comparable(self, reading: int, load: int) -> bool:
        """Return whether two loads can be compared: by rated loads any, else those of one unit."""
        names = self.fit.model.components
        return self.capacity is not None or names[reading][0] == names[load][0]

    def stage(self, name: str) -> Crosstalk | None:
        """Return the cross-talk of one stage, None where the outputs do not allow it."""
        return next((stage for stage in self.stages if stage.stage == name), None)


def load_unit(component: str) -> str:
    """Return the unit of a load component as it stands in files."""
    return "N" if component.startswith("F") else "N.m"
