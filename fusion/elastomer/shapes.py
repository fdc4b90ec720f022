"""Mode shapes as faces in space, for the pictures: beams and platform of the frame, the outside of the solid."""

from __future__ import annotations

import numpy as np

from fusion.elastomer.definition import Definition
from fusion.elastomer.result import FloatArray
from fusion.plots.elastomer import Shape
from shaker.models.elastomer.element import FrameModel
from shaker.models.elastomer.frame import rigid_motion
from shaker.models.elastomer.geometry import Section
from shaker.models.elastomer.modes import NAMES
from shaker.models.elastomer.solid import SolidModel

SIDES = ((0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5), (0, 1, 3, 2), (4, 5, 7, 6))
"""Faces of a box by its corners, numbered with the bits of x, y, z."""
PLATFORM_PARTS = 4
"""Tiles along each edge of the platform, so that its colours show how it turns."""
REVERSED = {
    "Tx": (True, False),
    "Ry": (True, False),
    "Ty": (False, True),
    "Rx": (False, True),
    "Tz": (False, False),
    "Rz": (True, True),
}
"""Modes whose motion is mirrored with reversed sign in the planes x = 0 and y = 0."""


def frame_shapes(definition: Definition, model: FrameModel) -> list[Shape]:
    """Return the six modes of the frame, beams with their sections, the platform as a block."""
    frame, platform = model.frame, definition.file.platform
    thickness = platform.thickness or definition.beams.beam_height_m
    centre = np.array([0.0, 0.0, platform.height])
    part = platform.half_size / PLATFORM_PARTS
    tiles = part * np.arange(1.0 - PLATFORM_PARTS, PLATFORM_PARTS, 2.0)
    blocks = [centre + np.array([x, y, 0.0]) + _box(part, part, 0.5 * thickness) for x in tiles for y in tiles]
    found = []
    for mode, name in enumerate(NAMES):
        nodes, own = model.node_motion(mode), model.platform_motion(mode)
        rest, motion = [], []
        for ends, section in zip(frame.beam, frame.section, strict=True):
            corners, moves = _beam(frame.node_m[ends], nodes[ends], section)
            rest.append(corners)
            motion.append(moves)
        rest += blocks
        motion += [np.stack([(rigid_motion(corner) @ own)[:3] for corner in block]) for block in blocks]
        faces = [np.stack(parts)[:, SIDES].reshape(-1, 4, 3) for parts in (rest, motion)]
        found.append(Shape(name, float(model.modes.frequency_hz[mode]), faces[0], faces[1]))
    return found


def solid_shapes(drawn: SolidModel, finest: SolidModel) -> list[Shape]:
    """Return the six modes on the outside of one mesh, in all quarters, with the finest mesh's frequencies."""
    faces = _outside(drawn)
    found = []
    for mode, name in enumerate(NAMES):
        rest, motion = [], []
        for signs in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)):
            mirror = np.array([*signs, 1.0])
            sense = np.prod([-1.0 if s < 0.0 and r else 1.0 for s, r in zip(signs, REVERSED[name], strict=True)])
            rest.append(drawn.vertex_m[faces] * mirror)
            motion.append(sense * drawn.motion[mode][faces] * mirror)
        found.append(Shape(name, float(finest.frequency_hz[mode]), np.concatenate(rest), np.concatenate(motion)))
    return found


def _beam(ends: FloatArray, motion: FloatArray, section: Section) -> tuple[FloatArray, FloatArray]:
    """Corners (8, 3) of a beam of a section between two nodes (2, 3), and how they move with the nodes (2, 6)."""
    along = ends[1] - ends[0]
    across = np.cross([0.0, 0.0, 1.0], along / np.linalg.norm(along))
    box = _box(1.0, 0.5 * section.width_m, 0.5 * section.height_m)
    offset = box[:, 1:2] * across + box[:, 2:] * np.array([0.0, 0.0, 1.0])
    end = (box[:, 0] > 0.0).astype(np.int64)
    moves = [(rigid_motion(o) @ motion[e])[:3] for o, e in zip(offset, end, strict=True)]
    return ends[end] + offset, np.stack(moves)


def _box(x: float, y: float, z: float) -> FloatArray:
    """Corners (8, 3) of a box about the origin."""
    bits = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    return np.asarray((2.0 * bits - 1.0) * np.array([x, y, z]))


def _outside(model: SolidModel) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Vertex numbers (P, 4) of the faces that belong to one cell only, those in the planes of symmetry left out."""
    corners = model.vertex_m[model.cell]
    bits = (corners > corners.mean(axis=1, keepdims=True)).astype(np.int64) @ np.array([1, 2, 4])
    ordered = np.take_along_axis(model.cell, np.argsort(bits, axis=1), axis=1)
    faces = ordered[:, SIDES].reshape(-1, 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    single = faces[first[count == 1]]
    inner = np.any(np.all(np.abs(model.vertex_m[single][..., :2]) < 1e-9, axis=1), axis=1)
    return np.asarray(single[~inner])
