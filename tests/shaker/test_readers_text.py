"""CSV, LVM, scans and universal files 58 and 58b: what programs write, by the byte; pyuff as the second opinion."""

import re
from pathlib import Path

import numpy as np
import pytest
import pyuff
import universal_factory as uff
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.io import read_channels, text
from shaker.io import universal as sets
from shaker.io.channel import RawChannel
from shaker.io.text import read_scan_asc
from shaker.io.universal import read_universal_functions, read_universal_shapes


def read(folder: Path, content: str | bytes, suffix: str = ".csv", rate: float | None = None) -> dict[str, RawChannel]:
    path = folder / f"a{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_channels(path, sample_rate_hz=rate)


@pytest.mark.parametrize(
    "content",
    [
        "time,Fz [N],Fx [kN]\n0.0,1.5,2\n0.5,2.5,3\n1.0,3.5,4\n",
        "Time [ms];Fz (N);Fx (kN)\r\n0;1,5;2\r\n500;2,5;3\r\n1000;3,5;4\r\n",
        "sep=;\nTime;Fz [N];Fx [kN]\ns;;\n0,0;1,5;2\n0,5;2,5;3\n1,0;3,5;4\n",
        '\ufeffTIME (us)\t"Fz"\tFx\n\tN\tkN\n0\t1.5\t2\n5e5\t2.5\t3\n1e6\t3.5\t4\n',
        "# recorder 7\n\ntime,Fz,Fx\ns,N,kN\n# begin\n0.0,1.5,2\n0.5,2.5,3\n# pause\n\n1.0,3.5,4\n",
        'time,"Fz","Fx"\n"s","N","kN"\n"0.0","1.5","2"\n"0.5","2.5","3"\n"1.0","3.5","4"',
        "time Fz Fx\ns   N kN\n 0.0  1.5 2\n0.5 2.5   3\n1.0 3.5\t4\n",
        "time;Fz;Fx;\ns;N;kN;\n0,0;1,5;2;\n0,5;2,5;3;\n1,0;3,5;4;\n",
        "time, Fz, Fx\ns, N, kN\n0.0, 1.5, 2\n0.5, +2.5, 3e0\n1.0, .35E1, 4.\n",
    ],
)
@pytest.mark.parametrize("block", [8, 1 << 20])
def test_csv_dialects(tmp_path, monkeypatch, content, block):
    monkeypatch.setattr(text, "BLOCK", block)
    found = read(tmp_path, content)
    force, other = (next(c for name, c in found.items() if name.startswith(start)) for start in ("Fz", "Fx"))
    np.testing.assert_array_equal(force.samples, [1.5, 2.5, 3.5])
    np.testing.assert_array_equal(other.samples, [2.0, 3.0, 4.0])
    assert (force.unit, other.unit) == ("N", "kN")
    assert force.sample_rate_hz == pytest.approx(2.0)


def test_csv_channels_answer_to_their_names_without_units(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('"Fz [N]",Fz [kN],"a, top (g)"\n1,2,3\n4,5,6\n')
    assert list(read_channels(path, sample_rate_hz=1.0)) == ["Fz [N]", "Fz [kN]", "a, top (g)"]
    assert read_channels(path, ["a, top"], 1.0)["a, top"].unit == "g"
    np.testing.assert_array_equal(read_channels(path, ["Fz [kN]"], 1.0)["Fz [kN]"].samples, [2.0, 5.0])
    refused(r'a\.csv: .*"Fz"', read_channels, path, ["Fz"], 1.0)
    # Columns of text do not matter to others.
    path.write_text("clock;Fz;state\n;N;\n12:00:01;1,5;ok\n12:00:02;2,5;late\n")
    np.testing.assert_array_equal(read_channels(path, ["Fz"], 1.0)["Fz"].samples, [1.5, 2.5])
    refused(r"a\.csv: line 3: .*'12:00:01;1,5;ok'", read_channels, path, ["Fz", "state"], 1.0)


def test_csv_latin_1_and_the_unit_1(tmp_path):
    found = read(tmp_path, "time;Drehung;Dehnung\ns;°;1\n0;1;2\n1;nan;4\n".encode("latin-1"))
    assert [channel.unit for channel in found.values()] == ["°", "1"]
    np.testing.assert_array_equal(found["Drehung"].samples, [1.0, np.nan])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("time,Fz\n0,1\n1,OVER\n2,3\n", "line 3: .*'1,OVER'"),
        ("time,Fz\n0,OVER\n1,2\n2,3\n", "line 2: .*'0,OVER'"),
        ("time,Fz\n0,1\n1,2,3\n", "line 3: .* 2 .* 3$"),
        ("time,Fz\n0,1\n1,2\n2\n", "line 4: .* 2 .* 1$"),
        ("time [V],Fz\n0,1\n1,2\n", "time.* 'V'"),
        ("time,Fz,Fz\n0,1,2\n1,2,3\n", "line 1: .*header"),
        ("time,Fz\ns,N\n", "line 3: .*rows"),
        ("", "header"),
        ("time,Fz\n0,1\n2,2\n1,3\n", "-1 s .* 1, 2 s"),
        ("1,2\n3,4\n", "line 1: .*header"),
        ("Fz\n1\n2\n", "sample_rate"),
    ],
)
@pytest.mark.parametrize("block", [6, 1 << 20])
def test_csv_errors(tmp_path, monkeypatch, content, message, block):
    monkeypatch.setattr(text, "BLOCK", block)
    refused(rf"a\.csv: .*{message}", read, tmp_path, content)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_whole_blocks_and_single_lines_read_the_same(tmp_path_factory, data):
    """Numbers of any spelling, empty cells, remarks and line ends: both ways agree with `float` to the last bit."""
    delimiter = data.draw(st.sampled_from([",", ";", "\t"]))
    number = st.floats(allow_nan=False, allow_infinity=False, width=64)
    cell = st.one_of(number.map(repr), number.map("{:.3e}".format), st.integers(-999, 999).map(str), st.just(""))
    columns = data.draw(st.integers(2, 4))
    rows = data.draw(st.lists(st.lists(cell, min_size=columns, max_size=columns), min_size=1, max_size=6))
    rows = [row if any(row) else ["0"] * columns for row in rows]
    expected = np.array([[float(c) if c else np.nan for c in row] for row in rows])
    end = data.draw(st.sampled_from(["\n", "\r\n"]))
    body = "".join(delimiter.join(row) + end for row in rows)
    if delimiter != ",":
        body = body.replace(".", data.draw(st.sampled_from([".", ","])))
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_bytes((delimiter.join(f"c{i}" for i in range(columns)) + end + body).encode())
    found = read_channels(path, sample_rate_hz=1.0)
    np.testing.assert_array_equal(np.stack([c.samples for c in found.values()], axis=1), expected)


def test_long_columns_grow_block_by_block(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "BLOCK", 1000)
    rng = np.random.default_rng(0)
    table = rng.normal(size=(5000, 3)) * 10.0 ** rng.integers(0, 9, (5000, 1))
    body = "\n".join(",".join(map(repr, row)) for row in table.tolist())
    found = read(tmp_path, "a,b,c\n" + body, rate=1.0)
    np.testing.assert_array_equal(np.stack([c.samples for c in found.values()], axis=1), table)


HEAD = "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\t{name}\nDecimal_Separator\t{point}\nX_Columns\t{x}\n"
END = "***End_of_Header***\t\n"


def lvm(body: str, channels: str, x: str = "No", separator: str = "\t", point: str = ".") -> str:
    name = {"\t": "Tab", ",": "Comma", ";": "Semicolon"}[separator]
    return (HEAD.format(name=name, point=point, x=x) + END + "\n" + channels + END + body).replace("\t", separator)


def test_lvm_with_a_time_column_of_every_channel(tmp_path):
    channels = "Channels\t2\nSamples\t3\t2\nX0\t0\t0\nDelta_X\t0.5\t1.0\nY_Unit_Label\tV\tA\n"
    body = "X_Value\tU\tX_Value\tI\tComment\n0.0\t1\t10.0\t4\t\n0.5\t2\t11.0\t5\tlate\n1.0\t3\t\t\t\n"
    found = read(tmp_path, lvm(body, channels, "Multi"), ".lvm")
    np.testing.assert_array_equal(found["U"].samples, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(found["I"].samples, [4.0, 5.0])
    assert [(c.sample_rate_hz, c.start_s, c.unit) for c in found.values()] == [(2.0, 0.0, "V"), (1.0, 10.0, "A")]


@pytest.mark.parametrize(("separator", "point"), [(",", "."), (";", ","), ("\t", ","), (";", ".")])
def test_lvm_separators(tmp_path, separator, point):
    channels = f"Channels\t2\nSamples\t2\t2\nDelta_X\t0{point}250000\t0{point}250000\n"
    body = f"X_Value\tU\tU\tComment\n\t1{point}5\t-2\n\t2{point}5E+1\t-3\n"
    found = read(tmp_path, lvm(body, channels, separator=separator, point=point), ".lvm")
    np.testing.assert_array_equal(found["U #1"].samples, [1.5, 25.0])
    np.testing.assert_array_equal(found["U #2"].samples, [-2.0, -3.0])
    assert found["U #1"].sample_rate_hz == 4.0


@pytest.mark.parametrize("block", [16, 100, 1 << 20])
def test_lvm_in_blocks(tmp_path, monkeypatch, block):
    """Headers and rows cut anywhere, remarks in some rows, special blocks passed over, line numbers of errors."""
    monkeypatch.setattr(text, "BLOCK", block)
    special = "***Start_Special***\t\nSamples\t99\nHarmonic\t3\n***End_Special***\t\n\n"
    channels = "Channels\t1\nSamples\t4\nX0\t{x0}\nDelta_X\t0.500000\n"
    body = "X_Value\tU\tComment\n\t1\ta remark, 7\n\t2\n\t3\t\n\t4\n\n"
    content = lvm(body, channels.format(x0=0)) + channels.format(x0=2) + END + body
    np.testing.assert_array_equal(read(tmp_path, content, ".lvm")["U"].samples, [1, 2, 3, 4, 1, 2, 3, 4])
    between = lvm(body, special + channels.format(x0=0)) + special + channels.format(x0=2) + END + body + special
    np.testing.assert_array_equal(read(tmp_path, between, ".lvm")["U"].samples, [1, 2, 3, 4, 1, 2, 3, 4])
    wrong = content[:-4] + "\tx\n"
    line = wrong.count("\n")
    refused(rf"a\.lvm: line {line}: .*'x'", read, tmp_path, wrong, ".lvm")


STAMPED = (
    "Channels\t1\nSamples\t{n}\nDate\t2020/08/06\nTime\t16:58:{second}\nY_Unit_Label\tVolts\nX0\t0\nDelta_X\t{step}\n"
)


def segments(second: str, point: str = ".") -> str:
    """Four samples from second 10.25 on, three from another second on."""
    parts = [STAMPED.format(n=n, second=s, step=f"0{point}500000") for n, s in ((4, "10.25"), (3, second))]
    rows = [
        "X_Value\tU\tComment\n" + "".join(f"\t{k}{point}25\t\n" for k in samples) for samples in (range(4), range(4, 7))
    ]
    return lvm(rows[0] + "\n", parts[0], point=point) + parts[1] + END + rows[1]


@pytest.mark.parametrize("point", [".", ","])
def test_lvm_segments_are_joined_and_pauses_stay(tmp_path, point):
    channel = read(tmp_path, segments("12.25", point), ".lvm")["U"]
    np.testing.assert_array_equal(channel.samples, np.arange(7) + 0.25)
    assert (channel.sample_rate_hz, channel.unit, channel.gap) == (2.0, "Volts", None)
    paused = read(tmp_path, segments("15.25", point), ".lvm")["U"]
    np.testing.assert_allclose(paused.time_s, [0.0, 0.5, 1.0, 1.5, 5.0, 5.5, 6.0], rtol=1e-12)
    assert re.match(r"3\.5 s .* 3 and 4,", str(paused.gap))
    refused(r"a\.lvm: .* 2\.0+ s.* 1\.0+ s", read, tmp_path, segments("11.25", point), ".lvm")


def test_lvm_column_of_a_decimated_file_rules_its_header(tmp_path):
    channels = STAMPED.format(n=100, second="10", step="0.001")
    body = "X_Value\tU\n" + "".join(f"{0.016 * i:.3f}\t{i}\n" for i in range(7))
    assert read(tmp_path, lvm(body, channels, "One"), ".lvm")["U"].sample_rate_hz == pytest.approx(62.5, rel=1e-12)
    with pytest.raises(ValueError, match=r" 100 .* 2$"):
        read(tmp_path, lvm("X_Value\tU\n\t1\n\t2\n", channels), ".lvm")


def _write_asc(path: Path, points: np.ndarray, blocks: np.ndarray, interval: float, by_rows: bool) -> None:
    """Write the layout that content.txt describes: points from line 19 on, acquisition, blocks with titles."""
    lines = [f"text {i}" for i in range(18)] + [" ".join(f"{v:.6f}" for v in p) for p in points]
    lines += ["", "acquisition", f"{blocks.shape[2]} {interval:.9g}"]
    for block in blocks:
        lines += ["", "Data block"]
        lines += [" ".join(f"{v:.9g}" for v in row) for row in (block.T if by_rows else block.reshape(-1, 1))]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("by_rows", [True, False])
@pytest.mark.parametrize("count", [1, 8])
def test_scanning_vibrometer_text(tmp_path, by_rows, count):
    rng = np.random.default_rng(0)
    points, blocks = rng.normal(size=(count, 3)), rng.normal(size=(3, count, 50))
    path = tmp_path / "Scan_time.asc"
    _write_asc(path, points, blocks, 1.0 / 51_200.0, by_rows)
    scan = read_scan_asc(path)
    np.testing.assert_allclose(scan.point_m, points, atol=1e-6)
    np.testing.assert_allclose(scan.samples, blocks, rtol=1e-8)
    assert scan.sample_rate_hz == pytest.approx(51_200.0)
    take = scan.channels_at(count - 1)
    assert list(take) == ["1", "2", "3"]
    np.testing.assert_array_equal(take["2"].samples, scan.samples[1, count - 1])
    np.testing.assert_array_equal(read_channels(path, [f"3/{count}"])[f"3/{count}"].samples, scan.samples[2, -1])
    path.write_text("\n".join(path.read_text().splitlines()[:-3]))
    torn = rf"Scan_time\.asc: .* {count} .* 50 .*{50 * count} "
    refused(torn, read_channels, path)


RNG, X = np.random.default_rng(0), 0.5 + np.arange(50) / 128.0
Y = RNG.normal(size=50) + 1j * RNG.normal(size=50)
VALUES = {2: Y.real, 4: Y.real, 5: Y, 6: Y}


@pytest.fixture
def path(tmp_path) -> Path:
    """A universal file to be written."""
    return tmp_path / "a.uff"


@pytest.mark.parametrize(("kind", "even"), uff.CASES)
def test_text_functions_of_all_eight_cases(path, kind, even):
    y = VALUES[kind]
    path.write_bytes(uff.text_function(4, kind, X, y, even) + uff.text_function(1, 4, X, Y.real, True, "after"))
    function, last = read_universal_functions(path)
    np.testing.assert_allclose(function.value, y, rtol=6e-13 if kind in (4, 6) else 6e-6, atol=6e-6)
    np.testing.assert_allclose(function.abscissa, X, rtol=6e-6)
    assert np.iscomplexobj(function.value) == (kind in (5, 6))
    assert (function.kind, function.unit, function.abscissa_unit) == ("frequency response", "(m/s^2)/(N)", "Hz")
    assert (function.response, function.reference, function.titles[0]) == ("12+Z", "7-X", "title")
    assert (last.name, last.kind, last.unit) == ("after", "time response", "m/s^2")
    assert list(read_channels(path)) == ["after"]


@pytest.mark.parametrize("after", [b"    -1\n", b"\r\n    -1\r\n", b"\n    -1\n"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("kind", "even"), uff.CASES)
def test_binary_functions_of_all_eight_cases(path, kind, even, order, after):
    y = VALUES[kind]
    content = uff.binary_function(kind, X, y, even, order, after=after)
    path.write_bytes(content + uff.text_function(1, 4, X, Y.real, True, "after"))
    function, last = read_universal_functions(path)
    exact = y if kind in (4, 6) else y.astype("c8" if kind == 5 else "f4")
    np.testing.assert_array_equal(function.value, exact)
    np.testing.assert_allclose(function.abscissa, X, rtol=6e-6 if even else 6e-8)
    assert last.name == "after"


def test_the_number_of_bytes_determines_the_precision_of_the_abscissa(path):
    """The description says that the abscissa is single in the text form and leaves the binary open: both occur."""
    for kind in (4, 6):
        path.write_bytes(uff.binary_function(kind, X, VALUES[kind], False, "<", abscissa="f8"))
        (function,) = read_universal_functions(path)
        np.testing.assert_array_equal(function.abscissa, X)
        np.testing.assert_array_equal(function.value, VALUES[kind])
    content = uff.binary_function(4, X, Y.real, True, ">")
    path.write_bytes(content.replace(f"{400:12d}".encode(), f"{0:12d}".encode()))
    np.testing.assert_array_equal(read_universal_functions(path)[0].value, Y.real)


def test_marks_within_numbers_are_numbers_and_foreign_or_missing_numbers_are_refused(path):
    """Bytes that look like an end mark or a line end belong to the numbers: their count decides."""
    looks_like = np.frombuffer(b"\n    -1\n    -1\r\n  \n\n" + b"    -1\n\n    -1\n 123 ", "<f4")
    path.write_bytes(uff.binary_function(2, X, looks_like, True, "<") + uff.text_function(1, 2, X, X, True, "after"))
    first, second = read_universal_functions(path)
    np.testing.assert_array_equal(first.value.astype("<f4"), looks_like)
    assert second.name == "after"
    content = uff.binary_function(4, X, Y.real, True, "<")
    for number, name in ((b"3", "IBM 5/370"), (b"1", "DEC VMS")):
        path.write_bytes(content.replace(b"1     2", b"1     " + number, 1))
        refused(rf"a\.uff: line 2: .* IEEE 754 .*{name}", read_channels, path)
    lines = uff.text_function(1, 2, X, Y.real, True).split(b"\n")
    path.write_bytes(b"\n".join(lines[:14] + lines[15:]))
    refused(r"a\.uff: line 2: .* 50 .* 44", read_channels, path)


def test_names_that_occur_twice_and_uneven_time_responses(path):
    same = uff.text_function(1, 4, X, Y.real, True, "Mic")
    path.write_bytes(same + same.replace(b"        12   3", b"        13  -2") + same)
    assert list(read_channels(path)) == ["Mic 12+Z #1", "Mic 13-Y", "Mic 12+Z #3"]
    path.write_bytes(uff.binary_function(2, X, Y.real, False, "<"))
    assert read_channels(path)["12+Z"].sample_rate_hz == pytest.approx(128.0, rel=1e-6)
    path.write_bytes(uff.binary_function(2, X**2, Y.real, False, "<"))
    np.testing.assert_allclose(read_channels(path)["12+Z"].time_s, X**2 - X[0] ** 2, rtol=1e-5)


def test_fields_without_blanks_and_free_fields(path):
    """Exponents of three digits fill their fields; some programs keep to no widths at all; Fortran writes D."""
    values = np.array([-1.25e-101, -2.5e100, -3.75e-101, 4.0, -5e-300, 6.0, 7.0])
    full = [f"{value:.5E}".rjust(13) for value in values]
    frame = uff.text_function(1, 2, X[:7], values, True).split(b"\n")
    path.write_bytes(b"\n".join([*frame[:13], "".join(full[:6]).encode(), full[6].encode(), *frame[15:]]))
    np.testing.assert_array_equal(read_channels(path)["12+Z"].samples, values)
    free = b"-1.25D-101 -2.5D100 -3.75D-101 4 -5D-300\n6 7"
    path.write_bytes(b"\n".join([*frame[:13], free, *frame[15:]]))
    np.testing.assert_array_equal(read_channels(path)["12+Z"].samples, values)


def test_large_text_in_blocks(path, monkeypatch):
    monkeypatch.setattr(sets, "BLOCK", 500)
    y = RNG.normal(size=1003)
    path.write_bytes(uff.text_function(1, 4, np.arange(1003.0), y, True) + uff.binary_function(4, X, Y.real, True, "<"))
    first, second = read_universal_functions(path)
    np.testing.assert_allclose(first.value, y, rtol=1e-12)
    np.testing.assert_array_equal(second.value, Y.real)


def test_shapes(path):
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
    assert (complex_mode.frequency_hz, complex_mode.damping_ratio) == pytest.approx((size / (2 * np.pi), 2.0 / size))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
def test_shapes_are_as_pyuff_reads_them_and_damaged_ones_refused(path):
    value = RNG.normal(size=(5, 3)) + 1j * RNG.normal(size=(5, 3))
    path.write_bytes(uff.shape(5, [53.7], [1, 2, 3, 4, 5], value))
    shape, other = read_universal_shapes(path)[0], pyuff.UFF(str(path)).read_sets()
    np.testing.assert_array_equal(shape.node, other["node_nums"])
    np.testing.assert_array_equal(shape.value[:, [0, 2]], np.stack([other["r1"], other["r3"]], axis=1))
    lines = uff.shape(5, [53.7], [1, 2, 3], np.ones((3, 3), dtype=complex)).split(b"\n")
    for damaged in (lines[:-4] + lines[-3:], [*lines[:8], *lines[-2:]], [*lines[:11], b" x", *lines[12:]]):
        path.write_bytes(b"\n".join(damaged))
        refused(re.escape(str(path)), read_universal_shapes, path)
