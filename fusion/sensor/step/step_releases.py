"""Releases read and fitted, the parts of a step evaluation, and static gains."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.estimation.coverage import NamedQuantity, RealQuantity
from fusion.recording.load import Manifest
from fusion.recording.rig import Rig
from fusion.sensor import model_notices as declared
from fusion.sensor.model_files import ModelEntry
from fusion.sensor.step.step_pool import PooledModel, effective_dof
from fusion.sensor.step.step_records import StepSettings, output_entries, read_step
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.indices import Indices, indices
from shaker.lti.system import ModalModel
from shaker.release.reading import ReleaseKind, compare_releases, read_releases
from shaker.release.record import ReleaseReading, StepRecord
from shaker.release.step_fit import (
    Method,
    StepFit,
    alternative_fits,
    fit_shapes,
    merge_alternatives,
    order_hypotheses,
)
from shaker.release.step_methods import METHODS, fit_all_methods
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# Parts of evaluated step responses.

UNNAMED = "not stated"  # name of a release device that no recording names


@dataclass(frozen=True)
class StepRelease:
    """One recording of a release: its record, readings, and model.

    Attributes
    ----------
    record : without the uncertainty of the load, which all releases share.
    readings : of the outputs that can be read, `driven` first.
    fit : None if no model was found.
    shapes : the fit and those of other release shapes, each as if the others were rejected. Their excess of χ² is that
        of all releases by the same device.
    """

    manifest: Manifest
    record: StepRecord
    driven: str
    readings: tuple[ReleaseReading, ...]
    fit: StepFit | None = None
    shapes: tuple[StepFit, ...] = ()

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.record.name

    @property
    def reading(self) -> ReleaseReading:
        """Reading of the driven output."""
        return self.readings[0]

    @property
    def excess(self) -> float:
        """χ² of the second hypothesis above that of the first, infinite without one."""
        return self.shapes[1].excess if len(self.shapes) > 1 else np.inf

    @property
    def timing(self) -> StepFit | ReleaseReading:
        """Onset, duration and shape of the change of load: of the fit, else as read."""
        return self.reading if self.fit is None else self.fit

    @property
    def structure(self) -> tuple[int, int] | None:
        """Numbers of modes and real poles of the model, None without a modal form."""
        model = None if self.fit is None else self.fit.model
        return None if model is None else (len(model.frequency_hz), len(model.real_hz))


def check_driven_output(first: StepRelease, other: StepRelease) -> None:
    """Raise `InputError` if a release drives another output than the first of its component."""
    if other.driven != first.driven:
        path, expected, found = other.manifest.path, first.driven, other.driven
        raise InputError(
            declared.OTHER_DRIVEN_OUTPUT, path, "daq.channel", expected=expected, recording=first.name, found=found
        )


@dataclass(frozen=True)
class StaticGain(RealQuantity):
    """Mean static gain of an output; `stated`, `u_stated`: of rig.toml, None without one."""

    channel: str
    releases: int
    stated: float | None
    u_stated: float

    @property
    def normalised(self) -> float | None:
        """Return the deviation from the stated value over its U, None if not stated."""
        if self.stated is None:
            return None
        spread = float(np.hypot(self.expanded, 2.0 * self.u_stated))
        return (self.value - self.stated) / spread if spread > 0.0 else None


@dataclass(frozen=True)
class ReleaseDevice:
    """Releases by one device, with rise and duration, and whether the model uses them.

    `kind`: rise of the driven output and duration of the change of load, of the models if available.
    """

    kind: ReleaseKind
    releases: tuple[str, ...]
    used: bool

    @property
    def name(self) -> str:
        """Name of the release device."""
        return self.kind.release or UNNAMED


@dataclass(frozen=True)
class MethodRow:
    """The result of one method for one release: fit and indices."""

    fit: StepFit
    indices: Indices | None
    recording: str


@dataclass(frozen=True)
class StepComponent:
    """All results of one load component.

    Attributes
    ----------
    channel : output that is driven.
    unit : of output over load.
    releases : of all devices; `used` names those in the model, selected for the `reason`.
    gains : static gain of every output, the driven one first.
    ropes : release devices, the fastest first.
    methods : result of each method for one release.
    pooled, parameters, figures, entry : the model, its parameters and indices, and its entry in models.json; None or
        empty without a model.
    budget : standard uncertainty of each index by cause.
    influences : influences that no record shows.
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
        """Releases that the model uses."""
        return tuple(release for release in self.releases if release.name in self.used)

    @property
    def scope(self) -> str:
        """Return the use that U of the model covers, in words; empty without a model."""
        return "" if self.entry is None else self.entry.scope

    def find(self, name: str) -> NamedQuantity | None:
        """Return an index by its name, None without one."""
        return next((one for one in self.figures if one.name == name), None)


@dataclass(frozen=True)
class StepEvaluation(CommandEvaluation):
    """All releases of one sensor, one result per load component."""

    rig: Rig
    components: tuple[StepComponent, ...]


FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError)  # exceptions of an identification without a model


# One recording: readings of its outputs, and the model of the driven one.

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
            found = ", ".join(record.channels)
            raise InputError(declared.DRIVEN_OUTPUT_MISSING, manifest.path, "daq.channel", expected=name, found=found)
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
        raise InputError(declared.DRIVEN_OUTPUT_CLIPPED, manifest.path, key)
    if abs(driven.static_gain) <= CLEAR * driven.u_static_gain:
        change = float(driven.steady - driven.baseline)
        raise InputError(
            declared.NO_STEP_FOUND, manifest.path, key, component=driven.component, change=change, unit=driven.unit
        )
    clipped = [other.channel for other in readings.values() if other.clipped]
    notices = [
        *(Notice(declared.CLIPPED_OUTPUT, record.name, channel=channel) for channel in clipped),
        *(notice.at(f"{record.name}: {name}") for notice in driven.notices),
    ]
    others = [reading for reading in readings.values() if not reading.clipped]
    return StepRelease(manifest, record, name, (driven, *others)), (*source.notices, *notices)


def fit_release(
    release: StepRelease, settings: StepSettings, structure: tuple[int, int] | None = None
) -> tuple[StepRelease, tuple[Notice, ...]]:
    """Return a release with its model.

    `structure` (modes, real poles) is selected by rule if None. If no model is found, the release has none and a notice
    gives the reason.
    """
    counts = structure or (settings.modes, settings.real_poles)
    method: Literal["arx", "pencil"] = "arx" if settings.method == "arx" else "pencil"
    shape = None if settings.release == "auto" else settings.release
    try:
        shapes = fit_shapes(release.record, release.driven, release.reading, *counts, method, shape)
    except FAILURES as error:
        notice = Notice(declared.RELEASE_WITHOUT_MODEL, release.name, channel=release.driven, reason=str(error))
        return release, (notice,)
    return replace(release, fit=merge_alternatives(shapes), shapes=shapes), ()


# The shape of the releases by one device, determined by all of them.


def fit_common_shape(releases: Sequence[StepRelease]) -> tuple[StepRelease, ...]:
    """Return releases with the likeliest models, one hypothesis per device."""
    devices = defaultdict[str, list[dict[str, float]]](list)
    for release in releases:
        if release.shapes:
            devices[release.record.release].append({fit.hypothesis: fit.excess for fit in release.shapes})
    total = {
        device: {name: sum(costs.get(name, np.inf) for costs in members) for name in members[0]}
        for device, members in devices.items()
    }

    def with_likeliest_shape(release: StepRelease) -> StepRelease:
        costs = total.get(release.record.release, {})
        common = [fit for fit in release.shapes if np.isfinite(costs.get(fit.hypothesis, np.inf))]
        if not common:
            return release
        shapes = order_hypotheses([replace(fit, excess=costs[fit.hypothesis]) for fit in common])
        return replace(release, fit=merge_alternatives(shapes), shapes=shapes)

    return tuple(map(with_likeliest_shape, releases))


# Selection of the releases for a component's model.

LONGEST_RELEASE = 0.5
"""Periods of the first mode that a release by another device than the fastest may last; from there on, the response
to a linear change is 0.64 of that to a step."""


def choose_releases(releases: Sequence[StepRelease]) -> tuple[tuple[StepRelease, ...], str]:
    """Return the releases of the fastest devices, and the reason.

    Other devices than the fastest are used up to half a period of the first mode. A load that changes over the time T
    excites a mode at f by sin(πfT)/(πfT) of an ideal step. From half a period of the first mode on (0.64), the model
    depends on the course of the load, which is not known for any device.
    """
    models = [(r, r.fit.model) for r in releases if r.fit is not None and r.fit.model is not None]
    if not models:
        return (), "no release could be fitted"
    devices = defaultdict[str, list[tuple[StepRelease, ModalModel]]](list)
    for release, model in models:
        devices[release.record.release].append((release, model))
    length = {device: float(np.median([r.timing.release_s for r, _ in group])) for device, group in devices.items()}
    fastest = min(length, key=lambda device: length[device])
    lowest = [float(model.frequency_hz.min()) for _, model in devices[fastest] if len(model.frequency_hz)]
    first_mode_hz = float(np.median(lowest)) if lowest else 0.0
    periods = {device: length[device] * first_mode_hz for device in devices}
    selected = [device for device in devices if device == fastest or periods[device] <= LONGEST_RELEASE]
    chosen = tuple(release for release, _ in models if release.record.release in selected)
    if len(devices) == 1:
        return chosen, "all releases"
    by = ", ".join(device or UNNAMED for device in selected)
    others = ", ".join(f"{device or UNNAMED} {periods[device]:.2g}" for device in devices if device not in selected)
    if not others:
        return chosen, f"releases by {by}: each lasts at most half a period of the first mode"
    why = "the fastest" if len(selected) == 1 else "at most half a period of the first mode"
    return chosen, f"releases by {by}, {why} ({periods[fastest]:.2g} periods; left out: {others} periods)"


# Comparison of methods for one release.

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
    """Return the result of every method for a release; `available` fits are used."""
    rng, rows, notices = np.random.default_rng(SEED), list[MethodRow](), list[Notice]()
    by = partial(fit_all_methods, release.record, release.driven, rng=rng, reading=release.reading)
    existing = {fit.method: fit for fit in available}
    for method in METHODS:
        try:
            fit = existing.get(method) or by(methods=(method,), modes=settings.modes, real_poles=settings.real_poles)[0]
        except FAILURES as error:
            notices.append(
                Notice(declared.METHOD_WITHOUT_MODEL, release.name, method=LABELS[method], reason=str(error))
            )
            continue
        rows.append(method_row(fit, release.name))
        notices += [
            Notice(declared.METHOD_REMARK, release.name, method=LABELS[method], remark=n.text) for n in fit.notices
        ]
    return tuple(rows), tuple(notices)


def method_row(fit: StepFit, recording: str) -> MethodRow:
    """Return a fit with the indices of its system, None if it has none."""
    try:
        with np.errstate(all="ignore"):
            return MethodRow(fit, indices(fit.system, sample_rate_hz=fit.sample_rate_hz), recording)
    except FAILURES:
        return MethodRow(fit, None, recording)


# Static gains of every output, and releases by device.


def static_gains(releases: Sequence[StepRelease], unit: str) -> Iterator[StaticGain]:
    """Yield the static gain of every output in `unit`, the driven output first.

    The mean of the releases is weighted by 1/u². If the scatter exceeds the stated uncertainties, u is that of the
    scatter with its degrees of freedom. The scales of load and output are common to all releases.
    """
    manifest, component = releases[0].manifest, releases[0].record.component
    for channel in dict.fromkeys(reading.channel for release in releases for reading in release.readings):
        of_channel = [reading for release in releases for reading in release.readings if reading.channel == channel]
        value, u = [reading.static_gain for reading in of_channel], [reading.u_static_gain for reading in of_channel]
        mean, u_mean, dof = mean_with_scatter(np.array(value), np.array(u))
        total = float(np.hypot(u_mean, abs(mean) * scale_uncertainty(manifest, channel)))
        wide = dof * (total / u_mean) ** 4 if np.isfinite(dof) and u_mean > 0.0 else dof
        stated = stated_gain(manifest, channel, component)
        yield StaticGain(mean, total, float(wide), unit, channel, len(of_channel), *stated)


def mean_with_scatter(value: FloatArray, u: FloatArray) -> tuple[float, float, float]:
    """Return the weighted mean of values (N,), its u and degrees of freedom.

    `u` (N,): of the values. u² is that of the weights times χ²/(N - 1) if this is above 1 (Birge ratio), with the
    degrees of freedom of `effective_dof`.
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
    """Return the relative u by both scales, common to all releases."""
    _, entry = output_entries(manifest)[channel]
    parts = (manifest.excitation.step_uncertainty, entry.scale_uncertainty, entry.individual_uncertainty)
    return float(np.sqrt(np.sum(np.square(parts))))


def stated_gain(manifest: Manifest, channel: str, component: str) -> tuple[float | None, float]:
    """Return the stated static sensitivity of an output, None without one, and u."""
    sensor = manifest.rig.sensor
    if sensor is None or sensor.static_sensitivity is None or channel not in sensor.channels:
        return None, 0.0
    value = float(sensor.static_sensitivity[sensor.channels.index(channel)][LOAD_COMPONENTS.index(component)])
    return value, abs(value) * sensor.static_sensitivity_uncertainty


def group_by_device(releases: Sequence[StepRelease], used: Sequence[str]) -> tuple[ReleaseDevice, ...]:
    """Return the releases by device, the fastest rise first.

    The duration of the change of load is that of the models. Its deviation for the other shape is common to all
    releases by one device.
    """
    readings = []
    for release in releases:
        timed = release.shapes[0] if release.shapes else release.reading
        readings.append(replace(release.reading, release_s=timed.release_s, u_release_s=timed.u_release_s))
    devices = []
    for kind in compare_releases(readings):
        of_device = [release for release in releases if release.record.release == kind.release]
        names = tuple(release.name for release in of_device)
        others = [(release, alternative_fits(release.shapes)) for release in of_device if release.shapes]
        moved = [[(fit.release_s - r.timing.release_s) / end.distance for fit, end in ends] for r, ends in others]
        deviations = [float(np.linalg.norm(parts)) for parts in moved]
        u_mean = float(np.hypot(kind.length.u_mean, sum(deviations) / len(of_device)))
        shown = replace(kind, length=replace(kind.length, u_mean=u_mean))
        devices.append(ReleaseDevice(shown, names, not set(used).isdisjoint(names)))
    return tuple(devices)
