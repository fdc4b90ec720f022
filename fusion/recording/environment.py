"""Model of the environment in rig.toml: gravity, location, air, temperatures, support motion."""

from __future__ import annotations

from math import hypot
from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from fusion.recording.recording_notices import (
    KEY_NOT_APPLICABLE,
    MISSING_KEY,
    VALUE_OUT_OF_RANGE,
)
from fusion.recording.values import (
    ZERO3,
    Celsius,
    Direction,
    ManifestBlock,
    NotNegative,
    Positive,
    Share,
    Uncertainty3,
    Vector3,
    describe,
    refusal,
    size_range,
    vector,
)
from shaker.static_rotation.harmonics import SourcedValue, air_density_at, gravity_at

GRAVITY_ON_EARTH = (9.7, 9.9)  # m/s^2
U_STATED_AIR = 0.01  # relative, of a stated air density: weather and height change it by more
STRAIN = size_range(0.0, 0.01, "m/m", **{"µm/m": 1e-6})
AIR = size_range(0.01, 20.0, "kg/m^3", **{"g/cm^3": 1e3})


def _gravity(value: object) -> tuple[float, ...]:
    """Return the acceleration of free fall if it is one on Earth."""
    elements = vector(3)(value)
    low, high = GRAVITY_ON_EARTH
    length = hypot(*elements)
    if not low <= length <= high:
        raise refusal(
            f"an acceleration of {low} to {high} m/s^2 (or no such key)",
            f"{length:g} m/s^2",
            declared=VALUE_OUT_OF_RANGE,
        )
    return elements


class Environment(ManifestBlock):
    """The environment: gravity m/s^2 in sensor axes, location, air, temperatures, support motion.

    `latitude` °, `height` m above the sea; `temperature` °C of the air, `air_density` kg/m^3, `pressure` Pa, relative
    `humidity`; `sensor_temperature` °C. `support_motion`: limit of the motion of the supports of lasers and cameras,
    over the motion that they measure. `base_strain`: largest strain amplitude of the sensor's support, m/m.
    """

    gravity: Annotated[Vector3 | None, BeforeValidator(_gravity)] = None
    gravity_uncertainty: Uncertainty3 = ZERO3
    down: Direction | None = None
    temperature: Celsius | None = None
    air_density: Annotated[Positive, AIR] | None = None
    latitude: Annotated[float | None, Field(ge=-90, le=90, allow_inf_nan=False)] = None
    height: Annotated[float | None, Field(ge=-500, le=9000, allow_inf_nan=False)] = None
    pressure: Annotated[float | None, Field(ge=3e4, le=1.2e5, allow_inf_nan=False)] = None
    humidity: Annotated[float | None, Field(ge=0, le=1, allow_inf_nan=False)] = None
    sensor_temperature: Celsius | None = None
    sensor_temperature_uncertainty: NotNegative = 0.0
    support_motion: Share | None = None
    base_strain: Annotated[NotNegative, STRAIN] | None = None

    @model_validator(mode="after")
    def _gravity_is_complete(self) -> Self:
        if self.latitude is not None and self.height is None and self.gravity is None:
            raise refusal(
                "the height above the sea in m that belongs to latitude",
                "no such key",
                key="height",
                declared=MISSING_KEY,
            )
        if self.gravity is not None and self.down is not None:
            raise refusal(
                "no such key in addition to gravity, which points down",
                describe(self.down),
                key="down",
                declared=KEY_NOT_APPLICABLE,
            )
        if self.down is not None and self.latitude is None:
            raise refusal(
                "the latitude in degrees, from which gravity along down follows",
                "no such key",
                key="latitude",
                declared=MISSING_KEY,
            )
        return self

    @property
    def free_fall_mps2(self) -> tuple[Vector3 | None, Vector3]:
        """Return gravity (3,) in sensor axes with its u; None if it is not stated.

        It may follow from latitude and height.

        The direction of `down` is treated as exact. State `gravity` and its uncertainty otherwise.
        """
        if self.gravity is not None or self.down is None or self.latitude is None:
            return self.gravity, self.gravity_uncertainty
        size = gravity_at(float(np.radians(self.latitude)), self.height or 0.0)
        x, y, z = self.down
        u = (size.u * abs(x), size.u * abs(y), size.u * abs(z))
        return (size.value * x, size.value * y, size.value * z), u

    @property
    def air(self) -> SourcedValue:
        """Return the density of the air, kg/m^3: stated, else from pressure, temperature, humidity and height.

        Usual laboratory conditions with their uncertainty replace missing values.
        """
        if self.air_density is not None:
            return SourcedValue(self.air_density, U_STATED_AIR * self.air_density, "stated in rig.toml")
        return air_density_at(self.height, self.pressure, self.temperature, self.humidity)
