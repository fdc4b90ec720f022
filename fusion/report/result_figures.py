"""Figures of a recording: acceleration, sensitivity, channels, clocks and vibrometer points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.base import prefix
from fusion.estimation.coverage import Polar, coverage_factor
from fusion.estimation.fuse import Acceleration, Source
from fusion.instruments.vibrometer import PointSpread, axis_name
from fusion.phasors.channel_phasors import ChannelResult
from fusion.phasors.timing import ClockResult
from fusion.report.figure import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    SOURCE_COLOUR,
    SOURCE_MARKER,
    Figure,
    Panel,
    Scale,
    decimate_edges,
    empty_figure,
    frame_bars,
    padded_limits,
    polar_bars,
    power_of_ten,
)
from fusion.report.tables import (
    PREFIXED,
    acceleration,
    bodies,
    by_source,
    driven_channel,
    driven_component,
    equivalent_sine,
    main_line,
    main_result,
    result_name,
    sensitivity_element,
    static_sensitivity,
    static_value,
)
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.load_phasors import BudgetEntry
from fusion.sensitivity.ratio import Sensitivity
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, sensitivity_unit
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.digits import number_text, typeset

BUDGET_ENTRIES = 14
"""Largest number of bars in the figure of the budget (chosen)."""
SHOWN_BELOW = 0.2
"""Relative U above which a magnitude is not drawn (chosen)."""

# Figures of the acceleration: sources side by side, and weak components in the complex plane.


def acceleration_figures(evaluation: Evaluation) -> list[Figure]:
    """Return all figures of the accelerations."""
    compared = [body for body in bodies(evaluation) if _has_reference(evaluation, body)]
    figures = [draw_sources(evaluation, compared)] if compared else []
    return figures + [draw_components(evaluation, body) for body in bodies(evaluation)]


def draw_sources(evaluation: Evaluation, compared: list[str]) -> Figure:
    """Draw each source's deviation from the fused acceleration at the strongest line."""
    component, line = driven_component(evaluation), main_line(evaluation)
    counts = [len(by_source(evaluation, body)) for body in compared]
    drawn = empty_figure("sources", 0.95 + 0.33 * sum(counts) + 0.25 * len(compared), counts, 2)
    for index, body in enumerate(compared):
        left, right = drawn.panels[2 * index : 2 * index + 2]
        _draw_deviations(left, right, by_source(evaluation, body), line, component)
        left.title = f"{body}, {MOTION_COMPONENTS[component]}"
    drawn.panels[-2].x.label = "deviation of the amplitude / %"
    drawn.panels[-1].x.label = "deviation of the phase / mrad"
    frequency = float(evaluation.accelerations[0].phasors.frequency_hz[line])
    caption = (
        f"Driven acceleration at {frequency:.4f} Hz from each kind of instrument alone, relative to the fused "
        f"value; bars: U (95 %) of each; band: U of the fused value, to which all of them contribute."
    )
    return drawn.with_title("Acceleration by source", caption, main=True)


def draw_components(evaluation: Evaluation, body: str) -> Figure:
    """Draw six components at the strongest line in the complex plane, with 95 % ellipses."""
    line, results = main_line(evaluation), by_source(evaluation, body)
    found = {result.source: result.polar[line] for result in results}
    drawn = empty_figure(f"components-{body}", 5.9, 2, 3, shared_x=False)
    # One unit for all translations, and one for all rotations.
    sizes = np.abs([result.phasors.value[line] for result in results])
    scales = prefix(sizes[:, :3]), prefix(sizes[:, 3:])
    for component, panel in enumerate(drawn.panels):
        panel.title = MOTION_COMPONENTS[component]
        available = {source: element for source, row in found.items() if (element := row[component]) is not None}
        _draw_plane(panel, available, typeset(results[0].phasors.unit[component]), scales[component // 3])
    frequency = float(results[0].phasors.frequency_hz[line])
    caption = (
        f"Acceleration phasors of the {body} at the sensor origin, {frequency:.4f} Hz, with 95 % "
        f"regions{equivalent_sine(evaluation)}. A "
        f"component whose region includes the origin (cross) is not distinguishable from zero; its amplitude and "
        f"phase alone would mislead."
    )
    return drawn.with_title(f"Components of the {body} in the complex plane", caption)


def _has_reference(evaluation: Evaluation, body: str) -> bool:
    """Return whether several instruments were fused and the driven component exceeds its uncertainty."""
    fused = acceleration(evaluation, body, "fused")
    if fused is None or len(fused.instruments) < 2 or len(by_source(evaluation, body)) < 2:
        return False
    element = fused.polar[main_line(evaluation)][driven_component(evaluation)]
    return element is not None and element.region.half_axes[0] < 0.5 * element.magnitude


def _draw_deviations(left: Panel, right: Panel, results: list[Acceleration], line: int, component: int) -> None:
    """Draw relative amplitude and phase differences from the first result, the fused one."""
    names: list[str] = []
    reference = complex(results[0].phasors.value[line, component])
    for result in results:
        element = result.polar[line][component]
        if element is None:
            continue
        amplitude = 100.0 * (element.magnitude / abs(reference) - 1.0)
        u_amplitude = 100.0 * element.expanded_magnitude / abs(reference)
        phase = 1e3 * float(np.angle(complex(element.re, element.im) / reference))
        u_phase = 1e3 * element.expanded_phase_rad
        look = {"colour": SOURCE_COLOUR[result.source], "marker": SOURCE_MARKER[result.source]}
        for panel, middle, half in ((left, amplitude, u_amplitude), (right, phase, u_phase)):
            if result.source == "fused":
                panel.span(-half, half, along="x")
            panel.points(middle, len(names), result.source, half_x=half, **look)
        names.append(result.source)
    for panel in (left, right):
        panel.rule(0.0, along="x", width=0.7)
        panel.y.names = tuple(names) if panel is left else ("",) * len(names)


def _draw_plane(panel: Panel, elements: Mapping[Source, Polar], unit: str, scale: tuple[float, str]) -> None:
    """Draw one component in the complex plane from every source, with its 95 % region."""
    if not elements:
        panel.text(0.5, 0.5, "not observed", colour=GREY)
        panel.x.limits = panel.y.limits = (0.0, 1.0)
        panel.blank = True
        return
    factor, letter = scale
    low, high = _frame(list(elements.values()), factor)
    for source, element in elements.items():
        look = {"label": source, "colour": SOURCE_COLOUR[source]}
        centre = complex(element.re, element.im) / factor
        first, second = (axis / factor for axis in element.region.half_axes)
        panel.points(centre.real, centre.imag, marker=SOURCE_MARKER[source], size=3.5, **look)
        panel.ellipse(centre, (first, second), float(element.region.angle_rad), **look)
    panel.points(0.0, 0.0, colour=BLACK, marker="plus", size=7.0, names=("origin",))
    panel.equal = True
    panel.x.limits, panel.y.limits = (low.real, high.real), (low.imag, high.imag)
    panel.x.label, panel.y.label = f"Re / {letter}{unit}", f"Im / {letter}{unit}"


def _frame(elements: list[Polar], factor: float) -> tuple[complex, complex]:
    """Return the corners of a square around the regions, with a near origin."""

    def square(points: NDArray[Any]) -> tuple[complex, float]:
        """Return centre and half side of a square with a margin."""
        middle = complex(points.real.max() + points.real.min(), points.imag.max() + points.imag.min()) / 2.0
        return middle, 0.6 * float(max(np.ptp(points.real), np.ptp(points.imag), 1e-300))

    centres = np.array([complex(element.re, element.im) for element in elements], dtype=np.complex128)
    reach = np.array([element.region.half_axes[0] for element in elements]) * (1 + 1j)
    points = np.concatenate([centres - reach, centres + reach]) / factor
    middle, half = square(points)
    if abs(middle) < 8.0 * half:
        middle, half = square(np.append(points, 0.0))
    half = max(half, 1e-6 * abs(middle), 1e-12)
    return middle - half * (1 + 1j), middle + half * (1 + 1j)


# Figures of the result: sensitivity over frequency, cross outputs, uncertainty budget.


def sensitivity_figures(evaluation: Evaluation) -> list[Figure]:
    """Return all figures of the sensitivity of one recording."""
    sensitivity, main = evaluation.sensitivity, main_result(evaluation)
    if sensitivity is None or main is None:
        return []
    component = driven_component(evaluation)
    available = np.isfinite(main[0].value[:, driven_channel(evaluation), component])
    figures = [draw_curve(evaluation, main[0])] if available.any() else []
    ratio = sensitivity.value[main_line(evaluation)]
    if len(ratio) > 1 and np.isfinite(ratio[:, component]).all():
        figures.append(draw_outputs(evaluation, sensitivity))
    return figures


def draw_curve(evaluation: Evaluation, sensitivity: Sensitivity) -> Figure:
    """Draw magnitude and phase of the driven element over frequency with U."""
    component, channel = driven_component(evaluation), driven_channel(evaluation)
    quantity = "Sensitivity" if "element" in sensitivity.kind else "Ratio"
    label = f"output {sensitivity.channels[channel]} per load {LOAD_COMPONENTS[component]}"
    label = f"{quantity}, {label}" + (", including the effect of other loads" if quantity == "Ratio" else "")
    lines = np.flatnonzero(np.isfinite(sensitivity.value[:, channel, component])).tolist()
    points = [sensitivity_element(sensitivity, k, channel, component) for k in lines]
    shown = np.array([point.expanded_magnitude < SHOWN_BELOW * point.magnitude for point in points])
    harmonic = np.array([sensitivity.kind[k] == "harmonic" for k in lines])
    static = static_value(evaluation, channel, component)
    sizes = [point.magnitude for point in points] + ([] if static is None else [abs(static)])
    factor, power = power_of_ten(np.array(sizes))
    value, expanded = polar_bars(points, factor)
    frequency = sensitivity.frequency_hz[lines]
    drawn = empty_figure("sensitivity", 4.4, (1.5, 1.0))
    upper, lower = drawn.panels
    unit = f"{power}{typeset(sensitivity_unit(sensitivity.unit, LOAD_COMPONENTS[component]))}"
    rest = None if static is None else (abs(static) / factor, "static sensitivity")
    frame_bars(upper, lower, (value[:, shown], expanded[:, shown]), unit, rest)
    for panel, level, half in zip(drawn.panels, value, expanded, strict=True):
        for mask, legend in (
            (shown & ~harmonic, "driven frequency"),
            (shown & harmonic, "harmonic, not part of the curve"),
        ):
            if mask.any():
                look = {"half_y": half[mask], "open": bool(harmonic[mask].any())}
                panel.points(frequency[mask], level[mask], legend, **look)
        panel.x.limits, panel.x.link = (0.0, 1.12 * float(frequency.max(initial=1.0))), "frequency"
        if evaluation.manifest.is_broadband:
            panel.x.limits, panel.x.log = (float(frequency.min()) / 1.12, 1.12 * float(frequency.max())), True
    lower.x.label = "frequency / Hz"
    hidden = len(points) - int(shown.sum())
    omitted = f" {hidden} line(s) with U above {SHOWN_BELOW:.0%} are in the table only." if hidden else ""
    return drawn.with_title(
        f"{quantity} over frequency", f"{label}: magnitude and phase; bars: U (95 %).{omitted}", main=True
    )


def draw_outputs(evaluation: Evaluation, sensitivity: Sensitivity) -> Figure:
    """Draw all outputs at the strongest line, relative to the driven or the rated output."""
    component, driven, line = driven_component(evaluation), driven_channel(evaluation), main_line(evaluation)
    scale, unit = _output_scale(evaluation, sensitivity, driven, component)
    elements = [sensitivity_element(sensitivity, line, c, component) for c in range(len(sensitivity.channels))]
    bound = np.array([element.region.holds_zero for element in elements])
    size = 100.0 * np.array([element.magnitude for element in elements]) / scale
    # Where a value may be zero: how far its region reaches beyond it.
    reach = [e.region.half_axes[0] if e.region.holds_zero else e.expanded_magnitude for e in elements]
    drawn = empty_figure("outputs", 0.9 + 0.3 * len(size))
    (panel,) = drawn.panels
    _draw_levels(panel, size, 100.0 * np.array(reach) / scale, driven, bound)
    panel.y.names = tuple(f"output {name}" for name in sensitivity.channels)
    panel.x.label = f"{unit} / %"
    load = LOAD_COMPONENTS[component]
    caption = (
        f"Responses of all outputs to the driven load {load} at {sensitivity.frequency_hz[line]:.4f} Hz, {unit}; "
        f"bars: U (95 %). An arrow is an upper bound if the output is not distinguishable from 0. A cross "
        "output of one recording includes both the sensor's cross-talk and its response to unintended loads."
    )
    return drawn.with_title(f"All outputs under {load}", caption)


def draw_budget(evaluation: Evaluation) -> Figure | None:
    """Draw the uncertainty budget at the strongest line, with shares of the variance."""
    main, line = main_result(evaluation), main_line(evaluation)
    if main is None:
        return None
    sensitivity, element = main
    channel, load = sensitivity.channels[driven_channel(evaluation)], LOAD_COMPONENTS[driven_component(evaluation)]
    name = result_name(sensitivity.kind[line], channel, load, main=True)
    return draw_contributions(sensitivity.budget, (line, element), f"{name}, {sensitivity.frequency_hz[line]:.4f} Hz")


def draw_contributions(budget: Sequence[BudgetEntry], index: tuple[int, int], quantity: str) -> Figure | None:
    """Draw the contributions to the magnitude of one value, with shares of the variance.

    `index`: line and column of the value; `quantity`: its name. None if they are not determined.
    """
    u_relative = np.array([entry.u_relative[index] for entry in budget])
    if not np.isfinite(u_relative).all() or not u_relative.any():
        return None
    order = np.argsort(u_relative)[::-1]
    order = order[u_relative[order] > 1e-3 * u_relative.max()][:BUDGET_ENTRIES]
    share = 100.0 * u_relative**2 / np.sum(u_relative**2)
    drawn = empty_figure("budget", 0.85 + 0.24 * len(order))
    (panel,) = drawn.panels
    entries = [budget[entry] for entry in order]
    for kind, colour in (("A", BLUE), ("B", ORANGE)):
        rows = np.flatnonzero([entry.type == kind for entry in entries])
        names = tuple(f"{entries[row].label}, {number_text(share[order[row]], 2)} % of the variance" for row in rows)
        ends = (np.zeros(len(rows)), 100.0 * u_relative[order[rows]])
        panel.boxes(ends, (rows - 0.33, rows + 0.33), f"type {kind}", colour=colour, names=names)
    texts = [f"{share[entry]:.1f} %" if share[entry] >= 0.05 else "< 0.1 %" for entry in order]
    panel.text(100.0 * u_relative[order], np.arange(len(order)), texts, align="left", offset_px=(4.0, 0.0))
    panel.y.names = tuple(entry.label for entry in entries)
    panel.x.label = "relative u (k = 1) / %"
    panel.x.limits = (0.0, 125.0 * float(u_relative.max()))
    caption = "Contributions to the standard uncertainty of the magnitude; next to each bar its share of the variance."
    return drawn.with_title(f"Uncertainty budget, {quantity}", caption, main=True)


def _output_scale(
    evaluation: Evaluation, sensitivity: Sensitivity, driven: int, component: int
) -> tuple[FloatArray, str]:
    """Return the value of 100 % for each output (C,), and its name."""
    sensor, static = evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if static is not None and sensor is not None and sensor.capacity is not None:
        components = [LOAD_COMPONENTS.index(name) if name in LOAD_COMPONENTS else -1 for name in sensitivity.channels]
        capacity = np.asarray(sensor.capacity, dtype=np.float64)
        rated = np.array([abs(static[c, j]) * capacity[j] if j >= 0 else 0.0 for c, j in enumerate(components)])
        if np.all(rated > 0.0):
            return rated / capacity[component], f"share of the rated output at rated {LOAD_COMPONENTS[component]}"
    size = abs(sensitivity.value[main_line(evaluation), driven, component])
    return np.full(len(sensitivity.channels), size), f"ratio to output {sensitivity.channels[driven]}"


def _draw_levels(panel: Panel, size: FloatArray, expanded: FloatArray, driven: int, bound: BoolArray) -> None:
    """Draw points on a logarithmic axis, and upper bounds of values that may be zero."""
    rows = np.arange(len(size), dtype=np.float64)
    panel.x.log = True
    main = rows == driven
    for mask, colour, label in ((main & ~bound, BLACK, "driven"), (~main & ~bound, BLUE, "other outputs")):
        if mask.any():
            panel.points(size[mask], rows[mask], label, half_x=expanded[mask], colour=colour)
    if bound.any():
        panel.bounds((size + expanded)[bound], rows[bound], "upper bound", along="x", colour=GREY)
    ends = np.concatenate([(size + expanded), (size - expanded)[~bound], 0.3 * (size + expanded)[bound]])
    panel.x.limits = (0.5 * float(ends.min()), 2.0 * float(ends.max()))


# Figures of the DAQ side: channels with their fit and spectrum, camera trigger.


SPECTRUM_POINTS = 700
"""Number of intervals of a drawn spectrum, about one per pixel."""
EXCERPT_POINTS = 300
"""Number of samples in an excerpt (chosen)."""
MOST_CHANNELS = 24
"""Largest number of channels and triggers in a figure (chosen)."""


def channel_figures(evaluation: Evaluation) -> list[Figure]:
    """Return the figure of all channels, if there are any."""
    return [draw_channels(evaluation.channels[:MOST_CHANNELS], evaluation)] if evaluation.channels else []


def trigger_figures(evaluation: Evaluation) -> list[Figure]:
    """Return the figure of all camera triggers, if there are any."""
    clocks = [clock for clock in evaluation.clocks if clock.trigger is not None and len(clock.trigger.number) > 2]
    return [draw_trigger(clocks[:MOST_CHANNELS])] if clocks else []


def draw_channels(channels: Sequence[ChannelResult], evaluation: Evaluation) -> Figure:
    """Draw an excerpt of every channel with its fit and exposures, and its amplitude spectrum."""
    exposures = evaluation.stereo[0].time_s if evaluation.stereo and not evaluation.set_ups else np.empty(0)
    broadband = evaluation.manifest.is_broadband
    lines_hz = np.empty(0) if broadband else evaluation.lines.frequency_hz
    # Blocks have separate clocks: no common axis.
    drawn = empty_figure("channels", 0.3 + 1.7 * len(channels), len(channels), (1.15, 1.0), shared_x=False)
    for index, channel in enumerate(channels):
        excerpts = [one.excerpt for one in channels if one.unit == channel.unit]
        scale = _shown_unit(np.concatenate(excerpts), channel.unit)
        _draw_excerpt(drawn.panels[2 * index], channel, exposures, scale)
        _draw_spectrum(drawn.panels[2 * index + 1], channel, lines_hz, scale)
        drawn.panels[2 * index].x.label, drawn.panels[2 * index + 1].x.label = "time / s", "frequency / Hz"
    marks = " Vertical lines: middles of the camera exposures." if len(exposures) else ""
    more = len(evaluation.channels) - len(channels)
    caption = f"Left: samples (points) and fitted lines (curve).{marks} Right: triangles mark the lines fitted."
    if broadband:
        caption = (
            f"Left: the first samples.{marks} Right: spectrum with a window over time, which shows the middle of a "
        )
        caption += "sweep larger than its ends."
    caption += f" {more} more channels are not drawn." if more else ""
    return drawn.with_title("Channels", caption)


def draw_trigger(clocks: Sequence[ClockResult]) -> Figure:
    """Draw the deviation of every trigger edge from the periodic model, for each DAQ block."""
    drawn = empty_figure("trigger", 0.55 + 1.35 * len(clocks), len(clocks))
    for panel, clock in zip(drawn.panels, clocks, strict=True):
        trigger = clock.trigger
        if trigger is None:
            continue
        deviation = trigger.edge_s - trigger.time_s(trigger.number)
        factor, letter = prefix(np.append(deviation, trigger.resolution_s / 2.0), coarse=True)
        half = trigger.resolution_s / factor / 2.0
        panel.span(-half, half, "undetermined by sampling", colour=ORANGE)
        panel.points(trigger.number, deviation / factor, colour=BLUE, size=2.6)
        panel.rule(0.0, width=0.6)
        panel.y.label, panel.title = f"deviation / {letter}s", clock.daq
        ends = np.append(deviation / factor, [-half, half])
        panel.y.limits = padded_limits(float(ends.min()), float(ends.max()))
    drawn.panels[-1].x.label = "number of the edge"
    caption = "Camera trigger edges minus the fitted periodic model. Band: the interval between two samples."
    return drawn.with_title("Trigger", caption)


def _shown_unit(values: FloatArray, unit: str) -> tuple[float, str]:
    """Return factor and text before the unit: a prefix or a power of ten."""
    return prefix(values) if unit in PREFIXED else power_of_ten(values)


def _draw_excerpt(panel: Panel, channel: ChannelResult, exposures: FloatArray, scale: tuple[float, str]) -> None:
    """Draw samples and fit over a short time."""
    time, chosen = channel.excerpt_s, slice(0, EXCERPT_POINTS)
    factor, letter = scale
    if len(time):
        within = exposures[(exposures >= time[0]) & (exposures <= time[chosen][-1])]
        if len(within):
            panel.rule(within, "exposures", along="x", colour=GREY, dashed=True)
    panel.points(time[chosen], channel.excerpt[chosen] / factor, "samples", colour=BLUE, size=1.8)
    if np.isfinite(channel.excerpt_fit).any():
        panel.line(time[chosen], channel.excerpt_fit[chosen] / factor, "fitted lines", colour=RED, width=0.9)
    panel.y.label, panel.title = f"{letter}{typeset(channel.unit)}", f"{channel.name} ({channel.daq})"
    panel.x.link = f"excerpt of {channel.daq}"


def _draw_spectrum(panel: Panel, channel: ChannelResult, lines: FloatArray, scale: tuple[float, str]) -> None:
    """Draw the amplitude spectrum on logarithmic axes with the lines marked."""
    keep = (channel.spectrum_hz > 0.0) & (channel.spectrum > 0.0)
    frequency, amplitude = channel.spectrum_hz[keep], channel.spectrum[keep] / scale[0]
    if not len(frequency):
        return
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, SPECTRUM_POINTS)
    thin_frequency, thin_amplitude = decimate_edges(frequency, amplitude, edges)
    panel.line(thin_frequency, thin_amplitude, "amplitude spectrum", colour=BLUE, width=0.8)
    marked = lines[(lines >= frequency[0]) & (lines <= frequency[-1])]
    width = 2.0 * (frequency[1] - frequency[0]) if len(frequency) > 1 else np.inf
    around = [slice(*np.searchsorted(frequency, (line - 2.0 * width, line + 2.0 * width))) for line in marked]
    near = [amplitude[part][np.abs(frequency[part] - line) <= width] for part, line in zip(around, marked, strict=True)]
    tops = [float(values.max() if len(values) else np.median(amplitude)) for values in near]
    if len(marked):
        names = tuple(f"{line:.4f} Hz" for line in marked)
        panel.points(marked, 2.2 * np.array(tops), "lines", marker="inverted_triangle", colour=RED, names=names)
    panel.x.log = panel.y.log = True
    panel.x.limits = (float(frequency[0]), float(frequency[-1]))
    panel.y.limits = (0.3 * float(np.median(thin_amplitude)), 12.0 * float(amplitude.max()))
    panel.y.label, panel.x.link = f"{scale[1]}{typeset(channel.unit)}", "spectrum"
    panel.title = f"{channel.name}: amplitude spectrum"


# Figure of parallel vibrometer points: positions, deviations from their mean, and the best rigid plane.


NAMES_BELOW = 24
"""Largest number of points with names in the map."""


def point_figures(evaluation: Evaluation) -> list[Figure]:
    """Return one figure per group of parallel points."""
    line = main_line(evaluation)
    return [draw_points(spread, line, number) for number, spread in enumerate(evaluation.points)]


def draw_points(spread: PointSpread, line: int, group: int) -> Figure:
    """Draw the vibrometer points, and the deviations of amplitude and phase from mean and plane."""
    height = max(2.9, 0.8 + 0.24 * len(spread.channels))
    drawn = empty_figure(f"points-{group}", height, 1, (1.15, 1.0, 1.0))
    chart, amplitude, phase = drawn.panels
    _draw_map(chart, spread, line)
    along, across, u_along, u_across = _deviations(spread, line)
    planned = (spread.value[line] - spread.residual[line]) / spread.mean[line]
    _draw_bars(amplitude, 100.0 * along, 100.0 * u_along, 100.0 * (planned.real - 1.0))
    _draw_bars(phase, 1e3 * across, 1e3 * u_across, 1e3 * planned.imag)
    names = tuple(f"{name} ({number})" for number, name in enumerate(spread.channels, 1))
    amplitude.y.names, phase.y.names = names, ("",) * len(names)
    amplitude.x.label, phase.x.label = "amplitude from the mean / %", "phase from the mean / mrad"
    caption = (
        f"Vibrometer points along {axis_name(spread.direction)} on the {spread.body} at "
        f"{spread.frequency_hz[line]:.4f} Hz: positions (red: amplitude above the mean, blue: below), and "
        f"deviation from the mean; bars: U of the deviation; open: best rigid plane (mean and rocking)."
    )
    return drawn.with_title("Vibrometer points and rocking", caption)


def _deviations(spread: PointSpread, line: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return relative deviations of the points along and across their mean, and their U."""
    count = len(spread.channels)
    centre = np.kron(np.eye(2), np.eye(count) - 1.0 / count)
    every = np.broadcast_to(centre, (len(spread.mean), *centre.shape))
    relative = spread.uncertainty.transformed(every).scaled(np.repeat(1.0 / spread.mean[:, None], count, axis=1))
    u = np.sqrt(relative.covariance[line].diagonal())
    parts = [relative.dof_along(np.full(count, direction))[line] for direction in (1.0 + 0.0j, 1.0j)]
    expanded = np.array([coverage_factor(float(dof)) for dof in np.concatenate(parts)]) * u
    ratio = spread.value[line] / spread.mean[line]
    return ratio.real - 1.0, ratio.imag, expanded[:count], expanded[count:]


def _draw_bars(panel: Panel, value: FloatArray, expanded: FloatArray, planned: FloatArray) -> None:
    """Draw deviations with bars, and those of the plane as open markers."""
    rows = np.arange(len(value))
    panel.rule(0.0, along="x", colour=GREY)
    panel.points(value, rows, "point", half_x=expanded, colour=BLUE)
    panel.points(planned, rows, "rigid plane", marker="diamond", open=True, colour=ORANGE, size=7.0)


def _draw_map(panel: Panel, spread: PointSpread, line: int) -> None:
    """Draw points seen against their direction, coloured by the deviation of their amplitude."""
    first, second = (axis_name(axis) for axis in spread.axes)
    position_mm = 1e3 * spread.place_m
    deviation = 100.0 * (np.abs(spread.value[line] / spread.mean[line]) - 1.0)
    limit = float(np.max(np.abs(deviation))) or 1.0
    scale = Scale("RdBu", -limit, limit, "amplitude from the mean / %")
    panel.points(*position_mm.T, values=deviation, scale=scale, size=8.4, names=tuple(spread.channels))
    if len(position_mm) <= NAMES_BELOW:
        panel.text(
            position_mm[:, 0],
            position_mm[:, 1],
            [str(number + 1) for number in range(len(position_mm))],
            align="left",
            offset_px=(7.0, 6.0),
        )
    panel.points(0.0, 0.0, marker="plus", colour=GREY, names=("origin",))
    panel.equal = True
    low, high = position_mm.min(axis=0, initial=0.0), position_mm.max(axis=0, initial=0.0)
    margin = 0.2 * float((high - low).max())
    panel.x.limits, panel.y.limits = (low[0] - margin, high[0] + margin), (low[1] - margin, high[1] + margin)
    panel.x.label, panel.y.label = f"{first} / mm", f"{second} / mm"
