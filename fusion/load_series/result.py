"""What evaluated load characteristics consist of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.coverage import coverage_factor
from fusion.load_series.series import LoadSeries
from fusion.load_series.settings import LoadSettings
from fusion.notices import Notice
from shaker._checks import FloatArray
from shaker.models.load_series.characteristics import LoadCurve
from shaker.models.load_series.identify import LoadIdentification
from shaker.models.load_series.model import LoadModel


@dataclass(frozen=True)
class NamedLimit:
    """A load that is permitted: `name` for files, `label` for readers, NaN where there is no limit; u, k = 1."""

    name: str
    label: str
    load_mass: float
    u: float


@dataclass(frozen=True)
class Solution:
    """One model that the data support, and what follows from it.

    Curves of both modes: `recorded` at the loads (R,), `predicted` at those asked for (P,), `drawn` over a grid (G,);
    `bands` (R, 2) and `predicted_bands` (P, 2): up to where the gain is within 5 and 10 % of that at rest, Hz.
    """

    model: LoadModel
    recorded: LoadCurve
    predicted: LoadCurve
    drawn: LoadCurve
    bands: FloatArray
    predicted_bands: FloatArray
    limits: tuple[NamedLimit, ...]


@dataclass(frozen=True)
class ComponentLoads:
    """The load characteristics of one component.

    `formula_hz` (R,): √(k/(m_E + m_L))/2π with k from the lightest load alone, what a rigid load would have.
    """

    series: LoadSeries
    identification: LoadIdentification
    formula_hz: FloatArray
    solutions: tuple[Solution, ...]

    @property
    def name(self) -> str:
        """The component, Fx … Mz, or F of a table that does not say."""
        return self.series.output.component

    @property
    def k(self) -> float:
        """Coverage factor for 95 %: by the degrees of freedom where the scatter about the model makes U."""
        fit = self.identification.chosen[0]
        return coverage_factor(fit.dof[0] if fit.scatter[0] > 0.0 else np.inf)

    @property
    def covers(self) -> bool:
        """Whether there is an uncertainty at all."""
        return self.identification.chosen[0].covariance is not None


@dataclass(frozen=True)
class LoadEvaluation:
    """Load characteristics of every component of a sensor."""

    name: str
    rig: str
    sensor: str
    components: tuple[ComponentLoads, ...]
    chosen: LoadSettings
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float

    @property
    def models(self) -> tuple[LoadModel, ...]:
        """Every model, of each component in the order of its solutions."""
        return tuple(solution.model for component in self.components for solution in component.solutions)
