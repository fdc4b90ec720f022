"""Unstated filters of measuring chains, found in the curve of one resonance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from shaker.identification.measured_curves import CurveError
from shaker.identification.oscillator import DampingLaw, Resonance
from shaker.identification.rival_models import added_uncertainty
from shakercal._common.arrays import ComplexArray, FloatArray

LAWS: tuple[DampingLaw, DampingLaw] = ("viscous", "loss factor")
"""The laws of damping that are compared."""
UNSTATED_FILTER = "unstated filter of a chain"
"""Cause in the budget."""
_FORMS = ({"delay": True}, {"delay": True, "residual_terms": True}, {"unstated_filter": True})
"""What is fitted in addition to one oscillator: a delay alone, with other modes, or as part of a filter."""
_WORDS = ("an oscillator", "an oscillator with modes outside the band", "an oscillator with an unstated filter of {}")
_EXPLAINED = 1.2  # χ² per degree of freedom up to which a form explains the lines up to the valleys
_REJECTED = 9.0  # χ² per degree of freedom from which a form says nothing of the chains
_DECISIVE = 6.0  # difference of Akaike's criterion that decides, Akaike weights in the ratio 1 : 20
_NEEDED = 25.0  # difference from which a delay does not suffice; noise of correlated lines makes it smaller
_BY_CHANCE = 1e-4  # probability by which stated errors explain a filter, below which it is named
_OF_K = 2.0 / 1.96  # k = 2 over that of a normal distribution

FitOfForm = Callable[..., Resonance]
"""Fits the curve; keywords are those of `fit_resonance`."""


@dataclass(frozen=True)
class WideFit:
    """One oscillator fitted from valley to valley, and the place of its form in `_FORMS`."""

    form: int
    fit: Resonance

    @property
    def is_explained(self) -> bool:
        """Whether its residuals are noise."""
        return self.excess < max(_EXPLAINED, 1.0 + 5.0 * float(np.sqrt(2.0 / self.fit.dof)))

    @property
    def excess(self) -> float:
        """χ² per degree of freedom."""
        return self.fit.chi_squared / self.fit.dof

    def criterion(self, excess: float) -> float:
        """Return Akaike's criterion, χ² divided by the excess of the best form."""
        return self.fit.chi_squared / max(1.0, excess) + 2.0 * len(self.fit.parameters)


@dataclass(frozen=True)
class FoundFilter:
    """What a filter that no manifest states does to a curve.

    `factor` (K,): of the curve. `u` (K,): standard uncertainty of its logarithm. `lag_s`: at the resonance. `change`:
    relative, of the magnitude at the highest line. `rivals`: forms that the data do not decide between, in words, empty
    if the filter is certain.
    """

    factor: ComplexArray
    u: FloatArray
    lag_s: float
    change: float
    rivals: tuple[str, ...]

    def error(self, errors: Sequence[CurveError]) -> ComplexArray:
        """Return the relative error (K,) of the curve in addition to stated `errors`.

        It is that of one standard uncertainty. U covers the curve without the filter, in magnitude and phase.
        """
        parts = []
        for logarithm, part in ((np.log(np.abs(self.factor)), np.real), (np.angle(self.factor), np.imag)):
            stated = np.linalg.norm([np.zeros(len(self.u)), *(part(error.relative) for error in errors)], axis=0)
            both = zip(stated.tolist(), logarithm.tolist(), np.hypot(stated, self.u).tolist(), strict=True)
            parts.append(_OF_K * np.array([added_uncertainty(0.0, u, other, u_other) for u, other, u_other in both]))
        return np.asarray(parts[0] + 1j * parts[1])


def wide_fits(fitted: FitOfForm) -> list[WideFit]:
    """Return the fits of all forms with both laws of damping.

    Those that fail are left out.
    """
    found = []
    for form, words in enumerate(_FORMS):
        for law in LAWS:
            try:
                found.append(WideFit(form, fitted(**words, law=law)))
            except (ValueError, np.linalg.LinAlgError):
                continue
    return found


def decided_law(wide: Sequence[WideFit]) -> DampingLaw | None:
    """Return the law of damping by the simplest form that explains the lines.

    It is None if that form does not decide.
    """
    for form in range(len(_FORMS)):
        fits = [one for one in wide if one.form == form]
        if any(one.is_explained for one in fits):
            left = [one.fit.chi_squared for one in fits]
            decides = len(left) == len(LAWS) and np.ptp(left) > _DECISIVE
            return fits[int(np.argmin(left))].fit.law if decides else None
    return None


def unstated_filter(
    wide: Sequence[WideFit], frequency_hz: FloatArray, errors: Sequence[CurveError], names: str
) -> FoundFilter | None:
    """Return the filter that stated `errors`, each (K,) at all lines, do not explain.

    It is certain if every form that the data leave open has it. `names`: of the channels, in words.
    """
    excess = min((one.excess for one in wide), default=np.inf)
    if excess >= _REJECTED:
        return None
    least = min(one.criterion(excess) for one in wide)
    remaining = [one for one in wide if one.criterion(excess) < least + (_DECISIVE if one.form else _NEEDED)]
    if any(one.form == 0 for one in remaining):  # the others are more than needed
        least = min(one.criterion(excess) for one in remaining if one.form == 0)
        remaining = [one for one in remaining if one.form == 0 and one.criterion(excess) < least + _DECISIVE]
    found = [
        (one, *_logarithm(one.fit, frequency_hz)) for one in remaining if _is_significant(one.fit, frequency_hz, errors)
    ]
    if not found or (len(found) < len(remaining) and remaining[0].form == 0):
        return None  # by one law of damping there is no unstated delay
    best, logarithm, u = max(found, key=lambda one: (one[0].form, -one[0].criterion(excess)))
    fit = best.fit
    at = int(np.argmin(np.abs(frequency_hz - fit.frequency_hz)))
    lag_s = -float(logarithm[at].imag) / (2.0 * np.pi * float(frequency_hz[at]))
    rivals = tuple(dict.fromkeys(_WORDS[one.form].format(names) for one in remaining))
    rivals = rivals if len(found) < len(remaining) else ()
    return FoundFilter(np.exp(logarithm), u, lag_s, float(np.expm1(logarithm[-1].real)), rivals)


def _basis(fit: Resonance, frequency_hz: FloatArray) -> ComplexArray:
    """Return the derivatives (K, P) of the logarithm of the chains by their numbers."""
    s = 2j * np.pi * frequency_hz
    columns = [np.full(len(s), 1j), -s, s**2, s**3]
    return np.stack(columns[: 4 if "loss_s2" in fit.parameters else 2], axis=1)


def _numbers(fit: Resonance) -> tuple[FloatArray, FloatArray]:
    """Return phase, delay, loss and dispersion, as fitted, with their covariance.

    A gain below 0 has no phase.
    """
    gain = fit.gain if fit.gain.real > 0.0 else -fit.gain
    slopes = np.zeros((4, len(fit.parameters)))
    real, imaginary = (fit.parameters.index(name) for name in ("gain_re", "gain_im"))
    slopes[0, [real, imaginary]] = np.array([-gain.imag, gain.real]) * (gain / fit.gain).real / abs(gain) ** 2
    rest = [name for name in ("delay_s", "loss_s2", "dispersion_s3") if name in fit.parameters]
    for row, name in enumerate(rest, 1):
        slopes[row, fit.parameters.index(name)] = 1.0
    slopes = slopes[: 1 + len(rest)]
    numbers = np.array([float(np.angle(gain)), fit.delay_s, *fit.filter_terms])[: len(slopes)]
    return numbers, slopes @ fit.covariance @ slopes.T


def _logarithm(fit: Resonance, frequency_hz: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return the logarithm (K,) of the fitted filter, and its standard uncertainty."""
    (numbers, covariance), basis = _numbers(fit), _basis(fit, frequency_hz)
    variance = np.einsum("kp,pq,kq->k", basis, covariance, basis.conj()).real
    return basis @ numbers, np.sqrt(np.maximum(variance, 0.0))


def _is_significant(fit: Resonance, frequency_hz: FloatArray, errors: Sequence[CurveError]) -> bool:
    """Return whether a fitted filter is beyond noise and stated errors (K,)."""
    (numbers, covariance), basis = _numbers(fit), _basis(fit, frequency_hz)
    scale = np.max(np.abs(basis), axis=0)
    columns = np.column_stack([np.ones(len(basis)), basis / scale])  # a scale is no filter
    stacked = np.concatenate([columns.real, columns.imag])
    rows = [np.concatenate([error.relative.real, error.relative.imag]) for error in errors]
    stated = np.linalg.lstsq(stacked, np.array(rows).T, rcond=None)[0][1:] if rows else np.zeros((len(numbers), 0))
    whole = covariance * np.multiply.outer(scale, scale) + stated @ stated.T
    numbers = numbers * scale
    return bool(numbers @ np.linalg.solve(whole, numbers) > chi2.isf(_BY_CHANCE, len(numbers)))
