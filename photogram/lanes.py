"""Generated code of the inner loops: vectors as long as a register, with fixed arithmetic.

Of floats or doubles. A product in a sum is fused with it, and lanes are added in pairs. With them: sums over the pixels
of subsets and cells, and the recursion and the values of B-splines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from math import comb, factorial
from operator import add, mul
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.polynomial import Polynomial

from shakercal._common.arrays import FloatArray


def _register_bytes() -> int:
    """Return 64 for a processor with AVX-512, else 32.

    AVX2 has too few registers for values that occupy two of them.
    """
    try:
        return 64 if get_host_cpu_features().get("avx512f") else 32
    except RuntimeError:  # LLVM does not support this query on every system
        return 32


FLOAT, DOUBLE = ir.FloatType(), ir.DoubleType()
_WIDTH = _register_bytes()
FLOATS, DOUBLES = ir.VectorType(FLOAT, _WIDTH // 4), ir.VectorType(DOUBLE, _WIDTH // 8)
INDEX = ir.IntType(64)
_WORD = ir.IntType(32)
_NAMES = {FLOAT: "f32", DOUBLE: "f64"}


@dataclass(frozen=True)
class Lanes:
    """`FLOATS` or `DOUBLES` with operators for formulas; `factors` of a product, for fusing."""

    builder: Any
    value: Any
    factors: tuple[Any, Any] | None = None

    def __add__(self, other: Any) -> Lanes:
        right = self._like(other)
        if right.factors is not None:
            return self._plus_product(right.factors)
        if self.factors is not None:
            return right._plus_product(self.factors)
        return Lanes(self.builder, self.builder.fadd(self.value, right.value))

    def __sub__(self, other: Any) -> Lanes:
        return self.__add__(-self._like(other))

    def __rsub__(self, other: Any) -> Lanes:
        return (-self).__add__(other)

    def __mul__(self, other: Any) -> Lanes:
        factors = self.value, self._like(other).value
        return Lanes(self.builder, self.builder.fmul(*factors), factors)

    def __truediv__(self, other: float) -> Lanes:
        return self * (1.0 / other)

    def __neg__(self) -> Lanes:
        negative = self.builder.fneg(self.value)
        if self.factors is None:
            return Lanes(self.builder, negative)
        return Lanes(self.builder, negative, (self.builder.fneg(self.factors[0]), self.factors[1]))

    __radd__, __rmul__ = __add__, __mul__

    def _like(self, other: Any) -> Lanes:
        """Return lanes unchanged, a number in every lane."""
        return other if isinstance(other, Lanes) else Lanes(self.builder, constant(self.value.type, float(other)))

    def _plus_product(self, factors: tuple[Any, Any]) -> Lanes:
        """Return the sum with a product, rounded once."""
        kind = self.value.type
        fused = _vector_code(self.builder, "fma", kind, "", ir.FunctionType(kind, [kind, kind, kind]))
        return Lanes(self.builder, self.builder.call(fused, [*factors, self.value]))


def constant(kind: Any, number: float) -> Any:
    """Return one number in every lane."""
    return ir.Constant(kind, [number] * kind.count)


def lane_numbers(builder: Any, kind: Any) -> Lanes:
    """Return the numbers 0, 1 … of all lanes."""
    return Lanes(builder, ir.Constant(kind, [float(lane) for lane in range(kind.count)]))


def broadcast(builder: Any, scalar: Any, kind: Any) -> Lanes:
    """Return a double in every lane, rounded to their type."""
    return Lanes(builder, _spread(builder, scalar if kind == DOUBLES else builder.fptrunc(scalar, FLOAT), kind))


def array_of(context: Any, builder: Any, signature: Any, arguments: Sequence[Any], number: int) -> Any:
    """Return one of the arguments of generated code that are arrays."""
    return context.make_array(signature.args[number])(context, builder, arguments[number])


def element(builder: Any, table: Any, row: Any, column: Any) -> Any:
    """Return the pointer to an element of a table of contiguous rows.

    A row that is fixed when code is generated is a number.
    """
    width = cgutils.unpack_tuple(builder, table.shape)[1]
    row = ir.Constant(INDEX, row) if isinstance(row, int) else row
    return builder.gep(table.data, [builder.add(builder.mul(row, width), column)])


def load(builder: Any, pointer: Any, kind: Any, mask: Any = None) -> Lanes:
    """Load adjacent numbers; those outside the mask are zero and their memory is not accessed.

    Doubles may be loaded from floats.
    """
    element_type = pointer.type.pointee
    stored = ir.VectorType(element_type, kind.count)
    source, align = builder.bitcast(pointer, stored.as_pointer()), 8 if element_type == DOUBLE else 4
    if mask is None:
        value = builder.load(source, align=align)
    else:
        form = ir.FunctionType(stored, [source.type, _WORD, mask.type, stored])
        masked = _vector_code(builder, "masked.load", stored, ".p0", form)
        value = builder.call(masked, [source, ir.Constant(_WORD, align), mask, constant(stored, 0.0)])
    return Lanes(builder, value if stored == kind else builder.fpext(value, kind))


def store(builder: Any, lanes: Lanes, pointer: Any, mask: Any = None) -> None:
    """Store numbers to adjacent memory of their type, only those of the mask."""
    kind = lanes.value.type
    target, align = builder.bitcast(pointer, kind.as_pointer()), 8 if kind == DOUBLES else 4
    if mask is None:
        builder.store(lanes.value, target, align=align)
        return
    form = ir.FunctionType(ir.VoidType(), [kind, target.type, _WORD, mask.type])
    masked = _vector_code(builder, "masked.store", kind, ".p0", form)
    builder.call(masked, [lanes.value, target, ir.Constant(_WORD, align), mask])


def sum_lanes(builder: Any, lanes: Lanes) -> Any:
    """Return the sum of all lanes, by adding halves."""
    value, width = lanes.value, lanes.value.type.count
    while width > 1:
        width //= 2
        low, high = (ir.Constant(ir.VectorType(_WORD, width), list(range(at, at + width))) for at in (0, width))
        value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in (low, high)))
    return builder.extract_element(value, ir.Constant(_WORD, 0))


def in_blocks(builder: Any, count: Any, kind: Any, block: Any) -> None:
    """Generate code that calls block(index, mask) for `count` points, a vector at a time.

    The last block has a mask if it is not full.
    """
    full = builder.and_(count, ir.Constant(INDEX, -kind.count))
    zero, step = ir.Constant(INDEX, 0), ir.Constant(INDEX, kind.count)
    with cgutils.for_range_slice(builder, zero, full, step, INDEX) as (index, _):
        block(index, None)
    with builder.if_then(builder.icmp_signed("<", full, count)):
        indices = ir.VectorType(INDEX, kind.count)
        lanes = ir.Constant(indices, list(range(kind.count)))
        block(full, builder.icmp_signed("<", lanes, _spread(builder, builder.sub(count, full), indices)))


def _spread(builder: Any, scalar: Any, kind: Any) -> Any:
    """Return a vector with the scalar in every lane."""
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_WORD, 0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(_WORD, kind.count), [0] * kind.count))


def _vector_code(builder: Any, name: str, kind: Any, suffix: str, form: Any) -> Any:
    """Return LLVM's function of this name for vectors of this kind."""
    whole = f"llvm.{name}.v{kind.count}{_NAMES[kind.element]}{suffix}"
    return cgutils.get_or_insert_function(builder.module, form, whole)


def kernel_signature(*kinds: Any) -> Any:
    """Return the type of generated code that fills arrays.

    Contiguous floats or doubles; whole numbers stay whole.
    """
    for kind in kinds:
        if isinstance(kind, types.Array) and (kind.layout != "C" or kind.dtype not in (types.float32, types.float64)):
            raise TypeError(f"expected contiguous arrays of floats or doubles, found {kind}")
    unchanged = types.Array | types.Integer | types.UniTuple
    return types.void(*(kind if isinstance(kind, unchanged) else types.float64 for kind in kinds))


# Sums over the pixels of subsets and cells.

_Terms = tuple[Lanes, ...]
AFFINE_SUMS, RUN_SUMS = 9, 7


@intrinsic
def affine_sums(typing, grey, mean, pixels, offsets, sums):  # type: ignore[no-untyped-def]
    """Fill sums (9,) of g = grey (P,) − mean times the affine steepest-descent images.

    Σg, Σg², Σf̃·g and Σ(f_x, f_x·dx, f_x·dy, f_y, f_y·dx, f_y·dy)·g. pixels (3, P): f̃, f_x, f_y; offsets (2, P): dx,
    dy.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        values, table, places, totals = (array_of(context, builder, signature, arguments, k) for k in (0, 2, 3, 4))
        level = broadcast(builder, arguments[1], DOUBLES)

        def block(index: Any, mask: Any) -> _Terms:
            rows = [(table, 0), (table, 1), (table, 2), (places, 0), (places, 1)]
            f, along, down, dx, dy = (
                load(builder, element(builder, array, row, index), DOUBLES, mask) for array, row in rows
            )
            g = _within(builder, load(builder, builder.gep(values.data, [index]), DOUBLES, mask) - level, mask)
            a, d = along * g, down * g
            return g, g * g, f * g, a, a * dx, a * dy, d, d * dx, d * dy

        (count,) = cgutils.unpack_tuple(builder, values.shape)
        _sum(builder, count, AFFINE_SUMS, block, totals)
        return context.get_dummy_value()

    return kernel_signature(grey, mean, pixels, offsets, sums), generate


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


# B-splines: the recursion of the prefilter, and values at equally spaced points of a run.

LINES = 32  # rows or columns that are filtered at once


@intrinsic
def recurse(typing, lines, poles):  # type: ignore[no-untyped-def]
    """Filter lines (n,LINES) in place, down and up, for three poles.

    y_k = x_k + z·y_k−1.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        table = array_of(context, builder, signature, arguments, 0)
        factors = [broadcast(builder, pole, FLOATS) for pole in cgutils.unpack_tuple(builder, arguments[1], 3)]
        (count, _), zero = cgutils.unpack_tuple(builder, table.shape), constant(FLOATS, 0.0)
        last = builder.sub(count, ir.Constant(INDEX, 1))
        columns = range(0, LINES, FLOATS.count)
        for upward in (False, True):
            states = [[cgutils.alloca_once_value(builder, zero) for _ in factors] for _ in columns]
            with cgutils.for_range(builder, count) as loop:
                row = builder.sub(last, loop.index) if upward else loop.index
                for column, before in zip(columns, states, strict=True):
                    pointer = element(builder, table, row, ir.Constant(INDEX, column))
                    value = load(builder, pointer, FLOATS)
                    for factor, state in zip(factors, before, strict=True):
                        value = factor * Lanes(builder, builder.load(state)) + value
                        builder.store(value.value, state)
                    store(builder, value, pointer)
        return context.get_dummy_value()

    return kernel_signature(lines, poles), generate


@cache
def basis_polynomials(degree: int) -> FloatArray:
    """Return the coefficients (power of t, spline) of B-splines at t in [0,1).

    Spline j is β(t + (degree−1)/2 − j), β the sum of truncated powers (Unser 1999, IEEE Signal Process. Mag. 16, 22,
    box 1): β(x) = Σ_k (−1)^k C(n+1,k) max(0, x + (n+1)/2 − k)^n / n!.
    """
    n = degree
    table = np.zeros((n + 1, n + 1))
    for j in range(n + 1):
        for k in range(n - j + 1):
            for power in range(n + 1):
                term = comb(n, power) * (n - j - k) ** (n - power)
                table[power, j] += (-1) ** k * comb(n + 1, k) * term / factorial(n)
    return table


def weights(t: Lanes, degree: int) -> tuple[Lanes, ...]:
    """Return the degree + 1 B-splines of an odd degree at t in [0, 1).

    With h = t − ½ the splines j and n−j are E(h²) ± h·O(h²).
    """
    half, h = (degree + 1) // 2, t - 0.5
    q = h * h

    def in_squares(coefficients: Any) -> Lanes:
        first, *others = coefficients[::-1].tolist()
        return reduce(lambda total, coefficient: total * q + coefficient, others, first)  # type: ignore[no-any-return]

    centred = [Polynomial(column)(Polynomial([0.5, 1.0])).coef for column in basis_polynomials(degree).T[:half]]
    pairs = [(in_squares(part[::2]), h * in_squares(part[1::2])) for part in centred]
    return (*(even + odd for even, odd in pairs), *(even - odd for even, odd in reversed(pairs)))


def _run_by(degree: int) -> Any:
    """Return the kernel of one run for splines of a degree.

    Whole blocks of points, then a masked one.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        table, grey = (array_of(context, builder, signature, arguments, k) for k in (0, 4))
        corner, offset, drift, span = (cgutils.unpack_tuple(builder, arguments[k], 2) for k in (1, 2, 3, 5))

        def block(index: Any, mask: Any) -> None:
            first = broadcast(builder, builder.sitofp(index, DOUBLE), FLOATS)
            points, column = lane_numbers(builder, FLOATS) + first, builder.add(corner[1], index)
            along, down = (
                weights(points * broadcast(builder, step, FLOATS) + broadcast(builder, begin, FLOATS), degree)
                for begin, step in zip(offset, drift, strict=True)
            )
            lines = []
            for k in range(len(down)):
                pointer = element(builder, table, builder.add(corner[0], ir.Constant(INDEX, k)), column)
                taps = [
                    load(builder, builder.gep(pointer, [ir.Constant(INDEX, j)]), FLOATS, mask)
                    for j in range(len(along))
                ]
                lines.append(reduce(add, map(mul, along, taps)))
            pointer = builder.gep(grey.data, [builder.add(span[0], index)])
            store(builder, reduce(add, map(mul, down, lines)), pointer, mask)

        in_blocks(builder, builder.sub(span[1], span[0]), FLOATS, block)
        return context.get_dummy_value()

    @intrinsic
    def run(typing, c, corner, offset, drift, grey, span):  # type: ignore[no-untyped-def]
        """Fill grey with the spline's values at the points of one run.

        Σ_k b_k(t) Σ_j a_j(s) c[row + k, column + j + i] at point i. s and t = offset + i·drift.
        """
        return kernel_signature(c, corner, offset, drift, grey, span), generate

    return run


run_cubic, run_quintic, run_septic = map(_run_by, (3, 5, 7))
