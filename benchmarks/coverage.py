"""Whether the stated uncertainties hold: every systematic error drawn from what the manifests state.

    python benchmarks/coverage.py [--part phasors tracks rendered matrix]

The tables of docs/uncertainty.md. All parts take about an hour on one core.
"""

from __future__ import annotations

import argparse
from importlib import import_module

PARTS = ("phasors", "tracks", "rendered", "matrix")
# Numba imports a package `coverage` where there is one, and finds this file while the folder is on the path: the parts,
# which import numba, must not be imported before they are run.


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    for name in parser.parse_args().part:
        print(f"\n## {name}\n")
        import_module(f"coverage_{name}").main()


if __name__ == "__main__":
    main()
