"""Parameters of a linear structure from all recordings in one fit.

Every named error of the recordings is an unknown of the fit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from shaker.identification.identification_problem import (
    IdentificationProblem,
    ModelledRatios,
    build_problem,
    starting_vectors,
    whole_inertia,
)
from shaker.identification.measured_curves import (
    CurveResidual,
    MeasuredTransfer,
    NamedUnknown,
    ParameterEstimate,
    ResidualNoise,
    estimate_residual_noise,
    line_correlation_term,
)
from shaker.identification.structures import CHANGE, MechanicalStructure
from shaker.model_notices import (
    DAMPING_UNDETERMINED,
    FIT_UNSETTLED,
    INERTIA_UNDETERMINED,
    MODEL_MISFIT,
    NEGATIVE_DAMPING,
    NEGATIVE_INERTIA,
    NEGATIVE_WITHIN_U,
    RESIDUAL_NOISE,
    STATED_ERROR_TOO_SMALL,
    STATED_VALUE_CONTRADICTED,
    STATED_VALUE_UNCHANGED,
    STIFFNESS_UNDETERMINED,
)
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.digits import typeset
from shakercal._common.fitting import LMOptions, levenberg_marquardt
from shakercal._common.notices import Notice, Value

# Result of an identification: parameters, modes, named errors, residuals.


@dataclass(frozen=True)
class ModeEstimate:
    """One mode of a recording, numbered by frequency: f₀ = |λ|/2π, ζ = -Re λ/|λ|."""

    record: str
    number: int
    frequency_hz: float
    u_frequency_hz: float
    damping_ratio: float
    u_damping_ratio: float


@dataclass(frozen=True)
class SmoothMisfit:
    """Mean square of residuals averaged over neighbouring lines.

    `factor`: 1 for independent noise; `dof`: its degrees of freedom.
    """

    factor: float
    dof: float

    @property
    def is_significant(self) -> bool:
        """Whether neighbouring lines deviate together by more than chance."""
        return bool(self.factor > 1.0 + _CHANCES * np.sqrt(2.0 / self.dof))


@dataclass(frozen=True, repr=False)
class Identification(Arrays, shapes="estimates P; covariance P P"):
    """Parameters of a structure from all recordings together.

    Attributes
    ----------
    estimates : P parameters; one that belongs to a single recording is named "name: recording"
    covariance : (P, P) of `estimates`, infinite where the recordings do not determine a parameter
    derived : b/k of each spring and damper
    modes : of every recording
    unknowns : named errors as estimated
    model, residual : (K, C) per recording, the curve with all estimated errors, and measured minus model
    chi_squared, dof : of the residuals over the stated covariances
    penalty : χ² of the stated errors and numbers as estimated
    free : number of parameters without a stated value
    excess, chance : χ²/dof over its expectation for noise, at least 1, and its relative standard deviation for noise
    smooth : the same of mean residuals over neighbouring lines, over that of single lines
    budget : contributions (P,) by cause

    Notes
    -----
    If χ²/dof is larger than noise explains, the noise is enlarged by the excess. The budget contains the change of the
    parameters for one standard deviation of each named error and of each stated number, and the contribution "noise".
    Their squares sum to the variances.
    """

    estimates: tuple[ParameterEstimate, ...]
    covariance: FloatArray
    derived: tuple[ParameterEstimate, ...]
    modes: tuple[ModeEstimate, ...]
    unknowns: tuple[NamedUnknown, ...]
    model: tuple[ComplexArray, ...]
    residual: tuple[ComplexArray, ...]
    chi_squared: float
    dof: float
    penalty: float
    free: int
    excess: float
    chance: float
    smooth: SmoothMisfit
    notices: tuple[Notice, ...]
    budget: Mapping[str, FloatArray] = field(default_factory=dict)

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
    def is_explained(self) -> bool:
        """Whether noise as stated, independent between lines, explains the residuals."""
        return self.excess < max(_NOISE_NOTE, 1.0 + _CHANCES * self.chance) and not self.smooth.is_significant

    @property
    def misfit(self) -> float:
        """χ² of means of neighbouring lines over that of noise as stated."""
        return self.excess * max(1.0, self.smooth.factor)

    @property
    def is_rejected(self) -> bool:
        """Whether the residuals are so much larger than the noise that the model is wrong."""
        return self.excess >= max(_NOISE_WARNING, 1.0 + _CHANCES * self.chance)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of `covariance`."""
        return tuple(estimate.name for estimate in self.estimates)

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix (P, P) of the parameters, zero for fixed and undetermined ones."""
        size = np.sqrt(self.covariance.diagonal())
        finite = np.isfinite(size) & (size > 0.0)
        correlation = np.zeros_like(self.covariance)
        inside = np.ix_(finite, finite)
        correlation[inside] = self.covariance[inside] / np.multiply.outer(size[finite], size[finite])
        return correlation + np.diag(1.0 - correlation.diagonal())


# Least squares over all recordings, and the covariance of the result.

_RULES = LMOptions(
    predicted_decrease=1e-8,
    predicted_decrease_share=0.0,
    actual_decrease=1e-4,
    max_steps=100,
    initial_damping=1e-6,
    damping_decrease=0.03,
    min_damping=1e-12,
    max_damping=1e8,
)
"""A fit has converged if a step would be 1e-4 of the standard uncertainties, or lowers χ² by less than 1e-4."""
_SHARE = 0.1  # of a step, over which the curvature of the residuals is evaluated
_RANK_TOLERANCE = 1e-10  # singular value, columns of unit length, below which a direction is undetermined


@dataclass(frozen=True, repr=False)
class FitState(Arrays):
    """Unknowns (N,) with the modelled curves, whitened residuals (K, 2C), χ² as `loss`."""

    problem: IdentificationProblem
    parameters: FloatArray
    modelled: tuple[ModelledRatios, ...]
    residuals: tuple[FloatArray, ...]
    loss: float

    @property
    def freedom(self) -> int:
        """Number of real readings less that of unknowns, at least 1."""
        return max(1, sum(residual.size for residual in self.residuals) - len(self.parameters))

    @cached_property
    def jacobians(self) -> tuple[FloatArray, ...]:
        """Derivatives (K, 2C, L) of the whitened model by the unknowns of each curve."""
        return tuple(part.curve.whitened(part.derivatives) for part in self.modelled)

    @cached_property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (N, N) and descent direction (N,), zero for fixed unknowns."""
        problem = self.problem
        normal, downhill = np.diag(problem.precision), problem.precision * (problem.expected - self.parameters)
        for curve, residual, jacobian in zip(problem.curves, self.residuals, self.jacobians, strict=True):
            flat = jacobian.reshape(-1, jacobian.shape[2])
            np.add.at(normal, (curve.unknown_indices[:, None], curve.unknown_indices), flat.T @ flat)
            np.add.at(downhill, curve.unknown_indices, flat.T @ residual.ravel())
        normal[problem.fixed] = 0.0
        normal[:, problem.fixed] = 0.0
        downhill[problem.fixed] = 0.0
        return normal, downhill


def evaluate(problem: IdentificationProblem, vector: FloatArray) -> FitState | None:
    """Return the fit state of a vector, None unless masses and stiffnesses are positive."""
    if not all(curve.possible(vector) for curve in problem.curves):
        return None
    modelled = tuple(curve.modelled(vector) for curve in problem.curves)
    residuals = tuple(
        part.curve.whitened((part.curve.record.ratio.value - part.value)[:, :, None])[:, :, 0] for part in modelled
    )
    loss = float(problem.precision @ (problem.expected - vector) ** 2)
    loss += sum(float(np.vdot(residual, residual)) for residual in residuals)
    return FitState(problem, vector, modelled, residuals, loss if np.isfinite(loss) else np.inf)


def solve(problem: IdentificationProblem, state: FitState) -> FitState:
    """Return the last state of a search for the least χ²."""

    def at(vector: FloatArray) -> FitState | None:
        return evaluate(problem, vector)

    def curvature(point: FitState, step: FloatArray) -> FloatArray | None:
        """Return the residuals' second derivative along a step, by a finite difference."""
        ahead = at(point.parameters + _SHARE * step)
        if ahead is None:
            return None
        downhill = np.zeros(len(step))
        parts = zip(problem.curves, point.residuals, point.jacobians, ahead.residuals, strict=True)
        for curve, now, jacobian, ahead_residual in parts:
            second = (ahead_residual - now + _SHARE * (jacobian @ step[curve.unknown_indices])) * (2.0 / _SHARE**2)
            np.add.at(downhill, curve.unknown_indices, np.tensordot(second, jacobian, 2))
        downhill[problem.fixed] = 0.0
        return downhill

    return levenberg_marquardt(at, state, _RULES, curvature=curvature).point


def effective(problem: IdentificationProblem, state: FitState) -> float:
    """Return the number of unknowns that the lines determine: tr[(JᵀJ + P)⁻¹ JᵀJ]."""
    whole = state.normal[0]
    scale = np.sqrt(np.maximum(whole.diagonal(), np.finfo(np.float64).tiny))
    pair = np.multiply.outer(scale, scale)
    return float(np.trace(np.linalg.lstsq(whole / pair, (whole - np.diag(problem.precision)) / pair, rcond=1e-12)[0]))


_BLOCKS, _FEWEST_IN_BLOCK = 16, 8  # blocks of neighbouring lines of a curve, and lines of the smallest one


def smooth_misfit(problem: IdentificationProblem, state: FitState) -> SmoothMisfit:
    """Return how much the residuals of neighbouring lines deviate together, along and across the model.

    A cause that the model lacks, such as a filter or a joint, deviates smoothly and moves parameters by far more than
    noise of the same size.
    """
    total, dof = 0.0, -float(len(problem.kind))
    for part, residual in zip(state.modelled, state.residuals, strict=True):
        lines = len(residual)
        blocks = min(_BLOCKS, lines // _FEWEST_IN_BLOCK)
        if blocks < 2:
            continue
        order = np.argsort(part.curve.record.ratio.frequency_hz, kind="stable")
        real, imaginary = np.split(residual, 2, axis=1)
        along = ((real + 1j * imaginary) * np.exp(-1j * np.angle(part.value)))[order]
        edges = np.linspace(0, lines, blocks + 1).astype(np.int64)
        correlation = part.curve.record.line_correlation
        wider = 1.0 if correlation is None else 1.0 + 2.0 * float(np.sum(correlation[1:].real))
        sums = np.add.reduceat(along, edges[:-1], axis=0)
        total += float(np.sum(np.abs(sums) ** 2 / np.diff(edges)[:, None]) / wider)
        dof += 2.0 * sums.size
    return SmoothMisfit(total / dof if dof > 0.0 else 1.0, max(dof, 1.0))


@dataclass(frozen=True, repr=False)
class UnknownsCovariance(Arrays):
    """Covariance of all unknowns, and the directions that the recordings do not determine.

    `covariance` (N, N) of the determined part. `undetermined` (Z, N): orthonormal directions in units of `scale` (N,).
    `prior` (N, N): change of all unknowns (rows) for one standard deviation of the prior of each (columns).
    `unsettled`: length of the next linearised step, in standard uncertainties.
    """

    covariance: FloatArray
    undetermined: FloatArray
    scale: FloatArray
    prior: FloatArray
    unsettled: float

    def u(self, gradient: FloatArray) -> float:
        """Return u of a function with a `gradient` (N,), infinite where undetermined."""
        scaled = gradient * self.scale
        size = float(np.linalg.norm(scaled))
        if size > 0.0 and len(self.undetermined) and np.linalg.norm(self.undetermined @ scaled) > 1e-4 * size:
            return float("inf")
        return float(np.sqrt(max(0.0, float(gradient @ self.covariance @ gradient))))

    def covariance_of(self, gradients: FloatArray) -> FloatArray:
        """Return the covariance (G, G) of functions with `gradients` (G, N), infinite where undetermined."""
        covariance = gradients @ self.covariance @ gradients.T
        undetermined = ~np.isfinite([self.u(gradient) for gradient in gradients])
        covariance[undetermined] = 0.0
        covariance[:, undetermined] = 0.0
        covariance[undetermined, undetermined] = np.inf
        return np.asarray(covariance)


def spread(problem: IdentificationProblem, state: FitState, smooth: float) -> UnknownsCovariance:
    """Return the covariance A⁻¹ (S JᵀRJ + P) A⁻¹ of all unknowns.

    A = JᵀJ + P, R is the correlation between lines, S the factor of a smooth misfit, P the precision of the priors. The
    basis is chosen such that A = 1, which keeps the digits of directions that the stated masses and scales do not
    determine.
    """
    count, free = len(state.parameters), ~problem.fixed
    unit = np.diag(free.astype(np.float64))
    wide = [
        jacobian @ unit[curve.unknown_indices] for curve, jacobian in zip(problem.curves, state.jacobians, strict=True)
    ]
    stacked = np.concatenate([*(rows.reshape(-1, count) for rows in wide), np.diag(np.sqrt(problem.precision))])
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0.0] = 1.0
    singular, rotation = np.linalg.svd(np.linalg.qr((stacked / size)[:, free], mode="r"))[1:]
    directions = np.zeros((len(rotation), count))
    directions[:, free] = rotation
    determined = singular > _RANK_TOLERANCE * singular.max()
    basis = directions[determined].T / singular[determined] / size[:, None]
    middle = np.eye(basis.shape[1])
    for curve, by_all in zip(problem.curves, wide, strict=True):
        real, imaginary = np.split(by_all @ basis, 2, axis=1)
        record = curve.record
        middle += smooth * line_correlation_term(
            record.ratio.frequency_hz, real + 1j * imaginary, record.line_correlation
        )
        flat = (by_all @ basis).reshape(-1, basis.shape[1])
        middle += (smooth - 1.0) * (flat.T @ flat)
    prior = basis @ basis.T * np.sqrt(problem.precision)
    unsettled = float(np.linalg.norm(state.normal[1] @ basis))
    return UnknownsCovariance(basis @ middle @ basis.T, directions[~determined], 1.0 / size, prior, unsettled)


# Notices of an identification: undetermined parameters and contradicted statements.

_UNKNOWN = 1.0 / 3.0  # u over value above which a parameter counts as undetermined: 2u would reach 2/3 of it
_NEGLIGIBLE = 0.02  # share of the whole inertia below which an internal one does not matter for the resonance
_MAX_DEVIATION = 3.0  # standard uncertainties, the usual limit of 3 σ
_NOISE_NOTE, _NOISE_WARNING = 1.2, 4.0  # χ²/dof: 10 % and a factor of 2 in the noise
_CHANCES = 5.0  # standard deviations of χ²/dof for noise alone
_SETTLED = 0.1  # standard uncertainties from the minimum that do not matter
_UNCHANGED = 0.95  # share of a stated uncertainty that remains if the recordings add no information


def _notices(
    problem: IdentificationProblem,
    state: FitState,
    found: UnknownsCovariance,
    estimates: tuple[ParameterEstimate, ...],
    noise: ResidualNoise,
) -> Iterator[Notice]:
    if noise.common >= max(_NOISE_NOTE, 1.0 + _CHANCES * noise.chance):
        declared = MODEL_MISFIT if noise.common >= _NOISE_WARNING else RESIDUAL_NOISE
        yield Notice(declared, "identification", factor=np.sqrt(noise.common))
    if found.unsettled >= _SETTLED:
        yield Notice(FIT_UNSETTLED, "identification", distance=found.unsettled)
    whole = np.nan_to_num(whole_inertia(problem, state.parameters))
    for index in np.flatnonzero(~problem.fixed[: len(estimates)]).tolist():
        estimate = estimates[index]
        if estimate.name.startswith(CHANGE):
            continue
        if problem.precision[index] > 0.0:
            yield from _against_stated(estimate, problem.expected[index], problem.precision[index] ** -0.5)
        elif estimate.u > _UNKNOWN * max(abs(estimate.value), _NEGLIGIBLE * whole[index]):
            kinds = {"stiffness": STIFFNESS_UNDETERMINED, "damping": DAMPING_UNDETERMINED}
            declared = kinds.get(estimate.name.partition("_")[0], INERTIA_UNDETERMINED)
            unit = typeset(estimate.unit)
            yield Notice(declared, estimate.name, parameter=estimate.label, u=estimate.u, unit=unit)
            continue
        yield from _negative(estimate)
    for index in range(len(estimates), len(problem.names)):
        off, remaining = float(state.parameters[index]), float(found.covariance[index, index])
        if problem.precision[index] > 0.0 and off**2 > _MAX_DEVIATION**2 * max(1e-6, 1.0 - remaining):
            name = problem.names[index].removeprefix("error: ")
            yield Notice(STATED_ERROR_TOO_SMALL, name, cause=name, deviation=abs(off))


def _negative(estimate: ParameterEstimate) -> Iterator[Notice]:
    """Yield a notice if a mass or a damping is below zero."""
    if estimate.value >= 0.0 or not np.isfinite(estimate.u):
        return
    declared = NEGATIVE_INERTIA if estimate.name.startswith("internal") else NEGATIVE_DAMPING
    if estimate.value > -2.0 * estimate.u:
        declared = NEGATIVE_WITHIN_U
    unit = typeset(estimate.unit)
    yield Notice(declared, estimate.name, parameter=estimate.label, value=estimate.value, u=estimate.u, unit=unit)


def _against_stated(estimate: ParameterEstimate, stated: float, u: float) -> Iterator[Notice]:
    """Yield a notice if a stated parameter is contradicted or not improved."""
    values: dict[str, Value] = {"parameter": estimate.label, "value": stated, "u": u, "unit": typeset(estimate.unit)}
    if estimate.u > _UNCHANGED * u:
        yield Notice(STATED_VALUE_UNCHANGED, estimate.name, **values)
    elif (pull := abs(estimate.value - stated) / float(np.sqrt(u**2 - estimate.u**2))) >= _MAX_DEVIATION:
        yield Notice(STATED_VALUE_CONTRADICTED, estimate.name, **values, estimate=estimate.value, deviation=pull)


# All recordings in one complex least-squares fit.

_EXPLAINED = 4.0  # χ² per real number below which no other start is tried
_COARSE_LINES = 200  # highest lines of a curve, and about as many others, for the first search of coupled motions
_NOISE_ROUNDS = 4  # of reweighting by the residuals, at most


def identify(
    records: Sequence[MeasuredTransfer],
    structure: MechanicalStructure,
    *,
    stated_values: Mapping[str, tuple[float, float]] | None = None,
    each_recording: Collection[str] = (),
) -> Identification:
    """Fit the parameters of a structure to all lines of all recordings together.

    Parameters
    ----------
    records
        transfer functions of the recordings, each with a different name
    structure
        the structure, e.g. `SpringSuspension`
    stated_values
        (value, u) of parameters that are stated; u = 0 fixes the parameter
    each_recording
        names of the parameters that have a separate value in every recording

    Notes
    -----
    The measured ratio is H(s) · exp(Σ z r) with relative errors r by name and unknowns z ~ N(0, 1). Equal names are one
    unknown. Uncertain numbers of the load, positions and directions of transducers, and the clock rate are unknowns
    too.
    """
    problem = build_problem(records, structure, stated_values or {}, each_recording)
    lines = sum(2 * record.ratio.value.size for record in records)
    if lines <= np.count_nonzero((problem.precision == 0.0) & ~problem.fixed):
        raise ValueError(f"records: expected more real values than {len(problem.names)} unknowns, found {lines}")
    vectors = starting_vectors(problem, structure.starts(records))
    if structure.body.shape[1] > 1:  # a long search of coupled motions, at first over few lines
        fewer = [_decimate(record) for record in records]
        coarse = build_problem(fewer, structure, stated_values or {}, each_recording)
        vectors = [_searched(coarse, vectors).parameters]
    weighted, state, noise = _weighed(problem, _searched(problem, vectors))
    return _result(weighted, state, noise)


def _searched(problem: IdentificationProblem, vectors: Sequence[FloatArray]) -> FitState:
    """Return the best minimum from several starts."""
    tried: list[FitState] = []
    lines = sum(2 * curve.record.ratio.value.size for curve in problem.curves)
    starts = filter(None, (evaluate(problem, vector) for vector in vectors))
    for start in sorted(starts, key=lambda state: state.loss):
        tried.append(solve(problem, start))
        if tried[-1].loss < _EXPLAINED * lines:
            break
    return min(tried, key=lambda state: state.loss)


def _decimate(record: MeasuredTransfer) -> MeasuredTransfer:
    """Return a curve with its highest lines and a share of the others."""
    size = np.abs(record.ratio.value).max(axis=1)
    chosen = np.arange(len(size)) % max(1, len(size) // _COARSE_LINES) == 0
    chosen[np.argsort(-size)[:_COARSE_LINES]] = True
    return record.at_lines(chosen)


def _weighed(problem: IdentificationProblem, state: FitState) -> tuple[IdentificationProblem, FitState, ResidualNoise]:
    """Return the problem weighted by the noise of the residuals, its solution and that noise."""

    def seen(problem: IdentificationProblem, state: FitState) -> ResidualNoise:
        curves = [
            CurveResidual(np.sum(residual**2, axis=1) * factor, curve.record.ratio.dof, residual.shape[1])
            for curve, residual, factor in zip(problem.curves, state.residuals, factors, strict=True)
        ]
        return estimate_residual_noise(curves, effective(problem, state))

    factors: tuple[FloatArray, ...] = tuple(np.ones(len(curve.whitening)) for curve in problem.curves)
    noise, weighted = seen(problem, state), problem
    for _ in range(_NOISE_ROUNDS):
        factors, before = noise.lines, state.parameters
        weighted = problem.weighed(factors)
        start = evaluate(weighted, before)
        assert start is not None
        state = solve(weighted, start)
        noise = seen(weighted, state)
        if np.array_equal(before, state.parameters):
            break
    return weighted, state, noise


def _result(problem: IdentificationProblem, state: FitState, noise: ResidualNoise) -> Identification:
    smooth = smooth_misfit(problem, state)
    found = spread(problem, state, smooth.factor if smooth.is_significant else 1.0)
    count, unit = len(problem.kind), np.eye(len(problem.names))
    estimates = tuple(
        ParameterEstimate(p.name, p.label, float(state.parameters[index]), found.u(unit[index]), p.unit)
        for index, p in enumerate(problem.parameters)
    )
    model = tuple(part.value for part in state.modelled)
    unknowns, causes = [], {}
    for index, name in enumerate(problem.names):
        cause = name.removeprefix("error: ")
        if index >= count and name.startswith("error: "):
            unknowns.append(NamedUnknown(cause, float(state.parameters[index]), found.u(unit[index])))
        if problem.precision[index] > 0.0:
            causes[cause if index >= count else f"{name} as stated"] = found.prior[:count, index]
    from_causes = np.sum([np.zeros(count), *(change**2 for change in causes.values())], axis=0)
    noise_left = np.sqrt(np.maximum(found.covariance.diagonal()[:count] - from_causes, 0.0))
    return Identification(
        estimates=estimates,
        covariance=found.covariance_of(unit[:count]),
        derived=_lags(problem, state, found),
        modes=_modes(problem, state, found),
        unknowns=tuple(unknowns),
        model=model,
        residual=tuple(curve.record.ratio.value - value for curve, value in zip(problem.curves, model, strict=True)),
        chi_squared=noise.chi_squared,
        dof=noise.dof,
        penalty=float(problem.precision @ (problem.expected - state.parameters) ** 2),
        free=int(np.count_nonzero((problem.precision == 0.0) & ~problem.fixed)),
        excess=noise.common,
        chance=noise.chance,
        smooth=smooth,
        notices=tuple(_notices(problem, state, found, estimates, noise)),
        budget={"noise": noise_left, **causes},
    )


def _lags(problem: IdentificationProblem, state: FitState, found: UnknownsCovariance) -> tuple[ParameterEstimate, ...]:
    """Return b/k of every damper with its spring, or the loss factor."""
    rate = 2.0 * np.pi * problem.curves[0].mechanics.loss_hz
    indices = {parameter.name: index for index, parameter in enumerate(problem.parameters)}
    derived = []
    for name, index in indices.items():
        spring = name.replace("damping_", "stiffness_", 1)
        shared = indices.get(spring, indices.get(spring.partition(":")[0]))
        if not name.startswith("damping_") or shared is None:
            continue
        ending, b, k = name.removeprefix("damping_"), state.parameters[index], state.parameters[shared]
        gradient = np.zeros(len(state.parameters))
        gradient[index], gradient[shared] = 1.0 / k, -b / k**2
        named = (f"loss_factor_{ending}", f"loss factor, {ending}") if rate else (f"lag_{ending}", f"b/k, {ending}")
        scale, unit = (rate, "1") if rate else (1.0, "s")
        derived.append(ParameterEstimate(*named, float(scale * b / k), scale * found.u(gradient), unit))
    return tuple(derived)


def _modes(problem: IdentificationProblem, state: FitState, found: UnknownsCovariance) -> tuple[ModeEstimate, ...]:
    """Return the modes of every recording from the poles of its fitted mechanics."""
    modes = []
    for curve in problem.curves:
        roots, changes = curve.poles(state.parameters)
        if not np.all(np.abs(roots) > 0.0):  # also NaN
            raise ValueError("records: expected curves with the modes of the structure, found none")
        for number, (root, change) in enumerate(zip(roots, changes, strict=True)):
            size, ratio = abs(root), float(-root.real / abs(root))
            by_size = (change * root.conj()).real / size
            u_size, u_ratio = found.u(by_size / (2.0 * np.pi)), found.u(-(change.real + ratio * by_size) / size)
            f0 = float(size / (2.0 * np.pi))
            modes.append(ModeEstimate(curve.record.name, number, f0, u_size, ratio, u_ratio))
    return tuple(modes)
