"""`shakercal plan`: camera rates for the frequencies of a calibration, as numbers and as a table in a file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.base import InputError
from shaker.arrays import FloatArray
from shaker.lines.rate_planner import (
    Lines,
    RatePlan,
    Sampling,
    best_rates,
    candidate_rates,
    fewest_rates,
    lines_of,
    plan_at,
    scan_rates,
)

COLUMNS = (
    "point",
    "choice",
    "rate_hz",
    "duration_s",
    "condition",
    "line_hz",
    "fundamental_hz",
    "multiple",
    "alias_hz",
    "alias_over_rate",
    "distance_bins",
    "exposure_gain",
    "u_amplitude",
    "u_amplitude_unit",
    "u_phase_rad",
)
PER_NOISE = "noise per frame"


@dataclass(frozen=True)
class Size:
    """What makes uncertainties absolute: `noise_m` per frame; `amplitude_m` or `acceleration_mps2` of a fundamental."""

    noise_m: float | None = None
    amplitude_m: float | None = None
    acceleration_mps2: float | None = None

    def relative(self, frequency_hz: float, u_amplitude: float) -> float | None:
        """Relative standard uncertainty of a fundamental's amplitude (that of its phase in rad), None if unstated."""
        amplitude = self.amplitude_m
        if self.acceleration_mps2 is not None:
            amplitude = float(self.acceleration_mps2 / (2.0 * np.pi * frequency_hz) ** 2)
        return None if amplitude is None or self.noise_m is None else u_amplitude * self.noise_m / amplitude


@dataclass(frozen=True)
class Request:
    """What to plan: excitations, together or one after the other, at `rate_hz` or within `limits_hz`.

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
    size: Size = Size()


@dataclass(frozen=True)
class Point:
    """One point of the plan: its lines, and what its best rates (best first), or the rate given, make of them.

    `nearby`: the good rate nearest to the rate given, None where that one is good itself or none is near.
    """

    lines: Lines
    choices: tuple[RatePlan, ...]
    nearby: RatePlan | None = None


@dataclass(frozen=True)
class SharedRate:
    """A rate that serves several points: their indices, and what it makes of each."""

    rate_hz: float
    points: tuple[int, ...]
    plans: tuple[RatePlan, ...]


@dataclass(frozen=True)
class Plan:
    """Answer to a request: its points, and the fewest rates that serve all of them (none where a rate was given)."""

    request: Request
    points: tuple[Point, ...]
    shared: tuple[SharedRate, ...]

    def total_s(self, plans: Sequence[RatePlan]) -> float:
        """Time of the points whose plans these are, each after its settling time."""
        return sum(plan.duration_s + self.request.settle_s for plan in plans)


def make_plan(request: Request) -> Plan:
    """Look for the rates of every point, or see what the given rate makes of it.

    >>> from fusion import Request, make_plan
    >>> from shaker import Sampling
    >>> plan = make_plan(Request((106.25,), Sampling(frames=211), limits_hz=(70.0, 80.0), rate_step_hz=0.1))
    >>> 70.0 <= plan.points[0].choices[0].rate_hz <= 80.0
    True
    """
    sampling = request.sampling
    groups = [request.frequency_hz] if request.together else [(f,) for f in request.frequency_hz]
    points = [lines_of(group, sampling.harmonics) for group in groups]
    _check(request, points)
    try:
        rates = candidate_rates(points, sampling, request.limits_hz, request.rate_step_hz)
    except ValueError as error:
        expected = f"a step with a multiple between {request.limits_hz[0]:g} and {request.limits_hz[1]:g} Hz"
        raise InputError("--rate-step", "", found=f"{request.rate_step_hz:g} Hz", expected=expected) from error
    if request.rate_hz is not None:
        return Plan(request, tuple(_explained(lines, request.rate_hz, rates, sampling) for lines in points), ())
    scans = [scan_rates(lines, rates, sampling) for lines in points]
    chosen = tuple(
        Point(lines, tuple(plan_at(lines, rate, sampling) for rate in best_rates(scan)))
        for lines, scan in zip(points, scans, strict=True)
    )
    shared = [
        SharedRate(rate, served, tuple(plan_at(points[i], rate, sampling) for i in served))
        for rate, served in fewest_rates(scans)
    ]
    return Plan(request, chosen, tuple(shared))


def plan_csv(plan: Plan) -> str:
    """Return the plan as a table: a row per point, choice and line; SI units, one header line."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for number, point in enumerate(plan.points, start=1):
        for choice, at_rate in enumerate(point.choices, start=1):
            given = plan.request.rate_hz is not None
            writer.writerows(_rows(plan.request.size, number, "given" if given else str(choice), at_rate))
    for shared in plan.shared:
        for index, at_rate in zip(shared.points, shared.plans, strict=True):
            writer.writerows(_rows(plan.request.size, index + 1, "shared", at_rate))
    return stream.getvalue()


def _explained(lines: Lines, rate_hz: float, rates: FloatArray, sampling: Sampling) -> Point:
    """Return what the given rate makes of a point, with the nearest good rate unless it is good itself."""
    scan = scan_rates(lines, np.sort(np.append(rates, rate_hz)), sampling)
    good = scan.rate_hz[scan.good]
    nearby = None
    if len(good):
        nearest = float(good[np.argmin(np.abs(good - rate_hz))])
        nearby = None if nearest == rate_hz else plan_at(lines, nearest, sampling)
    return Point(lines, (plan_at(lines, rate_hz, sampling),), nearby)


def _rows(size: Size, number: int, choice: str, plan: RatePlan) -> list[list[str]]:
    """Return the rows of one point at one rate."""
    unit, scale = (PER_NOISE, 1.0) if size.noise_m is None else ("m", size.noise_m)
    rows = []
    for k, frequency in enumerate(plan.lines.frequency_hz):
        u = float(plan.u_amplitude[k])
        relative = size.relative(float(frequency), u) if plan.lines.multiple[k] == 1 else None
        numbers = [plan.rate_hz, plan.duration_s, plan.condition, frequency, plan.lines.fundamental_hz[k]]
        seen = [
            plan.alias_hz[k],
            plan.alias_hz[k] / plan.rate_hz,
            plan.distance_hz[k] / plan.resolution_hz,
            plan.gain[k],
        ]
        rows.append(
            [str(number), choice]
            + [f"{value:.9g}" for value in numbers]
            + [str(plan.lines.multiple[k])]
            + [f"{value:.6g}" for value in seen]
            + [f"{u * scale:.4g}", unit, "" if relative is None else f"{relative:.4g}"]
        )
    return rows


def _check(request: Request, points: Sequence[Lines]) -> None:
    """Refuse what no rate can serve, naming the option."""
    highest = max(request.limits_hz) if request.rate_hz is None else request.rate_hz
    if request.rate_hz is None and not 0.0 < request.limits_hz[0] <= request.limits_hz[1]:
        low, high = request.limits_hz
        raise InputError("--min-rate", "", found=f"{low:g} Hz", expected=f"no more than --max-rate ({high:g} Hz)")
    needed = 2 * max(len(lines.frequency_hz) for lines in points) + 2
    frames = request.sampling.frames
    if frames < needed:
        raise InputError("--frames", "", found=str(frames), expected=f"at least {needed} for as many lines")
    exposure = request.sampling.exposure_s
    if exposure * highest > 1.0:
        expected = f"no more than the time between frames ({1.0 / highest:.3g} s)"
        raise InputError("--exposure", "", found=f"{exposure:g} s", expected=expected)
    sized = request.size.amplitude_m is not None or request.size.acceleration_mps2 is not None
    if sized and request.size.noise_m is None:
        option = "--amplitude" if request.size.amplitude_m is not None else "--acceleration"
        raise InputError(option, "", found="none", expected="--noise beside it")
