"""Linear fits to a series of readings with white noise and a random walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import FloatArray

MIN_WALK_READINGS = 12  # from which a random walk is looked at
WALK_GAIN = 5.41
"""Twice the gain in log likelihood of a random walk: 1 % of series without any exceed it (Self and Liang 1987)."""
WALK_GAIN_OF_SEVERAL = 1.0  # that of a channel where all channels together exceed the limit
WALKS = np.geomspace(1e-2, 4.0, 20)
"""Variance of a step of a random walk over that of the noise: larger ones leave the noise undetermined."""
LEAST_NOISE = 1e-3  # share of the variance of rounding that noise may have next to a random walk


def walk_covariance(time: FloatArray) -> FloatArray:
    """Return the covariance (N, N) of a random walk over times (N,), from its mean.

    Its variance at the end of the series is 1 more than at the start.
    """
    share = (time - time.min()) / np.ptp(time)
    walk = np.minimum(share[:, None], share)
    return np.asarray(walk - walk.mean(axis=0) - walk.mean(axis=1, keepdims=True) + walk.mean())


def find_walks(design: FloatArray, reading: FloatArray, covariance: FloatArray, floor: FloatArray) -> FloatArray:
    """Return the variance (C,) of a random walk over that of the noise.

    It maximises the restricted likelihood; 0 where it is not significant. `floor` (C,): least variance of a reading.
    """
    count = len(reading)
    if count < max(MIN_WALK_READINGS, design.shape[1] + 2):
        return np.zeros(reading.shape[1])
    outside = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    size, axes = np.linalg.eigh(outside.T @ covariance @ outside)
    squares, least = (axes.T @ outside.T @ reading) ** 2, len(size) * floor
    scaled = 1.0 + count * WALKS[:, None] * size
    base = np.maximum(squares.sum(axis=0), least)
    left = np.maximum((1.0 / scaled) @ squares, LEAST_NOISE * least)
    ratio = np.divide(left, base, out=np.ones_like(left), where=base > 0.0)
    gains = -np.sum(np.log(scaled), axis=1)[:, None] * (base > 0.0) - len(size) * np.log(ratio)
    together = WALK_GAIN if gains.sum(axis=1).max() < WALK_GAIN else WALK_GAIN_OF_SEVERAL
    best = np.argmax(gains, axis=0)
    return np.where(gains.max(axis=0) > together, count * WALKS[best], 0.0)


@dataclass(frozen=True)
class DriftingFit:
    """Coefficients (P, C) of a design (N, P) fitted to readings (N, C).

    `walk` (C,): variance of a random walk over that of the noise. `roots`: of the covariance (N, N) of each channel
    over the noise. `estimator`, `spread` (C, P, N): coefficient per reading, and per unit of white noise. `whitened`
    (N, C): residuals of unit covariance times the noise.
    """

    design: FloatArray
    walk: FloatArray
    roots: tuple[FloatArray, ...]
    estimator: FloatArray
    spread: FloatArray
    coefficient: FloatArray
    whitened: FloatArray

    @classmethod
    def of(cls, design: FloatArray, reading: FloatArray, walk: FloatArray, covariance: FloatArray) -> DriftingFit:
        """Return the generalised least-squares fit; `covariance` (N, N): of a random walk of variance 1."""
        from scipy.linalg import solve_triangular

        by_walk = dict[float, tuple[FloatArray, FloatArray]]()
        for each in set(walk.tolist()):
            root = np.linalg.cholesky(np.eye(len(reading)) + each * covariance) if each else np.eye(len(reading))
            white = solve_triangular(root, design, lower=True)
            estimator = np.linalg.solve(white.T @ white, solve_triangular(root, white, lower=True, trans="T").T)
            by_walk[each] = (root, estimator)
        roots, estimators = zip(*(by_walk[each] for each in walk.tolist()), strict=True)
        estimator, spread = np.stack(estimators), np.stack([e @ r for r, e in zip(roots, estimators, strict=True)])
        coefficient = np.stack([e @ y for e, y in zip(estimators, reading.T, strict=True)], axis=1)
        fit = cls(design, walk, roots, estimator, spread, coefficient, reading)
        return cls(design, walk, roots, estimator, spread, coefficient, fit.white(reading - design @ coefficient))

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise."""
        return float(len(self.design) - self.design.shape[1])

    @property
    def noise(self) -> FloatArray:
        """Covariance (C, C) of the noise of a reading."""
        return np.asarray(self.whitened.T @ self.whitened / self.dof)

    def white(self, columns: FloatArray) -> FloatArray:
        """Return columns (N, C), one per channel, whitened."""
        from scipy.linalg import solve_triangular

        return np.stack(
            [solve_triangular(r, y, lower=True) for r, y in zip(self.roots, columns.T, strict=True)], axis=1
        )

    def left(self, columns: FloatArray) -> FloatArray:
        """Return columns (N, C), one per channel, less their fit, whitened."""
        fitted = [self.design @ (e @ y) for e, y in zip(self.estimator, columns.T, strict=True)]
        return self.white(columns - np.stack(fitted, axis=1))

    def criterion(self, floor: FloatArray) -> float:
        """Return the Bayesian information criterion (Schwarz 1978); `floor` (C,): least variance of a reading."""
        count, channels = self.whitened.shape
        variance = np.maximum(np.mean(self.whitened**2, axis=0), np.where(self.walk > 0.0, LEAST_NOISE, 1.0) * floor)
        likelihood = count * float(np.sum(np.log(np.maximum(variance, np.finfo(np.float64).tiny))))
        likelihood += 2.0 * sum(float(np.sum(np.log(np.diag(root)))) for root in self.roots)
        parameters = self.design.shape[1] * channels + int(np.sum(self.walk > 0.0))
        return float(likelihood + parameters * np.log(count))


def coefficient_covariance(spread: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance (P·C, P·C) of coefficients by their spread and noise.

    `spread` (C, P, N), `noise` (C, C).
    """
    channels, terms, _ = spread.shape
    products = np.einsum("ctn,dun->tcud", spread, spread) * noise[None, :, None, :]
    return np.asarray(products.reshape(terms * channels, terms * channels))
