"""Plausibility of a manifest: sizes that suggest another unit, bodies of no known material.

No manifest is refused, because each size is right in some laboratory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from fusion.errors import InputError
from fusion.recording.dsi import NONE, parse_unit
from fusion.recording.manifest import ChannelEntry
from fusion.recording.plausibility_notices import (
    CAMERA_POINTS_PAST_SENSOR,
    DISTANT_CHANNEL_POINT,
    IMPLAUSIBLE_CAMERA_BASE,
    IMPLAUSIBLE_CAMERA_CROSSING,
    IMPLAUSIBLE_CENTRE_OF_MASS,
    IMPLAUSIBLE_DENSITY,
    IMPLAUSIBLE_INERTIA,
    IMPLAUSIBLE_STATIC_SENSITIVITY,
    LARGE_DIRECTION_UNCERTAINTY,
    LARGE_RESPONSE_UNCERTAINTY,
    LARGE_SCALE_UNCERTAINTY,
    LOAD_EXCEEDS_CAPACITY,
    LOAD_HANGS,
    LONG_DELAY,
    RESPONSE_PHASE_MAY_BE_DEGREES,
)
from fusion.recording.response import is_flat, read_response
from fusion.recording.rig import DENSEST_KGM3, Rig, RigPart, Sensor
from fusion.recording.toml import quote_key
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.values import Vector3
from photogram.calibration.calibration_file import read_calibration
from photogram.geometry import RigidTransform
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

LIGHTEST_KGM3 = 5.0
"""Mass over the volume of the ball of the same moment of inertia: a steel rod of 30 diameters has 17, a plate of 1 : 50
over 100."""
SOLID_KGM3 = (500.0, DENSEST_KGM3)
"""Densities of machined bodies: hard wood to osmium."""
REACH = 20.0
"""Distance over radius of gyration: 1.6 for a ball on its foot, 4.7 at the end of a stem of twice its radius."""
BRIDGE = (1e-5, 0.2)
"""Rated output over supply, V/V: foil gauges have 5e-4 to 4e-3, semiconductors up to 0.1."""
ENCLOSED = 0.3
"""Distance from the sensor over the load's radius of gyration below which a load encloses its sensor."""
OVERLOAD = 1.0
"""Weight of the load over the largest rated force."""
LARGE_ANGLE_RAD = 0.1
"""Direction uncertainty of 6°: with a protractor 1° is reached."""
SCALES = {"vibrometer": 0.03, "accelerometer": 0.1}
"""Relative standard uncertainty of a scale that suggests per cent: instruments have a tenth of it."""
WIDEST_BASE = 5.0
"""Distance of two cameras over that of the left one from the sensor: at 2 their axes meet at a right angle."""
PARALLEL_RAD = np.radians(3.0)
"""Angle between camera axes that need not cross near the sensor."""
PAST_SENSOR_DEG, INVERTED_DEG = 60.0, 30.0
"""Angle between the optical axis and the sensor; the same if the inverse rotation would point towards it. Pairs on
the base point past it by some 20°."""
LARGE_PHASE_RAD = 0.5
"""Phase of a response whose magnitude is constant: a delay of 0.8 ms at 100 Hz."""
LONG_DELAY_S = 0.01
"""Delay of a channel that no filter has whose corner frequency exceeds the excitation frequency."""


def plausibility_notices(
    rig: Rig,
    parts: Sequence[RigPart],
    channels: Sequence[tuple[str, ChannelEntry]],
    frequencies_hz: Sequence[float],
    files: tuple[str, str],
) -> tuple[Notice, ...]:
    """Return a notice for every implausible statement of a recording and its rig.

    `channels`: with their keys. `files`: names of rig.toml and recording.toml.
    """
    rig_file, file = files
    points = [entry.point for _, entry in channels if entry.body == "load" and entry.point is not None]
    notices = [*_body_notices(rig, parts, rig_file), *_sensor_notices(rig, rig_file), *_pair_notices(rig, rig_file)]
    notices += _gravity_notices(rig, points, rig_file)
    lowest_hz = min(frequencies_hz, default=np.inf)
    for key, entry in channels:
        notices += _channel_notices(entry, key, rig, lowest_hz, file)
    return tuple(notices)


def _gyration(mass: float, inertia: Sequence[Sequence[float]]) -> float:
    """Return the largest radius of gyration, m, of a mass above 0."""
    return float(np.sqrt(max(np.linalg.eigvalsh(np.array(inertia)).max(), 0.0) / mass))


def _body_notices(rig: Rig, parts: Sequence[RigPart], file: str) -> Iterator[Notice]:
    """Compare mass with inertia, centre of mass with extent, density with solids."""
    load, sensor = rig.load, rig.sensor
    bodies = [] if load is None else [("load", "", load.mass, load.inertia)]
    bodies += [] if sensor is None else [("sensor", "internal_", sensor.internal_mass, sensor.internal_inertia)]
    bodies += [(f"part.{quote_key(part.name)}", "", part.mass, part.inertia) for part in parts]
    for table, prefix, mass, inertia in bodies:
        gyration = _gyration(mass, inertia) if mass > 0.0 else 0.0
        ball = 4.0 / 3.0 * np.pi * (np.sqrt(2.5) * gyration) ** 3
        if ball > 0.0 and mass / ball < LIGHTEST_KGM3:
            yield Notice(
                IMPLAUSIBLE_INERTIA, file, key=f"{table}.{prefix}inertia",
                mass_kg=mass, inertia_kgm2=gyration**2 * mass, density_kgm3=mass / ball,
            )  # fmt: skip
    if load is None:
        return
    gyration, centre = _gyration(load.mass, load.inertia), float(np.linalg.norm(load.centre_of_mass))
    if gyration > 0.0 and centre > REACH * gyration:
        yield Notice(
            IMPLAUSIBLE_CENTRE_OF_MASS, file, key="load.centre_of_mass",
            distance_m=centre, ratio=centre / gyration, gyration_m=gyration,
        )  # fmt: skip
    densities = [("load", load.density), *((f"part.{quote_key(part.name)}", part.density) for part in parts)]
    densities += [(f"load.elastic.{quote_key(part.name)}", part.density) for part in load.elastic]
    low, high = SOLID_KGM3
    for table, density in densities:
        if density is not None and not low <= density <= high:
            yield Notice(
                IMPLAUSIBLE_DENSITY, file, key=f"{table}.density", density_kgm3=density, low_kgm3=low, high_kgm3=high
            )


def _sensor_notices(rig: Rig, file: str) -> Iterator[Notice]:
    """Compare rated loads with the load's weight, and outputs with those of bridges."""
    sensor, load = rig.sensor, rig.load
    if sensor is None or sensor.capacity is None:
        return
    rated = np.array(sensor.capacity)
    if load is not None and load.true_mass * 9.81 > OVERLOAD * rated[:3].max():
        weight, largest = load.true_mass * 9.81, float(rated[:3].max())
        yield Notice(LOAD_EXCEEDS_CAPACITY, file, key="sensor.capacity", weight_n=weight, rated_n=largest)
    yield from _rated_output_notices(sensor, rated, file)


def _rated_output_notices(sensor: Sensor, rated: FloatArray, file: str) -> Iterator[Notice]:
    """Compare outputs in V/V at the rated loads with those of bridges."""
    try:
        unit = parse_unit(sensor.unit)
    except ValueError:
        return
    if sensor.static_sensitivity is None or unit.dimension != NONE or "V" not in sensor.unit:
        return
    full = np.max(np.abs(np.array(sensor.static_sensitivity)) * rated, axis=1) * unit.factor
    low, high = BRIDGE
    for name, output in zip(sensor.channels, full.tolist(), strict=True):
        if output > 0.0 and not low <= output <= high:
            yield Notice(
                IMPLAUSIBLE_STATIC_SENSITIVITY, file, key="sensor.static_sensitivity", output=name, unit=sensor.unit,
                rated_mv_per_v=1e3 * output, low_mv_per_v=1e3 * low, high_mv_per_v=1e3 * high,
            )  # fmt: skip
            return


def _pair_notices(rig: Rig, file: str) -> Iterator[Notice]:
    """Compare distances and directions of cameras: their axes usually cross near the sensor."""
    for name, pair in rig.stereo.items():
        if pair.calibration is None:
            continue
        base, crossing, distance = np.nan, np.nan, float(np.linalg.norm(pair.translation))
        with suppress(OSError, ValueError):  # its reader reports the error; a single camera has no base
            between = read_calibration(pair.calibration).right_from_left
            base, crossing = float(np.linalg.norm(between.translation_m)), axes_cross_m(between)
        key, calibration = f"stereo.{quote_key(name)}.calibration", pair.calibration.name
        if distance > 0.0 and base > WIDEST_BASE * distance and pair.surface is None:
            yield Notice(
                IMPLAUSIBLE_CAMERA_BASE, file, key=key, base_m=base, distance_m=distance, calibration=calibration
            )
        elif distance > 0.0 and pair.surface is None and not (np.isnan(crossing) or 0.1 < crossing / distance < 10.0):
            yield Notice(
                IMPLAUSIBLE_CAMERA_CROSSING,
                file,
                key=key,
                crossing_m=crossing,
                distance_m=distance,
                calibration=calibration,
            )
        if distance == 0.0:
            continue
        rotation, position = np.array(pair.rotation), np.array(pair.translation)
        cosines = np.clip([-(rotation.T @ position)[2] / distance, -(rotation @ position)[2] / distance], -1.0, 1.0)
        angle, inverse = np.degrees(np.arccos(cosines)).tolist()
        if angle > PAST_SENSOR_DEG or (angle > INVERTED_DEG and inverse < angle / 3.0):
            key = f"stereo.{quote_key(name)}.rotation"
            yield Notice(CAMERA_POINTS_PAST_SENSOR, file, key=key, angle_deg=angle, inverse_angle_deg=inverse)


def axes_cross_m(right_from_left: RigidTransform) -> float:
    """Return where the camera axes cross, m along the left one, NaN if parallel."""
    back = right_from_left.inverse()
    axes = np.stack([[0.0, 0.0, 1.0], -back.rotation[:, 2]], axis=1)
    if np.hypot(*back.rotation[:2, 2]) < np.sin(PARALLEL_RAD):
        return float("nan")
    return float(np.linalg.lstsq(axes, back.translation_m, rcond=None)[0][0])


def _gravity_notices(rig: Rig, points: Sequence[Vector3], file: str) -> Iterator[Notice]:
    """Compare gravity with the position of the load; `points`: of instruments on it."""
    fall, _ = rig.surroundings.free_fall_mps2
    if fall is None or rig.load is None:
        return
    near = ENCLOSED * _gyration(rig.load.mass, rig.load.inertia)
    centre, down, target = np.array(rig.load.centre_of_mass), np.array(fall), "the load's centre of mass"
    if np.linalg.norm(centre) <= near and points:
        centre, target = np.mean(points, axis=0), "the measuring points on the load"
    if np.linalg.norm(centre) <= near:
        return
    along = float(centre @ down) / max(float(np.linalg.norm(centre) * np.linalg.norm(down)), 1e-300)
    if along > 0.5:
        key = "environment.gravity" if rig.surroundings.gravity is not None else "environment.down"
        yield Notice(LOAD_HANGS, file, key=key, target=target)


def _channel_notices(entry: ChannelEntry, key: str, rig: Rig, lowest_hz: float, file: str) -> Iterator[Notice]:
    """Check positions, angles and shares of one channel."""
    u_direction, u_scale = entry.direction_uncertainty, entry.scale_uncertainty
    if u_direction > LARGE_ANGLE_RAD:
        u_deg = float(np.degrees(u_direction))
        yield Notice(
            LARGE_DIRECTION_UNCERTAINTY, file, key=f"{key}.direction_uncertainty", u_rad=u_direction, u_deg=u_deg
        )
    if entry.quantity in TRANSDUCERS and u_scale > SCALES[TRANSDUCERS[entry.quantity].kind]:
        yield Notice(LARGE_SCALE_UNCERTAINTY, file, key=f"{key}.scale_uncertainty", u=u_scale)
    with suppress(InputError):  # its reader reports the error
        if entry.response is not None and np.isfinite(lowest_hz):
            yield from _response_notices(entry, f"{key}.response", lowest_hz, file)
    if abs(entry.delay) > max(LONG_DELAY_S, 1.0 / lowest_hz):
        periods = abs(entry.delay) * lowest_hz
        yield Notice(LONG_DELAY, file, key=f"{key}.delay", delay_s=entry.delay, periods=periods, frequency_hz=lowest_hz)
    load = rig.load
    if entry.body == "load" and entry.point is not None and load is not None:
        reach = float(np.linalg.norm(load.centre_of_mass)) + _gyration(load.mass, load.inertia)
        distance = float(np.linalg.norm(np.array(entry.point) - np.array(load.centre_of_mass)))
        if reach > 0.0 and distance > REACH * reach:
            yield Notice(DISTANT_CHANNEL_POINT, file, key=f"{key}.point", distance_m=distance, reach_m=reach)


def _response_notices(entry: ChannelEntry, key: str, frequency_hz: float, file: str) -> Iterator[Notice]:
    """Check uncertainty and phase of a channel's response at the lowest frequency."""
    assert entry.response is not None
    response = read_response(entry.response, np.array([frequency_hz]), entry.response_result, entry.response_columns)
    u = float(response.u_magnitude[0])
    if u > SCALES["accelerometer"]:
        yield Notice(LARGE_RESPONSE_UNCERTAINTY, file, key=key, u=u, frequency_hz=frequency_hz)
    phase = abs(float(np.angle(response.value[0] ** 2))) / 2.0  # of either sign
    if phase > LARGE_PHASE_RAD and is_flat(entry.response, entry.response_columns, frequency_hz):
        stated = float(np.angle(response.value[0]))
        yield Notice(RESPONSE_PHASE_MAY_BE_DEGREES, file, key=key, phase_rad=stated, frequency_hz=frequency_hz)
