"""Sums over the pixels of warped squares on a GPU, in one Triton kernel.

A program computes one square of `icgn_torch.square_sums`. Grey values stay in registers, whereas `icgn_torch.sample`
writes every pixel's weights to memory. A square reads its pixels once, and the coefficients from the cache.
"""

from __future__ import annotations

from math import isqrt
from typing import Any

import triton
import triton.language as tl

from photogram.bspline import PADDING_PX
from shakercal._common.arrays import FloatArray

BLOCK = 128  # pixels at a time: four warps


@triton.jit
def _weight(t, which: tl.constexpr, TAPS: tl.constexpr, BASIS: tl.constexpr):  # type: ignore[no-untyped-def]
    """B-spline `which` at the offsets t in [0, 1): a row of the basis polynomials."""
    value = tl.zeros_like(t) + BASIS[(TAPS - 1) * TAPS + which]
    for k in tl.static_range(TAPS - 1):
        value = value * t + BASIS[(TAPS - 2 - k) * TAPS + which]
    return value


@triton.jit
def _interpolated(near, width, t, s, inside, TAPS: tl.constexpr, BASIS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Grey values at the offsets t along x and s along y.

    near: the first coefficients of the pixels.
    """
    grey = tl.zeros_like(t)
    for j in tl.static_range(TAPS):
        line = tl.zeros_like(t)
        for i in tl.static_range(TAPS):
            line += _weight(t, i, TAPS, BASIS) * tl.load(near + j * width + i, mask=inside, other=0.0)
        grey += _weight(s, j, TAPS, BASIS) * line
    return grey


@triton.jit
def _shape_functions(dx, dy, ROWS: tl.constexpr):  # type: ignore[no-untyped-def]
    """[1, dx, dy] and, in eight rows, [dx²/2, dx dy, dy²/2] (ROWS, pixels); zeros below."""
    row, x, y = tl.arange(0, ROWS)[:, None], dx[None, :], dy[None, :]
    values = tl.where(row == 0, 1.0, tl.where(row == 1, x, tl.where(row == 2, y, 0.0)))
    if ROWS > 4:
        curved = tl.where(row == 3, 0.5 * x * x, tl.where(row == 4, x * y, 0.5 * y * y))
        values = tl.where((row > 2) & (row < 6), curved, values)
    return values


@triton.jit
def _stretched(slopes, curvatures, dx, dy, SHAPES: tl.constexpr):  # type: ignore[no-untyped-def]
    """Shift by the slopes u_x, u_y of a warp and, of six shapes, its curvatures.

    The curvatures are u_xx, u_xy, u_yy.
    """
    shift = tl.load(slopes).to(tl.float32) * dx + tl.load(slopes + 1).to(tl.float32) * dy
    if SHAPES == 6:
        shift += tl.load(curvatures).to(tl.float32) * (0.5 * dx * dx) + tl.load(curvatures + 1).to(tl.float32) * dx * dy
        shift += tl.load(curvatures + 2).to(tl.float32) * (0.5 * dy * dy)
    return shift


@triton.jit
def _sums_of_square(  # type: ignore[no-untyped-def]
    frames,
    squares,
    pairs,
    alive,
    sums,
    SIDE: tl.constexpr,
    SHAPES: tl.constexpr,
    LAYERS: tl.constexpr,
    TAPS: tl.constexpr,
    BASIS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    coefficients, height, width = frames
    pixels, centre, mean = squares
    frame, square, warp = pairs
    ROWS: tl.constexpr = 4 if SHAPES == 3 else 8
    COUNT: tl.constexpr = SIDE * SIDE
    pair = tl.program_id(0).to(tl.int64)
    if tl.load(alive + pair) == 0:
        return
    index = tl.load(square + pair)
    warp += 2 * SHAPES * pair
    pixels += LAYERS * COUNT * index
    across, down = tl.load(centre + 2 * index) + tl.load(warp), tl.load(centre + 2 * index + 1) + tl.load(warp + 3)
    column, row = tl.floor(across), tl.floor(down)  # positions in float32 are relative to this pixel, to 1e-6 px
    corner = (tl.load(frame + pair) * height + row.to(tl.int64)) * width + column.to(tl.int64)
    level = tl.load(mean + index).to(tl.float32)
    total, square_sum, product = (tl.zeros((BLOCK,), tl.float64),) * 3
    along, steep = (tl.zeros((ROWS, BLOCK), tl.float64),) * 2
    for begin in range(0, COUNT, BLOCK):
        pixel = begin + tl.arange(0, BLOCK)
        inside = pixel < COUNT
        dx, dy = (pixel % SIDE - SIDE // 2).to(tl.float32), (pixel // SIDE - SIDE // 2).to(tl.float32)
        x = (across - column).to(tl.float32) + dx + _stretched(warp + 1, warp + 6, dx, dy, SHAPES)
        y = (down - row).to(tl.float32) + dy + _stretched(warp + 4, warp + 9, dx, dy, SHAPES)
        left, top = tl.floor(x), tl.floor(y)
        near = coefficients + corner + top.to(tl.int64) * width + left.to(tl.int64)
        grey = tl.where(inside, _interpolated(near, width, x - left, y - top, inside, TAPS, BASIS) - level, 0.0)
        pointer = pixels + pixel
        weighted = grey
        if LAYERS == 4:
            weighted = grey * tl.load(pointer, mask=inside, other=0.0)
        total += weighted.to(tl.float64)
        square_sum += (weighted * grey).to(tl.float64)
        product += (grey * tl.load(pointer + (LAYERS - 3) * COUNT, mask=inside, other=0.0)).to(tl.float64)
        shape = _shape_functions(dx, dy, ROWS)
        along += (shape * (grey * tl.load(pointer + (LAYERS - 2) * COUNT, mask=inside, other=0.0))[None, :]).to(
            tl.float64
        )
        steep += (shape * (grey * tl.load(pointer + (LAYERS - 1) * COUNT, mask=inside, other=0.0))[None, :]).to(
            tl.float64
        )
    sums += (3 + 2 * SHAPES) * pair
    tl.store(sums, tl.sum(total))
    tl.store(sums + 1, tl.sum(square_sum))
    tl.store(sums + 2, tl.sum(product))
    which = tl.arange(0, ROWS)
    tl.store(sums + 3 + which, tl.sum(along, axis=1), mask=which < SHAPES)
    tl.store(sums + 3 + SHAPES + which, tl.sum(steep, axis=1), mask=which < SHAPES)


def square_sums(
    squares: Any, frames: Any, pairs: tuple[Any, Any, Any], alive: Any, sums: Any, basis: FloatArray
) -> None:
    """Write the sums of the pairs that are alive (n,) into sums (n, 3+2s).

    Arguments as of `icgn_torch.square_sums`, and the basis polynomials of the splines.
    """
    if not len(sums):
        return
    _, height, width = frames.coefficients.shape
    first = PADDING_PX - frames.degree // 2  # offset of the first coefficient that reaches a pixel
    _sums_of_square[(len(sums),)](
        (frames.coefficients.view(-1)[first * (width + 1) :], height, width),
        (squares.pixels, squares.centre_px, squares.mean),
        tuple(one.contiguous() for one in pairs),
        alive.contiguous(),
        sums,
        SIDE=isqrt(squares.pixels.shape[2]),
        SHAPES=pairs[2].shape[1] // 2,
        LAYERS=squares.pixels.shape[1],
        TAPS=frames.degree + 1,
        BASIS=tuple(basis.ravel().tolist()),
        BLOCK=BLOCK,
    )
