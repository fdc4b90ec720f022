"""Modes measured by pictures: what a load that bends does to a sensitivity, stated as rigid, as drawn, and measured.

`python benchmarks/modes.py --docs docs` renders recordings of the preset `bending`, evaluates each from its files three
times, and writes a table into docs/modes.md.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from pathlib import Path

import numpy as np
from marked import markdown_table, write_marked

from fusion import evaluate_recording, load_manifest, simulate_preset
from fusion.report.tables import sensitivity_element
from fusion.sensitivity.analyse import Evaluation

BLOCK = re.compile(r"\[\[load\.elastic\]\].*?(?=\n\[environment\])", re.DOTALL)
TREATMENTS = {
    "rigid, nothing stated": lambda text: BLOCK.sub("", text),
    "mode stated, u of its frequency 5 %": lambda text: re.sub(r"measured_by = .*\n", "", text),
    "mode stated and measured": lambda text: text,
}


def error(evaluation: Evaluation, recording: Path) -> tuple[float, float]:
    """Return the error of the driven element's magnitude and its U, relative; NaN where instruments contradict."""
    truth, found = json.loads((recording / "truth.json").read_text(encoding="utf-8")), evaluation.element
    if found is None or not np.isfinite(found.value[0, 2, 2]):
        return np.nan, np.nan
    true = abs(complex(truth["sensitivity"]["re"][0][2][2], truth["sensitivity"]["im"][0][2][2]))
    polar = sensitivity_element(found, 0, 2, 2)
    return polar.magnitude / true - 1.0, polar.expanded_magnitude / true


def draw(folder: Path, seed: int, frames: int, scale: float) -> dict[str, tuple[float, float]]:
    """Return error and U of the element by treatment, in one simulated recording."""
    recording = simulate_preset(folder, "bending", seed=seed, frames=frames, image_scale=scale)
    rig = folder / "rig.toml"
    whole, found = rig.read_text(encoding="utf-8"), {}
    for name, changed in TREATMENTS.items():
        rig.write_text(changed(whole), encoding="utf-8")
        evaluation = evaluate_recording(load_manifest(recording))
        found[name] = error(evaluation, recording)
        if name == "rigid, nothing stated":
            shapes = next(pair.shapes for pair in evaluation.stereo if pair.name == "top")
            print(f"seed {seed}: F {shapes.f[0]:.1f}, chance {shapes.chance[0]:.2g}, shapes {shapes.modes}")
        print(f"seed {seed}: {name}: {100 * found[name][0]:+.4f} % (U {100 * found[name][1]:.4f} %)", flush=True)
    return found


def main() -> None:
    """Simulate, evaluate, print, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--frames", type=int, default=211)
    parser.add_argument("--scale", type=float, default=1.0, help="of the pictures")
    parser.add_argument("--docs", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = [
            draw(Path(folder) / str(seed), seed, options.frames, options.scale) for seed in range(1, options.draws + 1)
        ]
    rows = []
    for name in TREATMENTS:
        every = np.array([each[name] for each in found])
        (errors, u), refused = every[np.isfinite(every[:, 0])].T, int(np.sum(np.isnan(every[:, 0])))
        if len(errors) < 2:
            rows.append(f"| {name} | – | – | – | – | {refused} |")
            continue
        mean, spread, inside = 100 * errors.mean(), 100 * errors.std(ddof=1), int(np.sum(np.abs(errors) <= u))
        largest = 100 * np.abs(errors).max()
        rows.append(
            f"| {name} | {mean:+.3f} ± {spread:.3f} | {largest:.3f} | {100 * u.mean():.3f} | {inside} of {len(u)} "
            f"| {refused} |"
        )
    head = "| load | error / %, mean ± scatter | largest / % | U / % | within U | no result: instruments contradict |"
    table = markdown_table(head, rows)
    pictures = (
        f"{options.draws} recordings of {options.frames} frames, pictures of {round(640 * options.scale)} px width."
    )
    print(table)
    if options.docs is not None:
        write_marked(options.docs / "modes.md", {"measured modes": f"{pictures}\n\n{table}"})


if __name__ == "__main__":
    main()
