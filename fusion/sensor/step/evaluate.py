"""Releases to models of the outputs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion.base import ComputeError, InputError
from fusion.recording.load import Manifest
from fusion.report.csv_files import sensitivity_unit
from fusion.report.provenance import versions
from fusion.sensor.models_file import ModelEntry
from fusion.sensor.step.records import Pooled, StepSettings, check_kind, index_figures, parameter_figures, pool_models
from fusion.sensor.step.releases import (
    ComponentResult,
    Fitted,
    Release,
    StepEvaluation,
    compare_methods,
    fit_component,
    read_recording,
    ropes,
    rows_of,
    scale_uncertainty,
    stated_gain,
    static_gains,
)
from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.labels import LOAD_COMPONENTS

# One load component: its releases become a model with indices, its ropes and methods are compared.


def evaluate_component(fitted: Fitted, settings: StepSettings) -> tuple[ComponentResult, tuple[Notice, ...]]:
    """Return what the fitted releases of one component say of it; all drive the same output."""
    first, used = fitted.releases[0], fitted.chosen
    component, channel, manifest = first.input.record.component, first.driven, first.input.manifest
    unit = sensitivity_unit(first.input.record.unit, component)
    stated, _ = stated_gain(manifest, channel, component)
    pooled = _pooled(used, scale_uncertainty(manifest, channel)) if used else None
    rate_hz = first.input.record.sample_rate_hz
    found = None if pooled is None else index_figures(pooled, stated, unit, rate_hz)
    rows = rows_of(fitted.releases)
    of_methods: tuple[Notice, ...] = ()
    if settings.method == "all" and used:
        rows, of_methods = compare_methods(used[0], settings)
    result = ComponentResult(
        component=component,
        channel=channel,
        unit=unit,
        releases=fitted.releases,
        used=fitted.used,
        reason=fitted.reason,
        pooled=pooled,
        parameters=() if pooled is None else parameter_figures(pooled, unit),
        indices=None if found is None else found[0],
        figures=() if found is None else found[1],
        gains=tuple(static_gains(fitted.releases)),
        ropes=ropes(fitted.releases, fitted.used),
        methods=rows,
        entry=None if pooled is None else _entry(pooled, used),
    )
    return result, (*fitted.notices, *_of_fits(used), *of_methods, *_of_result(result, stated))


def _of_fits(releases: Sequence[Release]) -> list[Notice]:
    """What the fits of the model's releases remark."""
    return [
        Notice(notice.severity, f"{release.driven}: {notice.text}", release.name)
        for release in releases
        if release.fit is not None
        for notice in release.fit.notices
    ]


def _pooled(releases: Sequence[Release], u_scale: float) -> Pooled:
    """One model from those of the releases."""
    models = [release.fit.model for release in releases if release.fit is not None]
    mountings = [release.input.manifest.mounting for release in releases]
    return pool_models([model for model in models if model is not None], mountings, u_scale)


def _entry(pooled: Pooled, releases: Sequence[Release]) -> ModelEntry:
    """What models.json holds of a component."""
    record, first = releases[0].input.record, releases[0]
    return ModelEntry(
        channel=first.driven,
        component=record.component,
        unit=record.unit,
        method="" if first.fit is None else first.fit.method,
        model=pooled.model,
        sample_rate_hz=record.sample_rate_hz,
        noise=float(np.median([release.reading.noise for release in releases])),
        recording=", ".join(release.name for release in releases),
        dof=float(pooled.scattered) if pooled.scattered else float(np.inf),
    )


def _of_result(result: ComponentResult, stated: float | None) -> list[Notice]:
    """Which releases made the model, what its U lacks, and how it compares with what is stated."""
    where, found = result.component, []
    if result.pooled is None:
        return [Notice("warning", f"no model of {result.channel}: {result.reason}", where)]
    if len(result.ropes) > 1:
        found.append(Notice("info", f"the model of {result.channel} rests on {result.reason}", where))
    mountings = {release.input.manifest.mounting for release in result.chosen}
    if len(result.used) == 1:
        found.append(Notice("info", "one release only: what releases scatter by is not in U", where))
    elif len(mountings) == 1:
        text = "all releases of a component are of one mounting: what mounting anew changes is not in U"
        found.append(Notice("info", text, "releases"))
    if result.indices is not None:
        found += [Notice(n.severity, n.text, f"{where}, {n.where}") for n in result.indices.notices]
    if not len(result.pooled.model.real_hz):
        text = (
            f"no release shows a real pole beside the modes of {result.channel}: a lag of amplifier or filter, which "
            "looks like a later onset, would move the bands by more than their U; --real-poles 1 lets it in"
        )
        found.append(Notice("info", text, where))
    if stated is None:
        text = "rig.toml states no static_sensitivity for it: bands against the static gain of the model only"
        found.append(Notice("info", text, where))
    driven = result.gains[0]
    if driven.normalised is not None and abs(driven.normalised) > 1.0:
        text = (
            f"static gain of {result.channel} and the stated static sensitivity differ by {abs(driven.normalised):.2f} "
            "times the U of their difference"
        )
        found.append(Notice("warning", text, where))
    return found


# From recordings of releases to models of a sensor's components.


def evaluate_steps(
    name: str, manifests: Sequence[Manifest], settings: StepSettings, input_hashes: dict[str, str]
) -> StepEvaluation:
    """Return what recordings of one sensor's releases tell: records → readings → models → indices.

    Raises `InputError` for what the user can mend in the files, `ComputeError` where no model is found at all.

    >>> from fusion import StepSettings, evaluate_steps, load_for_command
    >>> releases = load_for_command(["steps"], "step")  # doctest: +SKIP
    >>> evaluation = evaluate_steps("steps", releases, StepSettings(), {})  # doctest: +SKIP
    """
    started = time.monotonic()
    _check_together(manifests)
    releases, notices = _read(manifests)
    _check_forces(releases, settings)
    components: list[ComponentResult] = []
    for fitted in _fit(releases, settings):
        result, told = evaluate_component(fitted, settings)
        components.append(result)
        notices += told
    if all(result.pooled is None for result in components):
        why = next(notice for notice in notices if notice.severity == "warning")
        raise ComputeError(f"no model was found of any output ({why.where}: {why.text}); see docs/steps.md, limits")
    rig = manifests[0].rig
    return StepEvaluation(
        name=name,
        rig=rig.name,
        sensor=rig.sensor,
        components=tuple(components),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_settings(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _check_together(manifests: Sequence[Manifest]) -> None:
    """Recordings that are compared share a rig."""
    for manifest in manifests:
        check_kind(manifest)
        if manifest.rig_path.resolve() != manifests[0].rig_path.resolve():
            expected = f"{manifests[0].rig_path}, the rig of {manifests[0].folder.name}"
            raise InputError(manifest.path, "rig", found=str(manifest.rig_path), expected=expected)


def _read(manifests: Sequence[Manifest]) -> tuple[list[Release], list[Notice]]:
    """All releases; those of one component must drive the same output."""
    releases: list[Release] = []
    notices: list[Notice] = []
    for manifest in manifests:
        release, told = read_recording(manifest)
        notices += told
        component = release.input.record.component
        first = next((one for one in releases if one.input.record.component == component), release)
        if first.driven != release.driven:
            expected = f"{first.driven}, the output that {component} drives in {first.name}"
            raise InputError(manifest.path, "daq.channel", found=release.driven, expected=expected)
        releases.append(release)
    return releases, notices


def _fit(releases: Sequence[Release], settings: StepSettings) -> list[Fitted]:
    """The releases of every component fitted."""
    components = {release.input.record.component for release in releases}
    own = [[r for r in releases if r.input.record.component == c] for c in LOAD_COMPONENTS if c in components]
    return [fit_component(found, settings) for found in own]


def _check_forces(releases: Sequence[Release], settings: StepSettings) -> None:
    """A load that is to be taken as measured must have been measured."""
    for release in releases:
        if settings.release == "measured" and release.input.record.force is None:
            expected = "the name of the force channel, for --release measured"
            raise InputError(release.input.manifest.path, "excitation.force", found="nothing", expected=expected)


# The response over frequency that a release shows by itself, without a model.


LAST = 20
"""Share 1/LAST of a force's record, its end, that gives its last level."""
WEAK = 0.2
"""Share of a step's spectrum below which a release drives too little."""


class Measured(NamedTuple):
    """Output over load (K,) at frequencies (K,) in Hz; `u` (K,): r.m.s. size of what white noise adds to each."""

    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray


def measured_response(release: Release) -> Measured:
    """Return output over load of one release from the spectra of their derivatives.

    H(f) = Y'(f)/X'(f) with Y' = jω·Y from the differences of the samples, exact for what lies below half the sampling
    rate, and X' = A·s(f)·exp(-jωt), t the middle of the release and s = sin(πfT)/(πfT) of a load that changes evenly
    for T, cos(πfT)/(1 - (2fT)²) of one that changes along half a cosine; where the load was measured, X' likewise from
    its samples. Frequencies at which the release drives less than a fifth of what a step would are left out. From the
    onset on; before it nothing happens.
    """
    record = release.input.record
    step = 1.0 / record.sample_rate_hz
    onset = release.reading.onset_s if release.fit is None else release.fit.onset_s
    first = max(0, int((onset - record.start_s) / step) - 3)
    samples = record.samples[record.channels.index(release.driven), first:]
    start_s = record.start_s + first * step
    ends = release.reading.baseline, release.reading.steady
    frequency, moved = _derivative(samples, ends, start_s, step)
    if record.force is not None:
        force = record.force[first:]
        ends = float(record.force[: max(first, 1)].mean()), float(force[-max(1, len(force) // LAST) :].mean())
        driven = _derivative(force, ends, start_s, step)[1]
    else:
        middle = np.exp(-2j * np.pi * frequency * (onset + 0.5 * release.release_s))
        driven = record.amplitude * _share(release, frequency) * middle
    kept = (np.abs(driven) >= WEAK * abs(record.amplitude)) & (frequency > 0.0)
    noise = 2.0 * np.pi * frequency * release.reading.noise * step * np.sqrt(len(samples))
    return Measured(frequency[kept], moved[kept] / driven[kept], noise[kept] / np.abs(driven[kept]))


def _derivative(
    samples: FloatArray, ends: tuple[float, float], start_s: float, step_s: float
) -> tuple[FloatArray, ComplexArray]:
    """Spectrum of the derivative of samples (N,) between two levels: frequencies (K,) and values (K,).

    The sum of the differences' exp(-jωt) times ωΔ/(2 sin(ωΔ/2)), what a derivative has over a difference.
    """
    change = np.diff(samples, prepend=ends[0], append=ends[1])
    frequency = np.fft.rfftfreq(len(change), step_s)[:-1]
    turn = np.pi * frequency * step_s
    wide = np.divide(turn, np.sin(turn), out=np.ones_like(turn), where=turn > 0.0)
    spectrum = np.fft.rfft(change)[:-1] * wide
    return np.asarray(frequency), np.asarray(spectrum * np.exp(-2j * np.pi * frequency * (start_s - 0.5 * step_s)))


def _share(release: Release, frequency: FloatArray) -> FloatArray:
    """What a release drives over what a step would (K,)."""
    turn = frequency * release.release_s
    even = np.asarray(np.sinc(turn))
    if release.reading.shape != "smooth":
        return even
    near = np.abs(1.0 - (2.0 * turn) ** 2) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(near, np.pi / 4.0, np.cos(np.pi * turn) / (1.0 - (2.0 * turn) ** 2))
