"""Compiled kernels: numba with a cache by source code, imported at the first call.

Numba caches a compiled function as long as its file is unchanged, although it contains code and constants of functions
in other files. Here the cache belongs to the user, one for all checkouts, and a change in any source of the package
invalidates all kernels.

A kernel computes the same digits in every process. Numba compiles a function with the options of its caller where it
states none itself, and which of the copies runs depends on the order of compiling and loading. Therefore all options
are stated, without fast-math, by which every copy may round differently: `photogram.kernels.lanes` writes out the
arithmetic that needs it.
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

UNUSED_S = 30 * 86400.0  # a month, after which kernels of other versions are removed
DIGEST_BYTES = 32  # of SHA-256
COMPILER_BYTES = 600_000_000
"""Of addresses: the kernels of a run that tracks subsets took 500 MB."""
LEAN_VERSIONS = ((0, 68),)
"""Of numba, in which a cached kernel was tested to need only the memory of arrays; others load it as usual."""


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
    """Return numba's dispatcher of a function with the user's cache."""
    import numba
    from numba.core.caching import CompileResultCacheImpl, FunctionCache
    from numba.core.runtime import rtsys

    class Entries(CompileResultCacheImpl):  # type: ignore[misc]
        """Serialisation of a compiled function, without numba's search for a folder, which may raise."""

        def __init__(self) -> None:
            pass

    class UserKernelCache(FunctionCache):  # type: ignore[misc]
        """A cache that is read without numba's registries of types, which only a compiler needs.

        To load these takes as long as to import numba, which offers no public alternative.
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
            if not data.lifted and not data.library.has_dynamic_globals:  # which are valid in this process only
                self._cache_file.save(self._index_key(sig, data.codegen), self._impl.reduce(data))

    dispatcher, (folder, _) = numba.njit(**options)(function), _cache_folder()
    if not numba.config.DISABLE_JIT:
        dispatcher._cache = UserKernelCache(folder)
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


class File:
    """Compiled functions in one file each, `NAME-….nbc`, behind a digest; damaged ones are ignored.

    A full or read-only disk is tolerated. Without a `folder` nothing is cached, and the next process compiles anew.
    """

    def __init__(self, folder: Path | None, name: str) -> None:
        self._folder, self._stem = folder, name.replace("<", "").replace(">", "")

    def load(self, key: Any) -> Any:
        """Return the cached content of a key, None for none."""
        path = self._path(key)
        with contextlib.suppress(OSError):
            whole = path.read_bytes() if path is not None else b""
            if hashlib.sha256(whole[DIGEST_BYTES:]).digest() == whole[:DIGEST_BYTES]:
                return pickle.loads(whole[DIGEST_BYTES:])
        return None

    def save(self, key: Any, content: Any) -> None:
        """Cache content for a key, completely or not at all."""
        from numba.core.serialize import dumps

        path = self._path(key)
        if path is None:
            return
        written = dumps(content)
        part = path.with_name(f"{path.name}-{os.urandom(6).hex()}.part")
        with contextlib.suppress(OSError):
            try:
                part.write_bytes(hashlib.sha256(written).digest() + written)
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)

    def _path(self, key: Any) -> Path | None:
        """Return the file of a function's types, processor, code, and versions."""
        import numba

        digest = hashlib.sha256(repr((sys.version, numba.__version__, key)).encode()).hexdigest()
        return None if self._folder is None else self._folder / f"{self._stem}-{digest[:32]}.nbc"


@cache
def _sources_digest() -> str:
    """Return a hash of the package's sources, independent of their folder and time."""
    folder, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def user_cache(name: str) -> Path:
    """Return the user's cache folder of this program for one kind of content.

    Raises `RuntimeError` for a user without a home.
    """
    home = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    return Path(home or Path.home() / ".cache") / "shakercal" / name


@cache
def _cache_folder() -> tuple[Path | None, str]:
    """Return the user's folder of kernels compiled from these sources, None with the reason.

    It is shared by all checkouts. Kernels of other versions that were unused for a month are removed.
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
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        return None, str(error) if isinstance(error, RuntimeError) else f"{error.filename}: {error.strerror}"
    return folder, ""


def cache_failure_reason(*, other_processes: bool = False) -> str:
    """Return why compiled kernels are not cached for the next process, empty if they are.

    Also empty where this process has compiled none, unless `other_processes` compiled for it.
    """
    return _cache_folder()[1] if other_processes or _cache_folder.cache_info().currsize else ""
