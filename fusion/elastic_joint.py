"""The elastic joint between a load and what is mounted below it: how the lower side follows the upper one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from shaker._checks import ComplexArray, FloatArray


@dataclass(frozen=True)
class Joint:
    """The joint on which a load sits, with the instruments on the load.

    `frequency_hz` (6,): at which the load would resonate on the joint if the lower side stood still, component by
    component; `u_frequency_hz` (6,): its standard uncertainty, 0 where the joint is only named: then nothing is
    corrected, and what a correction would change is uncertain as a whole; `damping`: damping ratio of that resonance.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping: float

    def follow(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): motion of the lower side over that of the load, 1 - r²/(1 + 2jζr) with r = f/f_e.

        The joint carries the load's inertia, -ω²·m·x_load = (k + jωb)·(x_below - x_load).
        """
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, 1.0 - self._stretch(frequency_hz), 1.0))

    def change(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): change of `follow` for one standard uncertainty of the joint.

        Where it is corrected the derivative by f_e times its uncertainty; where it is only named the root mean square,
        1/√3 of the whole, of an error anywhere between nothing and a joint as elastic as that.
        """
        r = frequency_hz[:, None] / self.frequency_hz
        damped = 1.0 + 2j * self.damping * r
        slope = r * r * (1.0 + damped) / damped**2 / self.frequency_hz
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, slope * self.u_frequency_hz, -self._stretch(frequency_hz) / np.sqrt(3.0)))

    def _stretch(self, frequency_hz: FloatArray) -> ComplexArray:
        """Share (K, 6) of the load's motion that the joint takes up."""
        r = frequency_hz[:, None] / self.frequency_hz
        return np.asarray(r * r / (1.0 + 2j * self.damping * r))


def make_joint(frequency_hz: ArrayLike, u_frequency_hz: ArrayLike = 0.0, damping: float = 0.0) -> Joint:
    """Return a joint; one number stands for all six components."""
    frequency = np.broadcast_to(np.asarray(frequency_hz, dtype=np.float64), (6,)).copy()
    u_frequency = np.broadcast_to(np.asarray(u_frequency_hz, dtype=np.float64), (6,)).copy()
    return Joint(frequency, u_frequency, float(damping))
