"""One load component: its releases become a model with indices, its ropes and methods are compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.models_file import ModelEntry
from fusion.notices import Notice
from fusion.results_csv import sensitivity_unit
from fusion.step.figures import index_figures, parameter_figures
from fusion.step.fitting import Fitted
from fusion.step.gains import ropes, scale_uncertainty, stated_gain, static_gains
from fusion.step.methods import compare_methods, rows_of
from fusion.step.pool import Pooled, pool_models
from fusion.step.result import ComponentResult, Release
from fusion.step.settings import StepSettings


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
