"""Readings of one resonance from a transfer function, without a model fit: maximum, widths, Nyquist circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.resonance.circle import fit_circle
from shaker.models.resonance.noisy_curve import NoisyCurve
from shaker.models.resonance.peak_shape import LEVELS, Place, Width, read_shape, uncertainties, wandering_hz2

_FEWEST_LINES = 5
_RESOLVED_LINES = 4.0  # in the half-power width, below which a width read from the lines is not to be trusted


@dataclass(frozen=True)
class PeakReading:
    """One reading: frequency, width and damping ratio with standard uncertainties; NaN for what it does not tell.

    `note`: what the reader of these numbers has to know, empty for most.
    """

    method: str
    frequency_hz: float
    u_frequency_hz: float
    width_hz: float
    u_width_hz: float
    damping_ratio: float
    u_damping_ratio: float
    note: str = ""

    @property
    def quality(self) -> float:
        """Quality factor 1/(2ζ)."""
        return 0.5 / self.damping_ratio


@dataclass(frozen=True)
class PeakReadings:
    """All readings of one resonance of a base-excited mass.

    `maximum_bin`: the line of the largest |H|; `maximum`: the top between the lines; both are the frequency of the
    maximum, which lies ζ²f₀ below f₀. `half_power`: f₀ and ζ from the two frequencies where |H| is 1/√2 of its maximum.
    `half_amplitude`: f₀ = frequency of the maximum and ζ = width/(2f₀) with the width at half the maximum, as equation
    10 of Nitsche et al. (J. Sens. Sens. Syst. 7, 2018) words it: √3 times the damping there is. `circle`: f₀ and ζ from
    the angles of the Nyquist circle. `lines_in_width`: half-power width over line spacing.
    """

    maximum_bin: PeakReading
    maximum: PeakReading
    half_power: PeakReading
    half_amplitude: PeakReading
    circle: PeakReading
    lines_in_width: float

    @property
    def all(self) -> tuple[PeakReading, ...]:
        """Return the readings in the order of their description."""
        return self.maximum_bin, self.maximum, self.half_power, self.half_amplitude, self.circle


def peak_readings(
    frequency_hz: FloatArray,
    value: ComplexArray,
    covariance: FloatArray,
    *,
    line_correlation: ComplexArray | None = None,
) -> PeakReadings:
    """Read the highest resonance of H = motion of a mass over that of its base.

    `value` (K,) at ascending `frequency_hz` (K,), `covariance` (K, 2, 2) of [Re, Im], `line_correlation` (D,) as in
    `TransferFunction`. All but `maximum_bin` are free of bias by the line spacing.
    """
    curve = NoisyCurve(frequency_hz, np.asarray(value, dtype=np.complex128), covariance, line_correlation)
    if len(curve.frequency_hz) < _FEWEST_LINES:
        raise ValueError(f"frequency_hz: expected at least {_FEWEST_LINES} lines, found {len(curve.frequency_hz)}")
    top, crossings = read_shape(curve)
    low, high = crossings["half_power"]
    lines = (high.frequency_hz - low.frequency_hz) / curve.spacing_hz
    half_power = _half_power(curve, top, low, high, _width_note(lines))
    return PeakReadings(
        maximum_bin=_bin(curve, top, high.frequency_hz - low.frequency_hz),
        maximum=_maximum(curve, top),
        half_power=half_power,
        half_amplitude=_half_amplitude(curve, top, *crossings["half_amplitude"], _width_note(lines)),
        circle=_circle(curve, half_power),
        lines_in_width=float(lines),
    )


def stiffness(frequency_hz: float, mass: float) -> float:
    """Return k = (2πf₀)²m, N/m of kg or N·m/rad of kg·m² (Nitsche et al. 2018, equation 9)."""
    return float((2.0 * np.pi * frequency_hz) ** 2 * mass)


def damping_from_width(width_hz: float, mass: float, width: Width = "half_power") -> float:
    """Return b = √(km)·Δf/f₀ = 2πmΔf, kg/s (Nitsche et al. 2018, equation 10, which holds for the half-power width).

    The width at half the amplitude is √3 times as large and is divided by it.
    """
    return float(2.0 * np.pi * mass * width_hz / np.sqrt(LEVELS[width] - 1.0))


def width_from_damping(damping: float, mass: float, width: Width = "half_power") -> float:
    """Return the width Δf in Hz that a damping b shows: b/(2πm), times √3 at half the amplitude."""
    return float(damping * np.sqrt(LEVELS[width] - 1.0) / (2.0 * np.pi * mass))


def transmissibility_levels(damping_ratio: float, level: float = 2.0) -> tuple[float, float, float]:
    """Return r = f/f₀ of the maximum of |(1 + 2jζr)/(1 - r² + 2jζr)|, and below and above it where 1/|H|² is `level`
    times as large, zero where that is nowhere: r² solves y² - (2 - 4ζ² + 4ζ²c)y + 1 - c = 0, c = level/|H|²max.
    """
    square = 4.0 * damping_ratio**2
    highest = 2.0 / (np.sqrt(1.0 + 2.0 * square) + 1.0)
    at_level = level * ((1.0 - highest) ** 2 + square * highest) / (1.0 + square * highest)
    middle = 1.0 - 0.5 * square * (1.0 - at_level)
    root = np.sqrt(middle**2 - 1.0 + at_level)
    return float(np.sqrt(highest)), float(np.sqrt(max(0.0, middle - root))), float(np.sqrt(middle + root))


def _width_note(lines: float) -> str:
    """Return the note on a width that the line spacing does not resolve."""
    if not np.isfinite(lines) or lines >= _RESOLVED_LINES:
        return ""
    few = f"{lines:.1f} lines in the half-power width, fewer than {_RESOLVED_LINES:.0f}"
    return f"{few}: between them the curve is taken to be that of one oscillator"


def _bin(curve: NoisyCurve, top: Place, width_hz: float) -> PeakReading:
    """Return the line of the maximum, uncertain by half a spacing and by which line noise lets win."""
    frequency = float(curve.frequency_hz[np.argmax(np.abs(curve.value))])
    noise = wandering_hz2(curve, top, width_hz) if np.isfinite(width_hz) else np.nan
    return _without_width("maximum_bin", frequency, float(np.sqrt(curve.spacing_hz**2 / 12.0 + noise)), "")


def _maximum(curve: NoisyCurve, top: Place) -> PeakReading:
    """Return the vertex between the lines."""
    note = "" if np.isfinite(top.frequency_hz) else "no maximum between the lines of this band"
    u = float(uncertainties(curve, top.by_line)[0])
    return _without_width("maximum", top.frequency_hz, u, note)


def _without_width(method: str, frequency_hz: float, u_hz: float, note: str) -> PeakReading:
    """Return a reading of the frequency alone."""
    return PeakReading(method, frequency_hz, u_hz, np.nan, np.nan, np.nan, np.nan, note)


def _half_power(curve: NoisyCurve, top: Place, low: Place, high: Place, note: str) -> PeakReading:
    """Return the f₀ and ζ of which the oscillator has its maximum and its half-power points where they were read."""
    width = high.frequency_hz - low.frequency_hz
    if not np.isfinite(width):
        return _unread("half_power")
    zeta = 0.5 * width / top.frequency_hz
    for _ in range(20):
        highest, below, above = transmissibility_levels(zeta)
        zeta *= width / top.frequency_hz * highest / (above - below)
    middle = 1.0 / np.sqrt(below * above)
    f0 = float(np.sqrt(low.frequency_hz * high.frequency_hz) * middle)
    by_width = high.by_line - low.by_line
    by_f0 = 0.5 * f0 * (low.by_line / low.frequency_hz + high.by_line / high.frequency_hz)
    by_zeta = zeta * (by_width / width - top.by_line / top.frequency_hz)
    u = uncertainties(curve, by_f0, by_width, by_zeta)
    return PeakReading("half_power", f0, float(u[0]), width, float(u[1]), float(zeta), float(u[2]), note)


def _half_amplitude(curve: NoisyCurve, top: Place, low: Place, high: Place, note: str) -> PeakReading:
    """Return equation 10 with the width at half the maximum, without the √3 that this width is wider."""
    width = high.frequency_hz - low.frequency_hz
    if not np.isfinite(width):
        return _unread("half_amplitude")
    by_width = high.by_line - low.by_line
    zeta = 0.5 * width / top.frequency_hz
    by_zeta = zeta * (by_width / width - top.by_line / top.frequency_hz)
    u = uncertainties(curve, top.by_line, by_width, by_zeta)
    told = "damping overstated by √3" + (f"; {note}" if note else "")
    return PeakReading(
        "half_amplitude", top.frequency_hz, float(u[0]), width, float(u[1]), float(zeta), float(u[2]), told
    )


def _unread(method: str) -> PeakReading:
    """Return the reading of a peak that does not fall far enough inside the band."""
    level = "1/√2" if method == "half_power" else "1/2"
    nothing = (np.nan,) * 6
    return PeakReading(method, *nothing, f"|H| does not fall to {level} of its maximum on both sides inside the band")


def _circle(curve: NoisyCurve, start: PeakReading) -> PeakReading:
    """Return f₀ and ζ of the angles of the Nyquist circle, started where the half-power reading stands."""
    fit = fit_circle(curve, start.frequency_hz, start.damping_ratio) if np.isfinite(start.damping_ratio) else None
    if fit is None:
        return PeakReading("circle", *(np.nan,) * 6, "no circle found in the complex plane")
    f0, zeta = fit.frequency_hz, fit.damping_ratio
    by_width = np.array([2.0 * zeta, 2.0 * f0])
    u_f0, u_zeta = np.sqrt(np.diag(fit.covariance)).tolist()
    u_width = float(np.sqrt(by_width @ fit.covariance @ by_width))
    return PeakReading("circle", f0, u_f0, 2.0 * zeta * f0, u_width, zeta, u_zeta)
