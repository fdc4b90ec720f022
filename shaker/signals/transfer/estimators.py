"""H1, H2 and Hv from averaged spectra, their covariance, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.transfer.result import circular_covariance

_TOLERANCE = 0.3  # bias of an estimator, over its standard uncertainty, that is accepted
_TELLING = 0.5  # coherence from which 1 - γ² is about the sum of the two noise-to-signal ratios


@dataclass(frozen=True)
class Spectra:
    """Averaged spectra `power` (K, 1 + C, 1 + C) = E[z zᴴ] of [reference, responses], each worth `averages` (K,)."""

    power: ComplexArray
    averages: FloatArray

    def __post_init__(self) -> None:
        check_shape("power", self.power, (None, self.power.shape[-1], self.power.shape[-1]))
        check_shape("averages", self.averages, (len(self.power),))

    @property
    def reference(self) -> FloatArray:
        """S_xx (K,)."""
        return np.asarray(self.power[:, 0, 0].real)

    @property
    def responses(self) -> FloatArray:
        """S_yy (K, C)."""
        return np.asarray(np.einsum("kcc->kc", self.power).real[:, 1:])

    @property
    def cross(self) -> ComplexArray:
        """E[y x*] (K, C), which over S_xx is H1."""
        return np.asarray(self.power[:, 1:, 0])

    @property
    def coherence(self) -> FloatArray:
        """|S_xy|²/(S_xx S_yy) (K, C), one where a channel is silent."""
        both = self.reference[:, None] * self.responses
        found = np.divide(np.abs(self.cross) ** 2, both, out=np.ones_like(both), where=both > 0.0)
        return np.asarray(np.minimum(found, 1.0))


@dataclass(frozen=True)
class Choice:
    """The estimator taken, the ratio of the noise powers that Hv uses, and why."""

    estimator: Literal["H1", "H2", "Hv"]
    noise_ratio: float
    why: str

    def notice(self, where: str, averaged: str) -> Notice:
        """Return the notice that tells the choice."""
        return Notice("info", f"{self.estimator} of {averaged}: {self.why}", where)


@dataclass(frozen=True)
class Estimate:
    """Ratio (K, C), covariance (K, 2C, 2C), coherence (K, C)."""

    ratio: ComplexArray
    covariance: FloatArray
    coherence: FloatArray


def transfer_of(spectra: Spectra, choice: Choice) -> Estimate:
    """Return the ratio of the responses to the reference with the estimator chosen."""
    ratio = _ratio(spectra, choice)
    power, averages = spectra.power, spectra.averages
    cross = ratio[:, :, None] * spectra.cross.conj()[:, None, :]
    # Power of y - H x for the H found; for H1 it is what the regression leaves.
    left = power[:, 1:, 1:] - cross - cross.conj().swapaxes(1, 2)
    left = left + ratio[:, :, None] * ratio.conj()[:, None, :] * power[:, :1, :1]
    coherence = spectra.coherence
    if np.all(averages > 1.0):
        noise = left / (power[:, :1, :1].real * (averages[:, None, None] - 1.0))
        if choice.estimator != "H1":
            loss = 1.0 / np.sqrt(np.maximum(coherence, 1.0 / averages[:, None]))
            noise = noise * loss[:, :, None] * loss[:, None, :]
        covariance = circular_covariance(_positive(noise))
    else:
        covariance = np.full((len(ratio), 2 * ratio.shape[1], 2 * ratio.shape[1]), np.nan)
    return Estimate(ratio, covariance, coherence)


def _ratio(spectra: Spectra, choice: Choice) -> ComplexArray:
    """Return H (K, C); Hv minimises the noise |n_x|² + |n_y|²/κ that explains the spectra."""
    cross, reference, responses = spectra.cross, spectra.reference[:, None], spectra.responses
    if choice.estimator == "H1":
        return np.asarray(cross / reference)
    if choice.estimator == "H2":
        return np.asarray(responses / cross.conj())
    kappa = choice.noise_ratio
    difference = responses - kappa * reference
    root = np.sqrt(difference**2 + 4.0 * kappa * np.abs(cross) ** 2)
    return np.asarray((difference + root) / (2.0 * cross.conj()))


def _positive(noise: ComplexArray) -> ComplexArray:
    """Return Hermitian matrices with a diagonal that rounding has not made negative."""
    hermitian = 0.5 * (noise + noise.conj().swapaxes(1, 2))
    diagonal = np.arange(noise.shape[1])
    hermitian[:, diagonal, diagonal] = np.maximum(hermitian[:, diagonal, diagonal].real, np.finfo(np.float64).tiny)
    return np.asarray(hermitian)


def choose_estimator(
    spectra: Spectra,
    wanted: Literal["auto", "H1", "H2", "Hv"],
    noise_ratio: float | None,
    reference_name: str,
) -> Choice:
    """Return the estimator to take: the one wanted, or the one whose bias stays below its uncertainty.

    The coherence tells noise on the reference from noise on a response, if both are about white over the band:
    1 - γ² = N_x/S_xx + N_y/S_yy, solved for N_x, N_y ≥ 0 by weighted least squares.
    """
    if noise_ratio is not None and not noise_ratio > 0.0:
        raise ValueError(f"noise_ratio: expected a positive number, found {noise_ratio}")
    on_reference, on_response, bias_h1, bias_h2 = _noise_shares(spectra)
    found = noise_ratio if noise_ratio is not None else _quotient(on_response, on_reference)
    if wanted != "auto":
        if wanted == "Hv" and found is None:
            raise ValueError(
                "noise_ratio: expected the ratio of the noise powers, found none and no noise to tell it by"
            )
        return Choice(wanted, found or 1.0, "as asked")
    if bias_h1 <= _TOLERANCE:
        return Choice("H1", found or 1.0, f"noise on {reference_name} biases it by less than its uncertainty")
    if bias_h2 <= _TOLERANCE:
        return Choice("H2", found or 1.0, f"the noise is on {reference_name}, little on the responses")
    why = f"noise on {reference_name} and on the responses, powers in the ratio 1 : {found or 1.0:.3g}"
    return Choice("Hv", found or 1.0, why)


def _quotient(on_response: float, on_reference: float) -> float | None:
    """Return the ratio of the noise powers where both are known."""
    return on_response / on_reference if on_reference > 0.0 and on_response > 0.0 else None


def _noise_shares(spectra: Spectra) -> tuple[float, float, float, float]:
    """Return noise powers on reference and responses, and the bias of H1 and H2 over its uncertainty (95th centile)."""
    from scipy.optimize import nnls

    coherence = spectra.coherence
    bias = (1.0 - coherence) ** 2 / spectra.averages[:, None]
    missing = np.maximum(1.0 - coherence - bias, 0.0)
    # The estimate of 1 - γ² scatters by about √2 γ (1 - γ²)/√n; a smooth stand-in weighs the lines.
    scale = 1.0 / np.maximum(missing, np.maximum(np.median(missing), 1e-12))
    fits, shares = [], []
    for c in range(coherence.shape[1]):
        told = _telling(coherence[:, c])
        x, y, averages = spectra.reference[told], spectra.responses[told, c], spectra.averages[told]
        columns = np.stack([1.0 / x, 1.0 / y], axis=1) * scale[told, c, None]
        unit = np.linalg.norm(columns, axis=0)
        level = nnls(columns / unit, missing[told, c] * scale[told, c])[0] / unit
        fits.append(level)
        u_relative = np.sqrt(np.maximum(missing[told, c], 1e-12) / averages)
        shares.append(np.quantile([level[0] / x / u_relative, level[1] / y / u_relative], 0.95, axis=1))
    noise = np.median(fits, axis=0)
    bias_h1, bias_h2 = np.max(shares, axis=0)
    return float(noise[0]), float(noise[1]), float(bias_h1), float(bias_h2)


def _telling(coherence: FloatArray) -> BoolArray:
    """Tell the lines (K,) whose signal is above the noise, all where none is: beside a band, noise is all there is."""
    above = coherence > _TELLING
    return np.asarray(above if above.any() else np.ones_like(above))
