"""The indices of any system: what describes how a sensor follows a load that changes, with uncertainty.

A figure is where a smooth function of frequency or time passes a level or turns. Its change with the parameters is that
of the function at the fixed place, over the function's slope there; so no place is searched for again. Where the gain
just touches a band's limit the slope goes to nothing and the uncertainty, rightly, without bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shaker.arrays import FloatArray
from shaker.lti.responses import (
    band_edges,
    band_end,
    gain_curve,
    half_power,
    log_slope,
    peak,
    quadrature,
    roots_rad,
    settling_points,
    transient,
)
from shaker.lti.system import LinearSystem, ModalModel
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
    """An oscillating mode: pole in rad/s, f_n = |p|/2π, f_d = Im p/2π, ζ = -Re p/|p|.

    `step_share`: amplitude of its oscillation after a step over the static gain, None where poles coincide.
    """

    pole: complex
    natural_hz: float
    damped_hz: float
    damping_ratio: float
    step_share: float | None


@dataclass(frozen=True)
class Indices:
    """Figures of one system; None where the system has no such figure.

    `modes` by natural frequency and `dominant`, the one that oscillates most after a step; `natural_hz`, `damped_hz`
    and `damping_ratio` are its. `peak_gain` is over the static gain. Bands end where |H| first leaves ±5 or ±10 % of
    |H(0)|, or of the nominal gain; infinite where it never does (at half the rate for samples); `half_power_hz`: where
    it first falls below |H(0)|/√2; `quadrature_hz`: where the phase first is 90° from that at rest. `overshoot`: the
    highest value after a step beyond the final one over the final one; `rise_s` from its first 10 % to its first 90 %;
    `settling_2_s`, `settling_5_s`: from where on the response stays within 2 or 5 % of the final value.
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


def indices(system: LinearSystem, nominal_gain: float = 1.0, sample_rate_hz: float | None = None) -> Indices:
    """Return all figures of a system, continuous or sampled; `nominal_gain` is what its gain should be.

    A sampled system's poles are ln(z)·fs, its gain that on the unit circle, its times those of samples.
    `sample_rate_hz`: that of the samples a continuous system was identified from, for notices of its poles.

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
        max(oscillating, key=lambda mode: mode.step_share or 0.0, default=None),
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


def step_shares(system: LinearSystem) -> FloatArray:
    """Return for each pole (P,) how much it swings after a step, pairs together, over the static gain."""
    below = system.poles - system.static_point
    pairs = np.where(system.poles.imag == 0, 1.0, 2.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(pairs * system.residues() / below / system.static_gain))


# What makes a model's poles doubtful.

FAR = 0.5
"""Share of the sampling rate from which on a pole says nothing of the sensor."""
NEAR = 1e-2
"""Distance of a zero from a pole, over that of the pole from rest, below which the two nearly cancel."""


def pole_notices(system: LinearSystem, sample_rate_hz: float | None = None) -> tuple[Notice, ...]:
    """Return notices on stability, poles without a meaning, and zeros that nearly cancel poles.

    `sample_rate_hz`: that of the samples a continuous model was found from; a sampled model has its own.
    """
    own_rate = system.sample_rate_hz
    rate, notices = own_rate or sample_rate_hz, []
    if not system.stable:
        grows = system.poles.real >= 0 if own_rate is None else np.abs(system.poles) >= 1
        notices.append(Notice("warning", f"{int(grows.sum())} of {len(grows)} poles do not decay.", "stability"))
    for pole in system.poles[system.poles.imag >= 0]:
        value = f"{pole.real:.5g}" if pole.imag == 0 else f"{pole.real:.5g} ± {pole.imag:.5g}j"
        where = f"pole {value}{' rad/s' if own_rate is None else ''}"
        if own_rate is not None and pole.imag == 0 and pole.real < 0:
            text = f"turns its sign with every sample, z = {pole.real:.4g}: no motion of a sensor, a product of noise"
            notices.append(Notice("warning", f"The pole {text} or of too high an order.", where))
            continue
        if own_rate is not None and pole == 0:  # a delay of one sample
            continue
        size = abs(pole if own_rate is None else np.log(pole) * own_rate) / (2 * np.pi)
        if rate is not None and size > FAR * rate:
            text = f"The pole at {size:.4g} Hz lies beyond half the sampling rate of {rate:.6g} Hz: the samples do not"
            notices.append(Notice("warning", f"{text} show it.", where))
        distance = np.abs(system.zeros - pole)
        if np.any(distance < NEAR * abs(pole - system.static_point)):
            text = f"A zero lies {100 * distance.min() / abs(pole - system.static_point):.2g} % from it: the two nearly cancel,"
            notices.append(Notice("note", f"{text} and the order may be too high.", where))
    return tuple(notices)


# Whether figures change in proportion within U: a band that another turning point cuts short, a gain that bends.

REACH = 2.0
"""Standard uncertainties by which a model is moved to see that."""
ALIKE = 0.98
"""Correlation of two figures from which on both move the model the same way."""
BENT = 1.2
"""Factor between what a figure changes by and first order from which the user is told."""


@dataclass(frozen=True)
class FigureRange:
    """The lowest and highest values of figures (Q,) within `REACH` standard uncertainties of a model, NaN where a
    figure ceases to be; `factor` (Q,): what u of first order has to be multiplied by to hold them, at least 1.
    """

    low: FloatArray
    high: FloatArray
    factor: FloatArray

    def notices(self, names: Sequence[str]) -> Iterator[Notice]:
        """Say of which figures, names (Q,) as in `LABELS`, first order does not hold."""
        gone = [LABELS[name] for name, factor in zip(names, self.factor, strict=True) if np.isnan(factor)]
        if gone:
            text = f"within {REACH:g} standard uncertainties of the model there may be none of these, which have no U: "
            yield Notice("warning", text + ", ".join(gone), "indices")
        bent = [
            f"{LABELS[name]}: {low:.5g} … {high:.5g} {unit_of(name)}".rstrip()
            for name, low, high, factor in zip(names, self.low, self.high, self.factor, strict=True)
            if factor > BENT
        ]
        if bent:
            text = (
                f"within {REACH:g} standard uncertainties of the model these do not change in proportion to it, and U "
            )
            yield Notice("note", f"{text}is widened to hold where they come to: {'; '.join(bent)}", "indices")


def find_figure_range(
    covariance: FloatArray, slope: FloatArray, figures_after: Callable[[FloatArray], FloatArray]
) -> FigureRange:
    """Return what figures come to within the covariance (P, P) of a model, whose derivatives are `slope` (Q, P).

    `moved` gives the figures (Q,), NaN or infinite where there is none, for a move (P,) of the parameters. These are
    moved to either side as far as each figure can go to first order, V·g/√(gᵀVg): nothing else moves that figure by
    as much. Every figure is looked at in the direction of every other, since a band may end where the highest gain
    comes to touch its limit, which the gain at its own end does not tell. One that is linear never changes more than
    first order says, in whatever direction.
    """
    value, u = (
        figures_after(np.zeros(len(covariance))),
        np.sqrt(np.maximum(np.einsum("qp,pr,qr->q", slope, covariance, slope), 0)),
    )
    ways: list[FloatArray] = []
    for own, size in zip(slope, u, strict=True):
        alike = [abs(own @ way) > ALIKE * size for way in ways]
        if np.isfinite(size) and size > 0 and not any(alike):
            ways.append(covariance @ own / size)
    seen = np.array([value, *(figures_after(sign * REACH * way) for way in ways for sign in (-1.0, 1.0))])
    known, finite = np.isfinite(value) & np.isfinite(u), np.all(np.isfinite(seen), axis=0)
    low, high = (np.where(finite, of(seen, axis=0), np.nan) for of in (np.min, np.max))
    far = np.maximum(high - value, value - low)
    factor = np.maximum(np.divide(far, REACH * u, out=np.ones(len(u)), where=known & (u > 0)), 1.0)
    return FigureRange(low, high, np.where(known & (u > 0), factor, 1.0))


# Standard uncertainties of the indices of an identified model.

Figure = Callable[[ModalModel], float]
SETTLING = {"settling_5_s": 0.05, "settling_2_s": 0.02}
OVER_STATIC = ("half_power_hz", "band_5_hz", "band_10_hz")
OVER_NOMINAL = ("band_5_nominal_hz", "band_10_nominal_hz")


def moving_figures(model: ModalModel, found: Indices) -> tuple[tuple[str, ...], Callable[[ModalModel], FloatArray]]:
    """Return names (Q,) and a function of models whose Q values change as the figures of `found` do close to `model`.

    For `ModalModel.propagate` and `.jacobian`, which need changes only; figures that there are not are left out, and
    settling times, for which see `settling_u`.
    """
    parts: dict[str, tuple[Figure, float]] = {"static_gain": (lambda at: at.static_gain, 1.0)}
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


def _over_frequency(system: LinearSystem, found: Indices) -> dict[str, tuple[Figure, float]]:
    """Return what stands for peak, bands, -3 dB and 90° at their frequencies, and what these change by with it."""

    def level_at(hertz: float, over_static: bool) -> Figure:
        """ln|H|, over the static gain or not."""
        place = np.array([hertz])
        return lambda at: float(np.log(np.abs(at.response(place)[0]) / (abs(at.static_gain) if over_static else 1.0)))

    parts: dict[str, tuple[Figure, float]] = {}
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


def settling_u(model: ModalModel, tolerance: float) -> float:
    """Return the standard uncertainty in s of a settling time, NaN where there is none.

    Two parts: the crossing moves by τ with slope·τ ± curvature·τ²/2 = u of the response, away from the turning point
    before it or towards that, which it does not pass; and it jumps to the next turning point, half a period away, where
    one that is just outside comes to be inside, or the other way: variance (half period)²·P(1 - P) with the probability
    P of that.
    """
    from scipy.special import ndtr

    points = settling_points(model.system, tolerance)
    if points is None or points[0] == 0:
        return float("nan")
    value, covariance = model.propagate(lambda at: np.asarray(at.step(points) / at.static_gain))
    u = np.sqrt(np.diag(covariance))
    half = points[2] - points[1]
    near = model.impulse(points[0] + 1e-5 * half * np.arange(-1, 2)) / model.static_gain
    slope, bend = abs(near[1]), abs(near[2] - near[0]) / (2e-5 * half)
    away, back = slope**2 + 2 * bend * u[0], max(slope**2 - 2 * bend * u[0], 0.0)
    moved = 0.5 * (np.sqrt(away) - np.sqrt(back)) / bend if bend > 0 else u[0] / slope
    margin = np.abs(np.abs(value[1:] - 1) - tolerance)
    jump = ndtr(-np.divide(margin, u[1:], out=np.full(2, np.inf), where=u[1:] > 0))
    return float(np.hypot(moved, half * np.sqrt(np.sum(jump * (1 - jump)))))
