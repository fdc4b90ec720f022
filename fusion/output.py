"""Single files that a command writes: where they may go, and how they appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from fusion.errors import InputError


def check_new_file(path: Path, *, force: bool) -> None:
    """Refuse a place for a file that is taken (by a file: unless `force`) or that is in no folder."""
    if path.exists() and not (force and path.is_file()):
        what = "file" if path.is_file() else "folder"
        raise InputError(path, "", found=f"a {what} of this name", expected="a new file (--force replaces it)")
    if not path.absolute().parent.is_dir():
        raise InputError(path, "", found=f"no folder {path.parent}", expected="a file in an existing folder")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by a temporary name and one rename; text as UTF-8 with its line ends as they are."""
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
