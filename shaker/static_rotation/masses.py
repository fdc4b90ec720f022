"""Masses and centres of mass from the readings of a sensor turned in gravity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from shaker.static_rotation.weight_model import (
    FORCES,
    MIN_FORCE_SHARE,
    UNKNOWNS_PER_RECORD,
    USUAL_LEVER_M,
    RotationRecord,
    SensorOutputs,
    hysteresis_share,
    start_values,
    true_direction,
    weight_load,
)
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.fitting import LMOptions, WhitenedResiduals, levenberg_marquardt
from shakercal._common.propagation import covariance_root

Number = TypeVar("Number", float, FloatArray)
ROWS = UNKNOWNS_PER_RECORD + FORCES
"""Numbers of a recording in `WeightFit`: its unknowns, then the weight from each force component."""
LEVER_M = 1.0  # standard deviation of the prior of the weight's lever without a statement
FEW_NOISE_DOF = 4.0  # of noise, with which an output's variance counts as much as the mean of its kind
HEAD_MIXING = np.array([[[0.0, -0.5], [-0.5, 0.0]], [[-0.5, 0.0], [0.0, 0.5]]])
"""Change (2, 2) of cos θ and -sin θ by errors cos 2θ and sin 2θ of an indexing head, rad."""
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
_SMALLEST_DEPARTURE, _DEPARTURE_STEP = 1e-9, 1.003
SEPARATE_ROTATION = 0.2
"""Least singular value, over the largest, of rotations of the axes that forces determine: above that of small tilts."""
UNDETERMINED_SOURCE, DISAGREEMENT_SOURCE = "components that no channel measures", "disagreeing channels"
"""Names of causes of error: priors of undetermined unknowns; deviations beyond the stated uncertainties."""
HYSTERESIS_SOURCE = "hysteresis"
EXACT_RAD = 1e-9  # of a rotation that is stated as exact


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

    `value` (R·10 + O,), for each recording in turn: weight N, first moment x y z (weight times centre of mass, N·m),
    zero angle rad, tilt of the axis rad along gravity at zero angle and across it, and the weight from Fx, Fy, Fz
    separately (NaN if a component does not determine it); then the outputs without load of recordings that determine
    them. `sources`: every cause of error with its effect on all values. `load` (R, 6): first harmonics of the load by
    the calibration matrix, NaN if not determined, or of poses. `chi_squared`, `dof`: of all outputs. `departure`,
    `moment_departure`: share of the weight, and of the weight at a lever of 0.1 m, by which forces and moments deviate
    from those of a rotated weight in addition to the stated uncertainties, 0 if the channels agree.
    """

    names: tuple[str, ...]
    value: FloatArray
    sources: tuple[WeightErrorSource, ...]
    load: ComplexArray
    chi_squared: float
    dof: float
    departure: float
    moment_departure: float

    @property
    def covariance(self) -> FloatArray:
        """Covariance of `value`."""
        return np.asarray(sum(source.effect @ source.effect.T for source in self.sources))


def fit_weights(records: Sequence[RotationRecord], outputs: SensorOutputs, u_angle_rad: float = 0.0) -> WeightFit:
    """Fit weight, first moment and true axes of every recording to all outputs.

    Parameters
    ----------
    records
        outputs per direction of gravity of each recording
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
    A weight W with first moment μ has the force W·e and the moment μ × e along gravity's direction e in true sensor
    axes. Those of an indexing head are cos θ·d - sin θ·(n × d) with the axis n and gravity's direction d at zero angle.
    Every element of the sensitivity is an unknown with its stated uncertainty, common to all recordings. Errors of the
    head's angle twice per revolution (ε_s sin 2θ + ε_c cos 2θ, `u_angle_rad` each) are unknowns too. They alone affect
    first harmonics A = a + jb: A → A - (j/2)·conj(A)·(ε_c - jε_s). Outputs are weighted by their noise.

    An F test checks the residuals of all outputs and of the force outputs. If the chance is below 1 in 1000 (for few
    readings: 1 in 100), forces have an additional uncertainty, a share of the weight that makes their χ² equal to its
    degrees of freedom (Paule & Mandel 1982, J. Res. NBS 87, 377); then moments, if they disagree as well.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import fit_weights
    >>> from shaker.static_rotation.weight_model import SensorOutputs, head_record
    >>> axis, down = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    >>> turning = down + 1j * np.cross(axis, down)
    >>> load = np.concatenate([10.0 * turning, np.cross([0.0, 0.0, 0.3], turning)])  # 10 N, 30 mm above the origin
    >>> record = head_record("bar", load, 1e-8 * np.eye(12), 20.0, axis, down)
    >>> fit = fit_weights([record], SensorOutputs(np.eye(6), np.zeros((6, 6))))
    >>> print(np.abs(fit.value[:4]).round(6))  # weight in N, first moment in N·m
    [10.   0.   0.   0.3]
    """
    from scipy.special import fdtrc

    if not records:
        raise ValueError("records: expected at least one, found none")
    fit = _WeightSolution.of(_WeightProblem(tuple(records), outputs, u_angle_rad))
    noise_dof = sum(record.dof for record in records)
    chance = CHANCE if noise_dof >= FEW_DOF else CHANCE_OF_FEW

    def agrees(test: _Test) -> bool:
        return test.dof < 0.5 or fdtrc(test.dof, noise_dof, test.excess) >= chance

    if not agrees(fit.tests[1]):
        fit = _explained(fit, 0, 1)
    if not agrees(fit.tests[0]):
        fit = _explained(fit, 0 if fit.problem.outputs.forces.all() else 1, 0)
    return _result(fit)


class _Test(NamedTuple):
    """χ² and its degrees of freedom."""

    chi_squared: float
    dof: float

    @property
    def excess(self) -> float:
        """χ² per degree of freedom, 0 without degrees of freedom."""
        return self.chi_squared / self.dof if self.dof > 0.5 else 0.0


def _explained(fit: _WeightSolution, kind: int, test: int) -> _WeightSolution:
    """Return the fit with the departure for which a test passes.

    Of forces (`kind` 0) or of moments (1).
    """
    low, high = _SMALLEST_DEPARTURE, 1.0
    while high > low * _DEPARTURE_STEP:
        middle = float(np.sqrt(low * high))
        departure = (middle, fit.problem.departure[1]) if kind == 0 else (fit.problem.departure[0], middle)
        fit = _WeightSolution.of(replace(fit.problem, departure=departure), fit.point.parameters)
        low, high = (middle, high) if fit.tests[test].excess > 1.0 else (low, middle)
    return fit


@dataclass(frozen=True)
class _WeightProblem:
    """All recordings with one sensor as a least-squares problem.

    Unknowns: those of the recordings, then the shared ones. `departure`: of forces and of moments.
    """

    records: tuple[RotationRecord, ...]
    outputs: SensorOutputs
    u_angle_rad: float
    departure: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def start(self) -> FloatArray:
        """Start values of the unknowns."""
        starts = [start_values(record, self.outputs) for record in self.records]
        return np.concatenate([*starts, np.zeros(self.shared)])

    @cached_property
    def weights(self) -> FloatArray:
        """Start values of the weights (R,)."""
        return self.start[: UNKNOWNS_PER_RECORD * len(self.records) : UNKNOWNS_PER_RECORD]

    @cached_property
    def departures(self) -> FloatArray:
        """Standard deviation of every row from `departure`, moments at the usual lever."""
        lever = np.repeat([1.0, USUAL_LEVER_M], FORCES)
        size = np.max(np.abs(self.outputs.sensitivity) * lever, axis=1)
        size = size * np.where(self.outputs.forces, *self.departure)
        pairs = zip(self.records, self.weights, strict=True)
        return np.concatenate([np.tile(weight * size, len(record.response)) for record, weight in pairs])

    @cached_property
    def force_rows(self) -> BoolArray:
        """Mask of the rows of force outputs."""
        return np.concatenate([np.tile(self.outputs.forces, len(record.response)) for record in self.records])

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
        """One over the variance of every row."""
        variance = np.concatenate([self._variance(record) for record in self.records])
        return np.asarray(1.0 / (variance + self.departures**2))

    def _variance(self, record: RotationRecord) -> FloatArray:
        """Return the variance of every row of a recording.

        With few degrees of freedom it is drawn to the mean of its kind.
        """
        variance = record.variance.reshape(record.response.shape)
        share = FEW_NOISE_DOF / (FEW_NOISE_DOF + record.dof)
        mean = np.zeros_like(variance)
        for kind in (self.outputs.forces, ~self.outputs.forces):
            mean[:, kind] = variance[:, kind].mean() if kind.any() else 0.0
        return np.asarray((1.0 - share) * variance + share * mean).ravel()

    @cached_property
    def prior(self) -> FloatArray:
        """One over the prior variance of every unknown, zero where it is free."""
        weights = []
        for record, weight in zip(self.records, self.weights, strict=True):
            lever = 1.0 / (LEVER_M * weight) ** 2
            weights += [0.0, lever, lever, lever, *(max(u, EXACT_RAD) ** -2 for u in record.u_frame)]
        return np.array([*weights, *([1.0] * self.shared)])

    def rows(self, r: int) -> slice:
        """Return the rows of a recording."""
        sizes = [record.response.size for record in self.records]
        return slice(sum(sizes[:r]), sum(sizes[: r + 1]))

    def outputs_of(
        self, r: int, vector: FloatArray, direction: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return outputs (K, C) of a recording, and their derivatives (K, C, ...).

        `direction` (K, 3): of gravity, by default that of the record.
        """
        record, own = self.records[r], slice(UNKNOWNS_PER_RECORD * r, UNKNOWNS_PER_RECORD * (r + 1))
        shared = UNKNOWNS_PER_RECORD * len(self.records)
        (rows, columns), matrix = self.elements.T, self.outputs.sensitivity.copy()
        ends = shared + len(rows)
        matrix[rows, columns] += vector[shared:ends] * self.outputs.u[rows, columns]
        load, by_unknowns = weight_load(record, vector[own], self.outputs.sense, direction)
        jacobian = np.zeros((len(load), len(matrix), len(vector)))
        if self.u_angle_rad > 0.0 and record.head and direction is None:
            jacobian[:, :, ends:] = np.einsum("cl,ekm,ml->kce", matrix, self.u_angle_rad * HEAD_MIXING, load)
            mixing = np.eye(2) + self.u_angle_rad * np.tensordot(vector[ends:], HEAD_MIXING, 1)
            load, by_unknowns = mixing @ load, np.tensordot(mixing, by_unknowns, 1)
        jacobian[:, :, own] = matrix @ by_unknowns
        jacobian[:, rows, shared + np.arange(len(rows))] = self.outputs.u[rows, columns] * load[:, columns]
        return load @ matrix.T, jacobian

    def point(self, vector: FloatArray) -> WhitenedResiduals:
        """Return the weighted residuals, and the unknowns over their prior standard deviation."""
        found = [self.outputs_of(r, vector) for r in range(len(self.records))]
        pairs = zip(self.records, found, strict=True)
        residual = np.concatenate([(output - record.response).ravel() for record, (output, _) in pairs])
        jacobian = np.concatenate([by.reshape(-1, len(vector)) for _, by in found])
        root, prior = np.sqrt(self.weight), np.sqrt(self.prior)
        stacked = np.vstack([root[:, None] * jacobian, np.diag(prior)])
        return WhitenedResiduals(vector, np.concatenate([root * residual, prior * vector]), stacked)


@dataclass(frozen=True)
class _WeightSolution:
    """A solved problem: the unknowns and their covariance for rows of variance one."""

    problem: _WeightProblem
    point: WhitenedResiduals
    inverse: FloatArray

    @staticmethod
    def of(problem: _WeightProblem, start: FloatArray | None = None) -> _WeightSolution:
        point = problem.point(problem.start if start is None else start)
        for _ in range(2 if start is None else 1):  # a gain small against the loss of a far start may exceed the noise
            point = levenberg_marquardt(problem.point, point, _RULES).point
        normal, _ = point.normal
        scale = 1.0 / np.sqrt(np.diag(normal))
        return _WeightSolution(problem, point, scale[:, None] * np.linalg.inv(normal * np.outer(scale, scale)) * scale)

    @cached_property
    def tests(self) -> tuple[_Test, _Test]:
        """χ² of all outputs and of the force outputs."""
        problem, count = self.problem, len(self.problem.records)
        squares, shares = np.split(self.point.residual**2, [len(problem.weight)])
        from_prior = (problem.prior * np.diag(self.inverse))[: UNKNOWNS_PER_RECORD * count]
        freedom = sum(self._force_freedom(r) for r in range(count))
        forces = float(squares[problem.force_rows].sum())
        every = _Test(self.point.loss, len(squares) - float(np.sum(1.0 - from_prior)))
        return every, _Test(forces + float(shares.sum()), float(freedom))

    def _force_freedom(self, r: int) -> int:
        """Return the number of force rows less that of the unknowns that they determine."""
        problem, record = self.problem, self.problem.records[r]
        rows = int(problem.outputs.forces.sum()) * len(record.response)
        if record.frame_stated:
            return max(0, rows - 1)
        unknowns = self.point.parameters[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
        seen = problem.outputs.determined[:FORCES]
        columns = weight_load(record, unknowns, 1)[1][:, :FORCES][:, seen] / np.append(1.0, np.ones(6) * unknowns[0])
        size = np.linalg.svd(columns[..., [0, 4, 5, 6]].reshape(-1, 4), compute_uv=False)
        return max(0, rows - int(np.sum(size > SEPARATE_ROTATION * max(size, default=0.0))))


def _result(fit: _WeightSolution) -> WeightFit:
    """Return values, sources and the test of a fit."""
    problem, vector, names = fit.problem, fit.point.parameters, tuple(record.name for record in fit.problem.records)
    loads, value = np.full((len(names), 6), np.nan, dtype=np.complex128), np.empty((len(names), ROWS))
    offsets = []
    for r, record in enumerate(problem.records):
        load = record.response @ problem.outputs.inverse.T
        if record.head:
            loads[r] = np.where(problem.outputs.determined, load[0] + 1j * load[1], np.nan)
        value[r, :UNKNOWNS_PER_RECORD] = vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
        value[r, UNKNOWNS_PER_RECORD:] = np.sum(load[:, :FORCES] * _projection(problem, r, vector), axis=0)
        if len(record.constant):
            offsets.append(record.constant - problem.outputs_of(r, vector, record.mean[None])[0][0])
    every = fit.tests[0]
    numbers = np.concatenate([value.ravel(), *offsets])
    return WeightFit(names, numbers, tuple(_sources(fit)), loads, every.chi_squared, every.dof, *problem.departure)


def _projection(problem: _WeightProblem, r: int, vector: FloatArray) -> FloatArray:
    """Return factors (K, 3) from force components to the weight, NaN for small ones."""
    record, rotation = problem.records[r], vector[UNKNOWNS_PER_RECORD * r + 4 : UNKNOWNS_PER_RECORD * (r + 1)]
    direction = problem.outputs.sense * true_direction(record, rotation, record.direction)
    size = np.linalg.norm(direction, axis=0)
    seen = problem.outputs.determined[:FORCES] & (size > MIN_FORCE_SHARE)
    return np.asarray(np.where(seen, direction / np.where(seen, size, 1.0) ** 2, np.nan))


def _sources(fit: _WeightSolution) -> Iterator[WeightErrorSource]:
    """Yield every cause of error with its effect on all values."""
    problem, outputs = fit.problem, fit.problem.outputs
    count, shared_start = len(problem.records), UNKNOWNS_PER_RECORD * len(problem.records)
    by_row, shared = _effects(fit)
    size, main = len(outputs.sensitivity), ROWS * count
    loops = np.zeros((len(by_row), 2))
    for r, record in enumerate(problem.records):
        by_term = by_row[:, problem.rows(r)]
        if len(record.constant):
            own = np.zeros((len(by_row), size))
            own[main : main + size] = np.eye(size)
            by_term, main = np.hstack([by_term, own]), main + size
        noise = by_term @ covariance_root(record.covariance)
        yield WeightErrorSource(f"noise of {record.name}", "A", record.dof, noise)
        for stated in record.stated:
            yield WeightErrorSource(stated.name, "B", np.inf, by_term @ stated.effect)
        for kind, outputs_of_kind in enumerate((problem.outputs.forces, ~problem.outputs.forces)):
            share = hysteresis_share(problem.records, record, outputs_of_kind) / np.sqrt(3.0)
            loops[:, kind] += by_term[:, : record.response.size] @ (share * record.response * outputs_of_kind).ravel()
    if any(record.u_length for record in problem.records):
        yield WeightErrorSource("inclination of the axis", "B", np.inf, _lengthened(fit, len(by_row)))
    if loops.any():
        yield WeightErrorSource(HYSTERESIS_SOURCE, "B", np.inf, loops)
    if any(problem.departure):
        freedom = min(test.dof for test in fit.tests if test.dof > 0.5)
        yield WeightErrorSource(DISAGREEMENT_SOURCE, "A", freedom, by_row * problem.departures)
    ends = shared_start + len(problem.elements)
    if len(problem.elements):
        yield WeightErrorSource("calibration matrix", "B", np.inf, shared[:, shared_start:ends])
    if problem.u_angle_rad > 0.0:
        yield WeightErrorSource("angle of the head", "B", np.inf, shared[:, ends:])
    stated_frames = [r for r in range(count) if problem.records[r].frame_stated]
    frames = [UNKNOWNS_PER_RECORD * r + 4 + i for r in stated_frames for i in range(3)]
    weak = [UNKNOWNS_PER_RECORD * r + i for r in range(count) for i in range(1, UNKNOWNS_PER_RECORD)]
    weak = [unknown for unknown in weak if unknown not in frames and problem.prior[unknown] > 0.0]
    for name, unknowns in (("rotation of the sensor on the flange", frames), (UNDETERMINED_SOURCE, weak)):
        if unknowns:
            effect = shared[:, unknowns] / np.sqrt(problem.prior[unknowns])
            yield WeightErrorSource(name, "B", np.inf, effect)


def _lengthened(fit: _WeightSolution, size: int) -> FloatArray:
    """Return the effect (V, 1) of one standard deviation of the length of gravity's direction."""
    problem, effect = fit.problem, np.zeros((size, 1))
    rows = effect[: ROWS * len(problem.records)].reshape(-1, ROWS)
    for r, record in enumerate(problem.records):
        unknowns = fit.point.parameters[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
        rows[r, :4] = record.u_length * unknowns[:4]
        rows[r, UNKNOWNS_PER_RECORD:] = record.u_length * unknowns[0]
    return effect


def _effects(fit: _WeightSolution) -> tuple[FloatArray, FloatArray]:
    """Return the effects (V, ...) of errors of rows and of deviations from priors."""
    problem, vector, outputs = fit.problem, fit.point.parameters, fit.problem.outputs
    count, (row, column) = len(problem.records), problem.elements.T
    shared_start = UNKNOWNS_PER_RECORD * count
    wide = np.zeros((ROWS * count, len(vector)))  # derivatives of the values by the unknowns
    unit = np.eye(shared_start).reshape(count, UNKNOWNS_PER_RECORD, shared_start)
    wide.reshape(count, ROWS, -1)[:, :UNKNOWNS_PER_RECORD, :shared_start] = unit
    means = [(r, record.mean) for r, record in enumerate(problem.records) if len(record.constant)]
    wide = np.vstack([wide, *(-problem.outputs_of(r, vector, mean[None])[1][0] for r, mean in means)])
    by_row = wide @ fit.inverse @ (fit.point.jacobian[: len(problem.weight)].T * np.sqrt(problem.weight))
    shared = -wide @ (fit.inverse * problem.prior)
    for r, record in enumerate(problem.records):  # weights from each force component have separate effects
        alone = slice(ROWS * r + UNKNOWNS_PER_RECORD, ROWS * (r + 1))
        projection = _projection(problem, r, vector)
        by_row[alone, problem.rows(r)] = (projection.T[:, :, None] * outputs.inverse[:FORCES, None]).reshape(FORCES, -1)
        unknowns = vector[UNKNOWNS_PER_RECORD * r : UNKNOWNS_PER_RECORD * (r + 1)]
        load, _ = weight_load(record, unknowns, outputs.sense)
        by_element = outputs.inverse[:FORCES, row] * outputs.u[row, column] * (projection.T @ load[:, column])
        every = [by_element]
        if problem.u_angle_rad > 0.0:
            mixed = problem.u_angle_rad * HEAD_MIXING @ load[:, :FORCES] if record.head else np.zeros((2, 1, FORCES))
            every.append(np.sum(mixed * projection, axis=1).T)
        shared[alone, shared_start:] = np.hstack(every)
    return by_row, shared
