"""The filter against cross-talk: outputs to loads, as direct taps and a bank of poles, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape


@dataclass(frozen=True)
class FilterState:
    """What a filter keeps between blocks: the last inputs (L, C) and what its poles hold (N,)."""

    inputs: FloatArray
    poles: ComplexArray


@dataclass(frozen=True)
class DecouplingFilter:
    """Loads `components` (D,) from outputs `channels` (C,) in `unit`, sampled at `sample_rate_hz`.

    f[n] = Σ_k `taps`[k]·y[n - k] + Re Σ_i `shown`[:, i]·x_i[n - L], x_i[n + 1] = `poles`[i]·x_i[n] + `driven`[i]·y[n],
    L = `delay`: taps (L + 1, D, C), poles (N,) within the unit circle, one of each conjugate pair, driven (N, C), shown
    (D, N). The loads come L samples late, with the dynamics of one oscillator each: `target_hz`, `target_damping` (D,).
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
        outputs, loads, count = len(self.channels), len(self.components), len(self.poles)
        check_shape("taps", self.taps, (None, loads, outputs))
        check_shape("poles", self.poles, (count,))
        check_shape("driven", self.driven, (count, outputs))
        check_shape("shown", self.shown, (loads, count))
        check_shape("target_hz", self.target_hz, (loads,))
        check_shape("target_damping", self.target_damping, (loads,))
        if np.any(np.abs(self.poles) >= 1.0):
            raise ValueError(f"poles: expected within the unit circle, found {np.abs(self.poles).max():.9g}")

    @property
    def delay(self) -> int:
        """By how many samples the loads are late."""
        return len(self.taps) - 1

    def rest(self, outputs: FloatArray | None = None) -> FilterState:
        """Return the state of a filter whose inputs have been constant (C,) for long, zero where not stated."""
        level = np.zeros(len(self.channels)) if outputs is None else np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", level, (len(self.channels),))
        return FilterState(np.tile(level, (self.delay, 1)), self.driven @ level / (1.0 - self.poles))

    def process(self, outputs: FloatArray, state: FilterState) -> tuple[FloatArray, FilterState]:
        """Return the loads (N, D) of the next outputs (N, C), and the state to go on with.

        Sums run in a fixed order sample by sample, so that blocks of any length give the same bits as one record.
        """
        from scipy.signal import lfilter

        values = np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", values, (None, len(self.channels)))
        if not len(values):
            return np.zeros((0, len(self.components))), state
        whole = np.concatenate([state.inputs, values]).T.copy()
        count, delay = len(values), self.delay
        found = np.zeros((len(self.components), count))
        for k, tap in enumerate(self.taps):
            for c, column in enumerate(tap.T):
                for d, weight in enumerate(column):
                    found[d] += weight * whole[c, delay - k : delay - k + count]
        held = np.empty_like(state.poles)
        for i, pole in enumerate(self.poles):
            drive = _weighted(self.driven[i], whole[:, :count])
            answer, held[i : i + 1] = lfilter([0.0, 1.0], [1.0, -pole], drive, zi=state.poles[i : i + 1])
            real, imag = answer.real.copy(), answer.imag.copy()
            for d, weight in enumerate(self.shown[:, i]):
                found[d] += weight.real * real - weight.imag * imag
        return found.T.copy(), FilterState(whole[:, count:].T.copy(), held)

    def apply(self, outputs: FloatArray) -> FloatArray:
        """Return the loads (N, D) of a whole record (N, C) that begins at rest at its first sample."""
        return self.process(outputs, self.rest(np.asarray(outputs)[0]))[0]

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the loads over the outputs (K, D, C) at frequencies (K,) in Hz."""
        z = np.exp(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64) / self.sample_rate_hz)
        found = np.einsum("kl,ldc->kdc", z[:, None] ** -np.arange(len(self.taps)), self.taps)
        for sign in (1, -1):
            poles, driven, shown = (
                part if sign > 0 else part.conj() for part in (self.poles, self.driven, self.shown / 2.0)
            )
            basis = z[:, None] ** -self.delay / (z[:, None] - poles)
            found = found + np.einsum("kn,dn,nc->kdc", basis, shown, driven, optimize=True)
        return np.asarray(found)

    def target(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the wanted dynamics (K, D) with the delay: ω²/(s² + 2ζωs + ω²)·exp(-sL/fs)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        omega = 2 * np.pi * self.target_hz
        late = np.exp(-s * self.delay / self.sample_rate_hz)
        return np.asarray(omega**2 / (s**2 + 2 * self.target_damping * omega * s + omega**2) * late)

    def noise(self, outputs: FloatArray) -> FloatArray:
        """Return standard deviations (D,) of the loads for white noise of standard deviations (C,) of the outputs."""
        spread = np.asarray(outputs, dtype=np.float64)
        check_shape("outputs", spread, (len(self.channels),))
        power = np.einsum("ldc,c->d", self.taps**2, spread**2)
        poles = np.concatenate([self.poles, self.poles.conj()])
        driven = np.concatenate([self.driven, self.driven.conj()]) * spread
        shown = np.concatenate([self.shown, self.shown.conj()], axis=1) / 2.0
        among = (driven @ driven.conj().T) / (1.0 - np.outer(poles, poles.conj()))
        return np.asarray(np.sqrt(power + np.real(np.einsum("dn,nm,dm->d", shown, among, shown.conj()))))


def _weighted(weights: ComplexArray, rows: FloatArray) -> ComplexArray:
    """Σ weights·rows in the order of the rows, real and imaginary part apart."""
    real, imag = np.zeros(rows.shape[1]), np.zeros(rows.shape[1])
    for weight, row in zip(weights, rows, strict=True):
        real += weight.real * row
        imag += weight.imag * row
    return real + 1j * imag
