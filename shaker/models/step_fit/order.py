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
from shaker.models.step_fit.timing import TERM, first_vectors, known_about

_CERTAIN = 4.0  # standard uncertainties of the release's length, as read, from which on its shape may be told
_SHORT = 0.25  # periods of the fastest mode that a release has to last for its shape to matter
_ROUNDING = 1e-9  # share of the output below which a residual is taken for rounding


@dataclass(frozen=True)
class Search:
    """What is looked for in a record: `whole` its samples, `loads` that come into question, the likeliest first;
    `modes` and `reals` where they are given; `colour` of the noise as in `Problem`."""

    whole: Samples
    reading: Reading
    loads: tuple[Load, ...]
    method: Literal["pencil", "arx"]
    modes: int | None
    reals: int | None
    colour: float = 1.0


@dataclass(frozen=True)
class Found:
    """The fit that a record supports, the sums of squares on the way, and a fit with another shape of the release that
    the record tells hardly from it, None where there is none."""

    solution: Solution
    path: tuple[float, ...]
    rival: Solution | None = None


def searched(search: Search) -> Found:
    """Return the fit that the record supports.

    Modes are counted on the decay. One real pole and the length of the release are always fitted: a lag or a release
    too short to be told changes the amplitude and the phase of the ringing all the same, and a model without it states
    a certainty that the record does not give. A second real pole is there where it lowers B·ln(sum of squares) by more
    than 12, a numerator term or another shape of the release where by more than 8, B the number of blocks; coloured
    noise, which lowers it without any reason, asks for as much more as its density is higher.
    """
    modes, colour = decay_modes(_ringing(search), search.reading, search.method, search.modes)
    search = replace(search, colour=colour)
    found, rival = _over_loads(search, modes, 1 if search.reals is None else search.reals)
    path = list(found.path)
    if search.reals is None:
        found = _second_real(search, found, path)
    return Found(found, tuple(path), rival)


def _ringing(search: Search) -> Samples:
    """Return the samples without what simply follows a measured load, so that what rings is left."""
    load = search.loads[0].force
    if load is None:
        return search.whole
    follows = np.stack([np.ones(len(load)), load], axis=1)
    value = search.whole.value
    return replace(search.whole, value=value - follows @ np.linalg.lstsq(follows, value, rcond=None)[0])


def charge(plain: Solution, rich: Solution) -> float:
    """Return by how much B·ln(sum of squares) has to fall: 8 for a term or another release, 12 for a real pole."""
    terms = rich.problem.structure.terms - plain.problem.structure.terms
    other = rich.problem.load.shape != plain.problem.load.shape
    poles = rich.problem.structure.order - plain.problem.structure.order
    return rich.problem.colour * (TERM * (terms + other) + CLEAR * poles)


def better(plain: Solution, rich: Solution) -> bool:
    """Return whether a richer fit is worth its parameters."""
    samples = plain.problem.samples
    least = _ROUNDING**2 * float(np.sum((samples.weight * samples.value) ** 2))
    return plain.size * float(np.log((plain.square + least) / (rich.square + least))) > charge(plain, rich)


def _over_loads(search: Search, modes: ComplexArray, reals: int) -> tuple[Solution, Solution | None]:
    """Return the best fit with given modes to start from over the loads that come into question, and its rival.

    The shape is not looked for of a release whose length cannot be told, or that is short to the fastest mode.
    """
    best, rival = _fit_one(search, search.loads[0], modes, reals), None
    highest = float(np.abs(modes).max()) / (2 * np.pi)
    if search.reading.release_s < max(_CERTAIN * search.reading.u_release_s, _SHORT / highest):
        return best, rival
    for load in search.loads[1:]:
        trial = _fit_one(search, load, modes, reals)
        if better(best, trial):
            best, trial = trial, best
        rival = trial if not better(trial, best) else rival
    return best, rival


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


def _second_real(search: Search, found: Solution, path: list[float]) -> Solution:
    """Return the fit with a second real pole, where it is worth it."""
    structure, order = found.problem.structure, found.problem.structure.order
    two = replace(found.problem, structure=replace(structure, reals=2))
    starts = [np.insert(found.vector, order, found.vector[order - 1] + further) for further in (-0.7, 0.7, 1.6)]
    gain, start = gain_by(found, two, starts)
    if gain < CLEAR * search.colour:
        return found
    highest = float(np.exp(found.vector[: structure.modes].max())) / (2 * np.pi)
    more = solve(*known_about(two, start, highest))
    path += more.path
    return more if better(found, more) else found
