"""Outputs per direction of gravity, from readings of a sensor in any orientations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shaker.static_rotation.rounding import Rounding, last_digit
from shaker.static_rotation.series_noise import DriftingFit, coefficient_covariance, find_walks, walk_covariance
from shaker.static_rotation.weight_model import OutputEffect
from shakercal._common.arrays import Arrays, FloatArray, IntArray, check_shape
from shakercal._common.propagation import covariance_root

SAME_DIRECTION_RAD = 1e-3  # about 0.06°
MIN_ORIENTATIONS = 6
MIN_SPREAD, SECOND_SPREAD = 1e-3, 0.1
"""Standard deviation of gravity's direction along an axis from which outputs along it are fitted, and that which the
second axis must have."""
MOST_POSES = 1000  # beyond which neighbouring ones are averaged
MIN_DRIFT_POSES = 12  # from which a linear drift is always fitted
CHANCE = 1e-3  # of a false term
SAME_SCATTER = 0.05  # chance below which the scatter of poses exceeds that of repeated readings
PLAY = 0.5  # half width of a play element over the largest output
LOOP_OF_STEPS = 1.5  # a loop over that of one play element: of elements of other widths some are not run through
PRECISION = 1e-12  # relative, of computed numbers
UNKNOWN_TILT_RAD = 0.1


@dataclass(frozen=True, repr=False)
class OrientationSeries(Arrays, shapes="direction N 3; tilt N 2 3; time N"):
    """Gravity's `direction` (N, 3) in sensor axes.

    `tilt` (N, 2, 3): its change per rad of two tilts of the world.

    `time` (N,): of the readings in s, or their order.
    """

    direction: FloatArray
    tilt: FloatArray
    time: FloatArray


@dataclass(frozen=True, repr=False)
class OrientationFit(
    Arrays,
    shapes="channels C; direction N 3; reading N C; time N; count N; design N P; coefficient P C; basis K 3; noise C C",
):
    """Readings (N, C) of N poses as constant, gravity along K axes, and drift.

    reading = design · coefficient + residual. `terms` (P,): constant, "gravity 1" … along the rows of `basis` (K, 3)
    from the mean direction, and drift (over the time, from -1 to 1). `covariance` (P·C, P·C): of noise with `dof`
    degrees of freedom, of the terms. `effects`: of further causes on them.
    `noise` (C, C): covariance of the reading of a pose. `down_tilt`, `u_down_tilt` (2,): estimated tilt of the
    world, rad. `walk`
    (C,): variance of a random walk over the series, over that of the noise. `loop` (2, C): square of the
    loop that the difference between readings after a rise and after a fall shows, and its variance.
    """

    channels: tuple[str, ...]
    direction: FloatArray
    reading: FloatArray
    time: FloatArray
    count: IntArray
    terms: tuple[str, ...]
    design: FloatArray
    coefficient: FloatArray
    basis: FloatArray
    covariance: FloatArray
    noise: FloatArray
    dof: float
    effects: tuple[OutputEffect, ...]
    down_tilt: FloatArray
    u_down_tilt: FloatArray
    walk: FloatArray
    loop: FloatArray

    @property
    def residual(self) -> FloatArray:
        """Residuals (N, C) of the readings."""
        return np.asarray(self.reading - self.design @ self.coefficient)

    @property
    def axes(self) -> int:
        """Number of axes along which gravity varies."""
        return len(self.basis)

    @property
    def mean(self) -> FloatArray:
        """Mean direction (3,) of gravity."""
        return np.asarray(self.direction.mean(axis=0))

    @property
    def combined(self) -> FloatArray:
        """Covariance (P·C, P·C) of the terms, of all causes."""
        stated = (each.effect @ each.effect.T for each in self.effects)
        return np.asarray(self.covariance + sum(stated, np.zeros_like(self.covariance)))

    @property
    def condition(self) -> float:
        """Condition number of offset and three axes of gravity, infinite if an axis is missing."""
        size = np.linalg.svd(np.column_stack([np.ones(len(self.direction)), self.direction]), compute_uv=False)
        return float(size[0] / size[-1]) if self.axes == 3 and size[-1] > 0.0 else np.inf

    def further_pose(self) -> FloatArray:
        """Return the axis (3,), up or down, that the poses determine least."""
        design = np.column_stack([np.ones(len(self.direction)), self.direction])
        candidates = np.column_stack([np.ones(6), np.vstack([np.eye(3), -np.eye(3)])])
        normal = design.T @ design + MIN_SPREAD**2 * np.eye(4)
        return np.asarray(candidates[np.argmax(np.sum(candidates @ np.linalg.inv(normal) * candidates, axis=1)), 1:])


def fit_orientations(
    channels: tuple[str, ...],
    series: OrientationSeries,
    reading: FloatArray,
    digit: FloatArray | None = None,
    u_pose_rad: float = 0.0,
    u_down_rad: float | None = None,
) -> OrientationFit:
    """Fit constant, gravity and drift to readings (N, C) in any orientations.

    Parameters
    ----------
    channels
        names of the outputs
    series
        gravity's direction of every reading
    reading
        readings (N, C); consecutive ones of one direction are one pose, of which the mean is fitted
    digit
        last digit (C,) of the readings, by default found from them
    u_pose_rad
        standard uncertainty of every orientation about each axis, rad, independent from pose to pose
    u_down_rad
        that of down in the world; by default its tilt is fitted if it is significant

    Returns
    -------
    OrientationFit : outputs per direction of gravity with their covariance

    Raises
    ------
    ValueError : fewer than six orientations, or gravity along one line only

    Notes
    -----
    A linear drift is fitted to 12 poses or more, to fewer if it is significant. A random walk enters the covariance of
    a channel if its restricted likelihood asks for it. Repeated readings in one pose supply noise, which is combined
    with the scatter of the poses if that is not larger.
    """
    values = np.asarray(reading, np.float64)
    check_shape("reading", values, (len(series.time), len(channels)))
    poses, means, count, within = _poses(series, values)
    basis = _basis(poses.direction)
    place = _places(poses.direction)
    if place.max() + 1 < MIN_ORIENTATIONS or len(basis) < 2:
        raise ValueError(f"orientation: expected at least six different orientations, found {place.max() + 1}")
    digits = np.array([last_digit(column) for column in values.T]) if digit is None else digit
    rounding = Rounding(digits * _undithered(digits, within, count))
    floor = rounding.variance + (PRECISION * np.abs(values).max(axis=0)) ** 2
    problem = _Problem(channels, poses, means, count, basis, within, rounding, floor)
    drifting = len(means) >= MIN_DRIFT_POSES or problem.drifts()
    problem = replace(problem, drift=drifting)
    return problem.solved(place, u_pose_rad, u_down_rad)


def linear_misfit(direction: FloatArray, reading: FloatArray) -> float:
    """Return the median share of the variance of readings that gravity leaves.

    `direction` (N, 3), `reading` (N, C).
    """
    design = np.column_stack([np.ones(len(direction)), direction])
    residual = reading - design @ np.linalg.lstsq(design, reading, rcond=None)[0]
    total = np.sum((reading - reading.mean(axis=0)) ** 2, axis=0)
    changing = total > 0.0
    return float(np.median(np.sum(residual**2, axis=0)[changing] / total[changing])) if changing.any() else 0.0


def _poses(
    series: OrientationSeries, values: FloatArray
) -> tuple[OrientationSeries, FloatArray, IntArray, tuple[FloatArray, int]]:
    """Return the means of consecutive readings in one direction.

    With their numbers, and the covariance of a mean by the readings within a pose.
    """
    starts = [0]
    for i, direction in enumerate(series.direction):
        if np.linalg.norm(direction - series.direction[starts[-1]]) > SAME_DIRECTION_RAD:
            starts.append(i)
    joined = -(-len(starts) // MOST_POSES)
    owner = np.zeros(len(values), np.int64)
    owner[starts[1:]] = 1
    pose = np.cumsum(owner)
    counts, means = _mean(pose, values)
    left = values - means[pose]
    freedom = len(values) - len(counts)
    within = left.T @ left / max(freedom, 1) * float(np.mean(1.0 / counts))
    block = np.arange(len(counts)) // joined
    mean = [_mean(block, _mean(pose, array)[1])[1] for array in (series.direction, series.tilt, series.time, values)]
    number = np.bincount(block, counts).astype(np.int64)
    return OrientationSeries(*mean[:3]), mean[3], number, (within / joined, freedom)


def _undithered(digit: FloatArray, within: tuple[FloatArray, int], count: IntArray) -> FloatArray:
    """Return the share (C,) of the rounding error in means of `count` noisy readings."""
    number = 1.0 / float(np.mean(1.0 / count))
    noise = np.diag(within[0]) * number / np.where(digit > 0.0, digit, np.inf) ** 2
    left_share = np.exp(-4.0 * np.pi**2 * np.maximum(noise - 1.0 / 12.0, 0.0))
    return np.asarray(np.sqrt(np.maximum(left_share, 1.0 / number)))


def _mean(group: IntArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the sizes of groups and the mean of values (N, ...) in each."""
    size = np.bincount(group).astype(np.float64)
    total = np.zeros((len(size), *values.shape[1:]))
    np.add.at(total, group, values)
    return size, total / size.reshape(-1, *[1] * (values.ndim - 1))


def _basis(direction: FloatArray) -> FloatArray:
    """Return the axes (K, 3) along which gravity varies."""
    _, size, axes = np.linalg.svd(direction - direction.mean(axis=0), full_matrices=False)
    spread = size / np.sqrt(len(direction))
    if len(spread) < 2 or spread[1] < SECOND_SPREAD:
        raise ValueError(
            "orientation: expected gravity along at least two axes of the sensor, found it along "
            f"({', '.join(f'{x:.2f}' for x in axes[0])}) alone; add poses about another axis"
        )
    return np.asarray(axes[spread > MIN_SPREAD])


def _places(direction: FloatArray) -> IntArray:
    """Return the index (N,) of every direction among the different ones."""
    near = np.linalg.norm(direction[:, None] - direction, axis=2) < SAME_DIRECTION_RAD
    return np.asarray(np.unique(np.argmax(near, axis=1), return_inverse=True)[1].ravel(), np.int64)


@dataclass(frozen=True)
class _Problem:
    """Readings (N, C) of poses as a linear model of gravity.

    `within`: covariance of a mean by the readings of a pose, with its degrees of freedom.
    """

    channels: tuple[str, ...]
    series: OrientationSeries
    reading: FloatArray
    count: IntArray
    basis: FloatArray
    within: tuple[FloatArray, int]
    rounding: Rounding
    floor: FloatArray
    drift: bool = False

    @cached_property
    def time(self) -> FloatArray:
        """Time (N,) from -1 to 1."""
        time = self.series.time
        return np.asarray(2.0 * (time - time.min()) / np.ptp(time) - 1.0)

    @cached_property
    def design(self) -> FloatArray:
        """Columns (N, P): axes of gravity, constant, drift."""
        along = (self.series.direction - self.series.direction.mean(axis=0)) @ self.basis.T
        columns = [along, np.ones((len(along), 1))] + ([self.time[:, None]] if self.drift else [])
        return np.hstack(columns)

    def drifts(self) -> bool:
        """Return whether a linear drift is significant in one channel."""
        from scipy.special import fdtrc

        with_drift = replace(self, drift=True)
        dof = len(self.reading) - with_drift.design.shape[1]
        if dof < 1:
            return False
        before, after = (np.sum(p.left(self.reading) ** 2, axis=0) for p in (self, with_drift))
        after = np.maximum(after, dof * self.floor)
        chance = fdtrc(1, dof, np.maximum(before - after, 0.0) * dof / after)
        return bool(np.min(chance) < CHANCE / len(self.channels))

    def left(self, values: FloatArray) -> FloatArray:
        """Return values (N, ...) less their least-squares fit."""
        basis = np.linalg.qr(self.design)[0]
        return np.asarray(values - basis @ (basis.T @ values))

    def solved(self, place: IntArray, u_pose_rad: float, u_down_rad: float | None) -> OrientationFit:
        """Return the fit, the tilt of the world estimated with it."""
        walk = find_walks(self.design, self.reading, walk_covariance(self.time), self.floor)
        tilt, problem = np.zeros(2), self
        solution = _Solution.of(self, walk)
        down: FloatArray = np.zeros((2, 2))
        if self.series.tilt.any() and u_down_rad != 0.0:
            for _ in range(3):
                step, covariance, significant = solution.down_tilt(u_down_rad, tilt)
                if u_down_rad is None and not significant and not tilt.any():
                    break
                tilt, down = tilt + step, covariance
                moved = self.series.direction + np.tensordot(tilt, self.series.tilt, (0, 1))
                moved *= np.linalg.norm(self.series.direction, axis=1, keepdims=True) / np.linalg.norm(
                    moved, axis=1, keepdims=True
                )
                problem = replace(self, series=replace(self.series, direction=moved))
                solution = _Solution.of(problem, walk)
        return solution.result(place, u_pose_rad, tilt, down)


@dataclass(frozen=True)
class _Solution:
    """A fit of a problem, with the covariance (C, C) of its noise."""

    problem: _Problem
    fit: DriftingFit
    noise: FloatArray
    dof: float

    @staticmethod
    def of(problem: _Problem, walk: FloatArray) -> _Solution:
        from scipy.special import fdtrc

        fit = DriftingFit.of(problem.design, problem.reading, walk, walk_covariance(problem.time))
        (noise, dof), (within, freedom) = (fit.noise, fit.dof), problem.within
        if freedom and not walk.any() and np.all(np.diag(within) > 0.0):
            chance = fdtrc(dof, freedom, np.diag(noise) / np.diag(within))
            if np.min(chance) > SAME_SCATTER / len(chance):
                noise, dof = (dof * noise + freedom * within) / (dof + freedom), dof + freedom
        noise = noise + np.diag(np.maximum(0.0, problem.floor - np.diag(noise)))
        return _Solution(problem, fit, noise, dof)

    @property
    def gradient(self) -> FloatArray:
        """Output (C, 3) per direction of gravity."""
        return np.asarray(self.fit.coefficient[: len(self.problem.basis)].T @ self.problem.basis)

    def white_left(self, columns: FloatArray) -> FloatArray:
        """Return columns (N, C) of every channel less their fit, whitened, over the noise."""
        return np.asarray(self.fit.left(columns) / np.sqrt(np.diag(self.noise)))

    def tilted(self) -> FloatArray:
        """Return the change (2, N, C) of the readings per tilt of the world."""
        return np.asarray(np.einsum("njx,cx->jnc", self.problem.series.tilt, self.gradient))

    def down_tilt(self, u_down_rad: float | None, tilt: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
        """Return a step (2,) of the world's tilt, its covariance and significance."""
        from scipy.special import fdtrc

        columns = np.stack([self.white_left(each).ravel() for each in self.tilted()], axis=1)
        left = (self.fit.whitened / np.sqrt(np.diag(self.noise))).ravel()
        prior = np.eye(2) / (UNKNOWN_TILT_RAD if u_down_rad is None else u_down_rad) ** 2
        covariance = np.linalg.inv(columns.T @ columns + prior)
        step = covariance @ (columns.T @ left - prior @ tilt)
        terms, count = self.fit.coefficient.shape
        freedom = float(len(left) - terms * count - 2)
        if freedom < 1.0:
            return step, np.asarray(covariance, np.float64), False
        left_over = max(float(np.sum((left - columns @ step) ** 2)) / freedom, np.finfo(np.float64).tiny)
        ratio = float(step @ (columns.T @ columns) @ step) / 2.0 / left_over
        return step, np.asarray(covariance, np.float64), bool(fdtrc(2.0, freedom, ratio) < CHANCE)

    def pose_errors(self, place: IntArray, u_pose_rad: float) -> tuple[FloatArray, FloatArray]:
        """Return the effect (P·C, r) of errors of the poses on the terms.

        With their variance (C,) in a reading.
        """
        direction, terms = self.problem.series.direction, len(self.fit.coefficient)
        lever = u_pose_rad * np.cross(direction[None], self.gradient[:, None])
        effect = np.zeros((terms, len(self.problem.channels), place.max() + 1, 3))
        each = np.einsum("ctn,cnx->ntcx", self.fit.estimator, lever)
        np.add.at(effect.transpose(2, 0, 1, 3), place, each)
        wide = effect.reshape(terms * len(self.problem.channels), -1)
        return covariance_root(wide @ wide.T), np.mean(np.sum(lever**2, axis=2), axis=1)

    def loop(self) -> FloatArray:
        """Return the square (C,) of the loop, and its variance.

        By the readings against a play element, which knows how far the output last rose or fell.
        """
        gravity = self.problem.design[:, : len(self.problem.basis)] @ self.fit.coefficient[: len(self.problem.basis)]
        radius = np.maximum(PLAY * np.max(np.abs(gravity), axis=0), np.finfo(np.float64).tiny)
        held, behind = gravity[0], np.zeros_like(gravity)
        for row, value in zip(behind, gravity, strict=True):
            held = np.clip(held, value - radius, value + radius)
            row[:] = value - held
        sense = 0.5 * behind / radius
        columns = self.white_left(sense)
        size = np.sum(columns**2, axis=0)
        inverse = np.divide(LOOP_OF_STEPS**2, size, out=np.zeros(len(size)), where=size > 0.0)
        found = np.sum(columns * self.fit.whitened / np.sqrt(np.diag(self.noise)), axis=0)
        return np.stack([found**2 * inverse / np.where(size > 0.0, size, 1.0), inverse])

    def result(self, place: IntArray, u_pose_rad: float, tilt: FloatArray, down: FloatArray) -> OrientationFit:
        """Return the fit with the effects of all causes on its terms."""
        problem, terms = self.problem, len(self.fit.coefficient)
        noise, effects = problem.rounding.without(self.noise), list[OutputEffect]()
        rounded = problem.rounding.effect(
            self.fit.estimator, problem.design, problem.reading, self.fit.coefficient, self.noise, range(terms)
        )
        effects.append(OutputEffect("rounding", rounded))
        if u_pose_rad > 0.0:
            effect, variance = self.pose_errors(place, u_pose_rad)
            effects.append(OutputEffect("orientation of the poses", effect))
            size = np.where(np.diag(noise) > 0.0, np.diag(noise), np.inf)
            least = np.minimum(np.diag(problem.within[0]) / size, 1.0)
            share = np.sqrt(np.maximum(1.0 - variance / size, least))
            noise = noise * np.outer(share, share)
        if down.any():
            tilted = np.einsum("ctn,jnc->tcj", self.fit.estimator, self.tilted()).reshape(-1, 2)
            effects.append(OutputEffect("direction of down", tilted @ covariance_root(down)))
        covariance = coefficient_covariance(self.fit.spread, noise)
        gravity = (f"gravity {k}" for k in range(1, 1 + len(problem.basis)))
        names = (*gravity, "constant", *(["drift"] if problem.drift else []))
        return OrientationFit(
            problem.channels, problem.series.direction, problem.reading, problem.series.time, problem.count, names,
            problem.design, self.fit.coefficient, problem.basis, covariance, self.noise, self.dof,
            tuple(effects), tilt, np.sqrt(np.diag(down)), self.fit.walk, self.loop(),
        )  # fmt: skip
