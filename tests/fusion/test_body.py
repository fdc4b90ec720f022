"""Mass matrix and gravity tilt against clouds of point masses that are really turned and accelerated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.sensitivity.body import Body, Part, make_part

GRAVITY = np.array([0.3, -0.2, -9.8125])


def cloud(seed: int, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1.0, count), rng.uniform(-0.1, 0.1, (count, 3)) + np.array([0.01, -0.02, 0.05])


def part_of(mass: np.ndarray, place: np.ndarray, name: str = "cloud", u: tuple = (0.0, 0.0, 0.0)) -> Part:
    centre = mass @ place / mass.sum()
    arm = place - centre
    inertia = np.einsum(
        "n,nij->ij", mass, np.sum(arm**2, 1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None]
    )
    return make_part(name, mass.sum(), centre, inertia, u)


def test_kinetic_energy_of_point_masses() -> None:
    # 2 T = q' M q' with v_n = v + w × r_n.
    mass, place = cloud(1)
    velocity = np.array([0.3, -1.0, 0.2, 2.0, -0.7, 1.1])
    speeds = velocity[:3] + np.cross(velocity[3:], place)
    matrix = Body((part_of(mass, place),)).mass_matrix
    assert velocity @ matrix @ velocity == pytest.approx(mass @ np.sum(speeds**2, axis=1), rel=1e-12)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14)


def test_parts_add_up_like_their_points() -> None:
    (m1, r1), (m2, r2) = cloud(2), cloud(3)
    whole = Body((part_of(np.concatenate([m1, m2]), np.concatenate([r1, r2])),)).mass_matrix
    np.testing.assert_allclose(Body((part_of(m1, r1), part_of(m2, r2))).mass_matrix, whole, atol=1e-13)


def test_wrench_by_newton_and_euler_on_a_really_moving_cloud() -> None:
    # Sum over points of m (r'' - g), and of its moment, turned into body axes: first harmonic of one period.
    mass, place = cloud(4)
    frequency = 20.0
    omega = 2 * np.pi * frequency
    shift, turn = np.array([2.0, -1.0, 3.0]) * 1e-6, np.array([1.0, 2.0, -1.5]) * 1e-5
    phase = 0.4
    period, step = 1 / frequency, 1e-5
    times = np.arange(64) * period / 64

    def position(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, Rotation]:
        rotation = Rotation.from_rotvec(turn * np.cos(omega * t + phase)[:, None])
        origin = shift * np.cos(omega * t)[:, None]
        points = origin[:, None] + np.einsum("tij,nj->tni", rotation.as_matrix(), place)
        return points, origin, rotation

    here, origin, rotation = position(times)
    acceleration = (position(times + step)[0] - 2 * here + position(times - step)[0]) / step**2
    force = mass[:, None] * (acceleration - GRAVITY)
    total = force.sum(axis=1)
    moment = np.cross(here - origin[:, None], force).sum(axis=1)
    wrench = np.hstack([rotation.inv().apply(total), rotation.inv().apply(moment)])
    measured = 2 / 64 * np.exp(-1j * omega * times) @ wrench
    motion = -(omega**2) * np.concatenate([shift, turn * np.exp(1j * phase)])
    matrix = Body((part_of(mass, place),)).terms.load_matrix(np.array([frequency]), GRAVITY)[0]
    np.testing.assert_allclose(matrix @ motion, measured, rtol=0, atol=2e-6 * np.abs(measured).max())
    bare = Body((part_of(mass, place),)).mass_matrix
    assert np.abs(bare @ motion - measured).max() > 1e-4 * np.abs(measured).max()


@pytest.mark.parametrize("gravity", [None, GRAVITY])
def test_parameter_changes_are_derivatives(gravity: np.ndarray | None) -> None:
    part = part_of(*cloud(5), u=(1e-5, [1e-6, 2e-6, 3e-6], 1e-7))
    frequency = np.array([30.0])
    base = Body((part,)).terms.load_matrix(frequency, gravity)
    parameters = Body((part,)).matrix_changes(frequency, gravity)
    assert len(parameters) == 1 + 3 + 6
    shifted = make_part("", part.mass_kg + 1e-5, part.centre_of_mass_m, part.inertia_kgm2)
    expected = Body((shifted,)).terms.load_matrix(frequency, gravity) - base
    np.testing.assert_allclose(parameters[0].change, expected, atol=1e-12)
    for axis in range(3):
        centre = part.centre_of_mass_m + np.eye(3)[axis] * part.u_centre_of_mass_m
        shifted = make_part("", part.mass_kg, centre, part.inertia_kgm2)
        expected = Body((shifted,)).terms.load_matrix(frequency, gravity) - base
        np.testing.assert_allclose(parameters[1 + axis].change, expected, atol=1e-9)
    assert np.count_nonzero(parameters[4].change) == 1
    assert np.count_nonzero(parameters[7].change) == 2


def test_refusals_name_the_argument() -> None:
    with pytest.raises(ValueError, match=r"centre_of_mass_m: expected shape \(3,\), found \(2,\)"):
        make_part("p", 1.0, [0.0, 0.0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="symmetric"):
        make_part("p", 1.0, np.zeros(3), [[0, 1e-3, 0], [0, 0, 0], [0, 0, 0]])
