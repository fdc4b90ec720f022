"""Cross-beam element as an elastic solid of quadratic hexahedra, with elastic joints and plates.

Requires scikit-fem (`pip install shakercal[solid]`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from shaker.elastomer.frame import MODE_NAMES, RigidPart, assign_names, rigid_motion
from shaker.elastomer.geometry import CrossBeams
from shakercal._common.arrays import Arrays, FloatArray, IntArray

PARITIES = {"vertical": (False, False), "sideways": (True, False), "turning": (True, True)}
"""Whether the motion is mirrored with reversed sign in the planes x = 0 and y = 0."""
NAMED = {"vertical": ("Tz",), "sideways": ("Tx", "Ry"), "turning": ("Rz",)}
"""Rigid motions of each kind; Ty and Rx are Tx and Ry mirrored in the diagonal."""
COARSE_LENGTH = 6.0
"""Longest edge of the coarsest mesh over the thinnest section; longer elements are too stiff in bending."""
COUNT = 6
"""Number of computed modes of each kind."""


@dataclass(frozen=True)
class SolidBlock:
    """The elastic platform: a block of edge 2·`half_size_m`, `thickness_m` high, centre at `height_m`.

    `density_kgm3` of the block, 0 if `attached` includes its mass. `attached`: rigid parts that follow the block's mean
    motion. `stiffening`: factor on the block's modulus; a large one shows the effect of a rigid platform.
    """

    half_size_m: float
    thickness_m: float
    height_m: float
    density_kgm3: float
    attached: RigidPart | None = None
    stiffening: float = 1.0

    def __post_init__(self) -> None:
        if not (self.half_size_m > 0.0 and self.thickness_m > 0.0 and self.density_kgm3 >= 0.0):
            found = f"{self.half_size_m} m, {self.thickness_m} m, {self.density_kgm3} kg/m3"
            raise ValueError(f"half_size_m, thickness_m, density_kgm3: expected sizes above 0, found {found}")
        if self.density_kgm3 == 0.0 and self.attached is None:
            raise ValueError("attached: expected the mass of a block without density, found none")


@dataclass(frozen=True, repr=False)
class SolidModel(Arrays):
    """Solution on one mesh: `frequency_hz`, `stiffness` (6,) in the order of `MODE_NAMES`.

    `stiffness`: load per mean displacement or rotation of the platform in N/m, N·m/rad. `unknowns` of the whole
    element. `vertex_m` (V, 3), `cell` (C, 8) of the quarter x, y ≥ 0, `motion` (6, V, 3) of its vertices in every mode.
    """

    frequency_hz: FloatArray
    stiffness: FloatArray
    unknowns: int
    vertex_m: FloatArray
    cell: IntArray
    motion: FloatArray


def solve_solid(beams: CrossBeams, block: SolidBlock, refinement: int = 2) -> SolidModel:
    """Return frequencies and stiffness of the solid.

    Edges are at most 6/`refinement` times the thinnest section. By two planes of symmetry a quarter is solved once for
    each kind of motion. The sides of the compliant beams' ends are clamped, as if welded to rigid rims.
    """
    quarter = _Quarter(beams, block, refinement)
    frequency, stiffness, motion = {}, {}, {}
    for kind, names in NAMED.items():
        hertz, shapes, rigid_stiffness = quarter.solve(kind)
        for index, name in enumerate(names):
            frequency[name], motion[name], stiffness[name] = hertz[index], shapes[index], rigid_stiffness[index]
    for name, like in (("Ty", "Tx"), ("Rx", "Ry")):
        frequency[name], stiffness[name] = frequency[like], stiffness[like]
        motion[name] = quarter.mirrored(motion[like]) * (1.0 if name == "Ty" else -1.0)
    return SolidModel(
        frequency_hz=np.array([frequency[name] for name in MODE_NAMES]),
        stiffness=np.array([stiffness[name] for name in MODE_NAMES]),
        unknowns=12 * quarter.basis.N,
        vertex_m=np.ascontiguousarray(quarter.mesh.p.T),
        cell=np.ascontiguousarray(quarter.mesh.t.T),
        motion=np.stack([motion[name] for name in MODE_NAMES]),
    )


def mesh_change(models: tuple[SolidModel, ...]) -> FloatArray:
    """Return the relative change (6,) of the frequencies between the last two meshes."""
    if len(models) < 2:
        raise ValueError(f"models: expected two meshes or more, found {len(models)}")
    return np.asarray(models[-1].frequency_hz / models[-2].frequency_hz - 1.0)


class _Quarter:
    """Mesh and matrices of the quarter x, y ≥ 0."""

    def __init__(self, beams: CrossBeams, block: SolidBlock, refinement: int) -> None:
        _check_mesh(beams, block)
        self.beams, self.block = beams, block
        self.mesh, self.platform = _mesh(beams, block, refinement)

    @cached_property
    def basis(self) -> Any:
        """Quadratic functions of all three coordinates, the same for every component of the displacement."""
        from skfem import Basis, ElementHex2

        return Basis(self.mesh, ElementHex2(), intorder=4)

    @cached_property
    def matrices(self) -> tuple[Any, Any, Any]:
        """Stiffness, mass, and the platform's geometry (mass at unit density)."""
        from skfem.models.elasticity import lame_parameters

        material = self.beams.material
        lame = lame_parameters(material.youngs_modulus_pa, material.poisson_ratio)
        stiffening = np.where(self.platform, self.block.stiffening, 1.0)
        density = np.where(self.platform, self.block.density_kgm3, material.density_kgm3)
        stiffness = self._assembled(_elastic(self.basis, *lame) * stiffening[:, None, None, None, None])
        product = _inert(self.basis)
        mass, geometry = (
            self._assembled(product * weight[:, None, None, None, None])
            for weight in (density, self.platform.astype(np.float64))
        )
        return stiffness.tocsc(), mass.tocsr(), geometry.tocsr()

    def _assembled(self, local: FloatArray) -> Any:
        """Return the sparse matrix of the matrices (C, L, 3, L, 3) of all cells."""
        from scipy.sparse import coo_matrix

        unknown = 3 * self.basis.element_dofs.T[:, :, None] + np.arange(3)
        row = np.broadcast_to(unknown[:, :, :, None, None], local.shape)
        column = np.broadcast_to(unknown[:, None, None, :, :], local.shape)
        size = 3 * self.basis.N
        return coo_matrix((local.ravel(), (row.ravel(), column.ravel())), shape=(size, size))

    def solve(self, kind: str) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        """Return the modes of one kind: Hz, motion of vertices (V, 3), stiffness."""
        from scipy.sparse.linalg import LinearOperator, eigsh, splu

        stiffness, mass, geometry = self.matrices
        free = self._free(kind)
        indices = [MODE_NAMES.index(name) for name in NAMED[kind]]
        rigid = np.concatenate([rigid_motion(point)[:3] for point in self.basis.doflocs.T])[:, indices]
        weighed = geometry @ rigid
        mean = (weighed @ np.linalg.inv(rigid.T @ weighed))[free]
        part = self.block.attached
        extra = np.zeros((len(indices),) * 2) if part is None else part.mass_matrix[np.ix_(indices, indices)] / 4.0
        inert = mass[free][:, free]
        solver = splu(stiffness[free][:, free], permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        size = len(free)

        def weigh(motion: FloatArray) -> FloatArray:
            return np.asarray(inert @ motion + mean @ (extra @ (mean.T @ motion)))

        squared, shape = eigsh(
            stiffness[free][:, free],
            k=COUNT,
            M=LinearOperator((size, size), matvec=weigh, dtype=np.float64),
            sigma=0.0,
            OPinv=LinearOperator((size, size), matvec=solver.solve, dtype=np.float64),
            v0=solver.solve(mean.sum(axis=1)),
        )
        factor = shape.T @ weigh(_normalised(rigid[free], weigh))
        chosen = assign_names(factor)
        sign = np.where(factor[chosen, np.arange(len(chosen))] < 0.0, -1.0, 1.0)
        whole = np.zeros((3 * self.basis.N, len(chosen)))
        whole[free] = shape[:, chosen] * sign
        vertices = self.basis.nodal_dofs[0]
        motion = [column.reshape(-1, 3)[vertices] for column in whole.T]
        compliance = np.diag(mean.T @ solver.solve(mean)) / 4.0
        return np.sqrt(squared[chosen]) / (2.0 * np.pi), motion, 1.0 / compliance

    def mirrored(self, motion: FloatArray) -> FloatArray:
        """Return the motion (V, 3) of vertices mirrored in the diagonal x = y."""
        points = self.mesh.p.T
        key = np.round(points * 1e9).astype(np.int64)
        index = {tuple(row): i for i, row in enumerate(key.tolist())}
        other = np.array([index[y, x, z] for x, y, z in key.tolist()])
        return np.asarray(motion[other][:, [1, 0, 2]])

    def _free(self, kind: str) -> IntArray:
        """Return the unknowns without clamp or symmetry condition."""
        beams, near = self.beams, 1e-9
        inner, half = 0.5 * (beams.span_m - beams.compliant_thickness_m), 0.5 * beams.compliant_length_m
        x, y, _ = point = np.asarray(self.basis.doflocs)  # node n has the unknowns 3n, 3n + 1, 3n + 2
        clamped = (np.abs(y - half) < near) & (x > inner - near) | (np.abs(x - half) < near) & (y > inner - near)
        fixed = np.repeat(clamped[:, None], 3, axis=1)
        for axis, reversed_sign in enumerate(PARITIES[kind]):
            plane = np.abs(point[axis]) < near
            normal = np.arange(3) == axis
            fixed |= plane[:, None] & (~normal if reversed_sign else normal)
        return np.flatnonzero(~fixed.ravel())


def _elastic(basis: Any, first: float, second: float) -> FloatArray:
    """Return the stiffness (C, L, 3, L, 3) of every cell.

    ∫ λ ∂_a N_i ∂_b N_j + μ (∂_b N_i ∂_a N_j + δ_ab ∇N_i·∇N_j) dV.
    """
    gradient = np.stack([field.grad for (field,) in basis.basis])
    functions, axes, cells, points = gradient.shape
    flat = gradient.reshape(functions * axes, cells, points).transpose(1, 0, 2)
    product = (flat * basis.dx[:, None, :]) @ flat.transpose(0, 2, 1)
    product = product.reshape(cells, functions, axes, functions, axes)
    dot = np.einsum("eiaja->eij", product)
    local = first * product + second * product.transpose(0, 1, 4, 3, 2)
    for axis in range(axes):
        local[:, :, axis, :, axis] += second * dot
    return np.asarray(local)


def _inert(basis: Any) -> FloatArray:
    """Return the mass (C, L, 3, L, 3) of every cell at unit density."""
    value = np.stack([np.broadcast_to(np.asarray(field), basis.dx.shape) for (field,) in basis.basis], axis=1)
    product = (value * basis.dx[:, None, :]) @ value.transpose(0, 2, 1)
    local = np.zeros((*product.shape[:2], 3, product.shape[2], 3))
    for axis in range(3):
        local[:, :, axis, :, axis] = product
    return local


def _normalised(rigid: FloatArray, weigh: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return rigid motions (N, k) of mass 1, rotations about the centre of mass."""
    motions = rigid.copy()
    for column in range(rigid.shape[1]):
        for other in range(column):
            motions[:, column] -= motions[:, other] * (motions[:, other] @ weigh(rigid[:, column]))
        motions[:, column] /= np.sqrt(motions[:, column] @ weigh(motions[:, column]))
    return motions


def _check_mesh(beams: CrossBeams, block: SolidBlock) -> None:
    """Refuse sizes for which parts would not meet or would overlap."""
    clear = beams.span_m - beams.compliant_thickness_m
    if beams.compliant_length_m > clear:
        expected = f"at most {clear} m, where compliant beams meet"
        raise ValueError(f"compliant_length_m: expected {expected}, found {beams.compliant_length_m} m")
    if 0.5 * beams.beam_width_m > min(block.half_size_m, 0.5 * beams.compliant_length_m):
        expected = "no more than platform and compliant beams"
        raise ValueError(f"beam_width_m: expected {expected}, found {beams.beam_width_m} m")
    if block.half_size_m >= 0.5 * clear:
        expected = f"below {0.5 * clear} m, where the compliant beams are"
        raise ValueError(f"half_size_m: expected {expected}, found {block.half_size_m} m")
    if abs(block.height_m) >= 0.5 * (block.thickness_m + beams.beam_height_m):
        expected = "a block that the beams reach"
        raise ValueError(f"height_m: expected {expected}, found its centre at {block.height_m} m")


def _mesh(beams: CrossBeams, block: SolidBlock, refinement: int) -> tuple[Any, Any]:
    """Return the mesh of the quarter, and the mask (C,) of the platform's cells."""
    from skfem import MeshHex

    inner, outer = (0.5 * (beams.span_m + sign * beams.compliant_thickness_m) for sign in (-1.0, 1.0))
    side, half, across = block.half_size_m, 0.5 * beams.compliant_length_m, 0.5 * beams.beam_width_m
    low, high = (block.height_m + sign * 0.5 * block.thickness_m for sign in (-1.0, 1.0))
    thinnest = min(beams.compliant_thickness_m, beams.beam_width_m, beams.beam_height_m, beams.compliant_height_m)
    longest = COARSE_LENGTH * thinnest / refinement
    flat = _divided({0.0, across, side, half, inner, outer}, longest)
    tops = {sign * 0.5 * size for sign in (-1.0, 1.0) for size in (beams.beam_height_m, beams.compliant_height_m)}
    mesh = MeshHex.init_tensor(flat, flat, _divided({*tops, low, high}, longest))
    x, y, z = mesh.p[:, mesh.t].mean(axis=1)
    platform = (x < side) & (y < side) & (z > low) & (z < high)
    inside = platform.copy()
    for along, across_axis in ((x, y), (y, x)):
        inside |= (along < inner) & (across_axis < across) & (np.abs(z) < 0.5 * beams.beam_height_m) & (along > side)
        compliant = (along > inner) & (along < outer) & (across_axis < half)
        inside |= compliant & (np.abs(z) < 0.5 * beams.compliant_height_m)
    cells = np.flatnonzero(inside)
    return mesh.restrict(cells), platform[cells]


def _divided(breaks: set[float], longest: float) -> FloatArray:
    """Return grid lines through all breaks, at most `longest` apart."""
    ends = np.unique(np.round(sorted(breaks), 12))
    parts = [ends[:1]]
    for start, stop in pairwise(ends):
        pieces = int(np.ceil((stop - start) / longest * (1.0 - 1e-9)))
        parts.append(np.linspace(start, stop, pieces + 1)[1:])
    return np.concatenate(parts)
