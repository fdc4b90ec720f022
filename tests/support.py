"""Helpers of command tests: changed files, tables, refusals in one sentence."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import pytest
from pydantic import BaseModel

from fusion.base import Settings
from fusion.cli import main
from fusion.estimation.uncertainty import Uncertainty
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording

DOCS = Path(__file__).resolve().parent.parent / "docs"


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text that must be there."""
    text = path.read_text(encoding="utf-8")
    assert old in text, f"{old!r} is not in {path}"
    path.write_text(text.replace(old, new), encoding="utf-8")


def evaluated(recording: Path) -> Evaluation:
    """Evaluate a recording as a run does, without files."""
    return evaluate_recording(load_manifest(recording), Settings(), {})


AT_ORIGIN = {"point": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0]}


def block(title: str = "", /, **keys: Any) -> str:
    """A block `title` of a manifest with its keys; `[title]` is one of a list, such as `[daq]`."""
    return (f"[{title}]\n" if title else "") + "".join(f"{key} = {json.dumps(keys[key])}\n" for key in keys)


def channel(name: str, quantity: str, at: str = "", **keys: Any) -> str:
    """A channel of the DAQ block above; `at`: the block that this one is in, such as `take.`."""
    return block(f"[{at}daq.channel]", name=name, quantity=quantity, **keys)


def recording_head(name: str, frequency_hz: float = 106.25, **keys: Any) -> str:
    """The beginning of the manifest of a sine along z, to its DAQ block of the file daq.h5."""
    sine = {"kind": "sine", "direction": [0.0, 0.0, 1.0], "frequencies": [frequency_hz]}
    head = block(format=1, name=name, rig="../rig.toml") + block("excitation", **sine | keys)
    return head + block("[daq]", name="daq", file="daq.h5")


def write_daq(path: Path, rate_hz: float, signals: Mapping[str, np.ndarray]) -> None:
    """Write channels of one rate into an HDF5 file."""
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = rate_hz
        for name, samples in signals.items():
            file[name] = samples


def rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def truth_of(folder: Path) -> dict[str, Any]:
    """The simulator's truth of a recording or campaign."""
    return dict(json.loads((folder / "truth.json").read_text(encoding="utf-8")))


def complex_of(entry: dict[str, Any]) -> np.ndarray:
    """Complex numbers of a truth."""
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def examples(text: str, language: str = "toml") -> list[str]:
    """The blocks of a document that are marked with a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def draft_example(name: str) -> str:
    """Text of rig.toml or recording.toml as `shakercal init --example` writes it."""
    return (resources.files("fusion.planning.draft") / "example" / name).read_text(encoding="utf-8")


def example_with(document: str, words: str) -> str:
    """The first TOML example of a document that contains some words."""
    text = (DOCS / document).read_text(encoding="utf-8")
    return next(block for block in examples(text) if words in block)


def key_tables(section: str, level: str = "###") -> dict[str, dict[str, str]]:
    """Title -> key -> second column of every table on keys below the headings of a section."""
    titles, tables = (re.split(rf"^{level} (.*)$", section, flags=re.MULTILINE)[start::2] for start in (1, 2))
    row = re.compile(r"^\| `(\w+)` \| (.*?) \|", re.MULTILINE)
    return {title: dict(row.findall(table)) for title, table in zip(titles, tables, strict=True)}


def documented_columns(document: str, file: str) -> list[str]:
    """The columns of a table of results in a document."""
    text = (DOCS / document).read_text(encoding="utf-8")
    (columns,) = re.findall(rf"^\| `{re.escape(file)}` \| `([^`]*)`", text, re.MULTILINE)
    return str(columns).split(", ")


def documented_keys(models: dict[str, type[BaseModel]]) -> dict[str, dict[str, str]]:
    """Required second columns of key tables: required, inherited, optional, or the default."""
    return {title: {key: _requirement(model, key) for key in model.model_fields} for title, model in models.items()}


def _requirement(model: type[BaseModel], key: str) -> str:
    field = model.model_fields[key]
    if key in getattr(model, "INHERITED", ()):
        return "as the pair"
    if field.is_required():
        return "required"
    default: Any = field.get_default(call_default_factory=True)
    if default is None:
        return "optional"
    if isinstance(default, str | bool | int | float):
        return f"`{json.dumps(default)}`" if isinstance(default, str | bool) else f"{default:g}"
    if np.any(default):
        return f"`{json.dumps(default)}`"
    zeros = "0" if "uncertainty" in key and key not in ("pose_uncertainty", "datum_uncertainty") else "zeros"
    return zeros if len(default) else "none"


def folder_contents(folder: Path) -> dict[str, bytes]:
    """Content of every file of a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


class RefusedCommand(Protocol):
    """Run a command that refuses its input, and return its sentence on stderr."""

    def __call__(self, *arguments: object, status: int = 2) -> str: ...


def refusals(capsys: pytest.CaptureFixture[str]) -> RefusedCommand:
    """Return a function that runs a command and checks the form of its refusal."""

    def run(*arguments: object, status: int = 2) -> str:
        capsys.readouterr()
        assert main([str(argument) for argument in arguments]) == status
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("shakercal: ")
        assert printed.err.count("\n") == 1, printed.err
        return printed.err.strip()

    return run


PAGES = (
    "fusion.report.recording_report.render_report",
    "fusion.campaign.joint_report.render_campaign",
    "fusion.report.folder.CommandReport.page",
)


def without_pages(patch: pytest.MonkeyPatch) -> None:
    """Replace every page by an empty one: its figures take most of the time."""
    for name in PAGES:
        patch.setattr(name, lambda *_: "<!doctype html>\n")


def region_distance(value: np.ndarray, truth: np.ndarray, uncertainty: Uncertainty) -> list[float]:
    """Distance of C values of the first line from the truth, over the edge of their 95 % regions."""
    error, regions = np.ravel(value - truth), uncertainty.at_lines([0]).regions(np.reshape(value, (1, -1)))[0]
    parts = np.stack([error.real, error.imag], axis=-1)[..., None]
    return np.sqrt(parts.swapaxes(1, 2) @ np.linalg.solve(regions, parts)).ravel().tolist()


def undescribed_datasets(file: h5py.File) -> list[str]:
    """Return paths of data sets without description, unit or axis name."""
    found: list[str] = []

    def visit(path: str, data: object) -> None:
        if isinstance(data, h5py.Dataset):
            bare = b"not a netCDF variable" in data.attrs.get("NAME", b"")
            number = data.dtype.kind in "biufc" and not bare
            named = data.is_scale or all(len(dim) == 1 for dim in data.dims)
            if not ((bare or data.attrs.get("long_name")) and (data.attrs.get("units") or not number) and named):
                found.append(path)

    file.visititems(visit)
    return found
