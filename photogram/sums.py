"""Sums over the pixels of subsets and of rows of cells, eight pixels at a time and always in the same order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from photogram.lanes import LANES, REALS, Lanes, across, counted, in_blocks, load, spread

_Terms = tuple[Lanes, ...]
AFFINE_SUMS, CURVED_SUMS, RUN_SUMS = 9, 6, 7


def _affine_terms(g: Lanes, f: Lanes, along: Lanes, down: Lanes, dx: Lanes, dy: Lanes) -> _Terms:
    """What is summed for an affine warp."""
    a, d = along * g, down * g
    return g, g * g, f * g, a, a * dx, a * dy, d, d * dx, d * dy


def _curved_terms(g: Lanes, _: Lanes, along: Lanes, down: Lanes, dx: Lanes, dy: Lanes) -> _Terms:
    """What is summed besides for a warp of second order."""
    a, d = along * g, down * g
    xx, xy, yy = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
    return a * xx, a * xy, a * yy, d * xx, d * xy, d * yy


def _run_terms(g: Lanes, weight: Lanes, f: Lanes, along: Lanes, down: Lanes, dx: Lanes) -> _Terms:
    """What is summed of weighted pixels side by side."""
    w, a, d = weight * g, along * g, down * g
    return w, w * g, f * g, a, a * dx, d, d * dx


@intrinsic
def affine_sums(typing, grey, mean, pixels, offsets, sums):  # type: ignore[no-untyped-def]
    """Fill sums (9,) with Σg, Σg², Σf̃·g and Σ(f_x, f_x·dx, f_x·dy, f_y, f_y·dx, f_y·dy)·g, g = grey (P,) − mean.

    pixels (3,P): f̃, f_x, f_y; offsets (2,P): dx, dy.
    """
    return _type(grey, mean, pixels, offsets, sums), _subset_code(_affine_terms, AFFINE_SUMS)


@intrinsic
def curved_sums(typing, grey, mean, pixels, offsets, sums):  # type: ignore[no-untyped-def]
    """Fill sums (6,) with Σf_x·(dx²/2, dx·dy, dy²/2)·g and Σf_y·(…)·g; arguments as of `affine_sums`."""
    return _type(grey, mean, pixels, offsets, sums), _subset_code(_curved_terms, CURVED_SUMS)


@intrinsic
def run_sums(typing, grey, mean, pixels, start, dx, sums):  # type: ignore[no-untyped-def]
    """Fill sums (7,) with Σw·g, Σw·g², Σw·f̃·g, Σw·f_x·g, Σw·f_x·dx·g, Σw·f_y·g, Σw·f_y·dx·g, g = grey (n,) − mean.

    pixels (4,P): w, w·f̃, w·f_x, w·f_y, of which n from `start` on; dx: of the first one, the others a pixel apart.
    """
    return _type(grey, mean, pixels, start, dx, sums), _run_code


def _type(*arguments: Any) -> Any:
    """Types of the arguments; the arrays must be contiguous doubles."""
    for kind in arguments:
        if isinstance(kind, types.Array) and (kind.layout, kind.dtype) != ("C", types.float64):
            raise TypeError(f"expected contiguous float64 arrays, found {kind}")
    taken = [kind if isinstance(kind, types.Array | types.Integer) else types.float64 for kind in arguments]
    return types.void(*taken)


def _subset_code(terms: Callable[..., _Terms], number: int) -> Callable[..., Any]:
    """Generator of the code of sums over a subset."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        grey, pixels, offsets, sums = (_array(context, builder, signature, arguments, k) for k in (0, 2, 3, 4))
        (count,) = cgutils.unpack_tuple(builder, grey.shape)
        mean = spread(builder, arguments[1])

        def block(index: Any, mask: Any) -> _Terms:
            rows = [(pixels, 0), (pixels, 1), (pixels, 2), (offsets, 0), (offsets, 1)]
            read = [load(builder, _place(builder, table, row, index), mask) for table, row in rows]
            g = load(builder, builder.gep(grey.data, [index]), mask) - mean
            return terms(_within(builder, g, mask), *read)

        _sum(builder, (count, number, block), sums.data)
        return context.get_dummy_value()

    return generate


def _run_code(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
    """Code of sums over pixels side by side."""
    grey, pixels, sums = (_array(context, builder, signature, arguments, k) for k in (0, 2, 5))
    _, mean, _, start, first, _ = arguments
    (count,) = cgutils.unpack_tuple(builder, grey.shape)
    level, begin = spread(builder, mean), counted(builder, first)

    def block(index: Any, mask: Any) -> _Terms:
        place = builder.add(start, index)
        w, f, along, down = (load(builder, _place(builder, pixels, row, place), mask) for row in range(4))
        g = load(builder, builder.gep(grey.data, [index]), mask) - level
        dx = begin + spread(builder, builder.sitofp(index, ir.DoubleType()))
        return _run_terms(_within(builder, g, mask), w, f, along, down, dx)

    _sum(builder, (count, RUN_SUMS, block), sums.data)
    return context.get_dummy_value()


def _sum(builder: Any, loop: tuple[Any, int, Callable[..., _Terms]], sums: Any) -> None:
    """Code that adds the terms of all blocks lane by lane, then the lanes; loop: points, sums, terms of a block."""
    count, number, block = loop
    nothing = ir.Constant(REALS, [0.0] * LANES)
    totals = [cgutils.alloca_once(builder, REALS) for _ in range(number)]
    for total in totals:
        builder.store(nothing, total)

    def add(index: Any, mask: Any) -> None:
        for total, term in zip(totals, block(index, mask), strict=True):
            builder.store((Lanes(builder, builder.load(total)) + term).value, total)

    in_blocks(builder, count, add)
    for k, total in enumerate(totals):
        place = builder.gep(sums, [ir.Constant(ir.IntType(64), k)])
        builder.store(across(builder, Lanes(builder, builder.load(total))), place)


def _within(builder: Any, lanes: Lanes, mask: Any) -> Lanes:
    """The lanes of the mask, zero in the others."""
    if mask is None:
        return lanes
    return Lanes(builder, builder.select(mask, lanes.value, ir.Constant(REALS, [0.0] * LANES)))


def _array(context: Any, builder: Any, signature: Any, arguments: Sequence[Any], number: int) -> Any:
    """One of the arguments that are arrays."""
    return context.make_array(signature.args[number])(context, builder, arguments[number])


def _place(builder: Any, table: Any, row: int, column: Any) -> Any:
    """Pointer to an element of a table of contiguous rows."""
    width = cgutils.unpack_tuple(builder, table.shape)[1]
    return builder.gep(table.data, [builder.add(builder.mul(ir.Constant(ir.IntType(64), row), width), column)])
