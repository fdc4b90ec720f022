"""Common poles of several outputs, from step responses and from frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, Notice, check_shape
from shaker.decoupling.model import Block, MultiModel, Slope, Solution, covariances, minimise, pole_slopes
from shaker.decoupling.order import (
    Fitted,
    check_separable,
    chosen,
    fit_poles,
    fitted_poles,
    in_order,
    needed,
    otherwise,
    response_basis,
    shaped,
)
from shaker.decoupling.result import MultiFit, misfits, multi_fit
from shaker.decoupling.steps import (
    Poles,
    Release,
    SampleBlocks,
    Sampled,
    StepProblem,
    averaged,
    highest_frequency,
    prepared,
    shared_poles,
)
from shaker.release.reading import read_release
from shaker.release.record import Reading, StepRecord

# A model of all outputs over all loads from frequency responses, such as those of chirps and sines.


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


# A model of all outputs over all loads from records of releases of every load.


_PER_PERIOD = 6.0
_LEAST_BLOCKS = 1200
_DETECTED = 2.0
_APART = 2.0
_NEAR = 0.5
_BEFORE, _AFTER = 0.3, 2.0
"""Time constants of the slowest mode that the number of poles is looked for in, before and after a release."""


def fit_steps(records: Sequence[StepRecord], most_modes: int | None = None, most_reals: int = 2) -> MultiFit:
    """Return the model with common poles of all outputs over all loads that the records release, with covariance.

    Output-error least squares over the common poles and every record's release, residues by projection; numbers of
    modes and real poles by a rule, at most `most_modes` and `most_reals`. All records hold the same channels at one
    rate. Loads that the outputs do not tell apart are refused with their names.
    """
    components = _checked(records)
    readings = [_clearest(record) for record in records]
    noise = _noise(records, readings)
    problem, releases, start = _posed(records, readings, noise, components)
    start = needed(problem, start, releases, most_modes)
    near = _around(problem, releases, 1.0 / float(np.min(-start.values.real)))
    found, trials = chosen(near, start, releases, most_modes, most_reals)
    found = otherwise(near, found)
    found = _settled(problem, shaped(problem, fit_poles(problem, found.poles, found.releases, calm=_NEAR)))
    again = noise * misfits(found, len(noise))
    problem = replace(problem, records=tuple(_reweighted(record, noise / again) for record in problem.records))
    found = fit_poles(problem, found.poles, found.releases)
    return multi_fit(records, problem, found, again, tuple(trials))


def _checked(records: Sequence[StepRecord]) -> tuple[str, ...]:
    """The loads of records that fit together, Fx first."""
    if not records:
        raise ValueError("records: expected at least one, found none")
    first = records[0]
    for record in records:
        for name in ("channels", "unit", "sample_rate_hz"):
            if getattr(record, name) != getattr(first, name):
                found, expected = getattr(record, name), getattr(first, name)
                raise ValueError(
                    f"records: expected {name} {expected} as in {first.name}, found {found} in {record.name}"
                )
    return in_order(record.component for record in records)


def _clearest(record: StepRecord) -> Reading:
    """What the output shows of a release that changes most over what it scatters by before."""
    count = record.samples.shape[1]
    rest, end = record.samples[:, : max(8, count // 50)], record.samples[:, -max(8, count // 5) :]
    change = np.abs(end.mean(axis=1) - rest.mean(axis=1)) / np.maximum(rest.std(axis=1), 1e-300)
    return read_release(record, record.channels[int(np.argmax(change))])


def _noise(records: Sequence[StepRecord], readings: Sequence[Reading]) -> FloatArray:
    """Standard deviation of a sample (C,) before the releases; a silent output has that of its digits."""
    sums, count = np.zeros(len(records[0].channels)), 0
    for record, reading in zip(records, readings, strict=True):
        rest = record.samples[:, : max(8, int(0.9 * (reading.onset_s - record.start_s) * record.sample_rate_hz))]
        sums += np.sum((rest - rest.mean(axis=1, keepdims=True)) ** 2, axis=1)
        count += rest.shape[1] - 1
    spans = np.max([np.ptp(record.samples, axis=1) for record in records], axis=0)
    return np.asarray(np.maximum(np.sqrt(sums / count), 1e-9 * spans.max()))


def _posed(
    records: Sequence[StepRecord], readings: Sequence[Reading], noise: FloatArray, components: tuple[str, ...]
) -> tuple[StepProblem, tuple[Release, ...], Poles]:
    """The least squares problem, with releases as read and poles of the decays to start from."""
    rate = records[0].sample_rate_hz
    decays = [_decay(record, reading) / noise[:, None] for record, reading in zip(records, readings, strict=True)]
    size = max(1, int(rate / (_PER_PERIOD * highest_frequency(decays, rate))))
    size = min(size, max(1, min(part.shape[1] for part in decays) // _LEAST_BLOCKS))
    sampled = tuple(
        Sampled(
            record.name,
            record.component,
            record.amplitude,
            prepared(record.samples, noise, size),
            SampleBlocks(record.start_s, rate, record.samples.shape[1] // size, size),
        )
        for record in records
    )
    found = _offered([averaged(part, size) for part in decays], [record.component for record in records], rate / size)
    if not len(found):
        raise ValueError("records: expected outputs that swing after the release, found none")
    poles = Poles(np.abs(found) / (2 * np.pi), np.clip(-found.real / np.abs(found), 1e-4, 0.9), np.zeros(0))
    releases = tuple(
        Release(
            reading.onset_s + reading.release_s / 2.0,
            max(reading.release_s, 1.0 / rate),
            True,
            "smooth" if reading.shape == "smooth" else "ramp",
        )
        for reading in readings
    )
    return StepProblem(sampled, components), releases, poles


def _offered(decays: Sequence[FloatArray], loads: Sequence[str], rate_hz: float) -> ComplexArray:
    """Poles of all decays together, and those of each load's decays that are not among them."""
    found = shared_poles(decays, rate_hz)
    for load in dict.fromkeys(loads):
        for pole in shared_poles([part for part, own in zip(decays, loads, strict=True) if own == load], rate_hz):
            if not np.any(np.abs(found - pole) < _APART * np.maximum(-pole.real, -found.real)):
                found = np.append(found, pole)
    return found


def _around(problem: StepProblem, releases: Sequence[Release], lasts_s: float) -> StepProblem:
    """The same with records cut to what surrounds the release, by a time constant in s, for the search of poles."""
    cut = []
    for record, release in zip(problem.records, releases, strict=True):
        blocks = record.blocks
        first, last = (
            int((release.middle_s + sign * release.duration_s + by - blocks.start_s) * blocks.rate_hz / blocks.size)
            for sign, by in ((-1.0, -_BEFORE * lasts_s), (1.0, _AFTER * lasts_s))
        )
        first, last = max(0, first), min(blocks.count, last)
        data = record.data[first:last]
        start_s = blocks.start_s + first * blocks.size / blocks.rate_hz
        moved = replace(blocks, start_s=start_s, count=last - first)
        cut.append(replace(record, data=data - data.mean(axis=0), blocks=moved))
    return replace(problem, records=tuple(cut))


def _decay(record: StepRecord, reading: Reading) -> FloatArray:
    """Samples (C, N) after the release, less their last level."""
    end = reading.onset_s + 1.5 * reading.release_s + 2.0 / record.sample_rate_hz
    rest = record.samples[:, int((end - record.start_s) * record.sample_rate_hz) :]
    return np.asarray(rest - rest[:, -max(8, rest.shape[1] // 5) :].mean(axis=1, keepdims=True))


def _settled(problem: StepProblem, found: Fitted) -> Fitted:
    """Take a release whose duration is not told from none for a step, and fit again."""
    _, u_duration = _release_u(found)
    releases = tuple(
        replace(release, duration_s=0.0, free=False) if release.duration_s < _DETECTED * u else release
        for release, u in zip(found.releases, u_duration, strict=True)
    )
    return fit_poles(problem, found.poles, releases, calm=_NEAR)


def _release_u(found: Fitted) -> tuple[FloatArray, FloatArray]:
    """Standard uncertainties of middle and duration of the releases for noise of unit size, none for what is fixed."""
    spread, _ = covariances(found.solution, [np.ones(block.data.shape[1]) for block in found.solution.blocks])
    table = np.sqrt(np.diag(spread))[found.poles.count :].reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _reweighted(record: Sampled, factor: FloatArray) -> Sampled:
    """A record with other noise."""
    return replace(record, data=record.data * factor)
