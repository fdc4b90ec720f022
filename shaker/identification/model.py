"""A linear structure as its responses: mechanics, rational functions, and the result of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, Notice, check_shape
from shaker.identification.measured import MeasuredTransfer, ParameterEstimate

# Poles of measured curves from a linear rational fit: where an identification starts.


_ROUNDS = 8
_SIGNIFICANT = 30.0  # decrease of χ² per real number by which a pole is more than a feature of the noise
_SETTLED = 1e-4  # change of the denominator's coefficients that no longer moves a start


def measured_poles(record: MeasuredTransfer, count: int) -> ComplexArray:
    """Return `count` poles (Im λ > 0, ascending |λ|) of the common denominator of all responses of a recording.

    Ratios are fitted by polynomials Nᶜ(s)/D(s) of degree 2·count, linearised (Levy, IRE Trans. Autom. Control 4, 1959)
    and weighted anew in rounds (Sanathanan and Koerner, IEEE Trans. Autom. Control 8, 1963). Unstable poles are
    mirrored; in place of real ones stand poles above the band.
    """
    value, s = record.ratio.value, record.s
    middle = float(np.sqrt(np.abs(s).min() * np.abs(s).max()))
    q = s / middle
    noise = np.sqrt(record.ratio.u_re**2 + record.ratio.u_im**2)
    power = q[:, None] ** np.arange(2 * count)
    top = np.concatenate([power, q[:, None] ** (2 * count)], axis=1)
    weight = 1.0 / noise
    denominator = np.zeros(2 * count)
    for _ in range(_ROUNDS):
        before, denominator = denominator, _round(value, power, top, q ** (2 * count), weight)
        at = np.abs(q ** (2 * count) + power @ denominator)
        if np.abs(denominator - before).max() < _SETTLED:
            break
        weight = 1.0 / (noise * np.maximum(at, 1e-9 * at.max())[:, None])
    roots = np.roots([1.0, *denominator[::-1]])
    roots = -np.abs(roots.real) + 1j * roots.imag
    found = roots[roots.imag > 1e-9 * np.abs(roots)] * middle
    above = float(np.abs(s).max()) * 2.0 ** np.arange(1, count - len(found) + 1) * (-0.02 + 1j)
    return np.concatenate([found[np.argsort(np.abs(found))], above])


def significant_poles(record: MeasuredTransfer, poles: ComplexArray) -> ComplexArray:
    """Return those of some poles without which a sum of partial fractions explains the ratios clearly worse.

    Basis: 1/(s - λ) and 1/(s - λ*) of each pole, 1, s and s², for each response by itself.
    """
    if len(poles) < 2:
        return poles
    value, s = record.ratio.value, record.s
    noise = np.sqrt(0.5 * (record.ratio.u_re**2 + record.ratio.u_im**2))
    unit = float(np.abs(s).max())
    smooth = (s[:, None] / unit) ** np.arange(3)
    fractions = [np.stack([unit / (s - pole), unit / (s - pole.conjugate())], axis=1) for pole in poles]
    kept = []
    every = _misfit(np.concatenate([*fractions, smooth], axis=1), value, noise)
    for place in range(len(poles)):
        others = [*fractions[:place], *fractions[place + 1 :], smooth]
        lost = _misfit(np.concatenate(others, axis=1), value, noise) - every
        kept.append(lost > _SIGNIFICANT * 4.0 * value.shape[1])
    return np.asarray(poles[np.array(kept)])


def _misfit(columns: ComplexArray, value: ComplexArray, noise: FloatArray) -> float:
    """Return χ² of the best sums of columns (K, B) for values (K, C), each with its own coefficients."""
    total = 0.0
    for c in range(value.shape[1]):
        basis, right = columns / noise[:, c, None], value[:, c] / noise[:, c]
        basis = np.linalg.qr(basis)[0]
        rest = right - basis @ (basis.conj().T @ right)
        total += float(np.sum(np.abs(rest) ** 2))
    return total


def _round(
    value: ComplexArray, power: ComplexArray, top: ComplexArray, highest: ComplexArray, weight: FloatArray
) -> FloatArray:
    """Return the denominator's coefficients of one weighted linear fit, numerators projected out of each response."""
    left, right = [], []
    for c in range(value.shape[1]):
        w = weight[:, c, None]
        own, shared = _stacked(top * w), _stacked(-value[:, c, None] * power * w)
        wanted = _stacked((value[:, c] * highest)[:, None] * w)
        basis = np.linalg.qr(own)[0]
        rest = np.concatenate([shared, wanted], axis=1)
        rest = rest - basis @ (basis.T @ rest)
        left.append(rest[:, :-1])
        right.append(rest[:, -1])
    return np.asarray(np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0])


def _stacked(columns: ComplexArray) -> FloatArray:
    """Return complex columns as real ones, real parts above imaginary ones."""
    return np.concatenate([columns.real, columns.imag])


# Second-order mechanics of one recording, linear in its parameters: response, derivatives, modes.


@dataclass(frozen=True)
class Parameter:
    """One number of a structure: `name` for files, e.g. "stiffness_z", `label` for readers, `unit`."""

    name: str
    label: str
    unit: str


@dataclass(frozen=True)
class Mechanics:
    """What moves on a base in one recording: (M s² + B s + K) p = -s² f.

    p (n,) is the motion relative to the base per unit of the base's motion; M, B, K and f are weighted sums with the
    weights [1, θ (P), z (E)]: constant part, parameters, numbers of the load in their standard deviations.
    `matrices` (1+P+E, 3, n, n): M, B and K, symmetric, of each term; `forcing` (1+P+E, n): f of each term.
    Response c reads `offset` (C,) + `rows` (C, n) · p; the reference `reference_offset` + `reference` (n,) · p.
    """

    matrices: FloatArray
    forcing: FloatArray
    rows: FloatArray
    offset: FloatArray
    reference: FloatArray
    reference_offset: float

    def __post_init__(self) -> None:
        terms, size = self.forcing.shape
        check_shape("matrices", self.matrices, (terms, 3, size, size))
        check_shape("rows", self.rows, (len(self.offset), size))
        check_shape("reference", self.reference, (size,))

    def at(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return [M, B, K] (3, n, n) and f (n,) for weights (1+P+E,)."""
        flat = self.matrices.reshape(len(weights), -1)
        return (weights @ flat).reshape(self.matrices.shape[1:]), weights @ self.forcing


class Structure(Protocol):
    """What is fitted: named parameters, what they mean in a recording, and where a fit may start."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters (P,); "stiffness_…" and "damping_…" with one ending belong together."""

    @property
    def body(self) -> FloatArray:
        """How the load moves beside the base, (6, n) [x y z rx ry rz] per p; the base moves as `record.drive`."""

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return the mechanics of a recording, terms in the order 1, `parameters`, `record.inertia_errors`."""

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starting values (S, P), the right order of magnitude; the best of what they lead to is taken."""


@dataclass(frozen=True)
class Response:
    """Ratios `value` (K, C) with derivatives `by_term` (K, C, P+E) and `by_log_s` (K, C).

    `motion` (K, n): p, `below` (K,): what the reference reads, both per unit of the base's motion.
    """

    value: ComplexArray
    by_term: ComplexArray
    by_log_s: ComplexArray
    motion: ComplexArray
    below: ComplexArray


def respond(mechanics: Mechanics, weights: FloatArray, s: ComplexArray) -> Response:
    """Return the ratios of responses to reference at s (K,) for weights (1+P+E,), with their derivatives.

    With D = M s² + B s + K and y = D⁻¹ (rows - H · reference) / reference reading: dH = -y · (s² df + dD p). D is
    symmetric; dD and df are linear in the terms, so that all derivatives are one product of [s² yp, s yp, yp, s² y]
    with the entries of the terms' matrices.
    """
    (mass, damping, stiffness), forcing = mechanics.at(weights)
    s1 = s[:, None]
    s2 = s1 * s1
    inverse = _inverse(s2[:, :, None] * mass + s1[:, :, None] * damping + stiffness)
    motion = -s2 * (inverse @ forcing)
    below = mechanics.reference_offset + motion @ mechanics.reference
    value = (mechanics.offset + motion @ mechanics.rows.T) / below[:, None]
    readings = (mechanics.rows - value[:, :, None] * mechanics.reference) / below[:, None, None]
    adjoint = readings @ inverse
    size = len(forcing)
    pairs = (adjoint[:, :, :, None] * motion[:, None, None, :]).reshape(*value.shape, size * size)
    s3 = s[:, None, None]
    pairs1 = s3 * pairs
    parts = np.concatenate([s3 * pairs1, pairs1, pairs, (s3 * s3) * adjoint], axis=2)
    terms = np.concatenate([mechanics.matrices[1:].reshape(-1, 3 * size * size), mechanics.forcing[1:]], axis=1)
    by_term = parts.reshape(-1, parts.shape[2]) @ -terms.T
    faster = 2.0 * s2 * (forcing + motion @ mass) + s1 * (motion @ damping)
    return Response(
        value=value,
        by_term=by_term.reshape(*value.shape, len(terms)),
        by_log_s=-np.sum(adjoint * faster[:, None], axis=2),
        motion=motion,
        below=below,
    )


def _inverse(matrix: ComplexArray) -> ComplexArray:
    """Return the inverses of matrices (K, n, n)."""
    return np.asarray(1.0 / matrix if matrix.shape[1] == 1 else np.linalg.inv(matrix))


def poles(mechanics: Mechanics, weights: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles λ (n,) with Im λ ≥ 0, ascending |λ|, and their derivatives (n, P+E) by the terms.

    Of (M λ² + B λ + K) u = 0 with symmetric matrices: dλ = -uᵀ(dM λ² + dB λ + dK)u / uᵀ(2λM + B)u
    (Lancaster, Lambda-Matrices and Vibrating Systems, 1966). Of two real poles of one mode the slower one is returned.
    """
    (mass, damping, stiffness), _ = mechanics.at(weights)
    size = len(mass)
    unit = np.sqrt(np.trace(stiffness) / np.trace(mass))  # 1/s, so that the companion matrix is balanced
    lower = np.linalg.solve(mass, np.hstack([stiffness / unit**2, damping / unit]))
    companion = np.block([[np.zeros((size, size)), np.eye(size)], [-lower]])
    roots, vectors = np.linalg.eig(companion)
    order = np.lexsort((np.abs(roots), roots.imag < -1e-12 * np.abs(roots)))[:size]
    root = unit * roots[order].astype(np.complex128)
    shape = vectors[:size, order].T
    square = np.einsum("mi,qtij,mj->mqt", shape, mechanics.matrices[1:], shape)
    norm = 2.0 * root * np.einsum("mi,ij,mj->m", shape, mass, shape)
    norm = norm + np.einsum("mi,ij,mj->m", shape, damping, shape)
    change = (square[:, :, 0] * root[:, None] + square[:, :, 1]) * root[:, None] + square[:, :, 2]
    return root, -change / norm[:, None]


# What an identification says: parameters, modes, named errors, how well the model explains the curves.


@dataclass(frozen=True)
class ModeEstimate:
    """One mode of one recording, `number` from 0 by rising frequency, with standard uncertainties.

    `frequency_hz` f₀ = |λ|/2π of the undamped oscillator, `damping_ratio` ζ = -Re λ/|λ| of the pole λ.
    """

    record: str
    number: int
    frequency_hz: float
    u_frequency_hz: float
    damping_ratio: float
    u_damping_ratio: float

    @property
    def quality(self) -> float:
        """Quality factor Q = 1/(2ζ)."""
        return 0.5 / self.damping_ratio

    @property
    def u_quality(self) -> float:
        """Standard uncertainty of Q."""
        return abs(self.quality / self.damping_ratio) * self.u_damping_ratio


@dataclass(frozen=True)
class NamedUnknown:
    """A named error as the recordings see it: `estimate` in its standard deviations, of which `remaining` is left."""

    name: str
    estimate: float
    remaining: float


@dataclass(frozen=True)
class FreeFactor:
    """Gain or delay of one response in one recording that was left free: the curve is H · gain · exp(-s delay)."""

    record: str
    channel: str
    gain: complex
    u_gain_relative: float
    u_gain_phase_rad: float
    delay_s: float
    u_delay_s: float


@dataclass(frozen=True)
class Identification:
    """Parameters of a structure from all recordings together.

    `estimates` (P): parameters, of one recording alone "name: recording"; `covariance` (P, P) of them, infinite
    where the recordings leave one open. `derived`: b/k of each spring and damper. `modes`: of each recording.
    `unknowns`: named errors. `factors`: free gains and delays. `model`, `residual` (K, C): per recording, curve with
    all errors found, and what was measured less the model. `chi_squared` of the residuals over the covariances as
    stated, with `dof`; where χ²/dof exceeds what noise explains, the noise is enlarged by the excess. `budget` by
    cause: change (P,) of the parameters for one standard deviation of a named error or of a number stated beforehand,
    and what "noise" adds; their squares sum up to the variances.
    """

    estimates: tuple[ParameterEstimate, ...]
    covariance: FloatArray
    derived: tuple[ParameterEstimate, ...]
    modes: tuple[ModeEstimate, ...]
    unknowns: tuple[NamedUnknown, ...]
    factors: tuple[FreeFactor, ...]
    model: tuple[ComplexArray, ...]
    residual: tuple[ComplexArray, ...]
    chi_squared: float
    dof: float
    notices: tuple[Notice, ...]
    budget: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (len(self.estimates), len(self.estimates)))

    def __getitem__(self, name: str) -> ParameterEstimate:
        """Return the parameter or derived number of a name."""
        for estimate in (*self.estimates, *self.derived):
            if estimate.name == name:
                return estimate
        names = ", ".join(estimate.name for estimate in (*self.estimates, *self.derived))
        raise ValueError(f"name: expected one of {names}, found {name}")

    def value(self, name: str) -> float:
        """Return the value of a parameter or derived number."""
        return self[name].value

    def u(self, name: str) -> float:
        """Return the standard uncertainty of a parameter or derived number."""
        return self[name].u

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of `covariance`."""
        return tuple(estimate.name for estimate in self.estimates)

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix (P, P) of the parameters; zero for what is fixed or open."""
        size = np.sqrt(self.covariance.diagonal())
        known = np.isfinite(size) & (size > 0.0)
        found = np.zeros_like(self.covariance)
        inside = np.ix_(known, known)
        found[inside] = self.covariance[inside] / np.multiply.outer(size[known], size[known])
        return found + np.diag(1.0 - found.diagonal())
