"""From recordings of a sensor on an indexing head to masses and centres of mass: tables → harmonics → weights → masses.

Gravity, air and weighed masses enter with their uncertainties by name, each cause of error with its effect on all.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fusion.base import PERCENT, round_to_uncertainty
from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.recording.load import Manifest, check_one_rig
from fusion.sensor.rotate.rotation_readings import (
    JOINT,
    RepeatedResults,
    RotationEvaluation,
    RotationQuantity,
    RotationRecording,
    RotationScatter,
    WeighedBody,
    first_harmonics,
    load_bodies,
    local_gravity,
    read_rotation,
    recording_bodies,
    scatter_components,
    table_path,
    unknown_volume,
)
from shaker.arrays import FloatArray
from shaker.labels import AXES, LOAD_COMPONENTS
from shaker.static_rotation.harmonics import SourcedValue
from shaker.static_rotation.masses import (
    FORCES,
    ROWS,
    UNKNOWNS_PER_RECORD,
    RotationRecord,
    SensorOutputs,
    WeightErrorSource,
    WeightFit,
    fit_weights,
    mass_of_weight,
)
from shakercal._common.notices import Notice

TURNED_AWAY_RAD, TILTED_RAD = np.radians(10.0), np.radians(1.0)
"""Zero angle and tilt of the axis above which the user is told."""


def evaluate_rotation(name: str, manifests: Sequence[Manifest], input_hashes: dict[str, str]) -> RotationEvaluation:
    """Return what recordings of one sensor on the head weigh: tables → harmonics → weights → masses.

    Raises `InputError` for what the user can mend in the files.

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
    recordings, outputs, notices = _read(manifests)
    records = tuple(first_harmonics(recording) for recording in recordings)
    u_angle = max(manifest.excitation.angle_uncertainty for manifest in manifests)
    weights = fit_weights(records, outputs, u_angle)
    campaign = RotationCampaign(recordings, records, weights, gravity, air)
    numbers, again = quantities(campaign), repeats(campaign)
    notices += [*_of_surroundings(manifests[0], gravity, outputs), *_of_mounting(recordings, again)]
    notices += [
        *_of_fit(weights, records),
        *(notice for manifest in manifests for notice in manifest.certificate_notices),
    ]
    for quantity in numbers:
        if quantity.name == "load_mass_normalised_deviation" and abs(quantity.value) > 1.0:
            by, times = quantity.component, f"{abs(quantity.value):.2f} times the U of their difference"
            notices.append(Notice("warning", f"the load mass by {by} and the weighed mass differ by {times}", "load"))
    return RotationEvaluation(
        name=name,
        recordings=recordings,
        outputs=outputs,
        gravity=gravity,
        air=air,
        weights=weights,
        quantities=numbers,
        repeats=again,
        notices=tuple(dict.fromkeys(notices)),
        settings={"gravity": gravity.source, "air_density": air.source},
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _read(manifests: Sequence[Manifest]) -> tuple[tuple[RotationRecording, ...], SensorOutputs, list[Notice]]:
    """All recordings, which must hold the same channels."""
    read = [read_rotation(manifest) for manifest in manifests]
    first, outputs, _ = read[0]
    for recording, _, _ in read[1:]:
        if recording.fit.channels != first.fit.channels or recording.unit != first.unit:
            own, expected = (
                ", ".join(f"{c} {u}".strip() for c, u in zip(r.fit.channels, r.unit, strict=True))
                for r in (recording, first)
            )
            expected = f"{expected}, the channels of {first.name}"
            raise InputError(table_path(recording.manifest), "", found=own, expected=expected)
    return tuple(item[0] for item in read), outputs, [notice for *_, told in read for notice in told]


def _of_surroundings(manifest: Manifest, gravity: SourcedValue, outputs: SensorOutputs) -> Iterator[Notice]:
    value, environment = round_to_uncertainty(gravity.value, 2.0 * gravity.u), manifest.rig.environment
    if environment is None or environment.gravity is None:
        text = f"local gravity is not stated: ({value.value} ± {value.expanded}) m/s² (k = 2), {gravity.source}"
        yield Notice("note", text, "gravity")
    elif gravity.u == 0.0:
        yield Notice("note", "gravity counts as exact, since gravity_uncertainty is not stated", "gravity")
    if not outputs.u.any():
        text = (
            "no uncertainty of the calibration matrix is stated (static_sensitivity_uncertainty): U contains the "
            "scatter of the readings, but not the scale of the sensor"
        )
        yield Notice("warning", text, "sensor")
    for body in load_bodies(manifest):
        if body.u_volume_m3kg > 0.0:
            text = f"density of {body.name} not stated: its buoyancy is that of something between aluminium and steel"
            yield Notice("note", text, "load")


def _of_mounting(recordings: Sequence[RotationRecording], again: Sequence[RotationScatter]) -> Iterator[Notice]:
    """What a missing recording leaves open, and where repeats tell nothing of mounting anew."""
    kinds = {recording.with_load for recording in recordings}
    stated = bool(load_bodies(recordings[0].manifest))
    if kinds == {False}:
        yield Notice("note", "no recording with load: internal mass only", "recordings")
    elif kinds == {True} and stated:
        text = "no recording without load: the internal mass is what the weighed load leaves of the weight"
        yield Notice("note", text, "recordings")
    elif kinds == {True}:
        text = "neither a recording without load nor a weighed load: weights only, which hold load and internal mass"
        yield Notice("warning", text, "recordings")
    elif not stated:
        yield Notice("note", "no [load] in rig.toml: nothing to compare the load mass with", "load")
    for state in again:
        if not state.between_dof:
            text = f"{len(state.recordings)} recordings {state.state} are of one mounting: what mounting anew changes"
            yield Notice("note", f"{text} is not in U", "repeats")


def _of_fit(weights: WeightFit, records: Sequence[RotationRecord]) -> Iterator[Notice]:
    """What the fit says of the head and of the channels."""
    for r, record in enumerate(records):
        row = weights.value[ROWS * r : ROWS * (r + 1)]
        zero, tilt = float(row[4]), float(np.hypot(row[5], row[6]))
        away = f"gravity at angle 0 lies {np.degrees(zero):.1f}° from its stated direction"
        if abs(zero) > np.pi / 2.0:
            text = (
                f"{away}: sense of the sensor or zero_gravity may be the wrong way round; masses and centres do not "
                "depend on it"
            )
            yield Notice("warning", text, record.name)
        elif abs(zero) > TURNED_AWAY_RAD:
            yield Notice("note", f"{away}, which is taken off", record.name)
        if tilt > TILTED_RAD and tilt > 3.0 * float(np.sqrt(weights.covariance[ROWS * r + 5, ROWS * r + 5])):
            text = f"the force along the axis turns with the head as if that were {np.degrees(tilt):.2f}° from the axis"
            yield Notice("note", f"{text} stated, or by cross-talk of the sensor", record.name)
    if weights.departure > 0.0:
        text = (
            "a weight turned about the axis does not explain all channels within their noise and the stated "
            f"calibration: every first harmonic is taken to be uncertain by {100.0 * weights.departure:.2g} % of the "
            "weight more, by which they disagree"
        )
        yield Notice("warning", text, "channels")


# From weights to masses and centres of mass.


UNDETERMINED = "what no channel tells"
MAX_UNDETERMINED_SHARE = 0.1
"""Share of that in the uncertainty of a number above which the recordings do not tell it."""
MEAN_ROWS = np.array([0, *range(UNKNOWNS_PER_RECORD, UNKNOWNS_PER_RECORD + FORCES), 1, 2, 3])
"""Places of weights (joint, by Fx, Fy, Fz) and first moment among the numbers of a recording."""


class QuantityLabel(NamedTuple):
    """What a number is: unit, name for files, label, component, recording."""

    unit: str
    name: str
    label: str
    component: str
    recording: str = ""


@dataclass(frozen=True)
class RotationCampaign:
    """Everything that masses follow from: the weights, and in which recordings which bodies were mounted."""

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
        """Return the bodies that each recording carries beside that."""
        return tuple(recording_bodies(recording.manifest) for recording in self.recordings)

    @cached_property
    def bodies(self) -> tuple[WeighedBody, ...]:
        """Return all bodies, those of the load first, each of them once by its name."""
        return tuple({body.name: body for group in (self.load, *self.recording_bodies) for body in group}.values())

    def recording_indices(self, with_load: bool) -> list[int]:
        """Return which recordings are with, or without, load."""
        return [r for r, recording in enumerate(self.recordings) if recording.with_load == with_load]

    @cached_property
    def single_forces(self) -> list[list[tuple[int, str]]]:
        """Return the forces that tell the weight alone, as (place in `MEAN_ROWS`, name), of every recording."""
        finite = np.isfinite(self.weights.value.reshape(-1, ROWS)[:, UNKNOWNS_PER_RECORD:])
        return [[(1 + i, name) for i, name in enumerate(LOAD_COMPONENTS[:3]) if row[i]] for row in finite]


class _Inputs:
    """Numbers that masses follow from, in B variants at once, by name; every number is an array (B,).

    First as they are, then one standard uncertainty up, then down, each that is uncertain by itself. N numbers: those
    of the fit, gravity, air, volume of the sensor's part, then mass, volume, centre of every body. `sources`: every
    cause of error with its effect on them.
    """

    def __init__(self, campaign: RotationCampaign) -> None:
        fit, (volume, u_volume) = campaign.weights, unknown_volume()
        extra = [
            (campaign.gravity.value, campaign.gravity.u, "local gravity"),
            (campaign.air.value, campaign.air.u, "air density"),
            (volume, u_volume, "density of the sensor's moving part"),
        ]
        for body in campaign.bodies:
            extra.append((body.mass_kg, body.u_mass_kg, "weighed mass"))
            extra.append((body.volume_m3kg, body.u_volume_m3kg, f"density of {body.name}"))
            centre = zip(body.centre_m, body.u_centre_m, strict=True)
            extra += [(float(value), float(u), "stated centre of mass") for value, u in centre]
        value = np.concatenate([np.nan_to_num(fit.value), [item[0] for item in extra]])
        self.sources = []
        for source in fit.sources:
            wide = np.vstack([np.nan_to_num(source.effect), np.zeros((len(extra), source.effect.shape[1]))])
            self.sources.append(source._replace(effect=wide))
        for place, (_, u, name) in enumerate(extra, len(fit.value)):
            if u > 0.0:
                self.sources.append(WeightErrorSource(name, "B", np.inf, u * np.eye(len(value))[:, place : place + 1]))
        self.u = np.sqrt(sum(np.sum(source.effect**2, axis=1) for source in self.sources))
        self.uncertain = np.flatnonzero(self.u > 0.0)
        steps = np.diag(self.u)[:, self.uncertain]
        variants = value[:, None] + np.hstack([0.0 * steps[:, :1], steps, -steps])
        start, self.campaign = ROWS * len(campaign.recordings), campaign
        self.fit = variants[:start].reshape(-1, ROWS, variants.shape[1])
        self.gravity, self.air, self.volume = variants[start : start + 3]
        self.body = {body.name: variants[start + 3 + 5 * i :][:5] for i, body in enumerate(campaign.bodies)}

    def gradient(self, values: FloatArray) -> FloatArray:
        """Derivatives (Q, N) of numbers (Q, B)."""
        high, low = np.split(values[:, 1:], 2, axis=1)
        gradient = np.zeros((len(values), len(self.u)))
        gradient[:, self.uncertain] = (high - low) / (2.0 * self.u[self.uncertain])
        return gradient

    def carried(self, bodies: Sequence[WeighedBody]) -> FloatArray:
        """Weight in air N, for every row of weights, and first moment N·m of bodies, in the order of `MEAN_ROWS`."""
        load = np.zeros((len(MEAN_ROWS), len(self.gravity)))
        for row in (self.body[body.name] for body in bodies):
            weight = self.gravity * row[0] * (1.0 - self.air * row[1])
            load += weight * np.vstack([np.ones_like(load[:-3]), row[2:]])
        return load

    def stated(self, bodies: Sequence[WeighedBody]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mass kg, volume per mass m³/kg and centre of mass m (3, B) of bodies together."""
        rows = np.array([self.body[body.name] for body in bodies])
        mass = rows[:, 0].sum(axis=0)
        volume = np.sum(rows[:, 0] * rows[:, 1], axis=0) / mass
        return mass, volume, np.sum(rows[:, :1] * rows[:, 2:], axis=0) / mass

    def net(self, r: int) -> FloatArray:
        """What a recording carries beside the bodies that only it has, in the order of `MEAN_ROWS`."""
        return np.asarray(self.fit[r, MEAN_ROWS] - self.carried(self.campaign.recording_bodies[r]))

    def mean(self, with_load: bool) -> FloatArray | None:
        """Mean over the recordings with, or without, load; None where there are none."""
        places = self.campaign.recording_indices(with_load)
        return np.mean([self.net(r) for r in places], axis=0) if places else None


def quantities(campaign: RotationCampaign) -> tuple[RotationQuantity, ...]:
    """Return every number that the recordings tell, each with its uncertainty by cause.

    Derivatives are central differences over one standard uncertainty of every input.
    """
    inputs = _Inputs(campaign)
    told = list(_derived(inputs))
    gradient = inputs.gradient(np.array([value for _, value in told]))
    names, parts = [source.name for source in inputs.sources], list[tuple[FloatArray, ...]]()
    for source in inputs.sources:
        variance = np.sum((gradient @ source.effect) ** 2, axis=1)
        parts.append((variance, variance, np.full(len(told), source.dof)))
    on_all = np.array([not head.recording for head, _ in told])
    for carried, places in _states(inputs):
        rows = ROWS * np.array(places)[:, None] + MEAN_ROWS
        for name, component in scatter_components(carried, gradient[:, rows].sum(axis=1)):
            names.append(f"{name} {carried.state}")
            parts.append((*(np.where(on_all, own, 0.0) for own in component[1:3]), component.dof))
    variance, wide, dof = np.array(parts).swapaxes(0, 1)
    # effective degrees of freedom by Welch and Satterthwaite (JCGM 100, G.4)
    fourth = np.sum(np.divide(wide**2, dof, out=np.zeros_like(wide), where=variance > 0.0), axis=0)
    effective = np.divide(wide.sum(axis=0) ** 2, fourth, out=np.full(len(told), np.inf), where=fourth > 0.0)
    numbers = [
        RotationQuantity(float(value[0]), u, own, *head, _budget(names, shares))
        for (head, value), u, own, shares in zip(
            told, np.sqrt(variance.sum(axis=0)).tolist(), effective.tolist(), variance.T.tolist(), strict=True
        )
    ]
    kept = []
    for quantity in numbers:
        if quantity.budget.get(UNDETERMINED, 0.0) > MAX_UNDETERMINED_SHARE * quantity.u:
            continue
        kept.append(quantity)
        if quantity.name == "load_mass_deviation" and quantity.u > 0.0:  # within ±1 the two masses agree
            value, u = quantity.value / quantity.expanded, 1.0 / coverage_factor(quantity.dof)
            head = QuantityLabel("1", "load_mass_normalised_deviation", "deviation over its U", quantity.component)
            kept.append(RotationQuantity(value, u, quantity.dof, *head, {}))
    return tuple(kept)


def _budget(names: Sequence[str], variances: Sequence[float]) -> dict[str, float]:
    """Standard uncertainties by cause, those of one name together, without those that add nothing."""
    by_name = dict.fromkeys(names, 0.0)
    for name, variance in zip(names, variances, strict=True):
        by_name[name] += variance
    return {name: float(np.sqrt(variance)) for name, variance in by_name.items() if variance > 0.0}


def repeats(campaign: RotationCampaign) -> tuple[RotationScatter, ...]:
    """Return how much the weights of states that were recorded repeatedly scatter beyond what is stated."""
    weight = np.eye(len(MEAN_ROWS))[0]
    return tuple(carried.repeats(weight) for carried, _ in _states(_Inputs(campaign)))


def _states(inputs: _Inputs) -> Iterator[tuple[RepeatedResults, list[int]]]:
    """What every state that was recorded repeatedly carries beside its own bodies, and which recordings those are."""
    for with_load in (False, True):
        places = inputs.campaign.recording_indices(with_load)
        if len(places) < 2:
            continue
        net = np.array([inputs.net(r) for r in places])
        gradient = inputs.gradient(net.reshape(-1, net.shape[2]))
        effects = tuple((gradient @ source.effect).reshape(*net.shape[:2], -1) for source in inputs.sources)
        recordings = [inputs.campaign.recordings[r] for r in places]
        names, mountings = tuple(r.name for r in recordings), tuple(r.manifest.mounting for r in recordings)
        yield RepeatedResults(recordings[0].state, names, mountings, net[:, :, 0], effects), places


Told = Iterator[tuple[QuantityLabel, FloatArray]]


def _derived(inputs: _Inputs) -> Told:
    """Every number of the result, in the order of the files."""
    campaign = inputs.campaign
    bare, loaded = (inputs.mean(with_load) for with_load in (False, True))
    # the joint weight, and forces that tell it alone in every recording
    seen = [
        (0, JOINT),
        *(own for own in campaign.single_forces[0] if all(own in others for others in campaign.single_forces)),
    ]
    internal = bare
    if internal is None and loaded is not None and campaign.load:
        internal = loaded - inputs.carried(campaign.load)
    if internal is not None:
        share = inputs.air * inputs.volume
        masses = {name: mass_of_weight(internal[i], inputs.gravity, share) for i, name in seen}
        yield from _by_component("internal_mass", "internal mass", masses)
        yield from _centre("internal_centre_of_mass", "centre of the internal mass", internal)
    if bare is not None and loaded is not None:
        yield from _load(inputs, loaded - bare, seen)
    for r, recording in enumerate(campaign.recordings):
        name, row, net = recording.name, inputs.fit[r], inputs.net(r)
        yield QuantityLabel("N", "weight", "weight in air", JOINT, name), row[0]
        for i, component in campaign.single_forces[r]:
            yield QuantityLabel("N", "weight", "weight in air", component, name), row[UNKNOWNS_PER_RECORD + i - 1]
        yield QuantityLabel("rad", "zero_angle", "gravity at angle 0 ahead of its stated direction", "", name), row[4]
        _, along, across = campaign.records[r].frame
        tilt = np.outer(along, row[5]) + np.outer(across, row[6])
        for i, axis in enumerate(AXES):
            if abs(along[i]) + abs(across[i]) > 0.5:
                yield QuantityLabel("rad", "axis_tilt", "true axis less stated axis", axis, name), tilt[i]
        mean = loaded if recording.with_load else bare
        if mean is not None and len(campaign.recording_indices(recording.with_load)) > 1:
            for i, component in seen:
                head = QuantityLabel("N", "weight_deviation", "weight less mean of repeats", component, name)
                yield head, net[i] - mean[i]
    yield QuantityLabel("m/s^2", "gravity", "local gravity", ""), inputs.gravity
    yield QuantityLabel("kg/m^3", "air_density", "density of the air", ""), inputs.air


def _load(inputs: _Inputs, mean: FloatArray, seen: Sequence[tuple[int, str]]) -> Told:
    """Load mass as the difference of the recordings, its centre, and what was weighed."""
    load = inputs.campaign.load
    weighed, volume, centre = inputs.stated(load) if load else (inputs.air, inputs.volume, mean[-3:])
    masses = {name: mass_of_weight(mean[i], inputs.gravity, inputs.air * volume) for i, name in seen}
    yield from _by_component("load_mass", "load mass", masses)
    yield from _centre("load_centre_of_mass", "centre of the load", mean)
    if not load:
        return
    yield QuantityLabel("kg", "weighed_mass", "weighed mass of the load", "stated"), weighed
    for name, mass in masses.items():
        yield QuantityLabel("kg", "load_mass_deviation", "load mass less weighed mass", name), mass - weighed
        relative = PERCENT * (mass / weighed - 1.0)
        yield QuantityLabel("%", "load_mass_relative_deviation", "load mass less weighed mass", name), relative
    for i, axis in enumerate(AXES):
        head = QuantityLabel("m", "load_centre_of_mass_deviation", "centre of the load less stated centre", axis)
        yield head, mean[i - 3] / mean[0] - centre[i]


def _by_component(name: str, label: str, masses: dict[str, FloatArray]) -> Told:
    """A mass by all forces and by each alone, and how far those are apart."""
    for component, mass in masses.items():
        yield QuantityLabel("kg", name, label, component), mass
    alone = [component for component in masses if component != JOINT]
    if len(alone) == 2:
        first, second = alone
        between = f"{first}-{second}"
        yield (
            QuantityLabel("kg", f"{name}_difference", f"{label}, axis to axis", between),
            masses[first] - masses[second],
        )
        relative = PERCENT * (masses[first] - masses[second]) / masses[JOINT]
        yield QuantityLabel("%", f"{name}_relative_difference", f"{label}, axis to axis", between), relative


def _centre(name: str, label: str, mean: FloatArray) -> Told:
    for i, axis in enumerate(AXES):
        yield QuantityLabel("m", name, label, axis), mean[i - 3] / mean[0]
