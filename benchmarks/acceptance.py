"""Acceptance tests of simulated stereo rigs, right ones and ones with a fault, against the fault that was put in.

Usage: python benchmarks/acceptance.py [--draws 10] [--first 1] [--only CASE …] [--write docs/acceptance.md]

Every draw has another calibration within its covariance, another stage, pattern and noise, and another size or
direction of the fault. Printed for each case: how many rigs fail, for how many the true fault is named as the most
likely one, and for how many it is named at all. Right rigs have twice as many draws. Some 5 s per draw on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

from marked import existing_file, markdown_table, write_marked

from fusion.cameras.accept.acceptance_evaluation import AcceptanceEvaluation, evaluate_acceptance
from fusion.cameras.accept.acceptance_manifest import FEWEST_STATIONARY, read_acceptance
from fusion.simulate.acceptance import VIBRATION_HZ, write_acceptance

NEAR_HZ = 0.2
RIGHT = "none"
CASES = {
    RIGHT: ("no fault", ()),
    "camera-turned=2e-4": ("right camera turned by 0.2 mrad, any axis", ("pose",)),
    "camera-turned=1e-3": ("right camera turned by 1 mrad, any axis", ("pose",)),
    "focal-length": ("focal length of one camera off by 0.1 %", ("focal",)),
    "principal-point": ("principal point of one camera off by 5 px", ("principal_left", "principal_right")),
    "target-spacing": ("spacing of the target off by 0.2 %", ("scale",)),
    "no-distortion": ("lens distortion ignored", ("distortion",)),
    "late-frame": ("right camera one frame late", ("SC-931",)),
    "vibration": ("vibration of 10 µm at 12 Hz", ("vibration",)),
}
"""Fault of the simulation, its text, and the names that are right."""


@dataclass(frozen=True)
class Outcome:
    """Verdict of one draw, the cause named first, and all causes named."""

    verdict: str
    first: str
    named: tuple[str, ...]


def outcome(evaluation: AcceptanceEvaluation) -> Outcome:
    """Return what an evaluation says about its rig."""
    named = [notice.code for notice in evaluation.notices if notice.code == "SC-931"]
    rest = evaluation.stationary
    if rest is not None and bool((abs(rest.lines.frequency_hz - VIBRATION_HZ) < NEAR_HZ).any()):
        named += [row.name for row in rest.rows if row.name == "vibration" and row.verdict == "FAIL"]
    found = evaluation.diagnosis
    if not named and found is not None and found.is_significant and found.explains:
        named = [found.best.kind.name, *(fit.kind.name for fit in found.similar)]
    return Outcome(evaluation.verdict, named[0] if named else "", tuple(named))


def draw(case: str, seed: int) -> Outcome:
    """Simulate one rig and return its outcome."""
    with tempfile.TemporaryDirectory() as folder:
        frames = None if case in (RIGHT, "vibration") else FEWEST_STATIONARY
        write_acceptance(Path(folder), seed, violate=() if case == RIGHT else (case,), frames=frames)
        return outcome(evaluate_acceptance(read_acceptance(Path(folder)), {}))


def row(case: str, outcomes: list[Outcome]) -> str:
    """Return the row of a case."""
    text, right = CASES[case]
    count = len(outcomes)
    verdicts = [sum(one.verdict == verdict for one in outcomes) for verdict in ("PASS", "UNDECIDED", "FAIL")]
    first = sum(one.first in right or (case == RIGHT and not one.first) for one in outcomes)
    named = sum(any(name in right for name in one.named) or (case == RIGHT and not one.named) for one in outcomes)
    causes = (
        ("none named" if named == count else f"one named in {count - named}", "–") if case == RIGHT else (first, named)
    )
    shown = " | ".join(f"{number}" for number in (count, *verdicts, *causes))
    return f"| {text} | {shown} |"


def main() -> None:
    """Run the cases and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args()
    rows = []
    for case in options.only:
        draws = options.draws * (2 if case == RIGHT else 1)
        outcomes = list[Outcome]()
        for seed in range(options.first, options.first + draws):
            outcomes.append(draw(case, seed))
            print(case, seed, outcomes[-1], flush=True)
        rows.append(row(case, outcomes))
        print(rows[-1], flush=True)
    head = "| fault put in | rigs | PASS | UNDECIDED | FAIL | named first | named |"
    if options.write:
        write_marked(options.write, {"acceptance": markdown_table(head, rows)})


if __name__ == "__main__":
    main()
