"""All recordings in one complex least-squares fit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from shaker._checks import FloatArray
from shaker.models.identification.mechanics import Structure, poles
from shaker.models.identification.problem import DELAY_UNIT_S, Problem, build, factor_name
from shaker.models.identification.remarks import remarks
from shaker.models.identification.result import FreeFactor, Identification, ModeEstimate, NamedUnknown
from shaker.models.identification.solve import Spread, State, effective, evaluate, rescaled, solve, spread
from shaker.models.identification.start import starting_vectors
from shaker.models.measured import MeasuredTransfer, ParameterEstimate
from shaker.models.resonance.line_noise import CurveResidual, SeenNoise, seen_noise

_EXPLAINED = 4.0  # χ² per line below which no other start is tried
_NOISE_ROUNDS = 4


def identify(
    records: Sequence[MeasuredTransfer],
    structure: Structure,
    *,
    known: Mapping[str, tuple[float, float]] | None = None,
    each_recording: Collection[str] = (),
    gain: Collection[str] = (),
    delay: Collection[str] = (),
) -> Identification:
    """Fit a structure's parameters to all lines of all recordings together.

    Measured is H(s) · exp(Σ z r): r are the relative errors by name, z ~ N(0, 1) unknown, equal names one unknown, as
    are numbers of the load, places and directions of transducers, and the rate of the clock. `known`: (value, u) of
    parameters stated beforehand, u = 0 fixed. `each_recording`: parameters that have a value of their own in every
    recording. `gain`, `delay`: channels whose complex gain, or delay, is free in every recording, the scale being
    unstated.
    """
    problem = build(records, structure, known or {}, each_recording, gain, delay)
    lines = sum(2 * record.ratio.value.size for record in records)
    if lines <= np.count_nonzero((problem.precision == 0.0) & ~problem.fixed):
        raise ValueError(f"records: expected more real values than unknowns, found {lines} for {len(problem.names)}")
    state = _best(problem, starting_vectors(problem, structure.starts(records)), lines)
    weighted, state, noise = _weighed(problem, state)
    return _result(weighted, state, spread(weighted, state), noise)


def _best(problem: Problem, vectors: Sequence[FloatArray], lines: int) -> State:
    """Return the first solution that explains the curves, from the most promising start on, else the best of all."""
    tried: list[State] = []
    for start in sorted((evaluate(problem, vector) for vector in vectors), key=lambda state: state.cost):
        tried.append(solve(problem, start))
        if tried[-1].cost < _EXPLAINED * lines:
            break
    return min(tried, key=lambda state: state.cost)


def _seen(problem: Problem, state: State, before: Sequence[FloatArray]) -> SeenNoise:
    """Return the noise seen at a `state`, whose residuals are whitened with the factors `before`."""
    curves = [
        CurveResidual(np.sum(residual**2, axis=1) * factor, curve.record.ratio.dof, residual.shape[1])
        for curve, residual, factor in zip(problem.curves, state.residuals, before, strict=True)
    ]
    return seen_noise(curves, effective(problem, state))


def _weighed(problem: Problem, state: State) -> tuple[Problem, State, SeenNoise]:
    """Return the problem with its lines weighed by the noise seen in them, its solution, and that noise."""
    factors: tuple[FloatArray, ...] = tuple(np.ones(len(curve.whitening)) for curve in problem.curves)
    noise, weighted = _seen(problem, state, factors), problem
    for _ in range(_NOISE_ROUNDS):
        scale = [np.sqrt(old / new) for old, new in zip(factors, noise.lines, strict=True)]
        factors, before = noise.lines, state.vector
        weighted = problem.weighed(factors)
        state = solve(weighted, rescaled(weighted, state, scale))
        noise = _seen(weighted, state, factors)
        if np.array_equal(before, state.vector):
            break
    return weighted, state, noise


def _result(problem: Problem, state: State, found: Spread, noise: SeenNoise) -> Identification:
    """Return what a solution says."""
    count = len(problem.kind)
    estimates = _estimates(problem, state, found)
    model = tuple(curve.modelled(state.vector)[0] for curve in problem.curves)
    unknowns = tuple(
        NamedUnknown(
            name.removeprefix("error: "), float(state.vector[place]), found.u(np.eye(len(problem.names))[place])
        )
        for place, name in enumerate(problem.names)
        if name.startswith("error: ") and place >= count
    )
    return Identification(
        estimates=estimates,
        covariance=found.covariance_of(np.eye(count, len(problem.names))),
        derived=_lags(problem, state, found),
        modes=_modes(problem, state, found),
        unknowns=unknowns,
        factors=_factors(problem, state, found),
        model=model,
        residual=tuple(curve.record.ratio.value - value for curve, value in zip(problem.curves, model, strict=True)),
        chi_squared=noise.chi_squared,
        dof=noise.dof,
        notices=remarks(problem, state, found, estimates, noise),
        budget=_budget(problem, found),
    )


def _budget(problem: Problem, found: Spread) -> dict[str, FloatArray]:
    """Return what every cause changes of the parameters."""
    count = len(problem.kind)
    causes: dict[str, FloatArray] = {}
    for place, name in enumerate(problem.names):
        if problem.precision[place] > 0.0:
            words = name.removeprefix("error: ") if place >= count else f"{name} as stated"
            causes[words] = found.prior[:count, place]
    known = np.sum([np.zeros(count), *(change**2 for change in causes.values())], axis=0)
    left = found.covariance.diagonal()[:count] - known
    return {"noise": np.sqrt(np.maximum(left, 0.0)), **causes}


def _estimates(problem: Problem, state: State, found: Spread) -> tuple[ParameterEstimate, ...]:
    """Return the parameters with their uncertainties."""
    unit = np.eye(len(problem.names))
    return tuple(
        ParameterEstimate(p.name, p.label, float(state.vector[place]), found.u(unit[place]), p.unit)
        for place, p in enumerate(problem.parameters)
    )


def _lags(problem: Problem, state: State, found: Spread) -> tuple[ParameterEstimate, ...]:
    """Return b/k of every damper with its spring: what S(f) of the sensor would show."""
    places = {parameter.name: place for place, parameter in enumerate(problem.parameters)}
    derived = []
    for name, place in places.items():
        spring = name.replace("damping_", "stiffness_", 1)
        shared = places.get(spring, places.get(spring.partition(":")[0]))
        if not name.startswith("damping_") or shared is None:
            continue
        ending, b, k = name.removeprefix("damping_"), state.vector[place], state.vector[shared]
        gradient = np.zeros(len(state.vector))
        gradient[place], gradient[shared] = 1.0 / k, -b / k**2
        derived.append(ParameterEstimate(f"lag_{ending}", f"b/k, {ending}", float(b / k), found.u(gradient), "s"))
    return tuple(derived)


def _modes(problem: Problem, state: State, found: Spread) -> tuple[ModeEstimate, ...]:
    """Return the modes of every recording, from the poles of its fitted mechanics."""
    modes = []
    for curve in problem.curves:
        roots, by_term = poles(curve.mechanics, curve.weights(state.vector))
        for number, (root, change) in enumerate(zip(roots, by_term, strict=True)):
            by_unknown = np.zeros(len(state.vector), dtype=np.complex128)
            np.add.at(by_unknown, curve.terms, change)
            size = abs(root)
            by_size = (by_unknown * root.conj()).real / size
            by_ratio = -by_unknown.real / size + root.real / size**2 * by_size
            u_frequency, u_ratio = found.u(by_size / (2.0 * np.pi)), found.u(by_ratio)
            ratio = float(-root.real / size)
            modes.append(
                ModeEstimate(curve.record.name, number, float(size / (2.0 * np.pi)), u_frequency, ratio, u_ratio)
            )
    return tuple(modes)


def _factors(problem: Problem, state: State, found: Spread) -> tuple[FreeFactor, ...]:
    """Return the gains and delays that were free."""
    places = {name: place for place, name in enumerate(problem.names)}

    def of(name: str) -> tuple[float, float]:
        place = places.get(name)
        if place is None:
            return 0.0, 0.0
        gradient: FloatArray = np.eye(len(problem.names))[place]
        return float(state.vector[place]), found.u(gradient)

    factors = []
    for curve in problem.curves:
        for channel in curve.record.ratio.channels:
            size, phase, delay = (
                of(factor_name(kind, curve.record, channel)) for kind in ("ln gain", "gain phase", "delay")
            )
            if size[1] > 0.0 or delay[1] > 0.0:
                gain = complex(np.exp(complex(size[0], phase[0])))
                factors.append(
                    FreeFactor(
                        curve.record.name,
                        channel,
                        gain,
                        size[1],
                        phase[1],
                        delay[0] * DELAY_UNIT_S,
                        delay[1] * DELAY_UNIT_S,
                    )
                )
    return tuple(factors)
