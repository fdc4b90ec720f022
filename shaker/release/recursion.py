"""Difference equations sample by sample, compiled: importing this module brings numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from shaker.arrays import FloatArray, IntArray

njit: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(cache=True, nogil=True)
HUGE = 1e100  # loss from which a model counts as grown without bound


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


@njit
def dealt(order: IntArray, turns: IntArray) -> IntArray:
    """Return three others for each of P members, (3, P): the first of `order` (P,), which is shuffled anew for each.

    `turns` (P, P): what each shuffle makes of the order before it; the last one is left in `order`.
    """
    count = len(order)
    chosen, shuffled = np.empty((3, count), dtype=np.int64), np.empty(count, dtype=np.int64)
    for p in range(count):
        for i in range(count):
            shuffled[i] = order[turns[p, i]]
        order[:] = shuffled
        own = 0
        for k in range(3):
            own += order[k + own] == p
            chosen[k, p] = order[k + own]
    return chosen


@njit
def losses(members: FloatArray, most: FloatArray, load: FloatArray, output: FloatArray, before: float) -> FloatArray:
    """Return the squared output errors (P,) of difference equations, infinite from `most` (P,) or 1e100 on.

    `members` (P, 2n): [b_n, a_n, …, b_1, a_1] each, of H(z) = Σ b z⁻ⁱ/(1 + Σ a z⁻ⁱ); `before`: squares of the output
    before `load` (N,) begins, with which `output` (N,) does. A model is followed no further than its error allows.
    """
    count, order = members.shape[0], members.shape[1] // 2
    found = np.full(count, np.inf)
    state = np.empty(order + 1)
    for p in range(count):
        state[:] = 0.0
        square, limit = before, min(most[p], HUGE)
        for k in range(len(load)):
            x, y = load[k], state[0]
            for i in range(order):
                place = 2 * (order - 1 - i)
                state[i] = state[i + 1] + x * members[p, place] - y * members[p, place + 1]
            square += (output[k] - y) ** 2
            if not square <= limit:
                break
        if square <= limit:
            found[p] = square
    return found
