"""The certificate of a matrix campaign: one matrix per frequency, on A4, in the XML as a table with indices."""

from __future__ import annotations

import html
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import Page
from certificates import FORM, NAMES, SCHEMA, acknowledged, broken_rules, texts
from lxml import etree
from support import RefusedCommand, rows

from fusion.cli import main
from fusion.sensor import result_notices as raised
from fusion.sensor.certificate.certificate_evaluation import evaluate_certificate
from fusion.sensor.compare.comparison_inputs import read_result

pytestmark = pytest.mark.slow
MOST_PAGES = 4
OUTPUTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


@pytest.fixture(scope="module")
def campaign(commanded: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A matrix campaign with its certificate, a specimen."""
    folder = Path(shutil.copytree(commanded("matrix"), tmp_path_factory.mktemp("matrix") / "matrix"))
    (folder / "certificate.toml").write_text(FORM, encoding="utf-8")
    codes = {notice.code for notice in warnings_of(folder)}
    (folder / "certificate.toml").write_text(FORM + acknowledged(*sorted(codes)), encoding="utf-8")
    assert main(["certificate", str(folder), "--specimen"]) == 0
    return folder


def warnings_of(folder: Path) -> list[Any]:
    """The warnings that a certificate needs acknowledged, by the notices of its results."""
    from fusion.campaign.recording_results import read_recorded

    recorded = [read_recorded(path.parent) for path in sorted((folder / "results").glob("*/result.h5"))]
    return [notice for entry in recorded for notice in entry.notices if notice.severity == "warning"]


def matrix_rows(folder: Path) -> dict[tuple[float, str, str], dict[str, str]]:
    """Rows of the campaign's table by frequency, output and load."""
    table = [row for row in rows(folder / "results" / "curve.csv") if row["kind"] == "matrix"]
    return {(float(row["frequency_hz"]), row["channel"], row["component"]): row for row in table}


def numbers(table: etree._Element, kind: str, path: str) -> list[float]:
    """The numbers of a column by its type."""
    (column,) = [q for q in table.findall("dcc:quantity", NAMES) if kind in q.get("refType").split()]
    return [float(text) for text in column.find(f".//si:{path}", NAMES).text.split()]


def words(table: etree._Element, kind: str) -> list[str]:
    """The names of an index by its type."""
    (column,) = [q for q in table.findall("dcc:quantity", NAMES) if kind in q.get("refType").split()]
    return column.find("dcc:charsXMLList", NAMES).text.split()


def test_the_xml_is_one_table_per_kind_of_load_with_the_numbers_of_the_table(campaign: Path) -> None:
    root = etree.parse(campaign / "certificate" / "certificate.xml").getroot()
    expected = matrix_rows(campaign)
    assert len(expected) == 108
    found = set()
    results = root.findall(".//dcc:result", NAMES)
    assert [texts(result, "dcc:name/dcc:content") for result in results] == [
        ["Sensitivity matrix per force"],
        ["Sensitivity matrix per moment"],
    ]
    for table in root.findall(".//dcc:result/dcc:data/dcc:list", NAMES):
        assert table.get("refType") == "basic_3IndexTable"
        frequencies = numbers(table, "basic_tableIndex0", "valueXMLList")
        keys = list(zip(frequencies, words(table, "basic_tableIndex1"), words(table, "basic_tableIndex2"), strict=True))
        found |= set(keys)
        columns = {
            "re": numbers(table, "force_sensitivityComplex", "valueRealXMLList"),
            "im": numbers(table, "force_sensitivityComplex", "valueImagXMLList"),
            "magnitude": numbers(table, "force_sensitivityMagnitude", "valueXMLList"),
            "phase_rad": numbers(table, "force_sensitivityPhase", "valueXMLList"),
            "U_magnitude": numbers(table, "force_sensitivityMagnitude", "valueExpandedMUXMLList"),
            "k_magnitude": numbers(table, "force_sensitivityMagnitude", "coverageFactorXMLList"),
            "U_phase_rad": numbers(table, "force_sensitivityPhase", "valueExpandedMUXMLList"),
        }
        for name, values in columns.items():
            stated = np.array([float(expected[key][name]) for key in keys])
            listed = np.array(values)
            shown = np.isfinite(listed)
            assert np.count_nonzero(shown) > 0.6 * len(keys)
            np.testing.assert_allclose(listed[shown], stated[shown], rtol=1e-12, err_msg=name)
    assert found == set(expected)
    assert len(root.findall(".//dcc:metaData/dcc:conformityXMLList", NAMES)) == 6
    if SCHEMA.is_file():
        assert etree.XMLSchema(etree.parse(SCHEMA)).validate(root)
        pytest.importorskip("elementpath")
        rules = broken_rules(campaign / "certificate" / "certificate.xml", SCHEMA.with_name("dcc.sch"))
        assert {role for role, _ in rules} <= {"information"}


def test_dcclib_of_ptb_finds_nothing_wrong(campaign: Path) -> None:
    schematron = pytest.importorskip("dcclib.validation.schematron")
    found = schematron.SchematronValidator.for_dcc().validate_file(str(campaign / "certificate" / "certificate.xml"))
    assert found.is_valid
    assert found.failed_assertions == []


def test_every_element_is_read_back(campaign: Path) -> None:
    found = read_result("certificate", campaign / "certificate" / "certificate.xml")
    expected = matrix_rows(campaign)
    assert len(found.values) == len(expected)
    for value in found.values:
        row = expected[value.frequency_hz, value.channel, value.component]
        assert value.magnitude == pytest.approx(float(row["magnitude"]), rel=1e-9)


def test_the_page_has_one_matrix_per_frequency_with_the_digits_of_the_table(campaign: Path) -> None:
    page = (campaign / "certificate" / "certificate.html").read_text(encoding="utf-8")
    tables = re.findall(r"<caption>Sensitivity matrix at ([\d.]+) Hz.*?</table>", page, re.DOTALL)
    assert len(tables) == 3
    expected, compared = matrix_rows(campaign), 0
    for table in re.finditer(r"<caption>Sensitivity matrix at ([\d.]+) Hz.*?</table>", page, re.DOTALL):
        for row in re.findall(r"<tr>(<td.*?)</tr>", table[0], re.DOTALL):
            output, *cells = re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL)
            assert len(cells) == 6
            for load, cell in zip(OUTPUTS, cells, strict=True):
                csv = next(
                    one
                    for (f, channel, component), one in expected.items()
                    if (f"{f:.4f}", channel, component) == (table[1], output, load)
                )
                first = html.unescape(cell).split("<br>")[0].replace("\N{MINUS SIGN}", "-")
                match = re.fullmatch(r"([\d.]+) ± ([\d.]+)", first)
                if match is None:
                    assert "region ± " in cell
                    continue
                size, half = float(match[1]), 0.5 * 10.0 ** -len(match[1].partition(".")[2])
                power = round(np.log10(float(csv["magnitude"]) / size))
                assert abs(size - float(csv["magnitude"]) / 10.0**power) <= 1.001 * half
                assert float(match[2]) == pytest.approx(float(csv["U_magnitude"]) / 10.0**power, rel=0.06)
                assert len(match[2].replace(".", "").lstrip("0")) == 2
                compared += 1
    assert compared > 90
    for region in re.findall(r"region ± ([\d.]+), ± ([\d.]+)", page):
        assert all(len(text.replace(".", "").lstrip("0")) <= 2 for text in region)
        assert all(float(text) > 0.0 for text in region)


def test_it_prints_on_four_pages_without_cut_tables(campaign: Path, browser: Any, tmp_path: Path) -> None:
    opened = Page(browser, campaign / "certificate" / "certificate.html")
    opened.page.set_viewport_size({"width": 680, "height": 1000})  # 180 mm at 96 dpi
    opened.page.emulate_media(media="print")
    wide = opened.page.evaluate(
        "[...document.querySelectorAll('table')].filter(one => one.scrollWidth > one.parentElement.clientWidth).length"
    )
    assert wide == 0
    opened.page.pdf(path=tmp_path / "certificate.pdf", prefer_css_page_size=True, print_background=True)
    pages = re.findall(rb"/Type\s*/Page\b(?!s)", (tmp_path / "certificate.pdf").read_bytes())
    assert 1 < len(pages) <= MOST_PAGES
    opened.close()


def test_warnings_without_acknowledgement_refuse_it(campaign: Path, tmp_path: Path, refused: RefusedCommand) -> None:
    (tmp_path / "form.toml").write_text(FORM, encoding="utf-8")
    refusal = refused("certificate", campaign, "--specimen", "--force", "--form", tmp_path / "form.toml")
    assert f"{raised.WARNINGS_NOT_REVIEWED.code} " in refusal
    assert {notice.code for notice in warnings_of(campaign)} <= set(re.findall(r"SC-\d{3}", refusal))
    page = (campaign / "certificate" / "certificate.html").read_text(encoding="utf-8")
    assert "reviewed (B. Leader, 2026-11-21)" in page


def test_the_deviation_from_static_is_that_of_the_campaign_page(campaign: Path) -> None:
    found = evaluate_certificate(campaign, specimen=True)
    expected = matrix_rows(campaign)
    for element in (one for one in found.elements if one.main):
        for value, (size, expanded, k) in zip(element.values, element.deviation, strict=True):
            row = expected[value.frequency_hz, element.channel, element.component]
            assert size == pytest.approx(float(row["relative"]) - 1.0, abs=1e-12)
            assert expanded == pytest.approx(float(row["U_relative"]), rel=1e-12)
            assert expanded / k == pytest.approx(float(row["u_relative"]), rel=1e-12)
