"""`shakercal plan`: what it prints, the files it writes, and how it refuses."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import RefusedCommand, rows

from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_INPUT, frequencies
from fusion.planning.multisine_plan import MultisineRequest, make_multisine
from fusion.planning.planning_notices import MULTISINE_FRAMES, NOISE_UNSTATED, RATE_LIMITS, RATE_STEP, TOO_FEW_FRAMES
from shaker.lines.rate_planner import Sampling
from shaker.sine.sine_fit import fit_sines

TWELVE = "--frequencies 53.7:1020.3:12 --max-rate 82 --exposure 40e-6 --frames 211"
PUBLISHED = "--frequencies 106.25 --rate 52.874 --exposure 40e-6 --frames 211"
Planned = Callable[..., str]


@pytest.fixture
def planned(capsys: pytest.CaptureFixture[str]) -> Planned:
    """Return a function that runs the command with options as they are typed, and returns what it prints."""

    def run(options: str, *more: object) -> str:
        assert main(["plan", *options.split(), *map(str, more)]) == EXIT_DONE
        return capsys.readouterr().out

    return run


def _cells(out: str, first: str) -> list[str]:
    """Return the cells of the table row whose first cell is given."""
    table = ([cell.strip() for cell in line.strip("│ \n").split("│")] for line in out.splitlines() if "│" in line)
    return next(row for row in table if row[0] == first)


def test_published_case_is_explained(planned: Planned) -> None:
    out = planned(PUBLISHED)
    assert "106.25 Hz = 2 × 52.874 Hz + 0.502 Hz: " in out
    assert _cells(out, "425")[:6] == ["425", "4", "2.008", "0.038", "2.00", "318.75 Hz"]
    assert re.search(r"106\.25 Hz .* 0\.1 ", out)
    assert " 50.574 Hz (-2.300 Hz)" in out


def test_twelve_frequencies_with_their_rates_and_one_for_all(planned: Planned) -> None:
    out = planned(TWELVE)
    for name in ("53.700", "493.064", "1020.300"):
        rate, alias, share = (float(cell) for cell in _cells(out, name)[1:4])
        assert 41.0 <= rate <= 82.0
        assert alias == pytest.approx(abs(float(name) - rate * round(float(name) / rate)), abs=2e-3)
        assert 0.1 <= share <= 0.4
    assert out.count("All 12, ") == 2
    assert "(43.901 Hz): 57.7 s" in out
    assert "(43.901 Hz): 177.7 s, 10 s " in planned(TWELVE, "--settle", 10)


def test_uncertainties_in_units_of_the_motion(planned: Planned) -> None:
    row = _cells(planned(PUBLISHED, "--noise", "2.3e-6", "--amplitude", "0.43e-3"), "106.25")
    assert float(row[-3]) == pytest.approx(0.3378 * 2300.0, rel=2e-3)  # nm
    assert float(row[-2]) == pytest.approx(100.0 * 0.3378 * 2.3e-6 / 0.43e-3, rel=5e-3)
    assert float(row[-1]) == pytest.approx(10.0 * float(row[-2]), rel=5e-3)
    row = _cells(planned(PUBLISHED, "--noise", "2.3e-6", "--acceleration", "189.32"), "106.25")
    assert float(row[-2]) == pytest.approx(0.183, abs=0.001)  # 189.32 m/s² at 106.25 Hz are 0.4248 mm


def test_lines_at_the_same_time_are_one_point(planned: Planned) -> None:
    out = planned("--frequencies 120,175,210 --max-rate 82 --frames 300 --harmonics 2 --together")
    assert len(_cells(out, "120.000–210.000")) == 10
    assert {_cells(out, line)[0] for line in ("120", "175", "210", "240", "350", "420")}


def test_unfavourable_rates_are_explained(planned: Planned) -> None:
    out = planned("--frequencies 100,100.001 --max-rate 82 --frames 211 --together")
    assert "100.000–100.001 Hz: " in out
    out = planned("--frequencies 120 --rate 200 --frames 400 --harmonics 3")
    assert " 0.00 bins " in out or " 80.000 Hz" in out
    assert re.search(r"24\.9 Hz .* 0\.4 ", planned("--frequencies 24.9 --rate 52 --frames 400"))


def test_table_and_figures(planned: Planned, tmp_path: Path) -> None:
    table, figure = tmp_path / "plan.csv", tmp_path / "plan.svg"
    options = "--frequencies 53.7,106.25 --max-rate 82 --frames 211"
    planned(options, "--csv", table, "--figure", figure)
    written = rows(table)
    assert {row["choice"] for row in written} == {"1", "2", "3", "shared"}
    first = [row for row in written if row["point"] == "2" and row["choice"] == "1"]
    assert [float(row["line_hz"]) for row in first] == [106.25 * m for m in range(1, 6)]
    for row in first:
        rate, line = float(row["rate_hz"]), float(row["line_hz"])
        assert float(row["alias_hz"]) == pytest.approx(abs(line - rate * round(line / rate)), abs=1e-3)
        assert row["u_amplitude_unit"] == "noise per frame"
    before = figure.read_bytes()
    assert before.lstrip().startswith(b"<?xml")
    assert sorted(tmp_path.iterdir()) == [table, figure]
    planned(options, "--figure", figure, "--force")
    assert figure.read_bytes() == before  # nothing of the day or the run is in it
    for name, magic in (("one-rate.png", b"\x89PNG"), ("one-rate.pdf", b"%PDF")):
        planned(PUBLISHED, "--figure", tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(magic)


def test_files_that_are_there_are_kept(planned: Planned, refused: RefusedCommand, tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    path.write_text("mine", encoding="utf-8")
    assert "--force" in refused("plan", *PUBLISHED.split(), "--csv", path)
    assert path.read_text(encoding="utf-8") == "mine"
    planned(PUBLISHED, "--csv", path, "--force")
    assert path.read_text(encoding="utf-8").startswith("point,choice,rate_hz")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("--max-rate 82 --min-rate 90", f"{RATE_LIMITS.code} --min-rate: .*82 Hz.*90 Hz"),
        ("--max-rate 82 --exposure 0.05", f"{RATE_LIMITS.code} --exposure: .*0.05 s"),
        ("--max-rate 82 --frames 9", f"{TOO_FEW_FRAMES.code} --frames: .* 12 .* 9"),
        ("--max-rate 82 --amplitude 1e-4", f"{NOISE_UNSTATED.code} --amplitude: .*--noise"),
        ("--max-rate 82 --acceleration 10", f"{NOISE_UNSTATED.code} --acceleration: .*--noise"),
        ("--max-rate 82 --rate-step 100", f"{RATE_STEP.code} --rate-step: .* 41 .* 82 "),
        ("--rate 52.874 --min-rate 40", "--min-rate: .*--max-rate"),
        ("--max-rate 82 --csv /no/such/folder/plan.csv", "/no/such/folder"),
    ],
)
def test_wrong_input_is_one_sentence(arguments: str, told: str, refused: RefusedCommand) -> None:
    assert re.search(told, refused("plan", "--frequencies", "106.25", "--frames", "211", *arguments.split()))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("--frequencies 53.7:1020.3", "argument --frequencies: .*106.25"),
        ("--frequencies 53.7:1020.3:x", "argument --frequencies: "),
        ("--frequencies 1:2:3:lin", "argument --frequencies: "),
        ("--frequencies 106.25,", "argument --frequencies: "),
        ("--frequencies -5", "argument --frequencies: "),
        ("--frequencies 50:100:1", "argument --frequencies: .* 2"),
        ("--frequencies 50,60,50", "argument --frequencies: .*50 Hz"),
        ("--frames 0", "argument --frames: .* 4 .*1000000"),
        ("--figure plan.txt", r"argument --figure: .*\.png, \.svg, \.pdf"),
        ("--rate 50", "argument --rate: .* --max-rate"),
    ],
)
def test_wrong_arguments_are_named(arguments: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["plan", "--frequencies", "106.25", "--frames", "211", "--max-rate", "82", *arguments.split()])
    assert left.value.code == EXIT_INPUT
    assert re.search(told, capsys.readouterr().err)


def test_lists_of_frequencies() -> None:
    assert frequencies("106.25") == (106.25,)
    assert frequencies("10:20:3, 53.7") == (10.0, 15.0, 20.0, 53.7)
    assert frequencies("10:1000:3:log") == (10.0, 100.0, 1000.0)
    twelve = frequencies("53.7:1020.3:12")
    assert (len(twelve), twelve[0], twelve[1], twelve[-1]) == (12, 53.7, 141.572727, 1020.3)


MANY = "--lines 12 --band 60:900 --frames 300 --max-rate 53"


def test_a_multisine_is_played_from_its_table(planned: Planned, tmp_path: Path) -> None:
    planned(f"{MANY} --peak 60 --noise 2e-7", "--csv", tmp_path / "multisine.csv")
    lines = rows(tmp_path / "multisine.csv")
    frequency, amplitude, phase = (
        np.array([float(line[name]) for line in lines]) for name in ("frequency_hz", "acceleration_mps2", "phase_rad")
    )
    assert (len(frequency), frequency.min() > 55.0, frequency.max() < 950.0) == (12, True, True)
    time_s = np.linspace(0.0, 8.0, 200_000)
    played = np.zeros(len(time_s))
    for line in zip(frequency, amplitude, phase, strict=True):
        played += line[1] * np.cos(2.0 * np.pi * line[0] * time_s + line[2])
    assert np.abs(played).max() == pytest.approx(60.0, rel=0.01)


def test_predicted_u_is_the_scatter_of_fits() -> None:
    """At equal total time a multisine has crest/√2 times the noise of single lines of the same peak."""
    noise_m, rng = 2e-7, np.random.default_rng(8)
    plan = make_multisine(
        MultisineRequest(12, (60.0, 900.0), Sampling(300, corner_hz=0.0), (52.9,), peak_mps2=60.0, noise_m=noise_m)
    )
    frequency = plan.grid.frequency_hz
    moved = plan.acceleration_mps2 * np.exp(1j * plan.phase_rad) / (2.0 * np.pi * frequency) ** 2
    time_s = np.arange(plan.grid.frames) / plan.grid.rate_hz
    exact = (np.exp(2j * np.pi * np.multiply.outer(time_s, frequency)) @ moved).real
    values = exact[:, None] + noise_m * rng.standard_normal((len(exact), 400))
    names = [str(c) for c in range(400)]
    found = fit_sines(time_s, values, frequency, names, names).phasors.value
    scatter = np.sqrt(np.mean(np.abs(found - moved[:, None]) ** 2, axis=1) / 2.0) / np.abs(moved)
    assert plan.at_rate.condition == pytest.approx(1.0, abs=1e-6)
    assert plan.relative == pytest.approx(scatter, rel=0.1)
    assert plan.over_single(plan.single_frames) == pytest.approx(plan.crest / np.sqrt(2.0), rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("--lines 40 --band 60:900 --frames 80", f"{MULTISINE_FRAMES.code} --frames: .*81.* 80"),
        ("--lines 40 --band 0:900 --frames 400", "--band: .*above 0"),
        ("--lines 40 --band 60:900 --frames 400 --together", "--together: .*--lines"),
        ("--lines 40 --band 60:900 --frames 400 --min-rate 50", "--min-rate: .*--lines"),
        ("--frequencies 106.25 --band 60:900 --frames 400", "--band: .*--lines.* --frequencies"),
        ("--frequencies 106.25 --linear --frames 400", "--linear: .*--lines.* --frequencies"),
        ("--frequencies 106.25 --peak 9 --frames 400", "--peak: .*--lines.* --frequencies"),
        ("--frequencies 106.25 --slope 1 --frames 400", "--slope: .*--lines.* --frequencies"),
    ],
)
def test_wrong_multisines_are_one_sentence(arguments: str, told: str, refused: RefusedCommand) -> None:
    assert re.search(told, refused("plan", "--max-rate", "53", *arguments.split()))
