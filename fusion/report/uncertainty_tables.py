"""Tables of uncertainty: agreement of instruments, budgets, vibrometer points, Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from markupsafe import Markup

from fusion.estimation.coverage import Polar, polar
from fusion.estimation.fuse import REMAINING, Acceleration, Untested, untested
from fusion.estimation.instrument_consistency import CommonEstimate, Consistency
from fusion.estimation.uncertainty import Uncertainty, element_covariance, polar_elements
from fusion.instruments.vibrometer import FEWEST_POINTS, PointRatios, PointSpread, axis_name
from fusion.recording.toml import UncertainInput
from fusion.report.table import (
    Table,
    TableColumn,
    capitalise,
    common_exponent,
    degrees_of_freedom,
    factor_text,
    magnitude_phase_text,
    page_column,
    phase,
    table,
)
from fusion.report.tables import (
    acceleration,
    driven_channel,
    driven_component,
    main_line,
    main_result,
    result_name,
    static_sensitivity,
)
from fusion.sensitivity.analyse import NOT_SHOWN, Evaluation
from fusion.sensitivity.distributions import Propagated, RealSpread
from fusion.sensitivity.load_phasors import BudgetEntry, budget
from fusion.sensitivity.ratio import StatedMatrix, parasitic_loads, static_unknowns
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, sensitivity_unit
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import (
    DASH,
    number_text,
    quantity_text,
    round_to_uncertainty,
    scaled_text,
    signed_text,
    small,
    times_ten,
    typeset,
)

# Agreement of instruments: deviations, scatter, untested unknowns.


LONGEST = 15
"""Largest number of unknowns in a table, those with the largest deviations."""


def consistency_tables(evaluation: Evaluation) -> list[Table]:
    """Return tables of chi-square, instruments, scatter and tested unknowns."""
    fused = [result for result in evaluation.accelerations if result.source == "fused"]
    found = (
        chi_square_table(evaluation),
        consistency_table(evaluation),
        _explanations_table(fused),
        _scatter_table(fused),
        _estimates_table(fused),
        _untested_table(fused),
    )
    return [table for table in found if table]


def chi_square_table(evaluation: Evaluation) -> Table | None:
    """Return the agreement of all instruments of a result."""
    rows = tuple(
        (result.body, result.source, ", ".join(result.instruments), f"{result.chi2:.1f}", str(result.dof))
        for result in evaluation.accelerations
        if result.dof > 0
    )
    head = ("body", "result", "instruments", "χ²", "degrees of freedom")
    return Table("Agreement of the instruments", head, "lllrr", rows) if rows else None


def consistency_table(evaluation: Evaluation) -> Table | None:
    """Return the agreement of each instrument with the others."""

    def use(entry: Consistency) -> str:
        if not entry.used:
            return "left out, gross error" if entry.left_out else "compared only"
        return "fused, suspect" if entry.suspect else "fused"

    columns: list[TableColumn[tuple[Acceleration, Consistency]]] = [
        page_column("body", lambda row: row[0].body, "l"),
        page_column("result", lambda row: row[0].source, "l"),
        page_column("instrument", lambda row: row[1].instrument, "l"),
        page_column("channels", lambda row: str(row[1].channels)),
        page_column("normalised deviation", lambda row: signed_text(row[1].normalised_deviation)),
        page_column("amplitude / %", lambda row: signed_text(100.0 * (abs(row[1].ratio) - 1.0), "+.3f")),
        page_column("phase / mrad", lambda row: signed_text(1e3 * float(np.angle(row[1].ratio)), "+.2f")),
        page_column("use", lambda row: use(row[1]), "l"),
    ]
    caption = "Each instrument against the prediction of all others (normalised deviation: 1 is expected)"
    found = [(result, entry) for result in evaluation.accelerations for entry in result.consistency]
    shown = table(caption, columns, found)
    return None if shown is None else replace(shown, rows=tuple(dict.fromkeys(shown.rows)))


def _explanations_table(results: list[Acceleration]) -> Table | None:
    """Return the results without each suspect, for instruments that contradict each other."""
    rows = []
    for result in results:
        frequencies, units = result.phasors.frequency_hz, result.phasors.unit
        for k, c in np.ndindex(result.observed.shape):
            for one in result.explanations:
                if np.isfinite(one.value[k, c]):
                    value = polar(complex(one.value[k, c]), element_covariance(one.covariance[k], c))
                    size = round_to_uncertainty(value.magnitude, value.expanded_magnitude, 0)
                    turn = round_to_uncertainty(value.phase_rad, value.expanded_phase_rad, 0)
                    numbers = (size.value, size.expanded, units[c], turn.value, turn.expanded)
                else:
                    numbers = (DASH,) * 5
                use = "no mean" if result.disputed is not None and result.disputed[k, c] else "fused, covered by U"
                where = (result.body, f"{frequencies[k]:.4f}", MOTION_COMPONENTS[c])
                rows.append((*where, one.suspect, *numbers, use))
    head = ("body", "frequency / Hz", "component", "without", "magnitude", "U", "unit", "phase / rad", "U", "use")
    caption = "The fused acceleration without each suspect (the readings do not determine which one is right)"
    return Table(caption, head, "lrllrrlrrl", tuple(rows)) if rows else None


def _scatter_table(results: list[Acceleration]) -> Table | None:
    """Return the instruments with scatter beyond the stated uncertainty."""
    rows = []
    for result in results:
        for scatter in result.scatter:
            parts = zip(result.phasors.frequency_hz, scatter.amplitude, scatter.phase, scatter.dof, strict=True)
            for frequency, amplitude, phase_rad, dof in parts:
                sizes = (number_text(100.0 * amplitude, 2), number_text(1e3 * phase_rad, 2))
                freedom = f"{dof:.0f}" if np.isfinite(dof) else DASH
                rows.append((result.body, scatter.instrument, f"{frequency:.4f}", *sizes, freedom))
    head = ("body", "instrument", "frequency / Hz", "amplitude / %", "phase / mrad", "dof")
    caption = "Scatter of an instrument's readings beyond their stated u, relative to the motion (standard deviations)"
    return Table(caption, head, "llrrrr", tuple(rows)) if rows else None


def _estimates_table(results: list[Acceleration]) -> Table | None:
    """Return the estimates of the unknowns that the readings can test."""
    rows = []
    for result in results:
        tested = [u for u in result.unknowns if u.remaining < REMAINING and np.isfinite(u.deviation)]
        rows += [(result.body, u) for u in sorted(tested, key=lambda u: -abs(u.deviation))[:LONGEST]]
    columns: list[TableColumn[tuple[str, CommonEstimate]]] = [
        page_column("body", lambda row: row[0], "l"),
        page_column("unknown", lambda row: row[1].name, "l"),
        page_column("stated u", lambda row: number_text(row[1].u, 2)),
        page_column("unit", lambda row: "" if row[1].unit == "1" else row[1].unit, "l"),
        page_column("value / u by the readings", lambda row: signed_text(row[1].unconstrained_value, ".2g")),
        page_column("estimate / u", lambda row: signed_text(row[1].estimate, "+.2f")),
        page_column("deviation", lambda row: signed_text(row[1].deviation, "+.2f")),
        page_column("remaining u / u", lambda row: f"{row[1].remaining:.2f}"),
    ]
    caption = (
        "Stated unknowns by the readings: value without the stated uncertainty, estimate with it, deviation (standard "
        "normal if all is as stated) and remaining u"
    )
    return table(caption, columns, rows)


def _untested_table(results: list[Acceleration]) -> Table | None:
    """Return the important unknowns that these data do not test."""
    columns: list[TableColumn[tuple[str, Untested]]] = [
        page_column("body", lambda row: row[0], "l"),
        page_column("unknown", lambda row: row[1].name, "l"),
        page_column("stated u", lambda row: number_text(row[1].u, 2)),
        page_column("unit", lambda row: "" if row[1].unit == "1" else row[1].unit, "l"),
        page_column("largest effect on", lambda row: row[1].component, "l"),
        page_column(
            "by / % of it",
            lambda row: number_text(100.0 * row[1].relative, 2) if np.isfinite(row[1].relative) else DASH,
        ),
        page_column("share of its variance / %", lambda row: f"{100.0 * row[1].share:.0f}"),
    ]
    caption = "Not tested by these data: used as stated, a larger error would not be noticed"
    return table(caption, columns, [(result.body, unknown) for result in results for unknown in untested(result)])


# Budgets of the driven component, and the share of other loads in the outputs.


SMALLEST_SHARE = 0.05
"""Share of the variance in % from which a contribution has a separate row."""
SMALLEST_SLOPE = 1e-6
"""Share of the variance in % below which a sensitivity coefficient is a rounding error."""


def budget_tables(evaluation: Evaluation) -> list[Table]:
    """Return the budgets of sensitivity (or ratio), load and acceleration at the strongest line."""
    line, component = main_line(evaluation), driven_component(evaluation)
    main, load = main_result(evaluation), evaluation.load
    motion = acceleration(evaluation, "load", "fused")
    tables = []
    if main is not None and np.isfinite(main[0].value[line, driven_channel(evaluation), component]):
        found, index = main
        channel = found.channels[driven_channel(evaluation)]
        quantity = result_name(found.kind[line], channel, LOAD_COMPONENTS[component], main=True)
        tables.append(_budget_table(found.budget, line, index, quantity, found.frequency_hz[line]))
    if load is not None and load.observed[line, component]:
        entries = budget(load.uncertainty.at([component]), load.value[:, [component]])
        quantity = f"load {LOAD_COMPONENTS[component]}"
        tables.append(_budget_table(entries, line, 0, quantity, load.frequency_hz[line]))
    if motion is not None and motion.observed[line, component]:
        entries = budget(motion.uncertainty.at([component]), motion.phasors.value[:, [component]])
        quantity = f"acceleration {MOTION_COMPONENTS[component]} of the load"
        tables.append(_budget_table(entries, line, 0, quantity, motion.phasors.frequency_hz[line]))
    return tables


def _budget_table(entries: Sequence[BudgetEntry], line: int, element: int, quantity: str, frequency_hz: float) -> Table:
    """Return one budget: contributions, their inputs, coefficients, and shares in magnitude and phase.

    Influences that one recording cannot assess, such as repeatability and a new mounting, are listed without a number.
    """
    u = np.array([[entry.u_relative[line, element], entry.u_phase_rad[line, element]] for entry in entries])
    total = np.sqrt(np.sum(u**2, axis=0))
    share = 100.0 * np.divide(u**2, total**2, out=np.zeros_like(u), where=total > 0.0)
    order = np.argsort(-u[:, 0], kind="stable")  # of the magnitude, as in its figure
    shown = [int(element) for element in order if np.max(share[element]) >= SMALLEST_SHARE]
    rows: list[tuple[str, ...]] = []
    for index in shown:
        entry = entries[index]
        slopes = (_slope(entry.coefficient[part, line, element], share[index, part]) for part in (0, 1))
        kind = f"{entry.type}, {degrees_of_freedom(entry.dof[line])}"
        rows.append((entry.label, kind, _input(entry), *slopes, *_contribution(u[index], share[index])))
    rest = np.delete(np.arange(len(entries)), shown)
    if len(rest):
        left = _contribution(np.sqrt(np.sum(u[rest] ** 2, axis=0)), np.sum(share[rest], axis=0))
        rows.append((f"{len(rest)} smaller ones together", "", "", "", "", *left))
    rows += [(cause, "", "not assessed", "", "", *[DASH] * 4) for cause in NOT_SHOWN]
    rows.append((Markup("<b>combined, k = 1</b>"), "", "", "", "", *_contribution(total, np.sum(share, axis=0))))
    head = (
        *("contribution", "type, dof", "u of the input", "magnitude per unit", "rad per unit"),
        *("u(magnitude) / %", "share / %", "u(phase) / mrad", "share / %"),
    )
    return Table(f"Budget of {quantity} at {frequency_hz:.4f} Hz", head, "llrrrrrrr", tuple(rows))


def _contribution(u: FloatArray, share: FloatArray) -> tuple[str, str, str, str]:
    """Return the contribution (2,) to magnitude and phase, each with its share in %."""
    return small(100.0 * u[0]), f"{share[0]:.1f}", small(1e3 * u[1]), f"{share[1]:.1f}"


def _input(entry: BudgetEntry) -> str:
    """Return the standard uncertainty of the unknown with its unit; a dash for noise."""
    if not np.isfinite(entry.u):
        return f"{entry.count} unknowns" if entry.count > 1 else DASH
    unit = "" if entry.unit == "1" else typeset(entry.unit)
    each = f", {entry.count} times" if entry.count > 1 else ""
    return Markup("{} {}").format(number_text(entry.u, 2), unit).strip() + each


def _slope(value: float, share: float) -> str:
    """Return a sensitivity coefficient with its sign, or that it is about zero."""
    if not np.isfinite(value):
        return DASH
    return number_text(value, 2) if share >= SMALLEST_SLOPE else "≈ 0"


def other_loads_table(evaluation: Evaluation) -> Table | None:
    """Return the share of the other loads in each output at the strongest line."""
    sensitivity, outputs, load = evaluation.sensitivity, evaluation.outputs, evaluation.load
    sensor, static = evaluation.manifest.rig.sensor, static_sensitivity(evaluation)
    if sensitivity is None or outputs is None or load is None or sensor is None or static is None:
        return None
    line, component = main_line(evaluation), driven_component(evaluation)
    unknowns = static_unknowns(StatedMatrix.of(sensor), outputs.phasors.channels, static)
    shares = parasitic_loads(outputs, load, static, component, unknowns)
    rows: list[tuple[str, ...]] = []
    for c, name in enumerate(outputs.phasors.channels):
        if not abs(shares.value[line, c]) > 0.0:
            rows.append((name, DASH, DASH, DASH, DASH))
            continue
        share = shares.element(line, c)
        k_re, k_im = shares.factors(line, c)
        parts = [
            scaled_text(100.0 * part, 100.0 * u, 0)
            for part, u in ((share.re, k_re * share.u_re), (share.im, k_im * share.u_im))
        ]
        rows.append(
            (name, *parts, magnitude_phase_text(factor_text(k_re), factor_text(k_im)), degrees_of_freedom(share.dof))
        )
    frequency = f"{sensitivity.frequency_hz[line]:.4f}"
    head = ("output", "in phase / %", "across / %", "k", "dof")
    caption = f"Share of each output by loads other than {LOAD_COMPONENTS[component]} at {frequency} Hz, with U"
    return Table(caption, head, "lrrrr", tuple(rows))


# Parallel vibrometer points: each point, their spread and rocking, and their ratios.


def point_tables(evaluation: Evaluation) -> list[Table]:
    """Return tables of each group of parallel points: points, spread and ratios."""
    tables: list[Table | None] = []
    for spread in evaluation.points:
        tables += [_points_table(spread, main_line(evaluation)), _spread_table(spread)]
        if spread.ratios is not None:
            tables.append(_ratios_table(spread, spread.ratios))
    return [shown for shown in tables if shown is not None]


def available_elements(value: ComplexArray, uncertainty: Uncertainty) -> list[list[Polar]]:
    """Return finite values (K, C) as magnitude and phase with their uncertainty."""
    lines = polar_elements(value, uncertainty)
    return [[element for element in row if element is not None] for row in lines]


def _points_table(spread: PointSpread, line: int) -> Table | None:
    """Return every point at one line: position, value, deviations from mean and plane."""
    first, second = (axis_name(axis) for axis in spread.axes)
    points = available_elements(spread.value, spread.uncertainty)[line]
    ratio, left = (values[line] / spread.mean[line] for values in (spread.value, spread.residual))
    columns: list[TableColumn[int]] = [
        page_column("point", lambda i: spread.channels[i], "l"),
        page_column(f"{first} / mm", lambda i: signed_text(1e3 * spread.place_m[i, 0], ".1f")),
        page_column(f"{second} / mm", lambda i: signed_text(1e3 * spread.place_m[i, 1], ".1f")),
        page_column("amplitude / (m/s²)", lambda i: quantity_text(points[i].magnitude, points[i].expanded_magnitude)),
        page_column("phase / rad", lambda i: phase(points[i])),
        page_column("from the mean / %", lambda i: signed_text(100.0 * (abs(ratio[i]) - 1.0), "+.3f")),
        page_column("from the mean / mrad", lambda i: signed_text(1e3 * float(np.angle(ratio[i])), "+.2f")),
        page_column("from the plane / %", lambda i: _left(spread, abs(left[i]))),
    ]
    caption = f"{_title(spread)} at {spread.frequency_hz[line]:.4f} Hz: acceleration of every point with U"
    return table(caption, columns, range(len(points)))


def _spread_table(spread: PointSpread) -> Table | None:
    """Return mean, spread, rocking and residual of the plane at every line."""
    planes = available_elements(spread.plane, spread.plane_uncertainty)

    def turn(line: int, axis: int) -> str:
        element, micro = planes[line][axis + 1], 1e6 / (2.0 * np.pi * spread.frequency_hz[line]) ** 2
        return quantity_text(micro * element.magnitude, micro * element.expanded_magnitude)

    first, second = (axis_name(axis) for axis in spread.axes)
    columns: list[TableColumn[int]] = [
        page_column("frequency / Hz", lambda k: f"{spread.frequency_hz[k]:.4f}"),
        page_column("mean / (m/s²)", lambda k: quantity_text(planes[k][0].magnitude, planes[k][0].expanded_magnitude)),
        page_column("phase / rad", lambda k: phase(planes[k][0])),
        page_column("spread / %", lambda k: number_text(100.0 * float(spread.amplitude_spread[k]))),
        page_column("spread / mrad", lambda k: number_text(1e3 * float(spread.phase_spread_rad[k]))),
        page_column(f"rocking about {first} / µrad", lambda k: turn(k, 0)),
        page_column(f"rocking about {second} / µrad", lambda k: turn(k, 1)),
        page_column("left / %", lambda k: _left(spread, float(spread.left_relative[k]))),
        page_column("expected / %", lambda k: _left(spread, float(spread.left_expected[k]))),
    ]
    caption = (
        f"{_title(spread)}: mean with U, standard deviation over the points, best rigid plane with U, "
        "and rms of its residual"
    )
    return table(caption, columns, range(len(planes)))


def _ratios_table(spread: PointSpread, ratios: PointRatios) -> Table | None:
    """Return mean and standard deviation of the points' ratios, compared with the fused ratio."""
    exponent = common_exponent(ratios.value)
    mean = ratios.value.mean(axis=1, keepdims=True)
    count = ratios.value.shape[1]
    average = np.kron(np.eye(2), np.full((1, count), 1.0 / count))
    uncertainty = ratios.uncertainty.transformed(np.broadcast_to(average, (len(mean), *average.shape)))
    means = [element for (element,) in available_elements(mean, uncertainty)]
    size, turn = ratios.mean_magnitude / np.abs(ratios.fused), np.angle(mean[:, 0] / ratios.fused)
    columns: list[TableColumn[int]] = [
        page_column("frequency / Hz", lambda k: f"{spread.frequency_hz[k]:.4f}"),
        page_column("mean", lambda k: scaled_text(means[k].magnitude, means[k].expanded_magnitude, exponent)),
        page_column(
            "spread / %", lambda k: number_text(100.0 * float(ratios.magnitude_spread[k] / ratios.mean_magnitude[k]))
        ),
        page_column("phase / rad", lambda k: phase(means[k])),
        page_column("spread / mrad", lambda k: number_text(1e3 * float(ratios.phase_spread_rad[k]))),
        page_column("to the fused ratio / %", lambda k: signed_text(100.0 * (size[k] - 1.0), "+.3f")),
        page_column("to the fused ratio / mrad", lambda k: signed_text(1e3 * float(turn[k]), "+.2f")),
    ]
    unit = times_ten(exponent, typeset(sensitivity_unit(ratios.unit, ratios.component)))
    caption = Markup("Output {} over load mass times acceleration, point by point, in {}").format(ratios.channel, unit)
    return table(caption, columns, range(len(means)))


def _title(spread: PointSpread) -> str:
    where = f"along {axis_name(spread.direction)} on the {spread.body}"
    return f"{len(spread.channels)} points of {spread.instrument} {where}"


def _left(spread: PointSpread, share: float) -> str:
    """Return the residual of a plane in per cent; a dash without degrees of freedom."""
    return number_text(100.0 * share) if len(spread.channels) > FEWEST_POINTS else DASH


# A Monte Carlo run: 95 % intervals of the draws and of first-order propagation.


def monte_carlo_tables(evaluation: Evaluation) -> list[Table]:
    """Return one table per result of a Monte Carlo run, sensitivity first."""
    run = evaluation.monte_carlo
    return [] if run is None else [_table(result, run.draws) for result in reversed(run.results)]


def _table(result: Propagated, draws: int) -> Table:
    """Return both intervals of every quantity at every driven line, the region, and the verdict."""
    rows = []
    for line, frequency in enumerate(result.frequency_hz):
        for element, name in enumerate(result.elements):
            if np.isfinite(result.value[line, element]):
                size, turn = (_real_cells(part, line, element) for part in (result.magnitude, result.phase))
                region = f"{100.0 * result.first_holds[line, element]:.1f} %"
                named = Markup("{} / {}").format(name, typeset(result.unit[element]))
                rows.append((f"{frequency:.4f}", named, *size, *turn, region, _verdict(result, draws, line, element)))
    head = ["frequency / Hz", "quantity / unit"]
    for what in ("magnitude", "phase / rad"):
        head += [f"{what}, Monte Carlo", "first order", "difference / u"]
    strong = [np.where(result.weak, 0.0, what.u_end / what.first_u) for what in (result.magnitude, result.phase)]
    good = float(np.nanmax(strong, initial=0.0))
    intervals = f"shortest 95 % intervals of {draws} draws"
    caption = f"{capitalise(result.name)}: {intervals}; their number determines the ends to {number_text(good, 2)} u"
    return Table(caption, (*head, "in the region", ""), "ll" + "r" * 7 + "l", tuple(rows))


def _verdict(result: Propagated, draws: int, line: int, element: int) -> str:
    """Return whether first-order propagation is valid, with the number of common digits."""
    too_small = result.rejected_parts(draws, line, element, too_small=True)
    if too_small:
        return f"first-order U too small: {', '.join(too_small)}"
    large = result.rejected_parts(draws, line, element)
    if large:
        return f"first-order U too large: {', '.join(large)}"
    if result.weak[line, element]:
        return "region confirmed; magnitude and phase are not significant"
    digits = int(min(result.magnitude.digits[line, element], result.phase.digits[line, element]))
    return (
        f"agrees in {digits} digit{'s' * (digits != 1)} of u" if digits else "agrees within the resolution of the draws"
    )


def _real_cells(spread: RealSpread, line: int, element: int) -> list[str]:
    """Return both intervals, and the larger distance of their ends over u."""
    ends = [float(end[line, element]) for end in (spread.low, spread.high, spread.first_low, spread.first_high)]
    u = float(spread.first_u[line, element])
    largest = float(max(spread.d_low[line, element], spread.d_high[line, element]))
    distance = f"{largest / u:.2f}" if u > 0.0 and np.isfinite(largest) else DASH
    return [_interval(ends[0], ends[1], u), _interval(ends[2], ends[3], u), distance]


def _interval(low: float, high: float, u: float) -> str:
    """Return two ends with the digits that u justifies, and their power of ten."""
    exponent = round_to_uncertainty(max(abs(low), abs(high)), u).exponent
    texts = [round_to_uncertainty(end, u, exponent).value for end in (low, high)]
    if exponent:
        return Markup("({} … {}) × {}").format(*texts, times_ten(exponent, ""))
    return f"{texts[0]} … {texts[1]}"


# Inputs of the manifests with the uncertainties that are stated of them.


def _as_stated(item: UncertainInput) -> str:
    """Return the form and the source of a stated uncertainty."""
    stated = item.stated
    if stated is None:
        return "u"
    how = f"U, k = {number_text(stated.k, 6)}" if stated.k is not None else f"half-width, {stated.distribution}"
    freedom = "" if stated.dof is None else f"{number_text(stated.dof, 6)} degrees of freedom"
    return ", ".join(filter(None, (how, freedom, item.source)))


def inputs_table(inputs: Sequence[UncertainInput]) -> Table | None:
    """Return every uncertain input as it is used, with u and U = 2·u."""

    def size_text(item: UncertainInput, factor: float) -> str:
        sizes = factor * np.unique(np.ravel(item.u))
        sizes = 100.0 * sizes if item.relative else sizes
        text = " to ".join(dict.fromkeys((number_text(sizes[0]), number_text(sizes[-1]))))
        return f"{text} %" if item.relative else text

    def value(item: UncertainInput) -> str:
        numbers = np.ravel(item.value) if item.value is not None else np.array([])
        return ", ".join(number_text(number, 9) for number in numbers) if 0 < len(numbers) <= 3 else DASH

    columns: tuple[TableColumn[UncertainInput], ...] = (
        page_column("file", lambda item: item.file.name, "l"),
        page_column("key", lambda item: item.key, "l"),
        page_column("value", value),
        page_column("u", lambda item: size_text(item, 1.0)),
        page_column("2·u", lambda item: size_text(item, 2.0)),
        page_column("stated as", _as_stated, "l"),
    )
    return table("Inputs with their standard uncertainties, in the units of the manifest", columns, inputs)
