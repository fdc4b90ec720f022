"""Sensor models against recordings of other physics: who covers the truth, who warns, who fails.

    python benchmarks/other_physics.py --list
    python benchmarks/other_physics.py --case exponential_50us --draws 40
    python benchmarks/other_physics.py --draws 40 --json results.json --markdown docs/other-physics.md
    python benchmarks/other_physics.py --from results.json --markdown docs/other-physics.md

Recordings come from equations of motion of their own (`other_physics_sensor.py`, numpy and scipy alone); the estimators
are used through the command line and judged by the tables that they write. A draw that failed can be repeated:
`--case NAME --draw NUMBER --keep FOLDER` leaves its campaign for `python -m shakercal`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from marked import markdown_table, write_marked
from other_physics_body import CASES as BODIES
from other_physics_files import INTERNAL_ERROR, Case, Outcome, evaluate
from other_physics_loads import CASES as LOADS
from other_physics_release import CASES as RELEASES
from other_physics_shaken import CASES as SHAKEN
from other_physics_turned import CASES as TURNED

CASES: dict[str, Case] = {case.name: case for case in RELEASES + BODIES + LOADS + SHAKEN + TURNED}
SLOW = {"decouple": 0.4}
"""Share of the draws for commands that take longer than the others."""
COMMON = 0.5
"""A code in this share of the draws of any case within the assumptions tells nothing of another case."""


NAMED: dict[str, tuple[str, ...]] = {
    "exponential": ("SC-860", "SC-871"),
    "two_stages": ("SC-367", "SC-368", "SC-860"),
    "pink_noise": ("SC-369", "SC-374", "SC-870"),
    "mains_hum": ("SC-375", "SC-870"),
    "filter_stated": ("SC-666", "SC-862", "SC-922"),
    "filter_unstated": ("SC-921",),
    "growing_mode": ("SC-374", "SC-870"),
    "dry_friction": ("SC-861", "SC-920"),
    "light_friction": ("SC-861",),
    "softening": ("SC-861",),
    "compensated_exponential": ("SC-860",),
    "body_exponential": ("SC-395", "SC-880", "SC-881", "SC-925"),
    "body_quiet_exponential": ("SC-395", "SC-880", "SC-881", "SC-925"),
    "body_hum": ("SC-375",),
    "body_twelve_bit": ("SC-689",),
    "load_softening": ("SC-388", "SC-882"),
    "load_friction": ("SC-388", "SC-882"),
    "load_light_friction": ("SC-388", "SC-882"),
    "load_loss_factor": ("SC-883",),
    "masses_mount": ("SC-890", "SC-894", "SC-895"),
    "masses_lag": ("SC-890", "SC-891", "SC-894"),
    "masses_accelerometer": ("SC-890", "SC-891", "SC-894"),
    "masses_loss_factor": ("SC-892", "SC-893"),
    "masses_softening": ("SC-890", "SC-899"),
    "transfer_lag": ("SC-891", "SC-894"),
    "transfer_accelerometer": ("SC-891", "SC-894"),
    "transfer_loss_factor": ("SC-897", "SC-898"),
    "transfer_softening": ("SC-899", "SC-909"),
    "rotation_4_digits": ("SC-624",),
    "rotation_hysteresis": ("SC-913",),
    "rotation_tilted": ("SC-911",),
    "poses_hysteresis": ("SC-912", "SC-913"),
}
"""Codes that name the cause, by the beginning of the case."""


def generator(name: str, draw: int) -> np.random.Generator:
    """Return the random numbers of one draw of a case, the same whichever draws are run."""
    return np.random.default_rng([draw, *name.encode()])


def score(case: Case, outcomes: Sequence[Outcome], seconds: float) -> dict[str, Any]:
    """Return coverage and size of U of every stated quantity, codes and failures of a case."""
    draws = len(outcomes)
    failures = [
        {"draw": draw, "status": one.status, "internal": INTERNAL_ERROR in one.codes, "error": one.error}
        for draw, one in enumerate(outcomes)
        if one.status
    ]
    codes = Counter(code for one in outcomes for code in one.codes)
    groups: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for one in outcomes for name in one.truth):
        groups.setdefault(name.split("[")[0], []).append(name)
    return {
        "case": case.name,
        "about": case.about,
        "command": case.command[0],
        "within": case.within,
        "draws": draws,
        "seconds_per_draw": round(seconds / draws, 2),
        "internal_errors": sum(one["internal"] for one in failures),
        "failures": failures,
        "codes": {code: count / draws for code, count in sorted(codes.items())},
        "draw_codes": [one.codes for one in outcomes],
        "draw_worst": [worst(one) for one in outcomes],
        "quantities": {name: _judge(members, outcomes) for name, members in groups.items()},
    }


def worst(outcome: Outcome) -> float:
    """Return the largest error over its U of one draw, 0 where nothing has a U."""
    ratios = [
        abs(value - outcome.truth[name]) / max(u, 1e-300)
        for name, (value, u) in outcome.readings.items()
        if name in outcome.truth and np.isfinite([value, u, outcome.truth[name]]).all()
    ]
    return float(max(ratios, default=0.0))


def names(case: str) -> tuple[str, ...]:
    """Return the codes that name the cause of a case."""
    return next((codes for beginning, codes in NAMED.items() if case.startswith(beginning)), ())


def named(result: dict[str, Any]) -> tuple[float, float]:
    """Return the share of draws whose notices name the cause, and that of others with an error beyond 2 U."""
    told = [bool(set(codes) & set(names(result["case"]))) for codes in result["draw_codes"]]
    silent = [most > 2.0 and not one for most, one in zip(result["draw_worst"], told, strict=True)]
    return float(np.mean(told)), float(np.mean(silent))


def _judge(members: list[str], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return how often U covers, U over what is needed, the largest error over U, and how often U is withheld."""
    errors, us, withheld = [], [], 0
    per_name: dict[str, list[tuple[float, float]]] = {}
    missed = []
    for draw, one in enumerate(outcomes):
        for name in members:
            true, (value, u) = one.truth.get(name, np.nan), one.readings.get(name, (np.nan, np.nan))
            if not np.isfinite(true):
                continue
            if not np.isfinite(u) or not np.isfinite(value):
                withheld += int(np.isfinite(value))
                continue
            errors.append(value - true)
            us.append(u)
            per_name.setdefault(name, []).append((value - true, u))
            if abs(value - true) > u:
                missed.append(draw)
    if not errors:
        return {"stated": 0, "without_u": withheld}
    ratios, biases = [], []
    for both in per_name.values():
        error, u = np.array(both).T
        needed = 1.96 * float(np.sqrt(np.mean(error**2)))
        ratios.append(float(np.median(u)) / needed if needed else np.inf)
        biases.append(float(np.median(error / np.maximum(u, 1e-300))))
    over = np.abs(errors) / np.maximum(us, 1e-300)
    return {
        "stated": len(errors),
        "without_u": withheld,
        "covered": float(np.mean(over <= 1.0)),
        "u_over_needed": float(np.median(ratios)),
        "median_u": float(np.median(us)),
        "largest_error_over_u": float(over.max()),
        "median_error_over_u": float(np.median(over)),
        "bias_over_u": float(np.median(biases)),
        "draws_missed": sorted(set(missed)),
    }


def run(case: Case, draws: Sequence[int], keep: Path | None) -> dict[str, Any]:
    """Return the score of some draws of a case."""
    begun, outcomes = time.process_time(), []
    for draw in draws:
        with tempfile.TemporaryDirectory() as scratch:
            folder = (keep or Path(scratch)) / f"{case.name}-{draw}"
            folder.mkdir(parents=True)
            outcomes.append(evaluate(case, folder, generator(case.name, draw)))
    return score(case, outcomes, time.process_time() - begun)


# Tables.


def own_codes(result: dict[str, Any], results: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the codes of a case that are not common within the assumptions of its command."""
    usual = {
        code
        for one in results
        if one["within"] and one["command"] == result["command"]
        for code, share in one["codes"].items()
        if share >= COMMON
    }
    return {code: share for code, share in result["codes"].items() if code not in usual and share >= 0.1}


def low_coverage(draws: int) -> float:
    """Return the least share of `draws` that a coverage of 95 % leaves to chance once in 100."""
    from scipy.stats import binom

    return float(binom.ppf(0.01, draws, 0.95)) / draws


def report(result: dict[str, Any], results: Sequence[dict[str, Any]]) -> str:
    """Return a case as text: codes, failures, a line per quantity."""
    codes = ", ".join(f"{code} {share:.0%}" for code, share in own_codes(result, results).items()) or "none"
    told, silent = named(result)
    lines = [
        f"{result['case']} ({result['command']}: {result['about']}): {result['draws']} draws, "
        f"{result['seconds_per_draw']:.1f} s each, internal errors {result['internal_errors']}, named in {told:.0%}, "
        f"beyond 2 U and not named in {silent:.0%}, own codes: {codes}"
    ]
    for failure in result["failures"]:
        lines.append(f"  draw {failure['draw']}: status {failure['status']}: {failure['error'][:200]}")
    for name, one in result["quantities"].items():
        if not one["stated"]:
            lines.append(f"  {name:22s} no U stated")
            continue
        low = low_coverage(max(result["draws"], one["stated"] if result["draws"] > 1 else 1))
        mark = "!" if one["covered"] < min(low, 0.93) else " "
        lines.append(
            f"{mark} {name:22s} covered {one['covered']:6.1%} of {one['stated']:5d}, U/needed "
            f"{one['u_over_needed']:7.2f}, largest error/U {one['largest_error_over_u']:7.1f}, "
            f"median {one['median_error_over_u']:6.2f}, bias {one['bias_over_u']:+6.2f}, "
            f"without U {one['without_u']}"
        )
    return "\n".join(lines)


HEAD = "| command | recordings | lowest coverage | quantities below 93 % | U / needed | named | beyond 2 U, not named |"


def markdown_rows(results: Sequence[dict[str, Any]]) -> list[str]:
    """Return a row per case for the page."""
    rows = []
    for result in results:
        stated = {name: one for name, one in result["quantities"].items() if one["stated"]}
        ordered = sorted(stated, key=lambda name: stated[name]["covered"])
        worst = f"{100 * stated[ordered[0]]['covered']:.0f} % ({ordered[0]})" if ordered else "no U"
        low = sum(round(100 * one["covered"]) < 93 for one in stated.values())
        ratios = [one["u_over_needed"] for one in stated.values()]
        size = f"{np.median(ratios):.2g}, at most {max(ratios):.2g}" if ratios else ""
        told, silent = named(result)
        codes = ", ".join(code for code in names(result["case"]) if code in result["codes"])
        rows.append(
            f"| {result['command']} | {result['about']} | {worst} | {low} | {size} | "
            f"{f'{100 * told:.0f} % ({codes})' if codes else ''} | {100 * silent:.0f} % |"
        )
    return rows


def main() -> None:
    """Run cases, print them, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", help="name, or beginning of names with *")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--draw", type=int, help="one draw alone, by its number")
    parser.add_argument("--keep", type=Path, help="folder in which the campaigns are left")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--json", type=Path, help="file of all scores, added to after every case")
    parser.add_argument(
        "--from", type=Path, nargs="+", dest="before", help="files of scores to read in place of running"
    )
    parser.add_argument("--markdown", type=Path, help="page that holds the marks of the table")
    arguments = parser.parse_args()
    wanted = arguments.case or ["*"]
    cases = [
        case
        for case in CASES.values()
        if any(case.name == one or (one.endswith("*") and case.name.startswith(one[:-1])) for one in wanted)
    ]
    if arguments.list:
        print("\n".join(f"{case.name:24s} {case.command[0]:10s} {case.about}" for case in cases))
        return
    results: list[dict[str, Any]] = []
    if arguments.before:
        found = [one for path in arguments.before for one in json.loads(path.read_text(encoding="utf-8"))]
        results = [one for name in CASES for one in found if one["case"] == name]
        print("\n".join(report(result, results) for result in results))
    else:
        for case in cases:
            count = max(1, round(arguments.draws * SLOW.get(case.command[0], 1.0)))
            draws = [arguments.draw] if arguments.draw is not None else list(range(count))
            results.append(run(case, draws, arguments.keep))
            print(report(results[-1], results), flush=True)
            if arguments.json:
                arguments.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    if arguments.markdown:
        write_marked(arguments.markdown, {"other physics": markdown_table(HEAD, markdown_rows(results))})


if __name__ == "__main__":
    main()
