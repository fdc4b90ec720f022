"""The frame of a cross-beam element: four arms, four compliant beams, a rigid platform."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from shaker._checks import FloatArray
from shaker.models.elastomer.frame import Frame
from shaker.models.elastomer.geometry import CrossBeams
from shaker.models.elastomer.platform import RigidPart

SAME_M = 1e-9
"""Nodes nearer than this are one."""


def cross_frame(beams: CrossBeams, half_size_m: float, pieces: int = 6, consistent: bool = True) -> Frame:
    """Return the frame: arms from the faces of a platform of edge 2p to the axes of the compliant beams.

    The platform lies within the span: arms are l/2 - p long and begin at its faces, which move with it. `pieces`: into
    which every arm and every half of a compliant beam is divided.
    """
    beams.arm_m(half_size_m)
    outer, half = 0.5 * beams.span_m, 0.5 * beams.compliant_length_m
    nodes: list[FloatArray] = []
    pairs: list[tuple[int, int]] = []
    sections, rigid, clamped = [], [], []
    for quarter in range(4):
        x = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]][quarter] + [0.0])
        y = np.array([-x[1], x[0], 0.0])
        arm = _numbered(nodes, [x * r for r in np.linspace(half_size_m, outer, pieces + 1)])
        bar = _numbered(nodes, [x * outer + y * s for s in np.linspace(-half, half, 2 * pieces + 1)])
        for line, section in ((arm, beams.beam), (bar, beams.compliant)):
            pairs += pairwise(line)
            sections += [section] * (len(line) - 1)
        rigid.append(arm[0])
        clamped += [bar[0], bar[-1]]
    return Frame(
        node_m=np.array(nodes),
        beam=np.array(pairs),
        section=tuple(sections),
        material=beams.material,
        shear_factor=beams.shear_factor,
        rigid=np.unique(rigid),
        clamped=np.array(clamped),
        consistent=consistent,
    )


def frame_matrices(frame: Frame, platform: RigidPart) -> tuple[FloatArray, FloatArray]:
    """Return stiffness and mass (F, F) of a frame whose body is the platform."""
    stiffness, mass = frame.matrices
    mass = mass.copy()
    mass[:6, :6] += platform.mass_matrix
    return stiffness, mass


def platform_stiffness(frame: Frame) -> FloatArray:
    """Return 1/C_ii (6,): load per displacement in its own direction, nothing else being held.

    Forces in N/m, moments in N·m/rad, at the origin, which is in the plane of the beams' axes.
    """
    stiffness, _ = frame.matrices
    loads = np.eye(len(stiffness))[:, :6]
    return np.asarray(1.0 / np.diag(np.linalg.solve(stiffness, loads)[:6]))


def _numbered(nodes: list[FloatArray], places: list[FloatArray]) -> list[int]:
    """Numbers of nodes at some places, which are added where no node is yet."""
    found = []
    for place in places:
        near = [i for i, node in enumerate(nodes) if np.linalg.norm(node - place) < SAME_M]
        if not near:
            nodes.append(place)
        found.append(near[0] if near else len(nodes) - 1)
    return found
