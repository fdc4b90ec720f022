"""Drawings of the recording format: the rig and its blocks, frames and signs, times of an exposure, elastic loads."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle
from style import BLUE, DARK, GREEN, GREY, ORANGE, RED, blank, new_figure

RIG, RECORDING = DARK, ORANGE
METAL, SENSOR, BASE, CAMERA = "#dfe3e8", "#c9dcf0", "#b9c0c8", "#59636e"


def recording_rig() -> Figure:
    """Draw a rig from the side, every item with the name of its block."""
    figure, axes = new_figure(4.5)
    blank(axes, (0, 14.4), (0, 9.0))
    _bodies(axes)
    _camera(axes, (3.6, 7.9), (5.9, 5.2))
    _camera(axes, (5.0, 8.1), (6.1, 5.2))
    axes.plot([6.75, 6.75], [7.8, 5.35], color=RED, lw=1.2)
    axes.add_patch(Rectangle((6.4, 7.6), 0.7, 0.65, color="#8b1a1a"))
    axes.add_patch(Rectangle((7.55, 1.95), 0.3, 0.25, color=GREEN))
    _wire(axes, (7.1, 7.9), (11.8, 7.9), (11.8, 7.05))
    _wire(axes, (7.85, 2.07), (12.4, 2.07), (12.4, 3.85))
    _wire(axes, (7.35, 3.05), (11.2, 3.05), (11.2, 3.85))
    _wire(axes, (5.2, 8.85), (13.7, 8.85), (13.7, 4.37), (12.9, 4.37), color=BLUE)
    _wire(axes, (13.7, 6.52), (12.9, 6.52), color=BLUE)
    axes.text(9.2, 8.6, "camera trigger", color=BLUE, fontsize=8, ha="center", va="center")
    for y, text in ((6.52, "recorder 1"), (4.37, "recorder 2")):
        axes.add_patch(FancyBboxPatch((10.7, y - 0.52), 2.2, 1.05, boxstyle="round,pad=0.03", fc="white", ec=DARK))
        axes.text(11.8, y - 0.25, text, ha="center", va="center", fontsize=8)
        axes.text(
            11.8, y + 0.22, "[[daq]]", ha="center", va="center", fontsize=8.5, color=ORANGE, family="DejaVu Sans Mono"
        )
    for text, place, target, colour in (
        ("[stereo.top]", (0.2, 8.2), (3.2, 8.0), RIG),
        ("[[images]]", (0.2, 7.4), (3.3, 7.75), RECORDING),
        ("[head.psv]", (7.25, 8.2), None, RIG),
        ("[load]", (0.9, 4.75), (5.1, 4.75), RIG),
        ("[[part]]", (0.9, 3.75), (5.1, 3.75), RIG),
        ("[sensor]", (0.9, 2.95), (5.35, 3.0), RIG),
        ("[shaker]", (0.9, 1.2), (4.2, 1.2), RIG),
        ("[excitation]", (0.9, 0.35), (5.6, 0.45), RECORDING),
        ("[environment]", (8.35, 0.35), None, RIG),
        ("[[daq.channel]]  velocity", (7.0, 6.6), None, RECORDING),
        ("[[daq.channel]]  acceleration", (7.95, 1.7), None, RECORDING),
        ("[[daq.channel]]  output", (7.6, 2.7), None, RECORDING),
        ("[[daq.channel]]  trigger", (10.1, 5.45), None, RECORDING),
    ):
        _name(axes, text, place, target, colour)
    axes.annotate("", (8.0, 0.1), (8.0, 1.0), arrowprops={"arrowstyle": "-|>", "color": GREY})
    axes.text(8.1, 0.75, "g", color=GREY, fontsize=9, style="italic")
    return figure


def recording_axes() -> Figure:
    """Draw the sensor frame, the frame of a left camera and the sense of a laser channel."""
    figure, axes = new_figure(3.9)
    blank(axes, (-5.2, 8.2), (-1.6, 7.3))
    axes.add_patch(Rectangle((-1.6, 0.9), 3.2, 1.7, fc=METAL, ec=DARK, lw=0.8))
    axes.add_patch(Rectangle((-1.1, -0.4), 2.2, 1.3, fc=SENSOR, ec=DARK, lw=0.8))
    axes.add_patch(Rectangle((-2.0, -1.3), 4.0, 0.9, fc=BASE, ec=DARK, lw=0.8))
    _frame(axes, (0.0, 0.25), {"x": (1.9, 0.0), "z": (0.0, 1.25)}, DARK)
    axes.plot([0], [0.25], "o", mfc="white", mec=DARK, ms=8)
    axes.plot([-0.06, 0.06, 0, -0.06, 0.06], [0.19, 0.31, 0.25, 0.31, 0.19], color=DARK, lw=0.8)
    axes.text(-0.35, -0.05, "y", fontsize=9, color=DARK, style="italic")
    axes.text(2.35, -0.9, "sensor frame: origin and axes of the sensor", fontsize=8.5, color=DARK)
    eye, view = np.array([-3.6, 5.9]), np.array([-0.75, 2.6])
    _camera(axes, tuple(eye), tuple(view))
    forward = (view - eye) / np.hypot(*(view - eye))
    _frame(axes, tuple(eye), {"z": tuple(1.6 * forward), "x": (1.5 * forward[1], -1.5 * forward[0])}, BLUE)
    axes.text(-5.1, 6.75, "left camera: z forward, x to the right\nand y down in the image", fontsize=8.5, color=BLUE)
    axes.annotate("", (-3.75, 5.55), (-0.15, 0.4), arrowprops={"arrowstyle": "-|>", "color": GREY, "ls": "--"})
    axes.text(-2.9, 2.9, "translation", color=GREY, fontsize=8.5, ha="right")
    axes.text(
        -5.1,
        1.9,
        "rotation: its columns are\nthe axes of the camera\nin the sensor frame",
        color=BLUE,
        fontsize=8.5,
        va="top",
    )
    axes.plot([0.9, 2.0], [2.6, 6.4], color=RED, lw=1.2)
    axes.add_patch(Polygon([(1.75, 6.4), (2.35, 6.25), (2.5, 6.95), (1.95, 7.1)], color="#8b1a1a"))
    axes.plot([0.9], [2.6], "o", color=RED, ms=4)
    axes.annotate("", (1.3, 4.0), (0.9, 2.6), arrowprops={"arrowstyle": "-|>", "color": RED, "lw": 2.0})
    axes.text(1.55, 3.55, "direction: motion this way reads positive", color=RED, fontsize=8.5)
    axes.text(1.1, 2.75, "point", color=RED, fontsize=8.5)
    axes.text(2.65, 6.55, "mirror of [head.NAME]", color=RED, fontsize=8.5)
    axes.annotate("", (5.0, -0.35), (5.0, 0.75), arrowprops={"arrowstyle": "-|>", "color": GREY})
    axes.text(5.2, 0.15, "gravity = [0, 0, −9.81]", color=GREY, fontsize=8.5)
    axes.annotate("", (3.3, 1.2), (3.3, 2.5), arrowprops={"arrowstyle": "-|>", "color": ORANGE, "lw": 2.0})
    words = 'the load pushes the sensor down:\nsense "on_sensor": output Fz < 0\nsense "on_load": output Fz > 0'
    axes.text(3.55, 1.85, words, color=ORANGE, fontsize=8.5, va="center")
    return figure


def recording_times() -> Figure:
    """Draw the trigger instant, the delay and the exposure of one frame, and the length of a pulse."""
    figure, (above, below) = new_figure(3.6, 2, 1, sharex=True, height_ratios=(1.0, 0.55))
    time_us = np.linspace(-20.0, 130.0, 1501)
    volts = 5.0 / (1.0 + np.exp(-(time_us) / 0.8)) - 5.0 / (1.0 + np.exp(-(time_us - 80.0) / 0.8))
    above.plot(time_us, volts, color=DARK)
    above.axhline(2.5, color=GREY, lw=0.8, ls=":")
    above.text(-19.0, 2.65, "threshold", color=GREY, fontsize=8)
    above.set(ylabel="trigger / V", ylim=(-0.6, 9.0))
    above.set_title("A frame is dated at edge + delay + exposure / 2")
    above.set_yticks([0, 5])
    above.plot([0.0], [2.5], "o", color=DARK, ms=4)
    for start, stop, height, text, colour in (
        (0.0, 30.0, 6.1, "delay", GREY),
        (30.0, 90.0, 6.1, "exposure", ORANGE),
        (0.0, 80.0, 7.6, 'pulse: exposure if exposure = "pulse"', BLUE),
    ):
        _span(above, start, stop, height, text, colour)
    below.fill_between([30.0, 90.0], 0.0, 1.0, color=ORANGE, alpha=0.35, lw=0)
    below.plot([-20, 30, 30, 90, 90, 130], [0, 0, 1, 1, 0, 0], color=ORANGE)
    below.axvline(60.0, color=RED, lw=1.2)
    below.text(61.5, 1.12, "time of the frame", color=RED, fontsize=8)
    below.text(1.5, 1.12, "trigger instant", color=DARK, fontsize=8)
    for panel in (above, below):
        panel.axvline(0.0, color=DARK, lw=0.8, ls="--")
    below.set(ylabel="shutter", xlabel="time after the trigger instant / µs", yticks=[0, 1], ylim=(-0.1, 1.5))
    below.set_yticklabels(["closed", "open"])
    return figure


def recording_edges() -> Figure:
    """Draw trigger edges with their numbers, and the frames that belong to them."""
    figure, axes = new_figure(2.2)
    blank(axes, (-1.6, 11.4), (-0.6, 3.6))
    for edge in range(11):
        axes.plot([edge - 0.25, edge, edge, edge + 0.3, edge + 0.3, edge + 0.75], [2, 2, 2.6, 2.6, 2, 2], color=DARK)
        axes.text(edge + 0.15, 2.75, str(edge), ha="center", fontsize=8.5, color=DARK)
    frames = {2: "0000", 3: "0001", 4: "0002", 5: "0003", 7: "0005", 8: "0006", 9: "0007"}
    for edge, number in frames.items():
        axes.add_patch(Rectangle((edge - 0.28, 0.15), 0.86, 0.65, fc="#f3e3d3", ec=ORANGE))
        axes.text(edge + 0.15, 0.47, number, ha="center", va="center", fontsize=7.5)
        axes.annotate("", (edge + 0.15, 0.85), (edge + 0.15, 1.95), arrowprops={"arrowstyle": "-", "color": ORANGE})
    axes.add_patch(Rectangle((5.72, 0.15), 0.86, 0.65, fc="white", ec=RED, ls="--"))
    axes.text(6.15, 0.47, "0004", ha="center", va="center", fontsize=7.5, color=RED)
    axes.text(6.15, -0.35, "frame lost: edge 6 has no image", ha="center", fontsize=8, color=RED)
    axes.text(0.1, 1.2, "before the camera\nwas armed", fontsize=8, color=GREY, va="center", ha="center")
    axes.text(-0.5, 2.72, "edge", ha="right", fontsize=8.5)
    axes.text(-0.5, 0.42, "frame", ha="right", fontsize=8.5, color=ORANGE)
    axes.text(2.15, 3.3, "first_edge = 2", ha="center", fontsize=9, color=BLUE, weight="bold")
    axes.annotate("", (2.15, 2.98), (2.15, 3.28), arrowprops={"arrowstyle": "-|>", "color": BLUE})
    return figure


def elastic_effect() -> Figure:
    """Draw the error of a rigid load: a joint of 3.5 kHz below 6.96 kg, and a rod of 15 cm driven along its axis."""
    figure, axes = new_figure(2.7)
    hertz = np.linspace(20.0, 2000.0, 400)
    above, below = 6.9605, 0.769
    joint = below * (hertz / 3500.0) ** 2 / (above + below)
    wave = 2.0 * np.pi * hertz / np.sqrt(2.0e11 / 7850.0) * 0.15
    rod = 1.0 - np.tan(wave) / wave * np.cos(wave)
    axes.plot(hertz, 100.0 * joint, label="joint of 3.5 kHz, 0.77 kg below and 6.96 kg above it")
    axes.plot(hertz, 100.0 * rod, color=ORANGE, label="steel rod of 15 cm, force at its foot, motion of its top")
    axes.plot(
        [1000, 1000], [100 * np.interp(1000, hertz, joint), 100 * np.interp(1000, hertz, rod)], "o", color=GREY, ms=3
    )
    axes.set(xlabel="frequency / Hz", ylabel="error of m·a / %")
    axes.set_title("A load that is taken as rigid overestimates the force")
    axes.set(xlim=(0, 2000), ylim=(0, None))
    axes.legend(loc="upper left")
    return figure


def _bodies(axes: Axes) -> None:
    """Draw shaker, sensor, adapter and load mass."""
    for corner, width, height, colour in (
        ((4.2, 0.75), 3.4, 1.2, BASE),
        ((4.8, 1.95), 2.4, 0.35, "#9aa3ad"),
        ((5.35, 2.3), 1.3, 1.25, SENSOR),
        ((5.0, 3.55), 2.0, 0.4, "#c8cdd3"),
        ((5.0, 3.95), 2.0, 1.4, METAL),
    ):
        axes.add_patch(Rectangle(corner, width, height, fc=colour, ec=DARK, lw=0.8))
    axes.plot([6.65, 7.35], [3.05, 3.05], color=GREY, lw=1.0)
    axes.annotate("", (5.9, 0.75), (5.9, 0.1), arrowprops={"arrowstyle": "<|-|>", "color": ORANGE, "lw": 1.8})
    for x, y in np.random.default_rng(3).uniform((5.08, 4.03), (6.92, 5.27), (60, 2)):
        axes.add_patch(Circle((x, y), 0.035, color="#4b5563", lw=0))
    axes.text(5.9, 1.35, "shaker", ha="center", va="center", fontsize=8)
    axes.text(6.0, 2.92, "sensor", ha="center", va="center", fontsize=8)


def _camera(axes: Axes, eye: tuple[float, float], view: tuple[float, float]) -> None:
    """Draw a camera at a place that looks at another, and the edges of its view."""
    forward = np.subtract(view, eye) / np.hypot(*np.subtract(view, eye))
    side = np.array([-forward[1], forward[0]])
    for sign in (-1.0, 1.0):
        axes.plot(*np.stack([eye, np.add(view, sign * 0.7 * side)], axis=1), color=GREY, lw=0.6, ls="--")
    corners = [(-0.75, 0.28), (0.0, 0.28), (0.0, -0.28), (-0.75, -0.28)]
    axes.add_patch(Polygon([np.add(eye, a * forward + b * side) for a, b in corners], color=CAMERA))
    lens = [(0.0, 0.16), (0.22, 0.16), (0.22, -0.16), (0.0, -0.16)]
    axes.add_patch(Polygon([np.add(eye, a * forward + b * side) for a, b in lens], color="#323a42"))


def _wire(axes: Axes, *places: tuple[float, float], color: str = GREY) -> None:
    axes.plot(*zip(*places, strict=True), color=color, lw=1.0, zorder=0)


def _name(axes: Axes, text: str, place: tuple[float, float], target: Any, colour: str) -> None:
    """Write the name of a block, and draw a line to its item."""
    style = {"family": "DejaVu Sans Mono", "fontsize": 8.5, "color": colour, "va": "center"}
    if target is None:
        axes.text(*place, text, **style)
    else:
        line = {"arrowstyle": "-", "color": colour, "lw": 0.6, "shrinkA": 2.0}
        axes.annotate(text, target, place, arrowprops=line, **style)


def _frame(axes: Axes, origin: tuple[float, float], directions: dict[str, tuple[float, float]], colour: str) -> None:
    """Draw the axes of a frame from its origin."""
    for name, direction in directions.items():
        tip = np.add(origin, direction)
        axes.annotate("", tip, origin, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})
        axes.text(
            *(np.add(origin, 1.13 * np.asarray(direction))),
            name,
            color=colour,
            style="italic",
            ha="center",
            va="center",
        )


def _span(axes: Axes, start: float, stop: float, height: float, text: str, colour: str) -> None:
    """Draw a horizontal dimension line with its name."""
    axes.annotate("", (start, height), (stop, height), arrowprops={"arrowstyle": "<|-|>", "color": colour, "lw": 1.2})
    axes.text(0.5 * (start + stop), height + 0.3, text, color=colour, ha="center", fontsize=8)


DRAWINGS = (recording_rig, recording_axes, recording_times, recording_edges, elastic_effect)
