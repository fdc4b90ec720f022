"""What makes a model's poles doubtful."""

from __future__ import annotations

import numpy as np

from shaker.models.linear_system import LinearSystem
from shaker.notice import Notice

FAR = 0.5
"""Share of the sampling rate from which on a pole says nothing of the sensor."""
NEAR = 1e-2
"""Distance of a zero from a pole, over that of the pole from rest, below which the two nearly cancel."""


def remarks(system: LinearSystem, sample_rate_hz: float | None = None) -> tuple[Notice, ...]:
    """Return remarks on stability, poles without a meaning, and zeros that nearly cancel poles.

    `sample_rate_hz`: that of the samples a continuous model was found from; a sampled model has its own.
    """
    rate = system.sample_rate_hz or sample_rate_hz
    found = [] if system.stable else [_unstable(system)]
    for pole in system.poles[system.poles.imag >= 0]:
        if system.sample_rate_hz is not None and pole.imag == 0 and pole.real < 0:
            text = f"turns its sign with every sample, z = {pole.real:.4g}: no motion of a sensor, a product of noise"
            found.append(Notice("warning", f"The pole {text} or of too high an order.", _name(system, pole)))
            continue
        if system.sample_rate_hz is not None and pole == 0:  # a delay of one sample
            continue
        size = abs(pole if system.sample_rate_hz is None else np.log(pole) * system.sample_rate_hz) / (2 * np.pi)
        if rate is not None and size > FAR * rate:
            text = f"The pole at {size:.4g} Hz lies beyond half the sampling rate of {rate:.6g} Hz: the samples do not"
            found.append(Notice("warning", f"{text} show it.", _name(system, pole)))
        distance = np.abs(system.zeros - pole)
        if np.any(distance < NEAR * abs(pole - system.rest)):
            text = f"A zero lies {100 * distance.min() / abs(pole - system.rest):.2g} % from it: the two nearly cancel,"
            found.append(Notice("info", f"{text} and the order may be too high.", _name(system, pole)))
    return tuple(found)


def _unstable(system: LinearSystem) -> Notice:
    """Return the warning of poles that grow."""
    grows = system.poles.real >= 0 if system.sample_rate_hz is None else np.abs(system.poles) >= 1
    return Notice("warning", f"{int(grows.sum())} of {len(grows)} poles do not decay.", "stability")


def _name(system: LinearSystem, pole: complex) -> str:
    """Return words for a pole."""
    unit = " rad/s" if system.sample_rate_hz is None else ""
    value = f"{pole.real:.5g}" if pole.imag == 0 else f"{pole.real:.5g} ± {pole.imag:.5g}j"
    return f"pole {value}{unit}"
