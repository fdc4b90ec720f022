"""Tables of modules in architecture.md, from the first lines of their docstrings: `python docs/modules.py`."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
HEAD = "| module | content |\n|---|---|\n"


def module_table(package: str) -> str:
    """Return the table of a package: folders in bold, modules with the first line of their docstring."""
    rows = []
    for path in sorted((ROOT / package).rglob("*.py")):
        name = path.relative_to(ROOT / package).with_suffix("").as_posix()
        if name.endswith("_notices") or name.startswith("__"):
            continue
        folder = name.removesuffix("/__init__")
        first = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0].rstrip(".")
        rows.append(f"| **`{folder}/`** | {first} |" if folder != name else f"| `{name}` | {first} |")
    return HEAD + "\n".join(rows)


def module_tables() -> dict[str, str]:
    """Return the table of every package by its mark in architecture.md."""
    return {f"modules of {package}": module_table(package) for package in PACKAGES}


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from marked import write_marked

    write_marked(DOCS / "architecture.md", module_tables())
