"""How results are written: whole or not at all, by one run at a time, and nothing left of a run that was ended.

Everything that a command leaves goes through `write_file`. What is being made stands under a hidden name beside its
place (`.NAME-RANDOM.part`); who makes it holds the lock of that place (`.NAME.shakercal-lock`), which the system gives
free when the process ends, however it ends. Whoever gets a lock thus knows that what was being made is nobody's.
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

LOCK = "shakercal-lock"
INTERNAL_NAME = re.compile(rf"\.(?P<name>.+?)(-[0-9a-f]{{12}}\.(?P<kind>part|old|aside)|\.{LOCK})", re.DOTALL)
"""Names of what is being made (`part`), of what it replaces (`old`; single files: `aside`), and of locks."""
CHECKPOINT_SUFFIX = ".so-far"
LOCK_POLL_S = 0.2  # between looks for a lock to become free
ABANDONED_AGE_S = 86_400.0
"""Age after which something half-made is taken for abandoned where the file system has no locks."""
LONG_PATH = 240
"""Characters of a path from which on Windows, unless long paths are enabled there, says that there is no such file."""
_ATTEMPTS = 100
"""How often a folder that another run removes meanwhile is made anew."""
LOCK_BUSY_ERRNOS = {errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK}
"""What a system says of a lock that somebody else holds; anything else says that there are none."""

# One place that writes.


def write_file(path: Path, content: str | bytes | Iterable[str]) -> None:
    """Write a new file, text as UTF-8 with its line ends as they are; every byte of a result passes here.

    Text may come in parts, where all of it is too much for the memory.
    """
    with path.open("wb") as stream:
        for part in (content,) if isinstance(content, str | bytes) else content:
            stream.write(part if isinstance(part, bytes) else part.encode("utf-8", "replace"))


def write_files(folder: Path, contents: Mapping[str, str | bytes | Iterable[str]]) -> list[str]:
    """Write new files into a folder, those of names such as `below/name` below it, and return the names."""
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_file(folder / name, content)
    return list(contents)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all."""
    place = path.parent.resolve() / path.name
    with report_write_errors(path), file_lock(place):
        remove_abandoned(place.parent, place.name)
        with temporary_path(place) as part:
            write_file(part, content)
            os.replace(part, place)


@contextmanager
def report_write_errors(place: Path) -> Iterator[None]:
    """Tell what the system refuses meanwhile, such as a full disk, in one sentence about the place of the results."""
    try:
        yield
    except OSError as error:
        reason, refused = (error.strerror or str(error)).lower(), Path(str(error.filename2 or error.filename))
        file = "" if error.filename is None or is_internal_name(refused.name) else f" ({refused.name})"
        if isinstance(error, FileNotFoundError) and is_internal_name(refused.name) and refused.parent.is_dir():
            reason = f"{refused.parent} takes no files"  # as below /proc
        advice = ", or is it open in another program?" if isinstance(error, PermissionError) else ""
        if isinstance(error, FileNotFoundError) and len(str(error.filename)) > LONG_PATH:
            advice = f"; its path of {len(str(error.filename))} characters may be longer than the system takes"
        text = f"{place}: could not be written: {reason}{file}{advice}; what was there before is as it was"
        raise ComputeError(text) from error


# One run at a time: who writes a place holds its lock.


_held: dict[Path, int | None] = {}
_made: set[Path] = set()
"""Locks of this process, and what it is making."""


@contextmanager
def file_lock(place: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file or folder that is to be written, and make the folder it is to stand in.

    Where another process still holds it after `patience_s`, this is a `ComputeError`. The lock is gone afterwards, and
    so are folders that were made for nothing.
    """
    place = place.resolve()
    lock = _lock_of(place)
    if lock in _held:
        yield
        return
    new = [folder for folder in lock.parents if not folder.exists()]
    with cleanup_on_signal(partial(_free, lock, new)):
        end = time.monotonic() + patience_s
        while lock not in _held:
            try:
                with defer_signals(), report_write_errors(place):
                    _held[lock] = _locked(lock, place)
            except ComputeError:
                if time.monotonic() >= end:
                    raise
                time.sleep(LOCK_POLL_S)
        yield


def staging_dir(place: Path) -> Path:
    """Return the folder in which `place` is made: the one it stands in, or itself where that is another disk's."""
    within = place.is_dir() and (os.path.ismount(place) or not os.access(place.parent, os.W_OK | os.X_OK))
    return place if within else place.parent


def is_internal_name(name: str) -> bool:
    """Whether a name is that of what a run makes, of its lock, or of what it has found so far."""
    return INTERNAL_NAME.fullmatch(name) is not None or (name.startswith(".") and name.endswith(CHECKPOINT_SUFFIX))


def _lock_of(place: Path) -> Path:
    return staging_dir(place) / f".{place.name}.{LOCK}"


def _locked(lock: Path, place: Path) -> int | None:
    """Create and lock a file and return its handle, None where the file system has no locks."""
    for attempt in count(1):
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another run has just removed the folder that it made for nothing
            if attempt == _ATTEMPTS:
                raise
            continue
        try:
            _lock(handle)
        except OSError as error:
            os.close(handle)
            if error.errno not in LOCK_BUSY_ERRNOS:
                return None
            text = f"{place}: another run is writing there; start this one again when that has ended"
            raise ComputeError(text) from error
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        os.close(handle)  # who held it before has removed it in between
    return None


def _lock(handle: int) -> None:
    """Lock an open file until it is closed or the process ends; an `OSError` where somebody else has locked it."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _free(lock: Path, folders: Sequence[Path]) -> None:
    """Give a lock free where it is held, and remove folders that stayed empty."""
    if lock in _held:
        handle, windows = _held[lock], sys.platform == "win32"
        with contextlib.suppress(OSError):
            if not windows:  # as long as nobody else can hold it
                lock.unlink()
        with contextlib.suppress(OSError):
            if handle is not None:
                os.close(handle)
            if windows:  # which removes no open file
                lock.unlink()
        _held.pop(lock, None)
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


# What is being made, and what was left by runs that are gone.


def _hidden(place: Path, kind: str) -> Path:
    """Return a name beside a place that nobody else has."""
    return staging_dir(place) / f".{place.name}-{os.urandom(6).hex()}.{kind}"


@contextmanager
def temporary_path(place: Path) -> Iterator[Path]:
    """Yield a name that is free, under which a place is made; what stands there in the end is removed."""
    path = _hidden(place, "part")
    _made.add(path)
    with cleanup_on_signal(partial(_remove, path)):
        yield path


def _remove(path: Path) -> None:
    """Remove a file or a folder, if it is there; threads that still write into it find it no more."""
    if path.is_dir() and not path.is_symlink():
        gone = path.with_name(re.sub(r"[0-9a-f]{12}\.[a-z]+$", f"{os.urandom(6).hex()}.part", path.name))
        with contextlib.suppress(OSError):
            os.replace(path, gone)
        for place in (path, gone):
            shutil.rmtree(place, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
    _made.discard(path)


def remove_abandoned(folder: Path, name: str | None = None) -> list[Path]:
    """Remove from a folder what runs that are gone were making there, of one `name` or of all; return its paths.

    What they had put aside and not replaced goes back to its place. Where the file system has no locks, something that
    has not changed for a day counts as abandoned.
    """
    folder, removed = folder.resolve(), []
    # Of many thousands of results only what is hidden becomes a path.
    names = (
        sorted(found for found in os.listdir(folder) if found.startswith(f".{name or ''}")) if folder.is_dir() else []
    )
    for entry in (folder / hidden for hidden in names):
        found = INTERNAL_NAME.fullmatch(entry.name)
        if found is None or entry in _made or name not in (None, found["name"]):
            continue
        place = folder / found["name"]
        if folder.name == place.name and _lock_of(folder).parent == folder:
            place = folder  # it is made in itself
        own = _lock_of(place) in _held
        if own and found["kind"] is None:
            continue
        with contextlib.suppress(ComputeError, OSError), file_lock(place):
            locked = _held.get(_lock_of(place)) is not None
            if not locked and time.time() - entry.stat().st_mtime < ABANDONED_AGE_S:
                continue
            if found["kind"] in ("old", "aside"):
                _restore(entry, place)
            if found["kind"] is not None:
                _remove(entry)
            removed.append(entry)
    return removed


def _restore(aside: Path, place: Path) -> None:
    """Put back what was moved out of a place and never replaced."""
    if aside.suffix == ".old":
        if not place.exists():
            os.replace(aside, place)
        return
    for file in [path for path in aside.rglob("*") if path.is_file()]:
        _move(file, place / file.relative_to(aside))


# What a run has found so far.


class Checkpoint:
    """Files in a hidden folder beside that of the results, `.NAME.so-far`, or in it where it is another disk's.

    They are there until the results are written.

    `key`: makes that of everything that decides what they hold; files of another key are nobody's.
    """

    def __init__(self, place: Path, key: Callable[[], str]) -> None:
        place = place.resolve()
        self.disk = staging_dir(place)
        self._folder = self.disk / f".{place.name}{CHECKPOINT_SUFFIX}"
        self._make_key = key

    @cached_property
    def _key(self) -> str:
        return self._make_key()

    def get(self, name: str) -> bytes | None:
        """Return what was kept under a name, None where nothing was."""
        file = self._folder / f"{name}.{self._key}"
        with contextlib.suppress(OSError):
            return file.read_bytes()
        return None

    def put(self, name: str, content: bytes) -> bool:
        """Keep something, whole or not at all, and return whether that is done; where not, the run goes on without."""
        file = self._folder / f"{name}.{self._key}"
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file(file.with_name(f"{file.name}.part"), content)
            os.replace(file.with_name(f"{file.name}.part"), file)
            return True
        return False

    def remove(self) -> None:
        """Remove all that was kept, of other keys too."""
        shutil.rmtree(self._folder, ignore_errors=True)


# A folder whose files appear together.


def write_together(
    folder: Path,
    make: Callable[[Path], Sequence[str]],
    earlier: Callable[[], Sequence[str]],
    ready: Callable[[], None] = lambda: None,
) -> list[Path]:
    """Have `make` write files into a new folder and name them, last the one that says that all are there; move them.

    A failure leaves `folder` as it was. What an `earlier` run has written there makes way; all other files stay.
    `ready` is asked before anything is moved and raises what speaks against it. Names may be such as `below/name`.
    """
    folder = folder.resolve()
    with report_write_errors(folder), file_lock(folder):
        remove_abandoned(staging_dir(folder), folder.name)
        with temporary_path(folder) as part:
            part.mkdir()
            names = make(part)
            ready()
            with defer_signals():
                _put_in_place(part, folder, names, earlier())
    return [folder / name for name in names]


def _put_in_place(part: Path, folder: Path, names: Sequence[str], earlier: Sequence[str]) -> None:
    """Put finished files in place: the folder as a whole, else, where it holds files of others, file by file."""
    if not folder.exists():
        os.replace(part, folder)
        return
    gone = [name for name in dict.fromkeys((names[-1], *earlier, *names)) if (folder / name).is_file()]
    if part.parent == folder.parent and _holds_only(folder, gone) and _swapped(part, folder):
        return
    aside, placed = _hidden(folder, "aside"), list[str]()
    try:
        for name in gone:  # without the one that comes first here and last there the folder is no result
            _move(folder / name, aside / name)
        for name in names:
            _move(part / name, folder / name)
            placed.append(name)
    except OSError:
        for name in placed:
            _move(folder / name, part / name)
        _restore(aside, folder)
        shutil.rmtree(aside, ignore_errors=True)
        raise
    if aside.exists():
        old = aside.with_suffix(".old")  # which nobody puts back
        with contextlib.suppress(OSError):
            os.replace(aside, old)
        for place in (aside, old):
            shutil.rmtree(place, ignore_errors=True)
    for below in sorted({(folder / name).parent for name in gone} - {folder}, reverse=True):
        with contextlib.suppress(OSError):
            below.rmdir()  # where nothing is left in it


def _holds_only(folder: Path, names: Sequence[str]) -> bool:
    """Whether a folder holds nothing but files of some names."""
    tops = {Path(name).parts[0] for name in names}
    if any(entry.name not in tops for entry in folder.iterdir()):
        return False
    return sum(not path.is_dir() or path.is_symlink() for path in folder.rglob("*")) == len(names)


def _move(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    os.replace(file, place)


def _swapped(part: Path, folder: Path) -> bool:
    """Put one folder in the place of another; false where the system does not give the place free.

    Whoever is killed in between leaves the old one under a hidden name, from which the next run puts it back.
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
