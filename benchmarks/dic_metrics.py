"""Metrics of the DIC Challenge 2.0, computed from points and displacements alone.

Reu et al. 2022, Exp. Mech. 62, 639: the star has the displacement v = 0.5 px · cos(2π(y − 250)/p) and u = 0; its period
p grows evenly from 10 px in the first column to 300 px in the last. Along the centre row v is 0.5 px everywhere, so
that the measured v over 0.5 px is the transfer function of a program.

- Spatial resolution λ: a polynomial of degree 12 in p is fitted to that ratio. λ is the smallest period at which it
  rises above 0.9.
- Noise σ: standard deviation of a displacement whose true value is 0.
- Metrological Efficiency Indicator: MEI = σ·λ, smaller is better (Grédiac, Blaysat, Sur 2017, Exp. Mech. 57, 871).

Uncertainties come from resampling blocks of columns, the same blocks for all programs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
AMPLITUDE_PX, MIDDLE_PX, WIDTH_PX = 0.5, 250.0, 4000
PERIODS_PX = (10.0, 300.0)
LEVEL, DEGREE = 0.9, 12  # of the protocol
LONG_PX = 200.0  # periods from which on noise and bias are evaluated
AVERAGED_PX = 75.0  # of the running mean along the centre row
GRID_PX = 0.05  # of periods
RESAMPLES = 400


@dataclass(frozen=True)
class Field:
    """Displacements shifts (N,2) in px of subsets centred at points (N,2), NaN where there is none."""

    points: FloatArray
    shifts: FloatArray

    @property
    def period(self) -> FloatArray:
        """Period (N,) of the displacement at the points, in px."""
        return period_px(self.points[:, 0])

    @property
    def error(self) -> FloatArray:
        """Displacements minus true ones (N,2) in px."""
        return self.shifts - true_shift(self.points)


def period_px(x: FloatArray) -> FloatArray:
    """Return the period of the displacement in the columns x."""
    return PERIODS_PX[0] + (PERIODS_PX[1] - PERIODS_PX[0]) * x / (WIDTH_PX - 1)


def true_shift(points: FloatArray) -> FloatArray:
    """Return the displacement (N,2) in px at points (N,2)."""
    v = AMPLITUDE_PX * np.cos(2.0 * np.pi * (points[:, 1] - MIDDLE_PX) / period_px(points[:, 0]))
    return np.column_stack([np.zeros_like(v), v])


def centre_row(field: Field) -> tuple[FloatArray, FloatArray]:
    """Return columns (K,) in px and the ratio (K,) of measured to true displacement along the centre row."""
    line = np.flatnonzero(field.points[:, 1] == MIDDLE_PX)
    if len(line) == 0:
        raise ValueError(f"points: expected some in the row {MIDDLE_PX:g}, found none")
    line = line[np.argsort(field.points[line, 0])]
    return field.points[line, 0], field.shifts[line, 1] / AMPLITUDE_PX


def transfer_curves(period: FloatArray, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a grid of periods (G,) and the protocol's polynomials (R,G) of ratios (R,K), without missing points."""
    seen = np.isfinite(ratios).all(axis=0)
    first, last = period[seen].min(), period[seen].max()
    grid = np.linspace(first, last, int((last - first) / GRID_PX) + 1)
    basis, evaluated = (chebvander(2.0 * (p - first) / (last - first) - 1.0, DEGREE) for p in (period[seen], grid))
    return grid, ratios[:, seen] @ (evaluated @ np.linalg.pinv(basis)).T


def first_rise(period: FloatArray, ratio: FloatArray) -> float:
    """Return the smallest period at which the ratio rises above 0.9, NaN if it never does."""
    rises = np.flatnonzero((ratio[:-1] < LEVEL) & (ratio[1:] >= LEVEL))
    if len(rises) == 0:
        return float("nan")
    at = rises[0]
    return float(np.interp(LEVEL, ratio[at : at + 2], period[at : at + 2]))


def resolution_px(field: Field) -> float:
    """Return λ as the protocol defines it."""
    x, ratio = centre_row(field)
    grid, curves = transfer_curves(period_px(x), ratio[None])
    return first_rise(grid, curves[0])


def running_mean(field: Field) -> tuple[FloatArray, FloatArray]:
    """Return periods and the ratio along the centre row, both as means over 75 px; NaN next to missing points."""
    x, ratio = centre_row(field)
    width = max(1, round(AVERAGED_PX / (x[1] - x[0])))
    box = np.full(width, 1.0 / width)
    return np.convolve(period_px(x), box, "valid"), np.convolve(ratio, box, "valid")


def lasting_resolution_px(field: Field) -> float:
    """Return the smallest period from which on the running mean stays above 0.9 and no point is missing."""
    period, ratio = running_mean(field)
    below = np.flatnonzero(~(ratio >= LEVEL))
    if len(below) == 0:
        return float(period[0])
    last = below[-1]
    if last + 1 == len(period) or np.isnan(ratio[last]):
        return float(period[min(last + 1, len(period) - 1)])
    return float(np.interp(LEVEL, ratio[last : last + 2], period[last : last + 2]))


def projected_amplitude(side_px: int, order: int, period: FloatArray) -> FloatArray:
    """Return the ratio that least squares leave of a wave at the centre of a subset, without noise.

    A subset averages with the weights of a polynomial fit of its order over its pixels (Savitzky–Golay).
    """
    line = np.arange(side_px) - (side_px - 1) / 2.0
    weights = np.linalg.pinv(np.vander(line, order + 1, increasing=True))[0]
    return np.asarray(np.cos(2.0 * np.pi * np.outer(1.0 / period, line)) @ weights)


def predicted_resolution_px(side_px: int, order: int) -> float:
    """Return λ of `projected_amplitude`."""
    period = np.arange(4.0, 600.0, GRID_PX / 5.0)
    return first_rise(period, projected_amplitude(side_px, order, period))


def noise_px(field: Field) -> float:
    """Return the standard deviation of u, whose true value is 0, where the period is longer than 200 px."""
    return float(np.nanstd(field.shifts[field.period > LONG_PX, 0]))


def pixel_bias_px(field: Field) -> float:
    """Return the amplitude of the error of v that is periodic in the pixel, b of b·sin(2πv).

    Fitted where the period is longer than 200 px, with terms v and v/p² for the attenuation of the subset.
    """
    return float(_pixel_bias(*_bias_terms(field)[:2]))


def _bias_terms(field: Field) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return terms (M,4), errors (M,) and columns (M,) of the fit of `pixel_bias_px`."""
    v, error = true_shift(field.points)[:, 1], field.error[:, 1]
    used = np.isfinite(error) & (field.period > LONG_PX)
    curvature = (LONG_PX / field.period) ** 2
    terms = np.column_stack([np.sin(2.0 * np.pi * v), v, v * curvature, np.ones_like(v)])
    return terms[used], error[used], field.points[used, 0]


def _pixel_bias(terms: FloatArray, error: FloatArray) -> float:
    return float(np.linalg.lstsq(terms, error, rcond=None)[0][0])


@dataclass(frozen=True)
class Resamples:
    """Resolution, noise and bias periodic in the pixel of resamples (R,), in px."""

    resolution: FloatArray
    noise: FloatArray
    bias: FloatArray

    @property
    def mei(self) -> FloatArray:
        """MEI (R,) in px²."""
        return self.resolution * self.noise


def resample(field: Field, block_px: float, seed: int = 0) -> Resamples:
    """Return the metrics of resamples; equal columns and seeds have equal resamples.

    λ: residuals about the polynomial change their sign block by block (wild bootstrap), so that no period is lost.
    σ and bias: blocks are drawn with replacement. A block of columns is block_px wide, more than a subset, because
    overlapping subsets correlate.
    """
    rng = np.random.default_rng(seed)
    x, ratio = centre_row(field)
    grid, curves = transfer_curves(period_px(x), ratio[None])
    fitted = np.interp(period_px(x), grid, curves[0])
    block = ((x - x[0]) / block_px).astype(np.int64)
    signs = rng.choice([-1.0, 1.0], (RESAMPLES, block[-1] + 1))[:, block]
    grid, curves = transfer_curves(period_px(x), fitted + signs * (ratio - fitted))
    resolution = np.array([first_rise(grid, curve) for curve in curves])
    long = (field.period > LONG_PX) & np.isfinite(field.shifts[:, 0])
    u, columns = field.shifts[long, 0], field.points[long, 0]
    edge = x[period_px(x) > LONG_PX][0]
    count = int((x[-1] - edge) / block_px) + 1
    picked = rng.integers(0, count, (RESAMPLES, count))
    sums = _block_sums(np.column_stack([np.ones_like(u), u, u**2]), columns - edge, block_px, count)
    number, first, second = sums[picked].sum(axis=1).T
    terms, error, columns = _bias_terms(field)
    products = (terms[:, :, None] * np.column_stack([terms, error])[:, None]).reshape(len(terms), -1)
    normal = _block_sums(products, columns - edge, block_px, count)[picked].sum(axis=1).reshape(RESAMPLES, 4, 5)
    bias = np.linalg.solve(normal[:, :, :4], normal[:, :, 4:])[:, 0, 0]
    return Resamples(resolution, np.sqrt(second / number - (first / number) ** 2), bias)


def _block_sums(values: FloatArray, x: FloatArray, block_px: float, count: int) -> FloatArray:
    """Return the sums (count, m) of values (N,m) over blocks of columns x (N,), counted from the first block."""
    block = (x / block_px).astype(np.int64)
    return np.stack([np.bincount(block, value, count) for value in values.T], axis=1)
