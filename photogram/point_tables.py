"""3-D points computed by other image correlation programs, read from their text tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray

POSITION = ("x", "y", "z")
REFERENCE = ("x0", "y0", "z0")
IGNORED = "_"


@dataclass(frozen=True, eq=False, repr=False)
class PointTable(Arrays, shapes="frames F; position_m F N 3; reference_m N 3"):
    """Points of F frames: position_m (F,N,3), NaN where invalid; reference_m (N,3) where the files have it; frames (F).

    Points are those with the same identity in all frames, or the same row where the tables have no identity.
    """

    position_m: FloatArray
    reference_m: FloatArray | None
    frames: tuple[str, ...]


@dataclass(frozen=True)
class _Frame:
    """One frame's rows: identity (R,I), position and reference (R,3), whether valid (R,)."""

    name: str
    identity: FloatArray
    position: FloatArray
    reference: FloatArray | None
    valid: BoolArray


def read_point_tables(
    files: Sequence[str | Path], columns: Sequence[str], valid_status: float | None = None, scale: float = 1.0
) -> PointTable:
    """Read one table per frame, or one table whose column `frame` numbers the frames; lengths times `scale` are metres.

    `columns` names the columns from left to right: x y z (needed), x0 y0 z0 (reference), status (any number; all must
    equal `valid_status`), frame, names that begin with id (identity of a point), "_" (ignored). Separated by blanks,
    commas or semicolons (then with a decimal comma too); lines before the first numeric one are a header.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "frame.csv").write_text("x;y;z\\n1;2;3\\n4;5;6,5\\n")
    ...     table = read_point_tables([f"{folder}/frame.csv"], ["x", "y", "z"], scale=1e-3)
    >>> table.position_m[0, 1]
    array([0.004 , 0.005 , 0.0065])
    """
    if not files:
        raise ValueError("files: expected at least one table, found none")
    _check_columns(columns)
    tables = [(path, _read_numbers(Path(path), len(columns))) for path in files]
    if "frame" in columns:
        if len(files) > 1:
            raise ValueError(f"{files[1]}: expected one file when there is a column frame, found {len(files)}")
        numbers = tables[0][1]
        number = numbers[:, columns.index("frame")]
        frames = [_frame_of(f"frame {k:g}", numbers[number == k], columns, valid_status) for k in np.unique(number)]
    else:
        frames = [_frame_of(str(path), numbers, columns, valid_status) for path, numbers in tables]
    return _align(frames, scale)


def _check_columns(columns: Sequence[str]) -> None:
    """Every column has a known name, x y z are there, and only status and "_" come twice."""
    known = {*POSITION, *REFERENCE, "status", "frame", IGNORED}
    for name in columns:
        if name not in known and not name.startswith("id"):
            raise ValueError(f"columns: expected one of {', '.join(sorted(known))} or id…, found {name!r}")
        if name not in ("status", IGNORED) and columns.count(name) > 1:
            raise ValueError(f"columns: expected {name} once, found it {columns.count(name)} times")
    for group in (POSITION, REFERENCE):
        present = [name for name in group if name in columns]
        if len(present) not in ((3,) if group is POSITION else (0, 3)):
            raise ValueError(f"columns: expected {' '.join(group)}, found {' '.join(present) or 'none of them'}")


def _read_numbers(path: Path, width: int) -> FloatArray:
    """The numeric rows (R,width) of a text table."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = _fields(line)
        header = not rows and fields and not _is_number(fields[0])
        if not fields or fields[0].startswith("#") or header:
            continue
        if len(fields) != width:
            raise ValueError(f"{path}: line {number}: expected {width} columns, found {len(fields)}")
        rows.append(fields)
        lines.append(number)
    if not rows:
        raise ValueError(f"{path}: expected rows of {width} numbers, found none")
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:
        for fields, number in zip(rows, lines, strict=True):
            for column, field in enumerate(fields, start=1):
                if not _is_number(field):
                    raise ValueError(
                        f"{path}: line {number}, column {column}: expected a number, found {field!r}"
                    ) from None
        raise


def _fields(line: str) -> list[str]:
    """The fields of one line; a semicolon lets the comma be a decimal comma."""
    if ";" in line:
        fields = line.replace(",", ".").split(";")
    elif "," in line:
        fields = line.split(",")
    else:
        return line.split()
    return [field.strip() for field in fields]


def _is_number(field: str) -> bool:
    """Whether the text is a number (nan included)."""
    try:
        float(field)
    except ValueError:
        return False
    return True


def _frame_of(name: str, numbers: FloatArray, columns: Sequence[str], valid_status: float | None) -> _Frame:
    """One frame from its rows."""
    place = {column: index for index, column in enumerate(columns)}
    position = numbers[:, [place[column] for column in POSITION]]
    reference = numbers[:, [place[column] for column in REFERENCE]] if REFERENCE[0] in place else None
    identity = numbers[:, [index for index, column in enumerate(columns) if column.startswith("id")]]
    status = numbers[:, [index for index, column in enumerate(columns) if column == "status"]]
    accepted = np.ones_like(status, dtype=np.bool_) if valid_status is None else status == valid_status
    valid = np.asarray(np.hstack([np.isfinite(position), accepted]).all(axis=1))
    if identity.shape[1] and len(np.unique(identity, axis=0)) < len(identity):
        raise ValueError(f"{name}: expected every point's identity once, found one twice")
    return _Frame(name, identity, position, reference, valid)


def _align(frames: Sequence[_Frame], scale: float) -> PointTable:
    """All frames with the same points in the same order."""
    if frames[0].identity.shape[1] == 0:
        for frame in frames:
            if len(frame.position) != len(frames[0].position):
                raise ValueError(
                    f"{frame.name}: expected {len(frames[0].position)} rows as in {frames[0].name}, "
                    f"found {len(frame.position)} (columns named id… tell points apart)"
                )
        rows = [np.arange(len(frame.position)) for frame in frames]
        count = len(frames[0].position)
    else:
        every = np.concatenate([frame.identity for frame in frames])
        identities, inverse = np.unique(every, axis=0, return_inverse=True)
        rows = np.split(inverse.ravel(), np.cumsum([len(frame.identity) for frame in frames])[:-1])
        count = len(identities)
    position = np.full((len(frames), count, 3), np.nan)
    reference = np.full((count, 3), np.nan)
    for k, (frame, row) in enumerate(zip(frames, rows, strict=True)):
        position[k, row[frame.valid]] = frame.position[frame.valid] * scale
        if frame.reference is not None:
            missing = frame.valid & np.isnan(reference[row]).any(axis=1)
            reference[row[missing]] = frame.reference[missing] * scale
    names = tuple(frame.name for frame in frames)
    return PointTable(position, None if frames[0].reference is None else reference, names)
