"""Channels read through their chains: errors of a chain by name, rows of the linear model, the sensor's outputs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import CommonError, Deviates, Geometry, Observation
from fusion.estimation.uncertainty import Contribution, Scope, Uncertainty, Unknown, added_up, as_complex, real_stack
from fusion.instruments.transducer import (
    HEAD,
    TRANSDUCERS,
    TRANSVERSE,
    LaserBeams,
    Transducer,
    chain_name,
    is_aimed_at_mirror,
    main_direction,
    measuring_point,
    mirror_of,
    perpendicular_axes,
    placement_name,
    unit_direction,
)
from photogram.geometry import rotation_from_vector
from shaker.arrays import ComplexArray, FloatArray
from shaker.frf.chain import filters_of_delay
from shaker.sine.phasor import Phasors, stack_phasors

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry
    from shaker.frf.chain import ChainResponse

CLOCK_RATE = "clock rate"
PER_RECORDING_SCOPES: tuple[Scope, ...] = ("recording", "start")
"""Scopes of what no manifest states: every recording finds it anew."""
NOISE_REACH = 3.0
"""Standard uncertainties of its noise above which a line is one of its channel."""

# A channel with its chain: phasors, what the manifest states of them, and the relative errors that follow.


@dataclass(frozen=True)
class ChainUncertainty:
    """What the manifest does not say of a channel's chain: relative `u_magnitude` (K,) and `u_phase_rad` (K,) of its
    response table, and the block on whose `clock` it was recorded.
    """

    u_magnitude: FloatArray | None = None
    u_phase_rad: FloatArray | None = None
    clock: str = ""


@dataclass(frozen=True)
class ChannelRelativeError(Unknown[ComplexArray]):
    """One unknown of a chain: `effect` (K, M), the complex relative change of its M readings."""

    effect: ComplexArray

    def scaled(self, factor: ComplexArray | FloatArray) -> ChannelRelativeError:
        """Return the error of the readings times complex factors (K, 1) or (K, M)."""
        return self

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6) that it changes in proportion; the relative change may be (K, 1)."""
        none = np.zeros(design.shape[:2], np.complex128)
        slope = self.effect[:, :, None] * design
        return CommonError(self.name, self.label, self.u, self.unit, self.scope, slope, none, self.type, self.dof)


@dataclass(frozen=True)
class FittedError(ChannelRelativeError):
    """An error of times as a sine approximation passes it on: beside its `effect` (K, 1) it changes readings by `rest`.

    `rest` (K, M): what less than a beat cannot tell from the lines; it mixes lines, and X with its conjugate.
    """

    additive: ComplexArray = field(kw_only=True)

    def scaled(self, factor: ComplexArray | FloatArray) -> FittedError:
        """Return the error of the readings times complex factors (K, 1) or (K, M)."""
        return replace(self, additive=self.additive * factor)

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6): a change in proportion, and one of its own."""
        return replace(super().of_rows(design), offset=self.additive)

    def of_channel(self, column: int) -> FittedError:
        """Return the error of one of the channels of a fit."""
        return replace(self, additive=self.additive[:, column : column + 1])

    def relative_to(self, phasors: Phasors) -> ChannelRelativeError:
        """Return the relative error (K, 1) of one channel; at lines within its noise, the proportional part alone."""
        size = np.abs(phasors.value)
        stands_out = size > NOISE_REACH * np.hypot(phasors.u_re, phasors.u_im)
        rest = np.divide(self.additive, phasors.value, out=np.zeros_like(self.additive), where=stands_out)
        return ChannelRelativeError(
            self.name, self.label, self.u, self.unit, self.effect + rest, self.scope, self.type, self.dof
        )


@dataclass(frozen=True)
class ChannelReading:
    """One channel: its manifest entry, its phasors (one channel, SI, delay and response taken off) and its chain.

    `further`: relative errors (K, 1) that it has beside those of its chain.
    """

    entry: ChannelEntry
    phasors: Phasors
    chain: ChainUncertainty
    further_errors: tuple[ChannelRelativeError, ...] = ()


DELAY_OF_FILTER = "filter that the delay may be of"
"""Label of the attenuation that comes with a delay unless it is pure."""


def u_of_filter(frequency_hz: FloatArray, delay_s: float) -> tuple[FloatArray, FloatArray]:
    """Return standard uncertainties (K,) of relative magnitude and phase, rad, of a delay that may be a low-pass's.

    Nothing is corrected: a filter of this delay does anything between nothing and what the usual one does that changes
    most, so that u is that over √3.
    """
    if not delay_s > 0.0:
        return np.zeros(len(frequency_hz)), np.zeros(len(frequency_hz))
    filters = filters_of_delay(frequency_hz, delay_s)
    most = np.abs(np.abs(filters) - 1.0).max(axis=0), np.abs(np.angle(filters)).max(axis=0)
    return most[0] / np.sqrt(3.0), most[1] / np.sqrt(3.0)


def chain_errors(readings: Sequence[ChannelReading]) -> tuple[ChannelRelativeError, ...]:
    """Return scale, delay and response errors of channels that share one chain.

    Scale multiplies by 1 + u; a delay not taken off by exp(-jω u) ≈ 1 - jω u; a response by 1 + u_m + j u_phi, its
    error at all lines taken as one; likewise the filter that a delay may belong to (`u_of_filter`).
    `individual_uncertainty` is one unknown per channel. What a reading has beside that, errors of its clock among it,
    comes last.
    """
    entries, chains = [reading.entry for reading in readings], [reading.chain for reading in readings]
    name, frequency = chain_name(entries[0]), readings[0].phasors.frequency_hz
    turn, zero = -2j * np.pi * frequency, np.zeros(len(frequency))
    scales, delays = [e.scale_uncertainty for e in entries], [e.delay_uncertainty for e in entries]
    magnitudes = [zero if chain.u_magnitude is None else chain.u_magnitude for chain in chains]
    phases = [zero if chain.u_phase_rad is None else chain.u_phase_rad for chain in chains]
    filters = [u_of_filter(frequency, entry.filter_delay_s) for entry in entries]
    errors = []
    for kind, unit, u, columns in (
        ("scale", "1", max(scales), [zero + u for u in scales]),
        ("delay", "s", max(delays), [turn * u for u in delays]),
        ("response magnitude", "1", 1.0, magnitudes),
        ("response phase", "1", 1.0, [1j * phase for phase in phases]),
        (DELAY_OF_FILTER, "1", 1.0, [magnitude for magnitude, _ in filters]),
        (f"{DELAY_OF_FILTER}, phase", "1", 1.0, [1j * phase for _, phase in filters]),
    ):
        relative = np.stack(columns, axis=1).astype(np.complex128)
        errors.append(ChannelRelativeError(f"{name}: {kind}", f"{name}: {kind}", u, unit, relative, "rig"))
    label = f"{name}: individual scale"
    only = np.eye(len(entries), dtype=np.complex128)
    for place, entry in enumerate(entries):
        own = np.ones((len(frequency), 1)) * entry.individual_uncertainty * only[place]
        errors.append(
            ChannelRelativeError(f"{label} {entry.name}", label, entry.individual_uncertainty, "1", own, "rig")
        )
    for place, reading in enumerate(readings):
        errors += [replace(error, effect=error.effect * only[place]) for error in reading.further_errors]
    return nonzero_errors(errors)


def nonzero_errors(errors: Iterable[ChannelRelativeError]) -> tuple[ChannelRelativeError, ...]:
    """Return every unknown once, its effects added up; what acts on nothing is left out."""
    return tuple(error for error in added_up(errors) if np.any(error.effect != 0.0))


def delay_errors(
    name: str, frequency_hz: FloatArray, u_s: float, scope: Scope = "recording"
) -> tuple[ChannelRelativeError, ...]:
    """Return a time error, if any: what is late by one standard uncertainty turns by exp(-jω u) ≈ 1 - jω u."""
    turn = np.asarray(-2j * np.pi * frequency_hz * u_s)[:, None]
    return (ChannelRelativeError(name, name, u_s, "s", turn, scope),) if u_s > 0.0 else ()


def clock_rate(design: ComplexArray, orders: FloatArray, clock_uncertainty: float) -> list[CommonError]:
    """Return the unknown of a time base: where it runs fast readings ∝ ω^-n, n (M,), seem larger by n times as much."""
    relative = np.broadcast_to(-clock_uncertainty * orders + 0j, design.shape[:2])
    rate = ChannelRelativeError(CLOCK_RATE, CLOCK_RATE, clock_uncertainty, "1", relative, "rig").of_rows(design)
    return [rate] if np.any(rate.slope != 0.0) else []


def scale_is_stated(entry: ChannelEntry, response: ChainResponse | None) -> bool:
    """Whether the manifest, or the response of the channel at some lines, states how uncertain its scale is."""
    by_response = response is not None and bool(np.any(response.u_magnitude > 0.0))
    return by_response or bool(entry.scale_uncertainty or entry.individual_uncertainty)


def errors_are_stated(entry: ChannelEntry, response: ChainResponse | None, beams: LaserBeams) -> bool:
    """Whether any systematic uncertainty of a motion channel is stated: without one `fuse` uses it if it must."""
    of_chain = scale_is_stated(entry, response) or entry.delay_uncertainty > 0.0
    of_chain = of_chain or (response is not None and bool(np.any(response.errors != 0.0)))
    return of_chain or bool(geometry_errors(TRANSDUCERS[entry.quantity], entry, beams))


# Where and along what the channels measure, and what is uncertain of that.


FAN_U = 1.0 / np.sqrt(3.0)
"""Of beams stated as parallel: anything between parallel and as far apart as one mirror makes them, in either sense."""


def geometry_errors(
    transducer: Transducer, entry: ChannelEntry, beams: LaserBeams | None = None
) -> tuple[Unknown[FloatArray], ...]:
    """Return what is uncertain of a channel's place and direction, by names that hold in every recording.

    Effects (6,) on its geometry, as long as things are mounted as they are. `beams`: of all channels of the recording,
    the channel alone where None.

    A point has three coordinates; a direction errs by two small rotations; a transverse sensitivity t of unknown
    direction is two components of t/√2 across the axis. What its head contributes comes last. Several points that state
    one direction and no head err by one tilt and each by its own: whether they do one or the other is not stated.
    """
    beams = beams or LaserBeams.of([entry])
    point, direction, chain = measuring_point(entry), unit_direction(entry), chain_name(entry)
    errors = []
    if not transducer.rotational:
        for axis, unit, u in zip("xyz", np.eye(3), np.broadcast_to(entry.point_uncertainty, 3).tolist(), strict=True):
            lever = u * _moved_point(entry, unit)
            errors.append(Unknown(placement_name(entry, "point", axis), f"{chain}: point", u, "m", lever, "mounting"))
    leaks = (
        ("direction", "rad", entry.direction_uncertainty),
        (TRANSVERSE, "1", entry.transverse_sensitivity / np.sqrt(2.0)),
    )
    for number, tangent in enumerate(perpendicular_axes(direction)):
        for kind, of_kind, u in leaks:
            name = placement_name(entry, kind, str(number))
            turned = u * transducer.geometry(point, tangent)
            errors.append(Unknown(name, f"{chain}: {kind}", float(u), of_kind, turned, "mounting"))
            if kind == "direction" and beams.shares_tilt(entry):
                shared = _tilt_name(entry, str(number))
                errors.append(Unknown(shared, f"{chain}: tilt", float(u), of_kind, turned, "mounting"))
    errors += _head_errors(transducer, entry, beams)
    return tuple(error for error in errors if np.any(error.effect != 0.0))


def _moved_point(entry: ChannelEntry, shift: FloatArray) -> FloatArray:
    """Return the change (6,) of [d, r × d] where the point moves; an aimed beam turns about its mirror."""
    direction = unit_direction(entry)
    if not is_aimed_at_mirror(entry):
        return np.concatenate([np.zeros(3), np.cross(shift, direction)])
    mirror = mirror_of(entry)
    turned = -(shift - direction * (direction @ shift)) / np.linalg.norm(mirror - measuring_point(entry))
    return np.concatenate([turned, np.cross(mirror, turned)])


def _tilt_name(entry: ChannelEntry, axis: str) -> str:
    along = ", ".join(f"{x:.9g}" for x in entry.direction or ())
    return f"{chain_name(entry)}: tilt along ({along}) {axis}"


def _head_errors(transducer: Transducer, entry: ChannelEntry, beams: LaserBeams) -> list[Unknown[FloatArray]]:
    """Return what a channel has in common with all channels of its head, by the head's name.

    The head turned by a small vector φ turns the direction d by φ × d; about a known mirror q it moves the point r by
    φ × (r - q) as well, so that a beam goes on to pass through q, and points aimed at by the head's angles shift across
    the body. Otherwise the points stay, as those of an accelerometer do and spots that were measured on the body. An
    offset moves all points alike, a misplaced mirror turns aimed beams about their points. Beams stated as parallel
    lean towards the centre of the points where they leave one mirror: their change is taken with its second order,
    d·cos θ, which is all of it for a motion along d. What sits on the head itself is placed by itself.
    """
    if entry.head is None or entry.body == HEAD:
        return []
    stated, title = entry.head.stated, f"head {entry.head.name}"
    point, direction, mirror = measuring_point(entry), unit_direction(entry), mirror_of(entry)
    errors = []

    def add(kind: str, axis: str, u: float, unit: str, effect: FloatArray) -> None:
        name = f"{title}: {kind} {axis}".rstrip()
        errors.append(Unknown(name, f"{title}: {kind}", u, unit, u * effect, "mounting"))

    for place, axis in enumerate("xyz"):
        unit = np.eye(3)[place]
        turned, shift = np.cross(unit, direction), np.cross(unit, point - mirror)
        row = transducer.geometry(point, turned)
        if not transducer.rotational:
            row[3:] += np.cross(shift, direction)
            add("offset", axis, stated.point_uncertainty[place], "m", _moved_point(entry, unit))
        add("tilt", axis, stated.rotation_uncertainty[place], "rad", row)
        if is_aimed_at_mirror(entry):
            leaning = (unit - direction * (direction @ unit)) / np.linalg.norm(mirror - point)
            add("mirror", axis, stated.mirror_uncertainty[place], "m", transducer.geometry(point, leaning))
    fan = beams.fan(entry)
    if fan is not None:
        leaning = (direction + fan) / np.linalg.norm(direction + fan)
        add("fan of beams", "", FAN_U, "1", transducer.geometry(point, leaning - direction))
    return errors


@dataclass(frozen=True)
class ChannelGeometry(Geometry):
    """Places and directions of the channels of one instrument, for the Monte Carlo run."""

    transducer: Transducer
    entries: tuple[ChannelEntry, ...]
    frequency_hz: FloatArray
    gravity_mps2: FloatArray | None
    beams: LaserBeams

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` draws."""
        errors = (geometry_errors(self.transducer, entry, self.beams) for entry in self.entries)
        return frozenset(error.name for own in errors for error in own)

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows (N, K, M, 6) at points moved and along axes turned by finite angles, with a leak across them.

        The size of a transverse sensitivity is known and its direction is not, so its angle is uniform; so is the fan
        of beams stated as parallel.
        """
        drawn = []
        for entry in self.entries:
            point, mirror, direction = self._drawn_beam(entry, deviates)
            sides = perpendicular_axes(unit_direction(entry))
            angle = deviates.angle(placement_name(entry, TRANSVERSE, "0"))
            leak = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ sides
            turned = direction + entry.transverse_sensitivity * leak
            if entry.head is not None:
                tilt = np.array(entry.head.stated.rotation_uncertainty) * _vector(
                    deviates, f"head {entry.head.name}: tilt"
                )
                turn = rotation_from_vector(tilt)
                turned = np.einsum("nij,nj->ni", turn, turned)
                point = mirror + np.einsum("nij,nj->ni", turn, point - mirror)
            geometry = self.transducer.geometry(point, np.asarray(turned))
            drawn.append(self.transducer.rows(geometry, self.frequency_hz, self.gravity_mps2))
        return np.stack(drawn, axis=2)

    def _drawn_beam(self, entry: ChannelEntry, deviates: Deviates) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return N points, centres of the head's rotation and directions, each (N, 3), before the head is turned."""
        u = np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))
        own = [deviates.normal(placement_name(entry, "point", axis)) for axis in "xyz"]
        point = measuring_point(entry) + u * np.stack(own, axis=1)
        direction = np.broadcast_to(unit_direction(entry), point.shape)
        mirror = point
        if entry.head is not None:
            stated, title = entry.head.stated, f"head {entry.head.name}"
            point = point + np.array(stated.point_uncertainty) * _vector(deviates, f"{title}: offset")
            mirror = point
            if stated.mirror is not None:
                mirror = mirror_of(entry) + np.array(stated.mirror_uncertainty) * _vector(deviates, f"{title}: mirror")
            if is_aimed_at_mirror(entry):
                direction = (mirror - point) / np.linalg.norm(mirror - point, axis=1, keepdims=True)
            fan = self.beams.fan(entry)
            if fan is not None:
                leaning = direction + (deviates.angle(f"{title}: fan of beams") / np.pi - 1.0)[:, None] * fan
                direction = leaning / np.linalg.norm(leaning, axis=1, keepdims=True)
        names = [[placement_name(entry, "direction", axis)] for axis in "01"]
        if self.beams.shares_tilt(entry):
            names = [[name, _tilt_name(entry, axis)] for (name,), axis in zip(names, "01", strict=True)]
        tilt = np.stack([sum(deviates.normal(name) for name in both) for both in names], axis=1)
        spin = np.cross(direction, entry.direction_uncertainty * tilt @ perpendicular_axes(unit_direction(entry)))
        return point, mirror, np.einsum("nij,nj->ni", rotation_from_vector(spin), direction)


def _vector(deviates: Deviates, name: str) -> FloatArray:
    return np.stack([deviates.normal(f"{name} {axis}") for axis in "xyz"], axis=1)


# The channels of one instrument as rows of the linear model.


def observe_channels(
    readings: Sequence[ChannelReading], gravity_mps2: ArrayLike | None = None, clock_uncertainty: float = 0.0
) -> tuple[Observation, ...]:
    """Return the rows of all motion channels, one observation per instrument and body.

    Row of a channel at r with direction d: [d, r × d] · {1, 1/(jω), -1/ω²} for acceleration, velocity, displacement;
    an accelerometer reads d·(a - g) in body axes, so that its rotation part gains (d × g)/ω² when `gravity_mps2` (3,)
    is given; a gyroscope reads d·alpha/(jω). `clock_uncertainty`: relative, of the time base.
    """
    groups: dict[tuple[str, str, str], list[ChannelReading]] = {}
    for reading in readings:
        entry = reading.entry
        if entry.quantity in TRANSDUCERS:
            groups.setdefault((chain_name(entry), str(entry.body), entry.quantity), []).append(reading)
    gravity = None if gravity_mps2 is None else np.asarray(gravity_mps2, dtype=np.float64)
    beams = LaserBeams.of([reading.entry for reading in readings])
    return tuple(_observe(group, gravity, clock_uncertainty, beams) for group in groups.values())


def _observe(
    readings: Sequence[ChannelReading], gravity_mps2: FloatArray | None, clock_uncertainty: float, beams: LaserBeams
) -> Observation:
    """Return rows and common errors of the channels of one instrument on one body."""
    transducer = TRANSDUCERS[readings[0].entry.quantity]
    phasors = stack_phasors([reading.phasors for reading in readings])
    entries, frequency = tuple(reading.entry for reading in readings), phasors.frequency_hz
    geometry = np.stack([transducer.geometry(measuring_point(entry), unit_direction(entry)) for entry in entries])
    design = transducer.rows(geometry, frequency, gravity_mps2).swapaxes(0, 1)
    main = np.stack([transducer.geometry(measuring_point(entry), main_direction(entry)) for entry in entries])
    none = np.zeros_like(phasors.value)
    common = [error.of_rows(design) for error in chain_errors(readings)]
    placed: dict[str, CommonError] = {}
    for place, entry in enumerate(entries):
        for error in geometry_errors(transducer, entry, beams):
            known = placed.get(error.name)
            slope = np.zeros_like(design) if known is None else known.slope
            slope[:, place] = transducer.rows(error.effect, frequency, gravity_mps2)
            placed[error.name] = CommonError(error.name, error.label, error.u, error.unit, error.scope, slope, none)
    common += placed.values()
    stated = any(error.scope not in PER_RECORDING_SCOPES for error in common)
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
        geometry=ChannelGeometry(transducer, entries, frequency, gravity_mps2, beams),
        main=transducer.rows(main, frequency, gravity_mps2).swapaxes(0, 1)
        if any(map(is_aimed_at_mirror, entries))
        else None,
    )


# The outputs of the sensor under test, read through a bridge amplifier: phasors, common errors by name, and drawn.

NOISE = "output noise"


@dataclass(frozen=True)
class Outputs:
    """Phasors (K, C) of the sensor's outputs, in the unit of the sensor, with their whole covariance.

    `uncertainty`: noise of the sine approximation, and scale, delay, response and clock errors under the names that
    the motion's instruments use, so that what both share (a clock, an amplifier) acts on both. `additive`: names of
    those influences that add to the outputs whatever these are, and do not belong to their chains.
    """

    phasors: Phasors
    uncertainty: Uncertainty
    additive: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected, found = self.phasors.covariance.shape, self.uncertainty.random[0].covariance.shape
        if found != expected:
            raise ValueError(f"uncertainty: expected covariances of shape {expected}, found {found}")

    def draw(self, deviates: Deviates) -> ComplexArray:
        """Return N draws (N, K, C) with noise, from which relative errors c of the chains are taken off exactly.

        They act as (1 + Re c)·exp(j·Im c). What is additive is added before.
        """
        value = self.phasors.value
        drawn = np.repeat(value[None], deviates.count, axis=0)
        for part in self.uncertainty.random:
            dof = np.full(len(part.covariance), np.inf) if part.dof is None else part.dof
            drawn = drawn + as_complex(deviates.noise(f"{part.label} of outputs", part.covariance, dof))
        for influence in self.uncertainty.influences:
            if influence.name in self.additive:
                added = deviates.unknown(influence.name, influence.dof)[:, None, None]
                drawn = drawn + added * as_complex(influence.effect)
        for influence in self.uncertainty.influences:
            if influence.name in self.additive:
                continue
            effect = as_complex(influence.effect)
            relative = np.divide(effect, value, out=np.zeros_like(value), where=(value != 0.0) & np.isfinite(effect))
            size = deviates.unknown(influence.name, influence.dof)[:, None, None]
            drawn = drawn / ((1.0 + size * relative.real) * np.exp(1j * size * relative.imag))
        return np.asarray(drawn)


def sensor_outputs(readings: Sequence[ChannelReading], order: Sequence[str]) -> Outputs | None:
    """Return what of some readings are outputs of the sensor, in the order and by the names of its outputs, if any."""
    named = {str(reading.entry.channel): reading for reading in readings if reading.entry.quantity == "output"}
    own = [
        replace(named[name], phasors=replace(named[name].phasors, channels=(name,))) for name in order if name in named
    ]
    return output_phasors(own) if own else None


def output_phasors(readings: Sequence[ChannelReading]) -> Outputs:
    """Return the outputs of C channels, in the order given.

    An error of a chain, relative (K, C), changes the reading U by relative · U for one standard uncertainty; channels
    that name one `common` instrument share its errors. A budget names those of a chain by their kind, whichever channel
    has them.
    """
    if not readings:
        raise ValueError("readings: expected at least one output channel, found none")
    signals = stack_phasors([reading.phasors for reading in readings])
    chains: dict[str, list[int]] = {}
    for place, reading in enumerate(readings):
        chains.setdefault(chain_name(reading.entry), []).append(place)
    influences = []
    for places in chains.values():
        for error in chain_errors([readings[place] for place in places]):
            change = np.zeros_like(signals.value)
            change[:, places] = error.effect * signals.value[:, places]
            label = error.label if error.scope in PER_RECORDING_SCOPES else "output " + error.label.rpartition(": ")[2]
            influences.append(replace(error.acting(real_stack(change)), label=label))
    noise = Contribution(NOISE, "A", signals.covariance, signals.dof)
    uncertainty = Uncertainty((noise,), added_up(influences))
    return Outputs(replace(signals, covariance=uncertainty.covariance), uncertainty)
