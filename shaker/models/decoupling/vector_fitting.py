"""Common poles of many frequency responses by vector fitting, as a start for least squares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.decoupling.step_data import Poles

_ROUNDS = 12
_START_DAMPING = 0.01


def response_basis(poles: Poles, frequency_hz: FloatArray) -> ComplexArray:
    """Return what Re and Im of the residues and the real residues multiply, (K, 2M + Q), at frequencies (K,) in Hz."""
    s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
    upper, real = np.split(poles.values, [poles.modes])
    above, below = 1 / (s - upper), 1 / (s - upper.conj())
    return np.concatenate([above + below, 1j * (above - below), 1 / (s - real)], axis=1)


def fitted_poles(
    frequency_hz: FloatArray, responses: Sequence[ComplexArray], weights: Sequence[FloatArray], modes: int
) -> Poles:
    """Return poles that responses (K,) with weights (K,) share, `modes` pairs to start with.

    h·σ = Σ r/(s - a), σ = 1 + Σ d/(s - a) is linear in r and d, and the zeros of σ are better poles than a; repeated
    (Gustavsen and Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052), with r eliminated response by response
    (Deschrijver and others, IEEE Microw. Wirel. Compon. Lett. 18 (2008) 383). Poles that would grow are reflected.
    """
    low, high = float(np.min(frequency_hz[frequency_hz > 0])), float(np.max(frequency_hz))
    inside = np.linspace(low, high, modes + 2)[1:-1]
    poles = Poles(inside, np.full(modes, _START_DAMPING), np.zeros(0))
    for _ in range(_ROUNDS):
        unit = 1.0 / np.linalg.norm(response_basis(poles, frequency_hz), axis=0)
        basis = response_basis(poles, frequency_hz) * unit
        rows, right = [], []
        for response, weight in zip(responses, weights, strict=True):
            both = np.concatenate([basis, -response[:, None] * basis, response[:, None]], axis=1) * weight[:, None]
            _, triangle = np.linalg.qr(np.concatenate([both.real, both.imag]))
            kept = triangle[poles.count : 2 * poles.count]
            rows.append(kept[:, poles.count : -1])
            right.append(kept[:, -1])
        own = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0] * unit
        poles = _zeros(poles, own)
    return poles


def _zeros(poles: Poles, own: FloatArray) -> Poles:
    """Zeros of 1 + Σ d/(s - a) in the left half plane: eigenvalues of diag(a) - 1·d in real form."""
    m, q = poles.modes, len(poles.real_hz)
    upper, real = np.split(poles.values, [m])
    size = 2 * m + q
    table, ones = np.zeros((size, size)), np.zeros(size)
    for i, pole in enumerate(upper):
        table[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
        ones[2 * i] = 2.0
    table[2 * m :, 2 * m :] = np.diag(real.real)
    ones[2 * m :] = 1.0
    row = np.concatenate([np.stack([own[:m], own[m : 2 * m]], axis=1).ravel(), own[2 * m :]])
    found = np.linalg.eigvals(table - np.outer(ones, row))
    pairs = found[found.imag > 1e-9 * np.abs(found)]
    alone = np.abs(found[np.abs(found.imag) <= 1e-9 * np.abs(found)].real)
    damping = np.clip(np.abs(pairs.real) / np.abs(pairs), 1e-5, 0.69)
    return Poles(np.abs(pairs) / (2 * np.pi), damping, np.maximum(alone, 1e-3) / (2 * np.pi))
