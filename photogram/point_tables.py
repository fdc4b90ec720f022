"""3-D points computed by other image correlation programs, read from their text tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photogram._checks import FloatArray, check_shape


@dataclass(frozen=True)
class PointTable:
    """Points of F frames: position_m (F,N,3), NaN where invalid; reference_m (N,3) where the files have it; names (F)."""

    position_m: FloatArray
    reference_m: FloatArray | None
    frames: tuple[str, ...]

    def __post_init__(self) -> None:
        check_shape("position_m", self.position_m, (len(self.frames), None, 3))
        if self.reference_m is not None:
            check_shape("reference_m", self.reference_m, (self.position_m.shape[1], 3))


def read_point_tables(
    files: Sequence[Path], columns: Sequence[str], valid_status: int | None = None, scale: float = 1.0
) -> PointTable:
    """Read one table per frame, or one .csv whose column `frame` numbers the frames; lengths times `scale` are metres."""
    raise NotImplementedError
