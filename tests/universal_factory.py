"""Universal files byte by byte, from the published records of data sets 58, 58b and 55."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

CASES = [(kind, even) for kind in (2, 4, 5, 6) for even in (True, False)]


def header(
    function: int, kind: int, count: int, even: bool, start: float, step: float, name: str = "NONE"
) -> list[str]:
    """The text records 1 to 11 of a function."""
    spacing = (start, step) if even else (0.0, 0.0)
    return [
        *["title", "NONE", "21-NOV-26 10:00:00", "NONE", "NONE"],
        f"{function:5d}{0:10d}{0:5d}{0:10d} {name:10s}{12:10d}{3:4d} {'NONE':10s}{7:10d}{-1:4d}",
        f"{kind:10d}{count:10d}{int(even):10d}{spacing[0]:13.5E}{spacing[1]:13.5E}{0.0:13.5E}",
        f"{17 if function == 1 else 18:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'s' if function == 1 else 'Hz':20s}",
        f"{12:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'m/s^2':20s}",
        f"{13:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE' if function == 1 else 'N':20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE':20s}",
    ]


def text_function(function: int, kind: int, x: np.ndarray, y: np.ndarray, even: bool, name: str = "NONE") -> bytes:
    """A data set 58: the eight cases of record 12."""
    columns = ([] if even else [x]) + ([y.real, y.imag] if kind in (5, 6) else [y.real])
    double, uneven = kind in (4, 6), not even
    formats = [("%13.5E" if not double or (uneven and i == 0) else "%20.12E") for i in range(len(columns))]
    fields = [f % v for row in np.stack(columns, axis=1) for f, v in zip(formats, row, strict=True)]
    each = (4 if even else (3 if kind == 6 else 4)) if double else 6
    lines = ["".join(fields[i : i + each]) for i in range(0, len(fields), each)]
    head = header(function, kind, len(y), even, x[0], x[1] - x[0], name)
    return "\n".join(["    -1", "    58", *head, *lines, "    -1", ""]).encode()


def binary_function(
    kind: int, x: np.ndarray, y: np.ndarray, even: bool, order: str, abscissa: str = "f4", after: bytes = b"    -1\n"
) -> bytes:
    """A data set 58b: the same records, then the numbers of record 12 without field widths."""
    value = "f8" if kind in (4, 6) else "f4"
    types = ([] if even else [("x", order + abscissa)]) + [("re", order + value)]
    types += [("im", order + value)] if kind in (5, 6) else []
    rows = np.zeros(len(y), types)
    rows["re"] = y.real
    if kind in (5, 6):
        rows["im"] = y.imag
    if not even:
        rows["x"] = x
    first = f"{58:6d}b{1 if order == '<' else 2:6d}{2:6d}{11:12d}{rows.nbytes:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    function = 4 if kind in (5, 6) else 1
    head = header(function, kind, len(y), even, x[0], x[1] - x[0])
    return "\n".join(["    -1", first, *head, ""]).encode() + rows.tobytes() + after


def shape(analysis: int, numbers: Sequence[float], node: Sequence[int], value: np.ndarray, quantity: int = 8) -> bytes:
    """A data set 55: data at nodes, three components."""
    complex_values = np.iscomplexobj(value)
    lines = ["    -1", "    55", "shape", "NONE", "NONE", "NONE", "NONE"]
    lines.append("".join(f"{n:10d}" for n in (1, analysis, 2, quantity, 5 if complex_values else 2, value.shape[1])))
    lines.append("".join(f"{n:10d}" for n in (2, len(numbers), 0, 1)))
    lines.append("".join(f"{n:13.5E}" for n in numbers))
    for n, row in zip(node, value, strict=True):
        flat = np.stack([row.real, row.imag], axis=1).ravel() if complex_values else row
        lines += [f"{n:10d}", "".join(f"{v:13.5E}" for v in flat)]
    return "\n".join([*lines, "    -1", ""]).encode()
