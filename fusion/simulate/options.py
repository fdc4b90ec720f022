"""What a simulation may leave out or make smaller."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationOptions:
    """Switches of truth and noise, each on its own.

    `image_noise`, `channel_noise`: shot, read and amplifier noise. `systematic_errors`: what the manifests state as
    uncertainties is drawn, else everything is exactly as stated. `trigger_jitter`: 30 ns rms. `aliased`: sharp 2 px
    speckle without lens blur. `frames`: fewer frames. `image_scale`: smaller images of a smaller face, same optics.
    """

    image_noise: bool = True
    channel_noise: bool = True
    systematic_errors: bool = True
    trigger_jitter: bool = True
    aliased: bool = False
    frames: int | None = None
    image_scale: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be a recording."""
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames: expected at least 3, found {self.frames}")
        if not 0.1 <= self.image_scale <= 1:
            raise ValueError(f"image_scale: expected 0.1 to 1, found {self.image_scale}")
