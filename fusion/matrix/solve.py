"""Maximum likelihood of a matrix from loads and outputs that both err, with unknowns they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from fusion.drive import LOADS
from fusion.matrix.stack import Stack
from fusion.system import real_design
from shaker._checks import ComplexArray, FloatArray, IntArray

ITERATIONS = 100
CONVERGED = 1e-7
"""Largest step, in standard uncertainties, at which the iteration ends."""
NOISE_FLOOR = 1e-4
"""Smallest noise of a reading relative to the common errors in it: invisible in U, and sums keep their digits."""
DIGITS = 1e-10


@dataclass(frozen=True)
class Solution:
    """Matrix, loads and unknowns that fit a stack best, in its units.

    `matrix` (C, 6), `load` (R, 6), `errors` (E,) in standard uncertainties. Of the N usable real readings, drive by
    drive: `drive` (N,), `residual` (N,) of the outputs at the measured loads, `effects` (N, E), `noise` (N, N), `gain`
    (12C, N) from readings to [Re, Im] of the matrix, `through` (R, 2C, 12) from the loads to the readings, `projector`
    (N, N) with `chi2` = residualᵀ · projector · residual, of `dof` degrees of freedom; `step`: the last one, in
    standard uncertainties of the elements.
    """

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray
    drive: IntArray
    residual: FloatArray
    effects: FloatArray
    noise: FloatArray
    gain: FloatArray
    through: FloatArray
    projector: FloatArray
    step: float
    chi2: float
    dof: int


@dataclass(frozen=True)
class _Point:
    """Where the likelihood is linearised: matrix (C, 6), loads (R, 6), errors (E,)."""

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray


@dataclass(frozen=True)
class _Linear:
    """The model about a point, all drives: changes of the outputs.

    `residual` (R, 2C), `design` (R, 2C, 12C) for the matrix, `through` (R, 2C, 12) for the loads, `effects` (R, 2C, E)
    for the unknowns; `load_step` (R, 12, 12) from errors of the readings of the loads to the loads themselves.
    """

    residual: FloatArray
    design: FloatArray
    through: FloatArray
    effects: FloatArray
    load_effect: FloatArray
    load_step: FloatArray


def solve(stack: Stack, discrepancy: FloatArray | None = None) -> Solution:
    """Return the matrix S, the loads L_r and the unknowns e of greatest likelihood.

    Readings are l_r = L_r + E_r(L_r)·e + noise and y_r = (1 + Σ_k ρ_rk·e_k) ∘ (S·L_r) + noise, e with unit priors, E_r
    following the size of the fitted load and ρ relative, so that no reading that happens to be low gains weight by its
    common error (D'Agostini 1994, Nucl. Instrum. Methods A 346, 306). Gauss-Newton over S, L and e, in which L and e
    are eliminated: generalised least squares with the effective covariance of y - S·l and the design at the fitted
    loads (York 1969, Earth Planet. Sci. Lett. 5, 320, for a line). `discrepancy` (R, C): further standard deviations
    of the real and the imaginary part of the outputs.
    """
    extra = np.zeros(stack.output.shape) if discrepancy is None else discrepancy
    solution = _from(stack, _start(stack), extra)
    for _ in range(ITERATIONS):
        if solution.step <= CONVERGED:
            return solution
        solution = _from(stack, _Point(solution.matrix, solution.load, solution.errors), extra)
    raise ValueError(f"drives: expected loads that determine a matrix, found none after {ITERATIONS} iterations")


def judge(stack: Stack, solution: Solution | None = None) -> Solution:
    """Return one step from a solution, or from the start, with stated uncertainties only: what they say of it.

    Where readings disagree a thousandfold, the greatest likelihood drives the unknowns far beyond where the model is
    linear, and what it says of a single reading is meaningless; one step does not.
    """
    point = _start(stack) if solution is None else _Point(solution.matrix, solution.load, solution.errors)
    return _from(stack, point, np.zeros(stack.output.shape))


def _from(stack: Stack, point: _Point, discrepancy: FloatArray) -> Solution:
    """One step from a point."""
    return _step(stack, point, _linearise(stack, point), discrepancy)


def _start(stack: Stack) -> _Point:
    """Matrix by least squares as if the loads were exact."""
    usable = stack.usable
    rows = [
        np.linalg.lstsq(stack.load[usable[:, c]], stack.output[usable[:, c], c], rcond=None)[0]
        for c in range(len(stack.channels))
    ]
    return _Point(np.array(rows), stack.load, np.zeros(len(stack.unknowns)))


def _linearise(stack: Stack, point: _Point) -> _Linear:
    """First-order model of all readings about a point."""
    drives, channels = stack.output.shape
    factor = 1.0 + np.einsum("erc,e->rc", stack.output_effect, point.errors)
    plain = point.load @ point.matrix.T
    # The size of a load's common errors follows the fitted load: γ = <l, L>/<l, l>, E(L) = E·γ.
    weight = stack.load.conj() / np.sum(np.abs(stack.load) ** 2, axis=1, keepdims=True)
    size = np.sum(weight * point.load, axis=1)
    shift = np.einsum("erj,e->rj", stack.load_effect, point.errors)
    parts = []
    for r in range(drives):
        step = np.linalg.inv(np.eye(LOADS) + shift[r][:, None] * weight[r])
        through = factor[r][:, None] * point.matrix @ step
        design = np.zeros((channels, channels * LOADS), np.complex128)
        for c in range(channels):
            design[c, c * LOADS : (c + 1) * LOADS] = factor[r, c] * point.load[r]
        output_effect = (stack.output_effect[:, r] * plain[r]).T
        load_effect = stack.load_effect[:, r].T * size[r]
        residual = stack.output[r] - factor[r] * plain[r] - through @ (stack.load[r] - point.load[r])
        residual = residual + output_effect @ point.errors
        effects = output_effect - through @ load_effect
        parts.append((_tall(residual[:, None])[:, 0], *map(real_design, (design, through)), _tall(effects)))
        parts[-1] += (_tall(load_effect), real_design(step))
    return _Linear(*(np.stack(column) for column in zip(*parts, strict=True)))


def _tall(matrix: ComplexArray) -> FloatArray:
    """[Re; Im] of the columns of a matrix that acts on real numbers."""
    return np.concatenate([matrix.real, matrix.imag])


def _step(stack: Stack, point: _Point, linear: _Linear, discrepancy: FloatArray) -> Solution:
    """One Gauss-Newton step: generalised least squares for the matrix, then loads and errors from what is left."""
    drives, channels = stack.output.shape
    mask = np.tile(stack.usable, (1, 2))
    residual, design, effects = linear.residual[mask], linear.design[mask], linear.effects[mask]
    noise = _noise(stack, linear, discrepancy, mask)
    noise = _floored(noise, effects, np.concatenate([stack.output.real, stack.output.imag], axis=1)[mask])
    gain, projector, spread = _least_squares(noise, design, effects)
    step = gain @ residual
    left = projector @ residual
    errors = effects.T @ left
    load = _loads(stack, point, linear, (left, mask), errors)
    change = step[: channels * LOADS] + 1j * step[channels * LOADS :]
    return Solution(
        matrix=point.matrix + change.reshape(channels, LOADS),
        load=load,
        errors=errors,
        drive=np.repeat(np.arange(drives), 2 * channels).reshape(mask.shape)[mask],
        residual=residual,
        effects=effects,
        noise=noise,
        gain=gain,
        through=linear.through,
        projector=projector,
        step=float(np.max(np.abs(step) / spread)),
        chi2=float(residual @ left),
        dof=len(residual) - design.shape[1],
    )


def _least_squares(
    noise: FloatArray, design: FloatArray, effects: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain (P, N), projector (N, N) and standard uncertainties (P,) of least squares with common errors.

    The system [X A; 0 I], whitened by the noise, is equivalent to the covariance noise + A·Aᵀ but keeps its digits;
    more unknowns than readings are turned into as many.
    """
    root = np.linalg.cholesky(noise)
    white = solve_triangular(root, np.column_stack([design, effects]), lower=True)
    count, unknowns = design.shape
    common = white[:, unknowns:]
    if common.shape[1] > count:
        common = np.asarray(np.linalg.qr(common.T, mode="r")).T
    scale = np.linalg.norm(white[:, :unknowns], axis=0)
    total = unknowns + common.shape[1]
    augmented = np.zeros((count + common.shape[1], total))
    augmented[:count, :unknowns], augmented[:count, unknowns:] = white[:, :unknowns] / scale, common
    augmented[count:, unknowns:] = np.eye(common.shape[1])
    q, r = np.linalg.qr(augmented)
    inverse = solve_triangular(r, np.eye(total))
    gain = solve_triangular(root, (inverse[:unknowns] @ q[:count].T).T, lower=True, trans="T").T / scale[:, None]
    half = solve_triangular(root, np.eye(count) - q[:count] @ q[:count].T, lower=True, trans="T")
    projector = solve_triangular(root, half.T, lower=True, trans="T")
    return gain, (projector + projector.T) / 2.0, np.linalg.norm(inverse[:unknowns], axis=1) / scale


def _noise(stack: Stack, linear: _Linear, discrepancy: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Covariance (N, N) of the residuals without the unknowns: outputs, loads seen through the matrix, discrepancy."""
    ends = np.cumsum(np.sum(mask, axis=1))
    total = np.zeros((ends[-1], ends[-1]))
    for r, end in enumerate(ends):
        own = stack.output_noise[r].covariance[0] + np.diag(np.tile(discrepancy[r] ** 2, 2))
        own = own + linear.through[r] @ stack.load_noise[r].covariance[0] @ linear.through[r].T
        start = end - np.count_nonzero(mask[r])
        total[start:end, start:end] = own[np.ix_(mask[r], mask[r])]
    return total


def _floored(noise: FloatArray, effects: FloatArray, readings: FloatArray) -> FloatArray:
    """Noise raised where it is far below the common errors, or below the digits of the readings."""
    floor = (NOISE_FLOOR * np.linalg.norm(effects, axis=1)) ** 2 + (DIGITS * np.max(np.abs(readings))) ** 2
    return np.asarray(noise + np.diag(np.maximum(floor - np.diag(noise), 0.0)))


def _loads(
    stack: Stack, point: _Point, linear: _Linear, rest: tuple[FloatArray, NDArray[np.bool_]], errors: FloatArray
) -> ComplexArray:
    """Loads (R, 6) at the errors found: what is left of a drive's outputs is shared with the noise of its load."""
    left, mask = rest
    full = np.zeros(mask.shape)
    full[mask] = left
    loads = np.empty_like(point.load)
    for r, reading in enumerate(stack.load):
        noise = -stack.load_noise[r].covariance[0] @ linear.through[r].T @ full[r]
        # Readings at the point, l(L, e) = L + E(L)·e, leave l - l(L, e) - E·(e_new - e) - noise to the step of L.
        apart = _tall((reading - point.load[r])[:, None])[:, 0] - linear.load_effect[r] @ errors - noise
        step = linear.load_step[r] @ apart
        loads[r] = point.load[r] + step[:LOADS] + 1j * step[LOADS:]
    return loads
