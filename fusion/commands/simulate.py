"""`shakercal simulate`: recordings with known truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, seed
from fusion.settings import ProgressCallback


def add_simulate(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("simulate", parents=[common], help="write a simulated recording with its truth")
    parser.add_argument("out", type=Path, metavar="OUT", help="campaign folder to create")
    parser.add_argument(
        "--preset",
        choices=(
            "demo",
            "nitsche2018",
            "sweep",
            "matrix",
            "targets",
            "chirp",
            "masses",
            "pitching",
            "rotation",
            "steps",
            "loads",
            "elastomer",
        ),
        default="demo",
        help="which rig (default: demo); sweep, matrix: campaigns for a curve over frequency and for the 6x6; "
        "targets: a camera calibration; chirp: a recording for shakercal transfer; masses, pitching: campaigns of two "
        "loads for shakercal identify; rotation: a campaign for shakercal rotate; steps: one for shakercal step; "
        "loads: one for shakercal load; elastomer: a geometry for shakercal elastomer",
    )
    parser.add_argument("--seed", type=seed, default=1, help="seed of every random draw (default: 1)")
    parser.add_argument("--force", action="store_true", help="overwrite a simulation that is there")
    parser.set_defaults(action=_act_simulate)


def _act_simulate(options: argparse.Namespace) -> int:
    from fusion.errors import InputError
    from fusion.progress import progress_bar

    if options.out.exists() and not options.force:
        expected = "a new folder (--force replaces an earlier simulation)"
        raise InputError(options.out, "", found="a file or folder of this name", expected=expected)
    with progress_bar(enabled=not options.quiet) as progress:
        told = _write(options.out, options.preset, options.seed, progress)
    print(told)
    return EXIT_DONE


def _write(out: Path, preset: str, seed: int, progress: ProgressCallback) -> str:
    """Write what a preset is, and return the sentence about it."""
    from fusion.simulate import (
        simulate,
        simulate_campaign,
        simulate_chirp,
        simulate_element,
        simulate_load_series,
        simulate_loads,
        simulate_rotation,
        simulate_steps,
        simulate_targets,
    )

    if preset == "targets":
        return f"simulated pictures of a target: {simulate_targets(out, seed, progress)}"
    if preset in ("sweep", "matrix"):
        folders = simulate_campaign(out, preset, seed, progress)
        return f"simulated campaign: {out}, {len(folders)} recording{'s' * (len(folders) > 1)}"
    if preset in ("masses", "pitching"):
        return f"simulated campaign: {simulate_loads(out, preset, seed, progress)}"
    counted = {"rotation": simulate_rotation, "steps": simulate_steps, "loads": simulate_load_series}
    if preset in counted:
        return f"simulated campaign: {out}, {len(counted[preset](out, seed))} recordings"
    if preset == "elastomer":
        return f"simulated element: {simulate_element(out, seed)}"
    folder = simulate_chirp(out, seed) if preset == "chirp" else simulate(out, preset, seed, progress)
    return f"simulated recording: {folder}"
