"""Records of less than one beat: what clocks, triggers and lines leave open, through the fit that was made.

Poses and edges are simulated directly; the trigger is fitted to its edges between samples of 39 us, so the drawn error of
its rate is that of the fit.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from instrument_factory import stereo_entry

from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import Contribution, Uncertainty, polar, real_stack
from fusion.phasors.stereo_motion import StereoMotion
from fusion.phasors.stereo_phasors import StereoPhasors, stereo_phasors
from fusion.phasors.timing import Lateness, TimeBase, see, together
from photogram.motion import Deformation, RigidMotion
from shaker.arrays import FloatArray
from shaker.lines.frequencies import Lines, find_lines
from shaker.sine.fit import fit_sines
from shaker.sine.solve import SineModel
from shaker.timebase.edges import Edges
from shaker.timebase.tie import tie_clocks
from shaker.timebase.trigger import TriggerFit, fit_trigger

LINE_HZ, CAMERA_HZ, DAQ_HZ = 106.25, 52.874, 25_600.0
BEAT_HZ = LINE_HZ - 2.0 * CAMERA_HZ
SIZE = np.array([3e-7, 1e-7, 2e-6, 2e-8, 1e-8, 5e-9])  # turned so little that axes at rest and moved are the same
NOISE = 2e-4 * SIZE[[2, 2, 2, 3, 3, 3]]
EXPOSURE_S = 4e-5


def latched(instants: FloatArray, rate_hz: float) -> TriggerFit:
    """What a digital input makes of edges."""
    upper = np.ceil(instants * rate_hz) / rate_hz
    length_s = float(upper[-1]) + 0.1
    return fit_trigger(Edges(upper - 1.0 / rate_hz, upper, upper - 0.5 / rate_hz, "sampled", 0.0, length_s, 0.5))


def time_base(triggers: dict[tuple[str, str], TriggerFit]) -> TimeBase:
    names = dict.fromkeys(daq for daq, _ in triggers)
    first = next(iter(names))
    ties = {n: None if n == first else tie_clocks(triggers[first, "camera"], triggers[n, "camera"], 0) for n in names}
    records = tuple(SimpleNamespace(entry=SimpleNamespace(name=name, clock_uncertainty=0.0)) for name in names)
    return TimeBase(records, triggers, ties)


def known_lines(frequency_hz: float, u_hz: float) -> Lines:
    """A fundamental and its harmonic, known to `u_hz`."""
    order = np.array([1, 2])
    return Lines(frequency_hz * order, u_hz * order, np.full(2, LINE_HZ), order, ("", ""), ())


def seen_pair(base: TimeBase, poses: FloatArray) -> StereoMotion:
    """A pair that measured these poses (F, 6), the first one its reference."""
    pair = stereo_entry(exposure=EXPOSURE_S)
    pair.model_copy = lambda update: stereo_entry(**update)
    entry = SimpleNamespace(
        stereo="top", trigger="camera", first_edge=0, exposure=EXPOSURE_S, delay=0.0, delay_uncertainty=0.0
    )
    manifest = SimpleNamespace(rig=SimpleNamespace(stereo={"top": pair}), path=Path("recording.toml"))
    sight = see(manifest, base, entry, len(poses))
    frames = len(poses)
    nothing = np.zeros((frames, 1, 3))
    motion = RigidMotion(poses - poses[0], np.tile(np.eye(6), (frames, 1, 1)), np.zeros(frames), np.ones(frames), np.zeros(3))
    return StereoMotion(sight, motion, Deformation(nothing[0], nothing, np.zeros((frames, 1, 3, 3))), 0.0, None, ())


def recorded(truth: np.ndarray, instants: FloatArray, rng: np.random.Generator, noise: FloatArray = NOISE) -> FloatArray:
    """Poses (F, 6) of a motion with phasors (K, 6) at multiples of the line, exposed from these instants on."""
    omega = 2.0 * np.pi * LINE_HZ * np.arange(1, len(truth) + 1)
    middle = np.exp(1j * np.multiply.outer(instants + EXPOSURE_S / 2.0, omega)) * np.sinc(omega * EXPOSURE_S / 2 / np.pi)
    return (middle @ truth).real + noise * rng.normal(size=(len(instants), 6))


def drawn_pair(beats: float, rng: np.random.Generator, noise: float = 1.0) -> tuple[StereoPhasors, np.ndarray]:
    """A record of so many beats with an error of its trigger's fit and of its line, and the true phasors (2, 6)."""
    frames, u_hz = round(beats * CAMERA_HZ / BEAT_HZ), 2e-5
    instants = rng.uniform(0.05, 0.4) + np.arange(frames) / (CAMERA_HZ * (1.0 + 1e-6 * rng.normal()))
    truth = SIZE * np.exp(2j * np.pi * rng.uniform(size=6)) * np.array([[1.0], [0.0]])
    base = time_base({("daq", "camera"): latched(instants, DAQ_HZ)})
    lines = known_lines(LINE_HZ + u_hz * rng.normal(), u_hz)
    measured = seen_pair(base, recorded(truth, instants, rng, noise * NOISE))
    return stereo_phasors(base, measured, lines, base.line_errors(lines, ())), truth


def covered(seen: StereoPhasors, truth: np.ndarray) -> list[tuple[bool, bool]]:
    """Whether magnitude and phase of the fundamental's six components lie within U, the noise's dof its own."""
    reading = seen.reading
    value, observation = reading.phasors.value, reading.observed()
    motion = value / observation.design[:, :, :].diagonal(axis1=1, axis2=2)
    usable = np.isfinite(value).all(axis=1)
    noise = Contribution("noise", "A", reading.phasors.covariance[usable], reading.phasors.dof[usable])
    effects = [error.effect(np.nan_to_num(motion))[usable] for error in observation.common]
    covariance = noise.covariance + sum(np.einsum("ki,kj->kij", real_stack(e), real_stack(e)) for e in effects)
    total = Uncertainty((noise, Contribution("clock", "B", covariance - noise.covariance)))
    held = []
    for c in range(6):
        pair = np.ix_([c, c + 6], [c, c + 6])
        found = polar(complex(value[0, c]), covariance[0][pair], float(total.dof()[0, c]))
        turned = float(np.angle(value[0, c] / truth[0, c]))
        off = found.magnitude - abs(truth[0, c])
        held.append((abs(off) <= found.expanded_magnitude, abs(turned) <= found.expanded_phase_rad))
    return held
