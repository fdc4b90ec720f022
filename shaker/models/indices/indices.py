"""The indices of a system, and of an identified model with their uncertainties."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.frequency import band_end, gain_curve, half_power, peak, places_rad, quadrature
from shaker.models.indices.remarks import remarks
from shaker.models.indices.result import LABELS, Indices, Mode, UncertainIndices
from shaker.models.indices.transient import settling_points, transient
from shaker.models.linear_system import LinearSystem
from shaker.models.modal import ModalModel


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
        None if top is None or not usable else top[1] / abs(static),
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


def indices_with_u(
    model: ModalModel, nominal_gain: float = 1.0, sample_rate_hz: float | None = None
) -> UncertainIndices:
    """Return the figures of an identified model with standard uncertainties from its covariance.

    A figure that is there at the model's parameters and missing close by has no uncertainty.
    """

    def values(at: ModalModel) -> FloatArray:
        figures = indices(at.system, nominal_gain).figures()
        return np.array([np.nan if value is None else value for value in figures.values()])

    found = indices(model.system, nominal_gain, sample_rate_hz)
    u = dict(zip(LABELS, np.sqrt(np.diag(model.propagate(values)[1])), strict=True))
    for name, tolerance in (("settling_5_s", 0.05), ("settling_2_s", 0.02)):
        u[name] = settling_u(model, tolerance)
    return UncertainIndices(found, {name: float(value) if np.isfinite(value) else None for name, value in u.items()})


def settling_u(model: ModalModel, tolerance: float) -> float:
    """Return the standard uncertainty in s of a settling time, NaN where there is none.

    Two parts: the crossing moves by u of the response over its slope; and it jumps to the next turning point, half a
    period away, where one that is just outside comes to be inside, or the other way: variance (half period)²·P(1 - P)
    with the probability P of that.
    """
    from scipy.stats import norm

    points = settling_points(model.system, tolerance)
    if points is None:
        return float("nan")

    def ratio(at: ModalModel) -> FloatArray:
        return np.asarray(at.step(points) / at.static_gain)

    value, covariance = model.propagate(ratio)
    u = np.sqrt(np.diag(covariance))
    slope = abs(model.impulse(points[:1])[0] / model.static_gain)
    jump = norm.sf(np.abs(np.abs(value[1:] - 1) - tolerance) / u[1:])
    return float(np.hypot(u[0] / slope, (points[2] - points[1]) * np.sqrt(np.sum(jump * (1 - jump)))))
