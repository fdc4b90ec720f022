"""What evaluated step responses consist of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.coverage import coverage_factor
from fusion.manifest import Sensor
from fusion.models_file import ModelEntry
from fusion.notices import Notice
from fusion.step.figures import Figure
from fusion.step.pool import Pooled
from fusion.step.records import StepInput
from shaker.models.indices.result import Indices
from shaker.models.step.compare import ReleaseKind
from shaker.models.step.reading import Reading
from shaker.models.step_fit.result import StepFit

UNNAMED = "not stated"
"""What let go where no recording says it."""


@dataclass(frozen=True)
class Release:
    """One recording: its record, what every output shows, and the model of the driven output.

    `readings`: of the outputs that can be read, the driven one `driven` first; `fit`: None where no model was found.
    """

    input: StepInput
    driven: str
    readings: tuple[Reading, ...]
    fit: StepFit | None

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.input.record.name

    @property
    def reading(self) -> Reading:
        """What the driven output shows."""
        return self.readings[0]

    @property
    def release_s(self) -> float:
        """How long the load changed: by the fit, else as it was read."""
        return self.reading.release_s if self.fit is None else self.fit.release_s

    @property
    def u_release_s(self) -> float:
        """Standard uncertainty of that."""
        return self.reading.u_release_s if self.fit is None else self.fit.u_release_s


@dataclass(frozen=True)
class StaticGain:
    """Change of an output over that of the load, mean of all releases of a component.

    `u` with `dof` degrees of freedom; `stated`: what rig.toml says, None where it does not, with `u_stated`.
    """

    channel: str
    value: float
    u: float
    dof: float
    releases: int
    stated: float | None
    u_stated: float

    @property
    def k(self) -> float:
        """Return the coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> float:
        """Return U = k·u."""
        return self.k * self.u

    @property
    def normalised(self) -> float | None:
        """Return the difference from the stated value over its expanded uncertainty, None where nothing is stated."""
        if self.stated is None:
            return None
        spread = float(np.hypot(self.expanded, 2.0 * self.u_stated))
        return (self.value - self.stated) / spread if spread > 0.0 else None


@dataclass(frozen=True)
class Rope:
    """Releases by one thing: how fast and how repeatable they are, and whether the model rests on them.

    `kind`: rise of the driven output, and how long the load changed, by the models where there are.
    """

    kind: ReleaseKind
    releases: tuple[str, ...]
    used: bool

    @property
    def name(self) -> str:
        """What let go."""
        return self.kind.release or UNNAMED


@dataclass(frozen=True)
class MethodRow:
    """What one method made of one release: its model's main figures, fit and time, or why there is none."""

    fit: StepFit
    indices: Indices | None
    recording: str


@dataclass(frozen=True)
class ComponentResult:
    """Everything found of one load component.

    `channel`: the output that is driven; `releases` of all ropes, `used` of them in the model `pooled`, for the
    `reason`; `parameters`, `figures`: its numbers; `gains`: static gain of every output, the driven one first; `ropes`
    from the fastest to the slowest; `methods`: what each method made of one release. `unit`: of output over load.
    `entry`: what models.json holds. All that rests on a model is None or empty where none was found.
    """

    component: str
    channel: str
    unit: str
    releases: tuple[Release, ...]
    used: tuple[str, ...]
    reason: str
    pooled: Pooled | None
    parameters: tuple[Figure, ...]
    indices: Indices | None
    figures: tuple[Figure, ...]
    gains: tuple[StaticGain, ...]
    ropes: tuple[Rope, ...]
    methods: tuple[MethodRow, ...]
    entry: ModelEntry | None

    @property
    def chosen(self) -> tuple[Release, ...]:
        """The releases that the model rests on."""
        return tuple(release for release in self.releases if release.name in self.used)

    def figure(self, name: str) -> Figure | None:
        """Return a number by its name, None where there is none."""
        return next((one for one in (*self.parameters, *self.figures) if one.name == name), None)


@dataclass(frozen=True)
class StepEvaluation:
    """All releases of one sensor, one result per load component, notices and origin."""

    name: str
    rig: str
    sensor: Sensor | None
    components: tuple[ComponentResult, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float
