"""The campaign of the published sensitivity curve: twelve frequencies, two mountings, two recordings of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.simulate.mechanics import ComplexArray
from fusion.simulate.preset import NITSCHE2018, OUTPUTS, TRIGGER, DaqSpec, Preset, bridge, laser
from fusion.simulate.runs import Run, as_phasors, timed, triaxial

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
    amplifier = DaqSpec("bridge", "bridge.h5", RECORDERS_HZ[1], 1e-6, 0.0, 1.2, (*bridge(OUTPUTS, 2e-5), TRIGGER))
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
