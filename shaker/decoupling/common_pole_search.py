"""Number of common poles of several releases, and alternative times of the releases."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from shaker.decoupling.model import Poles
from shaker.decoupling.release_problem import PoleCandidate, PoleFit, ReleaseTiming, StepProblem, by_record, fit_poles
from shaker.release.record import ReleaseShape, shared_poles
from shakercal._common.arrays import FloatArray
from shakercal._common.fitting import REJECT_CHI2, SeparablePoint

_ROUNDS = 12  # changes of the number of poles, at most
_CANDIDATES = 3  # poles of a residual that are tried per load
_FEW_STEPS = 12  # of a fit near its minimum
_ROUGH = 2.0  # gain of a step of a comparison, in variances
_ALONG_A_VALLEY = (40, 0.1)  # steps and smallest gain for a lag, which acts almost like a later and longer release
_SHAPES: tuple[ReleaseShape, ...] = ("ramp", "smooth", "exponential", "stages")
_STAGES = (0.35, 0.5, 0.65)  # trial shares of the load in a first stage
_STAGES_PRICE = 1.03  # a loss without stages that is lower by more than this is no chance of imperfectly white noise
_EXPLAINED = 1.02  # mean square residual over the noise below which no further shape is tried
_LAGS = (1.5, 4.0, 10.0)  # trial first lags, in frequencies of the lowest mode
_HARDLY_RINGING = 0.15  # damping ratio from which a first mode is doubted
_ALMOST_STEP = 0.1  # duration over the median of all below which that of a fit is doubted
_SHORTEST = 0.3  # smallest remaining share of a release's duration after a trial lag
_REAL_SHARES = (0.3, 1.0, 3.0)  # trial further lags, in frequencies of the highest mode
_HIGHEST_REAL = 0.45  # share of the sampling rate
_RESOLVED_SAMPLES = 2.0  # duration below which the shape is not resolved
_LONGER = (0.5, 2.0)
_UNEXPLAINED = 1.5  # mean square residual over the noise
_DURATION_FACTORS = (0.75, 1.4)
_BELOW_NOISE = 0.8  # mean square residual over the noise at rest below which no further pole is needed
_HARDLY_MORE = 12.0  # excess loss for fixed poles above which no fit of all parameters is below `REJECT_CHI2`
_MIN_DIFFERENCE = 0.1  # relative, of different durations
_STRONG = 0.5
"""A mode above this share of the strongest does not merely compensate for an error of the release times."""

AlternativeTimes: TypeAlias = tuple[list[int], tuple[ReleaseTiming, ...]]
"""Indices of some records, and alternative times of their releases."""


@dataclass(frozen=True)
class PoleCountTrial:
    """One number of poles that was tried.

    `misfit`: mean square residual over that of the noise. `criterion`: N·ln(misfit) + ln(N)·(number of parameters), the
    least is selected (Schwarz, Ann. Statist. 6 (1978) 461).
    """

    modes: int
    reals: int
    misfit: float
    criterion: float
    accepted: bool


def add_first_lag(problem: StepProblem, poles: Poles, releases: tuple[ReleaseTiming, ...]) -> tuple[PoleCandidate, ...]:
    """Return the best poles with a first lag, and correspondingly earlier and shorter releases.

    A lag is always fitted: even one too fast to be observed changes the ringing, and a model without it claims too
    much. Where the best fit is far from the noise it may be a wrong one, and the best start without a fit is returned
    too.
    """
    offers, plain = list[tuple[float, PoleCandidate]](), list[tuple[float, PoleCandidate]]()

    def offer(lagged: Poles, moved: Sequence[ReleaseTiming]) -> None:
        times = []
        for i, one in enumerate(moved):
            shares = _STAGES if one.shape == "stages" else (one.share,)
            ends = [_timed(problem.part([i]), lagged, [replace(one, share=share)]) for share in shares]
            times.append(min(ends, key=lambda end: end.loss).releases[0])
        offers.append((problem.point(lagged, times).loss, (lagged, tuple(times))))

    starts = []
    for start in dict.fromkeys([poles, _ringing(poles)]):
        for share in _LAGS:
            hz = min(share * float(poles.frequency_hz.min()), 0.4 / problem.step_s)
            starts.append((start.with_real(hz), [*_lagged(releases, 1.0 / (2.0 * np.pi * hz))]))
    for shape in (None, *_SHAPES[-2:]):
        if min((loss for loss, _ in offers), default=np.inf) > _EXPLAINED * problem.values:
            for lagged, moved in starts:
                offer(lagged, moved if shape is None else [release.in_shape(shape) for release in moved])
            plain += offers[-len(starts) :]
            fit = fit_poles(problem, *min(offers[-len(starts) :], key=lambda pair: pair[0])[1], _FEW_STEPS, _ROUGH)
            # A lag and the time constant of an exponential are easily exchanged, and a fit may end at a duration of 0.
            for one in (fit, *_exchanged(problem, fit), *_without_steps(problem, fit)):
                offers.append((one.loss, (one.poles, one.releases)))
    best, first = (min(pairs, key=lambda pair: pair[0] * _price(pair[1][1][0].shape)) for pairs in (offers, plain))
    return (best[1],) if best is first or best[0] < _UNEXPLAINED * problem.values else (best[1], first[1])


def _lagged(releases: Sequence[ReleaseTiming], late_s: float) -> Iterator[ReleaseTiming]:
    """Yield releases that are earlier and shorter by a lag."""
    for one in releases:
        shorter = float(np.sqrt(max(1.0 - late_s**2 / one.moment_s2, _SHORTEST**2)))
        yield replace(one, middle_s=one.middle_s - late_s, duration_s=shorter * one.duration_s)


def _ringing(poles: Poles) -> Poles:
    """Return poles without modes that hardly ring.

    They may be a lag or a wrong release.
    """
    rings = poles.damping_ratio < _HARDLY_RINGING
    if np.all(rings) or not np.any(rings):
        return poles
    return Poles(poles.frequency_hz[rings], poles.damping_ratio[rings], poles.real_hz)


def _price(shape: ReleaseShape) -> float:
    """Return the factor on a loss by which a shape with further parameters is charged."""
    return _STAGES_PRICE if shape == "stages" else 1.0


def select_pole_count(
    problem: StepProblem, start: PoleCandidate, most: int | None, reals: int
) -> tuple[PoleFit, list[PoleCountTrial]]:
    """Return the fit with the number of poles that the criterion selects, and all trials."""
    fit = fit_poles(problem, drop_weak_modes(problem, *start, most), start[1], *_ALONG_A_VALLEY)

    def trial(fitted: PoleFit, accepted: bool) -> PoleCountTrial:
        poles, share = fitted.poles, fitted.loss / problem.values
        return PoleCountTrial(poles.modes, len(poles.real_hz), share, criterion(problem, poles, fitted.loss), accepted)

    trials = [trial(fit, True)]
    for _ in range(_ROUNDS):
        changed = _smaller(problem, fit, most) or _larger(problem, fit, most, reals)
        if changed is None:
            break
        trials.append(trial(changed, criterion(problem, changed.poles, changed.loss) < trials[-1].criterion))
        if not trials[-1].accepted:
            break
        fit = changed
    return fit, trials


def without_superfluous(problem: StepProblem, fit: PoleFit, most: int | None) -> PoleFit:
    """Return the fit without modes and further lags that its releases no longer need.

    A lag may have explained a release of a wrong shape or duration that was found later.
    """
    while (fewer := _smaller(problem, fit, most) or _fewer_lags(problem, fit)) is not None:
        fit = fewer
    return fit


def try_other_shapes(
    problem: StepProblem, fit: PoleFit, devices: Sequence[Sequence[int]]
) -> tuple[PoleFit, list[AlternativeTimes]]:
    """Return the fit with the best shape of each device's releases, and likely others.

    All releases by a device, given by the indices of their records, have one shape. Stages are tried if no other shape
    leaves noise alone.
    """
    releases, others = fit.releases, list[AlternativeTimes]()
    for indices in devices:
        if max(releases[i].duration_s for i in indices) < _RESOLVED_SAMPLES * problem.step_s:
            continue
        loads = {problem.records[i].component for i in indices}
        values = sum(record.samples.value.size for record in problem.records if record.component in loads)
        tried: list[tuple[float, tuple[ReleaseTiming, ...]]] = []
        for shape in _SHAPES:
            if shape == "stages" and min(end[0] for end in tried) < _EXPLAINED * values:
                continue
            starts = list(releases)
            for i in indices:
                starts[i] = starts[i] if starts[i].shape == shape else starts[i].in_shape(shape)
            tried.append(_best_times(problem, fit.poles, starts, indices))
        order = sorted(tried, key=lambda end: end[0] * _price(end[1][indices[0]].shape))
        releases = order[0][1]
        for loss, times in order[1:]:
            if loss < order[0][0] + _HARDLY_MORE and times[indices[0]].shape != "stages":
                others.append((list(indices), tuple(times[i] for i in indices)))
    if releases == fit.releases:
        return fit, others
    other = fit_poles(problem, fit.poles, releases, _FEW_STEPS, _ROUGH)
    return min(fit, other, key=lambda fitted: fitted.loss), others


def _best_times(
    problem: StepProblem, poles: Poles, releases: Sequence[ReleaseTiming], indices: Sequence[int]
) -> tuple[float, tuple[ReleaseTiming, ...]]:
    """Return loss and best times for fixed poles of the loads of some records."""
    times, total = list(releases), 0.0
    for component in dict.fromkeys(problem.records[i].component for i in indices):
        selected = problem.record_indices(component)
        end = _timed(problem.part(selected), poles, [times[i] for i in selected])
        total += end.loss
        for i, release in zip(selected, end.releases, strict=True):
            times[i] = release
    return total, tuple(times)


def try_other_durations(problem: StepProblem, fit: PoleFit) -> tuple[PoleFit, list[AlternativeTimes]]:
    """Return the fit from the best durations of each load's releases, and the alternatives.

    A release about as long as the period of a mode hardly excites it, and large residues compensate for a wrong
    duration.
    """
    releases, others = list(fit.releases), list[AlternativeTimes]()
    for component in problem.components:
        indices = problem.record_indices(component)
        part, current = problem.part(indices), tuple(fit.releases[i] for i in indices)
        tried = [[replace(one, duration_s=by * one.duration_s) for one in current] for by in _DURATION_FACTORS]
        loss = part.point(fit.poles, current).loss
        ends = [
            (end.loss, end.releases) for end in (_timed(part, fit.poles, one, loss + _HARDLY_MORE) for one in tried)
        ]
        ends = sorted([(loss - _ROUGH, current), *ends], key=lambda end: end[0])
        for i, release in zip(indices, ends[0][1], strict=True):
            releases[i] = release
        near = [times for loss, times in ends[1:] if loss < ends[0][0] + _HARDLY_MORE]
        others += [(indices, times) for times in near if _differs(problem, times, ends[0][1])]
    if tuple(releases) == fit.releases:
        return fit, others
    other = fit_poles(problem, fit.poles, releases, _FEW_STEPS, _ROUGH)
    return min(fit, other, key=lambda fitted: fitted.loss), others


def equally_likely(
    problem: StepProblem, fit: PoleFit, others: Sequence[AlternativeTimes]
) -> tuple[PoleFit, tuple[PoleFit, ...]]:
    """Return the best fit and the alternatives that are not rejected."""
    found = [fit]
    for indices, times in others:
        releases = list(fit.releases)
        for i, release in zip(indices, times, strict=True):
            releases[i] = release
        found.append(fit_poles(problem, fit.poles, releases))
    found += [other for one in sorted(found, key=_exponentials)[-1:] for other in _exchanged(problem, one)]
    found.sort(key=lambda fitted: fitted.loss)
    likely = found[:1]
    for one in found[1:]:
        if one.loss < likely[0].loss + REJECT_CHI2 and all(
            _differs(problem, one.releases, other.releases) for other in likely
        ):
            likely.append(one)
    return likely[0], tuple(likely[1:])


def _exponentials(fit: PoleFit) -> tuple[int, float]:
    """Return the number of exponential releases, then the negative loss."""
    return sum(release.shape == "exponential" for release in fit.releases), -fit.loss


def _exchanged(problem: StepProblem, fit: PoleFit) -> list[PoleFit]:
    """Return the fit with slowest lag and exponential releases exchanged, none without both.

    A sensor behind the lag 1/a answers a release with the time constant 1/b as one behind 1/b answers that with 1/a.
    Only releases of different time constants tell which belongs to the sensor.
    """
    if not len(fit.poles.real_hz) or all(release.shape != "exponential" for release in fit.releases):
        return []
    lag, late_s = int(np.argmin(fit.poles.real_hz)), float(np.median([np.sqrt(one.moment_s2) for one in fit.releases]))
    other_s, real_hz = 1.0 / (2.0 * np.pi * float(fit.poles.real_hz[lag])), fit.poles.real_hz.copy()
    real_hz[lag] = 1.0 / (2.0 * np.pi * late_s)
    releases = [ReleaseTiming(one.middle_s + other_s - late_s, 2.0 * other_s, "exponential") for one in fit.releases]
    return [fit_poles(problem, replace(fit.poles, real_hz=real_hz), releases)]


def _without_steps(problem: StepProblem, fit: PoleFit) -> list[PoleFit]:
    """Return the fit without releases much shorter than most, none if there are none."""
    usual_s = float(np.median([one.duration_s for one in fit.releases]))
    releases = [
        replace(one, duration_s=usual_s) if one.duration_s < _ALMOST_STEP * usual_s else one for one in fit.releases
    ]
    return [] if releases == list(fit.releases) else [fit_poles(problem, fit.poles, releases, _FEW_STEPS, _ROUGH)]


def _differs(problem: StepProblem, one: Sequence[ReleaseTiming], other: Sequence[ReleaseTiming]) -> bool:
    """Return whether some release has a clearly different duration, or another shape."""
    if any(a.shape != b.shape for a, b in zip(one, other, strict=True)):
        return True
    lengths = np.array([(a.duration_s, b.duration_s) for a, b in zip(one, other, strict=True)])
    return bool(np.any(np.ptp(lengths, axis=1) > np.maximum(_MIN_DIFFERENCE * lengths.max(axis=1), problem.step_s)))


def _timed(
    problem: StepProblem, poles: Poles, releases: Sequence[ReleaseTiming], target_loss: float = np.inf
) -> PoleFit:
    """Return the best times of releases for fixed poles, if the loss can reach `target_loss`."""
    return fit_poles(problem, poles, releases, _FEW_STEPS, _ROUGH, fixed_count=poles.count, target_loss=target_loss)


def _begun(part: StepProblem, poles: Poles, release: ReleaseTiming) -> ReleaseTiming:
    """Return the best release of one record for fixed poles, of both shapes."""
    ramp, smooth = replace(release, shape="ramp"), replace(release, shape="smooth")
    tried = [_timed(part, poles, [one]) for one in (ramp, smooth)]
    if min(end.loss for end in tried) >= _UNEXPLAINED * part.values:
        others = [replace(one, duration_s=by * one.duration_s) for one in (ramp, smooth) for by in _LONGER]
        tried += [_timed(part, poles, [one]) for one in others]
    return min(tried, key=lambda end: end.loss).releases[0]


def criterion(problem: StepProblem, poles: Poles, loss: float) -> float:
    """Return N·ln(loss/N) + ln(N)·(number of parameters); a lag has one.

    A loss far below that of the noise at rest counts no further.
    """
    count = problem.values
    return float(count * np.log(max(loss / count, _BELOW_NOISE)) + _charge(problem, poles))


def _charge(problem: StepProblem, poles: Poles) -> float:
    """Return the charge of the criterion for poles."""
    outputs, loads = problem.records[0].samples.value.shape[1], len(problem.components)
    parameters = 2 * poles.modes * (1 + outputs * loads) + len(poles.real_hz)
    return float(np.log(problem.values) * parameters)


def removal_losses(poles: Poles, point: SeparablePoint) -> FloatArray:
    """Return the growth of the loss without each pole (M + Q,), others fixed."""
    losses = np.zeros(poles.modes + len(poles.real_hz))
    for part in point.solved:
        whole, root = poles.smooth @ part.coefficients, poles.smooth @ part.root
        inverse = root @ root.T
        for index in range(len(losses)):
            columns = poles.columns(index)
            weight = np.linalg.pinv(inverse[np.ix_(columns, columns)], hermitian=True)
            losses[index] += float(np.einsum("bc,bd,dc->", whole[columns], weight, whole[columns]))
    return losses


def drop_weak_modes(problem: StepProblem, poles: Poles, releases: Sequence[ReleaseTiming], most: int | None) -> Poles:
    """Return a start without modes that the criterion rejects or that exceed the highest number."""
    while poles.modes > 1:
        point = problem.point(poles, releases)
        losses = removal_losses(poles, point)[: poles.modes]
        weakest = int(np.argmin(losses))
        fewer = poles.without(weakest)
        falls = criterion(problem, fewer, point.loss + losses[weakest]) < criterion(problem, poles, point.loss)
        if not (falls or (most is not None and poles.modes > most)):
            break
        poles = fewer
    return poles


def _smaller(problem: StepProblem, fit: PoleFit, most: int | None) -> PoleFit | None:
    """Return the fit without the weakest mode, None if the criterion needs all."""
    poles = fit.poles
    if poles.modes < 2 or (most is not None and poles.modes <= most):
        return None
    losses = removal_losses(poles, fit.solution.point)[: poles.modes]
    weakest = int(np.argmin(losses))
    if losses[weakest] > _STRONG * losses.max():
        return None
    return _without(problem, fit, weakest)


def _fewer_lags(problem: StepProblem, fit: PoleFit) -> PoleFit | None:
    """Return the fit without its fastest further lag, None if the criterion needs it."""
    if len(fit.poles.real_hz) < 2:
        return None
    return _without(problem, fit, fit.poles.modes + int(np.argmax(fit.poles.real_hz)))


def _without(problem: StepProblem, fit: PoleFit, index: int) -> PoleFit | None:
    """Return the fit without one pole, None if its criterion is not lower."""
    fewer, count = fit.poles.without(index), problem.values
    # The loss at which both criteria are equal.
    target_loss = count * float(np.exp((criterion(problem, fit.poles, fit.loss) - _charge(problem, fewer)) / count))
    fitted = fit_poles(problem, fewer, fit.releases, *_ALONG_A_VALLEY, target_loss=target_loss)
    return fitted if fitted.loss < target_loss else None


def _larger(problem: StepProblem, fit: PoleFit, most: int | None, reals: int) -> PoleFit | None:
    """Return the fit with the best additional mode or lag, None without one."""
    tried = []
    if (most is None or fit.poles.modes < most) and (mode := _left(problem, fit)) is not None:
        tried.append(fit_poles(problem, fit.poles.with_mode(mode), fit.releases, _FEW_STEPS, _ROUGH))
    if len(fit.poles.real_hz) < reals:
        top, limit = float(fit.poles.frequency_hz.max()), _HIGHEST_REAL / problem.step_s
        lags = [fit.poles.with_real(min(share * top, limit)) for share in _REAL_SHARES]
        lag = min(lags, key=lambda poles: problem.point(poles, fit.releases).loss)
        tried.append(fit_poles(problem, lag, fit.releases, *_ALONG_A_VALLEY))
    tried += [renewed for fitted in tried if (renewed := _with_new_releases(problem, fitted)) is not None]
    return min(tried, key=lambda fitted: criterion(problem, fitted.poles, fitted.loss), default=None)


def _with_new_releases(problem: StepProblem, fit: PoleFit) -> PoleFit | None:
    """Return the fit with new releases of unexplained records, None if all are explained."""
    releases = list(fit.releases)
    for i, rest in by_record(problem, fit):
        if float(np.mean(rest**2, axis=0).max()) > _UNEXPLAINED:
            releases[i] = _begun(problem.part([i]), fit.poles, releases[i])
    if tuple(releases) == fit.releases:
        return None
    return fit_poles(problem, fit.poles, releases, _FEW_STEPS, _ROUGH)


def _left(problem: StepProblem, fit: PoleFit) -> complex | None:
    """Return the pole that explains most of the residual after the releases, None without any."""
    samples = problem.records[0].samples
    rests, most, best = dict(by_record(problem, fit)), 0.0, None
    for component in problem.components:
        indices, parts = problem.record_indices(component), []
        part, releases = problem.part(indices), [fit.releases[i] for i in indices]
        for i in indices:
            end_s = fit.releases[i].middle_s + fit.releases[i].duration_s / 2.0
            parts.append(rests[i][np.searchsorted(problem.records[i].samples.time_s, end_s) :].T)
        poles = shared_poles(parts, 1.0 / (samples.step_s * int(samples.length[0])))
        loss = sum(float(np.vdot(rests[i], rests[i])) for i in indices)
        for pole in poles[np.argsort(-poles.real)][:_CANDIDATES].tolist():  # the slowest
            fall = loss - part.point(fit.poles.with_mode(pole), releases).loss
            if fall > most:
                most, best = fall, pole
    return best
