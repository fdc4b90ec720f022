"""Rendered images of calibration targets with known truth.

A Gaussian blurs the pattern in its plane, in closed form. An image is therefore as point-symmetric about each corner
and dot as the perspective permits. The mean over the pixel's square uses 3 × 3 Gauss points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram.camera import Camera, StereoRig, distort, undistort
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.patterns import Board, spots, tiles
from photogram.targets.target_view import TargetView
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.kernels import njit

_FAR = 4.5  # distance in σ of the blur beyond which an edge has no effect
_NODE = math.sqrt(0.6)  # Gauss-Legendre points of degree 5 on (−1, 1), weights 5/18, 8/18, 5/18 of the mean


@njit(error_model="numpy")
def _rays(row: int, camera: FloatArray, rays: FloatArray) -> None:
    """Fill the rays (W, 6) of a row of pixels.

    They are normalised x, y and ∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v. Newton steps from the neighbour's ray; a pixel outside the
    range of the distortion is NaN.
    """
    x, y = math.nan, math.nan
    for column in range(rays.shape[0]):
        if math.isnan(x):
            x, y = undistort(float(column), float(row), camera)
        target_y = (row - camera[3]) / camera[1]
        target_x = (column - camera[2] - camera[12] * target_y) / camera[0]
        for _ in range(2):
            xd, yd, dxx, dxy, dyy = distort(x, y, camera)
            determinant = dxx * dyy - dxy * dxy
            x += (dyy * (target_x - xd) - dxy * (target_y - yd)) / determinant
            y += (dxx * (target_y - yd) - dxy * (target_x - xd)) / determinant
        if not determinant > 0.0:
            x, y = math.nan, math.nan
        rays[column, 0], rays[column, 1] = x, y
        rays[column, 2], rays[column, 4] = dyy / (determinant * camera[0]), -dxy / (determinant * camera[0])
        rays[column, 3] = -dxy / (determinant * camera[1]) - rays[column, 2] * camera[12] / camera[1]
        rays[column, 5] = dxx / (determinant * camera[1]) - rays[column, 4] * camera[12] / camera[1]
        x, y = x + rays[column, 2], y + rays[column, 4]


@njit(error_model="numpy")
def _plane(homography: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Return the point in the target's plane on the ray (x, y, 1)."""
    w = 1.0 / (homography[2, 0] * x + homography[2, 1] * y + homography[2, 2])
    u = (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) * w
    return u, (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) * w


@njit(error_model="numpy")
def _reach(homography: FloatArray, ray: FloatArray, sigma: float) -> float:
    """Return the distance in the target's plane within which an edge affects a pixel."""
    u, v = _plane(homography, ray[0], ray[1])
    right_u, right_v = _plane(homography, ray[0] + ray[2], ray[1] + ray[4])
    below_u, below_v = _plane(homography, ray[0] + ray[3], ray[1] + ray[5])
    size = math.hypot(right_u - u, right_v - v) + math.hypot(below_u - u, below_v - v)
    return 0.5 * size + _FAR * sigma


@njit(error_model="numpy")
def _step(distance: float, sigma: float) -> float:
    return 0.5 * (1.0 + math.erf(distance / (sigma * math.sqrt(2.0))))


@njit(error_model="numpy")
def _shares(edges: FloatArray, value: float, sigma: float, first: int, last: int, shares: FloatArray) -> None:
    """Fill shares[first : last + 1] with tile weights; tile k ends at edge k."""
    lower = 0.0
    for k in range(first, last + 1):
        upper = _step(edges[k] - value, sigma) if k < last else 1.0
        shares[k] = upper - lower
        lower = upper


@njit(error_model="numpy")
def render_tiles(camera, homography, edges_x, edges_y, tiles, sigma, image):  # type: ignore[no-untyped-def]
    """Fill image (H, W) with a pattern of constant tiles.

    The tiles are (Y + 1, X + 1), the edges between them (X,) and (Y,).
    """
    rays = np.empty((image.shape[1], 6))
    share_x, share_y = np.empty(edges_x.size + 1), np.empty(edges_y.size + 1)
    for row in range(image.shape[0]):
        _rays(row, camera, rays)
        for column in range(image.shape[1]):
            ray = rays[column]
            u, v = _plane(homography, ray[0], ray[1])
            reach = _reach(homography, ray, sigma)
            if not reach > 0.0:
                image[row, column] = tiles[0, 0]
                continue
            i0, i1 = np.searchsorted(edges_x, u - reach, "right"), np.searchsorted(edges_x, u + reach, "right")
            j0, j1 = np.searchsorted(edges_y, v - reach, "right"), np.searchsorted(edges_y, v + reach, "right")
            if i0 == i1 and j0 == j1:
                image[row, column] = tiles[j0, i0]
                continue
            total = 0.0
            for q in range(9):
                down, across = 0.5 * _NODE * (q // 3 - 1), 0.5 * _NODE * (q % 3 - 1)
                x, y = ray[0] + across * ray[2] + down * ray[3], ray[1] + across * ray[4] + down * ray[5]
                u, v = _plane(homography, x, y)
                _shares(edges_x, u, sigma, i0, i1, share_x)
                _shares(edges_y, v, sigma, j0, j1, share_y)
                weight = (8.0 if q // 3 == 1 else 5.0) * (8.0 if q % 3 == 1 else 5.0) / 324.0
                for j in range(j0, j1 + 1):
                    for i in range(i0, i1 + 1):
                        total += weight * share_y[j] * share_x[i] * tiles[j, i]
            image[row, column] = total


@njit(error_model="numpy")
def _dots_value(spots: FloatArray, first: FloatArray, u: float, v: float, sigma: float) -> float:
    """Return the share of black at (u, v), in spacings, of the nearest four dots."""
    white = 1.0
    for k in range(4):
        i, j = math.floor(u) + k % 2, math.floor(v) + k // 2
        column, row = int(i - first[0]), int(j - first[1])
        if 0 <= row < spots.shape[0] and 0 <= column < spots.shape[1] and spots[row, column, 0] > 0.0:
            distance = math.hypot(u - i, v - j)
            black = _step(spots[row, column, 0] - distance, sigma)
            if spots[row, column, 1] > 0.0:
                black *= _step(distance - spots[row, column, 1], sigma)
            white *= 1.0 - black
    return 1.0 - white


@njit(error_model="numpy")
def _plain(spots: FloatArray, first: FloatArray, sheet: FloatArray, u: float, v: float, reach: float) -> bool:
    """Return whether the distance of (u, v) to all edges exceeds `reach`."""
    if abs(min(u - sheet[0], sheet[1] - u, v - sheet[2], sheet[3] - v)) < reach or not reach < 0.5:
        return False
    for k in range(4):
        i, j = math.floor(u) + k % 2, math.floor(v) + k // 2
        column, row = int(i - first[0]), int(j - first[1])
        if 0 <= row < spots.shape[0] and 0 <= column < spots.shape[1]:
            distance = math.hypot(u - i, v - j)
            if abs(distance - spots[row, column, 0]) < reach or abs(distance - spots[row, column, 1]) < reach:
                return False
    return True


@njit(error_model="numpy")
def render_dots(camera, homography, spots, first, sheet, sigma, image):  # type: ignore[no-untyped-def]
    """Fill image (H, W, 2) with the shares of black and of sheet.

    Lengths are in lattice spacings. spots (rows, columns, 2): radius of the dot and of the hole in it, 0 for none, at
    lattice points from `first` (2,). sheet (4,): first and last x, first and last y of the white sheet.
    """
    rays = np.empty((image.shape[1], 6))
    for row in range(image.shape[0]):
        _rays(row, camera, rays)
        for column in range(image.shape[1]):
            ray = rays[column]
            black, cover = 0.0, 0.0
            u, v = _plane(homography, ray[0], ray[1])
            plain = _plain(spots, first, sheet, u, v, _reach(homography, ray, sigma))
            for q in range(4, 5) if plain else range(9):
                down, across = 0.5 * _NODE * (q // 3 - 1), 0.5 * _NODE * (q % 3 - 1)
                x, y = ray[0] + across * ray[2] + down * ray[3], ray[1] + across * ray[4] + down * ray[5]
                u, v = _plane(homography, x, y)
                share = 1.0 if plain else (8.0 if q // 3 == 1 else 5.0) * (8.0 if q % 3 == 1 else 5.0) / 324.0
                inside = min(u - sheet[0], sheet[1] - u, v - sheet[2], sheet[3] - v)
                if inside > -_FAR * sigma:
                    black += share * _dots_value(spots, first, u, v, sigma)
                    cover += share * _step(inside, sigma)
            image[row, column, 0], image[row, column, 1] = black, cover


# Images of calibration targets with known truth.

_FINER = 2  # rendered squares along a pixel
_SOFT_PX = 0.5  # blur of the rendered edges, in these squares


def render_board(
    camera: Camera,
    camera_from_target: RigidTransform,
    board: Board,
    blur_px: float = 0.7,
    falloff: float = 0.12,
    slant: float = 0.0,
) -> FloatArray:
    """Render the noise-free image of a board.

    Parameters
    ----------
    camera
        Camera with distortion.
    camera_from_target
        Pose of the board.
    board
        The board.
    blur_px
        σ of the lens's Gaussian blur in px; default 0.7.
    falloff
        Relative loss of light at the image corners; default 0.12.
    slant
        Relative increase of light from left to right; default 0.

    Returns
    -------
    Image (H, W), fractions of full scale.

    Raises
    ------
    ValueError : The blur is too small for the sampling.

    Notes
    -----
    The pattern is rendered at half the pixel width with edges blurred by 0.5 of these pixels, the least for sampling.
    It is convolved with the rest of the Gaussian and averaged over each pixel's square.

    Examples
    --------
    >>> camera = Camera.from_parameters(np.array([400.0, 400, 80, 60, 0, 0, 0, 0, 0]), np.array([160, 120]))
    >>> pose = RigidTransform(np.eye(3), np.array([-0.02, -0.015, 0.2]))
    >>> render_board(camera, pose, Board(Target("chessboard", 9e-3, (5, 4)))).shape
    (120, 160)
    """
    from scipy.ndimage import gaussian_filter

    if _FINER * blur_px < _SOFT_PX:
        raise ValueError(f"blur_px: expected a blur of at least {_SOFT_PX / _FINER} px, found {blur_px}")
    matrix = camera.matrix * _FINER
    matrix[:2, 2] += (_FINER - 1) / 2
    matrix[2, 2] = 1.0
    fine = Camera(matrix, camera.distortion, camera.size_px * _FINER)
    sharp = _drawn(fine, camera_from_target, board, _SOFT_PX)
    rest = math.sqrt((_FINER * blur_px) ** 2 - _SOFT_PX**2)
    blurred = gaussian_filter(sharp, rest, mode="nearest", truncate=6.0)
    width, height = (int(n) for n in camera.size_px)
    image = blurred.reshape(height, _FINER, width, _FINER).mean(axis=(1, 3))
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
    return np.asarray(image * np.asarray(1 + slant / 2 * x - falloff * (x**2 + y**2) / 2))


def _drawn(camera: Camera, camera_from_target: RigidTransform, board: Board, soft_px: float) -> FloatArray:
    """Return the pattern (H, W) with blurred edges, `soft_px` at the board's centre."""
    spacing = board.target.spacing_m
    plane_to_ray = camera_from_target.rotation * [spacing, spacing, 1.0]
    plane_to_ray[:, 2] = camera_from_target.translation_m
    homography = np.linalg.inv(plane_to_ray)
    sigma = soft_px / _magnification(camera, camera_from_target, board)
    width, height = (int(n) for n in camera.size_px)
    if board.target.kind in {"chessboard", "charuco", "aprilgrid"}:
        image = np.empty((height, width))
        edges_x, edges_y, levels = tiles(board)
        render_tiles(camera.parameters, homography, edges_x, edges_y, levels, sigma, image)
        return image
    shares = np.empty((height, width, 2))
    dots, first = spots(board)
    render_dots(camera.parameters, homography, dots, first, board.extent_m / spacing, sigma, shares)
    sheet = board.bright - (board.bright - board.dark) * shares[..., 0]
    return np.asarray(board.background + (sheet - board.background) * shares[..., 1])


def _magnification(camera: Camera, camera_from_target: RigidTransform, board: Board) -> float:
    x0, x1, y0, y1 = board.extent_m
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    step = 1e-3 * board.target.spacing_m
    around = middle + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    pixels = camera.project(camera_from_target.apply(around))
    slope = np.stack([pixels[0] - pixels[1], pixels[2] - pixels[3]]) / 2e-3
    return float(np.sqrt(np.abs(np.linalg.det(slope))))


# Random stereo pairs and random poses of a calibration target: sessions with known truth.

_TRIES = 1500  # random poses tried for each accepted one
_STEEPEST_RAD = 0.9  # largest angle between the board's normal and the ray to a camera


def random_rig(rng: np.random.Generator, size_px: IntArray, field_m: float) -> StereoRig:
    """Return a random stereo pair whose axes cross where the images are about `field_m` wide.

    Half the left field of view is 8 … 25°, the angle between the axes 10 … 35°. Focal lengths of a pair are within 5 %,
    principal points within 3 % of the width. Distortion: |k1| ≤ 0.15, |k2| ≤ 0.1, |p| ≤ 5·10⁻⁴, |k3| ≤ 0.05.
    """
    focal = float(size_px[0]) / 2 / np.tan(rng.uniform(np.radians(8), np.radians(25)))
    distance = field_m * focal / float(size_px[0])
    rotation = rotation_from_vector(np.array([0.0, rng.uniform(np.radians(10), np.radians(35)), 0.0]))
    rotation = rotation_from_vector(rng.uniform(-0.03, 0.03, 3)) @ rotation
    crossing = np.array([0.0, 0.0, distance])
    seen = np.array([0.0, 0.0, distance * rng.uniform(0.95, 1.05)]) + rng.uniform(-0.02, 0.02, 3) * field_m
    return StereoRig(
        _camera(rng, size_px, focal),
        _camera(rng, size_px, focal * rng.uniform(0.95, 1.05)),
        RigidTransform(rotation, seen - rotation @ crossing),
    )


def _camera(rng: np.random.Generator, size_px: IntArray, focal_px: float) -> Camera:
    centre = (size_px - 1) / 2 + rng.uniform(-0.03, 0.03, 2) * size_px[0]
    fy = focal_px * rng.uniform(0.998, 1.002)
    distortion = rng.uniform(-1, 1, 5) * [0.15, 0.1, 5e-4, 5e-4, 0.05]
    return Camera.from_parameters(np.array([focal_px, fy, *centre, *distortion]), size_px)


def random_poses(rng: np.random.Generator, rig: StereoRig, board: Board, count: int) -> list[RigidTransform]:
    """Return `count` random poses left_from_target of a board in both fields of view.

    The board's normal is tilted by up to 0.6 rad against the bisector of the two axes. The board is rotated in its
    plane by up to 0.5 rad and is anywhere within both fields of view, in depth within 12 %. For dots with ring markers
    only the markers and the dots around them have to be visible.
    """
    required = _required(board)
    centre, facing, distance = _working_point(rig, board)
    lateral = 0.5 * distance * float(rig.left.size_px[0]) / rig.left.matrix[0, 0]
    poses: list[RigidTransform] = []
    for _ in range(_TRIES * count):
        turn = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
        direction, angle = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.6)
        rotation = facing @ rotation_from_vector(angle * np.array([np.cos(direction), np.sin(direction), 0.0])) @ turn
        shift = rng.uniform(-1, 1, 3) * [lateral, lateral, 0.12 * distance]
        pose = RigidTransform(rotation, centre + shift - rotation @ required.mean(axis=0))
        if _seen(rig, pose, required):
            poses.append(pose)
        if len(poses) == count:
            return poses
    raise ValueError(
        f"board: expected one that fits into both images, found {len(poses)} poses in {_TRIES * count} tries"
    )


def _working_point(rig: StereoRig, board: Board) -> tuple[FloatArray, FloatArray, float]:
    """Return where the axes meet, the rotation of a facing board, and the left distance."""
    left_from_right = rig.right_from_left.inverse()
    axes = np.stack([[0.0, 0.0, 1.0], left_from_right.rotation[:, 2]])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centre = np.linalg.solve(across.sum(axis=0), across[1] @ left_from_right.translation_m)
    z = axes.sum(axis=0) / np.linalg.norm(axes.sum(axis=0))
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(z, x), z])
    if board.rings is not None or board.target.kind == "aprilgrid":
        facing = facing * [1.0, -1.0, -1.0]
    return centre, facing, float(centre[2])


def _required(board: Board) -> FloatArray:
    if board.rings is not None:
        x, y = board.rings
        corners = np.array([[-1.0, -1.0], [x + 1, -1], [x + 1, y + 1], [-1, y + 1]])
    else:
        inset = board.margin - 0.25
        x0, x1, y0, y1 = board.extent_m / board.target.spacing_m + inset * np.array([1.0, -1.0, 1.0, -1.0])
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return np.column_stack([corners, np.zeros(4)]) * board.target.spacing_m


def _seen(rig: StereoRig, pose: RigidTransform, required: FloatArray) -> bool:
    """Return whether both cameras see the required points, and not too obliquely."""
    points = pose.apply(required)
    for camera, camera_from_left in ((rig.left, RigidTransform.identity()), (rig.right, rig.right_from_left)):
        pixels = camera.project(camera_from_left.apply(points))
        if not ((pixels > 4) & (pixels < camera.size_px - 5)).all():
            return False
        rays = points + camera_from_left.rotation.T @ camera_from_left.translation_m
        cosine = rays @ pose.rotation[:, 2] / np.linalg.norm(rays, axis=1)
        if not (np.abs(cosine) > np.cos(_STEEPEST_RAD)).all():
            return False
    return True


@dataclass(frozen=True)
class SessionFaults:
    """Errors of real calibration sessions beyond the noise of their points.

    Attributes
    ----------
    warp_m : Largest height of a bent board, a random polynomial of third order.
    focus : Relative change of both focal lengths from the first view to the last.
    smooth_px : rms error per coordinate shared by neighbours in one image (light, soft print, air), over `_SMOOTH` of
        the board's diagonal, different in every image.
    locking_px : Amplitude of an error that depends on the point's position within its pixel, as in sharpened images.
    focus_profile : "even"; "warming", exponential with three time constants; "jump", at once after a third of the
        views, as a touched lens.
    held : Number of successive views that share their smooth error, as images of a target held at rest do.
    """

    warp_m: float = 0.0
    focus: float = 0.0
    smooth_px: float = 0.0
    locking_px: float = 0.0
    focus_profile: Literal["even", "warming", "jump"] = "even"
    held: int = 1

    def growth(self, views: int) -> FloatArray:
        """Return the relative change (V,) of the focal lengths in each view, with mean zero."""
        time = np.linspace(0.0, 1.0, views)
        if self.focus_profile == "warming":
            time = -np.expm1(-3 * time) / -np.expm1(-3)
        elif self.focus_profile == "jump":
            time = (time > 1 / 3).astype(np.float64)
        return np.asarray(self.focus * (time - time.mean()))


_SMOOTH = 0.3  # correlation length of smooth errors over the board's diagonal


def simulate_session(
    rng: np.random.Generator,
    rig: StereoRig,
    poses: Sequence[RigidTransform],
    board: Board,
    noise_px: float,
    faults: SessionFaults = SessionFaults(),
) -> list[tuple[TargetView, TargetView]]:
    """Return simulated views (left, right) of a board's corners, without images.

    The noise is stated in the views, the faults are not. The rig's focal lengths are the means over the session.
    """
    index = board.index.astype(np.int64)
    points = board.points_m + _warp(rng, board.points_m, faults.warp_m)
    distance = np.linalg.norm(board.points_m[:, None] - board.points_m, axis=-1)
    length = _SMOOTH * float(distance.max())
    root = np.linalg.cholesky(np.exp(-0.5 * (distance / length) ** 2) + 1e-6 * np.eye(len(points)))
    stated = np.broadcast_to(noise_px**2 * np.eye(2), (len(points), 2, 2))
    pairs: list[tuple[TargetView, TargetView]] = []
    smooth: dict[str, FloatArray] = {}
    for number, (pose, change) in enumerate(zip(poses, faults.growth(len(poses)), strict=True)):
        growth = np.ones(13)
        growth[:2] += change
        sides = [Camera.from_parameters(camera.parameters * growth, camera.size_px) for camera in (rig.left, rig.right)]
        found = []
        projected = replace(rig, left=sides[0], right=sides[1]).project(pose.apply(points))
        for side, camera, pixel in zip("LR", sides, projected, strict=True):
            noise = noise_px * rng.normal(size=pixel.shape)
            if number % faults.held == 0:
                smooth[side] = faults.smooth_px * (root @ rng.normal(size=pixel.shape))
            seen = pixel + noise + smooth[side] + faults.locking_px * np.sin(2 * np.pi * pixel)
            found.append(TargetView(f"{side}{number}", index, seen, stated, 0.0, 0.7, camera.size_px))
        pairs.append((found[0], found[1]))
    return pairs


def _warp(rng: np.random.Generator, points_m: FloatArray, height_m: float) -> FloatArray:
    """Return offsets (N, 3) of a board's points that is bent by up to `height_m`."""
    x, y = ((points_m - points_m.mean(axis=0)) / np.ptp(points_m, axis=0).max() * 2)[:, :2].T
    terms = np.column_stack([x * x, x * y, y * y, 0.5 * x**3, 0.5 * x * x * y, 0.5 * x * y * y, 0.5 * y**3])
    height = terms @ rng.normal(size=7)
    plane = np.column_stack([np.ones_like(x), x, y])
    height -= plane @ np.linalg.lstsq(plane, height, rcond=None)[0]
    return np.outer(height_m * height / np.abs(height).max(), [0.0, 0.0, 1.0])
