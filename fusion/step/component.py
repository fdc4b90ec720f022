"""One load component: its releases become a model with indices, its ropes and methods are compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.models_file import ModelEntry
from fusion.notices import Notice
from fusion.results_csv import sensitivity_unit
from fusion.step.choose import choose_releases, common_structure
from fusion.step.figures import index_figures, parameter_figures
from fusion.step.gains import ropes, scale_uncertainty, stated_gain, static_gains
from fusion.step.methods import compare_methods, rows_of
from fusion.step.pool import Pooled, pool_models
from fusion.step.releases import fit_release, structure_of
from fusion.step.result import ComponentResult, Release
from fusion.step.settings import StepSettings


def evaluate_component(
    releases: Sequence[Release], settings: StepSettings
) -> tuple[ComponentResult, tuple[Notice, ...]]:
    """Return what the releases of one component, read but not fitted, say of it; all drive the same output."""
    component, channel = releases[0].input.record.component, releases[0].driven
    fitted, notices = _fitted(releases, settings)
    chosen = choose_releases(fitted)
    used, told = _of_one_structure(chosen.releases, settings)
    by_name = {release.name: release for release in used}
    fitted = tuple(by_name.get(release.name, release) for release in fitted)
    unit = sensitivity_unit(releases[0].input.record.unit, component)
    manifest = releases[0].input.manifest
    pooled = _pooled(used, scale_uncertainty(manifest, channel)) if used else None
    names = tuple(release.name for release in used)
    stated, _ = stated_gain(manifest, channel, component)
    rate_hz = releases[0].input.record.sample_rate_hz
    found = None if pooled is None else index_figures(pooled, stated, unit, rate_hz)
    rows = rows_of(fitted)
    of_methods: tuple[Notice, ...] = ()
    if settings.method == "all" and used:
        rows, of_methods = compare_methods(used[0], settings)
    result = ComponentResult(
        component=component,
        channel=channel,
        unit=unit,
        releases=fitted,
        used=names,
        reason=chosen.reason,
        pooled=pooled,
        parameters=() if pooled is None else parameter_figures(pooled, unit),
        indices=None if found is None else found[0],
        figures=() if found is None else found[1],
        gains=tuple(static_gains(fitted)),
        ropes=ropes(fitted, names),
        methods=rows,
        entry=None if pooled is None else _entry(pooled, used, unit),
    )
    return result, (*notices, *told, *of_methods, *_of_result(result, stated))


def _fitted(releases: Sequence[Release], settings: StepSettings) -> tuple[tuple[Release, ...], tuple[Notice, ...]]:
    """All releases with their models."""
    found = [fit_release(release, settings) for release in releases]
    return tuple(release for release, _ in found), tuple(notice for _, told in found for notice in told)


def _of_one_structure(
    releases: Sequence[Release], settings: StepSettings
) -> tuple[tuple[Release, ...], tuple[Notice, ...]]:
    """Fit those releases anew whose models have another structure; what cannot be fitted so is left out."""
    if not releases:
        return (), ()
    wanted = common_structure(releases)
    found: list[Release] = []
    notices: list[Notice] = []
    for release in releases:
        if release.fit is not None and structure_of(release.fit) == wanted:
            found.append(release)
            continue
        again, told = fit_release(release, settings, wanted)
        notices += told
        kept = again.fit is not None and structure_of(again.fit) == wanted
        text = f"{_count(wanted[0], 'mode')} and {_count(wanted[1], 'real pole')} as the others show them"
        if kept:
            found.append(again)
            notices.append(Notice("info", f"{release.driven}: fitted anew with {text}", release.name))
        else:
            notices.append(Notice("warning", f"{release.driven}: left out, no model with {text}", release.name))
    return tuple(found), tuple(notices)


def _count(number: int, what: str) -> str:
    """A number of things."""
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"


def _pooled(releases: Sequence[Release], u_scale: float) -> Pooled:
    """One model from those of the releases."""
    models = [release.fit.model for release in releases if release.fit is not None]
    mountings = [release.input.manifest.mounting for release in releases]
    return pool_models([model for model in models if model is not None], mountings, u_scale)


def _entry(pooled: Pooled, releases: Sequence[Release], unit: str) -> ModelEntry:
    """What models.json holds of a component."""
    record, first = releases[0].input.record, releases[0]
    return ModelEntry(
        channel=first.driven,
        component=record.component,
        unit=unit,
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
        found.append(Notice("info", "all releases are of one mounting: what mounting anew changes is not in U", where))
    if result.indices is not None:
        found += [Notice(n.severity, n.text, f"{where}, {n.where}") for n in result.indices.notices]
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
