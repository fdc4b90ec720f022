"""Shapes of a body's deformation, and their amplitudes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from photogram.direct.surface import RATE_STEP, Patches, PlacedCamera, warps_of_points
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.propagation import derivatives


class Shapes(Protocol):
    """Shapes in which a body may deform, by their names, in the body's frame."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the S shapes."""

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (S,N,3) of points (N,3) at rest in shapes of amplitude 1.

        It is finite everywhere.
        """


PLAIN = ("bowl", "saddle", "twist", "breathing", "stretch", "shear")


@dataclass(frozen=True, eq=False, repr=False)
class PlainShapes(Arrays, shapes="middle_m 3; axes 3 3"):
    """Six general shapes of a face: second order across it, first order along it.

    axes (3, 3): rows u and v along the face, n across it; reach_m: from its middle to its rim. With u, v in units of it
    the face moves across by u² + v² (bowl), u² − v² (saddle) or 2uv (twist). Along it, it moves by (u, v) (breathing),
    (u, −v) (stretch) or (v, u) (shear). An amplitude is the displacement of the rim against the middle, in m.
    """

    middle_m: FloatArray
    axes: FloatArray
    reach_m: float

    @classmethod
    def of(cls, points_m: FloatArray) -> PlainShapes:
        """Return the shapes of a face by points (N, 3) of it.

        u is the axis of the frame that lies most along the face.
        """
        finite = points_m[np.isfinite(points_m).all(axis=1)]
        middle = finite.mean(axis=0)
        normal = np.linalg.svd(finite - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
        along = np.eye(3)[np.argmin(np.abs(normal))]
        along = along - (along @ normal) * normal
        along /= np.linalg.norm(along)
        reach = np.linalg.norm(finite - middle, axis=1).max()
        return cls(middle, np.stack([along, np.cross(normal, along), normal]), float(reach))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shapes."""
        return PLAIN

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (6, N, 3) of points (N, 3)."""
        u, v = ((points_m - self.middle_m) @ self.axes[:2].T / self.reach_m).T
        across, along = np.stack([u * u + v * v, u * u - v * v, 2.0 * u * v]), np.array([[u, v], [u, -v], [v, u]])
        return np.concatenate([across[..., None] * self.axes[2], np.einsum("skn,kc->snc", along, self.axes[:2])])


@dataclass(frozen=True, eq=False, repr=False)
class ShapeAmplitudes(Arrays, shapes="amplitude F S; covariance F S S; share 6 S"):
    """Amplitudes of a body's S `shapes` in F frames, fitted to the grey values.

    amplitude (F, S) and covariance (F, S, S) of the frame's noise, NaN where the motion was not fitted to the grey
    values. The first frame is the reference of the deformation. The amplitudes are uncorrelated with the motion, which
    explains the frame as rigid: for an amplitude q it contains share (6, S)·q, and the remainder is the motion of the
    body without the shape.
    """

    shapes: Shapes
    amplitude: FloatArray
    covariance: FloatArray
    share: FloatArray


def shape_rates(camera: PlacedCamera, patches: Patches, shapes: Shapes) -> FloatArray:
    """Return the derivatives (C,6,S) of the patches' warps by the amplitudes of S shapes."""
    shape = shapes(patches.points_m.reshape(-1, 3))
    moved = shape.reshape(len(shape), *patches.points_m.shape)

    def warps(amplitude: FloatArray) -> FloatArray:
        return warps_of_points(camera, patches, patches.points_m + np.tensordot(amplitude, moved, 1))

    return derivatives(warps, np.full(len(shape), RATE_STEP))
