"""Calibration of random stereo pairs from rendered pictures of targets, against their truth; and the real dot grid.

Usage: python benchmarks/cameras.py [--target NAME] [--rigs 50] [--first 0] [--amount 0] [--write docs/cameras.md]

For every target, `--rigs` random stereo pairs (field of view 16 to 50 deg, axes at 10 to 35 deg, distortion) look at
12 random poses of it; the pictures, 640 x 512 px, 12 bit with shot and read noise, go through detection and bundle
adjustment as those of a user. Printed: the errors of the points found, and the errors of the 24 parameters over their
standard uncertainties. Some 20 s per pair on one core. `--target faults`: sessions of 15 and 8 views of a chessboard
10 x 7 as points, 0.03 px of noise, with what real sessions have and nobody states; two rows more have the corners of
rendered pictures, sharpened by a mask of amount 2: the errors over the uncertainties of the page, and over those of
the residuals alone. True is the pair as it was at a random one of its views. With `--write` into the table of a page;
some 60 s per pair. `--target held`: sessions with several images of each pose, which share an error; some 40 s per
pair. Then the 14 real pairs of a dot grid, where SHAKERCAL_DATA (by default `../shared/data` beside the
repository) has them, beside OpenCV's own calibration from the same points.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from marked import existing_file, short_table, write_marked
from numpy.typing import NDArray

from photogram.calibration.bundle import model_pixels
from photogram.calibration.calibration_result import Calibration
from photogram.calibration.initial_bundle import ViewPair
from photogram.calibration.session import calibrate_pair
from photogram.camera import LEFT, RIGHT, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.images.image_files import read_image
from photogram.images.sequence import GreyImage
from photogram.synthetic.board import SessionFaults, random_poses, random_rig, render_board, simulate_session
from photogram.synthetic.patterns import Board
from photogram.synthetic.scene import ImageSensor
from photogram.targets.find_target import find_target
from photogram.targets.target_view import Target, TargetNotFound, TargetView

FloatArray = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
SIZE_PX = np.array([640, 512])
VIEWS = 12
FIELD_M = 0.15
SHARPENED_GAIN = 0.65  # of the light, so that the overshoot of sharpened pictures stays below full scale
BOARDS = {
    "chessboard": Board(Target("chessboard", 9e-3, (9, 7))),
    "charuco": Board(Target("charuco", 9e-3, (11, 8), "DICT_4X4_100")),
    "aprilgrid": Board(Target("aprilgrid", 13e-3, (5, 4), tag_spacing=0.3)),
    "dots": Board(Target("dots", 8e-3, (11, 8))),
    "ring-dots": Board(Target("dots", 8e-3), rings=(5, 3)),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """One random pair: normalised errors of its parameters (24,), errors of all points (N, 2), failed pictures.

    `epipolar_px`: what the calibration does to the epipolar distance of points seen without error, rms.
    """

    normalised: FloatArray
    point_error_px: FloatArray
    failed: tuple[str, ...]
    calibration: Calibration
    epipolar_px: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--target", choices=(*BOARDS, "faults", "held", "real"), help="one of the targets (default: all)"
    )
    parser.add_argument("--write", type=existing_file, metavar="PAGE", help="replace the table of faults in a page")
    parser.add_argument("--amount", type=float, default=0.0, help="of an unsharp mask, σ = 1 px, on all pictures")
    parser.add_argument("--rigs", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first pair")
    options = parser.parse_args()
    for name in [options.target] if options.target else [*BOARDS, "faults", "held", "real"]:
        if name in ("faults", "held"):
            rows = faulty_rows if name == "faults" else held_rows
            lines = rows(range(options.first, options.first + options.rigs))
            if options.write is not None:
                columns, keep = PAGE_TABLES[name]
                write_marked(options.write, {name: short_table(lines[0], lines[2:], columns, keep)})
            continue
        if name == "real":
            real_dot_grid()
            continue
        outcomes = []
        for seed in range(options.first, options.first + options.rigs):
            outcomes.append(simulated(BOARDS[name], seed, options.amount))
            worst = np.abs(outcomes[-1].normalised).max()
            print(f"  {name} {seed}: largest {worst:.2f}, {len(outcomes[-1].failed)} failed", flush=True)
        report(name, outcomes)


def simulated(board: Board, seed: int, amount: float = 0.0) -> Outcome:
    """Render one session, its pictures sharpened by `amount`, calibrate from it, and compare with the truth."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE_PX, FIELD_M)
    poses = random_poses(rng, rig, board, VIEWS)
    pairs, errors, failed = [], [], []
    for number, pose in enumerate(poses):
        sides: list[TargetView | None] = []
        for side, (camera, relative) in enumerate(
            ((rig.left, RigidTransform.identity()), (rig.right, rig.right_from_left))
        ):
            blur = float(rng.uniform(0.6, 1.2))
            picture = photograph(render_board(camera, relative @ pose, board, blur, slant=0.2), rng, amount)
            try:
                view = find_target(picture, board.target, f"{'LR'[side]}{number}", ImageSensor().full_scale)
            except TargetNotFound as error:
                failed.append(str(error))
                sides.append(None)
                continue
            sides.append(view)
            errors.append(view.position_px - true_pixels(board, view, camera, relative, pose))
        pairs.append((sides[0], sides[1]))
    calibration = calibrate_pair(pairs, board.target)
    normalised, _ = normalised_errors(calibration, rig)
    seen = np.concatenate([pose.apply(board.points_m) for pose in poses])
    return Outcome(normalised, np.concatenate(errors), tuple(failed), calibration, epipolar_px(calibration, rig, seen))


def photograph(grey: FloatArray, rng: np.random.Generator, amount: float) -> NDArray[np.uint16]:
    """Return a picture of grey levels (H, W), sharpened after the noise by an unsharp mask of σ = 1 px."""
    sensor = ImageSensor()
    if amount == 0.0:
        return sensor.digitise(grey, rng)
    level = SHARPENED_GAIN * sensor.full_scale * grey
    noisy = level + rng.normal(size=grey.shape) * np.sqrt(sensor.variance(level))
    sharp = noisy + amount * (noisy - cv2.GaussianBlur(noisy, (0, 0), 1.0))
    return np.clip(np.rint(sharp), 0, sensor.full_scale).astype(np.uint16)


def epipolar_px(calibration: Calibration, rig: StereoRig, points_m: FloatArray) -> float:
    """Return the rms distance, in px, of points' true right images from the epipolar lines of their true left ones."""
    found = calibration.rig
    left, right = rig.project(points_m)
    one, two = (
        np.column_stack([camera.undistort(pixel), np.ones(len(pixel))])
        for camera, pixel in ((found.left, left), (found.right, right))
    )
    line = one @ found.essential.T
    distance = (two * line).sum(axis=1) / np.hypot(line[:, 0], line[:, 1]) * found.right.parameters[0]
    return float(np.sqrt((distance**2).mean()))


def normalised_errors(calibration: Calibration, rig: StereoRig, growth: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return the errors (24,) over the stated standard uncertainties, and over those that the residuals alone give.

    True are focal lengths larger by `growth`, relative, than those of `rig`.
    """
    found = calibration.rig
    error = found.values - rig.values
    focal = [*LEFT[:2], *RIGHT[:2]]
    error[focal] -= growth * rig.values[focal]
    error[18:21] = vector_from_rotation(found.right_from_left.rotation @ rig.right_from_left.rotation.T)
    assert found.covariance is not None
    assert calibration.cross_validation is not None
    return error[:24] / np.sqrt(np.diagonal(found.covariance))[:24], error[:24] / calibration.cross_validation.u_fit[
        :24
    ]


FAULTY_BOARD = Board(Target("chessboard", 9e-3, (10, 7)))
FAULTY_SIZE_PX = np.array([1280, 1024])
FAULTS = {
    "none": SessionFaults(),
    "board warped by 0.2 mm": SessionFaults(warp_m=2e-4),
    "focal lengths drift by 0.05 %": SessionFaults(focus=5e-4),
    "0.05 px shared by neighbours": SessionFaults(smooth_px=0.05),
    "0.03 px by place within the pixel": SessionFaults(locking_px=0.03),
    "all of these": SessionFaults(2e-4, 5e-4, 0.05, 0.03),
    "focal lengths warm up by 0.05 %": SessionFaults(focus=5e-4, focus_profile="warming"),
    "focal lengths jump by 0.05 %": SessionFaults(focus=5e-4, focus_profile="jump"),
}
SHARP_AMOUNT = 2.0
SHARP_FAULTS = SessionFaults(2e-4, 5e-4, 0.05)


def faulty_rows(seeds: range) -> list[str]:
    """Print and return the table of sessions with faults."""
    lines = [
        "| fault | views | sessions | freed | drift found | errors/u, rms | largest | beyond 2 u "
        "| residuals alone, rms | largest |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    pooled: list[FloatArray] = []
    sessions = [(name, views, faults, 0.0) for views in (15, 8) for name, faults in FAULTS.items()]
    sessions += [
        ("warped, drift, shared, in sharpened pictures", views, SHARP_FAULTS, SHARP_AMOUNT) for views in (12, 8)
    ]
    for name, views, faults, amount in sessions:
        stated, alone, freed, drifts = [], [], 0, 0
        for seed in seeds:
            calibration, ratios = faulty_session(seed, views, faults, amount)
            stated.append(ratios[0])
            alone.append(ratios[1])
            assert calibration.cross_validation is not None
            freed += calibration.cross_validation.shape == "free"
            drifts += calibration.cross_validation.drift is not None
        pooled += stated if faults != SessionFaults() else []
        lines.append(faulty_row(f"{name} | {views} | {len(seeds)} | {freed} | {drifts}", stated, alone))
        print(lines[-1], flush=True)
    lines.append(faulty_row("all with faults | | | |", pooled, None))
    print(lines[-1])
    return lines


def faulty_session(
    seed: int, views: int, faults: SessionFaults, amount: float
) -> tuple[Calibration, tuple[FloatArray, FloatArray]]:
    """Return the calibration from a session with faults, in pictures sharpened by `amount` if any; errors over u."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE_PX if amount else FAULTY_SIZE_PX, FIELD_M)
    poses = random_poses(rng, rig, FAULTY_BOARD, views)
    pairs: Sequence[ViewPair] = simulate_session(rng, rig, poses, FAULTY_BOARD, 0.0 if amount else 0.03, faults)
    if amount:
        ideal = simulate_session(rng, rig, poses, FAULTY_BOARD, 0.0)
        pairs = [sharpened(rng, rig, *each, amount) for each in zip(poses, pairs, ideal, strict=True)]
    calibration = calibrate_pair(pairs, FAULTY_BOARD.target)
    return calibration, normalised_errors(calibration, rig, float(rng.choice(faults.growth(views))))


FAULTS_SHOWN = ("none", "all of these", "focal lengths warm up by 0.05 %", "all with faults")
PAGE_TABLES: dict[str, tuple[tuple[int, ...], Callable[[list[str]], bool]]] = {
    "faults": ((0, 1, 5, 6, 7, 8), lambda cells: cells[0] in FAULTS_SHOWN),
    "held": ((0, 1, 4, 6, 7), lambda cells: cells[1] != "2" and "trembles" not in cells[0]),
}
"""Columns and rows of the tables that the page shows."""
HELD_POSES = 10
HELD = {  # images of each pose, error that they share, rad and tenths of m by which the target trembles
    "0.05 px shared": [(each, 0.05, 0.0) for each in (1, 2, 4, 8)],
    "0.05 px shared, the target trembles by 0.3°": [(4, 0.05, 0.005)],
    "nothing shared": [(4, 0.0, 0.0)],
}


def held_rows(seeds: range) -> list[str]:
    """Print and return the table of sessions with several images of each pose."""
    lines = [
        "| images of one pose | images of each | sessions | poses found | errors/u, rms | largest | beyond 2 u "
        "| residuals alone, rms | largest |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for name, each, shared_px, tremor in ((name, *case) for name, cases in HELD.items() for case in cases):
        found = [held_session(seed, each, shared_px, tremor) for seed in seeds]
        poses = np.mean([calibration.pose_count() for calibration, _ in found])
        stated, alone = ([ratios[number] for _, ratios in found] for number in (0, 1))
        lines.append(faulty_row(f"{name} | {each} | {len(seeds)} | {poses:.1f}", stated, alone))
        print(lines[-1], flush=True)
    return lines


def held_session(
    seed: int, each: int, shared_px: float, tremor: float
) -> tuple[Calibration, tuple[FloatArray, FloatArray]]:
    """Return the calibration from `each` images of ten poses, and the errors over u."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, FAULTY_SIZE_PX, FIELD_M)
    middle, poses = FAULTY_BOARD.points_m.mean(axis=0), []
    for pose in random_poses(rng, rig, FAULTY_BOARD, HELD_POSES):
        for _ in range(each):
            turn = rotation_from_vector(tremor * rng.normal(size=3)) @ pose.rotation
            place = pose.apply(middle) + 0.1 * tremor * rng.normal(size=3)
            poses.append(RigidTransform(turn, place - turn @ middle))
    pairs = simulate_session(rng, rig, poses, FAULTY_BOARD, 0.03, SessionFaults(smooth_px=shared_px, held=each))
    calibration = calibrate_pair(pairs, FAULTY_BOARD.target)
    return calibration, normalised_errors(calibration, rig)


def sharpened(
    rng: np.random.Generator, rig: StereoRig, pose: RigidTransform, faulty: ViewPair, ideal: ViewPair, amount: float
) -> ViewPair:
    """Return a view found in rendered, sharpened pictures, its points moved by what the faulty has on the ideal one."""
    views = []
    poses = (pose, rig.right_from_left @ pose)
    for camera, place, with_faults, without in zip((rig.left, rig.right), poses, faulty, ideal, strict=True):
        assert with_faults is not None
        assert without is not None
        board = render_board(camera, place, FAULTY_BOARD, float(rng.uniform(0.5, 1.0)), slant=0.2)
        name, target = with_faults.name, FAULTY_BOARD.target
        view = find_target(photograph(board, rng, amount), target, name, ImageSensor().full_scale)
        shifts = with_faults.position_px - without.position_px
        shift = dict(zip(map(tuple, without.index.tolist()), shifts, strict=True))
        moved = view.position_px + [shift[column, row] for column, row in view.index.tolist()]
        views.append(replace(view, position_px=moved))
    return views[0], views[1]


def faulty_row(named: str, stated: list[FloatArray], alone: list[FloatArray] | None) -> str:
    """Return one row of the table."""
    size, other = np.abs(stated), np.abs(alone) if alone is not None else None
    told = f"{np.sqrt((size**2).mean()):.2f} | {size.max():.1f} | {100 * (size > 2).mean():.1f} %"
    rest = "|" if other is None else f"{np.sqrt((other**2).mean()):.2f} | {other.max():.1f}"
    return f"| {named} | {told} | {rest} |"


def true_pixels(
    board: Board, view: TargetView, camera: Camera, relative: RigidTransform, pose: RigidTransform
) -> FloatArray:
    """Return where the points (N, 2) of a view truly are."""
    points = board.target.points_m(view.index)
    radius = board.radius * board.target.spacing_m if view.radius > 0 else 0.0
    return model_pixels(camera, relative, pose, points, radius).pixel


def report(name: str, outcomes: list[Outcome]) -> None:
    """Print one row of the table."""
    normalised = np.array([outcome.normalised for outcome in outcomes])
    errors = np.concatenate([outcome.point_error_px for outcome in outcomes])
    bias = np.abs([outcome.point_error_px.mean(axis=0) for outcome in outcomes]).max()
    within = np.abs(normalised)
    factor = np.array([outcome.calibration.sigma_factor for outcome in outcomes])
    scatter, mean = np.sqrt((errors**2).mean()), np.abs(errors.mean(axis=0)).max()
    print(
        f"| {name} | {len(outcomes)} | {len(errors)} | {scatter:.4f} | {mean:.4f} | {bias:.4f} "
        f" | {np.median(factor):.3f} | {np.sqrt((normalised**2).mean()):.3f} | {within.max():.2f} "
        f"| {100 * (within > 3).mean():.2f} % | {sum(len(outcome.failed) for outcome in outcomes)} "
        f"| {np.sqrt(np.mean([outcome.epipolar_px**2 for outcome in outcomes])):.4f} |",
        flush=True,
    )
    for outcome in outcomes:
        for text in outcome.failed:
            print(f"    failed: {text}")


def real_dot_grid() -> None:
    """Calibrate from the 14 real pairs, and by OpenCV from the same points."""
    folder = Path(os.environ.get("SHAKERCAL_DATA", ROOT.parent / "shared" / "data")) / "dotgrid_stereo"
    if not folder.is_dir():
        print(f"{folder}: not there, skipped")
        return
    started, busy = time.perf_counter(), time.process_time()
    target = Target("dots", 3.5e-3)
    paths = [sorted(folder.glob(f"*_{side}.jpeg")) for side in (0, 1)]
    with ThreadPoolExecutor(2) as workers:
        views = [list(workers.map(lambda path: find_target(*_picture(path, target)), side)) for side in paths]
    found = time.perf_counter() - started
    pairs = list(zip(*views, strict=True))
    common = common_points(pairs)
    calibrations = {
        "auto": calibrate_pair(pairs, target),
        "flat": calibrate_pair(pairs, target, "flat"),
        "flat, points of both images": calibrate_pair(common, target, "flat"),
    }
    for name, calibration in calibrations.items():
        rig, focal = calibration.rig, [*calibration.rig.left.parameters[:2], *calibration.rig.right.parameters[:2]]
        facts = f"{calibration.rms_px:.3f} | {_facts(rig.right_from_left, focal)}"
        print(f"| this program, {name} | {len(calibration.views)} | {facts} |")
    wall, cpu = time.perf_counter() - started, time.process_time() - busy
    print(f"points {found:.1f} s, all {wall:.1f} s wall, {cpu:.1f} s of CPU")
    opencv_rows(common, target, rig)


def _picture(path: Path, target: Target) -> tuple[GreyImage, Target, str, int]:
    image, full_scale = read_image(path)
    return image, target, path.name, full_scale


def _facts(base: RigidTransform, focal_px: Sequence[float]) -> str:
    angle, told = np.degrees(np.arccos(base.rotation[2, 2])), ", ".join(f"{value:.0f}" for value in focal_px)
    return f"{1e3 * np.linalg.norm(base.translation_m):.2f} | {angle:.2f} | {told}"


def common_points(pairs: Sequence[tuple[TargetView, TargetView]]) -> list[tuple[TargetView, TargetView]]:
    """Return the views with only the points that both images of a pair show, in one order."""
    found = []
    for left, right in pairs:
        order = sorted(
            {tuple(index) for index in left.index.tolist()} & {tuple(index) for index in right.index.tolist()}
        )
        sides = []
        for view in (left, right):
            row = {tuple(index): number for number, index in enumerate(view.index.tolist())}
            rows = [row[index] for index in order]
            covariance, position = view.covariance_px2[rows], view.position_px[rows]
            sides.append(replace(view, index=view.index[rows], position_px=position, covariance_px2=covariance))
        found.append((sides[0], sides[1]))
    return found


def opencv_rows(pairs: Sequence[tuple[TargetView, TargetView]], target: Target, start: StereoRig) -> None:
    """Print what cv2.stereoCalibrate makes of the same points: from its own start, and from `start`.

    In OpenCV 5.0 CALIB_DISABLE_SCHUR_COMPLEMENT has the bit of CALIB_TILTED_MODEL: it adds two angles of the sensor.
    """
    objects = [
        np.column_stack([view.index * target.spacing_m, np.zeros(len(view.index))]).astype(np.float32)
        for view, _ in pairs
    ]
    left, right = ([pair[side].position_px.astype(np.float32) for pair in pairs] for side in (0, 1))
    size = tuple(int(n) for n in pairs[0][0].size_px)
    own = [array for side in (left, right) for array in cv2.calibrateCamera(objects, side, size, None, None)[1:3]]
    ours = [array.copy() for camera in (start.left, start.right) for array in (camera.matrix, camera.distortion[:5])]
    other = getattr(cv2, "CALIB_DISABLE_SCHUR_COMPLEMENT", 0)
    for name, cameras, flags in (
        ("", own, 0),
        (", other solver, which also tilts the sensors", own, other),
        (" from this program's result", ours, 0),
        (" from this program's result, sensors tilted", ours, cv2.CALIB_TILTED_MODEL),
    ):
        first, lens, second, other_lens = cameras
        found = cv2.stereoCalibrate(
            objects, left, right, first, lens, second, other_lens, size, flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS
        )
        rms, k1, _, k2, _, rotation, translation = found[:7]
        focal = [k1[0, 0], k1[1, 1], k2[0, 0], k2[1, 1]]
        base = RigidTransform(np.array(rotation, float), np.array(translation, float).ravel())
        print(f"| OpenCV{name}, points of both images | {len(pairs)} | {rms:.3f} | {_facts(base, focal)} |")


if __name__ == "__main__":
    main()
