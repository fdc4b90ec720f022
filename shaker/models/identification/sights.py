"""Uncertain places and directions of transducers: how they change what is read of a motion, and the ratios."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray
from shaker.models.identification.mechanics import Mechanics, Response
from shaker.models.measured import AT_THE_BASE, MeasuredTransfer, SightError

_NOTHING = 1e-12  # share of a change below which it is rounding


@dataclass(frozen=True)
class Sights:
    """What one standard deviation of S unknowns of a recording changes of the readings of its C responses.

    `places` (S,) among all unknowns; `rows` (S, C, n) of p and `offset` (S, C) of the base's motion, `reference` (S,)
    what the reference reads of the latter.
    """

    places: IntArray
    rows: FloatArray
    offset: FloatArray
    reference: FloatArray

    def moved(self, mechanics: Mechanics, vector: FloatArray) -> Mechanics:
        """Return mechanics as seen from where the unknowns say that the transducers are."""
        if len(self.places) == 0:
            return mechanics
        off = vector[self.places]
        return replace(
            mechanics,
            rows=mechanics.rows + np.tensordot(off, self.rows, 1),
            offset=mechanics.offset + off @ self.offset,
            reference_offset=mechanics.reference_offset + float(off @ self.reference),
        )

    def derivatives(self, found: Response) -> ComplexArray:
        """Return the derivatives (K, C, S) of ratios: a row that changes by r reads r·X/(d·X_base) more."""
        above = np.einsum("kn,scn->kcs", found.motion, self.rows) + self.offset.T
        return np.asarray((above - found.value[:, :, None] * self.reference) / found.below[:, None, None])


def acting(record: MeasuredTransfer, body: FloatArray) -> tuple[SightError, ...]:
    """Return the errors of sights that change a reading of a load that moves along `body` (6, n) beside its base."""
    seen = np.column_stack([record.drive / np.linalg.norm(record.drive), body])
    return tuple(
        error
        for error in record.sight_errors
        if np.abs(error.change @ (seen[:, :1] if error.place == AT_THE_BASE else seen)).max()
        > _NOTHING * np.abs(error.change).max()
    )


def sights(record: MeasuredTransfer, body: FloatArray, names: Mapping[str, int]) -> Sights:
    """Return the errors of a recording that act, with the places of their `names` among the unknowns."""
    errors = acting(record, body)
    count, shape = len(errors), (len(errors), len(record.tops))
    found = Sights(
        places=np.array([names[f"error: {error.name}"] for error in errors], dtype=np.int64),
        rows=np.zeros((*shape, body.shape[1])),
        offset=np.zeros(shape),
        reference=np.zeros(count),
    )
    for number, error in enumerate(errors):
        if error.place == AT_THE_BASE:
            found.reference[number] = error.change @ record.drive
        else:
            found.rows[number, error.place] = error.change @ body
            found.offset[number, error.place] = error.change @ record.drive
    return found
