"""Least-squares problem of an identification: readings, vector of unknowns, starts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shaker.identification.measured_curves import REFERENCE_INDEX, MeasuredTransfer, PlacementError, whitening_matrices
from shaker.identification.structures import MechanicalStructure, StructureParameter
from shaker.mechanics import FrequencyTerms, MechanicalResponse, Mechanics, poles, respond
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.fitting import LMOptions, WhitenedResiduals, levenberg_marquardt

_ROUNDING = 1e-12  # share of a change below which it is rounding


@dataclass(frozen=True, repr=False)
class Displacements(Arrays):
    """Change of C readings for one standard deviation of S uncertain placements.

    `unknown_indices` (S,). `rows` (S, C, n) of p, `offset` (S, C) of the base motion and `reference` (S,) of its
    reading.
    """

    unknown_indices: IntArray
    rows: FloatArray
    offset: FloatArray
    reference: FloatArray

    def moved(self, mechanics: Mechanics, vector: FloatArray) -> Mechanics:
        """Return the mechanics as the displaced transducers read them."""
        if not len(self.unknown_indices):
            return mechanics
        off = vector[self.unknown_indices]
        return replace(
            mechanics,
            rows=mechanics.rows + np.tensordot(off, self.rows, 1),
            offset=mechanics.offset + off @ self.offset,
            reference_offset=mechanics.reference_offset + float(off @ self.reference),
        )

    def derivatives(self, response: MechanicalResponse) -> ComplexArray:
        """Return the derivatives (K, C, S) of the ratios."""
        above = np.einsum("kn,scn->kcs", response.motion, self.rows) + self.offset.T
        return np.asarray(
            (above - response.value[:, :, None] * self.reference) / response.reference_reading[:, None, None]
        )


def effective_placement_errors(record: MeasuredTransfer, body: FloatArray) -> tuple[PlacementError, ...]:
    """Return the placement errors that change a reading of a load on `body`."""
    seen = np.column_stack([record.drive / np.linalg.norm(record.drive), body])
    return tuple(
        error
        for error in record.placement_errors
        if np.abs(error.change @ (seen[:, :1] if error.response_index == REFERENCE_INDEX else seen)).max()
        > _ROUNDING * np.abs(error.change).max()
    )


def displacements(record: MeasuredTransfer, body: FloatArray, names: Mapping[str, int]) -> Displacements:
    """Return the effective placement errors of a recording, indexed by their `names`."""
    errors = effective_placement_errors(record, body)
    changes = np.reshape([error.change for error in errors], (len(errors), 6))
    response = np.array([error.response_index for error in errors], dtype=np.int64)
    mask = (response[:, None] == np.arange(len(record.tops))).astype(np.float64)
    along = changes @ record.drive
    return Displacements(
        unknown_indices=np.array([names[f"error: {error.name}"] for error in errors], dtype=np.int64),
        rows=mask[:, :, None] * (changes @ body)[:, None],
        offset=mask * along[:, None],
        reference=along * (response == REFERENCE_INDEX),
    )


@dataclass(frozen=True, repr=False)
class LoadBending(Arrays):
    """Contribution of an elastic load to its mechanics, as stated and per unknown.

    `unknown_indices` (V,): indices of the unknowns. `mass` (1+V, K, n, n), `forcing` (1+V, K, n), `rows` (1+V, K, C, n)
    and `offset` (1+V, K, C) as in the frequency-dependent part of `respond`.
    """

    unknown_indices: IntArray
    mass: ComplexArray
    forcing: ComplexArray
    rows: ComplexArray
    offset: ComplexArray

    def at(self, vector: FloatArray) -> FrequencyTerms:
        """Return the contribution for a vector of unknowns."""
        weights = np.concatenate([[1.0], vector[self.unknown_indices]])
        return FrequencyTerms(
            *(np.tensordot(weights, part, 1) for part in (self.mass, self.forcing, self.rows, self.offset))
        )

    def derivatives(self, response: MechanicalResponse, s: ComplexArray) -> ComplexArray:
        """Return the derivatives (K, C, V) of the ratios."""
        pull = np.einsum("vkij,kj->vki", self.mass[1:], response.motion) + self.forcing[1:]
        read = np.einsum("vkcj,kj->kcv", self.rows[1:], response.motion) + self.offset[1:].transpose(1, 2, 0)
        moved = np.einsum("kci,vki->kcv", response.adjoint, pull) * s[:, None, None] ** 2
        return np.asarray(read / response.reference_reading[:, None, None] - moved)


def load_bending(
    record: MeasuredTransfer, body: FloatArray, names: Mapping[str, int]
) -> tuple[LoadBending | None, FloatArray]:
    """Return the elastic contribution of a recording's load, and a constant mass (6, 6).

    The constant mass is the elastic contribution at the line of the largest ratio. It is added to the rigid mass, so
    that poles are those of the load near its resonance, and is subtracted from the first result.
    """
    if record.bending is None:
        return None, np.zeros((6, 6))
    inertia, stretch = record.bending.inertia.copy(), record.bending.stretch
    line = int(np.argmax(np.abs(record.ratio.value).max(axis=1)))
    constant = inertia[0, line].real.copy()
    inertia[0] -= constant
    pull, read = np.einsum("im,vkij->vkmj", body, inertia), record.drive
    indices = np.array([names[f"error: {name}"] for name in record.bending.names], dtype=np.int64)
    return LoadBending(indices, pull @ body, pull @ read, stretch @ body, stretch @ read), constant


@dataclass(frozen=True, repr=False)
class RecordingModel(Arrays):
    """Model of one recording with the indices of its unknowns.

    `terms` (P+E,): indices of the weights of `mechanics`. `factors` (F,): indices of the factors exp(z · `relative` (K,
    C, F)) on the ratios. `displacements`: of displaced transducers. `bends`: of an elastic load, None for a rigid one.
    `clock`: index of the clock error, -1 without one. `whitening` (K, 2C, 2C).
    """

    record: MeasuredTransfer
    mechanics: Mechanics
    terms: IntArray
    factors: IntArray
    relative: ComplexArray
    displacements: Displacements
    bends: LoadBending | None
    clock: int
    whitening: FloatArray

    def weights(self, vector: FloatArray) -> FloatArray:
        """Return the weights (1+P+E,) of the mechanics' terms."""
        return np.concatenate([[1.0], vector[self.terms]])

    def possible(self, vector: FloatArray) -> bool:
        """Return whether mass and stiffness matrices are positive definite."""
        (mass, _, stiffness), _ = self.mechanics.at(self.weights(vector))
        if len(mass) == 1:
            return bool(min(mass[0, 0], stiffness[0, 0]) > 0.0)
        return bool(min(np.linalg.eigvalsh(mass)[0], np.linalg.eigvalsh(stiffness)[0]) > 0.0)

    def poles(self, vector: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the poles (n,) of the mechanics and their derivatives (n, N) by all unknowns."""
        roots, by_term = poles(self.mechanics, self.weights(vector))
        by_unknown = np.zeros((len(roots), len(vector)), dtype=np.complex128)
        np.add.at(by_unknown.T, self.terms, by_term.T)
        return roots, by_unknown

    def has_same_poles(self, other: RecordingModel) -> bool:
        """Return whether another recording has the same load, and therefore the same poles."""
        matrices, its = self.mechanics.matrices, other.mechanics.matrices
        return np.array_equal(self.terms, other.terms) and np.array_equal(matrices, its)

    @property
    def unknown_indices(self) -> IntArray:
        """Indices of the unknowns that belong to the columns of the derivatives."""
        last = [] if self.bends is None else [self.bends.unknown_indices]
        last += [np.array([self.clock])] if self.clock >= 0 else []
        return np.concatenate([self.terms, self.factors, self.displacements.unknown_indices, *last])

    def modelled(self, vector: FloatArray) -> ModelledRatios:
        """Return the ratios for a vector of unknowns."""
        u_clock = self.record.u_clock if self.clock >= 0 else 0.0
        s = self.record.s * (1.0 + u_clock * vector[self.clock])
        bending = None if self.bends is None else self.bends.at(vector)
        response = respond(self.displacements.moved(self.mechanics, vector), self.weights(vector), s, bending)
        return ModelledRatios(self, response, np.exp(self.relative @ vector[self.factors]))

    def whitened(self, deviation: ComplexArray) -> FloatArray:
        """Return complex deviations (K, C, L) as whitened real ones (K, 2C, L)."""
        return np.asarray(self.whitening @ np.concatenate([deviation.real, deviation.imag], axis=1))


@dataclass(frozen=True, repr=False)
class ModelledRatios(Arrays):
    """Ratios of one recording for a vector of unknowns: `response` times `factor` (K, C)."""

    curve: RecordingModel
    response: MechanicalResponse
    factor: ComplexArray

    @cached_property
    def value(self) -> ComplexArray:
        """Ratios (K, C)."""
        return np.asarray(self.response.value * self.factor)

    @property
    def derivatives(self) -> ComplexArray:
        """Derivatives (K, C, L) of the ratios by the unknowns at `unknown_indices`."""
        curve, response, factor = self.curve, self.response, self.factor[:, :, None]
        moved = curve.displacements.derivatives(response) * factor
        columns = [response.by_term * factor, self.value[:, :, None] * curve.relative, moved]
        if curve.bends is not None:
            columns.append(curve.bends.derivatives(response, response.s) * factor)
        if curve.clock >= 0:
            columns.append((curve.record.u_clock * response.by_log_s)[:, :, None] * factor)
        return np.concatenate(columns, axis=2)


@dataclass(frozen=True, repr=False)
class IdentificationProblem(Arrays):
    """All recordings and all unknowns (N,): parameters, then named errors.

    `parameters`: the fitted ones; `kind` (P,): index of each in the structure. `names` (N,). The prior of an unknown is
    `expected` (N,) with `precision` (N,) = 1/u², zero without a prior. Unknowns in the mask `fixed` (N,) stay at
    `expected`.
    """

    curves: tuple[RecordingModel, ...]
    parameters: tuple[StructureParameter, ...]
    kind: IntArray
    names: tuple[str, ...]
    expected: FloatArray
    precision: FloatArray
    fixed: BoolArray

    def weighed(self, factors: Sequence[FloatArray]) -> IdentificationProblem:
        """Return the problem with the covariances of its lines multiplied by `factors` (K,) per recording."""
        curves = [
            replace(curve, whitening=curve.whitening / np.sqrt(factor)[:, None, None])
            for curve, factor in zip(self.curves, factors, strict=True)
        ]
        return replace(self, curves=tuple(curves))


def whole_inertia(problem: IdentificationProblem, vector: FloatArray) -> FloatArray:
    """Return the smallest inertia (P,) that contains each parameter, NaN for springs and dampers."""
    whole = np.full(len(problem.kind), np.nan)
    for curve in problem.curves:
        mass = curve.mechanics.at(curve.weights(vector))[0][0].diagonal()
        for index, matrices in zip(curve.terms, curve.mechanics.matrices[1:], strict=True):
            share = matrices[0].diagonal()
            if index < len(whole) and np.any(share > 0.0):
                whole[index] = np.fmin(whole[index], np.min(mass[share > 0.0] / share[share > 0.0]))
    return whole


def build_problem(
    records: Sequence[MeasuredTransfer],
    structure: MechanicalStructure,
    stated_values: Mapping[str, tuple[float, float]],
    each_recording: Collection[str],
) -> IdentificationProblem:
    """Return the recordings and unknowns as a least-squares problem."""
    _check(records, structure, stated_values, each_recording)
    parameters, kinds, indices = _parameters(records, structure, each_recording)
    names = {parameter.name: index for index, parameter in enumerate(parameters)}
    first_error = len(names)
    for record in records:
        causes = [error.name for error in record.errors] + [error.name for error in record.inertia_errors]
        causes += [error.name for error in effective_placement_errors(record, structure.body)]
        causes += () if record.bending is None else record.bending.names
        for name in [*causes, record.clock] if record.u_clock > 0.0 else causes:
            names.setdefault(f"error: {name}", len(names))
    curves = tuple(_curve(record, structure, index, names) for record, index in zip(records, indices, strict=True))
    count = len(names)
    expected, precision, fixed = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.bool_)
    precision[first_error:] = 1.0
    for index, kind in enumerate(kinds):
        if (stated := stated_values.get(structure.parameters[kind].name)) is not None:
            expected[index], fixed[index] = stated[0], stated[1] == 0.0
            precision[index] = 0.0 if fixed[index] else 1.0 / stated[1] ** 2
    return IdentificationProblem(curves, parameters, np.array(kinds), tuple(names), expected, precision, fixed)


def _check(
    records: Sequence[MeasuredTransfer],
    structure: MechanicalStructure,
    stated_values: Mapping[str, tuple[float, float]],
    each_recording: Collection[str],
) -> None:
    """Refuse unknown names and ambiguous recordings."""
    if not records:
        raise ValueError("records: expected one recording or more, found none")
    if len({record.name for record in records}) < len(records):
        raise ValueError(f"records: expected different names, found {', '.join(r.name for r in records)}")
    have = [parameter.name for parameter in structure.parameters]
    checked = (
        ("stated_values", stated_values, have),
        ("each_recording", each_recording, have),
    )
    for argument, names, allowed in checked:
        for name in names:
            if name not in allowed:
                raise ValueError(f"{argument}: expected some of {', '.join(allowed)}, found {name}")
    for name, (_, u) in stated_values.items():
        if not u >= 0.0:
            raise ValueError(f"stated_values: expected an uncertainty of 0 or more for {name}, found {u}")
    for record in records:
        if abs(float(record.base.row @ record.drive)) < 1e-9 * float(np.abs(record.drive).max()):
            raise ValueError(f"records: expected a reference along the drive of {record.name}, found one across it")


def _parameters(
    records: Sequence[MeasuredTransfer], structure: MechanicalStructure, each_recording: Collection[str]
) -> tuple[tuple[StructureParameter, ...], list[int], IntArray]:
    """Return the fitted parameters, their structure indices, and indices (R, P) by recording."""
    fitted: list[StructureParameter] = []
    kinds: list[int] = []
    indices = np.zeros((len(records), len(structure.parameters)), dtype=np.int64)
    for kind, parameter in enumerate(structure.parameters):
        members = [parameter]
        if parameter.name in each_recording:
            members = [
                replace(parameter, name=f"{parameter.name}: {record.name}", label=f"{parameter.label}, {record.name}")
                for record in records
            ]
        indices[:, kind] = len(fitted) + (np.arange(len(records)) if len(members) > 1 else 0)
        fitted += members
        kinds += [kind] * len(members)
    return tuple(fitted), kinds, indices


def _curve(
    record: MeasuredTransfer,
    structure: MechanicalStructure,
    parameters: IntArray,
    names: Mapping[str, int],
) -> RecordingModel:
    relative = [error.relative for error in record.errors]
    inertia = [names[f"error: {error.name}"] for error in record.inertia_errors]
    factors = [names[f"error: {error.name}"] for error in record.errors]
    bending, constant = load_bending(record, structure.body, names)
    return RecordingModel(
        record=record,
        mechanics=structure.mechanics(replace(record, mass_matrix=record.mass_matrix + constant)),
        terms=np.concatenate([parameters, np.array(inertia, dtype=np.int64)]),
        factors=np.array(factors, dtype=np.int64),
        relative=np.stack(relative, axis=2) if relative else np.zeros((*record.ratio.value.shape, 0), np.complex128),
        displacements=displacements(record, structure.body, names),
        bends=bending,
        clock=names[f"error: {record.clock}"] if record.u_clock > 0.0 else -1,
        whitening=whitening_matrices(record.ratio.covariance, f"records: covariance of {record.name}"),
    )


# Start values: parameters whose modes have the measured poles.

_RULES = LMOptions(predicted_decrease=1e-2, predicted_decrease_share=1e-4, max_steps=40)
_POLE_PRECISION = 3e-3  # relative standard deviation of a measured pole, chosen for start values
_FACTOR_RANGE = 2.0  # standard deviation of ln k and ln b about the structure's start: a factor of 7
_INERTIA_RANGE = 0.3  # standard deviation of an inertia, share of the whole
_LARGEST_DAMPING_RATIO = 0.4  # of a mode; poles above it do not ring
_SIGNIFICANT = 30.0  # decrease of χ² per real number by a significant pole
_SAME_START = 1e-3  # relative difference below which start values are equal


def starting_vectors(problem: IdentificationProblem, starts: FloatArray) -> list[FloatArray]:
    """Return start vectors of the unknowns from the `starts` (S, P) of a structure."""
    measured = []
    for curve in problem.curves:  # significant poles in the band that ring
        roots = curve.record.poles(curve.mechanics.forcing.shape[1])
        size, s = np.abs(roots), np.abs(curve.record.s)
        inside = (size > 0.7 * s.min()) & (size < 1.3 * s.max()) & (-roots.real < _LARGEST_DAMPING_RATIO * size)
        measured.append(_significant(curve.record, roots[inside]))
    count = len(problem.kind)
    stated = ((problem.precision > 0.0) | problem.fixed)[:count]
    vectors: list[FloatArray] = []
    for start in starts:
        vector = problem.expected.copy()
        vector[:count] = np.where(stated, vector[:count], start[problem.kind])
        vector = _matched(problem, vector, measured, np.flatnonzero(~stated))
        if not any(np.allclose(vector, other, rtol=_SAME_START, atol=0.0) for other in vectors):
            vectors.append(vector)
    return vectors


def _significant(record: MeasuredTransfer, roots: ComplexArray) -> ComplexArray:
    """Return the poles without which a sum of fractions fits much worse.

    Basis: 1/(s - λ) and 1/(s - λ*) of each pole, 1, s and s², separately for each response.
    """
    if len(roots) < 2:
        return roots
    value, s, noise = record.ratio.value, record.s, record.noise
    unit = float(np.abs(s).max())
    smooth = (s[:, None] / unit) ** np.arange(3)
    fractions = [np.stack([unit / (s - root), unit / (s - root.conjugate())], axis=1) for root in roots]

    def misfit(columns: Sequence[ComplexArray]) -> float:
        """Return χ² of the best sums of columns, separately for each ratio."""
        total = 0.0
        for c in range(value.shape[1]):
            right = value[:, c] / noise[:, c]
            basis = np.linalg.qr(np.concatenate(columns, axis=1) / noise[:, c, None])[0]
            total += float(np.sum(np.abs(right - basis @ (basis.conj().T @ right)) ** 2))
        return total

    every = misfit([*fractions, smooth])
    lost = [misfit([*fractions[:i], *fractions[i + 1 :], smooth]) - every for i in range(len(roots))]
    return np.asarray(roots[np.array(lost) > _SIGNIFICANT * 4.0 * value.shape[1]])


def _matched(
    problem: IdentificationProblem, start: FloatArray, measured: Sequence[ComplexArray], free: IntArray
) -> FloatArray:
    """Return unknowns near a start whose modes have the measured poles."""
    whole = whole_inertia(problem, start)[free]
    factors = np.isnan(whole)
    representative = [
        next(k for k, other in enumerate(problem.curves) if other.has_same_poles(curve)) for curve in problem.curves
    ]

    def moved(x: FloatArray) -> FloatArray:
        vector = start.copy()
        by_factor = start[free] * np.exp(np.where(factors, _FACTOR_RANGE * x, 0.0))
        vector[free] = np.where(factors, by_factor, start[free] + _INERTIA_RANGE * whole * x)
        return vector

    def point(x: FloatArray) -> WhitenedResiduals | None:
        vector = moved(x)
        scale = np.where(factors, _FACTOR_RANGE * vector[free], _INERTIA_RANGE * whole)
        residuals, slopes = [x], [np.eye(len(x))]
        if not all(problem.curves[k].possible(vector) for k in set(representative)):
            return None
        every = {k: problem.curves[k].poles(vector) for k in set(representative)}
        for k, roots in zip(representative, measured, strict=True):
            modes, by_unknown = every[k]
            whose = np.arange(len(modes))  # in order; the nearest if a measured pole is missing
            if len(roots) != len(modes):
                whose = np.argmin(np.abs(np.log(np.abs(roots[:, None] / modes))), axis=1)
            off, slope = np.log(modes[whose] / roots), by_unknown[whose][:, free] * scale / modes[whose, None]
            residuals.append(np.stack([off.real, off.imag], axis=1).ravel() / _POLE_PRECISION)
            slopes.append(np.stack([slope.real, slope.imag], axis=1).reshape(-1, len(x)) / _POLE_PRECISION)
        return WhitenedResiduals(x, np.concatenate(residuals), np.concatenate(slopes))

    first = point(np.zeros(len(free)))
    return start if first is None else moved(levenberg_marquardt(point, first, _RULES).point.parameters)
