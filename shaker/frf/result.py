"""Input and result of transfer-function measurements, excited lines, and pooled noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shaker.frf.chain import ratio_unit
from shaker.signal_notices import NARROW_PEAKS
from shaker.sine.phasor import Phasors, real_stacked
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

# Input and result of the estimate of a transfer function.

Estimator = Literal["H1", "H2", "Hv", "periodic", "local", "rest"]


@dataclass(frozen=True)
class TransferRecord:
    """Samples of a reference and of C responses on one clock.

    Attributes
    ----------
    reference : (S,), samples at `start + i / sample_rate_hz`.
    responses : (S, C), at the same times.
    sample_rate_hz : sampling rate in Hz.
    reference_name, reference_unit : name and unit of the reference.
    channels, unit : C names and units of the responses.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from shaker import TransferRecord
    >>> force = np.random.default_rng(0).normal(size=4000)
    >>> motion = lfilter([0.02], [1.0, -1.8, 0.97], force)
    >>> record = TransferRecord(force, motion[:, None], 1000.0, "force", "N", ("z",), ("m",))
    >>> record
    TransferRecord(4000 samples at 1000 Hz: z [m] over force [N])
    """

    reference: FloatArray
    responses: FloatArray
    sample_rate_hz: float
    reference_name: str
    reference_unit: str
    channels: tuple[str, ...]
    unit: tuple[str, ...]

    def __post_init__(self) -> None:
        check_shape("reference", self.reference, (None,))
        check_shape("responses", self.responses, (len(self.reference), len(self.channels)))
        if not self.sample_rate_hz > 0.0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
        if len(self.unit) != len(self.channels):
            raise ValueError(f"unit: expected {len(self.channels)} units, one per response, found {len(self.unit)}")
        named = {self.reference_name: self.reference} | dict(zip(self.channels, self.responses.T, strict=True))
        if len(named) != 1 + len(self.channels):
            raise ValueError(f"channels: expected names that differ, found {self.reference_name}, {self.channels}")
        gaps = [name for name, samples in named.items() if not np.isfinite(samples).all()]
        if gaps:
            raise ValueError(f"responses: expected samples without gaps, found NaN in {', '.join(gaps)}")

    def __repr__(self) -> str:
        names = ", ".join(f"{c} [{u}]" for c, u in zip(self.channels, self.unit, strict=True))
        what = f"{names} over {self.reference_name} [{self.reference_unit}]"
        return f"TransferRecord({len(self.reference)} samples at {self.sample_rate_hz:g} Hz: {what})"

    @property
    def ratio_unit(self) -> tuple[str, ...]:
        """Units of response over reference, "1" where they are the same."""
        return tuple(ratio_unit(unit, self.reference_unit) for unit in self.unit)


@dataclass(frozen=True)
class TransferFunction(Arrays, shapes="coherence K C; averages K; line_correlation D; repeat_effects M K C"):
    """Responses over a reference at K lines, H = Y/X.

    Attributes
    ----------
    ratio : the C responses over the reference with covariance.
    coherence : (K, C), as estimated, too large by (1 - γ²)²/n (Bendat and Piersol, Random Data, 4th ed., eq. 9.76).
    estimator : name of the estimator.
    reference : name of the reference.
    averages : (K,), number of independent averages.
    line_spacing_hz : distance of the lines of the grid in Hz.
    line_correlation : (D,), correlation of the errors of lines 0, 1, 2 … grid lines apart, [1] where independent.
    notices : notices of the measurement.
    added_decay_per_s : decay a of an exponential window, so that `ratio` is H(s) at s = a + jω.
    repeat_effects : (M, K, C), relative effect of each repeat on the ratio beyond the noise, as a standard uncertainty
        common to all lines; None if the repeats differ by no more than their noise.
    """

    ratio: Phasors
    coherence: FloatArray
    estimator: Estimator
    reference: str
    averages: FloatArray
    line_spacing_hz: float
    line_correlation: ComplexArray
    notices: tuple[Notice, ...] = ()
    added_decay_per_s: float = 0.0
    repeat_effects: ComplexArray | None = None

    def __repr__(self) -> str:
        return f"TransferFunction({self.estimator} over {self.reference}: {self.ratio})"

    def at_lines(self, lines: NDArray[Any]) -> TransferFunction:
        """Return the lines chosen by a mask (K,) or by indices."""
        return replace(
            self,
            ratio=self.ratio.at_lines(lines),
            coherence=self.coherence[lines],
            averages=self.averages[lines],
            repeat_effects=None if self.repeat_effects is None else self.repeat_effects[:, lines],
        )

    def between(self, band_hz: tuple[float, float]) -> TransferFunction:
        """Return the lines inside a band."""
        frequency = self.ratio.frequency_hz
        return self.at_lines((frequency >= band_hz[0]) & (frequency <= band_hz[1]))

    def channel_covariance(self, channel: str) -> FloatArray:
        """Return the covariance (K, 2, 2) of [Re, Im] of one response."""
        return self.ratio.select([channel]).covariance


def circular_covariance(complex_covariance: ComplexArray) -> FloatArray:
    """Return the covariance (K, 2C, 2C) of circular noise with E[e eᴴ]."""
    return real_stacked(0.5 * complex_covariance)


# Which harmonics a periodic reference excites.

_SIGNAL = 10.0  # mean over its standard uncertainty from which a line is a signal
_STRONG = 0.1  # share of the largest line nearby from which a line is excited for sure
_NEARBY = 12  # lines on either side that are nearby
_WEAKEST = 1e-3  # share of the largest line of all below which a line is a distortion or a spur
_DENSE = 0.7  # share of strong lines from which every line of a band is excited (a chirp)


def excited_lines(reference: ComplexArray) -> BoolArray:
    """Return which lines (K,) a periodic reference with phasors (M, K) of M periods excites.

    An excited line exceeds ten times its standard uncertainty. Where only some lines are excited (multisine with
    unexcited lines that show distortions), it also exceeds a tenth of the largest line nearby.
    """
    from scipy.ndimage import maximum_filter1d, uniform_filter1d

    lines, mean = reference.shape[1], reference.mean(axis=0)
    magnitude = np.abs(mean)
    # The standard uncertainty of the mean over periods, of both quadratures together, from lines nearby. A level that
    # changes from period to period is no noise.
    level = np.sum(reference * mean.conj(), axis=1) / max(float(np.sum(magnitude**2)), np.finfo(np.float64).tiny)
    scatter = np.sum(np.abs(reference - level[:, None] * mean) ** 2, axis=0) / (len(reference) - 1)
    smooth = uniform_filter1d(scatter, size=min(2 * _NEARBY + 1, lines), mode="nearest")
    signal = magnitude > _SIGNAL * np.sqrt(np.maximum(smooth, scatter) / len(reference))
    nearby = maximum_filter1d(magnitude, size=min(2 * _NEARBY + 1, lines), mode="nearest")
    strong = signal & (magnitude > _STRONG * nearby) & (magnitude > _WEAKEST * magnitude.max(initial=0.0))
    if not strong.any():
        return np.asarray(strong)
    strong_index = np.flatnonzero(strong)
    inside = np.zeros(lines, dtype=np.bool_)
    inside[strong_index[0] : strong_index[-1] + 1] = True
    dense = np.count_nonzero(strong) > _DENSE * np.count_nonzero(inside)
    return np.asarray(inside & signal if dense else strong)


# Whether the lines of a transfer function resolve its resonances.

_MIN_WIDTH = 6.0  # lines between half-power points; below it a Hann window or local polynomials lower a peak
_PROMINENCE = 2.0  # factor by which a peak exceeds its surroundings
_REACH = 40  # lines on either side that are its surroundings
_CERTAIN = 0.1  # relative uncertainty of |H| from which a peak may be noise


def resolution_notices(
    frequency_hz: FloatArray, ratio: ComplexArray, u_ratio: FloatArray, name: str, cause: str
) -> list[Notice]:
    """Return a notice of peaks of |H| narrower than the line spacing allows."""
    from scipy.signal import find_peaks, peak_widths

    magnitude = np.abs(ratio)
    level = np.log(np.maximum(magnitude, np.finfo(np.float64).tiny))
    peaks = find_peaks(level, prominence=np.log(_PROMINENCE), wlen=2 * _REACH + 1)[0]
    peaks = peaks[u_ratio[peaks] < _CERTAIN * magnitude[peaks]]
    if not len(peaks):
        return []
    # Half power lies ln √2 below the peak of the logarithm.
    prominences = (np.full(len(peaks), 0.5 * np.log(2.0)), np.maximum(peaks - _REACH, 0), peaks + _REACH)
    bounds = (prominences[0], prominences[1], np.minimum(prominences[2], len(level) - 1))
    widths = peak_widths(level, peaks, rel_height=1.0, prominence_data=bounds)[0]
    narrow = widths < _MIN_WIDTH
    if not narrow.any():
        return []
    spacing = float(frequency_hz[1] - frequency_hz[0])
    listed = ", ".join(f"{frequency_hz[p]:.6g}" for p in peaks[narrow][:6])
    width = float(widths[narrow].min())
    needed = spacing * max(1.0, width) / (2.0 * _MIN_WIDTH)
    return [Notice(NARROW_PEAKS, name, frequencies=listed, width_lines=width, cause=cause, spacing_hz=needed)]


# Noise of neighbouring lines taken together.

_NEIGHBOURS = 8  # lines on either side that share one estimate of the noise
_BLOCK = 64  # lines over which the shares of the noise are steady
_SHAPE_STEPS = 60  # multiplicative steps of the noise shape; chosen
_OUTLIER_PROBABILITY = 1e-5  # probability below which a line counts as noisier than its neighbours


def pooled_scatter(scatter: ComplexArray, ratio: ComplexArray, dof: float) -> tuple[ComplexArray, FloatArray]:
    """Return the noise (K, C, C) averaged over neighbouring lines, and their number.

    Up to 17 lines are averaged. Across a resonance the noise of y - Hx is not level. The noise of the response is, but
    that of the reference, and of vibrations of the base, is multiplied by |H|². Every line's scatter is therefore
    divided by a shape A + B|H|², A, B ≥ 0 constant over 64 lines, averaged, and multiplied by the shape again. A line
    that is noisier than `dof` degrees of freedom allow (mains, a spur) keeps its noise and is excluded from the
    average. Where its scatter has too few degrees of freedom for the correlation of C responses, that of the neighbours
    is used, enlarged.
    """
    from scipy.ndimage import convolve1d

    level = np.einsum("kcc->kc", scatter).real
    shape = np.sqrt(np.sum(_shape(level, np.abs(ratio) ** 2), axis=0))
    product = shape[:, :, None] * shape[:, None, :]
    even = scatter / product
    alone = _outlying(level / shape**2, dof)
    counted = np.where(alone[:, None, None], 0.0, even)
    near = np.ones(2 * _NEIGHBOURS + 1)
    total = convolve1d(counted, near, axis=0, mode="constant")
    number = convolve1d((~alone).astype(np.float64), near, mode="constant")
    mean = np.asarray(total / np.maximum(number, 1.0)[:, None, None], dtype=np.complex128)
    single = even
    if dof < 2.0 * level.shape[1]:  # the neighbours' noise times the largest ratio of the line's noise to it
        around = np.einsum("kcc->kc", mean).real
        factor = np.max(level / shape**2 / np.maximum(around, np.finfo(np.float64).tiny), axis=1)
        single = np.where(np.any(around > 0.0, axis=1)[:, None, None], mean * factor[:, None, None], even)
    mean = np.where(alone[:, None, None], single, mean)
    return np.asarray(mean * product), np.where(alone, 1.0, number)


def share_of_reference(scatter: ComplexArray, ratio: ComplexArray) -> FloatArray:
    """Return the share (K, C) of the noise proportional to |H|², by `pooled_scatter`."""
    level, gain = np.einsum("kcc->kc", scatter).real, np.abs(ratio) ** 2
    flat, through = _shape(level, gain)
    return np.asarray(through / (flat + through))


def _shape(level: FloatArray, gain: FloatArray) -> FloatArray:
    """Return A and B·gain (2, K, C) by Whittle likelihood (Févotte et al. 2009)."""
    tiny = np.finfo(np.float64).tiny ** 0.25
    lines = len(level)
    size = min(_BLOCK, lines)
    blocks = max(1, lines // size)
    edges = np.linspace(0, lines, blocks + 1).astype(np.int64)[:-1]
    count = np.diff(np.append(edges, lines))
    basis = np.stack([np.ones_like(gain), gain], axis=-1)
    white = np.add.reduceat(level, edges, axis=0) / count[:, None] + tiny
    steady = np.add.reduceat(basis, edges, axis=0) / count[:, None, None] + tiny
    coefficients = 0.5 * white[:, :, None] / steady
    for _ in range(_SHAPE_STEPS):
        model = np.sum(basis * np.repeat(coefficients, count, axis=0), axis=-1)
        up = np.add.reduceat(basis * (level / model**2)[:, :, None], edges, axis=0)
        down = np.add.reduceat(basis / model[:, :, None], edges, axis=0)
        coefficients = coefficients * np.sqrt(up / down) + tiny**2
    return np.asarray(np.moveaxis(basis * np.repeat(coefficients, count, axis=0), -1, 0) + 0.5 * tiny)


def _outlying(level: FloatArray, dof: float) -> BoolArray:
    """Return which lines are noisier, in any channel, than common noise allows."""
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    around = median_filter(level, size=(min(2 * _NEIGHBOURS + 1, len(level)), 1), mode="nearest")
    return np.asarray(np.any(level > chdtri(dof, _OUTLIER_PROBABILITY) / chdtri(dof, 0.5) * around, axis=1))
