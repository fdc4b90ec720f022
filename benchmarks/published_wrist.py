"""The numbers printed on a wrist force sensor (J. Sensors 2018, 6216979) that docs/papers.md starts from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shaker.elastomer.geometry import CrossBeams, ElasticMaterial
from shaker.lti.system import LinearSystem

FloatArray = NDArray[np.float64]

RATE_HZ = 100e3
BEAMS = CrossBeams(ElasticMaterial(72e9, 0.3, 2820.0), 64e-3, 3.8e-3, 3.8e-3, 1e-3, 32e-3, 3.8e-3)
"""Table 1; the height of the compliant beams is that of the beams."""
SPRING_N_PER_M, MASS_KG = 1.824e5, 0.049
COMPONENTS = ("Fx", "My", "Mz", "Fz")
MODELS = {
    "simplified dynamics": (1642.0, 3376.0, 4892.0, 1973.0),
    "finite elements": (1660.0, 3578.0, 5094.0, 2025.0),
    "SIM": (1720.0, 3530.0, 5060.0, 2020.0),
    "DE": (1680.0, 3460.0, 4910.0, 1986.0),
}
"""Natural frequencies in Hz of Table 6, in the order of `COMPONENTS`."""
LARGEST_DIFFERENCE = (4.5, 5.6, 4.0, 2.6)
BANDS_HZ = {
    "SIM": ((560.0, 997.0, 1622.0, 652.0), (414.0, 693.0, 1294.0, 475.0)),
    "DE": ((530.0, 980.0, 1610.0, 648.0), (405.0, 678.0, 1285.0, 466.0)),
}
"""Tables 4 and 5: up to ±10 % and up to ±5 %."""

DIFFERENCE_NUMERATOR = np.array([0.0037, -0.0011, 0.0047, 0.0083])
DIFFERENCE_DENOMINATOR = np.array([1.0, -1.3076, -0.2608, 0.5841])
"""Equation 20 (and 19), in falling powers of z."""
TRANSFER_NUMERATOR = np.array([8.2e-4, 4430.0, -5.36e8, 8.532e13])
TRANSFER_DENOMINATOR = np.array([1.0, 8.643e5, 5.494e9, 8.587e13])
"""Equation 21."""
EVOLVED = {
    "Fx": ([0.00798, -0.01281, 0.0063], [1.0, -2.841, 2.702, -0.8597], [0.0, 1e-3, 1e-3, 1e-4]),
    "My": ([-0.01755, 0.04019, -0.02001], [1.0, -2.797, 2.615, -0.816], [0.0, 1e-3, 1e-3, 1e-3]),
    "Mz": ([-0.00606, 0.009565, -0.003314], [1.0, -1.009, -0.9739, 0.9831], [0.0, 1e-3, 1e-4, 1e-4]),
    "Fz": ([-0.0007735, -0.002627, 0.005051], [1.0, -1.053, -0.8864, 0.941], [0.0, 1e-3, 1e-4, 1e-3]),
}
"""Equations 23 to 26: numerator from z⁻¹ on, denominator from 1 on, its last printed digits."""


def difference_equation() -> LinearSystem:
    """Return equation 20 at the stated rate."""
    return LinearSystem.from_coefficients(DIFFERENCE_NUMERATOR, DIFFERENCE_DENOMINATOR, RATE_HZ)


def transfer_function() -> LinearSystem:
    """Return equation 21."""
    return LinearSystem.from_coefficients(TRANSFER_NUMERATOR, TRANSFER_DENOMINATOR)


def evolved(component: str) -> LinearSystem:
    """Return equation 23, 24, 25 or 26 at the stated rate."""
    numerator, denominator, _ = EVOLVED[component]
    return LinearSystem.from_coefficients(np.array([0.0, *numerator]), np.array(denominator), RATE_HZ)


def evolved_digits(component: str) -> tuple[FloatArray, FloatArray]:
    """Return denominator and last printed digits of equation 23, 24, 25 or 26."""
    _, denominator, digits = EVOLVED[component]
    return np.array(denominator), np.array(digits)
