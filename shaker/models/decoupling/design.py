"""Design of the filter against cross-talk: the load that explains the outputs best, with wanted dynamics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.decoupling.filter import DecouplingFilter
from shaker.models.decoupling.model import MultiModel
from shaker.models.decoupling.state_space import StateSpace, sampled_modes

_DELAYS = 32
_GAIN_LEFT = 2.0
_SMALL = 1e-2
_REAL = 1e-9


@dataclass(frozen=True)
class Target:
    """Wanted dynamics of every load: `frequency_hz` and `damping_ratio` of one oscillator each (D,), static gain 1."""

    frequency_hz: FloatArray
    damping_ratio: FloatArray

    def __post_init__(self) -> None:
        check_shape("damping_ratio", self.damping_ratio, self.frequency_hz.shape)
        if np.any(self.frequency_hz <= 0):
            raise ValueError(f"frequency_hz: expected above 0, found {self.frequency_hz.tolist()}")
        if np.any((self.damping_ratio <= 0) | (self.damping_ratio >= 1)):
            raise ValueError(f"damping_ratio: expected between 0 and 1, found {self.damping_ratio.tolist()}")


@dataclass(frozen=True)
class Recorded:
    """What a filter is designed for: noise (C,) of a sample of the outputs at `sample_rate_hz`, and loads (D,): the
    standard deviation of a sample of a white one. Their ratio rules how far the filter goes beyond the resonances."""

    sample_rate_hz: float
    noise: FloatArray
    load: FloatArray


def design_decoupling(
    model: MultiModel, target: Target, recorded: Recorded, delay: int | None = None
) -> DecouplingFilter:
    """Return the stable filter D that brings D·H closest to the target T, delayed by `delay` samples.

    An inverse of H grows without bound above the resonances, and grows in time where H has zeros in the right half
    plane. Instead the mean square of T·f - D·(H·f + noise) is made least for white loads f: the steady Kalman filter of
    the states of H and T, which share their load, with smoothing over `delay` samples (Anderson and Moore, Optimal
    Filtering, 1979, chapters 4 and 7). It is stable whatever H is, and where the load stands clear of the noise and H
    has no such zeros D·H = T. Its static gain is then made exact. By default the delay is the shortest of up to 32
    samples whose error is within twice that of the longest, or below 1 % of the load, for every load.
    """
    if not model.stable:
        raise ValueError("model: expected one whose poles all decay, found one that grows")
    check_shape("frequency_hz", target.frequency_hz, (len(model.components),))
    plant, wanted = _scaled(model, target, recorded)
    gains = _smoother(plant, wanted, _DELAYS if delay is None else delay)
    lag = _shortest(gains) if delay is None else delay
    return _assembled(model, target, recorded, gains, lag)


@dataclass(frozen=True)
class _Gains:
    """The steady filter in units of noise and loads: x⁺ = m·x + k·y, innovations y - c·x, gains[i] of the innovation i
    samples after the load, `left` (L + 1, D): mean square error of every load by delay; `size` (D,): mean
    square of the load with the wanted dynamics."""

    m: FloatArray
    k: FloatArray
    c: FloatArray
    wanted: FloatArray
    gains: FloatArray
    left: FloatArray
    size: FloatArray


def _scaled(model: MultiModel, target: Target, recorded: Recorded) -> tuple[StateSpace, StateSpace]:
    """Outputs over their noise, and wanted loads, from the loads over their size."""
    shape = recorded.load / recorded.noise[:, None]
    poles = model.poles
    residues = [residue * shape for residue in (*model.residue, *model.real_residue)]
    omega, zeta = 2 * np.pi * target.frequency_hz, target.damping_ratio
    upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    own = [np.outer(unit, unit) * omega[i] ** 2 / (2j * upper[i].imag) for i, unit in enumerate(np.eye(len(omega)))]
    rate = recorded.sample_rate_hz
    return sampled_modes(poles, residues, rate), sampled_modes(upper, own, rate)


def _smoother(plant: StateSpace, wanted: StateSpace, delay: int) -> _Gains:
    """Steady Kalman filter of both systems with the gains of smoothing over a delay; loads and noise of unit size."""
    from scipy.linalg import block_diag, solve_discrete_are, solve_discrete_lyapunov

    a, b = block_diag(plant.a, wanted.a), np.concatenate([plant.b, wanted.b])
    c = np.concatenate([plant.c, np.zeros((len(plant.c), len(wanted.a)))], axis=1)
    shown = np.concatenate([np.zeros((len(wanted.c), len(plant.a))), wanted.c], axis=1)
    r, s = np.eye(len(c)) + plant.d @ plant.d.T, b @ plant.d.T
    p = solve_discrete_are(a.T, c.T, b @ b.T, r, s=s)
    spread = c @ p @ c.T + r
    k = np.linalg.solve(spread, (a @ p @ c.T + s).T).T
    m = a - k @ c
    first = shown @ p @ c.T + wanted.d @ plant.d.T
    along = shown @ p @ m.T + wanted.d @ (b - k @ plant.d).T
    together = [first]
    for _ in range(delay):
        together.append(along @ c.T)
        along = along @ m.T
    gains = np.array([np.linalg.solve(spread, part.T).T for part in together])
    before = np.diag(shown @ p @ shown.T + wanted.d @ wanted.d.T)
    told = np.cumsum([np.einsum("dc,dc->d", gain, part) for gain, part in zip(gains, together, strict=True)], axis=0)
    moved = solve_discrete_lyapunov(wanted.a, wanted.b @ wanted.b.T)
    size = np.diag(wanted.c @ moved @ wanted.c.T + wanted.d @ wanted.d.T)
    return _Gains(m, k, c, shown, gains, before - told, size)


def _shortest(gains: _Gains) -> int:
    """The shortest delay whose root mean square error is small, or near that of the longest, for every load."""
    error = np.sqrt(np.maximum(gains.left, 0.0))
    near = np.all(error <= np.maximum(_GAIN_LEFT * error[-1], _SMALL * np.sqrt(gains.size)), axis=1)
    return int(np.flatnonzero(near)[0])


def _assembled(model: MultiModel, target: Target, recorded: Recorded, found: _Gains, lag: int) -> DecouplingFilter:
    """The filter as taps and poles: innovations up to the delay are written as outputs and the state before them.

    f(t) = z·x(t) + Σ_i G_i (y(t + i) - c·x(t + i)), x(t + i) = mⁱ x(t) + Σ_{l < i} m^{i - 1 - l} k y(t + l).
    """
    outputs, loads = found.c.shape[0], len(found.wanted)
    taps, shown = np.zeros((lag + 1, loads, outputs)), found.wanted.copy()
    powers = [np.eye(len(found.m))]
    for _ in range(lag):
        powers.append(found.m @ powers[-1])
    for i in range(lag + 1):
        taps[lag - i] += found.gains[i]
        shown = shown - found.gains[i] @ found.c @ powers[i]
        for early in range(i):
            taps[lag - early] -= found.gains[i] @ found.c @ powers[i - 1 - early] @ found.k
    poles, vectors = np.linalg.eig(found.m)
    driven, seen = np.linalg.solve(vectors, found.k.astype(np.complex128)), shown @ vectors
    kept = poles.imag > -_REAL * np.abs(poles)
    double = np.where(poles[kept].imag > _REAL * np.abs(poles[kept]), 2.0, 1.0)
    raw = DecouplingFilter(
        channels=model.channels,
        components=model.components,
        unit=model.unit,
        sample_rate_hz=recorded.sample_rate_hz,
        taps=taps * recorded.load[:, None] / recorded.noise,
        poles=poles[kept].astype(np.complex128),
        driven=driven[kept] / recorded.noise,
        shown=seen[:, kept] * double * recorded.load[:, None],
        target_hz=target.frequency_hz,
        target_damping=target.damping_ratio,
    )
    return _exact_at_rest(raw, model)


def _exact_at_rest(raw: DecouplingFilter, model: MultiModel) -> DecouplingFilter:
    """The filter times the matrix that makes D(0)·H(0) one."""
    static = raw.response(np.zeros(1))[0].real @ model.static_gain
    mend = np.linalg.inv(static)
    return replace(raw, taps=np.asarray(np.einsum("de,lec->ldc", mend, raw.taps)), shown=mend @ raw.shown)
