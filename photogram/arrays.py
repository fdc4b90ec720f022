"""Array types, checks of shapes, and what a stage wants the user to know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from shakercal._common.notices import Notice

__version__ = "0.2.0"  # as in pyproject.toml: to look for the installed one takes longer than many a module

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


GOLDEN = (5.0**0.5 - 1.0) / 2.0


def spread_choice(numbers: IntArray, share: float) -> BoolArray:
    """Which of some numbers are taken so that `share` of them are, by the golden ratio: evenly, and in no period."""
    return np.asarray(numbers * GOLDEN % 1.0 < share)


def check_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` stands for any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {wanted}, found {array.shape}")


def derivatives(of: Callable[[FloatArray], FloatArray], step: FloatArray) -> FloatArray:
    """Return the derivatives (..., N) of a function of N numbers, all zero, by central differences of steps (N,).

    Those by numbers whose step is zero, because they are known exactly, are zero.
    """
    moved = np.flatnonzero(step)
    rates = [(of(delta) - of(-delta)) / (2.0 * delta.sum()) for delta in np.diag(step)[moved]]
    slope = np.zeros((*np.shape(rates[0] if rates else of(step)), len(step)))
    slope[..., moved] = np.stack(rates, axis=-1) if rates else 0.0
    return slope


class Arrays:
    """Base of data classes of arrays: shapes are checked once, when one is made; printing shows sizes, not numbers.

    `class Points(Arrays, shapes="position_m F N 3; reprojection_px F N")`: a letter is any length, the same wherever it
    stands. A field that is None is not checked; of a tuple its length counts.
    """

    _shapes: ClassVar[tuple[list[str], ...]] = ()

    def __init_subclass__(cls, shapes: str = "") -> None:
        cls._shapes = tuple(shape.split() for shape in shapes.split(";") if shape)

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for name, *wanted in self._shapes:
            array = getattr(self, name)
            if array is None:
                continue
            array = np.empty(len(array)) if isinstance(array, tuple) else array
            check_shape(name, array, tuple(int(at) if at.isdigit() else lengths.get(at) for at in wanted))
            for letter, length in zip(wanted, array.shape, strict=True):
                if lengths.setdefault(letter, length) != length and not letter.isdigit():
                    raise ValueError(f"{name}: expected an array of shape ({', '.join(wanted)}), found {array.shape}")

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


# What is known of all frames of a series that comes some frames at a time.


class RunningMean:
    """Mean over frames of what is finite: the digits of `values.sum(axis=0)` over all of them, however they come."""

    def __init__(self) -> None:
        self._total: FloatArray | None = None
        self.count: IntArray = np.zeros((), np.int64)

    def add(self, values: FloatArray) -> None:
        """Take in further frames (F, ...)."""
        known = np.isfinite(values)
        rows = np.where(known, values, 0.0)
        rows = rows if self._total is None else np.concatenate([self._total[None], rows])  # in the order of the frames
        self._total, self.count = np.asarray(rows.sum(axis=0)), self.count + known.sum(axis=0)

    @property
    def mean(self) -> FloatArray:
        """The mean so far (...), NaN where nothing is known."""
        assert self._total is not None
        return np.asarray(self._total / np.where(self.count > 0, self.count, np.nan))


SAMPLED = 1 << 19


class Sample:
    """Values of all frames, or of equally spaced ones where these are more than `SAMPLED` values: for a median."""

    def __init__(self) -> None:
        self._rows: list[FloatArray] = []
        self._every, self._frames = 1, 0

    def add(self, values: FloatArray) -> None:
        """Take in further frames (F, ...)."""
        first = -self._frames % self._every
        self._rows += [row.copy() for row in values[first :: self._every]]
        self._frames += len(values)
        while sum(row.size for row in self._rows[:1]) * len(self._rows) > SAMPLED and len(self._rows) > 1:
            self._rows, self._every = self._rows[::2], 2 * self._every

    @property
    def median(self) -> float:
        """Median of what is finite, NaN where nothing is."""
        values = np.array(self._rows)
        values = values[np.isfinite(values)]
        return float(np.median(values)) if len(values) else float("nan")
