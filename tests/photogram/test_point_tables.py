"""Tables of other programs: layout of the published PTB data set, csv with a column frame, and wrong files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photogram.point_tables import read_point_tables

PTB = ["id_x", "id_y", "status", "status", "status", "x0", "y0", "z0", "x", "y", "z"]


def ptb_row(x: int, y: int, point: np.ndarray, moved: np.ndarray, status: str = "3 3 3") -> str:
    return f"{x} {y} {status} " + " ".join(f"{value:.6f}" for value in (*point, *moved))


def test_ptb_layout_with_millimetres_and_error_codes(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (3, 3))
    keys = [(4, 7), (4, 8), (5, 7)]
    files = []
    for frame in range(3):
        rows = [ptb_row(*key, point, point + frame) for key, point in zip(keys, points, strict=True)]
        if frame == 1:
            rows[1] = ptb_row(*keys[1], points[1], points[1] + 99, status="3 4 3")
        if frame == 2:
            rows = rows[::-1][:2]
        files.append(tmp_path / f"result_A{frame}.txt")
        files[-1].write_text("\n".join(rows) + "\n")
    table = read_point_tables(files, PTB, valid_status=3, scale=1e-3)
    assert table.position_m.shape == (3, 3, 3)
    assert table.reference_m is not None
    np.testing.assert_allclose(table.reference_m, points * 1e-3, atol=1e-9)
    np.testing.assert_allclose(table.position_m[2, 1:], (points[1:] + 2) * 1e-3, atol=1e-9)
    assert np.isnan(table.position_m).all(axis=2).tolist() == [
        [False, False, False],
        [False, True, False],
        [True, False, False],
    ]
    assert table.frames[1].endswith("result_A1.txt")


@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
def test_one_table_with_a_column_frame(tmp_path: Path, separator: str) -> None:
    rows = [["frame", "point", "x", "y", "z"]]
    rows += [
        [str(frame), str(n), f"{n}.5", str(frame), "nan" if n == 2 else "1e-1"] for n in range(3) for frame in (0, 1)
    ]
    decimal = (lambda text: text.replace(".", ",")) if separator == ";" else str
    path = tmp_path / "points.csv"
    path.write_text("\n".join(separator.join(decimal(field) for field in row) for row in rows))
    table = read_point_tables([path], ["frame", "id", "x", "y", "z"])
    assert table.reference_m is None
    assert table.frames == ("frame 0", "frame 1")
    np.testing.assert_allclose(table.position_m[1, :2], [[0.5, 1.0, 0.1], [1.5, 1.0, 0.1]])
    assert np.isnan(table.position_m[:, 2]).all()


def test_rows_are_points_where_there_is_no_identity(tmp_path: Path) -> None:
    paths = [tmp_path / "a.txt", tmp_path / "b.txt"]
    paths[0].write_text("1 2 3 8\n4 5 6 8\n")
    paths[1].write_text("# comment\n1 2 4 8\n\n4 5 7 8\n")
    table = read_point_tables(paths, ["x", "y", "z", "_"])
    np.testing.assert_allclose(table.position_m[1] - table.position_m[0], [[0, 0, 1], [0, 0, 1]])


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("1 2 3\n4 5\n", ["x", "y", "z"], r"t.txt: line 2: expected 3 columns, found 2"),
        ("1 2 3\n4 oops 6\n", ["x", "y", "z"], r"t.txt: line 2, column 2: expected a number, found 'oops'"),
        ("x y z\n", ["x", "y", "z"], r"t.txt: expected rows of 3 numbers, found none"),
        ("1 1 2 3\n1 1 2 3\n", ["id", "x", "y", "z"], r"t.txt: expected every point's identity once"),
        ("1 2 3\n", ["x", "y", "_"], r"columns: expected x y z, found x y"),
        ("1 2 3\n", ["x", "y", "depth"], r"columns: expected one of .*found 'depth'"),
        ("1 2 3 4\n", ["x", "y", "z", "x"], r"columns: expected x once, found it 2 times"),
        ("1 2 3 4\n", ["x", "y", "z", "x0"], r"columns: expected x0 y0 z0, found x0"),
    ],
)
def test_wrong_tables_are_named(tmp_path: Path, text: str, columns: list[str], message: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_point_tables([path], columns)


def test_missing_files_and_unequal_lengths_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1 2 3\n")
    (tmp_path / "b.txt").write_text("1 2 3\n4 5 6\n")
    with pytest.raises(OSError, match=r"c.txt: no such file"):
        read_point_tables([tmp_path / "c.txt"], ["x", "y", "z"])
    with pytest.raises(ValueError, match=r"b.txt: expected 1 rows as in .*a.txt, found 2"):
        read_point_tables([tmp_path / "a.txt", tmp_path / "b.txt"], ["x", "y", "z"])
    with pytest.raises(ValueError, match=r"files: expected at least one table"):
        read_point_tables([], ["x", "y", "z"])
