"""The cross-beam element as a chain of oscillators and as a frame of Timoshenko beams."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, check_shape
from shaker.elastomer.geometry import Material, Section, beam_matrices, lumped
from shaker.mechanics import MassChain

# Natural frequencies and shapes, named after the motion of the moving parts that carries most of their mass.


NAMES = ("Tx", "Ty", "Tz", "Rx", "Ry", "Rz")
"""Translations along and rotations about the axes."""
EQUAL = 1e-4
"""Relative distance below which frequencies count as one, of a symmetric element's pairs."""


@dataclass(frozen=True)
class Modes:
    """The six modes that are named, in the order of `NAMES`.

    `frequency_hz` (6,). `participation` (6, 6): share of each rigid motion's mass that moves in each mode, modes down,
    `NAMES` across: (φᵀMr)²/(rᵀMr) with φᵀMφ = 1, translations r of all moving parts and turns about their common
    centre. `shape` (D, 6): the unknowns of every mode. `others_hz`: modes in between that are none of the six.
    """

    frequency_hz: FloatArray
    participation: FloatArray
    shape: FloatArray
    others_hz: FloatArray

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (6,))
        check_shape("participation", self.participation, (6, 6))
        check_shape("shape", self.shape, (None, 6))
        check_shape("others_hz", self.others_hz, (None,))


def dense_modes(stiffness: FloatArray, mass: FloatArray, count: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return the lowest frequencies in Hz (K,) and shapes (D, K) with φᵀMφ = 1 of K φ = ω² M φ."""
    from scipy.linalg import eigh

    last = min(count, len(stiffness)) - 1
    squared, shape = eigh(stiffness, mass, subset_by_index=[0, last])
    return np.sqrt(np.maximum(squared, 0.0)) / (2.0 * np.pi), shape


def named_modes(
    frequency_hz: FloatArray, shape: FloatArray, weigh: Callable[[FloatArray], FloatArray], rigid: FloatArray
) -> Modes:
    """Return modes (K,), (D, K) with the name each deserves: as a whole the assignment of the most mass.

    `weigh`: multiplies by the mass matrix. `rigid` (D, 6): translations, and turns about the centre of mass. Modes of
    one frequency, of which any mixture is one, are mixed so that each follows one axis. The sign is such that the
    motion a mode is named after is positive.
    """
    weighed = weigh(rigid)
    total = np.einsum("ij,ij->j", rigid, weighed)
    factor = shape.T @ weighed / np.sqrt(total)
    for group in _groups(frequency_hz):
        turn = _along_axes(factor[group])
        shape = shape.copy()
        shape[:, group] = shape[:, group] @ turn
        factor[group] = turn.T @ factor[group]
    chosen = assigned(factor)
    sign = np.where(factor[chosen, np.arange(6)] < 0.0, -1.0, 1.0)
    between = np.setdiff1d(np.arange(chosen.max() + 1), chosen)
    return Modes(frequency_hz[chosen], factor[chosen] ** 2, shape[:, chosen] * sign, frequency_hz[between])


def assigned(factor: FloatArray) -> IntArray:
    """Return which mode deserves each name (N,), given how modes take part (K, N): the most mass as a whole."""
    from scipy.optimize import linear_sum_assignment

    return np.asarray(linear_sum_assignment(-(np.asarray(factor) ** 2).T)[1])


def centre_of_mass(weigh: Callable[[FloatArray], FloatArray], about_origin: FloatArray) -> FloatArray:
    """Return the common centre (3,) of what moves, from its rigid motions (D, 6) about the origin."""
    matrix = about_origin.T @ weigh(about_origin)
    mass, turned = matrix[2, 2], matrix[:3, 3:]
    return np.array([-turned[2, 1] / mass, turned[2, 0] / mass, turned[0, 1] / matrix[0, 0]])


def _groups(frequency_hz: FloatArray) -> list[list[int]]:
    """Neighbouring modes of one frequency, two or more."""
    groups = [[0]]
    for k in range(1, len(frequency_hz)):
        if frequency_hz[k] - frequency_hz[k - 1] <= EQUAL * frequency_hz[k]:
            groups[-1].append(k)
        else:
            groups.append([k])
    return [group for group in groups if len(group) > 1]


def _along_axes(factor: FloatArray) -> FloatArray:
    """Rotation (G, G) of modes of one frequency after which each takes part (G, 6) in one axis as far as it can."""
    from scipy.linalg import polar, qr

    axes = np.sort(qr(factor, pivoting=True, mode="r")[1][: len(factor)])
    return np.asarray(polar(factor[:, axes])[0])


# The mounted sensor as oscillators in a row: hand on sensor on pedestal.


STAGES = ("pedestal", "sensor", "hand")


@dataclass(frozen=True)
class MountedChain:
    """Hand, elastic element and pedestal along one direction, each (3,) in this order of the publication.

    `mass_kg` m_h, m_t, m_k (kg·m² about an axis), `stiffness` k_h, k_t, k_k of the spring that joins each to the next,
    the pedestal's to the ground, `damping` likewise. A hand of no mass, with the mass zero, is left out.
    """

    mass_kg: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        for name in ("mass_kg", "stiffness", "damping"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or np.any(value < 0.0):
                raise ValueError(f"{name}: expected 3 numbers, none negative, found {value.tolist()}")
            object.__setattr__(self, name, value)
        if np.any(self.mass_kg[1:] == 0.0) or np.any(self.stiffness == 0.0):
            raise ValueError("mass_kg, stiffness: expected above 0 for sensor, pedestal and every spring, found 0")

    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return M, C, K (3, 3) of M ü + C u̇ + K u = 0, u = (u_h, u_t, u_k), equation 14 put right.

        C has -c_h, not -c_k, in row 1, and -c_t, not 0, in row 2, column 3: K's pattern, without which it is not
        symmetric and a rigid motion of all three would be damped between them.
        """
        return np.diag(self.mass_kg), _chained(self.damping), _chained(self.stiffness)

    def impedance(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return Z(ω) = -ω²M + jωC + K (N, 3, 3), equation 16 put right as `matrices`."""
        mass, damping, stiffness = self.matrices()
        omega = 2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None, None]
        return np.asarray(-(omega**2) * mass + 1j * omega * damping + stiffness)

    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Return f₀ = |s|/2π in Hz and ζ (N,) of the roots s of det Z = 0, ascending.

        These, not the eigenvalues of Z at some frequency, are the natural frequencies; damped f_d = f₀√(1 - ζ²).
        """
        return self._chain().modes()

    def _chain(self) -> MassChain:
        """The same from the ground upwards, without a hand that has no mass."""
        count = 3 if self.mass_kg[0] > 0.0 else 2
        mass, stiffness, damping = (x[::-1][:count] for x in (self.mass_kg, self.stiffness, self.damping))
        return MassChain(STAGES[:count], mass, stiffness, damping)


def mounted_hz(stiffness: float, sensor_kg: float, hand_kg: FloatArray) -> FloatArray:
    """Return the mounted resonance in Hz (N,) over the mass of a rigidly joined hand (N,), equation 17.

    f = √(k/(m_h + m_t))/2π.
    """
    total = np.asarray(hand_kg, dtype=np.float64) + sensor_kg
    if stiffness <= 0.0 or np.any(total <= 0.0):
        raise ValueError("stiffness, sensor_kg: expected above 0 with every hand, found 0 or less")
    return np.asarray(np.sqrt(stiffness / total) / (2.0 * np.pi))


def _chained(value: FloatArray) -> FloatArray:
    """Tridiagonal matrix (3, 3) of elements between neighbours (3,), the last one to the ground."""
    h, t, k = value
    return np.array([[h, -h, 0.0], [-h, h + t, -t], [0.0, -t, t + k]])


# Rigid bodies of the element: the platform and what stands on it, as mass, height and inertia.


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


# A frame of beams in space with one rigid body and clamped ends: assembly and reduction.


@dataclass(frozen=True)
class Frame:
    """Beams between nodes: `node_m` (N, 3), `beam` (E, 2) node numbers, `section` of every beam.

    `rigid` (R,): nodes that move with a body whose point of reference is the origin; `clamped` (C,). Local z of every
    beam is the global one, so no beam may stand upright. `consistent`: mass matrix, else lumped at the ends.
    """

    node_m: FloatArray
    beam: IntArray
    section: Sequence[Section]
    material: Material
    shear_factor: float
    rigid: IntArray
    clamped: IntArray
    consistent: bool = True

    def __post_init__(self) -> None:
        check_shape("node_m", self.node_m, (None, 3))
        check_shape("beam", self.beam, (len(self.section), 2))
        check_shape("rigid", self.rigid, (None,))
        check_shape("clamped", self.clamped, (None,))
        if np.intersect1d(self.rigid, self.clamped).size:
            raise ValueError("rigid, clamped: expected different nodes, found some in both")

    @cached_property
    def reduction(self) -> FloatArray:
        """T (6N, F): motion of all nodes from the unknowns, the body's (ux uy uz rx ry rz) at the origin first."""
        count = len(self.node_m)
        free = np.setdiff1d(np.arange(count), np.concatenate([self.rigid, self.clamped]))
        first = 6 if len(self.rigid) else 0
        matrix = np.zeros((6 * count, first + 6 * len(free)))
        for place, node in enumerate(free):
            column = first + 6 * place
            matrix[6 * node : 6 * node + 6, column : column + 6] = np.eye(6)
        for node in self.rigid:
            matrix[6 * node : 6 * node + 6, :6] = rigid_motion(self.node_m[node])
        return matrix

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Stiffness and mass (F, F) of the beams over the unknowns."""
        size = 6 * len(self.node_m)
        stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
        for ends, section in zip(self.beam, self.section, strict=True):
            places = (6 * ends[:, None] + np.arange(6)).ravel()
            elastic, inert = self._turned(ends, section)
            stiffness[np.ix_(places, places)] += elastic
            mass[np.ix_(places, places)] += inert
        reduced = (self.reduction.T @ whole @ self.reduction for whole in (stiffness, mass))
        elastic, inert = (0.5 * (matrix + matrix.T) for matrix in reduced)
        return elastic, inert

    def rigid_motions(self, about_m: FloatArray) -> FloatArray:
        """Return the unknowns (F, 6) of unit translations and of unit turns about a point (3,), clamps let go."""
        return self._about_origin @ rigid_motion(-np.asarray(about_m))

    @cached_property
    def _about_origin(self) -> FloatArray:
        """The rigid motions (F, 6) about the origin; those about a point are the same after a shift of it."""
        whole = np.concatenate([rigid_motion(node) for node in self.node_m])
        moved = self.reduction.T @ whole
        if len(self.rigid):
            moved[:6] = np.eye(6)
        return np.asarray(moved)

    def _turned(self, ends: IntArray, section: Section) -> tuple[FloatArray, FloatArray]:
        """Stiffness and mass (12, 12) of one beam in global axes."""
        along = self.node_m[ends[1]] - self.node_m[ends[0]]
        length = float(np.linalg.norm(along))
        elastic, inert = beam_matrices(self.material, section, length, self.shear_factor)
        inert = inert if self.consistent else lumped(inert)
        x, z = along / length, np.array([0.0, 0.0, 1.0])
        turn = np.kron(np.eye(4), np.stack([x, np.cross(z, x), z]))
        return turn.T @ elastic @ turn, turn.T @ inert @ turn


def rigid_motion(offset_m: FloatArray) -> FloatArray:
    """Return the motion (6, 6) of a point at an offset (3,) per motion (ux uy uz rx ry rz) of the origin."""
    x, y, z = offset_m
    matrix = np.eye(6)
    matrix[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return matrix
