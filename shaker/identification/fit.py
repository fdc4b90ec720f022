"""Parameters of a linear structure from all recordings in one fit, every named error an unknown."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.identification.measured import MeasuredTransfer, ParameterEstimate
from shaker.identification.model import (
    FreeFactor,
    Identification,
    ModeEstimate,
    NamedUnknown,
    Structure,
    poles,
)
from shaker.identification.oscillator import CurveResidual, SeenNoise, seen_noise
from shaker.identification.problem import DELAY_UNIT_S, Curve, Problem, build, factor_name, starting_vectors

# Levenberg-Marquardt over all recordings, and the covariance of what it finds.


_STEPS = 100
_SMALL_STEP = 1e-3  # length of a step in standard uncertainties at which a fit has converged
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e-12, 1e8
_FREE_DAMPING = 1e-5  # below it a small step is small because little is left to gain
_SHARE = 0.1  # of a step, over which the curvature of the residuals is seen
_MOST_BENT = 0.75  # length of the bend in that of the step
_OPEN = 1e-10  # singular value, columns of unit length, below which a direction is open


@dataclass(frozen=True)
class State:
    """Unknowns (N,) with the whitened residuals (K, 2C) and derivatives (K, 2C, L) of every curve by its own unknowns.

    `normal` (N, N) = Σ JᵀJ and `gradient` (N,) = Σ Jᵀr of the lines, `chi_squared` of the lines, `prior` that of what
    was known beforehand.
    """

    vector: FloatArray
    residuals: tuple[FloatArray, ...]
    jacobians: tuple[FloatArray, ...]
    normal: FloatArray
    gradient: FloatArray
    chi_squared: float
    prior: float

    @property
    def cost(self) -> float:
        """What is minimised: χ² of lines and priors together."""
        return self.chi_squared + self.prior


def evaluate(problem: Problem, vector: FloatArray) -> State:
    """Return residuals and derivatives at a vector of unknowns."""
    whitened = []
    for curve in problem.curves:
        value, by_place = curve.modelled(vector)
        deviation = (curve.record.ratio.value - value)[:, :, None]
        whitened.append(curve.whitened(np.concatenate([deviation, by_place], axis=2)))
    return _state(problem, vector, whitened)


def rescaled(problem: Problem, state: State, factors: Sequence[FloatArray]) -> State:
    """Return a state with residuals and derivatives times `factors` (K,) per recording."""
    whitened = [
        np.concatenate([residual[:, :, None], jacobian], axis=2) * factor[:, None, None]
        for residual, jacobian, factor in zip(state.residuals, state.jacobians, factors, strict=True)
    ]
    return _state(problem, state.vector, whitened)


def _state(problem: Problem, vector: FloatArray, whitened: Sequence[FloatArray]) -> State:
    """Return the state of residuals and derivatives (K, 2C, 1+L) of every curve."""
    count = len(vector)
    normal, gradient, chi_squared = np.zeros((count, count)), np.zeros(count), 0.0
    for curve, both in zip(problem.curves, whitened, strict=True):
        flat = both.reshape(-1, both.shape[2])
        product = flat.T @ flat
        places = curve.places
        np.add.at(normal, (places[:, None], places), product[1:, 1:])
        np.add.at(gradient, places, product[1:, 0])
        chi_squared += float(product[0, 0])
    normal[problem.fixed] = 0.0
    normal[:, problem.fixed] = 0.0
    gradient[problem.fixed] = 0.0
    return State(
        vector=vector,
        residuals=tuple(both[:, :, 0] for both in whitened),
        jacobians=tuple(both[:, :, 1:] for both in whitened),
        normal=normal,
        gradient=gradient,
        chi_squared=chi_squared,
        prior=float(np.sum(problem.precision * (problem.expected - vector) ** 2)),
    )


def solve(problem: Problem, state: State) -> State:
    """Return the unknowns of least χ² of lines and priors, from a state on, damped after Marquardt (J. SIAM 11, 1963).

    After a step that was refused the next ones are bent, so that they follow a curved valley (`_bent`). What is reached
    after many steps is returned also where more would be needed.
    """
    damping = _FIRST_DAMPING
    for _ in range(_STEPS):
        normal = state.normal + np.diag(problem.precision)
        gradient = state.gradient + problem.precision * (problem.expected - state.vector)
        scale = np.sqrt(np.maximum(normal.diagonal(), np.finfo(np.float64).tiny))
        unit = normal / np.multiply.outer(scale, scale)
        refused = False
        while True:
            damped = unit + damping * np.eye(len(scale))
            step = np.linalg.solve(damped, gradient / scale) / scale
            if damping < _FREE_DAMPING and step @ normal @ step < _SMALL_STEP**2:
                return state
            taken = _bent(problem, state, step, damped, scale) if refused else step
            new = _tried(problem, state.vector + taken) if taken is not None else None
            if new is not None and new.cost <= state.cost * (1.0 + 1e-12):
                break
            damping, refused = 10.0 * damping, True
            if damping > _LARGEST_DAMPING:
                return state
        state, damping = new, max(_LEAST_DAMPING, 0.03 * damping)
    return state


def _bent(problem: Problem, state: State, step: FloatArray, damped: FloatArray, scale: FloatArray) -> FloatArray | None:
    """Return a step with its geodesic acceleration (Transtrum and Sethna, arXiv:1201.5885), None where that rules it.

    The residuals' second derivative along the step is that of a difference over a tenth of it.
    """
    ahead = _tried(problem, state.vector + _SHARE * step)
    if ahead is None:
        return None
    curvature = np.zeros(len(step))
    for curve, here, jacobian, there in zip(
        problem.curves, state.residuals, state.jacobians, ahead.residuals, strict=True
    ):
        second = (there - here + _SHARE * (jacobian @ step[curve.places])) * (2.0 / _SHARE**2)
        np.add.at(curvature, curve.places, np.tensordot(second, jacobian, 2))
    curvature[problem.fixed] = 0.0
    bend = 0.5 * np.linalg.solve(damped, curvature / scale) / scale
    if np.linalg.norm(bend * scale) > _MOST_BENT * np.linalg.norm(step * scale):
        return None
    return np.asarray(step + bend)


def _tried(problem: Problem, vector: FloatArray) -> State | None:
    """Return the state at a vector, None where a mass or a stiffness would not be positive."""
    for curve in problem.curves:
        (mass, _, stiffness), _ = curve.mechanics.at(curve.weights(vector))
        if min(mass[0, 0], stiffness[0, 0]) <= 0.0:
            return None
        if len(mass) > 1 and min(np.linalg.eigvalsh(mass)[0], np.linalg.eigvalsh(stiffness)[0]) <= 0.0:
            return None
    state = evaluate(problem, vector)
    return state if np.isfinite(state.chi_squared) else None


def effective(problem: Problem, state: State) -> float:
    """Return the number of unknowns that the lines determine: the trace of (JᵀJ + P)⁻¹ JᵀJ."""
    whole = state.normal + np.diag(problem.precision)
    scale = np.sqrt(np.maximum(whole.diagonal(), np.finfo(np.float64).tiny))
    pair = np.multiply.outer(scale, scale)
    return float(np.trace(np.linalg.lstsq(whole / pair, state.normal / pair, rcond=1e-12)[0]))


@dataclass(frozen=True)
class Spread:
    """Covariance of all unknowns, and the directions that the recordings leave open.

    `covariance` (N, N) of the determined part, `opened` (Z, N) orthonormal directions in units of `scale` (N,);
    `prior` (N, N): change of all unknowns (rows) for one standard deviation of what was known beforehand of each
    (columns). `unsettled`: length in standard uncertainties of the step that linearisation would still take.
    """

    covariance: FloatArray
    opened: FloatArray
    scale: FloatArray
    prior: FloatArray
    unsettled: float

    def u(self, gradient: FloatArray) -> float:
        """Return the standard uncertainty of a number with a `gradient` (N,), infinite where it is open."""
        own = gradient * self.scale
        size = float(np.linalg.norm(own))
        if size > 0.0 and len(self.opened) and np.linalg.norm(self.opened @ own) > 1e-4 * size:
            return float("inf")
        return float(np.sqrt(max(0.0, float(gradient @ self.covariance @ gradient))))

    def covariance_of(self, gradients: FloatArray) -> FloatArray:
        """Return the covariance (G, G) of numbers with `gradients` (G, N): open ones infinite, and without relation."""
        found = gradients @ self.covariance @ gradients.T
        size = np.array([self.u(gradient) for gradient in gradients])
        unknown = ~np.isfinite(size)
        found[unknown] = 0.0
        found[:, unknown] = 0.0
        found[unknown, unknown] = np.inf
        return np.asarray(found)


def spread(problem: Problem, state: State) -> Spread:
    """Return the covariance A⁻¹ (JᵀRJ + P) A⁻¹, A = JᵀJ + P: R the correlation of lines, P what was known beforehand.

    In a basis in which A = 1, so that what the stated masses and scales leave open does not lose its digits.
    """
    count, free = len(state.vector), ~problem.fixed
    wide = [_wide(problem, curve, part) for curve, part in zip(problem.curves, state.jacobians, strict=True)]
    rows = [jacobian.reshape(-1, count) for jacobian in wide]
    stacked = np.concatenate([*rows, np.diag(np.sqrt(problem.precision))])
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0.0] = 1.0
    triangle = np.linalg.qr((stacked / size)[:, free], mode="r")
    singular, found = np.linalg.svd(triangle)[1:]
    directions = np.zeros((len(found), count))
    directions[:, free] = found
    determined = singular > _OPEN * singular.max()
    basis = directions[determined].T / singular[determined] / size[:, None]
    middle = np.eye(basis.shape[1])
    for curve, jacobian in zip(problem.curves, wide, strict=True):
        correlation = curve.record.line_correlation
        if correlation is not None and len(correlation) > 1:
            middle += _between_lines(curve.record.ratio.frequency_hz, jacobian @ basis, correlation)
    prior = basis @ basis.T * np.sqrt(problem.precision)
    uphill = state.gradient + problem.precision * (problem.expected - state.vector)
    unsettled = float(np.linalg.norm(uphill @ basis))
    return Spread(basis @ middle @ basis.T, directions[~determined], 1.0 / size, prior, unsettled)


def _wide(problem: Problem, curve: Curve, jacobian: FloatArray) -> FloatArray:
    """Return derivatives (K, 2C, N) by all unknowns of those (K, 2C, L) by a curve's own, none by fixed ones."""
    wide = np.zeros((*jacobian.shape[:2], len(problem.names)))
    for column, place in enumerate(curve.places):
        wide[:, :, place] += jacobian[:, :, column]
    wide[:, :, problem.fixed] = 0.0
    return wide


def _between_lines(frequency_hz: FloatArray, columns: FloatArray, correlation: ComplexArray) -> FloatArray:
    """Return Tᵀ(R - 1)T of whitened columns T (K, 2C, N), R the `correlation` (D,) of lines 0, 1, 2 … apart."""
    place = np.round((frequency_hz - frequency_hz.min()) / np.min(np.diff(np.sort(frequency_hz)))).astype(np.int64)
    length, channels, count = int(place.max()) + 1, columns.shape[1] // 2, columns.shape[2]
    grid: ComplexArray = np.zeros((length + len(correlation), channels, count), dtype=np.complex128)
    grid[place] = columns[:, :channels] + 1j * columns[:, channels:]
    here = grid[:length].reshape(-1, count)
    total = np.zeros((count, count))
    for apart, value in enumerate(correlation[1:], start=1):
        pair = value * (grid[apart : apart + length].reshape(-1, count).conj().T @ here)
        total += (pair + pair.conj().T).real
    return total


# What is to be said of an identification: what the recordings leave open, what contradicts what was stated.


_remarks_OPEN = 1.0 / 3.0  # u over value from which a parameter is called open
_NEGLIGIBLE = 0.02  # part of the whole inertia below which an internal one need not be known
_PULL = 3.0  # deviation in standard uncertainties that is named
_NOISE_INFO, _NOISE_WARNING = 1.2, 4.0  # χ²/dof that is named
_CHANCES = 5.0  # standard deviations by which χ²/dof exceeds what noise leaves
_SETTLED = 0.1  # standard uncertainties from the minimum that do not matter
_UNTOUCHED = 0.95  # of a stated uncertainty, left: the recordings say nothing of it


def remarks(
    problem: Problem, state: State, found: Spread, estimates: tuple[ParameterEstimate, ...], noise: SeenNoise
) -> tuple[Notice, ...]:
    """Return all notices of an identification."""
    notices = [*_misfit(noise), *_unsettled(found)]
    whole = _whole(problem, state)
    for place, estimate in enumerate(estimates):
        if problem.fixed[place]:
            continue
        if problem.precision[place] > 0.0:
            notices += [*_stated(problem, estimate, place), *_negative(estimate)]
        else:
            notices += _left_open(estimate, whole[place]) or _negative(estimate)
    for place in range(len(estimates), len(problem.names)):
        if problem.precision[place] > 0.0:
            notices += _pulled(problem.names[place].removeprefix("error: "), state, found, place)
    return tuple(notices)


def _misfit(noise: SeenNoise) -> list[Notice]:
    """Say that the residuals exceed the noise."""
    if noise.common < max(_NOISE_INFO, 1.0 + _CHANCES * noise.chance):
        return []
    text = (
        f"the curves depart from the model by {np.sqrt(noise.common):.2g} times their noise; the uncertainties are "
        "enlarged by this factor"
    )
    if noise.common < _NOISE_WARNING:
        return [Notice("info", text, "identification")]
    text += ", and the parameters depend on the lines that are fitted"
    return [Notice("warning", text, "identification")]


def _unsettled(found: Spread) -> list[Notice]:
    """Say that no minimum was reached."""
    if found.unsettled < _SETTLED:
        return []
    text = (
        f"the fit ended {found.unsettled:.2g} standard uncertainties before it settled; state what is known of "
        "the parameters, or fit fewer components"
    )
    return [Notice("warning", text, "identification")]


def _whole(problem: Problem, state: State) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return for parameters of inertia the smallest inertia (P,) that they are a part of, zero for all others."""
    whole = np.full(len(problem.kind), np.inf)
    for curve in problem.curves:
        mass = curve.mechanics.at(curve.weights(state.vector))[0][0].diagonal()
        for term, place in enumerate(curve.terms, start=1):
            share = curve.mechanics.matrices[term, 0].diagonal()
            if place < len(whole) and np.any(share > 0.0):
                whole[place] = min(whole[place], float(np.min(mass[share > 0.0] / share[share > 0.0])))
    return np.where(np.isfinite(whole), whole, 0.0)


def _left_open(estimate: ParameterEstimate, whole: float) -> list[Notice]:
    """Say that the recordings do not tell a parameter."""
    if estimate.u <= _remarks_OPEN * max(abs(estimate.value), _NEGLIGIBLE * whole):
        return []
    size = "" if not np.isfinite(estimate.u) else f": its uncertainty is {estimate.u:.2g} {estimate.unit}"
    helps = {
        "internal": "loads that differ more tell it, or a stated value does",
        "stiffness": "a band that holds its resonance tells it; where the masses are open, stiffness is too",
        "damping": "lines closer to its resonance tell it",
    }
    help_text = next((text for start, text in helps.items() if estimate.name.startswith(start)), "state its value")
    return [Notice("warning", f"the data cannot tell the {estimate.label}{size}; {help_text}", estimate.name)]


def _negative(estimate: ParameterEstimate) -> list[Notice]:
    """Say that a mass or a damping came out below zero."""
    if estimate.value >= 0.0 or not np.isfinite(estimate.u):
        return []
    number = f"{estimate.label} is {estimate.value:.4g} ± {estimate.u:.2g} {estimate.unit} (k = 1)"
    if estimate.value > -2.0 * estimate.u:
        return [Notice("info", f"{number}: zero within its uncertainty", estimate.name)]
    if estimate.name.startswith("internal"):
        text = (
            f"{number}, below zero: these resonances are not those of the load on the springs assumed, but of another "
            "motion, e.g. pitching or a mount that gives"
        )
    else:
        text = f"{number}, below zero: a delay or a mode outside the model turns the phase at the resonance"
    return [Notice("warning", text, estimate.name)]


def _stated(problem: Problem, estimate: ParameterEstimate, place: int) -> list[Notice]:
    """Say that a stated parameter is contradicted, or that the recordings add nothing to it."""
    stated, u = problem.expected[place], 1.0 / np.sqrt(problem.precision[place])
    if estimate.u > _UNTOUCHED * u:
        text = (
            f"the {estimate.label} is as stated, {stated:.6g} ± {u:.2g} {estimate.unit}: the data cannot tell it better"
        )
        return [Notice("info", text, estimate.name)]
    pull = abs(estimate.value - stated) / float(np.sqrt(u**2 - estimate.u**2))
    if pull < _PULL:
        return []
    text = (
        f"the {estimate.label} stated, {stated:.6g} ± {u:.2g} {estimate.unit}, is contradicted by the recordings: "
        f"together they give {estimate.value:.6g} {estimate.unit}, {pull:.2g} standard deviations off"
    )
    return [Notice("warning", text, estimate.name)]


def _pulled(name: str, state: State, found: Spread, place: int) -> list[Notice]:
    """Say that the recordings contradict the uncertainty stated of a cause of error."""
    estimate, remaining = float(state.vector[place]), float(found.covariance[place, place])
    if estimate**2 <= _PULL**2 * max(1e-6, 1.0 - remaining):
        return []
    text = f"the fit needs {name} to be off by {abs(estimate):.2g} times its standard uncertainty"
    return [Notice("warning", text, name)]


# All recordings in one complex least-squares fit.


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
