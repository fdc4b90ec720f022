"""The true campaign behind the manifests: nominal set-up plus drawn errors, its motion, load and outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.simulate.draws import Draws
from fusion.simulate.mechanics import ComplexArray, Motion, TruePart, base_motion, sensitivity, wrench
from fusion.simulate.preset import PartSpec, Preset
from fusion.simulate.scenery import StereoSetup, nominal_rig
from photogram.camera import StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector
from shaker._checks import FloatArray

STATIC_UNCERTAINTY = 1e-3
"""Relative change of a sensor since its static calibration, one standard deviation."""


@dataclass(frozen=True, eq=False)
class TrueStereo:
    """A stereo pair as stated (`nominal`, `sensor_from_left`) and as it is (`rig`, `left_from_sensor`, delay)."""

    setup: StereoSetup
    nominal: StereoRig
    sensor_from_left: RigidTransform
    rig: StereoRig
    left_from_sensor: RigidTransform
    delay_s: float


@dataclass(frozen=True, eq=False)
class World:
    """The truth: motions of both bodies, wrench on the load (K, 6), sensitivity (K, C, 6), outputs (K, C).

    `load_wrench` has the sense of the manifest. `trigger_s` (F,): instants of the trigger edges, with their jitter.
    Times are true seconds since the first sample of the first DAQ.
    """

    preset: Preset
    gravity: FloatArray
    motion: dict[str, Motion]
    load_wrench: ComplexArray
    sensitivity: ComplexArray
    static_stated: FloatArray
    outputs: ComplexArray
    trigger_s: FloatArray
    stereo: tuple[TrueStereo, ...]


def make_world(preset: Preset, draws: Draws, jitter_s: float) -> World:
    """Return the truth of a preset with errors drawn."""
    gravity = preset.gravity_mps2
    frequency = preset.frequencies_hz
    load = Motion(frequency, np.array(preset.acceleration))
    base = base_motion(load, np.array(preset.mount_hz), preset.mount_damping)
    parts = [true_part(spec, draws) for spec in (preset.load, preset.internal, *preset.parts)]
    sign = 1.0 if preset.sense == "on_load" else -1.0
    force = sign * wrench(load, parts, gravity)
    stated, true = static_sensitivity(preset, draws)
    matrix = sensitivity(frequency, true, np.array(preset.damping_s), preset.lag_s)
    outputs = np.einsum("kcj,kj->kc", matrix, force)
    edges = preset.first_frame_s + np.arange(preset.frames) / preset.camera_rate_hz
    edges = edges + jitter_s * draws.stream("trigger jitter").standard_normal(preset.frames)
    stereo = tuple(true_stereo(setup, draws) for setup in preset.stereo)
    motion = {"load": load, "base": base}
    return World(preset, gravity, motion, force, matrix, stated, outputs, edges, stereo)


def true_part(spec: PartSpec, draws: Draws) -> TruePart:
    """Return a part with errors of mass, centre of mass and inertia."""
    name = f"{spec.name}.mass"
    mass = spec.mass + float(draws.normal(name, spec.mass_uncertainty))
    centre = draws.normal(f"{spec.name}.centre_of_mass", spec.centre_of_mass_uncertainty, 3)
    six = draws.normal(f"{spec.name}.inertia", spec.inertia_uncertainty, 6)
    error = np.array([[six[0], six[3], six[4]], [six[3], six[1], six[5]], [six[4], six[5], six[2]]])
    return TruePart(mass, np.array(spec.centre_of_mass) + centre, np.diag(spec.inertia) + error)


def static_sensitivity(preset: Preset, draws: Draws) -> tuple[FloatArray, FloatArray]:
    """Return the static sensitivity (6, 6) of an earlier calibration, and today's, 0.1 % of its diagonal away.

    Cross-talk is stated relative to the rated loads: output i for component j is up to `cross_talk` of its rated
    output at the rated load j.
    """
    rated = np.array(preset.sensitivity) * np.array(preset.capacity)
    share = np.random.default_rng(6).uniform(-preset.cross_talk, preset.cross_talk, (6, 6))
    np.fill_diagonal(share, 1.0)
    stated = share * rated[:, None] / np.array(preset.capacity)
    change = draws.normal("static_sensitivity", STATIC_UNCERTAINTY, 36).reshape(6, 6) * np.diagonal(share)[:, None]
    return stated, stated * (1 + change)


def true_stereo(setup: StereoSetup, draws: Draws) -> TrueStereo:
    """Return a stereo pair whose cameras, scale, pose and delay differ from what its files state.

    The true baseline is longer by the relative scale error. The stated pose was found with the stated rig: the
    sensor origin's place in the camera frame grows by the same factor, then the pose error moves it and turns the
    frame about it.
    """
    nominal, sensor_from_left = nominal_rig(setup)
    covariance = nominal.covariance
    assert covariance is not None
    rig = nominal.perturbed(draws.covariant(f"{setup.name}.calibration", covariance))
    scale = 1 + float(draws.normal(f"{setup.name}.scale", setup.scale_uncertainty))
    between = rig.right_from_left
    rig = StereoRig(rig.left, rig.right, RigidTransform(between.rotation, between.translation_m * scale))
    true = true_pose(setup, sensor_from_left, scale, draws)
    delay = float(draws.normal(f"{setup.name}.delay", setup.delay_uncertainty))
    return TrueStereo(setup, nominal, sensor_from_left, rig, true.inverse(), delay)


def true_pose(setup: StereoSetup, stated: RigidTransform, scale: float, draws: Draws) -> RigidTransform:
    """Return sensor_from_left as it is, where lengths are `scale` times those that the stated pose was found with."""
    error = draws.normal(f"{setup.name}.pose", np.array(setup.pose_uncertainty), 6)
    turn = rotation_from_vector(error[3:])
    return RigidTransform(turn @ stated.rotation, turn @ (stated.translation_m * scale) + error[:3])
