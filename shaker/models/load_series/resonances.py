"""What is measured of every load: resonances and dampings, read from records or stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape


@dataclass(frozen=True)
class Resonances:
    """First and second mode of R records: natural frequencies in Hz and damping ratios, (R, 2) each, NaN where unknown.

    `u_…`: standard uncertainties, 0 where none is known, so that only the scatter about a model tells.
    """

    names: tuple[str, ...]
    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping_ratio: FloatArray
    u_damping_ratio: FloatArray

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "u_frequency_hz", "damping_ratio", "u_damping_ratio"):
            check_shape(name, getattr(self, name), (len(self.names), 2))
        known = self.frequency_hz[np.isfinite(self.frequency_hz)]
        if np.any(known <= 0) or np.any(np.isnan(self.frequency_hz[:, 0])):
            raise ValueError("frequency_hz: expected a first resonance above 0 of every record, found none")

    @property
    def has_damping(self) -> bool:
        """Whether any damping is known."""
        return bool(np.any(np.isfinite(self.damping_ratio)))

    @property
    def has_second(self) -> bool:
        """Whether a second mode was seen."""
        return bool(np.any(np.isfinite(self.frequency_hz[:, 1])))


def stated_resonances(
    first_hz: FloatArray, u_first_hz: FloatArray | None = None, second_hz: FloatArray | None = None
) -> Resonances:
    """Return resonances without damping: first ones (R,), where known their uncertainties, and second ones or NaN.

    A second one is taken to be known as well, in parts of itself, as the first.
    """
    first = np.asarray(first_hz, dtype=np.float64)
    u = np.zeros_like(first) if u_first_hz is None else np.asarray(u_first_hz, dtype=np.float64)
    second = np.full_like(first, np.nan) if second_hz is None else np.asarray(second_hz, dtype=np.float64)
    both = np.stack([first, second], axis=1)
    empty = np.full_like(both, np.nan)
    return Resonances(tuple(f"{f:g} Hz" for f in first), both, both * (u / first)[:, None], empty, empty)
