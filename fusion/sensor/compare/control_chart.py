"""Control charts of sensors over dates: individual values and moving ranges (ISO 7870-2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date as Date
from pathlib import Path

import numpy as np

from fusion.errors import InputError
from fusion.report.figure import BLUE, GREY, RED, empty_figure
from fusion.report.figure_files import render_figure
from fusion.report.report_notices import WRONG_CONDITION
from fusion.report.result_database import query_results
from fusion.report.table import TableColumn, csv_text, text_column
from fusion.report.terminal import print_table, print_text
from fusion.sensor.compare.comparison_inputs import Row, rows_by_line, split_query, year_of
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.digits import number_text, quantity_text, typeset

RANGE_OF_TWO = 2.0 / np.sqrt(np.pi)
"""Mean range of two values of a normal distribution over its standard deviation, d2 = 1.128 (ISO 7870-2, table 1)."""
LIMIT = 3.0
"""Half-width of the limits in standard deviations."""
MIN_DAYS, FEW_DAYS, MAX_PANELS = 3, 20, 8
ROUNDING = 1e-12
"""Deviation from the mean that is rounding, relative to the largest value; of phases relative to one turn."""
RADIAN = "rad"
QUANTITIES = (("magnitude", "u_magnitude"), ("phase_rad", "u_phase_rad"))


@dataclass(frozen=True)
class ControlChart:
    """One quantity of an element at one frequency over N days.

    Attributes
    ----------
    subject : serial number, output per component, kind, frequency and quantity.
    days : the days of the recordings, ascending.
    value, u : (N,) mean of each day, and its mean stated standard uncertainty.
    baseline : number of the first days from which mean and limits are.
    """

    subject: str
    unit: str
    days: tuple[Date, ...]
    value: FloatArray
    u: FloatArray
    baseline: int

    @property
    def centre(self) -> float:
        """Return the mean of the days of the baseline."""
        return float(np.mean(self.value[: self.baseline]))

    @property
    def sigma(self) -> float:
        """Return the mean range of neighbouring days of the baseline over d2."""
        return float(np.mean(np.abs(np.diff(self.value[: self.baseline]))) / RANGE_OF_TWO)

    @property
    def outside(self) -> BoolArray:
        """Return the days (N,) beyond the limits, three standard deviations from the mean."""
        size = 2.0 * np.pi if self.unit == RADIAN else np.max(np.abs(self.value))
        return np.asarray(np.abs(self.value - self.centre) > LIMIT * self.sigma + ROUNDING * size)


def control_charts(rows: Iterable[Row], baseline: int | None = None) -> tuple[ControlChart, ...]:
    """Return the charts of all elements and frequencies with at least three days.

    `rows` of `query_results`; results of one day are averaged, phases about the first one. Rows without a date and
    harmonics are left out. `baseline`: number of the first days that determine mean and limits, None for all.
    """
    dated = (row for row in rows if row["date"] is not None)
    groups = rows_by_line(dated, "serial", "channel", "component", "kind", "unit")
    charts = []
    for (serial, channel, component, kind, unit), lines in sorted(groups.items()):
        for line in lines:
            days = sorted({row["date"] for row in line})
            if len(days) >= MIN_DAYS:
                what = f"{serial} {channel} per {component} ({kind}), {number_text(line[0]['frequency_hz'], 6)} Hz"
                for name, u_name in QUANTITIES:
                    value, u = _daily(line, days, name, u_name)
                    if np.isfinite(value).all():
                        named = name.removesuffix("_rad")
                        unit_of = unit if name == named else RADIAN
                        charts.append(
                            ControlChart(f"{what}, {named}", unit_of, tuple(days), value, u, baseline or len(days))
                        )
    return tuple(charts)


def _daily(rows: Sequence[Row], days: Sequence[Date], name: str, u_name: str) -> tuple[FloatArray, FloatArray]:
    """Return the means (N,) of values and standard uncertainties of each day."""
    values = np.array([row[name] for row in rows])
    if name.endswith("_rad"):
        values = values[0] + np.angle(np.exp(1j * (values - values[0])))
    of_day = [np.array([row["date"] == day for row in rows]) for day in days]
    u = np.array([row[u_name] for row in rows])
    return np.array([values[chosen].mean() for chosen in of_day]), np.array([u[chosen].mean() for chosen in of_day])


def charts_of(database: Path, baseline: int | None = None) -> tuple[ControlChart, ...]:
    """Return the charts of `DATABASE.parquet?CONDITION`; `InputError` without a chart."""
    file, condition = split_query(database)
    rows = query_results(file, condition)
    charts = control_charts(rows, baseline)
    if not charts:
        reason = f"found {condition!r}, which selects no element with results of {MIN_DAYS} days"
        if undated := len({row["path"] for row in rows if row["date"] is None}):
            without = "result is" if undated == 1 else "results are"
            reason += f"; {undated} {without} of recordings without `date` in recording.toml"
        raise InputError(WRONG_CONDITION, file, reason=reason)
    return charts


_Point = tuple[ControlChart, int]
POINTS: list[TableColumn[_Point]] = [
    text_column("chart", lambda point: point[0].subject),
    text_column("date", lambda point: point[0].days[point[1]].isoformat()),
    TableColumn("value", lambda point: float(point[0].value[point[1]])),
    TableColumn("u", lambda point: float(point[0].u[point[1]])),
    text_column("unit", lambda point: point[0].unit),
    TableColumn("centre", lambda point: point[0].centre),
    TableColumn("lower_limit", lambda point: point[0].centre - LIMIT * point[0].sigma),
    TableColumn("upper_limit", lambda point: point[0].centre + LIMIT * point[0].sigma),
    text_column("outside", lambda point: "yes" if point[0].outside[point[1]] else "no"),
]


def charts_csv(charts: Iterable[ControlChart]) -> str:
    """Return one row for each day of every chart."""
    return csv_text(POINTS, [(chart, number) for chart in charts for number in range(len(chart.days))])


def print_charts(charts: Sequence[ControlChart]) -> None:
    """Print mean, limits and the days beyond them of every chart."""
    head = ["chart", "days", "mean ± limits", "unit", "mean U (k = 2)", "days beyond the limits"]
    rows = []
    for chart in charts:
        outside = [day.isoformat() for day, beyond in zip(chart.days, chart.outside, strict=True) if beyond]
        limits = quantity_text(chart.centre, LIMIT * chart.sigma)
        mean_u = number_text(2.0 * float(np.mean(chart.u)), 2)
        rows.append(
            [chart.subject, str(len(chart.days)), limits, typeset(chart.unit), mean_u, ", ".join(outside) or "none"]
        )
    print_table("", head, "lrrlrl", [rows])
    if min(min(len(chart.days), chart.baseline) for chart in charts) < FEW_DAYS:
        print_text(f"limits from fewer than {FEW_DAYS} days are provisional (ISO 7870-2)")


def draw_charts(charts: Sequence[ControlChart], kind: str) -> bytes:
    """Draw deviations from the mean with U over the years, and the limits.

    Those of magnitudes are in % of the mean. `kind`: file format.
    """
    shown = charts[:MAX_PANELS]
    drawn = empty_figure("control-chart", 0.7 + 2.2 * len(shown), len(shown))
    for panel, chart in zip(drawn.panels, shown, strict=True):
        relative = chart.unit != RADIAN and chart.centre > 0.0
        scale, unit = (100.0 / chart.centre, "%") if relative else (1.0, typeset(chart.unit))
        years, deviation = np.array([year_of(day) for day in chart.days]), scale * (chart.value - chart.centre)
        panel.points(years, deviation, "value with U (k = 2)", half_y=2.0 * scale * chart.u, colour=BLUE, size=4.0)
        panel.points(years[chart.outside], deviation[chart.outside], "beyond the limits", colour=RED, size=6.0)
        panel.rule(0.0, colour=GREY)
        panel.rule([-LIMIT * scale * chart.sigma, LIMIT * scale * chart.sigma], "limits", colour=RED, dashed=True)
        panel.y.label = f"{chart.subject.rpartition(', ')[2]} − mean / {unit}"
        panel.title = chart.subject
    drawn.panels[-1].x.label = "year"
    if len(shown) < len(charts):  # files do not show the caption
        drawn.panels[0].title += f" (first {len(shown)} of {len(charts)} charts)"
    text = "Deviation of every day from the mean; limits: three standard deviations by moving ranges (ISO 7870-2)."
    return render_figure(drawn.with_title("Control chart", text), kind)


def drawn_of(charts: Sequence[ControlChart]) -> str:
    """Return a sentence on charts that a figure leaves out, empty if it has all."""
    if len(charts) <= MAX_PANELS:
        return ""
    return f"First {MAX_PANELS} of {len(charts)} charts; a condition such as component = 'Fz' selects others."
