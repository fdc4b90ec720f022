"""Fixed pattern of image sensors: its effect on a body's motion, measured and corrected.

A frame is scene times pattern, and so is the reference. Moved by u, the reference's pattern P meets the frame's at
P(x + u): their difference is part of the misfit, least at u = 0, and shortens every small motion. Half the derivative
of that part by u is the slope that the pattern adds to the fit. So the growth of the misfit with the motion, which is
measured, gives the correction. Gains that alternate from pixel to pixel are an exception, since a spline has no slope
at their pixels: they are corrected in the images (`sequence.AlternatingGains`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from photogram.bspline import noise_gain, pattern_overlap, slope_noise_gain
from photogram.direct.direct_fit import BodyView, DirectFit, without_noise
from photogram.geometry import rotation_from_vector, rotation_vector_rate
from photogram.images.sensor_pattern import SensorPattern
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.propagation import covariance_root

PARTS = ("pixels", "columns", "rows", "shadows")
"""Parts of a pattern: independent pixels; whole columns and rows; dust, whose shadows are some pixels wide."""
SHADOW_PX = 3.0  # standard deviation of a shadow's profile, chosen
MODEL_SHARE, LARGE_PRNU, LARGEST_SHARE = 0.03, 0.012, 0.3
"""Relative standard uncertainty of a correction by patterns of other kinds, chosen; the PRNU above which it grows."""
FRAMES_AT_ONCE = 256
MIN_FREE_FRAMES, OUTLIER, ROUNDS = 3, 4.0, 3
"""Frames beyond the unknowns; robust standard deviations of a rejected misfit, and rounds of rejection."""


@dataclass(frozen=True, eq=False, repr=False)
class FixedPattern(Arrays, shapes="correction F 6; change F J 6; variance V 2; estimate 6 6"):
    """Effect of the fixed pattern on a body's motion.

    Attributes
    ----------
    correction : (F, 6), which has been added to the poses of the frames with a direct fit.
    change : (F, J, 6) its change by one standard uncertainty of each of J independent unknowns.
    variance : (V, 2) of each camera, variance of the pixels' pattern over that of `patterns`, and its standard
        uncertainty.
    patterns : what was known of each camera's.
    estimate : (6, 6), which converts slopes summed over cells into a motion.
    """

    correction: FloatArray
    change: FloatArray
    variance: FloatArray
    patterns: tuple[SensorPattern, ...]
    estimate: FloatArray

    @property
    def prnu(self) -> FloatArray:
        """Relative rms of the pixels' gains, and its standard uncertainty, of each camera (V, 2)."""
        nominal, (size, u) = np.array([one.prnu for one in self.patterns]), self.variance.T
        found = np.sqrt(np.maximum(size, 0.0))
        above = np.sqrt(np.maximum(size, 0.0) + u)
        return np.column_stack([nominal * found, nominal * (above - found)])


@dataclass(frozen=True, eq=False, repr=False)
class PatternModel(Arrays, shapes="variance C 4"):
    """Patterns of unit size in one camera.

    Attributes
    ----------
    variance : (C, 4) of each cell, Σw·v over its pixels with the variance v of each of `PARTS`.
    """

    view: BodyView
    degree: int
    variance: FloatArray

    @classmethod
    def of(cls, view: BodyView, pattern: SensorPattern, degree: int, full_scale: float) -> PatternModel:
        """Return a camera's model: pixels as `pattern`, other parts of relative variance 1."""
        cells = view.cells
        grey2 = np.where(view.steady, np.nan_to_num(cells.energy) + cells.weight * cells.mean**2, 0.0)
        mean2 = grey2 / np.where(cells.weight > 0.0, cells.weight, 1.0)
        pixels = np.where(view.steady, cells.weight * pattern.variance(mean2, full_scale), 0.0)
        return cls(view, degree, np.column_stack([pixels, grey2, grey2, grey2]))

    @property
    def curvature(self) -> FloatArray:
        """Slopes (4, 2) per variance, weight and small shift along x and y."""
        white, wide = slope_noise_gain(self.degree), 0.5 / SHADOW_PX**2
        return np.array([[white, white], [white, 0.0], [0.0, white], [wide, wide]])

    def misfits(self, pose: FloatArray) -> FloatArray:
        """Return what each part adds to the misfit (F, 4) at poses (F, 6).

        White pixels of variance v differ by v·(κ + 1 − 2·h(u_x)·h(u_y)), with the gain κ of interpolation
        (`bspline.pattern_overlap`). Columns do so along x, rows along y. Shadows are smooth: 2·(1 − R), with
        R = exp(−u²/4σ²).
        """

        def added(shift: FloatArray) -> FloatArray:
            value, _ = pattern_overlap(shift, self.degree)
            gain = noise_gain(shift, self.degree)
            both = gain.prod(axis=2) + 1.0 - 2.0 * value.prod(axis=2), *np.moveaxis(gain + 1.0 - 2.0 * value, 2, 0)
            differences = np.stack([*both, 2.0 * (1.0 - _smooth_overlap(shift))], axis=2)
            return np.asarray(np.einsum("ck,fck->fk", self.variance, differences))

        return self._of_frames(added, pose)

    def slopes(self, pose: FloatArray) -> FloatArray:
        """Return what each part adds to the slope (F, 4, 6) at poses (F, 6).

        The slopes of the reference correlate with the pattern of the frame.
        """

        def added(shift: FloatArray) -> FloatArray:
            value, slope = pattern_overlap(shift, self.degree)
            none = np.zeros_like(shift[..., 0])
            columns, rows = np.stack([slope[..., 0], none], axis=2), np.stack([none, slope[..., 1]], axis=2)
            smooth = _smooth_overlap(shift)[..., None] * shift * (0.5 / SHADOW_PX**2)
            along = np.stack([slope * value[..., ::-1], columns, rows, smooth], axis=2)
            return np.asarray(np.einsum("ck,fcki,cip->fkp", self.variance, along, self._rates, optimize=True))

        return self._of_frames(added, pose)

    @property
    def _rates(self) -> FloatArray:
        """Derivatives of the cells' shifts (C, 2, 6) by the motion."""
        return self.view.rates[:, [0, 3], :6]

    def _of_frames(self, added: Callable[[FloatArray], FloatArray], pose: FloatArray) -> FloatArray:
        """Return what is added at the cells' shifts (F, C, 2)."""
        parts = [pose[start : start + FRAMES_AT_ONCE] for start in range(0, max(len(pose), 1), FRAMES_AT_ONCE)]
        return np.concatenate([added(np.einsum("cip,fp->fci", self._rates, part)) for part in parts])

    def information(self, level: float, size: FloatArray) -> FloatArray:
        """Return what noise and parts of sizes (4,) add to the information (6, 6)."""
        rates, cells = self._rates, self.view.cells
        noise = level + max(float(size[0]), 0.0) * self.variance[:, 0] / np.maximum(cells.count, 1)
        of_lines = np.einsum("k,ck,ki->ci", np.maximum(size[1:], 0.0), self.variance[:, 1:], self.curvature[1:])
        white = np.einsum("c,cpq->pq", noise, self.view.information_noise[:, :6, :6])
        return np.asarray(white + np.einsum("cip,ci,ciq->pq", rates, of_lines, rates))


def _smooth_overlap(shift: FloatArray) -> FloatArray:
    """Return the correlation (F, C) of shadows at shifts (F, C, 2)."""
    return np.asarray(np.exp(-np.sum(shift**2, axis=2) / (4.0 * SHADOW_PX**2)))


def fixed_pattern(
    views: Sequence[BodyView],
    patterns: Sequence[SensorPattern],
    full_scales: Sequence[float],
    degree: int,
    pose: FloatArray,
    shown: tuple[FloatArray, FloatArray],
) -> FixedPattern:
    """Return the effect of the cameras' fixed patterns, whose size is estimated.

    `pose` (F, 6): NaN for frames without a direct fit. `shown`: poses (G, 6) and misfits (G, V, 2) of the frames that
    show the size (`DirectFit.misfit`), NaN for none. Of each camera misfit/expected = level + Σ sizeₖ·(misfit of part
    k)/expected is fitted by least squares, with the known sizes as further observations (Bayes's theorem for normal
    distributions). The slope b of all cameras moves the pose by −H⁻¹·b, with the information H of the scene without
    noise and pattern.
    """
    fitted = np.flatnonzero(np.isfinite(pose).all(axis=1))
    seen = np.isfinite(shown[0]).all(axis=1) & np.isfinite(shown[1]).all(axis=(1, 2))
    poses, misfit = shown[0][seen], shown[1][seen]
    slopes, roots, variance, information = [], [], [], np.zeros((2, 6, 6))
    for side, (view, pattern, full_scale) in enumerate(zip(views, patterns, full_scales, strict=True)):
        model = PatternModel.of(view, pattern, degree, full_scale)
        level, size, covariance = _sizes(misfit[:, side], model.misfits(poses), pattern)
        slope = model.slopes(pose[fitted])
        information += [view.information[:, :6, :6].sum(axis=0), model.information(level, size)]
        nominal = np.einsum("fkp,k->fp", slope, size)
        slopes.append(nominal)
        roots += [np.einsum("fkp,k->fp", slope, step) for step in covariance_root(covariance).T]
        roots.append(_model_share(pattern.prnu * np.sqrt(max(size[0], 0.0))) * nominal)
        variance.append((size[0], np.sqrt(covariance[0, 0])))
    estimate = np.asarray(np.linalg.inv(without_noise(information[0], information[1])), dtype=np.float64)
    both = np.stack([np.sum(slopes, axis=0), *roots], axis=1) @ estimate.T
    change = np.zeros((len(pose), both.shape[1], 6))
    change[fitted] = _of_pose(both, pose[fitted])
    return FixedPattern(change[:, 0], change[:, 1:], np.array(variance), tuple(patterns), estimate)


def _model_share(prnu: float) -> float:
    """Return the relative standard uncertainty of a correction by patterns of other kinds.

    Where the misfit grows as by a larger pattern than sensors have, something else contributes, such as texture that
    the pixels do not resolve.
    """
    return float(min(MODEL_SHARE * max(1.0, (prnu / LARGE_PRNU) ** 4), LARGEST_SHARE))


def _sizes(misfit: FloatArray, added: FloatArray, pattern: SensorPattern) -> tuple[float, FloatArray, FloatArray]:
    """Return noise level, and sizes (4,) of a pattern's parts with their covariance.

    `misfit` (F, 2), found and expected; `added` (F, 4) by each part of size 1. Misfits far off are not used.
    """
    known = np.array([1.0, 0.0, 0.0, 0.0])
    u = np.array([pattern.variance_uncertainty, pattern.lines**2, pattern.lines**2, pattern.shadows**2])
    u = np.maximum(u, 1e-12)
    ratio, design = misfit[:, 0] / misfit[:, 1], np.column_stack([np.ones(len(misfit)), added / misfit[:, 1:]])
    used, scale = np.ones(len(ratio), dtype=np.bool_), np.concatenate([[1.0], u])
    level, size, covariance = float(np.median(ratio)) if len(ratio) else 1.0, known, np.diag(u**2)
    for _ in range(ROUNDS):
        if np.count_nonzero(used) < design.shape[1] + MIN_FREE_FRAMES:
            break
        columns = design[used] * scale
        free, *_ = np.linalg.lstsq(columns, ratio[used], rcond=None)
        noise2 = float(np.sum((ratio[used] - columns @ free) ** 2)) / (np.count_nonzero(used) - len(scale))
        noise2 = max(noise2, np.finfo(np.float64).tiny)
        normal = columns.T @ columns / noise2 + np.diag([0.0, 1.0, 1.0, 1.0, 1.0])
        inverse = np.linalg.inv(normal)
        solution = inverse @ (columns.T @ ratio[used] / noise2 + np.concatenate([[0.0], known / u]))
        level, size = float(solution[0]), solution[1:] * u
        covariance = inverse[1:, 1:] * np.outer(u, u)
        left = np.abs(ratio - design @ np.concatenate([[level], size]))
        near = left <= OUTLIER * 1.4826 * np.median(left[used])
        if np.array_equal(near, used):
            break
        used = np.asarray(near)
    return level, *_not_negative_first(size, covariance)


def _not_negative_first(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) with a first value of at least 0.

    A variance is not negative. The other values follow by their regression on the first.
    """
    return mean + max(-float(mean[0]), 0.0) / float(covariance[0, 0]) * covariance[:, 0], covariance


def _of_pose(step: FloatArray, pose: FloatArray) -> FloatArray:
    """Return steps (F, J, 6) of the moved body as changes of poses."""
    rotation = rotation_from_vector(pose[:, 3:])
    shift = np.einsum("fij,fkj->fki", rotation, step[..., :3])
    turn = np.einsum("fij,fkj->fki", rotation_vector_rate(pose[:, 3:]) @ rotation, step[..., 3:])
    return np.concatenate([shift, turn], axis=2)


def cell_phasors(fits: Iterable[Sequence[DirectFit]], columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (T, C, 6) of the cells' slopes, and the slopes' covariance.

    `fits`: of frames with residuals, some at a time; `columns` X (S, T) of these frames. The covariance (C, 6, 6) is
    that of the slopes about the columns. A pattern leaves slopes in every cell that repeat with the motion, by chance
    to either side; noise does not repeat.
    """
    basis, triangle = np.linalg.qr(columns)
    done, sums, squares = 0, 0.0, 0.0
    for block in filter(None, fits):
        scores = np.array([fit.scores for fit in block], dtype=np.float64)
        sums = sums + np.einsum("st,scp->tcp", basis[done : done + len(scores)], scores)
        squares = squares + np.einsum("scp,scq->cpq", scores, scores)
        done += len(scores)
    coefficients = np.linalg.solve(triangle, np.reshape(sums, (len(triangle), -1))).reshape(np.shape(sums))
    left = squares - np.einsum("tcp,tcq->cpq", sums, sums)
    return coefficients, np.asarray(left / max(len(columns) - len(triangle), 1))
