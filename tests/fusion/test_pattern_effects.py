"""Fixed pattern of sensors in the uncertainty of phasors: errors over u, and what a user is told."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from pattern_factory import AMPLITUDE_PX, COLUMNS, FRAMES, PIXEL_M, clean_images, measured, relative_error
from speckle import SENSOR, sequence

from fusion.errors import InputError
from fusion.phasors.pattern_effects import PatternReading
from fusion.phasors.stereo_motion import _with_pattern
from fusion.recording.values import SensorOfCamera
from photogram.images.sensor_pattern import TYPICAL, SensorPattern, stated_pattern
from photogram.measure.body import BodyMotion
from shaker.sine.phasor import Phasors

FREQUENCY_HZ = np.array([0.618])
TIME_S = np.arange(FRAMES, dtype=np.float64)


@pytest.fixture(scope="module")
def clean() -> list[list[np.ndarray]]:
    return clean_images()


def pixels(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(image * (1.0 + 0.01 * rng.standard_normal(image.shape)) + 1e-3 * rng.standard_normal(image.shape))


def columns(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(image * (1.0 + 0.004 * rng.standard_normal(image.shape[1])))


def dust(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    shadows = np.ones(image.shape)
    for _ in range(60):
        middle, wide, deep = rng.uniform(0.0, image.shape[0], 2), rng.uniform(1.5, 4.0), rng.uniform(0.02, 0.08)
        shadows *= 1.0 - deep * np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2.0 * wide**2))
    return np.asarray(image * shadows)


def reading_of(body: BodyMotion) -> PatternReading:
    assert body.pattern is not None
    return PatternReading(TIME_S, body.motion.pose, body.shape_amplitudes.amplitude, body.pattern, body.tracked)


def noise_of(body: BodyMotion) -> float:
    left = body.motion.pose[:, 0] - COLUMNS @ np.linalg.lstsq(COLUMNS, body.motion.pose[:, 0], rcond=None)[0]
    return float(np.linalg.norm(left) / np.sqrt(FRAMES - 3) * np.sqrt(np.linalg.inv(COLUMNS.T @ COLUMNS)[1, 1]))


def normalised(body: BodyMotion) -> float:
    """The error of the amplitude over its standard uncertainty by noise and pattern."""
    effects = reading_of(body).effects(FREQUENCY_HZ)[:, 0, 0].real
    u = np.hypot(noise_of(body), np.linalg.norm(effects)) / (AMPLITUDE_PX * PIXEL_M)
    return relative_error(body.motion.pose) / float(u)


@pytest.mark.parametrize("changed", [pixels, columns])
def test_the_pattern_is_in_the_uncertainty(clean, changed):
    assert abs(normalised(measured(clean, 11, changed))) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("known", [TYPICAL, stated_pattern(0.01, 0.001)])
@pytest.mark.parametrize("changed", [pixels, columns, dust])
def test_errors_over_their_uncertainty(clean, changed, known):
    found = np.array([normalised(measured(clean, seed, changed, known)) for seed in range(100, 120)])
    assert 0.5 < np.sqrt(np.mean(found**2)) < 1.3
    assert np.abs(found).max() < 3.5


def phasors_of(body: BodyMotion) -> Phasors:
    value = np.linalg.lstsq(COLUMNS, body.motion.pose, rcond=None)[0]
    covariance = np.broadcast_to(noise_of(body) ** 2 * np.eye(12), (1, 12, 12))
    phasor = value[1:2] - 1j * value[2:3]
    return Phasors(FREQUENCY_HZ, phasor, covariance.copy(), tuple("xyzabc"), ("m",) * 6, np.array([9.0]))


def told(body: BodyMotion) -> list[str]:
    reading, driven = reading_of(body), np.array([True])
    effects = reading.effects(FREQUENCY_HZ)
    return [notice.code for notice in reading.notices((FREQUENCY_HZ, driven), phasors_of(body), effects)]


def test_a_user_is_told_of_the_correction_and_of_wrong_statements(clean):
    assert told(measured(clean, 12, pixels)) == ["SC-214"]
    assert told(measured(clean, 12, pixels, SensorPattern(0.002, 0.0002, 0.5, 2e-4, 2e-4, known=True)))[0] == "SC-219"


def test_a_motion_that_does_not_show_the_pattern_is_told(clean):
    """As by frames with hardly any motion, which leave what is known of the sensor."""
    body = measured(clean, 13, pixels)
    assert body.pattern is not None
    variance = np.array([[1.0, TYPICAL.variance_uncertainty]] * 2)
    open_size = replace(body, pattern=replace(body.pattern, change=20.0 * body.pattern.change, variance=variance))
    assert told(open_size) == ["SC-215"]


@pytest.mark.parametrize(("key", "said"), [("dark", "180 x 180 px, found 30 x 20 px"), ("flat", "found 30 x 20 px")])
def test_a_refused_dark_or_flat_image_is_one_sentence_with_its_key(key, said, clean, tmp_path):
    files = tuple(tmp_path / f"{number}.tif" for number in range(2))
    for file in files:
        cv2.imwrite(str(file), np.full((20, 30), 5, np.uint16))
    stated = SensorOfCamera.model_construct(**{key: files})
    sight: Any = SimpleNamespace(name="top", pair=SimpleNamespace(left=stated))
    manifest: Any = SimpleNamespace(rig_path=tmp_path / "rig.toml")
    images = sequence([SENSOR.digitise(clean[0][0], None)], SENSOR.full_scale)
    with pytest.raises(InputError) as refused:
        _with_pattern(manifest, sight, "left", images)
    assert "rig.toml: stereo.top.left: " in str(refused.value)
    assert said in str(refused.value)
