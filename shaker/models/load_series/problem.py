"""Rows and unknowns of a fit of load models to resonances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.models.load_series.chain_poles import upper_poles
from shaker.models.load_series.masses import SeriesMasses
from shaker.models.load_series.resonances import Resonances

LARGEST = 100.0
"""Logarithm of a stiffness or damping, in size, from which a step has gone astray."""
FLOOR = 1e-8
"""Relative uncertainty that stands where none is stated and none has shown yet."""


@dataclass(frozen=True)
class Problem:
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
