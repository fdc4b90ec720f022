"""Zeros and poles of real systems: conjugate pairs, and conversion between s and z."""

from __future__ import annotations

import numpy as np

from shakercal._common.arrays import ComplexArray


def pair_conjugates(roots: ComplexArray, name: str) -> ComplexArray:
    """Return roots (N,) with exact conjugate pairs by size, then real ones; refuse lone ones."""
    scale = 1e-9 * max(1e-300, float(np.max(np.abs(roots), initial=0.0)))
    above = roots[roots.imag > scale]
    below = roots[roots.imag < -scale]
    real = roots[np.abs(roots.imag) <= scale].real
    left = list(below.conj())
    for root in above:
        near = int(np.argmin(np.abs(np.array(left) - root))) if left else -1
        if near < 0 or abs(left[near] - root) > 1e-6 * abs(root):
            raise ValueError(f"{name}: expected conjugate pairs, found {root} without its conjugate")
        left.pop(near)
    if left:
        raise ValueError(f"{name}: expected conjugate pairs, found {left[0].conjugate()} without its conjugate")
    above = above[np.argsort(np.abs(above), kind="stable")]
    return np.concatenate([np.stack([above, above.conj()], axis=1).ravel(), np.sort(real) + 0j])


def tustin_constant(rate_hz: float, prewarp_hz: float | None) -> float:
    """Return c in rad/s of s = c (z - 1)/(z + 1), perhaps prewarped."""
    if prewarp_hz is None:
        return 2.0 * rate_hz
    if not 0 < prewarp_hz < 0.5 * rate_hz:
        raise ValueError(f"prewarp_hz: expected a frequency between 0 and {0.5 * rate_hz} Hz, found {prewarp_hz}")
    return float(2 * np.pi * prewarp_hz / np.tan(np.pi * prewarp_hz / rate_hz))


def hold_factor(poles: ComplexArray, rate_hz: float) -> ComplexArray:
    """Return the factor of residues by a hold, (exp(p/fs) - 1)/p."""
    factor = np.expm1(poles / rate_hz) / np.where(poles == 0, 1.0, poles)
    return np.where(poles == 0, 1 / rate_hz, factor)


def logarithms(z: ComplexArray, rate_hz: float) -> ComplexArray:
    """Return ln(z)·fs; a z that no real continuous system has is refused."""
    alone = z[(z.imag == 0) & (z.real <= 0)]
    if len(alone):
        raise ValueError(
            f"system: expected no real pole or zero at or below z = 0, found {alone[0].real:.6g}. It changes its sign "
            "with every sample, which no continuous system does; use tustin"
        )
    return np.asarray(np.log(z) * rate_hz)
