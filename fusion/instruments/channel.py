"""Channels and their measuring chains: named errors, rows of the linear model, sensor outputs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import CommonError, Deviates, Geometry, Observation
from fusion.estimation.uncertainty import Contribution, Scope, Uncertainty, Unknown, added_up, as_complex, real_stack
from fusion.recording.manifest import ChannelEntry
from fusion.recording.placement import (
    LaserBeams,
    chain_name,
    is_aimed_at_mirror,
    main_direction,
    measuring_point,
    mirror_of,
    perpendicular_axes,
    placement_name,
    unit_direction,
)
from fusion.recording.transducer import HEAD, TRANSDUCERS, TRANSVERSE, Transducer
from photogram.geometry import rotation_from_vector
from shaker.frf.chain import filters_of_delay
from shaker.sine.phasor import Phasors, stack_phasors
from shakercal._common.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from shaker.frf.chain import ChainResponse

CLOCK_RATE = "clock rate"
PER_RECORDING_SCOPES: tuple[Scope, ...] = ("recording", "start")
"""Scopes of unknowns that no manifest states: they differ between recordings."""
NOISE_REACH = 3.0
"""Amplitude over noise above which a line is significant."""

# A channel with its chain: phasors, stated uncertainties, relative errors.


@dataclass(frozen=True)
class ChainUncertainty:
    """Uncertainty of a channel's chain from its files.

    Relative `u_magnitude` (K,) and `u_phase_rad` (K,) of its response table, and the block of its `clock`.
    """

    u_magnitude: FloatArray | None = None
    u_phase_rad: FloatArray | None = None
    clock: str = ""


@dataclass(frozen=True)
class ChannelRelativeError(Unknown[ComplexArray]):
    """An unknown of a chain, with the relative change `effect` (K, M)."""

    effect: ComplexArray

    def scaled(self, factor: ComplexArray | FloatArray) -> ChannelRelativeError:
        """Return the error of readings times complex factors (K, 1) or (K, M)."""
        return self

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6); the relative change may be (K, 1)."""
        none = np.zeros(design.shape[:2], np.complex128)
        slope = self.effect[:, :, None] * design
        return CommonError(self.name, self.label, self.u, self.unit, self.scope, slope, none, self.type, self.dof)


@dataclass(frozen=True)
class FittedError(ChannelRelativeError):
    """An error of times: a relative `effect` (K, 1) and an `additive` change.

    `additive` (K, M): the part that records shorter than a beat cannot separate from the lines. It mixes lines, and X
    with its conjugate.
    """

    additive: ComplexArray = field(kw_only=True)

    def scaled(self, factor: ComplexArray | FloatArray) -> FittedError:
        """Return the error of readings times complex factors (K, 1) or (K, M)."""
        return replace(self, additive=self.additive * factor)

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6): a proportional and an additive change."""
        return replace(super().of_rows(design), offset=self.additive)

    def of_channel(self, column: int) -> FittedError:
        """Return the error of one of the channels of a fit."""
        return replace(self, additive=self.additive[:, column : column + 1])

    def relative_to(self, phasors: Phasors) -> ChannelRelativeError:
        """Return the relative error (K, 1) of one channel.

        It has no additive part at lines within the noise.
        """
        size = np.abs(phasors.value)
        significant = size > NOISE_REACH * np.hypot(phasors.u_re, phasors.u_im)
        rest = np.divide(self.additive, phasors.value, out=np.zeros_like(self.additive), where=significant)
        return ChannelRelativeError(
            self.name, self.label, self.u, self.unit, self.effect + rest, self.scope, self.type, self.dof
        )


@dataclass(frozen=True)
class ChannelReading:
    """One channel: manifest entry, phasors (SI, corrected for delay and response), chain.

    `further_errors`: relative errors (K, 1) in addition to those of its chain.
    """

    entry: ChannelEntry
    phasors: Phasors
    chain: ChainUncertainty
    further_errors: tuple[ChannelRelativeError, ...] = ()


DELAY_OF_FILTER = "filter that the delay may be of"
"""Label of the attenuation of a delay that is not pure."""


def u_of_filter(frequency_hz: FloatArray, delay_s: float) -> tuple[FloatArray, FloatArray]:
    """Return u (K,) of relative magnitude and phase, rad, of a possible low-pass.

    There is no correction. The effect of the filter is between zero and that of the usual filter with the largest
    effect; u is this limit over √3.
    """
    if not delay_s > 0.0:
        return np.zeros(len(frequency_hz)), np.zeros(len(frequency_hz))
    filters = filters_of_delay(frequency_hz, delay_s)
    most = np.abs(np.abs(filters) - 1.0).max(axis=0), np.abs(np.angle(filters)).max(axis=0)
    return most[0] / np.sqrt(3.0), most[1] / np.sqrt(3.0)


def chain_errors(readings: Sequence[ChannelReading]) -> tuple[ChannelRelativeError, ...]:
    """Return scale, delay and response errors of channels that share one chain.

    A scale error multiplies by 1 + u, a delay error by exp(-jω u) ≈ 1 - jω u, a response error by 1 + u_m + j u_phi.
    Response errors, and those of a filter with the delay (`u_of_filter`), are one unknown for all lines.
    `individual_uncertainty` is one unknown per channel. Further errors of readings, such as those of clocks, are last.
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
    for index, entry in enumerate(entries):
        individual = np.ones((len(frequency), 1)) * entry.individual_uncertainty * only[index]
        errors.append(
            ChannelRelativeError(f"{label} {entry.name}", label, entry.individual_uncertainty, "1", individual, "rig")
        )
    for index, reading in enumerate(readings):
        errors += [replace(error, effect=error.effect * only[index]) for error in reading.further_errors]
    return nonzero_errors(errors)


def nonzero_errors(errors: Iterable[ChannelRelativeError]) -> tuple[ChannelRelativeError, ...]:
    """Return every unknown once, with the sum of its effects, without those of zero effect."""
    return tuple(error for error in added_up(errors) if np.any(error.effect != 0.0))


def delay_errors(
    name: str, frequency_hz: FloatArray, u_s: float, scope: Scope = "recording"
) -> tuple[ChannelRelativeError, ...]:
    """Return a delay error, exp(-jω u) ≈ 1 - jω u, if any."""
    turn = np.asarray(-2j * np.pi * frequency_hz * u_s)[:, None]
    return (ChannelRelativeError(name, name, u_s, "s", turn, scope),) if u_s > 0.0 else ()


def clock_rate(design: ComplexArray, orders: FloatArray, clock_uncertainty: float) -> list[CommonError]:
    """Return the unknown of a clock rate, -n·u for readings ∝ ω^-n; `orders`: n (M,)."""
    relative = np.broadcast_to(-clock_uncertainty * orders + 0j, design.shape[:2])
    rate = ChannelRelativeError(CLOCK_RATE, CLOCK_RATE, clock_uncertainty, "1", relative, "rig").of_rows(design)
    return [rate] if np.any(rate.slope != 0.0) else []


def scale_is_stated(entry: ChannelEntry, response: ChainResponse | None) -> bool:
    """Whether the manifest, or the channel's response, states an uncertainty of its scale."""
    by_response = response is not None and bool(np.any(response.u_magnitude > 0.0))
    return by_response or bool(entry.scale_uncertainty or entry.individual_uncertainty)


def errors_are_stated(entry: ChannelEntry, response: ChainResponse | None, beams: LaserBeams) -> bool:
    """Whether any systematic uncertainty of a motion channel is stated; `fuse` prefers such channels."""
    of_chain = scale_is_stated(entry, response) or entry.delay_uncertainty > 0.0
    of_chain = of_chain or (response is not None and bool(np.any(response.errors != 0.0)))
    return of_chain or bool(geometry_errors(TRANSDUCERS[entry.quantity], entry, beams))


# Points and directions of channels, and their uncertainty.


FAN_U = 1.0 / np.sqrt(3.0)
"""Of beams stated as parallel: uniform between parallel and the fan of one mirror, in either sense."""


def geometry_errors(
    transducer: Transducer, entry: ChannelEntry, beams: LaserBeams | None = None
) -> tuple[Unknown[FloatArray], ...]:
    """Return the unknowns of a channel's point and direction, with names valid for all recordings.

    Effects (6,) on its geometry, for one mounting. `beams`: of all channels of the recording; by default the channel
    only.

    A point has three coordinates, a direction two small rotations. A transverse sensitivity t of unknown direction has
    two components of t/√2 across the axis. Contributions of its head are last. Several points with one direction and no
    head have a common tilt and individual ones, because the manifest does not state which applies.
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
            rotated = u * transducer.geometry(point, tangent)
            errors.append(Unknown(name, f"{chain}: {kind}", float(u), of_kind, rotated, "mounting"))
            if kind == "direction" and beams.shares_tilt(entry):
                shared = _tilt_name(entry, str(number))
                errors.append(Unknown(shared, f"{chain}: tilt", float(u), of_kind, rotated, "mounting"))
    errors += _head_errors(transducer, entry, beams)
    return tuple(error for error in errors if np.any(error.effect != 0.0))


def _moved_point(entry: ChannelEntry, shift: FloatArray) -> FloatArray:
    """Return the change (6,) of [d, r × d] by a shift.

    Aimed beams rotate about their mirror.
    """
    direction = unit_direction(entry)
    if not is_aimed_at_mirror(entry):
        return np.concatenate([np.zeros(3), np.cross(shift, direction)])
    mirror = mirror_of(entry)
    rotated = -(shift - direction * (direction @ shift)) / np.linalg.norm(mirror - measuring_point(entry))
    return np.concatenate([rotated, np.cross(mirror, rotated)])


def _tilt_name(entry: ChannelEntry, axis: str) -> str:
    along = ", ".join(f"{x:.9g}" for x in entry.direction or ())
    return f"{chain_name(entry)}: tilt along ({along}) {axis}"


def _head_errors(transducer: Transducer, entry: ChannelEntry, beams: LaserBeams) -> list[Unknown[FloatArray]]:
    """Return the common unknowns of all channels of a head, with the head's name.

    A small rotation φ of the head rotates the direction d by φ × d. About a stated mirror q it also moves the point r
    by φ × (r - q): the beam still passes through q, and points set by the angles of the head shift across the body.
    Otherwise the points are fixed, as for an accelerometer or for spots measured on the body. An offset moves all
    points equally. A wrong mirror rotates aimed beams about their points. Beams stated as parallel converge towards the
    centre of the points if they leave one mirror. Their change includes its second order, d·cos θ, which is the whole
    effect for a motion along d. Channels on the head itself have individual points.
    """
    if entry.head is None or entry.body == HEAD:
        return []
    stated, title = entry.head.stated, f"head {entry.head.name}"
    point, direction, mirror = measuring_point(entry), unit_direction(entry), mirror_of(entry)
    errors = []

    def add(kind: str, axis: str, u: float, unit: str, effect: FloatArray) -> None:
        name = f"{title}: {kind} {axis}".rstrip()
        errors.append(Unknown(name, f"{title}: {kind}", u, unit, u * effect, "mounting"))

    for index, axis in enumerate("xyz"):
        unit = np.eye(3)[index]
        rotated, shift = np.cross(unit, direction), np.cross(unit, point - mirror)
        row = transducer.geometry(point, rotated)
        if not transducer.rotational:
            row[3:] += np.cross(shift, direction)
            add("offset", axis, stated.point_uncertainty[index], "m", _moved_point(entry, unit))
        add("tilt", axis, stated.rotation_uncertainty[index], "rad", row)
        if is_aimed_at_mirror(entry):
            leaning = (unit - direction * (direction @ unit)) / np.linalg.norm(mirror - point)
            add("mirror", axis, stated.mirror_uncertainty[index], "m", transducer.geometry(point, leaning))
    fan = beams.fan(entry)
    if fan is not None:
        leaning = (direction + fan) / np.linalg.norm(direction + fan)
        add("fan of beams", "", FAN_U, "1", transducer.geometry(point, leaning - direction))
    return errors


@dataclass(frozen=True)
class ChannelGeometry(Geometry):
    """Points and directions of the channels of one instrument, for the Monte Carlo run."""

    transducer: Transducer
    entries: tuple[ChannelEntry, ...]
    frequency_hz: FloatArray
    gravity_mps2: FloatArray | None
    beams: LaserBeams

    @property
    def unknowns(self) -> frozenset[str]:
        """Names of the unknowns that `rows` samples."""
        errors = (geometry_errors(self.transducer, entry, self.beams) for entry in self.entries)
        return frozenset(error.name for members in errors for error in members)

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows (N, K, M, 6) with shifted points, rotated axes and transverse sensitivity.

        Rotations are finite. The angle of a transverse sensitivity is uniform, because only its size is stated. The fan
        of beams stated as parallel is uniform, too.
        """
        drawn = []
        for entry in self.entries:
            point, mirror, direction = self._drawn_beam(entry, deviates)
            sides = perpendicular_axes(unit_direction(entry))
            angle = deviates.angle(placement_name(entry, TRANSVERSE, "0"))
            leak = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ sides
            rotated = direction + entry.transverse_sensitivity * leak
            if entry.head is not None:
                tilt = np.array(entry.head.stated.rotation_uncertainty) * _vector(
                    deviates, f"head {entry.head.name}: tilt"
                )
                turn = rotation_from_vector(tilt)
                rotated = np.einsum("nij,nj->ni", turn, rotated)
                point = mirror + np.einsum("nij,nj->ni", turn, point - mirror)
            geometry = self.transducer.geometry(point, np.asarray(rotated))
            drawn.append(self.transducer.rows(geometry, self.frequency_hz, self.gravity_mps2))
        return np.stack(drawn, axis=2)

    def _drawn_beam(self, entry: ChannelEntry, deviates: Deviates) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return N points, centres of rotation and directions, each (N, 3), before the head rotates."""
        u = np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))
        shifts = [deviates.normal(placement_name(entry, "point", axis)) for axis in "xyz"]
        point = measuring_point(entry) + u * np.stack(shifts, axis=1)
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


# Channels of one instrument as rows of the linear model.


def observe_channels(
    readings: Sequence[ChannelReading], gravity_mps2: ArrayLike | None = None, clock_uncertainty: float = 0.0
) -> tuple[Observation, ...]:
    """Return the rows of all motion channels, one observation per instrument and body.

    The row of a channel at r with direction d is [d, r × d] · {1, 1/(jω), -1/ω²} for acceleration, velocity,
    displacement. An accelerometer measures d·(a - g) in body axes, which adds (d × g)/ω² to its rotations if
    `gravity_mps2` (3,) is given. A gyroscope measures d·alpha/(jω). `clock_uncertainty`: relative, of the clock.
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
    for index, entry in enumerate(entries):
        for error in geometry_errors(transducer, entry, beams):
            earlier = placed.get(error.name)
            slope = np.zeros_like(design) if earlier is None else earlier.slope
            slope[:, index] = transducer.rows(error.effect, frequency, gravity_mps2)
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


# The outputs of the sensor under test with its bridge amplifier: phasors, common errors, samples.

NOISE = "output noise"


@dataclass(frozen=True)
class Outputs:
    """Phasors (K, C) of the sensor's outputs, with their uncertainty.

    `uncertainty`: noise of the sine approximation, and scale, delay, response and clock errors. Common errors with
    motion instruments (a clock, an amplifier) have the same names. `additive`: names of influences that add to the
    outputs and do not belong to their chains.
    """

    phasors: Phasors
    uncertainty: Uncertainty
    additive: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected, found = self.phasors.covariance.shape, self.uncertainty.random[0].covariance.shape
        if found != expected:
            raise ValueError(f"uncertainty: expected covariances of shape {expected}, found {found}")

    def draw(self, deviates: Deviates) -> ComplexArray:
        """Return N samples (N, K, C) with noise and errors of the chains.

        Relative errors c act as division by (1 + Re c)·exp(j·Im c). Additive influences are added before.
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
    """Return the outputs of the sensor among readings, in order, if any."""
    named = {str(reading.entry.channel): reading for reading in readings if reading.entry.quantity == "output"}
    ordered = [
        replace(named[name], phasors=replace(named[name].phasors, channels=(name,))) for name in order if name in named
    ]
    return output_phasors(ordered) if ordered else None


def output_phasors(readings: Sequence[ChannelReading]) -> Outputs:
    """Return the outputs of C channels, in their order.

    A relative error (K, C) of a chain changes the reading U by relative · U for one standard uncertainty. Channels of
    one `common` instrument share its errors. A budget labels the errors of a chain by their kind, not by channel.
    """
    if not readings:
        raise ValueError("readings: expected at least one output channel, found none")
    signals = stack_phasors([reading.phasors for reading in readings])
    chains: dict[str, list[int]] = {}
    for index, reading in enumerate(readings):
        chains.setdefault(chain_name(reading.entry), []).append(index)
    influences = []
    for columns in chains.values():
        for error in chain_errors([readings[index] for index in columns]):
            change = np.zeros_like(signals.value)
            change[:, columns] = error.effect * signals.value[:, columns]
            label = error.label if error.scope in PER_RECORDING_SCOPES else "output " + error.label.rpartition(": ")[2]
            influences.append(replace(error.acting(real_stack(change)), label=label))
    noise = Contribution(NOISE, "A", signals.covariance, signals.dof)
    uncertainty = Uncertainty((noise,), added_up(influences))
    return Outputs(replace(signals, covariance=uncertainty.covariance), uncertainty)
