"""From weights to masses and centres of mass: gravity, air and weighed masses with their uncertainties by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.coverage import coverage_factor
from fusion.rotate.result import JOINT, Quantity, RotationRecording
from fusion.rotate.surroundings import Weighed, load_bodies, own_bodies, unknown_volume
from shaker.models.gravity import Known
from shaker.models.load_mass import ROWS, Source, WeightFit, mass_of_weight
from shaker.models.turning import FORCES, OWN, Turned

FloatArray = NDArray[np.float64]
AXES = ("x", "y", "z")
FORCE_NAMES = ("Fx", "Fy", "Fz")
UNTOLD = "what no channel tells"
LARGEST_UNTOLD = 0.1
"""Share of that in the uncertainty of a number above which the recordings do not tell it."""
PERCENT = 100.0


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
    u = np.sqrt(sum(np.sum(source.effect**2, axis=1) for source in inputs.sources))
    uncertain = np.flatnonzero(u > 0.0)
    steps = np.diag(u)[:, uncertain]
    told = list(_derived(campaign, inputs.value[:, None] + np.hstack([0.0 * steps[:, :1], steps, -steps])))
    values = np.array([value for _, value in told])
    high, low = np.split(values[:, 1:], 2, axis=1)
    gradient = np.zeros((len(told), len(u)))
    gradient[:, uncertain] = (high - low) / (2.0 * u[uncertain])
    shares = np.array([np.sum((gradient @ source.effect) ** 2, axis=1) for source in inputs.sources]).T
    found = [
        _quantity(head, float(value[0]), inputs.sources, own)
        for (head, value), own in zip(told, shares.tolist(), strict=True)
    ]
    kept = [q for q in found if q.budget.get(UNTOLD, 0.0) <= LARGEST_UNTOLD * q.u]
    return tuple(_with_normalised(kept))


def _quantity(head: Head, value: float, sources: Sequence[Source], variances: Sequence[float]) -> Quantity:
    """One number with its budget; effective degrees of freedom by Welch and Satterthwaite (JCGM 100, G.4)."""
    by_name: dict[str, float] = {}
    for source, variance in zip(sources, variances, strict=True):
        by_name[source.name] = by_name.get(source.name, 0.0) + variance
    total = sum(variances)
    fourth = sum(variance**2 / source.dof for source, variance in zip(sources, variances, strict=True))
    dof = total**2 / fourth if fourth > 0.0 else np.inf
    budget = {name: float(np.sqrt(variance)) for name, variance in by_name.items() if variance > 0.0}
    u = float(np.sqrt(total))
    return Quantity(head.name, head.label, head.component, value, u, dof, head.unit, head.recording, budget)


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
    for r in range(len(campaign.recordings)):
        yield from _one_recording(campaign, view, r)
    yield Head("gravity", "local gravity", "", "m/s^2"), view.gravity
    yield Head("air_density", "density of the air", "", "kg/m^3"), view.air


def _seen(campaign: Campaign) -> list[tuple[int, str]]:
    """Columns of `_Mean.weight` that every recording has, by component: the joint one, and forces that tell alone."""
    values = campaign.weights.value.reshape(-1, ROWS)[:, OWN:]
    alone = [(1 + i, name) for i, name in enumerate(FORCE_NAMES) if np.isfinite(values[:, i]).all()]
    return [(0, JOINT), *alone]


def _mean(campaign: Campaign, view: _View, with_load: bool) -> _Mean | None:
    """Mean over the recordings with, or without, load; None where there are none."""
    weights, moments = [], []
    for r, recording in enumerate(campaign.recordings):
        if recording.with_load == with_load:
            weight, moment = view.carried(campaign.own[r])
            weights.append(view.fit[r, [0, *range(OWN, OWN + FORCES)]] - weight)
            moments.append(view.fit[r, 1:4] - moment)
    return _Mean(np.mean(weights, axis=0), np.mean(moments, axis=0)) if weights else None


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
    for i, component in enumerate(FORCE_NAMES):
        if finite[i]:
            yield Head("weight", "weight in air", component, "N", name), row[OWN + i]
    yield Head("zero_angle", "gravity at angle 0 ahead of its stated direction", "", "rad", name), row[4]
    _, along, across = campaign.records[r].frame
    tilt = np.outer(along, row[5]) + np.outer(across, row[6])
    for i, axis in enumerate(AXES):
        if abs(along[i]) + abs(across[i]) > 0.5:
            yield Head("axis_tilt", "true axis less stated axis", axis, "rad", name), tilt[i]
