"""Differential evolution, rand/1/bin, of all members at once.

After Storn and Price, J. Global Optim. 11 (1997) 341. Importing this module imports numba, which compiles
`output_errors`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np

from shakercal._common.arrays import FloatArray

MUTATION, CROSSOVER = 0.8, 0.7  # the published settings
HUGE = 1e100  # loss above which a model has grown without bound

Losses = Callable[[FloatArray, FloatArray], FloatArray]
"""Function from members (P, N) and their largest losses (P,) to losses (P,), infinite above the largest."""


def evolve(
    losses: Losses, bounds: Sequence[tuple[float, float]], rng: np.random.Generator, effort: tuple[int, int]
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the best vector (N,) and the best loss of every generation.

    `effort`: numbers of members and generations.
    """
    from scipy.optimize import differential_evolution

    low, high = np.array(bounds).T
    first = low + (high - low) * rng.random((effort[0], len(bounds)))
    path, parents = list[float](), np.full(effort[0], np.inf)

    def keep(intermediate_result: Any) -> None:
        path.append(float(intermediate_result.fun))
        parents[:] = intermediate_result.population_energies

    end = differential_evolution(
        lambda members: losses(np.ascontiguousarray(members.T), parents),
        bounds,
        strategy="rand1bin",
        maxiter=effort[1],
        init=first,
        tol=0.0,
        mutation=MUTATION,
        recombination=CROSSOVER,
        rng=rng,
        callback=keep,
        polish=False,
        updating="deferred",
        vectorized=True,
    )
    return np.asarray(end.x), tuple(path)


def _output_errors(
    members: FloatArray, most: FloatArray, load: FloatArray, output: FloatArray, before: float
) -> FloatArray:
    """Return the squared output errors (P,) of difference equations, infinite above a limit.

    `members` (P, 2n): [b_n, a_n, …, b_1, a_1] each, of H(z) = Σ b z⁻ⁱ/(1 + Σ a z⁻ⁱ). The limit is `most` (P,), at most
    1e100. `before`: squares of the output before the start of `load` (N,) and `output` (N,). A simulation stops at its
    limit.
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
                column = 2 * (order - 1 - i)
                state[i] = state[i + 1] + x * members[p, column] - y * members[p, column + 1]
            square += (output[k] - y) ** 2
            if not square <= limit:
                break
        if square <= limit:
            found[p] = square
    return found


try:
    output_errors = numba.njit(nogil=True, cache=True)(_output_errors)
except RuntimeError:  # no folder for a cache
    output_errors = numba.njit(nogil=True)(_output_errors)
