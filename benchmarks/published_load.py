"""The numbers printed in the paper on load characteristics (IEEE Access) that docs/papers.md starts from."""

from __future__ import annotations

import numpy as np

from shaker.lti.system import LinearSystem
from shaker.release.load_model import LoadModel
from shaker.release.load_modes import Resonances, SeriesMasses

BEAM_KG, COVER_KG, PILLAR_KG = 0.089, 0.130, 0.021
"""Table 1."""
MOVING_KG = BEAM_KG + COVER_KG + PILLAR_KG
LOADS_KG = np.array([0.0, 0.008, 0.048, 0.098, 0.198])
RESONANCE_HZ = np.array([500.0, 486.0, 450.0, 393.0, 320.0])
"""Section II B, of the five load cases."""
OVERSHOOT, DAMPING = 0.926, 0.004
"""Equations 8 and 10."""
TWO_MASS = LoadModel("Fy", "Fy", "V", BEAM_KG, 2.36e6, 6.0)
"""Equations 13, 14 and 16: m_L holds cover and pillar."""


def resonances() -> Resonances:
    """Return the first resonances alone, without uncertainties."""
    frequency = np.full((5, 2), np.nan)
    frequency[:, 0] = RESONANCE_HZ
    names = tuple(f"{1e3 * load:.0f} g" for load in LOADS_KG)
    return Resonances(names, frequency, np.zeros((5, 2)), np.full((5, 2), np.nan), np.zeros((5, 2)))


def masses() -> SeriesMasses:
    """Return the masses, cover and pillar with the moving mass."""
    return SeriesMasses(MOVING_KG, LOADS_KG, (), np.zeros(0), np.zeros((5, 0)))


def identified() -> LinearSystem:
    """Return equation 11."""
    return LinearSystem.from_coefficients(np.array([9.86e6]), np.array([1.0, 25.0, 9.86e6]))


def compensated() -> LinearSystem:
    """Return equation 15."""
    return LinearSystem.from_coefficients(np.array([3.94e7]), np.array([1.0, 6280.0, 3.94e7]))


def filter_as_printed() -> LinearSystem:
    """Return equation 17 without load, m_L = 0.151 kg."""
    return LinearSystem.from_coefficients(16.7 * np.array([MOVING_KG, 6.0, 2.36e6]), np.array([1.0, 6280.0, 3.94e7]))
