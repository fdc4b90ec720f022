"""Binary format of answers to the page: a head in JSON, and numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def table(head: Mapping[str, Any], *arrays: NDArray[Any]) -> bytes:
    """Return numbers in the page's binary format.

    The length of a head, JSON, and arrays of doubles, aligned to 8 bytes.
    """
    body = b"".join(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays)
    return with_head({**head, "lengths": [array.size for array in arrays]}, body)


def with_head(head: Mapping[str, Any], body: bytes) -> bytes:
    """Return a body after the length of a head, and the head."""
    text = json.dumps(head, allow_nan=False).encode()
    text += b" " * (-(len(text) + 8) % 8)
    return len(text).to_bytes(8, "little") + text + body
