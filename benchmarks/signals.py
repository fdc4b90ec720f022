"""Clocks, sines and spectra: the figures that docs/performance.md summarises.

Usage: python benchmarks/signals.py [PART ...]      PART: clock sine noise transfer plan lines readers (default: all)

Each part is a program of its own (benchmarks/signals_PART.py) and prints rows of Markdown tables; here they run one
after another, some 15 minutes on two idle cores.
"""

from __future__ import annotations

import argparse
import importlib
import time

PARTS = ("clock", "sine", "noise", "transfer", "plan", "lines", "readers")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {' '.join(PARTS)}")
    chosen = parser.parse_args().parts or PARTS
    unknown = set(chosen) - set(PARTS)
    if unknown:
        parser.error(f"expected some of {' '.join(PARTS)}, found {' '.join(sorted(unknown))}")
    for part in chosen:
        start = time.perf_counter()
        print(f"\n## {part}\n", flush=True)
        importlib.import_module(f"signals_{part}").main()
        print(f"\n{part}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
