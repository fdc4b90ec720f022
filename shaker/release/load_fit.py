"""Stiffness, damping and masses from the releases of several loads, in one fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shaker.arrays import BoolArray, Brief, ComplexArray, FloatArray, check_shape
from shaker.fitting import Residuals, levenberg_marquardt
from shaker.release.load_model import upper_poles
from shaker.release.load_modes import SEARCH, FreeDecay, Resonances, coloured, projected

# The masses of a series of loads as named unknowns.


@dataclass(frozen=True, repr=False)
class SeriesMasses(Brief):
    """Moving mass and the load masses (R,) of R records in kg, with their errors by name.

    `names` (Q,) of what is uncertain; one standard uncertainty of it changes the moving mass by `moving_effect` (Q,)
    and the load masses by `load_effect` (R, Q), so that an adapter that two records share is one unknown.
    """

    moving: float
    load: FloatArray
    names: tuple[str, ...]
    moving_effect: FloatArray
    load_effect: FloatArray

    def __post_init__(self) -> None:
        if not self.moving > 0:
            raise ValueError(f"moving: expected a mass above 0, found {self.moving}")
        check_shape("load", self.load, (None,))
        if np.any(self.load < 0):
            raise ValueError(f"load: expected masses of at least 0, found {float(np.min(self.load))}")
        check_shape("moving_effect", self.moving_effect, (len(self.names),))
        check_shape("load_effect", self.load_effect, (len(self.load), len(self.names)))

    @property
    def u_moving(self) -> float:
        """Standard uncertainty of the moving mass."""
        return float(np.linalg.norm(self.moving_effect))

    @property
    def u_load(self) -> FloatArray:
        """Standard uncertainties of the load masses (R,)."""
        return np.asarray(np.linalg.norm(self.load_effect, axis=1))

    @property
    def is_single(self) -> bool:
        """Whether all records carry one load mass, but for 0.1 %."""
        return bool(np.ptp(self.load) <= 1e-3 * np.max(self.load, initial=0.0))

    def at(self, deviates: FloatArray) -> tuple[float, FloatArray]:
        """Return moving and load masses with every named error (Q,) at so many of its standard uncertainties."""
        return self.moving + float(self.moving_effect @ deviates), self.load + self.load_effect @ deviates


def stated_masses(moving: float, u_moving: float, load: FloatArray, u_load: FloatArray | None = None) -> SeriesMasses:
    """Return masses whose errors are independent: the moving mass, and every load mass (R,) that differs."""
    loads = np.asarray(load, dtype=np.float64)
    spread = np.zeros(len(loads)) if u_load is None else np.asarray(u_load, dtype=np.float64)
    names, rows, moved = [], [], []
    if u_moving > 0.0:
        names.append("moving mass")
        moved.append(u_moving)
        rows.append(np.zeros(len(loads)))
    for value in np.unique(loads[spread > 0.0]):
        names.append(f"load mass {value:.6g} kg")
        moved.append(0.0)
        rows.append(np.where(loads == value, spread, 0.0))
    effect = np.array(rows).reshape(len(names), len(loads)).T
    return SeriesMasses(float(moving), loads, tuple(names), np.array(moved, dtype=np.float64), effect)


# Rows and unknowns of a fit of load models to resonances.


LARGEST = 100.0
"""Logarithm of a stiffness or damping, in size, from which a step has gone astray."""
FLOOR = 1e-8
"""Relative uncertainty that stands where none is stated and none has shown yet."""


@dataclass(frozen=True)
class SeriesProblem:
    """A fit of ln f and ln ζ of the modes that were seen; a rigid load has first modes only.

    Unknown x (X,): logarithms of k and, unless `rigid`, k_L, then of c and c_L where a damping is known, then the named
    mass errors in their standard uncertainties.
    """

    measured: Resonances
    masses: SeriesMasses
    rigid: bool

    def __post_init__(self) -> None:
        if len(self.measured.names) != len(self.masses.load):
            found = f"{len(self.masses.load)} masses"
            raise ValueError(f"masses: expected one load mass per record, {len(self.measured.names)}, found {found}")
        if not self.rigid and (self.rows[0].sum() < 2 or not np.any(self.masses.load > 0)):
            raise ValueError(
                "measured: expected two resonances, one of them with a load, to tell the coupling's stiffness, found "
                f"{int(self.rows[0].sum())}"
            )

    @cached_property
    def rows(self) -> tuple[BoolArray, BoolArray]:
        """Which frequencies and which dampings (R, 2) enter."""
        seen = np.isfinite(self.measured.frequency_hz)
        seen[:, 1] &= (self.masses.load > 0) & (not self.rigid)
        return seen, seen & (np.nan_to_num(self.measured.damping_ratio) > 0)

    @property
    def springs(self) -> int:
        """Number of stiffnesses."""
        return 1 if self.rigid else 2

    @cached_property
    def dampers(self) -> int:
        """Number of dampings that the known ones tell; where one damping alone is known, c_L/k_L = c/k."""
        return min(self.springs, int(self.rows[1].sum()))

    @property
    def dof(self) -> tuple[int, int]:
        """Degrees of freedom of the frequencies and of the dampings."""
        f, z = self.rows
        return int(f.sum()) - self.springs, int(z.sum()) - self.dampers

    def numbers(self, x: FloatArray) -> FloatArray:
        """Return k, c or k, c, k_L, c_L of unknowns x; dampings of 0 where none is known."""
        stiffness = np.exp(x[: self.springs])
        damping = np.zeros(self.springs)
        if self.dampers:
            damping[: self.dampers] = np.exp(x[self.springs : self.springs + self.dampers])
        if self.dampers == 1 and self.springs == 2:
            damping[1] = damping[0] * stiffness[1] / stiffness[0]
        return np.stack([stiffness, damping], axis=1).ravel()

    def is_sound(self, x: FloatArray) -> bool:
        """Whether all numbers of unknowns x are numbers that a computer and a sensor may have."""
        moving, loads = self.masses.at(self.deviates(x))
        logarithms = np.abs(x[: self.springs + self.dampers])
        return bool(np.all(logarithms < LARGEST) and moving > 0.0 and np.all(loads[self.masses.load > 0] > 0.0))

    def deviates(self, x: FloatArray) -> FloatArray:
        """Return the named mass errors (Q,) among the unknowns."""
        return x[self.springs + self.dampers :]

    def number_rates(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (P, S) of the numbers by the logarithms of springs and dampers."""
        numbers = self.numbers(x)
        rates = np.zeros((len(numbers), self.springs + self.dampers))
        for i in range(self.springs):
            rates[2 * i, i] = numbers[2 * i]
        for i in range(self.dampers):
            rates[2 * i + 1, self.springs + i] = numbers[2 * i + 1]
        if self.dampers == 1 and self.springs == 2:
            rates[3] = [-numbers[3], numbers[3], numbers[3]]
        return rates

    def modes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies and damping ratios [f, ζ] (2, R, 2), and the derivatives of ln f and ζ (2, R, 2, X)."""
        moving, loads = self.masses.at(self.deviates(x))
        numbers, by_log = self.numbers(x), self.number_rates(x)
        values = np.full((2, len(loads), 2), np.nan)
        rates = np.zeros((*values.shape, len(x)))
        for r, load in enumerate(loads):
            poles, moved = upper_poles(numbers, moving, float(load) if self.masses.load[r] > 0 else 0.0)
            by_mass = np.outer(moved[:, -2], self.masses.moving_effect)
            by_mass = by_mass + np.outer(moved[:, -1], self.masses.load_effect[r])
            change = np.hstack([moved[:, :-2] @ by_log, by_mass])
            count, size = len(poles), np.abs(poles)
            along = (np.conj(poles)[:, None] * change).real / size[:, None] ** 2
            values[0, r, :count], values[1, r, :count] = size / (2.0 * np.pi), -poles.real / size
            rates[0, r, :count] = along
            rates[1, r, :count] = -change.real / size[:, None] + (poles.real / size)[:, None] * along
        return values, rates

    def residual(self, x: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return weighted residuals (N + Q,) and their derivatives (N + Q, X); `sigma` (N,) of ln f, then ln ζ."""
        if not self.is_sound(x):
            return np.full(len(sigma) + len(self.deviates(x)), np.inf), np.zeros((1, len(x)))
        (f, z), rates = self.modes(x)
        f_rows, z_rows = self.rows
        seen = self.measured
        told = [np.log(f[f_rows] / seen.frequency_hz[f_rows])]
        slopes = [rates[0][f_rows]]
        if self.dampers:
            with np.errstate(invalid="ignore", divide="ignore"):
                told.append(np.log(z[z_rows] / seen.damping_ratio[z_rows]))
                slopes.append(rates[1][z_rows] / z[z_rows][:, None])
        own = self.deviates(x)
        prior = np.zeros((len(own), len(x)))
        prior[:, len(x) - len(own) :] = np.eye(len(own))
        residual = np.concatenate([np.concatenate(told) / sigma, own])
        return residual, np.vstack([np.vstack(slopes) / sigma[:, None], prior])

    def stated(self) -> tuple[FloatArray, FloatArray]:
        """Return the relative standard uncertainties stated of the frequencies and of the dampings that enter."""
        f_rows, z_rows = self.rows
        seen = self.measured
        f = seen.u_frequency_hz[f_rows] / seen.frequency_hz[f_rows]
        z = seen.u_damping_ratio[z_rows] / seen.damping_ratio[z_rows] if self.dampers else np.zeros(0)
        return np.nan_to_num(f), np.nan_to_num(z)

    def sigma(self, scatter: tuple[float, float]) -> FloatArray:
        """Return the relative standard deviations (N,) of all rows with scatter beyond what is stated."""
        parts = [np.sqrt(u**2 + tau**2 + FLOOR**2) for u, tau in zip(self.stated(), scatter, strict=True)]
        return np.concatenate(parts)

    def start(self, ratio: float) -> FloatArray:
        """Return unknowns (X,) with k_L/k as given that meet the first resonance and damping of the lightest load."""
        lightest = int(np.argmin(self.masses.load))
        shape = np.array([1.0, 0.0] if self.rigid else [1.0, 0.0, ratio, 0.0])
        load = float(self.masses.load[lightest])
        omega = 2.0 * np.pi * float(self.measured.frequency_hz[lightest, 0])
        k = (omega / abs(upper_poles(shape, self.masses.moving, load)[0][0])) ** 2
        springs = np.log(k * shape[::2])
        zeta = self.measured.damping_ratio[self.rows[1]]
        dampers = springs[: self.dampers] + (np.log(2.0 * np.median(zeta) / omega) if self.dampers else 0.0)
        return np.concatenate([springs, dampers, np.zeros(len(self.masses.names))])


# Stiffnesses and dampings from the resonances of several loads.


STARTS = np.geomspace(0.03, 30.0, 9)
"""Ratios k_L/k from which the fit starts."""
ALIKE = 1e-2
"""Relative difference of parameters below which two minima are one."""
COARSE = (1e-2, 1e-1)
"""Relative scatter of frequencies and dampings with which minima are approached: their valleys are wide then."""
FARTHEST = 1e4
"""Ratio of the stiffnesses beyond which one of them means nothing."""
INDISTINCT = 3.84
"""Difference of chi-squared up to which a second minimum cannot be excluded (95 %)."""
CHANCE = 1e-3
"""Chance below which deviations are not explained by what is stated."""


@dataclass(frozen=True, repr=False)
class SeriesFit(Brief):
    """Parameters of a load model from a series of R records.

    `numbers` (P,): stiffness, damping and those of the coupling unless rigid; dampings are 0 where none was measured.
    `deviates` (Q,): named mass errors in their standard uncertainties. `covariance` (P + Q, P + Q) of both, None where
    the scatter is unknown and cannot show. `frequency_hz`, `damping_ratio` (R, 2) of the model. `scatter`: relative
    standard deviations of frequencies and of dampings about the model beyond what is stated. `chi_squared` of both by
    what is stated alone, with degrees of freedom `dof`; `excess`: chi-squared over that of the best minimum.
    """

    numbers: FloatArray
    deviates: FloatArray
    covariance: FloatArray | None
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    scatter: tuple[float, float]
    chi_squared: tuple[float, float]
    dof: tuple[int, int]
    excess: float = 0.0

    @property
    def is_rigid(self) -> bool:
        """Whether the load was taken as rigid."""
        return len(self.numbers) == 2


def fit_resonances(measured: Resonances, masses: SeriesMasses, *, rigid: bool) -> tuple[SeriesFit, ...]:
    """Return the fits that explain frequencies and dampings best, more than one where the data cannot tell.

    Weighted least squares on ln f and ln ζ with every named mass error as an unknown of its own, from several starts.
    Scatter beyond what is stated is estimated as of random effects (Mandel & Paule 1970), of frequencies and dampings
    each by itself, where chance would explain it less than once in 1000, or where nothing is stated.
    """
    problem = SeriesProblem(measured, masses, rigid)
    none = (0.0, 0.0)
    best = _minima(problem, none)[0][0]
    scatter = _scatter(problem, best)
    found = _minima(problem, scatter)
    return tuple(_result(problem, x, scatter, excess) for x, excess in found)


def refined(
    problem: SeriesProblem, x: FloatArray, scatter: tuple[float, float], tolerance: float = 1e-10
) -> tuple[FloatArray, float]:
    """Return the unknowns (X,) at the minimum next to a start, and chi-squared there."""
    sigma = problem.sigma(scatter)

    def at(x: FloatArray) -> Residuals:
        return Residuals(x, *problem.residual(x, sigma))

    end = levenberg_marquardt(at, at(x), replace(SEARCH, foretold_share=tolerance)).point
    return end.parameters, end.loss


def _minima(problem: SeriesProblem, scatter: tuple[float, float]) -> list[tuple[FloatArray, float]]:
    """Minima that cannot be excluded, the best first, with chi-squared beyond the best."""
    ratios = STARTS[:1] if problem.rigid else STARTS
    coarse = _distinct(problem, [refined(problem, problem.start(ratio), COARSE, 1e-5) for ratio in ratios])
    found = _distinct(problem, [refined(problem, x, scatter) for x, _ in coarse])
    return [(x, cost - found[0][1]) for x, cost in found if cost - found[0][1] <= INDISTINCT]


def _distinct(problem: SeriesProblem, found: list[tuple[FloatArray, float]]) -> list[tuple[FloatArray, float]]:
    """Minima that differ and mean something, the best first; the best at any rate."""
    ordered = sorted(found, key=lambda item: item[1])
    ratios = [1.0 if problem.rigid else float(np.divide(*problem.numbers(x)[2::-2])) for x, _ in ordered]
    sound = [item for item, ratio in zip(ordered, ratios, strict=True) if 1.0 / FARTHEST < ratio < FARTHEST]
    sound = sound or ordered[:1]
    kept: list[tuple[FloatArray, float]] = []
    for x, cost in sound:
        numbers = problem.numbers(x)[::2]
        if all(np.max(np.abs(numbers / problem.numbers(other)[::2] - 1.0)) > ALIKE for other, _ in kept):
            kept.append((x, cost))
    return kept


def _scatter(problem: SeriesProblem, x: FloatArray) -> tuple[float, float]:
    """Relative scatter of frequencies and dampings beyond what is stated: where chi-squared equals its freedom."""
    from scipy.optimize import brentq
    from scipy.special import chdtrc

    def exceeds(deviation: FloatArray, u: FloatArray, dof: int) -> bool:
        """Whether deviations are larger than what is stated explains, or nothing is stated."""
        unstated = bool(np.any(u == 0.0))
        return dof > 0 and (unstated or bool(chdtrc(dof, np.sum((deviation / u) ** 2)) < CHANCE))

    def tau(deviation: FloatArray, u: FloatArray, dof: int) -> float:
        """Solve Σ d²/(u² + τ²) = dof."""

        def beyond(tau: float) -> float:
            return float(np.sum(deviation**2 / (u**2 + tau**2))) - dof

        high = float(np.sqrt(np.sum(deviation**2) / dof))
        low = 1e-12 * high
        return float(brentq(beyond, low, high * (1.0 + 1e-9))) if high > 0.0 and beyond(low) > 0.0 else 0.0

    scatter = (0.0, 0.0)
    wanted = [exceeds(d, u, dof) for d, u, dof in zip(_groups(problem, x), problem.stated(), problem.dof, strict=True)]
    for _ in range(50 if any(wanted) else 0):
        parts = zip(_groups(problem, x), problem.stated(), problem.dof, wanted, strict=True)
        f, z = (tau(d, u, dof) if told else 0.0 for d, u, dof, told in parts)
        if np.allclose((f, z), scatter, rtol=1e-6, atol=0.0):
            break
        scatter = (f, z)
        x = refined(problem, x, scatter)[0]
    return scatter


def _groups(problem: SeriesProblem, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviations of ln f and of ln ζ."""
    count = len(problem.stated()[0])
    told = problem.residual(x, np.ones(sum(len(u) for u in problem.stated())))[0]
    return told[:count], told[count : count + len(problem.stated()[1])]


def _result(problem: SeriesProblem, x: FloatArray, scatter: tuple[float, float], excess: float) -> SeriesFit:
    """The fit at its minimum."""
    _, slope = problem.residual(x, problem.sigma(scatter))
    (f, z), _ = problem.modes(x)
    groups = zip(_groups(problem, x), problem.stated(), strict=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        chi = [float(np.nansum((d / u) ** 2)) for d, u in groups]
    known = all(tau > 0.0 or bool(np.all(u > 0.0)) for tau, u in zip(scatter, problem.stated(), strict=True))
    inner: FloatArray = np.asarray(np.linalg.inv(slope.T @ slope))
    covariance = number_covariance(problem, x, inner) if known else None
    return SeriesFit(
        numbers=problem.numbers(x),
        deviates=problem.deviates(x),
        covariance=covariance,
        frequency_hz=f,
        damping_ratio=z,
        scatter=scatter,
        chi_squared=(chi[0], chi[1]),
        dof=problem.dof,
        excess=excess,
    )


def number_covariance(problem: SeriesProblem, x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (P + Q, P + Q) of numbers and named mass errors from that of the unknowns (X, X)."""
    rates, count = problem.number_rates(x), len(problem.deviates(x))
    turn = np.zeros((len(rates) + count, len(x)))
    turn[: len(rates), : rates.shape[1]] = rates
    turn[len(rates) :, rates.shape[1] :] = np.eye(count)
    return np.asarray(turn @ covariance @ turn.T)


# Which second modes belong to the coupling of the load.


BELONGING_FARTHEST = 0.10
"""Relative distance of a second mode from where the first ones put it, from which it is another one."""


def belonging(measured: Resonances, masses: SeriesMasses) -> tuple[Resonances, tuple[int, ...]]:
    """Return the resonances without second modes that no coupling explains, and the records that had such.

    Where first resonances of several load masses tell k and k_L, they tell the second modes too. Without load there is
    none: what is seen there is of something else.
    """
    seen = np.isfinite(measured.frequency_hz[:, 1])
    foreign = seen & (masses.load == 0)
    if np.any(seen & ~foreign) and len(np.unique(np.round(masses.load / masses.moving, 3))) > 1:
        alone = _without_second(measured, np.ones(len(seen), dtype=np.bool_))
        foretold = np.array([fit.frequency_hz[:, 1] for fit in fit_resonances(alone, masses, rigid=False)])
        off = np.abs(measured.frequency_hz[:, 1] / foretold - 1.0)
        foreign |= seen & (masses.load > 0) & (np.min(off, axis=0) > BELONGING_FARTHEST)
    return _without_second(measured, foreign), tuple(int(place) for place in np.flatnonzero(foreign))


def _without_second(measured: Resonances, places: BoolArray) -> Resonances:
    """The resonances with the second modes of some records (R,) left out."""
    names = ("frequency_hz", "u_frequency_hz", "damping_ratio", "u_damping_ratio")
    left = {name: getattr(measured, name).copy() for name in names}
    for value in left.values():
        value[places, 1] = np.nan
    return replace(measured, **left)


# One load model fitted to the time records of all loads together.


ALLOWED = 2.0
"""Excess over that of white noise that is taken for the noise's colour."""


def fit_decays(decays: tuple[FreeDecay, ...], noise: FloatArray, problem: SeriesProblem, start: SeriesFit) -> SeriesFit:
    """Return the parameters that explain all records at once, from those that explain their resonances.

    Unknown are what all records share, k, c, k_L, c_L and the named masses; level and complex amplitude of every mode
    are free in every record. `noise` (R,): standard deviations of what free modes leave, the weights. The covariance
    takes the colour of the noise from the residuals.
    """
    count = problem.springs + problem.dampers
    first = np.concatenate([_logarithms(problem, start.numbers), start.deviates])

    def rows(x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        found = []
        for r, decay in enumerate(decays):
            poles, moved = _poles(problem, x, r)
            residual, slope = projected(decay, poles)
            by_x = slope @ np.stack([moved.real, moved.imag], axis=1).reshape(-1, len(x))
            found.append((residual / noise[r], by_x / noise[r]))
        prior = np.zeros((len(x) - count, len(x)))
        prior[:, count:] = np.eye(len(x) - count)
        return [*found, (x[count:], prior)]

    def at(x: FloatArray) -> Residuals | None:
        if not problem.is_sound(x):
            return None
        parts = rows(x)
        return Residuals(x, np.concatenate([part for part, _ in parts]), np.vstack([slope for _, slope in parts]))

    begin = at(first)
    if begin is None:
        raise ValueError("start: expected unknowns that a sensor may have, found others")
    x = levenberg_marquardt(at, begin, SEARCH).point.parameters
    parts = rows(x)
    inner = np.linalg.inv(sum((slope.T @ slope for _, slope in parts), np.zeros((len(x), len(x)))))
    middle = sum((coloured(slope, residual) for residual, slope in parts[:-1]), parts[-1][1].T @ parts[-1][1])
    (f, z), _ = problem.modes(x)
    return replace(
        start,
        numbers=problem.numbers(x),
        deviates=problem.deviates(x),
        covariance=number_covariance(problem, x, inner @ middle @ inner),
        frequency_hz=f,
        damping_ratio=z,
    )


def explains(decays: tuple[FreeDecay, ...], noise: FloatArray, problem: SeriesProblem, fit: SeriesFit) -> bool:
    """Return whether a model leaves no more of the records than modes of their own do, but for chance (1 in 1000).

    Σ |r|²/s² of the model less that of the free modes is a chi-squared with as many degrees of freedom as the model has
    fewer unknowns; twice its quantile is allowed, since the noise of a decimated record is not quite white.
    """
    from scipy.special import chdtri

    x = np.concatenate([_logarithms(problem, fit.numbers), fit.deviates])
    modes = np.sum(np.isfinite(problem.measured.frequency_hz), axis=1)
    more = 0.0
    for r, decay in enumerate(decays):
        residual, _ = projected(decay, _poles(problem, x, r)[0])
        more += float(residual @ residual) / float(noise[r]) ** 2 - (len(residual) - 1 - 4 * int(modes[r]))
    return more <= ALLOWED * float(chdtri(max(sum(problem.dof), 1), CHANCE))


def _poles(problem: SeriesProblem, x: FloatArray, record: int) -> tuple[ComplexArray, ComplexArray]:
    """Upper poles (M,) of one record and their derivatives (M, X)."""
    masses = problem.masses
    moving, loads = masses.at(problem.deviates(x))
    load = float(loads[record]) if masses.load[record] > 0 else 0.0
    poles, moved = upper_poles(problem.numbers(x), moving, load)
    by_mass = np.outer(moved[:, -2], masses.moving_effect) + np.outer(moved[:, -1], masses.load_effect[record])
    return poles, np.hstack([moved[:, :-2] @ problem.number_rates(x), by_mass])


def _logarithms(problem: SeriesProblem, numbers: FloatArray) -> FloatArray:
    """Logarithms of stiffnesses, then of the dampings that are unknowns."""
    return np.asarray(np.log(np.concatenate([numbers[::2], numbers[1::2][: problem.dampers]])))
