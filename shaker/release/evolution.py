"""Differential evolution, rand/1/bin, generation by generation (Storn and Price, J. Global Optim. 11 (1997) 341).

Importing this module brings numba, which compiles what goes through members or samples one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from shaker.arrays import FloatArray, IntArray
from shaker.lti.recursion import njit

MUTATION, CROSSOVER = 0.8, 0.7  # the published settings
HUGE = 1e100  # loss from which a model counts as grown without bound

Losses = Callable[[FloatArray, FloatArray], FloatArray]
"""Of members (P, N) and the losses (P,) that they have to keep to: losses (P,), infinite where a member exceeds its."""


def evolved(
    losses: Losses, bounds: Sequence[tuple[float, float]], rng: np.random.Generator, effort: tuple[int, int]
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the best vector (N,) and the best loss of every generation; `effort`: members and generations.

    Draws and steps are those of `scipy.optimize.differential_evolution` with `strategy="rand1bin"`, deferred updating
    and the first generation that is drawn here, so that both come to the same digits; that one shuffles all members
    for each of them by itself. It ends before its last generation where all members have one loss.
    """
    (low, high), (count, generations) = np.array(bounds).T, effort
    middle, span = 0.5 * (low + high), np.abs(low - high)
    first = low + (high - low) * rng.random((count, len(bounds)))
    members = np.clip((first - middle) * (1.0 / span) + 0.5, 0.0, 1.0)
    every, order, path = np.arange(count), np.arange(count), list[float]()
    known = losses(middle + (members - 0.5) * span, np.full(count, np.inf))
    _to_front(members, known)
    for _ in range(generations):
        base, one, other = members[dealt(order, rng.permuted(np.broadcast_to(every, (count, count)), axis=1))]
        point, crossed = rng.integers(len(bounds), size=count), rng.uniform(size=members.shape) < CROSSOVER
        crossed[every, point] = True
        trials = np.where(crossed, base + MUTATION * (one - other), members)
        outside = (trials > 1.0) | (trials < 0.0)
        if np.any(outside):
            trials[outside] = rng.uniform(size=np.count_nonzero(outside))
        found = losses(middle + (trials - 0.5) * span, known)
        better = found <= known
        members, known = np.where(better[:, None], trials, members), np.where(better, found, known)
        _to_front(members, known)
        path.append(float(known[0]))
        if np.all(np.isfinite(known)) and np.std(known) == 0.0:
            break
    return middle + (members[0] - 0.5) * span, tuple(path)


def _to_front(members: FloatArray, losses: FloatArray) -> None:
    """Exchange the best member and its loss with the first."""
    best = int(np.argmin(losses))
    members[[0, best]], losses[[0, best]] = members[[best, 0]], losses[[best, 0]]


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
def output_errors(
    members: FloatArray, most: FloatArray, load: FloatArray, output: FloatArray, before: float
) -> FloatArray:
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
