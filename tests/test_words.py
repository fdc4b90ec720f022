"""The language of the code: names, first lines of docstrings, and notices that are declared once with a code."""

from __future__ import annotations

import ast
import re
import string
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from syntax_trees import nodes_of, tree_of

from fusion.commands.measure import notices_page
from fusion.errors import declared_by_stage, declared_notices

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
DIALECT = {
    *("told", "foretold", "foretelling", "beside", "aside", "course", "again", "turned", "kept", "keeper"),
    *("shelf", "undone", "uninterrupted", "claimed", "workshop", "answering", "refuted", "hoped", "nothing"),
    *("still", "instead", "among", "untold", "otherwise", "alike", "shaped", "gained", "thinned", "approach"),
    *("unseen", "sought"),
}
"""Words of no field, which no identifier contains."""
RAISED = {"Notice", "InputError", "ComputeError"}
MOST_WORDS_OF_A_FIRST_LINE = 15
SHOWN = re.compile(r"\b(text|err|out|str|message|sentence|notices?|told)\b")
MOST_ASSERTIONS_ON_WORDING = 60


def _identifiers(path: Path) -> Iterator[str]:
    for node in nodes_of(path):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


@cache
def _words(name: str) -> frozenset[str]:
    return frozenset(
        word.lower() for part in name.split("_") for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", part)
    )


def test_no_identifier_has_a_word_of_no_field() -> None:
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in MODULES
        if any(_words(name) & DIALECT for name in set(re.findall(r"\w*[A-Za-z]\w*", path.read_text(encoding="utf-8"))))
        for name in _identifiers(path)
        if _words(name) & DIALECT
    }
    assert not found, sorted(found)


def test_classes_have_one_name_each_and_files_at_most_two() -> None:
    classes = Counter(node.name for path in MODULES for node in nodes_of(path) if isinstance(node, ast.ClassDef))
    files = Counter(path.name for path in MODULES if not path.name.startswith("__"))
    assert not [name for name, count in classes.items() if count > 1]
    assert not [name for name, count in files.items() if count > 2]


def test_docstrings_begin_with_a_short_line() -> None:
    long = []
    for path in MODULES:
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
                first = (ast.get_docstring(node) or "").partition("\n")[0]
                if len(first.split()) > MOST_WORDS_OF_A_FIRST_LINE:
                    long.append(f"{path.relative_to(ROOT)}: {first}")
    assert not long, long


# Notices: declared once, raised with all their fields, explained in the documentation.


def _declarations() -> dict[str, tuple[str, ast.Call]]:
    """Return every declaration by the name of its constant, with its module."""
    found: dict[str, tuple[str, ast.Call]] = {}
    for path in MODULES:
        for node in tree_of(path).body:
            call = node.value if isinstance(node, ast.Assign) else None
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "DeclaredNotice":
                (target,) = node.targets
                assert isinstance(target, ast.Name)
                assert target.id not in found, f"{target.id} is declared twice"
                found[target.id] = str(path.relative_to(ROOT)), call
    return found


def _texts(call: ast.Call) -> list[str]:
    """Return the literal arguments of a declaration."""
    arguments = [*call.args, *(keyword.value for keyword in call.keywords)]
    assert all(isinstance(ast.literal_eval(argument), str | bool) for argument in arguments)
    return [value for argument in arguments if isinstance(value := ast.literal_eval(argument), str)]


def test_codes_are_declared_once_and_found() -> None:
    stated = [_texts(call)[0] for _, call in _declarations().values()]
    assert sorted(stated) == sorted(set(stated)), "a code is declared twice"
    assert set(stated) == set(declared_notices())
    assert all(re.fullmatch(r"SC-\d{3}", code) for code in stated)
    assert sum(len(notices) for _, notices in declared_by_stage()) == len(stated)


def test_every_notice_and_error_is_raised_by_its_declaration_with_all_fields() -> None:
    declared = _declarations()
    fields = {
        name: {field for text in _texts(call) for _, field, _, _ in string.Formatter().parse(text) if field}
        for name, (_, call) in declared.items()
    }
    wrong, used = [], set()
    for path in MODULES:
        for node in nodes_of(path):
            if isinstance(node, ast.Name | ast.Attribute):
                used.add(node.id if isinstance(node, ast.Name) else node.attr)
            if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") in RAISED and node.args):
                continue
            first, place = node.args[0], f"{path.relative_to(ROOT)}:{node.lineno}"
            if isinstance(first, ast.Name | ast.Attribute) and not any(k.arg is None for k in node.keywords):
                name = first.id if isinstance(first, ast.Name) else first.attr
                given = {keyword.arg for keyword in node.keywords} - {"others"}
                if name in fields and not {field.split(".")[0] for field in fields[name]} <= given:
                    wrong.append(f"{place}: {name} needs {sorted(fields[name] - given)}")
                elif name not in fields and name.isupper():
                    wrong.append(f"{place}: {name} is not declared")
            elif not isinstance(first, ast.Name | ast.Attribute | ast.IfExp):
                wrong.append(f"{place}: {ast.unparse(first)[:60]} is no declaration")
    assert not wrong, wrong
    assert not {name for name in declared if name not in used}, "declared and never raised"


def test_the_page_of_notices_is_that_of_the_declarations() -> None:
    page = (ROOT / "docs" / "notices.md").read_text(encoding="utf-8")
    assert page == notices_page(), "make it anew: shakercal explain --markdown > docs/notices.md"


@cache
def _headings(page: Path) -> frozenset[str]:
    lines = page.read_text(encoding="utf-8").splitlines()
    heads = (line.strip("# ").lower() for line in lines if line.startswith("#"))
    return frozenset(re.sub(r"[^\w -]", "", head).replace(" ", "-") for head in heads)


@pytest.mark.parametrize("notice", [one for _, one in declared_notices().values()], ids=lambda one: one.code)
def test_a_notice_says_what_to_do_and_its_link_leads_somewhere(notice) -> None:
    assert notice.effect or notice.remedy or notice.severity == "note"
    if notice.link:
        file, _, heading = notice.link.partition("#")
        assert not heading or heading in _headings(ROOT / "docs" / file), f"{notice.code}: {notice.link}"


# Tests assert codes and values, not wording.


def _prose(node: ast.AST) -> bool:
    """Whether an expression contains a literal of two or more plain words."""
    texts = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str))
    return any(len(re.findall(r"(?<![\w./-])[a-z]{2,}(?![\w./-])", text)) >= 2 for text in texts)


def _assertions_on_wording(tree: ast.Module) -> Iterator[int]:
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "match" and _prose(node.value):
            yield node.value.lineno
        if isinstance(node, ast.Assert) and isinstance(node.test, ast.Compare):
            sides = [node.test.left, *node.test.comparators]
            operators = (ast.In, ast.NotIn, ast.Eq)
            compared = any(isinstance(one, operators) for one in node.test.ops) and any(map(_prose, sides))
            if compared and SHOWN.search(ast.unparse(node.test)):
                yield node.lineno


def test_few_tests_hold_wording_in_place() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for line in _assertions_on_wording(tree_of(path))
    ]
    assert len(found) <= MOST_ASSERTIONS_ON_WORDING, (len(found), found)
