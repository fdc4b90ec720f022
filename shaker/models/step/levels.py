"""Levels before and after a release, and whether the record holds all of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_OUTSIDE = 12.0  # resolutions that the record falls off beside a cut peak; the top of a wave falls off by 9 at most
_NOISE = 6.0
_RUN = 3


@dataclass(frozen=True)
class Level:
    """A level with standard uncertainty, the standard deviation of the samples about it (and about what rings), and
    how much it drifts over the samples, over the standard uncertainty of that (`drift`)."""

    value: float
    u: float
    noise: float
    drift: float
    drift_over_u: float


def rest_level(samples: FloatArray, resolution: float) -> Level:
    """Return the mean of samples (N,) at rest; the uncertainty holds their correlation and the last digit."""
    return ringing_level(samples, np.zeros(0, dtype=np.complex128), resolution)


def ringing_level(samples: FloatArray, poles: ComplexArray, resolution: float) -> Level:
    """Return the level about which samples (N,) ring, by least squares with decays of upper poles (M,) per sample."""
    count = len(samples)
    place = np.arange(count, dtype=np.float64)
    decays = np.exp(np.outer(place, poles))
    middle = (place - place.mean()) / count
    columns = np.concatenate([np.ones((count, 1)), decays.real, decays.imag], axis=1)
    value, u, residual = _fitted(columns, samples, 0)
    drift, u_drift, _ = _fitted(np.concatenate([columns, middle[:, None]], axis=1), samples, columns.shape[1])
    least = resolution / np.sqrt(12.0)
    noise = float(np.sqrt(residual @ residual / max(count - columns.shape[1], 1)))
    digit = least if noise < least else 0.0  # without noise the last digit is the same in all samples
    return Level(value, float(np.hypot(u, digit)), max(noise, least), drift, drift / max(u_drift, digit, 1e-300))


def _fitted(columns: FloatArray, samples: FloatArray, wanted: int) -> tuple[float, float, FloatArray]:
    """Return one coefficient with standard uncertainty, and the residual (N,)."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    inverse = np.linalg.pinv((columns / size).T @ (columns / size), rcond=1e-12, hermitian=True)
    linear = inverse @ ((columns / size).T @ samples)
    residual = samples - (columns / size) @ linear
    variance = float(residual @ residual) / max(len(samples) - columns.shape[1], 1) * correlation_factor(residual)
    return (
        float(linear[wanted] / size[wanted]),
        float(np.sqrt(variance * inverse[wanted, wanted]) / size[wanted]),
        residual,
    )


def correlation_factor(residual: FloatArray) -> float:
    """Return by how much correlation enlarges the variance of a mean over that of white noise, at least 1.

    1 + 2Σρ over lags until a pair of neighbouring ones no longer sums to more than its scatter (Geyer, Stat. Sci. 7,
    1992).
    """
    count = len(residual)
    centred = residual - residual.mean()
    power = float(centred @ centred)
    total, lag = 0.0, 1
    while power > 0.0 and lag + 1 < count // 2:
        pair = float(centred[:-lag] @ centred[lag:] + centred[: -lag - 1] @ centred[lag + 1 :]) / power
        if pair < 2.0 * np.sqrt(2.0 / count):
            break
        total, lag = total + pair, lag + 2
    return max(1.0, 1.0 + 2.0 * total)


def clipped(samples: FloatArray, resolution: float, noise: float) -> bool:
    """Tell whether the largest or smallest value of samples (N,) is a limit that cuts the record.

    A run of equal samples at the top of a wave of resolution q falls off by 9q at most within its own length on either
    side; a cut one falls off by more.
    """
    return any(_cut(sign * samples, resolution, noise) for sign in (1.0, -1.0))


def _cut(samples: FloatArray, resolution: float, noise: float) -> bool:
    """Tell whether the largest value cuts the record."""
    top = np.concatenate([[False], samples >= samples.max() - 0.25 * resolution, [False]])
    edges = np.flatnonzero(np.diff(top.astype(np.int8)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        length = int(end - start)
        if length < _RUN or start - length < 0 or end + length > len(samples):
            continue
        beside = samples.max() - max(samples[start - length], samples[end + length - 1])
        if beside > _OUTSIDE * resolution + _NOISE * noise:
            return True
    return False
