"""Write a simulated campaign of many recordings: rigs, records, points, manifests and the truth of each recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fusion.settings import ProgressCallback
from fusion.simulate import cross_talk, sweep
from fusion.simulate.channels import record
from fusion.simulate.draws import CampaignDraws
from fusion.simulate.manifest_text import clock_tie, complex_table, daq_table, part_table, rig_tables
from fusion.simulate.points import COLUMNS, FILE_SCALE, point_series, write_points
from fusion.simulate.runs import Run
from fusion.simulate.toml_text import to_toml
from fusion.simulate.world import World, make_world
from fusion.simulate.write import write_record

CAMPAIGNS: dict[str, Callable[[], tuple[Run, ...]]] = {"sweep": sweep.runs, "matrix": cross_talk.runs}
TRIGGER_JITTER_S = 30e-9


@dataclass(frozen=True)
class CampaignOptions:
    """Switches of truth and noise of a campaign, each on its own.

    `noise`: of points and channels. `systematic_errors`: what the manifests state as uncertainties is drawn, else
    everything is exactly as stated. `trigger_jitter`: 30 ns rms. `recordings`: only the first so many.
    """

    noise: bool = True
    systematic_errors: bool = True
    trigger_jitter: bool = True
    recordings: int | None = None


def write_runs(out: Path, preset: str, seed: int, options: CampaignOptions, progress: ProgressCallback) -> None:
    """Write the recordings of a campaign into the folder `out`; `progress` hears of each."""
    runs = CAMPAIGNS[preset]()[: options.recordings]
    jitter_s = TRIGGER_JITTER_S if options.trigger_jitter else 0.0
    for number, run in enumerate(runs, 1):
        draws = CampaignDraws(seed, options.systematic_errors, mounting=run.mounting, recording=run.preset.recording)
        world = make_world(run.preset, draws, jitter_s)
        write_run(out, run, world, draws, options.noise)
        rig = to_toml(rig_tables(replace(world, preset=run.rig)))
        (out / run.rig_file).write_text(rig, encoding="utf-8", newline="\n")
        progress("write", number, len(runs))


def write_run(out: Path, run: Run, world: World, draws: CampaignDraws, noise: bool) -> None:
    """Write one recording into the folder of a campaign, where its rig is or will be."""
    folder = out / run.preset.recording
    folder.mkdir()
    for daq in run.preset.daqs:
        write_record(folder / daq.file, record(world, daq, draws, noise))
    for setup in run.preset.points:
        write_points(folder / points_file(setup.name), point_series(world, setup, draws, noise))
    texts = {
        "recording.toml": to_toml(recording_tables(run)),
        "truth.json": json.dumps(truth_tables(run, world, draws)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")


def points_file(stereo: str) -> str:
    """Return the name of the table of a stereo pair's points."""
    return f"points-{stereo}.csv"


def recording_tables(run: Run) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    tables: dict[str, Any] = {
        "format": 1,
        "name": run.name,
        "rig": f"../{run.rig_file}",
        "mounting": run.mounting,
        "excitation": {
            "kind": run.kind,
            "direction": list(run.direction),
            "frequencies": list(run.nominal_hz),
            "harmonics": "auto" if run.kind == "sine" else [],
        },
    }
    if run.parts:
        tables["part"] = [part_table(part) for part in run.parts]
    tables["daq"] = [daq_table(daq) for daq in run.preset.daqs]
    blocks = [
        {
            "stereo": setup.name,
            "files": points_file(setup.name),
            "columns": list(COLUMNS),
            "scale": FILE_SCALE,
            "trigger": "camera_trigger",
        }
        for setup in run.preset.points
    ]
    return tables | ({"points": blocks} if blocks else {})


def truth_tables(run: Run, world: World, draws: CampaignDraws) -> dict[str, Any]:
    """Return truth.json: phasors, sensitivity, ratio of the driven component, clocks, and every error drawn."""
    return {
        "format": 1,
        "preset": run.preset.name,
        "seed": draws.seed,
        "mounting": run.mounting,
        "frequencies": run.preset.frequencies_hz.tolist(),
        "acceleration": {body: complex_table(motion.acceleration) for body, motion in world.motion.items()},
        "load": complex_table(world.load_wrench),
        "outputs": complex_table(world.outputs),
        "sensitivity": complex_table(world.sensitivity),
        "driven": run.driven,
        "ratio": complex_table(world.outputs / world.load_wrench[:, run.driven, None]),
        "clock": clock_tie(run.preset, draws),
        "drawn": draws.values,
    }
