"""Width of a trigger's pulses, as a strobe's exposure needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.notice import Notice
from shaker.signals.edges import find_edges
from shaker.signals.trigger import TriggerFit, fit_trigger


@dataclass(frozen=True)
class PulseWidth:
    """Mean width of a signal's pulses with its standard uncertainty, their number, and the models of both flanks."""

    width_s: float
    u_width_s: float
    pulses: int
    begin: TriggerFit
    end: TriggerFit
    notices: tuple[Notice, ...]


def pulse_width(
    samples: FloatArray,
    sample_rate_hz: float,
    threshold: float | None = None,
    edge: Literal["rising", "falling"] = "rising",
) -> PulseWidth:
    """Measure the width of the pulses that begin with `edge` in samples (S,), where they cross `threshold`.

    Both flanks follow the same periodic model (`fit_trigger`); the width is the distance of their lines in the middle
    of the burst, where neither depends on the period. Independent errors are assumed: jitter common to both flanks
    makes the uncertainty too large, never too small.
    """
    ends: Literal["rising", "falling"] = "falling" if edge == "rising" else "rising"
    begin = fit_trigger(find_edges(samples, sample_rate_hz, threshold, edge))
    end = fit_trigger(find_edges(samples, sample_rate_hz, threshold, ends))
    if abs(end.period_s / begin.period_s - 1.0) > 0.5 / begin.edges:
        raise ValueError(
            f"samples: expected pulses, found {edge} edges every {begin.period_s:.6g} s and {ends} ones every "
            f"{end.period_s:.6g} s"
        )
    middle = np.asarray(begin.edges // 2)
    # The first end after this beginning.
    partner = np.asarray(np.ceil((begin.time_s(middle) - end.start_s) / end.period_s), dtype=np.int64)
    width = float(end.time_s(partner) - begin.time_s(middle))
    u = float(np.hypot(begin.u_time_s(middle), end.u_time_s(partner)))
    notices = tuple(dict.fromkeys(begin.notices + end.notices))
    return PulseWidth(width, u, min(len(begin.number), len(end.number)), begin, end, notices)
