"""One model fitted to several releases together, with the contribution of each release."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from shaker.lti.system import ModalModel
from shaker.release.load_response import MOMENTS, BlockMeans
from shaker.release.model_order import CLEAR, LOOSE, TERM
from shaker.release.output_error import (
    MAX_DAMPING,
    OutputErrorFit,
    OutputErrorProblem,
    PoleStructure,
    columns,
    design,
    modal_model,
    model_slopes,
    noise_covariance,
    slopes,
)
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.fitting import LMOptions, ParameterPrior, levenberg_marquardt

_RULES = LMOptions(predicted_decrease=3e-3, actual_decrease=3e-3, max_steps=30, damping_decrease=0.03, min_damping=1e-8)
_COARSE = replace(_RULES, predicted_decrease=0.3, actual_decrease=0.3)  # among several starts
_MARGIN = 1.0  # χ² by which another start than that of all own fits must be better
_DURATIONS = (1.0, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6)  # of a release, over those of its own fit
_MIDDLES = (0.0, -0.3, 0.3, -0.6, 0.6)  # shifts of its middle, in radians of the lowest mode
_SWEEPS = 3  # over the releases in the search of their durations
_CONSISTENT = 1e-3  # probability of a larger χ² by chance below which releases do not share one model


@dataclass(frozen=True, repr=False)
class ReleasesFit(Arrays):
    """A model of several releases.

    Each release has its own onset, duration and baseline. The model is that of all of them.

    Attributes
    ----------
    model : the model, with the covariance by noise.
    moves : (R, P), change of its parameters by the noise of each release, times R.
    covariances : (R, P, P), of `moves`, by the noise that the release's own fit leaves.
    square : χ² of all residuals, over the noise that the releases' own fits leave.
    cost : `square` plus 8 per numerator term, 12 per pole, and 8 per mode for each release in two stages.
    consistent : whether `square` is above that of the releases' own fits by no more than chance.
    """

    model: ModalModel
    moves: FloatArray
    covariances: FloatArray
    square: float
    cost: float
    consistent: bool


class _Slopes(NamedTuple):
    """Residual (B,) of a release, and its derivatives (B, K) by parameters `places`."""

    residual: FloatArray
    jacobian: FloatArray
    places: IntArray


@dataclass(frozen=True, repr=False)
class _Releases:
    """Releases with one structure: their own fits, and where their parameters are.

    A vector is [poles, numerator terms, then baseline, middle and logarithm of the duration of each release].
    """

    structure: PoleStructure
    fits: tuple[OutputErrorFit, ...]
    variances: tuple[float, ...]

    @cached_property
    def problems(self) -> tuple[OutputErrorProblem, ...]:
        """Problem of each release with this structure."""
        return tuple(replace(fit.problem, structure=self.structure) for fit in self.fits)

    @cached_property
    def noise(self) -> tuple[float, ...]:
        """Variance of a sample of each release that counts about the modes."""
        return tuple(max(v, 1e-300) * fit.problem.colour for v, fit in zip(self.variances, self.fits, strict=True))

    @property
    def chain(self) -> tuple[float, float] | None:
        """Stated logarithm of the first real pole in rad/s with u, None without one."""
        return self.fits[0].problem.chain if self.structure.reals else None

    @property
    def charge(self) -> float:
        """What the numbers of terms, poles, and unknowns of releases in stages count, in χ²."""
        staged = sum(fit.problem.load.shape == "stages" for fit in self.fits)
        return TERM * (self.structure.terms + staged * self.structure.modes) + CLEAR * self.structure.order

    @property
    def shared(self) -> int:
        """Number of the model's parameters."""
        return self.structure.order + self.structure.terms

    @cached_property
    def own(self) -> tuple[slice, ...]:
        """Where the baseline and the release of each record are."""
        sizes = [1 + len(fit.vector) - fit.problem.structure.order for fit in self.fits]
        ends = self.shared + np.cumsum(sizes)
        return tuple(slice(int(end) - size, int(end)) for end, size in zip(ends, sizes, strict=True))

    def parts(self, vector: FloatArray, release: int) -> tuple[FloatArray, FloatArray]:
        """Return nonlinear and linear parameters of one release, as in `OutputErrorFit`."""
        own, order = vector[self.own[release]], self.structure.order
        return np.append(vector[:order], own[1:]), np.append(own[0], vector[order : self.shared])

    def index(self, release: int) -> IntArray:
        """Return the places of the parameters of `slopes`, then of the columns of a design."""
        own, order = np.arange(self.own[release].start, self.own[release].stop), self.structure.order
        places = np.arange(self.shared)
        return np.concatenate([places[:order], own[1:], own[:1], places[order:]])

    def slopes(self, vector: FloatArray, release: int, samples: BlockMeans) -> _Slopes:
        """Return the residual of one release and its derivatives."""
        problem, (nonlinear, linear) = self.problems[release], self.parts(vector, release)
        matrix, answered = columns(problem, nonlinear, samples)
        jacobian = np.concatenate([slopes(problem, nonlinear, linear, answered), matrix], axis=1)
        return _Slopes(samples.value - matrix @ linear, jacobian, self.index(release))

    def allowed(self, vector: FloatArray) -> bool:
        """Return whether modes oscillate and releases are within their records."""
        modes, order = self.structure.modes, self.structure.order
        if np.any(np.abs(vector[modes : 2 * modes]) > MAX_DAMPING) or np.any(np.abs(vector[:order]) > 50.0):
            return False
        for problem, own in zip(self.problems, self.own, strict=True):
            lengths, shares = vector[own][2::2], vector[own][3::2]
            if np.any(lengths >= np.log(np.ptp(problem.samples.time_s))) or np.any(np.abs(shares - 0.5) >= 0.5):
                return False
        return True

    def start(self, poles: FloatArray) -> FloatArray:
        """Return the vector of given poles (order,), with releases as in their own fits."""
        vector = np.zeros(self.own[-1].stop)
        vector[: self.structure.order] = poles
        for fit, own in zip(self.fits, self.own, strict=True):
            vector[own] = np.append(fit.linear[0], fit.vector[fit.problem.structure.order :])
        return vector

    def starts(self) -> list[FloatArray]:
        """Return start vectors: from all own fits, then from one fit for all releases.

        A single fit may end at a lag and a release that explain its record, but no other one. Releases of one device
        are similar, so each fit is tried for all of them, with the delays of their own fits.
        """
        same = [n for n, fit in enumerate(self.fits) if _counts(fit.problem.structure) == _counts(self.structure)]
        poles = {n: _sorted_poles(self.fits[n]) for n in same}
        found = [self.start(np.median([*poles.values()], axis=0))]
        if len(self.fits) == 1 or not all(problem.load.lasting for problem in self.problems):
            return found
        lags = [float(np.sum(np.exp(-poles[n][2 * self.structure.modes :]))) for n in same]
        ordered = [same[n] for n in np.argsort(lags)]
        for chosen in dict.fromkeys([ordered[0], ordered[len(ordered) // 2], ordered[-1]]):
            vector, like = self.start(poles[chosen]), self.fits[chosen]
            for fit, own in zip(self.fits, self.own, strict=True):
                if fit.problem.load.shape == like.problem.load.shape:
                    release = like.vector[like.problem.structure.order :].copy()
                    release[0] += fit.delay_s - like.delay_s
                    vector[own.start + 1 : own.stop] = release
            found.append(vector)
        return found

    def near(self, vector: FloatArray, everywhere: bool) -> tuple[FloatArray, FloatArray]:
        """Return changes (C, 2) of a release, and `_explained` for each (R, C, ., .).

        They are those of the middle, and of the logarithm of the duration. The ringing of a mode changes its sign where
        the load changes for a whole period of it. With several modes the best release is therefore sought near that of
        the own fit. The first change is none.
        """
        moves = np.zeros((1, 2))
        if everywhere and self.structure.modes > 1 and all(problem.load.lasting for problem in self.problems):
            shifts = float(np.exp(-vector[: self.structure.modes].min())) * np.array(_MIDDLES)
            moves = np.array([*product(shifts, np.log(_DURATIONS))])
        releases = range(len(self.fits))
        return moves, np.array([[self._explained(vector, n, move) for move in moves] for n in releases])

    def best_of(self, vector: FloatArray, moves: FloatArray, tables: FloatArray) -> FloatArray:
        """Return a vector with the best of `near` for each release, and the best numerator."""
        places = np.append(np.arange(self.structure.terms), -1)
        tables = tables[:, :, places[:, None], places]
        same = int(np.argmin([_unexplained(table) for table in tables.sum(axis=0)]))
        _, chosen = min((_descend(tables, first) for first in {0, same}), key=lambda one: one[0])
        total = np.sum([table[place] for table, place in zip(tables, chosen, strict=True)], axis=0)
        found = np.concatenate([vector[: self.structure.order], _solved(total), vector[-self._outside :]])
        for release, own in enumerate(self.own):
            last = min(own.start + 3, own.stop)
            found[own.start + 1 : last] += moves[chosen[release]][: last - own.start - 1]
            samples, (nonlinear, linear) = self.problems[release].samples, self.parts(found, release)
            off = samples.value - design(self.problems[release], nonlinear, samples)[:, 1:] @ linear[1:]
            found[own.start] = float(np.average(off, weights=samples.length))
        return found

    @property
    def _outside(self) -> int:
        """Number of the releases' parameters."""
        return int(self.own[-1].stop) - self.shared

    def _explained(self, vector: FloatArray, release: int, move: FloatArray) -> FloatArray:
        """Return products (terms + 1, terms + 1) of responses and output without means."""
        problem, samples = self.problems[release], self.problems[release].samples
        nonlinear = self.parts(vector, release)[0].copy()
        first = self.structure.order
        nonlinear[first : first + 2] += move[: len(nonlinear) - first]
        rows = np.append(design(problem, nonlinear, samples)[:, 1:], samples.value[:, None], axis=1)
        rows = (rows - np.average(rows, axis=0, weights=samples.length)) * samples.weight[:, None]
        return np.asarray(rows.T @ rows / self.noise[release])

    def prior(self, vector: FloatArray) -> ParameterPrior:
        """Return a wide prior; that of a release is the one of its own fit."""
        value, u = vector.copy(), np.full(len(vector), np.inf)
        u[2 * self.structure.modes : self.structure.order] = LOOSE[0]
        if self.chain is not None:
            value[2 * self.structure.modes], u[2 * self.structure.modes] = self.chain
        for fit, own in zip(self.fits, self.own, strict=True):
            value[own.start + 1 : own.stop] = fit.problem.prior[fit.problem.structure.order :]
            u[own.start + 1 : own.stop] = fit.problem.u_prior[fit.problem.structure.order :]
        return ParameterPrior(value, u)


@dataclass(frozen=True, repr=False)
class _JointPoint:
    """Parameters of all releases, as `levenberg_marquardt` uses them."""

    releases: _Releases
    parameters: FloatArray

    @cached_property
    def parts(self) -> list[_Slopes]:
        """Weighted residuals and derivatives of all releases."""
        found = []
        with np.errstate(over="ignore", invalid="ignore"):
            for release, (problem, noise) in enumerate(zip(self.releases.problems, self.releases.noise, strict=True)):
                part = self.releases.slopes(self.parameters, release, problem.samples)
                weight = problem.samples.weight / np.sqrt(noise)
                found.append(part._replace(residual=part.residual * weight, jacobian=part.jacobian * weight[:, None]))
        return found

    @cached_property
    def loss(self) -> float:
        """χ² of all residuals."""
        value, releases = 0.0, self.releases
        with np.errstate(over="ignore", invalid="ignore"):
            for release, (problem, noise) in enumerate(zip(releases.problems, releases.noise, strict=True)):
                nonlinear, linear = releases.parts(self.parameters, release)
                off = problem.samples.value - design(problem, nonlinear, problem.samples) @ linear
                value += float(np.sum((off * problem.samples.weight) ** 2)) / noise
        return value if np.isfinite(value) else np.inf

    @property
    def freedom(self) -> int:
        """Degrees of freedom, at least 1."""
        return max(1, sum(len(part.residual) for part in self.parts) - len(self.parameters))

    @cached_property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations."""
        normal, downhill = np.zeros((len(self.parameters),) * 2), np.zeros(len(self.parameters))
        for residual, jacobian, places in self.parts:
            normal[np.ix_(places, places)] += jacobian.T @ jacobian
            downhill[places] += jacobian.T @ residual
        return normal, downhill


def fit_jointly(
    fits: Sequence[OutputErrorFit],
    wholes: Sequence[BlockMeans],
    structure: PoleStructure,
    variances: Sequence[float] | None = None,
) -> ReleasesFit:
    """Return one model of releases, from their own fits and all their samples.

    `variances`: of the noise of a sample of each release; None: those of the fits.
    `structure`: of the model, which at least one of the fits has but for the number of its numerator terms. All
    records together determine that number, from the least of the fits to the largest, or that of a chain of masses.

    Raises
    ------
    ValueError : no fit has the modes and real poles of the structure.
    """
    same = [fit for fit in fits if _counts(fit.problem.structure) == _counts(structure)]
    if not same:
        raise ValueError("fits: expected one with the poles of the structure, found none")
    terms = [fit.problem.structure.terms for fit in same]
    noise = tuple(variances or (fit.variance for fit in fits))
    richest = _Releases(replace(structure, terms=max(*terms, structure.smoothest)), tuple(fits), noise)
    starts = [(start, *richest.near(start, everywhere=n == 0)) for n, start in enumerate(richest.starts())]
    tried = list[_JointPoint]()
    for count in range(min(terms), richest.structure.terms + 1):
        releases, coarse = replace(richest, structure=replace(structure, terms=count)), list[_JointPoint]()
        for start in starts:
            hopeless = min((point.loss for point in coarse), default=np.inf)
            coarse.append(_solved_from(releases, releases.best_of(*start), replace(_COARSE, tolerance=hopeless)))
        best = min(coarse, key=lambda point: point.loss + _MARGIN * (point is not coarse[0]))
        tried.append(_solved_from(releases, best.parameters, _RULES))
    best = min(tried, key=lambda point: point.loss + TERM * point.releases.structure.terms)
    return _as_joint_fit(best, wholes)


def _solved_from(releases: _Releases, first: FloatArray, rules: LMOptions) -> _JointPoint:
    """Return the least-squares parameters from a start vector."""

    def at(vector: FloatArray) -> _JointPoint | None:
        return _JointPoint(releases, vector) if releases.allowed(vector) else None

    return levenberg_marquardt(at, _JointPoint(releases, first), rules, prior=releases.prior(first)).point


def _descend(tables: FloatArray, first: int) -> tuple[float, list[int]]:
    """Return the least sum of squares by one choice per release of `tables`."""
    chosen, total = [first] * len(tables), tables[:, first].sum(axis=0)
    for _ in range(_SWEEPS if tables.shape[1] > 1 else 0):
        for release, table in enumerate(tables):
            others = total - table[chosen[release]]
            chosen[release] = int(np.argmin([_unexplained(others + one) for one in table]))
            total = others + table[chosen[release]]
    return _unexplained(total), chosen


def _solved(products: FloatArray) -> FloatArray:
    """Return the numerator (terms,) from products of the terms' responses and the output."""
    size = np.sqrt(np.maximum(np.diag(products), 1e-300))[:-1]
    scaled = products[:-1, :-1] / np.outer(size, size)
    return np.asarray(np.linalg.lstsq(scaled, products[:-1, -1] / size, rcond=1e-13)[0] / size)


def _unexplained(products: FloatArray) -> float:
    """Return the sum of squares of the output that the terms' responses leave."""
    return float(products[-1, -1] - products[:-1, -1] @ _solved(products))


def _counts(structure: PoleStructure) -> tuple[int, int]:
    """Return the numbers of modes and of real poles."""
    return structure.modes, structure.reals


def _sorted_poles(fit: OutputErrorFit) -> FloatArray:
    """Return the parameters of a fit's poles, modes and real poles in rising frequency."""
    structure, vector = fit.problem.structure, fit.vector
    modes, reals = np.argsort(vector[: structure.modes]), np.argsort(vector[2 * structure.modes : structure.order])
    return np.asarray(vector[np.concatenate([modes, structure.modes + modes, 2 * structure.modes + reals])])


def _as_joint_fit(point: _JointPoint, wholes: Sequence[BlockMeans]) -> ReleasesFit:
    """Return a solution with the contribution of each release from every sample."""
    releases, vector, count = point.releases, point.parameters, len(wholes)
    structure, shared = releases.structure, releases.shared
    parts = [releases.slopes(vector, release, whole) for release, whole in enumerate(wholes)]
    normal = np.zeros((len(vector),) * 2)
    for (_, jacobian, places), noise in zip(parts, releases.noise, strict=True):
        normal[np.ix_(places, places)] += jacobian.T @ jacobian / noise
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0.0] = 1.0
    normal = normal / np.outer(scale, scale)
    prior = _prior_normal(releases, vector, scale, normal)
    inverse = np.linalg.pinv(normal + np.diag(prior), rcond=1e-14, hermitian=True) / np.outer(scale, scale)
    nonlinear, linear = releases.parts(vector, 0)
    of_model = model_slopes(structure, nonlinear, linear)
    slope = np.concatenate([of_model[:, : structure.order], of_model[:, len(nonlinear) + 1 :]], axis=1)
    by_prior = inverse[:shared] * (prior * scale**2) @ inverse[:shared].T
    moves, covariances = [], []
    for release, (part, whole, noise) in enumerate(zip(parts, wholes, releases.noise, strict=True)):
        gain = inverse[np.ix_(part.places, part.places)] @ part.jacobian.T / noise
        fit, fitted = releases.fits[release], whole.value - part.residual
        own = np.asarray(design(fit.problem, fit.vector, whole) @ fit.linear)
        better = np.var(whole.value - own) < np.var(part.residual)
        of_noise = noise_covariance(part.jacobian, gain, whole, own if better else fitted).covariance
        place = np.argsort(part.places)[:shared]
        moves.append(count * slope @ (gain @ part.residual)[place])
        covariances.append(slope @ (count**2 * of_noise[np.ix_(place, place)] + count * by_prior) @ slope.T)
    covariance = np.sum(covariances, axis=0) / count**2
    solution = OutputErrorFit(releases.problems[0], nonlinear, linear, point.loss)
    excess = point.loss - sum(fit.square / noise for fit, noise in zip(releases.fits, releases.noise, strict=True))
    return ReleasesFit(
        modal_model(solution, covariance, 0.0),
        np.array(moves),
        np.array(covariances),
        point.loss,
        point.loss + releases.problems[0].pull(nonlinear) + releases.charge,
        _by_chance(excess, (count - 1) * shared),
    )


def _by_chance(excess: float, freedom: int) -> bool:
    """Return whether χ² above that of the releases' own fits may be chance."""
    from scipy.special import chdtrc

    return freedom == 0 or bool(chdtrc(freedom, max(excess, 0.0)) > _CONSISTENT)


def _prior_normal(releases: _Releases, vector: FloatArray, scale: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the diagonal of the prior's scaled normal matrix, as that of a single fit.

    The squares 1/a² of the real poles and T²/12 of a release are positive and at most their sum, which the record of
    that release determines.
    """
    structure, added, largest = releases.structure, np.zeros(len(vector)), np.inf
    reals = np.arange(2 * structure.modes, structure.order)
    for fit, own in zip(releases.fits, releases.own, strict=True):
        if fit.problem.load.timed:
            onset = own.start + 1
            added[onset] = 1.0 / (fit.problem.u_prior[fit.problem.structure.order] * scale[onset]) ** 2
    if releases.chain is not None:
        added[reals[0]] = 1.0 / (releases.chain[1] * scale[reals[0]]) ** 2
    free = np.asarray(np.linalg.pinv(normal + np.diag(added), rcond=1e-14, hermitian=True))
    of_reals = 2.0 * np.exp(-2.0 * vector[reals])
    for problem, own in zip(releases.problems, releases.own, strict=True):
        squares = np.zeros(len(vector))
        squares[reals] = -of_reals
        length = own.stop - 1
        if problem.load.lasting:
            moment = MOMENTS.get(problem.load.shape, MOMENTS["ramp"])
            squares[length] = 2.0 * moment * np.exp(2.0 * vector[length])
        if np.count_nonzero(squares) < 2:
            continue
        of_record = squares / scale
        spread_s2 = np.sqrt(max(0.0, float(of_record @ free @ of_record)))
        most = 0.5 * float(np.sum(np.abs(squares))) + 2.0 * spread_s2
        added[length] += 3.0 * (of_record[length] / most) ** 2
        largest = min(largest, most)
    added[reals] += 3.0 * (of_reals / scale[reals] / largest) ** 2
    return added
