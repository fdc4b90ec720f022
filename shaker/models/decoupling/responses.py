"""A model of all outputs over all loads from frequency responses, such as those of chirps and sines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.models.decoupling.excited import check_separable
from shaker.models.decoupling.model import MultiModel, pole_slopes
from shaker.models.decoupling.projection import Block, Slope, Solution, covariances, minimise
from shaker.models.decoupling.step_data import Poles
from shaker.models.decoupling.vector_fitting import fitted_poles, response_basis
from shaker.notice import Notice

_UNEXPLAINED = 1.5
_WORSE = 2


@dataclass(frozen=True)
class Responses:
    """Measured H (K, C, D) of outputs `channels` (C,) in `unit` over loads `components` (D,) at `frequency_hz` (K,).

    `covariance` (K, C, D, 2, 2) of Re and Im of every element. Elements of one line count as independent.
    """

    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        shape = (len(self.frequency_hz), len(self.channels), len(self.components))
        check_shape("value", self.value, shape)
        check_shape("covariance", self.covariance, (*shape, 2, 2))


@dataclass(frozen=True)
class ResponseTrial:
    """One number of modes that was tried: poles, sum of squares χ², χ² + ln(N)·(number of parameters)."""

    modes: int
    reals: int
    chi_squared: float
    criterion: float


@dataclass(frozen=True)
class ResponseFit:
    """A model fitted to frequency responses: `chi_squared` with `dof` degrees of freedom, what was tried, notices."""

    model: MultiModel
    chi_squared: float
    dof: int
    trials: tuple[ResponseTrial, ...]
    notices: tuple[Notice, ...]


def fit_responses(measured: Responses, most_modes: int = 12) -> ResponseFit:
    """Return the model with common poles of all elements, weighted by their covariance, with covariance.

    Vector fitting gives the poles of 1 … `most_modes` pairs, of which some may turn out real; the number is taken with
    the least χ² + ln(N)·P, of P parameters. Levenberg and Marquardt's steps lead to the weighted least squares, with
    the residues projected out, and poles that are not needed then are left out. Where χ² exceeds its degrees of freedom
    the covariance grows with it. Loads that the outputs do not tell apart are refused with their names.
    """
    if most_modes < 1:
        raise ValueError(f"most_modes: expected at least 1, found {most_modes}")
    whitener = np.linalg.inv(np.linalg.cholesky(measured.covariance))
    trials: list[ResponseTrial] = []
    starts: list[Poles] = []
    for modes in range(1, most_modes + 1):
        starts.append(_start(measured, whitener, modes))
        trials.append(_trial(measured, whitener, starts[-1]))
        best = int(np.argmin([trial.criterion for trial in trials]))
        if len(trials) - 1 - best == _WORSE:
            break
    poles, solution = _fitted(measured, whitener, starts[best])
    while poles.modes + len(poles.real_hz) > 1:
        fewer = [poles.without(place) for place in range(poles.modes + len(poles.real_hz)) if _may_go(poles, place)]
        found = [_trial(measured, whitener, one).criterion for one in fewer]
        if not fewer or min(found) >= _trial(measured, whitener, poles).criterion:
            break
        poles, solution = _fitted(measured, whitener, fewer[int(np.argmin(found))])
        trials.append(_trial(measured, whitener, poles))
    return _result(measured, poles, solution, tuple(trials))


def _may_go(poles: Poles, place: int) -> bool:
    """Whether something that swings is left without a pole."""
    return place >= poles.modes or poles.modes > 1


def _start(measured: Responses, whitener: FloatArray, modes: int) -> Poles:
    """Poles by vector fitting with the mean weight of Re and Im."""
    elements = list(np.ndindex(measured.value.shape[1:]))
    weights = [np.sqrt(np.einsum("kij,kij->k", whitener[:, c, d], whitener[:, c, d]) / 2) for c, d in elements]
    return fitted_poles(measured.frequency_hz, [measured.value[:, c, d] for c, d in elements], weights, modes)


def _fitted(measured: Responses, whitener: FloatArray, start: Poles) -> tuple[Poles, Solution]:
    """Weighted least squares poles from a start."""

    def blocks_at(vector: FloatArray) -> list[Block] | None:
        poles = start.with_vector(vector)
        return _blocks(measured, whitener, poles) if poles.allowed else None

    scale = np.concatenate(
        [1e-2 * start.frequency_hz, np.full(start.modes, 1e-2), np.maximum(0.3 * start.real_hz, 1e-3)]
    )
    solution = minimise(blocks_at, start.vector, scale, 60)
    return start.with_vector(solution.parameters), solution


def _blocks(measured: Responses, whitener: FloatArray, poles: Poles) -> list[Block]:
    """One block of rows per element, load after load."""
    basis, slopes = response_basis(poles, measured.frequency_hz), _slopes(poles, measured.frequency_hz)
    found, rows = [], slice(0, 2 * len(measured.frequency_hz))
    for d in range(len(measured.components)):
        for c in range(len(measured.channels)):
            own = whitener[:, c, d]
            moved = tuple(Slope(place, rows, columns, _whitened(own, value)) for place, columns, value in slopes)
            found.append(Block(_whitened(own, basis), _whitened(own, measured.value[:, c, d][:, None]), moved))
    return found


def _whitened(whitener: FloatArray, values: ComplexArray) -> FloatArray:
    """Real rows (2K, B) of unit variance of complex columns (K, B)."""
    pairs = np.stack([values.real, values.imag], axis=1)
    return np.asarray((whitener @ pairs).reshape(-1, values.shape[1]))


def _slopes(poles: Poles, frequency_hz: FloatArray) -> list[tuple[int, IntArray, ComplexArray]]:
    """Parameter, columns and change (K, b) of the basis with every parameter of the poles."""
    s = 2j * np.pi * frequency_hz[:, None]
    m, found = poles.modes, []
    upper, real = np.split(poles.values, [m])
    for k, slope in enumerate(pole_slopes(poles.frequency_hz, poles.damping_ratio)):
        above, below = slope / (s - upper) ** 2, slope.conj() / (s - upper.conj()) ** 2
        for i in range(m):
            value = np.stack([above[:, i] + below[:, i], 1j * (above[:, i] - below[:, i])], axis=1)
            found.append((k * m + i, np.array([i, m + i]), value))
    for q in range(len(real)):
        found.append((2 * m + q, np.array([2 * m + q]), -2 * np.pi / (s - real[q]) ** 2))
    return found


def _trial(measured: Responses, whitener: FloatArray, poles: Poles) -> ResponseTrial:
    """The entry of some poles, held as they are."""
    parameters = poles.count * (1 + len(measured.channels) * len(measured.components))
    basis, loss = response_basis(poles, measured.frequency_hz), 0.0
    for c, d in np.ndindex(measured.value.shape[1:]):
        rows = _whitened(whitener[:, c, d], basis)
        data = _whitened(whitener[:, c, d], measured.value[:, c, d][:, None])[:, 0]
        loss += float(np.sum((data - rows @ np.linalg.lstsq(rows, data, rcond=None)[0]) ** 2))
    criterion = loss + float(np.log(2 * measured.value.size)) * parameters
    return ResponseTrial(poles.modes, len(poles.real_hz), loss, criterion)


def _result(measured: Responses, poles: Poles, solution: Solution, trials: tuple[ResponseTrial, ...]) -> ResponseFit:
    """The model with covariance."""
    shape = (poles.count, len(measured.components), len(measured.channels))
    table = np.stack([own[:, 0] for own in solution.projected.coefficients], axis=1).reshape(shape).transpose(0, 2, 1)
    re, im, real = np.split(table, [poles.modes, 2 * poles.modes])
    model = MultiModel(
        channels=measured.channels,
        components=measured.components,
        unit=measured.unit,
        frequency_hz=poles.frequency_hz,
        damping_ratio=poles.damping_ratio,
        residue=re + 1j * im,
        real_hz=poles.real_hz,
        real_residue=real,
    )
    check_separable(model.static_gain, model.channels, model.components)
    chi_squared, dof = solution.projected.loss, 2 * measured.value.size - len(model.vector)
    excess = max(1.0, chi_squared / max(dof, 1))
    spread, follows = covariances(solution, [np.full(1, excess)] * len(solution.blocks))
    n = model.shared
    rows, own = np.zeros((len(model.vector), n)), np.zeros((len(model.vector),) * 2)
    rows[:n] = np.eye(n)
    for i, follow in enumerate(follows):
        here = slice(n * (1 + i), n * (2 + i))
        rows[here] = follow[0][:, :n]
        own[here, here] = follow[0][:, n:] @ follow[0][:, n:].T
    notices = []
    if excess > _UNEXPLAINED:
        text = (
            f"the model leaves {np.sqrt(excess):.1f} times what the covariance of the responses explains, which is in U"
        )
        notices.append(Notice("warning", text, "responses"))
    if not model.stable:
        notices.append(Notice("warning", "the model has a pole that grows", "model"))
    model = replace(model, covariance=rows @ spread @ rows.T + own)
    return ResponseFit(model, chi_squared, dof, trials, tuple(notices))
