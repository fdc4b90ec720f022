"""Output-error least squares: linear parameters projected out, the others by Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step_fit.load import Answers, Load, answers, responses
from shaker.models.step_fit.samples import Samples
from shaker.models.step_fit.structure import Structure

_STEPS = 60  # Levenberg-Marquardt steps, more than any solvable case was seen to take
_ENOUGH = 1e-4  # predicted fall of the sum of squares, over the variance, below which a step changes nothing
_STUCK = 1e9  # damping at which no step is left that helps
_STEEPEST = 0.995  # largest |ζ| of an oscillating mode


@dataclass(frozen=True)
class Problem:
    """What is fitted: a structure's answer to a load, to samples.

    Parameters: those of the structure, then the release's middle in s (a timed load) and the logarithm of its length
    in s (a lasting one). `known`, `u_known` (K,): what is known of them beforehand, wide, infinitely so for the modes:
    a record that does not tell the real poles or the release is solved all the same. `onset_s` of a load without one;
    `colour`: density of the blocks' noise over that of white noise with the samples' variance, 1 where it is white.
    """

    structure: Structure
    load: Load
    samples: Samples
    known: FloatArray
    u_known: FloatArray
    onset_s: float = 0.0
    colour: float = 1.0

    @property
    def count(self) -> int:
        """Number of parameters that the answer depends on nonlinearly."""
        return self.structure.order + self.load.timed + self.load.lasting

    def release(self, vector: FloatArray) -> tuple[float, float]:
        """Return the middle and the length of the release in s."""
        order = self.structure.order
        middle = float(vector[order]) if self.load.timed else self.onset_s
        return middle, float(np.exp(vector[order + 1])) if self.load.lasting else 0.0


@dataclass(frozen=True)
class Solution:
    """A fit: `vector` of the nonlinear parameters, `linear` [baseline, numerator terms], `square` weighted sum of
    squares of the residual, `path` of it over the steps; `problem` that was solved."""

    problem: Problem
    vector: FloatArray
    linear: FloatArray
    square: float
    path: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Number of blocks."""
        return len(self.problem.samples.value)

    @property
    def free(self) -> int:
        """Number of all parameters."""
        return len(self.vector) + len(self.linear)

    @property
    def variance(self) -> float:
        """Variance of a sample's noise by the residual."""
        return self.square / max(1, self.size - self.free)

    @property
    def residues(self) -> ComplexArray:
        """Residues (M + Q,) in output unit per load unit and second, upper poles first, real ones last."""
        shares, _ = self.problem.structure.shares(self.vector)
        return np.asarray(shares @ self.linear[1:])


def columns(problem: Problem, vector: FloatArray, samples: Samples) -> tuple[FloatArray, Answers]:
    """Return the design (B, 1 + terms) of baseline and numerator terms, unweighted, and the poles' answers."""
    middle, length = problem.release(vector)
    found = answers(problem.load, problem.structure.poles(vector), samples, middle, length)
    return _design(problem, vector, found.value), found


def design(problem: Problem, vector: FloatArray, samples: Samples) -> FloatArray:
    """Return the design of `columns` alone."""
    middle, length = problem.release(vector)
    poles = problem.structure.poles(vector)
    return _design(problem, vector, responses(problem.load, poles, samples, middle, length))


def _design(problem: Problem, vector: FloatArray, value: ComplexArray) -> FloatArray:
    """Return the design of the poles' responses (B, P)."""
    shares, _ = problem.structure.shares(vector)
    parts = np.real(value @ (_twice(problem.structure)[:, None] * shares))
    return np.concatenate([np.ones((len(parts), 1)), parts], axis=1)


def slopes(problem: Problem, vector: FloatArray, linear: FloatArray, found: Answers) -> FloatArray:
    """Return derivatives (B, K) of the fitted output to the nonlinear parameters, unweighted."""
    structure = problem.structure
    shares, by_vector = structure.shares(vector)
    twice = _twice(structure)
    residues, moved = twice * (shares @ linear[1:]), twice[:, None] * np.einsum("pkm,k->pm", by_vector, linear[1:])
    poles = structure.pole_slopes(vector) * residues[:, None]
    out = [np.real(found.by_pole @ poles + found.value @ moved)]
    if problem.load.timed:
        out.append(np.real(found.by_onset @ residues)[:, None])
    if problem.load.lasting:
        out.append(np.exp(vector[-1]) * np.real(found.by_length @ residues)[:, None])
    return np.concatenate(out, axis=1)


def squares(problem: Problem, vector: FloatArray) -> FloatArray:
    """Return the weighted sums of squares (terms,) that 1, 2, … numerator terms leave, by one factorisation."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = design(problem, vector, problem.samples)
    whole = np.concatenate([found, problem.samples.value[:, None]], axis=1) * problem.samples.weight[:, None]
    if not np.all(np.isfinite(whole)):
        return np.full(problem.structure.terms, np.inf)
    last = np.asarray(np.linalg.qr(whole)[1])[:, -1]
    return np.asarray(np.cumsum(last[::-1] ** 2)[::-1][2:])


def solve(problem: Problem, start: FloatArray) -> Solution:
    """Return the fit from a start vector (K,), by variable projection with Kaufman's derivative."""
    now, damping = _at(problem, start), 1e-3
    path = [now.solution.square]
    for _ in range(_STEPS):
        jacobian, rest = _projected(now)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ rest
        trial = now
        while trial is now:
            step = _step(normal, gradient, damping)
            if float(step @ (2.0 * gradient - normal @ step)) < _ENOUGH * now.solution.variance or damping > _STUCK:
                return replace(now.solution, path=tuple(path))
            further = _at(problem, now.solution.vector + step)
            if _cost(further.solution, now.solution.variance) < _cost(now.solution, now.solution.variance):
                trial = further
            else:
                damping *= 10.0
        damping, now = max(1e-8, damping * 0.03), trial
        path.append(now.solution.square)
    return replace(now.solution, path=tuple(path))


def gain_by(found: Solution, problem: Problem, vectors: list[FloatArray]) -> tuple[float, FloatArray]:
    """Return how much of B·ln(sum of squares) a fit would lose by a step towards a richer model, and the best vector.

    The richer model's design at each vector joins the fit's own design and derivatives; what the three together leave
    of the samples tells, without a solution, whether the richer model is worth one.
    """
    weight = found.problem.samples.weight[:, None]
    own_design, answers_ = columns(found.problem, found.vector, found.problem.samples)
    own = np.concatenate([own_design, slopes(found.problem, found.vector, found.linear, answers_)], axis=1)
    value = found.problem.samples.value * weight[:, 0]
    best, chosen = 0.0, vectors[0]
    for vector in vectors:
        whole = np.concatenate([own, design(problem, vector, found.problem.samples)], axis=1) * weight
        left = value - whole @ _linear(whole, value)
        gain = found.size * float(np.log(found.square / (left @ left)))
        if gain > best:
            best, chosen = gain, vector
    return best, chosen


@dataclass(frozen=True)
class _Trial:
    """A solution with its unweighted design (B, 1 + terms) and the poles' answers."""

    solution: Solution
    design: FloatArray
    found: Answers


def _cost(solution: Solution, variance: float) -> float:
    """Return the sum of squares with the pull of what was known beforehand."""
    pull = (solution.vector - solution.problem.known) / solution.problem.u_known
    return solution.square + float(pull @ pull) * variance


def _step(normal: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """Return the damped step; the damping follows the parameters' own scales."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale / scale[:, None] + damping * np.eye(len(scale))
    return np.asarray(np.linalg.lstsq(scaled, gradient / scale, rcond=None)[0] / scale)


def _at(problem: Problem, vector: FloatArray) -> _Trial:
    """Return the best baseline and numerator for given poles and release; what is impossible costs infinitely much."""
    blank = np.zeros((0, 0), dtype=np.complex128)
    nowhere = Solution(problem, vector, np.zeros(1 + problem.structure.terms), np.inf)
    if not _possible(problem, vector):
        return _Trial(nowhere, np.zeros((0, 0)), Answers(blank, blank, blank, blank))
    weight = problem.samples.weight
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, found = columns(problem, vector, problem.samples)
    if not np.all(np.isfinite(matrix)):
        return _Trial(nowhere, matrix, found)
    linear = _linear(matrix * weight[:, None], problem.samples.value * weight)
    rest = (problem.samples.value - matrix @ linear) * weight
    return _Trial(Solution(problem, vector, linear, float(rest @ rest)), matrix, found)


def _possible(problem: Problem, vector: FloatArray) -> bool:
    """Return whether modes oscillate, poles are numbers and the release is no longer than the record."""
    modes, order = problem.structure.modes, problem.structure.order
    time_s = problem.samples.time_s
    longest = np.log(time_s[-1] - time_s[0])
    steep = np.any(np.abs(vector[modes : 2 * modes]) > _STEEPEST)
    return not (steep or np.any(np.abs(vector[:order]) > 50.0) or (problem.load.lasting and vector[-1] > longest))


def _linear(matrix: FloatArray, value: FloatArray) -> FloatArray:
    """Return the coefficients of the columns by least squares, columns scaled."""
    scale = np.sqrt(np.einsum("bk,bk->k", matrix, matrix))
    scale[scale == 0] = 1.0
    q, r = np.linalg.qr(matrix / scale)
    diagonal = np.abs(np.diag(r))
    if diagonal.min() < 1e-12 * diagonal.max():
        return np.asarray(np.linalg.lstsq(matrix / scale, value, rcond=1e-12)[0] / scale)
    return np.asarray(np.linalg.solve(r, q.T @ value) / scale)


def _projected(now: _Trial) -> tuple[FloatArray, FloatArray]:
    """Return Kaufman's derivative and residual, weighted, with the rows of what was known beforehand."""
    solution, problem = now.solution, now.solution.problem
    weight = problem.samples.weight[:, None]
    jacobian = slopes(problem, solution.vector, solution.linear, now.found) * weight
    q, _ = np.linalg.qr(now.design * weight)
    jacobian = jacobian - q @ (q.T @ jacobian)
    rest = (problem.samples.value - now.design @ solution.linear) * weight[:, 0]
    firm = np.sqrt(solution.variance) / problem.u_known
    pull = (problem.known - solution.vector) * firm
    return np.concatenate([jacobian, np.diag(firm)]), np.concatenate([rest, pull])


def _twice(structure: Structure) -> FloatArray:
    """Return 2 for every upper pole, which stands for its conjugate too, and 1 for every real one."""
    return np.concatenate([np.full(structure.modes, 2.0), np.ones(structure.reals)])
