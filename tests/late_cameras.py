"""Recordings of stereo pairs whose files do not show the trigger edges that they should, rendered by separate formulas.

A round plate with a random pattern moves in six components before two cameras. Each pixel's ray is intersected with the
plate where it is then. Nothing of `photogram` or `fusion` is used.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import h5py
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL_PX, DISTANCE_M, ANGLE = 168, 144, 1000.0, 0.45, 0.42
RADIUS_M, TEXEL_M, FACE_Z_M = 0.026, 0.05e-3, 0.03
EXPOSURE_S, SAMPLES_HZ, FORCE_V_PER_MPS2 = 60e-6, 100e3, 4e-6
SIDES = ("left", "right")
Images = list[np.ndarray]


@dataclass(frozen=True)
class Rendering:
    """A recording: `edges` of each pair and camera are the edge numbers that their files show, one per file.

    `acceleration` (K, 6): complex amplitudes in m/s², rad/s² at `frequencies_hz`. `first_edge` of the manifest is that
    of the first file of an unfaulted camera. `rows_late`: of odd rows, over the frame interval. `change`: applied to
    the images of one pair and camera.
    """

    edges: Mapping[tuple[str, str], Sequence[int]]
    frequencies_hz: tuple[float, ...] = (80.0003,)
    rate_hz: float = 38.345
    acceleration: np.ndarray = field(
        default_factory=lambda: np.array([[0.6j, 0.4, 82.0 * np.exp(0.74j), 3 - 2j, 2 + 3j, 1j]])
    )
    first_edge: int = 6
    seed: int = 1
    lasers: bool = True
    rows_late: float = 0.0
    noise_grey: float = 3.0
    change: Callable[[str, str, Images], Images] | None = None

    @property
    def count(self) -> int:
        return 8 + self.first_edge + max(len(edges) for edges in self.edges.values())


def rendering(frames: int = 24, pairs: Sequence[str] = ("top",), **options: object) -> Rendering:
    """A recording without a fault."""
    first = Rendering.first_edge
    edges = {(pair, side): list(range(first, first + frames)) for pair in pairs for side in SIDES}
    return replace(Rendering(edges), **options)


def with_edges(one: Rendering, pair: str, changed: Mapping[str, Callable[[list[int]], list[int]]]) -> Rendering:
    """The recording with other edges shown by some cameras of a pair."""
    edges = dict(one.edges)
    for side, change in changed.items():
        edges[pair, side] = change(list(edges[pair, side]))
    return replace(one, edges=edges)


def shifted(frames: int) -> Callable[[list[int]], list[int]]:
    """Files that are late by so many frames: each shows the body of an earlier edge."""
    return lambda edges: [edge - frames for edge in edges]


def dropped(at: int, frames: int = 1) -> Callable[[list[int]], list[int]]:
    """Frames lost before file `at`; the later ones are renumbered."""
    return lambda edges: [edge + frames * (k >= at) for k, edge in enumerate(edges)]


def repeated(at: int) -> Callable[[list[int]], list[int]]:
    """File `at` is a copy of the one before; the later ones follow it."""
    return lambda edges: [edge - (k >= at) for k, edge in enumerate(edges)]


def write(folder: Path, one: Rendering) -> Path:
    """Write rig, calibration, channels, images and manifest; return the folder of the recording."""
    run = folder / "run"
    run.mkdir(parents=True)
    pairs = list(dict.fromkeys(pair for pair, _ in one.edges))
    (folder / "pair.json").write_text(json.dumps(_calibration()))
    (folder / "rig.toml").write_text(_RIG + "".join(_pair_text(pair) for pair in pairs))
    _channels(run / "daq.h5", one)
    for pair in pairs:
        texture = _texture(one.seed + 100 * pairs.index(pair))
        for side in SIDES:
            images = _images(one, pair, side, texture)
            images = images if one.change is None else one.change(pair, side, images)
            (run / f"{pair}-{side}").mkdir()
            for number, image in enumerate(images):
                cv2.imwrite(str(run / f"{pair}-{side}" / f"{number:04d}.png"), image)
    blocks = "".join(_IMAGES.format(pair=pair, first_edge=one.first_edge) for pair in pairs)
    frequencies = [round(f, 1) for f in one.frequencies_hz]
    lasers = _LASERS if one.lasers else ""
    (run / "recording.toml").write_text(_RECORDING.format(frequencies=frequencies, lasers=lasers) + blocks)
    return run


# The world.


@cache
def _texture(seed: int) -> np.ndarray:
    side = int(2.2 * RADIUS_M / TEXEL_M)
    pattern = gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 0.62e-3 / TEXEL_M)
    return spline_filter(np.clip(430.0 + 190.0 * pattern / pattern.std(), 20.0, 980.0), 3)


def _cameras() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rotation (sensor from camera) and centre of both cameras, which look at the plate from either side."""
    cameras = {}
    target = np.array([0.0, 0.0, FACE_Z_M])
    for side, angle in (("left", -ANGLE / 2), ("right", ANGLE / 2)):
        turn = Rotation.from_euler("yx", [angle, 0.25]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        cameras[side] = turn, target - DISTANCE_M * turn[:, 2]
    return cameras


def _calibration() -> dict[str, object]:
    (left, left_m), (right, right_m) = (_cameras()[side] for side in SIDES)
    matrix = [[FOCAL_PX, 0, WIDTH / 2 - 0.5], [0, FOCAL_PX, HEIGHT / 2 - 0.5], [0, 0, 1]]
    camera = {"matrix": matrix, "distortion": [0, 0, 0, 0, 0]}
    rotation, translation = right.T @ left, right.T @ (left_m - right_m)
    found = {"format": 1, "image_size": [WIDTH, HEIGHT], "left": camera, "right": camera}
    return found | {
        "rotation": rotation.tolist(),
        "translation": translation.tolist(),
        "reprojection_rms": 0.02,
        "covariance": None,
    }


def _motion(one: Rendering, pair: str, time_s: np.ndarray) -> np.ndarray:
    """Displacement (N, 6) of the body of a pair; that of the base is half as large and later."""
    size = 1.0 if pair == "top" else 0.5 * np.exp(-0.2j)
    pose = np.zeros((len(time_s), 6))
    for frequency, acceleration in zip(one.frequencies_hz, size * one.acceleration, strict=True):
        omega = 2.0 * np.pi * frequency
        pose += np.real(np.exp(1j * omega * time_s)[:, None] * acceleration / -(omega**2))
    return pose


def edge_times(one: Rendering) -> np.ndarray:
    """Times of the trigger's edges."""
    return 0.02 + np.arange(one.count) / one.rate_hz


def _images(one: Rendering, pair: str, side: str, texture: np.ndarray) -> Images:
    """The images of a camera; equal edges in a row are copies, grey value by grey value."""
    turn, centre = _cameras()[side]
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH / 2 + 0.5, np.arange(HEIGHT) - HEIGHT / 2 + 0.5)
    ray = np.stack([x / FOCAL_PX, y / FOCAL_PX, np.ones_like(x)], axis=-1) @ turn.T
    rng = np.random.default_rng([one.seed, len(pair), SIDES.index(side)])
    images, shown = list[np.ndarray](), dict[int, np.ndarray]()
    for edge in one.edges[pair, side]:
        if edge not in shown:
            fields = [
                _rendered(one, pair, edge, late, ray, centre, texture)
                for late in (0.0, one.rows_late)[: 1 + bool(one.rows_late)]
            ]
            grey = fields[0]
            if one.rows_late:
                grey = grey.copy()
                grey[1::2] = fields[1][1::2]
            grey = grey + rng.normal(size=grey.shape) * np.sqrt(one.noise_grey**2 + grey / 8.0)
            shown[edge] = np.clip(np.rint(grey), 0, 1023).astype(np.uint16)
        images.append(shown[edge])
    return images


def _rendered(
    one: Rendering, pair: str, edge: int, late: float, ray: np.ndarray, centre: np.ndarray, texture: np.ndarray
) -> np.ndarray:
    """Grey values without noise, `late` by a share of the frame interval."""
    time_s = edge_times(one)[0] + (edge + late) / one.rate_hz + EXPOSURE_S / 2
    (pose,) = _motion(one, pair, np.array([time_s]))
    turn = Rotation.from_rotvec(pose[3:]).as_matrix()
    begin, along = (centre - pose[:3]) @ turn, ray @ turn
    reach = (FACE_Z_M - begin[2]) / along[..., 2]
    places = begin[:2] + reach[..., None] * along[..., :2]
    grey = map_coordinates(
        texture, np.moveaxis(places, -1, 0)[::-1] / TEXEL_M + len(texture) / 2, order=3, prefilter=False, mode="nearest"
    )
    edge_share = np.clip((RADIUS_M - np.hypot(*np.moveaxis(places, -1, 0))) / 0.45e-3 + 0.5, 0.0, 1.0)
    return edge_share * grey + (1.0 - edge_share) * 60.0


def _channels(path: Path, one: Rendering) -> None:
    edges = edge_times(one)
    time_s = np.arange(int((edges[-1] + 0.03) * SAMPLES_HZ)) / SAMPLES_HZ
    rng = np.random.default_rng(one.seed)
    with h5py.File(path, "w") as file:

        def put(name: str, values: np.ndarray) -> None:
            file.create_dataset(name, data=values.astype(np.float32)).attrs["sample_rate"] = SAMPLES_HZ

        phase = (time_s - edges[0]) * one.rate_hz
        put("camera_trigger", np.where((phase % 1.0 < 0.2) & (phase > -0.1) & (phase < len(edges) - 0.5), 5.0, 0.0))
        force = np.zeros_like(time_s)
        velocity = np.zeros((3, len(time_s)))
        for frequency, value in zip(one.frequencies_hz, one.acceleration, strict=True):
            omega = 2.0 * np.pi * frequency
            wave = np.exp(1j * omega * time_s)
            force += np.real(FORCE_V_PER_MPS2 * value[2] * wave)
            for k, point in enumerate(_POINTS):
                along = value[2] + value[3] * point[1] - value[4] * point[0]
                velocity[k] += np.real(along / (1j * omega) * wave)
        put("Fz", force + 1e-9 * rng.standard_normal(len(time_s)))
        for k in range(3):
            put(f"velocity_{k + 1}", velocity[k] + 1e-4 * rng.standard_normal(len(time_s)))


_POINTS = ((0.02, 0.0, 0.03), (-0.01, 0.017, 0.03), (-0.01, -0.017, 0.03))
_RIG = """format = 1
name = "rendered"
[sensor]
name = "sensor"
channels = ["Fz"]
unit = "V/V"
sense = "on_sensor"
internal_mass = 0.2
internal_mass_uncertainty = 1e-4
[load]
mass = 2.0
mass_uncertainty = 2e-4
centre_of_mass = [0.0, 0.0, 0.02]
centre_of_mass_uncertainty = 1e-4
inertia = [[0.002, 0.0, 0.0], [0.0, 0.002, 0.0], [0.0, 0.0, 0.002]]
inertia_uncertainty = 1e-5
"""
_RECORDING = """format = 1
name = "rendered"
rig = "../rig.toml"
[excitation]
kind = "sine"
direction = [0.0, 0.0, 1.0]
frequencies = {frequencies}
harmonics = []
[[daq]]
name = "daq"
file = "daq.h5"
clock_uncertainty = 1e-6
[[daq.channel]]
name = "camera_trigger"
quantity = "trigger"
[[daq.channel]]
name = "Fz"
quantity = "output"
channel = "Fz"
scale_uncertainty = 1e-4
{lasers}"""
_LASERS = "".join(
    f"""[[daq.channel]]
name = "velocity_{k}"
quantity = "velocity"
body = "load"
point = {list(point)}
direction = [0.0, 0.0, 1.0]
common = "laser"
point_uncertainty = 5e-4
direction_uncertainty = 3e-3
scale_uncertainty = 5e-4
individual_uncertainty = 5e-5
"""
    for k, point in enumerate(_POINTS, 1)
)
_IMAGES = """
[[images]]
stereo = "{pair}"
left = "{pair}-left/*.png"
right = "{pair}-right/*.png"
trigger = "camera_trigger"
first_edge = {first_edge}
"""


def _pair_text(pair: str) -> str:
    turn, centre = _cameras()["left"]
    body = "load" if pair == "top" else "base"
    return f"""
[stereo.{pair}]
body = "{body}"
calibration = "pair.json"
rotation = {turn.tolist()}
translation = {centre.tolist()}
pose_uncertainty = [1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]
scale_uncertainty = 2e-4
bit_depth = 10
exposure = {EXPOSURE_S}
delay = 0.0
delay_uncertainty = 3e-7
"""
