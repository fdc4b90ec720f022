"""One release read and fitted; what the evaluation of releases consists of; static gains of all outputs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.estimation.coverage import NamedQuantity, RealQuantity
from fusion.recording.load import Manifest
from fusion.recording.rig import Rig
from fusion.sensor.model_files import ModelEntry
from fusion.sensor.step.step_records import (
    AlternativeModels,
    PooledModel,
    StepSettings,
    effective_dof,
    output_entries,
    read_step,
)
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.arrays import FloatArray
from shaker.fitting import REJECT_CHI2, excess_chi2_sigmas
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.indices import Indices, indices
from shaker.lti.system import ModalModel
from shaker.release.reading import ReleaseKind, compare_releases, read_releases
from shaker.release.record import ReleaseReading, ReleaseShape, StepRecord
from shaker.release.step_fit import (
    METHODS,
    Method,
    StepFit,
    describe_difference,
    fit_all_methods,
    fit_shapes,
    merge_alternatives,
)
from shakercal._common.notices import Notice

# What evaluated step responses consist of.

UNNAMED = "not stated"  # what let go where no recording says it


@dataclass(frozen=True)
class StepRelease:
    """One recording: its record, what every output shows, and the model of the driven output.

    `record`: without the uncertainty of the load, which all releases share; `readings`: of the outputs that can be
    read, the driven one `driven` first; `fit`: None where no model was found; `shapes`: it and that of the other shape
    of the release, each as if the other were refuted; `excess`: χ² of the other above that of the first, of all
    releases by the same rope.
    """

    manifest: Manifest
    record: StepRecord
    driven: str
    readings: tuple[ReleaseReading, ...]
    fit: StepFit | None = None
    shapes: tuple[StepFit, ...] = ()
    excess: float = np.inf

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.record.name

    @property
    def reading(self) -> ReleaseReading:
        """What the driven output shows."""
        return self.readings[0]

    @property
    def release_s(self) -> float:
        """How long the load changed: by the fit, else as it was read."""
        return self.reading.release_s if self.fit is None else self.fit.release_s

    @property
    def u_release_s(self) -> float:
        """Standard uncertainty of that."""
        return self.reading.u_release_s if self.fit is None else self.fit.u_release_s

    @property
    def shape(self) -> ReleaseShape:
        """How the load changed: by the fit, else as it was read."""
        return self.reading.shape if self.fit is None else self.fit.shape

    @property
    def structure(self) -> tuple[int, int] | None:
        """Numbers of modes and of real poles of the model, None where it has no modal form."""
        model = None if self.fit is None else self.fit.model
        return None if model is None else (len(model.frequency_hz), len(model.real_hz))


@dataclass(frozen=True)
class StaticGain(RealQuantity):
    """Change of an output over that of the load, mean of all releases of a component.

    `stated`: what rig.toml says, None where it does not, with `u_stated`.
    """

    channel: str
    releases: int
    stated: float | None
    u_stated: float

    @property
    def normalised(self) -> float | None:
        """Return the difference from the stated value over its expanded uncertainty, None where nothing is stated."""
        if self.stated is None:
            return None
        spread = float(np.hypot(self.expanded, 2.0 * self.u_stated))
        return (self.value - self.stated) / spread if spread > 0.0 else None


@dataclass(frozen=True)
class ReleaseDevice:
    """Releases by one thing: how fast and how repeatable they are, and whether the model rests on them.

    `kind`: rise of the driven output, and how long the load changed, by the models where there are.
    """

    kind: ReleaseKind
    releases: tuple[str, ...]
    used: bool

    @property
    def name(self) -> str:
        """What let go."""
        return self.kind.release or UNNAMED


@dataclass(frozen=True)
class MethodRow:
    """What one method made of one release: its model's main figures, fit and time, or why there is none."""

    fit: StepFit
    indices: Indices | None
    recording: str


@dataclass(frozen=True)
class StepComponent:
    """Everything found of one load component.

    `channel`: the output that is driven; `releases` of all ropes, `used` of them in the model `pooled`, for the
    `reason`; `parameters`, `figures`: its numbers, `figures` its indices; `gains`: static gain of every output, the
    driven one first; `ropes` from the fastest to the slowest; `methods`: what each method made of one release. `unit`:
    of output over load. `entry`: what models.json holds. `budget`: standard uncertainty of each index by cause;
    `beside`: what is known beside the records. What rests on a model is None or empty where none was found.
    """

    component: str
    channel: str
    unit: str
    releases: tuple[StepRelease, ...]
    used: tuple[str, ...]
    reason: str
    gains: tuple[StaticGain, ...]
    ropes: tuple[ReleaseDevice, ...]
    methods: tuple[MethodRow, ...]
    pooled: PooledModel | None = None
    parameters: tuple[NamedQuantity, ...] = ()
    figures: tuple[NamedQuantity, ...] = ()
    entry: ModelEntry | None = None
    budget: dict[str, dict[str, float]] = field(default_factory=dict)
    influences: ModelInfluences = NO_INFLUENCES

    @property
    def chosen(self) -> tuple[StepRelease, ...]:
        """The releases that the model rests on."""
        return tuple(release for release in self.releases if release.name in self.used)

    @property
    def scope(self) -> str:
        """Return over what U of the model holds, in words; empty without a model."""
        return "" if self.entry is None else self.entry.scope

    def find(self, name: str) -> NamedQuantity | None:
        """Return an index by its name, None where there is none."""
        return next((one for one in self.figures if one.name == name), None)


@dataclass(frozen=True)
class StepEvaluation(CommandEvaluation):
    """All releases of one sensor, one result per load component."""

    rig: Rig
    components: tuple[StepComponent, ...]


FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError)  # what an identification raises where it finds no model


# One recording: what its outputs show, which of them is driven, and the model of that.

CLEAR = 4.0  # change of the driven output, over its standard uncertainty, below which there is no step


def read_recording(manifest: Manifest) -> tuple[StepRelease, tuple[Notice, ...]]:
    """Return a recording with the readings of its outputs, not fitted yet.

    Raises `InputError` for a record without a step in the driven output, and for one that was clipped.
    """
    source = read_step(manifest)
    record, sensor = replace(source.record, u_amplitude=0.0), manifest.rig.sensor
    name = record.component
    if name not in record.channels:  # of outputs named otherwise the one that changes most
        if sensor is not None and name in sensor.channels:
            expected = f"the output {name}, the component that is driven"
            raise InputError(manifest.path, "daq.channel", found=", ".join(record.channels), expected=expected)
        size = max(1, record.samples.shape[1] // 20)
        change = record.samples[:, -size:].mean(axis=1) - record.samples[:, :size].mean(axis=1)
        name = record.channels[int(np.argmax(np.abs(change)))]
    try:
        readings = {reading.channel: reading for reading in read_releases(record)}
    except ValueError as error:
        key = "daq.channel" if record.onset_s is None else "excitation.onset"
        raise InputError.from_exception(error, manifest.path, key) from error
    driven, key = readings.pop(name), f"daq.channel.{output_entries(manifest)[name][1].name}"
    if driven.clipped:
        told, expected = "samples that stay at the limit of the range", "an output that was not clipped"
        raise InputError(manifest.path, key, found=told, expected=expected)
    if abs(driven.static_gain) <= CLEAR * driven.u_static_gain:
        told = f"a change of {driven.steady - driven.baseline:.2g} {driven.unit}, no more than noise"
        expected = f"a step in the output that {driven.component} drives"
        raise InputError(manifest.path, key, found=told, expected=expected)
    cut = [f"output {other.channel} was clipped and is left out" for other in readings.values() if other.clipped]
    notices = [
        *(Notice("warning", text, record.name) for text in cut),
        *(Notice(notice.severity, f"{name}: {notice.text}", record.name) for notice in driven.notices),
    ]
    others = [reading for reading in readings.values() if not reading.clipped]
    return StepRelease(manifest, record, name, (driven, *others)), (*source.notices, *notices)


def fit_release(
    release: StepRelease, settings: StepSettings, structure: tuple[int, int] | None = None
) -> tuple[StepRelease, tuple[Notice, ...]]:
    """Return a release with its model, of a given structure (modes, real poles) where that is given.

    Without one where none is found: then a notice says why.
    """
    modes, real_poles = structure or (settings.modes, settings.real_poles)
    try:
        shapes = fit_shapes(
            release.record,
            release.driven,
            release.reading,
            modes,
            real_poles,
            "arx" if settings.method == "arx" else "pencil",
            None if settings.release == "auto" else settings.release,
        )
    except FAILURES as error:
        return release, (Notice("warning", f"no model of {release.driven} was found: {error}", release.name),)
    return replace(release, fit=merge_alternatives(shapes), shapes=shapes), ()


# A rope lets go in one way, which its releases tell together.


def fit_common_shape(releases: Sequence[StepRelease]) -> tuple[StepRelease, ...]:
    """Return releases with the models of that shape which all by the same rope make the likeliest."""
    total = defaultdict[tuple[str, str], float](float)
    for release in releases:
        for fit in release.shapes:
            total[release.record.release, fit.shape] += fit.excess

    def settled(release: StepRelease) -> StepRelease:
        if len(release.shapes) < 2:
            return release
        by_rope = {fit.shape: total[release.record.release, fit.shape] for fit in release.shapes}
        shapes = tuple(sorted(release.shapes, key=lambda fit: by_rope[fit.shape]))
        excess = by_rope[shapes[1].shape] - by_rope[shapes[0].shape]
        return replace(release, fit=merge_alternatives(shapes, excess), shapes=shapes, excess=excess)

    return tuple(map(settled, releases))


def alternative_shapes(releases: Sequence[StepRelease]) -> Iterator[tuple[AlternativeModels, str]]:
    """Yield the models of all releases if those of one rope went in the other shape, where these do not refute it.

    With what that would mean, in words, "" where it is little.
    """
    for rope in dict.fromkeys(release.record.release for release in releases if release.excess < REJECT_CHI2):
        mine = [release.record.release == rope and release.excess < REJECT_CHI2 for release in releases]
        models = [release.shapes[int(own)].model for release, own in zip(releases, mine, strict=True)]
        one = releases[mine.index(True)]
        means = describe_difference(one.shapes[0], one.shapes[1])
        text = f"releases by {rope or UNNAMED} do not tell whether the load goes along {means}" if means else ""
        yield AlternativeModels([model for model in models if model is not None], excess_chi2_sigmas(one.excess)), text


# Which releases of a component make its model, and of which structure.

LONGEST_RELEASE = 0.5
"""Periods of the first mode that a release may last for its rope to be used beside the fastest one."""


def choose_releases(releases: Sequence[StepRelease]) -> tuple[tuple[StepRelease, ...], str]:
    """Return the releases of the fastest rope, and of others that last half a period of the first mode; and why these.

    A load that changes for the time T drives a mode at f by sin(πfT)/(πfT) of what a step would: from half a period on,
    0.64, the model depends on how the load changed meanwhile, which is known of no rope.
    """
    models = [(r, r.fit.model) for r in releases if r.fit is not None and r.fit.model is not None]
    if not models:
        return (), "no release could be fitted"
    ropes = defaultdict[str, list[tuple[StepRelease, ModalModel]]](list)
    for release, model in models:
        ropes[release.record.release].append((release, model))
    length = {rope: float(np.median([r.release_s for r, _ in own])) for rope, own in ropes.items()}
    fastest = min(length, key=lambda rope: length[rope])
    lowest = [float(model.frequency_hz.min()) for _, model in ropes[fastest] if len(model.frequency_hz)]
    first_mode_hz = float(np.median(lowest)) if lowest else 0.0
    periods = {rope: length[rope] * first_mode_hz for rope in ropes}
    kept = [rope for rope in ropes if rope == fastest or periods[rope] <= LONGEST_RELEASE]
    chosen = tuple(release for release, _ in models if release.record.release in kept)
    if len(ropes) == 1:
        return chosen, "all releases"
    by = ", ".join(rope or UNNAMED for rope in kept)
    others = ", ".join(f"{rope or UNNAMED} {periods[rope]:.2g}" for rope in ropes if rope not in kept)
    if not others:
        return chosen, f"releases by {by}: each lasts at most half a period of the first mode"
    why = "the fastest" if len(kept) == 1 else "at most half a period of the first mode"
    return chosen, f"releases by {by}, {why} ({periods[fastest]:.2g} periods; left out: {others} periods)"


def common_structure(releases: Sequence[StepRelease]) -> tuple[int, int]:
    """Return the number of modes that most models have, and the largest number of real poles among these.

    A real pole far above the modes shows in few releases; one that has it tells of it, one that has not is silent.
    """
    structures = [release.structure for release in releases if release.structure is not None]
    counts = Counter(modes for modes, _ in structures)
    modes = max(counts, key=lambda number: (counts[number], number))
    return modes, max(reals for number, reals in structures if number == modes)


# The releases of a component fitted, and those that make its model brought to one structure.


class FittedReleases(NamedTuple):
    """The releases of one component with their models, those that make its model, and why these.

    `notices`: what could not be fitted, or had to be fitted anew; `anew`: names of these.
    """

    releases: tuple[StepRelease, ...]
    chosen: tuple[StepRelease, ...]
    reason: str
    notices: tuple[Notice, ...]
    refitted: tuple[str, ...] = ()


def fit_component(releases: Sequence[StepRelease], settings: StepSettings) -> FittedReleases:
    """Fit all releases of a component, and choose those that make its model.

    Chosen releases whose models have another structure than most are fitted anew; what cannot be fitted so is left out.
    """
    fits, told = zip(*(fit_release(release, settings) for release in releases), strict=True)
    own, notices = fit_common_shape(fits), [*chain.from_iterable(told)]
    chosen, reason = choose_releases(own)
    if not chosen:
        return FittedReleases(own, (), reason, tuple(notices))
    wanted = common_structure(chosen)
    counted = zip(wanted, ("mode", "real pole"), strict=True)
    text = " and ".join(f"{count or 'no'} {what}{'' if count == 1 else 's'}" for count, what in counted)
    text = f"{text}, as others show"
    alike, anew = dict[str, StepRelease](), list[str]()
    for release in chosen:
        again = release
        if release.structure != wanted:
            again, _ = fit_release(replace(release, fit=None, shapes=()), settings, wanted)
            if again.structure != wanted:
                notices.append(Notice("warning", f"{release.driven}: left out, no model with {text}", release.name))
                continue
            anew.append(release.name)
        alike[release.name] = again
    if anew:
        notices.append(Notice("note", f"fitted anew with {text}", ", ".join(anew)))
    used = {release.name: release for release in fit_common_shape([*alike.values()])}
    everything = tuple(used.get(release.name, release) for release in own)
    return FittedReleases(everything, tuple(used.values()), reason, tuple(notices), tuple(anew))


# What different methods make of one release.

SEED = 1  # of the generator that draws the first generation of differential evolution
LABELS: dict[Method, str] = {
    "pencil": "matrix pencil, output error",
    "arx": "instrumental-variable ARX, output error",
    "sim": "SIM, Tustin",
    "sim_zoh": "SIM, zero-order hold",
    "evolution": "differential evolution on modes",
    "evolution_coefficients": "differential evolution on coefficients",
}


def compare_methods(
    release: StepRelease, settings: StepSettings, available: Sequence[StepFit] = ()
) -> tuple[tuple[MethodRow, ...], tuple[Notice, ...]]:
    """Return what every method makes of a release; a notice says which of them finds nothing, and what each remarks.

    `known`: what methods have made of it already, by the same rules.
    """
    rng, rows, notices = np.random.default_rng(SEED), list[MethodRow](), list[Notice]()
    by = partial(fit_all_methods, release.record, release.driven, rng=rng, reading=release.reading)
    made = {fit.method: fit for fit in available}
    for method in METHODS:
        try:
            fit = made.get(method) or by(methods=(method,), modes=settings.modes, real_poles=settings.real_poles)[0]
        except FAILURES as error:
            notices.append(Notice("note", f"{LABELS[method]}: no model ({error})", release.name))
            continue
        rows.append(method_row(fit, release.name))
        notices += [Notice("note", f"{LABELS[method]}: {n.text}", release.name) for n in fit.notices]
    return tuple(rows), tuple(notices)


def method_row(fit: StepFit, recording: str) -> MethodRow:
    """Return a fit with the indices of its system, none where it has none."""
    try:
        with np.errstate(all="ignore"):
            return MethodRow(fit, indices(fit.system, sample_rate_hz=fit.sample_rate_hz), recording)
    except FAILURES:
        return MethodRow(fit, None, recording)


# Static gains of every output, and what releases by different ropes have in common.


def static_gains(releases: Sequence[StepRelease], unit: str) -> Iterator[StaticGain]:
    """Yield the static gain of every output, in `unit`, for the load of some releases, the driven output first.

    The mean of the releases by weight 1/u²; where they scatter by more than is stated of each, u is that of the
    scatter, with its degrees of freedom. The load's and the output's scale err for all releases alike.
    """
    manifest, component = releases[0].manifest, releases[0].record.component
    for channel in dict.fromkeys(reading.channel for release in releases for reading in release.readings):
        own = [reading for release in releases for reading in release.readings if reading.channel == channel]
        value, u = [reading.static_gain for reading in own], [reading.u_static_gain for reading in own]
        mean, u_mean, dof = mean_with_scatter(np.array(value), np.array(u))
        total = float(np.hypot(u_mean, abs(mean) * scale_uncertainty(manifest, channel)))
        wide = dof * (total / u_mean) ** 4 if np.isfinite(dof) and u_mean > 0.0 else dof
        stated = stated_gain(manifest, channel, component)
        yield StaticGain(mean, total, float(wide), unit, channel, len(own), *stated)


def mean_with_scatter(value: FloatArray, u: FloatArray) -> tuple[float, float, float]:
    """Return the weighted mean of values (N,) with u (N,), its u and degrees of freedom.

    u² is that of the weights times χ²/(N - 1) where this is above 1 (Birge's ratio), with the degrees of freedom of
    `effective_dof`.
    """
    if not np.all(u > 0.0):
        u = np.ones(len(value))
    weight = 1.0 / u**2
    mean = float(weight @ value / weight.sum())
    stated = 1.0 / float(weight.sum())
    freedom = len(value) - 1
    ratio = float(weight @ (value - mean) ** 2) / freedom if freedom else 0.0
    if ratio <= 1.0:
        return mean, stated**0.5, float(np.inf)
    part = stated * (ratio - 1.0 if freedom == 1 else ratio)
    dof = effective_dof(np.array([stated * ratio]), np.array([part]), freedom)
    return mean, (stated * ratio) ** 0.5, float(dof[0])


def scale_uncertainty(manifest: Manifest, channel: str) -> float:
    """Return the relative standard uncertainty of output over load that all releases share: of both scales."""
    _, entry = output_entries(manifest)[channel]
    parts = (manifest.excitation.step_uncertainty, entry.scale_uncertainty, entry.individual_uncertainty)
    return float(np.sqrt(np.sum(np.square(parts))))


def stated_gain(manifest: Manifest, channel: str, component: str) -> tuple[float | None, float]:
    """Return the static sensitivity that rig.toml states for an output and a component, None without, and its u."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.static_sensitivity is None or channel not in sensor.channels:
        return None, 0.0
    value = float(sensor.static_sensitivity[sensor.channels.index(channel)][LOAD_COMPONENTS.index(component)])
    return value, abs(value) * sensor.static_sensitivity_uncertainty


def group_by_device(releases: Sequence[StepRelease], used: Sequence[str]) -> tuple[ReleaseDevice, ...]:
    """Return the releases by what let go, the fastest rise first; how long the load changed is told by the models.

    By how much that would be otherwise in the other shape, all releases by one rope share.
    """
    readings = []
    for release in releases:
        timed = release.shapes[0] if release.shapes else release.reading
        readings.append(replace(release.reading, release_s=timed.release_s, u_release_s=timed.u_release_s))
    ropes = []
    for kind in compare_releases(readings):
        own = [release for release in releases if release.record.release == kind.release]
        names = tuple(release.name for release in own)
        apart = [
            (r.shapes[1].release_s - r.release_s) / excess_chi2_sigmas(r.excess) for r in own if r.excess < REJECT_CHI2
        ]
        u_mean = float(np.hypot(kind.length.u_mean, sum(apart) / len(own)))
        shown = replace(kind, length=replace(kind.length, u_mean=u_mean))
        ropes.append(ReleaseDevice(shown, names, not set(used).isdisjoint(names)))
    return tuple(ropes)
