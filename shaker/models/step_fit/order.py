"""How many poles a record tells, how its load went, and how smoothly its response starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.reading import Reading
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.output_error import Problem, Solution, columns, gain_by, solve
from shaker.models.step_fit.samples import Samples, block_length, in_blocks
from shaker.models.step_fit.start import instruments, peaks_hz, pencil, thinned, upper_poles
from shaker.models.step_fit.structure import Structure
from shaker.models.step_fit.timing import LENGTHS, first_vector

_MOST = 4  # modes that the rule looks for
_CLEAR = 12.0  # fall of the sum of squares, over the variance, by a parameter that is taken for real
_MISFIT = 1.5  # residual's variance over that of the noise before the release, above which a step is doubted
_LOOSE = 0.6  # periods over 2π that the onset may move where further numerator terms take over what tells it
_HINT = 6.0  # the same for a numerator term, which costs little where it is not needed


@dataclass(frozen=True)
class Search:
    """What is looked for in a record: `whole` its samples, `loads` that come into question, the plainest first;
    `modes` and `reals` where they are given."""

    whole: Samples
    reading: Reading
    loads: tuple[Load, ...]
    method: Literal["pencil", "arx"]
    modes: int | None
    reals: int | None


def searched(search: Search) -> tuple[Solution, tuple[float, ...]]:
    """Return the fit that the record supports, and the sums of squares on the way.

    The rule: a pole pair, a real pole, a release that takes its time or a numerator term stays where it lowers
    B·ln(sum of squares) by more than 12 (6 for a term) per parameter, B the number of blocks.
    """
    modes = _first_modes(search, search.modes or 1)
    found = _fitted(search, modes, 1 if search.reals is None else search.reals)
    path = list(found.path)
    if search.modes is None:
        found = _more_modes(search, found, path)
    if search.reals is None:
        found = _other_reals(search, found, path)
    return _more_terms(found), tuple(path)


def _decay(whole: Samples, reading: Reading) -> FloatArray:
    """Return what follows the release (N,)."""
    start = reading.onset_s + reading.release_s + reading.u_onset_s
    first = min(int(np.searchsorted(whole.time_s, start)), len(whole.value) * 3 // 4)
    return whole.value[first:]


def _first_modes(search: Search, count: int) -> ComplexArray:
    """Return upper poles (count,) of the decay by the method asked for."""
    decay, step = _decay(search.whole, search.reading), search.whole.step_s
    near = peaks_hz(decay, step, count)
    if not near.size:
        raise ValueError(f"{search.reading.record}, {search.reading.channel}: no oscillation above the noise")
    values, coarse = thinned(decay, step, float(near.max()))
    find = pencil if search.method == "pencil" else instruments
    return upper_poles(find(values - values.mean(), coarse, 2 * count + 1), count, near)


def _fitted(search: Search, modes: ComplexArray, reals: int) -> Solution:
    """Return the best fit with given modes to start from, over the loads that come into question."""
    best = _fit_one(search, search.loads[0], modes, reals)
    for load in search.loads[1:]:
        if not best.problem.load.lasting and not _lasting(search, best, load):
            return best
        trial = _fit_one(search, load, modes, reals)
        if _gain(best, trial) > _CLEAR * (trial.free - best.free):
            best = trial
        elif not best.problem.load.lasting:
            return best
    return best


def _lasting(search: Search, step: Solution, load: Load) -> bool:
    """Return whether a release that takes its time is worth a fit."""
    if step.variance > _MISFIT * search.reading.noise**2:
        return True
    problem = replace(step.problem, load=load)
    lengths = np.log(search.reading.rise_s * np.array(LENGTHS))
    return gain_by(step, problem, [np.append(step.vector, length) for length in lengths])[0] > _CLEAR


def _fit_one(search: Search, load: Load, modes: ComplexArray, reals: int) -> Solution:
    """Return the fit for one load."""
    reading, whole = search.reading, search.whole
    highest, lowest = (float(edge) / (2 * np.pi) for edge in (np.abs(modes).max(), np.abs(modes).min()))
    structure = Structure(len(modes), reals, 1, float(np.exp(np.mean(np.log(np.abs(modes))))))
    structure = structure.with_terms(structure.smoothest)
    margin = 0.5 / lowest + 3.0 * whole.step_s
    length = block_length(1.0 / whole.step_s, highest)
    samples = in_blocks(whole, reading.onset_s - margin, reading.onset_s + reading.release_s + 2.0 * margin, length)
    start = first_vector(structure, load, samples, modes, reading)
    timing = start[structure.order :] if load.timed else np.array([reading.onset_s])
    return solve(Problem(structure, load, samples, timing, np.array([1.0 / lowest, 2.0])), start)


def _gain(plain: Solution, rich: Solution) -> float:
    """Return by how much the richer fit lowers B·ln(sum of squares)."""
    return plain.size * float(np.log(plain.square / rich.square))


def _more_modes(search: Search, found: Solution, path: list[float]) -> Solution:
    """Return the fit with as many modes as the rule lets stay; further ones are looked for in the residual."""
    while found.problem.structure.modes < _MOST:
        structure = found.problem.structure
        design, _ = columns(found.problem, found.vector, search.whole)
        rest = search.whole.value - design @ found.linear
        decay = _decay(replace(search.whole, value=rest), search.reading)
        near = peaks_hz(decay, search.whole.step_s, 1)
        if not near.size:
            return found
        values, coarse = thinned(decay, search.whole.step_s, float(near[0]))
        extra = upper_poles(pencil(values - values.mean(), coarse, 3), 1, near)
        known = structure.poles(found.vector)[: structure.modes]
        modes = np.concatenate([known, extra])
        trial = _fitted(search, modes[np.argsort(np.abs(modes))], structure.reals)
        path += trial.path
        if _gain(found, trial) < _CLEAR * (trial.free - found.free):
            return found
        found = trial
    return found


def _other_reals(search: Search, found: Solution, path: list[float]) -> Solution:
    """Return the fit with no, one or two real poles, as the rule has it."""
    structure = found.problem.structure
    order, modes = structure.order, 2 * structure.modes
    none = replace(found.problem, structure=replace(structure, reals=0))
    late = found.vector[order:] + np.exp(-found.vector[order - 1]) * (np.arange(len(found.vector) - order) == 0)
    fewer = solve(none, np.concatenate([found.vector[:modes], late]))
    path += fewer.path
    if _gain(fewer, found) < _CLEAR:
        return fewer
    two = replace(found.problem, structure=replace(structure, reals=2))
    starts = [np.insert(found.vector, order, found.vector[order - 1] + further) for further in (-0.7, 0.7, 1.6)]
    gain, start = gain_by(found, two, starts)
    if gain < _CLEAR:
        return found
    more = solve(two, start)
    path += more.path
    return more if _gain(found, more) > _CLEAR else found


def _more_terms(found: Solution) -> Solution:
    """Return the fit with as many numerator terms as the rule lets stay, from the smoothest start on."""
    problem, order = found.problem, found.problem.structure.order
    known = found.vector[order:] if problem.load.timed else problem.timing
    tight = np.array([_LOOSE / float(np.exp(found.vector[0])), 2.0])
    for terms in range(problem.structure.terms + 1, order + 1):
        richer = Problem(problem.structure.with_terms(terms), problem.load, problem.samples, known, tight)
        enough = _HINT * (terms - found.problem.structure.terms)
        if gain_by(found, richer, [found.vector])[0] > enough:
            trial = solve(richer, found.vector)
            found = trial if _gain(found, trial) > enough else found
    return found
