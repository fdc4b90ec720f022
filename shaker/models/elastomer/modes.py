"""Natural frequencies and shapes, named after the motion of the moving parts that carries most of their mass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape

NAMES = ("Tx", "Ty", "Tz", "Rx", "Ry", "Rz")
"""Translations along and rotations about the axes."""
EQUAL = 1e-4
"""Relative distance below which frequencies count as one, of a symmetric element's pairs."""


@dataclass(frozen=True)
class Modes:
    """The six modes that are named, in the order of `NAMES`.

    `frequency_hz` (6,). `participation` (6, 6): share of each rigid motion's mass that moves in each mode, modes down,
    `NAMES` across: (φᵀMr)²/(rᵀMr) with φᵀMφ = 1, translations r of all moving parts and turns about their common
    centre. `shape` (D, 6): the unknowns of every mode. `others_hz`: modes in between that are none of the six.
    """

    frequency_hz: FloatArray
    participation: FloatArray
    shape: FloatArray
    others_hz: FloatArray

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (6,))
        check_shape("participation", self.participation, (6, 6))
        check_shape("shape", self.shape, (None, 6))
        check_shape("others_hz", self.others_hz, (None,))


def dense_modes(stiffness: FloatArray, mass: FloatArray, count: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return the lowest frequencies in Hz (K,) and shapes (D, K) with φᵀMφ = 1 of K φ = ω² M φ."""
    from scipy.linalg import eigh

    last = min(count, len(stiffness)) - 1
    squared, shape = eigh(stiffness, mass, subset_by_index=[0, last])
    return np.sqrt(np.maximum(squared, 0.0)) / (2.0 * np.pi), shape


def named_modes(
    frequency_hz: FloatArray, shape: FloatArray, weigh: Callable[[FloatArray], FloatArray], rigid: FloatArray
) -> Modes:
    """Return modes (K,), (D, K) with the name each deserves: as a whole the assignment of the most mass.

    `weigh`: multiplies by the mass matrix. `rigid` (D, 6): translations, and turns about the centre of mass. Modes of
    one frequency, of which any mixture is one, are mixed so that each follows one axis. The sign is such that the
    motion a mode is named after is positive.
    """
    weighed = weigh(rigid)
    total = np.einsum("ij,ij->j", rigid, weighed)
    factor = shape.T @ weighed / np.sqrt(total)
    for group in _groups(frequency_hz):
        turn = _along_axes(factor[group])
        shape = shape.copy()
        shape[:, group] = shape[:, group] @ turn
        factor[group] = turn.T @ factor[group]
    chosen = assigned(factor)
    sign = np.where(factor[chosen, np.arange(6)] < 0.0, -1.0, 1.0)
    between = np.setdiff1d(np.arange(chosen.max() + 1), chosen)
    return Modes(frequency_hz[chosen], factor[chosen] ** 2, shape[:, chosen] * sign, frequency_hz[between])


def assigned(factor: FloatArray) -> IntArray:
    """Return which mode deserves each name (N,), given how modes take part (K, N): the most mass as a whole."""
    from scipy.optimize import linear_sum_assignment

    return np.asarray(linear_sum_assignment(-(np.asarray(factor) ** 2).T)[1])


def centre_of_mass(weigh: Callable[[FloatArray], FloatArray], about_origin: FloatArray) -> FloatArray:
    """Return the common centre (3,) of what moves, from its rigid motions (D, 6) about the origin."""
    matrix = about_origin.T @ weigh(about_origin)
    mass, turned = matrix[2, 2], matrix[:3, 3:]
    return np.array([-turned[2, 1] / mass, turned[2, 0] / mass, turned[0, 1] / matrix[0, 0]])


def _groups(frequency_hz: FloatArray) -> list[list[int]]:
    """Neighbouring modes of one frequency, two or more."""
    groups = [[0]]
    for k in range(1, len(frequency_hz)):
        if frequency_hz[k] - frequency_hz[k - 1] <= EQUAL * frequency_hz[k]:
            groups[-1].append(k)
        else:
            groups.append([k])
    return [group for group in groups if len(group) > 1]


def _along_axes(factor: FloatArray) -> FloatArray:
    """Rotation (G, G) of modes of one frequency after which each takes part (G, 6) in one axis as far as it can."""
    from scipy.linalg import polar, qr

    axes = np.sort(qr(factor, pivoting=True, mode="r")[1][: len(factor)])
    return np.asarray(polar(factor[:, axes])[0])
