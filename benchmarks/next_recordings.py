"""Predicted against obtained U of further recordings, and proposals against random ones of equal time.

    python benchmarks/next_recordings.py [--campaigns 5] [--alternatives 6] [--seed 1] [--write]

The eight recordings of the preset `matrix` at 80 Hz after the phasors (`simulated_phasors`, which shares no derivative
with the evaluation) are evaluated as one campaign. `fusion.planning.next_recordings` proposes further ones for some
elements and hours. These, and random choices that fill the same time, are simulated with errors of their own and
evaluated together with the eight. `--write` puts the table into docs/next-recordings.md. Ten minutes on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from coverage_poses import RUNS, Named, recorded
from marked import markdown_row, markdown_table, write_marked
from numpy.typing import NDArray
from simulated_phasors import Channel, Pair, PhasorSetup

from fusion.campaign.joint_evaluation import with_unique_names
from fusion.campaign.matrix import MatrixFit, fit_matrix
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.unknowns import apply_joint_estimate
from fusion.planning.next_recordings import (
    INTERNAL,
    Candidate,
    Element,
    Minutes,
    joint_information,
    list_candidates,
    propose,
)
from fusion.sensitivity.moving_body import MovingPart
from shaker.labels import LOAD_COMPONENTS

FloatArray = NDArray[np.float64]
PAGE = Path(__file__).parent.parent / "docs" / "next-recordings.md"
MAIN: tuple[Element, ...] = tuple((name, place) for place, name in enumerate(LOAD_COMPONENTS))
CASES: tuple[tuple[str, tuple[Element, ...], float, float, float | None], ...] = (
    ("all six main", MAIN, 4.0, 1.0, None),
    ("all six main", MAIN, 4.0, 30.0, None),
    ("Fz/Fz", (("Fz", 2),), 2.0, 1.0, None),
    ("My/Fx", (("My", 0),), 1.0, 1.0, None),
    ("Mx/Mx, My/My, Mz/Mz", MAIN[3:], 2.0, 10.0, None),
    ("all six main, with a stereo pair", MAIN, 4.0, 10.0, 5e-3),
)
"""Elements, hours, noise over that of `coverage_matrix`, and u of the rotation of a stereo pair (rad)."""
LENGTH_S = 120.0
HEAD = (
    "| elements | hours | noise | proposed, predicted | proposed, obtained | random, predicted | random, obtained "
    "| best random, obtained | predicted / obtained |"
)


def changed(candidate: Candidate, noise: float, setup: PhasorSetup) -> PhasorSetup:
    """Return the set-up of a candidate, with `noise` times the usual noise."""

    def of(channel: Channel, suffix: str = "") -> Channel:
        entry, group = channel.entry, channel.entry.common or channel.entry.name
        if candidate.exchanged == f"{group}: ":
            entry = entry.model_copy(update={"name": f"{entry.name} B", "common": f"{group} B"})
        if suffix:
            entry = entry.model_copy(update={"name": f"{entry.name}{suffix}", "common": entry.common or entry.name})
        return replace(channel, entry=entry, noise=noise * channel.noise / np.sqrt(candidate.longer))

    def seen(pair: Pair) -> Pair:
        phasors = pair.reading.phasors
        smaller = replace(phasors, covariance=noise**2 * phasors.covariance / (candidate.longer * candidate.points))
        return replace(pair, reading=replace(pair.reading, phasors=smaller))

    again = tuple(of(channel, f" {number}") for number in range(1, candidate.points) for channel in setup.channels)
    internal = setup.parts[1]
    whole_kg = sum(part.mass_kg for part in setup.parts)
    factor = (candidate.heavier * whole_kg - internal.mass_kg) / (whole_kg - internal.mass_kg)

    def moved(part: MovingPart) -> MovingPart:
        if part is internal:
            return replace(part, name=INTERNAL)
        if candidate.heavier == 1:
            return part
        sizes = {
            name: factor * getattr(part, name) for name in ("mass_kg", "inertia_kgm2", "u_mass_kg", "u_inertia_kgm2")
        }
        return replace(part, name=f"{part.name} B", **sizes)

    parts = tuple(map(moved, setup.parts))
    outputs = tuple(replace(of(one), entry=one.entry) for one in setup.outputs)
    channels, pairs = (*map(of, setup.channels), *again), tuple(map(seen, setup.pairs))
    return replace(setup, channels=channels, pairs=pairs, outputs=outputs, parts=parts)


def evaluated(entries: Sequence[RecordingResults]) -> tuple[MatrixFit, bool]:
    """Return the matrix of a campaign, and whether its recordings agree on shared unknowns."""
    carried, unknowns, _ = apply_joint_estimate("c", entries, lambda drive: drive)
    return fit_matrix([drive for entry in carried for drive in entry.excited_lines], LOAD_COMPONENTS), bool(unknowns)


def u_of(fit: MatrixFit, elements: Sequence[Element]) -> FloatArray:
    """Return standard uncertainties (E,) of magnitudes."""
    index = [fit.channels.index(channel) * 6 + load for channel, load in elements]
    value = fit.value.ravel()[index]
    covariance = fit.uncertainty.at(index).relative_to(value[None]).covariance[0]
    return np.asarray(np.abs(value) * np.sqrt(np.diagonal(covariance)[: len(index)]))


def obtained(
    base: Sequence[RecordingResults], further: Sequence[Candidate], seed: int, noise: float, rotation: float | None
) -> MatrixFit | None:
    """Return the matrix with simulated further recordings; None if the recordings contradict each other."""
    entries = list(base)
    for number, one in enumerate(further, 1):
        draws = Named(seed, True, mounting=f"next {number}", recording=f"next {number}")
        entries.append(recorded(int(one.folder), rotation, draws, partial(changed, one, noise))[0])
    fit, agree = evaluated(entries)
    return fit if agree and not fit.discrepancy else None


def random_choice(candidates: Sequence[Candidate], minutes: float, rng: np.random.Generator) -> list[int]:
    """Return random candidates until none fits into the time."""
    chosen, left = list[int](), minutes
    while fitting := [q for q, one in enumerate(candidates) if one.minutes <= left]:
        chosen.append(int(rng.choice(fitting)))
        left -= candidates[chosen[-1]].minutes
    return chosen


def case_row(
    case: tuple[str, tuple[Element, ...], float, float, float | None], seeds: range, alternatives: int
) -> tuple[str, FloatArray]:
    """Return the row of one case, and u of each proposal over that of the best random choice."""
    name, elements, hours, noise, rotation = case
    rows, ratios = list[tuple[float, ...]](), list[FloatArray]()
    for seed in seeds:
        parts = []
        for place in range(len(RUNS)):
            draws, usual = Named(seed, True, mounting=str(place), recording=str(place)), Candidate(str(place), 0.0)
            parts.append(recorded(place, rotation, draws, partial(changed, usual, noise))[0])
        base = with_unique_names(parts)
        fit, joint = evaluated(base)
        if fit.discrepancy or not joint:
            continue
        lengths = {entry.folder: LENGTH_S for entry in base}
        candidates = list_candidates(base, lengths, ["laser"], Minutes())
        information = joint_information(base, [fit], elements, candidates)
        proposal = propose(elements, candidates, information, 60.0 * hours)
        rng = np.random.default_rng([seed, 7])
        choices = [[*proposal.chosen], *(random_choice(candidates, 60.0 * hours, rng) for _ in range(alternatives))]
        found = list[tuple[float, float]]()
        for chosen in choices:
            now = replace(proposal, chosen=tuple(chosen)).ratios(len(chosen))[0]
            after = obtained(base, [candidates[q] for q in chosen], seed, noise, rotation)
            if after is not None:
                then = u_of(after, elements) / u_of(fit, elements)
                ratios.append(now / then)
                found.append((float(np.sqrt(np.mean(now**2))), float(np.sqrt(np.mean(then**2)))))
            elif chosen is choices[0]:
                break
        if len(found) > 1:
            (proposed, *others) = found
            rows.append((*proposed, *np.median(others, axis=0), min(one[1] for one in others)))
    means = [f"{value:.3f}" for value in np.mean(rows, axis=0)]
    low, high = np.percentile(np.concatenate(ratios), [2.5, 97.5])
    row = markdown_row(name, f"{hours:g}", f"{noise:g}", *means, f"{low:.2f} to {high:.2f}")
    return row, np.array([row[1] / row[4] for row in rows])


def main(arguments: Sequence[str] = ()) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=5)
    parser.add_argument("--alternatives", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args(arguments)
    rows, over = list[str](), list[FloatArray]()
    for case in CASES:
        row, ratio = case_row(case, range(options.seed, options.seed + options.campaigns), options.alternatives)
        rows, over = [*rows, row], [*over, ratio]
        print(row, flush=True)
    all_over = np.concatenate(over)
    text = markdown_table(HEAD, rows)
    text += f"\n\n{options.campaigns} campaigns with {options.alternatives} random choices each. Of {len(all_over)} "
    text += (
        f"proposals, {np.count_nonzero(all_over > 1.0)} obtained a larger u than the best random choice; the largest "
    )
    text += f"ratio is {np.max(all_over):.3f}."
    print(text)
    if options.write:
        write_marked(PAGE, {"proposals": text})


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
