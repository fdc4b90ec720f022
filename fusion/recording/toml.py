"""TOML text to checked models: every error becomes one `InputError` that names file and key.

Inputs may be stated as in certificates: a table with U and k instead of a number.
"""

from __future__ import annotations

import csv
import json
import re
import stat
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date as Date
from difflib import get_close_matches
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from fusion.errors import InputError
from fusion.recording.recording_notices import (
    FILE_TOO_LARGE,
    INVALID_SYNTAX,
    INVALID_UNCERTAINTY_STATEMENT,
    INVALID_VALUE,
    KEY_NOT_APPLICABLE,
    MISSING_FILE,
    MISSING_KEY,
    UNFILLED_VALUE,
    UNKNOWN_KEY,
    UNREADABLE_FILE,
    VALUE_OUT_OF_RANGE,
    WRONG_ENCODING,
    WRONG_VALUE_TYPE,
)
from fusion.recording.values import (
    Context,
    ManifestBlock,
    NotNegative,
    describe,
    is_number,
    refusal,
    wrong_size,
    wrong_text,
)
from shakercal._common.notices import DeclaredNotice

LARGEST_TOML = 4_000_000  # bytes; manifests have some 10 000
LONG_LINE = 5000  # characters; the TOML reader is slow for deep nesting in longer lines
UTF16 = (b"\xff\xfe", b"\xfe\xff")  # byte order marks
DEEPEST = 32  # nested tables and lists; manifests have five
AnyBlock = TypeVar("AnyBlock", bound=ManifestBlock)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the values of a TOML file; `InputError` with line or key."""
    text = read_text(path, LARGEST_TOML, "a manifest")
    deep = next((number for number, line in enumerate(text.splitlines(), 1) if _nested(line) > DEEPEST), None)
    if deep is not None:
        raise InputError(
            INVALID_SYNTAX,
            path,
            f"line {deep}",
            found="more",
            expected=f"at most {DEEPEST} tables or lists in one another",
        )
    try:
        values = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(INVALID_SYNTAX, path, found="brackets without end", expected="TOML") from error
    except ValueError as error:
        raise InputError(INVALID_SYNTAX, path, found=describe(str(error), plain=True), expected="TOML") from error
    check_values(values, path)
    return values


def read_rows(
    path: Path, largest: int, expected: str = "a table in UTF-8 text"
) -> tuple[tuple[str, ...], list[dict[str, str]]]:
    """Return columns and rows of a table of at most `largest` bytes."""
    try:
        reader = csv.DictReader(read_text(path, largest, "a table").splitlines())
        return tuple(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise InputError(INVALID_SYNTAX, path, found=str(error), expected=expected) from error


def read_text(path: Path, largest: int, what: str) -> str:
    """Return the text of a file of at most `largest` bytes; else `InputError`."""
    try:
        size = path.stat()
        if not stat.S_ISREG(size.st_mode):
            found = "a folder" if stat.S_ISDIR(size.st_mode) else "a device or pipe"
            raise InputError(UNREADABLE_FILE, path, found=found, expected="a file that can be read")
        if size.st_size > largest:
            raise InputError(
                FILE_TOO_LARGE, path, found=f"{size.st_size} bytes", expected=f"{what} of at most {largest} bytes"
            )
        content = path.read_bytes()
        if content.startswith(UTF16):
            raise InputError(WRONG_ENCODING, path, found="UTF-16", expected="UTF-8 text; save it as UTF-8")
        return content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(MISSING_FILE, path, found="no such file", expected="an existing file") from error
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        found = f"a letter of another encoding in line {line}, such as code page 1252"
        raise InputError(WRONG_ENCODING, path, found=found, expected="UTF-8 text; save it as UTF-8") from error
    except (OSError, ValueError) as error:  # a ValueError: NUL in the name
        found = getattr(error, "strerror", None) or str(error)
        raise InputError(UNREADABLE_FILE, path, found=found, expected="a file that can be read") from error


def _nested(line: str) -> int:
    """Return the nesting depth of a long line of TOML, by brackets and dots."""
    if len(line) < LONG_LINE:
        return 0
    name = line.partition("=")[0]
    depths = accumulate(1 if found[0] in "[{" else -1 for found in re.finditer(r"[\[\]{}]", line))
    return max(0 if "," in name else name.count("."), *depths, 0)


def check_values(values: Any, path: Path) -> None:
    """Raise `InputError` at the first impossible value of a file, independent of its key.

    Such values are numbers outside `SMALLEST` to `LARGEST`, control characters, very long texts, deeply nested tables.
    """
    waiting: list[tuple[Any, list[int | str]]] = [(values, [])]
    while waiting:
        value, key_steps = waiting.pop()
        if isinstance(value, dict | list):
            if len(key_steps) > DEEPEST:
                raise InputError(
                    INVALID_SYNTAX,
                    path,
                    key_path(values, key_steps[:3]),
                    found="more",
                    expected=f"at most {DEEPEST} tables or lists in one another",
                )
            steps = value.items() if isinstance(value, dict) else enumerate(value)
            for step, item in steps:
                wrong = wrong_text(step) if isinstance(step, str) else None
                if wrong is not None:
                    raise InputError(
                        INVALID_VALUE,
                        path,
                        key_path(values, key_steps),
                        found=f"the name {describe(step, plain=True)}",
                        expected=wrong,
                    )
                waiting.append((item, [*key_steps, step]))
            continue
        is_text = isinstance(value, str)
        wrong = wrong_text(value) if is_text else wrong_size(value)
        if wrong is not None:
            declared = INVALID_VALUE if is_text else VALUE_OUT_OF_RANGE
            raise InputError(declared, path, key_path(values, key_steps), found=describe(value), expected=wrong)


def validate(model: type[AnyBlock], text: dict[str, Any], path: Path, context: Context | None = None) -> AnyBlock:
    """Return TOML values as a model; all problems become one `InputError`."""
    values, _ = expand_statements(text, path)
    return checked_table(model, values, path, context=context)


def checked_table(
    model: type[AnyBlock],
    values: dict[str, Any],
    path: Path,
    location: tuple[dict[str, Any], list[int | str]] | None = None,
    context: Context | None = None,
) -> AnyBlock:
    """Return a table as a model; `location`: whole file and key path."""
    try:
        return model.model_validate(values, context=context)
    except ValidationError as error:
        problems = sorted_problems(error)
        at = location or (values, [])
        raise InputError.together(problem_error(model, problem, path, at) for problem in problems) from error


def sorted_problems(error: ValidationError) -> list[ErrorDetails]:
    """Return the problems of a table, unknown keys first: they are often misspelt missing ones."""
    return sorted(error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden")


def problem_path(problem: ErrorDetails) -> list[int | str]:
    """Return the key path of a problem, with the key named by its validator."""
    inner = problem.get("ctx", {}).get("key")
    return [*problem["loc"], *(inner.split(".") if inner else ())]


def problem_error(
    model: type[ManifestBlock], problem: ErrorDetails, path: Path, location: tuple[dict[str, Any], list[int | str]]
) -> InputError:
    """Return the error of a problem; `location`: whole file and key path of the table."""
    whole, start = location
    declared, expected, found = _describe_problem(model, problem)
    return InputError(declared, path, key_path(whole, [*start, *problem_path(problem)]), found=found, expected=expected)


# Inputs as in certificates: a table instead of a value, or of its standard uncertainty.

RELATIVE = (
    "scale",
    "individual",
    "static_sensitivity",
    "step_amplitude",
    "gain",
    "clock",
    "frequencies",
    "participation",
)
"""Values with a relative standard uncertainty."""
RELATIVE_ALONE = ("frequency", "damping_ratio")
"""The same if the table has no such value: for the poles of a chain's element and the modes of a model."""
UNCERTAINTY_OF = {"step_amplitude": "step_uncertainty"}
"""Keys of standard uncertainties other than NAME_uncertainty."""
DIVISORS = {"uniform": 3.0**0.5, "triangular": 6.0**0.5, "arcsine": 2.0**0.5}
"""Half-width over standard uncertainty (JCGM 101, 6.4.2, 6.4.5 and 6.4.6)."""


def _is_relative(name: str, table: dict[str, Any]) -> bool:
    """Whether the standard uncertainty of a value is relative.

    `frequency_uncertainty` of a chain's element is relative; that of a mode is in Hz, as its `frequency`.
    """
    return name in RELATIVE or (name in RELATIVE_ALONE and name not in table)


class UncertaintyStatement(ManifestBlock):
    """An input as in a certificate: U with k, or the half-width of a distribution."""

    value: Any = None
    U: Any = None
    U_relative: NotNegative | None = None
    k: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    dof: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    distribution: Literal["normal", "uniform", "triangular", "arcsine"] = "normal"
    certificate: str = ""
    laboratory: str = ""
    date: Date | None = None
    valid_until: Date | None = None

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if (self.U is None) == (self.U_relative is None):
            raise refusal(
                "either U or U_relative",
                "neither" if self.U is None else "both",
                key="U",
                declared=INVALID_UNCERTAINTY_STATEMENT,
            )
        numbers = self.U if isinstance(self.U, list | tuple) else [0.0 if self.U is None else self.U]
        if not all(is_number(number) and number >= 0 for number in numbers):
            raise refusal(
                "a number or numbers, none negative", describe(self.U), key="U", declared=INVALID_UNCERTAINTY_STATEMENT
            )
        if self.distribution == "normal" and self.k is None:
            raise refusal(
                "the coverage factor k that belongs to U (1 for a standard uncertainty)",
                "no such key",
                key="k",
                declared=INVALID_UNCERTAINTY_STATEMENT,
            )
        if self.distribution != "normal" and (self.k or self.dof) is not None:
            key = "dof" if self.k is None else "k"
            raise refusal(
                f"no such key: U of a {self.distribution} distribution is its half-width",
                "one",
                key=key,
                declared=INVALID_UNCERTAINTY_STATEMENT,
            )
        if self.date is not None and self.valid_until is not None and self.valid_until < self.date:
            raise refusal(
                f"a day after {self.date}, the date of the certificate",
                f"{self.valid_until}",
                key="valid_until",
                declared=INVALID_UNCERTAINTY_STATEMENT,
            )
        return self

    def standard_uncertainty(self, value: Any, *, relative: bool) -> Any:
        """Return u in the unit of a value, or relative; None if that is impossible.

        It is U/k, or the half-width over its divisor. U without a value is in the unit of its key. If U has `dof`
        degrees of freedom, u = U/k·t(dof)/1.96, so that ±1.96·u is the interval of 95 %.
        """
        divisor = DIVISORS.get(self.distribution, self.k or 1.0)
        if self.dof is not None:
            from scipy.special import ndtri, stdtrit

            divisor *= float(ndtri(0.975) / stdtrit(self.dof, 0.975))
        u = np.asarray(self.U_relative if self.U is None else self.U, dtype=np.float64) / divisor
        if relative != (self.U is None) and not (relative and self.value is None):
            if not is_number(value) or value == 0.0:
                return None
            u = u / abs(value) if relative else u * abs(value)
        return u.tolist()


@dataclass(frozen=True)
class UncertainInput:
    """An input with its standard uncertainty `u`, `relative` or in its unit.

    `value`: None if the key has none. `stated`: the statement of a certificate, None if u is stated itself.
    """

    file: Path
    key: str
    value: Any
    u: Any
    relative: bool
    stated: UncertaintyStatement | None = None

    @property
    def source(self) -> str:
        """Return certificate, laboratory and dates as text."""
        stated = self.stated or UncertaintyStatement(U=0.0, k=1.0)
        dates = (str(stated.date or ""), "" if stated.valid_until is None else f"valid until {stated.valid_until}")
        return ", ".join(filter(None, (stated.certificate, stated.laboratory, *dates)))


def _has_numbers(item: Any) -> bool:
    """Whether a list, or its first list, begins with a number."""
    while isinstance(item, list) and item:
        item = item[0]
    return is_number(item)


def uncertain_inputs(text: dict[str, Any], path: Path) -> tuple[UncertainInput, ...]:
    """Return every input of a file with an uncertainty, in the order of the file."""
    values, statements = expand_statements(text, path)
    by_key = {statement.key.removesuffix("_uncertainty"): statement for statement in statements}

    def walked(value: Any, key_steps: list[int | str]) -> Iterator[UncertainInput]:
        for step, item in value.items() if isinstance(value, dict) else enumerate(value):
            name = str(step).removesuffix("_uncertainty")
            if isinstance(item, dict | list) and not _has_numbers(item):
                yield from walked(item, [*key_steps, step])
            elif isinstance(value, dict) and name != step and np.any(item):
                key = key_path(values, [*key_steps, name])
                plain = UncertainInput(path, key, value.get(name), item, _is_relative(name, value))
                yield by_key.get(key, plain)

    return tuple(walked(values, []))


def expand_statements(text: dict[str, Any], path: Path) -> tuple[dict[str, Any], tuple[UncertainInput, ...]]:
    """Return TOML values with value and standard uncertainty instead of statements, and the statements.

    A table with U at a key gives the value and its `_uncertainty` key; a table at an `_uncertainty` key gives only
    that. Raises `InputError` for an incomplete or contradicting one.
    """
    statements: list[UncertainInput] = []

    def expanded(value: Any, path_steps: list[int | str]) -> Any:
        if isinstance(value, list):
            return [expanded(item, [*path_steps, number]) for number, item in enumerate(value)]
        if not isinstance(value, dict):
            return value
        out: dict[str, Any] = {}
        for key, item in value.items():
            steps = [*path_steps, key]
            # A table of tables, such as stereo pairs, may have one with the name U.
            if not isinstance(item, dict) or all(isinstance(item.get(u, {}), dict) for u in ("U", "U_relative")):
                out[key] = expanded(item, steps)
                continue
            statement = checked_table(UncertaintyStatement, item, path, (text, steps))
            name = key.removesuffix("_uncertainty")
            target, relative = UNCERTAINTY_OF.get(name, f"{name}_uncertainty"), _is_relative(name, value)
            if (statement.value is None) == (name == key):
                expected = "the value that this U belongs to" if name == key else "no value, which has a separate key"
                raise InputError(
                    INVALID_UNCERTAINTY_STATEMENT,
                    path,
                    key_path(text, [*steps, "value"]),
                    found=describe(statement.value),
                    expected=expected,
                )
            if name == key and target in value:
                raise InputError(
                    KEY_NOT_APPLICABLE,
                    path,
                    key_path(text, [*path_steps, target]),
                    found="one",
                    expected=f"no such key, since {key} states its U",
                )
            u = statement.standard_uncertainty(
                value.get(name) if statement.value is None else statement.value, relative=relative
            )
            if u is None:
                given, needed = ("U", "U_relative") if relative else ("U_relative", "U")
                found = describe(getattr(statement, given))
                raise InputError(
                    INVALID_UNCERTAINTY_STATEMENT,
                    path,
                    key_path(text, [*steps, given]),
                    found=found,
                    expected=f"{needed} for a value such as this",
                )
            statements.append(UncertainInput(path, key_path(text, steps), statement.value, u, relative, statement))
            out |= {target: u} if statement.value is None else {key: statement.value, target: u}
        return out

    return expanded(text, []), tuple(statements)


UNFILLED = "?"
"""Placeholder in a drafted manifest for a value that the laboratory must state."""


def find_unfilled(text: dict[str, Any], path: Path) -> list[InputError]:
    """Return an error for every placeholder of a file, in the order of the file.

    The expected value is described by the comment after the placeholder.
    """
    unfilled_paths: list[list[int | str]] = []

    def walk(value: Any, key_steps: list[int | str]) -> None:
        for step, item in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(item, dict | list):
                walk(item, [*key_steps, step])
            elif item == UNFILLED:
                unfilled_paths.append([*key_steps, step])

    walk(text, [])
    marks = (line.partition("#") for line in read_text(path, LARGEST_TOML, "a manifest").splitlines() if unfilled_paths)
    comments = [comment.strip() for value, _, comment in marks for _ in range(value.count(f'"{UNFILLED}"'))]
    descriptions = comments if len(comments) == len(unfilled_paths) else [""] * len(unfilled_paths)
    return [
        InputError(
            UNFILLED_VALUE,
            path,
            key_path(text, key_steps),
            found=f'"{UNFILLED}", not filled in yet',
            expected=comment or "a value",
        )
        for key_steps, comment in zip(unfilled_paths, descriptions, strict=True)
    ]


def quote_key(name: str) -> str:
    """Return a name for a key path, in quotes unless it is a bare key."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", name) else f'"{describe(name, plain=True)}"'


def key_path(text: dict[str, Any], key_steps: list[int | str]) -> str:
    """Return a key path with blocks by name, or counted from 1: `daq.bridge.channel.Fz.scale`."""
    shown = ""
    value: Any = text
    for step in key_steps:
        inside = isinstance(value, list | tuple) if isinstance(step, int) else isinstance(value, dict)
        present = inside and (step < len(value) if isinstance(step, int) else step in value)
        child = value[step] if present else None
        name = step if isinstance(step, str) else _block_name(value, child)
        if isinstance(step, int) and not name:
            shown += f"[{step + 1}]"
        else:
            shown += f".{quote_key(name)}" if shown else quote_key(name)
        value = child
    return shown


def _block_name(siblings: Any, block: Any) -> str:
    """Return the name that identifies a block among its siblings, empty if there is none."""
    for key in ("name", "stereo") if isinstance(block, dict) else ():
        names = [item.get(key) for item in siblings if isinstance(item, dict)]
        if isinstance(block.get(key), str) and names.count(block[key]) == 1:
            return str(block[key])
    return ""


VALIDATION_ERRORS = {
    "greater_than": VALUE_OUT_OF_RANGE,
    "greater_than_equal": VALUE_OUT_OF_RANGE,
    "less_than_equal": VALUE_OUT_OF_RANGE,
    "less_than": VALUE_OUT_OF_RANGE,
    "literal_error": INVALID_VALUE,
}
"""Declarations by pydantic's type of error; all others are wrong types."""


def _describe_problem(model: type[ManifestBlock], problem: ErrorDetails) -> tuple[DeclaredNotice, str, str]:
    """Return the declaration, the expected and the found value of any error of pydantic."""
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "refused":
        return context["declared"], str(context["expected"]), str(context["found"])
    if kind == "missing":
        return MISSING_KEY, "this key, which is required", "no such key"
    if kind == "extra_forbidden":
        return UNKNOWN_KEY, _available_keys(model, problem["loc"]), "an unknown key"
    expected = {
        "float_type": "a number",
        "finite_number": "a finite number",
        "int_type": "a whole number",
        "bool_type": "true or false",
        "string_type": "a text",
        "date": "a date, such as 2026-11-28",
        "string_too_short": "a text that is not empty",
        "too_short": "at least {min_length} element",
        "greater_than": "a number above {gt:g}",
        "greater_than_equal": "a number of at least {ge:g}",
        "less_than_equal": "a number of at most {le:g}",
        "less_than": "a number below {lt:g}",
        "literal_error": "{expected}",
        "model_type": "a table",
        "dict_type": "a table",
    }.get("date" if kind.startswith("date") else kind)
    declared = VALIDATION_ERRORS.get(kind, WRONG_VALUE_TYPE)
    return (
        declared,
        expected.format(**context) if expected else problem["msg"].removeprefix("Input should be "),
        describe(problem["input"]),
    )


def _available_keys(model: type[BaseModel], path: tuple[int | str, ...]) -> str:
    """Return the probably intended key of a table, else all its keys."""
    for step in path[:-1]:
        field = model.model_fields.get(step) if isinstance(step, str) else None
        below = next(models_in(field.annotation), None) if field is not None else None
        model = below or model
    available = list(model.model_fields)
    close = get_close_matches(str(path[-1]), available, n=1)
    return f'a key of this table, probably "{close[0]}"' if close else "one of the keys " + ", ".join(available)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation such as tuple[Daq, ...] names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from models_in(argument)


# Tables to TOML text.


def to_toml(table: Mapping[str, Any], path: str = "") -> str:
    """Return TOML text: plain keys first, then sub-tables, then arrays of tables (lists of dictionaries)."""
    lines = [f"{key} = {_shown(value)}" for key, value in table.items() if not _is_table(value)]
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            header = "" if all(isinstance(v, Mapping) for v in value.values()) else f"\n[{name}]\n"
            lines.append(header + to_toml(value, name).rstrip("\n"))
        elif _is_table(value):
            lines += [f"\n[[{name}]]\n" + to_toml(item, name).rstrip("\n") for item in value]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    """Whether a value needs a header."""
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping))


def _shown(value: Any) -> str:
    """Return a plain value as TOML text."""
    return value.isoformat() if isinstance(value, Date) else json.dumps(value, ensure_ascii=False)
