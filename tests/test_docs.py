"""Documents promise public names only, their links lead somewhere, and the published comparison is filled in."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from fusion.cli import commands

ROOT = Path(__file__).resolve().parent.parent
INSIDE = {"architecture.md", "papers.md"}
"""Documents of the inside: what each room is for, and which of them computes a published number."""
DOCUMENTS = [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").glob("*.md") if path.name not in INSIDE)]
PACKAGES = ("photogram", "shaker", "fusion")
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


def test_the_readme_lists_every_command() -> None:
    told = re.findall(r"^shakercal ([a-z][a-z-]*)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert {command.name for command in commands()} <= set(told)


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
