"""Damaged files of every kind give data or one sentence; `benchmarks/fuzz_files.py` tries thousands of them."""

from __future__ import annotations

from pathlib import Path

import fuzz_files
import fuzz_seeds
import pytest


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow) if kind in ("dewesoft", "mdf", "results") else kind
        for kind in fuzz_seeds.SEEDS
    ],
)
def test_sound_files_are_read(tmp_path: Path, data_dir: Path, kind: str):
    """What the changes start from is data for its reader, otherwise nothing behind its first check would be tried."""
    seed = fuzz_seeds.SEEDS[kind]
    if not seed.write(tmp_path, data_dir):
        pytest.skip(f"no {kind} file to start from")
    for path in seed.paths(tmp_path):
        assert fuzz_files.outcome(seed.reads, path) == (True, ""), path


@pytest.mark.slow
@pytest.mark.parametrize("kind", fuzz_seeds.SEEDS)
def test_damaged_files_give_data_or_one_sentence(data_dir: Path, kind: str):
    """Read by a process of its own: no crash, no hang, no other error, no more memory than 2 GB."""
    found = fuzz_files.fuzzed(kind, 10 if kind == "dewesoft" else 60, 2026, data_dir)
    if found is None:
        pytest.skip(f"no {kind} file to start from")
    assert not found.wrong
    assert found.memory_mb < 2000.0
