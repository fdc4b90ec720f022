"""The page of a compensation filter."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, rounded
from fusion.report.numbers import measured, number
from fusion.report.table import Headline, Table
from fusion.sensor.compensate.evaluate import (
    HAND_DAMPING,
    HAND_STIFFNESS,
    HANDLE_MASS,
    PUSH_M,
    PUSH_S,
    CompensateEvaluation,
)
from fusion.sensor.compensate.figures import (
    draw_bode,
    draw_channel,
    draw_force_feedback,
    draw_mismatch,
    draw_noise,
    draw_step,
    label,
)
from fusion.sensor.compensate.source import Figures, LoadFilter, SubjectResult
from shaker.compensation.filter import band_ratio, best_damping
from shaker.lti.indices import LABELS, unit_of

EXPANDED = 2.0
GRAM, MILLI, PERCENT = 1e3, 1e3, 100.0
SHOWN = (
    "natural_hz",
    "damping_ratio",
    "peak_hz",
    "peak_gain",
    "band_5_hz",
    "band_10_hz",
    "half_power_hz",
    "overshoot",
    "rise_s",
    "settling_5_s",
    "settling_2_s",
)
SCALE = {"s": (MILLI, "ms"), "Hz": (1.0, "Hz"), "": (1.0, "")}
PRINTED = {"band_10_hz": "±10 % band", "overshoot": "overshoot", "settling_2_s": "2 % settling"}
ERRORS = (0.01, 0.02, 0.05, 0.1, 0.2)


class NumberRow(NamedTuple):
    """One number of one filter in compensate.csv; what does not apply is empty."""

    channel: str
    component: str
    load_mass_kg: float | None
    name: str
    value: float | None
    u: float | None
    unit: str


def quantity_rows(evaluation: CompensateEvaluation) -> Iterator[NumberRow]:
    """One row per number."""
    for result in evaluation.subjects:
        for made in result.filters:
            for number_ in _numbers(result, made):
                yield NumberRow(result.subject.channel, result.subject.component, made.load_mass, *number_)


def over(top: str, bottom: str) -> str:
    """One unit over another; 1 where they are the same."""
    if top == bottom:
        return "1"
    parts = [f"({unit})" if "/" in unit or "." in unit else unit for unit in (top, bottom)]
    return "/".join(parts)


def _numbers(result: SubjectResult, found: LoadFilter) -> Iterator[tuple[str, float | None, float | None, str]]:
    """Name, value, u and unit of everything told of one filter."""
    sensor, target = found.compensation.sensor, found.compensation.target
    modes = len(sensor.frequency_hz)
    names = [f"sensor_{name}_{m + 1}" for name in ("frequency_hz", "damping_ratio") for m in range(modes)]
    names += [f"sensor_real_hz_{q + 1}" for q in range(len(sensor.real_hz))] + ["sensor_static_gain"]
    gain_unit = over(result.subject.unit, result.subject.load_unit)
    for name, value, u in zip(names, sensor.vector, sensor.u, strict=True):
        unit = "Hz" if "_hz" in name else gain_unit if name == "sensor_static_gain" else "1"
        yield name, float(value), None if np.isnan(u) else float(u), unit
    yield "target_frequency_hz", target.frequency_hz, None, "Hz"
    yield "target_damping_ratio", target.damping_ratio, None, "1"
    for when, figures in (("before", found.before), ("after", found.after)):
        for name, value_ in figures.indices.figures().items():
            yield f"{when}_{name}", value_, figures.u[name], unit_of(name) or "1"
    yield "white_noise_gain", found.noise_gain, None, over(result.output_unit, result.subject.unit)
    yield "noise", found.noise, None, result.output_unit
    yield "discretisation_error", found.discretisation_error, None, "1"
    for off, ringing in zip(found.off_frequency, found.off_ringing, strict=True):
        yield f"ringing_frequency_{off:+g}", float(ringing), None, "1"
    for load, ringing in zip(found.off_load, found.load_ringing, strict=True):
        yield f"ringing_load_{load:.12g}_kg", float(ringing), None, "1"


def headlines(evaluation: CompensateEvaluation) -> list[Headline]:
    """Of the first filter: band, overshoot, settling, each before and after."""
    result = evaluation.subjects[0]
    found = result.filters[0]
    where = label(result, found)
    wanted = (("band_10_hz", "±10 % of the static gain up to"), ("overshoot", "Overshoot"))
    told = [
        Headline(text, cell(found.after, name), f"before: {cell(found.before, name)}; {where}")
        for name, text in (*wanted, ("settling_2_s", "2 % settling"))
    ]
    times = found.noise_gain / abs(found.sections.gain)
    remark = f"white noise at {found.sections.sample_rate_hz:g} Hz; {where}"
    return [*told, Headline("Noise", f"× {times:.3g}", remark)]


def cell(figures: Figures, name: str) -> str:
    """A figure with U and unit."""
    value, u = figures.indices.figures()[name], figures.u[name]
    if value is None or not np.isfinite(value):
        return DASH if value is None else "no end"
    percent = name == "overshoot"
    scale, unit = (PERCENT, "%") if percent else SCALE[unit_of(name)]
    if u is None:
        return f"{scale * value:.5g} {unit}".strip()
    return measured(scale * value, EXPANDED * scale * u, unit)


def index_tables(evaluation: CompensateEvaluation) -> list[Table]:
    """Figures before and after, one table per filter."""
    tables = []
    for result in evaluation.subjects:
        for found in result.filters:
            rows = [(LABELS[name].capitalize() if LABELS[name][0].islower() else LABELS[name],
                     cell(found.before, name), cell(found.after, name)) for name in SHOWN]  # fmt: skip
            known = found.compensation.sensor.covariance is not None
            caption = f"{label(result, found)}: before and after" + (", with U (k = 2)" if known else "")
            tables.append(Table(caption, ("figure", "sensor", "compensated"), "lrr", tuple(rows)))
    return tables


def filter_table(evaluation: CompensateEvaluation) -> Table:
    """Every filter: what it cancels, what it puts there, what it costs."""
    rows = []
    for result in evaluation.subjects:
        for found in result.filters:
            design = found.compensation
            u = design.sensor.u
            poles = [
                measured(f, 0.0 if np.isnan(u[m]) else EXPANDED * u[m])
                for m, f in enumerate([*design.sensor.frequency_hz])
            ]
            damped = [f"{zeta:.4g}" for zeta in design.sensor.damping_ratio]
            rows.append(
                (
                    label(result, found),
                    Markup("; ").join([*poles, *(f"real {hertz:.5g}" for hertz in design.sensor.real_hz)]),
                    "; ".join(damped) or DASH,
                    f"{design.target.frequency_hz:.6g}",
                    f"{design.target.damping_ratio:.4g}",
                    f"{found.sections.sample_rate_hz:g}",
                    f"{found.noise_gain / abs(found.sections.gain):.3g}",
                    DASH if found.noise is None else f"{number(found.noise)} {result.output_unit}",
                    f"{PERCENT * found.discretisation_error:.2g}",
                )
            )
    head = ("filter", "from / Hz", "ζ", "to / Hz", "to ζ", "rate / Hz", "noise ×", "noise after", "sampling / %")
    return Table("Filters, with U (k = 2) where it is known", head, "lrrrrrrrr", tuple(rows))


def mismatch_tables(evaluation: CompensateEvaluation) -> list[Table]:
    """Residual ringing with other loads, one row per filter; else with a frequency that is off."""
    tables = []
    for result in evaluation.subjects:
        first = result.filters[0]
        loads = len(first.off_load) > 1
        head = [result.subject.load_text(float(load)) for load in first.off_load] if loads else []
        head = head or [_signed_percent(off) for off in first.off_frequency]
        rows = [
            (
                label(result, found),
                *(f"{PERCENT * r:.3g}" for r in (found.load_ringing if loads else found.off_ringing)),
            )
            for found in result.filters
        ]
        what = "with other loads" if loads else "with a sensor whose frequency is off"
        caption = f"{result.subject.name}: residual ringing {what}, % of the step after {MILLI * first.after_s:.3g} ms"
        if head:
            tables.append(Table(caption, ("filter for", *head), "l" + "r" * len(head), tuple(rows)))
    return tables


def _signed_percent(share: float) -> str:
    """A share in % with its sign, none before zero."""
    return f"{PERCENT * share:+g} %".replace("-", "\N{MINUS SIGN}") if share else "0 %"


def haptics_table(evaluation: CompensateEvaluation) -> Table | None:
    """How stiff the force feedback may be made with each treatment of the signal, and how well it then tracks."""
    found = evaluation.haptics
    if found is None:
        return None
    rows = []
    for case in found.cases:
        error = case.run.tracking_error
        at_shared = f"{PERCENT * error:.3g} %" if np.isfinite(error) and case.run.stable else "runs away"
        rows.append((case.name, f"{case.largest_gain:.4g}", f"{PERCENT * case.own_error:.3g} %", at_shared))
    head = ("signal", "largest stable K", "tracking error at half of it", f"at K = {found.gain:.3g}")
    caption = f"{found.channel}: force feedback with a load of {GRAM * found.load_mass:.4g} g"
    return Table(caption, head, "lrrr", tuple(rows))


def damping_table(evaluation: CompensateEvaluation) -> Table:
    """The damping ratio with the widest band for a permitted error, and that band over the natural frequency."""
    ratios = sorted({*ERRORS, evaluation.wish.permitted_error})
    target = evaluation.subjects[0].filters[0].compensation.target
    rows = [
        (
            f"±{PERCENT * error:g} %",
            f"{best_damping(error):.4f}",
            f"{band_ratio(best_damping(error) * (1 + 1e-12), error):.4f}",
            f"{band_ratio(target.damping_ratio, error):.4f}",
        )
        for error in ratios
    ]
    head = ("permitted error", "best ζ", "band / fn", f"band / fn with ζ = {target.damping_ratio:.4g}")
    return Table("One mode: the damping ratio with the widest band", head, "lrrr", tuple(rows))


def printed(evaluation: CompensateEvaluation) -> Iterator[str]:
    """Lines for the terminal, with U (k = 2) where it is known."""
    for result in evaluation.subjects:
        for found in result.filters:
            target, rate = found.compensation.target, found.sections.sample_rate_hz
            from_hz, from_damping = (plain(found.before, name) for name in ("natural_hz", "damping_ratio"))
            yield f"{label(result, found)}"
            yield f"  natural frequency: {from_hz} -> {target.frequency_hz:.6g} Hz"
            yield f"  damping ratio: {from_damping} -> {target.damping_ratio:.4g}"
            for name, text in PRINTED.items():
                yield f"  {text}: {plain(found.before, name)} -> {plain(found.after, name)}"
            yield f"  white noise at {rate:g} Hz: × {found.noise_gain / abs(found.sections.gain):.3g}"


def plain(figures: Figures, name: str) -> str:
    """A figure with U and unit as plain text."""
    value, u = figures.indices.figures()[name], figures.u[name]
    if value is None or not np.isfinite(value):
        return "none" if value is None else "no end"
    scale, unit = (PERCENT, "%") if name == "overshoot" else SCALE[unit_of(name)]
    told = rounded(scale * value, 0.0 if u is None else EXPANDED * scale * u)
    power = f"e{told.exponent}" if told.exponent else ""
    body = told.value if told.expanded == DASH else f"({told.value} ± {told.expanded})"
    return f"{body}{power} {unit}".strip()


def page_context(evaluation: CompensateEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    filters = [(result, made) for result in evaluation.subjects for made in result.filters]
    error, applied = evaluation.wish.permitted_error, evaluation.applied
    mismatches = [draw_mismatch(f"mismatch-{n}", result) for n, result in enumerate(evaluation.subjects)]
    return {
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation),
        "filters": filter_table(evaluation),
        "damping": damping_table(evaluation),
        "parts": [
            (label(*made), [draw_bode(f"bode-{n}", *made, error), draw_step(f"step-{n}", *made)], table)
            for n, (made, table) in enumerate(zip(filters, index_tables(evaluation), strict=True))
        ],
        "noise": [draw_noise(evaluation)],
        "mismatch": [picture for picture in mismatches if picture is not None],
        "mismatches": mismatch_tables(evaluation),
        "applied": [] if applied is None else [draw_channel(applied, one) for one in applied.channels],
        "haptics": haptics_table(evaluation),
        "haptics_pictures": [picture for picture in [draw_force_feedback(evaluation)] if picture is not None],
        "loop": _loop(evaluation),
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
