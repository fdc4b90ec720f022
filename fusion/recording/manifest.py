"""The models of rig.toml and recording.toml: what stands in them, key by key.

rig.toml: the sensor under test, what is mounted, the stereo pairs, the surroundings. recording.toml: one excitation,
the DAQ files with their channels, the images or points.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from fusion.instruments.transducer import TRANSDUCERS
from fusion.recording.excitation import Excitation
from fusion.recording.values import (
    ZERO3,
    ZERO6,
    ZERO33,
    Block,
    BodyName,
    Context,
    Direction,
    ExistingFile,
    ExistingFiles,
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
    refuse_foreign,
    refuse_missing,
    refuse_repeated,
    repeated_name,
    rows_of,
    spread,
    texts,
    vector,
)

if TYPE_CHECKING:
    Quantity = str
else:
    Quantity = Literal[(*TRANSDUCERS, "force", "output", "voltage", "trigger")]
DAQ_SUFFIXES = (".h5", ".hdf5", ".tdms", ".uff", ".unv", ".mat", ".csv", ".wav", ".lvm", ".asc")
OTHER_UNITS = {"force": "N", "voltage": "V"}
MINIMUM_FRAMES = 3
COORDINATES = ("x", "y", "z")
REFERENCE_COORDINATES = ("x0", "y0", "z0")
COLUMNS = ("frame", "status", *REFERENCE_COORDINATES, *COORDINATES, "_")
CONVENTIONAL_AIR_DENSITY = 1.2  # kg/m^3, OIML D 28
CONVENTIONAL_WEIGHT_DENSITY = 8000.0  # kg/m^3, OIML D 28
GRAVITY_ON_EARTH = (9.7, 9.9)  # m/s^2


# rig.toml


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
    """The surroundings: gravity m/s^2 in sensor axes, the place, the air.

    `latitude` °, `height` m above the sea; `temperature` °C, `air_density` kg/m^3, `pressure` Pa, relative `humidity`.
    """

    gravity: Annotated[Vector3 | None, BeforeValidator(_gravity)] = None
    gravity_uncertainty: Spread3 = ZERO3
    temperature: Number | None = None
    air_density: Positive | None = None
    latitude: Annotated[float | None, Field(ge=-90, le=90, allow_inf_nan=False)] = None
    height: Annotated[float | None, Field(ge=-500, le=9000, allow_inf_nan=False)] = None
    pressure: Annotated[float | None, Field(ge=3e4, le=1.2e5, allow_inf_nan=False)] = None
    humidity: Annotated[float | None, Field(ge=0, le=1, allow_inf_nan=False)] = None


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


# recording.toml


def _columns(value: object) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise refusal("a list of column names", describe(value))
    unknown = next((name for name in value if name not in COLUMNS and not name.startswith("id")), None)
    if unknown is not None:
        raise refusal("columns of " + ", ".join(COLUMNS) + " and id…", f'"{unknown}"')
    single = [name for name in value if name not in ("_", "status")]
    twice = repeated_name(single)
    if twice is not None:
        raise refusal("each column once", f'"{twice}" twice')
    missing = [name for name in COORDINATES if name not in single]
    if missing or 0 < len(set(REFERENCE_COORDINATES) & set(single)) < 3:
        raise refusal("the columns x, y, z and either all or none of x0, y0, z0", ", ".join(value))
    return tuple(value)


def _daq_suffix(value: Path) -> Path:
    if value.suffix.lower() not in DAQ_SUFFIXES:
        raise refusal("a file that ends in one of " + " ".join(DAQ_SUFFIXES), f"{value.name}")
    return value


class ChannelEntry(Block):
    """One channel of a DAQ file: true phasor = file value · scale · exp(+jω·delay) / response(f)."""

    name: Text
    quantity: Quantity
    body: BodyName | None = None
    point: FreeVector | None = None
    point_uncertainty: Spread3 = ZERO3
    direction: Direction | None = None
    direction_uncertainty: NotNegative = 0.0
    channel: Text | None = None
    scale: Number = 1.0
    scale_uncertainty: NotNegative = 0.0
    common: Text | None = None
    individual_uncertainty: NotNegative = 0.0
    transverse_sensitivity: NotNegative = 0.0
    delay: Number = 0.0
    delay_uncertainty: NotNegative = 0.0
    response: ExistingFile | None = None
    reference: bool = False
    threshold: Number | None = None
    edge: Literal["rising", "falling"] = "rising"

    ANY: ClassVar[tuple[str, ...]] = ("name", "quantity", "delay", "delay_uncertainty", "response")
    VALUE: ClassVar[tuple[str, ...]] = ("scale", "scale_uncertainty", "common", "individual_uncertainty", "reference")
    PLACE: ClassVar[tuple[str, ...]] = (
        "body", "point", "point_uncertainty", "direction", "direction_uncertainty", "transverse_sensitivity",
    )  # fmt: skip
    TRIGGER: ClassVar[tuple[str, ...]] = ("threshold", "edge")

    @model_validator(mode="after")
    def _keys_of_the_quantity(self) -> Self:
        why = f'quantity = "{self.quantity}"'
        if self.quantity in TRANSDUCERS:
            turning = TRANSDUCERS[self.quantity].turning
            refuse_missing(self, ("body", "direction") if turning else ("body", "point", "direction"), why)
        if self.quantity == "output":
            refuse_missing(self, ("channel",), why)
        known = {*self.ANY, *self.TRIGGER}
        if self.quantity != "trigger":
            known = {*self.ANY, *self.VALUE, *{"output": ("channel",), "voltage": ()}.get(self.quantity, self.PLACE)}
        refuse_foreign(self, known, why)
        if self.scale == 0.0:
            raise refusal("a number other than 0", "0", key="scale")
        return self


class Daq(Block):
    """One DAQ file with one clock."""

    name: Text
    file: Annotated[ExistingFile, AfterValidator(_daq_suffix)]
    clock_uncertainty: NotNegative = 0.0
    sample_rate: Positive | None = None
    first_edge: int | None = None
    channel: Annotated[tuple[ChannelEntry, ...], BeforeValidator(array_of_tables), Field(min_length=1)]

    def data_set(self, entry: ChannelEntry) -> tuple[str, str]:
        """Name of a channel and the scan point it names, empty where it names none: of a scan, `2/3` is ("2", "3")."""
        block, _, point = entry.name.partition("/")
        return (block, point) if self.file.suffix.lower() == ".asc" else (entry.name, "")

    @model_validator(mode="after")
    def _channels_have_different_names(self) -> Self:
        refuse_repeated([entry.name for entry in self.channel], "channels", "channel")
        if self.file.suffix.lower() == ".mat" and self.sample_rate is None:
            raise refusal("the sample rate in Hz, which a .mat file does not hold", "nothing", key="sample_rate")
        return self


class Frames(Block):
    """What images and points share: the stereo pair, the trigger, and the exposure, by default the pair's own."""

    stereo: Text
    trigger: Text
    first_edge: Annotated[int, Field(ge=0)] | None = None
    exposure: Exposure
    delay: Number
    delay_uncertainty: NotNegative

    INHERITED: ClassVar[tuple[str, ...]] = ("exposure", "delay", "delay_uncertainty")

    @model_validator(mode="before")
    @classmethod
    def _take_from_the_pair(cls, value: Any, info: ValidationInfo) -> Any:
        """Fill in what the recording does not override."""
        if not isinstance(value, dict) or not isinstance(info.context, Context):
            return value
        known = info.context.stereo
        name = value.get("stereo")
        if not isinstance(name, str):
            return value
        if name not in known:
            found = f'"{name}"; rig.toml has {", ".join(known) or "none"}'
            raise refusal("the name of a stereo pair of rig.toml", found, key="stereo")
        return {key: getattr(known[name], key) for key in cls.INHERITED} | value


class Images(Frames):
    """Image sequences of the left and right camera of a stereo pair, frame by frame in natural order."""

    left: ExistingFiles
    right: ExistingFiles
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None

    INHERITED: ClassVar[tuple[str, ...]] = (*Frames.INHERITED, "bit_depth")

    @model_validator(mode="after")
    def _as_many_left_as_right(self) -> Self:
        left, right = len(self.left), len(self.right)
        if left != right:
            raise refusal("as many images left as right", f"{left} left and {right} right", key="right")
        if 1 < left < MINIMUM_FRAMES:
            raise refusal(f"at least {MINIMUM_FRAMES} frames", f"{left}", key="left")
        if set(self.left) & set(self.right):
            raise refusal("other images than the left ones", "the same files", key="right")
        return self


class PointFiles(Frames):
    """Tables of 3-D points from another DIC program: one file per frame, or one with a column `frame`."""

    files: ExistingFiles
    columns: Annotated[tuple[str, ...], BeforeValidator(_columns)]
    valid_status: int | None = None
    scale: Positive = 1.0

    @model_validator(mode="after")
    def _columns_hold_what_is_used(self) -> Self:
        if self.valid_status is not None and "status" not in self.columns:
            raise refusal('a column "status" for valid_status', ", ".join(self.columns), key="columns")
        single = "frame" in self.columns
        if 1 < len(self.files) < MINIMUM_FRAMES and not single:
            raise refusal(f"at least {MINIMUM_FRAMES} frames", f"{len(self.files)}", key="files")
        if single and len(self.files) > 1:
            raise refusal('one file, since its column "frame" tells the frames', f"{len(self.files)}", key="files")
        return self


class SetUpFiles(Block):
    """What was recorded at once."""

    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables)] = ()
    images: Annotated[tuple[Images, ...], BeforeValidator(array_of_tables)] = ()
    points: Annotated[tuple[PointFiles, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        refuse_repeated([block.name for block in self.daq], "daq blocks", "daq")
        return self

    @property
    def files(self) -> list[Path]:
        """Files that these tables name."""
        files = []
        for daq in self.daq:
            files += [daq.file, *(entry.response for entry in daq.channel if entry.response)]
        for images in self.images:
            files += [*images.left, *images.right]
        return files + [file for points in self.points for file in points.files]


class Take(SetUpFiles):
    """What was recorded at once, where a recording holds several measurements one after another."""

    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables), Field(min_length=1)]


class RecordingFile(SetUpFiles):
    """recording.toml as it stands: one excitation and the files recorded under it."""

    format: Literal[1]
    name: Text
    rig: Text
    mounting: Text = "1"
    excitation: Excitation
    part: Annotated[tuple[Part, ...], BeforeValidator(array_of_tables)] = ()
    take: Annotated[tuple[Take, ...], BeforeValidator(array_of_tables)] = ()
