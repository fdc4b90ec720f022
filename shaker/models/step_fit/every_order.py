"""Difference equations of every order from one factorisation of the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.linear_system import LinearSystem

_BEND = 0.15  # share of the whole fall of ln J that may be left beyond the order chosen


@dataclass(frozen=True)
class EveryOrder:
    """Least-squares difference equations of order 0 … n at once.

    `triangle` (2n + 2, 2n + 2): R of the QR factorisation of the rows [u(k-n) y(k-n) … u(k-1) y(k-1) u(k) y(k)] over
    `rows` instants k; the interleaved order makes every leading part the data of a lower order (augmented UD
    identification, also called simultaneous identification of order and parameters). `sample_rate_hz` of the samples.
    """

    triangle: FloatArray
    rows: int
    sample_rate_hz: float

    def __post_init__(self) -> None:
        check_shape("triangle", self.triangle, (None, self.triangle.shape[0]))

    @property
    def most(self) -> int:
        """The highest order n."""
        return len(self.triangle) // 2 - 1

    def loss(self, direct: bool = True) -> FloatArray:
        """Return J (n,): the sum of squared equation errors of order 1 … n, with or without a term b0·u(k)."""
        last = 2 * np.arange(1, self.most + 1) + 1
        own = self.triangle[last, last] ** 2
        return np.asarray(own if direct else own + self.triangle[last - 1, last] ** 2)

    def parameters(self, order: int, direct: bool = True) -> FloatArray:
        """Return [b_n, -a_n, …, b_1, -a_1, b_0] (2·order + 1,), without b_0 where not `direct`, of one order."""
        if not 1 <= order <= self.most:
            raise ValueError(f"order: expected 1 to {self.most}, found {order}")
        size = 2 * order + direct
        return np.asarray(
            np.linalg.lstsq(self.triangle[:size, :size], self.triangle[:size, 2 * order + 1], rcond=None)[0]
        )

    def system(self, order: int, direct: bool = True) -> LinearSystem:
        """Return the difference equation y(k) = Σ b_i u(k-i) - Σ a_i y(k-i) of one order as a sampled system."""
        found = self.parameters(order, direct)
        load, past = found[: 2 * order : 2][::-1], found[1 : 2 * order : 2][::-1]
        numerator = np.concatenate([found[-1:] if direct else [0.0], load])
        return LinearSystem.from_coefficients(numerator, np.concatenate([[1.0], -past]), self.sample_rate_hz)

    def bend(self, direct: bool = True) -> int:
        """Return the order at which the loss bends: the first that leaves 15 % of the fall of ln J to higher ones.

        A test of significance is no help here: with noise on the output every further order lowers the loss.
        """
        loss = np.log(np.maximum(self.loss(direct), 1e-300))
        left = (loss - loss.min()) / max(1e-12, loss[0] - loss.min())
        return int(np.argmax(left <= _BEND)) + 1


def every_order(load: FloatArray, output: FloatArray, sample_rate_hz: float, most: int = 9) -> EveryOrder:
    """Return the difference equations of order 0 … `most` between a load (N,) and an output (N,)."""
    check_shape("output", output, load.shape)
    if len(load) < 4 * most + 4:
        raise ValueError(f"load: expected at least {4 * most + 4} samples for order {most}, found {len(load)}")
    windows = [np.lib.stride_tricks.sliding_window_view(part, most + 1) for part in (load, output)]
    rows = np.stack(windows, axis=2).reshape(len(windows[0]), 2 * most + 2)
    triangle = np.asarray(np.linalg.qr(rows)[1])
    return EveryOrder(triangle, len(rows), sample_rate_hz)
