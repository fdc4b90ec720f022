"""What a user may choose of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

ModelChoice = Literal["auto", "translation", "pitching", "adapter"]
DampingChoice = Literal["common", "each"]
MassChoice = Literal["auto", "free", "stated"]


@dataclass(frozen=True)
class IdentifySettings:
    """Choices that change results.

    `model`, `damping` (one for all recordings or one for each), `internal_mass` (fitted, or as stated in rig.toml);
    "auto" is decided from the recordings. `band_hz`: lines that are fitted, None for all. `load_masses_kg`: for which
    corrections and usable bands are given, none for those of the recordings. `permitted`: error of the magnitude up to
    which a band counts as usable.
    """

    model: ModelChoice = "auto"
    damping: DampingChoice = "common"
    internal_mass: MassChoice = "auto"
    band_hz: tuple[float, float] | None = None
    load_masses_kg: tuple[float, ...] = ()
    permitted: float = 0.05

    def __post_init__(self) -> None:
        for name, choices in (("model", ModelChoice), ("damping", DampingChoice), ("internal_mass", MassChoice)):
            if getattr(self, name) not in get_args(choices):
                raise ValueError(f"{name}: expected {', '.join(get_args(choices))}, found {getattr(self, name)}")
        if self.band_hz is not None and not 0.0 <= self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz: expected the lower frequency first, found {self.band_hz}")
        if any(not mass > 0.0 for mass in self.load_masses_kg):
            raise ValueError(f"load_masses_kg: expected masses above 0, found {self.load_masses_kg}")
        if not 0.0 < self.permitted < 1.0:
            raise ValueError(f"permitted: expected a share between 0 and 1, found {self.permitted}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        masses = ", ".join(f"{mass:.12g}" for mass in self.load_masses_kg)
        band = "all lines" if self.band_hz is None else f"{self.band_hz[0]:.12g} to {self.band_hz[1]:.12g}"
        return {
            "model": self.model,
            "damping": self.damping,
            "internal_mass": self.internal_mass,
            "band_hz": band,
            "load_masses_kg": masses or "those of the recordings",
            "permitted": self.permitted,
        }
