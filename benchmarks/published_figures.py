"""Figures 6 to 9 and 14 of the publication, drawn from evaluated recordings of the simulated twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import h5py
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from published_paper import DAMPING_KG_PER_S, INTERNAL_KG, LAG_S, LOADS_KG, RESONANCE_HZ

from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.figure import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from fusion.report.figure_files import drawing, figure_bytes, new_figure
from fusion.sensitivity.analyse import Evaluation
from shaker.mechanics import required_stiffness
from shaker.sine.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BAND_HZ = 2000.0
CHANNEL = "velocity_1"
Z = 2


@dataclass(frozen=True)
class SweepPoint:
    """One frequency of the sweep: S over eight points in the first recording, fused S of all four, and the truth.

    `mean`, `spread`, `phase_rad`, `phase_spread_rad`: as published; `fused` with expanded uncertainties of magnitude
    and phase; `true`.
    """

    frequency_hz: float
    mean: float
    spread: float
    phase_rad: float
    phase_spread_rad: float
    fused: complex
    expanded: float
    expanded_phase_rad: float
    true: complex


def lay_out(
    panels: Sequence[Axes],
    *,
    left: float = 0.72,
    right: float = 0.12,
    bottom: float = 0.45,
    top: float = 0.12,
    gap: tuple[float, float] = (0.6, 0.14),
    label: float = 0.52,
) -> None:
    """Margins, gaps (across, down) and the distance of the y labels from their panel, all in inches."""
    figure, grid = panels[0].get_figure(root=True), panels[0].get_gridspec()
    if figure is None:
        raise ValueError("panels: expected those of a figure, found others")
    width, height = figure.get_size_inches()
    across, down = (grid.ncols, grid.nrows) if grid is not None else (1, 1)
    panel_width = (width - left - right - (across - 1) * gap[0]) / across
    panel_height = (height - bottom - top - (down - 1) * gap[1]) / down
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=gap[0] / panel_width,
        hspace=gap[1] / panel_height,
    )
    for axes in panels:
        axes.yaxis.set_label_coords(-label / (axes.get_position().width * width), 0.5)


def draw_trigger(evaluation: Evaluation) -> bytes:
    """Fig. 6: acceleration from the vibrometer, the sines fitted to it, and the camera trigger."""
    clock = next(c for c in evaluation.clocks if c.trigger is not None)
    with h5py.File(clock.file) as file:
        rate = float(file[CHANNEL].attrs["sample_rate"])
        velocity, trigger = file[CHANNEL][:].astype(np.float64), file["camera_trigger"][:]
    scale = next(c.scale for daq in evaluation.manifest.daq for c in daq.channel if c.name == CHANNEL)
    measured = derivative(scale * velocity, rate)
    time = np.arange(len(measured)) / rate
    shown = (time > 0.955) & (time < 1.005)
    fitted = sines(time[shown], acceleration_of(evaluation))
    with drawing("fig6"):
        figure = new_figure(3.6)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.0]})
        upper.plot(time[shown], measured[shown], ".", color=SKY, markersize=2.5, label="vibrometer, differentiated")
        upper.plot(time[shown], fitted, color=RED, linewidth=0.9, label="fitted sines")
        lower.plot(time[shown], trigger[shown], color=BLACK, linewidth=0.9)
        upper.set_ylabel("acceleration / (m/s²)")
        upper.set_ylim(-270, 270)
        upper.legend(loc="upper right", ncols=2)
        lower.set_ylabel("trigger / V")
        lower.set_xlabel("time / s")
        lay_out([upper, lower])
        return figure_bytes(figure, "png")


def derivative(values: FloatArray, rate_hz: float) -> FloatArray:
    """Return the time derivative of samples below `BAND_HZ`, by multiplication of the spectrum with jω."""
    spectrum = np.fft.rfft(values)
    frequency = np.fft.rfftfreq(len(values), 1.0 / rate_hz)
    return np.fft.irfft(np.where(frequency < BAND_HZ, 2j * np.pi * frequency * spectrum, 0.0), len(values))


def acceleration_of(evaluation: Evaluation) -> Phasors:
    """Return the acceleration phasors of the vibrometer channel that is shown."""
    channel = next(c for c in evaluation.channels if c.name == CHANNEL)
    return channel.phasors.differentiated(1, ("m/s^2",))


def sines(time_s: FloatArray, phasors: Phasors, column: int = 0) -> FloatArray:
    """Return Σ Re{X·e^{jωt}} of one column of phasors."""
    turn = np.exp(2j * np.pi * np.multiply.outer(time_s, phasors.frequency_hz))
    return np.asarray((turn @ phasors.value[:, column]).real)


def draw_spectrum(evaluation: Evaluation) -> bytes:
    """Fig. 7: amplitude spectrum of the vibrometer's acceleration, scaled to the harmonics."""
    channel = next(c for c in evaluation.channels if c.name == CHANNEL)
    frequency = channel.spectrum_hz
    amplitude = 2 * np.pi * frequency * channel.spectrum
    shown = frequency < 1000.0
    with drawing("fig7"):
        figure = new_figure(2.6)
        axes = figure.subplots()
        axes.plot(frequency[shown], amplitude[shown], color=BLUE, linewidth=0.8)
        for line in acceleration_of(evaluation).frequency_hz[1:]:
            axes.axvline(line, color=ORANGE, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
        axes.set_xlim(0, 1010)
        axes.set_ylim(0, 1.5)
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel("acceleration / (m/s²)")
        lay_out([axes])
        return figure_bytes(figure, "png")


def folded(stereo: StereoResult, component: int, steps: int = 20) -> tuple[FloatArray, FloatArray]:
    """Return times and values of the fit between the frames as the camera's beat shows it: every line at its alias."""
    phasors, count = stereo.fit.phasors, len(stereo.time_s)
    frame = np.linspace(0.0, count - 1.0, steps * (count - 1) + 1)
    time = np.interp(frame, np.arange(count), stereo.time_s)
    step = (stereo.time_s[-1] - stereo.time_s[0]) / (count - 1)
    whole = np.round(phasors.frequency_hz * step)
    turn = np.exp(2j * np.pi * (np.multiply.outer(time, phasors.frequency_hz) - np.multiply.outer(frame, whole)))
    return time, np.asarray((turn @ phasors.value[:, component]).real)


def draw_displacement(stereo: StereoResult) -> bytes:
    """Fig. 8: displacement in z of every frame, the sines fitted, and what they leave."""
    with drawing("fig8"):
        figure = new_figure(3.8)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.0]})
        _draw_component(upper, stereo, Z, 1e3)
        upper.set_ylabel("z / mm")
        lower.plot(stereo.time_s, 1e6 * stereo.residual[:, Z], ".", color=BLUE, markersize=3.0)
        lower.axhline(0.0, color=GREY, linewidth=0.8)
        lower.set_ylabel("residual / µm")
        lower.set_xlabel("time / s")
        upper.legend(loc="upper right", ncols=2)
        upper.set_ylim(-0.56, 0.68)
        lay_out([upper, lower])
        return figure_bytes(figure, "png")


def draw_axis(stereo: StereoResult) -> bytes:
    """Fig. 9: displacement along x and rotation about it."""
    with drawing("fig9"):
        figure = new_figure(3.6)
        upper, lower = figure.subplots(2, 1, sharex=True)
        for axes, component, label in ((upper, 0, "x / µm"), (lower, 3, "rotation about x / µrad")):
            _draw_component(axes, stereo, component, 1e6)
            axes.set_ylabel(label)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.25 * (high - low))
        upper.legend(loc="upper right", ncols=2)
        lower.set_xlabel("time / s")
        lay_out([upper, lower])
        return figure_bytes(figure, "png")


def _draw_component(axes: Axes, stereo: StereoResult, component: int, factor: float) -> None:
    """Frames and the folded fit of one component, both about their mean."""
    offset = stereo.motion_from_mean.pose[:, component] - stereo.residual[:, component]
    offset = offset - sines(stereo.time_s, stereo.fit.phasors, component)
    time, fit = folded(stereo, component)
    axes.plot(time, factor * fit, color=RED, linewidth=0.9, label="fitted sines, at their beat", zorder=1)
    seen = stereo.motion_from_mean.pose[:, component] - offset
    axes.plot(stereo.time_s, factor * seen, ".", color=BLUE, markersize=3.0, label="frames", zorder=2)


def draw_sweep(points: Sequence[SweepPoint], static: float) -> bytes:
    """Fig. 14: sensitivity and phase over frequency, mean and standard deviation of eight points; fused with U."""
    frequency = np.array([p.frequency_hz for p in points])
    fine = np.linspace(0.0, 1.05 * frequency.max(), 300)
    damping = DAMPING_KG_PER_S[0] / required_stiffness(RESONANCE_HZ[0], LOADS_KG[0] + INTERNAL_KG)
    with drawing("fig14"):
        figure = new_figure(5.2)
        upper, lower = figure.subplots(2, 1, sharex=True)
        upper.axhline(1e7 * static, color=RED, linewidth=1.0, linestyle=(0, (5, 3)), label="static sensitivity")
        spring_only = 1 / (1 + 2j * np.pi * fine * damping)
        lagging = spring_only / (1 + 2j * np.pi * fine * LAG_S)
        named = ((spring_only, PURPLE, "eqs. 1, 2 with published k, b"), (lagging, GREEN, "and a lag of 50 µs"))
        for response, colour, label in named:
            upper.plot(fine, 1e7 * static * np.abs(response), color=colour, linewidth=0.9, label=label)
            lower.plot(fine, np.angle(response), color=colour, linewidth=0.9)
        mean = np.array([[p.mean, p.spread, p.phase_rad, p.phase_spread_rad] for p in points]).T
        fused = np.array([[abs(p.fused), p.expanded, np.angle(p.fused), p.expanded_phase_rad] for p in points]).T
        upper.errorbar(frequency, 1e7 * mean[0], 1e7 * mean[1], fmt="o", color=BLUE, label="eight points, std. dev.")
        lower.errorbar(frequency, mean[2], mean[3], fmt="o", color=BLUE)
        upper.errorbar(frequency + 9, 1e7 * fused[0], 1e7 * fused[1], fmt="s", color=BLACK, label="fused, U")
        lower.errorbar(frequency + 9, fused[2], fused[3], fmt="s", color=BLACK)
        upper.set_ylabel("sensitivity / 10⁻⁷ (V/V)/N")
        lower.set_ylabel("phase / rad")
        lower.set_xlabel("frequency / Hz")
        upper.legend(loc="lower left")
        upper.set_xlim(0.0, fine[-1])
        lay_out([upper, lower])
        return figure_bytes(figure, "png")
