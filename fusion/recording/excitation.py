"""Kinds of excitation: their keys in `[excitation]`, their commands, remarks of `check`.

A new kind is one entry of `KINDS`, and its keys in `ExcitationEntry`: the manifest, `check`, the commands and campaigns
of mixed kinds use this table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from fusion.recording.recording_notices import (
    MISSING_KEY,
    REPEATED_NAME,
    VALUE_OUT_OF_RANGE,
    WRONG_VALUE_TYPE,
)
from fusion.recording.values import (
    HERTZ,
    Angle,
    Component,
    Direction,
    ExistingFile,
    ManifestBlock,
    Matrix3,
    Number,
    Positive,
    Share,
    Text,
    Texts,
    describe,
    refusal,
    refuse_foreign,
    refuse_missing,
    rotation,
    size_range,
    unit_vector,
    vector,
)

MOST_FREQUENCIES = 2000
HIGHEST_HARMONIC = 1000
LASTING = size_range(0.0, 1e6, "s")
FORCE = size_range(0.0, 1e9, "N or N m")
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
HEAD = ("angle_unit", "axis", "zero_gravity")
"""Keys of a rotation on an indexing head."""
POSED = (
    "orientation_uncertainty", "down", "down_uncertainty", "sensor_in_flange", "sensor_in_flange_uncertainty",
)  # fmt: skip
"""Keys of a rotation in any orientations."""
Kind = Literal["sine", "multisine", "chirp", "noise", "impact", "step", "rotation"]


def _driven(value: object) -> tuple[float, ...]:
    """Return a direction of 3 numbers as unit vector, or 6 load components unchanged."""
    if not isinstance(value, list | tuple) or len(value) not in (3, 6):
        found = f"{len(value)} elements" if isinstance(value, list | tuple) else describe(value)
        raise refusal("3 numbers, or 6 where a moment is driven", found, declared=WRONG_VALUE_TYPE)
    components = unit_vector(value) if len(value) == 3 else vector(6)(value)
    if not any(components):
        raise refusal("a direction", "the zero vector")
    return components


def _frequencies(value: object) -> tuple[float, ...]:
    """Return nominal frequencies in Hz: at least one, positive, different."""
    if not isinstance(value, list | tuple) or not value:
        raise refusal("a list of frequencies in Hz", describe(value), declared=WRONG_VALUE_TYPE)
    if len(value) > MOST_FREQUENCIES:
        raise refusal(f"at most {MOST_FREQUENCIES} frequencies", f"{len(value)}", declared=VALUE_OUT_OF_RANGE)
    lines = vector(len(value))(value)
    if min(lines) <= 0:
        raise refusal("frequencies above 0", f"{min(lines):g}", declared=VALUE_OUT_OF_RANGE)
    if len(set(lines)) < len(lines):
        raise refusal("different frequencies", "one of them twice", declared=REPEATED_NAME)
    return lines


def _harmonics(value: object) -> Any:
    """Return the word auto, or a list of multiples of the nominal frequencies."""
    expected = '"auto" or a list of different multiples such as [2, 3]'
    if value == "auto":
        return value
    if not isinstance(value, list | tuple):
        raise refusal(expected, describe(value))
    for item in value:
        if not isinstance(item, int) or isinstance(item, bool) or not 1 <= item <= HIGHEST_HARMONIC:
            limit = expected if not isinstance(item, int) or item < 1 else f"multiples of at most {HIGHEST_HARMONIC}"
            raise refusal(limit, describe(item))
    if len(set(value)) < len(value):
        raise refusal(expected, "one of them twice")
    return tuple(value)


def _band(value: object) -> tuple[float, ...]:
    low, high = vector(2)(value)
    if not 0 <= low < high:
        raise refusal("two frequencies in Hz, the lower first", f"[{low:g}, {high:g}]")
    return low, high


def _mounted(value: object) -> Any:
    """Return the word fit, or a rotation matrix."""
    return value if value == "fit" else rotation(value)


class ExcitationEntry(ManifestBlock):
    """The excitation: kind, direction in sensor axes, further keys of the kind."""

    kind: Kind
    direction: Annotated[tuple[float, ...] | None, BeforeValidator(_driven)] = None
    frequencies: Annotated[tuple[float, ...] | None, BeforeValidator(_frequencies), HERTZ] = None
    harmonics: Annotated[Literal["auto"] | tuple[int, ...], BeforeValidator(_harmonics)] = "auto"
    band: Annotated[tuple[float, float] | None, BeforeValidator(_band), size_range(0.0, 1e8, "Hz")] = None
    period: Annotated[Positive, LASTING] | None = None
    settle_periods: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    response: Annotated[Texts, Field(min_length=1)] = ()
    reference: Annotated[Texts, Field(min_length=1)] = ()
    component: Component | None = None
    step_amplitude: Annotated[Number, FORCE] | None = None
    step_uncertainty: Share = 0.0
    onset: Annotated[Number, LASTING] | None = None
    force: Text | None = None
    release: Text | None = None
    file: ExistingFile | None = None
    angle_unit: Literal["rad", "deg"] | None = None
    axis: Direction | None = None
    zero_gravity: Direction | None = None
    with_load: bool | None = None
    angle_uncertainty: Angle = 0.0
    axis_uncertainty: Angle | None = None
    orientation: Literal["sensor_in_world", "world_in_sensor", "gravity_in_sensor"] | None = None
    orientation_uncertainty: Angle = 0.0
    down: Direction = (0.0, 0.0, -1.0)
    down_uncertainty: Angle | None = None
    sensor_in_flange: Annotated[Matrix3 | Literal["fit"], BeforeValidator(_mounted)] = EYE
    sensor_in_flange_uncertainty: Angle | None = None
    scale: Number = 1.0

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        kind, why = KINDS[self.kind], f'kind = "{self.kind}"'
        refuse_missing(self, kind.required, why)
        refuse_foreign(self, {"kind", *kind.required, *kind.allowed}, why)
        if self.kind == "rotation":
            self._keys_of_the_rotation()
        if self.kind == "multisine" and self.frequencies is None and (self.band is None or self.period is None):
            raise refusal(
                'frequencies, or band and period, for kind = "multisine"',
                "neither",
                key="frequencies",
                declared=MISSING_KEY,
            )
        for key, what in (("scale", "a number"), ("step_amplitude", "a step")):
            if getattr(self, key) == 0.0:
                raise refusal(f"{what} other than 0", "0", key=key, declared=VALUE_OUT_OF_RANGE)
        return self

    def _keys_of_the_rotation(self) -> None:
        """Refuse keys of an indexing head for other orientations, and the reverse."""
        always = {"kind", "file", "with_load", "scale", "angle_unit"}
        if self.orientation is None:
            why = 'kind = "rotation" without orientation'
            refuse_missing(self, HEAD, why)
            refuse_foreign(self, {*always, *HEAD, "angle_uncertainty", "axis_uncertainty"}, why)
            return
        posed = {*always, "orientation", *POSED}
        if self.orientation == "gravity_in_sensor":
            posed -= {"down", "down_uncertainty"}
        refuse_foreign(self, posed, f'orientation = "{self.orientation}"')

    @property
    def slowest_hz(self) -> float | None:
        """Lowest frequency of a periodic motion, None for other excitations."""
        if "run" not in KINDS[self.kind].commands:
            return None
        return min(self.frequencies) if self.frequencies else max(self.band[0], 1.0 / self.period)  # type: ignore[index,operator]

    @property
    def channels(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Keys that name recorded channels, with the names."""
        force = () if self.force is None else (self.force,)
        return ("response", self.response), ("reference", self.reference), ("force", force)


@dataclass(frozen=True)
class RecordedChannels:
    """Recorded channels that `check` compares with an excitation: outputs, force channels, number of takes."""

    outputs: tuple[str | None, ...]
    forces: tuple[str, ...]
    takes: int


def _released(excitation: ExcitationEntry, recorded: RecordedChannels) -> list[str]:
    """Return remarks on the models of a step response that cannot be determined."""
    remarks = []
    if not recorded.outputs:
        remarks.append("no channel is an output of the sensor: no model")
    elif excitation.component not in recorded.outputs:
        remarks.append(f"no channel is the output {excitation.component}, which is driven: cross-talk only")
    if excitation.force is not None and excitation.force not in recorded.forces:
        remarks.append(f"no force channel is named {excitation.force}")
    if recorded.takes > 1:
        remarks.append("several takes: shakercal step expects one release per recording")
    return remarks


@dataclass(frozen=True)
class ExcitationKind:
    """The properties of one kind of excitation.

    `commands`: those that evaluate it, the recommended one first. `required`, `allowed`: keys of `[excitation]`.
    `remarks`: function for remarks of `check`; None if the result is a motion of bodies, of which `check` reports the
    observed components. `command_note`: addition to the command's name. `readings_in_table`: the readings are in the
    table of the key `file`, instead of DAQ files and images.
    """

    commands: tuple[str, ...]
    required: tuple[str, ...]
    allowed: tuple[str, ...] = ()
    remarks: Callable[[ExcitationEntry, RecordedChannels], list[str]] | None = None
    command_note: str = ""
    readings_in_table: bool = False

    @property
    def is_broadband(self) -> bool:
        """Whether `run` evaluates recordings with images or points, by the spectrum of their channels."""
        return self.commands == ("transfer",)

    @property
    def needs_uniform_samples(self) -> bool:
        """Whether channels must be sampled uniformly; sines are fitted at any times."""
        return self.commands[0] != "run"

    @property
    def command_remark(self) -> list[str]:
        """Return the first remark of `check` on recordings of other commands than `shakercal run`."""
        command = self.commands[0]
        return [] if command == "run" else [f"shakercal {command} evaluates this recording{self.command_note}"]


KINDS = {
    "sine": ExcitationKind(commands=("run",), required=("direction", "frequencies"), allowed=("harmonics",)),
    "chirp": ExcitationKind(
        commands=("transfer",),
        required=("direction", "band"),
        allowed=("frequencies", "period", "settle_periods", "response", "reference"),
    ),
    "multisine": ExcitationKind(
        commands=("run", "transfer"),
        required=("direction",),
        allowed=("frequencies", "harmonics", "band", "period", "settle_periods", "response", "reference"),
    ),
    **dict.fromkeys(
        ("noise", "impact"),
        ExcitationKind(
            commands=("transfer",),
            required=("direction",),
            allowed=("frequencies", "band", "response", "reference"),
        ),
    ),
    "step": ExcitationKind(
        commands=("step", "load", "decouple"),
        required=("component", "step_amplitude"),
        allowed=("direction", "step_uncertainty", "onset", "force", "release"),
        remarks=_released,
    ),
    "rotation": ExcitationKind(
        commands=("rotate",),
        required=("file", "with_load"),
        allowed=(*HEAD, "angle_uncertainty", "axis_uncertainty", "scale", "orientation", *POSED),
        command_note=", by gravity alone",
        readings_in_table=True,
    ),
}
"""In the order of lists in messages."""

ONE_SET_UP = {
    **dict.fromkeys(("step", "load", "decouple"), "one release per recording, in a separate folder"),
    "transfer": "no [[take]] blocks, since shakercal transfer evaluates a single set-up",
}
"""Expectation of commands that evaluate no recording of several takes."""


def kinds_of(command: str) -> tuple[str, ...]:
    """Return the kinds of excitation that a command evaluates; `ValueError` if there are none."""
    kinds = tuple(name for name, kind in KINDS.items() if command in kind.commands)
    if not kinds:
        available = join_alternatives(list(dict.fromkeys(name for kind in KINDS.values() for name in kind.commands)))
        raise ValueError(f"command: expected one that evaluates recordings, {available}, found {command}")
    return kinds


def join_alternatives(names: Sequence[str]) -> str:
    """Return names as alternatives: `sine or multisine`."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))
