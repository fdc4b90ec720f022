"""Universal files: every case of data set 58 and 58b, written byte by byte; shapes; pyuff as the second opinion."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import pyuff
import universal_factory as uff

from shaker.io import read_channels
from shaker.io import universal as sets
from shaker.io.universal import read_universal_functions, read_universal_shapes

RNG = np.random.default_rng(0)
X = 0.5 + np.arange(50) / 128.0
Y = RNG.normal(size=50) + 1j * RNG.normal(size=50)


def rounded(values: np.ndarray, kind: int) -> float:
    """Relative error of the text form: 6 digits or 13."""
    return 6e-13 if kind in (4, 6) else 6e-6


@pytest.mark.parametrize(("kind", "even"), uff.CASES)
def test_text_functions_of_all_eight_cases(tmp_path: Path, kind: int, even: bool) -> None:
    path = tmp_path / "a.uff"
    y = Y if kind in (5, 6) else Y.real
    path.write_bytes(uff.text_function(4, kind, X, y, even) + uff.text_function(1, 4, X, Y.real, True, "after"))
    function, last = read_universal_functions(path)
    np.testing.assert_allclose(function.value, y, rtol=rounded(y, kind), atol=6e-6)
    np.testing.assert_allclose(function.abscissa, X, rtol=6e-6)
    assert np.iscomplexobj(function.value) == (kind in (5, 6))
    assert (function.kind, function.unit, function.abscissa_unit) == ("frequency response", "(m/s^2)/(N)", "Hz")
    assert (function.response, function.reference, function.titles[0]) == ("12+Z", "7-X", "title")
    assert (last.name, last.kind, last.unit) == ("after", "time response", "m/s^2")
    assert list(read_channels(path)) == ["after"]


@pytest.mark.parametrize("after", [b"    -1\n", b"\r\n    -1\r\n", b"\n    -1\n"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("kind", "even"), uff.CASES)
def test_binary_functions_of_all_eight_cases(tmp_path: Path, kind: int, even: bool, order: str, after: bytes) -> None:
    path = tmp_path / "a.uff"
    y = Y if kind in (5, 6) else Y.real
    content = uff.binary_function(kind, X, y, even, order, after=after)
    path.write_bytes(content + uff.text_function(1, 4, X, Y.real, True, "after"))
    function, last = read_universal_functions(path)
    exact = y if kind in (4, 6) else y.astype("c8" if kind == 5 else "f4")
    np.testing.assert_array_equal(function.value, exact)
    np.testing.assert_allclose(function.abscissa, X, rtol=6e-6 if even else 6e-8)
    assert last.name == "after"


@pytest.mark.parametrize("kind", [4, 6])
def test_abscissa_of_double_precision_is_told_by_the_number_of_bytes(tmp_path: Path, kind: int) -> None:
    """The description says that the abscissa is single in the text form and leaves the binary open: both occur."""
    path = tmp_path / "a.uff"
    y = Y if kind == 6 else Y.real
    path.write_bytes(uff.binary_function(kind, X, y, False, "<", abscissa="f8"))
    function = read_universal_functions(path)[0]
    np.testing.assert_array_equal(function.abscissa, X)
    np.testing.assert_array_equal(function.value, y)


def test_end_mark_and_line_ends_among_the_numbers(tmp_path: Path) -> None:
    """Bytes that look like an end mark or a line end belong to the numbers: their count decides."""
    path = tmp_path / "a.uff"
    looks_like = np.frombuffer(b"\n    -1\n    -1\r\n  \n\n" + b"    -1\n\n    -1\n 123 ", "<f4")
    path.write_bytes(uff.binary_function(2, X, looks_like, True, "<") + uff.text_function(1, 2, X, X, True, "after"))
    first, second = read_universal_functions(path)
    np.testing.assert_array_equal(first.value.astype("<f4"), looks_like)
    assert second.name == "after"


def test_wrong_number_of_bytes_in_the_header_is_seen_through(tmp_path: Path) -> None:
    path = tmp_path / "a.uff"
    content = uff.binary_function(4, X, Y.real, True, ">")
    path.write_bytes(content.replace(f"{400:12d}".encode(), f"{0:12d}".encode()))
    np.testing.assert_array_equal(read_universal_functions(path)[0].value, Y.real)


@pytest.mark.parametrize("case", [("1     2", "1     3", "IBM 5/370"), ("1     2", "1     1", "DEC VMS")])
def test_foreign_number_formats_are_refused(tmp_path: Path, case: tuple[str, str, str]) -> None:
    path = tmp_path / "a.uff"
    content = uff.binary_function(4, X, Y.real, True, "<")
    path.write_bytes(content.replace(case[0].encode(), case[1].encode(), 1))
    with pytest.raises(ValueError, match=rf"a\.uff: line 2: expected .* IEEE 754 numbers, found .*{case[2]}"):
        read_channels(path)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [2, 4, 5, 6])
def test_pyuff_agrees_where_spacing_is_even(tmp_path: Path, kind: int, order: str) -> None:
    path = tmp_path / "a.uff"
    path.write_bytes(uff.binary_function(kind, X, Y if kind > 4 else Y.real, True, order))
    np.testing.assert_array_equal(read_universal_functions(path)[0].value, pyuff.UFF(str(path)).read_sets()["data"])


def test_names_that_occur_twice(tmp_path: Path) -> None:
    path = tmp_path / "a.uff"
    same = uff.text_function(1, 4, X, Y.real, True, "Mic")
    path.write_bytes(same + same.replace(b"        12   3", b"        13  -2") + same)
    assert list(read_channels(path)) == ["Mic 12+Z #1", "Mic 13-Y", "Mic 12+Z #3"]


def test_uneven_time_responses(tmp_path: Path) -> None:
    path = tmp_path / "a.uff"
    path.write_bytes(uff.binary_function(2, X, Y.real, False, "<"))
    assert read_channels(path)["12+Z"].sample_rate_hz == pytest.approx(128.0, rel=1e-6)
    path.write_bytes(uff.binary_function(2, X**2, Y.real, False, "<"))
    with pytest.raises(ValueError, match=r'a\.uff: channel "12\+Z": expected times in uniform steps'):
        read_channels(path)


def test_fields_without_blanks_and_free_fields(tmp_path: Path) -> None:
    """Exponents of three digits fill their fields; some programs keep to no widths at all; Fortran writes D."""
    path = tmp_path / "a.uff"
    values = np.array([-1.25e-101, -2.5e100, -3.75e-101, 4.0, -5e-300, 6.0, 7.0])
    full = [f"{value:.5E}".rjust(13) for value in values]
    frame = uff.text_function(1, 2, X[:7], values, True).split(b"\n")
    path.write_bytes(b"\n".join([*frame[:13], "".join(full[:6]).encode(), full[6].encode(), *frame[15:]]))
    np.testing.assert_array_equal(read_channels(path)["12+Z"].samples, values)
    free = b"-1.25D-101 -2.5D100 -3.75D-101 4 -5D-300\n6 7"
    path.write_bytes(b"\n".join([*frame[:13], free, *frame[15:]]))
    np.testing.assert_array_equal(read_channels(path)["12+Z"].samples, values)


def test_too_few_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.uff"
    lines = uff.text_function(1, 2, X, Y.real, True).split(b"\n")
    path.write_bytes(b"\n".join(lines[:14] + lines[15:]))
    with pytest.raises(ValueError, match=r"a\.uff: line 2: expected 50 numbers, found 44"):
        read_channels(path)


def test_large_text_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sets, "BLOCK", 500)
    path = tmp_path / "a.uff"
    y = RNG.normal(size=1003)
    path.write_bytes(uff.text_function(1, 4, np.arange(1003.0), y, True) + uff.binary_function(4, X, Y.real, True, "<"))
    first, second = read_universal_functions(path)
    np.testing.assert_allclose(first.value, y, rtol=1e-12)
    np.testing.assert_array_equal(second.value, Y.real)


def test_shapes(tmp_path: Path) -> None:
    path = tmp_path / "a.unv"
    node, real = [4, 12, 1], RNG.normal(size=(3, 3))
    value = real + 1j * RNG.normal(size=(3, 3))
    eigenvalue = (-2.0, 100.0)
    path.write_bytes(
        uff.shape(2, [106.25, 1.0, 0.01, 0.0], node, real)
        + uff.text_function(1, 2, X, Y.real, True)
        + uff.shape(5, [375.9], node, value, 12)
        + uff.shape(3, [*eigenvalue, 1.0, 0.0, 1.0, 0.0], node, value)
    )
    mode, deflection, complex_mode = read_universal_shapes(path)
    np.testing.assert_array_equal(mode.node, node)
    np.testing.assert_allclose(mode.value, real, rtol=1e-5)
    assert (mode.analysis, mode.frequency_hz, mode.damping_ratio) == ("normal mode", 106.25, 0.01)
    np.testing.assert_allclose(deflection.value, value, rtol=1e-5, atol=1e-6)
    assert (deflection.analysis, deflection.quantity) == ("frequency response", "acceleration")
    assert deflection.frequency_hz == 375.9
    assert np.isnan(deflection.damping_ratio)
    size = abs(complex(*eigenvalue))
    assert complex_mode.frequency_hz == pytest.approx(size / (2 * np.pi))
    assert complex_mode.damping_ratio == pytest.approx(2.0 / size)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
def test_shapes_as_pyuff_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "a.unv"
    value = RNG.normal(size=(5, 3)) + 1j * RNG.normal(size=(5, 3))
    path.write_bytes(uff.shape(5, [53.7], [1, 2, 3, 4, 5], value))
    own, other = read_universal_shapes(path)[0], pyuff.UFF(str(path)).read_sets()
    np.testing.assert_array_equal(own.node, other["node_nums"])
    np.testing.assert_array_equal(own.value[:, 0], other["r1"])
    np.testing.assert_array_equal(own.value[:, 2], other["r3"])


def test_damaged_shapes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.unv"
    lines = uff.shape(5, [53.7], [1, 2, 3], np.ones((3, 3), dtype=complex)).split(b"\n")
    for damaged in (lines[:-4] + lines[-3:], [*lines[:8], *lines[-2:]], [*lines[:11], b" x", *lines[12:]]):
        path.write_bytes(b"\n".join(damaged))
        with pytest.raises(ValueError, match=re.escape(str(path))):
            read_universal_shapes(path)
