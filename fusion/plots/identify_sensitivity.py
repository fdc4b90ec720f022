"""Figures of the sensitivity over frequency with its explanations, and of what a load mass does to the output."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from fusion.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    panel_label,
    power_text,
    static_axis,
)
from fusion.polar import typeset
from shaker._checks import ComplexArray

LOADS = (BLUE, ORANGE, GREEN, PURPLE, SKY, GREY)
COVERAGE = 2.0
STYLES = ((GREEN, (0, (2, 2))), (PURPLE, (0, (6, 2))), (BLACK, "solid"))


@dataclass(frozen=True)
class ExplainedSensitivity:
    """Sensitivity of one output at K lines with `u_magnitude`, `u_phase_rad` (K,), and the curves of explanations.

    `label`: "output Fz per Fz"; `curve_hz` (L,); `curves`: words and complex values (L,); `static`: None where unknown.
    """

    label: str
    unit: str
    frequency_hz: FloatArray
    value: ComplexArray
    u_magnitude: FloatArray
    u_phase_rad: FloatArray
    static: float | None
    curve_hz: FloatArray
    curves: tuple[tuple[str, ComplexArray], ...]


@dataclass(frozen=True)
class LoadedOutput:
    """What the output says over the force for one load mass, in `unit`: `ratio` (L,) of magnitudes, band within which
    it departs by no more than what is permitted.
    """

    load: float
    unit: str
    frequency_hz: FloatArray
    ratio: FloatArray
    band_hz: float


def draw_explained(name: str, item: ExplainedSensitivity) -> Picture:
    """Magnitude and phase with the curves that the spring, the chain and both would give."""
    power = int(np.floor(np.log10(float(np.abs(item.value).max()))))
    factor = 1.0 if -2 <= power < 4 else 10.0**power
    sign = np.sign(item.curves[0][1][0].real)
    with drawing(name):
        figure = new_figure(4.6)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.4, 1.0]})
        size, u_size = np.abs(item.value) / factor, COVERAGE * item.u_magnitude / factor
        phase = np.angle(item.value * sign)
        bars = {"fmt": "o", "color": BLUE, "markersize": 3.5, "elinewidth": 0.9, "zorder": 2.5}
        upper.errorbar(item.frequency_hz, size, u_size, label="measured, U (k = 2)", **bars)
        lower.errorbar(item.frequency_hz, phase, COVERAGE * item.u_phase_rad, **bars)
        for (words, curve), (colour, dash) in zip(item.curves, STYLES, strict=False):
            upper.plot(item.curve_hz, np.abs(curve) / factor, color=colour, linestyle=dash, label=words, zorder=2)
            lower.plot(item.curve_hz, np.angle(curve * sign), color=colour, linestyle=dash, zorder=2)
        ends = [*(size - u_size), *(size + u_size), *(np.abs(curve).min() / factor for _, curve in item.curves)]
        ends += [] if item.static is None else [abs(item.static) / factor]
        upper.set_ylim(padded(min(ends), max(ends)))
        upper.set_ylabel(f"magnitude / {f'{power_text(power)} ' if factor != 1.0 else ''}{typeset(item.unit)}")
        lower.set_ylabel("phase / rad")
        lower.set_xlabel("frequency / Hz")
        lower.axhline(0.0, color=GREY, linewidth=0.7)
        upper.set_xlim(0.0, float(item.curve_hz[-1]))
        if item.static is not None:
            static_axis(upper, abs(item.static) / factor, "static")
        upper.legend(loc="lower left")
        lay_out(figure, [upper, lower], right=0.75, left=0.8, label=0.62)
        caption = (
            f"Complex sensitivity, {item.label}, and what would make it fall: the sensor's spring and damper alone "
            "with k and b of the resonance (equations 1 and 2), the measuring chain alone, and both together."
        )
        return finish(figure, name, f"Sensitivity with model curves, {item.label}", caption)


def draw_outputs_over_load(name: str, loads: Sequence[LoadedOutput], permitted: float) -> Picture:
    """Output over force of several load masses, and how far it stays within the error permitted."""
    with drawing(name):
        figure = new_figure(3.3)
        axes = figure.subplots()
        axes.axhspan(-100.0 * permitted, 100.0 * permitted, color=GREY, alpha=0.15, linewidth=0, zorder=1)
        for load, colour in zip(loads, LOADS, strict=False):
            away = 100.0 * (load.ratio - 1.0)
            axes.plot(load.frequency_hz, away, color=colour, label=f"{load.load:.4g} {load.unit}", zorder=2)
            if np.isfinite(load.band_hz):
                axes.axvline(load.band_hz, color=colour, linewidth=0.8, linestyle=(0, (3, 2)), zorder=1.5)
        _limit(axes, loads, permitted)
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel("output over force − 1 / %")
        axes.legend(loc="upper left")
        panel_label(axes, "uncorrected output, force applied to a load on a rigid base")
        lay_out(figure, [axes], top=0.24)
        caption = (
            "By how much the magnitude of the output departs from the force that acts on a load of the mass given, and "
            f"where it leaves ±{100.0 * permitted:g} % (dashed): the usable band without correction."
        )
        return finish(figure, name, "Usable band by load mass", caption)


def _limit(axes: Axes, loads: Sequence[LoadedOutput], permitted: float) -> None:
    """Limits of three times the error permitted, up to a little beyond the widest band."""
    axes.set_ylim(-300.0 * permitted, 300.0 * permitted)
    bands = [load.band_hz for load in loads if np.isfinite(load.band_hz)]
    highest = 1.6 * max(bands) if bands else float(loads[0].frequency_hz[-1])
    axes.set_xlim(0.0, min(highest, float(loads[0].frequency_hz[-1])))
    axes.yaxis.set_major_locator(MaxNLocator(7))
