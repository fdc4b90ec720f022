"""Linear mechanics of masses, springs and dampers: responses, poles, and chains of masses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from shakercal._common.arrays import ComplexArray, FloatArray, check_shape

BASE = "base"


def laplace(frequency_hz: FloatArray, added_decay_per_s: float = 0.0) -> ComplexArray:
    """Return s = a + jω (K,) in 1/s with an added decay a."""
    return np.asarray(added_decay_per_s + 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64))


def oscillator_hz(stiffness: float, mass: float) -> float:
    """Return f₀ = √(k/m)/2π in Hz; for a rotation from N·m/rad and kg·m²."""
    if stiffness <= 0.0 or mass <= 0.0:
        raise ValueError(f"stiffness, mass: expected both above 0, found {stiffness} and {mass}")
    return float(np.sqrt(stiffness / mass) / (2.0 * np.pi))


def required_stiffness(frequency_hz: float, mass: float) -> float:
    """Return k = (2πf₀)²m in N/m, or N·m/rad (Nitsche et al. 2018, eq. 9)."""
    return float((2.0 * np.pi * frequency_hz) ** 2 * mass)


def shared_spring(frequency_hz: FloatArray, mass: FloatArray) -> tuple[float, float]:
    """Return stiffness and internal mass of resonances (N,): 1/(2πf)² = (m + m_i)/k."""
    check_shape("mass", np.asarray(mass), np.asarray(frequency_hz).shape)
    if len(np.unique(mass)) < 2:
        raise ValueError(f"mass: expected two different loads or more, found {np.asarray(mass).tolist()}")
    softness, offset = np.polyfit(mass, 1.0 / (2.0 * np.pi * np.asarray(frequency_hz)) ** 2, 1)
    return float(1.0 / softness), float(offset / softness)


@dataclass(frozen=True)
class Mechanics:
    """Moving masses on a base in one recording.

    The equation of motion is (M s² + B s + K) p = -s² f. p (n,) is the motion relative to the base per unit of base
    motion. M, B, K and f are sums with the weights [1, θ (P), z (E)]: a constant part, parameters, and quantities of
    the load in units of their standard uncertainty. Response c reads `offset` + `rows` · p. The reference reads
    `reference_offset` + `reference` · p.

    Attributes
    ----------
    matrices : (1+P+E, 3, n, n), symmetric M, B and K of each term.
    forcing : (1+P+E, n), f of each term.
    rows, offset : (C, n) and (C,), of the responses.
    reference, reference_offset : (n,) and a number, of the reference.
    loss_hz : 0 for viscous damping. Otherwise the frequency in Hz at which B acts as viscous damping would: B s becomes
        jω₀B at every frequency, a loss factor η = ω₀B/K (structural damping) that does not depend on it.
    """

    matrices: FloatArray
    forcing: FloatArray
    rows: FloatArray
    offset: FloatArray
    reference: FloatArray
    reference_offset: float
    loss_hz: float = 0.0

    def __post_init__(self) -> None:
        terms, size = self.forcing.shape
        check_shape("matrices", self.matrices, (terms, 3, size, size))
        check_shape("rows", self.rows, (len(self.offset), size))
        check_shape("reference", self.reference, (size,))

    def at(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return [M, B, K] (3, n, n) and f (n,) for weights (1+P+E,)."""
        flat = self.matrices.reshape(len(weights), -1)
        return (weights @ flat).reshape(self.matrices.shape[1:]), weights @ self.forcing

    def damping_rate(self, s: ComplexArray) -> ComplexArray:
        """Return the factor (K,) of B: s (K,), or jω₀ of a loss factor."""
        return np.full(len(s), 2j * np.pi * self.loss_hz) if self.loss_hz else s


@dataclass(frozen=True)
class FrequencyTerms:
    """Terms by frequency, added to M, f, rows and offset of a `Mechanics`.

    `mass` (K, n, n), `forcing` (K, n), `rows` (K, C, n) and `offset` (K, C).
    """

    mass: ComplexArray
    forcing: ComplexArray
    rows: ComplexArray
    offset: ComplexArray


@dataclass(frozen=True)
class MechanicalResponse:
    """Ratios `value` (K, C) of responses to the reference at s (K,), with derivatives.

    `motion` (K, n): p per unit of base motion; `reference_reading` (K,) per unit of it; `inverse` (K, n, n) of D = M s²
    + B s + K; `rows`, `mass`, `forcing` include the frequency-dependent terms.
    """

    mechanics: Mechanics
    s: ComplexArray
    value: ComplexArray
    motion: ComplexArray
    reference_reading: ComplexArray
    inverse: ComplexArray
    rows: FloatArray | ComplexArray
    mass: FloatArray | ComplexArray
    damping: FloatArray
    forcing: ComplexArray

    @cached_property
    def adjoint(self) -> ComplexArray:
        """Change (K, C, n) of the ratios per unit force on p."""
        readings = (self.rows - self.value[:, :, None] * self.mechanics.reference) / self.reference_reading[
            :, None, None
        ]
        return np.asarray(readings @ self.inverse)

    @property
    def by_term(self) -> ComplexArray:
        """Derivatives (K, C, P+E) with respect to the terms.

        dH = -y · (s² df + dD p), linear in the terms: one product of s² yp, s yp, yp and s² y with the non-zero entries
        of the terms' matrices.
        """
        matrices, forcing = self.mechanics.matrices[1:], self.mechanics.forcing[1:]
        parts, terms = [], []
        factors = (self.s * self.s, self.mechanics.damping_rate(self.s), np.ones_like(self.s))
        for factor, term_matrices in zip(factors, matrices.swapaxes(0, 1), strict=True):
            row, column = np.nonzero(np.any(term_matrices, axis=0))
            pushed = factor[:, None] * self.motion[:, column]
            parts.append(self.adjoint[:, :, row] * pushed[:, None])
            terms.append(term_matrices[:, row, column])
        (ahead,) = np.nonzero(np.any(forcing, axis=0))
        parts.append(self.adjoint[:, :, ahead] * (self.s * self.s)[:, None, None])
        terms.append(forcing[:, ahead])
        together = np.concatenate(parts, axis=2)
        found = together.reshape(-1, together.shape[2]) @ -np.concatenate(terms, axis=1).T
        return np.asarray(found.reshape(*self.value.shape, len(forcing)))

    @property
    def by_log_s(self) -> ComplexArray:
        """Derivatives (K, C) with respect to ln s; the frequency-dependent terms are treated as constant."""
        s1 = self.s[:, None]
        faster = 2.0 * s1 * s1 * (self.forcing + (self.mass @ self.motion[:, :, None])[:, :, 0])
        if not self.mechanics.loss_hz:
            faster = faster + s1 * (self.motion @ self.damping)
        return np.asarray(-np.sum(self.adjoint * faster[:, None], axis=2))


def respond(
    mechanics: Mechanics, weights: FloatArray, s: ComplexArray, frequency_terms: FrequencyTerms | None = None
) -> MechanicalResponse:
    """Return the ratios of responses to reference at s (K,) for weights (1+P+E,)."""
    (mass, damping, stiffness), forcing = mechanics.at(weights)
    rows: FloatArray | ComplexArray = mechanics.rows[None]
    whole: FloatArray | ComplexArray = mass[None]
    offset, push = mechanics.offset + 0.0j, np.asarray(forcing[None], np.complex128)
    if frequency_terms is not None:
        rows, offset = rows + frequency_terms.rows, offset + frequency_terms.offset
        whole, push = whole + frequency_terms.mass, push + frequency_terms.forcing
    s1 = s[:, None]
    s2 = s1 * s1
    dynamic = s2[:, :, None] * whole + mechanics.damping_rate(s)[:, None, None] * damping + stiffness
    inverse: ComplexArray = np.asarray(1.0 / dynamic if len(mass) == 1 else np.linalg.inv(dynamic), np.complex128)
    motion = -s2 * (inverse @ push[:, :, None])[:, :, 0]
    below = mechanics.reference_offset + motion @ mechanics.reference
    value = (offset + (rows @ motion[:, :, None])[:, :, 0]) / below[:, None]
    return MechanicalResponse(mechanics, s, value, motion, below, inverse, rows, whole, damping, push)


def poles(mechanics: Mechanics, weights: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles λ (n,) with Im λ ≥ 0, ascending, and derivatives (n, P+E).

    They solve (M λ² + B λ + K) u = 0 with symmetric matrices: dλ = -uᵀ(dM λ² + dB λ + dK)u / uᵀ(2λM + B)u (Lancaster,
    Lambda-Matrices and Vibrating Systems, 1966). Of two real poles of one mode the slower one is returned. With a loss
    factor λ is the pole of viscous damping with the natural frequency and the damping ratio η/2 of the mode.
    """
    (mass, damping, stiffness), _ = mechanics.at(weights)
    if mechanics.loss_hz:
        return _loss_factor_poles(mechanics, mass, damping, stiffness)
    size = len(mass)
    unit = np.sqrt(np.trace(stiffness) / np.trace(mass))  # 1/s, so that the companion matrix is balanced
    companion = np.eye(2 * size, k=size)
    companion[size:, :size], companion[size:, size:] = stiffness / -(unit**2), damping / -unit
    companion[size:] = np.linalg.solve(mass, companion[size:])
    roots, vectors = np.linalg.eig(companion)
    order = np.lexsort((np.abs(roots), roots.imag < -1e-12 * np.abs(roots)))[:size]
    root = unit * roots[order].astype(np.complex128)
    shape = vectors[:size, order].T
    pairs = (shape[:, :, None] * shape[:, None]).reshape(size, -1)
    terms = mechanics.matrices[1:].reshape(-1, size * size)
    square = (pairs @ terms.T).reshape(size, -1, 3)
    norm = 2.0 * root * (pairs @ mass.ravel()) + pairs @ damping.ravel()
    change = (square[:, :, 0] * root[:, None] + square[:, :, 1]) * root[:, None] + square[:, :, 2]
    return root, -change / norm[:, None]


def _loss_factor_poles(
    mechanics: Mechanics, mass: FloatArray, damping: FloatArray, stiffness: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles of modes with a loss factor, and their derivatives.

    ω₀(-η/2 + j√(1 - η²/4)), from μ = ω₀²(1 + jη) of (K + jω_LB) u = μ M u.
    """
    rate = 2j * np.pi * mechanics.loss_hz
    roots, vectors = np.linalg.eig(np.linalg.solve(mass, stiffness + rate * damping))
    order = np.argsort(roots.real)
    root, shape = roots[order], vectors[:, order].T
    term_mass, term_damping, term_stiffness = mechanics.matrices[1:].swapaxes(0, 1)
    by_term = np.einsum("ni,pij,nj->np", shape, term_stiffness + rate * term_damping, shape)
    by_term = by_term - root[:, None] * np.einsum("ni,pij,nj->np", shape, term_mass, shape)
    change = by_term / np.einsum("ni,ij,nj->n", shape, mass, shape)[:, None]
    natural, ratio = np.sqrt(root.real), 0.5 * root.imag / root.real
    by_natural = change.real / (2.0 * natural)[:, None]
    by_ratio = 0.5 * change.imag / root.real[:, None] - (ratio / root.real)[:, None] * change.real
    rest = np.sqrt(np.maximum(1.0 - ratio**2, np.finfo(np.float64).tiny))
    pole, slope = natural * (-ratio + 1j * rest), natural * (-1.0 - 1j * ratio / rest)
    return pole, (pole / natural)[:, None] * by_natural + slope[:, None] * by_ratio


@dataclass(frozen=True)
class MassChain:
    """Masses in a row on a moving base, connected by springs and dampers.

    The equation of motion of stage i is mᵢ ẍᵢ = kᵢ(xᵢ₋₁ - xᵢ) + bᵢ(ẋᵢ₋₁ - ẋᵢ) - kᵢ₊₁(xᵢ - xᵢ₊₁) - bᵢ₊₁(ẋᵢ - ẋᵢ₊₁), with
    the base motion x₀.

    Attributes
    ----------
    stages : N names, from the base upwards.
    mass : (N,) in kg along an axis, or kg·m² about it.
    stiffness : (N,) in N/m, or N·m/rad.
    damping : (N,) in N·s/m, or N·m·s/rad.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import MassChain
    >>> load = MassChain(("load",), np.array([7.7]), np.array([4e6]), np.array([50.0]))
    >>> frequency_hz, damping_ratio = load.modes()
    >>> print(f"{frequency_hz[0]:.1f} Hz, damping ratio {damping_ratio[0]:.4f}")
    114.7 Hz, damping ratio 0.0045
    """

    stages: tuple[str, ...]
    mass: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        check_stages(self.stages)
        for name in ("mass", "stiffness", "damping"):
            check_shape(name, getattr(self, name), (len(self.stages),))
            if np.any(getattr(self, name) < 0.0):
                raise ValueError(f"{name}: expected none negative, found {getattr(self, name).tolist()}")

    def transfer(self, frequency_hz: FloatArray, of: str, over: str = BASE) -> MechanicalResponse:
        """Return the motion of a stage over that of another or the base."""
        for stage in (of, over):
            if stage not in (BASE, *self.stages):
                raise ValueError(f"stage: expected one of {', '.join((BASE, *self.stages))}, found {stage}")
        row, reference = (np.array([float(stage == name) for name in self.stages]) for stage in (of, over))
        mechanics = replace(fixed_base_chain(len(self.stages)), rows=row[None], reference=reference)
        return respond(mechanics, self._weights, laplace(frequency_hz))

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Matrices M, B, K (N, N) of the chain on a fixed base."""
        mass, damping, stiffness = fixed_base_chain(len(self.stages)).at(self._weights)[0]
        return mass, damping, stiffness

    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Return natural frequencies in Hz and damping ratios (N,) on a fixed base, ascending."""
        roots = poles(fixed_base_chain(len(self.stages)), self._weights)[0]
        size = np.abs(roots)
        return size / (2.0 * np.pi), -roots.real / size

    @property
    def _weights(self) -> FloatArray:
        """Weights (1+3N,) of the terms of `resting_chain`."""
        return np.concatenate([[1.0], self.mass, self.stiffness, self.damping])


def check_stages(stages: tuple[str, ...]) -> None:
    """Raise `ValueError` unless stages have different names, none of them that of the base."""
    if not stages or len({BASE, *stages}) <= len(stages):
        raise ValueError(f"stages: expected different names other than {BASE}, found {', '.join(stages) or 'none'}")


def chain_terms(count: int) -> tuple[FloatArray, FloatArray]:
    """Return M, B, K (1+3N, 3, N, N) and f (1+3N, N) of a chain.

    The first term is zero; the others are per unit of every mass, stiffness and damping.
    """
    unit = np.eye(count)
    stretch = unit - np.eye(count, k=-1)
    matrices = np.zeros((1 + 3 * count, 3, count, count))
    forcing = np.zeros((1 + 3 * count, count))
    for stage in range(count):
        matrices[1 + stage, 0] = np.outer(unit[stage], unit[stage])
        matrices[1 + count + stage, 2] = np.outer(stretch[stage], stretch[stage])
        matrices[1 + 2 * count + stage, 1] = matrices[1 + count + stage, 2]
        forcing[1 + stage] = unit[stage]
    return matrices, forcing


@cache
def fixed_base_chain(count: int) -> Mechanics:
    """Return a chain on a fixed base without a response, with the terms of `chain_terms`."""
    return Mechanics(*chain_terms(count), np.zeros((1, count)), np.ones(1), np.zeros(count), 1.0)
