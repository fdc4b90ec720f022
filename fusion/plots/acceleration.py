"""Figures of the acceleration: sources side by side, and weak components in the complex plane."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from fusion.evaluation import Evaluation
from fusion.fuse import Acceleration
from fusion.highlights import COMPONENTS, acceleration, bodies, by_source, driven_component, main_line
from fusion.plots.style import (
    BLACK,
    GREY,
    LIGHT,
    SOURCE_COLOUR,
    SOURCE_MARKER,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
)
from fusion.polar import Polar, element_covariance, polar, prefix, typeset


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
            left.set_title(f"{body}, {COMPONENTS[component]}")
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
    axes.set_title(COMPONENTS[component])
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
