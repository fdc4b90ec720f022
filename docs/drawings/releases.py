"""Releases of a load, the record of a sensor, its model, and the figures that follow from the model."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mechanics import BLACK
from style import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, new_figure

from shaker import LinearSystem, StepRecord, fit_step, indices
from shaker.lti.system import ModalModel
from shaker.release.load_response import load_share
from shakercal._common.arrays import FloatArray

MODE_HZ, ZETA, AMPLIFIER_HZ = 1700.0, 0.015, 6000.0
RATE_HZ = 100e3


def _sensor(modes: tuple[tuple[float, float, float], ...] = ((MODE_HZ, ZETA, 1.0),), lag: bool = True) -> LinearSystem:
    """Return a sensor of modes (frequency, damping ratio, share), static gain 1, behind an amplifier."""
    total = None
    for hertz, zeta, share in modes:
        omega = 2 * np.pi * hertz
        upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
        part = ModalModel(
            np.array([hertz]),
            np.array([zeta]),
            np.array([share * omega**2 / (2j * upper.imag)]),
            np.zeros(0),
            np.zeros(0),
        )
        terms = part.terms
        total = terms if total is None else tuple(np.concatenate(pair) for pair in zip(total, terms, strict=True))
    assert total is not None
    system = LinearSystem.from_residues(*total)
    corner = 2 * np.pi * AMPLIFIER_HZ
    return system.times(LinearSystem(np.zeros(0, complex), np.array([-corner + 0j]), corner)) if lag else system


def _after(system: LinearSystem, time_s: FloatArray, load: FloatArray) -> FloatArray:
    """Return the response to a sampled load, linear between the samples."""
    response = system.impulse(time_s - time_s[0])
    rising = np.cumsum(0.5 * (response + np.concatenate([[0.0], response[:-1]]))) * (time_s[1] - time_s[0])
    change = np.diff(load, prepend=load[0])
    size = 2 * len(load)
    return np.asarray(np.fft.irfft(np.fft.rfft(change, size) * np.fft.rfft(rising, size), size)[: len(load)])


def release_shapes() -> Figure:
    """Fitted time courses of a release, and how strongly each drives a mode."""
    figure, (left, right) = new_figure(2.8, 1, 2)
    ms = np.linspace(-0.3, 1.6, 1500)
    length, onset = 1.0, 0.0
    frequency = np.linspace(1e-3, 4.0, 600)
    fine = np.linspace(-0.5, 12.0, 60001)
    for name, color, label in (
        ("step", GREY, "at once (step)"),
        ("ramp", BLUE, "evenly (ramp)"),
        ("smooth", ORANGE, "half a cosine (smooth)"),
        ("exponential", GREEN, "exponential"),
        ("stages", VIOLET, "two stages"),
    ):

        def share(time: FloatArray, name: str = name) -> FloatArray:
            if name == "stages":
                first, second = (np.clip((time - start) / 0.5, 0.0, 1.0) for start in (0.0, 0.5))
                return 0.7 * first + 0.3 * second
            return load_share(name, time, onset, length)  # type: ignore[arg-type]

        left.plot(ms, 1.0 - share(ms), color=color, label=label)
        rate = np.diff(share(fine))
        middle = 0.5 * (fine[1:] + fine[:-1])
        strength = [abs(np.sum(rate * np.exp(-2j * np.pi * f * middle))) for f in frequency]
        right.plot(frequency, strength, color=color)
    left.set(xlabel="time since the onset / T", ylabel="load / load before", title="Load during a release of length T")
    left.legend(fontsize=7.5, loc="upper right")
    right.set(
        xlabel="frequency of a mode × T", ylabel="amplitude / amplitude after a step", xlim=(0.0, 4.0), ylim=(0.0, 1.05)
    )
    right.set_title("Amplitude of a mode after the release")
    return figure


def release_instants() -> Figure:
    """Load and output of one release with the readings of the program."""
    figure, (top, bottom) = new_figure(4.2, 2, 1, sharex=True, height_ratios=(1, 1.7))
    time_s = np.arange(-0.004, 0.03, 1 / 400e3)
    length = 0.4e-3
    share = load_share("ramp", time_s, 0.0, length)
    output = _after(_sensor(((MODE_HZ / 4, 0.05, 1.0),)), time_s, share)
    ms = 1e3 * time_s
    top.plot(ms, 120.0 * (1.0 - share), color=RED)
    top.set(ylabel="load / N", ylim=(-25, 160), title="Load: a weight of 120 N whose rope is cut")
    top.axvspan(0.0, 1e3 * length, color=ORANGE, alpha=0.35, linewidth=0)
    for at, height, text in ((0.0, 142, "onset"), (1e3 * length, 100, "end of the release, after the time T")):
        top.annotate(
            text, (at, height), (1.2, height), va="center", fontsize=8, arrowprops={"arrowstyle": "->", "color": BLACK}
        )
    bottom.plot(ms, 1.0 - output, color=BLUE)
    bottom.axvspan(0.0, 1e3 * length, color=ORANGE, alpha=0.35, linewidth=0)
    bottom.set(
        xlabel="time / ms", ylabel="output / baseline", title="Output of the sensor", xlim=(-4, 26), ylim=(-1.1, 1.3)
    )
    for low, high, text in (
        (-4.0, -0.1, "rest:\nbaseline,\nnoise"),
        (0.6, 18.0, "ringing: modes"),
        (18.2, 26.0, "steady level"),
    ):
        bottom.annotate("", (low, -0.93), (high, -0.93), arrowprops={"arrowstyle": "<->", "color": GREY})
        bottom.text((low + high) / 2, -0.88, text, ha="center", va="bottom", fontsize=8, color=GREY)
    begin, end = (ms[np.argmax(output > level)] for level in (0.1, 0.9))
    bottom.plot([begin, end], [0.9, 0.1], "o", color=RED, markersize=4)
    bottom.text(begin + 0.4, 1.02, "rise: from 10 % to 90 % of the change", fontsize=8, color=RED, va="center")
    bottom.axhline(0.0, color=GREY, linewidth=0.6)
    return figure


def step_figures() -> Figure:
    """Overshoot, rise and settling of a step response; bands, peak and half power of the gain."""
    figure, (left, right) = new_figure(3.2, 1, 2)
    sensor = _sensor(((400.0, 0.12, 1.0),), lag=False)
    found = indices(sensor)
    assert found.overshoot is not None
    assert found.rise_s is not None
    assert found.settling_5_s is not None
    assert found.settling_2_s is not None
    time_s = np.linspace(0.0, 0.018, 3000)
    response = sensor.step(time_s)
    left.plot(1e3 * time_s, response, color=BLUE)
    left.axhspan(0.95, 1.05, color=GREEN, alpha=0.18, linewidth=0)
    left.axhspan(0.98, 1.02, color=GREEN, alpha=0.3, linewidth=0)
    top = 1.0 + found.overshoot
    at = 1e3 * time_s[np.argmax(response)]
    left.annotate("", (at, 1.0), (at, top), arrowprops={"arrowstyle": "<->", "color": RED})
    left.text(at + 0.4, top, "overshoot", color=RED, va="center", fontsize=8)
    passed = [1e3 * time_s[np.argmax(response > level)] for level in (0.1, 0.9)]
    left.annotate("", (passed[0], 0.5), (passed[1], 0.5), arrowprops={"arrowstyle": "<->", "color": ORANGE})
    left.text(passed[1] + 0.4, 0.4, "rise_s:\n10 to 90 %", color=ORANGE, va="center", fontsize=8)
    for settling, text, side in ((found.settling_5_s, "settling_5_s", -1), (found.settling_2_s, "settling_2_s", 1)):
        left.axvline(1e3 * settling, color=GREY, linewidth=0.8, linestyle="--")
        left.text(1e3 * settling + 0.15 * side, 0.2, text, fontsize=8, color=GREY, ha="right" if side < 0 else "left")
    left.text(17.8, 1.07, "±5 %, ±2 %", fontsize=8, color=GREEN, ha="right")
    left.set(xlabel="time / ms", ylabel="output / final value", xlim=(0, 18), ylim=(0, 1.8))
    left.set_title("Response to an ideal step")
    frequency = np.linspace(0.0, 900.0, 2000)
    right.plot(frequency, np.abs(sensor.response(frequency)), color=BLUE)
    right.axhspan(0.9, 1.1, color=GREEN, alpha=0.18, linewidth=0)
    right.axhspan(0.95, 1.05, color=GREEN, alpha=0.3, linewidth=0)
    marks = (
        ("band_5_hz", found.band_5_hz, 1.05, (70.0, 0.35)),
        ("band_10_hz", found.band_10_hz, 1.10, (60.0, 2.4)),
        ("peak_hz, peak_gain", found.peak_hz, found.peak_gain, (440.0, 4.2)),
        ("half_power_hz", found.half_power_hz, np.sqrt(0.5), (660.0, 1.6)),
    )
    for text, hertz, gain, place in marks:
        right.plot([hertz], [gain], "o", color=RED, markersize=4)
        line = {"arrowstyle": "-", "color": RED, "linewidth": 0.6}
        right.annotate(text, (hertz, gain), place, fontsize=8, color=RED, arrowprops=line, ha="left")
    right.set(xlabel="frequency / Hz", ylabel="gain / static gain", xlim=(0, 900), ylim=(0, 4.6))
    right.set_title("Gain over frequency")
    return figure


def _two_mode_record() -> tuple[StepRecord, LinearSystem]:
    """Return the record of a release from a sensor with two modes and an amplifier, and the sensor."""
    sensor = _sensor(((MODE_HZ, ZETA, 0.85), (2900.0, 0.02, 0.15)))
    time_s = np.arange(-0.01, 0.03, 1 / RATE_HZ)
    fine = np.arange(-0.01, 0.03, 1 / (8 * RATE_HZ))
    output = _after(sensor, fine, load_share("ramp", fine, 3e-6, 0.15e-3))[::8][: len(time_s)]
    noise = 4e-3 * np.random.default_rng(4).normal(size=len(time_s))
    return StepRecord(
        "release", ("Fz",), "V/V", (1.0 - output + noise)[None], RATE_HZ, "Fz", -1.0, start_s=-0.01
    ), sensor


def step_residuals() -> Figure:
    """One record, and what models with too few and with enough terms leave of it."""
    figure, panels = new_figure(3.9, 3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    record, _ = _two_mode_record()
    ms = 1e3 * record.time_s
    few, enough = fit_step(record, "Fz", modes=1, release="step"), fit_step(record, "Fz")
    panels[0].plot(ms, record.samples[0], color="#c3c8d0", linewidth=3.0, label="record")
    panels[0].plot(
        1e3 * enough.time_s, enough.fitted, color=BLUE, linewidth=0.8, label="fit: modes, amplifier, release"
    )
    panels[0].set(ylabel="output / (V/V)", title="Record and fit")
    panels[0].legend(fontsize=8, ncols=2, loc="upper right")
    for axes, fit, color, title in (
        (panels[1], few, RED, "Residual of one mode and a release at once"),
        (panels[2], enough, BLUE, "Residual of the model that the program selects: noise alone"),
    ):
        axes.plot(1e3 * fit.time_s, fit.residual, color=color, linewidth=0.6)
        axes.set(ylim=(-0.12, 0.12), ylabel="residual\n/ (V/V)", title=title)
    panels[2].set(xlabel="time / ms", xlim=(-1.0, 10.0))
    return figure


def pole_plane() -> Figure:
    """Poles of the fitted model in the complex plane with the two figures of a mode."""
    figure, axes = new_figure(3.3)
    record, sensor = _two_mode_record()
    fit = fit_step(record, "Fz")
    terms = fit.model.terms[0] / (2 * np.pi)
    truth = sensor.poles / (2 * np.pi)
    axes.plot(truth.real, truth.imag, "o", markerfacecolor="none", color=GREY, markersize=10, label="simulated")
    axes.plot(terms.real, terms.imag, "x", color=BLUE, markersize=7, markeredgewidth=2, label="fitted")
    mode = MODE_HZ * (-ZETA + 1j * np.sqrt(1 - ZETA**2))
    axes.axhline(0, color=GREY, linewidth=0.6)
    axes.axvline(0, color=GREY, linewidth=0.6)
    for value in (1000.0, 2000.0, 3000.0, 6000.0):
        turn = np.linspace(np.pi / 2, 1.5 * np.pi, 200)
        axes.plot(value * np.cos(turn), value * np.sin(turn), color=GREY, linewidth=0.4, linestyle=":")
    for text, pole, place in (
        ("mode: 2π $f_n$ = |$p$|, the distance from 0;  ζ = −Re $p$ / |$p$|", (mode.real, mode.imag), (-3200, 1400)),
        ("second mode", (-58, 2899), (-1500, 3100)),
        ("real pole: the amplifier", (-6000, 0), (-5300, 700)),
    ):
        line = {"arrowstyle": "-", "color": BLUE, "linewidth": 0.6}
        behind = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
        axes.annotate(text, pole, place, fontsize=8, ha="center", arrowprops=line, bbox=behind)
    axes.text(150, -2600, "growing:\nno sensor", fontsize=8, color=RED, va="center")
    axes.set(xlabel="Re $p$ / 2π / Hz", ylabel="Im $p$ / 2π / Hz", xlim=(-7200, 1200), ylim=(-3600, 3600))
    axes.set_title("Poles of the model")
    axes.legend(loc="lower left", fontsize=8)
    return figure


def lag_or_release() -> Figure:
    """Two sensors and two releases with the same output: the gains differ."""
    figure, (left, middle, right) = new_figure(2.6, 1, 3)
    tau = 100e-6
    time_s = np.linspace(-0.2e-3, 2.2e-3, 2401)
    lagging = LinearSystem(np.zeros(0, complex), np.array([-1 / tau + 0j]), 1 / tau)
    ideal = _sensor(lag=False)
    both = ideal.times(lagging)
    slow = np.where(time_s > 0, 1.0 - np.exp(-np.maximum(time_s, 0.0) / tau), 0.0)
    output = np.where(time_s > 0, both.step(np.maximum(time_s, 0.0)), 0.0)
    assert np.max(np.abs(_after(ideal, time_s, slow) - output)) < 0.02
    ms = 1e3 * time_s
    left.plot(ms, 1.0 - (time_s > 0), color=BLUE, label="A: step")
    left.plot(ms, 1.0 - slow, color=ORANGE, linestyle="--", label="B: exponential, 0.1 ms")
    left.set(xlabel="time / ms", ylabel="load / load before", title="Load", ylim=(-0.05, 1.6), xlim=(-0.2, 1.0))
    left.legend(fontsize=7.5, loc="upper right")
    middle.plot(ms, 1.0 - output, color=BLUE)
    middle.plot(ms, 1.0 - output, color=ORANGE, linestyle=(0, (4, 4)))
    middle.set(xlabel="time / ms", ylabel="output / baseline", title="Output: the same")
    frequency = np.linspace(1.0, 1200.0, 500)
    right.plot(frequency, np.abs(both.response(frequency)), color=BLUE, label="A: chain lags 0.1 ms")
    right.plot(frequency, np.abs(ideal.response(frequency)), color=ORANGE, linestyle="--", label="B: chain without lag")
    right.axhspan(0.95, 1.05, color=GREEN, alpha=0.2, linewidth=0)
    right.set(xlabel="frequency / Hz", ylabel="gain", title="Gain: different", ylim=(0.8, 2.0), xlim=(0, 1200))
    right.legend(fontsize=7.5, loc="upper left")
    return figure


def amplitude_decay() -> Figure:
    """Swing, damping and frequency over the amplitude for a linear sensor, friction, and a softening spring."""
    from scipy.integrate import solve_ivp
    from scipy.signal import hilbert

    figure, (left, middle, right) = new_figure(2.6, 1, 3)
    omega, zeta = 2 * np.pi * 200.0, 0.01
    time_s = np.arange(0.0, 0.25, 2e-5)
    cases: tuple[tuple[str, str, float, float], ...] = (
        ("linear", GREY, 0.0, 0.0),
        ("dry friction", ORANGE, 0.004, 0.0),
        ("softening spring", BLUE, 0.0, 0.05),
    )
    for label, color, friction, soft in cases:

        def force(_: float, state: Any, friction: float = friction, soft: float = soft) -> list[float]:
            x, v = state
            pull = omega**2 * (x * (1.0 - soft * x * x) + friction * np.tanh(v / (1e-3 * omega)))
            return [v, -pull - 2 * zeta * omega * v]

        swing = solve_ivp(force, (0.0, time_s[-1]), [1.0, 0.0], t_eval=time_s, rtol=1e-8, atol=1e-10).y[0]
        wave = hilbert(swing)
        size = np.abs(wave)
        inner = slice(400, -2500)
        smooth = np.convolve(np.log(size), np.ones(500) / 500, "same")[inner]
        rate = np.gradient(smooth, time_s[inner])
        turns = np.convolve(np.gradient(np.unwrap(np.angle(wave)), time_s), np.ones(500) / 500, "same")[inner]
        shown = (np.exp(smooth) > 0.1) & (np.exp(smooth) < 0.8)
        # the linear sensor is wide and pale, because the others lie on it in part
        thin = {"color": color, "linewidth": 1.3} if color != GREY else {"color": "#c3c8cf", "linewidth": 4.5}
        left.plot(1e3 * time_s, size, label=label, **thin)
        middle.plot(np.exp(smooth)[shown], -100 * rate[shown] / turns[shown], **thin)
        right.plot(np.exp(smooth)[shown], turns[shown] / (2 * np.pi), **thin)
    left.set(
        xlabel="time / ms",
        ylabel="amplitude / first amplitude",
        title="Decay",
        yscale="log",
        ylim=(0.05, 2.5),
        xlim=(2, 200),
    )
    left.legend(fontsize=7.5, loc="upper right")
    middle.set(xlabel="amplitude / first amplitude", ylabel="damping ratio / %", title="Damping", ylim=(0, 5))
    right.set(xlabel="amplitude / first amplitude", ylabel="frequency / Hz", title="Frequency", ylim=(195, 201))
    return figure


DRAWINGS = (
    release_shapes,
    release_instants,
    step_figures,
    step_residuals,
    pole_plane,
    lag_or_release,
    amplitude_decay,
)
