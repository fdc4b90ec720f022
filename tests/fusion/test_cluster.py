"""A campaign by several processes and on a Dask cluster: equal to the serial run to the last bit, whoever is killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import worker_tasks as tasks
from dask_cluster import PATIENCE_S, Cluster, environment, wait_until

from fusion.base import ComputeError, InputError, Settings
from fusion.campaign.cluster import Outcome, connected
from fusion.campaign.run import run as under_test
from fusion.campaign.run import run_path
from fusion.cli import main
from fusion.commands.options import EXIT_INPUT, EXIT_INTERRUPTED
from fusion.simulate import simulate_campaign

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
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster for all tests of this module."""
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield cluster
    cluster.end()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few recordings of another program's points."""
    folder = tmp_path_factory.mktemp("sweep") / "campaign"
    simulate_campaign(folder, "sweep", 3, recordings=RECORDINGS)
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
        patch.setattr(under_test, "run_job", (lambda job, _: tasks.whole_job(job)) if not where else job)
        patch.setattr("fusion.campaign.joint_report.render_campaign", lambda evaluation: evaluation.name)
        return run_path(campaign, out, Settings(), **where)


def _tables(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.csv"))}


def _hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".*")]


@pytest.mark.slow
def test_two_processes_give_the_tables_of_one(sweep: Path, serial: dict[str, bytes]) -> None:
    outcomes = _run(sweep, sweep.with_name("two"), workers=2)
    assert [outcome.folder.name for outcome in outcomes] == sorted(path.parent.name for path in sweep.glob("*/*.toml"))
    assert _tables(sweep.with_name("two")) == serial


@pytest.mark.slow
def test_a_cluster_gives_the_same_tables_and_a_killed_worker_loses_nothing(
    sweep: Path, serial: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    cluster = Cluster(tmp_path_factory.mktemp("killed"))
    killed: list[int] = []

    def kill_the_first(stage: str, done: int, total: int) -> None:
        if done == 0:
            wait_until(lambda: len(list(sweep.parent.glob("begun-*"))) > 0)
            killed.append(int(next(sweep.parent.glob("begun-*")).read_text()))
            os.kill(killed[0], signal.SIGKILL)

    try:
        _run(sweep, sweep.with_name("dask"), tasks.slow_job, scheduler=cluster.address, progress=kill_the_first)
        assert killed[0] in [worker.pid for worker in cluster.workers]
        assert _tables(sweep.with_name("dask")) == serial
        assert _hidden(sweep.with_name("dask")) == []
    finally:
        cluster.end()


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_to_the_same_tables(
    sweep: Path, serial: dict[str, bytes], tmp_path: Path
) -> None:
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


def test_an_interruption_ends_all_workers_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    script, out = tmp_path / "run.py", tmp_path / "out"
    script.write_text(RUN)
    for name in ("a", "b", "c"):
        (tmp_path / "campaign" / name).mkdir(parents=True)
        (tmp_path / "campaign" / name / "recording.toml").write_text("")
    command = [sys.executable, script, "endless_job", "run", tmp_path / "campaign", "-o", out, "--workers", "2"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, start_new_session=True) as run:
        wait_until(lambda: len([path for path in out.glob("begun-*") if path.read_text()]) == 2)
        os.killpg(run.pid, signal.SIGINT)  # as a terminal does
        assert run.wait(PATIENCE_S) == EXIT_INTERRUPTED
        assert run.stderr is not None
        assert run.stderr.read() == b"shakercal: interrupted; nothing half-written was left behind\n"
    assert not any(Path(f"/proc/{path.read_text()}").exists() for path in out.glob("begun-*"))
    assert _hidden(out) == []


def test_tasks_of_a_cluster_come_back_like_those_of_processes(cluster: Cluster, tmp_path: Path) -> None:
    with connected(cluster.address) as crew:
        first = crew.submit(0, tasks.product, 2.0, 3.0)
        assert first.result().opened() == 6.0
        assert crew.submit(0, tasks.product, first, 7.0).result().opened() == 42.0
        assert set(crew.submit(0, tasks.threads).result().opened().values()) == {1}
        answer = crew.submit(0, tasks.refuse, "input").result()
        assert [record.getMessage() for record in answer.told] == ["a remark about input"]
        with pytest.raises(InputError, match=r"a\.h5: Fz"):
            answer.opened()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "foo://a:1", ""])
def test_an_address_where_nothing_answers_is_refused(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fusion.campaign.cluster.ANSWER_S", 0.5)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "recording.toml").write_text("")
    assert main(["run", str(tmp_path), "--scheduler", address]) == EXIT_INPUT
    told = capsys.readouterr().err
    assert told == (
        "shakercal: --scheduler: expected the address of a Dask scheduler that answers, such as tcp://10.0.0.1:8786, "
        f"found {address or 'nothing'}, where none does\n"
    )


def test_without_the_extra_the_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    (tmp_path / "recording.toml").write_text("")
    assert main(["run", str(tmp_path), "--scheduler", "tcp://127.0.0.1:9"]) == EXIT_INPUT
    told = capsys.readouterr().err
    assert told.startswith('shakercal: --scheduler: expected the packages that pip install "shakercal[cluster]" brings')
    assert told.count("\n") == 1


def test_workers_of_another_version_are_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.campaign.cluster.PROGRAM", "numpy")
    found = re.escape(version("shakercal"))
    with pytest.raises(InputError, match=f"expected workers with numpy .*, found numpy {found} at tcp:"):  # noqa: SIM117
        with connected(cluster.address):
            pass


def test_a_scheduler_that_goes_is_told(tmp_path: Path) -> None:
    cluster = Cluster(tmp_path)
    with connected(cluster.address) as crew:
        waiting = crew.submit(0, tasks.wait_for_ever, tmp_path / "begun")
        wait_until((tmp_path / "begun").exists)
        cluster.end()
        with pytest.raises(ComputeError, match="the Dask scheduler is gone"):
            waiting.result()
