"""The remarks of all three packages, seen as one kind."""

from __future__ import annotations

from photogram.notice import Notice as ImageNotice
from shaker.notice import Notice

AnyNotice = Notice | ImageNotice

__all__ = ["AnyNotice", "Notice"]
