"""Load matrices of a body whose masses, centres and moments of inertia are what is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.body import INERTIA_ENTRIES, Body, Part
from fusion.monte_carlo.deviates import Deviates
from shaker._checks import ComplexArray, FloatArray

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def draw_load_matrices(
    body: Body,
    frequency_hz: FloatArray,
    gravity_mps2: FloatArray | None,
    u_gravity_mps2: FloatArray | None,
    deviates: Deviates,
) -> ComplexArray:
    """Return N load matrices (N, K, 6, 6): mass, centre of mass and inertia of every part drawn, and whatever else.

    The parts' own numbers enter exactly; gravity, the joint and the air by their first-order changes.
    """
    own = {f"{part.name}: {what}" for part in body.parts for what in ("mass", "centre of mass", "inertia")}
    total = np.zeros((deviates.count, len(frequency_hz), 6, 6), dtype=np.complex128)
    for part in body.parts:
        terms = _polynomial(replace(body, parts=(part,)), frequency_hz, gravity_mps2)
        total += np.tensordot(_drawn_part(part, deviates), terms, 1)
    for change in body.matrix_changes(frequency_hz, gravity_mps2, u_gravity_mps2):
        if change.label not in own:
            total += deviates.normal(change.name)[:, None, None, None] * change.change
    return total


def _drawn_part(part: Part, deviates: Deviates) -> FloatArray:
    """Monomials (N, 16) of a drawn part: mass times (1, c, products of c) and the six entries of its inertia."""
    mass = part.mass_kg + part.u_mass_kg * deviates.normal(f"{part.name}: mass")
    centre = part.centre_of_mass_m + part.u_centre_of_mass_m * deviates.normal(f"{part.name}: centre of mass", 3)
    six = deviates.normal(f"{part.name}: inertia", 6)
    entries = tuple(np.array(INERTIA_ENTRIES).T)
    inertia = part.inertia_kgm2[entries] + part.u_inertia_kgm2[entries] * six
    products = [centre[:, i] * centre[:, j] for i, j in PAIRS]
    places = np.column_stack([np.ones(deviates.count), centre, *products])
    return np.column_stack([mass[:, None] * places, inertia])


def _polynomial(alone: Body, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
    """Coefficients (16, K, 6, 6) of the monomials of `_drawn_part` in the load matrix of a body of one part.

    The matrix is linear in mass and inertia and of second order in the centre of mass: its values at 0, ±e_i and
    e_i + e_j tell all of it.
    """
    (part,) = alone.parts

    def at(mass: float, centre: FloatArray, inertia: FloatArray) -> ComplexArray:
        one = replace(part, mass_kg=mass, centre_of_mass_m=centre, inertia_kgm2=inertia)
        return replace(alone, parts=(one,)).load_matrix(frequency_hz, gravity_mps2)

    none, unit = np.zeros((3, 3)), np.eye(3)
    still = at(1.0, np.zeros(3), none)
    ahead, behind = ([at(1.0, sign * e, none) for e in unit] for sign in (1.0, -1.0))
    slope = [(a - b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    square = [(a + b) / 2.0 - still for a, b in zip(ahead, behind, strict=True)]
    mixed = [
        at(1.0, unit[i] + unit[j], none) - still - slope[i] - slope[j] - square[i] - square[j] for i, j in PAIRS[3:]
    ]
    turning = [at(0.0, np.zeros(3), _symmetric(i, j)) for i, j in INERTIA_ENTRIES]
    return np.stack([still, *slope, *square, *mixed, *turning])


def _symmetric(row: int, column: int) -> FloatArray:
    """Unit matrix entry (3, 3) with its mirror image."""
    matrix = np.zeros((3, 3))
    matrix[row, column] = matrix[column, row] = 1.0
    return matrix
