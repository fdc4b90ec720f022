"""What is kept for later runs: found again, made anew where it is not what was written, and never in the way."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import jinja2
import pytest

from fusion.report.folder import TEMPLATES
from fusion.report.notice_tables import code_html
from fusion.report.page_cache import UNUSED_S, CompiledTemplates, load_or_make


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path))
    return tmp_path / "shakercal" / "pages"


def made(calls: list[str], content: bytes = b"content"):
    def make() -> bytes:
        calls.append("made")
        return content

    return make


def test_an_entry_is_made_once_for_each_key(folder):
    calls: list[str] = []
    assert load_or_make("a", "1", made(calls)) == load_or_make("a", "1", made(calls)) == b"content"
    assert calls == ["made"]
    assert load_or_make("a", "2", made(calls, b"other")) == b"other"
    assert load_or_make("b", "1", made(calls, b"third")) == b"third"
    assert load_or_make("a", "1", made(calls)) == b"content"
    assert len(calls) == len(list(folder.iterdir())) == 3


@pytest.mark.parametrize("damage", [b"", b"short", None])
def test_a_damaged_entry_is_made_again(folder, damage):
    calls: list[str] = []
    load_or_make("a", "1", made(calls))
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:-1] + b"?" if damage is None else damage)
    assert load_or_make("a", "1", made(calls)) == b"content"
    assert load_or_make("a", "1", made(calls)) == b"content"
    assert calls == ["made", "made"]


def test_an_old_entry_is_removed_and_made_again(folder):
    calls: list[str] = []
    load_or_make("a", "1", made(calls))
    load_or_make("b", "1", made(calls))
    for file in folder.iterdir():
        os.utime(file, (0.0, time.time() - UNUSED_S - 10.0))
    load_or_make("a", "1", made(calls))
    assert len(calls) == 3
    assert len(list(folder.iterdir())) == 1


def test_without_a_folder_everything_is_made(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    calls: list[str] = []
    for place in (tmp_path / "file", Path("/proc/none")):
        for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
            monkeypatch.setenv(name, str(place))
        assert load_or_make("a", "1", made(calls)) == load_or_make("a", "1", made(calls)) == b"content"
    assert len(calls) == 4


def test_several_at_once_find_it_whole(folder):
    content, found = os.urandom(1 << 20), list[bool]()

    def run() -> None:
        found.extend(load_or_make("a", "1", lambda: content) == content for _ in range(20))

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [True] * 80
    assert len(list(folder.iterdir())) == 1


def test_cached_templates_give_the_same_text(folder):
    def environment(**more: object) -> jinja2.Environment:
        made = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, **more)
        made.filters["code_html"] = code_html
        return made

    rows = {"headlines": [{"label": "<a>", "value": 1, "remark": "&"}]}

    def text(own: jinja2.Environment) -> str:
        return own.from_string('{% from "macros.html" import headline_row %}{{ headline_row(headlines) }}').render(rows)

    plain = text(environment())
    assert "&lt;a&gt;" in plain
    assert text(environment(bytecode_cache=CompiledTemplates())) == plain  # compiled, then kept
    assert text(environment(bytecode_cache=CompiledTemplates())) == plain
    assert len(list(folder.iterdir())) == 1
    assert text(environment(bytecode_cache=CompiledTemplates(), trim_blocks=True)) == text(
        environment(trim_blocks=True)
    )
    assert len(list(folder.iterdir())) == 2
