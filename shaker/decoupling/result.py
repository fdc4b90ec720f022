"""The result of a fit to the records of all loads: model, covariance, what every release shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.decoupling.model import MultiModel, covariances
from shaker.decoupling.order import Fitted, Trial, check_separable
from shaker.decoupling.steps import Poles, Shape, StepProblem
from shaker.release.record import StepRecord

_COLOURED = 2.0
_SCATTERED = 3.0


@dataclass(frozen=True)
class ReleaseFit:
    """One release: when (middle) and how long the load changed, in s with standard uncertainties, and how it went.

    `gain`: size of the outputs over that of the model of all releases of its load, with `u_gain` of the noise; `misfit`
    (C,): standard deviation of the residual of each output over its noise.
    """

    record: str
    component: str
    release: str
    middle_s: float
    u_middle_s: float
    duration_s: float
    u_duration_s: float
    shape: Shape
    gain: float
    u_gain: float
    misfit: FloatArray


@dataclass(frozen=True)
class ModeRank:
    """Singular values of a mode's residues over their noise, and how many stand out of it.

    One is a mode with one shape, which moves outputs and takes up loads in fixed shares; more are modes that coincide.
    """

    singular: FloatArray
    rank: int


@dataclass(frozen=True)
class MultiFit:
    """A model of C outputs over D loads with what it was found from.

    `noise` (C,): standard deviation of one sample of every output at `sample_rate_hz`; `amplitude` (D,): the largest
    change of each load in its records, `u_amplitude` (D,): relative, of its scale, with the scatter between releases in
    it; `variance_accounted` (D,): 1 - |residual|²/|data|² of each load's records over all outputs in units of their
    noise; `trials`: numbers of poles that were tried; `losses`: of the last search;
    `ranks`: of the residues of every mode, then of every real pole.
    """

    model: MultiModel
    noise: FloatArray
    sample_rate_hz: float
    amplitude: FloatArray
    u_amplitude: FloatArray
    releases: tuple[ReleaseFit, ...]
    variance_accounted: FloatArray
    trials: tuple[Trial, ...]
    losses: tuple[float, ...]
    ranks: tuple[ModeRank, ...]
    notices: tuple[Notice, ...] = ()


def multi_fit(
    records: Sequence[StepRecord],
    problem: StepProblem,
    found: Fitted,
    noise: FloatArray,
    trials: tuple[Trial, ...],
) -> MultiFit:
    """Return the result of a fit in the units of the records; `noise` (C,) of a sample weighted the outputs."""
    solution, poles = found.solution, found.poles
    spread, follows = covariances(solution, [misfits(found, len(noise)) ** 2] * len(solution.blocks))
    scaled = noise / np.sqrt(problem.records[0].blocks.size)
    releases = _releases(problem, records, found, spread)
    shares = np.array([_scale_share(name, records, releases) for name in problem.components])
    whole = [poles.smooth @ own for own in solution.projected.coefficients]
    follows = [
        [_whole(poles, follow, own[:, c]) for c, follow in enumerate(outputs)]
        for outputs, own in zip(follows, solution.projected.coefficients, strict=True)
    ]
    model = _model(records[0], problem.components, poles, whole, scaled)
    covariance, alone = _covariance(model, spread, follows, scaled)
    covariance += _of_scale(model, shares)
    check_separable(model.static_gain, model.channels, model.components)
    data = [float(np.vdot(block.data, block.data)) for block in solution.blocks]
    left = [float(np.vdot(rest, rest)) for rest in solution.projected.residuals]
    amplitude = [max(abs(r.amplitude) for r in records if r.component == name) for name in problem.components]
    return MultiFit(
        model=replace(model, covariance=covariance),
        noise=noise * misfits(found, len(noise)),
        sample_rate_hz=records[0].sample_rate_hz,
        amplitude=np.array(amplitude),
        u_amplitude=shares,
        releases=releases,
        variance_accounted=1.0 - np.array(left) / np.array(data),
        trials=trials,
        losses=solution.losses,
        ranks=mode_ranks(model, alone),
        notices=_notices(model, releases, found),
    )


def misfits(found: Fitted, outputs: int) -> FloatArray:
    """Return the standard deviation of the residual of each output over its weight, all records together."""
    rests = np.concatenate(found.solution.projected.residuals)
    free = sum(block.design.shape[1] for block in found.solution.blocks)
    free += (found.poles.count + 2 * len(found.releases)) / outputs
    return np.asarray(np.sqrt(np.sum(rests**2, axis=0) / (len(rests) - free)))


def _whole(poles: Poles, follow: FloatArray, own: FloatArray) -> FloatArray:
    """How all coefficients follow the parameters (2M + Q, P + B) from how those `own` (B,) that start smoothly do."""
    found = poles.smooth @ follow
    found[:, : poles.count] += (poles.smooth_slopes @ own).T
    return np.asarray(found)


def _model(
    record: StepRecord,
    components: tuple[str, ...],
    poles: Poles,
    coefficients: Sequence[FloatArray],
    scaled: FloatArray,
) -> MultiModel:
    """The model of poles and coefficients (2M + Q, C) in units of the noise, load after load."""
    table = np.stack(coefficients, axis=2) * scaled[:, None]
    re, im, real = np.split(table, [poles.modes, 2 * poles.modes])
    return MultiModel(
        channels=record.channels,
        components=components,
        unit=record.unit,
        frequency_hz=poles.frequency_hz,
        damping_ratio=poles.damping_ratio,
        residue=re + 1j * im,
        real_hz=poles.real_hz,
        real_residue=real,
    )


def _covariance(
    model: MultiModel, spread: FloatArray, follows: Sequence[Sequence[FloatArray]], scaled: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance of the model's vector from that of poles and releases and how the coefficients follow them.

    Beside it the standard uncertainties by the noise of each element alone, 0 for the poles.
    """
    count, n = len(model.vector), model.shared
    rows, own = np.zeros((count, len(spread))), np.zeros((count, count))
    rows[:n, :n] = np.eye(n)
    place = n
    for outputs in follows:
        for follow, size in zip(outputs, scaled, strict=True):
            here = slice(place, place + n)
            rows[here] = size * follow[:, : len(spread)]
            own[here, here] = size**2 * follow[:, len(spread) :] @ follow[:, len(spread) :].T
            place += n
    return np.asarray(rows @ spread @ rows.T + own), np.asarray(np.sqrt(np.diag(own)))


def _of_scale(model: MultiModel, shares: FloatArray) -> FloatArray:
    """Covariance by the relative uncertainty (D,) of each load's scale, which all residues of its column share."""
    vector, found = model.vector, np.zeros((len(model.vector),) * 2)
    size = model.shared * len(model.channels)
    for d, share in enumerate(shares):
        here = slice(model.shared + d * size, model.shared + (d + 1) * size)
        found[here, here] = share**2 * np.outer(vector[here], vector[here])
    return found


def _releases(
    problem: StepProblem, records: Sequence[StepRecord], found: Fitted, spread: FloatArray
) -> tuple[ReleaseFit, ...]:
    """What every record shows of its release, in the order of the records."""
    times = np.sqrt(np.diag(spread))[found.poles.count :].reshape(-1, 2)
    results: dict[int, ReleaseFit] = {}
    for d, component in enumerate(problem.components):
        row = 0
        block, rest = found.solution.blocks[d], found.solution.projected.residuals[d]
        for i, record in enumerate(problem.records):
            if record.component != component:
                continue
            rows = slice(row, row + record.blocks.count)
            data, release = block.data[rows], found.releases[i]
            fitted, row = data - rest[rows], rows.stop
            power = float(np.vdot(fitted, fitted))
            results[i] = ReleaseFit(
                record=record.name,
                component=component,
                release=records[i].release,
                middle_s=release.middle_s,
                u_middle_s=float(times[i, 0]),
                duration_s=release.duration_s,
                u_duration_s=float(times[i, 1]) if release.free else 0.0,
                shape=release.shape,
                gain=float(np.vdot(data, fitted)) / power,
                u_gain=1.0 / float(np.sqrt(power)),
                misfit=np.asarray(np.std(rest[rows], axis=0)),
            )
    return tuple(results[i] for i in range(len(problem.records)))


def _scale_share(component: str, records: Sequence[StepRecord], releases: Sequence[ReleaseFit]) -> float:
    """Relative standard uncertainty of a load's scale: as stated, and what its releases scatter by beyond the noise."""
    stated = max(record.u_amplitude for record in records if record.component == component)
    own = [release for release in releases if release.component == component]
    if len(own) < 2:
        return stated
    beyond = float(np.var([release.gain for release in own], ddof=1) - np.mean([r.u_gain**2 for r in own]))
    return float(np.hypot(stated, np.sqrt(max(0.0, beyond) / len(own))))


def _notices(model: MultiModel, releases: Sequence[ReleaseFit], found: Fitted) -> tuple[Notice, ...]:
    """What the user should know of the fit."""
    told = []
    if not found.solution.converged:
        told.append(Notice("warning", "the fit did not come to rest: its poles may be off", "model"))
    if not model.stable:
        told.append(Notice("warning", "the model has a pole that grows", "model"))
    for component in model.components:
        own = [release for release in releases if release.component == component]
        if len(own) < 2:
            text = f"one release of {component}: what another would change is not in U"
            told.append(Notice("info", text, component))
            continue
        spread, chance = np.std([r.gain for r in own], ddof=1), np.sqrt(np.mean([r.u_gain**2 for r in own]))
        if spread > _SCATTERED * chance:
            text = f"sizes of the {len(own)} releases scatter by {100 * spread:.2g} %, which is in U"
            told.append(Notice("info", text, component))
    for release in releases:
        worst = int(np.argmax(release.misfit))
        if release.misfit[worst] > _COLOURED:
            text = (
                f"the model leaves {release.misfit[worst]:.1f} times the noise of {model.channels[worst]}: "
                f"the load may go otherwise than along a line or half a cosine"
            )
            told.append(Notice("warning", text, release.record))
    return tuple(told)


def mode_ranks(model: MultiModel, u: FloatArray) -> tuple[ModeRank, ...]:
    """Return the ranks of the residues of every mode, then of every real pole; `u` (P,) of the model's vector.

    Of residues over standard uncertainties that are chance the largest singular value is about √C + √D, for complex
    ones √2 times that; one that stands out is twice that size.
    """
    spread = model.parts(u)
    pairs: list[tuple[ComplexArray | FloatArray, FloatArray]] = [
        (value, np.hypot(part.real, part.imag)) for value, part in zip(model.residue, spread.residue, strict=True)
    ]
    pairs += list(zip(model.real_residue, spread.real_residue, strict=True))
    limit = 2.0 * (np.sqrt(len(model.channels)) + np.sqrt(len(model.components)))
    found = []
    for value, part in pairs:
        whole, rows, columns = (np.sqrt(np.mean(part**2, axis=axis)) for axis in (None, 1, 0))
        singular = np.linalg.svd(value * whole / np.outer(rows, columns), compute_uv=False)
        found.append(ModeRank(singular, max(1, int(np.count_nonzero(singular > limit)))))
    return tuple(found)
