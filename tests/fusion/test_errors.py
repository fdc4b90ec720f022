"""The sentence of an input error, and that errors survive the way between processes."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from fusion.errors import ComputeError, InputError

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
