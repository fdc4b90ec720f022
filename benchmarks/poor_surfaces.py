"""Exact images of surfaces that are poor for image correlation, and the bound of their displacement.

A surface is a sum of plane waves, or of radial ones: its displaced image, blurred by the lens and integrated over the
pixels, is a closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
SIDE, RADIUS, FRAMES = 72, 15, 64  # px of the image, px of the subset, frames
ELECTRONS, READ_ELECTRONS, BITS = 10_000.0, 8.0, 12  # at full scale
BLUR_PX = 0.9  # rms, of the lens
LINES = (11, 25)  # periods in the record along the strong and the weak direction
MIDDLE_PX = SIDE // 2 - 1
INNER = slice(MIDDLE_PX - RADIUS, MIDDLE_PX + RADIUS + 1)  # pixels of the subset
X = np.arange(SIDE) - float(MIDDLE_PX)
WAVES = 250  # of a random texture
RING_RADIUS_PX, RING_STEP_PX = 120.0, 0.01  # from their common centre; step of the radial profile's table


@dataclass(frozen=True)
class Surface:
    """Waves of wave vectors (K, 2) in rad/px and complex amplitudes (K,) about a mean; rings have K radial ones.

    `light`: relative change of the illumination from edge to edge of the subset, fixed to the camera.
    """

    waves: FloatArray
    amplitudes: ComplexArray
    mean: float = 0.5
    light: float = 0.0
    rings: bool = False

    def image(self, moved_px: FloatArray, blur_px: float = 0.0) -> FloatArray:
        """Return grey values (SIDE, SIDE), share of full scale, after a displacement and further blur."""
        transfer = np.exp(-0.5 * np.sum(self.waves**2, axis=1) * (BLUR_PX**2 + blur_px**2))
        if self.rings:
            values = self._ring_image(moved_px, transfer)
        else:
            aperture = np.prod(np.sinc(self.waves / (2.0 * np.pi)), axis=1)
            amplitudes = self.amplitudes * transfer * aperture * np.exp(-1j * self.waves @ moved_px)
            along, down = self._phases
            values = ((down * amplitudes) @ along).real
        lit = 1.0 + self.light * X / (2.0 * RADIUS + 1.0)
        return np.asarray((self.mean + values) * lit)

    @cached_property
    def _phases(self) -> tuple[ComplexArray, ComplexArray]:
        """Waves along rows (K, SIDE) and columns (SIDE, K)."""
        return np.exp(1j * np.outer(self.waves[:, 0], X)), np.exp(1j * np.outer(X, self.waves[:, 1]))

    @cached_property
    def _radial_phases(self) -> tuple[FloatArray, ComplexArray]:
        """Radii (R,) in px and the waves (R, K) at them."""
        radii = np.arange(RING_RADIUS_PX - 60.0, RING_RADIUS_PX + 60.0, RING_STEP_PX)
        return radii, np.exp(1j * np.outer(radii, self.waves[:, 0]))

    def _ring_image(self, moved_px: FloatArray, transfer: FloatArray) -> FloatArray:
        """Return the mean of the radial profile over the pixel, by Gauss's rule of three points."""
        radii, phases = self._radial_phases
        profile = (phases @ (self.amplitudes * transfer)).real
        total = np.zeros((SIDE, SIDE))
        for x, along in zip((-1.0, 0.0, 1.0), (5.0, 8.0, 5.0), strict=True):
            for y, down in zip((-1.0, 0.0, 1.0), (5.0, 8.0, 5.0), strict=True):
                columns = X + np.sqrt(0.15) * x - moved_px[0] + 0.94 * RING_RADIUS_PX
                rows = X + np.sqrt(0.15) * y - moved_px[1] + 0.34 * RING_RADIUS_PX
                total += along * down / 324.0 * np.interp(np.hypot(columns, rows[:, None]), radii, profile)
        return total


def _random_waves(rms: float, spread: tuple[float, float], rng: np.random.Generator, angle: float = 0.0) -> Surface:
    """Return a Gaussian texture: waves with normally distributed components (rad/px), turned by an angle."""
    waves = np.clip(rng.standard_normal((WAVES, 2)), -3.0, 3.0) * spread
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    phases = np.exp(2j * np.pi * rng.uniform(size=WAVES))
    return Surface(waves @ turn, rms * np.sqrt(2.0 / WAVES) * phases)


def _printed(period: float, width: float, white: float, ink: float, lines: bool, rng: np.random.Generator) -> Surface:
    """Return dark lines printed at 17°, or a grid of them: the Fourier series of the bands and of their product."""
    order = np.arange(-int(period / 2), int(period / 2) + 1)
    turns = order * rng.uniform(-5.0, 5.0) / period
    series = width / period * np.sinc(order * width / period) * np.exp(2j * np.pi * turns)
    bands = (order == 0) - ink * series
    coefficients = np.outer(bands, bands if lines else order == 0).ravel() * white
    normal = 2.0 * np.pi / period * np.array([np.cos(0.3), np.sin(0.3)])
    one, other = (each.ravel() for each in np.meshgrid(order, order, indexing="ij"))
    waves = np.outer(one, normal) + np.outer(other, [-normal[1], normal[0]])
    used = (coefficients != 0.0) & (np.hypot(*waves.T) < np.pi)
    return Surface(waves[used], coefficients[used], 0.0)


def _edge(rng: np.random.Generator) -> Surface:
    """Return one printed edge: a square wave far longer than the image, shifted to its rise."""
    surface = _printed(400.0, 200.0, 0.8, 0.75, False, rng)
    to_edge = 100.0 * np.array([np.cos(0.3), np.sin(0.3)])
    return Surface(surface.waves, surface.amplitudes * np.exp(1j * surface.waves @ to_edge), 0.0)


def _rings(rng: np.random.Generator) -> Surface:
    """Return turned grooves with a feed of 6 px and random depth, contrast 5 % rms."""
    radial = np.concatenate([[2 * np.pi / 6, 4 * np.pi / 6], rng.normal(2 * np.pi / 6, 0.25, 40)])
    size = 0.025 * np.concatenate([[1.0, 0.4], np.full(40, 0.9 * np.sqrt(2.0 / 40))])
    waves = np.column_stack([radial, np.zeros(42)])
    return Surface(waves, size * np.exp(2j * np.pi * rng.uniform(size=42)), rings=True)


def _unpainted(rng: np.random.Generator) -> Surface:
    """Return a fine texture of 2 % in light that changes by 30 % across the subset."""
    fine = _random_waves(0.01, (0.8, 0.8), rng)
    return Surface(fine.waves, fine.amplitudes, light=0.3)


SURFACES: dict[str, Callable[[np.random.Generator], Surface]] = {
    "speckle of 5 px": lambda rng: _random_waves(0.12, (0.47, 0.47), rng),
    "one printed edge": _edge,
    "printed line grid": lambda rng: _printed(24.0, 3.0, 0.8, 0.75, True, rng),
    "brushed metal, 3 %": lambda rng: _random_waves(0.015, (0.7, 0.025), rng, 0.35),
    "machined rings, 5 %": _rings,
    "unpainted, 2 %": _unpainted,
}
DISTURBANCES = ("none", "flicker", "defocus", "PRNU 0.5 %")


@dataclass(frozen=True)
class Series:
    """Frames (F, SIDE, SIDE) in electrons' share of full scale, truth (F, 2) in px and bound (2,) per frame.

    `axes` (2, 2): rows are the strong and the weak direction.
    """

    frames: FloatArray
    truth_px: FloatArray
    bound_px: FloatArray
    axes: FloatArray


def bound_px(slopes: FloatArray, grey: FloatArray, noise2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the Cramér-Rao standard deviations (2,) of a shift along the principal directions, and these (2, 2).

    Fisher information Σ s⁻²·∇f ∇fᵀ of slopes (P, 2) with noise variance (P,), gain and offset free: without the
    projection of the slopes on 1 and f. Strongest direction first.
    """
    scale = 1.0 / np.sqrt(noise2)
    nuisance = np.column_stack([np.ones_like(grey), grey]) * scale[:, None]
    weighted = slopes * scale[:, None]
    free = weighted - nuisance @ np.linalg.lstsq(nuisance, weighted, rcond=None)[0]
    values, vectors = np.linalg.eigh(free.T @ free)
    return 1.0 / np.sqrt(np.maximum(values[::-1], 1e-12)), np.asarray(vectors.T[::-1])


def record(name: str, disturbance: str, amplitude_px: float, seed: int) -> Series:
    """Render a series of frames of a surface with noise and one disturbance."""
    rng = np.random.default_rng([seed, list(SURFACES).index(name)])
    surface = SURFACES[name](rng)
    clean, step = surface.image(np.zeros(2)), 1e-3
    slopes = [(surface.image(-step * one) - surface.image(step * one)) / (2 * step) for one in np.eye(2)]
    noise2 = clean / ELECTRONS + (READ_ELECTRONS / ELECTRONS) ** 2
    flat = [each[INNER, INNER].ravel() for each in (*slopes, clean, noise2)]
    bound, axes = bound_px(np.column_stack(flat[:2]), flat[2], flat[3])
    turns = 2.0 * np.pi * np.outer(np.arange(FRAMES), LINES) / FRAMES + [0.3, 1.1]
    truth = amplitude_px * (np.cos(turns) - np.cos([0.3, 1.1])) @ axes
    gains = 1.0 + (0.005 * rng.standard_normal((SIDE, SIDE)) if disturbance.startswith("PRNU") else 0.0)
    frames = []
    for moved in truth:
        image = surface.image(moved, rng.uniform(0.0, 0.5) if disturbance == "defocus" else 0.0)
        if disturbance == "flicker":
            lamp, x, y = rng.uniform(-0.02, 0.02, 3)
            image = image * (1.0 + lamp + (x * X + y * X[:, None]) / (2.0 * RADIUS + 1.0))
        electrons = rng.poisson(np.maximum(image * gains, 0.0) * ELECTRONS)
        read = electrons + READ_ELECTRONS * rng.standard_normal(image.shape)
        frames.append(np.rint(read / ELECTRONS * (2**BITS - 1)) / (2**BITS - 1))
    return Series(np.array(frames), truth, bound, axes)
