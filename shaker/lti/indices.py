"""Characteristic figures of a linear system, with uncertainty.

A figure is the position where a smooth function of frequency or time crosses a level or turns. Its change with the
parameters is the change of the function at the fixed position, divided by the function's slope there. No position is
therefore searched for again. Where the gain only touches a band's limit the slope vanishes, and the uncertainty
correctly grows without bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shaker.lti.responses import (
    band_edges,
    band_end,
    gain_curve,
    half_power,
    log_slope,
    peak,
    quadrature,
    roots_between,
    roots_rad,
    settling_turns,
    transient,
)
from shaker.lti.system import LinearSystem, ModalModel
from shaker.model_notices import (
    ALTERNATING_POLE,
    FIGURES_NOT_LINEAR,
    FIGURES_WITHOUT_U,
    POLE_ABOVE_NYQUIST,
    POLE_ZERO_CANCELLATION,
    UNSTABLE_POLES,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

UNITS = {"hz": "Hz", "s": "s"}
LABELS = {
    "static_gain": "static gain",
    "natural_hz": "natural frequency of the dominant mode",
    "damped_hz": "damped frequency of the dominant mode",
    "damping_ratio": "damping ratio of the dominant mode",
    "peak_hz": "frequency of the highest gain",
    "peak_gain": "highest gain over the static gain",
    "quadrature_hz": "frequency at 90° of phase",
    "half_power_hz": "−3 dB",
    "band_5_hz": "±5 % of the static gain up to",
    "band_10_hz": "±10 % of the static gain up to",
    "band_5_nominal_hz": "±5 % of the nominal gain up to",
    "band_10_nominal_hz": "±10 % of the nominal gain up to",
    "overshoot": "overshoot",
    "rise_s": "rise time, 10 to 90 %",
    "settling_5_s": "settling time, ±5 %",
    "settling_2_s": "settling time, ±2 %",
}
"""The figures of `Indices` in the order of a table, with the words for them."""


@dataclass(frozen=True)
class Mode:
    """An oscillating mode of a system.

    The pole is in rad/s, f_n = |p|/2π, f_d = Im p/2π, ζ = -Re p/|p|. `step_share`: amplitude of its oscillation after a
    step over the static gain, None where poles coincide.
    """

    pole: complex
    natural_hz: float
    damped_hz: float
    damping_ratio: float
    step_share: float | None


@dataclass(frozen=True)
class Indices:
    """Figures of one system; None where the system has no such figure.

    Attributes
    ----------
    static_gain : |H(0)| with sign.
    stable : whether every pole decays.
    modes, dominant : oscillating modes by natural frequency, and the one with the largest oscillation after a step;
        `natural_hz`, `damped_hz` and `damping_ratio` are those of the dominant mode.
    real_poles_hz : decay rates of real poles over 2π.
    peak_hz, peak_gain : frequency of the highest gain, and that gain over the static gain.
    quadrature_hz : frequency where the phase first differs by 90° from the static one.
    half_power_hz : frequency where |H| first falls below |H(0)|/√2.
    band_5_hz, band_10_hz : frequency where |H| first leaves ±5 or ±10 % of |H(0)|; infinite (half the rate for samples)
        where it never does.
    band_5_nominal_hz, band_10_nominal_hz : the same relative to the nominal gain.
    overshoot : highest value after a step beyond the final one, over the final one.
    rise_s : time from the first 10 % to the first 90 % in s.
    settling_2_s, settling_5_s : time after which the response stays within 2 or 5 % of the final value, in s.
    notices : notices about the poles.
    """

    static_gain: float
    stable: bool
    modes: tuple[Mode, ...]
    dominant: Mode | None
    real_poles_hz: tuple[float, ...]
    peak_hz: float | None
    peak_gain: float | None
    quadrature_hz: float | None
    half_power_hz: float | None
    band_5_hz: float | None
    band_10_hz: float | None
    band_5_nominal_hz: float | None
    band_10_nominal_hz: float | None
    overshoot: float | None
    rise_s: float | None
    settling_2_s: float | None
    settling_5_s: float | None
    notices: tuple[Notice, ...] = ()

    @property
    def natural_hz(self) -> float | None:
        """f_n of the dominant mode."""
        return None if self.dominant is None else self.dominant.natural_hz

    @property
    def damped_hz(self) -> float | None:
        """f_d of the dominant mode."""
        return None if self.dominant is None else self.dominant.damped_hz

    @property
    def damping_ratio(self) -> float | None:
        """ζ of the dominant mode."""
        return None if self.dominant is None else self.dominant.damping_ratio

    def figures(self) -> dict[str, float | None]:
        """Return every figure by its name, in the order of `LABELS`."""
        return {name: getattr(self, name) for name in LABELS}


def unit_of(name: str) -> str:
    """Return the unit of a figure: Hz, s, or none."""
    return UNITS.get(name.rsplit("_", 1)[-1], "")


def indices(
    system: LinearSystem,
    nominal_gain: float = 1.0,
    sample_rate_hz: float | None = None,
    dominant: complex | None = None,
) -> Indices:
    """Return all figures of a continuous or sampled system.

    A sampled system's poles are ln(z)·fs, its gain is that on the unit circle, and its times are those of samples.

    Parameters
    ----------
    system
        The system.
    nominal_gain
        Specified gain, default 1.
    sample_rate_hz
        Rate in Hz of the samples from which a continuous system was identified, for notices of its poles.
    dominant
        Pole in rad/s next to that of the dominant mode; default: the mode with the largest oscillation after a step.

    Returns
    -------
    The figures, with None where the system has no such figure.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import LinearSystem, indices
    >>> omega = 2 * np.pi * 300.0
    >>> sensor = LinearSystem.from_coefficients(np.array([omega**2]), np.array([1.0, 0.1 * omega, omega**2]))
    >>> found = indices(sensor)
    >>> overshoot = f"overshoot {100 * found.overshoot:.0f} %"
    >>> print(f"{found.natural_hz:.0f} Hz, {overshoot}, within 5 % up to {found.band_5_hz:.0f} Hz")
    300 Hz, overshoot 85 %, within 5 % up to 66 Hz
    """
    curve = gain_curve(system)
    static, oscillating = system.static_gain, modes(system)
    top, passing = peak(curve), transient(system)
    usable = bool(np.isfinite(static)) and static != 0
    levels = [(gain, part) for gain in (static, nominal_gain) for part in (0.05, 0.10)]
    if usable:  # in one search, whose parts are then at hand
        curve.crossings(float(curve.gain[0]) / np.sqrt(2.0), *(edge for level in levels for edge in band_edges(*level)))
    band_5, band_10, nominal_5, nominal_10 = (band_end(curve, *level) if usable else None for level in levels)
    _, poles = roots_rad(system)
    return Indices(
        static,
        system.stable,
        oscillating,
        _dominant(oscillating, dominant),
        tuple(sorted(float(-p.real / (2 * np.pi)) for p in poles if p.imag == 0)),
        None if top is None else top[0],
        None if top is None or not usable or not np.isfinite(top[1]) else top[1] / abs(static),
        quadrature(curve) if usable else None,
        half_power(curve) if usable else None,
        band_5,
        band_10,
        nominal_5,
        nominal_10,
        passing.overshoot,
        passing.rise_s,
        passing.settling_2_s,
        passing.settling_5_s,
        pole_notices(system, sample_rate_hz),
    )


def modes(system: LinearSystem) -> tuple[Mode, ...]:
    """Return the oscillating modes by natural frequency."""
    shares = step_shares(system)
    rate, upper = system.sample_rate_hz, system.poles.imag > 0
    poles = system.poles[upper] if rate is None else np.log(system.poles[upper]) * rate
    oscillating = [
        Mode(s, abs(s) / (2 * np.pi), s.imag / (2 * np.pi), -s.real / abs(s), share if np.isfinite(share) else None)
        for s, share in zip(poles.tolist(), shares[upper].tolist(), strict=True)
    ]
    return tuple(sorted(oscillating, key=lambda mode: mode.natural_hz))


def _dominant(oscillating: Sequence[Mode], near: complex | None) -> Mode | None:
    """Return the mode with the largest oscillation, or that next to a pole."""
    if near is not None:
        return min(oscillating, key=lambda mode: abs(mode.pole - near), default=None)
    return max(oscillating, key=lambda mode: mode.step_share or 0.0, default=None)


def step_shares(system: LinearSystem) -> FloatArray:
    """Return each pole's oscillation (P,) after a step over the static gain, with its conjugate."""
    below = system.poles - system.static_point
    pairs = np.where(system.poles.imag == 0, 1.0, 2.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(pairs * system.residues() / below / system.static_gain))


# Doubtful poles of a model.

MAX_POLE_SHARE = 0.5
"""Share of the sampling rate above which a pole cannot belong to the sensor: the Nyquist frequency."""
CANCELLATION_DISTANCE = 1e-2
"""Distance of a zero from a pole, over that of the pole from rest, below which both nearly cancel; chosen."""


def pole_notices(system: LinearSystem, sample_rate_hz: float | None = None) -> tuple[Notice, ...]:
    """Return notices of instability, poles without physical meaning, and near cancellations."""
    system_rate = system.sample_rate_hz
    rate, notices = system_rate or sample_rate_hz, []
    if not system.stable:
        grows = system.poles.real >= 0 if system_rate is None else np.abs(system.poles) >= 1
        notices.append(Notice(UNSTABLE_POLES, "stability", unstable=int(grows.sum()), poles=len(grows)))
    for pole in system.poles[system.poles.imag >= 0]:
        value = f"{pole.real:.5g}" if pole.imag == 0 else f"{pole.real:.5g} ± {pole.imag:.5g}j"
        where = f"pole {value}{' rad/s' if system_rate is None else ''}"
        if system_rate is not None and pole.imag == 0 and pole.real < 0:
            notices.append(Notice(ALTERNATING_POLE, where, pole_z=float(pole.real)))
            continue
        if system_rate is not None and pole == 0:  # a delay of one sample
            continue
        size = abs(pole if system_rate is None else np.log(pole) * system_rate) / (2 * np.pi)
        if rate is not None and size > MAX_POLE_SHARE * rate:
            notices.append(Notice(POLE_ABOVE_NYQUIST, where, pole_hz=float(size), rate_hz=rate))
        distance, from_rest = np.abs(system.zeros - pole), abs(pole - system.static_point)
        if np.any(distance < CANCELLATION_DISTANCE * from_rest):
            percent = 100 * float(distance.min()) / float(from_rest)
            notices.append(Notice(POLE_ZERO_CANCELLATION, where, distance_percent=percent))
    return tuple(notices)


# Whether figures change in proportion within U: a band that another turning point cuts short, a gain that bends.

REACH_SIGMAS = 2.0
"""Standard uncertainties by which a model is shifted, about the half-width of a 95 % interval."""
SAME_DIRECTION = 0.98
"""Correlation of two figures above which both shift the model in the same direction; chosen."""
NONLINEAR_FACTOR = 1.2
"""Ratio of a figure's change to its first-order change above which a notice is given; chosen."""


@dataclass(frozen=True)
class FigureRange:
    """Lowest and highest figures (Q,) within `REACH_SIGMAS` of a model, NaN where they cease.

    `factor` (Q,): factor by which a first-order u must be multiplied to include them, at least 1.
    """

    low: FloatArray
    high: FloatArray
    factor: FloatArray

    def notices(self, names: Sequence[str]) -> Iterator[Notice]:
        """Yield notices of figures that do not change linearly; names (Q,) as in `LABELS`."""
        lost = [LABELS[name] for name, factor in zip(names, self.factor, strict=True) if np.isnan(factor)]
        if lost:
            yield Notice(FIGURES_WITHOUT_U, "indices", reach_sigmas=REACH_SIGMAS, figures=", ".join(lost))
        ranges = [
            f"{LABELS[name]}: {low:.5g} … {high:.5g} {unit_of(name)}".rstrip()
            for name, low, high, factor in zip(names, self.low, self.high, self.factor, strict=True)
            if factor > NONLINEAR_FACTOR
        ]
        if ranges:
            yield Notice(FIGURES_NOT_LINEAR, "indices", reach_sigmas=REACH_SIGMAS, figures="; ".join(ranges))


def find_figure_range(
    covariance: FloatArray, slope: FloatArray, figures_after: Callable[[FloatArray], FloatArray]
) -> FigureRange:
    """Return the range of figures within the covariance (P, P) of a model.

    `slope` (Q, P) are their derivatives. `figures_after` returns the figures (Q,) for a shift (P,) of the parameters.
    These are shifted to both sides as far as each figure can change to first order, V·g/√(gᵀVg), and every figure is
    evaluated for the direction of every other: a band may end where the highest gain touches its limit. A linear figure
    never changes more than to first order.
    """
    value, u = (
        figures_after(np.zeros(len(covariance))),
        np.sqrt(np.maximum(np.einsum("qp,pr,qr->q", slope, covariance, slope), 0)),
    )
    shifts: list[FloatArray] = []
    for row, size in zip(slope, u, strict=True):
        same = [abs(row @ shift) > SAME_DIRECTION * size for shift in shifts]
        if np.isfinite(size) and size > 0 and not any(same):
            shifts.append(covariance @ row / size)
    seen = np.array([value, *(figures_after(sign * REACH_SIGMAS * shift) for shift in shifts for sign in (-1.0, 1.0))])
    exists, finite = np.isfinite(value) & np.isfinite(u), np.all(np.isfinite(seen), axis=0)
    low, high = (np.where(finite, of(seen, axis=0), np.nan) for of in (np.min, np.max))
    largest = np.maximum(high - value, value - low)
    factor = np.maximum(np.divide(largest, REACH_SIGMAS * u, out=np.ones(len(u)), where=exists & (u > 0)), 1.0)
    return FigureRange(low, high, np.where(exists & (u > 0), factor, 1.0))


# Standard uncertainties of the indices of an identified model.

ModelFigure = Callable[[ModalModel], float]
SETTLING = {"settling_5_s": 0.05, "settling_2_s": 0.02}
OVER_STATIC = ("half_power_hz", "band_5_hz", "band_10_hz")
OVER_NOMINAL = ("band_5_nominal_hz", "band_10_nominal_hz")


def moving_figures(model: ModalModel, found: Indices) -> tuple[tuple[str, ...], Callable[[ModalModel], FloatArray]]:
    """Return names (Q,) and one function of models whose values change like the figures.

    It is valid close to `model`. Missing figures are left out, and settling times, for which see `settling_interval`.
    """
    parts: dict[str, tuple[ModelFigure, float]] = {"static_gain": (lambda at: at.static_gain, 1.0)}
    if found.dominant is not None:
        mode = int(np.argmin(np.abs(model.poles[: len(model.frequency_hz)] - found.dominant.pole)))
        parts["natural_hz"] = lambda at: float(at.frequency_hz[mode]), 1.0
        parts["damped_hz"] = lambda at: float(at.poles[mode].imag / (2 * np.pi)), 1.0
        parts["damping_ratio"] = lambda at: float(at.damping_ratio[mode]), 1.0
    parts |= _over_frequency(model.system, found)
    seen = transient(model.system)
    if seen.highest_s is not None:
        highest = np.array([seen.highest_s])
        parts["overshoot"] = lambda at: float(at.step(highest)[0] / at.static_gain), 1.0
    if seen.passing_s is not None:
        passing = np.array(seen.passing_s)
        slope = model.impulse(passing) / model.static_gain
        if np.all(slope > 0):
            parts["rise_s"] = lambda at: float(-np.diff(at.step(passing) / at.static_gain / slope)[0]), 1.0
    return tuple(parts), lambda at: np.array([factor * figure(at) for figure, factor in parts.values()])


def _over_frequency(system: LinearSystem, found: Indices) -> dict[str, tuple[ModelFigure, float]]:
    """Return functions for peak, bands, -3 dB and 90° at fixed frequency, with factors."""

    def level_at(hertz: float, over_static: bool) -> ModelFigure:
        """ln|H|, over the static gain or not."""
        position = np.array([hertz])
        return lambda at: float(
            np.log(np.abs(at.response(position)[0]) / (abs(at.static_gain) if over_static else 1.0))
        )

    parts: dict[str, tuple[ModelFigure, float]] = {}
    if found.peak_hz is not None and found.peak_gain is not None:
        top, step = np.array([found.peak_hz]), 1e-6 * found.peak_hz
        bend = np.diff(log_slope(system, found.peak_hz + np.array([-step, step])))[0] / (2 * step)
        parts["peak_hz"] = lambda at: float(log_slope(at.system, top)[0]), -1.0 / float(bend)
        parts["peak_gain"] = level_at(found.peak_hz, True), found.peak_gain
    for name in (*OVER_STATIC, *OVER_NOMINAL):
        hertz = getattr(found, name)
        if hertz is not None and np.isfinite(hertz):
            slope = 2 * np.pi * float(log_slope(system, np.array([hertz]))[0])
            parts[name] = level_at(hertz, name in OVER_STATIC), -1.0 / slope
    if found.quadrature_hz is not None:
        near, quarter = found.quadrature_hz * (1 + np.array([-1e-6, 1e-6])), np.array([found.quadrature_hz])
        slope = np.diff((system.response(near) / system.static_gain).real)[0] / np.diff(near)[0]
        parts["quadrature_hz"] = lambda at: float(at.response(quarter)[0].real / at.static_gain), -1.0 / float(slope)
    return parts


def settling_interval(model: ModalModel, tolerance: float, factor: float) -> tuple[float, float] | None:
    """Return the least and the largest settling time in s, None where there is none.

    The response has `factor` standard uncertainties U(t). It surely leaves the tolerance for the last time where |y -
    1| - U does so, and may leave it until |y - 1| + U no longer does: whole half periods later if a turning point
    grazes the tolerance.
    """
    found = settling_turns(model.system, tolerance)
    if found is None:
        return None

    def reach(at_s: FloatArray) -> FloatArray:
        slope = model.jacobian(lambda at: np.asarray(at.step(at_s) / at.static_gain))[1]
        square = np.einsum("tp,pq,tq->t", slope, np.asarray(model.covariance), slope, optimize=True)
        return np.asarray(factor * np.sqrt(np.maximum(square, 0.0)))

    time, ratio = found
    at_turns = reach(time)

    def last_outside(sign: float) -> float:
        outside = np.flatnonzero(np.abs(ratio - 1.0) > tolerance + sign * at_turns)
        if not len(outside) or outside[-1] == len(time) - 1:
            return float(time[-1] if len(outside) else time[0])
        ends, sense = time[outside[-1] : outside[-1] + 2], np.sign(ratio[outside[-1]] - 1.0)

        def crossing(level: float) -> FloatArray:
            def beyond(at_s: FloatArray) -> FloatArray:
                return np.asarray(sense * (model.step(at_s) / model.static_gain - 1.0) - level)

            signs = beyond(ends)
            if not signs[0] > 0.0 > signs[1]:
                return ends[:1] if signs[0] <= 0.0 else ends[1:]
            return roots_between(beyond, ends[:1], ends[1:])

        return float(crossing(tolerance + sign * float(reach(crossing(tolerance))[0]))[0])

    return last_outside(1.0), last_outside(-1.0)
