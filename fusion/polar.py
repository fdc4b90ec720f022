"""Complex numbers as magnitude and phase with uncertainty, and how numbers and units are printed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.coverage import Region, coverage_factor, region
from shaker._checks import FloatArray

UNIFORM_PHASE_U = float(np.pi / np.sqrt(3.0))
LARGEST_PLAIN = 1e5
SMALLEST_PLAIN = 1e-2
DASH = "–"
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
PLAIN_TO_TYPESET = (("^2", "²"), ("N.m", "N·m"))


@dataclass(frozen=True)
class Polar:
    """A complex value as magnitude and phase in (-pi, pi] and as parts, with standard uncertainties (k = 1).

    `r`: correlation of real and imaginary part; `dof`: effective degrees of freedom, which decide the coverage factor.
    """

    magnitude: float
    phase_rad: float
    u_magnitude: float
    u_phase_rad: float
    re: float
    im: float
    u_re: float
    u_im: float
    r: float
    dof: float = np.inf

    @property
    def k(self) -> float:
        """Return the coverage factor of magnitude and phase for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded_magnitude(self) -> float:
        """Return U of the magnitude, k·u."""
        return self.k * self.u_magnitude

    @property
    def expanded_phase_rad(self) -> float:
        """Return U of the phase, k·u."""
        return self.k * self.u_phase_rad

    @property
    def region(self) -> Region:
        """Return the 95 % region of the complex value."""
        mixed = self.r * self.u_re * self.u_im
        covariance = np.array([[self.u_re**2, mixed], [mixed, self.u_im**2]])
        return region(complex(self.re, self.im), covariance, self.dof)


def polar(value: complex, covariance: FloatArray, dof: float = np.inf) -> Polar:
    """First-order propagation of the covariance (2, 2) of (Re, Im) of `value` to magnitude and phase.

    u(|X|)^2 = e^T V e with e = (Re, Im)/|X|, u(arg X)^2 = n^T V n / |X|^2 with n = (-Im, Re)/|X| (JCGM 102, 9.4).
    Where |X| is of the order of its uncertainty the expansion fails: u(arg X) is capped at pi/sqrt(3), the standard
    deviation of a phase of which nothing is known, and at X = 0 u(|X|) is that of the mean direction.
    """
    re, im = float(value.real), float(value.imag)
    magnitude = float(np.hypot(re, im))
    u_re, u_im = (float(u) for u in np.sqrt(np.diag(covariance)))
    r = float(covariance[0, 1]) / (u_re * u_im) if u_re * u_im > 0.0 else 0.0
    u_magnitude, u_phase = _first_order(re, im, magnitude, covariance)
    return Polar(magnitude, _phase(re, im), u_magnitude, u_phase, re, im, u_re, u_im, r, dof)


def element_covariance(covariance: FloatArray, element: int) -> FloatArray:
    """Covariance (2, 2) of (Re, Im) of one element of a real-stacked covariance (2M, 2M)."""
    pair = [element, element + covariance.shape[-1] // 2]
    return covariance[np.ix_(pair, pair)]


def _phase(re: float, im: float) -> float:
    """Phase in (-pi, pi]; an imaginary part of -0 does not turn pi into -pi."""
    return float(np.arctan2(im + 0.0, re))


def _first_order(re: float, im: float, magnitude: float, covariance: FloatArray) -> tuple[float, float]:
    """Standard uncertainties of magnitude and phase."""
    if magnitude == 0.0:
        return float(np.sqrt(np.trace(covariance) / 2.0)), UNIFORM_PHASE_U
    if np.isnan(covariance).any():
        return float("nan"), float("nan")
    along = np.array([re, im]) / magnitude
    across = np.array([-im, re]) / magnitude
    variance, turned = float(along @ covariance @ along), float(across @ covariance @ across)
    return float(np.sqrt(max(variance, 0.0))), min(float(np.sqrt(max(turned, 0.0))) / magnitude, UNIFORM_PHASE_U)


class Rounded(NamedTuple):
    """A value and its expanded uncertainty as decimal texts, both times ten to the power `exponent`."""

    value: str
    expanded: str
    exponent: int


def rounded(value: float, expanded: float, exponent: int | None = None) -> Rounded:
    """Value rounded to the second significant digit of its expanded uncertainty (GUM 7.2.6).

    `exponent`: power of ten to take off, by default none for sizes from 0.01 to 100 000 and else that of the larger of
    the two. Without a usable uncertainty the value has five significant digits and the uncertainty is a dash.
    """
    if not np.isfinite(value):
        return Rounded(DASH, DASH, 0)
    usable = bool(np.isfinite(expanded)) and expanded > 0.0
    power = _power(max(abs(value), expanded if usable else 0.0)) if exponent is None else exponent
    scale = 10.0**-power
    if not usable:
        return Rounded(_signed(f"{value * scale:.5g}"), DASH, power)
    decimals = _decimals(expanded * scale)
    return Rounded(_signed(_places(value * scale, decimals)), _places(expanded * scale, decimals), power)


def _places(value: float, decimals: int) -> str:
    """Decimal text; a negative number of places rounds to tens or hundreds."""
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def _decimals(expanded: float) -> int:
    """Decimal places that show two significant digits."""
    return 1 - int(f"{expanded:.1e}".partition("e")[2])


def _power(size: float) -> int:
    """Power of ten that leaves one digit before the point, none where the number is readable as it is."""
    if size == 0.0 or SMALLEST_PLAIN <= size < LARGEST_PLAIN:
        return 0
    return int(np.floor(np.log10(size)))


def _signed(text: str) -> str:
    """Typographic minus sign; no sign before zero."""
    if text.startswith("-") and not text.strip("-0."):
        return text[1:]
    return text.replace("-", "\N{MINUS SIGN}")


def prefix(values: FloatArray, *, coarse: bool = False) -> tuple[float, str]:
    """Factor and SI prefix that bring the largest magnitude of `values` to a readable size (`coarse`: at least 1)."""
    finite = np.abs(values[np.isfinite(values)])
    largest = float(finite.max()) if finite.size else 1.0
    threshold = 1.0 if coarse else 0.5
    for factor, letter in PREFIXES:
        if largest >= threshold * factor:
            return factor, letter
    return PREFIXES[-1]


def typeset(unit: str) -> str:
    """ASCII unit of the result files as it is printed: `m/s^2` becomes `m/s²`."""
    for plain, nice in PLAIN_TO_TYPESET:
        unit = unit.replace(plain, nice)
    return unit
