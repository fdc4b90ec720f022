"""When and how a load goes, how fast the real poles are, how smooth the start is: the best of a grid, modes known."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.reading import Reading
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.output_error import Problem, squares
from shaker.models.step_fit.samples import Samples
from shaker.models.step_fit.structure import Structure

LENGTHS = (0.25, 0.6, 1.2)  # lengths of the release tried, in rise times
TERM = 8.0  # fall of B·ln(sum of squares) by a numerator term that is taken for real
_REAL = (1.5, 4.0, 10.0)  # real poles tried, in frequencies of the lowest mode
_LAG = (0.0, 0.08, 0.17, 0.25)  # periods by which the half-way point follows the middle of the release
_LOOSE = (1.5, 2.0)  # standard deviations of what the grid says of logarithms of real poles and of the length


def first_vectors(
    structure: Structure, load: Load, samples: Samples, modes: ComplexArray, reading: Reading
) -> list[FloatArray]:
    """Return, for every number of numerator terms up to all, the grid point that leaves least about the release."""
    lowest = float(np.abs(modes).min()) / (2 * np.pi)
    rise = min(reading.rise_s, 3.0 / lowest + reading.release_s)
    near = samples.between(reading.onset_s - 2.0 / lowest, reading.onset_s + reading.release_s + rise + 2.0 / lowest)
    rich = structure.with_terms(structure.order)
    best, found = np.full(rich.terms, np.inf), [np.zeros(0)] * rich.terms
    for vector in _grid(structure, load, near, modes, reading, rise):
        costs = squares(Problem(rich, load, near, vector, np.ones(len(vector)), reading.onset_s), vector)
        found = [vector if cost < old else kept for cost, old, kept in zip(costs, best, found, strict=True)]
        best = np.minimum(best, costs)
    return found


def known_about(problem: Problem, vector: FloatArray, highest_hz: float) -> tuple[Problem, FloatArray]:
    """Return a problem that knows a vector beforehand, widely, and the vector; the onset to 1/`highest_hz`."""
    modes, order = problem.structure.modes, problem.structure.order
    wide = np.full(len(vector), np.inf)
    wide[2 * modes : order] = _LOOSE[0]
    wide[order : order + 2] = np.array([1.0 / highest_hz, _LOOSE[1]])[: len(vector) - order]
    return replace(problem, known=vector, u_known=wide), vector


def _grid(
    structure: Structure, load: Load, near: Samples, modes: ComplexArray, reading: Reading, rise: float
) -> list[FloatArray]:
    """Return the vectors that are tried."""
    lowest = float(np.abs(modes).min()) / (2 * np.pi)
    half, found = _half_way(near, reading), []
    lengths = np.array(LENGTHS) * rise if load.lasting else np.zeros(1)
    if load.lasting and reading.release_s > 0:
        lengths = np.array([reading.release_s])
    for reals in _real_poles(structure.reals, lowest, 0.4 / near.step_s):
        head = structure.vector(np.concatenate([modes, reals]))
        lag = float(np.sum(-1.0 / reals.real))
        for length in lengths:
            tail = [np.log(length)] if load.lasting else []
            middles = [half - lag - share / lowest for share in _LAG] + [reading.onset_s + 0.5 * length]
            for middle in middles if load.timed else [0.0]:
                found.append(np.concatenate([head, [middle] if load.timed else [], tail]))
    return found


def _real_poles(count: int, lowest: float, fastest: float) -> list[ComplexArray]:
    """Return the sets (Q,) of real poles that are tried, in rad/s, rising within a set."""
    values = [min(share * lowest, fastest) for share in _REAL]
    sets = [pick for pick in product(values, repeat=count) if list(pick) == sorted(pick)]
    spread = 1.0 + 0.2 * np.arange(count)
    return [-2 * np.pi * np.array(pick) * spread + 0j for pick in sets]


def _half_way(near: Samples, reading: Reading) -> float:
    """Return when the output is first half-way to its new level."""
    change = reading.steady - reading.baseline
    passed = np.flatnonzero((near.value - reading.baseline) * change >= 0.5 * change**2)
    later = passed[near.time_s[passed] >= reading.onset_s]
    return float(near.time_s[later[0]]) if later.size else reading.onset_s
