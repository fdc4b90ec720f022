"""Differential evolution, rand/1/bin, generation by generation (Storn and Price, J. Global Optim. 11 (1997) 341)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from shaker.arrays import FloatArray
from shaker.release.recursion import dealt

MUTATION, CROSSOVER = 0.8, 0.7  # the published settings

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
