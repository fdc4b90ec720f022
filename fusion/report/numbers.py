"""Numbers and headlines as reports print them."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, rounded, typeset
from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Polar, Region, region_factor
from fusion.recording.manifest import Rig
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import driven_component as driven_load
from shaker.arrays import ComplexArray

# How the report prints numbers: rounded to their expanded uncertainty, with powers of ten and units, as HTML.


LARGEST_PHASE_U = 1.0
"""Expanded uncertainty in rad above which a phase is printed as not determined."""
LARGEST_DOF = 1000
WEAK = "not distinguishable from 0"


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
    expanded = element.expanded_phase_rad
    determined = expanded <= LARGEST_PHASE_U and not element.region.holds_zero
    return measured(element.phase_rad, expanded) if determined else Markup(DASH)


def polar_cells(element: Polar, exponent: int | None = None) -> tuple[str, str, str]:
    """Magnitude and phase with U, and k; of a value that may be zero the half-axes of its region, and their factor.

    `exponent`: power of ten that stands elsewhere, by default with the magnitude.
    """
    region = element.region
    if region.holds_zero:
        return half_axes(region, exponent), WEAK, factor(region_factor(element.dof))
    size, expanded = element.magnitude, element.expanded_magnitude
    cell = measured(size, expanded) if exponent is None else fixed(size, expanded, exponent)
    return cell, phase(element), factor(element.k)


def half_axes(region: Region, exponent: int | None = None) -> Markup:
    """Half-axes of a region, to two digits of the larger one."""
    if not np.isfinite(region.half_axes[0]):
        return Markup(DASH)
    large, small_axis = region.half_axes
    first = rounded(large, large, exponent)
    second = rounded(small_axis, large, first.exponent)
    power = times_ten(first.exponent, "") if exponent is None and first.exponent else Markup("")
    return Markup("region ± {}, ± {}{}").format(
        first.value, second.value, Markup(" × {}").format(power) if power else ""
    )


def factor(value: float) -> str:
    """A coverage factor."""
    return f"{value:.2f}" if np.isfinite(value) else DASH


def common_exponent(values: ComplexArray) -> int:
    """Power of ten of the largest finite value, none where it is readable as it is."""
    sizes = np.abs(values[np.isfinite(values)])
    return rounded(float(sizes.max()), 0.0).exponent if sizes.size else 0


def short(value: float) -> Markup:
    """Two significant digits, with a power of ten where that is shorter."""
    if not np.isfinite(value):
        return Markup(DASH)
    value = float(f"{value:.1e}")
    exponent = rounded(value, 0.0).exponent
    text = f"{value / 10.0**exponent:.2g}" if exponent else f"{value:.6g}"
    text = text.replace("-", "\N{MINUS SIGN}")
    return Markup("{} × {}").format(text, times_ten(exponent, "").strip()) if exponent else Markup(text)


def number(value: float | None) -> str:
    """Three significant digits, a dash for what is unknown."""
    return DASH if value is None or not np.isfinite(value) else f"{value:.3g}"


def small(value: float) -> str:
    """Two significant digits of an uncertainty; what is far below the last place of interest is only bounded."""
    return f"{value:#.2g}".removesuffix(".") if value >= 1e-3 else "< 0.001"


def degrees_of_freedom(value: float) -> str:
    """Degrees of freedom as a whole number; thousands of them are as good as any number."""
    return f"{value:.0f}" if value <= LARGEST_DOF else ("∞" if np.isinf(value) else f"> {LARGEST_DOF}")


def microseconds(value_s: float | None, u_s: float | None) -> str:
    """A duration with U, a dash where it is not known."""
    return DASH if value_s is None or u_s is None else measured(1e6 * value_s, 2e6 * u_s)


def plain(value: float, expanded: float, unit: str = "") -> str:
    """Value with U and unit for the terminal, without a power of ten: `(2.0012 ± 0.0013) V/N`."""
    text, tail = rounded(value, expanded, 0), f" {typeset(unit)}" if unit else ""
    if text.expanded == DASH:
        return f"{text.value}{tail}"
    return f"({text.value} ± {text.expanded}){tail}" if unit else f"{text.value} ± {text.expanded}"


def signed(value: float, form: str = ".2f") -> str:
    """A number with a typographic minus sign, a dash for what is unknown; no sign before zero."""
    text = format(value + 0.0, form) if np.isfinite(value) else DASH
    return text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "\N{MINUS SIGN}")


def capital(text: str) -> str:
    """Text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def subject_of(rig: Rig) -> list[tuple[str, str]]:
    """Rig and sensor, as every page names them."""
    sensor = [] if rig.sensor is None else [("Sensor", f"{rig.sensor.name} {rig.sensor.serial}".strip())]
    return [("Rig", rig.name), *sensor]


# What a reader wants first: the driven component, the output that belongs to it, and the strongest line.


def driven_component(evaluation: Evaluation) -> int:
    """Place of the driven component among x, y, z, rx, ry, rz.

    The largest element of the excitation's direction, forces and moments in shares of the rated loads; where none is
    stated, the translation that moves most.
    """
    direction, sensor = evaluation.manifest.excitation.direction, evaluation.manifest.rig.sensor
    if direction is not None:
        return driven_load(direction, None if sensor is None else sensor.capacity)
    sizes = [np.abs(result.phasors.value[:, :3]) for result in evaluation.accelerations]
    moves = np.nan_to_num(np.concatenate(sizes)) if sizes else np.zeros((1, 3))
    return int(np.argmax(moves.max(axis=0)))


def driven_channel(evaluation: Evaluation) -> int:
    """Place of the sensor output that belongs to the driven component.

    The largest static sensitivity decides where one is given, else the largest ratio at the main line.
    """
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    component = driven_component(evaluation)
    static = static_sensitivity(evaluation)
    sizes = np.abs(found.value[main_line(evaluation), :, component] if static is None else static[:, component])
    usable = np.where(found.observed[:, component] & np.isfinite(sizes), sizes, -1.0)
    return int(np.argmax(usable))


def driven_element(evaluation: Evaluation) -> int:
    """Place of the driven channel and component among the elements of the sensitivity."""
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    return found.elements.index((driven_channel(evaluation), driven_component(evaluation)))


def main_line(evaluation: Evaluation) -> int:
    """Place of the strongest line: the largest driven fused acceleration of the load, else the first line."""
    result = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    if result is None:
        return 0
    driven = np.abs(result.phasors.value[:, driven_component(evaluation)])
    return int(np.nanargmax(driven)) if np.isfinite(driven).any() else 0


def acceleration(evaluation: Evaluation, body: str, source: str) -> Acceleration | None:
    """Acceleration of one body from one source, None where there is none."""
    for result in evaluation.accelerations:
        if (result.body, result.source) == (body, source):
            return result
    return None


def bodies(evaluation: Evaluation) -> list[str]:
    """Bodies whose acceleration was determined, in order of appearance."""
    return list(dict.fromkeys(result.body for result in evaluation.accelerations))


def by_source(evaluation: Evaluation, body: str) -> list[Acceleration]:
    """Results of one body, fused first; only the fused one where it rests on a single instrument."""
    results = [result for result in evaluation.accelerations if result.body == body]
    fused = acceleration(evaluation, body, "fused")
    return [fused] if fused is not None and len(fused.instruments) < 2 and len(results) < 3 else results


def static_sensitivity(evaluation: Evaluation) -> np.typing.NDArray[np.float64] | None:
    """Static sensitivity (C, 6) of the outputs evaluated, None where the rig states none."""
    sensor, found = evaluation.manifest.rig.sensor, evaluation.sensitivity
    if sensor is None or found is None or sensor.static_sensitivity is None:
        return None
    rows = [list(sensor.channels).index(name) for name in found.channels]
    return np.asarray(sensor.static_sensitivity, dtype=np.float64)[rows]


def static_value(evaluation: Evaluation, channel: int, component: int) -> float | None:
    """One element of the static sensitivity, None where it is not stated or zero."""
    static = static_sensitivity(evaluation)
    return float(static[channel, component]) if static is not None and static[channel, component] != 0.0 else None
