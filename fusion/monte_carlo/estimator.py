"""The estimate of a body's acceleration as a function of readings and rows, draw by draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.errors import ComputeError
from fusion.estimate import Solution
from fusion.monte_carlo.instruments import Drawn
from fusion.observe import Observation
from shaker._checks import ComplexArray, FloatArray

CONVERGED = 1e-9
MOST_STEPS = 60


@dataclass(frozen=True)
class Estimator:
    """What turns readings into an acceleration: with the gain of the evaluation, whatever the rows are.

    `observations` that were fused; `gain` (P, N) on the reduced unknowns; `expand` (12K, P) from these to
    [Re A_k, Im A_k] of all lines. The estimate of a draw is the A for which gain · (readings - rows · A) = 0: the truth
    itself where readings and rows belong together, and the generalised least squares to first order.
    """

    observations: tuple[Observation, ...]
    gain: FloatArray
    expand: FloatArray

    @classmethod
    def of(cls, observations: Sequence[Observation], expand: FloatArray, solution: Solution) -> Estimator:
        """Return the estimator of a solved system."""
        return cls(tuple(observations), np.asarray(np.linalg.pinv(expand) @ solution.gain), expand)

    def acceleration(self, drawn: Sequence[Drawn], start: ComplexArray, hidden: ComplexArray) -> ComplexArray:
        """Return the estimates (N, K, 6) from N draws of every observation, found by steps with the fixed gain.

        `start` (K, 6): where to start; `hidden` (N, K, 6): motion that no reading tells, which the rows may see.
        """
        count, lines = hidden.shape[:2]
        unknowns = np.repeat((np.linalg.pinv(self.expand) @ stacked(start[None])[0])[None], count, axis=0)
        # What a step may leave: in each unknown's own unit, the largest of its kind in the estimate.
        limit = CONVERGED * np.max(np.abs(unknowns), initial=1e-300)
        for _ in range(MOST_STEPS):
            found = unstacked(unknowns @ self.expand.T, lines) + hidden
            rest = [d.readings - np.einsum("nkmj,nkj->nkm", d.design, found) for d in drawn]
            step = self._rows(rest) @ self.gain.T
            unknowns = unknowns + step
            if np.abs(step).max(initial=0.0) <= limit:
                return unstacked(unknowns @ self.expand.T, lines)
        raise ComputeError("the Monte Carlo run: places or directions are so uncertain that draws have no solution")

    def _rows(self, values: Sequence[ComplexArray]) -> FloatArray:
        """Values (N, K, M) of every observation as real rows (N, R): line by line, usable channels, Re then Im."""
        rows = []
        for observation, value in zip(self.observations, values, strict=True):
            for k, usable in enumerate(np.isfinite(observation.phasors.value)):
                rows += [value[:, k, usable].real, value[:, k, usable].imag]
        return np.concatenate(rows, axis=1)


def stacked(acceleration: ComplexArray) -> FloatArray:
    """Return (N, K, 6) as (N, 12K): [Re A_k, Im A_k] of all lines."""
    both = np.concatenate([acceleration.real, acceleration.imag], axis=-1)
    return np.asarray(both.reshape(len(acceleration), -1))


def unstacked(values: FloatArray, lines: int) -> ComplexArray:
    """Return (N, 12K) as (N, K, 6)."""
    both = values.reshape(len(values), lines, 12)
    return np.asarray(both[..., :6] + 1j * both[..., 6:])
