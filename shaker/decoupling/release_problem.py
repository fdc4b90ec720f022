"""Records of several releases as one least-squares problem of common poles, and its covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from shaker.decoupling.model import MultiModel, Poles
from shaker.release.load_response import (
    MOMENTS,
    BlockMeans,
    BlockResponses,
    ReleaseLoad,
    Stages,
    responses,
    responses_with_derivatives,
)
from shaker.release.record import ReleaseShape
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray
from shakercal._common.fitting import (
    NORMAL_QUANTILE_95,
    BlockJacobian,
    LinearBlock,
    LMOptions,
    Minimum,
    ParameterPrior,
    SeparablePoint,
    levenberg_marquardt,
)

_LOOSE = (1.5, 2.0)  # standard deviations of logarithms of real poles and of durations: wide, to guide the search
_CACHE_SIZE = 2  # results per record: those of the current point and of the trial


SHAPE_NAMES = {"ramp": "line", "smooth": "half a cosine", "exponential": "exponential", "stages": "two lines"}
TIMES = 4  # parameters of a release in a vector; those of stages are not moved by other shapes
_SHARES, _PARTS = (0.02, 0.98), (0.05, 1.0)  # range of the first stage's share of the load, and of its length


@dataclass(frozen=True)
class ReleaseTiming:
    """Middle and duration of a load change in s, and its shape.

    Of a release in stages, the `share` of the load in the first one, and the length of each over the duration, `part`.
    """

    middle_s: float
    duration_s: float
    shape: ReleaseShape
    share: float = 0.5
    part: float = 0.4

    @property
    def stages(self) -> Stages:
        """Stages of the release."""
        return Stages(self.share, self.part * self.duration_s)

    @property
    def moment_s2(self) -> float:
        """Second moment of the load's change about its mean time."""
        if self.shape == "stages":
            between = self.share * (1.0 - self.share) * (1.0 - self.part) ** 2
            return (MOMENTS["ramp"] * self.part**2 + between) * self.duration_s**2
        return MOMENTS[self.shape] * self.duration_s**2

    @property
    def free(self) -> int:
        """Number of parameters that the shape has."""
        return TIMES if self.shape == "stages" else 2

    @property
    def vector(self) -> FloatArray:
        """Parameters (`TIMES`,): middle, logarithm of the duration, share and part of stages."""
        return np.array([self.middle_s, np.log(self.duration_s), self.share, self.part])

    def moved(self, vector: FloatArray, longest_s: float) -> ReleaseTiming | None:
        """Return the release of other parameters, None if they are impossible."""
        middle_s, log_s, share, part = vector.tolist()
        duration_s = float(np.exp(np.clip(log_s, -50.0, 50.0)))
        sound = _SHARES[0] <= share <= _SHARES[1] and _PARTS[0] <= part <= _PARTS[1]
        return (
            ReleaseTiming(middle_s, duration_s, self.shape, share, part) if sound and duration_s <= longest_s else None
        )

    def in_shape(self, shape: ReleaseShape) -> ReleaseTiming:
        """Return a release of another shape with the same middle and second moment."""
        other = ReleaseTiming(self.middle_s, self.duration_s, shape)
        return replace(other, duration_s=self.duration_s * float(np.sqrt(self.moment_s2 / other.moment_s2)))


PoleCandidate: TypeAlias = tuple[Poles, tuple[ReleaseTiming, ...]]
"""Poles with the releases of all records."""


class ExplainedData(NamedTuple):
    """A record without its mean, as the poles and a release explain it.

    Responses (A, B) are `basis` @ `triangle`; `along` (B, C): data along the orthonormal basis; `orthogonal` (A, C):
    the rest.
    """

    basis: FloatArray
    triangle: FloatArray
    along: FloatArray
    orthogonal: FloatArray


@dataclass(frozen=True)
class WhitenedRecord:
    """One record prepared for a fit: block means (A, C) over their noise, times, load.

    `hums_hz`: frequencies of lines whose amplitude and phase are unknown in every output, as its level is; 0 for drift.
    `whitening`: taps of a filter that whitens the noise, applied to the means and to all that describes them.
    """

    name: str
    component: str
    amplitude: float
    samples: BlockMeans
    hums_hz: tuple[float, ...] = ()
    whitening: tuple[float, ...] = ()

    @cached_property
    def level(self) -> FloatArray:
        """Orthonormal basis (A, L) of the level, of drift and of hum."""
        time_s = self.samples.time_s
        turns = 2.0 * np.pi * np.outer(time_s, [hz for hz in self.hums_hz if hz > 0.0])
        drift = [time_s[:, None] - time_s.mean()] if 0.0 in self.hums_hz else []
        columns = np.hstack([np.ones((len(time_s), 1)), *drift, np.cos(turns), np.sin(turns)])
        return np.linalg.qr(self.whitened(columns))[0]

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Return filtered rows (A, …), as of a record that was constant before."""
        if not self.whitening:
            return rows
        from scipy.signal import lfilter

        taps = np.array(self.whitening)
        return np.asarray(lfilter(taps, [1.0], rows - rows[:1], axis=0) + taps.sum() * rows[:1])

    def without_level(self, rows: FloatArray) -> FloatArray:
        """Return filtered rows (A, …) without their part in the span of `level`."""
        return self._orthogonal(self.whitened(rows))

    def _orthogonal(self, rows: FloatArray) -> FloatArray:
        return np.asarray(rows - self.level @ (self.level.T @ rows))

    def prepared(self, whitening: tuple[float, ...]) -> WhitenedRecord:
        """Return a record of plain means filtered, and without its level."""
        other = replace(self, whitening=whitening)
        return replace(other, samples=replace(self.samples, value=other.without_level(self.samples.value)))

    def with_hums(self, hums_hz: tuple[float, ...]) -> WhitenedRecord:
        """Return the record with additional lines as unknowns."""
        other = replace(self, hums_hz=hums_hz)
        return replace(other, samples=replace(self.samples, value=other._orthogonal(self.samples.value)))

    def response_derivatives(self, poles: ComplexArray, release: ReleaseTiming, fixed_poles: bool) -> BlockResponses:
        """Return the responses of the poles to the release, with derivatives."""
        load = ReleaseLoad(release.shape, self.amplitude)
        times = release.middle_s, release.duration_s
        return responses_with_derivatives(load, poles, self.samples, *times, fixed_poles, release.stages)

    @cached_property
    def explained(self) -> Callable[[Poles, ReleaseTiming], ExplainedData]:
        """Function from poles and release to `ExplainedData`, with a cache of the last results."""

        @lru_cache(_CACHE_SIZE)
        def found(poles: Poles, release: ReleaseTiming) -> ExplainedData:
            load = ReleaseLoad(release.shape, self.amplitude)
            times = release.middle_s, release.duration_s
            value = responses(load, poles.values, self.samples, *times, release.stages).T
            upper, real = value[: poles.modes], value[poles.modes :]
            columns = np.concatenate([2 * upper.real, -2 * upper.imag, real.real])
            basis, triangle = np.linalg.qr(self.without_level(columns.T))
            along = basis.T @ self.samples.value
            return ExplainedData(basis, triangle, along, self.samples.value - basis @ along)

        return found

    def cut(self, from_s: float, to_s: float) -> WhitenedRecord:
        """Return the record between two times."""
        near = self.samples.between(from_s, to_s)
        part = replace(self, samples=near)
        return replace(part, samples=replace(near, value=part._orthogonal(near.value)))


@dataclass(frozen=True)
class StepProblem:
    """Least-squares problem of poles and releases for all records by load component.

    The outputs of a sensor follow displacements, so that no load, however sudden, gives them an immediate velocity.
    Every real pole is a lag of the amplifier behind them. H therefore falls as s^-(2 + Q), and Σ R·p^k = 0 for k = 0 …
    Q in every element. This distinguishes the onset of a release from a delay of the outputs. The designs have the
    remaining columns (`Poles.smooth`).

    Parameters: those of the poles, then those of every record's release in the order of `records`.
    """

    records: tuple[WhitenedRecord, ...]
    components: tuple[str, ...]

    @property
    def values(self) -> int:
        """Number of data."""
        return sum(record.samples.value.size for record in self.records)

    @property
    def step_s(self) -> float:
        """Sampling interval."""
        return self.records[0].samples.step_s

    def record_indices(self, component: str) -> list[int]:
        """Return the indices of the records of a load."""
        return [i for i, record in enumerate(self.records) if record.component == component]

    def part(self, indices: Sequence[int]) -> StepProblem:
        """Return the problem of some records of one load."""
        return StepProblem(tuple(self.records[i] for i in indices), (self.records[indices[0]].component,))

    def vector(self, poles: Poles, releases: Sequence[ReleaseTiming]) -> FloatArray:
        """Return all parameters."""
        return np.concatenate([poles.vector, *(release.vector for release in releases)])

    def prior(self, vector: FloatArray, poles: Poles, fixed_count: int) -> ParameterPrior:
        """Return a wide prior of lags and durations, which guides along their valley."""
        u = np.full(len(vector), np.inf)
        u[2 * poles.modes : poles.count], u[poles.count + 1 :: TIMES] = _LOOSE
        return ParameterPrior(vector[fixed_count:], u[fixed_count:])

    def split(self, vector: FloatArray, poles: Poles, releases: Sequence[ReleaseTiming]) -> PoleCandidate | None:
        """Return poles and releases of a vector, None if they are not allowed."""
        unchanged = np.array_equal(vector[: poles.count], poles.vector)  # keeps the cached results of these poles
        moved_poles, times = poles if unchanged else poles.with_vector(vector), vector[poles.count :].reshape(-1, TIMES)
        longest = [float(np.ptp(record.samples.time_s)) for record in self.records]
        moved = [one.moved(row, most) for one, row, most in zip(releases, times, longest, strict=True)]
        sound = tuple(one for one in moved if one is not None)
        return (moved_poles, sound) if moved_poles.allowed and len(sound) == len(moved) else None

    def point(self, poles: Poles, releases: Sequence[ReleaseTiming], fixed_count: int = 0) -> SeparablePoint:
        """Return poles and releases as a point without the first `fixed_count` parameters."""
        blocks = tuple(
            _block(self, poles, releases, self.record_indices(name), fixed_count) for name in self.components
        )
        return SeparablePoint(self.vector(poles, releases)[fixed_count:], blocks)


@dataclass(frozen=True)
class PoleFit:
    """Poles and releases with their least-squares solution."""

    poles: Poles
    releases: tuple[ReleaseTiming, ...]
    solution: Minimum[SeparablePoint]

    @property
    def loss(self) -> float:
        """Sum of squares."""
        return self.solution.point.loss


def search_options(steps: int, min_gain: float, target_loss: float = np.inf) -> LMOptions:
    """Return the options of a search: `steps`, smallest gain in variances, loss to reach."""
    return LMOptions(
        predicted_decrease=min_gain,
        predicted_decrease_share=0.0,
        actual_decrease=min_gain,
        actual_decrease_share=1e-9,
        tolerance=target_loss,
        max_steps=steps,
        max_dampings=8,
        min_damping=1e-7,
    )


def fit_poles(
    problem: StepProblem,
    poles: Poles,
    releases: Sequence[ReleaseTiming],
    steps: int = 40,
    min_gain: float = 1e-2,
    fixed_count: int = 0,
    target_loss: float = np.inf,
) -> PoleFit:
    """Return the least-squares poles and releases from a start.

    It ends after `steps` steps, or at one that gains less than `min_gain`. The first `fixed_count` parameters are
    fixed. The fit is useless above `target_loss`.
    """
    start = problem.vector(poles, releases)

    def parts(vector: FloatArray) -> PoleCandidate | None:
        return problem.split(np.concatenate([start[:fixed_count], vector]), poles, releases)

    def at(vector: FloatArray) -> SeparablePoint | None:
        candidate = parts(vector)
        return None if candidate is None else problem.point(*candidate, fixed_count)

    first = at(start[fixed_count:])
    if first is None:
        raise ValueError(f"start: expected poles that oscillate and decay within their records, found {start.tolist()}")
    smallest = np.concatenate([poles.scale, np.tile([problem.step_s, 0.1, 0.1, 0.1], len(releases))])[fixed_count:]
    solution = levenberg_marquardt(
        at, first, search_options(steps, min_gain, target_loss), smallest, problem.prior(start, poles, fixed_count)
    )
    end = parts(solution.point.parameters)
    assert end is not None
    return PoleFit(*end, solution)


def covariances(
    point: SeparablePoint, variances: Sequence[FloatArray], prior_precision: FloatArray
) -> tuple[FloatArray, list[list[FloatArray]]]:
    """Return the covariance (P, P) of the parameters and the dependence of the coefficients.

    `variances`: of the columns (C,) of every block, in units of the weights. `prior_precision` (P,): reciprocal prior
    variances. Element [i][c] (B, P + B): change of the coefficients with the parameters, and a square root of their own
    covariance.
    """
    inverse, count = inverse_normal(point.normal[0] + np.diag(prior_precision)), len(point.parameters)
    spread, follows = np.diag(prior_precision), []
    for part, (indices, change, orthogonal, _), variance in zip(point.solved, point.jacobians, variances, strict=True):
        rows = []
        for c, size in enumerate(variance):
            along = part.basis.T @ change[:, :, c]
            free = change[:, :, c] - part.basis @ along
            spread[np.ix_(indices, indices)] += size * (free.T @ free + orthogonal[c])
            follow = np.zeros((len(part.root), count))
            follow[:, indices] = -part.root @ along
            rows.append(np.concatenate([follow, np.sqrt(size) * part.root], axis=1))
        follows.append(rows)
    return inverse @ spread @ inverse, follows


def inverse_normal(normal: FloatArray) -> FloatArray:
    """Return the inverse of a normal matrix, without undetermined directions."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(unit, unit)
    return np.asarray(np.linalg.pinv(normal * scale, rcond=1e-13, hermitian=True) * scale)


def model_covariance(
    model: MultiModel,
    spread: FloatArray,
    follows: Sequence[FloatArray],
    scale: FloatArray,
    coloured: tuple[FloatArray, FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (P, P) of the model's vector from a fit.

    The poles are first. `follows`: dependence of the coefficients of each element as in `covariances`, load by load and
    output by output, and their `scale`. Returned too: standard uncertainties (P,) from the noise of each element alone,
    0 for the poles. `coloured`: roots (P, K) and (D·C·B, K) of noise that is common to parameters and coefficients,
    where `spread` includes the first.
    """
    count, n = len(model.vector), model.shared
    rows, by_noise = np.zeros((count, len(spread))), np.zeros((count, count))
    rows[:n, :n] = np.diag(np.concatenate([np.ones(2 * len(model.frequency_hz)), model.real_hz]))
    for i, (follow, size) in enumerate(zip(follows, scale, strict=True)):
        rows_of_element = slice(n * (1 + i), n * (2 + i))
        rows[rows_of_element] = size * follow[:, : len(spread)]
        by_noise[rows_of_element, rows_of_element] = size**2 * follow[:, len(spread) :] @ follow[:, len(spread) :].T
    alone = np.asarray(np.sqrt(np.diag(by_noise)))
    if coloured is not None:
        along = np.zeros((count, coloured[0].shape[1]))
        along[n:] = np.repeat(scale, n)[:, None] * coloured[1]
        across = rows @ coloured[0] @ along.T
        by_noise += across + across.T + along @ along.T
    return np.asarray(rows @ spread @ rows.T + by_noise), alone


def lag_duration_prior(fit: PoleFit) -> FloatArray:
    """Return the prior precision (P,) of lags and durations from their bounds.

    To first order a lag 1/(1 + s/a) behind a release of duration T acts like a later release. To second order its 1/a²
    adds to the release's second moment, T²/12 for a ramp. The records determine the sum well. Each part is positive and
    at most the sum, and a time is at most its root: rectangular distributions of that half width.
    """
    poles, vector = fit.poles, fit.solution.point.parameters
    lags = np.arange(2 * poles.modes, poles.count)
    spread, precision, largest = inverse_normal(fit.solution.point.normal[0]), np.zeros(len(vector)), np.inf

    def bound(indices: IntArray | list[int], square: FloatArray | float, most: float) -> None:
        share = np.asarray(square) / most
        precision[indices] = 3.0 * np.maximum(share, 4.0 * share**2)

    squares = (2.0 * np.pi * poles.real_hz) ** -2.0
    for i, release in enumerate(fit.releases):
        index, moment = poles.count + TIMES * i + 1, release.moment_s2
        slope = np.zeros(len(vector))
        slope[lags], slope[index] = -2.0 * squares, 2.0 * moment
        u_whole = np.sqrt(np.maximum(slope @ spread @ slope, 0.0))
        whole = float(np.sum(squares) + moment + 2.0 * u_whole)
        bound([index], moment, whole)
        largest = min(largest, whole)
    bound(lags, squares, largest)
    return precision


def widen_for_lags(fit: PoleFit, spread: FloatArray) -> FloatArray:
    """Return the covariance (P, P), enlarged for the time 1/a of every lag.

    The records determine 1/a², and the time is not a linear function of it at large uncertainties. Along with the lag
    all parameters are widened so that 1.96 standard uncertainties include the root of the square's 1.96.
    """
    for lag in range(2 * fit.poles.modes, fit.poles.count):
        u = float(np.sqrt(spread[lag, lag]))
        far = max(
            1.0 - np.sqrt(max(1.0 - 2.0 * NORMAL_QUANTILE_95 * u, 0.0)),
            np.sqrt(1.0 + 2.0 * NORMAL_QUANTILE_95 * u) - 1.0,
        )
        more = max((far / (NORMAL_QUANTILE_95 * u)) ** 2, 1.0) - 1.0
        spread = spread + more * np.outer(spread[:, lag], spread[lag]) / u**2
    return spread


def _block(
    problem: StepProblem, poles: Poles, releases: Sequence[ReleaseTiming], indices: Sequence[int], fixed_count: int
) -> LinearBlock:
    """Return the block of a load's records in the bases of their responses."""
    records, smooth = [problem.records[i] for i in indices], poles.smooth
    shown = [record.explained(poles, releases[i]) for i, record in zip(indices, records, strict=True)]
    edges = np.cumsum([0, *(len(part.along) for part in shown)])
    free = poles.count if fixed_count < poles.count else 0  # parameters of free poles
    moved = np.concatenate([np.arange(free), *(poles.count + TIMES * i + np.arange(TIMES) for i in indices)])

    def changes(coefficients: FloatArray) -> BlockJacobian:
        """Return the changes by poles, which rotate the basis too, and by middle and duration."""
        outputs, count = coefficients.shape[1], len(moved)
        rotated = np.tensordot(poles.smooth_slopes[:free], coefficients, axes=1).transpose(1, 0, 2)
        re, im, real = np.split(smooth @ coefficients, [poles.modes, 2 * poles.modes])
        residues = np.concatenate([2 * (re + 1j * im), real])  # doubled for the conjugates of modes
        rows = np.zeros((edges[-1], count, outputs))
        orthogonal, pull = np.zeros((outputs, count, count)), np.zeros((outputs, count))
        for k, (i, record) in enumerate(zip(indices, records, strict=True)):
            mine = np.r_[:free, free + TIMES * k : free + TIMES * (k + 1)]
            answered = record.response_derivatives(poles.values, releases[i], fixed_poles=not free)
            columns, weights = moving(answered, residues, poles if free else None, releases[i])
            columns = record.without_level(columns.T).T
            part = shown[k]
            along = columns @ part.basis
            columns -= along @ part.basis.T
            change = (weights @ along).transpose(2, 1, 0)
            change[:, :free] += np.tensordot(part.triangle, rotated, axes=1)
            rows[edges[k] : edges[k + 1], mine] = change
            orthogonal[:, mine[:, None], mine] += weights @ (columns @ columns.T) @ weights.transpose(0, 2, 1)
            pull[:, mine] += np.einsum("cpq,qc->cp", weights, columns @ part.orthogonal)
        chosen = np.flatnonzero(moved >= fixed_count)
        if len(chosen) < count:
            rows, orthogonal, pull = rows[:, chosen], orthogonal[:, chosen[:, None], chosen], pull[:, chosen]
        return BlockJacobian(moved[chosen] - fixed_count, rows, orthogonal, pull)

    return LinearBlock(
        np.concatenate([part.triangle for part in shown]) @ smooth,
        np.concatenate([part.along for part in shown]),
        changes,
        float(sum(np.vdot(part.orthogonal, part.orthogonal) for part in shown)),
        sum(part.orthogonal.size - part.along.size for part in shown),
    )


def moving(
    answered: BlockResponses, residues: ComplexArray, poles: Poles | None, release: ReleaseTiming
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (R, A) of one record's rows, with weights (C, p, R)."""
    changes = [answered.by_onset, release.duration_s * answered.by_length]
    if len(answered.by_stage):
        by_share, by_part = answered.by_stage
        changes[1] = changes[1] + release.stages.part_s * by_part
        changes += [by_share, release.duration_s * by_part]
    times = [(residues.T @ change.T).real for change in changes]
    outputs, count = len(times[0]), 0 if poles is None else poles.count
    weights = np.zeros((outputs, count + TIMES, count + len(times) * outputs))
    each = np.arange(outputs)
    for k in range(len(times)):
        weights[each, count + k, count + k * outputs + each] = 1.0
    columns = times
    if poles is not None:
        which, slope = poles.slopes
        by_pole, parameter, m = (slope[:, None] * residues[which]).T, np.arange(count), poles.modes
        along = answered.by_pole.T
        columns = [along.real, along.imag[:m], *times]
        weights[:, parameter, which] = by_pole.real
        weights[:, parameter[: 2 * m], m + len(poles.real_hz) + which[: 2 * m]] = -by_pole.imag[:, : 2 * m]
    return np.concatenate(columns), weights


def by_record(problem: StepProblem, fit: PoleFit) -> list[tuple[int, FloatArray]]:
    """Return the residual of every record (A, C), load by load."""
    rests: list[tuple[int, FloatArray]] = []
    for component, rest in zip(problem.components, fit.solution.point.residuals, strict=True):
        start = 0
        for i in problem.record_indices(component):
            part = problem.records[i].explained(fit.poles, fit.releases[i])
            rests.append((i, part.basis @ rest[start : start + len(part.along)] + part.orthogonal))
            start += len(part.along)
    return rests
