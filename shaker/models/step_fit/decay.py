"""The modes that ring after a release: how many, and where the fit with the release starts from."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.reading import Reading
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.output_error import Problem, Solution, design, solve
from shaker.models.step_fit.samples import Samples, block_length, in_blocks
from shaker.models.step_fit.start import instruments, peaks_hz, pencil, thinned, upper_poles
from shaker.models.step_fit.structure import Structure

MOST = 4  # modes that the rule looks for
CLEAR = 12.0  # fall of B·ln(sum of squares) by a parameter that is taken for real
_STEEP = 0.5  # damping ratio above which a further mode is taken for a disturbance


def decay_modes(
    whole: Samples, reading: Reading, method: Literal["pencil", "arx"], count: int | None
) -> tuple[ComplexArray, float]:
    """Return the upper poles (M,) in rad/s that ring after the release, as many as told or supported, and the colour.

    Exponentials with free amplitudes and a level are fitted to the decay alone, so that neither the release nor fast
    poles matter. A further mode stays where its line stands out of the residual's spectrum, its ζ is between 0 and
    0.5, and it lowers B·ln(sum of squares) by more than 12 for each of its four parameters. The colour: density of the
    residual's blocks over that of white noise of the same variance.
    """
    decay = _after(whole, reading)
    near = peaks_hz(decay.value, decay.step_s, count or 1)
    if not near.size:
        raise ValueError(f"{reading.record}, {reading.channel}: no oscillation above the noise after the release")
    values, coarse = thinned(decay.value, decay.step_s, float(near.max()))
    find = pencil if method == "pencil" else instruments
    modes = upper_poles(find(values - values.mean(), coarse, 2 * (count or 1) + 1), count or 1, near)
    found = _rung(decay, modes)
    while count is None and found.problem.structure.modes < MOST:
        further = _with_another(decay, found)
        if further is None:
            break
        found = further
    poles = found.problem.structure.poles(found.vector)
    colour = found.variance / max(1e-300, float(np.var(_left(decay, found))))
    return poles[np.argsort(np.abs(poles))], max(1.0, colour)


def _after(whole: Samples, reading: Reading) -> Samples:
    """Return what follows the release."""
    start = reading.onset_s + reading.release_s + reading.u_onset_s
    last = whole.time_s[len(whole.time_s) * 3 // 4]
    return whole.between(min(start, float(last)), np.inf)


def _rung(decay: Samples, modes: ComplexArray) -> Solution:
    """Return exponentials with free amplitudes fitted to a decay."""
    begin = float(decay.time_s[0]) - decay.step_s
    structure = Structure(len(modes), 0, 2 * len(modes), float(np.exp(np.mean(np.log(np.abs(modes))))))
    samples = in_blocks(decay, begin, begin, block_length(1.0 / decay.step_s, float(np.abs(modes).max()) / (2 * np.pi)))
    start = np.append(structure.vector(modes), begin)
    pinned = np.append(np.full(structure.order, np.inf), 1e-3 * decay.step_s)
    return solve(Problem(structure, Load("step", 1.0), samples, start, pinned), start)


def _with_another(decay: Samples, found: Solution) -> Solution | None:
    """Return the fit with one more mode, None where the decay does not support it."""
    rest = replace(decay, value=_left(decay, found))
    near = peaks_hz(rest.value, rest.step_s, 1, local=True)
    if not near.size:
        return None
    values, coarse = thinned(rest.value, rest.step_s, float(near[0]))
    extra = upper_poles(pencil(values - values.mean(), coarse, 3), 1, near)
    modes = np.concatenate([found.problem.structure.poles(found.vector), extra])
    modes = modes[np.argsort(np.abs(modes))]
    trial = _rung(decay, modes)
    zeta = trial.vector[len(modes) : 2 * len(modes)]
    gain = trial.size * float(np.log(_square(decay, found) / _square(decay, trial)))
    return trial if gain > 4 * CLEAR and np.all((zeta > 0) & (zeta < _STEEP)) else None


def _left(decay: Samples, found: Solution) -> FloatArray:
    """Return the residual (N,) at every sample."""
    return np.asarray(decay.value - design(found.problem, found.vector, decay) @ found.linear)


def _square(decay: Samples, found: Solution) -> float:
    rest = _left(decay, found)
    return float(rest @ rest)
