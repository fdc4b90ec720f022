"""Calibrations of other programs: what OpenCV projects with their numbers is what the imported rig projects."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from contracts import refused
from scipy.spatial.transform import Rotation

from photogram.calibration.file import read_calibration, write_calibration
from photogram.calibration.foreign import ImportedCalibration
from photogram.calibration.foreign_formats import import_calibration
from photogram.camera import StereoRig
from photogram.geometry import skew

SIZE = (1280, 1024)
K_LEFT = np.array([[3200.5, 0, 640.25], [0, 3198.75, 511.5], [0, 0, 1.0]])
K_RIGHT = np.array([[3150.25, 0, 655.5], [0, 3152.5, 498.125], [0, 0, 1.0]])
D_LEFT, D_RIGHT = np.array([-0.08, 0.05, 1e-3, -5e-4, 0.02]), np.array([-0.07, 0.03, -8e-4, 6e-4, 0.01])
RADIAL_LEFT, RADIAL_RIGHT = D_LEFT * [1, 1, 0, 0, 1], D_RIGHT * [1, 1, 0, 0, 1]
ROTATION = Rotation.from_euler("xyz", [0.4, 18.0, -0.7], degrees=True).as_matrix()
T_MM = np.array([-151.5, 1.25, 24.5])
TEXT_NAMES = ("cx", "cy", "fx", "fy", "fs", "k1", "k2", "k3")
POINTS_M = np.random.default_rng(5).uniform([-0.1, -0.1, 0.9], [0.1, 0.1, 1.2], (60, 3))


def _assert_same(imported: ImportedCalibration, distortions: tuple[np.ndarray, np.ndarray] = (D_LEFT, D_RIGHT)) -> None:
    """The imported rig projects as OpenCV does with the numbers of the file."""
    left = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), K_LEFT, distortions[0])[0]
    right = cv2.projectPoints(POINTS_M, cv2.Rodrigues(ROTATION)[0], 1e-3 * T_MM, K_RIGHT, distortions[1])[0]
    for found, expected in zip(imported.rig.project(POINTS_M), (left, right), strict=True):
        np.testing.assert_allclose(found, expected.reshape(-1, 2), atol=1e-6)
    assert imported.rig.left.size_px.tolist() == list(SIZE)
    assert imported.rig.covariance is None
    assert "scale_uncertainty" in imported.notices[-1].text


def _file(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def _imported(folder: Path, text: str, *options: object) -> ImportedCalibration:
    """What is read from a file with this content."""
    return import_calibration(_file(folder, "calibration", text), *options)


def _storage(path: Path, content: dict[str, object]) -> Path:
    """Write a file as OpenCV writes it; the suffix decides between YAML, XML and JSON."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        storage.write(name, value)
    storage.release()
    return path


def _opencv(matrices: tuple[str, str], distortions: tuple[str, str], rotation: str = "R") -> dict[str, object]:
    return {
        matrices[0]: K_LEFT,
        distortions[0]: D_LEFT.reshape(1, -1),
        matrices[1]: K_RIGHT,
        distortions[1]: D_RIGHT.reshape(-1, 1),
        rotation: ROTATION,
        "T": T_MM.reshape(3, 1),
    }


@pytest.mark.parametrize("suffix", ["yml", "xml", "json", "yaml"])
@pytest.mark.parametrize(
    "names",
    [
        (("M1", "M2"), ("D1", "D2")),
        (("cameraMatrix1", "cameraMatrix2"), ("distCoeffs1", "distCoeffs2")),
        (("K0", "K1"), ("D0", "D1")),
        (("camera_matrix_left", "camera_matrix_right"), ("dist_coeffs_left", "dist_coeffs_right")),
        (("mtxL", "mtxR"), ("distL", "distR")),
        (("left_K", "right_K"), ("left_distortion", "right_distortion")),
    ],
)
def test_opencv_storage(tmp_path, suffix, names):
    path = _storage(tmp_path / f"stereo.{suffix}", _opencv(*names))
    _assert_same(import_calibration(path, SIZE, "mm"))


def test_opencv_in_two_files_with_the_size_in_one(tmp_path):
    content = _opencv(("M1", "M2"), ("D1", "D2"))
    inner = _storage(tmp_path / "intrinsics.yml", {k: content[k] for k in ("M1", "D1", "M2", "D2")})
    outer = {"R": content["R"], "T": content["T"], "image_width": SIZE[0], "image_height": SIZE[1]}
    _assert_same(import_calibration(inner, None, "mm", _storage(tmp_path / "extrinsics.yml", outer)))
    refused(r"intrinsics\.yml: expected the rotation R .* second file", import_calibration, inner, SIZE, "mm")


def test_opencv_plain_json_with_objects_and_a_rotation_vector(tmp_path):
    content = {
        "left": {"camera_matrix": K_LEFT.tolist(), "dist_coeffs": [*D_LEFT, 0, 0, 0]},
        "right": {"camera_matrix": K_RIGHT.tolist(), "dist_coeffs": [D_RIGHT.tolist()]},
        "R": Rotation.from_matrix(ROTATION).as_rotvec().tolist(),
        "T": (1e-3 * T_MM).tolist(),
        "imageSize": list(SIZE),
    }
    _assert_same(_imported(tmp_path, json.dumps(content), None, "m"))


def test_opencv_needs_a_unit_and_a_size_and_both_cameras(tmp_path):
    content = _opencv(("M1", "M2"), ("D1", "D2"))
    path = _storage(tmp_path / "s.yml", content)
    refused("length_unit: expected m or mm", import_calibration, path, SIZE)
    refused("image_size: expected width and height", import_calibration, path, None, "mm")
    assert import_calibration(path, SIZE, "m").rig.right_from_left.translation_m[0] == pytest.approx(-151.5)
    many = _storage(tmp_path / "s.yml", {**content, "D2": np.append(D_RIGHT, [0.1, 0, 0])})
    refused(r"D2: expected the distortion k1 k2 p1 p2 k3, found k4 = 0\.1", import_calibration, many, SIZE, "mm")
    alone = _storage(tmp_path / "mono.yml", {"camera_matrix": K_LEFT, "distortion_coefficients": D_LEFT})
    refused(r"mono\.yml: camera_matrix: .* single one", import_calibration, alone, SIZE, "mm")


def _matlab(old: bool) -> dict[str, object]:
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

    extrinsics: dict[str, object] = {"PoseCamera2": {"R": ROTATION.tolist(), "Translation": T_MM.tolist()}}
    if old:
        extrinsics = {"RotationOfCamera2": ROTATION.T.tolist(), "TranslationOfCamera2": T_MM.tolist()}
    return {"CameraParameters1": camera(K_LEFT, D_LEFT), "CameraParameters2": camera(K_RIGHT, D_RIGHT), **extrinsics}


@pytest.mark.parametrize("old", [False, True])
def test_matlab_and_the_way_through_the_calibration_file(tmp_path, old):
    imported = _imported(tmp_path, json.dumps(_matlab(old)))
    _assert_same(imported)
    write_calibration(tmp_path / "top.json", imported.rig)
    again = read_calibration(tmp_path / "top.json")
    for first, second in zip(imported.rig.project(POINTS_M), again.project(POINTS_M), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-9)
    refused(r"top\.json: .* one of this program", import_calibration, tmp_path / "top.json")


def test_matlab_with_two_coefficients_a_unit_nobody_knows_or_a_transposed_rotation(tmp_path):
    content = _matlab(old=False)
    for name in ("CameraParameters1", "CameraParameters2"):
        content[name] |= {"RadialDistortion": content[name]["RadialDistortion"][:2], "WorldUnits": "squares"}
    refused("length_unit", _imported, tmp_path, json.dumps(content))
    two = [1, 1, 1, 1, 0]
    _assert_same(_imported(tmp_path, json.dumps(content), None, "mm"), (D_LEFT * two, D_RIGHT * two))
    content = _matlab(old=False)
    cross = np.cross(np.eye(3), T_MM) * -1.0
    content["EssentialMatrix"] = (cross @ ROTATION).tolist()
    _assert_same(_imported(tmp_path, json.dumps(content)))
    content["PoseCamera2"] = {"R": ROTATION.T.tolist(), "Translation": T_MM.tolist()}
    refused("EssentialMatrix", import_calibration, _file(tmp_path, "b.json", json.dumps(content)))


def _bouguet(skew: str = "0.00000") -> str:
    """The text that the toolbox prints after a stereo calibration; its pixels count from 0."""

    def row(values: np.ndarray) -> str:
        return "[ " + "   ".join(f"{value:.12f}" for value in values) + " ] ± [ 1.00000   2.00000 ]"

    om = cv2.Rodrigues(ROTATION)[0].ravel()
    lines = ["", "Stereo calibration parameters after optimization:", "", "% fc_left = [ 1 1 ]"]
    for side, matrix, distortion in (("left", K_LEFT, D_LEFT), ("right", K_RIGHT, D_RIGHT)):
        lines += [
            f"Focal Length:          fc_{side} = {row(matrix[[0, 1], [0, 1]])}",
            f"Principal point:       cc_{side} = {row(matrix[:2, 2])}",
            f"Skew:             alpha_c_{side} = [ {skew} ] ± [ 0.00000  ]   => angle of pixel axes = 90 ± 0 degrees",
            f"Distortion:            kc_{side} = {row(distortion)}",
        ]
    return "\n".join(
        [*lines, f"Rotation vector:             om = {row(om)}", f"Translation vector:           T = {row(T_MM)}"]
    )


def test_bouguet_as_printed_and_with_column_vectors_and_image_size(tmp_path):
    _assert_same(_imported(tmp_path, _bouguet(), SIZE))
    text = _bouguet().replace("   ", " ;\n ") + "\nnx = 1280;\nny = 1024;"
    _assert_same(_imported(tmp_path, text.replace("± [ 1.00000 ;\n 2.00000 ]", ";")))


def _poses(world: Rotation, shift: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and translation (mm) of both cameras against a world that lies so before the left one."""
    return [(world.as_matrix(), shift), (ROTATION @ world.as_matrix(), ROTATION @ shift + T_MM)]


def _dice_xml(model: str, relative: bool, digits: int = 12, radial: tuple[dict[str, float], ...] = ({}, {})) -> str:
    """A DICe camera system file: the world's frame turned against camera 0 unless the file is relative."""
    poses = _poses(Rotation.from_euler("zyx", [0.02, -0.3, 3.0]), np.array([12.0, -7.0, 950.0]))
    parts = ['<?xml version="1.0"?>', "<ParameterList>", "<!-- DICe formatted camera system file -->"]
    parts += ['<Parameter name="xml_file_format" type="string" value="DICe_xml_camera_system_file" />']
    if relative:
        poses = [(np.eye(3), np.zeros(3)), (ROTATION, T_MM)]
        parts += ['<Parameter name="extrinsics_relative_camera_to_camera" type="bool" value="true" />']
    for index, (matrix, distortion) in enumerate(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))):
        rotation, translation = poses[index]
        names = ("FX", "FY", "CX", "CY", "K1", "K2", "P1", "P2", "K3", "TX", "TY", "TZ")
        values = (*matrix[[0, 1], [0, 1]], *matrix[:2, 2], *distortion, *translation)
        numbers = dict(zip(names, values, strict=True)) | radial[index]
        parts += [f'<ParameterList name="CAMERA {index}">']
        parts += [f'<Parameter name="{n}" type="double" value="{v:.12g}" />' for n, v in numbers.items()]
        parts += [f'<Parameter name="LENS_DISTORTION_MODEL" type="string" value="{model}" />']
        parts += [f'<Parameter name="IMAGE_HEIGHT_WIDTH" type="string" value="{{ {SIZE[1]}, {SIZE[0]} }}" />']
        parts += ['<ParameterList name="rotation_3x3_matrix">']
        for row in range(3):
            text = ", ".join(f"{v:.{digits}g}" for v in rotation[row])
            parts += [f'<Parameter name="ROW {row}" type="string" value="{{ {text} }}" />']
        parts += ["</ParameterList>", "</ParameterList>"]
    return "\n".join([*parts, "</ParameterList>"])


@pytest.mark.parametrize("relative", [True, False])
def test_dice_xml(tmp_path, relative):
    _assert_same(_imported(tmp_path, _dice_xml("OPENCV_LENS_DISTORTION", relative)))
    radial = _imported(tmp_path, _dice_xml("K1R3_K2R5_K3R7", relative))
    _assert_same(radial, (RADIAL_LEFT, RADIAL_RIGHT))
    none = _imported(tmp_path, _dice_xml("NO_LENS_DISTORTION", relative))
    _assert_same(none, (np.zeros(5), np.zeros(5)))


def test_dice_model_linear_in_the_radius_is_a_longer_focal_length_and_told(tmp_path):
    linear = {"K1": 0.015, "K2": 0.0, "K3": 0.0}
    imported = _imported(tmp_path, _dice_xml("K1R1_K2R2_K3R3", True, radial=(linear, linear)))
    np.testing.assert_allclose(imported.rig.left.parameters[:2], 1.015 * K_LEFT[[0, 1], [0, 1]], rtol=1e-6)
    assert any("K1R3_K2R5_K3R7 would be right there" in notice.text for notice in imported.notices)


def test_dice_rotation_with_few_digits_is_told(tmp_path):
    imported = _imported(tmp_path, _dice_xml("OPENCV_LENS_DISTORTION", True, digits=4))
    assert [notice.where for notice in imported.notices if notice.severity == "warning"] == ["rotation"]
    few = _dice_xml("OPENCV_LENS_DISTORTION", True, digits=2)
    refused("rotation: expected an orthonormal matrix", _imported, tmp_path, few)


def test_dice_polynomial_in_odd_powers_is_fitted_by_even_ones(tmp_path):
    radial = {"K1": -1e-3, "K2": 2e-3}, {"K1": 1.5e-3, "K2": -1e-3}
    imported = _imported(tmp_path, _dice_xml("K1R2_K2R4_K3R6", True, radial=radial))
    x, y = POINTS_M[:, 0] / POINTS_M[:, 2], POINTS_M[:, 1] / POINTS_M[:, 2]
    radius = np.hypot(x, y)
    grown = radius + (-1e-3 * radius**2 + 2e-3 * radius**4 + 0.02 * radius**6)  # DICe_Camera.cpp, sensor_to_image
    expected = np.stack([3200.5 * x / radius * grown + 640.25, 3198.75 * y / radius * grown + 511.5], axis=1)
    left = imported.rig.left.project(POINTS_M)
    (notice,) = (notice for notice in imported.notices if notice.where == "left camera")
    promised = float(notice.text.split("up to ")[1].split(" px")[0])
    assert 0 < promised < 0.1
    assert np.abs(left - expected).max() < promised + 1e-3


def _dice_text(fs: tuple[float, float] = (0.0, 0.0), size: bool = True, matrix: bool = False) -> str:
    lines = ["# a comment"]
    for (k, d), fs_px in zip(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT)), fs, strict=True):
        values = (k[0, 2], k[1, 2], k[0, 0], k[1, 1], fs_px, d[0], d[1], d[4])
        lines += [f"{v:.12g} # {n}" for v, n in zip(values, TEXT_NAMES, strict=True)]
    angles = Rotation.from_matrix(ROTATION).as_euler("xyz", degrees=True)
    outer = [*(ROTATION.ravel() if matrix else angles), *T_MM, *((SIZE[1], SIZE[0]) if size else ())]
    return "\n".join([*lines, *(f"{v:.12g} # an extrinsic" for v in outer)])


@pytest.mark.parametrize("matrix", [False, True])
@pytest.mark.parametrize("size", [False, True])
def test_dice_text(tmp_path, matrix, size):
    imported = _imported(tmp_path, _dice_text(size=size, matrix=matrix), SIZE)
    _assert_same(imported, (RADIAL_LEFT, RADIAL_RIGHT))


def _skewed(matrix: np.ndarray, distortion: np.ndarray, points_m: np.ndarray, skew: float) -> np.ndarray:
    """Pixels with u = fx·x_d + s·y_d + cx, from OpenCV's distorted coordinates."""
    distorted = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0].reshape(-1, 2)
    sheared = matrix + np.array([[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    return distorted @ sheared[:2, :2].T + sheared[:2, 2]


@pytest.mark.parametrize("fs", [(-2.5, 1.5), (0.0, 0.3)])
def test_skew_is_taken_up_by_a_turn_as_far_as_it_can(tmp_path, fs):
    imported = _imported(tmp_path, _dice_text(fs))
    rig = imported.rig
    expected = (
        _skewed(K_LEFT, RADIAL_LEFT, POINTS_M, fs[0]),
        _skewed(K_RIGHT, RADIAL_RIGHT, POINTS_M @ ROTATION.T + 1e-3 * T_MM, fs[1]),
    )
    turned = next((n for n in imported.notices if n.where == "left camera"), None)
    turn = 1e-3 * float(turned.text.split("turned by ")[1].split(" mrad")[0]) if turned else 0.0
    points = POINTS_M @ Rotation.from_euler("z", turn).as_matrix().T  # the left camera's frame took the turn
    for side, found, seen, fs_px in zip(("left", "right"), rig.project(points), expected, fs, strict=True):
        notices = [notice for notice in imported.notices if notice.where == f"{side} camera"]
        assert len(notices) == (fs_px != 0)
        remaining = np.linalg.norm(found - seen, axis=1).max()
        naive = abs(fs_px) * 512 / 3200
        if fs_px:
            promised = float(notices[0].text.split("up to ")[1].split(" px")[0])
            assert remaining < promised + 5e-3
            assert promised < 0.85 * naive
            assert notices[0].severity == ("warning" if promised > 0.05 else "info")
        else:
            assert remaining < 5e-3


def test_a_large_skew_is_refused(tmp_path):
    words = r"left camera: a skew of 40 px cannot be taken over: up to \d\.\d+ px"
    refused(words, _imported, tmp_path, _dice_text((40.0, 0.0)))
    refused("left camera: a skew of 64", import_calibration, _file(tmp_path, "b.txt", _bouguet("0.02")), SIZE)


def _vic3d(split: bool, size: bool = True) -> str:
    """A VIC-3D project: both cameras against a world between them, Cardan angles in degrees, lengths in mm."""
    poses = _poses(Rotation.from_euler("xyz", [179.9, 9.0, 0.05], degrees=True), np.array([-60.0, 0.5, 18.0]))
    parts = ['<?xml version="1.0" encoding="ISO-8859-1"?>\n<!DOCTYPE vpml>\n<project dir="C:/Üb">\n <calibration>']
    for index, (matrix, distortion) in enumerate(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))):
        inner = f"{matrix[0, 2]} {matrix[1, 2]} {matrix[0, 0]} {matrix[1, 1]} 0.0"
        radial = f"{distortion[0]} {distortion[1]} {distortion[4]}"
        angles = Rotation.from_matrix(poses[index][0]).as_euler("xyz", degrees=True)
        outer = " ".join(f"{v:.12g}" for v in (*angles, *poses[index][1]))
        text = f"<intrinsics>{inner}</intrinsics><distortion>{radial}</distortion>" if split else f"{inner} {radial}"
        parts += [f'  <camera id="{index}">{text}<orientation>{outer}</orientation></camera>']
    mask = f'<polygonmask width="{SIZE[0]}" height="{SIZE[1]}"/>' if size else ""
    return "\n".join([*parts, f" </calibration>{mask}</project>"])


@pytest.mark.parametrize("split", [False, True])
def test_vic3d(tmp_path, split):
    path = tmp_path / "project.xml"
    path.write_text(_vic3d(split), encoding="latin-1")
    _assert_same(import_calibration(path), (RADIAL_LEFT, RADIAL_RIGHT))
    loud = _vic3d(split, size=False).upper().replace("Ü", "U")
    for word in ("encoding", "version", "xml"):
        loud = loud.replace(word.upper(), word, 1)
    path.write_text(loud, encoding="latin-1")
    _assert_same(import_calibration(path, SIZE), (RADIAL_LEFT, RADIAL_RIGHT))
    with zipfile.ZipFile(tmp_path / "a.z3d", "w") as archive:
        archive.writestr("project.xml", _vic3d(split).encode("latin-1"))
    _assert_same(import_calibration(tmp_path / "a.z3d"), (RADIAL_LEFT, RADIAL_RIGHT))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected 22, 24, 28 or 30 numbers"),
        ("hello\nworld", "expected 22, 24, 28 or 30 numbers"),
        ("\n".join("x" * 22), "content: expected 22 numbers"),
        ("%YAML:1.0\n---\nM1: !!opencv-matrix\n  garb", "expected"),
        ("%YAML:1.0\n---\nM1: [1, 2", "OpenCV cannot parse"),
        ("{", "expected a JSON text"),
        ("[1, 2]", "expected 22, 24, 28 or 30 numbers"),
        ('{"CameraParameters1": 3}', "CameraParameters1: expected an object"),
        ("<html></html>", "found one that begins with <html>"),
        ("<a><b></a>", "expected an XML text"),
        ("<ParameterList/>", "xml_file_format"),
        ("<project><camera id='0'/></project>", "camera: expected the ids 0 and 1"),
        ("fc_left = [ 1 2 ]", "cc_left: missing"),
        ("fc_left = [ 1 2 3 ]", "fc_left: expected 2 numbers"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_sentence(tmp_path, text, message):
    path = _file(tmp_path, "calibration.txt", text)
    with pytest.raises(ValueError, match=message) as caught:
        import_calibration(path, SIZE, "mm")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_exchanged_width_and_height_are_told(tmp_path):
    imported = _imported(tmp_path, _dice_text(size=False), (600, 800))
    assert {n.where for n in imported.notices if n.severity == "warning"} == {"left camera", "right camera"}
    words = "image_size: expected 1280x1024 as in the file, found 1024x1280"
    refused(words, _imported, tmp_path, _dice_text(), (1024, 1280))


# Calibrations of other programs against what those programs, and the recordings they belong to, say.

GT4_CAMERAS = (
    (  # VIC-3D's calibration of the recording GT4, as DICe's regression test of it holds it
        "955.0537385 645.2301624 6636.033383 6636.440175 -0.0005693077075",
        (-0.0001957515272, 0.8739544595, -26.91426143),
        "179.933221 9.415993919 -0.05775865407 -58.20738494 0.1641145944 20.16820788",
    ),
    (
        "971.3275619 615.7965508 6609.847619 6609.16693 0.7051020868",
        (-0.00522596687, 1.077694686, -30.05404073),
        "-179.9418875 -9.416050875 0.04747312256 59.84373321 0.2184759676 21.04719884",
    ),
)


def _gt4(folder: Path, sign: float) -> StereoRig:
    """The rig of GT4 with the distortion coefficients multiplied by a factor."""
    cameras = "".join(
        f'<camera id="{index}">{inner} {" ".join(str(sign * k) for k in radial)}'
        f"<orientation>{outer}</orientation></camera>"
        for index, (inner, radial, outer) in enumerate(GT4_CAMERAS)
    )
    path = folder / "cal.xml"
    path.write_text(f"<project><calibration>{cameras}</calibration></project>", encoding="utf-8")
    return import_calibration(path, (1920, 1200)).rig


def _epipolar_px(rig: StereoRig, left_px: np.ndarray, right_px: np.ndarray) -> np.ndarray:
    """Sampson's distance of matches from the epipolar lines of the undistorted pictures, px."""
    left, right = (
        np.column_stack([camera.undistort(pixel), np.ones(len(pixel))])
        for camera, pixel in ((rig.left, left_px), (rig.right, right_px))
    )
    essential = skew(rig.right_from_left.translation_m) @ rig.right_from_left.rotation
    lines, back = left @ essential.T, right @ essential
    gradient = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.asarray((right * lines).sum(axis=1) / gradient * rig.left.matrix[0, 0])


def test_vic3d_calibration_fits_the_matches_of_its_recording(data_dir, tmp_path):
    table = np.genfromtxt(data_dir / "gt4_stereo" / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True)
    left, right = (np.column_stack([table[f"{name}x"], table[f"{name}y"]]) for name in ("", "r2_"))
    residuals = {sign: _epipolar_px(_gt4(tmp_path, sign), left, right) for sign in (1.0, 0.0, -1.0)}
    spread = {sign: 1.4826 * np.median(np.abs(e - np.median(e))) for sign, e in residuals.items()}
    assert abs(np.median(residuals[1.0])) < 0.1
    assert spread[1.0] < 0.02
    assert spread[1.0] < 0.95 * spread[0.0] < 0.95 * spread[-1.0]
    median = {sign: abs(np.median(e)) for sign, e in residuals.items()}
    assert median[1.0] < median[0.0] < median[-1.0]


def test_vic3d_project(data_dir):
    imported = import_calibration(data_dir / "static_stereo" / "cal.xml")
    rig = imported.rig
    assert imported.format == "VIC-3D"
    assert rig.left.size_px.tolist() == [1280, 800]
    assert rig.right_from_left.translation_m[0] == pytest.approx(0.1308, abs=1e-4)
    angle = np.rad2deg(np.arccos((np.trace(rig.right_from_left.rotation) - 1) / 2))
    assert angle == pytest.approx(2 * 9.015, abs=0.01)
    assert all(notice.severity == "info" for notice in imported.notices)


def test_dice_text_of_a_peer(data_dir):
    path = data_dir / "dotgrid_stereo" / "peer_cal.txt"
    refused("image_size", import_calibration, path)
    imported = import_calibration(path, (2448, 2048))
    rig = imported.rig
    np.testing.assert_allclose(rig.left.parameters[:4], [12577.41, 12575.82, 1202.508, 1056.028], atol=0.2)
    assert rig.right.parameters[4] == 0.07
    translation = [-0.086494, 0.000582, 0.02353]
    np.testing.assert_allclose(rig.right_from_left.translation_m, translation, atol=2e-5)
    warned = [notice.text for notice in imported.notices if notice.severity == "warning"]
    assert len(warned) == 2
    assert "a skew of -2.85 px" in warned[0]
