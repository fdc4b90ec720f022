"""Compiled functions whose cache on disk knows all the sources that they may have been compiled from.

Numba keeps a compiled function as long as the function's own file is unchanged. A kernel holds the code and the
constants of the functions that it calls, though, which are in other files: after a change there it would go on
computing with the old ones. Here a change of any module of the package makes all kernels new.

A kernel computes the same digits in every process. Numba compiles a function with the options of the one that calls it
where it states none itself, and copies it into the kernels that call it; which of the copies runs hangs on what was
compiled or loaded before. So all options are stated, and fast-math, by which every copy may round in another way, is
none of them: `lanes` has the arithmetic that needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba


def njit(
    *, parallel: bool = False, nogil: bool = False, error_model: str = "python", inline: str = "never"
) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with these options and no others, cached on disk until a module of this package changes."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(parallel=parallel, nogil=nogil, error_model=error_model, inline=inline, fastmath=False)(
            function
        )
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
