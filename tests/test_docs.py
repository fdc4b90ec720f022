"""Documents promise public names only, their links lead somewhere, and the published comparison is filled in."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from contracts import slow

from fusion.cli import commands

ROOT = Path(__file__).resolve().parent.parent
INSIDE = {"architecture.md", "papers.md"}
"""Documents of the inside: what each room is for, and which of them computes a published number."""
DOCUMENTS = [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").rglob("*.md") if path.name not in INSIDE)]
PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
IMPORT = re.compile(rf"^ *from ({'|'.join(PACKAGES)})(\.[\w.]+)? import (.+)$", re.MULTILINE)
NAME = re.compile(rf"\b({'|'.join(PACKAGES)})\.([A-Za-z_]\w*)(\.\w+)*")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_what_is_exported(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for package, inside, names in IMPORT.findall(text):
        assert not inside, f"{document.name} imports from {package}{inside}, which is not public"
        exported = importlib.import_module(package).__all__
        assert set(names.split(", ")) <= set(exported), f"{document.name}: from {package} import {names}"
    for package, name, _ in NAME.findall(text):
        assert name in importlib.import_module(package).__all__, f"{document.name}: {package}.{name}"


@pytest.mark.parametrize("document", [ROOT / "CHANGELOG.md", *DOCUMENTS], ids=lambda path: path.name)
def test_links_of_documents_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", document.read_text(encoding="utf-8")):
        assert "://" in target or (document.parent / target).exists(), f"{document.name}: {target}"


def test_the_overview_lists_every_command() -> None:
    told = re.findall(
        r"^shakercal ([a-z][a-z-]*)", (ROOT / "docs/overview.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {command.name for command in commands()} <= set(told)


def test_every_page_stands_in_the_contents() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    listed = set(
        re.findall(r"^([\w/-]+)$", "".join(re.findall(r"```\{toctree\}(.*?)```", index, re.DOTALL)), re.MULTILINE)
    )
    pages = {path.relative_to(ROOT / "docs").with_suffix("").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages - {"index"} <= listed


LONG = ("compensated_release", "sensitivity_of_a_recording")
"""Examples of seconds: the quick tests call what they call."""
EXAMPLES = sorted((ROOT / "examples").glob("*.py"), key=lambda path: (path.stem in LONG, path))


@pytest.mark.parametrize("example", [*EXAMPLES[:-2], *slow(*EXAMPLES[-2:])], ids=lambda path: path.stem)
def test_examples_run(example: Path) -> None:
    told = subprocess.run([sys.executable, str(example)], cwd=ROOT, capture_output=True, text=True, check=True)
    assert told.stderr == ""
    assert len(told.stdout.splitlines()) >= 5


@pytest.mark.slow
def test_the_site_is_made_without_a_warning_and_asks_for_nothing(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    build = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-E",
        "-b",
        "html",
        str(ROOT / "docs"),
        str(tmp_path),
    ]
    told = subprocess.run(build, capture_output=True, text=True, check=False)
    # Every warning is an error; a notebook's kernel may write a message of its own when it ends.
    assert told.returncode == 0, told.stderr
    assert "WARNING" not in told.stderr
    options = _text(tmp_path / "_static" / "documentation_options.js")
    assert "SHOW_SEARCH_SUMMARY: false" in options  # summaries would be fetched, which files do not allow
    for page in tmp_path.rglob("*.html"):
        addresses = re.findall(r'(?:src|href)="(https?://[^"]*)"', page.read_text(encoding="utf-8"))
        loaded = [a for a in addresses if re.search(r"\.(js|css|woff2?|png)(\?|$)", a)]
        assert loaded == [], page.name
    output = "cell_output" in _text(tmp_path / "notebooks" / "first-result.html")
    assert output == (importlib.util.find_spec("myst_nb") is not None)


def test_the_published_comparison_has_its_tables_filled_and_its_pictures():
    page = ROOT / "docs" / "nitsche2018.md"
    text = page.read_text(encoding="utf-8")
    for name in ("table 1", "agreement", "figure 14"):
        (content,) = re.findall(f"<!-- {name} -->(.*?)<!-- end of {name} -->", text, re.DOTALL)
        assert content.count("|") > 20
    pictures = re.findall(r"\((images/[^)]*)\)", text)
    assert len(pictures) == 5
    for picture in pictures:
        assert (page.parent / picture).read_bytes().startswith(b"\x89PNG")


def test_tables_of_modules_are_the_first_lines_of_their_docstrings() -> None:
    spec = importlib.util.spec_from_file_location("modules", ROOT / "docs" / "modules.py")
    assert spec is not None
    assert spec.loader is not None
    modules = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(modules)
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for name, table in modules.module_tables().items():
        assert f"<!-- {name} -->\n{table}\n<!-- end of {name} -->\n" in page, "run: python docs/modules.py"


def test_the_version_to_cite_is_that_of_the_program() -> None:
    version = importlib.import_module("shakercal").__version__
    assert f"version: {version}\n" in _text(ROOT / "CITATION.cff")
    assert set(re.findall(r"\b\d+\.\d+\.\d+\b", _text(ROOT / "docs" / "citation.md"))) == {version}


def test_every_image_is_shown_and_every_drawing_is_made() -> None:
    images = {path.relative_to(ROOT / "docs/images").as_posix() for path in (ROOT / "docs/images").rglob("*.*")}
    texts = [path.read_text(encoding="utf-8") for path in DOCUMENTS + [ROOT / "docs" / name for name in INSIDE]]
    shown = {name for text in texts for name in re.findall(r"images/([\w./-]+\.(?:png|webp|svg))", text)}
    assert images == shown
    functions = re.findall(
        r"^def ([a-z]\w*)\(\)", "".join(map(_text, (ROOT / "docs/drawings").glob("*.py"))), re.MULTILINE
    )
    assert {f"{name}.png" for name in functions} <= images


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")
