"""Recordings of rotation tests: surroundings, bodies, scatter, fits, and the evaluation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from fusion.base import CommandEvaluation
from fusion.campaign.repeats import BETWEEN, WITHIN, nested_anova
from fusion.errors import InputError, as_input_error
from fusion.estimation.coverage import NamedQuantity
from fusion.recording.load import Manifest
from fusion.recording.rig import RigLoad, RigPart, Sensor
from fusion.sensitivity.ratio import StatedMatrix
from fusion.sensor import bench_notices as declared
from fusion.sensor.rotate.rotation_table import (
    RotationTable,
    in_radians,
    orientation_series,
    read_rotation_table,
    wrong_table,
)
from shaker.labels import LOAD_COMPONENTS
from shaker.static_rotation.harmonics import AngleFit, SourcedValue, fit_angles, gravity_at
from shaker.static_rotation.masses import WeightFit
from shaker.static_rotation.orientations import OrientationFit, fit_orientations
from shaker.static_rotation.weight_model import (
    FORCES,
    MIN_FORCE_SHARE,
    TILT_RAD,
    OutputEffect,
    RotationRecord,
    SensorOutputs,
    head_record,
    start_values,
)
from shakercal._common.arrays import BoolArray, FloatArray
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
    """One recording: readings over the angle or in any orientations, and their fit.

    `name`: of its folder. `unit` (C,): of every channel. `load` (N, 6): readings as loads by the inverse (6, C) of the
    calibration matrix, NaN for components that it does not determine. `mounted` (3, 3): x_flange = mounted·x_sensor.
    """

    name: str
    manifest: Manifest
    with_load: bool
    unit: tuple[str, ...]
    fit: AngleFit | OrientationFit
    inverse: FloatArray
    load: FloatArray
    mounted: FloatArray

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


# From tables of readings to outputs per direction of gravity.


def read_rotations(
    manifests: Sequence[Manifest],
) -> tuple[tuple[RotationRecording, ...], SensorOutputs, list[Notice]]:
    """Return recordings with their fits, the channels' calibration, and notices; refuse impossible readings.

    A channel is left out if it is constant in every recording. If it is so in one of them, or the force along the axis
    of a head, its last digit bounds the load.
    """
    sensor, notices = manifests[0].rig.sensor, list[Notice]()
    if sensor is None:
        expected = "[sensor], whose readings are in the table"
        raise InputError(declared.MISSING_ROTATION_ENTRY, manifests[0].rig_path, "sensor", expected=expected)
    tables = [read_rotation_table(manifest, sensor) for manifest in manifests]
    first = tables[0]
    for table in tables[1:]:
        if table.units != first.units:
            found, expected = (", ".join(f"{c} {u}".strip() for c, u in each.units.items()) for each in (table, first))
            raise InputError(
                declared.DIFFERENT_ROTATION_CHANNELS,
                table.path,
                expected=expected,
                recording=first.path.parent.name,
                found=found,
            )
    digits = np.array([table.digit for table in tables])
    digit = np.min(np.where(digits > 0.0, digits, np.inf), axis=0)
    moves = np.any([np.ptp(table.reading, axis=0) > 0.0 for table in tables], axis=0)
    moves |= np.isfinite(digit) & _along_axis(manifests, sensor_outputs(sensor, list(first.units), first.are_loads))
    used = np.array([i for i, moving in enumerate(moves) if moving], np.int64)
    channels, constant = ([name for name, m in zip(first.units, moves, strict=True) if m == of] for of in (True, False))
    missing = [name for name in sensor.channels if name not in first.units]
    for manifest, table in zip(manifests, tables, strict=True):
        where = manifest.folder.name
        if constant:
            notices.append(Notice(declared.CONSTANT_CHANNELS, where, channels=", ".join(constant)))
        if missing:
            named = ", ".join(missing)
            notices.append(Notice(declared.MISSING_CHANNEL_COLUMNS, where, file=table.path.name, channels=named))
    if not channels:
        raise wrong_table(first.path, "", "readings that change with the angle", "constant readings")
    outputs = sensor_outputs(sensor, channels, first.are_loads)
    digit = np.where(np.isfinite(digit), digit, 0.0)[used]
    recordings = [
        _recording(manifest, replace(table, reading=table.reading[:, used]), outputs, tuple(channels), digit)
        for manifest, table in zip(manifests, tables, strict=True)
    ]
    return tuple(recordings), outputs, notices


def sensor_outputs(sensor: Sensor, channels: Sequence[str], are_loads: bool) -> SensorOutputs:
    """Return the stated calibration matrix of some channels with its uncertainty."""
    sense: Literal[1, -1] = 1 if sensor.sense == "on_sensor" else -1
    if are_loads:
        matrix = np.eye(len(LOAD_COMPONENTS))[[LOAD_COMPONENTS.index(name) for name in channels]]
    else:
        matrix = np.array(sensor.static_sensitivity)[[sensor.channels.index(name) for name in channels]]
    u = sensor.static_sensitivity_uncertainty * np.abs(matrix)
    if sensor.cross_talk_uncertainty is not None:
        rated = StatedMatrix.of(sensor).rated
        signal = np.abs(matrix) * rated
        largest = signal.max(axis=1, keepdims=True)
        u = np.where(signal < largest, np.hypot(u, sensor.cross_talk_uncertainty * largest / rated), u)
    return SensorOutputs(matrix, u, sense)


def _along_axis(manifests: Sequence[Manifest], outputs: SensorOutputs) -> BoolArray:
    """Return which outputs (C,) respond mainly to the force along the head's axis."""
    axes = [np.zeros(3) if m.excitation.axis is None else np.array(m.excitation.axis) for m in manifests]
    main = np.argmax(np.abs(outputs.sensitivity[:, :FORCES]), axis=1)
    along = np.min(np.abs(axes), axis=0) > np.sqrt(1.0 - MIN_FORCE_SHARE**2)
    return np.asarray(outputs.forces & along[main])


def _recording(
    manifest: Manifest, table: RotationTable, outputs: SensorOutputs, channels: tuple[str, ...], digit: FloatArray
) -> RotationRecording:
    """Return one recording with its fit."""
    fit: AngleFit | OrientationFit
    mounted = np.eye(3)
    if manifest.excitation.orientation is None:
        with as_input_error(table.path):
            fit = fit_angles(channels, in_radians(manifest, table)[:, 0], table.reading, digit)
    else:
        fit, mounted = _orientation_fit(manifest, table, outputs, channels, digit)
    sensor = manifest.rig.sensor
    recording = RotationRecording(
        name=manifest.folder.name,
        manifest=manifest,
        with_load=bool(manifest.excitation.with_load),
        unit=tuple(table.units[name] if table.are_loads or sensor is None else sensor.unit for name in channels),
        fit=fit,
        inverse=outputs.inverse,
        load=np.where(outputs.determined, fit.reading @ outputs.inverse.T, np.nan),
        mounted=mounted,
    )
    try:
        start_values(gravity_record(recording), outputs)
    except ValueError as error:
        keys = {
            "axis": (manifest.path, "excitation.axis"),
            "orientation": (manifest.path, "excitation.orientation"),
            "sensitivity": (manifest.rig_path, "sensor.channels"),
        }
        file, key = keys.get(str(error).partition(":")[0], (table.path, ""))
        raise InputError.from_exception(error, file, key) from error
    return recording


def _orientation_fit(
    manifest: Manifest, table: RotationTable, outputs: SensorOutputs, channels: tuple[str, ...], digit: FloatArray
) -> tuple[OrientationFit, FloatArray]:
    """Return the fit of readings in any orientations, and the rotation on the flange."""
    excitation = manifest.excitation
    mounted = np.eye(3) if excitation.sensor_in_flange == "fit" else np.array(excitation.sensor_in_flange)
    u_pose, u_down = excitation.orientation_uncertainty, excitation.down_uncertainty
    series = orientation_series(manifest, table, mounted)
    try:
        fit = fit_orientations(channels, series, table.reading, digit, u_pose, u_down)
        if excitation.sensor_in_flange != "fit":
            return fit, mounted
        mounted = mounted_rotation(fit, outputs)
    except ValueError as error:
        raise InputError.from_exception(error, table.path, table.names[0]) from error
    series = orientation_series(manifest, table, mounted)
    return fit_orientations(channels, series, table.reading, digit, u_pose, u_down), mounted


def mounted_rotation(fit: OrientationFit, outputs: SensorOutputs) -> FloatArray:
    """Return the rotation (3, 3) for which forces are along gravity.

    x_flange = R·x_sensor (Kabsch 1976, Acta Cryst. A32, 922).
    """
    if not outputs.determined[:3].all():
        raise ValueError('sensor_in_flange: expected three forces for the rotation "fit", found fewer')
    force = outputs.sense * (outputs.inverse @ fit.coefficient[: fit.axes].T)[:3] @ fit.basis
    left, _, right = np.linalg.svd(force)
    sign = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    return np.asarray((left * sign @ right).T)


def mounted_vectors(mounted: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the rotation vectors (3, B) from sensor to flange.

    `rotation` (3, B): of the true axes against the stated ones.
    """
    from scipy.spatial.transform import Rotation

    return np.asarray((Rotation.from_matrix(mounted) * Rotation.from_rotvec(-rotation.T)).as_rotvec().T)


def gravity_record(recording: RotationRecording) -> RotationRecord:
    """Return the outputs of a recording per direction of gravity, in stated axes."""
    excitation, fit = recording.manifest.excitation, recording.fit
    if isinstance(fit, AngleFit):
        axis, down = np.array(excitation.axis), np.array(excitation.zero_gravity)
        record = head_record(recording.name, fit.amplitude(), fit.covariance(), fit.dof, axis, down)
        bend = (excitation.axis_uncertainty or 0.0) ** 2 / 2.0  # mean of 1 - cos of the inclination
        stated = (OutputEffect("rounding", fit.rounding_effect()),)
        direction, u_length = (1.0 - bend) * record.direction, np.sqrt(2.0) * bend
        return replace(record, direction=direction, u_length=u_length, loop=fit.loop(), stated=stated)
    size = (fit.axes + 1) * len(fit.channels)
    u, free = excitation.sensor_in_flange_uncertainty, excitation.sensor_in_flange == "fit"
    return RotationRecord(
        name=recording.name,
        response=fit.coefficient[: fit.axes],
        covariance=fit.covariance[:size, :size],
        dof=fit.dof,
        direction=fit.basis,
        axis=np.array([0.0, 0.0, 1.0]),
        down=np.array([1.0, 0.0, 0.0]),
        constant=fit.coefficient[fit.axes],
        mean=fit.mean,
        loop=fit.loop,
        u_frame=(u if u is not None and not free else TILT_RAD,) * 3,
        frame_stated=u is not None and not free,
        head=False,
        stated=tuple(OutputEffect(each.name, each.effect[:size]) for each in fit.effects),
    )
