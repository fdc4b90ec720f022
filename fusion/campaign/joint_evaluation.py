"""Joint evaluation of the recordings of a campaign: matrices, curves, repeats, linearity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypeVar

import numpy as np
from markupsafe import Markup

from fusion.campaign.campaign_notices import (
    FAILED_RECORDINGS,
    MISSING_EXCITATIONS,
    NO_JOINT_RESULT,
    NO_MATRIX,
    SEVERAL_SENSORS,
    UNREPEATED_EXCITATIONS,
)
from fusion.campaign.curve import (
    CurvePoint,
    Linearity,
    SensitivityCurve,
    curve_elements,
    find_linearity,
    matrix_curve,
    ratio_curves,
    relative_curve,
)
from fusion.campaign.excited_line import ExcitedLine, group_by_frequency, with_starts
from fusion.campaign.matrix import CrossTalk, MatrixFit, cross_talk, fit_matrix
from fusion.campaign.matrix_solve import MissingExcitationError
from fusion.campaign.recording_results import RecordingResults, SensorFacts
from fusion.campaign.repeats import RepeatMean, cached_mean_ratio, find_repeats, frequencies_text, repeat_notices
from fusion.campaign.uncertainty_jumps import uncertainty_jumps
from fusion.campaign.unknowns import JointUnknown, apply_joint_estimate
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    common_exponent,
    page_column,
    polar_cells,
    table,
)
from fusion.report.tables import deviation, result_name, verdict
from shaker.labels import LOAD_COMPONENTS, sensitivity_unit
from shakercal._common.digits import DASH, quantity_text, scaled_text, small, times_ten
from shakercal._common.notices import Notice

# Joint results of a campaign: matrices, cross-talk, repeats, linearity, one curve per element.


Joint = TypeVar("Joint")
P = TypeVar("P")


@dataclass(frozen=True)
class CampaignEvaluation:
    """Joint results of several recordings of one sensor.

    `name` of the campaign; `recorded`: evaluated recordings in order; `failed`: reasons of the others by folder.
    `curves`: ratios by driven component, elements of the sensor if its matrix is stated, and elements of matrices;
    `relative`: each over its static sensitivity, None if not stated. `repeats`: every excitation that was recorded more
    than once. `matrices` and `cross_talks` (none without rated loads): one per frequency that determines a matrix;
    `refused`: notices for the other frequencies. `unknowns`: joint estimates of the unknowns of the rig, none if the
    loads do not depend on them.
    """

    name: str
    recorded: tuple[RecordingResults, ...]
    failed: Mapping[str, str]
    sensor: SensorFacts | None
    curves: tuple[SensitivityCurve, ...]
    relative: tuple[SensitivityCurve | None, ...]
    repeats: tuple[RepeatMean, ...]
    linearity: tuple[Linearity, ...]
    matrices: tuple[MatrixFit, ...]
    cross_talks: tuple[CrossTalk, ...]
    refused: tuple[Notice, ...]
    notices: tuple[Notice, ...]
    unknowns: tuple[JointUnknown, ...] = ()

    @property
    def excited_lines(self) -> tuple[ExcitedLine, ...]:
        """Driven lines of all recordings."""
        return tuple(drive for entry in self.recorded for drive in entry.excited_lines)


def evaluate_campaign(
    name: str,
    recorded: Sequence[RecordingResults],
    failed: Mapping[str, str],
    keep: Callable[[ExcitedLine], ExcitedLine] = lambda d: d,
) -> CampaignEvaluation:
    """Evaluate the recordings of a campaign together, in the given order.

    A recording name that occurs twice is extended by the folder, since it identifies unknowns of single recordings.
    Several sensors give no joint results. `keep`: stores lines whose load is corrected by the joint estimate.
    """
    corrected, sensor, unknowns, notices = _joined(name, recorded, failed, keep)
    driven = [drive for entry in corrected for drive in entry.excited_lines] if sensor is not None else []
    capacity = None if sensor is None or sensor.capacity is None else sensor.capacity.tolist()
    matrices, refused = _fit_matrices(driven, () if sensor is None else sensor.channels)
    notices += [notice for notice in refused if notice.severity == "warning"]
    mean = cached_mean_ratio()
    ratios = _attempt("curves of ratios", lambda: ratio_curves(driven, capacity, None, mean), notices)
    stated = None if sensor is None else sensor.stated_matrix
    elements: tuple[SensitivityCurve, ...] = ()
    if stated is not None:
        elements = _attempt("curves of elements", lambda: ratio_curves(driven, capacity, stated, mean), notices)
    excitations = _attempt("means of repeats", lambda: find_repeats(driven, capacity, stated, mean), notices)
    series = _attempt("linearity", lambda: find_linearity(driven, capacity, stated), notices)
    # The matrices of all frequencies are one curve for each set of outputs that they have.
    sets = dict.fromkeys(fit.channels for fit in matrices)
    joint = (matrix_curve([fit for fit in matrices if fit.channels == channels]) for channels in sets)
    curves = (*ratios, *elements, *joint)
    repeats = tuple(mean for mean in excitations if len(mean.recordings) > 1)
    notices += [notice for fit in matrices for notice in fit.notices]
    notices += repeat_notices(repeats)
    notices += uncertainty_jumps(corrected if sensor is not None else (), capacity, stated)
    single = len(excitations) - len(repeats)
    if single:
        notices.append(Notice(UNREPEATED_EXCITATIONS, "repeats", single=single, count=len(excitations)))
    return CampaignEvaluation(
        name=name,
        recorded=corrected,
        failed=dict(failed),
        sensor=sensor,
        curves=curves,
        relative=tuple(_over_static(curve, sensor) for curve in curves),
        repeats=repeats,
        linearity=series,
        matrices=matrices,
        cross_talks=() if capacity is None else tuple(cross_talk(fit, capacity) for fit in matrices),
        refused=refused,
        notices=tuple(notices),
        unknowns=unknowns,
    )


def _joined(
    name: str,
    recorded: Sequence[RecordingResults],
    failed: Mapping[str, str],
    keep: Callable[[ExcitedLine], ExcitedLine],
) -> tuple[tuple[RecordingResults, ...], SensorFacts | None, tuple[JointUnknown, ...], list[Notice]]:
    """Return recordings with unique names and corrected loads, the sensor, the unknowns, and notices."""
    named = with_unique_names(recorded)
    sensors = {(entry.sensor.name, entry.sensor.serial): entry.sensor for entry in named if entry.sensor is not None}
    sensor = next(iter(sensors.values())) if len(sensors) == 1 else None
    notices = []
    if len(sensors) > 1:
        tested = ", ".join(f"{name} {serial}".strip() for name, serial in sensors)
        notices.append(Notice(SEVERAL_SENSORS, "campaign", sensors=tested))
    if failed:
        notices.append(Notice(FAILED_RECORDINGS, "campaign", count=len(failed), names=", ".join(failed)))
    corrected, unknowns, estimate_notices = apply_joint_estimate(name, named, keep)
    return corrected, sensor, unknowns, [*notices, *estimate_notices]


def with_unique_names(recorded: Sequence[RecordingResults]) -> list[RecordingResults]:
    """Return recordings with names that occur once, and the starts that they share."""
    count = Counter(entry.name for entry in recorded)
    named = []
    for entry in recorded:
        unique = entry.name if count[entry.name] == 1 else f"{entry.name} [{entry.folder}]"
        drives = tuple(replace(drive, recording=unique) for drive in entry.excited_lines)
        named.append(replace(entry, name=unique, excited_lines=drives))
    started = iter(with_starts(drive for entry in named for drive in entry.excited_lines))
    return [replace(entry, excited_lines=tuple(islice(started, len(entry.excited_lines)))) for entry in named]


def _attempt(result: str, make: Callable[[], tuple[Joint, ...]], notices: list[Notice]) -> tuple[Joint, ...]:
    """Return joint results, or add a notice if these recordings do not allow them."""
    try:
        return make()
    except ValueError as error:
        notices.append(Notice(NO_JOINT_RESULT, "campaign", result=result, reason=str(error)))
        return ()


def _over_static(curve: SensitivityCurve, sensor: SensorFacts | None) -> SensitivityCurve | None:
    static = None if sensor is None else sensor.static_of(curve.channels)
    return (
        None
        if sensor is None or static is None
        else relative_curve(curve, static, sensor.stated_matrix.u_elements(static))
    )


def main_channel(evaluation: CampaignEvaluation, channels: Sequence[str], component: int) -> int:
    """Return the index of the output that belongs to a load component.

    It is the one of the same name, else the largest by static sensitivity, else the largest result.
    """
    if LOAD_COMPONENTS[component] in channels:
        return list(channels).index(LOAD_COMPONENTS[component])
    static = None if evaluation.sensor is None else evaluation.sensor.static_of(channels)
    if static is not None:
        return int(np.argmax(np.abs(static[:, component])))
    size = np.zeros(len(channels))
    for curve in evaluation.curves:
        for e, (channel, j) in enumerate(curve.elements):
            if j == component and curve.channels[channel] in channels:
                index = list(channels).index(curve.channels[channel])
                size[index] = max(size[index], float(np.nanmax(np.abs(curve.value[:, e]), initial=0.0)))
    return int(np.argmax(size))


def _fit_matrices(
    drives: Sequence[ExcitedLine], channels: Sequence[str]
) -> tuple[tuple[MatrixFit, ...], tuple[Notice, ...]]:
    """Return the matrix of every frequency that determines one, and notices for the others.

    Ratios need no matrix: missing excitations are a note, a failed fit is a warning.
    """
    fits: list[MatrixFit] = []
    missing: dict[tuple[str, str], list[float]] = {}
    failed: dict[str, list[float]] = {}
    recorded = [name for name in channels if any(name in drive.channels for drive in drives)]
    for group in group_by_frequency(drives):
        try:
            fits.append(fit_matrix(group, recorded))
        except MissingExcitationError as error:
            names = "; ".join(" with ".join(names) for names in error.missing)
            missing.setdefault((names, error.additions), []).append(group[0].frequency_hz)
        except ValueError as error:
            failed.setdefault(str(error), []).append(group[0].frequency_hz)
    notices = []
    for (names, additions), lines in missing.items():
        frequencies = frequencies_text(lines)
        values = {"frequencies": frequencies, "missing": names, "additions": additions}
        notices.append(Notice(MISSING_EXCITATIONS, "matrix", **values))
    for reason, lines in failed.items():
        notices.append(Notice(NO_MATRIX, "matrix", frequencies=frequencies_text(lines), reason=reason))
    return tuple(fits), tuple(notices)


# Points of the curves: magnitude and phase of every element at every frequency.


def curve_points(evaluation: CampaignEvaluation) -> tuple[CurvePoint, ...]:
    """Return all points of all curves, curve by curve, with ascending frequency."""
    mounting = {entry.name: entry.mounting for entry in evaluation.recorded}
    unit = "" if evaluation.sensor is None else evaluation.sensor.unit
    points = []
    for curve, relative in zip(evaluation.curves, evaluation.relative, strict=True):
        ratios = [] if relative is None else zip(*curve_elements(relative), strict=True)
        over_static = {} if relative is None else dict(zip(relative.elements, ratios, strict=True))
        for k, row in enumerate(curve_elements(curve)):
            mountings = len({mounting[name] for name in curve.recordings[k]})
            for (c, j), element in zip(curve.elements, row, strict=True):
                if element is None:
                    continue
                points.append(
                    CurvePoint(
                        frequency_hz=float(curve.frequency_hz[k]),
                        channel=curve.channels[c],
                        component=LOAD_COMPONENTS[j],
                        unit=sensitivity_unit(unit, LOAD_COMPONENTS[j]),
                        element=element,
                        relative=over_static[c, j][k] if (c, j) in over_static else None,
                        recordings=len(curve.recordings[k]),
                        mountings=mountings,
                        kind=curve.kind,
                    )
                )
    return tuple(points)


# The curves of a campaign on its page: headlines and tables.


FULL_HEADLINES = 2
"""Largest number of driven components for which the end of the curve has a headline, too."""


def main_points(evaluation: CampaignEvaluation, points: Sequence[CurvePoint]) -> dict[str, list[CurvePoint]]:
    """Return the points of the main outputs by component: ratios before elements of matrices."""
    found: dict[str, list[CurvePoint]] = {}
    for index, component in enumerate(LOAD_COMPONENTS):
        matching = [point for point in points if point.component == component]
        channels = list(dict.fromkeys(point.channel for point in matching))
        if matching:
            main = channels[main_channel(evaluation, channels, index)]
            found[component] = [point for point in matching if point.channel == main]
    return found


def headlines(evaluation: CampaignEvaluation, mains: dict[str, list[CurvePoint]]) -> list[Headline]:
    """Return the main results: every main sensitivity, its change with frequency, the largest cross-talk."""
    found = []
    for points in mains.values():
        best = best_points(points)
        first, last = best[0], best[-1]
        expanded = [100.0 * point.element.expanded_magnitude / point.element.magnitude for point in best]
        many = len(mains) > FULL_HEADLINES
        remark = f"U = {small(expanded[0])} % (k = {first.element.k:.2f})"
        if first.relative is not None:
            judged = verdict(first.relative)
            remark += f"; {judged.partition(',')[0] if many else judged}"
        name = result_name(first.kind, first.channel, first.component, main=True)
        if first.kind != "ratio":
            name = f"{'' if many else 'sensitivity, '}output {first.channel} per load {first.component}"
        name = capitalise(name)
        label = f"{name}, {first.frequency_hz:.1f} Hz"
        size = quantity_text(first.element.magnitude, first.element.expanded_magnitude, first.unit)
        found.append(Headline(label, size, remark))
        if many or len(best) < 2:
            continue
        if last.relative is not None:
            label = f"Deviation from static at {last.frequency_hz:.1f} Hz"
            remark = f"U of the curve's magnitudes: {small(min(expanded))} % to {small(max(expanded))} %"
            found.append(Headline(label, deviation(last.relative), remark))
        turn = quantity_text(last.element.phase_rad, last.element.expanded_phase_rad, "rad")
        remark = f"output {last.channel} relative to load {last.component}"
        found.append(Headline(f"Phase at {last.frequency_hz:.1f} Hz", turn, remark))
    return [*found, *_scatter_headline(evaluation), *_crosstalk_headline(evaluation)]


def best_points(points: Sequence[CurvePoint]) -> list[CurvePoint]:
    """Return the points of the `best_kind` with ascending frequency."""
    return sorted(best_kind(points, lambda point: point.kind), key=lambda point: point.frequency_hz)


def best_kind(points: Sequence[P], kind_of: Callable[[P], str]) -> list[P]:
    """Return the points of the kind that is closest to the sensor's sensitivity.

    Elements of matrices are best, unless elements of single recordings, or else ratios, exist at more frequencies.
    """
    kinds = {kind: [point for point in points if kind_of(point) == kind] for kind in ("matrix", "element", "ratio")}
    single = kinds["element"] or kinds["ratio"]
    return single if len(single) > len(kinds["matrix"]) else kinds["matrix"]


def curve_tables(mains: dict[str, list[CurvePoint]]) -> list[Table]:
    """Return one table per main element over frequency, ratios first."""
    tables = []
    for points in mains.values():
        first = points[0]
        exponent = common_exponent(np.array([complex(point.element.re, point.element.im) for point in points]))
        columns = _curve_columns(exponent, Markup("magnitude / {}").format(times_ten(exponent, first.unit)))
        kinds = ("ratio", "element", "matrix")
        ordered = sorted(points, key=lambda point: (kinds.index(point.kind), point.frequency_hz))
        caption = f"Output {first.channel} per load {first.component} with U = k·u (95 %)"
        tables.append(table(caption, columns, ordered))
    return [one for one in tables if one is not None]


def _curve_columns(exponent: int, magnitude: str) -> list[TableColumn[CurvePoint]]:
    """Return the columns of a table of points, with a common power of ten."""

    def from_static(point: CurvePoint) -> str:
        over = point.relative
        return DASH if over is None else scaled_text(100.0 * (over.magnitude - 1.0), 100.0 * over.expanded_magnitude, 0)

    return [
        page_column("frequency / Hz", lambda point: f"{point.frequency_hz:.4f}"),
        page_column(magnitude, lambda point: polar_cells(point.element, exponent)[0]),
        page_column("phase / rad", lambda point: polar_cells(point.element, exponent)[1]),
        page_column("from static / %", from_static),
        page_column("k", lambda point: polar_cells(point.element, exponent)[2]),
        page_column("kind", lambda point: point.kind, "l"),
        page_column("recordings (mountings)", lambda point: f"{point.recordings} ({point.mountings})"),
    ]


def _scatter_headline(evaluation: CampaignEvaluation) -> list[Headline]:
    """Return the effect of a new mounting over all excitations with several mountings."""
    repeated = [found for found in evaluation.repeats if found.between_dof and found.within_dof]
    if not repeated:
        return []
    channels = [main_channel(evaluation, found.channels, found.component) for found in repeated]
    sizes = [
        float(np.sqrt(np.mean([value[channel] ** 2 for value, channel in zip(values, channels, strict=True)])))
        for values in ([found.between for found in repeated], [found.within for found in repeated])
    ]
    remark = (
        f"between recordings {small(100.0 * sizes[1])} %; rms of {len(repeated)} frequencies, in addition to stated u"
    )
    return [Headline("Scatter between mountings", f"{small(100.0 * sizes[0])} %", remark)]


def largest_crosstalk(evaluation: CampaignEvaluation) -> tuple[CrossTalk, int, int] | None:
    """Return the largest cross-talk that has been shown: its matrix, output and load."""
    best: tuple[float, CrossTalk, int, int] | None = None
    for found in evaluation.cross_talks:
        bounds = np.where(found.holds_zero, -np.inf, np.abs(found.value) - found.half_axis)
        bounds[np.arange(len(found.main)), list(found.main)] = -np.inf
        index = divmod(int(np.argmax(bounds)), bounds.shape[1])
        if np.isfinite(bounds[index]) and (best is None or bounds[index] > best[0]):
            best = float(bounds[index]), found, *index
    return None if best is None else best[1:]


def _crosstalk_headline(evaluation: CampaignEvaluation) -> list[Headline]:
    """Return the largest cross-talk that has been shown."""
    best = largest_crosstalk(evaluation)
    if best is None:
        return []
    found, c, j = best
    size = quantity_text(100.0 * abs(found.value[c, j]), 100.0 * float(found.half_axis[c, j]), "%")
    where = f"output {found.channels[c]} under load {found.components[j]}, {found.frequency_hz:.1f} Hz"
    return [Headline("Largest significant cross-talk", size, where)]
