"""Figures of load characteristics: resonances, damping, deviations and spectra."""

from __future__ import annotations

import numpy as np

from fusion.base import GRAM, PERCENT
from fusion.report.figure import BLACK, BLUE, COLOURS, GREY, ORANGE, Figure, Panel, empty_figure
from fusion.sensor.load.load_evaluation import ComponentLoads
from shaker.labels import mechanical_units
from shaker.release.load_modes import project_amplitudes
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, typeset


def small_unit(component: ComponentLoads) -> str:
    """Return the unit of loads as shown."""
    return typeset(mechanical_units(component.name).inertia.removeprefix("k"))


def draw_characteristics(component: ComponentLoads, permitted: float) -> Figure:
    """Draw resonances and damping over the load with 95 % bands, and deviations."""
    seen, masses, k = component.series.measured, component.series.masses, component.k
    load, solutions = GRAM * masses.load, component.solutions
    is_damped = bool(np.any(np.isfinite(seen.damping_ratio[:, 0])))
    grid, lightest = solutions[0].drawn.load_mass, int(np.argmin(masses.load))
    formula = seen.frequency_hz[lightest, 0] * np.sqrt((masses.moving + masses.load[lightest]) / (masses.moving + grid))
    drawn = empty_figure(f"load-{component.name}", 5.2, (1.5, 1.0), 2)
    first, second, off, damping = drawn.panels
    first.line(GRAM * grid, formula, "two masses, by the lightest load", colour=GREY, dashed=True)
    for solution, colour in zip(solutions, COLOURS, strict=False):
        curve, model = solution.drawn, solution.model
        label = "two masses" if model.is_rigid else "three masses"
        label += f", solution {model.solution}" if model.solutions > 1 else ""
        over, expanded = GRAM * curve.load_mass, k * curve.u_frequency_hz
        _band(first, over, curve.frequency_hz[:, 0], expanded[:, 0], colour, label)
        _band(second, over, curve.frequency_hz[:, 1], expanded[:, 1], colour, label)
        ratio = curve.damping_ratio[:, 0] if is_damped else np.full_like(over, np.nan)
        _band(damping, over, PERCENT * ratio, PERCENT * k * curve.u_damping_ratio[:, 0], colour, label)
    for panel, mode in ((first, 0), (second, 1)):
        value, expanded = seen.frequency_hz[:, mode], k * seen.u_frequency_hz[:, mode]
        panel.points(load, value, "measured, U", half_y=expanded, colour=BLACK)
    ratio, expanded = PERCENT * seen.damping_ratio[:, 0], PERCENT * k * seen.u_damping_ratio[:, 0]
    damping.points(load, ratio, "measured, U", half_y=expanded, colour=BLACK)
    if not is_damped:
        _empty(damping, "damping is not determined")
    _draw_deviations(off, component, permitted)
    first.y.label, second.y.label = "first resonance / Hz", "second resonance / Hz"
    damping.y.label = "damping ratio, first / %"
    for panel in drawn.panels:
        panel.x.limits = (0.0, GRAM * float(grid[-1]))
    off.x.label = damping.x.label = f"load / {small_unit(component)}"
    # second resonances rise without end as the load vanishes: the axis ends above the largest load's region
    every = np.concatenate([seen.frequency_hz[:, 1], *(one.drawn.frequency_hz[:, 1] for one in solutions)])
    if np.isfinite(every).any():
        top = 1.15 * float(np.max(seen.frequency_hz[:, 1], initial=0.0, where=np.isfinite(seen.frequency_hz[:, 1])))
        second.y.limits = (0.0, max(3.0 * float(np.nanmin(every)), top))
    else:
        _empty(second, "a rigid load has no second mode")
    caption = (
        "Lines: models with 95 % bands; points: measured, with U. Below left: models less measured, the permitted "
        f"{number_text(PERCENT * permitted, 6)} % grey."
    )
    return drawn.with_title("Resonances and damping over the load", caption, main=True)


def draw_spectra(component: ComponentLoads) -> Figure | None:
    """Draw the spectrum of every record after its release, with the model's residual.

    None of a table.
    """
    decays, model = component.series.decays, component.solutions[0].model
    modes_hz = component.solutions[0].recorded.frequency_hz
    if not decays:
        return None
    top = 1.15 * max(float(np.nanmax(modes)) for modes in modes_hz[: len(decays)])
    drawn = empty_figure(f"spectra-{component.name}", 0.6 + 1.15 * len(decays), len(decays))
    for index, (panel, decay) in enumerate(zip(drawn.panels, decays, strict=True)):
        load = float(component.series.masses.load[index])
        poles = model.poles(load)
        residual, _ = project_amplitudes(decay, poles[poles.imag > 0.0])
        window, frequency = np.hanning(len(decay.value)), np.fft.rfftfreq(len(decay.value), 1.0 / decay.rate_hz)
        both = [np.abs(np.fft.rfft(window * part)) for part in (decay.value - np.mean(decay.value), residual)]
        shown, largest = (frequency > 0.0) & (frequency <= top), float(both[0].max())
        looks = (("output", COLOURS[index % len(COLOURS)], 1.1), ("residual of the model", GREY, 0.5))
        for values, (label, colour, width) in zip(both, looks, strict=True):
            panel.line(frequency[shown], values[shown] / largest, label, colour=colour, width=width)
        modes = modes_hz[index][np.isfinite(modes_hz[index])]
        panel.rule(modes, "modes of the model", along="x", colour=GREY, width=0.7, dashed=True)
        panel.y.log, panel.x.limits = True, (0.0, top)
        panel.title = f"{decay.name}, load {number_text(GRAM * load, 5)} {small_unit(component)}"
    drawn.panels[-1].x.label = "frequency / Hz"
    caption = (
        "Amplitude of the output after the release over its largest line; grey: residual of the model, with amplitudes "
        "and level fitted to each record; dashed: modes of the model."
    )
    return drawn.with_title("Spectra of the free oscillations", caption)


def _band(panel: Panel, load: FloatArray, value: FloatArray, expanded: FloatArray, colour: str, label: str) -> None:
    panel.line(load, value, label, colour=colour)
    if np.any(np.isfinite(expanded)):
        panel.band(load, value - expanded, value + expanded, label, colour=colour)


def _draw_deviations(panel: Panel, component: ComponentLoads, permitted: float) -> None:
    first, load = component.series.measured.frequency_hz[:, 0], GRAM * component.series.masses.load
    compared = [
        ("two masses, by the lightest load", component.formula_hz),
        ("two masses, all loads", component.identification.rigid.frequency_hz[:, 0]),
    ]
    if not component.solutions[0].model.is_rigid:
        compared.append(("three masses", component.solutions[0].recorded.frequency_hz[:, 0]))
    panel.span(-PERCENT * permitted, PERCENT * permitted, colour=GREY)
    panel.rule(0.0, colour=GREY)
    markers = ("circle", "square", "triangle")
    for (label, values), colour, marker in zip(compared, (GREY, ORANGE, BLUE), markers, strict=False):
        panel.line(load, PERCENT * (values / first - 1.0), label, colour=colour, width=0.8)
        panel.points(load, PERCENT * (values / first - 1.0), label, colour=colour, marker=marker)
    panel.y.label = "model less measured / %"


def _empty(panel: Panel, text: str) -> None:
    """Show the reason in a panel without data."""
    panel.title = text
