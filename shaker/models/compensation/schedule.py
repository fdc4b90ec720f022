"""Compensation filters over the load that a sensor carries."""

from __future__ import annotations

from dataclasses import dataclass

from shaker.models.compensation.discrete import Discretisation, Sections, filled, sampled
from shaker.models.compensation.dynamics import loaded_dynamics
from shaker.models.compensation.filter import Compensation
from shaker.models.compensation.target import Target
from shaker.models.load_series.model import LoadModel


@dataclass(frozen=True)
class Schedule:
    """One target for every load: poles are computed anew for each load mass in kg, `modes` of them are compensated.

    The target of the lowest mode stays, so that the compensated sensor answers alike whatever it carries.
    """

    model: LoadModel
    target: Target
    modes: int = 1
    calibrated: bool = False

    def at(self, load_mass: float, u_load_mass: float = 0.0) -> Compensation:
        """Return the filter for a load."""
        sensor = loaded_dynamics(self.model, load_mass, modes=self.modes, u_load_mass=u_load_mass)
        return Compensation(sensor, self.target, self.calibrated)

    def sections(self, load_mass: float, sample_rate_hz: float, method: Discretisation = "matched") -> Sections:
        """Return the filter for a load and samples, always as many sections, for `CompensationFilter.switch`.

        Where a load has fewer modes the last sections let everything pass.
        """
        return filled(
            sampled(self.at(load_mass), sample_rate_hz, method), self.modes + (self.target.low_pass_hz is not None)
        )
