"""Indices of any system with uncertainty; false poles.

Standard uncertainties of the indices of an identified model.

A figure is where a smooth function of frequency or time passes a level or turns. Its change with the parameters is that
of the function at the fixed place, over the function's slope there; so no place is searched for again. Where the gain
just touches a band's limit the slope goes to nothing and the uncertainty, rightly, without bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shaker.arrays import FloatArray, Notice
from shaker.lti.modal import ModalModel
from shaker.lti.responses import (
    LABELS,
    Indices,
    Mode,
    Transient,
    UncertainIndices,
    band_end,
    gain_curve,
    half_power,
    log_slope,
    peak,
    places_rad,
    quadrature,
    settling_points,
    transient,
)
from shaker.lti.system import LinearSystem

# What makes a model's poles doubtful.


FAR = 0.5
"""Share of the sampling rate from which on a pole says nothing of the sensor."""
NEAR = 1e-2
"""Distance of a zero from a pole, over that of the pole from rest, below which the two nearly cancel."""


def remarks(system: LinearSystem, sample_rate_hz: float | None = None) -> tuple[Notice, ...]:
    """Return remarks on stability, poles without a meaning, and zeros that nearly cancel poles.

    `sample_rate_hz`: that of the samples a continuous model was found from; a sampled model has its own.
    """
    rate = system.sample_rate_hz or sample_rate_hz
    found = [] if system.stable else [_unstable(system)]
    for pole in system.poles[system.poles.imag >= 0]:
        if system.sample_rate_hz is not None and pole.imag == 0 and pole.real < 0:
            text = f"turns its sign with every sample, z = {pole.real:.4g}: no motion of a sensor, a product of noise"
            found.append(Notice("warning", f"The pole {text} or of too high an order.", _name(system, pole)))
            continue
        if system.sample_rate_hz is not None and pole == 0:  # a delay of one sample
            continue
        size = abs(pole if system.sample_rate_hz is None else np.log(pole) * system.sample_rate_hz) / (2 * np.pi)
        if rate is not None and size > FAR * rate:
            text = f"The pole at {size:.4g} Hz lies beyond half the sampling rate of {rate:.6g} Hz: the samples do not"
            found.append(Notice("warning", f"{text} show it.", _name(system, pole)))
        distance = np.abs(system.zeros - pole)
        if np.any(distance < NEAR * abs(pole - system.rest)):
            text = f"A zero lies {100 * distance.min() / abs(pole - system.rest):.2g} % from it: the two nearly cancel,"
            found.append(Notice("info", f"{text} and the order may be too high.", _name(system, pole)))
    return tuple(found)


def _unstable(system: LinearSystem) -> Notice:
    """Return the warning of poles that grow."""
    grows = system.poles.real >= 0 if system.sample_rate_hz is None else np.abs(system.poles) >= 1
    return Notice("warning", f"{int(grows.sum())} of {len(grows)} poles do not decay.", "stability")


def _name(system: LinearSystem, pole: complex) -> str:
    """Return words for a pole."""
    unit = " rad/s" if system.sample_rate_hz is None else ""
    value = f"{pole.real:.5g}" if pole.imag == 0 else f"{pole.real:.5g} ± {pole.imag:.5g}j"
    return f"pole {value}{unit}"


# The indices of a system.


def indices(system: LinearSystem, nominal_gain: float = 1.0, sample_rate_hz: float | None = None) -> Indices:
    """Return all figures of a system, continuous or sampled; `nominal_gain` is what its gain should be.

    A sampled system's poles are ln(z)·fs, its gain that on the unit circle, its times those of samples.
    `sample_rate_hz`: that of the samples a continuous system was identified from, for remarks on its poles.
    """
    curve = gain_curve(system)
    static, found = system.static_gain, modes(system)
    top, passing = peak(curve), transient(system)
    usable = bool(np.isfinite(static)) and static != 0
    bands = [band_end(curve, static, part) if usable else None for part in (0.05, 0.10)]
    bands += [band_end(curve, nominal_gain, part) if usable else None for part in (0.05, 0.10)]
    _, poles = places_rad(system)
    return Indices(
        static,
        system.stable,
        found,
        max(found, key=lambda mode: mode.step_share or 0.0, default=None),
        tuple(sorted(float(-p.real / (2 * np.pi)) for p in poles if p.imag == 0)),
        None if top is None else top[0],
        None if top is None or not usable or not np.isfinite(top[1]) else top[1] / abs(static),
        quadrature(system) if usable else None,
        half_power(curve) if usable else None,
        bands[0],
        bands[1],
        bands[2],
        bands[3],
        passing.overshoot,
        passing.rise_s,
        passing.settling_2_s,
        passing.settling_5_s,
        remarks(system, sample_rate_hz),
    )


def modes(system: LinearSystem) -> tuple[Mode, ...]:
    """Return the oscillating modes by natural frequency."""
    shares = step_shares(system)
    rate, found = system.sample_rate_hz, []
    for pole, share in zip(system.poles, shares, strict=True):
        if pole.imag <= 0:
            continue
        s = pole if rate is None else np.log(pole) * rate
        size = float(abs(s))
        known = float(share) if np.isfinite(share) else None
        found.append(Mode(complex(s), size / (2 * np.pi), float(s.imag) / (2 * np.pi), float(-s.real / size), known))
    return tuple(sorted(found, key=lambda mode: mode.natural_hz))


def step_shares(system: LinearSystem) -> FloatArray:
    """Return for each pole (P,) how much it swings after a step, pairs together, over the static gain."""
    below = system.poles - system.rest
    pairs = np.where(system.poles.imag == 0, 1.0, 2.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(pairs * system.residues() / below / system.static_gain))


# Standard uncertainties of the indices of an identified model.


Figure = Callable[[ModalModel], float]
SETTLING = {"settling_5_s": 0.05, "settling_2_s": 0.02}
EDGES = ("half_power_hz", "band_5_hz", "band_10_hz")
NOMINAL_EDGES = ("band_5_nominal_hz", "band_10_nominal_hz")


@dataclass(frozen=True)
class _Smooth:
    """A smooth function of the model, and what a figure changes by per change of it."""

    function: Figure
    factor: float = 1.0


def indices_with_u(
    model: ModalModel, nominal_gain: float = 1.0, sample_rate_hz: float | None = None
) -> UncertainIndices:
    """Return the figures of an identified model with standard uncertainties from its covariance.

    Arguments as of `indices`.
    """
    found = indices(model.system, nominal_gain, sample_rate_hz)
    names, function = moving_figures(model, found)
    _, covariance = model.propagate(function)
    u: dict[str, float | None] = dict.fromkeys(LABELS)
    u |= dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    for name, tolerance in SETTLING.items():
        spread = settling_u(model, tolerance)
        u[name] = spread if np.isfinite(spread) else None
    return UncertainIndices(found, u)


def moving_figures(model: ModalModel, found: Indices) -> tuple[tuple[str, ...], Callable[[ModalModel], FloatArray]]:
    """Return names (Q,) and a function of models whose Q values change as the figures of `found` do close to `model`.

    For `ModalModel.jacobian`, which needs changes only; figures that there are not, and settling times, are left out.
    """
    parts = _of_modes(model, found) | _over_frequency(model.system, found) | _over_time(model, transient(model.system))
    return tuple(parts), lambda at: np.array([part.factor * part.function(at) for part in parts.values()])


def _of_modes(model: ModalModel, found: Indices) -> dict[str, _Smooth]:
    """Return the static gain and the figures of the dominant mode."""
    parts = {"static_gain": _Smooth(lambda at: at.static_gain)}
    if found.dominant is not None:
        mode = int(np.argmin(np.abs(model.poles[: len(model.frequency_hz)] - found.dominant.pole)))
        parts["natural_hz"] = _Smooth(lambda at: float(at.frequency_hz[mode]))
        parts["damped_hz"] = _Smooth(lambda at: float(at.poles[mode].imag / (2 * np.pi)))
        parts["damping_ratio"] = _Smooth(lambda at: float(at.damping_ratio[mode]))
    return parts


def _over_frequency(system: LinearSystem, found: Indices) -> dict[str, _Smooth]:
    """Return what stands for peak, bands, -3 dB and 90° at their frequencies."""
    parts = {}
    if found.peak_hz is not None and found.peak_gain is not None:
        step = 1e-6 * found.peak_hz
        bend = np.diff(log_slope(system, found.peak_hz + np.array([-step, step])))[0] / (2 * step)
        parts["peak_hz"] = _Smooth(_slope_at(found.peak_hz), -1.0 / float(bend))
        parts["peak_gain"] = _Smooth(_level_at(found.peak_hz, True), found.peak_gain)
    for name in (*EDGES, *NOMINAL_EDGES):
        hertz = getattr(found, name)
        if hertz is not None and np.isfinite(hertz):
            slope = 2 * np.pi * float(log_slope(system, np.array([hertz]))[0])
            parts[name] = _Smooth(_level_at(hertz, name in EDGES), -1.0 / slope)
    if found.quadrature_hz is not None:
        near = found.quadrature_hz * (1 + np.array([-1e-6, 1e-6]))
        slope = np.diff((system.response(near) / system.static_gain).real)[0] / np.diff(near)[0]
        parts["quadrature_hz"] = _Smooth(_share_at(found.quadrature_hz), -1.0 / float(slope))
    return parts


def _level_at(hertz: float, over_static: bool) -> Figure:
    """Return ln|H| at a frequency, over the static gain or not."""
    place = np.array([hertz])
    return lambda at: float(
        np.log(np.abs(at.response(place)[0])) - (np.log(abs(at.static_gain)) if over_static else 0.0)
    )


def _share_at(hertz: float) -> Figure:
    """Return the part of H in phase with H(0), over it, at a frequency."""
    place = np.array([hertz])
    return lambda at: float(at.response(place)[0].real / at.static_gain)


def _slope_at(hertz: float) -> Figure:
    """Return d ln|H|/dω at a frequency."""
    place = np.array([hertz])
    return lambda at: float(log_slope(at.system, place)[0])


def _over_time(model: ModalModel, found: Transient) -> dict[str, _Smooth]:
    """Return what stands for overshoot and rise time."""
    parts = {}
    if found.highest_s is not None:
        highest = np.array([found.highest_s])
        parts["overshoot"] = _Smooth(lambda at: float(at.step(highest)[0] / at.static_gain))
    if found.passing_s is not None:
        passing = np.array(found.passing_s)
        slope = model.impulse(passing) / model.static_gain
        if np.all(slope > 0):
            parts["rise_s"] = _Smooth(lambda at: float(-np.diff(at.step(passing) / at.static_gain / slope)[0]))
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
