"""Model of several outputs and loads with common poles, its state space, separable loads."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel, modal_poles
from shaker.model_notices import GROWING_POLE
from shaker.release.load_response import exponentials
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray, check_shape
from shakercal._common.notices import Notice

# Common poles of outputs and loads.


@dataclass(frozen=True, repr=False, eq=False)
class Poles(Arrays):
    """Common poles: `frequency_hz` and `damping_ratio` (M,) of the modes, `real_hz` (Q,).

    Instances are compared by identity.
    """

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    real_hz: FloatArray

    @property
    def modes(self) -> int:
        """Number of modes."""
        return len(self.frequency_hz)

    @property
    def count(self) -> int:
        """Number of parameters, also that of the columns of a design."""
        return 2 * self.modes + len(self.real_hz)

    @property
    def vector(self) -> FloatArray:
        """All parameters: frequencies, damping ratios, logarithms of the real poles."""
        return np.concatenate([self.frequency_hz, self.damping_ratio, np.log(self.real_hz)])

    def with_vector(self, vector: FloatArray) -> Poles:
        """Return the poles for other parameters."""
        f, z, log_hz = np.split(vector[: self.count], [self.modes, 2 * self.modes])
        return Poles(f, z, np.exp(np.clip(log_hz, -50.0, 50.0)))

    @property
    def scale(self) -> FloatArray:
        """Significant change of every parameter."""
        return np.concatenate([1e-2 * self.frequency_hz, np.full(self.modes, 1e-2), np.full(len(self.real_hz), 0.5)])

    @cached_property
    def slopes(self) -> tuple[IntArray, ComplexArray]:
        """Pole (2M + Q,) that every parameter changes, and the derivative."""
        m, omega, zeta = self.modes, 2 * np.pi * self.frequency_hz, self.damping_ratio
        root = np.sqrt(1 - zeta**2)
        by_frequency, by_damping = 2 * np.pi * (-zeta + 1j * root), omega * (-1.0 - 1j * zeta / root)
        indices = np.concatenate([np.arange(m), np.arange(m + len(self.real_hz))])
        return indices, np.concatenate([by_frequency, by_damping, self.values[m:]])

    def basis(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the columns (K, 2M + Q) of Re and Im residues, then real ones."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        upper, real = np.split(self.values, [self.modes])
        above, below = 1 / (s - upper), 1 / (s - upper.conj())
        return np.concatenate([above + below, 1j * (above - below), 1 / (s - real)], axis=1)

    def response_slopes(self, frequency_hz: FloatArray, residues: ComplexArray) -> ComplexArray:
        """Return derivatives (…, K, 2M + Q) of Σ R/(s - p) by the parameters."""
        s, (which, slope) = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None], self.slopes
        direct = (slope * residues[..., which])[..., None, :]
        mirrored = np.where(which < self.modes, direct.conj(), 0.0)
        return np.asarray(direct / (s - self.values[which]) ** 2 + mirrored / (s - self.values[which].conj()) ** 2)

    @property
    def allowed(self) -> bool:
        """Whether the modes oscillate and decay, as those of a sensor do."""
        damped = np.all((self.damping_ratio > 0.0) & (self.damping_ratio < 0.7))
        return bool(damped and np.all(self.frequency_hz > 0) and np.all(self.real_hz > 0))

    @cached_property
    def values(self) -> ComplexArray:
        """Poles in rad/s, those of the modes first."""
        return modal_poles(2 * np.pi * self.frequency_hz, self.damping_ratio, 2 * np.pi * self.real_hz)

    def with_mode(self, pole: complex) -> Poles:
        """Return the poles with one additional mode."""
        f, z = abs(pole) / (2 * np.pi), np.append(self.damping_ratio, -pole.real / abs(pole))
        return Poles(np.append(self.frequency_hz, f), np.clip(z, 1e-4, 0.9), self.real_hz)

    def with_real(self, hz: float) -> Poles:
        """Return the poles with one additional real pole."""
        return replace(self, real_hz=np.append(self.real_hz, hz))

    def without(self, index: int) -> Poles:
        """Return the poles without one; real poles are counted after the modes."""
        if index < self.modes:
            return Poles(np.delete(self.frequency_hz, index), np.delete(self.damping_ratio, index), self.real_hz)
        return replace(self, real_hz=np.delete(self.real_hz, index - self.modes))

    @cached_property
    def smooth(self) -> FloatArray:
        """Basis (2M + Q, 2M - 1) of outputs with a smooth start.

        Σ R·p^k = 0, k = 0 … Q.
        """
        return np.asarray(np.linalg.qr(self._moments()[0], mode="complete")[0][:, len(self.real_hz) + 1 :])

    @cached_property
    def smooth_slopes(self) -> FloatArray:
        """Derivatives (2M + Q, 2M + Q, 2M - 1) of `smooth`, -G·(GᵀG)⁻¹·dGᵀ·S."""
        moments, slopes = self._moments()
        inverse = np.linalg.pinv(moments).T
        return np.asarray(-inverse @ (np.transpose(slopes, (0, 2, 1)) @ self.smooth))

    def _moments(self) -> tuple[FloatArray, FloatArray]:
        """Return the matrix of Σ R·p^k (2M + Q, Q + 1) and its derivatives."""
        m, values = self.modes, self.values
        unit = float(np.abs(values).max())
        k = np.arange(len(self.real_hz) + 1)
        power = (values[:, None] / unit) ** k
        grows = k * (values[:, None] / unit) ** np.maximum(k - 1, 0) / unit
        moments = np.concatenate([2 * power[:m].real, -2 * power[:m].imag, power[m:].real])
        slopes = np.zeros((self.count, *moments.shape))
        for i, (index, slope) in enumerate(zip(*self.slopes, strict=True)):
            change = slope * grows[index]
            if index < m:
                slopes[i, index], slopes[i, m + index] = 2 * change.real, -2 * change.imag
            else:
                slopes[i, m + index] = change.real
        return moments, slopes

    def columns(self, index: int) -> list[int]:
        """Return the columns of a design that belong to one pole."""
        return [index, index + self.modes] if index < self.modes else [index + self.modes]


# System with several outputs and loads as a sum of common modes.

Names: TypeAlias = tuple[str, ...]


@dataclass(frozen=True, repr=False)
class ModelParts(Arrays):
    """Numbers arranged as the parameters of a `MultiModel`."""

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray


@dataclass(frozen=True, repr=False)
class MultiModel(
    Arrays,
    shapes="channels C; components D; frequency_hz M; damping_ratio M; real_hz Q; residue M C D; real_residue Q C D",
):
    """Transfer matrix of outputs `channels` (C,) over loads `components` (D,) with common poles.

    H(s) = Σ_m [R_m/(s - p_m) + R̄_m/(s - p̄_m)] + Σ_q R_q/(s - p_q) with p_m = -ζω + jω√(1 - ζ²), ω = 2π·`frequency_hz`
    (M,), ζ = `damping_ratio` (M,) and p_q = -2π·`real_hz` (Q,). Residue matrices `residue` (M, C, D) complex,
    `real_residue` (Q, C, D), in `unit` per N or N·m and second. `covariance` (P, P), P = (2M + Q)(1 + CD), of `vector`
    = [frequency_hz, damping_ratio, real_hz, then for each load and each of its outputs: Re residue (M), Im residue (M),
    real_residue (Q)].
    """

    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(self.vector),) * 2)
        if np.any(np.abs(self.damping_ratio) >= 1.0):
            raise ValueError(f"damping_ratio: expected below 1, found {self.damping_ratio.tolist()}")

    @property
    def shared(self) -> int:
        """Number 2M + Q of parameters of the poles, and of each element."""
        return 2 * len(self.frequency_hz) + len(self.real_hz)

    @staticmethod
    def of_poles(poles: Poles, table: FloatArray, names: tuple[Names, Names], unit: str) -> MultiModel:
        """Return the model of coefficients (2M + Q, C, D); refuse inseparable loads."""
        re, im, real = np.split(table, [poles.modes, 2 * poles.modes])
        modes = poles.frequency_hz, poles.damping_ratio
        model = MultiModel(*names, unit, *modes, re + 1j * im, poles.real_hz, real)
        check_separable(model.static_gain, *names)
        return model

    @property
    def table(self) -> FloatArray:
        """Coefficients (2M + Q, C, D) of `Poles.basis`."""
        return np.concatenate([self.residue.real, self.residue.imag, self.real_residue])

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        residues = np.transpose(self.table, (2, 1, 0)).ravel()
        return np.concatenate([self.frequency_hz, self.damping_ratio, self.real_hz, residues])

    def parts(self, vector: FloatArray) -> ModelParts:
        """Return numbers in the order of `vector`, such as uncertainties, arranged as the parameters."""
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        f, z, hz, residues = np.split(np.asarray(vector), np.cumsum([modes, modes, reals]))
        table = residues.reshape(len(self.components), len(self.channels), self.shared).transpose(2, 1, 0)
        re, im, real = np.split(table, [modes, 2 * modes])
        return ModelParts(f, z, re + 1j * im, hz, real.copy())

    def with_vector(self, vector: FloatArray) -> MultiModel:
        """Return the model of another vector (P,), with the same covariance."""
        return replace(self, **vars(self.parts(vector)))

    @property
    def poles(self) -> ComplexArray:
        """Poles in rad/s: the upper ones of the modes (M,), then the real ones (Q,)."""
        return self.common_poles.values

    @property
    def common_poles(self) -> Poles:
        """The poles with their parameters."""
        return Poles(self.frequency_hz, self.damping_ratio, self.real_hz)

    @property
    def stable(self) -> bool:
        """Whether every pole decays."""
        return bool(np.all(self.poles.real < 0))

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K, C, D) at frequencies (K,) in Hz."""
        return np.asarray(np.einsum("kn,ncd->kcd", self.common_poles.basis(frequency_hz), self.table))

    @property
    def static_gain(self) -> FloatArray:
        """H(0) (C, D), the static sensitivity matrix."""
        return np.asarray(self.response(np.zeros(1))[0].real)

    def step(self, time_s: FloatArray) -> FloatArray:
        """Return the responses (N, C, D) to a unit step of each load."""
        rings = exponentials(self.poles, np.maximum(np.asarray(time_s, dtype=np.float64), 0.0)) - 1.0
        upper, real = np.split(rings / self.poles[:, None], [len(self.frequency_hz)])
        swing = 2.0 * np.tensordot(upper.real, self.residue.real, (0, 0))
        swing -= 2.0 * np.tensordot(upper.imag, self.residue.imag, (0, 0))
        return np.asarray(swing + np.tensordot(real.real, self.real_residue, (0, 0)))

    def altered(self, frequency: float = 0.0, damping_ratio: float = 0.0, gain: float = 0.0) -> MultiModel:
        """Return the model with every element changed as in `shaker.lti.system.ModalModel.altered`."""
        residue, real_residue = self.residue.copy(), self.real_residue.copy()
        f, z = (1.0 + frequency) * self.frequency_hz, (1.0 + damping_ratio) * self.damping_ratio
        for c, d in np.ndindex(len(self.channels), len(self.components)):
            element_parts = self.residue[:, c, d], self.real_hz, self.real_residue[:, c, d]
            element = ModalModel(self.frequency_hz, self.damping_ratio, *element_parts)
            element = element.altered(frequency, damping_ratio, gain)
            residue[:, c, d], real_residue[:, c, d] = element.residue, element.real_residue
        return replace(self, frequency_hz=f, damping_ratio=z, residue=residue, real_residue=real_residue)

    @property
    def u(self) -> ModelParts:
        """Standard uncertainties of all parameters, separately for Re and Im of a residue."""
        if self.covariance is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        return self.parts(np.sqrt(np.diag(self.covariance)))

    def column_sensitivity(self, component: int, frequency_hz: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return ∂H_{·j} (K, C, P_j) by poles and a load's residues, and their covariance."""
        if self.covariance is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        n, outputs, common = self.shared, len(self.channels), self.common_poles
        slope = np.zeros((len(frequency_hz), outputs, n * (1 + outputs)), dtype=np.complex128)
        residues = np.concatenate([self.residue[:, :, component], self.real_residue[:, :, component]]).T
        unit = np.concatenate([np.ones(2 * common.modes), 1.0 / self.real_hz])  # of poles in Hz, not in logarithms
        slope[:, :, :n] = common.response_slopes(frequency_hz, residues).transpose(1, 0, 2) * unit
        for c in range(outputs):
            slope[:, c, n * (1 + c) : n * (2 + c)] = common.basis(frequency_hz)
        rows = n + n * outputs * component + np.arange(n * outputs)
        indices = np.concatenate([np.arange(n), rows])
        return slope, np.asarray(self.covariance[np.ix_(indices, indices)])


def growing_pole_notices(model: MultiModel) -> list[Notice]:
    """Return a notice on the fastest growing pole, if there is one."""
    if model.stable:
        return []
    pole = model.poles[np.argmax(model.poles.real)]
    return [Notice(GROWING_POLE, "model", frequency_hz=abs(pole) / (2.0 * np.pi))]


# Sampled sum of modes, for loads that are linear between samples.

_NO_SHAPE = 1e-9  # relative singular value of a residue matrix that is rounding


@dataclass(frozen=True, repr=False)
class StateSpace(Arrays):
    """x[n+1] = a·x[n] + b·u[n], y[n] = c·x[n] + d·u[n]."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray


def sampled_modes(
    poles: ComplexArray, residues: Sequence[ComplexArray | FloatArray], sample_rate_hz: float
) -> StateSpace:
    """Return Σ R/(s - p) sampled, poles (P,) in rad/s, residues (C, D) each.

    Conjugates are included. Exact for loads that are linear between samples (triangle hold). Each residue matrix has as
    many states as its rank, scaled to unit size under white loads.
    """
    from scipy.linalg import block_diag

    parts = [_pole(pole, residue, 1.0 / sample_rate_hz) for pole, residue in zip(poles, residues, strict=True)]
    b, c = np.concatenate([part.b for part in parts]), np.concatenate([part.c for part in parts], axis=1)
    return StateSpace(block_diag(*(part.a for part in parts)), b, c, np.sum([part.d for part in parts], axis=0))


def _pole(pole: complex, residue: ComplexArray | FloatArray, step_s: float) -> StateSpace:
    """Return one pole, a complex one with its conjugate.

    ξ[n+1] = E ξ[n] + (α + Eβ) g[n], response ξ + βg: E = e^x, x = pΔ, α + β = Δ(E - 1)/x, β = Δ(E - 1 - x)/x².
    """
    left, size, right = np.linalg.svd(residue, full_matrices=False)
    rank = max(1, int(np.count_nonzero(size > _NO_SHAPE * size[0])))
    x = pole * step_s
    turn, beta = np.exp(x), step_s * (np.expm1(x) - x) / x**2
    alpha = step_s * np.expm1(x) / x - beta
    drive = (alpha + turn * beta) * right[:rank]
    shown = left[:, :rank] * size[:rank]
    spread = np.linalg.norm(drive, axis=1) / np.sqrt(max(1e-12, 1.0 - abs(turn) ** 2))
    drive, seen = drive / spread[:, None], shown * spread
    direct = (shown * beta) @ right[:rank]
    if pole.imag == 0.0:
        return StateSpace(turn.real * np.eye(rank), drive.real, seen.real, direct.real)
    unit = np.eye(rank)
    a = np.block([[turn.real * unit, -turn.imag * unit], [turn.imag * unit, turn.real * unit]])
    b = np.concatenate([drive.real, drive.imag])
    return StateSpace(a, b, np.concatenate([2 * seen.real, -2 * seen.imag], axis=1), 2 * direct.real)


# Excited loads, and loads that the outputs distinguish.

_SEPARATE = 1e-3  # smallest singular value of the matrix of unit columns


def sort_components(components: Iterable[str]) -> tuple[str, ...]:
    """Return the different load components, Fx first."""
    named = set(components)
    standard = [name for name in LOAD_COMPONENTS if name in named]
    return (*standard, *sorted(named.difference(standard)))


def missing_loads(
    channels: Sequence[str], components: Sequence[str], static_sensitivity: FloatArray | None = None
) -> tuple[str, ...]:
    """Return the loads that a sensor measures without an excitation.

    It measures those that its outputs are named after, and those with a non-zero column of `static_sensitivity` (C, 6).
    """
    named = {name for name in LOAD_COMPONENTS if name in channels}
    if static_sensitivity is not None:
        named |= {name for name, column in zip(LOAD_COMPONENTS, static_sensitivity.T, strict=True) if np.any(column)}
    return tuple(name for name in LOAD_COMPONENTS if name in named and name not in components)


def check_separable(static_gain: FloatArray, channels: Sequence[str], components: Sequence[str]) -> None:
    """Raise `ValueError` for loads (named) that the outputs do not distinguish."""
    if len(channels) < len(components):
        raise ValueError(
            f"channels: expected at least as many as loads, {len(components)} ({', '.join(components)}), "
            f"found {len(channels)}"
        )
    size = np.linalg.norm(static_gain, axis=0)
    silent = [name for name, value in zip(components, size, strict=True) if not value > 0]
    if silent:
        raise ValueError(f"components: expected loads that move an output, found none for {', '.join(silent)}")
    _, singular, right = np.linalg.svd(static_gain / size)
    if singular[-1] < _SEPARATE:
        mixed = [name for name, share in zip(components, np.abs(right[-1]), strict=True) if share > 0.3]
        raise ValueError(
            f"components: expected loads that the outputs distinguish, found {' and '.join(mixed)} in one direction"
        )
