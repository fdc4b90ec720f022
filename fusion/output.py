"""What a command writes: where it may go, and how it appears whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
import socket
import sys
import time
from pathlib import Path

from fusion.errors import InputError

TEMPORARY = re.compile(r"\..+-(?P<process>\d+)@(?P<host>[^/]+)")
FORGOTTEN_S = 86_400.0
"""Age after which what a process of another machine left unfinished is taken for abandoned."""


def check_new_file(path: Path, *, force: bool) -> None:
    """Refuse a place for a file that is taken (by a file: unless `force`) or that is in no folder."""
    if path.exists() and not (force and path.is_file()):
        what = "file" if path.is_file() else "folder"
        raise InputError(path, "", found=f"a {what} of this name", expected="a new file (--force replaces it)")
    if not path.absolute().parent.is_dir():
        raise InputError(path, "", found=f"no folder {path.parent}", expected="a file in an existing folder")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by a temporary name and one rename; text as UTF-8 with its line ends as they are."""
    temporary = temporary_beside(path)
    try:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def temporary_beside(path: Path) -> Path:
    """Return the hidden name beside `path` under which this process prepares it: it tells process and machine."""
    return path.with_name(f".{path.name}-{os.getpid()}@{socket.gethostname()}")


def remove_abandoned(folder: Path) -> list[Path]:
    """Remove from a folder what processes that are gone were preparing there, and return its paths.

    A process of another machine cannot be asked: what it left counts as abandoned after a day without any change.
    """
    if not folder.is_dir():
        return []
    removed = [entry for entry in folder.iterdir() if _abandoned(entry)]
    for entry in removed:
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)
    return removed


def _abandoned(entry: Path) -> bool:
    """Whether an entry of a folder is a temporary one of a process that is gone."""
    named = TEMPORARY.fullmatch(entry.name)
    if named is None:
        return False
    if named["host"] == socket.gethostname() and sys.platform != "win32":
        return not _is_running(int(named["process"]))
    try:
        return time.time() - entry.stat().st_mtime > FORGOTTEN_S
    except FileNotFoundError:  # finished in between
        return False


def _is_running(process: int) -> bool:
    """Whether a process of this machine exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # of another user
        return True
    return True
