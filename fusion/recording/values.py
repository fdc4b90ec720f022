"""Types and validators of manifest values, and the resolution of paths.

Each refusal states the expected and the found value. TOML values are converted in two cases only: an integer is a
number, and one number may represent all elements of an uncertainty.
"""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import date, time
from fnmatch import fnmatchcase
from math import hypot, isinf
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic_core import PydanticCustomError

from fusion.base import natural_key
from fusion.recording.recording_notices import (
    IMPOSSIBLE_MASS_PROPERTIES,
    INVALID_VALUE,
    KEY_NOT_APPLICABLE,
    MISSING_FILE,
    MISSING_KEY,
    NAME_NOT_USABLE_IN_FILES,
    PATH_NOT_ALLOWED,
    REPEATED_NAME,
    UNREADABLE_FILE,
    VALUE_OUT_OF_RANGE,
    WRONG_VALUE_TYPE,
)
from shakercal._common.notices import DeclaredNotice

# Paths in a manifest: resolved against its folder, inside the campaign, globs in natural order.


MAGIC = re.compile(r"[*?\[]")


def _other_than_file(path: Path) -> str:
    """Return a description of a path that is not a file."""
    if path.is_dir():
        return f"a folder at {path}"
    return f"a device or pipe at {path}" if path.exists() else f"no file {path}"


@dataclass(frozen=True)
class PathScope:
    """Folder where the paths of a manifest start, and the resolved `root` that contains them.

    Every path of every manifest is resolved by it. `of`: a description of the root.
    """

    folder: Path
    root: Path
    allow_outside: bool = False
    of: str = "of rig.toml"

    def file(self, text: str) -> Path:
        """Return the resolved path of one existing file."""
        path = self._inside(self._followed(self._join(text), text), text)
        if not path.is_file():
            raise refusal("an existing file", _other_than_file(path), declared=MISSING_FILE)
        return path

    def files(self, text: str) -> tuple[Path, ...]:
        """Return the existing files of a path or a glob (`*`, `?`, `[…]`), in order."""
        plain = self._join(text)
        if plain.is_file():
            return (self._inside(self._followed(plain, text), text),)
        if not MAGIC.search(text):
            return (self.file(text),)
        if "**" in text:
            raise refusal("a pattern that stays in one folder", f"'{text}' with '**'", declared=PATH_NOT_ALLOWED)
        matches = [path for path in self._expand(text) if path.is_file()]
        if not matches:
            raise refusal("at least one file", f"no file that matches {plain}", declared=MISSING_FILE)
        folders = {folder: self._followed(folder, text) for folder in {path.parent for path in matches}}
        real = (self._followed(p, text) if p.is_symlink() else folders[p.parent] / p.name for p in matches)
        return tuple(self._inside(path, text) for path in real)

    def _join(self, text: str) -> Path:
        """Check the syntax of a path and join it to the manifest's folder."""
        if not text.strip() or UNPRINTABLE.search(text):
            raise refusal("a path", "a text with control characters" if text.strip() else "an empty text")
        if "\\" in text:
            raise refusal("a path with '/' between its parts", f"'{text}'", declared=PATH_NOT_ALLOWED)
        absolute = PurePosixPath(text).is_absolute() or PureWindowsPath(text).drive != ""
        if absolute and not self.allow_outside:
            raise refusal("a path relative to this file", f"'{text}'", declared=PATH_NOT_ALLOWED)
        return self.folder / text

    def _followed(self, path: Path, text: str) -> Path:
        """Return a path without links."""
        try:
            return path.resolve()
        except RuntimeError as error:  # raised by Python before 3.13
            raise refusal("a path that can be read", f"circular links at '{text}'", declared=UNREADABLE_FILE) from error

    def _inside(self, path: Path, text: str) -> Path:
        """Refuse a resolved path outside the campaign's folder."""
        if not self.allow_outside and not path.is_relative_to(self.root):
            raise refusal(
                f"a path inside the folder {self.of} {self.root} (--allow-outside permits others)",
                f"'{text}', which leads to {path}",
                declared=PATH_NOT_ALLOWED,
            )
        return path

    def _expand(self, text: str) -> list[Path]:
        """Return the matches of a glob, case-sensitively, each folder's entries in natural order.

        A pattern matches hidden entries only if it contains the dot.
        """
        anchor = PurePosixPath(text).anchor
        matches = [Path(anchor or self.folder)]
        for pattern in PurePosixPath(text).relative_to(anchor).parts:
            if not MAGIC.search(pattern):
                matches = [path / pattern for path in matches if (path / pattern).exists()]
                continue
            folders = [path.iterdir() for path in matches if path.is_dir()]
            entries = [entry for below in folders for entry in sorted(below, key=lambda path: natural_key(path.name))]
            named = [entry for entry in entries if fnmatchcase(entry.name, pattern)]
            matches = [entry for entry in named if pattern.startswith(".") or not entry.name.startswith(".")]
        return matches


# Types and validators of manifest values.


Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Box = tuple[int, int, int, int]
Outline = Box | tuple[tuple[int, int], ...]
MOST_PIXELS, MOST_OUTLINES = 100_000, 1000
BodyName = Literal["load", "base"]
Component = Literal["Fx", "Fy", "Fz", "Mx", "My", "Mz"]

PULSE: Literal["pulse"] = "pulse"
FILE: Literal["file"] = "file"
ORTHONORMAL_TOLERANCE = 1e-6
SYMMETRY_TOLERANCE = 1e-6
ROUNDING_TOLERANCE = 0.01  # of the largest principal moment: tables of two or three digits


@dataclass(frozen=True)
class Context:
    """Context of a validation: scope of paths."""

    scope: PathScope


class ManifestBlock(BaseModel):
    """A TOML table with its keys as attributes: immutable, without conversion, unknown keys are refused.

    Its validator is built at its first use: a table inside another one needs no validator.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", defer_build=True)


def refusal(expected: str, found: str, key: str = "", declared: DeclaredNotice = INVALID_VALUE) -> PydanticCustomError:
    """Return the error that a validator raises; `key`: within the table."""
    context = {"expected": expected, "found": found, "key": key, "declared": declared}
    return PydanticCustomError("refused", "expected {expected}, found {found}", context)


SMALLEST, LARGEST = 1e-100, 1e30
"""Range of the size of numbers other than 0, in SI units: their products do not overflow."""
LONGEST_TEXT = 4096
LONGEST_FILE_NAME = 100  # bytes of a name in the name of a file
MOST_ITEMS = 10_000  # blocks of one kind, names in a list; manifests have some 100
UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters except tab and \n, line separators, characters that change the direction of writing."""


def wrong_text(text: str) -> str | None:
    """Return the expected form of a text of a file, None if it complies."""
    if len(text) > LONGEST_TEXT:
        return f"a text of at most {LONGEST_TEXT} characters"
    return "a text without control characters" if UNPRINTABLE.search(text.replace("\r\n", "\n")) else None


def wrong_size(value: Any) -> str | None:
    """Return the expected range of a number whose products overflow or vanish, else None."""
    if not isinstance(value, int | float) or isinstance(value, bool) or value in (0, np.inf, -np.inf):
        return None
    return f"0 or a size of {SMALLEST:g} to {LARGEST:g}" if abs(value) < SMALLEST or abs(value) > LARGEST else None


def describe(value: Any, *, plain: bool = False) -> str:
    """Return a short description of a TOML value; `plain`: of a text, the text itself.

    Control characters are replaced by their numbers.
    """
    if value is None or isinstance(value, bool):
        return {None: "no value", True: "true", False: "false"}[value]
    if isinstance(value, str):
        short = value if len(value) <= 60 or (plain and len(value) <= 200) else value[:57] + "..."
        short = UNPRINTABLE.sub(lambda found: f"\\u{ord(found[0]):04x}", short)
        return short if plain else f'the text "{short}"'
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, date | time):
        return "a date or time"
    return "a whole number of hundreds of digits" if isinstance(value, int) and abs(value) > 10**99 else f"{value}"[:99]


def is_number(value: Any) -> bool:
    """Whether a value is a finite int or float, not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _numbers(value: Any, count: int, expected: str) -> tuple[float, ...]:
    if not isinstance(value, list | tuple):
        raise refusal(expected, describe(value), declared=WRONG_VALUE_TYPE)
    if len(value) != count:
        raise refusal(expected, f"{len(value)} elements", declared=WRONG_VALUE_TYPE)
    wrong = [(i, element) for i, element in enumerate(value, 1) if not is_number(element)]
    if wrong:
        raise refusal(expected, f"{describe(wrong[0][1])} as element {wrong[0][0]}", declared=WRONG_VALUE_TYPE)
    return tuple(float(element) for element in value)


def vector(count: int) -> Callable[[Any], tuple[float, ...]]:
    """Return a validator of a list of `count` numbers."""
    return lambda value: _numbers(value, count, f"{count} numbers")


def rows_of(rows: int, columns: int, fewer: int | None = None) -> Callable[[Any], tuple[tuple[float, ...], ...]]:
    """Return a validator of `rows` lists of `columns` numbers, or of `fewer`, padded with zeros."""
    expected = f"{rows} rows of {columns if fewer is None else f'{fewer} or {columns}'} numbers"

    def checked(value: Any) -> tuple[tuple[float, ...], ...]:
        if not isinstance(value, list | tuple) or len(value) != rows:
            found = f"{len(value)} rows" if isinstance(value, list | tuple) else describe(value)
            raise refusal(expected, found, declared=WRONG_VALUE_TYPE)
        if fewer is not None and all(isinstance(row, list | tuple) and len(row) == fewer for row in value):
            value = [[*row, *[0.0] * (columns - fewer)] for row in value]
        return tuple(_numbers(row, columns, expected) for row in value)

    return checked


_matrix3 = rows_of(3, 3)


def box(value: Any) -> Box:
    """Return a rectangle in whole pixels: left, top, width, height."""
    whole = isinstance(value, list | tuple) and len(value) == 4 and all(type(part) is int for part in value)
    if not (whole and min(value) >= 0 and min(value[2:]) >= 1 and max(value) <= MOST_PIXELS):
        raise refusal(
            "[x, y, width, height] of the left image in whole px, width and height above 0",
            describe(value),
            declared=WRONG_VALUE_TYPE,
        )
    x, y, width, height = value
    return x, y, width, height


def outline(value: Any) -> Outline:
    """Return a rectangle, or the corners of a polygon, in whole pixels."""
    if not isinstance(value, list | tuple) or not any(isinstance(corner, list | tuple) for corner in value):
        return box(value)
    pairs = [corner for corner in value if isinstance(corner, list | tuple) and len(corner) == 2]
    whole = all(type(part) is int and 0 <= part <= MOST_PIXELS for corner in pairs for part in corner)
    if not whole or len(pairs) < len(value) or not 3 <= len(value) <= MOST_OUTLINES:
        expected = f"3 to {MOST_OUTLINES} corners [x, y] of a polygon in whole px of the left image"
        raise refusal(expected, describe(value), declared=WRONG_VALUE_TYPE)
    return tuple((x, y) for x, y in pairs)


def outlines(value: Any) -> tuple[Outline, ...]:
    """Return rectangles and polygons in whole pixels."""
    if not isinstance(value, list | tuple) or any(not isinstance(one, list | tuple) for one in value):
        raise refusal("a list of [x, y, width, height] or polygons", describe(value), declared=WRONG_VALUE_TYPE)
    if len(value) > MOST_OUTLINES:
        raise refusal(f"at most {MOST_OUTLINES} rectangles and polygons", str(len(value)), declared=VALUE_OUT_OF_RANGE)
    return tuple(map(outline, value))


def unit_vector(value: Any) -> tuple[float, ...]:
    """Return a direction of 3 numbers as unit vector; the zero vector is refused."""
    elements = _numbers(value, 3, "3 numbers that give a direction")
    length = hypot(*elements)
    if length == 0.0:
        raise refusal("a direction", "the zero vector")
    if isinf(length):
        raise refusal("a direction", describe(value))
    return tuple(element / length for element in elements)


def uncertainty_vector(count: int, each: str = "") -> Callable[[Any], tuple[float, ...]]:
    """Return a validator of `count` standard uncertainties; `each`: their description.

    Without it one number applies to all.
    """
    expected = f"{count} numbers ({each}), none negative" if each else f"a number or {count} numbers, none negative"

    def check(value: Any) -> tuple[float, ...]:
        one_for_all = not each and is_number(value)
        elements = (float(value),) * count if one_for_all else _numbers(value, count, expected)
        if min(elements) < 0:
            raise refusal(expected, f"{min(elements):g}", declared=VALUE_OUT_OF_RANGE)
        return elements

    return check


def each_of(count: int) -> Callable[[Any], tuple[float, ...]]:
    """Return a validator of `count` numbers, or of one that applies to all."""
    expected = f"a number or {count} numbers"
    return lambda value: (float(value),) * count if is_number(value) else _numbers(value, count, expected)


def positive(check: Callable[[Any], tuple[float, ...]], expected: str) -> Callable[[Any], tuple[float, ...]]:
    """Return a validator of numbers above 0, based on another validator."""

    def above_zero(value: Any) -> tuple[float, ...]:
        numbers = check(value)
        if min(numbers) <= 0:
            raise refusal(expected, f"{min(numbers):g}", declared=VALUE_OUT_OF_RANGE)
        return numbers

    return above_zero


def exposure(value: Any) -> float | str:
    """Return an exposure time in s, or the word for trigger pulses or video files."""
    if value in (PULSE, FILE):
        return str(value)
    if not is_number(value) or value < 0:
        words = f'"{PULSE}" for the width of the trigger pulses, or "{FILE}" for the time in a video file'
        raise refusal(f"a number of at least 0, or {words}", describe(value))
    return float(value)


def rotation(value: Any) -> tuple[tuple[float, ...], ...]:
    """Return a rotation matrix: orthonormal to 1e-6, determinant +1."""
    rows = _matrix3(value)
    array = np.array(rows)
    error = float(np.abs(array @ array.T - np.eye(3)).max())
    if error > ORTHONORMAL_TOLERANCE:
        raise refusal("a rotation matrix, orthonormal to 1e-6", f"rows that deviate by {error:.2g}")
    if np.linalg.det(array) < 0:
        raise refusal("a rotation matrix with determinant +1", "determinant -1, a mirror image")
    return rows


def inertia(value: Any) -> tuple[tuple[float, ...], ...]:
    """Return a possible inertia tensor: symmetric, no principal moment above the sum of the others.

    All zeros is a point mass. The tolerance of the sum allows for tables rounded to two or three digits.
    """
    rows = _matrix3(value)
    array = np.array(rows)
    largest = float(np.abs(array).max())
    row, column = np.unravel_index(int(np.abs(array - array.T).argmax()), (3, 3))
    if abs(array[row, column] - array[column, row]) > SYMMETRY_TOLERANCE * largest:
        pair = f"{array[row, column]:g} in row {row + 1}, column {column + 1}"
        raise refusal(
            "a symmetric matrix",
            f"{pair} and {array[column, row]:g} in the opposite element",
            declared=IMPOSSIBLE_MASS_PROPERTIES,
        )
    low, middle, high = (float(moment) for moment in np.linalg.eigvalsh((array + array.T) / 2))
    if low < -SYMMETRY_TOLERANCE * largest:
        raise refusal(
            "an inertia with positive principal moments",
            f"the principal moment {low:g} kg m^2",
            declared=IMPOSSIBLE_MASS_PROPERTIES,
        )
    if high > low + middle + ROUNDING_TOLERANCE * high:
        moments = f"{low:g}, {middle:g} and {high:g} kg m^2"
        raise refusal(
            "principal moments of which none exceeds the sum of the others",
            moments,
            declared=IMPOSSIBLE_MASS_PROPERTIES,
        )
    return rows


def inertia_spread(value: Any) -> tuple[tuple[float, ...], ...]:
    """Return standard uncertainties of an inertia's elements: one number for all, or a symmetric matrix."""
    rows = ((float(value),) * 3,) * 3 if is_number(value) else _matrix3(value)
    array = np.array(rows)
    if array.min() < 0 or not np.allclose(array, array.T):
        raise refusal(
            "one number or a symmetric matrix of 3 rows of 3 numbers, none negative",
            "another matrix",
            declared=WRONG_VALUE_TYPE,
        )
    return rows


def _version(value: Any) -> int:
    """Return the version of a file's format; `true` is not 1."""
    if type(value) is not int or value != 1:
        raise refusal("1, the version of the format", describe(value))
    return value


def texts(value: Any) -> tuple[str, ...]:
    """Return a list of different, non-empty texts."""
    if not isinstance(value, list | tuple) or not all(isinstance(item, str) and item for item in value):
        raise refusal("a list of texts", describe(value), declared=WRONG_VALUE_TYPE)
    repeated = repeated_name(value)
    if repeated is not None:
        raise refusal("different names", f'"{repeated}" twice', declared=REPEATED_NAME)
    return _counted(value)


def _counted(value: Sequence[Any]) -> tuple[Any, ...]:
    """Return a list as a tuple, refused if it is too long."""
    if len(value) > MOST_ITEMS:
        raise refusal(f"at most {MOST_ITEMS}", f"{len(value)}", declared=VALUE_OUT_OF_RANGE)
    return tuple(value)


def array_of_tables(value: Any) -> Any:
    """Return an array of tables as a tuple."""
    if not isinstance(value, list | tuple):
        raise refusal("blocks in double brackets, [[…]]", describe(value), declared=WRONG_VALUE_TYPE)
    return _counted(value)


def existing(resolve: Callable[[PathScope, str], Any], expected: str) -> Callable[[Any, ValidationInfo], Any]:
    """Return a validator of paths; `resolve` uses the scope of the manifest."""

    def check(value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, Path | tuple):  # resolved before
            return value
        if not isinstance(value, str):
            raise refusal(expected, describe(value), declared=WRONG_VALUE_TYPE)
        if not isinstance(info.context, Context):
            raise refusal("a resolved path", "a text outside any manifest")
        try:
            return resolve(info.context.scope, value)
        except OSError as error:
            found = f"{error.strerror or error} ({describe(str(error.filename), plain=True)})"
            raise refusal("a path that can be read", found, declared=UNREADABLE_FILE) from error

    return check


def repeated_name(names: Sequence[str]) -> str | None:
    """Return the first repeated name, or None."""
    seen: set[str] = set()
    return next((name for name in names if name in seen or seen.add(name)), None)  # type: ignore[func-returns-value]


def refuse_missing(block: ManifestBlock, required: Sequence[str], why: str) -> None:
    """Refuse a table without a key that its kind requires."""
    for key in required:
        if getattr(block, key) is None:
            raise refusal(f"this key, required for {why}", "no such key", key=key, declared=MISSING_KEY)


def refuse_foreign(block: ManifestBlock, applicable: Collection[str], why: str) -> None:
    """Refuse a key that has no meaning for the kind of a table."""
    for key in type(block).model_fields:
        if key in block.model_fields_set and key not in applicable:
            raise refusal(f"no such key for {why}", describe(getattr(block, key)), key=key, declared=KEY_NOT_APPLICABLE)


RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
"""Names of devices on Windows, with any suffix after a dot."""


def refuse_as_file_names(names: Collection[str], key: str) -> None:
    """Refuse names for files that some file system does not accept or distinguish."""
    seen: dict[str, str] = {}
    for name in names:
        wrong = re.search(r'[\x00-\x1f\x7f/\\:*?"<>|]', name)
        if not name or wrong or name[-1] in ". " or name[0] in " -" or len(name.encode()) > LONGEST_FILE_NAME:
            expected = (
                f"a name of at most {LONGEST_FILE_NAME} bytes that is valid in a file name, such as motion-NAME.csv"
            )
            raise refusal(expected, f'"{describe(name, plain=True)}"', key=key, declared=NAME_NOT_USABLE_IN_FILES)
        if name.partition(".")[0].lower() in RESERVED:
            raise refusal(
                "a name other than those of devices on Windows", f'"{name}"', key=key, declared=NAME_NOT_USABLE_IN_FILES
            )
        twin = seen.setdefault(unicodedata.normalize("NFKC", name).casefold(), name)
        if twin != name:
            raise refusal(
                f'a name that differs from "{twin}" by more than case',
                f'"{name}"',
                key=key,
                declared=NAME_NOT_USABLE_IN_FILES,
            )


def refuse_repeated(names: Sequence[str], what: str, key: str) -> None:
    """Refuse two blocks with the same name."""
    twice = repeated_name(names)
    if twice is not None:
        raise refusal(f"{what} of different names", f'"{twice}" twice', key=key, declared=REPEATED_NAME)


def size_range(low: float, high: float, unit: str, **others: float) -> AfterValidator:
    """Return a validator of numbers of a size from `low` to `high`, or 0.

    `others`: factors of units that users confuse with it. The refusal names one in which the number would be valid.
    """

    def check(value: Any) -> Any:
        for number in (value,) if isinstance(value, int | float) else value if isinstance(value, tuple) else ():
            size = abs(number)
            if size and not low <= size <= high:
                usual = [f" ({number * one:g} {unit} if meant in {name})" for name, one in others.items()]
                fits = [text for text, one in zip(usual, others.values(), strict=True) if low <= size * one <= high]
                limits = f"{low:g} to {high:g}" if size < low else f"at most {high:g}"
                raise refusal(
                    f"{limits} {unit}".strip(), f"{number:g}{next(iter(fits), '')}", declared=VALUE_OUT_OF_RANGE
                )
        return value

    return AfterValidator(check)


NEAR = size_range(0.0, 5.0, "m", mm=1e-3)
FAR = size_range(0.0, 100.0, "m", mm=1e-3)
WEIGHT = size_range(1e-9, 1e5, "kg", g=1e-3)
DENSITY = size_range(10.0, 1e12, "kg/m^3", **{"g/cm^3": 1e3})
MODULUS = size_range(1e4, 2e12, "Pa", GPa=1e9, MPa=1e6)
SHARE = size_range(0.0, 1.0, "", percent=1e-2, ppm=1e-6)
RADIANS = size_range(0.0, 3.15, "rad", degrees=np.pi / 180)
SECONDS = size_range(0.0, 10.0, "s", ms=1e-3, µs=1e-6)
ROWS = size_range(1e-10, 1e-3, "s", µs=1e-6, ns=1e-9)
HERTZ = size_range(1e-4, 1e8, "Hz")
"""Possible ranges of keys: sizes beyond suggest another unit."""
Number = Annotated[float, Field(allow_inf_nan=False)]
Celsius = Annotated[float, Field(ge=-100, le=200, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Version = Annotated[Literal[1], BeforeValidator(_version)]
Text = Annotated[str, Field(min_length=1)]
Texts = Annotated[tuple[str, ...], BeforeValidator(texts)]
Exposure = Annotated[float | Literal["pulse", "file"], BeforeValidator(exposure), SECONDS]
FreeVector = Annotated[Vector3, BeforeValidator(vector(3))]
Position = Annotated[FreeVector, NEAR]
Share = Annotated[NotNegative, SHARE]
Angle = Annotated[NotNegative, RADIANS]
Mass = Annotated[Positive, WEIGHT]
Delay = Annotated[Number, SECONDS]
RowTime = Annotated[tuple[float, float], BeforeValidator(each_of(2)), ROWS]
Direction = Annotated[Vector3, BeforeValidator(unit_vector)]
Uncertainty3 = Annotated[Vector3, BeforeValidator(uncertainty_vector(3))]
PoseUncertainty = Annotated[Vector6, BeforeValidator(uncertainty_vector(6, "3 in m, 3 in rad"))]
Region = Annotated[Outline, BeforeValidator(outline)]
Mask = Annotated[tuple[Outline, ...], BeforeValidator(outlines)]
Rotation = Annotated[Matrix3, BeforeValidator(rotation)]
Inertia = Annotated[Matrix3, BeforeValidator(inertia)]
InertiaUncertainty = Annotated[Matrix3, BeforeValidator(inertia_spread)]
ExistingFile = Annotated[Path, BeforeValidator(existing(PathScope.file, "a path"))]
ExistingFiles = Annotated[
    tuple[Path, ...], BeforeValidator(existing(PathScope.files, "a path or a pattern such as folder/*.tif"))
]

ZERO3: Vector3 = (0.0, 0.0, 0.0)
ZERO6: Vector6 = (0.0,) * 6
ZERO33: Matrix3 = (ZERO3, ZERO3, ZERO3)


class SurfacePlane(ManifestBlock):
    """The plane of the face before a single camera, at rest, in the sensor frame.

    `point`: m. `distance_uncertainty`: m along the normal. `tilt_uncertainty`: rad about each of two axes across it.
    They describe drawing and mounting, in addition to the uncertainty of the camera's pose.
    """

    point: Position
    normal: Direction
    distance_uncertainty: Annotated[NotNegative, NEAR]
    tilt_uncertainty: Angle


class SensorOfCamera(ManifestBlock):
    """The image sensor of one camera: images or figures of its fixed pattern.

    `dark`: lens covered. `flat`: an even, unsharp surface. `prnu`: relative. `dsnu`: share of full scale.
    """

    dark: ExistingFiles = ()
    flat: ExistingFiles = ()
    prnu: Share | None = None
    dsnu: Share | None = None
