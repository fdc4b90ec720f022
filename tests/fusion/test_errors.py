"""The sentence of an input error, and that errors survive the way between processes."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from fusion.base import ComputeError, InputError

SAMPLE = InputError(Path("rig.toml"), "stereo.top.rotation", found="2", expected="a rotation")


def test_the_sentence_names_file_key_expectation_and_finding() -> None:
    assert str(SAMPLE) == "rig.toml: stereo.top.rotation: expected a rotation, found 2"


def test_without_key_the_file_is_meant() -> None:
    assert (
        str(InputError("a.tif", "", found="3 bytes", expected="an image")) == "a.tif: expected an image, found 3 bytes"
    )


@pytest.mark.parametrize(("more", "told"), [(1, "(1 more problem in"), (2, "(2 more problems in")])
def test_further_problems_are_counted(more: int, told: str) -> None:
    assert told in str(InputError("a", "b", "c", "d", more=more))


def test_lines_of_a_reader_become_one_sentence() -> None:
    assert str(InputError("a", "b", found="x\n  y", expected="z")) == "a: b: expected z, found x y"


@pytest.mark.parametrize("error", [SAMPLE, ComputeError("no line found")])
def test_errors_can_be_sent_between_processes(error: Exception) -> None:
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert str(back) == str(error)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("{folder}/top/0003.tif: truncated"), "{file}: images.top: top/0003.tif: truncated"),
        (ValueError("{file}: rotation: expected a, found b"), "{file}: images.top: rotation: expected a, found b"),
        (ValueError("nominal_hz: expected a, found b"), "{file}: images.top: expected a, found b"),
        (ValueError("a.tif: expected a, found b"), "{file}: images.top: a.tif: expected a, found b"),
        (PermissionError(13, "Permission denied", "{folder}/a.h5"), "{file}: images.top: a.h5: Permission denied"),
        (OSError("closed"), "{file}: images.top: closed"),
    ],
)
def test_what_a_reader_says_is_told_once(error: Exception, told: str, tmp_path: Path) -> None:
    names = {"folder": str(tmp_path), "file": str(tmp_path / "recording.toml")}
    filled = type(error)(*(part.format(**names) if isinstance(part, str) else part for part in error.args))
    if isinstance(error, OSError) and error.filename is not None:
        filled = PermissionError(13, "Permission denied", error.filename.format(**names))
    assert str(InputError.told_by(filled, Path(names["file"]), "images.top")) == told.format(**names)
