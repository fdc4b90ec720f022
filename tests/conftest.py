"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LONGEST = ("fusion/test_workers", "fusion/test_faults", "fusion/test_evaluate", "fusion/test_page", "test_wheel")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Of several processes that need all tests, each rewrites the assertions of its share first; others read them."""
    if session.config.args == session.config.getini("testpaths") and hasattr(session.config, "workerinput"):
        number, count = int(session.config.workerinput["workerid"][2:]), session.config.workerinput["workercount"]
        for path in sorted((ROOT / "tests").rglob("test_*.py"))[number::count]:
            with suppress(Exception):  # which collecting it raises again
                import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with tests that take long: at the end one of several processes would wait for the last of them."""
    items.sort(key=lambda item: not item.nodeid.removeprefix("tests/").startswith(LONGEST))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real data recorded by others; the test is skipped where it is absent."""
    folder = Path(os.environ.get("SHAKERCAL_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} does not exist (set SHAKERCAL_DATA)")
    return folder


@pytest.fixture(scope="session")
def demo_recording() -> Path:
    """The demo campaign folder in `sample_images`."""
    return ROOT / "sample_images" / "demo"
