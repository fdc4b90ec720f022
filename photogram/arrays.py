"""Array types, checks of shapes, and what a stage wants the user to know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# Array types and the shape check that every data class of the package uses.


FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def check_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` stands for any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {wanted}, found {array.shape}")


# What a stage wants the user to know, carried in its result.


Severity = Literal["info", "warning"]


@dataclass(frozen=True)
class Notice:
    """One remark to the user: how severe, what it says, and what it is about (a channel, a camera, a line)."""

    severity: Severity
    text: str
    where: str
