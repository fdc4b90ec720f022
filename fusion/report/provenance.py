"""What was run on what: hashes of the input files, versions, and whether a results folder still answers to them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from fusion.base import PROGRAM, InputError, __version__

RESULT_FILE, RESULT_FORMAT = "result.h5", 2
BLOCK_BYTES = 1 << 20
Setting = str | float | int


@dataclass(frozen=True)
class Provenance:
    """Origin of a results folder: SHA-256 of every input by its path, settings, versions, and the files written."""

    input_hashes: dict[str, str]
    settings: dict[str, Setting]
    versions: dict[str, str]
    files: tuple[str, ...]


def sha256(path: Path) -> str:
    """SHA-256 of a file as hexadecimal digits, read block by block."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while block := stream.read(BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise InputError(path, "", found=error.strerror or str(error), expected="a file that can be read") from error
    return digest.hexdigest()


def hash_files(files: Iterable[Path], root: Path) -> dict[str, str]:
    """SHA-256 of every file, keyed by its path relative to `root` (absolute where it lies elsewhere), sorted."""
    return dict(sorted((_key(path, root), sha256(path)) for path in set(files)))


def is_current(folder: Path, hashes: Mapping[str, str], settings: Mapping[str, Setting]) -> bool:
    """Whether `folder` holds the complete results of these very inputs and settings, by this program version."""
    found = read_provenance(folder)
    if found is None or not all((folder / name).is_file() for name in found.files):
        return False
    same_program = found.versions.get(PROGRAM) == __version__
    return same_program and found.input_hashes == dict(hashes) and found.settings == dict(settings)


def check_folder(folder: Path, hashes: Mapping[str, str], *, force: bool, marker: str = RESULT_FILE) -> None:
    """Refuse a place for results that is no folder, or that holds something else than results of the same inputs.

    `marker`: the file of the results that carries their provenance.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "", found="a file", expected="a folder for the results")
    above = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        what = "a folder that may not be written to" if above.is_dir() else "a file"
        raise InputError(folder, "", found=f"{what} at {above}", expected="a place for a folder with the results")
    if force or not folder.exists() or not any(folder.iterdir()):
        return
    found = read_provenance(folder, marker)
    if found is None or found.input_hashes != dict(hashes):
        what = "other files" if found is None else "results of other input files"
        expected = "an empty folder for the results (--force writes into this one and replaces only result files)"
        raise InputError(folder, "", found=what, expected=expected)


def read_provenance(folder: Path, marker: str = RESULT_FILE) -> Provenance | None:
    """Provenance of the results in a folder; None where there are none, or where their file cannot be read."""
    path = folder / marker
    if not path.is_file() or not h5py.is_hdf5(path):
        return None
    with h5py.File(path, "r") as file:
        group = file.get("provenance")
        if group is None:
            return None
        hashes = zip(group["input_file"].asstr()[()], group["input_sha256"].asstr()[()], strict=True)
        settings = {name: _plain(value) for name, value in group["settings"].attrs.items()}
        found = {name: str(value) for name, value in group["versions"].attrs.items()}
        return Provenance(dict(hashes), settings, found, tuple(group["files"].asstr()[()]))


def write_provenance(file: h5py.File, provenance: Provenance) -> None:
    """Put the group `provenance` into an open result file."""
    group = file.create_group("provenance")
    text = h5py.string_dtype()
    hashes = provenance.input_hashes
    group.create_dataset("input_file", data=np.array(list(hashes), dtype=object), dtype=text)
    group.create_dataset("input_sha256", data=np.array(list(hashes.values()), dtype=object), dtype=text)
    group.create_dataset("files", data=np.array(provenance.files, dtype=object), dtype=text)
    group.create_group("settings").attrs.update(provenance.settings)
    group.create_group("versions").attrs.update(provenance.versions)


def _key(path: Path, root: Path) -> str:
    """Path relative to the campaign's root, with `/` on every system."""
    resolved, base = path.resolve(), root.resolve()
    return (resolved.relative_to(base) if resolved.is_relative_to(base) else resolved).as_posix()


def _plain(value: object) -> Setting:
    """HDF5 attribute as a Python scalar."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str | float | int):
        return value
    return str(value)
