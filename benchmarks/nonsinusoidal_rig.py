"""A shaker table, a six-component sensor and its load as one linear system in time, without the program.

The table on flexures is driven by a prescribed signal in one component; parasitic components with a rocking mode
follow it. The load is on the sensor's 6 x 6 stiffness and damping, in gravity. The 38 states are integrated exactly
for a signal that is linear between points of the grid. Vectors of six are a translation of the sensor origin and a
rotation, or a wrench.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.signal import butter, lfilter, sosfilt

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

KINDS, BAND_HZ, SETTLE_S = ("chirp", "noise", "impact", "train", "sine"), (60.0, 900.0), 1.0
DRIVE_HZ, SUSPENSION_HZ, AMPLIFIER_HZ = 3e3, 25.0, 5e3
GRAVITY_M_S2 = 9.8113
CAPACITY = np.array([500.0, 500.0, 1000.0, 25.0, 25.0, 25.0])
DIRECTIONS, GAIN = ("x", "y", "z", "rx", "ry", "rz"), np.array([1.0, 1.0, 1.0, 20.0, 20.0, 20.0])
"""Driven components of the base, and their m or rad per m of stroke."""
PIVOT_M = np.array([0.0, 0.0, 0.0385])
"""A place about which the base turns below the rocking mode, for loads other than those of translations."""


def skew(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def row_of(point: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the six coefficients of a translation read at a point along a direction."""
    return np.concatenate([direction, np.cross(point, direction)])


@dataclass(frozen=True)
class Body:
    """Mass in kg, centre of mass in m, inertia about it in kg m2."""

    mass_kg: float
    centre_m: FloatArray
    inertia_kg_m2: FloatArray

    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return the 6 x 6 mass matrix about the sensor origin, and the wrench of the tilted weight per pose."""
        mass, arm, weight = self.mass_kg, skew(self.centre_m), np.array([0.0, 0.0, -self.mass_kg * GRAVITY_M_S2])
        lower = np.hstack([mass * arm, self.inertia_kg_m2 - mass * arm @ arm])
        tilt = np.vstack([-skew(weight), -arm @ skew(weight)])
        return np.vstack([np.hstack([mass * np.eye(3), -mass * arm]), lower]), np.hstack([np.zeros((6, 3)), tilt])


LOAD = Body(
    2.4, np.array([4e-4, -3e-4, 0.0385]), np.array([[1.93e-3, 2e-5, 0], [2e-5, 1.99e-3, -1e-5], [0, -1e-5, 2.25e-3]])
)
INTERNAL = Body(0.214, np.array([0.0, 0.0, 1e-3]), np.diag([9e-5, 9e-5, 1.5e-4]))
U_BODIES = ((2e-4, 5e-5, 5e-6), (5e-4, 2e-4, 3e-6))
"""Standard uncertainties of mass, centre of mass and inertia of load and internal mass."""


@dataclass(frozen=True)
class Rig:
    """True mechanics of one draw, and the static matrix that is stated."""

    mass: FloatArray
    tilt: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    damper_share: float
    static: FloatArray
    stated_static: FloatArray
    coupling: FloatArray
    coupling_hz: FloatArray
    coupling_damping: FloatArray
    driven: int = 2

    def natural(self) -> tuple[FloatArray, FloatArray]:
        """Return natural frequencies in Hz and mass-normalised shapes without damping."""
        squares, shapes = eigh(self.stiffness, self.mass)
        return np.sqrt(squares) / (2.0 * np.pi), shapes

    def base_per_table(self, hertz: FloatArray) -> ComplexArray:
        """Return the pose of the base over the stroke of the table, (F, 6)."""
        ratio = hertz[:, None] / self.coupling_hz
        base = np.asarray(self.coupling / (1.0 - ratio**2 + 2j * self.coupling_damping * ratio), dtype=complex)
        base[:, self.driven] = GAIN[self.driven]
        return base

    def responses(self, hertz: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return pose of the load and load per stroke of the table, (F, 6), and the sensitivities, (F, 6, 6)."""
        omega = (2.0 * np.pi * hertz)[:, None, None]
        spring = self.stiffness + 1j * omega * self.damping
        base = self.base_per_table(hertz)[..., None]
        pose = np.linalg.solve(spring + self.tilt - omega**2 * self.mass, spring @ base)
        load = (self.tilt - omega**2 * self.mass) @ pose
        read = self.static @ (self.stiffness + 1j * omega * self.damper_share * self.damping)
        matrix = np.asarray(read @ np.linalg.inv(spring), dtype=complex)
        return np.asarray(pose[..., 0], dtype=complex), np.asarray(load[..., 0], dtype=complex), matrix


def make_rig(draw: int, exact: bool = False, driven: int = 2) -> Rig:
    """Sample a rig; bending in the band for even draws, above it for odd ones; `driven`: component of the base."""
    rng = np.random.default_rng([71, draw])
    mass, tilt = np.zeros((6, 6)), np.zeros((6, 6))
    for body, (u_mass, u_centre, u_inertia) in zip((LOAD, INTERNAL), U_BODIES, strict=True):
        off = 0.0 if exact else 1.0
        noise = rng.normal(size=(3, 3)) * off
        centre = body.centre_m + u_centre * off * rng.normal(size=3)
        inertia = body.inertia_kg_m2 + u_inertia * np.triu(noise) + u_inertia * np.triu(noise, 1).T
        parts = Body(body.mass_kg + off * u_mass * rng.normal(), centre, inertia).matrices()
        mass, tilt = mass + parts[0], tilt + parts[1]
    rough = rng.uniform(-1.0, 1.0, (6, 6))
    rough = (rough + rough.T) / 2.0 * (1.0 - np.eye(6))
    shift = np.block([[np.eye(3), -skew(np.array([3e-4, -2e-4, -0.012]))], [np.zeros((3, 3)), np.eye(3)]])
    axial, bending = 1400.0 * rng.uniform(0.97, 1.03), (700.0 if draw % 2 == 0 else 1050.0) * rng.uniform(0.95, 1.05)

    def stiffness(rocking: float) -> FloatArray:
        own = [3.2e8, 3.0e8, mass[0, 0] * (2.0 * np.pi * axial) ** 2, rocking, 1.15 * rocking, 2.6e5]
        matrix: FloatArray = shift.T @ (np.diag(own) + 0.03 * np.sqrt(np.outer(own, own)) * rough) @ shift
        return matrix

    def excess(logarithm: float) -> float:
        lowest = float(eigh(stiffness(np.exp(logarithm)), mass, eigvals_only=True)[0])
        return lowest / (2.0 * np.pi * bending) ** 2 - 1.0

    spring = stiffness(np.exp(brentq(excess, np.log(1e4), np.log(3e6))))
    squares, shapes = eigh(spring, mass)
    ratios = np.array([0.025, 0.025, 0.012, 0.015, 0.015, 0.02])
    damping = mass @ shapes @ np.diag(2.0 * ratios * np.sqrt(squares)) @ shapes.T @ mass
    damping += 0.05 * np.sqrt(np.outer(np.diag(damping), np.diag(damping))) * rough[::-1, ::-1]
    main = np.array([1.6e-6, 1.6e-6, 7e-7, 3.1e-5, 3.1e-5, 2.7e-5])
    cross = 0.01 * rng.normal(size=(6, 6)) * (1.0 - np.eye(6)) * (main * CAPACITY)[:, None] / CAPACITY
    static = np.diag(main) * (1.0 + 0.01 * rng.normal(size=6)) + cross
    coupling = rng.normal(size=6) * np.array([0.03, 0.03, 0.03 * (driven != 2), 0.4, 0.4, 0.2])
    coupling[driven] = 0.0
    if driven > 2:
        coupling[:3] += GAIN[driven] * np.cross(PIVOT_M, np.eye(3)[driven - 3])
    stated = static * (1.0 + (0.0 if exact else 5e-4) * rng.normal(size=(6, 6)))
    share = 1.0 if draw == 0 else float(rng.uniform())
    coupling_hz, coupling_damping = rng.uniform(1150.0, 1300.0, 6), rng.uniform(0.02, 0.05, 6)
    return Rig(mass, tilt, spring, damping, share, static, stated, coupling, coupling_hz, coupling_damping, driven)


@dataclass(frozen=True)
class System:
    """States x' = A x + b f, and the places of pose, velocity, base and outputs among them."""

    a: FloatArray
    b: FloatArray

    def reading(self, derivative: int, body: str, row: FloatArray) -> FloatArray:
        """Return the row of a derivative of a translation of the load (`load`) or the base, (38,)."""
        states = np.zeros(38)
        states[slice(14, 20) if body == "load" else slice(2, 8)] = row
        for _ in range(derivative):
            states = states @ self.a
        return states


def make_system(rig: Rig) -> System:
    """Write the equations of motion: drive 0-1, base 2-13, load 14-25, outputs 26-37, each as value and rate."""
    a, b = np.zeros((38, 38)), np.zeros(38)

    def oscillator(first: int, count: int, hertz: Any, damping: Any) -> slice:
        rates, omega = slice(first + count, first + 2 * count), 2.0 * np.pi * np.broadcast_to(hertz, count)
        a[first : first + count, rates] = np.eye(count)
        a[rates, first : first + count] = -np.diag(omega**2)
        a[rates, rates] = -np.diag(2.0 * np.broadcast_to(damping, count) * omega)
        return rates

    oscillator(0, 1, DRIVE_HZ, 0.7)
    b[1] = (2.0 * np.pi * DRIVE_HZ) ** 2
    own, damping = rig.coupling_hz.copy(), rig.coupling_damping.copy()
    driven = rig.driven
    own[driven], damping[driven] = SUSPENSION_HZ, 0.4
    rates = oscillator(2, 6, own, damping)
    a[rates, 2 + driven] += (2.0 * np.pi * rig.coupling_hz) ** 2 * rig.coupling / GAIN[driven]
    a[8 + driven, 0] = GAIN[driven]
    pose, velocity, base, base_velocity = slice(14, 20), slice(20, 26), slice(2, 8), slice(8, 14)
    a[pose, velocity] = np.eye(6)
    inverse = np.linalg.inv(rig.mass)
    a[velocity, pose], a[velocity, velocity] = -inverse @ (rig.stiffness + rig.tilt), -inverse @ rig.damping
    a[velocity, base], a[velocity, base_velocity] = inverse @ rig.stiffness, inverse @ rig.damping
    rates = oscillator(26, 6, AMPLIFIER_HZ, np.sqrt(0.5))
    for sign, places, speeds in ((-1.0, pose, velocity), (1.0, base, base_velocity)):
        gain = sign * (2.0 * np.pi * AMPLIFIER_HZ) ** 2 * rig.static
        a[rates, places], a[rates, speeds] = gain @ rig.stiffness, gain @ rig.damping * rig.damper_share
    return System(a, b)


def integrate(
    system: System, force: FloatArray, step_s: float, rows: FloatArray, wanted: tuple[slice, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return readings (n, R) at a slice of the grid, and poses of the load (T, 6) at any times.

    The force is linear between points of the grid. Each mode is a recursion of first order, exact over a step.
    """
    every, times_s = wanted
    values, vectors = np.linalg.eig(system.a)
    inputs = np.linalg.solve(vectors, system.b.astype(complex))
    index = np.minimum((times_s / step_s).astype(int), force.size - 2)
    rest, slope = times_s - index * step_s, np.diff(force) / step_s
    readings, poses = np.zeros((len(range(force.size)[every]), len(rows))), np.zeros((times_s.size, 6))
    for value, vector, entry in zip(values, vectors.T, inputs, strict=True):
        if value.imag < 0.0:
            continue
        weight = 1.0 if value.imag == 0.0 else 2.0
        first, second = (np.squeeze(part) * entry for part in ramps(value, np.array([step_s])))
        recursion = [second / step_s, first - second / step_s]
        state = lfilter(recursion, [1.0, -np.exp(value * step_s)], force.astype(complex))
        readings += weight * (state[every, None] * (rows @ vector)).real
        first, second = ramps(value, rest)
        between = np.exp(value * rest) * state[index] + entry * (force[index] * first + slope[index] * second)
        poses += weight * (between[:, None] * vector[14:20]).real
    return readings, poses


def ramps(value: complex, times_s: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the response of x' = value x + u after each time, for u = 1 and u = t from rest."""
    argument = value * times_s
    small = np.abs(argument) < 1e-3
    safe = np.where(small, 1.0, argument)
    first = np.where(small, 1.0 + argument / 2.0 + argument**2 / 6.0, np.expm1(safe) / safe)
    second = np.where(small, 0.5 + argument / 6.0 + argument**2 / 24.0, (np.expm1(safe) - safe) / safe**2)
    return np.asarray(times_s * first, dtype=complex), np.asarray(times_s**2 * second, dtype=complex)


def drive(kind: str, times_s: FloatArray, end_s: float, hertz: float, rng: np.random.Generator) -> FloatArray:
    """Return the prescribed acceleration of the drive in m/s2; `times_s` begin at the end of the rest."""
    rise = 0.25 if kind != "sine" else 0.5 * SETTLE_S
    taper = np.sin(0.5 * np.pi * np.clip(np.minimum(times_s, end_s - times_s) / rise, 0.0, 1.0)) ** 2
    if kind == "sine":
        return np.asarray(20.0 * taper * np.sin(2.0 * np.pi * hertz * times_s))
    if kind == "chirp":
        low, high = BAND_HZ[0] - 6.0, BAND_HZ[1] + 20.0
        return np.asarray(20.0 * taper * np.sin(2.0 * np.pi * (low + 0.5 * (high - low) / end_s * times_s) * times_s))
    if kind == "noise":
        sections = butter(4, BAND_HZ, "bandpass", fs=1.0 / (times_s[1] - times_s[0]), output="sos")
        noise = sosfilt(sections, rng.normal(size=times_s.size))
        return np.asarray(12.0 * taper * noise / np.std(noise))
    force, start = np.zeros(times_s.size), 0.02
    while start < end_s:
        width, peak = rng.uniform(0.6e-3, 0.9e-3), rng.uniform(80.0, 160.0)
        blow = slice(*np.searchsorted(times_s, [start, start + width]))
        force[blow] = peak * np.sin(np.pi * (times_s[blow] - start) / width)
        start += rng.uniform(0.09, 0.16) if kind == "train" else rng.uniform(1.05, 1.15)
    return force
