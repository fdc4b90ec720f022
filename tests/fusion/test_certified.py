"""Inputs from Digital Calibration Certificates: as if typed, or one sentence with file and key."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support import DOCS, examples

from fusion.base import InputError
from fusion.cli import main
from fusion.recording import dcc
from fusion.recording.certified import certified_inputs
from fusion.recording.load import load_manifest
from fusion.recording.response import read_response
from fusion.recording.values import PathScope
from fusion.report.uncertainty_tables import inputs_table
from fusion.sensor.certificate.evaluate import _sources

REAL = Path(os.environ.get("SHAKERCAL_DATA", Path(__file__).parents[3] / "shared/data")) / "dcc"
TYPED = '{ value = 6.9605, U = 0.0020, k = 2, certificate = "K 7", laboratory = "Lab", date = 2026-03-01 }'
FROM_FILE = '{ dcc = "a.xml", result = "load mass" }'


def real(value: str, unit: str, uncertainty: str = "", k: str = "2", more: str = "") -> str:
    """One number with its U."""
    told = (
        f"<si:expandedUnc><si:uncertainty>{uncertainty}</si:uncertainty><si:coverageFactor>{k}</si:coverageFactor>{more}"
        "</si:expandedUnc>"
    )
    return f"<si:real><si:value>{value}</si:value><si:unit>{unit}</si:unit>{told if uncertainty else ''}</si:real>"


def many(value: str, unit: str, uncertainty: str = "", k: str = "2") -> str:
    """A list of numbers with their U."""
    told = (
        f"<si:expandedUncXMLList><si:uncertaintyXMLList>{uncertainty}</si:uncertaintyXMLList>"
        f"<si:coverageFactorXMLList>{k}</si:coverageFactorXMLList></si:expandedUncXMLList>"
    )
    return (
        f"<si:realListXMLList><si:valueXMLList>{value}</si:valueXMLList><si:unitXMLList>{unit}</si:unitXMLList>"
        f"{told if uncertainty else ''}</si:realListXMLList>"
    )


def result(name: str, *numbers: str, about: str = "") -> str:
    """A result with quantities, each a text of numbers, or a pair of its attributes and that."""
    quantities = "".join(f"<dcc:quantity {about}>{own}</dcc:quantity>" for own in numbers)
    told = f"<dcc:name><dcc:content>{name}</dcc:content></dcc:name>"
    return f"<dcc:result>{told}<dcc:data>{quantities}</dcc:data></dcc:result>"


def curve(name: str, frequency: str, magnitude: str, phase: str, unit: str = r"\volt\per\metre\second\tothe{2}") -> str:
    """A result over frequency, in rad, with U of 0.4 % and 4 mrad."""
    u = " ".join(f"{0.004 * float(value):.9g}" for value in magnitude.split()) or "1"
    parts = (
        ("vib_frequency", many(frequency, r"\hertz")),
        ("vib_magnitude", many(magnitude, unit, u)),
        ("vib_phase", many(phase, r"\radian", "0.004") if phase else ""),
    )
    quantities = "".join(f'<dcc:quantity refType="{kind}">{own}</dcc:quantity>' for kind, own in parts if own)
    return (
        f"<dcc:result><dcc:name><dcc:content>{name}</dcc:content></dcc:name><dcc:data><dcc:list>{quantities}"
        "</dcc:list></dcc:data></dcc:result>"
    )


def certificate(*results: str, statement: str = "") -> str:
    """A certificate K 7 of the laboratory Lab, of 2026-03-01."""
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


def test_a_certificate_counts_as_the_table_that_is_typed_from_it(campaign):
    recording = campaign(certificate(VOLUME, result("load mass", real("6.9605", r"\kilogram", "0.0020"))))
    read = load_manifest(recording)
    assert recording.parent / "a.xml" in read.files
    assert (recording.parent / "a.xml") in read.read
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
    text = tomllib.loads(examples((DOCS / "recording-format.md").read_text(encoding="utf-8"))[5])
    (tmp_path / "certificates").mkdir()
    mass = result("Mass of the load", real("6.9605", r"\kilogram", "0.002"))
    (tmp_path / "certificates" / "M-2026-117.xml").write_text(certificate(mass))
    found = certified_inputs(text, tmp_path / "rig.toml", PathScope(tmp_path, tmp_path.resolve()))
    assert found.wrong == []
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


def test_an_expired_certificate_is_told_as_a_typed_one_is(campaign):
    statement = (
        '<dcc:statements><dcc:statement refType="basic_recalibration"><dcc:date>2026-05-01</dcc:date></dcc:statement>'
        "</dcc:statements>"
    )
    recording = campaign(certificate(MASS, statement=statement), '{ dcc = "a.xml", valid_until = 2036-01-01 }')
    (notice,) = load_manifest(recording).expired
    assert "load.mass (K 7, Lab, 2026-03-01, valid until 2026-05-01)" in notice.text
    recording = campaign(certificate(MASS), '{ dcc = "a.xml", valid_until = 2036-01-01 }')
    assert load_manifest(recording).expired == ()


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
    for _ in range(2):  # just now: it might change again unseen
        assert read_response(file, at, "axis 1").value[0] == pytest.approx(5.0)
    assert len(parsed) == 3


def test_ten_thousand_frequencies_are_read(tmp_path):
    numbers = " ".join(str(number) for number in range(1, 10_001))
    (tmp_path / "b.xml").write_text(certificate(curve("c", numbers, "1 " * 10_000, "0 " * 10_000)))
    assert read_response(tmp_path / "b.xml", np.array([500.5])).value[0] == pytest.approx(1.0)


GOOD = certificate(MASS)
BROKEN = [
    # certificate, what stands at the key, key, words of the sentence
    (certificate(VOLUME), '{ dcc = "a.xml" }', "load.mass", r"\centi\metre\tothe{3}"),
    (certificate(VOLUME, MASS), '{ dcc = "a.xml", result = "volume" }', "load.mass", r"found \centi\metre"),
    (certificate(MASS, MASS), FROM_FILE, "load.mass.result", "one of the 2 results in kg"),
    (GOOD, '{ dcc = "a.xml", result = "other" }', "load.mass.result", '"load mass"'),
    (GOOD, '{ dcc = "b.xml" }', "load.mass.dcc", "no file"),
    (GOOD, '{ dcc = "../../a.xml" }', "load.mass.dcc", "inside the folder"),
    (GOOD, '{ dcc = "/etc/a.xml" }', "load.mass.dcc", "relative to this file"),
    (GOOD, '{ dcc = "a.txt" }', "load.mass.dcc", "Digital Calibration Certificate"),
    (GOOD, "{ dcc = 7 }", "load.mass.dcc", "a text"),
    (GOOD, '{ dcc = "a.xml", k = 2 }', "load.mass.k", "an unknown key"),
    (GOOD, '{ dcc = "a.xml", valid_until = 2020-01-01 }', "load.mass.valid_until", "the date of the certificate"),
    ("mass = 7", FROM_FILE, "a.xml", "damaged XML"),
    ("<a/>", FROM_FILE, "a.xml", "the root of a DCC"),
    ('<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;">]>' + GOOD, FROM_FILE, "a.xml", "document type"),
    (GOOD.replace(r"<si:unit>\gram</si:unit>", ""), FROM_FILE, "si:unit", "nothing"),
    (GOOD.replace(">2.0<", ">-2.0<"), FROM_FILE, "si:uncertainty", "at least 0"),
    (GOOD.replace("expandedUnc>", "none>"), FROM_FILE, "load mass", "no uncertainty"),
    (certificate(result("load mass", many("1 2", r"\kilogram", "0.1"))), FROM_FILE, "load.mass", "a list of 2"),
    (certificate(result("load mass", many("1 2", r"\kilogram", "0.1 0.1 0.1"))), FROM_FILE, "a.xml", "3 numbers"),
    (certificate(CONVENTIONAL), FROM_FILE, "load.mass", 'mass_kind = "conventional"'),
    (certificate(), '{ dcc = "a.xml" }', "load.mass.result", "none"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "entry", "key", "told"), BROKEN)
def test_a_certificate_that_cannot_be_used_is_one_sentence(campaign, capsys, text, entry, key, told):
    recording = campaign(text, entry)
    assert main(["check", str(recording)]) == 2
    said = capsys.readouterr().err
    assert key in said
    assert told in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (curve("c", "1 2 3", "1 1 1", "0 0 0", r"\pascal\per\volt"), r"\pascal\per\volt"),
        (curve("c", "1 2 3", "1 1 1", "", r"\one"), "no phase"),
        (curve("c", "1 2", "1 1 1", "0 0 0", r"\one"), "2 numbers"),
        (curve("c", "1 1 3", "1 1 1", "0 0 0", r"\one"), "one twice"),
        (curve("c", "1 2 3", "1 1 1", "0 0 0", r"\one") * 2, "by its id, name or type"),
        (MASS, "no list over frequency"),
    ],
)
def test_a_response_that_cannot_be_used_is_one_sentence(campaign, text, told):
    recording = campaign(certificate(text), '{ dcc = "a.xml" }', 'response = "bridge-response.csv"', "recording.toml")
    with pytest.raises(InputError) as caught:
        load_manifest(recording)
    assert told in str(caught.value)


def test_keys_that_no_certificate_states_are_refused(campaign):
    inertia = "inertia_uncertainty = 1e-4"
    with pytest.raises(InputError, match="inertia_uncertainty: expected no certificate"):
        load_manifest(campaign(GOOD, '{ dcc = "a.xml" }', inertia))


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
    with pytest.raises(InputError, match=r"load.mass: expected a quantity in kg, found \\centi\\metre"):
        load_manifest(campaign(text, '{ dcc = "a.xml", result = "Volume" }'))
