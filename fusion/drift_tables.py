"""The report's table of what changed while the instruments were recording."""

from __future__ import annotations

from fusion.drift import Drift, drifts
from fusion.evaluation import Evaluation
from fusion.report_numbers import fixed
from fusion.report_tables import Table

LEAST_CHANCE = 1e-4


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
    return Table(caption, head, "lrrrrrr", tuple(_row(drift) for drift in found))


def _row(drift: Drift) -> tuple[str, ...]:
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
