"""Region and masks written into recording.toml; every other line, comments included, remains as it is."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from fusion.errors import InputError
from fusion.planning.planning_notices import OUTLINE_NOT_WRITTEN, RECORDING_CHANGED
from fusion.planning.view.readable import version_of
from fusion.recording.values import Outline, outline, outlines
from fusion.report.atomic_files import write_atomically

BOM = "\ufeff"
HEADER = re.compile(r"\s*\[\[?\s*([A-Za-z0-9_\-.\"' ]+?)\s*\]\]?\s*(#.*)?\r?$")
LONGEST_VALUE = 2000  # lines of an existing region or mask


def write_outlines(
    recording: Path, version: str, place: tuple[int, int], region: Outline | None, mask: Sequence[Outline]
) -> None:
    """Write region and masks of an `[[images]]` block.

    `version`: hash of the file as it was read. `place`: of the block among those of its set-up, and the number of that.
    """
    region = None if region is None else outline(region)
    stated = {"region": region, "mask": outlines(mask) or None}
    if version_of(recording) != version:
        raise InputError(RECORDING_CHANGED, recording)
    content = recording.read_bytes()
    try:
        text = content.decode("utf-8")
        changed = edited(text.removeprefix(BOM), place, stated)
    except ValueError as error:
        raise InputError(OUTLINE_NOT_WRITTEN, recording, reason=str(error)) from error
    if version_of(recording) != version:
        raise InputError(RECORDING_CHANGED, recording)
    write_atomically(recording.resolve(), (BOM * text.startswith(BOM) + changed).encode())


def edited(text: str, place: tuple[int, int], stated: dict[str, Any]) -> str:
    """Return the text with other values of some keys of an `[[images]]` block.

    None removes a key. Raises `ValueError` unless exactly these keys change.

    >>> text = '[[images]] # top\\nstereo = "top"\\nmask = [[1, 2, 3, 4]] # screw\\n'
    >>> print(edited(text, (0, 0), {"region": (0, 0, 9, 9), "mask": (((1, 1), (5, 1), (3, 4)),)}), end="")
    [[images]] # top
    stereo = "top"
    mask = [[[1, 1], [5, 1], [3, 4]]] # screw
    region = [0, 0, 9, 9]
    """
    before = tomllib.loads(text)
    expected = deepcopy(before)
    block = _block(expected, place)
    for key, value in stated.items():
        block.pop(key, None)
        block |= {} if value is None else {key: _as_list(value)}
    lines = text.split("\n")
    first, last = _lines_of_block(lines, before, place)
    for key, value in stated.items():
        if value is None or _block(before, place).get(key) != _as_list(value):
            last += _set(lines, (first, last), key, value)
    changed = "\n".join(lines)
    if tomllib.loads(changed) != expected:
        raise ValueError("its tables are not written as lines under a header")
    return changed


def _block(values: dict[str, Any], place: tuple[int, int]) -> dict[str, Any]:
    """Return the table of an `[[images]]` block."""
    take, number = place
    try:
        found = (values["take"][take - 1] if take else values)["images"][number]
    except (LookupError, TypeError) as error:
        raise ValueError("there is no such block") from error
    return dict(found) if not isinstance(found, dict) else found


def _lines_of_block(lines: list[str], values: dict[str, Any], place: tuple[int, int]) -> tuple[int, int]:
    """Return the first line of a block, and the line after its last key."""
    take, number = place
    name = "take.images" if take else "images"
    earlier = sum(len(one.get("images", ())) for one in values["take"][: take - 1]) if take else 0
    headers = [(n, found[1].replace(" ", "")) for n, line in enumerate(lines) if (found := HEADER.match(line))]
    blocks = [n for n, header in headers if header == name and lines[n].lstrip().startswith("[[")]
    if len(blocks) <= earlier + number:
        raise ValueError("its header is not a line [[images]]")
    first = blocks[earlier + number] + 1
    last = min((n for n, _ in headers if n >= first), default=len(lines))
    while last > first and (not lines[last - 1].strip() or lines[last - 1].lstrip().startswith("#")):
        last -= 1
    return first, last


def _set(lines: list[str], block: tuple[int, int], key: str, value: Any) -> int:
    """Change a key of a block, and return by how many lines it grows."""
    end = "\r" if lines[block[0] - 1].endswith("\r") else ""
    statement = [] if value is None else [f"{key} = {_as_list(value)}"]
    for n in range(*block):
        if re.match(rf"\s*{key}\s*=", lines[n]):
            count = next((c for c in range(1, LONGEST_VALUE) if _parses(lines[n : n + c])), 1)
            comments = list(_comments(lines[n : n + count]))
            if len(comments) == 1 and statement:
                statement = [f"{statement[0]} {comments.pop()}"]
            lines[n : n + count] = [f"{line}{end}" for line in (*comments, *statement)]
            return len(comments) + len(statement) - count
    lines[block[1] : block[1]] = [f"{line}{end}" for line in statement]
    return len(statement)


def _comments(lines: list[str]) -> Iterator[str]:
    """Yield the comments of a statement of numbers, which has no other number signs."""
    yield from (f"#{comment.rstrip()}" for _, sign, comment in (line.partition("#") for line in lines) if sign)


def _parses(lines: list[str]) -> bool:
    try:
        tomllib.loads("\n".join([*lines, ""]))
    except ValueError:
        return False
    return True


def _as_list(value: Any) -> Any:
    return [_as_list(one) for one in value] if isinstance(value, list | tuple) else value
