"""Decoupling filter against cross-talk, and the cross-talk before and after it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.random import Generator

from shaker.decoupling.model import MultiModel, Poles, StateSpace, sampled_modes
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape

# Decoupling filter: outputs to loads, as taps and a bank of poles, block by block.


@dataclass(frozen=True, repr=False)
class FilterState(Arrays):
    """Last inputs (L, C) and states of the poles (N,) between blocks."""

    inputs: FloatArray
    poles: ComplexArray


@dataclass(frozen=True, repr=False)
class DecouplingFilter(
    Arrays,
    shapes="channels C; components D; poles N; taps L D C; driven N C; shown D N; target_hz D; target_damping D",
):
    """Filter for loads `components` (D,) from outputs `channels` (C,) in `unit`, at `sample_rate_hz`.

    f[n] = Σ_k `taps`[k]·y[n - k] + Re Σ_i `shown`[:, i]·x_i[n - L], x_i[n + 1] = `poles`[i]·x_i[n] + `driven`[i]·y[n],
    L = `delay`. Taps (L + 1, D, C); poles (N,) within the unit circle, one of each conjugate pair; driven (N, C); shown
    (D, N). The loads are delayed by L samples and have the dynamics of one oscillator each: `target_hz`,
    `target_damping` (D,).
    """

    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    sample_rate_hz: float
    taps: FloatArray
    poles: ComplexArray
    driven: ComplexArray
    shown: ComplexArray
    target_hz: FloatArray
    target_damping: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.abs(self.poles) >= 1.0):
            raise ValueError(f"poles: expected within the unit circle, found {np.abs(self.poles).max():.9g}")

    @property
    def delay(self) -> int:
        """Delay of the loads in samples."""
        return len(self.taps) - 1

    def rest(self, outputs: FloatArray | None = None) -> FilterState:
        """Return the state after constant inputs (C,), default zero."""
        level = np.zeros(len(self.channels)) if outputs is None else np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", level, (len(self.channels),))
        return FilterState(np.tile(level, (self.delay, 1)), self.driven @ level / (1.0 - self.poles))

    def process(self, outputs: FloatArray, state: FilterState) -> tuple[FloatArray, FilterState]:
        """Return the loads (N, D) of the next outputs (N, C), and the new state.

        Sums have a fixed order, so that blocks of any length give the same bits.
        """
        from scipy.signal import lfilter

        values = np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", values, (None, len(self.channels)))
        if not len(values):
            return np.zeros((0, len(self.components))), state
        whole = np.concatenate([state.inputs, values]).T.copy()
        count, delay = len(values), self.delay
        loads = np.zeros((len(self.components), count))
        for k, tap in enumerate(self.taps):
            for c, column in enumerate(tap.T):
                for d, weight in enumerate(column):
                    loads[d] += weight * whole[c, delay - k : delay - k + count]
        states = np.empty_like(state.poles)
        for i, pole in enumerate(self.poles):
            drive = np.zeros(count, dtype=np.complex128)
            for weight, row in zip(self.driven[i], whole[:, :count], strict=True):
                drive.real += weight.real * row
                drive.imag += weight.imag * row
            answer, states[i : i + 1] = lfilter([0.0, 1.0], [1.0, -pole], drive, zi=state.poles[i : i + 1])
            real, imag = answer.real.copy(), answer.imag.copy()
            for d, weight in enumerate(self.shown[:, i]):
                loads[d] += weight.real * real - weight.imag * imag
        return loads.T.copy(), FilterState(whole[:, count:].T.copy(), states)

    def impulse_response(self, count: int) -> FloatArray:
        """Return the loads (N, D, C) for a unit impulse of each output."""
        rings = np.zeros((count, len(self.poles)), dtype=np.complex128)
        rings[self.delay + 1 :] = self.poles ** np.arange(max(0, count - self.delay - 1))[:, None]
        pairs = self.shown.T[:, :, None] * self.driven[:, None, :]
        loads = np.tensordot(rings.real, pairs.real, 1) - np.tensordot(rings.imag, pairs.imag, 1)
        loads[: len(self.taps)] += self.taps[:count]
        return np.asarray(loads)

    def apply(self, outputs: FloatArray) -> FloatArray:
        """Return the loads (N, D) of a whole record (N, C) that starts at rest."""
        return self.process(outputs, self.rest(np.asarray(outputs)[0]))[0]

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the loads over the outputs (K, D, C) at frequencies (K,) in Hz."""
        z = np.exp(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64) / self.sample_rate_hz)
        response = np.einsum("kl,ldc->kdc", z[:, None] ** -np.arange(len(self.taps)), self.taps)
        for sign in (1, -1):
            poles, driven, shown = (
                part if sign > 0 else part.conj() for part in (self.poles, self.driven, self.shown / 2.0)
            )
            basis = z[:, None] ** -self.delay / (z[:, None] - poles)
            response = response + np.einsum("kn,dn,nc->kdc", basis, shown, driven, optimize=True)
        return np.asarray(response)

    def target(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the target dynamics (K, D) with the delay: ω²/(s² + 2ζωs + ω²)·exp(-sL/fs)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        omega = 2 * np.pi * self.target_hz
        late = np.exp(-s * self.delay / self.sample_rate_hz)
        return np.asarray(omega**2 / (s**2 + 2 * self.target_damping * omega * s + omega**2) * late)

    def noise(self, outputs: FloatArray) -> FloatArray:
        """Return standard deviations (D,) of the loads for white noise (C,) of the outputs."""
        spread = np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", spread, (len(self.channels),))
        power = np.einsum("ldc,c->d", self.taps**2, spread**2)
        poles = np.concatenate([self.poles, self.poles.conj()])
        driven = np.concatenate([self.driven, self.driven.conj()]) * spread
        shown = np.concatenate([self.shown, self.shown.conj()], axis=1) / 2.0
        gram = (driven @ driven.conj().T) / (1.0 - np.outer(poles, poles.conj()))
        return np.asarray(np.sqrt(power + np.real(np.einsum("dn,nm,dm->d", shown, gram, shown.conj()))))


# Design of the decoupling filter: the best estimate of the loads with target dynamics.

_DELAYS = 32  # samples, longest delay that is tried
_GAIN_LEFT = 2.0  # error of a short delay over that of the longest
_SMALL = 1e-2  # error over the load that is sufficient
_STATE_NOISE = (0.0, 1e-12, 1e-10, 1e-8)  # trial variances of further noise, over the mean of the driven states
_REAL = 1e-9  # relative imaginary part of a real pole


@dataclass(frozen=True, repr=False)
class DecouplingTarget(Arrays, shapes="frequency_hz D; damping_ratio D"):
    """One oscillator with static gain 1 as target of every load (D,)."""

    frequency_hz: FloatArray
    damping_ratio: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(self.frequency_hz <= 0):
            raise ValueError(f"frequency_hz: expected above 0, found {self.frequency_hz.tolist()}")
        if np.any((self.damping_ratio <= 0) | (self.damping_ratio >= 1)):
            raise ValueError(f"damping_ratio: expected between 0 and 1, found {self.damping_ratio.tolist()}")


@dataclass(frozen=True, repr=False)
class SignalLevels(Arrays):
    """Noise and loads for which a filter is designed.

    `noise` (C,): of a sample of the outputs at `sample_rate_hz`. `load` (D,): standard deviation of a sample of a white
    load. Their ratio determines the bandwidth of the filter beyond the resonances.
    """

    sample_rate_hz: float
    noise: FloatArray
    load: FloatArray


def design_decoupling(
    model: MultiModel, target: DecouplingTarget, recorded: SignalLevels, delay: int | None = None
) -> DecouplingFilter:
    """Design the stable filter D that brings D·H closest to the delayed target T.

    Parameters
    ----------
    model
        stable model of C outputs over D loads
    target
        target dynamics of the D loads
    recorded
        sampling rate, noise of the outputs and size of the loads
    delay
        samples, default None: the shortest of up to 32 with an error within twice that of the longest, or below 1 %

    Returns
    -------
    DecouplingFilter : stable filter with exact static gain

    Raises
    ------
    ValueError : a pole of the model grows

    Notes
    -----
    An inverse of H would grow without bound above the resonances, and in time if H has zeros in the right half plane.
    Instead the mean square of T·f - D·(H·f + noise) is minimised for white loads f. This is the steady Kalman filter of
    the states of H and T, which share their load, with smoothing over `delay` samples (Anderson and Moore, Optimal
    Filtering, 1979, chapters 4 and 7). It is stable for every H. D·H = T if the load is far above the noise and H has
    no such zeros. The static gain is then made exact.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import design_decoupling
    >>> from shaker.decoupling.filter import DecouplingTarget, SignalLevels
    >>> from shaker.decoupling.model import MultiModel
    >>> loads, residue = ("Fx", "Fy"), -1j * np.array([[[200.0, 9.0], [5.0, 3.0]], [[2.0, 4.0], [-6.0, 190.0]]])
    >>> modes = np.array([310.0, 400.0]), np.array([0.02, 0.015])
    >>> model = MultiModel(loads, loads, "V", *modes, residue, np.zeros(0), np.zeros((0, 2, 2)))
    >>> recorded = SignalLevels(10e3, noise=np.full(2, 1e-3), load=np.full(2, 10.0))
    >>> decoupler = design_decoupling(model, DecouplingTarget(np.full(2, 300.0), np.full(2, 0.7)), recorded)
    >>> print(np.abs(decoupler.response(np.zeros(1))[0].real @ model.static_gain).round(6))
    [[1. 0.]
     [0. 1.]]
    """
    if not model.stable:
        raise ValueError("model: expected decaying poles, found a growing one")
    check_shape("frequency_hz", target.frequency_hz, (len(model.components),))
    shape, rate = recorded.load / recorded.noise[:, None], recorded.sample_rate_hz
    plant = sampled_modes(model.poles, [residue * shape for residue in (*model.residue, *model.real_residue)], rate)
    omega, upper = 2 * np.pi * target.frequency_hz, Poles(target.frequency_hz, target.damping_ratio, np.zeros(0)).values
    units = enumerate(np.eye(len(omega)))
    residues = [np.outer(unit, unit) * omega[i] ** 2 / (2j * upper[i].imag) for i, unit in units]
    desired = sampled_modes(upper, residues, rate)  # per size of the loads, as the plant's outputs per noise
    gains = _smoother(plant, desired, _DELAYS if delay is None else delay)
    error = np.sqrt(np.maximum(gains.left, 0.0))
    near = np.all(error <= np.maximum(_GAIN_LEFT * error[-1], _SMALL * np.sqrt(gains.size)), axis=1)
    lag = int(np.flatnonzero(near)[0]) if delay is None else delay
    raw = _assembled(model, target, recorded, gains, lag)
    mend = np.linalg.inv(raw.response(np.zeros(1))[0].real @ model.static_gain)
    return replace(raw, taps=np.asarray(np.einsum("de,lec->ldc", mend, raw.taps)), shown=mend @ raw.shown)


@dataclass(frozen=True, repr=False)
class _KalmanGains(Arrays):
    """The steady Kalman filter in units of noise and loads.

    x⁺ = m·x + k·y with innovations y - c·x. gains[i]: of the innovation i samples after the load. `left` (L + 1, D):
    mean square error of every load by delay. `size` (D,): mean square of the load with the target dynamics.
    """

    m: FloatArray
    k: FloatArray
    c: FloatArray
    readout: FloatArray
    gains: FloatArray
    left: FloatArray
    size: FloatArray


def _smoother(plant: StateSpace, desired: StateSpace, delay: int) -> _KalmanGains:
    """Return the steady Kalman filter of both systems with smoothing, in unit sizes."""
    from scipy.linalg import block_diag, solve_discrete_lyapunov

    a, b = block_diag(plant.a, desired.a), np.concatenate([plant.b, desired.b])
    c = np.concatenate([plant.c, np.zeros((len(plant.c), len(desired.a)))], axis=1)
    shown = np.concatenate([np.zeros((len(desired.c), len(plant.a))), desired.c], axis=1)
    r, s = np.eye(len(c)) + plant.d @ plant.d.T, b @ plant.d.T
    p = _steady_covariance(a, b, c, (r, s))
    spread = c @ p @ c.T + r
    k = np.linalg.solve(spread, (a @ p @ c.T + s).T).T
    m = a - k @ c
    first = shown @ p @ c.T + desired.d @ plant.d.T
    along = shown @ p @ m.T + desired.d @ (b - k @ plant.d).T
    together = [first]
    for _ in range(delay):
        together.append(along @ c.T)
        along = along @ m.T
    gains = np.array([np.linalg.solve(spread, part.T).T for part in together])
    before = np.diag(shown @ p @ shown.T + desired.d @ desired.d.T)
    shares = [np.einsum("dc,dc->d", gain, part) for gain, part in zip(gains, together, strict=True)]
    explained = np.cumsum(shares, axis=0)
    moved = solve_discrete_lyapunov(desired.a, desired.b @ desired.b.T)
    size = np.diag(desired.c @ moved @ desired.c.T + desired.d @ desired.d.T)
    return _KalmanGains(m, k, c, shown, gains, before - explained, size)


def _steady_covariance(a: FloatArray, b: FloatArray, c: FloatArray, noise: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the covariance of the predicted states.

    States that the loads hardly drive make the equation ill-conditioned; they then get a small noise of their own.
    """
    from scipy.linalg import solve_discrete_are

    drive, (r, s) = b @ b.T, noise
    for share in _STATE_NOISE:
        with suppress(ValueError, np.linalg.LinAlgError):
            added = share * np.trace(drive) / len(a) * np.eye(len(a))
            return np.asarray(solve_discrete_are(a.T, c.T, drive + added, r, s=s))
    raise ValueError("model: expected poles and residues of which a steady filter can be computed, found others")


def _assembled(
    model: MultiModel, target: DecouplingTarget, recorded: SignalLevels, kalman: _KalmanGains, lag: int
) -> DecouplingFilter:
    """Return the filter as taps and poles.

    Innovations up to the delay are expressed by outputs and the previous state: f(t) = z·x(t) + Σ_i G_i (y(t + i) -
    c·x(t + i)), x(t + i) = mⁱ x(t) + Σ_{l < i} m^{i - 1 - l} k y(t + l).
    """
    outputs, loads = kalman.c.shape[0], len(kalman.readout)
    taps, shown = np.zeros((lag + 1, loads, outputs)), kalman.readout.copy()
    powers = [np.eye(len(kalman.m))]
    for _ in range(lag):
        powers.append(kalman.m @ powers[-1])
    for i in range(lag + 1):
        taps[lag - i] += kalman.gains[i]
        shown = shown - kalman.gains[i] @ kalman.c @ powers[i]
        for early in range(i):
            taps[lag - early] -= kalman.gains[i] @ kalman.c @ powers[i - 1 - early] @ kalman.k
    poles, vectors = np.linalg.eig(kalman.m)
    driven, seen = np.linalg.solve(vectors, kalman.k.astype(np.complex128)), shown @ vectors
    upper = poles.imag > -_REAL * np.abs(poles)
    double = np.where(poles[upper].imag > _REAL * np.abs(poles[upper]), 2.0, 1.0)
    return DecouplingFilter(
        channels=model.channels,
        components=model.components,
        unit=model.unit,
        sample_rate_hz=recorded.sample_rate_hz,
        taps=taps * recorded.load[:, None] / recorded.noise,
        poles=poles[upper].astype(np.complex128),
        driven=driven[upper] / recorded.noise,
        shown=seen[:, upper] * double * recorded.load[:, None],
        target_hz=target.frequency_hz,
        target_damping=target.damping_ratio,
    )


# Cross-talk without correction, with the static matrix, and after the filter.

Reader: TypeAlias = FloatArray | DecouplingFilter
_DECAYS = 5.0  # time constants of the slowest mode
_LONGEST = 20000  # samples of a step response
_SHORTENED = 0.05  # share of a sampled deviation, within the linear range
_ROOM = 0.5  # largest relative change of a pole by it


@dataclass(frozen=True, repr=False)
class Crosstalk(Arrays):
    """Loads read over loads applied at one stage.

    In N or N·m per N or N·m. `stage`: "raw" (each load by the output of its name over its sensitivity), "static"
    (inverse of the static matrix), "filtered". `value` (K, D, D) complex at `frequency_hz` (K,): reading i for load j,
    with standard uncertainty `u` (K, D, D) of its modulus by the model. `peak` (D, D): largest |reading| i during a
    unit step of load j, with `u_peak`.
    """

    stage: str
    components: tuple[str, ...]
    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray
    peak: FloatArray
    u_peak: FloatArray


def static_inverse(model: MultiModel, noise: FloatArray) -> FloatArray:
    """Return the matrix (D, C) from outputs to loads at rest, by weighted least squares."""
    weight = 1.0 / noise
    return np.asarray(np.linalg.pinv(weight[:, None] * model.static_gain) * weight)


def raw_reading(model: MultiModel) -> FloatArray | None:
    """Return the matrix (D, C) that reads each load from one output.

    The output has the name of the load, else the load moves it most. None if two loads share an output.
    """
    static = model.static_gain
    size = np.abs(static) / np.linalg.norm(static, axis=1, keepdims=True)
    mains = [
        model.channels.index(name) if name in model.channels else int(np.argmax(size[:, d]))
        for d, name in enumerate(model.components)
    ]
    if len(set(mains)) < len(mains):
        return None
    reading, loads = np.zeros(static.T.shape), np.arange(len(mains))
    reading[loads, mains] = 1.0 / static[mains, loads]
    return reading


def stage_readers(model: MultiModel, decoupler: DecouplingFilter, noise: FloatArray) -> dict[str, Reader]:
    """Return the readers of the possible stages: matrices (D, C), and the filter."""
    raw, static = raw_reading(model), static_inverse(model, noise)
    return {**({} if raw is None else {"raw": raw}), "static": static, "filtered": decoupler}


def crosstalks(
    model: MultiModel,
    decoupler: DecouplingFilter,
    noise: FloatArray,
    frequency_hz: FloatArray,
    rng: Generator,
    draws: int,
) -> tuple[Crosstalk, ...]:
    """Return the cross-talk at every possible stage.

    Readers and filter are those of the model; its covariance shows the possible deviation of the sensor: over frequency
    to first order, for the peaks by the slope towards `draws` sampled models, extrapolated from models nearby, in which
    outputs are linear.
    """
    if model.covariance is None:
        raise ValueError("model: expected one with covariance, found none")
    time_s, response, stages = step_times(model, decoupler), model.response(frequency_hz), []
    changes = rng.standard_normal((draws, len(model.vector))) @ _root(model.covariance).T
    shares = [_share_within_range(model, change) for change in changes]
    near = [
        model.with_vector(model.vector + share * change).step(time_s)
        for share, change in zip(shares, changes, strict=True)
    ]
    steps = model.step(time_s)
    for stage, reader in stage_readers(model, decoupler, noise).items():
        shown = (
            reader.response(frequency_hz)
            if isinstance(reader, DecouplingFilter)
            else reader[None].astype(np.complex128)
        )
        reads = _reads(reader, len(time_s))
        readings = reads(steps)
        peak = np.max(np.abs(readings), axis=0)
        moved = [readings + (reads(one) - readings) / share for share, one in zip(shares, near, strict=True)]
        spread = np.mean([(np.max(np.abs(other), axis=0) - peak) ** 2 for other in moved], axis=0)
        value, u, u_peak = shown @ response, _u(model, shown, frequency_hz), np.sqrt(spread) * _known(model)
        stages.append(Crosstalk(stage, model.components, frequency_hz, value, u, peak, np.asarray(u_peak)))
    return tuple(stages)


def _share_within_range(model: MultiModel, change: FloatArray) -> float:
    """Return the share of a sampled change with which every pole still decays."""
    f, z, hz = (np.abs(part) for part in (model.frequency_hz, model.damping_ratio, model.real_hz))
    room = np.concatenate([f, np.minimum(z, 1.0 - z), hz])
    largest = float(np.max(np.abs(change[: len(room)]) / room))
    return min(_SHORTENED, _ROOM / max(largest, _ROOM))


def step_readings(model: MultiModel, reader: Reader, time_s: FloatArray) -> FloatArray:
    """Return the loads read (N, D, D) for unit steps of each load."""
    return _reads(reader, len(time_s))(model.step(time_s))


def step_times(model: MultiModel, decoupler: DecouplingFilter) -> FloatArray:
    """Return the times of samples from a step until the slowest mode has decayed."""
    slowest = float(np.min(-model.poles.real))
    count = min(_LONGEST, int(_DECAYS / slowest * decoupler.sample_rate_hz) + 20 * (decoupler.delay + 1))
    return np.arange(count) / decoupler.sample_rate_hz


def _u(model: MultiModel, shown: ComplexArray, frequency_hz: FloatArray) -> FloatArray:
    """Return the standard uncertainty of every reading, averaged over directions in the complex plane."""
    columns = []
    for load in range(len(model.components)):
        slope, covariance = model.column_sensitivity(load, frequency_hz)
        columns.append(np.linalg.norm(shown @ slope @ _root(covariance), axis=2) / np.sqrt(2.0))
    return np.stack(columns, axis=2) * _known(model)


def _known(model: MultiModel) -> float:
    """Return 1, or NaN for a model without uncertainties because its records refute it."""
    return 1.0 if np.all(np.isfinite(np.asarray(model.covariance))) else np.nan


def _root(covariance: FloatArray) -> FloatArray:
    """Return the Cholesky root of a mended covariance: unique, so that samples are reproducible.

    A model that its records refute has a root of zeros, and `_known` makes its uncertainties NaN.
    """
    if not np.all(np.isfinite(covariance)):
        return np.zeros_like(covariance)
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    value, vector = np.linalg.eigh(covariance / np.outer(size, size))
    mended = (vector * np.maximum(value, 1e-12)) @ vector.T
    return np.asarray(np.linalg.cholesky(mended * np.outer(size, size)))


def _reads(reader: Reader, count: int) -> Callable[[FloatArray], FloatArray]:
    """Return a function from outputs (N, C, D) to readings (N, D, D)."""
    if not isinstance(reader, DecouplingFilter):
        return lambda outputs: np.asarray(reader @ outputs)
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(2 * count, real=True)
    kernel = rfft(reader.impulse_response(count), size, axis=0)
    return lambda outputs: np.asarray(irfft(kernel @ rfft(outputs, size, axis=0), size, axis=0)[:count])
