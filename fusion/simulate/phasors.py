"""Recordings at the level of phasors: exact readings of drawn instruments, and what the program is told of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.analyse import Inputs
from fusion.body import Body, Part
from fusion.manifest import ChannelEntry, Sensor
from fusion.monte_carlo import Known
from fusion.observe import ChainUncertainty, Observation, Reading, StereoReading, observe_channels
from fusion.simulate.draws import Draws
from fusion.simulate.mechanics import Motion, TruePart, acceleration_at, velocity_at, wrench
from photogram.rigid import rotation_from_vector
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.frequencies import Lines
from shaker.signals.phasor import Phasors

UNITS = {
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "output": "V/V",
}


@dataclass(frozen=True, eq=False)
class Channel:
    """A channel as the manifest states it, its noise (K,) of real and imaginary part, and its clock.

    `scatter`: relative error of its own that nobody states. `dof`: degrees of freedom of the noise as it is estimated.
    """

    entry: ChannelEntry
    noise: FloatArray
    dof: float
    chain: ChainUncertainty
    scatter: float = 0.0


@dataclass(frozen=True, eq=False)
class Pair:
    """A stereo pair as stated; the covariance of its phasors is the true one, estimated with `dof`."""

    reading: StereoReading
    dof: float


@dataclass(frozen=True, eq=False)
class PhasorSetup:
    """What a laboratory states of a recording, and the motion that is really there.

    `acceleration` (K, 6): of the load at the sensor origin; `multiple` (K,); `sensitivity` (K, C, 6): true output per
    load component; `outputs`: C channels. `clock_uncertainty`: relative, of the time base.
    """

    lines: Lines
    acceleration: ComplexArray
    pairs: tuple[Pair, ...]
    channels: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sensitivity: ComplexArray
    parts: tuple[Part, ...]
    gravity_mps2: tuple[float, float, float]
    sensor: Sensor
    direction: tuple[float, ...]
    clock_uncertainty: float = 0.0


@dataclass(frozen=True, eq=False)
class PhasorTruth:
    """What was really there: acceleration (K, 6), wrench in the sensor's sense (K, 6), true sensor signals (K, C)."""

    acceleration: ComplexArray
    load: ComplexArray
    outputs: ComplexArray


def simulate_phasors(setup: PhasorSetup, draws: Draws) -> tuple[Known, PhasorTruth]:
    """Draw every error of a set-up, and return what the program gets beside the truth."""
    rate = 1.0 + float(draws.normal("clock rate", setup.clock_uncertainty))
    motion = Motion(setup.lines.frequency_hz * rate, setup.acceleration)
    gravity = np.array(setup.gravity_mps2)
    parts = [_true_part(part, draws) for part in setup.parts]
    sign = 1.0 if setup.sensor.sense == "on_load" else -1.0
    load = sign * wrench(motion, parts, gravity)
    signals = np.einsum("kcj,kj->kc", setup.sensitivity, load)
    stated_hz = setup.lines.frequency_hz
    readings = [
        _reading(channel, stated_hz, _motion_signal(channel.entry, motion, gravity, draws), draws)
        for channel in setup.channels
    ]
    outputs = [_reading(channel, stated_hz, signals[:, c], draws) for c, channel in enumerate(setup.outputs)]
    pairs = [_pair(pair, motion, draws) for pair in setup.pairs]
    seen: list[Observation] = [pair.observed() for pair in pairs]
    seen += observe_channels(readings, setup.gravity_mps2, setup.clock_uncertainty)
    inputs = Inputs(
        lines=setup.lines,
        observations=tuple(seen),
        outputs=tuple(outputs),
        body=Body(setup.parts),
        gravity_mps2=setup.gravity_mps2,
        sensor=setup.sensor,
        direction=setup.direction,
    )
    return Known(inputs, tuple(pairs), tuple(readings)), PhasorTruth(motion.acceleration, load, signals)


def _true_part(part: Part, draws: Draws) -> TruePart:
    """Return a part with errors of mass, centre of mass and inertia."""
    mass = part.mass_kg + float(draws.normal(f"{part.name}: mass", part.u_mass_kg))
    centre = part.centre_of_mass_m + draws.normal(f"{part.name}: centre of mass", part.u_centre_of_mass_m, 3)
    error = draws.normal(f"{part.name}: inertia", part.u_inertia_kgm2.ravel(), 9).reshape(3, 3)
    symmetric = np.triu(error) + np.triu(error, 1).T
    return TruePart(mass, centre, part.inertia_kgm2 + symmetric)


def _motion_signal(entry: ChannelEntry, motion: Motion, gravity: FloatArray, draws: Draws) -> ComplexArray:
    """Return what an errorless chain reads where the channel really is and in the direction it really has."""
    u_point = np.asarray(entry.point_uncertainty, dtype=np.float64)
    moved = draws.normal(f"{entry.name}: point", u_point, 3)
    point = np.zeros(3) if entry.point is None else np.array(entry.point) + moved
    direction = _true_direction(entry, draws)
    if entry.quantity == "acceleration":
        return acceleration_at(motion, point, direction, gravity)
    if entry.quantity == "angular_velocity":
        return np.asarray(motion.acceleration[:, 3:] @ direction / (1j * motion.omega))
    velocity = velocity_at(motion, point, direction)
    return velocity if entry.quantity == "velocity" else velocity / (1j * motion.omega)


def _true_direction(entry: ChannelEntry, draws: Draws) -> FloatArray:
    """Return the direction a channel is sensitive in: turned by a finite angle, and leaking across its axis."""
    stated = np.array(entry.direction, dtype=np.float64)
    stated /= np.linalg.norm(stated)
    first = np.cross(stated, np.eye(3)[np.argmin(np.abs(stated))])
    across = np.stack([first / np.linalg.norm(first), np.cross(stated, first) / np.linalg.norm(first)])
    tilt = draws.normal(f"{entry.name}: direction", entry.direction_uncertainty, 2)
    turned = rotation_from_vector(np.cross(stated, tilt @ across)) @ stated
    angle = draws.stream(f"{entry.name}: transverse").uniform(0.0, 2.0 * np.pi)
    leak = entry.transverse_sensitivity if draws.systematic else 0.0
    return np.asarray(turned + leak * (np.cos(angle) * across[0] + np.sin(angle) * across[1]))


def _reading(channel: Channel, frequency_hz: FloatArray, signal: ComplexArray, draws: Draws) -> Reading:
    """Return a channel as it is read: its chain's errors, its noise, and the noise as a fit would estimate it."""
    entry, chain = channel.entry, channel.chain
    name = entry.common or entry.name
    gain = 1.0 + entry.scale_uncertainty * float(draws.normal(f"{name}: scale", 1.0))
    gain *= 1.0 + float(draws.normal(f"{entry.name}: individual scale", entry.individual_uncertainty))
    gain *= 1.0 + float(draws.normal(f"{entry.name}: scatter", channel.scatter))
    delay = entry.delay_uncertainty * float(draws.normal(f"{name}: delay", 1.0))
    late = delay + chain.u_clock_s * float(draws.normal(f"clock {chain.clock}: time", 1.0))
    value = signal * gain * np.exp(-2j * np.pi * frequency_hz * late)
    if chain.u_magnitude is not None:
        value = value * (1.0 + chain.u_magnitude * float(draws.normal(f"{name}: response magnitude", 1.0)))
    if chain.u_phase_rad is not None:
        value = value * np.exp(1j * chain.u_phase_rad * float(draws.normal(f"{name}: response phase", 1.0)))
    covariance = channel.noise[:, None, None] ** 2 * np.eye(2)
    unit = UNITS[entry.quantity]
    blank = Phasors(frequency_hz, value[:, None], covariance, (entry.name,), (unit,), np.full(len(value), channel.dof))
    return Reading(entry, _with_noise(blank, entry.name, draws), chain)


def _pair(pair: Pair, motion: Motion, draws: Draws) -> StereoReading:
    """Return a pair as it is read: scale, place and axes of its frame, delays, and calibration off."""
    stated = pair.reading
    entry, title = stated.pair, f"stereo {stated.name}"
    pose = draws.normal(f"{title}: pose", np.array(entry.pose_uncertainty), 6)
    turn = rotation_from_vector(pose[3:])
    shift, spin = motion.displacement[:, :3], motion.displacement[:, 3:]
    scale = 1.0 + float(draws.normal(f"{title}: scale", entry.scale_uncertainty or 0.0))
    moved = np.concatenate([scale * (shift + np.cross(spin, pose[:3])) @ turn.T, spin @ turn.T], axis=1)
    late = float(draws.normal(f"{title}: delay", entry.delay_uncertainty))
    late += float(draws.normal(f"{stated.trigger[0]}: time", stated.trigger[1]))
    value = moved * np.exp(-2j * np.pi * stated.phasors.frequency_hz * late)[:, None]
    for what, changes in stated.effects.items():
        value = value + np.tensordot(draws.normal(f"{title}: {what}", 1.0, len(changes)), changes, 1)
    phasors = replace(stated.phasors, value=value, dof=np.full(len(value), pair.dof))
    return replace(stated, phasors=_with_noise(phasors, title, draws))


def _with_noise(phasors: Phasors, name: str, draws: Draws) -> Phasors:
    """Add noise of the covariance stated, and replace that by an estimate with the phasors' degrees of freedom."""
    rng = draws.stream(f"{name}: noise")
    channels = len(phasors.channels)
    root = np.linalg.cholesky(phasors.covariance)
    noise = np.einsum("kij,kj->ki", root, rng.standard_normal(root.shape[:2]))
    estimated = rng.chisquare(phasors.dof) / phasors.dof
    return replace(
        phasors,
        value=phasors.value + noise[:, :channels] + 1j * noise[:, channels:],
        covariance=phasors.covariance * estimated[:, None, None],
    )


def lines_at(frequency_hz: Sequence[float], multiple: Sequence[int]) -> Lines:
    """Return lines without uncertainty of their frequencies: fundamentals where `multiple` is 1."""
    frequency = np.array(frequency_hz, dtype=np.float64)
    number = np.array(multiple, dtype=np.int64)
    why = tuple("stated" for _ in frequency)
    return Lines(frequency, np.zeros(len(frequency)), frequency / number, number, why, ())
