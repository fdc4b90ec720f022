"""What a pole answers to a release that takes its time."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray


def pole_responses(poles: ComplexArray, time_s: FloatArray, onset_s: float, release_s: float) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, to a load that grows from 0 to 1, at `time_s` (N,).

    The load is clip((t - onset)/T, 0, 1) with T = `release_s` ≥ 0, a step for T = 0. With τ = t - onset: before the end
    of the ramp [(exp(pτ) - 1)/p - τ]/(pT); after it [exp(p(τ - T))·(exp(pT) - 1)/(pT) - 1]/p; zero before the onset.
    """
    p = np.asarray(poles, dtype=np.complex128)
    if release_s < 0:
        raise ValueError(f"release_s: expected 0 or more, found {release_s}")
    tau = np.asarray(time_s, dtype=np.float64)[:, None] - onset_s
    during = (tau > 0) & (tau < release_s)
    after = (tau > 0) & ~during
    found = np.zeros((len(tau), len(p)), dtype=np.complex128)
    late, early = tau[after[:, 0]], tau[during[:, 0]]
    spread = np.expm1(p * release_s) / (p * release_s) if release_s > 0 else np.ones_like(p)
    found[after[:, 0]] = (np.exp(p * (late - release_s)) * spread - 1.0) / p
    if early.size:
        found[during[:, 0]] = (np.expm1(p * early) / p - early) / (p * release_s)
    return found
