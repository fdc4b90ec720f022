"""One point of a plan: the lines of an excitation, and what one camera rate makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.signals.folding import Fold, alias_frequency, exposure_gain, folded_harmonics
from shaker.signals.plan.prediction import amplitude_covariance, rms_uncertainty

WATCHED = 20
"""Highest multiple of a fundamental whose fold onto a fitted line is looked for."""
_SAME = 1e-9  # relative difference below which a harmonic of one fundamental is a line of another


@dataclass(frozen=True)
class Sampling:
    """What stays the same while camera rates are compared.

    `frames` per point, `exposure_s` of each; `harmonics` fitted with every fundamental (1: it alone); `corner_hz` at
    which 1/f noise is as strong as white noise; `tolerance`, the relative accuracy to which excitation and camera
    rate are known beforehand.
    """

    frames: int
    exposure_s: float = 0.0
    harmonics: int = 5
    corner_hz: float = 5.0
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        if self.frames < 4 or self.harmonics < 1:
            found = f"{self.frames} and {self.harmonics}"
            raise ValueError(f"frames, harmonics: expected at least 4 frames and 1 harmonic, found {found}")
        for name in ("exposure_s", "corner_hz", "tolerance"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name}: expected a number of at least 0, found {value}")


@dataclass(frozen=True)
class Lines:
    """Lines (K,) that a point excites: `frequency_hz` = `multiple` · `fundamental_hz`, fundamentals first."""

    frequency_hz: FloatArray
    fundamental_hz: FloatArray
    multiple: IntArray

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        check_shape("fundamental_hz", self.fundamental_hz, self.frequency_hz.shape)
        check_shape("multiple", self.multiple, self.frequency_hz.shape)

    @property
    def fundamentals_hz(self) -> FloatArray:
        """Frequencies excited, (E,)."""
        return np.asarray(self.frequency_hz[self.multiple == 1])


@dataclass(frozen=True)
class RatePlan:
    """What one camera rate makes of a point.

    For each line (K,): `alias_hz`, where it appears; `gain`, what the exposure leaves of its amplitude; `u_amplitude`,
    the standard uncertainty of its amplitude, corrected for the exposure, for white noise of unit variance per frame
    (over the amplitude it is that of the phase in rad); `distance_hz` from the nearest other line, zero or the Nyquist
    frequency, and `neighbour_hz`, the frequency of that line (0 for zero, inf for the Nyquist frequency). `condition`
    of the design matrix; `folds`, unfitted harmonics that fall within a bin of a fitted line; `duration_s`.
    """

    lines: Lines
    rate_hz: float
    frames: int
    alias_hz: FloatArray
    gain: FloatArray
    u_amplitude: FloatArray
    distance_hz: FloatArray
    neighbour_hz: FloatArray
    condition: float
    folds: tuple[Fold, ...]

    @property
    def resolution_hz(self) -> float:
        """Width of a bin, rate/frames."""
        return self.rate_hz / self.frames

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the end of the last frame's interval."""
        return self.frames / self.rate_hz

    @property
    def distance_bins(self) -> float:
        """Smallest distance of any two lines, in bins."""
        return float(np.min(self.distance_hz)) / self.resolution_hz


def lines_of(fundamentals_hz: Sequence[float], harmonics: int) -> Lines:
    """Return the lines that fundamentals excited at the same time bring: multiples 1 to `harmonics` of each, once."""
    fundamentals = np.asarray(fundamentals_hz, dtype=np.float64)
    check_shape("fundamentals_hz", fundamentals, (None,))
    if not (len(fundamentals) and np.all(np.isfinite(fundamentals)) and np.all(fundamentals > 0.0)):
        raise ValueError(f"fundamentals_hz: expected frequencies above 0, found {fundamentals.tolist()}")
    multiple = np.repeat(np.arange(1, harmonics + 1, dtype=np.int64), len(fundamentals))
    fundamental = np.tile(fundamentals, harmonics)
    frequency = np.asarray(multiple * fundamental, dtype=np.float64)
    kept: list[int] = []
    for k in range(len(frequency)):
        if all(abs(frequency[k] - frequency[i]) > _SAME * frequency[k] for i in kept):
            kept.append(k)
    return Lines(frequency[kept], fundamental[kept], multiple[kept])


def plan_at(lines: Lines, rate_hz: float, sampling: Sampling) -> RatePlan:
    """Return what `rate_hz` makes of the lines: aliases, neighbours, loss by exposure, uncertainty."""
    frequency = lines.frequency_hz
    covariance, condition = amplitude_covariance(frequency, rate_hz, sampling.frames, sampling.corner_hz)
    gain = exposure_gain(frequency, sampling.exposure_s)
    distance, neighbour = _neighbours(frequency, rate_hz)
    return RatePlan(
        lines=lines,
        rate_hz=rate_hz,
        frames=sampling.frames,
        alias_hz=alias_frequency(frequency, rate_hz),
        gain=gain,
        u_amplitude=rms_uncertainty(covariance) / np.maximum(np.abs(gain), np.finfo(np.float64).tiny),
        distance_hz=distance,
        neighbour_hz=neighbour,
        condition=condition,
        folds=_unfitted_folds(lines, rate_hz, rate_hz / sampling.frames),
    )


def _neighbours(frequency: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Return the distance of each alias (K,) from the nearest other, zero or the Nyquist frequency, and which it is."""
    alias = alias_frequency(frequency, rate_hz)
    among = np.abs(np.subtract.outer(alias, alias))
    np.fill_diagonal(among, np.inf)
    # A line near the Nyquist frequency meets its own mirror image, which is twice as far away.
    distance = np.column_stack([among, alias, rate_hz - 2.0 * alias])
    names = np.append(frequency, [0.0, np.inf])
    nearest = np.argmin(distance, axis=1)
    return distance[np.arange(len(alias)), nearest], names[nearest]


def _unfitted_folds(lines: Lines, rate_hz: float, resolution_hz: float) -> tuple[Fold, ...]:
    """Return harmonics up to the 20th, not fitted themselves, that come within a bin of a fitted line."""
    found: dict[float, Fold] = {}
    for frequency in lines.frequency_hz:
        for fold in folded_harmonics(frequency, lines.fundamentals_hz.tolist(), rate_hz, resolution_hz, WATCHED):
            if np.all(np.abs(lines.frequency_hz - fold.frequency_hz) > _SAME * fold.frequency_hz):
                found[fold.frequency_hz] = fold
    return tuple(found[f] for f in sorted(found))
