"""The cross-beam element: dimensions, mode shapes' directions, and the ambiguity of a fitted platform."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from mechanics import BLACK
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, blank, new_figure

from shaker.elastomer.frame import MODE_NAMES, block, platform_family, sensitivities
from shaker.elastomer.geometry import CrossBeams, ElasticMaterial

CROSS = CrossBeams(ElasticMaterial(72e9, 0.3, 2820.0), 0.064, 0.0038, 0.0038, 0.001, 0.032, 0.0038)
"""The example of the document: J. Sensors 2018, 6216979, Table 1."""
STATED_HZ = {"Tx": 1660.0, "Tz": 2025.0, "Rx": 3577.0, "Rz": 5094.0}
"""Natural frequencies of the publication by finite elements."""


def _size(
    axes: Any, start: tuple[float, float], end: tuple[float, float], text: str, shift: tuple[float, float]
) -> None:
    """Draw a dimension line with its key."""
    axes.annotate("", start, end, arrowprops={"arrowstyle": "<->", "color": RED, "linewidth": 0.9})
    middle = (start[0] + end[0]) / 2 + shift[0], (start[1] + end[1]) / 2 + shift[1]
    axes.text(*middle, text, color=RED, fontsize=7.5, ha="center", va="center")


def cross_beam() -> Figure:
    """Plan of the element with the keys of its dimensions."""
    figure, axes = new_figure(4.4)
    span, width, half, thick, length = 64.0, 3.8, 14.0, 1.0, 32.0
    steel = {"facecolor": "#dbe4ee", "edgecolor": BLACK, "linewidth": 1.0}
    arm = span / 2
    rim = {"facecolor": "#9ca3af", "edgecolor": BLACK, "hatch": "///", "linewidth": 0.8}
    for horizontal in (True, False):
        for side in (-1.0, 1.0):
            boxes = (
                (side * (half + arm) / 2, 0.0, arm - half, width),
                (side * arm, 0.0, thick, length),
            )
            ends = [(side * arm, end * (length / 2 + 2.5), 7.0, 5.0) for end in (-1.0, 1.0)]
            for kind, group in ((steel, boxes), (rim, ends)):
                for box in group:
                    x, y, w, h = box if horizontal else (box[1], box[0], box[3], box[2])
                    axes.add_patch(Rectangle((x - w / 2, y - h / 2), w, h, **kind))
    axes.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#fde8d0", edgecolor=BLACK))
    axes.text(0, 0, "platform", ha="center", va="center")
    axes.text(23, 4.0, "beam", fontsize=8, ha="center")
    axes.annotate("compliant beam", (32.5, 9), (46, 14), fontsize=8, arrowprops={"arrowstyle": "-", "linewidth": 0.6})
    axes.annotate("rim, clamped", (35.5, 19), (46, 21), fontsize=8, arrowprops={"arrowstyle": "-", "linewidth": 0.6})
    _size(axes, (-arm, -39.0), (arm, -39.0), "[beams] span", (0.0, -2.4))
    for x in (-arm, arm):
        axes.plot([x, x], [-40.5, -21.5], color=RED, linewidth=0.5)
    _size(axes, (0.0, -9.0), (half, -9.0), "half_size", (0.0, 2.2))
    _size(axes, (-22.0, -width / 2), (-22.0, width / 2), "width", (-4.6, 3.6))
    _size(axes, (-39.0, -length / 2), (-39.0, length / 2), "[compliant_beams]\nlength", (-10.5, 0.0))
    axes.annotate(
        "thickness (along the beam)",
        (arm, -9),
        (46, -8),
        fontsize=7.5,
        color=RED,
        arrowprops={"arrowstyle": "-", "color": RED, "linewidth": 0.6},
    )
    for (dx, dy), text in (((9, 0), "x"), ((0, 9), "y")):
        axes.annotate("", (52 + dx, -28 + dy), (52, -28), arrowprops={"arrowstyle": "->", "color": GREEN})
        axes.text(52 + 1.2 * dx, -28 + 1.2 * dy, text, color=GREEN, ha="center", va="center")
    axes.text(50.5, -33.5, "z: towards you", color=GREEN, fontsize=8, va="center", ha="left")
    blank(axes, (-60, 75), (-42, 42))
    return figure


def element_tolerances() -> Figure:
    """Change of the natural frequencies for one per cent of each dimension."""
    figure, axes = new_figure(2.9)
    found = sensitivities(CROSS, 0.0179, block(2820.0, 0.0179, 0.0059))
    rows = ("Tx", "Tz", "Rx", "Rz")
    names = [name for name in found if name != "height_m"]
    place, width = np.arange(len(names)), 0.2
    for index, (row, color) in enumerate(zip(rows, (BLUE, ORANGE, GREEN, VIOLET), strict=True)):
        axes.bar(
            place + (index - 1.5) * width,
            [found[name][MODE_NAMES.index(row)] for name in names],
            width,
            color=color,
            label=row,
        )
    axes.axhline(0, color=GREY, linewidth=0.6)
    axes.set_xticks(place, [name.rpartition("_")[0].replace("_", "\n") for name in names], fontsize=7.5)
    axes.set(ylabel="change of f / % per %", title="Effect of 1 % of a dimension on the frequencies")
    axes.legend(ncols=4, fontsize=8)
    return figure


def platform_ambiguity() -> Figure:
    """Platforms of any half-size that have the four published frequencies."""
    figure, (left, right) = new_figure(2.9, 1, 2)
    sizes = np.linspace(0.005, 0.020, 16)
    family = platform_family(CROSS, sizes.tolist(), STATED_HZ)
    mm = 1e3 * sizes
    left.plot(mm, [1e3 * fit.platform.mass_kg for fit in family], color=BLUE)
    left.set(
        xlabel="half-size of the platform / mm", ylabel="fitted mass / g", title="Platform that fits", ylim=(0, 25)
    )
    for name, color in zip(STATED_HZ, (BLUE, ORANGE, GREEN, VIOLET), strict=True):
        right.plot(mm, [fit.frequency_hz[MODE_NAMES.index(name)] for fit in family], color=color)
        right.text(20.3, STATED_HZ[name], name, color=color, va="center")
    right.set(xlabel="half-size of the platform / mm", ylabel="natural frequency / Hz", ylim=(0, 5600), xlim=(5, 21.5))
    right.set_title("Frequencies: as published")
    return figure


DRAWINGS = (cross_beam, element_tolerances, platform_ambiguity)
