"""Fixed pattern of image sensors: its effect on a body's motion, measured and corrected.

A frame is scene times pattern, and so is the reference. Moved by u, the reference's pattern P meets the frame's at
P(x + u): their difference is part of the misfit, least at u = 0, and shortens every small motion. Half the derivative
of that part by u is the slope that the pattern adds to the fit. So the growth of the misfit with the motion, which is
measured, gives the correction, whatever the pattern is made of.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from photogram.bspline import noise_gain, pattern_overlap, slope_noise_gain
from photogram.direct.direct_fit import BodyView, DirectFit
from photogram.geometry import rotation_from_vector, rotation_vector_rate
from photogram.images.sensor_pattern import SensorPattern
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.propagation import covariance_root

PARTS = ("pixels", "columns", "rows", "shadows")
"""Parts of a pattern: independent pixels; whole columns and rows; dust, whose shadows are some pixels wide."""
SHADOW_PX = 3.0  # standard deviation of a shadow's profile, chosen
MODEL_SHARE = 0.03  # of a correction, standard uncertainty by patterns of other kinds, chosen
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
class PatternModel(Arrays, shapes="grey2 C; variance C 4"):
    """Patterns of unit size in one camera.

    Attributes
    ----------
    variance : (C, 4) of each cell, Σw·v over its pixels with the variance v of each of `PARTS`.
    """

    view: BodyView
    degree: int
    grey2: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, view: BodyView, pattern: SensorPattern, degree: int, full_scale: float) -> PatternModel:
        """Return a camera's model: pixels as `pattern`, other parts of relative variance 1."""
        cells = view.cells
        grey2 = np.where(view.steady, np.nan_to_num(cells.energy) + cells.weight * cells.mean**2, 0.0)
        mean2 = grey2 / np.where(cells.weight > 0.0, cells.weight, 1.0)
        pixels = np.where(view.steady, cells.weight * pattern.variance(mean2, full_scale), 0.0)
        return cls(view, degree, grey2, np.column_stack([pixels, grey2, grey2, grey2]))

    @property
    def curvature(self) -> FloatArray:
        """Slopes (4, 2) per variance, weight and small shift along x and y."""
        white, wide = slope_noise_gain(self.degree), 0.5 / SHADOW_PX**2
        return np.array([[white, white], [white, 0.0], [0.0, white], [wide, wide]])

    def effects(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what each part adds to misfit (F, 4) and slope (F, 4, 6).

        `pose`: (F, 6).

        White pixels of variance v differ by v·(κ + 1 − 2·h(u_x)·h(u_y)), with the gain κ of interpolation, and
        correlate with the slopes of the reference (`bspline.pattern_overlap`). Columns do so along x, rows along y.
        Shadows are smooth: 2·(1 − R), with R = exp(−u²/4σ²).
        """
        rates = self.view.rates[:, [0, 3], :6]
        misfits, slopes = [], []
        for start in range(0, len(pose), FRAMES_AT_ONCE):
            shift = np.einsum("cip,fp->fci", rates, pose[start : start + FRAMES_AT_ONCE])
            value, slope = pattern_overlap(shift, self.degree)
            gain, none = noise_gain(shift, self.degree), np.zeros_like(shift[..., 0])
            wide = np.exp(-np.sum(shift**2, axis=2) / (4.0 * SHADOW_PX**2))
            both = gain.prod(axis=2) + 1.0 - 2.0 * value.prod(axis=2), *np.moveaxis(gain + 1.0 - 2.0 * value, 2, 0)
            differences = np.stack([*both, 2.0 * (1.0 - wide)], axis=2)
            white = slope * value[..., ::-1]
            columns, rows = np.stack([slope[..., 0], none], axis=2), np.stack([none, slope[..., 1]], axis=2)
            smooth = wide[..., None] * shift * (0.5 / SHADOW_PX**2)
            along = np.stack([white, columns, rows, smooth], axis=2)
            misfits.append(np.einsum("ck,fck->fk", self.variance, differences))
            slopes.append(np.einsum("ck,fcki,cip->fkp", self.variance, along, rates, optimize=True))
        return np.concatenate(misfits), np.concatenate(slopes)

    def information(self, level: float, size: FloatArray) -> FloatArray:
        """Return the information (6, 6) of the scene alone for sizes (4,)."""
        view, rates = self.view, self.view.rates[:, [0, 3], :6]
        noise = level + size[0] * self.variance[:, 0] / np.maximum(view.cells.count, 1)
        clean = view.information[:, :6, :6] - noise[:, None, None] * view.information_noise[:, :6, :6]
        of_lines = np.einsum("k,ck,ki->ci", size[1:], self.variance[:, 1:], self.curvature[1:])
        return np.asarray(clean.sum(axis=0) - np.einsum("cip,ci,ciq->pq", rates, of_lines, rates))


def fixed_pattern(
    views: Sequence[BodyView],
    patterns: Sequence[SensorPattern],
    full_scales: Sequence[float],
    degree: int,
    fits: tuple[FloatArray, FloatArray],
    displaced: tuple[FloatArray, FloatArray],
) -> FixedPattern:
    """Return the effect of the cameras' fixed patterns, whose size is estimated.

    `fits`: poses (F, 6) and misfits (F, V, 2) of the direct fits (`DirectFit.misfit`), NaN for none. `displaced`: those
    of further frames, which only show the size. Of each camera
    misfit/expected = level + Σ sizeₖ·(misfit of part k)/expected is fitted by least squares, with the known sizes as
    further observations (Bayes's theorem for normal distributions). The slope b of all cameras moves the pose by
    −H⁻¹·b, with the information H of the scene without noise and pattern.
    """
    pose, misfit = fits
    fitted = np.flatnonzero(np.isfinite(pose).all(axis=1) & np.isfinite(misfit).all(axis=(1, 2)))
    shown = [np.concatenate([of_fits[fitted], further]) for of_fits, further in zip(fits, displaced, strict=True)]
    slopes, roots, variance, whole = [], [], [], np.zeros((6, 6))
    for side, (view, pattern, full_scale) in enumerate(zip(views, patterns, full_scales, strict=True)):
        model = PatternModel.of(view, pattern, degree, full_scale)
        added, every_slope = model.effects(shown[0])
        level, size, covariance = _sizes(shown[1][:, side], added, pattern)
        slope = every_slope[: len(fitted)]
        whole += model.information(level, size)
        nominal = np.einsum("fkp,k->fp", slope, size)
        slopes.append(nominal)
        roots += [np.einsum("fkp,k->fp", slope, step) for step in covariance_root(covariance).T]
        roots.append(MODEL_SHARE * nominal)
        variance.append((size[0], np.sqrt(covariance[0, 0])))
    estimate = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    both = np.stack([np.sum(slopes, axis=0), *roots], axis=1) @ estimate.T
    change = np.zeros((len(pose), both.shape[1], 6))
    change[fitted] = _of_pose(both, pose[fitted])
    return FixedPattern(change[:, 0], change[:, 1:], np.array(variance), tuple(patterns), estimate)


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
    return level, size, covariance


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
    for block in fits:
        scores = np.array([fit.scores for fit in block], dtype=np.float64)
        sums = sums + np.einsum("st,scp->tcp", basis[done : done + len(scores)], scores)
        squares = squares + np.einsum("scp,scq->cpq", scores, scores)
        done += len(scores)
    coefficients = np.linalg.solve(triangle, np.reshape(sums, (len(triangle), -1))).reshape(np.shape(sums))
    left = squares - np.einsum("tcp,tcq->cpq", sums, sums)
    return coefficients, np.asarray(left / max(len(columns) - len(triangle), 1))
