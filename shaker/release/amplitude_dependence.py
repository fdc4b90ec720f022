"""Frequency and damping that depend on the amplitude of a decay: softening springs, friction.

With t from the end of the release, a mode z = c·exp(pt), σ = -Re p, has the amplitude a = exp(-σt) of its first. A
frequency that changes by α·aᵐ, relative, changes the phase by αω(1 - exp(-mσt))/(mσ). A damping ratio that changes by
β·aᵐ changes ln|z| by the negative of the same with β. Dry friction has m = -1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shaker.lti.system import ModalModel
from shaker.model_notices import AMPLITUDE_DEPENDENT
from shaker.release.load_response import responses
from shaker.release.output_error import OutputErrorFit, columns, slopes
from shaker.release.shape_hypotheses import parameter_change
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.fitting import eliminate
from shakercal._common.notices import Notice

_TERMS = (("frequency", 2), ("frequency", 1), ("damping", 1), ("damping", -1))
_SIGNIFICANT = 30.0  # χ² by one of four terms; noise alone exceeds it once in 10^7
_LEAST_AMPLITUDE = 0.05  # amplitude over the first below which a decay is left out
_RANGE = 0.1  # smallest amplitude over the first for which changes are stated
EVENLY = float(np.sqrt(3.0))
"""Half range over the standard deviation of an even distribution."""


@dataclass(frozen=True)
class AmplitudeDependence:
    """Change of frequency and damping of a decay with its amplitude.

    `mode`: its number in the fit. `amplitude`: the first. `frequency_change`, `damping_change`: relative, from a tenth
    of the first amplitude to it. `shifts` (2, 2): of ln ω and ζ from the fit to those of small and of the first
    amplitude. `square_share`: sum of squares that the terms leave, over that of the fit.
    """

    mode: int
    amplitude: float
    frequency_change: float
    damping_change: float
    shifts: FloatArray
    square_share: float

    def changes(self, model: ModalModel) -> list[FloatArray]:
        """Return the changes (P,) of parameters to small and to first amplitudes."""
        modes, found = len(model.frequency_hz), list[FloatArray]()
        for log_omega, zeta in self.shifts:
            shift = np.zeros(len(model.vector))
            shift[self.mode], shift[modes + self.mode] = log_omega * model.frequency_hz[self.mode], zeta
            found.append(parameter_change(model, shift))
        return found

    def widen(self, model: ModalModel) -> ModalModel:
        """Return a model whose covariance includes small and first amplitudes."""
        if model.covariance is None:
            return model
        parts = [np.outer(change, change) / EVENLY**2 for change in self.changes(model)]
        return replace(model, covariance=model.covariance + np.sum(parts, axis=0))

    def notice(self, model: ModalModel, unit: str, where: str) -> Notice:
        """Return the notice of the dependence."""
        return Notice(
            AMPLITUDE_DEPENDENT,
            where,
            frequency_hz=float(model.frequency_hz[self.mode]),
            amplitude=self.amplitude,
            unit=unit,
            frequency_percent=100.0 * self.frequency_change,
            damping_percent=100.0 * self.damping_change,
        )


class _Decay(NamedTuple):
    """Decay of the strongest mode `z` (B,), residual, derivatives by all parameters (B, K)."""

    mode: int
    pole: complex
    time_s: FloatArray
    weight: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    z: ComplexArray


def distinct_modes(fit: OutputErrorFit) -> int:
    """Return the number of modes if overlapping ones are one mode that drifts."""
    poles = fit.problem.structure.poles(fit.vector)[: fit.problem.structure.modes]
    poles = poles[np.argsort(poles.imag)]
    return 1 + int(np.count_nonzero(np.diff(poles.imag) > np.abs(poles.real[1:]) + np.abs(poles.real[:-1])))


def _decay(fit: OutputErrorFit) -> _Decay:
    """Return the decay of the strongest mode, weighted by the length of blocks."""
    problem, samples, structure = fit.problem, fit.problem.samples, fit.problem.structure
    poles, (middle, length) = structure.poles(fit.vector), problem.release(fit.vector)
    residues = 2.0 * structure.shares(fit.vector)[: structure.modes] @ fit.linear[1:]
    strongest = int(np.argmax(np.abs(residues / poles[: structure.modes])))
    one, load = poles[strongest : strongest + 1], problem.load
    ring = responses(load, one, samples, middle, length, problem.stages(fit.vector))[:, 0]
    z = residues[strongest] * (ring + load.amplitude / one[0])
    matrix, answered = columns(problem, fit.vector, samples)
    jacobian = np.concatenate([slopes(problem, fit.vector, fit.linear, answered), matrix], axis=1)
    late = samples.time_s - (middle + 0.5 * length)
    after = (late > 0.0) & (late * one[0].real > np.log(_LEAST_AMPLITUDE))
    weight, residual = samples.weight[after], (samples.value - matrix @ fit.linear)[after]
    return _Decay(
        strongest, one[0], late[after], weight, residual * weight, jacobian[after] * weight[:, None], z[after]
    )


def _column(decay: _Decay, kind: str, power: int) -> FloatArray:
    """Return the change (B,) of the decay by one term."""
    sigma = -decay.pole.real
    by = -abs(decay.pole) * np.expm1(-power * sigma * decay.time_s) / (power * sigma)
    return decay.weight * np.real((1j if kind == "frequency" else -1.0) * decay.z * by)


def amplitude_dependence(fit: OutputErrorFit) -> AmplitudeDependence | None:
    """Return how the strongest mode depends on its amplitude, None if that is not significant.

    The terms are fitted to the residual together with all parameters of the fit: the most significant one of the
    frequency, and of the damping.
    """
    decay, modes = _decay(fit), fit.problem.structure.modes
    if not decay.pole.real < 0.0 or len(decay.time_s) <= decay.jacobian.shape[1] + len(_TERMS):
        return None
    design, terms, chosen = decay.jacobian, {term: _column(decay, *term) for term in _TERMS}, list[tuple[str, int]]()
    first = square = _squares_left(design, decay.residual)
    while terms:
        trials = {term: np.column_stack([design, column]) for term, column in terms.items()}
        left = {term: _squares_left(trial, decay.residual) for term, trial in trials.items()}
        best = min(left, key=lambda term: left[term])
        noise = left[best] * fit.problem.colour / max(1, len(decay.residual) - design.shape[1] - 1)
        if square - left[best] < _SIGNIFICANT * noise:
            break
        design, square = trials[best], left[best]
        chosen.append(best)
        terms = {term: column for term, column in terms.items() if term[0] != best[0]}
    if not chosen:
        return None
    solved = eliminate(design, decay.residual[:, None]).coefficients[:, 0]
    sizes = dict(zip(chosen, solved[decay.jacobian.shape[1] :].tolist(), strict=True))
    small = solved[[decay.mode, modes + decay.mode]]
    at_first = [sum(size for (kind, _), size in sizes.items() if kind == of) for of in ("frequency", "damping")]
    changes = {kind: size * (1.0 - _RANGE**power) for (kind, power), size in sizes.items()}
    return AmplitudeDependence(
        decay.mode,
        float(np.abs(decay.z[0])),
        changes.get("frequency", 0.0),
        changes.get("damping", 0.0) / float(fit.vector[modes + decay.mode]),
        np.array([small, small + at_first]),
        square / first,
    )


def _squares_left(design: FloatArray, residual: FloatArray) -> float:
    """Return the sum of squares of a residual without its part along a design."""
    left = eliminate(design, residual[:, None]).residual[:, 0]
    return float(left @ left)
