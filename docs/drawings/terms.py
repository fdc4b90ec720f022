"""Drawings of the vocabulary and of the way from files to a recording."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from style import BLUE, DARK, GREEN, GREY, ORANGE, RED, VIOLET, blank, new_figure

NAMES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def glossary_matrix() -> Figure:
    """Draw outputs = matrix × loads, with an element, cross-talk, the driven load and parasitic loads marked."""
    figure, axes = new_figure(3.2)
    blank(axes, (-3.4, 16.8), (-1.5, 7.4))
    _vector(axes, -1.6, "outputs", {2: BLUE})
    axes.text(-0.15, 3.0, "=", fontsize=14, ha="center", va="center")
    for row in range(6):
        for column in range(6):
            colour = BLUE if (row, column) == (2, 2) else ORANGE if column == 2 else "#e5e7eb"
            axes.add_patch(Rectangle((0.5 + column, 5.05 - row), 0.9, 0.9, color=colour, lw=0))
    axes.text(3.45, 6.5, "matrix of sensitivities", ha="center", fontsize=8.5, color=DARK)
    axes.text(7.05, 3.0, "·", fontsize=16, ha="center", va="center")
    _vector(axes, 7.6, "loads", {2: GREEN}, RED)
    for x, y, text, colour in (
        (10.0, 5.3, "parasitic loads: not intended", RED),
        (10.0, 3.5, "driven load Fz", GREEN),
        (10.0, 2.2, "element Fz per Fz: output Fz to load Fz alone", BLUE),
        (10.0, 1.2, "cross-talk: other outputs to load Fz", ORANGE),
        (10.0, 0.2, "ratio: whole output Fz / driven load Fz,\nincludes the effect of parasitic loads", DARK),
    ):
        axes.text(x, y, text, color=colour, fontsize=8.5, va="center")
    axes.plot([8.6, 9.8], [3.5, 3.5], color=GREEN, lw=0.8)
    axes.plot([8.6, 9.8], [5.3, 5.3], color=RED, lw=0.8)
    axes.text(-1.15, -0.7, "V/V", ha="center", fontsize=8.5, color=GREY)
    axes.text(3.45, -0.7, "(V/V)/N and (V/V)/(N·m)", ha="center", fontsize=8.5, color=GREY)
    axes.text(8.05, -0.7, "N, N·m", ha="center", fontsize=8.5, color=GREY)
    return figure


def drafting_flow() -> Figure:
    """Draw the way from files to a recording that runs, and the four kinds of values in a draft."""
    figure, axes = new_figure(2.5)
    blank(axes, (0.0, 16.0), (0.0, 5.6), "auto")
    steps = (
        (0.1, "files", "recorder, images,\ncalibration", GREY),
        (4.2, "shakercal init", "draft of recording.toml\nand rig.toml", BLUE),
        (8.3, "questions, editor", "open values\nfilled in", ORANGE),
        (12.4, "shakercal check", "lists what is left,\nthen shakercal run", GREEN),
    )
    for left, title, text, colour in steps:
        axes.add_patch(
            FancyBboxPatch((left + 0.1, 3.2), 3.2, 2.1, boxstyle="round,pad=0.06", fc=colour, alpha=0.16, lw=0)
        )
        axes.text(left + 1.7, 4.75, title, ha="center", va="center", fontsize=9, weight="bold", color=colour)
        axes.text(left + 1.7, 3.85, text, ha="center", va="center", fontsize=8, color=DARK)
        if left > 1.0:
            axes.annotate(
                "", (left, 4.25), (left - 0.65, 4.25), arrowprops={"arrowstyle": "-|>", "color": GREY, "lw": 1.4}
            )
    kinds = (
        (0.4, 'trigger = "camera_trigger"  # it has 24 edges', "shown by the files", GREEN),
        (0.4, 'quantity = "velocity"  # guessed: its unit', "guessed: check it", VIOLET),
        (8.5, 'mass = "?"  # the true mass in kg', "open: fill it in", RED),
        (8.5, "# delay_uncertainty = 1e-6  # s", "optional", GREY),
    )
    for at, (left, line, meaning, colour) in enumerate(kinds):
        y = 2.0 - 1.2 * (at % 2)
        axes.text(left, y, line, family="DejaVu Sans Mono", fontsize=7, color=colour, va="center")
        axes.text(left, y - 0.5, meaning, fontsize=8, color=colour, va="center")
    return figure


def _vector(axes: Axes, left: float, title: str, colours: dict[int, str], other: str = "#9ca3af") -> None:
    """Draw a column of six named cells."""
    axes.text(left + 0.45, 6.5, title, ha="center", fontsize=8.5, color=DARK)
    for row, name in enumerate(NAMES):
        colour = colours.get(row, other)
        axes.add_patch(Rectangle((left, 5.05 - row), 0.9, 0.9, fc=colour, alpha=0.85 if row in colours else 0.3, lw=0))
        axes.text(
            left + 0.45,
            5.5 - row,
            name,
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if row in colours else DARK,
        )


DRAWINGS = (glossary_matrix, drafting_flow)
