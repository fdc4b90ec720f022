"""The report's tables of parallel vibrometer points: each point, what they spread and rock, and each one's ratio."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from fusion.evaluation import Evaluation
from fusion.highlights import main_line
from fusion.point_spread import FEWEST_POINTS, PointRatios, PointSpread, axis_name
from fusion.polar import DASH, Polar, element_covariance, polar, typeset
from fusion.report_numbers import common_exponent, fixed, measured, number, phase, times_ten
from fusion.report_tables import Table
from fusion.results_csv import sensitivity_unit
from fusion.uncertainty import Uncertainty
from shaker._checks import ComplexArray


def point_tables(evaluation: Evaluation) -> list[Table]:
    """Per group of parallel points: the points at the strongest line, their spread at every line, their ratios."""
    tables = []
    line = main_line(evaluation)
    for spread in evaluation.points:
        tables += [_points_table(spread, line), _spread_table(spread)]
        if spread.ratios is not None:
            tables.append(_ratios_table(spread, spread.ratios))
    return tables


def elements(value: ComplexArray, uncertainty: Uncertainty, line: int) -> list[Polar]:
    """Return the C values of a line as magnitude and phase with their uncertainty."""
    covariance, dof = uncertainty.covariance[line], uncertainty.dof()[line]
    return [polar(complex(v), element_covariance(covariance, c), float(dof[c])) for c, v in enumerate(value[line])]


def _points_table(spread: PointSpread, line: int) -> Table:
    """Every point at one line: where it is, what it measures, how far it is from the mean and from the plane."""
    first, second = (axis_name(axis) for axis in spread.axes)
    mean = spread.mean[line]
    rows = []
    for place, (name, found) in enumerate(
        zip(spread.channels, elements(spread.value, spread.uncertainty, line), strict=True)
    ):
        ratio = spread.value[line, place] / mean
        left = abs(spread.residual[line, place] / mean)
        rows.append(
            (
                name,
                *(f"{1e3 * lever:.1f}".replace("-", "\N{MINUS SIGN}") for lever in spread.place_m[place]),
                measured(found.magnitude, found.expanded_magnitude),
                phase(found),
                _signed(100.0 * (abs(ratio) - 1.0), 3),
                _signed(1e3 * float(np.angle(ratio)), 2),
                number(100.0 * left) if _has_rest(spread) else DASH,
            )
        )
    head = (
        *("point", f"{first} / mm", f"{second} / mm", "amplitude / (m/s²)", "phase / rad"),
        *("from the mean / %", "from the mean / mrad", "from the plane / %"),
    )
    frequency = float(spread.frequency_hz[line])
    caption = f"{_title(spread)} at {frequency:.4f} Hz: acceleration of every point with U"
    return Table(caption, head, "lrrrrrrr", tuple(rows))


def _spread_table(spread: PointSpread) -> Table:
    """Mean, spread, rocking and what the plane leaves at every line."""
    first, second = (axis_name(axis) for axis in spread.axes)
    rows = []
    for line, frequency in enumerate(spread.frequency_hz):
        mean, *turns = elements(spread.plane, spread.plane_uncertainty, line)
        micro = 1e6 / (2.0 * np.pi * frequency) ** 2
        rows.append(
            (
                f"{frequency:.4f}",
                measured(mean.magnitude, mean.expanded_magnitude),
                phase(mean),
                number(100.0 * float(spread.amplitude_spread[line])),
                number(1e3 * float(spread.phase_spread_rad[line])),
                *(measured(micro * turn.magnitude, micro * turn.expanded_magnitude) for turn in turns),
                number(100.0 * float(spread.left_relative[line])) if _has_rest(spread) else DASH,
                number(100.0 * float(spread.left_expected[line])) if _has_rest(spread) else DASH,
            )
        )
    head = (
        *("frequency / Hz", "mean / (m/s²)", "phase / rad", "spread / %", "spread / mrad"),
        *(f"rocking about {first} / µrad", f"rocking about {second} / µrad", "left / %", "expected / %"),
    )
    caption = (
        f"{_title(spread)}: mean with U, standard deviation over the points, best rigid plane with U, "
        "and rms of what it leaves"
    )
    return Table(caption, head, "r" * len(head), tuple(rows))


def _ratios_table(spread: PointSpread, ratios: PointRatios) -> Table:
    """Mean and standard deviation of the points' ratios beside the ratio of the fused motion."""
    exponent = common_exponent(ratios.value)
    mean = ratios.value.mean(axis=1, keepdims=True)
    count = ratios.value.shape[1]
    average = np.kron(np.eye(2), np.full((1, count), 1.0 / count))
    uncertainty = ratios.uncertainty.transformed(np.broadcast_to(average, (len(mean), *average.shape)))
    rows = []
    for line, frequency in enumerate(spread.frequency_hz):
        (found,) = elements(mean, uncertainty, line)
        fused = complex(ratios.fused[line])
        known = bool(np.isfinite(fused))
        rows.append(
            (
                f"{frequency:.4f}",
                fixed(found.magnitude, found.expanded_magnitude, exponent),
                number(100.0 * float(ratios.magnitude_spread[line] / ratios.mean_magnitude[line])),
                phase(found),
                number(1e3 * float(ratios.phase_spread_rad[line])),
                _signed(100.0 * (ratios.mean_magnitude[line] / abs(fused) - 1.0), 3) if known else DASH,
                _signed(1e3 * float(np.angle(mean[line, 0] / fused)), 2) if known else DASH,
            )
        )
    unit = times_ten(exponent, typeset(sensitivity_unit(ratios.unit, ratios.component)))
    caption = Markup("Output {} over load mass times acceleration, point by point, in {}").format(ratios.channel, unit)
    head = (
        *("frequency / Hz", "mean", "spread / %", "phase / rad", "spread / mrad"),
        *("to the fused ratio / %", "to the fused ratio / mrad"),
    )
    return Table(caption, head, "rrrrrrr", tuple(rows))


def _title(spread: PointSpread) -> str:
    """What was measured where."""
    return (
        f"{len(spread.channels)} points of {spread.instrument} along {axis_name(spread.direction)} on the {spread.body}"
    )


def _has_rest(spread: PointSpread) -> bool:
    """Whether there are more points than a plane needs."""
    return len(spread.channels) > FEWEST_POINTS


def _signed(value: float, places: int) -> str:
    """A difference with its sign."""
    return f"{value:+.{places}f}".replace("-", "\N{MINUS SIGN}")
