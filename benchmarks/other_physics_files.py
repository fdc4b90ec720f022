"""Campaigns as files, and the results of a command as numbers: the frame around `other_physics.py`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from fusion.cli import main as command_line

FloatArray = NDArray[np.float64]
Numbers = dict[str, float]
Readings = dict[str, tuple[float, float]]
"""Value and expanded uncertainty (95 %) of every quantity that a result file states."""
CODE = re.compile(r"SC-\d{3}")
INTERNAL_ERROR = "SC-953"


@dataclass(frozen=True)
class Case:
    """One kind of recording: what writes it with its truth, what evaluates it, and what reads the results.

    `build` fills an empty folder and returns the truth of every quantity, by the names that `read` gives them. A name
    with a bracket, `residue[3]`, counts with all others before the bracket. `first` is a command whose results are the
    input of `command`.
    """

    name: str
    about: str
    command: tuple[str, ...]
    build: Callable[[Path, np.random.Generator], Numbers]
    read: Callable[[Path], Readings]
    first: tuple[str, ...] = ()
    within: bool = False


@dataclass(frozen=True)
class Outcome:
    """What one draw gave: exit status, codes of notices, error sentence, truths and readings."""

    status: int
    codes: tuple[str, ...]
    error: str
    truth: Numbers
    readings: Readings


def evaluate(case: Case, folder: Path, rng: np.random.Generator) -> Outcome:
    """Write a campaign, run its command in this process, and read the results."""
    truth = case.build(folder, rng)
    source, status, text = folder, 0, ""
    if case.first:
        source = folder / "first"
        status, text = run_command([case.first[0], str(folder), *case.first[1:], "-o", str(source)])
    if status == 0:
        more = [str(source), *case.command[1:], "-o", str(folder / "results")]
        status, later = run_command([case.command[0], *more])
        text += later
    codes = tuple(sorted(set(CODE.findall(text)) | stored_codes(folder)))
    readings = case.read(folder / "results") if (folder / "results").is_dir() else {}
    error = "" if status == 0 else " ".join(text.split())[:400]
    return Outcome(status, codes, error, truth, readings)


def run_command(arguments: list[str]) -> tuple[int, str]:
    """Return the exit status of the command line and what it wrote to stderr; -1 for an exception that escaped."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(out), redirect_stderr(err):
            status = command_line(arguments)
    except SystemExit as end:
        status = int(end.code or 0)
    except Exception as error:  # what the command line should have turned into a sentence
        return -1, f"{INTERNAL_ERROR} {type(error).__name__}: {error}"
    return status, err.getvalue()


def stored_codes(folder: Path) -> set[str]:
    """Return the codes of all notices that result files hold; the terminal does not list notes."""
    found: set[str] = set()

    def visit(name: str, node: object) -> None:
        if name.endswith("notices/code") and isinstance(node, h5py.Dataset):
            found.update(CODE.findall(str([one.decode() for one in node[()].ravel()])))

    for path in folder.rglob("*.h5"):
        with h5py.File(path) as file:
            file.visititems(visit)
    return found


# Manifests: TOML written by a few lines, since values are texts, numbers, lists and blocks alone.


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(_value(one) for one in value) + "]"
    return repr(float(value)) if isinstance(value, float | np.floating) else str(int(value))


def toml_text(table: Mapping[str, Any], prefix: str = "") -> str:
    """Return a table as TOML: dicts are tables, lists of dicts are blocks."""
    plain, below = [], []
    for key, value in table.items():
        name = f"{prefix}.{key}" if prefix else key
        if isinstance(value, Mapping):
            below.append(f"\n[{name}]\n{toml_text(value, name)}")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            below += [f"\n[[{name}]]\n{toml_text(one, name)}" for one in value]
        else:
            plain.append(f"{key} = {_value(value)}\n")
    return "".join(plain + below)


def write_toml(path: Path, table: Mapping[str, Any]) -> None:
    """Write a manifest of format 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(toml_text({"format": 1, **table}), encoding="utf-8")


def write_channels(path: Path, rate_hz: float, channels: Mapping[str, FloatArray]) -> None:
    """Write channels of one rate as a DAQ file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, samples in channels.items():
            file.create_dataset(name, data=samples).attrs["sample_rate"] = rate_hz


# Results.


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table; none where it was not written."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def number(text: str | None) -> float:
    """Return a cell as a number, NaN where it is empty or a word."""
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")
