"""What every command does with a finished evaluation: tell its notices, put its origin on a page, write a folder."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import h5py

from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.page import origin_frame
from fusion.provenance import Provenance, write_provenance
from fusion.results import write_folder


class Evaluated(Protocol):
    """An evaluation with its notices and its origin: settings, versions of what computed it, hashes of its inputs."""

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What the user should know."""

    @property
    def settings(self) -> dict[str, str | float | int]:
        """What was chosen."""

    @property
    def versions(self) -> dict[str, str]:
        """The program and the libraries that computed it."""

    @property
    def input_hashes(self) -> dict[str, str]:
        """Hashes of all input files."""

    @property
    def duration_s(self) -> float:
        """How long it took."""


E = TypeVar("E", bound=Evaluated)


@dataclass(frozen=True)
class ResultFolder(Generic[E]):
    """The files of one kind of evaluation.

    `h5_file`: the HDF5 file, which says that the folder is complete and is filled by `fill`; `texts` gives the other
    files by name, texts or pictures; `own`: names that are the program's.
    """

    h5_file: str
    own: re.Pattern[str]
    texts: Callable[[E], Mapping[str, str | bytes]]
    fill: Callable[[h5py.File, E], None]

    def write(self, evaluation: E, folder: Path, *, force: bool = False) -> list[Path]:
        """Write every file and return their paths; other folders are refused unless `force`."""
        make = partial(self._make, evaluation=evaluation)
        return write_folder(folder, evaluation.input_hashes, make, force=force, marker=self.h5_file, own=self.own)

    def _make(self, folder: Path, evaluation: E) -> list[str]:
        """Make all files in a folder, the HDF5 file last."""
        texts = self.texts(evaluation)
        for name, text in texts.items():
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
        names = [*texts, self.h5_file]
        with h5py.File(folder / self.h5_file, "w", track_order=True) as file:
            write_provenance(file, _origin(evaluation, names))
            self.fill(file, evaluation)
        return names


def default_folder(paths: Sequence[Path], manifests: Sequence[Manifest], name: str) -> Path:
    """Where results of recordings that are evaluated together stand: folder `name` of the campaign or of the only
    recording at `paths`, or, of several paths, beside the first recording's rig."""
    if len(paths) > 1:
        return manifests[0].root / name
    return (manifests[0].folder if paths[0].is_file() else paths[0]) / name


def page_frame(evaluation: Evaluated) -> dict[str, Any]:
    """What every page shows of an evaluation: notices, origin, inputs, program, time of computation."""
    return {**origin_frame(_origin(evaluation, ()), evaluation.notices), "duration_s": evaluation.duration_s}


def log_notices(evaluation: Evaluated, log: logging.Logger) -> None:
    """Log every notice with its place."""
    for notice in evaluation.notices:
        level = logging.WARNING if notice.severity == "warning" else logging.INFO
        log.log(level, "%s: %s", notice.where, notice.text)


def _origin(evaluation: Evaluated, names: list[str] | tuple[str, ...]) -> Provenance:
    """Settings, versions and inputs of an evaluation, with the files that hold it."""
    return Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(names))
