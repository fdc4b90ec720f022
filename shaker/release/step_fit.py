"""Models of a step response by every method: output error, simultaneous identification (SIM), evolution."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from shaker.lti.indices import pole_notices
from shaker.lti.system import Conversion, LinearSystem, ModalModel
from shaker.model_notices import NO_CONTINUOUS_MODEL, OUTPUT_DIVERGES, RELEASE_SHAPE_UNDETERMINED
from shaker.release.load_response import ReleaseLoad, every_sample, reduce_to_blocks
from shaker.release.model_order import (
    OrderSearch,
    add_numerator_terms,
    fit_all_orders,
    fit_notices,
    penalised_chi_squared,
    search_order,
    with_loose_prior,
)
from shaker.release.output_error import (
    OutputErrorFit,
    OutputErrorProblem,
    PoleStructure,
    fit_covariance,
    modal_model,
    solve,
    squares,
)
from shaker.release.reading import read_release
from shaker.release.record import ReleaseReading, ReleaseShape, StepRecord
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.fitting import REJECT_CHI2, excess_chi2_sigmas
from shakercal._common.kernels import njit
from shakercal._common.notices import Notice

# Result of an identification from a step response, for all methods.

Method = Literal["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


@dataclass(frozen=True, repr=False)
class StepFit(Arrays, shapes="time_s N; fitted N; residual N; convergence I"):
    """A model of one output for one load component.

    `model`: continuous, in output unit per load unit; None if the poles of `system` have no modal form. `system`: the
    same, or the system of the method itself, at full precision. `sample_rate_hz`, `decimation`: of the fitted samples.
    `fitted`, `residual` (N,) over `time_s` (N,) in output units. `onset_s`, `u_onset_s`, `release_s`, `u_release_s`:
    start and length of the release, whose time course is `shape`. `variance_accounted`: 1 - |residual|²/|y - mean|².
    `convergence`: loss over iterations, generations or the order 1, 2, …. `order`: number of poles. `duration_s`:
    computing time. `excess`: χ² above that of the likeliest shape. `solution`: of output-error least squares.
    """

    method: Method
    channel: str
    component: str
    unit: str
    model: ModalModel | None
    system: LinearSystem
    time_s: FloatArray
    fitted: FloatArray
    residual: FloatArray
    sample_rate_hz: float
    decimation: int
    order: int
    variance_accounted: float
    convergence: FloatArray
    duration_s: float
    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    shape: ReleaseShape = "step"
    excess: float = 0.0
    notices: tuple[Notice, ...] = ()
    solution: OutputErrorFit | None = None


# A solution as a result.


def as_step_fit(
    record: StepRecord, reading: ReleaseReading, solution: OutputErrorFit, method: Method, began: float
) -> StepFit:
    """Return a result with its covariance from every sample."""
    value = record.samples[record.channels.index(reading.channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    covariance = fit_covariance(solution, whole)
    model = modal_model(solution, covariance.covariance, record.u_amplitude)
    middle, length = solution.problem.release(solution.vector)
    timed = solution.problem.load.timed
    decimation = int(solution.problem.samples.length[-1])
    return StepFit(
        method=method,
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=model,
        system=model.system,
        time_s=whole.time_s,
        fitted=covariance.fitted,
        residual=covariance.residual,
        sample_rate_hz=record.sample_rate_hz / decimation,
        decimation=decimation,
        order=solution.problem.structure.order,
        variance_accounted=1.0 - float(np.sum(covariance.residual**2) / np.sum((value - value.mean()) ** 2)),
        convergence=np.array(solution.path),
        duration_s=time.perf_counter() - began,
        onset_s=middle - 0.5 * length if timed else reading.onset_s,
        u_onset_s=covariance.u_onset_s if timed else reading.u_onset_s,
        release_s=length,
        u_release_s=covariance.u_release_s,
        shape=solution.problem.load.shape,
        notices=fit_notices(record, reading, solution, model, covariance),
        solution=solution,
    )


# Model of a sensor from the record of one release.

SHAPES = {"step": "a step", "ramp": "a ramp", "smooth": "half a cosine", "measured": "the measured force"}
ReleaseOption = Literal["step", "ramp", "smooth", "measured"]


def fit_step(
    record: StepRecord,
    channel: str,
    *,
    reading: ReleaseReading | None = None,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: ReleaseOption | None = None,
) -> StepFit:
    """Fit a model of one output to one release by output-error least squares.

    Parameters
    ----------
    record
        outputs during one release
    channel
        name of the output
    reading
        result of `read_release` for this channel, default None: it is read first
    modes, real_poles
        numbers of oscillating modes and real poles, default None: selected by rule
    method
        start values from a matrix "pencil" (default) or an "arx" model
    release
        "step", "ramp", "smooth" or "measured"; default None: the measured force, else the likelier of ramp and half
        cosine

    Returns
    -------
    StepFit : the model with its covariance

    Notes
    -----
    The covariance contains the noise of the record, coloured or white, the baseline, the release and the amplitude of
    the load. It also contains the effect of the other shape of the release if the record does not reject it.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import StepRecord, fit_step
    >>> time_s, noise = np.arange(4000) / 10e3 - 0.05, 1e-3 * np.random.default_rng(0).normal(size=4000)
    >>> ring = np.exp(-40.0 * time_s) * np.cos(2 * np.pi * 310.0 * time_s)
    >>> volts = np.where(time_s < 0.0, 2.0, 2.0 * ring) + noise  # 20 N are taken off
    >>> record = StepRecord("line 1", ("Fz",), "V", volts[None], 10e3, "Fz", -20.0)
    >>> model = fit_step(record, "Fz").model
    >>> print(f"{model.frequency_hz[0]:.0f} Hz, damping ratio {model.damping_ratio[0]:.2f}")
    310 Hz, damping ratio 0.02
    """
    reading = reading or read_release(record, channel)
    fits = fit_shapes(record, channel, reading, modes, real_poles, method, release)
    fit = merge_alternatives(fits)
    where = f"{record.name}, {channel}"
    shapes = [
        Notice(RELEASE_SHAPE_UNDETERMINED, where, alternatives=text)
        for other in fits[1:]
        if other.excess < REJECT_CHI2 and (text := describe_difference(fits[0], other))
    ]
    return replace(fit, notices=(*fit.notices, *shapes))


def fit_shapes(
    record: StepRecord,
    channel: str,
    reading: ReleaseReading,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: ReleaseOption | None = None,
) -> tuple[StepFit, ...]:
    """Return the result of `fit_step` for each possible shape, the likeliest first."""
    began = time.perf_counter()
    whole = every_sample(record.samples[record.channels.index(channel)], record.time_s, 1.0 / record.sample_rate_hz)
    found = search_order(
        OrderSearch(whole, reading, candidate_loads(record, reading, release), method, modes, real_poles)
    )
    fits = [as_step_fit(record, reading, one, method, began) for one in found]
    least, *_ = costs = [penalised_chi_squared(one) for one in found]
    return tuple(replace(fit, excess=cost - least) for fit, cost in zip(fits, costs, strict=True))


def merge_alternatives(fits: Sequence[StepFit], excess: float | None = None) -> StepFit:
    """Return the first fit, its uncertainty including fits that are not rejected.

    `excess`: χ² of the other fit above the first, default None: that of the record itself.
    """
    first = fits[0]
    for other in fits[1:]:
        more = other.excess if excess is None else excess
        if more >= REJECT_CHI2 or first.model is None or other.model is None or first.model.covariance is None:
            continue
        far = excess_chi2_sigmas(more)
        shift = (other.model.vector - first.model.vector) / far
        first = replace(
            first,
            model=replace(first.model, covariance=first.model.covariance + np.outer(shift, shift)),
            u_onset_s=float(np.hypot(first.u_onset_s, (other.onset_s - first.onset_s) / far)),
            u_release_s=float(np.hypot(first.u_release_s, (other.release_s - first.release_s) / far)),
        )
    return first


def describe_difference(first: StepFit, other: StepFit) -> str:
    """Return both release shapes with their real poles; "" for a small difference."""
    if first.model is None or other.model is None or first.model.covariance is None:
        return ""
    difference = np.abs(other.model.vector - first.model.vector)
    if not np.any(difference > np.sqrt(np.diag(first.model.covariance))):
        return ""
    shapes = [SHAPES[fit.shape] for fit in (first, other)]
    poles = [" and ".join(f"{hz:.3g}" for hz in np.sort(fit.model.real_hz)) for fit in (first, other) if fit.model]
    of_poles = f" (real pole at {poles[0]} Hz or {poles[1]} Hz)" if poles[0] else ""
    return f"{shapes[0]} or {shapes[1]}{of_poles}"


def candidate_loads(
    record: StepRecord, reading: ReleaseReading, release: ReleaseOption | None
) -> tuple[ReleaseLoad, ...]:
    """Return the time courses of the load that are fitted."""
    if release == "measured" or (release is None and record.force is not None):
        if record.force is None:
            raise ValueError(
                'release: expected "step", "ramp" or "smooth" for a record without force, found "measured"'
            )
        rest = record.time_s < reading.onset_s - 3.0 * reading.u_onset_s
        level = float(np.mean(record.force[rest])) if np.any(rest) else float(record.force[0])
        return (ReleaseLoad("measured", record.amplitude, record.force - level, record.start_s),)
    if release is not None:
        return (ReleaseLoad(release, record.amplitude),)
    return tuple(ReleaseLoad(shape, record.amplitude) for shape in ("ramp", "smooth"))


# Simultaneous identification of order and parameters, as published.


def fit_sim(
    record: StepRecord,
    channel: str,
    *,
    reading: ReleaseReading | None = None,
    order: int | None = None,
    conversion: Conversion = "tustin",
) -> StepFit:
    """Fit order and parameters of a difference equation simultaneously; return it as a continuous model.

    `order`: number of poles, by the bend of the loss over order 1 … 9 if None. `conversion` to continuous time:
    "tustin" as in the published model of 100 kHz samples, or "zoh", exact for a load that is constant between samples.
    `system.sampled(sample_rate_hz, conversion)` is the difference equation. The result has no covariance. Output noise
    biases the least squares of the equation error, increasingly with the sampling rate: at 100 kHz and 40 dB the
    damping of a mode of ζ = 0.015 is several times too large.
    """
    began = time.perf_counter()
    reading = reading or read_release(record, channel)
    signals = load_and_output(record, reading)
    orders = fit_all_orders(*signals, record.sample_rate_hz)
    direct = conversion == "tustin"
    chosen = order or orders.bend(direct)
    fit = difference_fit(record, reading, orders.system(chosen, direct), conversion, signals, orders.loss(direct))
    return replace(fit, method="sim" if direct else "sim_zoh", order=chosen, duration_s=time.perf_counter() - began)


def difference_fit(
    record: StepRecord,
    reading: ReleaseReading,
    sampled: LinearSystem,
    conversion: Conversion,
    signals: tuple[FloatArray, FloatArray],
    convergence: FloatArray,
) -> StepFit:
    """Return the fit of a difference equation to the signals of `load_and_output`."""
    from scipy.signal import sosfilt

    (load, output), where = signals, f"{record.name}, {reading.channel}"
    system, notices = sampled, tuple[Notice, ...]()
    try:
        system = sampled.continuous(conversion)
    except ValueError as error:
        notices = (Notice(NO_CONTINUOUS_MODEL, where, reason=str(error)),)
    notices += pole_notices(system, record.sample_rate_hz)
    with np.errstate(over="ignore", invalid="ignore"):
        fitted = np.asarray(sosfilt(sampled.sections(), load))
    if not np.all(np.isfinite(fitted)):
        notices += (Notice(OUTPUT_DIVERGES, where),)
        fitted = np.full_like(output, output.mean())
    with np.errstate(over="ignore"):
        accounted = 1.0 - float(np.sum((output - fitted) ** 2) / np.sum((output - output.mean()) ** 2))
    return StepFit(
        method="evolution_coefficients",
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=modal_form(system),
        system=system,
        time_s=record.time_s,
        fitted=fitted + reading.baseline,
        residual=output - fitted,
        sample_rate_hz=record.sample_rate_hz,
        decimation=1,
        order=len(sampled.poles),
        variance_accounted=accounted,
        convergence=convergence,
        duration_s=0.0,
        onset_s=reading.onset_s,
        u_onset_s=reading.u_onset_s,
        release_s=0.0,
        u_release_s=0.0,
        notices=notices,
    )


def load_and_output(record: StepRecord, reading: ReleaseReading) -> tuple[FloatArray, FloatArray]:
    """Return load (N,), a step unless measured, and output (N,) above its baseline."""
    value = record.samples[record.channels.index(reading.channel)] - reading.baseline
    load = record.amplitude * (record.time_s >= reading.onset_s) if record.force is None else record.force
    if record.force is not None:
        load = load - np.mean(load[record.time_s < reading.onset_s])
    return np.asarray(load), value


def modal_form(system: LinearSystem) -> ModalModel | None:
    """Return a continuous system as a sum of modes, None if impossible."""
    if system.sample_rate_hz is not None or len(system.zeros) == len(system.poles):
        return None
    gaps = np.abs(system.poles[:, None] - system.poles) + np.diag(np.full(len(system.poles), np.inf))
    if np.min(gaps, initial=np.inf) < 1e-6 * np.max(np.abs(system.poles)) or np.any(system.poles == 0):
        return None
    residues = system.residues()
    upper, real = system.poles.imag > 0, system.poles.imag == 0
    omega = np.abs(system.poles[upper])
    return ModalModel(
        omega / (2 * np.pi),
        -system.poles[upper].real / omega,
        residues[upper],
        -system.poles[real].real / (2 * np.pi),
        residues[real].real,
    )


# Differential evolution (rand/1/bin; Storn and Price, J. Global Optim. 11 (1997) 341): with the published settings, and
# on modal parameters.

MUTATION, CROSSOVER = 0.8, 0.7  # the published settings
HUGE = 1e100  # loss above which a model has grown without bound

Losses = Callable[[FloatArray, FloatArray], FloatArray]
"""Function from members (P, N) and their largest losses (P,) to losses (P,), infinite above the largest."""
POPULATION, GENERATIONS, BOUND = 100, 500, 5.0  # the published settings
_ORDER = 3  # poles of a fit: a mode and a real pole
_FEWER = (30, 40)  # members and generations for three bounded parameters
_DAMPING = (1e-4, 0.5)
_BLOCKS = 1000  # blocks of the record in the evolution


def evolve(
    losses: Losses, bounds: Sequence[tuple[float, float]], rng: np.random.Generator, effort: tuple[int, int]
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the best vector (N,) and losses of `effort` = (members, generations)."""
    from scipy.optimize import differential_evolution

    low, high = np.array(bounds).T
    first = low + (high - low) * rng.random((effort[0], len(bounds)))
    path, parents = list[float](), np.full(effort[0], np.inf)

    def keep(intermediate_result: Any) -> None:
        path.append(float(intermediate_result.fun))
        parents[:] = intermediate_result.population_energies

    end = differential_evolution(
        lambda members: losses(np.ascontiguousarray(members.T), parents),
        bounds,
        strategy="rand1bin",
        maxiter=effort[1],
        init=first,
        tol=0.0,
        mutation=MUTATION,
        recombination=CROSSOVER,
        rng=rng,
        callback=keep,
        polish=False,
        updating="deferred",
        vectorized=True,
    )
    return np.asarray(end.x), tuple(path)


def fit_evolution(
    record: StepRecord,
    channel: str,
    *,
    rng: np.random.Generator,
    reading: ReleaseReading | None = None,
    parametrisation: Literal["coefficients", "modes"] = "modes",
) -> StepFit:
    """Fit a model of one output by differential evolution (rand/1/bin, mutation 0.8, crossover 0.7).

    "coefficients": as published, [b_n, a_n, …, b_1, a_1] of H(z) = Σ b z⁻ⁱ/(1 + Σ a z⁻ⁱ) within ±5, population 100, 500
    generations. The loss is the squared output error; `convergence` is that of the best member over the generations.
    "modes": fn, ζ and a real pole, the numerator by linear least squares. The default
    method then continues from the best member and gives the covariance.
    """
    began = time.perf_counter()
    reading = reading or read_release(record, channel)
    if parametrisation == "coefficients":
        return _published(record, reading, rng, began)
    value = record.samples[record.channels.index(channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    margin, onset_s = reading.rise_s + reading.release_s, reading.onset_s
    samples = reduce_to_blocks(whole, onset_s - margin, onset_s + 2.0 * margin, max(1, len(value) // _BLOCKS))
    structure, blank = PoleStructure(1, 1, _ORDER, 1.0 / reading.rise_s), np.zeros(_ORDER + 1)
    problem = OutputErrorProblem(structure, ReleaseLoad("step", record.amplitude), samples, blank, blank, onset_s)
    span_s, block_s = samples.time_s[-1] - samples.time_s[0], samples.step_s * samples.length.max()
    slow, fast, edge = np.log(2 * np.pi * np.array([2.0 / span_s, 0.1 / block_s, 0.4 / samples.step_s])).tolist()
    # ln ω from two periods in the record to a tenth of the blocks' rate, ζ, ln a up to 0.4 of the samples' rate
    bounds = [(slow, fast), _DAMPING, (slow, edge)]

    def losses(members: FloatArray, _: FloatArray) -> FloatArray:
        vectors = np.insert(members, _ORDER, onset_s, axis=1)  # groups that fit the cache of the processor
        return np.concatenate([squares(problem, part)[:, -1] for part in np.array_split(vectors, _FEWER[0] // 10)])

    best, path = evolve(losses, bounds, rng, _FEWER)
    hz = float(np.exp(best[0])) / (2 * np.pi)
    start = np.append(best, onset_s)
    plain = replace(problem, structure=replace(structure, terms=1, scale=2 * np.pi * hz))
    solution = add_numerator_terms(solve(*with_loose_prior(plain, start, hz)), [start] * _ORDER, hz)
    return as_step_fit(record, reading, replace(solution, path=path), "evolution", began)


def _published(record: StepRecord, reading: ReleaseReading, rng: np.random.Generator, began: float) -> StepFit:
    """Return the model by the published method, in coefficients of the difference equation."""
    signals = load_and_output(record, reading)
    begin = int(np.argmax(signals[0] != 0.0))  # no model responds before it
    load, output = signals[0][begin:], signals[1][begin:]
    before = float(np.sum(signals[1][:begin] ** 2))
    bounds = [(-BOUND, BOUND)] * (2 * _ORDER)
    best, path = evolve(
        lambda members, most: output_errors(members, most, load, output, before), bounds, rng, (POPULATION, GENERATIONS)
    )
    top, bottom = np.append(0.0, best[-2::-2]), np.append(1.0, best[::-2])
    sampled = LinearSystem.from_coefficients(top, bottom, record.sample_rate_hz)
    fit = difference_fit(record, reading, sampled, "zoh", signals, np.array(path))
    return replace(fit, duration_s=time.perf_counter() - began)


@njit()
def output_errors(
    members: FloatArray, most: FloatArray, load: FloatArray, output: FloatArray, before: float
) -> FloatArray:
    """Return the squared output errors (P,) of difference equations, infinite above a limit.

    `members` (P, 2n): [b_n, a_n, …, b_1, a_1] each, of H(z) = Σ b z⁻ⁱ/(1 + Σ a z⁻ⁱ). A simulation stops at its limit
    `most` (P,), at most 1e100. `before`: squares of the output before the start of `load` (N,) and `output` (N,).
    """
    count, order = members.shape[0], members.shape[1] // 2
    found = np.full(count, np.inf)
    state = np.empty(order + 1)
    for p in range(count):
        state[:] = 0.0
        square, limit = before, min(most[p], HUGE)
        for k in range(len(load)):
            x, y = load[k], state[0]
            for i in range(order):
                column = 2 * (order - 1 - i)
                state[i] = state[i + 1] + x * members[p, column] - y * members[p, column + 1]
            square += (output[k] - y) ** 2
            if not square <= limit:
                break
        if square <= limit:
            found[p] = square
    return found


# Every method on the same record.

METHODS: tuple[Method, ...] = ("pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients")


def fit_all_methods(
    record: StepRecord,
    channel: str,
    *,
    rng: np.random.Generator,
    reading: ReleaseReading | None = None,
    methods: Sequence[Method] = METHODS,
    modes: int | None = None,
    real_poles: int | None = None,
) -> tuple[StepFit, ...]:
    """Return the fits of one output by several methods, in the order of `methods`.

    All use one reading of the release. `modes` and `real_poles` apply to the two methods with these options; the
    published ones select their order themselves or use three poles. `rng` samples the first generation.
    """
    reading = reading or read_release(record, channel)

    def fitted(method: Method) -> StepFit:
        if method in ("pencil", "arx"):
            start: Literal["pencil", "arx"] = "arx" if method == "arx" else "pencil"
            return fit_step(record, channel, reading=reading, modes=modes, real_poles=real_poles, method=start)
        if method in ("sim", "sim_zoh"):
            return fit_sim(record, channel, reading=reading, conversion="tustin" if method == "sim" else "zoh")
        parametrisation: Literal["modes", "coefficients"] = "modes" if method == "evolution" else "coefficients"
        return fit_evolution(record, channel, rng=rng, reading=reading, parametrisation=parametrisation)

    return tuple(map(fitted, methods))
