"""Figures of the guides: principle, matrix, mountings, linked rounds, aliases, gravity, a sweep at rest."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from scipy.signal import chirp
from scipy.stats import t as student
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, blank, new_figure

from fusion.simulate.sines import SETUPS, runs
from fusion.simulate.world import Draws, make_world
from shaker import lines_of
from shaker.labels import LOAD_COMPONENTS
from shaker.lines.rate_planner import PREFERRED
from shaker.sine.aliasing import alias_frequency


def _box(axes: Any, corner: tuple[float, float], size: tuple[float, float], text: str, colour: str) -> None:
    axes.add_patch(Rectangle(corner, *size, facecolor=colour, edgecolor="black", alpha=0.35, linewidth=1.0))
    axes.text(corner[0] + size[0] / 2, corner[1] + size[1] / 2, text, ha="center", va="center")


def _arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], colour: str, style: str = "-|>") -> None:
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle=style, mutation_scale=12, color=colour, linewidth=1.6))


def measurement_principle() -> Figure:
    """Shaker, sensor and load mass with the instruments, and the quantities that they give."""
    figure, axes = new_figure(3.1)
    blank(axes, (0, 10), (0, 4.3))
    _box(axes, (2.9, 0.1), (2.2, 0.8), "shaker", GREY)
    _box(axes, (3.3, 0.95), (1.4, 0.35), "base", GREY)
    _box(axes, (3.4, 1.35), (1.2, 0.6), "sensor", ORANGE)
    _box(axes, (3.0, 2.0), (2.0, 1.0), "load mass m", BLUE)
    for x in (0.3, 1.3):
        _box(axes, (x, 3.5), (0.9, 0.45), "", VIOLET)
        _arrow(axes, (x + 0.9, 3.55), (3.25, 3.02), VIOLET, "-")
    axes.text(1.25, 3.3, "stereo cameras:\nsix components,\nsampled at the beat", ha="center", va="top", color=VIOLET)
    _box(axes, (4.6, 3.6), (1.5, 0.45), "laser", GREEN)
    _arrow(axes, (4.8, 3.6), (4.8, 3.02), GREEN)
    axes.text(4.95, 3.32, "velocity along z", color=GREEN, va="center")
    _arrow(axes, (2.6, 2.1), (2.6, 2.9), BLUE, "<|-|>")
    axes.text(2.45, 2.5, "a", color=BLUE, ha="right", va="center", fontsize=11)
    _arrow(axes, (4.6, 1.65), (6.1, 1.65), ORANGE)
    axes.text(5.35, 1.75, "bridge output", color=ORANGE, ha="center", va="bottom")
    axes.text(6.3, 2.75, "acceleration a of the load mass,\nsix components (fused)", color=BLUE, va="center")
    axes.text(6.3, 2.2, "load = mass matrix · a", color=BLUE, va="center")
    axes.text(6.3, 1.65, "output phasor", color=ORANGE, va="center")
    axes.text(6.3, 1.0, "sensitivity = output / load", weight="bold", va="center")
    axes.text(6.3, 0.55, "magnitude and phase, each with U", va="center")
    return figure


def matrix_equation() -> Figure:
    """Outputs = matrix · loads of eight excitations, with the numbers of the preset `matrix` at 80 Hz."""
    loads, outputs, matrix = [], [], np.zeros((6, 6))
    for run in runs("matrix"):
        world = make_world(run.preset, Draws(1, systematic=False), 0.0)
        capacity = np.array(run.preset.capacity)
        rated = np.diagonal(world.static_stated) * capacity
        loads.append(np.abs(world.load_wrench[0]) / capacity)
        outputs.append(np.abs(world.outputs[0]) / rated)
        matrix = 100.0 * np.abs(world.sensitivity[0]) * capacity / rated[:, None]
    figure, axes = new_figure(2.5, 1, 3, width_ratios=(8, 6, 8))
    excitations = [f"{axis} {arm}".strip() for axis, arm in SETUPS]
    parts = (
        (axes[0], 100 * np.array(outputs).T, "outputs / %", excitations),
        (axes[1], matrix, "sensitivity / %", list(LOAD_COMPONENTS)),
        (axes[2], 100 * np.array(loads).T, "loads / %", excitations),
    )
    for panel, values, title, names in parts:
        panel.imshow(np.log10(values), vmin=-3, vmax=2, cmap="Blues", aspect="equal")
        for (row, column), value in np.ndenumerate(values):
            text = f"{value:.0f}" if value >= 9.5 else f"{value:.1f}" if value >= 0.05 else "0"
            shade = "white" if value > 3 else "black"
            panel.text(column, row, text, ha="center", va="center", fontsize=7.5, color=shade)
        panel.set_title(title)
        panel.set_xticks(range(len(names)), names, rotation=60, fontsize=7.5)
        panel.set_yticks(range(6), LOAD_COMPONENTS, fontsize=7.5)
        panel.tick_params(length=0)
        panel.spines[:].set_visible(False)
    for panel, sign in zip(axes[1:], ("=", "·"), strict=True):
        panel.text(-0.28, 0.5, sign, transform=panel.transAxes, fontsize=15, ha="center", va="center")
    return figure


def mountings() -> Figure:
    """Two ways of scatter, and U of the mean over the number of mountings."""
    figure, (left, right) = new_figure(2.7, 1, 2)
    within, between = 0.02, 0.05
    rng = np.random.default_rng(5)
    place, values = 0, []
    for mounting in range(4):
        mean = between * rng.standard_normal()
        values.append(mean + within * rng.standard_normal(3))
        x = place + np.arange(3)
        left.plot(x, values[-1], "o", color=BLUE)
        left.fill_between(
            [x[0] - 0.4, x[-1] + 0.4],
            *(values[-1].mean() + np.array([-2, 2]) * within),
            color=BLUE,
            alpha=0.15,
            linewidth=0,
        )
        left.text(x.mean(), 0.135, f"mounting {mounting + 1}", ha="center", fontsize=8)
        place += 4
    means = np.array([one.mean() for one in values])
    half = student.ppf(0.975, 3) * means.std(ddof=1) / 2.0
    left.axhspan(means.mean() - half, means.mean() + half, color=ORANGE, alpha=0.2, linewidth=0)
    left.axhline(means.mean(), color=ORANGE)
    left.set(xticks=[], ylim=(-0.16, 0.16), ylabel="deviation / %", title="Repeats scatter less than mountings")
    number = np.arange(2, 9)
    total = np.sqrt((between**2 + within**2 / 3) / number)
    right.plot(
        number,
        student.ppf(0.975, number - 1) * total,
        "o-",
        color=ORANGE,
        label="U = k·u with M − 1 degrees of freedom",
    )
    right.plot(number, 2 * total, "--", color=GREY, label="2·u")
    right.set(
        xlabel="number of mountings M",
        ylabel="U of the mean / %",
        ylim=(0, 0.5),
        title="A third mounting reduces U most",
    )
    right.legend(fontsize=8)
    return figure


def linked_rounds() -> Figure:
    """A regional round linked to a key comparison by a pilot."""
    figure, axes = new_figure(2.6)
    blank(axes, (0, 10), (0, 4), "auto")
    for x, title, artefact in ((0.2, "key comparison", "artefact A"), (7.2, "regional round", "artefact B")):
        axes.add_patch(Rectangle((x, 0.3), 3.4 if x < 1 else 2.5, 3.2, facecolor="none", edgecolor=GREY, linewidth=1.0))
        axes.text(x + (1.7 if x < 1 else 1.25), 3.6, title, ha="center", weight="bold")
        axes.text(x + (1.7 if x < 1 else 1.25), 3.15, artefact, ha="center", color=GREY)
    for y, name in ((2.3, "kc/nist"), (1.5, "kc/cem")):
        _box(axes, (0.5, y), (1.5, 0.55), name, BLUE)
    _box(axes, (0.5, 0.6), (1.5, 0.55), "kc/ptb", ORANGE)
    axes.text(2.55, 1.9, "reference\nvalue", ha="left", va="center", color=BLUE)
    for y in (2.57, 1.77, 0.87):
        _arrow(axes, (2.05, y), (2.5, 1.9 + 0.2 * (y - 1.7)), BLUE)
    for y, name, colour in ((0.6, "rc/ptb", ORANGE), (2.3, "rc/lab", GREEN)):
        _box(axes, (7.7, y), (1.5, 0.55), name, colour)
    _arrow(axes, (2.05, 0.75), (7.65, 0.75), ORANGE, "<|-|>")
    axes.text(5.4, 0.85, "same laboratory:\ndifference of the artefacts", ha="center", va="bottom", color=ORANGE)
    _arrow(axes, (7.65, 2.57), (3.45, 2.0), GREEN)
    axes.text(5.4, 2.6, "degree of equivalence\nof the linked laboratory", ha="center", va="bottom", color=GREEN)
    return figure


def stroboscope() -> Figure:
    """A sine sampled below its frequency, and where five lines appear over the camera rate."""
    figure, (left, right) = new_figure(3.0, 1, 2)
    line, rate = 106.25, 57.565
    fine = np.linspace(0.0, 0.22, 3000)
    frames = np.arange(0.0, 0.22, 1 / rate)
    beat = alias_frequency(np.array([line]), rate)[0]
    left.plot(1e3 * fine, np.sin(2 * np.pi * line * fine), color=BLUE, linewidth=0.8, label=f"motion, {line} Hz")
    left.plot(1e3 * fine, -np.sin(2 * np.pi * beat * fine), color=ORANGE, label=f"beat, {beat:.2f} Hz")
    left.plot(1e3 * frames, np.sin(2 * np.pi * line * frames), "o", color=RED, label="frames", markersize=5)
    left.set(xlabel="time / ms", yticks=[], ylim=(-1.2, 1.9), title=f"A camera of {rate:.2f} frames per second")
    left.legend(fontsize=7.5, ncols=3, loc="upper center", columnspacing=1.0, handlelength=1.3)
    lines = lines_of([line], 5)
    rates = np.linspace(41.0, 82.0, 2000)
    for number, frequency in enumerate(lines.frequency_hz):
        seen = [alias_frequency(np.array([frequency]), one)[0] for one in rates]
        right.plot(rates, seen, linewidth=2.2 if number == 0 else 1.0, label=f"{number + 1}")
    right.fill_between(rates, PREFERRED[0] * rates, PREFERRED[1] * rates, color=GREEN, alpha=0.12, linewidth=0)
    for chosen, colour, side in ((rate, GREEN, "left"), (52.874, RED, "right")):
        right.plot([chosen, chosen], [0.0, 46.0], ":", color=colour)
        right.text(chosen, 44.0, f" {chosen:.2f} ", color=colour, fontsize=8, ha=side)
    right.set(xlabel="camera rate / Hz", ylabel="seen at / Hz", ylim=(0, 54), title="Aliases of the harmonics 1 to 5")
    right.legend(
        fontsize=7.5, ncols=5, loc="upper center", bbox_to_anchor=(0.5, 1.02), columnspacing=0.8, handlelength=1.0
    )
    return figure


def gravity_over_angle() -> Figure:
    """Forces of gravity on a sensor whose axis is horizontal, without and with load, over the angle of the head."""
    figure, (left, right) = new_figure(2.9, 1, 2, width_ratios=(2, 3))
    left.set(xlim=(-1.6, 1.6), ylim=(-1.7, 1.5), aspect="equal", title="Sensor on the head")
    left.axis("off")
    theta = np.deg2rad(35.0)
    left.add_patch(
        Rectangle(
            (-0.7, -0.7), 1.4, 1.4, angle=35.0, rotation_point="center", facecolor=BLUE, alpha=0.2, edgecolor="black"
        )
    )
    for angle, name, colour in ((theta, "x", BLUE), (theta + np.pi / 2, "y", ORANGE)):
        tip = 1.25 * np.array([np.cos(angle), np.sin(angle)])
        _arrow(left, (0.0, 0.0), tuple(tip), colour)
        left.text(*(1.12 * tip), name, color=colour, ha="center", va="center")
    _arrow(left, (0.0, 0.0), (0.0, -1.4), RED)
    left.text(0.1, -1.4, "weight W", color=RED, va="center")
    angle = np.linspace(0.0, 360.0, 400)
    readings = np.arange(0.0, 361.0, 22.5)
    gravity = 9.81249
    for mass, style, name in ((0.769, "--", "without load"), (0.769 + 6.9605, "-", "with load")):
        for sign, colour, axis, function in ((-1, BLUE, "Fx", np.sin), (-1, ORANGE, "Fy", np.cos)):
            right.plot(
                angle, sign * mass * gravity * function(np.deg2rad(angle)), style, color=colour, label=f"{axis} {name}"
            )
            right.plot(readings, sign * mass * gravity * function(np.deg2rad(readings)), ".", color=colour)
    right.set(
        xlabel="angle of the head / °",
        ylabel="force / N",
        xticks=range(0, 361, 90),
        ylim=(-95, 135),
        title="The amplitude is the weight",
    )
    right.legend(fontsize=7.5, ncols=2, loc="upper center")
    return figure


def rest_to_rest() -> Figure:
    """A sweep between two times at rest, with the ringing of a resonance."""
    figure, axes = new_figure(2.5)
    rate, begin, end = 8000.0, 0.1, 1.1
    time = np.arange(0.0, 1.5, 1 / rate)
    drive = np.where((time >= begin) & (time < end), chirp(time - begin, 20.0, end - begin, 200.0), 0.0)
    pole = 2 * np.pi * 120.0
    response = np.zeros_like(drive)  # semi-implicit steps of an oscillator of 120 Hz, damping ratio 0.02
    place = speed = 0.0
    for number, force in enumerate(drive):
        speed += (pole**2 * (force - place) - 2 * 0.02 * pole * speed) / rate
        place += speed / rate
        response[number] = place
    axes.plot(time, 0.35 * drive / np.abs(drive).max() + 1.1, color=BLUE, linewidth=0.7)
    axes.plot(time, 0.9 * response / np.abs(response).max() - 0.2, color=ORANGE, linewidth=0.7)
    for span in ((0.0, begin), (1.35, 1.5)):
        axes.axvspan(*span, color=GREEN, alpha=0.15, linewidth=0)
    axes.text(1.14, 1.3, "reference", color=BLUE, va="center")
    axes.text(1.14, 0.25, "response", color=ORANGE, va="center")
    axes.text(0.05, -1.25, "at rest:\nnoise", ha="center", va="center", fontsize=8)
    axes.text(0.6, -1.25, "sweep", ha="center", va="center", fontsize=8)
    axes.text(1.22, -1.25, "ringing", ha="center", va="center", fontsize=8)
    axes.text(1.425, -1.25, "at rest:\nnoise", ha="center", va="center", fontsize=8)
    axes.set(
        xlabel="time / s", yticks=[], ylim=(-1.6, 1.65), xlim=(0, 1.5), title="A record from rest to rest is one period"
    )
    return figure


DRAWINGS = (
    measurement_principle,
    matrix_equation,
    mountings,
    linked_rounds,
    stroboscope,
    gravity_over_angle,
    rest_to_rest,
)
