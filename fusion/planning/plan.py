"""`shakercal plan`: camera rates for the frequencies of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.base import prefix
from fusion.errors import InputError
from fusion.planning.planning_notices import (
    NOISE_UNSTATED,
    RATE_LIMITS,
    RATE_STEP,
    TOO_FEW_FRAMES,
    TOO_MANY_LISTED_LINES,
)
from fusion.report.table import R, TableColumn, csv_text, page_column
from fusion.report.terminal import print_table, print_text
from shaker.lines.rate_planner import (
    PREFERRED,
    PlannedLines,
    RatePlan,
    Sampling,
    best_rates,
    candidate_rates,
    fewest_rates,
    lines_of,
    plan_at,
    scan_rates,
)
from shaker.sine.aliasing import CLEAR_BINS
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import DASH, number_text

PER_NOISE = "noise per frame"
MOST_LINES, MOST_LINES_OF_ALL = 200, 2000  # lines fitted at one point, and at all points: a plan takes some seconds
MOST_ENTRIES = 2_000_000  # lines times frames of a point: some 100 MB
SHOWN = 3  # frequencies that are written; of more the number is


@dataclass(frozen=True)
class MotionSize:
    """Noise and amplitude of the motion, for absolute uncertainties.

    `noise_m` per frame; `amplitude_m` or `acceleration_mps2` of a fundamental.
    """

    noise_m: float | None = None
    amplitude_m: float | None = None
    acceleration_mps2: float | None = None

    @property
    def is_whole(self) -> bool:
        """Whether relative uncertainties can be calculated."""
        return self.noise_m is not None and (self.amplitude_m is not None or self.acceleration_mps2 is not None)

    def displacement_m(self, frequency_hz: float) -> float | None:
        """Return the amplitude of a fundamental, None if unknown."""
        if self.acceleration_mps2 is not None:
            return float(self.acceleration_mps2 / (2.0 * np.pi * frequency_hz) ** 2)
        return self.amplitude_m

    def relative(self, plan: RatePlan, k: int) -> float | None:
        """Return the relative standard uncertainty of line k's amplitude, None if unknown.

        It is also that of its phase in rad.
        """
        amplitude = self.displacement_m(float(plan.lines.frequency_hz[k]))
        if amplitude is None or self.noise_m is None or plan.lines.multiple[k] != 1:
            return None
        return float(plan.u_amplitude[k]) * self.noise_m / amplitude


@dataclass(frozen=True)
class Request:
    """Input of a plan: excitation frequencies, sampling and camera rates.

    Attributes
    ----------
    frequency_hz : Excitation frequencies, Hz.
    sampling : Frames, exposure, harmonics and noise of the record.
    together : Whether they are excited at the same time; default False.
    rate_hz : Camera rate to explain, Hz; default None.
    limits_hz : Smallest and largest camera rate, Hz.
    rate_step_hz : Step of possible rates, Hz; default 0.001.
    settle_s : Waiting time before each record, s; default 0.
    size : Noise and amplitude, for absolute uncertainties.

    Examples
    --------
    >>> from fusion import Request
    >>> from shaker import Sampling
    >>> Request((106.25,), Sampling(frames=211), rate_hz=77.5).together
    False
    """

    frequency_hz: tuple[float, ...]
    sampling: Sampling
    together: bool = False
    rate_hz: float | None = None
    limits_hz: tuple[float, float] = (0.0, 0.0)
    rate_step_hz: float = 1e-3
    settle_s: float = 0.0
    size: MotionSize = MotionSize()


@dataclass(frozen=True)
class PlanPoint:
    """One point of the plan: its lines and the best rates, or the given one.

    `nearby`: the good rate nearest to the given one; None if that one is good or none is near.
    """

    lines: PlannedLines
    choices: tuple[RatePlan, ...]
    nearby: RatePlan | None = None


@dataclass(frozen=True)
class SharedRate:
    """A rate for several points: their indices, and its properties for each."""

    rate_hz: float
    points: tuple[int, ...]
    plans: tuple[RatePlan, ...]


@dataclass(frozen=True)
class Plan:
    """Result of a request: its points, and the smallest set of common rates.

    `shared` is empty if a rate was given.
    """

    request: Request
    points: tuple[PlanPoint, ...]
    shared: tuple[SharedRate, ...]


def make_plan(request: Request) -> Plan:
    """Find the best camera rates for every point, or evaluate a given rate.

    Parameters
    ----------
    request
        Frequencies, sampling and limits.

    Returns
    -------
    The best rates of each point and the smallest common set.

    Raises
    ------
    InputError : No rate can serve the request; names the option.

    Examples
    --------
    >>> from fusion import Request, make_plan
    >>> from shaker import Sampling
    >>> plan = make_plan(Request((106.25,), Sampling(frames=211), limits_hz=(70.0, 80.0), rate_step_hz=0.1))
    >>> 70.0 <= plan.points[0].choices[0].rate_hz <= 80.0
    True
    """
    sampling = request.sampling
    _check_size(request)
    groups = [request.frequency_hz] if request.together else [(f,) for f in request.frequency_hz]
    points = [lines_of(group, sampling.harmonics) for group in groups]
    _check(request, points)
    try:
        rates = candidate_rates(points, sampling, request.limits_hz, request.rate_step_hz)
    except ValueError as error:
        expected = f"a step with a multiple between {request.limits_hz[0]:g} and {request.limits_hz[1]:g} Hz"
        found = f"{request.rate_step_hz:g} Hz"
        raise InputError(RATE_STEP, "--rate-step", found=found, expected=expected) from error
    if request.rate_hz is not None:
        return Plan(request, tuple(_explained(lines, request.rate_hz, rates, sampling) for lines in points), ())
    scans = [scan_rates(lines, rates, sampling) for lines in points]
    chosen = tuple(
        PlanPoint(lines, tuple(plan_at(lines, rate, sampling) for rate in best_rates(scan)))
        for lines, scan in zip(points, scans, strict=True)
    )
    shared = [
        SharedRate(rate, served, tuple(plan_at(points[i], rate, sampling) for i in served))
        for rate, served in fewest_rates(scans)
    ]
    return Plan(request, chosen, tuple(shared))


def _check_size(request: Request) -> None:
    """Refuse more lines and frames than time and memory permit, naming the option."""
    frames, harmonics, excitations = request.sampling.frames, request.sampling.harmonics, len(request.frequency_hz)
    lines = harmonics * (excitations if request.together else 1)
    if lines > MOST_LINES:
        expected = f"at most {MOST_LINES} lines of a point"
        raise InputError(TOO_MANY_LISTED_LINES, "--harmonics", found=lines, expected=expected)
    if frames * lines > MOST_ENTRIES:
        expected = f"at most {MOST_ENTRIES // lines} for {lines} lines of a point"
        raise InputError(TOO_MANY_LISTED_LINES, "--frames", found=frames, expected=expected)
    if excitations * harmonics > MOST_LINES_OF_ALL:
        expected = f"at most {MOST_LINES_OF_ALL // harmonics} with {harmonics} harmonics each"
        raise InputError(TOO_MANY_LISTED_LINES, "--frequencies", found=excitations, expected=expected)


def _explained(lines: PlannedLines, rate_hz: float, rates: FloatArray, sampling: Sampling) -> PlanPoint:
    """Return the given rate for a point, with the nearest good rate.

    It is None if the given rate is good.
    """
    scan = scan_rates(lines, np.sort(np.append(rates, rate_hz)), sampling)
    good = scan.rate_hz[scan.good]
    nearby = None
    if len(good):
        nearest = float(good[np.argmin(np.abs(good - rate_hz))])
        nearby = None if nearest == rate_hz else plan_at(lines, nearest, sampling)
    return PlanPoint(lines, (plan_at(lines, rate_hz, sampling),), nearby)


def _check(request: Request, points: Sequence[PlannedLines]) -> None:
    """Refuse a request that no rate can serve, naming the option."""
    highest = max(request.limits_hz) if request.rate_hz is None else request.rate_hz
    if request.rate_hz is None and not 0.0 < request.limits_hz[0] <= request.limits_hz[1]:
        low, high = request.limits_hz
        expected = f"no more than --max-rate ({high:g} Hz)"
        raise InputError(RATE_LIMITS, "--min-rate", found=f"{low:g} Hz", expected=expected)
    needed = 2 * max(len(lines.frequency_hz) for lines in points) + 2
    frames = request.sampling.frames
    if frames < needed:
        expected = f"at least {needed} for as many lines"
        raise InputError(TOO_FEW_FRAMES, "--frames", found=frames, expected=expected)
    exposure = request.sampling.exposure_s
    if exposure * highest > 1.0:
        expected = f"no more than the time between frames ({number_text(1.0 / highest)} s)"
        raise InputError(RATE_LIMITS, "--exposure", found=f"{exposure:g} s", expected=expected)
    sized = request.size.amplitude_m is not None or request.size.acceleration_mps2 is not None
    if sized and request.size.noise_m is None:
        option = "--amplitude" if request.size.amplitude_m is not None else "--acceleration"
        raise InputError(NOISE_UNSTATED, option, found="no --noise", expected="--noise in addition")


# The plan as tables, in a file and on the terminal.


class _Line(NamedTuple):
    """One line at one rate.

    `point`: number or excitation; `relative`: u over the amplitude, None if unknown.
    """

    point: str
    choice: str
    plan: RatePlan
    frequency_hz: float
    fundamental_hz: float
    multiple: int
    alias_hz: float
    bins: float
    neighbour_hz: float
    gain: float
    u_amplitude: float
    relative: float | None


def _lines_at(size: MotionSize, plan: RatePlan, point: str = "", choice: str = "") -> list[_Line]:
    """Return the lines of a point at one rate."""
    numbers = (
        plan.lines.frequency_hz,
        plan.lines.fundamental_hz,
        plan.lines.multiple,
        plan.alias_hz,
        plan.distance_hz / plan.resolution_hz,
        plan.neighbour_hz,
        plan.gain,
        plan.u_amplitude,
        [size.relative(plan, k) for k in range(len(plan.gain))],
    )
    return [_Line(point, choice, plan, *values) for values in zip(*numbers, strict=True)]


def plan_csv(plan: Plan) -> str:
    """Return the plan as a table with a row per point, choice and line.

    SI units, one header line.
    """
    size, rows = plan.request.size, list[_Line]()
    for number, point in enumerate(plan.points, start=1):
        for choice, at_rate in enumerate(point.choices, start=1):
            name = str(choice) if plan.request.rate_hz is None else "given"
            rows += _lines_at(size, at_rate, str(number), name)
    for shared in plan.shared:
        for index, at_rate in zip(shared.points, shared.plans, strict=True):
            rows += _lines_at(size, at_rate, str(index + 1), "shared")
    return csv_text(_line_columns(size), rows)


def _line_columns(size: MotionSize) -> list[TableColumn[_Line]]:
    """Return the columns of lines at a rate.

    A file has those with a name, the terminal those with a head.
    """
    noise_m, unit = (1.0, PER_NOISE) if size.noise_m is None else (size.noise_m, "m")
    noise, shown_unit = _shown_noise(size)

    def nearest(line: _Line) -> str:
        if line.neighbour_hz == 0.0:
            return "zero"
        return f"{number_text(line.neighbour_hz, 9)} Hz" if np.isfinite(line.neighbour_hz) else "Nyquist"

    return [
        TableColumn("point", lambda line: line.point),
        TableColumn("choice", lambda line: line.choice),
        TableColumn("rate_hz", lambda line: f"{line.plan.rate_hz:.9g}"),
        TableColumn("duration_s", lambda line: f"{line.plan.duration_s:.9g}"),
        TableColumn("condition", lambda line: f"{line.plan.condition:.9g}"),
        TableColumn("line_hz", lambda line: f"{line.frequency_hz:.9g}", "line / Hz"),
        TableColumn("fundamental_hz", lambda line: f"{line.fundamental_hz:.9g}"),
        TableColumn("multiple", lambda line: line.multiple, "harmonic"),
        TableColumn(
            "alias_hz", lambda line: f"{line.alias_hz:.6g}", "seen at / Hz", lambda line: f"{line.alias_hz:.3f}"
        ),
        TableColumn(
            "alias_over_rate",
            lambda line: f"{line.alias_hz / line.plan.rate_hz:.6g}",
            "of rate",
            lambda line: f"{line.alias_hz / line.plan.rate_hz:.3f}",
        ),
        TableColumn("distance_bins", lambda line: f"{line.bins:.6g}", "distance", lambda line: f"{line.bins:.2f}"),
        page_column("nearest", nearest),
        TableColumn("exposure_gain", lambda line: f"{line.gain:.6g}", "loss / %", _loss),
        TableColumn(
            "u_amplitude",
            lambda line: f"{line.u_amplitude * noise_m:.4g}",
            f"u{shown_unit}",
            lambda line: _three_digits(noise * line.u_amplitude),
        ),
        TableColumn("u_amplitude_unit", lambda line: unit),
        TableColumn("u_phase_rad", lambda line: "" if line.relative is None else f"{line.relative:.4g}"),
        *_relative_columns(size),
    ]


def _rate_columns(size: MotionSize) -> list[TableColumn[_Line]]:
    """Return the columns of rates; each row is the most uncertain fundamental."""
    noise, unit = _shown_noise(size)

    def aliases(line: _Line) -> FloatArray:
        return np.asarray(line.plan.alias_hz[line.plan.lines.multiple == 1])

    return [
        page_column("excited / Hz", lambda line: line.point),
        page_column("rate / Hz", lambda line: f"{line.plan.rate_hz:.3f}"),
        page_column("seen at / Hz", lambda line: _range(aliases(line))),
        page_column("of rate", lambda line: _range(aliases(line) / line.plan.rate_hz)),
        page_column("distance", lambda line: f"{line.plan.distance_bins:.2f}"),
        page_column("cond.", lambda line: f"{line.plan.condition:.2f}"),
        page_column(f"u{unit}", lambda line: _three_digits(noise * line.u_amplitude)),
        page_column(f"worst u{unit}", lambda line: _three_digits(noise * float(np.max(line.plan.u_amplitude)))),
        *_relative_columns(size),
        page_column("loss / %", _loss),
        page_column("time / s", lambda line: f"{line.plan.duration_s:.2f}"),
    ]


def _relative_columns(size: MotionSize) -> list[TableColumn[_Line]]:
    """Return the columns of relative uncertainties, empty without the size of the motion."""

    def shown(line: _Line, factor: float) -> str:
        return "" if line.relative is None else _three_digits(factor * line.relative)

    if not size.is_whole:
        return []
    return [
        page_column("u / %", lambda line: shown(line, 100.0)),
        page_column("phase / mrad", lambda line: shown(line, 1e3)),
    ]


def _loss(line: _Line) -> str:
    """Return the loss of amplitude by the exposure, in per cent."""
    return f"{100.0 * (1.0 - line.gain):.3f}"


def _range(values: FloatArray) -> str:
    """Return one value, or the ends of several."""
    ends = sorted({f"{value:.3f}" for value in (float(np.min(values)), float(np.max(values)))}, key=float)
    return DASH.join(ends)


def _three_digits(value: float) -> str:
    """Return a number with three significant digits."""
    return f"{value:#.3g}".rstrip(".")


def _shown_noise(size: MotionSize) -> tuple[float, str]:
    """Return the noise of one frame in a readable unit, and that unit."""
    if size.noise_m is None:
        return 1.0, ""
    factor, letter = prefix(np.array([0.1 * size.noise_m]))
    return size.noise_m / factor, f" / {letter}m"


# Output of `shakercal plan`: the rates of every frequency, the smallest common set, or the effect of one rate.


def print_plan(plan: Plan) -> None:
    """Print the plan to stdout."""
    request, sampling = plan.request, plan.request.sampling
    frequencies = ", ".join(number_text(f, 9) for f in request.frequency_hz)
    if len(request.frequency_hz) > SHOWN:
        ends = f"{number_text(min(request.frequency_hz), 9)} to {number_text(max(request.frequency_hz), 9)}"
        frequencies = f"{len(request.frequency_hz)} frequencies, {ends}"
    together = " at the same time" if request.together else ""
    fitted = "fundamentals alone" if sampling.harmonics == 1 else f"harmonics 1 to {sampling.harmonics}"
    rates = (
        ""
        if request.rate_hz
        else f", camera rate {number_text(request.limits_hz[0], 6)} to {number_text(request.limits_hz[1], 6)} Hz"
    )
    print_text(
        f"Excitation {frequencies} Hz{together}, {fitted}; {sampling.frames} frames, exposure "
        f"{sampling.exposure_s * 1e6:.6g} µs{rates}; 1/f noise exceeds white noise below {sampling.corner_hz:.6g} Hz",
    )
    if request.rate_hz is None:
        _print_choices(plan)
    else:
        for point in plan.points:
            _print_explained(request.size, point)
    unit = " in units of the noise of one frame" if request.size.noise_m is None else ""
    print_text(
        f"u: standard uncertainty (k = 1) of an amplitude{unit}, of the fundamental and of the worst line; "
        "relative to the amplitude it is that of the phase in rad",
    )
    if not request.size.is_whole:
        print_text("(--noise with --amplitude or --acceleration gives numbers)")
    distance_text = "distance: smallest one of two aliased lines, in bins of rate/frames"
    print_text(f"{distance_text} ({CLEAR_BINS:g} required); loss: of amplitude, by exposure (a run corrects it)")
    smallest = request.size.displacement_m(max(request.frequency_hz))
    if smallest is not None:
        moved = (
            f"The displacement at {number_text(max(request.frequency_hz), 9)} Hz is {number_text(1e6 * smallest)} µm."
        )
        shown = "show how large the fixed pattern of the sensors is (docs/tracking.md)."
        print_text(
            f"{moved} Below 0.1 px in the images, add 5 to 10 images of the body displaced by 1 to 5 px: they {shown}"
        )


def _print_sections(title: str, columns: Sequence[TableColumn[R]], sections: Sequence[Sequence[R]]) -> None:
    """Print a table with a line between its sections."""
    shown = [column for column in columns if column.head is not None]
    cells = [[[column.cell(row) for column in shown] for row in rows] for rows in sections]
    print_table(title, [column.head or "" for column in shown], "r" * len(shown), cells)


def _print_choices(plan: Plan) -> None:
    """Print the rates of every point, and the smallest common set."""
    size, points, settle_s = plan.request.size, plan.points, plan.request.settle_s
    columns = _rate_columns(size)
    excited = [_range(point.lines.fundamentals_hz) for point in points]

    def row(name: str, at_rate: RatePlan) -> _Line:
        fundamentals = [line for line in _lines_at(size, at_rate, name) if line.multiple == 1]
        return max(fundamentals, key=lambda line: line.u_amplitude)

    def time_of(plans: Sequence[RatePlan]) -> str:
        total_s = sum(at_rate.duration_s + settle_s for at_rate in plans)
        return f"{total_s:.1f} s" + (f", {number_text(settle_s, 6)} s before each included" if settle_s else "")

    def served(plans: Sequence[RatePlan], how: str) -> str:
        number = f"All {len(plans)}" if len(plans) == len(points) else f"{len(plans)} of {len(points)}"
        return f"{number}, {how}: {time_of(plans)}"

    sections = [
        [row(name if at_rate is point.choices[0] else "", at_rate) for at_rate in point.choices]
        for name, point in zip(excited, points, strict=True)
        if point.choices
    ]
    if sections:
        _print_sections("Camera rates, best first", columns, sections)
    fewer = "fewer harmonics, or more exact frequencies (--tolerance)"
    for name, point in zip(excited, points, strict=True):
        if not point.choices:
            print_text(f"{name} Hz: no such rate separates all lines; use more frames or {fewer}")
    first = [point.choices[0] for point in points if point.choices]
    if len(points) > 1 and first:
        print_text(served(first, "each at its first rate"))
        pairs = [zip(shared.points, shared.plans, strict=True) for shared in plan.shared]
        sections = [[row(excited[index], at_rate) for index, at_rate in pair] for pair in pairs]
        _print_sections("With as few rates as possible", columns, sections)
        rates = ", ".join(f"{shared.rate_hz:.3f}" for shared in plan.shared)
        number = "one rate" if len(plan.shared) == 1 else f"{len(plan.shared)} rates"
        plans = [at_rate for shared in plan.shared for at_rate in shared.plans]
        print_text(served(plans, f"with {number} ({rates} Hz)"))
    elif first:
        print_text(f"Time: {time_of(first)}")
        _print_lines(size, first[0])


def _print_lines(size: MotionSize, plan: RatePlan) -> None:
    """Print all lines of a point at one rate."""
    _print_sections(f"Lines at {number_text(plan.rate_hz, 9)} Hz", _line_columns(size), [_lines_at(size, plan)])


def _print_explained(size: MotionSize, point: PlanPoint) -> None:
    """Print the effect of the given rate on one point, line by line."""
    (plan,) = point.choices
    for frequency, alias in zip(plan.lines.frequency_hz, plan.alias_hz, strict=True):
        if frequency in plan.lines.fundamentals_hz:  # whole periods between two frames and a rest: a slow beat
            turns = round(frequency / plan.rate_hz)
            sign = "+" if frequency >= turns * plan.rate_hz else "-"
            seen = "directly" if turns == 0 else f"as a beat of {alias:.3f} Hz"
            print_text(
                f"{frequency:.9g} Hz = {turns} × {plan.rate_hz:.9g} Hz {sign} {alias:.3f} Hz: seen {seen}, "
                f"{alias * plan.duration_s:.2f} periods in {plan.duration_s:.2f} s",
            )
    _print_lines(size, plan)
    for frequency, alias in zip(plan.lines.fundamentals_hz, plan.alias_hz, strict=False):
        share = float(alias) / plan.rate_hz
        if share < PREFERRED[0]:
            print_text(
                f"{frequency:.9g} Hz is seen below {PREFERRED[0]:g} of the rate: drift, slow motion of the rig and "
                f"other 1/f noise around {alias:.3f} Hz disturb it",
            )
        elif share > PREFERRED[1]:
            print_text(
                f"{frequency:.9g} Hz is seen above {PREFERRED[1]:g} of the rate: near the Nyquist frequency a small "
                "change of rate brings its mirror image onto it",
            )
    if plan.distance_bins < CLEAR_BINS:
        print_text(f"lines are only {plan.distance_bins:.2f} bins apart: {CLEAR_BINS:g} are required to separate them")
    for other in plan.aliased_harmonics:
        name = f"harmonic {other.multiple} of {number_text(other.fundamental_hz, 9)} Hz, not fitted"
        print_text(f"{name}, is aliased to {other.alias_hz:.3f} Hz, within a bin of a line that is fitted")
    if point.nearby is not None:
        rate = point.nearby.rate_hz
        share = float(np.max(point.nearby.u_amplitude)) / float(np.max(plan.u_amplitude))
        gain = f", worst u {number_text(share, 2)} times the given rate's" if share > 0.0 else ""
        print_text(f"Nearest good rate: {rate:.3f} Hz ({rate - plan.rate_hz:+.3f} Hz){gain}")
