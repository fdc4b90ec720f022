"""Poles of measured curves from a linear rational fit: where an identification starts."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.measured import MeasuredTransfer

_ROUNDS = 8
_SIGNIFICANT = 30.0  # decrease of χ² per real number by which a pole is more than a feature of the noise
_SETTLED = 1e-4  # change of the denominator's coefficients that no longer moves a start


def measured_poles(record: MeasuredTransfer, count: int) -> ComplexArray:
    """Return `count` poles (Im λ > 0, ascending |λ|) of the common denominator of all responses of a recording.

    Ratios are fitted by polynomials Nᶜ(s)/D(s) of degree 2·count, linearised (Levy, IRE Trans. Autom. Control 4, 1959)
    and weighted anew in rounds (Sanathanan and Koerner, IEEE Trans. Autom. Control 8, 1963). Unstable poles are
    mirrored; in place of real ones stand poles above the band.
    """
    value, s = record.ratio.value, record.s
    middle = float(np.sqrt(np.abs(s).min() * np.abs(s).max()))
    q = s / middle
    noise = np.sqrt(record.ratio.u_re**2 + record.ratio.u_im**2)
    power = q[:, None] ** np.arange(2 * count)
    top = np.concatenate([power, q[:, None] ** (2 * count)], axis=1)
    weight = 1.0 / noise
    denominator = np.zeros(2 * count)
    for _ in range(_ROUNDS):
        before, denominator = denominator, _round(value, power, top, q ** (2 * count), weight)
        at = np.abs(q ** (2 * count) + power @ denominator)
        if np.abs(denominator - before).max() < _SETTLED:
            break
        weight = 1.0 / (noise * np.maximum(at, 1e-9 * at.max())[:, None])
    roots = np.roots([1.0, *denominator[::-1]])
    roots = -np.abs(roots.real) + 1j * roots.imag
    found = roots[roots.imag > 1e-9 * np.abs(roots)] * middle
    above = float(np.abs(s).max()) * 2.0 ** np.arange(1, count - len(found) + 1) * (-0.02 + 1j)
    return np.concatenate([found[np.argsort(np.abs(found))], above])


def significant_poles(record: MeasuredTransfer, poles: ComplexArray) -> ComplexArray:
    """Return those of some poles without which a sum of partial fractions explains the ratios clearly worse.

    Basis: 1/(s - λ) and 1/(s - λ*) of each pole, 1, s and s², for each response by itself.
    """
    if len(poles) < 2:
        return poles
    value, s = record.ratio.value, record.s
    noise = np.sqrt(0.5 * (record.ratio.u_re**2 + record.ratio.u_im**2))
    unit = float(np.abs(s).max())
    smooth = (s[:, None] / unit) ** np.arange(3)
    fractions = [np.stack([unit / (s - pole), unit / (s - pole.conjugate())], axis=1) for pole in poles]
    kept = []
    every = _misfit(np.concatenate([*fractions, smooth], axis=1), value, noise)
    for place in range(len(poles)):
        others = [*fractions[:place], *fractions[place + 1 :], smooth]
        lost = _misfit(np.concatenate(others, axis=1), value, noise) - every
        kept.append(lost > _SIGNIFICANT * 4.0 * value.shape[1])
    return np.asarray(poles[np.array(kept)])


def _misfit(columns: ComplexArray, value: ComplexArray, noise: FloatArray) -> float:
    """Return χ² of the best sums of columns (K, B) for values (K, C), each with its own coefficients."""
    total = 0.0
    for c in range(value.shape[1]):
        basis, right = columns / noise[:, c, None], value[:, c] / noise[:, c]
        basis = np.linalg.qr(basis)[0]
        rest = right - basis @ (basis.conj().T @ right)
        total += float(np.sum(np.abs(rest) ** 2))
    return total


def _round(
    value: ComplexArray, power: ComplexArray, top: ComplexArray, highest: ComplexArray, weight: FloatArray
) -> FloatArray:
    """Return the denominator's coefficients of one weighted linear fit, numerators projected out of each response."""
    left, right = [], []
    for c in range(value.shape[1]):
        w = weight[:, c, None]
        own, shared = _stacked(top * w), _stacked(-value[:, c, None] * power * w)
        wanted = _stacked((value[:, c] * highest)[:, None] * w)
        basis = np.linalg.qr(own)[0]
        rest = np.concatenate([shared, wanted], axis=1)
        rest = rest - basis @ (basis.T @ rest)
        left.append(rest[:, :-1])
        right.append(rest[:, -1])
    return np.asarray(np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0])


def _stacked(columns: ComplexArray) -> FloatArray:
    """Return complex columns as real ones, real parts above imaginary ones."""
    return np.concatenate([columns.real, columns.imag])
