"""A plate on the load that bends, for motion, load and images of the simulator.

The plate is a disc of uniform mass m about the axis z of the sensor, with the shape s(ρ) = ρ²·(1.4 − 0.4·ρ²) over the
radius ρ = r/R. Its rim moves by q relative to its centre, m·⟨s²⟩·(q̈ + 2ζω₀·q̇ + ω₀²·q) = −m·⟨s⟩·a, and the foot
carries m·⟨s⟩·q̈ in addition to the rigid load. Means over the disc are sums over rings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.simulate.preset import PlateSpec, Preset
from photogram.synthetic.scene import Face, View, bend_view
from shakercal._common.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from fusion.simulate.world import Draws, SimulatedMotion, World

SURFACE_FILE = "plate-mode-1.csv"
RINGS, SPOKES = 12, 24  # of the surface's table
SUM = (np.arange(20000) + 0.5) / 20000


def shape(rho: FloatArray) -> FloatArray:
    """Return the displacement over that of the rim, at radii over that of the rim."""
    return np.asarray(rho**2 * (1.4 - 0.4 * rho**2))


MEAN, MEAN_SQUARE = (float(np.sum(shape(SUM) ** power * SUM) / np.sum(SUM)) for power in (1, 2))


def _at(plate: PlateSpec, point: Sequence[float] | FloatArray) -> float:
    return float(shape(np.hypot(point[0], point[1]) / plate.radius))


def rim_acceleration(plate: PlateSpec, motion: SimulatedMotion, draws: Draws) -> ComplexArray:
    """Return the acceleration phasors (K,) of the rim relative to the centre.

    The natural frequency has its sampled error.
    """
    natural = (
        2.0 * np.pi * plate.frequency * (1.0 + float(draws.normal("plate.frequency", plate.frequency_uncertainty)))
    )
    omega = motion.omega
    denominator = natural**2 - omega**2 + 2j * plate.damping * natural * omega
    return np.asarray(omega**2 * MEAN / MEAN_SQUARE * motion.acceleration[:, 2] / denominator)


def plate_motion(plate: PlateSpec, motion: SimulatedMotion, draws: Draws, point: FloatArray) -> SimulatedMotion:
    """Return the apparent motion of the load at a point of the plate."""
    moved = motion.acceleration.copy()
    moved[:, 2] += _at(plate, point) * rim_acceleration(plate, motion, draws)
    return replace(motion, acceleration=moved)


def plate_wrench(plate: PlateSpec, motion: SimulatedMotion, draws: Draws) -> ComplexArray:
    """Return the wrench (K, 6) of the plate in addition to the rigid load."""
    total = np.zeros((len(motion.frequency_hz), 6), np.complex128)
    total[:, 2] = plate.mass * MEAN * rim_acceleration(plate, motion, draws)
    return total


def bent_view(world: World, draws: Draws, view: View, face: Face, instant: tuple[float | FloatArray, float]) -> View:
    """Return a view of the bending face of the load, averaged over an exposure.

    instant: middle of the exposure, (H,) for rows, and its length, s.
    """
    plate, motion, (middle_s, exposure_s) = world.preset.plate, world.motion["load"], instant
    if plate is None:
        return view
    omega = motion.omega
    lost = np.sinc(omega * exposure_s / (2.0 * np.pi))
    turn = np.exp(1j * np.multiply.outer(middle_s, omega))
    rim_m = np.sum(-rim_acceleration(plate, motion, draws) / omega**2 * lost * turn, axis=-1).real[..., None]

    def bending(u: FloatArray, v: FloatArray) -> FloatArray:
        position = face.origin_m + u[..., None] * face.axis_u + v[..., None] * face.axis_v
        up = rim_m * shape(np.hypot(position[..., 0], position[..., 1]) / plate.radius)
        none = np.zeros_like(up)
        return np.stack([none, none, up * np.cross(face.axis_u, face.axis_v)[2]], axis=-1)

    return bend_view(view, face, motion.pose(float(np.mean(middle_s))), bending)


def elastic_keys(preset: Preset) -> dict[str, Any]:
    """Return the keys of the plate in the load's table, none without a plate."""
    plate = preset.plate
    if plate is None:
        return {}
    points = {spec.name: spec.point for daq in preset.daqs for spec in daq.channels if spec.body == "load"}
    points |= {setup.name: setup.face_centre for setup in preset.stereo if setup.body == "load"}
    mode = {
        "frequency": plate.frequency,
        "frequency_uncertainty": plate.frequency * plate.frequency_uncertainty,
        "participation": [0.0, 0.0, plate.mass * MEAN, 0.0, 0.0, 0.0],
        "modal_mass": plate.mass * MEAN_SQUARE,
        "displacement": {name: [0.0, 0.0, _at(plate, point)] for name, point in points.items()},
        "surface": SURFACE_FILE,
    }
    measured = {"measured_by": list(plate.measured_by)} if plate.measured_by else {}
    return {"elastic": [{"name": "plate", "shape": "modes", "damping": plate.damping, **measured, "mode": [mode]}]}


def surface_files(preset: Preset) -> dict[str, str]:
    """Return the file of the mode on the top face, if there is a plate."""
    plate = preset.plate
    if plate is None:
        return {}
    height_m = max(setup.face_centre[2] for setup in preset.stereo if setup.body == "load")
    rho, angle = (
        np.linspace(1.0, 0.0, RINGS, endpoint=False)[:, None],
        np.linspace(0.0, 2.0 * np.pi, SPOKES, endpoint=False),
    )
    x, y = (plate.radius * rho * turn for turn in (np.cos(angle), np.sin(angle)))
    up = np.broadcast_to(shape(rho), x.shape)
    rows = np.stack([x, y, np.full_like(x, height_m), 0.0 * x, 0.0 * x, up], axis=-1).reshape(-1, 6).tolist()
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return {SURFACE_FILE: "\n".join(["x,y,z,ux,uy,uz", *lines]) + "\n"}
