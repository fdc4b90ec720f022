"""What really happens: motion of load and base, the load on the sensor, the sensor's answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class TruePart:
    """A rigid part: mass_kg, centre_of_mass_m (3,), inertia_kgm2 (3, 3) about the centre of mass."""

    mass_kg: float
    centre_of_mass_m: FloatArray
    inertia_kgm2: FloatArray


@dataclass(frozen=True, eq=False)
class Motion:
    """Harmonic motion of a body: frequency_hz (K,), acceleration (K, 6) phasors of the origin point, m/s², rad/s²."""

    frequency_hz: FloatArray
    acceleration: ComplexArray

    @property
    def displacement(self) -> ComplexArray:
        """Displacement phasors (K, 6), m and rad: −A/ω²."""
        return -self.acceleration / self.omega[:, None] ** 2

    @property
    def omega(self) -> FloatArray:
        """Angular frequencies (K,), rad/s."""
        return 2 * np.pi * self.frequency_hz

    def pose(self, time_s: FloatArray | float) -> FloatArray:
        """Return the poses (..., 6) at times (...,): translation of the origin point, rotation vector, zero mean."""
        return harmonic(np.asarray(time_s), self.frequency_hz, self.displacement)


def harmonic(time_s: FloatArray, frequency_hz: FloatArray, phasors: ComplexArray) -> FloatArray:
    """Return Σ Re{X·e^{jωt}} (..., C) at times (...,) of phasors (K, C)."""
    time = np.asarray(time_s, dtype=np.float64)
    total = np.zeros((*time.shape, phasors.shape[1]))
    for frequency, line in zip(frequency_hz, phasors, strict=True):
        turn = np.exp(2j * np.pi * frequency * time)[..., None]
        total += (turn * line).real
    return total


def wrench(motion: Motion, parts: Sequence[TruePart], gravity: FloatArray) -> ComplexArray:
    """Return the phasors (K, 6) of force and moment at the origin that move the parts, in the body's own axes.

    Newton and Euler of each part: F = m·(a + α × c) + m·θ × g, M = c × F + I·α, θ = −α/ω². The last term of F is
    gravity seen from tilted axes: Rᵀ·(−m·g) = −m·g + m·θ × g to first order.
    """
    a, alpha = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    tilt = np.cross(motion.displacement[:, 3:], gravity)
    total = np.zeros_like(motion.acceleration)
    for part in parts:
        c = part.centre_of_mass_m
        force = part.mass_kg * (a + np.cross(alpha, c) + tilt)
        total[:, :3] += force
        total[:, 3:] += np.cross(c, force) + alpha @ part.inertia_kgm2.T
    return total


def base_motion(load: Motion, mount_hz: FloatArray, damping: float) -> Motion:
    """Return the motion of the base below an oscillator per component.

    load/base = (1 + 2jζη)/(1 − η² + 2jζη), η = f/f_0 with the component's own f_0 (`mount_hz`, (6,)).
    """
    ratio = load.frequency_hz[:, None] / np.asarray(mount_hz)
    transfer = (1 + 2j * damping * ratio) / (1 - ratio**2 + 2j * damping * ratio)
    return Motion(load.frequency_hz, load.acceleration / transfer)


def sensitivity(frequency_hz: FloatArray, static: FloatArray, damping_s: FloatArray, lag_s: float) -> ComplexArray:
    """Return the complex sensitivity (K, 6, 6), output per load component, of a spring-damper sensor behind a filter.

    Outputs follow the spring's deflection: component i of the load counts 1/(1 + jω·b_i/k_i) (`damping_s` = b/k),
    and the chain is a first-order low-pass 1/(1 + jω·lag). `static` (6, 6) carries the cross-talk.
    """
    jw = 2j * np.pi * frequency_hz[:, None]
    per_component = 1 / (1 + jw * damping_s) / (1 + jw * lag_s)
    return np.asarray(static[None] * per_component[:, None, :])


def velocity_at(motion: Motion, point: FloatArray, direction: FloatArray) -> ComplexArray:
    """Return the phasors (K,) of the velocity of a body point along a fixed direction: d·(v + ω × r)."""
    velocity = motion.acceleration / (1j * motion.omega[:, None])
    return np.asarray((velocity[:, :3] + np.cross(velocity[:, 3:], point)) @ direction)


def acceleration_at(motion: Motion, point: FloatArray, direction: FloatArray, gravity: FloatArray) -> ComplexArray:
    """Return the phasors (K,) that an accelerometer reads: d·(a + α × r) − (θ × d)·g, its axis tilting along."""
    a, alpha = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    tilted = np.cross(motion.displacement[:, 3:], direction)
    return np.asarray((a + np.cross(alpha, point)) @ direction - tilted @ gravity)
