"""Models of a step response, by output error and by differential evolution, side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from shaker.arrays import FloatArray
from shaker.lti.system import LinearSystem
from shaker.release.order import Found, Search, known_about, more_terms, remarks, searched
from shaker.release.output_error import Problem, Structure, modal_model, solve, spread, squares
from shaker.release.reading import read_release
from shaker.release.record import Reading, StepRecord
from shaker.release.response import Load, every_sample, in_blocks
from shaker.release.sim import Method, StepFit, constructed, difference_fit, fit_sim

# A solution as what an identification returns.


def outcome(
    record: StepRecord,
    reading: Reading,
    found: Found,
    method: Method,
    began: float,
) -> StepFit:
    """Return what was found with its covariance from every sample; `began`: when the identification did."""
    solution = found.solution
    value = record.samples[record.channels.index(reading.channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    known = spread(solution, whole)
    model = modal_model(solution, known.covariance, record.u_amplitude)
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
        fitted=known.fitted,
        residual=known.residual,
        sample_rate_hz=record.sample_rate_hz / decimation,
        decimation=decimation,
        order=solution.problem.structure.order,
        variance_accounted=1.0 - float(np.sum(known.residual**2) / np.sum((value - value.mean()) ** 2)),
        convergence=np.array(found.path),
        duration_s=time.perf_counter() - began,
        onset_s=middle - 0.5 * length if timed else reading.onset_s,
        u_onset_s=known.u_onset_s if timed else reading.u_onset_s,
        release_s=length,
        u_release_s=known.u_release_s,
        shape=solution.problem.load.shape,
        notices=remarks(record, reading, found, model, known),
    )


# A model of a sensor from the record of one release.


Release = Literal["step", "ramp", "smooth", "measured"]


def fit_step(
    record: StepRecord,
    channel: str,
    *,
    reading: Reading | None = None,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: Release | None = None,
) -> StepFit:
    """Return the model of one output with covariance, by output-error least squares.

    `reading`: what `read_release` says of this channel, read here where it is None; `modes`, `real_poles`: numbers of
    oscillating modes and of real poles, chosen by rule where None; `release`: how the load goes, "measured" with a
    measured force and else chosen by rule where None; `method`: what the start comes from. The covariance holds the
    record's noise, coloured or not, the baseline, the release and the load's amplitude.

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
    began = time.perf_counter()
    found = reading or read_release(record, channel)
    whole = every_sample(record.samples[record.channels.index(channel)], record.time_s, 1.0 / record.sample_rate_hz)
    search = Search(whole, found, loads(record, found, release), method, modes, real_poles)
    return outcome(record, found, searched(search), method, began)


def loads(record: StepRecord, reading: Reading, release: Release | None) -> tuple[Load, ...]:
    """Return the loads that come into question, the likeliest first."""
    if release == "measured" or (release is None and record.force is not None):
        if record.force is None:
            raise ValueError(
                'release: expected "step", "ramp" or "smooth" for a record without force, found "measured"'
            )
        rest = record.time_s < reading.onset_s - 3.0 * reading.u_onset_s
        level = float(np.mean(record.force[rest])) if np.any(rest) else float(record.force[0])
        return (Load("measured", record.amplitude, record.force - level, record.start_s),)
    if release is not None:
        return (Load(release, record.amplitude),)
    return tuple(Load(shape, record.amplitude) for shape in ("ramp", "smooth"))


# Differential evolution: with the published settings, and on parameters that suit the problem.


MUTATION, CROSSOVER, POPULATION, GENERATIONS, BOUND = 0.8, 0.7, 100, 500, 5.0
"""The published settings."""
_FEWER = (30, 40)  # members and generations that three bounded parameters take
_DAMPING = (1e-4, 0.5)
_HUGE = 1e100  # loss from which a member counts as grown without bound
_BLOCKS = 1000  # blocks of the record that the evolution looks at


def fit_evolution(
    record: StepRecord,
    channel: str,
    *,
    rng: np.random.Generator,
    reading: Reading | None = None,
    parametrisation: Literal["coefficients", "modes"] = "modes",
    order: int = 3,
) -> StepFit:
    """Return the model of one output by differential evolution (rand/1/bin, mutation 0.8, crossover 0.7).

    "coefficients": as published, [b_n, a_n, …, b_1, a_1] of H(z) = Σ b z⁻ⁱ/(1 + Σ a z⁻ⁱ) within ±5, population 100, 500
    generations, loss the squared output error; `convergence` is the best member's over the generations. "modes": fn, ζ
    and a real pole for order 3 (fn, ζ for order 2), the numerator by linear least squares, then the default method's
    output-error steps from the best member, which bring the covariance.
    """
    began = time.perf_counter()
    found = reading or read_release(record, channel)
    if parametrisation == "coefficients":
        return _published(record, found, rng, order, began)
    if order not in (2, 3):
        raise ValueError(f"order: expected 2 or 3 for modes, found {order}")
    problem = _problem(record, found, order - 2)
    samples = problem.samples
    slow, fast, edge = (
        float(np.log(2 * np.pi * hz))
        for hz in (
            2.0 / (samples.time_s[-1] - samples.time_s[0]),
            0.1 / (samples.step_s * samples.length.max()),
            0.4 / samples.step_s,
        )
    )
    # ln ω from two periods in the record to a tenth of the blocks' rate, ζ, ln a up to 0.4 of the samples' rate
    bounds = [(slow, fast), _DAMPING, *[(slow, edge)] * problem.structure.reals]

    def loss(part: FloatArray) -> float:
        return float(squares(problem, np.append(part, found.onset_s))[-1])

    best, path = _evolved(loss, bounds, rng, _FEWER)
    hz = float(np.exp(best[0])) / (2 * np.pi)
    start = np.append(best, found.onset_s)
    plain = replace(problem, structure=replace(problem.structure, terms=1, scale=2 * np.pi * hz))
    solution = more_terms(solve(*known_about(plain, start, hz)), [start] * order, hz)
    return outcome(record, found, Found(solution, path), "evolution", began)


def _problem(record: StepRecord, reading: Reading, reals: int) -> Problem:
    """Return the problem on blocks of the record, single samples about the release: one mode, numerator free."""
    value = record.samples[record.channels.index(reading.channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    margin = reading.rise_s + reading.release_s
    length = max(1, len(value) // _BLOCKS)
    samples = in_blocks(whole, reading.onset_s - margin, reading.onset_s + 2.0 * margin, length)
    structure = Structure(1, reals, 2 + reals, 1.0 / reading.rise_s)
    blank = np.zeros(structure.order + 1)
    return Problem(structure, Load("step", record.amplitude), samples, blank, blank, reading.onset_s)


def _published(record: StepRecord, reading: Reading, rng: np.random.Generator, order: int, began: float) -> StepFit:
    """Return the model found as published, in coefficients of the difference equation."""
    from scipy.signal import lfilter

    load, output, _ = signals = constructed(record, reading, 1)

    def loss(part: FloatArray) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            rest = output - lfilter(np.append(0.0, part[-2::-2]), np.append(1.0, part[::-2]), load)
            square = float(rest @ rest)
        return square if square < _HUGE else np.inf

    bounds = [(-BOUND, BOUND)] * (2 * order)
    best, path = _evolved(loss, bounds, rng, (POPULATION, GENERATIONS))
    sampled = LinearSystem.from_coefficients(
        np.append(0.0, best[-2::-2]), np.append(1.0, best[::-2]), record.sample_rate_hz
    )
    fit = difference_fit(record, reading, sampled, "zoh", signals, np.array(path))
    return replace(fit, order=order, duration_s=time.perf_counter() - began)


def _evolved(
    loss: Callable[[FloatArray], float],
    bounds: list[tuple[float, float]],
    rng: np.random.Generator,
    effort: tuple[int, int],
) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the best vector and the best loss of every generation; `effort`: members and generations."""
    from scipy.optimize import differential_evolution

    low, high = np.array(bounds).T
    first = low + (high - low) * rng.random((effort[0], len(bounds)))
    path: list[float] = []

    def keep(intermediate_result: Any) -> None:
        path.append(float(intermediate_result.fun))

    found = differential_evolution(
        loss,
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
    )
    return np.asarray(found.x), tuple(path)


# Every method on the same record.


METHODS: tuple[Method, ...] = ("pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients")


def compare(
    record: StepRecord,
    channel: str,
    *,
    rng: np.random.Generator,
    reading: Reading | None = None,
    methods: Sequence[Method] = METHODS,
    modes: int | None = None,
    real_poles: int | None = None,
) -> tuple[StepFit, ...]:
    """Return the fits of one output by several methods, in the order of `methods`.

    All share one reading of the release. `modes` and `real_poles` are those of the two methods that take them; the
    published ones choose their order themselves or keep the published three poles. `rng` draws the first generation.
    """
    found = reading or read_release(record, channel)

    default = partial(fit_step, record, channel, reading=found, modes=modes, real_poles=real_poles)
    by: dict[Method, Callable[[], StepFit]] = {
        "pencil": lambda: default(method="pencil"),
        "arx": lambda: default(method="arx"),
        "sim": lambda: fit_sim(record, channel, reading=found, conversion="tustin"),
        "sim_zoh": lambda: fit_sim(record, channel, reading=found, conversion="zoh"),
        "evolution": lambda: fit_evolution(record, channel, reading=found, rng=rng),
        "evolution_coefficients": lambda: fit_evolution(
            record, channel, reading=found, rng=rng, parametrisation="coefficients"
        ),
    }
    return tuple(by[method]() for method in methods)
