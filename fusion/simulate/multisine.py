"""Many lines in one simulated recording, and the rocking of the load that they excite."""

from __future__ import annotations

import numpy as np

from shaker.lines.multisine import LineGrid, crest_factor, place_lines, small_crest_phases
from shakercal._common.arrays import ComplexArray, FloatArray

LINES, BAND_HZ = 40, (50.0, 1000.0)
PEAK_MPS2 = 60.0
ROCKING_HZ = 375.9
_ROCKING_DAMPING = 0.03
_ROCKING_PER_M = ((0.022, 2.1), (0.034, -0.4))  # angular over linear acceleration far below resonance, about x and y


def rocking_motion(frequency_hz: FloatArray, axial: ComplexArray) -> ComplexArray:
    """Return the motion (K, 6) of a load that the axial acceleration (K,) lets rock.

    The body rocks as an oscillator, excited by the axial motion: α = a·c/(1 − η² + 2jζη).
    """
    ratio = frequency_hz / ROCKING_HZ
    resonance = 1 / (1 - ratio**2 + 2j * _ROCKING_DAMPING * ratio)
    motion = np.zeros((len(axial), 6), dtype=np.complex128)
    motion[:, 2] = axial
    for axis, (size, phase) in enumerate(_ROCKING_PER_M, 3):
        motion[:, axis] = axial * resonance * size * np.exp(1j * phase)
    side = np.array([0.004, 0.003, 0.02])  # x, y, and the turn about z in rad/m
    motion[:, [0, 1, 5]] = axial[:, None] * side * np.exp(1j * np.array([0.7, -1.9, 2.4]))
    return motion


def many_lines(
    rate_hz: float, frames: int, lines: int = LINES, peak_mps2: float = PEAK_MPS2
) -> tuple[LineGrid, ComplexArray]:
    """Return lines and motion (K, 6) of a multisine with this peak acceleration."""
    grid = place_lines(np.geomspace(*BAND_HZ, lines), rate_hz, frames)
    equal = np.ones(lines)
    phase_rad = small_crest_phases(grid.numbers, equal)
    size = peak_mps2 / (crest_factor(grid.numbers, equal, phase_rad) * np.sqrt(lines / 2.0))
    return grid, rocking_motion(grid.frequency_hz, size * np.exp(1j * phase_rad))
