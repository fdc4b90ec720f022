"""Simulated acceptance test of a stereo rig (`shakercal accept`), right or with one fault.

The images are rendered with the true cameras, which differ from the calibration within its stated covariance, and by
the fault. No evaluating module is imported.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from fusion.base import ProgressCallback, no_progress
from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_files
from fusion.simulate.preset import CHECKED, StereoSetup, camera_pose, face_of, nominal_rig, read_preset
from fusion.simulate.write import TRUTH_FILE
from photogram.calibration.calibration_file import write_calibration
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import Face, View, render, view_of
from shakercal._common.arrays import FloatArray

ACCEPTANCE_FILE, CALIBRATION_FILE = "acceptance.toml", "calibration.json"
VIBRATION_HZ = 12.0
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "z": (0.0, 0.0, 1.0)}
TURN_AXIS = (0.0, 0.0, 1.0)
STAGE_KEYS = ("position_uncertainty", "scale_uncertainty", "rotation_uncertainty", "straightness_uncertainty")
SIDES = ("left", "right")


@dataclass(frozen=True, config=CHECKED)
class AcceptancePreset:
    """Cameras, stage and sine bar: m, rad, Hz; uncertainties are standard uncertainties."""

    stereo: StereoSetup
    frame_rate_hz: float
    stationary_frames: int
    positions: tuple[float, ...]
    position_uncertainty: float
    scale_uncertainty: float
    rotation_uncertainty: float
    straightness_uncertainty: float
    angle: float
    repeats: int
    angle_uncertainty: float
    axis_uncertainty: float


class RigFault(NamedTuple):
    """A fault with its default size and unit; `change`: of the true rig."""

    unit: str
    size: float
    change: Callable[[StereoRig, float, np.random.Generator], StereoRig] | None = None


def _unit_vector(rng: np.random.Generator, count: int) -> FloatArray:
    vector = rng.standard_normal(count)
    return np.asarray(vector / np.linalg.norm(vector))


def _turn(rig: StereoRig, size: float, rng: np.random.Generator) -> StereoRig:
    """Turn the right camera about its centre, about an axis in any direction."""
    turn = RigidTransform(rotation_from_vector(size * _unit_vector(rng, 3)), np.zeros(3))
    return replace(rig, right_from_left=turn @ rig.right_from_left)


def _change_camera(rig: StereoRig, rng: np.random.Generator, change: Callable[[FloatArray], None]) -> StereoRig:
    """Change the matrix of one of both cameras."""
    side = SIDES[int(rng.integers(2))]
    camera: Camera = getattr(rig, side)
    matrix = camera.matrix.copy()
    change(matrix)
    changed: dict[str, Any] = {side: replace(camera, matrix=matrix)}
    return replace(rig, **changed)


def _focus(rig: StereoRig, size: float, rng: np.random.Generator) -> StereoRig:
    def change(matrix: FloatArray) -> None:
        matrix[:2, :2] *= 1.0 + size * rng.choice([-1.0, 1.0])

    return _change_camera(rig, rng, change)


def _shift(rig: StereoRig, size: float, rng: np.random.Generator) -> StereoRig:
    def change(matrix: FloatArray) -> None:
        matrix[:2, 2] += size * _unit_vector(rng, 2)

    return _change_camera(rig, rng, change)


def _stretch(rig: StereoRig, size: float, rng: np.random.Generator) -> StereoRig:
    """Make all lengths larger or smaller, as a wrong spacing of the target does."""
    factor = 1.0 + size * rng.choice([-1.0, 1.0])
    moved = RigidTransform(rig.right_from_left.rotation, factor * rig.right_from_left.translation_m)
    return replace(rig, right_from_left=moved)


FAULTS = {
    "camera-turned": RigFault("rad", 5e-4, _turn),
    "focal-length": RigFault("share of the focal length", 1e-3, _focus),
    "principal-point": RigFault("px", 5.0, _shift),
    "target-spacing": RigFault("share of the spacing", 2e-3, _stretch),
    "no-distortion": RigFault("share of the lens distortion", 1.0),
    "late-frame": RigFault("frames", 1.0),
    "vibration": RigFault("m", 1e-5),
}
"""Faults of `--violate NAME[=SIZE]` for the preset `acceptance`."""


def rig_faults(given: Sequence[str]) -> dict[str, float]:
    """Return the sizes of faults by name from texts NAME or NAME=SIZE."""
    sizes = {}
    for text in given:
        name, equals, number = text.partition("=")
        if name not in FAULTS:
            raise ValueError(f"violate: expected one of {', '.join(FAULTS)}, found {name or 'nothing'}")
        try:
            size = float(number) if equals else FAULTS[name].size
        except ValueError:
            size = math.nan
        unit = FAULTS[name].unit
        whole = unit != "frames" or size == round(size)
        if not (math.isfinite(size) and size > 0.0 and whole):
            expected = f"a {'whole ' if unit == 'frames' else ''}number above 0 ({unit})"
            raise ValueError(f"violate: expected {expected} for {name}, found {number or 'nothing'}")
        sizes[name] = size
    return sizes


def write_acceptance(
    folder: Path,
    seed: int,
    progress: ProgressCallback = no_progress,
    violate: Sequence[str] = (),
    frames: int | None = None,
) -> Path:
    """Write acceptance.toml with calibration, images and truth; return its path.

    `frames`: of the stationary scene, by default those of the preset.
    """
    changes = {} if frames is None else {"stationary_frames": frames}
    preset, faults = read_preset(AcceptancePreset, "acceptance", **changes), rig_faults(violate)
    rng = np.random.default_rng(seed)
    nominal, _ = nominal_rig(preset.stereo)
    true = _true_rig(nominal, faults, rng)
    face = face_of(preset.stereo, False, rng)
    left = camera_pose(preset.stereo).inverse()
    views = view_of(true.left, left), view_of(true.right, true.right_from_left @ left)
    stated, poses, drawn = _motions(preset, faults, left, rng)
    tables: dict[str, Any] = {"format": 1, "name": "simulated rig", "calibration": CALIBRATION_FILE, **stated}
    late = round(faults.get("late-frame", 0.0))
    done, total = 0, sum(len(pose) for pose in poses.values())
    written = list[str]()
    for name, pose in poses.items():
        shown = pose, pose[np.maximum(np.arange(len(pose)) - late, 0)]
        for number in range(len(pose)):
            images = {}
            for side, view, seen in zip(SIDES, views, shown, strict=True):
                images[f"{name}/{side}-{number:03d}.png"] = _png(preset, view, face, seen[number], rng)
            write_files(folder, images)
            written += images
            done += 1
            progress("render", done, total)
    stored = nominal
    if "no-distortion" in faults:
        share = 1.0 - faults["no-distortion"]
        left_camera, right_camera = (replace(c, distortion=share * c.distortion) for c in (nominal.left, nominal.right))
        stored = replace(nominal, left=left_camera, right=right_camera)
    write_calibration(folder / CALIBRATION_FILE, stored, 0.02)
    files = sorted([*written, ACCEPTANCE_FILE, CALIBRATION_FILE, TRUTH_FILE])
    truth = {"seed": seed, "faults": faults, "parameters": true.values.tolist(), **drawn, "files": files}
    write_files(folder, {ACCEPTANCE_FILE: to_toml(tables), TRUTH_FILE: json.dumps(truth, indent=1)})
    return folder / ACCEPTANCE_FILE


def _true_rig(nominal: StereoRig, faults: dict[str, float], rng: np.random.Generator) -> StereoRig:
    """Return the true cameras: errors of the calibration within its covariance, and faults."""
    covariance = nominal.covariance
    assert covariance is not None
    variance, directions = np.linalg.eigh(covariance)
    error = directions @ (np.sqrt(np.maximum(variance, 0.0)) * rng.standard_normal(len(variance)))
    true = nominal.perturbed(error)
    for name, size in faults.items():
        change = FAULTS[name].change
        true = true if change is None else change(true, size, rng)
    return true


def _motions(
    preset: AcceptancePreset, faults: dict[str, float], left_from_world: RigidTransform, rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, FloatArray], dict[str, Any]]:
    """Return tables of acceptance.toml, poses (F, 6) of the plate by test, and sampled errors."""
    frames = preset.stationary_frames
    rest, time = np.zeros((frames, 6)), np.arange(frames) / preset.frame_rate_hz
    rest[:, 0] = faults.get("vibration", 0.0) * np.sin(2.0 * np.pi * VIBRATION_HZ * time + rng.uniform(0.0, 6.28))
    poses = {"rest": rest}
    blocks, scale = list[dict[str, Any]](), 1.0 + preset.scale_uncertainty * rng.standard_normal()
    position = np.array(preset.positions)
    for name, direction in DIRECTIONS.items():
        true = scale * position + preset.position_uncertainty * rng.standard_normal(len(position))
        share = (position - position.min()) / np.ptp(position)
        pose = np.zeros((len(position), 6))
        pose[:, :3] = np.outer(true - 0.5 * position.max(), direction)
        pose[:, :3] += preset.straightness_uncertainty * rng.standard_normal((len(position), 3))
        pose[:, 3:] = np.outer(share, preset.rotation_uncertainty * rng.standard_normal(3))
        poses[name] = pose
        stated = {key: getattr(preset, key) for key in STAGE_KEYS}
        blocks.append({"name": name, **_images(name), "positions": position.tolist(), **stated})
    axis, wobble = np.array(TURN_AXIS), preset.axis_uncertainty * rng.standard_normal(3)
    angles = np.repeat([0.0, preset.angle], preset.repeats)
    true_angles = np.repeat([0.0, preset.angle + preset.angle_uncertainty * rng.standard_normal()], preset.repeats)
    true_axis = (axis + wobble) / np.linalg.norm(axis + wobble)
    poses["turned"] = np.concatenate([np.zeros((len(angles), 3)), np.outer(true_angles, true_axis)], axis=1)
    rotation = {
        "name": "sine bar",
        **_images("turned"),
        "angles": angles.tolist(),
        "angle_uncertainty": preset.angle_uncertainty,
        "axis": (left_from_world.rotation @ axis).tolist(),
        "axis_uncertainty": preset.axis_uncertainty,
    }
    stationary = {**_images("rest"), "frame_rate": preset.frame_rate_hz}
    tables = {"stationary": stationary, "translation": blocks, "rotation": [rotation]}
    drawn = {"stage_scale": float(scale), "turned_rad": float(true_angles[-1])}
    return tables, poses, drawn


def _images(name: str) -> dict[str, str]:
    return {side: f"{name}/{side}-*.png" for side in SIDES}


def _png(preset: AcceptancePreset, view: View, face: Face, pose: FloatArray, rng: np.random.Generator) -> bytes:
    """Return a rendered image of the plate as PNG."""
    import cv2

    image: NDArray[np.uint16] = preset.stereo.sensor.digitise(render(view, face, pose[None], np.ones(1)), rng)
    _, data = cv2.imencode(".png", image.astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return data.tobytes()
