"""Whitened least squares: accelerations and common errors estimated together, with all that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from fusion.system import (
    BODY_SIZE_M,
    SCALE,
    UNOBSERVED_MOTION,
    System,
    build_system,
    hidden_motion,
    real_design,
    real_rows,
    real_stack,
)
from shaker._checks import ComplexArray, FloatArray

__all__ = [
    "BODY_SIZE_M",
    "SCALE",
    "UNOBSERVED_MOTION",
    "Solution",
    "System",
    "build_system",
    "hidden_motion",
    "real_design",
    "real_rows",
    "real_stack",
    "solve",
]


NOISE_FLOOR = 1e-4
CONVERGED = 1e-10


@dataclass(frozen=True)
class Solution:
    """Estimate of a system: `acceleration` (K, 6), `errors` (E,) in standard uncertainties, `effects` (N, E) there.

    `remaining` (E,): standard uncertainty of the errors after the estimate over that before.
    `gain` (12K, N): estimate = gain · readings; `projector` (N, N) = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 with V the
    covariance of noise and common errors, so that `chi2` = y^T P y; `dof`; `noise` (N, N) as it was used, with the
    discrepancy and the `hidden` (N,) variances in it.
    """

    acceleration: ComplexArray
    errors: FloatArray
    remaining: FloatArray
    effects: FloatArray
    gain: FloatArray
    projector: FloatArray
    chi2: float
    dof: int
    noise: FloatArray
    hidden: FloatArray


def solve(system: System, extra: FloatArray | None = None, iterations: int = 8) -> Solution:
    """Estimate accelerations and common errors together by least squares.

    The augmented system [X S; 0 I] [A; e] = [y; 0], whitened by the noise, is equivalent to generalised least squares
    with the covariance N + S S^T. S is taken at the current estimate and the step repeated, so that no reading that
    happens to be low gains weight by it (Peelle's puzzle; D'Agostini 1994, Nucl. Instrum. Methods A 346, 306).
    `extra` (N, N): covariance of the readings beside what is stated.
    """
    noise = system.noise if extra is None else system.noise + extra
    acceleration = system.acceleration(_starting_point(system, noise))
    for _ in range(iterations):
        step = _augmented(system, noise, acceleration)
        found = step.acceleration(system)
        change = np.max(np.abs(found - acceleration), initial=0.0)
        acceleration = found
        if change <= CONVERGED * np.max(np.abs(acceleration), initial=0.0):
            break
    return _solution(system, _augmented(system, noise, acceleration))


def _starting_point(system: System, noise: FloatArray) -> FloatArray:
    """Unknowns without common errors, every reading weighted by its noise and a hundredth of its size."""
    weight = 1.0 / np.sqrt(np.diag(noise) + (1e-2 * system.size) ** 2)
    return np.asarray(np.linalg.lstsq(system.design * weight[:, None], system.readings * weight, rcond=None)[0])


@dataclass(frozen=True)
class _Step:
    """The augmented system whitened by the `root` of the `noise`: (N + E, P + E), right side (N,), column `scale`."""

    matrix: FloatArray
    readings: FloatArray
    scale: FloatArray
    root: FloatArray
    noise: FloatArray
    effects: FloatArray
    hidden: FloatArray

    def acceleration(self, system: System) -> ComplexArray:
        """Return the estimate alone."""
        unknowns = len(self.scale)
        right = np.zeros(len(self.matrix))
        right[: len(self.readings)] = self.readings
        triangle = np.asarray(np.linalg.qr(np.column_stack([self.matrix, right]), mode="r"))
        size = self.matrix.shape[1]
        found = solve_triangular(triangle[:size, :size], triangle[:size, -1], check_finite=False)
        return system.acceleration(found[:unknowns] / self.scale)


def _augmented(system: System, noise: FloatArray, acceleration: ComplexArray) -> _Step:
    """Whitened system with the effects of the common errors and of unobserved motion at an acceleration (K, 6)."""
    effects, hidden = system.effects(acceleration), system.hidden_variances(acceleration)
    # Noise far below the common errors is raised to 1e-4 of them: invisible in U, and P keeps its digits.
    floor = (NOISE_FLOOR * np.linalg.norm(effects, axis=1)) ** 2 + (1e-12 * system.size) ** 2
    variance = np.diag(noise) + hidden
    # A share of 1e-9 of the variances keeps covariances of channels that move alike positive definite.
    noise = noise + np.diag(hidden + np.maximum(floor - variance, 0.0) + 1e-9 * variance)
    root = np.asarray(np.linalg.cholesky(noise))
    count, unknowns, errors = len(system.readings), system.design.shape[1], effects.shape[1]
    columns = np.column_stack([system.design, effects, system.readings])
    white = solve_triangular(root, columns, lower=True, check_finite=False)
    scale = np.asarray(np.linalg.norm(white[:, :unknowns], axis=0))
    matrix = np.zeros((count + errors, unknowns + errors))
    matrix[:count] = white[:, :-1]
    matrix[:count, :unknowns] /= scale
    matrix[count:, unknowns:] = np.eye(errors)
    return _Step(matrix, white[:, -1], scale, root, noise, effects, hidden)


def _solution(system: System, step: _Step) -> Solution:
    """Estimate with all that follows from it."""
    count, unknowns = len(system.readings), system.design.shape[1]
    q, r = np.linalg.qr(step.matrix)
    white_projector = np.eye(count) - q[:count] @ q[:count].T
    inverse = solve_triangular(r, q[:count].T, check_finite=False)
    left = solve_triangular(
        step.root, np.column_stack([white_projector, inverse.T]), lower=True, trans="T", check_finite=False
    )
    gain = left[:, count:].T
    after = solve_triangular(r[unknowns:, unknowns:], np.eye(len(r) - unknowns), check_finite=False)
    return Solution(
        acceleration=system.acceleration(inverse[:unknowns] @ step.readings / step.scale),
        errors=inverse[unknowns:] @ step.readings,
        remaining=np.linalg.norm(after, axis=1),
        effects=step.effects,
        gain=system.expand @ (gain[:unknowns] / step.scale[:, None]),
        projector=solve_triangular(step.root, left[:, :count].T, lower=True, trans="T", check_finite=False),
        chi2=float(step.readings @ white_projector @ step.readings),
        dof=count - unknowns,
        noise=step.noise,
        hidden=step.hidden,
    )
