"""A recording's table of readings over the angle → harmonics of the sensor's outputs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.errors import InputError
from fusion.load import LOAD_COMPONENTS, LOAD_UNITS
from fusion.manifest import Manifest, Sensor
from fusion.notices import Notice
from fusion.rotate.result import Column, RotationRecording
from shaker._checks import FloatArray
from shaker.models.weights.harmonics import fit_angles
from shaker.models.weights.turning import SensorOutputs, Turned, start_values
from shaker.signals.files import read_table_columns, table_units

ANGLE = "angle"
ANGLE_UNITS = {"deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad"}
PREFIXES = {"": 1.0, "m": 1e-3, "µ": 1e-6, "μ": 1e-6, "u": 1e-6}
SPELT = (("·", "."), ("*", "."), (" ", ""), ("Nm", "N.m"))


def read_rotation(manifest: Manifest) -> tuple[RotationRecording, SensorOutputs, list[Notice]]:
    """Return one recording with its fit, how its channels answer loads, and what the user should know of it."""
    sensor = _sensor(manifest)
    columns = _columns(manifest, sensor)
    angle, values = _numbers(manifest, sensor, columns)
    changing = np.ptp(values, axis=0) > 0.0
    still = [column.channel for column, moves in zip(columns, changing, strict=True) if not moves]
    where = manifest.folder.name
    notices = [Notice("warning", f"{', '.join(still)}: every reading is the same, left out", where)] if still else []
    missing = [name for name in sensor.channels if name not in [column.channel for column in columns]]
    if missing:
        text = f"{table_path(manifest).name} has no column of {', '.join(missing)}"
        notices.append(Notice("info", text, where))
    columns = [column for column, moves in zip(columns, changing, strict=True) if moves]
    if not columns:
        raise InputError(table_path(manifest), "", "readings that do not change with the angle", "the sensor's outputs")
    outputs = _outputs(sensor, columns)
    try:
        fit = fit_angles(tuple(column.channel for column in columns), angle, values[:, changing])
    except ValueError as error:
        raise InputError.told_by(error, table_path(manifest)) from error
    load = np.where(outputs.determined, fit.reading @ outputs.inverse.T, np.nan)
    recording = RotationRecording(
        name=where,
        manifest=manifest,
        with_load=bool(manifest.excitation.with_load),
        unit=tuple(column.unit if column.is_load else sensor.unit for column in columns),
        fit=fit,
        inverse=outputs.inverse,
        load=load,
    )
    _check_start(recording, outputs)
    return recording, outputs, notices


def turned(recording: RotationRecording) -> Turned:
    """Return the first harmonics of a recording with the axis and the direction of gravity as stated."""
    excitation, fit = recording.manifest.excitation, recording.fit
    axis, down = np.array(excitation.axis), np.array(excitation.zero_gravity)
    return Turned(recording.name, fit.amplitude(), fit.covariance(), fit.dof, axis, down)


def table_path(manifest: Manifest) -> Path:
    """Return the path of the table of readings."""
    if manifest.excitation.file is None:
        raise InputError(manifest.path, "excitation.file", "nothing", "the table of readings")
    return manifest.excitation.file


def _sensor(manifest: Manifest) -> Sensor:
    """The sensor on the head."""
    if manifest.rig.sensor is None:
        raise InputError(manifest.rig_path, "sensor", "nothing", "the [sensor] whose readings stand in the table")
    return manifest.rig.sensor


def _columns(manifest: Manifest, sensor: Sensor) -> list[Column]:
    """Which columns are the sensor's channels, and whether they are outputs or loads."""
    path = table_path(manifest)
    try:
        units = table_units(path)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, path) from error
    if ANGLE not in units:
        raise InputError(path, ANGLE, f"the columns {', '.join(units)}", "a column of this name")
    stated, written = manifest.excitation.angle_unit, ANGLE_UNITS.get(units[ANGLE].strip().lower())
    if units[ANGLE] and written != stated:
        expected = f'the unit of the column {ANGLE} in {path.name}, "{units[ANGLE]}"'
        raise InputError(manifest.path, "excitation.angle_unit", found=f'"{stated}"', expected=expected)
    present = [name for name in sensor.channels if name in units]
    if not present:
        expected = f"columns of the sensor's channels {', '.join(sensor.channels)}"
        raise InputError(path, "", found=", ".join(units), expected=expected)
    plain = {name: _spelt(units[name]) for name in present}
    loads = [name for name in present if plain[name] in LOAD_UNITS or _is_bare_load(sensor, plain[name])]
    if loads and len(loads) < len(present):
        other = next(name for name in present if name not in loads)
        raise InputError(path, other, f'the unit "{units[other]}"', f"N or N.m as of {loads[0]}, or outputs throughout")
    if loads:
        return [_load_column(manifest, sensor, name, plain[name]) for name in present]
    if sensor.static_sensitivity is None:
        expected = (
            "the sensitivities that turn outputs into loads (the inverse of a calibration matrix), or columns in N"
        )
        raise InputError(manifest.rig_path, "sensor.static_sensitivity", found="nothing", expected=expected)
    return [Column(name, plain[name], is_load=False) for name in present]


def _spelt(unit: str) -> str:
    """A unit in the spelling of the result files."""
    text = unit.strip()
    for old, new in SPELT:
        text = text.replace(old, new)
    return text


def _is_bare_load(sensor: Sensor, unit: str) -> bool:
    """Whether a column without a unit holds a load: of a sensor whose outputs are loads, without sensitivities."""
    return not unit and sensor.static_sensitivity is None and _spelt(sensor.unit) in LOAD_UNITS


def _load_column(manifest: Manifest, sensor: Sensor, name: str, unit: str) -> Column:
    """A column that holds a load component."""
    if name not in LOAD_COMPONENTS:
        expected = f"one of {', '.join(LOAD_COMPONENTS)}, since columns in N and N.m are loads"
        raise InputError(manifest.rig_path, "sensor.channels", found=f'"{name}"', expected=expected)
    right = LOAD_UNITS[LOAD_COMPONENTS.index(name)]
    if unit not in ("", right):
        raise InputError(table_path(manifest), name, found=f'the unit "{unit}"', expected=right)
    return Column(name, right, is_load=True)


def _numbers(manifest: Manifest, sensor: Sensor, columns: Sequence[Column]) -> tuple[FloatArray, FloatArray]:
    """Angles in rad (N,) and readings (N, C) in the unit of each column."""
    path = table_path(manifest)
    try:
        table = read_table_columns(path, [ANGLE, *(column.channel for column in columns)])
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, path) from error
    if not np.isfinite(table).all():
        row, place = (int(i) for i in np.argwhere(~np.isfinite(table))[0])
        name = ANGLE if place == 0 else columns[place - 1].channel
        raise InputError(path, name, found=f"none in row {row + 1}", expected="a number in every row")
    angle = np.radians(table[:, 0]) if manifest.excitation.angle_unit == "deg" else table[:, 0]
    return angle, table[:, 1:] * np.array([_factor(manifest, sensor, column) for column in columns])


def _factor(manifest: Manifest, sensor: Sensor, column: Column) -> float:
    """What turns a column into the sensor's unit, or leaves a load as it is."""
    if column.is_load:
        return 1.0
    if "scale" in manifest.excitation.model_fields_set or not column.unit:
        return manifest.excitation.scale
    own = _spelt(sensor.unit)
    for prefix, factor in PREFIXES.items():
        if column.unit == prefix + own:
            return factor
    expected = f'"{sensor.unit}", the same with m or µ before it, N and N.m, or the key scale in recording.toml'
    raise InputError(table_path(manifest), column.channel, found=f'the unit "{column.unit}"', expected=expected)


def _outputs(sensor: Sensor, columns: Sequence[Column]) -> SensorOutputs:
    """How the channels answer the load: rows of the sensitivity, or of the identity where they are loads already."""
    if columns[0].is_load:
        matrix = np.eye(6)[[LOAD_COMPONENTS.index(column.channel) for column in columns]]
    else:
        matrix = np.array(sensor.static_sensitivity)[[sensor.channels.index(column.channel) for column in columns]]
    u = sensor.static_sensitivity_uncertainty * np.abs(matrix)
    return SensorOutputs(matrix, u, 1 if sensor.sense == "on_sensor" else -1)


def _check_start(recording: RotationRecording, outputs: SensorOutputs) -> None:
    """Refuse readings that cannot be those of a weight turned as stated."""
    manifest = recording.manifest
    try:
        start_values(turned(recording), outputs)
    except ValueError as error:
        argument = str(error).partition(":")[0]
        where = {"axis": (manifest.path, "excitation.axis"), "sensitivity": (manifest.rig_path, "sensor.channels")}
        file, key = where.get(argument, (table_path(manifest), ""))
        raise InputError.told_by(error, file, key) from error
