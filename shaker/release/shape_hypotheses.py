"""Exponential and two-stage releases, fitted from known poles; attribution of lags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from shaker.lti.system import ModalModel, coordinate_sizes, frame_of, from_coordinates, to_coordinates
from shaker.release.load_response import MOMENTS
from shaker.release.model_order import TERM, add_numerator_terms, penalised_chi_squared, with_loose_prior
from shaker.release.output_error import OutputErrorFit, solve, squares
from shaker.release.record import ReleaseShape
from shakercal._common.arrays import FloatArray
from shakercal._common.fitting import NORMAL_QUANTILE_95, REJECT_CHI2

_SPLITS = (0.003, 0.03, 0.12, 0.3)  # trial shares of the chain in the squared lags of chain and release
_SHARES = (0.35, 0.5, 0.65)  # trial shares of the first of two stages
_DISTANCES = (0.1, 0.2, 0.35, 0.6)  # trial distances of two stages, in periods of the lowest mode
_LAG = 0.2  # trial lag of the chain with two stages, in radians of the lowest mode
_PART = 0.1  # trial length of a stage over their distance
_LOOSE = (0.5, 2.0)  # standard deviations of share and logarithm of the length of a stage in the fit
HOPELESS = 4.0 * REJECT_CHI2  # χ² of a further shape above that of the likeliest from which it is left out
_ENOUGH = 0.03  # predicted fall of χ² by a step at which a fit from known poles ends
_TRIALS = {"exponential": 1, "stages": 2}  # number of start vectors, the best first, from which a shape is fitted


def with_further_shapes(found: Sequence[OutputErrorFit], by_rule: bool) -> tuple[OutputErrorFit, ...]:
    """Return fits with those of an exponential release and of two stages.

    `found`: the likeliest first. `by_rule`: whether the number of real poles is free; an exponential release may then
    replace a second one.
    """
    likeliest, fits = found[0], [*found]
    reals = likeliest.problem.structure.reals
    for count in (1, reals) if by_rule and reals > 1 else (reals,):
        fits.append(_fit_from(likeliest, "exponential", _exponential_starts(likeliest, count), count))
        if penalised_chi_squared(fits[-1]) < penalised_chi_squared(likeliest) + REJECT_CHI2:
            break
    best = min(fits, key=penalised_chi_squared)
    count = min(1, reals) if by_rule else reals
    fits.append(_fit_from(best, "stages", _staged_starts(best, count), count))
    return tuple(sorted(fits, key=shape_chi_squared))


def shape_chi_squared(fit: OutputErrorFit) -> float:
    """Return the penalised χ²; two stages count 8 for each mode."""
    staged = fit.problem.load.shape == "stages"
    return penalised_chi_squared(fit) + TERM * staged * fit.problem.structure.modes


def _exponential_starts(fit: OutputErrorFit, reals: int) -> list[FloatArray]:
    """Return start vectors with the delay and the squared lags of a fit."""
    problem, modes, order = fit.problem, fit.problem.structure.modes, fit.problem.structure.order
    lags, length, delay = np.exp(-fit.vector[2 * modes : order]), problem.release(fit.vector)[1], fit.delay_s
    square = float(np.sum(lags**2)) + MOMENTS[problem.load.shape] * length**2
    starts = []
    for split in _SPLITS:
        chain = np.full(reals, np.sqrt(split * square / max(1, reals))) * (1.0 + 0.2 * np.arange(reals))
        lag = np.sqrt((1.0 - split * (reals > 0)) * square)
        tail = [delay - np.sum(chain), np.log(2.0 * lag)]
        starts.append(np.concatenate([fit.vector[: 2 * modes], -np.log(chain), tail]))
    return starts


def _staged_starts(fit: OutputErrorFit, reals: int) -> list[FloatArray]:
    """Return start vectors with the delay of a fit."""
    modes, delay = fit.problem.structure.modes, fit.delay_s
    omega = float(np.exp(fit.vector[:modes].min()))
    starts = []
    for share, periods in product(_SHARES, _DISTANCES):
        distance, chain = 2.0 * np.pi * periods / omega, np.full(reals, _LAG / omega)
        tail = [delay - np.sum(chain) - distance * (0.5 - share), np.log(distance), share, np.log(_PART * distance)]
        starts.append(np.concatenate([fit.vector[: 2 * modes], -np.log(chain), tail]))
    return starts


def _fit_from(plain: OutputErrorFit, shape: ReleaseShape, starts: Sequence[FloatArray], reals: int) -> OutputErrorFit:
    """Return the fit of another shape from the best of some start vectors.

    Numerator terms are added only if the plain fit needs them, too.
    """
    structure = replace(plain.problem.structure, terms=1, reals=reals)
    problem = replace(plain.problem, structure=structure, load=replace(plain.problem.load, shape=shape))
    highest_hz = float(np.exp(plain.vector[: structure.modes].max())) / (2 * np.pi)
    starts = sorted(starts, key=lambda vector: float(squares(problem, vector[None])[0, -1]))
    far = HOPELESS + TERM * plain.problem.structure.order if plain.problem.structure.terms == 1 else np.inf
    tried = list[OutputErrorFit]()
    for start in starts[: _TRIALS[shape]]:
        loose, first = with_loose_prior(problem, start, highest_hz)
        if shape == "stages":
            loose = replace(loose, u_prior=np.concatenate([loose.u_prior[:-2], _LOOSE]))
        hopeless = plain.square * np.exp(min(far * problem.colour / plain.size, 700.0))
        tried.append(solve(loose, first, _ENOUGH, hopeless))
    fit = min(tried, key=lambda one: one.square)
    if plain.problem.structure.terms == 1 or shape_chi_squared(fit) < penalised_chi_squared(plain):
        return fit
    return add_numerator_terms(fit, [fit.vector] * structure.order, highest_hz)


# Attribution of lags: an exponential release behind a chain with a real pole leaves the record of its exchange.


def exchange_lags(fit: OutputErrorFit) -> OutputErrorFit:
    """Return the fit with the lags of release and slowest real pole exchanged."""
    order, vector, linear, slowest = fit.problem.structure.order, fit.vector.copy(), fit.linear.copy(), _slowest(fit)
    chain, release = np.exp(-vector[slowest]), 0.5 * np.exp(vector[order + 1])
    vector[[slowest, order + 1]] = -np.log(release), np.log(2.0 * chain)
    vector[order] += chain - release
    linear[1:] *= chain / release
    return replace(fit, problem=replace(fit.problem, prior=vector), vector=vector, linear=linear)


def release_is_slower(fit: OutputErrorFit) -> bool:
    """Return whether an exponential release is slower than every real pole."""
    order = fit.problem.structure.order
    return bool(0.5 * np.exp(fit.vector[order + 1]) >= np.exp(-fit.vector[_slowest(fit)]))


def with_both_lags(model: ModalModel, release_s: float) -> ModalModel:
    """Return a model whose slowest real pole has also the release's lag."""
    frame, modes, reals = frame_of(model), len(model.frequency_hz), len(model.real_hz)
    coordinates, slowest = to_coordinates(model, frame), 2 * modes + int(np.argmin(model.real_hz))
    coordinates[slowest] += (np.pi * release_s) ** 2
    return model.with_vector(from_coordinates(coordinates, modes, reals, frame))


def _slowest(fit: OutputErrorFit) -> int:
    """Return the place of the slowest real pole in a vector."""
    structure = fit.problem.structure
    return 2 * structure.modes + int(np.argmin(fit.vector[2 * structure.modes : structure.order]))


# Other hypotheses as parts of the uncertainty.

_EVENLY = np.sqrt(3.0)  # half range over the standard deviation of an even distribution (JCGM 100, 4.3.7)
_FIRST_ORDER = 1e-3  # share of frequencies and lags by which they are moved for derivatives
_SAME = 1e-3  # share of a hypothesis that is left beside farther ones, below which it is not another one


class OtherHypothesis(NamedTuple):
    """Another hypothesis: its number, and the model to which U is to extend.

    `distance` of the model in standard uncertainties; `change` (P,): of the parameters, of first order.
    """

    number: int
    model: ModalModel
    distance: float
    change: FloatArray


def alternatives(first: ModalModel, others: Sequence[tuple[ModalModel, float]], lags: bool) -> list[OtherHypothesis]:
    """Return hypotheses that are not rejected, the farthest first, each with its distance.

    `others`: models of the same structure, χ² above that of the first. `lags`: whether some attribute lags otherwise.
    A lag may be split in any way between release and chain, so the end has the distance of an even distribution.
    Of each hypothesis the part along farther ones is left out, since U includes it already.
    """
    if first.covariance is None:
        return []
    frame, modes, reals = frame_of(first), len(first.frequency_hz), len(first.real_hz)
    here, slope = first.jacobian(lambda at: to_coordinates(at, frame))
    size = np.sqrt(np.maximum(np.diag(slope @ first.covariance @ slope.T), 0.0)) + 1e-9 * coordinate_sizes(here, reals)
    least, found = _EVENLY if lags else NORMAL_QUANTILE_95, list[tuple[int, FloatArray, float]]()
    for number, (model, excess) in enumerate(others):
        if excess < REJECT_CHI2 and len(model.vector) == len(first.vector):
            distance = float(np.sqrt(max(excess, least**2)))
            shift = _shift(here, to_coordinates(model, frame), modes, reals)
            found.append((number, shift / size / distance, distance))
    found.sort(key=lambda one: -float(one[1] @ one[1]))
    result, directions = list[OtherHypothesis](), list[FloatArray]()
    for number, unit, distance in found:
        rest = unit - sum(((unit @ other) / (other @ other) * other for other in directions), np.zeros(len(unit)))
        if rest @ rest <= _SAME**2 * (unit @ unit):
            continue
        directions.append(rest)
        moved = rest * size * distance
        end = first.with_vector(from_coordinates(here + moved, modes, reals, frame))
        result.append(OtherHypothesis(number, end, distance, parameter_change(first, moved)))
    return result


def parameter_change(model: ModalModel, shift: FloatArray) -> FloatArray:
    """Return the first-order change (P,) of parameters for a shift of coordinates (P,)."""
    frame, modes, reals = frame_of(model), len(model.frequency_hz), len(model.real_hz)
    here, poles = to_coordinates(model, frame), slice(0, 2 * modes + reals)
    step = _FIRST_ORDER / max(1.0, float(np.max(np.abs(shift[poles] / here[poles]))))
    ahead, behind = (from_coordinates(here + by * shift, modes, reals, frame) for by in (step, -step))
    return np.asarray((ahead - behind) / (2.0 * step))


def _shift(here: FloatArray, there: FloatArray, modes: int, reals: int) -> FloatArray:
    """Return the shift between coordinates, lags by rank.

    The coordinates are squares of lags, which bands follow. A smaller lag has the shift whose first-order effect is the
    difference of the lags.
    """
    lags, shift = slice(2 * modes, 2 * modes + reals), there - here
    own, rank = here[lags], np.argsort(np.argsort(here[lags]))
    other = np.sort(there[lags])[rank]
    smaller = 2.0 * np.sqrt(np.abs(own)) * (np.sqrt(np.abs(other)) - np.sqrt(np.abs(own)))
    shift[lags] = np.where(other > own, other - own, smaller)
    return shift
