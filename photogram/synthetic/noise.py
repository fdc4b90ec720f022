"""The image sensor: shot noise, read noise, bit depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray


@dataclass(frozen=True)
class ImageSensor:
    """A camera's sensor: significant bits, electrons per grey level, read noise in grey levels."""

    bit_depth: int = 12
    electrons_per_grey: float = 8.0
    read_noise_grey: float = 6.0

    @property
    def full_scale(self) -> int:
        """The largest grey level."""
        return int(2**self.bit_depth - 1)

    def variance(self, grey: FloatArray) -> FloatArray:
        """Return the noise variance of grey levels: shot noise g/e, read noise, and 1/12 of rounding."""
        return np.asarray(np.maximum(grey, 0) / self.electrons_per_grey + self.read_noise_grey**2 + 1 / 12)

    def digitise(self, image: FloatArray, rng: np.random.Generator | None) -> NDArray[np.uint16]:
        """Return the stored image of fractions of full scale; `rng` None stores it without noise.

        Shot noise is taken as normal with the variance of the electron count, thousands of electrons per pixel.
        """
        grey = np.asarray(image) * self.full_scale
        if rng is not None:
            spread = np.sqrt(self.variance(grey) - 1 / 12)
            grey = grey + spread * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey), 0, self.full_scale).astype(np.uint16)
