"""Levenberg-Marquardt over all recordings, and the covariance of what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.identification.problem import Curve, Problem

_STEPS = 100
_SMALL_STEP = 1e-3  # length of a step in standard uncertainties at which a fit has converged
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e-12, 1e8
_FREE_DAMPING = 1e-5  # below it a small step is small because little is left to gain
_SHARE = 0.1  # of a step, over which the curvature of the residuals is seen
_MOST_BENT = 0.75  # length of the bend in that of the step
_OPEN = 1e-10  # singular value, columns of unit length, below which a direction is open


@dataclass(frozen=True)
class State:
    """Unknowns (N,) with the whitened residuals (K, 2C) and derivatives (K, 2C, L) of every curve by its own unknowns.

    `normal` (N, N) = Σ JᵀJ and `gradient` (N,) = Σ Jᵀr of the lines, `chi_squared` of the lines, `prior` that of what
    was known beforehand.
    """

    vector: FloatArray
    residuals: tuple[FloatArray, ...]
    jacobians: tuple[FloatArray, ...]
    normal: FloatArray
    gradient: FloatArray
    chi_squared: float
    prior: float

    @property
    def cost(self) -> float:
        """What is minimised: χ² of lines and priors together."""
        return self.chi_squared + self.prior


def evaluate(problem: Problem, vector: FloatArray) -> State:
    """Return residuals and derivatives at a vector of unknowns."""
    whitened = []
    for curve in problem.curves:
        value, by_place = curve.modelled(vector)
        deviation = (curve.record.ratio.value - value)[:, :, None]
        whitened.append(curve.whitened(np.concatenate([deviation, by_place], axis=2)))
    return _state(problem, vector, whitened)


def rescaled(problem: Problem, state: State, factors: Sequence[FloatArray]) -> State:
    """Return a state with residuals and derivatives times `factors` (K,) per recording."""
    whitened = [
        np.concatenate([residual[:, :, None], jacobian], axis=2) * factor[:, None, None]
        for residual, jacobian, factor in zip(state.residuals, state.jacobians, factors, strict=True)
    ]
    return _state(problem, state.vector, whitened)


def _state(problem: Problem, vector: FloatArray, whitened: Sequence[FloatArray]) -> State:
    """Return the state of residuals and derivatives (K, 2C, 1+L) of every curve."""
    count = len(vector)
    normal, gradient, chi_squared = np.zeros((count, count)), np.zeros(count), 0.0
    for curve, both in zip(problem.curves, whitened, strict=True):
        flat = both.reshape(-1, both.shape[2])
        product = flat.T @ flat
        places = curve.places
        np.add.at(normal, (places[:, None], places), product[1:, 1:])
        np.add.at(gradient, places, product[1:, 0])
        chi_squared += float(product[0, 0])
    normal[problem.fixed] = 0.0
    normal[:, problem.fixed] = 0.0
    gradient[problem.fixed] = 0.0
    return State(
        vector=vector,
        residuals=tuple(both[:, :, 0] for both in whitened),
        jacobians=tuple(both[:, :, 1:] for both in whitened),
        normal=normal,
        gradient=gradient,
        chi_squared=chi_squared,
        prior=float(np.sum(problem.precision * (problem.expected - vector) ** 2)),
    )


def solve(problem: Problem, state: State) -> State:
    """Return the unknowns of least χ² of lines and priors, from a state on, damped after Marquardt (J. SIAM 11, 1963).

    After a step that was refused the next ones are bent, so that they follow a curved valley (`_bent`). What is reached
    after many steps is returned also where more would be needed.
    """
    damping = _FIRST_DAMPING
    for _ in range(_STEPS):
        normal = state.normal + np.diag(problem.precision)
        gradient = state.gradient + problem.precision * (problem.expected - state.vector)
        scale = np.sqrt(np.maximum(normal.diagonal(), np.finfo(np.float64).tiny))
        unit = normal / np.multiply.outer(scale, scale)
        refused = False
        while True:
            damped = unit + damping * np.eye(len(scale))
            step = np.linalg.solve(damped, gradient / scale) / scale
            if damping < _FREE_DAMPING and step @ normal @ step < _SMALL_STEP**2:
                return state
            taken = _bent(problem, state, step, damped, scale) if refused else step
            new = _tried(problem, state.vector + taken) if taken is not None else None
            if new is not None and new.cost <= state.cost * (1.0 + 1e-12):
                break
            damping, refused = 10.0 * damping, True
            if damping > _LARGEST_DAMPING:
                return state
        state, damping = new, max(_LEAST_DAMPING, 0.03 * damping)
    return state


def _bent(problem: Problem, state: State, step: FloatArray, damped: FloatArray, scale: FloatArray) -> FloatArray | None:
    """Return a step with its geodesic acceleration (Transtrum and Sethna, arXiv:1201.5885), None where that rules it.

    The residuals' second derivative along the step is that of a difference over a tenth of it.
    """
    ahead = _tried(problem, state.vector + _SHARE * step)
    if ahead is None:
        return None
    curvature = np.zeros(len(step))
    for curve, here, jacobian, there in zip(
        problem.curves, state.residuals, state.jacobians, ahead.residuals, strict=True
    ):
        second = (there - here + _SHARE * (jacobian @ step[curve.places])) * (2.0 / _SHARE**2)
        np.add.at(curvature, curve.places, np.tensordot(second, jacobian, 2))
    curvature[problem.fixed] = 0.0
    bend = 0.5 * np.linalg.solve(damped, curvature / scale) / scale
    if np.linalg.norm(bend * scale) > _MOST_BENT * np.linalg.norm(step * scale):
        return None
    return np.asarray(step + bend)


def _tried(problem: Problem, vector: FloatArray) -> State | None:
    """Return the state at a vector, None where a mass or a stiffness would not be positive."""
    for curve in problem.curves:
        (mass, _, stiffness), _ = curve.mechanics.at(curve.weights(vector))
        if min(mass[0, 0], stiffness[0, 0]) <= 0.0:
            return None
        if len(mass) > 1 and min(np.linalg.eigvalsh(mass)[0], np.linalg.eigvalsh(stiffness)[0]) <= 0.0:
            return None
    state = evaluate(problem, vector)
    return state if np.isfinite(state.chi_squared) else None


def effective(problem: Problem, state: State) -> float:
    """Return the number of unknowns that the lines determine: the trace of (JᵀJ + P)⁻¹ JᵀJ."""
    whole = state.normal + np.diag(problem.precision)
    scale = np.sqrt(np.maximum(whole.diagonal(), np.finfo(np.float64).tiny))
    pair = np.multiply.outer(scale, scale)
    return float(np.trace(np.linalg.lstsq(whole / pair, state.normal / pair, rcond=1e-12)[0]))


@dataclass(frozen=True)
class Spread:
    """Covariance of all unknowns, and the directions that the recordings leave open.

    `covariance` (N, N) of the determined part, `opened` (Z, N) orthonormal directions in units of `scale` (N,);
    `prior` (N, N): change of all unknowns (rows) for one standard deviation of what was known beforehand of each
    (columns). `unsettled`: length in standard uncertainties of the step that linearisation would still take.
    """

    covariance: FloatArray
    opened: FloatArray
    scale: FloatArray
    prior: FloatArray
    unsettled: float

    def u(self, gradient: FloatArray) -> float:
        """Return the standard uncertainty of a number with a `gradient` (N,), infinite where it is open."""
        own = gradient * self.scale
        size = float(np.linalg.norm(own))
        if size > 0.0 and len(self.opened) and np.linalg.norm(self.opened @ own) > 1e-4 * size:
            return float("inf")
        return float(np.sqrt(max(0.0, float(gradient @ self.covariance @ gradient))))

    def covariance_of(self, gradients: FloatArray) -> FloatArray:
        """Return the covariance (G, G) of numbers with `gradients` (G, N): open ones infinite, and without relation."""
        found = gradients @ self.covariance @ gradients.T
        size = np.array([self.u(gradient) for gradient in gradients])
        unknown = ~np.isfinite(size)
        found[unknown] = 0.0
        found[:, unknown] = 0.0
        found[unknown, unknown] = np.inf
        return np.asarray(found)


def spread(problem: Problem, state: State) -> Spread:
    """Return the covariance A⁻¹ (JᵀRJ + P) A⁻¹, A = JᵀJ + P: R the correlation of lines, P what was known beforehand.

    In a basis in which A = 1, so that what the stated masses and scales leave open does not lose its digits.
    """
    count, free = len(state.vector), ~problem.fixed
    wide = [_wide(problem, curve, part) for curve, part in zip(problem.curves, state.jacobians, strict=True)]
    rows = [jacobian.reshape(-1, count) for jacobian in wide]
    stacked = np.concatenate([*rows, np.diag(np.sqrt(problem.precision))])
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0.0] = 1.0
    triangle = np.linalg.qr((stacked / size)[:, free], mode="r")
    singular, found = np.linalg.svd(triangle)[1:]
    directions = np.zeros((len(found), count))
    directions[:, free] = found
    determined = singular > _OPEN * singular.max()
    basis = directions[determined].T / singular[determined] / size[:, None]
    middle = np.eye(basis.shape[1])
    for curve, jacobian in zip(problem.curves, wide, strict=True):
        correlation = curve.record.line_correlation
        if correlation is not None and len(correlation) > 1:
            middle += _between_lines(curve.record.ratio.frequency_hz, jacobian @ basis, correlation)
    prior = basis @ basis.T * np.sqrt(problem.precision)
    uphill = state.gradient + problem.precision * (problem.expected - state.vector)
    unsettled = float(np.linalg.norm(uphill @ basis))
    return Spread(basis @ middle @ basis.T, directions[~determined], 1.0 / size, prior, unsettled)


def _wide(problem: Problem, curve: Curve, jacobian: FloatArray) -> FloatArray:
    """Return derivatives (K, 2C, N) by all unknowns of those (K, 2C, L) by a curve's own, none by fixed ones."""
    wide = np.zeros((*jacobian.shape[:2], len(problem.names)))
    for column, place in enumerate(curve.places):
        wide[:, :, place] += jacobian[:, :, column]
    wide[:, :, problem.fixed] = 0.0
    return wide


def _between_lines(frequency_hz: FloatArray, columns: FloatArray, correlation: ComplexArray) -> FloatArray:
    """Return Tᵀ(R - 1)T of whitened columns T (K, 2C, N), R the `correlation` (D,) of lines 0, 1, 2 … apart."""
    place = np.round((frequency_hz - frequency_hz.min()) / np.min(np.diff(np.sort(frequency_hz)))).astype(np.int64)
    length, channels, count = int(place.max()) + 1, columns.shape[1] // 2, columns.shape[2]
    grid: ComplexArray = np.zeros((length + len(correlation), channels, count), dtype=np.complex128)
    grid[place] = columns[:, :channels] + 1j * columns[:, channels:]
    here = grid[:length].reshape(-1, count)
    total = np.zeros((count, count))
    for apart, value in enumerate(correlation[1:], start=1):
        pair = value * (grid[apart : apart + length].reshape(-1, count).conj().T @ here)
        total += (pair + pair.conj().T).real
    return total
