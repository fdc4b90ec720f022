"""Differential evolution: with the published settings, and on parameters that suit the problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.remarks import remarks
from shaker.models.linear_system import LinearSystem
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.order import Found, more_terms
from shaker.models.step_fit.outcome import outcome
from shaker.models.step_fit.output_error import Problem, solve, squares
from shaker.models.step_fit.result import StepFit
from shaker.models.step_fit.samples import every_sample, in_blocks
from shaker.models.step_fit.sim import accounted, constructed, modal_form, simulated
from shaker.models.step_fit.structure import Structure
from shaker.models.step_fit.timing import known_about
from shaker.notice import Notice

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

    def loss(part: FloatArray) -> float:
        return float(squares(problem, np.append(part, found.onset_s))[-1])

    best, path = _evolved(loss, _bounds(problem), rng, _FEWER)
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


def _bounds(problem: Problem) -> list[tuple[float, float]]:
    """Return bounds of ln ω, ζ and ln a: from two periods in the record to a tenth of the blocks' rate, 0.4 of the
    samples' for a real pole."""
    samples = problem.samples
    slow, fast, edge = (
        float(np.log(2 * np.pi * hz))
        for hz in (
            2.0 / (samples.time_s[-1] - samples.time_s[0]),
            0.1 / (samples.step_s * samples.length.max()),
            0.4 / samples.step_s,
        )
    )
    return [(slow, fast), _DAMPING, *[(slow, edge)] * problem.structure.reals]


def _published(record: StepRecord, reading: Reading, rng: np.random.Generator, order: int, began: float) -> StepFit:
    """Return the model found as published, in coefficients of the difference equation."""
    from scipy.signal import lfilter

    load, output, time_s = constructed(record, reading, 1)

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
    notices: tuple[Notice, ...] = ()
    try:
        system = sampled.continuous("zoh")
    except ValueError as error:
        system = sampled
        notices = (Notice("warning", f"no continuous model: {error}", f"{record.name}, {reading.channel}"),)
    fitted = simulated(sampled, load)
    return StepFit(
        method="evolution_coefficients",
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=modal_form(system),
        system=system,
        time_s=time_s,
        fitted=fitted + reading.baseline,
        residual=output - fitted,
        sample_rate_hz=record.sample_rate_hz,
        decimation=1,
        order=order,
        variance_accounted=accounted(output, fitted),
        convergence=np.array(path),
        duration_s=time.perf_counter() - began,
        onset_s=reading.onset_s,
        u_onset_s=reading.u_onset_s,
        release_s=0.0,
        u_release_s=0.0,
        notices=notices + remarks(system, record.sample_rate_hz),
    )


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
