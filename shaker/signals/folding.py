"""What sampling does to a line: aliases, lines that fold onto each other, loss by exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape

GRID_TOLERANCE = 1e-2  # of a sampling interval: times this close to a grid are treated as being on it


@dataclass(frozen=True)
class Fold:
    """A harmonic that a sampling rate folds onto another line: `frequency_hz` = `multiple`·`fundamental_hz`."""

    frequency_hz: float
    fundamental_hz: float
    multiple: int
    alias_hz: float


@dataclass(frozen=True)
class SamplingGrid:
    """Uniform sampling with gaps: sample i lies at `start_s + index[i] / rate_hz`."""

    start_s: float
    rate_hz: float
    index: IntArray

    @property
    def length(self) -> int:
        """Number of grid places from the first to the last sample."""
        return int(self.index[-1]) + 1

    def filled(self, values: FloatArray) -> FloatArray:
        """Return values (S, C) on all places of the grid, zero in the gaps."""
        if len(values) == self.length:
            return values
        full = np.zeros((self.length, values.shape[1]))
        full[self.index] = values
        return full


def alias_frequency(frequency_hz: FloatArray | float, rate_hz: float) -> FloatArray:
    """Return where lines appear between zero and the Nyquist frequency: |f - rate·round(f / rate)|."""
    f = np.asarray(frequency_hz, dtype=np.float64)
    return np.asarray(np.abs(f - rate_hz * np.round(f / rate_hz)))


def exposure_gain(frequency_hz: FloatArray, exposure_s: float) -> FloatArray:
    """Return sin(πfT) / (πfT): what a rectangular exposure of T seconds leaves of a line's amplitude."""
    return np.asarray(np.sinc(np.asarray(frequency_hz, dtype=np.float64) * exposure_s))


def beat_phase(time_s: FloatArray, frequency_hz: float) -> FloatArray:
    """Return the phase of a line at the times given, in [0, 2π) rad: the abscissa that folds a record on one period.

    A camera slower than the line sees one period spread over one beat; over this phase the frames fall into place.
    """
    return np.asarray(2.0 * np.pi * np.mod(np.asarray(time_s, dtype=np.float64) * frequency_hz, 1.0))


def sampling_grid(time_s: FloatArray) -> SamplingGrid | None:
    """Return the uniform grid (with gaps) on which ascending times lie within 1 % of an interval, or None."""
    check_shape("time_s", time_s, (None,))
    if len(time_s) < 3 or not np.all(np.diff(time_s) > 0.0):
        return None
    interval = float(np.median(np.diff(time_s)))
    index = np.concatenate([[0], np.cumsum(np.round(np.diff(time_s) / interval))]).astype(np.int64)
    if index[-1] < len(time_s) - 1 or np.any(np.diff(index) < 1):
        return None
    centred = index - index.mean()
    interval = float(centred @ time_s / (centred @ centred))
    start = float(np.mean(time_s) - interval * index.mean())
    deviation = float(np.max(np.abs(time_s - start - interval * index)))
    return SamplingGrid(start, 1.0 / interval, index) if deviation <= GRID_TOLERANCE * interval else None


def sine_columns(time_s: FloatArray, frequency_hz: FloatArray, drift: bool = False) -> FloatArray:
    """Return the design matrix (S, 2K + 1 or 2): cos and sin of each line in turn, then offset and drift.

    Columns have unit length for ideal sampling (cos, sin by √(2/S)), so the condition number says how far the actual
    sampling is from it; a line at zero or the Nyquist frequency keeps a vanishing column and is seen at once. The
    drift column is linear in time, zero in the middle.
    """
    samples, lines = len(time_s), len(frequency_hz)
    columns = np.empty((samples, 2 * lines + (2 if drift else 1)), order="F")
    scale = np.sqrt(2.0 / samples)
    for k, frequency in enumerate(frequency_hz):
        # Whole turns are taken off before the angle is formed, so long records keep their last digits.
        angle = 2.0 * np.pi * np.mod(frequency * time_s, 1.0)
        columns[:, 2 * k] = scale * np.cos(angle)
        columns[:, 2 * k + 1] = scale * np.sin(angle)
    columns[:, 2 * lines] = np.sqrt(1.0 / samples)
    if drift:
        centred = time_s - np.mean(time_s)
        columns[:, 2 * lines + 1] = centred / np.linalg.norm(centred)
    return columns


def condition_number(gram: FloatArray) -> float:
    """Return the condition number of a design matrix from its Gram matrix XᵀX (infinite where singular)."""
    eigenvalues = np.linalg.eigvalsh(gram)
    limit = float(eigenvalues[-1]) * len(gram) * float(np.finfo(np.float64).eps)
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > limit else float("inf")


def folded_harmonics(
    frequency_hz: float,
    fundamentals_hz: Sequence[float],
    rate_hz: float,
    resolution_hz: float,
    max_multiple: int = 20,
) -> tuple[Fold, ...]:
    """Return the harmonics of the fundamentals that `rate_hz` folds within `resolution_hz` of a line's alias.

    What they contain in an unfiltered record is added to the line, and no fit can take it out.
    """
    alias = float(alias_frequency(frequency_hz, rate_hz))
    found: dict[float, Fold] = {}
    for fundamental in fundamentals_hz:
        for multiple in range(1, max_multiple + 1):
            other = multiple * fundamental
            other_alias = float(alias_frequency(other, rate_hz))
            same_line = abs(other - frequency_hz) <= resolution_hz
            known = any(abs(other - f) <= resolution_hz for f in found)
            if abs(other_alias - alias) <= resolution_hz and not same_line and not known:
                found[other] = Fold(other, float(fundamental), multiple, other_alias)
    return tuple(sorted(found.values(), key=lambda fold: fold.frequency_hz))
