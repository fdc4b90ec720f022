"""Presets of simulated rigs, and what stands before the cameras."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import Face, ImageSensor, session_covariance, speckle_texture
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS

# What a simulation may leave out or make smaller.


@dataclass(frozen=True)
class SimulationOptions:
    """Switches of truth and noise, each on its own.

    `image_noise`, `channel_noise`: shot, read and amplifier noise. `systematic_errors`: what the manifests state as
    uncertainties is drawn, else everything is exactly as stated. `trigger_jitter`: 30 ns rms. `aliased`: sharp 2 px
    speckle without lens blur. `frames`: fewer frames. `image_scale`: smaller images of a smaller face, same optics.
    """

    image_noise: bool = True
    channel_noise: bool = True
    systematic_errors: bool = True
    trigger_jitter: bool = True
    aliased: bool = False
    frames: int | None = None
    image_scale: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be a recording."""
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames: expected at least 3, found {self.frames}")
        if not 0.1 <= self.image_scale <= 1:
            raise ValueError(f"image_scale: expected 0.1 to 1, found {self.image_scale}")


# Where the cameras stand and what they see: nominal stereo rigs, poses and speckled faces.


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


# The simulated set-ups: what the laboratory knows about them, and what really moves.


@dataclass(frozen=True)
class PartSpec:
    """A rigid part of the load as the laboratory states it: SI values and standard uncertainties."""

    name: str
    mass: float
    mass_uncertainty: float
    centre_of_mass: tuple[float, float, float]
    centre_of_mass_uncertainty: float
    inertia: tuple[float, float, float]
    inertia_uncertainty: float


@dataclass(frozen=True)
class ChannelSpec:
    """A DAQ channel: `scale` is the manifest's, `noise` (rms) and `lsb` are in file units."""

    name: str
    quantity: str
    scale: float
    noise: float
    lsb: float
    body: str = ""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    stated: dict[str, float] = field(default_factory=dict)
    common: str = ""
    unit: str = "V"


@dataclass(frozen=True)
class DaqSpec:
    """One recorder: file, rate, true deviation of its clock, start before the time base's zero, its channels."""

    name: str
    file: str
    sample_rate_hz: float
    clock_uncertainty: float
    start_s: float
    duration_s: float
    channels: tuple[ChannelSpec, ...]
    response: str = ""


@dataclass(frozen=True)
class Preset:
    """A whole set-up. Phasors (K, 6) are true accelerations of the load at the lines `fundamental_hz`·`multiples`.

    `points`: stereo pairs of which another program's points are written instead of images. `down`: of gravity.
    """

    name: str
    rig_name: str
    recording: str
    sensor_name: str
    serial: str
    sense: str
    sensitivity: tuple[float, ...]
    capacity: tuple[float, ...]
    cross_talk: float
    damping_s: tuple[float, ...]
    lag_s: float
    mount_hz: tuple[float, ...]
    mount_damping: float
    internal: PartSpec
    load: PartSpec
    parts: tuple[PartSpec, ...]
    gravity: float
    fundamental_hz: float
    multiples: tuple[int, ...]
    acceleration: tuple[tuple[complex, ...], ...]
    camera_rate_hz: float
    frames: int
    first_frame_s: float
    exposure_s: float
    stereo: tuple[StereoSetup, ...]
    daqs: tuple[DaqSpec, ...]
    points: tuple[StereoSetup, ...] = ()
    down: tuple[float, float, float] = (0.0, 0.0, -1.0)

    @property
    def frequencies_hz(self) -> FloatArray:
        """The lines (K,) that are present."""
        return self.fundamental_hz * np.array(self.multiples, dtype=np.float64)

    @property
    def gravity_mps2(self) -> FloatArray:
        """Acceleration of gravity (3,) in the sensor frame."""
        return self.gravity * np.array(self.down)

    def shrunk(self, frames: int | None, image_scale: float) -> Preset:
        """Return the preset with fewer frames and smaller images."""
        count = self.frames if frames is None else frames
        stereo = tuple(setup.scaled(image_scale) for setup in self.stereo)
        return replace(self, frames=count, stereo=stereo)


def _polar(*terms: tuple[float, float]) -> tuple[complex, ...]:
    """Return complex numbers from pairs of amplitude and phase."""
    return tuple(complex(amplitude * np.exp(1j * phase)) for amplitude, phase in terms)


def laser(name: str, point: tuple[float, float, float], scale: float) -> ChannelSpec:
    """Return one vibrometer channel on the load, along z."""
    stated = {
        "point_uncertainty": 5e-4,
        "direction_uncertainty": 3e-3,
        "scale_uncertainty": 5e-4,
        "individual_uncertainty": 5e-5,
        "delay_uncertainty": 2e-7,
    }
    return ChannelSpec(name, "velocity", scale, 4e-4, 20 / 2**16, "load", point, (0.0, 0.0, 1.0), stated, "laser")


def accelerometer(
    name: str, body: str, point: tuple[float, float, float], direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> ChannelSpec:
    """Return one accelerometer channel, along z if nothing else is said, 10 mV per m/s²."""
    stated = {
        "point_uncertainty": 1e-3,
        "direction_uncertainty": 5e-3,
        "scale_uncertainty": 3e-3,
        "transverse_sensitivity": 0.01,
        "delay_uncertainty": 1e-6,
    }
    return ChannelSpec(name, "acceleration", 100.0, 4e-4, 20 / 2**16, body, point, direction, stated)


def bridge(names: tuple[str, ...], noise: float) -> tuple[ChannelSpec, ...]:
    """Return the sensor's output channels in mV/V, from one amplifier."""
    stated = {"scale_uncertainty": 1e-4, "delay_uncertainty": 2e-7}
    return tuple(
        ChannelSpec(name, "output", 1e-3, noise, 5 / 2**22, stated=stated, common="amplifier", unit="mV/V")
        for name in names
    )


TRIGGER = ChannelSpec("camera_trigger", "trigger", 1.0, 0.01, 20 / 2**12)

NITSCHE2018 = Preset(
    name="nitsche2018",
    rig_name="10 kN shaker, load mass 7 kg",
    recording="Fz-0106.25",
    sensor_name="six-component transducer",
    serial="0815",
    sense="on_load",
    sensitivity=(5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6),
    capacity=(2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0),
    cross_talk=0.01,
    damping_s=(8e-6, 8e-6, 3e-6, 6e-6, 6e-6, 8e-6),
    lag_s=20e-6,
    mount_hz=(1738.0, 1740.0, 1093.0, 404.0, 405.0, 1399.0),
    mount_damping=0.012,
    internal=PartSpec("internal", 0.769, 0.001, (0.0, 0.0, 0.002), 2e-4, (7.0e-4, 7.0e-4, 1.2e-3), 1e-5),
    load=PartSpec("load", 6.9605, 0.0005, (0.0, 0.0, 0.0507), 5e-5, (0.010313, 0.010313, 0.010528), 2e-5),
    parts=(),
    gravity=9.8125,
    fundamental_hz=106.2497,
    multiples=(1, 2, 3, 4),
    acceleration=(
        _polar((0.83, 2.10), (0.52, -1.30), (189.3217, 0.369), (3.1, 0.60), (4.4, -2.40), (0.9, 1.80)),
        _polar((0.11, 0.40), (0.07, 2.20), (0.85, -1.10), (0.35, 2.90), (0.22, -0.70), (0.10, 0.20)),
        _polar((0.05, -2.00), (0.06, 1.00), (0.30, 2.40), (0.12, -0.30), (0.16, 1.50), (0.05, -1.90)),
        _polar((0.08, 1.30), (0.05, -0.60), (0.9596, -2.50), (0.20, 1.10), (0.14, 2.60), (0.07, -1.20)),
    ),
    camera_rate_hz=52.874,
    frames=211,
    first_frame_s=0.97,
    exposure_s=40e-6,
    stereo=(
        StereoSetup(
            name="top",
            body="load",
            size_px=(640, 512),
            pixel_m=0.166e-3,
            focal_px=2710.0,
            face_centre=(0.0, 0.0, 0.0973),
            face_normal=(0.0, 0.0, 1.0),
            face_up=(0.0, 1.0, 0.0),
            half_size=(0.055, 0.055),
            round=True,
            tilt_deg=-20.0,
            stereo_deg=28.0,
        ),
        StereoSetup(
            name="base",
            body="base",
            size_px=(640, 512),
            pixel_m=0.166e-3,
            focal_px=2710.0,
            face_centre=(0.0, -0.090, -0.075),
            face_normal=(0.0, -1.0, 0.0),
            face_up=(0.0, 0.0, 1.0),
            half_size=(0.065, 0.036),
            round=False,
            tilt_deg=15.0,
            stereo_deg=26.0,
        ),
    ),
    daqs=(
        DaqSpec(
            "vibrometer",
            "vibrometer.h5",
            51200.0,
            1e-6,
            0.0,
            5.5,
            (
                laser("velocity_1", (0.045, 0.0, 0.0973), 0.125),
                laser("velocity_2", (-0.0225, 0.0390, 0.0973), 0.125),
                laser("velocity_3", (-0.0225, -0.0390, 0.0973), 0.125),
                accelerometer("base_acceleration", "base", (0.120, 0.0, -0.045)),
                TRIGGER,
            ),
        ),
        DaqSpec("bridge", "bridge.tdms", 50000.0, 1e-6, 0.3137, 5.0, (*bridge(LOAD_COMPONENTS, 2e-5), TRIGGER), ""),
    ),
)

DEMO = Preset(
    name="demo",
    rig_name="2 kN shaker, load mass 2.4 kg",
    recording="Fz-0080",
    sensor_name="six-axis wrist sensor",
    serial="W6-031",
    sense="on_sensor",
    sensitivity=(1.6e-6, 1.6e-6, 7.0e-7, 3.1e-5, 3.1e-5, 2.7e-5),
    capacity=(500.0, 500.0, 1000.0, 25.0, 25.0, 25.0),
    cross_talk=0.012,
    damping_s=(1.1e-5, 1.1e-5, 5e-6, 9e-6, 9e-6, 1e-5),
    lag_s=12e-6,
    mount_hz=(1310.0, 1290.0, 960.0, 420.0, 435.0, 1120.0),
    mount_damping=0.015,
    internal=PartSpec("internal", 0.214, 0.0005, (0.0, 0.0, 0.001), 2e-4, (9.0e-5, 9.0e-5, 1.5e-4), 3e-6),
    load=PartSpec("load", 2.4063, 0.0002, (0.0, 0.0, 0.0385), 5e-5, (1.93e-3, 1.93e-3, 2.25e-3), 5e-6),
    parts=(PartSpec("adapter plate", 0.1835, 0.0001, (0.0, 0.0, 0.006), 1e-4, (9.4e-5, 9.4e-5, 1.83e-4), 1e-6),),
    gravity=9.8113,
    fundamental_hz=80.0003,
    multiples=(1, 2, 3),
    acceleration=(
        _polar((0.60, -0.90), (0.41, 2.30), (82.0, 0.740), (2.6, -1.50), (3.3, 0.90), (1.1, 2.50)),
        _polar((0.12, 1.20), (0.08, -2.80), (1.35, 1.90), (0.50, 0.30), (0.36, -1.10), (0.20, 2.00)),
        _polar((0.10, -0.50), (0.07, 0.80), (0.72, -2.20), (0.25, -2.60), (0.31, 1.40), (0.12, 0.10)),
    ),
    camera_rate_hz=38.345,
    frames=24,
    first_frame_s=0.15,
    exposure_s=60e-6,
    stereo=(
        StereoSetup(
            name="top",
            body="load",
            size_px=(304, 240),
            pixel_m=0.260e-3,
            focal_px=1600.0,
            face_centre=(0.0, 0.0, 0.0690),
            face_normal=(0.0, 0.0, 1.0),
            face_up=(0.0, 1.0, 0.0),
            half_size=(0.0410, 0.0410),
            round=True,
            tilt_deg=-22.0,
            stereo_deg=27.0,
            bit_depth=10,
            electrons_per_grey=16.0,
            read_noise_grey=1.5,
        ),
        StereoSetup(
            name="base",
            body="base",
            size_px=(304, 240),
            pixel_m=0.260e-3,
            focal_px=1600.0,
            face_centre=(0.0, -0.070, -0.052),
            face_normal=(0.0, -1.0, 0.0),
            face_up=(0.0, 0.0, 1.0),
            half_size=(0.043, 0.026),
            round=False,
            tilt_deg=16.0,
            stereo_deg=27.0,
            bit_depth=10,
            electrons_per_grey=16.0,
            read_noise_grey=1.5,
        ),
    ),
    daqs=(
        DaqSpec(
            "vibrometer",
            "vibrometer.h5",
            25600.0,
            1e-6,
            0.0,
            1.1,
            (
                laser("velocity_1", (0.033, 0.0, 0.069), 0.1),
                laser("velocity_2", (-0.0165, 0.0286, 0.069), 0.1),
                laser("velocity_3", (-0.0165, -0.0286, 0.069), 0.1),
                accelerometer("base_acceleration", "base", (0.090, 0.0, -0.030)),
                TRIGGER,
            ),
        ),
        DaqSpec(
            "bridge",
            "bridge.h5",
            20000.0,
            1e-6,
            0.0837,
            0.95,
            (*bridge(LOAD_COMPONENTS, 2e-5), TRIGGER),
            "bridge-response.csv",
        ),
    ),
)

PRESETS = {preset.name: preset for preset in (NITSCHE2018, DEMO)}
