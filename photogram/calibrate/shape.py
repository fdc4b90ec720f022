"""The target's shape: flat, bowed, or every point where it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram._checks import FloatArray, IntArray, check_shape

ShapeKind = Literal["flat", "bowed", "free"]

_BOW = 0.01  # what is known of a bow beforehand: its height over the target's half diagonal
_FREE = 0.01  # and of single points: their displacement over the spacing
_STRETCH = 3.0  # rms displacement by stretch of one axis and by shear, over that of single points


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a target, flat_m (P, 3) + basis (P, 3, S)·value_m (S,), with what is known of the values beforehand.

    `index` (P, 2): lattice indices. `prior_m` (S,): standard deviations of the values around zero. `group` (S,): values
    of one group have one prior; `from_data`: whether it is estimated together with them; that of the last group is then
    `_STRETCH` times that of the first.
    """

    index: IntArray
    flat_m: FloatArray
    basis: FloatArray
    value_m: FloatArray
    prior_m: FloatArray
    group: IntArray
    from_data: bool

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        points, values = len(self.index), len(self.value_m)
        check_shape("flat_m", self.flat_m, (points, 3))
        check_shape("basis", self.basis, (points, 3, values))
        check_shape("prior_m", self.prior_m, (values,))

    @property
    def points_m(self) -> FloatArray:
        """The points (P, 3) as they are estimated."""
        return np.asarray(self.flat_m + self.basis @ self.value_m)

    def moved(self, step_m: FloatArray) -> Shape:
        """Return the shape with its values changed by a step (S,)."""
        return replace(self, value_m=self.value_m + step_m)

    def with_prior_from(self, variance_m2: FloatArray) -> Shape:
        """Return the shape with each group's prior set to the spread of its values, known to `variance_m2` (S,).

        One step of expectation and maximisation: σ² = mean of value² + variance (Dempster, Laird, Rubin 1977).
        """
        if not self.from_data:
            return self
        second = self.value_m**2 + variance_m2
        inside, across = (float(np.sqrt(second[self.group == group].mean())) for group in (0, 1))
        return replace(self, prior_m=np.array([inside, across, _STRETCH * inside])[self.group])


def make_shape(kind: ShapeKind, index: IntArray, spacing_m: float) -> Shape:
    """Return the shape of the lattice points `index` (P, 2) before anything is known of it.

    `bowed`: height as a quadratic form of the place on the target. `free`: every point has an offset of its own, with
    one spread within the plane and one across; scale, place and turn of all points together stay those of the lattice
    to within what the spread allows (Strobl and Hirzinger 2011, ICCV Workshops, 1068). Since printers stretch one axis
    and shear, these two have an rms displacement of their own, three times that of the single points.
    """
    flat = np.column_stack([index * spacing_m, np.zeros(len(index))])
    points = len(index)
    if kind == "flat":
        return Shape(index, flat, np.zeros((points, 3, 0)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), False)
    if kind == "bowed":
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
        half = np.linalg.norm(flat - middle, axis=1).max()
        x, y = ((flat - middle)[:, :2] / half).T
        basis = np.zeros((points, 3, 3))
        basis[:, 2] = np.column_stack([x * x, x * y, y * y])
        return Shape(index, flat, basis, np.zeros(3), np.full(3, _BOW * half), np.zeros(3, np.int64), False)
    place = (flat - flat.mean(axis=0))[:, :2]
    stretch, shear = np.zeros((points, 3, 1)), np.zeros((points, 3, 1))
    stretch[:, :2, 0], shear[:, :2, 0] = place * [1, -1], place[:, ::-1]
    size = np.sqrt((place**2).sum(axis=1).mean())
    single = np.eye(3 * points).reshape(points, 3, 3 * points)
    basis = np.concatenate([single, stretch / size, shear / size], axis=-1)
    group = np.array([*np.tile([0, 0, 1], points), 2, 2])
    prior = np.array([1.0, 1.0, _STRETCH])[group] * _FREE * spacing_m
    return Shape(index, flat, basis, np.zeros(len(group)), prior, group, True)
