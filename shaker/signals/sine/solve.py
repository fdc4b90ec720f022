"""Linear parameters eliminated, frequencies and decay rates by Gauss-Newton (variable projection)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.signals.folding import condition_number
from shaker.signals.sine.dense import check_condition
from shaker.signals.sine.normal import Columns, Normal, Samples, Tones, as_complex, normal_equations

_STEPS = 40
_CONVERGED = 1e-3  # of the standard uncertainty: the last step is taken on the exact residual
_STANDS = 1e-9  # rad: a step that turns the ends of the record by less is the last, too
_FARTHEST = 2.0  # rad by which one step may turn the ends of the record against its middle
_ROUNDING = 1e-14  # of a channel's power: below it, differences of sums are rounding
_SINGULAR = 1e-12


@dataclass(frozen=True)
class SineModel:
    """What is fitted beside amplitudes, phases and an offset.

    `drift`: a linear drift. `free`: a label per line; the frequencies of lines with the same label share one relative
    change, as harmonics do and everything made by one generator; -1 for a known frequency, None for all known.
    `decay`: lines decay as exp(-δt), all at one rate or each at its own.
    """

    drift: bool = False
    free: tuple[int, ...] | None = None
    decay: Literal["none", "common", "each"] = "none"

    def exponents(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivative (K, Q) of the exponents s = -δ + jω by the Q unknowns: relative frequencies, then δ."""
        lines = len(frequency_hz)
        labels = np.full(lines, -1) if self.free is None else np.asarray(self.free)
        if labels.shape != (lines,):
            raise ValueError(f"free: expected {lines} labels, one per line, found {len(labels)}")
        groups = [(labels == label) * (2j * np.pi * frequency_hz) for label in np.unique(labels[labels >= 0])]
        decays = {"none": [], "common": [-np.ones(lines)], "each": list(-np.eye(lines))}[self.decay]
        return np.array([*groups, *decays], dtype=np.complex128).reshape(-1, lines).T


@dataclass(frozen=True)
class System:
    """Normal equations solved for the linear parameters.

    `gram` (D, D, P', P') of all columns, D = 1 where all channels have the same weights, else C; `inverse` (D, P, P)
    for the P linear ones; `project` (D, P', 2K) combines columns to slopes that the linear ones cannot imitate;
    `condition` of the linear columns at unit length.
    """

    gram: FloatArray
    inverse: FloatArray
    project: FloatArray
    condition: float

    @property
    def linear(self) -> int:
        """Number of linear parameters."""
        return int(self.inverse.shape[1])

    def coefficients(self, right: FloatArray) -> FloatArray:
        """Return the linear parameters (P, C) of right-hand sides (P', C)."""
        return _products(self.inverse, right[: self.linear])

    def slopes(self, right: FloatArray) -> FloatArray:
        """Return the projected slopes' products (2K, C) with the values."""
        return _products(self.project.swapaxes(1, 2), right)

    def information(self) -> FloatArray:
        """Return the products (D, D, 2K, 2K) of the projected slopes of one channel with those of another."""
        return np.asarray(self.project.swapaxes(1, 2)[:, None] @ self.gram @ self.project[None])

    def own_information(self) -> FloatArray:
        """Return the products (D, 2K, 2K) of each channel's projected slopes with themselves."""
        own = np.einsum("ddpq->dpq", self.gram)
        return np.asarray(self.project.swapaxes(1, 2) @ own @ self.project)

    def spread(self) -> FloatArray:
        """Return G⁻¹·XᵀX·G⁻¹ (D, D, P, P): the linear parameters' covariance between channels for unit noise."""
        gram = self.gram[:, :, : self.linear, : self.linear]
        return np.asarray(self.inverse[:, None] @ gram @ self.inverse[None])


def _products(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return the products (N, C) of one matrix (1, N, M), or of each channel's own (C, N, M), with columns (M, C)."""
    if len(matrices) == 1:
        return np.asarray(matrices[0] @ right)
    return np.asarray((matrices @ right.T[:, :, None])[:, :, 0].T)


def solved(normal: Normal, columns: Columns) -> System:
    """Invert the normal equations of the linear columns, scaled to unit length."""
    lines, linear = len(columns.tones.frequency_hz), columns.linear
    own = np.einsum("ddpq->dpq", normal.gram)
    squares = np.einsum("dpp->dp", own)[:, :linear].copy()
    pairs = squares[:, : 2 * lines].reshape(len(own), lines, 2)
    # Both columns of a line by the same factor: at zero or the Nyquist frequency one of them vanishes, and must.
    squares[:, : 2 * lines] = np.repeat(pairs.mean(axis=2), 2, axis=1)
    scale = 1.0 / np.sqrt(squares)
    scaled = own[:, :linear, :linear] * scale[:, :, None] * scale[:, None, :]
    condition = max(condition_number(matrix) for matrix in scaled)
    check_condition(condition)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    inverse = (inverse + inverse.swapaxes(1, 2)) / 2.0
    carried = -inverse @ own[:, :linear, linear:]
    rest = np.broadcast_to(np.eye(own.shape[1] - linear), (len(own), own.shape[1] - linear, own.shape[1] - linear))
    return System(normal.gram, inverse, np.concatenate([carried, rest], axis=1), condition)


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step: `change` (Q,) of the unknowns, `inverse` (Q, Q) of the Hessian.

    `derivative` (C, 2K, Q): of the slopes' coefficients in each channel; `pull`: the same over its noise variance.
    """

    change: FloatArray
    inverse: FloatArray
    derivative: FloatArray
    pull: FloatArray


def frequency_step(
    system: System, right: FloatArray, value: ComplexArray, exponents: ComplexArray, variance: FloatArray
) -> Step:
    """Return the step of frequencies and decay rates from products `right` (P', C) with values or residuals.

    Gauss-Newton on the nonlinear unknowns alone, the linear ones projected out (variable projection; Golub and Pereyra
    1973, with Kaufman's simplification). Channels weigh by their noise variance (C,).
    """
    product = value.T[:, :, None] * exponents[None]
    derivative = np.stack([product.real, product.imag], axis=2).reshape(len(variance), -1, exponents.shape[1])
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
    pull = derivative * weight[:, None, None]
    hessian = np.sum(pull.swapaxes(1, 2) @ system.own_information() @ derivative, axis=0)
    size = np.sqrt(hessian.diagonal())
    scaled = hessian / np.multiply.outer(size, size) if np.all(size > 0.0) else np.zeros_like(hessian)
    if not np.linalg.eigvalsh(scaled)[0] > _SINGULAR:
        raise ValueError("frequency_hz: expected lines whose frequencies and decays the record tells, found none")
    inverse = np.linalg.inv(scaled) / np.multiply.outer(size, size)
    gradient = np.einsum("ckq,kc->q", pull, system.slopes(right))
    return Step(inverse @ gradient, inverse, derivative, pull)


def moved(tones: Tones, exponents: ComplexArray, change: FloatArray) -> Tones:
    """Return the lines after a step of the unknowns."""
    exponent = exponents @ change
    return Tones(tones.frequency_hz + exponent.imag / (2.0 * np.pi), tones.decay_per_s - exponent.real)


def _turn(exponent_change: ComplexArray, value: ComplexArray) -> float:
    """Return the rate at which a change of the exponents (K,) turns the lines (K, C), in rad/s, rms by their power."""
    power = np.sum(np.abs(value) ** 2, axis=1)
    return float(np.sqrt(power @ np.abs(exponent_change) ** 2 / np.sum(power))) if power.any() else 0.0


def estimate(samples: Samples, frequency_hz: FloatArray, model: SineModel) -> tuple[Columns, System, FloatArray]:
    """Return columns, normal equations and linear parameters (P, C), frequencies and decays within 1/1000 of their u.

    One pass over the data where frequencies are known and nothing decays, else one per step.
    """
    exponents = model.exponents(frequency_hz)
    count = exponents.shape[1]
    tones = Tones(np.array(frequency_hz, dtype=np.float64), np.zeros(len(frequency_hz)))
    columns = Columns(tones, model.drift, count > 0)
    half_s = float(np.max(np.abs(samples.timeline.centre_s))) + float(np.max(np.abs(samples.timeline.local_s)))
    for _ in range(_STEPS):
        normal = normal_equations(samples, columns)
        system = solved(normal, columns)
        coefficients = system.coefficients(normal.right)
        if not count:
            return columns, system, coefficients
        left = normal.power - np.einsum("pc,pc->c", coefficients, normal.right[: system.linear])
        variance = np.maximum(left, _ROUNDING * normal.power) / samples.timeline.samples
        value = as_complex(coefficients, len(frequency_hz))
        step = frequency_step(system, normal.right, value, exponents, variance)
        turn = half_s * _turn(exponents @ step.change, value)
        if turn <= _STANDS or np.all(np.abs(step.change) <= _CONVERGED * np.sqrt(step.inverse.diagonal())):
            return columns, system, coefficients
        shorter = min(1.0, _FARTHEST / turn) if turn > 0.0 else 1.0
        columns = replace(columns, tones=moved(columns.tones, exponents, shorter * step.change))
    listed = ", ".join(f"{f:.6g}" for f in frequency_hz)
    raise ValueError(f"frequency_hz: expected frequencies from which the fit converges, found {listed} Hz")
