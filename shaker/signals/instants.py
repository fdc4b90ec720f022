"""Instants of single trigger edges from all records that saw them: the periodic model and each edge's own deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.signals.sync import ClockTie
from shaker.signals.trigger import TriggerFit


@dataclass(frozen=True)
class EdgeInstants:
    """Times (F,) of edges on the base clock and their standard uncertainty (F,), which holds that of model and ties."""

    time_s: FloatArray
    u_time_s: FloatArray

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("u_time_s", self.u_time_s, self.time_s.shape)


def edge_instants(
    base: TriggerFit, number: IntArray, others: Sequence[tuple[TriggerFit, ClockTie]] = ()
) -> EdgeInstants:
    """Return the instants of the base record's edges numbered (F,), with what other records saw of the same edges.

    An edge is the model's time plus a Gaussian deviation of the size of the jitter. Resolved crossings update it as
    readings with their own noise; intervals truncate what is left. So edges without jitter follow the model, those with
    much follow what was seen, and one that no record has seen keeps the model's time and the jitter as uncertainty.
    """
    records = [(base, base.number, None), *((fit, fit.number + tie.shift, tie) for fit, tie in others)]
    mean, variance = np.zeros(len(number)), base.jitter_s**2 + base.u_time_s(number) ** 2
    below, above = np.full(len(number), -np.inf), np.full(len(number), np.inf)
    model = base.time_s(number)
    for fit, seen, tie in records:
        _, at, which = np.intersect1d(number, seen, return_indices=True)
        lower, upper, edge = (
            (time if tie is None else tie.to_base_s(time)) - model[at]
            for time in (fit.lower_s[which], fit.upper_s[which], fit.edge_s[which])
        )
        if fit.kind == "resolved":
            u_tie = np.zeros(len(at)) if tie is None else tie.u_to_base_s(fit.edge_s[which])
            noise = np.maximum(fit.resolution_s**2 / 12.0 + u_tie**2, 1e-30)
            gain = variance[at] / (variance[at] + noise)
            mean[at] += gain * (edge - mean[at])
            variance[at] *= 1.0 - gain
        else:
            below[at], above[at] = np.maximum(below[at], lower), np.minimum(above[at], upper)
    mean, variance = _truncated(mean, variance, below, above)
    return EdgeInstants(model + mean, np.sqrt(variance))


def _truncated(
    mean: FloatArray, variance: FloatArray, below: FloatArray, above: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of Gaussians (F,) between bounds; as they were where the bounds are far off."""
    from scipy.special import ndtr

    deviation = np.sqrt(np.maximum(variance, 1e-30))
    low, high = np.clip((below - mean) / deviation, -40.0, 40.0), np.clip((above - mean) / deviation, -40.0, 40.0)
    share = ndtr(high) - ndtr(low)
    # An interval that the model misses by more than the jitter explains says nothing about the jitter.
    inside = share > 1e-6
    share = np.where(inside, share, 1.0)
    density_low, density_high = np.exp(-0.5 * low**2), np.exp(-0.5 * high**2)
    step = (density_low - density_high) / np.sqrt(2.0 * np.pi) / share
    spread = 1.0 + (low * density_low - high * density_high) / np.sqrt(2.0 * np.pi) / share - step**2
    return (
        np.where(inside, mean + deviation * step, mean),
        np.where(inside, variance * np.clip(spread, 0.0, 1.0), variance),
    )
