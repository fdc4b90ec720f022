"""Channels read through their chains: errors of a chain by name, rows of the linear model, the sensor's outputs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import CommonError, Deviates, Geometry, Observation
from fusion.estimation.uncertainty import (
    Contribution,
    Scope,
    Uncertainty,
    Unknown,
    added_up,
    as_complex,
    real_stack,
)
from fusion.instruments.transducer import (
    TRANSDUCERS,
    TRANSVERSE,
    Transducer,
    across,
    chain_name,
    placed_at,
    placement_name,
    unit_direction,
)
from photogram.geometry import rotation_from_vector
from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.phasor import Phasors, stack_phasors

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

CLOCK_RATE = "clock rate"

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
class RelativeError(Unknown[ComplexArray]):
    """One unknown of a chain: `effect` (K, M), the complex relative change of its M readings."""

    effect: ComplexArray

    def of_rows(self, design: ComplexArray) -> CommonError:
        """Return the unknown of rows (K, M, 6) that it changes in proportion; the relative change may be (K, 1)."""
        none = np.zeros(design.shape[:2], np.complex128)
        slope = self.effect[:, :, None] * design
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
        errors.append(RelativeError(f"{name}: {kind}", f"{name}: {kind}", u, unit, relative, "rig"))
    for clock in sorted({c.clock for c in chains if c.u_clock_s > 0.0}):
        times = np.array([c.u_clock_s if c.clock == clock else 0.0 for c in chains])
        unknown, late = f"clock {clock}: time", turn[:, None] * times
        errors.append(RelativeError(unknown, unknown, float(np.max(times)), "s", late))
    label = f"{name}: individual scale"
    only = np.eye(len(entries), dtype=np.complex128)
    for place, entry in enumerate(entries):
        own = np.ones((len(frequency), 1)) * entry.individual_uncertainty * only[place]
        errors.append(RelativeError(f"{label} {entry.name}", label, entry.individual_uncertainty, "1", own, "rig"))
    for place, reading in enumerate(readings):
        errors += [replace(error, effect=error.effect * only[place]) for error in reading.further]
    return acting(errors)


def acting(errors: Iterable[RelativeError]) -> tuple[RelativeError, ...]:
    """Return every unknown once, its effects added up; what acts on nothing is left out."""
    return tuple(error for error in added_up(errors) if np.any(error.effect != 0.0))


def late(name: str, frequency_hz: FloatArray, u_s: float, scope: Scope = "recording") -> tuple[RelativeError, ...]:
    """Return a time error, if any: what is late by one standard uncertainty turns by exp(-jω u) ≈ 1 - jω u."""
    turn = np.asarray(-2j * np.pi * frequency_hz * u_s)[:, None]
    return (RelativeError(name, name, u_s, "s", turn, scope),) if u_s > 0.0 else ()


def clock_rate(design: ComplexArray, orders: FloatArray, clock_uncertainty: float) -> list[CommonError]:
    """Return the unknown of a time base: where it runs fast readings ∝ ω^-n, n (M,), seem larger by n times as much."""
    relative = np.broadcast_to(-clock_uncertainty * orders + 0j, design.shape[:2])
    rate = RelativeError(CLOCK_RATE, CLOCK_RATE, clock_uncertainty, "1", relative, "rig").of_rows(design)
    return [rate] if np.any(rate.slope != 0.0) else []


# Where and along what the channels measure, and what is uncertain of that.


def geometry_errors(transducer: Transducer, entry: ChannelEntry) -> tuple[Unknown[FloatArray], ...]:
    """Return what is uncertain of a channel's place and direction, by names that hold in every recording.

    Effects (6,) on its geometry, as long as things are mounted as they are.

    A point has three coordinates; a direction errs by two small rotations; a transverse sensitivity t of unknown
    direction is two components of t/√2 across the axis.
    """
    point, direction, chain = placed_at(entry), unit_direction(entry), chain_name(entry)
    errors = []
    if not transducer.turning:
        for axis, unit, u in zip("xyz", np.eye(3), np.broadcast_to(entry.point_uncertainty, 3).tolist(), strict=True):
            lever = np.concatenate([np.zeros(3), np.cross(unit, direction) * u])
            errors.append(Unknown(placement_name(entry, "point", axis), f"{chain}: point", u, "m", lever, "mounting"))
    leaks = (
        ("direction", "rad", entry.direction_uncertainty),
        (TRANSVERSE, "1", entry.transverse_sensitivity / np.sqrt(2.0)),
    )
    for number, tangent in enumerate(across(direction)):
        for kind, of_kind, u in leaks:
            name = placement_name(entry, kind, str(number))
            turned = u * transducer.geometry(point, tangent)
            errors.append(Unknown(name, f"{chain}: {kind}", float(u), of_kind, turned, "mounting"))
    return tuple(error for error in errors if np.any(error.effect != 0.0))


@dataclass(frozen=True)
class ChannelGeometry(Geometry):
    """Places and directions of the channels of one instrument, for the Monte Carlo run."""

    transducer: Transducer
    entries: tuple[ChannelEntry, ...]
    frequency_hz: FloatArray
    gravity_mps2: FloatArray | None

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` draws."""
        return frozenset(error.name for entry in self.entries for error in geometry_errors(self.transducer, entry))

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


# The channels of one instrument as rows of the linear model.


def observe_channels(
    readings: Sequence[Reading], gravity_mps2: ArrayLike | None = None, clock_uncertainty: float = 0.0
) -> tuple[Observation, ...]:
    """Return the rows of all motion channels, one observation per instrument and body.

    Row of a channel at r with direction d: [d, r × d] · {1, 1/(jω), -1/ω²} for acceleration, velocity, displacement;
    an accelerometer reads d·(a - g) in body axes, so that its rotation part gains (d × g)/ω² when `gravity_mps2` (3,)
    is given; a gyroscope reads d·alpha/(jω). `clock_uncertainty`: relative, of the time base.
    """
    groups: dict[tuple[str, str, str], list[Reading]] = {}
    for reading in readings:
        entry = reading.entry
        if entry.quantity in TRANSDUCERS:
            groups.setdefault((chain_name(entry), str(entry.body), entry.quantity), []).append(reading)
    gravity = None if gravity_mps2 is None else np.asarray(gravity_mps2, dtype=np.float64)
    return tuple(_observe(group, gravity, clock_uncertainty) for group in groups.values())


def _observe(readings: Sequence[Reading], gravity_mps2: FloatArray | None, clock_uncertainty: float) -> Observation:
    """Return rows and common errors of the channels of one instrument on one body."""
    transducer = TRANSDUCERS[readings[0].entry.quantity]
    phasors = stack_phasors([reading.phasors for reading in readings])
    entries, frequency = tuple(reading.entry for reading in readings), phasors.frequency_hz
    geometry = np.stack([transducer.geometry(placed_at(entry), unit_direction(entry)) for entry in entries])
    design = transducer.rows(geometry, frequency, gravity_mps2).swapaxes(0, 1)
    none = np.zeros_like(phasors.value)
    common = [error.of_rows(design) for error in chain_errors(readings)]
    for place, entry in enumerate(entries):
        for error in geometry_errors(transducer, entry):
            slope = np.zeros_like(design)
            slope[:, place] = transducer.rows(error.effect, frequency, gravity_mps2)
            common.append(CommonError(error.name, error.label, error.u, error.unit, error.scope, slope, none))
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


# The outputs of the sensor under test, read through a bridge amplifier: phasors, common errors by name, and drawn.

NOISE = "output noise"


@dataclass(frozen=True)
class Outputs:
    """Phasors (K, C) of the sensor's outputs, in the unit of the sensor, with their whole covariance.

    `uncertainty`: noise of the sine approximation, and scale, delay, response and clock errors under the names that
    the motion's instruments use, so that what both share (a clock, an amplifier) acts on both.
    """

    phasors: Phasors
    uncertainty: Uncertainty

    def __post_init__(self) -> None:
        expected, found = self.phasors.covariance.shape, self.uncertainty.random[0].covariance.shape
        if found != expected:
            raise ValueError(f"uncertainty: expected covariances of shape {expected}, found {found}")

    def draw(self, deviates: Deviates) -> ComplexArray:
        """Return N draws (N, K, C) with noise, from which relative errors c of the chains are taken off exactly.

        They act as (1 + Re c)·exp(j·Im c).
        """
        value = self.phasors.value
        drawn = np.repeat(value[None], deviates.count, axis=0)
        for part in self.uncertainty.random:
            dof = np.full(len(part.covariance), np.inf) if part.dof is None else part.dof
            drawn = drawn + as_complex(deviates.noise(f"{part.label} of outputs", part.covariance, dof))
        for influence in self.uncertainty.influences:
            effect = as_complex(influence.effect)
            relative = np.divide(effect, value, out=np.zeros_like(value), where=(value != 0.0) & np.isfinite(effect))
            size = deviates.normal(influence.name)[:, None, None]
            drawn = drawn / ((1.0 + size * relative.real) * np.exp(1j * size * relative.imag))
        return np.asarray(drawn)


def sensor_outputs(readings: Sequence[Reading], order: Sequence[str]) -> Outputs | None:
    """Return what of some readings are outputs of the sensor, in the order and by the names of its outputs, if any."""
    named = {str(reading.entry.channel): reading for reading in readings if reading.entry.quantity == "output"}
    own = [
        replace(named[name], phasors=replace(named[name].phasors, channels=(name,))) for name in order if name in named
    ]
    return output_phasors(own) if own else None


def output_phasors(readings: Sequence[Reading]) -> Outputs:
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
            label = error.label if error.scope == "recording" else "output " + error.label.rpartition(": ")[2]
            influences.append(replace(error.acting(real_stack(change)), label=label))
    noise = Contribution(NOISE, "A", signals.covariance, signals.dof)
    uncertainty = Uncertainty((noise,), added_up(influences))
    return Outputs(replace(signals, covariance=uncertainty.covariance), uncertainty)
