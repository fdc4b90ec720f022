"""What an evaluated transfer recording consists of, and what a user may choose about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from fusion.manifest import Manifest
from fusion.measured_results import ClockResult
from fusion.notices import Notice
from shaker._checks import ComplexArray, FloatArray
from shaker.models.resonance.oscillator import Resonance
from shaker.signals.transfer import TransferFunction

EstimatorChoice = Literal["auto", "periodic", "local", "H1", "H2", "Hv"]
Quantity = Literal["displacement", "velocity", "acceleration"]


@dataclass(frozen=True)
class TransferSettings:
    """Choices that change results: the estimator, the line spacing of averaged spectra (Hz), the motion's quantity.

    None leaves the line spacing to the record's length, and every motion in the quantity in which it was measured.
    """

    estimator: EstimatorChoice = "auto"
    resolution_hz: float | None = None
    quantity: Quantity | None = None

    def __post_init__(self) -> None:
        if self.estimator not in get_args(EstimatorChoice):
            raise ValueError(f"estimator: expected {', '.join(get_args(EstimatorChoice))}, found {self.estimator}")
        if self.resolution_hz is not None and not self.resolution_hz > 0.0:
            raise ValueError(f"resolution_hz: expected a number above 0, found {self.resolution_hz}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        resolution = "from the record" if self.resolution_hz is None else self.resolution_hz
        return {
            "estimator": self.estimator,
            "resolution_hz": resolution,
            "quantity": self.quantity or "as measured",
        }


@dataclass(frozen=True)
class CommonError:
    """One cause of error that acts on all lines at once.

    `relative` (K, C): complex relative deviation of every transfer function for one standard deviation of the cause.
    """

    name: str
    relative: ComplexArray


@dataclass(frozen=True)
class FoundResonance:
    """A resonance of one `response` over its reference, fitted over the lines between `band_hz`.

    `u_frequency_hz`, `u_damping_ratio`: standard uncertainties, noise and all common errors together; `budget`: by
    cause what one standard deviation changes of frequency (Hz) and damping ratio.
    """

    response: str
    reference: str
    fit: Resonance
    band_hz: tuple[float, float]
    u_frequency_hz: float
    u_damping_ratio: float
    budget: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class ReferenceResult:
    """All transfer functions over one reference (`name`).

    `transfer`: delays and responses taken off, quantity as wanted, covariance of noise and common errors together.
    `random_covariance` (K, 2C, 2C): that of the noise alone. `errors`: what is common to the lines. `resonances`: found
    in the curves.
    """

    name: str
    transfer: TransferFunction
    random_covariance: FloatArray
    errors: tuple[CommonError, ...]
    resonances: tuple[FoundResonance, ...]


@dataclass(frozen=True)
class TransferEvaluation:
    """One evaluated recording: transfer functions over every reference, clocks where blocks were tied, origin."""

    manifest: Manifest
    references: tuple[ReferenceResult, ...]
    clocks: tuple[ClockResult, ...]
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float
