"""Mechanical models of the documents: masses, springs and dampers with their symbols."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from style import BLUE, GREEN, GREY, ORANGE, RED, blank, new_figure

BLACK = "#1f2937"
BODY = {"facecolor": "#e5e7eb", "edgecolor": BLACK, "linewidth": 1.2}


def mass(axes: Any, box: tuple[float, float, float, float], text: str, color: str = "#e5e7eb") -> None:
    """Draw a body in a box (x, y, width, height) with its symbol."""
    x, y, width, height = box
    axes.add_patch(Rectangle((x, y), width, height, **{**BODY, "facecolor": color}))
    axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9)


def spring(axes: Any, x: float, low: float, high: float, text: str, side: float = -1.0) -> None:
    """Draw a vertical spring between two heights with its symbol on one side."""
    length, turns = high - low, 5
    inner = np.linspace(low + 0.18 * length, high - 0.18 * length, 2 * turns + 1)
    swing = np.concatenate([[0.0], 0.13 * (-1.0) ** np.arange(2 * turns - 1), [0.0]])
    axes.plot(x + np.concatenate([[0.0], swing, [0.0]]), [low, *inner, high], color=BLUE, linewidth=1.3)
    axes.text(x + 0.26 * side, (low + high) / 2, text, ha="right" if side < 0 else "left", va="center", color=BLUE)


def damper(axes: Any, x: float, low: float, high: float, text: str, side: float = 1.0) -> None:
    """Draw a vertical damper between two heights with its symbol on one side."""
    length, half = high - low, 0.15
    bottom, top = low + 0.3 * length, low + 0.7 * length
    line: dict[str, Any] = {"color": ORANGE, "linewidth": 1.3}
    axes.plot([x, x], [low, bottom], **line)
    axes.plot([x - half, x - half, x + half, x + half], [top, bottom, bottom, top], **line)
    axes.plot([x - 0.8 * half, x + 0.8 * half], [low + 0.52 * length] * 2, **line)
    axes.plot([x, x], [low + 0.52 * length, high], **line)
    axes.text(x + 0.26 * side, (low + high) / 2, text, ha="right" if side < 0 else "left", va="center", color=ORANGE)


def joint(axes: Any, middle: float, heights: tuple[float, float], spring_text: str, damper_text: str) -> None:
    """Draw a spring and a damper side by side between two heights."""
    spring(axes, middle - 0.35, *heights, spring_text)
    damper(axes, middle + 0.35, *heights, damper_text)


def ground(axes: Any, low: float, left: float, right: float) -> None:
    """Draw fixed ground whose surface is at a height."""
    axes.plot([left, right], [low, low], color=BLACK, linewidth=1.4)
    for x in np.arange(left + 0.1, right + 0.01, 0.2):
        axes.plot([x - 0.1, x], [low - 0.12, low], color=BLACK, linewidth=0.8)


def arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], color: str, text: str = "") -> None:
    """Draw an arrow with a text at its beginning."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=color, linewidth=1.5))
    if text:
        up = end[1] > start[1]
        axes.text(
            start[0], start[1] + (-0.06 if up else 0.06), text, color=color, ha="center", va="top" if up else "bottom"
        )


def motion(axes: Any, x: float, y: float, text: str) -> None:
    """Draw the coordinate of a body at its right edge."""
    axes.plot([x, x + 0.22], [y, y], color=GREEN, linewidth=1.0)
    axes.add_patch(
        FancyArrowPatch((x + 0.14, y), (x + 0.14, y + 0.42), arrowstyle="-|>", mutation_scale=9, color=GREEN)
    )
    axes.text(x + 0.27, y + 0.26, text, color=GREEN, va="center")


def sketch(axes: Any, width: float, height: float, title: str) -> None:
    """Prepare axes for a sketch about their middle."""
    blank(axes, (-width / 2, width / 2), (-0.35, height))
    axes.set_title(title, loc="center")


def load_masses() -> Figure:
    """Sensor without load, with a rigid load, and with a load on a coupling."""
    figure, panels = new_figure(3.3, 1, 3)
    titles = ("no load", "two masses: rigid load", "three masses: coupling")
    for axes, title in zip(panels, titles, strict=True):
        sketch(axes, 3.2, 4.35, title)
        ground(axes, 0.0, -0.9, 0.9)
        joint(axes, 0.0, (0.0, 1.0), "$k$", "$c$")
        mass(axes, (-0.75, 1.0, 1.5, 0.55), "$m_E$")
        motion(axes, 0.75, 1.25, "$x_E$")
    mass(panels[1], (-0.75, 1.55, 1.5, 0.8), "$m_L$", "#fde8d0")
    joint(panels[2], 0.0, (1.55, 2.4), "$k_L$", "$c_L$")
    mass(panels[2], (-0.75, 2.4, 1.5, 0.8), "$m_L$", "#fde8d0")
    motion(panels[2], 0.75, 2.75, "$x_L$")
    for axes, top in zip(panels, (1.55, 2.35, 3.2), strict=True):
        arrow(axes, (0.0, top + 0.6), (0.0, top), RED, "force $F$")
        axes.text(0.0, -0.33, "base of the sensor, at rest", ha="center", va="top", fontsize=8, color=GREY)
    return figure


def identify_masses() -> Figure:
    """Load on a sensor with a driven base: one spring, a compliant mount, a pitching load."""
    figure, panels = new_figure(3.5, 1, 3)
    for axes, title in zip(panels, ("translation", "adapter", "pitching"), strict=True):
        sketch(axes, 3.3, 4.3, title)
    for axes, low in ((panels[0], 0.0), (panels[1], 1.15)):
        mass(axes, (-0.85, low, 1.7, 0.3), "sensor base")
        joint(axes, 0.0, (low + 0.3, low + 1.25), "$k$", "$b$")
        mass(axes, (-0.75, low + 1.25, 1.5, 0.4), "$m_i$")
        mass(axes, (-0.75, low + 1.65, 1.5, 0.75), "load $m$", "#fde8d0")
        motion(axes, 0.75, low + 1.9, "$a_{load}$")
    motion(panels[0], 0.85, 0.0, "$a_{base}$")
    joint(panels[1], 0.0, (0.25, 1.15), "$k_{mount}$", "$b_{mount}$")
    mass(panels[1], (-0.85, -0.05, 1.7, 0.3), "shaker table")
    motion(panels[1], 0.85, -0.05, "$a_{base}$")
    axes = panels[2]
    mass(axes, (-0.85, 0.0, 1.7, 0.3), "sensor base")
    spring(axes, -0.45, 0.3, 1.25, "$k_x$, $k_{ry}$")
    damper(axes, 0.45, 0.3, 1.25, "$b_x$, $b_{ry}$")
    turn = 8.0
    axes.add_patch(Rectangle((-0.7, 1.35), 1.5, 0.4, angle=-turn, rotation_point=(0.0, 1.5), **BODY))
    axes.add_patch(
        Rectangle((-0.7, 1.75), 1.5, 1.5, angle=-turn, rotation_point=(0.0, 1.5), **{**BODY, "facecolor": "#fde8d0"})
    )
    axes.plot([0.21], [2.5], "o", color=BLACK, markersize=5)
    axes.text(0.21, 2.62, "centre of mass", fontsize=8, ha="center", va="bottom")
    axes.text(0.05, 1.53, "$m_i$", ha="center", va="center", rotation=-turn)
    arrow(axes, (0.85, 0.0), (1.6, 0.0), GREEN)
    axes.text(1.25, 0.07, "$a_{base}$", color=GREEN, ha="center", va="bottom")
    axes.add_patch(
        FancyArrowPatch(
            (-0.6, 3.45),
            (0.75, 3.4),
            connectionstyle="arc3,rad=-0.25",
            arrowstyle="-|>",
            mutation_scale=11,
            color=GREEN,
            linewidth=1.3,
        )
    )
    axes.text(0.05, 3.75, "shift $x$ and turn $ry$", color=GREEN, ha="center", va="bottom")
    return figure


def mounted_chain() -> Figure:
    """Pedestal, sensor and hand as three masses in a row, with their natural frequencies."""
    figure, axes = new_figure(1.8)
    blank(axes, (-0.3, 9.0), (0.0, 2.1))
    axes.plot([0.0, 0.0], [0.2, 1.8], color=BLACK, linewidth=1.4)
    for y in np.arange(0.35, 1.81, 0.2):
        axes.plot([-0.12, 0.0], [y - 0.12, y], color=BLACK, linewidth=0.8)
    names = (("pedestal", "pedestal_mass"), ("sensor", "from the frame"), ("hand", "hand_mass"))
    springs = (("pedestal_stiffness", "pedestal_damping"), ("from the frame", "sensor_damping"))
    left = 0.0
    for (name, key), (above, below) in zip(names, (*springs, ("hand_stiffness", "hand_damping")), strict=True):
        zigzag = np.linspace(left + 0.25, left + 1.25, 11)
        swing = np.concatenate([[0.0], 0.12 * (-1.0) ** np.arange(9), [0.0]])
        axes.plot([left, *zigzag, left + 1.5], 1.35 + np.concatenate([[0.0], swing, [0.0]]), color=BLUE, linewidth=1.3)
        for x, y in (([left, left + 0.5], [0.65, 0.65]), ([left + 0.75, left + 1.5], [0.65, 0.65])):
            axes.plot(x, y, color=ORANGE, linewidth=1.3)
        axes.plot([left + 1.0, left + 0.5, left + 0.5, left + 1.0], [0.8, 0.8, 0.5, 0.5], color=ORANGE, linewidth=1.3)
        axes.plot([left + 0.75] * 2, [0.53, 0.77], color=ORANGE, linewidth=1.3)
        axes.text(left + 0.75, 1.58, above, color=BLUE, ha="center", va="bottom", fontsize=7.5)
        axes.text(left + 0.75, 0.4, below, color=ORANGE, ha="center", va="top", fontsize=7.5)
        mass(axes, (left + 1.5, 0.35, 1.4, 1.3), f"{name}\n{key}")
        left += 2.9
    axes.text(-0.05, 1.9, "ground", fontsize=8, ha="left", color=GREY)
    return figure


def signal_paths() -> Figure:
    """Loads, common modes, outputs and the decoupling filter of a sensor with several components."""
    figure, axes = new_figure(2.5)
    blank(axes, (0.0, 12.0), (0.1, 4.0), "auto")
    loads, outputs, reads = ("Fx", "Fz", "My"), ("output Fx", "output Fz", "output My"), ("Fx", "Fz", "My")
    heights = (3.2, 1.9, 0.6)
    modes = ("mode 1", "mode 2", "mode 3")
    for y, load, mode, output, read in zip(heights, loads, modes, outputs, reads, strict=True):
        mass(axes, (0.1, y - 0.3, 1.3, 0.6), load, "#fbd9d9")
        mass(axes, (3.0, y - 0.3, 1.6, 0.6), mode)
        mass(axes, (6.1, y - 0.3, 1.8, 0.6), output, "#dbeafe")
        mass(axes, (10.6, y - 0.3, 1.3, 0.6), read, "#d3f0dc")
        arrow(axes, (9.75, y), (10.6, y), GREY)
        arrow(axes, (7.9, y), (8.65, y), GREY)
    for start in heights:
        for end in heights:
            strong = start == end
            style: dict[str, Any] = {"color": BLACK if strong else RED, "linewidth": 1.6 if strong else 0.6}
            axes.plot([1.4, 3.0], [start, end], **style)
            axes.plot([4.6, 6.1], [start, end], **style)
    mass(axes, (8.65, 0.2, 1.1, 3.4), "filter\n$D$", "#d3f0dc")
    for x, text in ((0.75, "loads"), (3.8, "common modes"), (7.0, "outputs"), (11.25, "loads read")):
        axes.text(x, 3.75, text, ha="center", fontweight="bold")
    return figure


DRAWINGS = (load_masses, identify_masses, mounted_chain, signal_paths)
