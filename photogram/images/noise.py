"""Image noise as a function of brightness: read noise, shot noise, and contradictions to them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from photogram.images.image_notices import NOISE_FALLS, NOISE_OF_ROWS, SENSOR_SATURATES
from shakercal._common.arrays import FloatArray, IntArray, check_shape
from shakercal._common.notices import Notice

QUANTISATION = 1.0 / 12.0  # variance of rounding to whole grey values
CUT = 9.0  # squared residuals beyond three standard deviations count as outliers
_ENLARGED = 1.0 / (1.0 - math.sqrt(2.0 * CUT / math.pi) * math.exp(-CUT / 2.0) / math.erf(math.sqrt(CUT / 2.0)))
"""F₁/F₃ at the cut, Fₙ the distribution of χ² with n degrees of freedom: correction of a mean for rejection."""
MEDIAN_CHI2 = 0.4549364231195724  # of χ² with one degree of freedom
BINS = 32  # enough for a line, with thousands of pixels in each
MIN_IN_BIN = 50  # pixels, for a variance to 20 %
NARROW = 0.1  # brightness range, relative to the brightest, below which shot noise and read noise cannot be separated
ROUNDS = 30  # usually fewer than ten are needed
MIN_VARIANCE_GREY2 = 0.5  # of every bin: below it, rounding to whole grey values hides the noise
SATURATED_NOISE = 0.5  # of the variance of darker pixels, below which the brightest ones are saturated
BELOW, PILED = 4, 0.5  # bins below saturated ones; range of the grey values of saturated ones over the least possible
MIN_FALL = 0.05  # of the variance from the darkest to the brightest third, 0.10 to 0.15 with a gamma of 0.45
SURE_SIGMA = 5.0
SHORTENED = 0.05
"""Shortening of motions below a pixel by a saturated share s of a body's pixels, 0.05·s^1.5. Measured in renderings
with speckle of 5 px: 0.02 % for 0.03, 0.16 % for 0.1, 0.6 % for 0.25; twice that for 3 px, half for 8 px."""
MIN_IN_ROW = 20  # pixels, for the mean of a row


@dataclass(frozen=True)
class NoiseModel:
    """Noise variance of a pixel of grey value g: read_variance_grey2 + variance_per_grey·g.

    It is at least 1/12, the variance of rounding. The photon transfer curve (Janesick 2007, Photon Transfer, SPIE, ch.
    5; EMVA 1288 release 4.0, eq. 10): the first term is the noise of the dark sensor, quantisation included. The second
    is shot noise, 1/(electrons per grey value).
    """

    read_variance_grey2: float
    variance_per_grey: float

    def __post_init__(self) -> None:
        for name in ("read_variance_grey2", "variance_per_grey"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a finite variance of 0 or more, found {getattr(self, name)}")

    def variance(self, grey: FloatArray | float) -> FloatArray:
        """Return the noise variance in grey² of pixels of any shape with grey values `grey`."""
        shot = self.variance_per_grey * np.maximum(grey, 0.0)
        return np.asarray(np.maximum(self.read_variance_grey2 + shot, QUANTISATION), dtype=np.float64)


def fit_noise_model(grey: FloatArray, residual_grey2: FloatArray) -> NoiseModel:
    """Fit a noise model to pixels' brightness (M,) and squared residuals (M,).

    Each squared residual is χ² distributed with one degree of freedom. Up to 32 bins of equal count divide the
    brightness. In a bin the variance s² is the mean of the residuals below 9·s², enlarged by F₁(9)/F₃(9) = 1.027 (Fₙ:
    distribution of χ² with n degrees of freedom, since ∫₀ᵗ x·f₁ = F₃(t)). The line through the bins has no negative
    coefficient; its relative weights follow from the line itself. A brightness range of less than 10 % of the brightest
    bin gives a constant. NaN pixels are ignored.
    """
    brightness, variance, count = noise_curve(grey, residual_grey2)
    if np.ptp(brightness) < NARROW * np.abs(brightness).max():
        return NoiseModel(max(float(np.average(variance, weights=count)), QUANTISATION), 0.0)
    columns = np.column_stack([np.ones_like(brightness), np.maximum(brightness, 0.0)])
    solution, expected = np.zeros(2), np.full_like(variance, variance.mean())
    for _ in range(4):
        weight = np.sqrt(count) / np.maximum(expected, QUANTISATION)
        solution = _nonnegative(columns * weight[:, None], variance * weight)
        expected = columns @ solution
    return NoiseModel(float(solution[0]), float(solution[1]))


def noise_curve(grey: FloatArray, residual_grey2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean grey value, robust variance and count of pixels in bins (B,).

    The bins are in order of brightness (`fit_noise_model`).
    """
    check_shape("grey", grey, (None,))
    check_shape("residual_grey2", residual_grey2, (len(grey),))
    finite = np.isfinite(grey) & np.isfinite(residual_grey2)
    if finite.sum() < MIN_IN_BIN:
        raise ValueError(f"grey: expected at least {MIN_IN_BIN} finite pixels, found {finite.sum()}")
    order = np.flatnonzero(finite)[np.argsort(grey[finite])]
    parts = np.array_split(order, max(1, min(BINS, len(order) // MIN_IN_BIN)))
    brightness = np.array([grey[part].mean() for part in parts])
    variance = np.array([_robust_variance(residual_grey2[part]) for part in parts])
    return brightness, variance, np.array([float(len(part)) for part in parts])


def noise_notices(grey: FloatArray, residual_grey: FloatArray, row: IntArray, where: str) -> list[Notice]:
    """Return notices of noise that no linear sensor with independent pixels has.

    `grey`, `residual_grey`, `row`: brightness, residual and image row (M,) of pixels; NaN pixels are ignored.

    The variance of a linear sensor never falls with brightness. It falls steeply in the brightest pixels where wells
    are full before read noise is added, and slowly everywhere behind a gamma curve: a variance that is proportional to
    the light becomes proportional to g^(2 − 1/γ) of codes g = light^γ, which falls for γ below ½.

    Pixels of a row whose noise has a common part of relative variance s² have a mean of variance (1 + n·s²)/n.
    """
    bins = noise_curve(grey, residual_grey**2)
    notices = [notice for notice in (_saturation(*bins, where) or _fall(*bins, where),) if notice is not None]
    finite = np.isfinite(residual_grey)
    count = np.bincount(row[finite])
    sums = np.bincount(row[finite], residual_grey[finite])
    full = np.flatnonzero(count >= MIN_IN_ROW)
    variance = float(np.average(bins[1], weights=bins[2]))
    if variance < MIN_VARIANCE_GREY2 or len(full) == 0:
        return notices
    sign = np.where(full % 2 == 0, 1.0, -1.0)  # even and odd rows may differ: that is no noise
    total = sums[full] - sign * count[full] * float(np.sum(sign * sums[full]) / np.sum(count[full]))
    excess = float(np.mean(total**2 / count[full])) / variance - 1.0  # n·s²
    if excess > 1.0 + SURE_SIGMA * math.sqrt(2.0 / len(full)):
        row_grey = math.sqrt(excess * variance / float(np.mean(count[full])))
        notices.append(Notice(NOISE_OF_ROWS, where, row_grey=row_grey, pixel_grey=math.sqrt(variance)))
    return notices


def _saturation(grey: FloatArray, variance: FloatArray, count: FloatArray, where: str) -> Notice | None:
    """Return a warning where the brightest pixels scatter less than noise allows.

    Their variance is far below that of all darker ones, or their bins are closer together than those of equally bright
    pixels with the noise of the bins below.
    """
    half, found = len(grey) // 2, 0
    if half == 0 or (floor := float(variance[:half].min())) < MIN_VARIANCE_GREY2:
        return None
    quantile = np.array([NormalDist().inv_cdf((k + 0.5) / len(grey)) for k in range(len(grey))])
    for bins in range(1, half):
        top, below = float(variance[-bins:].max()), float(np.median(variance[-bins - BELOW : -bins]))
        spread = PILED * math.sqrt(below) * float(quantile[-1] - quantile[-bins])
        if grey[-1] - grey[-bins] < spread or top < SATURATED_NOISE * min(below, floor):
            found = bins
    if found == 0:
        return None
    share, level = float(count[-found:].sum() / count.sum()), float(grey[-found])
    shortening = 100.0 * SHORTENED * share**1.5
    return Notice(SENSOR_SATURATES, where, share_percent=100.0 * share, level=level, shortening_percent=shortening)


def _fall(grey: FloatArray, variance: FloatArray, count: FloatArray, where: str) -> Notice | None:
    """Return a note where the noise falls from dark to bright pixels."""
    third = len(grey) // 3
    if third == 0 or variance.min() < MIN_VARIANCE_GREY2 or np.ptp(grey) < NARROW * np.abs(grey).max():
        return None
    dark, bright = variance[:third].mean(), variance[-third:].mean()
    fall = 1.0 - float(bright / dark)
    uncertainty = math.sqrt(2.0 / float(count[:third].sum()) + 2.0 / float(count[-third:].sum()))
    if fall < max(MIN_FALL, SURE_SIGMA * uncertainty):
        return None
    return Notice(NOISE_FALLS, where, fall_percent=100.0 * fall)


def _robust_variance(squares: FloatArray) -> float:
    """Return the mean of squares of normal deviates, corrected for those rejected beyond 3σ."""
    ordered, middle = np.sort(squares), len(squares) // 2
    median = 0.5 * float(ordered[middle] + ordered[-1 - middle])
    sums, variance = np.cumsum(ordered), median / MEDIAN_CHI2
    for _ in range(ROUNDS):
        number = np.searchsorted(ordered, CUT * variance, side="right")
        before, variance = variance, _ENLARGED * float(sums[number - 1] / number)
        if abs(variance - before) <= 1e-6 * before:
            break
    return variance


def _nonnegative(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Solve values (M,) by columns (M, 2) in least squares, neither coefficient below zero."""
    both, *_ = np.linalg.lstsq(columns, values)
    if (both >= 0.0).all():
        return np.asarray(both)
    alone = np.diag(np.maximum(columns.T @ values, 0.0) / np.sum(columns**2, axis=0))
    return np.asarray(min(alone, key=lambda one: float(np.sum((values - columns @ one) ** 2))))
