"""What an identified sensor consists of."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.identify.fit import JointFit
from fusion.identify.readings import Reading
from fusion.manifest import Sensor
from fusion.notices import Notice
from shaker.models.correction import SensorModel, UsableBand
from shaker.models.measured import MeasuredSensitivity, ParameterEstimate
from shaker.models.sensor_response import SensitivityComparison


@dataclass(frozen=True)
class SensitivityResult:
    """The sensitivity of one output over frequency, as measured and as explained."""

    measured: MeasuredSensitivity
    comparison: SensitivityComparison


@dataclass(frozen=True)
class ComponentResult:
    """Everything found of one component of the sensor.

    `internal_mass`: value, u and unit of what moves with the load inside the sensor; `sensitivity`: None without
    evaluated sines of this component; `model`: what a correction needs; `bands`: one per load mass `loads`.
    """

    fit: JointFit
    internal_mass: ParameterEstimate
    readings: tuple[Reading, ...]
    sensitivity: SensitivityResult | None
    model: SensorModel
    loads: tuple[float, ...]
    bands: tuple[UsableBand, ...]

    @property
    def name(self) -> str:
        """Name of the component: x, y, z, rx, ry or rz."""
        return self.fit.axis


@dataclass(frozen=True)
class IdentifyEvaluation:
    """A campaign's identification: the sensor, one result per driven component, notices and origin."""

    name: str
    sensor: Sensor | None
    components: tuple[ComponentResult, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float
