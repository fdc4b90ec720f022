"""What ties takes to each other: phasors of take i times R_1/R_i of the reference, and what that leaves open."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import InputError
from fusion.measured_results import TakeResult
from fusion.notices import Notice
from fusion.observe import PERIODIC, PulseExposure, Reading, RelativeError, StereoReading, added_up
from fusion.take import OpenTake
from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.signals.phasor import Phasors, real_stacked_diagonal

LEAST_SNR = 6.0
"""Of its own standard uncertainty: what the reference must reach at a line; 1/R_i is biased by u²/R², 3 % there."""
TOLD_DRIFT, LARGE_DRIFT = 1e-3, 2e-2
SAME_FREQUENCY = 1e-4  # relative: what clocks and generators differ by from take to take
KEPT_NOISE = 1e-6  # of a covariance that an unknown has taken over: enough to stay positive definite


@dataclass(frozen=True)
class Referral:
    """How one take is referred to the first: its phasors times `factor` (K,), NaN at lines without a reference.

    `first`: this is the take that all are referred to. `frequency_hz` (K,): lines of the first take, at which results
    are given. `noise`: the reference's noise in this take as relative errors (K, 1) of its phasor, at lines where it
    stands out; `errors`: those that all referred phasors of the take share.
    """

    name: str
    first: bool
    frequency_hz: FloatArray
    factor: ComplexArray
    noise: tuple[RelativeError, ...]
    errors: tuple[RelativeError, ...]
    result: TakeResult

    def phasors(self, phasors: Phasors) -> Phasors:
        """Return phasors of the take as those of the first."""
        return replace(phasors.scaled(self.factor[:, None]), frequency_hz=self.frequency_hz)

    def reading(self, reading: Reading) -> Reading:
        """Return a channel of the take as one of the first, its clock's errors among its own."""
        chain = replace(reading.chain, clock=f"{self.name}: {reading.chain.clock}", u_clock_s=0.0)
        further = added_up([*_clock_error(self.name, reading), *self.errors])
        return Reading(reading.entry, self.phasors(reading.phasors), chain, further)

    def reference(self, reading: Reading) -> Reading:
        """Return the reference channel of the first take, its noise being that which all other takes share."""
        known = np.zeros(len(self.frequency_hz), dtype=np.bool_)
        for error in self.noise:
            known |= error.relative[:, 0] != 0.0
        phasors = reading.phasors
        kept = np.where(known, KEPT_NOISE, 1.0)[:, None, None]
        own = self.reading(replace(reading, phasors=replace(phasors, covariance=phasors.covariance * kept)))
        return replace(own, further=added_up([*own.further, *self.noise]))

    def stereo(self, pair: StereoReading) -> StereoReading:
        """Return a stereo pair of the take as one of the first; what its frames have in common is the take's own."""
        effects: Mapping[str, ComplexArray] = {
            f"{what}, {self.name}" if what == PERIODIC else what: change * self.factor[:, None]
            for what, change in pair.effects.items()
        }
        pulse = pair.pulse
        return replace(
            pair,
            phasors=self.phasors(pair.phasors),
            effects=effects,
            trigger=(f"{self.name}: {pair.trigger[0]}", pair.trigger[1]),
            pulse=None if pulse is None else PulseExposure(f"{self.name}: {pulse.trigger}", pulse.width_s, pulse.u_s),
            further=self.errors,
        )


def referrals(takes: Sequence[OpenTake]) -> tuple[Referral, ...]:
    """Tie takes to the first one by the channel with `reference = true` in all of them.

    With R_i the reference's phasors, delay and response taken off, the factor is R_1/R_i. Its scale, delay and response
    cancel; its noise in take i is one complex unknown per line for all phasors of that take, its noise in the first
    take one for all other takes and for itself. A drift of its amplitude between the takes is made good, but what else
    changed with it is not known: d = ||R_i/R_1| - 1|, less its noise and with twice the relative change of the
    frequency, acts on magnitude and phase of all phasors of take i at that line (type B, rectangular of half-width d).
    """
    references = [_reference(take) for take in takes]
    return tuple(_referral(takes, references, place) for place in range(len(takes)))


def drift_notices(found: Sequence[Referral], driven: BoolArray) -> tuple[Notice, ...]:
    """Say how far the reference's amplitude, and the frequency, at the `driven` lines (K,) changed between takes."""
    notices = []
    for referral in found:
        result = referral.result
        changed = np.abs(result.frequency_hz / referral.frequency_hz - 1.0)
        for k in np.flatnonzero(driven & np.isfinite(result.drift)):
            at = f"{referral.frequency_hz[k]:.6g} Hz"
            if abs(result.drift[k]) > TOLD_DRIFT:
                text = (
                    f"the reference {result.reference} reads {100.0 * result.drift[k]:+.2g} % at {at} against the "
                    "first take; the level is made good, the drift is part of the uncertainty"
                )
                large = abs(result.drift[k]) > LARGE_DRIFT
                notices.append(Notice("warning" if large else "info", f"{referral.name}: {text}", referral.name))
            if changed[k] > SAME_FREQUENCY:
                text = f"driven at {result.frequency_hz[k]:.7g} Hz, in the first take at {at}"
                notices.append(Notice("warning", f"{referral.name}: {text}", referral.name))
    return tuple(notices)


def _reference(take: OpenTake) -> Reading:
    """Return the channel that ties a take to the others."""
    marked = [reading for reading in take.readings if reading.entry.reference]
    if len(marked) != 1:
        expected = "one channel with reference = true, the same in every take"
        raise InputError(take.manifest.path, f"{take.where}daq", found=f"{len(marked) or 'none'}", expected=expected)
    return marked[0]


def _referral(takes: Sequence[OpenTake], references: Sequence[Reading], place: int) -> Referral:
    """Tie one take to the first."""
    take, first, own = takes[place], references[0], references[place]
    stands_out = _standing_out(own) & _standing_out(first)
    _check_driven(take, own, stands_out)
    base_hz = first.phasors.frequency_hz
    here, there = own.phasors.value[:, 0], first.phasors.value[:, 0]
    factor = np.full(len(base_hz), complex(np.nan, np.nan))
    np.divide(there, here, out=factor, where=stands_out)
    u_drift = np.hypot(_u_relative(own), _u_relative(first)) if place else np.zeros(len(base_hz))
    drift = 1.0 / np.abs(factor) - 1.0
    noise = _noise(take.name, own, base_hz, _standing_out(own))
    errors: tuple[RelativeError, ...] = ()
    if place:
        known = np.sqrt(np.maximum(drift**2 - u_drift**2, 0.0))
        half_width = known + 2.0 * np.abs(own.phasors.frequency_hz / base_hz - 1.0)
        inherited = [*_noise(takes[0].name, first, base_hz, stands_out), *_clock_error(takes[0].name, first)]
        lost = [*noise, *_clock_error(take.name, own)]
        taken_off = [replace(error, relative=-error.relative) for error in lost]
        errors = added_up([*inherited, *taken_off, *_drift(take.name, base_hz, np.where(stands_out, half_width, 0.0))])
    result = TakeResult(
        name=take.name,
        reference=own.entry.name,
        frequency_hz=own.phasors.frequency_hz,
        value=here,
        factor=factor,
        drift=drift,
        u_drift=u_drift,
    )
    used = factor if place else np.ones(len(base_hz), dtype=np.complex128)
    return Referral(take.name, place == 0, base_hz, used, noise, errors, result)


def _u_relative(reading: Reading) -> FloatArray:
    """Standard uncertainty (K,) of real and imaginary part over the amplitude, mean of both."""
    phasors = reading.phasors
    u = np.sqrt((phasors.u_re[:, 0] ** 2 + phasors.u_im[:, 0] ** 2) / 2.0)
    size = np.abs(phasors.value[:, 0])
    return np.asarray(np.divide(u, size, out=np.full(len(u), np.inf), where=size > 0.0))


def _standing_out(reading: Reading) -> BoolArray:
    """Lines (K,) at which a reference is far above its noise."""
    return np.asarray(np.nan_to_num(_u_relative(reading), nan=np.inf) * LEAST_SNR < 1.0)


def _check_driven(take: OpenTake, reference: Reading, stands_out: BoolArray) -> None:
    """Refuse a reference that does not show a driven line."""
    driven = np.ones(0, dtype=np.bool_) if take.lines is None else take.lines.multiple == 1
    lost = np.flatnonzero(driven & ~stands_out)
    if len(lost):
        clock = next(daq for daq in take.manifest.daq if reference.entry in daq.channel)
        key = f"{take.where}daq.{clock.name}.channel.{reference.entry.name}.reference"
        amplitude, u = np.abs(reference.phasors.value[lost[0], 0]), reference.phasors.u_re[lost[0], 0]
        frequency = f"{reference.phasors.frequency_hz[lost[0]]:.6g} Hz"
        found = f"an amplitude of {amplitude:.2g} with a standard uncertainty of {u:.2g} in {take.name}"
        expected = f"a channel that shows the driven line at {frequency} in every take"
        raise InputError(take.manifest.path, key, found=found, expected=expected)


def _noise(name: str, reading: Reading, frequency_hz: FloatArray, lines: BoolArray) -> tuple[RelativeError, ...]:
    """Relative errors (K, 1) of a reference's phasor from its noise: two real unknowns at each of the lines chosen."""
    found = []
    phasors = reading.phasors
    for k in np.flatnonzero(lines):
        (turn,) = real_stacked_diagonal(1.0 / phasors.value[k : k + 1])
        variances, vectors = np.linalg.eigh(turn @ phasors.covariance[k] @ turn.T)
        for part, (variance, vector) in enumerate(zip(variances.tolist(), vectors.T, strict=True)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = np.sqrt(max(variance, 0.0)) * complex(*vector)
            unknown = f"reference noise of {name} at {frequency_hz[k]:.9g} Hz, part {part + 1}"
            found.append(RelativeError(unknown, "reference noise", 1.0, "1", "recording", relative, "A"))
    return tuple(found)


def _clock_error(name: str, reading: Reading) -> tuple[RelativeError, ...]:
    """Relative error (K, 1) of a channel from the tie of its clock to the first one of its take."""
    chain = reading.chain
    if chain.u_clock_s == 0.0:
        return ()
    relative = np.asarray(-2j * np.pi * reading.phasors.frequency_hz[:, None] * chain.u_clock_s)
    label = f"clock {chain.clock}: time"
    return (RelativeError(f"clock {name}: {chain.clock}: time", label, chain.u_clock_s, "s", "recording", relative),)


def _drift(name: str, frequency_hz: FloatArray, half_width: FloatArray) -> Iterator[RelativeError]:
    """Relative errors (K, 1) of magnitude and phase of all phasors of a take whose reference drifted this far."""
    label = "drift between takes"
    for k in np.flatnonzero(half_width > 0.0):
        u = float(half_width[k]) / np.sqrt(3.0)
        for part, unit, turn in (("magnitude", "1", 1.0 + 0.0j), ("phase", "rad", 1.0j)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = u * turn
            unknown = f"{label}: {part} of {name} at {frequency_hz[k]:.9g} Hz"
            yield RelativeError(unknown, label, u, unit, "recording", relative)
