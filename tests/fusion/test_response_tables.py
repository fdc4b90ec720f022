"""Tables of calibration systems as responses: columns by name, units, repeats; the same numbers as typed by hand."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import edit, evaluated

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ResponseColumns
from fusion.recording.plausibility_notices import LARGE_RESPONSE_UNCERTAINTY, RESPONSE_PHASE_MAY_BE_DEGREES
from fusion.recording.recording_notices import (
    AMBIGUOUS_PHASE_SIGN,
    INVALID_RESPONSE_VALUE,
    INVALID_VALUE,
    KEY_NOT_APPLICABLE,
    MISSING_KEY,
    PHASE_NOT_IN_RADIANS,
    RESPONSE_RANGE_TOO_SMALL,
    RESPONSE_UNIT_CONTRADICTION,
    UNREADABLE_RESPONSE_FILE,
    VALUE_OUT_OF_RANGE,
)
from fusion.recording.response import read_response, read_table

DEMO = Path(__file__).parents[2] / "sample_images" / "demo"
AT_HZ = np.array([10.0, 40.0, 80.0, 160.0, 500.0, 1000.0, 2000.0])
CHARGE = ResponseColumns(
    frequency="f",
    magnitude="S",
    phase="phi",
    u_magnitude="U(S)",
    u_phase="U(phi)",
    magnitude_unit="mV/(m/s^2)",
    phase_unit="deg",
    u_magnitude_unit="%",
    k=2.0,
)
KEY = (
    'response_columns = { frequency = "f", magnitude = "S", phase = "phi", u_magnitude = "U(S)", u_phase = "U(phi)", '
    'magnitude_unit = "mV/(m/s^2)", phase_unit = "deg", u_magnitude_unit = "%", k = 2.0 }'
)


def accelerometer(frequency_hz):
    """10.2 mV/(m/s²) with a mounted resonance at 28 kHz, of opposite sign."""
    ratio = frequency_hz / 28e3
    return -10.2e-3 / (1 - ratio**2 + 0.03j * ratio)


def german_table(path: Path, loops: int = 1, scatter: float = 0.0, suffix: str = ".csv") -> Path:
    """A table as European systems export it: semicolons, decimal commas, a row of units, loops one after the other."""
    rng = np.random.default_rng(3)
    lines = ["loop;f;S;phi;U(S);U(phi)", "1;Hz;mV/(m/s^2);deg;%;deg"]
    for loop in range(loops):
        for frequency, value in zip(AT_HZ, accelerometer(AT_HZ), strict=True):
            off, turn = scatter * rng.standard_normal(2)
            seen = value * (1 + off) * np.exp(1j * turn)
            row = (loop + 1, frequency, 1e3 * abs(seen), np.degrees(np.angle(seen)), 0.5, 0.4)
            lines.append(";".join(f"{cell:.12g}".replace(".", ",") for cell in row))
    table = path / f"calibration{suffix}"
    table.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return table


def test_a_table_of_a_calibration_system_is_read_by_its_own_columns(tmp_path):
    table = read_table(german_table(tmp_path), CHARGE)
    np.testing.assert_allclose(table.frequency_hz, AT_HZ)
    np.testing.assert_allclose(table.magnitude, np.abs(accelerometer(AT_HZ)), rtol=1e-10)
    np.testing.assert_allclose(np.exp(1j * table.phase_rad), np.exp(1j * np.angle(accelerometer(AT_HZ))), atol=1e-10)
    np.testing.assert_allclose(table.u_magnitude, 0.0025 * table.magnitude)
    np.testing.assert_allclose(table.u_phase_rad, np.radians(0.2))
    found = read_response(german_table(tmp_path), np.array([93.0, 700.0]), None, CHARGE)
    np.testing.assert_allclose(found.value, accelerometer(np.array([93.0, 700.0])), rtol=1e-4)


def test_loops_are_averaged_and_lessen_their_scatter_only(tmp_path):
    """Phases that lie around 180° are averaged on the circle; 400 loops of 1 % leave the stated 0.25 % and 0.05 %."""
    table = read_table(german_table(tmp_path, loops=400, scatter=0.01), CHARGE)
    assert len(table.frequency_hz) == len(AT_HZ)
    value = table.magnitude * np.exp(1j * table.phase_rad)
    assert np.abs(value / accelerometer(AT_HZ) - 1).max() < 4 * 0.01 / 20
    np.testing.assert_allclose(table.u_magnitude / table.magnitude, np.hypot(0.0025, 0.01 / 20), rtol=0.02)
    np.testing.assert_allclose(table.u_phase_rad, np.hypot(np.radians(0.2), 0.01 / 20), rtol=0.02)


def test_datasets_of_an_hdf5_file_are_columns(tmp_path):
    """Groups of datasets as PTB's programs store transfer functions, loops by loops, in rad and absolute units."""
    path, value = tmp_path / "TF.hdf5", accelerometer(np.tile(AT_HZ, 3))
    with h5py.File(path, "w") as file:
        group = file.create_group("TRANSFER/acceleration")
        group["Frequency"] = np.tile(AT_HZ, 3)
        group["Magnitude"], group["Magnitude_std"] = np.abs(value), 1e-3 * np.abs(value)
        group["Phase"], group["Phase_std"] = np.angle(value), np.full(len(value), 2e-3)
    names = ("Frequency", "Magnitude", "Phase", "Magnitude_std", "Phase_std")
    keys = ("frequency", "magnitude", "phase", "u_magnitude", "u_phase")
    columns = ResponseColumns(**{key: f"TRANSFER/acceleration/{name}" for key, name in zip(keys, names, strict=True)})
    table = read_table(path, columns)
    np.testing.assert_allclose(table.magnitude, np.abs(accelerometer(AT_HZ)))
    np.testing.assert_allclose(table.u_magnitude, 1e-3 * table.magnitude)
    np.testing.assert_allclose(table.u_phase_rad, 2e-3)


@pytest.mark.parametrize(
    ("change", "old", "new", "key", "code"),
    [
        ("table", ";S;", ";A;", "response_columns", UNREADABLE_RESPONSE_FILE),
        ("table", "10,2", "-10,2", "S", INVALID_RESPONSE_VALUE),
        ("table", ";0,5;", ";-0,5;", "U(S)", INVALID_RESPONSE_VALUE),
        ("table", "10,2", "x", "response_columns", UNREADABLE_RESPONSE_FILE),
        ("table", ";0,4", ";", "U(phi)", INVALID_RESPONSE_VALUE),
        ("table", ";160;", ";1e200;", "f", INVALID_RESPONSE_VALUE),
        ("manifest", '"mV/(m/s^2)"', '"mV per g"', "response_columns.magnitude_unit", INVALID_VALUE),
        ("manifest", '"deg"', '"grad"', "response_columns.phase_unit", INVALID_VALUE),
        ("manifest", "k = 2.0", "k = 0.0", "response_columns.k", VALUE_OUT_OF_RANGE),
        ("manifest", 'phase = "phi", ', "", "response_columns.phase", MISSING_KEY),
        ("manifest", "calibration.csv", "recording.toml", "response_columns", KEY_NOT_APPLICABLE),
    ],
)
def test_a_table_that_cannot_be_read_is_one_sentence(tmp_path, capsys, change, old, new, key, code):
    recording = with_response(tmp_path, f'response = "calibration.csv"\n{KEY}')
    german_table(recording)
    file = recording / ("calibration.csv" if change == "table" else "recording.toml")
    edit(file, old, new)
    assert main(["check", str(recording)]) == 2
    printed = capsys.readouterr()
    lines = [line for line in (printed.out + printed.err).splitlines() if code.code in line]
    assert len(lines) == 1, printed
    assert f"{key}: " in lines[0]
    assert file.name in lines[0]
    assert "Traceback" not in printed.err


PLAIN = {"frequency": "f", "magnitude": "S", "phase": "phi", "u_magnitude": "uS", "u_phase": "uphi"}
TYPED = ("frequency_hz", "magnitude", "phase_rad", "u_magnitude", "u_phase_rad")


def written(folder: Path, names, units, rows) -> Path:
    """A table of five columns with a row of units."""
    path = folder / "t.csv"
    lines = [",".join(names), *([",".join(units)] if units else []), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("units", "keys", "phase", "expected"),
    [
        (("Hz", "V", "rad", "V", "rad"), {}, 0.2, 0.2),
        (("Hz", "V", "deg", "%", "deg"), {}, 11.459156, 0.2),  # the file's units, where the user states none
        (("kHz", "V", "deg", "V", "rad"), {}, 11.459156, 0.2),
        (("rad/s", "", "mrad", "", "mrad"), {}, 200.0, 0.2),
        (None, {"phase_unit": "deg"}, 11.459156, 0.2),
        (None, {"phase": "phase lag"}, 0.2, -0.2),
        (("Hz", "V", "deg", "V", "deg"), {"phase_unit": "rad"}, 11.0, ("phi", RESPONSE_UNIT_CONTRADICTION)),
        (("Hz", "V", "rad", "V", "rad"), {"phase_unit": "deg"}, 11.0, ("phi", RESPONSE_UNIT_CONTRADICTION)),
        (("Hz", "mV", "rad", "mV", "rad"), {"magnitude_unit": "V"}, 0.2, ("S", RESPONSE_UNIT_CONTRADICTION)),
        (("Hz", "V", "rad", "V", "rad"), {"u_magnitude_unit": "%"}, 0.2, ("uS", RESPONSE_UNIT_CONTRADICTION)),
        (("Hz", "V", "rad", "mV", "rad"), {}, 0.2, ("uS", RESPONSE_UNIT_CONTRADICTION)),
        (("Hz", "dB", "rad", "dB", "rad"), {}, 0.2, ("S", RESPONSE_UNIT_CONTRADICTION)),
        (("s", "V", "rad", "V", "rad"), {}, 0.2, ("response_columns", UNREADABLE_RESPONSE_FILE)),  # f is the time axis
        (("Hz", "V", "gon", "V", "gon"), {}, 0.2, ("phi", RESPONSE_UNIT_CONTRADICTION)),
        (None, {"phase": "phase delay"}, 0.2, ("response_columns.phase", AMBIGUOUS_PHASE_SIGN)),
        (None, {"phase": "phase_lag"}, -0.2, ("response_columns.phase", AMBIGUOUS_PHASE_SIGN)),
        (None, {"phase": "phi (deg.)"}, 11.0, ("phi (deg.)", RESPONSE_UNIT_CONTRADICTION)),
        (None, {}, 180.0, ("phi", PHASE_NOT_IN_RADIANS)),
    ],
)
def test_units_and_signs_that_a_table_states_are_used_or_contradicted(tmp_path, units, keys, phase, expected):
    columns = ResponseColumns(**PLAIN | keys)
    factor = {"kHz": 1e-3, "rad/s": 2.0 * np.pi}.get((units or ("Hz",))[0], 1.0)
    share = 100.0 if units and units[3] == "%" else 2.0
    rows = [(factor * hertz, 2.0, phase, 0.002 * share, 0.001) for hertz in (50.0, 100.0, 200.0)]
    path = written(tmp_path, columns.names, units, rows)
    if isinstance(expected, tuple):
        key, declared = expected
        with pytest.raises(InputError) as caught:
            read_response(path, np.array([100.0]), None, columns)
        assert (caught.value.key, caught.value.code) == (key, declared.code)
    else:
        found = read_response(path, np.array([100.0]), None, columns)
        assert found.value[0] == pytest.approx(2.0 * np.exp(1j * expected), rel=1e-6)
        assert found.errors[0, 0].real == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("phases", "found"),
    [
        ((-0.1, -1.0, -3.0, 3.0), ""),  # wrapped
        ((-0.1, -3.0, -6.0, -9.0), ""),  # followed
        ((0.1, 3.0, 6.1, 3.0), ""),
        ((180.0, 179.5, 179.0, 178.0), "180"),
        ((-0.3, -2.0, -10.0, -40.0), "-40"),
        ((-7.0, -9.0, -11.0, -13.0), "-13"),
        ((-5.7, -5.7, -5.7, -5.7), "-5.7"),
        ((6.2, 0.1, 0.2, 0.3), ""),
        ((-3.3, -3.6, -4.0, -5.0), ""),  # of opposite sign, followed
    ],
)
def test_a_column_of_radians_cannot_be_in_degrees(tmp_path, phases, found):
    rows = [(hertz, 1.0, phase, 0.001, 0.001) for hertz, phase in zip((10, 20, 30, 40), phases, strict=True)]
    path = written(tmp_path, TYPED, None, rows)
    if found:
        with pytest.raises(InputError) as caught:
            read_table(path)
        error = caught.value
        assert (error.code, error.key, error.values["found"]) == (PHASE_NOT_IN_RADIANS.code, "phase_rad", found)
    else:
        assert read_table(path).phase_rad.tolist() == list(phases)


def test_a_line_at_the_end_of_a_table_is_in_range_for_any_clock(tmp_path):
    for hertz in ((80.0,), (80.0, 160.0), (20.0, 80.0)):
        path = written(tmp_path, TYPED, None, [(one, 2.0, 0.1, 0.002, 0.001) for one in hertz])
        for off in (-5e-5, 0.0, 5e-5):
            found = read_response(path, np.array([80.0 * (1 + off)]))
            assert found.value[0] == pytest.approx(2.0 * np.exp(0.1j), rel=1e-9)
            assert found.u_magnitude[0] == pytest.approx(0.001)


@pytest.mark.parametrize(
    ("hertz", "declared"),
    [
        ((10, 20, 20), INVALID_RESPONSE_VALUE),
        ((10, 30, 20), INVALID_RESPONSE_VALUE),
        ((10, 20, 30), RESPONSE_RANGE_TOO_SMALL),
    ],
)
def test_frequencies_ascend_and_reach_the_line(tmp_path, hertz, declared):
    path = written(tmp_path, TYPED, None, [(one, 1.0, 0.0, 0.001, 0.001) for one in hertz])
    with pytest.raises(InputError) as caught:
        read_response(path, np.array([40.0]))
    assert (caught.value.code, caught.value.key) == (declared.code, "frequency_hz")


def test_an_uncertainty_in_per_cent_is_a_warning(tmp_path):
    recording = with_response(tmp_path, 'response = "t.csv"')
    written(recording, TYPED, None, [(one, 1.0, 0.0, 0.5, 0.001) for one in (10, 80, 300)])
    (notice,) = load_manifest(recording).plausibility_notices
    assert notice.code == LARGE_RESPONSE_UNCERTAINTY.code
    assert (notice.values["u"], notice.values["frequency_hz"]) == pytest.approx((0.5, 80.0))


@pytest.mark.parametrize(
    ("magnitudes", "phase", "count"), [((1, 1, 1), -2.0, 1), ((1, 0.9, 0.5), -2.0, 0), ((1, 1, 1), 3.1, 0)]
)
def test_phases_that_may_be_degrees_are_a_warning(tmp_path, magnitudes, phase, count):
    recording = with_response(tmp_path, 'response = "t.csv"')
    rows = [(one, size, phase, 0.001, 0.001) for one, size in zip((10, 80, 300), magnitudes, strict=True)]
    written(recording, TYPED, None, rows)
    codes = [notice.code for notice in load_manifest(recording).plausibility_notices]
    assert codes.count(RESPONSE_PHASE_MAY_BE_DEGREES.code) == count


def with_response(folder: Path, text: str) -> Path:
    """The demo's recording whose accelerometer has its calibration in a response file."""
    shutil.copytree(DEMO, folder / "demo")
    recording = folder / "demo" / "Fz-0080"
    edit(recording / "recording.toml", 'quantity = "acceleration"\n', f'quantity = "acceleration"\n{text}\n')
    return recording


@pytest.mark.slow
def test_a_run_with_a_table_by_its_columns_is_one_with_the_table_typed(tmp_path):
    frequency = np.array(load_manifest(DEMO / "Fz-0080").excitation.frequencies)
    recording = with_response(tmp_path / "a", f'response = "calibration.csv"\n{KEY}')
    german_table(recording, loops=2)
    assert AT_HZ[0] < frequency.min() <= frequency.max() < AT_HZ[-1]
    by_columns = accelerometer_of(evaluated(recording))
    recording = with_response(tmp_path / "b", 'response = "typed.csv"')
    value = accelerometer(AT_HZ)
    lines = ["frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad"]
    for hertz, one in zip(AT_HZ, value, strict=True):
        row = (hertz, abs(one), np.angle(one), 0.0025 * abs(one), np.radians(0.2))
        lines.append(",".join(f"{float(cell):.15g}" for cell in row))
    (recording / "typed.csv").write_text("\n".join(lines), encoding="utf-8")
    typed = accelerometer_of(evaluated(recording))
    np.testing.assert_allclose(by_columns.phasors.value, typed.phasors.value, rtol=1e-9)
    plain = accelerometer_of(evaluated(with_response(tmp_path / "c", "")))
    ratio = plain.phasors.value / typed.phasors.value
    np.testing.assert_allclose(ratio[0], accelerometer(frequency[0]), rtol=1e-4)


def accelerometer_of(evaluation):
    """The channel of the accelerometer."""
    (channel,) = (own for own in evaluation.channels if own.name == "base_acceleration")
    return channel
