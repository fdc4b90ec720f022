"""What is to be said of an identification: what the recordings leave open, what contradicts what was stated."""

from __future__ import annotations

import numpy as np

from shaker.models.identification.problem import Problem
from shaker.models.identification.solve import Spread, State
from shaker.models.measured import ParameterEstimate
from shaker.models.resonance.line_noise import SeenNoise
from shaker.notice import Notice

_OPEN = 1.0 / 3.0  # u over value from which a parameter is called open
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
    if estimate.u <= _OPEN * max(abs(estimate.value), _NEGLIGIBLE * whole):
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
