"""Simulated campaigns of sines: sweep, matrix, repeated drives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion.simulate.preset import (
    NITSCHE2018,
    TRIGGER,
    ChannelSpec,
    DaqSpec,
    PartSpec,
    Preset,
    accelerometer,
    bridge,
    laser,
)
from fusion.simulate.world import Motion, TruePart, wrench
from shaker.arrays import ComplexArray
from shaker.labels import LOAD_COMPONENTS

# One recording of a simulated campaign: what is driven, how, and what its manifest says.


LEAD_S = 0.1  # of the first frame after the first recorder's start, and of a record's end after the last frame
BRIDGE_START_S = 0.0437


@dataclass(frozen=True)
class Run:
    """One recording: its `preset` (with the whole load), its `mounting`, the name and first lines of its manifest.

    `rig_file`, `rig`: the file of the rig that it stands on, and the set-up written there. `parts`: those of the load
    that this recording's own manifest states. `direction`: 3 or 6 numbers; `driven`: the place of the component that
    is driven.
    """

    name: str
    preset: Preset
    rig: Preset
    rig_file: str
    mounting: str
    kind: str
    direction: tuple[float, ...]
    driven: int
    nominal_hz: tuple[float, ...]
    parts: tuple[PartSpec, ...] = ()


def timed(preset: Preset, camera_rate_hz: float) -> Preset:
    """Return the preset with a camera rate, and records of its one or two recorders that hold all frames."""
    end = LEAD_S + preset.frames / camera_rate_hz + LEAD_S
    starts = (0.0, BRIDGE_START_S)
    daqs: tuple[DaqSpec, ...] = tuple(
        replace(daq, start_s=start, duration_s=end - start) for daq, start in zip(preset.daqs, starts, strict=False)
    )
    return replace(preset, camera_rate_hz=camera_rate_hz, first_frame_s=LEAD_S, daqs=daqs)


def triaxial(point: tuple[float, float, float]) -> tuple[ChannelSpec, ...]:
    """Return the three channels of an accelerometer on the load, each axis calibrated on its own."""
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    return tuple(accelerometer(f"acceleration_{name}", "load", point, axis) for name, axis in axes.items())


def wrench_direction(parts: tuple[PartSpec, ...], translation: tuple[float, float, float]) -> tuple[float, ...]:
    """Return the six load components that a unit acceleration of rigid parts needs, as they are stated: N and N·m."""
    amplitude = np.array([[*translation, 0.0, 0.0, 0.0]], dtype=np.complex128)
    rigid = [TruePart(p.mass, np.array(p.centre_of_mass), np.diag(p.inertia)) for p in parts]
    total = wrench(Motion(np.array([1.0]), amplitude), rigid, np.zeros(3))[0].real
    return tuple(round(float(component), 4) + 0.0 for component in total)


def as_phasors(values: ComplexArray) -> tuple[tuple[complex, ...], ...]:
    """Return phasors (K, 6) in the form of a preset."""
    return tuple(tuple(complex(v) for v in row) for row in values)


# The campaign of the published sensitivity curve: twelve frequencies, two mountings, two recordings of each.


STEP_HZ = 53.7
STEPS = (1, 2, 3, 5, 7, 9, 11, 13, 14, 15, 17, 19)
"""All frequencies are multiples of 53.7 Hz; the publication names the 1st, the 7th (rocking) and the 19th."""
MOUNTINGS = ("1", "2")
REPEATS = 2
ROCKING_HZ = 7 * STEP_HZ
_ROCKING_DAMPING = 0.03
_ROCKING_PER_M = ((0.022, 2.1), (0.034, -0.4))  # angular over linear acceleration far below resonance, about x and y
_DRIVE_MPS2 = 60.0
_FREQUENCY_ERROR = 2.4e-6
RECORDERS_HZ = (25600.0, 20000.0)
_BEATS = (0.27, 0.33)  # cycles that a line may advance from frame to frame beyond whole ones
_FRAMES = 48
_TOP_M = 0.0973
_RADII_M = (0.022, 0.048)


def runs() -> tuple[Run, ...]:
    """Return the recordings, frequency by frequency."""
    return tuple(
        _run(step, mounting, repeat) for step in STEPS for mounting in MOUNTINGS for repeat in range(1, REPEATS + 1)
    )


def laser_points() -> tuple[tuple[float, float, float], ...]:
    """Return eight points on the top of the load, four on either of two circles."""
    angle = np.deg2rad([0, 90, 180, 270, 45, 135, 225, 315])
    radius = np.repeat(_RADII_M, 4)
    place = np.round(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), 5) + 0.0
    return tuple((float(x), float(y), _TOP_M) for x, y in place)


def _rig() -> Preset:
    """Return the published set-up with the load's centre of mass at the sensor origin and the chain's lag of 50 µs."""
    lasers = tuple(laser(f"velocity_{n}", point, 0.125) for n, point in enumerate(laser_points(), 1))
    recorder = DaqSpec(
        "vibrometer",
        "vibrometer.h5",
        RECORDERS_HZ[0],
        1e-6,
        0.0,
        1.2,
        (*lasers, *triaxial((0.020, -0.030, 0.0973)), TRIGGER),
    )
    amplifier = DaqSpec(
        "bridge", "bridge.h5", RECORDERS_HZ[1], 1e-6, 0.0, 1.2, (*bridge(LOAD_COMPONENTS, 2e-5), TRIGGER)
    )
    return replace(
        NITSCHE2018,
        name="sweep",
        load=replace(NITSCHE2018.load, centre_of_mass=(0.0, 0.0, 0.0)),
        damping_s=(4e-6, 4e-6, 1.6e-6, 6e-6, 6e-6, 8e-6),
        lag_s=50e-6,
        frames=_FRAMES,
        stereo=(),
        points=NITSCHE2018.stereo,
        daqs=(recorder, amplifier),
    )


def _run(step: int, mounting: str, repeat: int) -> Run:
    """Return one recording."""
    rig = _rig()
    nominal = round(step * STEP_HZ, 1)
    name = f"Fz-{nominal:06.1f}-{mounting}{'ab'[repeat - 1]}"
    preset = replace(
        rig,
        recording=name,
        fundamental_hz=nominal * (1 + _FREQUENCY_ERROR),
        multiples=(1, 2),
        acceleration=as_phasors(_motion(nominal, (step, int(mounting), repeat))),
    )
    preset = timed(preset, camera_rate(nominal))
    title = f"Fz {nominal:g} Hz, mounting {mounting}, recording {repeat}, simulated"
    return Run(title, preset, rig, "rig.toml", mounting, "sine", (0.0, 0.0, 1.0), 2, (nominal,))


def camera_rate(frequency_hz: float) -> float:
    """Return a camera rate near 53 Hz that beats with a line and is no simple fraction of the recorders' rates.

    Of rates that let the line advance by about 0.3 cycles from frame to frame it is the one whose edges leave the
    smallest gaps between their places in the sampling intervals: the gap is what the trigger's instant stays open to.
    """
    rates = frequency_hz / (np.floor(frequency_hz / 53.0) + np.linspace(*_BEATS, 61))
    return float(min(rates, key=lambda rate: max(_gap_s(float(rate), sampling) for sampling in RECORDERS_HZ)))


def _gap_s(rate_hz: float, sampling_hz: float) -> float:
    """Return the largest gap (s) between the places of all edges in the sampling intervals of a recorder."""
    place = np.sort(np.arange(_FRAMES) * sampling_hz / rate_hz % 1.0)
    return float(np.max(np.diff(np.append(place, place[0] + 1.0))) / sampling_hz)


def _motion(frequency_hz: float, place: tuple[int, int, int]) -> ComplexArray:
    """Return the load's acceleration (2, 6) at the driven line and its second harmonic.

    The body rocks as an oscillator at 375.9 Hz that the axial motion drives: α = a·c/(1 − η² + 2jζη). Every recording
    starts at another moment and is driven within 1 % of the same amplitude.
    """
    rng = np.random.default_rng(place)
    turn = np.exp(2j * np.pi * rng.uniform(size=2))
    driven = _DRIVE_MPS2 * (1 + 0.01 * rng.uniform(-1, 1)) * np.array([1.0, 0.004]) * turn
    ratio = frequency_hz * np.array([1.0, 2.0]) / ROCKING_HZ
    resonance = 1 / (1 - ratio**2 + 2j * _ROCKING_DAMPING * ratio)
    motion = np.zeros((2, 6), dtype=np.complex128)
    motion[:, 2] = driven
    for axis, (size, phase) in enumerate(_ROCKING_PER_M, 3):
        motion[:, axis] = driven * resonance * size * np.exp(1j * phase)
    side = np.array([0.004, 0.003, 0.02])  # x, y, and the turn about z in rad/m
    motion[:, [0, 1, 5]] = driven[:, None] * side * np.exp(1j * np.array([0.7, -1.9, 2.4]))
    return motion


# The campaign that determines all 36 sensitivities: axial, transverse and with a mass on an arm of the beam cross.


MULTIPLES = (8, 17, 31)
_FUNDAMENTAL_HZ = 10.00002  # the generator's 10 Hz
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


def cross_talk_runs() -> tuple[Run, ...]:
    """Return the eight recordings, every one mounted anew."""
    return tuple(_cross_talk_run(number, axis, arm) for number, (axis, arm) in enumerate(SETUPS, 1))


def _cross_talk_rig(axis: str) -> Preset:
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
    channels: tuple[ChannelSpec, ...] = (*lasers, *triaxial((0.020, -0.030, 0.060)), *bridge(LOAD_COMPONENTS, 2e-5))
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


def _cross_talk_run(number: int, axis: str, arm: str) -> Run:
    """Return one recording."""
    rig, place = _cross_talk_rig(axis), "xyz".index(axis)
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
        acceleration=as_phasors(_cross_talk_motion(number, place)),
    )
    title = f"shaker along {axis}" + (f", mass at {arm}" if arm else "") + ", simulated"
    nominal = tuple(10.0 * multiple for multiple in MULTIPLES)
    file = f"rig-{axis}.toml"
    preset = timed(preset, 52.874)
    return Run(title, preset, rig, file, name, "multisine", direction, int(np.argmax(share)), nominal, parts)


def _arm_mass(arm: str) -> PartSpec:
    """Return the moment mass on one arm of the cross: one and the same cylinder, wherever it is clamped."""
    return PartSpec("moment mass", 2.047, 2e-4, _ARMS[arm], 1e-4, (2.1e-3, 2.1e-3, 1.6e-3), 2e-5)


def _cross_talk_motion(number: int, driven: int) -> ComplexArray:
    """Return the load's acceleration (K, 6): one translation driven, the others 1 to 2 % of it, phases at random."""
    rng = np.random.default_rng([6, number])
    size = _SIDE * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    size[driven] = 1.0
    amplitude = _DRIVE_MPS2 * size * rng.uniform(0.5, 1.0, (len(MULTIPLES), 6))
    amplitude[:, driven] = _DRIVE_MPS2
    return np.asarray(amplitude * np.exp(2j * np.pi * rng.uniform(size=amplitude.shape)))
