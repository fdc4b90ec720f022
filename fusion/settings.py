"""What a user may choose about a run, beside the manifest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

ProgressCallback = Callable[[str, int, int], None]
"""Called as (stage, done, total) during long work."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Ignore progress, the default of library calls."""


@dataclass(frozen=True)
class Settings:
    """Choices that change results and therefore belong to a result's identity.

    `subset_radius_px`: subsets are squares of 2·radius + 1 pixels, laid side by side so that their noise is
    independent; None takes it from the speckle size found in the images. `spline_degree`: B-spline interpolation of
    the images, 3, 5 or 7 (7 keeps the interpolation bias below the noise of a whole recording). `device`: where subsets
    are tracked, "auto", "cpu" or "cuda"; the positions agree to 1e-6 px, so that it does not count in `as_dict`.
    """

    subset_radius_px: int | None = None
    spline_degree: int = 7
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.subset_radius_px is not None and not 4 <= self.subset_radius_px <= 100:
            raise ValueError(f"subset_radius_px: expected 4 to 100, found {self.subset_radius_px}")
        if self.spline_degree not in (3, 5, 7):
            raise ValueError(f"spline_degree: expected 3, 5 or 7, found {self.spline_degree}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        radius = "from speckle" if self.subset_radius_px is None else self.subset_radius_px
        return {"subset_radius_px": radius, "spline_degree": self.spline_degree}
