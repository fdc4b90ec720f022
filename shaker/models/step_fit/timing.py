"""When and how a load goes, and how fast the real poles are: the best of a grid, poles of the modes known."""

from __future__ import annotations

from itertools import product

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.reading import Reading
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.output_error import Problem, square
from shaker.models.step_fit.samples import Samples
from shaker.models.step_fit.structure import Structure

_REAL = (1.5, 4.0, 10.0)  # real poles tried, in frequencies of the lowest mode
_LAG = (0.0, 0.08, 0.17, 0.25)  # periods by which the half-way point follows the middle of the release
LENGTHS = (0.25, 0.6, 1.2)  # lengths of the release tried, in rise times


def first_vector(
    structure: Structure, load: Load, samples: Samples, modes: ComplexArray, reading: Reading
) -> FloatArray:
    """Return the parameters of the grid point that leaves the smallest residual about the release."""
    lowest = float(np.abs(modes).min()) / (2 * np.pi)
    end = reading.onset_s + reading.release_s + 3.0 * reading.rise_s + 2.0 / lowest
    near = samples.between(reading.onset_s - 2.0 / lowest, end)
    half = _half_way(near, reading)
    fastest = 0.4 / samples.step_s
    best, found = np.inf, np.zeros(0)
    for reals in _real_poles(structure.reals, lowest, fastest):
        head = structure.vector(np.concatenate([modes, reals]))
        lag = float(np.sum(-1.0 / reals.real))
        for length in reading.rise_s * np.array(LENGTHS) if load.lasting else (0.0,):
            tail = [np.log(length)] if load.lasting else []
            middles = [half - lag - share / lowest for share in _LAG] if load.timed else [half]
            middles += [reading.onset_s + 0.5 * length] if load.timed else []
            for middle in middles:
                vector = np.concatenate([head, [middle] if load.timed else [], tail])
                problem = Problem(structure, load, near, vector[structure.order :], np.ones(2))
                cost = square(problem, vector)
                if cost < best:
                    best, found = cost, vector
    return np.asarray(found)


def _real_poles(count: int, lowest: float, fastest: float) -> list[ComplexArray]:
    """Return the sets (Q,) of real poles that are tried, in rad/s, in falling order of size within a set."""
    values = [min(share * lowest, fastest) for share in _REAL]
    sets = [pick for pick in product(values, repeat=count) if list(pick) == sorted(pick)]
    spread = 1.0 + 0.2 * np.arange(count)
    return [-2 * np.pi * np.array(pick) * spread + 0j for pick in sets]


def _half_way(near: Samples, reading: Reading) -> float:
    """Return when the output is first half-way to its new level."""
    share = (near.value - reading.baseline) / (reading.steady - reading.baseline)
    passed = np.flatnonzero((share >= 0.5) & (near.time_s >= reading.onset_s))
    return float(near.time_s[passed[0]]) if passed.size else reading.onset_s
