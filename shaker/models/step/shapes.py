"""Shapes of a release: how the load goes, and what poles answer."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.basis import pole_responses
from shaker.models.step.reading import Shape


def load_share(shape: Shape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the share (N,) of the load's change at `time_s` (N,): 0 before `onset_s`, 1 from its end on.

    In between, with x = (t - onset)/T: x of a "ramp", (1 - cos πx)/2 of a "smooth" release.
    """
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.asarray((tau > 0).astype(np.float64))
    x = np.clip(tau / release_s, 0.0, 1.0)
    return np.asarray(x if shape == "ramp" else 0.5 * (1.0 - np.cos(np.pi * x)))


def load_rate(shape: Shape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the derivative (N,) of `load_share` in 1/s, 0 of a step."""
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.zeros(len(tau))
    during = (tau > 0) & (tau < release_s)
    rate = 1.0 if shape == "ramp" else 0.5 * np.pi * np.sin(np.pi * tau / release_s)
    return np.asarray(np.where(during, rate, 0.0) / release_s)


def shape_responses(
    shape: Shape, poles: ComplexArray, time_s: FloatArray, onset_s: float, release_s: float
) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, at `time_s` (N,), to a load of a shape.

    "step" and "ramp" as in `pole_responses`. "smooth": with ω = π/T and τ = t - onset, until the end
    [(exp(pτ) - 1)/p - (p(exp(pτ) - cos ωτ) + ω sin ωτ)/(p² + ω²)]/2; then the free motion from there under full load.
    """
    if shape == "measured":
        raise ValueError('shape: expected "step", "ramp" or "smooth", found "measured"')
    if shape != "smooth" or release_s <= 0.0:
        return pole_responses(poles, time_s, onset_s, 0.0 if shape == "step" else release_s)
    p = np.asarray(poles, dtype=np.complex128)
    tau = np.asarray(time_s, dtype=np.float64)[:, None] - onset_s
    omega = np.pi / release_s
    found = np.zeros((len(tau), len(p)), dtype=np.complex128)
    during = (tau[:, 0] > 0) & (tau[:, 0] < release_s)
    after = tau[:, 0] >= release_s
    early, late = tau[during], tau[after] - release_s
    swing = p * (np.exp(p * early) - np.cos(omega * early)) + omega * np.sin(omega * early)
    found[during] = 0.5 * (np.expm1(p * early) / p - swing / (p**2 + omega**2))
    end = 0.5 * (np.expm1(p * release_s) / p - p * (np.exp(p * release_s) + 1.0) / (p**2 + omega**2))
    found[after] = end * np.exp(p * late) + np.expm1(p * late) / p
    return found


def force_responses(poles: ComplexArray, force: FloatArray, sample_rate_hz: float) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, from rest, to a measured load (N,).

    Between samples the load is a straight line, for which the recursion is exact:
    x[n+1] = z·x[n] + (u[n]·(z - 1 - w) + u[n+1]·w)/p with z = exp(pΔ) and w = (z - 1)/(pΔ) - 1.
    """
    from scipy.signal import lfilter

    p = np.asarray(poles, dtype=np.complex128)
    u = np.asarray(force, dtype=np.float64)
    step = 1.0 / sample_rate_hz
    found = np.zeros((len(u), len(p)), dtype=np.complex128)
    for place, pole in enumerate(p):
        grown = np.expm1(pole * step)
        new = grown / (pole * step) - 1.0
        drive = (u[:-1] * (grown - new) + u[1:] * new) / pole
        found[1:, place] = lfilter([1.0], [1.0, -np.exp(pole * step)], drive)
    return found
