"""Records of several releases as one least squares problem: poles are shared, residues are shared by a load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray
from shaker.decoupling.model import Poles
from shaker.fitting import Block, Minimum, Prior, Rules, Separable, levenberg_marquardt
from shaker.release.record import Shape
from shaker.release.response import MOMENTS, Answers, Load, Samples, answers, averaged, responses

_REACH = 1.96  # standard uncertainties of 95 %
_LOOSE = (1.5, 2.0)  # standard deviations of what a start says of logarithms of real poles and of durations


@dataclass(frozen=True)
class Release:
    """When a load changes: middle and duration in s, and how it goes."""

    middle_s: float
    duration_s: float
    shape: Shape


@dataclass(frozen=True)
class Sampled:
    """One record ready for a fit: means over blocks of samples (A, C) over their noise, times, load."""

    name: str
    component: str
    amplitude: float
    samples: Samples

    def answers(self, poles: ComplexArray, release: Release) -> Answers:
        """Return what poles answer to the release, with slopes."""
        load = Load(release.shape, self.amplitude)
        return answers(load, poles, self.samples, release.middle_s, release.duration_s)

    def cut(self, from_s: float, to_s: float) -> Sampled:
        """Return the record between two times."""
        near = self.samples.between(from_s, to_s)
        return replace(self, samples=replace(near, value=near.value - near.value.mean(axis=0)))


def prepared(samples: FloatArray, start_s: float, rate_hz: float, noise: FloatArray, size: int) -> Samples:
    """Return means over `size` samples (C, N) over their noise (C,), the mean of the record taken off."""
    data = averaged(samples, size).T / (noise / np.sqrt(size))
    count = len(data)
    time_s = start_s + np.arange(count) * size / rate_hz
    return Samples(time_s, np.full(count, size, dtype=np.int64), data - data.mean(axis=0), 1.0 / rate_hz)


@dataclass(frozen=True)
class StepProblem:
    """All records by load component: the least squares problem of poles and releases.

    A sensor's outputs follow displacements, so that no load, however sudden, gives them a velocity at once, and every
    real pole is a lag of the amplifier behind them: H falls as s^-(2 + Q), Σ R·p^k = 0 for k = 0 … Q in every element.
    This is what tells the beginning of a release from a delay of the outputs; designs have the columns that are left
    (`Poles.smooth`).

    Parameters: those of the poles, then middle and logarithm of the duration of every record in the order of `records`.
    """

    records: tuple[Sampled, ...]
    components: tuple[str, ...]

    @property
    def values(self) -> int:
        """Number of data."""
        return sum(record.samples.value.size for record in self.records)

    @property
    def step_s(self) -> float:
        """Sampling interval."""
        return self.records[0].samples.step_s

    def places(self, component: str) -> list[int]:
        """Return the records of a load."""
        return [i for i, record in enumerate(self.records) if record.component == component]

    def part(self, places: Sequence[int]) -> StepProblem:
        """Return some records of one load alone."""
        return StepProblem(tuple(self.records[i] for i in places), (self.records[places[0]].component,))

    def vector(self, poles: Poles, releases: Sequence[Release]) -> FloatArray:
        """Return all parameters."""
        own = [value for release in releases for value in (release.middle_s, np.log(release.duration_s))]
        return np.concatenate([poles.vector, own])

    def prior(self, vector: FloatArray, poles: Poles) -> Prior:
        """Return what a start says of lags and durations, loosely: it leads a search along the valley between them."""
        u = np.full(len(vector), np.inf)
        u[2 * poles.modes : poles.count], u[poles.count + 1 :: 2] = _LOOSE
        return Prior(vector, u)

    def split(
        self, vector: FloatArray, poles: Poles, releases: Sequence[Release]
    ) -> tuple[Poles, tuple[Release, ...]] | None:
        """Return poles and releases of a vector, None where they are not allowed."""
        there, own = poles.with_vector(vector), vector[poles.count :].reshape(-1, 2)
        longest = np.array([float(np.ptp(record.samples.time_s)) for record in self.records])
        durations = np.exp(np.clip(own[:, 1], -50.0, 50.0))
        if not there.allowed or np.any(durations > longest):
            return None
        times = zip(releases, own[:, 0], durations, strict=True)
        moved = (replace(release, middle_s=float(t), duration_s=float(length)) for release, t, length in times)
        return there, tuple(moved)

    def point(self, poles: Poles, releases: Sequence[Release]) -> Separable:
        """Return poles and releases as a point of the search, with one block of rows per load component."""
        blocks = tuple(_block(self, poles, releases, self.places(component)) for component in self.components)
        return Separable(self.vector(poles, releases), blocks)


@dataclass(frozen=True)
class Fitted:
    """Poles and releases with the least squares solution they come from."""

    poles: Poles
    releases: tuple[Release, ...]
    solution: Minimum[Separable]

    @property
    def loss(self) -> float:
        """Sum of squares."""
        return self.solution.point.loss


def rules(steps: int, calm: float) -> Rules:
    """Return when a search ends: after so many steps, or where one gains less than `calm` units of the variance."""
    return Rules(foretold=calm, foretold_share=0.0, gained=calm, gained_share=1e-9, steps=steps, tries=8, least=1e-7)


def fit_poles(
    problem: StepProblem, poles: Poles, releases: Sequence[Release], steps: int = 40, calm: float = 1e-2
) -> Fitted:
    """Return the least squares poles and releases from a start, by at most `steps` steps or till one gains `calm`."""

    def at(vector: FloatArray) -> Separable | None:
        parts = problem.split(vector, poles, releases)
        return None if parts is None else problem.point(*parts)

    start = problem.vector(poles, releases)
    first = at(start)
    if first is None:
        raise ValueError(f"start: expected poles that swing and decay, found {start.tolist()}")
    smallest = np.concatenate([poles.scale, np.tile([problem.step_s, 0.1], len(releases))])
    solution = levenberg_marquardt(at, first, rules(steps, calm), smallest, problem.prior(start, poles))
    parts = problem.split(solution.point.parameters, poles, releases)
    assert parts is not None
    return Fitted(*parts, solution)


def covariances(
    point: Separable, variances: Sequence[FloatArray], known: FloatArray
) -> tuple[FloatArray, list[list[FloatArray]]]:
    """Return the covariance (P, P) of the parameters, and for every block and column how its coefficients follow them.

    `variances`: of the columns (C,) of every block, in units of the weights; `known` (P,): reciprocal variances of what
    is known of the parameters beforehand. Element [i][c] (B, P + B): change of the coefficients with the parameters,
    beside a square root of their covariance where the parameters are known.
    """
    normal, count = point.normal[0] + np.diag(known), len(point.parameters)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * np.outer(unit, unit), rcond=1e-13, hermitian=True) * np.outer(unit, unit)
    spread, follows = np.diag(known), []
    for part, (places, change), variance in zip(point.solved, point.slopes, variances, strict=True):
        rows = []
        for c, size in enumerate(variance):
            along = part.basis.T @ change[:, :, c]
            free = change[:, :, c] - part.basis @ along
            spread[np.ix_(places, places)] += size * (free.T @ free)
            follow = np.zeros((len(part.root), count))
            follow[:, places] = -part.root @ along
            rows.append(np.concatenate([follow, np.sqrt(size) * part.root], axis=1))
        follows.append(rows)
    return inverse @ spread @ inverse, follows


def left_open(found: Fitted) -> FloatArray:
    """Return the reciprocal variances (P,) of lags and durations by what bounds them.

    A lag 1/(1 + s/a) behind a release that takes the time T acts like a later release to first order, and to second
    order its 1/a² adds to the release's second moment, T²/12 along a line. The records tell the sum well, and even
    where they cannot tell the parts apart each of these is positive and at most the sum, as is a time at most its root:
    rectangular distributions of that half width.
    """
    poles, vector = found.poles, found.solution.point.parameters
    lags = np.arange(2 * poles.modes, poles.count)
    normal, largest = found.solution.point.normal[0], np.inf
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    spread = np.linalg.pinv(normal * np.outer(unit, unit), rcond=1e-13, hermitian=True) * np.outer(unit, unit)
    known = np.zeros(len(vector))

    def bound(places: IntArray | list[int], square: FloatArray | float, most: float) -> None:
        share = np.asarray(square) / most
        known[places] = 3.0 * np.maximum(share, 4.0 * share**2)

    squares = (2.0 * np.pi * poles.real_hz) ** -2.0
    for i, release in enumerate(found.releases):
        own = poles.count + 2 * i + 1
        moment = MOMENTS[release.shape] * release.duration_s**2
        slope = np.zeros(len(vector))
        slope[lags], slope[own] = -2.0 * squares, 2.0 * moment
        u_whole = np.sqrt(np.maximum(slope @ spread @ slope, 0.0))
        whole = float(np.sum(squares) + moment + 2.0 * u_whole)
        bound([own], moment, whole)
        largest = min(largest, whole)
    bound(lags, squares, largest)
    return known


def widened(found: Fitted, spread: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of the parameters, wide enough for the time 1/a of every lag.

    Records tell 1/a², of which the time is no linear function where little is known: along with the lag everything is
    widened so that 1.96 standard uncertainties reach as far as the root of what 1.96 of the square allow.
    """
    for lag in range(2 * found.poles.modes, found.poles.count):
        u = float(np.sqrt(spread[lag, lag]))
        far = max(1.0 - np.sqrt(max(1.0 - 2.0 * _REACH * u, 0.0)), np.sqrt(1.0 + 2.0 * _REACH * u) - 1.0)
        more = max((far / (_REACH * u)) ** 2, 1.0) - 1.0
        spread = spread + more * np.outer(spread[:, lag], spread[lag]) / u**2
    return spread


def decay_start(samples: Samples, release: Release) -> int:
    """Return the first block of samples of which none is taken while the load changes."""
    end_s = release.middle_s + release.duration_s / 2.0
    return int(np.searchsorted(samples.time_s, end_s))


def _block(problem: StepProblem, poles: Poles, releases: Sequence[Release], places: Sequence[int]) -> Block:
    """All records of one load; the level of each is taken off data and design alike."""
    records, smooth, modes = [problem.records[i] for i in places], poles.smooth, poles.modes
    edges = np.cumsum([0, *(len(record.samples.time_s) for record in records)])
    designs = []
    for i, record in zip(places, records, strict=True):
        load, release = Load(releases[i].shape, record.amplitude), releases[i]
        value = responses(load, poles.values, record.samples, release.middle_s, release.duration_s)
        upper, real = value[:, :modes], value[:, modes:]
        columns = np.concatenate([2 * upper.real, -2 * upper.imag, real.real], axis=1)
        designs.append(columns - columns.mean(axis=0))
    design = np.concatenate(designs)
    moved = np.concatenate([np.arange(poles.count), *(poles.count + 2 * i + np.arange(2) for i in places)])

    def changes(own: FloatArray) -> tuple[IntArray, FloatArray]:
        """Poles move the responses and turn the basis; middle and duration move those of their own record."""
        found = np.zeros((edges[-1], len(moved), own.shape[1]))
        turned = np.einsum("pbs,sc->bpc", poles.smooth_slopes, own)
        re, im, real = np.split(smooth @ own, [modes, 2 * modes])
        residues = np.concatenate([2 * (re + 1j * im), real])  # those of modes twice, for their conjugates
        which, slope = poles.slopes
        for k, (i, record) in enumerate(zip(places, records, strict=True)):
            rows, here = slice(edges[k], edges[k + 1]), record.answers(poles.values, releases[i])
            along = here.by_pole[:, which, None] * (slope[:, None] * residues[which])
            found[rows, : poles.count] = along.real + np.tensordot(designs[k], turned, axes=1)
            found[rows, poles.count + 2 * k] = (here.by_onset @ residues).real
            found[rows, poles.count + 2 * k + 1] = releases[i].duration_s * (here.by_length @ residues).real
            found[rows] -= found[rows].mean(axis=0)
        return moved, found

    return Block(design @ smooth, np.concatenate([record.samples.value for record in records]), changes)
