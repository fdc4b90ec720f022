"""Loads that are not rigid: modes against wave equations, published roots and finite elements; what they do to a load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import iv, jv, kv, yv

from fusion.base import InputError
from fusion.recording.load import load_manifest
from fusion.sensitivity.elastic import Modes, Place, Plate, Rod, joined, likely_frequencies

STEEL = {"young_modulus_pa": 2.0e11, "density_kgpm3": 7850.0, "poisson_ratio": 0.3}
FOOT = np.array([0.01, -0.02, 0.03])
UP = np.array([0.0, 0.0, 1.0])
ROD = Rod(FOOT, UP, 0.15, 0.02, 0.0, **STEEL)
SKEW = np.array([2.0, -1.0, 2.0]) / 3.0
ACROSS = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)


def beaten(modes: Modes, seconds: float) -> Modes:
    """Modes of a material whose modulus is E·(1 + jω·seconds)."""
    return replace(modes, damping=np.pi * modes.frequency_hz * seconds)


def top_of(rod: Rod) -> Place:
    return Place("top", rod.foot_m + rod.length_m * rod.axis)


@pytest.mark.parametrize("length", [0.05, 0.10, 0.15])
def test_a_rod_driven_along_its_axis_obeys_the_wave_equation(length):
    # u(z) = cos k(L - z)/cos kL with k = ω √(ρ/E*), F = m a tan(kL)/(kL); without lateral contraction.
    rod = replace(ROD, length_m=length, poisson_ratio=0.0, axis=SKEW)
    frequency, lag = np.array([300.0, 1000.0, 4000.0, 15000.0]), 2e-7
    k = 2.0 * np.pi * frequency * np.sqrt(7850.0 / (2.0e11 * (1.0 + 2j * np.pi * frequency * lag)))
    modes = beaten(joined(list(rod.families().values())), lag)
    # The axial motion of the foot, which is not the sensor origin.
    drive = np.concatenate([SKEW, np.zeros(3)])
    force = rod.mass_kg * drive[:3] + np.einsum("kij,j->ki", modes.wrench(frequency), drive)[:, :3]
    expected = rod.mass_kg * np.tan(k * length) / (k * length)
    np.testing.assert_allclose(force, expected[:, None] * SKEW, rtol=1e-7, atol=1e-9)
    moment = np.einsum("kij,j->ki", modes.wrench(frequency), drive)[:, 3:]
    bending = force - rod.mass_kg * SKEW
    np.testing.assert_allclose(moment, np.cross(rod.foot_m, bending), atol=1e-9)
    for share in (0.3, 1.0):
        place = Place("", rod.foot_m + share * length * SKEW + 0.004 * np.cross(SKEW, UP))
        moved = drive[:3] + np.einsum("kij,j->ki", modes.stretch(frequency, place), drive)[:, :3]
        wave = np.cos(k * length * (1.0 - share)) / np.cos(k * length)
        np.testing.assert_allclose(moved, wave[:, None] * SKEW, rtol=1e-6, atol=1e-7)
    if length == 0.15:
        top = modes.stretch(frequency, top_of(rod)) @ drive
        assert abs(force[1] @ SKEW / (1.0 + top[1, :3] @ SKEW) / rod.mass_kg) == pytest.approx(1.0 - 0.0058, abs=1e-4)


def test_natural_frequencies_are_the_published_ones_of_cantilevers():
    # Young and Felgar 1949: roots of cos x cosh x = -1; Love's and Timoshenko's terms vanish with the slenderness.
    slim = replace(ROD, length_m=4.0)
    families = slim.families()
    speed = np.sqrt(2.0e11 / 7850.0)
    roots = np.array([1.8751040687, 4.6940911330, 7.8547574382])
    expected = roots**2 / (2.0 * np.pi) * speed * (0.02 / 4.0) / 4.0**2
    found = np.sort(families["bending"].frequency_hz)
    np.testing.assert_array_less(np.abs(found[0:6:2] / expected - 1.0), [4e-5, 3e-4, 9e-4])
    np.testing.assert_allclose(found[1:6:2], found[0:6:2], rtol=1e-9)
    np.testing.assert_allclose(families["axial"].frequency_hz[:3], speed / 16.0 * np.array([1, 3, 5]), rtol=1e-5)
    shear = speed / np.sqrt(2.6)
    np.testing.assert_allclose(families["torsion"].frequency_hz[:3], shear / 16.0 * np.array([1, 3, 5]), rtol=1e-6)
    # A mass at the end: kL tan kL = m/M along the axis.
    loaded = replace(slim, tip_mass_kg=slim.mass_kg / 2.0, poisson_ratio=0.0)
    root = brentq(lambda x: x * np.tan(x) - 2.0, 0.1, 1.5)
    assert loaded.families()["axial"].frequency_hz[0] == pytest.approx(root * speed / 4.0 / (2 * np.pi), rel=1e-7)


def beam_elements(rod: Rod, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of a Timoshenko beam of elements of two nodes, w and slope, shear integrated at one point."""
    e, rho, nu, d = rod.young_modulus_pa, rod.density_kgpm3, rod.poisson_ratio, rod.diameter_m
    area, second, h = np.pi / 4 * d**2, np.pi / 64 * d**4, rod.length_m / count
    shear = 6 * (1 + nu) / (7 + 6 * nu) * area * e / (2 * (1 + nu))
    stiffness, mass = np.zeros((2, 2 * count + 2, 2 * count + 2))
    turn, slide = np.array([0, -1, 0, 1]) / h, np.array([-1 / h, -0.5, 1 / h, -0.5])
    k = h * (e * second * np.outer(turn, turn) + shear * np.outer(slide, slide))
    m = rho * h / 6 * np.kron([[2, 1], [1, 2]], np.diag([area, second]))
    for n in range(count):
        own = slice(2 * n, 2 * n + 4)
        stiffness[own, own] += k
        mass[own, own] += m
    return stiffness, mass


def driven(stiffness: np.ndarray, mass: np.ndarray, omega: float, lag: float, base: np.ndarray) -> tuple:
    """Accelerations of all nodes and reactions of the first one, whose two accelerations are given."""
    dynamic = stiffness * (1.0 + 1j * omega * lag) - omega**2 * mass
    shift = -base / omega**2
    free = np.linalg.solve(dynamic[2:, 2:], -dynamic[2:, :2] @ shift)
    whole = np.concatenate([shift, free])
    return -(omega**2) * whole, dynamic[:2] @ whole


@pytest.mark.parametrize("base", [[1.0, 0.0], [0.0, 1.0]])
@pytest.mark.parametrize("frequency", [100.0, 400.0, 1000.0, 5000.0])
def test_a_bending_rod_moves_and_pulls_as_finite_elements_do(frequency, base):
    lag, count = 3e-6, 400
    values = []
    for number in (count, 2 * count):  # Richardson: errors of linear elements fall with the square of their length
        accelerations, reaction = driven(*beam_elements(ROD, number), 2 * np.pi * frequency, lag, np.array(base))
        values.append(np.concatenate([reaction, accelerations[-2:], accelerations[number : number + 2]]))
    expected = (4.0 * values[1] - values[0]) / 3.0
    # Moved along `ACROSS`, or turned about UP × ACROSS at the foot.
    rod = replace(ROD, foot_m=np.zeros(3))
    modes = beaten(joined(list(rod.families().values())), lag)
    about = np.cross(UP, ACROSS)
    drive = np.concatenate([base[0] * ACROSS, base[1] * about])
    mass, half, second = rod.mass_kg, rod.length_m / 2, rod.length_m**2 / 3 + rod.diameter_m**2 / 16
    rigid = mass * np.array([[1.0, half], [half, second]]) @ base
    wrench = modes.wrench(np.array([frequency]))[0] @ drive
    found = [wrench[:3] @ ACROSS + rigid[0], wrench[3:] @ about + rigid[1]]
    for share in (1.0, 0.5):
        height = share * rod.length_m
        own = modes.stretch(np.array([frequency]), Place("", height * UP))[0] @ drive + drive
        found += [own[:3] @ ACROSS + own[3:] @ about * height, own[3:] @ about]
    np.testing.assert_allclose(found, expected, rtol=2e-5)


def annular_root(ratio: float, n: int) -> float:
    """First λ of a thin plate of ν = 0.3, clamped at r = ratio and free at r = 1, from Bessel functions."""

    def row(r: float, x: float, free: bool) -> list[list[float]]:
        rows = np.zeros((2, 4))
        for column, (f, sign) in enumerate(((jv, -1), (yv, -1), (iv, 1), (kv, 1))):
            h = 1e-5
            w, up, down = f(n, x * r), f(n, x * (r + h)), f(n, x * (r - h))
            first = (up - down) / (2 * h)
            if not free:
                rows[:, column] = w, first
                continue
            # ∇²w = ±λ²w; M_r = ∇²w - (1 - ν)(w'/r - n²w/r²), V_r = (∇²w)' - (1 - ν)n²/r²·(w' - w/r).
            rows[0, column] = sign * x**2 * w - 0.7 * (first / r - n**2 * w / r**2)
            rows[1, column] = sign * x**2 * first - 0.7 * n**2 / r**2 * (first - w / r)
        return rows.tolist()

    def determinant(x: float) -> float:
        matrix = np.array([*row(ratio, x, False), *row(1.0, x, True)])
        return float(np.linalg.det(matrix / np.abs(matrix).max(axis=0)))

    grid = np.linspace(0.8, 6.0, 500)
    signs = np.sign([determinant(x) for x in grid])
    place = int(np.flatnonzero(np.diff(signs))[0])
    return float(brentq(determinant, grid[place], grid[place + 1]))


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5])
@pytest.mark.parametrize(("n", "family"), [(0, "axial"), (1, "bending")])
def test_plates_have_the_frequencies_of_bessel_functions(ratio, n, family):
    plate = Plate(FOOT, UP, 2e-4, 0.2, 0.2 * ratio, **STEEL)
    bending = np.sqrt(2.0e11 * 2e-4**2 / (12.0 * (1.0 - 0.09) * 7850.0))
    expected = annular_root(ratio, n) ** 2 / (2.0 * np.pi * 0.1**2) * bending
    assert plate.families()[family].frequency_hz.min() == pytest.approx(expected, rel=3e-4)
