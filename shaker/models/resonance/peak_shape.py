"""Where |H| of one resonance is largest and where it has fallen to a given share of that, between the lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.models.resonance.noisy_curve import NoisyCurve

Width = Literal["half_power", "half_amplitude"]
LEVELS: dict[Width, float] = {"half_power": 2.0, "half_amplitude": 4.0}  # of 1/|H|², relative to the maximum
_PASSES = 3


@dataclass(frozen=True)
class Place:
    """A frequency read from a curve, 1/|H|² there, and their gradients (K,) by 1/|H|² of every line; NaN: not found."""

    frequency_hz: float
    inverse: float
    by_line: FloatArray
    inverse_by_line: FloatArray


@dataclass(frozen=True)
class _Parabola:
    """1/|H|² = c₀ + c₁u + c₂u² near one frequency, u = (f² - `centre`)/`scale`; c = `by_line` (3, K) · 1/|H|²."""

    centre: float
    scale: float
    coefficients: FloatArray
    by_line: FloatArray

    def frequency(self, u: float, u_by_line: FloatArray) -> tuple[float, FloatArray]:
        """Return the frequency at u and its gradient (K,)."""
        frequency = float(np.sqrt(self.centre + self.scale * u))
        return frequency, np.asarray(u_by_line * self.scale / (2.0 * frequency))


def _nowhere(curve: NoisyCurve) -> Place:
    """Return the place that was not found."""
    nothing = np.full(len(curve.frequency_hz), np.nan)
    return Place(np.nan, np.nan, nothing, nothing)


def read_shape(curve: NoisyCurve) -> tuple[Place, dict[Width, tuple[Place, Place]]]:
    """Return the maximum and the crossings below and above it for both widths.

    1/|H|² of one base-excited oscillator is a parabola over f², but for a factor 1 + 4ζ²f²/f₀². The maximum is the
    vertex of the parabola of the lines above half power, a crossing that of the lines within a quarter width around it.
    """
    frequency, low, high = _first_look(curve)
    top = _nowhere(curve)
    crossings: dict[Width, tuple[Place, Place]] = {}
    for _ in range(_PASSES):
        width = high - low
        top = _top(curve, frequency, 0.5 * width)
        if not np.isfinite(top.frequency_hz):
            return top, dict.fromkeys(LEVELS, (top, top))
        for name, level in LEVELS.items():
            reach = 0.5 * width * np.sqrt(level - 1.0)
            pair = [_crossing(curve, top, level, top.frequency_hz + side * reach, 0.25 * width) for side in (-1, 1)]
            crossings[name] = pair[0], pair[1]
        found = [place.frequency_hz for place in crossings["half_power"]]
        if not np.all(np.isfinite(found)):
            break
        frequency, (low, high) = top.frequency_hz, found
    return top, crossings


def _first_look(curve: NoisyCurve) -> tuple[float, float, float]:
    """Return the line of the maximum and where the lines next to it first fall below 1/√2 of it, mirrored if absent."""
    power = _smoothed_power(curve)
    peak = int(np.argmax(power))
    at = float(curve.frequency_hz[peak])
    below = np.flatnonzero(power < 0.5 * power[peak])
    left, right = below[below < peak], below[below > peak]
    reach = [at - curve.frequency_hz[left[-1]]] if len(left) else []
    reach += [curve.frequency_hz[right[0]] - at] if len(right) else []
    nearest = float(np.min(reach)) if reach else float(curve.frequency_hz[-1] - curve.frequency_hz[0])
    return at, at - nearest, at + nearest


def _smoothed_power(curve: NoisyCurve) -> FloatArray:
    """Return |H|² (K,) averaged over as many lines as make 3 % of its noise at the maximum, a twentieth at most."""
    magnitude = np.abs(curve.value)
    peak = int(np.argmax(magnitude))
    noise = 2.0 * np.sqrt(np.trace(curve.covariance[peak]) / 2.0) / magnitude[peak]
    length = int(np.clip(np.ceil((noise / 0.03) ** 2), 1, max(1, len(magnitude) // 20)))
    window = np.ones(length)
    total = np.convolve(magnitude**2, window, mode="same")
    return np.asarray(total / np.convolve(np.ones(len(magnitude)), window, mode="same"))


def _parabola(curve: NoisyCurve, frequency_hz: float, reach_hz: float, fewest: int) -> _Parabola:
    """Fit 1/|H|² by a weighted parabola over f² to the lines within reach of a frequency, the nearest at least.

    Noise of variances σᵣ², σₜ² along and across H makes 1/|H|² too large by (3σᵣ² - σₜ²)/|H|⁴ on average.
    """
    distance = np.abs(curve.frequency_hz - frequency_hz)
    reach = max(reach_hz, float(np.sort(distance)[fewest - 1]))
    chosen: BoolArray = distance <= reach
    centre, scale = frequency_hz**2, 2.0 * frequency_hz * reach
    u = (curve.frequency_hz[chosen] ** 2 - centre) / scale
    powers = np.stack([np.ones(len(u)), u, u * u], axis=1)
    unit = curve.value / np.abs(curve.value)
    radial, tangential = (curve.variance_along(direction)[chosen] for direction in (unit, 1j * unit))
    smooth = np.abs(curve.value[chosen]) ** -2.0
    inverse = smooth - (3.0 * radial - tangential) * smooth**2
    for _ in range(2):
        weighted = powers / (smooth**3 * radial)[:, None]
        solve = np.linalg.solve(weighted.T @ powers, weighted.T)
        coefficients = solve @ inverse
        smooth = np.maximum(powers @ coefficients, 0.1 * smooth)
    by_line = np.zeros((3, len(distance)))
    by_line[:, chosen] = solve
    return _Parabola(centre, scale, coefficients, by_line)


def _top(curve: NoisyCurve, frequency_hz: float, reach_hz: float) -> Place:
    """Return the vertex of the parabola of the lines around a maximum."""
    parabola = _parabola(curve, frequency_hz, reach_hz, 3)
    c0, c1, c2 = parabola.coefficients
    u = -0.5 * c1 / c2 if c2 > 0.0 else np.nan
    inverse = c0 + 0.5 * c1 * u
    if not (abs(u) < 2.0 and inverse > 0.0):
        return _nowhere(curve)
    u_by_line = (c1 / c2 * parabola.by_line[2] - parabola.by_line[1]) / (2.0 * c2)
    frequency, by_line = parabola.frequency(u, u_by_line)
    return Place(frequency, float(inverse), by_line, np.array([1.0, u, u * u]) @ parabola.by_line)


def _crossing(curve: NoisyCurve, top: Place, level: float, frequency_hz: float, reach_hz: float) -> Place:
    """Return where the parabola of the lines around a flank has `level` times the 1/|H|² of the maximum."""
    if not curve.frequency_hz[0] <= frequency_hz <= curve.frequency_hz[-1]:
        return _nowhere(curve)
    parabola = _parabola(curve, frequency_hz, reach_hz, 4)
    c0, c1, c2 = parabola.coefficients
    target = level * top.inverse
    outward = np.sign(frequency_hz - top.frequency_hz)
    root = c1 * c1 - 4.0 * c2 * (c0 - target)
    if not root > 0.0:
        return _nowhere(curve)
    slope = outward * np.sqrt(root)
    u = 2.0 * (target - c0) / (slope + c1)
    if not abs(u) < 3.0:
        return _nowhere(curve)
    u_by_line = (level * top.inverse_by_line - np.array([1.0, u, u * u]) @ parabola.by_line) / slope
    frequency, by_line = parabola.frequency(u, u_by_line)
    return Place(frequency, target, by_line, level * top.inverse_by_line)


def uncertainties(curve: NoisyCurve, *by_inverse: FloatArray) -> FloatArray:
    """Return standard uncertainties (P,) of numbers with these gradients (K,) by 1/|H|² of every line."""
    square = np.abs(curve.value) ** 2
    gradient = np.stack(by_inverse) * (-2.0 * curve.value / square**2)
    return np.asarray(np.sqrt(np.diag(curve.propagated(gradient))))


def wandering_hz2(curve: NoisyCurve, top: Place, width_hz: float) -> float:
    """Return the variance of the line of the largest |H| that comes from noise: which line wins, all equally spaced.

    The lines above half power are independent and normal about |H| of the oscillator; each wins with the probability
    ∫ φₖ(a) Πⱼ Φⱼ(a) da.
    """
    from scipy.special import log_ndtr

    near = np.abs(curve.frequency_hz - top.frequency_hz) <= max(0.5 * width_hz, curve.spacing_hz)
    frequency = curve.frequency_hz[near]
    detuned = 2.0 * (frequency - top.frequency_hz) / width_hz
    expected = 1.0 / np.sqrt(top.inverse * (1.0 + detuned**2))
    u = np.sqrt(curve.variance_along(curve.value / np.abs(curve.value)))[near]
    level = np.linspace(expected.max() - 4.0 * u.max(), expected.max() + 6.0 * u.max(), 400)
    score = (level[:, None] - expected) / u
    log_below = log_ndtr(score)
    wins = np.exp(log_below.sum(axis=1, keepdims=True) - log_below - 0.5 * score**2) / u
    chance = wins.sum(axis=0) / wins.sum()
    return float(chance @ (frequency - chance @ frequency) ** 2)
