"""What the user chooses of an identification from step responses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MethodChoice = Literal["pencil", "arx", "all"]
ReleaseChoice = Literal["auto", "step", "ramp", "smooth", "measured"]


@dataclass(frozen=True)
class StepSettings:
    """`method`: what the start of a fit comes from; "all" compares every method beside the default one.

    `modes`, `real_poles`: the structure of the models, chosen by rule where None; `release`: how the load goes, chosen
    by rule for "auto".
    """

    method: MethodChoice = "pencil"
    modes: int | None = None
    real_poles: int | None = None
    release: ReleaseChoice = "auto"

    def as_settings(self) -> dict[str, str | float | int]:
        """Return what was chosen, for the results."""
        found: dict[str, str | float | int] = {"method": self.method, "release": self.release}
        for name in ("modes", "real_poles"):
            value = getattr(self, name)
            found[name] = "by rule" if value is None else value
        return found
