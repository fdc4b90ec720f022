"""Frequency response of a measuring chain: from tables or poles, combined, and corrected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, TypeVar

import numpy as np

from shaker.labels import MOTION_UNITS
from shaker.lti.system import pair_conjugates
from shaker.sine.phasor import derivative_factor
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray

Numbers = TypeVar("Numbers", FloatArray, ComplexArray)
FilterKind = Literal["butterworth", "bessel", "resonance"]
PassBand = Literal["lowpass", "highpass"]
QUANTITIES = ("displacement", "velocity", "acceleration")
"""Names of the quantities that differentiation turns into each other, by the order of the derivative."""
FEWEST_TO_HALVE = 6
"""Points of a table from which on halves and quarters of it show how the error of interpolation falls with the step."""
MIN_ERROR_SHARE = 1.0 / 8.0
"""Twice the share by which halved steps lessen the error of a cubic spline through a smooth function."""


@dataclass(frozen=True)
class ChainResponse(Arrays, shapes="value K; causes E; errors E K"):
    """Response of a chain at K lines: true phasor = measured phasor / `value`.

    Attributes
    ----------
    value : (K,), complex response.
    errors : (E, K), complex relative deviation of `value` for one standard deviation of each of E independent causes,
        at all lines at once; real part: magnitude, imaginary part: phase in rad.
    causes : E names.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import ChainResponse
    >>> amplifier = ChainResponse(np.array([0.99 - 0.1j]), np.array([[1e-3 + 2e-3j]]), ("calibration",))
    >>> amplifier.u_magnitude, amplifier.u_phase_rad
    (array([0.001]), array([0.002]))
    """

    value: ComplexArray
    errors: ComplexArray
    causes: tuple[str, ...]

    @property
    def u_magnitude(self) -> FloatArray:
        """Relative standard uncertainty of the magnitude, (K,)."""
        return np.asarray(np.sqrt(np.sum(self.errors.real**2, axis=0)))

    @property
    def u_phase_rad(self) -> FloatArray:
        """Standard uncertainty of the phase in rad, (K,)."""
        return np.asarray(np.sqrt(np.sum(self.errors.imag**2, axis=0)))


@dataclass(frozen=True)
class ResponseTable(Arrays, shapes="frequency_hz N; magnitude N; phase_rad N; u_magnitude N; u_phase_rad N"):
    """A calibrated response at N ascending frequencies: `magnitude` > 0 and `phase_rad`, also whole turns."""

    frequency_hz: FloatArray
    magnitude: FloatArray
    phase_rad: FloatArray
    u_magnitude: FloatArray
    u_phase_rad: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.frequency_hz) == 0 or np.any(np.diff(self.frequency_hz) <= 0.0):
            raise ValueError("frequency_hz: expected ascending frequencies, found values that do not ascend")
        if np.any(self.magnitude <= 0.0):
            raise ValueError(f"magnitude: expected positive values, found {self.magnitude.min():g}")


@dataclass(frozen=True)
class PoleModel(Arrays, shapes="zeros Z; poles P"):
    """Response of zeros, poles, gain and delay.

    H(jω) = k·Π(jω − z) / Π(jω − p)·exp(−jωτ), z and p in rad/s, τ = `delay_s`. `gain` is k where `gain_hz` is None,
    else the value (with sign) of |H| at this frequency.
    """

    zeros: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    poles: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    gain: float = 1.0
    gain_hz: float | None = None
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("zeros", "poles"):
            pair_conjugates(getattr(self, name), name)
        if np.any(self.poles.real > 0.0):
            raise ValueError(f"poles: expected real parts of at most 0, found {self.poles.real.max():g}")
        if self.gain == 0.0:
            raise ValueError("gain: expected a number other than 0, found 0")


def table_response(table: ResponseTable, frequency_hz: FloatArray) -> ChainResponse:
    """Interpolate a response table to frequencies (K,) in Hz within its range.

    Cubic splines (not-a-knot) interpolate ln|H| and the phase minus the mean delay, over f or ln f. The better scale is
    that which predicts the table's points better from their neighbours. The table's standard uncertainties, linear in
    between, are errors common to all lines. The interpolation error is zero at the table's points. Between them it is
    the change without every other point (odd or even ones, whichever is larger), reduced as far as the table shows that
    narrower steps help; see `_interpolation_error`.
    """
    low, high = table.frequency_hz[0], table.frequency_hz[-1]
    outside = [f for f in frequency_hz if not low <= f <= high]
    if outside:
        raise ValueError(f"frequency_hz: expected {low:g} to {high:g} Hz, the range of the table, found {outside[0]:g}")
    phase = np.unwrap(table.phase_rad)
    knots, positions = table.frequency_hz, np.asarray(frequency_hz, dtype=np.float64)
    centred = knots - knots.mean()
    spread = float(centred @ centred)
    delay = -float(centred @ phase) / (2.0 * np.pi * spread) if spread > 0.0 else 0.0
    logarithm = np.log(table.magnitude) + 1j * (phase + 2.0 * np.pi * knots * delay)
    if (
        knots[0] > 0.0
        and len(knots) >= 4
        and _prediction_error(np.log(knots), logarithm) < _prediction_error(knots, logarithm)
    ):
        knots, positions = np.log(knots), np.log(positions)
    fine = cubic_spline(knots, logarithm, positions)
    change = _interpolation_error(knots, logarithm, positions)
    value = np.asarray(np.exp(fine - 2j * np.pi * np.asarray(frequency_hz) * delay), dtype=np.complex128)
    u_magnitude = np.interp(positions, knots, table.u_magnitude / table.magnitude)
    u_phase = np.interp(positions, knots, table.u_phase_rad)
    errors = np.stack([u_magnitude + 0j, 1j * u_phase, change])
    return ChainResponse(value, errors, ("magnitude of the table", "phase of the table", "interpolation"))


def pole_response(
    frequency_hz: FloatArray, model: PoleModel, *, u_gain: float = 0.0, u_frequency: float = 0.0, u_delay_s: float = 0.0
) -> ChainResponse:
    """Return the response of a pole model at frequencies (K,) in Hz.

    `u_gain` is relative. `u_frequency` is relative, of all zeros and poles together: a corner frequency that is off by
    1 % moves every pole of its filter by 1 %. `u_delay_s` is in s. With s = jω, ∂ln H/∂ln p = p/(s − p), ∂ln H/∂ln z =
    −z/(s − z) and ∂ln H/∂τ = −s. Where the gain is stated at a frequency, its magnitude there is constant.
    """
    s = derivative_factor(frequency_hz, 1)
    gain, fixed_slope = model.gain, 0.0
    if model.gain_hz is not None:
        at = derivative_factor(np.array([model.gain_hz]), 1)
        gain = model.gain / _check_finite(abs(_product(at, model)), [model.gain_hz])[0]
        fixed_slope = float(_frequency_slope(at, model)[0].real)
    shape = _check_finite(_product(s, model), frequency_hz)
    errors = np.stack([u_gain + 0.0 * s, u_frequency * (_frequency_slope(s, model) - fixed_slope), -s * u_delay_s])
    value = np.asarray(gain * shape * np.exp(-s * model.delay_s), dtype=np.complex128)
    return ChainResponse(value, np.asarray(errors), ("gain", "frequency", "delay"))


def filter_poles(
    kind: FilterKind, order: int, corner_hz: float, band: PassBand = "lowpass", damping: float = np.sqrt(0.5)
) -> PoleModel:
    """Return a standard analogue filter of pass-band gain 1.

    Its response at `corner_hz` is −3 dB. `butterworth`, `bessel` (normalised to −3 dB, not to its delay): of an order
    of 1 to 12 (poles from scipy.signal). `resonance`: one pair of poles at |p| = 2π·corner_hz with a `damping` ratio
    (order 2; −3 dB only at 0.707), the response of an accelerometer below and at its mounted resonance.
    """
    if not 1 <= order <= 12:
        raise ValueError(f"order: expected 1 to 12, found {order}")
    if not corner_hz > 0.0:
        raise ValueError(f"corner_hz: expected a frequency above 0 Hz, found {corner_hz:g}")
    corner = 2.0 * np.pi * corner_hz
    if kind == "resonance":  # one pair of poles, or two real ones where damped above 1
        if order != 2:
            raise ValueError(f"order: expected 2 for a resonance, found {order}")
        if not damping > 0.0:
            raise ValueError(f"damping: expected a ratio above 0, found {damping:g}")
        turn = np.sqrt(complex(damping**2 - 1.0))
        poles, gain = corner * np.array([-damping + turn, -damping - turn]), 1.0
        zeros = np.zeros(2 if band == "highpass" else 0)
    else:
        from scipy import signal

        design = signal.butter if kind == "butterworth" else partial(signal.bessel, norm="mag")
        zeros, poles, gain = design(order, corner, band, analog=True, output="zpk")
    # The gain is that of the pass band: at 0 Hz, or (k = 1) at the highest frequencies.
    gain_statement = (1.0, 0.0) if band == "lowpass" else (float(gain), None)
    return PoleModel(np.asarray(zeros, dtype=np.complex128), np.asarray(poles, dtype=np.complex128), *gain_statement)


USUAL_FILTERS: tuple[tuple[FilterKind, int], ...] = tuple(
    (kind, order) for kind in ("bessel", "butterworth") for order in range(1, 9)
)
"""Filters that amplifiers and recorders usually have."""


def filters_of_delay(frequency_hz: FloatArray, delay_s: float) -> ComplexArray:
    """Return responses (F, K) of usual low-pass filters of one delay.

    The delay at low frequencies is removed. Filters of poles p have a delay of Σ Re(-1/p) at 0 Hz, which determines
    their corner. 1 means a pure delay.

    >>> from shaker.frf.chain import filters_of_delay
    >>> import numpy as np
    >>> float(np.abs(filters_of_delay(np.array([319.0]), 168e-6)).min().round(3))  # of a first order
    0.948
    """
    s, found = derivative_factor(frequency_hz, 1), []
    for kind, order in USUAL_FILTERS:
        model = filter_poles(kind, order, 1.0)
        scale = delay_s / float(np.sum(-1.0 / model.poles).real)
        found.append(_product(scale * s, model) / _product(0.0 * s, model) * np.exp(s * delay_s))
    return np.asarray(found)


def cascade_responses(responses: Sequence[ChainResponse]) -> ChainResponse:
    """Return the response of elements in series; their errors are independent of each other."""
    value = np.prod([response.value for response in responses], axis=0)
    errors = np.concatenate([response.errors for response in responses])
    return ChainResponse(value, errors, tuple(cause for response in responses for cause in response.causes))


def common_covariance(value: ComplexArray, errors: ComplexArray) -> FloatArray:
    """Return the covariance (K, 2C, 2C) of phasors from E independent relative errors."""
    deviation = value * errors
    stacked = np.concatenate([deviation.real, deviation.imag], axis=-1)
    return np.asarray(np.einsum("eki,ekj->kij", stacked, stacked))


def motion_order(unit: str) -> tuple[int, int]:
    """Return family and derivative order of a unit of `MOTION_UNITS`; others are refused."""
    for family, units in enumerate(MOTION_UNITS):
        if unit in units:
            return family, units.index(unit)
    units_listed = ", ".join(unit for units in MOTION_UNITS for unit in units)
    raise ValueError(f"unit: expected one of {units_listed}, found {unit}")


def ratio_unit(above: str, below: str) -> str:
    """Return the unit of a ratio, such as `(m/s^2)/N`; 1 for equal units."""
    if above == below:
        return "1"
    parts = (part or "1" for part in (above, below))
    top, bottom = (f"({part})" if any(sign in part for sign in "/.·* ") else part for part in parts)
    return f"{top}/{bottom}"


def split_ratio(unit: str) -> tuple[str, str]:
    """Return the units above and below a unit's last division, "" for none."""
    if any(unit in units for units in MOTION_UNITS):
        return unit, ""
    depth = 0
    for index in range(len(unit) - 1, -1, -1):
        depth += {")": 1, "(": -1}.get(unit[index], 0)
        if unit[index] == "/" and depth == 0:
            return _unwrapped(unit[:index]), _unwrapped(unit[index + 1 :])
    return unit, ""


def _unwrapped(unit: str) -> str:
    """Return a unit without the brackets around it."""
    return unit[1:-1] if unit.startswith("(") and unit.endswith(")") else unit


def _product(s: ComplexArray, model: PoleModel) -> ComplexArray:
    """Return Π(s − z)/Π(s − p) at s (K,), without overflow."""
    factors = np.ones((len(s), max(len(model.zeros), len(model.poles))), dtype=np.complex128)
    factors[:, : len(model.zeros)] = s[:, None] - model.zeros
    with np.errstate(divide="ignore", invalid="ignore"):
        factors[:, : len(model.poles)] /= s[:, None] - model.poles
        return np.asarray(np.prod(factors, axis=1))


def _frequency_slope(s: ComplexArray, model: PoleModel) -> ComplexArray:
    """Return ∂ln H/∂ln(all zeros and poles) at s (K,); roots at 0 are constant."""
    poles, zeros = (roots[roots != 0.0] for roots in (model.poles, model.zeros))
    return np.asarray(np.sum(poles / (s[:, None] - poles), axis=1) - np.sum(zeros / (s[:, None] - zeros), axis=1))


def _check_finite(value: np.ndarray, frequency_hz: Sequence[float] | FloatArray) -> np.ndarray:
    """Refuse frequencies at which a response is zero or infinite."""
    bad = np.flatnonzero(~np.isfinite(value) | (value == 0.0))
    if len(bad):
        raise ValueError(
            f"frequency_hz: expected frequencies other than a zero or a pole, found {frequency_hz[bad[0]]:g} Hz"
        )
    return value


def cubic_spline(knots: FloatArray, values: Numbers, position: FloatArray) -> Numbers:
    """Return the not-a-knot cubic spline through values (N,) at positions; a constant for one knot.

    The digits are those of `scipy.interpolate.CubicSpline`, whose package takes as long to import as a check of a whole
    recording.
    """
    if len(knots) == 1:
        return np.full(len(position), values[0])
    step = np.diff(knots)
    rise = np.diff(values) / step
    slope = _slopes(knots, step, rise)
    bend = (slope[:-1] + slope[1:] - 2.0 * rise) / step
    curve = (rise - slope[:-1]) / step - bend
    piece = np.clip(np.searchsorted(knots, position, side="right") - 1, 0, len(step) - 1)
    x = position - knots[piece]
    return np.asarray(values[piece] + slope[piece] * x + curve[piece] * (x * x) + (bend / step)[piece] * (x * x * x))


def _slopes(knots: FloatArray, step: FloatArray, rise: Numbers) -> Numbers:
    """Return the spline's slopes (N,) at the knots.

    They make its second derivative continuous there, and the third one at the second and the last but one (de Boor
    2001, A Practical Guide to Splines, chapter IV).
    """
    if len(knots) == 2:
        return np.repeat(rise, 2)
    inner: FloatArray = 2.0 * (step[:-1] + step[1:])
    right = np.empty(len(knots), dtype=rise.dtype)
    right[1:-1] = 3.0 * (step[1:] * rise[:-1] + step[:-1] * rise[1:])
    if len(knots) == 3:  # both ends state the same: a parabola
        right[0], right[2] = 2.0 * rise
        return np.asarray(np.linalg.solve([[1.0, 1.0, 0.0], [step[1], inner[0], step[0]], [0.0, 1.0, 1.0]], right))
    first, last = knots[2] - knots[0], knots[-1] - knots[-3]
    right[0] = ((step[0] + 2.0 * first) * step[1] * rise[0] + step[0] ** 2 * rise[1]) / first
    right[-1] = (step[-1] ** 2 * rise[-2] + (2.0 * last + step[-1]) * step[-2] * rise[-1]) / last
    # Three diagonals by elimination; as steps are positive, no middle one becomes zero.
    above, middle, below = [first, *step[:-1]], [step[1], *inner, step[-2]], [*step[1:], last]
    for i, element in enumerate(below):
        share = element / middle[i]
        middle[i + 1] -= share * above[i]
        right[i + 1] -= share * right[i]
    right[-1] /= middle[-1]
    for i in range(len(below) - 1, -1, -1):
        right[i] = (right[i] - above[i] * right[i + 1]) / middle[i]
    return right


def _interpolation_error(knots: FloatArray, values: ComplexArray, positions: FloatArray) -> ComplexArray:
    """Return the standard error of a cubic spline at positions, 0 at its knots.

    For a smooth function it is f⁗/24·(x − a)²·(b − x)² between two knots. The change without every other knot, times
    the squared ratio of (x − a)·(b − x) with and without them, is then the error. Where the function is less smooth,
    the error is a share of that change, or of the error at either knot when it is left out. The share is the effect of
    halved steps on such errors nearby, at least 1/8. It is 1 in scatter, for fewer than six knots, and in the first and
    last interval, beyond which no knot determines the slope. For two knots half their difference is the half-width.
    """
    if len(knots) == 1:
        return np.zeros(len(positions), dtype=np.complex128)
    piece = np.clip(np.searchsorted(knots, positions, side="right") - 1, 0, len(knots) - 2)
    inside = (positions - knots[piece]) * (knots[piece + 1] - positions)
    arch = np.maximum(4.0 * inside, 0.0) / (knots[piece + 1] - knots[piece]) ** 2
    if len(knots) == 2:
        return np.asarray(arch * (values[1] - values[0]) / np.sqrt(12.0))
    share, left_out = np.ones(len(knots)), _omission_errors(knots, values, 2)
    if len(knots) >= FEWEST_TO_HALVE:
        near, far = _neighbour_maximum(np.abs(left_out)), _neighbour_maximum(np.abs(_omission_errors(knots, values, 4)))
        share[1:-1] = np.clip(np.divide(near, far, out=np.ones(len(knots)), where=far > 0.0), MIN_ERROR_SHARE, 1.0)[
            1:-1
        ]
    fine, share = cubic_spline(knots, values, positions), np.maximum(share[piece], share[piece + 1])
    outermost = (2.0 * positions < knots[0] + knots[1]) | (2.0 * positions > knots[-2] + knots[-1])
    changes = [np.nan_to_num(left_out[knot]) * share * arch for knot in (piece, piece + 1)]
    arch = np.where(outermost, 1.0, arch)  # no half lacks the first and the last knot
    for odd in (0, 1):
        used = _every_nth(len(knots), 2, odd)
        around = np.clip(np.searchsorted(knots[used], positions, side="right") - 1, 0, np.sum(used) - 2)
        wide = (positions - knots[used][around]) * (knots[used][around + 1] - positions)
        smooth = np.divide(inside, wide, out=np.zeros(len(wide)), where=wide > inside) ** 2
        changes.append((cubic_spline(knots[used], values[used], positions) - fine) * np.maximum(smooth, share * arch))
    largest = np.argmax(np.abs(changes), axis=0)[None]
    return np.asarray(np.take_along_axis(np.array(changes), largest, axis=0)[0])


def _prediction_error(knots: FloatArray, values: ComplexArray) -> float:
    """Return the squared errors with which half of the knots predicts the other."""
    return float(np.nansum(np.abs(_omission_errors(knots, values, 2)) ** 2))


def _omission_errors(knots: FloatArray, values: ComplexArray, every: int) -> ComplexArray:
    """Return the error (N,) at every knot of a spline through others.

    The knot is in the middle of two others. The others are those at multiples of `every`. The first and the last knot
    are never left out, and NaN.
    """
    number, errors = np.arange(len(knots)), np.full(len(knots), np.nan, dtype=np.complex128)
    for first in range(every):
        used = _every_nth(len(knots), every, first)
        middle = ((number - first) % every == every // 2) & ~used
        errors[middle] = cubic_spline(knots[used], values[used], knots[middle]) - values[middle]
    return errors


def _every_nth(count: int, every: int, first: int) -> BoolArray:
    """Return a mask (N,) of every `every`-th knot, with both ends."""
    number = np.arange(count)
    return np.asarray((number % every == first) | np.isin(number, [0, count - 1]))


def _neighbour_maximum(size: FloatArray) -> FloatArray:
    """Return the largest of every number (N,) and its two neighbours, NaN as 0."""
    padded = np.pad(np.nan_to_num(size), 1)
    return np.asarray(np.max([padded[:-2], padded[1:-1], padded[2:]], axis=0))
