"""The campaign that determines all 36 sensitivities: axial, transverse and with a mass on an arm of the beam cross."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.simulate.mechanics import ComplexArray
from fusion.simulate.preset import NITSCHE2018, OUTPUTS, ChannelSpec, DaqSpec, PartSpec, Preset, bridge, laser
from fusion.simulate.runs import Run, as_phasors, timed, triaxial, wrench_direction

MULTIPLES = (8, 17, 31)
_FUNDAMENTAL_HZ = 10.00002  # the generator's 10 Hz
_DRIVE_MPS2 = 60.0
_SIDE = 0.02  # motion in other components over the driven one (rotations: over 0.1 m)
_ARM_M = 0.2
_CROSS = PartSpec("beam cross", 1.284, 2e-4, (0.0, 0.0, 0.0), 1e-4, (6.9e-3, 6.9e-3, 0.0136), 2e-5)
_ARMS = {"+x": (_ARM_M, 0.0, 0.0), "-x": (-_ARM_M, 0.0, 0.0), "+y": (0.0, _ARM_M, 0.0)}
SETUPS: tuple[tuple[str, str], ...] = (
    ("z", ""),
    ("z", "+x"),
    ("z", "-x"),
    ("z", "+y"),
    ("x", ""),
    ("x", "+y"),
    ("y", ""),
    ("y", "+x"),
)
"""Axis along the shaker, and the arm that carries the mass ("": the load alone)."""


def runs() -> tuple[Run, ...]:
    """Return the eight recordings, every one mounted anew."""
    return tuple(_run(number, axis, arm) for number, (axis, arm) in enumerate(SETUPS, 1))


def _rig(axis: str) -> Preset:
    """Return the published set-up, the sensor's `axis` upwards, with three points seen from three directions each.

    One recorder takes all channels: what two clocks leave open of the time would be the largest error of cross-talk.
    """
    up = np.eye(3)["xyz".index(axis)]
    points = ((0.045, 0.0, 0.060), (-0.0225, 0.039, 0.060), (-0.0225, -0.039, 0.020))
    lasers = tuple(
        replace(laser(f"velocity_{n}{name}", point, 0.125), direction=direction)
        for n, point in enumerate(points, 1)
        for name, direction in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0)))
    )
    channels: tuple[ChannelSpec, ...] = (*lasers, *triaxial((0.020, -0.030, 0.060)), *bridge(OUTPUTS, 2e-5))
    recorder = DaqSpec("recorder", "channels.h5", 25600.0, 1e-6, 0.0, 1.2, channels)
    down = tuple(float(v) + 0.0 for v in -up)
    return replace(
        NITSCHE2018,
        name="matrix",
        rig_name=f"{NITSCHE2018.rig_name}, {axis} upwards",
        load=replace(NITSCHE2018.load, centre_of_mass=(0.0, 0.0, 0.0)),
        cross_talk=0.02,
        frames=48,
        stereo=(),
        daqs=(recorder,),
        down=(down[0], down[1], down[2]),
    )


def _run(number: int, axis: str, arm: str) -> Run:
    """Return one recording."""
    rig, place = _rig(axis), "xyz".index(axis)
    parts = (_CROSS, _arm_mass(arm)) if arm else ()
    unit = [0.0, 0.0, 0.0]
    unit[place] = 1.0
    translation = (unit[0], unit[1], unit[2])
    direction = wrench_direction((rig.load, rig.internal, *parts), translation) if arm else translation
    share = np.abs(direction) / np.array(rig.capacity[: len(direction)])
    name = f"{number}-{axis}" + (f"-mass-{arm}" if arm else "")
    preset = replace(
        rig,
        recording=name,
        parts=parts,
        fundamental_hz=_FUNDAMENTAL_HZ,
        multiples=MULTIPLES,
        acceleration=as_phasors(_motion(number, place)),
    )
    title = f"shaker along {axis}" + (f", mass at {arm}" if arm else "") + ", simulated"
    nominal = tuple(10.0 * multiple for multiple in MULTIPLES)
    file = f"rig-{axis}.toml"
    preset = timed(preset, 52.874)
    return Run(title, preset, rig, file, name, "multisine", direction, int(np.argmax(share)), nominal, parts)


def _arm_mass(arm: str) -> PartSpec:
    """Return the moment mass on one arm of the cross: one and the same cylinder, wherever it is clamped."""
    return PartSpec("moment mass", 2.047, 2e-4, _ARMS[arm], 1e-4, (2.1e-3, 2.1e-3, 1.6e-3), 2e-5)


def _motion(number: int, driven: int) -> ComplexArray:
    """Return the load's acceleration (K, 6): one translation driven, the others 1 to 2 % of it, phases at random."""
    rng = np.random.default_rng([6, number])
    size = _SIDE * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    size[driven] = 1.0
    amplitude = _DRIVE_MPS2 * size * rng.uniform(0.5, 1.0, (len(MULTIPLES), 6))
    amplitude[:, driven] = _DRIVE_MPS2
    return np.asarray(amplitude * np.exp(2j * np.pi * rng.uniform(size=amplitude.shape)))
