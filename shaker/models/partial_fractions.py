"""Between zeros, poles and gain and a sum of residues over poles."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray


def residues(zeros: ComplexArray, poles: ComplexArray, gain: float) -> ComplexArray:
    """Return r (P,) of gain·Π(x - zeros)/Π(x - poles) = direct + Σ r/(x - pole), infinite where poles coincide."""
    found = np.full(len(poles), gain, dtype=np.complex128)
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, pole in enumerate(poles):
            above = np.ones(len(poles), dtype=np.complex128)
            above[: len(zeros)] = pole - zeros
            below = pole - poles
            below[i] = 1.0
            found[i] *= np.prod(above / below)
    return np.asarray(np.where(np.isfinite(found), found, np.inf))


def zeros_and_gain(
    poles: ComplexArray, residues: ComplexArray, direct: float = 0.0, rest: float = 0.0
) -> tuple[ComplexArray, float]:
    """Return zeros (Z,) and gain of direct + Σ residue/(x - pole), poles (P,) different, in conjugate pairs.

    The numerator is made in powers of x - `rest`, the x of frequency zero, in units of the poles' typical distance from
    it, so that the poles of oversampled signals, all near z = 1, keep their digits. Leading coefficients that are zero
    but for rounding are left out.
    """
    distance = np.abs(poles - rest)
    scale = float(np.exp(np.mean(np.log(distance[distance > 0])))) if np.any(distance > 0) else 1.0
    near = (poles - rest) / scale
    terms = [direct * np.atleast_1d(np.poly(near))]
    for i, residue in enumerate(residues):
        terms.append(np.concatenate([[0.0], residue / scale * np.atleast_1d(np.poly(np.delete(near, i)))]))
    total, size = np.sum(terms, axis=0).real, np.sum(np.abs(terms), axis=0)
    kept = np.flatnonzero(np.abs(total) > 1e-13 * size)
    if not len(kept):
        raise ValueError("residues: expected one other than 0, found none")
    first = int(kept[0])
    return np.asarray(np.roots(total[first:]) * scale + rest + 0j), float(total[first]) * scale**first
