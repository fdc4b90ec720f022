"""What a manifest states that physics gives a ground to doubt: sizes of another unit, a body that nothing is made of.

Each doubt is a question; nothing is refused, since every one of them has an answer that is right in some laboratory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import InputError
from fusion.instruments.transducer import TRANSDUCERS
from fusion.recording.dsi import NONE, parse_unit
from fusion.recording.response import is_flat, read_response
from fusion.recording.rig import DENSEST_KGM3, Rig, Sensor
from fusion.recording.toml import quote_key
from fusion.recording.values import Vector3
from photogram.calibration.calibration_file import read_calibration
from photogram.geometry import RigidTransform
from shaker.arrays import FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import ChannelEntry

LIGHTEST_KGM3 = 5.0
"""Mass over the volume of the ball of the same moment of inertia: a steel rod of 30 diameters has 17, a plate of 1 : 50
over 100."""
SOLID_KGM3 = (500.0, DENSEST_KGM3)
"""Of what bodies are turned of: hard wood to osmium."""
REACH = 20.0
"""Distance over radius of gyration: of a ball on its foot it is 1.6, at the end of a stem of twice its radius 4.7."""
BRIDGE = (1e-5, 0.2)
"""Rated output over supply, V/V: foil gauges have 5e-4 to 4e-3, semiconductors up to 0.1."""
BESIDE = 0.3
"""Distance from the sensor over the load's radius of gyration up to which a load is neither above nor below it."""
OVERLOAD = 1.0
"""Weight of the load over the largest rated force."""
AIMED_RAD = 0.1
SCALES = {"vibrometer": 0.03, "accelerometer": 0.1}
"""Relative standard uncertainty of a scale from which on it looks like per cent: instruments have a tenth of it."""
WIDEST = 5.0
"""Distance of two cameras over that of the left one from the sensor: at 2 their axes meet at a right angle."""
PARALLEL_RAD = np.radians(3.0)  # between axes that need not cross near the sensor
ASIDE_DEG, TURNED_DEG = 60.0, 30.0
"""Angle between the optical axis and the sensor; the same where the inverse rotation would look towards it. Pairs on
the base look past it by some 20°."""
TURNED_RAD = 0.5
"""Phase of a response whose magnitude is constant: of a delay, 0.8 ms at 100 Hz."""
LATE_S = 0.01
"""Delay of a channel that no filter has whose corner lies above a period of the excitation."""


def plausibility_notices(manifest: Manifest) -> tuple[Notice, ...]:
    """Return a question for everything that a recording and its rig state and that looks like a mistake."""
    rig, file = manifest.rig, manifest.rig_path
    told = [*_bodies(manifest), *_sensor(rig), *_pairs(rig)]
    channels = [
        (f"{where}daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}", entry)
        for where, block in manifest.set_ups
        for daq in block.daq
        for entry in daq.channel
    ]
    told += _gravity(rig, [entry.point for _, entry in channels if entry.body == "load" and entry.point is not None])
    # A load that hangs is nothing unusual.
    of_rig = [
        Notice("note" if key.startswith("environment") else "warning", f"{key}: {text}", file.name)
        for key, text in told
    ]
    lowest = min(manifest.excitation.frequencies or (), default=np.inf)
    own = [f"{key}.{text}" for key, entry in channels for text in _channel(entry, rig, lowest)]
    return (*of_rig, *(Notice("warning", text, manifest.path.name) for text in own))


def _gyration(mass: float, inertia: Sequence[Sequence[float]]) -> float:
    """Return the largest radius of gyration, m, of a mass above 0."""
    return float(np.sqrt(max(np.linalg.eigvalsh(np.array(inertia)).max(), 0.0) / mass))


def _bodies(manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Mass against inertia, centre of mass against extent, and what a body is made of."""
    load, sensor = manifest.rig.load, manifest.rig.sensor
    bodies = [] if load is None else [("load", "", load.mass, load.inertia)]
    bodies += [] if sensor is None else [("sensor", "internal_", sensor.internal_mass, sensor.internal_inertia)]
    bodies += [(f"part.{quote_key(part.name)}", "", part.mass, part.inertia) for part in manifest.part]
    for table, prefix, mass, inertia in bodies:
        gyration = _gyration(mass, inertia) if mass > 0.0 else 0.0
        ball = 4.0 / 3.0 * np.pi * (np.sqrt(2.5) * gyration) ** 3
        if ball > 0.0 and mass / ball < LIGHTEST_KGM3:
            yield (
                f"{table}.{prefix}inertia",
                f"a ball of {mass:g} kg and the largest moment of inertia of {gyration**2 * mass:g} kg m^2 has "
                f"{mass / ball:.2g} kg/m^3, hardly more than air: is {table}.{prefix}mass in kg, "
                f"{table}.{prefix}inertia in kg m^2?",
            )
    if load is None:
        return
    gyration, centre = _gyration(load.mass, load.inertia), float(np.linalg.norm(load.centre_of_mass))
    if gyration > 0.0 and centre > REACH * gyration:
        yield (
            "load.centre_of_mass",
            f"{centre:g} m from the sensor, {centre / gyration:.3g} times the load's radius of gyration of "
            f"{gyration:.3g} m: is it in m, load.inertia in kg m^2 about the centre of mass?",
        )
    densities = [("load", load.density), *((f"part.{quote_key(part.name)}", part.density) for part in manifest.part)]
    densities += [(f"load.elastic.{quote_key(part.name)}", part.density) for part in load.elastic]
    for table, density in densities:
        if density is not None and not SOLID_KGM3[0] <= density <= SOLID_KGM3[1]:
            low, high = SOLID_KGM3
            yield f"{table}.density", f"{density:g} kg/m^3, where solids have {low:g} to {high:g}: is it in kg/m^3?"


def _sensor(rig: Rig) -> Iterator[tuple[str, str]]:
    """Rated loads against the weight of the load, the static matrix against what a bridge can give."""
    sensor, load = rig.sensor, rig.load
    if sensor is None or sensor.capacity is None:
        return
    rated = np.array(sensor.capacity)
    if load is not None and load.true_mass * 9.81 > OVERLOAD * rated[:3].max():
        yield (
            "sensor.capacity",
            f"the load alone weighs {load.true_mass * 9.81:.3g} N, more than every rated force (up to "
            f"{rated[:3].max():g} N): are they in N, load.mass in kg?",
        )
    yield from _rated_output(sensor, rated)


def _rated_output(sensor: Sensor, rated: FloatArray) -> Iterator[tuple[str, str]]:
    """What a bridge gives at the rated loads; of outputs in other units nothing is known."""
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
            yield (
                "sensor.static_sensitivity",
                f"output {name} would be {1e3 * output:.3g} mV/V at its rated load, where bridges give "
                f"{1e3 * low:g} to {1e3 * high:g}: is the matrix in {sensor.unit} per N and N m, sensor.capacity in N?",
            )
            return


def _pairs(rig: Rig) -> Iterator[tuple[str, str]]:
    """Cameras stand closer to each other than several times their distance from the sensor, and look towards it."""
    for name, pair in rig.stereo.items():
        if pair.calibration is None:
            continue
        apart, crossing, away = np.nan, np.nan, float(np.linalg.norm(pair.translation))
        with suppress(OSError, ValueError):  # whoever reads it says what is wrong; a camera alone is none of a pair
            between = read_calibration(pair.calibration).right_from_left
            apart, crossing = float(np.linalg.norm(between.translation_m)), axes_cross_m(between)
        if away > 0.0 and apart > WIDEST * away and pair.surface is None:
            yield (
                f"stereo.{quote_key(name)}.calibration",
                f"its cameras are {apart:.3g} m apart and the left one {away:.3g} m from the sensor: is the "
                f"translation of {pair.calibration.name} in m, and that of the pair?",
            )
        elif away > 0.0 and pair.surface is None and not (np.isnan(crossing) or 0.1 < crossing / away < 10.0):
            yield (
                f"stereo.{quote_key(name)}.calibration",
                f"the axes of its cameras cross {crossing:.3g} m before the left one, which is {away:.3g} m from the "
                f"sensor: are rotation and translation (m) of {pair.calibration.name} x_right = R · x_left + t?",
            )
        if away == 0.0:
            continue
        rotation, place = np.array(pair.rotation), np.array(pair.translation)
        cosines = np.clip([-(rotation.T @ place)[2] / away, -(rotation @ place)[2] / away], -1.0, 1.0)
        aside, turned = np.degrees(np.arccos(cosines)).tolist()
        if aside > ASIDE_DEG or (aside > TURNED_DEG and turned < aside / 3.0):
            yield (
                f"stereo.{quote_key(name)}.rotation",
                f"by it and the translation the left camera looks {aside:.3g}° past the sensor, {turned:.3g}° by its "
                "inverse: is x_sensor = rotation · x_left_camera + translation?",
            )


def axes_cross_m(right_from_left: RigidTransform) -> float:
    """Return where on the left camera's axis the right one's comes nearest, NaN for nearly parallel axes."""
    back = right_from_left.inverse()
    axes = np.stack([[0.0, 0.0, 1.0], -back.rotation[:, 2]], axis=1)
    if np.hypot(*back.rotation[:2, 2]) < np.sin(PARALLEL_RAD):
        return float("nan")
    return float(np.linalg.lstsq(axes, back.translation_m, rcond=None)[0][0])


def _gravity(rig: Rig, points: Sequence[Vector3]) -> Iterator[tuple[str, str]]:
    """A load stands on its sensor, unless it hangs; `points`: of instruments on it."""
    fall, _ = rig.surroundings.free_fall_mps2
    if fall is None or rig.load is None:
        return
    near = BESIDE * _gyration(rig.load.mass, rig.load.inertia)  # a load may enclose its sensor
    centre, down, what = np.array(rig.load.centre_of_mass), np.array(fall), "the load's centre of mass"
    if np.linalg.norm(centre) <= near and points:
        centre, what = np.mean(points, axis=0), "what is measured on the load"
    if np.linalg.norm(centre) <= near:
        return
    along = float(centre @ down) / max(float(np.linalg.norm(centre) * np.linalg.norm(down)), 1e-300)
    if along > 0.5:
        key = "environment.gravity" if rig.surroundings.gravity is not None else "environment.down"
        yield key, f"points from the sensor to {what}: does the load hang under the sensor? Gravity points down"


def _channel(entry: ChannelEntry, rig: Rig, lowest_hz: float) -> Iterator[str]:
    """Places, angles and shares of one channel, each with its key in front."""
    if entry.direction_uncertainty > AIMED_RAD:
        yield (
            f"direction_uncertainty: {entry.direction_uncertainty:.3g} rad are "
            f"{np.degrees(entry.direction_uncertainty):.3g}°: was it stated in degrees?"
        )
    if entry.quantity in TRANSDUCERS and entry.scale_uncertainty > SCALES[TRANSDUCERS[entry.quantity].kind]:
        yield f"scale_uncertainty: {entry.scale_uncertainty:.3g} is {entry.scale_uncertainty:.1%}: stated in per cent?"
    with suppress(InputError):  # whoever reads it says what is wrong
        lines = np.array([lowest_hz] if np.isfinite(lowest_hz) else [])
        if entry.response is not None and len(lines):
            response = read_response(entry.response, lines, entry.response_result, entry.response_columns)
            if response.u_magnitude[0] > SCALES["accelerometer"]:
                u = float(response.u_magnitude[0])
                yield f"response: u of its magnitude is {u:.1%} at {lowest_hz:g} Hz: stated in per cent?"
            turn = abs(float(np.angle(response.value[0] ** 2))) / 2.0  # of either sign
            if turn > TURNED_RAD and is_flat(entry.response, entry.response_columns, lowest_hz):
                phase = f"{float(np.angle(response.value[0])):.3g} rad at {lowest_hz:g} Hz"
                yield f"response: its phase is {phase}, where its magnitude is constant: are the phases in degrees?"
    if abs(entry.delay) > max(LATE_S, 1.0 / lowest_hz):
        yield (
            f"delay: {entry.delay:g} s are {abs(entry.delay) * lowest_hz:.3g} periods of {lowest_hz:g} Hz: is it in s?"
        )
    load = rig.load
    if entry.body == "load" and entry.point is not None and load is not None:
        reach = float(np.linalg.norm(load.centre_of_mass)) + _gyration(load.mass, load.inertia)
        away = float(np.linalg.norm(np.array(entry.point) - np.array(load.centre_of_mass)))
        if reach > 0.0 and away > REACH * reach:
            yield (
                f"point: {away:.3g} m from the load's centre of mass, where load.inertia and load.centre_of_mass "
                f"tell of {reach:.3g} m: is it in m?"
            )
