"""Where the cameras stand and what they see: nominal stereo rigs, poses and speckled faces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from photogram.camera import Camera, StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector
from photogram.synthetic import Face, ImageSensor, session_covariance, speckle_texture

_LEFT_LENS = (-0.09, 0.12, 2e-4, -1.5e-4, 0.0)
_RIGHT_LENS = (-0.085, 0.10, -1e-4, 2e-4, 0.0)
_SPECKLE_PX = 5.0
_DOT_SOFTNESS_PX = 1.0
_ALIASED_SPECKLE_PX = 2.8  # a width of 2 px
_BLUR_PX = 0.6
_CORNER_NOISE_PX = 0.02
_SESSION_VIEWS = 20


@dataclass(frozen=True)
class StereoSetup:
    """A stereo pair on one face: `tilt_deg` from its normal towards `face_up`, `stereo_deg` between the cameras.

    `pixel_m` is the size of a pixel on the face; `face_up` the direction in the face that is up in the images.
    """

    name: str
    body: str
    size_px: tuple[int, int]
    pixel_m: float
    focal_px: float
    face_centre: tuple[float, float, float]
    face_normal: tuple[float, float, float]
    face_up: tuple[float, float, float]
    half_size: tuple[float, float]
    round: bool
    tilt_deg: float
    stereo_deg: float
    bit_depth: int = 12
    electrons_per_grey: float = 8.0
    read_noise_grey: float = 6.0
    delay_uncertainty: float = 3e-7
    scale_uncertainty: float = 2e-4
    pose_uncertainty: tuple[float, ...] = (1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4)

    @property
    def sensor(self) -> ImageSensor:
        """The image sensor of both cameras."""
        return ImageSensor(self.bit_depth, self.electrons_per_grey, self.read_noise_grey)

    def scaled(self, factor: float) -> StereoSetup:
        """Return the set-up with images `factor` as large, over the same pixel on the face."""
        width, height = (max(64, round(n * factor)) for n in self.size_px)
        half = (self.half_size[0] * factor, self.half_size[1] * factor)
        return replace(self, size_px=(width, height), half_size=half)


@lru_cache(maxsize=8)
def nominal_rig(setup: StereoSetup) -> tuple[StereoRig, RigidTransform]:
    """Return the stereo rig with its session's covariance, and sensor_from_left, as the laboratory states them.

    Its covariance takes half a second: a set-up simulated again has it ready.
    """
    poses = [_sensor_from_camera(setup, sign * setup.stereo_deg / 2) for sign in (-1.0, 1.0)]
    size = np.array(setup.size_px, dtype=np.int64)
    cameras = []
    for focal, lens in ((setup.focal_px, _LEFT_LENS), (setup.focal_px * 1.003, _RIGHT_LENS)):
        matrix = np.array(
            [[focal, 0, (size[0] - 1) / 2 + 2.3], [0, focal * 1.0004, (size[1] - 1) / 2 - 1.7], [0, 0, 1]]
        )
        cameras.append(Camera(matrix, np.array(lens), size))
    rig = StereoRig(cameras[0], cameras[1], poses[1].inverse() @ poses[0])
    distance = setup.focal_px * setup.pixel_m
    covariance = session_covariance(
        rig,
        np.array([0, 0, distance]),
        setup.pixel_m * float(size[0]),
        _CORNER_NOISE_PX,
        _SESSION_VIEWS,
        np.random.default_rng(20),
    )
    return replace(rig, covariance=covariance), poses[0]


def left_camera(setup: StereoSetup) -> RigidTransform:
    """Return sensor_from_left of a pair as the laboratory states it, as exact as a file of numbers is."""
    return _sensor_from_camera(setup, -setup.stereo_deg / 2)


def _sensor_from_camera(setup: StereoSetup, angle_deg: float) -> RigidTransform:
    """Return the pose of a camera that looks at the face's centre from `angle_deg` beside the middle direction."""
    normal, up, centre = (np.array(v) for v in (setup.face_normal, setup.face_up, setup.face_centre))
    tilt = np.deg2rad(setup.tilt_deg)
    towards = np.cos(tilt) * normal + np.sin(tilt) * up
    screen_up = np.cos(tilt) * up - np.sin(tilt) * normal
    towards = rotation_from_vector(np.deg2rad(angle_deg) * screen_up) @ towards
    right = np.cross(-towards, screen_up)
    rotation = np.column_stack([right, -screen_up, -towards])
    return RigidTransform(rotation, centre + setup.focal_px * setup.pixel_m * towards)


def face_of(setup: StereoSetup, aliased: bool, rng: np.random.Generator) -> Face:
    """Return the speckled face: sprayed dots of 5 px behind the lens blur of 0.6 px, or sharp dots of 2 px (`aliased`).

    The rims of sprayed dots are soft (σ 1 px), which leaves nothing beyond the Nyquist frequency of the pixels: sharp
    discs of the same size alias by 1 % of their amplitude and move subsets by 1 to 2 thousandths of a pixel.
    """
    normal, up = np.array(setup.face_normal), np.array(setup.face_up)
    pixel = setup.pixel_m
    speckle = _ALIASED_SPECKLE_PX if aliased else _SPECKLE_PX
    blur = 0.0 if aliased else float(np.hypot(_BLUR_PX, _DOT_SOFTNESS_PX)) * pixel
    extent = (2 * setup.half_size[0] + 8 * pixel, 2 * setup.half_size[1] + 8 * pixel)
    texture = speckle_texture(extent, speckle * pixel, pixel / (5 if aliased else 4), blur, rng)
    half = np.array(setup.half_size)
    return Face(np.array(setup.face_centre), np.cross(up, normal), up, half, setup.round, texture, _BLUR_PX * pixel)
