"""Errors of a body's motion by the fixed pattern of sensors, beside their stated uncertainty.

    python benchmarks/sensor_pattern.py [--draws 40] [--full] [--write]

A speckled face before two cameras moves in a sine; a formula of its own gives every pixel its gain and dark value.
Rows: pattern, contrast and amplitude; without the correction, with it, and with dark and flat images. The page has
the rows of `SHOWN`; `--full` computes and prints all, and does not write.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from marked import markdown_table, write_marked
from numpy.typing import NDArray

from fusion.phasors.pattern_effects import PatternReading
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.flat_field import corrected_sequence, flat_field
from photogram.images.sensor_pattern import stated_pattern
from photogram.images.sequence import ImageSequence
from photogram.measure.body import BodyMotion, measure_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

FloatArray = NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[1] / "docs" / "tracking.md"
PIXEL_M, FOCAL_PX, MIDDLE = 2e-4, 1500.0, 130
FRAMES, RATE_HZ, LINE_HZ = 60, 53.0, 80.0
SENSOR = ImageSensor(12, 8.0, 6.0)
FLATS = 64


@dataclass(frozen=True)
class Defects:
    """Pattern of a sensor: rms of gains and dark values of pixels, of columns, and shadows of dust."""

    name: str
    prnu: float = 0.0
    dsnu: float = 0.0
    columns: float = 0.0
    dust: int = 0

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return gains and dark values (share of full scale) of the pixels of one sensor."""
        gain = 1.0 + self.prnu * rng.standard_normal(shape) + self.columns * rng.standard_normal(shape[1])
        rows, columns = np.mgrid[: shape[0], : shape[1]]
        for _ in range(self.dust):
            x, y = rng.uniform(0.0, shape[1]), rng.uniform(0.0, shape[0])
            wide, deep = rng.uniform(1.5, 4.5), 0.08 * rng.uniform(0.3, 1.0)
            gain *= 1.0 - deep * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * wide**2))
        return gain, self.dsnu * rng.standard_normal(shape)


DEFECTS = (
    Defects("none"),
    Defects("PRNU 0.25 %", 0.0025, 0.00025),
    Defects("PRNU 0.5 %", 0.005, 0.0005),
    Defects("PRNU 1 %", 0.01, 0.001),
    Defects("columns 0.2 %", columns=0.002),
    Defects("100 dust shadows", dust=100),
)
SHOWN = {
    *((motion, "PRNU 1 %", "unknown") for motion in (0.05, 0.3, 1.0, 3.0)),
    *((motion, "PRNU 0.5 %", "unknown") for motion in (0.05, 0.3, 1.0)),
    *((motion, name, "unknown") for motion in (0.05, 0.3) for name in ("columns 0.2 %", "100 dust shadows")),
    *((motion, "PRNU 1 %", "dark and flat") for motion in (0.05, 0.3)),
}
"""Amplitude, pattern and knowledge of the page's rows, at contrast 0.3."""
MOTIONS = ((0.05, 0.3), (0.3, 0.3), (0.3, 0.64), (1.0, 0.3), (3.0, 0.3))


@dataclass(frozen=True)
class Scene:
    """Images without noise of both cameras, and the true motion."""

    images: list[list[NDArray[np.float32]]]
    pose: FloatArray
    rig: StereoRig
    body_from_left: RigidTransform


def render_scene(amplitude_px: float, contrast: float, seed: int = 1) -> Scene:
    """Render a face that moves along its plane, each frame at another phase."""
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(seed))
    size = np.array([0.02, 0.02])
    face = Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], size, False, texture, 0.6 * PIXEL_M)
    face = replace(face, bright=0.5 * (1.0 + contrast), dark=0.5 * (1.0 - contrast))
    camera = Camera.from_parameters(
        np.array([FOCAL_PX, FOCAL_PX, MIDDLE, MIDDLE, 0, 0, 0, 0, 0]), np.array([2 * MIDDLE, 2 * MIDDLE])
    )
    away = RigidTransform(np.eye(3), np.array([0.0, 0.0, FOCAL_PX * PIXEL_M]))
    left, right = (away @ RigidTransform.from_pose(np.radians([0, 0, 0, 0, angle, 0])) for angle in (-14.0, 14.0))
    pose = np.zeros((FRAMES, 6))
    pose[:, :2] = amplitude_px * PIXEL_M * np.outer(np.cos(2.0 * np.pi * LINE_HZ * times_s()), [0.958, 0.287])
    images = [
        [render(view_of(camera, one), face, each[None], np.ones(1)).astype(np.float32) for each in pose]
        for one in (left, right)
    ]
    return Scene(images, pose, StereoRig(camera, camera, right @ left.inverse()), left.inverse())


def times_s() -> FloatArray:
    """Return the instants of the frames."""
    return np.arange(FRAMES) / RATE_HZ + 0.0011


def _sequence(images: list[NDArray[Any]]) -> ImageSequence:
    names = tuple(f"frame {number}" for number in range(len(images)))
    return ImageSequence(names, images[0].shape[::-1], SENSOR.full_scale, images.__getitem__)


def recorded(scene: Scene, defects: Defects, rng: np.random.Generator, known: str) -> tuple[ImageSequence, ...]:
    """Return the images of both cameras; of a sensor that is `unknown`, or measured by `dark and flat`."""
    cameras = []
    for side in scene.images:
        gain, dark = defects.draw(side[0].shape, rng)
        images = _sequence([SENSOR.digitise(image * gain + dark, rng) for image in side])
        if known == "stated":
            images = replace(images, pattern=stated_pattern(defects.prnu, defects.dsnu))
        elif known == "dark and flat":
            dark_images = _sequence([SENSOR.digitise(0.02 + dark, rng) for _ in range(FLATS)])
            flat_images = _sequence([SENSOR.digitise(0.6 * gain + dark, rng) for _ in range(FLATS)])
            images = corrected_sequence(images, flat_field(images, dark_images, flat_images))
        cameras.append(images)
    return tuple(cameras)


def evaluate(scene: Scene, images: tuple[ImageSequence, ...]) -> tuple[float, float, float]:
    """Return the relative errors of the amplitude without and with correction, and its standard uncertainty."""
    body: BodyMotion = measure_body((images[0], images[1]), scene.rig, scene.body_from_left, TrackSettings())
    pattern, time_s = body.pattern, times_s()
    assert pattern is not None
    phase = 2.0 * np.pi * LINE_HZ * time_s
    columns = np.column_stack([np.ones_like(phase), np.cos(phase), np.sin(phase)])
    inverse = np.linalg.pinv(columns)
    true = float((inverse @ scene.pose)[1, 0])
    before, after = (float((inverse @ one)[1, 0]) for one in (body.motion.pose - pattern.correction, body.motion.pose))
    left = body.motion.pose[:, 0] - columns @ (inverse @ body.motion.pose[:, 0])
    noise = float(np.sqrt(np.sum(left**2) / (FRAMES - 3) * np.linalg.inv(columns.T @ columns)[1, 1]))
    amplitude = body.shape_amplitudes.amplitude
    reading = PatternReading(time_s, body.motion.pose, amplitude, pattern, body.tracked)
    effects = reading.effects(np.array([LINE_HZ]))[:, 0, 0].real
    u = float(np.sqrt(noise**2 + np.sum(effects**2)))
    return before / true - 1.0, after / true - 1.0, u / abs(true)


def rows(draws: int, report: Callable[[str], None], full: bool) -> Iterator[str]:
    """Yield the rows of the table, all or those of the page."""
    for amplitude_px, contrast in MOTIONS:
        scene = render_scene(amplitude_px, contrast)
        for defects in DEFECTS:
            for known in ("unknown", "dark and flat") if defects in (DEFECTS[3], DEFECTS[5]) else ("unknown",):
                if not full and (contrast != 0.3 or (amplitude_px, defects.name, known) not in SHOWN):
                    continue
                found = []
                for draw in range(draws):
                    rng = np.random.default_rng([draw, DEFECTS.index(defects), known == "unknown"])
                    found.append(evaluate(scene, recorded(scene, defects, rng, known)))
                before, after, u = np.array(found).T
                covered = 100.0 * np.mean(np.abs(after) <= 1.96 * u)
                row = (
                    f"| {amplitude_px:g}{f' | {contrast:g}' if full else ''} | {defects.name} | {known} | "
                    f"{100 * before.mean():+.3f} | "
                    f"{100 * after.mean():+.3f} | {100 * after.std(ddof=1):.3f} | {100 * np.median(u):.3f} | "
                    f"{covered:.0f} |"
                )
                report(row)
                yield row


HEAD = (
    "| motion / px | pattern | sensor | error as recorded / % | after correction / % | scatter / % | u / % "
    "| covered / % |"
)


def main() -> None:
    """Print the table, or write it into the documents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--full", action="store_true", help="all patterns, contrasts and amplitudes")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    table = list(rows(arguments.draws, lambda row: print(row, flush=True), arguments.full))
    if arguments.write and not arguments.full:
        write_marked(PAGE, {"sensor pattern": markdown_table(HEAD, table)})


if __name__ == "__main__":
    main()
