"""Stiffnesses and dampings from the resonances of several loads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.load_series.least_squares import minimum
from shaker.models.load_series.masses import SeriesMasses
from shaker.models.load_series.problem import Problem
from shaker.models.load_series.resonances import Resonances

STARTS = np.geomspace(0.03, 30.0, 9)
"""Ratios k_L/k from which the fit starts."""
ALIKE = 1e-2
"""Relative difference of parameters below which two minima are one."""
COARSE = (1e-2, 1e-1)
"""Relative scatter of frequencies and dampings with which minima are approached: their valleys are wide then."""
FARTHEST = 1e4
"""Ratio of the stiffnesses beyond which one of them means nothing."""
INDISTINCT = 3.84
"""Difference of chi-squared up to which a second minimum cannot be excluded (95 %)."""
CHANCE = 1e-3
"""Chance below which deviations are not explained by what is stated."""


@dataclass(frozen=True)
class SeriesFit:
    """Parameters of a load model from a series of R records.

    `numbers` (P,): stiffness, damping and those of the coupling unless rigid; dampings are 0 where none was measured.
    `deviates` (Q,): named mass errors in their standard uncertainties. `covariance` (P + Q, P + Q) of both, None where
    the scatter is unknown and cannot show. `frequency_hz`, `damping_ratio` (R, 2) of the model. `scatter`: relative
    standard deviations of frequencies and of dampings about the model beyond what is stated. `chi_squared` of both by
    what is stated alone, with degrees of freedom `dof`; `excess`: chi-squared over that of the best minimum.
    """

    numbers: FloatArray
    deviates: FloatArray
    covariance: FloatArray | None
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    scatter: tuple[float, float]
    chi_squared: tuple[float, float]
    dof: tuple[int, int]
    excess: float = 0.0

    @property
    def is_rigid(self) -> bool:
        """Whether the load was taken as rigid."""
        return len(self.numbers) == 2


def fit_resonances(measured: Resonances, masses: SeriesMasses, *, rigid: bool) -> tuple[SeriesFit, ...]:
    """Return the fits that explain frequencies and dampings best, more than one where the data cannot tell.

    Weighted least squares on ln f and ln ζ with every named mass error as an unknown of its own, from several starts.
    Scatter beyond what is stated is estimated as of random effects (Mandel & Paule 1970), of frequencies and dampings
    each by itself, where chance would explain it less than once in 1000, or where nothing is stated.
    """
    problem = Problem(measured, masses, rigid)
    none = (0.0, 0.0)
    best = _minima(problem, none)[0][0]
    scatter = _scatter(problem, best)
    found = _minima(problem, scatter)
    return tuple(_result(problem, x, scatter, excess) for x, excess in found)


def refined(
    problem: Problem, x: FloatArray, scatter: tuple[float, float], tolerance: float = 1e-10
) -> tuple[FloatArray, float]:
    """Return the unknowns (X,) at the minimum next to a start, and chi-squared there."""
    sigma = problem.sigma(scatter)
    return minimum(lambda x: problem.residual(x, sigma), x, tolerance)


def _minima(problem: Problem, scatter: tuple[float, float]) -> list[tuple[FloatArray, float]]:
    """Minima that cannot be excluded, the best first, with chi-squared beyond the best."""
    ratios = STARTS[:1] if problem.rigid else STARTS
    coarse = _distinct(problem, [refined(problem, problem.start(ratio), COARSE, 1e-5) for ratio in ratios])
    found = _distinct(problem, [refined(problem, x, scatter) for x, _ in coarse])
    return [(x, cost - found[0][1]) for x, cost in found if cost - found[0][1] <= INDISTINCT]


def _distinct(problem: Problem, found: list[tuple[FloatArray, float]]) -> list[tuple[FloatArray, float]]:
    """Minima that differ and mean something, the best first; the best at any rate."""
    ordered = sorted(found, key=lambda item: item[1])
    sound = [item for item in ordered if _is_sound(problem.numbers(item[0]))] or ordered[:1]
    kept: list[tuple[FloatArray, float]] = []
    for x, cost in sound:
        numbers = problem.numbers(x)[::2]
        if all(np.max(np.abs(numbers / problem.numbers(other)[::2] - 1.0)) > ALIKE for other, _ in kept):
            kept.append((x, cost))
    return kept


def _is_sound(numbers: FloatArray) -> bool:
    """Whether both stiffnesses mean something."""
    return len(numbers) == 2 or 1.0 / FARTHEST < numbers[2] / numbers[0] < FARTHEST


def _scatter(problem: Problem, x: FloatArray) -> tuple[float, float]:
    """Relative scatter of frequencies and dampings beyond what is stated: where chi-squared equals its freedom."""
    found = (0.0, 0.0)
    start = _groups(problem, x)
    wanted = [_exceeds(d, u, dof) for d, u, dof in zip(start, problem.stated(), problem.dof, strict=True)]
    for _ in range(50 if any(wanted) else 0):
        parts = zip(_groups(problem, x), problem.stated(), problem.dof, wanted, strict=True)
        f, z = (_tau(d, u, dof) if told else 0.0 for d, u, dof, told in parts)
        if np.allclose((f, z), found, rtol=1e-6, atol=0.0):
            break
        found = (f, z)
        x = refined(problem, x, found)[0]
    return found


def _groups(problem: Problem, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviations of ln f and of ln ζ."""
    count = len(problem.stated()[0])
    told = problem.residual(x, np.ones(sum(len(u) for u in problem.stated())))[0]
    return told[:count], told[count : count + len(problem.stated()[1])]


def _exceeds(deviation: FloatArray, u: FloatArray, dof: int) -> bool:
    """Whether deviations are larger than what is stated explains, or nothing is stated."""
    from scipy.special import chdtrc

    if dof < 1:
        return False
    return bool(np.any(u == 0.0)) or bool(chdtrc(dof, np.sum((deviation / u) ** 2)) < CHANCE)


def _tau(deviation: FloatArray, u: FloatArray, dof: int) -> float:
    """Solve Σ d²/(u² + τ²) = dof."""
    from scipy.optimize import brentq

    def beyond(tau: float) -> float:
        return float(np.sum(deviation**2 / (u**2 + tau**2))) - dof

    high = float(np.sqrt(np.sum(deviation**2) / dof))
    low = 1e-12 * high
    return float(brentq(beyond, low, high * (1.0 + 1e-9))) if high > 0.0 and beyond(low) > 0.0 else 0.0


def _result(problem: Problem, x: FloatArray, scatter: tuple[float, float], excess: float) -> SeriesFit:
    """The fit at its minimum."""
    _, slope = problem.residual(x, problem.sigma(scatter))
    (f, z), _ = problem.modes(x)
    groups = zip(_groups(problem, x), problem.stated(), strict=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        chi = [float(np.nansum((d / u) ** 2)) for d, u in groups]
    known = all(tau > 0.0 or bool(np.all(u > 0.0)) for tau, u in zip(scatter, problem.stated(), strict=True))
    inner: FloatArray = np.asarray(np.linalg.inv(slope.T @ slope))
    covariance = number_covariance(problem, x, inner) if known else None
    return SeriesFit(
        numbers=problem.numbers(x),
        deviates=problem.deviates(x),
        covariance=covariance,
        frequency_hz=f,
        damping_ratio=z,
        scatter=scatter,
        chi_squared=(chi[0], chi[1]),
        dof=problem.dof,
        excess=excess,
    )


def number_covariance(problem: Problem, x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (P + Q, P + Q) of numbers and named mass errors from that of the unknowns (X, X)."""
    rates, count = problem.number_rates(x), len(problem.deviates(x))
    turn = np.zeros((len(rates) + count, len(x)))
    turn[: len(rates), : rates.shape[1]] = rates
    turn[len(rates) :, rates.shape[1] :] = np.eye(count)
    return np.asarray(turn @ covariance @ turn.T)
