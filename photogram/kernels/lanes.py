"""Vectors of floats or doubles as long as a register, with fixed arithmetic.

A product in a sum is fused with it, and lanes are added in pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils


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
