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
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
)
from fusion.polar import element_covariance, polar, prefix, typeset

ELLIPSE_95 = float(np.sqrt(-2.0 * np.log(0.05)))
"""Radius, in standard deviations, that holds 95 % of a two-dimensional normal distribution."""


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
            f"value; bars: U (k = 2) of each; band: U of the fused value, to which all of them contribute."
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
    return bool(element[0] != 0.0 and 2.0 * np.sqrt(np.trace(element[1])) < 0.5 * abs(element[0]))


def _element(result: Acceleration, line: int, component: int) -> tuple[complex, FloatArray]:
    """Value and covariance (2, 2) of one component; zero where it is not determined."""
    value = complex(result.phasors.value[line, component])
    determined = bool(result.observed[line, component]) and np.isfinite(value)
    return (value if determined else 0.0), element_covariance(result.phasors.covariance[line], component)


def _draw_deviations(left: Axes, right: Axes, results: list[Acceleration], line: int, component: int) -> None:
    """Relative amplitude and phase differences from the first result, the fused one."""
    names: list[str] = []
    reference = _element(results[0], line, component)[0]
    for result in results:
        value, covariance = _element(result, line, component)
        if value == 0.0:
            continue
        element = polar(value, covariance)
        amplitude = 100.0 * (element.magnitude / abs(reference) - 1.0)
        u_amplitude = 200.0 * element.u_magnitude / abs(reference)
        phase = 1e3 * float(np.angle(value / reference))
        u_phase = 2e3 * element.u_phase_rad
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
    found = [(result, *_element(result, line, component)) for result in results]
    found = [entry for entry in found if entry[1] != 0.0]
    unit = results[0].phasors.unit[component]
    axes.set_title(COMPONENTS[component])
    if not found:
        axes.text(0.5, 0.5, "not observed", ha="center", va="center", color=GREY, transform=axes.transAxes)
        axes.set_axis_off()
        return
    factor, letter = prefix(np.array([abs(value) for _, value, _ in found]))
    low, high = _frame(found, factor)
    for result, value, covariance in found:
        colour = SOURCE_COLOUR[result.source]
        axes.add_patch(_ellipse(value, covariance, factor, colour))
        axes.plot(value.real / factor, value.imag / factor, SOURCE_MARKER[result.source], color=colour, markersize=3.5)
    axes.plot(0.0, 0.0, "+", color=BLACK, markersize=8)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low.real, high.real)
    axes.set_ylim(low.imag, high.imag)
    axes.locator_params(nbins=4)
    axes.set_xlabel(f"Re / {letter}{typeset(unit)}")
    axes.set_ylabel(f"Im / {letter}{typeset(unit)}")


def _frame(found: list[tuple[Acceleration, complex, FloatArray]], factor: float) -> tuple[complex, complex]:
    """Corners of a square that holds the regions, and the origin where it is not far outside."""
    reach = [ELLIPSE_95 * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) for _, _, covariance in found]
    corners = [
        (value + sign * size * (1 + 1j)) for (_, value, _), size in zip(found, reach, strict=True) for sign in (-1, 1)
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


def _ellipse(value: complex, covariance: FloatArray, factor: float, colour: str) -> Ellipse:
    """95 % region of a complex value."""
    variance, axes = np.linalg.eigh(covariance)
    height, width = 2.0 * ELLIPSE_95 * np.sqrt(np.maximum(variance, 0.0)) / factor
    angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    centre = (value.real / factor, value.imag / factor)
    return Ellipse(centre, float(width), float(height), angle=angle, facecolor="none", edgecolor=colour, linewidth=1.1)
