"""Readings over the angle of an indexing head: surroundings, scatter, and the result they lead to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from shaker.arrays import FloatArray
from shaker.io.text import read_table_columns, table_units
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import AngleFit, SourcedValue, fit_angles, gravity_at
from shaker.static_rotation.masses import RotationRecord, SensorOutputs, WeightFit, start_values
from shakercal._common.notices import Notice

# Gravity, air and what is mounted, as the rig states them or as they follow from its place.


LIGHTEST_KGM3, HEAVIEST_KGM3 = 2700.0, 8000.0
"""Densities of aluminium and steel: anything between them may be what nobody has stated."""
"""Relative standard uncertainty of an air density that is stated."""


@dataclass(frozen=True)
class WeighedBody:
    """A body whose mass is stated: true mass kg, volume per mass m³/kg, centre of mass m (3,), with uncertainties."""

    name: str
    mass_kg: float
    u_mass_kg: float
    volume_m3kg: float
    u_volume_m3kg: float
    centre_m: FloatArray
    u_centre_m: FloatArray


def local_gravity(manifest: Manifest) -> SourcedValue:
    """Return the rig's gravity, else that of its latitude and height; refuses a rig that states neither."""
    environment = manifest.rig.surroundings
    if environment.gravity is not None:
        vector, u = np.array(environment.gravity), np.array(environment.gravity_uncertainty)
        size = float(np.linalg.norm(vector))
        return SourcedValue(size, float(np.linalg.norm(vector / size * u)), "stated in rig.toml")
    if environment.latitude is None or environment.height is None:
        expected = "local gravity, or latitude and height from which it follows"
        raise InputError(manifest.rig_path, "environment.gravity", found="nothing", expected=expected)
    return gravity_at(float(np.radians(environment.latitude)), environment.height)


def unknown_volume() -> tuple[float, float]:
    """Return volume per mass, m³/kg, of something between aluminium and steel, and its standard uncertainty."""
    low, high = 1.0 / HEAVIEST_KGM3, 1.0 / LIGHTEST_KGM3
    return 0.5 * (low + high), (high - low) / np.sqrt(12.0)


def load_bodies(manifest: Manifest) -> tuple[WeighedBody, ...]:
    """Return what is taken off for a recording without load: the load and the rig's parts on it."""
    rig = manifest.rig
    found = [] if rig.load is None else [_weighed("load", rig.load)]
    return (*found, *(_weighed(part.name, part) for part in rig.part if part.body == "load"))


def recording_bodies(manifest: Manifest) -> tuple[WeighedBody, ...]:
    """Return what one recording carries beside that: the parts that stand in its own recording.toml."""
    own = manifest.part[len(manifest.rig.part) :]
    return tuple(_weighed(part.name, part) for part in own if part.body == "load")


def _weighed(name: str, entry: RigLoad | RigPart) -> WeighedBody:
    """One table of the manifests."""
    volume, u_volume = unknown_volume() if entry.density is None else (1.0 / entry.density, 0.0)
    centre, u_centre = np.array(entry.centre_of_mass), np.array(entry.centre_of_mass_uncertainty)
    return WeighedBody(name, entry.true_mass, entry.mass_uncertainty, volume, u_volume, centre, u_centre)


# Repeats of a rotation test: what recordings and mountings of one state scatter by beyond what is stated for them.


@dataclass(frozen=True)
class RotationScatter:
    """Recordings of one state, with or without load.

    `recordings`, `mountings` (N,); `within`, `between`: standard deviation in N of a recording's weight and of a
    mounting's beyond what is stated, with N - M and M - 1 degrees of freedom; NaN where there are none.
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
    """What N recordings of one state found: `value` (N, V) and the effect (N, V, r) of every cause of error on it."""

    state: str
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    value: FloatArray
    effects: tuple[FloatArray, ...]

    def repeats(self, gradient: FloatArray) -> RotationScatter:
        """Return how much the number with a gradient (V,) scatters."""
        forms = nested_anova(self.mountings)
        found = dict(scatter_components(self, gradient[None]))
        within, between = (float(np.sqrt(found[n].variance[0])) if n in found else np.nan for n in (WITHIN, BETWEEN))
        counts = (forms.within_dof, forms.between_dof)
        return RotationScatter(self.state, self.recordings, self.mountings, within, between, *counts)


class ScatterComponent(NamedTuple):
    """Variance (Q,) of one recording or mounting beyond what is stated, and that of the mean.

    `wide`, `dof` (Q,): variance of the mean and its degrees of freedom for the formula of Welch and Satterthwaite.
    """

    variance: FloatArray
    in_mean: FloatArray
    wide: FloatArray
    dof: FloatArray


def scatter_components(carried: RepeatedResults, gradient: FloatArray) -> Iterator[tuple[str, ScatterComponent]]:
    """Yield what recordings, then mountings, scatter by in Q numbers, each by itself; `gradient` (Q, V) of the mean.

    One-way random effects, unbalanced: of the mean squares s² between the recordings of a mounting and between the
    mountings, what is stated makes σ², and beyond it are τ² = s² - σ², none where negative (Searle, Casella &
    McCulloch 1992, Variance Components, 3.6). The mean is that of the recordings; where it scatters, its u has the
    N - M or M - 1 = ν degrees of freedom of s². Beside other contributions, effective degrees of freedom follow from
    s² enlarged by its relative variance 2/ν, τ² + 2s²/ν for τ²: with s² itself there are too many wherever few
    readings happen to scatter little, and 95 % intervals of three would hold 92 in 100.
    """
    forms, count = nested_anova(carried.mountings), len(carried.recordings)
    reading = carried.value @ gradient.T
    effects = [np.einsum("qv,nvr->nqr", gradient, effect) for effect in carried.effects]
    known: FloatArray = np.zeros(len(gradient))

    def beyond(form: Callable[[FloatArray], FloatArray], dof: int, each: float, share: float) -> ScatterComponent:
        """What a mean square exceeds stated errors by, of `each` recordings of a mounting, with a share in the mean."""
        square = np.einsum("nq,nq->q", reading, form(reading)) / dof
        stated = sum((np.einsum("nqr,nqr->q", e, form(e)) for e in effects), np.zeros(len(square))) / dof
        variance = np.maximum(square - stated - known, 0.0)
        enlarged = np.where(variance > 0.0, square * (1.0 + 2.0 / dof), 1.0)
        wide = np.where(variance > 0.0, variance + square * (2.0 / dof), 0.0)
        factor = share / each
        return ScatterComponent(variance / each, variance * factor, wide * factor, dof * (wide / enlarged) ** 2)

    if forms.within_dof:
        within = beyond(forms.within, forms.within_dof, 1.0, 1.0 / count)
        known = within.variance
        yield WITHIN, within
    if forms.between_dof:
        share = sum(carried.mountings.count(kind) ** 2 for kind in set(carried.mountings)) / count**2
        yield BETWEEN, beyond(forms.between, forms.between_dof, forms.each, share)


# What an evaluated rotation test consists of.


JOINT = "joint"
"""Component of a mass that all force channels tell together."""


@dataclass(frozen=True)
class RotationRecording:
    """One recording: readings over the angle in the sensor's unit or in N and N·m, and the fit to them.

    `name`: of its folder. `unit` (C,), of every channel. `load` (N, 6): the readings as loads by the calibration
    matrix `inverse` (6, C), NaN where that does not tell a component.
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
        """Return what was on the sensor, in words."""
        return "with load" if self.with_load else "without load"

    @property
    def determined(self) -> list[int]:
        """Return the places of the load components that the channels tell."""
        return [int(i) for i in np.flatnonzero(np.isfinite(self.load).all(axis=0))]


@dataclass(frozen=True)
class RotationQuantity(NamedQuantity):
    """One number of the result.

    `component`: Fx … Mz, x, y, z, or all forces together ("joint"); `recording`: the folder of the one it belongs to,
    empty where it rests on several. `budget`: standard uncertainty by cause.
    """

    component: str
    recording: str
    budget: dict[str, float]


@dataclass(frozen=True)
class RotationEvaluation(CommandEvaluation):
    """All recordings of one sensor on the head, what they weigh, and their surroundings.

    `repeats`: of each state that was recorded more than once.
    """

    recordings: tuple[RotationRecording, ...]
    outputs: SensorOutputs
    gravity: SourcedValue
    air: SourcedValue
    weights: WeightFit
    quantities: tuple[RotationQuantity, ...]
    repeats: tuple[RotationScatter, ...]

    def find(self, name: str, component: str = JOINT, recording: str = "") -> RotationQuantity | None:
        """Return a quantity, None where the recordings do not tell it."""
        wanted = (name, component, recording)
        return next((q for q in self.quantities if (q.name, q.component, q.recording) == wanted), None)


# A recording's table of readings over the angle → harmonics of the sensor's outputs.


ANGLE = "angle"
ANGLE_UNITS = {"deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "radian": "rad"}
SPELT = (("·", "."), ("*", "."), (" ", ""), ("Nm", "N.m"))


def read_rotation(manifest: Manifest) -> tuple[RotationRecording, SensorOutputs, list[Notice]]:
    """Return one recording with its fit, how its channels answer loads, and what the user should know of it.

    Readings that cannot be those of a weight turned as stated are refused.
    """
    sensor, where = manifest.rig.sensor, manifest.folder.name
    if sensor is None:
        raise InputError(manifest.rig_path, "sensor", "nothing", "the [sensor] whose readings stand in the table")
    units, are_loads = _columns(manifest, sensor)
    angle, values = _numbers(manifest, sensor, units, are_loads)
    changing = np.ptp(values, axis=0) > 0.0
    still = [name for name, moves in zip(units, changing, strict=True) if not moves]
    notices = [Notice("warning", f"{', '.join(still)}: every reading is the same, left out", where)] if still else []
    missing = [name for name in sensor.channels if name not in units]
    if missing:
        text = f"{table_path(manifest).name} has no column of {', '.join(missing)}"
        notices.append(Notice("note", text, where))
    channels = tuple(name for name in units if name not in still)
    if not channels:
        raise InputError(table_path(manifest), "", "readings that do not change with the angle", "the sensor's outputs")
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
    """Return the first harmonics of a recording with the axis and the direction of gravity as stated."""
    excitation, fit = recording.manifest.excitation, recording.fit
    axis, down = np.array(excitation.axis), np.array(excitation.zero_gravity)
    return RotationRecord(recording.name, fit.amplitude(), fit.covariance(), fit.dof, axis, down)


def table_path(manifest: Manifest) -> Path:
    """Return the path of the table of readings."""
    if manifest.excitation.file is None:
        raise InputError(manifest.path, "excitation.file", "nothing", "the table of readings")
    return manifest.excitation.file


def _columns(manifest: Manifest, sensor: Sensor) -> tuple[dict[str, str], bool]:
    """Units of the columns that are the sensor's channels, and whether these are loads rather than outputs.

    A column without a unit holds a load where the sensor's outputs are loads, without sensitivities.
    """
    path = table_path(manifest)
    with as_input_error(path):
        units = table_units(path)
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
    spelt = {name: _spelt(units[name]) for name in present}
    bare_is_load = sensor.static_sensitivity is None and _spelt(sensor.unit) in LOAD_UNITS
    loads = [name for name in present if spelt[name] in LOAD_UNITS or (bare_is_load and not spelt[name])]
    if not loads:
        if sensor.static_sensitivity is None:
            expected = "the sensitivities that turn outputs into loads (the inverse of a calibration matrix)"
            raise InputError(manifest.rig_path, "sensor.static_sensitivity", "nothing", f"{expected}, or columns in N")
        return spelt, False
    for name in present:
        if name not in loads:
            expected = f"N or N.m as of {loads[0]}, or outputs throughout"
            raise InputError(path, name, f'the unit "{units[name]}"', expected)
    right = dict(zip(LOAD_COMPONENTS, LOAD_UNITS, strict=True))
    for name in present:
        if name not in right:
            expected = f"one of {', '.join(LOAD_COMPONENTS)}, since columns in N and N.m are loads"
            raise InputError(manifest.rig_path, "sensor.channels", found=f'"{name}"', expected=expected)
        if spelt[name] not in ("", right[name]):
            raise InputError(path, name, found=f'the unit "{spelt[name]}"', expected=right[name])
    return {name: right[name] for name in present}, True


def _spelt(unit: str) -> str:
    """A unit in the spelling of the result files."""
    text = unit.strip()
    for old, new in SPELT:
        text = text.replace(old, new)
    return text


def _numbers(
    manifest: Manifest, sensor: Sensor, units: dict[str, str], are_loads: bool
) -> tuple[FloatArray, FloatArray]:
    """Angles in rad (N,) and readings (N, C), of outputs in the sensor's unit, of loads in N and N·m."""
    path, excitation, names = table_path(manifest), manifest.excitation, [ANGLE, *units]
    with as_input_error(path):
        table = read_table_columns(path, names)
    if not np.isfinite(table).all():
        row, place = (int(i) for i in np.argwhere(~np.isfinite(table))[0])
        raise InputError(path, names[place], found=f"none in row {row + 1}", expected="a number in every row")
    scale, own = np.ones(len(units)), _spelt(sensor.unit)
    for c, (name, unit) in enumerate([] if are_loads else units.items()):
        if "scale" in excitation.model_fields_set or not unit:
            scale[c] = excitation.scale
            continue
        found, wanted = recorded_unit(unit), recorded_unit(sensor.unit)
        factor = None if found is None or wanted is None else found.over(wanted)
        if factor is None and unit != own:
            expected = f'"{sensor.unit}", a multiple of it, N and N.m, or the key scale in recording.toml'
            raise InputError(path, name, found=f'the unit "{unit}"', expected=expected)
        scale[c] = 1.0 if factor is None else factor
    angle = np.radians(table[:, 0]) if excitation.angle_unit == "deg" else table[:, 0]
    return angle, table[:, 1:] * scale
