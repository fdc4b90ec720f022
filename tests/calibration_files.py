"""Calibration files of other programs, each written from the numbers of one stereo pair."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from photogram.calibration.calibration_file import write_calibration
from photogram.calibration.exchange.exchange_files import export_calibration
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform

SIZE = (1280, 1024)
K_LEFT = np.array([[3200.5, 0, 640.25], [0, 3198.75, 511.5], [0, 0, 1.0]])
K_RIGHT = np.array([[3150.25, 0, 655.5], [0, 3152.5, 498.125], [0, 0, 1.0]])
D_LEFT, D_RIGHT = np.array([-0.08, 0.05, 1e-3, -5e-4, 0.02]), np.array([-0.07, 0.03, -8e-4, 6e-4, 0.01])
ROTATION = Rotation.from_euler("xyz", [0.4, 18.0, -0.7], degrees=True).as_matrix()
T_MM = np.array([-151.5, 1.25, 24.5])
PAIR = ((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))
TEXT_NAMES = ("cx", "cy", "fx", "fy", "fs", "k1", "k2", "k3")
Cameras = Sequence[tuple[np.ndarray, np.ndarray]]


def make_rig(
    tangential: float = 0.0, divisor: float = 0.0, skew_px: float = 0.0, covariance: np.ndarray | None = None
) -> StereoRig:
    """The pair with a share of its tangential distortion, a rational lens, skew."""
    cameras = []
    for matrix, distortion in PAIR:
        values = np.array([*matrix[[0, 1], [0, 1]], *matrix[:2, 2], *distortion, 0.02, -0.01, 0.05, skew_px])
        values[6:8] *= tangential
        values[9:12] *= divisor
        cameras.append(Camera.from_parameters(values, np.array(SIZE)))
    return StereoRig(cameras[0], cameras[1], RigidTransform(ROTATION, 1e-3 * T_MM), covariance)


def storage(path: Path, content: dict[str, object]) -> Path:
    """Write a file as OpenCV writes it; the suffix decides between YAML, XML and JSON."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        file.write(name, value)
    file.release()
    return path


def opencv(
    matrices: tuple[str, str] = ("M1", "M2"), distortions: tuple[str, str] = ("D1", "D2"), **changes: object
) -> dict[str, object]:
    content = {matrices[0]: K_LEFT, distortions[0]: D_LEFT.reshape(1, -1)}
    content |= {matrices[1]: K_RIGHT, distortions[1]: D_RIGHT.reshape(-1, 1), "R": ROTATION, "T": T_MM.reshape(3, 1)}
    return content | changes


def matlab(old: bool = False) -> dict[str, object]:
    """What toStruct gives: the older release transposes every matrix, and both count pixels from 1."""

    def camera(matrix: np.ndarray, distortion: np.ndarray) -> dict[str, object]:
        counted = matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        return {
            "IntrinsicMatrix" if old else "K": (counted.T if old else counted).tolist(),
            "RadialDistortion": distortion[[0, 1, 4]].tolist(),
            "TangentialDistortion": distortion[2:4].tolist(),
            "ImageSize": [SIZE[1], SIZE[0]],
            "WorldUnits": "millimeters",
        }

    outer: dict[str, object] = {"PoseCamera2": {"R": ROTATION.tolist(), "Translation": T_MM.tolist()}}
    if old:
        outer = {"RotationOfCamera2": ROTATION.T.tolist(), "TranslationOfCamera2": T_MM.tolist()}
    return {f"CameraParameters{n}": camera(*each) for n, each in enumerate(PAIR, start=1)} | outer


def bouguet_variables() -> dict[str, object]:
    """The variables of Bouguet's toolbox, whose pixels count from 0."""
    values: dict[str, object] = {"om": cv2.Rodrigues(ROTATION)[0].ravel(), "T": T_MM, "nx": SIZE[0], "ny": SIZE[1]}
    for side, (matrix, distortion) in zip(("left", "right"), PAIR, strict=True):
        values |= {f"fc_{side}": matrix[[0, 1], [0, 1]], f"cc_{side}": matrix[:2, 2], f"kc_{side}": distortion}
    return values


def bouguet(skew: str = "0.00000") -> str:
    """The text that the toolbox prints after a stereo calibration."""
    lines = ["", "Stereo calibration parameters after optimization:", "", "% fc_left = [ 1 1 ]"]
    for name, value in bouguet_variables().items():
        if name not in ("nx", "ny"):
            row = "   ".join(f"{number:.12f}" for number in np.ravel(value))
            lines.append(f"A name:          {name} = [ {row} ] ± [ 1.00000   2.00000 ]")
    skews = [f"Skew: alpha_c_{side} = [ {skew} ] ± [ 0.00000  ]   => angle = 90 degrees" for side in ("left", "right")]
    return "\n".join(lines + skews)


def _poses(world: Rotation, shift: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and translation (mm) of both cameras against a world that lies so before the left one."""
    return [(world.as_matrix(), shift), (ROTATION @ world.as_matrix(), ROTATION @ shift + T_MM)]


def dice_xml(model: str, relative: bool, digits: int = 12, radial: tuple[dict[str, float], ...] = ({}, {})) -> str:
    """A DICe camera system file: the world's frame turned against camera 0 unless the file is relative."""
    poses = _poses(Rotation.from_euler("zyx", [0.02, -0.3, 3.0]), np.array([12.0, -7.0, 950.0]))
    parts = ['<?xml version="1.0"?>', "<ParameterList>", "<!-- DICe formatted camera system file -->"]
    parts += ['<Parameter name="xml_file_format" type="string" value="DICe_xml_camera_system_file" />']
    if relative:
        poses = [(np.eye(3), np.zeros(3)), (ROTATION, T_MM)]
        parts += ['<Parameter name="extrinsics_relative_camera_to_camera" type="bool" value="true" />']
    for index, (matrix, distortion) in enumerate(PAIR):
        rotation, translation = poses[index]
        names = ("FX", "FY", "CX", "CY", "K1", "K2", "P1", "P2", "K3", "TX", "TY", "TZ")
        values = (*matrix[[0, 1], [0, 1]], *matrix[:2, 2], *distortion, *translation)
        numbers = dict(zip(names, values, strict=True)) | radial[index]
        parts += [f'<ParameterList name="CAMERA {index}">']
        parts += [f'<Parameter name="{n}" type="double" value="{v:.12g}" />' for n, v in numbers.items()]
        parts += [f'<Parameter name="LENS_DISTORTION_MODEL" type="string" value="{model}" />']
        parts += [f'<Parameter name="IMAGE_HEIGHT_WIDTH" type="string" value="{{ {SIZE[1]}, {SIZE[0]} }}" />']
        parts += ['<ParameterList name="rotation_3x3_matrix">']
        rows = [", ".join(f"{v:.{digits}g}" for v in row) for row in rotation]
        parts += [f'<Parameter name="ROW {n}" type="string" value="{{ {row} }}" />' for n, row in enumerate(rows)]
        parts += ["</ParameterList>", "</ParameterList>"]
    return "\n".join([*parts, "</ParameterList>"])


def dice_text(
    fs: tuple[float, float] = (0.0, 0.0),
    size: bool = True,
    matrix: bool = False,
    radial: tuple[tuple[float, ...], ...] = (tuple(D_LEFT[[0, 1, 4]]), tuple(D_RIGHT[[0, 1, 4]])),
) -> str:
    lines = ["# a comment"]
    for k, d, fs_px in zip((K_LEFT, K_RIGHT), radial, fs, strict=True):
        values = (k[0, 2], k[1, 2], k[0, 0], k[1, 1], fs_px, *d)
        lines += [f"{v:.12g} # {n}" for v, n in zip(values, TEXT_NAMES, strict=True)]
    angles = Rotation.from_matrix(ROTATION).as_euler("xyz", degrees=True)
    outer = [*(ROTATION.ravel() if matrix else angles), *T_MM, *((SIZE[1], SIZE[0]) if size else ())]
    return "\n".join([*lines, *(f"{v:.12g} # an extrinsic" for v in outer)])


def vic3d(split: bool = False, size: bool = True) -> str:
    """A VIC-3D project: both cameras against a world between them, Cardan angles in degrees, lengths in mm."""
    poses = _poses(Rotation.from_euler("xyz", [179.9, 9.0, 0.05], degrees=True), np.array([-60.0, 0.5, 18.0]))
    parts = ['<?xml version="1.0" encoding="ISO-8859-1"?>\n<!DOCTYPE vpml>\n<project dir="C:/Üb">\n <calibration>']
    for index, (matrix, distortion) in enumerate(PAIR):
        inner = f"{matrix[0, 2]} {matrix[1, 2]} {matrix[0, 0]} {matrix[1, 1]} 0.0"
        radial = f"{distortion[0]} {distortion[1]} {distortion[4]}"
        angles = Rotation.from_matrix(poses[index][0]).as_euler("xyz", degrees=True)
        outer = " ".join(f"{v:.12g}" for v in (*angles, *poses[index][1]))
        text = f"<intrinsics>{inner}</intrinsics><distortion>{radial}</distortion>" if split else f"{inner} {radial}"
        parts += [f'  <camera id="{index}">{text}<orientation>{outer}</orientation></camera>']
    mask = f'<polygonmask width="{SIZE[0]}" height="{SIZE[1]}"/>' if size else ""
    return "\n".join([*parts, f" </calibration>{mask}</project>"])


MATCHID_POSE = "Tx [{}];-151.5\nTy [{}];1.25\nTz [{}];24.5\nTheta [{}];0.4\nPhi [{}];{}\nPsi [{}];-0.7\n"


def matchid(pose: str = MATCHID_POSE.format(*["mm"] * 3, "deg", "deg", 18.0, "deg")) -> str:
    lines = []
    for n, (k, d) in enumerate(PAIR):
        values = {"Fx [px]": k[0, 0], "Fy [px]": k[1, 1], "Fs": 0, "Cx": k[0, 2], "Cy": k[1, 2]}
        values |= {"Kappa 1": d[0], "Kappa 2": d[1], "Kappa 3": d[4], "P1": d[2], "P2": d[3]}
        lines += [f"Cam{n}_{name};{value}" for name, value in values.items()]
    return "\n".join(lines) + "\n" + pose


def kalibr(cameras: Cameras = PAIR, model: str = "radtan") -> str:
    text = ""
    for n, (k, d) in enumerate(cameras):
        text += f"cam{n}:\n  camera_model: pinhole\n  distortion_model: {model}\n"
        text += f"  distortion_coeffs: {np.ravel(d)[:4].tolist()}\n  resolution: {list(SIZE)}\n"
        text += f"  intrinsics: {k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}\n"
    pose = np.vstack([np.column_stack([ROTATION, 1e-3 * T_MM]), [0, 0, 0, 1]])
    return text + f"  T_cn_cnm1: {pose.tolist()}\n"


def ros(cameras: Cameras = PAIR, model: str = "plumb_bob") -> tuple[str, str]:
    """The texts of both cameras, rectified by OpenCV."""
    rectify = cv2.stereoRectify if model == "plumb_bob" else cv2.fisheye.stereoRectify
    (k1, d1), (k2, d2) = cameras
    extra = () if model == "plumb_bob" else (0,)
    turned = rectify(k1, d1, k2, d2, SIZE, ROTATION, 1e-3 * T_MM.reshape(3, 1), *extra)[:4]
    texts = []
    for (k, d), r, p in zip(cameras, turned[:2], turned[2:], strict=True):
        text = f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ndistortion_model: {model}\n"
        named = {"camera_matrix": k, "distortion_coefficients": d.reshape(1, -1), "rectification_matrix": r}
        for name, value in {**named, "projection_matrix": p}.items():
            text += f"{name}:\n  rows: {len(value)}\n  cols: {value.shape[1]}\n  data: {value.ravel().tolist()}\n"
        texts.append(text)
    return texts[0], texts[1]


def write_all(folder: Path) -> dict[str, bytes]:
    """Write a whole file of every format, and return their content by name."""
    certain = make_rig(tangential=1.0, covariance=np.diag(np.full(24, 1e-6)))
    write_calibration(folder / "own.json", certain, 0.1)
    own = json.loads((folder / "own.json").read_text())
    covariance = {"parameters": ["fx", "fy"], "matrix": [[1.0, 0.5], [0.5, 1.0]]}
    mono = {key: own[key] for key in ("format", "image_size", "reprojection_rms")}
    (folder / "camera.json").write_text(json.dumps({**mono, "camera": own["left"], "covariance": covariance}))
    for name, exported in (("opencv.yml", certain), ("vic3d.xml", make_rig()), ("matlab.json", certain)):
        export_calibration(folder / name, exported)
    for suffix in ("xml", "json"):
        storage(folder / f"storage.{suffix}", opencv())
    variables = bouguet_variables()
    texts = {"dice.txt": dice_text(), "dice.xml": dice_xml("OPENCV_LENS_DISTORTION", True), "a.caldat": matchid()}
    texts |= {"bouguet.m": bouguet() + "\nnx = 1280;\nny = 1024;", "kalibr.yaml": kalibr(), "ros.yaml": ros()[0]}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    savemat(folder / "bouguet.mat", variables)
    wide = {"K1": K_LEFT, "D1": D_LEFT[:4], "K2": K_RIGHT, "D2": D_RIGHT[:4], "distortion_model": "fisheye"}
    np.savez(folder / "fisheye.npz", **wide, R=ROTATION, T=T_MM)
    with zipfile.ZipFile(folder / "vic3d.z3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "vic3d.xml", "project.xml")
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
