"""What a fit leaves: its sums, its covariance between channels, and its density around each line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray
from shaker.signals.folding import alias_frequency, sampling_grid
from shaker.signals.noise import LineNoise, line_noise, neighbour_bins, noise_of_ordinates
from shaker.signals.sine.normal import Columns, Samples, residuals
from shaker.signals.sine.ordinates import Demodulator
from shaker.signals.sine.times import LONG

_DEPENDENT = 1e-12  # smallest eigenvalue of a correlation matrix that counts, for channels that depend on others


@dataclass(frozen=True)
class Remainder:
    """Sums over the residual of a fit, each weighted.

    `right` (P, C): columns times residual; `power` (C, C): residual times residual; `held` (S, C) the residual itself
    of a short record, `transform` (K + 1, M, C) its Fourier transform at `bins` (K + 1, M) near the lines and near zero
    of a long one.
    """

    right: FloatArray
    power: FloatArray
    held: FloatArray | None
    transform: ComplexArray | None
    bins: IntArray | None


def remainder(samples: Samples, columns: Columns, coefficients: FloatArray) -> Remainder:
    """Gather what a fit leaves in one pass over its samples."""
    timeline, channels = samples.timeline, samples.values.shape[1]
    turned = columns.turned(timeline)
    long = timeline.grid is not None and timeline.samples > LONG
    bins = neighbour_bins(timeline.samples, line_bins(columns, timeline.samples, rate_hz(samples))) if long else None
    demodulator = None if bins is None else Demodulator(timeline, bins)
    down = np.empty((0, 0)) if demodulator is None else demodulator.columns()
    moments = np.empty((len(turned), down.shape[1], channels))
    held = None if long else np.empty(samples.values.shape)
    local_right = np.empty((len(turned), turned.shape[1], channels))
    power = np.zeros((channels, channels))
    for chunk, basis, residual in residuals(samples, columns, coefficients):
        blocks = slice(chunk.first, chunk.last)
        single = residual.reshape(-1, channels)
        power += single.T @ single
        local_right[blocks] = chunk.by_block(basis.T @ chunk.weighted(residual, 1))
        if demodulator is not None:
            moments[blocks] = chunk.by_block(down[: len(residual)].T @ residual)
        if held is not None:
            held[timeline.edges[chunk.first] : timeline.edges[chunk.last]] = chunk.in_order(residual)
    right = np.asarray(np.sum(turned.swapaxes(1, 2) @ local_right, axis=0))
    transform = None if demodulator is None else demodulator.transform(moments)
    return Remainder(right, power, held, transform, bins)


def noise_at_lines(
    samples: Samples, columns: Columns, left: Remainder, whitening: FloatArray, time_s: FloatArray | None
) -> LineNoise | None:
    """Return the noise of the whitened series at each line and, last, at the lowest bin for the offset.

    `time_s`: the times of a record whose residual is held. None where times lie on no grid or are too few.
    """
    if left.transform is not None and left.bins is not None:
        ordinates = left.transform @ whitening.T / np.sqrt(samples.count)
        line_bin = line_bins(columns, samples.timeline.samples, rate_hz(samples))
        return noise_of_ordinates(ordinates, left.bins.astype(np.float64), line_bin, samples.timeline.samples)
    if left.held is None or time_s is None:
        return None
    kept = samples.kept()
    grid = sampling_grid(time_s[kept])
    if grid is None:
        return None
    whitened = np.asarray(left.held[kept] @ whitening.T)
    return line_noise(grid.filled(whitened), len(whitened), line_bins(columns, grid.length, grid.rate_hz))


def rate_hz(samples: Samples) -> float:
    """Return the sampling rate of a uniform record."""
    grid = samples.timeline.grid
    return 0.0 if grid is None else 1.0 / float(grid.interval_s)


def line_bins(columns: Columns, length: int, rate: float) -> FloatArray:
    """Return the places of all lines in bins of a record, and half a bin for the offset."""
    return np.append(alias_frequency(columns.tones.frequency_hz, rate) * length / rate, 0.5)


def factor_of(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F (C, C) with F·Fᵀ = covariance, and F⁻¹, zero for channels without noise.

    F = D·√R with the symmetric root of the correlation matrix: of all roots the one that mixes the channels least, and
    the same in whatever order they stand.
    """
    sigma = np.sqrt(covariance.diagonal())
    inverse_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    correlation = covariance * np.multiply.outer(inverse_sigma, inverse_sigma)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    root = np.sqrt(np.maximum(eigenvalues, _DEPENDENT))
    factor = sigma[:, None] * ((vectors * root) @ vectors.T)
    inverse = ((vectors / root) @ vectors.T) * inverse_sigma
    return np.asarray(factor), np.asarray(inverse)
