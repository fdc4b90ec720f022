"""Stiffness and mass of a straight Timoshenko beam in space, 12 × 12."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.elastomer.geometry import Material, Section

IN_PLANE, ACROSS = [1, 5, 7, 11], [2, 4, 8, 10]
"""Deflection and slope of both ends in the planes xy and xz; in the latter a positive slope is a negative turn."""
ALONG, TWIST = [0, 6], [3, 9]


def beam_matrices(
    material: Material, section: Section, length_m: float, shear_factor: float
) -> tuple[FloatArray, FloatArray]:
    """Return stiffness and consistent mass (12, 12) over (ux uy uz rx ry rz) of the two ends, x along the beam.

    Axial, torsion, two bending planes with shear and rotary inertia, Φ = 12EI/(KGAL²): exact in statics.
    Przemieniecki 1968, sections 5.6 and 11.3 (the cubic functions of a beam that shears).
    """
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    modulus, shear = material.youngs_modulus_pa, material.shear_modulus_pa
    area, density = section.area_m2, material.density_kgm3
    planes = ((section.bending_in_plane_m4, IN_PLANE, 1.0), (section.bending_across_m4, ACROSS, -1.0))
    polar = section.bending_in_plane_m4 + section.bending_across_m4
    for places, elastic, inert in (
        (ALONG, modulus * area, density * area),
        (TWIST, shear * section.torsion_m4, density * polar),
    ):
        stiffness[np.ix_(places, places)] += elastic / length_m * np.array([[1.0, -1.0], [-1.0, 1.0]])
        mass[np.ix_(places, places)] += inert * length_m / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    for second_moment, places, sense in planes:
        phi = 12.0 * modulus * second_moment / (shear_factor * shear * area * length_m**2)
        turn = np.outer(*(np.array([1.0, sense, 1.0, sense]),) * 2)
        elastic_part = modulus * second_moment / length_m**3 * _bending(phi, length_m)
        inert_part = density * area * length_m * _translation(phi, length_m)
        inert_part += density * second_moment / length_m * _rotation(phi, length_m)
        stiffness[np.ix_(places, places)] += turn * elastic_part
        mass[np.ix_(places, places)] += turn * inert_part
    return stiffness, mass


def lumped(mass: FloatArray) -> FloatArray:
    """Return a diagonal mass (12, 12): half the beam's mass and twist at each end, turns as on its diagonal."""
    total = float(mass[np.ix_(ALONG, ALONG)].sum())
    twist = float(mass[np.ix_(TWIST, TWIST)].sum())
    parts = np.array([total, total, total, twist, 0.0, 0.0]) / 2.0
    for place, plane in ((5, IN_PLANE), (4, ACROSS)):
        turn = mass[np.ix_(plane, plane)]
        parts[place] = float(turn[1, 1] + turn[3, 3]) / 2.0
    return np.diag(np.concatenate([parts, parts]))


def _bending(phi: float, length: float) -> FloatArray:
    """Bending stiffness (4, 4) over deflection and slope of both ends, less EI/L³."""
    a, b = 6.0 * length, (4.0 + phi) * length**2
    c = (2.0 - phi) * length**2
    rows = [[12.0, a, -12.0, a], [a, b, -a, c], [-12.0, -a, 12.0, -a], [a, c, -a, b]]
    return np.array(rows) / (1.0 + phi)


def _translation(phi: float, length: float) -> FloatArray:
    """Mass (4, 4) of the deflection, less ρAL."""
    a = 13.0 / 35.0 + 7.0 * phi / 10.0 + phi**2 / 3.0
    b = (11.0 / 210.0 + 11.0 * phi / 120.0 + phi**2 / 24.0) * length
    c = 9.0 / 70.0 + 3.0 * phi / 10.0 + phi**2 / 6.0
    d = (13.0 / 420.0 + 3.0 * phi / 40.0 + phi**2 / 24.0) * length
    e = (1.0 / 105.0 + phi / 60.0 + phi**2 / 120.0) * length**2
    f = (1.0 / 140.0 + phi / 60.0 + phi**2 / 120.0) * length**2
    rows = [[a, b, c, -d], [b, e, d, -f], [c, d, a, -b], [-d, -f, -b, e]]
    return np.array(rows) / (1.0 + phi) ** 2


def _rotation(phi: float, length: float) -> FloatArray:
    """Mass (4, 4) of the turning sections, less ρI/L."""
    a = (1.0 / 10.0 - phi / 2.0) * length
    b = (2.0 / 15.0 + phi / 6.0 + phi**2 / 3.0) * length**2
    c = (-1.0 / 30.0 - phi / 6.0 + phi**2 / 6.0) * length**2
    rows = [[1.2, a, -1.2, a], [a, b, -a, c], [-1.2, -a, 1.2, -a], [a, c, -a, b]]
    return np.array(rows) / (1.0 + phi) ** 2
