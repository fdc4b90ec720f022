"""Load characteristics and identification: resonance over the load, springs, dampers and chains."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, new_figure

from shaker import MassChain
from shaker.mechanics import shared_spring
from shaker.release.load_model import LoadModel, load_curve, rigid_formula_hz

SENSOR = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, 1.89e6, 4.0)
"""The simulated sensor of the preset `loads`."""


def _exchanged(model: LoadModel, load_mass: float) -> LoadModel:
    """Return the other solution with the same poles at one load mass."""
    assert model.coupling_stiffness is not None
    assert model.coupling_damping is not None
    up, down = (model.moving_mass + load_mass) / load_mass, load_mass / (model.moving_mass + load_mass)
    k, c, kl, cl = model.stiffness, model.damping, model.coupling_stiffness, model.coupling_damping
    return LoadModel("Fy", "Fy", "V", model.moving_mass, kl * up, cl * up, k * down, c * down)


def load_characteristic() -> Figure:
    """Both resonances over the load mass, the formula of a rigid load, and three load limits."""
    figure, axes = new_figure(3.2)
    grams = np.linspace(0.0, 250.0, 5001)
    curve = load_curve(SENSOR, grams / 1e3)
    rigid = np.array([rigid_formula_hz(SENSOR, m) for m in grams / 1e3])
    first = curve.frequency_hz[:, 0]
    axes.plot(grams, first, color=BLUE, label="three masses: resonance")
    axes.plot(grams, rigid, color=GREY, linestyle="--", label="rigid load: √(k/(m$_E$ + m$_L$))/2π")
    formula = float(grams[np.argmax(rigid > 1.05 * first)])
    change = float(grams[np.argmax(first < 0.95 * first[0])])
    target = float(grams[np.argmax(first < 400.0)])
    for at, text, color, place, side in (
        (change, "resonance 5 % below\nthat without load", GREEN, (25, 265), "left"),
        (formula, "formula 5 % above\nthe resonance", ORANGE, (80, 315), "right"),
        (target, "resonance of 400 Hz", RED, (94, 265), "left"),
    ):
        height = float(np.interp(at, grams, first))
        axes.plot([at, at], [250, height], color=color, linewidth=0.9, linestyle=":")
        axes.plot([at], [height], "o", color=color, markersize=5)
        axes.text(*place, f"{text}:\n{at:.0f} g", color=color, fontsize=8, ha=side)
    recorded = np.array([0.0, 8.0, 48.0, 98.0, 198.0])
    axes.plot(recorded, np.interp(recorded, grams, first), "x", color=BLUE, markersize=7, label="recorded loads")
    axes.set(xlabel="load mass $m_L$ / g", ylabel="resonance / Hz", xlim=(-3, 250), ylim=(250, 520))
    axes.set_title("Load characteristic of the example")
    axes.legend(fontsize=8, loc="upper right")
    return figure


def load_solutions() -> Figure:
    """Two models with the same resonances at one load mass."""
    figure, (left, right) = new_figure(2.9, 1, 2)
    known = 0.048
    other = _exchanged(SENSOR, known)
    grams = np.linspace(0.5, 250.0, 300)
    for model, color, label in ((SENSOR, BLUE, "solution 1"), (other, ORANGE, "solution 2")):
        curve = load_curve(model, grams / 1e3)
        text = f"{label}: k = {model.stiffness / 1e6:.2f}, $k_L$ = {model.coupling_stiffness / 1e6:.2f} MN/m"  # type: ignore[operator]
        left.plot(grams, curve.frequency_hz[:, 0], color=color, label=text)
        right.plot(grams, curve.frequency_hz[:, 1], color=color)
    for axes, mode in ((left, 0), (right, 1)):
        hertz = float(load_curve(SENSOR, np.array([known])).frequency_hz[0, mode])
        axes.plot([1e3 * known], [hertz], "o", color=RED, markersize=6)
        axes.annotate(
            "recorded load:\n48 g",
            (1e3 * known, hertz),
            (100, 620 if mode == 0 else 1800),
            fontsize=8,
            color=RED,
            arrowprops={"arrowstyle": "-", "color": RED, "linewidth": 0.6},
        )
        axes.set(xlabel="load mass $m_L$ / g", ylabel="resonance / Hz")
    left.set(title="First resonance", ylim=(200, 1300))
    right.set(title="Second resonance", ylim=(600, 3200))
    left.legend(fontsize=7.5, loc="upper right")
    return figure


def mass_line() -> Figure:
    """Reciprocal squared resonance over the load mass: slope and intercept give spring and internal mass."""
    figure, axes = new_figure(2.8)
    k, internal = 4.5e8, 0.7657
    loads = np.array([4.236, 8.798])
    hertz = np.sqrt(k / (loads + internal)) / (2 * np.pi)
    stiffness, mass = shared_spring(hertz, loads)
    line = np.linspace(-1.2, 10.0, 50)
    axes.plot(line, 1e9 * (line + mass) / stiffness, color=BLUE)
    axes.plot(loads, 1e9 / (2 * np.pi * hertz) ** 2, "o", color=RED)
    for load, f in zip(loads, hertz, strict=True):
        axes.text(
            load - 0.15,
            1e9 / (2 * np.pi * f) ** 2 + 0.5,
            f"{f:.0f} Hz with {load:.3f} kg",
            fontsize=8,
            color=RED,
            ha="right",
        )
    axes.plot([-mass], [0.0], "s", color=GREEN)
    axes.annotate(
        f"−m$_i$ = −{mass:.3f} kg",
        (-mass, 0.0),
        (0.15, 9.0),
        fontsize=8,
        color=GREEN,
        arrowprops={"arrowstyle": "-", "color": GREEN, "linewidth": 0.6},
    )
    axes.text(5.6, 11.5, f"slope 1/k,  k = {stiffness / 1e8:.2f} × 10⁸ N/m", fontsize=8, color=BLUE, va="center")
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.axvline(0.0, color=GREY, linewidth=0.6)
    axes.set(xlabel="load mass $m$ / kg", ylabel="$1/(2πf_0)^2$ / 10$^{-9}$ s²", xlim=(-1.2, 10), ylim=(-1.5, 25))
    axes.set_title("Two load masses separate stiffness and internal mass")
    return figure


def damping_laws() -> Figure:
    """Force over deflection of damper, loss factor and dry friction, and their loss over frequency and amplitude."""
    figure, (left, middle, right) = new_figure(2.7, 1, 3)
    turn = np.linspace(0.0, 2 * np.pi, 401)
    x, v = np.cos(turn), -np.sin(turn)
    loss = 0.3
    left.plot(x, x + loss * v, color=BLUE, label="damper")
    left.plot(x, x + loss * v, color=ORANGE, linestyle=(0, (4, 3)), label="loss factor")
    left.plot(x, x + 0.25 * np.sign(v), color=GREEN, label="dry friction")
    left.set(xlabel="deflection / amplitude", ylabel="force / (k × amplitude)", title="One frequency")
    left.set(ylim=(-1.3, 1.75), xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    left.legend(fontsize=7.5, loc="upper left")
    ratio = np.linspace(0.2, 3.0, 100)
    middle.plot(ratio, loss * ratio, color=BLUE)
    middle.plot(ratio, np.full(100, loss), color=ORANGE, linestyle="--")
    middle.axhline(1.0, color=GREY, linewidth=0.8)
    middle.text(0.3, 0.97, "storage: k", ha="left", va="top", fontsize=8, color=GREY)
    middle.text(1.9, 0.62, "loss: ωb", ha="right", fontsize=8, color=BLUE)
    middle.text(3.0, 0.27, "loss: ηk", ha="right", va="top", fontsize=8, color=ORANGE)
    middle.set(
        xlabel="frequency / first resonance", ylabel="part of the stiffness / k", title="Over frequency", ylim=(0, 1.1)
    )
    mass = np.linspace(2.0, 12.0, 100)
    hertz = np.sqrt(4.5e8 / (mass + 0.77)) / (2 * np.pi)
    damper = 900.0 * np.pi * hertz / 4.5e8
    right.plot(mass, 100 * damper, color=BLUE, label="damper")
    at = np.interp(4.236, mass, damper)
    right.plot(mass, np.full(100, 100 * at), color=ORANGE, linestyle="--", label="loss factor")
    right.set(xlabel="load mass / kg", ylabel="damping ratio / %", title="Over the load", ylim=(0, 1.5))
    right.legend(fontsize=7.5, loc="lower left")
    return figure


def transmissibility() -> Figure:
    """Transmissibility of the two loads and its circle in the complex plane."""
    figure, (left, right) = new_figure(3.0, 1, 2, width_ratios=(1.5, 1))
    for load, color in ((4.236, BLUE), (8.798, ORANGE)):
        chain = MassChain(("load",), np.array([load + 0.7657]), np.array([4.5e8]), np.array([900.0]))
        frequency = np.linspace(800.0, 1800.0, 4000)
        value = chain.transfer(frequency, "load").value[:, 0]
        left.plot(frequency, np.abs(value), color=color, label=f"load {load:.3f} kg")
        right.plot(value.real, value.imag, color=color)
    left.set(
        xlabel="frequency / Hz", ylabel="|$H$| = load / base", yscale="log", ylim=(0.5, 250), title="Transmissibility"
    )
    left.legend(fontsize=8, loc="upper right")
    right.set(xlabel="Re $H$", ylabel="Im $H$", aspect="equal", title="Nyquist circle")
    return figure


def chain_or_damper() -> Figure:
    """Sensitivity over frequency: a lag of the chain, and the damper that the resonance shows."""
    figure, (left, right) = new_figure(2.7, 1, 2)
    frequency = np.linspace(10.0, 1100.0, 300)
    s = 2j * np.pi * frequency
    delay = 50e-6
    for value, color, style, label in (
        (1 / (1 + s * 2e-6), GREY, "-", "damper alone, b/k = 2 µs"),
        (1 / (1 + s * 2e-6) / (1 + 50e-6 * s), BLUE, "-", "and a lag of 50 µs"),
        (1 / (1 + s * 2e-6) * np.exp(-delay * s), VIOLET, "--", "and a delay of 50 µs"),
    ):
        left.plot(frequency, 100 * (np.abs(value) - 1), color=color, linestyle=style, label=label)
        right.plot(frequency, np.angle(value), color=color, linestyle=style)
    left.set(
        xlabel="frequency / Hz", ylabel="change of |S| / %", title="Magnitude of the sensitivity", ylim=(-6.5, 2.5)
    )
    left.legend(fontsize=7.5, loc="upper left")
    right.set(xlabel="frequency / Hz", ylabel="phase / rad", title="Phase of the sensitivity")
    return figure


DRAWINGS = (load_characteristic, load_solutions, mass_line, damping_laws, transmissibility, chain_or_damper)
