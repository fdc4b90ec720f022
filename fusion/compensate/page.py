"""compensate.html: one self-contained page with curves, figures and costs of every filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.compensate import tables
from fusion.compensate.evaluation import CompensateEvaluation
from fusion.compensate.haptics import HAND_DAMPING, HAND_STIFFNESS, HANDLE_MASS, PUSH_M, PUSH_S
from fusion.compensate.result import CompensatedChannel, FloatArray, LoadFilter, SubjectResult
from fusion.evaluated import page_frame
from fusion.page import render_page
from fusion.plots.compensate import (
    BodeCurves,
    FilteredChannel,
    MismatchCurve,
    NoiseCurve,
    PushedBall,
    StepCurves,
    draw_bode,
    draw_channel,
    draw_haptics,
    draw_mismatch,
    draw_noise,
    draw_steps,
)
from fusion.plots.style import Picture
from shaker.models.compensation.uncertainty import gain_band

PAGE_FILE = "compensate.html"
POINTS = 900
STEP_POINTS = 3000
STEP_PERIODS = 20.0
DRAWN = 20_000


def render_compensate_page(evaluation: CompensateEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("compensate.html", _context(evaluation))


def frequencies(found: LoadFilter) -> FloatArray:
    """Frequencies (K,) in Hz of the curves of a filter: two decades below its modes to half the sampling rate."""
    known = [*found.compensation.sensor.frequency_hz, *found.compensation.sensor.real_hz]
    low, high = min(known) / 50.0, 0.5 * found.sections.sample_rate_hz
    even = np.geomspace(low, min(high, 40.0 * found.compensation.target.frequency_hz), POINTS)
    return np.unique(np.concatenate([even, *(f * (1.0 + np.linspace(-0.05, 0.05, 101)) for f in known)]))


def _context(evaluation: CompensateEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    filters = [(result, found) for result in evaluation.subjects for found in result.filters]
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "filters": tables.filter_table(evaluation),
        "damping": tables.damping_table(evaluation),
        "parts": [
            (tables.label(result, found), [_bode(result, found, evaluation, n), _step(result, found, n)], table)
            for n, ((result, found), table) in enumerate(zip(filters, tables.index_tables(evaluation), strict=True))
        ],
        "noise": [_noise(evaluation)],
        "mismatch": [picture for n, result in enumerate(evaluation.subjects) for picture in _mismatch(result, n)],
        "mismatches": tables.mismatch_tables(evaluation),
        "applied": []
        if evaluation.applied is None
        else [_channel(evaluation, one) for one in evaluation.applied.channels],
        "haptics": tables.haptics_table(evaluation),
        "haptics_pictures": _haptics(evaluation),
        "loop": _loop(evaluation),
        **page_frame(evaluation),
    }


def _subject(evaluation: CompensateEvaluation) -> list[tuple[str, str]]:
    """What is compensated, and how."""
    wish = evaluation.wish
    aim = (
        f"±{100 * wish.permitted_error:g} % to {wish.bandwidth_hz:g} Hz"
        if wish.bandwidth_hz is not None
        else f"{wish.frequency_hz:g} Hz"
    )
    kind = "matched poles and zeros" if wish.discretisation == "matched" else "Tustin, prewarped at each mode"
    facts = [("Wanted", aim), ("For samples", kind)]
    facts += [(f"Model of {one.subject.name}", one.subject.source) for one in evaluation.subjects]
    if evaluation.applied is not None:
        facts.append(("Recording", evaluation.applied.name))
    return facts


def _bode(result: SubjectResult, found: LoadFilter, evaluation: CompensateEvaluation, number: int) -> Picture:
    """Gain and phase before and after."""
    design, hertz = found.compensation, frequencies(found)
    sensor = design.sensor.system.response(hertz) / design.sensor.static_gain
    known = design.sensor.covariance is not None
    curves = BodeCurves(
        title=tables.label(result, found),
        frequency_hz=hertz,
        before=sensor,
        after=sensor * design.system.response(hertz) / design.gain,
        sampled=sensor * found.sections.response(hertz) / found.sections.gain,
        u_gain=gain_band(design, hertz).u_gain if known else None,
        error=evaluation.wish.permitted_error,
        bands_hz=(found.before.indices.band_10_hz, found.after.indices.band_10_hz),
    )
    return draw_bode(f"bode-{number}", curves)


def _step(result: SubjectResult, found: LoadFilter, number: int) -> Picture:
    """A step before and after."""
    design = found.compensation
    time = np.linspace(0.0, STEP_PERIODS / design.target.frequency_hz, STEP_POINTS)
    before = design.sensor.system.step(time) / design.sensor.static_gain
    after = design.compensated.step(time) / design.compensated.static_gain
    return draw_steps(f"step-{number}", StepCurves(tables.label(result, found), time, before, after))


def _noise(evaluation: CompensateEvaluation) -> Picture:
    """What the filters do to noise."""
    curves = []
    for result in evaluation.subjects:
        for found in result.filters:
            hertz = frequencies(found)
            gain = np.abs(found.sections.response(hertz) / found.sections.gain)
            white = found.noise_gain / abs(found.sections.gain)
            curves.append(NoiseCurve(tables.label(result, found), hertz, gain, white))
    return draw_noise("noise", curves)


def _mismatch(result: SubjectResult, number: int) -> list[Picture]:
    """Residual ringing over the load, or over an error of the frequency."""
    first = result.filters[0]
    after = f"Largest deviation from the final value from {1e3 * first.after_s:.3g} ms after a step on."
    subject = result.subject
    scale, unit = (1e3, "g") if subject.load_unit == "N" else (1.0, "(kg·m²)")
    if len(first.off_load) > 1:
        curves = [
            MismatchCurve(
                f"filter for {subject.load_text(one.load_mass or 0.0)}", scale * one.off_load, one.load_ringing
            )
            for one in result.filters
        ]
        return [draw_mismatch(f"mismatch-{number}", curves, f"load / {unit}", after)]
    if not len(first.off_frequency):
        return []
    curves = [
        MismatchCurve(tables.label(result, one), 100 * one.off_frequency, one.off_ringing) for one in result.filters
    ]
    return [draw_mismatch(f"mismatch-{number}", curves, "frequency of the sensor off by / %", after)]


def _haptics(evaluation: CompensateEvaluation) -> list[Picture]:
    """Applied and fed-back force with the filter for no load and with the own one."""
    found = evaluation.haptics
    if found is None:
        return []
    runs = [
        PushedBall(case.name, case.run.time_s, case.run.applied, case.run.fed_back)
        for case in (found.cases[1], found.cases[2])
    ]
    return [draw_haptics("haptics", runs, found.gain)]


def _loop(evaluation: CompensateEvaluation) -> str:
    """The loop of the check in words."""
    found = evaluation.haptics
    if found is None:
        return ""
    return (
        f"A hand ({HAND_STIFFNESS:g} N/m, {HAND_DAMPING:g} N·s/m) pushes a handle of {HANDLE_MASS:g} kg by "
        f"{1e3 * PUSH_M:g} mm in {PUSH_S:g} s against a virtual ball of {found.ball_stiffness:g} N/m. The device "
        "pushes back with the force of the ball and K times its difference to what the sensor tells, one sample late. "
        "Tracking error: rms of applied less fed-back force over rms of the latter while the ball is touched."
    )


def _channel(evaluation: CompensateEvaluation, channel: CompensatedChannel) -> Picture:
    """One filtered channel, thinned out."""
    applied = evaluation.applied
    assert applied is not None
    every = max(1, -(-len(channel.value) // DRAWN))
    keep = slice(None, None, every)
    raw, value = channel.raw - channel.raw[0], channel.value - channel.value[0]
    shown = FilteredChannel(
        channel.channel, channel.unit, applied.time_s[keep], raw[keep], value[keep], channel.u[keep]
    )
    return draw_channel(f"recording-{channel.channel}", shown)
