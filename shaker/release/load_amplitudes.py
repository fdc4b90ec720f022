"""Amplitude dependence of the first mode over a series of loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shaker.release.load_modes import FreeDecay, Resonances, coloured_normal, free_modes
from shakercal._common.arrays import ComplexArray, FloatArray

_POWERS = (2, 1, -1)
"""Power of the amplitude with which the pole changes: cubic springs, hysteresis or drag, dry friction."""
_LONGEST = 3.0  # time constants of a decay in which its amplitude matters
_CHANCE = 1e-4  # chance of a significant dependence in noise
_ALLOWED = 1.5  # factor on its quantile, since the noise of a decimated record is not exactly white
_RANGE = float(np.exp(-1.0))  # smallest amplitude over the largest, for which linear models are compared
_LEAST_DAMPING = 0.02  # smallest damping ratio of a linear model, over the fitted one
STATIC_SHARE = 8.0 / 3.0  # relative change of the secant stiffness over that of the frequency, cubic spring


@dataclass(frozen=True)
class LoadAmplitudes:
    """First poles (R,) of records that change with a power of the amplitude.

    `ends`: poles (R,) without the change, at the largest amplitude, and at `smallest` times that.
    """

    power: int
    ends: tuple[ComplexArray, ...]
    smallest: float = _RANGE

    @property
    def changes(self) -> tuple[float, float]:
        """Mean relative changes of frequency and damping ratio from the largest to the smallest amplitude."""
        f, z = zip(*(_modal(poles) for poles in self.ends[1:]), strict=True)
        return float(np.mean(f[1] / f[0] - 1.0)), float(np.mean(z[1]) / np.mean(z[0]) - 1.0)

    @property
    def static_share(self) -> float:
        """Relative change of the static sensitivity by a cubic spring, otherwise 0."""
        (small, _), (large, _) = (_modal(poles) for poles in self.ends[:2])
        return STATIC_SHARE * float(np.mean(large / small - 1.0)) if self.power == _POWERS[0] else 0.0

    def widened(self, measured: Resonances) -> Resonances:
        """Return measured resonances whose uncertainties include the ends of the range."""
        others = [self.resonances(measured, end) for end in range(len(self.ends))]
        f, z = measured.frequency_hz, measured.damping_ratio
        far_f = np.max([np.abs(one.frequency_hz - f) for one in others], axis=0)
        far_z = np.max([np.abs(one.damping_ratio - z) for one in others], axis=0)
        u_f, u_z = np.hypot(measured.u_frequency_hz, far_f), np.hypot(measured.u_damping_ratio, far_z)
        return Resonances(measured.names, f, u_f, z, u_z)

    def resonances(self, measured: Resonances, end: int) -> Resonances:
        """Return measured resonances with the first mode at an end of the range."""
        f, z = measured.frequency_hz.copy(), measured.damping_ratio.copy()
        f[:, 0], damping = _modal(self.ends[end])
        z[:, 0] = np.maximum(damping, _LEAST_DAMPING * z[:, 0])
        return Resonances(measured.names, f, measured.u_frequency_hz, z, measured.u_damping_ratio)


def _modal(poles: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return natural frequencies in Hz and damping ratios."""
    return np.asarray(np.abs(poles) / (2.0 * np.pi)), np.asarray(-poles.real / np.abs(poles))


class _Change(NamedTuple):
    """Change of a pole, constant and with the amplitude, and χ² of the latter."""

    constant: complex
    with_amplitude: complex
    chi_squared: float


def load_amplitudes(decays: Sequence[FreeDecay], poles: Sequence[ComplexArray]) -> LoadAmplitudes | None:
    """Return how the first mode depends on its amplitude, None if that is not significant.

    The pole of an oscillation with the amplitude a is p + q·(a/a₀)ⁿ. To first order, with a = a₀·exp(-δt), q adds
    A·exp(pt)·∫exp(-nδt)dt to the output. Each n is tried for all records together.
    """
    from scipy.special import chdtri

    best: tuple[float, int, list[_Change]] | None = None
    for power in _POWERS:
        found = [_change(decay, of_record, power) for decay, of_record in zip(decays, poles, strict=True)]
        chi_squared = sum(change.chi_squared for change in found)
        if best is None or chi_squared > best[0]:
            best = chi_squared, power, found
    if best is None or best[0] < _ALLOWED * float(chdtri(2 * len(decays), _CHANCE / len(_POWERS))):
        return None
    _, power, found = best
    without: ComplexArray = np.array([p[0] + change.constant for p, change in zip(poles, found, strict=True)])
    slope: ComplexArray = np.array([change.with_amplitude for change in found])
    return LoadAmplitudes(power, tuple(np.asarray(without + slope * g) for g in (0.0, 1.0, _RANGE**power)))


def _change(decay: FreeDecay, poles: ComplexArray, power: int) -> _Change:
    """Return the change of a record's first pole with a power of its amplitude."""
    rate = max(float(-poles[0].real), 1e-3 * abs(poles[0]))
    time_s = decay.time_s - decay.time_s[0]
    part = FreeDecay(decay.name, decay.time_s, decay.value, decay.decimation)
    if (count := int(np.searchsorted(time_s, _LONGEST / rate))) < len(time_s):
        part = FreeDecay(decay.name, decay.time_s[:count], decay.value[:count], decay.decimation)
    point, t = free_modes(part, poles), time_s[: len(part.value)]
    wave = np.exp(t * poles[0]) * complex(*point.coefficients[0][[1, 1 + len(poles)], 0])
    along = wave * -np.expm1(-power * rate * t) / (power * rate)
    columns = np.hstack(
        [point.blocks[0].design, point.jacobians[0].rows[:, :, 0], np.stack([along.real, -along.imag], axis=1)]
    )
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / scale
    inverse = np.linalg.pinv(columns.T @ columns, rcond=1e-12, hermitian=True)
    coefficients = inverse @ (columns.T @ part.value)
    residual = part.value - columns @ coefficients
    covariance = inverse @ coloured_normal(columns, residual) @ inverse
    coefficients, covariance = coefficients / scale, covariance / np.outer(scale, scale)
    first = 1 + 2 * len(poles)
    change, spread = coefficients[-2:], covariance[-2:, -2:]
    return _Change(
        complex(*coefficients[first : first + 2]), complex(*change), float(change @ np.linalg.pinv(spread) @ change)
    )
