"""One release read and fitted; what the evaluation of releases consists of; static gains of all outputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.base import InputError
from fusion.estimation.uncertainty import coverage_factor
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Sensor
from fusion.sensor.models_file import ModelEntry
from fusion.sensor.step.records import Figure, Pooled, StepInput, StepSettings, effective_dof, read_step
from shaker.arrays import FloatArray, Notice
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.indices import Indices, indices
from shaker.release.fit import METHODS, compare, fit_step
from shaker.release.reading import ReleaseKind, compare_releases, read_releases
from shaker.release.record import Reading, StepRecord
from shaker.release.sim import Method, StepFit

# What evaluated step responses consist of.


UNNAMED = "not stated"
"""What let go where no recording says it."""


@dataclass(frozen=True)
class Release:
    """One recording: its record, what every output shows, and the model of the driven output.

    `readings`: of the outputs that can be read, the driven one `driven` first; `fit`: None where no model was found.
    """

    input: StepInput
    driven: str
    readings: tuple[Reading, ...]
    fit: StepFit | None

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.input.record.name

    @property
    def reading(self) -> Reading:
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


@dataclass(frozen=True)
class StaticGain:
    """Change of an output over that of the load, mean of all releases of a component.

    `u` with `dof` degrees of freedom; `stated`: what rig.toml says, None where it does not, with `u_stated`.
    """

    channel: str
    value: float
    u: float
    dof: float
    releases: int
    stated: float | None
    u_stated: float

    @property
    def k(self) -> float:
        """Return the coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> float:
        """Return U = k·u."""
        return self.k * self.u

    @property
    def normalised(self) -> float | None:
        """Return the difference from the stated value over its expanded uncertainty, None where nothing is stated."""
        if self.stated is None:
            return None
        spread = float(np.hypot(self.expanded, 2.0 * self.u_stated))
        return (self.value - self.stated) / spread if spread > 0.0 else None


@dataclass(frozen=True)
class Rope:
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
class ComponentResult:
    """Everything found of one load component.

    `channel`: the output that is driven; `releases` of all ropes, `used` of them in the model `pooled`, for the
    `reason`; `parameters`, `figures`: its numbers; `gains`: static gain of every output, the driven one first; `ropes`
    from the fastest to the slowest; `methods`: what each method made of one release. `unit`: of output over load.
    `entry`: what models.json holds. All that rests on a model is None or empty where none was found.
    """

    component: str
    channel: str
    unit: str
    releases: tuple[Release, ...]
    used: tuple[str, ...]
    reason: str
    pooled: Pooled | None
    parameters: tuple[Figure, ...]
    indices: Indices | None
    figures: tuple[Figure, ...]
    gains: tuple[StaticGain, ...]
    ropes: tuple[Rope, ...]
    methods: tuple[MethodRow, ...]
    entry: ModelEntry | None

    @property
    def chosen(self) -> tuple[Release, ...]:
        """The releases that the model rests on."""
        return tuple(release for release in self.releases if release.name in self.used)

    def figure(self, name: str) -> Figure | None:
        """Return a number by its name, None where there is none."""
        return next((one for one in (*self.parameters, *self.figures) if one.name == name), None)


@dataclass(frozen=True)
class StepEvaluation:
    """All releases of one sensor, one result per load component, notices and origin."""

    name: str
    rig: str
    sensor: Sensor | None
    components: tuple[ComponentResult, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float


# One recording: what its outputs show, which of them is driven, and the model of that.


CLEAR = 4.0
"""Change of the driven output, over its standard uncertainty, below which there is no step."""


def read_recording(manifest: Manifest) -> tuple[Release, tuple[Notice, ...]]:
    """Return a recording with the readings of its outputs, not fitted yet.

    Raises `InputError` for a record without a step in the driven output, and for one that was clipped.
    """
    found = read_step(manifest)
    record = replace(found.record, u_amplitude=0.0)
    driven = _driven(manifest, record)
    readings = {reading.channel: reading for reading in _read(manifest, record)}
    _check(manifest, readings[driven])
    others = [reading for reading in readings.values() if reading.channel != driven and not reading.clipped]
    cut = [reading.channel for reading in readings.values() if reading.channel != driven and reading.clipped]
    told = [Notice("warning", f"output {channel} was clipped and is left out", record.name) for channel in cut]
    release = Release(found, driven, (readings[driven], *others), None)
    return release, (*found.notices, *told, *_remarks(readings[driven], record))


def fit_release(
    release: Release, settings: StepSettings, structure: tuple[int, int] | None = None
) -> tuple[Release, tuple[Notice, ...]]:
    """Return a release with its model, of a given structure (modes, real poles) where that is given.

    Without one where none is found: then a notice says why.
    """
    modes, real_poles = structure or (settings.modes, settings.real_poles)
    record = replace(release.input.record, u_amplitude=0.0)
    try:
        fit = fit_step(
            record,
            release.driven,
            reading=release.reading,
            modes=modes,
            real_poles=real_poles,
            method="arx" if settings.method == "arx" else "pencil",
            release=None if settings.release == "auto" else settings.release,
        )
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return release, (Notice("warning", f"no model of {release.driven} was found: {error}", release.name),)
    return replace(release, fit=fit), ()


def structure_of(fit: StepFit) -> tuple[int, int] | None:
    """Return the numbers of modes and of real poles of a model, None where it has no modal form."""
    return None if fit.model is None else (len(fit.model.frequency_hz), len(fit.model.real_hz))


def _driven(manifest: Manifest, record: StepRecord) -> str:
    """The output of the driven component: the one of its name, of outputs named otherwise the one that changes most."""
    if record.component in record.channels:
        return record.component
    sensor = manifest.rig.sensor
    if sensor is not None and record.component in sensor.channels:
        expected = f"the output {record.component}, the component that is driven"
        raise InputError(manifest.path, "daq.channel", found=", ".join(record.channels), expected=expected)
    size = max(1, record.samples.shape[1] // 20)
    change = record.samples[:, -size:].mean(axis=1) - record.samples[:, :size].mean(axis=1)
    return record.channels[int(np.argmax(np.abs(change)))]


def _read(manifest: Manifest, record: StepRecord) -> tuple[Reading, ...]:
    """What the outputs show; without a step the recording cannot be used."""
    try:
        return read_releases(record)
    except ValueError as error:
        key = "daq.channel" if record.onset_s is None else "excitation.onset"
        raise InputError.told_by(error, manifest.path, key) from error


def _check(manifest: Manifest, reading: Reading) -> None:
    """Refuse a driven output that was clipped, or that does not change."""
    entries = [entry for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    entry = next(entry for entry in entries if reading.channel == (entry.channel or entry.name))
    key = f"daq.channel.{entry.name}"
    if reading.clipped:
        found, expected = "samples that stay at the limit of the range", "an output that was not clipped"
        raise InputError(manifest.path, key, found=found, expected=expected)
    if abs(reading.static_gain) <= CLEAR * reading.u_static_gain:
        change = f"{reading.steady - reading.baseline:.2g} {reading.unit}, no more than noise"
        expected = f"a step in the output that {reading.component} drives"
        raise InputError(manifest.path, key, found=f"a change of {change}", expected=expected)


def _remarks(reading: Reading, record: StepRecord) -> Sequence[Notice]:
    """The remarks of a reading, with the recording they belong to."""
    return [Notice(n.severity, f"{reading.channel}: {n.text}", record.name) for n in reading.notices]


# Which releases of a component make its model, and of which structure.


LONGEST_RELEASE = 0.5
"""Periods of the first mode that a release may last for its rope to be used beside the fastest one."""


class Chosen(NamedTuple):
    """Releases that make a model, and why these."""

    releases: tuple[Release, ...]
    reason: str


def choose_releases(releases: Sequence[Release]) -> Chosen:
    """Return the releases of the fastest rope, and of others whose release lasts half a period of the first mode.

    A load that changes for the time T drives a mode at f by sin(πfT)/(πfT) of what a step would: from half a period on,
    0.64, the model depends on how the load changed meanwhile, which is known of no rope.
    """
    fitted = [release for release in releases if release.fit is not None and release.fit.model is not None]
    if not fitted:
        return Chosen((), "no release could be fitted")
    names = dict.fromkeys(release.input.record.release for release in fitted)
    length = {name: _middle([r.release_s for r in fitted if r.input.record.release == name]) for name in names}
    fastest = min(names, key=lambda name: length[name])
    periods = {name: length[name] * _first_mode_hz(fitted, fastest) for name in names}
    kept = [name for name in names if name == fastest or periods[name] <= LONGEST_RELEASE]
    chosen = tuple(release for release in fitted if release.input.record.release in kept)
    return Chosen(chosen, _reason(kept, periods, fastest))


def common_structure(releases: Sequence[Release]) -> tuple[int, int]:
    """Return the number of modes that most models have, and the largest number of real poles among these.

    A real pole far above the modes shows in few releases; one that has it tells of it, one that has not is silent.
    """
    found = [structure for r in releases if r.fit is not None and (structure := structure_of(r.fit)) is not None]
    counts = Counter(modes for modes, _ in found)
    modes = max(counts, key=lambda number: (counts[number], number))
    return modes, max(reals for number, reals in found if number == modes)


def _first_mode_hz(releases: Sequence[Release], rope: str) -> float:
    """Middle of the lowest natural frequencies that the releases of a rope show, 0 where none oscillates."""
    models = [r.fit.model for r in releases if r.fit is not None and r.input.record.release == rope]
    lowest = [float(model.frequency_hz.min()) for model in models if model is not None and len(model.frequency_hz)]
    return _middle(lowest) if lowest else 0.0


def _middle(values: Sequence[float]) -> float:
    """The median."""
    return float(np.median(values))


def _reason(kept: Sequence[str], periods: dict[str, float], fastest: str) -> str:
    """Why these ropes."""
    if len(periods) == 1:
        return "all releases"
    names = ", ".join(name or UNNAMED for name in kept)
    others = [f"{name or UNNAMED} {periods[name]:.2g}" for name in periods if name not in kept]
    if not others:
        return f"releases by {names}: each lasts at most half a period of the first mode"
    why = "the fastest" if len(kept) == 1 else "at most half a period of the first mode"
    return f"releases by {names}, {why} ({periods[fastest]:.2g} periods; left out: {', '.join(others)} periods)"


# The releases of a component fitted, and those that make its model brought to one structure.


@dataclass(frozen=True)
class Fitted:
    """The releases of one component with their models; `used`: names of those that make its model, for the `reason`.

    `notices`: what could not be fitted, or had to be fitted anew.
    """

    releases: tuple[Release, ...]
    used: tuple[str, ...]
    reason: str
    notices: tuple[Notice, ...]

    @property
    def chosen(self) -> tuple[Release, ...]:
        """The releases that make the model."""
        return tuple(release for release in self.releases if release.name in self.used)


def fit_component(releases: Sequence[Release], settings: StepSettings) -> Fitted:
    """Fit all releases of a component, and choose those that make its model."""
    found = [fit_release(release, settings) for release in releases]
    notices = tuple(notice for _, told in found for notice in told)
    chosen = choose_releases([release for release, _ in found])
    names = tuple(release.name for release in chosen.releases)
    fitted = Fitted(tuple(release for release, _ in found), names, chosen.reason, notices)
    wanted = common_structure(chosen.releases) if chosen.releases else (0, 0)
    return _of_structure(fitted, settings, wanted) if names else fitted


def _of_structure(fitted: Fitted, settings: StepSettings, wanted: tuple[int, int]) -> Fitted:
    """Fit those chosen releases anew whose models have another structure; what cannot be fitted so is left out."""
    found: dict[str, Release] = {}
    anew: list[str] = []
    notices: list[Notice] = []
    text = f"{_count(wanted[0], 'mode')} and {_count(wanted[1], 'real pole')}, as others show"
    for release in fitted.chosen:
        if release.fit is not None and structure_of(release.fit) == wanted:
            found[release.name] = release
            continue
        again, _ = fit_release(replace(release, fit=None), settings, wanted)
        if again.fit is not None and structure_of(again.fit) == wanted:
            found[release.name] = again
            anew.append(release.name)
        else:
            notices.append(Notice("warning", f"{release.driven}: left out, no model with {text}", release.name))
    if anew:
        notices.append(Notice("info", f"fitted anew with {text}", ", ".join(anew)))
    releases = tuple(found.get(release.name, release) for release in fitted.releases)
    return Fitted(releases, tuple(found), fitted.reason, (*fitted.notices, *notices))


def _count(number: int, what: str) -> str:
    """A number of things."""
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"


# What different methods make of one release.


SEED = 1
"""Of the generator that draws the first generation of differential evolution."""
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What an identification raises where it finds no model."""
LABELS: dict[Method, str] = {
    "pencil": "matrix pencil, output error",
    "arx": "instrumental-variable ARX, output error",
    "sim": "SIM, Tustin",
    "sim_zoh": "SIM, zero-order hold",
    "evolution": "differential evolution on modes",
    "evolution_coefficients": "differential evolution on coefficients",
}


def rows_of(releases: Sequence[Release]) -> tuple[MethodRow, ...]:
    """Return the fits that there are, one row per release."""
    return tuple(method_row(release.fit, release.name) for release in releases if release.fit is not None)


def compare_methods(release: Release, settings: StepSettings) -> tuple[tuple[MethodRow, ...], tuple[Notice, ...]]:
    """Return what every method makes of a release; a notice says which of them finds nothing, and what each remarks."""
    record = replace(release.input.record, u_amplitude=0.0)
    rng = np.random.default_rng(SEED)
    rows: list[MethodRow] = []
    notices: list[Notice] = []
    for method in METHODS:
        try:
            fit = compare(
                record,
                release.driven,
                rng=rng,
                reading=release.reading,
                methods=(method,),
                modes=settings.modes,
                real_poles=settings.real_poles,
            )[0]
        except FAILURES as error:
            notices.append(Notice("info", f"{LABELS[method]}: no model ({error})", release.name))
            continue
        rows.append(method_row(fit, release.name))
        notices += [Notice("info", f"{LABELS[method]}: {n.text}", release.name) for n in fit.notices]
    return tuple(rows), tuple(notices)


def method_row(fit: StepFit, recording: str) -> MethodRow:
    """Return a fit with the indices of its system."""
    return MethodRow(fit, _indices(fit), recording)


def _indices(fit: StepFit) -> Indices | None:
    """Indices of a method's system, none where it has none."""
    try:
        with np.errstate(all="ignore"):
            return indices(fit.system, sample_rate_hz=fit.sample_rate_hz)
    except FAILURES:
        return None


# Static gains of every output, and what releases by different ropes have in common.


def static_gains(releases: Sequence[Release]) -> Iterator[StaticGain]:
    """Yield the static gain of every output for the load of some releases, the driven output first.

    The mean of the releases by weight 1/u²; where they scatter by more than is stated of each, u is that of the
    scatter, with its degrees of freedom. The load's and the output's scale err for all releases alike.
    """
    channels = dict.fromkeys(reading.channel for release in releases for reading in release.readings)
    for channel in channels:
        found = [reading for release in releases for reading in release.readings if reading.channel == channel]
        value = np.array([reading.static_gain for reading in found])
        u = np.array([reading.u_static_gain for reading in found])
        mean, u_mean, dof = mean_with_scatter(value, u)
        own = abs(mean) * scale_uncertainty(releases[0].input.manifest, channel)
        stated, u_stated = stated_gain(releases[0].input.manifest, channel, releases[0].input.record.component)
        total = float(np.hypot(u_mean, own))
        wide = dof * (total / u_mean) ** 4 if np.isfinite(dof) and u_mean > 0.0 else dof
        yield StaticGain(channel, mean, total, float(wide), len(found), stated, u_stated)


def mean_with_scatter(value: FloatArray, u: FloatArray) -> tuple[float, float, float]:
    """Return the weighted mean of values (N,) with u (N,), its u and degrees of freedom.

    u² is that of the weights times χ²/(N - 1) where this is above 1 (Birge's ratio), with the degrees of freedom of
    `pool.effective_dof`.
    """
    if not np.all(u > 0.0):
        u = np.ones(len(value))
    weight = 1.0 / u**2
    mean = float(weight @ value / weight.sum())
    stated = 1.0 / float(weight.sum())
    if len(value) < 2:
        return mean, stated**0.5, float(np.inf)
    freedom = len(value) - 1
    ratio = float(weight @ (value - mean) ** 2) / freedom
    if ratio <= 1.0:
        return mean, stated**0.5, float(np.inf)
    part = stated * (ratio - 1.0 if freedom == 1 else ratio)
    dof = effective_dof(np.array([stated * ratio]), np.array([part]), freedom)
    return mean, (stated * ratio) ** 0.5, float(dof[0])


def scale_uncertainty(manifest: Manifest, channel: str) -> float:
    """Return the relative standard uncertainty of output over load that all releases share: of both scales."""
    entry = _entry(manifest, channel)
    parts = (manifest.excitation.step_uncertainty, entry.scale_uncertainty, entry.individual_uncertainty)
    return float(np.sqrt(np.sum(np.square(parts))))


def stated_gain(manifest: Manifest, channel: str, component: str) -> tuple[float | None, float]:
    """Return the static sensitivity that rig.toml states for an output and a component, None without, and its u."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.static_sensitivity is None or channel not in sensor.channels:
        return None, 0.0
    value = float(sensor.static_sensitivity[sensor.channels.index(channel)][LOAD_COMPONENTS.index(component)])
    return value, abs(value) * sensor.static_sensitivity_uncertainty


def ropes(releases: Sequence[Release], used: Sequence[str]) -> tuple[Rope, ...]:
    """Return the releases by what let go, the fastest rise first; how long the load changed is told by the models."""
    readings = [replace(r.reading, release_s=r.release_s, u_release_s=r.u_release_s) for r in releases]
    found = []
    for kind in compare_releases(readings):
        own = tuple(r.name for r in releases if r.input.record.release == kind.release)
        found.append(Rope(kind, own, any(name in used for name in own)))
    return tuple(found)


def _entry(manifest: Manifest, channel: str) -> ChannelEntry:
    """The entry of an output channel."""
    entries = [entry for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    return next(entry for entry in entries if (entry.channel or entry.name) == channel)
