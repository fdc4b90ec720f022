"""What an identified sensor consists of."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.identify.fit import JointFit
from fusion.identify.readings import Reading
from fusion.identify.sensor import SensitivityResult
from fusion.manifest import Sensor
from fusion.notices import Notice
from shaker.models.measured import ParameterEstimate
from shaker.models.sensor.sensor_model import SensorModel
from shaker.models.sensor.usable_band import UsableBand


@dataclass(frozen=True)
class ComponentResult:
    """Everything found of one component of the sensor.

    `internal_mass`: value, u and unit of what moves with the load inside the sensor; `sensitivity`: None without
    evaluated sines of this component; `model`: what a correction needs, supported by data in `range_hz`; `bands`: one
    per load mass `loads`.
    """

    fit: JointFit
    internal_mass: ParameterEstimate
    readings: tuple[Reading, ...]
    sensitivity: SensitivityResult | None
    model: SensorModel
    range_hz: tuple[float, float]
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
