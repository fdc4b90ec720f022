"""Compiled kernels: numba with a cache that knows its sources, imported when a kernel is first called.

Numba keeps a compiled function as long as its own file is unchanged, though it holds code and constants of functions in
other files. Here the cache is the user's, one for all checkouts, and a change in any source of the package makes all
kernels new.

A kernel computes the same digits in every process. Numba compiles a function with the options of the one that calls it
where it states none itself; which of the copies runs hangs on what was compiled or loaded before. So all options are
stated, and fast-math, by which every copy may round in another way, is none of them: `photogram.kernels.lanes` writes
out the arithmetic that needs it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import shutil
import sys
from collections.abc import Callable
from functools import cache, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any

UNUSED_S = 30 * 86400.0
DIGEST_BYTES = 32
COMPILER_BYTES = 600_000_000
"""Of addresses: the kernels of a run that tracks subsets took 500 MB."""
LEAN_VERSIONS = ((0, 68),)
"""Of numba, in which a kept kernel was seen to need nothing but the memory of arrays; with others it loads as usual."""


def njit(*, error_model: str = "python", inline: str = "never") -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with these options and no others, cached for the user until a source of this package changes.

    A kernel computes in the thread that calls it, and lets other threads of Python go on meanwhile: several bodies, or
    blocks of frames, at once use all cores, and no digit depends on their number.
    """
    options = {"parallel": False, "nogil": True, "error_model": error_model, "inline": inline, "fastmath": False}
    return lambda function: Kernel(function, options)


class Kernel:
    """A function that numba compiles. Importing numba takes half a second, so the first call does it, or whatever else
    asks for what numba made of the function: a kernel that calls this one finds its type and options so."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func, self._options = function, options

    def __call__(self, *arguments: Any) -> Any:
        """Call what numba made of the function."""
        return self._made(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what Python asks of any object
            raise AttributeError(name)
        if name != "_made":
            return getattr(self._made, name)
        # Of two threads that call it first, the one that is later takes what the other made.
        return self.__dict__.setdefault(name, _dispatcher(self.py_func, self._options))

    def plain(self, *arguments: Any) -> Any:
        """Call the function as Python runs it, and all kernels that it calls: for a few numbers, without numba."""
        function = self.py_func
        called = {name: kernel.plain for name, kernel in function.__globals__.items() if isinstance(kernel, Kernel)}
        return FunctionType(function.__code__, {**function.__globals__, **called})(*arguments)


def _dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return what numba makes of a function, its cache being the user's."""
    import numba
    from numba.core.caching import CompileResultCacheImpl, FunctionCache
    from numba.core.runtime import rtsys

    class Entries(CompileResultCacheImpl):  # type: ignore[misc]
        """What of a compiled function is kept; numba's own class looks for a place, and raises where it finds none."""

        def __init__(self) -> None:
            pass

    class Cache(FunctionCache):  # type: ignore[misc]
        """A cache that is read without all that numba knows of types and functions, which only a compiler needs.

        To look that up takes as long as to import numba, which offers no public way without it.
        """

        def __init__(self, folder: Path | None) -> None:
            self._name, self._py_func, self._cache_path = repr(function), function, str(folder)
            self._impl, self._cache_file = Entries(), File(folder, f"{function.__module__}.{function.__qualname__}")
            self.enable()

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            if numba.version_info.short in LEAN_VERSIONS:
                rtsys.initialize(target_context)  # the memory of arrays
            else:
                target_context.refresh()
            found = self._load_overload(sig, target_context)
            if found is None:
                check_memory()
            return found

        def save_overload(self, sig: Any, data: Any) -> None:
            if not data.lifted and not data.library.has_dynamic_globals:  # which hold for this process alone
                self._cache_file.save(self._index_key(sig, data.codegen), self._impl.reduce(data))

    dispatcher, (folder, _) = numba.njit(**options)(function), _cache_folder()
    if not numba.config.DISABLE_JIT:
        dispatcher._cache = Cache(folder)
    return dispatcher


@cache
def check_memory() -> None:
    """Raise `MemoryError` where the system limits the address space to less than the compiler takes for all kernels.

    The compiler itself ends the process then, or never returns. Once it has begun, nothing is raised.
    """
    if sys.platform == "linux":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        if limit != resource.RLIM_INFINITY and limit - taken < COMPILER_BYTES:
            told = f"{limit / 1e6:.0f} MB of addresses (ulimit -v), of which {taken / 1e6:.0f} MB are taken"
            raise MemoryError(f"expected {COMPILER_BYTES / 1e6:.0f} MB to compile functions, found {told}")


class File:
    """Compiled functions in one file each, `NAME-….nbc`, behind a digest: one that is damaged counts as none.

    A full or read-only disk stays as it is, and without a `folder` nothing is kept: the next process compiles anew.
    """

    def __init__(self, folder: Path | None, name: str) -> None:
        self._folder, self._stem = folder, name.replace("<", "").replace(">", "")

    def load(self, key: Any) -> Any:
        """Return what is kept for a key, None where nothing is."""
        place = self._place(key)
        with contextlib.suppress(OSError):
            whole = place.read_bytes() if place is not None else b""
            if hashlib.sha256(whole[DIGEST_BYTES:]).digest() == whole[:DIGEST_BYTES]:
                return pickle.loads(whole[DIGEST_BYTES:])
        return None

    def save(self, key: Any, content: Any) -> None:
        """Keep something for a key, whole or not at all."""
        from numba.core.serialize import dumps

        place = self._place(key)
        if place is None:
            return
        written = dumps(content)
        part = place.with_name(f"{place.name}-{os.urandom(6).hex()}.part")
        with contextlib.suppress(OSError):
            try:
                part.write_bytes(hashlib.sha256(written).digest() + written)
                os.replace(part, place)
            finally:
                part.unlink(missing_ok=True)

    def _place(self, key: Any) -> Path | None:
        """Path of a file for a function's types, the processor, its code, and the versions of Python and numba."""
        import numba

        digest = hashlib.sha256(repr((sys.version, numba.__version__, key)).encode()).hexdigest()
        return None if self._folder is None else self._folder / f"{self._stem}-{digest[:32]}.nbc"


@cache
def _sources_digest() -> str:
    """Hash of the sources of the package, whatever folder they stand in and whenever they were written."""
    folder, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def user_cache(name: str) -> Path:
    """Folder of the user's caches of this program for one kind of content; `RuntimeError` for a user without a home."""
    home = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    return Path(home or Path.home() / ".cache") / "shakercal" / name


@cache
def _cache_folder() -> tuple[Path | None, str]:
    """The user's folder of kernels compiled from these sources, shared by all checkouts; None and why it cannot be.

    Kernels of other versions that nobody has used for a month are removed.
    """
    try:
        kernels = Path(os.environ.get("NUMBA_CACHE_DIR") or user_cache("kernels"))
        folder = kernels / _sources_digest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        if not os.access(folder, os.W_OK | os.X_OK):
            return None, f"{folder}: no permission to write"
        for other in kernels.iterdir():
            with contextlib.suppress(OSError):
                if other.stat().st_mtime < folder.stat().st_mtime - UNUSED_S:
                    shutil.rmtree(other, ignore_errors=True)
    except (OSError, RuntimeError) as error:  # the latter of a user without a home
        return None, str(error) if isinstance(error, RuntimeError) else f"{error.filename}: {error.strerror}"
    return folder, ""


def cache_failure_reason(*, other_processes: bool = False) -> str:
    """Return why compiled kernels are not kept for the next process of the user; empty where they are.

    Also empty where this process has compiled none, unless processes `elsewhere` did for it.
    """
    return _cache_folder()[1] if other_processes or _cache_folder.cache_info().currsize else ""
