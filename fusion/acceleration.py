"""The six-component acceleration of one body, with all that its estimate says of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fusion.consistency import CommonEstimate, Consistency
from fusion.discrepancy import Scatter
from fusion.notices import AnyNotice
from fusion.uncertainty import Contribution, Uncertainty
from shaker._checks import BoolArray
from shaker.signals.phasor import Phasors

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
UNITS = ("m/s^2",) * 3 + ("rad/s^2",) * 3


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `uncertainty` of the six components, NaN
    where not observed: noise of every instrument and the common errors, which act on all lines at once. `unknowns`:
    what the data say of those. `consistency`, `chi2` and `dof` rest on what is stated; `scatter`: instruments whose
    readings scatter beyond that.
    """

    body: str
    source: Source
    phasors: Phasors
    observed: BoolArray
    instruments: tuple[str, ...]
    uncertainty: Uncertainty
    consistency: tuple[Consistency, ...]
    chi2: float
    dof: int
    unknowns: tuple[CommonEstimate, ...]
    notices: tuple[AnyNotice, ...]
    scatter: tuple[Scatter, ...] = ()

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of the phasors."""
        return self.uncertainty.grouped()
