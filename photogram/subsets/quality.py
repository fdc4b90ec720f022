"""What to expect of subsets before they are tracked: their σ, the unusable ones, and the bias of unresolved texture."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray, Notice, check_shape
from photogram.subsets.grid import (
    NoiseModel,
    fine_texture_share,
    lay_grid,
    saturated,
    speckle_size,
    subset_mean,
    textured_area,
)
from photogram.subsets.reference import Reference, TrackStatus

Image = NDArray[Any]
USUAL_RADIUS_PX = 10
SMALLEST_RADIUS_PX, LARGEST_RADIUS_PX = 7, 25
FEWEST_SPECKLES, MOST_SPECKLES = 4.2, 5.25
SMALLEST_SPECKLE_PX = 3.0
LARGEST_BIAS_PX = 5e-4
TILE_PX = 32
STEEP = 0.25  # cycles per pixel from which on the decay of the spectrum is fitted
CORNER = 0.4
RIM_EXPONENT = 2.0
SCATTER = 0.2
DECAYS = np.concatenate([[0.0], np.geomspace(0.5, 400.0, 120)])
REASONS = {
    TrackStatus.FLAT: "without texture",
    TrackStatus.SATURATED: "saturated",
    TrackStatus.LEFT_IMAGE: "too close to the image's border",
    TrackStatus.NO_START: "without a position",
}


@dataclass(frozen=True)
class SubsetQuality:
    """Expected standard deviation of x and y of N subsets in one frame, and which of them are of no use.

    predicted_sigma_px (N,2), NaN where the subset is unusable; noise_grey (N,): rms noise of the pixels that carry the
    position; status (N,) of `TrackStatus`: `OK`, `FLAT`, `SATURATED`, `LEFT_IMAGE` or `NO_START`.
    """

    predicted_sigma_px: FloatArray
    noise_grey: FloatArray
    status: NDArray[np.int8]

    def __post_init__(self) -> None:
        check_shape("predicted_sigma_px", self.predicted_sigma_px, (None, 2))
        for name in ("noise_grey", "status"):
            check_shape(name, getattr(self, name), (len(self.predicted_sigma_px),))

    @property
    def usable(self) -> BoolArray:
        """Which subsets are worth tracking."""
        return np.asarray(self.status == TrackStatus.OK)

    @property
    def saturated(self) -> BoolArray:
        """Which subsets have more than 1 % of their pixels at full scale."""
        return np.asarray(self.status == TrackStatus.SATURATED)

    @property
    def flat(self) -> BoolArray:
        """Which subsets have no texture that stands out of the noise."""
        return np.asarray(self.status == TrackStatus.FLAT)

    def notices(self, where: str) -> tuple[Notice, ...]:
        """A remark on `where` that counts the unusable subsets by reason, if there are any."""
        lost = [(int(np.sum(self.status == status)), reason) for status, reason in REASONS.items()]
        parts = [f"{count} {reason}" for count, reason in lost if count > 0]
        if not parts:
            return ()
        text = f"{np.sum(~self.usable)} of {len(self.status)} subsets are not used: {', '.join(parts)}"
        return (Notice("info", text, where),)


def assess(reference: Reference, image: Image, noise: NoiseModel, full_scale: int) -> SubsetQuality:
    """What the subsets of `reference`, prepared from `image` (H,W), will yield in any frame of a camera's noise model.

    σᵢ² = Vᵢᵢ · Σ fᵢ²·s²(f) / Σ fᵢ² with V the `position_variance` per unit noise (affine map, gain and offset free), fᵢ
    the gradient along x or y, and s² the noise model: noise counts where the gradients are.
    """
    check_shape("image", image, (None, None))
    grey = image.astype(np.float64)
    level = noise.variance(grey)
    absent = ~np.isfinite(reference.centre_px).all(axis=1)
    full = saturated(image, full_scale, reference.centre_px, reference.radius_px)
    status = np.where(full, np.int8(TrackStatus.SATURATED), reference.status)
    status = np.where(absent, np.int8(TrackStatus.NO_START), status)
    variance = np.empty((len(status), 2))
    for i, slope in enumerate(np.gradient(grey)[::-1]):
        weight = subset_mean(slope**2, reference.centre_px, reference.radius_px)
        noisy = subset_mean(slope**2 * level, reference.centre_px, reference.radius_px)
        variance[:, i] = np.divide(noisy, weight, out=np.full(len(status), np.nan), where=weight > 0.0)
    predicted = np.sqrt(variance * reference.position_variance[:, [0, 1], [0, 1]])
    predicted[status != TrackStatus.OK] = np.nan
    return SubsetQuality(predicted, np.sqrt(variance.mean(axis=1)), status.astype(np.int8))


def default_radius_px(speckle_px: float) -> int:
    """Radius, as near to 10 px as can be, of a subset 4.2 to 5.25 speckles wide, at least 7 and at most 25 px.

    Fewer speckles leave too little for affine map, gain and offset; more give no more of a rigid body than smaller
    subsets together, and leave more of its rim uncovered. An unknown size (NaN) gives 10.
    """
    if not np.isfinite(speckle_px):
        return USUAL_RADIUS_PX
    smallest = ceil((FEWEST_SPECKLES * speckle_px - 1.0) / 2.0)
    largest = max(smallest, floor((MOST_SPECKLES * speckle_px - 1.0) / 2.0))
    radius = min(max(USUAL_RADIUS_PX, smallest), largest)
    return min(max(radius, SMALLEST_RADIUS_PX), LARGEST_RADIUS_PX)


def suggested_radius_px(image: Image) -> int:
    """`default_radius_px` of the speckle size found in the textured area of image (H,W)."""
    return default_radius_px(speckle_size(image, textured_area(image)))


@dataclass(frozen=True)
class AliasingBias:
    """Amplitude in px of the position error that is periodic in the pixel, the larger one of x and y.

    mean_px: of all subsets together, as long as their displacements are equal; subset_px: of one subset, rms.
    """

    mean_px: float
    subset_px: float


def aliasing_bias(image: Image, area: BoolArray, noise_grey: float, radius_px: int, degree: int = 5) -> AliasingBias:
    """Error of subsets of `image` (H,W) in `area` (H,W) that sampling and spline interpolation bring; NaN if no room.

    Texture of frequency ν along x, shifted by u, is found by a spline at a pixel shifted by u as
    F(ν)·[1 + W·(e^{∓2πju} − 1)]: W(ν) = H(ν−1), H the frequency response of the cardinal spline (Unser 1999, IEEE
    Signal Process. Mag. 16(6), 22), goes from 0 below Nyquist (images left by the spline) to 1 above it (aliases). The
    error e moves a subset by δ = Σ fₓe/Σ fₓ². With the spline's derivative D(ν) and the spectrum P the mean over
    subsets is B·sin 2πu, B = ∫P·W·D/∫P·D² over 0 < ν < 1, whose parts below and above Nyquist have opposite signs; the
    larger part is taken, since the difference hangs on the extrapolation. A subset of n pixels has beside it the rms
    amplitude √(2∫∫P·D²·P·W²/n)/∫∫P·D².

    P beyond Nyquist is the folded part of the periodogram under the law A·ν⁻²·sinc²ν·exp(−cν²): rims of dots, pixel
    aperture, lens blur, fitted from 0.25 cycles per pixel on. Noise is taken off, at most what the corners of the
    two-dimensional spectrum show.
    """
    check_shape("area", area, image.shape)
    power = _periodogram(image, area)
    if power is None:
        return AliasingBias(float("nan"), float("nan"))
    fine = np.abs(np.fft.fftfreq(TILE_PX)) > CORNER
    floor_power = float(power[np.ix_(fine, fine)].mean())
    floor_power = min(floor_power, noise_grey**2) if np.isfinite(noise_grey) else floor_power
    pixels = ((2 * radius_px + 1) ** 2, degree)
    both = [_axis_bias(spectrum, floor_power, *pixels) for spectrum in (power, power.T)]
    return AliasingBias(max(mean for mean, _ in both), max(single for _, single in both))


def aliasing_notice(image: Image, area: BoolArray, noise_grey: float, bias: AliasingBias, where: str) -> Notice | None:
    """A warning about speckle that the camera cannot resolve: below 3 px, or with a mean bias beyond 0.5 mpx.

    `bias`: the `aliasing_bias` of image (H,W) in `area` (H,W).
    """
    size = speckle_size(image, area)
    if not (size < SMALLEST_SPECKLE_PX or bias.mean_px > LARGEST_BIAS_PX):
        return None
    share = fine_texture_share(image, area, float(np.nan_to_num(noise_grey)))
    text = (
        f"texture is finer than the camera resolves (speckle of {size:.1f} px, {100 * share:.1f} % of its power beyond "
        f"0.4 cycles per pixel): positions may err by {bias.subset_px:.2g} px per subset and {bias.mean_px:.2g} px in "
        "the mean of all, periodic in the pixel, which appears as false harmonics of the motion; use speckle of 4 to "
        "5 px with soft rims or defocus slightly"
    )
    return Notice("warning", text, where)


def _periodogram(image: Image, area: BoolArray) -> FloatArray | None:
    """Mean power density (32,32) of Hann-windowed tiles, half overlapping, in grey² (white noise: its variance)."""
    half = TILE_PX // 2
    window = np.outer(np.hanning(TILE_PX + 1)[:-1], np.hanning(TILE_PX + 1)[:-1])
    centres = lay_grid(area, half, half).astype(np.int64)
    if len(centres) == 0:
        return None
    tiles = np.stack([image[y - half : y + half, x - half : x + half] for x, y in centres]).astype(np.float64)
    tiles -= np.mean(tiles * window, axis=(1, 2), keepdims=True) / window.mean()
    power: FloatArray = np.mean(np.abs(np.fft.fft2(tiles * window)) ** 2, axis=0) / np.sum(window**2)
    return power


def _axis_bias(power: FloatArray, noise_power: float, pixels: int, degree: int) -> tuple[float, float]:
    """Amplitudes of mean and single subset for a shift along the second axis of the power density."""
    clean = np.maximum(power - noise_power, 0.0)
    along = np.mean(power, axis=0)[: TILE_PX // 2 + 1] - noise_power
    frequency = np.arange(TILE_PX // 2 + 1) / TILE_PX
    folded = _folded_share(frequency, along, noise_power)
    image, alias = _spline_response(frequency - 1.0, degree), _spline_response(-frequency, degree)
    slope = _spline_slope(frequency, degree)
    along = np.maximum(along, 0.0)
    count = np.where((frequency == 0.0) | (frequency == 0.5), 0.5, 1.0)  # of the bins that share a frequency
    total = np.sum(count * along * slope**2)
    if total <= 0.0:
        return float("nan"), float("nan")
    parts = np.array([np.sum(count * along * slope * w) for w in ((1.0 - folded) * image, folded * alias)])
    mean = float(np.max(parts) / total)
    every = np.abs(np.rint(np.fft.fftfreq(TILE_PX) * TILE_PX)).astype(np.int64)
    error = ((1.0 - folded) * image**2 + folded * alias**2)[every]
    steep = clean * slope[every] ** 2
    scattered = float(np.sqrt(2.0 * np.mean(steep * clean * error) / pixels) / np.mean(steep))
    return mean, float(np.hypot(mean, scattered))


def _folded_share(frequency: FloatArray, along: FloatArray, noise_power: float) -> FloatArray:
    """Share of the power at each frequency up to 0.5 that comes from 1 − frequency; zero below 0.25."""
    tail = frequency >= STEEP
    nu = frequency[tail]
    inside = np.exp(-np.multiply.outer(DECAYS, nu**2)) * nu**-RIM_EXPONENT * np.sinc(nu) ** 2
    beyond = np.exp(-np.multiply.outer(DECAYS, (1 - nu) ** 2)) * (1 - nu) ** -RIM_EXPONENT * np.sinc(1 - nu) ** 2
    weight = 1.0 / (SCATTER * np.maximum(along[tail], 0.0) + 0.05 * noise_power + 1e-9 * along.max()) ** 2
    model = inside + beyond
    height = np.maximum((model * weight) @ along[tail], 0.0) / np.sum(model**2 * weight, axis=1)
    misfit = np.sum(weight * (along[tail] - height[:, None] * model) ** 2, axis=1)
    best = int(np.argmin(misfit))
    share = np.zeros_like(frequency)
    share[tail] = beyond[best] / model[best]
    return share


def _spline_response(frequency: FloatArray, degree: int) -> FloatArray:
    """Frequency response sinc^(n+1)(ν)/Σ_k sinc^(n+1)(ν+k) of the cardinal spline of degree n."""
    power = degree + 1
    period: FloatArray = np.sum([np.sinc(frequency + k) ** power for k in range(-8, 9)], axis=0)
    return np.asarray(np.sinc(frequency) ** power / period)


def _spline_slope(frequency: FloatArray, degree: int) -> FloatArray:
    """Slope of the spline through cos 2πνn at the pixels, relative to −sin 2πνn: Σ_k 2π(ν+k)·H(ν+k)."""
    terms = [2.0 * np.pi * (frequency + k) * _spline_response(frequency + k, degree) for k in range(-8, 9)]
    return np.asarray(np.sum(terms, axis=0))
