"""`shakercal run`: evaluate recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import Commands, add_recording, count, device, draws, radius, seed
from fusion.settings import DEFAULT_SEED, FEWEST_DRAWS, MOST_DRAWS


def add_run(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("run", parents=[common], help="evaluate one recording or a campaign of several")
    add_recording(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="RESULTS", help="folder of the results (default: RECORDING/results)"
    )
    parser.add_argument("--force", action="store_true", help="compute again and overwrite result files that are there")
    parser.add_argument(
        "--subset-radius",
        type=radius,
        metavar="PX",
        help="half-width of the subsets (default: from the speckle size in the images, 10 px for speckle of 4 to 5 px)",
    )
    parser.add_argument(
        "--device",
        type=device,
        default="auto",
        metavar="{auto,cpu,cuda}",
        help="where subsets are tracked (default: auto, a GPU where torch finds one)",
    )
    parser.add_argument(
        "--monte-carlo",
        type=draws,
        default=0,
        metavar="N",
        help="check the uncertainties with N draws of everything uncertain "
        f"({FEWEST_DRAWS} to {MOST_DRAWS}; 100000 are good for two digits of U; default: none)",
    )
    parser.add_argument(
        "--seed", type=seed, default=DEFAULT_SEED, metavar="S", help=f"of these draws (default: {DEFAULT_SEED})"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=count,
        default=1,
        metavar="N",
        help="processes that share the work on this machine (default: 1); results are the same to the last digit",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="have the work done by the Dask cluster whose scheduler is at ADDRESS, such as tcp://10.0.0.1:8786: its "
        'workers see the same files by the same paths (needs pip install "shakercal[cluster]")',
    )
    parser.set_defaults(action=_act_run)


def _act_run(options: argparse.Namespace) -> int:
    from fusion.campaign import exit_status, is_campaign, run_path
    from fusion.campaign_summary import print_campaign
    from fusion.progress import progress_bar
    from fusion.settings import Settings
    from fusion.summary import print_outcomes

    settings = Settings(
        subset_radius_px=options.subset_radius,
        device=options.device,
        monte_carlo=options.monte_carlo,
        seed=options.seed,
    )
    with progress_bar(enabled=not options.quiet) as progress:
        outcomes = run_path(
            options.recording,
            options.output,
            settings,
            force=options.force,
            allow_outside=options.allow_outside,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=progress,
        )
    (print_campaign if is_campaign(options.recording) else print_outcomes)(outcomes)
    return exit_status(outcomes)
