"""What every run would make alike, kept for the next ones in the user's folder of caches: templates, packed programs.

Where that folder cannot be, everything is made anew. Processes do not disturb each other: a file appears whole, and one
that is not what was written counts as none.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import jinja2
from jinja2.bccache import Bucket

from fusion.report.atomic_files import write_file
from photogram.kernels import user_cache

UNUSED_S = 30 * 86400.0
"""Age after which what is kept is made anew, so that nothing of older versions stays."""


def load_or_make(name: str, key: str, make: Callable[[], bytes]) -> bytes:
    """Return what is kept under a name for a key, which says of what it was made; made and kept where it is not."""
    content = _find(name, key)
    if content is None:
        content = make()
        _keep(name, key, content)
    return content


class CompiledTemplates(jinja2.BytecodeCache):
    """Templates as they are when Python has compiled them; jinja2 itself sees to its source and to Python's version."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Take a template's code, if it is kept."""
        code = _find(bucket.key, self._key(bucket))
        if code is not None:
            bucket.bytecode_from_string(code)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a template's code."""
        _keep(bucket.key, self._key(bucket), bucket.bytecode_to_string())

    @staticmethod
    def _key(bucket: Bucket) -> str:
        """All that the code depends on: versions, the template's text, and how it is to be read."""
        own = bucket.environment
        how = own.autoescape, own.trim_blocks, own.lstrip_blocks, own.undefined.__name__
        return f"{jinja2.__version__} {sys.version} {bucket.checksum} {how}"


def _place(name: str, key: str) -> Path:
    return user_cache("pages") / hashlib.sha256(f"{name} {key}".encode()).hexdigest()[:32]


def _find(name: str, key: str) -> bytes | None:
    """Return what is kept, None where nothing is, or not what was written, or for longer than it may be."""
    with suppress(OSError, RuntimeError):  # the latter of a user without a home
        place = _place(name, key)
        if time.time() - place.stat().st_mtime < UNUSED_S:
            digest, content = (whole := place.read_bytes())[:32], whole[32:]
            return content if hashlib.sha256(content).digest() == digest else None
    return None


def _keep(name: str, key: str, content: bytes) -> None:
    """Keep something where that can be, and remove what is too old."""
    with suppress(OSError, RuntimeError):
        place = _place(name, key)
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_name(f"{place.name}-{secrets.token_hex(6)}.part")
        try:
            write_file(part, hashlib.sha256(content).digest() + content)
            os.replace(part, place)
        finally:
            part.unlink(missing_ok=True)
        for other in place.parent.iterdir():
            if time.time() - other.stat().st_mtime > UNUSED_S:
                other.unlink(missing_ok=True)
