"""Processes of this machine and of a cluster: the digits of one process, whoever is killed, and none left behind."""

from __future__ import annotations

import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import worker_tasks as tasks
from cluster_factory import PATIENCE_S, Cluster, InlineExecutor, environment, wait_until
from support import without_pages

from fusion.base import Settings
from fusion.campaign import run as leading
from fusion.campaign.campaign_notices import NO_DASK, NO_SCHEDULER, OTHER_WORKER_VERSION, SCHEDULER_LOST, WORKER_ENDED
from fusion.campaign.executor import LoggedResult, Workers, call, connect_cluster, one_blas_thread
from fusion.campaign.run import Outcome, run_path
from fusion.commands.options import EXIT_INTERRUPTED
from fusion.errors import REFUSED_BY_READER, ComputeError, InputError
from fusion.report.atomic_files import remove_abandoned
from fusion.report.recording_report import result_tables
from fusion.sensitivity.analyse import Evaluation
from fusion.simulate import simulate
from photogram.measure.body import follow_block


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


def test_results_belong_to_their_tasks(two):
    answers = [two.submit(-number, tasks.product, number, 2.0) for number in range(8)]
    assert [answer.result(PATIENCE_S).unwrap() for answer in answers] == [2.0 * number for number in range(8)]
    # An answer can be what the next task needs.
    assert two.submit(0, tasks.product, answers[3], 7.0).result(PATIENCE_S).unwrap() == 42.0
    assert set(two.submit(0, tasks.threads).result(PATIENCE_S).unwrap().values()) == {1}


def test_one_thread_of_linear_algebra_gives_the_same_digits_everywhere(two):
    with one_blas_thread():
        here = tasks.sum_of_products()
    assert two.submit(0, tasks.sum_of_products).result(PATIENCE_S).unwrap() == here


@pytest.mark.parametrize(
    ("kind", "error", "sentence"),
    [
        ("input", InputError, f"{REFUSED_BY_READER.code} a.h5: Fz: b (2 more "),
        ("disk", OSError, "[Errno 28] disk full"),
        ("unpicklable", RuntimeError, "ValueError: <function"),
    ],
)
def test_failures_and_remarks_come_back(kind, error, sentence, two, capsys):
    answer = two.submit(0, tasks.refuse, kind).result(PATIENCE_S)
    log = logging.getLogger("shakercal")
    level = log.level
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log, "handlers", [logging.StreamHandler(sys.stderr)])
        patch.setattr(log, "propagate", False)
        answer.log("Fz-0100")
    assert capsys.readouterr().err == f"Fz-0100: {answer.log_records[0].getMessage()}\n"
    with pytest.raises(error) as raised:
        answer.unwrap()
    assert str(raised.value).startswith(sentence)
    if kind != "unpicklable":
        assert "in refuse" in raised.value.__notes__[0]
    here = call(tasks.refuse, kind)  # is answered likewise
    assert isinstance(here.error, ValueError if kind == "unpicklable" else error)
    assert [record.getMessage() for record in here.log_records] == [f"a remark about {kind}"]
    assert log.level == level


def test_the_task_of_a_worker_that_was_killed_is_done_by_another_and_one_that_kills_all_fails_alone(two, tmp_path):
    answer, other = two.submit(0, tasks.die_until, tmp_path / "two", 2), two.submit(1, tasks.product, 2.0, 3.0)
    assert answer.result(PATIENCE_S).unwrap() == 3
    assert other.result(PATIENCE_S).unwrap() == 6.0
    answer = two.submit(0, tasks.die_until, tmp_path / "all", 99).result(PATIENCE_S)
    with pytest.raises(ComputeError) as ended:
        answer.unwrap()
    assert (ended.value.code, ended.value.values["attempts"]) == (WORKER_ENDED.code, 3)
    assert (tmp_path / "all").stat().st_size == 3
    assert two.submit(0, tasks.product, 2.0, 3.0).result(PATIENCE_S).unwrap() == 6.0


def test_the_end_leaves_no_process_and_no_unfinished_file(tmp_path):
    begun = tmp_path / "begun"
    with Workers(1) as workers:
        waiting = workers.submit(0, tasks.wait_for_ever, begun)
        never = workers.submit(1, tasks.product, 1.0, 1.0)
        wait_until(lambda: begun.exists() and begun.read_text())
    assert waiting.cancelled()
    assert never.cancelled()
    assert not _is_running(int(begun.read_text()))
    remove_abandoned(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["begun"]


def test_workers_end_when_the_process_that_leads_them_is_killed(tmp_path):
    begun = tmp_path / "begun"
    code = (
        "import sys, pathlib, worker_tasks\nfrom fusion.campaign.executor import Workers\n"
        "if __name__ == '__main__':\n"
        "    with Workers(1) as workers:\n"
        "        workers.submit(0, worker_tasks.wait_for_ever, pathlib.Path(sys.argv[1])).result()\n"
    )
    script = tmp_path / "lead.py"
    script.write_text(code)
    leader = subprocess.Popen([sys.executable, script, begun], env=environment())
    wait_until(lambda: begun.exists() and begun.read_text())
    leader.kill()
    leader.wait()
    wait_until(lambda: not _is_running(int(begun.read_text())))


NAME = "Fz-0080"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster for all tests of this module that leave it alive."""
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield cluster
    cluster.end()


def _tables(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.csv"))}


def _demo_tables(demo_recording: Path, out: Path, **where: Any) -> dict[str, bytes]:
    """Every table of the demo's recording."""
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        run_path(demo_recording / NAME, out, Settings(), **where)
    return _tables(out)


@pytest.fixture(scope="module")
def serial_demo(demo_evaluation: Evaluation) -> dict[str, bytes]:
    """The tables of the serial run."""
    tables = {name: text.encode() for name, text in result_tables(demo_evaluation).items()}
    assert len(tables) >= 5
    return tables


def test_shared_frames_give_the_tables_of_the_serial_run(demo_recording, serial_demo, tmp_path, monkeypatch):
    """Stereo pairs and blocks of frames go to the crew, here this process."""
    crew, stages = InlineExecutor(), []
    monkeypatch.setattr(leading, "Workers", lambda _: crew)
    tables = _demo_tables(demo_recording, tmp_path, workers=2, progress=lambda *what: stages.append(what))
    names = [asked.__name__ for asked in crew.asked if asked.__name__ != "_ready"]  # those begin the workers
    assert names[:4] == ["prepare_scene", "prepare_scene", "track_block", "track_block"]
    assert ("track base", 48, 48) in stages
    assert tables == serial_demo


def test_threads_give_the_tables_of_one(demo_recording, serial_demo, tmp_path, monkeypatch):
    """Both bodies at once, in more threads than this machine may have cores; those of the fixture are one."""
    seen = set[str]()

    def noted(*arguments: Any) -> Any:
        seen.add(threading.current_thread().name)
        return follow_block(*arguments)

    monkeypatch.setattr("fusion.base.usable_cores", lambda: 3)
    monkeypatch.setattr("photogram.measure.body.follow_block", noted)
    assert _demo_tables(demo_recording, tmp_path) == serial_demo
    assert len(seen) == 2


@pytest.mark.slow
@pytest.mark.parametrize("who", ["two processes", "a cluster"])
def test_others_share_the_frames_of_one_recording(who, demo_recording, serial_demo, cluster, tmp_path):
    where = {"workers": 2} if who == "two processes" else {"workers": cluster.address}
    assert _demo_tables(demo_recording, tmp_path, **where) == serial_demo


def test_arrays_of_an_answer_travel_in_it():
    """Apart from it they would begin at any byte of a message."""
    apart: list[pickle.PickleBuffer] = []
    packed = pickle.dumps(LoggedResult(np.arange(1e5), None, ()), protocol=5, buffer_callback=apart.append)
    assert not apart
    array = pickle.loads(packed, buffers=apart).unwrap()
    assert array.flags.aligned
    assert np.array_equal(array, np.arange(1e5))


@pytest.mark.slow
def test_an_image_refused_by_another_process_gives_the_same_error(demo_recording, tmp_path, monkeypatch):
    shutil.copytree(demo_recording, tmp_path / "demo")
    broken = sorted((tmp_path / "demo" / NAME / "top-right").iterdir())[5]
    image = cv2.imread(str(broken), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(broken), np.full_like(image, 1023))
    sentences = []
    crew = InlineExecutor()
    monkeypatch.setattr(leading, "Workers", lambda _: crew)
    for workers in (1, 2):
        with pytest.raises(InputError) as raised:
            run_path(tmp_path / "demo" / NAME, None, Settings(), workers=workers)
        sentences.append(str(raised.value))
    assert broken.name in sentences[0]
    assert sentences[0] == sentences[1]
    assert len(crew.asked) > 0


def _empty_recordings(campaign: Path, count: int) -> None:
    for number in range(count):
        (campaign / f"{number}").mkdir(parents=True)
        (campaign / f"{number}" / "recording.toml").write_text("")


@pytest.mark.parametrize(("recordings", "shared"), [(1, True), (2, False)])
def test_few_recordings_share_their_frames_and_many_the_workers(recordings, shared, tmp_path, monkeypatch):
    _empty_recordings(tmp_path / "campaign", recordings)
    crew = InlineExecutor()
    monkeypatch.setattr(leading, "Workers", lambda _: crew)
    outcomes = run_path(tmp_path / "campaign", None, Settings(), workers=2)
    assert all(isinstance(outcome.error, InputError) for outcome in outcomes)
    assert len(crew.asked) == (0 if shared else recordings)


RECORDINGS = 3
RUN = """
import signal, sys, worker_tasks
from unittest.mock import patch
from fusion.cli import main
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job starts with the signal ignored
    with patch("fusion.campaign.run.run_job", getattr(worker_tasks, sys.argv.pop(1))), \\
         patch("fusion.campaign.joint_report.render_campaign", lambda evaluation: evaluation.name):
        sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few recordings of another program's points."""
    folder = tmp_path_factory.mktemp("sweep") / "campaign"
    simulate(folder, "sweep", 3, recordings=RECORDINGS)
    return folder


@pytest.fixture(scope="module")
def serial(sweep: Path) -> dict[str, bytes]:
    """Every table that the serial run writes."""
    outcomes = _run(sweep, sweep.with_name("serial"))
    assert all(outcome.error is None for outcome in outcomes)
    tables = _tables(sweep.with_name("serial"))
    assert len(tables) > 5 * RECORDINGS
    return tables


def _run(campaign: Path, out: Path, job: Any = tasks.whole_job, **where: Any) -> tuple[Outcome, ...]:
    """Run a campaign without its figures."""
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        if where:
            patch.setattr(leading, "run_job", job)
        return run_path(campaign, out, Settings(), **where)


def _begun(folder: Path) -> list[int]:
    """The processes that have told that they began; a file without a number is being written."""
    return [int(text) for path in folder.glob("begun-*") if (text := path.read_text())]


def _hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".*")]


@pytest.mark.slow
def test_two_processes_give_the_tables_of_one(sweep, serial):
    outcomes = _run(sweep, sweep.with_name("two"), workers=2)
    assert [outcome.folder.name for outcome in outcomes] == sorted(path.parent.name for path in sweep.glob("*/*.toml"))
    assert _tables(sweep.with_name("two")) == serial


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_to_the_same_tables(sweep, serial, tmp_path):
    script, out = tmp_path / "run.py", tmp_path / "out"
    script.write_text(RUN)
    command = [sys.executable, script, "slow_job", "run", sweep, "-o", out, "--workers", "2"]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL) as run:
        wait_until(lambda: len(list(out.glob("Fz*/result.h5"))) > 0)
        run.kill()
    done = {path.parent.name: path.stat().st_mtime_ns for path in out.glob("Fz*/result.h5")}
    assert not (out / "sensitivity.csv").exists()
    assert subprocess.run(command, env=environment(), stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert _tables(out) == serial
    assert _hidden(out) == []
    assert all((out / name / "result.h5").stat().st_mtime_ns == when for name, when in done.items())


@pytest.mark.slow
def test_an_interruption_ends_all_workers_and_leaves_no_unfinished_file(tmp_path):
    script, out = tmp_path / "run.py", tmp_path / "out"
    script.write_text(RUN)
    _empty_recordings(tmp_path / "campaign", 3)
    command = [sys.executable, script, "endless_job", "run", tmp_path / "campaign", "-o", out, "--workers", "2"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, start_new_session=True) as run:
        wait_until(lambda: len(_begun(out)) == 2)
        os.killpg(run.pid, signal.SIGINT)  # as a terminal does
        assert run.wait(PATIENCE_S) == EXIT_INTERRUPTED
        assert run.stderr.read() == b"shakercal: interrupted; nothing half-written was left behind\n"
    assert not any(Path(f"/proc/{path.read_text()}").exists() for path in out.glob("begun-*"))
    assert _hidden(out) == []


def test_tasks_of_a_cluster_come_back_like_those_of_processes(cluster, tmp_path):
    with connect_cluster(cluster.address) as crew:
        first = crew.submit(0, tasks.product, 2.0, 3.0)
        assert first.result().unwrap() == 6.0
        assert crew.submit(0, tasks.product, first, 7.0).result().unwrap() == 42.0
        assert set(crew.submit(0, tasks.threads).result().unwrap().values()) == {1}
        answer = crew.submit(0, tasks.refuse, "input").result()
        assert [record.getMessage() for record in answer.log_records] == ["a remark about input"]
        with pytest.raises(InputError, match=r"a\.h5: Fz"):
            answer.unwrap()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "foo://a:1", ""])
def test_an_address_without_a_scheduler_is_refused(address, tmp_path, monkeypatch, refused):
    monkeypatch.setattr("fusion.campaign.executor.ANSWER_S", 0.5)
    (tmp_path / "recording.toml").write_text("")
    sentence = refused("run", tmp_path, "--scheduler", address)
    assert sentence.startswith(f"shakercal: {NO_SCHEDULER.code} --scheduler: ")
    assert address in sentence


def test_without_the_extra_the_command_is_refused(tmp_path, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "distributed", None)
    (tmp_path / "recording.toml").write_text("")
    sentence = refused("run", tmp_path, "--scheduler", "tcp://127.0.0.1:9")
    assert sentence.startswith(f"shakercal: {NO_DASK.code} --scheduler: ")


def test_workers_of_another_version_are_refused(cluster, monkeypatch):
    monkeypatch.setattr("fusion.campaign.executor.__version__", "99.0")
    found = version("shakercal")
    with pytest.raises(InputError, match=OTHER_WORKER_VERSION.code) as raised, connect_cluster(cluster.address):
        pass
    assert raised.value.values["expected"] == "shakercal 99.0"
    assert raised.value.values["found"] == f"shakercal {found}"


@pytest.mark.slow
def test_a_lost_scheduler_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr("fusion.campaign.executor.SCHEDULER_TIMEOUT_S", 1.0)
    cluster = Cluster(tmp_path, workers=1)
    with connect_cluster(cluster.address) as crew:
        waiting = crew.submit(0, tasks.wait_for_ever, tmp_path / "begun")
        wait_until((tmp_path / "begun").exists)
        cluster.end()
        with pytest.raises(ComputeError, match=SCHEDULER_LOST.code):
            waiting.result()


def _worker_processes(nanny: int) -> list[int]:
    """The workers that a nanny has started."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((place / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == nanny and b"spawn_main" in (place / "cmdline").read_bytes():
                found.append(int(place.name))
        except OSError:
            continue
    return found


_KILLS = 4  # more would only make slow machines begin again and again


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers of a nanny in /proc")
def test_killed_workers_and_a_scheduler_that_starts_anew_change_no_digit(sweep, serial, tmp_path):
    cluster, ended, killed = Cluster(tmp_path, nannies=True), threading.Event(), 0

    def kill() -> None:
        nonlocal killed
        while killed < _KILLS and not ended.wait(10.0 if killed else 2.0):  # whole recordings take seconds
            if killed == 1:
                cluster.restart_scheduler(1.0)
            for process in _worker_processes(cluster.workers[killed % 2].pid)[:1]:
                os.kill(process, signal.SIGKILL)
                killed += 1

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        outcomes = _run(sweep, tmp_path / "out", tasks.slow_job, workers=cluster.address)
    finally:
        ended.set()
        killer.join()
        cluster.end()
    assert [outcome.error for outcome in outcomes] == [None] * RECORDINGS
    assert killed > 0
    assert _tables(tmp_path / "out") == serial
    assert _hidden(tmp_path / "out") == []


BLOCKS = """
import sys
import photogram.measure.follow
from unittest.mock import patch
from fusion.cli import main
photogram.measure.follow.BLOCK_FRAMES = 3
if __name__ == "__main__":
    with patch("fusion.report.recording_report.render_report", lambda _: "<!doctype html>"):
        sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--workers", "2"]])
def test_frames_followed_before_a_kill_are_not_repeated(options, demo_recording, tmp_path):
    script = tmp_path / "blocks.py"
    script.write_text(BLOCKS)
    whole = [sys.executable, script, "run", "-q", demo_recording / NAME, "-o", tmp_path / "whole"]
    assert subprocess.run(whole, env=environment(), check=False, capture_output=True).returncode == 0
    kept, out = tmp_path / ".out.so-far", tmp_path / "out"
    command = [*whole[:-1], out, *options]
    for blocks in (1, 5):
        with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as run:
            wait_until(lambda blocks=blocks: len(list(kept.glob("*"))) >= blocks)
            run.kill()
        assert not out.exists()
    damaged = next(file for file in kept.iterdir() if not file.name.endswith(".part"))
    damaged.write_bytes(damaged.read_bytes()[:-100])
    assert subprocess.run(command, env=environment(), check=False, capture_output=True).returncode == 0
    assert _tables(out) == _tables(tmp_path / "whole")
    assert not kept.exists()
