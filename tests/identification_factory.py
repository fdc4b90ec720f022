"""Exact curves of loads on springs, by formulas and by state space that the program does not use, and noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from shaker.identification.measured_curves import CurveError, InertiaError, MeasuredTransfer, Placement
from shaker.sine.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Z = np.array([0.0, 0.0, 1.0])
X = np.array([1.0, 0.0, 0.0])
ALONG_Z = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
ALONG_X = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def rigid_mass(mass_kg: float, height_m: float = 0.0, inertia_kgm2: float = 0.0) -> FloatArray:
    """Mass matrix (6, 6) about the origin of a body with its centre of mass on the z axis: ½ẋᵀMẋ is its energy."""
    velocity, turning = np.eye(6)[:, :3] + np.cross(np.eye(6)[:, 3:], height_m * Z), np.eye(6)[:, 3:]
    return np.asarray(mass_kg * velocity @ velocity.T + inertia_kgm2 * turning @ turning.T)


def oscillator(s: ComplexArray, mass: float, k: float, b: float) -> ComplexArray:
    """Motion of a mass over that of its base."""
    return np.asarray((b * s + k) / (mass * s * s + b * s + k))


def state_space(
    s: ComplexArray, mass: FloatArray, damping: FloatArray, stiffness: FloatArray, base: FloatArray
) -> ComplexArray:
    """Motion (K, n) of coordinates on springs and dampers to a base that moves by `base` (n,), by state space.

    States x and v; the base's displacement and velocity drive: M v̇ = K(base·u - x) + B(base·u̇ - v), forces of the
    base's own acceleration on rigidly coupled coordinates being none.
    """
    size = len(mass)
    lower = [-linalg.solve(mass, stiffness), -linalg.solve(mass, damping)]
    a = np.block([[np.zeros((size, size)), np.eye(size)], lower])
    by_displacement = np.concatenate([np.zeros(size), linalg.solve(mass, stiffness @ base)])
    by_velocity = np.concatenate([np.zeros(size), linalg.solve(mass, damping @ base)])
    moved = [linalg.solve(one * np.eye(2 * size) - a, by_displacement + one * by_velocity)[:size] for one in s]
    return np.array(moved)


def replace_ratio(record: MeasuredTransfer, value: ComplexArray | None = None, **words: Any) -> MeasuredTransfer:
    """The curve of a recording along z, or another value, with other noise and errors."""
    value = record.ratio.value if value is None else value
    return recording(record.name, record.ratio.frequency_hz, value, record.mass_matrix, ALONG_Z, **words)


def recording(
    name: str,
    frequency_hz: FloatArray,
    value: ComplexArray,
    mass_matrix: FloatArray,
    drive: FloatArray,
    *,
    noise: float | FloatArray,
    rng: np.random.Generator | None = None,
    tops: Sequence[Placement] | None = None,
    base: Placement | None = None,
    errors: Sequence[CurveError] = (),
    inertia_errors: Sequence[InertiaError] = (),
    line_correlation: ComplexArray | None = None,
    added_decay_per_s: float = 0.0,
    u_clock: float = 0.0,
    dof: float = 1e6,
) -> MeasuredTransfer:
    """Curves (K, C) with circular noise of a standard uncertainty per part, as measured; without `rng` exact.

    With few `dof` the covariance stated of a line scatters about the true one, as that of a few periods does.
    """
    value = value.reshape(len(frequency_hz), -1)
    lines, channels = value.shape
    size = np.broadcast_to(noise, value.shape)
    covariance = np.zeros((lines, 2 * channels, 2 * channels))
    index = np.arange(2 * channels)
    covariance[:, index, index] = np.concatenate([size, size], axis=1) ** 2
    if rng is not None:
        draws = rng.standard_normal((2, lines, channels))
        value = value + size * (draws[0] + 1j * draws[1])
        covariance *= (rng.chisquare(dof, lines) / dof)[:, None, None]
    sight = Placement(np.zeros(3), drive[:3] if np.any(drive[:3]) else Z)
    names = tuple(f"top {c + 1}" for c in range(channels))
    ratio = Phasors(frequency_hz, value, covariance, names, ("1",) * channels, np.full(lines, dof))
    return MeasuredTransfer(
        name=name,
        ratio=ratio,
        tops=tuple(tops) if tops is not None else (sight,) * channels,
        base=sight if base is None else base,
        drive=drive,
        mass_matrix=mass_matrix,
        errors=tuple(errors),
        inertia_errors=tuple(inertia_errors),
        line_correlation=line_correlation,
        added_decay_per_s=added_decay_per_s,
        u_clock=u_clock,
    )


FREE = [0, 4]
"""Components of a load that shifts along x and pitches about y."""


def pitching(
    load: tuple[float, float, float],
    springs: tuple[float, float, float, float],
    internal: tuple[float, float],
    frequency_hz: FloatArray,
    true: Sequence[Placement],
    *,
    off_kg: float = 0.0,
    **words: Any,
) -> MeasuredTransfer:
    """Horizontal drive of a load (kg, height of its centre of mass in m, central kg·m²), seen where transducers are.

    `springs`: k_x, k_ry, b_x, b_ry; `internal`: mass and moment of inertia inside the sensor; `off_kg`: by which the
    load is heavier than stated. Words: those of `recording`.
    """
    mass, height, inertia = load
    whole = rigid_mass(mass + off_kg, height, inertia) + rigid_mass(internal[0], 0.0, internal[1])
    free_mass, s = whole[np.ix_(FREE, FREE)], 2j * np.pi * frequency_hz
    moved = state_space(s, free_mass, np.diag(springs[2:]), np.diag(springs[:2]), np.array([1.0, 0.0]))
    seen = []
    for top in true:
        (x, _, z), (along, _, up) = top.point_m, top.direction
        seen.append(along * (moved[:, 0] + z * moved[:, 1]) - up * x * moved[:, 1])
    stated = rigid_mass(mass, height, inertia)
    return recording(f"{mass} kg", frequency_hz, np.stack(seen, axis=1), stated, ALONG_X, **words)
