"""Where a fit starts: parameters whose modes are those of the measured poles, and the gains that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.models.identification.mechanics import Mechanics
from shaker.models.identification.problem import Curve, Problem, factor_name
from shaker.models.identification.rational import measured_poles, significant_poles

_ROUNDS = 12
_POLE_PRECISION = 3e-3  # relative, of the frequency of a measured pole
_STIFFNESS_RANGE = 2.0  # standard deviation of ln k about where a structure starts
_INERTIA_RANGE = 0.3  # standard deviation of an inertia, in parts of the whole
_LARGEST_DAMPING_RATIO = 0.4  # of what is taken for a mode
_LEAST_DAMPING_RATIO = 1e-3
_ALIKE = 1e-3  # relative difference of starting values that are one


@dataclass(frozen=True)
class _Terms:
    """What a parameter is: one of stiffness, of inertia with `whole` (P,) the inertia it adds to, or of damping."""

    stiffness: BoolArray
    inertia: BoolArray
    damping: BoolArray
    whole: FloatArray


def starting_vectors(problem: Problem, starts: FloatArray) -> list[FloatArray]:
    """Return vectors of unknowns to start from, made from a structure's `starts` (S, P)."""
    measured = [_believed(curve) for curve in problem.curves]
    found: list[FloatArray] = []
    for start in starts:
        vector = problem.expected.copy()
        stated = (problem.precision > 0.0) | problem.fixed
        count = len(problem.kind)
        vector[:count] = np.where(stated[:count], vector[:count], start[problem.kind])
        terms = _terms(problem, vector)
        vector = _damped(problem, terms, _matched(problem, terms, vector, measured, stated), measured, stated)
        if not any(np.allclose(vector, other, rtol=_ALIKE, atol=0.0) for other in found):
            found.append(vector)
    return [_gained(problem, vector) for vector in found]


def _believed(curve: Curve) -> ComplexArray:
    """Return the measured poles of a recording that lie in its band, ring and stand out."""
    count = curve.mechanics.forcing.shape[1]
    poles = measured_poles(curve.record, count)
    size = np.abs(poles)
    inside = (size > 0.7 * np.abs(curve.record.s).min()) & (size < 1.3 * np.abs(curve.record.s).max())
    return significant_poles(curve.record, poles[inside & (-poles.real < _LARGEST_DAMPING_RATIO * size)])


def _terms(problem: Problem, vector: FloatArray) -> _Terms:
    """Return what the parameters are, from the matrices that they act on."""
    count = len(problem.kind)
    acts, whole = np.zeros((3, count), dtype=np.bool_), np.ones(count)
    for curve in problem.curves:
        mechanics, (mass, _, _) = curve.mechanics, curve.mechanics.at(curve.weights(vector))[0]
        for term, place in enumerate(curve.terms, start=1):
            if place < count:
                acts[:, place] |= np.any(mechanics.matrices[term] != 0.0, axis=(1, 2))
                share = mechanics.matrices[term, 0].diagonal()
                if np.any(share > 0.0):
                    whole[place] = float(np.min(mass.diagonal()[share > 0.0] / share[share > 0.0]))
    return _Terms(acts[2], acts[0] & ~acts[2], acts[1] & ~acts[0] & ~acts[2], whole)


def _matched(
    problem: Problem, terms: _Terms, start: FloatArray, measured: Sequence[ComplexArray], stated: BoolArray
) -> FloatArray:
    """Return unknowns whose undamped modes have the frequencies of the measured poles, near where they start."""
    count = len(problem.kind)
    moved = np.flatnonzero((terms.stiffness | terms.inertia) & ~stated[:count])
    logarithmic = terms.stiffness[moved]
    unit = np.where(logarithmic, _STIFFNESS_RANGE, _INERTIA_RANGE * terms.whole[moved])
    x, vector = np.zeros(len(moved)), start
    for _ in range(_ROUNDS):
        rows, right = [], []
        for curve, poles in zip(problem.curves, measured, strict=True):
            frequency, by_unknown = _undamped(curve, vector)
            for pole, mode in _pairs(poles, frequency):
                change = by_unknown[mode, moved] * np.where(logarithmic, vector[moved], 1.0) * unit
                rows.append(change / _POLE_PRECISION)
                right.append(np.log(np.abs(pole) / frequency[mode]) / _POLE_PRECISION)
        rows.extend(np.eye(len(moved)))
        right.extend(-x)
        step = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
        step /= max(1.0, float(np.abs(step).max(initial=0.0)))
        x = x + step
        vector = start.copy()
        vector[moved] = np.where(logarithmic, start[moved] * np.exp(x * unit), start[moved] + x * unit)
        if np.abs(step).max(initial=0.0) < 1e-5:
            break
    return vector


def _undamped(curve: Curve, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the undamped ω (n,) in 1/s, ascending, and the derivatives (n, N) of ln ω by all unknowns."""
    omega, shape = _modes(curve.mechanics, curve.weights(vector))
    matrices = curve.mechanics.matrices[1:]
    change = np.einsum("im,qij,jm->mq", shape, matrices[:, 2], shape)
    change -= omega[:, None] ** 2 * np.einsum("im,qij,jm->mq", shape, matrices[:, 0], shape)
    return omega, _by_unknown(curve, change / (2.0 * omega[:, None] ** 2), len(vector))


def _by_unknown(curve: Curve, by_term: FloatArray, count: int) -> FloatArray:
    """Return derivatives (n, N) by all unknowns of those (n, P+E) by the terms of a recording."""
    found = np.zeros((len(by_term), count))
    for column, place in enumerate(curve.terms):
        found[:, place] += by_term[:, column]
    return found


def _modes(mechanics: Mechanics, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ω (n,) and shapes (n, n), columns of unit modal mass, without damping; masses are kept above zero."""
    (mass, _, stiffness), _ = mechanics.at(weights)
    values, vectors = np.linalg.eigh(mass)
    root = vectors / np.sqrt(np.maximum(values, 1e-3 * values.max()))
    square, turned = np.linalg.eigh(root.T @ stiffness @ root)
    return np.sqrt(np.maximum(square, 1e-12 * square.max())), root @ turned


def _pairs(poles: ComplexArray, frequency: FloatArray) -> list[tuple[complex, int]]:
    """Return measured poles with the number of the mode each one is."""
    if len(poles) == len(frequency):
        return list(zip(poles.tolist(), range(len(frequency)), strict=True))
    nearest = [int(np.argmin(np.abs(np.log(np.abs(pole) / frequency)))) for pole in poles]
    return list(zip(poles.tolist(), nearest, strict=True))


def _damped(
    problem: Problem, terms: _Terms, vector: FloatArray, measured: Sequence[ComplexArray], stated: BoolArray
) -> FloatArray:
    """Return unknowns with dampings that give the measured poles their decay, none below a small one."""
    count = len(problem.kind)
    moved = np.flatnonzero(terms.damping & ~stated[:count])
    if len(moved) == 0:
        return vector
    rows, right, least = [], [], np.full(len(vector), np.inf)
    for curve, poles in zip(problem.curves, measured, strict=True):
        omega, shape = _modes(curve.mechanics, curve.weights(vector))
        by_term = np.einsum("im,qij,jm->mq", shape, curve.mechanics.matrices[1:, 1], shape)
        share = _by_unknown(curve, by_term, len(vector))
        for place in moved[share[:, moved].max(axis=0) > 0.0]:
            mode = int(np.argmax(share[:, place]))
            floor = 2.0 * _LEAST_DAMPING_RATIO * omega[mode] / share[mode, place]
            least[place] = min(least[place], floor)
        for pole, mode in _pairs(poles, omega):
            rows.append(share[mode, moved] / abs(pole))
            right.append(-2.0 * pole.real / abs(pole))
    found = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0] if rows else np.zeros(len(moved))
    damped = vector.copy()
    damped[moved] = np.maximum(found, np.where(np.isfinite(least[moved]), least[moved], 0.0))
    return damped


def _gained(problem: Problem, vector: FloatArray) -> FloatArray:
    """Return unknowns with the free gains that bring the modelled curves nearest to the measured ones."""
    gained = vector.copy()
    places = {name: place for place, name in enumerate(problem.names)}
    for curve in problem.curves:
        record = curve.record
        value = curve.modelled(vector)[0]
        noise = record.ratio.u_re**2 + record.ratio.u_im**2
        for c, channel in enumerate(record.ratio.channels):
            place = places.get(factor_name("ln gain", record, channel))
            if place is not None:
                weighted = value[:, c].conj() / noise[:, c]
                gain = complex(np.sum(weighted * record.ratio.value[:, c]) / np.sum(weighted * value[:, c]))
                gained[place] = np.log(max(abs(gain), np.finfo(np.float64).tiny))
                gained[places[factor_name("gain phase", record, channel)]] = np.angle(gain)
    return gained
