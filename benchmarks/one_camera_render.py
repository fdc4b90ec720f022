"""Recordings of one camera with known truth, as files.

It shares no code with the estimator: the pattern is a sum of plane waves in closed form, and rays meet the moved plane.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
RATE_HZ, START_S, WAVES = 25_600.0, 0.2, 32
MASS_KG, U_MASS_KG, INTERNAL_KG, SENSITIVITY = 2.4, 2e-4, 0.2, 7e-7 * np.exp(-0.01j)
FACES = {  # centre, then the axes x, y and the normal as columns, in the sensor frame
    "top": (np.array([0.0, 0.0, 0.06]), np.eye(3)),
    "side": (np.array([0.0, -0.04, 0.03]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])),
}


@dataclass(frozen=True)
class Case:
    """A camera, its place, its light and the motion.

    `turn_deg`: of the view from the face's normal, about its y.
    """

    name: str
    face: str = "side"
    turn_deg: float = 0.0
    size_px: int = 300
    pixel_m: float = 6.9e-6
    focal_m: float = 25e-3
    distance_m: float = 0.6
    half_m: float = 0.02
    speckle_px: float = 5.0
    contrast: float = 0.15
    noise: float = 0.006
    bits: int = 12
    rate_hz: float = 52.37
    frames: int = 48
    exposure_s: float = 100e-6
    row_s: float = 0.0
    frequency_hz: float = 80.0
    acceleration: float = 10.0
    film: bool = False  # compressed
    free: bool = False  # without a trigger, by a clock that is wrong by some 10⁻⁵
    prnu: float = 0.003
    u_focal: float = 2e-4
    u_distance_m: float = 2e-4
    u_tilt: float = 1e-3
    u_pose: tuple[float, float] = (1e-4, 5e-4)

    @property
    def focal_px(self) -> float:
        """Distance of the image from the lens, px."""
        return self.distance_m * self.focal_m / (self.distance_m - self.focal_m) / self.pixel_m


@njit
def _texture(u, v, waves, phase, half, blur, contrast, grey):  # type: ignore[no-untyped-def]
    """Fill grey with the pattern, whose contrast ends at the rim."""
    size = contrast * np.sqrt(2.0 / len(phase))
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            inside = min(half - abs(u[i, j]), half - abs(v[i, j])) / blur
            grey[i, j] = 0.5
            if inside > -3.0:
                total = 0.0
                for n in range(len(phase)):
                    total += np.cos(waves[n, 0] * u[i, j] + waves[n, 1] * v[i, j] + phase[n])
                grey[i, j] += size * total / (1.0 + np.exp(-4.0 * inside))


def rotation(vector: FloatArray) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of vectors (..., 3) by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    second = 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + second)


class World:
    """The truth of one recording: every stated uncertainty is one draw away from the files."""

    def __init__(self, case: Case, seed: int) -> None:
        self.case, self.rng = case, np.random.default_rng(seed)
        draw = self.rng.standard_normal
        self.mass_kg = MASS_KG + U_MASS_KG * draw()
        centre, axes = FACES[case.face]
        turn = np.radians(case.turn_deg)
        eye = axes @ np.array([np.sin(turn), 0.0, np.cos(turn)])
        right = np.cross(axes[:, 1], eye)
        self.stated_pose = np.column_stack([right, np.cross(-eye, right), -eye]), centre + case.distance_m * eye
        off, spin = case.u_pose[0] * draw(3), rotation(case.u_pose[1] * draw(3))
        self.pose = spin @ self.stated_pose[0], spin @ self.stated_pose[1] + off
        tilt = rotation(axes @ (case.u_tilt * np.array([draw(), draw(), 0.0])))
        self.axes, self.centre = tilt @ axes, centre + case.u_distance_m * draw() * axes[:, 2]
        self.focal_px = case.focal_px * (1.0 + case.u_focal * draw())
        a = case.acceleration
        size = np.array([0.03 * a, 0.02 * a, a, 0.2 * a, 0.2 * a, 0.1 * a])
        self.acceleration = size * np.exp(2j * np.pi * self.rng.random(6))
        self.frequency_hz = case.frequency_hz * (1.0 + 1e-6 * draw())
        length_m = case.speckle_px * case.distance_m / case.focal_px / (2.0 * np.sqrt(np.log(2.0)))
        waves = draw((WAVES, 2))
        spread = np.linalg.cholesky(np.linalg.inv(waves.T @ waves / WAVES * length_m**2 / 2.0))
        self.gain = 1.0 + case.prnu * draw((case.size_px, case.size_px))
        self.waves, self.phase = np.ascontiguousarray(waves @ spread), 2.0 * np.pi * self.rng.random(WAVES)

    def poses(self, time_s: FloatArray) -> FloatArray:
        """Return the mean motion (..., 6) of the sensor origin over exposures."""
        omega = 2.0 * np.pi * self.frequency_hz
        phasor = -self.acceleration / omega**2 * np.sinc(self.frequency_hz * self.case.exposure_s)
        return np.asarray(np.real(phasor * np.exp(1j * omega * time_s[..., None])))

    def image(self, middle_s: float) -> NDArray[np.uint16]:
        """Return a frame; the exposure of its rows follows one after the other."""
        case, size = self.case, self.case.size_px
        motion = self.poses(np.asarray(middle_s + case.row_s * np.arange(size), dtype=np.float64))
        back = np.swapaxes(rotation(motion[:, 3:]), 1, 2)  # of each row
        turn, place = self.pose
        pixel = (np.arange(size) - (size - 1) / 2.0) / self.focal_px
        ray = np.stack([*np.meshgrid(pixel, pixel), np.ones((size, size))], axis=-1) @ turn.T
        ray = np.einsum("rij,rcj->rci", back, ray) @ self.axes
        start = (np.einsum("rij,rj->ri", back, place - motion[:, :3]) - self.centre) @ self.axes
        far = -start[:, None, 2] / ray[..., 2]
        u, v = (np.ascontiguousarray(start[:, None, i] + far * ray[..., i]) for i in (0, 1))
        grey = np.empty_like(u)
        blur = case.distance_m / case.focal_px
        _texture(u, v, self.waves, self.phase, case.half_m, 3.0 * blur, case.contrast, grey)
        full = 2**case.bits - 1
        noisy = full * (self.gain * grey + case.noise * self.rng.standard_normal(grey.shape))
        return np.asarray(np.clip(np.rint(noisy), 0, full), dtype=np.uint16)


def write_recording(folder: Path, case: Case, seed: int) -> World:
    """Write rig, recording, channels and images into a new folder, and return the truth."""
    world = World(case, seed)
    folder.mkdir()
    period_s = (1.0 + (3e-5 * world.rng.standard_normal() if case.free else 0.0)) / case.rate_hz
    first_s = START_S + world.rng.random() * (0.1 if case.free else 1.0 / RATE_HZ)
    edge_s = first_s + period_s * np.arange(case.frames)
    images = [world.image(time + case.exposure_s / 2.0) for time in edge_s]
    if case.film:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        film = cv2.VideoWriter(str(folder / "film.mp4"), code, round(case.rate_hz), (case.size_px,) * 2)
        for image in images:
            film.write(cv2.cvtColor(image.astype(np.uint8), cv2.COLOR_GRAY2BGR))
        film.release()
    else:
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / f"{i:04d}.tif"), image.astype(np.uint8) if case.bits == 8 else image)
    time_s = np.arange(int((edge_s[-1] + 0.2) * RATE_HZ)) / RATE_HZ
    output = SENSITIVITY * (world.mass_kg + INTERNAL_KG) * world.acceleration[2]
    signal = np.real(output * np.exp(2j * np.pi * world.frequency_hz * time_s))
    phase = (time_s - first_s) / period_s
    pulse = (phase >= 0) & (phase < case.frames) & (phase % 1.0 < 0.3)
    with h5py.File(folder / "recorder.h5", "w") as file:
        for name, values in (("Fz", signal + 1e-9 * world.rng.standard_normal(len(time_s))), ("camera", 5.0 * pulse)):
            file[name] = values
            file[name].attrs["sample_rate"] = RATE_HZ
    _write_manifests(folder, case, world)
    return world


def _write_manifests(folder: Path, case: Case, world: World) -> None:
    centre, axes = FACES[case.face]
    matrix = [[case.focal_px, 0, (case.size_px - 1) / 2], [0, case.focal_px, (case.size_px - 1) / 2], [0, 0, 1]]
    lens = {"matrix": matrix, "distortion": [0.0] * 5}
    common = (np.full((2, 2), (case.u_focal * case.focal_px) ** 2)).tolist()
    content: dict[str, Any] = {"format": 1, "image_size": [case.size_px] * 2, "left": lens, "right": lens}
    content |= {"rotation": np.eye(3).tolist(), "translation": [-0.1, 0.0, 0.0]}
    content["reprojection_rms"] = 0.05
    content["covariance"] = {"parameters": ["left.fx", "left.fy"], "matrix": common}
    (folder / "camera.json").write_text(json.dumps(content), encoding="utf-8")
    turn, place = world.stated_pose
    u_pose = [case.u_pose[0]] * 3 + [case.u_pose[1]] * 3
    rows = "" if case.row_s == 0.0 else f"row_time = {case.row_s}\n"
    depth = "" if case.film else f"bit_depth = {case.bits}\n"
    (folder / "rig.toml").write_text(
        f"""format = 1
name = "one camera"
[sensor]
name = "sensor"
channels = ["Fz"]
unit = "V/V"
sense = "on_load"
internal_mass = {INTERNAL_KG}
[load]
mass = {MASS_KG}
mass_uncertainty = {U_MASS_KG}
centre_of_mass = [0.0, 0.0, 0.03]
inertia = [[0.002, 0.0, 0.0], [0.0, 0.002, 0.0], [0.0, 0.0, 0.002]]
[stereo.side]
body = "load"
calibration = "camera.json"
rotation = {turn.tolist()}
translation = {place.tolist()}
pose_uncertainty = {u_pose}
exposure = {case.exposure_s}
{rows}{depth}[stereo.side.left]
prnu = {case.prnu}
[stereo.side.surface]
point = {centre.tolist()}
normal = {axes[:, 2].tolist()}
distance_uncertainty = {case.u_distance_m}
tilt_uncertainty = {case.u_tilt}
""",
        encoding="utf-8",
    )
    dated = 'trigger = "camera"' if not case.free else f"frame_rate = {case.rate_hz}"
    (folder / "recording.toml").write_text(
        f"""format = 1
name = "{case.name}"
rig = "rig.toml"
[excitation]
kind = "sine"
direction = [0.0, 0.0, 1.0]
frequencies = [{case.frequency_hz}]
harmonics = []
[[daq]]
name = "recorder"
file = "recorder.h5"
[[daq.channel]]
name = "Fz"
quantity = "output"
channel = "Fz"
"""
        + ('[[daq.channel]]\nname = "camera"\nquantity = "trigger"\n' if not case.free else "")
        + f"""[[images]]
stereo = "side"
left = "{"film.mp4" if case.film else "*.tif"}"
{dated}
""",
        encoding="utf-8",
    )
