"""Sweeps with slow cameras: images between which the channels show the motion."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline
from style import BLUE, GREY, ORANGE, WIDTH_IN

from shaker.frf.sampled_motion import ReferenceSignals, fit_sampled_motion

RATE_HZ, LENGTH_S, BAND_HZ, FRAME_HZ = 4096.0, 20.0, (60.0, 900.0), 53.127
SHOWN_S, NOISE_RAD, FINER = (7.40, 7.46), 2e-6, 16
"""Time that is shown, in which the sweep is near the resonance; noise of a rotation in one image."""


def rocking(frequency_hz: np.ndarray) -> np.ndarray:
    """Return the rotation of a load over its translation, in rad/m."""
    ratio = frequency_hz / 420.0
    return np.asarray(1.2 + 3.0 * ratio**2 / (1.0 - ratio**2 + 0.1j * ratio))


def sweep_between_images() -> Figure:
    """Draw translation and rotation of a sweep for a short time, and their ratio as all images determine it."""
    rng, time_s = np.random.default_rng(3), np.arange(0.0, LENGTH_S, 1.0 / RATE_HZ)
    low, high = BAND_HZ[0] - 6.0, BAND_HZ[1] + 20.0
    taper = np.sin(0.5 * np.pi * np.clip(np.minimum(time_s - 0.3, LENGTH_S - 0.5 - time_s) / 0.25, 0.0, 1.0)) ** 2
    acceleration = 20.0 * taper * np.sin(2.0 * np.pi * (low + 0.5 * (high - low) / LENGTH_S * time_s) * time_s)
    hertz = np.fft.rfftfreq(len(time_s), 1.0 / RATE_HZ)
    moved = np.where(hertz > 20.0, np.fft.rfft(acceleration) / -((2.0 * np.pi * np.maximum(hertz, 1.0)) ** 2), 0.0)
    fine_s = np.arange(FINER * len(time_s)) / (FINER * RATE_HZ)
    z, turned = (FINER * np.fft.irfft(part, len(fine_s)) for part in (moved, moved * rocking(hertz)))
    images_s = np.arange(0.06, LENGTH_S - 0.05, 1.0 / FRAME_HZ)
    seen = CubicSpline(fine_s, turned)(images_s) + NOISE_RAD * rng.normal(size=len(images_s))
    signals = ReferenceSignals(acceleration[:, None], np.array([2]), RATE_HZ, 0.0, BAND_HZ)
    lines_hz = np.geomspace(*BAND_HZ, 300)
    of_motion = -((2.0 * np.pi * lines_hz[:, None]) ** 2).astype(np.complex128)
    phasors = fit_sampled_motion(signals, images_s, seen[:, None]).phasors(lines_hz, of_motion)
    found, u = phasors.of(seen[:, None])[:, 0], np.sqrt(phasors.covariance[:, [0, 1], [0, 1]].max(axis=1))

    figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    top, right = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
    bottom = figure.add_subplot(grid[1, 0], sharex=top)
    fine, images = (slice(*np.searchsorted(of, SHOWN_S)) for of in (fine_s, images_s))
    shown_ms = 1e3 * (images_s[images] - SHOWN_S[0])
    for axes, values, label in ((top, z, "z / µm"), (bottom, turned, "ry / µrad")):
        axes.plot(1e3 * (fine_s[fine] - SHOWN_S[0]), 1e6 * values[fine], color=BLUE, lw=1.0)
        axes.vlines(shown_ms, *axes.get_ylim(), color=ORANGE, lw=0.8, zorder=0)
        axes.set_ylabel(label)
    bottom.plot(shown_ms, 1e6 * seen[images], "o", color=ORANGE, ms=5)
    top.set_title("A laser shows z at any time")
    bottom.set_title("Images show ry at few times")
    bottom.set_xlabel("time / ms")
    right.fill_between(lines_hz, np.abs(found) - 2 * u, np.abs(found) + 2 * u, color=BLUE, alpha=0.25, lw=0, label="U")
    right.plot(lines_hz, np.abs(found), color=BLUE, label=f"by {len(images_s)} images")
    right.plot(lines_hz, np.abs(rocking(lines_hz)), color=GREY, lw=1.0, ls="--", label="truth")
    right.set(ylim=(0.6, 60.0), xscale="log", yscale="log", xlabel="f / Hz", ylabel="|ry / z| / (rad/m)")
    right.set_xticks([60, 100, 200, 400, 900], ["60", "100", "200", "400", "900"])
    right.set_xticks([], minor=True)
    right.set_title("All images give ry per z")
    right.legend(loc="upper left", fontsize=8)
    return figure


DRAWINGS = (sweep_between_images,)
