"""Draw the figures of the documents: `python docs/drawings [NAME ...]`, all without a name.

Every other file of this folder has a tuple `DRAWINGS` of functions without arguments that return a figure;
`docs/images/NAME.png` has the name of its function.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import matplotlib as mpl
from style import RC, write_drawing


def draw(arguments: list[str]) -> None:
    """Write the drawings of some names, or all."""
    parser = argparse.ArgumentParser(prog="docs/drawings", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    names = parser.parse_args(arguments).names
    modules = sorted(path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in ("__main__", "style"))
    drawings = {
        function.__name__: function for module in modules for function in importlib.import_module(module).DRAWINGS
    }
    if unknown := sorted(set(names) - set(drawings)):
        parser.error(f"NAME: expected some of {', '.join(drawings)}, found {', '.join(unknown)}")
    with mpl.rc_context(RC):
        for name in names or drawings:
            print(write_drawing(drawings[name](), name))


if __name__ == "__main__":
    draw(sys.argv[1:])
