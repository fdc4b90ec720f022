"""Compensation of a sensor's dynamics and decoupling of its outputs."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, new_figure

from shaker import Compensation, CompensationFilter, design_decoupling
from shaker.compensation.effects import gain_band, white_noise_gain
from shaker.compensation.filter import (
    CompensationTarget,
    band_ratio,
    best_damping,
    discretise,
    loaded_dynamics,
    single_mode,
)
from shaker.decoupling.filter import DecouplingTarget, SignalLevels, static_inverse, step_readings
from shaker.decoupling.model import MultiModel
from shaker.release.load_model import LoadModel

SENSOR_HZ, SENSOR_ZETA = 500.0, 0.02


def compensation_effect() -> Figure:
    """Poles, gain and step response of one mode before and after the filter."""
    figure, (poles, gain, step) = new_figure(2.9, 1, 3)
    filtered = Compensation(single_mode(SENSOR_HZ, SENSOR_ZETA), CompensationTarget(1000.0, 0.6))
    sensor, whole = filtered.sensor.system, filtered.compensated
    for system, color, label in ((sensor, RED, "sensor"), (whole, BLUE, "with filter")):
        place = system.poles / (2 * np.pi)
        poles.plot(place.real, place.imag, "x", color=color, markersize=8, markeredgewidth=2)
        frequency = np.linspace(1.0, 1500.0, 1500)
        gain.plot(frequency, np.abs(system.response(frequency)), color=color)
        time_s = np.linspace(0.0, 0.02, 2000)
        step.plot(1e3 * time_s, system.step(time_s), color=color, label=label, linewidth=1.2)
    near = np.array([0.0, 500.0])
    poles.annotate("", (-600, 800), (-30, 530), arrowprops={"arrowstyle": "->", "color": GREY})
    poles.plot(
        filtered.system.zeros.real / 2 / np.pi,
        filtered.system.zeros.imag / 2 / np.pi,
        "o",
        color=RED,
        markerfacecolor="none",
        markersize=11,
    )
    poles.text(-80, near[1] - 210, "500 Hz,\nζ = 0.02", color=RED, fontsize=8, ha="right")
    poles.text(-700, 930, "1000 Hz, ζ = 0.6", color=BLUE, fontsize=8, ha="left")
    poles.axhline(0, color=GREY, linewidth=0.6)
    poles.axvline(0, color=GREY, linewidth=0.6)
    poles.set(xlabel="Re $p$ / 2π / Hz", ylabel="Im $p$ / 2π / Hz", xlim=(-900, 200), ylim=(-1100, 1200), title="Poles")
    gain.axhspan(0.9, 1.1, color=GREEN, alpha=0.2, linewidth=0)
    gain.text(1480, 1.17, "±10 %", color=GREEN, fontsize=8, ha="right")
    gain.set(xlabel="frequency / Hz", ylabel="gain / static gain", ylim=(0, 3), xlim=(0, 1500), title="Gain")
    step.set(xlabel="time / ms", ylabel="output / final value", ylim=(0, 2.4), xlim=(0, 20), title="After a step")
    step.legend(fontsize=8, loc="upper right")
    return figure


def best_damping_ratio() -> Figure:
    """Gain of one mode for three damping ratios within a permitted error of 10 %."""
    figure, axes = new_figure(2.7)
    frequency = np.linspace(0.0, 1.3, 800)
    for zeta, color, style in ((0.5, RED, "-"), (best_damping(0.1), BLUE, "-"), (0.6, ORANGE, "--"), (0.8, GREY, ":")):
        label = f"ζ = {zeta:.3f}: within ±10 % up to {band_ratio(zeta, 0.1):.2f}"
        axes.plot(
            frequency, 1 / np.abs(1 - frequency**2 + 2j * zeta * frequency), color=color, linestyle=style, label=label
        )
    axes.axhspan(0.9, 1.1, color=GREEN, alpha=0.2, linewidth=0)
    axes.set(
        xlabel="frequency / natural frequency of the target",
        ylabel="gain / static gain",
        ylim=(0.6, 1.25),
        xlim=(0, 1.3),
    )
    axes.set_title("Permitted error of ±10 %: only one damping ratio touches both limits")
    axes.legend(fontsize=8, loc="lower left")
    return figure


def compensation_cost() -> Figure:
    """Noise over the target frequency, and the uncertainty of the gain from that of the model."""
    figure, (left, right) = new_figure(2.8, 1, 2)
    model = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, 1.89e6, 4.0)
    one, loaded = loaded_dynamics(model, 0.0), loaded_dynamics(model, 0.198, modes=2)
    hertz = np.geomspace(500.0, 2000.0, 25)
    for sensor, color, low_pass, label in (
        (one, BLUE, None, "no load, one mode"),
        (loaded, ORANGE, None, "198 g, two modes"),
        (loaded, ORANGE, 2000.0, "198 g, low-pass 2 kHz"),
    ):
        targets = [CompensationTarget(float(f), 0.577, None, low_pass) for f in hertz]
        noise = [white_noise_gain(discretise(Compensation(sensor, target), 100e3)) for target in targets]
        left.plot(hertz, noise, color=color, linestyle="--" if low_pass else "-", label=label)
    left.set(xlabel="frequency of the target / Hz", ylabel="factor of white noise", yscale="log", xscale="log")
    left.set(title="Noise at 100 kHz", xticks=[500, 1000, 2000], xticklabels=["500", "1000", "2000"])
    left.minorticks_off()
    left.legend(fontsize=7.5, loc="upper left")
    frequency = np.linspace(1.0, 1000.0, 1200)
    for share, color in ((1e-4, BLUE), (3e-4, VIOLET), (1e-3, ORANGE)):
        sensor = single_mode(500.0, 0.004)
        covariance = np.zeros((len(sensor.vector),) * 2)
        covariance[0, 0] = (share * 500.0) ** 2
        known = type(sensor)(**{**vars(sensor), "covariance": covariance})
        band = gain_band(Compensation(known, CompensationTarget(1000.0, 0.54)), frequency)
        right.plot(frequency, 100 * band.u_gain, color=color, label=f"u(f$_n$) = {100 * share:g} %")
    right.set(
        xlabel="frequency / Hz",
        ylabel="u of the gain / %",
        yscale="log",
        ylim=(1e-3, 100),
        title="Model with ζ = 0.004",
    )
    right.legend(fontsize=7.5, loc="upper left")
    return figure


def filter_switch() -> Figure:
    """Output when the filter changes with the load: state computed anew, and state kept."""
    figure, axes = new_figure(2.6)
    model = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, 1.89e6, 4.0)
    rate = 20e3
    target = CompensationTarget(1000.0, 0.6)
    filters = [
        discretise(Compensation(loaded_dynamics(model, m, modes=n), target), rate) for m, n in ((0.0, 1), (0.198, 1))
    ]
    time_s = np.arange(400) / rate
    signal = 1.0 + 0.3 * np.sin(2 * np.pi * 60.0 * time_s)
    at = 220
    device = CompensationFilter(filters[0], channels=1, level=None)
    first = device(signal[None, :at])
    device.switch(filters[1])
    smooth = np.concatenate([first, device(signal[None, at:])], axis=1)[0]
    sos = [one.sos[0] for one in filters]
    state = np.zeros(2)
    b, a = sos[0][:3], sos[0][3:]
    state[1] = (b[2] - a[2]) * signal[0]
    state[0] = (b[1] - a[1]) * signal[0] + state[1]
    kept = []
    for index, x in enumerate(signal):
        b, a = (sos[0] if index < at else sos[1])[:3], (sos[0] if index < at else sos[1])[3:]
        y = b[0] * x + state[0]
        state = np.array([b[1] * x - a[1] * y + state[1], b[2] * x - a[2] * y])
        kept.append(y)
    axes.plot(1e3 * time_s, kept, color=RED, linewidth=1.0, label="internal state kept")
    axes.plot(1e3 * time_s, smooth, color=BLUE, label="state computed from the last inputs and outputs")
    axes.axvline(1e3 * time_s[at], color=GREY, linestyle=":", linewidth=1.0)
    axes.set(
        xlabel="time / ms", ylabel="output / mean", title="Switch of the filter from no load to 198 g", xlim=(5, 20)
    )
    axes.legend(fontsize=8, loc="upper right")
    return figure


def _coupled() -> MultiModel:
    """Return a sensor of two components whose modes appear in both outputs."""
    hertz, zeta = np.array([1700.0, 2000.0]), np.array([0.015, 0.015])
    omega = 2 * np.pi * hertz
    outputs = np.array([[1.0, 0.05], [-0.04, 1.0]])  # shares (C, M) of the outputs in the modes
    loads = np.array([[1.0, -0.03], [0.06, 1.0]])  # shares (D, M) of the loads in the modes
    residue = np.stack([-0.5j * w / np.sqrt(1 - z**2) * np.outer(outputs[:, m], loads[:, m])
                        for m, (w, z) in enumerate(zip(omega, zeta, strict=True))])  # fmt: skip
    names = ("Fx", "Fz")
    return MultiModel(names, names, "V", hertz, zeta, residue, np.zeros(0), np.zeros((0, 2, 2)))


def crosstalk_stages() -> Figure:
    """Both loads read while one of them steps: outputs alone, static matrix, filter."""
    figure, panels = new_figure(3.2, 2, 3, sharex=True, height_ratios=(1.3, 1))
    model, rate = _coupled(), 100e3
    noise = np.full(2, 0.01)
    recorded = SignalLevels(rate, noise, np.full(2, 1.0))
    decoupler = design_decoupling(model, DecouplingTarget(np.full(2, 850.0), np.full(2, 0.6)), recorded)
    time_s = np.arange(800) / rate
    raw = np.diag(1.0 / np.diag(model.static_gain))
    stages = (("each output alone", raw), ("static matrix", static_inverse(model, noise)), ("filter", decoupler))
    for column, (title, reader) in enumerate(stages):
        read = step_readings(model, reader, time_s)
        panels[0, column].plot(1e3 * time_s, read[:, 0, 0], color=BLUE, linewidth=1.0)
        panels[1, column].plot(1e3 * time_s, 100 * read[:, 1, 0], color=RED, linewidth=1.0)
        panels[0, column].set(title=title, ylim=(-0.05, 2.1), xlim=(0, 8))
        panels[1, column].set(xlabel="time / ms", ylim=(-22, 22))
    panels[0, 0].set_ylabel("Fx read / Fx")
    panels[1, 0].set_ylabel("Fz read / Fx / %")
    return figure


DRAWINGS = (compensation_effect, best_damping_ratio, compensation_cost, filter_switch, crosstalk_stages)
