"""Width of a trigger's pulses, as a strobe's exposure needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.notice import Notice
from shaker.signals.edges import find_edges
from shaker.signals.trigger import TriggerFit, fit_trigger

_LEAST = 1.5  # samples: pulses shorter than one fall between the samples, and those seen seem one long
_LEAST_RISES = 5.0  # of the rise: shorter pulses do not settle at their level
_NEAR = 16  # samples beside a flank on which its rise is looked for
_RINGING = 0.2  # standard uncertainty in samples² over the width: crossings of one flank on the ringing of the other


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

    Default threshold: half height, midway between the medians of the samples of either level. Both flanks follow the
    same periodic model (`fit_trigger`); the width is the distance of their lines in the middle of the burst, where
    neither depends on the period. Independent errors are assumed: jitter common to both flanks makes the uncertainty
    too large, never too small. Behind a low-pass filter one flank lies on the ringing of the other, an ideal filter's
    being sin(πx)/(π²x) at x samples from it, which the uncertainty of short pulses allows for.
    """
    ends: Literal["rising", "falling"] = "falling" if edge == "rising" else "rising"
    low, high = _levels(samples, find_edges(samples, sample_rate_hz, threshold, edge).threshold)
    level = (low + high) / 2.0 if threshold is None else threshold
    begin = fit_trigger(find_edges(samples, sample_rate_hz, level, edge))
    end = fit_trigger(find_edges(samples, sample_rate_hz, level, ends))
    if abs(end.period_s / begin.period_s - 1.0) > 0.5 / begin.edges:
        raise ValueError(
            f"samples: expected pulses, found {edge} edges every {begin.period_s:.6g} s and {ends} ones every "
            f"{end.period_s:.6g} s"
        )
    middle = np.asarray(begin.edges // 2)
    # The first end after this beginning.
    partner = np.asarray(np.ceil((begin.time_s(middle) - end.start_s) / end.period_s), dtype=np.int64)
    width = float(end.time_s(partner) - begin.time_s(middle))
    flanks = sample_rate_hz * np.concatenate([begin.edge_s, end.edge_s])
    least = max(_LEAST, _LEAST_RISES * _rise((samples - low) / (high - low), flanks))
    if width * sample_rate_hz < least:
        raise ValueError(
            f"samples: expected pulses of at least {least:.2g} samples, {1e6 * least / sample_rate_hz:.3g} us, found "
            f"some of {1e6 * width:.3g} us"
        )
    u = float(np.hypot(begin.u_time_s(middle), end.u_time_s(partner)))
    if "resolved" in (begin.kind, end.kind):
        u = float(np.hypot(u, _RINGING / (width * sample_rate_hz**2)))
    notices = tuple(dict.fromkeys(begin.notices + end.notices))
    return PulseWidth(width, u, min(len(begin.number), len(end.number)), begin, end, notices)


def _levels(samples: FloatArray, between: float) -> tuple[float, float]:
    """Return the medians of the samples below and above a level between them."""
    above = samples >= between
    return float(np.median(samples[~above])), float(np.median(samples[above]))


def _rise(height: FloatArray, flanks: FloatArray) -> float:
    """Return how many samples per flank, these at places (E,), lie between 10 % and 90 % of the height (S,)."""
    near = np.rint(flanks).astype(np.int64)[:, None] + np.arange(-_NEAR, _NEAR + 1)
    beside = height[np.unique(np.clip(near, 0, len(height) - 1))]
    return float(np.count_nonzero(np.abs(beside - 0.5) < 0.4) / len(flanks))
