"""Questions of drafted manifests, answered on a terminal or from a file."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion.errors import InputError
from fusion.planning.planning_notices import UNUSED_ANSWER
from fusion.recording.toml import UNFILLED, read_toml

_LINE = re.compile(r"(?P<off># )?(?P<key>[A-Za-z_]+) = (?P<value>.*?)(?:  # (?P<why>.*))?")
_HEADER = re.compile(r"(?P<off># )?(?P<brackets>\[{1,2})(?P<name>[^\[\]]+)\]{1,2}(?:  # .*)?")
_STATEMENT = re.compile(
    r"(?P<value>[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)\s*(?:±|\+/?-)\s*(?P<U>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)\s*(?P<percent>%)?"
    r"\s*(?:\(?\s*k\s*=\s*(?P<k>\d+(?:[.,]\d+)?)\s*\)?)?"
)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
IMPORTANCE = (
    "kind", "direction", "frequencies", "quantity", "channels", "channel", "unit", "trigger", "first_edge", "sense",
    "mass", "scale", "body", "point", "calibration", "rotation", "translation", "exposure", "internal_mass",
    "centre_of_mass", "inertia", "normal", "stereo",
)  # fmt: skip
"""Keys in the order in which they are asked for; uncertainties follow."""
HELP = "An empty line leaves a value open. `2.4 ± 0.001` states the standard uncertainty (k = 1) as well."
MATRICES = ("rotation", "inertia")  # keys of 3 x 3 numbers


@dataclass(frozen=True)
class Question:
    """A value that a drafted manifest leaves open.

    `key`: its path, with blocks by name; `line`: its line in the file; `why`: the expected value.
    """

    file: Path
    key: str
    line: int
    why: str

    @property
    def name(self) -> str:
        """The key without its path."""
        return self.key.rpartition(".")[2]

    @property
    def order(self) -> tuple[int, str]:
        """Position among all questions: by importance."""
        return (IMPORTANCE.index(self.name) if self.name in IMPORTANCE else len(IMPORTANCE)), str(self.file)


def questions_of(files: Mapping[Path, str]) -> list[Question]:
    """Return the open values of drafted manifests, the most important first."""
    found = [
        Question(path, key, number, why)
        for path, text in files.items()
        for number, key, value, why in _values(text)
        if value == json.dumps(UNFILLED)
    ]
    return sorted(found, key=lambda question: question.order)


def _values(text: str) -> Iterator[tuple[int, str, str, str]]:
    """Yield line, key path, value and remark of every key.

    The value of an optional key is empty.
    """
    lines = text.splitlines()
    path: list[str] = []
    named: dict[tuple[str, ...], str] = {}
    for number, line in enumerate(lines):
        header = _HEADER.fullmatch(line.strip())
        if header is not None:
            path = list(_steps(header["name"]))
            if header["brackets"] == "[[" and not header["off"]:
                label = _label(lines[number + 1 :])
                named[tuple(path)] = label
                for inner in [key for key in named if key[: len(path)] == tuple(path) and len(key) > len(path)]:
                    del named[inner]
            path = _with_labels(path, named)
            continue
        entry = _LINE.fullmatch(line)
        if entry is not None:
            key = ".".join([*path, entry["key"]])
            yield number, key, "" if entry["off"] else entry["value"], entry["why"] or ""


def _steps(name: str) -> Iterator[str]:
    """Yield the steps of a table's header."""
    table: Any = tomllib.loads(f"[{name}]")
    while isinstance(table, dict) and table:
        step = next(iter(table))
        yield step
        table = table[step]


def _label(lines: Sequence[str]) -> str:
    """Return the name of a block of an array from its first lines."""
    for line in lines:
        entry = _LINE.fullmatch(line)
        if entry is None or entry["off"]:
            return ""
        if entry["key"] in ("name", "stereo"):
            return str(tomllib.loads(f"x = {entry['value']}")["x"])
    return ""


def _with_labels(path: Sequence[str], named: Mapping[tuple[str, ...], str]) -> list[str]:
    """Return a path with the name of each block after the key of its array."""
    made = []
    for count in range(1, len(path) + 1):
        made.append(path[count - 1])
        label = named.get(tuple(path[:count]), "")
        made += [label] if label else []
    return made


Redraft = Callable[[Mapping[Path, Mapping[str, str]]], dict[Path, str]]
"""Drafts the manifests again with stated quantities, by the recording's folder and the path of the key."""


def with_answers(files: Mapping[Path, str], answers: Path, redraft: Redraft) -> dict[Path, str]:
    """Return drafted manifests with the values of a file.

    They may also replace guesses and optional keys. A key of the file is the end of a key's path, such as `load.mass`,
    `laser.point`, or `sense`; the longest one counts. A table with the name of a recording's folder holds for that
    recording only.
    """
    stated = dict(_flat(read_toml(answers)))
    used: set[str] = set()
    made = {}
    quantities: dict[Path, dict[str, str]] = {}
    for path, text in files.items():
        for _, key, value, _ in _values(text):
            name = _longest(key, path.parent.name, stated) if key.endswith(".quantity") and value else None
            if name is not None:
                quantities.setdefault(path.parent, {})[key] = str(stated[name])
    for path, text in (redraft(quantities) if quantities else files).items():
        lines = text.splitlines()
        for number, key, _, _ in _values(text):
            name = _longest(key, path.parent.name, stated)
            if name is not None and not lines[number].endswith(f"in the statement of {_certain(key)}"):
                used.add(name)
                _replace(lines, number, stated[name])
        made[path] = "\n".join(lines) + "\n"
    for name in stated:
        if name not in used:
            expected = "the end of a key's path in a drafted file, such as load.mass"
            raise InputError(UNUSED_ANSWER, answers, name, found="no such key", expected=expected)
    texts = {path: text.splitlines() for path, text in made.items()}
    names = next((value for name, value in stated.items() if name.rpartition(".")[2] == "channels"), None)
    _name_outputs(questions_of(made), texts, names)
    return {path: "\n".join(lines) + "\n" for path, lines in texts.items()}


def _flat(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables by their paths."""
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, dict) and not {"U", "U_relative", "dcc"} & set(value):
            yield from _flat(value, name)
        else:
            yield name, value


def _longest(key: str, folder: str, stated: Mapping[str, Any]) -> str | None:
    """Return the answer with the longest path that ends a key's path.

    One of the recording counts first.
    """
    parts = key.split(".")
    ends = [".".join(parts[start:]) for start in range(len(parts))]
    return next((name for start in (f"{folder}.", "") for end in ends if (name := start + end) in stated), None)


def _replace(lines: list[str], number: int, value: Any) -> None:
    """Replace the value in a line, which may be that of an optional key."""
    entry = _LINE.fullmatch(lines[number])
    assert entry is not None
    lines[number] = f"{entry['key']} = {_inline(value)}"
    above = next((i for i in range(number, -1, -1) if _HEADER.fullmatch(lines[i].strip())), None)
    if entry["off"] and above is not None:
        lines[above] = lines[above].removeprefix("# ")
    if isinstance(value, dict):  # which states the uncertainty as well
        end = next((i for i in range(number + 1, len(lines)) if _HEADER.fullmatch(lines[i].strip())), len(lines))
        for i in range(number + 1, end):
            if lines[i].startswith(f"{entry['key']}_uncertainty = "):
                lines[i] = f"# {entry['key']}_uncertainty: in the statement of {entry['key']}"


def _inline(value: Any) -> str:
    """Return a value as TOML in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_inline(item)}" for key, item in value.items()) + " }"
    return value.isoformat() if hasattr(value, "isoformat") else json.dumps(value, ensure_ascii=False)


def parse_answer(text: str, key: str) -> Any:
    """Return a typed value: a number, numbers in brackets or apart, or a text.

    `2.4 ± 0.001` states a number with its standard uncertainty, `2.4 ± 0.1 % (k = 2)` with an expanded one.
    """
    text = text.strip()
    stated = _STATEMENT.fullmatch(text)
    if stated is not None:
        value, expanded = (float(number.replace(",", ".")) for number in stated.group("value", "U"))
        relative = {"U_relative": float(f"{expanded / 100:.12g}")} if stated["percent"] else {"U": expanded}
        return {"value": value, **relative, "k": float((stated["k"] or "1").replace(",", "."))}
    typed: Any
    try:
        typed = tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        words = re.split(r"[\s;]+", text.strip("[]() "))
        words = [word.strip(",") for word in words]
        if key == "channels":
            return words
        words = [word.replace(",", ".") if word.count(",") == 1 and "." not in word else word for word in words]
        if not all(_NUMBER.fullmatch(word) for word in words):
            return text
        numbers = [float(word) for word in words]
        typed = numbers if len(numbers) > 1 else numbers[0]
    if key in MATRICES and isinstance(typed, list) and typed and not isinstance(typed[0], list):
        if len(typed) == 9:
            return [typed[0:3], typed[3:6], typed[6:9]]
        if len(typed) == 3 and key == "inertia":
            return [[typed[0], 0.0, 0.0], [0.0, typed[1], 0.0], [0.0, 0.0, typed[2]]]
    return typed


def ask(
    files: Mapping[Path, str], found: Sequence[str], reply: Callable[[str], str], redraft: Redraft
) -> dict[Path, str]:
    """Return drafted manifests with the values typed in reply to questions.

    Equal questions of several recordings are asked once, quantities first, since others follow from them. An empty
    reply leaves a value open; the end of the input leaves all others open. `found`: the contents of the recordings,
    shown before the first question.
    """
    given: dict[str, Any] = {}
    head = "\n".join([*found, HELP, ""])
    quantities: dict[Path, dict[str, str]] = {}
    try:
        for only_quantities in (True, False):
            lines = {path: text.splitlines() for path, text in files.items()}
            questions = [q for q in questions_of(files) if (q.name == "quantity") == only_quantities]
            for number, question in enumerate(questions):
                name = _general(question.key)
                if UNFILLED not in lines[question.file][question.line]:
                    continue  # answered together with another one
                if name not in given:
                    left = len(
                        {_general(q.key) for q in questions[number:] if UNFILLED in lines[q.file][q.line]} - set(given)
                    )
                    text = reply(f"{head}{left} left. {question.key}: {question.why}")
                    head, given[name] = "", parse_answer(text, question.name) if text.strip() else None
                if given[name] is not None:
                    _replace(lines[question.file], question.line, given[name])
                    if question.name == "channels":
                        _name_outputs(questions, lines, given[name])
                    if only_quantities:
                        quantities.setdefault(question.file.parent, {})[question.key] = str(given[name])
            made = {path: "\n".join(text) + "\n" for path, text in lines.items()}
            files = redraft(quantities) if only_quantities and quantities else made
    except EOFError:
        files = {path: "\n".join(text) + "\n" for path, text in lines.items()}
    return dict(files)


def _name_outputs(questions: Sequence[Question], lines: Mapping[Path, list[str]], names: Any) -> None:
    """Fill in the open outputs of each recording with stated names, in their order."""
    for path in lines:
        outputs = [question for question in questions if question.file == path and question.name == "channel"]
        if isinstance(names, list) and len(outputs) == len(names):
            for output, name in zip(outputs, names, strict=True):
                _replace(lines[path], output.line, name)


def _certain(key: str) -> str:
    """Return the name of the value that an uncertainty belongs to."""
    return key.rpartition(".")[2].removesuffix("_uncertainty")


def _general(key: str) -> str:
    """Return the path of a key without the name of its recorder's block."""
    return re.sub(r"^daq\.[^.]+\.(?=channel\.|defaults\.)", "daq.", key)
