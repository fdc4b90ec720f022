"""What tests have other processes do: they import it by its name."""

from __future__ import annotations

import logging
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from fusion.errors import REFUSED_BY_READER, InputError

if TYPE_CHECKING:
    from fusion.campaign.run import Job, Outcome


def whole_job(job: Job) -> Outcome:
    """Everything that a run does with a recording but its figures, which take most of the time."""
    from fusion.campaign.run import run_job

    with patch("fusion.report.recording_report.render_report", lambda _: "<!doctype html>"):
        return run_job(job)


def slow_job(job: Job) -> Outcome:
    """The same, but not before the test may have looked at it."""
    (job.folder.parent.parent / f"begun-{job.folder.name}").write_text(str(os.getpid()))
    time.sleep(0.5)
    return whole_job(job)


def endless_job(job: Job) -> None:
    """A recording that is never done."""
    job.folder.parent.mkdir(exist_ok=True)
    wait_for_ever(job.folder.parent / f"begun-{job.folder.name}")


def product(a: float, b: float) -> float:
    """A task without anything else."""
    return a * b


def die_until(tries: Path, deaths: int) -> int:
    """Be killed as often as is asked for, then return the number of tries."""
    with tries.open("a") as stream:
        stream.write(".")
    if tries.stat().st_size <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    return tries.stat().st_size


def refuse(kind: str) -> None:
    """Log, and fail in one of several ways."""
    logging.getLogger("shakercal").warning("a remark about %s", kind)
    if kind == "input":
        others = (InputError(REFUSED_BY_READER, "a.h5", key, reason="b") for key in ("Fx", "Fy"))
        raise InputError(REFUSED_BY_READER, "a.h5", "Fz", reason="b", others=others)
    if kind == "unpicklable":
        raise ValueError(lambda: kind)
    raise OSError(28, "disk full")


def sum_of_products() -> bytes:
    """A number whose last digits depend on the threads of linear algebra."""
    import numpy as np

    values = np.random.default_rng(1).normal(size=(2, 400_000))
    return np.asarray(values @ values.T).tobytes()


def threads() -> dict[str, int]:
    """How many threads the libraries may use."""
    import cv2
    import threadpoolctl

    from fusion.base import usable_cores

    found = {pool["prefix"]: pool["num_threads"] for pool in threadpoolctl.threadpool_info()}
    return {**found, "own": usable_cores(), "cv2": cv2.getNumThreads()}


def wait_for_ever(begun: Path) -> None:
    """Say who waits, and do so with something half-made."""
    from fusion.report.atomic_files import file_lock, temporary_path

    with file_lock(begun), temporary_path(begun) as partial:
        partial.write_text("")
        begun.write_text(str(os.getpid()))
        time.sleep(600.0)
