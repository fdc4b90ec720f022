"""Recordings to view: a folder of recordings, or the recordings of results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fusion.errors import InputError
from fusion.planning.planning_notices import RECORDING_MOVED, RESULTS_WITHOUT_RECORDING
from fusion.recording.load import find_recordings
from fusion.recording.toml import read_toml
from fusion.report.folder import RECORDED_AT, RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.labelled_results import CAMPAIGN_FILE

DEFAULT_RESULTS = "results"


@dataclass(frozen=True)
class ViewSource:
    """A recording to view: its recording.toml and the folder of its results, or None."""

    recording: Path
    results: Path | None


def find_sources(path: Path, recording: Path | None = None) -> list[ViewSource]:
    """Return the recordings of a folder of recordings or results.

    `recording`: where the recordings of the results are.
    """
    if not any((path / name).is_file() for name in (RESULT_FILE, CAMPAIGN_FILE)):
        found = find_recordings(path)
        top = found[0].parent if len(found) == 1 and found[0].parent.name == path.resolve().name else path
        return [ViewSource(one, _results_of(one, top / DEFAULT_RESULTS)) for one in found]
    if recording is not None:
        found = find_recordings(recording)
        if (path / RESULT_FILE).is_file():
            found = [one for one in found if one.parent.name == path.resolve().name] or found[:1]
        with_results = [ViewSource(one, _results_of(one, path)) for one in found]
        if any(one.results for one in with_results):
            return with_results
        expected = f"a recording of the results in {path}"
        raise InputError(RESULTS_WITHOUT_RECORDING, recording, found="other recordings", expected=expected)
    folders = [path] if (path / RESULT_FILE).is_file() else sorted(one.parent for one in path.glob(f"*/{RESULT_FILE}"))
    recorded = [_recorded(folder) for folder in folders]
    if not any(there for _, there in recorded):
        for folder in folders[:1]:
            with open_results(folder / RESULT_FILE):
                pass  # damaged results have a sentence of their own
        raise InputError(RECORDING_MOVED, path, recording=str(recorded[0][0]) if recorded else "an unknown place")
    return [ViewSource(one, folder) for folder, (one, _) in zip(folders, recorded, strict=True)]


def _results_of(recording: Path, results: Path) -> Path | None:
    """Return the folder of a recording's results: the given one or one below."""
    below = results / recording.resolve().parent.name
    return next((folder for folder in (below, results) if (folder / RESULT_FILE).is_file()), None)


def _recorded(results: Path) -> tuple[Path, bool]:
    """Return the recording of results, stated or nearby, and whether it exists."""
    folder = results.resolve()
    name, stated = result_names(folder)
    places = [folder / stated[0], *map(Path, stated[1:])] if stated else []
    near = [folder.parent, folder.parent.parent / folder.name, folder.parent.parent]
    for place in (*places, *(one / "recording.toml" for one in (*near, *(one / folder.name for one in near)))):
        if place.is_file() and _name_of(place) in (name, ""):
            return place.resolve(), True
    return (places[-1] if places else folder / "recording.toml"), False


def result_names(results: Path) -> tuple[str, tuple[str, ...]]:
    """Return the name of a result's recording, and its places: from the results, and absolute."""
    try:
        with open_results(results / RESULT_FILE) as file:
            stated = tuple(str(file.attrs[name]) for name in RECORDED_AT if name in file.attrs)
            return str(file.attrs.get("recording", "")), stated
    except InputError:
        return "", ()


def _name_of(recording: Path) -> str:
    """Return the name in a recording.toml, empty if it cannot be read."""
    try:
        return str(read_toml(recording).get("name", ""))
    except InputError:
        return ""


def overview(source: ViewSource) -> Mapping[str, str]:
    """Return a row of the campaign's table, from the text of the recording's manifest alone."""
    name = source.recording.parent.name
    try:
        text = read_toml(source.recording)
    except InputError as error:
        return {"name": name, "excitation": str(error), "images": "", "channels": "", "results": ""}
    excitation = text.get("excitation")
    stated = excitation if isinstance(excitation, dict) else {}
    listed = stated.get("frequencies")
    hz = (
        ", ".join(f"{value:g}" for value in listed if isinstance(value, int | float))
        if isinstance(listed, list)
        else ""
    )
    blocks = text.get("daq") if isinstance(text.get("daq"), list) else []
    channels = [block.get("channel") for block in blocks or () if isinstance(block, dict)]
    pairs = text.get("images")
    return {
        "name": name,
        "excitation": f"{stated.get('kind', '')} {hz}{' Hz' * bool(hz)}".strip(),
        "images": str(len(pairs) if isinstance(pairs, list) else 0),
        "channels": str(sum(len(one) for one in channels if isinstance(one, list))),
        "results": "" if source.results is None else source.results.name,
    }
