"""The comparison of results: formulas against closed forms and simulated laboratories, files and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from page_outline import self_contained
from support import documented_columns, folder_contents, refusals, rows

from fusion.cli import main
from fusion.report.h5 import open_results, read_notices
from fusion.sensor import result_notices as raised
from fusion.sensor.compare.comparison_inputs import read_result
from fusion.sensor.compare.comparison_report import COMPARISON
from fusion.sensor.compare.consistency import complex_normalised_error, drift, normalised_error, reference_value
from shakercal._common.notices import Notice


def test_reference_of_independent_results_is_that_of_the_closed_form() -> None:
    value, u = np.array([10.0, 10.3, 9.8]), np.array([0.2, 0.3, 0.4])
    found = reference_value(value, np.diag(u**2))
    weights = u**-2 / np.sum(u**-2)
    assert found.value == pytest.approx(weights @ value)
    assert found.u == pytest.approx(np.sum(u**-2) ** -0.5)
    assert found.expanded == pytest.approx(2.0 * np.sqrt(u**2 - found.u**2)), "Cox 2002, equation 9"
    assert found.chi_squared == pytest.approx(np.sum(((value - found.value) / u) ** 2))
    assert found.used.all()


def test_an_outlier_leaves_the_largest_consistent_subset() -> None:
    u = np.full(4, 0.1)
    found = reference_value(np.array([1.0, 1.05, 3.0, 0.97]), np.diag(u**2))
    assert found.used.tolist() == [True, True, False, True]
    assert found.expanded[2] == pytest.approx(2.0 * np.sqrt(0.1**2 + found.u**2)), "one left out is independent of it"
    assert abs(found.normalised[2]) > 1.0


def test_three_laboratories_of_which_two_share_an_input_are_covered() -> None:
    """Generalised least squares against its closed form; 1000 draws of errors, the mean, deviations and chi-square."""
    rng, draws, separate = np.random.default_rng(8), 1000, np.array([0.10, 0.15, 0.12])
    common = np.array([0.12, 0.12, 0.0])
    covariance = np.diag(separate**2) + np.outer(common, common)
    values = 5.0 + common * rng.standard_normal((draws, 1)) + separate * rng.standard_normal((draws, 3))
    found = [reference_value(row, covariance) for row in values]
    inverse = np.linalg.inv(covariance)
    assert found[0].u == pytest.approx(inverse.sum() ** -0.5)
    whole = [one for one in found if one.used.all()]
    assert 0.93 < len(whole) / draws < 0.97, "chi-square refutes one in twenty"
    weights = inverse.sum(axis=0) / inverse.sum()
    means, of_whole = values @ weights, np.array([one.used.all() for one in found])
    np.testing.assert_allclose([one.value for one in whole], means[of_whole], rtol=1e-12)
    assert 0.93 < np.mean(np.abs(means - 5.0) <= 2.0 * found[0].u) < 0.97
    deviations = (values - means[:, None]) / whole[0].expanded
    assert np.all(np.abs(np.mean(np.abs(deviations) <= 1.0, axis=0) - 0.9545) < 0.025)


def test_a_deviation_of_three_u_is_found_and_a_shared_error_cancels() -> None:
    value = np.array([1.0, 1.0 + 3 * 0.2 * 2**0.5])
    assert abs(normalised_error(value, 0.01 * np.eye(2))[0, 1]) == pytest.approx(3.0)
    assert abs(normalised_error(value, 0.01 * np.eye(2) + 0.04)[0, 1]) == pytest.approx(3.0)


def test_drift_is_that_of_many_draws() -> None:
    year, u = np.array([2020.0, 2021.0, 2024.0, 2025.0]), np.array([0.1, 0.2, 0.1, 0.3])
    rng = np.random.default_rng(2)
    covariance = np.diag(u**2)
    found = [drift(year, 3.0 + 0.05 * (year - 2020.0) + u * rng.standard_normal(4), covariance) for _ in range(1000)]
    slopes = np.array([slope for slope, _ in found])
    assert slopes.mean() == pytest.approx(0.05, abs=4 * slopes.std() / 1000**0.5)
    assert slopes.std() == pytest.approx(found[0][1], rel=0.1)


def test_two_results_that_contradict_each_other_have_no_reference() -> None:
    found = reference_value(np.array([1.0, 2.0]), 0.01 * np.eye(2))
    assert not found.used.any()
    assert np.isnan(found.value)
    assert np.isnan(found.normalised).all()


def test_honest_laboratories_agree_about_complex_values_in_95_percent() -> None:
    """Real and imaginary parts are drawn in Cartesian coordinates about a truth at 40 degrees, 1000 pairs."""
    rng, draws = np.random.default_rng(3), 1000
    truth, u_size, u_turn = 2.0 * np.exp(0.7j), np.array([0.004, 0.010]), np.array([0.003, 0.001])
    radial, across = rng.standard_normal((2, draws, 2))
    value = truth * (1.0 + u_size / 2.0 * radial + 1j * u_turn * across)
    share = np.mean([complex_normalised_error(pair, u_size, u_turn)[0, 1] <= 1.0 for pair in value])
    assert 0.925 < share < 0.972


def test_complex_values_on_the_edge_of_the_region_have_an_error_of_1() -> None:
    """sqrt(5.991) = 2.4477 standard uncertainties of the difference are its edge (JCGM 102, 6.5)."""
    u = np.array([0.003, 0.004])
    values = np.array([1.0 + 0.0j, 1.0 + 2.4477 * 0.005])
    assert complex_normalised_error(values, u, np.array([0.01, 0.01]))[0, 1] == pytest.approx(1.0, rel=1e-4)
    assert np.isnan(complex_normalised_error(values * [1.0, np.nan], u, u)[0, 1])


HEAD = "frequency_hz,channel,component,magnitude,U_magnitude,k,phase_rad,U_phase_rad,unit"


def table(*values: tuple[float, float, float], unit: str = "(V/V)/N", head: str = HEAD) -> str:
    """A table of Fz per Fz: frequency, magnitude, its U."""
    return "\n".join([head, *(f"{f},Fz,Fz,{m},{u},2,-0.01,0.002,{unit}" for f, m, u in values)]) + "\n"


def notices_of(folder: Path) -> tuple[Notice, ...]:
    """The notices of a comparison."""
    with open_results(folder / "comparison.h5") as file:
        return read_notices(file)


def test_tables_become_a_page_and_a_table(tmp_path) -> None:
    (tmp_path / "a.csv").write_text(table((80.0, 2e-7, 2e-10), (160.0, 2.1e-7, 2e-10)))
    (tmp_path / "b.csv").write_text(table((80.01, 2.002e-7, 2e-10), (200.0, 2.2e-7, 2e-10)))
    out = tmp_path / "out"
    dates = ["--date", "one=2024-01-01", "--date", "two=2026-01-01"]
    names = [f"one={tmp_path / 'a.csv'}", f"two={tmp_path / 'b.csv'}"]
    assert main(["compare", *names, *dates, "-o", str(out)]) == 0
    one, two = (row for row in rows(out / "comparison.csv") if row["quantity"] == "magnitude")
    assert float(one["reference"]) == pytest.approx(2.001e-7)
    assert float(one["u_reference"]) == pytest.approx(1e-10 / 2**0.5)
    assert float(two["E_n_largest_pair"]) == pytest.approx(2e-10 / (2 * 2**0.5 * 1e-10))
    assert float(two["E_n"]) == pytest.approx(1e-10 / (2 * np.sqrt(1e-20 - 0.5e-20)))
    assert float(one["per_year"]) == pytest.approx(1e-10, rel=2e-3)
    assert list(one) == documented_columns("comparison.md", "comparison.csv")
    assert [column.name for column in COMPARISON] == list(one)
    assert float(two["E_n_complex_largest_pair"]) == pytest.approx(2e-10 / (2**0.5 * 1e-10) / 5.99146**0.5)
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert "chart-Fz-Fz" in page
    text = "".join(self_contained(page).text)
    assert "Results agree" in text
    assert "U covers all 2 values" in text
    assert "largest |E_n| of a pair 0.71: one and two, magnitude of Fz per Fz, 80.0050 Hz" in text
    (unmatched,) = (notice for notice in notices_of(out) if notice.code == raised.UNMATCHED_VALUES.code)
    assert unmatched.values == {"count": 2}


def test_a_difference_beyond_its_u_is_the_verdict(tmp_path, capsys) -> None:
    for name, value in (("a", 2e-7), ("b", 2e-7 + 6e-10), ("c", 2e-7)):
        (tmp_path / f"{name}.csv").write_text(table((80.0, value, 2e-10)))
    assert main(["compare", *(str(tmp_path / f"{name}.csv") for name in "abc"), "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "Results differ: U does not cover 1 of 2 values (largest |E_n| of a pair 2.12: " in told  # 6/(2·√2·1)


def test_of_several_kinds_the_element_counts_and_ratios_meet_ratios(tmp_path) -> None:
    head = HEAD + ",kind"
    rows_a = [f"80,Fz,Fz,{m},2e-10,2,0,0.01,u,{kind}" for m, kind in ((2.0e-7, "element"), (2.5e-7, "ratio"))]
    (tmp_path / "a.csv").write_text("\n".join([head, *rows_a, "160,Fz,Fz,3e-7,2e-10,2,0,0.01,u,ratio"]) + "\n")
    rows_b = ["80,Fz,Fz,2.001e-7,2e-10,2,0,0.01,u,matrix", "160,Fz,Fz,3e-7,2e-10,2,0,0.01,u,element"]
    (tmp_path / "b.csv").write_text("\n".join([head, *rows_b]) + "\n")
    assert main(["compare", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "-o", str(tmp_path / "out")]) == 0
    found = [row for row in rows(tmp_path / "out" / "comparison.csv") if row["quantity"] == "magnitude"]
    assert [float(row["value"]) for row in found] == [2.0e-7, 2.001e-7]


def kinds(*values: tuple[float, str, float, str]) -> str:
    """A table of outputs per Fz: frequency, channel, magnitude, kind; U is a thousandth."""
    cells = (f"{f:.7f},{channel},Fz,{m},{m / 1000},2,0,0.01,u,{kind}" for f, channel, m, kind in values)
    return "\n".join([f"{HEAD},kind", *cells]) + "\n"


@pytest.mark.parametrize("outputs", [("Fz", "Fx"), ("bridge 1", "bridge 2")])
def test_responses_to_other_loads_are_not_compared(tmp_path, outputs) -> None:
    """A good sensor in two rigs: another output answers to other loads, here by a factor of six, some 350 times U."""
    main_output, other = outputs
    for name, response in (("a", 1e-9), ("b", 6e-9)):
        single = [(80.0, main_output, 2e-7, "ratio"), (80.0, other, response, "ratio"), (160.0, other, 1.0, "harmonic")]
        (tmp_path / f"{name}.csv").write_text(kinds(*single))
    assert main(["compare", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "-o", str(tmp_path / "out")]) == 0
    assert {row["channel"] for row in rows(tmp_path / "out" / "comparison.csv")} == {main_output}
    (left_out,) = (notice for notice in notices_of(tmp_path / "out") if notice.code == raised.RESPONSES_LEFT_OUT.code)
    assert left_out.values == {"counts": "1 of a, 1 of b"}


def test_kinds_of_one_line_are_one_value_though_their_mean_frequencies_differ(tmp_path) -> None:
    campaign = [(80.0001 + 1e-6 * n, "Fz", 2e-7, kind) for n, kind in enumerate(("ratio", "element", "matrix"))]
    (tmp_path / "a.csv").write_text(kinds(*campaign, (80.05, "Fz", 2.1e-7, "element")))
    (value, other) = read_result("a", tmp_path / "a.csv").values
    assert (value.frequency_hz, value.ratio) == (pytest.approx(80.000102, abs=1e-7), False)
    assert other.magnitude == 2.1e-7, "another line, though compare's tolerance is wider"


def test_ratios_and_elements_are_refused(tmp_path, capsys) -> None:
    (tmp_path / "a.csv").write_text(kinds((80.0, "Fz", 2e-7, "ratio")))
    (tmp_path / "b.csv").write_text(kinds((80.01, "Fz", 2e-7, "element")))
    refusal = refusals(capsys)("compare", tmp_path / "a.csv", tmp_path / "b.csv", "-o", tmp_path / "out")
    assert f"{raised.ONLY_DIFFERENT_KINDS.code} " in refusal


@pytest.mark.parametrize(
    ("phases", "declared"),
    [
        ((-0.05, 3.08, -0.10, 3.05), raised.PHASES_DIFFER_BY_180),
        ((-0.05, 0.05, -0.10, 0.10), raised.PHASES_OPPOSITE),
        ((-0.05, -0.05, -0.10, 3.05), None),
        ((-0.0005, 0.0005, -0.001, 0.001), None),
        ((-0.05, 0.09, -0.10, 0.20), None),
    ],
)
def test_different_conventions_of_two_laboratories_are_named(tmp_path, capsys, phases, declared) -> None:
    for name, of_laboratory in (("a", phases[::2]), ("b", phases[1::2])):
        values = zip((80.0, 160.0), of_laboratory, strict=True)
        cells = [f"{f},Fz,Fz,2e-7,2e-10,2,{phase},0.002,u" for f, phase in values]
        (tmp_path / f"{name}.csv").write_text("\n".join([HEAD, *cells]) + "\n")
    assert main(["compare", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "-o", str(tmp_path / "out"), "-q"]) == 0
    assert bool(capsys.readouterr().err) is (declared is not None)
    codes = {notice.code for notice in notices_of(tmp_path / "out")} & {
        raised.PHASES_DIFFER_BY_180.code,
        raised.PHASES_OPPOSITE.code,
    }
    assert codes == ({declared.code} if declared else set())


def test_a_ratio_of_a_certificate_is_a_ratio(tmp_path) -> None:
    text = CERTIFICATE.replace("Sensitivity Fz per Fz", "Ratio of output Fz to driven load Fz")
    (tmp_path / "b.xml").write_text(text)
    assert [value.ratio for value in read_result("b", tmp_path / "b.xml").values] == [True, True]


DSI = r"\milli\volt\per\volt\per\newton"
CERTIFICATE = (
    '<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si"><dcc:administrativeData>'
    "<dcc:coreData><dcc:uniqueIdentifier>K 7</dcc:uniqueIdentifier>"
    "<dcc:endPerformanceDate>2026-03-01</dcc:endPerformanceDate>"
    "</dcc:coreData></dcc:administrativeData><dcc:measurementResults><dcc:measurementResult><dcc:results><dcc:result><dcc:name>"
    "<dcc:content>Sensitivity Fz per Fz</dcc:content></dcc:name><dcc:data><dcc:list>"
    '<dcc:quantity refType="vib_frequency"><si:realListXMLList><si:valueXMLList>80 160</si:valueXMLList>'
    r"<si:unitXMLList>\hertz</si:unitXMLList></si:realListXMLList></dcc:quantity>"
    '<dcc:quantity refType="basic_measuredValue"><si:realListXMLList><si:valueXMLList>2.002e-4 2.1e-4</si:valueXMLList>'
    f"<si:unitXMLList>{DSI}</si:unitXMLList>"
    "<si:measurementUncertaintyUnivariateXMLList><si:expandedMUXMLList><si:valueExpandedMUXMLList>2e-7</si:valueExpandedMUXMLList>"
    "<si:coverageFactorXMLList>2</si:coverageFactorXMLList></si:expandedMUXMLList></si:measurementUncertaintyUnivariateXMLList>"
    "</si:realListXMLList></dcc:quantity></dcc:list></dcc:data></dcc:result></dcc:results></dcc:measurementResult>"
    "</dcc:measurementResults></dcc:digitalCalibrationCertificate>"
)


def test_a_certificate_in_another_unit_meets_a_table(tmp_path) -> None:
    (tmp_path / "a.csv").write_text(table((80.0, 2e-7, 2e-10)))
    (tmp_path / "b.xml").write_text(CERTIFICATE)
    out = tmp_path / "out"
    paths = [str(tmp_path / "a.csv"), str(tmp_path / "b.xml")]
    assert main(["compare", *paths, "--date", "a=2025-03-01", "-o", str(out)]) == 0
    one, two = (row for row in rows(out / "comparison.csv") if row["quantity"] == "magnitude")
    assert one["unit"] == two["unit"] == "(V/V)/N"
    assert float(two["value"]) == pytest.approx(2.002e-7)
    assert float(two["u"]) == pytest.approx(1e-10)
    assert float(one["per_year"]) == pytest.approx(2e-10, rel=2e-3), "dated by the certificate"


def complex_certificate(unit: str, variance: str) -> str:
    """The certificate with complex values in mV/V/N and their covariance in a unit instead of magnitudes."""
    start = CERTIFICATE.index('<dcc:quantity refType="basic_measuredValue">')
    end = CERTIFICATE.index("</dcc:list>")

    def column(*numbers: str) -> str:
        cells = (
            f"<si:covarianceXMLList><si:valueXMLList>{number}</si:valueXMLList><si:unitXMLList>{unit}</si:unitXMLList>"
            "</si:covarianceXMLList>"
            for number in numbers
        )
        return f"<si:columnXMLList>{''.join(cells)}</si:columnXMLList>"

    matrix = column(variance, "0") + column("0", variance)
    region = (
        "<si:measurementUncertaintyBivariateXMLList><si:ellipsoidalRegionMUXMLList><si:covarianceMatrixXMLList>"
        f"{matrix}</si:covarianceMatrixXMLList></si:ellipsoidalRegionMUXMLList></si:measurementUncertaintyBivariateXMLList>"
    )
    values = (
        "<dcc:quantity><si:complexListXMLList><si:valueRealXMLList>2.002e-4 2.1e-4</si:valueRealXMLList>"
        f"<si:valueImagXMLList>0 0</si:valueImagXMLList><si:unitXMLList>{DSI}</si:unitXMLList>{region}"
        "</si:complexListXMLList></dcc:quantity>"
    )
    return CERTIFICATE[:start] + values + CERTIFICATE[end:]


@pytest.mark.parametrize(
    ("unit", "variance"),
    [
        (r"\milli\volt\tothe{2}\volt\tothe{-2}\newton\tothe{-2}", "1e-14"),
        (r"\volt\tothe{2}\volt\tothe{-2}\newton\tothe{-2}", "1e-20"),
    ],
)
def test_a_covariance_counts_in_the_unit_stated(tmp_path, unit: str, variance: str) -> None:
    (tmp_path / "b.xml").write_text(complex_certificate(unit, variance))
    one, two = read_result("b", tmp_path / "b.xml").values
    assert (one.magnitude, two.magnitude) == pytest.approx((2.002e-4, 2.1e-4))
    assert (one.u_magnitude, two.u_magnitude) == pytest.approx((1e-7, 1e-7)), "in mV/V/N"
    assert one.u_phase_rad == pytest.approx(1e-7 / 2.002e-4)


CERTIFIED_CODE = raised.WRONG_CERTIFIED_RESULT.code
BROKEN_CERTIFICATES = [  # the text, and a code, key or value of the refusal
    (complex_certificate(r"\milli\volt\tothe{2}", "1e-14"), "b.xml: "),
    (CERTIFICATE[:-40], "XML"),
    ("<a/>", "DCC"),
    ('<!DOCTYPE a [<!ENTITY b "c">]>' + CERTIFICATE, "b.xml: "),
    (CERTIFICATE.replace("K 7", ""), "dcc:uniqueIdentifier"),
    (CERTIFICATE.replace("80 160", "80"), "b.xml: "),
    (CERTIFICATE.replace("2.1e-4", "many"), "si:valueXMLList"),
    (CERTIFICATE.replace("2.1e-4", "nan"), "nan"),
    (CERTIFICATE.replace(">2e-7<", "><"), "si:valueExpandedMUXMLList"),
    (CERTIFICATE.replace("expandedMUXMLList>", "noneXMLList>"), "b.xml: "),
    (CERTIFICATE.replace(DSI, r"\furlong"), "furlong"),
    (CERTIFICATE.replace(DSI, r"\giga\metre\tothe{999}"), "{999}"),
    (CERTIFICATE.replace(DSI, r"\milli\volt\per\newton"), f"{raised.UNIT_NOT_CONVERTIBLE.code} "),
    (CERTIFICATE.replace("2026-03-01", "March"), "March"),
    (CERTIFICATE.replace(" per Fz", ""), f"{CERTIFIED_CODE} "),
    ("<a>" * 100_000, "XML"),
]


@pytest.mark.parametrize(("text", "found"), BROKEN_CERTIFICATES)
def test_certificates_that_cannot_be_compared_are_one_sentence(tmp_path, capsys, text, found) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    (tmp_path / "b.xml").write_text(text)
    before = folder_contents(tmp_path)
    assert main(["compare", str(tmp_path / "a.csv"), str(tmp_path / "b.xml"), "-o", str(tmp_path / "out")]) == 2
    refusal = capsys.readouterr().err
    assert found in refusal
    assert "b.xml" in refusal
    assert len(refusal.strip().splitlines()) == 1
    assert folder_contents(tmp_path) == before


GOOD = table((80.0, 2e-7, 2e-10))
COLUMNS, CELL = raised.WRONG_RESULT_TABLE.code, raised.WRONG_RESULT_CELL.code
BROKEN = [  # the text, and the code, file, key or value of the refusal
    ("", f"{COLUMNS} "),
    ("\x00\x01", ""),
    (GOOD.replace("magnitude,U", "size,U"), "b.csv: magnitude: "),
    (GOOD.replace(",U_magnitude", ",x"), "b.csv: U_magnitude: "),
    (GOOD.replace("2e-07,", "nan,"), "b.csv: magnitude: "),
    (GOOD.replace("2e-07,", "-2e-07,"), "b.csv: magnitude: "),
    (GOOD.replace("2e-10,2,", "0,2,"), f"{CELL} "),
    (GOOD.replace("2e-10,2,", "2e-10,0.5,"), "b.csv: k: "),
    (GOOD.replace("2e-10,2,", "many,2,"), '"many"'),
    (GOOD.replace(",Fz,Fz", ",,Fz"), "b.csv: channel: "),
    (GOOD + GOOD.splitlines()[1] + "\n", f"{CELL} "),
    (table((90.0, 2e-7, 2e-10)), f"{raised.NO_COMMON_VALUE.code} "),
    (table((80.0, 2e-7, 2e-10), unit="mV/N"), f"{raised.UNIT_NOT_CONVERTIBLE.code} "),
    (HEAD + "\n", f"{COLUMNS} "),
    (GOOD.replace("80.0,", "1e300,"), "b.csv: frequency_hz: "),
    (kinds((80.0, "Fz", 2e-7, "mean")), "b.csv: kind: "),
]


@pytest.mark.parametrize(("text", "found"), BROKEN)
def test_tables_that_cannot_be_compared_are_one_sentence(tmp_path, capsys, text, found) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    (tmp_path / "b.csv").write_text(text)
    before = folder_contents(tmp_path)
    assert found in refusals(capsys)("compare", tmp_path / "a.csv", tmp_path / "b.csv", "-o", tmp_path / "out")
    assert folder_contents(tmp_path) == before


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["a.csv"], f"{raised.WRONG_COMPARISON_OPTION.code} a.csv: "),
        (["b.csv", "--date", "c=2024-01-01"], f"{raised.WRONG_COMPARISON_OPTION.code} --date: c: "),
        (["b.csv", "--date", "a=yesterday"], f"{raised.WRONG_COMPARISON_OPTION.code} --date: a: "),
        (["nowhere.csv"], "nowhere.csv"),
        (["empty"], f"{raised.NO_RESULT_TABLE.code} empty: "),
        ([], f"{raised.WRONG_RESULT_COUNT.code} "),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, capsys, monkeypatch, more, found) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    (tmp_path / "b.csv").write_text(GOOD)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert found in refusals(capsys)("compare", "a.csv", *more, "-o", "out")
