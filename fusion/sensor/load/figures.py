"""Figures of load characteristics: resonance, damping and deviations over the load, spectra of the records."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from fusion.base import GRAM, PERCENT
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    ORANGE,
    Picture,
    decades,
    panel_label,
    sheet,
)
from fusion.sensor.load.evaluate import ComponentLoads
from shaker.arrays import FloatArray
from shaker.labels import mechanical_units, typeset
from shaker.release.load_modes import projected


def small_unit(component: ComponentLoads) -> str:
    """Unit of loads as they are shown."""
    return typeset(mechanical_units(component.name).inertia.removeprefix("k"))


def draw_characteristics(component: ComponentLoads, permitted: float) -> Picture:
    """Both resonances over the load with 95 % bands, deviations of the models from the first, and its damping."""
    seen, masses, k = component.series.measured, component.series.masses, component.k
    load, solutions = GRAM * masses.load, component.solutions
    is_damped = bool(np.any(np.isfinite(seen.damping_ratio[:, 0])))
    grid, lightest = solutions[0].drawn.load_mass, int(np.argmin(masses.load))
    formula = seen.frequency_hz[lightest, 0] * np.sqrt((masses.moving + masses.load[lightest]) / (masses.moving + grid))
    with sheet(f"load-{component.name}", 5.2, 2, 2, heights=(1.5, 1.0)) as drawn:
        first, second, off, damping = drawn.panels
        first.plot(GRAM * grid, formula, color=GREY, linestyle=(0, (5, 3)), label="two masses, by the lightest load")
        for solution, colour in zip(solutions, COLOURS, strict=False):
            curve, model = solution.drawn, solution.model
            label = "two masses" if model.is_rigid else "three masses"
            label += f", solution {model.solution}" if model.solutions > 1 else ""
            over, expanded = GRAM * curve.load_mass, k * curve.u_frequency_hz
            _band(first, over, curve.frequency_hz[:, 0], expanded[:, 0], colour, label)
            _band(second, over, curve.frequency_hz[:, 1], expanded[:, 1], colour, label)
            ratio = curve.damping_ratio[:, 0] if is_damped else np.full_like(over, np.nan)
            _band(damping, over, PERCENT * ratio, PERCENT * k * curve.u_damping_ratio[:, 0], colour, label)
        points: dict[str, Any] = {"fmt": "o", "color": BLACK, "zorder": 4}
        for axes, mode in ((first, 0), (second, 1)):
            value, expanded = seen.frequency_hz[:, mode], k * seen.u_frequency_hz[:, mode]
            axes.errorbar(load, value, expanded, label="measured", **points)
        ratio, expanded = PERCENT * seen.damping_ratio[:, 0], PERCENT * k * seen.u_damping_ratio[:, 0]
        damping.errorbar(load, ratio, expanded, **points)
        if not is_damped:
            _empty(damping, "resonances tell no damping")
        _draw_deviations(off, component, permitted)
        first.set_ylabel("first resonance / Hz")
        second.set_ylabel("second resonance / Hz")
        damping.set_ylabel("damping ratio, first / %")
        for axes in (off, damping):
            axes.set_xlabel(f"load / {small_unit(component)}")
            axes.set_xlim(0.0, GRAM * float(grid[-1]))
        # second resonances rise without end as the load vanishes: the axis ends above the largest load's region
        every = np.concatenate([seen.frequency_hz[:, 1], *(one.drawn.frequency_hz[:, 1] for one in solutions)])
        if np.isfinite(every).any():
            top = 1.15 * float(np.max(seen.frequency_hz[:, 1], initial=0.0, where=np.isfinite(seen.frequency_hz[:, 1])))
            second.set_ylim(0.0, max(3.0 * float(np.nanmin(every)), top))
        else:
            _empty(second, "a rigid load has no second mode")
        first.legend(loc="best")
        off.legend(loc="best")
        caption = (
            "Lines: models with 95 % bands; points: measured, with U. Below left: models less measured, the permitted "
            f"{PERCENT * permitted:g} % grey."
        )
        title = "Resonances and damping over the load"
        return drawn.picture(title, caption, top=0.12, gap=(0.75, 0.16), left=0.72, label=0.52)


def draw_spectra(component: ComponentLoads) -> Picture | None:
    """Spectrum of every record after its release over its largest line, with what the model leaves; None of a table."""
    decays, model = component.series.decays, component.solutions[0].model
    modes_hz = component.solutions[0].recorded.frequency_hz
    if not decays:
        return None
    top = 1.15 * max(float(np.nanmax(modes)) for modes in modes_hz[: len(decays)])
    with sheet(f"spectra-{component.name}", 0.6 + 1.15 * len(decays), len(decays)) as drawn:
        for place, (axes, decay) in enumerate(zip(drawn.panels, decays, strict=True)):
            load = float(component.series.masses.load[place])
            poles = model.poles(load)
            residual, _ = projected(decay, poles[poles.imag > 0.0])
            window, frequency = np.hanning(len(decay.value)), np.fft.rfftfreq(len(decay.value), 1.0 / decay.rate_hz)
            both = [np.abs(np.fft.rfft(window * part)) for part in (decay.value - np.mean(decay.value), residual)]
            shown, largest = (frequency > 0.0) & (frequency <= top), float(both[0].max())
            for values, colour, width in zip(both, (COLOURS[place % len(COLOURS)], GREY), (1.1, 0.5), strict=True):
                axes.semilogy(frequency[shown], values[shown] / largest, color=colour, linewidth=width)
            for mode in modes_hz[place][np.isfinite(modes_hz[place])]:
                axes.axvline(float(mode), color=GREY, linewidth=0.7, linestyle=(0, (2, 2)), zorder=1)
            decades(axes.yaxis)
            panel_label(axes, f"{decay.name}, load {GRAM * load:.5g} {small_unit(component)}")
        drawn.panels[-1].set_xlabel("frequency / Hz")
        drawn.panels[-1].set_xlim(0.0, top)
        caption = (
            "Amplitude of the output after the release over its largest line; grey: what the model leaves, whose free "
            "amplitudes and level are fitted to each record; dashed: modes of the model."
        )
        layout: dict[str, Any] = {"top": 0.26, "gap": (0.5, 0.28), "left": 0.72, "label": 0.52}
        return drawn.picture("Spectra of the free oscillations", caption, **layout)


def _band(axes: Axes, load: FloatArray, value: FloatArray, expanded: FloatArray, colour: str, label: str) -> None:
    axes.plot(load, value, color=colour, label=label, zorder=3)
    if np.any(np.isfinite(expanded)):
        axes.fill_between(load, value - expanded, value + expanded, color=colour, alpha=0.25, linewidth=0, zorder=2)


def _draw_deviations(axes: Axes, component: ComponentLoads, permitted: float) -> None:
    first, load = component.series.measured.frequency_hz[:, 0], GRAM * component.series.masses.load
    compared = [
        ("two masses, by the lightest load", component.formula_hz),
        ("two masses, all loads", component.identification.rigid.frequency_hz[:, 0]),
    ]
    if not component.solutions[0].model.is_rigid:
        compared.append(("three masses", component.solutions[0].recorded.frequency_hz[:, 0]))
    axes.axhspan(-PERCENT * permitted, PERCENT * permitted, color=GREY, alpha=0.15, linewidth=0, zorder=1)
    axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=1.5)
    for (label, values), colour, marker in zip(compared, (GREY, ORANGE, BLUE), "os^", strict=False):
        axes.plot(load, PERCENT * (values / first - 1.0), marker=marker, color=colour, linewidth=0.8, label=label)
    axes.set_ylabel("model less measured / %")


def _empty(axes: Axes, text: str) -> None:
    """A panel that has nothing to show says why."""
    axes.text(0.5, 0.5, text, ha="center", transform=axes.transAxes, color=GREY)
    axes.set_yticks([])
