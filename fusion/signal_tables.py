"""The report's tables of signals: lines, channels, what drifted, clocks and triggers."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from fusion.drift import Drift, drifts
from fusion.evaluation import Evaluation
from fusion.highlights import main_line
from fusion.measured_results import ClockResult
from fusion.polar import DASH, element_covariance, polar, prefix, typeset
from fusion.report_numbers import fixed, measured, microseconds, number, phase, short
from fusion.report_tables import PREFIXED, Table

OTHER_LINES = 30
"""Lines without results that are listed, those that stand out most."""
LEAST_CHANCE = 1e-4
"""Below it, a chance is only said to be smaller."""


def lines_table(evaluation: Evaluation) -> Table:
    """The lines evaluated, the others that stand out most, and why."""
    lines, others = evaluation.lines, evaluation.lines.others
    rows = [
        (float(f), (measured(f, 2.0 * u), f"{nominal:g}", str(int(multiple)), "result", why))
        for f, u, nominal, multiple, why in zip(
            lines.frequency_hz, lines.u_frequency_hz, lines.nominal_hz, lines.multiple, lines.why, strict=True
        )
    ]
    for i in np.argsort(-others.snr, kind="stable")[:OTHER_LINES].tolist():
        f, u = float(others.frequency_hz[i]), float(others.u_frequency_hz[i])
        beside = bool(np.any(np.abs(lines.nuisance_hz - f) <= 6.0 * u))
        use = "fitted beside" if beside else "not fitted"
        rows.append((f, (measured(f, 2.0 * u), DASH, DASH, use, others.why[i])))
    rows.sort(key=lambda row: row[0])
    more = len(others.snr) - OTHER_LINES
    head = ("frequency / Hz", "nominal / Hz", "multiple", "use", "reason")
    caption = "Lines of the record, with U (k = 2)" + (f"; {more} weaker ones are left out" if more > 0 else "")
    return Table(caption, head, "rrrll", tuple(cells for _, cells in rows))


def channels_table(evaluation: Evaluation) -> Table | None:
    """Every DAQ channel at the strongest line."""
    line, rows = main_line(evaluation), []
    for channel in evaluation.channels:
        value = complex(channel.phasors.value[line, 0])
        element = polar(
            value, element_covariance(channel.phasors.covariance[line], 0), float(channel.phasors.dof[line])
        )
        factor, letter = prefix(np.array([abs(value)])) if channel.unit in PREFIXED else (1.0, "")
        amplitude = measured(element.magnitude / factor, element.expanded_magnitude / factor, letter + channel.unit)
        rest = Markup("{} {}").format(short(channel.residual_rms / factor), typeset(letter + channel.unit))
        rows.append(
            (
                channel.name,
                channel.daq,
                channel.quantity,
                f"{channel.sample_rate_hz:g}",
                amplitude,
                phase(element),
                rest,
            )
        )
    head = ("channel", "DAQ", "quantity", "rate / Hz", "amplitude", "phase / rad", "residual rms")
    caption = "Channels at the strongest line; U (95 %) from the scatter alone"
    return Table(caption, head, "lllrrrr", tuple(rows)) if rows else None


def drift_table(evaluation: Evaluation) -> Table | None:
    """Return the changes of the driven lines over the record, one row per instrument; None without any."""
    found = drifts(evaluation.channels, evaluation.stereo, evaluation.lines, evaluation.clocks)
    if not found:
        return None
    head = ("instrument", "line / Hz", "blocks", "periods in each", "amplitude / %", "phase / mrad", "chance of noise")
    caption = (
        "Change of amplitude and phase over the record, with U (k = 2) that has the rates of the clocks in it, from "
        "blocks of whole periods or beats"
    )
    return Table(caption, head, "lrrrrrr", tuple(_drift_cells(drift) for drift in found))


def clocks_table(evaluation: Evaluation) -> Table | None:
    """Triggers and ties of the DAQ blocks, one column each."""
    if not evaluation.clocks:
        return None
    found = ["file", "edges found", "missing, doubled, spurious", "trigger rate / Hz", "jitter beyond sampling / µs"]
    found += ["first edge / s", "pulse width / µs"]
    names = [*found, "offset in the middle / s", "rate − 1 / 10⁻⁶", "edges paired by"]
    columns = [
        (clock.file.name, *_trigger_cells(clock), *_tie_cells(clock, evaluation.clocks[0]))
        for clock in evaluation.clocks
    ]
    rows = tuple((name, *(column[place] for column in columns)) for place, name in enumerate(names))
    head = ("", *(clock.daq for clock in evaluation.clocks))
    return Table("Camera trigger and clocks, U (k = 2)", head, "l" + "r" * len(columns), rows)


def _drift_cells(drift: Drift) -> tuple[str, ...]:
    """One instrument at one line."""
    return (
        drift.name,
        f"{drift.frequency_hz:.4f}",
        str(drift.blocks),
        f"{drift.periods:.0f}" if drift.whole else f"{drift.periods:.2f}, not whole",
        fixed(100.0 * drift.amplitude, 200.0 * drift.u_amplitude, 0),
        fixed(1e3 * drift.phase_rad, 2e3 * drift.u_phase_rad, 0),
        f"{drift.chance:.2g}" if drift.chance >= LEAST_CHANCE else f"below {LEAST_CHANCE:g}",
    )


def _trigger_cells(clock: ClockResult) -> list[str]:
    """Edges, missing, doubled and spurious ones, rate, jitter, first edge."""
    trigger = clock.trigger
    if trigger is None:
        return ["no trigger", *[DASH] * 5]
    u_start, u_period = 2.0 * np.sqrt(np.diag(trigger.covariance))
    return [
        str(len(trigger.number)),
        f"{len(trigger.missing)}, {trigger.doubled}, {trigger.spurious}",
        measured(1.0 / trigger.period_s, float(u_period) / trigger.period_s**2),
        number(1e6 * trigger.jitter_s),
        measured(trigger.start_s, float(u_start)),
        microseconds(clock.pulse_width_s, clock.u_pulse_width_s),
    ]


def _tie_cells(clock: ClockResult, base: ClockResult) -> list[str]:
    """Offset in the middle of the common edges and rate against the first block, and what paired the edges."""
    tie = clock.tie
    if tie is None:
        return ["time base" if clock is base else "time base of its take", DASH, DASH]
    middle = np.asarray(tie.middle_s)
    offset = measured(float(tie.to_base_s(middle)) - tie.middle_s, 2.0 * float(tie.u_to_base_s(middle)))
    rate = measured(1e6 * (tie.rate - 1.0), 2e6 * float(np.sqrt(tie.covariance[1, 1])))
    return [offset, rate, f"{tie.decided_by} ({tie.pairs})"]
