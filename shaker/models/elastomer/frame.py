"""A frame of beams in space with one rigid body and clamped ends: assembly and reduction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.models.elastomer.beam import beam_matrices, lumped
from shaker.models.elastomer.geometry import Material, Section


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
