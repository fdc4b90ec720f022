"""The report's tables of a Monte Carlo run: 95 % intervals of the draws beside those of first-order propagation."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from fusion.evaluation import Evaluation
from fusion.polar import DASH, rounded, typeset
from fusion.propagated import Propagated, RealSpread
from fusion.report_numbers import times_ten
from fusion.report_tables import Table


def monte_carlo_tables(evaluation: Evaluation) -> list[Table]:
    """Return one table per result: sensitivity first, then load and acceleration of each body; none without a run."""
    run = evaluation.monte_carlo
    return [] if run is None else [_table(result, run.draws) for result in reversed(run.results)]


def _table(result: Propagated, draws: int) -> Table:
    """Magnitude, phase and region of every quantity at every driven line."""
    rows = []
    for line, frequency in enumerate(result.frequency_hz):
        for element, name in enumerate(result.elements):
            if np.isfinite(result.value[line, element]):
                rows.append((f"{frequency:.4f}", name, *_row(result, draws, line, element)))
    head = ("frequency / Hz", "quantity", *_columns("magnitude"), *_columns("phase / rad"), "in the region", "")
    title = result.name[0].upper() + result.name[1:]
    strong = [np.where(result.weak, 0.0, what.u_end / what.first_u) for what in (result.magnitude, result.phase)]
    good = float(np.nanmax(strong, initial=0.0))
    caption = f"{title}: shortest 95 % intervals of {draws} draws, whose number determines their ends to {good:.2g} u"
    return Table(caption, head, "ll" + "r" * 7 + "l", tuple(rows))


def _columns(what: str) -> tuple[str, str, str]:
    """Heads of the columns of a real quantity."""
    return f"{what}, Monte Carlo", "first order", "apart / u"


def _row(result: Propagated, draws: int, line: int, element: int) -> tuple[str, ...]:
    """Cells of one quantity: both intervals of magnitude and phase, how far they are apart, the region, the verdict."""
    unit, cells = result.unit[element], []
    for what, own in ((result.magnitude, unit), (result.phase, "")):
        cells += _real_cells(what, line, element, own)
    return (*cells, f"{100.0 * result.first_holds[line, element]:.1f} %", _verdict(result, draws, line, element))


def _verdict(result: Propagated, draws: int, line: int, element: int) -> str:
    """Whether first-order propagation holds."""
    small = result.too_small(draws, line, element)
    if small:
        return f"first-order U too small: {', '.join(small)}"
    large = result.refuted(draws, line, element)
    return f"first-order U larger than need be: {', '.join(large)}" if large else _digits(result, line, element)


def _digits(result: Propagated, line: int, element: int) -> str:
    """In how many digits both ways agree, or that only the region is judged."""
    if result.weak[line, element]:
        return "region confirmed; magnitude and phase say little"
    digits = int(min(result.magnitude.digits[line, element], result.phase.digits[line, element]))
    return f"agrees in {digits} digit{'s' * (digits != 1)} of u" if digits else "within what the number of draws tells"


def _real_cells(spread: RealSpread, line: int, element: int, unit: str) -> list[str]:
    """Interval of the draws, that of first-order propagation, and the larger distance of their ends over u."""
    ends = [float(end[line, element]) for end in (spread.low, spread.high, spread.first_low, spread.first_high)]
    u = float(spread.first_u[line, element])
    apart = float(max(spread.d_low[line, element], spread.d_high[line, element]))
    told = f"{apart / u:.2f}" if u > 0.0 and np.isfinite(apart) else DASH
    return [_interval(ends[0], ends[1], u, unit), _interval(ends[2], ends[3], u, unit), told]


def _interval(low: float, high: float, u: float, unit: str) -> str:
    """Two ends with the digits that u deserves, and the unit with its power of ten."""
    exponent = rounded(max(abs(low), abs(high)), u).exponent
    texts = [rounded(end, u, exponent).value for end in (low, high)]
    if exponent:
        return Markup("({} … {}) × {}").format(*texts, times_ten(exponent, unit))
    return Markup("{} … {} {}").format(*texts, typeset(unit))
