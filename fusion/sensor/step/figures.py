"""Figures of step responses: record, fit and residual; releases by their device; models over frequency; convergence."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from fusion.base import MILLI, PERCENT
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    RASTER_ABOVE,
    RED,
    Picture,
    decades,
    draw_response,
    frequency_axis,
    panel_label,
    power_of_ten,
    sheet,
)
from fusion.sensor.step.evaluate import measured_response
from fusion.sensor.step.records import Pooled
from fusion.sensor.step.releases import LABELS, ComponentResult, Release
from shaker.arrays import FloatArray
from shaker.labels import typeset
from shaker.lti.system import ModalModel

DASHED = (0, (4, 2))
BEFORE, AFTER = 0.6, 8.0
"""Periods of the lowest mode that the enlarged panel shows before the onset and after the release."""
PERIODS = 12.0
POINTS = 500
HIGHEST = 6.0  # frequencies shown, over the highest mode
SHOWN_RELEASES = 3
OVER_ORDER = "sim"  # the loss of "sim_zoh" is its twin
OVER_GENERATION = ("evolution", "evolution_coefficients")


def component_pictures(component: ComponentResult) -> Iterator[Picture]:
    """Yield record and fit of the first release of the model, response over frequency, devices, and convergence."""
    if component.pooled is not None:
        yield draw_release(f"step-{component.component}", component.chosen[0])
        yield draw_model(f"bode-{component.component}", component, component.pooled)
    if len(component.ropes) > 1:
        yield draw_devices(f"ropes-{component.component}", component)
    losses: list[tuple[str, str, FloatArray, int | None]] = []
    for fit in (row.fit for row in component.methods if len(row.fit.convergence) > 1):
        if fit.method == OVER_ORDER:
            chosen = fit.order - 1 if 1 <= fit.order <= len(fit.convergence) else None
            losses.append((LABELS[fit.method].partition(",")[0], "order", fit.convergence, chosen))
        elif fit.method in OVER_GENERATION:
            losses.append((LABELS[fit.method], "generation", fit.convergence, None))
    if losses:
        yield draw_convergence(f"convergence-{component.component}", losses)


def draw_release(name: str, release: Release) -> Picture:
    """The whole record left, the release right; below what the fit leaves, over the change of the output."""
    record, reading, fit = release.record, release.reading, release.fit
    if fit is None:
        raise ValueError("release: expected one with a model, found none")
    measured, change, period = fit.fitted + fit.residual, abs(reading.steady - reading.baseline), _period_s(fit.model)
    low = fit.onset_s - BEFORE * period - 0.3 * fit.release_s
    near = (fit.time_s >= low) & (fit.time_s <= fit.onset_s + fit.release_s + AFTER * period)
    everywhere = np.ones(len(near), dtype=np.bool_)
    factor, power = power_of_ten(measured)
    with sheet(name, 4.8, 2, 2, heights=(2.0, 1.0)) as drawn:
        whole, enlarged, rest, rest_near = drawn.panels
        for upper, lower, shown, zoom in (
            (whole, rest, everywhere, ""),
            (enlarged, rest_near, near if np.count_nonzero(near) > 8 else everywhere, ", around the release"),
        ):
            time, dense = MILLI * fit.time_s[shown], np.count_nonzero(shown) > RASTER_ABOVE
            changing = (MILLI * fit.onset_s, MILLI * (fit.onset_s + fit.release_s))
            upper.axvspan(*changing, color=GREY, alpha=0.2, linewidth=0)
            dots: dict[str, Any] = {"marker": ".", "markersize": 3.5, "linestyle": "none"}
            look = {"linewidth": 0.8} if dense else dots
            upper.plot(time, measured[shown] / factor, color=BLUE, label="record", zorder=2, **look)
            dashed: dict[str, Any] = {"color": RED, "linewidth": 0.9, "linestyle": DASHED, "zorder": 2.5}
            upper.plot(time, fit.fitted[shown] / factor, label="fit", **dashed)
            upper.margins(x=0.01)
            lower.plot(time, PERCENT * fit.residual[shown] / change, color=BLACK, linewidth=0.6, zorder=2)
            lower.axhline(0.0, color=LIGHT, linewidth=0.8, zorder=1)
            lower.set_xlabel("time / ms")
            for axes, ticks, text in (
                (upper, 6, f"{release.name}: output {release.driven}{zoom}"),
                (lower, 4, f"record less fit{zoom}"),
            ):
                axes.set_rasterization_zorder(3 if dense else -1)
                axes.yaxis.set_major_locator(MaxNLocator(ticks))
                panel_label(axes, text)
        unit = f"{power}{typeset(record.unit)}"
        whole.set_ylabel(f"output / ({unit})" if " " in unit or "/" in unit else f"output / {unit}")
        rest.set_ylabel("residual / %")
        enlarged.legend(loc="best")
        caption = (
            "Record (blue) and fit (red, dashed); grey: while the load changes, by the fit. Below: the residual over "
            "the output's change; where the model is right it is noise alone."
        )
        title = f"{release.name}: record, fit and residual"
        return drawn.picture(title, caption, gap=(0.6, 0.3), left=0.82, label=0.62)


def draw_devices(name: str, component: ComponentResult) -> Picture:
    """The first release by each device over the time since its onset, over the longest release and some periods."""
    periods = [_period_s(release.fit.model) for release in component.releases if release.fit is not None]
    longest = max(rope.kind.length.mean for rope in component.ropes)
    span, points = 1.5 * longest + PERIODS * float(np.median(periods) if periods else longest), 0
    with sheet(name, 3.0) as drawn:
        (axes,) = drawn.panels
        for place, rope in enumerate(component.ropes):
            release = next(release for release in component.releases if release.name in rope.releases)
            record, reading = release.record, release.reading
            time = record.time_s - (reading.onset_s if release.fit is None else release.fit.onset_s)
            shown = (time >= -0.1 * span) & (time <= span)
            level = record.samples[record.channels.index(release.driven)][shown]
            share, points = (level - reading.baseline) / (reading.steady - reading.baseline), points + len(level)
            label, colour = f"{rope.name}, {MILLI * rope.kind.length.mean:.3g} ms", COLOURS[place % len(COLOURS)]
            axes.plot(MILLI * time[shown], share, color=colour, linewidth=0.9, label=label, zorder=3 - 0.1 * place)
        for end in (0.0, 1.0):
            axes.axhline(end, color=LIGHT, linewidth=0.8, zorder=1)
        axes.set_rasterization_zorder(4 if points > RASTER_ABOVE else -1)
        axes.set_xlabel("time since the onset / ms")
        axes.set_ylabel("share of the change")
        axes.margins(x=0.01)
        axes.legend(loc="lower right")
        panel_label(axes, f"output {component.channel}")
        caption = (
            "One release by each, over the output's change, with how long the load changed. What lets go at once makes "
            "the sensor ring; what takes longer than a period of the mode hardly does."
        )
        return drawn.picture("What let go", caption, left=0.7, label=0.5)


def draw_model(name: str, component: ComponentResult, pooled: Pooled) -> Picture:
    """The pooled model over its static gain with its bands, phase, and what its releases show by themselves."""
    model, static = pooled.model, pooled.model.static_gain
    responses = [measured_response(release) for release in component.chosen[:SHOWN_RELEASES]]
    rate_hz = min(release.record.sample_rate_hz for release in component.chosen)
    top_hz = min(0.4 * rate_hz, HIGHEST * float(np.max(_modes_hz(model))))
    low_hz = min(float(one.frequency_hz.min()) for one in responses)
    damping = np.maximum(np.abs(model.damping_ratio), 1e-5)
    near = [f * (1.0 + z * np.linspace(-8.0, 8.0, 81)) for f, z in zip(model.frequency_hz, damping, strict=True)]
    every = np.unique(np.concatenate([np.geomspace(low_hz, top_hz, POINTS), *near]))  # more where a mode is narrow
    frequency = every[(every >= low_hz) & (every <= top_hz)]
    kept = [one.frequency_hz <= top_hz for one in responses]

    def joined(field: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.concatenate([getattr(one, field)[k] for one, k in zip(responses, kept, strict=True)])

    def size(at: ModalModel) -> FloatArray:
        return np.asarray(np.log(np.abs(at.response(frequency) / at.static_gain)))

    u, _ = pooled.spread(model.jacobian(size)[1])
    measured_hz, measured, noise = joined("frequency_hz"), joined("value") / static, joined("u") / abs(static)
    value, there = model.response(frequency) / static, model.response(measured_hz) / static
    with sheet(name, 6.0, 3, heights=(2.0, 1.3, 1.1)) as drawn:
        upper, middle, lower = drawn.panels
        for index, colour, label in (("band_5_hz", GREEN, "±5 %"), ("band_10_hz", ORANGE, "±10 %")):
            end = component.find(index)
            if end is not None and np.isfinite(end.value):
                told = f"{label} up to {end.value:.4g} Hz"
                upper.axvline(end.value, color=colour, linewidth=1.0, zorder=1.5, label=told)
        dots: dict[str, Any] = {"color": BLUE, "markersize": 2.0, "zorder": 2}
        upper.plot(measured_hz, np.abs(measured), ".", label="releases", **dots)
        look: dict[str, Any] = {"color": RED, "linewidth": 1.0, "zorder": 2.5, "label": "model"}
        draw_response(upper, middle, frequency, value, (u, np.zeros(len(u))), unwrapped=True, **look)
        upper.axhline(1.0, color=LIGHT, linewidth=0.8, zorder=1)
        upper.set_ylim(0.4 * min(1.0, float(np.abs(value).min())), 2.0 * float(np.abs(value).max()))
        upper.set_ylabel("|H / H(0)|")
        upper.legend(loc="upper left", ncols=2)
        phase = np.degrees(np.unwrap(np.angle(value)))
        close = np.interp(measured_hz, frequency, phase)
        middle.plot(measured_hz, close + np.degrees(np.angle(measured * np.exp(-1j * np.radians(close)))), ".", **dots)
        middle.set_ylim(float(phase.min()) - 60.0, max(float(phase.max()), 0.0) + 60.0)
        middle.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 3, 4.5, 9, 10]))
        lower.plot(measured_hz, PERCENT * np.abs(measured - there), ".", color=BLACK, markersize=2.0, zorder=2)
        order = np.argsort(measured_hz)
        lower.plot(measured_hz[order], PERCENT * noise[order], color=GREY, linewidth=0.8, zorder=2.5)
        lower.set_yscale("log")
        lower.set_ylabel("difference / %")
        for axes in (upper, lower):
            decades(axes.yaxis)
        labels = (f"output {component.channel} over load {component.component}: magnitude", "phase")
        for axes, text in zip(drawn.panels, (*labels, "releases less model, over the static gain"), strict=True):
            axes.set_rasterization_zorder(2.2 if len(measured_hz) > 400 else -1)
            panel_label(axes, text)
        frequency_axis(lower, frequency, 1.0)
        caption = (
            "Model (red, with U) over its static gain, and what the releases show without a model (blue): the spectrum "
            "of the output's derivative over that of the load's. Green and orange: where |H| is within 5 and 10 % of "
            "the static gain. Below: their difference over the static gain, and what noise alone makes of it (grey)."
        )
        title = f"Output {component.channel} over load {component.component}"
        return drawn.picture(title, caption, gap=(0.5, 0.28))


def draw_convergence(name: str, losses: list[tuple[str, str, FloatArray, int | None]]) -> Picture:
    """Loss over the order or the generations of every method that has such a curve; a ring where an order was taken."""
    with sheet(name, 2.7, 1, len(losses)) as drawn:
        for axes, colour, (label, over, loss, chosen) in zip(drawn.panels, COLOURS, losses, strict=False):
            number, marker = np.arange(1, len(loss) + 1), "o" if len(loss) <= 20 else ""
            shown = loss / float(loss.min()) if loss.min() > 0.0 else loss
            axes.plot(number, shown, color=colour, linewidth=0.9, marker=marker, markersize=3.5, zorder=2)
            if chosen is not None:
                axes.plot(number[chosen], shown[chosen], "o", color=BLACK, markersize=6.5, fillstyle="none")
            if shown.max() > 20.0 * shown.min() > 0.0:
                axes.set_yscale("log")
                decades(axes.yaxis)
            axes.set_xlabel(over)
            axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            panel_label(axes, label)
        drawn.panels[0].set_ylabel("loss over the smallest")
        caption = (
            "Loss as each method defines it. SIM: of the equation error over the order, where it stops to fall the "
            "order is enough for that error, which is not yet the mode's. Differential evolution: of the best member."
        )
        title = "How the methods came to their models"
        return drawn.picture(title, caption, gap=(0.62, 0.3), left=0.72, label=0.54)


def _modes_hz(model: ModalModel) -> FloatArray:
    """Frequencies of the modes, of a model without one those of its real poles."""
    return np.asarray(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz))


def _period_s(model: ModalModel | None) -> float:
    """Period of the lowest mode."""
    return 1e-3 if model is None else 1.0 / float(np.min(_modes_hz(model)))
