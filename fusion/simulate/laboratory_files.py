"""Simulated files of a laboratory, named by recorder and cameras, without manifests."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusion.base import ProgressCallback
from fusion.report.atomic_files import write_files
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import (
    FREQUENCY_ERROR,
    MOUNTINGS,
    TRIGGER_JITTER_S,
    Run,
    SimulationOptions,
    camera_rate,
    driven,
    write_run,
)
from fusion.simulate.world import Draws, make_world
from fusion.simulate.write import MANIFEST_FILE, TRUTH_FILE, calibration_file
from photogram.calibration.calibration_file import read_calibration
from photogram.calibration.exchange.exchange_files import export_calibration

FREQUENCIES_HZ = (63.0, 125.0, 250.0)
CAMERAS = {"left": "CamA", "right": "CamB"}
CALIBRATION = "Kalibrierung/stereo.yml"
"""As OpenCV writes it."""


def write_laboratory_files(folder: Path, seed: int, progress: ProgressCallback, options: SimulationOptions) -> None:
    """Write recorders' files, images, calibration and truth of every recording."""
    variants = [(mounting, frequency) for mounting in MOUNTINGS for frequency in FREQUENCIES_HZ]
    for number, (mounting, frequency) in enumerate(variants[: options.recordings], 1):
        run = _run(number, frequency, mounting)
        run = replace(run, preset=run.preset.reduced(options.frames, options.image_scale))
        draws = Draws(seed, options.systematic_errors, mounting=mounting, recording=run.preset.recording)
        world = make_world(run.preset, draws, TRIGGER_JITTER_S)
        recording = write_run(folder, run, world, draws, options)
        (recording / MANIFEST_FILE).unlink()
        (folder / run.rig_file).unlink()
        for setup in run.preset.stereo:
            for side, camera in CAMERAS.items():
                series = (recording / f"{setup.name}-{side}").rename(recording / camera)
                for image in series.iterdir():
                    image.rename(series / f"{camera}_{image.name}")
        progress("write", number, len(variants))
    (setup,) = run.preset.stereo
    calibration = folder / calibration_file(setup)
    (folder / CALIBRATION).parent.mkdir()
    export_calibration(folder / CALIBRATION, read_calibration(calibration))
    calibration.unlink()
    calibration.parent.rmdir()
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    write_files(folder, {TRUTH_FILE: json.dumps({"files": files})})


def _run(number: int, frequency_hz: float, mounting: str) -> Run:
    """Return one recording, driven along z; recorders and cameras start at other moments in each."""
    preset = read_preset(Preset, "files")
    preset = replace(preset, camera_rate_hz=camera_rate(preset, frequency_hz))
    rng = np.random.default_rng([7, number])
    motion = np.array(preset.acceleration) * np.exp(2j * np.pi * rng.uniform(size=(len(preset.multiples), 1)))
    name = f"Fz_{frequency_hz:03.0f}Hz_{mounting}"
    preset = driven(preset, name, frequency_hz * (1 + FREQUENCY_ERROR), motion, preset.multiples)
    daqs = [
        replace(daq, file=daq.file.replace(".", f"_{number:04d}."), start_s=daq.start_s + 0.01 * float(rng.uniform()))
        for daq in preset.daqs
    ]
    return Run(f"Fz {frequency_hz:g} Hz", replace(preset, daqs=tuple(daqs)), (frequency_hz,), mounting=mounting)
