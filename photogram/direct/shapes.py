"""Shapes in which a body may deform beside its rigid motion, and their amplitudes as fitted to grey values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from photogram.arrays import Arrays, FloatArray, derivatives
from photogram.direct.surface import RATE_STEP, Patches, PlacedCamera, warps_of_points


class Shapes(Protocol):
    """Some shapes in which a body may deform, by their names, in the body's frame."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return what the S shapes are called."""

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (S, N, 3) of points (N, 3) at rest in shapes of amplitude 1, finite everywhere."""


PLAIN = ("bowl", "saddle", "twist", "breathing", "stretch", "shear")


@dataclass(frozen=True, eq=False, repr=False)
class PlainShapes(Arrays, shapes="middle_m 3; axes 3 3"):
    """The six ways in which a face bends or stretches that need no knowledge of it: second order across, first along.

    axes (3, 3): rows u and v along the face, n across it; reach_m: from its middle to its rim. With u, v in units of it
    the face moves across by u² + v² (bowl), u² − v² (saddle), 2uv (twist), along by (u, v) (breathing), (u, −v)
    (stretch), (v, u) (shear): an amplitude is what the rim does against the middle, in m.
    """

    middle_m: FloatArray
    axes: FloatArray
    reach_m: float

    @classmethod
    def of(cls, points_m: FloatArray) -> PlainShapes:
        """Return the shapes of a face by points (N, 3) of it; u is the frame's axis that lies most along the face."""
        known = points_m[np.isfinite(points_m).all(axis=1)]
        middle = known.mean(axis=0)
        normal = np.linalg.svd(known - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
        along = np.eye(3)[np.argmin(np.abs(normal))]
        along = along - (along @ normal) * normal
        along /= np.linalg.norm(along)
        reach = np.linalg.norm(known - middle, axis=1).max()
        return cls(middle, np.stack([along, np.cross(normal, along), normal]), float(reach))

    @property
    def names(self) -> tuple[str, ...]:
        """Return what the shapes are called."""
        return PLAIN

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (6, N, 3) of points (N, 3)."""
        u, v = ((points_m - self.middle_m) @ self.axes[:2].T / self.reach_m).T
        across, along = np.stack([u * u + v * v, u * u - v * v, 2.0 * u * v]), np.array([[u, v], [u, -v], [v, u]])
        return np.concatenate([across[..., None] * self.axes[2], np.einsum("skn,kc->snc", along, self.axes[:2])])


@dataclass(frozen=True, eq=False, repr=False)
class ShapeAmplitudes(Arrays, shapes="amplitude F S; covariance F S S; share 6 S"):
    """By how much a body deformed in its S `shapes` in each of F frames, fitted to the grey values beside its motion.

    amplitude (F, S) and covariance (F, S, S) of the frame's noise, NaN where the motion was not so fitted; the first
    frame is that against which deformation counts. They are uncorrelated with the motion, which is the one that
    explains the frame as rigid: where an amplitude is q, that contains share (6, S)·q, and the motion of the body
    beside the shape is what remains.
    """

    shapes: Shapes
    amplitude: FloatArray
    covariance: FloatArray
    share: FloatArray


def shape_rates(camera: PlacedCamera, patches: Patches, shapes: Shapes) -> FloatArray:
    """Return the derivatives (C, 6, S) of the patches' affine warps by the amplitudes of S shapes at rest."""
    shape = shapes(patches.points_m.reshape(-1, 3))
    moved = shape.reshape(len(shape), *patches.points_m.shape)

    def warps(amplitude: FloatArray) -> FloatArray:
        return warps_of_points(camera, patches, patches.points_m + np.tensordot(amplitude, moved, 1))

    return derivatives(warps, np.full(len(shape), RATE_STEP))
