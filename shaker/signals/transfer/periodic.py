"""Transfer functions from periodic excitation: errors-in-variables estimate, covariance over periods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import Phasors
from shaker.signals.transfer.excited import excited_lines
from shaker.signals.transfer.period_notices import period_notices
from shaker.signals.transfer.periods import find_period, period_phasors
from shaker.signals.transfer.pooling import pooled_scatter
from shaker.signals.transfer.result import TransferFunction, TransferRecord, circular_covariance

_HIGHEST = 0.45  # share of the sampling rate up to which lines are taken where no band is named


def transfer_periodic(
    record: TransferRecord,
    period_s: float,
    *,
    settle_periods: int = 0,
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H = Ȳ/X̄ at the excited harmonics of a periodic excitation (chirp, multisine) from its whole periods.

    The maximum-likelihood estimate with noise on reference and responses (Pintelon and Schoukens, System
    Identification, 2nd ed., section 2.7.2): phasors are averaged over the M periods after the first `settle_periods`,
    then divided. The period is refined on the reference, so that an excitation clock beside the DAQ's leaks nothing.
    The covariance follows from the scatter of Y_m - H·X_m over the periods (M ≥ 2), pooled over up to 17
    neighbouring lines; `dof` is 2(M-1) times the lines pooled.
    """
    rate = record.sample_rate_hz
    if settle_periods < 0 or not period_s * rate >= 16.0:
        raise ValueError(
            f"period_s: expected a period of 16 samples or more and settle_periods 0 or more, found {period_s} s "
            f"at {rate} Hz and {settle_periods}"
        )
    period = find_period(record.reference, period_s * rate, settle_periods)
    if period.count < 2:
        raise ValueError(
            f"period_s: expected at least 2 whole periods after {settle_periods} to settle, found {period.count} in "
            f"{len(record.reference) / rate:.6g} s"
        )
    share = (0.0, _HIGHEST) if band_hz is None else (max(0.0, band_hz[0] / rate), min(0.5, band_hz[1] / rate))
    together = np.column_stack([record.reference, record.responses])
    lines = period_phasors(together, period, share)
    excited = excited_lines(lines.value[:, :, 0])
    if not excited.any():
        raise ValueError(
            f"record: expected a reference that excites lines, found only noise in {record.reference_name}"
        )
    estimate = _estimate(lines.value[:, excited])
    frequency = np.asarray(lines.harmonic * (rate / period.samples), dtype=np.float64)
    notices = period_notices(record, period, lines, excited, estimate.ratio)
    kept = int(np.count_nonzero(excited))
    return TransferFunction(
        ratio=Phasors(
            frequency[excited], estimate.ratio, estimate.covariance, record.channels, record.ratio_unit, estimate.dof
        ),
        coherence=estimate.coherence,
        estimator="periodic",
        reference=record.reference_name,
        averages=np.full(kept, float(period.count)),
        line_spacing_hz=rate / period.samples,
        line_correlation=np.ones(1, dtype=np.complex128),
        notices=notices,
    )


@dataclass(frozen=True)
class _Estimate:
    """Ratio (K, C), covariance (K, 2C, 2C), dof (K,), coherence over periods (K, C)."""

    ratio: ComplexArray
    covariance: FloatArray
    dof: FloatArray
    coherence: FloatArray


def _estimate(value: ComplexArray) -> _Estimate:
    """Return the ratio of the means over periods of phasors (M, K, 1 + C), reference first."""
    count = len(value)
    reference, responses = value[:, :, 0], value[:, :, 1:]
    mean = reference.mean(axis=0)
    ratio = responses.mean(axis=0) / mean[:, None]
    error = responses - ratio * reference[:, :, None]
    scatter = np.einsum("mkc,mkd->kcd", error, error.conj()) / (count - 1)
    pooled, lines = pooled_scatter(scatter, ratio, 2.0 * (count - 1))
    covariance = circular_covariance(pooled / (count * np.abs(mean[:, None, None]) ** 2))
    cross = np.abs(np.sum(responses * reference.conj()[:, :, None], axis=0)) ** 2
    power = np.sum(np.abs(reference) ** 2, axis=0)[:, None] * np.sum(np.abs(responses) ** 2, axis=0)
    coherence = np.divide(cross, power, out=np.ones_like(power), where=power > 0.0)
    return _Estimate(ratio, covariance, 2.0 * (count - 1) * lines, np.minimum(coherence, 1.0))
