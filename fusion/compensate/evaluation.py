"""Everything a compensation found, as it is written and shown."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.compensate.haptics import Haptics
from fusion.compensate.result import CompensatedRecording, SubjectResult
from fusion.compensate.wish import Wish
from fusion.notices import Notice


@dataclass(frozen=True)
class CompensateEvaluation:
    """All filters, the recording they were applied to, the force-feedback check, notices and origin."""

    name: str
    wish: Wish
    subjects: tuple[SubjectResult, ...]
    applied: CompensatedRecording | None
    haptics: Haptics | None
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float
