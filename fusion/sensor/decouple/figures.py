"""Figures of a decoupling: cross-talk over frequency, and readings while a load makes a step."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.base import K2
from fusion.report.style import (
    BLUE,
    COLOURS,
    GREY,
    ORANGE,
    Picture,
    decades,
    panel_label,
    sheet,
)
from fusion.sensor.decouple.evaluate import DecoupleEvaluation
from shaker.decoupling.filter import raw_reading, static_inverse, step_readings, step_times

STAGE_COLOURS = {"raw": GREY, "static": ORANGE, "filtered": BLUE}
COLUMNS = 2
LEAST = 1e-6
STAGE_NAMES = {"raw": "each output alone", "static": "static matrix", "filtered": "filter"}
SHOWN_S = 5e-3


def draw_crosstalk(evaluation: DecoupleEvaluation) -> Picture:
    """The largest reading of any other load while one oscillates, over frequency, before and after."""
    names, ratio = evaluation.fit.model.components, 100 * evaluation.scale / evaluation.scale[:, None]
    others = {j: [i for i in range(len(names)) if i != j and evaluation.comparable(i, j)] for j in range(len(names))}
    loads = [j for j in others if others[j]]
    rows, frequency = -(-len(loads) // COLUMNS), evaluation.frequency_hz
    with sheet("decouple-crosstalk", 1.9 * rows + 0.6, rows, COLUMNS, sharex=True, sharey=True) as drawn:
        used = drawn.panels[: len(loads)]
        for axes, j in zip(used, loads, strict=True):
            for stage in evaluation.stages:
                size = np.abs(stage.value[:, others[j], j]) * ratio[others[j], j]
                worst, u = np.argmax(size, axis=1)[:, None], stage.u[:, others[j], j] * ratio[others[j], j]
                value = np.take_along_axis(size, worst, axis=1)[:, 0]
                expanded, colour = K2 * np.take_along_axis(u, worst, axis=1)[:, 0], STAGE_COLOURS[stage.stage]
                axes.plot(frequency, np.maximum(value, LEAST), color=colour, label=STAGE_NAMES[stage.stage])
                low, high = np.maximum(value - expanded, LEAST), np.maximum(value + expanded, LEAST)
                axes.fill_between(frequency, low, high, color=colour, alpha=0.2, linewidth=0)
            for mode in evaluation.fit.model.frequency_hz:
                axes.axvline(mode, color=GREY, linewidth=0.6, linestyle=":")
            axes.axvline(float(evaluation.decoupler.target_hz[0]), color=GREY, linewidth=0.8, linestyle=(0, (5, 3)))
            axes.set(xscale="log", yscale="log", xlim=(frequency[0], frequency[-1]), ylim=(1e-3, 1e3))
            decades(axes.yaxis)
            panel_label(axes, f"{names[j]} oscillates")
        for axes in drawn.panels[len(loads) :]:
            axes.set_visible(False)
        for axes in used[max(0, len(loads) - COLUMNS) :]:
            axes.set_xlabel("frequency / Hz")
            axes.tick_params(labelbottom=True)
        for axes in used[::COLUMNS]:
            axes.set_ylabel("cross-talk / %")
        used[0].legend(loc="lower right", ncols=3, bbox_to_anchor=(2.1, 1.08), borderaxespad=0.0)
        caption = (
            "Largest reading of any other load while one oscillates, in rated loads. Shaded: U (k = 2) by the "
            "uncertainty of the model. Dotted: modes; dashed: frequency of the wanted dynamics."
        )
        layout: dict[str, Any] = {"top": 0.42, "gap": (0.25, 0.3), "left": 0.7, "label": 0.52}
        return drawn.picture("Cross-talk over frequency", caption, **layout)


def draw_step(evaluation: DecoupleEvaluation) -> Picture:
    """Readings of the other loads while the load steps that shows most with the static matrix alone, by stage."""
    model, ratio = evaluation.fit.model, evaluation.scale / evaluation.scale[:, None]
    static = next(stage for stage in evaluation.stages if stage.stage == "static")
    size = np.where(np.eye(len(model.components), dtype=np.bool_), 0.0, static.peak * ratio)
    for i, j in np.ndindex(size.shape):
        size[i, j] *= evaluation.comparable(i, j)
    load = int(np.argmax(size.max(axis=0)))
    time_s = step_times(model, evaluation.decoupler)
    time_s = time_s[time_s <= SHOWN_S]
    matrices = (("raw", raw_reading(model)), ("static", static_inverse(model, evaluation.fit.noise)))
    readings = {s: step_readings(model, reader, time_s) for s, reader in matrices if reader is not None}
    readings["filtered"] = step_readings(model, evaluation.decoupler, time_s)
    name = model.components[load]
    with sheet(f"decouple-step-{name}", 1.5 * len(readings) + 0.6, len(readings)) as drawn:
        for axes, (stage, value) in zip(drawn.panels, readings.items(), strict=True):
            for d, reading in enumerate(model.components):
                if d != load:
                    share = 100 * (value[:, :, load] * ratio[:, load])[:, d]
                    axes.plot(1e3 * time_s, share, color=COLOURS[d], label=reading, linewidth=0.8)
            axes.set_ylabel("reading / %")
            panel_label(axes, f"step of {name}: {STAGE_NAMES[stage]}")
        drawn.panels[-1].set_xlabel("time after the step / ms")
        drawn.panels[0].legend(loc="lower right", ncols=6, bbox_to_anchor=(1.0, 1.02), borderaxespad=0.0)
        caption = (
            "Readings of all other loads by the model, in per cent of their rated loads for a step of the rated one."
        )
        title = f"Other loads while {name} makes a step"
        return drawn.picture(title, caption, top=0.3, gap=(0.5, 0.3), label=0.52)
