"""Rendered speckle images of moving bodies with known truth, and their Cramér–Rao bound."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.kernels import njit
from shakercal._common.propagation import derivatives

_CELL = 1.15  # spacing of the speckle grid in speckle diameters: dots cover about half of the face
_SHIFT = 0.35  # largest random shift of a dot in cells


@dataclass(frozen=True, eq=False, repr=False)
class Texture(Arrays, shapes="coefficients I J; origin_m 2"):
    """Reflectance over a face: cubic B-spline coefficients (rows, columns) at grid points `step_m` apart.

    `coefficients[i, j]` is that of the face coordinates (u, v) = `origin_m` (2,) + `step_m`·(j, i), in m.
    """

    coefficients: NDArray[np.float32]
    origin_m: FloatArray
    step_m: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.coefficients.shape) < 4:
            raise ValueError(f"coefficients: expected at least 4 x 4, found {self.coefficients.shape}")


def texture_from_samples(samples: NDArray[np.floating], step_m: float, blur_m: float = 0.0) -> Texture:
    """Return the texture through reflectance samples (rows, columns), centred on the face's origin.

    `blur_m` is the σ of a Gaussian filter of the samples: the lens blur at this distance.
    """
    smooth = np.asarray(samples, dtype=np.float64)
    if blur_m > 0:
        smooth = ndimage.gaussian_filter(smooth, blur_m / step_m, mode="nearest")
    coefficients = ndimage.spline_filter(smooth, order=3, output=np.float64, mode="mirror")
    rows, columns = smooth.shape
    origin = -0.5 * step_m * np.array([columns - 1, rows - 1], dtype=np.float64)
    return Texture(coefficients.astype(np.float32), origin, step_m)


def speckle_texture(
    size_m: tuple[float, float], diameter_m: float, step_m: float, blur_m: float, rng: np.random.Generator
) -> Texture:
    """Return a random speckle pattern of dark dots for a face.

    Parameters
    ----------
    size_m
        Width along u and height along v, m.
    diameter_m
        Mean diameter of the dots, m.
    step_m
        Distance of grid points, m.
    blur_m
        σ of the lens blur, m.
    rng
        Random generator.

    Returns
    -------
    Reflectance from 0 to 1.

    Notes
    -----
    Dot diameters vary by ± 15 %. The dots are on a grid 1.15 diameters wide, each shifted randomly by up to 0.35 of it.
    About half of the face is dark, without long-range order.

    Examples
    --------
    >>> speckle_texture((0.02, 0.01), diameter_m=1e-3, step_m=1e-4, blur_m=1e-4, rng=np.random.default_rng(1))
    Texture(coefficients (101, 201), origin_m=[-0.01 -0.005], step_m=0.0001)
    """
    columns, rows = (int(np.ceil(length / step_m)) + 1 for length in size_m)
    cell = _CELL * diameter_m / step_m
    across, down = int(columns / cell) + 2, int(rows / cell) + 2
    shift = rng.uniform(-_SHIFT, _SHIFT, (2, down, across))
    radius = 0.5 * diameter_m / step_m * (1 + 0.15 * rng.uniform(-1, 1, (down, across)))
    x = (np.arange(across) + shift[0]) * cell
    y = (np.arange(down)[:, None] + shift[1]) * cell
    samples = np.ones((rows, columns))
    _paint_dots(samples, x.ravel(), y.ravel(), radius.ravel())
    return texture_from_samples(samples, step_m, blur_m)


def tile_texture(texture: Texture, period_m: float) -> Texture:
    """Return the texture repeated from one tile of `period_m`, as on printed foils."""
    count = max(4, round(period_m / texture.step_m))
    rows, columns = (np.arange(n) % min(count, n) for n in texture.coefficients.shape)
    return replace(texture, coefficients=np.ascontiguousarray(texture.coefficients[np.ix_(rows, columns)]))


@njit()
def _paint_dots(samples: FloatArray, x: FloatArray, y: FloatArray, radius: FloatArray) -> None:
    """Darken discs in place; their rims are one grid step wide."""
    rows, columns = samples.shape
    for k in range(x.size):
        reach = radius[k] + 1.0
        for i in range(max(0, int(y[k] - reach)), min(rows, int(y[k] + reach) + 2)):
            for j in range(max(0, int(x[k] - reach)), min(columns, int(x[k] + reach) + 2)):
                inside = radius[k] + 0.5 - np.hypot(j - x[k], i - y[k])
                samples[i, j] = min(samples[i, j], 1.0 - min(max(inside, 0.0), 1.0))


@njit()
def spline_value(coefficients: NDArray[np.float32], x: float, y: float) -> float:
    """Return the cubic B-spline at a column x and row y, clamped at the border."""
    rows, columns = coefficients.shape
    x = min(max(x, 1.0), columns - 2.000001)
    y = min(max(y, 1.0), rows - 2.000001)
    j, i = int(x), int(y)
    tx, ty = x - j, y - i
    sx, sy = 1.0 - tx, 1.0 - ty
    a0, a3 = sx * sx * sx / 6.0, tx * tx * tx / 6.0
    a1, a2 = 2.0 / 3.0 - 0.5 * tx * tx * (2.0 - tx), 2.0 / 3.0 - 0.5 * sx * sx * (2.0 - sx)
    b0, b3 = sy * sy * sy / 6.0, ty * ty * ty / 6.0
    b1, b2 = 2.0 / 3.0 - 0.5 * ty * ty * (2.0 - ty), 2.0 / 3.0 - 0.5 * sy * sy * (2.0 - sy)
    c = coefficients
    value: float = (
        b0 * (a0 * c[i - 1, j - 1] + a1 * c[i - 1, j] + a2 * c[i - 1, j + 1] + a3 * c[i - 1, j + 2])
        + b1 * (a0 * c[i, j - 1] + a1 * c[i, j] + a2 * c[i, j + 1] + a3 * c[i, j + 2])
        + b2 * (a0 * c[i + 1, j - 1] + a1 * c[i + 1, j] + a2 * c[i + 1, j + 1] + a3 * c[i + 1, j + 2])
        + b3 * (a0 * c[i + 2, j - 1] + a1 * c[i + 2, j] + a2 * c[i + 2, j + 1] + a3 * c[i + 2, j + 2])
    )
    return value


# Objects: a flat textured face of a rigid body, and the view of it.


@dataclass(frozen=True, eq=False, repr=False)
class Face(Arrays, shapes="origin_m 3; axis_u 3; axis_v 3; half_size_m 2"):
    """A flat textured face of a body at rest.

    Its points are origin + u·axis_u + v·axis_v in the world (sensor) frame, in m.

    Attributes
    ----------
    origin_m, axis_u, axis_v : (3,); the axes are orthogonal unit vectors.
    half_size_m : (2,), half width and half height of the rectangle; the first is the radius of a `round` face.
    round : Whether it is a disc.
    texture : Reflectance over (u, v).
    edge_blur_m : σ of the lens blur at the rim, m.
    bright, dark : Grey levels (fractions of full scale) of reflectance 1 and 0.
    background : Grey level around the face.

    Examples
    --------
    >>> texture = speckle_texture((0.02, 0.02), 1e-3, 1e-4, 1e-4, np.random.default_rng(1))
    >>> face = Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array([0.01, 0.01]), False, texture, edge_blur_m=1e-4)
    >>> face.plane.shape
    (3, 3)
    """

    origin_m: FloatArray
    axis_u: FloatArray
    axis_v: FloatArray
    half_size_m: FloatArray
    round: bool
    texture: Texture
    edge_blur_m: float
    bright: float = 0.80
    dark: float = 0.16
    background: float = 0.06

    def __post_init__(self) -> None:
        super().__post_init__()
        axes = np.stack([self.axis_u, self.axis_v])
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-9):
            raise ValueError("axis_u, axis_v: expected two orthogonal unit vectors")

    @property
    def plane(self) -> FloatArray:
        """Matrix (3, 3) [axis_u axis_v origin] from (u, v, 1) to the world frame."""
        return np.column_stack([self.axis_u, self.axis_v, self.origin_m])


@dataclass(frozen=True, eq=False, repr=False)
class View(Arrays, shapes="ray H W 2; ray_x H W 2; ray_y H W 2; light H W"):
    """A camera in the world with its rays and brightness.

    `ray` (H, W, 2): normalised coordinates x = X/Z, y = Y/Z of the pixel centres; `ray_x`, `ray_y` (H, W, 2): their
    change from one pixel to the next, along columns and rows. `light` (H, W): brightness, 1 at the image centre.
    """

    camera: Camera
    camera_from_world: RigidTransform
    ray: FloatArray
    ray_x: FloatArray
    ray_y: FloatArray
    light: FloatArray

    def homography(self, face: Face, pose: FloatArray) -> FloatArray:
        """Return the matrix (3, 3) from a ray (x, y, 1) to w·(u, v, 1).

        The face is that of a body in `pose` (6,).
        """
        camera_from_body = self.camera_from_world @ RigidTransform.from_pose(pose)
        face_to_ray = camera_from_body.rotation @ face.plane
        face_to_ray[:, 2] += camera_from_body.translation_m
        return np.asarray(np.linalg.inv(face_to_ray))


def view_of(camera: Camera, camera_from_world: RigidTransform, falloff: float = 0.12) -> View:
    """Return the view through a camera.

    Parameters
    ----------
    camera
        Camera with distortion.
    camera_from_world
        Pose of the camera.
    falloff
        Relative loss of light at the image corners; default 0.12.

    Returns
    -------
    Rays and brightness of every pixel.

    Examples
    --------
    >>> camera = Camera.from_parameters(np.array([400.0, 400, 31.5, 23.5, 0, 0, 0, 0, 0]), np.array([64, 48]))
    >>> view_of(camera, RigidTransform.identity()).light.shape
    (48, 64)
    """
    width, height = (int(n) for n in camera.size_px)
    x, y = np.meshgrid(np.arange(-1.0, width + 1), np.arange(-1.0, height + 1))
    ray = camera.undistort(np.stack([x, y], axis=-1))
    radius = np.hypot(2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1)[1:-1, 1:-1] / np.sqrt(2)
    return View(
        camera,
        camera_from_world,
        np.ascontiguousarray(ray[1:-1, 1:-1]),
        np.ascontiguousarray(ray[1:-1, 2:] - ray[1:-1, :-2]) / 2,
        np.ascontiguousarray(ray[2:, 1:-1] - ray[:-2, 1:-1]) / 2,
        1 - falloff * radius**2,
    )


# The image sensor: shot noise, read noise, bit depth.


@dataclass(frozen=True)
class ImageSensor:
    """Noise and digitisation of a camera's image sensor.

    Attributes
    ----------
    bit_depth : Significant bits; default 12.
    electrons_per_grey : Electrons per grey level; default 8.
    read_noise_grey : Standard deviation of the read noise in grey levels; default 6.

    Examples
    --------
    >>> sensor = ImageSensor(bit_depth=10)
    >>> sensor.full_scale, int(sensor.digitise(np.array([[0.5]]), None)[0, 0])
    (1023, 512)
    """

    bit_depth: int = 12
    electrons_per_grey: float = 8.0
    read_noise_grey: float = 6.0

    @property
    def full_scale(self) -> int:
        """Largest grey level."""
        return int(2**self.bit_depth - 1)

    def variance(self, grey: FloatArray) -> FloatArray:
        """Return the noise variance of grey levels: shot noise g/e, read noise, 1/12 of rounding."""
        return np.asarray(np.maximum(grey, 0) / self.electrons_per_grey + self.read_noise_grey**2 + 1 / 12)

    def digitise(self, image: FloatArray, rng: np.random.Generator | None) -> NDArray[np.uint16]:
        """Return the stored image of fractions of full scale; without noise if `rng` is None.

        Shot noise is approximated as normal with the variance of the electron count, thousands of electrons per pixel.
        """
        grey = np.asarray(image) * self.full_scale
        if rng is not None:
            spread = np.sqrt(self.variance(grey) - 1 / 12)
            grey = grey + spread * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey), 0, self.full_scale).astype(np.uint16)


# Rendering by ray intersection: pixel aperture and exposure are integrated, lens blur is part of the face.

_FAR = 4.0  # distance in σ of the rim blur beyond which a point is inside or outside


def render(view: View, face: Face, poses: FloatArray, weights: FloatArray, nodes: int = 2) -> FloatArray:
    """Render the noise-free image of a face of a moving body.

    Parameters
    ----------
    view
        Camera and rays.
    face
        The face at rest.
    poses
        (E, 6) of the body, or (H, E, 6) of each row of the image.
    weights
        (E,), of the poses; their sum is 1.
    nodes
        Gauss–Legendre points per pixel along each side; default 2.

    Returns
    -------
    Image (H, W), fractions of full scale.

    Notes
    -----
    A ray meets the moved face at homography·(x, y, 1). The rim is an error function of the distance from it. The
    texture already includes the lens blur.

    Examples
    --------
    >>> texture = speckle_texture((0.02, 0.02), 1e-3, 1e-4, 1e-4, np.random.default_rng(1))
    >>> face = Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array([0.01, 0.01]), False, texture, edge_blur_m=1e-4)
    >>> camera = Camera.from_parameters(np.array([400.0, 400, 31.5, 23.5, 0, 0, 0, 0, 0]), np.array([64, 48]))
    >>> view = view_of(camera, RigidTransform(np.eye(3), np.array([0, 0, 0.2])))
    >>> render(view, face, np.zeros((1, 6)), np.ones(1)).shape
    (48, 64)
    """
    maps = np.stack([view.homography(face, pose) for pose in poses.reshape(-1, 6)]).reshape(-1, len(weights), 3, 3)
    offsets, shares = _gauss_legendre(nodes, 1.0)
    image = np.empty(view.ray.shape[:2])
    tone = np.array([face.dark, face.bright - face.dark, face.background])
    size = np.array([face.half_size_m[0], face.half_size_m[1], float(face.round), face.edge_blur_m])
    grid = np.array([face.texture.origin_m[0], face.texture.origin_m[1], 1.0 / face.texture.step_m])
    rays, aperture = (view.ray, view.ray_x, view.ray_y), (offsets, shares)
    _integrate(rays, (maps, weights), aperture, (face.texture.coefficients, grid), size, tone, image)
    return image * view.light


def bend_view(
    view: View, face: Face, pose: FloatArray, shape_m: Callable[[FloatArray, FloatArray], FloatArray]
) -> View:
    """Return the view in which the undeformed face looks like the deformed one.

    `shape_m` is the small displacement (..., 3) along u, v and the normal of face points u, v (...), in `pose` (6,). A
    ray that meets the plane at (u, v) sees material displaced by d. It is shifted by d_n·r/r_n − d along the face, with
    the ray's direction r, and the ray is replaced by that to the original position. The error is of second order in d.
    """
    hit = np.concatenate([view.ray, np.ones((*view.ray.shape[:2], 1))], axis=2) @ view.homography(face, pose).T
    u, v = hit[..., 0] / hit[..., 2], hit[..., 1] / hit[..., 2]
    camera_from_body = view.camera_from_world @ RigidTransform.from_pose(pose)
    axes = np.column_stack([face.axis_u, face.axis_v, np.cross(face.axis_u, face.axis_v)])
    to_camera = camera_from_body.rotation @ axes
    origin = camera_from_body.apply(face.origin_m)

    def position(u: FloatArray, v: FloatArray) -> FloatArray:
        return np.asarray(origin + np.stack([u, v, np.zeros_like(u)], axis=-1) @ to_camera.T)

    along = position(u, v) @ to_camera
    d = shape_m(u, v)
    off = d[..., 2:] * along[..., :2] / along[..., 2:] - d[..., :2]
    seen = position(u + off[..., 0], v + off[..., 1])
    return replace(view, ray=np.ascontiguousarray(seen[..., :2] / seen[..., 2:]))


def render_exposure(
    view: View,
    face: Face,
    pose_at: Callable[[float], FloatArray],
    middle_s: float | FloatArray,
    exposure_s: float,
    nodes: int = 2,
    times: int = 2,
) -> FloatArray:
    """Render the image (H, W) of a body with `pose_at(time)` (6,) over a rectangular exposure.

    `middle_s`: centre of the exposure of the frame, or (H,) of each of its rows, as with a rolling shutter. With two
    Gauss–Legendre `times` the error of the mean is (π·f·T)⁴/1080 of the amplitude of a line at f, below 10⁻⁸ at f·T =
    0.02.
    """
    offsets, shares = _gauss_legendre(times, exposure_s)
    instants = np.add.outer(np.atleast_1d(middle_s), offsets)
    poses = np.stack([pose_at(instant) for instant in instants.flat]).reshape(*instants.shape, 6)
    return render(view, face, poses, shares, nodes)


def add_face(
    image: FloatArray,
    view: View,
    face: Face,
    pose_at: Callable[[float], FloatArray],
    exposure: tuple[float | FloatArray, float],
    nodes: int = 2,
) -> FloatArray:
    """Return an image (H, W) with one more face that covers no other face.

    `exposure`: middle and length in s.
    """
    return image + render_exposure(view, face, pose_at, *exposure, nodes) - face.background * view.light


def _gauss_legendre(nodes: int, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the points and weights (nodes,) of the mean over an interval around zero."""
    points, weights = np.polynomial.legendre.leggauss(nodes)
    return points * length / 2, weights / 2


@njit(error_model="numpy")
def _integrate(rays, motion, aperture, texture, size, tone, image):  # type: ignore[no-untyped-def]
    """Fill the image with the mean over aperture and exposure, in one pass."""
    (ray, ray_x, ray_y), (maps, weights) = rays, motion
    (offsets, shares), (coefficients, grid) = aperture, texture
    rows, columns = image.shape
    nodes, poses = offsets.size, weights.size
    for i in range(rows):
        row_maps = maps[min(i, maps.shape[0] - 1)]
        for j in range(columns):
            centre_x, centre_y = ray[i, j, 0], ray[i, j, 1]
            total = 0.0
            for q in range(nodes * nodes):
                down, across = offsets[q // nodes], offsets[q % nodes]
                x = centre_x + across * ray_x[i, j, 0] + down * ray_y[i, j, 0]
                y = centre_y + across * ray_x[i, j, 1] + down * ray_y[i, j, 1]
                share = shares[q // nodes] * shares[q % nodes]
                for e in range(poses):
                    w = 1.0 / (row_maps[e, 2, 0] * x + row_maps[e, 2, 1] * y + row_maps[e, 2, 2])
                    u = (row_maps[e, 0, 0] * x + row_maps[e, 0, 1] * y + row_maps[e, 0, 2]) * w
                    v = (row_maps[e, 1, 0] * x + row_maps[e, 1, 1] * y + row_maps[e, 1, 2]) * w
                    cover = _cover(size, u, v)
                    value = tone[2]
                    if cover > 0.0:
                        column, row = (u - grid[0]) * grid[2], (v - grid[1]) * grid[2]
                        value += cover * (tone[0] + tone[1] * spline_value(coefficients, column, row) - tone[2])
                    total += share * weights[e] * value
            image[i, j] = total


@njit(error_model="numpy")
def _cover(size: FloatArray, u: float, v: float) -> float:
    """Return the share of the point (u, v) on the face, smooth at the rim."""
    inside = size[0] - math.sqrt(u * u + v * v) if size[2] > 0.0 else min(size[0] - abs(u), size[1] - abs(v))
    cover = inside / size[3]
    if cover > _FAR:
        return 1.0
    return 0.0 if cover < -_FAR else 0.5 * (1.0 + math.erf(cover / math.sqrt(2.0)))


# Cramér-Rao bound of the motion in a set of images.

_POSE_STEP = np.array([2e-6] * 3 + [2e-5] * 3)  # m and, at 0.1 m from the origin, rad: some hundredths of a pixel


def motion_bound(
    views: Sequence[View],
    face: Face,
    sensor: ImageSensor,
    pose: FloatArray | None = None,
    shapes: Sequence[Callable[[FloatArray, FloatArray], FloatArray]] = (),
) -> FloatArray:
    """Return the Cramér–Rao bound (6, 6) of a motion in one frame.

    The components are x y z rx ry rz (m, rad, at the world origin). The bound is (Σ w·JᵀJ)⁻¹ over all pixels of all
    views, with J = ∂grey/∂pose by central differences of the rendered images and w = 1/noise variance. Gain, offset and
    noise of a reference are assumed known; their estimation increases the bound. With S `shapes` of bending
    (`bend_view`) the covariance is (6 + S, 6 + S), amplitudes in m.
    """
    start = np.zeros(6) if pose is None else np.asarray(pose, dtype=np.float64)

    def bending(amplitude: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
        return np.asarray(sum(a * shape(u, v) for a, shape in zip(amplitude, shapes, strict=True)))

    def grey(view: View, change: FloatArray) -> FloatArray:
        moved, amplitude = start + change[:6], change[6:]
        seen = bend_view(view, face, moved, partial(bending, amplitude)) if amplitude.any() else view
        return render(seen, face, moved[None], np.ones(1)) * sensor.full_scale

    steps = np.concatenate([_POSE_STEP, np.full(len(shapes), _POSE_STEP[0])])
    information = np.zeros((len(steps), len(steps)))
    for view in views:
        slope, variance = derivatives(partial(grey, view), steps), sensor.variance(grey(view, np.zeros(len(steps))))
        information += np.einsum("hwi,hwj,hw->ij", slope, slope, 1 / variance, optimize=True)
    return np.asarray(np.linalg.inv(information))


# Simulated calibration session: covariance of a stereo pair's parameters.

# Steps of the numeric derivative, and prior standard deviations (focal lengths and centres in px, the distortion of a
# good lens, rotation in rad, translation in m). Without a prior, k3 of a narrow field is undetermined.
_CAMERA_STEP = (0.1, 0.1, 0.1, 0.1, 1e-4, 1e-3, 1e-5, 1e-5, 1e-2)
_CAMERA_PRIOR = (100.0, 100.0, 30.0, 30.0, 0.2, 0.5, 2e-3, 2e-3, 0.5)
_STEPS = np.array([*_CAMERA_STEP, *_CAMERA_STEP, *[1e-6] * 6])
_PRIOR = np.array([*_CAMERA_PRIOR, *_CAMERA_PRIOR, *[0.1] * 3, *[0.05] * 3])


def session_covariance(
    rig: StereoRig, working_point_m: FloatArray, field_m: float, noise_px: float, views: int, rng: np.random.Generator
) -> FloatArray:
    """Return the covariance (24, 24) of a rig after a simulated calibration session.

    The flat target has 13 × 10 points over 0.9 of the field `field_m`, in `views` random poses around the working point
    (tilts up to 0.5 rad, shifts up to 0.12 of the field, in depth 0.4). Corners are found to `noise_px` per coordinate.
    The result is the inverse Fisher information with the target's poses marginalised (Schur complement of each view's 6
    × 6 block). The target's scale is assumed exact; its uncertainty is `scale_uncertainty`.
    """
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 13) * field_m, np.linspace(-0.36, 0.36, 10) * field_m)
    target = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    information = np.diag(1 / _PRIOR**2)
    for _ in range(views):
        pose = np.concatenate(
            [rng.uniform(-1, 1, 3) * field_m * np.array([0.12, 0.12, 0.4]), rng.uniform(-0.5, 0.5, 3)]
        )
        points = target @ rotation_from_vector(pose[3:]).T + pose[:3] + working_point_m
        rig_slope, pose_slope = _slopes(rig, points, working_point_m)
        cross = rig_slope.T @ pose_slope
        information += (
            rig_slope.T @ rig_slope - cross @ np.linalg.solve(pose_slope.T @ pose_slope, cross.T)
        ) / noise_px**2
    scale = np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((covariance + covariance.T) / 2)


def _slopes(rig: StereoRig, points: FloatArray, pivot: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the pixels by rig (Q, 24) and pose (Q, 6)."""

    def pixels(seen_by: StereoRig, points: FloatArray) -> FloatArray:
        return np.concatenate([side.ravel() for side in seen_by.project(points)])

    def moved(pose: FloatArray) -> FloatArray:
        return RigidTransform.from_pose(pose).apply(points - pivot) + pivot

    by_rig = derivatives(lambda delta: pixels(rig.perturbed(delta), points), _STEPS)
    return by_rig, derivatives(lambda delta: pixels(rig, moved(delta)), np.full(6, 1e-6))
