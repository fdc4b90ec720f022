"""Recordings simulated at the level of phasors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import Observation
from fusion.instruments.channel import (
    ChainUncertainty,
    ChannelReading,
    ChannelRelativeError,
    delay_errors,
    observe_channels,
    output_phasors,
)
from fusion.instruments.stereo import StereoReading
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Sensor, Stereo
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensitivity.analyse import Inputs
from fusion.sensitivity.moving_body import Body, MovingPart, make_moving_part
from fusion.simulate.world import Draws, SimulatedMotion, TruePart, acceleration_at, velocity_at, wrench
from photogram.geometry import rotation_from_vector
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import ComplexArray, FloatArray

# Recordings at the level of phasors: exact readings of drawn instruments, and what the program is told of them.


@dataclass(frozen=True, eq=False)
class Channel:
    """A channel as the manifest states it, its noise (K,) of real and imaginary part, and the errors of its clock.

    `scatter`: relative error of its own that nobody states. `dof`: degrees of freedom of the noise as it is estimated.
    """

    entry: ChannelEntry
    noise: FloatArray
    dof: float
    chain: ChainUncertainty
    scatter: float = 0.0
    clock: tuple[ChannelRelativeError, ...] = ()


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

    lines: LineFrequencies
    acceleration: ComplexArray
    pairs: tuple[Pair, ...]
    channels: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sensitivity: ComplexArray
    parts: tuple[MovingPart, ...]
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


def simulate_phasors(setup: PhasorSetup, draws: Draws) -> tuple[Inputs, PhasorTruth]:
    """Draw every error of a set-up, and return what the program gets beside the truth."""
    rate = 1.0 + float(draws.normal("clock rate", setup.clock_uncertainty))
    motion = SimulatedMotion(setup.lines.frequency_hz * rate, setup.acceleration)
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
    seen: list[Observation] = [pair.observation() for pair in pairs]
    seen += observe_channels(readings, setup.gravity_mps2, setup.clock_uncertainty)
    inputs = Inputs(
        lines=setup.lines,
        observations=tuple(seen),
        outputs=output_phasors(outputs),
        body=Body(setup.parts, gravity_mps2=setup.gravity_mps2, sense=setup.sensor.sense),
        sensor=setup.sensor,
        direction=setup.direction,
    )
    return inputs, PhasorTruth(motion.acceleration, load, signals)


def _true_part(part: MovingPart, draws: Draws) -> TruePart:
    """Return a part with errors of mass, centre of mass and inertia."""
    mass = part.mass_kg + float(draws.normal(f"{part.name}: mass", part.u_mass_kg))
    centre = part.centre_of_mass_m + draws.normal(f"{part.name}: centre of mass", part.u_centre_of_mass_m, 3)
    error = draws.normal(f"{part.name}: inertia", part.u_inertia_kgm2.ravel(), 9).reshape(3, 3)
    symmetric = np.triu(error) + np.triu(error, 1).T
    return TruePart(mass, centre, part.inertia_kgm2 + symmetric)


def _motion_signal(entry: ChannelEntry, motion: SimulatedMotion, gravity: FloatArray, draws: Draws) -> ComplexArray:
    """Return what an errorless chain reads where the channel really is and in the direction it really has."""
    u_point = np.asarray(entry.point_uncertainty, dtype=np.float64)
    moved = draws.normal(f"{entry.name}: point", u_point, 3)
    point = np.zeros(3) if entry.point is None else np.array(entry.point) + moved
    direction = _true_direction(entry, draws)
    velocity = velocity_at(motion, point, direction)
    return {
        "displacement": velocity / (1j * motion.omega),
        "velocity": velocity,
        "acceleration": acceleration_at(motion, point, direction, gravity),
        "angular_velocity": np.asarray(motion.acceleration[:, 3:] @ direction / (1j * motion.omega)),
    }[entry.quantity]


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


def _reading(channel: Channel, frequency_hz: FloatArray, signal: ComplexArray, draws: Draws) -> ChannelReading:
    """Return a channel as it is read: its chain's errors, its noise, and the noise as a fit would estimate it."""
    entry, chain = channel.entry, channel.chain
    name = entry.common or entry.name
    gain = 1.0 + entry.scale_uncertainty * float(draws.normal(f"{name}: scale", 1.0))
    gain *= 1.0 + float(draws.normal(f"{entry.name}: individual scale", entry.individual_uncertainty))
    gain *= 1.0 + float(draws.normal(f"{entry.name}: scatter", channel.scatter))
    delay = entry.delay_uncertainty * float(draws.normal(f"{name}: delay", 1.0))
    behind = delay + sum(float(draws.normal(error.name, error.u)) for error in channel.clock)
    value = signal * gain * np.exp(-2j * np.pi * frequency_hz * behind)
    if chain.u_magnitude is not None:
        value = value * (1.0 + chain.u_magnitude * float(draws.normal(f"{name}: response magnitude", 1.0)))
    if chain.u_phase_rad is not None:
        value = value * np.exp(1j * chain.u_phase_rad * float(draws.normal(f"{name}: response phase", 1.0)))
    covariance = channel.noise[:, None, None] ** 2 * np.eye(2)
    unit = TRANSDUCERS[entry.quantity].unit if entry.quantity in TRANSDUCERS else "V/V"
    blank = Phasors(frequency_hz, value[:, None], covariance, (entry.name,), (unit,), np.full(len(value), channel.dof))
    return ChannelReading(entry, _with_noise(blank, entry.name, draws), chain, channel.clock)


def _pair(pair: Pair, motion: SimulatedMotion, draws: Draws) -> StereoReading:
    """Return a pair as it is read: scale, place and axes of its frame, delays, and calibration off."""
    stated = pair.reading
    entry, title = stated.pair, f"stereo {stated.name}"
    pose = draws.normal(f"{title}: pose", np.array(entry.pose_uncertainty), 6)
    turn = rotation_from_vector(pose[3:])
    shift, spin = motion.displacement[:, :3], motion.displacement[:, 3:]
    scale = 1.0 + float(draws.normal(f"{title}: scale", entry.scale_uncertainty or 0.0))
    moved = np.concatenate([scale * (shift + np.cross(spin, pose[:3])) @ turn.T, spin @ turn.T], axis=1)
    behind = float(draws.normal(f"{title}: delay", entry.delay_uncertainty))
    behind += sum(float(draws.normal(error.name, error.u)) for error in stated.errors)
    value = moved * np.exp(-2j * np.pi * stated.phasors.frequency_hz * behind)[:, None]
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


def lines_at(frequency_hz: ArrayLike, multiple: ArrayLike) -> LineFrequencies:
    """Return lines without uncertainty of their frequencies: fundamentals where `multiple` is 1."""
    frequency = np.array(frequency_hz, dtype=np.float64)
    number = np.array(multiple, dtype=np.int64)
    why = tuple("stated" for _ in frequency)
    return LineFrequencies(frequency, np.zeros(len(frequency)), frequency / number, number, why, ())


# Set-ups at the level of phasors: a stereo pair, lasers, an accelerometer and six outputs, driven in several ways.


LINES = lines_at([106.25, 212.5], [1, 2])
OMEGA = 2.0 * np.pi * LINES.frequency_hz
BRIDGE = delay_errors("clock bridge: time", LINES.frequency_hz, 4e-7)
CAPACITY = (2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0)
GAINS = np.array([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
SENSOR = Sensor(
    name="six components",
    channels=LOAD_COMPONENTS,
    unit="V/V",
    sense="on_load",
    capacity=CAPACITY,
    internal_mass=0.769,
)
GRAVITY = (0.0, 0.0, -9.8125)
LASER = {
    "point_uncertainty": 1e-3,
    "direction_uncertainty": 5e-3,
    "scale_uncertainty": 2.5e-4,
    "individual_uncertainty": 1e-4,
    "delay_uncertainty": 5e-7,
    "common": "laser",
}
ACCELEROMETER = {
    "point": [0.02, -0.03, 0.06],
    "point_uncertainty": 1e-3,
    "direction_uncertainty": 5e-3,
    "scale_uncertainty": 2e-3,
    "individual_uncertainty": 1e-3,
    "transverse_sensitivity": 0.01,
    "delay_uncertainty": 1e-6,
    "common": "accelerometer",
}
TOP = ((0.045, 0.0, 0.0973), (-0.0225, 0.0390, 0.0973), (-0.0225, -0.0390, 0.0973))
SIDE = ((0.05, 0.0, 0.02), (0.05, 0.03, 0.08), (0.05, -0.03, 0.08))
BEAM = ((0.16, 0.0, 0.03), (-0.16, 0.0, 0.03), (0.0, 0.05, 0.03))
CIRCLE = tuple((0.04 * np.cos(a), 0.04 * np.sin(a), 0.03) for a in 2.0 * np.pi * np.arange(8) / 8.0)
SMALL = np.array([0.52 - 0.8j, -0.6 + 0.5j, 0.7 + 0.4j, 2.1 + 1.2j, -2.4 - 1.9j, 0.5 + 0.7j])
PLAIN_LOAD = (
    make_moving_part("load", 6.9605, (0.0, 0.0, 0.0507), np.diag([0.0103, 0.0103, 0.0105]), (1e-3, 1e-4, 2e-5)),
    make_moving_part("internal mass", 0.769, (0.0, 0.0, 0.002), np.diag([7e-4, 7e-4, 1.2e-3]), (2e-3, 2e-4, 1e-5)),
)
CROSS_BEAM = (
    make_moving_part("beam", 2.4, (0.0, 0.0, 0.025), np.diag([0.002, 0.021, 0.022]), (5e-4, 1e-4, 4e-5)),
    make_moving_part("mass at +x", 1.204, (0.162, 0.001, 0.04), np.diag([4e-4, 4e-4, 3e-4]), (2e-4, 1e-4, 5e-6)),
    make_moving_part("mass at -x", 1.187, (-0.158, 0.0, 0.04), np.diag([4e-4, 4e-4, 3e-4]), (2e-4, 1e-4, 5e-6)),
    PLAIN_LOAD[1],
)


@dataclass(frozen=True)
class Case:
    """An excitation: driven load component, size of the driven acceleration, instruments, load, and what is special."""

    name: str
    driven: int
    direction: tuple[float, ...]
    size: float
    points: tuple[tuple[float, float, float], ...]
    along: tuple[float, float, float]
    parts: tuple[MovingPart, ...] = PLAIN_LOAD
    one_clock: bool = False
    lasers_only: bool = False
    laser: dict[str, object] = field(default_factory=lambda: dict(LASER))
    laser_noise: float = 1e-5
    scatter: float = 0.0


Z, X = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
EIGHT = {"scale_uncertainty": 2.5e-4, "common": "laser"}
CASES = (
    Case("uniaxial z", 2, Z, 189.32, TOP, Z),
    Case("transverse x", 0, X, 90.0, SIDE, X),
    Case("moment My", 4, (0.0, 0.0, 0.0, 0.0, 1.0, 0.0), 900.0, BEAM, Z, CROSS_BEAM),
    Case("outputs and lasers on one clock", 2, Z, 189.32, TOP, Z, one_clock=True),
    Case(
        "eight lasers, 1e-3 discrepancy", 2, Z, 189.32, CIRCLE, Z,
        lasers_only=True, laser=EIGHT, laser_noise=2e-7, scatter=1e-3,
    ),
)  # fmt: skip


def true_acceleration(case: Case) -> ComplexArray:
    """Return the motion (K, 6): one component driven, the others small, harmonics a hundredth."""
    main = SMALL.copy()
    main[case.driven] = case.size * np.exp(0.369j)
    harmonic = 0.3 * SMALL[::-1] * np.exp(1.1j)
    harmonic[case.driven] = 0.01 * case.size * np.exp(-1.2j)
    if case.lasers_only:
        main[[0, 1, 5]] = harmonic[[0, 1, 5]] = 0.0
    return np.stack([main, harmonic])


def laser_channel(case: Case, place: int, motion: ComplexArray) -> Channel:
    """Return one laser point; its noise is relative to the velocity of the driven point."""
    point = [float(value) for value in case.points[place]]
    text = {"name": f"laser {place}", "quantity": "velocity", "body": "load", "point": point}
    entry = ChannelEntry.model_validate(text | {"direction": list(case.along)} | case.laser)
    size = np.linalg.norm(motion[0, :3] + np.cross(motion[0, 3:], point))
    noise = case.laser_noise * size / OMEGA
    return Channel(entry, noise, 400.0, ChainUncertainty(), case.scatter, BRIDGE if case.one_clock else ())


def accelerometer(motion: ComplexArray) -> tuple[Channel, ...]:
    """Return the three channels of a triaxial accelerometer."""
    noise = np.full(len(OMEGA), 2e-5 * np.linalg.norm(motion[0, :3]))
    found = []
    for axis, letter in enumerate("xyz"):
        text = {"name": f"a{letter}", "quantity": "acceleration", "body": "load", "direction": np.eye(3)[axis].tolist()}
        found.append(Channel(ChannelEntry.model_validate(text | ACCELEROMETER), noise, 400.0, ChainUncertainty()))
    return tuple(found)


def stereo_pair(motion: ComplexArray) -> Pair:
    """Return a stereo pair whose calibration has three uncertain directions and whose trigger is uncertain."""
    entry = Stereo.model_validate(
        {
            "body": "load", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.3], "exposure": 4e-5,
            "scale_uncertainty": 2e-4, "pose_uncertainty": [1e-4] * 3 + [5e-4] * 3, "delay_uncertainty": 1e-6,
        }
    )  # fmt: skip
    rng = np.random.default_rng(6)
    spread = np.tile(np.array([8e-9, 8e-9, 2.5e-8, 3e-7, 3e-7, 1.2e-7]), 2)
    mixing = np.eye(12) + 0.15 * rng.standard_normal((12, 12))
    root = spread[:, None] * mixing
    covariance = np.repeat((root @ root.T)[None], len(OMEGA), axis=0)
    displacement = -motion / OMEGA[:, None] ** 2
    relative = 1e-4 * rng.standard_normal((3, 6, 6)) * np.outer([1, 1, 1, 5, 5, 5], [1, 1, 1, 0.1, 0.1, 0.1])
    effects = {"calibration": np.einsum("pij,kj->pki", relative, displacement)}
    phasors = Phasors(
        LINES.frequency_hz, displacement, covariance, MOTION_COMPONENTS, component_units(0), np.full(len(OMEGA), 40.0)
    )
    trigger = delay_errors("camera_trigger: time", LINES.frequency_hz, 2e-7)
    return Pair(StereoReading("top", entry, phasors, effects, 1e-6, trigger), 40.0)


def output_channels(motion: ComplexArray, case: Case) -> tuple[Channel, ...]:
    """Return the six outputs, recorded by one amplifier on a clock of its own."""
    chain = ChainUncertainty(np.full(len(OMEGA), 1e-4), np.full(len(OMEGA), 2e-4))
    signal = 2e-7 * 7.7 * case.size if case.driven < 3 else 9.1e-6 * 0.09 * case.size
    noise = np.full(len(OMEGA), 1e-5 * signal)
    found = []
    for name in SENSOR.channels:
        text = {"name": name, "quantity": "output", "channel": name, "common": "amplifier"}
        stated = {"scale_uncertainty": 1e-4, "individual_uncertainty": 5e-5, "delay_uncertainty": 2e-7}
        found.append(Channel(ChannelEntry.model_validate(text | stated), noise, 300.0, chain, clock=BRIDGE))
    return tuple(found)


def case_setup(case: Case) -> PhasorSetup:
    """Return what is stated of a case and what is really there."""
    motion = true_acceleration(case)
    talk = np.random.default_rng(7).uniform(-0.01, 0.01, (6, 6))
    np.fill_diagonal(talk, 1.0)
    static = talk * (GAINS * np.array(CAPACITY))[:, None] / np.array(CAPACITY)
    lasers = tuple(laser_channel(case, place, motion) for place in range(len(case.points)))
    return PhasorSetup(
        lines=LINES,
        acceleration=motion,
        pairs=() if case.lasers_only else (stereo_pair(motion),),
        channels=lasers if case.lasers_only else (*lasers, *accelerometer(motion)),
        outputs=output_channels(motion, case),
        sensitivity=static / (1.0 + 1j * OMEGA[:, None, None] * 2e-5),
        parts=case.parts,
        gravity_mps2=GRAVITY,
        sensor=SENSOR,
        direction=case.direction,
        clock_uncertainty=0.0 if case.lasers_only else 1e-6,
    )
