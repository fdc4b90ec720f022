"""Which lines a recording contains: fundamentals refined, harmonics that stand out of the noise."""

from __future__ import annotations

from dataclasses import dataclass

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.notice import Notice


@dataclass(frozen=True)
class Lines:
    """Lines of a recording in ascending frequency.

    `frequency_hz`, `u_frequency_hz` (K,) on the clock of the times given; `nominal_hz` (K,) the nominal fundamental
    each belongs to, `multiple` (K,) its harmonic number; `why` (K,) why it is in the list.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    nominal_hz: FloatArray
    multiple: IntArray
    why: tuple[str, ...]
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        lines = self.frequency_hz.shape
        check_shape("u_frequency_hz", self.u_frequency_hz, lines)
        check_shape("nominal_hz", self.nominal_hz, lines)
        check_shape("multiple", self.multiple, lines)
        if len(self.why) != lines[0]:
            raise ValueError(f"why: expected {lines[0]} texts, one per line, found {len(self.why)}")
