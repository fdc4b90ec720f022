"""Whether recordings excite all six components of the load, and what is missing where they do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.drive import LOADS
from fusion.load import LOAD_COMPONENTS
from fusion.matrix.stack import Stack
from shaker._checks import ComplexArray, FloatArray

LEAST_SINGULAR = 10.0
"""Least size of an excitation in its standard uncertainties: its elements of the matrix are then known to 10 %."""
LEAST_SHARE = 1e-3
"""Least size of an excitation beside the largest, every component in units of its largest load."""
MEMBER = 0.05
"""Share of a missing direction above which a component takes part in it."""
TOGETHER = 0.1
"""Correlation in the missing directions above which components are told together."""
FLOOR = 1e-9
"""Standard uncertainty, relative to a load's size, below which no load is known."""

HOW = {
    "Fx": "a recording driven along x",
    "Fy": "a recording driven along y",
    "Fz": "a recording driven along z",
    "Mx": "a recording with a moment about x (force along z off the axis in y, or along y at another height)",
    "My": "a recording with a moment about y (force along z off the axis in x, or along x at another height)",
    "Mz": "a recording with a moment about z (force along x or y off the axis)",
}


class MissingExcitationError(ValueError):
    """The recordings do not excite six independent loads: `missing` names the components, alone or together."""

    def __init__(self, text: str, missing: tuple[tuple[str, ...], ...]) -> None:
        super().__init__(text)
        self.missing = missing


@dataclass(frozen=True)
class Excitation:
    """How strongly R drives excite six independent loads.

    `singular` (6,): of the loads whitened by their covariance, largest first: amplitude of an independent load in its
    standard uncertainties; `share` (6,): singular values of the loads, every component in units of its own size,
    relative to the largest. `missing`: components that are not excited, alone or only in fixed proportion.
    """

    singular: FloatArray
    share: FloatArray
    missing: tuple[tuple[str, ...], ...]

    @property
    def determines(self) -> bool:
        """Return whether all six columns of a matrix can be determined."""
        return not self.missing


def excitation(stack: Stack, drives: Sequence[int] | NDArray[np.int64] | None = None) -> Excitation:
    """Return how strongly some of the drives (all by default) excite six independent loads.

    With w_r the loads and Γ_r their complex covariances, the whitened singular values are the roots of
    vᴴ(Σ w̄_r w_rᵀ)v / vᴴ(Σ Γ̄_r)v at its extremes, a generalised eigenvalue problem: a direction v that is not excited
    has 1 or less. A direction counts as excited where vᴴ(Σ w̄_r w_rᵀ)v exceeds the squares of both `LEAST_SINGULAR`
    standard uncertainties and `LEAST_SHARE` of the largest excitation; the others are the negative eigenspace of the
    difference.
    """
    from scipy.linalg import eigh

    chosen = np.arange(len(stack.load)) if drives is None else np.asarray(drives, dtype=np.int64)
    load = stack.load[chosen]
    signal = load.conj().T @ load
    noise = np.sum(_complex_covariance(stack.load_covariance()[chosen]).conj(), axis=0)
    # Components in units of what is there of them, load or uncertainty, so that none is large or small by itself.
    size = np.sqrt(np.diag(signal).real + np.diag(noise).real)
    size = np.where(size > 0.0, size, 1.0)
    signal, noise = signal / np.outer(size, size), noise / np.outer(size, size) + FLOOR**2 * np.eye(LOADS)
    singular = np.sqrt(np.maximum(eigh(signal, noise, eigvals_only=True), 0.0))[::-1]
    share = np.sqrt(np.maximum(np.linalg.eigvalsh(signal), 0.0))[::-1]
    least = LEAST_SINGULAR**2 * noise + (LEAST_SHARE * share[0]) ** 2 * np.eye(LOADS)
    values, vectors = np.linalg.eigh(signal - least)
    lacking = vectors[:, values < 0.0]
    missing = _missing(np.asarray(lacking @ lacking.conj().T))
    return Excitation(singular, share / (share[0] if share[0] > 0.0 else 1.0), missing)


def require_six(found: Excitation, drives: int) -> None:
    """Raise `MissingExcitationError` unless the drives excite six independent loads, saying what to add."""
    if found.determines:
        return
    told = ", nor ".join(_told(group) for group in found.missing)
    wanted = "; ".join(_remedy(group) for group in found.missing)
    text = f"drives: expected loads in six independent directions, found {drives} that do not excite {told}"
    raise MissingExcitationError(f"{text}; add {wanted}", found.missing)


def _complex_covariance(covariance: FloatArray) -> ComplexArray:
    """E[n nᴴ] (R, 6, 6) of complex errors from their covariance (R, 12, 12) of [Re, Im]."""
    half = covariance.shape[1] // 2
    re, im = covariance[:, :half, :half], covariance[:, half:, half:]
    cross = covariance[:, half:, :half] - covariance[:, :half, half:]
    return np.asarray(re + im + 1j * cross)


def _missing(projector: ComplexArray) -> tuple[tuple[str, ...], ...]:
    """Components of the missing directions: each alone, or those that occur in fixed proportion together."""
    size = np.diag(projector).real
    members = [j for j in range(LOADS) if size[j] > MEMBER]
    groups: list[list[int]] = []
    for j in members:
        joined = [g for g in groups if any(abs(projector[j, i]) > TOGETHER * np.sqrt(size[i] * size[j]) for i in g)]
        groups = [g for g in groups if g not in joined] + [sorted([j, *(i for g in joined for i in g)])]
    found: list[tuple[str, ...]] = []
    for group in groups:
        names = tuple(LOAD_COMPONENTS[j] for j in group)
        whole = round(float(np.sum(size[group]))) >= len(group)
        found += [(name,) for name in names] if whole else [names]
    return tuple(sorted(found, key=lambda group: (len(group), LOAD_COMPONENTS.index(group[0]))))


def _told(group: tuple[str, ...]) -> str:
    """A missing excitation in words."""
    return group[0] if len(group) == 1 else f"{_listed(group)} other than together"


def _remedy(group: tuple[str, ...]) -> str:
    """What would add a missing excitation."""
    if len(group) == 1:
        return HOW[group[0]]
    return f"{HOW[group[-1]]}, so that {_listed(group)} are in another proportion"


def _listed(names: tuple[str, ...]) -> str:
    """Names in a sentence."""
    return f"{', '.join(names[:-1])} and {names[-1]}"
