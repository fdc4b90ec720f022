"""Functions compiled by numba at their first call, cached until their package changes.

Numba caches a compiled function as long as its file is unchanged, although it contains code and constants of functions
in other files. Here the cache belongs to the user, one for all checkouts, and a change in any source of a package
invalidates its compiled functions.

A kernel computes the same digits in every process. Numba compiles a function with the options of its caller where it
states none itself, and which of the copies runs depends on the order of compiling and loading. Therefore all options
are stated, without fast-math, by which every copy may round differently.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

UNUSED_S = 30 * 86400.0  # a month, after which compiled functions of other versions are removed
COMPILER_BYTES = 600_000_000
"""Of addresses: the kernels of a run that tracks subsets took 500 MB."""


def njit(*, error_model: str = "python", inline: str = "never") -> Callable[[Callable[..., Any]], Any]:
    """Compile with `numba.njit` and these options, cached until a source of the package changes.

    A kernel runs in the thread that calls it and releases Python's lock. Several bodies, or blocks of frames, therefore
    use all cores at once, and no digit depends on their number.
    """
    options = {"parallel": False, "nogil": True, "error_model": error_model, "inline": inline, "fastmath": False}
    return lambda function: Kernel(function, options)


class Kernel:
    """A function that numba compiles at its first use.

    Importing numba takes half a second. A kernel that calls this one finds its type and options as attributes.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func, self._options = function, options

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function."""
        return self._made(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # Python's protocols
            raise AttributeError(name)
        if name != "_made":
            return getattr(self._made, name)
        # Of two threads that call it first, the later one uses the result of the other.
        return self.__dict__.setdefault(name, _dispatcher(self.py_func, self._options))

    def plain(self, *arguments: Any) -> Any:
        """Call the function and its kernels uncompiled: for a few numbers, without numba."""
        function = self.py_func
        called = {name: kernel.plain for name, kernel in function.__globals__.items() if isinstance(kernel, Kernel)}
        return FunctionType(function.__code__, {**function.__globals__, **called})(*arguments)


def _dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return numba's dispatcher of a function; without a folder, the next process compiles anew."""
    import numba
    from numba.core import caching

    dispatcher, (folder, _) = numba.njit(**options)(function), _cache_folder(function.__module__.partition(".")[0])
    if folder is None or numba.config.DISABLE_JIT:
        return dispatcher
    path, digest = str(folder), folder.name

    class SourcesLocator(caching._CacheLocator):  # type: ignore[misc]
        """The folder of a package's sources, whose hash is its name."""

        _py_file = function.__code__.co_filename  # named by numba's warnings

        def get_cache_path(self) -> str:
            return path

        def get_source_stamp(self) -> str:
            return digest

        def get_disambiguator(self) -> str:
            return function.__module__

        @classmethod
        def from_function(cls, *_: Any) -> Any:
            return cls()

    class Entries(caching.CompileResultCacheImpl):  # type: ignore[misc]
        _locator_classes = (SourcesLocator,)

    class TolerantCache(caching.FunctionCache):  # type: ignore[misc]
        """A cache that ignores damaged entries and failed writes."""

        _impl_class = Entries

        def load_overload(self, *key: Any) -> Any:
            found = None
            try:
                found = super().load_overload(*key)
            except Exception:  # a damaged pickle may raise anything
                with suppress(OSError):
                    self.flush()
            if found is None:
                check_memory()
            return found

        def save_overload(self, *entry: Any) -> None:
            with suppress(OSError):
                super().save_overload(*entry)

    dispatcher._cache = TolerantCache(function)
    return dispatcher


@cache
def check_memory() -> None:
    """Raise `MemoryError` where the address space is too small for compiling all kernels.

    The compiler would terminate the process, or never return. After the first compilation nothing is raised.
    """
    if sys.platform == "linux":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        if limit != resource.RLIM_INFINITY and limit - taken < COMPILER_BYTES:
            available = f"{limit / 1e6:.0f} MB of addresses (ulimit -v), of which {taken / 1e6:.0f} MB are used"
            raise MemoryError(f"expected {COMPILER_BYTES / 1e6:.0f} MB to compile functions, found {available}")


def user_cache(name: str) -> Path:
    """Return the user's cache folder of this program for one kind of content.

    Raises `RuntimeError` for a user without a home.
    """
    home = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    return Path(home or Path.home() / ".cache") / "shakercal" / name


@cache
def _sources_digest(package: str) -> str:
    """Return a hash of a package's sources, independent of their folder and time."""
    folder, digest = Path(import_module(package).__file__ or "").parent, hashlib.sha256(Path(__file__).read_bytes())
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


@cache
def _cache_folder(package: str) -> tuple[Path | None, str]:
    """Return the user's folder of functions compiled from a package's sources, None with the reason.

    Those of other versions that were unused for a month are removed.
    """
    try:
        kernels = Path(os.environ.get("NUMBA_CACHE_DIR") or user_cache("kernels"))
        folder = kernels / _sources_digest(package)[:16]
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        if not os.access(folder, os.W_OK | os.X_OK):
            return None, f"{folder}: no permission to write"
        for other in kernels.iterdir():
            with suppress(OSError):
                if other.stat().st_mtime < folder.stat().st_mtime - UNUSED_S:
                    shutil.rmtree(other, ignore_errors=True)
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        return None, str(error) if isinstance(error, RuntimeError) else f"{error.filename}: {error.strerror}"
    return folder, ""


def cache_failure_reason(*, other_processes: bool = False) -> str:
    """Return why compiled kernels are not cached for the next process, empty if they are.

    Also empty where this process has compiled none, unless `other_processes` compiled for it.
    """
    return _cache_folder("photogram")[1] if other_processes or _cache_folder.cache_info().currsize else ""
