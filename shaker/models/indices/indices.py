"""The indices of a system."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.frequency import band_end, gain_curve, half_power, peak, places_rad, quadrature
from shaker.models.indices.remarks import remarks
from shaker.models.indices.result import Indices, Mode
from shaker.models.indices.transient import transient
from shaker.models.linear_system import LinearSystem


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
