"""Arrays that may be anything: what differs between systems is not in them, and most of a check's time is."""

from typing import Any

def __getattr__(name: str) -> Any: ...
