"""Hashes, versions and the rule for existing folders."""

from __future__ import annotations

import hashlib
from pathlib import Path

import h5py
import pytest

from fusion.base import InputError
from fusion.report.provenance import check_folder, hash_files, read_provenance, sha256, versions


def test_hash_is_that_of_the_whole_file(tmp_path: Path) -> None:
    content = bytes(range(256)) * 9000
    path = tmp_path / "big.bin"
    path.write_bytes(content)
    assert len(content) > 2 << 20
    assert sha256(path) == hashlib.sha256(content).hexdigest()


def test_published_hash_of_abc(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    assert sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-4 example


def test_files_are_named_from_the_root_and_sorted(tmp_path: Path) -> None:
    root = tmp_path / "campaign"
    (root / "b").mkdir(parents=True)
    paths = [root / "rig.toml", root / "b" / "x.tif", tmp_path / "elsewhere.h5"]
    for path in paths:
        path.write_bytes(path.name.encode())
    hashes = hash_files([*paths, paths[0]], root)
    assert list(hashes) == sorted(["rig.toml", "b/x.tif", paths[2].resolve().as_posix()])


def test_versions_name_the_program_and_only_what_was_imported() -> None:
    found = versions()
    assert {"shakercal", "python", "platform", "numpy", "h5py"} <= set(found)
    assert "pyarrow" not in found


def test_folder_rules(tmp_path: Path) -> None:
    check_folder(tmp_path / "absent", {}, force=False)
    check_folder(tmp_path, {}, force=False)
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        check_folder(tmp_path, {}, force=False)
    check_folder(tmp_path, {}, force=True)
    with pytest.raises(InputError, match="a folder"):
        check_folder(tmp_path / "thesis.txt", {}, force=True)


def test_a_foreign_or_broken_result_file_is_no_provenance(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    path.write_bytes(b"not HDF5")
    assert read_provenance(tmp_path) is None
    with h5py.File(path, "w") as file:
        file["data"] = 1.0
    assert read_provenance(tmp_path) is None
