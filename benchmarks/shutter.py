"""Rolling shutters and long exposures: error and coverage of the driven component, ignored and accounted for.

    python benchmarks/shutter.py [--recordings 3] [--only rows|blur] [--write docs/shutter.md]

The demo's rig seen by one stereo pair alone, 24 frames, every systematic error drawn, pictures of 152 x 480 px with
rows of 10 us, of 182 x 144 px for long exposures; evaluated from its files as a user would. Pictures are rendered with
the body where it is when each row is exposed, as the mean over up to 40 instants of an exposure; that shares nothing
with the estimator. 3 recordings of every case take some 15 minutes on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from marked import existing_file, short_table, write_marked
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.recording.load import load_manifest
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import rendered_run, write_run
from fusion.simulate.world import Draws, make_world

FloatArray = NDArray[np.float64]
FRAMES, PIXEL_M = 24, 0.26e-3
ROW_TIME_S, BODY_S = 10e-6, 4.0e-3
"""Of 480 rows, and about for how long they show the body."""
VIEW_SINE = float(np.sqrt(1.0 - (np.cos(np.radians(22.0)) * np.cos(np.radians(13.5))) ** 2))
"""Of the angle between z and the views of the demo's pair, which is tilted by 22° with 27° between its views."""
TALL = {"size_px": (152, 480), "half_size": (0.015, 0.052), "round": False}
SMALL = {"size_px": (182, 144), "half_size": (0.0246, 0.0246)}


@dataclass(frozen=True)
class Case:
    """Line, acceleration along z, exposure, and whether rows are exposed one after the other."""

    frequency_hz: float
    drive: float
    exposure_s: float = 100e-6
    rolls: bool = False

    @property
    def amplitude_px(self) -> float:
        """Of the motion along z, in the images of both cameras."""
        return VIEW_SINE * self.drive / (2.0 * np.pi * self.frequency_hz) ** 2 / PIXEL_M


ROWS = tuple(Case(*at, rolls=True) for at in ((50.0003, 60.0), (106.2507, 100.0), (250.0003, 190.0), (1020.307, 420.0)))
BLUR = (
    *(Case(80.0003, 250.0, exposure_s) for exposure_s in (1e-4, 1e-3, 2e-3, 3e-3, 5e-3, 10e-3)),
    Case(80.0003, 80.0, 5e-3),
    Case(300.0003, 400.0, 2e-3),
)


def recorded(case: Case, seed: int, folder: Path) -> tuple[Path, FloatArray]:
    """Render one recording into an empty folder; return its folder and the true acceleration (6,) of the load."""
    whole = read_preset(Preset, "demo")
    phasors = np.array(whole.acceleration[0])
    row_time, size = (ROW_TIME_S, TALL) if case.rolls else (0.0, SMALL)
    pair = replace(whole.stereo[0], row_time=row_time, **size)
    daqs = tuple(
        replace(daq, channels=tuple(c for c in daq.channels if c.body != "load" or not c.quantity.startswith("velo")))
        for daq in whole.daqs
    )
    cycles = round(case.frequency_hz / whole.camera_rate_hz)
    preset = replace(
        whole,
        fundamental_hz=case.frequency_hz,
        multiples=(1,),
        acceleration=(tuple((phasors * case.drive / abs(phasors[2])).tolist()),),
        camera_rate_hz=case.frequency_hz / (cycles + 0.29),
        exposure_s=case.exposure_s,
        stereo=(pair,),
        daqs=daqs,
        frames=FRAMES,
    )
    draws = Draws(seed, True)
    world = make_world(preset, draws, 30e-9)
    return write_run(folder, rendered_run(preset), world, draws), world.motion["load"].acceleration[0]


def found(recording: Path, true: FloatArray) -> tuple[complex, FloatArray, float]:
    """Return relative error of z, errors of Re and Im (12,) over their u, and the relative u of the amplitude of z."""
    evaluation = evaluate_recording(load_manifest(recording), Settings(), {})
    line = int(np.argmin(evaluation.lines.multiple))
    fused = next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", "fused"))
    error = fused.phasors.value[line] - true
    u = np.sqrt(np.diagonal(fused.uncertainty.covariance[line]))
    along = np.conj(true[2]) / abs(true[2])
    amplitude = np.hypot(along.real * u[2], along.imag * u[8]) / abs(true[2])
    return error[2] / true[2], np.concatenate([error.real, error.imag]) / u, float(amplitude)


def trials(case: Case, recordings: int, without: Callable[[Path], object]) -> tuple[list[str], str]:
    """Return errors and coverage, ignored and accounted for, as cells, and the relative u of the amplitude."""
    cells, u = list[str](), 0.0
    for ignored in (True, False):
        relative, over_u = list[complex](), list[FloatArray]()
        for seed in range(1, recordings + 1):
            with tempfile.TemporaryDirectory() as scratch:
                recording, true = recorded(case, seed, Path(scratch) / "campaign")
                counts = np.inf if ignored else 1e-5
                if ignored:
                    without(recording)
                with patch("fusion.phasors.shutter_refinement.BLUR_COUNTS", counts):
                    try:
                        error, parts, u = found(recording, true)
                    except Exception as problem:  # what is told to the user of such a recording
                        print(f"{case}, seed {seed}: {problem}", flush=True)
                        continue
            relative.append(error)
            over_u.append(parts)
        if not relative:
            cells += ["refused", "–", "–"]
            continue
        size = np.abs(np.concatenate(over_u))
        rms = np.sqrt(np.mean(np.square([(e.real, e.imag) for e in relative]), axis=0))
        cells += [f"{brief(100.0 * rms[0])} %, {brief(1e3 * rms[1])} mrad", f"{100.0 * np.mean(size < 2.0):.0f} %"]
        cells.append(brief(float(np.sqrt(np.mean(size**2)))))
    return cells, f"{100.0 * u:.2g} %"


def brief(value: float) -> str:
    """Return two digits of a number, all before the point."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def without_rows(recording: Path) -> None:
    """Take the row time out of the rig."""
    rig = recording.parent / "rig.toml"
    lines = rig.read_text(encoding="utf-8").splitlines(keepends=True)
    rig.write_text("".join(line for line in lines if not line.startswith("row_time")), encoding="utf-8")


def _is_shown(cells: list[str]) -> bool:
    """Return whether the page shows a row of long exposures."""
    return cells[0] != "80 Hz" or cells[1] in ("1 ms", "3 ms", "10 ms")


HEAD = "error of z, rms | within 2 u | rms / u |"


def main(recordings: int, only: str | None, page: Path | None) -> None:
    """Run all cases, print both tables and write them."""
    tables = dict[str, str]()
    if only != "blur":
        rows = []
        for case in ROWS:
            cells, u = trials(case, recordings, without_rows)
            angle = 360.0 * case.frequency_hz * BODY_S
            first: tuple[str, ...] = f"{case.frequency_hz:.4g} Hz", f"{case.amplitude_px:.2g}", f"{angle:.0f}°"
            rows.append("| " + " | ".join((*first, *cells, u)) + " |")
            print(rows[-1], flush=True)
        head = f"| line | amplitude in the image / px | turns over the body | ignored: {HEAD} modelled: {HEAD} u of z |"
        tables["rows"] = short_table(head, rows, (0, 2, 3, 6, 9))
    if only != "rows":
        rows = []
        for case in BLUR:
            cells, u = trials(case, recordings, lambda recording: None)
            turn = f"{case.frequency_hz * case.exposure_s:.3g}"
            first = f"{case.frequency_hz:.4g} Hz", f"{1e3 * case.exposure_s:g} ms", turn, f"{case.amplitude_px:.2g}"
            rows.append("| " + " | ".join((*first, *cells, u)) + " |")
            print(rows[-1], flush=True)
        head = f"| line | exposure T | f·T | amplitude in the image / px | as sharp: {HEAD} as blurred: {HEAD} u of z |"
        tables["blur"] = short_table(head, rows, (0, 1, 2, 3, 4, 7, 10), _is_shown)
    if page is not None:
        write_marked(page, tables)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=3)
    parser.add_argument("--only", choices=("rows", "blur"))
    parser.add_argument("--write", type=existing_file)
    arguments = parser.parse_args()
    main(arguments.recordings, arguments.only, arguments.write)
