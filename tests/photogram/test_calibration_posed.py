"""Calibrations of COLMAP, mrcal, anipose, caliscope and Metashape: what OpenCV projects with the file's numbers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import posed_files as files
import pytest
from calibration_files import D_LEFT, D_RIGHT, K_LEFT, K_RIGHT, ROTATION, SIZE, T_MM
from contracts import refused

from photogram.calibration import calibration_notices as notices
from photogram.calibration.calibration_file import read_calibration, write_calibration
from photogram.calibration.exchange.exchange_files import import_calibration
from photogram.calibration.exchange.lens import ImportedCalibration
from photogram.camera import triangulate

POINTS_M = np.random.default_rng(5).uniform([-0.1, -0.1, 0.9], [0.1, 0.1, 1.2], (60, 3))
PLAIN = (D_LEFT, D_RIGHT)
MATRICES = (K_LEFT, K_RIGHT)


def _projected(distortions=PLAIN, matrices=MATRICES, points=POINTS_M, fisheye: bool = False) -> list[np.ndarray]:
    """What OpenCV projects of points in the left camera's frame."""
    poses = (np.zeros(3), np.zeros(3)), (cv2.Rodrigues(ROTATION)[0].ravel(), 1e-3 * T_MM)
    pixels = []
    for (turn, shift), matrix, distortion in zip(poses, matrices, distortions, strict=True):
        if fisheye:
            bent = np.asarray(distortion, dtype=float).reshape(4, 1)
            pixels.append(cv2.fisheye.projectPoints(points[None], turn, shift, matrix, bent)[0][0])
        else:
            pixels.append(cv2.projectPoints(points, turn, shift, matrix, np.asarray(distortion))[0][:, 0])
    return pixels


def _assert_same(imported: ImportedCalibration, program: str, expected=None, points=POINTS_M, px: float = 1e-6) -> None:
    assert imported.format == program
    found = imported.rig.project(points)
    for seen, truth in zip(found, _projected() if expected is None else expected, strict=True):
        inside = ((truth > 0) & (truth < np.array(SIZE) - 1)).all(axis=1)
        assert inside.sum() > 20
        np.testing.assert_allclose(seen[inside], truth[inside], atol=px)
    assert imported.notices[-1].code == notices.UNCERTAINTIES_MISSING.code


def _write(folder: Path, name: str, content: str | bytes) -> Path:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / name


# COLMAP.


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("points", ["100.5 200.25 -1 30 40 17\n", ""])
def test_colmap(tmp_path, binary, points):
    first, second = files.colmap_binary(points=len(points)) if binary else files.colmap_text(points=points)
    path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second)
    imported = import_calibration(path, length_unit="m", extrinsics=images)
    _assert_same(imported, "COLMAP")
    assert notices.ARBITRARY_SCALE.code in {notice.code for notice in imported.notices}
    mm = import_calibration(path, length_unit="mm", extrinsics=images).rig.right_from_left.translation_m
    np.testing.assert_allclose(1e3 * mm, imported.rig.right_from_left.translation_m)
    refused("a: length_unit: ", import_calibration, path, extrinsics=images)
    refused("a: extrinsics: .*images.txt", import_calibration, path, length_unit="m")


@pytest.mark.parametrize("binary", [False, True])
def test_two_of_several_colmap_images_are_chosen_by_name(tmp_path, binary):
    (two, one), extra = files.IMAGES, (9, files.POSES[0], 3, "third.png")
    write = files.colmap_binary if binary else files.colmap_text
    first, second = write(images=(one, extra, two))
    path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second)
    stated = {"length_unit": "m", "extrinsics": images}
    _assert_same(import_calibration(path, cameras=("left 01.png", "right/01.png"), **stated), "COLMAP")
    refused("cameras: .*right/01.png, third.png, left 01.png", import_calibration, path, **stated)
    refused("'x'.*0 times", import_calibration, path, cameras=("x", "third.png"), **stated)
    refused("different", import_calibration, path, cameras=("third.png", "third.png"), **stated)


@pytest.mark.parametrize(
    ("model", "parameters", "distortion", "fisheye"),
    [
        ("SIMPLE_PINHOLE", [3200, 640, 512], [0, 0, 0, 0], False),
        ("PINHOLE", [3200, 3190, 640, 512], [0, 0, 0, 0], False),
        ("SIMPLE_RADIAL", [3200, 640, 512, -0.08], [-0.08, 0, 0, 0], False),
        ("RADIAL", [3200, 640, 512, -0.08, 0.3], [-0.08, 0.3, 0, 0], False),
        ("OPENCV", [3200, 3190, 640, 512, -0.08, 0.3, 1e-3, -2e-3], [-0.08, 0.3, 1e-3, -2e-3], False),
        ("FULL_OPENCV", [3200, 3190, 640, 512, -0.08, 0.3, 1e-3, -2e-3, 0.2, 0.1, 0.3, -0.2], None, False),
        ("OPENCV_FISHEYE", [900, 905, 640, 512, -0.02, 0.01, -0.01, 0.003], [-0.02, 0.01, -0.01, 0.003], True),
        ("SIMPLE_RADIAL_FISHEYE", [900, 640, 512, -0.02], [-0.02, 0, 0, 0], True),
        ("RADIAL_FISHEYE", [900, 640, 512, -0.02, 0.01], [-0.02, 0.01, 0, 0], True),
    ],
)
def test_every_lens_of_colmap(tmp_path, model, parameters, distortion, fisheye):
    """Its pixels count from the image's corner, OpenCV's from the first pixel's centre."""
    fx, fy, cx, cy = (parameters[0], *parameters[:3]) if len(parameters) % 2 else parameters[:4]
    one_focal = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    fx, fy, cx, cy = (parameters[0], *parameters[:3]) if one_focal else parameters[:4]
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])
    points = np.random.default_rng(6).uniform([-0.5, -0.4, 0.8], [0.5, 0.4, 1.0], (200, 3)) if fisheye else POINTS_M
    expected = _projected([distortion or parameters[4:]] * 2, [matrix] * 2, points, fisheye)
    cameras = [(number, model, SIZE, parameters) for number, *_ in files.CAMERAS]
    for write in (files.colmap_text, files.colmap_binary):
        first, second = write(cameras=cameras)
        path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second)
        imported = import_calibration(path, length_unit="m", extrinsics=images)
        _assert_same(imported, "COLMAP", expected, points, 2e-3 if fisheye else 1e-6)


@pytest.mark.parametrize(
    ("model", "parameters", "words"),
    [
        ("FOV", [900, 900, 640, 512, 0.9], "found FOV"),
        ("THIN_PRISM_FISHEYE", [900, 900, 640, 512, *[0.01] * 8], "found THIN_PRISM_FISHEYE"),
    ],
)
def test_lenses_of_colmap_without_a_counterpart_are_refused(tmp_path, model, parameters, words):
    for write in (files.colmap_text, files.colmap_binary):
        first, second = write(cameras=[(number, model, SIZE, parameters) for number, *_ in files.CAMERAS])
        path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second)
        refused(words, import_calibration, path, length_unit="m", extrinsics=images)


def test_what_is_wrong_in_colmaps_files_is_named(tmp_path):
    first, second = files.colmap_text()
    path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second.replace(" 7 left", " 5 left"))
    stated = {"length_unit": "m", "extrinsics": images}
    refused("left 01.png: .*cameras 7, 3.*found 5", import_calibration, path, **stated)
    _write(tmp_path, "b", second.replace("\n2 ", "\n2 9"))
    refused("quaternion", import_calibration, path, **stated)
    _write(tmp_path, "b", "nothing\n")
    refused("images: ", import_calibration, path, **stated)
    short = first.replace(" FULL_OPENCV", " OPENCV")
    _write(tmp_path, "b", second)
    refused("8 parameters of OPENCV, found 12", import_calibration, _write(tmp_path, "a", short), **stated)
    cameras, poses = files.colmap_binary()
    _write(tmp_path, "b", poses + b"\0" * 8)
    refused("8 bytes after the last image", import_calibration, _write(tmp_path, "a", cameras), **stated)
    for end in (30, 90, len(poses) - 5):
        _write(tmp_path, "b", poses[:end])
        refused("images: ", import_calibration, tmp_path / "a", **stated)


# mrcal.


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("PINHOLE", []),
        ("OPENCV4", [-0.08, 0.05, 1e-3, -5e-4]),
        ("OPENCV5", D_LEFT.tolist()),
        ("OPENCV8", [*D_LEFT, 0.02, -0.03, 0.01]),
        ("OPENCV12", [*D_LEFT, 0.02, -0.03, 0.01, 0, 0, 0, 0]),
    ],
)
def test_mrcal(tmp_path, model, distortion):
    left, right = (_write(tmp_path, name, files.mrcal(k, model, distortion)) for k, name in enumerate("ab"))
    bent = distortion or [0.0] * 5
    imported = import_calibration(left, extrinsics=right)
    _assert_same(imported, "mrcal", _projected((bent, bent)))
    assert imported.rig.left.size_px.tolist() == list(SIZE)


def test_mrcal_models_without_a_counterpart_are_refused(tmp_path):
    left, right = (_write(tmp_path, name, files.mrcal(k)) for k, name in enumerate("ab"))
    refused("a: extrinsics: .*right camera", import_calibration, left)
    splined = files.mrcal(1).replace(
        "LENSMODEL_OPENCV5", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170"
    )
    _write(tmp_path, "b", splined)
    refused("right lensmodel: .*mrcal-convert-lensmodel.*SPLINED", import_calibration, left, extrinsics=right)
    for model in ("CAHVOR", "LONLAT", "STEREOGRAPHIC"):
        _write(tmp_path, "b", files.mrcal(1, model))
        refused(f"right lensmodel: .*{model}", import_calibration, left, extrinsics=right)
    prism = [*D_LEFT, 0, 0, 0, 0.01, 0, 0, 0]
    _write(tmp_path, "b", files.mrcal(1, "OPENCV12", prism))
    refused("right intrinsics: .*s1 = 0.01", import_calibration, left, extrinsics=right)
    _write(tmp_path, "b", files.mrcal(1, "OPENCV8"))
    refused("right intrinsics: .*12 numbers, found 9", import_calibration, left, extrinsics=right)
    _write(tmp_path, "b", "{'lensmodel': __import__('os').getpid(), 'x': 'LENSMODEL_'}")
    refused("right camera: ", import_calibration, left, extrinsics=right)


# anipose and caliscope.


@pytest.mark.parametrize("vectors", [True, False])
@pytest.mark.parametrize("nested", [True, False])
def test_caliscope_and_anipose(tmp_path, vectors, nested):
    path = _write(tmp_path, "a", files.toml(True, vectors, nested))
    _assert_same(import_calibration(path), "caliscope")
    anipose = _write(tmp_path, "b", files.toml(False, vectors, nested))
    refused("b: length_unit: ", import_calibration, anipose)
    _assert_same(import_calibration(anipose, length_unit="m"), "anipose")
    swapped = import_calibration(anipose, length_unit="m", cameras=("B", "A")).rig.right_from_left
    np.testing.assert_allclose(swapped.rotation, ROTATION.T, atol=1e-12)
    refused("cameras: .*'C' once among A, B", import_calibration, anipose, length_unit="m", cameras=("A", "C"))


def test_fisheye_cameras_of_anipose_and_what_is_wrong(tmp_path):
    wide = ([-0.012, 0.021, -0.018, 0.0045], [-0.02, 0.01, -0.003, 0.001])
    path = _write(tmp_path, "a", files.toml(distortions=wide, extra="fisheye = true"))
    _assert_same(import_calibration(path, length_unit="m"), "anipose", _projected(wide, fisheye=True), px=1e-4)
    text = files.toml(distortions=wide)
    _assert_same(import_calibration(_write(tmp_path, "a", text), length_unit="m"), "anipose", _projected(wide))
    for change, words in (
        (("fisheye = true", 'fisheye = "yes"'), "cam_0.fisheye: "),
        (("rotation = [", "rotation = [0.0, "), "cam_0.rotation: "),
        (("size = [ 1280,", "size = [ "), "cam_0.size: "),
        (("translation = ", "shift = "), "rotation and translation"),
        (("[cam_0]", "[cam_0"), "TOML"),
    ):
        _write(tmp_path, "a", files.toml(distortions=wide, extra="fisheye = true").replace(*change))
        refused(words, import_calibration, path, length_unit="m")


# Metashape.


def _metashape_pixels(points, matrix, size, terms, fisheye=False):
    """The formulas of the user manual's appendix, for points in the camera's frame."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if fisheye:
        r0 = np.hypot(x, y)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.hypot(x, y)
    factor = 1 + terms["k1"] * r**2 + terms["k2"] * r**4 + terms["k3"] * r**6 + terms["k4"] * r**8
    xd = x * factor + (terms["p1"] * (r**2 + 2 * x**2) + 2 * terms["p2"] * x * y)
    yd = y * factor + (terms["p2"] * (r**2 + 2 * y**2) + 2 * terms["p1"] * x * y)
    u = size[0] * 0.5 + terms["cx"] + xd * terms["f"] + xd * terms["b1"] + yd * terms["b2"]
    v = size[1] * 0.5 + terms["cy"] + yd * terms["f"]
    return np.column_stack([u, v]) - 0.5  # the manual's pixels begin at the image's corner


def test_metashape(tmp_path):
    path = _write(tmp_path, "a", files.metashape())
    imported = import_calibration(path)
    _assert_same(imported, "Metashape")
    assert notices.ARBITRARY_SCALE.code not in {notice.code for notice in imported.notices}
    unscaled = _write(tmp_path, "b", files.metashape(scale=None))
    refused("b: length_unit: ", import_calibration, unscaled)
    again = import_calibration(unscaled, length_unit="m", cameras=("DSC_0", "DSC_1"))
    _assert_same(again, "Metashape")
    assert notices.ARBITRARY_SCALE.code in {notice.code for notice in again.notices}
    refused("cameras: .*'DSC_2' once among DSC_0, DSC_1", import_calibration, path, cameras=("DSC_0", "DSC_2"))


@pytest.mark.parametrize(
    ("kind", "changes", "px"),
    [
        ("frame", {"b2": 1.5, "k4": 0.0}, 1e-6),
        ("frame", {"b2": -0.7, "k4": 0.6}, 1e-3),
        ("fisheye", {"f": 900.0, "b1": 0.0, "k4": 0.002, "p1": 0.0, "p2": 0.0}, 2e-3),
        ("fisheye", {"f": 900.0, "b1": 0.7, "b2": 0.5, "k4": 0.002, "p1": 5e-5, "p2": -1e-4}, None),
    ],
)
def test_the_lens_of_metashape_is_that_of_its_manual(tmp_path, kind, changes, px):
    terms = {"f": 3100.0, "cx": 12.25, "cy": -8.5, "b1": 3.25, "b2": 0.0}
    terms |= {"k1": -0.05, "k2": 0.02, "k3": -0.01, "k4": 0.0, "p1": 4e-4, "p2": -6e-4, **changes}
    imported = import_calibration(_write(tmp_path, "a", files.metashape(kind, (terms, terms))))
    wide = kind == "fisheye"
    points = np.random.default_rng(6).uniform([-0.6, -0.5, 0.8], [0.6, 0.5, 1.0], (300, 3)) if wide else POINTS_M
    right = points @ ROTATION.T + 1e-3 * T_MM
    expected = [_metashape_pixels(each, None, SIZE, terms, wide) for each in (points, right)]
    if px is None:  # as far as the import says
        px = max(notice.values["largest_px"] for notice in imported.notices if "largest_px" in notice.values)
        assert 1e-3 < px < 0.2
    _assert_same(imported, "Metashape", expected, points, 1.2 * px)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('class="adjusted"', 'class="adjusted" x="'), "XML"),
        (('type="frame"', 'type="spherical"'), "DSC_0: .*spherical"),
        (("<f>", "<g>"), "XML"),
        (("<k1>", "<p3>0.1</p3><k1>"), "without p3"),
        (('sensor_id="0" label="DSC_0"', 'sensor_id="5" label="DSC_0"'), "DSC_0: .*found 5"),
        (("<scale>2.5", "<scale>-1"), "scale: "),
        (("<scale>2.5", "<scale>x"), "scale: "),
        (("<transform>", "<transform>1 "), "DSC_0: transform: "),
    ],
)
def test_what_is_wrong_in_metashapes_file_is_named(tmp_path, change, words):
    refused(words, import_calibration, _write(tmp_path, "a", files.metashape().replace(*change)))


def test_one_lens_of_metashape_is_no_pair(tmp_path):
    text = '<?xml version="1.0"?><calibration><projection>frame</projection><f>1000</f></calibration>'
    refused("one lens alone", import_calibration, _write(tmp_path, "a", text))


# Fisheye lenses up to a full field of view of 100 degrees: converted, and used.


def test_fisheye_lenses_up_to_100_degrees_are_used_as_opencv_uses_them(tmp_path):
    """Ten lenses: pixels within 0.002 px, points within 2 µm at 0.9 m, through the file of this program."""
    rng = np.random.default_rng(3)
    for trial in range(10):
        half, k = np.radians(50.0), rng.uniform(-1, 1, (2, 4)) * [0.05, 0.05, 0.02, 0.01]
        corner = half * (1 + k @ half ** np.array([2, 4, 6, 8]))
        focal = np.hypot(*SIZE) / 2 / corner
        matrices = [np.array([[f, 0, 640.0], [0, 1.001 * f, 510.0], [0, 0, 1]]) for f in focal]
        cameras = [
            (number, "OPENCV_FISHEYE", SIZE, [m[0, 0], m[1, 1], m[0, 2] + 0.5, m[1, 2] + 0.5, *bent])
            for (number, *_), m, bent in zip(files.CAMERAS, matrices, k, strict=True)
        ]
        first, second = files.colmap_binary(cameras=cameras)
        path, images = _write(tmp_path, "a", first), _write(tmp_path, "b", second)
        imported = import_calibration(path, length_unit="m", extrinsics=images)
        write_calibration(tmp_path / f"{trial}.json", imported.rig)
        rig = read_calibration(tmp_path / f"{trial}.json")
        points = rng.uniform([-0.7, -0.6, 0.8], [0.7, 0.6, 1.0], (300, 3))
        pixels = _projected(k, matrices, points, fisheye=True)
        inside = np.all([((p > 0) & (p < np.array(SIZE) - 1)).all(axis=1) for p in pixels], axis=0)
        assert inside.sum() > 60
        for seen, truth in zip(rig.project(points[inside]), (p[inside] for p in pixels), strict=True):
            assert np.abs(seen - truth).max() < 2e-3
        placed = triangulate(rig, pixels[0][inside][None], pixels[1][inside][None]).position_m[0]
        assert np.abs(placed - points[inside]).max() < 2e-5
