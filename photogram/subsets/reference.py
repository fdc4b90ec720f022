"""Subsets of the reference image, prepared once per series for registration."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from photogram.bspline import Spline, noise_gain, sample_squares, slope_noise_gain, third_differences
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

SMALLEST_NOISE = 1e-9  # of the variance of the grey values, for images without noise
SMALLEST_CONTRAST = 1e-6  # of the mean: ten times the rounding of float32
MIN_RATIO = 4.0  # of a determined direction's information to that of noise, which shortens a step by a quarter
CURVED_MARGIN = 1.2  # times the largest ratio by noise alone
UNDETERMINED = 1e-3  # relative to the reference's noise: information about an undetermined shift, about 25 px
PARAMETERS = {0: 2, 1: 6, 2: 12}  # by the order of the shape function
CHUNK = 64  # subsets whose pixels fit into the processor's cache


class TrackStatus(IntEnum):
    """Status of one subset in one frame; every status but `OK` has NaN positions.

    `UNRESOLVED` belongs to order 2. Texture, noise and size of the subset do not determine the shape function, or a
    displacement remains that it cannot follow. Or it fits worse than the affine one, which it contains (a false
    minimum).
    """

    OK = 0
    NOT_CONVERGED = 1
    LOW_CORRELATION = 2
    LEFT_IMAGE = 3
    FLAT = 4
    SATURATED = 5
    NO_START = 6
    UNRESOLVED = 7


@dataclass(frozen=True, eq=False, repr=False)
class ReferenceSubsets(
    Arrays,
    shapes="centre_px N 2; pixels N 3 P; removed N 2 m; inverse_hessian N m m; position_variance N 2 2; mean N; "
    "energy N; noise_gain N; noise_grey2 N; status N",
):
    """N square subsets of P = (2·radius+1)² pixels, prepared once for a whole sequence.

    Attributes
    ----------
    centre_px : (N, 2).
    pixels : (N, 3, P) grey value f̃ without its mean, gradient along x, gradient along y.
    mean : (N,) of the grey values.
    energy : (N,) Σf̃².
    order : of the shape function, 0 (translation), 1 (affine) or 2, with m = 2, 6 or 12 parameters.
    removed : (N, 2, m) mean of each steepest-descent image and its regression on f̃.
    inverse_hessian : (N, m, m) of the steepest-descent images after this removal, so that gain and offset are free
        parameters, and after subtraction of the reference's noise; zero along directions that the texture does not
        determine.
    position_variance : (N, 2, 2) covariance of the translation in px² for image noise of variance 1.
    noise_gain : (N,) variance of the subset's grey values per variance of the pixels.
    noise_grey2 : (N,) variance of the pixels' white noise.
    status : (N,) `OK`, `FLAT`, `LEFT_IMAGE` or `UNRESOLVED`.
    affine : of order 2 the same subsets with order 1, from whose result it starts.
    """

    centre_px: FloatArray
    radius_px: int
    pixels: NDArray[np.float32]
    mean: FloatArray
    energy: FloatArray
    removed: FloatArray
    inverse_hessian: FloatArray
    position_variance: FloatArray
    noise_gain: FloatArray
    noise_grey2: FloatArray
    status: NDArray[np.int8]
    order: int = 1
    affine: ReferenceSubsets | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order not in PARAMETERS:
            raise ValueError(f"order: expected 0, 1 or 2, found {self.order}")


def prepare_reference(spline: Spline, centre_px: FloatArray, radius_px: int, order: int = 1) -> ReferenceSubsets:
    """Prepare the subsets of one image about centres (N, 2), which may lie between pixels.

    Steepest-descent images of the affine warp: [f_x, f_x dx, f_x dy, f_y, f_y dx, f_y dy] (Baker, Matthews 2004, Int.
    J. Comput. Vis. 56, 221; Pan, Li, Tong 2013, Exp. Mech. 53, 1277), each without its mean and its part along f̃.
    Order 0 has f_x and f_y alone, order 2 further f_x and f_y times dx²/2, dx dy, dy²/2.

    Noise of the reference also makes gradients, with the Hessian N = σ²γ·diag(1, dx², dy² …) summed over the subset.
    Along conjugate directions v, H v = μ N v, first of translation and then of deformation. Those with μ < 4 are noise,
    not texture (along an edge): they keep their start. A subset with no direction of translation is `FLAT`. With one,
    the variance of the other is that of 25 px. N adds to H but not to the slope, so the inverse along v is 1/(μ−1),
    which makes steps of the correct length (with 1/μ every step is too short by 1/μ of itself). The variance is
    μ/(μ−1)².

    A direction that order 2 keeps at its start would be curvature that the field may have, and an error of the
    position. A subset with such a direction is therefore `UNRESOLVED`, and directions with μ near 4 are solved for.
    Noise alone has μ up to (1 + √(m/P))² (Marchenko, Pastur 1967, Math. USSR Sb. 1, 457), of which 1.2 times is the
    limit for order 2.
    """
    check_shape("centre_px", centre_px, (None, 2))
    if order not in PARAMETERS:
        raise ValueError(f"order: expected 0, 1 or 2, found {order}")
    count, size, parameters = len(centre_px), (2 * radius_px + 1) ** 2, PARAMETERS[order]
    noise2 = _pixel_noise(spline, centre_px, radius_px) ** 2
    pixels, status = np.empty((count, 3, size), np.float32), np.zeros(count, np.int8)
    mean, energy = np.empty(count), np.empty(count)
    extent = np.sum(shape_values(subset_offsets(radius_px), order) ** 2, axis=1)
    removed, inverse = np.zeros((count, 2, parameters)), np.full((count, parameters, parameters), np.nan)
    variance, plain = np.full((count, 2, 2), np.nan), np.full((count, 6, 6) if order == 2 else (0, 0, 0), np.nan)
    plain_variance = variance.copy()
    for part in _parts(np.arange(count)):
        square = sample_squares(spline, centre_px[part], radius_px)
        mean[part] = square[:, 0].mean(axis=1)
        square[:, 0] -= mean[part, None]
        pixels[part], energy[part] = square, np.einsum("np,np->n", square[:, 0], square[:, 0])
        status[part[~np.isfinite(square[:, 0, 0])]] = TrackStatus.LEFT_IMAGE
        status[part[energy[part] <= size * (SMALLEST_CONTRAST * np.abs(mean[part])) ** 2]] = TrackStatus.FLAT
        usable = part[status[part] == TrackStatus.OK]
        floor = np.maximum(slope_noise_gain(spline.degree) * noise2[usable], SMALLEST_NOISE * energy[usable] / size)
        hessian, removed[usable] = _hessians(square[status[part] == TrackStatus.OK], energy[usable], radius_px, order)
        if order < 2:
            determined, inverse[usable], variance[usable] = _invert(hessian, floor, extent)
        else:
            determined, plain[usable], plain_variance[usable] = _invert(hessian[:, :6, :6], floor, extent[:3])
            chance = float(np.sqrt(parameters / size))
            carried, inverse[usable], variance[usable] = _invert(hessian, floor, extent, chance)
            status[usable[~carried]] = TrackStatus.UNRESOLVED
        status[usable[~determined]] = TrackStatus.FLAT
    gain = noise_gain(centre_px[:, 0], spline.degree) * noise_gain(centre_px[:, 1], spline.degree)
    affine = None
    subsets, ends = (centre_px, radius_px, pixels, mean, energy), (gain, noise2, status)
    if order == 2:
        affine = ReferenceSubsets(*subsets, np.ascontiguousarray(removed[:, :, :6]), plain, plain_variance, *ends)
    return ReferenceSubsets(*subsets, removed, inverse, variance, *ends, order, affine)


def shape_values(offsets: FloatArray, order: int) -> FloatArray:
    """Return values (m/2, P) of one coordinate's shape functions at offsets (P, 2).

    1; dx, dy; dx²/2, dx dy, dy²/2.
    """
    x, y = offsets.T
    values: FloatArray = np.stack([np.ones_like(x), x, y, x * x / 2.0, x * y, y * y / 2.0])
    return values[: PARAMETERS[order] // 2]


def subset_offsets(radius_px: int) -> FloatArray:
    """Return the pixels (P, 2) of a subset relative to its centre, row by row."""
    line = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    rows, columns = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([columns.ravel(), rows.ravel()])


def _pixel_noise(spline: Spline, centre_px: FloatArray, radius_px: int) -> FloatArray:
    """Return the standard deviation (N,) of white noise in each subset.

    From the median of mixed third differences of its pixels. The differences (1 −3 3 −1) in x and y suppress texture of
    a few pixels' size; |·| has the median 0.6745 · 20 σ.
    """
    fine, side = np.abs(third_differences(spline)), 2 * radius_px - 2
    corner = np.rint(np.nan_to_num(centre_px, nan=-1e6)).astype(np.int64) - radius_px
    inside = np.flatnonzero(((corner >= 0) & (corner + side <= fine.shape[::-1])).all(axis=1))
    middle, half = np.zeros(len(corner)), side**2 // 2
    for part in _parts(inside):
        column, row = corner[part].T
        values = sliding_window_view(fine, (side, side))[row, column].reshape(len(part), -1)
        values.partition(half, axis=1)  # an even number of them
        middle[part] = (values[:, half] + values[:, :half].max(axis=1)) / 2.0
    return middle / (0.6745 * 20.0)


def _parts(which: IntArray) -> list[IntArray]:
    """Return indices of subsets in parts that fit into the processor's cache."""
    return np.array_split(which, range(CHUNK, len(which), CHUNK))


def _hessians(pixels: FloatArray, energy: FloatArray, radius_px: int, order: int) -> tuple[FloatArray, FloatArray]:
    """Return Hessians (n,m,m) of the projected steepest-descent images, and the projections (n,2,m).

    Removed from the images are their mean and their part along f̃.
    """
    grey, along, down = np.moveaxis(pixels, 1, 0)[:, :, None]
    shapes = shape_values(subset_offsets(radius_px), order)
    parts = [slope * part for part in (shapes[:3], shapes[3:]) for slope in (along, down)]
    steepest = np.concatenate(parts, axis=1)
    removed = np.stack([steepest.mean(axis=2), (steepest @ grey.mT)[..., 0] / energy[:, None]], axis=1)
    steepest -= removed[:, 0, :, None] + removed[:, 1, :, None] * grey
    return steepest @ steepest.mT, removed


def _invert(
    hessian: FloatArray, slope_noise2: FloatArray, extent: FloatArray, chance: float = 0.0
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return whether a subset is determined (n,), inverse Hessians (n, m, m), and position variances.

    The variances (n, 2, 2) are those of the translation. Without `chance` one determined direction of translation is
    enough. With `chance`, c = √(m/P), all directions must be determined. The least determined directions are so partly
    by chance: noise happens to add little to them, 1 − 2c instead of 1, and to cancel texture, by c·√(μ−1). The
    subtraction is reduced by that.
    """
    extents = np.concatenate([extent[:3], extent[:3], extent[3:], extent[3:]])
    shift = np.array([0, min(3, len(extent))])
    scale = 1.0 / np.sqrt(slope_noise2[:, None] * extents)
    scaled = hessian * scale[:, :, None] * scale[:, None, :]
    ratio, vectors = np.linalg.eigh(scaled) if chance else _shift_first(scaled, shift)
    limit = CURVED_MARGIN * (1.0 + chance) ** 2 if chance else MIN_RATIO
    clear = ratio > limit
    lost = np.where(clear[:, None, :2], 0.0, vectors[:, shift, :2]) * scale[:, shift, None]  # directions of translation
    vectors = np.where(clear[:, None, :], vectors, 0.0)
    directions = vectors * scale[:, :, None]
    by_chance = chance * (2.0 + np.sqrt(np.maximum(ratio - 1.0, 0.0)))
    diagonal = np.where(clear, ratio + by_chance, 1.0)[:, None, :] * np.eye(len(extents))
    weights = np.linalg.inv(diagonal - np.swapaxes(vectors, 1, 2) @ vectors)
    inverse = directions @ weights @ np.swapaxes(directions, 1, 2)
    steps = directions[:, shift] @ weights
    variance = (steps * np.where(clear, ratio, 0.0)[:, None, :]) @ np.swapaxes(steps, 1, 2)
    determined = clear.all(axis=1) if chance else clear[:, :2].any(axis=1)
    if not chance:
        variance += lost @ np.swapaxes(lost, 1, 2) / UNDETERMINED**2
    inverse[~determined], variance[~determined] = np.nan, np.nan
    return np.asarray(determined, dtype=np.bool_), inverse, variance


def _shift_first(scaled: FloatArray, shift: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return information (n, m) and conjugate directions (n, m, m), translation first.

    Columns of unit length: two of translation, then those of deformation. Eigenvectors of the whole Hessian mix both,
    so that an undetermined one, which keeps its start, would hold back a part of the motion.
    """
    other = np.setdiff1d(np.arange(scaled.shape[1]), shift)
    vectors = np.zeros_like(scaled)
    of_shift, axes = np.linalg.eigh(scaled[:, shift[:, None], shift])
    vectors[:, shift, :2] = axes
    weights = np.where(of_shift > MIN_RATIO, 1.0 / np.maximum(of_shift, MIN_RATIO), 0.0)
    mixed = scaled[:, shift[:, None], other]
    carried = (axes * weights[:, None, :]) @ np.swapaxes(axes, 1, 2) @ mixed
    of_rest, rest = np.linalg.eigh(scaled[:, other[:, None], other] - np.swapaxes(mixed, 1, 2) @ carried)
    moved = -carried @ rest
    length2 = 1.0 + np.sum(moved**2, axis=1)
    vectors[:, other, 2:], vectors[:, shift, 2:] = rest, moved
    vectors[:, :, 2:] /= np.sqrt(length2)[:, None, :]
    return np.concatenate([of_shift, of_rest / length2], axis=1), vectors
