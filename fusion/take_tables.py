"""The report's table of takes: how far the reference channel tied them, and what drifted between them."""

from __future__ import annotations

import numpy as np

from fusion.evaluation import Evaluation
from fusion.report_numbers import fixed
from fusion.report_tables import Table


def takes_table(evaluation: Evaluation) -> Table | None:
    """Return frequency, amplitude and phase of the reference at the driven lines of every take; None without takes."""
    takes = evaluation.takes
    if not takes:
        return None
    rows = []
    for k in np.flatnonzero(evaluation.lines.multiple == 1):
        for take in takes:
            drift = fixed(100.0 * take.drift[k], 200.0 * take.u_drift[k], 0) if take is not takes[0] else "0"
            ppm = 1e6 * (take.frequency_hz[k] / takes[0].frequency_hz[k] - 1.0)
            phase = np.angle(take.factor[k])
            rows.append((take.name, f"{take.frequency_hz[k]:.5f}", f"{ppm:+.2f}", drift, f"{phase:+.4f}"))
    head = ("take", "line / Hz", "frequency − first / 10⁻⁶", "amplitude − first / %", "turned by / rad")
    caption = (
        f"Takes, referred to the first by the channel {takes[0].reference}: its line, amplitude with U (k = 2) from "
        "noise, and the angle by which all phasors of the take were turned"
    )
    return Table(caption, head, "lrrrr", tuple(rows))
