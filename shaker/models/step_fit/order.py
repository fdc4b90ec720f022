"""How many poles a record tells, how its load went, and how smoothly its response starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.reading import Reading
from shaker.models.step_fit.decay import CLEAR, decay_modes
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.output_error import Problem, Solution, gain_by, solve, squares
from shaker.models.step_fit.samples import Samples, block_length, in_blocks
from shaker.models.step_fit.structure import Structure
from shaker.models.step_fit.timing import LENGTHS, TERM, first_vectors, known_about

_CERTAIN = 4.0  # standard uncertainties of the release's length, as read, that make it worth a fit
_ROUNDING = 1e-9  # share of the output below which a residual is taken for rounding
_MISFIT = 1.5  # residual's variance over that of the noise before the release, above which a step is doubted


@dataclass(frozen=True)
class Search:
    """What is looked for in a record: `whole` its samples, `loads` that come into question, the plainest first;
    `modes` and `reals` where they are given; `colour` of the noise as in `Problem`."""

    whole: Samples
    reading: Reading
    loads: tuple[Load, ...]
    method: Literal["pencil", "arx"]
    modes: int | None
    reals: int | None
    colour: float = 1.0


def searched(search: Search) -> tuple[Solution, tuple[float, ...]]:
    """Return the fit that the record supports, and the sums of squares on the way.

    Modes are counted on the decay. A real pole stays where it lowers B·ln(sum of squares) by more than 12, a numerator
    term or a release that takes its time where by more than 8, B the number of blocks; coloured noise, which lowers it
    without any reason, asks for as much more as its density is higher.
    """
    modes, colour = decay_modes(_ringing(search), search.reading, search.method, search.modes)
    search = replace(search, colour=colour)
    found = _over_loads(search, modes, 1 if search.reals is None else search.reals)
    path = list(found.path)
    if search.reals is None:
        found = _other_reals(search, found, path)
    return found, tuple(path)


def _ringing(search: Search) -> Samples:
    """Return the samples without what simply follows a measured load, so that what rings is left."""
    load = search.loads[0].force
    if load is None:
        return search.whole
    follows = np.stack([np.ones(len(load)), load], axis=1)
    value = search.whole.value
    return replace(search.whole, value=value - follows @ np.linalg.lstsq(follows, value, rcond=None)[0])


def charge(plain: Solution, rich: Solution) -> float:
    """Return by how much B·ln(sum of squares) has to fall: 8 for a term or a release's length, 12 for a real pole."""
    terms = rich.problem.structure.terms - plain.problem.structure.terms
    lasting = rich.problem.load.lasting - plain.problem.load.lasting
    poles = rich.problem.structure.order - plain.problem.structure.order
    return rich.problem.colour * (TERM * (terms + lasting) + CLEAR * poles)


def better(plain: Solution, rich: Solution) -> bool:
    """Return whether a richer fit is worth its parameters."""
    samples = plain.problem.samples
    least = _ROUNDING**2 * float(np.sum((samples.weight * samples.value) ** 2))
    return plain.size * float(np.log((plain.square + least) / (rich.square + least))) > charge(plain, rich)


def _over_loads(search: Search, modes: ComplexArray, reals: int) -> Solution:
    """Return the best fit with given modes to start from, over the loads that come into question."""
    best = _fit_one(search, search.loads[0], modes, reals)
    lasts = search.reading.release_s > _CERTAIN * search.reading.u_release_s
    for load in search.loads[1:]:
        if best.problem.load.lasting or lasts or _doubted(search, best, load):
            trial = _fit_one(search, load, modes, reals)
            best = trial if better(best, trial) else best
    return best


def _doubted(search: Search, step: Solution, load: Load) -> bool:
    """Return whether a release that takes its time is worth a fit, beside a step."""
    structure = step.problem.structure
    if step.variance > _MISFIT * search.colour * search.reading.noise**2 or structure.terms > structure.smoothest:
        return True
    lengths = np.log(search.reading.rise_s * np.array(LENGTHS))
    vectors = [np.append(step.vector, length) for length in lengths]
    return gain_by(step, replace(step.problem, load=load), vectors)[0] > TERM * search.colour


def _fit_one(search: Search, load: Load, modes: ComplexArray, reals: int) -> Solution:
    """Return the fit for one load, with the numerator terms that it needs."""
    reading, whole = search.reading, search.whole
    highest, lowest = (float(edge) / (2 * np.pi) for edge in (np.abs(modes).max(), np.abs(modes).min()))
    structure = Structure(len(modes), reals, 1, float(np.exp(np.mean(np.log(np.abs(modes))))))
    margin = 0.5 / lowest + 3.0 * whole.step_s
    end = reading.onset_s + reading.release_s + 2.0 * margin
    samples = in_blocks(whole, reading.onset_s - margin, end, block_length(1.0 / whole.step_s, highest))
    starts = first_vectors(structure, load, samples, modes, reading)
    problem = Problem(structure, load, samples, starts[0], starts[0], reading.onset_s, search.colour)
    return more_terms(solve(*known_about(problem, starts[0], highest)), starts, highest)


def more_terms(found: Solution, starts: list[FloatArray], highest_hz: float) -> Solution:
    """Return the fit with the numerator terms that it is worth, each tried from the last fit or from its own start."""
    problem = found.problem
    for terms in range(2, problem.structure.order + 1):
        richer = replace(problem, structure=problem.structure.with_terms(terms))
        gain, _ = gain_by(found, richer, [found.vector, starts[terms - 1]])
        if gain > TERM * problem.colour * (terms - found.problem.structure.terms):
            start = min(found.vector, starts[terms - 1], key=lambda vector: squares(richer, vector)[-1])
            firm = 1.0 if terms <= problem.structure.smoothest else 6.0
            trial = solve(*known_about(richer, start, firm * highest_hz))
            found = replace(trial, path=found.path + trial.path) if better(found, trial) else found
    return found


def _other_reals(search: Search, found: Solution, path: list[float]) -> Solution:
    """Return the fit with no, one or two real poles, as the rule has it."""
    structure, order = found.problem.structure, found.problem.structure.order
    modes = structure.poles(found.vector)[: structure.modes]
    fewer = _fit_one(replace(search, loads=(found.problem.load,)), found.problem.load, modes, 0)
    path += fewer.path
    if not better(fewer, found):
        return fewer
    two = replace(found.problem, structure=replace(structure, reals=2))
    starts = [np.insert(found.vector, order, found.vector[order - 1] + further) for further in (-0.7, 0.7, 1.6)]
    gain, start = gain_by(found, two, starts)
    if gain < CLEAR * search.colour:
        return found
    more = solve(*known_about(two, start, float(np.abs(modes).max()) / (2 * np.pi)))
    path += more.path
    return more if better(found, more) else found
