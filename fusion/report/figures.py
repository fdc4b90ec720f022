"""Figures of acceleration and sensitivity over frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from fusion.base import prefix, typeset
from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.report.csv_files import sensitivity_element, sensitivity_unit
from fusion.report.numbers import (
    acceleration,
    bodies,
    by_source,
    driven_channel,
    driven_component,
    main_line,
    static_sensitivity,
)
from fusion.report.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    SOURCE_COLOUR,
    SOURCE_MARKER,
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
from fusion.sensitivity.analyse import Evaluation
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS

# Figures of the acceleration: sources side by side, and weak components in the complex plane.


def acceleration_pictures(evaluation: Evaluation) -> list[Picture]:
    """All figures of the accelerations."""
    pictures = []
    compared = [body for body in bodies(evaluation) if len(by_source(evaluation, body)) > 1]
    if any(_usable_reference(evaluation, body) for body in compared):
        pictures.append(draw_sources(evaluation, [body for body in compared if _usable_reference(evaluation, body)]))
    pictures += [draw_components(evaluation, body) for body in bodies(evaluation)]
    return pictures


def draw_sources(evaluation: Evaluation, compared: list[str]) -> Picture:
    """Driven component at the strongest line: each source's deviation from the fused value, in % and mrad."""
    component, line = driven_component(evaluation), main_line(evaluation)
    with drawing("sources"):
        counts = [len(by_source(evaluation, body)) for body in compared]
        figure = new_figure(0.75 + 0.33 * sum(counts) + 0.25 * len(compared))
        panels = figure.subplots(len(compared), 2, squeeze=False, sharex="col", gridspec_kw={"height_ratios": counts})
        for (left, right), body in zip(panels, compared, strict=True):
            _draw_deviations(left, right, by_source(evaluation, body), line, component)
            left.set_title(f"{body}, {MOTION_COMPONENTS[component]}")
        panels[-1, 0].set_xlabel("deviation of the amplitude / %")
        panels[-1, 1].set_xlabel("deviation of the phase / mrad")
        lay_out(figure, panels.flat, left=1.15, top=0.25, gap=(0.25, 0.35))
        frequency = float(evaluation.accelerations[0].phasors.frequency_hz[line])
        caption = (
            f"Driven acceleration at {frequency:.4f} Hz from each kind of instrument alone, relative to the fused "
            f"value; bars: U (95 %) of each; band: U of the fused value, to which all of them contribute."
        )
        return finish(figure, "sources", "Acceleration by source", caption)


def draw_components(evaluation: Evaluation, body: str) -> Picture:
    """Six components at the strongest line in the complex plane, with 95 % ellipses of every source."""
    name = f"components-{body}"
    line, results = main_line(evaluation), by_source(evaluation, body)
    with drawing(name):
        figure = new_figure(5.9)
        panels = figure.subplots(2, 3)
        for component, axes in enumerate(panels.flat):
            _draw_plane(axes, results, line, component)
        handles = [
            axes_handle
            for result in results
            for axes_handle in panels.flat[0].plot(
                [], [], color=SOURCE_COLOUR[result.source], marker=SOURCE_MARKER[result.source], linestyle="none"
            )
        ]
        labels = [result.source for result in results]
        lay_out(figure, panels.flat, bottom=0.75, top=0.25, gap=(0.8, 0.75), label=0.48)
        figure.legend(handles, labels, loc="lower center", ncols=len(labels))
        frequency = float(results[0].phasors.frequency_hz[line])
        caption = (
            f"Acceleration phasors of the {body} at the sensor origin, {frequency:.4f} Hz, with 95 % regions. A "
            f"component whose region holds the origin (cross) is not told apart from zero; its amplitude and phase "
            f"alone would mislead."
        )
        return finish(figure, name, f"Components of the {body} in the complex plane", caption)


def _usable_reference(evaluation: Evaluation, body: str) -> bool:
    """Whether several instruments were fused, and the driven component stands out of its uncertainty."""
    fused = acceleration(evaluation, body, "fused")
    if fused is None:
        return False
    if len(fused.instruments) < 2:
        return False
    element = _element(fused, main_line(evaluation), driven_component(evaluation))
    return element is not None and element.region.half_axes[0] < 0.5 * element.magnitude


def _element(result: Acceleration, line: int, component: int) -> Polar | None:
    """One component with its degrees of freedom, None where it is not determined."""
    value = complex(result.phasors.value[line, component])
    if not result.observed[line, component] or not np.isfinite(value):
        return None
    pair = element_covariance(result.phasors.covariance[line], component)
    return polar(value, pair, float(result.uncertainty.dof()[line, component]))


def _draw_deviations(left: Axes, right: Axes, results: list[Acceleration], line: int, component: int) -> None:
    """Relative amplitude and phase differences from the first result, the fused one."""
    names: list[str] = []
    reference = complex(results[0].phasors.value[line, component])
    for result in results:
        element = _element(result, line, component)
        if element is None:
            continue
        amplitude = 100.0 * (element.magnitude / abs(reference) - 1.0)
        u_amplitude = 100.0 * element.expanded_magnitude / abs(reference)
        phase = 1e3 * float(np.angle(complex(element.re, element.im) / reference))
        u_phase = 1e3 * element.expanded_phase_rad
        colour, marker = SOURCE_COLOUR[result.source], SOURCE_MARKER[result.source]
        for axes, middle, half in ((left, amplitude, u_amplitude), (right, phase, u_phase)):
            axes.errorbar(middle, len(names), xerr=half, fmt=marker, color=colour)
            if result.source == "fused":
                axes.axvspan(-half, half, color=LIGHT, alpha=0.6, linewidth=0)
        names.append(result.source)
    for axes in (left, right):
        axes.axvline(0.0, color=BLACK, linewidth=0.7)
        axes.set_yticks(range(len(names)), names if axes is left else [""] * len(names))
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")


def _draw_plane(axes: Axes, results: list[Acceleration], line: int, component: int) -> None:
    """One component of all sources in the complex plane."""
    found = [(result, element) for result in results if (element := _element(result, line, component)) is not None]
    unit = results[0].phasors.unit[component]
    axes.set_title(MOTION_COMPONENTS[component])
    if not found:
        axes.text(0.5, 0.5, "not observed", ha="center", va="center", color=GREY, transform=axes.transAxes)
        axes.set_axis_off()
        return
    factor, letter = prefix(np.array([element.magnitude for _, element in found]))
    low, high = _frame([element for _, element in found], factor)
    for result, element in found:
        colour = SOURCE_COLOUR[result.source]
        axes.add_patch(_ellipse(element, factor, colour))
        axes.plot(element.re / factor, element.im / factor, SOURCE_MARKER[result.source], color=colour, markersize=3.5)
    axes.plot(0.0, 0.0, "+", color=BLACK, markersize=8)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low.real, high.real)
    axes.set_ylim(low.imag, high.imag)
    axes.locator_params(nbins=4)
    axes.set_xlabel(f"Re / {letter}{typeset(unit)}")
    axes.set_ylabel(f"Im / {letter}{typeset(unit)}")


def _frame(found: list[Polar], factor: float) -> tuple[complex, complex]:
    """Corners of a square that holds the regions, and the origin where it is not far outside."""
    corners = [
        complex(element.re, element.im) + sign * element.region.half_axes[0] * (1 + 1j)
        for element in found
        for sign in (-1, 1)
    ]
    points = np.array(corners) / factor
    middle = complex((points.real.max() + points.real.min()) / 2.0, (points.imag.max() + points.imag.min()) / 2.0)
    half = 0.6 * max(np.ptp(points.real), np.ptp(points.imag), 1e-300)
    if abs(middle) < 8.0 * half:
        points = np.append(points, 0.0)
        middle = complex((points.real.max() + points.real.min()) / 2.0, (points.imag.max() + points.imag.min()) / 2.0)
        half = 0.6 * max(np.ptp(points.real), np.ptp(points.imag))
    half = max(half, 1e-6 * abs(middle), 1e-12)
    return middle - half * (1 + 1j), middle + half * (1 + 1j)


def _ellipse(element: Polar, factor: float, colour: str) -> Ellipse:
    """95 % region of a complex value."""
    region = element.region
    width, height = (2.0 * axis / factor for axis in region.half_axes)
    centre, angle = (element.re / factor, element.im / factor), float(np.degrees(region.angle_rad))
    return Ellipse(centre, width, height, angle=angle, facecolor="none", edgecolor=colour, linewidth=1.1)


# Figures of the result: sensitivity over frequency, cross outputs, uncertainty budget.


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
