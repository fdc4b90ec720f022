"""Between continuous systems and systems of samples, both by zeros, poles and gain."""

from __future__ import annotations

from typing import Literal

import numpy as np

from shaker._checks import ComplexArray
from shaker.models.partial_fractions import residues, zeros_and_gain

Method = Literal["tustin", "zoh", "matched"]
Parts = tuple[ComplexArray, ComplexArray, float]


def tustin_constant(rate_hz: float, prewarp_hz: float | None) -> float:
    """Return c of s = c (z - 1)/(z + 1) in rad/s: 2 fs, or ω/tan(ω/2fs), for which one frequency stays in place."""
    if prewarp_hz is None:
        return 2.0 * rate_hz
    if not 0 < prewarp_hz < 0.5 * rate_hz:
        raise ValueError(f"prewarp_hz: expected one between 0 and {0.5 * rate_hz} Hz, found {prewarp_hz}")
    return float(2 * np.pi * prewarp_hz / np.tan(np.pi * prewarp_hz / rate_hz))


def tustin_to_samples(zeros: ComplexArray, poles: ComplexArray, gain: float, c: float) -> Parts:
    """Return H(z) of H(s) by s = c (z - 1)/(z + 1): z = (c + s)/(c - s), zeros at infinity at z = -1."""
    at_infinity = np.full(len(poles) - len(zeros), -1.0 + 0j)
    found = np.concatenate([(c + zeros) / (c - zeros), at_infinity])
    factor = np.prod((c - zeros) / (c - poles[: len(zeros)])) / np.prod(c - poles[len(zeros) :])
    return found, np.asarray((c + poles) / (c - poles)), float(np.real(gain * factor))


def tustin_to_continuous(zeros: ComplexArray, poles: ComplexArray, gain: float, c: float) -> Parts:
    """Return H(s) of H(z) by z = (c + s)/(c - s): zeros at z = -1 go to infinity; a pole there has no place."""
    if np.any(poles == -1):
        raise ValueError("poles: expected none at z = -1 for the Tustin conversion, found one")
    far = len(poles) - len(zeros)
    left = zeros[zeros != -1]
    found = np.concatenate([c * (left - 1) / (left + 1), np.full(far, c + 0j)])
    factor = gain * np.prod(left + 1) * (2 * c) ** (len(zeros) - len(left)) * (-1.0) ** far / np.prod(poles + 1)
    return found, np.asarray(c * (poles - 1) / (poles + 1)), float(np.real(factor))


def zoh_to_samples(zeros: ComplexArray, poles: ComplexArray, gain: float, rate_hz: float) -> Parts:
    """Return H(z) with the same response to a load that is constant between samples.

    Poles exp(p/fs); residues r·(exp(p/fs) - 1)/p, r/fs of a pole at 0; what passes at once stays.
    """
    parts = _residues(zeros, poles, gain)
    z = np.exp(poles / rate_hz)
    held = np.where(poles == 0, 1 / rate_hz, np.expm1(poles / rate_hz) / np.where(poles == 0, 1.0, poles))
    direct = gain if len(zeros) == len(poles) else 0.0
    found, factor = zeros_and_gain(z, parts * held, direct, rest=1.0)
    return found, z, factor


def zoh_to_continuous(zeros: ComplexArray, poles: ComplexArray, gain: float, rate_hz: float) -> Parts:
    """Return the H(s) whose response to loads that are constant between samples is that of H(z); poles ln(z)·fs."""
    parts, p = _residues(zeros, poles, gain), _logarithms(poles, rate_hz)
    held = np.where(p == 0, 1 / rate_hz, np.expm1(p / rate_hz) / np.where(p == 0, 1.0, p))
    direct = gain if len(zeros) == len(poles) else 0.0
    found, factor = zeros_and_gain(p, parts / held, direct)
    return found, p, factor


def matched_to_samples(zeros: ComplexArray, poles: ComplexArray, gain: float, rate_hz: float) -> Parts:
    """Return H(z) with zeros and poles exp(s/fs), zeros at infinity at z = -1, and the same gain at one frequency."""
    at_infinity = np.full(len(poles) - len(zeros), -1.0 + 0j)
    found = np.concatenate([np.exp(zeros / rate_hz), at_infinity])
    z = np.exp(poles / rate_hz)
    factor = _same_gain((zeros, poles, gain), (found, z, 1.0), rate_hz)
    return np.asarray(found), np.asarray(z), factor


def matched_to_continuous(zeros: ComplexArray, poles: ComplexArray, gain: float, rate_hz: float) -> Parts:
    """Return H(s) with zeros and poles ln(z)·fs, zeros at z = -1 at infinity, and the gain of H(z) at one frequency."""
    found, p = _logarithms(zeros[zeros != -1], rate_hz), _logarithms(poles, rate_hz)
    factor = 1.0 / _same_gain((found, p, 1.0), (zeros, poles, gain), rate_hz)
    return found, p, factor


def _residues(zeros: ComplexArray, poles: ComplexArray, gain: float) -> ComplexArray:
    """Return the residues of different poles."""
    found = residues(zeros, poles, gain)
    if not np.all(np.isfinite(found)):
        raise ValueError("poles: expected different ones for the zoh conversion, found some that coincide; use tustin")
    return found


def _logarithms(z: ComplexArray, rate_hz: float) -> ComplexArray:
    """Return ln(z)·fs; a z that no real continuous system has is refused."""
    alone = z[(z.imag == 0) & (z.real <= 0)]
    if len(alone):
        raise ValueError(
            f"system: expected no real pole or zero at or below z = 0, found {alone[0].real:.6g}: such a one turns its "
            "sign with every sample, which nothing continuous does; use tustin"
        )
    return np.asarray(np.log(z) * rate_hz)


def _same_gain(continuous: Parts, samples: Parts, rate_hz: float) -> float:
    """Return what the sampled system must be multiplied by for the gain at rest, or at fs/100 where that has none."""

    def at(parts: Parts, x: complex) -> complex:
        above, below = x - parts[0], x - parts[1]
        count = len(above)
        return complex(parts[2] * np.prod(above / below[:count]) / np.prod(below[count:]))

    flat = not any(np.any(part == 0) for part in continuous[:2])
    if flat:
        return float((at(continuous, 0j) / at(samples, 1 + 0j)).real)
    jump = 2j * np.pi / 100
    ratio = at(continuous, jump * rate_hz) / at(samples, np.exp(jump))
    return float(np.copysign(abs(ratio), ratio.real))
