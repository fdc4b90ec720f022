"""How many poles records of several releases ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.decoupling.projection import Block, Projected, Solution, minimise, project
from shaker.models.decoupling.start import shared_poles
from shaker.models.decoupling.step_data import Poles, Release, StepProblem, decay_start

_ROUNDS = 12
_CANDIDATES = 6
_FEW_STEPS = 12
_REAL_SHARES = (0.3, 1.0, 3.0)
_HIGHEST_REAL = 0.45


@dataclass(frozen=True)
class Trial:
    """One number of poles that was tried: `misfit` is the mean square residual over that of the noise, `criterion`
    N·ln(misfit) + ln(N)·(number of parameters), of which the least wins (Schwarz, Ann. Statist. 6 (1978) 461)."""

    modes: int
    reals: int
    misfit: float
    criterion: float
    kept: bool


@dataclass(frozen=True)
class Fitted:
    """Poles and releases with the least squares solution they come from."""

    poles: Poles
    releases: tuple[Release, ...]
    solution: Solution


def fit_poles(problem: StepProblem, poles: Poles, releases: Sequence[Release], steps: int = 40) -> Fitted:
    """Return the least squares poles and releases from a start."""

    def blocks_at(vector: FloatArray) -> list[Block] | None:
        parts = problem.split(vector, poles, releases)
        return None if parts is None else problem.blocks(*parts)

    solution = minimise(blocks_at, problem.vector(poles, releases), problem.scale(poles), steps)
    found = problem.split(solution.parameters, poles, releases)
    if found is None:
        raise ValueError("poles: expected allowed ones at the end of a fit, found none")
    return Fitted(*found, solution)


def chosen(
    problem: StepProblem, start: Poles, releases: Sequence[Release], most: int | None = None, reals: int | None = None
) -> tuple[Fitted, list[Trial]]:
    """Return the fit with the number of poles that the criterion favours, and what was tried.

    Modes that the start offers and the records do not ask for are left out one by one; then modes that the residual
    shows, and real poles, are added as long as the criterion falls. `most`, `reals`: the highest numbers of modes and
    of real poles.
    """
    poles = _pruned(problem, start, releases, most)
    here = fit_poles(problem, poles, releases, _FEW_STEPS)
    trials = [_trial(problem, here, kept=True)]
    for _ in range(_ROUNDS):
        smaller = _smaller(problem, here, most)
        larger = None if smaller is not None else _larger(problem, here, most, reals)
        found = smaller or larger
        if found is None:
            break
        trials.append(_trial(problem, found, kept=True))
        if trials[-1].criterion >= _trial(problem, here, kept=True).criterion:
            trials[-1] = replace(trials[-1], kept=False)
            break
        here = found
    return fit_poles(problem, here.poles, here.releases), trials


def criterion(problem: StepProblem, poles: Poles, loss: float) -> float:
    """Return N·ln(loss/N) + ln(N)·(number of parameters), where a loss below that of the noise counts as the noise."""
    count, outputs = problem.values, problem.records[0].data.shape[1]
    parameters = poles.count * (1 + outputs * len(problem.components))
    return float(count * np.log(max(loss / count, 1e-12)) + np.log(count) * parameters)


def _trial(problem: StepProblem, fitted: Fitted, *, kept: bool) -> Trial:
    """The entry of one fit in the list of trials."""
    loss, poles = fitted.solution.projected.loss, fitted.poles
    value = criterion(problem, poles, loss)
    return Trial(poles.modes, len(poles.real_hz), loss / problem.values, value, kept)


def removal_losses(poles: Poles, blocks: Sequence[Block], projected: Projected) -> FloatArray:
    """Return how much the loss grows without each pole (M + Q,), the others held: b'·[(A'A)⁻¹ of its columns]⁻¹·b."""
    count = poles.modes + len(poles.real_hz)
    found = np.zeros(count)
    for block, own in zip(blocks, projected.coefficients, strict=True):
        inverse = np.linalg.pinv(block.design.T @ block.design, rcond=1e-14, hermitian=True)
        for place in range(count):
            columns = poles.columns(place)
            part = np.linalg.pinv(inverse[np.ix_(columns, columns)], hermitian=True)
            found[place] += float(np.einsum("bc,bd,dc->", own[columns], part, own[columns]))
    return found


def _pruned(problem: StepProblem, poles: Poles, releases: Sequence[Release], most: int | None) -> Poles:
    """Leave modes of a start out while the criterion falls, or down to the highest number."""
    while poles.modes > 1:
        blocks = problem.blocks(poles, releases)
        projected = project(blocks, poles.count + 2 * len(releases))
        losses = removal_losses(poles, blocks, projected)[: poles.modes]
        weakest = int(np.argmin(losses))
        fewer = poles.without(weakest)
        falls = criterion(problem, fewer, projected.loss + losses[weakest]) < criterion(problem, poles, projected.loss)
        if not (falls or (most is not None and poles.modes > most)):
            break
        poles = fewer
    return poles


def _smaller(problem: StepProblem, here: Fitted, most: int | None) -> Fitted | None:
    """The fit without the weakest mode, None where the criterion needs all."""
    poles = here.poles
    if poles.modes < 2 or (most is not None and poles.modes <= most):
        return None
    losses = removal_losses(poles, here.solution.blocks, here.solution.projected)[: poles.modes]
    weakest = int(np.argmin(losses))
    loss = here.solution.projected.loss
    if criterion(problem, poles.without(weakest), loss + losses[weakest]) >= criterion(problem, poles, loss):
        return None
    return fit_poles(problem, poles.without(weakest), here.releases, _FEW_STEPS)


def _larger(problem: StepProblem, here: Fitted, most: int | None, reals: int | None) -> Fitted | None:
    """The fit with the mode or the real pole that lowers the loss most, None where the numbers are reached."""
    offers: list[Poles] = []
    if most is None or here.poles.modes < most:
        offers += [here.poles.with_mode(complex(pole)) for pole in _left(problem, here)]
    if reals is None or len(here.poles.real_hz) < reals:
        top = float(here.poles.frequency_hz.max())
        limit = _HIGHEST_REAL * problem.records[0].blocks.rate_hz
        offers += [here.poles.with_real(min(share * top, limit)) for share in _REAL_SHARES]
    if not offers:
        return None
    timed = 2 * len(here.releases)
    losses = [project(problem.blocks(offer, here.releases), offer.count + timed).loss for offer in offers]
    tried = [fit_poles(problem, offers[i], here.releases, _FEW_STEPS) for i in np.argsort(losses)[:2]]
    return min(tried, key=lambda fitted: criterion(problem, fitted.poles, fitted.solution.projected.loss))


def _left(problem: StepProblem, here: Fitted) -> ComplexArray:
    """Poles of what the fit leaves after the releases, the strongest first."""
    parts = []
    for component, rest in zip(problem.components, here.solution.projected.residuals, strict=True):
        row = 0
        for record, release in zip(problem.records, here.releases, strict=True):
            if record.component == component:
                rows = rest[row : row + record.blocks.count]
                parts.append(rows[decay_start(record.blocks, release) :].T)
                row += record.blocks.count
    rate = problem.records[0].blocks.rate_hz / problem.records[0].blocks.size
    found = shared_poles(parts, rate)
    return np.asarray(found[np.argsort(-found.real)][:_CANDIDATES])
