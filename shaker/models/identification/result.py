"""What an identification says: parameters, modes, named errors, how well the model explains the curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.measured import ParameterEstimate
from shaker.notice import Notice


@dataclass(frozen=True)
class ModeEstimate:
    """One mode of one recording, `number` from 0 by rising frequency, with standard uncertainties.

    `frequency_hz` f₀ = |λ|/2π of the undamped oscillator, `damping_ratio` ζ = -Re λ/|λ| of the pole λ.
    """

    record: str
    number: int
    frequency_hz: float
    u_frequency_hz: float
    damping_ratio: float
    u_damping_ratio: float

    @property
    def quality(self) -> float:
        """Quality factor Q = 1/(2ζ)."""
        return 0.5 / self.damping_ratio

    @property
    def u_quality(self) -> float:
        """Standard uncertainty of Q."""
        return abs(self.quality / self.damping_ratio) * self.u_damping_ratio


@dataclass(frozen=True)
class NamedUnknown:
    """A named error as the recordings see it: `estimate` in its standard deviations, of which `remaining` is left."""

    name: str
    estimate: float
    remaining: float


@dataclass(frozen=True)
class FreeFactor:
    """Gain or delay of one response in one recording that was left free: the curve is H · gain · exp(-s delay)."""

    record: str
    channel: str
    gain: complex
    u_gain_relative: float
    u_gain_phase_rad: float
    delay_s: float
    u_delay_s: float


@dataclass(frozen=True)
class Identification:
    """Parameters of a structure from all recordings together.

    `estimates` (P): parameters, of one recording alone "name: recording"; `covariance` (P, P) of them, infinite
    where the recordings leave one open. `derived`: b/k of each spring and damper. `modes`: of each recording.
    `unknowns`: named errors. `factors`: free gains and delays. `model`, `residual` (K, C): per recording, curve with
    all errors found, and what was measured less the model. `chi_squared` of the residuals over the covariances as
    stated, with `dof`; where χ²/dof exceeds what noise explains, the noise is enlarged by the excess. `budget` by
    cause: change (P,) of the parameters for one standard deviation of a named error or of a number stated beforehand,
    and what "noise" adds; their squares sum up to the variances.
    """

    estimates: tuple[ParameterEstimate, ...]
    covariance: FloatArray
    derived: tuple[ParameterEstimate, ...]
    modes: tuple[ModeEstimate, ...]
    unknowns: tuple[NamedUnknown, ...]
    factors: tuple[FreeFactor, ...]
    model: tuple[ComplexArray, ...]
    residual: tuple[ComplexArray, ...]
    chi_squared: float
    dof: float
    notices: tuple[Notice, ...]
    budget: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (len(self.estimates), len(self.estimates)))

    def __getitem__(self, name: str) -> ParameterEstimate:
        """Return the parameter or derived number of a name."""
        for estimate in (*self.estimates, *self.derived):
            if estimate.name == name:
                return estimate
        names = ", ".join(estimate.name for estimate in (*self.estimates, *self.derived))
        raise ValueError(f"name: expected one of {names}, found {name}")

    def value(self, name: str) -> float:
        """Return the value of a parameter or derived number."""
        return self[name].value

    def u(self, name: str) -> float:
        """Return the standard uncertainty of a parameter or derived number."""
        return self[name].u

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of `covariance`."""
        return tuple(estimate.name for estimate in self.estimates)

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix (P, P) of the parameters; zero for what is fixed or open."""
        size = np.sqrt(self.covariance.diagonal())
        known = np.isfinite(size) & (size > 0.0)
        found = np.zeros_like(self.covariance)
        inside = np.ix_(known, known)
        found[inside] = self.covariance[inside] / np.multiply.outer(size[known], size[known])
        return found + np.diag(1.0 - found.diagonal())
