"""The mounted sensor as oscillators in a row, against eigenvalues of its matrices and limits known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from shaker.elastomer.frame import MountedChain, mounted_hz

positive = st.floats(0.05, 20.0)


@settings(max_examples=40, deadline=None)
@given(mass=st.tuples(positive, positive, positive), stiffness=st.tuples(positive, positive, positive))
def test_undamped_modes_are_those_of_mass_and_stiffness(mass: tuple[float, ...], stiffness: tuple[float, ...]) -> None:
    chain = MountedChain(np.array(mass), 1e6 * np.array(stiffness), np.zeros(3))
    inert, damping, elastic = chain.matrices()
    expected = np.sqrt(eigh(elastic, inert, eigvals_only=True)) / (2.0 * np.pi)
    found, zeta = chain.modes()
    assert found == pytest.approx(expected, rel=1e-7)
    assert zeta == pytest.approx(np.zeros(3), abs=1e-7)
    assert not damping.any()


def test_poles_are_roots_of_the_determinant() -> None:
    chain = MountedChain(np.array([0.3, 0.05, 0.4]), np.array([3e6, 1.3e6, 2e7]), np.array([60.0, 9.0, 120.0]))
    mass, damping, stiffness = chain.matrices()
    frequency, zeta = chain.modes()
    for f, z in zip(frequency, zeta, strict=True):
        s = 2.0 * np.pi * f * (-z + 1j * np.sqrt(1.0 - z * z))
        matrix = s * s * mass + s * damping + stiffness
        assert abs(np.linalg.det(matrix)) < 1e-9 * np.prod(np.linalg.norm(matrix, axis=1))
    impedance = chain.impedance(np.array([100.0, 700.0]))
    omega = 2.0 * np.pi * 700.0
    assert impedance[1] == pytest.approx(stiffness + 1j * omega * damping - omega**2 * mass)


def test_damping_acts_between_neighbours_only() -> None:
    chain = MountedChain(np.ones(3), np.ones(3), np.array([2.0, 3.0, 5.0]))
    _, damping, _ = chain.matrices()
    assert damping == pytest.approx(damping.T)
    assert damping @ np.ones(3) == pytest.approx([0.0, 0.0, 5.0])  # the pedestal's alone, to the ground
    assert damping[0, 1] == -2.0  # printed -c_k
    assert damping[1, 2] == -3.0  # printed 0


def test_a_hand_lowers_the_resonance_as_an_oscillator_with_more_mass() -> None:
    hands = np.array([0.0, 0.02, 0.1, 0.5])
    rigid = mounted_hz(1.3e6, 0.05, hands)
    assert np.all(np.diff(rigid) < 0.0)
    assert rigid[0] == pytest.approx(np.sqrt(1.3e6 / 0.05) / (2.0 * np.pi))
    for hand, expected in zip(hands, rigid, strict=True):
        chain = MountedChain(np.array([hand, 0.05, 50.0]), np.array([1e10, 1.3e6, 1e12]), np.zeros(3))
        assert chain.modes()[0][0] == pytest.approx(expected, rel=1e-3)
        assert len(chain.modes()[0]) == (3 if hand else 2)


def test_wrong_chains_are_refused() -> None:
    with pytest.raises(ValueError, match="stiffness: expected 3 numbers"):
        MountedChain(np.ones(3), np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="damping: expected 3 numbers, none negative"):
        MountedChain(np.ones(3), np.ones(3), -np.ones(3))
    with pytest.raises(ValueError, match="expected above 0"):
        MountedChain(np.array([1.0, 0.0, 1.0]), np.ones(3), np.ones(3))
