"""Camera rates for excited lines: aliases, expected uncertainty, and the best rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker.sine.aliasing import (
    CLEAR_BINS,
    AliasedHarmonic,
    alias_frequency,
    condition_number,
    differences_hz,
    exposure_gain,
    find_aliased_harmonics,
    sine_columns,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

# How uncertain the amplitudes of a least-squares fit of sines will be, before anything is measured.

_REFINEMENT = 16  # points of the noise integral per bin of the record


def amplitude_covariance(
    frequency_hz: FloatArray, rate_hz: float, frames: int, corner_hz: float = 0.0
) -> tuple[FloatArray, float]:
    """Return the covariance (K, 2, 2) of fitted amplitudes, and the condition number.

    The amplitudes are those of cosine and sine in an ordinary least-squares fit of the lines and an offset to `frames`
    uniform samples. The noise has the spectral density S(f) = (2/rate)·(1 + corner/f): white with unit variance per
    frame, and 1/f noise that is as strong at `corner_hz`. With C = (XᵀX)⁻¹Xᵀ the covariance is (XᵀX)⁻¹ +
    ∫(corner/|f|)·C(f)·C(f)ᴴ df/rate, with the Fourier transforms C(f) of the rows of C. For well separated lines both
    quadratures have (2/frames)·(1 + corner/alias). The integral is finite because the fitted offset removes constants.
    """
    check_shape("frequency_hz", frequency_hz, (None,))
    lines = len(frequency_hz)
    if not frames > 2 * lines + 1:
        raise ValueError(f"frames: expected more than {2 * lines + 1} for {lines} lines and an offset, found {frames}")
    columns = sine_columns(np.arange(frames) / rate_hz, frequency_hz)
    gram = columns.T @ columns
    condition = condition_number(gram)
    if not np.isfinite(condition):
        return np.full((lines, 2, 2), np.inf), condition
    inverse = np.linalg.inv(gram)
    covariance = inverse
    if corner_hz != 0.0:
        length = _REFINEMENT * frames
        response = np.fft.rfft(inverse @ columns.T, n=length, axis=1)[:, 1:]  # at zero the offset takes all
        weight = np.full(response.shape[1], 2.0 / length)
        weight[-1] = 1.0 / length  # the length is even: the Nyquist frequency counts once
        density = corner_hz / (rate_hz / length * np.arange(1, response.shape[1] + 1))
        covariance = inverse + ((response * (weight * density)) @ response.conj().T).real
    pairs = np.arange(2 * lines).reshape(lines, 2)
    return np.asarray(2.0 / frames * covariance[pairs[:, :, None], pairs[:, None, :]]), condition


def rms_uncertainty(covariance: FloatArray) -> FloatArray:
    """Return √(trace/2) of covariances (K, 2, 2): an amplitude's mean u over phases."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2.0))


# One point of a plan: the lines of an excitation at one camera rate.

WATCHED = 20
"""Highest multiple of a fundamental whose alias on a fitted line is searched for."""
_SAME = 1e-9  # relative difference below which a harmonic of one fundamental is a line of another


@dataclass(frozen=True)
class Sampling:
    """Conditions that are constant while camera rates are compared.

    Attributes
    ----------
    frames : number of frames per point.
    exposure_s : exposure time in s, default 0.
    harmonics : harmonics fitted with every fundamental, default 5; 1 means the fundamental alone.
    corner_hz : frequency in Hz at which 1/f noise equals white noise, default 5.
    tolerance : relative accuracy of the stated excitation and camera rate, default 1e-4.

    Examples
    --------
    >>> from shaker import Sampling
    >>> Sampling(frames=500, exposure_s=2e-3).harmonics
    5
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
class PlannedLines(Arrays, shapes="frequency_hz K; fundamental_hz K; multiple K"):
    """Lines (K,) of an excitation: `frequency_hz` = `multiple` · `fundamental_hz`, fundamentals first."""

    frequency_hz: FloatArray
    fundamental_hz: FloatArray
    multiple: IntArray

    @property
    def fundamentals_hz(self) -> FloatArray:
        """Excited frequencies (E,)."""
        return np.asarray(self.frequency_hz[self.multiple == 1])


@dataclass(frozen=True)
class RatePlan:
    """Lines of one excitation at one camera rate.

    Attributes
    ----------
    lines, rate_hz, frames : the lines and the sampling.
    alias_hz : (K,), alias of each line.
    gain : (K,), gain of the exposure.
    u_amplitude : (K,), standard uncertainty of the amplitude corrected for exposure, for white noise of unit variance
        per frame; over the amplitude it is that of the phase in rad.
    distance_hz : (K,), distance to the nearest other line, zero or the Nyquist frequency.
    neighbour_hz : (K,), frequency of that line, 0 for zero, inf for the Nyquist frequency.
    condition : condition number of the design matrix.
    aliased_harmonics : harmonics not fitted that alias within a bin of a fitted line.
    """

    lines: PlannedLines
    rate_hz: float
    frames: int
    alias_hz: FloatArray
    gain: FloatArray
    u_amplitude: FloatArray
    distance_hz: FloatArray
    neighbour_hz: FloatArray
    condition: float
    aliased_harmonics: tuple[AliasedHarmonic, ...]

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


def lines_of(fundamentals_hz: Sequence[float], harmonics: int) -> PlannedLines:
    """Return the lines of simultaneously excited fundamentals: each multiple up to `harmonics`, once.

    Parameters
    ----------
    fundamentals_hz
        Excited frequencies in Hz, above 0.
    harmonics
        Highest multiple.

    Returns
    -------
    The lines, fundamentals first.

    Raises
    ------
    ValueError
        A frequency is not above 0.

    Examples
    --------
    >>> from shaker import lines_of
    >>> lines_of([80.0, 160.0], harmonics=3).frequency_hz
    array([ 80., 160., 320., 240., 480.])
    """
    fundamentals = np.asarray(fundamentals_hz, dtype=np.float64)
    check_shape("fundamentals_hz", fundamentals, (None,))
    if not (len(fundamentals) and np.all(np.isfinite(fundamentals)) and np.all(fundamentals > 0.0)):
        raise ValueError(f"fundamentals_hz: expected frequencies above 0, found {fundamentals.tolist()}")
    multiple = np.repeat(np.arange(1, harmonics + 1, dtype=np.int64), len(fundamentals))
    fundamental = np.tile(fundamentals, harmonics)
    frequency = np.asarray(multiple * fundamental, dtype=np.float64)
    distinct: list[int] = []
    for k in range(len(frequency)):
        if all(abs(frequency[k] - frequency[i]) > _SAME * frequency[k] for i in distinct):
            distinct.append(k)
    return PlannedLines(frequency[distinct], fundamental[distinct], multiple[distinct])


def plan_at(lines: PlannedLines, rate_hz: float, sampling: Sampling) -> RatePlan:
    """Return aliases, neighbours, exposure loss and uncertainty of lines at a camera rate.

    Parameters
    ----------
    lines
        The lines of an excitation.
    rate_hz
        Camera rate in Hz.
    sampling
        Frames, exposure and noise.

    Returns
    -------
    The plan for this rate.

    Raises
    ------
    ValueError
        There are too few frames for the lines.

    Examples
    --------
    >>> from shaker import Sampling, lines_of, plan_at
    >>> plan = plan_at(lines_of([80.0], harmonics=2), rate_hz=21.3, sampling=Sampling(frames=500))
    >>> print(plan.alias_hz, f"{plan.distance_bins:.0f} bins apart")
    [ 5.2 10.4] 12 bins apart
    """
    frequency = lines.frequency_hz
    covariance, condition = amplitude_covariance(frequency, rate_hz, sampling.frames, sampling.corner_hz)
    gain, alias = exposure_gain(frequency, sampling.exposure_s), alias_frequency(frequency, rate_hz)
    alias_distance = np.abs(np.subtract.outer(alias, alias))
    np.fill_diagonal(alias_distance, np.inf)
    # A line near the Nyquist frequency meets its mirror image, which is twice as far.
    distance = np.column_stack([alias_distance, alias, rate_hz - 2.0 * alias])
    aliased: dict[float, AliasedHarmonic] = {}  # harmonics without a fit within a bin of a fitted line
    for line in frequency:
        for fold in find_aliased_harmonics(
            line, lines.fundamentals_hz.tolist(), rate_hz, rate_hz / sampling.frames, WATCHED
        ):
            if np.all(np.abs(frequency - fold.frequency_hz) > _SAME * fold.frequency_hz):
                aliased[fold.frequency_hz] = fold
    return RatePlan(
        lines=lines,
        rate_hz=rate_hz,
        frames=sampling.frames,
        alias_hz=alias,
        gain=gain,
        u_amplitude=rms_uncertainty(covariance) / np.maximum(np.abs(gain), np.finfo(np.float64).tiny),
        distance_hz=distance.min(axis=1),
        neighbour_hz=np.append(frequency, [0.0, np.inf])[distance.argmin(axis=1)],
        condition=condition,
        aliased_harmonics=tuple(aliased[f] for f in sorted(aliased)),
    )


# Which camera rates are good for a point, and which few serve all of them.

PREFERRED = (0.1, 0.4)
"""Share of the camera rate between which fundamentals are best seen: above 1/f noise, below the Nyquist frequency."""
_NEAR_BEST = 1.05  # uncertainties this close are equal, and the distance between lines decides
_CHOICES = 3  # rates proposed at most
_CHOICE_DISTANCE = 0.02  # of the range of rates: choices closer than this are one choice
_POINTS_PER_INTERVAL = 4  # rates tried within the narrowest interval in which two lines meet
_MAX_ENTRIES = 4_000_000  # points times rates stored at a time
_MAX_GRAM_ENTRIES = 1_000_000  # of Gram matrices formed at a time
_SEPARATED_BINS = 1.0  # between a fitted line and a harmonic that is not


@dataclass(frozen=True)
class RateScan(Arrays, shapes="rate_hz R; margin_bins R; penalty R; preferred R; separated R"):
    """Rates (R,) examined for one point.

    Attributes
    ----------
    rate_hz : (R,), the rates in Hz.
    margin_bins : (R,), smallest distance of two lines in bins, reduced by the tolerance.
    penalty : (R,), largest factor by which 1/f noise raises a line's uncertainty above that of white noise.
    preferred : (R,), number of fundamentals between 0.1 and 0.4 of the rate.
    separated : (R,), whether at a clear rate no harmonic that is not fitted lies within a bin of a line.
    """

    rate_hz: FloatArray
    margin_bins: FloatArray
    penalty: FloatArray
    preferred: IntArray
    separated: BoolArray

    @property
    def clear(self) -> BoolArray:
        """Whether every line is far enough from every other, (R,)."""
        return np.asarray(self.margin_bins >= CLEAR_BINS)

    @property
    def good(self) -> BoolArray:
        """Clear rates with most fundamentals in the preferred band, separated if any are."""
        good = self.clear
        if good.any():
            good &= self.preferred == self.preferred[good].max()
        return good & self.separated if np.any(good & self.separated) else good


def candidate_rates(
    points: Sequence[PlannedLines], sampling: Sampling, limits_hz: tuple[float, float], step_hz: float
) -> FloatArray:
    """Return the multiples of `step_hz` within the limits that are worth examining for all points.

    Two lines whose frequencies differ by F (modulo the rate) meet within a bin over a range of rates of
    rate²/(frames·F). Some rates within the narrowest such range are enough.
    """
    low, high = limits_hz
    if not 0.0 < low <= high:
        raise ValueError(f"limits_hz: expected a range of rates above 0, found {low} to {high}")
    if not 0.0 < step_hz <= high:
        raise ValueError(f"step_hz: expected a number between 0 and {high}, found {step_hz}")
    highest = 2.0 * max(float(lines.frequency_hz.max()) for lines in points)
    narrowest = low * high / (sampling.frames * highest)
    most = max(_MAX_ENTRIES // len(points), 1)
    stride = max(1, int(narrowest / _POINTS_PER_INTERVAL / step_hz), int(np.ceil((high - low) / step_hz / most)))
    first, last = int(np.ceil(low / step_hz - 1e-9)), int(np.floor(high / step_hz + 1e-9))
    rates = np.arange(last, first - 1, -stride, dtype=np.int64)[::-1] * step_hz
    if not len(rates):
        raise ValueError(f"limits_hz: expected a multiple of {step_hz} between {low} and {high}, found none")
    return np.asarray(np.round(rates, 9))


def scan_rates(lines: PlannedLines, rate_hz: FloatArray, sampling: Sampling) -> RateScan:
    """Evaluate every rate (R,) for the lines of one point by their aliases."""
    # The tolerance changes the distance of two lines: for one fundamental in proportion to their difference.
    first, second = np.triu_indices(len(lines.frequency_hz), k=1)
    one = lines.fundamental_hz[first] == lines.fundamental_hz[second]
    differences = differences_hz(lines.frequency_hz)
    slack = differences.copy()
    slack[len(differences) - len(one) :] = np.where(
        one, differences[len(differences) - len(one) :], differences[-2 * len(one) :][: len(one)]
    )
    margin = _margin_bins(differences, slack, rate_hz, sampling)
    separated = margin >= CLEAR_BINS  # the other rates are not good in any case
    watched = np.outer(np.arange(sampling.harmonics + 1, WATCHED + 1), lines.fundamentals_hz).ravel()
    sums = np.abs(np.concatenate([np.add.outer(watched, sign * lines.frequency_hz).ravel() for sign in (1, -1)]))
    sums = sums[sums > 1e-6 * lines.frequency_hz.max()]
    separated[separated] = _margin_bins(sums, np.zeros_like(sums), rate_hz[separated], sampling) >= _SEPARATED_BINS
    penalty = np.zeros(len(rate_hz))
    preferred = np.zeros(len(rate_hz), dtype=np.int64)
    for frequency, multiple in zip(lines.frequency_hz, lines.multiple, strict=True):
        turns = frequency / rate_hz
        share = np.abs(turns - np.round(turns))
        lowest = np.maximum(share, 0.5 / sampling.frames)
        penalty = np.maximum(penalty, np.sqrt(1.0 + sampling.corner_hz / (lowest * rate_hz)))
        preferred += (multiple == 1) & (share >= PREFERRED[0]) & (share <= PREFERRED[1])
    return RateScan(rate_hz, margin, penalty, preferred, separated)


def best_rates(scan: RateScan) -> tuple[float, ...]:
    """Return up to three rates, best first; empty where no rate separates the lines.

    The best is, among the good rates whose penalty is within 5 % of the smallest, the one with the largest margin. The
    next are the best of those that are not near a chosen one.
    """
    left = scan.good
    min_distance = _CHOICE_DISTANCE * float(scan.rate_hz[-1] - scan.rate_hz[0])
    chosen: list[float] = []
    while left.any() and len(chosen) < _CHOICES:
        rate = float(scan.rate_hz[_best_of(left, scan.penalty, scan.margin_bins)])
        chosen.append(rate)
        left = left & (np.abs(scan.rate_hz - rate) > min_distance)
    return tuple(chosen)


def fewest_rates(scans: Sequence[RateScan]) -> tuple[tuple[float, tuple[int, ...]], ...]:
    """Return few rates, found greedily, with the indices of the points that they serve."""
    good = np.array([scan.good for scan in scans])
    penalty = np.array([scan.penalty for scan in scans])
    margin = np.array([scan.margin_bins for scan in scans])
    waiting = good.any(axis=1)
    chosen: list[tuple[float, tuple[int, ...]]] = []
    while waiting.any():
        served = np.sum(good[waiting], axis=0)
        most = served == served.max()
        worst = np.max(np.where(good[waiting], penalty[waiting], 0.0), axis=0)
        closest = np.min(np.where(good[waiting], margin[waiting], np.inf), axis=0)
        best = _best_of(most, worst, closest)
        serves = waiting & good[:, best]
        chosen.append((float(scans[0].rate_hz[best]), tuple(np.flatnonzero(serves).tolist())))
        waiting = waiting & ~serves
    return tuple(chosen)


def condition_over_rate(lines: PlannedLines, rate_hz: FloatArray, frames: int) -> FloatArray:
    """Return the condition number of the design matrix at rates (R,), from Dirichlet's kernel.

    Cosines, sines and offset are unitarily equivalent to the exponentials at 0 and ±f. Their Gram matrix over frames
    counted from the middle is sin(πNδ)/(N·sin πδ) with their distances δ per frame.
    """
    check_shape("rate_hz", rate_hz, (None,))
    signed = np.concatenate([[0.0], lines.frequency_hz, -lines.frequency_hz])
    distance = np.subtract.outer(signed, signed)
    parts = np.array_split(rate_hz, max(1, len(rate_hz) * distance.size // _MAX_GRAM_ENTRIES))
    conditions = []
    for part in parts:
        turns = distance / part[:, None, None]
        below = np.sin(np.pi * turns)
        met = np.abs(below) < 1e-9  # where the kernel is ±1
        limit = np.cos(np.pi * frames * turns) * np.cos(np.pi * turns)
        gram = np.where(met, limit, np.sin(np.pi * frames * turns) / (frames * np.where(met, 1.0, below)))
        smallest, *_, largest = np.linalg.eigvalsh(gram).T
        singular = smallest <= largest * len(signed) * np.finfo(np.float64).eps
        conditions.append(np.where(singular, np.inf, np.sqrt(largest / np.where(singular, 1.0, smallest))))
    return np.concatenate(conditions)


def _best_of(allowed: BoolArray, penalty: FloatArray, margin: FloatArray) -> int:
    """Return the allowed rate of widest margin with nearly the smallest penalty."""
    near = allowed & (penalty <= _NEAR_BEST * penalty[allowed].min())
    return int(np.argmax(np.where(near, margin, -np.inf)))


def _margin_bins(difference: FloatArray, slack: FloatArray, rate_hz: FloatArray, sampling: Sampling) -> FloatArray:
    """Return the smallest distance of exponentials in bins, less the tolerance's share."""
    smallest = np.full(len(rate_hz), 0.5)
    # Each pair once: harmonics of one fundamental repeat them.
    for distance, loose in np.unique(np.round(np.column_stack([difference, slack]), 9), axis=0):
        change = loose * sampling.tolerance
        turns = distance / rate_hz
        np.minimum(smallest, np.abs(turns - np.round(turns)) - change / rate_hz, out=smallest)
    return np.asarray(smallest * sampling.frames)
