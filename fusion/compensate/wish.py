"""What the user wants of a compensation."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.errors import InputError
from shaker.models.compensation.bandwidth import target_for_bandwidth, target_for_frequency
from shaker.models.compensation.discrete import Discretisation
from shaker.models.compensation.dynamics import SensorDynamics
from shaker.models.compensation.target import Target

COMMAND = "shakercal compensate"


@dataclass(frozen=True)
class Wish:
    """The wanted dynamics and how the filter is made.

    Either `frequency_hz`, with `damping_ratio` or else that with the widest band for `permitted_error`, or
    `bandwidth_hz`: up to where the gain stays within ± `permitted_error` of the static one. `modes` are compensated,
    and the real poles if `real_hz` says where to; `low_pass_hz` is the corner of a low-pass in the filter.
    `calibrated`: the filter also divides by the static gain. `load_masses` in kg, those of a sensor whose load is
    modelled. `channels`: which, none for all. `ball_stiffness` in N/m: that of the virtual ball of a force-feedback
    check, None for no check.
    """

    frequency_hz: float | None = None
    damping_ratio: float | None = None
    bandwidth_hz: float | None = None
    permitted_error: float = 0.1
    real_hz: float | None = None
    low_pass_hz: float | None = None
    modes: int = 1
    sample_rate_hz: float | None = None
    discretisation: Discretisation = "matched"
    calibrated: bool = False
    load_masses: tuple[float, ...] = ()
    channels: tuple[str, ...] = ()
    ball_stiffness: float | None = None

    def __post_init__(self) -> None:
        if (self.frequency_hz is None) == (self.bandwidth_hz is None):
            found = "none" if self.frequency_hz is None else "both"
            raise InputError(COMMAND, "", found=found, expected="either --frequency or --bandwidth")
        if self.bandwidth_hz is not None and self.damping_ratio is not None:
            expected = "no --damping beside --bandwidth, which finds it"
            raise InputError(COMMAND, "--damping", found=f"{self.damping_ratio:g}", expected=expected)
        if not 0 < self.permitted_error < 1:
            expected = "a permitted error above 0 and below 100 %"
            raise InputError(COMMAND, "--permitted-error", found=f"{100 * self.permitted_error:g} %", expected=expected)

    def target(self, sensor: SensorDynamics) -> Target:
        """Return the target for a sensor."""
        if self.bandwidth_hz is not None:
            more = (self.permitted_error, self.real_hz, self.low_pass_hz)
            return target_for_bandwidth(sensor, self.bandwidth_hz, *more)
        frequency = float(self.frequency_hz or 0.0)
        if self.damping_ratio is None:
            more = (self.permitted_error, self.real_hz, self.low_pass_hz)
            return target_for_frequency(sensor, frequency, *more)
        return Target(frequency, self.damping_ratio, self.real_hz, self.low_pass_hz)

    @property
    def settings(self) -> dict[str, str | float | int]:
        """What was chosen, for the origin of the results."""
        given: dict[str, str | float | int] = {
            "permitted_error": self.permitted_error,
            "modes": self.modes,
            "discretisation": self.discretisation,
            "calibrated": int(self.calibrated),
        }
        for name in (
            "frequency_hz",
            "damping_ratio",
            "bandwidth_hz",
            "real_hz",
            "low_pass_hz",
            "sample_rate_hz",
            "ball_stiffness",
        ):
            value = getattr(self, name)
            if value is not None:
                given[name] = value
        if self.load_masses:
            given["load_masses_kg"] = ", ".join(f"{mass:.12g}" for mass in self.load_masses)
        if self.channels:
            given["channels"] = ", ".join(self.channels)
        return given
