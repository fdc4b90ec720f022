"""Stereo images that pyvale carries, evaluated by pyvale and by our subsets at the same points.

- Plate: rendered with a known calibration and known rigid displacements, two cameras of 250 × 400 px.
- Challenge: the specimen of the Stereo-DIC Challenge 1.0 (Reu et al. 2024, Exp. Mech.) in its first state, with the
  calibration that pyvale's authors determined. Its displaced states and its true shape are not in the package.

Run by dic_challenge.py; with the interpreter that has pyvale `python dic_stereo.py PACKAGE NAME RESULT.npz`.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from photogram.camera import StereoRig

Array = NDArray[np.float64]
OUTLINE_PX = ((465, 187), (485, 1763), (2038, 1747), (1989, 206))  # of the specimen, pyvale's example
SEEDS_PX = (1554, 1204, 842, 1202, 770, 301, 1880, 551)  # of pyvale's example


@dataclass(frozen=True)
class Case:
    """Images of two cameras in states, and how they are evaluated."""

    calibration: str
    images: str
    states: tuple[str, ...]
    true_um: tuple[tuple[float, float, float], ...]
    radius: int
    step: int
    sign: float  # of the translation t in x_1 = R·x_0 + sign·t


def _along(steps_um: tuple[float, ...]) -> tuple[tuple[float, float, float], ...]:
    """Return displacements along x and against y."""
    return tuple((step, -step, 0.0) for step in steps_um)


CASES = {
    "plate": Case(
        "dic_ex08_stereo_calibration.txt",
        "dic/plate_rigid/rigid_cam{camera}_frame{state}.tiff",
        ("00", "04", "08", "10", "25", "50"),
        _along((0.0, 4.0, 8.0, 10.0, 250.0, 500.0)),
        15,
        10,
        -1.0,
    ),
    "challenge": Case(
        "dic_ex10_dic_chal_calibration.txt",
        "dic/stereo_challenge/Step01_00,00-sys1-0000_{camera}.tif",
        ("",),
        _along((0.0,)),
        13,
        27,
        1.0,
    ),
}


@dataclass(frozen=True)
class Surface:
    """Subsets at points (N,2) in px of the left camera's first image.

    Attributes
    ----------
    right_px : (N, 2) the same points in the right camera's first image, NaN where there is none.
    position_mm : (F, N, 3) in the left camera's axes.
    """

    points: Array
    right_px: Array
    position_mm: Array


def image_paths(package: Path, case: Case, camera: int) -> list[Path]:
    """Return the images of one camera."""
    return [package / "data" / case.images.format(camera=camera, state=state) for state in case.states]


def calibration_values(package: Path, case: Case) -> dict[str, float]:
    """Return the numbers of a calibration; principal points of cut images in their middle."""
    lines = (package / "data" / case.calibration).read_text(encoding="utf-8").split()
    values = {name: float(number) for name, number in (line.split(",")[:2] for line in lines)}
    if "plate_rigid" in case.images:
        height, width = read_image(image_paths(package, case, 0)[0]).shape
        for camera in ("cam0", "cam1"):
            values[f"{camera}_cx_px"], values[f"{camera}_cy_px"] = (width - 1) / 2.0, (height - 1) / 2.0
    return values


def read_image(path: Path) -> NDArray[Any]:
    """Return one image as it is stored."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path}: not a readable image")
    return image


def region(case: Case, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the pixels that subsets may cover."""
    import cv2

    mask = np.zeros(shape, np.uint8)
    if "plate_rigid" in case.images:
        mask[20:-20, 20:-20] = 1
    else:
        cv2.fillPoly(mask, [np.array(OUTLINE_PX, np.int32)], 1)
    return mask.astype(np.bool_)


def peer_surface(package: Path, case: Case) -> Surface:
    """Return the surface by pyvale, without its image filter; runs in the interpreter that has it."""
    from pyvale import calib, dic

    left, right = (image_paths(package, case, camera) for camera in (0, 1))
    shape = read_image(left[0]).shape
    seed = [shape[1] // 2, shape[0] // 2] if "plate_rigid" in case.images else list(SEEDS_PX)
    with tempfile.TemporaryDirectory() as folder:
        text = "".join(f"{name},{value!r}\n" for name, value in calibration_values(package, case).items())
        (Path(folder) / "calibration.txt").write_text(text, encoding="utf-8")
        dic.calculate_3d(
            reference=[left[0], right[0]],
            deformed=[left[1:] or left, right[1:] or right],
            calibration=calib.loadtxt(Path(folder) / "calibration.txt"),
            roi_mask=region(case, shape),
            seed=seed,
            subset_size=2 * case.radius + 1,
            subset_step=case.step,
            max_displacement=100,
            image_filter_kernel=1,
            num_threads=1,
            output_basepath=folder,
            print_level=0,
        )
        found = dic.import_3d(Path(folder) / "dic_results_*.csv", delimiter=",", layout="column", print_level=0)
    points, stereo = np.column_stack([found.ss_x, found.ss_y]).astype(np.float64), found.stereo
    disparity = np.stack([stereo.disparity_u_px[0], stereo.disparity_v_px[0]], axis=-1)
    position = case.sign * np.stack([stereo.x_mm, stereo.y_mm, stereo.z_mm], axis=-1)  # it has x_1 = R·x_0 + t
    states = [position[0], *position[-len(case.states) + 1 :]] if len(case.states) > 1 else [position[0]]
    return Surface(points, points + disparity, np.asarray(states, dtype=np.float64))


def our_surface(package: Path, case: Case, points: Array) -> Surface:
    """Return the surface by our subsets at points (N,2) of the left image."""
    from photogram.camera import triangulate
    from photogram.images.image_files import open_sequence
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.track import match_stereo, track_sequence

    left, right = (open_sequence(image_paths(package, case, camera)) for camera in (0, 1))
    settings = TrackSettings(radius_px=case.radius)
    right_px = match_stereo(left.read(0), right.read(0), points, settings).position_px[0]
    tracks = [points[None], right_px[None]]
    if len(case.states) > 1:
        tracks = [track_sequence(each, at, settings).position_px for each, at in ((left, points), (right, right_px))]
    rig = stereo_rig(package, case)
    return Surface(points, right_px, 1e3 * triangulate(rig, *tracks).position_m)


def stereo_rig(package: Path, case: Case) -> StereoRig:
    """Return the calibration, as a rig."""
    from photogram.calibration.exchange.lens import rotation_from_cardan
    from photogram.camera import Camera, StereoRig
    from photogram.geometry import RigidTransform

    value = calibration_values(package, case)
    size, cameras = np.array(read_image(image_paths(package, case, 0)[0]).shape[::-1]), []
    for name in ("cam0", "cam1"):
        fx, fy, skew, cx, cy = (value[f"{name}_{part}_px"] for part in ("fx", "fy", "fs", "cx", "cy"))
        bent = np.array([value[f"{name}_{part}"] for part in ("k1", "k2", "p1", "p2", "k3")])
        cameras.append(Camera(np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), bent, size))
    rotation = rotation_from_cardan(np.array([value[f"{name}_deg"] for name in ("theta", "phi", "psi")]))
    translation = case.sign * 1e-3 * np.array([value[f"t{axis}_mm"] for axis in "xyz"])
    return StereoRig(cameras[0], cameras[1], RigidTransform(rotation, translation))


def epipolar_px(package: Path, case: Case, surface: Surface) -> Array:
    """Return the signed distances (N,) in px of the right points from the epipolar lines of the left ones."""
    from photogram.camera import epipolar_residual

    return np.asarray(epipolar_residual(stereo_rig(package, case), surface.points, surface.right_px)[0])


if __name__ == "__main__":
    surface = peer_surface(Path(sys.argv[1]), CASES[sys.argv[2]])
    np.savez(sys.argv[3], points=surface.points, right_px=surface.right_px, position_mm=surface.position_mm)
