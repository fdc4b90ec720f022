"""Modes measured by pictures: what a load that bends does to a sensitivity, stated as rigid, as drawn, and measured.

`python benchmarks/modes.py --docs docs` renders recordings of the preset `bending`, evaluates each from its files three
times, and writes a table into docs/modes.md; `"all at once"` those of the preset `laboratory`, whose load bends, whose
cameras shake by 0.2 % of the driven motion and whose clocks are nearly locked, with the lasers elsewhere as well; with
`--drawn` without rendering them (`drawn_motion`).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from drawn_motion import make_template, unrendered
from marked import existing_folder, markdown_table, write_marked

from fusion import evaluate_recording, load_manifest, simulate_preset
from fusion.report.tables import sensitivity_element
from fusion.sensitivity.analyse import Evaluation
from fusion.simulate import sines
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import TRIGGER_JITTER_S, rendered_run, write_run
from fusion.simulate.violations import violations
from fusion.simulate.world import Draws, World, make_world

BLOCK = re.compile(r"\[\[load\.elastic\]\].*?(?=\n\[environment\])", re.DOTALL)
TREATMENTS = {
    "rigid, nothing stated": lambda text: BLOCK.sub("", text),
    "mode stated, u of its frequency 5 %": lambda text: re.sub(r"measured_by = .*\n", "", text),
    "mode stated and measured": lambda text: text,
}
CASES: dict[str, tuple[str, tuple[str, ...], dict[str, Callable[[str], str]]]] = {
    "measured modes": ("bending", (), TREATMENTS),
    "all at once": ("laboratory", ("camera-shake=0.002", "locked-clocks=0.6"), {}),
}
"""Preset, what is broken of it, and how its rig.toml is changed, if not where its lasers look, by the table of them."""
AS_IT_IS = "at 0.76 of the radius (preset)"
SPOTS = {AS_IT_IS: (0.0, 1), "at 0.50": (0.50, 10), "at 0.31": (0.31, 1)}
"""Where the lasers look, over the radius of the plate, 0 for the preset's own place; in every which draw."""


def error(evaluation: Evaluation, recording: Path) -> tuple[float, float]:
    """Return the error of the driven element's magnitude and its U, relative; NaN where instruments contradict."""
    truth, found = json.loads((recording / "truth.json").read_text(encoding="utf-8")), evaluation.element
    if found is None or not np.isfinite(found.value[0, 2, 2]):
        return np.nan, np.nan
    true = abs(complex(truth["sensitivity"]["re"][0][2][2], truth["sensitivity"]["im"][0][2][2]))
    polar = sensitivity_element(found, 0, 2, 2)
    return polar.magnitude / true - 1.0, polar.expanded_magnitude / true


def draw(folder: Path, case: str, seed: int, frames: int, scale: float) -> dict[str, tuple[float, float]]:
    """Return error and U of the element by treatment, or by where the lasers look, in one recording of a case."""
    name, broken, treatments = CASES[case]
    recording = simulate_preset(folder, name, seed=seed, frames=frames, image_scale=scale, violate=broken)
    rig = folder / "rig.toml"
    whole, found = rig.read_text(encoding="utf-8"), {}
    for treatment, changed in (treatments or {AS_IT_IS: str}).items():
        rig.write_text(changed(whole), encoding="utf-8")
        found[treatment] = error(evaluate_recording(load_manifest(recording)), recording)
        tell(seed, treatment, found[treatment])
    for spots, (share, every) in ({} if treatments else SPOTS).items():
        if share and every == 1:
            moved, world, drawing = looking(case, read_preset(Preset, name).reduced(frames, scale), seed, share)
            with pictures_of(recording):
                elsewhere = write_run(folder / f"{share}", rendered_run(moved), world, drawing)
            found[spots] = error(evaluate_recording(load_manifest(elsewhere)), elsewhere)
            tell(seed, spots, found[spots])
    return found


@contextmanager
def pictures_of(recording: Path) -> Iterator[None]:
    """Write recordings with the pictures of another one that has the same truth: cameras do not see the lasers."""

    def linked(folder: Path, *_: object) -> None:
        here, there = ((one / "truth.json").read_text(encoding="utf-8") for one in (folder, recording))
        if json.loads(here) != json.loads(there):
            raise ValueError("expected pictures of the same motion")
        for series in (entry for entry in recording.iterdir() if entry.is_dir()):
            shutil.copytree(series, folder / series.name, copy_function=os.link)

    with patch.object(sines, "_write_images", linked):
        yield


def tell(seed: int, name: str, found: tuple[float, float]) -> None:
    """Print error and U of one recording as they come."""
    print(f"seed {seed}: {name}: {100 * found[0]:+.4f} % (U {100 * found[1]:.4f} %)", flush=True)


def drawn(case: str, draws: int, frames: int) -> Iterator[dict[str, tuple[float, float]]]:
    """Yield error and U of the element by where the lasers look, of one draw after the other that is not rendered."""
    preset = read_preset(Preset, CASES[case][0]).reduced(frames, 1.0)
    with tempfile.TemporaryDirectory() as folder:
        template = make_template(Path(folder) / "template", preset)
        for seed in range(1, draws + 1):
            found = {}
            for spots, (share, every) in SPOTS.items():
                if seed % every:
                    continue
                moved, world, drawing = looking(case, preset, seed, share)
                with tempfile.TemporaryDirectory(dir=folder) as own, unrendered(template, world, drawing):
                    recording = write_run(Path(own), rendered_run(moved), world, drawing)
                    found[spots] = error(evaluate_recording(load_manifest(recording)), recording)
                tell(seed, spots, found[spots])
            yield found


def looking(case: str, preset: Preset, seed: int, share: float) -> tuple[Preset, World, Draws]:
    """Return a preset whose lasers look at a share of the plate's radius, 0 for where they do, and the truth of it."""
    assert preset.plate is not None
    daqs = []
    for daq in preset.daqs:
        channels = list(daq.channels)
        for place, spec in enumerate(channels if share else ()):
            x, y, z = spec.point
            if spec.quantity == "velocity":
                size = share * preset.plate.radius / float(np.hypot(x, y))
                channels[place] = replace(spec, point=(size * x, size * y, z))
        daqs.append(replace(daq, channels=tuple(channels)))
    moved = replace(preset, daqs=tuple(daqs))
    drawing = Draws(seed, True, violations=violations(CASES[case][1], moved))
    return moved, make_world(moved, drawing, TRIGGER_JITTER_S), drawing


def rows(found: list[dict[str, tuple[float, float]]]) -> list[str]:
    """Return a row for each treatment."""
    told = []
    for name in dict.fromkeys(name for each in found for name in each):
        every = np.array([each[name] for each in found if name in each])
        known = np.isfinite(every[:, 0])
        errors, u = every[known].T
        refused = int(np.sum(~known))
        if len(errors) < 2:
            told.append(f"| {name} | – | – | – | – | {refused} |")
            continue
        mean, spread, inside = 100 * errors.mean(), 100 * errors.std(ddof=1), int(np.sum(np.abs(errors) <= u))
        largest, typical = 100 * np.abs(errors).max(), 100 * u.mean()
        numbers = f"{mean:+.3f} ± {spread:.3f} | {largest:.3f} | {typical:.3f} | {inside} of {len(u)}"
        told.append(f"| {name} | {numbers} | {refused} |")
    return told


def main() -> None:
    """Simulate, evaluate, print, and write the table of one case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=CASES, nargs="?", default="measured modes")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--scale", type=float, default=1.0, help="of the pictures")
    parser.add_argument("--drawn", action="store_true", help="without rendering")
    parser.add_argument("--docs", type=existing_folder)
    options = parser.parse_args()
    if options.drawn:
        mark = f"{options.case}, drawn"
        told = f"{options.draws} draws of {options.frames} frames."
        found = list(drawn(options.case, options.draws, options.frames))
    else:
        mark = options.case
        width = round(640 * options.scale)
        told = f"{options.draws} recordings of {options.frames} frames, images of {width} px width."
        with tempfile.TemporaryDirectory() as folder:
            size, seeds = (options.frames, options.scale), range(1, options.draws + 1)
            found = [draw(Path(folder) / str(seed), options.case, seed, *size) for seed in seeds]
    what = "load" if CASES[options.case][2] else "lasers"
    head = f"| {what} | error / %, mean ± scatter | largest / % | U / % | within U | contradictory: no result |"
    table = f"{told}\n\n{markdown_table(head, rows(found))}"
    print(table)
    if options.docs is not None:
        write_marked(options.docs / "modes.md", {mark: table})


if __name__ == "__main__":
    main()
