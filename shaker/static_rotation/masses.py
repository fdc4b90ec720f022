"""Masses and centres of mass from the readings of an indexing head."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray, check_shape
from shakercal._common.fitting import LMOptions, WhitenedResiduals, levenberg_marquardt
from shakercal._common.propagation import covariance_root

FORCES = 3
UNKNOWNS_PER_RECORD = 7
"""Unknowns of a recording: weight N, first moment N·m (3), zero angle rad, tilt of the axis rad (2)."""
MIN_FORCE_SHARE = 0.3
"""Smallest share of the weight in a force component, at some angle, for a separate weight."""
DETERMINED = 1e-6  # tolerance of the unit matrix


@dataclass(frozen=True, repr=False)
class SensorOutputs(Arrays, shapes="sensitivity C 6; u C 6"):
    """Response of C outputs to the load.

    `sensitivity` (C, 6): output per Fx … Mz; `u` (C, 6) of every element, independent. `sense`: +1 for outputs that are
    positive for the load on the sensor, -1 for the force of the sensor on its load.
    """

    sensitivity: FloatArray
    u: FloatArray
    sense: Literal[1, -1] = 1

    @cached_property
    def inverse(self) -> FloatArray:
        """Calibration matrix (6, C), load per output: pseudo-inverse with columns scaled to one size."""
        size = np.linalg.norm(self.sensitivity, axis=0)
        scale = np.where(size > 0.0, size, 1.0)
        return np.asarray(np.linalg.pinv(self.sensitivity / scale, rcond=1e-9) / scale[:, None])

    @cached_property
    def determined(self) -> BoolArray:
        """Mask (6,) of the load components that the outputs separate from all others."""
        identity = self.inverse @ self.sensitivity
        return np.asarray(np.all(np.abs(identity - np.eye(6)) < DETERMINED, axis=1))


@dataclass(frozen=True, repr=False)
class RotationRecord(Arrays, shapes="amplitude C; axis 3; down 3"):
    """One recording: first harmonics of the C outputs and the orientation of the head.

    `amplitude` (C,): output = Re{amplitude exp(+jθ)}, θ is the rotation of the sensor, right-handed about `axis` (3,).
    `covariance` (2C, 2C) of [all Re, all Im], of noise with `dof` degrees of freedom. `down` (3,): direction of gravity
    at θ = 0. Both are unit vectors in sensor axes.
    """

    name: str
    amplitude: ComplexArray
    covariance: FloatArray
    dof: float
    axis: FloatArray
    down: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape("covariance", self.covariance, (2 * len(self.amplitude),) * 2)
        if np.linalg.norm(np.cross(self.axis, self.down)) < 0.5:
            raise ValueError("axis: expected one across gravity, found one within 30 degrees of it")

    @cached_property
    def frame(self) -> tuple[float, FloatArray, FloatArray]:
        """Rotating share of gravity, its direction at θ = 0, and axis × direction."""
        across = self.down - self.axis * float(self.axis @ self.down)
        share = float(np.linalg.norm(across))
        return share, across / share, np.cross(self.axis, across) / share


def weight_load(record: RotationRecord, unknowns: FloatArray, sense: int) -> tuple[ComplexArray, ComplexArray]:
    """Return the load phasor (6,) of a recording's unknowns (7,), and its derivatives (6, 7)."""
    share, _, _ = record.frame
    turn = sense * np.exp(1j * unknowns[4])
    phasor = turn * turning_phasor(record, unknowns[5:])
    tilts = turn * share * np.outer(record.axis, [-1.0, -1j])
    columns = np.zeros((6, UNKNOWNS_PER_RECORD), np.complex128)
    columns[:3, 0] = phasor
    columns[3:, 1:4] = np.cross(np.eye(3), phasor).T
    load = columns[:, :4] @ unknowns[:4]
    columns[:, 4] = 1j * load
    columns[:3, 5:] = unknowns[0] * tilts
    columns[3:, 5:] = np.cross(unknowns[1:4], tilts, axisb=0).T
    return np.asarray(load), columns


def start_values(record: RotationRecord, outputs: SensorOutputs) -> FloatArray:
    """Return start values (7,) of a recording; the opposite sense of rotation is refused."""
    phasor = outputs.sense * turning_phasor(record, np.zeros(2))
    seen = outputs.determined[:FORCES] & (np.abs(phasor) > MIN_FORCE_SHARE)
    if not seen.any():
        raise ValueError("sensitivity: expected an output for a force across the axis, found none")
    force, size = (outputs.inverse @ record.amplitude)[:FORCES][seen], np.sum(np.abs(phasor[seen]) ** 2)
    with_axis = np.sum(force * np.conj(phasor[seen])) / size
    against = np.sum(force * phasor[seen]) / size
    if abs(against) > 1.5 * abs(with_axis):
        raise ValueError(
            "axis: expected a rotation for which gravity rotates backwards in the sensor, found the opposite sense; "
            "reverse the axis"
        )
    if abs(with_axis) == 0.0:
        raise ValueError("amplitude: expected forces that change with the angle, found none")
    return np.array([abs(with_axis), 0.0, 0.0, 0.0, float(np.angle(with_axis)), 0.0, 0.0])


def turning_phasor(record: RotationRecord, tilt: FloatArray) -> ComplexArray:
    """Return gravity's direction (3,) in sensor axes as a phasor, the axis tilted."""
    from scipy.spatial.transform import Rotation

    share, along, across = record.frame
    turn = Rotation.from_rotvec(tilt[0] * across - tilt[1] * along).as_matrix()
    return np.asarray(share * (turn @ (along + 1j * across)))


# Weights, first moments and masses from the first harmonic of a sensor rotated about a horizontal axis.

Number = TypeVar("Number", float, FloatArray)
ROWS = UNKNOWNS_PER_RECORD + FORCES
"""Numbers of a recording in `WeightFit`: its unknowns, then the weight from each force component."""
LEVER_M, TILT_RAD = 1.0, 0.1
"""Standard deviations of the priors without a statement: lever of the weight, tilt of the axis."""
USUAL_LEVER_M = 0.1
"""Lever at which forces and moments have equal weight in the classification of outputs."""
CHANCE, CHANCE_OF_FEW, FEW_DOF = 1e-3, 1e-2, 5.0
"""Probability of a false disagreement of channels; larger with few degrees of freedom."""
_RULES = LMOptions(
    predicted_decrease=1e-14,
    predicted_decrease_share=0.0,
    max_steps=20,
    max_dampings=8,
    initial_damping=1e-9,
    min_damping=1e-12,
)
"""A fit has converged if a step would be 1e-7 of the standard uncertainties."""
_SMALLEST_DEPARTURE, _DEPARTURE_STEP = 1e-9, 1.001
UNDETERMINED_SOURCE, DISAGREEMENT_SOURCE = "components that no channel measures", "disagreeing channels"
"""Names of causes of error: priors of undetermined unknowns; deviations beyond the stated uncertainties."""


def mass_of_weight(weight_n: Number, gravity_mps2: Number, air_share: Number | float = 0.0) -> Number:
    """Return the mass in kg of a weight in air, m = F/(g·(1 - ρ_air/ρ)).

    `air_share`: ρ_air/ρ of the body. Nitsche et al. 2018, eq. 7, without buoyancy (`air_share` 0).
    """
    return weight_n / (gravity_mps2 * (1.0 - air_share))


class WeightErrorSource(NamedTuple):
    """Independent errors of one kind, `effect` (V, r) of r unit deviations."""

    name: str
    kind: Literal["A", "B"]
    dof: float
    effect: FloatArray


@dataclass(frozen=True, repr=False)
class WeightFit(Arrays, shapes="names R; load R 6"):
    """Weights of R recordings with one sensor.

    `value` (R·10,), for each recording in turn: weight N, first moment x y z (weight times centre of mass, N·m), zero
    angle rad, tilt of the axis rad along gravity at zero angle and across it, and the weight from Fx, Fy, Fz separately
    (NaN if a component does not determine it). `sources`: every cause of error with its effect on all values. `load`
    (R, 6): first harmonics of the load by the calibration matrix, NaN if not determined. `chi_squared`, `dof`: of all
    outputs. `departure`: share of the weight by which first harmonics deviate from that of a rotated weight in addition
    to the stated uncertainties, 0 if the channels agree.
    """

    names: tuple[str, ...]
    value: FloatArray
    sources: tuple[WeightErrorSource, ...]
    load: ComplexArray
    chi_squared: float
    dof: float
    departure: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape("value", self.value, (ROWS * len(self.names),))

    @property
    def covariance(self) -> FloatArray:
        """Covariance of `value`."""
        return np.asarray(sum(source.effect @ source.effect.T for source in self.sources))


def fit_weights(records: Sequence[RotationRecord], outputs: SensorOutputs, u_angle_rad: float = 0.0) -> WeightFit:
    """Fit weight, first moment, zero angle and axis of every recording to all first harmonics.

    Parameters
    ----------
    records
        first harmonics of each recording
    outputs
        sensitivity of the outputs with its uncertainty
    u_angle_rad
        standard uncertainty of the head's angle errors twice per revolution, rad, default 0

    Returns
    -------
    WeightFit : values with the effects of all causes of error

    Raises
    ------
    ValueError : no record, no output for a force across the axis, or readings for the opposite sense of rotation

    Notes
    -----
    In sensor axes gravity rotates backwards: force = W·U·exp(jθ₀), moment = μ × U·exp(jθ₀), U = d + j n × d with the
    axis n and gravity's direction d at zero angle. Every element of the sensitivity is an unknown with its stated
    uncertainty, common to all recordings. Errors of the head's angle twice per revolution (ε_s sin 2θ + ε_c cos 2θ,
    `u_angle_rad` each) are unknowns too. They alone affect first harmonics: A → A - (j/2)·conj(A)·(ε_c - jε_s). Outputs
    are weighted by their noise.

    An F test checks the residuals of all outputs and of the force outputs. If the chance is below 1 in 1000 (for few
    readings: 1 in 100), every first harmonic has an additional uncertainty, a share of the weight that makes χ² equal
    to its degrees of freedom (Paule & Mandel 1982, J. Res. NBS 87, 377).

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import fit_weights
    >>> from shaker.static_rotation.masses import RotationRecord, SensorOutputs
    >>> axis, down = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    >>> turning = down + 1j * np.cross(axis, down)
    >>> load = np.concatenate([10.0 * turning, np.cross([0.0, 0.0, 0.3], turning)])  # 10 N, 30 mm above the origin
    >>> record = RotationRecord("bar", load, 1e-8 * np.eye(12), 20.0, axis, down)
    >>> fit = fit_weights([record], SensorOutputs(np.eye(6), np.zeros((6, 6))))
    >>> print(np.abs(fit.value[:4]).round(6))  # weight in N, first moment in N·m
    [10.   0.   0.   0.3]
    """
    from scipy.special import fdtrc

    if not records:
        raise ValueError("records: expected at least one, found none")
    problem = _WeightProblem(tuple(records), outputs, u_angle_rad)
    fit = _WeightSolution.of(problem)
    noise_dof = sum(record.dof for record in records)
    chance = CHANCE if noise_dof >= FEW_DOF else CHANCE_OF_FEW
    if all(test.dof < 0.5 or fdtrc(test.dof, noise_dof, test.excess) >= chance for test in fit.tests):
        return _result(fit)
    low, high = _SMALLEST_DEPARTURE, 1.0
    while high > low * _DEPARTURE_STEP:
        middle = float(np.sqrt(low * high))
        fit = _WeightSolution.of(replace(problem, departure=middle))
        low, high = (middle, high) if max(test.excess for test in fit.tests) > 1.0 else (low, middle)
    return _result(fit)


class _Test(NamedTuple):
    """χ² and its degrees of freedom."""

    chi_squared: float
    dof: float

    @property
    def excess(self) -> float:
        """χ² per degree of freedom, 0 without degrees of freedom."""
        return self.chi_squared / self.dof if self.dof > 0.5 else 0.0


@dataclass(frozen=True)
class _WeightProblem:
    """All recordings with one sensor as a least-squares problem of real rows.

    Unknowns: those of the recordings, then the shared ones.
    """

    records: tuple[RotationRecord, ...]
    outputs: SensorOutputs
    u_angle_rad: float
    departure: float = 0.0

    @cached_property
    def start(self) -> FloatArray:
        """Start values of the unknowns."""
        starts = [start_values(record, self.outputs) for record in self.records]
        return np.concatenate([*starts, np.zeros(self.shared)])

    @cached_property
    def departures(self) -> FloatArray:
        """Standard deviation of every real row from `departure`, moments at the usual lever."""
        lever = np.repeat([1.0, USUAL_LEVER_M], FORCES)
        size = np.max(np.abs(self.outputs.sensitivity) * lever, axis=1)
        weights = self.start[: UNKNOWNS_PER_RECORD * len(self.records) : UNKNOWNS_PER_RECORD]
        return self.departure * np.concatenate([np.tile(weight * size, 2) for weight in weights])

    @cached_property
    def forces(self) -> BoolArray:
        """Mask (C,) of outputs that respond to forces rather than moments."""
        size = np.abs(self.outputs.sensitivity)
        return np.asarray(size[:, :FORCES].sum(axis=1) > USUAL_LEVER_M * size[:, FORCES:].sum(axis=1))

    @cached_property
    def elements(self) -> IntArray:
        """Rows (E, 2) of the uncertain elements of the sensitivity."""
        return np.argwhere(self.outputs.u > 0.0)

    @property
    def shared(self) -> int:
        """Number of shared unknowns: elements, then twice-per-revolution errors (cos, sin) of the head."""
        return len(self.elements) + (2 if self.u_angle_rad > 0.0 else 0)

    @cached_property
    def weight(self) -> FloatArray:
        """One over the variance of every real row."""
        variance = np.concatenate([np.diag(record.covariance) for record in self.records])
        return np.asarray(1.0 / (variance + self.departures**2))

    @cached_property
    def prior(self) -> FloatArray:
        """One over the prior variance of every unknown, zero where it is free."""
        weights = []
        for weight in self.start[: UNKNOWNS_PER_RECORD * len(self.records) : UNKNOWNS_PER_RECORD]:
            lever = 1.0 / (LEVER_M * weight) ** 2
            weights += [0.0, lever, lever, lever, 0.0, TILT_RAD**-2, TILT_RAD**-2]
        return np.array([*weights, *([1.0] * self.shared)])

    def point(self, vector: FloatArray) -> WhitenedResiduals:
        """Return the weighted residuals, and the unknowns over their prior standard deviation."""
        residuals, blocks = [], []
        shared_start = UNKNOWNS_PER_RECORD * len(self.records)
        elements, matrix = self.elements, self.outputs.sensitivity.copy()
        rows, columns = elements.T
        matrix[rows, columns] += vector[shared_start : shared_start + len(elements)] * self.outputs.u[rows, columns]
        for r, record in enumerate(self.records):
            load, by_unknowns = weight_load(
                record, vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)], self.outputs.sense
            )
            if self.u_angle_rad > 0.0:
                twice = self.u_angle_rad * complex(vector[-2], -vector[-1])
                by_head = -0.5j * np.conj(load)[:, None] * self.u_angle_rad * np.array([1.0, -1j])
                by_unknowns = by_unknowns - 0.5j * np.conj(by_unknowns) * twice
                load = load - 0.5j * np.conj(load) * twice
            else:
                by_head = np.zeros((6, 0), np.complex128)
            jacobian = np.zeros((len(matrix), len(vector)), np.complex128)
            jacobian[:, UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)] = matrix @ by_unknowns
            jacobian[rows, shared_start + np.arange(len(elements))] = self.outputs.u[rows, columns] * load[columns]
            jacobian[:, shared_start + len(elements) :] = matrix @ by_head
            missing = record.amplitude - matrix @ load
            residuals += [missing.real, missing.imag]
            blocks += [jacobian.real, jacobian.imag]
        root, prior = np.sqrt(self.weight), np.sqrt(self.prior)
        residual = np.concatenate([root * -np.concatenate(residuals), prior * vector])
        return WhitenedResiduals(vector, residual, np.vstack([root[:, None] * np.concatenate(blocks), np.diag(prior)]))


@dataclass(frozen=True)
class _WeightSolution:
    """A solved problem: the unknowns and their covariance for rows of variance one."""

    problem: _WeightProblem
    point: WhitenedResiduals
    inverse: FloatArray

    @staticmethod
    def of(problem: _WeightProblem) -> _WeightSolution:
        point = problem.point(problem.start)
        for _ in range(2):  # a gain that is small against the loss of a far start may be large against the noise
            point = levenberg_marquardt(problem.point, point, _RULES).point
        normal, _ = point.normal
        scale = 1.0 / np.sqrt(np.diag(normal))
        return _WeightSolution(problem, point, scale[:, None] * np.linalg.inv(normal * np.outer(scale, scale)) * scale)

    @property
    def tests(self) -> tuple[_Test, _Test]:
        """χ² of all outputs and of the force outputs."""
        problem, count = self.problem, len(self.problem.records)
        squares, shares = np.split(self.point.residual**2, [len(problem.weight)])
        from_prior = (problem.prior * np.diag(self.inverse))[: UNKNOWNS_PER_RECORD * count]
        rows = 2 * int(problem.forces.sum())
        freedom = count * max(0, rows - 2 - (2 if rows > 4 else 0))
        forces = float(squares.reshape(count, 2, -1)[:, :, problem.forces].sum())
        every = _Test(self.point.loss, len(squares) - float(np.sum(1.0 - from_prior)))
        return every, _Test(forces + float(shares.sum()), float(freedom))


def _result(fit: _WeightSolution) -> WeightFit:
    """Return values, sources and the test of a fit."""
    problem, vector, names = fit.problem, fit.point.parameters, tuple(record.name for record in fit.problem.records)
    loads, value = np.full((len(names), 6), np.nan, dtype=np.complex128), np.empty((len(names), ROWS))
    for r, record in enumerate(problem.records):
        loads[r] = np.where(problem.outputs.determined, problem.outputs.inverse @ record.amplitude, np.nan)
        value[r, :UNKNOWNS_PER_RECORD] = vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
        value[r, UNKNOWNS_PER_RECORD:] = np.real(loads[r, :FORCES] * _projection(problem, r, vector))
    every = fit.tests[0]
    return WeightFit(names, value.ravel(), tuple(_sources(fit)), loads, every.chi_squared, every.dof, problem.departure)


def _projection(problem: _WeightProblem, r: int, vector: FloatArray) -> ComplexArray:
    """Return factors (3,) from a force component to the weight, NaN for small ones."""
    unknowns = vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
    phasor = problem.outputs.sense * np.exp(1j * unknowns[4]) * turning_phasor(problem.records[r], unknowns[5:])
    size = np.abs(phasor)
    seen = problem.outputs.determined[:FORCES] & (size > MIN_FORCE_SHARE)
    return np.asarray(np.where(seen, np.conj(phasor) / np.where(seen, size, 1.0) ** 2, np.nan))


def _sources(fit: _WeightSolution) -> Iterator[WeightErrorSource]:
    """Yield every cause of error with its effect on all values."""
    problem, vector, outputs = fit.problem, fit.point.parameters, fit.problem.outputs
    count, elements, u_angle = len(problem.records), problem.elements, problem.u_angle_rad
    shared_start, (row, column) = UNKNOWNS_PER_RECORD * count, elements.T
    wide = np.zeros((ROWS * count, len(vector)))  # derivatives of the values by the unknowns
    unit = np.eye(shared_start).reshape(count, UNKNOWNS_PER_RECORD, shared_start)
    wide.reshape(count, ROWS, -1)[:, :UNKNOWNS_PER_RECORD, :shared_start] = unit
    by_row = wide @ fit.inverse @ (fit.point.jacobian[: len(problem.weight)].T * np.sqrt(problem.weight))
    shared = -wide @ (fit.inverse * problem.prior)
    size = 2 * len(outputs.sensitivity)
    for r, record in enumerate(problem.records):  # weights from each force component have separate effects
        alone, rows = slice(ROWS * r + UNKNOWNS_PER_RECORD, ROWS * (r + 1)), slice(size * r, size * (r + 1))
        projection = _projection(problem, r, vector)[:, None]
        to_load = outputs.inverse[:FORCES] * projection
        by_row[alone, rows] = np.hstack([to_load.real, -to_load.imag])
        load, _ = weight_load(record, vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)], outputs.sense)
        by_element = outputs.inverse[:FORCES, row] * outputs.u[row, column] * load[column]
        by_head = -0.5j * u_angle * np.conj(load[:FORCES, None]) * np.array([1.0, -1j])
        every = np.hstack([by_element, by_head]) if u_angle > 0.0 else by_element
        shared[alone, shared_start:] = np.real(every * projection)
        yield WeightErrorSource(
            f"noise of {record.name}", "A", record.dof, by_row[:, rows] @ covariance_root(record.covariance)
        )
    if problem.departure > 0.0:
        freedom = min(test.dof for test in fit.tests if test.dof > 0.5)
        yield WeightErrorSource(DISAGREEMENT_SOURCE, "A", freedom, by_row * problem.departures)
    ends = shared_start + len(elements)
    if len(elements):
        yield WeightErrorSource("calibration matrix", "B", np.inf, shared[:, shared_start:ends])
    if u_angle > 0.0:
        yield WeightErrorSource("angle of the head", "B", np.inf, shared[:, ends:])
    weak = [UNKNOWNS_PER_RECORD * r + unknown for r in range(count) for unknown in (1, 2, 3, 5, 6)]
    yield WeightErrorSource(UNDETERMINED_SOURCE, "B", np.inf, shared[:, weak] / np.sqrt(problem.prior[weak]))
