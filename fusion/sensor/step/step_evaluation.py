"""Releases to models of the outputs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.recording.load import Manifest, check_one_rig
from fusion.report.table import sensitivity_unit
from fusion.sensor.model_files import ModelEntry
from fusion.sensor.step.step_records import StepSettings, index_quantities, parameter_quantities, pool_models
from fusion.sensor.step.step_releases import (
    StepComponent,
    StepEvaluation,
    StepRelease,
    alternative_shapes,
    compare_methods,
    fit_component,
    group_by_device,
    method_row,
    read_recording,
    scale_uncertainty,
    stated_gain,
    static_gains,
)
from fusion.sensor.unmodelled_effects import describe_coverage, stated_influences
from shaker.arrays import ComplexArray, FloatArray
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel
from shakercal._common.notices import Notice

# One load component: its releases become a model with indices, its ropes and methods are compared.


def evaluate_component(
    releases: Sequence[StepRelease], settings: StepSettings
) -> tuple[StepComponent, tuple[Notice, ...]]:
    """Return what the releases of one component, which all drive the same output, say of it."""
    first, fitted = releases[0], fit_component(releases, settings)
    component, channel, manifest, used = first.record.component, first.driven, first.manifest, fitted.chosen
    unit, names, notices = sensitivity_unit(first.record.unit, component), [r.name for r in used], [*fitted.notices]
    result = StepComponent(
        component=component,
        channel=channel,
        unit=unit,
        releases=fitted.releases,
        used=tuple(names),
        reason=fitted.reason,
        gains=tuple(static_gains(fitted.releases, unit)),
        ropes=group_by_device(fitted.releases, names),
        methods=(),
    )
    if settings.method != "all" or not used:
        rows = tuple(method_row(release.fit, release.name) for release in result.releases if release.fit is not None)
        result = replace(result, methods=rows)
    if not used:
        notices.append(Notice("warning", f"no model of {channel}: {fitted.reason}", component))
        return result, tuple(notices)
    fits = [(release, release.fit) for release in used if release.fit is not None]
    models = [release.shapes[0].model for release in used if release.shapes[0].model is not None]
    mountings = [release.manifest.mounting for release in used]
    known, others = stated_influences(manifest.rig, mountings), [*alternative_shapes(used)]
    pooled = pool_models(models, mountings, scale_uncertainty(manifest, channel), known, [one for one, _ in others])
    stated, _ = stated_gain(manifest, channel, component)
    found = index_quantities(pooled, stated, unit, first.record.sample_rate_hz, known)
    notices += [Notice(n.severity, f"{r.driven}: {n.text}", r.name) for r, fit in fits for n in fit.notices]
    notices += [Notice("note", text, component) for _, text in others if text]
    entry = ModelEntry(
        channel=channel,
        component=component,
        unit=used[0].record.unit,
        method=fits[0][1].method,
        model=pooled.model,
        sample_rate_hz=used[0].record.sample_rate_hz,
        noise=float(np.median([release.reading.noise for release in used])),
        recording=", ".join(names),
        dof=float(pooled.scatter_dof) if pooled.scatter_dof else float(np.inf),
        scope=known.scope,
        scatter=pooled.scatter if pooled.scatter_dof else None,
        outside=known.outside,
    )
    parameters = parameter_quantities(pooled, unit)
    result = replace(result, pooled=pooled, parameters=parameters, figures=found.quantities, entry=entry)
    result = replace(result, budget=found.budget, influences=known)
    if settings.method == "all":
        by_rule = settings.release == "auto" and used[0].name not in fitted.refitted
        rows, of_methods = compare_methods(used[0], settings, [fits[0][1]] if by_rule else ())
        result, notices = replace(result, methods=rows), [*notices, *of_methods]
    return result, (*notices, *_remarks(result, pooled.model, found.notices, stated))


def _remarks(
    result: StepComponent, model: ModalModel, of_indices: Sequence[Notice], stated: float | None
) -> Iterator[Notice]:
    """Which releases made the model, what its U lacks, and how it compares with what is stated."""
    where, channel = result.component, result.channel
    if len(result.ropes) > 1:
        yield Notice("note", f"the model of {channel} rests on {result.reason}", where)
    yield Notice("note", describe_coverage(result.scope, result.influences.outside), "models")
    for notice in of_indices:
        yield Notice(notice.severity, notice.text, f"{where}, {notice.where}")
    if not len(model.real_hz):
        text = (
            f"no release shows a real pole beside the modes of {channel}: a lag of amplifier or filter, which "
            "looks like a later onset, would move the bands by more than their U; --real-poles 1 lets it in"
        )
        yield Notice("note", text, where)
    if stated is None:
        text = "rig.toml states no static_sensitivity for it: bands against the static gain of the model only"
        yield Notice("note", text, where)
    over = result.gains[0].normalised
    if over is not None and abs(over) > 1.0:
        text = (
            f"static gain of {channel} and the stated static sensitivity differ by {abs(over):.2f} times the U of "
            "their difference"
        )
        yield Notice("warning", text, where)


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
    by_component, notices = _read(manifests, settings)
    notices += [notice for manifest in manifests for notice in manifest.certificate_notices]
    components: list[StepComponent] = []
    for component in LOAD_COMPONENTS:
        if component in by_component:
            result, told = evaluate_component(by_component[component], settings)
            components.append(result)
            notices += told
    if all(result.pooled is None for result in components):
        why = next(notice for notice in notices if notice.severity == "warning")
        raise ComputeError(f"no model was found of any output ({why.where}: {why.text}); see docs/steps.md, limits")
    return StepEvaluation(
        name=name,
        rig=manifests[0].rig,
        components=tuple(components),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_settings(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _read(manifests: Sequence[Manifest], settings: StepSettings) -> tuple[dict[str, list[StepRelease]], list[Notice]]:
    """Releases of one rig by component; those of one component must drive the same output."""
    releases, notices = defaultdict[str, list[StepRelease]](list), list[Notice]()
    check_one_rig(manifests)
    for manifest in manifests:
        release, told = read_recording(manifest)
        notices += told
        component = release.record.component
        releases[component].append(release)
        first = releases[component][0]
        if first.driven != release.driven:
            expected = f"{first.driven}, the output that {component} drives in {first.name}"
            raise InputError(manifest.path, "daq.channel", found=release.driven, expected=expected)
        if settings.release == "measured" and release.record.force is None:
            expected = "the name of the force channel, for --release measured"
            raise InputError(manifest.path, "excitation.force", found="nothing", expected=expected)
    return releases, notices


# The response over frequency that a release shows by itself, without a model.

LAST = 20  # share 1/LAST of a force's record, its end, that gives its last level
WEAK = 0.2  # share of a step's spectrum below which a release drives too little


class MeasuredResponse(NamedTuple):
    """Output over load (K,) at frequencies (K,) in Hz; `u` (K,): r.m.s. size of what white noise adds to each."""

    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray


def measured_response(release: StepRelease) -> MeasuredResponse:
    """Return output over load of one release from the spectra of their derivatives.

    H(f) = Y'(f)/X'(f) with Y' = jω·Y from the differences of the samples, exact for what lies below half the sampling
    rate, and X' = A·s(f)·exp(-jωt), t the middle of the release and s = sin(πfT)/(πfT) of a load that changes evenly
    for T, cos(πfT)/(1 - (2fT)²) of one that changes along half a cosine; where the load was measured, X' likewise from
    its samples. Frequencies at which the release drives less than a fifth of what a step would are left out. From the
    onset on; before it nothing happens.
    """
    record = release.record
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
        turn = frequency * release.release_s
        share = np.sinc(turn)
        if release.shape == "smooth":
            near = np.abs(1.0 - (2.0 * turn) ** 2) < 1e-9
            below = np.where(near, 1.0, 1.0 - (2.0 * turn) ** 2)
            share = np.where(near, np.pi / 4.0, np.cos(np.pi * turn) / below)
        middle = np.exp(-2j * np.pi * frequency * (onset + 0.5 * release.release_s))
        driven = record.amplitude * share * middle
    kept = (np.abs(driven) >= WEAK * abs(record.amplitude)) & (frequency > 0.0)
    noise = 2.0 * np.pi * frequency * release.reading.noise * step * np.sqrt(len(samples))
    return MeasuredResponse(frequency[kept], moved[kept] / driven[kept], noise[kept] / np.abs(driven[kept]))


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
