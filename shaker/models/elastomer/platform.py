"""Rigid bodies of the element: the platform and what stands on it, as mass, height and inertia."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape


@dataclass(frozen=True)
class RigidPart:
    """A rigid body on the axis of the element: `mass_kg`, `height_m` of its centre of mass, `inertia_kgm2` (3,).

    Heights count along z from the plane of the beams' axes, moments of inertia Jx, Jy, Jz about the body's own centre.
    """

    mass_kg: float
    height_m: float
    inertia_kgm2: FloatArray

    def __post_init__(self) -> None:
        inertia = np.asarray(self.inertia_kgm2, dtype=np.float64)
        check_shape("inertia_kgm2", inertia, (3,))
        object.__setattr__(self, "inertia_kgm2", inertia)
        if self.mass_kg < 0.0 or np.any(inertia < 0.0):
            found = f"{self.mass_kg} kg, {inertia.tolist()} kg.m2"
            raise ValueError(f"mass_kg, inertia_kgm2: expected none negative, found {found}")

    @property
    def gyration_m(self) -> FloatArray:
        """Radii of gyration √(J/m) (3,)."""
        return np.asarray(np.sqrt(self.inertia_kgm2 / self.mass_kg))

    @property
    def mass_matrix(self) -> FloatArray:
        """Mass matrix (6, 6) over (ux uy uz rx ry rz) of the point in the plane of the beams."""
        m, h = self.mass_kg, self.height_m
        matrix = np.diag(np.concatenate([[m, m, m], self.inertia_kgm2 + m * h**2 * np.array([1.0, 1.0, 0.0])]))
        matrix[0, 4] = matrix[4, 0] = m * h
        matrix[1, 3] = matrix[3, 1] = -m * h
        return matrix


def block(density_kgm3: float, half_size_m: float, thickness_m: float, height_m: float = 0.0) -> RigidPart:
    """Return a square block of edge 2p and thickness H, its centre at a height."""
    edge = 2.0 * half_size_m
    mass = density_kgm3 * edge**2 * thickness_m
    across = mass * (edge**2 + thickness_m**2) / 12.0
    return RigidPart(mass, height_m, np.array([across, across, mass * edge**2 / 6.0]))


def pillar(density_kgm3: float, radius_m: float, length_m: float, foot_m: float) -> RigidPart:
    """Return an upright cylinder that stands at a height `foot_m`."""
    mass = density_kgm3 * np.pi * radius_m**2 * length_m
    across = mass * (3.0 * radius_m**2 + length_m**2) / 12.0
    return RigidPart(mass, foot_m + 0.5 * length_m, np.array([across, across, 0.5 * mass * radius_m**2]))


def joined(parts: Sequence[RigidPart]) -> RigidPart:
    """Return the one body that several make (Steiner's theorem)."""
    mass = sum(part.mass_kg for part in parts)
    if not mass > 0.0:
        raise ValueError("parts: expected a mass above 0, found none")
    height = sum(part.mass_kg * part.height_m for part in parts) / mass
    offsets = np.array([1.0, 1.0, 0.0])
    inertia = [part.inertia_kgm2 + part.mass_kg * (part.height_m - height) ** 2 * offsets for part in parts]
    return RigidPart(mass, height, np.sum(inertia, axis=0))
