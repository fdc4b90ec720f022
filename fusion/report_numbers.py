"""How the report prints numbers: rounded to their expanded uncertainty, with powers of ten and units, as HTML."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from fusion.polar import DASH, Polar, rounded, typeset

ComplexArray = NDArray[np.complex128]
LARGEST_PHASE_U = 1.0
"""Expanded uncertainty in rad above which a phase is printed as not determined."""


def measured(value: float, expanded: float, unit: str = "") -> Markup:
    """Value and expanded uncertainty as HTML: `(2.0012 ± 0.0013) × 10⁻⁷ V/N`."""
    text = rounded(value, expanded)
    body = text.value if text.expanded == DASH else f"{text.value} ± {text.expanded}"
    bracketed = f"({body})" if text.expanded != DASH and (unit or text.exponent) else body
    minus = "\N{MINUS SIGN}" if text.exponent < 0 else ""
    power = Markup(" × 10<sup>{}{}</sup>").format(minus, abs(text.exponent)) if text.exponent else Markup("")
    return Markup("{}{}{}").format(bracketed, power, f" {typeset(unit)}" if unit else "")


def fixed(value: float, expanded: float, exponent: int) -> Markup:
    """Value and expanded uncertainty in units of a power of ten that stands elsewhere."""
    text = rounded(value, expanded, exponent)
    return Markup(text.value if text.expanded == DASH else f"{text.value} ± {text.expanded}")


def times_ten(exponent: int, unit: str) -> Markup:
    """Unit with a power of ten before it."""
    minus = "\N{MINUS SIGN}" if exponent < 0 else ""
    return (
        Markup("10<sup>{}{}</sup> {}").format(minus, abs(exponent), typeset(unit))
        if exponent
        else Markup(typeset(unit))
    )


def phase(element: Polar) -> Markup:
    """Phase with U, or a dash where it is not determined."""
    expanded = 2.0 * element.u_phase_rad
    return measured(element.phase_rad, expanded) if not expanded > LARGEST_PHASE_U else Markup(DASH)


def common_exponent(values: ComplexArray) -> int:
    """Power of ten of the largest finite value, none where it is readable as it is."""
    sizes = np.abs(values[np.isfinite(values)])
    return rounded(float(sizes.max()), 0.0).exponent if sizes.size else 0


def short(value: float) -> Markup:
    """Two significant digits, with a power of ten where that is shorter."""
    if not np.isfinite(value):
        return Markup(DASH)
    exponent = rounded(value, 0.0).exponent
    return (
        Markup("{:.2g} × {}").format(value / 10.0**exponent, times_ten(exponent, ""))
        if exponent
        else Markup(f"{value:.2g}")
    )


def number(value: float | None) -> str:
    """Three significant digits, a dash for what is unknown."""
    return DASH if value is None or not np.isfinite(value) else f"{value:.3g}"


def small(value: float) -> str:
    """Two significant digits of an uncertainty; what is far below the last place of interest is only bounded."""
    return f"{value:#.2g}".removesuffix(".") if value >= 1e-3 else "< 0.001"


def degrees_of_freedom(value: float) -> str:
    """Degrees of freedom as a whole number."""
    return f"{value:.0f}" if np.isfinite(value) else "∞"


def microseconds(value_s: float | None, u_s: float | None) -> str:
    """A duration with U, a dash where it is not known."""
    return DASH if value_s is None or u_s is None else measured(1e6 * value_s, 2e6 * u_s)
