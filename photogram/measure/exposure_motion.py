"""Frames re-evaluated with an estimated motion: rolling shutter and motion blur."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photogram.bspline import Spline, sample_line, spline_of_image
from photogram.direct.cells import prepare_cells
from photogram.direct.direct_fit import (
    BodyView,
    estimator_matrix,
    fit_direct,
    phase_rotated_pose,
    row_information,
    with_cells,
)
from photogram.direct.surface import motion_from_positions, project_body_points
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.images.sequence import GreyImage
from photogram.measure.follow import (
    UNIFORM,
    BodyScene,
    FollowedFrame,
    Registrations,
    body_views,
    cameras_about,
    locate_subsets,
    reweight_scene,
    subset_centres,
)
from photogram.subsets.find import identity_registration
from photogram.subsets.icgn import register
from photogram.subsets.reference import ReferenceSubsets, TrackStatus, prepare_reference
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.kernels import njit

MotionSeries = tuple[FloatArray, FloatArray]
"""Rotations (..., 3, 3) and shifts (..., 3)."""
ROUNDS = 2  # iterations of positions and the instants of their rows
PATH_TIMES = 16  # nodes of Gauss-Legendre quadrature over an exposure
BAND_PX = 24  # rows with the same blur in a rolling shutter
WIDEST_CELL = 1.0 / 3.0  # periods of a line in which the rows of one cell are exposed
MAX_POINTS = 200  # of a surface, for the change of the path across it


@dataclass(frozen=True, eq=False, repr=False)
class ExposureMotion(Arrays, shapes="frequency_hz K; phasors K 6; time_s F"):
    """Motion of a body about its mean pose while frames are exposed: Re Σ X·exp(jωt).

    Attributes
    ----------
    frequency_hz : (K,).
    phasors : (K, 6) X in m and rad.
    time_s : (F,) middles of the exposures of the rows that are read first.
    exposure_s : length of an exposure.
    row_s : of the left and the right camera, delay of each row after the one above it; negative where the last row is
        read first, 0 where all are exposed at once.
    motion_blur : whether the path of an exposure changes grey values significantly.
    """

    frequency_hz: FloatArray
    phasors: ComplexArray
    time_s: FloatArray
    exposure_s: float
    row_s: tuple[float, float]
    motion_blur: bool

    @property
    def rolling_shutter(self) -> bool:
        """Whether a camera exposes its rows one after the other."""
        return any(self.row_s)

    @property
    def per_row(self) -> float:
        """Periods of the fastest line from row to row."""
        return float(np.max(np.abs(self.row_s)) * self.frequency_hz.max())

    def pose(self, time_s: FloatArray, exposure_s: float) -> MotionSeries:
        """Return the body's mean poses over exposures about instants (...)."""
        omega = 2.0 * np.pi * self.frequency_hz
        seen = self.phasors * np.sinc(self.frequency_hz * exposure_s)[:, None]
        poses = np.asarray((np.exp(1j * np.multiply.outer(time_s, omega)) @ seen).real, np.float64)
        return rotation_from_vector(poses[..., 3:]), poses[..., :3]

    def relative_motion(
        self, start_s: FloatArray | float, end_s: FloatArray, exposure_s: float | None = None
    ) -> MotionSeries:
        """Return the motion from one instant to others, each as the mean over an exposure.

        `exposure_s`: of the others, by default that of the frames.
        """
        length = self.exposure_s if exposure_s is None else exposure_s
        first, last = self.pose(np.asarray(start_s), self.exposure_s), self.pose(end_s, length)
        rotation = last[0] @ np.swapaxes(first[0], -1, -2)
        return rotation, last[1] - np.einsum("...ij,...j->...i", rotation, first[1])


def row_delay_s(row_s: float, row_px: FloatArray, rows: int) -> FloatArray:
    """Return the delay of rows of an image after the row that is read first.

    `rows`: their number.
    """
    return np.asarray(row_s * (row_px if row_s >= 0.0 else row_px - (rows - 1)))


def apply_motion(carried: MotionSeries, points_m: FloatArray) -> FloatArray:
    """Return points (..., 3) after a motion."""
    return np.asarray(np.einsum("...ij,...j->...i", carried[0], points_m) + carried[1])


def undo_motion(carried: MotionSeries, points_m: FloatArray) -> FloatArray:
    """Return points (..., 3) before a motion."""
    return np.asarray(np.einsum("...ji,...j->...i", carried[0], points_m - carried[1]))


@dataclass(frozen=True, eq=False, repr=False)
class ExposureCorrection(Arrays):
    """A scene in which every frame shows its body at one instant.

    The instant is the middle of its first row's exposure. `uncorrected`: the one in which subsets have their positions
    in the images.
    """

    uncorrected: BodyScene
    scene: BodyScene
    swing: ExposureMotion

    def correct_frame(self, number: int, frame: FollowedFrame) -> tuple[FollowedFrame, ComplexArray | None]:
        """Return one frame as if exposed at one instant, and its phase-rotated pose (K, p).

        The latter with rolling shutters (`direct_fit.phase_rotated_pose`), else None, as without a direct fit.
        """
        (found, fit), start = frame, None
        if found is not None:
            start = motion_from_positions(self.scene.seen, _at_one_instant(self.uncorrected, self.swing, number, found))
        start = fit.moved if start is None and fit is not None else start
        if start is None:
            return (found, None), None
        views, targets, references = self._compared(number, start)
        if found is not None:
            if references:
                found = self._registered(found, references, targets)
            found = _at_positions(
                self.scene.references, found, _at_one_instant(self.uncorrected, self.swing, number, found)
            )
        fit = fit_direct(views, targets, start)
        if fit is not None and self.swing.motion_blur:  # the misfit grows with the blur, not with a fixed pattern alone
            fit = replace(fit, misfit=np.full_like(fit.misfit, np.nan))
        if fit is None or not self.swing.rolling_shutter:
            return (found, fit), None
        from_first = self.swing.relative_motion(self.swing.time_s[0], self.swing.time_s[number])
        turns = []
        for side, view in enumerate(views):
            delay = self._delay_s(side, view.cells.centre_px[:, 1])
            turns.append(np.exp(-2j * np.pi * np.multiply.outer(self.swing.frequency_hz, delay)))
        departure = fit.moved.pose - RigidTransform(*from_first).pose
        return (found, fit), phase_rotated_pose(views, targets, fit, turns, departure)

    def with_noise(self, number: int, frame: FollowedFrame) -> ExposureCorrection:
        """Return it with the noise of the images in a frame.

        Unchanged if that cannot be fitted.
        """
        (_, fit), _ = self.correct_frame(number, frame)
        if fit is None:
            return self
        views, targets, _ = self._compared(number, fit.moved)
        return replace(self, scene=reweight_scene(self.scene, views, targets, fit.moved))

    def _registered(
        self, found: Registrations, references: Sequence[Spline], targets: Sequence[Spline]
    ) -> Registrations:
        """Register subsets again, from their positions, in equally blurred images."""
        renewed, settings = [], self.scene.settings
        for one, subsets, reference, target in zip(
            found, self.uncorrected.references, references, targets, strict=True
        ):
            blurred = prepare_reference(reference, subsets.centre_px, settings.radius_px, settings.shape_order)
            good = one.status == TrackStatus.OK
            now = register(blurred, target, np.where(good[:, None], one.warp, np.nan), settings)
            renewed.append(replace(now, status=np.where(good, now.status, one.status)))
        return tuple(renewed)

    def _compared(self, number: int, moved: RigidTransform) -> tuple[list[BodyView], list[Spline], list[Spline]]:
        """Return the body at rest and one frame, prepared for comparison, and the blurred references.

        The body has moved by `moved`. Each image is blurred as the exposure of the other one has blurred that one.
        Points are moved to their positions when the rows that show them are exposed.
        """
        scene, swing, rest = self.scene, self.swing, RigidTransform.identity()
        views, targets, references = list[BodyView](), list[Spline](), list[Spline]()
        for side, sharp in enumerate(scene.views):
            view, image = sharp, scene.images[side].read(number)
            if not swing.motion_blur:
                targets.append(spline_of_image(image, scene.settings.degree))
            else:
                model, full = (UNIFORM if scene.noise is None else scene.noise[side]), scene.images[side].saturation
                reference = self._blurred(side, scene.first[side], rest, (number, moved))
                references.append(spline_of_image(reference, scene.settings.degree))
                targets.append(spline_of_image(self._blurred(side, image, moved, (0, rest)), scene.settings.degree))
                cells = prepare_cells(references[side], scene.grid.areas[side], view.cells.side_px, model, float(full))
                view = with_cells(view, cells)
            if swing.rolling_shutter:
                seen = points = moved.apply(view.patches.points_m)
                for _ in range(ROUNDS):
                    carried = _motion_since(scene, swing, number, side, view.camera.project(seen)[..., 1])
                    seen = apply_motion(carried, points)
                view = replace(view, added_motion=carried)
            views.append(view)
        return views, targets, references

    def _blurred(
        self, side: int, image: GreyImage, at: RigidTransform, by: tuple[int, RigidTransform]
    ) -> NDArray[np.float32]:
        """Return an image of the body, blurred by its path in an exposure.

        at: the pose; by: number and motion of the frame.
        """
        swing, (number, moved), camera = self.swing, by, self.scene.seen[side].camera
        nodes, share = np.polynomial.legendre.leggauss(PATH_TIMES)
        finite_m = self.scene.rest_m[np.isfinite(self.scene.rest_m).all(axis=1)]
        finite_m = finite_m[:: 1 + len(finite_m) // MAX_POINTS]
        design = np.column_stack([np.ones(len(finite_m)), camera.project(at.apply(finite_m))])
        bands = max(1, len(image) // BAND_PX) if swing.rolling_shutter else 1
        middle = swing.time_s[number] + self._delay_s(side, (np.arange(bands) + 0.5) * len(image) / bands - 0.5)
        path = np.empty((bands, PATH_TIMES, 2, 3))
        for band, start_s in enumerate(middle):
            carried = swing.relative_motion(start_s, start_s + nodes * swing.exposure_s / 2.0, 0.0)
            shown = camera.project(apply_motion((carried[0][:, None], carried[1][:, None]), moved.apply(finite_m)))
            shown -= np.einsum("e,end->nd", share / 2.0, shown)
            path[band] = np.einsum("an,end->eda", np.linalg.pinv(design), shown)
        return blur_along_path(image, path, share / 2.0)

    def _delay_s(self, side: int, row_px: FloatArray) -> FloatArray:
        """Return the delay of rows of a camera after the first one."""
        return row_delay_s(self.swing.row_s[side], row_px, int(self.scene.images[side].size_px[1]))

    @property
    def responses(self) -> tuple[ComplexArray, ComplexArray]:
        """Response of phase-rotated poses to a motion, and to the assumed motion: (K,p,p).

        The delay of each cell is compensated; within a cell rows still differ. The assumed motion acts through its
        affine warp: by the instants of its middle and of points above and below.
        """
        informed = [row_information(view) for view in self.scene.views]
        whole = np.sum([part.sum(axis=0) for part in informed], axis=0)
        sums = np.zeros((2, len(self.swing.frequency_hz), *whole.shape), np.complex128)
        for row_s, view, part in zip(self.swing.row_s, self.scene.views, informed, strict=False):
            arm, down = view.patches.arm_px, np.arange(len(part)) - (len(part) - 1) / 2
            angle = 2.0 * np.pi * self.swing.frequency_hz[:, None] * row_s
            for row, factor in enumerate((np.exp(1j * angle * down), 1.0 + 1j * np.sin(angle * arm) / arm * down)):
                sums[row] += np.einsum("kr,rij->kij", factor, part)
        estimate = estimator_matrix(whole)
        rotated, assumed = estimate @ sums @ np.linalg.inv(estimate @ whole)
        return rotated, assumed

    @property
    def row_lag(self) -> FloatArray:
        """Number of rows (6, 6) after the first one at which a motion is seen."""
        sums, whole = np.zeros((6, 6)), np.zeros((6, 6))
        for side, view in enumerate(self.scene.views):
            delay = self._delay_s(side, view.cells.centre_px[:, 1])
            information = view.information[:, :6, :6]
            sums += np.einsum("c,cij->ij", delay / max(abs(self.swing.row_s[side]), 1e-300), information)
            whole += information.sum(axis=0)
        return np.asarray(np.linalg.solve(whole, sums))

    @property
    def delay_s(self) -> FloatArray:
        """Delay of the subsets (N,) after the first row, in the mean of the cameras."""
        delays = [self._delay_s(side, one.centre_px[:, 1]) for side, one in enumerate(self.uncorrected.references)]
        return np.asarray(np.mean(delays, axis=0))


def blur_along_path(image: NDArray[np.generic], path_px: FloatArray, share: FloatArray) -> NDArray[np.float32]:
    """Return an image (H,W) as the mean of itself shifted along a path.

    The mean is weighted by shares (E,). The shift at the pixel (x, y) is d = (c + a·x + b·y) px. path_px (B, E, 2, 3):
    rows c, a, b, for each of B bands of rows.
    """
    rows, columns = image.shape
    corners = np.array([[1.0, x, y] for x in (0, columns) for y in (0, rows)])
    margin = int(np.ceil(np.abs(path_px @ corners.T).max())) + 2
    spline = spline_of_image(np.pad(image.astype(np.float64), margin, mode="reflect"))
    smooth = np.zeros(image.shape, np.float32)
    _smear((spline.coefficients, spline.degree, margin), path_px, share, np.empty(columns, np.float32), smooth)
    return smooth


@njit()
def _smear(source, path, share, line, smooth):  # type: ignore[no-untyped-def]
    coefficients, degree, margin = source
    rows, columns = smooth.shape
    for i in range(rows):
        band_path = path[i * path.shape[0] // rows]
        for e in range(share.size):
            (c_x, a_x, b_x), (c_y, a_y, b_y) = band_path[e, 0], band_path[e, 1]
            start = margin - c_x - b_x * i, margin + i - c_y - b_y * i
            sample_line(coefficients, degree, start, (1.0 - a_x, -a_y), line, (0, columns))
            for j in range(columns):
                smooth[i, j] += share[e] * line[j]


def prepare_exposure_correction(scene: BodyScene, swing: ExposureMotion) -> ExposureCorrection:
    """Return the correction of a scene whose frames were followed, for an estimated motion."""
    corrected = scene
    if swing.rolling_shutter:
        at_rest = tuple(map(identity_registration, scene.references))
        centres_px = _at_one_instant(scene, swing, 0, at_rest)
        references = tuple(
            replace(reference, centre_px=centre_px)
            for reference, centre_px in zip(scene.references, centres_px, strict=True)
        )
        rest_m = locate_subsets(scene, centres_px).position_m[0]
        seen = tuple(project_body_points(camera, rest_m) for camera in cameras_about(scene, rest_m))
        corrected = replace(scene, references=references, rest_m=rest_m, seen=seen)
    splines = tuple(spline_of_image(image, scene.settings.degree) for image in scene.first)
    views = body_views(corrected, splines, WIDEST_CELL / swing.per_row if swing.rolling_shutter else np.inf)
    if swing.rolling_shutter:
        views = tuple(_with_instants(corrected, swing, side, view) for side, view in enumerate(views))
    corrected = replace(corrected, views=views, near=(), noise=None, lead=(), blocks=())
    return ExposureCorrection(scene, corrected, swing)


def _motion_since(scene: BodyScene, swing: ExposureMotion, number: int, side: int, row_px: FloatArray) -> MotionSeries:
    """Return the motion of points since the frame's instant when the rows (...) are exposed."""
    begin = float(swing.time_s[number])
    return swing.relative_motion(
        begin, begin + row_delay_s(swing.row_s[side], row_px, int(scene.images[side].size_px[1]))
    )


def _at_one_instant(scene: BodyScene, swing: ExposureMotion, number: int, found: Registrations) -> list[FloatArray]:
    """Return the subsets' positions if all rows were exposed with the first one."""
    positions = subset_centres(scene, found)
    shifts = [np.zeros_like(position) for position in positions]
    for _ in range(ROUNDS if swing.rolling_shutter else 0):
        shifted = [position - shift for position, shift in zip(positions, shifts, strict=True)]
        points = locate_subsets(scene, shifted).position_m[0]
        for side, seen in enumerate(cameras_about(scene, points)):
            displaced = apply_motion(_motion_since(scene, swing, number, side, positions[side][:, 1]), points)
            shifts[side] = seen.project(displaced) - seen.project(points)
    return [position - shift for position, shift in zip(positions, shifts, strict=True)]


def _at_positions(
    references: Sequence[ReferenceSubsets], found: Registrations, positions_px: list[FloatArray]
) -> Registrations:
    """Return subsets as they were registered, but at these positions."""
    moved = []
    for reference, one, position in zip(references, found, positions_px, strict=True):
        warp = one.warp.copy()
        warp[:, [0, 3]] = position - reference.centre_px
        moved.append(replace(one, warp=warp))
    return tuple(moved)


def _with_instants(scene: BodyScene, swing: ExposureMotion, side: int, view: BodyView) -> BodyView:
    """Return the body at rest at the first frame's instant, from images with later rows.

    The intersection with a ray is moved back, and along the ray onto the surface.
    """
    patches = view.patches
    carried = _motion_since(scene, swing, 0, side, patches.rest_px[..., 1])
    seen, points = patches.points_m, undo_motion(carried, patches.points_m)
    normal = np.cross(seen[:, 1] - seen[:, 2], seen[:, 3] - seen[:, 4])[:, None]
    ray = seen - view.camera.camera_from_body.inverse().translation_m
    off = ((points - seen) * normal).sum(axis=-1) / (ray * normal).sum(axis=-1)
    points = undo_motion(carried, seen - off[..., None] * ray)
    return replace(view, patches=replace(patches, points_m=points))
