"""Presets of simulated rigs: data of `presets/NAME.toml`, checked when read, and the optics that follow from them.

A table with `like = "FILE"` or `like = "FILE.TABLE"` takes from there what it does not say itself.
"""

from __future__ import annotations

import tomllib
from dataclasses import field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BeforeValidator, ConfigDict
from pydantic.dataclasses import dataclass

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import Face, ImageSensor, session_covariance, speckle_texture
from shaker.arrays import FloatArray

CHECKED = ConfigDict(extra="forbid")
"""Of every dataclass that is read from a preset: keys that it does not have are refused."""
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
    """Return `presets/NAME.toml`, or a table of it (`NAME.TABLE`), as a dataclass of this kind with some changes.

    Raises `ValueError` naming the key that is wrong.
    """
    return kind(**(_read(name) | changes))


def _read(place: str) -> dict[str, Any]:
    """Return a file of presets, or a table of it (`FILE.TABLE`, of several by name), completed by what it is like."""
    name, *keys = place.split(".")
    table = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    for key in keys:
        table = table[key] if isinstance(table, dict) else next(item for item in table if item["name"] == key)
    completed: dict[str, Any] = _completed(table)
    return completed


def _completed(value: Any) -> Any:
    """Return tables and lists of them with what they are like put in."""
    if isinstance(value, list):
        return [_completed(item) for item in value]
    if not isinstance(value, dict):
        return value
    own = {key: _completed(item) for key, item in value.items() if key != "like"}
    if "like" not in value:
        return own
    whole = _read(value["like"])
    both = {key: whole[key] | own[key] for key in own if isinstance(own[key], dict) and key in whole}
    return whole | own | both


@dataclass(frozen=True, config=CHECKED)
class StereoSetup:
    """A stereo pair on one face: `tilt_deg` from its normal towards `face_up`, `stereo_deg` between the cameras.

    `pixel_m` is the size of a pixel on the face; `face_up` the direction in the face that is up in the images.
    `row_time`: s from row to row of a rolling shutter, negative where the last row is read first, 0 without one.
    `at_rest`: of two patches that stand still in the face's plane, to its right and left: distance of their centres
    from the face's, half width and height, m; none where empty. `surface_uncertainty`: of the face's distance, m, and
    tilts, rad, where its left camera is alone; a pair where empty.
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
        """Its cameras by name."""
        return ("left",) if self.surface_uncertainty else ("left", "right")

    @property
    def sensor(self) -> ImageSensor:
        """The image sensor of both cameras."""
        return ImageSensor(self.bit_depth, self.electrons_per_grey, self.read_noise_grey)


@dataclass(frozen=True, config=CHECKED)
class PartSpec:
    """A rigid part of the load as the laboratory states it: SI values and standard uncertainties."""

    name: str
    mass: float
    mass_uncertainty: float
    centre_of_mass: Vector
    centre_of_mass_uncertainty: float
    inertia: Vector
    inertia_uncertainty: float


@dataclass(frozen=True, config=CHECKED)
class PlateSpec:
    """A plate on top of the load that bends (`fusion.simulate.bending`), as the laboratory states it.

    Its mass is part of the load's; natural frequency with its standard uncertainty (relative), damping ratio;
    `measured_by`: stereo pairs that are to measure it.
    """

    mass: float
    radius: float
    frequency: float
    frequency_uncertainty: float
    damping: float
    measured_by: tuple[str, ...] = ()


@dataclass(frozen=True, config=CHECKED)
class HeadSpec:
    """A laser head as stated: standard uncertainties of its turn about each axis (rad) and of its place (m)."""

    name: str
    rotation_uncertainty: float
    point_uncertainty: float


@dataclass(frozen=True, config=CHECKED)
class ChannelSpec:
    """A DAQ channel: `scale` and `stated` are the manifest's; `noise` (rms) and `range` (on `bits`) in file units.

    `head`: name of the laser head that it is a beam of, if any.
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
    """One recorder: file, rate, true deviation of its clock, start before the time base's zero, its channels.

    `response`: file of the stated response of its channels, if there is one.
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
    """A whole set-up. Phasors (K, 6) are true accelerations of the load at the lines `fundamental_hz`·`multiples`.

    `as_points`: another program's points are written instead of images of the stereo pairs. `down`: of gravity.
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
        """The lines (K,) that are present."""
        return self.fundamental_hz * np.array(self.multiples, dtype=np.float64)

    @property
    def gravity_mps2(self) -> FloatArray:
        """Acceleration of gravity (3,) in the sensor frame."""
        return self.gravity * np.array(self.down)

    def reduced(self, frames: int | None, image_scale: float) -> Preset:
        """Return the preset with fewer frames, and images `image_scale` as large over the same pixel on the face."""
        stereo = []
        for setup in self.stereo:
            width, height = (max(64, round(n * image_scale)) for n in setup.size_px)
            half = (setup.half_size[0] * image_scale, setup.half_size[1] * image_scale)
            rest = tuple(length * image_scale for length in setup.at_rest)
            stereo.append(replace(setup, size_px=(width, height), half_size=half, at_rest=rest))
        return replace(self, frames=self.frames if frames is None else frames, stereo=tuple(stereo))


@lru_cache(maxsize=8)
def nominal_rig(setup: StereoSetup) -> tuple[StereoRig, RigidTransform]:
    """Return the stereo rig with its session's covariance, and sensor_from_left, as the laboratory states them.

    Its covariance takes half a second: a set-up simulated again has it ready.
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
    """Return sensor_from_left (`sign` −1) or sensor_from_right (+1) as stated: both cameras look at the face's centre.

    They stand half the stereo angle to either side of the middle direction.
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
    """Return the patches at rest beside a face as faces of the room."""
    aside, *half = setup.at_rest or (0.0,)
    side = np.cross(np.array(setup.face_up), np.array(setup.face_normal))
    patches = []
    for sign in (1.0, -1.0) if half else ():
        x, y, z = (np.array(setup.face_centre) + sign * aside * side).tolist()
        patch = replace(setup, name=f"{setup.name}-room", body="room", face_centre=(x, y, z), at_rest=())
        patches.append(replace(patch, half_size=(half[0], half[1]), round=False))
    return tuple(patches)


def region_of(setup: StereoSetup, *faces: StereoSetup) -> list[int]:
    """Return x, y, width, height in px that hold faces in the left picture of a pair, as it is stated."""
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
