"""Trigger edges in a sampled signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shaker._checks import FloatArray, check_shape

EdgeKind = Literal["sampled", "band_limited"]


@dataclass(frozen=True)
class Edges:
    """Edges of a trigger signal, in seconds from the record's first sample.

    Each true crossing lies in (`lower_s`, `upper_s`] (E,); `estimate_s` (E,) is its best single estimate, free of the
    half-sample bias. `kind`: "sampled" where no sample lies on the rise (the interval is one sample wide),
    "band_limited" where the rise is resolved (the interval is the interpolation's uncertainty). `record_s` is the
    record's length, `threshold` the level used.
    """

    lower_s: FloatArray
    upper_s: FloatArray
    estimate_s: FloatArray
    kind: EdgeKind
    record_s: float
    threshold: float

    def __post_init__(self) -> None:
        check_shape("lower_s", self.lower_s, (None,))
        check_shape("upper_s", self.upper_s, self.lower_s.shape)
        check_shape("estimate_s", self.estimate_s, self.lower_s.shape)
