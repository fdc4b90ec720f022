"""Formulas of the three publications that the program itself has no use for, and what rounded coefficients leave open.

Nitsche et al. (J. Sens. Sens. Syst. 7, 2018), equations 1, 2 and 10; the wrist sensor (J. Sensors 2018, 6216979),
equation 4 and the printed digits of its difference equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from shaker.elastomer.geometry import PublishedStatics
from shaker.identification.oscillator import INVERSE_POWER_LEVELS, PeakWidth
from shakercal._common.arrays import FloatArray, check_shape

Form = Literal["exact", "series"]


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


def damping_from_width(width_hz: float, mass: float, width: PeakWidth = "half_power") -> float:
    """Return b = √(km)·Δf/f₀ = 2πmΔf, kg/s (Nitsche et al. 2018, equation 10, which holds for the half-power width).

    The width at half the amplitude is √3 times as large and is divided by it.
    """
    return float(2.0 * np.pi * mass * width_hz / np.sqrt(INVERSE_POWER_LEVELS[width] - 1.0))


def width_from_damping(damping: float, mass: float, width: PeakWidth = "half_power") -> float:
    """Return the width Δf in Hz that a damping b shows: b/(2πm), times √3 at half the amplitude."""
    return float(damping * np.sqrt(INVERSE_POWER_LEVELS[width] - 1.0) / (2.0 * np.pi * mass))


def supported_deflection(formula: PublishedStatics, place_m: float) -> float:
    """Return ω(x)/F_e in m/N of a cross beam on two supports with its load at mid-span, equation 4, printed G."""
    beams, section = formula.beams, formula.beams.beam
    length = beams.span_m
    if not 0.0 <= place_m <= length:
        raise ValueError(f"place_m: expected from 0 to {length}, found {place_m}")
    x = min(place_m, length - place_m)
    bending = beams.material.youngs_modulus_pa * section.bending_in_plane_m4
    shear = beams.shear_factor * formula.shear_modulus_pa * section.area_m2
    return (length**2 * x / 16.0 - x**3 / 12.0) / bending + x / (2.0 * shear)


POINTS = 129
SCAN = 20001
MOST = 10


@dataclass(frozen=True)
class RoundingRange:
    """Natural frequency in Hz of the lowest mode and the largest |z| of a pole over all that rounding permits.

    `natural_hz` (2,): lowest and highest, NaN where no system of the box oscillates; `always_oscillates`: whether every
    system does; `radius`: unstable systems are among them if it is 1 or more.
    """

    natural_hz: FloatArray
    always_oscillates: bool
    radius: float


def rounding_range(denominator: FloatArray, last_digit: FloatArray, sample_rate_hz: float) -> RoundingRange:
    """Return what a0 + a1 z⁻¹ + … + an z⁻ⁿ (n + 1,) may stand for, each coefficient rounded to a `last_digit` (n + 1,).

    0 as last digit of one that is exact. The extremes of the roots lie on the edges of the box of coefficients
    (Bartlett, Hollot, Lin, Math. Control Signals Systems 1 (1988) 61-71), each looked at in 129 points, or where two
    roots meet on the real axis.
    """
    centre, half = np.asarray(denominator, dtype=np.float64), 0.5 * np.asarray(last_digit, dtype=np.float64)
    check_shape("last_digit", half, centre.shape)
    if not 1 < len(centre) <= MOST + 1:
        raise ValueError(f"denominator: expected 2 to {MOST + 1} coefficients, found {len(centre)}")
    if not sample_rate_hz > 0:
        raise ValueError(f"sample_rate_hz: expected a positive number, found {sample_rate_hz}")
    lowest, largest = [], []
    for edge in _edges(half):
        z = np.roots(centre + edge)
        largest.append(float(np.max(np.abs(z))))
        upper = z[z.imag > 1e-9 * np.abs(z)]
        lowest.append(float(np.min(np.abs(np.log(upper)), initial=np.inf)) * sample_rate_hz / (2 * np.pi))
    found = np.array(lowest)
    seen, always = found[np.isfinite(found)], bool(np.all(np.isfinite(found)))
    if not always:
        seen = np.concatenate([seen, _doubled(centre, half) * sample_rate_hz / (2 * np.pi)])
    ends = np.array([seen.min(), seen.max()]) if len(seen) else np.full(2, np.nan)
    return RoundingRange(ends, always, max(largest))


def _doubled(centre: FloatArray, half: FloatArray) -> FloatArray:
    """Return |ln z| (K,) of double roots z > 0 that the box has, on a fine grid.

    p(z) = 0 and p'(z) = 0 have a solution in the box if and only if, for the power k of every free coefficient,
    |Σ (k - j) c_j z^j| ≤ Σ half_j |k - j| z^j (Farkas: the two equations combined so that c_k drops out).
    """
    decay = np.geomspace(1e-5, 10.0, SCAN)
    decay = np.concatenate([decay, -decay])
    power = np.arange(len(centre) - 1, -1, -1.0)
    terms = np.exp(-np.outer(decay, power))
    possible = np.ones(len(decay), dtype=bool)
    for k in power[half > 0]:
        possible &= np.abs(terms @ ((k - power) * centre)) <= terms @ (np.abs(k - power) * half)
    return np.asarray(np.abs(decay[possible]))


def _edges(half: FloatArray) -> FloatArray:
    """Return points (E, n + 1) on all edges of a box about 0."""
    free = np.flatnonzero(half)
    parts = [np.zeros((1, len(half)))]
    for moving in free:
        others = [i for i in free if i != moving]
        for signs in product((-1.0, 1.0), repeat=len(others)):
            points = np.zeros((POINTS, len(half)))
            points[:, others] = np.array(signs) * half[others]
            points[:, moving] = np.linspace(-half[moving], half[moving], POINTS)
            parts.append(points)
    return np.concatenate(parts)
