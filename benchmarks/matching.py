"""Which point of the left picture is which of the right one: shares found and wrong, with and without the calibration.

Usage: python benchmarks/matching.py [--seeds 5] [--only NAME]

A flat speckled face before two cameras of 512 x 400 px, 12 bit with shot and read noise, that see 0.166 mm per pixel,
dots of 4.5 px; every row changes what it names. A subset is wrong where it lies more than 0.5 px from the truth, which
is the face's own geometry. `features`: without a calibration, by features of the whole pictures (`rig=None`, what was
done before); `calibration`: with it. Prints the table of docs/tracking.md. Five seeds take two minutes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.texture import find_saturated, place_subsets, textured_area
from photogram.subsets.track import lay_stereo_grid
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, tile_texture, view_of

FloatArray = NDArray[np.float64]
SIZE_PX = np.array([512, 400])
PIXEL_M = 0.166e-3
DOT_PX = 4.5
WRONG_PX = 0.5
SENSOR = ImageSensor()


@dataclass(frozen=True)
class Scene:
    """What a row of the table changes: angle between the axes, focal length, size and tilt of the face, its print."""

    angle_deg: float = 30.0
    focal_px: float = 2000.0
    half_m: tuple[float, float] = (0.034, 0.027)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    period_m: float = 0.0
    turn_deg: float = 0.0
    grey: tuple[float, float] = (0.16, 0.80)
    glare: float = 0.0


SCENES = {
    "30° between the axes": Scene(),
    "45°": Scene(45.0),
    "60°": Scene(60.0),
    "45°, face tilted by 15° about both axes": Scene(45.0, tilt_deg=(15.0, 15.0)),
    "60°, face tilted by 20° about both axes": Scene(60.0, tilt_deg=(20.0, 20.0)),
    "75°, face tilted by 15° about both axes": Scene(75.0, tilt_deg=(15.0, 15.0)),
    "glare over 10 % of either picture": Scene(glare=0.1),
    "strong perspective (f = 500 px)": Scene(focal_px=500.0, tilt_deg=(10.0, 20.0)),
    "contrast 5 % of full scale": Scene(grey=(0.10, 0.15)),
    "contrast 3 % of full scale": Scene(grey=(0.10, 0.13)),
    "pattern of 64 mm, repeats every 43 mm": Scene(half_m=(0.032, 0.027), period_m=0.043),
    "pattern of 80 mm, repeats every 43 mm": Scene(half_m=(0.040, 0.031), period_m=0.043),
    "the same 43 mm, turned by 3.5°": Scene(half_m=(0.040, 0.031), period_m=0.043, turn_deg=3.5),
    "pattern beyond the view, repeats every 43 mm": Scene(half_m=(0.09, 0.07), period_m=0.043),
    "the same 43 mm beyond the view, turned by 3.5°": Scene(half_m=(0.09, 0.07), period_m=0.043, turn_deg=3.5),
    "pattern of 68 mm, repeats every 8 mm": Scene(period_m=0.008),
    "pattern beyond the view, repeats every 8 mm, turned by 3.5°": Scene(
        half_m=(0.09, 0.07), period_m=0.008, turn_deg=3.5
    ),
}


def rig_of(scene: Scene) -> tuple[StereoRig, tuple[RigidTransform, RigidTransform]]:
    """Two cameras that look at the origin of the world, and where they stand."""
    camera = Camera.from_parameters(
        np.array([scene.focal_px, scene.focal_px, *(SIZE_PX - 1) / 2.0, -0.1, 0.05, 0, 0, 0]), SIZE_PX
    )
    away = RigidTransform(np.eye(3), np.array([0.0, 0.0, scene.focal_px * PIXEL_M]))
    half = np.radians(scene.angle_deg) / 2.0
    left, right = (away @ RigidTransform.from_pose(np.array([0, 0, 0, 0, turn, 0])) for turn in (-half, half))
    return StereoRig(camera, camera, right @ left.inverse()), (left, right)


def face_of(scene: Scene, seed: int) -> Face:
    """The speckled face, which looks at the cameras' middle but for its tilt."""
    rng = np.random.default_rng(seed)
    size = 2.2 * max(scene.half_m)
    texture = speckle_texture((size, size), DOT_PX * PIXEL_M, PIXEL_M / 3, PIXEL_M, rng)
    texture = tile_texture(texture, scene.period_m) if scene.period_m > 0 else texture
    tilt = RigidTransform.from_pose(np.array([0, 0, 0, *np.radians([*scene.tilt_deg, scene.turn_deg])])).rotation
    dark, bright = scene.grey
    half = np.array(scene.half_m)
    return Face(np.zeros(3), tilt[:, 0], tilt[:, 1], half, False, texture, 0.6 * PIXEL_M, bright, dark, 0.06)


def pictures(scene: Scene, seed: int, noise_seed: int) -> tuple[StereoRig, tuple[ImageSequence, ImageSequence], Face]:
    """Both cameras' picture of the face, with noise, and a lamp's reflection where the scene has one."""
    rig, places = rig_of(scene)
    face, rng = face_of(scene, seed), np.random.default_rng((seed, noise_seed))
    sequences = []
    for side, place in enumerate(places):
        image = render(view_of(rig.left, place), face, np.zeros((1, 6)), np.ones(1))
        image = image + _glare(scene.glare, side)
        stored = SENSOR.digitise(image, rng)
        sequences.append(ImageSequence((f"{'LR'[side]}0",), tuple(SIZE_PX), SENSOR.full_scale, {0: stored}.__getitem__))
    return rig, (sequences[0], sequences[1]), face


def _glare(share: float, side: int) -> FloatArray | float:
    """A reflection, saturated over this share of the picture, in another place for each camera."""
    if share == 0.0:
        return 0.0
    x, y = np.meshgrid(*(np.arange(n) for n in SIZE_PX))
    radius = np.sqrt(share * SIZE_PX.prod() / np.pi)
    middle = (200 + 110 * side, 180 + 30 * side)
    return np.asarray(1.0 / (1.0 + np.exp((np.hypot(x - middle[0], y - middle[1]) - radius) / 5.0)))


def true_right(scene: Scene, face: Face, left_px: FloatArray) -> FloatArray:
    """Where the points of the face that the left camera sees at left_px (N,2) are in the right picture."""
    rig, (left, _) = rig_of(scene)
    rays = np.column_stack([rig.left.undistort(left_px), np.ones(len(left_px))])
    normal = left.rotation @ np.cross(face.axis_u, face.axis_v)
    origin = left.apply(face.origin_m[None])[0]
    return rig.project(rays * ((origin @ normal) / (rays @ normal))[:, None])[1]


def matched(scene: Scene, seed: int, noise_seed: int, calibrated: bool) -> tuple[float, float, bool, float]:
    """Share of subsets found, share of these that are wrong, whether it was refused, and the CPU time in s."""
    rig, (left, right), face = pictures(scene, seed, noise_seed)
    settings = TrackSettings()
    area = textured_area(left.read(0))
    inside = np.zeros_like(area)
    inside[5:-5, 5:-5] = area[5:-5, 5:-5]
    points = place_subsets(inside, settings.radius_px, settings.grid_step_px)
    expected = true_right(scene, face, points)
    seen = ((expected > 16) & (expected < SIZE_PX - 17)).all(axis=1)
    for images, places in ((left, points), (right, expected)):
        seen &= ~find_saturated(images.read(0), SENSOR.full_scale, places, settings.radius_px)
    started = time.process_time()
    try:
        grid = lay_stereo_grid(left, right, rig if calibrated else None, settings)
    except ValueError as error:
        print(f"    {error}")
        return 0.0, 0.0, True, time.process_time() - started
    wrong = np.hypot(*(grid.right_px - true_right(scene, face, grid.left_px)).T) > WRONG_PX
    return np.sum(~wrong) / np.sum(seen), np.mean(wrong), False, time.process_time() - started


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="rows whose name has this in it")
    parser.add_argument("--same-print", action="store_true", help="seeds change the noise alone")
    options = parser.parse_args()
    print(
        "| scene | features: found | wrong | refused | calibration: found | wrong | refused | CPU, s |\n|---|"
        + "---|" * 7
    )
    for name, scene in SCENES.items():
        if options.only not in name:
            continue
        cells, times = [], []
        for calibrated in (False, True):
            seeds = [(0, n) if options.same_print else (n, n) for n in range(options.seeds)]
            rows = np.array([matched(scene, *seed, calibrated) for seed in seeds])
            kept = rows[rows[:, 2] == 0]
            found, wrong = kept[:, :2].mean(axis=0) if len(kept) else (np.nan, np.nan)
            cells += [f"{100 * found:.1f} %", f"{100 * wrong:.1f} %", f"{rows[:, 2].sum():.0f} of {len(rows)}"]
            times.append(f"{np.median(rows[:, 3]):.2f}")
        print(f"| {name} | {' | '.join(cells)} | {', '.join(times)} |", flush=True)


if __name__ == "__main__":
    main()
