"""The campaign for stiffness, damping, internal mass: two loads on one axial spring, the output over frequency."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fusion.settings import ProgressCallback
from fusion.simulate.campaign import TRIGGER_JITTER_S, write_run
from fusion.simulate.chirp import Chirp
from fusion.simulate.draws import CampaignDraws
from fusion.simulate.preset import NITSCHE2018, TRIGGER, DaqSpec, PartSpec, Preset, accelerometer, bridge, laser
from fusion.simulate.runs import Run, as_phasors, timed
from fusion.simulate.suspended import Suspension, rig_file, write_chirps, write_truth
from fusion.simulate.sweep import RECORDERS_HZ, STEP_HZ, STEPS, camera_rate
from fusion.simulate.world import make_world, true_part

LAG_S = 50e-6
LOADS = {
    "4kg": PartSpec("load 4 kg", 4.236, 3e-4, (0.0, 0.0, 0.0), 5e-5, (0.0055, 0.0055, 0.0058), 2e-5),
    "9kg": PartSpec("load 9 kg", 8.798, 3e-4, (0.0, 0.0, 0.0), 5e-5, (0.0142, 0.0142, 0.0135), 2e-5),
}
SINE_LOAD = "9kg"
MOUNTING = "1"
_INTERNAL = PartSpec("internal", 0.769, 0.002, (0.0, 0.0, 0.0), 2e-4, (7.0e-4, 7.0e-4, 1.2e-3), 1e-5)
_STIFFNESS, _DAMPING = 4.5e8, 900.0  # N/m, N·s/m: Q of 53 and 73
_DRIVE_MPS2 = 60.0
_FREQUENCY_ERROR = 2.4e-6
_TOP_M = 0.0973
STAND = Suspension(
    sensor=replace(NITSCHE2018, name="masses", rig_name="10 kN shaker"),
    internal=_INTERNAL,
    free=(2,),
    stiffness=(_STIFFNESS,),
    damping=(_DAMPING,),
    loads=LOADS,
    direction=(0.0, 0.0, 1.0),
    base=(0.0, 0.0, -0.05),
    tops={"top_1": (0.03, 0.0, _TOP_M), "top_2": (-0.03, 0.0, _TOP_M)},
    chirp=Chirp(period_s=1.28),
)


def write_masses(folder: Path, seed: int, progress: ProgressCallback) -> None:
    """Write both rigs, a chirp recording of each load, twelve sine recordings of one load, and the truth.

    Everything stated as an uncertainty is drawn, once for the whole campaign. The period of the chirps gives the line
    spacing of the publication, 0.78125 Hz.
    """
    draws = CampaignDraws(seed, True, mounting=MOUNTING)
    write_chirps(folder, STAND, draws)
    for number, step in enumerate(STEPS, 1):
        run = sine_run(step, draws)
        own = replace(draws, recording=run.preset.recording)
        write_run(folder, run, make_world(run.preset, own, TRIGGER_JITTER_S), own, noise=True)
        progress("write", number, len(STEPS))
    others = {"spring_lag_s": _DAMPING / _STIFFNESS, "chain_lag_s": LAG_S, "sine_load": SINE_LOAD}
    write_truth(folder, "masses", STAND, draws, others)


def sine_run(step: int, draws: CampaignDraws) -> Run:
    """Return one sine recording: the load moves along z alone, its base on the true spring below it."""
    nominal = round(step * STEP_HZ, 1)
    rig = _sine_rig(draws)
    preset = replace(
        rig,
        recording=f"Fz-{nominal:06.1f}",
        fundamental_hz=nominal * (1.0 + _FREQUENCY_ERROR),
        multiples=(1, 2),
        acceleration=as_phasors(_motion(step)),
    )
    title = f"Fz {nominal:g} Hz, load mass {rig.load.mass:g} kg, simulated"
    preset = timed(preset, camera_rate(nominal))
    return Run(title, preset, rig, rig_file(SINE_LOAD), MOUNTING, "sine", (0.0, 0.0, 1.0), 2, (nominal,))


def _sine_rig(draws: CampaignDraws) -> Preset:
    """Return the set-up of the sines: three points on the load seen by a vibrometer, a base accelerometer, output Fz.

    Its resonance is that of the true masses, so that its base moves as the chirps say.
    """
    places = ((0.045, 0.0, _TOP_M), (-0.0225, 0.0390, _TOP_M), (-0.0225, -0.0390, _TOP_M))
    lasers = tuple(laser(f"velocity_{n}", place, 0.125) for n, place in enumerate(places, 1))
    motion = (*lasers, accelerometer("base_acceleration", "base", (0.0, 0.0, -0.045)), TRIGGER)
    load, own = true_part(LOADS[SINE_LOAD], draws), true_part(_INTERNAL, draws)
    axial_hz = float(STAND.resonances_hz(load, own)[0])
    return replace(
        STAND.sensor,
        internal=_INTERNAL,
        load=LOADS[SINE_LOAD],
        rig_name=f"{STAND.sensor.rig_name}, {LOADS[SINE_LOAD].name}",
        mount_hz=(*NITSCHE2018.mount_hz[:2], axial_hz, *NITSCHE2018.mount_hz[3:]),
        mount_damping=np.pi * axial_hz * _DAMPING / _STIFFNESS,
        damping_s=(0.0, 0.0, _DAMPING / _STIFFNESS, 0.0, 0.0, 0.0),
        lag_s=LAG_S,
        stereo=(),
        frames=48,
        daqs=(
            DaqSpec("vibrometer", "vibrometer.h5", RECORDERS_HZ[0], 1e-6, 0.0, 1.2, motion),
            DaqSpec("bridge", "bridge.h5", RECORDERS_HZ[1], 1e-6, 0.0, 1.2, (*bridge(("Fz",), 2e-5), TRIGGER)),
        ),
    )


def _motion(step: int) -> np.ndarray:
    """Return the load's acceleration (2, 6): z at the driven line, and 0.4 % of it at twice its frequency."""
    phase = np.random.default_rng([7, step]).uniform(0.0, 2.0 * np.pi, 2)
    motion = np.zeros((2, 6), dtype=np.complex128)
    motion[:, 2] = _DRIVE_MPS2 * np.array([1.0, 0.004]) * np.exp(1j * phase)
    return motion
