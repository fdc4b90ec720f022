"""Models of rig.toml: sensor under test, load and parts, stereo pairs, heads, environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from fusion.estimation.measurement_model import UnobservedMotion
from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.environment import Environment
from fusion.recording.recording_notices import (
    CONTRADICTING_VALUES,
    IMPOSSIBLE_MASS_PROPERTIES,
    KEY_NOT_APPLICABLE,
    MISSING_KEY,
    UNKNOWN_NAME,
    VALUE_OUT_OF_RANGE,
    WRONG_VALUE_TYPE,
)
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.values import (
    DENSITY,
    FAR,
    HERTZ,
    MODULUS,
    NEAR,
    ROWS,
    SECONDS,
    SHARE,
    WEIGHT,
    ZERO3,
    ZERO6,
    ZERO33,
    BodyName,
    Celsius,
    Delay,
    Direction,
    ExistingFile,
    Exposure,
    FreeVector,
    Inertia,
    InertiaUncertainty,
    ManifestBlock,
    Mass,
    Matrix3,
    NotNegative,
    Number,
    PoseUncertainty,
    Position,
    Positive,
    Rotation,
    RowTime,
    SensorOfCamera,
    Share,
    SurfacePlane,
    Text,
    Uncertainty3,
    Vector3,
    Vector6,
    Version,
    array_of_tables,
    describe,
    positive,
    refusal,
    refuse_as_file_names,
    refuse_foreign,
    refuse_missing,
    refuse_repeated,
    rows_of,
    texts,
    uncertainty_vector,
    vector,
)

OTHER_UNITS = {"force": "N", "voltage": "V"}
CONVENTIONAL_AIR_DENSITY = 1.2  # kg/m^3, OIML D 28
CONVENTIONAL_WEIGHT_DENSITY = 8000.0  # kg/m^3, OIML D 28
DENSEST_KGM3 = 22_600.0  # osmium
FARTHEST_M = 5.0  # radius of gyration of a body on a shaker


def _outputs(value: object) -> tuple[str, ...]:
    """Return the names of the sensor's outputs: one to six different texts."""
    names = texts(value)
    if not 1 <= len(names) <= 6:
        raise refusal("one to six different names", f"{len(names)}")
    return names


def _sensitivity_rows(value: object) -> tuple[tuple[float, ...], ...]:
    """Return rows of six numbers; the model compares their number with the channels."""
    if not isinstance(value, list | tuple):
        raise refusal("one row of 6 numbers per channel", describe(value), declared=WRONG_VALUE_TYPE)
    return tuple(vector(6)(row) for row in value)


def _refuse_impossible(mass: float, inertia: Matrix3, mass_key: str, inertia_key: str) -> None:
    """Refuse mass and inertia that no body can have.

    A mass in g, or an inertia in g mm², is a usual cause. Of all bodies of a mass and a largest density, a ball has
    the smallest inertia, 0.4·m·r² about every axis. Half of it passes, for values of few digits. All zeros represent
    a point mass.
    """
    largest = float(np.linalg.eigvalsh(np.array(inertia)).max())
    if largest <= 0.0 or mass <= 0.0:
        return
    gyration = float(np.sqrt(largest / mass))
    if gyration > FARTHEST_M:
        found = f"up to {largest:g} kg m^2 of {mass:g} kg, a radius of gyration of {gyration:.3g} m"
        raise refusal(
            "moments of inertia in kg m^2 of this mass", found, key=inertia_key, declared=IMPOSSIBLE_MASS_PROPERTIES
        )
    smallest = 0.4 * mass * (3.0 * mass / (4.0 * np.pi * DENSEST_KGM3)) ** (2.0 / 3.0)
    if largest < 0.5 * smallest:
        found = f"{mass:g} kg with moments of inertia up to {largest:g} kg m^2, denser than any metal"
        raise refusal(
            "a mass in kg with moments of inertia in kg m^2", found, key=mass_key, declared=IMPOSSIBLE_MASS_PROPERTIES
        )


class Sensor(ManifestBlock):
    """The sensor under test: outputs, sense, and the internal mass above its elastic element."""

    name: Text
    serial: str = ""
    channels: Annotated[tuple[str, ...], BeforeValidator(_outputs)]
    unit: Text
    sense: Literal["on_load", "on_sensor"]
    capacity: Annotated[Vector6 | None, BeforeValidator(positive(vector(6), "6 numbers above 0"))] = None
    static_sensitivity: Annotated[tuple[Vector6, ...] | None, BeforeValidator(_sensitivity_rows)] = None
    static_sensitivity_uncertainty: Share = 0.0
    cross_talk: Annotated[Positive, SHARE] | None = None
    cross_talk_uncertainty: NotNegative | None = None
    temperature_coefficient: Annotated[Number, SHARE] | None = None
    temperature_coefficient_uncertainty: Share = 0.0
    reference_temperature: Celsius = 23.0
    base_strain_sensitivity: NotNegative | None = None
    internal_mass: Annotated[NotNegative, WEIGHT]
    internal_mass_uncertainty: NotNegative = 0.0
    internal_centre_of_mass: Position = ZERO3
    internal_centre_of_mass_uncertainty: Uncertainty3 = ZERO3
    internal_inertia: Inertia = ZERO33
    internal_inertia_uncertainty: InertiaUncertainty = ZERO33

    @model_validator(mode="after")
    def _one_row_per_channel(self) -> Self:
        rows = self.static_sensitivity
        if rows is not None and len(rows) != len(self.channels):
            raise refusal(
                f"{len(self.channels)} rows, one per channel",
                f"{len(rows)} rows",
                key="static_sensitivity",
                declared=CONTRADICTING_VALUES,
            )
        _refuse_impossible(self.internal_mass, self.internal_inertia, "internal_mass", "internal_inertia")
        if self.cross_talk is not None and self.capacity is None:
            raise refusal(
                "the six rated loads that cross_talk is relative to",
                "no such key",
                key="capacity",
                declared=MISSING_KEY,
            )
        return self

    def moving(self, component: int) -> tuple[float, float]:
        """Return the internal mass or moment of inertia of a component, and its u."""
        if component < 3:
            return self.internal_mass, self.internal_mass_uncertainty
        axis = component - 3
        return float(self.internal_inertia[axis][axis]), float(self.internal_inertia_uncertainty[axis][axis])


class MountedBody(ManifestBlock):
    """A rigid body with mass: the common keys of the load and of further parts.

    `inertia` (3, 3): about the centre of mass, products −∫xy dm.
    """

    mass: Mass
    mass_uncertainty: NotNegative = 0.0
    mass_kind: Literal["true", "conventional"] = "true"
    density: Annotated[Positive, DENSITY] | None = None
    centre_of_mass: Position
    centre_of_mass_uncertainty: Uncertainty3 = ZERO3
    inertia_uncertainty: InertiaUncertainty = ZERO33

    @model_validator(mode="after")
    def _conventional_mass_has_density(self) -> Self:
        if self.mass_kind == "conventional" and self.density is None:
            raise refusal(
                'the density in kg/m^3 that mass_kind = "conventional" needs',
                "no such key",
                key="density",
                declared=MISSING_KEY,
            )
        _refuse_impossible(self.mass, getattr(self, "inertia", ZERO33), "mass", "inertia")
        return self

    @property
    def true_mass(self) -> float:
        """True mass in kg.

        m_c·(1 − 1.2/8000)/(1 − 1.2/ρ) if m_c is conventional (OIML D 28, 5.4).
        """
        if self.mass_kind == "true" or self.density is None:
            return self.mass
        reference = 1 - CONVENTIONAL_AIR_DENSITY / CONVENTIONAL_WEIGHT_DENSITY
        return self.mass * reference / (1 - CONVENTIONAL_AIR_DENSITY / self.density)


def _displacements(value: object) -> dict[str, tuple[float, ...]]:
    """Return displacements of a mode by name: 3 numbers, or 6 with the rotation."""
    if not isinstance(value, dict) or not value:
        raise refusal(
            "a table of 3 or 6 numbers by the names of channels and stereo pairs",
            describe(value),
            declared=WRONG_VALUE_TYPE,
        )
    return {
        name: vector(6 if isinstance(row, list | tuple) and len(row) == 6 else 3)(row) for name, row in value.items()
    }


def _refuse_as_large(block: ManifestBlock, keys: Sequence[str]) -> None:
    """Refuse a value that is not larger than its standard uncertainty."""
    for key in keys:
        value, u = getattr(block, key), getattr(block, f"{key}_uncertainty")
        if value is not None and u > 0.0 and u >= value:
            raise refusal(
                f"less than the {key} of {value:g}", f"{u:g}", key=f"{key}_uncertainty", declared=VALUE_OUT_OF_RANGE
            )


class ElasticMode(ManifestBlock):
    """A natural mode of the load on a fixed foot, from a finite element program.

    `participation` (6,): force and moment at the sensor origin for a unit acceleration of the mode. `displacement`: of
    channels and stereo pairs by name. Both are for a mode of `modal_mass`.
    """

    frequency: Annotated[Positive, HERTZ]
    frequency_uncertainty: NotNegative = 0.0
    damping: Share | None = None
    participation: Annotated[Vector6, BeforeValidator(vector(6))]
    modal_mass: Positive = 1.0
    displacement: Annotated[dict[str, tuple[float, ...]], BeforeValidator(_displacements)]
    surface: ExistingFile | None = None

    @model_validator(mode="after")
    def _frequency_exceeds_its_uncertainty(self) -> Self:
        _refuse_as_large(self, ("frequency",))
        return self


DRAWN = ("foot", "axis", "poisson_ratio", "axial_frequency", "bending_frequency")
KEYS_OF_SHAPE = {
    "rod": ("young_modulus", "density", "diameter", "length", "name", *DRAWN, "inner_diameter", "tip_mass"),
    "plate": ("young_modulus", "density", "diameter", "thickness", "clamped_diameter", *DRAWN),
    "modes": ("mode",),
}
"""Keys of `[[load.elastic]]` by shape; the first five are required."""


POSITIVE = (
    *("length", "diameter", "thickness", "clamped_diameter", "young_modulus", "density"),
    *("tip_mass", "axial_frequency", "bending_frequency"),
)
"""Numbers of a drawing that must exceed 0."""


class Elastic(ManifestBlock):
    """An elastic part of the load: rod, plate, or table of modes.

    Without any uncertainty there is no correction, and the whole effect is uncertain.
    """

    name: Text
    shape: Literal["rod", "plate", "modes"]
    foot: Position = ZERO3
    axis: Direction | None = None
    length: Annotated[Positive, NEAR] | None = None
    length_uncertainty: NotNegative = 0.0
    diameter: Annotated[Positive, NEAR] | None = None
    diameter_uncertainty: NotNegative = 0.0
    inner_diameter: Annotated[NotNegative, NEAR] = 0.0
    inner_diameter_uncertainty: NotNegative = 0.0
    thickness: Annotated[Positive, NEAR] | None = None
    thickness_uncertainty: NotNegative = 0.0
    clamped_diameter: Annotated[Positive, NEAR] | None = None
    clamped_diameter_uncertainty: NotNegative = 0.0
    young_modulus: Annotated[Positive, MODULUS] | None = None
    young_modulus_uncertainty: NotNegative = 0.0
    density: Annotated[Positive, DENSITY] | None = None
    density_uncertainty: NotNegative = 0.0
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.3
    poisson_ratio_uncertainty: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    tip_mass: Annotated[NotNegative, WEIGHT] = 0.0
    tip_mass_uncertainty: NotNegative = 0.0
    axial_frequency: Annotated[Positive, HERTZ] | None = None
    axial_frequency_uncertainty: NotNegative = 0.0
    bending_frequency: Annotated[Positive, HERTZ] | None = None
    bending_frequency_uncertainty: NotNegative = 0.0
    damping: Share = 0.0
    damping_uncertainty: NotNegative = 0.0
    frequencies_uncertainty: Annotated[float, Field(ge=0, lt=1)] = 0.0
    participation_uncertainty: Annotated[float, Field(ge=0, lt=1)] = 0.0
    measured_by: Annotated[tuple[str, ...], BeforeValidator(texts)] = ()
    mode: Annotated[tuple[ElasticMode, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _is_measured_against_what_is_stated(self) -> Self:
        if not self.measured_by:
            return self
        stated = (getattr(self, key) for key in type(self).model_fields if key.endswith("_uncertainty"))
        if not any(stated) and not any(mode.frequency_uncertainty for mode in self.mode):
            raise refusal(
                "an uncertainty, such as frequencies_uncertainty = 0.1", "none", key="measured_by", declared=MISSING_KEY
            )
        if self.shape == "modes" and not any(mode.surface for mode in self.mode):
            raise refusal("the surface of at least one mode", "none", key="measured_by", declared=MISSING_KEY)
        return self

    @model_validator(mode="after")
    def _has_what_its_shape_needs(self) -> Self:
        of_modes = {
            "name",
            "shape",
            "damping",
            "damping_uncertainty",
            "frequencies_uncertainty",
            "participation_uncertainty",
            "measured_by",
        }
        keys = KEYS_OF_SHAPE[self.shape]
        applicable = {*of_modes, *(name for key in keys for name in (key, f"{key}_uncertainty"))}
        refuse_foreign(self, applicable, f'shape = "{self.shape}"')
        if self.shape == "modes":
            if not self.mode:
                raise refusal("at least one [[load.elastic.mode]]", "no such key", key="mode", declared=MISSING_KEY)
            names = set(self.mode[0].displacement)
            for number, mode in enumerate(self.mode, 1):
                if set(mode.displacement) != names:
                    found = f"{', '.join(sorted(mode.displacement))} in mode {number}"
                    raise refusal(
                        f"the names {', '.join(sorted(names))} of mode 1",
                        found,
                        key="mode",
                        declared=CONTRADICTING_VALUES,
                    )
            return self
        refuse_missing(self, keys[:5], f'shape = "{self.shape}"')
        _refuse_as_large(self, POSITIVE)
        key = "inner_diameter" if self.shape == "rod" else "clamped_diameter"
        inner, outer, u = getattr(self, key) or 0.0, self.diameter or 0.0, getattr(self, f"{key}_uncertainty")
        if max(inner + u, inner + self.diameter_uncertainty) >= outer:
            raise refusal(
                f"less than the diameter of {outer:g} m, by more than either uncertainty",
                f"{inner:g}",
                key=key,
                declared=CONTRADICTING_VALUES,
            )
        return self


class RigLoad(MountedBody):
    """All bodies above the sensor, without the sensor's internal mass.

    `elastic_frequency`: resonance of the load on its joint with a fixed lower side, Hz, per component. Without an
    uncertainty there is no correction, and the whole effect is uncertain. `elastic`: elastic parts of the load.
    `first_frequency`: first resonance on a fixed foot, if no modes are available. `cable_stiffness`: of connections to
    the surroundings, N/m along each axis.
    """

    inertia: Inertia
    elastic: Annotated[tuple[Elastic, ...], BeforeValidator(array_of_tables)] = ()
    first_frequency: Annotated[
        Vector6 | None, BeforeValidator(positive(uncertainty_vector(6), "a number or 6 numbers, all above 0"))
    ] = None
    elastic_frequency: Annotated[
        Vector6 | None, BeforeValidator(positive(uncertainty_vector(6), "a number or 6 numbers, all above 0"))
    ] = None
    elastic_frequency_uncertainty: Annotated[Vector6, BeforeValidator(uncertainty_vector(6))] = ZERO6
    elastic_damping: Share = 0.0
    cable_stiffness: Annotated[Vector3 | None, BeforeValidator(uncertainty_vector(3))] = None
    cable_stiffness_uncertainty: Uncertainty3 = ZERO3

    @model_validator(mode="after")
    def _elastic_parts_have_different_names(self) -> Self:
        refuse_repeated([part.name for part in self.elastic], "elastic parts", "elastic")
        if self.cable_stiffness is None and any(self.cable_stiffness_uncertainty):
            raise refusal(
                "the stiffness that this uncertainty belongs to (0 if there is none)",
                "no such key",
                key="cable_stiffness",
                declared=MISSING_KEY,
            )
        if self.elastic and self.first_frequency is not None:
            expected = "either the modes of [[load.elastic]] or a first frequency that bounds them"
            raise refusal(expected, "both", key="first_frequency", declared=CONTRADICTING_VALUES)
        return self


class RigPart(MountedBody):
    """A further part of the load or of the base; a point mass without inertia."""

    name: Text
    body: BodyName
    inertia: Inertia = ZERO33
    below_joint: bool = False


class Stereo(ManifestBlock):
    """A stereo pair: x_sensor = rotation · x_left_camera + translation at rest, and its exposure.

    `row_time`: s from row to row of the left and the right camera, negative if the last row is read first; 0 for a
    global shutter.

    `body` "room": a stationary object, which shows the motion of the `support` of the cameras. A pair with a `surface`
    is a single camera, the left one.
    """

    body: Literal["load", "base", "room"]
    support: Text | None = None
    calibration: ExistingFile | None = None
    surface: SurfacePlane | None = None
    rotation: Rotation
    translation: Annotated[FreeVector, FAR]
    pose_uncertainty: PoseUncertainty = ZERO6
    pose_by_calibration: Annotated[tuple[tuple[float, ...], ...] | None, BeforeValidator(rows_of(6, 32, 24))] = None
    scale_uncertainty: Share | None = None
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None = None
    exposure: Exposure
    delay: Delay = 0.0
    delay_uncertainty: Annotated[NotNegative, SECONDS] = 0.0
    row_time: RowTime = (0.0, 0.0)
    row_time_uncertainty: Annotated[NotNegative, ROWS] = 0.0
    left: SensorOfCamera | None = None
    right: SensorOfCamera | None = None

    def readout_s(self, rows: int) -> float:
        """Return the delay from the first to the last of some rows, s."""
        return max(map(abs, self.row_time)) * (rows - 1)

    @model_validator(mode="after")
    def _depth_is_stated_once(self) -> Self:
        if self.surface is not None and self.pose_by_calibration is not None:
            expected = "no such key for a single camera with a surface"
            raise refusal(expected, "one", key="pose_by_calibration", declared=KEY_NOT_APPLICABLE)
        return self


class InstrumentHead(ManifestBlock):
    """A laser head, or the body of a triaxial accelerometer: common properties of its channels.

    `mirror`: origin of the beams, sensor frame. `standoff`: its distance from the points, if the mirror is not stated.
    `rotation_uncertainty` rad about the sensor axes, `point_uncertainty` m: common to all its channels.
    """

    mirror: FreeVector | None = None
    mirror_uncertainty: Uncertainty3 = ZERO3
    standoff: Positive | None = None
    rotation_uncertainty: Uncertainty3 = ZERO3
    point_uncertainty: Uncertainty3 = ZERO3

    @model_validator(mode="after")
    def _mirror_is_stated_once(self) -> Self:
        if self.mirror is not None and self.standoff is not None:
            raise refusal(
                "no such key in addition to the mirror",
                f"{self.standoff:g}",
                key="standoff",
                declared=KEY_NOT_APPLICABLE,
            )
        if self.mirror is None and any(self.mirror_uncertainty):
            raise refusal("the mirror whose uncertainty is stated", "no such key", key="mirror", declared=MISSING_KEY)
        return self


@dataclass(frozen=True)
class NamedHead:
    """A head of the rig, with its name."""

    name: str
    stated: InstrumentHead


class Shaker(ManifestBlock):
    """Limits of shaker motion in components that are not measured, over the driven amplitude.

    `rocking_motion`: rotations times 0.1 m.
    """

    transverse_motion: Positive = UnobservedMotion.transverse
    rocking_motion: Positive = UnobservedMotion.rocking

    @property
    def unobserved_motion(self) -> UnobservedMotion:
        """The limits for the fusion."""
        return UnobservedMotion(self.transverse_motion, self.rocking_motion)


class ModelChange(ManifestBlock):
    """Relative standard uncertainties of changes of a model.

    They apply to the frequencies of all modes together, to their damping ratios, to the static gain.
    """

    frequency_uncertainty: NotNegative = 0.0
    damping_ratio_uncertainty: NotNegative = 0.0
    gain_uncertainty: NotNegative = 0.0


class TemperatureChange(ManifestBlock):
    """One unknown temperature difference, K, and relative changes per K.

    `gain_coefficient`: the sensor's `temperature_coefficient` by default.
    """

    difference_uncertainty: NotNegative
    frequency_coefficient: Number = 0.0
    damping_ratio_coefficient: Number = 0.0
    gain_coefficient: Number | None = None


class ModelChanges(ManifestBlock):
    """Changes of a sensor model that its recordings cannot show."""

    mounting: ModelChange | None = None
    load: ModelChange | None = None
    temperature: TemperatureChange | None = None
    structure: ModelChange | None = None


class RigAdministration(ManifestBlock):
    """Statements for a calibration certificate."""

    laboratory: Text | None = None


class Rig(ManifestBlock):
    """rig.toml: the properties that do not change between recordings."""

    format: Version
    name: Text
    sensor: Sensor | None = None
    load: RigLoad | None = None
    part: Annotated[tuple[RigPart, ...], BeforeValidator(array_of_tables)] = ()
    environment: Environment | None = None
    stereo: dict[str, Stereo] = Field(default_factory=dict)
    head: dict[str, InstrumentHead] = Field(default_factory=dict)
    shaker: Shaker | None = None
    model: ModelChanges | None = None
    administration: RigAdministration | None = None
    acknowledged: Annotated[tuple[Acknowledgement, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _parts_have_different_names(self) -> Self:
        refuse_repeated([part.name for part in self.part], "parts", "part")
        refuse_as_file_names(self.stereo, "stereo")
        return self

    @model_validator(mode="after")
    def _modes_are_measured_on_the_load(self) -> Self:
        pairs = [name for name, pair in self.stereo.items() if pair.body == "load" and pair.surface is None]
        for part in self.load.elastic if self.load is not None else ():
            for name in part.measured_by:
                if name not in pairs:
                    expected = f"a stereo pair of two cameras at the load ({', '.join(pairs) or 'none'})"
                    raise refusal(expected, name, key=f"load.elastic.{part.name}.measured_by", declared=UNKNOWN_NAME)
        return self

    def unit_of(self, quantity: str) -> str:
        """Return the unit of a channel of a quantity after its scale."""
        if quantity == "output":
            return self.sensor.unit if self.sensor else "1"
        return TRANSDUCERS[quantity].unit if quantity in TRANSDUCERS else OTHER_UNITS[quantity]

    @property
    def surroundings(self) -> Environment:
        """The environment; empty if the rig does not state it."""
        return self.environment or Environment()

    @property
    def files(self) -> tuple[Path, ...]:
        """Files named in rig.toml."""
        calibrations = [pair.calibration for pair in self.stereo.values()]
        parts = self.load.elastic if self.load is not None else ()
        surfaces = [mode.surface for part in parts for mode in part.mode]
        return tuple(file for file in (*calibrations, *surfaces) if file is not None)
