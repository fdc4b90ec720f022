"""One camera before a known face: its U, and that of `shakercal plan --setup`.

    python benchmarks/one_camera.py [--draws 24] [--only films NAME ...] [--write PAGE]

Every draw is a rendered recording with all stated uncertainties sampled (`one_camera_render.py`), and evaluated
from its files.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from marked import existing_file, markdown_row, markdown_table, write_marked
from one_camera_render import FACES, SENSITIVITY, Case, write_recording

from fusion.planning.camera_setup import CameraSetup, estimate_setup, relative_expanded_uncertainty
from fusion.recording.load import load_manifest
from fusion.sensitivity.recording_evaluation import evaluate_recording

PHONE = Case(
    "telephone", turn_deg=35.0, pixel_m=3e-6, focal_m=4.3e-3, distance_m=0.25, noise=0.008, bits=8,
    rate_hz=59.94, frames=120, exposure_s=250e-6, row_s=12e-6, u_focal=1e-3, u_distance_m=5e-4, u_tilt=3e-3,
    u_pose=(3e-4, 2e-3),
)  # fmt: skip
INDUSTRIAL = Case("industrial camera", turn_deg=35.0)
FREE = replace(PHONE, free=True)
STROBE = replace(PHONE, row_s=0.0, rate_hz=29.97, frames=90, exposure_s=100e-6)
CASES = (
    replace(INDUSTRIAL, name="industrial, side, turned by 35°"),
    replace(INDUSTRIAL, name="industrial, side, across the view", turn_deg=0.0),
    replace(INDUSTRIAL, name="industrial, from above", face="top", turn_deg=0.0),
    replace(INDUSTRIAL, name="industrial, turned, 500 Hz", frequency_hz=500.0, acceleration=50.0),
    replace(STROBE, name="telephone, strobe"),
    replace(FREE, name="telephone, 60 frames/s"),
    replace(FREE, name="telephone, 240 frames/s", rate_hz=239.76, frames=240, noise=0.012, row_s=3.8e-6),
    replace(FREE, name="telephone, 60 frames/s, 300 Hz", frequency_hz=300.0),
)


def setup_of(case: Case, **changes: object) -> CameraSetup:
    """Return what a laboratory would state in advance."""
    centre, axes = FACES[case.face]
    scale = float(np.hypot(case.u_focal, case.u_distance_m / case.distance_m))
    sheet = {
        "pixel": case.pixel_m, "image": (case.size_px, case.size_px), "focal_length": case.focal_m, "f_number": 8.0,
        "distance": case.distance_m, "view_angle": case.turn_deg, "face": (2 * case.half_m, 2 * case.half_m),
        "speckle": case.speckle_px, "contrast": case.contrast, "noise": case.noise, "frames": case.frames,
        "origin": tuple(-centre @ axes), "direction": tuple(axes[2]), "frequency": case.frequency_hz,
        "acceleration": case.acceleration, "scale_uncertainty": scale,
    }  # fmt: skip
    return CameraSetup.model_validate(sheet | changes)


def magnitude(case: Case, seed: int) -> tuple[float, float]:
    """Return the relative error of the sensitivity of one rendered recording, and its stated U."""
    with tempfile.TemporaryDirectory() as folder:
        write_recording(Path(folder) / "one", case, seed)
        result = evaluate_recording(load_manifest(Path(folder) / "one")).sensitivity
    assert result is not None
    (polar,) = result.polar[0]
    assert polar is not None
    found = polar.magnitude / abs(SENSITIVITY) - 1.0, polar.expanded_magnitude / abs(SENSITIVITY)
    print(case.name, seed, f"error {found[0]:+.2e}, U {found[1]:.2e}", flush=True)
    return found


def reached(case: Case, draws: int) -> str:
    """Return the row of a case: plan, stated U, scatter and coverage of the magnitude."""
    setup = setup_of(case)
    planned = relative_expanded_uncertainty(setup, estimate_setup(setup).covariance["one camera"])
    error, size = np.array([magnitude(case, seed) for seed in range(draws)]).T
    twice = 2.0 * float(np.sqrt(np.mean(error**2)))
    cells = (f"{100.0 * share:.2g}" for share in (planned, float(np.median(size)), twice))
    return markdown_row(case.name, *cells, f"{np.count_nonzero(np.abs(error) <= size)} of {draws}")


def films(draws: int) -> list[str]:
    """Return rows of the error by compression, without other systematic errors."""
    exact = replace(STROBE, frames=60, u_focal=1e-9, u_distance_m=0.0, u_tilt=0.0, u_pose=(0.0, 0.0), prnu=0.0)
    rows = []
    for acceleration in (10.0, 50.0, 200.0):
        case = replace(exact, name=f"{acceleration:g} m/s²", acceleration=acceleration)
        amplitude_px = acceleration / (2.0 * np.pi * case.frequency_hz) ** 2 * case.focal_px / case.distance_m
        cells = []
        for film in (False, True):
            error, size = np.array([magnitude(replace(case, film=film), seed) for seed in range(draws)]).T
            cells.append(f"{100.0 * np.mean(error):+.2g} ± {100.0 * np.median(size):.2g}")
        rows.append(markdown_row(f"{amplitude_px:.2g}", *cells))
    return rows


TABLES = ("films",)
REACHED = "| camera | planned U / % | stated U / % | 2 × rms error / % | within ±U |"
FILMS = "| amplitude in the image / px | 8-bit images: error ± U / % | compressed film: error ± U / % |"


def main() -> None:
    """Print the tables, and write them into a page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=24)
    parser.add_argument("--only", nargs="*", default=[*TABLES, *(case.name for case in CASES)])
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args()
    parts = {}
    if chosen := [case for case in CASES if case.name in options.only]:
        parts["cameras"] = markdown_table(REACHED, [reached(case, options.draws) for case in chosen])
    if "films" in options.only:
        parts["films"] = markdown_table(FILMS, films(max(3, options.draws // 8)))
    print("\n\n".join(parts.values()))
    if options.write is not None:
        write_marked(options.write, parts)


if __name__ == "__main__":
    main()
