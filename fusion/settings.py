"""What a user may choose about a run, beside the manifest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

DEFAULT_SEED = 20180401
FEWEST_DRAWS, MOST_DRAWS = 1000, 1_000_000
"""Of a Monte Carlo run: 95 % intervals of fewer draws mean nothing, more do not fit into memory."""
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
    `monte_carlo`: draws that check the first-order uncertainties, 0 for none, from the streams of `seed`.
    """

    subset_radius_px: int | None = None
    spline_degree: int = 7
    device: str = "auto"
    monte_carlo: int = 0
    seed: int = DEFAULT_SEED

    def __post_init__(self) -> None:
        if self.subset_radius_px is not None and not 4 <= self.subset_radius_px <= 100:
            raise ValueError(f"subset_radius_px: expected 4 to 100, found {self.subset_radius_px}")
        if self.spline_degree not in (3, 5, 7):
            raise ValueError(f"spline_degree: expected 3, 5 or 7, found {self.spline_degree}")
        if self.monte_carlo and not FEWEST_DRAWS <= self.monte_carlo <= MOST_DRAWS:
            raise ValueError(f"monte_carlo: expected {FEWEST_DRAWS} to {MOST_DRAWS}, found {self.monte_carlo}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, found {self.seed}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        radius = "from speckle" if self.subset_radius_px is None else self.subset_radius_px
        drawn = {"monte_carlo": self.monte_carlo, "seed": self.seed} if self.monte_carlo else {}
        return {"subset_radius_px": radius, "spline_degree": self.spline_degree, **drawn}
