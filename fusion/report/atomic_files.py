"""Atomic writing of result files under a lock, and removal of unfinished files.

Everything that a command writes passes `write_file`. An unfinished file or folder has a hidden name next to its final
path (`.NAME-RANDOM.part`). The writing process has the lock of that path (`.NAME.shakercal-lock`). The operating system
releases the lock when the process ends. A process that gets the lock can therefore remove unfinished files.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from itertools import count
from pathlib import Path

from fusion.base import cleanup_on_signal, defer_signals
from fusion.errors import ComputeError
from fusion.report.report_notices import LOCKED, NOT_WRITTEN, PATH_TOO_LONG

LOCK = "shakercal-lock"
INTERNAL_NAME = re.compile(rf"\.(?P<name>.+?)(-[0-9a-f]{{12}}\.(?P<kind>part|old|aside)|\.{LOCK})", re.DOTALL)
"""Names of unfinished files (`part`), of files they replace (`old`; single files: `aside`), and of locks."""
CHECKPOINT_SUFFIX = ".so-far"
LOCK_POLL_S = 0.2  # between looks for a lock to become free
ABANDONED_AGE_S = 86_400.0
"""Age after which an unfinished file counts as abandoned on a file system without locks; chosen: one day."""
LONG_PATH = 240
"""Length of a path from which Windows reports a missing file, unless long paths are enabled (MAX_PATH is 260)."""
_ATTEMPTS = 100
"""How often a folder is created again that another run removes at the same time."""
LOCK_BUSY_ERRNOS = {errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK}
"""Error numbers of a lock that another process has; any other error means that the file system has no locks."""

# Writing.


def write_file(path: Path, content: str | bytes | Iterable[str]) -> None:
    """Write a new file; text as UTF-8 with unchanged line ends.

    Every byte of a result passes this function. Text may be given in parts, so that it need not fit into memory.
    """
    with path.open("wb") as stream:
        for part in (content,) if isinstance(content, str | bytes) else content:
            stream.write(part if isinstance(part, bytes) else part.encode("utf-8", "replace"))


def write_files(folder: Path, contents: Mapping[str, str | bytes | Iterable[str]]) -> list[str]:
    """Write new files into a folder and return their names.

    A name such as `below/name` creates the subfolder.
    """
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_file(folder / name, content)
    return list(contents)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file that appears completely or not at all."""
    target = path.parent.resolve() / path.name
    with report_write_errors(path), file_lock(target):
        remove_abandoned(target.parent, target.name)
        with temporary_path(target) as part:
            write_file(part, content)
            os.replace(part, target)


@contextmanager
def report_write_errors(target: Path) -> Iterator[None]:
    """Convert an `OSError` into a `ComputeError` that names the place of the results."""
    try:
        yield
    except OSError as error:
        reason, refused = (error.strerror or str(error)).lower(), Path(str(error.filename2 or error.filename))
        file = "" if error.filename is None or is_internal_name(refused.name) else f" ({refused.name})"
        if isinstance(error, FileNotFoundError) and is_internal_name(refused.name) and refused.parent.is_dir():
            reason = f"{refused.parent} accepts no files"  # such as /proc
        characters = len(str(error.filename))
        if isinstance(error, FileNotFoundError) and characters > LONG_PATH:
            raise ComputeError(PATH_TOO_LONG, str(target), reason=f"{reason}{file}", characters=characters) from error
        raise ComputeError(NOT_WRITTEN, str(target), reason=f"{reason}{file}") from error


# One run at a time: the writer of a path has its lock.


_locks: dict[Path, int | None] = {}
_made: set[Path] = set()
"""Locks and unfinished paths of this process."""


@contextmanager
def file_lock(target: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Lock a file or folder that is to be written, and create its parent folder.

    If another process still has the lock after `patience_s`, a `ComputeError` is raised. At the end the lock and new
    empty folders are removed.
    """
    target = target.resolve()
    lock = _lock_of(target)
    if lock in _locks:
        yield
        return
    new = [folder for folder in lock.parents if not folder.exists()]
    with cleanup_on_signal(partial(_free, lock, new)):
        end = time.monotonic() + patience_s
        while lock not in _locks:
            try:
                with defer_signals(), report_write_errors(target):
                    _locks[lock] = _locked(lock, target)
            except ComputeError:
                if time.monotonic() >= end:
                    raise
                time.sleep(LOCK_POLL_S)
        yield


def staging_dir(target: Path) -> Path:
    """Return the folder in which `target` is prepared.

    It is the parent folder, or `target` itself if that is a mount point or its parent is not writable.
    """
    within = target.is_dir() and (os.path.ismount(target) or not os.access(target.parent, os.W_OK | os.X_OK))
    return target if within else target.parent


def is_internal_name(name: str) -> bool:
    """Return whether a name is that of an unfinished file, a lock or a checkpoint."""
    return INTERNAL_NAME.fullmatch(name) is not None or (name.startswith(".") and name.endswith(CHECKPOINT_SUFFIX))


def _lock_of(target: Path) -> Path:
    return staging_dir(target) / f".{target.name}.{LOCK}"


def _locked(lock: Path, target: Path) -> int | None:
    """Create and lock a file and return its handle.

    Returns None if the file system has no locks.
    """
    for attempt in count(1):
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another run has just removed its empty folder
            if attempt == _ATTEMPTS:
                raise
            continue
        try:
            _lock(handle)
        except OSError as error:
            os.close(handle)
            if error.errno not in LOCK_BUSY_ERRNOS:
                return None
            raise ComputeError(LOCKED, str(target)) from error
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        os.close(handle)  # its previous owner has removed it in between
    return None


def _lock(handle: int) -> None:
    """Lock an open file until it is closed or the process ends.

    Raises `OSError` if another process has locked it.
    """
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _free(lock: Path, folders: Sequence[Path]) -> None:
    """Release a lock of this process and remove empty folders."""
    if lock in _locks:
        handle, windows = _locks[lock], sys.platform == "win32"
        with contextlib.suppress(OSError):
            if not windows:  # while this process still has the lock
                lock.unlink()
        with contextlib.suppress(OSError):
            if handle is not None:
                os.close(handle)
            if windows:  # which removes no open file
                lock.unlink()
        _locks.pop(lock, None)
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


# Unfinished files, also those of ended runs.


def _hidden(target: Path, kind: str) -> Path:
    """Return a unique hidden name next to a path."""
    return staging_dir(target) / f".{target.name}-{os.urandom(6).hex()}.{kind}"


@contextmanager
def temporary_path(target: Path) -> Iterator[Path]:
    """Yield an unused path for an unfinished file or folder; remove it at the end."""
    path = _hidden(target, "part")
    _made.add(path)
    with cleanup_on_signal(partial(_remove, path)):
        yield path


def _remove(path: Path) -> None:
    """Remove a file or folder if it exists.

    A folder is renamed first, so that threads of this process cannot write into it any more.
    """
    if path.is_dir() and not path.is_symlink():
        gone = path.with_name(re.sub(r"[0-9a-f]{12}\.[a-z]+$", f"{os.urandom(6).hex()}.part", path.name))
        with contextlib.suppress(OSError):
            os.replace(path, gone)
        for target in (path, gone):
            shutil.rmtree(target, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
    _made.discard(path)


def remove_abandoned(folder: Path, name: str | None = None) -> list[Path]:
    """Remove unfinished files of ended runs from a folder and return their paths.

    `name` restricts this to one result; None means all. Files that such a run had moved away and not replaced are moved
    back. On a file system without locks, a file counts as abandoned after one day without a change.
    """
    folder, removed = folder.resolve(), []
    # Of many thousands of names only hidden ones become paths.
    names = (
        sorted(found for found in os.listdir(folder) if found.startswith(f".{name or ''}")) if folder.is_dir() else []
    )
    for entry in (folder / hidden for hidden in names):
        found = INTERNAL_NAME.fullmatch(entry.name)
        if found is None or entry in _made or name not in (None, found["name"]):
            continue
        target = folder / found["name"]
        if folder.name == target.name and _lock_of(folder).parent == folder:
            target = folder  # it is prepared inside itself
        owned = _lock_of(target) in _locks
        if owned and found["kind"] is None:
            continue
        with contextlib.suppress(ComputeError, OSError), file_lock(target):
            locked = _locks.get(_lock_of(target)) is not None
            if not locked and time.time() - entry.stat().st_mtime < ABANDONED_AGE_S:
                continue
            if found["kind"] in ("old", "aside"):
                _restore(entry, target)
            if found["kind"] is not None:
                _remove(entry)
            removed.append(entry)
    return removed


def _restore(backup: Path, target: Path) -> None:
    """Move back the files that a run had moved away and not replaced."""
    if backup.suffix == ".old":
        if not target.exists():
            os.replace(backup, target)
        return
    for file in [path for path in backup.rglob("*") if path.is_file()]:
        _move(file, target / file.relative_to(backup))


# Intermediate results of a run.


class Checkpoint:
    """Checkpoints of a run in a hidden folder `.NAME.so-far` next to its results.

    The folder is inside that of the results if the latter is a mount point. It exists until the results are written.

    `key` returns a text that identifies all inputs of the files; files of another key are ignored.
    """

    def __init__(self, target: Path, key: Callable[[], str]) -> None:
        target = target.resolve()
        self.disk = staging_dir(target)
        self._folder = self.disk / f".{target.name}{CHECKPOINT_SUFFIX}"
        self._make_key = key

    @cached_property
    def _key(self) -> str:
        return self._make_key()

    def get(self, name: str) -> bytes | None:
        """Return the content of a file, None if there is none."""
        file = self._folder / f"{name}.{self._key}"
        with contextlib.suppress(OSError):
            return file.read_bytes()
        return None

    def put(self, name: str, content: bytes) -> bool:
        """Write a file completely or not at all, and return whether it was written."""
        file = self._folder / f"{name}.{self._key}"
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file(file.with_name(f"{file.name}.part"), content)
            os.replace(file.with_name(f"{file.name}.part"), file)
            return True
        return False

    def remove(self) -> None:
        """Remove all files, also those of other keys."""
        shutil.rmtree(self._folder, ignore_errors=True)


# A folder whose files appear together.


def write_together(
    folder: Path,
    make: Callable[[Path], Sequence[str]],
    earlier: Callable[[], Sequence[str]],
    ready: Callable[[], None] = lambda: None,
) -> list[Path]:
    """Write files into a new folder and move them to their places together.

    `make` writes the files and returns their names; the last one marks complete results. A failure leaves `folder`
    unchanged. The files `earlier` of a previous run are replaced; all other files stay. `ready` is called before files
    are moved and may raise an exception. Names may contain a subfolder: `below/name`.
    """
    folder = folder.resolve()
    with report_write_errors(folder), file_lock(folder):
        remove_abandoned(staging_dir(folder), folder.name)
        with temporary_path(folder) as part:
            part.mkdir()
            names = make(part)
            ready()
            with defer_signals():
                _move_to_target(part, folder, names, earlier())
    return [folder / name for name in names]


def _move_to_target(part: Path, folder: Path, names: Sequence[str], earlier: Sequence[str]) -> None:
    """Move finished files into place.

    The folder is replaced as a whole, or file by file if it contains other files.
    """
    if not folder.exists():
        os.replace(part, folder)
        return
    gone = [name for name in dict.fromkeys((names[-1], *earlier, *names)) if (folder / name).is_file()]
    if part.parent == folder.parent and _contains_only(folder, gone) and _swap_folders(part, folder):
        return
    backup, moved = _hidden(folder, "aside"), list[str]()
    try:
        for name in gone:  # first the file that marks complete results, which is written last
            _move(folder / name, backup / name)
        for name in names:
            _move(part / name, folder / name)
            moved.append(name)
    except OSError:
        for name in moved:
            _move(folder / name, part / name)
        _restore(backup, folder)
        shutil.rmtree(backup, ignore_errors=True)
        raise
    if backup.exists():
        old = backup.with_suffix(".old")  # which no run moves back
        with contextlib.suppress(OSError):
            os.replace(backup, old)
        for target in (backup, old):
            shutil.rmtree(target, ignore_errors=True)
    for below in sorted({(folder / name).parent for name in gone} - {folder}, reverse=True):
        with contextlib.suppress(OSError):
            below.rmdir()  # if it is empty


def _contains_only(folder: Path, names: Sequence[str]) -> bool:
    """Return whether a folder contains only files of these names."""
    tops = {Path(name).parts[0] for name in names}
    if any(entry.name not in tops for entry in folder.iterdir()):
        return False
    return sum(not path.is_dir() or path.is_symlink() for path in folder.rglob("*")) == len(names)


def _move(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(file, target)


def _swap_folders(part: Path, folder: Path) -> bool:
    """Replace one folder by another; return False if the system refuses.

    A process that is killed in between leaves the old folder under a hidden name; the next run moves it back.
    """
    old = _hidden(folder, "old")
    try:
        os.replace(folder, old)
    except OSError:
        return False
    try:
        os.replace(part, folder)
    except OSError:
        os.replace(old, folder)
        raise
    shutil.rmtree(old, ignore_errors=True)
    return True
