"""`shakercal rotate`: internal mass and load mass from the sensor turned on an indexing head."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands


def add(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "rotate", parents=[common], help="internal mass and load mass from the sensor turned about a horizontal axis"
    )
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="folder of a campaign, or of recordings of one rig",
    )
    parser.add_argument("--allow-outside", action="store_true", help="accept files outside the folder of rig.toml")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="RESULTS",
        help="result folder (default: folder rotate in the campaign or in the only recording, else beside rig.toml)",
    )
    parser.add_argument("--force", action="store_true", help="overwrite result files that are there")
    parser.set_defaults(action=_act)


def _act(options: argparse.Namespace) -> int:
    from fusion.rotate.run import run_rotate

    run_rotate(options.recordings, options.output, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
