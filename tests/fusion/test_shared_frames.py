"""One recording by several processes, in stereo pairs and blocks of frames: equal to the serial run to the last bit."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dask_cluster import Cluster

from fusion.base import InputError, Settings
from fusion.campaign.run import run as under_test
from fusion.campaign.run import run_path
from fusion.campaign.workers import Answer, Workers, call

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


def _run(recording: Path, out: Path, **where: Any) -> dict[str, bytes]:
    """Every table of a recording; its report is without figures, which take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "fusion.report.recording.render_report", lambda evaluation: f"<!doctype html>{evaluation.manifest.name}"
        )
        outcomes = run_path(recording, out, Settings(), **where)
    assert [outcome.folder for outcome in outcomes] == [out]
    return {path.name: path.read_bytes() for path in sorted(out.glob("*.csv"))}


@pytest.fixture(scope="module")
def serial(demo_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The tables of the serial run."""
    tables = _run(demo_recording / NAME, tmp_path_factory.mktemp("serial") / "out")
    assert len(tables) >= 5
    return tables


def test_two_processes_share_the_frames_of_one_recording(
    demo_recording: Path, serial: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    class Heard(Workers):
        def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Answer]:
            asked.append(function.__name__)
            return super().submit(rank, function, *arguments)

    told: list[tuple[str, int, int]] = []
    monkeypatch.setattr(under_test, "Workers", Heard)
    tables = _run(demo_recording / NAME, tmp_path / "two", workers=2, progress=lambda *what: told.append(what))
    assert asked[:4] == ["_prepared", "_prepared", "_followed", "_followed"]
    assert ("track base", 48, 48) in told
    assert tables == serial


def test_a_cluster_shares_the_frames_of_one_recording(
    demo_recording: Path, serial: dict[str, bytes], tmp_path: Path
) -> None:
    cluster = Cluster(tmp_path)
    try:
        assert _run(demo_recording / NAME, tmp_path / "dask", scheduler=cluster.address) == serial
    finally:
        cluster.end()


def test_arrays_of_an_answer_travel_in_it() -> None:
    """Apart from it they would begin at any byte of a message."""
    apart: list[pickle.PickleBuffer] = []
    packed = pickle.dumps(Answer(np.arange(1e5), None, ()), protocol=5, buffer_callback=apart.append)
    assert not apart
    array = pickle.loads(packed, buffers=apart).opened()
    assert array.flags.aligned
    assert np.array_equal(array, np.arange(1e5))


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
