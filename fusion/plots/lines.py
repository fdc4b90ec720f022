"""Figure of the lines of a record: its spectrum, the noise floor, and what each line is."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from fusion.lines import Entry, LineList
from fusion.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    as_file,
    decades,
    drawing,
    lay_out,
    new_figure,
    panel_label,
    thin_out,
)
from shaker.signals.survey.floor import FIRST_BIN

POINTS = 1600
DETAILS = re.compile(r" of |[,(]|(?<=combination) ")
"""Where the details of what a line is begin."""
LABELLED = 12  # lines of a panel that are named, the highest


def draw_lines(lists: Sequence[LineList], kind: str) -> bytes:
    """Draw spectrum, noise floor and lines of every channel, as a file (png, svg, pdf)."""
    panels = [(item, c) for item in lists for c in range(len(item.channels))]
    with drawing("lines"):
        figure = new_figure(0.7 + 2.3 * len(panels))
        every = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
        for axes, (item, c) in zip(every, panels, strict=True):
            _draw_channel(axes, item, c)
        every[-1].set_xlabel("frequency / Hz")
        lay_out(figure, every, top=0.25, gap=(0.5, 0.42))
        return as_file(figure, kind)


def _draw_channel(axes: Axes, item: LineList, c: int) -> None:
    """One channel's spectrum with its lines."""
    frequency, amplitude = item.spectrum_hz[FIRST_BIN:], item.spectrum[FIRST_BIN:, c]
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, POINTS)
    axes.loglog(*thin_out(frequency, amplitude, edges), color=BLUE, linewidth=0.6)
    if len(item.floor_hz):
        above = item.floor_hz >= frequency[0]
        axes.plot(item.floor_hz[above], item.floor[above, c], color=BLACK, linewidth=0.9)
    shown = [entry for entry in item.entries if np.isfinite(entry.amplitude[c])]
    for entry in shown:
        place = _place(entry, item.rate_hz)
        axes.plot(place, entry.amplitude[c], marker="v", color=_colour(entry), markersize=4.0, linestyle="")
    for entry in sorted(shown, key=lambda entry: -float(entry.amplitude[c]))[:LABELLED]:
        axes.annotate(
            _short(entry),
            (_place(entry, item.rate_hz), float(entry.amplitude[c])),
            xytext=(0, 5),
            textcoords="offset points",
            fontsize=5.5,
            rotation=90,
            ha="center",
            color=_colour(entry),
        )
    floor = item.floor[:, c] if len(item.floor_hz) else amplitude[amplitude > 0.0]
    axes.set_ylim(0.2 * float(np.min(floor)), 1e4 * float(amplitude.max()))
    decades(axes.yaxis)
    unit = f" / {item.units[c]}" if item.units[c] else ""
    axes.set_ylabel(f"amplitude{unit}")
    panel_label(axes, f"{item.channels[c]}: spectrum, noise floor (black) and lines")


def _place(entry: Entry, rate_hz: float) -> float:
    """Return where the spectrum shows a line."""
    return float(abs(entry.frequency_hz - rate_hz * round(entry.frequency_hz / rate_hz)))


def _colour(entry: Entry) -> str:
    """Tell lines that are fitted or fundamental, explained and unexplained apart."""
    if entry.use == "fitted" or (not entry.use and entry.what.startswith("fundamental")):
        return RED
    return ORANGE if entry.what.startswith("unexplained") else GREY


def _short(entry: Entry) -> str:
    """Return a line's frequency and what it is, without the details."""
    return f"{entry.frequency_hz:.5g} {DETAILS.split(entry.what)[0].strip()}"
