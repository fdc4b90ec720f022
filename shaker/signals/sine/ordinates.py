"""The noise around lines from the residual of a long uniform record, without ever holding it."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray
from shaker.signals.sine.times import Timeline

_ORDERS = 4  # powers of time per block: 30 bins off in 2048 blocks, they leave 2·10⁻⁷ of an ordinate


@dataclass(frozen=True)
class Demodulator:
    """Discrete Fourier transform of a record at chosen bins only, (K, M) in K groups of neighbours.

    In each block the record is turned down by the bin in the middle of a group and multiplied by the powers of time of
    a Taylor series; what remains of the exponential is smooth over a block, so these moments yield all the bins of the
    group, without the droop and the aliases of a decimation.
    """

    timeline: Timeline
    bins: IntArray

    @property
    def centre(self) -> IntArray:
        """Bin (K,) to which each group is turned down."""
        return np.asarray((self.bins.min(axis=1) + self.bins.max(axis=1)) // 2)

    def columns(self) -> FloatArray:
        """Return the columns (L, 2·K·4) of a full block: cosine and sine, times powers of time from -1 to 1."""
        length = int(self.timeline.edges[1])
        place = np.arange(length) - length // 2
        angle = 2.0 * np.pi * np.mod(np.multiply.outer(place, self.centre) / self.timeline.samples, 1.0)
        turn = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        powers = (place / self._half)[:, None] ** np.arange(_ORDERS)
        return np.asfortranarray((turn[..., None] * powers[:, None, None, :]).reshape(length, -1))

    def transform(self, moments: FloatArray) -> ComplexArray:
        """Return the transform (K, M, C) from the blocks' sums (B, 2·K·4, C) of columns times samples."""
        blocks, _, channels = moments.shape
        groups, samples = self.bins.shape[0], self.timeline.samples
        parts = moments.reshape(blocks, 2, groups, _ORDERS, channels)
        together = parts[:, 0] + 1j * parts[:, 1]
        centre = self.timeline.edges[:-1] + int(self.timeline.edges[1]) // 2
        scale = np.array([(-1j) ** m / factorial(m) for m in range(_ORDERS)])
        found = np.empty((*self.bins.shape, channels), dtype=np.complex128)
        for k, bins in enumerate(self.bins):
            # j·n mod N in whole numbers: the phases of the blocks are exact.
            angle = 2.0 * np.pi * (np.multiply.outer(bins, centre) % samples) / samples
            change = 2.0 * np.pi * (bins - self.centre[k]) * self._half / samples
            series = scale * change[:, None] ** np.arange(_ORDERS)
            kernel = np.exp(-1j * angle)[:, :, None] * series[:, None, :]
            found[k] = kernel.reshape(len(bins), -1) @ together[:, k].reshape(-1, channels)
        return found

    @property
    def _half(self) -> float:
        """Half the length of a block in samples."""
        return int(self.timeline.edges[1]) / 2.0
