"""The errors of one simulated campaign, drawn from what its manifests state."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from shaker._checks import FloatArray

MOUNTED = ("point", "direction", "transverse", "centre_of_mass")
"""Last parts of the names of errors that are made anew whenever something is mounted."""
RECORDED = ("noise", "trigger jitter", "points")
"""Last parts of the names of what no two recordings share."""


@dataclass(frozen=True)
class Draws:
    """Normal deviates by name: each name has its own stream of `seed`, so that none depends on what else is drawn.

    `systematic` False gives zeros. `values` remembers every error drawn, for the truth file.
    """

    seed: int
    systematic: bool
    values: dict[str, list[float]] = field(default_factory=dict)

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        return np.random.default_rng([self.seed, zlib.crc32(name.encode())])

    def normal(self, name: str, uncertainty: float | FloatArray, count: int | None = None) -> FloatArray:
        """Return errors (count,) or scalar-shaped () of the given standard uncertainty, and remember them."""
        deviate = self.stream(name).standard_normal(count)
        value = np.asarray(deviate * uncertainty if self.systematic else 0.0 * deviate * uncertainty)
        if np.any(np.asarray(uncertainty) > 0):
            self.values[name] = [float(v) for v in np.atleast_1d(value)]
        return value

    def covariant(self, name: str, covariance: FloatArray) -> FloatArray:
        """Return errors (P,) with a covariance (P, P), and remember them."""
        scale = np.sqrt(np.diagonal(covariance))
        lower = np.linalg.cholesky(covariance / np.outer(scale, scale))
        value = scale * (lower @ self.stream(name).standard_normal(len(scale))) * (1.0 if self.systematic else 0.0)
        self.values[name] = [float(v) for v in value]
        return np.asarray(value)


@dataclass(frozen=True)
class CampaignDraws(Draws):
    """The errors of one recording of a campaign: those of the rig are its other recordings' too.

    Where something was mounted (`MOUNTED`) differs from `mounting` to mounting, noise (`RECORDED`) from `recording` to
    recording. The sensor's own parts are never taken off.
    """

    mounting: str = ""
    recording: str = ""

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name, within its mounting or its recording."""
        last = name.rpartition(".")[2]
        if last in RECORDED:
            return super().stream(f"{name} [{self.recording}]")
        own = name.startswith("internal.")
        return super().stream(f"{name} [{self.mounting}]" if last in MOUNTED and not own else name)
