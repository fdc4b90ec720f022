"""Set-ups at the level of phasors: a stereo pair, lasers, an accelerometer and six outputs, driven in several ways."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fusion.body import Part, make_part
from fusion.manifest import ChannelEntry, Sensor, Stereo
from fusion.observe import ChainUncertainty, StereoReading
from fusion.simulate.phasors import Channel, Pair, PhasorSetup, lines_at
from shaker._checks import ComplexArray
from shaker.signals.phasor import Phasors

LINES = lines_at([106.25, 212.5], [1, 2])
OMEGA = 2.0 * np.pi * LINES.frequency_hz
CAPACITY = (2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0)
GAINS = np.array([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
SENSOR = Sensor(
    name="six components",
    channels=("Fx", "Fy", "Fz", "Mx", "My", "Mz"),
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
    make_part("load", 6.9605, (0.0, 0.0, 0.0507), np.diag([0.0103, 0.0103, 0.0105]), (1e-3, 1e-4, 2e-5)),
    make_part("internal mass", 0.769, (0.0, 0.0, 0.002), np.diag([7e-4, 7e-4, 1.2e-3]), (2e-3, 2e-4, 1e-5)),
)
CROSS_BEAM = (
    make_part("beam", 2.4, (0.0, 0.0, 0.025), np.diag([0.002, 0.021, 0.022]), (5e-4, 1e-4, 4e-5)),
    make_part("mass at +x", 1.204, (0.162, 0.001, 0.04), np.diag([4e-4, 4e-4, 3e-4]), (2e-4, 1e-4, 5e-6)),
    make_part("mass at -x", 1.187, (-0.158, 0.0, 0.04), np.diag([4e-4, 4e-4, 3e-4]), (2e-4, 1e-4, 5e-6)),
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
    parts: tuple[Part, ...] = PLAIN_LOAD
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
    clock = ChainUncertainty(clock="bridge", u_clock_s=4e-7) if case.one_clock else ChainUncertainty()
    return Channel(entry, noise, 400.0, clock, case.scatter)


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
    names = ("x", "y", "z", "rx", "ry", "rz")
    units = ("m", "m", "m", "rad", "rad", "rad")
    phasors = Phasors(LINES.frequency_hz, displacement, covariance, names, units, np.full(len(OMEGA), 40.0))
    return Pair(StereoReading("top", entry, phasors, effects, 1e-6, ("camera_trigger", 2e-7)), 40.0)


def output_channels(motion: ComplexArray, case: Case) -> tuple[Channel, ...]:
    """Return the six outputs, recorded by one amplifier on a clock of its own."""
    clock = ChainUncertainty(np.full(len(OMEGA), 1e-4), np.full(len(OMEGA), 2e-4), "bridge", 4e-7)
    signal = 2e-7 * 7.7 * case.size if case.driven < 3 else 9.1e-6 * 0.09 * case.size
    noise = np.full(len(OMEGA), 1e-5 * signal)
    found = []
    for name in SENSOR.channels:
        text = {"name": name, "quantity": "output", "channel": name, "common": "amplifier"}
        stated = {"scale_uncertainty": 1e-4, "individual_uncertainty": 5e-5, "delay_uncertainty": 2e-7}
        found.append(Channel(ChannelEntry.model_validate(text | stated), noise, 300.0, clock))
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
