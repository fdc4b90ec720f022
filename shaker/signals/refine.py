"""Frequencies refined by least squares, jointly over harmonics and channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.signals.sine import SineModel, UniformTimes, fit_sines


@dataclass(frozen=True)
class Refined:
    """Fundamentals refined by least squares: `frequency_hz`, `u_frequency_hz` (Q,)."""

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray


def refine_frequency(
    time_s: FloatArray | UniformTimes, values: FloatArray, start_hz: FloatArray, multiples: Sequence[Sequence[int]]
) -> Refined:
    """Refine fundamentals (Q,) jointly with their harmonics over all channels of `values` (S, C).

    `fit_sines` with frequencies free: `multiples[q]` lists the harmonics of fundamental q, 1 among them, which share
    its relative change. Channels weigh by their residuals.
    """
    check_shape("values", values, (len(time_s), None))
    label = tuple(q for q, orders in enumerate(multiples) for _ in orders)
    order = np.array([m for orders in multiples for m in orders], dtype=np.float64)
    names = [str(c) for c in range(values.shape[1])]
    fit = fit_sines(time_s, values, order * start_hz[list(label)], names, names, model=SineModel(free=label))
    first = [label.index(q) for q in range(len(start_hz))]
    return Refined(fit.phasors.frequency_hz[first] / order[first], fit.u_frequency_hz[first] / order[first])
