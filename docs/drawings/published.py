"""Drawings of the comparisons with published numbers and with data of other laboratories."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from scipy.optimize import brentq
from style import BLUE, DARK, GREEN, GREY, ORANGE, RED, blank, new_figure

from shaker.compensation.filter import single_mode
from shaker.lti.indices import indices
from shaker.lti.system import LinearSystem
from shaker.mechanics import required_stiffness
from shaker.release.load_model import LoadModel
from shaker.release.load_response import pole_responses

RESONANCE_HZ, MASS_KG, DAMPING_KG_PER_S = 1477.35, 4.236 + 0.769, 699.18
"""Resonance of Fz with the smaller load, and its damping as printed (Nitsche, Kumme and Tutsch 2018)."""
OVERSHOOT, STATED_DAMPING, NATURAL_HZ = 0.926, 0.004, 500.0
"""Equations 7, 8 and 10 of the paper on load characteristics."""
PARTS = (
    ("files", ("uff", "tdms", "shaker_three_tone")),
    ("camera calibration", ("dotgrid_stereo", "static_stereo")),
    ("correlation", ("gt4_stereo", "static_stereo", "undersampled_video")),
    ("3-D points, rigid motion", ("duodic_rigid", "gt4_stereo")),
    ("sines, aliases", ("shaker_three_tone",)),
    ("frequency responses", ("chirp_measured",)),
    ("sensor models", ("accelerometer_calibration",)),
    ("load, sensitivity, U", ()),
)


def papers_damping() -> Figure:
    """Draw two widths of a published resonance, and two step responses with the published overshoot."""
    figure, (peak, step) = new_figure(3.0, 1, 2)
    hertz = np.linspace(1420.0, 1535.0, 1151)
    k = required_stiffness(RESONANCE_HZ, MASS_KG)
    s = 2j * np.pi * hertz
    size = np.abs((k + DAMPING_KG_PER_S * s) / (MASS_KG * s**2 + DAMPING_KG_PER_S * s + k))
    size /= size.max()
    peak.plot(hertz, size, color=DARK)
    for level, text, colour in ((np.sqrt(0.5), "1/√2", GREEN), (0.5, "1/2", RED)):
        inside = hertz[size >= level]
        peak.annotate("", (inside[0], level), (inside[-1], level), arrowprops={"arrowstyle": "<|-|>", "color": colour})
        peak.text(inside[-1] + 2.0, level, f"at {text}: {np.ptp(inside):.1f} Hz", color=colour, fontsize=8, va="center")
    peak.set(xlabel="frequency / Hz", ylabel="amplitude / maximum", ylim=(0, 1.1), xlim=(1430, 1535))
    peak.set_title("Resonance of Fz: two widths")

    time = np.linspace(0.0, 5e-3, 2001)

    def response(damping: float, release_s: float) -> np.ndarray:
        system = single_mode(NATURAL_HZ, damping).system
        return np.real(pole_responses(system.poles, time, 0.0, release_s) @ system.residues())

    zeta = brentq(lambda value: response(value, 1e-7).max() - 1.0 - OVERSHOOT, 1e-3, 0.5)
    release_s = brentq(lambda value: response(STATED_DAMPING, value).max() - 1.0 - OVERSHOOT, 1e-5, 1e-3)
    step.plot(1e3 * time, response(zeta, 1e-7), color=BLUE, label=f"ζ = {zeta:.4f}, instant release")
    slow = f"ζ = {STATED_DAMPING}, release of {1e3 * release_s:.2f} ms"
    step.plot(1e3 * time, response(STATED_DAMPING, release_s), color=ORANGE, label=slow)
    step.axhline(1.0 + OVERSHOOT, color=GREY, lw=0.8, ls="--")
    step.text(5.0, 1.0 + OVERSHOOT + 0.04, "overshoot 92.6 %", color=GREY, fontsize=8, ha="right")
    step.set(xlabel="time after the release / ms", ylabel="output / final value", ylim=(0, 2.75))
    step.legend(loc="upper left", fontsize=8)
    step.set_title("Two sensors with the same overshoot")
    return figure


def papers_band() -> Figure:
    """Draw the gain of the published sensor before and after its compensation, and their bands of ±10 %."""
    sensor = LoadModel("Fy", "Fy", "V", 0.089, 2.36e6, 6.0).system(0.151)
    compensated = LinearSystem.from_coefficients(np.array([3.94e7]), np.array([1.0, 6280.0, 3.94e7]))
    figure, axes = new_figure(2.8)
    hertz = np.linspace(1.0, 1600.0, 3200)
    axes.axhspan(0.9, 1.1, color=GREEN, alpha=0.12, lw=0)
    axes.text(1590.0, 1.0, "±10 %", color=GREEN, fontsize=8.5, ha="right", va="center")
    for system, name, colour in ((sensor, "sensor", BLUE), (compensated, "with compensation", ORANGE)):
        gain = np.abs(system.response(hertz)) / abs(system.static_gain)
        limit = float(indices(system).band_10_hz or np.nan)
        axes.plot(hertz, gain, color=colour, label=f"{name}: within ±10 % up to {limit:.0f} Hz")
        axes.axvline(limit, color=colour, lw=0.9, ls="--")
    axes.set(xlabel="frequency / Hz", ylabel="gain / static gain", xlim=(0, 1600), ylim=(0, 2.2))
    axes.legend(loc="upper right")
    axes.set_title("The published compensation widens the band to 473 Hz")
    return figure


def real_data_map() -> Figure:
    """Draw the parts of the program in their order, with the data sets that test each of them."""
    figure, axes = new_figure(2.5)
    blank(axes, (0.0, 16.0), (0.0, 5.6), "auto")
    for at, (name, sets) in enumerate(PARTS):
        left = 2.0 * at
        colour = BLUE if sets else GREY
        box = FancyBboxPatch((left + 0.15, 3.7), 1.6, 1.4, boxstyle="round,pad=0.06", fc=colour, alpha=0.18, lw=0)
        axes.add_patch(box)
        words = name.replace(" ", "\n")
        axes.text(left + 0.95, 4.4, words, ha="center", va="center", fontsize=8, color=colour, weight="bold")
        for row, title in enumerate(sets or ("simulations",)):
            text = title.replace("_", "_\n", 1) if len(title) > 10 else title
            axes.text(left + 0.95, 3.1 - 1.15 * row, text, ha="center", va="center", fontsize=7, color=DARK)
        if at:
            axes.annotate("", (left + 0.1, 4.4), (left - 0.2, 4.4), arrowprops={"arrowstyle": "-|>", "color": GREY})
    return figure


DRAWINGS = (papers_damping, papers_band, real_data_map)
