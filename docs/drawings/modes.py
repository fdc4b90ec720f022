"""Drawings of an elastic load: shapes that images measure, the force that it adds, places of lasers."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from style import BLUE, GREY, ORANGE, RED, blank, new_figure

from fusion.simulate.preset import PlateSpec, Preset, read_preset
from fusion.simulate.world import MEAN_SHAPE, MEAN_SQUARE_SHAPE, plate_shape
from photogram.direct.surface import PlainShapes

DRIVEN_HZ = 1020.3
LASERS = (0.31, 0.50, 0.76)


def mode_shapes() -> Figure:
    """Show the six general shapes of a round face: colours across it, arrows along it."""
    line = np.linspace(-1.0, 1.0, 201)
    u, v = np.meshgrid(line, line)
    inside = np.hypot(u, v) <= 1.0
    shapes = PlainShapes(np.zeros(3), np.eye(3), 1.0)
    points = np.stack([u[inside], v[inside], np.zeros(inside.sum())], axis=1)
    moved = np.full((6, *u.shape, 3), np.nan)
    moved[:, inside] = shapes(points)
    figure, axes = new_figure(4.6, 2, 3)
    for number, (part, name) in enumerate(zip(axes.ravel(), shapes.names, strict=True)):
        blank(part, (-1.45, 1.45), (-1.45, 1.45))
        turn = np.linspace(0.0, 2.0 * np.pi, 200)
        part.plot(np.cos(turn), np.sin(turn), color=GREY, linewidth=1.0)
        if number < 3:
            shown = part.contourf(u, v, moved[number, ..., 2], np.linspace(-1.0, 1.0, 11), cmap="RdBu_r")
        else:
            coarse = (slice(10, -1, 36), slice(10, -1, 36))
            along = moved[number][coarse]
            part.quiver(
                u[coarse], v[coarse], along[..., 0], along[..., 1], color=BLUE, scale=7.0, width=0.012, pivot="mid"
            )
        part.set_title(name)
    bar = figure.colorbar(shown, ax=axes[0], shrink=0.8, ticks=[-1, 0, 1])
    bar.set_label("displacement across\nthe face / amplitude")
    return figure


def elastic_force() -> Figure:
    """Show the force of a load with a bending plate, and the place where a laser sees that force."""
    preset = read_preset(Preset, "bending")
    plate, mass_kg = preset.plate, sum(body.mass for body in (preset.internal, preset.load, *preset.parts))
    assert plate is not None
    figure, (force, laser) = new_figure(2.9, 1, 2)
    frequency_hz, radius = np.linspace(50.0, 2000.0, 400), np.linspace(0.0, 1.0, 200)
    for factor, style in (
        (1.0, "-"),
        (1.0 - plate.frequency_uncertainty, "--"),
        (1.0 + plate.frequency_uncertainty, ":"),
    ):
        name = f"{1e-3 * factor * plate.frequency:.2f} kHz"
        over = 1.0 + plate.mass * MEAN_SHAPE / mass_kg * _rim_ratio(plate, frequency_hz, factor)
        force.plot(frequency_hz, 100.0 * (np.abs(over) - 1.0), style, color=BLUE, linewidth=1.2, label=name)
        rim = _rim_ratio(plate, np.array([DRIVEN_HZ]), factor)
        seen = (1.0 + plate.mass * MEAN_SHAPE / mass_kg * rim) / (1.0 + plate_shape(radius) * rim)
        laser.plot(radius, 100.0 * (np.abs(seen) - 1.0), style, color=ORANGE, linewidth=1.2, label=name)
    force.axvline(DRIVEN_HZ, color=GREY, linewidth=0.8)
    force.set(xlabel="frequency / Hz", ylabel="force over mass × a(foot) − 1 / %", ylim=(0.0, None), xlim=(0.0, 2000.0))
    force.legend(title="natural frequency", fontsize=7.5, title_fontsize=7.5, frameon=False)
    force.set_title("Force of a load whose top bends")
    laser.axhline(0.0, color=GREY, linewidth=0.8)
    for place in LASERS:
        laser.axvline(place, color=RED, linewidth=0.8, linestyle="-.")
        laser.text(place + 0.01, -3.7, f"{place:.2f}", fontsize=7.5, color=RED)
    laser.set(xlabel="radius of the laser spot / radius of the plate", ylabel="force over mass × a(spot) − 1 / %")
    laser.set_title(f"Effect of the laser's place, {DRIVEN_HZ:.0f} Hz")
    return figure


def _rim_ratio(plate: PlateSpec, frequency_hz: NDArray[np.float64], factor: float) -> NDArray[np.complex128]:
    """Return the acceleration of the rim relative to the middle, over that of the foot."""
    natural, omega = 2.0 * np.pi * plate.frequency * factor, 2.0 * np.pi * frequency_hz
    denominator = natural**2 - omega**2 + 2j * plate.damping * natural * omega
    return np.asarray(omega**2 * MEAN_SHAPE / MEAN_SQUARE_SHAPE / denominator)


DRAWINGS = (mode_shapes, elastic_force)
