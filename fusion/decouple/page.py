"""decouple.html: one self-contained page with modes, cross-talk before and after, filter and origin."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.decouple import tables
from fusion.decouple.result import DecoupleEvaluation, K
from fusion.evaluated import page_frame
from fusion.page import render_page
from fusion.plots.decouple import CrosstalkCurves, StepCurves, draw_crosstalk, draw_step
from fusion.plots.style import Picture
from shaker.models.decoupling.crosstalk import raw_reading, static_inverse, step_readings, step_times

PAGE_FILE = "decouple.html"
SHOWN_S = 5e-3


def render_decouple_page(evaluation: DecoupleEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("decouple.html", _context(evaluation))


def _context(evaluation: DecoupleEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "crosstalk": [_crosstalk(evaluation)],
        "peaks": tables.peak_tables(evaluation),
        "steps": [_step(evaluation)],
        "modes": tables.modes_table(evaluation),
        "static": tables.static_table(evaluation),
        "noise": tables.noise_table(evaluation),
        "releases": tables.releases_table(evaluation),
        "trials": tables.trials_table(evaluation),
        "deviation": f"{100 * float(evaluation.deviation[_within(evaluation)].max()):.2g}",
        **page_frame(evaluation),
    }


def _within(evaluation: DecoupleEvaluation) -> Any:
    """Which frequencies lie below that of the wanted dynamics."""
    return evaluation.frequency_hz <= evaluation.decoupler.target_hz.max()


def _subject(evaluation: DecoupleEvaluation) -> list[tuple[str, str]]:
    """What was released: rig, sensor, recordings."""
    rig = evaluation.manifests[0].rig
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        facts.append(("Sensor", f"{rig.sensor.name} {rig.sensor.serial}".strip()))
    model = evaluation.fit.model
    counts = [
        f"{name} {sum(release.component == name for release in evaluation.fit.releases)}" for name in model.components
    ]
    facts.append(("Releases", ", ".join(counts)))
    facts.append(("Outputs", f"{', '.join(model.channels)} at {evaluation.fit.sample_rate_hz:g} Hz"))
    return facts


def _crosstalk(evaluation: DecoupleEvaluation) -> Picture:
    """The largest cross-talk of every load over frequency."""
    curves, ratio = [], 100 * evaluation.scale / evaluation.scale[:, None]
    names = evaluation.fit.model.components
    for j, load in enumerate(names):
        others = [i for i in range(len(names)) if i != j and evaluation.comparable(i, j)]
        if not others:
            continue
        values, expanded = [], []
        for stage in evaluation.stages:
            size = np.abs(stage.value[:, others, j]) * ratio[others, j]
            worst = np.argmax(size, axis=1)[:, None]
            spread = K * stage.u[:, others, j] * ratio[others, j]
            values.append(np.take_along_axis(size, worst, axis=1)[:, 0])
            expanded.append(np.take_along_axis(spread, worst, axis=1)[:, 0])
        stages = tuple(stage.stage for stage in evaluation.stages)
        labels = tuple(tables.STAGE_NAMES[stage] for stage in stages)
        curves.append(CrosstalkCurves(load, evaluation.frequency_hz, stages, labels, tuple(values), tuple(expanded)))
    return draw_crosstalk(curves, evaluation.fit.model.frequency_hz, float(evaluation.decoupler.target_hz[0]))


def _step(evaluation: DecoupleEvaluation) -> Picture:
    """The readings while the load steps that shows most with the static matrix alone."""
    model, ratio = evaluation.fit.model, evaluation.scale / evaluation.scale[:, None]
    static = next(stage for stage in evaluation.stages if stage.stage == "static")
    size = np.where(np.eye(len(model.components), dtype=np.bool_), 0.0, static.peak * ratio)
    for i, j in np.ndindex(size.shape):
        size[i, j] *= evaluation.comparable(i, j)
    load = int(np.argmax(size.max(axis=0)))
    time_s = step_times(model, evaluation.decoupler)
    time_s = time_s[time_s <= SHOWN_S]
    matrices = (("raw", raw_reading(model)), ("static", static_inverse(model, evaluation.fit.noise)))
    readers = [(stage, reader) for stage, reader in matrices if reader is not None]
    shown = [(stage, step_readings(model, reader, time_s)[:, :, load]) for stage, reader in readers]
    shown.append(("filtered", step_readings(model, evaluation.decoupler, time_s)[:, :, load]))
    labels = tuple(tables.STAGE_NAMES[stage] for stage, _ in shown)
    values = tuple(value * ratio[:, load] for _, value in shown)
    return draw_step(StepCurves(model.components[load], model.components, time_s, labels, values))
