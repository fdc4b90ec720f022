"""Subsets of the reference image, prepared once per series for registration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from photogram.bspline import Spline, noise_gain, sample_squares, slope_noise_gain, third_differences
from photogram.kernels.lanes import (
    DOUBLE,
    DOUBLES,
    INDEX,
    Lanes,
    array_of,
    broadcast,
    constant,
    element,
    in_blocks,
    kernel_signature,
    lane_numbers,
    load,
    sum_lanes,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

_Terms = tuple[Lanes, ...]
AFFINE_SUMS, CURVED_SUMS, RUN_SUMS = 9, 6, 7


@intrinsic
def affine_sums(typing, grey, mean, pixels, offsets, sums):  # type: ignore[no-untyped-def]
    """Fill sums (9,) of g = grey (P,) − mean times the affine steepest-descent images.

    Σg, Σg², Σf̃·g and Σ(f_x, f_x·dx, f_x·dy, f_y, f_y·dx, f_y·dy)·g. pixels (3, P): f̃, f_x, f_y; offsets (2, P): dx,
    dy.
    """

    def terms(g: Lanes, f: Lanes, along: Lanes, down: Lanes, dx: Lanes, dy: Lanes) -> _Terms:
        a, d = along * g, down * g
        return g, g * g, f * g, a, a * dx, a * dy, d, d * dx, d * dy

    return kernel_signature(grey, mean, pixels, offsets, sums), _subset_code(terms, AFFINE_SUMS)


@intrinsic
def curved_sums(typing, grey, mean, pixels, offsets, sums):  # type: ignore[no-untyped-def]
    """Fill sums (6,) with Σf_x·(dx²/2, dx·dy, dy²/2)·g and Σf_y·(…)·g.

    Arguments as of `affine_sums`.
    """

    def terms(g: Lanes, _: Lanes, along: Lanes, down: Lanes, dx: Lanes, dy: Lanes) -> _Terms:
        a, d = along * g, down * g
        xx, xy, yy = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
        return a * xx, a * xy, a * yy, d * xx, d * xy, d * yy

    return kernel_signature(grey, mean, pixels, offsets, sums), _subset_code(terms, CURVED_SUMS)


def _subset_code(terms: Callable[..., _Terms], number: int) -> Callable[..., Any]:
    """Return the generator of the code of sums over a subset."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        grey, pixels, offsets, sums = (array_of(context, builder, signature, arguments, k) for k in (0, 2, 3, 4))
        mean = broadcast(builder, arguments[1], DOUBLES)

        def block(index: Any, mask: Any) -> _Terms:
            rows = [(pixels, 0), (pixels, 1), (pixels, 2), (offsets, 0), (offsets, 1)]
            read = [load(builder, element(builder, table, row, index), DOUBLES, mask) for table, row in rows]
            g = load(builder, builder.gep(grey.data, [index]), DOUBLES, mask) - mean
            return terms(_within(builder, g, mask), *read)

        (count,) = cgutils.unpack_tuple(builder, grey.shape)
        _sum(builder, count, number, block, sums)
        return context.get_dummy_value()

    return generate


@intrinsic
def run_sums(typing, grey, mean, pixels, span, dx, sums):  # type: ignore[no-untyped-def]
    """Fill sums (7,) over a run of pixels with g = grey − mean.

    Σw·g, Σw·g², Σw·f̃·g, Σw·f_x·g, Σw·f_x·dx·g, Σw·f_y·g, Σw·f_y·dx·g. pixels (4, P): w, w·f̃, w·f_x, w·f_y; span: the
    first pixel and their number; dx: of the first one, the others 1 px from each other.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        values, table, totals = (array_of(context, builder, signature, arguments, k) for k in (0, 2, 5))
        start, count = cgutils.unpack_tuple(builder, arguments[3], 2)
        level = broadcast(builder, arguments[1], DOUBLES)
        begin = broadcast(builder, arguments[4], DOUBLES) + lane_numbers(builder, DOUBLES)

        def block(index: Any, mask: Any) -> _Terms:
            pixel = builder.add(start, index)
            weight, f, along, down = (
                load(builder, element(builder, table, row, pixel), DOUBLES, mask) for row in range(4)
            )
            g = _within(builder, load(builder, builder.gep(values.data, [index]), DOUBLES, mask) - level, mask)
            offset = begin + broadcast(builder, builder.sitofp(index, DOUBLE), DOUBLES)
            w, a, d = weight * g, along * g, down * g
            return w, w * g, f * g, a, a * offset, d, d * offset

        _sum(builder, count, RUN_SUMS, block, totals)
        return context.get_dummy_value()

    return kernel_signature(grey, mean, pixels, span, dx, sums), generate


def _sum(builder: Any, count: Any, number: int, block: Callable[..., _Terms], sums: Any) -> None:
    """Generate code that adds the `number` terms of all blocks lane by lane.

    Then the lanes are added.
    """
    totals = [cgutils.alloca_once(builder, DOUBLES) for _ in range(number)]
    for total in totals:
        builder.store(constant(DOUBLES, 0.0), total)

    def add(index: Any, mask: Any) -> None:
        for total, term in zip(totals, block(index, mask), strict=True):
            builder.store((Lanes(builder, builder.load(total)) + term).value, total)

    in_blocks(builder, count, DOUBLES, add)
    for k, total in enumerate(totals):
        pointer = builder.gep(sums.data, [ir.Constant(INDEX, k)])
        builder.store(sum_lanes(builder, Lanes(builder, builder.load(total))), pointer)


def _within(builder: Any, lanes: Lanes, mask: Any) -> Lanes:
    """Return the lanes of the mask, zero in the others."""
    return lanes if mask is None else Lanes(builder, builder.select(mask, lanes.value, constant(lanes.value.type, 0.0)))


# Subsets of a reference image, prepared once: grey values, gradients, Hessians, and determined directions.

SMALLEST_NOISE = 1e-9  # of the variance of the grey values, for images without noise
SMALLEST_CONTRAST = 1e-6  # of the mean: ten times the rounding of float32
MIN_RATIO = 4.0  # of a determined direction's information to that of noise, which shortens a step by a quarter
CURVED_MARGIN = 1.2  # times the largest ratio by noise alone
SMALLEST_EXCESS = 1e-2  # of a ratio over 1, so that variances remain finite
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

    Noise of the reference also makes gradients, with the Hessian N = σ²γ·diag(1, dx², dy² …) summed over the subset. In
    the basis H v = μ N v, directions with μ < 4 are noise, not texture (along an edge): they keep their start. N adds
    to H but not to the slope, so the inverse along v is 1/(μ−1), which makes steps of the correct length (with 1/μ
    every step is too short by 1/μ of itself). The variance is μ/(μ−1)².

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

    The variances (n, 2, 2) are those of the translation. Without `chance` one determined direction is enough. With
    `chance`, c = √(m/P), all directions must be determined. The least determined directions are so partly by chance:
    noise happens to add little to them, 1 − 2c instead of 1, and to cancel texture, by c·√(μ−1). The subtraction is
    reduced by that.
    """
    extents = np.concatenate([extent[:3], extent[:3], extent[3:], extent[3:]])
    scale = 1.0 / np.sqrt(slope_noise2[:, None] * extents)
    ratio, vectors = np.linalg.eigh(hessian * scale[:, :, None] * scale[:, None, :])
    directions = vectors * scale[:, :, None]
    limit = CURVED_MARGIN * (1.0 + chance) ** 2 if chance else MIN_RATIO
    share = 1.0 - chance * (2.0 + np.sqrt(np.maximum(ratio - 1.0, 0.0)))
    clear = ratio > limit
    weights = np.where(clear, 1.0 / (np.maximum(ratio, limit) - share), 0.0)
    inverse = (directions * weights[:, None, :]) @ np.swapaxes(directions, 1, 2)
    translation = directions[:, [0, min(3, len(extent))]]
    spread = ratio / np.maximum(ratio - share, SMALLEST_EXCESS) ** 2
    variance = (translation * spread[:, None, :]) @ np.swapaxes(translation, 1, 2)
    determined = np.asarray(clear.all(axis=1) if chance else clear.any(axis=1), dtype=np.bool_)
    inverse[~determined], variance[~determined] = np.nan, np.nan
    return determined, inverse, variance
