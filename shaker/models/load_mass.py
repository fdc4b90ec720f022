"""Weights, first moments and masses from the first harmonic of a sensor that is turned about a horizontal axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, IntArray, check_shape

ArrayOf = TypeVar("ArrayOf", FloatArray, ComplexArray)
FORCES = 3
OWN = 7
"""Unknowns of a recording: weight N, first moment N·m (3), zero angle rad, tilt of the axis rad (2)."""
ROWS = OWN + FORCES
"""Numbers of a recording in `WeightFit`: its unknowns, then the weight by each force component alone."""
LEVER_M, TILT_RAD = 1.0, 0.1
"""Standard deviations of what nothing is known of: lever of the weight, tilt of the axis."""
LEAST_SHARE = 0.3
"""Share of the weight that a force component must feel at some angle for a weight of its own."""
DETERMINED = 1e-6
CHANCE = 1e-3
"""Probability with which channels that agree may be taken for ones that do not."""
_STEPS, _CONVERGED = 20, 1e-6


def mass_of_weight(weight_n: float, gravity_mps2: float, air_share: float = 0.0) -> float:
    """Return the mass in kg of a weight in air, m = F/(g·(1 - ρ_air/ρ)); `air_share`: ρ_air/ρ of the body.

    Nitsche et al. 2018, eq. 7, whose masses are without buoyancy (`air_share` 0).
    """
    return weight_n / (gravity_mps2 * (1.0 - air_share))


@dataclass(frozen=True)
class SensorOutputs:
    """How C outputs answer the load: `sensitivity` (C, 6) output per Fx … Mz, `u` (C, 6) of every element, independent.

    `sense`: +1 where outputs are positive for the load on the sensor, -1 for that of the sensor on what it carries.
    """

    sensitivity: FloatArray
    u: FloatArray
    sense: Literal[1, -1] = 1

    def __post_init__(self) -> None:
        check_shape("sensitivity", self.sensitivity, (None, 6))
        check_shape("u", self.u, self.sensitivity.shape)

    @cached_property
    def inverse(self) -> FloatArray:
        """Return the calibration matrix (6, C), load per output: the pseudo-inverse, columns scaled to one size."""
        size = np.linalg.norm(self.sensitivity, axis=0)
        scale = np.where(size > 0.0, size, 1.0)
        return np.asarray(np.linalg.pinv(self.sensitivity / scale, rcond=1e-9) / scale[:, None])

    @cached_property
    def determined(self) -> BoolArray:
        """Return (6,): which load components the outputs tell from all others."""
        identity = self.inverse @ self.sensitivity
        return np.asarray(np.all(np.abs(identity - np.eye(6)) < DETERMINED, axis=1))


@dataclass(frozen=True)
class Turned:
    """One recording: first harmonics of the C outputs and how the head stood.

    `amplitude` (C,): output = Re{amplitude exp(+jθ)}, θ counted as the sensor turns, right-handed about `axis` (3,);
    `covariance` (2C, 2C) of [all Re, all Im], of noise with `dof` degrees of freedom; `down` (3,): direction of gravity
    at θ = 0, both unit vectors in sensor axes.
    """

    name: str
    amplitude: ComplexArray
    covariance: FloatArray
    dof: float
    axis: FloatArray
    down: FloatArray

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (2 * len(self.amplitude), 2 * len(self.amplitude)))
        check_shape("axis", self.axis, (3,))
        check_shape("down", self.down, (3,))
        if np.linalg.norm(np.cross(self.axis, self.down)) < 0.5:
            raise ValueError("axis: expected one across gravity, found one within 30 degrees of it")

    @cached_property
    def frame(self) -> tuple[float, FloatArray, FloatArray]:
        """Return the share of gravity that turns, its direction at θ = 0, and that across it: axis × direction."""
        across = self.down - self.axis * float(self.axis @ self.down)
        share = float(np.linalg.norm(across))
        return share, across / share, _skew(self.axis) @ across / share


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
            load, by_own = _load(record, vector[OWN * r : OWN * (r + 1)], self.outputs.sense)
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


def _skew(vector: ArrayOf) -> ArrayOf:
    """Return the matrix (3, 3) whose product with w is vector × w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=vector.dtype)


def _turning(record: Turned, tilt: FloatArray) -> ComplexArray:
    """U (3,): the phasor of gravity's direction in sensor axes, its axis tilted along and across gravity at zero."""
    share, along, across = record.frame
    turn = tilt[0] * across - tilt[1] * along
    angle = float(np.linalg.norm(turn))
    phasor = along + 1j * across
    if angle > 0.0:
        k = turn / angle
        phasor = phasor * np.cos(angle) + np.cross(k, phasor) * np.sin(angle) + k * (k @ phasor) * (1.0 - np.cos(angle))
    return np.asarray(share * phasor)


def _load(record: Turned, own: FloatArray, sense: int) -> tuple[ComplexArray, ComplexArray]:
    """Load (6,) of a recording's unknowns, and its derivatives (6, 7)."""
    share, _, _ = record.frame
    turn = sense * np.exp(1j * own[4])
    phasor = turn * _turning(record, own[5:])
    tilts = turn * share * np.outer(record.axis, [-1.0, -1j])
    columns = np.zeros((6, OWN), np.complex128)
    columns[:3, 0] = phasor
    columns[3:, 1:4] = -_skew(phasor)
    load = columns[:, :4] @ own[:4]
    columns[:, 4] = 1j * load
    columns[:3, 5:] = own[0] * tilts
    columns[3:, 5:] = _skew(own[1:4]) @ tilts
    return np.asarray(load), columns


def start_values(record: Turned, outputs: SensorOutputs) -> FloatArray:
    """Return the unknowns (7,) of a recording from the forces alone; refuses readings that turn the other way round."""
    phasor = outputs.sense * _turning(record, np.zeros(2))
    seen = outputs.determined[:FORCES] & (np.abs(phasor) > LEAST_SHARE)
    if not seen.any():
        raise ValueError("sensitivity: expected an output for a force across the axis, found none")
    force, size = (outputs.inverse @ record.amplitude)[:FORCES][seen], np.sum(np.abs(phasor[seen]) ** 2)
    with_axis = np.sum(force * np.conj(phasor[seen])) / size
    against = np.sum(force * phasor[seen]) / size
    if abs(against) > 1.5 * abs(with_axis):
        raise ValueError(
            "axis: expected the sense of turning for which gravity turns backwards in the sensor, found readings that "
            "turn the other way round; reverse the axis"
        )
    if abs(with_axis) == 0.0:
        raise ValueError("amplitude: expected forces that change with the angle, found none")
    return np.array([abs(with_axis), 0.0, 0.0, 0.0, float(np.angle(with_axis)), 0.0, 0.0])


def _result(problem: _Problem, vector: FloatArray, residual: FloatArray, inverse: FloatArray) -> WeightFit:
    """Values, sources and the test of a fit that has converged."""
    from scipy.special import fdtrc

    prior = problem.prior(vector)
    chi_squared = float(np.sum(problem.weight * residual**2) + np.sum(prior * vector**2))
    free = OWN * len(problem.records)
    known = prior[:free] * np.diag(inverse)[:free]
    dof = len(residual) - float(np.sum(1.0 - known))
    noise_dof = sum(record.dof for record in problem.records)
    chance = float(fdtrc(dof, noise_dof, chi_squared / dof)) if dof > 0.5 else 1.0
    enlarged = float(np.sqrt(chi_squared / dof)) if chance < CHANCE else 1.0
    loads = [
        np.where(problem.outputs.determined, problem.outputs.inverse @ r.amplitude, np.nan) for r in problem.records
    ]
    value = np.empty(ROWS * len(problem.records))
    for r in range(len(problem.records)):
        value[ROWS * r : ROWS * r + OWN] = vector[OWN * r : OWN * (r + 1)]
        value[ROWS * r + OWN : ROWS * (r + 1)] = np.real(loads[r][:FORCES] * _projection(problem, r, vector))
    sources = _sources(problem, vector, inverse)
    if enlarged > 1.0:
        sources.append(_disagreement(sources, enlarged, dof, len(problem.records)))
    names = tuple(record.name for record in problem.records)
    return WeightFit(names, value, tuple(sources), np.array(loads), chi_squared, dof, enlarged)


def _projection(problem: _Problem, r: int, vector: FloatArray) -> ComplexArray:
    """Factors (3,) whose product with a force component has the weight as its real part; NaN where it feels little."""
    own = vector[OWN * r : OWN * (r + 1)]
    phasor = problem.outputs.sense * np.exp(1j * own[4]) * _turning(problem.records[r], own[5:])
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
    load, _ = _load(problem.records[r], vector[OWN * r : OWN * (r + 1)], problem.outputs.sense)
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
