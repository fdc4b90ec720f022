"""The models of recording.toml: one excitation, the DAQ files with their channels, the images or points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from fusion.recording.rig import Part
from fusion.recording.values import (
    ZERO3,
    Block,
    BodyName,
    Component,
    Context,
    Direction,
    ExistingFile,
    ExistingFiles,
    Exposure,
    FreeVector,
    NotNegative,
    Number,
    Positive,
    Spread3,
    Text,
    Texts,
    array_of_tables,
    describe,
    refusal,
    repeated_name,
    unit_vector,
    vector,
)

Kind = Literal["sine", "multisine", "chirp", "noise", "impact", "step", "rotation"]
Quantity = Literal[
    "displacement", "velocity", "acceleration", "angular_velocity", "force", "output", "voltage", "trigger"
]
DAQ_SUFFIXES = (".h5", ".hdf5", ".tdms", ".uff", ".unv", ".mat", ".csv", ".wav", ".lvm", ".asc")
MINIMUM_FRAMES = 3
COORDINATES = ("x", "y", "z")
REFERENCE_COORDINATES = ("x0", "y0", "z0")
COLUMNS = ("frame", "status", *REFERENCE_COORDINATES, *COORDINATES, "_")


def _driven(value: object) -> tuple[float, ...]:
    """A direction of 3 numbers, made a unit vector, or 6 load components, left as they are."""
    if not isinstance(value, list | tuple) or len(value) not in (3, 6):
        found = f"{len(value)} elements" if isinstance(value, list | tuple) else describe(value)
        raise refusal("3 numbers, or 6 where a moment is driven", found)
    if len(value) == 3:
        return unit_vector(value)
    components = vector(6)(value)
    if not any(components):
        raise refusal("a direction", "the zero vector")
    return components


def _frequencies(value: object) -> tuple[float, ...]:
    """Nominal frequencies in Hz: at least one, positive, different."""
    if not isinstance(value, list | tuple) or not value:
        raise refusal("a list of frequencies in Hz", describe(value))
    lines = vector(len(value))(value)
    if min(lines) <= 0:
        raise refusal("frequencies above 0", f"{min(lines):g}")
    if len(set(lines)) < len(lines):
        raise refusal("different frequencies", "one of them twice")
    return lines


def _harmonics(value: object) -> Any:
    """The word auto, or a list of multiples of the nominal frequencies."""
    expected = '"auto" or a list of different multiples such as [2, 3]'
    if value == "auto":
        return value
    if not isinstance(value, list | tuple):
        raise refusal(expected, describe(value))
    for item in value:
        if not isinstance(item, int) or isinstance(item, bool) or item < 1:
            raise refusal(expected, describe(item))
    if len(set(value)) < len(value):
        raise refusal(expected, "one of them twice")
    return tuple(value)


def _band(value: object) -> tuple[float, ...]:
    """Lower and upper frequency in Hz."""
    low, high = vector(2)(value)
    if not 0 <= low < high:
        raise refusal("two frequencies in Hz, the lower first", f"[{low:g}, {high:g}]")
    return low, high


def _columns(value: object) -> tuple[str, ...]:
    """What the columns of a point table hold."""
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
    """A DAQ file is recognised by its suffix."""
    if value.suffix.lower() not in DAQ_SUFFIXES:
        raise refusal("a file that ends in one of " + " ".join(DAQ_SUFFIXES), f"{value.name}")
    return value


class Excitation(Block):
    """What drove the rig: kind, direction in sensor axes, and what the kind needs."""

    kind: Kind
    direction: Annotated[tuple[float, ...] | None, BeforeValidator(_driven)] = None
    frequencies: Annotated[tuple[float, ...] | None, BeforeValidator(_frequencies)] = None
    harmonics: Annotated[Literal["auto"] | tuple[int, ...], BeforeValidator(_harmonics)] = "auto"
    band: Annotated[tuple[float, float] | None, BeforeValidator(_band)] = None
    period: Positive | None = None
    settle_periods: Annotated[int, Field(ge=0)] = 0
    response: Annotated[Texts, Field(min_length=1)] = ()
    reference: Annotated[Texts, Field(min_length=1)] = ()
    component: Component | None = None
    step_amplitude: Number | None = None
    step_uncertainty: NotNegative = 0.0
    onset: Number | None = None
    force: Text | None = None
    release: Text | None = None
    file: ExistingFile | None = None
    angle_unit: Literal["rad", "deg"] | None = None
    axis: Direction | None = None
    zero_gravity: Direction | None = None
    with_load: bool | None = None
    angle_uncertainty: NotNegative = 0.0
    scale: Number = 1.0

    REQUIRED: ClassVar[dict[str, tuple[str, ...]]] = {
        "sine": ("direction", "frequencies"),
        "multisine": ("direction",),
        "chirp": ("direction", "band"),
        "noise": ("direction",),
        "impact": ("direction",),
        "step": ("component", "step_amplitude"),
        "rotation": ("file", "angle_unit", "axis", "zero_gravity", "with_load"),
    }
    ALLOWED: ClassVar[dict[str, tuple[str, ...]]] = {
        "sine": ("harmonics",),
        "multisine": ("frequencies", "harmonics", "band", "period", "settle_periods", "response", "reference"),
        "chirp": ("period", "settle_periods", "response", "reference"),
        "noise": ("band", "response", "reference"),
        "impact": ("band", "response", "reference"),
        "step": ("direction", "step_uncertainty", "onset", "force", "release"),
        "rotation": ("angle_uncertainty", "scale"),
    }

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        required = self.REQUIRED[self.kind]
        _refuse_missing(self, required, f'kind = "{self.kind}"')
        _refuse_foreign(self, {"kind", *required, *self.ALLOWED[self.kind]}, f'kind = "{self.kind}"')
        if self.kind == "multisine" and self.frequencies is None and (self.band is None or self.period is None):
            raise refusal('frequencies, or band and period, for kind = "multisine"', "neither", key="frequencies")
        if self.scale == 0.0:
            raise refusal("a number other than 0", "0", key="scale")
        if self.step_amplitude == 0.0:
            raise refusal("a step other than 0", "0", key="step_amplitude")
        return self


def _refuse_missing(block: Block, required: tuple[str, ...], why: str) -> None:
    """Refuse a table that lacks a key its kind needs."""
    for key in required:
        if getattr(block, key) is None:
            raise refusal(f"this key, required for {why}", "nothing", key=key)


def _refuse_foreign(block: Block, known: set[str], why: str) -> None:
    """Refuse a key that means nothing for the kind of a table."""
    for key in type(block).model_fields:
        if key in block.model_fields_set and key not in known:
            raise refusal(f"no such key for {why}", describe(getattr(block, key)), key=key)


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
    MOTION: ClassVar[tuple[str, ...]] = ("displacement", "velocity", "acceleration", "angular_velocity")

    @model_validator(mode="after")
    def _keys_of_the_quantity(self) -> Self:
        why = f'quantity = "{self.quantity}"'
        if self.quantity in self.MOTION:
            turning = self.quantity == "angular_velocity"
            _refuse_missing(self, ("body", "direction") if turning else ("body", "point", "direction"), why)
        if self.quantity == "output":
            _refuse_missing(self, ("channel",), why)
        _refuse_foreign(self, self._known(), why)
        if self.scale == 0.0:
            raise refusal("a number other than 0", "0", key="scale")
        return self

    def _known(self) -> set[str]:
        """Keys that mean something for the quantity."""
        if self.quantity == "trigger":
            return {*self.ANY, *self.TRIGGER}
        own = {"output": ("channel",), "voltage": ()}.get(self.quantity, self.PLACE)
        return {*self.ANY, *self.VALUE, *own}


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
        twice = repeated_name([entry.name for entry in self.channel])
        if twice is not None:
            raise refusal("channels of different names", f'"{twice}" twice', key="channel")
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


def _daq_names_differ(blocks: tuple[Daq, ...]) -> None:
    """Refuse two daq blocks of one name."""
    twice = repeated_name([block.name for block in blocks])
    if twice is not None:
        raise refusal("daq blocks of different names", f'"{twice}" twice', key="daq")


class Take(Block):
    """What was recorded at once, where a recording holds several measurements one after another."""

    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables), Field(min_length=1)]
    images: Annotated[tuple[Images, ...], BeforeValidator(array_of_tables)] = ()
    points: Annotated[tuple[PointFiles, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        _daq_names_differ(self.daq)
        return self


class RecordingFile(Block):
    """recording.toml as it stands: one excitation and the files recorded under it."""

    format: Literal[1]
    name: Text
    rig: Text
    mounting: Text = "1"
    excitation: Excitation
    part: Annotated[tuple[Part, ...], BeforeValidator(array_of_tables)] = ()
    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables)] = ()
    images: Annotated[tuple[Images, ...], BeforeValidator(array_of_tables)] = ()
    points: Annotated[tuple[PointFiles, ...], BeforeValidator(array_of_tables)] = ()
    take: Annotated[tuple[Take, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        _daq_names_differ(self.daq)
        return self
