"""Model of all outputs over all loads from frequency responses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from shaker.decoupling.model import MultiModel, Poles, growing_pole_notices
from shaker.decoupling.release_problem import covariances, model_covariance, search_options
from shaker.model_notices import MODEL_MISFIT
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.fitting import BlockJacobian, LinearBlock, SeparablePoint, levenberg_marquardt
from shakercal._common.notices import Notice

_UNEXPLAINED = 1.5  # χ²/dof above which a notice is given
_WORSE = 2  # numbers of modes above the best that are tried

Point: TypeAlias = tuple[Poles, SeparablePoint]


@dataclass(frozen=True, repr=False)
class Responses(Arrays, shapes="channels C; components D; frequency_hz K; value K C D; covariance K C D 2 2"):
    """Measured H (K, C, D) of outputs `channels` (C,) in `unit` over loads `components` (D,).

    `frequency_hz` (K,). `covariance` (K, C, D, 2, 2) of Re and Im of every element; the elements of a line are
    independent.
    """

    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray

    @cached_property
    def whitener(self) -> FloatArray:
        """Matrices (K, C, D, 2, 2) that whiten the noise of Re and Im."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))


@dataclass(frozen=True)
class ResponseTrial:
    """One number of modes that was tried: poles, χ², and χ² + ln(N)·(number of parameters)."""

    modes: int
    reals: int
    chi_squared: float
    criterion: float


@dataclass(frozen=True)
class ResponseFit:
    """A model fitted to frequency responses.

    `chi_squared` with `dof` degrees of freedom; `trials`: numbers of modes that were tried; `notices`.
    """

    model: MultiModel
    chi_squared: float
    dof: int
    trials: tuple[ResponseTrial, ...]
    notices: tuple[Notice, ...]


def fit_responses(measured: Responses, most_modes: int = 12) -> ResponseFit:
    """Fit a model with common poles to all elements, weighted by their covariance.

    Parameters
    ----------
    measured
        frequency responses with covariance
    most_modes
        highest number of pole pairs, default 12

    Returns
    -------
    ResponseFit : the model with its covariance, χ², trials and notices

    Raises
    ------
    ValueError : `most_modes` below 1, or loads that the outputs do not distinguish (named)

    Notes
    -----
    Vector fitting gives the poles of 1 … `most_modes` pairs, some of which may be real. The number of least χ² +
    ln(N)·P for P parameters is selected. Levenberg-Marquardt steps then give the weighted least squares with projected
    residues, and unnecessary poles are removed. If χ² is above its degrees of freedom, the covariance is enlarged.

    Examples
    --------
    >>> from shaker import fit_responses
    >>> model = fit_responses(responses).model  # doctest: +SKIP
    """
    if most_modes < 1:
        raise ValueError(f"most_modes: expected at least 1, found {most_modes}")
    elements = measured.value.reshape(len(measured.frequency_hz), -1).T
    mean_weight = np.sqrt(np.sum(measured.whitener**2, axis=(3, 4)) / 2)
    weights = mean_weight.reshape(len(mean_weight), -1).T
    trials: list[ResponseTrial] = []
    points: list[Point] = []
    for modes in range(1, most_modes + 1):
        points.append(_point(measured, fitted_poles(measured.frequency_hz, elements, weights, modes)))
        trials.append(_trial(measured, *points[-1]))
        best = int(np.argmin([trial.criterion for trial in trials]))
        if len(trials) - 1 - best == _WORSE:
            break
    point = _fitted(measured, points[best][0])
    while (count := point[0].modes + len(point[0].real_hz)) > 1:
        first = 0 if point[0].modes > 1 else 1  # at least one mode remains
        fewer = [_point(measured, point[0].without(index)) for index in range(first, count)]
        tried = [_trial(measured, *one).criterion for one in fewer]
        if min(tried) >= _trial(measured, *point).criterion:
            break
        point = _fitted(measured, fewer[int(np.argmin(tried))][0])
        trials.append(_trial(measured, *point))
    return _result(measured, *point, tuple(trials))


def _fitted(measured: Responses, start: Poles) -> Point:
    """Return the weighted least-squares poles from a start."""

    def at(vector: FloatArray) -> SeparablePoint | None:
        poles = start.with_vector(vector)
        return _point(measured, poles)[1] if poles.allowed else None

    first = at(start.vector)
    if first is None:
        raise ValueError(f"start: expected poles that oscillate and decay, found {start.vector.tolist()}")
    point = levenberg_marquardt(at, first, search_options(60, 1e-2), start.scale).point
    return start.with_vector(point.parameters), point


def _point(measured: Responses, poles: Poles) -> Point:
    """Return poles as a point of the search, one block per element."""
    basis, m, blocks = poles.basis(measured.frequency_hz), poles.modes, []
    for d, c in np.ndindex(measured.value.shape[:0:-1]):
        weight = measured.whitener[:, c, d]

        def changes(coefficients: FloatArray, weight: FloatArray = weight) -> BlockJacobian:
            residues = np.concatenate([coefficients[:m, 0] + 1j * coefficients[m : 2 * m, 0], coefficients[2 * m :, 0]])
            slopes = poles.response_slopes(measured.frequency_hz, residues)
            return BlockJacobian(np.arange(poles.count), _whitened(weight, slopes)[:, :, None])

        blocks.append(
            LinearBlock(_whitened(weight, basis), _whitened(weight, measured.value[:, c, d][:, None]), changes)
        )
    return poles, SeparablePoint(poles.vector, tuple(blocks))


def _whitened(whitener: FloatArray, values: ComplexArray) -> FloatArray:
    """Return real rows (2K, B) of unit variance of complex columns (K, B)."""
    pairs = np.stack([values.real, values.imag], axis=1)
    return np.asarray((whitener @ pairs).reshape(-1, values.shape[1]))


def _trial(measured: Responses, poles: Poles, point: SeparablePoint) -> ResponseTrial:
    """Return the trial entry of fixed poles."""
    parameters = poles.count * (1 + len(measured.channels) * len(measured.components))
    criterion = point.loss + float(np.log(2 * measured.value.size)) * parameters
    return ResponseTrial(poles.modes, len(poles.real_hz), point.loss, criterion)


def _result(
    measured: Responses, poles: Poles, solution: SeparablePoint, trials: tuple[ResponseTrial, ...]
) -> ResponseFit:
    """Return the model with covariance."""
    shape = (poles.count, len(measured.components), len(measured.channels))
    table = np.concatenate(solution.coefficients, axis=1).reshape(shape).transpose(0, 2, 1)
    model = MultiModel.of_poles(poles, table, (measured.channels, measured.components), measured.unit)
    chi_squared, dof = solution.loss, 2 * measured.value.size - len(model.vector)
    excess = max(1.0, chi_squared / max(dof, 1))
    no_prior = np.zeros(len(solution.parameters))
    spread, follows = covariances(solution, [np.full(1, excess)] * len(solution.blocks), no_prior)
    covariance, _ = model_covariance(model, spread, [outputs[0] for outputs in follows], np.ones(len(follows)))
    notices = []
    if excess > _UNEXPLAINED:
        notices.append(Notice(MODEL_MISFIT, "responses", factor=np.sqrt(excess)))
    notices += growing_pole_notices(model)
    return ResponseFit(replace(model, covariance=covariance), chi_squared, dof, trials, tuple(notices))


# Common poles of many frequency responses by vector fitting, as a start for least squares.

_ROUNDS = 12  # of vector fitting, chosen
_START_DAMPING = 0.01  # as recommended by Gustavsen and Semlyen


def fitted_poles(frequency_hz: FloatArray, responses: ComplexArray, weights: FloatArray, modes: int) -> Poles:
    """Return the common poles of responses (R, K) with weights (R, K), from `modes` pairs.

    h·σ = Σ r/(s - a), σ = 1 + Σ d/(s - a) is linear in r and d, and the zeros of σ are better poles than a (Gustavsen
    and Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052), with r eliminated for each response (Deschrijver and
    others, IEEE Microw. Wirel. Compon. Lett. 18 (2008) 383). Unstable poles are reflected.
    """
    low, high = float(np.min(frequency_hz[frequency_hz > 0])), float(np.max(frequency_hz))
    inside = np.linspace(low, high, modes + 2)[1:-1]
    poles = Poles(inside, np.full(modes, _START_DAMPING), np.zeros(0))
    for _ in range(_ROUNDS):
        unit = 1.0 / np.linalg.norm(poles.basis(frequency_hz), axis=0)
        basis = poles.basis(frequency_hz) * unit
        rows, right = [], []
        for response, weight in zip(responses, weights, strict=True):
            both = np.concatenate([basis, -response[:, None] * basis, response[:, None]], axis=1) * weight[:, None]
            _, triangle = np.linalg.qr(np.concatenate([both.real, both.imag]))
            reduced = triangle[poles.count : 2 * poles.count]
            rows.append(reduced[:, poles.count : -1])
            right.append(reduced[:, -1])
        correction = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0] * unit
        poles = _zeros(poles, correction)
    return poles


def _zeros(poles: Poles, correction: FloatArray) -> Poles:
    """Return the zeros of 1 + Σ d/(s - a), reflected to the left."""
    from scipy.linalg import block_diag

    m = poles.modes
    upper, real = np.split(poles.values, [m])
    swings = [[[pole.real, pole.imag], [-pole.imag, pole.real]] for pole in upper]
    table = block_diag(*swings, np.diag(real.real))
    ones = np.concatenate([np.tile([2.0, 0.0], m), np.ones(len(real))])
    row = np.concatenate([np.stack([correction[:m], correction[m : 2 * m]], axis=1).ravel(), correction[2 * m :]])
    zeros = np.linalg.eigvals(table - np.outer(ones, row))
    pairs = zeros[zeros.imag > 1e-9 * np.abs(zeros)]
    alone = np.abs(zeros[np.abs(zeros.imag) <= 1e-9 * np.abs(zeros)].real)
    damping = np.clip(np.abs(pairs.real) / np.abs(pairs), 1e-5, 0.69)
    return Poles(np.abs(pairs) / (2 * np.pi), damping, np.maximum(alone, 1e-3) / (2 * np.pi))
