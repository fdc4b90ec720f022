"""Eight doubles at a time in code that is being generated, with arithmetic that leaves a compiler no choice.

A product that goes into a sum is fused with it, and lanes are added in pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

LANES = 8
REAL = ir.DoubleType()
REALS = ir.VectorType(REAL, LANES)
INDEX = ir.IntType(64)
INDICES = ir.VectorType(INDEX, LANES)
MASK = ir.VectorType(ir.IntType(1), LANES)
NOTHING = ir.Constant(REALS, [0.0] * LANES)
_WORD = ir.IntType(32)


@dataclass(frozen=True)
class Lanes:
    """Eight doubles, with the arithmetic that formulas are written in; `factors` of a product are kept for its sum."""

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
        """Lanes as they are; a number stands for eight of it."""
        return other if isinstance(other, Lanes) else Lanes(self.builder, ir.Constant(REALS, [float(other)] * LANES))

    def _plus_product(self, factors: tuple[Any, Any]) -> Lanes:
        """The sum with a product, rounded once."""
        kind = ir.FunctionType(REALS, [REALS, REALS, REALS])
        fused = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.fma.v{LANES}f64")
        return Lanes(self.builder, self.builder.call(fused, [*factors, self.value]))


def counted(builder: Any, begin: Any) -> Lanes:
    """The numbers begin, begin + 1 … of eight lanes; begin is a double."""
    return spread(builder, begin) + Lanes(builder, ir.Constant(REALS, [float(lane) for lane in range(LANES)]))


def spread(builder: Any, scalar: Any) -> Lanes:
    """A double eight times."""
    return Lanes(builder, _spread(builder, scalar, REALS))


def array_of(context: Any, builder: Any, signature: Any, arguments: Sequence[Any], number: int) -> Any:
    """One of the arguments of generated code that are arrays."""
    return context.make_array(signature.args[number])(context, builder, arguments[number])


def element(builder: Any, table: Any, row: Any, column: Any) -> Any:
    """Pointer to an element of a table of contiguous rows; a row known when code is generated is a number."""
    width = cgutils.unpack_tuple(builder, table.shape)[1]
    row = ir.Constant(INDEX, row) if isinstance(row, int) else row
    return builder.gep(table.data, [builder.add(builder.mul(row, width), column)])


def load(builder: Any, pointer: Any, mask: Any = None) -> Lanes:
    """Eight doubles in a row, those outside the mask zero and their memory untouched."""
    place = builder.bitcast(pointer, REALS.as_pointer())
    if mask is None:
        return Lanes(builder, builder.load(place, align=8))
    kind = ir.FunctionType(REALS, [place.type, _WORD, MASK, REALS])
    masked = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{LANES}f64.p0")
    return Lanes(builder, builder.call(masked, [place, ir.Constant(_WORD, 8), mask, NOTHING]))


def store(builder: Any, lanes: Lanes, pointer: Any, mask: Any = None) -> None:
    """Write eight doubles in a row, only those of the mask."""
    place = builder.bitcast(pointer, REALS.as_pointer())
    if mask is None:
        builder.store(lanes.value, place, align=8)
        return
    kind = ir.FunctionType(ir.VoidType(), [REALS, place.type, _WORD, MASK])
    masked = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f64.p0")
    builder.call(masked, [lanes.value, place, ir.Constant(_WORD, 8), mask])


def across(builder: Any, lanes: Lanes) -> Any:
    """The sum of eight lanes, a double: halves added to each other until one is left."""
    value, width = lanes.value, LANES
    while width > 1:
        width //= 2
        low, high = (ir.Constant(ir.VectorType(_WORD, width), list(range(at, at + width))) for at in (0, width))
        value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in (low, high)))
    return builder.extract_element(value, ir.Constant(_WORD, 0))


def in_blocks(builder: Any, count: Any, block: Any) -> None:
    """Code that calls block(index, mask) for every eight of `count` points, the last time with a mask if need be."""
    full = builder.and_(count, ir.Constant(INDEX, -LANES))
    with cgutils.for_range_slice(builder, ir.Constant(INDEX, 0), full, ir.Constant(INDEX, LANES), INDEX) as (index, _):
        block(index, None)
    with builder.if_then(builder.icmp_signed("<", full, count)):
        lanes = ir.Constant(INDICES, list(range(LANES)))
        block(full, builder.icmp_signed("<", lanes, _spread(builder, builder.sub(count, full), INDICES)))


def _spread(builder: Any, scalar: Any, kind: Any) -> Any:
    """A vector that holds the scalar eight times."""
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_WORD, 0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(_WORD, LANES), [0] * LANES))


def filling(*kinds: Any) -> Any:
    """Type of generated code that fills arrays: these must be contiguous doubles; whole numbers stay whole."""
    for kind in kinds:
        if isinstance(kind, types.Array) and (kind.layout, kind.dtype) != ("C", types.float64):
            raise TypeError(f"expected contiguous float64 arrays, found {kind}")
    kept = types.Array | types.Integer | types.UniTuple
    return types.void(*(kind if isinstance(kind, kept) else types.float64 for kind in kinds))
