"""Surfaces that stereo pairs track, with the size and significance of their deflection."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fusion.base import prefix
from fusion.phasors.deformation import DeflectionShape
from fusion.phasors.stereo_phasors import StereoResult
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

MOST_POINTS = 120  # of one tracked surface that a page shows
SIGNIFICANT_RATIO = 1.5  # rms of a deflection over that of noise (chosen)


@dataclass(frozen=True)
class TrackedSurface:
    """Surface tracked by a pair: resolved lines and shown points."""

    name: str
    usable: BoolArray
    shape: DeflectionShape
    shown: IntArray

    @property
    def points_m(self) -> FloatArray:
        """Shown points (N, 3) at rest."""
        return np.asarray(self.shape.reference_m[self.shown])

    def _sizes(self, line: int) -> tuple[float, float] | None:
        """Return the rms of the deflection at a line, and that of noise alone."""
        if not self.usable[line]:
            return None
        k = int(np.count_nonzero(self.usable[:line]))
        value, u = self.shape.value[k], self.shape.u[k]
        return float(np.sqrt(3.0 * np.nanmean(np.abs(value) ** 2))), float(np.sqrt(6.0 * np.nanmean(u**2)))

    def deflection(self, line: int) -> ComplexArray | None:
        """Return the deflection (N, 3) of the shown points, None if not significant."""
        sizes = self._sizes(line)
        if sizes is None or not sizes[0] > SIGNIFICANT_RATIO * sizes[1]:
            return None
        return np.asarray(self.shape.value[int(np.count_nonzero(self.usable[:line]))][self.shown])

    def text(self, line: int) -> str:
        """Return the size of the deflection as text."""
        sizes = self._sizes(line)
        if sizes is None:
            return ""
        factor, letter = prefix(max(sizes))
        size, noise = (f"{value / factor:.3g} {letter}m" for value in sizes)
        end = (
            f"of which noise {noise}" if self.deflection(line) is not None else f"not above noise ({noise}), not drawn"
        )
        return f"points of {self.name} in addition to the rigid motion: rms {size}, {end}"


def tracked_surface(item: StereoResult) -> Iterator[TrackedSurface]:
    """Yield the surface of a pair with a limited number of finite points."""
    shape = item.deflection
    if shape is None:
        return
    finite = np.flatnonzero(np.isfinite(shape.value).all(axis=(0, 2)) & np.isfinite(shape.reference_m).all(axis=1))
    if len(finite) >= 3:
        chosen = np.unique(np.linspace(0, len(finite) - 1, min(MOST_POINTS, len(finite))).round().astype(int))
        yield TrackedSurface(item.name, item.usable, shape, finite[chosen])
