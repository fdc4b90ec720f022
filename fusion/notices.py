"""The remarks of all three packages, seen as one kind."""

from __future__ import annotations

from collections.abc import Iterable

from photogram.notice import Notice as ImageNotice
from shaker.notice import Notice

AnyNotice = Notice | ImageNotice

__all__ = ["AnyNotice", "Notice", "warnings_first"]


def warnings_first(notices: Iterable[AnyNotice]) -> list[AnyNotice]:
    """Return all distinct notices, warnings first."""
    distinct = {(notice.severity, notice.where, notice.text): notice for notice in notices}
    return sorted(distinct.values(), key=lambda notice: notice.severity != "warning")
