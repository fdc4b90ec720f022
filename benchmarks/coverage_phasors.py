"""Coverage of the 95 % regions at the level of phasors: every systematic error drawn from what is stated of it.

    python benchmarks/coverage_phasors.py [--trials 4000] [--seed 1] [--case NAME ...] [--processes 2]

One stereo pair (six components), three laser points, a triaxial accelerometer that gravity tilts, a load of several
parts, six outputs recorded on a clock of their own. Readings come from exact rigid kinematics with finite errors
(`simulated_phasors`), the results from the program's own path after the phasors. Cases: a uniaxial excitation
along z, a transverse one along x, a moment on a cross beam with offset masses; the z case with outputs and lasers on
one clock; eight laser points that scatter a thousandth more than is stated.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context

import numpy as np
from coverage_statistics import HEAD, Counts, row
from simulated_phasors import CASES, Case, case_setup, simulate_phasors

from fusion.sensitivity.analyse import analyse
from fusion.simulate.world import Draws

CHUNK = 100
"""Recordings that a process simulates before it tells what it counted."""


def run_case(case: Case, seeds: range) -> Counts:
    """Simulate and evaluate one case."""
    counts, setup = Counts(), case_setup(case)
    for seed in seeds:
        known, truth = simulate_phasors(setup, Draws(seed, True))
        counts.add(case.driven, analyse(known), truth.acceleration[0], truth.load[0], truth.outputs[0])
    return counts


def count_case(case: Case, seeds: range, processes: int) -> Counts:
    """Run one case in several processes; what is counted does not depend on their number."""
    parts = [seeds[start : start + CHUNK] for start in range(0, len(seeds), CHUNK)]
    counts = Counts()
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        for found in pool.map(run_case, repeat(case), parts):
            counts.join(found)
    return counts


def bias_row(case: Case, counts: Counts) -> str:
    """Return what is left of the driven acceleration's errors in the mean, and how often the instruments disagree."""
    errors = np.array(counts.driven)
    uncertain = np.std(errors.real) / np.sqrt(len(errors))
    pooled = np.concatenate([t.normalised for t in counts.acceleration + counts.load + counts.sensitivity if t.errors])
    cells = [case.name, f"{errors.real.mean():.2e} ± {uncertain:.1e}", f"{errors.imag.mean():.2e}"]
    cells += [f"{np.sqrt(np.mean(pooled**2)):.3f}", f"{100.0 * counts.warned / len(errors):.1f} %"]
    return "| " + " | ".join(cells) + " |"


def main(trials: int = 4000, seed: int = 1, names: Sequence[str] = (), processes: int = os.cpu_count() or 1) -> None:
    """Run the cases and print their tables."""
    print(HEAD)
    bias = []
    for case in CASES:
        if names and not any(name in case.name for name in names):
            continue
        counts = count_case(case, range(seed, seed + trials), processes)
        for quantity in ("acceleration", "load", "sensitivity"):
            print(row(case.name, quantity, getattr(counts, quantity)), flush=True)
            for place, tally in enumerate(getattr(counts, quantity)):
                if place == case.driven:
                    print(row(case.name, f"{quantity}, driven component", [tally]), flush=True)
        bias.append(bias_row(case, counts))
    head = ("case", "mean relative error of the driven acceleration", "mean phase error / rad")
    print("\n| " + " | ".join([*head, "root mean square of all errors / u", "instruments disagree"]) + " |")
    print("|---" * 5 + "|")
    print("\n".join(bias))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", nargs="+", default=[], help="parts of the names of the cases to run")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    main(options.trials, options.seed, options.case, options.processes)
