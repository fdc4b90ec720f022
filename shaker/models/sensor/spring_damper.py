"""The sensor's spring and damper: what stiffness and damping do to the sensitivity and to its phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray

Form = Literal["exact", "series"]


@dataclass(frozen=True)
class SpringPrior:
    """Stiffness and damping as a resonance gives them, with their standard uncertainties and correlation.

    k in N/m, b in kg/s; of a rotation N·m/rad and N·m·s/rad.
    """

    k: float
    u_k: float
    b: float
    u_b: float
    r_kb: float = 0.0

    def __post_init__(self) -> None:
        if not (self.k > 0.0 and self.u_k >= 0.0 and self.u_b >= 0.0):
            raise ValueError(f"k, u_k, u_b: expected k > 0 and u >= 0, found {self.k:g}, {self.u_k:g} and {self.u_b:g}")
        if not abs(self.r_kb) <= 1.0:
            raise ValueError(f"r_kb: expected a correlation of -1 to 1, found {self.r_kb:g}")

    @property
    def covariance(self) -> FloatArray:
        """Covariance (2, 2) of [k, b]."""
        mixed = self.r_kb * self.u_k * self.u_b
        return np.array([[self.u_k**2, mixed], [mixed, self.u_b**2]])

    @property
    def time_s(self) -> float:
        """τ = b/k in s, the time constant of the lag that the damper makes."""
        return self.b / self.k

    @property
    def time_slope(self) -> FloatArray:
        """Derivatives (2,) of b/k by [k, b]."""
        return np.array([-self.b / self.k**2, 1.0 / self.k])

    @property
    def u_time_s(self) -> float:
        """Standard uncertainty of b/k in s."""
        return float(np.sqrt(self.time_slope @ self.covariance @ self.time_slope))


def relative_sensitivity(frequency_hz: FloatArray, k: float, b: float, form: Form = "exact") -> FloatArray:
    """Return |S(f)|/S(0) of a spring k (N/m) with a damper b (kg/s) at frequencies (K,) in Hz.

    `exact`: 1/√(1 + (bω/k)²); `series`: 1 − ½(b/k)²ω². Both are equation 1 of Nitsche et al., J. Sens. Sens. Syst. 7,
    2018: c/√(k² + (bω)²) ≈ (c/k)(1 − ½(b/k)²ω²), with S(0) = c/k.
    """
    turned = _turned(frequency_hz, k, b)
    return 1.0 - 0.5 * turned**2 if form == "series" else 1.0 / np.sqrt(1.0 + turned**2)


def sensitivity_phase_rad(frequency_hz: FloatArray, k: float, b: float, form: Form = "exact") -> FloatArray:
    """Return the phase of the output to the force in rad at frequencies (K,) in Hz.

    `exact`: −arctan(bω/k); `series`: −bω/k, equation 2 of the same paper.
    """
    turned = _turned(frequency_hz, k, b)
    return -turned if form == "series" else -np.arctan(turned)


def damping_from_sensitivity(relative: float, frequency_hz: float, k: float, form: Form = "exact") -> float:
    """Return the b (kg/s) that would lower the sensitivity to `relative` of its static value: equation 1 solved for b.

    `exact`: (k/ω)√(1/S² − 1); `series`: (k/ω)√(2(1 − S)).
    """
    if not 0.0 < relative <= 1.0:
        raise ValueError(f"relative: expected more than 0 and at most 1, found {relative:g}")
    turned = np.sqrt(2.0 * (1.0 - relative) if form == "series" else relative**-2.0 - 1.0)
    return float(k * turned / (2.0 * np.pi * frequency_hz))


def damping_from_phase(phase_rad: float, frequency_hz: float, k: float, form: Form = "exact") -> float:
    """Return the b (kg/s) that would turn the output by `phase_rad`: equation 2 solved for b.

    `exact`: −(k/ω)·tan φ; `series`: −(k/ω)·φ.
    """
    if not abs(phase_rad) < 0.5 * np.pi:
        raise ValueError(f"phase_rad: expected a phase between -π/2 and π/2, found {phase_rad:g}")
    turned = phase_rad if form == "series" else np.tan(phase_rad)
    return float(-k * turned / (2.0 * np.pi * frequency_hz))


def series_limits_hz(k: float, b: float, departure: float = 0.01) -> tuple[float, float]:
    """Return the frequencies (Hz) up to which the series of equations 1 and 2 keep within `departure`.

    With x = bω/k: (1 − ½x²)·√(1 + x²) = 1 − departure for the magnitude, x/arctan x = 1 + departure for the phase;
    at 1 % x = 0.409 and x = 0.174. Infinite without damping.
    """
    if not 0.0 < departure < 1.0:
        raise ValueError(f"departure: expected a share between 0 and 1, found {departure:g}")
    from scipy import optimize

    magnitude = optimize.brentq(lambda x: (1.0 - 0.5 * x * x) * np.sqrt(1.0 + x * x) - 1.0 + departure, 1e-6, 2.0**0.5)
    phase = optimize.brentq(lambda x: x - (1.0 + departure) * np.arctan(x), 1e-3 * departure**0.5, 10.0)
    if b == 0.0:
        return np.inf, np.inf
    to_hz = k / (2.0 * np.pi * abs(b))
    return float(magnitude * to_hz), float(phase * to_hz)


def _turned(frequency_hz: FloatArray, k: float, b: float) -> FloatArray:
    """Return bω/k."""
    if not k > 0.0:
        raise ValueError(f"k: expected a stiffness above 0, found {k:g}")
    return np.asarray(2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64) * (b / k))
