"""How many threads the libraries of one task use.

Linear algebra adds in an order that depends on its threads, so that with another number of them the last digits of a
result change. Everything a run computes is therefore done with one of them, wherever it is computed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "NUMBA_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LIMITS, "OPENCV_FOR_THREADS_NUM"), "1")
"""What a process has to be started with for its libraries to use one thread each."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let linear algebra compute with one thread; loops over subsets, whose result does not depend on it, keep all."""
    import scipy.linalg  # noqa: F401  (brings a linear algebra of its own, which is to be limited too)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


def with_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function while every library computes with one thread."""
    with one_thread():
        return function(*arguments)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let every library compute with one thread."""
    import cv2
    import numba
    from threadpoolctl import threadpool_limits

    threads = numba.get_num_threads(), cv2.getNumThreads()
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        with one_blas_thread(), threadpool_limits(1):
            yield
    finally:
        numba.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])
