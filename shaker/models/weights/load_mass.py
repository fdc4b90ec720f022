"""Weights, first moments and masses from the first harmonic of a sensor that is turned about a horizontal axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, IntArray, check_shape
from shaker.models.weights.turning import (
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
CHANCE, CHANCE_OF_FEW, FEW_DOF = 1e-3, 1e-2, 5.0
"""Probability with which channels that agree may be taken for ones that do not; with fewer degrees of freedom, more."""
_STEPS, _CONVERGED = 20, 1e-6
_SMALLEST_DEPARTURE, _DEPARTURE_STEP = 1e-9, 1.001


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
    weights explain all outputs; `departure`: share of the weight by which every first harmonic departs from that of a
    turned weight beyond what is stated, 0 where the channels agree.
    """

    names: tuple[str, ...]
    value: FloatArray
    sources: tuple[Source, ...]
    load: ComplexArray
    chi_squared: float
    dof: float
    departure: float

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
    their own noise. Where an F test gives what all outputs, or those of forces, leave to chance less than once in 1000
    (of few readings: in 100), every first harmonic is taken to be uncertain by one more share of the weight, as large
    as makes χ² its degrees of freedom (Paule & Mandel 1982, J. Res. NBS 87, 377).
    """
    from scipy.special import fdtrc

    if not records:
        raise ValueError("records: expected at least one, found none")
    problem = _Problem(tuple(records), outputs, u_angle_rad)
    fit = _converged(problem)
    noise_dof = sum(record.dof for record in records)
    chance = CHANCE if noise_dof >= FEW_DOF else CHANCE_OF_FEW
    if all(test.dof < 0.5 or fdtrc(test.dof, noise_dof, test.excess) >= chance for test in fit.tests):
        return _result(fit)
    low, high = _SMALLEST_DEPARTURE, 1.0
    while high > low * _DEPARTURE_STEP:
        middle = float(np.sqrt(low * high))
        fit = _converged(replace(problem, departure=middle))
        low, high = (middle, high) if max(test.excess for test in fit.tests) > 1.0 else (low, middle)
    return _result(fit)


class _Test(NamedTuple):
    """χ² and its degrees of freedom."""

    chi_squared: float
    dof: float

    @property
    def excess(self) -> float:
        """χ² per degree of freedom, none where there is no freedom."""
        return self.chi_squared / self.dof if self.dof > 0.5 else 0.0


@dataclass(frozen=True)
class _Problem:
    """All recordings with one sensor as a least-squares problem of real rows; unknowns: recordings', then shared."""

    records: tuple[Turned, ...]
    outputs: SensorOutputs
    u_angle_rad: float
    departure: float = 0.0

    @cached_property
    def start(self) -> FloatArray:
        """Unknowns before the first step."""
        own = [start_values(record, self.outputs) for record in self.records]
        return np.concatenate([*own, np.zeros(self.shared)])

    @cached_property
    def departures(self) -> FloatArray:
        """What `departure` makes of every real row: that share of the weight, of moments at the usual lever."""
        lever = np.repeat([1.0, USUAL_LEVER_M], FORCES)
        size = np.max(np.abs(self.outputs.sensitivity) * lever, axis=1)
        weights = self.start[: OWN * len(self.records) : OWN]
        return self.departure * np.concatenate([np.tile(weight * size, 2) for weight in weights])

    @cached_property
    def forces(self) -> BoolArray:
        """Which outputs answer to forces rather than moments (C,)."""
        size = np.abs(self.outputs.sensitivity)
        return np.asarray(size[:, :FORCES].sum(axis=1) > USUAL_LEVER_M * size[:, FORCES:].sum(axis=1))

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
        return np.asarray(1.0 / (variance + self.departures**2))

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


class _Converged(NamedTuple):
    """A problem at its solution."""

    problem: _Problem
    vector: FloatArray
    residual: FloatArray
    inverse: FloatArray

    @property
    def tests(self) -> tuple[_Test, _Test]:
        """χ² of all outputs and of those of forces."""
        problem, count = self.problem, len(self.problem.records)
        prior = problem.prior(self.vector)
        own = problem.weight * self.residual**2
        shares = float(np.sum(prior * self.vector**2))
        known = (prior * np.diag(self.inverse))[: OWN * count]
        rows = 2 * int(problem.forces.sum())
        freedom = count * max(0, rows - 2 - (2 if rows > 4 else 0))
        forces = float(own.reshape(count, 2, -1)[:, :, problem.forces].sum())
        every = _Test(float(own.sum()) + shares, len(own) - float(np.sum(1.0 - known)))
        return every, _Test(forces + shares, float(freedom))


def _converged(problem: _Problem) -> _Converged:
    """Gauss-Newton steps from the start to the solution."""
    vector = problem.start
    for _ in range(_STEPS):
        residual, jacobian = problem.linearised(vector)
        scale, step, inverse = problem.solved(vector, residual, jacobian)
        vector = vector + step
        if np.max(np.abs(step) / scale) < _CONVERGED:
            break
    residual, jacobian = problem.linearised(vector)
    _, _, inverse = problem.solved(vector, residual, jacobian)
    return _Converged(problem, vector, residual, inverse)


def _result(fit: _Converged) -> WeightFit:
    """Values, sources and the test of a fit."""
    problem, vector = fit.problem, fit.vector
    inverse, told = problem.outputs.inverse, problem.outputs.determined
    loads = np.array([np.where(told, inverse @ record.amplitude, np.nan) for record in problem.records])
    value = np.empty(ROWS * len(problem.records))
    for r in range(len(problem.records)):
        value[ROWS * r : ROWS * r + OWN] = vector[OWN * r : OWN * (r + 1)]
        value[ROWS * r + OWN : ROWS * (r + 1)] = np.real(loads[r][:FORCES] * _projection(problem, r, vector))
    names, every = tuple(record.name for record in problem.records), fit.tests[0]
    sources = tuple(_sources(fit))
    return WeightFit(names, value, sources, loads, every.chi_squared, every.dof, problem.departure)


def _projection(problem: _Problem, r: int, vector: FloatArray) -> ComplexArray:
    """Factors (3,) whose product with a force component has the weight as its real part; NaN where it feels little."""
    own = vector[OWN * r : OWN * (r + 1)]
    phasor = problem.outputs.sense * np.exp(1j * own[4]) * turning_phasor(problem.records[r], own[5:])
    size = np.abs(phasor)
    seen = problem.outputs.determined[:FORCES] & (size > LEAST_SHARE)
    return np.asarray(np.where(seen, np.conj(phasor) / np.where(seen, size, 1.0) ** 2, np.nan))


def _sources(fit: _Converged) -> Iterator[Source]:
    """Every cause of error with its effect on all values; effects of deviates that are one in truth."""
    problem, vector, inverse = fit.problem, fit.vector, fit.inverse
    count, own, elements = len(problem.records), OWN * len(problem.records), problem.elements
    _, jacobian = problem.linearised(vector)
    gain = inverse @ (jacobian.T * problem.weight)
    prior = problem.prior(vector)
    size = 2 * len(problem.outputs.sensitivity)
    departing = []
    for r, record in enumerate(problem.records):
        rows = slice(size * r, size * (r + 1))
        by_row = _spread(gain[:, rows], count)
        to_load = problem.outputs.inverse[:FORCES] * _projection(problem, r, vector)[:, None]
        by_row[ROWS * r + OWN : ROWS * (r + 1)] = np.hstack([to_load.real, -to_load.imag])
        yield Source(f"noise of {record.name}", "A", record.dof, by_row @ _root(record.covariance))
        departing.append(by_row * problem.departures[rows])
    if problem.departure > 0.0:
        freedom = min(test.dof for test in fit.tests if test.dof > 0.5)
        yield Source("channels that disagree", "A", freedom, np.hstack(departing))
    shared = -_spread(inverse * prior, count)
    for r in range(count):
        shared[ROWS * r + OWN : ROWS * (r + 1), own:] = _alone(problem, r, vector)
    ends = own + len(elements)
    weak = [OWN * r + place for r in range(count) for place in (1, 2, 3, 5, 6)]
    if len(elements):
        yield Source("calibration matrix", "B", np.inf, shared[:, own:ends])
    if problem.u_angle_rad > 0.0:
        yield Source("angle of the head", "B", np.inf, shared[:, ends:])
    yield Source("what no channel tells", "B", np.inf, shared[:, weak] / np.sqrt(prior[weak]))


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


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix whose square is the covariance, which may have directions without spread."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * axes * np.sqrt(np.maximum(variance, 0.0)))
