"""What `shakercal lines` prints: every line with its size, its height over the noise, what it is and why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.console import stdout_console
from fusion.lines import Entry, LineList
from fusion.polar import rounded

COVERAGE = 2.0
WHY_WIDTH = 18
LISTED = "lines"
"""Where notices are about that only say what the table shows."""


def print_lines(lists: Sequence[LineList]) -> None:
    """Print the lines to stdout, a table for each group of channels."""
    from rich import box
    from rich.table import Table

    console = stdout_console()
    for item in lists:
        console.print(_heading(item), soft_wrap=True)
        if not item.entries:
            console.print("  no line stands out of the noise")
            continue
        table = Table(box=box.SIMPLE, pad_edge=False)
        table.add_column("frequency / Hz", justify="right", no_wrap=True)
        for name, _ in item.cameras:
            table.add_column(f"{name} / Hz", justify="right")
        table.add_column("amplitude", justify="right", no_wrap=True)
        if len(item.channels) > 1:
            table.add_column("in channel", overflow="fold")
        table.add_column("dB", justify="right")
        table.add_column("what and why", min_width=WHY_WIDTH)
        for entry in item.entries:
            table.add_row(*_cells(item, entry))
        console.print(table)
    for notice in dict.fromkeys(notice for item in lists for notice in item.notices if notice.where != LISTED):
        console.print(f"{notice.severity}: {notice.text}", soft_wrap=True)
    console.print(
        "U (k = 2); amplitude: in the channel in which the line stands out most; dB: its power there over that of the "
        "noise in a bin of the Hann spectrum",
        soft_wrap=True,
    )


def _heading(item: LineList) -> str:
    """Say what the table is of."""
    duration = item.samples / item.rate_hz
    names = ", ".join(item.channels)
    seen = "".join(f"; {pairs}: lines as seen at {rate:.6g} Hz" for pairs, rate in item.cameras)
    return f"{item.source.name}: {names}; {item.samples} samples at {item.rate_hz:.9g} Hz, {duration:.4g} s{seen}"


def _cells(item: LineList, entry: Entry) -> list[str]:
    """Return the cells of one line."""
    cells = [_with_u(entry.frequency_hz, entry.u_frequency_hz, 0)]
    cells += [f"{place:.4f}" for place in entry.places]
    best = int(np.nanargmax(entry.amplitude / np.maximum(entry.u_amplitude, np.finfo(np.float64).tiny)))
    size = _with_u(float(entry.amplitude[best]), float(entry.u_amplitude[best]))
    cells.append(f"{size} {item.units[best]}".strip())
    if len(item.channels) > 1:
        cells.append(item.channels[best])
    return [*cells, f"{entry.floor_db:.0f}", f"{entry.use}: {entry.what}" if entry.use else entry.what]


def _with_u(value: float, u: float, exponent: int | None = None) -> str:
    """Return a number with its expanded uncertainty."""
    text, uncertainty, power = rounded(value, COVERAGE * u, exponent)
    both = f"{text} ± {uncertainty}"
    return f"({both})e{power}" if power else both
