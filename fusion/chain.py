"""A channel with its chain: phasors, what the manifest states of them, and the relative errors that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion.uncertainty import Kind, Scope
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import Phasors

if TYPE_CHECKING:
    from fusion.manifest import ChannelEntry


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
    type: Kind = "B"


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
