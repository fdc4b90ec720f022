"""Mistakes of a table that other mistakes hide: each is replaced by something valid until the whole table is valid."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fusion.errors import InputError
from fusion.recording.toml import describe_problem, key_path, models_in
from fusion.recording.values import Context, ManifestBlock

AnyBlock = TypeVar("AnyBlock", bound=ManifestBlock)
Place = list[int | str]
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
    [PLACEHOLDER],
    [1.0] * 6,
    True,
)
"""Values that may take the place of a mistake, beside those that other tables have at the same key."""


class Repair(Generic[AnyBlock]):
    """A table validated in spite of its mistakes.

    `block`: None if no valid one was found; `wrong`: all mistakes, those first that the table shows as it is; `places`:
    where values were replaced, `names`: of the blocks with a replaced value, which `block` says nothing of.
    """

    def __init__(self, model: type[AnyBlock], values: dict[str, Any], path: Path, context: Context) -> None:
        self.block: AnyBlock | None = None
        self.wrong: list[InputError] = []
        self.places: list[Place] = []
        self.names: set[str] = set()
        self._model, self._context, self._path, self._left = model, context, path, MOST_VALIDATIONS
        self._whole, self._values = values, deepcopy(values)
        problems = self._problems(self._values)
        for _ in range(MOST_REPAIRS):
            self.wrong += (mistake for mistake in map(self._mistake, problems) if self._new(mistake))
            if not problems or self._left <= 0:
                break
            problems = self._repaired(problems[0])

    def _problems(self, values: dict[str, Any]) -> list[ErrorDetails]:
        """Validate, and return what is wrong, unknown keys first."""
        self._left -= 1
        try:
            self.block = self._model.model_validate(values, context=self._context)
        except ValidationError as error:
            found = error.errors(include_url=False)
            return sorted(found, key=lambda problem: problem["type"] != "extra_forbidden")
        return []

    def _mistake(self, problem: ErrorDetails) -> InputError:
        expected, found = describe_problem(self._model, problem)
        return InputError(self._path, key_path(self._whole, _place(problem)), found, expected)

    def _new(self, mistake: InputError) -> bool:
        """Whether a mistake was not found before and is none of a table in which a value was replaced."""
        tables = [key_path(self._whole, place[:-1]) for place in self.places]
        inside = [key_path(self._whole, place) + "." for place in self.places]
        known = any(mistake.key == other.key for other in self.wrong)
        beside = any(mistake.key.rpartition(".")[0] == table for table in tables)
        return not known and not beside and not mistake.key.startswith(tuple(inside))

    def _repaired(self, problem: ErrorDetails) -> list[ErrorDetails]:
        """Replace what one problem is about, and return the problems that are left."""
        place = _place(problem)
        names = set(_names(self._values, place))
        for candidate in self._candidates(problem, place):
            if self._left <= 0:
                break
            problems = self._problems(candidate)
            if all(_place(other) != place for other in problems):
                if _value_at(candidate, place) is not None:
                    self._replaced(place, names)
                self._values = candidate
                return problems
        self._replaced(place, names)
        self._values = _without(self._values, place[:-1]) if len(place) > 1 else self._values
        return self._problems(self._values)

    def _replaced(self, place: Place, names: set[str]) -> None:
        """Remember that what a valid table says of a place is not what was meant."""
        self.places.append(place)
        self.names |= names

    def _candidates(self, problem: ErrorDetails, place: Place) -> Iterator[dict[str, Any]]:
        """Yield the table without the key, with values of the same key elsewhere, words that are allowed, others."""
        if problem["type"] != "missing":
            yield _without(self._values, place)
        if problem["type"] == "extra_forbidden":
            return
        elsewhere = [value for value in _at_key(self._values, place[-1]) if value != problem["input"]]
        words = [word for field in _fields(self._model, place) for word in get_args(field.annotation)]
        for value in (*elsewhere, *(word for word in words if isinstance(word, str)), *PLAIN):
            yield _with(self._values, place, value)


def _place(problem: ErrorDetails) -> Place:
    """Where a problem lies, by the key that a validator of a whole table names."""
    own = problem.get("ctx", {}).get("key")
    return [*problem["loc"], *(own.split(".") if own else ())]


def _fields(model: type[BaseModel], place: Place) -> Iterator[Any]:
    """Yield the field at a place below a model."""
    for number, step in enumerate(place):
        field = model.model_fields.get(step) if isinstance(step, str) else None
        if field is not None and number == len(place) - 1:
            yield field
        below = next(models_in(field.annotation), None) if field is not None else None
        model = below or model


def _names(values: Any, place: Place) -> Iterator[str]:
    """Yield the names of the blocks around a place: their own, else their keys."""
    for step in place[:-1]:
        values = _value_at(values, [step])
        if isinstance(values, dict):
            own = [values[key] for key in ("name", "stereo") if isinstance(values.get(key), str)]
            plain = not all(isinstance(value, dict) for value in values.values())
            yield from own or ([step] if isinstance(step, str) and plain else [])


def _value_at(values: Any, place: Place) -> Any:
    """Return what stands at a place, None where nothing does."""
    try:
        for step in place:
            values = values[step]
    except (LookupError, TypeError):
        return None
    return values


def _at_key(value: Any, key: int | str) -> Iterator[Any]:
    """Yield the values that tables anywhere have at a key."""
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _at_key(item, key)
    if isinstance(value, dict) and key in value:
        yield value[key]


def _with(values: dict[str, Any], place: Place, value: Any) -> dict[str, Any]:
    """Return the table with another value at a place, unchanged where there is no table around it."""
    changed = inner = deepcopy(values)
    try:
        for step in place[:-1]:
            inner = inner[step]  # type: ignore[index]
        inner[place[-1]] = value  # type: ignore[index]
    except (LookupError, TypeError):
        return changed
    return changed


def _without(values: dict[str, Any], place: Place) -> dict[str, Any]:
    """Return the table without what stands at a place."""
    changed = inner = deepcopy(values)
    try:
        for step in place[:-1]:
            inner = inner[step]  # type: ignore[index]
        del inner[place[-1]]  # type: ignore[arg-type]
    except (LookupError, TypeError):
        return changed
    return changed


def is_doubtful(contradiction: InputError, doubtful: Mapping[Path, set[str]]) -> bool:
    """Whether a contradiction may follow from a placeholder: it names such a block, or is at a key of one."""
    every = set().union(*doubtful.values())
    told, key = (set(re.split(r"[^\w-]+", text)) for text in (contradiction.sentence, contradiction.key))
    return bool((every | {PLACEHOLDER}) & told or doubtful.get(contradiction.file, set()) & key)
