"""`shakercal plan --next`: predicted u against closed forms, choices against all choices, the command as a whole."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support import RefusedCommand, rows

from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.matrix import fit_matrix
from fusion.campaign.recording_results import RecordingResults
from fusion.cli import main
from fusion.commands.options import EXIT_DONE
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, real_stack
from fusion.planning.next_recordings import (
    Candidate,
    JointInformation,
    Minutes,
    choose,
    joint_information,
    list_candidates,
    propose,
)
from fusion.planning.planning_notices import NEXT_ELEMENT, NEXT_HOURS, NEXT_WITHOUT_MATRIX
from fusion.report.folder import Provenance
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.arrays import FloatArray

COMMON, OF_MOUNTING, NOISE, INTERNAL = 6e-4, 5e-4, 8e-4, 3e-4
"""Relative: scale of the laser, point of a mounting, noise of the output; of the load: the sensor's own mass."""
Effects = dict[tuple[str, str], FloatArray]


def recording(number: int, load: FloatArray, effects: Effects) -> RecordingResults:
    """A recording of a sensor with the unit matrix; `effects` of one u on the load, by name and scope."""
    influences = tuple(
        Influence(name, name, 1.0, "1", real_stack(change.astype(np.complex128))[None], scope)  # type: ignore[arg-type]
        for (name, scope), change in effects.items()
    )
    of_load = Contribution("motion", "A", 1e-16 * np.eye(12)[None], np.array([1e6]))
    of_output = Contribution("output", "A", NOISE**2 * np.eye(12)[None], np.array([1e6]))
    line = ExcitedLine(
        recording=str(number), mounting=str(number), frequency_hz=80.0, nominal_hz=80.0, direction=tuple(load),
        load=load.astype(np.complex128), load_uncertainty=Uncertainty((of_load,), influences),
        outputs=load.astype(np.complex128), outputs_uncertainty=Uncertainty((of_output,)), channels=LOAD_COMPONENTS,
    )  # fmt: skip
    name = str(number)
    return RecordingResults(
        name, name, name, "", "sine", tuple(load), (), None, (line,), (), Provenance({}, {}, {}, ())
    )


def six() -> list[RecordingResults]:
    """Six pure loads of 1 with the four errors."""
    return [
        recording(number, load, {
            ("laser: scale", "rig"): COMMON * load,
            ("laser: point", "mounting"): OF_MOUNTING * load,
            ("internal mass: mass", "rig"): INTERNAL * load,
        })
        for number, load in enumerate(np.eye(6))
    ]  # fmt: skip


def information(recorded: Sequence[RecordingResults], load: int, candidates: Sequence[Candidate]) -> JointInformation:
    """Joint information about a main element."""
    fit = fit_matrix([line for entry in recorded for line in entry.excited_lines])
    (found,) = joint_information(recorded, [fit], [(LOAD_COMPONENTS[load], load)], candidates)
    return found


def test_repeats_reduce_all_but_the_common_part() -> None:
    changes = [Candidate("2", 1.0), Candidate("2", 1.0, longer=4), Candidate("2", 1.0, exchanged="laser: "),
               Candidate("2", 1.0, heavier=2)]  # fmt: skip
    found = information(six(), 2, changes)

    def u(*counts: float) -> float:
        return float(np.sqrt(found.variance(np.array(counts))[0]))

    own = OF_MOUNTING**2 + NOISE**2
    fixed = COMMON**2 + INTERNAL**2
    assert u(0, 0, 0, 0) == pytest.approx(np.sqrt(fixed + own), rel=1e-6)
    for n in (1, 5):
        assert u(n, 0, 0, 0) == pytest.approx(np.sqrt(fixed + own / (n + 1)), rel=1e-6)
    longer = OF_MOUNTING**2 + NOISE**2 / 4.0
    assert u(0, 1, 0, 0) == pytest.approx(np.sqrt(fixed + 1.0 / (1.0 / own + 1.0 / longer)), rel=1e-6)
    assert u(0, 0, 1, 0) == pytest.approx(np.sqrt(INTERNAL**2 + (COMMON**2 + own) / 2.0), rel=1e-6)
    # Twice the mass: half the relative noise of the output and half the effect of the sensor's own mass.
    both = np.array([[own, 0.0], [0.0, longer]]) + COMMON**2 + INTERNAL**2 * np.outer([1.0, 0.5], [1.0, 0.5])
    assert u(0, 0, 0, 1) == pytest.approx(1.0 / np.sqrt(np.linalg.inv(both).sum()), rel=1e-6)


def test_common_influences_and_their_limit() -> None:
    recorded = six()
    candidates = list_candidates(recorded, {}, [], Minutes(mounting=10.0))
    found = information(recorded, 2, candidates)
    proposal = propose([("Fz", 2)], candidates, [found], 60.0)
    assert {proposal.candidates[q].folder for q in proposal.chosen} == {"2"}
    fixed, own = COMMON**2 + INTERNAL**2, OF_MOUNTING**2 + NOISE**2
    assert proposal.repeated[0, 0] == pytest.approx(np.sqrt(fixed / (fixed + own)), rel=1e-4)
    none = proposal.counts(0)
    assert found.shares(none, 1)["laser: scale"][0] == pytest.approx(COMMON**2 / (fixed + own), rel=1e-6)
    halved = (fixed - 0.75 * COMMON**2 + own) / (fixed + own)
    assert found.halved(none, "laser: scale")[0] / found.variance(none)[0] == pytest.approx(halved, rel=1e-6)


def test_two_arms_separate_the_moment_from_the_position_of_the_sensor() -> None:
    """My = ∓r·Fz of masses at ±r, all displaced by one unknown: against three-parameter least squares."""
    arm, displaced = 0.2, 2e-3
    recorded = [recording(number, load, {("laser: scale", "rig"): 0.0 * load}) for number, load in enumerate(np.eye(6))]
    for number, side in ((6, 1.0), (7, -1.0)):
        load, change = np.zeros(6), np.zeros(6)
        load[2], load[4], change[4] = 1.0, -side * arm, displaced
        recorded.append(recording(number, load, {("offset: x", "rig"): change}))
    del recorded[4]
    found = information(recorded, 4, [Candidate("6", 1.0), Candidate("7", 1.0)])

    def u(plus: int, minus: int) -> float:
        """Output My = S_z·1 + S_m·(∓r) - δ, S_m = 1."""
        lines = [(1.0, 0.0, 0.0), *[(1.0, -arm, -displaced)] * plus, *[(1.0, arm, -displaced)] * minus]
        design = np.array(lines) / NOISE
        return float(np.sqrt(np.linalg.inv(design.T @ design + np.diag([0.0, 0.0, 1.0]))[1, 1]))

    now = np.sqrt(found.variance(np.zeros(2))[0])
    for plus, minus in ((0, 3), (3, 0), (2, 2)):
        then = np.sqrt(found.variance(np.array([plus, minus]))[0])
        assert then / now == pytest.approx(u(1 + plus, 1 + minus) / u(1, 1), rel=1e-5)


def test_choices_are_near_the_best_of_all() -> None:
    """A-optimality of two parameters against all choices within the time."""
    rng, lost = np.random.default_rng(4), []
    for _ in range(20):
        directions, minutes = rng.standard_normal((4, 2)), rng.uniform(1.0, 3.0, 4)

        def criterion(counts: FloatArray, of: FloatArray = directions) -> float:
            return float(np.trace(np.linalg.inv(np.eye(2) + np.einsum("q,qi,qj->ij", counts, of, of))))

        chosen = choose(criterion, minutes.tolist(), 8.0)
        counts = np.bincount(chosen, minlength=4)
        assert counts @ minutes <= 8.0 + 1e-6
        every = (np.array(one) for one in product(range(9), repeat=4) if np.dot(one, minutes) <= 8.0)
        lost.append(criterion(counts) / min(map(criterion, every)))
    assert np.median(lost) < 1.01
    assert max(lost) < 1.05


def test_wrong_input_is_one_sentence(refused: RefusedCommand, tmp_path: Path) -> None:
    recording, results = tmp_path / "campaign" / "one", tmp_path / "other" / "results"
    for file in (recording / "recording.toml", results / "result.h5"):
        file.parent.mkdir(parents=True)
        file.touch()
    wrong = tmp_path, tmp_path / "missing", recording / "recording.toml", recording, recording.parent, results
    assert len({refused("plan", "--next", path).replace(str(path), "") for path in wrong}) == len(wrong)
    assert NEXT_WITHOUT_MATRIX.code in refused("plan", "--next", recording)
    with pytest.raises(SystemExit, match="2"):
        main(["plan", "--next", str(tmp_path), "--elements", "Fz/Fz,My/Fx, Fz/Fz"])
    assert "--rate" in refused("plan", "--next", tmp_path, "--rate", "50")
    assert "--hours" in refused("plan", "--frequencies", "80", "--hours", "3")


@pytest.mark.slow
def test_the_command_reads_a_campaign(
    commanded: Callable[[str], Path],
    refused: RefusedCommand,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    results, table, figure = commanded("matrix") / "results", tmp_path / "next.csv", tmp_path / "next.svg"
    command = ["plan", "--next", str(results), "--elements", "Fz/Fz,My/Fx", "--hours", "2"]
    capsys.readouterr()  # of the campaign
    assert main([*command, "--csv", str(table), "--figure", str(figure), "--json"]) == EXIT_DONE
    printed = json.loads(capsys.readouterr().out)["rows"]
    written = rows(table)
    assert len(printed) == len(written)
    assert figure.read_bytes().lstrip().startswith(b"<?xml")
    # Step 0 is the campaign as it was evaluated, apart from the coverage factor's digits.
    stated = {
        (f"{row['channel']}/{row['component']}", round(float(row["frequency_hz"]))): float(row["U_magnitude"])
        / float(row["magnitude"])
        for row in rows(results / "curve.csv")
        if row["kind"] == "matrix"
    }
    for row in written:
        key = row["element"], round(float(row["frequency_hz"]))
        assert float(row["U_now_relative"]) == pytest.approx(stated[key], rel=1e-6)
    last = [row for row in written if row["step"] == written[-1]["step"]]
    assert 0.0 < float(last[0]["hours"]) <= 2.0
    assert all(float(row["U_then_relative"]) < float(row["U_now_relative"]) for row in last)
    assert NEXT_ELEMENT.code in refused(*command[:3], "--elements", "Fz/Fq")
    assert NEXT_HOURS.code in refused(*command[:3], "--hours", "0.1")
