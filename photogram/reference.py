"""Subsets of a reference image, prepared once: grey values, gradients, Hessians, and what the texture determines."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, check_shape
from photogram.interpolate import Spline, evaluate, noise_gain, slope_noise_gain

SMALLEST_NOISE = 1e-9
SMALLEST_CONTRAST = 1e-9
LEAST_RATIO = 4.0
SMALLEST_EXCESS = 1e-2


class TrackStatus(IntEnum):
    """What became of one subset in one frame; every status but `OK` comes with NaN positions."""

    OK = 0
    NOT_CONVERGED = 1
    LOW_CORRELATION = 2
    LEFT_IMAGE = 3
    FLAT = 4
    SATURATED = 5
    NO_START = 6


@dataclass(frozen=True)
class Reference:
    """Square subsets of P = (2·radius+1)² pixels around centre_px (N,2), prepared once for a whole sequence.

    pixels (N,3,P): grey value f̃ without its mean, gradient along x, gradient along y. mean (N,): of the grey values;
    energy (N,): Σf̃². removed (N,2,6): mean of each steepest-descent image and its regression on f̃. inverse_hessian
    (N,6,6): of the steepest-descent images without what is removed, so that gain and offset are free parameters; zero
    along what the texture does not determine. position_variance (N,2,2): covariance of the translation in px² for
    image noise of variance 1. noise_gain (N,): variance of the subset's grey values per variance of the pixels.
    status (N,): `OK`, `FLAT` or `LEFT_IMAGE`.
    """

    centre_px: FloatArray
    radius_px: int
    pixels: FloatArray
    mean: FloatArray
    energy: FloatArray
    removed: FloatArray
    inverse_hessian: FloatArray
    position_variance: FloatArray
    noise_gain: FloatArray
    status: NDArray[np.int8]

    def __post_init__(self) -> None:
        check_shape("centre_px", self.centre_px, (None, 2))
        count, size = len(self.centre_px), (2 * self.radius_px + 1) ** 2
        check_shape("pixels", self.pixels, (count, 3, size))
        check_shape("removed", self.removed, (count, 2, 6))
        check_shape("inverse_hessian", self.inverse_hessian, (count, 6, 6))
        check_shape("position_variance", self.position_variance, (count, 2, 2))
        for name in ("mean", "energy", "noise_gain", "status"):
            check_shape(name, getattr(self, name), (count,))


def prepare_reference(spline: Spline, centre_px: FloatArray, radius_px: int) -> Reference:
    """Grey values, gradients and Hessians of the subsets of one image; centres (N,2) need not be whole pixels.

    Steepest-descent images of the affine warp: [f_x, f_x dx, f_x dy, f_y, f_y dx, f_y dy] (Baker, Matthews 2004,
    Int. J. Comput. Vis. 56, 221; Pan, Li, Tong 2013, Exp. Mech. 53, 1277), each without its mean and its part along f̃.

    Noise of the reference makes gradients too, with the Hessian N = σ²γ·diag(1, dx², dy²) summed over the subset. In
    the basis H v = μ N v, directions with μ < 4 are noise, not texture (along an edge): they are held at their start.
    The variance along v is μ/(μ−1)² instead of 1/μ, since N adds to H but not to what is found.
    """
    check_shape("centre_px", centre_px, (None, 2))
    offsets = subset_offsets(radius_px)
    count, size = len(centre_px), len(offsets)
    points = (centre_px[:, None, :] + offsets).reshape(-1, 2)
    values, gradients = evaluate(spline, points)
    pixels = np.empty((count, 3, size))
    pixels[:, 0] = values.reshape(count, size)
    pixels[:, 1:] = np.moveaxis(gradients.reshape(count, size, 2), 2, 1)
    mean = pixels[:, 0].mean(axis=1)
    pixels[:, 0] -= mean[:, None]
    energy = np.sum(pixels[:, 0] ** 2, axis=1)
    removed, inverse_hessian = np.zeros((count, 2, 6)), np.full((count, 6, 6), np.nan)
    variance, status = np.full((count, 2, 2), np.nan), np.zeros(count, np.int8)
    slope_noise2 = slope_noise_gain(spline.degree) * _pixel_noise(spline, centre_px, radius_px) ** 2
    for n in range(count):
        status[n] = TrackStatus.LEFT_IMAGE
        if energy[n] <= size * (SMALLEST_CONTRAST * abs(mean[n])) ** 2:
            status[n] = TrackStatus.FLAT
        elif np.all(np.isfinite(pixels[n])):
            hessian, removed[n] = _hessian(pixels[n], energy[n], offsets)
            floor = max(slope_noise2[n], SMALLEST_NOISE * energy[n] / size)
            status[n], inverse_hessian[n], variance[n] = _invert(hessian, floor, offsets)
    gain = noise_gain(centre_px[:, 0], spline.degree) * noise_gain(centre_px[:, 1], spline.degree)
    return Reference(centre_px, radius_px, pixels, mean, energy, removed, inverse_hessian, variance, gain, status)


def subset_offsets(radius_px: int) -> FloatArray:
    """Pixels (P,2) of a subset relative to its centre, row by row."""
    line = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    rows, columns = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([columns.ravel(), rows.ravel()])


def _pixel_noise(spline: Spline, centre_px: FloatArray, radius_px: int) -> FloatArray:
    """Standard deviation (N,) of white noise in each subset, from the median of mixed third differences of its pixels.

    The differences (1 −3 3 −1) in x and y suppress texture of a few pixels' size; |·| has the median 0.6745 · 20 σ.
    """
    side = 2 * radius_px + 1
    points = (np.rint(centre_px)[:, None, :] + subset_offsets(radius_px)).reshape(-1, 2)
    grey = evaluate(spline, points)[0].reshape(-1, side, side)
    fine = np.abs(np.diff(np.diff(grey, n=3, axis=1), n=3, axis=2)).reshape(len(centre_px), -1)
    noise: FloatArray = np.nan_to_num(np.median(fine, axis=1)) / (0.6745 * 20.0)
    return noise


def _hessian(pixels: FloatArray, energy: float, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hessian (6,6) of one subset's steepest-descent images without their mean and part along f̃, and these (2,6)."""
    shape = np.column_stack([np.ones(len(offsets)), offsets])
    steepest = np.concatenate([pixels[1][:, None] * shape, pixels[2][:, None] * shape], axis=1)
    mean = steepest.mean(axis=0)
    part = pixels[0] @ steepest / energy if energy > 0.0 else np.zeros(6)
    steepest -= mean + pixels[0][:, None] * part
    return steepest.T @ steepest, np.stack([mean, part])


def _invert(hessian: FloatArray, slope_noise2: float, offsets: FloatArray) -> tuple[int, FloatArray, FloatArray]:
    """Status, inverse Hessian (6,6) of the determined directions, and variance (2,2) of the translation."""
    if slope_noise2 <= 0.0:
        return TrackStatus.FLAT, np.full((6, 6), np.nan), np.full((2, 2), np.nan)
    extent = np.array([len(offsets), *np.sum(offsets**2, axis=0)])
    scale = 1.0 / np.sqrt(slope_noise2 * np.concatenate([extent, extent]))
    ratio, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    directions = vectors * scale[:, None]
    clear = ratio > LEAST_RATIO
    if not clear.any():
        return TrackStatus.FLAT, np.full((6, 6), np.nan), np.full((2, 2), np.nan)
    inverse = (directions[:, clear] / ratio[clear]) @ directions[:, clear].T
    weights = ratio / np.maximum(ratio - 1.0, SMALLEST_EXCESS) ** 2
    translation = directions[[0, 3]]
    return TrackStatus.OK, inverse, (translation * weights) @ translation.T
