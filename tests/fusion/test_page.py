"""Pages in a real browser: what is drawn, told, hidden, kept and printed; and that nothing is asked of anybody."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from browsing import Page, below_the_first_screen, marks_of_pages, paper
from evaluation_factory import make_evaluation

from fusion.cli import main
from fusion.errors import ComputeError
from fusion.report.figure import RED, Figure, Scale, empty_figure
from fusion.report.folder import TEMPLATES
from fusion.report.recording_report import render_report, write_results
from fusion.report.report_notices import NO_BROWSER, NOT_PRINTED
from fusion.report.summary_pdf import find_browser, print_summary
from shakercal._common.digits import number_text, python_number, quantity_text

A4_MM = 297.0 - 2 * 16.0  # height within the margins
NASTY = "</script><b>\"'&\u2028 <!-- name"


PLOTS = """const plots = [], host = document.querySelector(`figure[data-figure='${name}'] .plot`);
  const walk = (view) => {
    if (view.model.type === "Figure") plots.push(view);
    (view.child_views ?? []).forEach(walk);
  };
  [...Bokeh.index].filter((view) => host.contains(view.el)).forEach(walk);"""
PLACE = f"""([name, panel, x, y]) => {{ {PLOTS}
  const plot = plots[panel], box = plot.canvas_view.el.getBoundingClientRect();
  return [box.x + plot.frame.x_scale.compute(x), box.y + plot.frame.y_scale.compute(y)];
}}"""
"""Where on the screen a point of a panel is."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of results with a report."""
    folder = tmp_path_factory.mktemp("results")
    write_results(make_evaluation(tmp_path_factory.mktemp("Fz")), folder, force=True)
    return folder


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page whose figures hold one mark of every kind, with names that are no markup."""
    monkeypatch.setattr("fusion.report.recording_report.draw_all", lambda _: defaultdict(list, channels=[every_mark()]))
    path = tmp_path / "page.html"
    path.write_text(render_report(make_evaluation(tmp_path / "recording")), encoding="utf-8")
    return path


def every_mark() -> Figure:
    """One mark of every kind."""
    made = empty_figure("every", 6.0, 2, 2, shared_x=False)
    first, second, third, fourth = made.panels
    x, y = np.array([1.0, 2.0, 3.0]), np.array([10.0, 100.0, 1000.0])
    first.line(x, y, "line", dashed=True)
    first.points(x, y, NASTY, half_y=0.1 * y, colour=RED, names=(NASTY, "b", "c"))
    first.band(x, 0.5 * y, [20.0, np.nan, 2000.0], "band")
    first.bounds(x, 2.0 * y, "bound")
    first.y.log, first.title, first.x.label, first.y.label = True, NASTY, "x / m", "y / m"
    first.x.limits, first.y.limits = (0.0, 4.0), (1.0, 1e4)
    second.boxes((np.zeros(2), [3.0, 4.0]), ([-0.3, 0.7], [0.3, 1.3]), "boxes", names=("p", "q"))
    second.rule([1.0, 2.0], "rule", along="x")
    second.span(0.5, 1.5, "span", along="x")
    second.y.names = ("p", NASTY)
    third.ellipse(1.0 + 2.0j, (0.5, 0.2), 0.3, label="ellipse")
    third.arrows(np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[0.5, 0.5], [0.2, -0.2]]), "arrows")
    third.text(0.0, 1.0, NASTY)
    third.equal = True
    fourth.image(np.repeat(np.uint8([[0], [255]]), 8, axis=1).repeat(4, axis=0), (-0.5, 7.5), (-0.5, 7.5))
    fourth.squares(np.array([[2.0, 2.0], [5.0, 5.0]]), 1.0, values=[1.0, np.nan], scale=Scale("RdBu", -1.0, 1.0, "v"))
    fourth.points(4.0, 4.0, values=[0.5], scale=Scale("viridis", 0.1, 1.0, "w", log=True))
    fourth.x.limits, fourth.y.limits = (-0.5, 7.5), (7.5, -0.5)
    fourth.y.second = ("other", 1.0, 2.0)
    return made.with_title("Every mark", "All of them.")


def test_every_figure_of_a_report_is_drawn(browser, results):
    for scheme, ground, most in (("light", "rgb(255, 255, 255)", 99), ("dark", "rgb(22, 22, 22)", 1)):
        opened = Page(browser, results / "report.html", color_scheme=scheme)
        names = opened.page.eval_on_selector_all("figure[data-figure]", "all => all.map((one) => one.dataset.figure)")
        assert len(names) >= 13
        for name in names[:most]:
            assert opened.draw(name).locator("canvas").count() > 0
        assert opened.page.evaluate("getComputedStyle(document.body).backgroundColor") == ground
        opened.close()


PAGES = {
    "steps": "step.html",
    "rotation": "rotation.html",
    "loads": "load.html",
    "chirp": "transfer.html",
    "masses": "identify.html",
    "elastomer": "elastomer.html",
}


@pytest.mark.slow
@pytest.mark.parametrize("preset", PAGES)
def test_every_figure_of_every_command_is_drawn(browser, preset, commanded, tmp_path):
    (page,) = commanded(preset).rglob(PAGES[preset])
    opened = Page(browser, page)
    names = opened.page.eval_on_selector_all("figure[data-figure]", "all => all.map((one) => one.dataset.figure)")
    assert names or opened.page.locator("figure img").count()
    for figure in names:
        assert opened.draw(figure).locator("canvas").count() > 0
    opened.close()
    found = paper(browser, page, tmp_path / "page.pdf")
    assert (found["missing"], found["broken"], found["blank"]) == ([], 0, [])
    if preset == "steps":
        assert below_the_first_screen(browser, page, ".front .plot") == []
        assert (found["wide"], found["summary_mm"] < A4_MM) == ([], True)


def test_hovering_shows_the_number_of_the_table(browser, results):
    """The curve's first point against the row of sensitivity.csv it stands for."""
    opened = Page(browser, results / "report.html")
    opened.draw("sensitivity")
    rows = csv.DictReader((results / "sensitivity.csv").read_text(encoding="utf-8").splitlines())
    row = next(row for row in rows if (row["channel"], row["component"]) == ("Fz", "Fz") and row["kind"] != "harmonic")
    value, half = float(row["magnitude"]), float(row["u_magnitude"]) * float(row["k_magnitude"])
    place = (float(row["frequency_hz"]), 1e7 * value)
    opened.page.mouse.move(*opened.page.evaluate(PLACE, ["sensitivity", 0, *place]))
    tip_text = opened.page.locator(".tip", has_text="±").first.inner_text()
    assert tip_text.splitlines()[0] == "driven frequency"
    label, number = tip_text.splitlines()[2].rsplit(": ", 1)
    assert label == "magnitude / 10⁻⁷ (V/V)/N"
    shown, u = (float(part) for part in number.split(" ± "))
    assert shown == pytest.approx(1e7 * value, abs=0.006e7 * half)
    assert u == pytest.approx(1e7 * half, rel=0.05)
    opened.close()


def test_every_kind_of_mark_and_no_name_is_markup(browser, drawn):
    opened = Page(browser, drawn)
    figure = opened.draw("every")
    buttons = figure.locator(".legend button")
    assert buttons.nth(1).text_content() == NASTY
    opened.page.mouse.move(*opened.page.evaluate(PLACE, ["every", 0, 1.0, 10.0]))
    tips = opened.page.locator(".tip")
    tips.filter(has_text="±").first.wait_for()
    tip_text = "\n".join(tips.all_inner_texts())
    assert "10.0 ± 1.0" in tip_text
    assert "</script><b>" in tip_text
    assert tips.locator("b").count() == 0
    buttons.nth(1).click()
    assert buttons.nth(1).get_attribute("aria-pressed") == "false"
    opened.page.mouse.move(5.0, 5.0)
    opened.page.mouse.move(*opened.page.evaluate(PLACE, ["every", 0, 1.0, 10.0]))
    opened.page.wait_for_timeout(200)
    assert "± 1.0" not in "".join(tips.all_inner_texts())
    opened.close()


def test_zooming_by_keyboard_moves_linked_axes(browser, results):
    opened = Page(browser, results / "report.html")
    opened.draw("motion-top")
    opened.draw("residuals-top")
    span = f"(name) => {{ {PLOTS} return plots[0].model.x_range.end - plots[0].model.x_range.start; }}"
    before = opened.page.evaluate(span, "residuals-top")
    opened.page.locator("figure[data-figure='motion-top'] button[aria-label='zoom in']").press("Enter")
    for name in ("motion-top", "residuals-top"):
        assert opened.page.evaluate(span, name) == pytest.approx(before / 1.5, rel=0.05)
    opened.close()


def test_a_logarithmic_axis_zooms_about_its_geometric_middle(browser, results):
    opened = Page(browser, results / "report.html")
    figure = opened.draw("channels")
    ends = f"(name) => {{ {PLOTS} const range = plots[1].model.x_range; return [range.start, range.end]; }}"
    low, high = opened.page.evaluate(ends, "channels")
    figure.get_by_role("button", name="zoom in").click()
    nearer, farther = opened.page.evaluate(ends, "channels")
    assert nearer * farther == pytest.approx(low * high)
    assert np.log(farther / nearer) == pytest.approx(np.log(high / low) / 1.5)
    opened.close()


def test_a_figure_is_saved_as_svg_and_its_data_as_csv(browser, drawn):
    opened = Page(browser, drawn)
    figure = opened.draw("every")
    with opened.page.expect_download() as kept:
        figure.get_by_role("button", name="as a vector graphic").click()
    root = ElementTree.fromstring(Path(kept.value.path()).read_bytes())
    assert root.tag.endswith("svg")
    assert len(list(root.iter())) > 100
    with opened.page.expect_download() as kept:
        figure.get_by_role("button", name="as a table").click()
    text = Path(kept.value.path()).read_text(encoding="utf-8-sig")
    rows = [row for row in csv.DictReader(io.StringIO(text, newline="")) if row["kind"] == "Points"]
    assert [(float(row["x"]), float(row["y"]), float(row["U_y"])) for row in rows[:2]] == [(1, 10, 1), (2, 100, 10)]
    assert rows[0]["name"] == NASTY
    opened.close()


def test_without_programs_the_main_figures_remain(browser, results):
    plain = browser.new_context(java_script_enabled=False)
    page = plain.new_page()
    page.goto((results / "report.html").as_uri())
    shown = page.locator("figure img.static")
    assert shown.count() >= 3
    assert all(shown.nth(k).is_visible() for k in range(shown.count()))
    plain.close()


def test_the_first_screen_holds_result_and_rig(browser, results):
    assert below_the_first_screen(browser, results / "report.html", ".scene canvas") == []
    page = (results / "report.html").read_text(encoding="utf-8")
    assert '<span class="badge">simulated data</span>' in page
    assert "· six-component transducer" in page


def test_all_figures_are_on_paper_and_the_summary_is_one_sheet(browser, results, tmp_path):
    found = paper(browser, results / "report.html", tmp_path / "report.pdf")
    assert found.pop("summary_mm") < A4_MM
    assert found == {"missing": [], "broken": 0, "wide": [], "blank": []}


def test_the_summary_is_printed_by_a_browser_of_the_machine(browser, results, tmp_path, monkeypatch):
    file = tmp_path / "summary.pdf"
    file.write_bytes(print_summary(results / "report.html", find_browser(), tmp_path))
    (marks,) = marks_of_pages(file)
    assert marks > 300
    assert [entry.name for entry in tmp_path.iterdir()] == ["summary.pdf"]
    silent = tmp_path / "browser"
    silent.write_text("#!/bin/sh\nexit 3\n", encoding="utf-8")
    silent.chmod(0o755)
    with pytest.raises(ComputeError, match="exit status 3") as caught:
        print_summary(results / "report.html", str(silent), tmp_path)
    assert caught.value.code == NOT_PRINTED.code


def test_a_pdf_file_of_a_run_needs_a_browser_and_a_free_name(
    browser, make_campaign, evaluated, refused, tmp_path, monkeypatch
):
    del browser  # where none starts, none prints
    recording, file = str(make_campaign()), tmp_path / "summary.pdf"
    assert main(["run", recording, "-q", "--pdf", str(file)]) == 0
    assert file.read_bytes().startswith(b"%PDF")
    assert "SC-900" in refused("run", recording, "--pdf", str(file))
    for name in ("BROWSERS", "PLACES", "WINDOWS_PLACES"):
        monkeypatch.setattr(f"fusion.report.summary_pdf.{name}", ())
    assert NO_BROWSER.code in refused("run", recording, "--force", "--pdf", str(file))
    assert len(evaluated) == 1


def test_pages_fit_their_window_and_have_names_for_everything(browser, results):
    opened = Page(browser, results / "report.html")
    opened.page.set_viewport_size({"width": 1400, "height": 900})
    for name in ("sensitivity", "budget", "motion-top"):
        opened.draw(name)
    assert opened.page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    opened.page.set_viewport_size({"width": 800, "height": 900})
    opened.page.wait_for_timeout(500)  # until they are drawn again
    found = opened.page.evaluate("""() => ({
      wide: document.documentElement.scrollWidth - innerWidth,
      images: document.querySelectorAll("img:not([alt])").length,
      plots: document.querySelectorAll(".plot:not([aria-label])").length,
      tables: [...document.querySelectorAll("table")].filter((one) => !one.caption).length,
      heads: document.querySelectorAll("thead th:not([scope])").length,
      buttons: [...document.querySelectorAll("button")].filter((b) => !(b.ariaLabel || b.textContent.trim())).length,
      levels: [...document.querySelectorAll("h1, h2, h3")].map((one) => Number(one.tagName[1])),
      language: document.documentElement.lang,
    })""")
    levels = found.pop("levels")
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
    assert found == {"wide": 0, "images": 0, "plots": 0, "tables": 0, "heads": 0, "buttons": 0, "language": "en"}
    opened.close()


def test_figures_print_numbers_as_tables_do(browser):
    program = (TEMPLATES / "figures.js").read_text(encoding="utf-8")
    rule = program[program.index("  /* Numbers by the rule") : program.index("  /* Ticks with the decimals")]
    random = np.random.default_rng(5)
    values = random.choice([-1.0, 1.0], 400) * 10.0 ** random.uniform(-9.0, 9.0, 400)
    halves = np.abs(values) * 10.0 ** random.uniform(-6.0, 1.0, 400)
    pairs = [
        *zip(values.tolist(), halves.tolist(), strict=True),
        (0.5, 0.0996),
        (0.0, 0.1),
        (-1e-9, 0.3),
        (1234.0, 120.0),
    ]
    context = browser.new_context()
    call = "return pairs.map(([v, u]) => [told(v, u), told(v)]);"
    told = context.new_page().evaluate(f"(pairs) => {{ {rule}; {call} }}", pairs)
    context.close()
    for (value, half), (with_u, alone) in zip(pairs, told, strict=True):
        assert with_u == quantity_text(value, half)
        assert alone == number_text(value, 6)


def test_ticks_are_told_without_programs_notation(browser, tmp_path, monkeypatch):
    made = empty_figure("every", 4.0, 2, shared_x=False)
    small, wide = made.panels
    small.line([0.0, 1.0, 2.0], [-6e-7, 0.0, 7.4e-7], "small")
    small.y.label = "reading / V"
    wide.line([1.0, 100.0, 1000.0], [2e-7, 1.0, 5.0], "wide")
    wide.x.log = wide.y.log = True
    monkeypatch.setattr("fusion.report.recording_report.draw_all", lambda _: defaultdict(list, channels=[made]))
    path = tmp_path / "page.html"
    path.write_text(render_report(make_evaluation(tmp_path / "recording")), encoding="utf-8")
    opened = Page(browser, path)
    opened.draw("every")
    texts = opened.page.evaluate(
        f"(name) => {{ {PLOTS} return plots.map((plot) => [plot.model.left[0], plot.model.below[0]].map((axis, k) => {{"
        " const range = k ? plot.model.x_range : plot.model.y_range;"
        " const ticks = axis.ticker.get_ticks(range.start, range.end, range, NaN).major;"
        " return [axis.axis_label, axis.formatter.doFormat(ticks, null), ticks]; })); }",
        "every",
    )
    opened.close()
    (reading, across), (size, frequency) = texts
    assert reading[0] == "reading / V   × 10⁻⁷"
    assert [1e-7 * python_number(text) for text in reading[1]] == pytest.approx(reading[2], abs=1e-12)
    assert "−" in reading[1][0]
    assert across[1][0] in ("0", "0.0")
    assert all(text.startswith("10") for text in size[1])
    assert "10⁻⁶" in size[1]
    assert frequency[1][-2:] == ["100", "1000"]
