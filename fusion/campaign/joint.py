"""What the recordings of a campaign say together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from markupsafe import Markup

from fusion.campaign.curve import (
    LEAST_POINTS,
    Curve,
    Linearity,
    find_linearity,
    interpolate,
    matrix_curve,
    ratio_curves,
    relative_curve,
)
from fusion.campaign.matrix import CrossTalk, MatrixFit, cross_talk, fit_matrix
from fusion.campaign.matrix_solve import MissingExcitationError
from fusion.campaign.repeats import Drive, Repeats, drive_ratio, find_repeats, group_by_frequency
from fusion.estimation.uncertainty import Polar, Uncertainty, element_covariance, polar
from fusion.report.campaign_figures import (
    CurveDrawing,
    OutputsDrawing,
    Points,
    draw_campaign_curve,
    draw_campaign_outputs,
)
from fusion.report.csv_files import sensitivity_unit
from fusion.report.numbers import common_exponent, fixed, measured, polar_cells, small, times_ten
from fusion.report.recorded import Recorded, SensorFacts
from fusion.report.style import Picture
from fusion.report.table import Headline, Table
from shaker.arrays import ComplexArray, Notice, Severity
from shaker.labels import LOAD_COMPONENTS

# What the recordings of a campaign say together: matrices, cross-talk, repeats, linearity, one curve per element.


Joint = TypeVar("Joint")


@dataclass(frozen=True)
class CampaignEvaluation:
    """All that several recordings of one sensor yield together.

    `name` of the campaign; `recorded`: what could be evaluated, in order; `failed`: why others could not, by folder;
    `curves`: ratios by driven component, then elements of matrices; `relative`: each over its static sensitivity, None
    where none is stated; `repeats`: every excitation that was recorded more than once; `matrices` and `cross_talks`
    (none where rated loads are not stated): one per frequency that determines a matrix; `refused`: why the other
    frequencies do not.
    """

    name: str
    recorded: tuple[Recorded, ...]
    failed: Mapping[str, str]
    sensor: SensorFacts | None
    curves: tuple[Curve, ...]
    relative: tuple[Curve | None, ...]
    repeats: tuple[Repeats, ...]
    linearity: tuple[Linearity, ...]
    matrices: tuple[MatrixFit, ...]
    cross_talks: tuple[CrossTalk, ...]
    refused: tuple[Notice, ...]
    notices: tuple[Notice, ...]

    @property
    def drives(self) -> tuple[Drive, ...]:
        """Return the driven lines of all recordings."""
        return tuple(drive for entry in self.recorded for drive in entry.drives)


def evaluate_campaign(name: str, recorded: Sequence[Recorded], failed: Mapping[str, str]) -> CampaignEvaluation:
    """Evaluate the recordings of a campaign together, in the order given."""
    known = distinct_names(recorded)
    sensor, several = _one_sensor(known)
    drives = [drive for entry in known for drive in entry.drives] if sensor is not None else []
    capacity = None if sensor is None or sensor.capacity is None else sensor.capacity.tolist()
    matrices, refused = fit_matrices(drives, () if sensor is None else sensor.channels)
    ratios, no_ratios = _attempt("curves of ratios", lambda: ratio_curves(drives, capacity))
    alike, no_repeats = _attempt("means of repeats", lambda: find_repeats(drives, capacity))
    series, no_series = _attempt("linearity", lambda: find_linearity(drives, capacity))
    curves = (*ratios, *matrix_curves(matrices))
    repeats = tuple(found for found in alike if len(found.recordings) > 1)
    failures = [notice for notice in refused if notice.severity == "warning"]
    failures += [*no_ratios, *no_repeats, *no_series]
    found = [notice for fit in matrices for notice in fit.notices]
    found += [notice for repeated in repeats for notice in repeated.notices]
    return CampaignEvaluation(
        name=name,
        recorded=known,
        failed=dict(failed),
        sensor=sensor,
        curves=curves,
        relative=tuple(None if sensor is None else over_static(curve, sensor) for curve in curves),
        repeats=repeats,
        linearity=series,
        matrices=matrices,
        cross_talks=() if capacity is None else tuple(cross_talk(fit, capacity) for fit in matrices),
        refused=refused,
        notices=(*several, *_failures(failed), *failures, *found),
    )


def _attempt(what: str, make: Callable[[], tuple[Joint, ...]]) -> tuple[tuple[Joint, ...], tuple[Notice, ...]]:
    """Return joint results, or why there are none: recordings that do not fit together keep their own results."""
    try:
        return make(), ()
    except ValueError as error:
        return (), (Notice("warning", f"no {what}: {error}", "campaign"),)


def matrix_curves(fits: Sequence[MatrixFit]) -> tuple[Curve, ...]:
    """Return the matrices of all frequencies as one curve for each set of outputs that they have."""
    sets = dict.fromkeys(fit.channels for fit in fits)
    return tuple(matrix_curve([fit for fit in fits if fit.channels == channels]) for channels in sets)


def over_static(curve: Curve, sensor: SensorFacts) -> Curve | None:
    """Return a curve over the static sensitivity, None where that is not stated."""
    if sensor.static is None:
        return None
    rows = [sensor.channels.index(channel) for channel in curve.channels]
    return relative_curve(curve, sensor.static[rows], sensor.u_static)


def main_channel(evaluation: CampaignEvaluation, channels: Sequence[str], component: int) -> int:
    """Return which of the outputs belongs to a load component.

    The one of the same name, else the largest by static sensitivity, else the largest found.
    """
    sensor = evaluation.sensor
    if LOAD_COMPONENTS[component] in channels:
        return list(channels).index(LOAD_COMPONENTS[component])
    if sensor is not None and sensor.static is not None:
        rows = [sensor.channels.index(channel) for channel in channels]
        return int(np.argmax(np.abs(sensor.static[rows, component])))
    size = np.zeros(len(channels))
    for curve in evaluation.curves:
        for e, (channel, j) in enumerate(curve.elements):
            if j == component and curve.channels[channel] in channels:
                place = list(channels).index(curve.channels[channel])
                size[place] = max(size[place], float(np.nanmax(np.abs(curve.value[:, e]), initial=0.0)))
    return int(np.argmax(size))


def distinct_names(recorded: Sequence[Recorded]) -> tuple[Recorded, ...]:
    """Return the recordings with names that tell them apart: a name that occurs twice gets the folder's beside it.

    Unknowns of single recordings are known by the recording's name.
    """
    names = [entry.name for entry in recorded]
    return tuple(
        entry if names.count(entry.name) == 1 else _renamed(entry, f"{entry.name} [{entry.folder}]")
        for entry in recorded
    )


def fit_matrices(drives: Sequence[Drive], channels: Sequence[str]) -> tuple[tuple[MatrixFit, ...], tuple[Notice, ...]]:
    """Return the matrix of every frequency that determines one, and why the others do not."""
    fits: list[MatrixFit] = []
    refused: dict[tuple[Severity, str], list[float]] = {}
    recorded = [name for name in channels if any(name in drive.channels for drive in drives)]
    for group in group_by_frequency(drives):
        try:
            fits.append(fit_matrix(group, recorded))
        except ValueError as error:
            refused.setdefault(_reason(error), []).append(group[0].frequency_hz)
    notices = tuple(_refusal(*reason, places) for reason, places in refused.items())
    return tuple(fits), notices


def _reason(error: ValueError) -> tuple[Severity, str]:
    """Why there is no matrix, and how severe that is: ratios need no matrix, a fit that fails is a surprise."""
    if isinstance(error, MissingExcitationError):
        return "info", "the recordings excite too few independent loads; " + str(error).partition("; ")[2]
    return "warning", str(error)


def _refusal(severity: Severity, reason: str, frequency_hz: Sequence[float]) -> Notice:
    """One sentence for all frequencies without a matrix for the same reason."""
    first, last = min(frequency_hz), max(frequency_hz)
    where = (
        f"{first:.6g} Hz"
        if len(frequency_hz) == 1
        else f"{len(frequency_hz)} frequencies, {first:.6g} to {last:.6g} Hz"
    )
    return Notice(severity, f"no matrix at {where}: {reason}", "matrix")


def _failures(failed: Mapping[str, str]) -> tuple[Notice, ...]:
    """Name the recordings that could not be evaluated."""
    if not failed:
        return ()
    text = f"{len(failed)} of the recordings could not be evaluated and are in no result: {', '.join(failed)}"
    return (Notice("warning", text, "campaign"),)


def _renamed(entry: Recorded, name: str) -> Recorded:
    """A recording under another name."""
    return replace(entry, name=name, drives=tuple(replace(drive, recording=name) for drive in entry.drives))


def _one_sensor(recorded: Sequence[Recorded]) -> tuple[SensorFacts | None, tuple[Notice, ...]]:
    """The sensor of all recordings; none where they tested several, which have nothing to say together."""
    sensors = {(entry.sensor.name, entry.sensor.serial): entry.sensor for entry in recorded if entry.sensor is not None}
    if len(sensors) > 1:
        names = ", ".join(f"{name} {serial}".strip() for name, serial in sensors)
        text = f"the recordings tested several sensors ({names}): no joint sensitivity; a campaign has one sensor"
        return None, (Notice("warning", text, "campaign"),)
    return next(iter(sensors.values()), None), ()


# The curves of a campaign as points: magnitude and phase of every element at every frequency, and of recordings.


@dataclass(frozen=True)
class CurvePoint:
    """One element of the sensitivity at one frequency.

    `channel` and `component` by name; `element`: the value; `relative`: over its static sensitivity, None where that
    is not stated; `recordings` and `mountings` behind it; `kind`: ratio or matrix.
    """

    frequency_hz: float
    channel: str
    component: str
    unit: str
    element: Polar
    relative: Polar | None
    recordings: int
    mountings: int
    kind: str


def curve_points(evaluation: CampaignEvaluation) -> tuple[CurvePoint, ...]:
    """Return all points of all curves: curve by curve, frequencies ascending."""
    mounting = {entry.name: entry.mounting for entry in evaluation.recorded}
    unit = "" if evaluation.sensor is None else evaluation.sensor.unit
    points = []
    for curve, relative in zip(evaluation.curves, evaluation.relative, strict=True):
        values = curve_elements(curve)
        ratios = {} if relative is None else _by_element(relative)
        for k, row in enumerate(values):
            mountings = len({mounting[name] for name in curve.recordings[k]})
            for (c, j), element in zip(curve.elements, row, strict=True):
                if element is not None:
                    points.append(
                        CurvePoint(
                            frequency_hz=float(curve.frequency_hz[k]),
                            channel=curve.channels[c],
                            component=LOAD_COMPONENTS[j],
                            unit=sensitivity_unit(unit, LOAD_COMPONENTS[j]),
                            element=element,
                            relative=ratios[c, j][k] if (c, j) in ratios else None,
                            recordings=len(curve.recordings[k]),
                            mountings=mountings,
                            kind=curve.kind,
                        )
                    )
    return tuple(points)


def single_points(evaluation: CampaignEvaluation, curve: Curve, element: int) -> list[tuple[float, str, Polar]]:
    """Return frequency, mounting and ratio of every recording behind one element of a curve of ratios."""
    c, component = curve.elements[element]
    channel = curve.channels[c]
    behind = {(name, k) for k, names in enumerate(curve.recordings) for name in names}
    found = []
    for drive in evaluation.drives:
        line = int(np.argmin(np.abs(curve.frequency_hz - drive.frequency_hz)))
        if (drive.recording, line) in behind and channel in drive.channels:
            value, uncertainty = drive_ratio(drive, component, [channel])
            point = elements(value[None], uncertainty)[0][0]
            if point is not None:
                found.append((drive.frequency_hz, drive.mounting, point))
    return found


def curve_elements(curve: Curve) -> list[list[Polar | None]]:
    """Return every element (K lines of E) with magnitude and phase, None where there is no value."""
    return elements(curve.value, curve.uncertainty)


def elements(value: ComplexArray, uncertainty: Uncertainty) -> list[list[Polar | None]]:
    """Return complex values (K, C) with magnitude and phase, None where there is no value."""
    covariance, dof = uncertainty.covariance, uncertainty.dof()
    return [
        [
            polar(complex(entry), element_covariance(covariance[k], c), float(dof[k, c]))
            if np.isfinite(entry)
            else None
            for c, entry in enumerate(row)
        ]
        for k, row in enumerate(value)
    ]


def _by_element(curve: Curve) -> dict[tuple[int, int], Sequence[Polar | None]]:
    """Elements of a curve over frequency, by channel and component."""
    return dict(zip(curve.elements, zip(*curve_elements(curve), strict=True), strict=True))


# The curves of a campaign on its page: headlines, table, figures.


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
