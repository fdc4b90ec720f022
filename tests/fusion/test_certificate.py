"""The calibration certificate: what it states against the tables, its XML against the schema, what is refused."""

from __future__ import annotations

import re
import shutil
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import Page
from certificates import FORM, NAMES, SCHEMA, acknowledged, broken_rules, texts
from lxml import etree
from support import DOCS, RefusedCommand, edit, examples, rows, without_pages

from fusion.campaign.curve import CurvePoint
from fusion.cli import main
from fusion.estimation.coverage import polar
from fusion.phasors.phasor_notices import CAMERA_DELAYED, HIGH_HARMONICS_NOT_ASSESSED, MOTION_BLUR
from fusion.recording.dsi import dsi_unit
from fusion.recording.load import load_manifest
from fusion.report.folder import hash_files
from fusion.report.recording_report import write_results
from fusion.sensitivity.analyse import Evaluation
from fusion.sensor import result_notices as raised
from fusion.sensor.certificate.certificate_content import Certificate
from fusion.sensor.certificate.certificate_evaluation import _loads, _not_assessed, _stated, evaluate_certificate
from fusion.sensor.certificate.certificate_form import METHOD, NEW_FORM, read_form
from fusion.sensor.certificate.certificate_page import certificate_page
from fusion.sensor.certificate.certificate_xml import certificate_xml
from fusion.sensor.compare.comparison_inputs import read_result
from fusion.sensor.unmodelled_effects import coverage_notice
from shakercal._common.notices import Notice


@pytest.fixture(scope="module")
def evaluated(demo_recording: Path, demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo, as if measured, with its results and a filled certificate.toml."""
    folder = tmp_path_factory.mktemp("evaluated") / "demo"
    shutil.copytree(demo_recording, folder)
    (folder / "Fz-0080" / "truth.json").unlink()
    edit(folder / "Fz-0080" / "recording.toml", ", simulated", "")
    edit(folder / "Fz-0080" / "recording.toml", "simulated = true\n", "")
    manifest = load_manifest(folder / "Fz-0080")
    hashes = hash_files(manifest.files, manifest.root).hashes
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        write_results(replace(demo_evaluation, input_hashes=hashes), folder / "results" / "Fz-0080")
    codes = {notice.code for notice in demo_evaluation.notices if notice.severity == "warning"}
    (folder / "certificate.toml").write_text(FORM + acknowledged(*sorted(codes)), encoding="utf-8")
    return folder


@pytest.fixture
def campaign(evaluated: Path, tmp_path: Path, no_pages: None) -> Path:
    """A copy of it that may be changed."""
    return Path(shutil.copytree(evaluated, tmp_path / "demo"))


@pytest.fixture(scope="module")
def certified(evaluated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A campaign with its certificate, and what the command printed."""
    folder, printed = tmp_path_factory.mktemp("certified") / "demo", StringIO()
    shutil.copytree(evaluated, folder)
    with redirect_stdout(printed):
        assert main(["certificate", str(folder)]) == 0
    return folder, printed.getvalue()


def test_the_numbers_are_those_of_the_table_and_the_xml_is_valid(certified: tuple[Path, str]) -> None:
    campaign, printed = certified
    assert "Sensitivity Fz per Fz: 80.0002 Hz" in printed  # the name is that of the XML, too
    root = etree.parse(campaign / "certificate" / "certificate.xml").getroot()
    found = {r.find("dcc:name/dcc:content", NAMES).text: r for r in root.findall(".//dcc:result", NAMES)}
    table = rows(campaign / "results" / "Fz-0080" / "sensitivity.csv")
    elements = [row for row in table if row["kind"] == "element" and row["frequency_hz"].startswith("80.")]
    assert len(found) == len(elements) == 6
    for row in elements:
        result = found[f"Sensitivity {row['channel']} per {row['component']}"]
        assert texts(result, ".//si:valueRealXMLList") == [row["re"]]
        assert texts(result, ".//si:valueImagXMLList") == [row["im"]]
        values = texts(result, ".//si:realListXMLList/si:valueXMLList")
        assert values[0] == row["frequency_hz"]
        if len(values) == 3:
            assert values[1:] == [row["magnitude"], row["phase_rad"]]
            factors = texts(result, ".//si:expandedMUXMLList/si:coverageFactorXMLList")
            for u, k, stated in zip(
                ("u_magnitude", "u_phase_rad"), factors, texts(result, ".//si:valueExpandedMUXMLList"), strict=True
            ):
                assert float(stated) == pytest.approx(float(k) * float(row[u]), rel=1e-12)
        re, im, r = (float(row[f"region_{name}"]) for name in ("re", "im", "r"))
        (k,) = (float(text) for text in texts(result, ".//si:ellipsoidalRegionMUXMLList/si:coverageFactorXMLList"))
        variances = [float(text) for text in texts(result, ".//si:covarianceXMLList/si:valueXMLList")]
        np.testing.assert_allclose(k**2 * np.array(variances), [re**2, r * re * im, r * re * im, im**2], rtol=1e-9)
        # One factor for both parts: the area is that of the covariance of first order.
        first = float(row["u_re"]) * float(row["u_im"]) * np.sqrt(1.0 - float(row["r"]) ** 2)
        assert np.sqrt(variances[0] * variances[3] - variances[1] ** 2) == pytest.approx(first, rel=1e-6)
    units = set(texts(root, ".//si:complexListXMLList/si:unitXMLList"))
    assert units == {r"\volt\volt\tothe{-1}\newton\tothe{-1}"}
    assert texts(root, ".//dcc:calibrationLaboratory//dcc:name/dcc:content") == ["Söhne <&\"'> </script>"]
    assert texts(root, ".//dcc:conformityXMLList") == ["pass"]
    page = (campaign / "certificate" / "certificate.html").read_text(encoding="utf-8")
    assert "&lt;/script&gt;" in page
    assert "</script>" not in page
    if not SCHEMA.is_file():
        pytest.skip(f"the schema is not at {SCHEMA}")
    xmlschema = pytest.importorskip("xmlschema")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    assert schema.validate(root), schema.error_log
    assert xmlschema.XMLSchema(str(SCHEMA)).is_valid(str(campaign / "certificate" / "certificate.xml"))
    pytest.importorskip("elementpath")
    rules = broken_rules(campaign / "certificate" / "certificate.xml", SCHEMA.with_name("dcc.sch"))
    assert {role for role, _ in rules} <= {"information"}


def test_certificates_are_read_back(certified: tuple[Path, str]) -> None:
    campaign, _ = certified
    back = read_result("certificate", campaign / "certificate" / "certificate.xml")
    table = read_result("table", campaign / "results" / "Fz-0080")
    assert back.date is not None
    found = {(value.channel, value.component): value for value in back.values}
    expected = [value for value in table.values if value.frequency_hz < 90.0 and value.phase_rad is not None]
    assert expected
    for value in expected:
        read = found[value.channel, value.component]
        assert (read.frequency_hz, read.magnitude, read.phase_rad) == pytest.approx(
            (value.frequency_hz, value.magnitude, value.phase_rad), rel=1e-12
        )
        # The table has u; of U with k above 2 half of it counts as u, and a region has one factor for both parts.
        assert 0.98 < read.u_magnitude / value.u_magnitude < 1.1
        assert 0.98 < read.u_phase_rad / value.u_phase_rad < 1.1


def test_missing_entries_are_one_list(campaign: Path, refused: RefusedCommand) -> None:
    (campaign / "certificate.toml").unlink()
    assert f"{raised.NO_CERTIFICATE_FORM.code} {campaign / 'certificate.toml'}: " in refused("certificate", campaign)
    assert main(["certificate", str(campaign), "--draft"]) == 0
    assert (campaign / "certificate.toml").read_text(encoding="utf-8") == NEW_FORM.replace("METHOD", METHOD)
    refusal = refused("certificate", campaign)
    assert f"{raised.MISSING_CERTIFICATE_ENTRIES.code} " in refusal
    keys = ("number", "operator", "begun", "issued")
    for key in (*(f"administration.{key}" for key in keys), "laboratory.name", "customer.city", "item.model"):
        assert key in refusal
    assert f"{campaign / 'certificate.toml'}: " in refused("certificate", campaign, "--draft")
    assert not (campaign / "certificate").exists()


@pytest.mark.parametrize(
    ("old", "new", "key", "code"),
    [
        ('country = "DE"', 'country = "Germany"', "laboratory.country", ""),
        ("issued = 2026-11-23", "issued = 2026-11-18", "administration.issued", raised.ISSUED_BEFORE_CALIBRATION.code),
        ('number = "2026-0815"', 'number = "a\\u0001b"', "administration.number", ""),
        ("tolerance = 0.02", "tolerance = -1", "conformity.tolerance", ""),
        ("format = 1", "format = 2", "format", ""),
        ('model = "W6"', 'model = "W6"\ncolour = "red"', "item.colour", ""),
        ("begun = 2026-11-19", "begun = 2026-11-21", "administration.ended", ""),
    ],
)
def test_a_wrong_form_is_refused_in_one_sentence(
    old: str, new: str, key: str, code: str, campaign: Path, refused: RefusedCommand
) -> None:
    edit(campaign / "certificate.toml", old, new)
    refusal = refused("certificate", campaign)
    assert f"{code} " in refusal
    assert f"certificate.toml: {key}: " in refusal
    assert not (campaign / "certificate").exists()


def test_results_of_other_inputs_and_none_are_refused(campaign: Path, refused: RefusedCommand) -> None:
    edit(campaign / "rig.toml", "mass = 2.4063", "mass = 2.5")
    refusal = refused("certificate", campaign)
    assert f"{raised.OUTDATED_RESULTS.code} " in refusal
    assert "rig.toml" in refusal
    shutil.rmtree(campaign / "results")
    assert f"{campaign / 'results'}" in refused("certificate", campaign)


def test_an_expired_certificate_of_an_input_refuses_it(campaign: Path, refused: RefusedCommand) -> None:
    stated = 'mass = { value = 2.4063, U = 0.0004, k = 2, certificate = "M-1", valid_until = 2020-01-01 }'
    edit(campaign / "rig.toml", "mass = 2.4063\nmass_uncertainty = 0.0002", stated)
    refusal = refused("certificate", campaign)
    assert f"{raised.EXPIRED_CERTIFICATES.code} " in refusal
    assert all(text in refusal for text in ("load.mass", "M-1", "2020-01-01"))


def test_existing_certificate_is_replaced_only_by_force(campaign: Path, refused: RefusedCommand) -> None:
    (campaign / "certificate").mkdir()
    (campaign / "certificate" / "certificate.xml").write_bytes(b"of 2026-0815")
    edit(campaign / "certificate.toml", "2026-0815", "2026-0816")
    assert "--force" in refused("certificate", campaign)
    assert (campaign / "certificate" / "certificate.xml").read_bytes() == b"of 2026-0815"
    assert main(["certificate", str(campaign), "--force"]) == 0
    assert b"2026-0816" in (campaign / "certificate" / "certificate.xml").read_bytes()


def test_smallest_uncertainty_and_k_of_the_form_apply(campaign: Path) -> None:
    found = evaluate_certificate(campaign)
    (main_one,) = (element for element in found.elements if element.main)
    (value,) = main_one.values
    assert value.k == pytest.approx(value.element.k)
    edit(campaign / "certificate.toml", "format = 1", "format = 1\nk = 2")
    edit(campaign / "certificate.toml", "[customer]", "[laboratory.cmc]\nmagnitude = 0.01\nphase = 0.5\n[customer]")
    (floored,) = next(element for element in evaluate_certificate(campaign).elements if element.main).values
    assert floored.expanded_magnitude == pytest.approx(0.01 * value.element.magnitude)
    assert floored.k == max(2.0, value.element.k)
    assert (floored.k_phase, floored.expanded_phase_rad) == (max(2.0, value.element.k_phase), 0.5)


def test_k_of_two_is_a_smallest_one(campaign: Path) -> None:
    # JCGM 100, table G.2: t of 95 % for one degree of freedom is 12.71; 2 would cover 70 %.
    edit(campaign / "certificate.toml", "format = 1", "format = 1\nk = 2")
    form = read_form(campaign / "certificate.toml")
    element = polar(1.0 + 0.0j, np.diag([1e-6, 1e-6]), 1.0, (1.0, np.inf))
    point = CurvePoint(80.0, "Fz", "Fz", "V/V", element, None, 1, 1, "element")
    stated = _stated(point, (1.0, 1.0), form)
    assert (stated.k, stated.k_phase) == (pytest.approx(12.706, abs=1e-3), 2.0)
    assert stated.expanded_magnitude == pytest.approx(12.706e-3, rel=1e-4)


def test_every_mass_has_its_u_and_certificate(campaign: Path) -> None:
    old = "internal_mass = 0.214\ninternal_mass_uncertainty = 0.0005\n"
    new = 'internal_mass = { value = 0.214, U = 0.0012, k = 2, certificate = "M-7", laboratory = "Lab" }\n'
    edit(campaign / "rig.toml", old, new)
    (load,) = _loads([load_manifest(campaign / "Fz-0080")])
    assert [(one.name, one.mass_kg, one.expanded_kg, one.certificate) for one in load.masses] == [
        ("Load", 2.4063, pytest.approx(4e-4), ""),
        ("Further parts", 0.1835, pytest.approx(2e-4), ""),
        ("Internal mass of the item", 0.214, pytest.approx(1.2e-3), "M-7"),
    ]


def test_effects_that_u_does_not_include_are_stated_once() -> None:
    delayed = [
        Notice(CAMERA_DELAYED, "exposure", late="left", delay_us=us, phase_mrad=1.0, frequency_hz=80.0, u_mrad=0.1)
        for us in (2.0, 3.0)
    ]
    aliases = Notice(HIGH_HARMONICS_NOT_ASSESSED, "force", rate_hz=1000.0, aliases="900 Hz")
    blur = Notice(MOTION_BLUR, "exposure", exposure_ms=1.0, bias_percent=0.5)
    of_scope = coverage_notice("within these releases", "another load", "Fz")
    older = [
        Notice.from_row({"severity": severity, "where": "", "text": text})
        for severity, text in (("info", "not assessed, not in U: cables"), ("warning", "clipped"))
    ]
    found = _not_assessed([*delayed, aliases, blur, of_scope, *older])
    harmonics = aliases.text.partition(":")[0]
    assert found == (f"{delayed[0].text} {delayed[0].effect}", harmonics[:1].lower() + harmonics[1:], older[0].text)


def many(found: Certificate, count: int) -> Certificate:
    """The same certificate with its first result at many frequencies."""
    first = found.elements[0]
    values = tuple(replace(first.values[0], frequency_hz=10.0 + index / 7) for index in range(count))
    deviation, verdicts = first.deviation * count, first.verdicts * count
    return replace(found, elements=(replace(first, values=values, deviation=deviation, verdicts=verdicts),))


def test_many_frequencies_make_lists_of_equal_length(certified: tuple[Path, str]) -> None:
    found = many(evaluate_certificate(certified[0]), 200)
    root = etree.fromstring(certificate_xml(found, b""))
    lists = root.findall(".//dcc:result//*", NAMES)
    lengths = {
        len(element.text.split()) for element in lists if element.tag.endswith(("valueXMLList", "FactorXMLList"))
    }
    assert lengths == {200}
    assert certificate_page(found).count("<tr>") > 200


def test_a_curve_prints_on_three_pages(certified: tuple[Path, str], browser: Any, tmp_path: Path) -> None:
    """Six outputs at twelve frequencies, with every figure and budget."""
    found = evaluate_certificate(certified[0])
    curves = []
    for element in found.elements:
        frequencies = [80.0 + 20.0 * index for index in range(12)]
        values = tuple(replace(element.values[0], frequency_hz=frequency) for frequency in frequencies)
        points = tuple(replace(element.points[0], frequency_hz=frequency) for frequency in frequencies)
        lists = {"deviation": element.deviation * 12, "verdicts": element.verdicts * 12}
        curves.append(replace(element, values=values, points=points, **lists))
    page = tmp_path / "certificate.html"
    page.write_text(certificate_page(replace(found, elements=tuple(curves))), encoding="utf-8")
    opened = Page(browser, page)
    assert opened.page.locator("figure img").count() == 1
    opened.page.pdf(path=tmp_path / "certificate.pdf", prefer_css_page_size=True, print_background=True)
    pages = re.findall(rb"/Type\s*/Page\b(?!s)", (tmp_path / "certificate.pdf").read_bytes())
    assert 1 < len(pages) <= 3
    opened.close()


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("mV/V", r"\milli\volt\volt\tothe{-1}"),
        ("V", r"\volt"),
        ("pC", r"\pico\coulomb"),
        ("1", r"\one"),
        ("V/(N·m)", r"\volt\newton\tothe{-1}\metre\tothe{-1}"),
        ("(mV/V)/N", r"\milli\volt\volt\tothe{-1}\newton\tothe{-1}"),
        ("V/(m/s^2)", r"\volt\metre\tothe{-1}\second\tothe{2}"),
    ],
)
def test_units_are_those_of_the_digital_si(unit: str, text: str) -> None:
    assert dsi_unit(unit) == text


def test_an_unknown_unit_is_refused() -> None:
    for unit in ("counts", "", "V/", "/N", "V//N", "V/(m", "V)", "(m/s)^2"):
        with pytest.raises(ValueError, match="V"):
            dsi_unit(unit)


def test_the_document_shows_the_draft() -> None:
    assert NEW_FORM.replace("METHOD", METHOD) in examples((DOCS / "certificate.md").read_text(encoding="utf-8"))


def test_every_clause_of_the_auditors_list_is_found_in_the_xml(certified: tuple[Path, str]) -> None:
    """Clauses of ISO/IEC 17025:2017, 7.8.2.1 a to p and 7.8.4.1 a to f; each element that the list names exists."""
    document = (DOCS / "certificate.md").read_text(encoding="utf-8").partition("## An auditor's list")[2]
    table = [
        line.strip("|").split("|") for line in document.partition("\n## ")[0].splitlines() if line.startswith("| ")
    ]
    clauses = [row[0].strip() for row in table[1:]]
    general, calibration = clauses.index("7.8.2.1 a"), clauses.index("7.8.4.1 a")
    assert clauses[general : general + 16] == ["7.8.2.1 a", *"bcdefghijklmnop"]
    assert clauses[calibration : calibration + 6] == ["7.8.4.1 a", *"bcdef"]
    root = etree.parse(certified[0] / "certificate" / "certificate.xml").getroot()
    tags = {etree.QName(element).localname for element in root.iter(etree.Element)}
    names = {name for row in table[1:] for name in re.findall(r"`(\w+)`", row[-1])}
    assert len(names) > 15
    assert names <= tags, names - tags
    statements = set(texts(root, ".//dcc:statement/dcc:name/dcc:content"))
    page = (certified[0] / "certificate" / "certificate.html").read_text(encoding="utf-8")
    for row in table[1:]:
        for name in re.findall(r"Statements, (\w+(?: \w+)?)", row[3]):
            assert name == "Remarks" or name in statements, name
            assert name == "Remarks" or f"<dt>{name}</dt>" in page, name


def _relative_variances(inputs: list[dict[str, str]]) -> dict[str, float]:
    """Return the variance of the relative magnitude by the key of each input, of exported inputs of one value."""
    found: dict[str, float] = {}
    for row in inputs:
        value = complex(float(row["value_re"]), float(row["value_im"]))
        along = np.array([value.real, value.imag]) / abs(value) ** 2
        u, r = np.array([float(row["u_re"]), float(row["u_im"])]) * along, float(row["correlation"])
        variance = float(u @ u + 2.0 * r * u[0] * u[1])
        found[row["stated_in"]] = found.get(row["stated_in"], 0.0) + variance
    return found


def test_the_statement_of_traceability_has_the_shares_of_the_exported_inputs(
    campaign: Path, tmp_path: Path, refused: RefusedCommand
) -> None:
    assert main(["export", str(campaign / "results" / "Fz-0080"), "--inputs", "-o", str(tmp_path / "i.csv")]) == 0
    driven = [row for row in rows(tmp_path / "i.csv") if row["kind"] == "element" and row["component"] == "Fz"]
    variances = _relative_variances([row for row in driven if row["frequency_hz"].startswith("80.")])
    total = sum(variances.values())
    stated = sum(variance for key, variance in variances.items() if key)
    shares = evaluate_certificate(campaign).shares
    assert shares is not None
    assert shares.certified == 0.0
    assert shares.missing == pytest.approx(stated / total, rel=1e-3)
    assert "statements of the laboratory" in shares.statement
    form = campaign / "certificate.toml"
    edit(form, 'laboratory = "Mass laboratory"', 'laboratory = "Mass laboratory"\ninputs = ["internal_mass"]')
    covered = evaluate_certificate(campaign).shares
    assert covered is not None
    internal = variances["rig.toml: sensor.internal_mass"] / total
    assert internal > 0.05
    assert covered.certified == pytest.approx(internal, rel=1e-3)
    assert covered.missing == pytest.approx(shares.missing - internal, rel=1e-3)
    edit(form, '["internal_mass"]', '["internal_mas"]')
    assert raised.UNKNOWN_CERTIFIED_INPUT.code in refused("certificate", campaign)
