"""Units of files are used or contradicted, never ignored."""

from __future__ import annotations

import numpy as np
import pytest
from bench_factory import ACCELERATION, FORCE_OUTPUT, LINE_HZ, MASS_KG, SENSITIVITY, Bench, write_bench
from support import edit, evaluated

from fusion.errors import InputError
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.recording_notices import (
    CERTIFIED_SCALE_UNIT,
    CONVERTER_CODES,
    RESPONSE_WITHOUT_UNIT,
    SCALE_CONTRADICTS_UNIT,
    SCALE_REQUIRED,
    UNIT_OF_ANOTHER_QUANTITY,
    UNKNOWN_FILE_UNIT,
)
from fusion.recording.units import recorded_unit

A = ACCELERATION
G = 9.80665
VELOCITY = A / (2j * np.pi * LINE_HZ)
UNIT_CODES = {
    declared.code
    for declared in (
        CERTIFIED_SCALE_UNIT,
        CONVERTER_CODES,
        RESPONSE_WITHOUT_UNIT,
        SCALE_CONTRADICTS_UNIT,
        UNIT_OF_ANOTHER_QUANTITY,
        UNKNOWN_FILE_UNIT,
    )
}


@pytest.mark.parametrize(
    ("texts", "factor"),
    [
        ("m/s²|m/s^2|m/s2|m/s/s|m s^-2|ms-2|m·s⁻²|m/s**2|[m/s^2]|M/S^2|m/sec^2", 1.0),
        ("mm/s²|mm/s^2", 1e-3),
        ("g|G|gn|g_n|g pk", G),
        ("mg", 1e-3 * G),
        ("m/s|mps", 1.0),
        ("µm/s|um/s|μm/s", 1e-6),
        ("V|v|Volts|volt|V rms", 1.0),
        ("mV|mv|MV|millivolts", 1e-3),
        ("mV/V|mv/v|MV/V", 1e-3),
        ("µV/V|uV/V", 1e-6),
        ("%", 1e-2),
        ("kN|kn", 1e3),
        ("in/s", 0.0254),
        ("deg/s|°/s|dps", np.pi / 180.0),
        ("|-|n/a|unit|EU|Nm|furlong", np.nan),
    ],
)
def test_spellings_of_units(texts, factor):
    found = [recorded_unit(text) for text in texts.split("|")]
    factors = [np.nan if unit is None else unit.factor for unit in found]
    assert factors == pytest.approx([factor] * len(found), rel=1e-12, nan_ok=True)
    assert len({unit and unit.dimension for unit in found}) == 1


RIGHT = {
    "si": {"acc": Bench(A, "m/s^2")},
    "not stated": {"acc": Bench(A, None)},
    "millimetres": {"acc": Bench(A * 1e3, "mm/s²")},
    "free fall": {"acc": Bench(A / G, "g")},
    "free fall with its scale": {"acc": Bench(A / G, "g", keys={"scale": G})},
    "volts with a scale": {"acc": Bench(A / 10.0, "V", keys={"scale": 10.0})},
    "velocity": {"acc": Bench(VELOCITY * 1e6, "µm/s", "velocity")},
    "output": {"Fz": Bench(FORCE_OUTPUT.phasor * 1e3, "mV/V", "output")},
    "output in per cent": {"Fz": Bench(FORCE_OUTPUT.phasor * 1e2, "%", "output")},
    "output of an amplifier": {"Fz": Bench(FORCE_OUTPUT.phasor * 500.0, "V", "output", {"scale": 2e-3})},
}


@pytest.mark.parametrize("case", RIGHT)
def test_multiples_of_the_unit_are_converted(tmp_path, case):
    channels = {"acc": Bench(A, "m/s^2"), "Fz": FORCE_OUTPUT, **RIGHT[case]}
    run = write_bench(tmp_path, channels)
    found = evaluated(run)
    assert abs(found.sensitivity.value[0, 0, 2] / SENSITIVITY - 1.0) < 1e-6
    assert abs(found.load.value[0, 2] / (MASS_KG * A) - 1.0) < 1e-6
    assert not {n.code for n in found.notices} & UNIT_CODES
    assert check(load_manifest(run)).problems == ()


MISSING = {
    "acceleration in V": ({"acc": Bench(A / 8.0, "V")}, "acc", "m/s^2 per V"),
    "velocity in mV": ({"acc": Bench(VELOCITY, "mV", "velocity")}, "acc", "m/s per mV"),
    "acceleration that is a velocity": ({"acc": Bench(VELOCITY, "m/s")}, "acc", "m/s^2 per m/s"),
    "codes": ({"acc": Bench(A * 100.0, "counts")}, "acc", "m/s^2 per counts"),
    "force in V": ({"cell": Bench(MASS_KG * A, "Volts", "force")}, "cell", "N per Volts"),
    "output in V": ({"Fz": Bench(FORCE_OUTPUT.phasor * 500.0, "V", "output")}, "Fz", "V/V per V"),
    "output in N": ({"Fz": Bench(MASS_KG * A, "N", "output")}, "Fz", "V/V per N"),
}


@pytest.mark.parametrize("case", MISSING)
def test_another_unit_needs_a_scale(tmp_path, case):
    channels, name, factor = MISSING[case]
    run = write_bench(tmp_path, {"acc": Bench(A, "m/s^2"), "Fz": FORCE_OUTPUT, **channels})
    with pytest.raises(InputError) as refused:
        evaluated(run)
    assert (refused.value.code, refused.value.file.name) == (SCALE_REQUIRED.code, "recording.toml")
    assert refused.value.key == f"daq.daq.channel.{name}.scale"
    assert factor in refused.value.values["expected"]
    assert any(f"channel.{name}.scale" in problem for problem in check(load_manifest(run)).problems)


def test_all_missing_scales_are_named_at_once(tmp_path):
    run = write_bench(tmp_path, {"acc": Bench(A, "V"), "Fz": Bench(1e-3, "V", "output")})
    with pytest.raises(InputError) as refused:
        evaluated(run)
    assert [error.key.split(".")[-2] for error in refused.value.each] == ["acc", "Fz"]


SUSPICIOUS = {
    "unknown": ({"acc": Bench(A, "EU")}, UNKNOWN_FILE_UNIT, {"unit": "EU"}),
    "free fall as if it were si": (
        {"acc": Bench(A / G, "g", keys={"scale": 1.0})},
        SCALE_CONTRADICTS_UNIT,
        {"unit": "g", "factor": G, "scale": 1.0},
    ),
    "si times two": (
        {"acc": Bench(A, "m/s^2", keys={"scale": 2.0})},
        SCALE_CONTRADICTS_UNIT,
        {"unit": "m/s^2", "factor": 1.0, "scale": 2.0},
    ),
    "velocity as acceleration": (
        {"acc": Bench(A, "m/s", keys={"scale": 1.0})},
        UNIT_OF_ANOTHER_QUANTITY,
        {"unit": "m/s", "quantity": "acceleration"},
    ),
    "mV/V as V/V": (
        {"Fz": Bench(FORCE_OUTPUT.phasor, "mV/V", "output", {"scale": 1.0})},
        SCALE_CONTRADICTS_UNIT,
        {"unit": "mV/V", "factor": 1e-3},
    ),
}


@pytest.mark.parametrize("case", SUSPICIOUS)
def test_a_scale_that_contradicts_the_file_is_a_warning(tmp_path, case):
    channels, declared, values = SUSPICIOUS[case]
    run = write_bench(tmp_path, {"acc": Bench(A, "m/s^2"), "Fz": FORCE_OUTPUT, **channels})
    (notice,) = (n for n in evaluated(run).notices if n.code in UNIT_CODES)
    assert (notice.code, notice.severity) == (declared.code, "warning")
    for name, value in values.items():
        assert notice.values[name] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-12))
    assert any(notice.text in remark for remark in check(load_manifest(run)).remarks)


def test_a_scale_of_a_certificate_is_a_warning_if_the_file_is_in_millivolts(tmp_path):
    run = write_bench(tmp_path, {"acc": Bench(A, "mV", keys={"scale": 1.0}), "Fz": FORCE_OUTPUT})
    edit(run / "recording.toml", "scale = 1.0", 'scale = { value = 1.0, U = 1e-3, k = 2, certificate = "A-1" }')
    (notice,) = (n for n in evaluated(run).notices if n.code in UNIT_CODES)
    assert (notice.code, notice.values["unit"]) == (CERTIFIED_SCALE_UNIT.code, "mV")


RESPONSES = [
    # median magnitude, its unit, unit of the file, whether a scale is required
    (10.0e-3, "V/(m/s^2)", "V", False),
    (10.0, "mV/(m/s^2)", "V", False),
    (10.0e-3, None, "V", False),
    (1.0, "V/V", "V", True),
    (1.0, None, "V", True),
    (1.0, None, "m/s^2", False),
]


@pytest.mark.parametrize(("magnitude", "unit", "stated", "refused"), RESPONSES)
def test_a_response_in_V_per_unit_of_the_quantity_is_the_scale(tmp_path, magnitude, unit, stated, refused):
    columns = {key: key for key in ("frequency", "magnitude", "phase", "u_magnitude", "u_phase")}
    keys = {"response": "acc.csv"}
    text = block_with(columns | ({} if unit is None else {"magnitude_unit": unit}))
    factor = magnitude * (1e-3 if unit == "mV/(m/s^2)" else 1.0)
    run = write_bench(tmp_path, {"acc": Bench(A * factor, stated, keys=keys), "Fz": FORCE_OUTPUT})
    path = run / "recording.toml"
    path.write_text(path.read_text().replace('response = "acc.csv"\n', f'response = "acc.csv"\n{text}\n'))
    rows = [f"{hertz},{magnitude},0,{1e-3 * magnitude},0" for hertz in (10, 50, 100, 200, 1000, 2000)]
    (run / "acc.csv").write_text(",".join(columns) + "\n" + "\n".join(rows) + "\n")
    if refused:
        with pytest.raises(InputError, match=r"acc\.scale"):
            evaluated(run)
    else:
        assert abs(evaluated(run).load.value[0, 2] / (MASS_KG * A) - 1.0) < 1e-5


def block_with(columns):
    inside = ", ".join(f'{key} = "{value}"' for key, value in columns.items())
    return f"response_columns = {{ {inside} }}"
