"""The indices of a system, and of an identified model with their uncertainties."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.frequency import band_end, gain_curve, half_power, peak, places_rad, quadrature
from shaker.models.indices.remarks import remarks
from shaker.models.indices.result import LABELS, Indices, Mode, UncertainIndices
from shaker.models.indices.transient import transient
from shaker.models.linear_system import LinearSystem
from shaker.models.modal import ModalModel

SETTLING_STEP = 1.0
"""Standard uncertainties over which the settling times are differentiated: they change in steps of half a period."""


def indices(system: LinearSystem, nominal_gain: float = 1.0) -> Indices:
    """Return all figures of a system, continuous or sampled; `nominal_gain` is what its gain should be.

    A sampled system's poles are ln(z)·fs, its gain that on the unit circle, its times those of samples.
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
        *bands,
        passing.overshoot,
        passing.rise_s,
        passing.settling_2_s,
        passing.settling_5_s,
        remarks(system),
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


def indices_with_u(model: ModalModel, nominal_gain: float = 1.0) -> UncertainIndices:
    """Return the figures of an identified model with standard uncertainties from its covariance.

    Settling times jump by half a period where an oscillation just reaches the tolerance: they are differentiated over a
    standard uncertainty of each parameter to either side.
    """

    def values(at: ModalModel) -> FloatArray:
        figures = indices(at.system, nominal_gain).figures()
        return np.array([np.nan if value is None else value for value in figures.values()])

    smooth = np.sqrt(np.diag(model.propagate(values)[1]))
    rough = np.sqrt(np.diag(model.propagate(values, SETTLING_STEP)[1]))
    found = {}
    for name, fine, coarse in zip(LABELS, smooth, rough, strict=True):
        u = max(fine, coarse) if name.startswith("settling") else fine
        found[name] = float(u) if np.isfinite(u) else None
    return UncertainIndices(indices(model.system, nominal_gain), found)
