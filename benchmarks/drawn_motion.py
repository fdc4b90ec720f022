"""Recordings whose pictures are not rendered: what the fit to grey values would find of each frame is drawn instead.

All else is the real path: recorders' files, ties of clocks, lines, sine fits, calibration's effects, supports, modes,
load and sensitivity. Points of a face are where both cameras really see them; the stated calibration and pose make of
that the motion and the amplitudes of the modes, and noise comes with the covariance that the pixels of a small rendered
recording of the same preset state. 160 frames take seconds instead of minutes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.phasors import set_up
from fusion.phasors.stereo_motion import (
    ImageView,
    PreparedImages,
    StereoMotion,
    sensor_from_camera,
)
from fusion.phasors.tracked_blocks import Motions, body_inputs
from fusion.recording.load import load_manifest
from fusion.simulate import sines
from fusion.simulate.preset import Preset, StereoSetup, patches_of
from fusion.simulate.sines import rendered_run, write_run
from fusion.simulate.world import Draws, SimulatedMotion, World, harmonic, make_world, plate_shape, rim_acceleration
from photogram.camera import StereoRig, triangulate
from photogram.direct.direct_fit import pose_covariance, rest_information, rigid_share, without_noise
from photogram.direct.surface import PlainShapes, ShapeAmplitudes
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.measure.body import body_motion, follow_block
from photogram.measure.epipolar import check_epipolar
from photogram.measure.follow import BodyPrior, prepare_body
from photogram.motion import RigidMotion, deformation, fit_motion
from photogram.subsets.track import StereoTracks, Tracks

FloatArray = NDArray[np.float64]
TEMPLATE_FRAMES, POINTS, SIGMA_PX = 8, 13, 2.3e-3
"""Frames of the rendered recording; points along a face; noise of a subset's place, which tells nothing of motion."""


@dataclass(frozen=True)
class PairNoise:
    """What the pixels of one pair state of a frame: covariance of the motion (6, 6) and of the amplitudes of its shapes
    (S, S), uncorrelated with it; rigid motion that a unit of each shape makes (6, S); and a frame's subsets."""

    motion: FloatArray
    shapes: FloatArray
    share: FloatArray
    noise: tuple[NoiseModel, ...]
    subsets: StereoTracks


@dataclass(frozen=True)
class Template:
    """A small rendered recording, and what it states of the noise of each pair by its name."""

    recording: Path
    pairs: dict[str, PairNoise]


def make_template(folder: Path, preset: Preset) -> Template:
    """Render some frames of a preset without errors, and return what their pixels state."""
    small = preset.reduced(TEMPLATE_FRAMES, 1.0)
    draws = Draws(1, False)
    recording = write_run(folder, rendered_run(small), make_world(small, draws, 0.0), draws)
    (opened,) = set_up.prepare_set_ups(load_manifest(recording))
    return Template(recording, {images.sight.name: _noise_of(images) for images in opened.images})


def _noise_of(images: PreparedImages) -> PairNoise:
    scene = prepare_body(*body_inputs(images, Settings()), prior=BodyPrior(images.depth_m, images.modes))
    assert scene.noise is not None
    body = body_motion(scene, [follow_block(scene, block) for block in scene.blocks])
    information, noise_part = rest_information(scene.views)
    clean = without_noise(information, noise_part)
    mixed = clean[6:, :6]
    shapes: FloatArray = np.asarray(np.linalg.inv(clean[6:, 6:] - mixed @ np.linalg.solve(clean[:6, :6], mixed.T)))
    motion = pose_covariance(information[:6, :6], noise_part[:6, :6], np.eye(3), np.zeros(3))
    return PairNoise(motion, shapes, rigid_share(scene.views), scene.noise, next(iter(body.tracked)))


@contextmanager
def unrendered(template: Template, world: World, draws: Draws) -> Iterator[None]:
    """Write recordings of a world with the template's first pictures for all, and measure what it really does."""

    def linked(folder: Path, *_: object) -> None:
        for stereo in world.stereo:
            for side in ("left", "right"):
                series = folder / f"{stereo.setup.name}-{side}"
                series.mkdir()
                for frame in range(world.preset.frames):
                    (series / f"{frame:04d}.tif").hardlink_to(template.recording / series.name / "0000.tif")

    @contextmanager
    def drawn(images: Sequence[PreparedImages], *_: object) -> Iterator[Motions]:
        yield lambda _: tuple(_seen(one, template.pairs[one.sight.name], world, draws) for one in images)

    with patch.object(sines, "_write_images", linked), patch.object(set_up, "tracked_pairs", drawn):
        yield


def _seen(images: PreparedImages, noise: PairNoise, world: World, draws: Draws) -> StereoMotion:
    """Return what a pair finds of a body: of places in its pictures, by the calibration and pose that are stated."""
    rng = draws.stream(f"{images.sight.name}.drawn")
    places = _places(images, world, draws)
    one_px = SIGMA_PX**2 * np.eye(2)
    assert isinstance(images.rig, StereoRig)
    points = triangulate(images.rig, *places, one_px, one_px).transformed(sensor_from_camera(images.sight.pair))
    rigid, rest = fit_motion(points, None, np.zeros(3)), points.position_m[0]
    shapes = images.modes or PlainShapes.of(rest)
    columns = [*np.broadcast_to(np.eye(3)[:, None], (3, len(rest), 3)), *np.cross(np.eye(3)[:, None], rest)]
    design = np.stack([*columns, *shapes(rest)])
    weighted = np.einsum("pni,nij->pnj", design, np.linalg.inv(points.covariance_m2[0])).reshape(len(design), -1)
    beside = deformation(points, rigid).residual_m.reshape(len(rigid.pose), -1)
    both = np.linalg.solve(weighted @ design.reshape(len(design), -1).T, weighted @ (beside - beside[0]).T).T
    frames = len(both)
    pose = rigid.pose + both[:, :6] + both[:, 6:] @ noise.share.T
    pose += rng.standard_normal((frames, 6)) @ np.linalg.cholesky(noise.motion).T
    amplitude = both[:, 6:] + rng.standard_normal((frames, len(noise.shapes))) @ np.linalg.cholesky(noise.shapes).T
    motion = RigidMotion(
        pose, np.broadcast_to(noise.motion, (frames, 6, 6)), rigid.residual_m, rigid.points, np.zeros(3)
    )
    covariance = np.broadcast_to(noise.shapes, (frames, *noise.shapes.shape))
    cameras = tuple(_tracks(place, rng) for place in places)
    tracks = replace(noise.subsets, cameras=cameras, notices=())
    deformed = ShapeAmplitudes(shapes, amplitude, covariance, noise.share)
    epipolar = check_epipolar(tracks, images.rig)
    view = ImageView((tracks,), images.rig, images.first, noise.noise, None, epipolar, deformed, SIGMA_PX, 1.0)
    return StereoMotion(images.sight, motion, (deformation(points, motion),), SIGMA_PX, view, (*images.notices,))


def _tracks(place_px: FloatArray, rng: np.random.Generator) -> Tracks:
    """Return subsets that are found there, with their noise."""
    frames, count, _ = place_px.shape
    found = place_px + SIGMA_PX * rng.standard_normal(place_px.shape)
    covariance = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (frames, count, 2, 2))
    return Tracks(found, covariance, np.ones((frames, count)), np.zeros((frames, count), np.int8), np.ones(count))


def _places(images: PreparedImages, world: World, draws: Draws) -> tuple[FloatArray, FloatArray]:
    """Return where both cameras see points of a face (F, N, 2), as the mean over each exposure."""
    (stereo,) = (s for s in world.stereo if images.sight.name in (s.setup.name, *(p.name for p in patches_of(s.setup))))
    room, preset = images.sight.name != stereo.setup.name, world.preset
    faces = patches_of(stereo.setup) if room else (stereo.setup,)
    rest = np.concatenate([_face(face) for face in faces])
    seen = world.observed_motion(
        draws, "room" if room else stereo.setup.body, "camera", np.array(stereo.setup.face_centre)
    )
    lost = np.sinc(seen.frequency_hz * preset.exposure_s)[:, None]
    middle = world.trigger_s + stereo.delay_s + preset.exposure_s / 2
    moved = np.repeat(rest[None], len(middle), axis=0)
    if preset.plate is not None and not room:
        load = world.motion["load"]
        rim = -rim_acceleration(preset.plate, load, draws)[:, None] / load.omega[:, None] ** 2 * lost
        shape = plate_shape(np.hypot(rest[:, 0], rest[:, 1]) / preset.plate.radius)
        moved[..., 2] += harmonic(middle, load.frequency_hz, rim) * shape
    poses = SimulatedMotion(seen.frequency_hz, seen.acceleration * lost).pose(middle)
    there = np.stack([RigidTransform.from_pose(pose).apply(own) for pose, own in zip(poses, moved, strict=True)])
    left = stereo.left_from_sensor.apply(there)
    return stereo.rig.left.project(left), stereo.rig.right.project(stereo.rig.right_from_left.apply(left))


def _face(face: StereoSetup) -> FloatArray:
    """Return points (N, 3) all over a face at rest."""
    line = 0.97 * np.linspace(-1.0, 1.0, POINTS)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    inside = np.hypot(u, v) <= 1.0 if face.round else np.ones(len(u), np.bool_)
    up, side = np.array(face.face_up), np.cross(np.array(face.face_up), np.array(face.face_normal))
    return np.asarray(
        np.array(face.face_centre)
        + np.multiply.outer(face.half_size[0] * u[inside], side)
        + np.multiply.outer(face.half_size[1] * v[inside], up)
    )
