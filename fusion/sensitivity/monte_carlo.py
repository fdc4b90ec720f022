"""Monte Carlo: the evaluation after tracks and channels for each draw of all uncertain quantities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.base import ProgressCallback, no_progress
from fusion.errors import ComputeError
from fusion.estimation.consistent_solution import solve_consistently
from fusion.estimation.fuse import Acceleration
from fusion.estimation.least_squares import UNOBSERVED, UNOBSERVED_ITSELF, FusionSolution, RowIndex
from fusion.estimation.measurement_model import Deviates, DrawnReadings, Observation
from fusion.estimation.uncertainty import Uncertainty, as_complex, element_covariances, real_stack
from fusion.estimation.variance_components import MIN_DISCREPANCY_DOF
from fusion.instruments.channel import Outputs
from fusion.sensitivity.analyse import Analysis, Inputs
from fusion.sensitivity.distributions import FirstOrder, MonteCarlo, Propagated, judged, summarise
from fusion.sensitivity.load_phasors import LoadResult
from fusion.sensitivity.ratio import PriorMatrix, quotient
from fusion.sensitivity.sensitivity_notices import DRAWS_NOT_CONVERGED, FIRST_ORDER_TOO_LARGE, FIRST_ORDER_TOO_SMALL
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

BLOCK = 2000
"""Draws computed at once; each block has separate random streams, so that blocks may be computed in any order."""
CONVERGED = 1e-9
MOST_STEPS = 60


def propagate(
    inputs: Inputs, analysis: Analysis, draws: int, seed: int, progress: ProgressCallback = no_progress
) -> MonteCarlo:
    """Return the distribution of every result at the driven lines from N draws.

    JCGM 101 and 102. Noise has multivariate t-distributions with its degrees of freedom. Masses, points, directions,
    poses, scales, delays and clocks have normal distributions of their stated standard uncertainties, each once by its
    name. Positions, finite rotations, products and delays are exact. Unobserved motion has its limit as amplitude and a
    uniform phase; disagreement between instruments is drawn as the evaluation states it.

    The weights of the instruments are the evaluation's. The cost of estimated weights (2Λ of `EstimatedNoise.lost`, in
    first-order U) is not drawn: t-distributions are already wider by the same amount, with the variance ν/(ν - 2). Both
    together would contradict a correct first-order U (docs/uncertainty.md).
    """
    motions = [_motion(inputs, fused) for fused in analysis.accelerations if fused.source == "fused"]
    driven = np.flatnonzero(inputs.lines.multiple == 1)
    firsts, drawn = [], {}
    for first in _first_order(analysis):
        # Of the driven lines those elements that any of them determines.
        determined = np.flatnonzero(np.isfinite(first.value[driven]).any(axis=0))
        firsts.append(first.at(driven, determined))
        drawn[first.name] = np.empty((draws, len(driven), len(determined)), np.complex128), determined
    for number, start in enumerate(range(0, draws, BLOCK)):
        deviates = Deviates(seed, number, min(BLOCK, draws - start))
        values = _draw(inputs, analysis, motions, deviates)
        for name, (block, determined) in drawn.items():
            block[start : start + deviates.count] = values[name][:, driven][:, :, determined]
        progress("Monte Carlo", start + deviates.count, draws)
    unknown = complex(np.nan, np.nan)
    results = [summarise(f, np.where(np.isfinite(f.value), drawn.pop(f.name)[0], unknown)) for f in firsts]
    return MonteCarlo(draws, seed, tuple(results), _notices(results, draws))


@dataclass(frozen=True)
class Estimator:
    """Estimator of the acceleration from drawn readings, with the gain of the evaluation.

    `observations`: those of the fusion. `gain` (P, N) on the reduced unknowns. `expand` (12K, P): from these to [Re
    A_k, Im A_k] of all lines. The estimate of a draw is the A for which gain · (readings - rows · A) = 0: the true
    value if readings and rows are consistent, and generalised least squares to first order.
    """

    observations: tuple[Observation, ...]
    gain: FloatArray
    expand: FloatArray

    @classmethod
    def of(cls, observations: Sequence[Observation], expand: FloatArray, solution: FusionSolution) -> Estimator:
        """Return the estimator of a solved system."""
        return cls(tuple(observations), np.asarray(np.linalg.pinv(expand) @ solution.gain), expand)

    def acceleration(self, drawn: Sequence[DrawnReadings], start: ComplexArray, hidden: ComplexArray) -> ComplexArray:
        """Return the estimates (N, K, 6) from N draws of every observation.

        By steps with the fixed gain. `start` (K, 6): initial value. `hidden` (N, K, 6): unobserved motion, which the
        rows may include.
        """
        count, lines = hidden.shape[:2]
        indices = [RowIndex.of(observation) for observation in self.observations]
        unknowns = np.repeat((np.linalg.pinv(self.expand) @ real_stack(start).ravel())[None], count, axis=0)
        # Tolerance of a step: the largest unknown of the same kind and unit.
        limit = CONVERGED * np.max(np.abs(unknowns), initial=1e-300)
        for _ in range(MOST_STEPS):
            estimate = as_complex((unknowns @ self.expand.T).reshape(count, lines, 12))
            rest = [d.readings - np.einsum("nkmj,nkj->nkm", d.design, estimate + hidden) for d in drawn]
            rows = [index.rows(value) for index, value in zip(indices, rest, strict=True)]
            step = np.concatenate(rows, axis=1) @ self.gain.T
            unknowns = unknowns + step
            if np.abs(step).max(initial=0.0) <= limit:
                return as_complex((unknowns @ self.expand.T).reshape(count, lines, 12))
        raise ComputeError(DRAWS_NOT_CONVERGED)


@dataclass(frozen=True)
class _Motion:
    """The fused acceleration of a body with its estimator; `noise`: names of the random streams."""

    fused: Acceleration
    observations: tuple[Observation, ...]
    noise: tuple[str, ...]
    estimator: Estimator

    @property
    def name(self) -> str:
        """Return the name among the results."""
        return f"acceleration of the {self.fused.body}"

    def draw(self, deviates: Deviates) -> ComplexArray:
        """Return accelerations (N, K, 6) of the body; possible values where it is not observed.

        The uncertainty of the estimate includes disagreement of the instruments in addition to their errors. A variance
        that is hardly significant has nominally less than one degree of freedom and no distribution; it is drawn with
        at least `MIN_DISCREPANCY_DOF`.
        """
        fused, estimate = self.fused, np.asarray(np.nan_to_num(self.fused.phasors.value))
        phase = deviates.angle(f"unobserved motion of the {fused.body}", *estimate.shape)
        amplitude = fused.unobserved_amplitude  # unbounded motion reaches no value
        hidden = np.where(np.isinf(amplitude), 0.0, amplitude) * np.exp(1j * phase)
        readings = [o.draw(estimate, deviates, noise) for o, noise in zip(self.observations, self.noise, strict=True)]
        value = self.estimator.acceleration(readings, estimate, hidden)
        drawn_labels = {f"{name}: noise" for name in fused.instruments} | {UNOBSERVED, *UNOBSERVED_ITSELF}
        drawn_names = {error.name for observation in self.observations for error in observation.common}
        further = np.zeros_like(value)
        for part in fused.uncertainty.random:
            if part.label not in drawn_labels:
                dof = np.full(len(part.covariance), np.inf) if part.dof is None else part.dof
                dof = np.maximum(dof, MIN_DISCREPANCY_DOF)
                further += as_complex(deviates.noise(f"{part.label} of the {fused.body}", part.covariance, dof))
        for influence in fused.uncertainty.influences:
            if influence.name not in drawn_names:
                effect = np.nan_to_num(influence.effect)
                further += as_complex(deviates.unknown(influence.name, influence.dof)[:, None, None] * effect)
        return np.where(fused.observed, value + further, hidden)


def _motion(inputs: Inputs, fused: Acceleration) -> _Motion:
    """Return a fused acceleration with the instruments that it uses."""
    of_body = [(index, seen) for index, seen in enumerate(inputs.observations) if seen.body == fused.body]
    used = [(index, seen) for index, seen in of_body if seen.stated] or of_body
    solved = solve_consistently([seen for _, seen in used], fused.unobserved_limits, fused.scatter)
    estimator = Estimator.of(solved.system.observations, solved.system.expand, solved.final)
    return _Motion(fused, estimator.observations, tuple(f"noise of instrument {index}" for index, _ in used), estimator)


def _draw(
    inputs: Inputs, analysis: Analysis, motions: Sequence[_Motion], deviates: Deviates
) -> dict[str, ComplexArray]:
    """Return one block of draws (N, K, components) of every result, by its name."""
    drawn: dict[str, ComplexArray] = {}
    for motion in motions:
        drawn[motion.name] = acceleration = motion.draw(deviates)
        if motion.fused.body == "load" and inputs.body is not None and analysis.load is not None:
            matrices = inputs.body.draw_load_matrices(inputs.lines.frequency_hz, deviates)
            drawn["load"] = np.einsum("nkij,nkj->nki", matrices, acceleration)
    outputs = analysis.outputs
    if outputs is not None and analysis.sensitivity is not None:
        channel, component = np.array(analysis.sensitivity.elements).T
        drawn["sensitivity"] = quotient(outputs.draw(deviates)[:, :, channel], drawn["load"][:, :, component])
        if analysis.prior_matrix is not None and analysis.load is not None:
            drawn["element"] = _draw_elements(analysis.prior_matrix, outputs, analysis.load, drawn["load"], deviates)
    return drawn


def _draw_elements(
    prior: PriorMatrix, outputs: Outputs, load: LoadResult, loads: ComplexArray, deviates: Deviates
) -> ComplexArray:
    """Return the elements (N, K, E) of the sensor from drawn loads, outputs and matrices."""
    matrix = np.zeros((deviates.count, loads.shape[1], *prior.value.shape), np.complex128) + prior.value
    unknowns = (*prior.unknowns, *prior.frequency_unknowns(outputs.phasors.value, load.value))
    for unknown in unknowns:
        bound = np.sqrt(3.0) * (deviates.angle(unknown.name) / np.pi - 1.0)
        off = deviates.normal(unknown.name) if unknown.distribution == "normal" else bound
        matrix += off[:, None, None, None] * unknown.effect
    return prior.elements(outputs.draw(deviates), loads, matrix)


def _first_order(analysis: Analysis) -> Iterator[FirstOrder]:
    """Yield every result with its first-order uncertainty, all lines and elements."""
    frequency = analysis.accelerations[0].phasors.frequency_hz

    def of(
        name: str, elements: Sequence[str], units: Sequence[str], value: ComplexArray, uncertainty: Uncertainty
    ) -> FirstOrder:
        covariance, dof = uncertainty.covariance, uncertainty.dof_polar(value)
        first_order = uncertainty.regions(value, covariance, dof), uncertainty.k_polar(value, dof)
        covariances = element_covariances(covariance)
        return FirstOrder(name, frequency, tuple(elements), tuple(units), value, covariances, *first_order)

    for fused in analysis.accelerations:
        if fused.source == "fused":
            name, seen = f"acceleration of the {fused.body}", fused.phasors
            yield of(name, MOTION_COMPONENTS, seen.unit, seen.value, fused.uncertainty)
    if analysis.load is not None:
        value = np.where(analysis.load.observed, analysis.load.value, complex(np.nan, np.nan))
        yield of("load", LOAD_COMPONENTS, LOAD_UNITS, value, analysis.load.uncertainty)
    for title, found in (("sensitivity", analysis.sensitivity), ("element", analysis.element)):
        if found is not None:
            names = [f"{found.channels[c]} per {found.components[j]}" for c, j in found.elements]
            units = [f"({found.unit})/{'N' if j < 3 else '(N.m)'}" for _, j in found.elements]
            channel, component = np.array(found.elements).T
            yield of(title, names, units, found.value[:, channel, component], found.uncertainty)


def _notices(results: Sequence[Propagated], draws: int) -> tuple[Notice, ...]:
    """Return a warning of too small first-order U, and a note of too large."""
    small, large = judged(results, draws)
    notices = []
    if small:
        notices.append(Notice(FIRST_ORDER_TOO_SMALL, "monte carlo", draws=draws, quantities="; ".join(small)))
    if large:
        notices.append(Notice(FIRST_ORDER_TOO_LARGE, "monte carlo", draws=draws, quantities="; ".join(large)))
    return tuple(notices)
