"""Processes of this machine: answers and failures come back, dead ones are replaced, none is left behind."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import worker_tasks as tasks

from fusion.base import ComputeError, InputError, remove_abandoned, temporary_beside
from fusion.campaign.workers import Workers, call, one_blas_thread

PATIENCE_S = 120.0
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def two() -> Iterator[Workers]:
    """Two workers, who serve all tests of this module."""
    with Workers(2) as workers:
        yield workers


def _is_running(process: int) -> bool:
    state = Path(f"/proc/{process}/stat")
    if Path("/proc").is_dir():
        return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def _wait_until(condition: object) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_answers_go_to_those_who_asked(two: Workers) -> None:
    answers = [two.submit(-number, tasks.product, number, 2.0) for number in range(8)]
    assert [answer.result(PATIENCE_S).opened() for answer in answers] == [2.0 * number for number in range(8)]


def test_an_answer_can_be_what_the_next_task_needs(two: Workers) -> None:
    first = two.submit(0, tasks.product, 2.0, 3.0)
    first.result(PATIENCE_S)
    assert two.submit(0, tasks.product, first, 7.0).result(PATIENCE_S).opened() == 42.0


def test_every_library_has_one_thread(two: Workers) -> None:
    assert set(two.submit(0, tasks.threads).result(PATIENCE_S).opened().values()) == {1}


def test_one_thread_of_linear_algebra_gives_the_same_digits_everywhere(two: Workers) -> None:
    with one_blas_thread():
        here = tasks.sum_of_products()
    assert two.submit(0, tasks.sum_of_products).result(PATIENCE_S).opened() == here


@pytest.mark.parametrize(
    ("kind", "error", "sentence"),
    [
        ("input", InputError, "a.h5: Fz: expected c, found b (2 more problems in this file)"),
        ("disk", OSError, "[Errno 28] disk full"),
        ("unpicklable", RuntimeError, "ValueError: <function"),
    ],
)
def test_failures_and_remarks_come_back(
    kind: str, error: type[Exception], sentence: str, two: Workers, capsys: pytest.CaptureFixture[str]
) -> None:
    answer = two.submit(0, tasks.refuse, kind).result(PATIENCE_S)
    log = logging.getLogger("shakercal")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log, "handlers", [logging.StreamHandler(sys.stderr)])
        patch.setattr(log, "propagate", False)
        answer.log("Fz-0100")
    assert capsys.readouterr().err == f"Fz-0100: a remark about {kind}\n"
    with pytest.raises(error) as raised:
        answer.opened()
    assert str(raised.value).startswith(sentence)
    if kind != "unpicklable":
        assert "in refuse" in raised.value.__notes__[0]


def test_the_task_of_a_worker_that_was_killed_is_done_by_another(two: Workers, tmp_path: Path) -> None:
    answer, other = two.submit(0, tasks.die_until, tmp_path / "tries", 2), two.submit(1, tasks.product, 2.0, 3.0)
    assert answer.result(PATIENCE_S).opened() == 3
    assert other.result(PATIENCE_S).opened() == 6.0


def test_a_task_that_kills_every_worker_fails_alone(two: Workers, tmp_path: Path) -> None:
    answer = two.submit(0, tasks.die_until, tmp_path / "tries", 99).result(PATIENCE_S)
    with pytest.raises(
        ComputeError, match=r"3 worker processes ended while they computed it; does the memory suffice\?"
    ):
        answer.opened()
    assert (tmp_path / "tries").stat().st_size == 3
    assert two.submit(0, tasks.product, 2.0, 3.0).result(PATIENCE_S).opened() == 6.0


def test_the_end_leaves_no_process_and_nothing_half_written(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    with Workers(1) as workers:
        waiting = workers.submit(0, tasks.wait_for_ever, begun)
        never = workers.submit(1, tasks.product, 1.0, 1.0)
        _wait_until(lambda: begun.exists() and begun.read_text())
    assert waiting.cancelled()
    assert never.cancelled()
    assert not _is_running(int(begun.read_text()))
    assert [path.name for path in tmp_path.iterdir()] == ["begun"]


def test_workers_end_when_the_process_that_leads_them_is_killed(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    code = (
        "import sys, pathlib, worker_tasks\nfrom fusion.campaign.workers import Workers\n"
        "if __name__ == '__main__':\n"
        "    with Workers(1) as workers:\n"
        "        workers.submit(0, worker_tasks.wait_for_ever, pathlib.Path(sys.argv[1])).result()\n"
    )
    script = tmp_path / "lead.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    leader = subprocess.Popen([sys.executable, script, begun], env=environment)
    _wait_until(lambda: begun.exists() and begun.read_text())
    leader.kill()
    leader.wait()
    _wait_until(lambda: not _is_running(int(begun.read_text())))


def test_a_call_here_is_answered_likewise() -> None:
    level = logging.getLogger("shakercal").level
    answer = call(tasks.refuse, "input")
    assert isinstance(answer.error, InputError)
    assert [record.getMessage() for record in answer.told] == ["a remark about input"]
    assert logging.getLogger("shakercal").level == level


def test_only_what_a_process_left_that_is_gone_is_removed(tmp_path: Path) -> None:
    own = temporary_beside(tmp_path / "Fz-0100")
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    other_host = own.name.replace(f"-{os.getpid()}@", f"-{gone.pid}@far-")
    stale = own.name.replace(f"-{os.getpid()}@", f"-{gone.pid}@")
    old = other_host.replace("0100", "0200")
    for name in (own.name, other_host, stale, old, ".DS_Store", ".hidden-123"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("")
    os.utime(tmp_path / old, (0, 0))
    assert sorted(path.name for path in remove_abandoned(tmp_path)) == sorted([stale, old])
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {own.name, other_host, ".DS_Store", ".hidden-123"}
    assert remove_abandoned(tmp_path / "none") == []
