"""Cache of compiled page templates and packed scripts in the user's cache folder.

If that folder is not available, everything is made again. A file appears completely or not at all; a damaged file is
ignored.
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
from shakercal._common.kernels import user_cache

UNUSED_S = 30 * 86400.0
"""Age after which an entry is made again, so that entries of older versions disappear; chosen: 30 days."""


def load_or_make(name: str, key: str, make: Callable[[], bytes]) -> bytes:
    """Return the cached content of a name and key, or make and cache it.

    `key` identifies everything that the content depends on.
    """
    content = _read_entry(name, key)
    if content is None:
        content = make()
        _write_entry(name, key, content)
    return content


class CompiledTemplates(jinja2.BytecodeCache):
    """Cache of templates as compiled Python code."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load the code of a template if it is cached."""
        code = _read_entry(bucket.key, self._key(bucket))
        if code is not None:
            bucket.bytecode_from_string(code)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Cache the code of a template."""
        _write_entry(bucket.key, self._key(bucket), bucket.bytecode_to_string())

    @staticmethod
    def _key(bucket: Bucket) -> str:
        """Return everything that the code depends on: versions, source text and parser settings."""
        environment = bucket.environment
        how = environment.autoescape, environment.trim_blocks, environment.lstrip_blocks, environment.undefined.__name__
        return f"{jinja2.__version__} {sys.version} {bucket.checksum} {how}"


def _entry_path(name: str, key: str) -> Path:
    return user_cache("pages") / hashlib.sha256(f"{name} {key}".encode()).hexdigest()[:32]


def _read_entry(name: str, key: str) -> bytes | None:
    """Return a cached content, None if it is missing, damaged or too old."""
    with suppress(OSError, RuntimeError):  # the latter of a user without a home
        path = _entry_path(name, key)
        if time.time() - path.stat().st_mtime < UNUSED_S:
            digest, content = (whole := path.read_bytes())[:32], whole[32:]
            return content if hashlib.sha256(content).digest() == digest else None
    return None


def _write_entry(name: str, key: str, content: bytes) -> None:
    """Write a cache entry if possible, and remove old entries."""
    with suppress(OSError, RuntimeError):
        path = _entry_path(name, key)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}-{secrets.token_hex(6)}.part")
        try:
            write_file(part, hashlib.sha256(content).digest() + content)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        for other in path.parent.iterdir():
            if time.time() - other.stat().st_mtime > UNUSED_S:
                other.unlink(missing_ok=True)
