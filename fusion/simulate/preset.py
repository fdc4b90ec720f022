"""Presets of simulated rigs: checked data of `presets/NAME.toml`, and their optics.

A table with `like = "FILE"` or `like = "FILE.TABLE"` inherits missing keys from there.
"""

from __future__ import annotations

import tomllib
from dataclasses import field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BeforeValidator, ConfigDict
from pydantic.dataclasses import dataclass

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import Face, ImageSensor, session_covariance, speckle_texture
from shakercal._common.arrays import FloatArray

CHECKED = ConfigDict(extra="forbid")
"""Configuration of dataclasses of presets: unknown keys are refused."""
Vector = tuple[float, float, float]
Phasor = Annotated[complex, BeforeValidator(lambda v: complex(v[0] * np.exp(1j * v[1])) if isinstance(v, list) else v)]
"""A complex number, in a preset as [amplitude, phase]."""
_FOLDER = Path(__file__).parent / "presets"
_T = TypeVar("_T")

_LEFT_LENS = (-0.09, 0.12, 2e-4, -1.5e-4, 0.0)
_RIGHT_LENS = (-0.085, 0.10, -1e-4, 2e-4, 0.0)
_SPECKLE_PX = 5.0
_DOT_SOFTNESS_PX = 1.0
_ALIASED_SPECKLE_PX = 2.8  # a width of 2 px
_BLUR_PX = 0.6
_CORNER_NOISE_PX = 0.02
_SESSION_VIEWS = 20


def read_preset(kind: type[_T], name: str, **changes: Any) -> _T:
    """Return `presets/NAME.toml`, or its table `NAME.TABLE`, as a dataclass, with changes.

    Raises `ValueError` with the wrong key.
    """
    return kind(**(_read(name) | changes))


@cache
def _read(source: str) -> dict[str, Any]:
    """Return a file of presets, or a table of it (`FILE.TABLE`), with inherited keys."""
    name, *keys = source.split(".")
    table = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    for key in keys:
        table = table[key] if isinstance(table, dict) else next(item for item in table if item["name"] == key)
    completed: dict[str, Any] = _completed(table)
    return completed


def _completed(value: Any) -> Any:
    """Return tables and lists of them with inherited keys."""
    if isinstance(value, list):
        return [_completed(item) for item in value]
    if not isinstance(value, dict):
        return value
    values = {key: _completed(item) for key, item in value.items() if key != "like"}
    if "like" not in value:
        return values
    whole = _read(value["like"])
    both = {key: whole[key] | values[key] for key in values if isinstance(values[key], dict) and key in whole}
    return whole | values | both


@dataclass(frozen=True, config=CHECKED)
class StereoSetup:
    """A stereo pair before one face; `tilt_deg`: from the normal towards `face_up`.

    `stereo_deg`: between the cameras. `pixel_m`: size of a pixel on the face. `face_up`: direction in the face that is
    up in the images. `row_time`: s from row to row of a rolling shutter, negative if the last row is read first, 0 for
    a global shutter. `at_rest`: two patches at rest in the plane of the face, right and left of it: distance of their
    centres from that of the face, half width and height, m; empty for none. `surface_uncertainty`: of the distance of
    the face, m, and its tilts, rad, before a single left camera; empty for a pair.
    """

    name: str
    body: str
    size_px: tuple[int, int]
    pixel_m: float
    focal_px: float
    face_centre: Vector
    face_normal: Vector
    face_up: Vector
    half_size: tuple[float, float]
    round: bool
    tilt_deg: float
    stereo_deg: float
    bit_depth: int = 12
    electrons_per_grey: float = 8.0
    read_noise_grey: float = 6.0
    delay_uncertainty: float = 3e-7
    row_time: float = 0.0
    row_time_uncertainty: float = 0.0
    scale_uncertainty: float = 2e-4
    pose_uncertainty: tuple[float, ...] = (1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4)
    at_rest: tuple[float, ...] = ()
    surface_uncertainty: tuple[float, ...] = ()

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of its cameras."""
        return ("left",) if self.surface_uncertainty else ("left", "right")

    @property
    def sensor(self) -> ImageSensor:
        """The image sensor of both cameras."""
        return ImageSensor(self.bit_depth, self.electrons_per_grey, self.read_noise_grey)


@dataclass(frozen=True, config=CHECKED)
class PartSpec:
    """A rigid part of the load as stated: SI values and standard uncertainties."""

    name: str
    mass: float
    mass_uncertainty: float
    centre_of_mass: Vector
    centre_of_mass_uncertainty: float
    inertia: Vector
    inertia_uncertainty: float


@dataclass(frozen=True, config=CHECKED)
class PlateSpec:
    """A flexible plate on top of the load (`fusion.simulate.world`), as stated.

    Its mass is part of the load's. Natural frequency with its standard uncertainty (relative), damping ratio.
    `measured_by`: stereo pairs that measure it.
    """

    mass: float
    radius: float
    frequency: float
    frequency_uncertainty: float
    damping: float
    measured_by: tuple[str, ...] = ()


@dataclass(frozen=True, config=CHECKED)
class HeadSpec:
    """A stated laser head: u of its rotation (rad) and position (m)."""

    name: str
    rotation_uncertainty: float
    point_uncertainty: float


@dataclass(frozen=True, config=CHECKED)
class ChannelSpec:
    """A DAQ channel: `scale` and `stated` of the manifest, `noise` (rms) and `range` (on `bits`).

    Noise and range are in file units. `head`: name of its laser head, if any.
    """

    name: str
    quantity: str
    scale: float
    noise: float
    range: float
    bits: int
    body: str = ""
    point: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (0.0, 0.0, 1.0)
    stated: dict[str, float] = field(default_factory=dict)
    common: str = ""
    unit: str = "V"
    head: str = ""


@dataclass(frozen=True, config=CHECKED)
class DaqSpec:
    """One recorder: file, rate, clock uncertainty, start before the time origin, channels.

    `response`: file of the stated response of its channels, if any.
    """

    name: str
    file: str
    sample_rate_hz: float
    clock_uncertainty: float
    start_s: float
    duration_s: float
    channels: tuple[ChannelSpec, ...]
    response: str = ""


@dataclass(frozen=True, config=CHECKED)
class Preset:
    """A whole set-up with true accelerations of the load, phasors (K, 6).

    They belong to the lines `fundamental_hz`·`multiples`. `as_points`: point tables are written instead of images.
    `down`: direction of gravity.
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
    gravity: float
    fundamental_hz: float
    multiples: tuple[int, ...]
    acceleration: tuple[tuple[Phasor, ...], ...]
    camera_rate_hz: float
    frames: int
    first_frame_s: float
    exposure_s: float
    stereo: tuple[StereoSetup, ...]
    daqs: tuple[DaqSpec, ...]
    parts: tuple[PartSpec, ...] = ()
    heads: tuple[HeadSpec, ...] = ()
    plate: PlateSpec | None = None
    as_points: bool = False
    down: Vector = (0.0, 0.0, -1.0)

    @property
    def frequencies_hz(self) -> FloatArray:
        """Lines (K,) of the motion."""
        return self.fundamental_hz * np.array(self.multiples, dtype=np.float64)

    @property
    def gravity_mps2(self) -> FloatArray:
        """Acceleration of gravity (3,) in the sensor frame."""
        return self.gravity * np.array(self.down)

    def reduced(self, frames: int | None, image_scale: float) -> Preset:
        """Return the preset with fewer frames, and smaller images of the same pixel size."""
        stereo = []
        for setup in self.stereo:
            width, height = (max(64, round(n * image_scale)) for n in setup.size_px)
            half = (setup.half_size[0] * image_scale, setup.half_size[1] * image_scale)
            rest = tuple(length * image_scale for length in setup.at_rest)
            stereo.append(replace(setup, size_px=(width, height), half_size=half, at_rest=rest))
        return replace(self, frames=self.frames if frames is None else frames, stereo=tuple(stereo))


@lru_cache(maxsize=8)
def nominal_rig(setup: StereoSetup) -> tuple[StereoRig, RigidTransform]:
    """Return the stated stereo rig with its covariance, and sensor_from_left.

    The covariance takes half a second and is cached.
    """
    left, right = (camera_pose(setup, sign) for sign in (-1.0, 1.0))
    size = np.array(setup.size_px, dtype=np.int64)
    cameras, (x, y) = [], (size - 1) / 2 + [2.3, -1.7]
    for focal, lens in ((setup.focal_px, _LEFT_LENS), (setup.focal_px * 1.003, _RIGHT_LENS)):
        matrix = np.array([[focal, 0, x], [0, focal * 1.0004, y], [0, 0, 1]])
        cameras.append(Camera(matrix, np.array(lens), size))
    rig = StereoRig(cameras[0], cameras[1], right.inverse() @ left)
    middle, width = np.array([0, 0, setup.focal_px * setup.pixel_m]), setup.pixel_m * float(size[0])
    session = _CORNER_NOISE_PX, _SESSION_VIEWS, np.random.default_rng(20)
    return replace(rig, covariance=session_covariance(rig, middle, width, *session)), left


def camera_pose(setup: StereoSetup, sign: float = -1.0) -> RigidTransform:
    """Return the stated sensor_from_left (`sign` −1) or sensor_from_right (+1).

    Both cameras point at the centre of the face, at half the stereo angle to either side of the middle direction.
    """
    normal, up, centre = (np.array(v) for v in (setup.face_normal, setup.face_up, setup.face_centre))
    tilt = np.deg2rad(setup.tilt_deg)
    towards = np.cos(tilt) * normal + np.sin(tilt) * up
    screen_up = np.cos(tilt) * up - np.sin(tilt) * normal
    towards = rotation_from_vector(np.deg2rad(sign * setup.stereo_deg / 2) * screen_up) @ towards
    right = np.cross(-towards, screen_up)
    rotation = np.column_stack([right, -screen_up, -towards])
    return RigidTransform(rotation, centre + setup.focal_px * setup.pixel_m * towards)


def patches_of(setup: StereoSetup) -> tuple[StereoSetup, ...]:
    """Return the patches at rest next to a face as faces at rest."""
    offset, *half = setup.at_rest or (0.0,)
    side = np.cross(np.array(setup.face_up), np.array(setup.face_normal))
    patches = []
    for sign in (1.0, -1.0) if half else ():
        x, y, z = (np.array(setup.face_centre) + sign * offset * side).tolist()
        patch = replace(setup, name=f"{setup.name}-room", body="room", face_centre=(x, y, z), at_rest=())
        patches.append(replace(patch, half_size=(half[0], half[1]), round=False))
    return tuple(patches)


def region_of(setup: StereoSetup, *faces: StereoSetup) -> list[int]:
    """Return the stated region x, y, width, height, px, of faces in the left image."""
    rig, placed = nominal_rig(setup)
    rim, angle = [], np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    for face in faces:
        normal, up = np.array(face.face_normal), np.array(face.face_up)
        along = face.half_size[0 if face.round else 1]
        ends = np.stack([np.cos(angle), np.sin(angle)]) if face.round else np.array([[-1, -1, 1, 1], [-1, 1, -1, 1]])
        rim.append(
            np.array(face.face_centre) + ends.T @ np.stack([face.half_size[0] * np.cross(up, normal), along * up])
        )
    px = rig.left.project(placed.inverse().apply(np.concatenate(rim)))
    low = np.maximum(np.floor(px.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(px.max(axis=0)) + 1, np.array(setup.size_px)).astype(int)
    return [*low.tolist(), *(high - low).tolist()]


def face_of(setup: StereoSetup, aliased: bool, rng: np.random.Generator) -> Face:
    """Return the speckled face, with blurred or sharp (`aliased`) dots.

    The rims of sprayed dots are soft (σ 1 px), without components beyond the Nyquist frequency of the pixels. Sharp
    discs of the same size alias by 1 % of their amplitude and move subsets by 0.001 to 0.002 px.
    """
    normal, up = np.array(setup.face_normal), np.array(setup.face_up)
    pixel = setup.pixel_m
    speckle = _ALIASED_SPECKLE_PX if aliased else _SPECKLE_PX
    blur = 0.0 if aliased else float(np.hypot(_BLUR_PX, _DOT_SOFTNESS_PX)) * pixel
    extent = (2 * setup.half_size[0] + 8 * pixel, 2 * setup.half_size[1] + 8 * pixel)
    texture = speckle_texture(extent, speckle * pixel, pixel / (5 if aliased else 4), blur, rng)
    half = np.array(setup.half_size)
    return Face(np.array(setup.face_centre), np.cross(up, normal), up, half, setup.round, texture, _BLUR_PX * pixel)
