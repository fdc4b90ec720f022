"""Draws of unknowns by their names, the same whatever else is drawn and in whatever order."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray


@dataclass(frozen=True)
class Deviates:
    """`count` draws of every unknown, block `block` of the stream of `seed`: equal names are the same unknown."""

    seed: int
    block: int
    count: int

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        return np.random.default_rng([self.seed, self.block, zlib.crc32(name.encode())])

    def normal(self, name: str, *shape: int) -> FloatArray:
        """Return standard normal deviates (N, ...)."""
        return self.stream(name).standard_normal((self.count, *shape))

    def angle(self, name: str) -> FloatArray:
        """Return angles (N,) of which nothing is known."""
        return self.stream(name).uniform(0.0, 2.0 * np.pi, self.count)

    def noise(self, name: str, covariance: FloatArray, dof: FloatArray) -> FloatArray:
        """Return deviates (N, K, M) of covariances (K, M, M) known with `dof` (K,) degrees of freedom.

        A multivariate t-distribution, scaled and shifted, is what M values with an estimated covariance leave
        (JCGM 102, 5.3.2); for infinite degrees of freedom a normal one. What is not known (NaN) is zero.
        """
        values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        drawn = np.einsum("kij,nkj->nki", root, self.normal(name, *covariance.shape[:2]))
        finite = np.isfinite(dof)
        freedom = np.where(finite, np.maximum(np.nan_to_num(dof, posinf=1.0), 1.0), 1.0)
        square = self.stream(f"{name}, squares").chisquare(freedom, (self.count, len(dof)))
        return np.asarray(drawn * np.where(finite, np.sqrt(freedom / square), 1.0)[:, :, None])
