"""Phasors fitted to the grey values of all frames at once, against those of the motions that each frame has alone.

    python benchmarks/grey_phasors.py [--draws 4] [--only NAME ...] [--docs docs]

Unknowns are an offset and amplitude and phase of six components at every line. Frames are not fitted one by one. Their
information H and slope g (`photogram.direct.direct_fit`) at the motion of the unknowns are summed, Σ Φᵀ·H·Φ and Σ Φᵀ·g
with the columns Φ of the sine fit, and solved until convergence. A frame that does not determine its motion contributes
its information. Images are of the preset `demo` without systematic errors, rendered once for each case, with new noise
in each draw. The truth is the sine fit to the true motions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from marked import existing_folder, markdown_table, write_marked
from numpy.typing import NDArray

from fusion.simulate.preset import Preset, face_of, read_preset
from fusion.simulate.world import Draws, make_world
from photogram.bspline import Spline, spline_of_image
from photogram.direct.cells import compare_cells
from photogram.direct.direct_fit import BodyView, rest_information, rigid_cells, without_noise
from photogram.direct.surface import patch_warps
from photogram.geometry import RigidTransform, pose_rate
from photogram.images.sequence import ImageSequence
from photogram.measure.body import body_motion, follow_block
from photogram.measure.follow import BodyScene, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import render_exposure
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.aliasing import sine_columns
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ROUNDS, ENOUGH = 15, 1e-3


@dataclass(frozen=True)
class Case:
    """Pictures of the preset: `frames`; `light` of them, and of every other one `dim` of it; `read` noise in grey
    values; half size of the `face` over that of the preset; part of the pictures that is `hidden` in a third of them;
    of every picture but the first only a `strip` is seen, a part of its width, elsewhere in each; `radius` of subsets
    in px, 0 for the program's own."""

    name: str
    frames: int = 24
    light: float = 1.0
    dim: float = 1.0
    read: float = 1.5
    face: float = 1.0
    hidden: float = 0.0
    strip: float = 0.0
    radius: int = 0


CASES = (
    Case("preset demo"),
    Case("12 frames", frames=12),
    Case("dark", light=0.06, read=3.0),
    Case("dark, 12 frames", frames=12, light=0.06, read=3.0),
    Case("a small patch", face=0.20, radius=7),
    Case("a small patch, dark, 12 frames", frames=12, face=0.20, light=0.15, read=3.0, radius=7),
    Case("every other frame at 0.3 of the light", dim=0.3, read=3.0),
    Case("every other frame at 0.06 of the light", dim=0.06, read=3.0),
    Case("half hidden in a third of the frames", hidden=0.5),
    Case("a strip of a tenth in each frame", strip=0.1),
)


@dataclass(frozen=True)
class Pictures:
    """Noise-free pictures (F, 2, H, W) of a body, instants (F,), frequencies (K,), true phasors (K, 6), the set-up."""

    grey: FloatArray
    time_s: FloatArray
    frequency_hz: FloatArray
    true: ComplexArray
    preset: Preset
    case: Case


def pictures(case: Case) -> Pictures:
    """Render a case."""
    whole = read_preset(Preset, "demo")
    stereo = replace(whole.stereo[0], read_noise_grey=case.read)
    half = (case.face * stereo.half_size[0], case.face * stereo.half_size[1])
    preset = replace(whole, frames=case.frames, stereo=(replace(stereo, half_size=half),))
    draws = Draws(1, False)
    world = make_world(preset, draws, 0.0)
    (pair,) = world.stereo
    face = face_of(pair.setup, False, draws.stream("speckle"))
    middle, seen = world.trigger_s + preset.exposure_s / 2, world.motion["load"]
    grey = []
    for frame, instant in enumerate(middle):
        light = case.light * (case.dim if frame % 2 else 1.0)
        both = [
            light * render_exposure(view, face, seen.pose, float(instant), preset.exposure_s) for view in pair.views
        ]
        if case.hidden and frame % 3 == 1:
            for image in both:
                image[:, : round(case.hidden * image.shape[1])] = 0.2 * light
        if case.strip and frame:
            width = both[0].shape[1]
            begin = round(width * (0.15 + (0.7 - case.strip) * (0.618 * frame % 1.0)))
            for image in both:
                image[:, :begin] = image[:, begin + round(case.strip * width) :] = 0.2 * light
        grey.append(both)
    lost = np.sinc(preset.frequencies_hz * preset.exposure_s)[:, None]
    poses = replace(seen, acceleration=seen.acceleration * lost).pose(middle)
    first = RigidTransform.from_pose(poses[0]).inverse()
    true = np.array([(RigidTransform.from_pose(pose) @ first).pose for pose in poses])
    columns = sine_columns(middle, preset.frequencies_hz)
    phasors = as_phasors(np.linalg.lstsq(columns, true, rcond=None)[0], case.frames)
    return Pictures(np.array(grey), middle, preset.frequencies_hz, phasors, preset, case)


def as_phasors(solution: FloatArray, frames: int) -> ComplexArray:
    """Return the phasors (K, 6) of a solution (2K + 1, 6) in the order of `sine_columns`."""
    return np.asarray(np.sqrt(2.0 / frames) * (solution[0:-1:2] - 1j * solution[1::2]))


def stereo_images(seen: Pictures, rng: np.random.Generator) -> tuple[ImageSequence, ImageSequence]:
    """Return the images of both cameras with noise of their own."""
    sensor, names = seen.preset.stereo[0].sensor, tuple(str(k) for k in range(len(seen.grey)))
    size = (seen.grey.shape[3], seen.grey.shape[2])
    stored = [[sensor.digitise(image, rng) for image in seen.grey[:, side]] for side in range(2)]
    left, right = (ImageSequence(names, size, sensor.full_scale, images.__getitem__) for images in stored)
    return left, right


@dataclass(frozen=True)
class Found:
    """Phasors (K, 6) of one way, standard uncertainty of a part (K, 6), and frames without a fit of their own."""

    value: ComplexArray
    u: FloatArray


def frame_by_frame(scene: BodyScene, seen: Pictures) -> tuple[Found, FloatArray, FloatArray]:
    """Return what the program finds, and motion (F, 6) with covariance (F, 6, 6) of every frame."""
    body = body_motion(scene, [follow_block(scene, block) for block in scene.blocks])
    pose = body.motion.pose
    model = SineModel(robust=True)
    fit = fit_sines(seen.time_s, pose, seen.frequency_hz, MOTION_COMPONENTS, component_units(0), model=model)
    return Found(fit.phasors.value, (fit.phasors.u_re + fit.phasors.u_im) / 2), pose, body.motion.covariance


def by_variance(pose: FloatArray, covariance: FloatArray, seen: Pictures) -> Found:
    """Return phasors of the same motions, each with one weight: by its variances over those of others, in the mean."""
    own = np.log(np.diagonal(covariance, axis1=1, axis2=2))
    size = np.exp(np.mean(own - np.nanmedian(own, axis=0), axis=1))
    unit, model = component_units(0), SineModel(robust=True)
    fit = fit_sines(seen.time_s, pose, seen.frequency_hz, MOTION_COMPONENTS, unit, model=model, variance=size)
    return Found(fit.phasors.value, (fit.phasors.u_re + fit.phasors.u_im) / 2)


def weighted(pose: FloatArray, covariance: FloatArray, seen: Pictures) -> Found:
    """Return phasors of the same motions, each weighted by its own information (6, 6): generalised least squares."""
    known = np.isfinite(pose).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    columns = sine_columns(seen.time_s, seen.frequency_hz)[known]
    information = np.linalg.inv(covariance[known])
    normal = np.einsum("ka,kij,kb->aibj", columns, information, columns, optimize=True)
    right = np.einsum("ka,kij,kj->ai", columns, information, pose[known])
    return _solved(normal, normal, right, len(pose))


def _solved(clean: FloatArray, whole: FloatArray, right: FloatArray, frames: int) -> Found:
    """Return the solution of normal equations (P, 6, P, 6) with what they state of its uncertainty."""
    size = right.size
    inverse = np.linalg.inv(clean.reshape(size, size))
    variance = np.diagonal(inverse @ whole.reshape(size, size) @ inverse).reshape(right.shape)
    u = np.sqrt(2.0 / frames * (variance[0:-1:2] + variance[1::2]) / 2)
    return Found(as_phasors((inverse @ right.ravel()).reshape(right.shape), frames), u)


def all_at_once(scene: BodyScene, images: tuple[ImageSequence, ImageSequence], start: Found, seen: Pictures) -> Found:
    """Return phasors fitted to the grey values of all frames, begun at `start`; NaN where that does not converge."""
    columns, frames = sine_columns(seen.time_s, seen.frequency_hz), len(seen.time_s)
    parts = np.stack([start.value.real, -start.value.imag], axis=1).reshape(-1, 6) / np.sqrt(2.0 / frames)
    unknown = np.concatenate([parts, np.zeros((1, 6))])
    degree = scene.settings.degree
    splines = [[spline_of_image(side.read(k), degree) for side in images] for k in range(1, frames)]
    unknown[-1] -= columns[0] @ unknown / columns[0, -1]  # the first frame is the reference
    at_rest = *rest_information(scene.views), np.zeros(scene.views[0].rates.shape[2])
    for _ in range(ROUNDS):
        normal = np.zeros((2, len(unknown), 6, len(unknown), 6))
        right = np.zeros_like(unknown)
        for k, pose in enumerate(columns @ unknown):
            moved = RigidTransform.from_pose(pose)
            sums = at_rest if k == 0 else frame_sums(scene.views, splines[k - 1], moved)
            information, noise_part, slope = sums[0][:6, :6], sums[1][:6, :6], sums[2][:6]
            turn = np.linalg.inv(pose_rate(pose) @ np.kron(np.eye(2), moved.rotation))
            clean, own = turn.T @ without_noise(information, noise_part) @ turn, turn.T @ information @ turn
            pull = clean @ -pose if k == 0 else -turn.T @ slope
            weight = np.outer(columns[k], columns[k])
            normal += np.stack([np.einsum("ab,ij->aibj", weight, part) for part in (clean, own)])
            right += np.outer(columns[k], pull)
        step = _solved(normal[0], normal[1], right, frames)
        change = np.linalg.solve(normal[0].reshape(right.size, -1), right.ravel()).reshape(right.shape)
        unknown = unknown + change
        if np.all(np.abs(step.value) < ENOUGH * step.u):
            return replace(step, value=as_phasors(unknown, frames))
    return replace(step, value=np.full_like(step.value, np.nan))


def frame_sums(
    views: Sequence[BodyView], targets: Sequence[Spline], moved: RigidTransform
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return information (p, p) of a frame at a motion, the part of it that is noise, slope (p,), over its noise."""
    size = views[0].rates.shape[2]
    both, slope, sums = np.zeros((2, size, size)), np.zeros(size), np.zeros(2)
    for view, target in zip(views, targets, strict=True):
        told = compare_cells(view.cells, target, patch_warps(view.camera, view.patches, moved))
        used = rigid_cells(np, view, told, np.zeros((1, 6)))[0]
        gain = np.where(used, told.gain[0], 0.0)
        both[0] += np.tensordot(gain**2, view.information, 1)
        both[1] += np.tensordot(gain**2, view.information_noise, 1)
        slope += np.einsum("ci,cip->p", np.where(used[:, None], told.slope[0], 0.0) * gain[:, None], view.rates)
        sums += told.misfit[0][used].sum(), told.misfit_noise[0][used].sum()
    scale = max(sums[0] / sums[1], 1e-6) if sums[1] > 0.0 else 1.0
    return both[0] / scale, both[1], slope / scale


def draw(seen: Pictures, seed: int) -> tuple[Found, ...]:
    """Return what one draw of the noise gives: frame by frame, its motions weighted both ways, and all at once."""
    images = stereo_images(seen, np.random.default_rng([seed, 5]))
    world = make_world(seen.preset, Draws(1, False), 0.0)
    (pair,) = world.stereo
    options = TrackSettings(seen.case.radius) if seen.case.radius else TrackSettings()
    scene = prepare_body(images, pair.nominal, pair.sensor_from_left, options)
    plain, pose, covariance = frame_by_frame(scene, seen)
    by_information = weighted(pose, covariance, seen)
    return plain, by_variance(pose, covariance, seen), by_information, all_at_once(scene, images, by_information, seen)


HEAD = (
    "| images | frames | equal weights: error / u | weights by variance: relative error | error / u "
    "| all pixels at once: relative error |"
)


def row(case: Case, draws: int) -> str:
    """Return one row of the table: root mean squares over draws, lines, components and parts in units of u."""
    seen = pictures(case)
    found = [draw(seen, seed) for seed in range(1, draws + 1)]
    unit = np.median([one[-1].u for one in found], axis=0)
    error = np.array([[np.abs(way.value - seen.true) for way in one] for one in found]) / np.sqrt(2.0)
    own = np.sqrt(np.mean((error / np.array([[way.u for way in one] for one in found])) ** 2, axis=(0, 2, 3)))
    square = np.mean((error / unit) ** 2, axis=(2, 3))
    cells = [case.name, f"{case.frames}", f"{own[0]:.2f}", share(square[:, 1], square[:, 0]), f"{own[1]:.2f}"]
    cells.append(share(square[:, 3], square[:, 0]))
    return "| " + " | ".join("does not converge" if "nan" in cell else cell for cell in cells) + " |"


def share(square: FloatArray, other: FloatArray) -> str:
    """Return the root of the ratio of two means of squares of the same draws, with its uncertainty (jackknife)."""
    count = len(square)
    each = np.sqrt((square.sum() - square) / (other.sum() - other))
    spread = np.sqrt((count - 1) * np.mean((each - each.mean()) ** 2))
    return f"{np.sqrt(square.sum() / other.sum()):.3f} ± {2 * spread:.3f}"


def main() -> None:
    """Print the table, and write it into docs/uncertainty-tables.md where a folder is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--docs", type=existing_folder)
    options = parser.parse_args()
    rows = list[str]()
    print(HEAD)
    for case in CASES:
        if not options.only or case.name in options.only:
            rows.append(row(case, options.draws))
            print(rows[-1], flush=True)
    if options.docs is not None:
        write_marked(options.docs / "uncertainty-tables.md", {"grey phasors": markdown_table(HEAD, rows)})


if __name__ == "__main__":
    main()
