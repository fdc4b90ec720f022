"""Stereo pair or single camera from its data sheet: optics, noise, uncertainty.

Thin lens and geometric optics; the noise is the Cramér–Rao bound of the motion of a speckled face.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, log, pi, radians, sin, sqrt
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from fusion.recording.recording_notices import MISSING_KEY
from fusion.recording.toml import read_toml, validate
from fusion.recording.values import (
    HERTZ,
    ZERO3,
    Direction,
    ManifestBlock,
    Position,
    Positive,
    Share,
    Version,
    refusal,
    vector,
)
from fusion.report.terminal import print_table
from photogram.geometry import skew
from shaker.labels import MOTION_COMPONENTS
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text

WAVELENGTH_M = 550e-9
"""Middle of visible light."""
LEAST_FACE_PX = 20
"""Shorter side of a face in the image (chosen)."""
WIDTH_OF_CORRELATION = 2.0 * sqrt(2.0 * log(2.0))
"""Full width at half maximum of exp(−τ²/ℓ²) times √2/ℓ, the rms slope of grey values of unit scatter: 2√(2 ln 2)."""


COVERAGE = 1.96
"""Of an interval of 95 %, normal distribution."""


Pair = Annotated[tuple[Positive, Positive], BeforeValidator(vector(2))]
"""Width and height."""


class CameraSetup(ManifestBlock):
    """Data sheets and distances of a stereo pair, one camera, or both.

    In SI units. Vectors are in face axes: x to the right, y up, z out of the face. `view_angle`: of one camera, turned
    about y as those of a pair. `face`: the part in the image. `origin`: of the sensor, from the centre of the face.
    `direction`: of the excitation.
    """

    format: Version = 1
    pixel: Positive
    image: Pair
    focal_length: Positive
    distance: Positive
    f_number: Positive
    stereo_angle: Annotated[float, Field(gt=0, lt=120)] | None = None
    view_angle: Annotated[float, Field(ge=0, le=80)] | None = None
    face: Pair
    speckle: Positive = 5.0
    contrast: Positive = 0.2
    noise: Positive = 0.01
    frames: Annotated[int, Field(ge=4)] = 211
    origin: Position = ZERO3
    direction: Direction = (0.0, 0.0, 1.0)
    frequency: Annotated[Positive, HERTZ] | None = None
    acceleration: Positive | None = None
    scale_uncertainty: Share = 0.0

    @model_validator(mode="after")
    def _sees_the_face(self) -> Self:
        if self.distance <= self.focal_length:
            raise refusal("a distance beyond the focal length", f"{self.distance:g}", key="distance")
        pixel_m = self.pixel * (self.distance - self.focal_length) / self.focal_length
        wide, high = (count * pixel_m for count in self.image)
        shown = f"{1e3 * self.face[0]:.3g} × {1e3 * self.face[1]:.3g} mm"
        if self.face[0] > wide or self.face[1] > high:
            raise refusal(f"a face within the field of {1e3 * wide:.3g} × {1e3 * high:.3g} mm", shown, key="face")
        if min(self.face) < LEAST_FACE_PX * pixel_m:
            expected = f"a face of {LEAST_FACE_PX} px or more at {self.distance:g} m, {1e3 * pixel_m:.3g} mm each"
            raise refusal(expected, shown, key="face")
        if self.stereo_angle is None and self.view_angle is None:
            expected = "stereo_angle of a pair, or view_angle of one camera"
            raise refusal(expected, "neither", key="stereo_angle", declared=MISSING_KEY)
        if (self.frequency is None) != (self.acceleration is None):
            key = "frequency" if self.frequency is None else "acceleration"
            raise refusal("frequency and acceleration", "one of them", key=key, declared=MISSING_KEY)
        return self

    @property
    def arrangements(self) -> dict[str, list[FloatArray]]:
        """Unit vectors from the face to the cameras of each arrangement, by its name."""
        named: dict[str, list[FloatArray]] = {}
        if self.view_angle is not None:
            named["one camera"] = [_eye(self.view_angle)]
        if self.stereo_angle is not None:
            named["a pair"] = [_eye(sign * self.stereo_angle / 2.0) for sign in (-1.0, 1.0)]
        return named


def _eye(degrees: float) -> FloatArray:
    """Return the unit vector from the face to a camera."""
    return np.array([sin(radians(degrees)), 0.0, cos(radians(degrees))])


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
    used_px : number of pixels on a face across the view.
    covariance : (6, 6) of the motion x y z rx ry rz of the sensor origin in one frame, m and rad, by arrangement.
    """

    pixel_m: float
    field_m: tuple[float, float]
    depth_m: float
    airy_px: float
    speckle_m: float
    used_px: float
    covariance: dict[str, FloatArray]


GRID = 41
"""Points along each side of the face: the mean over it is exact to 0.1 %."""


def estimate_setup(setup: CameraSetup) -> SetupEstimate:
    """Return field of view, depth of field and covariance of the motion of a set-up.

    The magnification is M = f/(d − f); a blur of one pixel p limits the depth to 2·N·p·(1 + M)/M². Grey values with the
    scatter C and a speckle of s px (full width at half maximum of their autocorrelation, Gaussian) have the rms slope
    2√(2 ln 2)·C/s on the face. A pixel whose ray r meets the face at P sees the pattern displaced by d − r·d_z/r_z,
    d = t + θ × (P − origin). With the rates J (2, 6) of the first two components and noise σ, the covariance is
    (Σ JᵀJ·slope²/σ²)⁻¹ over the pixels of all cameras (Cramér–Rao bound for an exact reference).
    """
    magnification = setup.focal_length / (setup.distance - setup.focal_length)
    pixel_m = setup.pixel / magnification
    field_m = setup.image[0] * pixel_m, setup.image[1] * pixel_m
    slope = WIDTH_OF_CORRELATION * setup.contrast / (setup.speckle * pixel_m)
    x, y = (side_m * ((np.arange(GRID) + 0.5) / GRID - 0.5) for side_m in setup.face)
    points = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.zeros(GRID**2)], axis=1)
    per_pixel = (slope / setup.noise) ** 2
    used_px = setup.face[0] * setup.face[1] / pixel_m**2

    def information(eye: FloatArray) -> FloatArray:
        ray = points - setup.distance * eye
        density = -ray[:, 2] * setup.distance**2 / (-ray @ eye) ** 3  # pixels over those of a face across the view
        along = np.broadcast_to(np.eye(3)[:2], (len(points), 2, 3)).copy()
        along[:, :, 2] = -ray[:, :2] / ray[:, 2:]
        by_rotation = np.stack([-skew(arm) for arm in points - np.array(setup.origin)])
        rates = along @ np.concatenate([np.broadcast_to(np.eye(3), by_rotation.shape), by_rotation], axis=2)
        return np.asarray(per_pixel * used_px / len(points) * np.einsum("n,nip,niq->pq", density, rates, rates))

    return SetupEstimate(
        pixel_m=pixel_m,
        field_m=field_m,
        depth_m=2.0 * setup.f_number * setup.pixel * (1.0 + magnification) / magnification**2,
        airy_px=2.44 * WAVELENGTH_M * setup.f_number * (1.0 + magnification) / setup.pixel,
        speckle_m=setup.speckle * pixel_m,
        used_px=used_px,
        covariance={
            name: _inverse(np.sum([information(eye) for eye in eyes], axis=0))
            for name, eyes in setup.arrangements.items()
        },
    )


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix of m and rad, scaled before."""
    scale = 1.0 / np.sqrt(np.diagonal(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def read_setup(path: Path) -> CameraSetup:
    """Read a set-up; `InputError` for errors."""
    return validate(CameraSetup, read_toml(path), path)


def print_setup(setup: CameraSetup) -> None:
    """Print what a set-up gives, and its risks."""
    found = estimate_setup(setup)
    print_table("Optics", ("quantity", "value", "unit"), "lrl", [list(_optics(found))])
    head = ("standard uncertainty, and U (95 %)", *found.covariance, "unit")
    align = "l" + "r" * len(found.covariance) + "l"
    print_table("Motion of the sensor origin, face axes", head, align, list(_motion(setup, found)))


def _optics(found: SetupEstimate) -> Iterator[tuple[str, str, str]]:
    """Yield quantity, value and unit."""
    yield "field of view", f"{1e3 * found.field_m[0]:.0f} × {1e3 * found.field_m[1]:.0f}", "mm"
    yield "pixel on the object", f"{1e6 * found.pixel_m:.1f}", "µm"
    yield "speckle on the object", f"{1e3 * found.speckle_m:.2f}", "mm"
    yield "depth of field, blur of 1 px", f"{1e3 * found.depth_m:.1f}", "mm"
    yield "diffraction disc", f"{found.airy_px:.1f}", "px"
    yield "pixels on the face", f"{1e-6 * found.used_px:.2g}", "million"


def relative_expanded_uncertainty(setup: CameraSetup, covariance: FloatArray) -> float:
    """Return the relative U (95 %) of the sensitivity by image noise and scale.

    A part of an amplitude from N frames has u·√(2/N). It needs `frequency` and `acceleration`.
    """
    assert setup.frequency is not None
    assert setup.acceleration is not None
    along = np.array(setup.direction)
    u_m = sqrt(float(along @ covariance[:3, :3] @ along) * 2.0 / setup.frames)
    return COVERAGE * float(
        np.hypot((2.0 * pi * setup.frequency) ** 2 * u_m / setup.acceleration, setup.scale_uncertainty)
    )


def _motion(setup: CameraSetup, found: SetupEstimate) -> Iterator[list[list[str]]]:
    """Yield sections of rows: noise, then U of accelerations and sensitivity."""
    u = 1e9 * np.array([np.sqrt(np.diagonal(covariance)) for covariance in found.covariance.values()]).T
    amplitude = sqrt(2.0 / setup.frames)

    def section(title: str, factor: float, units: tuple[str, str]) -> list[list[str]]:
        return [
            [f"{title}, {name}", *(number_text(factor * value, 2) for value in values), units[i // 3]]
            for i, (name, values) in enumerate(zip(MOTION_COMPONENTS, u, strict=True))
        ]

    yield section("u of a frame", 1.0, ("nm", "nrad"))
    if setup.frequency is None:
        yield section(f"u of an amplitude, {setup.frames} frames", amplitude, ("nm", "nrad"))
    else:
        factor = COVERAGE * amplitude * 1e-9 * (2.0 * pi * setup.frequency) ** 2
        yield section(f"U of an acceleration, {setup.frequency:g} Hz", factor, ("m/s²", "rad/s²"))
        shares = [relative_expanded_uncertainty(setup, covariance) for covariance in found.covariance.values()]
        yield [["U of the sensitivity, with the scale", *(number_text(100.0 * share, 2) for share in shares), "%"]]
