"""Many lines in one recording: places of the lines and of their products, and the waveform."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from style import BLUE, GREY, ORANGE, new_figure

from shaker.lines.multisine import crest_factor, place_lines, small_crest_phases, waveform

RATE_HZ, FRAMES, LINES, BAND_HZ = 52.874, 640, 40, (50.0, 1000.0)
SHOWN_HZ = (8.0, 14.0)  # of the aliases
RANDOM_PHASES = 1  # seed


def many_lines() -> Figure:
    """Draw aliases of lines with those of their sums and differences, and one period of the waveform."""
    figure, axes = new_figure(2.9, 1, 2)
    grid = place_lines(np.geomspace(*BAND_HZ, LINES), RATE_HZ, FRAMES)
    signed = np.concatenate([grid.numbers, -grid.numbers])
    sums = np.unique(np.abs(np.add.outer(signed, signed)))
    rest = sums % grid.period_frames
    products = np.unique(np.minimum(rest, grid.period_frames - rest)) * grid.spacing_hz
    lines = grid.alias_numbers * grid.spacing_hz
    left, right = axes
    for places, colour, height, label in (
        (products, GREY, 0.35, "sums and differences of two lines"),
        (lines, BLUE, 1.0, "lines"),
    ):
        near = places[(places > SHOWN_HZ[0]) & (places < SHOWN_HZ[1])]
        left.vlines(near, 0.0, height, color=colour, label=label)
    left.set_title("Lines at the camera: on odd places")
    left.set_xlabel("alias / Hz")
    left.set_yticks([])
    left.set_ylim(0.0, 1.45)
    left.legend(loc="upper left")
    equal = np.ones(LINES)
    rms = np.sqrt(LINES / 2.0)
    random = np.random.default_rng(RANDOM_PHASES).uniform(0.0, 2.0 * np.pi, LINES)
    small = small_crest_phases(grid.numbers, equal)
    for phase, colour, name in ((random, ORANGE, "random phases"), (small, BLUE, "phases of plan")):
        values = waveform(grid.numbers, equal, phase) / rms
        parts = values[: len(values) // 256 * 256].reshape(256, -1)
        time_s = (np.arange(256) + 0.5) / 256 / grid.spacing_hz
        label = f"{name}: peak {crest_factor(grid.numbers, equal, phase):.2f} rms"
        right.fill_between(time_s, parts.min(axis=1), parts.max(axis=1), color=colour, alpha=0.65, label=label, lw=0)
    right.set_title("One period of the multisine")
    right.set_xlabel("time / s")
    right.set_ylabel("acceleration / rms")
    right.set_ylim(-4.5, 6.8)
    right.legend(loc="upper left")
    return figure


DRAWINGS = (many_lines,)
