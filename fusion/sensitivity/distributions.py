"""Distributions of complex quantities by Monte Carlo draws, compared with first-order propagation of uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.estimation.coverage import COVERAGE
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice

DIGITS = 2
"""Significant digits of the standard uncertainty in which both ways can agree at best (JCGM 101, 7.9.2)."""
BATCHES = 10
"""Parts of the draws whose scatter says how well their number determines a result (JCGM 101, 7.9.4)."""
SIGNIFICANT = 3.0
"""Standard uncertainties of the draws' own that a difference must exceed to count against first-order propagation."""
REGION_TOLERANCE = 0.01
"""What the share of draws in the first-order 95 % region may differ from 95 %."""
WEAK = 5.0
"""Magnitude over the largest standard uncertainty of the complex value below which only its region is judged: magnitude
and phase of smaller values are no linear functions of it within their spread."""


@dataclass(frozen=True)
class RealSpread:
    """Magnitude or phase of Q quantities at L lines, by draws and by first-order propagation.

    All (L, Q). `mean`, `u` (standard deviation) of the draws. `low`, `high`: their shortest 95 % interval (JCGM 101,
    7.7); `u_end`: standard uncertainty of its ends by the number of draws. `first_u`, `first_low`, `first_high`:
    first-order u, and estimate ± k·u.
    """

    mean: FloatArray
    u: FloatArray
    low: FloatArray
    high: FloatArray
    u_end: FloatArray
    first_u: FloatArray
    first_low: FloatArray
    first_high: FloatArray

    @property
    def d_low(self) -> FloatArray:
        """Return how far the lower ends are apart, (L, Q) (JCGM 101, 8.1.3)."""
        return np.asarray(np.abs(self.first_low - self.low))

    @property
    def d_high(self) -> FloatArray:
        """Return how far the upper ends are apart, (L, Q) (JCGM 101, 8.1.3)."""
        return np.asarray(np.abs(self.first_high - self.high))

    @property
    def digits(self) -> IntArray:
        """Return the number of significant digits (L, Q) of u in which the ends agree.

        2, 1 or 0 (JCGM 101, 8.1.3).
        """
        distance = np.maximum(self.d_low, self.d_high)
        return np.asarray(np.sum([distance <= tolerance(self.first_u, n) for n in range(1, DIGITS + 1)], axis=0))

    @property
    def rejected(self) -> BoolArray:
        """Return (L, Q) whether the ends differ in the first digit of u.

        By more than the number of draws explains.
        """
        return self._beyond(np.maximum(self.d_low, self.d_high))

    @property
    def too_narrow(self) -> BoolArray:
        """Return (L, Q) whether the draws' interval reaches beyond the first-order one by as much."""
        return self._beyond(np.maximum(self.first_low - self.low, self.high - self.first_high))

    def _beyond(self, distance: FloatArray) -> BoolArray:
        """Whether a distance (L, Q) of ends counts."""
        return np.asarray(distance > tolerance(self.first_u, 1) + SIGNIFICANT * self.u_end)


@dataclass(frozen=True)
class FirstOrder(Arrays):
    """Q complex quantities at L lines with their first-order uncertainty.

    `elements`, `unit` (Q names). `value` (L, Q), NaN where a line does not determine a quantity. `first_covariance` (L,
    Q, 2, 2) of its (Re, Im). `first_region` (L, Q, 2, 2): matrix of its 95 % region (`coverage.region_matrix`).
    `k_polar` (2, L, Q): coverage factors of magnitude and phase.
    """

    name: str
    frequency_hz: FloatArray
    elements: tuple[str, ...]
    unit: tuple[str, ...]
    value: ComplexArray
    first_covariance: FloatArray
    first_region: FloatArray
    k_polar: FloatArray

    def at(self, lines: IntArray, elements: IntArray) -> FirstOrder:
        """Return some of the elements at some of the lines, by their places."""
        index = np.ix_(lines, elements)
        return FirstOrder(
            self.name,
            self.frequency_hz[lines],
            tuple(self.elements[q] for q in elements),
            tuple(self.unit[q] for q in elements),
            self.value[index],
            self.first_covariance[index],
            self.first_region[index],
            self.k_polar[:, lines][:, :, elements],
        )


@dataclass(frozen=True)
class Propagated(
    FirstOrder,
    shapes="frequency_hz L; elements Q; unit Q; value L Q; mean L Q; factor L Q; first_holds L Q; k_polar 2 L Q; "
    "first_covariance L Q 2 2; first_region L Q 2 2; covariance L Q 2 2",
):
    """Q complex quantities at L lines by N Monte Carlo draws.

    `mean` (L, Q), `covariance` (L, Q, 2, 2) of the draws. `factor` (L, Q): the ellipse (z - mean)ᵀ·covariance⁻¹·(z -
    mean) ≤ factor² contains 95 % of them (JCGM 102, 7.7.2). `first_holds` (L, Q): share of the draws inside the stated
    region. `magnitude`, `phase` (rad, within π of the value's phase): real quantities of the same draws.
    """

    mean: ComplexArray
    covariance: FloatArray
    factor: FloatArray
    first_holds: FloatArray
    magnitude: RealSpread
    phase: RealSpread

    @property
    def weak(self) -> BoolArray:
        """Return (L, Q) which values are too small for a significant magnitude and phase.

        Relative to their ellipse.
        """
        finite = np.isfinite(self.first_covariance).all(axis=(-1, -2))
        longest = np.full(self.value.shape, np.nan)
        longest[finite] = np.sqrt(np.linalg.eigvalsh(self.first_covariance[finite])[:, -1])
        return np.asarray(np.abs(self.value) < WEAK * longest)

    def rejected_parts(self, draws: int, line: int, element: int, *, too_small: bool = False) -> tuple[str, ...]:
        """Return the parts of a quantity for which first-order propagation is wrong.

        "region", "magnitude", "phase". `too_small`: only those that first-order U does not cover.
        """
        chance = SIGNIFICANT * np.sqrt(COVERAGE * (1.0 - COVERAGE) / draws)
        missing = COVERAGE - float(self.first_holds[line, element])
        wrong = ["region"] if (missing if too_small else abs(missing)) > REGION_TOLERANCE + chance else []
        if not self.weak[line, element]:
            for what, spread in (("magnitude", self.magnitude), ("phase", self.phase)):
                differs = spread.too_narrow if too_small else spread.rejected
                wrong += [what] if differs[line, element] else []
        return tuple(wrong)


@dataclass(frozen=True)
class MonteCarlo:
    """Propagation of distributions through everything that follows tracks and channels (JCGM 101 and 102).

    `draws`, `seed`: the same pair gives the same numbers; `results`: acceleration of each body, load, sensitivity.
    """

    draws: int
    seed: int
    results: tuple[Propagated, ...]
    notices: tuple[Notice, ...]


def summarise(first: FirstOrder, draws: ComplexArray) -> Propagated:
    """Return statistics of N draws (N, L, Q) together with first-order propagation."""

    mean = draws.mean(axis=0)
    parts = np.stack([(draws - mean).real, (draws - mean).imag], axis=-1)
    covariance = np.asarray(np.einsum("nlqi,nlqj->lqij", parts, parts) / (len(draws) - 1))
    factor = np.sqrt(np.quantile(_distance(draws - mean, covariance), COVERAGE, axis=0))
    inside = _distance(draws - first.value, first.first_region) <= 1.0
    finite = np.isfinite(mean) & np.isfinite(first.value)
    size = np.abs(first.value)
    angle = np.angle(draws * np.conj(first.value)) + np.angle(first.value)
    # First-order standard uncertainties of magnitude and phase (JCGM 102, 9.4).
    unit = np.divide(first.value, size, out=np.full(size.shape, complex(np.nan, np.nan)), where=size > 0.0)
    along, across = (
        np.sqrt(np.einsum("lqi,lqij,lqj->lq", e, first.first_covariance, e))
        for e in (np.stack([unit.real, unit.imag], axis=-1), np.stack([-unit.imag, unit.real], axis=-1))
    )
    k_magnitude, k_phase = first.k_polar
    return Propagated(
        **vars(first),
        mean=mean,
        covariance=covariance,
        factor=factor,
        first_holds=np.where(finite, inside.mean(axis=0), np.nan),
        magnitude=_spread(np.abs(draws), size, along, k_magnitude),
        phase=_spread(np.where(np.isfinite(draws), angle, np.nan), np.angle(first.value), across / size, k_phase),
    )


def _distance(difference: ComplexArray, covariance: FloatArray) -> FloatArray:
    """Return squared Mahalanobis distances (N, L, Q); of singular covariances along their directions."""
    inverse = np.full(covariance.shape, np.nan)
    finite = np.isfinite(covariance).all(axis=(-1, -2))
    inverse[finite] = np.linalg.pinv(covariance[finite], hermitian=True)
    re, im = difference.real, difference.imag
    return np.asarray(inverse[..., 0, 0] * re**2 + 2.0 * inverse[..., 0, 1] * re * im + inverse[..., 1, 1] * im**2)


def _spread(draws: FloatArray, estimate: FloatArray, u: FloatArray, k: FloatArray) -> RealSpread:
    """Return statistics of real draws (N, L, Q) for an estimate with u and k."""
    low, high = shortest_interval(draws)
    parts = [np.stack(shortest_interval(part)) for part in np.array_split(draws, BATCHES)]
    # The place of a shortest interval converges with the cube root of the number of draws (Andrews et al. 1972).
    u_end = np.std(parts, axis=0, ddof=1).max(axis=0) / np.cbrt(BATCHES)
    return RealSpread(
        mean=draws.mean(axis=0),
        u=draws.std(axis=0, ddof=1),
        low=low,
        high=high,
        u_end=u_end,
        first_u=u,
        first_low=estimate - k * u,
        first_high=estimate + k * u,
    )


def shortest_interval(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the shortest interval with 95 % of draws (N, ...).

    JCGM 101, 7.7.4 and 5.3.4.
    """
    ordered = np.sort(draws, axis=0)
    inside = int(COVERAGE * len(ordered) + 0.5)
    first = np.argmin(np.nan_to_num(ordered[inside:] - ordered[:-inside]), axis=0)[None]
    low = np.take_along_axis(ordered, first, axis=0)[0]
    return low, np.take_along_axis(ordered, first + inside, axis=0)[0]


def tolerance(u: FloatArray, digits: int) -> FloatArray:
    """Return half a unit of the last of `digits` significant digits of u.

    Numerical tolerance of JCGM 101, 7.9.2.
    """
    usable = np.isfinite(u) & (u > 0.0)
    power = np.floor(np.log10(np.where(usable, u, 1.0))) - (digits - 1)
    return np.where(usable, 0.5 * 10.0**power, np.nan)


def judged(results: Sequence[Propagated], draws: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the quantities whose first-order U is too small, and too large."""
    small: list[str] = []
    large: list[str] = []
    for result in results:
        for line, element in np.ndindex(result.value.shape):
            where = f"{result.elements[element]}, {result.frequency_hz[line]:.6g} Hz"
            short = result.rejected_parts(draws, line, element, too_small=True)
            for what in result.rejected_parts(draws, line, element):
                (small if what in short else large).append(f"{what} of the {result.name} ({where})")
    return tuple(small), tuple(large)
