"""Certificates of rotate, identify and step: numbers against their tables, XML against schema and Schematron rules."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from certificates import FORM, NAMES, SCHEMA, acknowledged, broken_rules, texts
from lxml import etree
from support import RefusedCommand, edit, rows

from fusion.cli import main
from fusion.recording.dcc import read_dcc
from fusion.recording.load import load_manifest
from fusion.sensor import result_notices as raised
from fusion.sensor.certificate.certificate_inputs import CERTIFIED_COMMANDS

NUMBERED = FORM.replace('model = "W6"', 'model = "W6"\ncustomer_number = "C-1"') + acknowledged("SC-377")
RULES = SCHEMA.with_name("dcc.sch")


def filled(source: Path, folder: Path) -> Path:
    """A copy of a campaign with results, and a filled form."""
    shutil.copytree(source, folder)
    (folder / "certificate.toml").write_text(NUMBERED, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def rotated(commanded: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return filled(commanded("rotation"), tmp_path_factory.mktemp("rotation") / "rotation")


def certified(folder: Path, out: Path) -> etree._Element:
    """The root of the certificate's XML."""
    assert main(["certificate", str(folder), "--specimen", "-o", str(out)]) == 0
    return etree.parse(out / "certificate.xml").getroot()


def stated(root: etree._Element) -> list[tuple[str, str, str, str]]:
    """Name, value, U and k of every number, as texts."""
    found = []
    for quantity in root.findall(".//dcc:result/dcc:data/dcc:list/dcc:quantity", NAMES):
        (name,) = texts(quantity, "dcc:name/dcc:content")
        paths = ("si:value", "si:measurementUncertaintyUnivariate/si:expandedMU/si:valueExpandedMU")
        numbers = [texts(quantity, f"si:real/{path}")[0] for path in paths]
        found.append((name, *numbers, texts(quantity, ".//si:coverageFactor")[0]))
    return found


def check_valid(file: Path) -> None:
    """Hold a certificate to schema and Schematron rules, where their files are at hand."""
    if not SCHEMA.is_file():
        pytest.skip(f"the schema is not at {SCHEMA}")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    assert schema.validate(etree.parse(file)), schema.error_log
    pytest.importorskip("elementpath")
    assert {role for role, _ in broken_rules(file, RULES)} <= {"information"}


def test_a_certificate_states_the_masses_of_a_rotation_test(rotated, tmp_path, capsys) -> None:
    root = certified(rotated, tmp_path / "out")
    assert ": 8 numbers" in capsys.readouterr().out
    table = {(row["name"], row["component"]): row for row in rows(rotated / "rotate" / "rotation.csv")}
    mass = table["internal_mass", "joint"]
    found = stated(root)
    name, value, expanded, k = found[0]
    assert (name, value, k) == ("Internal mass", mass["value"], mass["k"])
    assert float(expanded) == pytest.approx(float(mass["U"]), rel=1e-12)
    assert [line[1] for line in found] == [
        table[name, component]["value"]
        for body in ("internal", "load")
        for name, component in ((f"{body}_mass", "joint"), *((f"{body}_centre_of_mass", axis) for axis in "xyz"))
    ]
    assert texts(root, ".//dcc:result//si:real/si:unit")[:2] == [r"\kilogram", r"\metre"]
    assert "Internal centre of mass x" in (tmp_path / "out" / "certificate.html").read_text(encoding="utf-8")
    check_valid(tmp_path / "out" / "certificate.xml")


def test_its_mass_is_an_input_of_the_next_recording(rotated, tmp_path, demo_recording) -> None:
    """What a rotation test certifies is what rig.toml takes from a certificate, with its U and number."""
    certified(rotated, tmp_path / "out")
    shutil.copytree(demo_recording, tmp_path / "demo")
    shutil.copy(tmp_path / "out" / "certificate.xml", tmp_path / "demo" / "mass.xml")
    old = "internal_mass = 0.214\ninternal_mass_uncertainty = 0.0005\n"
    new = 'internal_mass = { dcc = "mass.xml", result = "Internal mass" }\n'
    edit(tmp_path / "demo" / "rig.toml", old, new)
    sensor = load_manifest(tmp_path / "demo" / "Fz-0080").rig.sensor
    mass = next(row for row in rows(rotated / "rotate" / "rotation.csv") if row["name"] == "internal_mass")
    assert sensor.internal_mass == float(mass["value"])
    assert sensor.internal_mass_uncertainty == pytest.approx(float(mass["u"]), rel=1e-9)
    assert read_dcc(tmp_path / "demo" / "mass.xml").number == "SPECIMEN 2026-0815"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "command", "names", "units"),
    [
        (
            "masses", "identify", ["Stiffness z", "Damping z", "Internal mass"],
            [r"\newton\metre\tothe{-1}", r"\newton\second\metre\tothe{-1}", r"\kilogram"],
        ),
        (
            "steps", "step", ["Static gain", "Natural frequency of the dominant mode"],
            [r"\volt\volt\tothe{-1}\newton\tothe{-1}", r"\hertz"],
        ),
    ],
)  # fmt: skip
def test_numbers_of_other_commands_are_those_of_their_tables(
    preset, command, names, units, commanded, tmp_path
) -> None:
    folder = filled(commanded(preset), tmp_path / preset)
    root = certified(folder, tmp_path / "out")
    found, table = stated(root), rows(folder / command / CERTIFIED_COMMANDS[command].table)
    assert [line[0] for line in found[: len(names)]] == names
    assert texts(root, ".//dcc:result//si:real/si:unit")[: len(units)] == units
    if command == "step":
        table = [row for row in table if row["channel"] == row["component"]]
        assert "for these" in " ".join(texts(root, ".//dcc:statement/dcc:declaration/dcc:content"))
    assert [line[1] for line in found] == [row["value"] for row in table]
    assert [float(line[2]) for line in found] == pytest.approx([float(row["U"]) for row in table], rel=1e-12)
    check_valid(tmp_path / "out" / "certificate.xml")


def test_schematron_rules_find_what_is_wrong(rotated, tmp_path) -> None:
    """Each of these is an error by the rules' own words."""
    pytest.importorskip("elementpath")
    if not RULES.is_file():
        pytest.skip(f"the rules are not at {RULES}")
    assert {role for role, _ in broken_rules(RULES.with_name("minimal_dcc.xml"), RULES)} == {"information"}
    certified(rotated, tmp_path / "out")
    text = (tmp_path / "out" / "certificate.xml").read_text(encoding="utf-8")
    for old, new, words in (  # of the published rules
        ("<dcc:endPerformanceDate>2026-11-20", "<dcc:endPerformanceDate>2026-11-01", "date"),
        ('refId="item"', 'refId="nothing"', "Invalid reference ID"),
        ('lang="en"', 'lang="no"', "Invalid language code"),
        ("(?s)<dcc:usedMethods>.*?</dcc:usedMethods>", "", "Missing measurement methods"),
    ):
        wrong = tmp_path / "wrong.xml"
        changed = re.sub(old, new, text, count=1)
        assert changed != text
        wrong.write_text(changed, encoding="utf-8")
        assert any(role == "error" and words in text for role, text in broken_rules(wrong, RULES)), words


def test_a_draft_names_the_method_and_missing_entries_are_named(rotated, tmp_path, refused: RefusedCommand) -> None:
    folder = filled(rotated, tmp_path / "rotation")
    (folder / "certificate.toml").unlink()
    assert main(["certificate", str(folder), "--draft"]) == 0
    assert CERTIFIED_COMMANDS["rotate"].method in (folder / "certificate.toml").read_text(encoding="utf-8")
    (folder / "certificate.toml").write_text(FORM, encoding="utf-8")
    refusal = refused("certificate", folder, "--specimen")
    assert f"{raised.MISSING_CERTIFICATE_ENTRIES.code} " in refusal
    assert "item.customer_number" in refusal
    (folder / "certificate.toml").write_text(NUMBERED, encoding="utf-8")
    table = folder / "rotate" / "rotation.csv"
    good = table.read_text(encoding="utf-8")
    for broken, declared in (
        (good.replace("joint,0.", "joint,x0.", 1), raised.DAMAGED_RESULT_TABLE),
        (good.partition("\n")[0] + "\n", raised.NO_CERTIFIABLE_RESULT),
    ):
        table.write_text(broken, encoding="utf-8")
        refusal = refused("certificate", folder, "--specimen")
        assert f"{declared.code} {table}: " in refusal
    table.write_text(good, encoding="utf-8")
    edit(folder / "rig.toml", "mass = 6.9605", "mass = 6.9606")
    refusal = refused("certificate", folder, "--specimen")
    assert f"{raised.OUTDATED_RESULTS.code} " in refusal
    assert "rig.toml" in refusal
