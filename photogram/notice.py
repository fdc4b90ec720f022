"""What a stage wants the user to know, carried in its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["info", "warning"]


@dataclass(frozen=True)
class Notice:
    """One remark to the user: how severe, what it says, and what it is about (a channel, a camera, a line)."""

    severity: Severity
    text: str
    where: str
