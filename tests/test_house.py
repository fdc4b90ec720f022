"""The rules of the house: who may import whom, how long a chain of imports, a file and a function may be."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest
from syntax_trees import nodes_of, tree_of

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
FORBIDDEN = {
    "shakercal": {"photogram", "shaker"},
    "photogram": {"shaker", "fusion"},
    "shaker": {"photogram", "fusion"},
    "fusion": set[str](),
}
LAYERS = {
    "shakercal": ("_common", "__main__"),
    "photogram": (
        "device lanes frame_statistics",
        "geometry images point_tables",
        "camera bspline",
        "subsets targets",
        "motion direct",
        "measure calibration alignment synthetic",
    ),
    "shaker": (
        "labels signal_notices model_notices",
        "sine io lti mechanics static_rotation elastomer",
        "timebase lines frf",
        "identification release compensation",
        "decoupling",
    ),
    "fusion": (
        "errors",
        "base",
        "estimation",
        "recording",
        "instruments",
        "phasors sensitivity",
        "report",
        "campaign",
        "cameras planning sensor",
        "simulate",
        "commands",
        "cli",
    ),
}
"""Entries of each package by layer: an entry imports from its own layer and from those above it in the list."""
MOST_ENTRIES = {"shakercal": 3, "photogram": 17, "shaker": 16, "fusion": 15}
LONGEST_CHAIN, LONGEST_FILE, LONGEST_FUNCTION, MOST_ARGUMENTS = 19, 600, 60, 7


def _modules() -> dict[str, Path]:
    """Return every module of the three packages by its dotted name."""
    named = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            named[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return named


MODULES = _modules()


def _imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the names of imported modules."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def _needs(name: str) -> frozenset[str]:
    """Return the modules that are imported together with a module: those its top level names."""
    inside = {other for other in _imported(tree_of(MODULES[name]).body) if other in MODULES}
    return frozenset(inside - {name} - {name.rpartition(".")[0]})


@cache
def _mentions(name: str) -> frozenset[str]:
    """Return the modules that a module imports anywhere: at the top, when a function is called, or for its types."""
    inside = {other for other in _imported(nodes_of(MODULES[name])) if other in MODULES}
    return frozenset(inside - {name} - {name.rpartition(".")[0]})


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_keep_apart(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        tops = {name.split(".")[0] for name in _imported(nodes_of(path))}
        assert not tops & FORBIDDEN[package], f"{path.relative_to(ROOT)} imports {tops & FORBIDDEN[package]}"


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_run_one_way_by_layer(package: str) -> None:
    layer = {entry: place for place, entries in enumerate(LAYERS[package]) for entry in entries.split()}
    for name in MODULES:
        own = name.split(".")
        if own[0] != package or len(own) == 1:
            continue
        assert own[1] in layer, f"{name} has no layer"
        for other in _mentions(name):
            top, _, entry = other.partition(".")
            entry = entry.split(".")[0]
            assert top != package or not entry or layer[entry] <= layer[own[1]], f"{name} imports {other}"


def _calls(name: str, functions: tuple[str, ...]) -> Iterator[str]:
    """Yield the calls in a module of functions whose names end like one of these: `h5py.File(path, 'r')`."""
    for node in nodes_of(MODULES[name]):
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called.endswith(functions):
                yield ast.unparse(node)


def test_one_function_opens_hdf5_and_one_writes_results() -> None:
    """So that no file leads to others unseen, and no write is refused without a sentence."""
    opens = {
        name for name in MODULES for call in _calls(name, ("File",)) if re.match(r"h5py\.File\((?!'in memory')", call)
    }
    assert opens == {"shaker.io.channel", "photogram.calibration.exchange.vision"}
    writes = re.compile(r"[\w.]+\.(write_text|write_bytes)\(|[\w.]*open\(.*'[wax]b?'")
    calls = {
        name: _calls(name, ("write_text", "write_bytes", "open")) for name in MODULES if name.startswith("fusion.")
    }
    writers = {name for name, made in calls.items() if any(map(writes.match, made))}
    assert writers == {"fusion.report.atomic_files", "fusion.cli"}, "fusion.cli: what nobody reads"


def _longest_chain(imports: Callable[[str], frozenset[str]]) -> tuple[str, ...]:
    """Return the longest chain of imports; raise `AssertionError` for a circle."""
    chains: dict[str, tuple[str, ...]] = {}

    def chain(name: str, above: tuple[str, ...] = ()) -> tuple[str, ...]:
        assert name not in above, f"a circle of imports: {' -> '.join((*above, name))}"
        if name not in chains:
            below = [chain(other, (*above, name)) for other in sorted(imports(name))]
            chains[name] = (name, *max(below, key=len, default=()))
        return chains[name]

    return max((chain(name) for name in MODULES), key=len)


def test_no_circles_even_of_deferred_imports() -> None:
    _longest_chain(_mentions)


def test_chains_of_imports_are_short() -> None:
    longest = _longest_chain(_needs)
    assert len(longest) <= LONGEST_CHAIN, " -> ".join(longest)


@pytest.mark.parametrize("package", PACKAGES)
def test_few_entries_stand_side_by_side(package: str) -> None:
    beside = [path.name for path in (ROOT / package).iterdir() if not path.name.startswith(("__", "py.typed"))]
    assert len(beside) <= MOST_ENTRIES[package], sorted(beside)


def _functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for name, path in MODULES.items():
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef):
                yield f"{name}.{node.name}", node


def test_files_and_functions_are_as_long_as_one_thought() -> None:
    files = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert not {name: lines for name, lines in files.items() if lines > LONGEST_FILE}
    for name, function in _functions():
        lines = (function.end_lineno or 0) - function.lineno + 1 - len((ast.get_docstring(function) or "").splitlines())
        assert lines <= LONGEST_FUNCTION, f"{name} has {lines} lines"


def test_public_functions_take_few_arguments() -> None:
    for name, function in _functions():
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        count = sum(argument.arg not in ("self", "cls") for argument in arguments)
        compiled = bool(function.decorator_list) and "njit" in ast.dump(function.decorator_list[0])
        if not function.name.startswith("_") and not compiled:
            assert count <= MOST_ARGUMENTS, f"{name} takes {count} arguments"


def test_importing_a_package_costs_nothing_heavy() -> None:
    for package in PACKAGES:
        heavy = _needs(package) - {"shakercal._common.version"}
        assert not heavy, f"{package}/__init__.py imports {sorted(heavy)} before it is asked to"
