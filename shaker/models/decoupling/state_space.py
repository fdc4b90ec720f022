"""A sum of modes at the samples' times, for loads that go straight from sample to sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_NO_SHAPE = 1e-9


@dataclass(frozen=True)
class StateSpace:
    """x[n+1] = a·x[n] + b·u[n], y[n] = c·x[n] + d·u[n]."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray


def sampled_modes(
    poles: ComplexArray, residues: Sequence[ComplexArray | FloatArray], sample_rate_hz: float
) -> StateSpace:
    """Return Σ R/(s - p), conjugates of complex poles with it, poles (P,) in rad/s, residues (C, D) each, sampled.

    Exact for loads that go along straight lines between samples (triangle hold), of which the response at a sample
    depends on the load there: no half sample of delay, unlike with loads that stay. Of each residue matrix as many
    states as its rank, scaled to unit size under white loads.
    """
    outputs, loads = residues[0].shape
    parts = [_pole(pole, residue, 1.0 / sample_rate_hz) for pole, residue in zip(poles, residues, strict=True)]
    size = sum(len(part.a) for part in parts)
    a, b, c = np.zeros((size, size)), np.zeros((size, loads)), np.zeros((outputs, size))
    d, row = np.zeros((outputs, loads)), 0
    for part in parts:
        here = slice(row, row + len(part.a))
        a[here, here], b[here], c[:, here] = part.a, part.b, part.c
        d += part.d
        row = here.stop
    return StateSpace(a, b, c, d)


def _pole(pole: complex, residue: ComplexArray | FloatArray, step_s: float) -> StateSpace:
    """One pole, a complex one with its conjugate.

    ξ[n+1] = E ξ[n] + (α + Eβ) g[n], answer ξ + βg: E = e^x, x = pΔ, α + β = Δ(E - 1)/x, β = Δ(E - 1 - x)/x².
    """
    left, size, right = np.linalg.svd(residue, full_matrices=False)
    rank = max(1, int(np.count_nonzero(size > _NO_SHAPE * size[0])))
    x = pole * step_s
    turn, beta = np.exp(x), step_s * (np.expm1(x) - x) / x**2
    alpha = step_s * np.expm1(x) / x - beta
    drive = (alpha + turn * beta) * right[:rank]
    shown = left[:, :rank] * size[:rank]
    spread = np.linalg.norm(drive, axis=1) / np.sqrt(max(1e-12, 1.0 - abs(turn) ** 2))
    drive, seen = drive / spread[:, None], shown * spread
    direct = (shown * beta) @ right[:rank]
    if pole.imag == 0.0:
        return StateSpace(turn.real * np.eye(rank), drive.real, seen.real, direct.real)
    unit = np.eye(rank)
    a = np.block([[turn.real * unit, -turn.imag * unit], [turn.imag * unit, turn.real * unit]])
    b = np.concatenate([drive.real, drive.imag])
    return StateSpace(a, b, np.concatenate([2 * seen.real, -2 * seen.imag], axis=1), 2 * direct.real)
