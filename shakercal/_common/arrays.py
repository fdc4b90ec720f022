"""Array types, checks of shapes, and data classes of arrays."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
MAX_SHOWN_CHARACTERS = 60
"""Characters of a value that a data class shows when it is printed in Python."""


class HasShape(Protocol):
    """An array, or what is indexed like one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        ...


def check_shape(name: str, array: HasShape, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` means any length."""
    fits = len(array.shape) == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {expected}, found {array.shape}")


def check_shapes(owner: Any, shape: tuple[int | None, ...], *names: str) -> None:
    """Raise `ValueError` unless these fields of a data class have `shape`; `None` means any length."""
    for name in names:
        check_shape(name, getattr(owner, name), shape)


class Arrays:
    """Base of data classes of arrays: shapes are checked once, and printing shows sizes.

    `class Points3D(Arrays, shapes="position_m F N 3; reprojection_px F N")`: a letter is any length, the same wherever
    it occurs. A field that is None is not checked; of a tuple its length counts.
    """

    _shapes: ClassVar[tuple[list[str], ...]] = ()

    def __init_subclass__(cls, shapes: str = "") -> None:
        if shapes:
            cls._shapes = tuple(shape.split() for shape in shapes.split(";"))

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for name, *letters in self._shapes:
            array = getattr(self, name)
            if array is None:
                continue
            array = np.empty(len(array)) if isinstance(array, tuple) else array
            check_shape(name, array, tuple(int(at) if at.isdigit() else lengths.get(at) for at in letters))
            for letter, length in zip(letters, array.shape, strict=True):
                if lengths.setdefault(letter, length) != length and not letter.isdigit():
                    raise ValueError(f"{name}: expected an array of shape ({', '.join(letters)}), found {array.shape}")

    def __repr__(self) -> str:
        parts = []
        for part in fields(cast(Any, self)):
            value = getattr(self, part.name)
            if isinstance(value, np.ndarray):
                text = " ".join(f"{number:.6g}" for number in value) if value.shape < (7,) and value.ndim == 1 else ""
                parts.append(f"{part.name}=[{text}]" if text else f"{part.name} {value.shape}")
            elif isinstance(value, tuple | list) and not all(isinstance(item, int | float | str) for item in value):
                parts.append(f"{part.name}: {len(value)}")
            elif is_dataclass(value):
                parts.append(f"{part.name}: {type(value).__name__}")
            else:
                parts.append(f"{part.name}={value!r:.{MAX_SHOWN_CHARACTERS}}")
        return f"{type(self).__name__}({', '.join(parts)})"
