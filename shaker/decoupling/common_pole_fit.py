"""Model of all outputs over all loads from records of releases of every load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.decoupling.coloured_noise import (
    coloured_roots,
    converter_errors,
    converter_steps,
    noise_with_steps,
    whitening_filter,
    with_hum,
)
from shaker.decoupling.common_pole_search import (
    PoleCountTrial,
    add_first_lag,
    drop_weak_modes,
    equally_likely,
    select_pole_count,
    try_other_durations,
    try_other_shapes,
    without_superfluous,
)
from shaker.decoupling.model import MultiModel, Poles, growing_pole_notices, sort_components
from shaker.decoupling.release_problem import (
    SHAPE_NAMES,
    TIMES,
    PoleCandidate,
    PoleFit,
    ReleaseTiming,
    StepProblem,
    WhitenedRecord,
    by_record,
    covariances,
    fit_poles,
    lag_duration_prior,
    model_covariance,
    widen_for_lags,
)
from shaker.model_notices import (
    DOUBTFUL_MODE,
    DURATION_AMBIGUOUS,
    DURATION_UNLIKELY,
    FIT_NOT_CONVERGED,
    LAG_OR_RELEASE,
    RELEASE_MODEL_REJECTED,
    RELEASE_SHAPE_AMBIGUOUS,
    RELEASE_SHAPE_MISFIT,
    RELEASE_SIZE_SCATTER,
    RELEASE_TOO_SLOW,
    SINGLE_RELEASE,
)
from shaker.release.load_response import BlockMeans, average_blocks
from shaker.release.reading import initial_release
from shaker.release.record import UNCLEAR, ReleaseShape, StepRecord, highest_frequency, shared_poles
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.fitting import NORMAL_QUANTILE_95, excess_chi2_sigmas
from shakercal._common.notices import Notice

_PER_PERIOD = 6.0  # blocks per period of the highest significant frequency
_LEAST_BLOCKS = 1200  # per record, if it has as many samples
_MIN_DISTANCE = 2.0  # of different poles, in decay rates
_REST = 1.5  # durations of a release before its middle, from which the record is at rest
_AWAY = 8.0  # standard deviations of the noise from which an output is no longer at rest
_NEAR = 0.5  # gain of a step of a fit that is continued later, in variances
_BEFORE, _AFTER = 0.3, 2.0  # range of the search for the number of poles, in time constants of the slowest mode


def fit_steps(records: Sequence[StepRecord], most_modes: int | None = None, most_reals: int = 2) -> MultiFit:
    """Fit a model with common poles of all outputs and loads to releases.

    Parameters
    ----------
    records
        releases of every load; all have the same channels, unit and sampling rate
    most_modes
        highest number of modes, default None: no limit
    most_reals
        highest number of real poles, default 2

    Returns
    -------
    MultiFit : the model with its covariance, releases, trials and notices

    Raises
    ------
    ValueError : the records differ in channels, unit or rate, do not oscillate, or the outputs do not distinguish loads
        (named)

    Notes
    -----
    Output-error least squares over the common poles and every record's release, residues by projection. Numbers of
    modes and real poles are selected by the Schwarz criterion.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import StepRecord, fit_steps
    >>> time_s, rng = np.arange(1000) / 10e3 - 0.02, np.random.default_rng(0)
    >>> ring = [np.exp(-40.0 * time_s) * np.cos(2 * np.pi * f * time_s) for f in (310.0, 400.0)]
    >>> gain = np.array([[0.2, 0.01], [0.005, 0.15]])  # V/N of both outputs for both loads
    >>> records = []
    >>> for k, load in enumerate(("Fx", "Fy")):  # 10 N along x, then along y, are taken off
    ...     volts = 10.0 * gain[:, k, None] * np.where(time_s < 0.0, 1.0, ring[k]) + 1e-3 * rng.normal(size=(2, 1000))
    ...     records.append(StepRecord(load, ("Fx", "Fy"), "V", volts, 10e3, load, -10.0))
    >>> found = fit_steps(records, most_modes=2, most_reals=0)
    >>> print(np.sort(found.model.frequency_hz).round())
    [310. 400.]
    """
    if not records:
        raise ValueError("records: expected at least one, found none")
    first = records[0]
    for other in records:
        for key in ("channels", "unit", "sample_rate_hz"):
            actual, expected = getattr(other, key), getattr(first, key)
            if actual != expected:
                difference = f"expected {key} {expected} as in {first.name}, found {actual} in {other.name}"
                raise ValueError(f"records: {difference}")
    releases = []
    for raw in records:
        middle_s, duration_s, shape = initial_release(raw)
        releases.append(ReleaseTiming(middle_s, max(duration_s, 1.0 / raw.sample_rate_hz), shape))
    noise = _noise(records, releases)
    noise = noise_with_steps(noise, converter_steps(records))
    releases = _after_rest(records, releases, noise)
    problem, start = _posed(records, releases, noise)
    start = drop_weak_modes(problem, start, releases, most_modes)
    ends = [_selected(problem, one, most_modes, most_reals) for one in add_first_lag(problem, start, tuple(releases))]
    problem, near, fit, trials = min(ends, key=lambda end: end[2].loss / end[1].values)
    devices = _devices(records)
    fit, shapes = try_other_shapes(near, fit, devices)
    fit, durations = try_other_durations(near, without_superfluous(near, fit, most_modes))
    fit, others = fit_poles(problem, fit.poles, fit.releases, min_gain=_NEAR), [*durations, *shapes]
    refined_noise = noise * misfits(problem, fit)
    weighted = [
        replace(one, samples=replace(one.samples, value=one.samples.value * noise / refined_noise))
        for one in problem.records
    ]
    problem = replace(problem, records=tuple(weighted))
    fit = without_superfluous(problem, fit_poles(problem, fit.poles, fit.releases), most_modes)
    fit, likely = equally_likely(problem, fit, others)
    return multi_fit(records, problem, (fit, *likely), (noise, refined_noise), tuple(trials))


def _selected(
    problem: StepProblem, candidate: PoleCandidate, most_modes: int | None, most_reals: int
) -> tuple[StepProblem, StepProblem, PoleFit, list[PoleCountTrial]]:
    """Return problem with hum, its part near the releases, fit and trials."""
    problem, start = with_hum(problem, *candidate)
    lasts_s, cut = 1.0 / float(np.min(-start.values.real)), []
    for record, release in zip(problem.records, candidate[1], strict=True):
        before_s, after_s = release.duration_s + _BEFORE * lasts_s, release.duration_s + _AFTER * lasts_s
        cut.append(record.cut(release.middle_s - before_s, release.middle_s + after_s))
    near = replace(problem, records=tuple(cut))
    return problem, near, *select_pole_count(near, (start, candidate[1]), most_modes, most_reals)


def _devices(records: Sequence[StepRecord]) -> list[list[int]]:
    """Return the indices of the records by release device, else by load."""
    names = [record.release or record.component for record in records]
    return [[i for i, name in enumerate(names) if name == one] for one in dict.fromkeys(names)]


def _noise(records: Sequence[StepRecord], releases: Sequence[ReleaseTiming]) -> FloatArray:
    """Return the standard deviation of a sample (C,) before the releases."""
    sums, count = np.zeros(len(records[0].channels)), 0
    for record, release in zip(records, releases, strict=True):
        begin_s = release.middle_s - 0.5 * release.duration_s
        rest = record.samples[:, : max(8, int(0.9 * (begin_s - record.start_s) * record.sample_rate_hz))]
        sums += np.sum((rest - rest.mean(axis=1, keepdims=True)) ** 2, axis=1)
        count += rest.shape[1] - 1
    spans = np.max([np.ptp(record.samples, axis=1) for record in records], axis=0)
    return np.asarray(np.maximum(np.sqrt(sums / count), 1e-9 * spans.max()))


def _after_rest(
    records: Sequence[StepRecord], releases: Sequence[ReleaseTiming], noise: FloatArray
) -> list[ReleaseTiming]:
    """Return releases of which none is over while all outputs are still at rest.

    A first estimate may be wrong by a period of the ringing. It is replaced by the usual duration from the end of rest.
    """
    usual_s, moved = float(np.median([one.duration_s for one in releases])), []
    for record, release in zip(records, releases, strict=True):
        begin_s = release.middle_s - 0.5 * release.duration_s
        rest = record.samples[:, : max(8, int((begin_s - record.start_s) * record.sample_rate_hz))]
        away = np.any(np.abs(record.samples - rest.mean(axis=1, keepdims=True)) > _AWAY * noise[:, None], axis=0)
        end_s = record.start_s + float(np.argmax(away)) / record.sample_rate_hz
        late = release.middle_s + usual_s < end_s
        moved.append(replace(release, middle_s=end_s, duration_s=usual_s) if late else release)
    return moved


def _posed(
    records: Sequence[StepRecord], releases: Sequence[ReleaseTiming], noise: FloatArray
) -> tuple[StepProblem, Poles]:
    """Return the least-squares problem of block means, and start poles from the decays."""
    rate = records[0].sample_rate_hz
    decays = []
    for record, release in zip(records, releases, strict=True):
        end = release.middle_s + release.duration_s + 2.0 / rate
        rest = record.samples[:, int((end - record.start_s) * rate) :]
        level = rest[:, -max(8, rest.shape[1] // 5) :].mean(axis=1, keepdims=True)
        decays.append((rest - level) / noise[:, None])
    size = max(1, int(rate / (_PER_PERIOD * highest_frequency(decays, rate))))
    size = min(size, max(1, min(part.shape[1] for part in decays) // _LEAST_BLOCKS))
    sampled, rests = [], []
    for record, release in zip(records, releases, strict=True):
        data = average_blocks(record.samples, size).T / (noise / np.sqrt(size))
        time_s = record.start_s + np.arange(len(data)) * size / rate
        rests.append(data[: np.searchsorted(time_s, release.middle_s - _REST * release.duration_s)])
        samples = BlockMeans(time_s, np.full(len(data), size, dtype=np.int64), data, 1.0 / rate)
        sampled.append(WhitenedRecord(record.name, record.component, record.amplitude, samples))
    whitening = whitening_filter(rests)
    sampled = [replace(one, whitening=whitening) for one in sampled]
    sampled = [
        replace(one, samples=replace(one.samples, value=one.without_level(one.samples.value))) for one in sampled
    ]
    swings = _swings(
        [average_blocks(part, size) for part in decays], [record.component for record in records], rate / size
    )
    if not len(swings):
        raise ValueError("records: expected outputs that oscillate after the release, found none")
    poles = Poles(np.abs(swings) / (2 * np.pi), np.clip(-swings.real / np.abs(swings), 1e-4, 0.9), np.zeros(0))
    components = sort_components(record.component for record in records)
    return StepProblem(tuple(sampled), components), poles


def _swings(decays: Sequence[FloatArray], loads: Sequence[str], rate_hz: float) -> ComplexArray:
    """Return the poles of all decays together, and additional poles of each load's decays."""
    poles = shared_poles(decays, rate_hz)
    for load in dict.fromkeys(loads):
        selected = [part for part, component in zip(decays, loads, strict=True) if component == load]
        for pole in shared_poles(selected, rate_hz):
            if not np.any(np.abs(poles - pole) < _MIN_DISTANCE * np.maximum(-pole.real, -poles.real)):
                poles = np.append(poles, pole)
    return poles


# Result of a fit, in the units of the records.

REJECTED_FROM = 3.0
"""Residual over the noise at rest, rms, from which the records refute the model."""
_COLOURED = 2.0  # residual over the noise above which a notice is given
_ABOVE, _LINES = 1.5, 40  # highest frequency over the highest mode at which models are compared, and the number
_OTHER_LAG = 0.1  # relative difference of lags above which they are different
_SCATTERED = 3.0  # scatter of releases over their noise above which a notice is given


@dataclass(frozen=True, repr=False)
class ReleaseFit(Arrays):
    """One release: middle, duration and shape of the load change.

    In s with standard uncertainties. `gain`: size of the outputs over that of the model of all releases of its load,
    with `u_gain` of the noise. `misfit` (C,): standard deviation of the residual of each output over its noise.
    """

    record: str
    component: str
    release: str
    middle_s: float
    u_middle_s: float
    duration_s: float
    u_duration_s: float
    shape: ReleaseShape
    gain: float
    u_gain: float
    misfit: FloatArray


@dataclass(frozen=True, repr=False)
class ModeRank(Arrays):
    """Singular values of a mode's residues over their noise, and the number of significant ones.

    Rank one is a mode with one shape: fixed shares of outputs and loads. A higher rank is several modes that coincide.
    """

    singular: FloatArray
    rank: int


@dataclass(frozen=True, repr=False)
class MultiFit(Arrays):
    """A model of C outputs over D loads with the data of its fit.

    `noise` (C,): standard deviation of one sample of every output at `sample_rate_hz`. `amplitude` (D,): the largest
    change of each load in its records. `u_amplitude` (D,): relative uncertainty of its scale, including the scatter
    between releases. `variance_accounted` (D,): 1 - |residual|²/|data|² of each load's records over all outputs in
    units of their noise. `trials`: numbers of poles that were tried; `losses`: of the last search. `ranks`: of the
    residues of every mode, then of every real pole.
    """

    model: MultiModel
    noise: FloatArray
    sample_rate_hz: float
    amplitude: FloatArray
    u_amplitude: FloatArray
    releases: tuple[ReleaseFit, ...]
    variance_accounted: FloatArray
    trials: tuple[PoleCountTrial, ...]
    losses: tuple[float, ...]
    ranks: tuple[ModeRank, ...]
    notices: tuple[Notice, ...] = ()


def multi_fit(
    records: Sequence[StepRecord],
    problem: StepProblem,
    fits: tuple[PoleFit, ...],
    noises: tuple[FloatArray, FloatArray],
    trials: tuple[PoleCountTrial, ...],
) -> MultiFit:
    """Return the result of a fit in the units of the records.

    The first of `fits` is the result; the others are not rejected by the records and enter the covariance
    (`shakercal._common.fitting`). `noises`: (C,) of a sample at rest, and that of the weights. A model that the records
    refute has no uncertainties.
    """
    (fit, *others), (at_rest, noise) = fits, noises
    point, poles = fit.solution.point, fit.poles
    misfit = misfits(problem, fit)
    precision = lag_duration_prior(fit)
    spread, follows = covariances(point, [misfit**2] * len(point.blocks), precision)
    scaled = noise / np.sqrt(problem.records[0].samples.length[0])
    errors = [error / scaled for error in converter_errors(records, problem, fit)]
    coloured = coloured_roots(problem, fit, precision, errors)
    spread = widen_for_lags(fit, spread + coloured[0] @ coloured[0].T)
    model, *alternatives = (_model(records, problem, one, scaled) for one in fits)
    far = np.array([excess_chi2_sigmas(one.loss - fit.loss) for one in others]).reshape(-1, 1)
    shift = np.array([_difference(model, one) for one in alternatives]).reshape(-1, len(model.vector)) / far
    moved = [one.solution.point.parameters - point.parameters for one in others]
    later = np.array(moved).reshape(-1, len(spread)) / far
    releases = _releases(problem, records, fit, (spread + later.T @ later, noise / at_rest))
    rejected = _is_rejected(releases)
    shares = np.array([_scale_share(name, records, releases) for name in problem.components])
    for outputs, coefficients in zip(follows, point.coefficients, strict=True):
        for c, follow in enumerate(
            outputs
        ):  # coefficients of outputs with a smooth start, and the rotation of their basis
            outputs[c] = poles.smooth @ follow
            outputs[c][:, : poles.count] += (poles.smooth_slopes @ coefficients[:, c]).T
    elements = [follow for outputs in follows for follow in outputs]
    covariance, alone = model_covariance(model, spread, elements, np.tile(scaled, len(follows)), coloured)
    size = model.shared * len(model.channels)
    for d, share in enumerate(shares):  # all residues of a load share the uncertainty of its scale
        rows = slice(model.shared + d * size, model.shared + (d + 1) * size)
        covariance[rows, rows] += share**2 * np.outer(model.vector[rows], model.vector[rows])
    covariance += shift.T @ shift
    model = replace(model, covariance=np.full_like(covariance, np.nan) if rejected else covariance)
    data = [float(np.vdot(block.data, block.data)) + block.extra_squares for block in point.blocks]
    left = [
        float(np.vdot(rest, rest)) + block.extra_squares
        for block, rest in zip(point.blocks, point.residuals, strict=True)
    ]
    amplitude = [max(abs(r.amplitude) for r in records if r.component == name) for name in problem.components]
    return MultiFit(
        model=model,
        noise=noise * misfit,
        sample_rate_hz=records[0].sample_rate_hz,
        amplitude=np.array(amplitude),
        u_amplitude=shares,
        releases=releases,
        variance_accounted=1.0 - np.array(left) / np.array(data),
        trials=trials,
        losses=fit.solution.losses,
        ranks=mode_ranks(model, alone),
        notices=(*_notices(model, releases, fit), *_alternative_notices(problem, fit, others)),
    )


def _difference(model: MultiModel, other: MultiModel) -> FloatArray:
    """Return the change (P,) of a model's vector that gives another's responses to first order.

    Responses are not linear in the poles: the residues change so that they are met best.
    """
    n, highest = model.shared, float(max(model.frequency_hz.max(), other.frequency_hz.max()))
    poles = np.concatenate([one.vector[:n] for one in (other, model)]).reshape(2, n)
    lines = np.concatenate([np.zeros(1), np.geomspace(1e-2, _ABOVE, _LINES) * highest])
    change = other.response(lines) - model.response(lines)
    weight = 1.0 / np.sqrt(np.mean(np.abs(model.response(lines)) ** 2, axis=(1, 2)))
    basis, moved = model.common_poles.basis(lines) * weight[:, None], poles[0] - poles[1]
    whole = [moved]
    unit = np.concatenate([np.ones(2 * len(model.frequency_hz)), 1.0 / model.real_hz])  # of poles in Hz
    for d, c in np.ndindex(len(model.components), len(model.channels)):
        residues = np.concatenate([model.residue[:, c, d], model.real_residue[:, c, d]])
        slope = model.common_poles.response_slopes(lines, residues) * unit
        left = (change[:, c, d] - slope @ moved) * weight
        both = [np.concatenate([part.real, part.imag]) for part in (basis, left)]
        whole.append(np.linalg.lstsq(both[0], both[1], rcond=None)[0])
    return np.concatenate(whole)


def _model(records: Sequence[StepRecord], problem: StepProblem, fit: PoleFit, scaled: FloatArray) -> MultiModel:
    """Return the model of a fit; `scaled` (C,) was the weight."""
    parts = [fit.poles.smooth @ coefficients for coefficients in fit.solution.point.coefficients]
    table = np.stack(parts, axis=2) * scaled[:, None]
    return MultiModel.of_poles(fit.poles, table, (records[0].channels, problem.components), records[0].unit)


def misfits(problem: StepProblem, fit: PoleFit) -> FloatArray:
    """Return the standard deviation of each output's residual over its weight, all records together."""
    rests = np.concatenate([rest for _, rest in by_record(problem, fit)])
    free = sum(block.design.shape[1] for block in fit.solution.point.blocks)
    free += (fit.poles.count + sum(release.free for release in fit.releases)) / rests.shape[1]
    return np.asarray(np.sqrt(np.sum(rests**2, axis=0) / (len(rests) - free)))


def _releases(
    problem: StepProblem, records: Sequence[StepRecord], fit: PoleFit, scales: tuple[FloatArray, FloatArray]
) -> tuple[ReleaseFit, ...]:
    """Return the fitted release of every record, in the order of the records.

    `scales`: covariance of the parameters, and the weights over the noise at rest (C,).
    """
    spread, over = scales
    times = np.sqrt(np.diag(spread))[fit.poles.count :].reshape(-1, TIMES).tolist()
    rests, results = dict(by_record(problem, fit)), []
    for i, (record, release) in enumerate(zip(problem.records, fit.releases, strict=True)):
        data = record.samples.value
        fitted = data - rests[i]
        power = float(np.vdot(fitted, fitted))
        results.append(
            ReleaseFit(
                record=record.name,
                component=record.component,
                release=records[i].release,
                middle_s=release.middle_s,
                u_middle_s=times[i][0],
                duration_s=release.duration_s,
                u_duration_s=release.duration_s * times[i][1],
                shape=release.shape,
                gain=float(np.vdot(data, fitted)) / power,
                u_gain=1.0 / float(np.sqrt(power)),
                misfit=np.asarray(np.std(rests[i], axis=0) * over),
            )
        )
    return tuple(results)


def _is_rejected(releases: Sequence[ReleaseFit]) -> bool:
    """Return whether an output departs from the model in every release of a load."""
    loads = {one.component for one in releases}
    least = [np.min([one.misfit for one in releases if one.component == load], axis=0) for load in loads]
    return bool(np.max(least) > REJECTED_FROM)


def _scale_share(component: str, records: Sequence[StepRecord], releases: Sequence[ReleaseFit]) -> float:
    """Return the relative standard uncertainty of a load's scale, stated and from scatter."""
    stated = max(record.u_amplitude for record in records if record.component == component)
    members = [release for release in releases if release.component == component]
    if len(members) < 2:
        return stated
    beyond = float(np.var([release.gain for release in members], ddof=1) - np.mean([r.u_gain**2 for r in members]))
    return float(np.hypot(stated, np.sqrt(max(0.0, beyond) / len(members))))


def _notices(model: MultiModel, releases: Sequence[ReleaseFit], fit: PoleFit) -> tuple[Notice, ...]:
    """Return the notices of a fit."""
    notices = []
    if not fit.solution.converged:
        notices.append(Notice(FIT_NOT_CONVERGED, "model", model="the common poles"))
    notices += growing_pole_notices(model)
    for hz, zeta, u_zeta in zip(model.frequency_hz, model.damping_ratio, model.u.damping_ratio, strict=True):
        if u_zeta > UNCLEAR * abs(zeta):
            notices.append(Notice(DOUBTFUL_MODE, "model", frequency_hz=hz, damping_ratio=zeta, u_damping_ratio=u_zeta))
    for component in model.components:
        selected = [release for release in releases if release.component == component]
        shortest = min(release.duration_s for release in selected)
        if slow := ", ".join(f"{hz:.5g}" for hz in np.sort(model.frequency_hz) if hz * shortest > 1.0):
            notices.append(Notice(RELEASE_TOO_SLOW, component, frequencies=slow))
        if len(selected) < 2:
            notices.append(Notice(SINGLE_RELEASE, component, component=component))
            continue
        spread = float(np.std([r.gain for r in selected], ddof=1))
        chance = np.sqrt(np.mean([r.u_gain**2 for r in selected]))
        if spread > _SCATTERED * chance:
            notices.append(Notice(RELEASE_SIZE_SCATTER, component, count=len(selected), scatter_percent=100 * spread))
    assert model.covariance is not None
    if np.all(np.isnan(model.covariance)):
        factor = float(max(release.misfit.max() for release in releases))
        notices.append(Notice(RELEASE_MODEL_REJECTED, "model", factor=factor))
    for release in releases:
        worst = int(np.argmax(release.misfit))
        if release.misfit[worst] > _COLOURED:
            channel, factor = model.channels[worst], release.misfit[worst]
            notices.append(Notice(RELEASE_SHAPE_MISFIT, release.record, channel=channel, factor=factor))
    return tuple(notices)


def _alternative_notices(problem: StepProblem, fit: PoleFit, others: Sequence[PoleFit]) -> Iterator[Notice]:
    """Yield notices on other possible shapes or durations of releases, and lags."""
    for other in others:
        pairs, more = list(zip(other.releases, fit.releases, strict=True)), other.loss - fit.loss
        reshaped = [i for i, (one, best) in enumerate(pairs) if one.shape != best.shape]
        if reshaped:
            loads = ", ".join(dict.fromkeys(problem.records[i].component for i in reshaped))
            best, other_shape = (SHAPE_NAMES[pairs[reshaped[0]][k].shape] for k in (1, 0))
            yield Notice(RELEASE_SHAPE_AMBIGUOUS, "model", loads=loads, difference=more, shape=best, other=other_shape)
            continue
        lags = [np.sort(1e6 / (2.0 * np.pi * one.poles.real_hz)) for one in (fit, other)]
        if len(lags[0]) and any(best.shape == "exponential" for _, best in pairs):
            k = int(np.argmax(np.abs(np.log(lags[1] / lags[0]))))
            if abs(np.log(lags[1][k] / lags[0][k])) > _OTHER_LAG:
                yield Notice(LAG_OR_RELEASE, "model", lag_us=lags[0][k], other_us=lags[1][k], difference=more)
                continue
        i = int(np.argmax([abs(np.log(one.duration_s / best.duration_s)) for one, best in pairs]))
        record = problem.records[i]
        yield Notice(
            DURATION_AMBIGUOUS if more < NORMAL_QUANTILE_95**2 else DURATION_UNLIKELY,
            record.component,
            record=record.name,
            duration_ms=1e3 * pairs[i][1].duration_s,
            other_ms=1e3 * pairs[i][0].duration_s,
            difference=more,
        )


def mode_ranks(model: MultiModel, u: FloatArray) -> tuple[ModeRank, ...]:
    """Return the ranks of the residues of modes, then of real poles.

    `u` (P,) of the model's vector. The largest singular value of random residues over their u is about √C + √D, for
    complex ones √2 times that. A significant one is at least twice as large.
    """
    spread = model.parts(u)
    pairs: list[tuple[ComplexArray | FloatArray, FloatArray]] = [
        (value, np.hypot(part.real, part.imag)) for value, part in zip(model.residue, spread.residue, strict=True)
    ]
    pairs += list(zip(model.real_residue, spread.real_residue, strict=True))
    limit = 2.0 * (np.sqrt(len(model.channels)) + np.sqrt(len(model.components)))
    ranks = []
    for value, part in pairs:
        whole, rows, columns = (np.sqrt(np.mean(part**2, axis=axis)) for axis in (None, 1, 0))
        singular = np.linalg.svd(value * whole / np.outer(rows, columns), compute_uv=False)
        ranks.append(ModeRank(singular, max(1, int(np.count_nonzero(singular > limit)))))
    return tuple(ranks)
