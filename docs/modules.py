"""Tables of packages in architecture.md, from the first lines of docstrings: `python docs/modules.py`.

With folders it prints their modules instead: `python docs/modules.py fusion/recording photogram/subsets`.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PACKAGES = ("shakercal", "photogram", "shaker", "fusion")
HEAD = "| folder or module | content |\n|---|---|\n"


def module_table(package: str) -> str:
    """Return the table of a package: its folders in bold, and the modules outside of them."""
    top, rows = ROOT / package, []
    for path in _modules(top):
        name = path.relative_to(top).with_suffix("").as_posix()
        if path.name == "__init__.py":
            rows.append(f"| **`{name.removesuffix('/__init__')}/`** | {_first_line(path)} |")
        elif path.parent == top:
            rows.append(f"| `{name}` | {_first_line(path)} |")
    return HEAD + "\n".join(rows)


def module_tables() -> dict[str, str]:
    """Return the table of every package by its mark in architecture.md."""
    return {f"modules of {package}": module_table(package) for package in PACKAGES}


def _modules(top: Path) -> Iterator[Path]:
    """Yield the modules of a folder, without notices and entry points."""
    for path in sorted(top.rglob("*.py")):
        folder = path.name == "__init__.py" and path.parent != top
        if folder or not (path.stem.endswith("_notices") or path.name.startswith("__")):
            yield path


def _first_line(path: Path) -> str:
    """Return the first line of a module's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0].rstrip(".")


if __name__ == "__main__":
    if folders := sys.argv[1:]:
        if missing := [folder for folder in folders if not (ROOT / folder).is_dir()]:
            print(f"docs/modules.py: expected folders of {ROOT}, found none: {', '.join(missing)}", file=sys.stderr)
            sys.exit(2)
        for path in (path for folder in folders for path in _modules(ROOT / folder)):
            print(f"{path.relative_to(ROOT).as_posix():60s} {_first_line(path)}")
    else:
        sys.path.insert(0, str(ROOT / "benchmarks"))
        from marked import write_marked

        write_marked(DOCS / "architecture.md", module_tables())
