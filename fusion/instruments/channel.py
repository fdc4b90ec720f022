"""Channels as they are read through their measuring chains: errors of the chain by name, rows of the linear model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import CommonError, Observation
from fusion.estimation.uncertainty import Scope, Unknown, added_up
from fusion.instruments import TRANSDUCERS
from fusion.instruments.transducer import ChannelGeometry, chain_name, geometry_errors, placed_at, unit_direction
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
