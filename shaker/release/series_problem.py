"""Fit of load models to the resonances of a series of loads: rows, unknowns, result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker.release.load_model import upper_poles
from shaker.release.load_modes import Resonances, SeriesMasses
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape

LARGEST = 100.0  # |logarithm| of a stiffness or damping above which a step has diverged
FLOOR = 1e-8  # relative uncertainty if none is stated or estimated yet


@dataclass(frozen=True)
class SeriesProblem:
    """A fit of ln f and ln ζ of the observed modes.

    A rigid load has first modes only. Unknown x (X,): logarithms of k and, unless `rigid`, k_L; then of c and c_L if a
    damping is measured; then the named mass errors in standard uncertainties.
    """

    measured: Resonances
    masses: SeriesMasses
    rigid: bool

    def __post_init__(self) -> None:
        check_shape("masses", self.masses.load, (len(self.measured.names),))
        if not self.rigid and (self.rows[0].sum() < 2 or not np.any(self.masses.load > 0)):
            raise ValueError(
                "measured: expected two resonances, one of them with a load, to determine the coupling, found "
                f"{int(self.rows[0].sum())}"
            )

    @cached_property
    def rows(self) -> tuple[BoolArray, BoolArray]:
        """Masks of the frequencies and of the dampings (R, 2) in the fit."""
        seen = np.isfinite(self.measured.frequency_hz)
        seen[:, 1] &= (self.masses.load > 0) & (not self.rigid)
        return seen, seen & (np.nan_to_num(self.measured.damping_ratio) > 0)

    @cached_property
    def powers(self) -> FloatArray:
        """Powers (P, S) of the exponentials in springs and dampers.

        They are k, c or k, c, k_L, c_L. c_L = c·k_L/k if only one damping is measured; all dampings are 0 without any.
        """
        springs = 1 if self.rigid else 2
        dampers = min(springs, int(self.rows[1].sum()))
        powers = np.zeros((2 * springs, springs + dampers))
        powers[::2, :springs] = np.eye(springs)
        powers[1::2, springs:] = np.eye(springs, dampers)
        if dampers == 1 and springs == 2:
            powers[3] = [-1.0, 1.0, 1.0]
        return powers

    @property
    def springs(self) -> int:
        """Number of stiffnesses."""
        return len(self.powers) // 2

    @property
    def dampers(self) -> int:
        """Number of dampings that the measured ones determine."""
        return int(self.powers.shape[1]) - self.springs

    @property
    def dof(self) -> tuple[int, int]:
        """Degrees of freedom of the frequencies and of the dampings."""
        f, z = self.rows
        return int(f.sum()) - self.springs, int(z.sum()) - self.dampers

    def numbers(self, x: FloatArray) -> FloatArray:
        """Return stiffnesses and dampings of unknowns x.

        k, c or k, c, k_L, c_L; dampings are 0 if none is measured.
        """
        numbers = np.exp(self.powers @ x[: self.powers.shape[1]])
        numbers[1::2] *= self.dampers > 0
        return np.asarray(numbers)

    def unknowns(self, fit: SeriesFit) -> FloatArray:
        """Return the unknowns (X,) that a fit found."""
        springs, dampers = fit.numbers[::2], fit.numbers[1::2][: self.dampers]
        return np.concatenate([np.log(springs), np.log(dampers), fit.deviates])

    def deviates(self, x: FloatArray) -> FloatArray:
        """Return the named mass errors (Q,) among the unknowns."""
        return x[self.powers.shape[1] :]

    def is_sound(self, x: FloatArray) -> bool:
        """Return whether the unknowns x are in the range of a real sensor."""
        moving, loads = self.masses.at(self.deviates(x))
        logarithms = np.abs(x[: self.powers.shape[1]])
        return bool(np.all(logarithms < LARGEST) and moving > 0.0 and np.all(loads[self.masses.load > 0] > 0.0))

    def number_rates(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (P, S) of the numbers by the logarithms of springs and dampers."""
        return np.asarray(self.numbers(x)[:, None] * self.powers)

    def poles(self, x: FloatArray, record: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the upper poles (M,) of one record and their derivatives (M, X)."""
        moving, loads = self.masses.at(self.deviates(x))
        load = float(loads[record]) if self.masses.load[record] > 0 else 0.0
        poles, moved = upper_poles(self.numbers(x), moving, load)
        by_mass = np.outer(moved[:, -2], self.masses.moving_effect)
        by_mass = by_mass + np.outer(moved[:, -1], self.masses.load_effect[record])
        return poles, np.hstack([moved[:, :-2] @ self.number_rates(x), by_mass])

    def modes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies and damping ratios (2, R, 2) with derivatives of ln f and ζ.

        The derivatives (2, R, 2, X) are by the unknowns x (X,).
        """
        values = np.full((2, len(self.masses.load), 2), np.nan)
        rates = np.zeros((*values.shape, len(x)))
        for r in range(values.shape[1]):
            poles, change = self.poles(x, r)
            count, size = len(poles), np.abs(poles)
            along = (np.conj(poles)[:, None] * change).real / size[:, None] ** 2
            values[0, r, :count], values[1, r, :count] = size / (2.0 * np.pi), -poles.real / size
            rates[0, r, :count] = along
            rates[1, r, :count] = -change.real / size[:, None] + (poles.real / size)[:, None] * along
        return values, rates

    def residual(self, x: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return weighted residuals (N + Q,) and their derivatives (N + Q, X).

        `sigma` (N,) of ln f, then of ln ζ.
        """
        (f, z), rates = self.modes(x)
        f_rows, z_rows = self.rows
        left, slopes = [np.log(f[f_rows] / self.measured.frequency_hz[f_rows])], [rates[0][f_rows]]
        if self.dampers:
            with np.errstate(invalid="ignore", divide="ignore"):
                left.append(np.log(z[z_rows] / self.measured.damping_ratio[z_rows]))
                slopes.append(rates[1][z_rows] / z[z_rows][:, None])
        prior, by_prior = self.prior(x)
        residual = np.concatenate([np.concatenate(left) / sigma, prior])
        return residual, np.vstack([np.vstack(slopes) / sigma[:, None], by_prior])

    def prior(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the stated masses as residuals (Q,) with their derivatives (Q, X)."""
        deviates = self.deviates(x)
        return deviates, np.eye(len(x))[len(x) - len(deviates) :]

    def stated(self) -> tuple[FloatArray, FloatArray]:
        """Return the stated relative standard uncertainties of the fitted frequencies and dampings."""
        f_rows, z_rows = self.rows
        seen = self.measured
        f = seen.u_frequency_hz[f_rows] / seen.frequency_hz[f_rows]
        z = seen.u_damping_ratio[z_rows] / seen.damping_ratio[z_rows] if self.dampers else np.zeros(0)
        return np.nan_to_num(f), np.nan_to_num(z)

    def groups(self, x: FloatArray) -> list[tuple[FloatArray, FloatArray, int]]:
        """Return deviations, stated uncertainties and degrees of freedom by quantity.

        The quantities are ln f and ln ζ.
        """
        f, z = self.stated()
        left = self.residual(x, np.ones(len(f) + len(z)))[0]
        parts = left[: len(f)], left[len(f) : len(f) + len(z)]
        return list(zip(parts, (f, z), self.dof, strict=True))

    def sigma(self, scatter: tuple[float, float]) -> FloatArray:
        """Return relative standard deviations (N,) of all rows. `scatter` is added to the stated ones."""
        parts = [np.sqrt(u**2 + tau**2 + FLOOR**2) for u, tau in zip(self.stated(), scatter, strict=True)]
        return np.concatenate(parts)

    def start(self, ratio: float) -> FloatArray:
        """Return start unknowns (X,) for a ratio k_L/k.

        They give resonance and damping of the lightest load.
        """
        lightest = int(np.argmin(self.masses.load))
        shape = np.array([1.0, 0.0] if self.rigid else [1.0, 0.0, ratio, 0.0])
        load = float(self.masses.load[lightest])
        omega = 2.0 * np.pi * float(self.measured.frequency_hz[lightest, 0])
        k = (omega / abs(upper_poles(shape, self.masses.moving, load)[0][0])) ** 2
        springs = np.log(k * shape[::2])
        zeta = self.measured.damping_ratio[self.rows[1]]
        dampers = springs[: self.dampers] + (np.log(2.0 * np.median(zeta) / omega) if self.dampers else 0.0)
        return np.concatenate([springs, dampers, np.zeros(len(self.masses.names))])


@dataclass(frozen=True, repr=False)
class SeriesFit(Arrays):
    """Parameters of a load model from a series of R records.

    `numbers` (P,): stiffness and damping, and those of the coupling unless rigid; dampings are 0 if none was measured.
    `deviates` (Q,): named mass errors in standard uncertainties. `covariance` (P + Q, P + Q) of both, None if the
    scatter is unknown. `frequency_hz`, `damping_ratio` (R, 2) of the model. `scatter`: relative standard deviations of
    frequencies and of dampings about the model in addition to the stated ones. `chi_squared` of both for the stated
    uncertainties, with `dof`. `excess`: χ² above that of the best minimum.
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
