"""Evaluation of releases: models of the outputs and their indices."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.base import PERCENT
from fusion.errors import ComputeError, InputError
from fusion.recording.load import Manifest, check_one_rig
from fusion.sensor import model_notices as declared
from fusion.sensor.model_files import ModelEntry
from fusion.sensor.step.step_joint import fit_component
from fusion.sensor.step.step_pool import IndexResults, index_quantities, parameter_quantities, pool_models
from fusion.sensor.step.step_records import StepSettings
from fusion.sensor.step.step_releases import (
    StepComponent,
    StepEvaluation,
    StepRelease,
    check_driven_output,
    compare_methods,
    group_by_device,
    method_row,
    read_recording,
    scale_uncertainty,
    stated_gain,
    static_gains,
)
from fusion.sensor.unmodelled_effects import RELATIVE_STEP, coverage_notice, stated_influences
from shaker.labels import LOAD_COMPONENTS, sensitivity_unit
from shaker.lti.indices import SETTLING
from shaker.lti.system import ModalModel
from shaker.model_notices import AMPLITUDE_DEPENDENT
from shakercal._common.notices import Notice

# One load component: model, indices, release devices and methods.


def evaluate_component(
    releases: Sequence[StepRelease], settings: StepSettings
) -> tuple[StepComponent, tuple[Notice, ...]]:
    """Return model and results of the releases of one component and one driven output."""
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
    if not used or fitted.common is None:
        notices.append(Notice(declared.COMPONENT_WITHOUT_MODEL, component, channel=channel, reason=fitted.reason))
        return result, tuple(notices)
    fits = [(release, release.fit) for release in used if release.fit is not None]
    mountings = [release.manifest.mounting for release in used]
    influences, others = stated_influences(manifest.rig, mountings), fitted.common.alternatives
    alternatives = [other.model for other in others]
    u_scale, contributions = scale_uncertainty(manifest, channel), fitted.common.contributions
    pooled = pool_models(contributions, mountings, u_scale, influences, alternatives)
    stated, _ = stated_gain(manifest, channel, component)
    found = index_quantities(pooled, stated, unit, first.record.sample_rate_hz, influences)
    found = _with_delay(found, used, pooled.model)
    of_all = [other.notice for other in others if other.notice is not None]
    if AMPLITUDE_DEPENDENT.code in [notice.code for notice in of_all]:  # of all releases in place of each of them
        found = _drop_damping_uncertainty(found)
        fits = [
            (r, replace(f, notices=tuple(n for n in f.notices if n.code != AMPLITUDE_DEPENDENT.code))) for r, f in fits
        ]
    notices += [*(n.at(f"{r.name}: {r.driven}") for r, fit in fits for n in fit.notices), *of_all]
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
        scope=influences.scope,
        scatter=pooled.scatter if pooled.scatter_dof else None,
        outside=influences.outside,
    )
    result = replace(result, pooled=pooled, parameters=parameter_quantities(pooled, unit), entry=entry)
    result = replace(result, figures=found.quantities, budget=found.budget, influences=influences)
    if settings.method == "all":
        by_rule = settings.release == "auto" and used[0].name not in fitted.refitted
        rows, of_methods = compare_methods(used[0], settings, [fits[0][1]] if by_rule else ())
        result, notices = replace(result, methods=rows), [*notices, *of_methods]
    return result, (*notices, *_remarks(result, pooled.model, found.notices, stated))


_OF_DAMPING = ("damping_ratio", "peak_gain", *SETTLING)
_OF_DELAY = ("quadrature_hz", "rise_s", *SETTLING)
_CONTRADICTED = 0.5  # U of a damping ratio over it from which a dependence on the amplitude leaves it without a value
_DELAY_S = 1e-5  # delay of a chain for which the effect is stated


def _drop_damping_uncertainty(found: IndexResults) -> IndexResults:
    """Return indices, those of a damping ratio that is uncertain by half without U."""
    damping = next((one for one in found.quantities if one.name == "damping_ratio"), None)
    if damping is None or damping.expanded < _CONTRADICTED * abs(damping.value):
        return found
    share = PERCENT * damping.expanded / abs(damping.value)
    return _without_u(found, _OF_DAMPING, Notice(declared.DAMPING_NOT_LINEAR, damping.name, percent=share))


def _without_u(found: IndexResults, names: Sequence[str], notice: Notice) -> IndexResults:
    """Return indices, those of `names` without U, and a notice why."""
    quantities = tuple(
        replace(one, u=np.nan, low=np.nan, high=np.nan) if one.name in names else one for one in found.quantities
    )
    rest = {cause: {n: u for n, u in parts.items() if n not in names} for cause, parts in found.budget.items()}
    return IndexResults(quantities, (*found.notices, notice), rest)


def _with_delay(found: IndexResults, chosen: Sequence[StepRelease], model: ModalModel) -> IndexResults:
    """Return indices with a notice of the chain's delay, which moves the quadrature frequency.

    A stated delay that moves it by more than its U leaves the indices of time and phase without U.
    """
    quadrature = next((one for one in found.quantities if one.name == "quadrature_hz"), None)
    if quadrature is None or any(release.record.force is not None for release in chosen):
        return found
    near = quadrature.value * np.array([1.0 - RELATIVE_STEP, 1.0 + RELATIVE_STEP])
    phases = np.angle(model.response(near) / model.response(np.full(2, quadrature.value)))
    per_s = 2.0 * np.pi * quadrature.value * np.ptp(near) / max(abs(float(np.diff(phases)[0])), 1e-300)
    stated = [release.record.delay_s for release in chosen if release.record.delay_s is not None]
    if not stated:
        values = {"delay_us": 1e6 * _DELAY_S, "shift_hz": _DELAY_S * per_s}
        return found._replace(notices=(*found.notices, Notice(declared.CHAIN_DELAY_UNKNOWN, quadrature.name, **values)))
    delay_s = float(np.median(stated))
    if abs(delay_s) * per_s < quadrature.expanded:
        return found
    values = {"delay_us": 1e6 * delay_s, "shift_hz": abs(delay_s) * per_s}
    return _without_u(found, _OF_DELAY, Notice(declared.CHAIN_DELAY_NOT_IN_MODEL, quadrature.name, **values))


def _remarks(
    result: StepComponent, model: ModalModel, of_indices: Sequence[Notice], stated: float | None
) -> Iterator[Notice]:
    """Yield notices on selected releases, coverage of U, and deviations from stated values."""
    where, channel = result.component, result.channel
    if len(result.ropes) > 1:
        yield Notice(declared.RELEASES_SELECTED, where, channel=channel, reason=result.reason)
    yield coverage_notice(result.scope, result.influences.outside, "models")
    for notice in of_indices:
        yield notice.at(f"{where}, {notice.where}")
    if not len(model.real_hz):
        yield Notice(declared.NO_REAL_POLE, where, channel=channel)
    if stated is None:
        yield Notice(declared.GAIN_NOT_STATED, where)
    over = result.gains[0].normalised
    if over is not None and abs(over) > 1.0:
        yield Notice(declared.GAIN_DEVIATES, where, channel=channel, ratio=abs(over))


# From recordings of releases to models of a sensor's components.

_WITHOUT_MODEL = (
    declared.RELEASE_WITHOUT_MODEL.code,
    declared.STRUCTURE_NOT_FOUND.code,
    declared.COMPONENT_WITHOUT_MODEL.code,
)
"""Codes of the notices that state why there is no model."""


def evaluate_steps(
    name: str, manifests: Sequence[Manifest], settings: StepSettings, input_hashes: dict[str, str]
) -> StepEvaluation:
    """Evaluate recordings of the releases of one sensor: records → readings → models → indices.

    Parameters
    ----------
    name
        Name of the evaluation in the results.
    manifests
        Recordings of kind step, of one rig.
    settings
        Choices of the identification.
    input_hashes
        SHA-256 of the input files by name, for the results.

    Returns
    -------
    StepEvaluation : one result per load component.

    Raises
    ------
    InputError : a file or key that the user has to correct.
    ComputeError : no model was found for any component.

    Examples
    --------
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
            result, found = evaluate_component(by_component[component], settings)
            components.append(result)
            notices += found
    if all(result.pooled is None for result in components):
        why = next(notice for notice in notices if notice.code in _WITHOUT_MODEL)
        raise ComputeError(declared.NO_STEP_MODEL, recording=why.where, reason=why.text)
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
    """Return releases of one rig by component, each driving one output."""
    releases, notices = defaultdict[str, list[StepRelease]](list), list[Notice]()
    check_one_rig(manifests)
    for manifest in manifests:
        release, found = read_recording(manifest)
        notices += found
        component = release.record.component
        releases[component].append(release)
        check_driven_output(releases[component][0], release)
        if settings.release == "measured" and release.record.force is None:
            expected = "the name of the force channel, for --release measured"
            raise InputError(declared.MISSING_STEP_ENTRY, manifest.path, "excitation.force", expected=expected)
    return releases, notices
