"""Model of a step response by output error, for every time course of the load."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from shaker.lti.system import LinearSystem, ModalModel
from shaker.model_notices import (
    LAG_NOT_ATTRIBUTED,
    RELEASE_SHAPE_UNDETERMINED,
    STATED_LAG_CONTRADICTED,
)
from shaker.release.amplitude_dependence import amplitude_dependence, distinct_modes
from shaker.release.load_response import ReleaseLoad, every_sample
from shaker.release.model_order import (
    OrderSearch,
    fit_notices,
    penalised_chi_squared,
    search_order,
)
from shaker.release.output_error import (
    OutputErrorFit,
    fit_covariance,
    modal_model,
)
from shaker.release.reading import read_release
from shaker.release.record import ReleaseReading, ReleaseShape, StepRecord
from shaker.release.shape_hypotheses import (
    HOPELESS,
    OtherHypothesis,
    alternatives,
    exchange_lags,
    release_is_slower,
    shape_chi_squared,
    with_both_lags,
    with_further_shapes,
)
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.digits import number_text
from shakercal._common.fitting import REJECT_CHI2
from shakercal._common.notices import Notice

# Result of an identification from a step response, for all methods.

Method = Literal["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]
Attribution = Literal["fast chain", "slow chain", "both in the chain"]
SLOW_CHAIN: Final = "slow chain"
BOTH_IN_CHAIN: Final = "both in the chain"
"""Attributions of the lags of an exponential release besides that of the longer one to the release."""
"""Which lag of an exponential release is that of the chain; both leave the same record."""


@dataclass(frozen=True, repr=False)
class StepFit(Arrays, shapes="time_s N; fitted N; residual N; convergence I"):
    """A model of one output for one load component.

    `model`: continuous, in output unit per load unit; None if the poles of `system` have no modal form. `system`: the
    same, or the system of the method itself, at full precision. `sample_rate_hz`, `decimation`: of the fitted samples.
    `fitted`, `residual` (N,) over `time_s` (N,) in output units. `onset_s`, `u_onset_s`, `release_s`, `u_release_s`:
    start and length of the release, whose time course is `shape`. `variance_accounted`: 1 - |residual|²/|y - mean|².
    `convergence`: loss over iterations, generations or the order 1, 2, …. `order`: number of poles. `duration_s`:
    computing time. `excess`: χ² above that of the likeliest shape. `attribution`: of the two lags of an exponential
    release. `solution`: of output-error least squares.
    """

    method: Method
    channel: str
    component: str
    unit: str
    model: ModalModel | None
    system: LinearSystem
    time_s: FloatArray
    fitted: FloatArray
    residual: FloatArray
    sample_rate_hz: float
    decimation: int
    order: int
    variance_accounted: float
    convergence: FloatArray
    duration_s: float
    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    shape: ReleaseShape = "step"
    excess: float = 0.0
    attribution: Attribution = "fast chain"
    notices: tuple[Notice, ...] = ()
    solution: OutputErrorFit | None = None

    @property
    def hypothesis(self) -> str:
        """Shape of the release, of an exponential one with the attribution of the lags."""
        other = self.shape == "exponential" and self.attribution != "fast chain"
        return f"{self.shape}, {self.attribution}" if other else self.shape


# A solution as a result.


def as_step_fit(
    record: StepRecord, reading: ReleaseReading, solution: OutputErrorFit, method: Method, began: float
) -> StepFit:
    """Return a result with its covariance from every sample."""
    value = record.samples[record.channels.index(reading.channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    covariance = fit_covariance(solution, whole)
    model = modal_model(solution, covariance.covariance, record.u_amplitude)
    notices = fit_notices(record, reading, solution, model, covariance)
    if (dependence := amplitude_dependence([solution])) is not None:
        model = dependence.widen(model)
        notices = (*notices, dependence.notice(model, record.unit, f"{record.name}, {reading.channel}"))
    middle, length = solution.problem.release(solution.vector)
    timed = solution.problem.load.timed
    decimation = int(solution.problem.samples.length[-1])
    return StepFit(
        method=method,
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=model,
        system=model.system,
        time_s=whole.time_s,
        fitted=covariance.fitted,
        residual=covariance.residual,
        sample_rate_hz=record.sample_rate_hz / decimation,
        decimation=decimation,
        order=solution.problem.structure.order,
        variance_accounted=1.0 - float(np.sum(covariance.residual**2) / np.sum((value - value.mean()) ** 2)),
        convergence=np.array(solution.path),
        duration_s=time.perf_counter() - began,
        onset_s=middle - 0.5 * length if timed else reading.onset_s,
        u_onset_s=covariance.u_onset_s if timed else reading.u_onset_s,
        release_s=length,
        u_release_s=covariance.u_release_s,
        shape=solution.problem.load.shape,
        notices=notices,
        solution=solution,
    )


# Model of a sensor from the record of one release.

SHAPES = {
    "step": "a step",
    "ramp": "a ramp",
    "smooth": "half a cosine",
    "exponential": "an exponential",
    "stages": "two stages",
    "measured": "the measured force",
}
ReleaseOption = Literal["step", "ramp", "smooth", "exponential", "measured"]
_EXPLAINED = 0.8  # share of what further modes explain that a drift with the amplitude must explain to replace them
_SHORTEST = 0.02  # lag of a stated chain, in radians of the highest peak, below which it has no effect
_EXACT = 1e-3  # least relative standard uncertainty of a stated lag
PREFERENCE = 4.0
"""χ² by which an exponential release must be likelier, since it attributes lags otherwise."""


def fit_step(
    record: StepRecord,
    channel: str,
    *,
    reading: ReleaseReading | None = None,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: ReleaseOption | None = None,
) -> StepFit:
    """Fit a model of one output to one release by output-error least squares.

    Parameters
    ----------
    record
        outputs during one release
    channel
        name of the output
    reading
        result of `read_release` for this channel, default None: it is read first
    modes, real_poles
        numbers of oscillating modes and real poles, default None: selected by rule
    method
        start values from a matrix "pencil" (default) or an "arx" model
    release
        "step", "ramp", "smooth", "exponential" or "measured"; default None: the measured force, else the likeliest of
        ramp, half cosine, exponential, and two stages

    Returns
    -------
    StepFit : the model with its covariance

    Notes
    -----
    The covariance contains the noise of the record, coloured or white, the baseline, the release and the amplitude of
    the load. It also contains the effect of other shapes of the release that the record does not reject. A lag may be
    that of an exponential release or of the chain, which one record does not show. Without a stated lag of the chain
    (`StepRecord.lag_s`) the covariance contains both.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import StepRecord, fit_step
    >>> time_s, noise = np.arange(4000) / 10e3 - 0.05, 1e-3 * np.random.default_rng(0).normal(size=4000)
    >>> ring = np.exp(-40.0 * time_s) * np.cos(2 * np.pi * 310.0 * time_s)
    >>> volts = np.where(time_s < 0.0, 2.0, 2.0 * ring) + noise  # 20 N are taken off
    >>> record = StepRecord("line 1", ("Fz",), "V", volts[None], 10e3, "Fz", -20.0)
    >>> model = fit_step(record, "Fz").model
    >>> print(f"{model.frequency_hz[0]:.0f} Hz, damping ratio {model.damping_ratio[0]:.2f}")
    310 Hz, damping ratio 0.02
    """
    reading = reading or read_release(record, channel)
    fits = fit_shapes(record, channel, reading, modes, real_poles, method, release)
    fit = merge_alternatives(fits)
    return replace(fit, notices=(*fit.notices, *shape_notices(fits, f"{record.name}, {channel}")))


def fit_shapes(
    record: StepRecord,
    channel: str,
    reading: ReleaseReading,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: ReleaseOption | None = None,
) -> tuple[StepFit, ...]:
    """Return the result of `fit_step` for each possible shape, the likeliest first."""
    began = time.perf_counter()
    whole = every_sample(record.samples[record.channels.index(channel)], record.time_s, 1.0 / record.sample_rate_hz)
    loads = candidate_loads(record, reading, release)
    search = OrderSearch(whole, reading, loads, method, modes, real_poles, chain=_stated_pole(record, reading))
    found, notices = _found_shapes(search, release), list[Notice]()
    if search.chain is not None:
        free = _found_shapes(replace(search, chain=None), release)
        if shape_chi_squared(free[0]) < shape_chi_squared(found[0]) - REJECT_CHI2:
            stated_us, where = 1e6 * np.exp(-search.chain[0]), f"{record.name}, {channel}"
            found, notices = free, [Notice(STATED_LAG_CONTRADICTED, where, stated_us=stated_us)]
    least = shape_chi_squared(found[0])
    fits = list[StepFit]()
    for one in found:
        excess = shape_chi_squared(one) - least
        if excess < HOPELESS or one.problem.load in loads:
            fits += _attributed(
                replace(as_step_fit(record, reading, one, method, began), excess=excess), record, reading
            )
    return tuple(replace(fit, notices=(*fit.notices, *notices)) for fit in order_hypotheses(fits))


def _found_shapes(search: OrderSearch, release: ReleaseOption | None) -> tuple[OutputErrorFit, ...]:
    """Return the supported fits of every shape, the likeliest first."""
    found = _without_drift(search)
    if search.loads[0].lasting and release in (None, "exponential"):
        found = with_further_shapes(found, search.reals is None)
        found = tuple(one for one in found if release in (None, one.problem.load.shape))
    return found


def _without_drift(search: OrderSearch) -> tuple[OutputErrorFit, ...]:
    """Return the supported fits, without modes that only follow a drift with the amplitude."""
    found = search_order(search)
    while search.modes is None and (distinct := distinct_modes(found[0])) < found[0].problem.structure.modes:
        fewer = search_order(replace(search, modes=distinct))
        dependence = amplitude_dependence([fewer[0]])
        explained = 0.0 if dependence is None else (1.0 - dependence.square_share) * fewer[0].square
        if explained > _EXPLAINED * (fewer[0].square - found[0].square):
            return fewer
        if penalised_chi_squared(fewer[0]) >= penalised_chi_squared(found[0]):
            break
        found = fewer
    return found


def _stated_pole(record: StepRecord, reading: ReleaseReading) -> tuple[float, float] | None:
    """Return ln of the stated real pole in rad/s with u, None without one."""
    if record.lag_s is None:
        return None
    least = _SHORTEST / (2.0 * np.pi * max((peak.frequency_hz for peak in reading.peaks), default=1.0))
    lag = max(record.lag_s, least)
    return -float(np.log(lag)), float(np.hypot(max(record.u_lag_s, _EXACT * lag), lag - record.lag_s)) / lag


def _attributed(fit: StepFit, record: StepRecord, reading: ReleaseReading) -> list[StepFit]:
    """Return a fit with every attribution of lags to chain and release."""
    solution = fit.solution
    if solution is None or fit.shape != "exponential":
        return [fit]
    if not solution.problem.structure.reals or solution.problem.chain is not None:
        return [fit]
    other = replace(as_step_fit(record, reading, exchange_lags(solution), fit.method, 0.0), duration_s=fit.duration_s)
    fast, slow = (fit, other) if release_is_slower(solution) else (other, fit)
    fast, slow = replace(fast, excess=fit.excess), replace(slow, excess=fit.excess, attribution=SLOW_CHAIN)
    assert slow.model is not None
    both = replace(slow, model=with_both_lags(slow.model, slow.release_s), attribution=BOTH_IN_CHAIN, solution=None)
    return [fast, slow, both]


def order_hypotheses(fits: Sequence[StepFit]) -> tuple[StepFit, ...]:
    """Return fits of one release, the likeliest first, with χ² above the first.

    Those of another structure are left out. An exponential release counts as the likeliest if its χ² is lower by more
    than 4.
    """
    doubtful = any(fit.attribution != "fast chain" for fit in fits)
    cost = [fit.excess + PREFERENCE * (doubtful and fit.shape == "exponential") for fit in fits]
    ordered = [fits[index] for index in np.argsort(cost, kind="stable")]
    comparable = [fit for fit in ordered if len(_parameters(fit)) == len(_parameters(ordered[0]))]
    return tuple(replace(fit, excess=max(0.0, fit.excess - ordered[0].excess)) for fit in comparable)


def _parameters(fit: StepFit) -> FloatArray:
    """Return the parameters of a model, none without a modal form."""
    return np.zeros(0) if fit.model is None else fit.model.vector


def alternative_fits(fits: Sequence[StepFit]) -> list[tuple[StepFit, OtherHypothesis]]:
    """Return the fits that are not rejected with their distances from the first."""
    first, others = fits[0], [(fit, fit.model) for fit in fits[1:] if fit.model is not None]
    if first.model is None:
        return []
    lags = any(fit.shape == "exponential" and fit.excess < REJECT_CHI2 for fit in fits)
    found = alternatives(first.model, [(model, fit.excess) for fit, model in others], lags)
    return [(others[one.number][0], one) for one in found]


def merge_alternatives(fits: Sequence[StepFit]) -> StepFit:
    """Return the first fit, its uncertainty including fits that are not rejected."""
    first = fits[0]
    for other, end in alternative_fits(fits):
        assert first.model is not None
        assert first.model.covariance is not None
        covariance = first.model.covariance + np.outer(end.change, end.change) / end.distance**2
        first = replace(
            first,
            model=replace(first.model, covariance=covariance),
            u_onset_s=float(np.hypot(first.u_onset_s, (other.onset_s - first.onset_s) / end.distance)),
            u_release_s=float(np.hypot(first.u_release_s, (other.release_s - first.release_s) / end.distance)),
        )
    return first


def shape_notices(fits: Sequence[StepFit], where: str) -> list[Notice]:
    """Return notices of release shapes and lags that a record does not determine."""
    texts = {
        fit.shape: describe_difference(fits[0], fit)
        for fit in fits[1:]
        if fit.excess < REJECT_CHI2 and fit.shape not in (fits[0].shape, "exponential")
    }
    notices = [Notice(RELEASE_SHAPE_UNDETERMINED, where, alternatives=text) for text in texts.values() if text]
    lag = lag_notice(fits, where)
    return notices if lag is None else [*notices, lag]


def lag_notice(fits: Sequence[StepFit], where: str) -> Notice | None:
    """Return the notice of a lag that is not attributed, None without one."""
    possible = [fit for fit in fits if fit.excess < REJECT_CHI2 and fit.model is not None and len(fit.model.real_hz)]
    if not any(fit.shape == "exponential" and describe_difference(fits[0], fit) for fit in possible[1:]):
        return None
    lags = [float(np.max(1e6 / (2.0 * np.pi * fit.model.real_hz))) for fit in possible if fit.model is not None]
    return Notice(LAG_NOT_ATTRIBUTED, where, low_us=min(lags), high_us=max(lags))


def describe_difference(first: StepFit, other: StepFit) -> str:
    """Return both release shapes with their real poles; "" for a small difference."""
    if first.model is None or other.model is None or first.model.covariance is None:
        return ""
    difference = np.abs(other.model.vector - first.model.vector)
    if not np.any(difference > np.sqrt(np.diag(first.model.covariance))):
        return ""
    shapes = [SHAPES[fit.shape] for fit in (first, other)]
    poles = [
        " and ".join(number_text(float(hz)) for hz in np.sort(fit.model.real_hz)) for fit in (first, other) if fit.model
    ]
    of_poles = f" (real pole at {poles[0]} Hz or {poles[1]} Hz)" if poles[0] else ""
    return f"{shapes[0]} or {shapes[1]}{of_poles}"


def candidate_loads(
    record: StepRecord, reading: ReleaseReading, release: ReleaseOption | None
) -> tuple[ReleaseLoad, ...]:
    """Return the time courses of the load that are fitted."""
    if release == "measured" or (release is None and record.force is not None):
        if record.force is None:
            raise ValueError(
                'release: expected "step", "ramp" or "smooth" for a record without force, found "measured"'
            )
        rest = record.time_s < reading.onset_s - 3.0 * reading.u_onset_s
        level = float(np.mean(record.force[rest])) if np.any(rest) else float(record.force[0])
        return (ReleaseLoad("measured", record.amplitude, record.force - level, record.start_s),)
    if release not in (None, "exponential"):
        return (ReleaseLoad(release, record.amplitude),)
    return tuple(ReleaseLoad(shape, record.amplitude) for shape in ("ramp", "smooth"))
