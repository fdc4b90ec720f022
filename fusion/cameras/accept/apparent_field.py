"""Apparent deformation of a moved plate: displacement per travel, its rigid and smooth parts.

A rigid body that moves along a stage has the same displacement everywhere. A wrong calibration bends the measured
space, so that the displacement changes over the plate: that change is rotation, strain and bending, which do not exist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import Arrays, FloatArray

CUBIC, QUADRATIC = 10, 6
"""Terms of a polynomial in two coordinates: errors of lenses and poses are smooth, matching errors are not."""
RATES = 9
"""Displacement, rotation and strain in the plane, three each."""


def plate_axes(offset_m: FloatArray) -> FloatArray:
    """Return axes (3, 3) as columns: right in the left image, down, away from it.

    `offset_m` (N, 3): the points about their centre. The first two are in the mean plane of the points.
    """
    _, _, directions = np.linalg.svd(offset_m, full_matrices=False)
    normal = directions[2] * (1.0 if directions[2, 2] >= 0.0 else -1.0)
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(normal, right), normal])


def polynomials(plane_m: FloatArray, terms: int, extent_m: FloatArray | None = None) -> FloatArray:
    """Return powers (N, terms) of plate coordinates (N, 2), scaled to their extent."""
    x, y = (plane_m / (np.max(np.abs(plane_m), axis=0) if extent_m is None else extent_m)).T
    powers = [x ** (total - down) * y**down for total in range(4) for down in range(total + 1)]
    return np.stack(powers[:terms], axis=1)


def local_noise(plane_m: FloatArray, values: FloatArray) -> FloatArray:
    """Return standard deviations (C,) of values (N, C) about a cubic over the plate."""
    design = polynomials(plane_m, CUBIC)
    left_over = values - design @ (np.linalg.pinv(design) @ values)
    return np.asarray(np.sqrt(np.sum(left_over**2, axis=0) / max(len(values) - CUBIC, 1)))


@dataclass(frozen=True, eq=False, repr=False)
class ApparentField(
    Arrays,
    shapes="axes 3 3; plane_m N 2; offset_m N 3; slope N 3; noise 3; rates 9; covariance 9 9; remainder N 3",
):
    """Displacement of N points per travel, in the axes of the plate.

    Attributes
    ----------
    axes : `plate_axes` in the left camera's frame.
    plane_m, offset_m : (N, 2) and (N, 3), points about their centre in the axes of the plate.
    slope : (N, 3), displacement over travel (m per m, or m per rad).
    noise : (3,) of the slope of one point.
    rates, covariance : mean displacement (3), rotation (3) and strain (xx, yy, xy) per travel.
    remainder : (N, 3), slope without displacement, rotation and strain.
    """

    axes: FloatArray
    plane_m: FloatArray
    offset_m: FloatArray
    slope: FloatArray
    noise: FloatArray
    rates: FloatArray
    covariance: FloatArray
    remainder: FloatArray

    @property
    def bending(self) -> tuple[float, float]:
        """Rms length of the smooth part of the remainder, and its standard uncertainty."""
        design = polynomials(self.plane_m, CUBIC)
        smooth = design @ (np.linalg.pinv(design) @ self.remainder)
        by_noise = float(np.sum(self.noise**2)) * (CUBIC - 3) / len(design)
        size = float(np.mean(np.sum(smooth**2, axis=1)))
        return float(np.sqrt(max(size - by_noise, 0.0))), float(np.sqrt(by_noise))

    def scale_over_field(self, direction: FloatArray) -> tuple[FloatArray, float]:
        """Return the relative change (N,) of the scale over the plate, and its u."""
        size = float(np.linalg.norm(self.rates[:3]))
        design = polynomials(self.plane_m, QUADRATIC)
        solver = np.linalg.pinv(design)
        along = self.slope @ direction / size - 1.0
        smooth = design @ (solver @ along)
        leverage = float(np.max(np.sum((design @ solver) ** 2, axis=1)))
        noise = float(np.sqrt(np.sum((self.noise * direction) ** 2)))
        return np.asarray(smooth - smooth.mean()), noise * np.sqrt(leverage) / size

    @property
    def strain_map(self) -> FloatArray:
        """Largest principal strain per travel (N,) at each point, by a slope of second degree."""
        solver = np.linalg.pinv(polynomials(self.plane_m, QUADRATIC))
        extent = np.max(np.abs(self.plane_m), axis=0)
        gradient = []
        for axis in (0, 1):
            step = np.zeros(2)
            step[axis] = 1e-4 * extent[axis]
            ends = [polynomials(self.plane_m + sign * step, QUADRATIC, extent) for sign in (1.0, -1.0)]
            gradient.append((ends[0] - ends[1]) @ (solver @ self.slope[:, :2]) / (2.0 * step[axis]))
        tensor = np.stack(gradient, axis=1)
        principal = np.linalg.eigvalsh(0.5 * (tensor + tensor.transpose(0, 2, 1)))
        return np.asarray(principal[np.arange(len(principal)), np.argmax(np.abs(principal), axis=1)])

    @property
    def strain(self) -> tuple[float, float]:
        """Largest principal strain per travel by magnitude, and its standard uncertainty."""
        xx, yy, xy = self.rates[6:]
        principal = np.linalg.eigvalsh(np.array([[xx, xy], [xy, yy]]))
        u = float(np.sqrt(np.max(np.diagonal(self.covariance)[6:])))
        return float(principal[np.argmax(np.abs(principal))]), u

    @property
    def rotation(self) -> tuple[float, float]:
        """Magnitude of the rotation per travel, and its standard uncertainty."""
        vector, covariance = self.rates[3:6], self.covariance[3:6, 3:6]
        size = float(np.linalg.norm(vector))
        along = vector / size if size > 0.0 else np.array([1.0, 0.0, 0.0])
        return size, float(np.sqrt(along @ covariance @ along))


def rate_design(offset: FloatArray) -> FloatArray:
    """Return displacements (N, 3, 9) of points by displacement, rotation, and strain in the plane."""
    x, y, z = offset.T
    none, one = np.zeros_like(x), np.ones_like(x)
    columns = [
        (one, none, none),
        (none, one, none),
        (none, none, one),
        (none, -z, y),
        (z, none, -x),
        (-y, x, none),
        (x, none, none),
        (none, y, none),
        (y, x, none),
    ]
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)


def apparent_field(start_m: FloatArray, displacement_m: FloatArray, along: FloatArray) -> ApparentField:
    """Return the apparent field of a plate moved along a stage or about an axis.

    Points (N, 3) have displacements (F, N, 3) over `along` (F,), in m or rad.
    """
    centred = along - along.mean()
    weights = centred / (centred @ centred)
    offset = start_m - start_m.mean(axis=0)
    axes = plate_axes(offset)
    slope = np.einsum("f,fni->ni", weights, displacement_m) @ axes
    offset = offset @ axes
    noise = local_noise(offset[:, :2], slope)
    design = rate_design(offset)
    whitened = (design / noise[:, None]).reshape(-1, RATES)
    covariance = np.asarray(np.linalg.inv(whitened.T @ whitened), dtype=np.float64)
    rates = np.asarray(covariance @ whitened.T @ (slope / noise).ravel())
    remainder = slope - np.einsum("nia,a->ni", design, rates)
    return ApparentField(axes, offset[:, :2], offset, slope, noise, rates, covariance, remainder)
