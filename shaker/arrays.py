"""Array types, checks of shapes, and what a stage wants the user to know."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__version__ = version("shakercal")

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
LONGEST_SHOWN = 60
"""Characters of a value that a result shows when it is printed in Python."""


def check_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` stands for any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {wanted}, found {array.shape}")


def check_shapes(owner: Any, shape: tuple[int | None, ...], *names: str) -> None:
    """Raise `ValueError` unless these fields of a data class have `shape`; `None` stands for any length."""
    for name in names:
        check_shape(name, getattr(owner, name), shape)


def brief(result: Any) -> str:
    """Return a data class as one line: arrays by their shape, collections by their length."""
    shown = []
    for field in fields(result):
        value: Any = getattr(result, field.name, None)
        if hasattr(value, "shape"):
            text = f"array {value.shape}"
        elif isinstance(value, tuple | dict) and len(repr(value)) > LONGEST_SHOWN:
            text = f"{len(value)} of {type(value).__name__}"
        else:
            text = repr(value) if len(repr(value)) <= LONGEST_SHOWN else type(value).__name__
        shown.append(f"{field.name}={text}")
    return f"{type(result).__name__}({', '.join(shown)})"


class Brief:
    """A data class of arrays that prints on one line: `@dataclass(frozen=True, repr=False)`."""

    __repr__ = brief


# What a stage wants the user to know, carried in its result.

Severity = Literal["info", "warning"]


@dataclass(frozen=True)
class Notice:
    """One remark to the user: how severe, what it says, and what it is about (a channel, a camera, a line)."""

    severity: Severity
    text: str
    where: str
