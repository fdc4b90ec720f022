"""Stereo pair from its data sheet: field of view, depth of field, noise.

Thin lens and geometric optics; the noise is the Cramér–Rao bound of the displacement of a speckled face.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, log, radians, sin, sqrt
from pathlib import Path
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from fusion.recording.toml import read_toml, validate
from fusion.recording.values import ManifestBlock, Positive, Version, refusal, vector
from fusion.report.terminal import print_table

WAVELENGTH_M = 550e-9
"""Middle of visible light."""
WIDTH_OF_CORRELATION = 2.0 * sqrt(2.0 * log(2.0))
"""Full width at half maximum of exp(−τ²/ℓ²) times √2/ℓ, the rms slope of grey values of unit scatter: 2√(2 ln 2)."""


Pair = Annotated[tuple[Positive, Positive], BeforeValidator(vector(2))]
"""Width and height."""


class CameraSetup(ManifestBlock):
    """Data sheets and distances of a symmetric stereo pair, in SI units."""

    format: Version = 1
    pixel: Positive
    image: Pair
    focal_length: Positive
    distance: Positive
    f_number: Positive
    stereo_angle: Annotated[float, Field(gt=0, lt=120)]
    face: Pair
    speckle: Positive = 5.0
    contrast: Positive = 0.2
    noise: Positive = 0.01
    frames: Annotated[int, Field(ge=4)] = 211

    @model_validator(mode="after")
    def _sees_the_face(self) -> Self:
        if self.distance <= self.focal_length:
            raise refusal("a distance beyond the focal length", f"{self.distance:g}", key="distance")
        return self


@dataclass(frozen=True)
class SetupEstimate:
    """What a set-up gives.

    Attributes
    ----------
    pixel_m : size of a pixel on the object.
    field_m : width and height of the field of view.
    depth_m : depth of field for a blur of one pixel.
    airy_px : diameter of the diffraction disc.
    speckle_m : size of a speckle on the object.
    used_px : number of pixels on the face.
    noise_m : standard deviation of x (in the plane of both cameras), y and z (along the view) of the face in one frame.
    """

    pixel_m: float
    field_m: tuple[float, float]
    depth_m: float
    airy_px: float
    speckle_m: float
    used_px: float
    noise_m: tuple[float, float, float]


def estimate_setup(setup: CameraSetup) -> SetupEstimate:
    """Return field of view, depth of field and noise of a set-up.

    The magnification is M = f/(d − f); a blur of one pixel p limits the depth to 2·N·p·(1 + M)/M². Grey values with the
    scatter C and a speckle of s px (full width at half maximum of their autocorrelation, Gaussian) have the rms slope
    2√(2 ln 2)·C/s. The displacement of n pixels with noise σ then scatters by σ/(slope·√n) (Cramér–Rao bound for an
    exact reference). Two cameras at half the stereo angle α from the normal give x by 1/(√2·cos α), y by 1/√2, and z by
    1/(√2·sin α) of that.
    """
    magnification = setup.focal_length / (setup.distance - setup.focal_length)
    pixel_m = setup.pixel / magnification
    field_m = setup.image[0] * pixel_m, setup.image[1] * pixel_m
    used = [min(face, field) / pixel_m for face, field in zip(setup.face, field_m, strict=True)]
    slope = WIDTH_OF_CORRELATION * setup.contrast / setup.speckle
    one = pixel_m * setup.noise / (slope * sqrt(used[0] * used[1]) * sqrt(2.0))
    half = radians(setup.stereo_angle / 2.0)
    return SetupEstimate(
        pixel_m=pixel_m,
        field_m=field_m,
        depth_m=2.0 * setup.f_number * setup.pixel * (1.0 + magnification) / magnification**2,
        airy_px=2.44 * WAVELENGTH_M * setup.f_number * (1.0 + magnification) / setup.pixel,
        speckle_m=setup.speckle * pixel_m,
        used_px=used[0] * used[1],
        noise_m=(one / cos(half), one, one / sin(half)),
    )


def read_setup(path: Path) -> CameraSetup:
    """Read a set-up; `InputError` for errors."""
    return validate(CameraSetup, read_toml(path), path)


def print_setup(setup: CameraSetup) -> None:
    """Print what a set-up gives, and its risks."""
    print_table("Set-up of a stereo pair", ("quantity", "value", "unit"), "lrl", [list(_rows(setup))])


def _rows(setup: CameraSetup) -> Iterator[tuple[str, str, str]]:
    """Yield quantity, value and unit."""
    found = estimate_setup(setup)
    x, y, z = (1e9 * noise for noise in found.noise_m)
    amplitude = sqrt(2.0 / setup.frames)
    yield "field of view", f"{1e3 * found.field_m[0]:.0f} × {1e3 * found.field_m[1]:.0f}", "mm"
    yield "pixel on the object", f"{1e6 * found.pixel_m:.1f}", "µm"
    yield "speckle on the object", f"{1e3 * found.speckle_m:.2f}", "mm"
    yield "depth of field, blur of 1 px", f"{1e3 * found.depth_m:.1f}", "mm"
    yield "diffraction disc", f"{found.airy_px:.1f}", "px"
    yield "pixels on the face", f"{1e-6 * found.used_px:.2g}", "million"
    yield "noise of a frame, x", f"{x:.2g}", "nm"
    yield "noise of a frame, y", f"{y:.2g}", "nm"
    yield "noise of a frame, z (along the view)", f"{z:.2g}", "nm"
    yield f"noise of an amplitude, x, {setup.frames} frames", f"{x * amplitude:.2g}", "nm"
    yield f"noise of an amplitude, z, {setup.frames} frames", f"{z * amplitude:.2g}", "nm"
