"""An analytic speckle texture: the truth that no interpolation has touched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest


@dataclass(frozen=True)
class Texture:
    """Sum of plane waves, a Gaussian random field of unit variance with the autocorrelation exp(−l²/4s²)."""

    wave: np.ndarray
    phase: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values at points (..., 2)."""
        angle = points @ self.wave.T + self.phase
        return np.sqrt(2.0 / len(self.phase)) * np.cos(angle).sum(axis=-1)

    def image(
        self, size: tuple[int, int], source: Callable[[np.ndarray], np.ndarray] = lambda points: points
    ) -> np.ndarray:
        """Image (H,W) whose pixel at p shows the texture at source(p)."""
        width, height = size
        x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        return np.stack([self(source(np.column_stack([row_x, row_y]))) for row_x, row_y in zip(x, y, strict=True)])


@pytest.fixture(scope="session")
def make_texture() -> Callable[..., Texture]:
    """Texture with Gaussian speckle of radius s; the speckle size (half width of the autocorrelation) is 3.33 s."""

    def make(seed: int = 0, s: float = 1.5, waves: int = 120) -> Texture:
        rng = np.random.default_rng(seed)
        return Texture(rng.normal(size=(waves, 2)) / (np.sqrt(2.0) * s), rng.uniform(0, 2 * np.pi, waves))

    return make
