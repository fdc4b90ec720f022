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
    independent. `spline_degree`: B-spline interpolation of the images, 3 or 5 (5 keeps the interpolation bias
    below the noise of a whole recording).
    """

    subset_radius_px: int = 10
    spline_degree: int = 5

    def __post_init__(self) -> None:
        if not 4 <= self.subset_radius_px <= 100:
            raise ValueError(f"subset_radius_px: expected 4 to 100, found {self.subset_radius_px}")
        if self.spline_degree not in (3, 5):
            raise ValueError(f"spline_degree: expected 3 or 5, found {self.spline_degree}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        return {"subset_radius_px": self.subset_radius_px, "spline_degree": self.spline_degree}
