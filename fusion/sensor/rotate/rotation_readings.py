"""Readings of rotation tests: surroundings, bodies, scatter, and the evaluation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from fusion.base import CommandEvaluation
from fusion.campaign.repeats import BETWEEN, WITHIN, nested_anova
from fusion.errors import InputError, as_input_error
from fusion.estimation.coverage import NamedQuantity
from fusion.recording.load import Manifest
from fusion.recording.rig import RigLoad, RigPart, Sensor
from fusion.recording.units import recorded_unit
from fusion.sensor import bench_notices as declared
from shaker.io.text import read_table_columns, table_units
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import AngleFit, SourcedValue, fit_angles, gravity_at
from shaker.static_rotation.masses import RotationRecord, SensorOutputs, WeightFit, start_values
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# Gravity, air and bodies, as stated by the rig or derived from its location.


LIGHTEST_KGM3, HEAVIEST_KGM3 = 2700.0, 8000.0
"""Densities of aluminium and steel, the limits of a density that is not stated."""


@dataclass(frozen=True)
class WeighedBody:
    """A body with stated mass, volume per mass and centre: kg, m³/kg, m (3,)."""

    name: str
    mass_kg: float
    u_mass_kg: float
    volume_m3kg: float
    u_volume_m3kg: float
    centre_m: FloatArray
    u_centre_m: FloatArray


def local_gravity(manifest: Manifest) -> SourcedValue:
    """Return gravity as stated or by latitude and height; raise `InputError` without them."""
    environment = manifest.rig.surroundings
    if environment.gravity is not None:
        vector, u = np.array(environment.gravity), np.array(environment.gravity_uncertainty)
        size = float(np.linalg.norm(vector))
        return SourcedValue(size, float(np.linalg.norm(vector / size * u)), "stated in rig.toml")
    if environment.latitude is None or environment.height is None:
        raise InputError(declared.GRAVITY_NOT_DETERMINED, manifest.rig_path, "environment.gravity")
    return gravity_at(float(np.radians(environment.latitude)), environment.height)


def unknown_volume() -> tuple[float, float]:
    """Return volume per mass, m³/kg, of something between aluminium and steel, and its standard uncertainty."""
    low, high = 1.0 / HEAVIEST_KGM3, 1.0 / LIGHTEST_KGM3
    return 0.5 * (low + high), (high - low) / np.sqrt(12.0)


def load_bodies(manifest: Manifest) -> tuple[WeighedBody, ...]:
    """Return the load and the rig's parts on it, of recordings with load."""
    rig = manifest.rig
    found = () if rig.load is None else (_weighed("load", rig.load),)
    return found + _weighed_parts(rig.part)


def recording_bodies(manifest: Manifest) -> tuple[WeighedBody, ...]:
    """Return the additional bodies of one recording: the parts of recording.toml."""
    return _weighed_parts(manifest.part[len(manifest.rig.part) :])


def _weighed_parts(parts: Sequence[RigPart]) -> tuple[WeighedBody, ...]:
    return tuple(_weighed(part.name, part) for part in parts if part.body == "load")


def _weighed(name: str, entry: RigLoad | RigPart) -> WeighedBody:
    """Return the body of one table of the manifests."""
    volume, u_volume = unknown_volume() if entry.density is None else (1.0 / entry.density, 0.0)
    centre, u_centre = np.array(entry.centre_of_mass), np.array(entry.centre_of_mass_uncertainty)
    return WeighedBody(name, entry.true_mass, entry.mass_uncertainty, volume, u_volume, centre, u_centre)


# Scatter of the recordings and mountings of one state beyond the stated uncertainties.


@dataclass(frozen=True)
class RotationScatter:
    """Scatter of the recordings of one state, with or without load.

    `recordings`, `mountings` (N,). `within`, `between`: standard deviation (N) of a recording's weight and of a
    mounting's beyond the stated uncertainties, with N - M and M - 1 degrees of freedom; NaN without any.
    """

    state: str
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    within: float
    between: float
    within_dof: int
    between_dof: int


@dataclass(frozen=True)
class RepeatedResults:
    """Results of N recordings of one state, with the effects of all errors.

    `value` (N, V), `effects` (N, V, r) of every cause of error.
    """

    state: str
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    value: FloatArray
    effects: tuple[FloatArray, ...]

    def repeats(self, gradient: FloatArray) -> RotationScatter:
        """Return the scatter of the number with gradient (V,)."""
        forms, found = nested_anova(self.mountings), dict(scatter_components(self, gradient[None]))
        within, between = (float(np.sqrt(found[n].variance[0])) if n in found else np.nan for n in (WITHIN, BETWEEN))
        named = (self.state, self.recordings, self.mountings)
        return RotationScatter(*named, within, between, forms.within_dof, forms.between_dof)


class ScatterComponent(NamedTuple):
    """Variance (Q,) of one recording or mounting beyond the stated uncertainties.

    `in_mean` (Q,): that of the mean. `wide`, `dof` (Q,): variance of the mean and its degrees of freedom for the
    formula of Welch and Satterthwaite.
    """

    variance: FloatArray
    in_mean: FloatArray
    wide: FloatArray
    dof: FloatArray


def scatter_components(carried: RepeatedResults, gradient: FloatArray) -> Iterator[tuple[str, ScatterComponent]]:
    """Yield the scatter of recordings, then of mountings, of Q numbers.

    `gradient` (Q, V): derivatives of the numbers by the mean. One-way random effects, unbalanced. From the mean squares
    s² between the recordings of a mounting, and between mountings, the stated variance σ² is subtracted: τ² = s² - σ²,
    not below 0 (Searle, Casella & McCulloch 1992, Variance Components, 3.6). The mean is that of the recordings. With
    scatter, its u has the ν = N - M or M - 1 degrees of freedom of s². In the formula of effective degrees of freedom,
    s² is enlarged by its relative variance 2/ν to τ² + 2s²/ν. With s² itself, a small scatter of few readings by chance
    gives too many degrees of freedom, and 95 % intervals of three readings cover 92 %.
    """
    forms, count = nested_anova(carried.mountings), len(carried.recordings)
    reading = carried.value @ gradient.T
    effects = [np.einsum("qv,nvr->nqr", gradient, effect) for effect in carried.effects]
    subtracted: FloatArray = np.zeros(len(gradient))

    def beyond(form: Callable[[FloatArray], FloatArray], dof: int, each: float, share: float) -> ScatterComponent:
        """Return the excess of a mean square over stated errors, of `each` recordings per mounting."""
        square = np.einsum("nq,nq->q", reading, form(reading)) / dof
        stated = sum((np.einsum("nqr,nqr->q", e, form(e)) for e in effects), np.zeros(len(square))) / dof
        variance = np.maximum(square - stated - subtracted, 0.0)
        enlarged = np.where(variance > 0.0, square * (1.0 + 2.0 / dof), 1.0)
        wide = np.where(variance > 0.0, variance + square * (2.0 / dof), 0.0)
        factor = share / each
        return ScatterComponent(variance / each, variance * factor, wide * factor, dof * (wide / enlarged) ** 2)

    if forms.within_dof:
        within = beyond(forms.within, forms.within_dof, 1.0, 1.0 / count)
        subtracted = within.variance
        yield WITHIN, within
    if forms.between_dof:
        share = sum(carried.mountings.count(kind) ** 2 for kind in set(carried.mountings)) / count**2
        yield BETWEEN, beyond(forms.between, forms.between_dof, forms.each, share)


# Parts of an evaluated rotation test.


JOINT = "joint"
"""Component of a mass that all force channels determine together."""


@dataclass(frozen=True)
class RotationRecording:
    """One recording: readings over the angle, and their fit.

    `name`: of its folder. `unit` (C,): of every channel. `load` (N, 6): readings as loads by the inverse (6, C) of the
    calibration matrix, NaN for components that it does not determine.
    """

    name: str
    manifest: Manifest
    with_load: bool
    unit: tuple[str, ...]
    fit: AngleFit
    inverse: FloatArray
    load: FloatArray

    @property
    def state(self) -> str:
        """Return whether the sensor carried the load, in words."""
        return "with load" if self.with_load else "without load"

    @property
    def determined(self) -> list[int]:
        """Return the indices of the load components that the channels determine."""
        return [int(i) for i in np.flatnonzero(np.isfinite(self.load).all(axis=0))]


@dataclass(frozen=True)
class RotationQuantity(NamedQuantity):
    """One number of the result.

    `component`: Fx … Mz, x, y, z, or "joint" (all forces). `recording`: folder of its recording, empty if it depends on
    several. `budget`: standard uncertainty by cause.
    """

    component: str
    recording: str
    budget: dict[str, float]


@dataclass(frozen=True)
class RotationEvaluation(CommandEvaluation):
    """All recordings of one sensor on the head; `repeats`: states recorded more than once."""

    recordings: tuple[RotationRecording, ...]
    outputs: SensorOutputs
    gravity: SourcedValue
    air: SourcedValue
    weights: WeightFit
    quantities: tuple[RotationQuantity, ...]
    repeats: tuple[RotationScatter, ...]

    def find(self, name: str, component: str = JOINT, recording: str = "") -> RotationQuantity | None:
        """Return a quantity, None if the recordings do not determine it."""
        key = (name, component, recording)
        return next((q for q in self.quantities if (q.name, q.component, q.recording) == key), None)


# From the table of readings over the angle to harmonics of the outputs.


ANGLE = "angle"
ANGLE_UNITS = {"deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad"}
SPELT = (("·", "."), ("*", "."), (" ", ""), ("Nm", "N.m"))


def read_rotation(manifest: Manifest) -> tuple[RotationRecording, SensorOutputs, list[Notice]]:
    """Return a recording with its fit, its channels' calibration, and notices; refuse impossible readings."""
    sensor, where = manifest.rig.sensor, manifest.folder.name
    if sensor is None:
        expected = "[sensor], whose readings are in the table"
        raise InputError(declared.MISSING_ROTATION_ENTRY, manifest.rig_path, "sensor", expected=expected)
    units, are_loads = _columns(manifest, sensor)
    angle, values = _numbers(manifest, sensor, units, are_loads)
    changing = np.ptp(values, axis=0) > 0.0
    constant = [name for name, changes in zip(units, changing, strict=True) if not changes]
    notices = [Notice(declared.CONSTANT_CHANNELS, where, channels=", ".join(constant))] if constant else []
    missing = [name for name in sensor.channels if name not in units]
    if missing:
        table = table_path(manifest).name
        notices.append(Notice(declared.MISSING_CHANNEL_COLUMNS, where, file=table, channels=", ".join(missing)))
    channels = tuple(name for name in units if name not in constant)
    if not channels:
        raise _wrong_table(table_path(manifest), "", "readings that change with the angle", "constant readings")
    if are_loads:
        matrix = np.eye(6)[[LOAD_COMPONENTS.index(name) for name in channels]]
    else:
        matrix = np.array(sensor.static_sensitivity)[[sensor.channels.index(name) for name in channels]]
    sense: Literal[1, -1] = 1 if sensor.sense == "on_sensor" else -1
    outputs = SensorOutputs(matrix, sensor.static_sensitivity_uncertainty * np.abs(matrix), sense)
    with as_input_error(table_path(manifest)):
        fit = fit_angles(channels, angle, values[:, changing])
    recording = RotationRecording(
        name=where,
        manifest=manifest,
        with_load=bool(manifest.excitation.with_load),
        unit=tuple(units[name] if are_loads else sensor.unit for name in channels),
        fit=fit,
        inverse=outputs.inverse,
        load=np.where(outputs.determined, fit.reading @ outputs.inverse.T, np.nan),
    )
    try:
        start_values(first_harmonics(recording), outputs)
    except ValueError as error:
        keys = {"axis": (manifest.path, "excitation.axis"), "sensitivity": (manifest.rig_path, "sensor.channels")}
        file, key = keys.get(str(error).partition(":")[0], (table_path(manifest), ""))
        raise InputError.from_exception(error, file, key) from error
    return recording, outputs, notices


def first_harmonics(recording: RotationRecording) -> RotationRecord:
    """Return the first harmonics of a recording with the stated axis and direction of gravity."""
    excitation, fit = recording.manifest.excitation, recording.fit
    axis, down = np.array(excitation.axis), np.array(excitation.zero_gravity)
    return RotationRecord(recording.name, fit.amplitude(), fit.covariance(), fit.dof, axis, down)


def table_path(manifest: Manifest) -> Path:
    """Return the path of the table of readings."""
    if manifest.excitation.file is None:
        raise InputError(
            declared.MISSING_ROTATION_ENTRY, manifest.path, "excitation.file", expected="the table of readings"
        )
    return manifest.excitation.file


def _wrong_table(file: Path, key: str, expected: str, found: str) -> InputError:
    return InputError(declared.WRONG_ROTATION_TABLE, file, key, expected=expected, found=found)


def _columns(manifest: Manifest, sensor: Sensor) -> tuple[dict[str, str], bool]:
    """Return the units of the channels' columns, and whether they are loads rather than outputs.

    A column without a unit is a load if the sensor's outputs are loads, without sensitivities.
    """
    path = table_path(manifest)
    with as_input_error(path):
        units = table_units(path)
    if ANGLE not in units:
        raise _wrong_table(path, ANGLE, "a column of this name", f"the columns {', '.join(units)}")
    stated, written = manifest.excitation.angle_unit, ANGLE_UNITS.get(units[ANGLE].strip().lower())
    if units[ANGLE] and written != stated:
        expected = f'the unit of the column {ANGLE} in {path.name}, "{units[ANGLE]}"'
        raise _wrong_table(manifest.path, "excitation.angle_unit", expected, f'"{stated}"')
    present = [name for name in sensor.channels if name in units]
    if not present:
        expected = f"columns of the sensor's channels {', '.join(sensor.channels)}"
        raise _wrong_table(path, "", expected, ", ".join(units))
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
            raise _wrong_table(path, name, expected, f'the unit "{units[name]}"')
    units_of_loads = dict(zip(LOAD_COMPONENTS, LOAD_UNITS, strict=True))
    for name in present:
        if name not in units_of_loads:
            expected = f"one of {', '.join(LOAD_COMPONENTS)}, since columns in N and N.m are loads"
            raise _wrong_table(manifest.rig_path, "sensor.channels", expected, f'"{name}"')
        if spelt[name] not in ("", units_of_loads[name]):
            raise _wrong_table(path, name, units_of_loads[name], f'the unit "{spelt[name]}"')
    return {name: units_of_loads[name] for name in present}, True


def _spelt(unit: str) -> str:
    """Return a unit in the spelling of the result files."""
    text = unit.strip()
    for old, new in SPELT:
        text = text.replace(old, new)
    return text


def _numbers(
    manifest: Manifest, sensor: Sensor, units: dict[str, str], are_loads: bool
) -> tuple[FloatArray, FloatArray]:
    """Return angles (N,) in rad and readings (N, C), outputs or N and N·m."""
    path, excitation, names = table_path(manifest), manifest.excitation, [ANGLE, *units]
    with as_input_error(path):
        table = read_table_columns(path, names)
    if not np.isfinite(table).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(table))[0])
        raise _wrong_table(path, names[column], "a number in every row", f"none in row {row + 1}")
    scale, sensor_unit = np.ones(len(units)), _spelt(sensor.unit)
    for c, (name, unit) in enumerate([] if are_loads else units.items()):
        if "scale" in excitation.model_fields_set or not unit:
            scale[c] = excitation.scale
            continue
        found, target = recorded_unit(unit), recorded_unit(sensor.unit)
        factor = None if found is None or target is None else found.over(target)
        if factor is None and unit != sensor_unit:
            expected = f'"{sensor.unit}", a multiple of it, N and N.m, or the key scale in recording.toml'
            raise _wrong_table(path, name, expected, f'the unit "{unit}"')
        scale[c] = 1.0 if factor is None else factor
    angle = np.radians(table[:, 0]) if excitation.angle_unit == "deg" else table[:, 0]
    return angle, table[:, 1:] * scale
