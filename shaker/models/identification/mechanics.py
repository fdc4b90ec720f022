"""Second-order mechanics of one recording, linear in its parameters: response, derivatives, modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.measured import MeasuredTransfer


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
