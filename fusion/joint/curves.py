"""The curves of a campaign on its page: headlines, table, figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from markupsafe import Markup

from fusion.curve import Curve, interpolate
from fusion.interpolation import LEAST_POINTS
from fusion.joint.evaluation import CampaignEvaluation, main_channel
from fusion.joint.points import CurvePoint, curve_elements, single_points
from fusion.load import LOAD_COMPONENTS
from fusion.matrix import CrossTalk
from fusion.plots.curve import CurveDrawing, OutputsDrawing, Points, draw_campaign_curve, draw_campaign_outputs
from fusion.plots.style import Picture
from fusion.polar import Polar
from fusion.report_numbers import common_exponent, fixed, measured, polar_cells, small, times_ten
from fusion.report_tables import Headline, Table

BETWEEN_POINTS = 121
"""Number of places at which the interpolated curve is drawn."""
FULL_HEADLINES = 2
"""Number of driven components up to which the end of the curve has a headline, too."""


def main_points(evaluation: CampaignEvaluation, points: Sequence[CurvePoint]) -> dict[str, list[CurvePoint]]:
    """Return the points of the outputs that belong to their load, by component: ratios before elements of matrices."""
    found: dict[str, list[CurvePoint]] = {}
    for place, component in enumerate(LOAD_COMPONENTS):
        own = [point for point in points if point.component == component]
        channels = list(dict.fromkeys(point.channel for point in own))
        if own:
            main = channels[main_channel(evaluation, channels, place)]
            found[component] = [point for point in own if point.channel == main]
    return found


def headlines(evaluation: CampaignEvaluation, mains: dict[str, list[CurvePoint]]) -> list[Headline]:
    """The results to remember: every main sensitivity at its lowest frequency, its course, the largest cross-talk."""
    found = []
    for points in mains.values():
        best = _longest(points)
        found.append(_sensitivity_headline(best[0]))
        if len(mains) <= FULL_HEADLINES and len(best) > 1:
            found += _course_headlines(best)
    return [*found, *_scatter_headline(evaluation), *_crosstalk_headline(evaluation)]


def curve_tables(mains: dict[str, list[CurvePoint]]) -> list[Table]:
    """One table per main element over frequency, ratios first."""
    return [_curve_table(points) for points in mains.values()]


def _curve_table(points: Sequence[CurvePoint]) -> Table:
    """One main element over frequency, its unit in the head."""
    exponent = common_exponent(np.array([complex(point.element.re, point.element.im) for point in points]))
    rows: list[tuple[str, ...]] = []
    for point in sorted(points, key=lambda point: (point.kind != "ratio", point.frequency_hz)):
        size, turn, k = polar_cells(point.element, exponent)
        cells = (point.kind, f"{point.recordings} ({point.mountings})")
        rows.append((f"{point.frequency_hz:.4f}", size, turn, _from_static(point), k, *cells))
    first = points[0]
    unit = times_ten(exponent, first.unit)
    head = (
        "frequency / Hz",
        Markup("magnitude / {}").format(unit),
        "phase / rad",
        "from static / %",
        "k",
        "kind",
        "recordings (mountings)",
    )
    caption = f"Output {first.channel} per load {first.component} with U = k·u (95 %)"
    return Table(caption, head, "rrrrrlr", tuple(rows))


def curve_pictures(evaluation: CampaignEvaluation, mains: dict[str, list[CurvePoint]]) -> list[Picture]:
    """One figure per main element, ratios and elements of matrices in the same."""
    return [draw_campaign_curve(_curve_drawing(evaluation, points)) for points in mains.values()]


def output_pictures(evaluation: CampaignEvaluation) -> list[Picture]:
    """All outputs under each load that was driven, relative to the output that belongs to it."""
    ratios = [curve for curve in evaluation.curves if curve.kind == "ratio" and len(curve.channels) > 1]
    return [draw_campaign_outputs(_outputs_drawing(evaluation, curve)) for curve in ratios]


def _longest(points: Sequence[CurvePoint]) -> list[CurvePoint]:
    """Points of one kind: elements of matrices unless there are more ratios; ascending in frequency."""
    matrix = [point for point in points if point.kind == "matrix"]
    ratio = [point for point in points if point.kind == "ratio"]
    return sorted(ratio if len(ratio) > len(matrix) else matrix, key=lambda point: point.frequency_hz)


def _sensitivity_headline(point: CurvePoint) -> Headline:
    """One value with its deviation from static."""
    element = point.element
    share = small(100.0 * element.expanded_magnitude / element.magnitude)
    remark = f"U = {share} % (k = {element.k:.2f}), {point.kind}"
    if point.relative is not None:
        remark += f"; from static: {_deviation(point.relative)}"
    label = f"Sensitivity {point.channel} per {point.component}, {point.frequency_hz:.4f} Hz"
    return Headline(label, measured(element.magnitude, element.expanded_magnitude, point.unit), remark)


def _course_headlines(points: Sequence[CurvePoint]) -> list[Headline]:
    """What the curve comes to at its upper end."""
    last = points[-1]
    turn = measured(last.element.phase_rad, last.element.expanded_phase_rad, "rad")
    found = [Headline(f"Phase at {last.frequency_hz:.4f} Hz", turn, f"{last.channel} to {last.component}, {last.kind}")]
    if last.relative is not None:
        label = f"Deviation from static at {last.frequency_hz:.4f} Hz"
        expanded = [100.0 * p.element.expanded_magnitude / p.element.magnitude for p in points]
        remark = f"U of the curve's magnitudes: {small(min(expanded))} % to {small(max(expanded))} %"
        found.insert(0, Headline(label, _deviation(last.relative), remark))
    return found


def _scatter_headline(evaluation: CampaignEvaluation) -> list[Headline]:
    """What mounting anew changes, over all excitations that were mounted more than once."""
    known = [found for found in evaluation.repeats if found.between_dof and found.within_dof]
    if not known:
        return []
    places = [main_channel(evaluation, found.channels, found.component) for found in known]
    sizes = [
        float(np.sqrt(np.mean([value[place] ** 2 for value, place in zip(values, places, strict=True)])))
        for values in ([found.between for found in known], [found.within for found in known])
    ]
    remark = f"a recording: {small(100.0 * sizes[1])} %; rms of {len(known)} excitations, beyond what is stated"
    return [Headline("Mounting anew, standard deviation", f"{small(100.0 * sizes[0])} %", remark)]


def _crosstalk_headline(evaluation: CampaignEvaluation) -> list[Headline]:
    """The largest cross-talk that has been shown."""
    best: tuple[float, CrossTalk, int, int] | None = None
    for found in evaluation.cross_talks:
        least = np.where(found.holds_zero, -np.inf, np.abs(found.value) - found.half_axis)
        least[np.arange(len(found.main)), list(found.main)] = -np.inf
        place = divmod(int(np.argmax(least)), least.shape[1])
        if np.isfinite(least[place]) and (best is None or least[place] > best[0]):
            best = float(least[place]), found, *place
    if best is None:
        return []
    _, found, c, j = best
    size = measured(100.0 * abs(found.value[c, j]), 100.0 * float(found.half_axis[c, j]), "%")
    where = f"output {found.channels[c]} under {found.components[j]}, {found.frequency_hz:.4f} Hz"
    return [Headline("Largest cross-talk that is certain", size, where)]


def _deviation(relative: Polar) -> str:
    """Deviation of a magnitude from static in per cent."""
    return measured(100.0 * (relative.magnitude - 1.0), 100.0 * relative.expanded_magnitude, "%").striptags()


def _from_static(point: CurvePoint) -> str:
    """Deviation from static as a cell of the table."""
    if point.relative is None:
        return "–"
    return fixed(100.0 * (point.relative.magnitude - 1.0), 100.0 * point.relative.expanded_magnitude, 0)


def _curve_drawing(evaluation: CampaignEvaluation, points: Sequence[CurvePoint]) -> CurveDrawing:
    """One main element as the figure takes it."""
    first = points[0]
    singles, between = [], None
    for curve in evaluation.curves:
        names = [(curve.channels[c], LOAD_COMPONENTS[j]) for c, j in curve.elements]
        if (first.channel, first.component) in names:
            element = names.index((first.channel, first.component))
            singles += single_points(evaluation, curve, element) if curve.kind == "ratio" else []
            between = _between(curve, element) if between is None else between
    static = [p.element.magnitude / p.relative.magnitude for p in points if p.relative is not None]
    return CurveDrawing(
        name=f"curve-{first.channel}-{first.component}",
        label=f"output {first.channel} per load {first.component}",
        unit=first.unit,
        value=_points([(p.frequency_hz, p.element) for p in points]),
        matrix=np.array([p.kind == "matrix" for p in points]),
        static=static[0] if static else None,
        single=_points([(frequency, element) for frequency, _, element in singles]),
        mounting=np.array([mounting for _, mounting, _ in singles], dtype=np.str_),
        between=between,
    )


def _between(curve: Curve, element: int) -> Points | None:
    """The interpolated curve, None where there are too few points."""
    usable = np.isfinite(curve.value[:, element])
    if np.count_nonzero(usable) < LEAST_POINTS:
        return None
    frequency = curve.frequency_hz[usable]
    alone = replace(
        curve,
        elements=(curve.elements[element],),
        value=curve.value[:, [element]],
        uncertainty=curve.uncertainty.at([element]),
    )
    fine = interpolate(alone, np.linspace(float(frequency.min()), float(frequency.max()), BETWEEN_POINTS))
    found = [row[0] for row in curve_elements(fine)]
    return _points([(f, p) for f, p in zip(fine.frequency_hz.tolist(), found, strict=True) if p is not None])


def _points(items: Sequence[tuple[float, Polar]]) -> Points:
    """Values over frequency as arrays."""
    rows = [(frequency, p.magnitude, p.phase_rad, p.expanded_magnitude, p.expanded_phase_rad) for frequency, p in items]
    columns = np.array(rows, dtype=np.float64).reshape(len(rows), 5).T
    return Points(*columns)


def _outputs_drawing(evaluation: CampaignEvaluation, curve: Curve) -> OutputsDrawing:
    """All outputs under one load, relative to the one that belongs to it or to what is rated."""
    component = curve.elements[0][1]
    driven = main_channel(evaluation, curve.channels, component)
    values = curve_elements(curve)
    size = np.array([[np.nan if p is None else p.magnitude for p in row] for row in values])
    expanded = np.array([[np.nan if p is None else p.expanded_magnitude for p in row] for row in values])
    load = LOAD_COMPONENTS[component]
    return OutputsDrawing(
        name=f"outputs-{load}",
        load=load,
        reference=f"ratio to output {curve.channels[driven]}",
        channels=curve.channels,
        driven=driven,
        frequency_hz=curve.frequency_hz,
        share=100.0 * size / size[:, [driven]],
        expanded=100.0 * expanded / size[:, [driven]],
    )
