"""Whether the stated uncertainties hold: every systematic error drawn from what the manifests state.

    python benchmarks/coverage.py [--part phasors tracks rendered matrix]

The tables of docs/uncertainty-tables.md. All parts take about an hour on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

if __name__ != "__main__":
    raise ImportError(
        "a script, not the package of this name that numba asks for when it finds this folder on its path"
    )

import coverage_matrix
import coverage_phasors
import coverage_rendered
import coverage_tracks

PARTS: dict[str, Callable[[], None]] = {
    "phasors": coverage_phasors.main,
    "tracks": coverage_tracks.main,
    "rendered": coverage_rendered.main,
    "matrix": coverage_matrix.main,
}


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    for name in parser.parse_args().part:
        print(f"\n## {name}\n")
        PARTS[name]()


if __name__ == "__main__":
    main()
