"""The uncertainty budget: what each cause does to magnitude and phase of complex values, line by line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.uncertainty import Influence, Kind, Uncertainty
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import real_stacked_diagonal


@dataclass(frozen=True)
class BudgetEntry:
    """What one cause contributes to C complex values at K lines; all entries of a budget are independent.

    `label`, `type` A or B; `count`: how many unknowns stand behind it, 0 for noise. `u` in `unit`: standard uncertainty
    of the unknown, NaN for noise and where unknowns of different uncertainty were put together. `coefficient` (2, K,
    C): change of the relative magnitude and of the phase (rad) per unit of the unknown; for several unknowns of one
    uncertainty the root of the sum of squares. `u_relative`, `u_phase_rad` (K, C): contribution to the standard
    uncertainty of the relative magnitude and of the phase. `dof` (K,).
    """

    label: str
    type: Kind
    count: int
    u: float
    unit: str
    coefficient: FloatArray
    u_relative: FloatArray
    u_phase_rad: FloatArray
    dof: FloatArray


def budget(uncertainty: Uncertainty, value: ComplexArray) -> tuple[BudgetEntry, ...]:
    """Return the budget of complex values (K, C): one entry per label, in the order of their first appearance.

    With dX/X = d ln|X| + j d arg X the contributions are those to X turned and divided by X (JCGM 102, 9.4). What an
    unknown does on several ways (to outputs and load) has been added up in its effect before any square is taken.
    """
    usable = np.isfinite(value) & (value != 0.0)
    turn = np.divide(1.0, value, out=np.full(value.shape, complex(np.nan, np.nan)), where=usable)
    relative = uncertainty.transformed(real_stacked_diagonal(turn))
    unknowns: dict[str, list[Influence]] = {}
    for influence in relative.influences:
        unknowns.setdefault(influence.label, []).append(influence)
    infinite = np.full(len(value), np.inf)
    found = []
    for part in relative.grouped():
        variance = np.maximum(part.covariance.diagonal(axis1=1, axis2=2), 0.0)
        both = np.sqrt(variance).reshape(len(value), 2, -1).swapaxes(0, 1)
        own = unknowns.get(part.label, [])
        u, unit = _input(own)
        dof = infinite if part.dof is None else part.dof
        coefficient = _coefficient(own, u, both)
        found.append(BudgetEntry(part.label, part.type, len(own), u, unit, coefficient, both[0], both[1], dof))
    return tuple(found)


def _input(own: Sequence[Influence]) -> tuple[float, str]:
    """Standard uncertainty and unit that the unknowns of one label have in common, NaN and nothing where none."""
    known = {(influence.u, influence.unit) for influence in own}
    return known.pop() if len(known) == 1 else (np.nan, "")


def _coefficient(own: Sequence[Influence], u: float, both: FloatArray) -> FloatArray:
    """Change (2, K, C) of relative magnitude and phase per unit of the unknown, with its sign where there is one."""
    if not np.isfinite(u) or u == 0.0:
        return np.full(both.shape, np.nan)
    if len(own) > 1:
        return np.asarray(both / u)
    return np.asarray(own[0].effect.reshape(both.shape[1], 2, -1).swapaxes(0, 1) / u)
