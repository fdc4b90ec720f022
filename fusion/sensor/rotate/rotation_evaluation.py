"""Evaluation of rotation tests: tables → harmonics → weights → masses and centres of mass.

Gravity, air density and weighed masses are named inputs with uncertainty.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fusion.base import PERCENT
from fusion.estimation.coverage import coverage_factor
from fusion.recording.load import Manifest, check_one_rig
from fusion.sensor import bench_notices as declared
from fusion.sensor.rotate.rotation_matrix import force_sensitivity
from fusion.sensor.rotate.rotation_poses import pose_notices
from fusion.sensor.rotate.rotation_readings import (
    JOINT,
    RepeatedResults,
    RotationEvaluation,
    RotationQuantity,
    RotationRecording,
    RotationScatter,
    WeighedBody,
    gravity_record,
    load_bodies,
    local_gravity,
    mounted_vectors,
    read_rotations,
    recording_bodies,
    scatter_components,
    unknown_volume,
)
from shaker.labels import AXES, LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import SourcedValue
from shaker.static_rotation.masses import (
    HYSTERESIS_SOURCE,
    ROWS,
    UNDETERMINED_SOURCE,
    WeightErrorSource,
    WeightFit,
    fit_weights,
    mass_of_weight,
)
from shaker.static_rotation.weight_model import (
    FORCES,
    LOOP_CERTAIN,
    UNKNOWNS_PER_RECORD,
    RotationRecord,
    SensorOutputs,
    rotation_vector,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

ZERO_ANGLE_NOTICE_RAD, AXIS_TILT_NOTICE_RAD = np.radians(10.0), np.radians(1.0)
"""Zero angle and tilt of the axis above which a notice is given: chosen, far above the alignment of a good setup."""


def evaluate_rotation(name: str, manifests: Sequence[Manifest], input_hashes: dict[str, str]) -> RotationEvaluation:
    """Evaluate recordings on an indexing head: tables → harmonics → weights → masses.

    Parameters
    ----------
    name
        Name of the evaluation in the results.
    manifests
        Recordings of kind rotation, of one rig.
    input_hashes
        SHA-256 of the input files by name, for the results.

    Returns
    -------
    RotationEvaluation : masses and centres of mass with their uncertainties.

    Raises
    ------
    InputError : a file or key that the user has to correct.

    Examples
    --------
    >>> import tempfile
    >>> from fusion import evaluate_rotation, load_for_command, simulate_preset
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     manifests = load_for_command([simulate_preset(f"{folder}/turned", "rotation", seed=1)], "rotate")
    ...     evaluation = evaluate_rotation("turned", manifests, {})
    >>> evaluation.name, len(evaluation.recordings)
    ('turned', 2)
    """
    started = time.monotonic()
    for manifest in manifests:
        manifest.check_command("rotate")
    check_one_rig(manifests)
    gravity, air = local_gravity(manifests[0]), manifests[0].rig.surroundings.air
    recordings, outputs, notices = read_rotations(manifests)
    records = tuple(gravity_record(recording) for recording in recordings)
    u_angle = max(manifest.excitation.angle_uncertainty for manifest in manifests)
    weights = fit_weights(records, outputs, u_angle)
    mass_inputs = MassInputs(recordings, records, weights, gravity, air)
    numbers, scatter = quantities(mass_inputs), repeats(mass_inputs)
    tilts = mass_inputs.tilts
    matrix = force_sensitivity(recordings, records, outputs, mass_inputs.load, (gravity, air), tilts)
    numbers += tuple(matrix)
    notices += [*_input_notices(manifests[0], gravity, outputs), *_recording_notices(recordings, scatter)]
    notices += [*_fit_notices(weights, records), *pose_notices(recordings, mass_inputs.tilts)]
    notices += [*_head_notices(recordings, records), *_hysteresis_notices(records, outputs, numbers)]
    notices += [notice for manifest in manifests for notice in manifest.certificate_notices]
    for quantity in numbers:
        if quantity.name == "load_mass_normalised_deviation" and abs(quantity.value) > 1.0:
            notices.append(
                Notice(declared.LOAD_MASS_DEVIATES, "load", component=quantity.component, ratio=abs(quantity.value))
            )
    return RotationEvaluation(
        name=name,
        recordings=recordings,
        outputs=outputs,
        gravity=gravity,
        air=air,
        weights=weights,
        quantities=numbers,
        repeats=scatter,
        notices=tuple(dict.fromkeys(notices)),
        settings={"gravity": gravity.source, "air_density": air.source},
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _input_notices(manifest: Manifest, gravity: SourcedValue, outputs: SensorOutputs) -> Iterator[Notice]:
    """Yield notices on gravity, calibration matrix and bodies."""
    environment = manifest.rig.environment
    if environment is None or environment.gravity is None:
        value, expanded = gravity.value, 2.0 * gravity.u
        yield Notice(
            declared.GRAVITY_FROM_LOCATION, "gravity", gravity_mps2=value, expanded_mps2=expanded, source=gravity.source
        )
    elif gravity.u == 0.0:
        yield Notice(declared.GRAVITY_EXACT, "gravity")
    if not outputs.u.any():
        yield Notice(declared.MATRIX_UNCERTAINTY_NOT_STATED, "sensor")
    for body in load_bodies(manifest):
        if body.u_volume_m3kg > 0.0:
            yield Notice(declared.BODY_DENSITY_NOT_STATED, "load", body=body.name)


def _recording_notices(recordings: Sequence[RotationRecording], scatter: Sequence[RotationScatter]) -> Iterator[Notice]:
    """Yield notices on missing recordings and on states of one mounting."""
    kinds = {recording.with_load for recording in recordings}
    stated = bool(load_bodies(recordings[0].manifest))
    if kinds == {False}:
        yield Notice(declared.NO_LOADED_RECORDING, "recordings")
    elif kinds == {True} and stated:
        yield Notice(declared.NO_UNLOADED_RECORDING, "recordings")
    elif kinds == {True}:
        yield Notice(declared.TOTAL_WEIGHT_ONLY, "recordings")
    elif not stated:
        yield Notice(declared.LOAD_NOT_WEIGHED, "load")
    for state in scatter:
        if not state.between_dof:
            yield Notice(declared.SINGLE_MOUNTING, "repeats", count=len(state.recordings), state=state.state)


def _fit_notices(weights: WeightFit, records: Sequence[RotationRecord]) -> Iterator[Notice]:
    """Yield notices on the axis of the head and the consistency of the channels."""
    for r, record in enumerate(records):
        row = weights.value[ROWS * r : ROWS * (r + 1)]
        if not record.head:
            continue
        zero, tilt = float(row[4]), float(np.hypot(row[5], row[6]))
        if abs(zero) > np.pi / 2.0:
            yield Notice(declared.GRAVITY_REVERSED, record.name, offset_deg=float(np.degrees(zero)))
        elif abs(zero) > ZERO_ANGLE_NOTICE_RAD:
            yield Notice(declared.GRAVITY_OFFSET, record.name, offset_deg=float(np.degrees(zero)))
        if tilt > AXIS_TILT_NOTICE_RAD and tilt > 3.0 * float(np.sqrt(weights.covariance[ROWS * r + 5, ROWS * r + 5])):
            yield Notice(declared.AXIS_TILT, record.name, tilt_deg=float(np.degrees(tilt)))
    if weights.departure > 0.0 or weights.moment_departure > 0.0:
        departures = 100.0 * weights.departure, 100.0 * weights.moment_departure
        yield Notice(
            declared.WEIGHT_NOT_EXPLAINED, "channels", departure_percent=departures[0], moment_percent=departures[1]
        )


def _head_notices(recordings: Sequence[RotationRecording], records: Sequence[RotationRecord]) -> Iterator[Notice]:
    """Yield notices on what the readings of a head do not show."""
    for recording, record in zip(recordings, records, strict=True):
        if record.head and recording.manifest.excitation.axis_uncertainty is None:
            yield Notice(declared.AXIS_INCLINATION_NOT_STATED, "axis")
        if record.head and not record.loop.any():
            yield Notice(declared.ONE_SENSE_OF_ROTATION, record.name)


def _hysteresis_notices(
    records: Sequence[RotationRecord], outputs: SensorOutputs, numbers: Sequence[RotationQuantity]
) -> Iterator[Notice]:
    """Yield notices on hysteresis that is most of a mass's or centre's U."""
    named = [q for q in numbers if q.name.endswith(("_mass", "_centre_of_mass"))]
    if not any(q.budget.get(HYSTERESIS_SOURCE, 0.0) ** 2 > 0.5 * q.u**2 for q in named):
        return
    for record in records:
        for name, kind in (("forces", outputs.forces), ("moments", ~outputs.forces)):
            share = 100.0 * record.loop_share(kind, LOOP_CERTAIN)
            if share > 0.0:
                yield Notice(declared.HYSTERESIS_FOUND, record.name, loop_percent=share, outputs=name)


# From weights to masses and centres of mass.


MAX_UNDETERMINED_SHARE = 0.1
"""Share of `UNDETERMINED_SOURCE` in the u of a number above which the recordings do not determine it."""
WEIGHT_AND_MOMENT_ROWS = np.array([0, *range(UNKNOWNS_PER_RECORD, UNKNOWNS_PER_RECORD + FORCES), 1, 2, 3])
"""Indices of weights (joint, by Fx, Fy, Fz) and first moment among the numbers of a recording."""


class QuantityLabel(NamedTuple):
    """Unit, name in files, label, component and recording of a number."""

    unit: str
    name: str
    label: str
    component: str
    recording: str = ""


@dataclass(frozen=True)
class MassInputs:
    """The inputs of the masses: weights, surroundings, and bodies of each recording."""

    recordings: tuple[RotationRecording, ...]
    records: tuple[RotationRecord, ...]
    weights: WeightFit
    gravity: SourcedValue
    air: SourcedValue

    @cached_property
    def load(self) -> tuple[WeighedBody, ...]:
        """Return the bodies that make up the load."""
        return load_bodies(self.recordings[0].manifest)

    @cached_property
    def recording_bodies(self) -> tuple[tuple[WeighedBody, ...], ...]:
        """Return the bodies of each recording in addition to the load."""
        return tuple(recording_bodies(recording.manifest) for recording in self.recordings)

    @cached_property
    def bodies(self) -> tuple[WeighedBody, ...]:
        """Return all bodies, those of the load first, each of them once by its name."""
        return tuple({body.name: body for group in (self.load, *self.recording_bodies) for body in group}.values())

    def recording_indices(self, with_load: bool) -> list[int]:
        """Return which recordings are with, or without, load."""
        return [r for r, recording in enumerate(self.recordings) if recording.with_load == with_load]

    @cached_property
    def tilts(self) -> FloatArray:
        """Fitted rotations (R, 3) of the true axes against the stated ones, rad."""
        rows = self.weights.value[: ROWS * len(self.recordings)].reshape(-1, ROWS)
        return np.array([rotation_vector(record, row) for record, row in zip(self.records, rows, strict=True)])

    @cached_property
    def single_forces(self) -> list[list[tuple[int, str]]]:
        """Forces that determine each weight individually, as (index in `WEIGHT_AND_MOMENT_ROWS`, name)."""
        rows = self.weights.value[: ROWS * len(self.recordings)].reshape(-1, ROWS)
        finite = np.isfinite(rows[:, UNKNOWNS_PER_RECORD:])
        return [[(1 + i, name) for i, name in enumerate(LOAD_COMPONENTS[:3]) if row[i]] for row in finite]


class _PerturbedInputs:
    """Inputs of the masses in B variants at once.

    Nominal values first, then each uncertain one raised and lowered by its u. There are N numbers: those of the fit,
    gravity, air density, volume of the sensor's moving part, then mass, volume and centre of every body. `sources`:
    every cause of error with its effect on them.
    """

    def __init__(self, mass_inputs: MassInputs) -> None:
        fit, (volume, u_volume) = mass_inputs.weights, unknown_volume()
        extra = [
            (mass_inputs.gravity.value, mass_inputs.gravity.u, "local gravity"),
            (mass_inputs.air.value, mass_inputs.air.u, "air density"),
            (volume, u_volume, "density of the sensor's moving part"),
        ]
        for body in mass_inputs.bodies:
            extra.append((body.mass_kg, body.u_mass_kg, "weighed mass"))
            extra.append((body.volume_m3kg, body.u_volume_m3kg, f"density of {body.name}"))
            centre = zip(body.centre_m, body.u_centre_m, strict=True)
            extra += [(float(value), float(u), "stated centre of mass") for value, u in centre]
        value = np.concatenate([np.nan_to_num(fit.value), [item[0] for item in extra]])
        self.sources = []
        for source in fit.sources:
            wide = np.vstack([np.nan_to_num(source.effect), np.zeros((len(extra), source.effect.shape[1]))])
            self.sources.append(source._replace(effect=wide))
        for index, (_, u, name) in enumerate(extra, len(fit.value)):
            if u > 0.0:
                self.sources.append(WeightErrorSource(name, "B", np.inf, u * np.eye(len(value))[:, index : index + 1]))
        self.u = np.sqrt(sum(np.sum(source.effect**2, axis=1) for source in self.sources))
        self.uncertain = np.flatnonzero(self.u > 0.0)
        steps = np.diag(self.u)[:, self.uncertain]
        variants = value[:, None] + np.hstack([0.0 * steps[:, :1], steps, -steps])
        main, start, self.mass_inputs = ROWS * len(mass_inputs.recordings), len(fit.value), mass_inputs
        self.fit = variants[:main].reshape(-1, ROWS, variants.shape[1])
        self.offset = variants[main:start]
        self.gravity, self.air, self.volume = variants[start : start + 3]
        self.body = {body.name: variants[start + 3 + 5 * i :][:5] for i, body in enumerate(mass_inputs.bodies)}

    def gradient(self, values: FloatArray) -> FloatArray:
        """Return central differences (Q, N) of results (Q, B) by each input."""
        high, low = np.split(values[:, 1:], 2, axis=1)
        gradient = np.zeros((len(values), len(self.u)))
        gradient[:, self.uncertain] = (high - low) / (2.0 * self.u[self.uncertain])
        return gradient

    def weight_and_moment(self, bodies: Sequence[WeighedBody]) -> FloatArray:
        """Return weight (N) and first moment (N·m) of bodies by `WEIGHT_AND_MOMENT_ROWS`."""
        load = np.zeros((len(WEIGHT_AND_MOMENT_ROWS), len(self.gravity)))
        for row in (self.body[body.name] for body in bodies):
            weight = self.gravity * row[0] * (1.0 - self.air * row[1])
            load += weight * np.vstack([np.ones_like(load[:-3]), row[2:]])
        return load

    def mass_volume_centre(self, bodies: Sequence[WeighedBody]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mass (kg), volume per mass (m³/kg) and centre (m) of bodies together."""
        rows = np.array([self.body[body.name] for body in bodies])
        mass = rows[:, 0].sum(axis=0)
        volume = np.sum(rows[:, 0] * rows[:, 1], axis=0) / mass
        return mass, volume, np.sum(rows[:, :1] * rows[:, 2:], axis=0) / mass

    def net(self, r: int) -> FloatArray:
        """Return the load of a recording less its additional bodies, in the order of `WEIGHT_AND_MOMENT_ROWS`."""
        return np.asarray(
            self.fit[r, WEIGHT_AND_MOMENT_ROWS] - self.weight_and_moment(self.mass_inputs.recording_bodies[r])
        )

    def mean(self, with_load: bool) -> FloatArray | None:
        """Return the mean over the recordings with, or without, load; None without any."""
        indices = self.mass_inputs.recording_indices(with_load)
        return np.mean([self.net(r) for r in indices], axis=0) if indices else None


def quantities(mass_inputs: MassInputs) -> tuple[RotationQuantity, ...]:
    """Return every number that the recordings determine, with its uncertainty by cause."""
    inputs = _PerturbedInputs(mass_inputs)
    derived = list(_derived(inputs))
    gradient = inputs.gradient(np.array([value for _, value in derived]))
    names, parts = [source.name for source in inputs.sources], list[tuple[FloatArray, ...]]()
    for source in inputs.sources:
        variance = np.sum((gradient @ source.effect) ** 2, axis=1)
        parts.append((variance, variance, np.full(len(derived), source.dof)))
    on_all = np.array([not head.recording for head, _ in derived])
    for repeated, indices in _states(inputs):
        rows = ROWS * np.array(indices)[:, None] + WEIGHT_AND_MOMENT_ROWS
        for name, component in scatter_components(repeated, gradient[:, rows].sum(axis=1)):
            names.append(f"{name} {repeated.state}")
            parts.append((*(np.where(on_all, part, 0.0) for part in component[1:3]), component.dof))
    variance, wide, dof = np.array(parts).swapaxes(0, 1)
    # effective degrees of freedom by Welch and Satterthwaite (JCGM 100, G.4)
    fourth = np.sum(np.divide(wide**2, dof, out=np.zeros_like(wide), where=variance > 0.0), axis=0)
    effective = np.divide(wide.sum(axis=0) ** 2, fourth, out=np.full(len(derived), np.inf), where=fourth > 0.0)
    numbers = [
        RotationQuantity(float(value[0]), u, number_dof, *head, _budget(names, shares))
        for (head, value), u, number_dof, shares in zip(
            derived, np.sqrt(variance.sum(axis=0)).tolist(), effective.tolist(), variance.T.tolist(), strict=True
        )
    ]
    determined = []
    for quantity in numbers:
        if quantity.budget.get(UNDETERMINED_SOURCE, 0.0) > MAX_UNDETERMINED_SHARE * quantity.u:
            continue
        determined.append(quantity)
        if quantity.name == "load_mass_deviation" and quantity.u > 0.0:  # within ±1 the two masses agree
            value, u = quantity.value / quantity.expanded, 1.0 / coverage_factor(quantity.dof)
            head = QuantityLabel("1", "load_mass_normalised_deviation", "deviation over its U", quantity.component)
            determined.append(RotationQuantity(value, u, quantity.dof, *head, {}))
    return tuple(determined)


def _budget(names: Sequence[str], variances: Sequence[float]) -> dict[str, float]:
    """Return non-zero standard uncertainties by cause; those of one name are combined."""
    by_name = dict.fromkeys(names, 0.0)
    for name, variance in zip(names, variances, strict=True):
        by_name[name] += variance
    return {name: float(np.sqrt(variance)) for name, variance in by_name.items() if variance > 0.0}


def repeats(mass_inputs: MassInputs) -> tuple[RotationScatter, ...]:
    """Return the scatter of the joint weight of repeated states beyond stated uncertainties."""
    weight = np.eye(len(WEIGHT_AND_MOMENT_ROWS))[0]
    return tuple(repeated.repeats(weight) for repeated, _ in _states(_PerturbedInputs(mass_inputs)))


def _states(inputs: _PerturbedInputs) -> Iterator[tuple[RepeatedResults, list[int]]]:
    """Yield the net results of each repeated state, and the indices of its recordings."""
    for with_load in (False, True):
        indices = inputs.mass_inputs.recording_indices(with_load)
        if len(indices) < 2:
            continue
        net = np.array([inputs.net(r) for r in indices])
        gradient = inputs.gradient(net.reshape(-1, net.shape[2]))
        effects = tuple((gradient @ source.effect).reshape(*net.shape[:2], -1) for source in inputs.sources)
        recordings = [inputs.mass_inputs.recordings[r] for r in indices]
        names, mountings = tuple(r.name for r in recordings), tuple(r.manifest.mounting for r in recordings)
        yield RepeatedResults(recordings[0].state, names, mountings, net[:, :, 0], effects), indices


LabelledValues = Iterator[tuple[QuantityLabel, FloatArray]]


def _derived(inputs: _PerturbedInputs) -> LabelledValues:
    """Yield every number of the result, in the order of the files."""
    mass_inputs = inputs.mass_inputs
    bare, loaded = (inputs.mean(with_load) for with_load in (False, True))
    # the joint weight, and forces that determine it individually in every recording
    first, *others = mass_inputs.single_forces
    seen = [(0, JOINT), *(force for force in first if all(force in other for other in others))]
    internal = bare
    if internal is None and loaded is not None and mass_inputs.load:
        internal = loaded - inputs.weight_and_moment(mass_inputs.load)
    if internal is not None:
        share = inputs.air * inputs.volume
        masses = {name: mass_of_weight(internal[i], inputs.gravity, share) for i, name in seen}
        yield from _by_component("internal_mass", "internal mass", masses)
        yield from _centre("internal_centre_of_mass", "centre of the internal mass", internal)
    if bare is not None and loaded is not None:
        yield from _load(inputs, loaded - bare, seen)
    for r, recording in enumerate(mass_inputs.recordings):
        name, row, net = recording.name, inputs.fit[r], inputs.net(r)
        yield QuantityLabel("N", "weight", "weight in air", JOINT, name), row[0]
        for i, component in mass_inputs.single_forces[r]:
            yield QuantityLabel("N", "weight", "weight in air", component, name), row[UNKNOWNS_PER_RECORD + i - 1]
        yield from _frame(inputs, r)
        mean = loaded if recording.with_load else bare
        if mean is not None and len(mass_inputs.recording_indices(recording.with_load)) > 1:
            for i, component in seen:
                head = QuantityLabel("N", "weight_deviation", "weight minus mean of repeats", component, name)
                yield head, net[i] - mean[i]
    yield QuantityLabel("m/s^2", "gravity", "local gravity", ""), inputs.gravity
    yield QuantityLabel("kg/m^3", "air_density", "density of the air", ""), inputs.air


def _frame(inputs: _PerturbedInputs, r: int) -> LabelledValues:
    """Yield how the sensor stood, and of poses its outputs without load."""
    record, recording, row = inputs.mass_inputs.records[r], inputs.mass_inputs.recordings[r], inputs.fit[r]
    name, (along, across) = recording.name, record.frame
    if record.head:
        yield QuantityLabel("rad", "zero_angle", "gravity at angle 0 ahead of its stated direction", "", name), row[4]
        tilt = np.outer(along, row[5]) + np.outer(across, row[6])
        for i, axis in enumerate(AXES):
            if abs(along[i]) + abs(across[i]) > 0.5:
                yield QuantityLabel("rad", "axis_tilt", "true axis minus stated axis", axis, name), tilt[i]
        return
    rotated = np.array([rotation_vector(record, column) for column in row.T]).T
    if recording.manifest.excitation.sensor_in_flange == "fit":
        rotated = mounted_vectors(recording.mounted, rotated)
        labels = ("sensor_in_flange", "rotation vector from sensor to flange")
    else:
        labels = ("frame_tilt", "true axes minus stated axes")
    for axis, angle in zip(AXES, rotated, strict=True):
        yield QuantityLabel("rad", *labels, axis, name), angle
    before = sum(len(each.constant) for each in inputs.mass_inputs.records[:r])
    offset = inputs.offset[before : before + len(record.constant)]
    for i in recording.determined:
        label = QuantityLabel(LOAD_UNITS[i], "offset", "offset", LOAD_COMPONENTS[i], name)
        yield label, recording.inverse[i] @ offset
    for channel, unit, value in zip(recording.fit.channels, recording.unit, offset, strict=True):
        yield QuantityLabel(unit, "output_offset", "output without load", channel, name), value


def _load(inputs: _PerturbedInputs, mean: FloatArray, seen: Sequence[tuple[int, str]]) -> LabelledValues:
    """Yield load mass, its centre, and the weighed mass."""
    load = inputs.mass_inputs.load
    weighed, volume, centre = inputs.mass_volume_centre(load) if load else (inputs.air, inputs.volume, mean[-3:])
    masses = {name: mass_of_weight(mean[i], inputs.gravity, inputs.air * volume) for i, name in seen}
    yield from _by_component("load_mass", "load mass", masses)
    yield from _centre("load_centre_of_mass", "centre of the load", mean)
    if not load:
        return
    yield QuantityLabel("kg", "weighed_mass", "weighed mass of the load", "stated"), weighed
    for name, mass in masses.items():
        yield QuantityLabel("kg", "load_mass_deviation", "load mass minus weighed mass", name), mass - weighed
        relative = PERCENT * (mass / weighed - 1.0)
        yield QuantityLabel("%", "load_mass_relative_deviation", "load mass minus weighed mass", name), relative
    for i, axis in enumerate(AXES):
        head = QuantityLabel("m", "load_centre_of_mass_deviation", "centre of the load minus stated centre", axis)
        yield head, mean[i - 3] / mean[0] - centre[i]


def _by_component(name: str, label: str, masses: dict[str, FloatArray]) -> LabelledValues:
    """Yield a mass by all forces and by each force, and the difference between axes."""
    for component, mass in masses.items():
        yield QuantityLabel("kg", name, label, component), mass
    single = [component for component in masses if component != JOINT]
    if len(single) == 2:
        first, second = single
        label, between = f"{label}, axis to axis", f"{first}-{second}"
        difference = masses[first] - masses[second]
        yield QuantityLabel("kg", f"{name}_difference", label, between), difference
        relative = PERCENT * difference / masses[JOINT]
        yield QuantityLabel("%", f"{name}_relative_difference", label, between), relative


def _centre(name: str, label: str, mean: FloatArray) -> LabelledValues:
    for i, axis in enumerate(AXES):
        yield QuantityLabel("m", name, label, axis), mean[i - 3] / mean[0]
