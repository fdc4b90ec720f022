"""3-D points computed by other image correlation programs, read from their tables."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photogram.images.sequence import check_file, wrap_read_errors
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.mat5 import check_mat5, load_mat

POSITION = ("x", "y", "z")
REFERENCE = ("x0", "y0", "z0")
IGNORED = "_"
MOST_BYTES = 256 << 20  # of a table
_MOST_ARRAYS = 10_000  # of a `.mat` file


@dataclass(frozen=True, eq=False, repr=False)
class PointTable(Arrays, shapes="frames F; position_m F N 3; reference_m N 3; u_m F N 3"):
    """Points of F frames, matched by identity or row.

    Attributes
    ----------
    position_m : (F, N, 3), NaN where invalid.
    reference_m : (N, 3) where the files have it, else None.
    frames : (F) names.
    u_m : (F, N, 3) standard uncertainties of the program, None for none.
    program : whose layout the header has, empty where the caller named the columns.
    """

    position_m: FloatArray
    reference_m: FloatArray | None
    frames: tuple[str, ...]
    u_m: FloatArray | None = None
    program: str = ""


@dataclass(frozen=True, eq=False)
class _TableFrame:
    """Points of one frame in m, NaN where lost.

    identity (R, k): numbers that identify a point; positions (R, 3) in this and in the first frame.
    """

    name: str
    identity: FloatArray
    position_m: FloatArray
    reference_m: FloatArray | None = None
    u_m: FloatArray | None = None


def read_point_tables(
    files: Sequence[str | Path],
    columns: Sequence[str] | None = None,
    valid_status: float | None = None,
    scale: float | None = None,
) -> PointTable:
    """Read 3-D points of other programs from one table per frame.

    Parameters
    ----------
    files
        One table per frame, or one table with a column `frame`.
    columns
        Names from left to right: x y z (needed), x0 y0 z0 (reference), status (any number; all must equal
        `valid_status`), frame, names that begin with id (identity of a point), "_" (ignored). None (default): the
        header, or the file name, shows the layout of VIC-3D, ARAMIS, DICe, pyvale or MatchID.
    valid_status
        Value of status of a valid point; default None.
    scale
        Metres per unit of length. With `columns` 1 by default; without, the unit in the header (DICe states none: mm,
        its usual unit), which a given scale replaces.

    Returns
    -------
    PointTable
        Positions in m.

    Raises
    ------
    ValueError
        For a table that cannot be read; the text begins with its path.

    Notes
    -----
    Fields are separated by blanks, commas or semicolons (then with a decimal comma too). Lines before the first numeric
    one are a header.

    Examples
    --------
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
    paths, program = [Path(path) for path in files], ""
    if columns is not None:
        _check_columns(columns)
    for path in paths:
        check_file(path)
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"{path}: expected a table of at most {MOST_BYTES >> 20} MiB, found a larger file")
    if columns is None:
        program, frames = _header_frames(paths, scale)
    else:
        frames = _named_frames(paths, columns, valid_status, 1.0 if scale is None else scale)
    indices, count = _point_indices(frames)
    position = np.full((len(frames), count, 3), np.nan)
    u = np.full_like(position, np.nan)
    reference = np.full((count, 3), np.nan)
    for number, (frame, index) in enumerate(zip(frames, indices, strict=True)):
        valid = np.isfinite(frame.position_m).all(axis=1)
        position[number, index[valid]] = frame.position_m[valid]
        if frame.u_m is not None:
            u[number, index[valid]] = frame.u_m[valid]
        if frame.reference_m is not None:
            missing = valid & np.isnan(reference[index]).any(axis=1)
            reference[index[missing]] = frame.reference_m[missing]
    return PointTable(
        position,
        reference if frames[0].reference_m is not None else None,
        tuple(frame.name for frame in frames),
        u if all(frame.u_m is not None for frame in frames) else None,
        program,
    )


def _named_frames(
    paths: Sequence[Path], columns: Sequence[str], valid_status: float | None, scale: float
) -> list[_TableFrame]:
    """Return the frames of tables whose columns the caller names."""
    tables = []
    for path in paths:
        with wrap_read_errors(path):
            tables.append((str(path), _read_numbers(path, len(columns))))
    if "frame" in columns:
        if len(paths) > 1:
            raise ValueError(f"{paths[1]}: expected one file when there is a column frame, found {len(paths)}")
        rows = tables[0][1]
        number = rows[:, columns.index("frame")]
        tables = [(f"frame {k:g}", rows[number == k]) for k in np.unique(number)]
    frames = []
    for name, rows in tables:
        status = rows[:, [column == "status" for column in columns]]
        position = rows[:, [columns.index(name) for name in POSITION]] * scale
        valid = np.isfinite(position).all(axis=1) & (valid_status is None or (status == valid_status).all(axis=1))
        position[~valid] = np.nan
        before = None
        if REFERENCE[0] in columns:
            before = rows[:, [columns.index(name) for name in REFERENCE]] * scale
        frames.append(_TableFrame(name, rows[:, [column.startswith("id") for column in columns]], position, before))
    return frames


def _check_columns(columns: Sequence[str]) -> None:
    """Raise `ValueError` for an unknown or missing column, or one repeated but status and "_"."""
    allowed = {*POSITION, *REFERENCE, "status", "frame", IGNORED}
    for name in columns:
        if name not in allowed and not name.startswith("id"):
            raise ValueError(f"columns: expected one of {', '.join(sorted(allowed))} or id…, found {name!r}")
        if name not in ("status", IGNORED) and columns.count(name) > 1:
            raise ValueError(f"columns: expected {name} once, found it {columns.count(name)} times")
    for group in (POSITION, REFERENCE):
        present = [name for name in group if name in columns]
        if len(present) not in ((3,) if group is POSITION else (0, 3)):
            raise ValueError(f"columns: expected {' '.join(group)}, found {' '.join(present) or 'none of them'}")


def _point_indices(frames: Sequence[_TableFrame]) -> tuple[list[IntArray], int]:
    """Return the point of each row, by identity or order, and their number."""
    first = frames[0]
    named, count = first.identity.shape[1] > 0, len(first.position_m)
    for frame in frames:
        if not named and len(frame.position_m) != count:
            raise ValueError(
                f"{frame.name}: expected {count} rows as in {first.name}, found {len(frame.position_m)} "
                "(columns named id… identify points)"
            )
        if frame.identity.shape[1] != first.identity.shape[1]:
            raise ValueError(f"{frame.name}: expected the columns of {first.name}, found others")
        if named and len(np.unique(frame.identity, axis=0)) < len(frame.identity):
            raise ValueError(f"{frame.name}: expected every point's identity once, found one twice")
    if not named:
        return [np.arange(count)] * len(frames), count
    every = np.concatenate([frame.identity for frame in frames])
    identities, inverse = np.unique(every, axis=0, return_inverse=True)
    ends = np.cumsum([len(frame.identity) for frame in frames])
    return np.split(inverse.ravel(), ends[:-1]), len(identities)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text that are not blank, with their numbers."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    return ((number, line) for number, line in enumerate(lines, start=1) if line.strip())


def _read_numbers(path: Path, width: int) -> FloatArray:
    """Return the numeric rows (R, width) of a text table."""
    rows: list[list[float]] = []
    for number, line in _lines(path):
        fields = _fields(line)
        if not fields[0].startswith("#") and (rows or _is_number(fields[0])):
            rows.append(_row(path, number, fields, width))
    if not rows:
        raise ValueError(f"{path}: expected rows of {width} numbers, found none")
    return np.array(rows)


def _fields(line: str) -> list[str]:
    """Return the fields of a line, without blanks and quotes; semicolons permit the decimal comma."""
    fields = line.replace(",", ".").split(";") if ";" in line else line.split("," if "," in line else None)
    return [field.strip(' "\t') for field in fields]


def _row(path: Path, number: int, fields: Sequence[str], width: int, lost: Sequence[str] = ()) -> list[float]:
    """Return the numbers of a line, NaN for the texts `lost`."""
    if len(fields) != width:
        raise ValueError(f"{path}: line {number}: expected {width} columns, found {len(fields)}")
    try:
        return [math.nan if field.lower() in lost else float(field) for field in fields]
    except ValueError:
        column = next(n for n, field in enumerate(fields) if not _is_number(field, lost))
        raise ValueError(
            f"{path}: line {number}, column {column + 1}: expected a number, found {fields[column][:40]!r}"
        ) from None


def _is_number(field: str, lost: Sequence[str] = ()) -> bool:
    """Return whether the text is a number (nan included) or one of `lost`."""
    try:
        float(field)
    except ValueError:
        return field.lower() in lost
    return True


# Tables whose header shows their layout.

_LOST = ("", "nan", "non un numero reale", "non numérique", "n. def.", "neun")  # a missing number, as .NET writes it
_UNITS = {"m": 1.0, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "in": 0.0254}
_QUANTITY = re.compile(r"_([A-Za-z]+) *\[(\w+)\]\.csv$")
_MATRIX = "MatchID"


@dataclass(frozen=True)
class _Layout:
    """Names of a program's columns.

    Attributes
    ----------
    position : coordinates, of the first frame or (`moved`) of this one.
    moves : displacements since the first frame.
    identities : alternatives of columns that identify a point.
    u : standard uncertainties.
    flag : a column with its least value of a valid point.
    unit : used where the header states none; None where it must be stated.
    """

    program: str
    position: tuple[str, str, str]
    moves: tuple[str, str, str]
    identities: tuple[tuple[str, ...], ...]
    u: tuple[str, str, str] | None = None
    flag: tuple[str, float] | None = None
    unit: str | None = None
    moved: bool = False


def _axes(before: str, after: str = "", names: str = "XYZ") -> tuple[str, str, str]:
    return tuple(f"{before}{axis}{after}" for axis in names)  # type: ignore[return-value]


_LAYOUTS = (
    _Layout("VIC-3D", _axes(""), _axes("", names="UVW"), (("x", "y"), ("Index",)), _axes("Sigma_"), ("sigma", 0.0)),
    _Layout("ARAMIS", _axes("", "_undef", "xyz"), _axes("", names="uvw"), (("ID",),)),
    _Layout(
        "DICe", _axes("MODEL_COORDINATES_"), _axes("MODEL_DISPLACEMENT_"), (("COORDINATE_X", "COORDINATE_Y"),),
        flag=("SIGMA", 0.0), unit="mm",
    ),
    _Layout(
        "pyvale", _axes("stereo_", "_mm", "xyz"), _axes("stereo_disp_", "_mm", "uvw"), (("subset_x", "subset_y"),),
        flag=("stereo_converged", 1.0), unit="mm", moved=True,
    ),
)  # fmt: skip

_Columns = dict[str, tuple[str, FloatArray]]
"""Unit, empty for none, and values (R,) of every column by its name."""


def _header_frames(paths: Sequence[Path], scale: float | None) -> tuple[str, list[_TableFrame]]:
    """Return the program of these tables and their frames."""
    if any(_QUANTITY.search(path.name) for path in paths):
        return _MATRIX, _matrix_frames(paths, scale)
    found, frames = [], []
    for path in paths:
        with wrap_read_errors(path):
            columns = _mat_columns(path) if path.suffix.lower() == ".mat" else _text_columns(path)
        layout = next(
            (candidate for candidate in _LAYOUTS if {*candidate.position, *candidate.moves} <= set(columns)), None
        )
        if layout is None:
            names = ", ".join(list(columns)[:8]) or "none"
            programs = ", ".join(candidate.program for candidate in _LAYOUTS)
            raise ValueError(
                f"{path}: expected coordinates and displacements with the names of {programs}, "
                f"found {names}; name the columns of other programs"
            )
        frames.append(_frame(path, columns, layout, scale))
        found.append(layout.program)
        if layout.program != found[0]:
            raise ValueError(f"{path}: expected a table of {found[0]} as {paths[0]}, found one of {layout.program}")
    return found[0], frames


def _frame(path: Path, columns: _Columns, layout: _Layout, scale: float | None) -> _TableFrame:
    """Return the points of one table of a supported program."""

    def lengths(names: tuple[str, ...]) -> FloatArray:
        return np.stack(
            [columns[name][1] * _metres(path, name, columns[name][0] or layout.unit, scale) for name in names], 1
        )

    first_position, moves = lengths(layout.position), lengths(layout.moves)
    position, before = (
        (first_position, first_position - moves) if layout.moved else (first_position + moves, first_position)
    )
    position[(first_position == 0.0).all(axis=1)] = np.nan  # zeros represent missing points
    if layout.flag is not None and layout.flag[0] in columns:
        position[~(columns[layout.flag[0]][1] >= layout.flag[1])] = np.nan
    names: tuple[str, ...] = next((names for names in layout.identities if set(names) <= set(columns)), ())
    identity = np.stack([columns[name][1] for name in names], 1) if names else np.empty((len(position), 0))
    u = lengths(layout.u) if layout.u and set(layout.u) <= set(columns) else None
    return _TableFrame(str(path), identity, position, before, u)


def _metres(path: Path, name: str, unit: str | None, scale: float | None) -> float:
    """Return how many metres a file's unit of length is."""
    if scale is not None:
        return scale
    if unit is None:
        raise ValueError(f"{path}: {name}: expected a unit of length, found none; state scale")
    if unit not in _UNITS:
        raise ValueError(f"{path}: {name}: expected a length in {', '.join(_UNITS)}, found {unit}")
    return _UNITS[unit]


def _text_columns(path: Path) -> _Columns:
    """Return the columns of a text table by the names in its header."""
    rows: list[list[float]] = []
    names: list[str] = []
    for number, line in _lines(path):
        fields = _fields(line if rows else line.lstrip("# "))
        if not rows and not (any(map(_is_number, fields)) and all(_is_number(field, _LOST) for field in fields)):
            names = fields if len(fields) > 1 else names
            continue
        if fields[-1] == "" and len(fields) == len(names) + 1:
            fields.pop()
        rows.append(_row(path, number, fields, len(names), _LOST))
    if not rows:
        raise ValueError(f"{path}: expected a header and rows of numbers, found none")
    table, columns = np.array(rows), _Columns()
    for name, values_of in zip(names, table.T, strict=True):
        matched = re.fullmatch(r"(.*?)\s*(?:\[(.*)\])?", name)
        title, unit = (name, None) if matched is None else matched.groups()
        columns.setdefault(title, (unit or "", values_of))
    return columns


_MAT_NUMBERS = ("double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


def _mat_columns(path: Path) -> _Columns:
    """Return the arrays of a `.mat` file of the first coordinate's size, flat."""
    from scipy.io import whosmat

    check_mat5(path, MOST_BYTES, _MOST_ARRAYS)
    try:
        plain = {name: size for name, size, kind in whosmat(path) if kind in _MAT_NUMBERS}
        if sum(8 * math.prod(size) for size in plain.values()) > 1100 * path.stat().st_size:
            raise ValueError("more numbers declared than fit into a file of its length")
        found = load_mat(path, variable_names=list(plain))
    except Exception as error:  # any error of damaged bytes
        raise ValueError(f"{path}: expected a .mat file up to version 7, found {type(error).__name__} in it") from error
    arrays = {
        name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    }
    size = arrays["X"].size if "X" in arrays else 0
    return {name: ("", value.ravel().astype(np.float64)) for name, value in arrays.items() if value.size == size > 0}


def _matrix_frames(paths: Sequence[Path], scale: float | None) -> list[_TableFrame]:
    """Return the points of MatchID's matrices `FRAME_X[mm].csv` of X Y Z U V W."""
    frames: dict[str, dict[str, tuple[Path, str]]] = {}
    for path in paths:
        named = _QUANTITY.search(path.name)
        if named is None:
            raise ValueError(f"{path}: expected a name that ends in a quantity and its unit as _X[mm].csv, found none")
        quantities = frames.setdefault(str(path.with_name(path.name[: named.start()])), {})
        quantities[named[1].upper()] = path, named[2]
    points = []
    for name, quantities in frames.items():
        missing = [quantity for quantity in "XYZUVW" if quantity not in quantities]
        if missing:
            raise ValueError(
                f"{name}: expected matrices of X Y Z (first frame) and U V W, found none of {', '.join(missing)}"
            )
        values = {}
        for quantity, (path, unit) in quantities.items():
            if quantity in "XYZUVW":
                with wrap_read_errors(path):
                    values[quantity] = read_matrix(path) * _metres(path, quantity, unit, scale)
        if len({value.shape for value in values.values()}) > 1:
            raise ValueError(f"{name}: expected matrices of one size, found several")
        before, moves = (np.stack([values[axis].ravel() for axis in axes], 1) for axes in ("XYZ", "UVW"))
        points.append(_TableFrame(name, np.empty((len(before), 0)), before + moves, before))
    return points


def read_matrix(path: Path) -> FloatArray:
    """Return a matrix (rows, columns) of MatchID in the file's unit, NaN for missing numbers.

    No header; semicolons between and after the values; a decimal comma where the system has one.
    """
    rows: list[list[float]] = []
    for number, line in _lines(path):
        fields = [field.strip() for field in line.replace(",", ".").split(";")]
        fields = fields[:-1] if fields[-1] == "" else fields
        rows.append(_row(path, number, fields, len(rows[0]) if rows else len(fields), _LOST))
    if not rows:
        raise ValueError(f"{path}: expected rows of numbers, found none")
    return np.array(rows)
