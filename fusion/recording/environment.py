"""The model of the surroundings in rig.toml: gravity, the place, the air, temperatures, and what moves along."""

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
U_STATED_AIR = 0.01  # relative, of an air density without any other statement
STRAIN = size_range(0.0, 0.01, "m/m", **{"µm/m": 1e-6})
AIR = size_range(0.01, 20.0, "kg/m^3", **{"g/cm^3": 1e3})


def _gravity(value: object) -> tuple[float, ...]:
    """The acceleration of free fall as it is on Earth."""
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
    """The surroundings: gravity m/s^2 in sensor axes, the place, the air, temperatures, and what moves along.

    `latitude` °, `height` m above the sea; `temperature` °C of the air, `air_density` kg/m^3, `pressure` Pa, relative
    `humidity`; `sensor_temperature` °C. `support_motion`: how much what carries lasers and cameras may move, over the
    motion that they measure. `base_strain`: largest amplitude of strain of what the sensor stands on, m/m.
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
    def _gravity_is_told_whole(self) -> Self:
        if self.latitude is not None and self.height is None and self.gravity is None:
            raise refusal(
                "the height above the sea in m that belongs to latitude",
                "no such key",
                key="height",
                declared=MISSING_KEY,
            )
        if self.gravity is not None and self.down is not None:
            raise refusal(
                "no such key beside gravity, which points down",
                describe(self.down),
                key="down",
                declared=KEY_NOT_APPLICABLE,
            )
        if self.down is not None and self.latitude is None:
            raise refusal(
                "the latitude in degrees, of which and of height gravity along down follows",
                "no such key",
                key="latitude",
                declared=MISSING_KEY,
            )
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
    def air(self) -> SourcedValue:
        """Return the density of the air, kg/m^3: as stated, else what pressure, temperature, humidity and height say.

        Of what is not stated the usual conditions of a laboratory are taken, with their uncertainty.
        """
        if self.air_density is not None:
            return SourcedValue(self.air_density, U_STATED_AIR * self.air_density, "stated in rig.toml")
        return air_density_at(self.height, self.pressure, self.temperature, self.humidity)
