"""3-D points computed by other image correlation programs, read from their text tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photogram.arrays import Arrays, FloatArray, IntArray

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
    tables = [(str(path), _read_numbers(Path(path), len(columns))) for path in files]
    if "frame" in columns:
        if len(files) > 1:
            raise ValueError(f"{files[1]}: expected one file when there is a column frame, found {len(files)}")
        rows = tables[0][1]
        number = rows[:, columns.index("frame")]
        tables = [(f"frame {k:g}", rows[number == k]) for k in np.unique(number)]
    places, count = _places(tables, [place for place, column in enumerate(columns) if column.startswith("id")])
    position = np.full((len(tables), count, 3), np.nan)
    reference = np.full((count, 3), np.nan)
    for frame, ((_, rows), place) in enumerate(zip(tables, places, strict=True)):
        status = rows[:, [column == "status" for column in columns]]
        here = rows[:, [columns.index(name) for name in POSITION]]
        valid = np.isfinite(here).all(axis=1) & (valid_status is None or (status == valid_status).all(axis=1))
        position[frame, place[valid]] = here[valid] * scale
        if REFERENCE[0] in columns:
            missing = valid & np.isnan(reference[place]).any(axis=1)
            reference[place[missing]] = rows[missing][:, [columns.index(name) for name in REFERENCE]] * scale
    return PointTable(position, reference if REFERENCE[0] in columns else None, tuple(name for name, _ in tables))


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


def _places(tables: Sequence[tuple[str, FloatArray]], columns: Sequence[int]) -> tuple[list[IntArray], int]:
    """Which points the rows of each table are, by their identity in `columns` or else by their order; and how many."""
    first, points = tables[0]
    for name, rows in tables:
        if not columns and len(rows) != len(points):
            raise ValueError(
                f"{name}: expected {len(points)} rows as in {first}, found {len(rows)} "
                "(columns named id… tell points apart)"
            )
        if columns and len(np.unique(rows[:, columns], axis=0)) < len(rows):
            raise ValueError(f"{name}: expected every point's identity once, found one twice")
    if not columns:
        return [np.arange(len(points))] * len(tables), len(points)
    every = np.concatenate([rows[:, columns] for _, rows in tables])
    identities, inverse = np.unique(every, axis=0, return_inverse=True)
    ends = np.cumsum([len(rows) for _, rows in tables])
    return np.split(inverse.ravel(), ends[:-1]), len(identities)


def _read_numbers(path: Path, width: int) -> FloatArray:
    """The numeric rows (R,width) of a text table; a semicolon lets the comma be a decimal comma."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    rows: dict[int, list[str]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", ".").split(";") if ";" in line else line.split("," if "," in line else None)
        fields = [field.strip() for field in fields]
        header = not rows and fields and not _is_number(fields[0])
        if not fields or fields[0].startswith("#") or header:
            continue
        if len(fields) != width:
            raise ValueError(f"{path}: line {number}: expected {width} columns, found {len(fields)}")
        rows[number] = fields
    if not rows:
        raise ValueError(f"{path}: expected rows of {width} numbers, found none")
    try:
        return np.array(list(rows.values()), dtype=np.float64)
    except ValueError:
        for number, fields in rows.items():
            for column, field in enumerate(fields, start=1):
                if not _is_number(field):
                    raise ValueError(
                        f"{path}: line {number}, column {column}: expected a number, found {field!r}"
                    ) from None
        raise


def _is_number(field: str) -> bool:
    """Whether the text is a number (nan included)."""
    try:
        float(field)
    except ValueError:
        return False
    return True
