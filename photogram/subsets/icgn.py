"""Inverse-compositional Gauss-Newton registration of many subsets of one reference image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.bspline import Spline, mean_noise_gain, noise_gain_table, sample_line, sample_points, warp_inside
from photogram.images.noise import QUANTISATION
from photogram.lanes import AFFINE_SUMS, affine_sums
from photogram.subsets.reference import (
    PARAMETERS,
    ReferenceSubsets,
    TrackStatus,
    subset_offsets,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.kernels import njit

GAIN_AND_OFFSET = 2  # parameters
REMAINING = {2: 0.02, 6: 0.02, 12: 0.4}  # share of the error after a step, measured, by the number of parameters
SMALL_STEP = 0.05  # standard uncertainties of the parameters: far below noise
LINEAR_PX = 0.3  # step below which the error decreases by `REMAINING`
WORSE, SMALLEST_LOSS = 1e-3, 1e-6  # permitted relative and absolute increase of 1 − zncc² by order 2
UNEXPLAINED_SIGMAS = 3.0  # permitted chance of a residual variance
OTHER_NOISE = 1.5  # permitted residual variance over that by the reference's noise in both images
LARGEST_UNRESOLVED_PX = 0.15  # displacement that a shape function of order 2 may miss, chosen
TRUNCATED = 0.15  # effect of the terms after the second order over that of the second, measured on waves


Outline = tuple[int, int, int, int] | tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the registration of subsets.

    Attributes
    ----------
    radius_px : subsets have (2·radius+1)² pixels; default 10.
    step_px : distance in the grid; by default just without overlap, so that the subsets' noise is independent.
    degree : of the spline, 3, 5 (default) or 7.
    max_iterations : after which a subset is lost; default 30.
    convergence_px : displacement below which the iteration ends; default 1e-4.
    min_zncc : correlation below which a subset is lost; default 0.75.
    reach_px : half width of the search when the prediction fails; the whole image follows; default 32.
    shape_order : of the shape function, 0 (translation), 1 (affine, default) or 2.
    region : part of the first left image that has subsets: x, y, width, height, or the corners of a polygon, which are
        pixels of it; None (default) for all.
    mask : parts that have none.
    frames : approximate number of frames in which subsets are searched, where a body's motion is fitted to the grey
        values of all frames (`measure.follow`); None (default) for all.

    Examples
    --------
    >>> TrackSettings(radius_px=12).grid_step_px
    25
    """

    radius_px: int = 10
    step_px: int | None = None
    degree: int = 5
    max_iterations: int = 30
    convergence_px: float = 1e-4
    min_zncc: float = 0.75
    reach_px: int = 32
    shape_order: int = 1
    region: Outline | None = None
    mask: tuple[Outline, ...] = ()
    frames: int | None = None

    def __post_init__(self) -> None:
        if self.shape_order not in PARAMETERS:
            raise ValueError(f"shape_order: expected 0, 1 or 2, found {self.shape_order}")
        if self.radius_px < 3:
            raise ValueError(f"radius_px: expected at least 3, found {self.radius_px}")
        if self.step_px is not None and self.step_px < 1:
            raise ValueError(f"step_px: expected at least 1, found {self.step_px}")

    @property
    def grid_step_px(self) -> int:
        """Distance of neighbouring subsets."""
        return 2 * self.radius_px + 1 if self.step_px is None else self.step_px


@dataclass(frozen=True, eq=False, repr=False)
class Registration(Arrays, shapes="warp N p; zncc N; gain N; residual_grey2 N; status N; iterations N"):
    """Result of the registration of N subsets in an image.

    Attributes
    ----------
    warp : (N, 6) = [u, u_x, u_y, v, v_x, v_y]: reference point c + d is found at c + d + (u, v) + [[u_x, u_y], [v_x,
        v_y]] d. Shape functions of order 2 have (N, 12) with further [u_xx, u_xy, u_yy, v_xx, v_xy, v_yy], which add
        u_xx dx²/2 + u_xy dx dy + u_yy dy²/2 to u, and equally to v.
    zncc : (N,) zero-normalised cross-correlation.
    gain : (N,) contrast relative to the reference.
    residual_grey2 : (N,) variance of the residual grey values.
    status : (N,) of `TrackStatus`.
    iterations : (N,).
    """

    warp: FloatArray
    zncc: FloatArray
    gain: FloatArray
    residual_grey2: FloatArray
    status: NDArray[np.int8]
    iterations: IntArray


def register(reference: ReferenceSubsets, target: Spline, start: FloatArray, settings: TrackSettings) -> Registration:
    """Find every subset of `reference` in the image `target` from warps `start` (N, 6).

    A NaN start is none. Minimises the zero-normalised sum of squared differences (its gain and offset eliminated) over
    the warp, by W(p) ← W(p) ∘ W(δ)⁻¹ with δ = H⁻¹ Σ SDᵀ g(W(p)) / gain. The gradients of order 0 stay those of the
    start. Order 2 has warps (N, 12), composed as polynomials up to second order (Gao et al. 2015, Opt. Lasers Eng. 65,
    73), and accepts starts (N, 6). Where a start has no curvature, order 1 is found first and order 2 starts from
    there. Then `reject_poor_curvature` decides which results the subsets support.

    After a step below 0.3 px the remaining error is about a hundredth of it. Measured were 0.4 to 0.7 % (31 px), 0.7 to
    1.1 % (21 px) and 1.5 to 2.5 % (13 px) with noise of 1/255 of full scale and dots of 4.5 px. Without noise it is
    0.05 to 3 %. A subset is therefore found when a fiftieth of the step is below `convergence_px` of the `settings` at
    every point of the subset. It is also found when a fiftieth is below a twentieth of the m parameters' standard
    uncertainties, 0.02² δᵀ(gain² H/s²)δ < 0.05² m with the residual variance s². Steps of order 2 leave up to a third
    of themselves where the texture hardly determines a direction: there the limit is two fifths instead of a fiftieth.
    The reduction of the sum of squares by the last step, gain² δᵀHδ, is subtracted in `zncc` and `residual_grey2`.
    """
    count = len(reference.centre_px)
    columns = 12 if reference.order == 2 else 6
    warp = np.zeros((count, columns))
    check_shape("start", start, (count, columns if start.shape[1:] == (columns,) else 6))
    warp[:, : start.shape[1]] = start
    if reference.affine is not None:
        plain = affine_part(warp)
        first = register(replace(reference.affine, status=reference.status), target, plain, settings)
        found = _found(reference, target, starts_from_affine(warp, first), settings)
        return reject_poor_curvature(reference, found, first)
    return _found(reference, target, warp, settings)


def _found(reference: ReferenceSubsets, target: Spline, warp: FloatArray, settings: TrackSettings) -> Registration:
    """Iterate all subsets from `warp` (N, 6 or 12), which is overwritten."""
    count = len(warp)
    scores = np.full((count, 3), np.nan)
    lacking = (reference.status == TrackStatus.OK) & ~np.isfinite(warp).all(axis=1)
    status = np.where(lacking, np.int8(TrackStatus.NO_START), reference.status)
    outcome = np.column_stack([status, np.zeros(count)]).astype(np.int64)
    offsets = np.ascontiguousarray(subset_offsets(reference.radius_px).T)
    _register(
        (reference.centre_px, reference.radius_px, reference.pixels, reference.mean, reference.energy, offsets),
        (reference.removed, reference.inverse_hessian),
        (target.coefficients, target.degree),
        (settings.max_iterations, settings.convergence_px, settings.min_zncc, REMAINING[reference.removed.shape[2]]),
        warp,
        scores,
        outcome,
    )
    status, iterations = outcome[:, 0].astype(np.int8), outcome[:, 1].copy()
    warp[status != TrackStatus.OK] = np.nan
    zncc, gain, residual = np.ascontiguousarray(scores.T)
    return Registration(warp, zncc, gain, residual, status, iterations)


def affine_part(start: FloatArray) -> FloatArray:
    """Return the affine part (..., 6) of starts (..., 12), NaN where they have curvature."""
    return np.where(np.all(start[..., 6:] == 0.0, axis=-1, keepdims=True), start[..., :6], np.nan)


def starts_from_affine(start: FloatArray, first: Registration) -> FloatArray:
    """Return starts (N,12) of order 2: those with curvature, else results of order 1.

    NaN where order 1 failed.
    """
    flat = np.pad(first.warp, ((0, 0), (0, 6)))
    return np.where(np.isnan(affine_part(start)).any(axis=1, keepdims=True), start, flat)


def reject_poor_curvature(reference: ReferenceSubsets, found: Registration, first: Registration) -> Registration:
    """Return the result of order 2 without the subsets that do not support it, `UNRESOLVED`.

    Rejected are subsets that fit worse than the affine warp of order 1 (`first`), which order 2 contains: 1 − zncc² is
    larger by more than 10⁻³ of itself. Rejected are also those of `drop_unresolved`. Where order 1 failed, its status
    remains.
    """
    tried, loss = first.status != TrackStatus.NO_START, (1.0 + WORSE) * (1.0 - first.zncc**2) + SMALLEST_LOSS
    status = np.where(tried & (first.status != TrackStatus.OK), first.status, found.status)
    done = replace(found, status=status, iterations=found.iterations + first.iterations)
    return _drop_found(drop_unresolved(reference, done), 1.0 - found.zncc**2 > loss)


def drop_unresolved(reference: ReferenceSubsets, found: Registration) -> Registration:
    """Return `found` without subsets of order 2 whose `unresolved_px` is more than 0.15 px."""
    if reference.order < 2:
        return found
    return _drop_found(found, np.any(unresolved_px(reference, found) > LARGEST_UNRESOLVED_PX, axis=1))


def _drop_found(found: Registration, which: BoolArray) -> Registration:
    """Return `found` with those of the subsets `which` (N,) that were found as `UNRESOLVED`."""
    gone = which & (found.status == TrackStatus.OK)
    status = np.where(gone, np.int8(TrackStatus.UNRESOLVED), found.status)
    return replace(found, warp=np.where(gone[:, None], np.nan, found.warp), status=status)


def unresolved_px(reference: ReferenceSubsets, found: Registration) -> FloatArray:
    """Return the displacement (N, 2) in px, rms over the subset, that explains excess residuals.

    A displacement e that the shape function cannot follow leaves the residual gain²·mean(f_x²)·e² along x, equally
    along y. The position may be wrong by as much. The noise level is the median over the subsets, at most one and a
    half times the reference's noise in both images. Three standard deviations √(2/ν) of a variance of ν pixels are
    allowed for chance.
    """
    ok = found.status == TrackStatus.OK
    if not ok.any():
        return np.full((len(ok), 2), np.nan)
    slopes = np.einsum("nkp,nkp->nk", *[reference.pixels[:, 1:]] * 2, dtype=np.float64) / reference.pixels.shape[2]
    freedom = reference.pixels.shape[2] - reference.removed.shape[2] - GAIN_AND_OFFSET
    limit = OTHER_NOISE * (1.0 + found.gain**2) * np.maximum(np.median(reference.noise_grey2[ok]), QUANTISATION)
    level = np.minimum(np.median(found.residual_grey2[ok]), limit) * (1.0 + UNEXPLAINED_SIGMAS * np.sqrt(2.0 / freedom))
    excess = np.maximum(found.residual_grey2 - level, 0.0) / found.gain**2
    square: FloatArray = np.divide(excess[:, None], slopes, out=np.full_like(slopes, np.nan), where=slopes > 0.0)
    return np.sqrt(square)


def position_covariance(reference: ReferenceSubsets, found: Registration, noise_grey: FloatArray) -> FloatArray:
    """Return the covariance (N,2,2) in px² of the found centres from white image noise.

    noise_grey (N,): its standard deviation. A V Aᵀ σ²/gain² with V the `position_variance` of the subset (affine
    parameters, gain and offset free) and A the local deformation: the noise of the one image. That of the reference is
    constant over a series. With order 2, V also contains the squares of displacements that the subset does not resolve.
    These are `unresolved_px`, and 0.15·(u_xx + u_yy)·r(r+1)/6 for the terms after the second. In a wave 1.3 to 4 sides
    long, a parabola leaves 0.15 to 0.01 of its effect.
    """
    deformation = np.eye(2) + found.warp[:, [1, 2, 4, 5]].reshape(-1, 2, 2)
    scale = (noise_grey / found.gain) ** 2
    transposed = np.swapaxes(deformation, 1, 2)
    covariance: FloatArray = deformation @ reference.position_variance @ transposed * scale[:, None, None]
    if reference.order == 2:
        bent = (found.warp[:, [6, 9]] + found.warp[:, [8, 11]]) * reference.radius_px * (reference.radius_px + 1) / 6.0
        left = unresolved_px(reference, found) ** 2 + (TRUNCATED * bent) ** 2
        covariance += deformation @ (np.eye(2) * left[:, :, None]) @ transposed
    return covariance


def noise_of_residual(reference: ReferenceSubsets, found: Registration, degree: int) -> FloatArray:
    """Return the noise (N,), a standard deviation in grey values, that explains the residuals.

    The residual g − gain·f̃ has the variance σ²(κ_g + gain²·κ_f) when both images have white noise σ. κ is the variance
    after interpolation (`noise_gain`), for g the mean over nine pixels of the subset. Shot noise is covered, since
    every subset has a separate σ. A misfit of the affine warp counts as noise too. The smallest value is that of
    rounding.
    """
    offsets = subset_offsets(1) * round(2.0 / 3.0 * reference.radius_px)
    gain: FloatArray = mean_noise_gain(np, reference.centre_px, found.warp[:, :6], offsets, noise_gain_table(degree))
    variance = found.residual_grey2 / (gain + found.gain**2 * reference.noise_gain)
    return np.sqrt(np.maximum(variance, QUANTISATION))


def compose_with_inverse(warp: Any, step: Any) -> tuple[Any, ...]:
    """Return the six parts of warp ∘ step⁻¹, both affine, as numbers or tensors."""
    a, b, c, d = 1.0 + step[1], step[2], step[4], 1.0 + step[5]
    scale = 1.0 / (a * d - b * c)
    ia, ib, ic, id_ = d * scale, -b * scale, -c * scale, a * scale
    iu, iv = -(ia * step[0] + ib * step[3]), -(ic * step[0] + id_ * step[3])
    p, q, r, s = 1.0 + warp[1], warp[2], warp[4], 1.0 + warp[5]
    across = warp[0] + (p * iu + q * iv), p * ia + q * ic - 1.0, p * ib + q * id_
    return *across, warp[3] + (r * iu + s * iv), r * ia + s * ic, r * ib + s * id_ - 1.0


_compose_with_inverse = njit()(compose_with_inverse)


@njit()
def _register(subsets, solved, target, limits, warp, scores, outcome):  # type: ignore[no-untyped-def]
    """Register every usable subset; outcome (N, 2) receives status and iterations."""
    centres, radius, pixels, means, energies, offsets = subsets
    removed, inverse = solved
    side, parameters = 2 * radius + 1, inverse.shape[1]
    buffers = (
        np.empty(max(AFFINE_SUMS, 3 + parameters)),
        np.empty((2, parameters)),
        np.zeros(warp.shape[1]),
        np.empty(side**2, np.float32),
        np.empty((2, side)),
    )
    for n in range(centres.shape[0]):
        if outcome[n, 0] != 0:
            continue
        outcome[n, 0], outcome[n, 1] = _register_one(
            (centres[n, 0], centres[n, 1], radius, pixels[n], means[n], energies[n], offsets),
            (removed[n], inverse[n]),
            target,
            limits,
            warp[n],
            scores[n],
            buffers,
        )


@njit()
def _register_one(subset, solved, target, limits, warp, scores, buffers):  # type: ignore[no-untyped-def]
    """Iterate one subset until it converges; return status and iterations, fill warp and scores.

    `buffers`: sums, solution and slope, step, grey values, a row of positions.
    """
    centre_x, centre_y, radius, _, _, energy, _ = subset
    removed, inverse = solved
    max_iterations, convergence, min_zncc, remaining = limits
    count, parameters = (2 * radius + 1) ** 2, inverse.shape[0]
    sums, vectors, step, grey, row_points = buffers
    solution, slope = vectors[0], vectors[1]
    start_x, start_y = warp[0], warp[3]
    for iteration in range(1, max_iterations + 1):
        if abs(warp[0] - start_x) + abs(warp[3] - start_y) > 2.0 * radius:
            return 1, iteration
        if not warp_inside(target[0], centre_x, centre_y, radius, warp):
            return 3, iteration
        _sample(subset, target, warp, grey, row_points)
        _correlate(subset, grey, parameters, sums)
        spread = sums[1] - sums[0] * sums[0] / count
        gain = sums[2] / energy
        if spread <= 0.0 or gain <= 0.0:
            return 2, iteration
        for j in range(parameters):
            slope[j] = sums[3 + j] - removed[0, j] * sums[0] - removed[1, j] * sums[2]
        improvement = 0.0
        for i in range(parameters):
            total = 0.0
            for j in range(parameters):
                total += inverse[i, j] * slope[j]
            solution[i] = total / gain
            improvement += solution[i] * slope[i]
        moved = _step_of(solution, radius, step)
        if warp.size == 12:
            _compose_inverse_quadratic(warp, step)
        else:
            warp[0], warp[1], warp[2], warp[3], warp[4], warp[5] = _compose_with_inverse(warp, step)
        left = max(0.0, spread - sums[2] * gain - gain * improvement)
        zncc, residual = np.sqrt(max(0.0, 1.0 - left / spread)), left / (count - parameters - GAIN_AND_OFFSET)
        small = gain * improvement < (SMALL_STEP / remaining) ** 2 * parameters * residual
        if moved < LINEAR_PX**2 and (small or remaining**2 * moved < convergence**2):
            scores[0], scores[1], scores[2] = zncc, gain, residual
            return (0 if zncc >= min_zncc else 2), iteration
    return 1, max_iterations


@njit()
def _step_of(solution, radius, step):  # type: ignore[no-untyped-def]
    """Fill the warp `step` from the parameters; return the squared displacement at the rim."""
    if solution.size == 2:
        step[0], step[3] = solution[0], solution[1]
    else:
        step[:] = solution
    moved = step[0] ** 2 + step[3] ** 2
    moved += radius**2 * (step[1] ** 2 + step[2] ** 2 + step[4] ** 2 + step[5] ** 2)
    for curvature in step[6:]:
        moved += 0.25 * radius**4 * curvature**2
    return moved


@njit()
def _correlate(subset, grey, parameters, sums):  # type: ignore[no-untyped-def]
    """Sum g, g², f̃g and the steepest-descent images times g.

    g without the mean of f.
    """
    _, _, _, pixels, mean, _, offsets = subset
    affine_sums(grey, mean, pixels, offsets, sums)
    if parameters == 2:
        sums[4] = sums[6]
    elif parameters == 12:
        sums[AFFINE_SUMS:] = 0.0
        for p in range(grey.size):
            g, dx, dy = grey[p] - mean, offsets[0, p], offsets[1, p]
            for first, slope in ((AFFINE_SUMS, pixels[1, p]), (AFFINE_SUMS + 3, pixels[2, p])):
                sums[first] += slope * g * (0.5 * dx * dx)
                sums[first + 1] += slope * g * (dx * dy)
                sums[first + 2] += slope * g * (0.5 * dy * dy)


@njit()
def _sample(subset, target, warp, grey, buffer):  # type: ignore[no-untyped-def]
    """Sample grey values (P,) of the target at the warped subset, row by row.

    `buffer`: for the points of a curved row.
    """
    centre_x, centre_y, radius, _, _, _, _ = subset
    coefficients, degree = target
    width = buffer.shape[1]
    for number in range(width):
        dy, span = number - radius, (number * width, (number + 1) * width)
        x = centre_x + warp[0] + warp[2] * dy - (1.0 + warp[1]) * radius
        y = centre_y + warp[3] + (1.0 + warp[5]) * dy - warp[4] * radius
        if warp.size == 12:
            for i in range(width):
                dx = float(i - radius)
                curved_x = 0.5 * warp[6] * dx * dx + warp[7] * dx * dy + 0.5 * warp[8] * dy * dy
                curved_y = 0.5 * warp[9] * dx * dx + warp[10] * dx * dy + 0.5 * warp[11] * dy * dy
                buffer[0, i], buffer[1, i] = x + i * (1.0 + warp[1]) + curved_x, y + i * warp[4] + curved_y
            sample_points(coefficients, degree, buffer, grey, span)
        else:
            sample_line(coefficients, degree, (x, y), (1.0 + warp[1], warp[4]), grey, span)


@njit()
def _compose_inverse_quadratic(warp, step):  # type: ignore[no-untyped-def]
    """Set warp ← warp ∘ step⁻¹ for polynomials of second order.

    As matrices on [dx², dx dy, dy², dx, dy, 1] (Gao 2015).
    """
    product = _matrix_of(warp) @ np.linalg.inv(_matrix_of(step))
    for first, row in ((0, 3), (3, 4)):
        warp[first], warp[first + 1], warp[first + 2] = product[row, 5], product[row, 3], product[row, 4]
        warp[first + 6], warp[first + 7], warp[first + 8] = (
            2.0 * product[row, 0],
            product[row, 1],
            2.0 * product[row, 2],
        )
    warp[1] -= 1.0
    warp[5] -= 1.0


@njit()
def _matrix_of(warp):  # type: ignore[no-untyped-def]
    """Return the matrix of a warp of order 2 on [dx²,dx dy,dy²,dx,dy,1], truncated."""
    matrix = np.zeros((6, 6))
    x, y = matrix[3], matrix[4]
    x[0], x[1], x[2], x[3], x[4], x[5] = 0.5 * warp[6], warp[7], 0.5 * warp[8], 1.0 + warp[1], warp[2], warp[0]
    y[0], y[1], y[2], y[3], y[4], y[5] = 0.5 * warp[9], warp[10], 0.5 * warp[11], warp[4], 1.0 + warp[5], warp[3]
    for row, p, q in ((0, x, x), (1, x, y), (2, y, y)):
        matrix[row, 0] = p[0] * q[5] + p[5] * q[0] + p[3] * q[3]
        matrix[row, 1] = p[1] * q[5] + p[5] * q[1] + p[3] * q[4] + p[4] * q[3]
        matrix[row, 2] = p[2] * q[5] + p[5] * q[2] + p[4] * q[4]
        matrix[row, 3] = p[3] * q[5] + p[5] * q[3]
        matrix[row, 4] = p[4] * q[5] + p[5] * q[4]
        matrix[row, 5] = p[5] * q[5]
    matrix[5, 5] = 1.0
    return matrix


def subset_positions(found: Sequence[Registration], reference: ReferenceSubsets) -> tuple[FloatArray, NDArray[np.int8]]:
    """Return positions (F,N,2) of all frames, NaN where not found, and statuses (F,N)."""
    status = np.stack([frame.status for frame in found])
    position = np.stack([reference.centre_px + frame.warp[:, [0, 3]] for frame in found])
    position[status != TrackStatus.OK] = np.nan
    return position, status


def subset_noise(found: Sequence[Registration], reference: ReferenceSubsets, degree: int) -> FloatArray:
    """Return the image noise (F,N) at each subset, NaN where not found."""
    noise = np.stack([noise_of_residual(reference, frame, degree) for frame in found])
    noise[np.stack([frame.status for frame in found]) != TrackStatus.OK] = np.nan
    return noise
