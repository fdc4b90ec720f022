"""What `shakercal plan` prints: the rates of every frequency, the fewest that serve all, or what one rate does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import DASH, prefix, stdout_console
from fusion.planning.plan import Plan, Point, Size
from shaker.arrays import FloatArray
from shaker.lines.rate_planner import PREFERRED, RatePlan
from shaker.sine.aliasing import CLEAR_BINS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


_SHOWN = 3  # frequencies and aliased harmonics that are written out; of more there is a count


def print_plan(plan: Plan) -> None:
    """Print the plan to stdout."""
    console = stdout_console()
    _say(console, _setting(plan))
    if plan.request.rate_hz is not None:
        for point in plan.points:
            _print_explained(console, plan.request.size, point)
    else:
        _print_choices(console, plan)
    size = plan.request.size
    unit = " in units of the noise of one frame" if size.noise_m is None else ""
    _say(
        console,
        f"u: standard uncertainty (k = 1) of an amplitude{unit}, of the fundamental and of the worst line; "
        "over the amplitude it is that of the phase in rad",
    )
    if not _sized(size):
        _say(console, "(--noise with --amplitude or --acceleration gives numbers)")
    apart = "apart: smallest distance of two lines as the camera sees them, in bins of rate/frames"
    _say(console, f"{apart} ({CLEAR_BINS:g} needed); loss: of amplitude, by exposure (a run corrects it)")


def _say(console: Console, text: str) -> None:
    """Print a sentence on one line."""
    console.print(text, soft_wrap=True)


def _setting(plan: Plan) -> str:
    """Return what the plan is for, in one sentence."""
    request, sampling = plan.request, plan.request.sampling
    frequencies = ", ".join(f"{f:.9g}" for f in request.frequency_hz)
    if len(request.frequency_hz) > _SHOWN:
        ends = f"{min(request.frequency_hz):.9g} to {max(request.frequency_hz):.9g}"
        frequencies = f"{len(request.frequency_hz)} frequencies, {ends}"
    together = " at the same time" if request.together else ""
    fitted = "fundamentals alone" if sampling.harmonics == 1 else f"harmonics 1 to {sampling.harmonics}"
    rates = "" if request.rate_hz else f", camera rate {request.limits_hz[0]:g} to {request.limits_hz[1]:g} Hz"
    return (
        f"Excitation {frequencies} Hz{together}, {fitted}; {sampling.frames} frames, exposure "
        f"{sampling.exposure_s * 1e6:g} µs{rates}; 1/f noise exceeds white noise below {sampling.corner_hz:g} Hz"
    )


def _print_choices(console: Console, plan: Plan) -> None:
    """Print the rates of every point, and the fewest that serve all."""
    size = plan.request.size
    table = _rates_table(size, "Camera rates, best first")
    for point in plan.points:
        for number, choice in enumerate(point.choices, start=1):
            name = _excitation(point) if number == 1 else ""
            table.add_row(name, *_rate_cells(size, choice), end_section=number == len(point.choices))
    if table.row_count:
        console.print(table)
    fewer = "fewer harmonics, or know the frequencies better (--tolerance)"
    for point in plan.points:
        if not point.choices:
            _say(console, f"{_excitation(point)} Hz: no such rate keeps all lines apart; take more frames or {fewer}")
    first = [point.choices[0] for point in plan.points if point.choices]
    if len(plan.points) > 1 and first:
        _say(console, f"{_of_all(first, plan)}, each at its first rate: {_total(plan, first)}")
        _print_shared(console, plan)
    elif first:
        _say(console, f"Time: {_total(plan, first)}")
        console.print(_lines_table(size, first[0]))


def _print_shared(console: Console, plan: Plan) -> None:
    """Print the fewest rates that serve all points."""
    served = [at_rate for shared in plan.shared for at_rate in shared.plans]
    table = _rates_table(plan.request.size, "With as few rates as possible")
    for shared in plan.shared:
        for index, at_rate in zip(shared.points, shared.plans, strict=True):
            last = index == shared.points[-1]
            table.add_row(_excitation(plan.points[index]), *_rate_cells(plan.request.size, at_rate), end_section=last)
    console.print(table)
    rates = ", ".join(f"{shared.rate_hz:.3f}" for shared in plan.shared)
    number = "one rate" if len(plan.shared) == 1 else f"{len(plan.shared)} rates"
    _say(console, f"{_of_all(served, plan)}, with {number} ({rates} Hz): {_total(plan, served)}")


def _of_all(served: Sequence[RatePlan], plan: Plan) -> str:
    """Return how many of the points are meant."""
    return f"All {len(served)}" if len(served) == len(plan.points) else f"{len(served)} of {len(plan.points)}"


def _total(plan: Plan, plans: Sequence[RatePlan]) -> str:
    """Return the time of points."""
    settle = plan.request.settle_s
    return f"{plan.total_s(plans):.1f} s" + (f", {settle:g} s before each included" if settle else "")


def _rates_table(size: Size, title: str) -> Table:
    """Return an empty table of rates."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    relative = ("u / %", "phase / mrad") if _sized(size) else ()
    unit = _noise(size)[1]
    seen = ("excited / Hz", "rate / Hz", "seen at / Hz", "of rate", "apart", "cond.")
    for name in (*seen, f"u{unit}", f"worst u{unit}", *relative, "loss / %", "time / s"):
        table.add_column(name, justify="right")
    return table


def _rate_cells(size: Size, plan: RatePlan) -> list[str]:
    """Return what a table of rates says about one point at one rate, after the excitation."""
    fundamental = plan.lines.multiple == 1
    k = int(np.argmax(np.where(fundamental, plan.u_amplitude, 0.0)))
    noise, _ = _noise(size)
    return [
        f"{plan.rate_hz:.3f}",
        _range(plan.alias_hz[fundamental], 3),
        _range(plan.alias_hz[fundamental] / plan.rate_hz, 3),
        f"{plan.distance_bins:.2f}",
        f"{plan.condition:.2f}",
        _figures(noise * plan.u_amplitude[k]),
        _figures(noise * float(np.max(plan.u_amplitude))),
        *_relative_cells(size, plan, k),
        f"{100.0 * (1.0 - plan.gain[k]):.3f}",
        f"{plan.duration_s:.2f}",
    ]


def _relative_cells(size: Size, plan: RatePlan, k: int) -> list[str]:
    """Return the relative uncertainty of amplitude and phase of a fundamental, where its size is known."""
    if not _sized(size):
        return []
    relative = size.relative(float(plan.lines.frequency_hz[k]), float(plan.u_amplitude[k]))
    if plan.lines.multiple[k] != 1 or relative is None:
        return ["", ""]
    return [_figures(100.0 * relative), _figures(1e3 * relative)]


def _print_explained(console: Console, size: Size, point: Point) -> None:
    """Print what the given rate does to one point, line by line."""
    (plan,) = point.choices
    for frequency, alias in zip(plan.lines.frequency_hz, plan.alias_hz, strict=True):
        if frequency in plan.lines.fundamentals_hz:  # so many turns between two frames and a bit: so slow a beat
            turns = round(frequency / plan.rate_hz)
            sign = "+" if frequency >= turns * plan.rate_hz else "-"
            seen = "as it is" if turns == 0 else f"as a beat of {alias:.3f} Hz"
            _say(
                console,
                f"{frequency:.9g} Hz = {turns} × {plan.rate_hz:.9g} Hz {sign} {alias:.3f} Hz: seen {seen}, "
                f"{alias * plan.duration_s:.2f} periods in {plan.duration_s:.2f} s",
            )
    console.print(_lines_table(size, plan))
    for remark in _remarks(plan):
        _say(console, remark)
    if point.nearby is not None:
        rate = point.nearby.rate_hz
        share = float(np.max(point.nearby.u_amplitude)) / float(np.max(plan.u_amplitude))
        gain = f", worst u {share:.2g} times the present one" if share > 0.0 else ""
        _say(console, f"Nearest good rate: {rate:.3f} Hz ({rate - plan.rate_hz:+.3f} Hz){gain}")


def _remarks(plan: RatePlan) -> list[str]:
    """Return what is unfavourable about a rate."""
    found = []
    for frequency, alias in zip(plan.lines.fundamentals_hz, plan.alias_hz, strict=False):
        share = float(alias) / plan.rate_hz
        if share < PREFERRED[0]:
            found.append(
                f"{frequency:.9g} Hz is seen below {PREFERRED[0]:g} of the rate: drift, slow motion of the rig and "
                f"other 1/f noise around {alias:.3f} Hz disturb it"
            )
        elif share > PREFERRED[1]:
            found.append(
                f"{frequency:.9g} Hz is seen above {PREFERRED[1]:g} of the rate: near the Nyquist frequency a small "
                "change of rate brings its mirror image onto it"
            )
    if plan.distance_bins < CLEAR_BINS:
        found.append(
            f"lines are only {plan.distance_bins:.2f} bins apart: {CLEAR_BINS:g} are needed to tell them apart"
        )
    for other in plan.folds[:_SHOWN]:
        name = f"harmonic {other.multiple} of {other.fundamental_hz:.9g} Hz, not fitted"
        found.append(f"{name}, is aliased to {other.alias_hz:.3f} Hz, within a bin of a line that is fitted")
    if len(plan.folds) > _SHOWN:
        found.append(f"so do {len(plan.folds) - _SHOWN} more")
    return found


def _lines_table(size: Size, plan: RatePlan) -> Table:
    """Return all lines of a point at one rate."""
    from rich.table import Table

    table = Table(title=f"Lines at {plan.rate_hz:.9g} Hz", title_justify="left")
    noise, unit = _noise(size)
    relative = ("u / %", "phase / mrad") if _sized(size) else ()
    seen = ("line / Hz", "harmonic", "seen at / Hz", "of rate", "apart", "nearest", "loss / %")
    for name in (*seen, f"u{unit}", *relative):
        table.add_column(name, justify="right")
    for k, frequency in enumerate(plan.lines.frequency_hz):
        neighbour = float(plan.neighbour_hz[k])
        nearest = "zero" if neighbour == 0.0 else f"{neighbour:.9g} Hz" if np.isfinite(neighbour) else "Nyquist"
        table.add_row(
            f"{frequency:.9g}",
            str(plan.lines.multiple[k]),
            f"{plan.alias_hz[k]:.3f}",
            f"{plan.alias_hz[k] / plan.rate_hz:.3f}",
            f"{plan.distance_hz[k] / plan.resolution_hz:.2f}",
            nearest,
            f"{100.0 * (1.0 - plan.gain[k]):.3f}",
            _figures(noise * plan.u_amplitude[k]),
            *_relative_cells(size, plan, k),
        )
    return table


def _excitation(point: Point) -> str:
    """Return the frequencies of a point."""
    return _range(point.lines.fundamentals_hz, 3)


def _range(values: FloatArray, decimals: int) -> str:
    """Return one value, or the ends of several."""
    ends = sorted({f"{value:.{decimals}f}" for value in (float(np.min(values)), float(np.max(values)))}, key=float)
    return DASH.join(ends)


def _figures(value: float) -> str:
    """Return a number with three significant digits."""
    return f"{value:#.3g}".rstrip(".")


def _noise(size: Size) -> tuple[float, str]:
    """Return the noise of one frame in a readable unit, and what stands behind u in a table's head."""
    if size.noise_m is None:
        return 1.0, ""
    factor, letter = prefix(np.array([0.1 * size.noise_m]))
    return size.noise_m / factor, f" / {letter}m"


def _sized(size: Size) -> bool:
    """Tell whether relative uncertainties can be given."""
    return size.noise_m is not None and (size.amplitude_m is not None or size.acceleration_mps2 is not None)
