"""`shakercal init`: drafted manifests of a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from fusion.base import natural_key
from fusion.errors import InputError
from fusion.planning.draft.channel_guess import HEAD, optional_line
from fusion.planning.draft.excitation_guess import driven_axis
from fusion.planning.draft.inventory import Inventory, is_recording_folder, recorder_folder, survey_folder
from fusion.planning.draft.manifest_drafts import RECORDING_KEYS, SurveyedRecording, recording_text, rig_text
from fusion.planning.draft.questions import ask, with_answers
from fusion.planning.planning_notices import (
    FILE_EXISTS,
    MANIFEST_EXISTS,
    NO_RECORDED_FILES,
    UNSUITABLE_FOLDER,
    UNSUITABLE_TEMPLATE,
)
from fusion.recording.load import RECORDING_NAME
from fusion.recording.toml import UNFILLED, read_toml, to_toml
from fusion.report.atomic_files import write_atomically

RIG_NAME = "rig.toml"
EXAMPLE_RECORDING = "Fz-0106.25"


@dataclass(frozen=True)
class Draft:
    """Drafted manifests of a folder.

    Attributes
    ----------
    files : Text by path.
    found : Contents of each recording, in words.

    Examples
    --------
    >>> from fusion import Draft, draft
    >>> from shutil import copytree, ignore_patterns
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = copytree("sample_images/demo", f"{folder}/demo", ignore=ignore_patterns("*.toml"))
    ...     drafted = draft(f"{folder}/demo")
    >>> isinstance(drafted, Draft), [path.name for path in drafted.files], drafted.unfilled
    (True, ['rig.toml', 'recording.toml'], 28)
    """

    files: dict[Path, str]
    found: tuple[str, ...]

    @property
    def unfilled(self) -> int:
        """Number of values to fill in."""
        return sum(text.count(f'= "{UNFILLED}"') for text in self.files.values())


def draft(folder: str | Path, like: str | Path | None = None) -> Draft:
    """Draft the manifests of a recording, or of all recordings below a folder without one.

    Parameters
    ----------
    folder
        A recording, or a folder of recordings. A rig.toml in it, or above a recording, is used unchanged.
    like
        A recording whose rig and channels are copied; default None.

    Returns
    -------
    The drafted files, which are not written.

    Raises
    ------
    InputError : No recorded files, or every recording has a manifest.

    Examples
    --------
    >>> from fusion import draft
    >>> draft("sample_images/demo/Fz-0080")
    Traceback (most recent call last):
        ...
    fusion.errors.InputError: SC-809 sample_images/demo/Fz-0080: expected a folder without recording.toml, found one
    """
    return _draft(Path(folder), _survey(Path(folder)), like)


def _survey(folder: Path) -> list[Inventory]:
    """Return the contents of the recordings of a folder that has any."""
    surveyed = [survey_folder(recording) for recording in _recordings(folder)]
    found = [inventory for inventory in surveyed if not inventory.empty]
    if not found:
        expected = "recorders' files or images in this folder or directly below"
        unreadable = "; ".join(text for inventory in surveyed for text in inventory.unreadable)
        raise InputError(NO_RECORDED_FILES, folder, found=unreadable or _deeper(folder) or "none", expected=expected)
    return found


def _deeper(folder: Path) -> str:
    """Return the folders farther below whose own folders are recordings, in words."""
    entries = sorted(path for path in folder.glob("*/*") if path.is_dir())
    campaigns = dict.fromkeys(
        path.parent.relative_to(folder).as_posix() for path in entries if is_recording_folder(path)
    )
    return f"some below {', '.join(campaigns)}: draft each of these folders" if campaigns else ""


def _draft(
    folder: Path,
    found: Sequence[Inventory],
    like: str | Path | None = None,
    quantities: Mapping[Path, Mapping[str, str]] | None = None,
) -> Draft:
    """Draft the manifests of recordings; `quantities`: stated ones, by folder and key."""
    stated = quantities or {}
    surveyed = [SurveyedRecording.of(inventory, stated.get(inventory.folder)) for inventory in found]
    files = {}
    if like is not None:
        for item in surveyed:
            files[item.inventory.folder / RECORDING_NAME] = _copied_recording(item, Path(like))
    else:
        single = found[0].folder == folder
        above = folder.absolute().parent / RIG_NAME
        rig = folder.parent / RIG_NAME if single and folder.name and above.is_file() else folder / RIG_NAME
        pairs = read_toml(rig).get("stereo", {}) if rig.exists() else {}
        if not rig.exists():
            files[rig] = rig_text(folder, found, surveyed[0].recorders)
        for item in surveyed:
            path = Path(os.path.relpath(rig, item.inventory.folder)).as_posix()
            files[item.inventory.folder / RECORDING_NAME] = recording_text(item, path, tuple(pairs))
    unreadable = [f"cannot be read: {item.folder.name}/{text}" for item in found for text in item.unreadable]
    return Draft(files, (*unreadable, *map(_summary, surveyed)))


def example(folder: Path) -> Draft:
    """Return a commented example: the rig and the recording of docs/recording-format.md."""
    texts = resources.files("fusion.planning.draft") / "example"
    paths = {RIG_NAME: folder / RIG_NAME, RECORDING_NAME: folder / EXAMPLE_RECORDING / RECORDING_NAME}
    files = {path: (texts / name).read_text(encoding="utf-8") for name, path in paths.items()}
    return Draft(files, ("an example with every block; the named files do not exist",))


def run_init(
    folder: Path,
    like: Path | None = None,
    *,
    with_example: bool = False,
    answers: Path | None = None,
    reply: Callable[[str], str] | None = None,
) -> Draft:
    """Write drafted manifests, each atomically; existing files are never replaced.

    `answers`: a file with values; `reply`: asks for the open ones, and returns the typed text.
    """
    if with_example:
        made = example(folder)
    else:
        found = _survey(folder)
        made = _draft(folder, found, like)

        def redraft(quantities: Mapping[Path, Mapping[str, str]]) -> dict[Path, str]:
            return _draft(folder, found, like, quantities).files

        if answers is not None:
            made = replace(made, files=with_answers(made.files, answers, redraft))
        if reply is not None and made.unfilled:
            made = replace(made, files=ask(made.files, made.found, reply, redraft), found=())
    for path in made.files:
        if path.exists():
            raise InputError(FILE_EXISTS, path, found="one", expected="no file of this name")
    for path, text in made.files.items():
        write_atomically(path, text)
    return made


def _recordings(folder: Path) -> list[Path]:
    """Return the recordings without a manifest that a folder is or contains."""
    if not folder.is_dir():
        found = "a file" if folder.is_file() else "no such path"
        raise InputError(UNSUITABLE_FOLDER, folder, found=found, expected="the folder of the recorders' files")
    try:
        if (folder / RECORDING_NAME).exists():
            raise InputError(MANIFEST_EXISTS, folder, found="one", expected=f"a folder without {RECORDING_NAME}")
        if is_recording_folder(folder) or recorder_folder(folder):
            return [folder]
        below = sorted(
            (entry for entry in folder.iterdir() if entry.is_dir()), key=lambda entry: natural_key(entry.name)
        )
        recordings = [entry for entry in below if is_recording_folder(entry)]
    except OSError as error:
        found = error.strerror or str(error)
        raise InputError(UNSUITABLE_FOLDER, folder, found=found, expected="a folder that can be read") from error
    without_manifest = [entry for entry in recordings if not (entry / RECORDING_NAME).exists()]
    if recordings and not without_manifest:
        found, expected = f"one in each of {len(recordings)}", f"a recording without {RECORDING_NAME}"
        raise InputError(MANIFEST_EXISTS, folder, found=found, expected=expected)
    return without_manifest


def _summary(surveyed: SurveyedRecording) -> str:
    """Return the contents of a recording in one line."""
    inventory = surveyed.inventory
    readable = [len(daq.channels) for daq in inventory.daqs if daq.channels]
    channels = f"{sum(readable)} channel{'s' if sum(readable) > 1 else ''}"
    files = f"{len(readable)} recorder file{'s' if len(readable) > 1 else ''}"
    texts = [f"{files} with {channels}"] if readable else []
    for sight in inventory.camera_systems:
        kind = "camera" if sight.right is None else "stereo pair"
        called = kind if sight.name in kind.split() else f"{kind} {sight.name}"
        texts.append(f"{called} of {sight.left.frames} frames")
    texts += [f"{camera.pattern} left out ({camera.problem})" for camera in inventory.cameras]
    texts += [f"points {table.path.name}" for table in inventory.points]
    texts += [f"response {path.name}" for path in inventory.responses]
    driven = surveyed.lines
    if driven.lines_hz:
        texts.append(f"driven at {', '.join(f'{line:g}' for line in driven.lines_hz[:5])} Hz {driven.where}")
    return f"{inventory.folder.name}: {'; '.join(texts)}"


# Draft from another recording: its rig and channels, with the lines and files of this one.


def _copied_recording(surveyed: SurveyedRecording, like: Path) -> str:
    """Return recording.toml from another recording, with the files and lines of this one."""
    path = like if like.is_file() else like / RECORDING_NAME
    text = read_toml(path)
    if "take" in text:
        raise InputError(UNSUITABLE_TEMPLATE, path, "take", found="takes", expected="a recording without takes")
    rig, excitation = text.get("rig"), text.get("excitation")
    if not isinstance(rig, str) or not isinstance(excitation, dict):
        expected = "a recording with its rig and an excitation"
        raise InputError(UNSUITABLE_TEMPLATE, path, found="neither", expected=expected)
    inventory, lines = surveyed.inventory, list(surveyed.lines.lines_hz)
    folder = inventory.folder

    def moved(name: Any) -> Any:
        """Return the relative path of the other recording's file, unless it exists."""
        if not isinstance(name, str) or (folder / name).exists():
            return name
        return Path(os.path.relpath(path.parent / name, folder)).as_posix()

    axis = driven_axis(folder.resolve().name)
    excitation = {**excitation, **({"frequencies": lines} if lines and "frequencies" in excitation else {})}
    excitation |= {"direction": axis} if axis is not None and "direction" in excitation else {}
    copied = {key: value for key, value in text.items() if key not in ("format", "name", "rig", "date", "excitation")}
    head = to_toml({"format": 1, "name": folder.resolve().name, "rig": moved(rig)})
    head += "".join(f"{optional_line(*entry)}\n" for entry in RECORDING_KEYS if entry[0] not in copied)
    made = {**copied, "excitation": excitation}
    made["daq"] = [_same_recorder(block, inventory, moved) for block in _blocks(text, "daq")]
    sights = {sight.name: [camera.pattern for camera in sight.cameras] for sight in inventory.camera_systems}
    made["images"] = []
    for block in _blocks(text, "images"):
        sides = [side for side in ("left", "right") if side in block]
        files = sights.get(block.get("stereo", ""), [])
        images = files if len(files) == len(sides) else [UNFILLED] * len(sides)
        made["images"].append(block | dict(zip(sides, images, strict=True)))
    tables = {table.name: table.path.name for table in inventory.points}
    made["points"] = [
        block
        if (folder / str(block.get("files"))).exists()
        else {**block, "files": tables.get(str(block.get("stereo")), UNFILLED)}
        for block in _blocks(text, "points")
    ]
    rest = to_toml({key: value for key, value in made.items() if value != []})
    return f"{HEAD}# Rig and channels are those of {path.parent.name}.\n\n{head}{rest}"


def _blocks(text: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the blocks of an array of tables."""
    blocks = text.get(key, [])
    return [block for block in blocks if isinstance(block, dict)] if isinstance(blocks, list) else []


def _same_recorder(block: dict[str, Any], inventory: Inventory, moved: Any) -> dict[str, Any]:
    """Return a recorder's block with this recording's file.

    It has the same name, otherwise it is the only one with all channels.
    """
    channels = [
        {**entry, **({"response": moved(entry["response"])} if "response" in entry else {})}
        for entry in _blocks(block, "channel")
    ]
    names = {str(entry.get("in_file", entry.get("name"))) for entry in channels}
    having = [
        inventory.path_of(daq)
        for daq in inventory.daqs
        if names <= {name for channel in daq.channels for name in (channel.name, channel.short)}
    ]
    same = [name for name in having if name == block.get("file")] or having
    file = same[0] if len(same) == 1 else UNFILLED
    named = {"name": Path(file).stem} if block.get("name") == Path(str(block.get("file"))).stem and same else {}
    return {**block, **named, "file": file, "channel": channels}
