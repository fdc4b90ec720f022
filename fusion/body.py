"""Rigid bodies about the sensor origin: mass matrix, gravity tilt, and what their uncertain parameters do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
REFERENCE_DENSITY = 8000.0
REFERENCE_AIR_DENSITY = 1.2
INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def cross_matrix(vector: ArrayLike) -> FloatArray:
    """Return the matrices [v]x (..., 3, 3) of vectors (..., 3), with [v]x w = v × w."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return matrix - matrix.swapaxes(-1, -2)


def true_mass(conventional_kg: float, density_kgm3: float) -> float:
    """Return the true mass (kg) of a body of `density_kgm3` whose conventional mass is given.

    m = m_c (1 - 1.2/8000) / (1 - 1.2/rho) (OIML D 28:2004, definition of the conventional mass).
    """
    if not density_kgm3 > REFERENCE_AIR_DENSITY:
        raise ValueError(f"density_kgm3: expected more than {REFERENCE_AIR_DENSITY} kg/m^3, found {density_kgm3}")
    buoyancy = 1.0 - REFERENCE_AIR_DENSITY / REFERENCE_DENSITY
    return conventional_kg * buoyancy / (1.0 - REFERENCE_AIR_DENSITY / density_kgm3)


@dataclass(frozen=True)
class Part:
    """A rigid part in the sensor frame, with standard uncertainties.

    `mass_kg`; `centre_of_mass_m` (3,); `inertia_kgm2` (3, 3) about its centre of mass; `u_mass_kg`;
    `u_centre_of_mass_m` (3,); `u_inertia_kgm2` (3, 3) per entry, symmetric.
    """

    name: str
    mass_kg: float
    centre_of_mass_m: FloatArray
    inertia_kgm2: FloatArray
    u_mass_kg: float
    u_centre_of_mass_m: FloatArray
    u_inertia_kgm2: FloatArray

    def __post_init__(self) -> None:
        for name, shape in (("centre_of_mass_m", (3,)), ("inertia_kgm2", (3, 3))):
            for key in (name, "u_" + name):
                array = np.asarray(getattr(self, key), dtype=np.float64)
                if key.startswith("u_"):
                    array = np.broadcast_to(array, shape).copy()
                if array.shape != shape:
                    raise ValueError(f"{key}: expected shape {shape}, found {array.shape}")
                object.__setattr__(self, key, array)
        if not np.allclose(self.inertia_kgm2, self.inertia_kgm2.T, rtol=0.0, atol=1e-12):
            raise ValueError(f"inertia_kgm2: expected a symmetric matrix, found {self.inertia_kgm2.tolist()}")


class InertialEntry(Protocol):
    """What a `[load]` or `[[part]]` table of a rig states about one rigid part."""

    @property
    def mass(self) -> float: ...  # noqa: D102


@dataclass(frozen=True)
class BodyParameter:
    """One uncertain number of a body.

    `mass` (6, 6) and `moment` (6,): change of the mass matrix, and of the static moments [m, m c] (4,), for one
    standard uncertainty. `label` groups the entries of a budget.
    """

    label: str
    mass: FloatArray
    moment: FloatArray


@dataclass(frozen=True)
class Body:
    """Rigidly joined parts seen as one body."""

    parts: tuple[Part, ...]
