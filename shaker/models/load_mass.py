"""Weights, first moments and masses from the first harmonic of a sensor that is turned about a horizontal axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.models.turning import (
    FORCES,
    LEAST_SHARE,
    OWN,
    SensorOutputs,
    Turned,
    start_values,
    turning_phasor,
    weight_load,
)

Number = TypeVar("Number", float, FloatArray)
ROWS = OWN + FORCES
"""Numbers of a recording in `WeightFit`: its unknowns, then the weight by each force component alone."""
LEVER_M, TILT_RAD = 1.0, 0.1
"""Standard deviations of what nothing is known of: lever of the weight, tilt of the axis."""
USUAL_LEVER_M = 0.1
"""Lever at which forces and moments count alike where outputs of either kind are told apart."""
CHANCE = 1e-3
"""Probability with which channels that agree may be taken for ones that do not."""
_STEPS, _CONVERGED = 20, 1e-6


def mass_of_weight(weight_n: Number, gravity_mps2: Number, air_share: Number | float = 0.0) -> Number:
    """Return the mass in kg of a weight in air, m = F/(g·(1 - ρ_air/ρ)); `air_share`: ρ_air/ρ of the body.

    Nitsche et al. 2018, eq. 7, whose masses are without buoyancy (`air_share` 0).
    """
    return weight_n / (gravity_mps2 * (1.0 - air_share))


class Source(NamedTuple):
    """Independent errors of one kind: `effect` (V, r) of r unit deviates on all V numbers of a fit, with `dof`."""

    name: str
    kind: Literal["A", "B"]
    dof: float
    effect: FloatArray


@dataclass(frozen=True)
class WeightFit:
    """Weights of R recordings with one sensor.

    `value` (R·10,), for each recording in turn: weight N, first moment x y z (weight times centre of mass, N·m), zero
    angle rad, tilt of the axis rad along gravity at zero angle and across it, and the weight by Fx, Fy, Fz alone (NaN
    where a component does not tell). `sources`: every cause of error with its effect on all of them. `load` (R, 6):
    first harmonics of the load by the calibration matrix (NaN where not determined). `chi_squared`, `dof`: how well
    weights explain all outputs; `enlarged`: factor that made up for channels which disagree beyond what is stated.
    """

    names: tuple[str, ...]
    value: FloatArray
    sources: tuple[Source, ...]
    load: ComplexArray
    chi_squared: float
    dof: float
    enlarged: float

    def __post_init__(self) -> None:
        check_shape("value", self.value, (ROWS * len(self.names),))
        check_shape("load", self.load, (len(self.names), 6))

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance of `value`."""
        return np.asarray(sum(source.effect @ source.effect.T for source in self.sources))

    def place(self, recording: int, row: int) -> int:
        """Return where a number of a recording stands in `value`."""
        return ROWS * recording + row


def fit_weights(records: Sequence[Turned], outputs: SensorOutputs, u_angle_rad: float = 0.0) -> WeightFit:
    """Fit weight, first moment, zero angle and axis of every recording to all first harmonics.

    In sensor axes gravity turns backwards: force = W·U·exp(jθ₀), moment = μ × U·exp(jθ₀), U = d + j n × d with n the
    axis, d gravity's direction at zero angle. Every element of the sensitivity is an unknown with its stated
    uncertainty, common to all recordings; so are errors of the head's angle twice per turn (ε_s sin 2θ + ε_c cos 2θ,
    `u_angle_rad` each), the only ones that first harmonics feel: A → A - (j/2)·conj(A)·(ε_c - jε_s). Outputs weigh by
    their own noise.
    """
    if not records:
        raise ValueError("records: expected at least one, found none")
    problem = _Problem(tuple(records), outputs, u_angle_rad)
    vector = np.concatenate([*(start_values(record, outputs) for record in records), np.zeros(problem.shared)])
    for _ in range(_STEPS):
        residual, jacobian = problem.linearised(vector)
        scale, step, gain = problem.solved(vector, residual, jacobian)
        vector = vector + step
        if np.max(np.abs(step) / scale) < _CONVERGED:
            break
    residual, jacobian = problem.linearised(vector)
    _, _, gain = problem.solved(vector, residual, jacobian)
    return _result(problem, vector, residual, gain)


@dataclass(frozen=True)
class _Problem:
    """All recordings with one sensor as a least-squares problem of real rows; unknowns: recordings', then shared."""

    records: tuple[Turned, ...]
    outputs: SensorOutputs
    u_angle_rad: float

    @cached_property
    def elements(self) -> IntArray:
        """Rows (E, 2) of the uncertain elements of the sensitivity."""
        return np.argwhere(self.outputs.u > 0.0)

    @property
    def shared(self) -> int:
        """Number of unknowns that all recordings share: elements, then twice-per-turn errors (cos, sin) of the head."""
        return len(self.elements) + (2 if self.u_angle_rad > 0.0 else 0)

    @cached_property
    def weight(self) -> FloatArray:
        """One over the variance of every real row."""
        variance = np.concatenate([np.diag(record.covariance) for record in self.records])
        return np.asarray(1.0 / variance)

    def prior(self, vector: FloatArray) -> FloatArray:
        """One over the prior variance of every unknown, zero where it is free."""
        weights = []
        for r in range(len(self.records)):
            lever = 1.0 / (LEVER_M * vector[OWN * r]) ** 2
            weights += [0.0, lever, lever, lever, 0.0, TILT_RAD**-2, TILT_RAD**-2]
        return np.array([*weights, *([1.0] * self.shared)])

    def linearised(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (rows,) and derivatives (rows, unknowns) of the model at a vector."""
        residuals, blocks = [], []
        own = OWN * len(self.records)
        elements, matrix = self.elements, self.outputs.sensitivity.copy()
        rows, columns = elements.T
        matrix[rows, columns] += vector[own : own + len(elements)] * self.outputs.u[rows, columns]
        for r, record in enumerate(self.records):
            load, by_own = weight_load(record, vector[OWN * r : OWN * (r + 1)], self.outputs.sense)
            if self.u_angle_rad > 0.0:
                twice = self.u_angle_rad * complex(vector[-2], -vector[-1])
                by_head = -0.5j * np.conj(load)[:, None] * self.u_angle_rad * np.array([1.0, -1j])
                load, by_own = load - 0.5j * np.conj(load) * twice, by_own - 0.5j * np.conj(by_own) * twice
            else:
                by_head = np.zeros((6, 0), np.complex128)
            jacobian = np.zeros((len(matrix), len(vector)), np.complex128)
            jacobian[:, OWN * r : OWN * (r + 1)] = matrix @ by_own
            jacobian[rows, own + np.arange(len(elements))] = self.outputs.u[rows, columns] * load[columns]
            jacobian[:, own + len(elements) :] = matrix @ by_head
            missing = record.amplitude - matrix @ load
            residuals += [missing.real, missing.imag]
            blocks += [jacobian.real, jacobian.imag]
        return np.concatenate(residuals), np.concatenate(blocks)

    def solved(
        self, vector: FloatArray, residual: FloatArray, jacobian: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Scale of the unknowns, the step of the fit, and the inverse of the normal matrix."""
        prior = self.prior(vector)
        normal = jacobian.T @ (self.weight[:, None] * jacobian) + np.diag(prior)
        scale = 1.0 / np.sqrt(np.diag(normal))
        inverse = scale[:, None] * np.linalg.inv(normal * np.outer(scale, scale)) * scale
        right = jacobian.T @ (self.weight * residual) - prior * vector
        return np.sqrt(np.diag(inverse)), inverse @ right, np.asarray(inverse)


def _result(problem: _Problem, vector: FloatArray, residual: FloatArray, inverse: FloatArray) -> WeightFit:
    """Values, sources and the test of a fit that has converged."""
    from scipy.special import fdtrc

    prior = problem.prior(vector)
    chi_squared = float(np.sum(problem.weight * residual**2) + np.sum(prior * vector**2))
    free = OWN * len(problem.records)
    known = prior[:free] * np.diag(inverse)[:free]
    dof = len(residual) - float(np.sum(1.0 - known))
    noise_dof = sum(record.dof for record in problem.records)
    tests = [(chi_squared, dof), _of_forces(problem, vector, residual)]
    enlarged, behind = 1.0, dof
    for square, freedom in tests:
        if freedom > 0.5 and fdtrc(freedom, noise_dof, square / freedom) < CHANCE and square > enlarged**2 * freedom:
            enlarged, behind = float(np.sqrt(square / freedom)), freedom
    loads = [
        np.where(problem.outputs.determined, problem.outputs.inverse @ r.amplitude, np.nan) for r in problem.records
    ]
    value = np.empty(ROWS * len(problem.records))
    for r in range(len(problem.records)):
        value[ROWS * r : ROWS * r + OWN] = vector[OWN * r : OWN * (r + 1)]
        value[ROWS * r + OWN : ROWS * (r + 1)] = np.real(loads[r][:FORCES] * _projection(problem, r, vector))
    sources = _sources(problem, vector, inverse)
    if enlarged > 1.0:
        sources.append(_disagreement(sources, enlarged, behind, len(problem.records)))
    names = tuple(record.name for record in problem.records)
    return WeightFit(names, value, tuple(sources), np.array(loads), chi_squared, dof, enlarged)


def _of_forces(problem: _Problem, vector: FloatArray, residual: FloatArray) -> tuple[float, float]:
    """χ² of the outputs that answer to forces rather than moments, and its degrees of freedom."""
    square, count = 0.0, 0
    split = (problem.weight * residual**2).reshape(len(problem.records), 2, -1)
    size = np.abs(problem.outputs.sensitivity)
    forces = size[:, :FORCES].sum(axis=1) > USUAL_LEVER_M * size[:, FORCES:].sum(axis=1)
    for r in range(len(problem.records)):
        square += float(split[r][:, forces].sum())
        rows = 2 * int(forces.sum())
        count += max(0, rows - 2 - (2 if rows > 4 else 0))
    return square + float(problem.prior(vector) @ vector**2), float(count)


def _projection(problem: _Problem, r: int, vector: FloatArray) -> ComplexArray:
    """Factors (3,) whose product with a force component has the weight as its real part; NaN where it feels little."""
    own = vector[OWN * r : OWN * (r + 1)]
    phasor = problem.outputs.sense * np.exp(1j * own[4]) * turning_phasor(problem.records[r], own[5:])
    size = np.abs(phasor)
    seen = problem.outputs.determined[:FORCES] & (size > LEAST_SHARE)
    return np.asarray(np.where(seen, np.conj(phasor) / np.where(seen, size, 1.0) ** 2, np.nan))


def _sources(problem: _Problem, vector: FloatArray, inverse: FloatArray) -> list[Source]:
    """Every cause of error with its effect on all values; effects of deviates that are one in truth."""
    count, own, elements = len(problem.records), OWN * len(problem.records), problem.elements
    _, jacobian = problem.linearised(vector)
    gain = inverse @ (jacobian.T * problem.weight)
    prior = problem.prior(vector)
    found, start = [], 0
    for r, record in enumerate(problem.records):
        size = 2 * len(record.amplitude)
        root = _root(record.covariance)
        effect = _spread(gain[:, start : start + size] @ root, count)
        to_load = problem.outputs.inverse[:FORCES] * _projection(problem, r, vector)[:, None]
        effect[ROWS * r + OWN : ROWS * (r + 1)] = np.hstack([to_load.real, -to_load.imag]) @ root
        found.append(Source(f"noise of {record.name}", "A", record.dof, effect))
        start += size
    shared = -_spread(inverse * prior, count)
    for r in range(count):
        shared[ROWS * r + OWN : ROWS * (r + 1), own:] = _alone(problem, r, vector)
    ends = own + len(elements)
    weak = [OWN * r + place for r in range(count) for place in (1, 2, 3, 5, 6)]
    found.append(Source("calibration matrix", "B", np.inf, shared[:, own:ends]))
    found.append(Source("angle of the head", "B", np.inf, shared[:, ends:]))
    found.append(Source("what no channel tells", "B", np.inf, shared[:, weak] / np.sqrt(prior[weak])))
    return [source for source in found if source.effect.shape[1]]


def _alone(problem: _Problem, r: int, vector: FloatArray) -> FloatArray:
    """Effect (3, shared) of the shared unknowns on the weights by each force component alone."""
    load, _ = weight_load(problem.records[r], vector[OWN * r : OWN * (r + 1)], problem.outputs.sense)
    factor, inverse = _projection(problem, r, vector), problem.outputs.inverse[:FORCES]
    rows, columns = problem.elements.T
    by_element = inverse[:, rows] * problem.outputs.u[rows, columns] * load[columns]
    turned = -0.5j * problem.u_angle_rad * np.conj(load[:FORCES, None]) * np.array([1.0, -1j])
    every = np.hstack([by_element, turned]) if problem.u_angle_rad > 0.0 else by_element
    return np.asarray(np.real(every * factor[:, None]))


def _spread(effect: FloatArray, recordings: int) -> FloatArray:
    """Effects on the unknowns (U, r) as effects on all values (V, r), zero where a value is no unknown."""
    wide = np.zeros((ROWS * recordings, effect.shape[1]))
    for r in range(recordings):
        wide[ROWS * r : ROWS * r + OWN] = effect[OWN * r : OWN * (r + 1)]
    return wide


def _disagreement(sources: Sequence[Source], enlarged: float, dof: float, recordings: int) -> Source:
    """What brings the uncertainty of the unknowns to `enlarged` times itself."""
    own = np.concatenate([ROWS * r + np.arange(OWN) for r in range(recordings)])
    effect = np.zeros((ROWS * recordings, len(own)))
    every = np.hstack([source.effect[own] for source in sources if source.name != "what no channel tells"])
    effect[own] = np.sqrt(enlarged**2 - 1.0) * _root(every @ every.T)
    return Source("channels that disagree", "A", dof, effect)


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix whose square is the covariance, which may have directions without spread."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * axes * np.sqrt(np.maximum(variance, 0.0)))
