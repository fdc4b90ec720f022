"""Figures of acceleration and sensitivity over frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from fusion.base import prefix
from fusion.estimation.coverage import Polar
from fusion.estimation.fuse import Acceleration, Source
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
    frame_bars,
    polar_bars,
    power_of_ten,
    sheet,
)
from fusion.report.table import sensitivity_unit
from fusion.report.tables import (
    acceleration,
    bodies,
    by_source,
    driven_channel,
    driven_component,
    main_line,
    main_result,
    result_elements,
    result_name,
    sensitivity_element,
    static_sensitivity,
    static_value,
)
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import Sensitivity
from shaker.arrays import BoolArray, FloatArray
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, typeset

BUDGET_ENTRIES = 14
SHOWN_BELOW = 0.2
"""Share of a magnitude that its U must be below to be drawn."""

# Figures of the acceleration: sources side by side, and weak components in the complex plane.


def acceleration_pictures(evaluation: Evaluation) -> list[Picture]:
    """All figures of the accelerations."""
    compared = [body for body in bodies(evaluation) if _has_reference(evaluation, body)]
    pictures = [draw_sources(evaluation, compared)] if compared else []
    return pictures + [draw_components(evaluation, body) for body in bodies(evaluation)]


def draw_sources(evaluation: Evaluation, compared: list[str]) -> Picture:
    """Driven component at the strongest line: each source's deviation from the fused value, in % and mrad."""
    component, line = driven_component(evaluation), main_line(evaluation)
    counts = [len(by_source(evaluation, body)) for body in compared]
    height = 0.75 + 0.33 * sum(counts) + 0.25 * len(compared)
    with sheet("sources", height, len(compared), 2, heights=counts) as drawn:
        for place, body in enumerate(compared):
            left, right = drawn.panels[2 * place : 2 * place + 2]
            _draw_deviations(left, right, by_source(evaluation, body), line, component)
            left.set_title(f"{body}, {MOTION_COMPONENTS[component]}")
        drawn.panels[-2].set_xlabel("deviation of the amplitude / %")
        drawn.panels[-1].set_xlabel("deviation of the phase / mrad")
        frequency = float(evaluation.accelerations[0].phasors.frequency_hz[line])
        caption = (
            f"Driven acceleration at {frequency:.4f} Hz from each kind of instrument alone, relative to the fused "
            f"value; bars: U (95 %) of each; band: U of the fused value, to which all of them contribute."
        )
        return drawn.picture("Acceleration by source", caption, left=1.15, top=0.25, gap=(0.25, 0.35), label=0.52)


def draw_components(evaluation: Evaluation, body: str) -> Picture:
    """Six components at the strongest line in the complex plane, with 95 % ellipses of every source."""
    line, results = main_line(evaluation), by_source(evaluation, body)
    found = {result.source: result_elements(result)[line] for result in results}
    with sheet(f"components-{body}", 5.9, 2, 3, sharex=False) as drawn:
        for component, axes in enumerate(drawn.panels):
            axes.set_title(MOTION_COMPONENTS[component])
            known = {source: element for source, row in found.items() if (element := row[component]) is not None}
            _draw_plane(axes, known, typeset(results[0].phasors.unit[component]))
        handles, labels = [], [result.source for result in results]
        for source in labels:
            look: dict[str, Any] = {"color": SOURCE_COLOUR[source], "marker": SOURCE_MARKER[source]}
            handles += drawn.panels[0].plot([], [], linestyle="none", **look)
        drawn.figure.legend(handles, labels, loc="lower center", ncols=len(labels))
        frequency = float(results[0].phasors.frequency_hz[line])
        caption = (
            f"Acceleration phasors of the {body} at the sensor origin, {frequency:.4f} Hz, with 95 % regions. A "
            f"component whose region holds the origin (cross) is not told apart from zero; its amplitude and phase "
            f"alone would mislead."
        )
        layout: dict[str, Any] = {"left": 0.72, "bottom": 0.75, "top": 0.25, "gap": (0.8, 0.75), "label": 0.48}
        return drawn.picture(f"Components of the {body} in the complex plane", caption, **layout)


def _has_reference(evaluation: Evaluation, body: str) -> bool:
    """Whether several instruments were fused, and the driven component stands out of its uncertainty."""
    fused = acceleration(evaluation, body, "fused")
    if fused is None or len(fused.instruments) < 2 or len(by_source(evaluation, body)) < 2:
        return False
    element = result_elements(fused)[main_line(evaluation)][driven_component(evaluation)]
    return element is not None and element.region.half_axes[0] < 0.5 * element.magnitude


def _draw_deviations(left: Axes, right: Axes, results: list[Acceleration], line: int, component: int) -> None:
    """Relative amplitude and phase differences from the first result, the fused one."""
    names: list[str] = []
    reference = complex(results[0].phasors.value[line, component])
    for result in results:
        element = result_elements(result)[line][component]
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


def _draw_plane(axes: Axes, known: Mapping[Source, Polar], unit: str) -> None:
    """One component in the complex plane from every source that determines it, each with its 95 % region."""
    if not known:
        axes.text(0.5, 0.5, "not observed", ha="center", va="center", color=GREY, transform=axes.transAxes)
        axes.set_axis_off()
        return
    factor, letter = prefix([element.magnitude for element in known.values()])
    low, high = _frame(list(known.values()), factor)
    for source, element in known.items():
        colour, centre = SOURCE_COLOUR[source], (element.re / factor, element.im / factor)
        width, height = (2.0 * axis / factor for axis in element.region.half_axes)
        look: dict[str, Any] = {"facecolor": "none", "edgecolor": colour, "linewidth": 1.1}
        axes.add_patch(Ellipse(centre, width, height, angle=float(np.degrees(element.region.angle_rad)), **look))
        axes.plot(*centre, SOURCE_MARKER[source], color=colour, markersize=3.5)
    axes.plot(0.0, 0.0, "+", color=BLACK, markersize=8)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low.real, high.real)
    axes.set_ylim(low.imag, high.imag)
    axes.locator_params(nbins=4)
    axes.set_xlabel(f"Re / {letter}{unit}")
    axes.set_ylabel(f"Im / {letter}{unit}")


def _frame(known: list[Polar], factor: float) -> tuple[complex, complex]:
    """Corners of a square that holds the regions, and the origin where it is not far outside."""

    def square(points: NDArray[Any]) -> tuple[complex, float]:
        """Middle and half a side, with some room."""
        middle = complex(points.real.max() + points.real.min(), points.imag.max() + points.imag.min()) / 2.0
        return middle, 0.6 * float(max(np.ptp(points.real), np.ptp(points.imag), 1e-300))

    centres = np.array([complex(element.re, element.im) for element in known], dtype=np.complex128)
    reach = np.array([element.region.half_axes[0] for element in known]) * (1 + 1j)
    points = np.concatenate([centres - reach, centres + reach]) / factor
    middle, half = square(points)
    if abs(middle) < 8.0 * half:
        middle, half = square(np.append(points, 0.0))
    half = max(half, 1e-6 * abs(middle), 1e-12)
    return middle - half * (1 + 1j), middle + half * (1 + 1j)


# Figures of the result: sensitivity over frequency, cross outputs, uncertainty budget.


def sensitivity_pictures(evaluation: Evaluation) -> list[Picture]:
    """All figures of the sensitivity of one recording."""
    sensitivity, main = evaluation.sensitivity, main_result(evaluation)
    if sensitivity is None or main is None:
        return []
    component = driven_component(evaluation)
    known = np.isfinite(main[0].value[:, driven_channel(evaluation), component])
    pictures = [draw_curve(evaluation, main[0])] if known.any() else []
    ratio = sensitivity.value[main_line(evaluation)]
    if len(ratio) > 1 and np.isfinite(ratio[:, component]).all():
        pictures.append(draw_outputs(evaluation, sensitivity))
    return pictures


def draw_curve(evaluation: Evaluation, sensitivity: Sensitivity) -> Picture:
    """Magnitude and phase of the driven element over frequency with U (95 %), and the static value."""
    component, channel = driven_component(evaluation), driven_channel(evaluation)
    what = "Sensitivity" if "element" in sensitivity.kind else "Ratio"
    label = f"output {sensitivity.channels[channel]} per load {LOAD_COMPONENTS[component]}"
    label = f"{what}, {label}" + (", with what other loads put into it" if what == "Ratio" else "")
    lines = np.flatnonzero(np.isfinite(sensitivity.value[:, channel, component])).tolist()
    points = [sensitivity_element(sensitivity, k, channel, component) for k in lines]
    shown = np.array([point.expanded_magnitude < SHOWN_BELOW * point.magnitude for point in points])
    harmonic = np.array([sensitivity.kind[k] == "harmonic" for k in lines])
    static = static_value(evaluation, channel, component)
    sizes = [point.magnitude for point in points] + ([] if static is None else [abs(static)])
    factor, power = power_of_ten(np.array(sizes))
    value, expanded = polar_bars(points, factor)
    frequency = sensitivity.frequency_hz[lines]
    with sheet("sensitivity", 4.3, 2, heights=(1.5, 1.0)) as drawn:
        upper, lower = drawn.panels
        for axes, level, half in zip(drawn.panels, value, expanded, strict=True):
            for own, face, text in (
                (shown & ~harmonic, BLUE, "driven frequency"),
                (shown & harmonic, "white", "harmonic, no part of the curve"),
            ):
                look: dict[str, Any] = {"color": BLUE, "markerfacecolor": face, "elinewidth": 1.0, "label": text}
                if own.any():
                    axes.errorbar(frequency[own], level[own], half[own], fmt="o", **look)
        unit = f"{power}{typeset(sensitivity_unit(sensitivity.unit, LOAD_COMPONENTS[component]))}"
        rest = None if static is None else (abs(static) / factor, "static sensitivity")
        frame_bars(upper, lower, (value[:, shown], expanded[:, shown]), unit, rest)
        upper.set_xlim(0.0, 1.12 * float(frequency.max(initial=1.0)))
        lower.set_xlabel("frequency / Hz")
        upper.legend(loc="best")
        hidden = len(points) - int(shown.sum())
        omitted = f" {hidden} line(s) with U above {SHOWN_BELOW:.0%} are in the table only." if hidden else ""
        caption = f"{label}: magnitude and phase; bars: U (95 %).{omitted}"
        return drawn.picture(f"{what} over frequency", caption, top=0.12, right=0.75, left=0.8, label=0.62)


def draw_outputs(evaluation: Evaluation, sensitivity: Sensitivity) -> Picture:
    """All outputs at the strongest line, relative to the driven one or to each output's rated signal."""
    component, driven, line = driven_component(evaluation), driven_channel(evaluation), main_line(evaluation)
    scale, what = _output_scale(evaluation, sensitivity, driven, component)
    elements = [sensitivity_element(sensitivity, line, c, component) for c in range(len(sensitivity.channels))]
    bound = np.array([element.region.holds_zero for element in elements])
    size = 100.0 * np.array([element.magnitude for element in elements]) / scale
    # Where a value may be zero: how far its region reaches beyond it.
    reach = [e.region.half_axes[0] if e.region.holds_zero else e.expanded_magnitude for e in elements]
    with sheet("outputs", 0.9 + 0.3 * len(size)) as drawn:
        (axes,) = drawn.panels
        _draw_levels(axes, size, 100.0 * np.array(reach) / scale, driven, bound)
        axes.set_yticks(range(len(size)), [f"output {name}" for name in sensitivity.channels])
        axes.set_ylim(len(size) - 0.4, -0.6)
        axes.set_xlabel(f"{what} / %")
        load = LOAD_COMPONENTS[component]
        caption = (
            f"Responses of all outputs to the driven load {load} at {sensitivity.frequency_hz[line]:.4f} Hz, {what}; "
            f"bars: U (95 %). An arrow is an upper bound where the output is not distinguishable from 0. A cross "
            "output of one recording holds both the sensor's cross-talk and its answer to loads that were not meant to "
            "act."
        )
        return drawn.picture(f"All outputs under {load}", caption, left=1.1, top=0.12, label=0.52)


def draw_budget(evaluation: Evaluation) -> Picture | None:
    """Budget of sensitivity or ratio at the strongest line, largest first, with each one's share of the variance."""
    main, line = main_result(evaluation), main_line(evaluation)
    if main is None:
        return None
    sensitivity, element = main
    u_relative = np.array([entry.u_relative[line, element] for entry in sensitivity.budget])
    if not np.isfinite(u_relative).all() or not u_relative.any():
        return None
    order = np.argsort(u_relative)[::-1]
    order = order[u_relative[order] > 1e-3 * u_relative.max()][:BUDGET_ENTRIES]
    share = 100.0 * u_relative**2 / np.sum(u_relative**2)
    with sheet("budget", 0.85 + 0.24 * len(order)) as drawn:
        (axes,) = drawn.panels
        for place, entry in enumerate(order):
            colour = BLUE if sensitivity.budget[entry].type == "A" else ORANGE
            axes.barh(place, 100.0 * u_relative[entry], height=0.66, color=colour)
            text = f" {share[entry]:.1f} %" if share[entry] >= 0.05 else " < 0.1 %"
            axes.text(100.0 * u_relative[entry], place, text, va="center", fontsize=7.5)
        axes.set_yticks(range(len(order)), [sensitivity.budget[entry].label for entry in order])
        axes.set_ylim(len(order) - 0.4, -0.6)
        axes.set_xlim(0.0, 115.0 * float(u_relative.max()))
        axes.set_xlabel("relative standard uncertainty (k = 1) / %")
        axes.barh(-5.0, 0.0, color=BLUE, label="type A")
        axes.barh(-5.0, 0.0, color=ORANGE, label="type B")
        axes.legend(loc="lower right")
        channel, load = sensitivity.channels[driven_channel(evaluation)], LOAD_COMPONENTS[driven_component(evaluation)]
        what = (
            f"{result_name(sensitivity.kind[line], channel, load, main=True)}, {sensitivity.frequency_hz[line]:.4f} Hz"
        )
        caption = f"Uncertainty budget of the magnitude of {what}; beside each bar its share of the variance."
        return drawn.picture("Uncertainty budget", caption, left=3.0, top=0.12, label=0.52)


def _output_scale(
    evaluation: Evaluation, sensitivity: Sensitivity, driven: int, component: int
) -> tuple[FloatArray, str]:
    """What 100 % is for each output (C,), and its name."""
    sensor, static = evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if static is not None and sensor is not None and sensor.capacity is not None:
        own = [LOAD_COMPONENTS.index(name) if name in LOAD_COMPONENTS else -1 for name in sensitivity.channels]
        capacity = np.asarray(sensor.capacity, dtype=np.float64)
        rated = np.array([abs(static[c, j]) * capacity[j] if j >= 0 else 0.0 for c, j in enumerate(own)])
        if np.all(rated > 0.0):
            return rated / capacity[component], f"share of the rated output at rated {LOAD_COMPONENTS[component]}"
    size = abs(sensitivity.value[main_line(evaluation), driven, component])
    return np.full(len(sensitivity.channels), size), f"ratio to output {sensitivity.channels[driven]}"


def _draw_levels(axes: Axes, size: FloatArray, expanded: FloatArray, driven: int, bound: BoolArray) -> None:
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
