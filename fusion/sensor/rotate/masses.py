"""From weights to masses and centres of mass: gravity, air and weighed masses with their uncertainties by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fusion.estimation.uncertainty import coverage_factor
from fusion.sensor.rotate.readings import (
    JOINT,
    Carried,
    Quantity,
    Repeats,
    RotationRecording,
    Weighed,
    components,
    load_bodies,
    own_bodies,
    unknown_volume,
)
from shaker.arrays import FloatArray
from shaker.labels import AXES, LOAD_COMPONENTS
from shaker.static_rotation.harmonics import Known
from shaker.static_rotation.masses import FORCES, OWN, ROWS, Source, Turned, WeightFit, mass_of_weight

UNTOLD = "what no channel tells"
LARGEST_UNTOLD = 0.1
"""Share of that in the uncertainty of a number above which the recordings do not tell it."""
PERCENT = 100.0
MEAN_ROWS = np.array([0, *range(OWN, OWN + FORCES), 1, 2, 3])
"""Places of weights and first moment among the numbers of a recording."""


class Head(NamedTuple):
    """What a number is: name for files, label, component, unit, recording."""

    name: str
    label: str
    component: str
    unit: str
    recording: str = ""


@dataclass(frozen=True)
class Campaign:
    """Everything that masses follow from: the weights, and in which recordings which bodies were mounted."""

    recordings: tuple[RotationRecording, ...]
    records: tuple[Turned, ...]
    weights: WeightFit
    gravity: Known
    air: Known

    @cached_property
    def load(self) -> tuple[Weighed, ...]:
        """Return the bodies that make up the load."""
        return load_bodies(self.recordings[0].manifest)

    @cached_property
    def own(self) -> tuple[tuple[Weighed, ...], ...]:
        """Return the bodies that each recording carries beside that."""
        return tuple(own_bodies(recording.manifest) for recording in self.recordings)

    @cached_property
    def bodies(self) -> tuple[Weighed, ...]:
        """Return all bodies, those of the load first, each of them once by its name."""
        return tuple({body.name: body for group in (self.load, *self.own) for body in group}.values())


class Inputs(NamedTuple):
    """Numbers (N,) that masses are computed from, and every cause of error with its effect on them."""

    value: FloatArray
    sources: tuple[Source, ...]


def quantities(campaign: Campaign) -> tuple[Quantity, ...]:
    """Return every number that the recordings tell, each with its uncertainty by cause.

    Derivatives are central differences over one standard uncertainty of every input.
    """
    inputs = _inputs(campaign)
    variants = _Variants(inputs)
    told = list(_derived(campaign, variants.inputs))
    gradient = variants.gradient(np.array([value for _, value in told]))
    parts = []
    for source in inputs.sources:
        variance = np.sum((gradient @ source.effect) ** 2, axis=1)
        parts.append(_Part(source.name, variance, variance, np.full(len(told), source.dof)))
    on_all = np.array([not head.recording for head, _ in told])
    for carried, places in _states(campaign, inputs, variants):
        rows = ROWS * np.array(places)[:, None] + MEAN_ROWS
        for name, component in components(carried, gradient[:, rows].sum(axis=1)):
            in_mean, wide = (np.where(on_all, variance, 0.0) for variance in (component.in_mean, component.wide))
            parts.append(_Part(f"{name} {carried.state}", in_mean, wide, component.dof))
    names = [part.name for part in parts]
    numbers = np.array([part[1:] for part in parts]).T.tolist()
    found = [_quantity(head, float(value[0]), names, *own) for (head, value), own in zip(told, numbers, strict=True)]
    kept = [q for q in found if q.budget.get(UNTOLD, 0.0) <= LARGEST_UNTOLD * q.u]
    return tuple(_with_normalised(kept))


def repeats(campaign: Campaign) -> tuple[Repeats, ...]:
    """Return how much the weights of states that were recorded repeatedly scatter beyond what is stated."""
    inputs = _inputs(campaign)
    weight = np.eye(len(MEAN_ROWS))[0]
    return tuple(carried.repeats(weight) for carried, _ in _states(campaign, inputs, _Variants(inputs)))


class _Part(NamedTuple):
    """One contribution to Q numbers: variances (Q,), and those that tell effective degrees of freedom."""

    name: str
    variance: FloatArray
    wide: FloatArray
    dof: FloatArray


class _Variants:
    """Inputs (N, B) as they are, then one standard uncertainty up, then down, each that is uncertain by itself."""

    def __init__(self, inputs: Inputs) -> None:
        self.u = np.sqrt(sum(np.sum(source.effect**2, axis=1) for source in inputs.sources))
        self.uncertain = np.flatnonzero(self.u > 0.0)
        steps = np.diag(self.u)[:, self.uncertain]
        self.inputs = inputs.value[:, None] + np.hstack([0.0 * steps[:, :1], steps, -steps])

    def gradient(self, values: FloatArray) -> FloatArray:
        """Derivatives (Q, N) of numbers (Q, B)."""
        high, low = np.split(values[:, 1:], 2, axis=1)
        gradient = np.zeros((len(values), len(self.u)))
        gradient[:, self.uncertain] = (high - low) / (2.0 * self.u[self.uncertain])
        return gradient


def _states(campaign: Campaign, inputs: Inputs, variants: _Variants) -> Iterator[tuple[Carried, list[int]]]:
    """What every state that was recorded repeatedly carries beside its own bodies, and which recordings those are."""
    view = _View(campaign, variants.inputs)
    for with_load in (False, True):
        places = _places(campaign, with_load)
        if len(places) < 2:
            continue
        found = np.array([np.vstack(_net(campaign, view, r)) for r in places])
        shape = found.shape[:2]
        gradient = variants.gradient(found.reshape(-1, found.shape[2]))
        effects = tuple((gradient @ source.effect).reshape(*shape, -1) for source in inputs.sources)
        recordings = [campaign.recordings[r] for r in places]
        names, mountings = tuple(r.name for r in recordings), tuple(r.manifest.mounting for r in recordings)
        yield Carried(recordings[0].state, names, mountings, found[:, :, 0], effects), places


def _quantity(
    head: Head,
    value: float,
    names: Sequence[str],
    variances: Sequence[float],
    wide: Sequence[float],
    dof: Sequence[float],
) -> Quantity:
    """One number with its budget; effective degrees of freedom by Welch and Satterthwaite (JCGM 100, G.4)."""
    by_name: dict[str, float] = {}
    for name, variance in zip(names, variances, strict=True):
        by_name[name] = by_name.get(name, 0.0) + variance
    fourth = sum(variance**2 / own for variance, own in zip(wide, dof, strict=True) if variance > 0.0)
    effective = sum(wide) ** 2 / fourth if fourth > 0.0 else np.inf
    budget = {name: float(np.sqrt(variance)) for name, variance in by_name.items() if variance > 0.0}
    u = float(np.sqrt(sum(variances)))
    return Quantity(head.name, head.label, head.component, value, u, effective, head.unit, head.recording, budget)


def _with_normalised(found: Sequence[Quantity]) -> Iterator[Quantity]:
    """All numbers, and behind the load's deviation in kg that over its U: within ±1 the two masses agree."""
    for quantity in found:
        yield quantity
        if quantity.name == "load_mass_deviation" and quantity.u > 0.0:
            value, k = quantity.value / quantity.expanded, coverage_factor(quantity.dof)
            label = "deviation over its U"
            name = "load_mass_normalised_deviation"
            yield Quantity(name, label, quantity.component, value, 1.0 / k, quantity.dof, "1", "", {})


def _inputs(campaign: Campaign) -> Inputs:
    """Numbers of the fit, then gravity, air, volume of the sensor's part, then mass, volume, centre of every body."""
    fit = campaign.weights
    volume, u_volume = unknown_volume()
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
    sources = []
    for source in fit.sources:
        wide = np.vstack([np.nan_to_num(source.effect), np.zeros((len(extra), source.effect.shape[1]))])
        sources.append(source._replace(effect=wide))
    for place, (_, u, name) in enumerate(extra, len(fit.value)):
        if u > 0.0:
            effect = np.zeros((len(value), 1))
            effect[place] = u
            sources.append(Source(name, "B", np.inf, effect))
    return Inputs(value, tuple(sources))


class _View:
    """Inputs (N, B), in B variants at once, by name; every number is an array (B,)."""

    def __init__(self, campaign: Campaign, inputs: FloatArray) -> None:
        start = ROWS * len(campaign.recordings)
        self.fit = inputs[:start].reshape(-1, ROWS, inputs.shape[1])
        self.gravity, self.air, self.volume = inputs[start : start + 3]
        self.body = {body.name: inputs[start + 3 + 5 * i :][:5] for i, body in enumerate(campaign.bodies)}

    def carried(self, bodies: Sequence[Weighed]) -> tuple[FloatArray, FloatArray]:
        """Weight in air N and first moment N·m (3, B) of bodies."""
        weight, moment = np.zeros_like(self.gravity), np.zeros((3, len(self.gravity)))
        for row in (self.body[body.name] for body in bodies):
            own = self.gravity * row[0] * (1.0 - self.air * row[1])
            weight, moment = weight + own, moment + own * row[2:]
        return weight, moment

    def stated(self, bodies: Sequence[Weighed]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mass kg, volume per mass m³/kg and centre of mass m (3, B) of bodies together."""
        rows = np.array([self.body[body.name] for body in bodies])
        mass = rows[:, 0].sum(axis=0)
        volume = np.sum(rows[:, 0] * rows[:, 1], axis=0) / mass
        return mass, volume, np.sum(rows[:, :1] * rows[:, 2:], axis=0) / mass


class _Mean(NamedTuple):
    """Mean over recordings less what each carried: weights N (4, B) joint, Fx, Fy, Fz; first moment N·m (3, B)."""

    weight: FloatArray
    moment: FloatArray


Told = Iterator[tuple[Head, FloatArray]]


def _derived(campaign: Campaign, inputs: FloatArray) -> Told:
    """Every number of the result, in the order of the files."""
    view = _View(campaign, inputs)
    bare, loaded = (_mean(campaign, view, with_load) for with_load in (False, True))
    seen = _seen(campaign)
    if bare is not None:
        yield from _internal(view, bare, seen)
    elif loaded is not None and campaign.load:
        weight, moment = view.carried(campaign.load)
        yield from _internal(view, _Mean(loaded.weight - weight, loaded.moment - moment), seen)
    if bare is not None and loaded is not None:
        yield from _load(campaign, view, _Mean(loaded.weight - bare.weight, loaded.moment - bare.moment), seen)
    for r, recording in enumerate(campaign.recordings):
        yield from _one_recording(campaign, view, r)
        mean = loaded if recording.with_load else bare
        if mean is not None and len(_places(campaign, recording.with_load)) > 1:
            off = _net(campaign, view, r).weight - mean.weight
            for i, component in seen:
                yield Head("weight_deviation", "weight less mean of repeats", component, "N", recording.name), off[i]
    yield Head("gravity", "local gravity", "", "m/s^2"), view.gravity
    yield Head("air_density", "density of the air", "", "kg/m^3"), view.air


def _seen(campaign: Campaign) -> list[tuple[int, str]]:
    """Columns of `_Mean.weight` that every recording has, by component: the joint one, and forces that tell alone."""
    values = campaign.weights.value.reshape(-1, ROWS)[:, OWN:]
    alone = [(1 + i, name) for i, name in enumerate(LOAD_COMPONENTS[:3]) if np.isfinite(values[:, i]).all()]
    return [(0, JOINT), *alone]


def _mean(campaign: Campaign, view: _View, with_load: bool) -> _Mean | None:
    """Mean over the recordings with, or without, load; None where there are none."""
    found = [_net(campaign, view, r) for r in _places(campaign, with_load)]
    if not found:
        return None
    return _Mean(np.mean([net.weight for net in found], axis=0), np.mean([net.moment for net in found], axis=0))


def _places(campaign: Campaign, with_load: bool) -> list[int]:
    """Which recordings are with, or without, load."""
    return [r for r, recording in enumerate(campaign.recordings) if recording.with_load == with_load]


def _net(campaign: Campaign, view: _View, r: int) -> _Mean:
    """What a recording carries beside the bodies that only it has, in the order of `MEAN_ROWS`."""
    weight, moment = view.carried(campaign.own[r])
    return _Mean(view.fit[r, MEAN_ROWS[:-3]] - weight, view.fit[r, MEAN_ROWS[-3:]] - moment)


def _internal(view: _View, mean: _Mean, seen: Sequence[tuple[int, str]]) -> Told:
    """Internal mass and its centre."""
    share = view.air * view.volume
    masses = {name: mass_of_weight(mean.weight[i], view.gravity, share) for i, name in seen}
    yield from _by_component("internal_mass", "internal mass", masses)
    yield from _centre("internal_centre_of_mass", "centre of the internal mass", mean)


def _load(campaign: Campaign, view: _View, mean: _Mean, seen: Sequence[tuple[int, str]]) -> Told:
    """Load mass as the difference of the recordings, its centre, and what was weighed."""
    weighed, volume, centre = view.stated(campaign.load) if campaign.load else (view.air, view.volume, mean.moment)
    masses = {name: mass_of_weight(mean.weight[i], view.gravity, view.air * volume) for i, name in seen}
    yield from _by_component("load_mass", "load mass", masses)
    yield from _centre("load_centre_of_mass", "centre of the load", mean)
    if not campaign.load:
        return
    yield Head("weighed_mass", "weighed mass of the load", "stated", "kg"), weighed
    for name, mass in masses.items():
        yield Head("load_mass_deviation", "load mass less weighed mass", name, "kg"), mass - weighed
        relative = PERCENT * (mass / weighed - 1.0)
        yield Head("load_mass_relative_deviation", "load mass less weighed mass", name, "%"), relative
    for i, axis in enumerate(AXES):
        head = Head("load_centre_of_mass_deviation", "centre of the load less stated centre", axis, "m")
        yield head, mean.moment[i] / mean.weight[0] - centre[i]


def _by_component(name: str, label: str, masses: dict[str, FloatArray]) -> Told:
    """A mass by all forces and by each alone, and how far those are apart."""
    for component, mass in masses.items():
        yield Head(name, label, component, "kg"), mass
    alone = [component for component in masses if component != JOINT]
    if len(alone) == 2:
        first, second = alone
        between = f"{first}-{second}"
        yield Head(f"{name}_difference", f"{label}, axis to axis", between, "kg"), masses[first] - masses[second]
        relative = PERCENT * (masses[first] - masses[second]) / masses[JOINT]
        yield Head(f"{name}_relative_difference", f"{label}, axis to axis", between, "%"), relative


def _centre(name: str, label: str, mean: _Mean) -> Told:
    """Centre of mass from first moment and weight."""
    for i, axis in enumerate(AXES):
        yield Head(name, label, axis, "m"), mean.moment[i] / mean.weight[0]


def _one_recording(campaign: Campaign, view: _View, r: int) -> Told:
    """What belongs to one recording: weights in air, and how the head stood."""
    name, row = campaign.recordings[r].name, view.fit[r]
    yield Head("weight", "weight in air", JOINT, "N", name), row[0]
    finite = np.isfinite(campaign.weights.value.reshape(-1, ROWS)[r, OWN:])
    for i, component in enumerate(LOAD_COMPONENTS[:3]):
        if finite[i]:
            yield Head("weight", "weight in air", component, "N", name), row[OWN + i]
    yield Head("zero_angle", "gravity at angle 0 ahead of its stated direction", "", "rad", name), row[4]
    _, along, across = campaign.records[r].frame
    tilt = np.outer(along, row[5]) + np.outer(across, row[6])
    for i, axis in enumerate(AXES):
        if abs(along[i]) + abs(across[i]) > 0.5:
            yield Head("axis_tilt", "true axis less stated axis", axis, "rad", name), tilt[i]
