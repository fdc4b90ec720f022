"""Calibrations of other programs: what OpenCV projects with their numbers is what the imported rig projects."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

import calibration_files as files
import cv2
import h5py
import numpy as np
import pytest
from calibration_files import D_LEFT, D_RIGHT, K_LEFT, K_RIGHT, MATCHID_POSE, ROTATION, SIZE, T_MM
from contracts import refused
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from photogram.calibration import calibration_notices as notices
from photogram.calibration.calibration_file import read_calibration, write_calibration
from photogram.calibration.exchange.exchange_files import export_calibration, import_calibration
from photogram.calibration.exchange.lens import ImportedCalibration, pixel_grid
from photogram.camera import StereoRig, epipolar_residual
from photogram.geometry import skew

RADIAL_LEFT, RADIAL_RIGHT = D_LEFT * [1, 1, 0, 0, 1], D_RIGHT * [1, 1, 0, 0, 1]
POINTS_M = np.random.default_rng(5).uniform([-0.1, -0.1, 0.9], [0.1, 0.1, 1.2], (60, 3))


def _assert_same(imported: ImportedCalibration, distortions: tuple[np.ndarray, np.ndarray] = (D_LEFT, D_RIGHT)) -> None:
    """The imported rig projects as OpenCV does with the numbers of the file."""
    left = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), K_LEFT, distortions[0])[0]
    right = cv2.projectPoints(POINTS_M, cv2.Rodrigues(ROTATION)[0], 1e-3 * T_MM, K_RIGHT, distortions[1])[0]
    for found, expected in zip(imported.rig.project(POINTS_M), (left, right), strict=True):
        np.testing.assert_allclose(found, expected.reshape(-1, 2), atol=1e-6)
    assert imported.rig.left.size_px.tolist() == list(SIZE)
    assert imported.rig.covariance is None
    assert imported.notices[-1].code == notices.UNCERTAINTIES_MISSING.code


def _file(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def _imported(folder: Path, text: str, *options: object) -> ImportedCalibration:
    """What is read from a file with this content."""
    return import_calibration(_file(folder, "calibration", text), *options)


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
    path = files.storage(tmp_path / f"stereo.{suffix}", files.opencv(*names))
    _assert_same(import_calibration(path, SIZE, "mm"))


def test_opencv_in_two_files_with_the_size_in_one(tmp_path):
    content = files.opencv()
    inner = files.storage(tmp_path / "intrinsics.yml", {k: content[k] for k in ("M1", "D1", "M2", "D2")})
    outer = {"R": content["R"], "T": content["T"], "image_width": SIZE[0], "image_height": SIZE[1]}
    _assert_same(import_calibration(inner, None, "mm", files.storage(tmp_path / "extrinsics.yml", outer)))
    refused(r"intrinsics\.yml: .*rotation R", import_calibration, inner, SIZE, "mm")


def test_opencv_plain_json_with_objects_and_a_rotation_vector(tmp_path):
    content = {
        "left": {"camera_matrix": K_LEFT.tolist(), "dist_coeffs": [*D_LEFT, 0, 0, 0]},
        "right": {"camera_matrix": K_RIGHT.tolist(), "dist_coeffs": [D_RIGHT.tolist()]},
        "R": Rotation.from_matrix(ROTATION).as_rotvec().tolist(),
        "T": (1e-3 * T_MM).tolist(),
        "imageSize": list(SIZE),
    }
    _assert_same(_imported(tmp_path, json.dumps(content), None, "m"))


def test_opencv_rational_distortion_is_taken_as_opencv_projects_it(tmp_path):
    distortions = np.append(D_LEFT, [0.3, -0.1, 0.05]), np.append(D_RIGHT, [-0.2, 0.04, 0.01])
    content = files.opencv() | {"D1": distortions[0], "D2": np.append(distortions[1], np.zeros(6))}
    _assert_same(import_calibration(files.storage(tmp_path / "s.yml", content), SIZE, "mm"), distortions)


def test_opencv_needs_a_unit_and_a_size_and_both_cameras(tmp_path):
    content = files.opencv()
    path = files.storage(tmp_path / "s.yml", content)
    refused("length_unit: ", import_calibration, path, SIZE)
    refused("image_size: ", import_calibration, path, None, "mm")
    assert import_calibration(path, SIZE, "m").rig.right_from_left.translation_m[0] == pytest.approx(-151.5)
    many = files.storage(tmp_path / "s.yml", {**content, "D2": np.append(D_RIGHT, [0, 0, 0, 0.1, 0, 0, 0])})
    refused(r"D2: .*s1 = 0\.1", import_calibration, many, SIZE, "mm")
    alone = files.storage(tmp_path / "mono.yml", {"camera_matrix": K_LEFT, "distortion_coefficients": D_LEFT})
    refused(r"mono\.yml: camera_matrix: ", import_calibration, alone, SIZE, "mm")


# Lenses whose coefficients belong to angles, and four coefficients that may be either.

ANGULAR = np.array([[-0.012], [0.021], [-0.018], [0.0045]]), np.array([[-0.02], [0.01], [-0.003], [0.001]])
K_WIDE = (
    np.array([[750.0, 0, 636.5], [0, 751.0, 513.25], [0, 0, 1]]),
    np.array([[760.0, 0, 642], [0, 758, 508], [0, 0, 1]]),
)
WIDE_M = np.random.default_rng(6).uniform([-0.8, -0.7, 0.6], [0.8, 0.7, 1.0], (200, 3))


def _wide(**keys: object) -> dict[str, object]:
    """What OpenCV's fisheye module finds of a pair, as its users store it."""
    (k1, k2), (d1, d2) = K_WIDE, ANGULAR
    return {"K1": k1, "D1": d1, "K2": k2, "D2": d2, "R": ROTATION, "T": T_MM.reshape(3, 1), **keys}


def _assert_wide(imported: ImportedCalibration, distortions: tuple[np.ndarray, np.ndarray] = ANGULAR) -> None:
    """The imported pair sees what OpenCV's fisheye cameras see, within what it says."""
    promised = [
        notice.values["largest_px"] for notice in imported.notices if notice.code == notices.APPROXIMATED_CAMERA.code
    ]
    assert len(promised) == 2
    poses = (np.zeros(3), np.zeros(3)), (cv2.Rodrigues(ROTATION)[0], 1e-3 * T_MM)
    for found, (turn, shift), k, d, px in zip(
        imported.rig.project(WIDE_M), poses, K_WIDE, distortions, promised, strict=True
    ):
        expected = cv2.fisheye.projectPoints(WIDE_M[None], turn.reshape(3, 1), shift.reshape(3, 1), k, d)[0][0]
        inside = ((expected > 0) & (expected < np.array(SIZE) - 1)).all(axis=1)
        assert inside.sum() > 50
        assert np.linalg.norm(found - expected, axis=1)[inside].max() < px + 2e-3
        assert px < 0.05


@pytest.mark.parametrize(
    ("keys", "asked"),
    [
        ({}, "fisheye"),
        ({"fisheye_model": 1}, None),
        ({"distortion_type": 1}, None),
        ({"distortion_model": "equidistant"}, None),
        ({"camera_model": "pinhole", "D_model": "x", "is_fisheye": "true"}, None),
        ({"camera_model": "KANNALA_BRANDT"}, "fisheye"),
    ],
)
@pytest.mark.parametrize("suffix", ["yml", "npz"])
def test_a_fisheye_lens_that_is_stated_is_described_by_the_rational_model(tmp_path, keys, asked, suffix):
    path = tmp_path / f"stereo.{suffix}"
    if suffix == "npz":
        np.savez(path, **_wide(**keys))
    else:
        files.storage(path, _wide(**keys))
    _assert_wide(import_calibration(path, SIZE, "mm", distortion_model=asked))


@pytest.mark.parametrize(
    ("keys", "asked", "words"),
    [
        ({}, None, "distortion_model: .*plumb_bob.*fisheye.* 4 .*D1"),
        ({"D1": np.zeros(4), "D2": np.zeros(4)}, None, "distortion_model: .* 4 .*D1"),
        ({"camera_model": "pinhole"}, None, "distortion_model: .* 4 .*D1"),
        ({"fisheye_model": 0}, "fisheye", "distortion_model: .*fisheye.* fisheye_model = 0"),
        (
            {"distortion_model": "plumb_bob", "lens_model": "fisheye"},
            None,
            "distortion_model: .*distortion_model = plumb_bob.*lens",
        ),
        ({"distortion_model": "fov"}, None, "distortion_model: .*plumb_bob.* fov"),
        ({"camera_model": "omnidirectional"}, None, "camera_model: .* omni"),
        ({"xi1": 1.2, "xi2": 1.1}, "plumb_bob", "xi1: .* omnidirectional"),
        ({"D1": D_LEFT, "D2": D_RIGHT}, "fisheye", "D1: .* 4 .* 5$"),
        (
            {"K1": K_WIDE[0] * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]]},
            "fisheye",
            "left camera: distortion: .* 79 ",
        ),
    ],
)
def test_four_coefficients_that_no_key_explains_or_two_keys_contradict_are_refused(tmp_path, keys, asked, words):
    path = files.storage(tmp_path / "stereo.yml", _wide(**keys))
    refused(words, import_calibration, path, SIZE, "mm", distortion_model=asked)


@pytest.mark.parametrize(("keys", "asked"), [({}, "plumb_bob"), ({"model": "radtan"}, None), ({"fisheye": 0}, None)])
def test_four_coefficients_stated_as_those_of_a_pinhole_camera(tmp_path, keys, asked):
    content = files.opencv() | {"D1": D_LEFT[:4], "D2": D_RIGHT[:4], "lens_model": "Xenoplan 35"}
    path = files.storage(tmp_path / "stereo.yml", content | keys)
    imported = import_calibration(path, SIZE, "mm", distortion_model=asked)
    _assert_same(imported, (D_LEFT * [1, 1, 1, 1, 0], D_RIGHT * [1, 1, 1, 1, 0]))


def _ros_pair(folder: Path, **cameras: object) -> tuple[Path, Path]:
    left, right = (_file(folder, f"{n}.yaml", text) for n, text in enumerate(files.ros(**cameras)))
    return left, right


def test_ros_and_kalibr(tmp_path):
    """Rectified by OpenCV and written as ROS writes it, the pose comes back; likewise of fisheye lenses."""
    pytest.importorskip("yaml")
    left, right = _ros_pair(tmp_path)
    _assert_same(import_calibration(left, extrinsics=right))
    without_k3 = D_LEFT * [1, 1, 1, 1, 0], D_RIGHT * [1, 1, 1, 1, 0]
    _assert_same(_imported(tmp_path, files.kalibr()), without_k3)
    wide = tuple(zip(K_WIDE, ANGULAR, strict=True))
    _assert_wide(_imported(tmp_path, files.kalibr(wide, "equidistant")))
    left, right = _ros_pair(tmp_path, cameras=wide, model="equidistant")
    _assert_wide(import_calibration(left, extrinsics=right))
    binned = _file(tmp_path, "binned.yaml", left.read_text() + "binning_x: 2\n")
    refused("left binning_x: .* 2$", import_calibration, binned, extrinsics=right)
    refused("camera_info: ", import_calibration, left)
    refused("projection_matrix: ", import_calibration, left, extrinsics=left)


def test_a_file_of_numpy_is_read_as_opencvs_and_a_damaged_one_refused(tmp_path):
    np.savez(tmp_path / "a.npz", **files.opencv(), corners=np.zeros((30, 70, 2)))
    _assert_same(import_calibration(tmp_path / "a.npz", SIZE, "mm"))
    np.savez(tmp_path / "b.npz", M1=np.array([{"a": 1}], dtype=object))
    refused(r"b\.npz: M1\.npy: .*object", import_calibration, tmp_path / "b.npz", SIZE, "mm")
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("M1.npy", b"\x93NUMPY\x01\x00\x0e\x00garbage")
    refused(r"c\.npz: M1\.npy: ", import_calibration, tmp_path / "c.npz", SIZE, "mm")
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    refused(r"d\.zip: .*project\.xml", import_calibration, tmp_path / "d.zip", SIZE, "mm")


# What a file states of units, sizes, rotations, or leaves to the user, and what has no effect on it.


def test_units_and_sizes_that_a_file_states_are_not_overruled(tmp_path):
    content = files.opencv()
    sizes = {"image_width1": SIZE[0], "image_height1": SIZE[1], "image_width2": 1300, "image_height2": 1000}
    path = files.storage(tmp_path / "s.yml", {**content, "length_unit": "cm", **sizes})
    rig = import_calibration(path).rig
    assert rig.right_from_left.translation_m[0] == pytest.approx(-1.515)
    assert [camera.size_px.tolist() for camera in (rig.left, rig.right)] == [list(SIZE), [1300, 1000]]
    refused("length_unit: .*cm.*mm", import_calibration, path, None, "mm")
    refused("image_size: .*1300x1000.*1280x1024", import_calibration, path, SIZE)
    content = files.matlab()
    for name in ("CameraParameters1", "CameraParameters2"):
        content[name] |= {"WorldUnits": "inches"}
    translation = _imported(tmp_path, json.dumps(content)).rig.right_from_left.translation_m
    np.testing.assert_allclose(translation, 0.0254 * T_MM)
    refused("length_unit: ", _imported, tmp_path, json.dumps(content), None, "mm")


def test_cameras_too_near_or_far_for_their_unit_and_those_that_look_past_each_other_are_told(tmp_path):
    metres = files.bouguet().replace(f"{T_MM[0]:.12f}", "-0.1515").replace(f"{T_MM[2]:.12f}", "0.0245")
    metres = metres.replace(f"{T_MM[1]:.12f}", "0.00125")
    refused(r"length_unit: .*0\.000153 m.*mm", _imported, tmp_path, metres, SIZE)
    rig = _imported(tmp_path, metres, SIZE, "m").rig
    np.testing.assert_allclose(rig.right_from_left.translation_m, 1e-3 * T_MM)
    path = files.storage(tmp_path / "s.yml", files.opencv())
    warned = [notice for notice in import_calibration(path, SIZE, "m").notices if notice.severity == "warning"]
    assert warned[0].code == notices.UNUSUAL_DISTANCE.code
    assert warned[0].values == {"distance_m": pytest.approx(153.5, abs=0.1), "unit": "m"}
    turned = {**files.opencv(), "R": Rotation.from_euler("y", -18, degrees=True).as_matrix()}
    codes = [n.code for n in import_calibration(files.storage(tmp_path / "s.yml", turned), SIZE, "mm").notices]
    assert notices.NO_COMMON_VIEW.code in codes


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"E": np.eye(3)}, "E: "),
        ({"E": skew(T_MM) @ ROTATION}, None),
        ({"K2": K_RIGHT}, None),
    ],
)
def test_an_essential_matrix_in_opencvs_file_has_to_be_that_of_its_pose(tmp_path, changes, words):
    path = files.storage(tmp_path / "s.yml", files.opencv() | changes)
    if words is None:
        _assert_same(import_calibration(path, SIZE, "mm"))
    else:
        refused(words, import_calibration, path, SIZE, "mm")


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("bouguet", {"even_radial": True}, "even_radial: .*DICe.*Bouguet"),
        ("bouguet", {"distortion_model": "fisheye"}, "distortion_model: .*OpenCV"),
        ("vic3d", {"extrinsics": "calibration"}, "extrinsics: .*OpenCV.*ROS.*VIC-3D"),
        ("dice", {"even_radial": True}, "even_radial: .*K1R1_K2R2_K3R3"),
    ],
)
def test_an_option_without_effect_on_a_file_is_refused(tmp_path, text, options, words):
    texts = {
        "bouguet": files.bouguet(),
        "vic3d": files.vic3d(split=False),
        "dice": files.dice_xml("OPENCV_LENS_DISTORTION", True),
    }
    path = _file(tmp_path, "calibration", texts[text])
    named = {name: path if value == "calibration" else value for name, value in options.items()}
    refused(words, import_calibration, path, None if text != "bouguet" else SIZE, **named)


def test_what_contradicts_itself_in_dice_and_matchid_is_refused(tmp_path):
    xml = files.dice_xml("OPENCV_LENS_DISTORTION", True)
    refused("LENS_DISTORTION_MODEL: ", _imported, tmp_path, xml.replace("LENS_DISTORTION_MODEL", "LENS"))
    angles = '<Parameter name="BETA" type="double" value="0.3141" />'  # in rad beside the matrix
    words = "CAMERA 0.ALPHA, BETA, GAMMA: .*rotation_3x3_matrix"
    refused(words, _imported, tmp_path, xml.replace('<Parameter name="FX"', angles + '<Parameter name="FX"', 1))
    inch = _imported(tmp_path, files.matchid(MATCHID_POSE.format(*["inch"] * 3, "deg", "deg", 18, "deg")), SIZE)
    np.testing.assert_allclose(inch.rig.right_from_left.translation_m, 0.0254 * T_MM)
    _assert_same(
        _imported(tmp_path, files.matchid(MATCHID_POSE.format(*["mm"] * 3, "deg", "rad", np.radians(18), "deg")), SIZE)
    )
    for units, words in (
        (("mm", "mm", "m", "deg", "deg", 18, "deg"), "tx, ty, tz: .*mm, mm, m"),
        (("ell", "ell", "ell", "deg", "deg", 18, "deg"), "tx: .*ell"),
        (("mm", "mm", "mm", "deg", "gon", 20, "deg"), "phi: .*gon"),
    ):
        refused(words, _imported, tmp_path, files.matchid(MATCHID_POSE.format(*units)), SIZE)


@pytest.mark.parametrize("old", [False, True])
def test_matlab_and_the_way_through_the_calibration_file(tmp_path, old):
    imported = _imported(tmp_path, json.dumps(files.matlab(old)))
    _assert_same(imported)
    write_calibration(tmp_path / "top.json", imported.rig)
    again = read_calibration(tmp_path / "top.json")
    for first, second in zip(imported.rig.project(POINTS_M), again.project(POINTS_M), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-9)
    refused(r"top\.json: .*program", import_calibration, tmp_path / "top.json")


def test_matlab_with_two_coefficients_a_unit_nobody_knows_or_a_transposed_rotation(tmp_path):
    content = files.matlab(old=False)
    for name in ("CameraParameters1", "CameraParameters2"):
        content[name] |= {"RadialDistortion": content[name]["RadialDistortion"][:2], "WorldUnits": "squares"}
    refused("length_unit", _imported, tmp_path, json.dumps(content))
    two = [1, 1, 1, 1, 0]
    _assert_same(_imported(tmp_path, json.dumps(content), None, "mm"), (D_LEFT * two, D_RIGHT * two))
    content = files.matlab(old=False)
    cross = np.cross(np.eye(3), T_MM) * -1.0
    content["EssentialMatrix"] = (cross @ ROTATION).tolist()
    _assert_same(_imported(tmp_path, json.dumps(content)))
    content["PoseCamera2"] = {"R": ROTATION.T.tolist(), "Translation": T_MM.tolist()}
    refused("EssentialMatrix", import_calibration, _file(tmp_path, "b.json", json.dumps(content)))


def test_bouguet_as_printed_and_with_column_vectors_and_image_size(tmp_path):
    _assert_same(_imported(tmp_path, files.bouguet(), SIZE))
    both = files.bouguet() + "\nR = [ " + "; ".join(" ".join(map(repr, row)) for row in ROTATION.T.tolist()) + " ]"
    refused("om: ", _imported, tmp_path, both, SIZE)
    text = files.bouguet().replace("   ", " ;\n ") + "\nnx = 1280;\nny = 1024;"
    _assert_same(_imported(tmp_path, text.replace("± [ 1.00000 ;\n 2.00000 ]", ";")))


@pytest.mark.parametrize("relative", [True, False])
def test_dice_xml(tmp_path, relative):
    _assert_same(_imported(tmp_path, files.dice_xml("OPENCV_LENS_DISTORTION", relative)))
    radial = _imported(tmp_path, files.dice_xml("K1R3_K2R5_K3R7", relative))
    _assert_same(radial, (RADIAL_LEFT, RADIAL_RIGHT))
    none = _imported(tmp_path, files.dice_xml("NO_LENS_DISTORTION", relative))
    _assert_same(none, (np.zeros(5), np.zeros(5)))


@pytest.mark.parametrize(
    ("text", "grown"),
    [  # DICe_Camera.cpp, sensor_to_image
        (files.dice_text(radial=((0.02, -0.01, 0.3), (0.0,) * 3)), lambda r: r + 0.02 * r - 0.01 * r**2 + 0.3 * r**3),
        (
            files.dice_xml("K1R2_K2R4_K3R6", True, radial=({"K1": -1e-3, "K2": 2e-3}, {"K1": 1.5e-3, "K2": -1e-3})),
            lambda r: r - 1e-3 * r**2 + 2e-3 * r**4 + 0.02 * r**6,
        ),
        (files.dice_xml("K1R1_K2R2_K3R3", True, radial=({"K1": 0.015, "K2": 0, "K3": 0},) * 2), lambda r: 1.015 * r),
    ],
    ids=["text", "odd powers", "linear"],
)
def test_other_powers_of_dice_are_fitted_by_even_ones_and_linear_ones_are_told(tmp_path, text, grown):
    imported = _imported(tmp_path, text)
    x, y = POINTS_M[:, 0] / POINTS_M[:, 2], POINTS_M[:, 1] / POINTS_M[:, 2]
    radius = np.hypot(x, y)
    factor = grown(radius) / radius
    expected = np.stack([K_LEFT[0, 0] * x * factor + K_LEFT[0, 2], K_LEFT[1, 1] * y * factor + K_LEFT[1, 2]], axis=1)
    (approximated,) = (notice for notice in imported.notices if notice.where == "left camera")
    promised = approximated.values["largest_px"]
    assert promised < 0.1
    assert np.abs(imported.rig.left.project(POINTS_M) - expected).max() < promised + 1e-3
    linear = [n.values["left_percent"] for n in imported.notices if n.code == notices.LINEAR_POWERS.code]
    unused = [
        (n.values["camera"], n.values["coefficients"])
        for n in imported.notices
        if n.code == notices.UNUSED_COEFFICIENTS.code
    ]
    if text.startswith("#"):
        assert (linear, unused) == ([pytest.approx(2.0)], [])
    else:
        assert linear == ([pytest.approx(1.5)] if "K1R1" in text else [])
        assert unused == [("CAMERA 0", "P1, P2"), ("CAMERA 1", "P1, P2")]


def test_dice_rotation_with_few_digits_is_told(tmp_path):
    imported = _imported(tmp_path, files.dice_xml("OPENCV_LENS_DISTORTION", True, digits=4))
    assert [notice.where for notice in imported.notices if notice.severity == "warning"] == ["rotation"]
    few = files.dice_xml("OPENCV_LENS_DISTORTION", True, digits=2)
    refused("rotation: ", _imported, tmp_path, few)


@pytest.mark.parametrize("matrix", [False, True])
@pytest.mark.parametrize("size", [False, True])
def test_dice_text_of_numbers_fromopencv(tmp_path, matrix, size):
    path = _file(tmp_path, "cal.txt", files.dice_text(size=size, matrix=matrix))
    _assert_same(import_calibration(path, SIZE, even_radial=True), (RADIAL_LEFT, RADIAL_RIGHT))


def _skewed(matrix: np.ndarray, distortion: np.ndarray, points_m: np.ndarray, skew: float) -> np.ndarray:
    """Pixels with u = fx·x_d + s·y_d + cx, from OpenCV's distorted coordinates."""
    distorted = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0].reshape(-1, 2)
    sheared = matrix + np.array([[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    return distorted @ sheared[:2, :2].T + sheared[:2, 2]


@pytest.mark.parametrize("fs", [(-2.5, 1.5), (40.0, 0.3)])
def test_skew_is_taken_over_exactly(tmp_path, fs):
    rig = import_calibration(_file(tmp_path, "cal.txt", files.dice_text(fs)), even_radial=True).rig
    left = _skewed(K_LEFT, RADIAL_LEFT, POINTS_M, fs[0])
    right = _skewed(K_RIGHT, RADIAL_RIGHT, POINTS_M @ ROTATION.T + 1e-3 * T_MM, fs[1])
    for found, expected in zip(rig.project(POINTS_M), (left, right), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    printed = _imported(tmp_path, files.bouguet("0.00125"), SIZE).rig.left  # of the focal length
    np.testing.assert_allclose(
        printed.project(POINTS_M), _skewed(K_LEFT, D_LEFT, POINTS_M, 0.00125 * 3200.5), atol=1e-6
    )


@pytest.mark.parametrize("split", [False, True])
def test_vic3d(tmp_path, split):
    path = tmp_path / "project.xml"
    path.write_text(files.vic3d(split), encoding="latin-1")
    _assert_same(import_calibration(path), (RADIAL_LEFT, RADIAL_RIGHT))
    loud = files.vic3d(split, size=False).upper().replace("Ü", "U")
    for word in ("encoding", "version", "xml"):
        loud = loud.replace(word.upper(), word, 1)
    path.write_text(loud, encoding="latin-1")
    _assert_same(import_calibration(path, SIZE), (RADIAL_LEFT, RADIAL_RIGHT))
    with zipfile.ZipFile(tmp_path / "a.z3d", "w") as archive:
        archive.writestr("project.xml", files.vic3d(split).encode("latin-1"))
    _assert_same(import_calibration(tmp_path / "a.z3d"), (RADIAL_LEFT, RADIAL_RIGHT))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("hello\nworld", "OpenCV, .*Kalibr, .*'hello'"),
        ("\n".join("x" * 22), "OpenCV, .*'x'"),
        ("1\n" + "\n".join("x" * 21), "content: .* 22 "),
        ("M1: [[900, 0, 320]\nD1: [0]", "YAML.*flow"),
        ("image_width: 640\nimage_height: 480", "M1.*M2"),
        ("%YAML:1.0\n---\nM1: !!files.opencv-matrix\n  garb", "expected"),
        ("%YAML:1.0\n---\nM1: [1, 2", "OpenCV"),
        ("{", "JSON"),
        ("[1, 2]", " 22, 24, 28 .*30 "),
        ('{"CameraParameters1": 3}', "CameraParameters1: "),
        ("<html></html>", "<html>"),
        ("<a><b></a>", "XML"),
        ("<ParameterList/>", "xml_file_format"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><project>&b;</project>', "entities"),
        ("<a>" * 10000, " 64 elements"),
        ("[" * 100000, " 64 lists"),
        ('{"a": ' * 100000, " 64 lists"),
        ("%YAML:1.0\n---\na: " + "[" * 100000, " 64 lists"),
        ("MATLAB 5.0 MAT-file, cut off", r"\.mat"),
        ("MATLAB 7.3 MAT-file, cut off", r"\.mat|mat-io"),
        ("cam0: &a [*a]\ncam0:\n", "references"),
        ("cam0:\n  x: [1", "YAML"),
        ("cam0:\n- " + "- " * 5000 + "1", "YAML"),
        ("cam0:\n  camera_model: pinhole", "cam0.*cam1.*cam0$"),
        (
            "cam0:\n  camera_model: omni\ncam1:\n  x: 1",
            "cam0: .*pinhole-radtan.*omni-None",
        ),
        ("distortion_model: plumb_bob", "camera_info: "),
        ("Cam0_Fx;1\nCam0_Fy;1", " 0 .* 1"),
        ("Cam0_Fx;1\nCam0_Fy;1\nCam1_Fx;a", "cam0cx: missing"),
        ("<project><camera id='0'/></project>", "camera: .* 0 .* 1"),
        ("fc_left = [ 1 2 ]", "cc_left: missing"),
        ("fc_left = [ 1 2 3 ]", "fc_left: .* 2 .*3$"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_sentence(tmp_path, text, message):
    path = _file(tmp_path, "calibration.txt", text)
    with pytest.raises(ValueError, match=message) as caught:
        import_calibration(path, SIZE, "mm")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_exchanged_width_and_height_are_told(tmp_path):
    path = _file(tmp_path, "cal.txt", files.dice_text(size=False))
    imported = import_calibration(path, (600, 800), even_radial=True)
    warned = [n for n in imported.notices if n.severity == "warning"]
    assert [n.code for n in warned] == 2 * [notices.CENTRE_OUTSIDE_IMAGE.code]
    imported = import_calibration(path, (2560, 2048), even_radial=True)  # the matrix of pictures half as large
    warned = [n for n in imported.notices if n.severity == "warning"]
    assert [notice.code for notice in warned] == 2 * [notices.CENTRE_FAR_FROM_MIDDLE.code]
    assert (warned[0].values["width_px"], warned[0].values["height_px"]) == (2560, 2048)
    words = "image_size: .*1280x1024.*1024x1280"
    refused(words, _imported, tmp_path, files.dice_text(), (1024, 1280))


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


def test_vic3d_calibration_fits_the_matches_of_its_recording(data_dir, tmp_path):
    table = np.genfromtxt(data_dir / "gt4_stereo" / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True)
    left, right = (np.column_stack([table[f"{name}x"], table[f"{name}y"]]) for name in ("", "r2_"))
    residuals = {sign: epipolar_residual(_gt4(tmp_path, sign), left, right)[0] for sign in (1.0, 0.0, -1.0)}
    spread = {sign: 1.4826 * np.median(np.abs(e - np.median(e))) for sign, e in residuals.items()}
    assert abs(np.median(residuals[1.0])) < 0.14
    assert spread[1.0] < 0.028
    assert spread[1.0] < 0.95 * spread[0.0] < 0.95 * spread[-1.0]
    median = {sign: abs(np.median(e)) for sign, e in residuals.items()}
    assert median[1.0] < median[0.0] < median[-1.0]


def test_vic3d_project(data_dir):
    imported = import_calibration(data_dir / "static_stereo" / "cal.xml")
    pose = imported.rig.right_from_left
    assert (imported.format, imported.rig.left.size_px.tolist()) == ("VIC-3D", [1280, 800])
    assert pose.translation_m[0] == pytest.approx(0.1308, abs=1e-4)
    assert _turned_deg(pose.rotation)[1] == pytest.approx(-2 * 9.015, abs=0.02)
    assert all(notice.severity == "note" for notice in imported.notices)


def test_dice_text_of_a_peer_whose_numbers_are_vic3ds(data_dir):
    """Of the same cameras this program's own calibration has 12543 px (docs/real-data.md), DICe's order 8.5 % more."""
    path = data_dir / "dotgrid_stereo" / "peer_cal.txt"
    refused("image_size", import_calibration, path)
    rig = import_calibration(path, (2448, 2048), even_radial=True).rig
    np.testing.assert_allclose(rig.left.parameters[:4], [12577.41, 12575.82, 1202.508, 1056.028], atol=1e-9)
    assert rig.right.parameters[4] == 0.07
    assert rig.left.matrix[0, 1] == -2.85
    translation = [-0.086494, 0.000582, 0.02353]
    np.testing.assert_allclose(rig.right_from_left.translation_m, translation, atol=1e-9)
    as_dice = import_calibration(path, (2448, 2048))
    np.testing.assert_allclose(as_dice.rig.left.parameters[0], 1.085 * 12577.41, rtol=1e-6)
    assert [notice.where for notice in as_dice.notices if notice.severity == "warning"] == ["distortion"]


# ROS, Kalibr, MatchID, MATLAB's own files: what the programs themselves, or geometry, say of samples.


@pytest.fixture
def formats(data_dir):
    folder = data_dir / "formats"
    if not folder.is_dir():
        pytest.skip("no sample files of laboratory formats")
    return folder


def _turned_deg(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)


WARNED = {"kalibr/camchain_F1_F2_IMU1.yaml": 2, "vic3d/cal_b.xml": 3}
"""Few digits and two cameras of a robot that look past each other; principal points of a part of the picture."""


@pytest.mark.parametrize(
    ("name", "fx_px", "angles", "translation_mm"),
    [  # relative poses computed from the files; that of cal_a also printed by Sandia (dice/cal_a.txt)
        ("ros_camera_info/left.yaml", 696.262741, (0.30361, 0.88381, -0.06917), (-516.159, 0.216, 5.369)),
        ("kalibr/open_vins_euroc_kalibr_imucam_chain.yaml", 458.654, None, (-110.07381, 0.39912, -0.8537)),
        ("kalibr/camchain_F1_F2_IMU1.yaml", 2357.860520, (40.002, 0, 0), (0, -206.1, -84.2)),
        ("matlab_stereo/stereoParams.mat", 1120.324001, None, (-50.07139664, -2.98262452, -2.63608454)),
        ("dice/sim_dot_cal_gold.xml", 6673.3159, (0.13068954, -19.0676936, 0.281404038), None),
        ("dice/stereo_rectified_cal.xml", None, (0.455106, 34.92894, 0.067867), None),
        ("vic3d/cal_a.xml", None, (0.09008, -18.03023, -0.08766), (130.75485, -0.61049, 17.13290)),
        ("vic3d/stereo_d_spec_cal.xml", None, (0.11048, -18.83214, 0.08691), (121.44562, 0.18669, 20.74752)),
        ("vic3d/project_xml_from_z3d.xml", None, (0.12659, 27.44298, 0.30813), (-229.07086, -0.75305, 49.44478)),
        ("vic3d/cal_b.xml", None, (-0.66620, 29.50270, -1.37167), (-3674.07965, -20.96650, 1040.45140)),
    ],
)
def test_files_of_laboratories(formats, name, fx_px, angles, translation_mm):
    pytest.importorskip("yaml" if name.endswith("yaml") else "matio" if name.endswith("mat") else "numpy")
    right = formats / "ros_camera_info" / "right.yaml" if "ros" in name else None
    imported = import_calibration(formats / name, (2448, 2048) if "z3d" in name else None, extrinsics=right)
    pose = imported.rig.right_from_left
    assert fx_px is None or imported.rig.left.matrix[0, 0] == pytest.approx(fx_px, abs=1e-6)
    if angles is not None:
        np.testing.assert_allclose(_turned_deg(pose.rotation), angles, atol=6e-6 if "vic3d" in name else 3e-4)
    if translation_mm is not None:
        np.testing.assert_allclose(1e3 * pose.translation_m, translation_mm, atol=1e-3 if "ros" in name else 6e-6)
    assert sum(notice.severity == "warning" for notice in imported.notices) == WARNED.get(name, 0)


def test_kalibr_of_other_cameras_is_refused(formats):
    pytest.importorskip("yaml")
    refused("cam1: .*pinhole-radtan.*omni", import_calibration, formats / "kalibr" / "camchain.yaml")
    refused("cam0$", import_calibration, formats / "kalibr" / "camchain_mono_F1.yaml")


def test_kalibr_pose_by_the_imu_is_the_one_between_the_cameras(formats, tmp_path):
    """Kalibr's documented example states both; its second camera, an omni, stands in as a pinhole here."""
    pytest.importorskip("yaml")
    text = (formats / "kalibr" / "camchain.yaml").read_text(encoding="utf-8")
    text = text.replace("omni", "pinhole").replace("[0.80065662, 833.006", "[833.006")
    both = _imported(tmp_path, text).rig.right_from_left
    start = text.index("  T_cn_cnm1")
    by_imu = _imported(tmp_path, text[:start] + text[text.index("  T_cam_imu", start) :]).rig.right_from_left
    np.testing.assert_allclose(by_imu.translation_m, both.translation_m, atol=1e-7)
    np.testing.assert_allclose(by_imu.rotation, both.rotation, atol=1e-7)


def test_matchid(formats, tmp_path):
    """The second camera of the sample stands 187 mm beside the first one, no nearer, no farther, turned to it."""
    path = formats / "matchid" / "calib.caldat"
    imported = import_calibration(path, (20, 20))
    pose = imported.rig.right_from_left
    assert imported.format == "MatchID"
    np.testing.assert_allclose(_turned_deg(pose.rotation), [0, 15, 0], atol=1e-12)
    np.testing.assert_allclose(-pose.rotation.T @ pose.translation_m, [0.187, 0, 0], atol=1e-12)
    renamed = path.read_text(encoding="utf-8").replace("Cam1", "Cam2").replace("Cam0", "Cam1")
    underscored = path.read_text(encoding="utf-8").replace(" [pixels];", "_px,").replace(" [mm];", "_mm,")
    underscored = underscored.replace(" [deg];", "_deg,").replace("Kappa ", "k").replace(";", ",").lower()
    assert "cam0_fx_px, 2898" in underscored
    for text in (renamed, underscored):
        again = _imported(tmp_path, text, (20, 20)).rig
        np.testing.assert_array_equal(again.values, imported.rig.values)
        np.testing.assert_array_equal(again.right_from_left.rotation, pose.rotation)


def _in_other_files(kind: str, folder: Path) -> Path:
    """A `.mat` file of version 7.3 that takes a matrix from elsewhere."""
    (folder / "secret").write_bytes(np.arange(2.0).tobytes())
    layout = h5py.VirtualLayout((1, 2), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "a", (1, 2))
    with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
        if kind == "link":
            file["fc_left"] = h5py.ExternalLink(str(folder / "other.h5"), "/a")
        elif kind == "storage":
            file.create_dataset("fc_left", (1, 2), "f8", external=[(str(folder / "secret"), 0, 16)])
        else:
            file.create_virtual_dataset("fc_left", layout)
    with (folder / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return folder / "a.mat"


@pytest.mark.parametrize("kind", ["link", "storage", "virtual"])
def test_a_calibration_takes_nothing_from_other_files(kind, tmp_path):
    path = _in_other_files(kind, tmp_path)
    refused(r"a\.mat: ", import_calibration, path)


def test_matlab_object_as_mat_io_prints_it(formats, tmp_path, monkeypatch):
    path = formats / "matlab_stereo" / "stereoParams.mat"
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "matio", None)
        refused("mat-io.*jsonencode", import_calibration, path)
    pytest.importorskip("matio")
    distortion = [0.18890753, -1.28717634, 0, 0, 2.13349311]
    np.testing.assert_allclose(import_calibration(path).rig.left.parameters[4:9], distortion, atol=5e-9)
    cut = tmp_path / "cut.mat"
    cut.write_bytes(path.read_bytes()[:9000])
    refused(r"cut\.mat: ", import_calibration, cut)


def test_matlab_struct_and_bouguets_variables_in_a_mat_file(tmp_path):
    savemat(tmp_path / "s.mat", {"s": files.matlab(old=True)})
    _assert_same(import_calibration(tmp_path / "s.mat"))
    savemat(tmp_path / "b.mat", files.bouguet_variables())
    _assert_same(import_calibration(tmp_path / "b.mat"))
    savemat(tmp_path / "c.mat", {"x": 1.0})
    refused("stereoParameters.* x$", import_calibration, tmp_path / "c.mat")


def test_dice_text_of_sandia_has_the_numbers_of_vic3d_and_a_system_two_sizes(formats):
    vic3d = import_calibration(formats / "vic3d" / "cal_a.xml").rig
    assert vic3d.left.matrix[0, 1] == -0.1711976745
    for name in ("cal_a.txt", "cal_a_with_R.txt"):
        text = import_calibration(formats / "dice" / name, even_radial=True).rig
        np.testing.assert_allclose(text.left.parameters, vic3d.left.parameters, rtol=1e-9)
        np.testing.assert_allclose(text.right_from_left.rotation, vic3d.right_from_left.rotation, atol=2e-5)
    rig = import_calibration(formats / "dice" / "DICe_cal_a.xml").rig
    assert [camera.size_px.tolist() for camera in (rig.left, rig.right)] == [[1200, 800], [1200, 700]]


def test_zipped_project_that_unpacks_to_too_much_and_a_missing_package(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "a.z3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("project.xml", b" " * (65 * 2**20))
    refused("project.xml.* 16 MB", import_calibration, tmp_path / "a.z3d")
    monkeypatch.setitem(sys.modules, "yaml", None)
    refused("PyYAML.*shakercal.formats", _imported, tmp_path, "cam0:\n  x: 1\n")


# And out again.


def test_export_to_opencv_is_what_opencv_reads(tmp_path):
    rig = files.make_rig(tangential=1.0, divisor=1.0)
    assert export_calibration(tmp_path / "rig.yml", rig) == ("OpenCV", ())
    written = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    read = {name: written.getNode(name).mat() for name in ("M1", "D1", "M2", "D2", "R", "T")}
    left = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), read["M1"], read["D1"])[0]
    right = cv2.projectPoints(POINTS_M, cv2.Rodrigues(read["R"])[0], read["T"], read["M2"], read["D2"])[0]
    for found, expected in zip((left, right), rig.project(POINTS_M), strict=True):
        np.testing.assert_allclose(found.reshape(-1, 2), expected, atol=1e-9)
    (notice,) = (
        n for n in export_calibration(tmp_path / "rig.yml", files.make_rig(skew_px=0.5))[1] if n.where == "left camera"
    )
    assert (notice.code, notice.values) == (notices.SKEW_IGNORED.code, {"skew_px": 0.5})


@pytest.mark.parametrize(
    ("name", "stated"),
    [
        ("rig.yaml", {"tangential": 1.0, "divisor": 1.0, "skew_px": 0.5}),
        ("rig.xml", {"skew_px": 0.5}),
        ("rig.json", {"tangential": 1.0, "skew_px": 0.5}),
    ],
)
def test_exported_calibrations_come_back_to_the_last_digits(tmp_path, name, stated):
    rig = files.make_rig(**stated)
    export_calibration(tmp_path / name, rig)
    again = import_calibration(tmp_path / name).rig
    np.testing.assert_allclose(again.values, rig.values, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(again.right_from_left.rotation, rig.right_from_left.rotation, atol=1e-12)
    assert again.left.size_px.tolist() == list(SIZE)


@pytest.mark.parametrize(("name", "stated"), [("rig.xml", {"tangential": 0.5}), ("rig.json", {"divisor": 1.0})])
def test_export_of_what_a_program_has_not_stays_within_what_it_says(tmp_path, name, stated):
    """A point seen by the original is, in the frame of the exported pair, the same point: through both cameras."""
    rig = files.make_rig(**stated)
    promised = max(notice.values["largest_px"] for notice in export_calibration(tmp_path / name, rig)[1])
    again = import_calibration(tmp_path / name).rig
    for side in ("left", "right"):
        pixels, seen = (getattr(which, side) for which in (rig, again))
        rays, found = (camera.undistort(pixel_grid(rig.left.size_px)) for camera in (pixels, seen))
        turn = Rotation.align_vectors(*(np.column_stack([xy, np.ones(len(xy))]) for xy in (found, rays)))[0].as_matrix()
        back = seen.project(np.column_stack([rays, np.ones(len(rays))]) @ turn.T)
        assert np.linalg.norm(back - pixel_grid(rig.left.size_px), axis=1).max() < 1.3 * promised + 1e-3
    assert promised < 0.2


def test_export_is_refused_where_it_would_not_hold(tmp_path):
    words = r"left camera: .*p1 = 0.01, p2 = -0.005 .* \d\.\d+ px"
    refused(words, export_calibration, tmp_path / "rig.xml", files.make_rig(tangential=10.0))
    refused(r"rig\.txt: .*\.yml.*\.txt", export_calibration, tmp_path / "rig.txt", files.make_rig())
    assert not list(tmp_path.iterdir())
