"""Tables and VTK files of every tracked point of a stereo pair in every frame."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.atomic_files import write_file
from photogram.geometry import displacement_jacobian, pose_rate, rotation_from_vector
from photogram.motion import Deformation
from shakercal._common.arrays import BoolArray, FloatArray

_AXES = ("x", "y", "z")
HEAD = ("frame", "time_s", "point", *(f"{name}_m" for name in _AXES))
HEAD += tuple(f"{before}{name}_m" for before in ("d", "u_d", "rest_", "u_rest_") for name in _AXES)
"""Columns of the table: position in the first frame, displacement and its part that is not rigid, each with u."""


@dataclass(frozen=True, eq=False)
class _Frame:
    """Points (N, 3) of one frame in sensor axes.

    `moved_m`: displacement; `rest_m`: deviation from the rigid body.
    """

    number: int
    time_s: float
    moved_m: FloatArray
    u_moved_m: FloatArray
    rest_m: FloatArray
    u_rest_m: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Which points (N,) were found in this frame."""
        return np.asarray(np.isfinite(self.rest_m).all(axis=1))


def save_points(folder: Path, stereo: StereoResult) -> list[str]:
    """Write the points of a pair into a folder and return the file names.

    points-NAME.csv, points-NAME/FRAME.vtp and points-NAME.pvd, which lists the frames with their times for ParaView.
    """
    if stereo.surface is None:
        return []
    name = f"points-{stereo.name}"
    names = [f"{name}.csv", f"{name}.pvd"]
    (folder / name).mkdir()
    reference_m = next(iter(stereo.surface)).reference_m
    finite = np.asarray(np.isfinite(reference_m).all(axis=1))
    positions = reference_m[finite]
    write_file(folder / names[0], _table(stereo, stereo.surface, finite))
    steps = []
    for frame in _frames(stereo, stereo.surface, finite):
        names.append(f"{name}/{frame.number:04d}.vtp")
        write_file(folder / names[-1], _vtp(positions, frame))
        steps.append(f'<DataSet timestep="{frame.time_s!r}" file="{escape(names[-1])}"/>')
    collection = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="1.0">', "<Collection>", *steps]
    write_file(folder / names[1], "\n".join([*collection, "</Collection>", "</VTKFile>", ""]))
    return names


def _table(stereo: StereoResult, surface: Iterable[Deformation], finite: BoolArray) -> Iterator[str]:
    """Yield the table frame by frame."""
    yield ",".join(HEAD) + "\n"
    positions = next(iter(surface)).reference_m[finite]
    for frame in _frames(stereo, surface, finite):
        numbers = np.hstack([positions, frame.moved_m, frame.u_moved_m, frame.rest_m, frame.u_rest_m])
        start = f"{frame.number},{frame.time_s!r},"
        points = np.flatnonzero(frame.seen).tolist()
        yield "".join(f"{start}{point},{','.join(map(repr, numbers[point].tolist()))}\n" for point in points)


def _frames(stereo: StereoResult, surface: Iterable[Deformation], finite: BoolArray) -> Iterator[_Frame]:
    """Yield the frames with a motion; points without a reference position are excluded.

    x' − x = R·(x − o) + o + t + R·e − x with the deviation e about each point's mean over time. The covariance is that
    of the rotated e, R·V·Rᵀ, plus J·P·Jᵀ of the pose, J = [I, −[R·(x − o)]×]. Common errors of all points, such as
    those of the calibration, are not included.
    """
    motion = stereo.motion
    each = ((part, row) for part in surface for row in range(len(part.residual_m)))
    for number, (part, row) in enumerate(each):
        if not np.isfinite(motion.pose[number]).all():
            continue
        arm = part.reference_m[finite] - motion.origin_m
        turn = rotation_from_vector(motion.pose[number, 3:])
        rest = part.residual_m[row, finite] @ turn.T
        local = turn @ part.covariance_m2[row, finite] @ turn.T
        rotated = arm @ turn.T
        jacobian = displacement_jacobian(rotated) @ np.linalg.inv(pose_rate(motion.pose[number]))
        whole = local + jacobian @ motion.covariance[number] @ jacobian.swapaxes(1, 2)
        yield _Frame(
            number,
            float(stereo.time_s[number]),
            rotated - arm + motion.pose[number, :3] + rest,
            _sigma(whole),
            rest,
            _sigma(local),
        )


def _sigma(covariance: FloatArray) -> FloatArray:
    """Return standard uncertainties (N, 3) of covariances (N, 3, 3)."""
    return np.asarray(np.sqrt(np.maximum(covariance.diagonal(axis1=1, axis2=2), 0.0)))


def _vtp(positions_m: FloatArray, frame: _Frame) -> str:
    """Return VTK PolyData in XML: positions in the first frame and vectors of this frame.

    Doubles are in base64 after their length in bytes as UInt64 (VTK file formats, "XML file formats"). Points that were
    not found have `seen` 0 and zero vectors.
    """
    count, seen = len(positions_m), frame.seen
    vectors = {
        "displacement_m": frame.moved_m,
        "u_displacement_m": frame.u_moved_m,
        "deviation_m": frame.rest_m,
        "u_deviation_m": frame.u_rest_m,
    }
    parts = ['<?xml version="1.0"?>']
    parts += ['<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">', "<PolyData>"]
    parts += [f'<Piece NumberOfPoints="{count}" NumberOfVerts="{count}">', "<Points>", _array("place_m", positions_m)]
    parts += ["</Points>", "<Verts>", _array("connectivity", np.arange(count))]
    parts += [_array("offsets", np.arange(1, count + 1)), "</Verts>", '<PointData Vectors="displacement_m">']
    parts += [_array(name, np.where(seen[:, None], values, 0.0)) for name, values in vectors.items()]
    parts += [_array("seen", seen.astype(np.uint8)), "</PointData>", "</Piece>", "</PolyData>", "</VTKFile>", ""]
    return "\n".join(parts)


def _array(name: str, values: NDArray[Any]) -> str:
    """Return a DataArray of doubles, integers or bytes."""
    kind, dtype = {"f": ("Float64", "<f8"), "i": ("Int64", "<i8"), "u": ("UInt8", "u1")}[values.dtype.kind]
    raw = np.ascontiguousarray(values, dtype=dtype).tobytes()
    text = base64.b64encode(len(raw).to_bytes(8, "little") + raw).decode("ascii")
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'<DataArray type="{kind}" Name="{name}"{components} format="binary">{text}</DataArray>'
