"""Channels: one component of a body's motion, or one output, read through an electrical chain.

What the kinds of channels share: the errors of the chain by name, the place and direction of a transducer as rows
[d, r × d] · (jω)^n, their uncertain numbers by name, and how these are drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.measurement_model import CommonError, Deviates, Kind, Observation
from fusion.estimation.uncertainty import Kind as ErrorType
from fusion.estimation.uncertainty import Scope
from photogram.geometry import rotation_from_vector
from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.phasor import Phasors, derivative_factor, stack_phasors

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

CLOCK_RATE = "clock rate"
TRANSVERSE = "transverse sensitivity"

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
    type: ErrorType = "B"

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6) that it changes in proportion; `relative` may be (K, 1)."""
        none = np.zeros(design.shape[:2], np.complex128)
        slope = self.relative[:, :, None] * design
        return CommonError(self.name, self.label, self.u, self.unit, self.scope, slope, none, self.type)


@dataclass(frozen=True)
class Reading:
    """One channel: its manifest entry, its phasors (one channel, SI, delay and response taken off) and its chain.

    `further`: relative errors (K, 1) that it has beside those of its chain.
    """

    entry: ChannelEntry
    phasors: Phasors
    chain: ChainUncertainty
    further: tuple[RelativeError, ...] = ()


def chain_name(entry: ChannelEntry) -> str:
    """Return the name of the instrument that a channel belongs to: its `common`, or its own name."""
    return entry.common or entry.name


def chain_errors(readings: Sequence[Reading]) -> tuple[RelativeError, ...]:
    """Return scale, delay, response and clock errors of channels that share one chain.

    Scale multiplies by 1 + u; a delay not taken off by exp(-jω u) ≈ 1 - jω u; a response by 1 + u_m + j u_phi, its
    error at all lines taken as one. `individual_uncertainty` is one unknown per channel. What a reading has beside that
    comes last.
    """
    entries, chains = [reading.entry for reading in readings], [reading.chain for reading in readings]
    name, frequency = chain_name(entries[0]), readings[0].phasors.frequency_hz
    turn, zero = -2j * np.pi * frequency, np.zeros(len(frequency))
    scales, delays = [e.scale_uncertainty for e in entries], [e.delay_uncertainty for e in entries]
    magnitudes = [zero if chain.u_magnitude is None else chain.u_magnitude for chain in chains]
    phases = [zero if chain.u_phase_rad is None else chain.u_phase_rad for chain in chains]
    errors = []
    for kind, unit, u, columns in (
        ("scale", "1", max(scales), [zero + u for u in scales]),
        ("delay", "s", max(delays), [turn * u for u in delays]),
        ("response magnitude", "1", 1.0, magnitudes),
        ("response phase", "1", 1.0, [1j * phase for phase in phases]),
    ):
        relative = np.stack(columns, axis=1).astype(np.complex128)
        errors.append(RelativeError(f"{name}: {kind}", f"{name}: {kind}", u, unit, "rig", relative))
    for clock in sorted({c.clock for c in chains if c.u_clock_s > 0.0}):
        times = np.array([c.u_clock_s if c.clock == clock else 0.0 for c in chains])
        unknown, late = f"clock {clock}: time", turn[:, None] * times
        errors.append(RelativeError(unknown, unknown, float(np.max(times)), "s", "recording", late))
    label = f"{name}: individual scale"
    only = np.eye(len(entries), dtype=np.complex128)
    for place, entry in enumerate(entries):
        own = np.ones((len(frequency), 1)) * entry.individual_uncertainty * only[place]
        errors.append(RelativeError(f"{label} {entry.name}", label, entry.individual_uncertainty, "1", "rig", own))
    for place, reading in enumerate(readings):
        errors += [replace(error, relative=error.relative * only[place]) for error in reading.further]
    return added_up(errors)


def added_up(errors: Sequence[RelativeError]) -> tuple[RelativeError, ...]:
    """Return every unknown once, its effects added up; what acts on nothing is left out."""
    found: dict[str, RelativeError] = {}
    for error in errors:
        known = found.get(error.name)
        found[error.name] = error if known is None else replace(known, relative=known.relative + error.relative)
    return tuple(error for error in found.values() if np.any(error.relative != 0.0))


def clock_rate(design: ComplexArray, orders: FloatArray, clock_uncertainty: float) -> list[CommonError]:
    """Return the unknown of a time base: where it runs fast readings ∝ ω^-n, n (M,), seem larger by n times as much."""
    relative = np.broadcast_to(-clock_uncertainty * orders + 0j, design.shape[:2])
    rate = RelativeError(CLOCK_RATE, CLOCK_RATE, clock_uncertainty, "1", "rig", relative).of_rows(design)
    return [rate] if np.any(rate.slope != 0.0) else []


# A transducer: what kind of motion it reads, where and along which direction.


@dataclass(frozen=True)
class Transducer:
    """A kind of channel that reads one component of a body's motion; `quantity` is its name in the manifest.

    It reads (jω)^`order` times an acceleration, in `unit`, along its direction, or, `turning`, about it; one that
    `weighs` reads d·(a - g) in body axes. `kind`: of instrument, among which a source of the fusion is chosen.
    """

    quantity: str
    unit: str
    kind: Kind
    order: int
    turning: bool = False
    weighs: bool = False

    def geometry(self, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Return [d, r × d] (..., 6) for places r and directions d (..., 3), of a turning one [0, d].

        It tells what the channel can observe, whatever the frequency.
        """
        none = np.zeros_like(direction)
        parts = (none, direction) if self.turning else (direction, np.cross(point, direction))
        return np.concatenate(parts, axis=-1)

    def rows(self, geometry: FloatArray, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
        """Return rows (..., K, 6) of the model from geometries, or changes of them, (..., 6).

        What weighs tilts with the body, which adds (d × g)/ω² to its rotations.
        """
        rows = np.repeat(geometry[..., None, :], len(frequency_hz), axis=-2)
        if self.weighs and gravity_mps2 is not None:
            tilt = np.cross(geometry[..., :3], gravity_mps2)
            rows[..., 3:] += tilt[..., None, :] / (2.0 * np.pi * frequency_hz[:, None]) ** 2
        return np.asarray(derivative_factor(frequency_hz, self.order)[:, None] * rows)


def unit_direction(entry: ChannelEntry) -> FloatArray:
    """Return the direction of a channel, normalised."""
    direction = np.asarray(entry.direction, dtype=np.float64)
    return np.asarray(direction / np.linalg.norm(direction))


def placed_at(entry: ChannelEntry) -> FloatArray:
    """Return the point of a channel; the origin where it has none, for what turns is the same everywhere."""
    return np.zeros(3) if entry.point is None else np.asarray(entry.point, dtype=np.float64)


def across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a direction and to each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def placement_name(entry: ChannelEntry, kind: str, axis: str) -> str:
    """Return the name of an unknown of a channel's placement: with the stated place, and its direction where that errs.

    `kind`: "point" (axis x, y, z), "direction" or "transverse sensitivity" (axis 0, 1 of `across`).
    """
    at = "" if entry.point is None else f" at ({', '.join(f'{x:.9g}' for x in entry.point)})"
    along = "" if kind == "point" else f" along ({', '.join(f'{x:.9g}' for x in entry.direction or ())})"
    return f"{chain_name(entry)}: {kind} {entry.name}{at}{along} {axis}"


@dataclass(frozen=True)
class GeometryError:
    """One uncertain number of where or along what a channel measures: `change` (6,) of its geometry by one `u`."""

    name: str
    label: str
    u: float
    unit: str
    change: FloatArray


def geometry_errors(transducer: Transducer, entry: ChannelEntry) -> tuple[GeometryError, ...]:
    """Return what is uncertain of a channel's place and direction, by names that hold in every recording.

    A point has three coordinates; a direction errs by two small rotations; a transverse sensitivity t of unknown
    direction is two components of t/√2 across the axis.
    """
    point, direction, chain = placed_at(entry), unit_direction(entry), chain_name(entry)
    found = []
    if not transducer.turning:
        for axis, unit, u in zip("xyz", np.eye(3), np.broadcast_to(entry.point_uncertainty, 3).tolist(), strict=True):
            lever = np.concatenate([np.zeros(3), np.cross(unit, direction) * u])
            found.append(GeometryError(placement_name(entry, "point", axis), f"{chain}: point", u, "m", lever))
    leaks = (
        ("direction", "rad", entry.direction_uncertainty),
        (TRANSVERSE, "1", entry.transverse_sensitivity / np.sqrt(2.0)),
    )
    for number, tangent in enumerate(across(direction)):
        for kind, of_kind, u in leaks:
            name = placement_name(entry, kind, str(number))
            turned = u * transducer.geometry(point, tangent)
            found.append(GeometryError(name, f"{chain}: {kind}", float(u), of_kind, turned))
    return tuple(error for error in found if np.any(error.change != 0.0))


@dataclass(frozen=True)
class ChannelGeometry:
    """Places and directions of the channels of one instrument, for the Monte Carlo run."""

    transducer: Transducer
    entries: tuple[ChannelEntry, ...]
    frequency_hz: FloatArray
    gravity_mps2: FloatArray | None

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` draws."""
        return frozenset(error.name for entry in self.entries for error in geometry_errors(self.transducer, entry))

    def moved(self, readings: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the readings as they are: another place is another row."""
        return readings

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows (N, K, M, 6) at points moved and along axes turned by finite angles, with a leak across them.

        The size of a transverse sensitivity is known and its direction is not, so its angle is uniform.
        """
        drawn = []
        for entry in self.entries:
            u = np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))
            shift = np.stack([deviates.normal(placement_name(entry, "point", axis)) for axis in "xyz"], axis=1)
            stated = unit_direction(entry)
            sides = across(stated)
            tilt = np.stack([deviates.normal(placement_name(entry, "direction", axis)) for axis in "01"], axis=1)
            spin = np.cross(stated, entry.direction_uncertainty * tilt @ sides)
            turned = np.einsum("nij,j->ni", rotation_from_vector(spin), stated)
            angle = deviates.angle(placement_name(entry, TRANSVERSE, "0"))
            leak = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ sides
            geometry = self.transducer.geometry(
                placed_at(entry) + u * shift, np.asarray(turned + entry.transverse_sensitivity * leak)
            )
            drawn.append(self.transducer.rows(geometry, self.frequency_hz, self.gravity_mps2))
        return np.stack(drawn, axis=2)


def observe_group(
    transducer: Transducer, readings: Sequence[Reading], gravity_mps2: FloatArray | None, clock_uncertainty: float
) -> Observation:
    """Return rows and common errors of the channels of one instrument on one body."""
    phasors = stack_phasors([reading.phasors for reading in readings])
    entries, frequency = tuple(reading.entry for reading in readings), phasors.frequency_hz
    geometry = np.stack([transducer.geometry(placed_at(entry), unit_direction(entry)) for entry in entries])
    design = transducer.rows(geometry, frequency, gravity_mps2).swapaxes(0, 1)
    none = np.zeros_like(phasors.value)
    common = [error.of_rows(design) for error in chain_errors(readings)]
    for place, entry in enumerate(entries):
        for error in geometry_errors(transducer, entry):
            slope = np.zeros_like(design)
            slope[:, place] = transducer.rows(error.change, frequency, gravity_mps2)
            common.append(CommonError(error.name, error.label, error.u, error.unit, "mounting", slope, none))
    stated = any(error.scope != "recording" for error in common)
    common += clock_rate(design, np.full(len(entries), -float(transducer.order)), clock_uncertainty)
    return Observation(
        name=chain_name(entries[0]),
        kind=transducer.kind,
        body=str(entries[0].body),
        phasors=phasors,
        design=design,
        common=tuple(common),
        members=tuple(entry.name for entry in entries),
        stated=stated,
        geometry=ChannelGeometry(transducer, entries, frequency, gravity_mps2),
    )


def by_instrument(
    readings: Sequence[Reading], transducers: Mapping[str, Transducer]
) -> list[tuple[Transducer, list[Reading]]]:
    """Return the channels that read a motion, those of one instrument on one body together."""
    groups: dict[tuple[str, str, str], list[Reading]] = {}
    for reading in readings:
        entry = reading.entry
        if entry.quantity in transducers:
            key = (chain_name(entry), str(entry.body), entry.quantity)
            groups.setdefault(key, []).append(reading)
    return [(transducers[group[0].entry.quantity], group) for group in groups.values()]
