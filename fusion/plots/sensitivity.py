"""Figures of the result: sensitivity over frequency, cross outputs, uncertainty budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from fusion.evaluation import Evaluation
from fusion.highlights import LOAD_COMPONENTS, driven_channel, driven_component, main_line, static_sensitivity
from fusion.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    FloatArray,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    power_text,
    static_axis,
)
from fusion.polar import Polar, typeset
from fusion.results_csv import sensitivity_element, sensitivity_unit

HARMONIC_SHOWN_BELOW = 0.2
BUDGET_ENTRIES = 14


@dataclass(frozen=True)
class Curve:
    """One element of the sensitivity over frequency: `points` and whether each is a harmonic, static value or None."""

    label: str
    unit: str
    frequency_hz: FloatArray
    points: tuple[Polar, ...]
    harmonic: tuple[bool, ...]
    static: float | None


def sensitivity_pictures(evaluation: Evaluation) -> list[Picture]:
    """All figures of the sensitivity of one recording."""
    if evaluation.sensitivity is None:
        return []
    curve, ratio = driven_curve(evaluation), evaluation.sensitivity.value[main_line(evaluation)]
    pictures = [draw_curve(curve)] if curve.points else []
    if len(ratio) > 1 and np.isfinite(ratio[:, driven_component(evaluation)]).all():
        pictures.append(draw_outputs(evaluation))
    return pictures


def driven_curve(evaluation: Evaluation) -> Curve:
    """The driven element of a recording's sensitivity."""
    found, component, channel = evaluation.sensitivity, driven_component(evaluation), driven_channel(evaluation)
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    lines = [k for k in range(len(found.frequency_hz)) if np.isfinite(found.value[k, channel, component])]
    static = static_sensitivity(evaluation)
    return Curve(
        label=f"output {found.channels[channel]} per load {LOAD_COMPONENTS[component]}",
        unit=sensitivity_unit(found.unit, LOAD_COMPONENTS[component]),
        frequency_hz=found.frequency_hz[lines],
        points=tuple(sensitivity_element(found, k, channel, component) for k in lines),
        harmonic=tuple(found.kind[k] == "harmonic" for k in lines),
        static=None if static is None or static[channel, component] == 0.0 else float(static[channel, component]),
    )


def draw_curve(curve: Curve) -> Picture:
    """Magnitude and phase of one element over frequency with U (95 %), and the static value."""
    with drawing("sensitivity"):
        figure = new_figure(4.3)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.5, 1.0]})
        shown = [
            k
            for k, point in enumerate(curve.points)
            if point.expanded_magnitude < HARMONIC_SHOWN_BELOW * point.magnitude
        ]
        factor = _power_of_ten(curve)
        magnitude = np.array([point.magnitude for point in curve.points]) / factor
        u_magnitude = np.array([point.expanded_magnitude for point in curve.points]) / factor
        phase = np.array([point.phase_rad for point in curve.points])
        u_phase = np.array([point.expanded_phase_rad for point in curve.points])
        _points(upper, curve, shown, magnitude, u_magnitude)
        _points(lower, curve, shown, phase, u_phase)
        _limits(upper, shown, magnitude, u_magnitude, None if curve.static is None else abs(curve.static) / factor)
        _limits(lower, shown, phase, u_phase, 0.0)
        power = int(np.log10(factor))
        times = f"{power_text(power)} " if power else ""
        upper.set_ylabel(f"magnitude / {times}{typeset(curve.unit)}")
        lower.set_ylabel("phase / rad")
        lower.set_xlabel("frequency / Hz")
        lower.axhline(0.0, color=GREY, linewidth=0.8)
        _static_line(upper, curve, factor)
        upper.legend(loc="best")
        lay_out(figure, [upper, lower], right=0.75, left=0.8, label=0.62)
        hidden = len(curve.points) - len(shown)
        omitted = f" {hidden} line(s) with U above {HARMONIC_SHOWN_BELOW:.0%} are in the table only." if hidden else ""
        caption = f"Complex sensitivity, {curve.label}: magnitude and phase; bars: U (95 %).{omitted}"
        return finish(figure, "sensitivity", "Sensitivity over frequency", caption)


def draw_outputs(evaluation: Evaluation) -> Picture:
    """All outputs at the strongest line, relative to the driven one or to each output's rated signal."""
    found, component, driven = evaluation.sensitivity, driven_component(evaluation), driven_channel(evaluation)
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    line = main_line(evaluation)
    scale, what = _output_scale(evaluation, driven, component)
    elements = [sensitivity_element(found, line, c, component) for c in range(len(found.channels))]
    size = 100.0 * np.array([element.magnitude for element in elements]) / scale
    expanded = 100.0 * np.array([_reach(element) for element in elements]) / scale
    bound = np.array([element.region.holds_zero for element in elements])
    with drawing("outputs"):
        figure = new_figure(0.9 + 0.3 * len(size))
        axes = figure.subplots()
        _draw_levels(axes, size, expanded, driven, bound)
        axes.set_yticks(range(len(size)), [f"output {name}" for name in found.channels])
        axes.set_ylim(len(size) - 0.4, -0.6)
        axes.set_xlabel(f"{what} / %")
        lay_out(figure, [axes], left=1.1)
        load = LOAD_COMPONENTS[component]
        caption = (
            f"All outputs under the {load} load at {found.frequency_hz[line]:.4f} Hz, {what}; bars: U (95 %). An "
            f"arrow is an upper bound where the output is not distinguishable from 0. A cross output of one recording "
            f"holds both the sensor's cross-talk and its answer to loads that were not meant to act."
        )
        return finish(figure, "outputs", f"All outputs under {load}", caption)


def draw_budget(labels: Sequence[str], types: Sequence[str], u_relative: FloatArray, what: str) -> Picture:
    """Contributions (M,) of an uncertainty budget, largest first, with each one's share of the variance."""
    order = np.argsort(u_relative)[::-1]
    order = order[u_relative[order] > 1e-3 * u_relative.max()][:BUDGET_ENTRIES]
    share = 100.0 * u_relative**2 / np.sum(u_relative**2)
    with drawing("budget"):
        figure = new_figure(0.85 + 0.24 * len(order))
        axes = figure.subplots()
        for place, entry in enumerate(order):
            axes.barh(place, 100.0 * u_relative[entry], height=0.66, color=BLUE if types[entry] == "A" else ORANGE)
            text = f" {share[entry]:.1f} %" if share[entry] >= 0.05 else " < 0.1 %"
            axes.text(100.0 * u_relative[entry], place, text, va="center", fontsize=7.5)
        axes.set_yticks(range(len(order)), [labels[entry] for entry in order])
        axes.set_ylim(len(order) - 0.4, -0.6)
        axes.set_xlim(0.0, 115.0 * float(u_relative.max()))
        axes.set_xlabel("relative standard uncertainty (k = 1) / %")
        axes.barh(-5.0, 0.0, color=BLUE, label="type A")
        axes.barh(-5.0, 0.0, color=ORANGE, label="type B")
        axes.legend(loc="lower right")
        lay_out(figure, [axes], left=3.0)
        caption = f"Uncertainty budget of {what}; beside each bar its share of the variance."
        return finish(figure, "budget", "Uncertainty budget", caption)


def _power_of_ten(curve: Curve) -> float:
    """Factor to take off the magnitudes."""
    sizes = [point.magnitude for point in curve.points] + ([abs(curve.static)] if curve.static else [])
    largest = max(sizes, default=1.0)
    power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    return 1.0 if -2 <= power < 4 else 10.0**power


def _points(axes: Axes, curve: Curve, shown: list[int], value: FloatArray, expanded: FloatArray) -> None:
    """Points with error bars: filled for the curve, open for harmonics."""
    for harmonic, face, label in ((False, BLUE, "driven frequency"), (True, "white", "harmonic, no part of the curve")):
        chosen = [k for k in shown if curve.harmonic[k] == harmonic]
        if chosen:
            axes.errorbar(
                curve.frequency_hz[chosen],
                value[chosen],
                expanded[chosen],
                fmt="o",
                color=BLUE,
                markerfacecolor=face,
                elinewidth=1.0,
                label=label,
            )


def _limits(axes: Axes, shown: list[int], value: FloatArray, expanded: FloatArray, reference: float | None) -> None:
    """Limits that hold the points with their bars and the reference."""
    ends = [*(value - expanded)[shown], *(value + expanded)[shown], *([] if reference is None else [reference])]
    if ends:
        axes.set_ylim(padded(min(ends), max(ends)))
    axes.yaxis.set_major_locator(MaxNLocator(6))


def _static_line(axes: Axes, curve: Curve, factor: float) -> None:
    """Static sensitivity and, on the right, the deviation from it."""
    axes.set_xlim(0.0, 1.12 * float(curve.frequency_hz.max(initial=1.0)))
    if curve.static is None:
        return
    static_axis(axes, abs(curve.static) / factor, "static sensitivity")


def _output_scale(evaluation: Evaluation, driven: int, component: int) -> tuple[FloatArray, str]:
    """What 100 % is for each output (C,), and its name."""
    found, sensor, static = evaluation.sensitivity, evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    if static is not None and sensor is not None and sensor.capacity is not None:
        own = [LOAD_COMPONENTS.index(name) if name in LOAD_COMPONENTS else -1 for name in found.channels]
        capacity = np.asarray(sensor.capacity, dtype=np.float64)
        rated = np.array([abs(static[c, j]) * capacity[j] if j >= 0 else 0.0 for c, j in enumerate(own)])
        if np.all(rated > 0.0):
            return rated / capacity[component], f"share of the rated output at rated {LOAD_COMPONENTS[component]}"
    size = abs(found.value[main_line(evaluation), driven, component])
    return np.full(len(found.channels), size), f"ratio to output {found.channels[driven]}"


def _reach(element: Polar) -> float:
    """U of a magnitude; where the value may be zero, how far its region reaches beyond it."""
    return element.region.half_axes[0] if element.region.holds_zero else element.expanded_magnitude


def _draw_levels(axes: Axes, size: FloatArray, expanded: FloatArray, driven: int, bound: NDArray[np.bool_]) -> None:
    """Points on a logarithmic axis; where a value may be zero (`bound`), an arrow from the end of its region."""
    axes.set_xscale("log")
    decades(axes.xaxis)
    for place, (value, half) in enumerate(zip(size, expanded, strict=True)):
        colour = BLACK if place == driven else BLUE
        if bound[place]:
            axes.errorbar(
                value + half, place, xerr=[[0.6 * (value + half)], [0.0]], xuplims=True, color=GREY, fmt="none"
            )
        else:
            axes.errorbar(value, place, xerr=half, fmt="o", color=colour)
    ends = np.concatenate([(size + expanded), (size - expanded)[~bound], 0.3 * (size + expanded)[bound]])
    axes.set_xlim(0.5 * float(ends.min()), 2.0 * float(ends.max()))
