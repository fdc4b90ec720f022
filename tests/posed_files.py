"""Calibration files with posed cameras, written by hand after the formats' documentation from one pair's numbers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from calibration_files import D_LEFT, D_RIGHT, K_LEFT, K_RIGHT, ROTATION, SIZE, T_MM
from scipy.spatial.transform import Rotation

WORLD = Rotation.from_rotvec([0.7, -1.1, 2.0]).as_matrix(), np.array([0.31, -0.12, 0.85])
"""x_left = R·x_world + t, in m."""
RIGHT = ROTATION @ WORLD[0], ROTATION @ WORLD[1] + 1e-3 * T_MM
POSES = WORLD, RIGHT
MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
MODELS |= {"FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10}
CAMERAS = tuple(
    (7 - 4 * k, "FULL_OPENCV", SIZE, [m[0, 0], m[1, 1], m[0, 2] + 0.5, m[1, 2] + 0.5, *d, 0, 0, 0])
    for k, (m, d) in enumerate(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT)))
)
IMAGES = tuple((2 + k, POSES[k], 7 - 4 * k, name) for k, name in enumerate(("left 01.png", "right/01.png")))


def colmap_text(cameras=CAMERAS, images=IMAGES, points="100.5 200.25 -1 30 40 17\n") -> tuple[str, str]:
    """cameras.txt and images.txt; the points of an image are a line that may be empty."""
    first = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for number, model, (width, height), parameters in cameras:
        first += f"{number} {model} {width} {height} " + " ".join(repr(float(value)) for value in parameters) + "\n"
    second = (
        "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
    )
    for number, (turn, shift), camera, name in images:
        quaternion = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
        numbers = " ".join(repr(float(value)) for value in (*quaternion, *shift))
        second += f"{number} {numbers} {camera} {name}\n{points or chr(10)}"
    return first, second


def colmap_binary(cameras=CAMERAS, images=IMAGES, points: int = 3) -> tuple[bytes, bytes]:
    """cameras.bin and images.bin, little endian."""
    first = struct.pack("<Q", len(cameras))
    for number, model, (width, height), parameters in cameras:
        first += struct.pack(f"<IiQQ{len(parameters)}d", number, MODELS[model], width, height, *parameters)
    second = struct.pack("<Q", len(images))
    for number, (turn, shift), camera, name in images:
        quaternion = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
        second += struct.pack("<I7dI", number, *quaternion, *shift, camera) + name.encode() + b"\0"
        second += struct.pack("<Q", points) + struct.pack("<ddq", 1.5, 2.5, -1) * points
    return first, second


def write_posed(folder: Path) -> dict[str, bytes]:
    """Write a whole file of every format, and the second files; return the content of the first ones by name."""
    (images_text, images), (cameras_text, cameras) = reversed(list(zip(colmap_text(), colmap_binary(), strict=True)))
    contents: dict[str, str | bytes] = {"colmap.bin": cameras, "colmap.txt": cameras_text, "mrcal": mrcal(0)}
    contents |= {"anipose.toml": toml(), "caliscope.toml": toml(True, False, True), "metashape.xml": metashape()}
    contents |= {"images.bin": images, "images.txt": images_text, "right.mrcal": mrcal(1)}
    for name, content in contents.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return {name: (folder / name).read_bytes() for name in contents}


def mrcal(side: int, model: str = "OPENCV5", distortion: Sequence[float] | None = None) -> str:
    """A .cameramodel as mrcal writes it: comments, and a comma after the last number."""
    matrix, stated = ((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))[side]
    terms = stated if distortion is None else distortion
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *terms]
    pose = [*Rotation.from_matrix(POSES[side][0]).as_rotvec(), *POSES[side][1]]
    intrinsics, extrinsics = (" ".join(f"{float(value)!r}," for value in each) for each in (values, pose))
    return (
        f"# generated on a day by a command\n{{\n    'lensmodel':  'LENSMODEL_{model}',\n\n"
        f"    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n    'intrinsics': [ {intrinsics}],\n\n"
        f"    'valid_intrinsics_region': [\n    [ 0, 0 ],\n    [ 10, 10 ],\n ],\n\n"
        f"    # extrinsics are rt_fromref\n    'extrinsics': [ {extrinsics}],\n\n"
        f"    'imagersize': [ {SIZE[0]}, {SIZE[1]},],\n\n    'optimization_inputs': b'{'A%1' * 50}',\n}}\n"
    )


def toml(
    caliscope: bool = False, vectors: bool = True, nested: bool = False, distortions=(D_LEFT, D_RIGHT), extra: str = ""
) -> str:
    """The cameras of anipose or caliscope; lengths in m."""
    text = "" if not nested else "CreationDate = 2023-03-31T09:56:43.193358\n\n"
    for k, (matrix, distortion) in enumerate(zip((K_LEFT, K_RIGHT), distortions, strict=True)):
        turn = Rotation.from_matrix(POSES[k][0]).as_rotvec() if vectors else POSES[k][0]
        text += f"[cameras.{k}]\n" if nested else f"[cam_{k}]\n"
        text += f"port = {k}\nrotation_count = 0\nignore = false\n" if caliscope else f'name = "{"AB"[k]}"\n'
        text += f"size = [ {SIZE[0]}, {SIZE[1]},]\nmatrix = {matrix.tolist()}\n"
        text += f"distortions = {np.array(distortion).tolist()}\n"
        text += f"rotation = {turn.tolist()}\ntranslation = {POSES[k][1].tolist()}\n{extra}\n"
    return text + "[metadata]\nadjusted = false\nerror = 0.26\n"


def metashape(
    kind: str = "frame", terms: Sequence[dict[str, float]] = ({}, {}), scale: float | None = 2.5, size=SIZE
) -> str:
    """Cameras that Metashape exports: poses in the chunk's frame, whose unit is `scale` m."""
    sensors = cameras = ""
    for k, (matrix, distortion) in enumerate(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))):
        k1, k2, p1, p2, k3 = distortion
        values = {"f": matrix[1, 1], "cx": matrix[0, 2] + 0.5 - size[0] / 2, "cy": matrix[1, 2] + 0.5 - size[1] / 2}
        values |= {"b1": matrix[0, 0] - matrix[1, 1], "b2": 0.0, "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
        values |= terms[k]
        resolution = f'<resolution width="{size[0]}" height="{size[1]}"/>'
        inner = "".join(f"<{name}>{float(value)!r}</{name}>" for name, value in values.items())
        sensors += (
            f'<sensor id="{k}" label="unknown" type="{kind}">{resolution}'
            f'<calibration type="{kind}" class="initial">{resolution}<f>1000</f></calibration>'
            f'<calibration type="{kind}" class="adjusted">{resolution}{inner}</calibration></sensor>'
        )
        turn, shift = POSES[k]
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = turn.T, -turn.T @ shift / (scale or 1.0)
        numbers = " ".join(repr(float(value)) for value in whole.ravel())
        cameras += f'<camera id="{k}" sensor_id="{k}" label="DSC_{k}"><transform>{numbers}</transform></camera>\n'
    chunk = "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation>"
    chunk += f"<scale>{scale!r}</scale></transform>" if scale else "</transform>"
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">\n'
        f'<sensors next_id="2">{sensors}</sensors>\n<cameras next_id="3">{cameras}'
        f'<camera id="2" sensor_id="0" label="not aligned"/></cameras>\n{chunk}\n</chunk></document>\n'
    )
