"""Figures of load characteristics: resonance, damping and deviations over the load, spectra of the records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from fusion.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from shaker.arrays import FloatArray

COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)


@dataclass(frozen=True)
class ModelCurve:
    """First and second resonance (G, 2) and damping ratio of the first (G,) in % of one solution over loads (G,) in g.

    `expanded` (G, 2), `expanded_damping` (G,): U for 95 %, NaN where there is none.
    """

    label: str
    load: FloatArray
    frequency_hz: FloatArray
    expanded: FloatArray
    damping: FloatArray
    expanded_damping: FloatArray


@dataclass(frozen=True)
class MeasuredLoads:
    """What was measured at loads (R,) in g: resonances (R, 2) with U, damping ratio of the first mode (R,) in % with U.

    `deviation` (R, D) of the models named in `compared` (D,) from the first resonance, in %; `unit` of the loads.
    """

    load: FloatArray
    frequency_hz: FloatArray
    expanded: FloatArray
    damping: FloatArray
    expanded_damping: FloatArray
    compared: tuple[str, ...]
    deviation: FloatArray
    permitted: float
    unit: str


@dataclass(frozen=True)
class DecaySpectrum:
    """Amplitude spectrum of one record after the release, over its largest value, and that of what the model leaves."""

    label: str
    frequency_hz: FloatArray
    amplitude: FloatArray
    residual: FloatArray
    modes_hz: FloatArray


def draw_characteristics(name: str, curves: Sequence[ModelCurve], seen: MeasuredLoads, formula: FloatArray) -> Picture:
    """Resonances over the load with bands, deviations of the models, second mode and damping.

    `formula` (G,): two-mass formula by the lightest load, over the loads of the first curve.
    """
    damped = bool(np.any(np.isfinite(seen.damping)))
    with drawing(name):
        figure = new_figure(5.2)
        panels = figure.subplots(2, 2, sharex="col", gridspec_kw={"height_ratios": [1.5, 1.0]})
        first, second, off, damping = panels[0, 0], panels[0, 1], panels[1, 0], panels[1, 1]
        first.plot(curves[0].load, formula, color=GREY, linestyle=(0, (5, 3)), label="two masses, by the lightest load")
        for place, curve in enumerate(curves):
            _band(first, curve.load, curve.frequency_hz[:, 0], curve.expanded[:, 0], COLOURS[place], curve.label)
            _band(second, curve.load, curve.frequency_hz[:, 1], curve.expanded[:, 1], COLOURS[place], curve.label)
            _band(
                damping,
                curve.load,
                curve.damping if damped else np.full_like(curve.load, np.nan),
                curve.expanded_damping,
                COLOURS[place],
                curve.label,
            )
        for axes, mode in ((first, 0), (second, 1)):
            axes.errorbar(
                seen.load,
                seen.frequency_hz[:, mode],
                seen.expanded[:, mode],
                fmt="o",
                color=BLACK,
                zorder=4,
                label="measured",
            )
        damping.errorbar(seen.load, seen.damping, seen.expanded_damping, fmt="o", color=BLACK, zorder=4)
        if not damped:
            _empty(damping, "resonances tell no damping")
        _deviations(off, seen)
        first.set_ylabel("first resonance / Hz")
        second.set_ylabel("second resonance / Hz")
        damping.set_ylabel("damping ratio, first / %")
        for axes in (off, damping):
            axes.set_xlabel(f"load / {seen.unit}")
            axes.set_xlim(0.0, float(curves[0].load[-1]))
        _second_axis(second, curves, seen)
        first.legend(loc="best")
        off.legend(loc="best")
        lay_out(figure, panels.ravel(), top=0.12, gap=(0.75, 0.16), left=0.72, label=0.52)
        caption = (
            "Lines: models with 95 % bands; points: measured, with U. Below left: models less measured, the permitted "
            f"{100.0 * seen.permitted:g} % grey."
        )
        return finish(figure, name, "Resonances and damping over the load", caption)


def draw_spectra(name: str, spectra: Sequence[DecaySpectrum]) -> Picture:
    """Spectrum of every record after its release, with what the model leaves."""
    with drawing(name):
        figure = new_figure(0.6 + 1.15 * len(spectra))
        panels = figure.subplots(len(spectra), 1, sharex=True, squeeze=False).ravel()
        top = 1.15 * max(float(np.nanmax(s.modes_hz)) for s in spectra)
        for place, (axes, spectrum) in enumerate(zip(panels, spectra, strict=True)):
            shown = (spectrum.frequency_hz > 0.0) & (spectrum.frequency_hz <= top)
            colour = COLOURS[place % len(COLOURS)]
            axes.semilogy(spectrum.frequency_hz[shown], spectrum.amplitude[shown], color=colour, linewidth=1.1)
            axes.semilogy(spectrum.frequency_hz[shown], spectrum.residual[shown], color=GREY, linewidth=0.5)
            for mode in spectrum.modes_hz[np.isfinite(spectrum.modes_hz)]:
                axes.axvline(float(mode), color=GREY, linewidth=0.7, linestyle=(0, (2, 2)), zorder=1)
            decades(axes.yaxis)
            panel_label(axes, spectrum.label)
        panels[-1].set_xlabel("frequency / Hz")
        panels[-1].set_xlim(0.0, top)
        lay_out(figure, panels, top=0.26, gap=(0.5, 0.28))
        caption = (
            "Amplitude of the output after the release over its largest line; grey: what the model leaves, whose free "
            "amplitudes and level are fitted to each record; dashed: modes of the model."
        )
        return finish(figure, name, "Spectra of the free oscillations", caption)


def _band(axes: Axes, load: FloatArray, value: FloatArray, expanded: FloatArray, colour: str, label: str) -> None:
    """A curve with its 95 % band."""
    axes.plot(load, value, color=colour, label=label, zorder=3)
    if np.any(np.isfinite(expanded)):
        axes.fill_between(load, value - expanded, value + expanded, color=colour, alpha=0.25, linewidth=0, zorder=2)


def _deviations(axes: Axes, seen: MeasuredLoads) -> None:
    """Models less measured in %."""
    share = 100.0 * seen.permitted
    axes.axhspan(-share, share, color=GREY, alpha=0.15, linewidth=0, zorder=1)
    axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=1.5)
    for place, label in enumerate(seen.compared):
        colour = (GREY, ORANGE, BLUE)[place % 3]
        axes.plot(
            seen.load, seen.deviation[:, place], marker="os^"[place % 3], color=colour, linewidth=0.8, label=label
        )
    axes.set_ylabel("model less measured / %")


def _empty(axes: Axes, text: str) -> None:
    """A panel that has nothing to show says why."""
    axes.text(0.5, 0.5, text, ha="center", transform=axes.transAxes, color=GREY)
    axes.set_yticks([])


def _second_axis(axes: Axes, curves: Sequence[ModelCurve], seen: MeasuredLoads) -> None:
    """Second resonances rise without end as the load vanishes: the axis ends above the largest load's region."""
    every = np.concatenate([seen.frequency_hz[:, 1], *(curve.frequency_hz[:, 1] for curve in curves)])
    known = every[np.isfinite(every)]
    if not known.size:
        _empty(axes, "a rigid load has no second mode")
        return
    measured = seen.frequency_hz[:, 1][np.isfinite(seen.frequency_hz[:, 1])]
    top = max(3.0 * float(np.min(known)), 1.15 * float(np.max(measured, initial=0.0)))
    axes.set_ylim(0.0, top)
