"""Rigid bodies about the sensor origin: mass matrix, gravity tilt, and what their uncertain parameters do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photogram.rigid import skew

FloatArray = NDArray[np.float64]

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
REFERENCE_DENSITY = 8000.0
REFERENCE_AIR_DENSITY = 1.2
INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Part:
    """A rigid part in the sensor frame, with standard uncertainties.

    `mass_kg`; `centre_of_mass_m` (3,); `inertia_kgm2` (3, 3) about its centre of mass; `u_mass_kg`;
    `u_centre_of_mass_m` (3,); `u_inertia_kgm2` (3, 3), one per entry.
    """

    name: str
    mass_kg: float
    centre_of_mass_m: FloatArray
    inertia_kgm2: FloatArray
    u_mass_kg: float
    u_centre_of_mass_m: FloatArray
    u_inertia_kgm2: FloatArray

    def __post_init__(self) -> None:
        for key, shape in (("centre_of_mass_m", (3,)), ("inertia_kgm2", (3, 3))):
            for name in (key, f"u_{key}"):
                found = np.shape(getattr(self, name))
                if found != shape:
                    raise ValueError(f"{name}: expected shape {shape}, found {found}")
        if not np.allclose(self.inertia_kgm2, self.inertia_kgm2.T, rtol=0.0, atol=1e-12):
            raise ValueError(f"inertia_kgm2: expected a symmetric matrix, found {self.inertia_kgm2.tolist()}")


def make_part(
    name: str,
    mass_kg: float,
    centre_of_mass_m: ArrayLike,
    inertia_kgm2: ArrayLike,
    uncertainties: tuple[float, ArrayLike, ArrayLike] = (0.0, 0.0, 0.0),
) -> Part:
    """Return a part from plain lists; one number as an uncertainty (mass, centre of mass, inertia) holds for all."""
    u_mass, u_centre, u_inertia = uncertainties
    return Part(
        name=name,
        mass_kg=float(mass_kg),
        centre_of_mass_m=np.array(centre_of_mass_m, dtype=np.float64),
        inertia_kgm2=np.array(inertia_kgm2, dtype=np.float64),
        u_mass_kg=float(u_mass),
        u_centre_of_mass_m=np.broadcast_to(np.asarray(u_centre, dtype=np.float64), (3,)).copy(),
        u_inertia_kgm2=np.broadcast_to(np.asarray(u_inertia, dtype=np.float64), (3, 3)).copy(),
    )


@dataclass(frozen=True)
class InertialTerms:
    """What a body, or the change of one, contributes to the equations of motion about the sensor origin.

    `mass_matrix` (6, 6): wrench = mass_matrix · [a, alpha] of the origin. `mass_kg` and `static_moment_kgm` (3,),
    the mass and mass times centre of mass, which gravity acts on.
    """

    mass_matrix: FloatArray
    mass_kg: float
    static_moment_kgm: FloatArray

    def load_matrix(self, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> FloatArray:
        """Return (K, 6, 6): wrench phasors = matrix · acceleration phasors, in body axes, with the tilt of gravity.

        With theta = -alpha/omega^2 the weight turns in body axes: F = m (theta × g), M = c × m (theta × g).
        """
        omega2 = (2.0 * np.pi * frequency_hz) ** 2
        matrix = np.repeat(self.mass_matrix[None], len(frequency_hz), axis=0)
        if gravity_mps2 is not None:
            weight = skew(gravity_mps2)
            tilt = np.concatenate([self.mass_kg * weight, skew(self.static_moment_kgm) @ weight])
            matrix[:, :, 3:] += tilt / omega2[:, None, None]
        return matrix


@dataclass(frozen=True)
class BodyParameter:
    """One uncertain number of a body: the first-order change of its terms for one standard uncertainty."""

    label: str
    change: InertialTerms


@dataclass(frozen=True)
class Body:
    """Rigidly joined parts that move as one."""

    parts: tuple[Part, ...]

    @property
    def terms(self) -> InertialTerms:
        """Sum of the parts' terms about the sensor origin."""
        terms = [_terms(part) for part in self.parts]
        return InertialTerms(
            mass_matrix=np.sum([term.mass_matrix for term in terms], axis=0),
            mass_kg=sum(term.mass_kg for term in terms),
            static_moment_kgm=np.sum([term.static_moment_kgm for term in terms], axis=0),
        )

    @property
    def mass_matrix(self) -> FloatArray:
        """Mass matrix (6, 6) about the sensor origin: F = m (a + alpha × c), M = c × F + J alpha."""
        return self.terms.mass_matrix

    def parameters(self) -> tuple[BodyParameter, ...]:
        """Return every parameter with an uncertainty: mass, centre of mass and inertia of each part."""
        return tuple(parameter for part in self.parts for parameter in _parameters(part))


def _terms(part: Part) -> InertialTerms:
    """Terms of one part about the sensor origin."""
    mass, lever = part.mass_kg, skew(part.centre_of_mass_m)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass * np.eye(3)
    matrix[:3, 3:] = -mass * lever
    matrix[3:, :3] = mass * lever
    matrix[3:, 3:] = part.inertia_kgm2 - mass * lever @ lever
    return InertialTerms(matrix, mass, mass * part.centre_of_mass_m)


def _parameters(part: Part) -> Iterator[BodyParameter]:
    """Changes of one part's terms, parameter by parameter."""
    if part.u_mass_kg > 0.0:
        point = make_part(part.name, part.u_mass_kg, part.centre_of_mass_m, np.zeros((3, 3)))
        yield BodyParameter(f"{part.name}: mass", _terms(point))
    for axis in range(3):
        if part.u_centre_of_mass_m[axis] > 0.0:
            yield BodyParameter(f"{part.name}: centre of mass", _centre_change(part, axis))
    for row, column in INERTIA_ENTRIES:
        if part.u_inertia_kgm2[row, column] > 0.0:
            matrix = np.zeros((6, 6))
            matrix[3 + row, 3 + column] = matrix[3 + column, 3 + row] = part.u_inertia_kgm2[row, column]
            yield BodyParameter(f"{part.name}: inertia", InertialTerms(matrix, 0.0, np.zeros(3)))


def _centre_change(part: Part, axis: int) -> InertialTerms:
    """First-order change when the centre of mass moves by its uncertainty along one axis."""
    shift = np.zeros(3)
    shift[axis] = part.u_centre_of_mass_m[axis]
    lever, change = skew(part.centre_of_mass_m), skew(shift)
    matrix = np.zeros((6, 6))
    matrix[:3, 3:] = -part.mass_kg * change
    matrix[3:, :3] = part.mass_kg * change
    matrix[3:, 3:] = -part.mass_kg * (lever @ change + change @ lever)
    return InertialTerms(matrix, 0.0, part.mass_kg * shift)
