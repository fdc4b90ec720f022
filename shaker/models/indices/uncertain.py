"""Standard uncertainties of the indices of an identified model.

A figure is where a smooth function of frequency or time passes a level or turns. Its change with the parameters is that
of the function at the fixed place, over the function's slope there; so no place is searched for again. Where the gain
just touches a band's limit the slope goes to nothing and the uncertainty, rightly, without bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.frequency import log_slope
from shaker.models.indices.indices import indices
from shaker.models.indices.result import LABELS, Indices, UncertainIndices
from shaker.models.indices.transient import Transient, settling_points, transient
from shaker.models.linear_system import LinearSystem
from shaker.models.modal import ModalModel

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
