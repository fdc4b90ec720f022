"""What ordinary cameras do to the light of a rendered scene: noise, gamma, full wells, readout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from speckle import PIXEL_M, camera, sequence, two_poses

from photogram.camera import StereoRig
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence, inspect_first_image
from photogram.measure.body import BodyMotion, measure_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import Face, render, speckle_texture, view_of
from shakercal._common.notices import Notice

WELL = 10_000.0  # electrons at full scale
READ = 1e-3  # of full scale
MIDDLE, HALF_M = (160, 128), (0.028, 0.021)
LEVER_M = 0.02
CYCLES = (3, 5, 7, 4, 6, 8)  # of x y z rx ry rz in a series
Fault = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def swing(frames: int, amplitude_px: float) -> np.ndarray:
    """Poses (F, 6) of a body that swings in all components by about this amplitude in the images."""
    size = np.array([1.0, 1.0, 3.0, *[1.0 / LEVER_M] * 3]) * PIXEL_M * amplitude_px
    return np.asarray(size * np.sin(2.0 * np.pi * np.outer(np.arange(frames) / frames, CYCLES)))


def turn(frames: int, step_deg: float) -> np.ndarray:
    """Poses (F, 6) of a body that turns about z, its rotation vectors no longer than π."""
    angle = np.radians(step_deg) * np.arange(frames)
    return np.column_stack([np.zeros((frames, 5)), (angle + np.pi) % (2.0 * np.pi) - np.pi])


@lru_cache(maxsize=4)
def _light(poses: bytes, frames: int, dark: float, half_m: tuple[float, float]) -> np.ndarray:
    texture = speckle_texture((0.08, 0.08), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(3))
    along = np.eye(3)
    body = Face(np.zeros(3), along[0], along[1], np.array(half_m), False, texture, 0.6 * PIXEL_M, dark=dark)
    views = [view_of(camera(MIDDLE), place) for place in two_poses()]
    shown = np.frombuffer(poses).reshape(frames, 6)
    return np.array([[render(view, body, pose[None], np.ones(1)) for pose in shown] for view in views])


def light(poses: np.ndarray, dark: float = 0.16, half_m: tuple[float, float] = HALF_M) -> np.ndarray:
    """Light (2, F, H, W) on the pixels of both cameras, in shares of full scale."""
    return _light(np.ascontiguousarray(poses).tobytes(), len(poses), dark, half_m)


def shot(expected: np.ndarray, rng: np.random.Generator, well: float = WELL) -> np.ndarray:
    """Light with the noise of its electrons."""
    return np.asarray(expected + np.sqrt(np.maximum(expected, 0.0) / well) * rng.standard_normal(expected.shape))


def read(signal: np.ndarray, rng: np.random.Generator, noise: float = READ) -> np.ndarray:
    """The signal with read noise."""
    return np.asarray(signal + noise * rng.standard_normal(signal.shape))


def sensed(signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A linear sensor."""
    return read(shot(signal, rng), rng)


def full_wells(level: float) -> Fault:
    """Wells that are full at a level, before read noise is added."""
    return lambda signal, rng: read(np.minimum(shot(signal, rng), level), rng)


def gamma(exponent: float) -> Fault:
    """A curve behind the sensor."""
    return lambda signal, rng: np.maximum(sensed(signal, rng), 0.0) ** exponent


def gains(pattern: np.ndarray) -> Fault:
    """A pattern of gains, repeated over the sensor."""

    def fault(signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        rows, columns = signal.shape[2:]
        return np.asarray(sensed(signal, rng) * np.tile(pattern, (rows, columns))[:rows, :columns])

    return fault


def flickering_rows(size: float) -> Fault:
    """An error of each row, another one in every frame."""
    return lambda signal, rng: sensed(signal, rng) + size * rng.standard_normal((*signal.shape[:3], 1))


def digits(signal: np.ndarray, bits: int) -> tuple[list[ImageSequence], list[Notice]]:
    """The images of both cameras, and what their first ones give."""
    full = 2**bits - 1
    kind = np.uint8 if bits == 8 else np.uint16
    images = [sequence([np.clip(np.rint(f * full), 0, full).astype(kind) for f in side], full) for side in signal]
    inspected = [inspect_first_image(one, one.read(0)) for one in images]
    return inspected, [notice for one in inspected for notice in one.notices]


def as_stored(images: ImageSequence) -> ImageSequence:
    """The images without the correction of alternating gains."""
    return replace(images, flat_field=None)


def measured(
    signal: np.ndarray, bits: int, device: str = "cpu", corrected: bool = True
) -> tuple[BodyMotion, list[Notice]]:
    """The motion of the body in these signals, and all notices; as stored where gains are not to be corrected."""
    images, notices = digits(signal, bits)
    images = images if corrected else [as_stored(one) for one in images]
    places = two_poses()
    rig = StereoRig(camera(MIDDLE), camera(MIDDLE), places[1] @ places[0].inverse())
    left_from_body: RigidTransform = places[0]
    body = measure_body(tuple(images), rig, left_from_body.inverse(), TrackSettings(degree=7), device=device)
    return body, [*notices, *body.notices]


def gain_errors(body: BodyMotion, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of the amplitudes of x y z rx ry rz, and their standard uncertainties by the images' noise.

    Of the motion as the fit finds it, without a correction for the fixed pattern of the sensors.
    """
    assert body.pattern is not None
    found = body.motion.pose - body.pattern.correction
    true = poses - poses.mean(axis=0)
    energy = np.sum(true**2, axis=0)
    variance = np.diagonal(body.motion.covariance[1:], axis1=1, axis2=2).mean(axis=0)
    return np.sum(found * true, axis=0) / energy - 1.0, np.sqrt(variance / energy)


def codes(notices: list[Notice]) -> set[str]:
    """The codes of notices."""
    return {notice.code for notice in notices}
