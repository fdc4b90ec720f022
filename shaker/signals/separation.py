"""Which lines a series of sampling times can tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.notice import Notice
from shaker.signals.folding import alias_frequency, condition_number, sampling_grid, sine_columns

MAX_CONDITION = 10.0  # above it, the standard uncertainty of a line is several times that of well-spread sampling


def usable_lines(
    time_s: FloatArray, frequency_hz: FloatArray, max_condition: float = MAX_CONDITION, drift: bool = False
) -> tuple[BoolArray, tuple[Notice, ...]]:
    """Return which lines (K,) these sampling times can tell apart, and a notice for each that is dropped.

    Lines are taken in the order given (fundamentals first, please); one is dropped when, with the lines kept so far
    and the offset, it lifts the condition number of the design matrix above `max_condition`.
    """
    columns = sine_columns(time_s, frequency_hz, drift)
    gram = columns.T @ columns
    constant = list(range(2 * len(frequency_hz), columns.shape[1]))
    kept: list[int] = []
    notices: list[Notice] = []
    for k in range(len(frequency_hz)):
        chosen = [i for line in [*kept, k] for i in (2 * line, 2 * line + 1)] + constant
        if condition_number(gram[np.ix_(chosen, chosen)]) <= max_condition:
            kept.append(k)
        else:
            notices.append(_dropped(time_s, float(frequency_hz[k]), [float(frequency_hz[i]) for i in kept]))
    mask = np.zeros(len(frequency_hz), dtype=np.bool_)
    mask[kept] = True
    return mask, tuple(notices)


def _dropped(time_s: FloatArray, frequency: float, kept: Sequence[float]) -> Notice:
    """Say why a line cannot be used: what it folds onto, with the alias frequencies."""
    where = f"{frequency:.6g} Hz"
    grid = sampling_grid(time_s)
    if grid is None:
        return Notice("warning", f"{where} cannot be told apart from the other lines at these sampling times", where)
    rate, resolution = grid.rate_hz, grid.rate_hz / grid.length
    alias = float(alias_frequency(frequency, rate))
    reasons = [(alias, "zero"), (abs(rate / 2.0 - alias), "the Nyquist frequency")]
    for other in kept:
        other_alias = float(alias_frequency(other, rate))
        reasons.append((abs(alias - other_alias), f"the line {other:.6g} Hz (at {other_alias:.4g} Hz)"))
    distance, target = min(reasons)
    close = f"onto {target}" if distance < 1e-3 * resolution else f"to within {distance:.3g} Hz of {target}"
    text = (
        f"{where} is dropped: sampled at {rate:.6g} Hz it folds to {alias:.4g} Hz, {close}, "
        f"and {grid.length / rate:.4g} s of record resolve {resolution:.3g} Hz"
    )
    return Notice("warning", text, where)
