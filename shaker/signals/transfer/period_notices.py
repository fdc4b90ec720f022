"""What periods tell beyond the transfer function: a structure not settled, a drift, distortions."""

from __future__ import annotations

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.notice import Notice
from shaker.signals.transfer.periods import Period, Periods
from shaker.signals.transfer.result import TransferRecord

_BLOCK = 8  # lines that are tested together
_UNLIKELY = 1e-4  # probability, over all blocks of a record, below which periods differ
_GAIN = 1e-3  # change of the reference's amplitude between periods that is told
_CLOCK = 1e-7  # relative difference of the excitation's clock that is told
_DISTORTION = 3.0  # mean of an unexcited line over its uncertainty, rms, from which it is a distortion


def period_notices(
    record: TransferRecord, period: Period, lines: Periods, excited: BoolArray, ratio: ComplexArray
) -> tuple[Notice, ...]:
    """Return the notices on the periods of a record; `lines.value` (M, K, 1 + C), `ratio` (E, C) at excited lines."""
    rate = record.sample_rate_hz
    frequency = np.asarray(lines.harmonic * (rate / period.samples), dtype=np.float64)
    value = lines.value[:, excited]
    found = [_choice(record, period, int(np.count_nonzero(excited)))]
    found += _reference_drift(value[:, :, 0], record.reference_name)
    for c, name in enumerate(record.channels):
        error = value[:, :, 1 + c] - ratio[:, c] * value[:, :, 0]
        found += _unsettled(error, value[:, :, 1 + c], frequency[excited], name)
        found += _distortions(lines, excited, ratio[:, c], 1 + c, name)
    return tuple(found)


def _choice(record: TransferRecord, period: Period, lines: int) -> Notice:
    """Say which estimator was taken and why."""
    seconds = period.samples / record.sample_rate_hz
    text = (
        f"periodic excitation, {period.count} periods of {seconds:.9g} s (u {period.u_samples / period.samples:.1e}), "
        f"{lines} lines: ratio of the means over periods, leaks nothing, not biased by noise on either channel"
    )
    return Notice("info", text, record.reference_name)


def _reference_drift(reference: ComplexArray, name: str) -> list[Notice]:
    """Tell a reference whose amplitude changes from period to period; the ratio does not suffer."""
    mean = reference.mean(axis=0)
    power = np.sum(np.abs(mean) ** 2)
    gain = np.sum(reference * mean.conj(), axis=1) / power
    scatter = np.sum(np.abs(reference - gain[:, None] * mean) ** 2 * np.abs(mean) ** 2) / max(1, len(reference) - 1)
    u_gain = np.sqrt(0.5 * scatter) / power
    span = float(np.ptp(gain.real))
    if span < max(_GAIN, 6.0 * float(u_gain)):
        return []
    text = f"the excitation's amplitude changes by {100.0 * span:.2g} % between periods; the ratio does not suffer"
    return [Notice("info", text, name)]


def _unsettled(error: ComplexArray, response: ComplexArray, frequency: FloatArray, name: str) -> list[Notice]:
    """Tell a first period that differs from the others, and a response that drifts over the periods."""
    count = len(error)
    if count < 3:
        return []
    first = np.full(count, -1.0 / (count - 1))
    first[0] = 1.0
    found = _differs(error, first, frequency)
    if found.any():
        size = np.abs(error[0] - error[1:].mean(axis=0))[found].max() / np.abs(response.mean(axis=0))[found].max()
        text = (
            f"the first kept period differs from the others between {frequency[found].min():.6g} and "
            f"{frequency[found].max():.6g} Hz, by up to {100.0 * size:.2g} % of the response: the structure had not "
            "settled; leave out one period more (settle_periods)"
        )
        return [Notice("warning", text, name)]
    trend = _differs(error, np.arange(0.0, count) - 0.5 * (count - 1), frequency)
    if trend.any():
        text = (
            f"response over reference drifts over the periods between {frequency[trend].min():.6g} and "
            f"{frequency[trend].max():.6g} Hz: what is given is the mean"
        )
        return [Notice("warning", text, name)]
    return []


def _differs(error: ComplexArray, contrast: FloatArray, frequency: FloatArray) -> BoolArray:
    """Tell the lines (K,) in whose blocks a contrast over periods exceeds what is left: F of 2n and 2n(M-2)."""
    from scipy.special import fdtrc

    unit = contrast / np.sqrt(contrast @ contrast)
    along = np.einsum("m,mk->k", unit, error)
    power = np.abs(along) ** 2
    rest = np.sum(np.abs(error - error.mean(axis=0)) ** 2, axis=0) - power
    blocks = np.arange(0, len(frequency), _BLOCK)
    size = np.diff(np.append(blocks, len(frequency)))
    others = len(error) - 2
    tiny = np.finfo(np.float64).tiny
    quotient = np.add.reduceat(power, blocks) / np.maximum(np.add.reduceat(rest, blocks) / others, tiny)
    probability = fdtrc(2.0 * size, 2.0 * size * others, quotient)
    return np.repeat(np.asarray(probability < _UNLIKELY / len(blocks)), size)


def _distortions(lines: Periods, excited: BoolArray, ratio: ComplexArray, channel: int, name: str) -> list[Notice]:
    """Tell what stands on even and odd unexcited lines inside the band, where a multisine leaves such lines."""
    place = np.flatnonzero(excited)
    silent = ~excited
    silent[: place[0]] = silent[place[-1] :] = False
    if np.count_nonzero(silent) < 0.1 * len(place):
        return []
    through = np.interp(lines.harmonic, lines.harmonic[place], ratio.real) + 1j * np.interp(
        lines.harmonic, lines.harmonic[place], ratio.imag
    )
    # What the distorted reference itself drives through the structure is no distortion of the response.
    own = lines.value[:, :, channel] - through * lines.value[:, :, 0]
    level = np.sqrt(np.mean(np.abs(lines.value[:, excited, channel].mean(axis=0)) ** 2))
    told = []
    for word, remainder in (("even", 0), ("odd", 1)):
        chosen = silent & (lines.harmonic % 2 == remainder)
        if not chosen.any():
            continue
        mean = np.mean(np.abs(own[:, chosen].mean(axis=0)) ** 2)
        noise = np.mean(np.var(own[:, chosen], axis=0, ddof=1)) / len(own)
        if mean > _DISTORTION**2 * noise:
            told.append(f"{20.0 * np.log10(np.sqrt(mean - noise) / level):.0f} dB at {word} lines")
    if not told:
        return []
    text = f"non-linear distortions: {' and '.join(told)} that are not excited, relative to the excited ones"
    return [Notice("warning", text, name)]
