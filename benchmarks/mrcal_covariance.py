"""The covariance of a calibration compared with mrcal's, from the same points.

Usage: python benchmarks/mrcal_covariance.py [--sessions 8] [--write docs/performance.md]

mrcal (Debian packages mrcal and python3-mrcal, https://mrcal.secretsauce.net) runs in the interpreter that the variable
MRCAL_PYTHON names, by default /usr/bin/python3, with its regularisation and its rejection of outliers switched off.
Where that interpreter has no mrcal, this is printed and nothing is compared.

Its assumptions: a flat board, one white noise of all points, no knowledge of lenses. *Equal* are results of this
program under these assumptions: values in standard uncertainties, and ratios of u. *Stated* are the u of
`calibrate_pair`, which uses the points' covariances, knows what an ordinary lens is like, and includes the scatter of
the views. The uncertainty of projection is that of a point in front of the left camera at the boards' distance, on a
grid over the image, with the boards' poses as its reference.

Simulated: pairs of a chessboard of 10 x 7 corners, 12 views, 0.03 px of noise; and the left camera alone. Real: 15
images of a chessboard, where SHAKERCAL_DATA has `chessboard_mono`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from marked import existing_file, write_marked
from numpy.typing import NDArray

from photogram.calibration.adjust import AdjustedBundle, RigPrior, adjust, residuals
from photogram.calibration.bundle import Bundle, ImageObservations, distort_points
from photogram.calibration.initial_bundle import ViewPair, image_observations, start_bundle
from photogram.calibration.session import calibrate_pair
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector, skew, vector_from_rotation
from photogram.images.image_files import read_image
from photogram.synthetic.board import SessionFaults, random_poses, random_rig, simulate_session
from photogram.synthetic.patterns import Board
from photogram.targets.find_target import find_target
from photogram.targets.target_view import Target

FloatArray = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
INTERPRETER = os.environ.get("MRCAL_PYTHON", "/usr/bin/python3")
BOARD = Board(Target("chessboard", 9e-3, (10, 7)))
SIZE_PX = np.array([1280, 1024])
NOISE_PX = 0.03
GRID = (7, 5)  # points of the image at which the uncertainty of projection is compared
HEAD = (
    "| session | equal assumptions: difference of values / u | ratio of u | stated u of fx over mrcal's "
    "| rms of errors over mrcal's u | over the stated u |\n|---|---|---|---|---|---|"
)

MRCAL = """
import sys
import mrcal
import numpy as np

given = dict(np.load(sys.argv[1]))
inputs = dict(
    intrinsics=given["intrinsics"], extrinsics_rt_fromref=given["extrinsics"], frames_rt_toref=given["frames"],
    points=None, observations_board=given["observations"],
    indices_frame_camintrinsics_camextrinsics=given["indices"].astype(np.int32), observations_point=None,
    indices_point_camintrinsics_camextrinsics=None, lensmodel="LENSMODEL_OPENCV5",
    imagersizes=given["sizes"].astype(np.int32), calibration_object_spacing=float(given["spacing"]),
    do_optimize_intrinsics_core=True, do_optimize_intrinsics_distortions=True, do_optimize_extrinsics=True,
    do_optimize_frames=True, do_optimize_calobject_warp=False, do_apply_outlier_rejection=False,
    do_apply_regularization=False, verbose=False,
)
mrcal.optimize(**inputs)
state, misfit, _, factorization = mrcal.optimizer_callback(**inputs)
unit = np.eye(len(state))
inverse = factorization.solve_xt_JtJ_bt(unit)
mrcal.unpack_state(inverse, **inputs)
inverse = np.ascontiguousarray(inverse.T)
mrcal.unpack_state(inverse, **inputs)
model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
projected = mrcal.projection_uncertainty(
    given["points"], model=model, what="covariance", observed_pixel_uncertainty=1.0
)
np.savez(
    sys.argv[2], intrinsics=inputs["intrinsics"], extrinsics=inputs["extrinsics_rt_fromref"], inverse=inverse,
    squares=float(misfit @ misfit), measurements=len(misfit), projected=projected,
)
"""


@dataclass(frozen=True, eq=False)
class Compared:
    """Values (P,), u (P,) and covariance of projection (G, 2, 2) of both programs under equal assumptions.

    `stated_u` (P,): as `calibrate_pair` states them, `errors` (2, P): of mrcal's and of its values, where the truth is
    known.
    """

    names: tuple[str, ...]
    values: tuple[FloatArray, FloatArray]
    u: tuple[FloatArray, FloatArray]
    projected: tuple[FloatArray, FloatArray]
    stated_u: FloatArray
    errors: FloatArray | None = None

    def row(self, name: str, first: Sequence[Compared] = ()) -> str:
        """Return the row of a table, of all sessions `first` and this one."""
        every = [*first, self]
        off = max(float(np.abs((each.values[0] - each.values[1]) / each.u[1]).max()) for each in every)
        ratios = [(each.u[0] / each.u[1]).ravel() for each in every]
        for each in every:
            own, theirs = (np.trace(part, axis1=1, axis2=2) for part in each.projected)
            ratios.append(np.sqrt(own / theirs).ravel())
        focal = np.array([one.endswith(("fx", "fy")) for one in self.names])
        cells = [_median(np.array([each.stated_u / each.u[1] for each in every])[:, focal])]
        for number in (0, 1):
            over = [
                each.errors[number] / (each.u[1], each.stated_u)[number] for each in every if each.errors is not None
            ]
            cells.append(f"{np.sqrt(np.mean(np.square(over))):.2f}" if over else "")
        return f"| {name} | {off:.3f} | {_range(np.concatenate(ratios))} | {' | '.join(cells)} |"


def _range(ratio: FloatArray) -> str:
    return f"{ratio.min():.4f} to {ratio.max():.4f}"


def _median(ratio: FloatArray) -> str:
    return f"{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})"


def has_mrcal() -> bool:
    """Return whether the interpreter has mrcal."""
    try:
        done = subprocess.run([INTERPRETER, "-c", "import mrcal"], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def compare(pairs: Sequence[ViewPair], target: Target, true: StereoRig | None = None) -> Compared:
    """Return the results of both programs from the same points."""
    single = all(right is None for _, right in pairs)
    bundle, used, _ = start_bundle(pairs, target, "flat")
    index = bundle.shape.index
    images = [
        replace(
            image_observations(view, number, side, index, target.spacing_m),
            precision=np.tile(np.eye(2) / NOISE_PX**2, (len(view.index), 1, 1)),
        )
        for number, pair in enumerate(used)
        for side, view in enumerate(pair)
        if view is not None
    ]
    adjusted = adjust(bundle, images, _no_prior(single))
    free = adjusted.normal.parameter_index
    coordinates = 2 * sum(len(image.point) for image in images)
    squares = sum(float((off**2).sum()) / NOISE_PX**2 for off in residuals(adjusted.bundle, images))
    factor = squares / (coordinates - len(free) - 6 * len(bundle.poses))
    points = _grid_points(adjusted.bundle)
    theirs = _mrcal(adjusted.bundle, images, target, points, single)
    stated = calibrate_pair(pairs, target, "flat", lens="polynomial").rig
    assert stated.covariance is not None
    own = adjusted.covariance[np.ix_(free, free)] * factor
    return Compared(
        tuple(RIG_PARAMETERS[number] for number in free),
        (adjusted.bundle.rig.values[free], theirs[0]),
        (np.sqrt(np.diagonal(own)), np.sqrt(np.diagonal(theirs[1]))),
        (_projection_covariance(adjusted, points) * factor, theirs[2]),
        np.sqrt(np.diagonal(stated.covariance))[free],
        None if true is None else np.stack([_errors(adjusted.bundle.rig, true), _errors(stated, true)])[:, free],
    )


def _errors(found: StereoRig, true: StereoRig) -> FloatArray:
    """Return the errors (32,) of a pair's parameters."""
    error = found.values - true.values
    error[ROTATION] = vector_from_rotation(found.right_from_left.rotation @ true.right_from_left.rotation.T)
    return np.asarray(error)


def _no_prior(single: bool) -> RigPrior:
    """Return a prior that knows nothing, of five coefficients of distortion."""
    sigma = np.zeros(len(RIG_PARAMETERS))
    for free in (LEFT[:9],) if single else (LEFT[:9], RIGHT[:9], ROTATION, TRANSLATION):
        sigma[free] = np.inf
    return RigPrior(np.zeros(len(sigma)), sigma, (np.inf, np.inf))


def _grid_points(bundle: Bundle) -> FloatArray:
    """Return points (G, 3) in front of the left camera, at the boards' distance."""
    camera, middle = bundle.rig.left, bundle.shape.flat_m.mean(axis=0)
    depth = float(np.median([pose.apply(middle)[2] for pose in bundle.poses]))
    steps = [np.linspace(0.1, 0.9, count) * length for count, length in zip(GRID, camera.size_px, strict=True)]
    pixel = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    return depth * np.column_stack([camera.undistort(pixel), np.ones(len(pixel))])


def _projection_covariance(adjusted: AdjustedBundle, points_m: FloatArray) -> FloatArray:
    """Return the covariance (G, 2, 2) of the pixels of points (G, 3) that are at rest relative to all boards.

    A point p moves with the boards by the mean over their poses of δt + δω × (p − t), and its pixel in addition with
    the camera's parameters.
    """
    normal, bundle = adjusted.normal, adjusted.bundle
    covariance, camera = normal.reduced().covariance(), bundle.rig.left
    free, common = len(normal.parameter_index), len(normal.prior)
    slope = np.zeros((len(points_m), 2, len(covariance)))
    for number, point in enumerate(points_m):
        flat = point[None, :2] / point[2]
        _, by_flat = distort_points(camera, flat)
        by_point = camera.matrix[:2, :2] @ by_flat[0] @ np.array([[1, 0, -flat[0, 0]], [0, 1, -flat[0, 1]]]) / point[2]
        slope[number, :, : min(free, 9)] = _by_camera(camera.parameters[:9], camera.size_px, point)
        for view, pose in enumerate(bundle.poses):
            moved = np.column_stack([np.eye(3), -skew(point - pose.translation_m)]) / len(bundle.poses)
            slope[number, :, common + 6 * view : common + 6 * view + 6] = by_point @ moved
    return np.asarray(slope @ covariance @ slope.transpose(0, 2, 1))


def _by_camera(parameters: FloatArray, size_px: NDArray[np.int64], point: FloatArray) -> FloatArray:
    """Return the derivative (2, 9) of a point's pixel by the parameters of a camera, by differences."""
    step = np.maximum(np.abs(parameters), 1.0) * 1e-6
    columns = []
    for number in range(9):
        change = np.zeros(9)
        change[number] = step[number]
        ends = [Camera.from_parameters(parameters + sign * change, size_px).project(point[None])[0] for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step[number]))
    return np.column_stack(columns)


def _mrcal(
    bundle: Bundle, images: Sequence[ImageObservations], target: Target, points_m: FloatArray, single: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mrcal's values (P,), their covariance (P, P), and that of projection (G, 2, 2), in this order."""
    assert target.size is not None
    columns, rows = target.size
    rig, sides = bundle.rig, 1 if single else 2
    observations = np.zeros((len(images), rows, columns, 3))
    observations[..., 2] = -1.0
    for number, image in enumerate(images):
        column, row = (bundle.shape.index[image.point]).T
        observations[number, row, column, :2], observations[number, row, column, 2] = image.position_px, 1.0
    indices = np.array([(image.view, image.side, image.side - 1) for image in images])
    order = np.lexsort((indices[:, 1], indices[:, 0]))
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/{name}.npz" for name in ("given", "found")]
        np.savez(
            files[0],
            intrinsics=np.stack([rig.left.parameters[:9], rig.right.parameters[:9]][:sides]),
            extrinsics=np.array([_rt(rig.right_from_left)] if not single else np.zeros((0, 6))),
            frames=np.array([_rt(pose) for pose in bundle.poses]),
            observations=observations[order],
            indices=indices[order],
            sizes=np.stack([rig.left.size_px, rig.right.size_px][:sides]),
            spacing=target.spacing_m,
            points=points_m,
        )
        subprocess.run([INTERPRETER, "-c", MRCAL, *files], check=True)
        found = dict(np.load(files[1]))
    states = 9 * sides + 6 * (sides - 1)
    outliers = 2 * int((observations[..., 2] < 0).sum())
    variance = float(found["squares"]) / (int(found["measurements"]) - outliers - states - 6 * len(bundle.poses))
    values, slope = found["intrinsics"].ravel(), np.eye(states)
    if not single:
        vector = found["extrinsics"][0, :3]
        turned = [[rotation_from_vector(vector + sign * step) for sign in (1, -1)] for step in 1e-6 * np.eye(3)]
        by_vector = [vector_from_rotation(after @ before.T) / 2e-6 for after, before in turned]
        slope[18:21, 18:21] = np.array(by_vector).T
        shift = vector_from_rotation(rotation_from_vector(vector) @ rig.right_from_left.rotation.T)
        values = np.concatenate([values, rig.values[ROTATION] + shift, found["extrinsics"][0, 3:]])
    covariance = slope @ found["inverse"][:states, :states] @ slope.T * variance
    return values, covariance, found["projected"] * variance


def _rt(pose: RigidTransform) -> FloatArray:
    """Return a pose as mrcal has it: rotation vector, translation."""
    return np.concatenate([vector_from_rotation(pose.rotation), pose.translation_m])


def simulated(seed: int, single: bool, faults: SessionFaults) -> Compared:
    """Return the comparison of a simulated session."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE_PX, 0.15)
    pairs: Sequence[ViewPair] = simulate_session(rng, rig, random_poses(rng, rig, BOARD, 12), BOARD, NOISE_PX, faults)
    return compare([(left, None) for left, _ in pairs] if single else pairs, BOARD.target, rig)


def real_views() -> tuple[list[ViewPair], Target] | None:
    """Return the views of the real chessboard, if they are there."""
    folder = Path(os.environ.get("SHAKERCAL_DATA", ROOT.parent / "shared" / "data")) / "chessboard_mono"
    if not folder.is_dir():
        print(f"{folder}: not there, skipped")
        return None
    target = Target("chessboard", 0.02, (6, 4))
    views = []
    for path in sorted(folder.glob("*.jpg")):
        image, full_scale = read_image(path)
        views.append((find_target(image, target, path.name, full_scale), None))
    return list(views), target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--write", type=existing_file, metavar="PAGE", help="replace the table in a page")
    options = parser.parse_args()
    if not has_mrcal():
        print(f"{INTERPRETER} has no mrcal (packages mrcal, python3-mrcal; MRCAL_PYTHON): nothing compared")
        return
    lines = [HEAD]
    print(HEAD)
    for name, single, faults in (
        ("one camera", True, SessionFaults()),
        ("pair", False, SessionFaults()),
        ("pair, 0.05 px shared by neighbours", False, SessionFaults(smooth_px=0.05)),
    ):
        *first, last = [simulated(seed, single, faults) for seed in range(options.sessions)]
        lines.append(last.row(f"{name}, {options.sessions} simulated", first))
        print(lines[-1], flush=True)
    real = real_views()
    if real is not None:
        lines.append(compare(*real).row(f"one camera, {len(real[0])} real images"))
        print(lines[-1])
    if options.write is not None:
        write_marked(options.write, {"mrcal": "\n".join(lines)})


if __name__ == "__main__":
    main()
