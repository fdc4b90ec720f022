"""Models of recording.toml: excitation, DAQ files with channels, images, points, takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date as Date
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.dsi import parse_unit
from fusion.recording.environment import Environment
from fusion.recording.excitation import KINDS, ExcitationEntry
from fusion.recording.instruments import ChannelDefaults
from fusion.recording.recording_notices import (
    CONTRADICTING_VALUES,
    FRAMES_DO_NOT_MATCH,
    KEY_NOT_APPLICABLE,
    REPEATED_NAME,
    UNKNOWN_NAME,
    VALUE_OUT_OF_RANGE,
    WRONG_VALUE_TYPE,
)
from fusion.recording.rig import InstrumentHead, NamedHead, RigPart, Shaker, Stereo
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from fusion.recording.values import (
    HERTZ,
    PULSE,
    SECONDS,
    ZERO3,
    Angle,
    Context,
    Delay,
    Direction,
    ExistingFile,
    ExistingFiles,
    Exposure,
    ManifestBlock,
    Mask,
    NotNegative,
    Number,
    PathScope,
    Position,
    Positive,
    Region,
    Share,
    Text,
    Uncertainty3,
    Version,
    array_of_tables,
    describe,
    existing,
    refusal,
    refuse_foreign,
    refuse_missing,
    refuse_repeated,
    repeated_name,
)
from shaker.io import SUFFIXES, unsupported_suffix

if TYPE_CHECKING:
    Quantity = str
else:
    Quantity = Literal[(*TRANSDUCERS, "force", "output", "voltage", "trigger")]
MINIMUM_FRAMES = 3  # two frames have no residual
FARTHEST_EDGE = 1_000_000_000  # edges of a day at 10 kHz
SCAN = ".asc"
"""Suffix of a scanning vibrometer's text."""
COORDINATES = ("x", "y", "z")
REFERENCE_COORDINATES = ("x0", "y0", "z0")
COLUMNS = ("frame", "status", *REFERENCE_COORDINATES, *COORDINATES, "_")


def _unit(text: str) -> str:
    try:
        parse_unit(text)
    except ValueError as error:
        raise refusal("a unit such as mV/(m/s^2)", f'"{describe(text, plain=True)}"') from error
    return text


def _columns(value: object) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise refusal("a list of column names", describe(value), declared=WRONG_VALUE_TYPE)
    unknown = next((name for name in value if name not in COLUMNS and not name.startswith("id")), None)
    if unknown is not None:
        raise refusal("columns of " + ", ".join(COLUMNS) + " and id…", f'"{unknown}"')
    single = [name for name in value if name not in ("_", "status")]
    twice = repeated_name(single)
    if twice is not None:
        raise refusal("each column once", f'"{twice}" twice', declared=REPEATED_NAME)
    missing = [name for name in COORDINATES if name not in single]
    if missing or 0 < len(set(REFERENCE_COORDINATES) & set(single)) < 3:
        raise refusal("the columns x, y, z and either all or none of x0, y0, z0", ", ".join(value))
    return tuple(value)


EdgeRuns = tuple[tuple[int, int], ...]
"""Runs of frames with consecutive edges: first frame and its edge of each run."""


def _first_edge(value: object) -> int | dict[str, EdgeRuns] | None:
    """Return the edge of the first frame, or the runs of each camera."""
    if value is None or (isinstance(value, dict) and all(isinstance(runs, tuple) for runs in value.values())):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return _edge(value, 0)
    if isinstance(value, dict) and value and set(value) <= {"left", "right"}:
        return {side: _edge_runs(runs) for side, runs in value.items()}
    if isinstance(value, list):
        return dict.fromkeys(("left", "right"), _edge_runs(value))
    expected = "the number of an edge, [frame, edge] for runs of frames, or one of these for left and right"
    raise refusal(expected, describe(value), declared=WRONG_VALUE_TYPE)


def _edge(value: int, least: int) -> int:
    if not least <= value <= FARTHEST_EDGE:
        raise refusal(f"a number from {least} to {FARTHEST_EDGE}", f"{value}", declared=VALUE_OUT_OF_RANGE)
    return value


def _edge_runs(value: object) -> EdgeRuns:
    """Return the runs of frames of a camera.

    Their edges may lie before the first recorded one.
    """
    runs = [[0, value]] if isinstance(value, int) and not isinstance(value, bool) else value
    listed = [run for run in runs if isinstance(run, list)] if isinstance(runs, list) else []
    frames = [run[0] for run in listed if [type(number) for number in run] == [int, int]]
    ascending = frames[:1] == [0] and all(before < after for before, after in pairwise(frames))
    if not ascending or not isinstance(runs, list) or len(frames) < len(runs):
        expected = "[frame, edge] of the first frame, 0, and of each later one whose edge does not follow"
        raise refusal(expected, describe(value), declared=WRONG_VALUE_TYPE)
    return tuple((_edge(frame, 0), _edge(edge, -FARTHEST_EDGE)) for frame, edge in listed)


def _daq_suffix(value: Path) -> Path:
    wrong = unsupported_suffix(value)
    if wrong is not None:
        raise refusal(*wrong)
    return value


@dataclass(frozen=True)
class RigContext(Context):
    """Context of the validation of a recording: paths, stereo pairs and heads of its rig."""

    stereo: dict[str, Stereo]
    head: dict[str, InstrumentHead] = field(default_factory=dict)


def _head(value: object, info: ValidationInfo) -> object:
    """Return the head of rig.toml that a channel names."""
    if value is None or isinstance(value, NamedHead):
        return value
    heads = info.context.head if isinstance(info.context, RigContext) else {}
    if not isinstance(value, str) or value not in heads:
        found = f"{describe(value)}; rig.toml has {', '.join(heads) or 'none'}"
        raise refusal("the name of a head of rig.toml", found, declared=UNKNOWN_NAME)
    return NamedHead(value, heads[value])


class ResponseColumns(ManifestBlock):
    """Column names and units of a table of a frequency response.

    `magnitude_unit`: converted into SI; without it the numbers are used unchanged. `u_magnitude_unit` "%": relative to
    the magnitude, else its unit. `phase_unit`: by default that of the file, else rad. `k`: coverage factor of the
    uncertainties.
    """

    KEY: ClassVar[str] = "response_columns"

    frequency: Text
    magnitude: Text
    phase: Text
    u_magnitude: Text
    u_phase: Text
    magnitude_unit: Annotated[Text, AfterValidator(_unit)] | None = None
    phase_unit: Literal["rad", "deg"] | None = None
    u_magnitude_unit: Literal["%"] | None = None
    k: Positive = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the five columns."""
        return self.frequency, self.magnitude, self.phase, self.u_magnitude, self.u_phase


class ChannelEntry(ManifestBlock):
    """One channel: true phasor = file value · scale · exp(+jω·delay) / response(f).

    `in_file`: its name in the file, if it differs from `name`. `body` "head": an accelerometer on its `head`; "room": a
    beam of that head at a stationary object. Both measure the motion of the head. `delay_of` "pure": the delay of a
    converter or a line, without attenuation; "filter": the delay of a low-pass.
    """

    name: Text
    in_file: Text | None = None
    instrument: Text | None = None
    quantity: Quantity
    body: Literal["load", "base", "room", "head"] | None = None
    point: Position | None = None
    point_uncertainty: Uncertainty3 = ZERO3
    direction: Direction | None = None
    direction_uncertainty: Angle = 0.0
    head: Annotated[NamedHead | None, BeforeValidator(_head)] = None
    channel: Text | None = None
    scale: Number = 1.0
    scale_uncertainty: Share = 0.0
    common: Text | None = None
    individual_uncertainty: Share = 0.0
    transverse_sensitivity: Share = 0.0
    delay: Delay = 0.0
    delay_uncertainty: Annotated[NotNegative, SECONDS] = 0.0
    delay_of: Literal["pure", "filter"] | None = None
    response: ExistingFile | None = None
    response_result: Text | None = None
    response_columns: ResponseColumns | None = None
    reference: bool = False
    threshold: Number | None = None
    edge: Literal["rising", "falling"] = "rising"

    ANY: ClassVar[tuple[str, ...]] = (
        "name",
        "in_file",
        "instrument",
        "quantity",
        "delay",
        "delay_uncertainty",
        "response",
        "response_result",
        "response_columns",
    )
    VALUE: ClassVar[tuple[str, ...]] = (
        "scale", "scale_uncertainty", "common", "individual_uncertainty", "delay_of", "reference",
    )  # fmt: skip
    PLACEMENT: ClassVar[tuple[str, ...]] = (
        "body", "point", "point_uncertainty", "direction", "direction_uncertainty", "head", "transverse_sensitivity",
    )  # fmt: skip
    TRIGGER: ClassVar[tuple[str, ...]] = ("threshold", "edge")

    @model_validator(mode="after")
    def _keys_of_the_quantity(self) -> Self:
        why = f'quantity = "{self.quantity}"'
        if self.quantity in TRANSDUCERS:
            transducer = TRANSDUCERS[self.quantity]
            aimed = self.head is not None and self.head.stated.mirror is not None and self.body != HEAD
            if self.body in (STATIONARY, HEAD):
                refuse_missing(self, ("head",), f'body = "{self.body}"')
                if (self.body == HEAD) != (transducer.kind == "accelerometer"):
                    expected = "an accelerometer on the head, or a laser beam at the room"
                    raise refusal(
                        expected, f'{why} with body = "{self.body}"', key="body", declared=CONTRADICTING_VALUES
                    )
            elif self.head is not None and transducer.kind != "vibrometer" and (aimed or self.head.stated.standoff):
                expected = f"a head without mirror and standoff for {why}"
                raise refusal(expected, f'"{self.head.name}"', key="head", declared=UNKNOWN_NAME)
            refuse_missing(self, ("body",) if transducer.rotational else ("body", "point"), why)
            if not aimed:
                refuse_missing(self, ("direction",), why)
            if self.head is not None and self.point is not None and self.point == self.head.stated.mirror:
                expected = f"another point than the mirror of head {self.head.name}"
                raise refusal(expected, "the same", key="point", declared=CONTRADICTING_VALUES)
        if self.quantity == "output":
            refuse_missing(self, ("channel",), why)
        refuse_foreign(self, self.keys_of(self.quantity), why)
        suffix = self.response.suffix.lower() if self.response is not None else ""
        if self.response_result is not None and suffix != ".xml":
            expected = "no such key without a certificate as response"
            found = f'"{self.response_result}"'
            raise refusal(expected, found, key="response_result", declared=KEY_NOT_APPLICABLE)
        if self.response_columns is not None and suffix not in SUFFIXES:
            raise refusal(
                "no such key without a table as response", "one", key="response_columns", declared=KEY_NOT_APPLICABLE
            )
        if self.delay_of is not None and not self.delay > 0.0 and (self.delay_of == "filter" or not self.delay):
            expected = "a delay above 0 that this describes"
            raise refusal(expected, f"{self.delay:g}", key="delay_of", declared=CONTRADICTING_VALUES)
        if self.scale == 0.0:
            raise refusal("a number other than 0", "0", key="scale", declared=VALUE_OUT_OF_RANGE)
        return self

    @classmethod
    def keys_of(cls, quantity: str) -> set[str]:
        """Return the keys of a channel of a quantity."""
        if quantity == "trigger":
            return {*cls.ANY, *cls.TRIGGER}
        return {*cls.ANY, *cls.VALUE, *{"output": ("channel",), "voltage": ()}.get(quantity, cls.PLACEMENT)}

    @property
    def stored_name(self) -> str:
        """The channel's name in its file."""
        return self.in_file or self.name

    @property
    def filter_delay_s(self) -> float:
        """The delay that may be that of a low-pass; 0 if it is pure.

        With a response the delay is pure, unless stated differently.
        """
        kind = self.delay_of or (None if self.response is None else "pure")
        return 0.0 if kind == "pure" else max(self.delay, 0.0)


KEYS = {kind: ChannelEntry.keys_of(kind) for kind in (*TRANSDUCERS, "force", "output", "voltage", "trigger")}
"""Keys of a channel by its quantity."""


def _repeats(value: object, info: ValidationInfo) -> tuple[Path, ...]:
    """Return the files of a path, a pattern or a list of them, each once."""
    listed = value if isinstance(value, list | tuple) else [value]
    resolve = existing(PathScope.files, "paths or a pattern such as sweep-*.h5")
    found = [resolve(item, info) for item in listed]
    files = [file for item in found for file in (item if isinstance(item, tuple) else (item,))]
    return tuple(dict.fromkeys(_daq_suffix(file) for file in files))


class Daq(ManifestBlock):
    """One DAQ file with one clock.

    `repeats`: further files of the same channels, of the same measurement.
    """

    name: Text
    file: Annotated[ExistingFile, AfterValidator(_daq_suffix)]
    repeats: Annotated[tuple[Path, ...], BeforeValidator(_repeats)] = ()
    clock_uncertainty: Share = 0.0
    sample_rate: Annotated[Positive, HERTZ] | None = None
    first_edge: Annotated[int, Field(ge=-FARTHEST_EDGE, le=FARTHEST_EDGE)] | None = None
    defaults: ChannelDefaults | None = None
    channel: Annotated[tuple[ChannelEntry, ...], BeforeValidator(array_of_tables), Field(min_length=1)]

    @property
    def further_files(self) -> tuple[Path, ...]:
        """The files of the repeats without the first one, which a pattern may include."""
        return tuple(file for file in self.repeats if file != self.file)

    def data_set(self, entry: ChannelEntry) -> tuple[str, str]:
        """Return block and point of a scan's channel `2/3`; otherwise the name and ""."""
        block, _, point = entry.name.partition("/")
        return (block, point) if self.file.suffix.lower() == SCAN else (entry.name, "")

    @model_validator(mode="after")
    def _channels_have_different_names(self) -> Self:
        refuse_repeated([entry.name for entry in self.channel], "channels", "channel")
        refuse_repeated([entry.stored_name for entry in self.channel], "channels of the file", "channel")
        if self.file.suffix.lower() == SCAN and any(entry.in_file is not None for entry in self.channel):
            raise refusal(
                "no key in_file for a scan, whose channels are named block/point",
                "one",
                key="channel",
                declared=KEY_NOT_APPLICABLE,
            )
        return self


class Frames(ManifestBlock):
    """Common keys of images and points; the exposure is that of the pair by default.

    `first_edge`: of the first frame, or the runs of each camera, if frames were lost or a camera is late. `edge_step`:
    edges from one frame to the next, or to the next number of a file.
    """

    stereo: Text
    trigger: Text
    first_edge: Annotated[int | dict[str, EdgeRuns] | None, BeforeValidator(_first_edge)] = None
    edge_step: Annotated[int, Field(ge=1, le=FARTHEST_EDGE)] | None = None
    exposure: Exposure
    delay: Delay
    delay_uncertainty: Annotated[NotNegative, SECONDS]

    INHERITED: ClassVar[tuple[str, ...]] = ("exposure", "delay", "delay_uncertainty")
    HAS_ROW_TIMES: ClassVar[bool] = False

    @model_validator(mode="before")
    @classmethod
    def _inherit_from_pair(cls, value: Any, info: ValidationInfo) -> Any:
        """Return the keys, completed by those of the pair."""
        if not isinstance(value, dict) or not isinstance(info.context, RigContext):
            return value
        pairs = info.context.stereo
        name = value.get("stereo")
        if not isinstance(name, str):
            return value
        if name not in pairs:
            found = f'"{name}"; rig.toml has {", ".join(pairs) or "none"}'
            raise refusal("the name of a stereo pair of rig.toml", found, key="stereo", declared=UNKNOWN_NAME)
        if any(pairs[name].row_time) and not cls.HAS_ROW_TIMES:
            expected = "images, because points of a rolling shutter (row_time) have no exposure times of their rows"
            raise refusal(expected, f'points of "{name}"', key="stereo", declared=CONTRADICTING_VALUES)
        return {key: getattr(pairs[name], key) for key in cls.INHERITED} | value


class Images(Frames):
    """Image sequences of the cameras of a stereo pair, in natural order.

    `right` is empty for a single camera. Without a trigger, `frame_rate` dates the frames, and `trigger` is the name of
    their free-running clock, whose start is unknown. Subsets are inside the `region` of the first left image, outside
    every `mask`: x, y, width, height or the corners of a polygon, in px. `displaced_left`, `displaced_right`: further
    images of the body at other places.
    """

    left: ExistingFiles
    right: ExistingFiles = ()
    displaced_left: ExistingFiles = ()
    displaced_right: ExistingFiles = ()
    bit_depth: Annotated[int, Field(ge=1, le=16)] | None
    frame_rate: Annotated[Positive, HERTZ] | None = None
    region: Region | None = None
    mask: Mask = ()

    INHERITED: ClassVar[tuple[str, ...]] = (*Frames.INHERITED, "bit_depth")
    HAS_ROW_TIMES: ClassVar[bool] = True

    @model_validator(mode="before")
    @classmethod
    def _free_running(cls, value: Any) -> Any:
        """Return the keys; frames without a trigger count edges of a clock of their own."""
        if not isinstance(value, dict) or "frame_rate" not in value:
            return value
        for key in ("trigger", "first_edge", "edge_step"):
            if key in value:
                expected = "no such key with frame_rate, which dates frames without a trigger"
                raise refusal(expected, "one", key=key, declared=KEY_NOT_APPLICABLE)
        return {"trigger": f"frames of {value.get('stereo')}", "first_edge": 0} | value

    @property
    def cameras(self) -> tuple[tuple[str, tuple[Path, ...]], ...]:
        """Files of each camera, with its key."""
        return (("left", self.left), ("right", self.right)) if self.right else (("left", self.left),)

    @property
    def displaced(self) -> tuple[tuple[str, tuple[Path, ...]], ...]:
        """Files of the displaced body of each camera, with its key; none without any."""
        both = (("displaced_left", self.displaced_left), ("displaced_right", self.displaced_right))
        return both[: len(self.cameras)] if self.displaced_left else ()

    @model_validator(mode="after")
    def _as_many_left_as_right(self) -> Self:
        left, right = len(self.left), len(self.right)
        if len(self.displaced_right) != (len(self.displaced_left) if self.right else 0):
            raise refusal(
                "as many images of the displaced body left as right",
                f"{len(self.displaced_left)} left and {len(self.displaced_right)} right",
                key="displaced_right",
                declared=FRAMES_DO_NOT_MATCH,
            )
        runs = self.first_edge if isinstance(self.first_edge, dict) else {}
        if "right" in runs and not self.right and set(runs) != {"left", "right"}:
            raise refusal("no right camera", "one", key="first_edge", declared=CONTRADICTING_VALUES)
        if self.right and runs and set(runs) != {"left", "right"}:
            raise refusal("edges of left and right", next(iter(runs)), key="first_edge", declared=CONTRADICTING_VALUES)
        if self.frame_rate is not None and self.exposure == PULSE:
            expected, found = "the exposure in s, because no trigger has pulses", f'"{PULSE}"'
            raise refusal(expected, found, key="exposure", declared=CONTRADICTING_VALUES)
        if self.right and left != right and not runs:
            raise refusal(
                "as many images left as right, or `first_edge` of each camera",
                f"{left} left and {right} right",
                key="right",
                declared=FRAMES_DO_NOT_MATCH,
            )
        if 1 < left < MINIMUM_FRAMES:
            raise refusal(f"at least {MINIMUM_FRAMES} frames", f"{left}", key="left", declared=FRAMES_DO_NOT_MATCH)
        if set(self.left) & set(self.right):
            raise refusal(
                "other images than the left ones", "the same files", key="right", declared=FRAMES_DO_NOT_MATCH
            )
        return self


class PointFiles(Frames):
    """Tables of 3-D points: one file per frame, or a column `frame`.

    Without `columns` the headers of the files name them.
    """

    files: ExistingFiles
    columns: Annotated[tuple[str, ...] | None, BeforeValidator(_columns)] = None
    valid_status: int | None = None
    scale: Positive | None = None

    @model_validator(mode="after")
    def _columns_match_keys(self) -> Self:
        if isinstance(self.first_edge, dict):
            expected = "the number of an edge, because points are of both cameras"
            raise refusal(expected, "one for each camera", key="first_edge", declared=KEY_NOT_APPLICABLE)
        columns = self.columns or ()
        if self.valid_status is not None and "status" not in columns:
            raise refusal(
                'a column "status" for valid_status',
                ", ".join(columns) or "none named",
                key="columns",
                declared=CONTRADICTING_VALUES,
            )
        single = "frame" in columns
        if 1 < len(self.files) < MINIMUM_FRAMES and not single:
            raise refusal(
                f"at least {MINIMUM_FRAMES} frames", f"{len(self.files)}", key="files", declared=FRAMES_DO_NOT_MATCH
            )
        if single and len(self.files) > 1:
            raise refusal(
                'one file, since its column "frame" numbers the frames',
                f"{len(self.files)}",
                key="files",
                declared=FRAMES_DO_NOT_MATCH,
            )
        return self


class SetUpFiles(ManifestBlock):
    """Files of one set-up."""

    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables)] = ()
    images: Annotated[tuple[Images, ...], BeforeValidator(array_of_tables)] = ()
    points: Annotated[tuple[PointFiles, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        refuse_repeated([block.name for block in self.daq], "daq blocks", "daq")
        return self

    @property
    def files(self) -> list[Path]:
        """Files named in these tables."""
        files = []
        for daq in self.daq:
            files += [daq.file, *daq.repeats, *(entry.response for entry in daq.channel if entry.response)]
        for images in self.images:
            files += [*images.left, *images.right]
        return files + [file for points in self.points for file in points.files]


class Take(SetUpFiles):
    """A sequential set-up of a recording."""

    daq: Annotated[tuple[Daq, ...], BeforeValidator(array_of_tables), Field(min_length=1)]


class RecordingFile(SetUpFiles):
    """recording.toml: one excitation and the files recorded under it.

    `environment`: keys that differ from those of the rig.
    """

    format: Version
    name: Text
    simulated: bool = False
    rig: Text
    mounting: Text = "1"
    date: Date | None = None
    operator: Text | None = None
    procedure: Text | None = None
    environment: Environment | None = None
    excitation: ExcitationEntry
    part: Annotated[tuple[RigPart, ...], BeforeValidator(array_of_tables)] = ()
    shaker: Shaker | None = None
    take: Annotated[tuple[Take, ...], BeforeValidator(array_of_tables)] = ()
    acknowledged: Annotated[tuple[Acknowledgement, ...], BeforeValidator(array_of_tables)] = ()

    @model_validator(mode="after")
    def _repeats_in_every_block(self) -> Self:
        blocks: tuple[SetUpFiles, ...] = (self, *self.take)
        counts = {daq.name: len(daq.further_files) for block in blocks for daq in block.daq}
        name = next((name for name, count in counts.items() if count), None)
        if name is None:
            return self
        kind = self.excitation.kind
        if KINDS[kind].commands != ("transfer",):
            why = f'one for kind = "{kind}"'
            raise refusal("no such key", why, key=f"daq.{name}.repeats", declared=KEY_NOT_APPLICABLE)
        other = next((name for name, count in counts.items() if count != max(counts.values())), None)
        if other is not None:
            expected = f"{max(counts.values())} further files, as in the other blocks"
            found = f"{counts[other]}"
            raise refusal(expected, found, key=f"daq.{other}.repeats", declared=CONTRADICTING_VALUES)
        return self
