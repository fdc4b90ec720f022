"""Drawings of the set-up, the trigger, shutters and exposures, and of a control chart (docs/practice.md)."""

from __future__ import annotations

from datetime import date, timedelta
from typing import Any

import numpy as np
from matplotlib.patches import Arc, Circle, Polygon, Rectangle
from scipy.signal import lfilter
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, Figure, FloatArray, arrow, blank, camera_shape, new_figure

from fusion.sensor.compare.comparison_inputs import year_of
from fusion.sensor.compare.control_chart import control_charts

STEEL, PALE = "#cbd5e1", "#eef1f4"


def _note(axes: Any, place: tuple[float, float], text: str, at: tuple[float, float], colour: str = "black") -> None:
    """Write a text at one place, with a thin line to another."""
    axes.plot(*zip(place, at, strict=True), color=colour, linewidth=0.7)
    left = at[0] > place[0]
    axes.text(
        at[0] + (0.5 if left else -0.5),
        at[1],
        text,
        ha="left" if left else "right",
        va="center",
        fontsize=8,
        color=colour,
    )


def instrument_places() -> Figure:
    """Draw a shaker with sensor and load from the side, and where the instruments go."""
    figure, axes = new_figure(4.3)
    blank(axes, (-53, 53), (-5, 57))
    axes.plot([-50, 50], [0, 0], color="black")
    axes.add_patch(Rectangle((-12, 0), 24, 12, facecolor=STEEL, edgecolor=GREY))
    axes.text(0, 6, "shaker", ha="center", va="center")
    axes.add_patch(Rectangle((-8, 12.4), 16, 2.2, facecolor=PALE, edgecolor=GREY))
    axes.add_patch(Rectangle((-4, 14.6), 8, 3.0, facecolor="#f6d9b8", edgecolor=ORANGE))
    axes.add_patch(Rectangle((-7, 17.6), 14, 6.0, facecolor=PALE, edgecolor=GREY))
    axes.add_patch(Rectangle((-7, 23.6), 14, 0.5, facecolor="#111827"))
    _note(axes, (7.2, 13.5), "table", (14, 12.6))
    _note(axes, (4.0, 16.1), "force/moment sensor", (14, 16.4), ORANGE)
    _note(axes, (7.0, 20.6), "load: known mass and inertia", (14, 20.2))
    _note(axes, (6.4, 23.8), "speckle on the load", (14, 24.0))
    _note(axes, (5.8, 15.0), "accelerometer on the table, cable fixed to the table", (14, 9.0), VIOLET)
    axes.add_patch(Rectangle((5.0, 14.6), 1.6, 1.3, facecolor=VIOLET))
    axes.plot([-4, -11, -20], [16.4, 18.8, 15.6], color=GREY, linewidth=1.2)
    axes.text(-20.5, 15.6, "sensor cable: loose loop,\nfixed 10 cm away", ha="right", va="center", fontsize=8)
    target = np.array([0.0, 24.1])
    for sign in (-1.0, 1.0):
        place = target + 24.0 * np.array([sign * np.sin(np.radians(15.0)), np.cos(np.radians(15.0))])
        axes.plot(*zip(place, target, strict=True), color=BLUE, linewidth=0.8, linestyle="--")
        camera_shape(axes, place, target, 2.0)
    for x in (-2.4, 0.0, 2.4):
        axes.plot([x, x], [24.1, 49.0], color=RED, linewidth=1.0)
    axes.add_patch(Arc((0.0, 24.1), 17.0, 17.0, theta1=75, theta2=105, color=BLUE))
    axes.text(-3.4, 32.4, "α = 30°", ha="right", fontsize=8, color=BLUE)
    axes.add_patch(Rectangle((-3.6, 49.0), 7.2, 3.6, facecolor="#f8d7da", edgecolor=RED))
    axes.add_patch(Rectangle((1.6, 52.6), 1.6, 1.3, facecolor=VIOLET))
    _note(axes, (3.6, 50.8), "laser head, with an accelerometer", (22, 52.6), RED)
    _note(axes, (8.6, 47.5), "stereo pair, 20° to 35° between the views", (22, 47.6), BLUE)
    _note(axes, (2.4, 38.0), "one beam near the axis, or three for the tilts", (14, 38.0), RED)
    axes.plot([-50, -50, 7.2], [0, 55.6, 55.6], color=GREY, linewidth=3)
    for x in (-7.2, 7.2):
        axes.plot([x, x], [50.8, 55.6], color=GREY, linewidth=3)
    axes.text(-48, 52.4, "separate stand for cameras", fontsize=8, color=GREY, va="center")
    axes.add_patch(Rectangle((-20, 22.2), 7.5, 1.6, facecolor="#111827"))
    axes.plot([-16.2, -16.2, -46, -46], [22.2, 21.6, 21.6, 0], color=GREY, linewidth=2)
    _note(axes, (-18, 23.8), "stationary speckle in view,\non a separate stand", (-24, 29), GREEN)
    axes.text(0, -4.0, "floor", ha="center", color=GREY, fontsize=8)
    return figure


def trigger_wiring() -> Figure:
    """Draw how the trigger reaches cameras and recorders."""
    figure, axes = new_figure(2.9)
    blank(axes, (0, 100), (0, 38))
    boxes = {
        "pulse generator": (2, 27, 20, 7, GREY),
        "left camera": (36, 29, 17, 7, BLUE),
        "right camera": (36, 19, 17, 7, BLUE),
        "strobe": (36, 10, 17, 6, ORANGE),
        "recorder 1": (78, 27, 20, 7, GREEN),
        "recorder 2": (78, 17, 20, 7, GREEN),
        "sine generator": (2, 1, 20, 6, GREY),
        "amplifier": (36, 1, 17, 6, GREY),
        "shaker": (78, 1, 20, 6, GREY),
    }
    for name, (x, y, wide, high, colour) in boxes.items():
        axes.add_patch(Rectangle((x, y), wide, high, facecolor="white", edgecolor=colour, linewidth=1.6))
        axes.text(x + wide / 2, y + high / 2, name, ha="center", va="center", fontsize=8.5)
    for y in (32.5, 22.5):
        axes.plot([28, 28], [30.5, y], color=GREY, linewidth=1.3)
        arrow(axes, (28, y), (36, y), GREY)
    axes.plot([22, 28], [30.5, 30.5], color=GREY, linewidth=1.3)
    axes.text(23, 18, "trigger,\nequal cables", fontsize=7.5, color=GREY, ha="center")
    axes.plot([53, 66], [32.5, 32.5], color=RED, linewidth=1.8)
    axes.plot([66, 66], [13.0, 32.5], color=RED, linewidth=1.8)
    for y, x in ((30.5, 78), (20.5, 78), (13.0, 53)):
        arrow(axes, (66, y), (x, y), RED)
    axes.text(54, 34.0, "exposure output", fontsize=8, color=RED)
    axes.text(67.5, 25.0, "one channel\nof each\nrecorder", fontsize=7.5, color=RED, va="center")
    axes.text(60, 9.0, "starts the flash, delayed\nuntil both shutters are open", fontsize=7.5, color=RED, va="center")
    arrow(axes, (22, 4), (36, 4), GREY)
    arrow(axes, (53, 4), (78, 4), GREY)
    return figure


def _measured(time: FloatArray, pulse: FloatArray, corner: float, ringing: float = 0.0) -> FloatArray:
    """Return a pulse behind a low pass of first order, with ringing at its edges."""
    step = time[1] - time[0]
    share = 1.0 - np.exp(-step / corner)
    smooth = lfilter([share], [1.0, share - 1.0], pulse)
    flanks = np.diff(pulse, prepend=pulse[0])
    decay = np.exp(-np.arange(len(time)) * step / 25e-6) * np.sin(2 * np.pi * 60e3 * np.arange(len(time)) * step)
    return np.asarray(smooth + ringing * np.convolve(flanks, decay)[: len(time)])


def trigger_pulses() -> Figure:
    """Draw trigger, exposure and strobe over one frame, and three kinds of recorded edges."""
    figure, axes = new_figure(3.1, 1, 2, width_ratios=[1.2, 1.0])
    time = np.arange(-100e-6, 960e-6, 0.5e-6)
    rows = (
        ("trigger input", (0.0, 150e-6), GREY),
        ("exposure output", (120e-6, 520e-6), RED),
        ("strobe current", (160e-6, 220e-6), ORANGE),
    )
    for number, (name, (start, end), colour) in enumerate(rows):
        level = ((time >= start) & (time < end)).astype(np.float64)
        axes[0].plot(1e6 * time, 2.6 - 1.3 * number + level, color=colour)
        axes[0].text(560, 3.05 - 1.3 * number, name, color=colour, fontsize=8.5, va="center")
    axes[0].axvspan(160, 220, color=ORANGE, alpha=0.18, linewidth=0)
    axes[0].annotate("", (120, 3.85), (0, 3.85), arrowprops={"arrowstyle": "<->", "color": GREY})
    axes[0].text(60, 3.95, "delay", ha="center", color=GREY, fontsize=8)
    axes[0].annotate(
        "light only\nhere",
        (222, 0.5),
        (290, 0.5),
        fontsize=8,
        color=ORANGE,
        va="center",
        arrowprops={"arrowstyle": "->", "color": ORANGE},
    )
    axes[0].set(xlim=(-100, 960), ylim=(-0.1, 4.3), yticks=[], xlabel="time in µs", title="one frame")
    axes[0].spines["left"].set_visible(False)
    fine = np.arange(-60e-6, 340e-6, 0.2e-6)
    pulse = ((fine >= 0.0) & (fine < 200e-6)).astype(np.float64)
    cases = (
        ("good", 1e-6, 0.0, GREEN),
        ("slow edge: late by 0.69 time constants", 40e-6, 0.0, ORANGE),
        ("ringing", 1e-6, 0.6, RED),
    )
    samples = np.arange(0, len(fine), 100)
    for number, (name, corner, ringing, colour) in enumerate(cases):
        shown = _measured(fine, pulse, corner, ringing) + 5.0 - 2.5 * number
        axes[1].plot(1e6 * fine, shown, color=colour, linewidth=1.2)
        axes[1].plot(1e6 * fine[samples], shown[samples], "o", color=colour, markersize=3)
        axes[1].text(-58, 6.75 - 2.5 * number, name, color=colour, fontsize=8.5, va="center")
        axes[1].plot([-60, 340], [5.5 - 2.5 * number] * 2, color=GREY, linewidth=0.7, linestyle=":")
    axes[1].set(yticks=[], xlabel="time in µs", title="sampled at 50 kHz; dotted: half height", ylim=(-0.8, 7.3))
    axes[1].spines["left"].set_visible(False)
    return figure


def reflections() -> Figure:
    """Draw why a reflection moves differently from the surface, and light that avoids it."""
    figure, axes = new_figure(2.6, 1, 3)
    titles = ("lamp next to the camera", "the face tilts by θ", "light from the side")
    for number, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        blank(axis, (-9, 9), (-4.2, 12))
        axis.set_title(title)
        tilt = np.radians(9.0) if number == 1 else 0.0
        along = np.array([np.cos(tilt), np.sin(tilt)])
        for sign in (-1.0, 1.0):
            axis.plot([0, 6 * sign * along[0]], [0, 6 * sign * along[1]], color="black", linewidth=2.5)
        light = np.array([-3.0, 10.0]) if number < 2 else np.array([-8.2, 3.2])
        camera_shape(axis, np.array([3.0, 9.0]), np.zeros(2), 1.0)
        axis.add_patch(Circle(tuple(light), 0.7, facecolor="#fde68a", edgecolor=ORANGE))
        arrow(axis, tuple(light * 0.88), (0.0, 0.0), ORANGE)
        normal = np.array([-along[1], along[0]])
        incoming = -light / np.linalg.norm(light)
        leaving = incoming - 2.0 * (incoming @ normal) * normal
        end = leaving * (8.0 if number < 2 else 7.5)
        hit = number == 0
        arrow(axis, (0.0, 0.0), (float(end[0]), float(end[1])), RED if hit else GREY)
        if number == 1:
            angle = float(np.degrees(np.arctan2(end[1], end[0])))
            axis.add_patch(Arc((0, 0), 13, 13, theta1=angle - 18.0, theta2=angle, color=GREY))
            axis.text(1.2, 6.9, "2θ", fontsize=8, color=GREY, ha="center")
            axis.plot([0, 2.4], [0, 8.0], color=GREY, linewidth=0.8, linestyle=":")
            axis.plot([0, 6.5], [0, 0], color=GREY, linewidth=0.8, linestyle=":")
            axis.add_patch(Arc((0, 0), 9.5, 9.5, theta1=0.0, theta2=9.0, color="black"))
            axis.text(7.2, 0.6, "θ", fontsize=8, va="center", ha="center")
    axes[0].text(
        0,
        -2.8,
        "the mirror image of the lamp\nis in the camera's view",
        ha="center",
        va="center",
        fontsize=8,
        color=RED,
    )
    axes[1].text(
        0,
        -2.8,
        "the reflection turns by 2θ:\nit moves differently from the speckle",
        ha="center",
        va="center",
        fontsize=8,
    )
    axes[2].text(0, -2.8, "the reflection passes\nthe camera", ha="center", va="center", fontsize=8, color=GREEN)
    return figure


def laboratory_day() -> Figure:
    """Draw the steps of a day over time."""
    figure, axes = new_figure(2.7)
    steps = [
        ("warm up", 0.0, 1.0, GREY),
        ("calibrate cameras", 1.0, 0.5, BLUE),
        ("at rest, known displacement", 1.5, 0.25, VIOLET),
        ("first recording, shakercal look", 1.75, 0.25, ORANGE),
        ("all frequencies, the first again", 2.0, 1.5, GREEN),
        ("mount anew, repeat", 3.5, 1.5, GREEN),
        ("mount anew, repeat", 5.0, 1.5, GREEN),
        ("calibrate cameras again", 6.5, 0.5, BLUE),
        ("shakercal run, certificate draft", 7.0, 1.0, ORANGE),
    ]
    for number, (name, start, length, colour) in enumerate(steps):
        axes.barh(-number, length, left=start, color=colour, height=0.68)
        right = start < 4.5
        axes.text(
            start + length + 0.1 if right else start - 0.1,
            -number,
            name,
            ha="left" if right else "right",
            va="center",
            fontsize=8.5,
        )
    axes.set(yticks=[], xlim=(0, 8), xlabel="hours after switching on")
    axes.set_xticks(range(9), [f"{hour}:00" for hour in range(9)])
    axes.spines["left"].set_visible(False)
    return figure


def rolling_shutter() -> Figure:
    """Draw when rows are exposed, and what a straight vertical line that oscillates looks like."""
    figure, axes = new_figure(2.9, 1, 4, width_ratios=[2.1, 1, 1, 1])
    rows, row_time = np.arange(480), 10e-6
    for frame in range(2):
        start = frame * 10.0
        first, last = start + 0.5, start + 0.5 + 1e3 * row_time * rows[-1]
        corners = [[first, 0], [first + 0.6, 0], [last + 0.6, 479], [last, 479]]
        axes[0].add_patch(Polygon(corners, facecolor="#dbe4ee", edgecolor=BLUE))
        axes[0].plot([start, start], [-40, 0], color=RED, linewidth=2)
    axes[0].text(0.3, -62, "trigger", color=RED, fontsize=8, va="center")
    axes[0].text(-0.2, 400, "row r starts\nr·row_time\nlater", fontsize=7.6, va="center")
    axes[0].set(xlim=(-0.5, 16), ylim=(480, -90), xlabel="time in ms", ylabel="row", title="rows of two frames")
    for axis, frequency_hz in zip(axes[1:], (50.0, 250.0, 1020.0), strict=True):
        time = rows * row_time
        for name, colour, place in (
            ("all rows at once", GREY, np.zeros(480)),
            ("rolling", RED, np.sin(2 * np.pi * frequency_hz * time)),
        ):
            axis.plot(place, rows, color=colour, linewidth=2.2 if colour == RED else 1.2, label=name)
        axis.set(xlim=(-1.6, 1.6), ylim=(480, -90), xticks=[-1, 0, 1], yticks=[])
        axis.set_title(f"{frequency_hz:g} Hz: {360 * frequency_hz * row_time * 480:.0f}°", fontsize=8.5)
        axis.spines["left"].set_visible(False)
    axes[2].set_xlabel("place of a vertical line, in amplitudes")
    axes[3].legend(fontsize=7.5, loc="upper center", bbox_to_anchor=(0.4, 1.0), handlelength=1.2)
    return figure


def exposure_effects() -> Figure:
    """Draw the loss of amplitude by the exposure, and the bias of a fit of sharp images."""
    figure, axes = new_figure(2.8, 1, 2)
    share = np.linspace(0.0, 1.6, 200)
    axes[0].plot(share, np.sinc(share), color=BLUE)
    cases = ((80, 60e-6, GREEN), (2000, 50e-6, VIOLET), (80, 3e-3, ORANGE), (300, 2e-3, RED))
    for frequency, exposure, colour in cases:
        at = frequency * exposure
        text = f"{frequency} Hz, {1e6 * exposure:.0f} µs: {np.sinc(at):.4f}"
        axes[0].plot(at, np.sinc(at), "o", color=colour, markersize=5, label=text)
    axes[0].legend(loc="upper right", fontsize=8, handlelength=0.8)
    axes[0].set(xlabel="f·T, frequency × exposure", ylabel="amplitude over its true value", ylim=(-0.25, 1.08))
    axes[0].axhline(0.0, color=GREY, linewidth=0.8)
    axes[0].set_title("sin(πfT)/(πfT), corrected")
    turn = np.geomspace(0.02, 1.0, 100)
    for amplitude, colour in ((0.5, GREEN), (1.5, ORANGE), (4.0, RED)):
        bias = (0.7 * amplitude) ** 2 * (2 * np.pi * turn) ** 4 / 2880
        shown = bias < 0.3
        axes[1].loglog(turn[shown], 100 * bias[shown], color=colour, label=f"{amplitude:g} px")
    axes[1].axhline(1e-3, color=GREY, linewidth=1.0, linestyle="--")
    axes[1].text(0.98, 4e-4, "corrected above this line", fontsize=8, color=GREY, ha="right")
    axes[1].set(xlabel="f·T", ylabel="error in %, if treated as sharp", ylim=(1e-6, 40))
    axes[1].set_title("blur along the path, by amplitude")
    axes[1].legend(loc="lower right")
    return figure


def control_chart() -> Figure:
    """Draw a control chart of a simulated sensor whose sensitivity changes once."""
    rng = np.random.default_rng(4)
    relative = 5e-4 * rng.standard_normal(45) + np.where(np.arange(45) < 30, 0.0, 6e-3)
    facts = {"serial": "1234", "channel": "Fz", "component": "Fz", "kind": "element", "unit": "", "frequency_hz": 80.0}
    numbers = {"u_magnitude": 7e-4, "phase_rad": 0.0, "u_phase_rad": 1e-3}
    days = [date(2023, 1, 9) + timedelta(days=25 * number) for number in range(len(relative))]
    rows = [
        facts | numbers | {"date": day, "magnitude": 1.0 + value}
        for day, value in zip(days, relative.tolist(), strict=True)
    ]
    chart = control_charts(rows, 30)[0]
    years, limit = np.array([year_of(day) for day in days]), 3.0 * chart.sigma
    figure, axes = new_figure(2.6)
    for chosen, colour, label in ((~chart.outside, BLUE, "within"), (chart.outside, RED, "beyond the limits")):
        deviation = 100.0 * (chart.value[chosen] - chart.centre)
        axes.errorbar(years[chosen], deviation, 0.14, fmt="o", ms=3, color=colour, lw=0.8, label=label)
    axes.axhline(0.0, color=GREY, lw=0.8)
    for side in (-1.0, 1.0):
        axes.axhline(100.0 * side * limit, color=RED, lw=0.9, ls="--")
    axes.set(xlabel="year", ylabel="deviation from the mean / %")
    axes.legend(loc="upper left")
    axes.set_title("Mean of each day with U (k = 2), and limits from the first 30 days")
    return figure


DRAWINGS = (
    instrument_places,
    trigger_wiring,
    trigger_pulses,
    reflections,
    laboratory_day,
    rolling_shutter,
    exposure_effects,
    control_chart,
)
