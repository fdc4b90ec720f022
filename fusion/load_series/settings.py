"""What a user of `shakercal load` may choose."""

from __future__ import annotations

from dataclasses import dataclass

PERMITTED = 0.05


@dataclass(frozen=True)
class LoadSettings:
    """`permitted`: error of a formula, or change of the resonance, up to which a load is permitted, as a share.

    `wanted_hz`: resonances that are to be kept; `predicted`: masses, such as those of grippers or of a hand, that
    characteristics are foretold for, kg or kg·m². `moving_mass`: of a table's sensor with its standard uncertainty, kg;
    of recordings the rig states it.
    """

    permitted: float = PERMITTED
    wanted_hz: tuple[float, ...] = ()
    predicted: tuple[float, ...] = ()
    moving_mass: tuple[float, float] | None = None

    def as_settings(self) -> dict[str, str | float | int]:
        """Return the choices by name."""
        found: dict[str, str | float | int] = {
            "permitted": self.permitted,
            "wanted_hz": " ".join(f"{value:.9g}" for value in self.wanted_hz),
            "predicted_load_masses": " ".join(f"{value:.9g}" for value in self.predicted),
        }
        if self.moving_mass is not None:
            found |= dict(zip(("moving_mass_kg", "u_moving_mass_kg"), self.moving_mass, strict=True))
        return found
