"""Write a simulated campaign: images, DAQ files, calibration, manifests, truth."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from fusion.settings import ProgressCallback
from fusion.simulate.channels import Record, record, response_table
from fusion.simulate.draws import Draws
from fusion.simulate.manifest_text import recording_tables, rig_tables, truth_tables
from fusion.simulate.scenery import face_of
from fusion.simulate.toml_text import to_toml
from fusion.simulate.world import TrueStereo, World
from photogram.calibration_file import write_calibration
from photogram.synthetic import Face, View, render_exposure, view_of

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
