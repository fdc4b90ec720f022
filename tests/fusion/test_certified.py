"""Inputs from Digital Calibration Certificates: read as if typed, or an error with file and key."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from certificates import SIGNED
from support import example_with

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording import dcc
from fusion.recording import recording_notices as raised
from fusion.recording.certified import resolve_certificates
from fusion.recording.dsi import parse_unit
from fusion.recording.load import load_manifest
from fusion.recording.response import read_response
from fusion.recording.values import PathScope
from fusion.report.uncertainty_tables import inputs_table
from fusion.sensor.certificate.certificate_evaluation import _sources
from shakercal._common.notices import DeclaredNotice

ENVELOPED = (
    '<ds:Transform Algorithm="http://www.w3.org/2000/09/xmldsig#enveloped-signature"></ds:Transform>'
    '<ds:Transform Algorithm="http://www.w3.org/TR/2001/REC-xml-c14n-20010315"></ds:Transform>'
)
ALGORITHMS = {
    "sha1": "http://www.w3.org/2000/09/xmldsig#sha1",
    "sha224": "http://www.w3.org/2001/04/xmldsig-more#sha224",
    "sha256": "http://www.w3.org/2001/04/xmlenc#sha256",
    "sha384": "http://www.w3.org/2001/04/xmldsig-more#sha384",
    "sha512": "http://www.w3.org/2001/04/xmlenc#sha512",
}
REAL = Path(os.environ.get("SHAKERCAL_DATA", Path(__file__).parents[3] / "shared/data")) / "dcc"
TYPED = '{ value = 6.9605, U = 0.0020, k = 2, certificate = "K 7", laboratory = "Lab", date = 2026-03-01 }'
FROM_FILE = '{ dcc = "a.xml", result = "load mass" }'


def real(value: str, unit: str, uncertainty: str = "", k: str = "2", more: str = "") -> str:
    """One number with its U."""
    expanded = (
        f"<si:expandedUnc><si:uncertainty>{uncertainty}</si:uncertainty><si:coverageFactor>{k}</si:coverageFactor>{more}"
        "</si:expandedUnc>"
    )
    return f"<si:real><si:value>{value}</si:value><si:unit>{unit}</si:unit>{expanded if uncertainty else ''}</si:real>"


def many(value: str, unit: str, uncertainty: str = "", k: str = "2") -> str:
    """A list of numbers with their U."""
    expanded = (
        f"<si:expandedUncXMLList><si:uncertaintyXMLList>{uncertainty}</si:uncertaintyXMLList>"
        f"<si:coverageFactorXMLList>{k}</si:coverageFactorXMLList></si:expandedUncXMLList>"
    )
    return (
        f"<si:realListXMLList><si:valueXMLList>{value}</si:valueXMLList><si:unitXMLList>{unit}</si:unitXMLList>"
        f"{expanded if uncertainty else ''}</si:realListXMLList>"
    )


def result(name: str, *numbers: str, about: str = "") -> str:
    """A result with quantities, each a text of numbers, or a pair of its attributes and that."""
    quantities = "".join(f"<dcc:quantity {about}>{one}</dcc:quantity>" for one in numbers)
    title = f"<dcc:name><dcc:content>{name}</dcc:content></dcc:name>"
    return f"<dcc:result>{title}<dcc:data>{quantities}</dcc:data></dcc:result>"


def curve(name: str, frequency: str, magnitude: str, phase: str, unit: str = r"\volt\per\metre\second\tothe{2}") -> str:
    """A result over frequency, in rad, with U of 0.4 % and 4 mrad."""
    u = " ".join(f"{0.004 * float(value):.9g}" for value in magnitude.split()) or "1"
    parts = (
        ("vib_frequency", many(frequency, r"\hertz")),
        ("vib_magnitude", many(magnitude, unit, u)),
        ("vib_phase", many(phase, r"\radian", "0.004") if phase else ""),
    )
    quantities = "".join(
        f'<dcc:quantity refType="{kind}">{numbers}</dcc:quantity>' for kind, numbers in parts if numbers
    )
    return (
        f"<dcc:result><dcc:name><dcc:content>{name}</dcc:content></dcc:name><dcc:data><dcc:list>{quantities}"
        "</dcc:list></dcc:data></dcc:result>"
    )


def certificate(*results: str, statement: str = "") -> str:
    """A certificate K 7 of the laboratory Lab, dated 2026-03-01."""
    return (
        '<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si">'
        "<dcc:administrativeData><dcc:coreData><dcc:uniqueIdentifier>K 7</dcc:uniqueIdentifier>"
        "<dcc:endPerformanceDate>2026-03-01</dcc:endPerformanceDate></dcc:coreData><dcc:calibrationLaboratory><dcc:contact>"
        "<dcc:name><dcc:content>Lab</dcc:content></dcc:name></dcc:contact></dcc:calibrationLaboratory>"
        f"{statement}</dcc:administrativeData><dcc:measurementResults><dcc:measurementResult><dcc:results>"
        f"{''.join(results)}</dcc:results></dcc:measurementResult></dcc:measurementResults>"
        "</dcc:digitalCalibrationCertificate>"
    )


SEVEN = result("x", real("7", r"\kilogram", "0.01"), about='id="m1" refType="basic_mass"')
CONVENTIONAL = result("load mass", real("7", r"\kilogram", "1"), about='refType="mass_conventionalMass"')
FEW = result("m", real("7", r"\kilogram", "0.02776445", "2.776445"))
MASS = result("load mass", real("6960.5", r"\gram", "2.0"))
VOLUME = result("volume", real("880", r"\centi\metre\tothe{3}", "0.1"))


@pytest.fixture
def campaign(make_campaign):
    """Return a function that puts a certificate and an entry for a mass into a campaign, and gives its recording."""

    def made(text: str, entry: str = FROM_FILE, old: str = "mass = 6.9605", file: str = "rig.toml") -> Path:
        key = old.partition(" =")[0]
        more = (("rig.toml", "\nmass_uncertainty = 0.0010", ""),) if key == "mass" else ()
        recording = make_campaign(replace=((file, old, f"{key} = {entry}"), *more))
        folder = recording.parent if file == "rig.toml" else recording
        (folder / "a.xml").write_text(text, encoding="utf-8")
        return recording

    return made


def test_certificate_and_typed_values_give_the_same_inputs(campaign):
    recording = campaign(certificate(VOLUME, result("load mass", real("6.9605", r"\kilogram", "0.0020"))))
    read = load_manifest(recording)
    assert recording.parent / "a.xml" in read.files
    assert (recording.parent / "a.xml") in read.file_identities
    rig = recording.parent / "rig.toml"
    rig.write_text(rig.read_text().replace(FROM_FILE, TYPED))
    typed = load_manifest(recording)
    assert read.rig == typed.rig
    assert read.rig.load.mass_uncertainty == pytest.approx(0.001)
    key = next(item for item in read.inputs if item.key == "load.mass")
    same = next(item for item in typed.inputs if item.key == "load.mass")
    assert key.u == pytest.approx(same.u)
    assert key.source == same.source == "K 7, Lab, 2026-03-01"
    assert _sources(read.inputs) == _sources(typed.inputs)
    assert "K 7, Lab, 2026-03-01" in str(inputs_table(read.inputs))


def test_the_example_of_the_document_is_read(tmp_path):
    text = tomllib.loads(example_with("recording-format.md", "dcc ="))
    (tmp_path / "certificates").mkdir()
    mass = result("Mass of the load", real("6.9605", r"\kilogram", "0.002"))
    (tmp_path / "certificates" / "M-2026-117.xml").write_text(certificate(mass))
    found = resolve_certificates(text, tmp_path / "rig.toml", PathScope(tmp_path, tmp_path.resolve()))
    assert found.errors == []
    assert found.text["load"]["mass"]["value"] == 6.9605


@pytest.mark.parametrize(
    ("entry", "results", "expected", "u"),
    [
        # U in another unit than the key's, by its id, by its type; ν of k = 2.87 at 95 % is 4: U/1.96 (JCGM 100, G.2)
        ('{ dcc = "a.xml" }', (MASS, VOLUME), 6.9605, 0.001),
        ('{ dcc = "a.xml", result = "m1" }', (MASS, SEVEN), 7.0, 0.005),
        ('{ dcc = "a.xml", result = "basic_mass" }', (MASS, SEVEN), 7.0, 0.005),
        ('{ dcc = "a.xml" }', (FEW,), 7.0, 0.02776445 / 1.959964),
        ('{ dcc = "a.xml", dof = 4 }', (FEW,), 7.0, 0.01416579),
    ],
)  # fmt: skip
def test_results_are_found_by_unit_id_and_type(campaign, entry, results, expected, u):
    load = load_manifest(campaign(certificate(*results), entry)).rig.load
    assert load.mass == pytest.approx(expected)
    assert load.mass_uncertainty == pytest.approx(u, rel=1e-6)


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [
        (r"\milli\volt\second\metre\tothe{-1}", "8000", 0.125),  # 8 V/(m/s)
        (r"\metre\second\tothe{-1}\volt\tothe{-1}", "0.125", 0.125),
        (r"\milli\metre\second\tothe{-1}\volt\tothe{-1}", "125", 0.125),
    ],
)
def test_a_scale_is_the_reciprocal_of_a_sensitivity(campaign, unit, value, expected):
    text = certificate(result("s", real(value, unit, f"{0.001 * float(value):g}")))
    recording = campaign(text, '{ dcc = "a.xml" }', "scale = 0.125", "recording.toml")
    toml = recording / "recording.toml"
    toml.write_text(toml.read_text().replace("  scale_uncertainty = 2.5e-4            # relative\n", ""))
    entry = load_manifest(recording).daq[0].channel[0]
    assert entry.scale == pytest.approx(expected)
    assert entry.scale_uncertainty == pytest.approx(0.0005), "relative, U/2"


def test_expiry_of_a_certificate_gives_a_notice(campaign):
    statement = (
        '<dcc:statements><dcc:statement refType="basic_recalibration"><dcc:date>2026-05-01</dcc:date></dcc:statement>'
        "</dcc:statements>"
    )
    recording = campaign(certificate(MASS, statement=statement), '{ dcc = "a.xml", valid_until = 2036-01-01 }')
    (notice,) = load_manifest(recording).expiry_notices
    assert notice.code == raised.CERTIFICATE_EXPIRED.code
    assert (notice.values["key"], notice.values["source"]) == (
        "load.mass",
        "K 7, Lab, 2026-03-01, valid until 2026-05-01",
    )
    recording = campaign(certificate(MASS), '{ dcc = "a.xml", valid_until = 2036-01-01 }')
    assert load_manifest(recording).expiry_notices == ()


def test_a_response_from_a_certificate_is_the_table_of_its_numbers(campaign, tmp_path):
    frequency = np.geomspace(5.0, 10_000.0, 200)
    value = 0.01 / (1 - (frequency / 32_000) ** 2 + 0.04j * frequency / 32_000)
    size, turn = np.abs(value), np.angle(value)
    texts = [" ".join(f"{number:.12g}" for number in column) for column in (frequency[::-1], size[::-1], turn[::-1])]
    text = certificate(curve("axis x", *texts), curve("axis y", "1 2", "1 1", "0 0"))
    (tmp_path / "b.xml").write_text(text)
    at = np.array([33.3, 711.0])
    exact = 0.01 / (1 - (at / 32_000) ** 2 + 0.04j * at / 32_000)
    found = read_response(tmp_path / "b.xml", at, "axis x")
    np.testing.assert_allclose(found.value, exact, rtol=1e-6)
    np.testing.assert_allclose(found.u_magnitude, 0.002, rtol=0.02)
    np.testing.assert_allclose(found.u_phase_rad, 0.002, rtol=0.02)
    entry = '{ dcc = "a.xml", result = "axis x", valid_until = 2027-01-01 }\n  scale = 1.0'
    text = text.replace(r"\metre\second\tothe{2}", r"\volt")
    recording = campaign(text, entry, 'response = "bridge-response.csv"', "recording.toml")
    toml = recording / "recording.toml"
    toml.write_text(toml.read_text().replace("  scale = 1e-3                          # mV/V → V/V\n", ""))
    manifest = load_manifest(recording)
    channel = manifest.daq[1].channel[0]
    assert (channel.response.name, channel.response_result) == ("a.xml", "axis x")
    assert manifest.inputs[-1].key == "daq.bridge.channel.Fz.response"
    assert manifest.inputs[-1].source == "K 7, Lab, 2026-03-01, valid until 2027-01-01"


def test_a_certificate_is_parsed_once_until_it_changes(tmp_path, monkeypatch):
    parsed, root = [], dcc._root
    monkeypatch.setattr(dcc, "_root", lambda path: parsed.append(path.name) or root(path))
    file, at = tmp_path / "b.xml", np.array([1.5])
    file.write_text(certificate(*(curve(f"axis {n}", "1 2", f"{n} {n}", "0 0") for n in "123")))
    os.utime(file, (1.7e9, 1.7e9))
    assert [read_response(file, at, f"axis {n}").value[0].real for n in "123"] == pytest.approx([1.0, 2.0, 3.0])
    assert parsed == ["b.xml"]
    file.write_text(certificate(curve("axis 1", "1 2", "5 5", "0 0")))
    for _ in range(2):  # as it was written just now, its time of change proves nothing
        assert read_response(file, at, "axis 1").value[0] == pytest.approx(5.0)
    assert len(parsed) == 3


def named(kind: str, numbers: str, name: str = "", about: str = "") -> str:
    """A quantity of some type (refType), with a name in German and a description."""
    name = f'<dcc:name><dcc:content lang="de">{name}</dcc:content></dcc:name>' if name else ""
    about = f"<dcc:description><dcc:content>{about}</dcc:content></dcc:description>" if about else ""
    return f'<dcc:quantity refType="{kind}">{name}{about}{numbers}</dcc:quantity>'


def listed(name: str, *quantities: str) -> str:
    """A result with one list of quantities."""
    title = f"<dcc:name><dcc:content>{name}</dcc:content></dcc:name>"
    return f"<dcc:result>{title}<dcc:data><dcc:list>{''.join(quantities)}</dcc:list></dcc:data></dcc:result>"


def read_input(folder: Path, text: str, entry: dict[str, str], key: str = "mass"):
    """Table at a key of [load] after its certificate was read; raises the first error."""
    (folder / "a.xml").write_text(text, encoding="utf-8")
    scope = PathScope(folder, folder.resolve())
    found = resolve_certificates({"load": {key: {"dcc": "a.xml"} | entry}}, folder / "rig.toml", scope)
    if found.errors:
        raise found.errors[0]
    return found.text["load"][key]


FOREIGN = [
    result("Sound", real("61.2", r"\decibel", "0.5")),
    result("Height", many("0.051 NaN 0.049", r"\metre")),
    result("Label", real("red", r"\one")),
    result("Label", "<dcc:noQuantity><dcc:content>not measured</dcc:content></dcc:noQuantity>"),
    result("Length", real("3", r"\inch", "0.1")),
    result("Length", real("3", "")),
    result("Length", many("1 2 3", r"\metre", "0.1 0.1")),
    result("Length", "<si:hybrid></si:hybrid>"),
    result("Length", "<si:real/>", "<si:list/>", "<si:complex/>"),
    result("New", "<si:tensor><si:value>1</si:value></si:tensor><other/>"),
    result("Pressure", real("1", r"\pascal", "-1"), real("1", r"\pascal", "1", "0.5")),
    curve("broken", "1 2 3", "1 1", "0 0", r"\one"),
    listed("levels", named("vib_frequency", many("1 2", r"\hertz")), named("x", many("1 x", r"\decibel"))),
    "<dcc:result/><dcc:result><dcc:data/></dcc:result><unknown/>",
]


@pytest.mark.parametrize("foreign", FOREIGN)
@pytest.mark.parametrize("entry", [{}, {"result": "load mass"}])
def test_damaged_results_that_are_not_used_are_accepted(tmp_path, foreign, entry):
    for results in ((MASS, foreign), (foreign, MASS)):
        table = read_input(tmp_path, certificate(*results), entry)
        assert (table["value"], table["U"], table["k"]) == (pytest.approx(6.9605), pytest.approx(0.002), 2.0)
    sound = curve("axis z", "50 100 200", "2 2 2", "0.1 0.2 0.4", r"\one")
    (tmp_path / "a.xml").write_text(certificate(foreign, sound), encoding="utf-8")
    assert read_response(tmp_path / "a.xml", np.array([100.0]), "axis z").value[0] == pytest.approx(2 * np.exp(0.2j))
    quantities = foreign.partition("<dcc:data>")[2].partition("</dcc:data>")[0].replace("dcc:list>", "dcc:other>")
    inside = sound.replace("</dcc:list>", f"{quantities}</dcc:list>")
    (tmp_path / "a.xml").write_text(certificate(inside), encoding="utf-8")
    assert read_response(tmp_path / "a.xml", np.array([100.0])).value[0] == pytest.approx(2 * np.exp(0.2j))


@pytest.mark.parametrize(
    ("numbers", "declared", "named"),
    [
        (real("NaN", r"\kilogram", "0.1"), raised.CERTIFIED_VALUE_NOT_USABLE, "nan"),
        (real("7", r"\kilogram", "NaN"), raised.CERTIFIED_VALUE_NOT_USABLE, "uncertainty"),
        (real("7", r"\kilogram", "0.1", "NaN"), raised.CERTIFIED_VALUE_NOT_USABLE, "uncertainty"),
        (real("seven", r"\kilogram", "0.1"), raised.CERTIFIED_VALUE_NOT_USABLE, "seven"),
        (real("7", r"\pound", "0.1"), raised.CERTIFIED_VALUE_NOT_USABLE, r"\pound"),
        (real("7", r"|lb", "0.1"), raised.CERTIFIED_VALUE_NOT_USABLE, "|lb"),
        (real("38", r"\decibel", "0.1"), raised.CERTIFIED_UNIT_MISMATCH, r"\decibel"),
        (
            real("7", r"\one", "0.1") + real("8", r"\gram", "0.1").replace("si:real>", "x:y>").replace("x:", ""),
            raised.CERTIFIED_UNIT_MISMATCH,
            r"\one",
        ),
    ],
)
def test_unusable_result_is_refused_by_its_name(tmp_path, numbers, declared, named):
    with pytest.raises(InputError) as caught:
        read_input(tmp_path, certificate(result("load mass", numbers), VOLUME), {"result": "load mass"})
    assert caught.value.code == declared.code
    assert named in str(caught.value)
    assert "load mass" in str(caught.value)


def test_two_results_of_one_unit_are_refused_even_if_one_is_damaged(tmp_path):
    with pytest.raises(InputError) as caught:
        read_input(tmp_path, certificate(MASS, result("other", real("NaN", r"\kilogram", "1"))), {})
    assert (caught.value.code, caught.value.key) == (raised.CERTIFIED_RESULT_NOT_FOUND.code, "load.mass.result")


def amplifier(frequency: str, magnitude: str, phase: str) -> str:
    """A certificate of one response, by its quantities."""
    return certificate(listed("c", frequency, magnitude, phase))


def response_or_refusal(folder: Path, frequency: str, magnitude: str, phase: str) -> complex | str:
    """The value of a response at 100 Hz, or key and finding of its refusal."""
    (folder / "a.xml").write_text(amplifier(frequency, magnitude, phase), encoding="utf-8")
    try:
        return read_response(folder / "a.xml", np.array([100.0])).value[0]
    except InputError as error:
        if error.code != raised.CERTIFIED_VALUE_NOT_USABLE.code:
            raise
        return f"{error.key}: {error.values['found']}"


HERTZ = named("vib_frequency", many("50 100 200", r"\hertz"))
GAIN = named("vib_magnitude", many("2 2 2", r"\one", "0.008"))
TURN = named("vib_phase", many("-0.1 -0.2 -0.4", r"\radian", "0.004"))


@pytest.mark.parametrize(
    ("kind", "name", "values", "unit", "expected"),
    [
        ("vib_phase", "Phase", "-0.1 -0.2 -0.4", r"\radian", -0.2),
        ("vib_phase", "Phase lag", "0.1 0.2 0.4", r"\radian", -0.2),
        ("vib_phase", "Nacheilung der Phase", "5.7 11.459156 23", r"\degree", -0.2),
        ("vib_phaseLag", "", "0.1 0.2 0.4", r"\radian", -0.2),
        ("vib_phase_lag", "Phase", "100 200 400", r"\milli\radian", -0.2),
        ("vib_phase", "Phase lag", "-0.001 0.2 0.4", r"\radian", -0.2),
        ("", "Winkel", "-0.1 -0.2 -0.4", r"\radian", -0.2),
        ("", "Phase flag", "-0.1 -0.2 -0.4", r"\radian", -0.2),
        ("", "Phase", "-687.5494 -687.5494 -687.5494", r"\arcminute", -0.2),
        ("vib_phase", "Phase lag", "-0.1 -0.2 -0.4", r"\radian", "-0.4 rad"),
        ("vib_phase", "Phase lag, negative", "0.1 0.2 0.4", r"\radian", "negative"),
        ("vib_phase", "Phase delay", "0.1 0.2 0.4", r"\radian", "delay"),
        ("vib_phase", "Phasenverzögerung", "0.1 0.2 0.4", r"\radian", "verzögerung"),
        ("vib_phase", "retard de phase", "0.1 0.2 0.4", r"\radian", "retard"),
        ("vib_phase", "Phase", "10 20 40", r"\percent", r"\percent"),
    ],
)
def test_sign_of_a_phase_follows_its_name_or_is_refused(tmp_path, kind, name, values, unit, expected):
    largest = max(abs(float(value)) for value in values.split())
    turn = named(kind, many(values, unit, f"{0.02 * largest:g}"), name)
    found = response_or_refusal(tmp_path, HERTZ, GAIN, turn)
    if isinstance(expected, str):
        assert '"c"' in found
        assert expected in found
    else:
        assert found == pytest.approx(2.0 * np.exp(1j * expected), rel=1e-6)


@pytest.mark.parametrize(
    ("about", "refused"),
    [
        ("Positive values: phase lag.", True),
        ("Positive phase is a lag, negative phase a lead", True),
        ("The lag of the output", True),
        ("Negative values: the output lags.", False),
        ("Without the delay of the cable", False),
    ],
)
def test_description_that_makes_the_phase_a_lag_is_refused(tmp_path, about, refused):
    turn = named("vib_phase", many("-0.1 -0.2 -0.4", r"\radian", "0.004"), "Phase", about)
    found = response_or_refusal(tmp_path, HERTZ, GAIN, turn)
    assert about in found if refused else found == pytest.approx(2.0 * np.exp(-0.2j))


@pytest.mark.parametrize(
    ("frequency", "named_in_error"),
    [
        (named("vib_frequency", many("50 100 200", r"\hertz")), ""),
        (named("vib_frequency", many("314.15926536 628.31853072 1256.6370614", r"\radian\per\second")), ""),
        (named("x_angularFrequency", many("314.15926536 628.31853072 1256.6370614", r"\second\tothe{-1}")), ""),
        (named("x", many("314.15926536 628.31853072 1256.6370614", r"\one\per\second"), "Kreisfrequenz"), ""),
        (named("vib_frequency", many("18000 36000 72000", r"\degree\second\tothe{-1}")), ""),
        (named("basic_tableIndex0", many("50 100 200", r"\hertz")), ""),
        (named("", many("50 100 200", r"\hertz"), "f"), ""),
        (named("x_angularFrequency", many("50 100 200", r"\hertz")), r"\hertz"),
        (named("vib_frequency", many("50 100 200", r"\hertz"), "Frequency of the angular motion, in pulses"), ""),
        (named("vib_frequency", many("50 NaN 200", r"\hertz")), "nan"),
        (named("vib_frequency", many("50 100 200", r"\rpm")), r"\rpm"),
        (HERTZ + named("vib_frequency", many("51 101 201", r"\hertz")), "2"),
    ],
)
def test_frequencies_are_converted_to_hertz(tmp_path, frequency, named_in_error):
    found = response_or_refusal(tmp_path, frequency, GAIN, TURN)
    assert named_in_error in found if named_in_error else found == pytest.approx(2.0 * np.exp(-0.2j), rel=1e-6)


@pytest.mark.parametrize(
    ("text", "factor", "powers"),  # of m, kg, s, A, K, …: SI brochure, 9th edition, tables 4, 7, 8
    [
        (r"\hour", 3600.0, "0 0 1"),
        (r"\minute", 60.0, "0 0 1"),
        (r"\arcminute", np.pi / 10800, ""),
        (r"\milli\litre", 1e-6, "3"),
        (r"\ppm", 1e-6, ""),
        (r"\hectare", 1e4, "2"),
        (r"\electronvolt", 1.602176634e-19, "2 1 -2"),
        (r"\weber", 1.0, "2 1 -2 -1"),
        (r"\lux", 1.0, "-2 0 0 0 0 0 1"),
        (r"\exa\joule", 1e18, "2 1 -2"),
        (r"\quecto\metre\tothe{3}", None, None),
        (r"\kibi\bit", 1024.0, "0 0 0 0 0 0 0 0 1"),
        (r"\kilogram\metre\tothe{-3}", 1.0, "-3 1"),
        (r"\kilo\gram\metre\tothe{-3.0}", 1.0, "-3 1"),
        (r"\joule\per\kilogram\kelvin", 1.0, "2 0 -2 0 -1"),
        (r"\micro\volt\per\volt\newton\metre", 1e-6, "-2 -1 2"),
        (r"\volt\tothe{2}\hertz\tothe{-1}", 1.0, "4 2 -5 -2"),
        (r"\decibel", np.log(10) / 20, "0 0 0 0 0 0 0 1"),
        ("", None, None), (r"\volt newton", None, None), (r"volt", None, None), (r"\per", None, None),
        (r"\kilo", None, None), (r"\volt\per\per\newton", None, None), (r"\tothe{2}", None, None),
        (r"\metre\tothe{}", None, None), (r"\metre\tothe{99}", None, None), (r"\furlong", None, None),
        (r"|metre", None, None), (r"\kilo\kilo\gram", None, None), (r"\yotta\metre\tothe{9}", None, None),
    ],
)  # fmt: skip
def test_units_of_the_d_si_are_those_of_the_si_brochure(text, factor, powers):
    if powers is None:
        with pytest.raises(ValueError, match="unit"):
            parse_unit(text)
        return
    exponents = [int(power) for power in powers.split()]
    assert parse_unit(text).factor == pytest.approx(factor, rel=1e-12)
    assert parse_unit(text).dimension == (*exponents, *(9 - len(exponents)) * [0])


def test_roots_of_units_and_products_after_per():
    assert parse_unit(r"\volt\hertz\tothe{-0.5}").dimension == (2, 1, -2.5, -1, 0, 0, 0, 0, 0)
    assert parse_unit(r"\metre\tothe{1_2}").dimension == parse_unit(r"\metre\tothe{0.5}").dimension
    unit = parse_unit(r"\milli\volt\per\metre\second\tothe{2}")
    assert unit.dimension == parse_unit(r"\volt\metre\tothe{-1}\second\tothe{-2}").dimension
    assert unit.other.dimension == parse_unit(r"\volt\metre\tothe{-1}\second\tothe{2}").dimension
    assert unit.factor == unit.other.factor == pytest.approx(1e-3)


def test_a_single_frequency_in_rad_per_second_is_converted(tmp_path):
    text = certificate(result("resonance", real("628.31853072", r"\radian\per\second", "6.2831853")))
    table = read_input(tmp_path, text, {}, "axial_frequency")
    assert (table["value"], table["U"]) == (pytest.approx(100.0), pytest.approx(1.0))


@pytest.mark.parametrize(
    ("magnitudes", "expected"),
    [
        (named("vib_magnitude", many("6.0205999 6.0205999 6.0205999", r"\decibel", "0.0346")), 2.0),
        (named("", many("6.0205999 6.0205999 6.0205999", r"\decibel", "0.0346"), "Insertion loss"), r"\decibel"),
        (GAIN + named("", many("3 3 3", r"\one", "0.1"), "Temperature ratio"), 2.0),
        (named("", many("2 2 2", r"\one", "0.008"), "Gain") + named("", many("9 9 9", r"\one", "1"), "Drift"), 2.0),
        (named("", many("2 2 2", r"\one", "0.008"), "A") + named("", many("9 9 9", r"\one", "1"), "B"), "2"),
        (named("x_magnitude", many("2 2 2", r"\foo", "0.008")) + named("", many("9 9 9", r"\one", "1")), r"\foo"),
        (named("", many("2 2 2", r"\one", "0.008"), "A") + named("", many("9 9 9", r"\kelvin", "1"), "B"), 2.0),
        (named("", many("2 2 2", r"\one"), "A"), "uncertainty"),
        (
            named("", many("2 2 2", r"\one", "0.008"), "Gain")
            + named("", many("9 9 9", r"\percent"), "Uncertainty of gain"),
            2.0,
        ),
        (named("", many("9 9 9", r"\percent", "1"), "Deviation of the gain"), "frequency"),
    ],
)
def test_the_magnitude_is_the_column_that_can_be_it(tmp_path, magnitudes, expected):
    found = response_or_refusal(tmp_path, HERTZ, magnitudes, TURN)
    if isinstance(expected, str):
        assert expected in found
    else:
        assert abs(found) == pytest.approx(expected)
        found = read_response(tmp_path / "a.xml", np.array([100.0]))
        assert found.errors[0, 0].real == pytest.approx(0.002, rel=0.01), "0.0346 dB are 0.4 %"


def test_nan_in_the_table_matters_where_it_is_needed(tmp_path):
    """A linear phase, so that a missing point changes nothing at the others."""
    frequency = named("vib_frequency", many("50 100 150 200 250", r"\hertz"))
    for phase in ("-0.1 -0.2 NaN -0.4 -0.5", "-0.1 -0.2 -0.3 -0.4 -0.5"):
        sizes = "2 2 2 2 2" if "NaN" in phase else "2 2 NaN 2 2"
        magnitude = named("vib_magnitude", many(sizes, r"\one", "0.008"))
        text = amplifier(frequency, magnitude, named("vib_phase", many(phase, r"\radian", "0.004")))
        (tmp_path / "a.xml").write_text(text, encoding="utf-8")
        at = np.array([50.0, 75.0, 100.0, 200.0, 240.0])
        found = read_response(tmp_path / "a.xml", at)
        np.testing.assert_allclose(found.value, 2.0 * np.exp(-2j * at / 1000), rtol=1e-9)
        for hertz in (100.5, 150.0, 199.0):
            with pytest.raises(InputError) as caught:
                read_response(tmp_path / "a.xml", np.array([hertz]))
            assert caught.value.code == raised.CERTIFIED_VALUE_NOT_USABLE.code
            assert '"c"' in caught.value.key
            assert f"{hertz:g} Hz" in str(caught.value)
            assert "150 Hz" in str(caught.value)


INCH = real("2.7559", r"\inch", "0.1")
METRE = real("0.07", r"\metre", "0.00254")
MILLIMETRE = real("70", r"\milli\metre", "2.54")


@pytest.mark.parametrize(
    "members", [INCH + METRE, METRE + INCH, INCH + MILLIMETRE + METRE, MILLIMETRE, METRE + MILLIMETRE]
)
def test_hybrid_is_read_in_the_si_unit_at_any_position(tmp_path, members):
    text = certificate(result("d", f"<si:hybrid>{members}</si:hybrid>"))
    table = read_input(tmp_path, text, {}, "clamped_diameter")
    assert (table["value"], table["U"]) == (pytest.approx(0.07), pytest.approx(0.00254))


def test_hybrids_of_lists_and_those_that_contradict_themselves(tmp_path):
    lists = many("50 100 200", r"\cps") + many("0.05 0.1 0.2", r"\kilo\hertz") + many("50 100 200", r"\hertz")
    real_list = "<si:realList><si:listUnit>\\one</si:listUnit>" + 3 * "<si:real><si:value>2</si:value></si:real>"
    real_list = real_list.replace(
        "</si:listUnit>",
        "</si:listUnit><si:listMeasurementUncertaintyUnivariate><si:expandedMU><si:valueExpandedMU>0.008"
        "</si:valueExpandedMU><si:coverageFactor>2</si:coverageFactor></si:expandedMU>"
        "</si:listMeasurementUncertaintyUnivariate>",
    )
    frequency = named("vib_frequency", f"<si:hybrid>{lists}</si:hybrid>")
    gain = named("vib_magnitude", f"<si:hybrid>{real_list}</si:realList></si:hybrid>")
    (tmp_path / "a.xml").write_text(amplifier(frequency, gain, TURN), encoding="utf-8")
    assert read_response(tmp_path / "a.xml", np.array([100.0])).value[0] == pytest.approx(2.0 * np.exp(-0.2j))
    for members, named_in_error in (
        (METRE + MILLIMETRE.replace("70", "80"), "0.08"),
        (METRE + real("7", r"\kilogram", "1"), r"\kilogram"),
        (INCH, r"\inch"),
    ):
        with pytest.raises(InputError) as caught:
            read_input(tmp_path, certificate(result("d", f"<si:hybrid>{members}</si:hybrid>")), {}, "clamped_diameter")
        assert named_in_error in str(caught.value.values["found"])


def signed(text: str, uri: str = "", transform: str = ENVELOPED, digest: str = "sha256", name: str = "") -> str:
    """A certificate with a signature, digested here by the rules of W3C: `text` is in canonical form.

    No space between attributes, double quotes, sorted, no empty elements, no declaration: its bytes are digested.
    """
    part = re.search(rf'<(\S+) id="{uri[1:]}".*</\1>', text)[0] if uri.startswith("#") else text
    if uri.startswith("#"):  # in its canonical form an element states what it inherits
        part = part.replace(" id=", ' xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si" id=', 1)
    value = base64.b64encode(hashlib.new(digest, part.encode()).digest()).decode()
    signature = (
        f'<ds:Signature xmlns:ds="http://www.w3.org/2000/09/xmldsig#"><ds:SignedInfo><ds:Reference URI="{uri}">'
        f"<ds:Transforms>{transform}</ds:Transforms>"
        f'<ds:DigestMethod Algorithm="{name or ALGORITHMS[digest]}"></ds:DigestMethod>'
        f"<ds:DigestValue>{value}</ds:DigestValue></ds:Reference></ds:SignedInfo></ds:Signature>"
    )
    root = "</dcc:digitalCalibrationCertificate>"
    return text.replace(root, signature + root)


PLAIN = certificate(MASS).replace("<dcc:quantity >", "<dcc:quantity>")
REMARKED = PLAIN.replace("<dcc:results>", "<!-- weighed twice --><dcc:results>")
COMMENTED = ENVELOPED.replace("20010315", "20010315#WithComments")
SUBTRACTED = (
    '<ds:Transform Algorithm="http://www.w3.org/2002/06/xmldsig-filter2"><f:XPath xmlns:f="http://www.w3.org/2002/06/'
    'xmldsig-filter2" Filter="subtract">/descendant::ds:Signature</f:XPath></ds:Transform>'
)
PARALLEL = (
    '<ds:Transform Algorithm="http://www.w3.org/TR/1999/REC-xpath-19991116"><ds:XPath>not(ancestor-or-self::ds:Signature)'
    "</ds:XPath></ds:Transform>"
)
UNKNOWN = '<ds:Transform Algorithm="http://www.w3.org/TR/1999/REC-xslt-19991116"/>'
RESULTS = PLAIN.replace("<dcc:measurementResults>", '<dcc:measurementResults id="r">')
CHECKED = (raised.SIGNER_NOT_VERIFIED, "")
"""Every digest agrees."""


def unchecked(reason: str = "") -> tuple[DeclaredNotice, str]:
    """Notice of a signature that was not checked, and what its reason names."""
    return raised.SIGNATURE_NOT_CHECKED, reason


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PLAIN, None),
        (SIGNED.replace("S&#252;d &amp; 7", "K 7"), raised.CERTIFICATE_CHANGED),
        (SIGNED, CHECKED),
        (SIGNED.replace("<?style sheet?>", "<?style  sheet?>"), CHECKED),
        (SIGNED.replace("<?style sheet?>", "<?style other?>"), raised.CERTIFICATE_CHANGED),
        (SIGNED.replace("<!-- weighed -->", ""), CHECKED),  # comments are not signed
        (SIGNED.replace("\n", "\r\n"), CHECKED),
        (SIGNED.replace(">7<", ">7.1<"), raised.CERTIFICATE_CHANGED),
        (SIGNED.replace("\\kilogram", "\\gram"), raised.CERTIFICATE_CHANGED),
        (SIGNED.replace("load mass", "load mass "), raised.CERTIFICATE_CHANGED),
        (SIGNED.replace(' id=\'m1\'', ' id=\'m1\' refId=\'x\''), raised.CERTIFICATE_CHANGED),
        *((signed(PLAIN, digest=name), CHECKED) for name in ("sha1", "sha224", "sha256", "sha384", "sha512")),
        *((signed(PLAIN, transform=transform), CHECKED) for transform in (SUBTRACTED, PARALLEL)),
        (signed(REMARKED, transform=COMMENTED), CHECKED),
        (signed(REMARKED, transform=COMMENTED).replace("6960.5", "7"), raised.CERTIFICATE_CHANGED),
        (signed(signed(PLAIN), digest="sha512"), CHECKED),  # a second one, of all and the first
        (signed(PLAIN, digest="sha512").replace("6960.5", "2406.3"), raised.CERTIFICATE_CHANGED),
        (signed(PLAIN, transform=UNKNOWN), unchecked("http://www.w3.org/TR/1999/REC-xslt-19991116")),
        (signed(PLAIN, name="http://www.w3.org/2001/04/xmldsig-more#md5"), unchecked("http://www.w3.org/2001/04/xmldsig-more#md5")),
        (signed(PLAIN).replace('URI=""', 'URI="other.xml"'), unchecked("other.xml")),
        (signed(RESULTS, "#r", ""), unchecked("dcc:administrativeData")),
        (signed(signed(RESULTS, "#r", "").replace('id="r"', 'id="s"'), "#s", ""), raised.CERTIFICATE_CHANGED),  # no #r
        (signed(PLAIN).replace("<ds:DigestValue>", "<ds:DigestValue>AAAA"), raised.CERTIFICATE_CHANGED),
        (
            PLAIN.replace("<dcc:results>", f"<dcc:results>{signed(PLAIN)[signed(PLAIN).index('<ds:Sig'):-36]}"),
            unchecked(),
        ),
    ],
)  # fmt: skip
def test_signature_is_checked_and_a_changed_certificate_refused(tmp_path, text, expected):
    (tmp_path / "a.xml").write_bytes(text.encode())
    if expected is raised.CERTIFICATE_CHANGED:
        with pytest.raises(InputError) as caught:
            dcc.read_dcc(tmp_path / "a.xml")
        assert (caught.value.code, caught.value.key) == (raised.CERTIFICATE_CHANGED.code, "ds:Signature")
        assert caught.value.file.name == "a.xml"
        return
    notices = dcc.read_dcc(tmp_path / "a.xml").signature_notices
    assert [(notice.code, notice.where) for notice in notices] == ([(expected[0].code, "a.xml")] if expected else [])
    for notice in notices:
        assert expected[1] in str(notice.values.get("reason", ""))


def test_check_prints_the_notice_of_a_signature(campaign, capsys):
    recording = campaign(signed(PLAIN, transform=UNKNOWN))
    (notice,) = load_manifest(recording).certificate_notices
    main(["check", str(recording)])
    assert notice.code == raised.SIGNATURE_NOT_CHECKED.code
    assert "http://www.w3.org/TR/1999/REC-xslt-19991116" in capsys.readouterr().out
    changed = campaign(signed(PLAIN).replace("6960.5", "2406.3"))
    assert main(["check", str(changed)]) == 2
    assert "ds:Signature" in capsys.readouterr().err


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no certificates at {REAL}")
def test_the_published_signed_certificate_and_the_manipulated_one():
    (notice,) = dcc.read_dcc(REAL / "dcc_gp_temperature_typical_v12_signed.xml").signature_notices
    assert notice.code == raised.SIGNER_NOT_VERIFIED.code
    with pytest.raises(InputError) as caught:
        dcc.read_dcc(REAL / "dcc_gp_temperature_typical_v12_signed_manipulated.xml")
    assert caught.value.code == raised.CERTIFICATE_CHANGED.code


GOOD = certificate(MASS)
BROKEN = [
    # certificate, entry at the key, declaration of the error, its file and key, value that it names
    (
        certificate(VOLUME), '{ dcc = "a.xml" }',
        raised.CERTIFIED_UNIT_MISMATCH, "rig.toml", "load.mass", r"\centi\metre\tothe{3}",
    ),
    (
        certificate(VOLUME, MASS), '{ dcc = "a.xml", result = "volume" }',
        raised.CERTIFIED_UNIT_MISMATCH, "rig.toml", "load.mass", r"\centi\metre",
    ),
    (
        certificate(MASS, MASS), FROM_FILE,
        raised.CERTIFIED_RESULT_NOT_FOUND, "rig.toml", "load.mass.result", "load mass",
    ),
    (
        GOOD, '{ dcc = "a.xml", result = "other" }',
        raised.CERTIFIED_RESULT_NOT_FOUND, "rig.toml", "load.mass.result", '"load mass"',
    ),
    (GOOD, '{ dcc = "b.xml" }', raised.MISSING_FILE, "rig.toml", "load.mass.dcc", "b.xml"),
    (GOOD, '{ dcc = "../../a.xml" }', raised.PATH_NOT_ALLOWED, "rig.toml", "load.mass.dcc", "../../a.xml"),
    (GOOD, '{ dcc = "/etc/a.xml" }', raised.PATH_NOT_ALLOWED, "rig.toml", "load.mass.dcc", "/etc/a.xml"),
    (GOOD, '{ dcc = "a.txt" }', raised.KEY_TAKES_NO_CERTIFICATE, "rig.toml", "load.mass.dcc", "a.txt"),
    (GOOD, "{ dcc = 7 }", raised.WRONG_VALUE_TYPE, "rig.toml", "load.mass.dcc", "7"),
    (GOOD, '{ dcc = "a.xml", k = 2 }', raised.UNKNOWN_KEY, "rig.toml", "load.mass.k", ""),
    (
        GOOD, '{ dcc = "a.xml", valid_until = 2020-01-01 }',
        raised.INVALID_UNCERTAINTY_STATEMENT, "rig.toml", "load.mass.valid_until", "2020-01-01",
    ),
    ("mass = 7", FROM_FILE, raised.INVALID_CERTIFICATE_FILE, "a.xml", "", ""),
    ("<a/>", FROM_FILE, raised.INVALID_CERTIFICATE_FILE, "a.xml", "", "dcc:digitalCalibrationCertificate"),
    (
        '<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;">]>' + GOOD, FROM_FILE,
        raised.INVALID_CERTIFICATE_FILE, "a.xml", "", "",
    ),
    (
        GOOD.replace(r"<si:unit>\gram</si:unit>", ""), FROM_FILE,
        raised.CERTIFIED_VALUE_NOT_USABLE, "a.xml", "si:unit", "",
    ),
    (GOOD.replace(">2.0<", ">-2.0<"), FROM_FILE, raised.CERTIFIED_VALUE_NOT_USABLE, "a.xml", "si:uncertainty", "-2"),
    (
        GOOD.replace("expandedUnc>", "none>"), FROM_FILE,
        raised.CERTIFIED_VALUE_NOT_USABLE, "a.xml", "load mass", "uncertainty",
    ),
    (
        certificate(result("load mass", many("1 2", r"\kilogram", "0.1"))), FROM_FILE,
        raised.CERTIFIED_UNIT_MISMATCH, "rig.toml", "load.mass", "2",
    ),
    (
        certificate(result("load mass", many("1 2", r"\kilogram", "0.1 0.1 0.1"))), FROM_FILE,
        raised.CERTIFIED_VALUE_NOT_USABLE, "a.xml", "load mass", "3 numbers",
    ),
    (
        certificate(CONVENTIONAL), FROM_FILE,
        raised.CONTRADICTING_VALUES, "rig.toml", "load.mass", 'mass_kind = "conventional"',
    ),
    (certificate(), '{ dcc = "a.xml" }', raised.CERTIFIED_RESULT_NOT_FOUND, "rig.toml", "load.mass.result", "a.xml"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "entry", "declared", "file", "key", "named"), BROKEN)
def test_unusable_certificate_is_refused_at_file_and_key(campaign, capsys, text, entry, declared, file, key, named):
    recording = campaign(text, entry)
    with pytest.raises(InputError) as caught:
        load_manifest(recording)
    error = caught.value
    assert (error.code, error.file.name) == (declared.code, file)
    assert key in error.key
    assert named in error.sentence
    assert main(["check", str(recording)]) == 2
    printed = capsys.readouterr().err
    assert declared.code in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize(
    ("text", "declared", "found"),
    [
        (
            curve("c", "1 2 3", "1 1 1", "0 0 0", r"\pascal\per\volt"),
            raised.CERTIFIED_UNIT_MISMATCH,
            r"\pascal\per\volt",
        ),
        (curve("c", "1 2 3", "1 1 1", "", r"\one"), raised.CERTIFIED_VALUE_NOT_USABLE, "phase"),
        (curve("c", "1 2", "1 1 1", "0 0 0", r"\one"), raised.CERTIFIED_VALUE_NOT_USABLE, "2 numbers"),
        (curve("c", "1 1 3", "1 1 1", "0 0 0", r"\one"), raised.CERTIFIED_VALUE_NOT_USABLE, "twice"),
        (curve("c", "1 2 3", "1 1 1", "0 0 0", r"\one") * 2, raised.CERTIFIED_VALUE_NOT_USABLE, '2 of "c"'),
        (MASS, raised.CERTIFIED_VALUE_NOT_USABLE, "frequency"),
    ],
)
def test_unusable_response_of_a_certificate_is_refused(campaign, text, declared, found):
    recording = campaign(certificate(text), '{ dcc = "a.xml" }', 'response = "bridge-response.csv"', "recording.toml")
    with pytest.raises(InputError) as caught:
        load_manifest(recording)
    assert caught.value.code == declared.code
    assert found in str(caught.value.values["found"])


def test_keys_that_no_certificate_states_are_refused(campaign):
    inertia = "inertia_uncertainty = 1e-4"
    with pytest.raises(InputError) as caught:
        load_manifest(campaign(GOOD, '{ dcc = "a.xml" }', inertia))
    assert (caught.value.code, caught.value.key) == (raised.KEY_TAKES_NO_CERTIFICATE.code, "load.inertia_uncertainty")


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no certificates at {REAL}")
def test_the_published_certificate_of_a_silicon_sphere(campaign):
    text = (REAL / "siliziumkugel_2_4_0.xml").read_text(encoding="utf-8")
    manifest = load_manifest(campaign(text, '{ dcc = "a.xml", result = "mass" }'))
    assert manifest.rig.load.mass == 1.00007841
    assert manifest.rig.load.mass_uncertainty == pytest.approx(2.5e-8)
    stated = next(item.stated for item in manifest.inputs if item.key == "load.mass")
    assert stated.certificate
    assert stated.laboratory
    assert stated.k == 2.0
    with pytest.raises(InputError) as caught:
        load_manifest(campaign(text, '{ dcc = "a.xml", result = "Volume" }'))
    assert (caught.value.code, caught.value.key) == (raised.CERTIFIED_UNIT_MISMATCH.code, "load.mass")
    assert r"\centi\metre" in str(caught.value.values["found"])
