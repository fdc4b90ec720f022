"""Check of a stereo pair's calibration: epipolar residuals of the points, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.frame_statistics import RunningMean
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.measure.epipolar_notices import CAMERA_DRIFTS, CAMERA_MOVED, CAMERA_ROTATED, PAIR_CHANGED
from shakercal._common.arrays import Arrays, BoolArray, FloatArray
from shakercal._common.notices import Notice, Value
from shakercal._common.propagation import derivatives

if TYPE_CHECKING:
    from photogram.subsets.track import StereoTracks

FEWEST_POINTS = 8  # for three coefficients with a scatter
FEWEST_FRAMES = 4  # two on either side of a step
UNCALIBRATED_PX = 0.1  # residual that is accepted where the calibration states no uncertainty
REMARKABLE_PX = 0.02  # smallest reported residual, even if the calibration is more precise
MOVED_PX = 0.005  # smallest reported change within a recording
UNUSABLE = 10.0  # standard uncertainties of the pattern beyond which no error of the calibration explains it
UNUSABLE_PX = 1.0  # smallest residual, rms over the points, of a pair that is rejected
RARE = 1e-4  # probability of a false warning, for either test
CLEAR = 3.0  # smallest reported change within a recording over the scatter of the frames
OUTLIER = 5.0  # robust standard deviations beyond which a point is ignored
COVERAGE = 2.0  # k of expanded uncertainties
_STEP = 1e-3  # of a standard uncertainty, for derivatives by the parameters
_TURN_RAD = 1e-5  # step of the derivatives by a turn
_TURN_EXPLAINS = 0.3  # share of the residuals that remains after a turn that is their cause
_WHERE = "epipolar residual"


@dataclass(frozen=True, eq=False, repr=False)
class EpipolarCheck(
    Arrays, shapes="residual_trend_px F 3; u_residual_trend_px F 3; pattern_px 3; position_px N 2; residual_px N"
):
    """Epipolar residuals of N points in F frames, in px.

    A residual is the distance of the right point from the left one's epipolar line.

    Attributes
    ----------
    residual_trend_px : (F, 3) mean of the residual and its change across the image along x and y, the latter two as
        rms over the points; NaN where too few points are seen.
    u_residual_trend_px : (F, 3) standard uncertainties from the image noise.
    pattern_px : (3,) the same of the residual's mean over the frames.
    pattern_covariance : (3, 3) due to the calibration and the matching of the first images; None without a
        calibration's covariance.
    position_px : (N, 2) mean left positions.
    residual_px : (N,) mean residuals of the points, NaN for outliers.
    notices : of cameras that do not agree with their calibration.
    """

    residual_trend_px: FloatArray = field(metadata={"dataset": "course_px"})
    u_residual_trend_px: FloatArray = field(metadata={"dataset": "u_course_px"})
    pattern_px: FloatArray
    pattern_covariance: FloatArray | None
    position_px: FloatArray
    residual_px: FloatArray
    notices: tuple[Notice, ...]

    @property
    def mean_px(self) -> FloatArray:
        """Mean residual of every frame (F,)."""
        return self.residual_trend_px[:, 0]

    @property
    def rejection_reason(self) -> str:
        """Reason why the pair does not belong to its calibration, empty if it may.

        Two limits must be exceeded. A residual of more than ten times the effect of calibration and matching is no
        error of the calibration but another arrangement: cameras moved, exchanged or given another file. Against a
        calibration that states far too small uncertainties, the residual must also exceed 1 px. That is ten times the
        value for calibrations without uncertainties: real pairs with published calibrations of other programs have 0.08
        to 0.13 px. Below 1 px a triangulation, which depends on the residual in first order, is wrong by at most 1/f of
        its distance, which the other instruments can judge.
        """
        size = float(np.linalg.norm(self.pattern_px))
        if not size > UNUSABLE_PX:
            return ""
        if self.pattern_covariance is None:
            return f"its epipolar residual is {size:.2g} px and its calibration states no uncertainty"
        inverse = np.linalg.pinv(self.pattern_covariance, hermitian=True)
        times = float(np.sqrt(self.pattern_px @ inverse @ self.pattern_px))
        text = f"its epipolar residual is {size:.2g} px, {times:.2g} times what calibration and matching explain"
        return text if times > UNUSABLE else ""


def check_epipolar(
    tracks: StereoTracks | Iterable[StereoTracks], rig: StereoRig, subset_frames: BoolArray | None = None
) -> EpipolarCheck:
    """Return the epipolar residuals of a recording, with notices of disagreement.

    Parameters
    ----------
    tracks
        Of all frames, or blocks of frames in turn, which are iterated twice.
    rig
        The calibrated pair.
    subset_frames
        (F,) which frames of the recording they are; None (default) for all.

    Returns
    -------
    EpipolarCheck
        Residuals with uncertainties, and a warning where the cameras disagree with their calibration.

    Notes
    -----
    Two tests, each with a probability of 10⁻⁴ for a false warning. The first compares the pattern (mean and slopes)
    over all frames with the covariance of calibration and matching, or with 0.1 px for a calibration without
    covariance. The second compares the largest step between all frames before and all frames after an instant with the
    image noise; it also finds a drift. Both allow for errors periodic in the pixel (`StereoTracks.bias_px`), the second
    one also for the residual that changes with the body's position. A turn of a camera about an axis across the plane
    of sight shifts points along the epipolar lines: neither test detects it.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> noise = gaussian_filter(np.random.default_rng(1).standard_normal((96, 96)), 2.0, mode="wrap")
    >>> image = np.rint(128 + 300 * noise).astype(np.uint8)
    >>> left = ImageSequence(("l0", "l1"), (96, 96), 255, lambda k: np.roll(image, k, axis=1))
    >>> right = ImageSequence(("r0", "r1"), (96, 96), 255, lambda k: np.roll(image, k - 5, axis=1))
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 48, 48, 0, 0, 0, 0, 0]), np.array([96, 96]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.005, 0.0, 0.0])))
    >>> check = check_epipolar(track_stereo(left, right, rig, TrackSettings(radius_px=7)), rig)
    >>> float(np.abs(check.mean_px).max()) < 0.01
    True
    """
    blocks: Iterable[StereoTracks] = tracks if isinstance(tracks, Iterable) else (tracks,)
    means, bias_px, frames = [RunningMean() for _ in range(3)], 0.0, 0
    for block in blocks:
        residual, *_ = epipolar_residual(rig, block.left.position_px, block.right.position_px)
        for running, values in zip(means, (residual, block.left.position_px, block.right.position_px), strict=True):
            running.add(values)
        bias_px, frames = float(np.sqrt(np.nansum(block.bias_px**2))), frames + len(residual)
    mean, position, other = (running.mean for running in means)
    subset_frames = np.ones(frames, dtype=np.bool_) if subset_frames is None else subset_frames
    good = _good(mean, position)
    if np.count_nonzero(good) < FEWEST_POINTS:
        missing = np.full((len(subset_frames), 3), np.nan)
        return EpipolarCheck(missing, missing, np.full(3, np.nan), None, position, np.full(len(mean), np.nan), ())
    basis = _basis(position[good])
    changes, u_changes, paths = zip(*_block_residuals(blocks, rig, good, mean, position), strict=True)
    path, (change, u_change) = np.concatenate(paths), np.full((2, len(subset_frames), 3), np.nan)
    change[subset_frames], u_change[subset_frames] = np.concatenate(changes), np.concatenate(u_changes)
    solver = np.linalg.pinv(basis)
    pattern = solver @ mean[good]
    matches = position[good], other[good]
    covariance = None
    if rig.covariance is not None:
        left_over = mean[good] - basis @ pattern
        matching = float(left_over @ left_over) / (len(basis) - 3) * (solver @ solver.T) + bias_px**2 * np.eye(3)
        step = _STEP * np.sqrt(np.diagonal(rig.covariance))
        derivative = solver @ derivatives(lambda delta: epipolar_residual(rig.perturbed(delta), *matches)[0], step)
        covariance = derivative @ rig.covariance @ derivative.T + matching
    excess = _unexplained_residual(pattern, covariance)
    # A residual that depends on the position in the image changes with the body's motion: by the ratio of its travel,
    # rms over the frames, to the extent of its points.
    extent = np.sqrt(np.mean(np.sum((position[good] - position[good].mean(axis=0)) ** 2, axis=-1)))
    travel = float(np.sqrt(np.nanmean(np.sum(path**2, axis=-1))) / extent)
    passing_px = travel * float(np.sqrt(np.mean(mean[good] ** 2)))
    notices = [
        None if excess is None else _pair_notice(rig, matches, excess),
        _change_notice(change, u_change, float(np.hypot(bias_px, passing_px))),
    ]
    return EpipolarCheck(
        change + pattern,
        u_change,
        pattern,
        covariance,
        position,
        np.where(good, mean, np.nan),
        tuple(notice for notice in notices if notice is not None),
    )


def _block_residuals(
    blocks: Iterable[StereoTracks], rig: StereoRig, good: BoolArray, mean: FloatArray, position: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Yield by block residual coefficients (F,3), u, and the body's path.

    `good` (N,): the points that count; mean (N,) residual; `position` (N, 2): mean in the left camera. The path is (F,
    2).
    """
    basis = _basis(position[good])
    for block in blocks:
        residual, by_left, by_right = epipolar_residual(rig, block.left.position_px, block.right.position_px)
        sides = (by_left, block.left), (by_right, block.right)
        variance = np.sum([np.einsum("fni,fnij,fnj->fn", by, side.covariance_px2, by) for by, side in sides], axis=0)
        path = RunningMean()
        path.add((block.left.position_px[:, good] - position[good]).swapaxes(0, 1))
        yield (*_coefficients(residual[:, good] - mean[good], variance[:, good], basis), path.mean)


def _good(mean: FloatArray, position: FloatArray) -> BoolArray:
    """Return points (N,) that are finite and no outliers among their neighbours."""
    finite = np.isfinite(mean) & np.isfinite(position).all(axis=1)
    if np.count_nonzero(finite) < FEWEST_POINTS:
        return finite
    basis = np.zeros((len(mean), 3))
    basis[finite] = _basis(position[finite])
    good = finite
    for _ in range(3):
        fit = basis @ (np.linalg.pinv(basis[good]) @ mean[good])
        distance = np.abs(mean - fit)
        good = finite & (distance <= OUTLIER * 1.4826 * np.median(distance[good]) + 1e-12)
    return good


def _basis(position: FloatArray) -> FloatArray:
    """Return constant, x and y (N, 3), uncorrelated, of rms 1 or without extent zero."""
    columns = np.column_stack([np.ones(len(position)), position])
    for column in (1, 2):
        before = columns[:, :column]
        columns[:, column] -= before @ (np.linalg.pinv(before) @ columns[:, column])
        rms = np.sqrt(np.mean(columns[:, column] ** 2))
        columns[:, column] = columns[:, column] / rms if rms > 1e-6 else 0.0
    return columns


def _coefficients(residual: FloatArray, variance: FloatArray, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (F, 3) of every frame's residuals and their standard uncertainties."""
    finite = np.isfinite(residual) & np.isfinite(variance)
    weight = finite.astype(np.float64)
    normal = np.einsum("fn,na,nb->fab", weight, basis, basis)
    solver = np.linalg.pinv(normal, hermitian=True) @ (weight[:, None, :] * basis.T)
    value = np.einsum("fan,fn->fa", solver, np.where(finite, residual, 0.0))
    u = np.sqrt(np.einsum("fan,fn->fa", solver**2, np.where(finite, variance, 0.0)))
    enough = (finite.sum(axis=1) >= FEWEST_POINTS)[:, None]
    return np.where(enough, value, np.nan), np.where(enough, u, np.nan)


def _pair_notice(rig: StereoRig, matches: tuple[FloatArray, FloatArray], values: dict[str, Value]) -> Notice:
    """Return the warning of an unexplained residual, with a rotation that explains it."""
    turn = _explaining_turn(rig, matches)
    if turn is None:
        return Notice(PAIR_CHANGED, _WHERE, **values)
    (about_x, about_z), displaced_m = turn
    angles = {"about_x_mrad": round(1e3 * about_x, 2) + 0.0, "about_z_mrad": round(1e3 * about_z, 2) + 0.0}
    return Notice(CAMERA_ROTATED, _WHERE, **values, **angles, displaced_mm=1e3 * displaced_m)


def _explaining_turn(rig: StereoRig, matches: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, float] | None:
    """Return the turn of the right camera that explains the residuals, if any.

    About its x and its optical axis in rad, with the displacement in m of the points. Of the turns that do, it is the
    one without a part across the plane of sight, which has no effect on residuals.
    """
    residual, *_ = epipolar_residual(rig, *matches)
    axes = np.eye(3)[:, [0, 2]]
    derivative = derivatives(
        lambda turn: epipolar_residual(_rotated_rig(rig, axes @ turn), *matches)[0], np.full(2, _TURN_RAD)
    )
    turn, *_ = np.linalg.lstsq(derivative, -residual, rcond=None)
    if np.linalg.norm(residual + derivative @ turn) > _TURN_EXPLAINS * np.linalg.norm(residual):
        return None
    rotated = _rotated_rig(rig, axes @ turn)
    pairs = matches[0][None], matches[1][None]
    moved = triangulate(rotated, *pairs).position_m - triangulate(rig, *pairs).position_m
    return np.asarray(turn), float(np.sqrt(np.nanmean(np.sum(moved**2, axis=-1))))


def _rotated_rig(rig: StereoRig, vector_rad: FloatArray) -> StereoRig:
    """Return the rig after a rotation (3,) of the right camera about its centre."""
    turn = RigidTransform(rotation_from_vector(vector_rad), np.zeros(3))
    return replace(rig, right_from_left=turn @ rig.right_from_left)


def _unexplained_residual(pattern: FloatArray, covariance: FloatArray | None) -> dict[str, Value] | None:
    """Return the residual of an unexplained pattern, and the limit."""
    from scipy.special import chdtri

    size = float(np.linalg.norm(pattern))
    if covariance is None:
        if size <= UNCALIBRATED_PX:
            return None
        source, explained_px = "a calibration without uncertainties", UNCALIBRATED_PX
    else:
        square = float(pattern @ np.linalg.pinv(covariance, hermitian=True) @ pattern)
        if size <= REMARKABLE_PX or square <= chdtri(3, RARE):
            return None
        source, explained_px = "the calibration (k = 2)", float(COVERAGE * np.sqrt(np.trace(covariance)))
    return {"residual_px": size, "source": source, "explained_px": explained_px}


def _change_notice(change: FloatArray, u_noise: FloatArray, bias_px: float) -> Notice | None:
    """Return a warning where the pattern changes within the recording significantly.

    Compared with noise, u, and other errors of a frame.
    """
    from scipy.special import chdtri

    frames = np.flatnonzero(np.isfinite(change).all(axis=1))
    if len(frames) < FEWEST_FRAMES:
        return None
    values, u = change[frames], np.hypot(u_noise[frames], bias_px)
    # Factor, at least 1, by which neighbouring frames differ more than expected from their noise
    difference = np.abs(np.diff(values, axis=0)) / np.sqrt(u[1:] ** 2 + u[:-1] ** 2)
    weight = 1.0 / (max(1.0, 1.4826 * float(np.median(difference))) * u) ** 2
    # The first frame after the most significant step, the step (3,), and its square in standard uncertainties. Both
    # sides have at least two frames
    sums, totals = np.cumsum(weight * values, axis=0), np.cumsum(weight, axis=0)
    before, after = totals[1:-2], totals[-1] - totals[1:-2]
    steps = (sums[-1] - sums[1:-2]) / after - sums[1:-2] / before
    squares = (steps**2 / (1.0 / before + 1.0 / after)).sum(axis=1)
    best = int(np.argmax(squares))
    split, step, square = best + 2, steps[best], float(squares[best])
    if square <= chdtri(3, RARE / len(frames)):
        return None
    parts = (slice(None, split), slice(split, None))
    time = np.broadcast_to(np.linspace(-0.5, 0.5, len(values))[:, None], values.shape)
    time = time - np.average(time, axis=0, weights=weight)
    slope = (weight * time * values).sum(axis=0) / (weight * time**2).sum(axis=0)
    about_line = values - np.average(values, axis=0, weights=weight) - slope * time
    about_step = np.concatenate([values[p] - np.average(values[p], axis=0, weights=weight[p]) for p in parts])
    drifts = float((weight * about_line**2).sum()) < float((weight * about_step**2).sum())
    change_px = float(np.linalg.norm(slope if drifts else step))
    scatter = float(np.sqrt(np.mean(np.sum((about_line if drifts else about_step) ** 2, axis=1))))
    if change_px <= max(MOVED_PX + COVERAGE * bias_px, CLEAR * scatter):
        return None
    if drifts:
        return Notice(CAMERA_DRIFTS, _WHERE, change_px=change_px)
    return Notice(CAMERA_MOVED, _WHERE, frame=int(frames[split]), change_px=change_px)
