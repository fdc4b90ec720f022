"""Frequency and damping that depend on the amplitude of a decay: softening springs, friction.

With t from the end of the release, a mode z = c·exp(pt), σ = -Re p, has the amplitude a = exp(-σt) of its first. A
frequency that changes by α·aᵐ, relative, changes the phase by αω(1 - exp(-mσt))/(mσ). A damping ratio that changes by
β·aᵐ changes ln|z| by the negative of the same with β. Dry friction has m = -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shaker.lti.system import ModalModel
from shaker.model_notices import AMPLITUDE_DEPENDENT
from shaker.release.load_response import responses
from shaker.release.output_error import OutputErrorFit, columns, design, slopes
from shaker.release.shape_hypotheses import parameter_change
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.fitting import eliminate
from shakercal._common.notices import Notice

_TERMS = (("frequency", 2), ("frequency", 1), ("damping", 1), ("damping", -1))
_KINDS = ("frequency", "damping")
_LEAST_AMPLITUDE = 0.05  # amplitude over the first below which a decay is left out
_LEAST_LINES = 32  # number of samples of a spectrum
_RANGE = 0.1  # smallest amplitude over the first for which changes are stated
SIGNIFICANT = 15.0
"""χ² of a significant term; noise alone exceeds it with one of four terms once in 2000 cases."""
EVENLY = float(np.sqrt(3.0))
"""Half range over the standard deviation of an even distribution."""


@dataclass(frozen=True)
class AmplitudeDependence:
    """Change of frequency and damping of a decay with its amplitude.

    `mode`: its number in the fit. `amplitude`: the first. `frequency_change`, `damping_change`: relative, from a tenth
    of the first amplitude to it. `shifts` (2, 2): of ln ω and ζ from the fit to those of small and of the first
    amplitude. `square_share`: sum of squares that the terms leave, over that of the fit. `chi_squared`: of the most
    significant term.
    """

    mode: int
    amplitude: float
    frequency_change: float
    damping_change: float
    shifts: FloatArray
    square_share: float
    chi_squared: float

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
    """Decay of the strongest mode `z` (B,), residual, derivatives by all parameters (B, K).

    `places`: those of its frequency and damping ratio. `colour`: density of the noise about it.
    """

    mode: int
    places: tuple[int, int]
    pole: complex
    colour: float
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


def _decay(fit: OutputErrorFit) -> _Decay | None:
    """Return the weighted decay of the strongest mode, None for one too short."""
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
    if not one[0].real < 0.0 or np.count_nonzero(after) <= jacobian.shape[1] + len(_TERMS):
        return None
    weight, residual = samples.weight[after], (samples.value - matrix @ fit.linear)[after]
    ended = samples.between(float(samples.time_s[after][-1]), np.inf)
    rest = ended.value - design(problem, fit.vector, ended) @ fit.linear
    return _Decay(
        mode=strongest,
        places=(strongest, structure.modes + strongest),
        pole=complex(one[0]),
        colour=max(problem.colour, _resonant_noise(rest, complex(one[0]) * ended.step_s * int(samples.length[-1]))),
        time_s=late[after],
        weight=weight,
        residual=residual * weight,
        jacobian=jacobian[after] * weight[:, None],
        z=z[after],
    )


def _resonant_noise(rest: FloatArray, pole: complex) -> float:
    """Return the relative density of noise (N,) about a mode, at least 1.

    Relative to white noise, after the decay. `pole`: times the interval. A measured load, or the floor, excites the
    mode at rest as well.
    """
    if len(rest) < _LEAST_LINES:
        return 1.0
    cycles, power = np.fft.rfftfreq(len(rest)), np.abs(np.fft.rfft(rest)) ** 2
    near = np.abs(cycles - pole.imag / (2.0 * np.pi)) < max(2.0 / len(rest), -pole.real / np.pi)
    if not np.any(near):
        return 1.0
    chance = 1.0 + 2.0 / np.sqrt(np.count_nonzero(near))
    density = float(np.mean(power[near])) / max(1e-300, float(np.mean(power[1:])))
    return max(1.0, float(density / chance))


def _column(decay: _Decay, kind: str, power: int) -> FloatArray:
    """Return the change (B,) of the decay by one term."""
    sigma = -decay.pole.real
    by = -abs(decay.pole) * np.expm1(-power * sigma * decay.time_s) / (power * sigma)
    return decay.weight * np.real((1j if kind == "frequency" else -1.0) * decay.z * by)


def amplitude_dependence(fits: Sequence[OutputErrorFit], least: float = SIGNIFICANT) -> AmplitudeDependence | None:
    """Return how the strongest mode depends on its amplitude, None if not significantly.

    The terms are fitted to the residuals of all releases together with the parameters of each fit: the most
    significant one of the frequency, and of the damping, with χ² above `least`. `mode` is that of the first fit.
    """
    decays = [decay for fit in fits if (decay := _decay(fit)) is not None]
    if not decays:
        return None
    amplitude = max(float(np.abs(decay.z[0])) for decay in decays)
    parts = [_without_fit(decay, amplitude) for decay in decays]
    terms, residual = (np.concatenate([getattr(part, name) for part in parts]) for name in ("terms", "residual"))
    chosen, significance, left = list[int](), 0.0, float(residual @ residual)
    while rest := [n for n, (kind, _) in enumerate(_TERMS) if kind not in [_TERMS[one][0] for one in chosen]]:
        trials = {n: _squares_left(terms[:, [*chosen, n]], residual) for n in rest}
        best = min(trials, key=lambda n: trials[n])
        if left - trials[best] < least:
            break
        significance = max(significance, left - trials[best])
        chosen, left = [*chosen, best], trials[best]
    if not chosen:
        return None
    sizes = eliminate(terms[:, chosen], residual[:, None]).coefficients[:, 0]
    small = np.mean([part.shifts[:, 0] - part.shifts[:, 1:][:, chosen] @ sizes for part in parts], axis=0)
    at_first, changes = np.zeros(2), np.zeros(2)
    for one, size in zip(chosen, sizes.tolist(), strict=True):
        kind, power = _TERMS[one]
        at_first[_KINDS.index(kind)] += size
        changes[_KINDS.index(kind)] += size * (1.0 - _RANGE**power)
    damping_ratio = float(fits[0].vector[fits[0].problem.structure.modes + decays[0].mode])
    return AmplitudeDependence(
        mode=decays[0].mode,
        amplitude=amplitude,
        frequency_change=float(changes[0]),
        damping_change=float(changes[1]) / damping_ratio,
        shifts=np.array([small, small + at_first]),
        square_share=left / float(residual @ residual),
        chi_squared=significance,
    )


class _WithoutFit(NamedTuple):
    """Residual (B,) and terms (B, T) of a decay without the fit's part, over noise.

    `shifts` (2, 1 + T): changes of ln ω and ζ that these parts are.
    """

    residual: FloatArray
    terms: FloatArray
    shifts: FloatArray


def _without_fit(decay: _Decay, amplitude: float) -> _WithoutFit:
    """Return a decay without its parts along its fit; the terms refer to an amplitude."""
    share = float(np.abs(decay.z[0])) / amplitude
    terms = [share**power * _column(decay, kind, power) for kind, power in _TERMS]
    solved = eliminate(decay.jacobian, np.column_stack([decay.residual, *terms]))
    residual, columns_ = solved.residual[:, 0], solved.residual[:, 1:]
    freedom = max(1, len(residual) - decay.jacobian.shape[1] - len(terms))
    noise = np.sqrt(max(_squares_left(columns_, residual), 1e-300) * decay.colour / freedom)
    return _WithoutFit(residual / noise, columns_ / noise, solved.coefficients[list(decay.places)])


def _squares_left(design: FloatArray, residual: FloatArray) -> float:
    """Return the sum of squares of a residual without its part along a design."""
    left = eliminate(design, residual[:, None]).residual[:, 0]
    return float(left @ left)
