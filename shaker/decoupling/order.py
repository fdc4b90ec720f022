"""How many common poles, and which of them a load excites."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray
from shaker.decoupling.model import Block, Projected, Solution, minimise, project
from shaker.decoupling.steps import Poles, Release, Shape, StepProblem, decay_start, shared_poles
from shaker.labels import LOAD_COMPONENTS

# Whether loads were excited, and whether the outputs tell them apart.


_SEPARATE = 1e-3


def in_order(components: Iterable[str]) -> tuple[str, ...]:
    """Return the load components that occur, once each, Fx first."""
    named = dict.fromkeys(components)
    return tuple(
        sorted(
            named,
            key=lambda name: (LOAD_COMPONENTS.index(name) if name in LOAD_COMPONENTS else len(LOAD_COMPONENTS), name),
        )
    )


def missing_loads(
    channels: Sequence[str], components: Sequence[str], static_sensitivity: FloatArray | None = None
) -> tuple[str, ...]:
    """Return the loads that a sensor measures and no record or response excites.

    It measures those that its outputs are named after, and those of which `static_sensitivity` (C, 6) holds a number
    other than 0.
    """
    named = {name for name in LOAD_COMPONENTS if name in channels}
    if static_sensitivity is not None:
        named |= {name for name, column in zip(LOAD_COMPONENTS, static_sensitivity.T, strict=True) if np.any(column)}
    return tuple(name for name in LOAD_COMPONENTS if name in named and name not in components)


def check_separable(static_gain: FloatArray, channels: Sequence[str], components: Sequence[str]) -> None:
    """Raise `ValueError` with the loads (D,) that outputs of a static matrix (C, D) do not tell apart.

    Columns are compared by direction: the smallest singular value of the matrix of unit columns must reach 0.001.
    """
    if len(channels) < len(components):
        raise ValueError(
            f"channels: expected at least as many as loads, {len(components)} ({', '.join(components)}), "
            f"found {len(channels)}"
        )
    size = np.linalg.norm(static_gain, axis=0)
    silent = [name for name, value in zip(components, size, strict=True) if not value > 0]
    if silent:
        raise ValueError(f"components: expected loads that move an output, found none for {', '.join(silent)}")
    _, singular, right = np.linalg.svd(static_gain / size)
    if singular[-1] < _SEPARATE:
        mixed = [name for name, share in zip(components, np.abs(right[-1]), strict=True) if share > 0.3]
        raise ValueError(f"components: expected loads that the outputs tell apart, found {' and '.join(mixed)} alike")


# Common poles of many frequency responses by vector fitting, as a start for least squares.


_ROUNDS = 12
_START_DAMPING = 0.01


def response_basis(poles: Poles, frequency_hz: FloatArray) -> ComplexArray:
    """Return what Re and Im of the residues and the real residues multiply, (K, 2M + Q), at frequencies (K,) in Hz."""
    s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
    upper, real = np.split(poles.values, [poles.modes])
    above, below = 1 / (s - upper), 1 / (s - upper.conj())
    return np.concatenate([above + below, 1j * (above - below), 1 / (s - real)], axis=1)


def fitted_poles(
    frequency_hz: FloatArray, responses: Sequence[ComplexArray], weights: Sequence[FloatArray], modes: int
) -> Poles:
    """Return poles that responses (K,) with weights (K,) share, `modes` pairs to start with.

    h·σ = Σ r/(s - a), σ = 1 + Σ d/(s - a) is linear in r and d, and the zeros of σ are better poles than a; repeated
    (Gustavsen and Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052), with r eliminated response by response
    (Deschrijver and others, IEEE Microw. Wirel. Compon. Lett. 18 (2008) 383). Poles that would grow are reflected.
    """
    low, high = float(np.min(frequency_hz[frequency_hz > 0])), float(np.max(frequency_hz))
    inside = np.linspace(low, high, modes + 2)[1:-1]
    poles = Poles(inside, np.full(modes, _START_DAMPING), np.zeros(0))
    for _ in range(_ROUNDS):
        unit = 1.0 / np.linalg.norm(response_basis(poles, frequency_hz), axis=0)
        basis = response_basis(poles, frequency_hz) * unit
        rows, right = [], []
        for response, weight in zip(responses, weights, strict=True):
            both = np.concatenate([basis, -response[:, None] * basis, response[:, None]], axis=1) * weight[:, None]
            _, triangle = np.linalg.qr(np.concatenate([both.real, both.imag]))
            kept = triangle[poles.count : 2 * poles.count]
            rows.append(kept[:, poles.count : -1])
            right.append(kept[:, -1])
        own = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0] * unit
        poles = _zeros(poles, own)
    return poles


def _zeros(poles: Poles, own: FloatArray) -> Poles:
    """Zeros of 1 + Σ d/(s - a) in the left half plane: eigenvalues of diag(a) - 1·d in real form."""
    m, q = poles.modes, len(poles.real_hz)
    upper, real = np.split(poles.values, [m])
    size = 2 * m + q
    table, ones = np.zeros((size, size)), np.zeros(size)
    for i, pole in enumerate(upper):
        table[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
        ones[2 * i] = 2.0
    table[2 * m :, 2 * m :] = np.diag(real.real)
    ones[2 * m :] = 1.0
    row = np.concatenate([np.stack([own[:m], own[m : 2 * m]], axis=1).ravel(), own[2 * m :]])
    found = np.linalg.eigvals(table - np.outer(ones, row))
    pairs = found[found.imag > 1e-9 * np.abs(found)]
    alone = np.abs(found[np.abs(found.imag) <= 1e-9 * np.abs(found)].real)
    damping = np.clip(np.abs(pairs.real) / np.abs(pairs), 1e-5, 0.69)
    return Poles(np.abs(pairs) / (2 * np.pi), damping, np.maximum(alone, 1e-3) / (2 * np.pi))


# How many poles records of several releases ask for.


_CANDIDATES = 3
_FEW_STEPS = 12
_ROUGH = 2.0
_ALONG_A_VALLEY = (40, 0.1)
"""Steps and calm for a lag, which nearly does what a later and longer release does."""
_AS_LONG = (1.25, 1.35, 1.45, 1.55)
"""Durations of half a cosine over that of a line that does nearly the same: 1.33 by spread, more for fast modes."""
_REAL_SHARES = (0.3, 1.0, 3.0)
_HIGHEST_REAL = 0.45
_TOLD_SAMPLES = 2.0
_LONGER = (0.5, 2.0)
_UNEXPLAINED = 1.5
_CLEARLY = 10.0
_OTHERWISE = (0.75, 1.4)
_STRONG = 0.1
"""A mode above this share of the strongest is no make-up for releases read some hundredths of a period off."""


Offer = tuple[Poles, tuple[Release, ...]]


@dataclass(frozen=True)
class Trial:
    """One number of poles that was tried: `misfit` is the mean square residual over that of the noise, `criterion`
    N·ln(misfit) + ln(N)·(number of parameters), of which the least wins (Schwarz, Ann. Statist. 6 (1978) 461)."""

    modes: int
    reals: int
    misfit: float
    criterion: float
    kept: bool


@dataclass(frozen=True)
class Fitted:
    """Poles and releases with the least squares solution they come from."""

    poles: Poles
    releases: tuple[Release, ...]
    solution: Solution


def fit_poles(
    problem: StepProblem, poles: Poles, releases: Sequence[Release], steps: int = 40, calm: float = 1e-2
) -> Fitted:
    """Return the least squares poles and releases from a start, by at most `steps` steps or till one gains `calm`."""

    def blocks_at(vector: FloatArray) -> list[Block] | None:
        parts = problem.split(vector, poles, releases)
        return None if parts is None else problem.blocks(*parts)

    solution = minimise(blocks_at, problem.vector(poles, releases), problem.scale(poles), steps, calm)
    found = problem.split(solution.parameters, poles, releases)
    if found is None:
        raise ValueError("poles: expected allowed ones at the end of a fit, found none")
    return Fitted(*found, solution)


def chosen(
    problem: StepProblem, start: Poles, releases: Sequence[Release], most: int | None, reals: int
) -> tuple[Fitted, list[Trial]]:
    """Return the fit with the number of poles that the criterion favours, and what was tried.

    Modes that the start offers and the records do not ask for are left out one by one; then modes that the residual
    shows, and real poles, are added as long as the criterion falls. `most`, `reals`: the highest numbers of modes and
    of real poles.
    """
    poles = needed(problem, start, releases, most)
    here = fit_poles(problem, poles, releases, _FEW_STEPS, _ROUGH)
    trials = [_trial(problem, here, kept=True)]
    for _ in range(_ROUNDS):
        smaller = _smaller(problem, here, most)
        larger = None if smaller is not None else _larger(problem, here, most, reals)
        found = smaller or larger
        if found is None:
            break
        trials.append(_trial(problem, found, kept=True))
        if trials[-1].criterion >= _trial(problem, here, kept=True).criterion:
            trials[-1] = replace(trials[-1], kept=False)
            break
        here = found
    return here, trials


def shaped(problem: StepProblem, found: Fitted) -> Fitted:
    """Return the fit in which each release goes along a line or half a cosine, whichever leaves clearly less."""
    releases = list(found.releases)
    for i, release in enumerate(found.releases):
        if release.duration_s * problem.records[i].blocks.rate_hz > _TOLD_SAMPLES:
            releases[i] = _better_shape(problem, found.poles, found.releases, i)
    if releases == list(found.releases):
        return found
    return fit_poles(problem, found.poles, releases, _FEW_STEPS, _ROUGH)


def otherwise(problem: StepProblem, found: Fitted) -> Fitted:
    """The fit from shorter or longer releases of each load, where these leave less: the least of several minima."""
    releases = list(found.releases)
    for component in problem.components:
        places = [i for i, record in enumerate(problem.records) if record.component == component]
        if not any(releases[i].free for i in places):
            continue
        part = StepProblem(tuple(problem.records[i] for i in places), (component,))
        here = _timed(part, found.poles, [releases[i] for i in places])
        for by in _OTHERWISE:
            scaled = [replace(releases[i], duration_s=by * found.releases[i].duration_s) for i in places]
            there = _timed(part, found.poles, scaled)
            here = min(here, there, key=lambda pair: pair[0])
        for i, release in zip(places, here[1], strict=True):
            releases[i] = release
    other = fit_poles(problem, found.poles, releases, _FEW_STEPS, _ROUGH)
    return min(found, other, key=lambda fitted: fitted.solution.projected.loss)


def _timed(problem: StepProblem, poles: Poles, releases: Sequence[Release]) -> tuple[float, tuple[Release, ...]]:
    """The loss and the best times of releases where the poles are known."""

    def split(times: FloatArray) -> tuple[Release, ...]:
        parts = problem.split(np.concatenate([poles.vector, times]), poles, releases)
        return tuple(releases) if parts is None else parts[1]

    def blocks_at(times: FloatArray) -> list[Block]:
        blocks = problem.blocks(poles, split(times))
        count = poles.count
        return [
            replace(block, slopes=tuple(replace(s, place=s.place - count) for s in block.slopes if s.place >= count))
            for block in blocks
        ]

    scale = np.full(2 * len(releases), 1.0 / problem.records[0].blocks.rate_hz)
    start = problem.vector(poles, releases)[poles.count :]
    found = minimise(blocks_at, start, scale, _FEW_STEPS, _ROUGH)
    return found.projected.loss, split(found.parameters)


def _begun(problem: StepProblem, poles: Poles, release: Release, place: int) -> Release:
    """A release by its record alone, poles held: the best of both shapes, from shorter and longer ones
    too where the record is not explained."""
    part = StepProblem((problem.records[place],), (problem.records[place].component,))

    def search(start: Release) -> tuple[float, Release]:
        loss, (moved,) = _timed(part, poles, [start])
        return loss, moved

    shapes: tuple[Shape, ...] = ("ramp", "smooth")
    best = min((search(replace(release, shape=shape)) for shape in shapes), key=lambda pair: pair[0])
    if best[0] < _UNEXPLAINED * part.values:
        return best[1]
    others = [replace(release, shape=shape, duration_s=by * release.duration_s) for shape in shapes for by in _LONGER]
    return min((best, *(search(start) for start in others)), key=lambda pair: pair[0])[1]


def _better_shape(problem: StepProblem, poles: Poles, releases: Sequence[Release], place: int) -> Release:
    """One release, or the same in the other shape, with its best duration, where that leaves clearly less."""
    component = problem.records[place].component
    near = [i for i, record in enumerate(problem.records) if record.component == component]
    part = StepProblem(tuple(problem.records[i] for i in near), (component,))
    own = releases[place]
    other: Shape = "smooth" if own.shape == "ramp" else "ramp"
    tried = [own]
    for ratio in _AS_LONG:
        duration_s = own.duration_s * (ratio if other == "smooth" else 1.0 / ratio)
        tried.append(replace(own, shape=other, duration_s=duration_s))

    def loss(release: Release) -> float:
        return _loss(part, poles, [release if i == place else releases[i] for i in near])

    losses = [loss(release) for release in tried]
    best = int(np.argmin(losses))
    return tried[best] if losses[best] < losses[0] - _CLEARLY else own


def _loss(problem: StepProblem, poles: Poles, releases: Sequence[Release]) -> float:
    """Sum of squares that the best residues leave."""
    blocks = problem.blocks(poles, releases, slopes=False)
    return project(blocks, poles.count + 2 * len(releases)).loss


def criterion(problem: StepProblem, poles: Poles, loss: float) -> float:
    """Return N·ln(loss/N) + ln(N)·(number of parameters): a lag adds its corner alone, its residues follow."""
    count, outputs, loads = problem.values, problem.records[0].data.shape[1], len(problem.components)
    parameters = 2 * poles.modes * (1 + outputs * loads) + len(poles.real_hz)
    return float(count * np.log(max(loss / count, 1e-12)) + np.log(count) * parameters)


def _trial(problem: StepProblem, fitted: Fitted, *, kept: bool) -> Trial:
    """The entry of one fit in the list of trials."""
    loss, poles = fitted.solution.projected.loss, fitted.poles
    value = criterion(problem, poles, loss)
    return Trial(poles.modes, len(poles.real_hz), loss / problem.values, value, kept)


def removal_losses(poles: Poles, blocks: Sequence[Block], projected: Projected) -> FloatArray:
    """Return how much the loss grows without each pole (M + Q,), the others held: b'·[(A'A)⁻¹ of its columns]⁻¹·b."""
    count = poles.modes + len(poles.real_hz)
    found = np.zeros(count)
    for block, own in zip(blocks, projected.coefficients, strict=True):
        whole = poles.smooth @ own
        inverse = np.linalg.pinv(block.design.T @ block.design, rcond=1e-14, hermitian=True)
        inverse = poles.smooth @ inverse @ poles.smooth.T
        for place in range(count):
            columns = poles.columns(place)
            part = np.linalg.pinv(inverse[np.ix_(columns, columns)], hermitian=True)
            found[place] += float(np.einsum("bc,bd,dc->", whole[columns], part, whole[columns]))
    return found


def needed(problem: StepProblem, poles: Poles, releases: Sequence[Release], most: int | None) -> Poles:
    """Return a start without the modes that the criterion does not ask for, or that are beyond the highest number."""
    while poles.modes > 1:
        blocks = problem.blocks(poles, releases, slopes=False)
        projected = project(blocks, poles.count + 2 * len(releases))
        losses = removal_losses(poles, blocks, projected)[: poles.modes]
        weakest = int(np.argmin(losses))
        fewer = poles.without(weakest)
        falls = criterion(problem, fewer, projected.loss + losses[weakest]) < criterion(problem, poles, projected.loss)
        if not (falls or (most is not None and poles.modes > most)):
            break
        poles = fewer
    return poles


def _smaller(problem: StepProblem, here: Fitted, most: int | None) -> Fitted | None:
    """The fit without the weakest mode, None where the criterion needs all.

    What the other poles and the releases take over shows in a fit alone: a mode that makes up for a release begun
    elsewhere looks needed as long as that release is held.
    """
    poles = here.poles
    if poles.modes < 2 or (most is not None and poles.modes <= most):
        return None
    losses = removal_losses(poles, here.solution.blocks, here.solution.projected)[: poles.modes]
    weakest, loss = int(np.argmin(losses)), here.solution.projected.loss
    if losses[weakest] > _STRONG * losses.max():
        return None
    fewer = fit_poles(problem, poles.without(weakest), here.releases, _FEW_STEPS, _ROUGH)
    falls = criterion(problem, fewer.poles, fewer.solution.projected.loss) < criterion(problem, poles, loss)
    return fewer if falls else None


def _larger(problem: StepProblem, here: Fitted, most: int | None, reals: int) -> Fitted | None:
    """The fit with the mode or the real pole that lowers the loss most, None where the numbers are reached."""
    modes: list[Offer] = []
    if most is None or here.poles.modes < most:
        modes = [(here.poles.with_mode(complex(pole)), here.releases) for pole in _left(problem, here)]
    lags: list[Offer] = []
    if len(here.poles.real_hz) < reals:
        top = float(here.poles.frequency_hz.max())
        limit = _HIGHEST_REAL * problem.records[0].blocks.rate_hz
        lags = [(here.poles.with_real(min(share * top, limit)), here.releases) for share in _REAL_SHARES]
    tried = []
    for offers, steps, calm in ((modes, _FEW_STEPS, _ROUGH), (lags, *_ALONG_A_VALLEY)):
        if offers:
            losses = [_loss(problem, *offer) for offer in offers]
            fitted = fit_poles(problem, *offers[int(np.argmin(losses))], steps, calm)
            again = _again(problem, fitted)
            tried += [fitted] if again is None else [fitted, again]
    if not tried:
        return None
    return min(tried, key=lambda fitted: criterion(problem, fitted.poles, fitted.solution.projected.loss))


def _again(problem: StepProblem, here: Fitted) -> Fitted | None:
    """The fit with the releases found anew whose records it does not explain, None where it explains all."""
    releases = list(here.releases)
    for component, rest in zip(problem.components, here.solution.projected.residuals, strict=True):
        places = [i for i, record in enumerate(problem.records) if record.component == component]
        ends = np.cumsum([problem.records[i].blocks.count for i in places])[:-1]
        for i, rows in zip(places, np.split(rest, ends), strict=True):
            if float(np.mean(rows**2, axis=0).max()) > _UNEXPLAINED:
                releases[i] = _begun(problem, here.poles, releases[i], i)
    if releases == list(here.releases):
        return None
    return fit_poles(problem, here.poles, releases, _FEW_STEPS, _ROUGH)


def _left(problem: StepProblem, here: Fitted) -> ComplexArray:
    """Poles of what the fit leaves after the releases, load by load the slowest first."""
    rate = problem.records[0].blocks.rate_hz / problem.records[0].blocks.size
    found = []
    for component, rest in zip(problem.components, here.solution.projected.residuals, strict=True):
        parts, row = [], 0
        for record, release in zip(problem.records, here.releases, strict=True):
            if record.component == component:
                rows = rest[row : row + record.blocks.count]
                parts.append(rows[decay_start(record.blocks, release) :].T)
                row += record.blocks.count
        poles = shared_poles(parts, rate)
        found.append(poles[np.argsort(-poles.real)][:_CANDIDATES])
    return np.concatenate(found)
