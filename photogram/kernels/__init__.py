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
import shutil
import sys
from collections.abc import Callable
from functools import cache, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any

UNUSED_S = 30 * 86400.0
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
    from numba.core.caching import FunctionCache, IndexDataCacheFile
    from numba.core.runtime import rtsys

    class File(IndexDataCacheFile):  # type: ignore[misc]
        """A cache that a full or read-only disk leaves as it is: the kernel is compiled again next time."""

        def save(self, key: Any, data: Any) -> None:
            with contextlib.suppress(OSError):
                super().save(key, data)

    class Cache(FunctionCache):  # type: ignore[misc]
        """A cache that is read without all that numba knows of types and functions, which only a compiler needs.

        To look that up takes as long as to import numba, which offers no public way without it.
        """

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            if numba.version_info.short not in LEAN_VERSIONS:
                return super().load_overload(sig, target_context)
            rtsys.initialize(target_context)  # the memory of arrays
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)

    dispatcher = numba.njit(**options)(function)
    if numba.config.DISABLE_JIT:
        return dispatcher
    cache, folder = Cache(function), _cache_folder()  # numba offers no public way to say where, until when and how
    if folder is not None:
        cache._cache_path = str(folder)
        cache._cache_file = File(str(folder), cache._impl.filename_base, _sources_digest())
    dispatcher._cache = cache
    return dispatcher


@cache
def _sources_digest() -> str:
    """Hash of the sources of the package, whatever folder they stand in and whenever they were written."""
    folder, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def user_cache(room: str) -> Path:
    """Folder of the user's caches of this program for one kind of content; `RuntimeError` for a user without a home."""
    home = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    return Path(home or Path.home() / ".cache") / "shakercal" / room


@cache
def _cache_folder() -> Path | None:
    """The user's folder of kernels compiled from these sources, shared by all checkouts; None where it cannot be.

    Kernels of other versions that nobody has used for a month are removed.
    """
    kernels = Path(os.environ.get("NUMBA_CACHE_DIR") or user_cache("kernels"))
    folder = kernels / _sources_digest()[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    for other in kernels.iterdir():
        with contextlib.suppress(OSError):
            if other.stat().st_mtime < folder.stat().st_mtime - UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)
    return folder
