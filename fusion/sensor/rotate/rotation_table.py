"""Tables of rotation tests: channels, and angle of the head or orientation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.errors import InputError, as_input_error
from fusion.recording.load import Manifest
from fusion.recording.rig import Sensor
from fusion.recording.units import recorded_unit
from fusion.recording.values import LARGEST
from fusion.sensor import bench_notices as declared
from shaker.io.table import read_table_columns, table_units
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.orientations import OrientationSeries, linear_misfit
from shaker.static_rotation.rounding import last_digit
from shakercal._common.arrays import FloatArray

ANGLE, TIME = "angle", "time"
ANGLE_UNITS = {"deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad"}
SPELT = (("·", "."), ("*", "."), (" ", ""), ("Nm", "N.m"))
ROTATION_VECTOR, TILT, ACCELERATION = ("rx", "ry", "rz"), ("roll", "pitch"), ("ax", "ay", "az")
QUATERNION, GRAVITY = ("qx", "qy", "qz", "qw"), ("gx", "gy", "gz")
MATRIX = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
POSES = (QUATERNION, ROTATION_VECTOR, MATRIX, TILT)
DIRECTIONS = (GRAVITY, ACCELERATION)
UNIT_TOLERANCE, ORTHONORMAL = 0.01, 0.01
"""Largest deviation of a quaternion's length, and of the products of a matrix's rows, from those of a rotation."""
WRONG_SHARE, BETTER_SHARE = 0.02, 0.1
"""Share of the variance of the readings that stated poses must leave, and that other poses leave of it, to be refused:
chosen."""


@dataclass(frozen=True)
class RotationTable:
    """Channels with `units`, as loads or outputs, and angle or orientation.

    `pose` (N, M): the columns `names` of angle or orientation.

    `reading` (N, C) with its last `digit` (C,). `time` (N,): in s, or the order.
    """

    path: Path
    units: dict[str, str]
    are_loads: bool
    names: tuple[str, ...]
    pose: FloatArray
    reading: FloatArray
    digit: FloatArray
    time: FloatArray


def read_rotation_table(manifest: Manifest, sensor: Sensor) -> RotationTable:
    """Return the table of a recording; raise `InputError` for impossible columns and numbers."""
    path = table_path(manifest)
    with as_input_error(path):
        stated = table_units(path)
    names = _pose_columns(manifest, stated)
    units, are_loads = _channels(manifest, sensor, stated)
    timed = (TIME,) if TIME in stated and manifest.excitation.orientation else ()
    wanted = [*names, *units, *timed]
    with as_input_error(path):
        table = read_table_columns(path, wanted)
    impossible = ~(np.abs(table) <= LARGEST)
    if impossible.any():
        row, column = (int(i) for i in np.argwhere(impossible)[0])
        expected = f"a number of at most {LARGEST:g} in every row"
        raise wrong_table(path, wanted[column], expected, f"none in row {row + 1}")
    raw = table[:, len(names) : len(names) + len(units)]
    scale = np.ones(len(units)) if are_loads else _scales(manifest, sensor, units)
    digit = np.array([last_digit(column) for column in raw.T]) * np.abs(scale)
    time = table[:, -1] if timed else np.arange(float(len(table)))
    if timed and np.any(np.diff(time) <= 0.0):
        row = int(np.argmax(np.diff(time) <= 0.0)) + 2
        raise wrong_table(path, TIME, "times that increase", f"{time[row - 1]:g} in row {row} after {time[row - 2]:g}")
    return RotationTable(path, units, are_loads, names, table[:, : len(names)], raw * scale, digit, time)


def table_path(manifest: Manifest) -> Path:
    """Return the path of the table of readings."""
    if manifest.excitation.file is None:
        raise InputError(
            declared.MISSING_ROTATION_ENTRY, manifest.path, "excitation.file", expected="the table of readings"
        )
    return manifest.excitation.file


def wrong_table(file: Path, key: str, expected: str, found: str) -> InputError:
    """Return the refusal of a table, or of the key that describes it."""
    return InputError(declared.WRONG_ROTATION_TABLE, file, key, expected=expected, found=found)


def _pose_columns(manifest: Manifest, units: dict[str, str]) -> tuple[str, ...]:
    """Return the columns of angle or orientation, whose unit must be that of the manifest."""
    path, excitation = table_path(manifest), manifest.excitation
    sets: Sequence[tuple[str, ...]] = ((ANGLE,),)
    if excitation.orientation is not None:
        sets = DIRECTIONS if excitation.orientation == "gravity_in_sensor" else POSES
    complete = [names for names in sets if all(name in units for name in names)]
    if excitation.orientation is None and not complete:
        raise wrong_table(path, ANGLE, "a column of this name", f"the columns {', '.join(units)}")
    if len(complete) != 1:
        listed = " or ".join(", ".join(names) for names in sets)
        most = max(sets, key=lambda names: sum(name in units for name in names) / len(names))
        missing = [name for name in most if name not in units]
        if len(complete) > 1:
            raise wrong_table(path, complete[1][0], f"one set of columns of {listed}", "several")
        if len(missing) < len(most):
            raise wrong_table(path, missing[0], f"the columns {', '.join(most)}", "no such column")
        raise wrong_table(path, most[0], f"the columns {listed}", f"the columns {', '.join(units)}")
    (names,) = complete
    if names == TILT and (excitation.orientation != "sensor_in_world" or "down" in excitation.model_fields_set):
        key = "orientation" if excitation.orientation != "sensor_in_world" else "down"
        expected = '"sensor_in_world" with down = -z for the columns roll, pitch'
        raise wrong_table(manifest.path, f"excitation.{key}", expected, "another statement")
    for name in names if names in ((ANGLE,), ROTATION_VECTOR, TILT) else ():
        stated, written = excitation.angle_unit, ANGLE_UNITS.get(units[name].strip().lower())
        if (units[name] and written != stated and (stated or names == (ANGLE,))) or not (written or stated):
            unit = f', "{units[name]}"' if units[name] else ', "rad" or "deg"'
            expected = f"the unit of the column {name} in {path.name}{unit}"
            raise wrong_table(manifest.path, "excitation.angle_unit", expected, f'"{stated}"' if stated else "none")
        if units[name] and written is None:
            raise wrong_table(path, name, "rad or deg", f'the unit "{units[name]}"')
    return names


def in_radians(manifest: Manifest, table: RotationTable) -> FloatArray:
    """Return the columns (N, M) of angles in rad."""
    units = table_units(table.path)
    factors = [
        np.pi / 180.0 if (ANGLE_UNITS.get(units[n].strip().lower()) or manifest.excitation.angle_unit) == "deg" else 1.0
        for n in table.names
    ]
    return np.asarray(table.pose * factors)


# Orientations.


def orientation_series(manifest: Manifest, table: RotationTable, mounted: FloatArray) -> OrientationSeries:
    """Return gravity's direction of every row in sensor axes.

    `mounted` (3, 3): x_flange = mounted · x_sensor.
    """
    excitation, (down, across) = manifest.excitation, _down(manifest)
    if excitation.orientation == "gravity_in_sensor":
        size = np.linalg.norm(table.pose, axis=1, keepdims=True)
        if not np.all(size > 0.0):
            row = int(np.argmin(size)) + 1
            raise wrong_table(table.path, table.names[0], "a direction in every row", f"zeros in row {row}")
        direction = table.pose / size * (1.0 if table.names == GRAVITY else -1.0)
        return OrientationSeries(direction @ mounted, np.zeros((len(direction), 2, 3)), table.time)
    world_from_flange = _rotations(manifest, table)
    if excitation.orientation == "world_in_sensor":
        world_from_flange = world_from_flange.swapaxes(1, 2)
    _refuse_other_poses(manifest, table, world_from_flange, down)
    tilt = np.zeros((len(table.time), 2, 3))
    if table.names != TILT:
        tilt = np.einsum("nxy,jx->njy", world_from_flange, np.cross(across, down)) @ mounted
    return OrientationSeries(np.einsum("nxy,x->ny", world_from_flange, down) @ mounted, tilt, table.time)


def _down(manifest: Manifest) -> tuple[FloatArray, FloatArray]:
    """Return down in the world, and two axes (2, 3) of its tilts."""
    down = np.array(manifest.excitation.down)
    axes = np.linalg.svd(down[None])[2][1:]
    return down, np.asarray(axes)


def _rotations(manifest: Manifest, table: RotationTable) -> FloatArray:
    """Return the stated rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    values, path = table.pose, table.path
    if table.names == QUATERNION:
        length = np.linalg.norm(values, axis=1)
        wrong = np.abs(length - 1.0) > UNIT_TOLERANCE
        if wrong.any():
            row = int(np.argmax(wrong))
            raise wrong_table(path, "qw", "quaternions of length 1", f"length {length[row]:.4g} in row {row + 1}")
        return np.asarray(Rotation.from_quat(values).as_matrix())
    if table.names == ROTATION_VECTOR:
        return np.asarray(Rotation.from_rotvec(in_radians(manifest, table)).as_matrix())
    if table.names == TILT:
        return np.asarray(Rotation.from_euler("YX", in_radians(manifest, table)[:, ::-1]).as_matrix())
    matrix = values.reshape(-1, 3, 3)
    error = np.abs(matrix @ matrix.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > ORTHONORMAL) | (np.linalg.det(matrix) < 0.0)
    if wrong.any():
        row = int(np.argmax(wrong))
        mirrored = error[row] <= ORTHONORMAL
        found = "a mirror image" if mirrored else f"rows that deviate by {error[row]:.2g}"
        raise wrong_table(path, "r11", "rotation matrices, orthonormal", f"{found} in row {row + 1}")
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def _refuse_other_poses(manifest: Manifest, table: RotationTable, stated: FloatArray, down: FloatArray) -> None:
    """Refuse poses if the readings follow their inverse, or quaternions with the real part first."""
    from scipy.spatial.transform import Rotation

    misfit = linear_misfit(stated.swapaxes(1, 2) @ down, table.reading)
    if misfit < WRONG_SHARE:
        return
    key, orientation = (manifest.path, "excitation.orientation"), manifest.excitation.orientation
    inverse = "world_in_sensor" if orientation == "sensor_in_world" else "sensor_in_world"
    others = [(stated, key, f'"{inverse}", which the readings follow', f'"{orientation}"')]
    if table.names == QUATERNION:
        first = Rotation.from_quat(np.roll(table.pose, -1, axis=1)).as_matrix()
        first = first.swapaxes(1, 2) if orientation == "world_in_sensor" else first
        expected, found = "the real part of the quaternion in this column", "it in the first one"
        others.append((first.swapaxes(1, 2), (table.path, "qw"), expected, found))
    if table.names in (ROTATION_VECTOR, TILT):
        degrees = bool(np.ptp(in_radians(manifest, table) - table.pose) > 0.0)
        factor, units = (180.0 / np.pi, "rad, deg") if degrees else (np.pi / 180.0, "deg, rad")
        other = _rotations(manifest, replace(table, pose=factor * table.pose))
        other = other.swapaxes(1, 2) if orientation == "world_in_sensor" else other
        expected, found = units.split(", ")
        others.append((other.swapaxes(1, 2), (table.path, table.names[0]), expected, found))
    for gravity, where, expected, found in others:
        if linear_misfit(gravity @ down, table.reading) < BETTER_SHARE * misfit:
            raise wrong_table(*where, expected, found)


# Channels.


def _channels(manifest: Manifest, sensor: Sensor, units: dict[str, str]) -> tuple[dict[str, str], bool]:
    """Return the units of the channels' columns, and whether they are loads rather than outputs.

    A column without a unit is a load if the sensor's outputs are loads, without sensitivities.
    """
    path = table_path(manifest)
    present = [name for name in sensor.channels if name in units]
    if not present:
        expected = f"columns of the sensor's channels {', '.join(sensor.channels)}"
        raise wrong_table(path, "", expected, ", ".join(units))
    spelt = {name: _spelt(units[name]) for name in present}
    bare_is_load = sensor.static_sensitivity is None and _spelt(sensor.unit) in LOAD_UNITS
    loads = [name for name in present if spelt[name] in LOAD_UNITS or (bare_is_load and not spelt[name])]
    if not loads:
        if sensor.static_sensitivity is None:
            expected = "sensitivities that convert outputs into loads (a calibration matrix), or columns in N"
            raise InputError(
                declared.MISSING_ROTATION_ENTRY, manifest.rig_path, "sensor.static_sensitivity", expected=expected
            )
        return spelt, False
    for name in present:
        if name not in loads:
            expected = f"N or N.m as of {loads[0]}, or outputs throughout"
            raise wrong_table(path, name, expected, f'the unit "{units[name]}"')
    units_of_loads = dict(zip(LOAD_COMPONENTS, LOAD_UNITS, strict=True))
    for name in present:
        if name not in units_of_loads:
            expected = f"one of {', '.join(LOAD_COMPONENTS)}, since columns in N and N.m are loads"
            raise wrong_table(manifest.rig_path, "sensor.channels", expected, f'"{name}"')
        if spelt[name] not in ("", units_of_loads[name]):
            raise wrong_table(path, name, units_of_loads[name], f'the unit "{spelt[name]}"')
    return {name: units_of_loads[name] for name in present}, True


def _spelt(unit: str) -> str:
    """Return a unit in the spelling of the result files."""
    text = unit.strip()
    for old, new in SPELT:
        text = text.replace(old, new)
    return text


def _scales(manifest: Manifest, sensor: Sensor, units: dict[str, str]) -> FloatArray:
    """Return factors (C,) of the columns into the unit of the sensor."""
    excitation, scale, sensor_unit = manifest.excitation, np.ones(len(units)), _spelt(sensor.unit)
    for c, (name, unit) in enumerate(units.items()):
        if "scale" in excitation.model_fields_set or not unit:
            scale[c] = excitation.scale
            continue
        found, target = recorded_unit(unit), recorded_unit(sensor.unit)
        factor = None if found is None or target is None else found.over(target)
        if factor is None and unit != sensor_unit:
            expected = f'"{sensor.unit}", a multiple of it, N and N.m, or the key scale in recording.toml'
            raise wrong_table(table_path(manifest), name, expected, f'the unit "{unit}"')
        scale[c] = 1.0 if factor is None else factor
    return scale
