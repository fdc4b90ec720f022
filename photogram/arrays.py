"""Array types, checks of shapes, and statistics over frames that arrive in blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from shakercal._common.notices import Notice

__version__ = "0.2.0"  # as in pyproject.toml: reading the installed one takes long

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


GOLDEN = (5.0**0.5 - 1.0) / 2.0  # the golden ratio, least approximable by fractions


def spread_choice(numbers: IntArray, share: float) -> BoolArray:
    """Return which of some numbers are chosen, `share` of them, evenly and without a period.

    By the golden ratio.
    """
    return np.asarray(numbers * GOLDEN % 1.0 < share)


def check_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` is any length."""
    fits = array.ndim == len(shape) and all(
        length is None or length == found for length, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join("any" if length is None else str(length) for length in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {expected}, found {array.shape}")


def derivatives(of: Callable[[FloatArray], FloatArray], step: FloatArray) -> FloatArray:
    """Return the derivatives (...,N) of a function at zero by central differences of steps (N,).

    They are zero for numbers whose step is zero, which are exact.
    """
    moved = np.flatnonzero(step)
    rates = [(of(delta) - of(-delta)) / (2.0 * delta.sum()) for delta in np.diag(step)[moved]]
    slope = np.zeros((*np.shape(rates[0] if rates else of(step)), len(step)))
    slope[..., moved] = np.stack(rates, axis=-1) if rates else 0.0
    return slope


class Arrays:
    """Base of data classes of arrays: shapes are checked once, and printing shows sizes.

    `class Points3D(Arrays, shapes="position_m F N 3; reprojection_px F N")`: a letter is any length, the same wherever
    it occurs. A field that is None is not checked; of a tuple its length counts.
    """

    _shapes: ClassVar[tuple[list[str], ...]] = ()

    def __init_subclass__(cls, shapes: str = "") -> None:
        cls._shapes = tuple(shape.split() for shape in shapes.split(";") if shape)

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
            elif is_dataclass(value) and not isinstance(value, Notice):
                parts.append(f"{part.name}: {type(value).__name__}")
            else:
                parts.append(f"{part.name}={value!r:.60}")
        return f"{type(self).__name__}({', '.join(parts)})"


# Statistics over the frames of a series that arrives in blocks.


class RunningMean:
    """Mean over frames of the finite values, independent of how the frames are divided.

    It has the digits of `values.sum(axis=0)` over all of them.
    """

    def __init__(self) -> None:
        self._total: FloatArray | None = None
        self.count: IntArray = np.zeros((), np.int64)

    def add(self, values: FloatArray) -> None:
        """Add further frames (F, ...)."""
        finite = np.isfinite(values)
        rows = np.where(finite, values, 0.0)
        rows = rows if self._total is None else np.concatenate([self._total[None], rows])  # in the order of the frames
        self._total, self.count = np.asarray(rows.sum(axis=0)), self.count + finite.sum(axis=0)

    @property
    def mean(self) -> FloatArray:
        """The mean so far (...), NaN without a finite value."""
        assert self._total is not None
        return np.asarray(self._total / np.where(self.count > 0, self.count, np.nan))


SAMPLED = 1 << 19  # values of a sample: 4 MB


class Sample:
    """Values of all frames, or of equally spaced ones beyond `SAMPLED` values: for a median."""

    def __init__(self) -> None:
        self._rows: list[FloatArray] = []
        self._every, self._frames = 1, 0

    def add(self, values: FloatArray) -> None:
        """Add further frames (F, ...)."""
        first = -self._frames % self._every
        self._rows += [row.copy() for row in values[first :: self._every]]
        self._frames += len(values)
        while sum(row.size for row in self._rows[:1]) * len(self._rows) > SAMPLED and len(self._rows) > 1:
            self._rows, self._every = self._rows[::2], 2 * self._every

    @property
    def median(self) -> float:
        """Median of the finite values, NaN without any."""
        values = np.array(self._rows)
        values = values[np.isfinite(values)]
        return float(np.median(values)) if len(values) else float("nan")
