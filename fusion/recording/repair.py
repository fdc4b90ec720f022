"""Errors of a table that other errors mask.

Each error is replaced by a valid value until the whole table is valid.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fusion.errors import InputError
from fusion.recording.toml import key_path, models_in, problem_error, problem_path, sorted_problems
from fusion.recording.values import Context, ManifestBlock

AnyBlock = TypeVar("AnyBlock", bound=ManifestBlock)
KeyPath = list[int | str]
PLACEHOLDER = "placeholder"
MOST_REPAIRS, MOST_VALIDATIONS = 40, 400
PLAIN: tuple[Any, ...] = (
    1.0,
    1,
    1e-3,
    100.0,
    PLACEHOLDER,
    [0.0, 0.0, 1.0],
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3]],
    [100.0],
    [100.0, 200.0],
    [PLACEHOLDER],
    [1.0] * 6,
    True,
)
"""Values that may replace an erroneous one, in addition to those that other tables have at the same key."""


class Repair(Generic[AnyBlock]):
    """A table validated in spite of its errors.

    `block`: None if no valid one was found. `errors`: all of them, those of the unchanged table first.
    `replaced_paths`: where values were replaced. `names`: of the blocks with a replaced value, which cannot be trusted.
    """

    def __init__(self, model: type[AnyBlock], values: dict[str, Any], path: Path, context: Context) -> None:
        self.block: AnyBlock | None = None
        self.errors: list[InputError] = []
        self.replaced_paths: list[KeyPath] = []
        self.names: set[str] = set()
        self._model, self._context, self._path, self._left = model, context, path, MOST_VALIDATIONS
        self._whole, self._values = values, deepcopy(values)
        problems = self._problems(self._values)
        for _ in range(MOST_REPAIRS):
            self.errors += (mistake for mistake in map(self._mistake, problems) if self._new(mistake))
            if not problems or self._left <= 0:
                break
            problems = self._repair(problems[0])

    def _problems(self, values: dict[str, Any]) -> list[ErrorDetails]:
        """Validate, and return the problems, unknown keys first."""
        self._left -= 1
        try:
            self.block = self._model.model_validate(values, context=self._context)
        except ValidationError as error:
            return sorted_problems(error)
        return []

    def _mistake(self, problem: ErrorDetails) -> InputError:
        return problem_error(self._model, problem, self._path, (self._whole, []))

    def _new(self, mistake: InputError) -> bool:
        """Whether an error was not found before, and no value of its table was replaced."""
        tables = [key_path(self._whole, path[:-1]) for path in self.replaced_paths]
        inside = [key_path(self._whole, path) + "." for path in self.replaced_paths]
        found_before = any(mistake.key == other.key for other in self.errors)
        in_changed_table = any(mistake.key.rpartition(".")[0] == table for table in tables)
        return not found_before and not in_changed_table and not mistake.key.startswith(tuple(inside))

    def _repair(self, problem: ErrorDetails) -> list[ErrorDetails]:
        """Replace the value of one problem, and return the remaining problems."""
        path = problem_path(problem)
        names = set(_names(self._values, path))
        for candidate in self._candidates(problem, path):
            if self._left <= 0:
                break
            problems = self._problems(candidate)
            removed = problem["type"] != "extra_forbidden" and _value_at(candidate, path) is None
            required = removed and any(
                other["type"] == "missing" and problem_path(other)[:-1] == path[:-1] for other in problems
            )  # another key instead of the removed one
            if not required and all(problem_path(other) != path for other in problems):
                if _value_at(candidate, path) is not None:
                    self._replaced(path, names)
                self._values = candidate
                return problems
        self._replaced(path, names)
        self._values = _without(self._values, path[:-1]) if len(path) > 1 else self._values
        return self._problems(self._values)

    def _replaced(self, path: KeyPath, names: set[str]) -> None:
        """Record that a valid table has a replaced value at a path."""
        self.replaced_paths.append(path)
        self.names |= names

    def _candidates(self, problem: ErrorDetails, path: KeyPath) -> Iterator[dict[str, Any]]:
        """Yield tables without the key, or with another value."""
        if problem["type"] != "missing":
            yield _without(self._values, path)
        if problem["type"] == "extra_forbidden":
            return
        same_key = [value for value in _at_key(self._values, path[-1]) if value != problem["input"]]
        words = [word for field in _fields(self._model, path) for word in get_args(field.annotation)]
        for value in (*same_key, *(word for word in words if isinstance(word, str)), *PLAIN):
            yield _with(self._values, path, value)


def _fields(model: type[BaseModel], path: KeyPath) -> Iterator[Any]:
    """Yield the field at a path below a model."""
    for number, step in enumerate(path):
        field = model.model_fields.get(step) if isinstance(step, str) else None
        if field is not None and number == len(path) - 1:
            yield field
        below = next(models_in(field.annotation), None) if field is not None else None
        model = below or model


def _names(values: Any, path: KeyPath) -> Iterator[str]:
    """Yield the names of the blocks around a path, or their keys."""
    for step in path[:-1]:
        values = _value_at(values, [step])
        if isinstance(values, dict):
            names = [values[key] for key in ("name", "stereo") if isinstance(values.get(key), str)]
            plain = not all(isinstance(value, dict) for value in values.values())
            yield from names or ([step] if isinstance(step, str) and plain else [])


def _value_at(values: Any, path: KeyPath) -> Any:
    """Return the value at a path, None if there is none."""
    try:
        for step in path:
            values = values[step]
    except (LookupError, TypeError):
        return None
    return values


def _at_key(value: Any, key: int | str) -> Iterator[Any]:
    """Yield the values of all tables at a key."""
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _at_key(item, key)
    if isinstance(value, dict) and key in value:
        yield value[key]


def _with(values: dict[str, Any], path: KeyPath, value: Any) -> dict[str, Any]:
    """Return the table with another value at a path, if the path exists."""
    changed = inner = deepcopy(values)
    try:
        for step in path[:-1]:
            inner = inner[step]  # type: ignore[index]
        inner[path[-1]] = value  # type: ignore[index]
    except (LookupError, TypeError):
        return changed
    return changed


def _without(values: dict[str, Any], path: KeyPath) -> dict[str, Any]:
    """Return the table without the value at a path."""
    changed = inner = deepcopy(values)
    try:
        for step in path[:-1]:
            inner = inner[step]  # type: ignore[index]
        del inner[path[-1]]  # type: ignore[arg-type]
    except (LookupError, TypeError):
        return changed
    return changed


def is_doubtful(contradiction: InputError, doubtful: Mapping[Path, set[str]]) -> bool:
    """Whether a contradiction names a block with a placeholder, or a key of one."""
    every, values = set().union(*doubtful.values()), " ".join(map(str, contradiction.values.values()))
    words, key = (set(re.split(r"[^\w-]+", text)) for text in (values, contradiction.key))
    return bool((every | {PLACEHOLDER}) & words or doubtful.get(contradiction.file, set()) & key)
