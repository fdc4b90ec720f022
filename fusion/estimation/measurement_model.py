"""A channel with its chain's errors, an instrument as rows of the linear model with its common errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.estimation.uncertainty import Kind as ErrorType
from fusion.estimation.uncertainty import Kind as UncertaintyKind
from fusion.estimation.uncertainty import Scope
from photogram.geometry import skew
from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.sine.phasor import Phasors, derivative_factor, stack_phasors

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry
    from fusion.recording.rig import Stereo


# A channel with its chain: phasors, what the manifest states of them, and the relative errors that follow.


@dataclass(frozen=True)
class ChainUncertainty:
    """What the manifest does not say of a channel's chain: relative `u_magnitude` (K,) and `u_phase_rad` (K,) of its
    response table, and `u_clock_s`, the standard uncertainty of the tie of its clock to the first block's.
    """

    u_magnitude: FloatArray | None = None
    u_phase_rad: FloatArray | None = None
    clock: str = ""
    u_clock_s: float = 0.0


@dataclass(frozen=True)
class RelativeError:
    """One unknown of a chain: complex `relative` (K, M) change of its M readings for one standard uncertainty `u`.

    `u` is in `unit`; `scope`: how long the unknown keeps its value.
    """

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    relative: ComplexArray
    type: UncertaintyKind = "B"


@dataclass(frozen=True)
class Reading:
    """One channel: its manifest entry, its phasors (one channel, SI, delay and response taken off) and its chain.

    `further`: relative errors (K, 1) that it has beside those of its chain.
    """

    entry: ChannelEntry
    phasors: Phasors
    chain: ChainUncertainty
    further: tuple[RelativeError, ...] = ()


def chain_errors(readings: Sequence[Reading]) -> tuple[RelativeError, ...]:
    """Return scale, delay, response and clock errors of channels that share one chain.

    Scale multiplies by 1 + u; a delay not taken off by exp(-jω u) ≈ 1 - jω u; a response by 1 + u_m + j u_phi, its
    error at all lines taken as one. `individual_uncertainty` is one unknown per channel. What a reading has beside that
    comes last.
    """
    name, frequency = chain_name(readings[0]), readings[0].phasors.frequency_hz
    turn = -2j * np.pi * frequency
    zero = np.zeros(len(frequency))
    entries, chains = [r.entry for r in readings], [r.chain for r in readings]

    def shared(kind: str, unit: str, columns: Sequence[NDArray[Any]], u: float) -> RelativeError:
        relative = np.stack(columns, axis=1).astype(np.complex128)
        return RelativeError(f"{name}: {kind}", f"{name}: {kind}", u, unit, "rig", relative)

    def table(values: FloatArray | None) -> FloatArray:
        return zero if values is None else values

    errors = [
        shared("scale", "1", [zero + e.scale_uncertainty for e in entries], max(e.scale_uncertainty for e in entries)),
        shared("delay", "s", [turn * e.delay_uncertainty for e in entries], max(e.delay_uncertainty for e in entries)),
        shared("response magnitude", "1", [table(c.u_magnitude) + 0.0 for c in chains], 1.0),
        shared("response phase", "1", [1j * table(c.u_phase_rad) for c in chains], 1.0),
    ]
    for clock in sorted({c.clock for c in chains if c.u_clock_s > 0.0}):
        times = np.array([c.u_clock_s if c.clock == clock else 0.0 for c in chains])
        unknown = f"clock {clock}: time"
        late = turn[:, None] * times
        errors.append(RelativeError(unknown, unknown, float(np.max(times)), "s", "recording", late))
    for place, entry in enumerate(entries):
        own = np.zeros((len(frequency), len(entries)), dtype=np.complex128)
        own[:, place] = entry.individual_uncertainty
        label = f"{name}: individual scale"
        errors.append(RelativeError(f"{label} {entry.name}", label, entry.individual_uncertainty, "1", "rig", own))
    for place, reading in enumerate(readings):
        for error in reading.further:
            own = np.zeros((len(frequency), len(entries)), dtype=np.complex128)
            own[:, place] = error.relative[:, 0]
            errors.append(replace(error, relative=own))
    return added_up(errors)


def added_up(errors: Sequence[RelativeError]) -> tuple[RelativeError, ...]:
    """Return every unknown once, its effects added up; what acts on nothing is left out."""
    found: dict[str, RelativeError] = {}
    for error in errors:
        known = found.get(error.name)
        found[error.name] = error if known is None else replace(known, relative=known.relative + error.relative)
    return tuple(error for error in found.values() if np.any(error.relative != 0.0))


def chain_name(reading: Reading) -> str:
    """Return the name of the instrument that a channel belongs to: its `common`, or its own name."""
    return str(reading.entry.common or reading.entry.name)


# Instruments as rows of one linear model per line: measured phasors = design · acceleration + common errors.


Kind = Literal["photogrammetry", "vibrometer", "accelerometer"]
ORDER_BELOW_ACCELERATION = {"displacement": -2, "velocity": -1, "acceleration": 0, "angular_velocity": -1}
KINDS: dict[str, Kind] = {
    "displacement": "vibrometer",
    "velocity": "vibrometer",
    "acceleration": "accelerometer",
    "angular_velocity": "accelerometer",
}
CLOCK_RATE = "clock rate"
CALIBRATION = "calibration"
PERIODIC = "error periodic in the pixel"


@dataclass(frozen=True)
class CommonError:
    """One real unknown that several readings share, with a normal prior of zero mean and standard uncertainty `u`.

    `name` identifies the unknown: equal names in several observations are the same unknown; it contains where a channel
    was placed, so that a channel placed elsewhere is another unknown. `label` groups it in a budget, `u` is in `unit`,
    `scope` says how long the unknown keeps its value. Its effect on the phasors for one standard uncertainty is
    slope · A + offset, with `slope` (K, M, 6) and `offset` (K, M), so that it follows the estimate A (K, 6) and never
    the readings.
    """

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    slope: ComplexArray
    offset: ComplexArray
    type: ErrorType = "B"

    def effect(self, acceleration: ComplexArray) -> ComplexArray:
        """Return the change (K, M) of the phasors for one standard uncertainty, at the acceleration (K, 6)."""
        return np.asarray(np.einsum("kmj,kj->km", self.slope, acceleration) + self.offset)


@dataclass(frozen=True)
class Observation:
    """Readings of one body by one instrument (a stereo pair, or the channels that share a chain).

    `phasors` (K lines, M channels; NaN where a line is not usable), `design` (K, M, 6) complex:
    phasors = design · [x y z rx ry rz accelerations at the sensor origin]. `members` (M,): the name under which each
    row is tested for consistency. `stated`: some systematic uncertainty is stated, so it takes part in the fusion.
    """

    name: str
    kind: Kind
    body: str
    phasors: Phasors
    design: ComplexArray
    common: tuple[CommonError, ...]
    members: tuple[str, ...]
    stated: bool

    def __post_init__(self) -> None:
        shape = (*self.phasors.value.shape, 6)
        check_shape("design", self.design, shape)
        for error in self.common:
            check_shape(f"slope of {error.name}", error.slope, shape)
            check_shape(f"offset of {error.name}", error.offset, shape[:2])
        if len(self.members) != shape[1]:
            raise ValueError(f"members: expected {shape[1]} names, found {len(self.members)}")

    @property
    def title(self) -> str:
        """Return the name of the instrument as it stands in budgets."""
        return f"stereo {self.name}" if self.kind == "photogrammetry" else self.name


@dataclass(frozen=True)
class LineTurns:
    """How errors of the estimated line frequencies turn the phasors of a record whose middle is at `middle_s`.

    A fit at f + u leaves the phase in the middle of the record as it is, so the phasor, which counts from time zero,
    turns by exp(-j2π u middle_s). `nominal_hz`, `u_hz` (K,): fundamental and standard uncertainty of each line; the
    lines of one fundamental err together, and so do all stereo pairs.
    """

    nominal_hz: FloatArray
    u_hz: FloatArray
    middle_s: float

    def turns(self) -> dict[str, ComplexArray]:
        """Return by the name of the unknown the relative change (K,) for one standard uncertainty."""
        turn = -2j * np.pi * self.u_hz * self.middle_s
        found = np.unique(self.nominal_hz).tolist()
        return {f"frequency of {f:.6g} Hz": np.where(self.nominal_hz == f, turn, 0.0) for f in found}


@dataclass(frozen=True)
class PulseExposure:
    """An exposure as long as the pulses of a trigger: its name, `width_s` as measured, and `u_s`, 0 where stated."""

    trigger: str
    width_s: float
    u_s: float

    def change(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the relative change (K,) of phasors for one standard uncertainty of the width T.

        Frames whose exposures seem longer by u seem later by u/2, and their loss sin(x)/x, x = πfT, which was taken
        off, seems greater: u·[(1 - x·cot x)/T - jπf].
        """
        x = np.pi * frequency_hz * self.width_s
        return np.asarray(self.u_s * ((1.0 - x / np.tan(x)) / self.width_s - 1j * np.pi * frequency_hz))


@dataclass(frozen=True)
class StereoReading:
    """One stereo pair: `pair` as rig.toml has it, displacement phasors (K, 6), and what `observe_stereo` takes.

    `further`: relative errors (K, 1) of all six phasors beside those.
    """

    name: str
    pair: Stereo
    phasors: Phasors
    effects: Mapping[str, ComplexArray] = field(default_factory=dict)
    clock_uncertainty: float = 0.0
    trigger: tuple[str, float] = ("", 0.0)
    turns: LineTurns | None = None
    pulse: PulseExposure | None = None
    further: tuple[RelativeError, ...] = ()

    def observed(self) -> Observation:
        """Return the rows of the pair."""
        seen = observe_stereo(
            self.name,
            self.pair,
            self.phasors,
            self.effects,
            self.clock_uncertainty,
            self.trigger,
            self.turns,
            self.pulse,
        )
        return replace(seen, common=seen.common + _of_rows(self.further, seen.design))


def _of_rows(errors: Sequence[RelativeError], design: ComplexArray) -> tuple[CommonError, ...]:
    """Return relative errors (K, M) or (K, 1) as common errors of the rows of a design (K, M, 6)."""
    none = np.zeros(design.shape[:2], np.complex128)
    return tuple(
        CommonError(e.name, e.label, e.u, e.unit, e.scope, e.relative[:, :, None] * design, none, e.type)
        for e in errors
    )


def observe_stereo(
    name: str,
    entry: Stereo,
    phasors: Phasors,
    effects: Mapping[str, ComplexArray] | None = None,
    clock_uncertainty: float = 0.0,
    trigger: tuple[str, float] = ("", 0.0),
    turns: LineTurns | None = None,
    pulse: PulseExposure | None = None,
) -> Observation:
    """Return the rows of a stereo pair: displacement phasors (K, 6) in m and rad about the sensor origin = -A/ω².

    Common errors: scale of all lengths (translations), pose: position p of the sensor origin (translation changes by
    theta × p) and rotation φ of the axes (vectors change by φ × v), delay of the exposure, and the `effects`: by name,
    changes (P, K, 6) of the phasors for one standard uncertainty of further unknowns, such as the principal components
    of the calibration's covariance (CALIBRATION, which counts as stated). `clock_uncertainty`: relative, of the time
    base; `trigger`: name of the camera trigger and standard uncertainty (s) of its fitted instants, one error for all
    pairs that follow it. `turns`: where the line frequencies are known from this motion only. `pulse`: what the
    exposure was measured from, one error for all pairs that expose as long as that trigger's pulses.
    """
    factor = derivative_factor(phasors.frequency_hz, -2)
    design = factor[:, None, None] * np.eye(6)
    geometry: list[tuple[str, str, str, float, ArrayLike]] = [
        ("scale", "", "1", entry.scale_uncertainty or 0.0, np.diag([1.0, 1, 1, 0, 0, 0]))
    ]
    for axis, letter in enumerate("xyz"):
        spin = skew(np.eye(3)[axis])
        shift, turn = np.zeros((6, 6)), np.kron(np.eye(2), spin)
        shift[:3, 3:] = -spin
        geometry.append(("pose position", letter, "m", entry.pose_uncertainty[axis], shift))
        geometry.append(("pose rotation", letter, "rad", entry.pose_uncertainty[3 + axis], turn))
    title = f"stereo {name}"
    none = np.zeros_like(phasors.value)
    common = []
    for kind, letter, unit, u, change in geometry:
        if u > 0.0:
            unknown, slope = f"{title}: {kind} {letter}".strip(), factor[:, None, None] * (u * np.asarray(change))
            common.append(CommonError(unknown, f"{title}: {kind}", u, unit, "rig", slope, none))
    if entry.delay_uncertainty > 0.0:
        common.append(_late(f"{title}: delay", entry.delay_uncertainty, "rig", phasors.frequency_hz, design))
    further = {} if effects is None else effects
    stated = bool(common) or len(further.get(CALIBRATION, ())) > 0
    for what, changes in further.items():
        label = f"{title}: {what}"
        scope: Scope = "recording" if what.startswith(PERIODIC) else "rig"
        for place, effect in enumerate(np.asarray(changes)):
            common.append(CommonError(f"{label} {place}", label, 1.0, "1", scope, np.zeros_like(design), effect))
    if trigger[1] > 0.0:
        common.append(_late(f"{trigger[0]}: time", trigger[1], "recording", phasors.frequency_hz, design))
    if pulse is not None and pulse.u_s > 0.0:
        unknown, slope = f"{pulse.trigger}: pulse width", pulse.change(phasors.frequency_hz)[:, None, None] * design
        common.append(CommonError(unknown, unknown, pulse.u_s, "s", "recording", slope, none))
    for unknown, turned in ({} if turns is None else turns.turns()).items():
        slope = turned[:, None, None] * design
        common.append(CommonError(unknown, unknown, 1.0, "1", "recording", slope, none))
    common += _clock_rate(design, np.full(6, 2.0), clock_uncertainty)
    return Observation(name, "photogrammetry", entry.body, phasors, design, tuple(common), (title,) * 6, stated)


def _late(name: str, u_s: float, scope: Scope, frequency_hz: FloatArray, design: ComplexArray) -> CommonError:
    """Time error of all rows of a design: readings late by one standard uncertainty turn by exp(-jω u) ≈ 1 - jω u."""
    slope = (-2j * np.pi * frequency_hz * u_s)[:, None, None] * design
    return CommonError(name, name, u_s, "s", scope, slope, np.zeros(design.shape[:2], np.complex128))


def observe_channels(
    readings: Sequence[Reading], gravity_mps2: ArrayLike | None = None, clock_uncertainty: float = 0.0
) -> tuple[Observation, ...]:
    """Return the rows of all motion channels, one observation per instrument and body.

    Row of a channel at r with direction d: [d, r × d] · {1, 1/(jω), -1/ω²} for acceleration, velocity, displacement;
    an accelerometer reads d·(a - g) in body axes, so that its rotation part gains (d × g)/ω² when `gravity_mps2` (3,)
    is given; a gyroscope reads d·alpha/(jω). Direction errors are two small rotations; a transverse sensitivity t of
    unknown direction is two components of t/√2 across the axis.
    """
    groups: dict[tuple[str, str, str], list[Reading]] = {}
    for reading in readings:
        entry = reading.entry
        if entry.quantity in KINDS:
            groups.setdefault((chain_name(reading), str(entry.body), KINDS[entry.quantity]), []).append(reading)
    gravity = None if gravity_mps2 is None else np.asarray(gravity_mps2, dtype=np.float64)
    return tuple(_observe_group(group, gravity, clock_uncertainty) for group in groups.values())


def _observe_group(readings: list[Reading], gravity: FloatArray | None, clock_uncertainty: float) -> Observation:
    """Rows and common errors of the channels of one instrument on one body."""
    phasors = stack_phasors([reading.phasors for reading in readings])
    entries = [reading.entry for reading in readings]
    frequency = phasors.frequency_hz
    design = np.stack([_row(e, _unit(e), frequency, gravity) for e in entries], axis=1)
    none = np.zeros_like(phasors.value)
    common = [*_of_rows(chain_errors(readings), design)]
    for place, reading in enumerate(readings):
        for kind, unit, axis, u, row in _placement_errors(reading, gravity):
            slope = np.zeros_like(design)
            slope[:, place] = row
            name, label = placement_name(reading.entry, kind, axis), f"{chain_name(reading)}: {kind}"
            common.append(CommonError(name, label, u, unit, "mounting", slope, none))
    stated = any(error.scope != "recording" for error in common)
    orders = np.array([-ORDER_BELOW_ACCELERATION[e.quantity] for e in entries], dtype=np.float64)
    common += _clock_rate(design, orders, clock_uncertainty)
    entry = entries[0]
    return Observation(
        name=chain_name(readings[0]),
        kind=KINDS[entry.quantity],
        body=str(entry.body),
        phasors=phasors,
        design=design,
        common=tuple(common),
        members=tuple(e.name for e in entries),
        stated=stated,
    )


def _unit(entry: ChannelEntry) -> FloatArray:
    """Direction of a channel, normalised."""
    direction = np.asarray(entry.direction, dtype=np.float64)
    return np.asarray(direction / np.linalg.norm(direction))


def _row(
    entry: ChannelEntry, direction: FloatArray, frequency_hz: FloatArray, gravity: FloatArray | None
) -> ComplexArray:
    """Design row (K, 6) of a channel if it had this direction."""
    factor = derivative_factor(frequency_hz, ORDER_BELOW_ACCELERATION[entry.quantity])
    row = np.zeros((len(frequency_hz), 6))
    if entry.quantity == "angular_velocity":
        row[:, 3:] = direction
        return np.asarray(factor[:, None] * row)
    row[:, :3] = direction
    row[:, 3:] = np.cross(np.asarray(entry.point, dtype=np.float64), direction)
    if entry.quantity == "acceleration" and gravity is not None:
        row[:, 3:] += np.cross(direction, gravity) / (2.0 * np.pi * frequency_hz[:, None]) ** 2
    return np.asarray(factor[:, None] * row)


def placement_name(entry: ChannelEntry, kind: str, axis: str) -> str:
    """Return the name of an unknown of a channel's placement: with the stated place, and its direction where that errs.

    `kind`: "point" (axis x, y, z), "direction" or "transverse sensitivity" (axis 0, 1 of `across`).
    """
    at = "" if entry.point is None else f" at ({', '.join(f'{x:.9g}' for x in entry.point)})"
    along = "" if kind == "point" else f" along ({', '.join(f'{x:.9g}' for x in entry.direction or ())})"
    return f"{entry.common or entry.name}: {kind} {entry.name}{at}{along} {axis}"


def across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a direction and to each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def _placement_errors(reading: Reading, gravity: FloatArray | None) -> list[tuple[str, str, str, float, ComplexArray]]:
    """Kind, unit, axis, standard uncertainty and row change (K, 6) of where a channel measures, in which direction."""
    entry, frequency = reading.entry, reading.phasors.frequency_hz
    direction = _unit(entry)
    factor = derivative_factor(frequency, ORDER_BELOW_ACCELERATION[entry.quantity])
    found: list[tuple[str, str, str, float, ComplexArray]] = []
    if entry.quantity != "angular_velocity":
        for axis, u in enumerate(np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))):
            lever = np.concatenate([np.zeros(3), np.cross(np.eye(3)[axis], direction) * u])
            found.append(("point", "m", "xyz"[axis], float(u), factor[:, None] * lever))
    for number, tangent in enumerate(across(direction)):
        turned = _row(entry, tangent, frequency, gravity)
        transverse = entry.transverse_sensitivity / np.sqrt(2.0)
        found.append(
            ("direction", "rad", str(number), entry.direction_uncertainty, entry.direction_uncertainty * turned)
        )
        found.append(("transverse sensitivity", "1", str(number), transverse, transverse * turned))
    return [item for item in found if item[3] > 0.0 and np.any(item[4] != 0.0)]


def _clock_rate(design: ComplexArray, orders: FloatArray, clock_uncertainty: float) -> list[CommonError]:
    """A time base that runs fast makes ω small: readings ∝ ω^-n seem larger by n times its relative error."""
    slope = -clock_uncertainty * orders[:, None] * design
    if not np.any(slope != 0.0):
        return []
    none = np.zeros(design.shape[:2], np.complex128)
    return [CommonError(CLOCK_RATE, CLOCK_RATE, clock_uncertainty, "1", "rig", slope, none)]
