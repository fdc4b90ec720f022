"""One recorded channel as it stands in a file."""

from __future__ import annotations

from dataclasses import dataclass

from shaker._checks import FloatArray, check_shape


@dataclass(frozen=True)
class RawChannel:
    """Samples of one channel in the file's own unit.

    `samples` (S,), taken at `start_s + i / sample_rate_hz`; `start_s` is the file's start time (s, 0 where the file
    states none), `unit` the file's own words (empty where it has none).
    """

    samples: FloatArray
    sample_rate_hz: float
    start_s: float = 0.0
    unit: str = ""

    def __post_init__(self) -> None:
        check_shape("samples", self.samples, (None,))
        if not self.sample_rate_hz > 0.0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
