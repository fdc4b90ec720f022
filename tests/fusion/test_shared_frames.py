"""One recording by several processes, in stereo pairs and blocks of frames: equal to the serial run to the last bit."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fusion import campaign as under_test
from fusion.campaign import run_path
from fusion.errors import InputError
from fusion.evaluation import Evaluation
from fusion.execution.task import Answer, call
from fusion.execution.workers import Workers
from fusion.settings import Settings

NAME = "Fz-0080"


class Inline:
    """A crew that is this process, and tells what it was asked."""

    size = 2

    def __init__(self) -> None:
        self.asked: list[Callable[..., Any]] = []

    def __enter__(self) -> Inline:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Answer]:
        self.asked.append(function)
        future: Future[Answer] = Future()
        future.set_result(call(function, *(held.result() if isinstance(held, Future) else held for held in arguments)))
        return future


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without figures, which take most of the time."""

    def render(evaluation: Evaluation) -> str:
        return f"<!doctype html>{evaluation.manifest.name}"

    monkeypatch.setattr("fusion.results.render_report", render)


def _tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.csv"))}


@pytest.mark.usefixtures("no_figures")
def test_two_processes_share_the_frames_of_one_recording(
    demo_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []

    class Heard(Workers):
        def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Answer]:
            asked.append((function.__name__, len(arguments)))
            return super().submit(rank, function, *arguments)

    told: list[tuple[str, int, int]] = []
    run_path(demo_recording / NAME, tmp_path / "serial", Settings())
    monkeypatch.setattr(under_test, "Workers", Heard)
    outcomes = run_path(
        demo_recording / NAME, tmp_path / "two", Settings(), workers=2, progress=lambda *what: told.append(what)
    )
    assert [outcome.folder for outcome in outcomes] == [tmp_path / "two"]
    assert [name for name, _ in asked[:4]] == ["_prepared", "_prepared", "_followed", "_followed"]
    assert ("track base", 48, 48) in told
    tables = _tables(tmp_path / "serial")
    assert len(tables) >= 5
    assert _tables(tmp_path / "two") == tables


def test_an_image_that_another_process_refuses_is_told_as_here(
    demo_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(demo_recording, tmp_path / "demo")
    broken = sorted((tmp_path / "demo" / NAME / "top-right").iterdir())[5]
    image = cv2.imread(str(broken), cv2.IMREAD_UNCHANGED)
    assert image is not None
    cv2.imwrite(str(broken), np.full_like(image, 1023))
    sentences = []
    crew = Inline()
    monkeypatch.setattr(under_test, "Workers", lambda _: crew)
    for workers in (1, 2):
        with pytest.raises(InputError) as raised:
            run_path(tmp_path / "demo" / NAME, None, Settings(), workers=workers)
        sentences.append(str(raised.value))
    assert broken.name in sentences[0]
    assert sentences[0] == sentences[1]
    assert len(crew.asked) > 0


@pytest.mark.parametrize(("recordings", "shared"), [(1, True), (2, False)])
def test_few_recordings_share_their_frames_and_many_the_workers(
    recordings: int, shared: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(recordings):
        (tmp_path / "campaign" / f"{number}").mkdir(parents=True)
        (tmp_path / "campaign" / f"{number}" / "recording.toml").write_text("")
    crew = Inline()
    monkeypatch.setattr(under_test, "Workers", lambda _: crew)
    outcomes = run_path(tmp_path / "campaign", None, Settings(), workers=2)
    assert all(isinstance(outcome.error, InputError) for outcome in outcomes)
    assert len(crew.asked) == (0 if shared else recordings)
