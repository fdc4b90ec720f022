"""Simulated recordings and campaigns written to disk."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import ProgressCallback
from fusion.simulate import sines as cross_talk
from fusion.simulate import sines as sweep
from fusion.simulate.channels import (
    Record,
    clock_tie,
    complex_table,
    daq_table,
    part_table,
    record,
    recording_tables,
    response_table,
    rig_tables,
    to_toml,
    truth_tables,
)
from fusion.simulate.preset import face_of
from fusion.simulate.sines import Run
from fusion.simulate.world import (
    COLUMNS,
    FILE_SCALE,
    CampaignDraws,
    Draws,
    TrueStereo,
    World,
    make_world,
    point_series,
    write_points,
)
from photogram.calibration.file import write_calibration
from photogram.synthetic.scene import Face, View, render_exposure, view_of

# Write a simulated campaign: images, DAQ files, calibration, manifests, truth.


_START = np.datetime64("2018-01-01T00:00:00", "us")
_GZIP = {"compression": "gzip", "compression_opts": 6, "shuffle": True}


@dataclass(frozen=True, eq=False)
class _Shot:
    """One camera's series: where it is written, what it sees."""

    folder: Path
    view: View
    face: Face
    stereo: TrueStereo


def write_campaign(
    out: Path,
    world: World,
    draws: Draws,
    noise: tuple[bool, bool],
    aliased: bool,
    progress: ProgressCallback,
) -> Path:
    """Write the campaign into the empty folder `out` and return its recording's folder.

    `noise`: in the images, in the channels. `progress` hears of every image written.
    """
    preset = world.preset
    folder = out / preset.recording
    (out / "calibration").mkdir(parents=True)
    folder.mkdir()
    for stereo in world.stereo:
        write_calibration(out / "calibration" / f"{stereo.setup.name}.json", stereo.nominal, 0.02)
    for daq in preset.daqs:
        write_record(folder / daq.file, record(world, daq, draws, noise[1]))
        if daq.response:
            (folder / daq.response).write_text(response_table(), encoding="utf-8", newline="\n")
    _write_images(folder, world, draws, noise[0], aliased, progress)
    text = {"../rig.toml": rig_tables(world), "recording.toml": recording_tables(preset)}
    for name, tables in text.items():
        (folder / name).write_text(to_toml(tables), encoding="utf-8", newline="\n")
    truth = truth_tables(world, draws, draws.seed)
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8", newline="\n")
    return folder


def write_record(path: Path, recorded: Record) -> None:
    """Write one DAQ file, HDF5 or TDMS by its suffix."""
    if path.suffix == ".tdms":
        _write_tdms(path, recorded)
        return
    import h5py

    with h5py.File(path, "w") as file:
        for name, samples in recorded.samples.items():
            data = file.create_dataset(name, data=samples, **_GZIP)
            data.attrs["sample_rate"] = recorded.sample_rate_hz
            data.attrs["unit"] = recorded.units[name]


def _write_tdms(path: Path, recorded: Record) -> None:
    """Write a TDMS file with one group, waveform properties on each channel."""
    from nptdms import ChannelObject, TdmsWriter

    channels = [
        ChannelObject(
            path.stem,
            name,
            samples,
            properties={
                "wf_increment": 1 / recorded.sample_rate_hz,
                "wf_start_offset": 0.0,
                "wf_start_time": _START.astype(datetime),
                "wf_samples": len(samples),
                "unit_string": recorded.units[name],
            },
        )
        for name, samples in recorded.samples.items()
    ]
    with TdmsWriter(path) as writer:
        writer.write_segment(channels)


def _shots(folder: Path, world: World, draws: Draws, aliased: bool) -> Iterator[_Shot]:
    """Yield the cameras of all stereo pairs, each with its face."""
    for stereo in world.stereo:
        name = stereo.setup.name
        face = face_of(stereo.setup, aliased, draws.stream(f"{name}.speckle"))
        right_from_sensor = stereo.rig.right_from_left @ stereo.left_from_sensor
        yield _Shot(folder / f"{name}-left", view_of(stereo.rig.left, stereo.left_from_sensor), face, stereo)
        yield _Shot(folder / f"{name}-right", view_of(stereo.rig.right, right_from_sensor), face, stereo)


def _write_images(
    folder: Path, world: World, draws: Draws, noise: bool, aliased: bool, progress: ProgressCallback
) -> None:
    """Render and write every image, frames in parallel: the work is done outside Python's lock."""
    done, total = 0, 2 * len(world.stereo) * world.preset.frames
    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        for shot in _shots(folder, world, draws, aliased):
            shot.folder.mkdir()
            tasks = [pool.submit(_shoot, shot, world, draws, noise, aliased, k) for k in range(world.preset.frames)]
            for task in tasks:
                task.result()
                done += 1
                progress("render", done, total)
    finally:
        pool.shutdown(cancel_futures=True)  # who interrupts need not wait for the images that are left


def _shoot(shot: _Shot, world: World, draws: Draws, noise: bool, aliased: bool, frame: int) -> None:
    """Render, digitise and write one image."""
    import tifffile

    setup, exposure = shot.stereo.setup, world.preset.exposure_s
    middle = float(world.trigger_s[frame] + shot.stereo.delay_s + exposure / 2)
    pose_at = world.motion[setup.body].pose
    image = render_exposure(shot.view, shot.face, pose_at, middle, exposure, 4 if aliased else 2)
    rng = draws.stream(f"{shot.folder.name}.{frame}") if noise else None
    grey = setup.sensor.digitise(image, rng)
    tifffile.imwrite(
        shot.folder / f"{frame:04d}.tif",
        grey,
        photometric="minisblack",
        compression="zlib",
        metadata=None,
        software=False,
    )


# Write a simulated campaign of many recordings: rigs, records, points, manifests and the truth of each recording.


CAMPAIGNS: dict[str, Callable[[], tuple[Run, ...]]] = {"sweep": sweep.runs, "matrix": cross_talk.cross_talk_runs}
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
        "recording.toml": to_toml(drive_tables(run)),
        "truth.json": json.dumps(drive_truth_tables(run, world, draws)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")


def points_file(stereo: str) -> str:
    """Return the name of the table of a stereo pair's points."""
    return f"points-{stereo}.csv"


def drive_tables(run: Run) -> dict[str, Any]:
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


def drive_truth_tables(run: Run, world: World, draws: CampaignDraws) -> dict[str, Any]:
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
