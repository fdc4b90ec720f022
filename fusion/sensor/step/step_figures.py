"""Figures of step responses: fits, release devices, models over frequency, and convergence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fusion.base import MILLI, PERCENT
from fusion.report.figure import (
    BLACK,
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    LIGHT,
    PURPLE,
    RED,
    Figure,
    Panel,
    draw_response,
    empty_figure,
    frequency_axis,
    power_of_ten,
)
from fusion.sensor.step.step_pool import PooledModel
from fusion.sensor.step.step_releases import LABELS, StepComponent, StepRelease
from shaker.lti.system import ModalModel
from shaker.release.step_fit import StepFit
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.digits import number_text, typeset

BEFORE, AFTER = 0.6, 8.0
"""Periods of the lowest mode that the enlarged panel shows before the onset and after the release."""
PERIODS = 12.0  # of the lowest mode, shown after the longest release
POINTS, DOTTED = 500, 500
"""Frequencies of the model, and samples up to which each is a dot."""
MAX_FREQUENCY = 6.0  # largest frequency shown, over that of the highest mode
SHOWN_RELEASES = 3
DOT: dict[bool, dict[str, float]] = {True: {"size": 2.0}, False: {"width": 0.8}}
"""Style of a record that is drawn with dots or as a line."""
OVER_ORDER = "sim"  # the loss of "sim_zoh" is nearly equal
OVER_GENERATION = ("evolution", "evolution_coefficients")


def component_figures(component: StepComponent) -> Iterator[Figure]:
    """Yield figures of record and fit, response over frequency, devices, and convergence of a component."""
    if component.pooled is not None:
        yield draw_release(f"step-{component.component}", component.chosen[0])
        yield draw_model(f"bode-{component.component}", component, component.pooled)
    if len(component.ropes) > 1:
        yield draw_devices(f"ropes-{component.component}", component)
    losses: list[tuple[str, str, FloatArray, int | None]] = []
    for fit in (row.fit for row in component.methods if len(row.fit.convergence) > 1):
        if fit.method == OVER_ORDER:
            chosen = fit.order - 1 if 1 <= fit.order <= len(fit.convergence) else None
            losses.append((LABELS[fit.method].partition(",")[0], "order", fit.convergence, chosen))
        elif fit.method in OVER_GENERATION:
            losses.append((LABELS[fit.method], "generation", fit.convergence, None))
    if losses:
        yield draw_convergence(f"convergence-{component.component}", losses)


def draw_release(name: str, release: StepRelease) -> Figure:
    """Draw the whole record (left), the release (right), and the residuals."""
    record, reading, fit = release.record, release.reading, release.fit
    if fit is None:
        raise ValueError("release: expected one with a model, found none")
    measured, change, near = fit.fitted + fit.residual, abs(reading.steady - reading.baseline), _near_release(fit)
    everywhere = np.ones(len(near), dtype=np.bool_)
    factor, power = power_of_ten(measured)
    drawn = empty_figure(name, 5.0, (2.0, 1.0), 2)
    whole, enlarged, rest, rest_near = drawn.panels
    for upper, lower, shown, zoom in (
        (whole, rest, everywhere, ""),
        (enlarged, rest_near, near, ", around the release"),
    ):
        time = MILLI * fit.time_s[shown]
        _draw_fit(upper, fit, shown, factor)
        lower.rule(0.0, colour=LIGHT)
        lower.line(time, PERCENT * fit.residual[shown] / change, colour=BLACK, width=0.6)
        lower.x.label = "time / ms"
        upper.title, lower.title = f"{release.name}: output {release.driven}{zoom}", f"record less fit{zoom}"
    unit = f"{power}{typeset(record.unit)}"
    whole.y.label = f"output / ({unit})" if " " in unit or "/" in unit else f"output / {unit}"
    rest.y.label = "residual / %"
    caption = (
        "Record (blue) and fit (dashed); grey: while the load changes, by the fit. Below: the residual over "
        "the output's change; it is only noise if the model is correct."
    )
    return drawn.with_title(f"{release.name}: record, fit and residual", caption)


def draw_releases(components: Sequence[StepComponent]) -> list[Figure]:
    """Draw a release of every component with its model; no figure without a model."""
    chosen = [(component, component.chosen[0].fit) for component in components if component.pooled is not None]
    fits = [(component, fit) for component, fit in chosen if fit is not None]
    if not fits:
        return []
    columns = min(len(fits), 3)
    rows = -(-len(fits) // columns)
    drawn = empty_figure("releases", 0.6 + (1.8 if rows > 1 else 3.0) * rows, rows, columns, shared_x=False)
    for panel, (component, fit) in zip(drawn.panels, fits, strict=False):
        shown = _near_release(fit)
        factor, power = power_of_ten(fit.fitted)
        _draw_fit(panel, fit, shown, factor)
        panel.title = f"output {component.channel} / {power}{typeset(component.chosen[0].record.unit)}"
        panel.x.label = "time / ms"
    for panel in drawn.panels[len(fits) :]:
        panel.blank = True
    caption = "Output (blue) and model (dashed) around the release of each load; grey: while the load changes."
    return [drawn.with_title("Releases and models", caption, main=True)]


def _near_release(fit: StepFit) -> BoolArray:
    """Return the samples around the release; all of them if these are too few."""
    period = _period_s(fit.model)
    low = fit.onset_s - BEFORE * period - 0.3 * fit.release_s
    near = (fit.time_s >= low) & (fit.time_s <= fit.onset_s + fit.release_s + AFTER * period)
    return np.asarray(near if np.count_nonzero(near) > 8 else np.ones(len(near), dtype=np.bool_))


def _draw_fit(panel: Panel, fit: StepFit, shown: BoolArray, factor: float) -> None:
    """Draw samples over a factor, their fit, and the time of the release."""
    time, measured = MILLI * fit.time_s[shown], (fit.fitted + fit.residual)[shown]
    panel.span(MILLI * fit.onset_s, MILLI * (fit.onset_s + fit.release_s), "load changes", along="x", colour=GREY)
    dots = bool(np.count_nonzero(shown) <= DOTTED)
    (panel.points if dots else panel.line)(time, measured / factor, "record", colour=BLUE, **DOT[dots])
    panel.line(time, fit.fitted[shown] / factor, "fit", colour=RED, width=0.9, dashed=not dots)


def draw_devices(name: str, component: StepComponent) -> Figure:
    """Draw the first release by each device over the time since its onset."""
    periods = [_period_s(release.fit.model) for release in component.releases if release.fit is not None]
    longest = max(device.kind.length.mean for device in component.ropes)
    span = 1.5 * longest + PERIODS * float(np.median(periods) if periods else longest)
    drawn = empty_figure(name, 3.0)
    (panel,) = drawn.panels
    panel.rule([0.0, 1.0], colour=LIGHT)
    for index, device in enumerate(component.ropes):
        release = next(release for release in component.releases if release.name in device.releases)
        record, reading = release.record, release.reading
        time = record.time_s - release.timing.onset_s
        shown = (time >= -0.1 * span) & (time <= span)
        level = record.samples[record.channels.index(release.driven)][shown]
        share = (level - reading.baseline) / (reading.steady - reading.baseline)
        label = f"{device.name}, {number_text(MILLI * device.kind.length.mean)} ms"
        colour = COLOURS[index % len(COLOURS)]
        panel.line(MILLI * time[shown], share, label, colour=colour, width=0.9)
    panel.x.label, panel.y.label = "time since the onset / ms", "share of the change"
    panel.title = f"output {component.channel}"
    caption = (
        "One release by each device over the change of the output, with the duration of the change of load. A fast "
        "release makes the sensor ring; a release longer than a period of the mode hardly does."
    )
    return drawn.with_title("Release devices", caption)


def draw_model(name: str, component: StepComponent, pooled: PooledModel) -> Figure:
    """Draw the pooled model over its static gain, with bands, phase, and the measured releases."""
    model, static = pooled.model, pooled.model.static_gain
    responses = [measured_response(release) for release in component.chosen[:SHOWN_RELEASES]]
    rate_hz = min(release.record.sample_rate_hz for release in component.chosen)
    top_hz = min(0.4 * rate_hz, MAX_FREQUENCY * float(np.max(_modes_hz(model))))
    low_hz = min(float(one.frequency_hz.min()) for one in responses)
    damping = np.maximum(np.abs(model.damping_ratio), 1e-5)
    near = [f * (1.0 + z * np.linspace(-8.0, 8.0, 81)) for f, z in zip(model.frequency_hz, damping, strict=True)]
    every = np.unique(np.concatenate([np.geomspace(low_hz, top_hz, POINTS), *near]))  # more where a mode is narrow
    frequency = every[(every >= low_hz) & (every <= top_hz)]
    shown = [one.frequency_hz <= top_hz for one in responses]

    def joined(field: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.concatenate([getattr(one, field)[k] for one, k in zip(responses, shown, strict=True)])

    def size(at: ModalModel) -> FloatArray:
        return np.asarray(np.log(np.abs(at.response(frequency) / at.static_gain)))

    u, _ = pooled.spread(model.jacobian(size)[1])
    measured_hz, measured, noise = joined("frequency_hz"), joined("value") / static, joined("u") / abs(static)
    value, at_measured = model.response(frequency) / static, model.response(measured_hz) / static
    drawn = empty_figure(name, 6.2, (2.0, 1.3, 1.1))
    upper, middle, lower = drawn.panels
    for index, colour, label in (("band_5_hz", GREEN, "±5 %"), ("band_10_hz", PURPLE, "±10 %")):
        end = component.find(index)
        if end is not None and np.isfinite(end.value):
            upper.rule(end.value, f"{label} up to {number_text(end.value, 4)} Hz", along="x", colour=colour, width=1.0)
    upper.rule(1.0, colour=LIGHT)
    upper.points(measured_hz, np.abs(measured), "releases", colour=BLUE, size=2.0)
    draw_response(
        upper, middle, frequency, value, (u, np.zeros(len(u))), unwrapped=True, colour=RED, width=1.0, label="model"
    )
    upper.y.limits = (0.4 * min(1.0, float(np.abs(value).min())), 2.0 * float(np.abs(value).max()))
    upper.y.label = "|H / H(0)|"
    phase = np.degrees(np.unwrap(np.angle(value)))
    close = np.interp(measured_hz, frequency, phase)
    unwrapped = close + np.degrees(np.angle(measured * np.exp(-1j * np.radians(close))))
    middle.points(measured_hz, unwrapped, "releases", colour=BLUE, size=2.0)
    middle.y.limits = (float(phase.min()) - 60.0, max(float(phase.max()), 0.0) + 60.0)
    difference = PERCENT * np.abs(measured - at_measured)
    lower.points(measured_hz, difference, "releases less model", colour=BLACK, size=2.0)
    order = np.argsort(measured_hz)
    lower.line(measured_hz[order], PERCENT * noise[order], "noise", colour=GREY, width=0.8)
    lower.y.log, lower.y.label = True, "difference / %"
    labels = (f"output {component.channel} over load {component.component}: magnitude", "phase")
    for panel, text in zip(drawn.panels, (*labels, "releases less model, over the static gain"), strict=True):
        panel.title = text
        frequency_axis(panel.x, frequency, 1.0)
    upper.x.label = middle.x.label = ""
    caption = (
        "Model (line, with U) over its static gain, and the releases without a model (points): the spectrum of the "
        "output's derivative over that of the load. Vertical lines: |H| is within 5 and 10 % of the static gain up to "
        "there. Below: difference of model and releases over the static gain, and the contribution of noise (grey)."
    )
    return drawn.with_title(f"Output {component.channel} over load {component.component}", caption, main=True)


def draw_convergence(name: str, losses: list[tuple[str, str, FloatArray, int | None]]) -> Figure:
    """Draw the loss of each method; a ring marks the selected order."""
    drawn = empty_figure(name, 2.7, 1, len(losses))
    for panel, colour, (label, over, loss, chosen) in zip(drawn.panels, COLOURS, losses, strict=False):
        number = np.arange(1, len(loss) + 1)
        shown = loss / float(loss.min()) if loss.min() > 0.0 else loss
        panel.line(number, shown, colour=colour, width=0.9)
        if len(loss) <= 20:
            panel.points(number, shown, colour=colour, size=3.5)
        if chosen is not None:
            panel.points(number[chosen], shown[chosen], colour=BLACK, size=6.5, open=True, names=("taken",))
        panel.y.log = bool(shown.max() > 20.0 * shown.min() > 0.0)
        panel.x.label, panel.title = over, label
    drawn.panels[0].y.label = "loss over the smallest"
    caption = (
        "Loss as defined by each method. SIM: loss of the equation error over the order; where it stops falling, the "
        "order suffices for that error, not yet for the mode. Differential evolution: loss of the best member."
    )
    return drawn.with_title("Convergence of the methods", caption)


def _modes_hz(model: ModalModel) -> FloatArray:
    """Return the frequencies of the modes, else those of the real poles."""
    return np.asarray(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz))


def _period_s(model: ModalModel | None) -> float:
    return 1e-3 if model is None else 1.0 / float(np.min(_modes_hz(model)))


# The response over frequency of a release, without a model.

FINAL_FRACTION = 20  # the last 1/20 of a force's record determines its final level
MIN_EXCITATION = 0.2  # ratio to the spectrum of an ideal step below which a release excites too little


class MeasuredResponse(NamedTuple):
    """Output over load (K,) at frequencies in Hz; `u`: r.m.s. of white noise."""

    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray


def measured_response(release: StepRelease) -> MeasuredResponse:
    """Return output over load of one release from the spectra of derivatives.

    H(f) = Y'(f)/X'(f), where Y' = jω·Y is the spectrum of the differences of the samples, exact below half the sampling
    rate. X' = A·s(f)·exp(-jωt) with t the middle of the release. s = sin(πfT)/(πfT) for a load that changes linearly
    over T, and cos(πfT)/(1 - (2fT)²) for half a cosine. If the load was measured, X' is the spectrum of its samples.
    Frequencies at which the release excites less than a fifth of an ideal step are rejected. Only samples from the
    onset on are used.
    """
    record = release.record
    step = 1.0 / record.sample_rate_hz
    timing = release.timing
    onset, lasts = timing.onset_s, timing.release_s
    first = max(0, int((onset - record.start_s) / step) - 3)
    samples = record.samples[record.channels.index(release.driven), first:]
    start_s = record.start_s + first * step
    ends = release.reading.baseline, release.reading.steady
    frequency, moved = _derivative(samples, ends, start_s, step)
    if record.force is not None:
        force = record.force[first:]
        ends = float(record.force[: max(first, 1)].mean()), float(force[-max(1, len(force) // FINAL_FRACTION) :].mean())
        driven = _derivative(force, ends, start_s, step)[1]
    else:
        turn = frequency * lasts
        share = np.sinc(turn)
        if timing.shape == "smooth":
            near = np.abs(1.0 - (2.0 * turn) ** 2) < 1e-9
            below = np.where(near, 1.0, 1.0 - (2.0 * turn) ** 2)
            share = np.where(near, np.pi / 4.0, np.cos(np.pi * turn) / below)
        middle = np.exp(-2j * np.pi * frequency * (onset + 0.5 * lasts))
        driven = record.amplitude * share * middle
    excited = (np.abs(driven) >= MIN_EXCITATION * abs(record.amplitude)) & (frequency > 0.0)
    noise = 2.0 * np.pi * frequency * release.reading.noise * step * np.sqrt(len(samples))
    driven = driven[excited]
    return MeasuredResponse(frequency[excited], moved[excited] / driven, noise[excited] / np.abs(driven))


def _derivative(
    samples: FloatArray, ends: tuple[float, float], start_s: float, step_s: float
) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies (K,) and spectrum (K,) of the derivative of samples (N,) between two levels.

    The sum of the differences times exp(-jωt) is corrected by ωΔ/(2 sin(ωΔ/2)), the ratio of derivative and difference.
    """
    change = np.diff(samples, prepend=ends[0], append=ends[1])
    frequency = np.fft.rfftfreq(len(change), step_s)[:-1]
    turn = np.pi * frequency * step_s
    wide = np.divide(turn, np.sin(turn), out=np.ones_like(turn), where=turn > 0.0)
    spectrum = np.fft.rfft(change)[:-1] * wide
    return np.asarray(frequency), np.asarray(spectrum * np.exp(-2j * np.pi * frequency * (start_s - 0.5 * step_s)))
