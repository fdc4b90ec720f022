"""The models of rig.toml, key by key: the sensor under test, what is mounted, the stereo pairs, the surroundings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from fusion.instruments.transducer import TRANSDUCERS
from fusion.recording.values import (
    ZERO3,
    ZERO6,
    ZERO33,
    Block,
    BodyName,
    Direction,
    ExistingFile,
    Exposure,
    FreeVector,
    Inertia,
    InertiaSpread,
    NotNegative,
    Number,
    PoseSpread,
    Positive,
    Rotation,
    Spread3,
    Text,
    Vector3,
    Vector6,
    array_of_tables,
    describe,
    positive,
    refusal,
    refuse_repeated,
    rows_of,
    spread,
    texts,
    vector,
)
from shaker.static_rotation.harmonics import Known, air_density_at, gravity_at

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

OTHER_UNITS = {"force": "N", "voltage": "V"}
CONVENTIONAL_AIR_DENSITY = 1.2  # kg/m^3, OIML D 28
CONVENTIONAL_WEIGHT_DENSITY = 8000.0  # kg/m^3, OIML D 28
GRAVITY_ON_EARTH = (9.7, 9.9)  # m/s^2
U_STATED_AIR = 0.01  # relative, of an air density without any other statement


def _gravity(value: object) -> tuple[float, ...]:
    """The acceleration of free fall as it is on Earth."""
    elements = vector(3)(value)
    low, high = GRAVITY_ON_EARTH
    length = float(np.linalg.norm(elements))
    if not low <= length <= high:
        raise refusal(f"an acceleration of {low} to {high} m/s^2 (or no such key)", f"{length:g} m/s^2")
    return elements


def _outputs(value: object) -> tuple[str, ...]:
    """Names of the outputs of the sensor: one to six different texts."""
    names = texts(value)
    if not 1 <= len(names) <= 6:
        raise refusal("one to six different names", f"{len(names)}")
    return names


def _sensitivity_rows(value: object) -> tuple[tuple[float, ...], ...]:
    """Rows of six numbers; their number is checked against the channels."""
    if not isinstance(value, list | tuple):
        raise refusal("one row of 6 numbers per channel", describe(value))
    return tuple(vector(6)(row) for row in value)


class Sensor(Block):
    """The sensor under test: its outputs, their sense, and the mass that moves above its elastic element."""

    name: Text
    serial: str = ""
    channels: Annotated[tuple[str, ...], BeforeValidator(_outputs)]
    unit: Text
    sense: Literal["on_load", "on_sensor"]
    capacity: Annotated[Vector6 | None, BeforeValidator(positive(vector(6), "6 numbers above 0"))] = None
    static_sensitivity: Annotated[tuple[Vector6, ...] | None, BeforeValidator(_sensitivity_rows)] = None
    static_sensitivity_uncertainty: NotNegative = 0.0
    temperature_coefficient: Number | None = None
    temperature_coefficient_uncertainty: NotNegative = 0.0
    reference_temperature: Number = 23.0
    internal_mass: NotNegative
    internal_mass_uncertainty: NotNegative = 0.0
    internal_centre_of_mass: FreeVector = ZERO3
    internal_centre_of_mass_uncertainty: Spread3 = ZERO3
    internal_inertia: Inertia = ZERO33
    internal_inertia_uncertainty: InertiaSpread = ZERO33

    @model_validator(mode="after")
    def _one_row_per_channel(self) -> Self:
        rows = self.static_sensitivity
        if rows is not None and len(rows) != len(self.channels):
            raise refusal(f"{len(self.channels)} rows, one per channel", f"{len(rows)} rows", key="static_sensitivity")
        return self

    def moving(self, component: int) -> tuple[float, float]:
        """Return what moves with the load along a component, mass or moment of inertia, and its u."""
        if component < 3:
            return self.internal_mass, self.internal_mass_uncertainty
        axis = component - 3
        return float(self.internal_inertia[axis][axis]), float(self.internal_inertia_uncertainty[axis][axis])


class Mounted(Block):
    """A rigid thing with mass: what the load and every further part have in common.

    `inertia` (3, 3): about the centre of mass, products −∫xy dm.
    """

    mass: Positive
    mass_uncertainty: NotNegative = 0.0
    mass_kind: Literal["true", "conventional"] = "true"
    density: Positive | None = None
    centre_of_mass: FreeVector
    centre_of_mass_uncertainty: Spread3 = ZERO3
    inertia_uncertainty: InertiaSpread = ZERO33

    @model_validator(mode="after")
    def _conventional_mass_has_density(self) -> Self:
        if self.mass_kind == "conventional" and self.density is None:
            raise refusal('the density in kg/m^3 that mass_kind = "conventional" needs', "nothing", key="density")
        if self.density is not None and self.density <= CONVENTIONAL_AIR_DENSITY:
            raise refusal("a density above that of air", f"{self.density:g}", key="density")
        return self

    @property
    def true_mass(self) -> float:
        """True mass, kg: m_c·(1 − 1.2/8000)/(1 − 1.2/ρ) of a conventional mass (OIML D 28, 5.4)."""
        if self.mass_kind == "true" or self.density is None:
            return self.mass
        reference = 1 - CONVENTIONAL_AIR_DENSITY / CONVENTIONAL_WEIGHT_DENSITY
        return self.mass * reference / (1 - CONVENTIONAL_AIR_DENSITY / self.density)


class Load(Mounted):
    """Everything mounted above the sensor, without the sensor's own part.

    `elastic_frequency`: at which the load resonates on its joint with the lower side held, Hz, component by component;
    without an uncertainty it is only named: nothing is corrected, and the whole effect is uncertain.
    """

    inertia: Inertia
    elastic_frequency: Annotated[
        Vector6 | None, BeforeValidator(positive(spread(6), "a number or 6 numbers, all above 0"))
    ] = None
    elastic_frequency_uncertainty: Annotated[Vector6, BeforeValidator(spread(6))] = ZERO6
    elastic_damping: NotNegative = 0.0


class Part(Mounted):
    """A further part of the load or of the base; without inertia it is a point mass."""

    name: Text
    body: BodyName
    inertia: Inertia = ZERO33
    below_joint: bool = False


class Environment(Block):
    """The surroundings: gravity m/s^2 in sensor axes, the place, the air, temperatures, and what moves along.

    `latitude` °, `height` m above the sea; `temperature` °C of the air, `air_density` kg/m^3, `pressure` Pa, relative
    `humidity`; `sensor_temperature` °C. `support_motion`: how much what carries lasers and cameras may move, over the
    motion that they measure.
    """

    gravity: Annotated[Vector3 | None, BeforeValidator(_gravity)] = None
    gravity_uncertainty: Spread3 = ZERO3
    down: Direction | None = None
    temperature: Number | None = None
    air_density: Positive | None = None
    latitude: Annotated[float | None, Field(ge=-90, le=90, allow_inf_nan=False)] = None
    height: Annotated[float | None, Field(ge=-500, le=9000, allow_inf_nan=False)] = None
    pressure: Annotated[float | None, Field(ge=3e4, le=1.2e5, allow_inf_nan=False)] = None
    humidity: Annotated[float | None, Field(ge=0, le=1, allow_inf_nan=False)] = None
    sensor_temperature: Number | None = None
    sensor_temperature_uncertainty: NotNegative = 0.0
    support_motion: NotNegative | None = None

    @model_validator(mode="after")
    def _latitude_has_height(self) -> Self:
        if self.latitude is not None and self.height is None and self.gravity is None:
            raise refusal("the height above the sea in m that belongs to latitude", "nothing", key="height")
        if self.gravity is not None and self.down is not None:
            raise refusal("no such key beside gravity, which points down", describe(self.down), key="down")
        return self

    @property
    def free_fall_mps2(self) -> tuple[Vector3 | None, Vector3]:
        """Return gravity (3,) in sensor axes with its u, as stated, or of latitude and height along `down`; else None.

        The direction of `down` counts as exact; who knows how exact it is states `gravity` and its uncertainty.
        """
        if self.gravity is not None or self.down is None or self.latitude is None:
            return self.gravity, self.gravity_uncertainty
        size = gravity_at(float(np.radians(self.latitude)), self.height or 0.0)
        x, y, z = self.down
        spread = (size.u * abs(x), size.u * abs(y), size.u * abs(z))
        return (size.value * x, size.value * y, size.value * z), spread

    @property
    def air(self) -> Known:
        """Return the density of the air, kg/m^3: as stated, else what pressure, temperature, humidity and height say.

        Of what is not stated the usual conditions of a laboratory are taken, with their uncertainty.
        """
        if self.air_density is not None:
            return Known(self.air_density, U_STATED_AIR * self.air_density, "stated in rig.toml")
        return air_density_at(self.height, self.pressure, self.temperature, self.humidity)


class Stereo(Block):
    """A stereo pair: x_sensor = rotation · x_left_camera + translation at rest, and when its frames are exposed."""

    body: BodyName
    calibration: ExistingFile | None = None
    rotation: Rotation
    translation: FreeVector
    pose_uncertainty: PoseSpread = ZERO6
    pose_by_calibration: Annotated[tuple[tuple[float, ...], ...] | None, BeforeValidator(rows_of(6, 24))] = None
    scale_uncertainty: NotNegative | None = None
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None = None
    exposure: Exposure
    delay: Number = 0.0
    delay_uncertainty: NotNegative = 0.0


class Administration(Block):
    """What a calibration certificate needs beside the results."""

    laboratory: Text | None = None


class Rig(Block):
    """rig.toml: what does not change from run to run."""

    format: Literal[1]
    name: Text
    sensor: Sensor | None = None
    load: Load | None = None
    part: Annotated[tuple[Part, ...], BeforeValidator(array_of_tables)] = ()
    environment: Environment | None = None
    stereo: dict[str, Stereo] = Field(default_factory=dict)
    administration: Administration | None = None

    @model_validator(mode="after")
    def _parts_have_different_names(self) -> Self:
        refuse_repeated([part.name for part in self.part], "parts", "part")
        return self

    def unit_of(self, channel: ChannelEntry) -> str:
        """Return the unit of a channel after its scale."""
        if channel.quantity == "output":
            return self.sensor.unit if self.sensor else "1"
        return TRANSDUCERS[channel.quantity].unit if channel.quantity in TRANSDUCERS else OTHER_UNITS[channel.quantity]

    @property
    def surroundings(self) -> Environment:
        """Return the environment, of which nothing is known where the rig does not state it."""
        return self.environment or Environment()

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that rig.toml names."""
        return tuple(pair.calibration for pair in self.stereo.values() if pair.calibration is not None)
