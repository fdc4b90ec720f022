"""The calibration file: what is written comes back, and every wrong file is refused by file and key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photogram.calibration.file import read_calibration, write_calibration
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform

EXAMPLE = """{"format": 1, "image_size": [1280, 1024],
 "left":  {"matrix": [[3200, 0, 640], [0, 3200, 512], [0, 0, 1]], "distortion": [-0.08, 0.05, 0, 0, 0]},
 "right": {"matrix": [[3200, 0, 640], [0, 3200, 512], [0, 0, 1]], "distortion": [-0.08, 0.05, 0, 0, 0]},
 "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [-0.15, 0, 0],
 "reprojection_rms": 0.05, "covariance": null}"""


def rig(covariance: np.ndarray | None) -> StereoRig:
    matrix = np.array([[3201.123456789, 0, 639.5], [0, 3199.87654321, 511.25], [0, 0, 1]])
    left = Camera(matrix, np.array([-0.08, 0.05, 1e-4, -2e-4, 0.3]), np.array([1280, 1024]))
    right = Camera(matrix + np.diag([1 / 3, 1 / 7, 0]), np.zeros(5), np.array([1280, 1024]))
    pose = RigidTransform.from_pose(np.array([-0.15, 1 / 3e3, 0.02, 0.01, 0.34, -0.005]))
    return StereoRig(left, right, pose, covariance)


def full_covariance() -> np.ndarray:
    root = np.random.default_rng(0).normal(size=(24, 24)) * np.logspace(-6, 0, 24)[:, None]
    covariance = root @ root.T
    return (covariance + covariance.T) / 2


def changed(tmp_path: Path, **changes: Any) -> Path:
    path = tmp_path / "top.json"
    path.write_text(json.dumps(json.loads(EXAMPLE) | changes))
    return path


def test_the_formats_example_is_read(tmp_path: Path) -> None:
    path = tmp_path / "top.json"
    path.write_text(EXAMPLE)
    found = read_calibration(path)
    np.testing.assert_array_equal(found.left.size_px, [1280, 1024])
    np.testing.assert_array_equal(found.right.distortion, [-0.08, 0.05, 0, 0, 0])
    np.testing.assert_array_equal(found.right_from_left.translation_m, [-0.15, 0, 0])
    assert found.covariance is None


@pytest.mark.parametrize("covariance", [None, full_covariance()], ids=["without", "with"])
def test_what_is_written_comes_back(tmp_path: Path, covariance: np.ndarray | None) -> None:
    path = tmp_path / "top.json"
    write_calibration(path, rig(covariance), 0.0421)
    found, expected = read_calibration(path), rig(covariance)
    for side in ("left", "right"):
        np.testing.assert_array_equal(getattr(found, side).parameters, getattr(expected, side).parameters)
    np.testing.assert_allclose(found.right_from_left.rotation, expected.right_from_left.rotation, atol=1e-15)
    np.testing.assert_array_equal(found.right_from_left.translation_m, expected.right_from_left.translation_m)
    if covariance is None:
        assert found.covariance is None
    else:
        np.testing.assert_array_equal(found.covariance, covariance)
    assert json.loads(path.read_text())["reprojection_rms"] == 0.0421
    assert [entry.name for entry in tmp_path.iterdir()] == ["top.json"]


def test_parameters_left_out_of_the_covariance_have_none(tmp_path: Path) -> None:
    names = ["translation.x", "left.fx"]
    block = {"parameters": names, "matrix": [[4e-10, 1e-6], [1e-6, 0.25]]}
    covariance = read_calibration(changed(tmp_path, covariance=block)).covariance
    x, fx = (RIG_PARAMETERS.index(name) for name in names)
    expected = np.zeros((24, 24))
    expected[x, x], expected[fx, fx], expected[x, fx], expected[fx, x] = 4e-10, 0.25, 1e-6, 1e-6
    np.testing.assert_array_equal(covariance, expected)


def test_a_rotation_of_few_digits_is_made_exact(tmp_path: Path) -> None:
    angle = 0.3
    rotation = np.round([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], 7)
    found = read_calibration(changed(tmp_path, rotation=rotation.tolist())).right_from_left.rotation
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(found, rotation, atol=1e-7)


CAMERA = json.loads(EXAMPLE)["left"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 1e-5, 1]]}, "rotation: expected an orthonormal"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation: .*reflection"),
        ({"rotation": [[1, 0], [0, 1]]}, r"rotation: expected an array of shape \(3, 3\)"),
        ({"rotation": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "rotation: expected rows of one length"),
        ({"translation": [0.1, 0.2]}, "translation: expected an array"),
        ({"translation": [0.1, "0.2", 0]}, "translation: expected numbers, found '0.2'"),
        ({"translation": [0.1, True, 0]}, "translation: expected numbers, found True"),
        ({"translation": [0.1, float("nan"), 0]}, "translation: expected finite"),
        ({"format": 2}, "format: expected 1, found 2"),
        ({"image_size": [1280.5, 1024]}, "image_size: expected two whole"),
        ({"image_size": [0, 1024]}, "image_size: expected two whole"),
        ({"units": "mm"}, "units: unknown key"),
        ({"left": CAMERA | {"skew": 0}}, "left.skew: unknown key"),
        ({"left": {"matrix": CAMERA["matrix"]}}, "left.distortion: missing key"),
        ({"right": CAMERA | {"distortion": [0, 0, 0, 0]}}, "right.distortion: expected an array"),
        ({"right": CAMERA | {"matrix": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}}, "right.matrix: expected"),
        ({"right": 3}, "right: expected an object"),
        ({"reprojection_rms": "good"}, "reprojection_rms: expected numbers"),
        ({"covariance": [1]}, "covariance: expected an object"),
        ({"covariance": {"parameters": [], "matrix": []}}, "covariance.parameters: expected a list"),
        ({"covariance": {"parameters": ["left.f"], "matrix": [[1]]}}, "covariance.parameters: .* found 'left.f'"),
        ({"covariance": {"parameters": ["left.fx"] * 2, "matrix": [[1, 0], [0, 1]]}}, "each name once"),
        ({"covariance": {"parameters": ["left.fx"], "matrix": [[1, 0]]}}, "covariance.matrix: expected an array"),
        ({"covariance": {"parameters": ["left.fx"], "matrix": [[-1]]}}, "covariance: expected"),
        ({"covariance": {"parameters": ["left.fx", "left.fy"], "matrix": [[1, 2], [2, 1]]}}, "covariance: expected"),
    ],
)
def test_wrong_content_is_refused_by_file_and_key(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = changed(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("key", list(json.loads(EXAMPLE)))
def test_every_key_is_required(tmp_path: Path, key: str) -> None:
    content = json.loads(EXAMPLE)
    del content[key]
    (tmp_path / "top.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=f"top.json: {key}: missing key"):
        read_calibration(tmp_path / "top.json")


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"format": 1, "format": 1}', "\x80"])
def test_what_is_no_calibration_text_is_refused_by_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "top.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"top\.json: "):
        read_calibration(tmp_path / "top.json")


def test_an_absent_file_is_an_os_error_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"absent\.json"):
        read_calibration(tmp_path / "absent.json")


def test_cameras_of_two_sizes_cannot_be_written(tmp_path: Path) -> None:
    one = rig(None)
    other = Camera(one.right.matrix, one.right.distortion, np.array([640, 512]))
    with pytest.raises(ValueError, match="images of one size"):
        write_calibration(tmp_path / "top.json", StereoRig(one.left, other, one.right_from_left))
    assert not list(tmp_path.iterdir())
