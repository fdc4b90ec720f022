"""Difference equations sample by sample, compiled: importing this module brings numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from shaker.arrays import FloatArray

njit: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(cache=True, nogil=True)


@njit
def filtered(top: FloatArray, bottom: FloatArray, load: FloatArray) -> FloatArray:
    """Return the output (N,) of Σ b z⁻ⁱ/Σ a z⁻ⁱ, `top` b (n + 1,) over `bottom` a (n + 1,), a0 = 1, for a load (N,)."""
    order = len(top) - 1
    state, answer = np.zeros(order + 1), np.empty(len(load))
    for k in range(len(load)):
        x = load[k]
        y = state[0] + top[0] * x
        for i in range(order):
            state[i] = state[i + 1] + x * top[i + 1] - y * bottom[i + 1]
        answer[k] = y
    return answer
