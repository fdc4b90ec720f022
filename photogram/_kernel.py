"""Compiled functions whose cache on disk knows all the sources that they may have been compiled from.

Numba keeps a compiled function as long as the function's own file is unchanged. A kernel holds the code and the
constants of the functions that it calls, though, which are in other files: after a change there it would go on
computing with the old ones. Here a change of any module of the package makes all kernels new.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with these options, cached on disk until a module of this package changes."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if numba.config.DISABLE_JIT:
            return dispatcher
        dispatcher.enable_caching()
        files = dispatcher._cache._cache_file  # numba offers no public way to say what a cached function hangs on
        files._source_stamp = (files._source_stamp, _package_stamp())
        return dispatcher

    return compiled


@cache
def _package_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every module of the package."""
    folder = Path(__file__).parent
    states = ((path.relative_to(folder).as_posix(), path.stat()) for path in sorted(folder.rglob("*.py")))
    return tuple((name, state.st_mtime_ns, state.st_size) for name, state in states)
