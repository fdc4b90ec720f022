"""Load models from the releases of several loads: two masses or three, stiffnesses and dampings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.labels import mechanical_units
from shaker.model_notices import (
    AMBIGUOUS_SOLUTIONS,
    LOADS_AMPLITUDE_DEPENDENT,
    LOSS_FACTOR,
    MASS_CONTRADICTED,
    NO_SERIES_UNCERTAINTY,
    SCATTER_UNCERTAINTY,
    SECOND_MODE_EXCLUDED,
    SERIES_SCATTER,
    THREE_MASSES,
    TWO_MASSES_ASSUMED,
    TWO_MASSES_SUFFICIENT,
)
from shaker.release.load_amplitudes import load_amplitudes
from shaker.release.load_model import LoadModel
from shaker.release.load_modes import (
    SEARCH,
    FreeDecay,
    Resonances,
    SeriesFit,
    SeriesMasses,
    SeriesOutput,
    SeriesProblem,
    coloured_normal,
    project_amplitudes,
)
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.digits import typeset
from shakercal._common.fitting import REJECT_CHI2, WhitenedResiduals, levenberg_marquardt
from shakercal._common.notices import Notice, Value

# Stiffnesses and dampings from the resonances of several loads.

_ROUNDING = 1e-12  # scatter over that of equal weights, below which it is none
STARTS = np.geomspace(0.03, 30.0, 9)  # ratios k_L/k of the starts
SAME_MINIMUM = 1e-2  # relative difference of parameters below which two minima are the same
COARSE = (1e-2, 1e-1)
"""Relative scatter of frequencies and dampings in a first fit, which widens the valleys of the minima."""
MAX_STIFFNESS_RATIO = 1e4  # ratio of the stiffnesses above which one of them has no effect
INDISTINCT = 3.84  # difference of χ² up to which a second minimum cannot be excluded (95 %)
CHANCE = 1e-3  # chance below which the stated uncertainties do not explain the deviations


def fit_resonances(measured: Resonances, masses: SeriesMasses, *, rigid: bool) -> tuple[SeriesFit, ...]:
    """Return the fits that explain frequencies and dampings best, several if indistinguishable.

    Weighted least squares on ln f and ln ζ from several starts; every named mass error is an unknown. Scatter in
    addition to the stated uncertainties is estimated as a random effect (Mandel & Paule 1970), separately for
    frequencies and dampings. It is estimated if its chance is below 1 in 1000, or without stated uncertainties.
    """
    problem = SeriesProblem(measured, masses, rigid)
    scatter = _scatter(problem, _minima(problem, (0.0, 0.0))[0][0])
    determined = all(tau > 0.0 or bool(np.all(u > 0.0)) for tau, u in zip(scatter, problem.stated(), strict=True))
    fits = []
    for x, excess in _minima(problem, scatter):
        _, slope = problem.residual(x, problem.sigma(scatter))
        (f, z), _ = problem.modes(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_f, of_z = (float(np.nansum((deviation / u) ** 2)) for deviation, u, _ in problem.groups(x))
        inner: FloatArray = np.asarray(np.linalg.inv(slope.T @ slope))
        fits.append(
            SeriesFit(
                numbers=problem.numbers(x),
                deviates=problem.deviates(x),
                covariance=_of_numbers(problem, x, inner) if determined else None,
                frequency_hz=f,
                damping_ratio=z,
                scatter=scatter,
                chi_squared=(of_f, of_z),
                dof=problem.dof,
                excess=excess,
            )
        )
    return tuple(fits)


def _minimise(
    problem: SeriesProblem,
    residual: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    tolerance: float = SEARCH.predicted_decrease_share,
) -> WhitenedResiduals:
    """Return the least squares next to a start, within the range of a real sensor."""

    def at(x: FloatArray) -> WhitenedResiduals | None:
        return WhitenedResiduals(x, *residual(x)) if problem.is_sound(x) else None

    begin = at(start)
    if begin is None:
        raise ValueError("start: expected unknowns within the range of a sensor, found others")
    return levenberg_marquardt(at, begin, replace(SEARCH, predicted_decrease_share=tolerance)).point


def _refined(
    problem: SeriesProblem,
    start: FloatArray,
    scatter: tuple[float, float],
    tolerance: float = SEARCH.predicted_decrease_share,
) -> tuple[FloatArray, float]:
    """Return the unknowns (X,) at the minimum next to a start, and their χ²."""
    sigma = problem.sigma(scatter)
    end = _minimise(problem, lambda x: problem.residual(x, sigma), start, tolerance)
    return end.parameters, end.loss


def _minima(problem: SeriesProblem, scatter: tuple[float, float]) -> list[tuple[FloatArray, float]]:
    """Return the minima that cannot be excluded, the best first, with χ² above the best."""
    ratios = STARTS[:1] if problem.rigid else STARTS
    coarse = _distinct(problem, [_refined(problem, problem.start(ratio), COARSE, 1e-5) for ratio in ratios])
    minima = _distinct(problem, [_refined(problem, x, scatter) for x, _ in coarse])
    return [(x, cost - minima[0][1]) for x, cost in minima if cost - minima[0][1] <= INDISTINCT]


def _distinct(problem: SeriesProblem, minima: list[tuple[FloatArray, float]]) -> list[tuple[FloatArray, float]]:
    """Return the different and meaningful minima, the best first; at least the best one."""
    ordered = sorted(minima, key=lambda item: item[1])
    ratios = [1.0 if problem.rigid else float(np.divide(*problem.numbers(x)[2::-2])) for x, _ in ordered]
    low, high = 1.0 / MAX_STIFFNESS_RATIO, MAX_STIFFNESS_RATIO
    sound = [item for item, ratio in zip(ordered, ratios, strict=True) if low < ratio < high]
    distinct: list[tuple[FloatArray, float]] = []
    for x, cost in sound or ordered[:1]:
        numbers = problem.numbers(x)[::2]
        if all(np.max(np.abs(numbers / problem.numbers(other)[::2] - 1.0)) > SAME_MINIMUM for other, _ in distinct):
            distinct.append((x, cost))
    return distinct


def _scatter(problem: SeriesProblem, x: FloatArray) -> tuple[float, float]:
    """Return the relative scatter of frequencies and dampings for which χ² equals its freedom."""
    from scipy.special import chdtrc

    scatter = (0.0, 0.0)
    estimated = [
        dof > 0 and (bool(np.any(u == 0.0)) or bool(chdtrc(dof, np.sum((deviation / u) ** 2)) < CHANCE))
        for deviation, u, dof in problem.groups(x)
    ]
    for _ in range(50 if any(estimated) else 0):
        f, z = (
            _additional_scatter(*group) if estimate else 0.0
            for group, estimate in zip(problem.groups(x), estimated, strict=True)
        )
        if np.allclose((f, z), scatter, rtol=1e-6, atol=0.0):
            break
        scatter = (f, z)
        x = _refined(problem, x, scatter)[0]
    return scatter


def _of_numbers(problem: SeriesProblem, x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (P + Q, P + Q) of numbers and mass errors."""
    rates, (_, by_prior) = problem.number_rates(x), problem.prior(x)
    turn = np.vstack([np.pad(rates, ((0, 0), (0, len(by_prior)))), by_prior])
    return np.asarray(turn @ covariance @ turn.T)


# One load model fitted to the records of all loads together.

ALLOWED = 2.0  # excess over that of white noise that coloured noise explains


def fit_decays(
    decays: tuple[FreeDecay, ...], noise: FloatArray, problem: SeriesProblem, start: SeriesFit
) -> tuple[SeriesFit, bool]:
    """Return the parameters that fit all records best, and whether they explain the records.

    Unknown are the common k, c, k_L, c_L and the named masses, starting from those of the resonances. Level and complex
    amplitude of every mode are free in every record. `noise` (R,): standard deviations of the residuals of free modes,
    the weights. The covariance uses the colour of the noise in the residuals. Σ |r|²/s² of the model minus that of free
    modes is a χ²; its degrees of freedom are the difference of the numbers of unknowns. Twice its quantile (1 in 1000)
    is allowed, because the noise of a decimated record is not exactly white.
    """
    from scipy.special import chdtri

    def records(x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        parts = []
        for r, decay in enumerate(decays):
            poles, moved = problem.poles(x, r)
            residual, slope = project_amplitudes(decay, poles)
            by_x = slope @ np.stack([moved.real, moved.imag], axis=1).reshape(-1, len(x))
            parts.append((residual / noise[r], by_x / noise[r]))
        return parts

    def residual(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        left, slopes = zip(*records(x), problem.prior(x), strict=True)
        return np.concatenate(left), np.vstack(slopes)

    end = _minimise(problem, residual, problem.unknowns(start))
    x, parts, by_prior = end.parameters, records(end.parameters), problem.prior(end.parameters)[1]
    inner = np.linalg.inv(end.jacobian.T @ end.jacobian)
    middle = sum((coloured_normal(slope, left) for left, slope in parts), by_prior.T @ by_prior)
    modes = np.sum(np.isfinite(problem.measured.frequency_hz), axis=1)
    more = sum(float(left @ left) - (len(left) - 1 - 4 * int(modes[r])) for r, (left, _) in enumerate(parts))
    (f, z), _ = problem.modes(x)
    fit = replace(
        start,
        numbers=problem.numbers(x),
        deviates=problem.deviates(x),
        covariance=_of_numbers(problem, x, inner @ middle @ inner),
        frequency_hz=f,
        damping_ratio=z,
    )
    return fit, more <= ALLOWED * float(chdtri(max(sum(problem.dof), 1), CHANCE))


# Which second modes belong to the coupling of the load.

MAX_SECOND_DEVIATION = 0.10
"""Relative deviation of a second mode from its prediction by the first ones, above which it is foreign."""


def belonging(measured: Resonances, masses: SeriesMasses) -> tuple[Resonances, tuple[int, ...]]:
    """Return the resonances without foreign second modes, and the records with such modes.

    First resonances of several load masses determine k and k_L, and therefore the second modes. A second mode without
    load is always foreign.
    """
    seen = np.isfinite(measured.frequency_hz[:, 1])
    foreign = seen & (masses.load == 0)
    if np.any(seen & ~foreign) and len(np.unique(np.round(masses.load / masses.moving, 3))) > 1:
        alone = measured.without_second(np.ones(len(seen), dtype=np.bool_))
        predicted = np.array([fit.frequency_hz[:, 1] for fit in fit_resonances(alone, masses, rigid=False)])
        off = np.abs(measured.frequency_hz[:, 1] / predicted - 1.0)
        foreign |= seen & (masses.load > 0) & (np.min(off, axis=0) > MAX_SECOND_DEVIATION)
    return measured.without_second(foreign), tuple(int(record) for record in np.flatnonzero(foreign))


# Selection of the model that a series of loads supports.

CONTRADICTED = 0.01  # chance below which a rigid load is contradicted
NEGLIGIBLE = 1e-3  # deviation in % below which 0 is reported
UNLIKELY = 3.0  # standard uncertainties by which a mass may deviate from its statement without a notice, 3 σ


@dataclass(frozen=True)
class LoadIdentification:
    """The model of a sensor and its loads, with its alternatives.

    `rigid`, `elastic`: fits of the two-mass and of the three-mass model to the resonances; `elastic` is empty if the
    resonances cannot determine it. `chosen`: fits of the supported model, to the records if `from_records`. There are
    several if the data cannot distinguish solutions, the stiffest coupling first. `models`: in the order of `chosen`.
    `reason`: justification of the structure.
    """

    rigid: SeriesFit
    elastic: tuple[SeriesFit, ...]
    chosen: tuple[SeriesFit, ...]
    from_records: bool
    models: tuple[LoadModel, ...]
    reason: str
    notices: tuple[Notice, ...]

    @property
    def model(self) -> LoadModel:
        """The model, the first one where there are several solutions."""
        return self.models[0]


def identify_loads(
    measured: Resonances,
    masses: SeriesMasses,
    output: SeriesOutput,
    decays: tuple[FreeDecay, ...] = (),
    noise: FloatArray | None = None,
    poles: Sequence[ComplexArray] = (),
) -> LoadIdentification:
    """Identify the model that resonances of R records support.

    Parameters
    ----------
    measured
        resonances and dampings of R records
    masses
        moving mass and load masses with their errors
    output
        output channel and its static sensitivity
    decays
        free decays of the R records, default none: the model is fitted to the resonances alone
    noise
        (R,) standard deviations of the records' residuals, output unit, default None
    poles
        (M,) upper poles of the modes of every decay, default none: dependence on the amplitude is not tested

    Returns
    -------
    LoadIdentification : supported model, alternatives and notices

    Notes
    -----
    Three masses are selected if a second mode was observed, or if a rigid load contradicts the first ones (chance below
    1 in 100). Second modes that no coupling explains are excluded. The fit to the resonances replaces that to the
    records if the resonances scatter more than stated and the records are not explained within their noise. It includes
    that scatter.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import identify_loads
    >>> from shaker.release.load_modes import SeriesOutput, stated_masses, stated_resonances
    >>> load = np.array([0.0, 0.5, 1.0, 2.0])  # kg on 0.3 kg that move, on a spring of 4 N/µm
    >>> seen = stated_resonances(np.sqrt(4e6 / (0.3 + load)) / (2 * np.pi))
    >>> found = identify_loads(seen, stated_masses(0.3, 0.0, load), SeriesOutput("Fz", "Fz", "V"))
    >>> print(f"{found.model.stiffness:.3g} N/m")
    4e+06 N/m
    """
    observed, unit = measured, output.mass_unit
    measured, foreign = belonging(measured, masses)
    if (dependence := load_amplitudes(decays, poles) if poles else None) is not None:
        measured = dependence.widened(measured)
    rigid = fit_resonances(measured, masses, rigid=True)[0]
    used = np.isfinite(measured.frequency_hz) & np.stack([np.ones_like(masses.load), masses.load], axis=1).astype(bool)
    different = sum(len(np.unique(masses.load[used[:, mode]])) for mode in range(2))  # repeats do not count
    enough = different >= 2 and bool(np.any(masses.load > 0))
    elastic = fit_resonances(measured, masses, rigid=False) if enough else ()
    supported, reason = _supports(measured, masses, rigid, elastic, output)
    chosen = elastic if supported else (rigid,)
    from_records = False
    if decays and noise is not None:
        problem = SeriesProblem(measured, masses, rigid=not supported)
        joint, explained = zip(*(fit_decays(decays, noise, problem, fit) for fit in chosen), strict=True)
        from_records = not any(chosen[0].scatter) or explained[0]
        chosen = tuple(replace(fit, scatter=(0.0, 0.0)) for fit in joint) if from_records else chosen
    if supported:
        chosen = tuple(sorted(chosen, key=lambda fit: -float(fit.numbers[2])))
    where, notices = output.component, list[Notice]()
    ends: list[Resonances] = []
    if dependence is not None:
        ends += [dependence.resonances(measured, end) for end in range(len(dependence.ends))]
        static = output.sensitivity * dependence.static_share / np.sqrt(2.0)  # either end: an arcsine distribution
        output = replace(output, u_sensitivity=float(np.hypot(output.u_sensitivity, static)))
        f, z = dependence.changes
        share, size = 100.0 * dependence.smallest, {"f_percent": 100.0 * f, "zeta_percent": 100.0 * z}
        notices.append(Notice(LOADS_AMPLITUDE_DEPENDENT, where, share_percent=share, **size))
    if (loss := _loss_factor(measured, masses, chosen[0], supported)) is not None:
        ends += [_damped_as_at(measured, hertz) for hertz in _range_hz(measured)]
        low, high = _range_hz(measured)
        dof, before = chosen[0].dof[1], chosen[0].chi_squared[1]
        notices.append(Notice(LOSS_FACTOR, where, chi2=loss, viscous=before, dof=dof, low_hz=low, high_hz=high))
    chosen = tuple(_with_range(fit, ends, masses) for fit in chosen)
    models = tuple(_model(fit, masses, output, n, len(chosen)) for n, fit in enumerate(chosen, 1))
    if foreign:
        modes = ", ".join(f"{observed.frequency_hz[r, 1]:.5g} Hz with {_mass(masses.load[r], unit)}" for r in foreign)
        notices.append(Notice(SECOND_MODE_EXCLUDED, where, modes=modes))
    notices.append(reason)
    notices += _remarks(masses, output, chosen[0], models, bool(np.any(measured.u_frequency_hz[:, 0] > 0)))
    text = f"{reason.text} {reason.effect}"
    return LoadIdentification(rigid, elastic, chosen, from_records, models, text, tuple(notices))


def _range_hz(measured: Resonances) -> tuple[float, float]:
    """Return the lowest and the highest first resonance."""
    return float(np.min(measured.frequency_hz[:, 0])), float(np.max(measured.frequency_hz[:, 0]))


def _damped_as_at(measured: Resonances, hertz: float) -> Resonances:
    """Return resonances whose dampers are those of a constant loss factor at one frequency."""
    factor = measured.frequency_hz / hertz
    z, u = measured.damping_ratio * factor, measured.u_damping_ratio * factor
    return Resonances(measured.names, measured.frequency_hz, measured.u_frequency_hz, z, u)


def _loss_factor(measured: Resonances, masses: SeriesMasses, fit: SeriesFit, elastic: bool) -> float | None:
    """Return χ² of dampings by a constant loss factor, None if not clearly better."""
    from scipy.special import chdtrc

    if fit.dof[1] < 1 or float(chdtrc(fit.dof[1], fit.chi_squared[1])) >= CHANCE:
        return None
    other = fit_resonances(_damped_as_at(measured, _range_hz(measured)[0]), masses, rigid=not elastic)
    chi_squared = min(one.chi_squared[1] for one in other)
    return chi_squared if chi_squared < fit.chi_squared[1] - REJECT_CHI2 else None


def _with_range(fit: SeriesFit, ends: Sequence[Resonances], masses: SeriesMasses) -> SeriesFit:
    """Return a fit whose covariance includes the linear models of a range.

    Its ends are those of arcsine distributions."""
    if fit.covariance is None:
        return fit
    covariance = fit.covariance
    for end in ends:
        problem = SeriesProblem(end, masses, rigid=len(fit.numbers) == 2)
        x, _ = _refined(problem, problem.unknowns(fit), fit.scatter)
        move = np.concatenate([problem.numbers(x), problem.deviates(x)]) - np.concatenate([fit.numbers, fit.deviates])
        covariance = covariance + np.outer(move, move) / 2.0
    return replace(fit, covariance=covariance)


def _supports(
    measured: Resonances, masses: SeriesMasses, rigid: SeriesFit, elastic: tuple[SeriesFit, ...], output: SeriesOutput
) -> tuple[bool, Notice]:
    """Return whether the data support three masses, and the reason."""
    from scipy.special import chdtrc, fdtrc

    where, unit = output.component, output.mass_unit
    if not elastic:
        return False, Notice(TWO_MASSES_ASSUMED, where)

    def largest(fit: SeriesFit) -> tuple[float, str]:
        deviation = 100.0 * np.abs(fit.frequency_hz[:, 0] / first - 1.0)
        index = int(np.argmax(deviation))
        size = float(deviation[index])
        return size if size > NEGLIGIBLE else 0.0, _mass(masses.load[index], unit)

    first, seen = measured.frequency_hz[:, 0], np.isfinite(measured.frequency_hz[:, 1]) & (masses.load > 0)
    (two, two_load), (three, three_load) = largest(rigid), largest(elastic[0])
    values: dict[str, Value] = {
        "two_percent": two,
        "two_load": two_load,
        "three_percent": three,
        "three_load": three_load,
    }
    if seen.any():
        index = int(np.flatnonzero(seen)[0])
        second = f"{measured.frequency_hz[index, 1]:.5g} Hz with {_mass(masses.load[index], unit)}"
        return True, Notice(THREE_MASSES, where, evidence=f"a second resonance at {second}", **values)
    scatter, freedom = elastic[0].scatter[0], elastic[0].dof[0]
    variance = (measured.u_frequency_hz[:, 0] / first) ** 2 + scatter**2
    if np.all(variance > 0.0):
        of_two, of_three = (
            np.sum(np.log(fit.frequency_hz[:, 0] / first) ** 2 / variance) for fit in (rigid, elastic[0])
        )
        gain = max(float(of_two - of_three), 0.0)
        if (fdtrc(1, freedom, gain) if scatter > 0.0 else chdtrc(1, gain)) < CONTRADICTED:
            return True, Notice(THREE_MASSES, where, evidence="the first resonances", **values)
    return False, Notice(TWO_MASSES_SUFFICIENT, where, **values)


def _mass(load: float, unit: str) -> str:
    """Return a load mass in words."""
    return f"a load of {load:.4g} {unit}" if load > 0 else "no load"


def _model(fit: SeriesFit, masses: SeriesMasses, output: SeriesOutput, number: int, count: int) -> LoadModel:
    """Return the load model of a fit, with covariances for given and for uncertain masses."""
    size = len(fit.numbers)
    conditional, total = None, None
    if fit.covariance is not None:
        whole = fit.covariance
        turn = np.vstack([np.eye(size, len(whole)), np.append(np.zeros(size), masses.moving_effect)])
        total = turn @ whole @ turn.T
        across = whole[:size, size:]
        conditional = whole[:size, :size]
        if across.size:
            conditional = conditional - across @ np.linalg.solve(whole[size:, size:], across.T)
    k, c, *coupling = (float(number) for number in fit.numbers)
    kl, cl = coupling or (None, None)
    return LoadModel(
        output.component,
        output.channel,
        output.unit,
        masses.at(fit.deviates)[0],
        k,
        c,
        kl,
        cl,
        sensitivity=output.sensitivity,
        u_moving_mass=masses.u_moving if total is None else float(np.sqrt(total[-1, -1])),
        covariance=conditional,
        u_sensitivity=output.u_sensitivity,
        covariance_with_mass=total,
        load_masses=tuple(float(mass) for mass in masses.load),
        solution=number,
        solutions=count,
    )


def _remarks(
    masses: SeriesMasses, output: SeriesOutput, fit: SeriesFit, models: tuple[LoadModel, ...], stated: bool
) -> Iterator[Notice]:
    """Yield notices on ambiguous solutions, scatter about the model and contradicted masses."""
    where = output.component
    if len(models) > 1:
        unit = typeset(mechanical_units(output.component).stiffness)
        pairs = " or ".join(f"k = {m.stiffness:.4g}, k_L = {m.coupling_stiffness:.4g} {unit}" for m in models)
        unloaded = " or ".join(f"{abs(m.poles(0.0)[0]) / (2.0 * np.pi):.5g} Hz" for m in models)
        yield Notice(AMBIGUOUS_SOLUTIONS, where, count=len(models), solutions=pairs, unloaded=unloaded)
    for tau, quantity, has_u in zip(fit.scatter, ("resonances", "damping ratios"), (stated, True), strict=True):
        if tau > 0.0:
            declared = SERIES_SCATTER if has_u else SCATTER_UNCERTAINTY
            yield Notice(declared, where, quantity=quantity, scatter_percent=100.0 * tau)
    if fit.covariance is None:
        yield Notice(NO_SERIES_UNCERTAINTY, where)
    for name, value in zip(masses.names, fit.deviates, strict=True):
        if abs(value) > UNLIKELY:
            yield Notice(MASS_CONTRADICTED, where, cause=name, deviation=value)


def _additional_scatter(deviation: FloatArray, u: FloatArray, dof: int) -> float:
    """Return the standard deviation τ with Σ d²/(u² + τ²) = dof, 0 without scatter.

    It belongs to deviations (N,) from a mean or model with stated uncertainties (N,) (Paule and Mandel, J. Res. NBS 87
    (1982) 377).
    """
    from scipy.optimize import brentq

    def beyond(tau: float) -> float:
        return float(np.sum(deviation**2 / (u**2 + tau**2))) - dof

    high = float(np.sqrt(np.sum(deviation**2) / dof))
    low = _ROUNDING * high
    return float(brentq(beyond, low, high * (1.0 + 1e-9))) if high > 0.0 and beyond(low) > 0.0 else 0.0
