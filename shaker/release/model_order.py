"""Number of poles that a release shows, difference equations of every order, doubtful fits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from shaker.lti.system import LinearSystem, ModalModel
from shaker.model_notices import (
    COLOURED_NOISE,
    DOUBTFUL_MODE,
    DOUBTFUL_REAL_POLE,
    GROWING_POLE,
    MODE_NEAR_SAMPLING_LIMIT,
    ONSET_CONTRADICTED,
    ONSET_UNCERTAIN,
    OUTPUT_AT_LIMIT,
    RELEASE_OUTSIDE_SEARCH,
    RESIDUAL_ABOVE_NOISE,
)
from shaker.release.load_response import BlockMeans, ReleaseLoad, block_length, reduce_to_blocks
from shaker.release.output_error import (
    FitCovariance,
    OutputErrorFit,
    OutputErrorProblem,
    PoleStructure,
    design,
    predicted_gain,
    solve,
    squares,
)
from shaker.release.record import (
    UNCLEAR,
    ReleaseReading,
    StepRecord,
    decimate,
    instrumental_variables,
    matrix_pencil,
    peaks_hz,
    start_poles,
)
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

# Modes that ring after a release: their number, and start values of the fit with the release.

MOST = 4  # largest number of modes by the rule
CLEAR = 12.0  # fall of B·ln(sum of squares) by a significant parameter
_HUM = 0.3  # amplitude before the release over that after it from which a line is hum or drift
STEEP = 0.5  # damping ratio above which a further mode is a disturbance


def decay_modes(
    whole: BlockMeans, reading: ReleaseReading, method: Literal["pencil", "arx"], count: int | None
) -> tuple[ComplexArray, float]:
    """Return the upper poles (M,) in rad/s of the decay, and the noise colour.

    Exponentials with free amplitudes and a level are fitted to the decay only, so that the release and fast poles do
    not matter; `count` of them, or as many as the record supports. A further mode is accepted if its line is
    significant in the residual's spectrum, its ζ is between 0 and 0.5, and it lowers B·ln(sum of squares) by more than
    12 for each of its four parameters, also if the noise is that of the residual in the octaves around it. Hum and
    drift are no modes: their line must not be in the output before the release. The colour is the density of the
    residual's blocks over that of white noise of the same variance.
    """
    start = reading.onset_s + reading.release_s + reading.u_onset_s
    decay = whole.between(min(start, float(whole.time_s[len(whole.time_s) * 3 // 4])), np.inf)
    near = peaks_hz(decay.value, decay.step_s, count or 1)
    if not near.size:
        where = f"{reading.record}, {reading.channel}"
        raise ValueError(f"{where}: expected an oscillation above the noise after the release, found none")
    values, coarse = decimate(decay.value, decay.step_s, float(near.max()))
    find = matrix_pencil if method == "pencil" else instrumental_variables
    modes = start_poles(find(values - values.mean(), coarse, 2 * (count or 1) + 1), count or 1, near)
    rung = _rung(decay, modes)
    rest = whole.between(-np.inf, reading.onset_s - 3.0 * reading.u_onset_s)
    while count is None and rung.problem.structure.modes < MOST:
        more = _with_another(decay, rest, rung)
        if more is None:
            break
        rung = more
    poles = rung.problem.structure.poles(rung.vector)
    colour = rung.variance / max(1e-300, float(np.var(_left(decay, rung))))
    return poles[np.argsort(np.abs(poles))], max(1.0, colour)


def _rung(decay: BlockMeans, modes: ComplexArray) -> OutputErrorFit:
    """Return exponentials with free amplitudes fitted to a decay."""
    begin = float(decay.time_s[0]) - decay.step_s
    structure = PoleStructure(len(modes), 0, 2 * len(modes), float(np.exp(np.mean(np.log(np.abs(modes))))))
    samples = reduce_to_blocks(
        decay, begin, begin, block_length(1.0 / decay.step_s, float(np.abs(modes).max()) / (2 * np.pi))
    )
    start = np.append(structure.vector(modes), begin)
    pinned = np.append(np.full(structure.order, np.inf), 1e-3 * decay.step_s)
    return solve(OutputErrorProblem(structure, ReleaseLoad("step", 1.0), samples, start, pinned), start)


def _with_another(decay: BlockMeans, rest: BlockMeans, found: OutputErrorFit) -> OutputErrorFit | None:
    """Return the fit with one additional mode, None if the record does not support it."""
    before = _left(decay, found)
    near = peaks_hz(before, decay.step_s, 1, local=True)
    if not near.size:
        return None
    values, coarse = decimate(before, decay.step_s, float(near[0]))
    extra = start_poles(matrix_pencil(values - values.mean(), coarse, 3), 1, near)
    modes = np.concatenate([found.problem.structure.poles(found.vector), extra])
    modes = modes[np.argsort(np.abs(modes))]
    trial = _rung(decay, modes)
    zeta = trial.vector[len(modes) : 2 * len(modes)]
    after = _left(decay, trial)
    squares = float(before @ before), float(after @ after)
    if not np.all((zeta > 0) & (zeta < STEEP)) or trial.size * float(np.log(squares[0] / squares[1])) <= 4 * CLEAR:
        return None
    gain = (squares[0] - squares[1]) / max(1e-300, _density(after, decay.step_s * float(near[0])))
    return trial if gain > 4 * CLEAR and not _in_rest(rest, trial, 2 * np.pi * float(near[0])) else None


def _density(residual: FloatArray, cycles: float) -> float:
    """Return the mean power of lines in the octaves around a frequency."""
    power = np.abs(np.fft.rfft(residual)) ** 2 / len(residual)
    line = cycles * len(residual)
    low, high = max(1, min(int(line / 2.0), int(line) - 2)), max(int(2.0 * line), int(line) + 3)
    return float(np.mean(power[low:high]))


def _in_rest(rest: BlockMeans, trial: OutputErrorFit, omega: float) -> bool:
    """Return whether the output before the release has the line of a mode.

    The mode is the one next to `omega` in rad/s. The line's amplitude there is above `_HUM` of that after the release,
    and above the noise.
    """
    if len(rest.value) < 8 or omega * np.ptp(rest.time_s) < np.pi:
        return False
    structure = trial.problem.structure
    poles = structure.poles(trial.vector)
    mode = int(np.argmin(np.abs(np.abs(poles) - omega)))
    ring = 2.0 * abs((structure.shares(trial.vector) @ trial.linear[1:])[mode] / poles[mode])
    phase = abs(poles[mode]) * rest.time_s
    wave = np.stack([np.ones(len(phase)), np.cos(phase), np.sin(phase)], axis=1)
    fit = np.linalg.lstsq(wave, rest.value, rcond=None)[0]
    noise = float(np.std(rest.value - wave @ fit)) * np.sqrt(2.0 / len(phase))
    return bool(np.hypot(fit[1], fit[2]) > max(_HUM * ring, 3.0 * noise))


def _left(decay: BlockMeans, found: OutputErrorFit) -> FloatArray:
    """Return the residual (N,) at every sample."""
    return np.asarray(decay.value - design(found.problem, found.vector, decay) @ found.linear)


# Start values of release and real poles: the best of a grid, for known modes.

LENGTHS = (0.25, 0.6, 1.2)  # trial lengths of the release, in rise times
TERM = 8.0  # fall of B·ln(sum of squares) by a significant numerator term
_REAL = (1.5, 4.0, 10.0)  # trial real poles, in frequencies of the lowest mode
_LAG = (0.0, 0.08, 0.17, 0.25)  # trial delays of the half-way point after the middle of the release, in periods
LOOSE = (1.5, 2.0)  # standard deviations of logarithms of real poles and of the length about the grid point


def start_vectors(
    structure: PoleStructure, load: ReleaseLoad, samples: BlockMeans, modes: ComplexArray, reading: ReleaseReading
) -> list[FloatArray]:
    """Return the best grid point for every number of numerator terms."""
    lowest = float(np.abs(modes).min()) / (2 * np.pi)
    rise = min(reading.rise_s, 3.0 / lowest + reading.release_s)
    near = samples.between(reading.onset_s - 2.0 / lowest, reading.onset_s + reading.release_s + rise + 2.0 / lowest)
    rich = replace(structure, terms=structure.order)
    best, found = np.full(rich.terms, np.inf), [np.zeros(0)] * rich.terms
    for vector in _grid(structure, load, near, modes, reading, rise):
        costs = squares(
            OutputErrorProblem(rich, load, near, vector, np.ones(len(vector)), reading.onset_s), vector[None]
        )[0]
        found = [vector if cost < old else last for cost, old, last in zip(costs, best, found, strict=True)]
        best = np.minimum(best, costs)
    return found


def with_loose_prior(
    problem: OutputErrorProblem, vector: FloatArray, highest_hz: float
) -> tuple[OutputErrorProblem, FloatArray]:
    """Return a problem with a wide prior about a vector, and the vector.

    The prior of the onset has the standard deviation 1/`highest_hz`.
    """
    modes, order = problem.structure.modes, problem.structure.order
    wide = np.full(len(vector), np.inf)
    wide[2 * modes : order] = LOOSE[0]
    wide[order : order + 2] = np.array([1.0 / highest_hz, LOOSE[1]])[: len(vector) - order]
    return replace(problem, prior=vector, u_prior=wide), vector


def _grid(
    structure: PoleStructure,
    load: ReleaseLoad,
    near: BlockMeans,
    modes: ComplexArray,
    reading: ReleaseReading,
    rise: float,
) -> list[FloatArray]:
    """Return the start vectors of a grid; real poles ascend within a vector."""
    lowest = float(np.abs(modes).min()) / (2 * np.pi)
    change = reading.steady - reading.baseline
    passed = np.flatnonzero((near.value - reading.baseline) * change >= 0.5 * change**2)
    later = passed[near.time_s[passed] >= reading.onset_s]
    half = float(near.time_s[later[0]]) if later.size else reading.onset_s
    lengths = np.array(LENGTHS) * rise if load.lasting else np.zeros(1)
    if load.lasting and reading.release_s > 0:
        lengths = np.array([reading.release_s])
    corners, vectors = [min(share * lowest, 0.4 / near.step_s) for share in _REAL], []
    for pick in product(corners, repeat=structure.reals):
        if list(pick) != sorted(pick):
            continue
        reals = -2 * np.pi * np.array(pick) * (1.0 + 0.2 * np.arange(structure.reals))
        head, lag = structure.vector(np.concatenate([modes, reals + 0j])), float(np.sum(-1.0 / reals))
        for length in lengths:
            tail = [np.log(length)] if load.lasting else []
            middles = [half - lag - share / lowest for share in _LAG] + [reading.onset_s + 0.5 * length]
            for middle in middles if load.timed else [0.0]:
                vectors.append(np.concatenate([head, [middle] if load.timed else [], tail]))
    return vectors


# Order search: number of poles, time course of the load, numerator terms.

_ROUNDING = 1e-9  # share of the output below which a residual is rounding


@dataclass(frozen=True)
class OrderSearch:
    """Data and limits of the order search.

    `whole`: all samples. `modes` and `reals`: given numbers, else None. `colour`, `chain` as in
    `OutputErrorProblem`.
    """

    whole: BlockMeans
    reading: ReleaseReading
    loads: tuple[ReleaseLoad, ...]
    method: Literal["pencil", "arx"]
    modes: int | None
    reals: int | None
    colour: float = 1.0
    chain: tuple[float, float] | None = None


def search_order(search: OrderSearch) -> tuple[OutputErrorFit, ...]:
    """Return the supported fits, one for each candidate load, the likeliest first.

    Modes are counted on the decay. One real pole and the length of the release are always fitted: even if they are too
    short to be observed they change amplitude and phase of the ringing, and a model without them would claim a
    certainty that the record does not give. A second real pole is added, for every load, if it lowers χ² of the
    likeliest by more than 12; a numerator term if by more than 8. χ² is B·ln(sum of squares) with the number B of
    blocks, divided by the density of coloured noise, which would lower it by chance.
    """
    ringing, force = search.whole, search.loads[0].force
    if force is not None:  # the part proportional to a measured load is subtracted, so that the ringing remains
        follows = np.stack([np.ones(len(force)), force], axis=1)
        left = ringing.value - follows @ np.linalg.lstsq(follows, ringing.value, rcond=None)[0]
        ringing = replace(ringing, value=left)
    modes, colour = decay_modes(ringing, search.reading, search.method, search.modes)
    search = replace(search, colour=colour)
    reals = 1 if search.reals is None else search.reals
    found = sorted((_fit_one(search, load, modes, reals) for load in search.loads), key=penalised_chi_squared)
    first = _with_real(found[0], CLEAR) if search.reals is None else None
    if first is not None and penalised_chi_squared(first) < penalised_chi_squared(found[0]):
        rest = [_with_real(one, -np.inf) or one for one in found[1:]]
        found = sorted([first, *rest], key=penalised_chi_squared)
    return tuple(found)


def _with_real(plain: OutputErrorFit, least: float) -> OutputErrorFit | None:
    """Return the fit with one more real pole, None without the `least` gain."""
    structure, order = plain.problem.structure, plain.problem.structure.order
    two = replace(plain.problem, structure=replace(structure, reals=structure.reals + 1))
    starts = [np.insert(plain.vector, order, plain.vector[order - 1] + further) for further in (-0.7, 0.7, 1.6)]
    gain, start = predicted_gain(plain, two, starts)
    if gain < least * plain.problem.colour:
        return None
    more = solve(*with_loose_prior(two, start, float(np.exp(plain.vector[: structure.modes].max())) / (2 * np.pi)))
    return replace(more, path=plain.path + more.path)


def penalised_chi_squared(fit: OutputErrorFit) -> float:
    """Return χ² plus 8 per numerator term and 12 per pole."""
    samples, structure = fit.problem.samples, fit.problem.structure
    least = _ROUNDING**2 * float(np.sum((samples.weight * samples.value) ** 2))
    chi_square = fit.size * float(np.log(fit.square + least)) / fit.problem.colour
    return chi_square + fit.problem.pull(fit.vector) + TERM * structure.terms + CLEAR * structure.order


def _fit_one(search: OrderSearch, load: ReleaseLoad, modes: ComplexArray, reals: int) -> OutputErrorFit:
    """Return the fit for one load with the numerator terms it needs."""
    reading, whole = search.reading, search.whole
    highest, lowest = (float(edge) / (2 * np.pi) for edge in (np.abs(modes).max(), np.abs(modes).min()))
    structure = PoleStructure(len(modes), reals, 1, float(np.exp(np.mean(np.log(np.abs(modes))))))
    margin = 0.5 / lowest + 3.0 * whole.step_s
    end = reading.onset_s + reading.release_s + 2.0 * margin
    samples = reduce_to_blocks(whole, reading.onset_s - margin, end, block_length(1.0 / whole.step_s, highest))
    starts = start_vectors(structure, load, samples, modes, reading)
    problem = OutputErrorProblem(
        structure, load, samples, starts[0], starts[0], reading.onset_s, search.colour, search.chain
    )
    return add_numerator_terms(solve(*with_loose_prior(problem, starts[0], highest)), starts, highest)


def add_numerator_terms(found: OutputErrorFit, starts: list[FloatArray], highest_hz: float) -> OutputErrorFit:
    """Return the fit with additional numerator terms that are significant.

    With few terms a release about as long as the period of a further mode gives that mode the wrong sign. With several
    modes a richer model is therefore fitted also from its own start.
    """
    problem = found.problem
    for terms in range(2, problem.structure.order + 1):
        richer = replace(problem, structure=replace(problem.structure, terms=terms))
        own = [found.vector, starts[terms - 1]]
        gain, _ = predicted_gain(found, richer, own)
        if gain > TERM * problem.colour * (terms - found.problem.structure.terms):
            firm = 1.0 if terms <= problem.structure.smoothest else 6.0
            best = min(own, key=lambda vector: squares(richer, vector[None])[0, -1])
            chosen = own if problem.structure.modes > 1 else [best]
            tried = [solve(*with_loose_prior(richer, start, firm * highest_hz)) for start in chosen]
            trial = min(tried, key=penalised_chi_squared)
            found = (
                replace(trial, path=found.path + trial.path)
                if penalised_chi_squared(trial) < penalised_chi_squared(found)
                else found
            )
    return found


# Difference equations of every order from one factorisation of the data.

_BEND = 0.15  # share of the fall of ln J that may remain above the selected order


@dataclass(frozen=True, repr=False)
class OrderFamily(Arrays, shapes="triangle R R"):
    """Least-squares difference equations of order 0 … n from one factorisation.

    `triangle` (2n + 2, 2n + 2): R of the QR factorisation of the rows [u(k-n) y(k-n) … u(k-1) y(k-1) u(k) y(k)] over
    all instants k, sampled at `sample_rate_hz`. In this interleaved order every leading part is the data of a lower
    order. The method is known as augmented UD identification, or simultaneous identification of order and parameters.
    """

    triangle: FloatArray
    sample_rate_hz: float

    @property
    def most(self) -> int:
        """The highest order n."""
        return len(self.triangle) // 2 - 1

    def loss(self, direct: bool = True) -> FloatArray:
        """Return J (n,), squared equation errors of order 1 … n, `direct` with b0·u(k)."""
        last = 2 * np.arange(1, self.most + 1) + 1
        squares = self.triangle[last, last] ** 2
        return np.asarray(squares if direct else squares + self.triangle[last - 1, last] ** 2)

    def parameters(self, order: int, direct: bool = True) -> FloatArray:
        """Return [b_n, -a_n, …, b_1, -a_1, b_0] of one order, b_0 only if `direct`."""
        if not 1 <= order <= self.most:
            raise ValueError(f"order: expected 1 to {self.most}, found {order}")
        size = 2 * order + direct
        return np.asarray(
            np.linalg.lstsq(self.triangle[:size, :size], self.triangle[:size, 2 * order + 1], rcond=None)[0]
        )

    def system(self, order: int, direct: bool = True) -> LinearSystem:
        """Return the difference equation of one order as a sampled system."""
        parameters = self.parameters(order, direct)
        load, past = parameters[: 2 * order : 2][::-1], parameters[1 : 2 * order : 2][::-1]
        numerator = np.concatenate([parameters[-1:] if direct else [0.0], load])
        return LinearSystem.from_coefficients(numerator, np.concatenate([[1.0], -past]), self.sample_rate_hz)

    def bend(self, direct: bool = True) -> int:
        """Return the lowest order that leaves 15 % of the fall of ln J."""
        loss = np.log(np.maximum(self.loss(direct), 1e-300))
        left = (loss - loss.min()) / max(1e-12, loss[0] - loss.min())
        return int(np.argmax(left <= _BEND)) + 1


def fit_all_orders(load: FloatArray, output: FloatArray, sample_rate_hz: float, most: int = 9) -> OrderFamily:
    """Return the difference equations of order 0 … `most` of load and output (N,)."""
    check_shape("output", output, load.shape)
    if len(load) < 4 * most + 4:
        raise ValueError(f"load: expected at least {4 * most + 4} samples for order {most}, found {len(load)}")
    windows = [np.lib.stride_tricks.sliding_window_view(part, most + 1) for part in (load, output)]
    rows = np.stack(windows, axis=2).reshape(len(windows[0]), 2 * most + 2)
    return OrderFamily(np.asarray(np.linalg.qr(rows)[1]), sample_rate_hz)


# Notices of an identification.

_MORE = 1.5  # variance of the residual over that of the noise before the release; a correct model leaves about 1


def fit_notices(
    record: StepRecord, reading: ReleaseReading, solution: OutputErrorFit, model: ModalModel, spread: FitCovariance
) -> tuple[Notice, ...]:
    """Return notices on the poles, the residual and the release."""
    where = f"{record.name}, {reading.channel}"
    notices = [*_of_poles(model, record.sample_rate_hz, where), *_of_residual(reading, spread, where)]
    return (*notices, *_of_release(record, solution, spread, where))


def _of_poles(model: ModalModel, rate_hz: float, where: str) -> Iterator[Notice]:
    """Yield notices on growing poles, poles near the sampling limit, and uncertain ones."""
    assert model.covariance is not None
    u, modes = np.sqrt(np.diag(model.covariance)), len(model.frequency_hz)
    for hz, zeta, u_zeta in zip(model.frequency_hz, model.damping_ratio, u[modes : 2 * modes], strict=True):
        if zeta < 0:
            yield Notice(GROWING_POLE, where, frequency_hz=hz)
        elif u_zeta > UNCLEAR * zeta or zeta > 0.6:
            yield Notice(DOUBTFUL_MODE, where, frequency_hz=hz, damping_ratio=zeta, u_damping_ratio=u_zeta)
        if hz > 0.4 * rate_hz:
            yield Notice(MODE_NEAR_SAMPLING_LIMIT, where, frequency_hz=hz, rate_hz=rate_hz)
    for hz, u_hz in zip(model.real_hz, u[4 * modes :], strict=False):
        if hz > 0.5 * rate_hz or u_hz > UNCLEAR * abs(hz):
            yield Notice(DOUBTFUL_REAL_POLE, where, frequency_hz=hz, u_hz=u_hz)


def _of_residual(reading: ReleaseReading, spread: FitCovariance, where: str) -> Iterator[Notice]:
    """Yield notices on the order of the model and on the noise."""
    ratio = float(np.std(spread.residual)) / reading.noise if reading.noise > 0 else np.inf
    if ratio**2 > _MORE:
        yield Notice(RESIDUAL_ABOVE_NOISE, where, factor=ratio)
    elif not spread.white:
        yield Notice(COLOURED_NOISE, where, factor=np.sqrt(spread.excess))
    if reading.clipped:
        yield Notice(OUTPUT_AT_LIMIT, where)


def _of_release(record: StepRecord, solution: OutputErrorFit, spread: FitCovariance, where: str) -> Iterator[Notice]:
    """Yield notices on the onset and the release."""
    load, samples = solution.problem.load, solution.problem.samples
    if not load.timed:
        return
    middle, length = solution.problem.release(solution.vector)
    fastest = float(np.exp(np.max(solution.vector[: solution.problem.structure.modes]))) / (2 * np.pi)
    if spread.u_onset_s > 0.1 / fastest:
        yield Notice(ONSET_UNCERTAIN, where, u_onset_s=spread.u_onset_s)
    coarse = samples.time_s[samples.length > 1]
    if np.any(np.abs(coarse - middle) < 0.5 * length):
        yield Notice(RELEASE_OUTSIDE_SEARCH, where, middle_s=middle)
    if record.onset_s is not None and abs(record.onset_s - middle + 0.5 * length) > 1.0 / fastest:
        yield Notice(ONSET_CONTRADICTED, where, found_s=middle - 0.5 * length, stated_s=record.onset_s)
