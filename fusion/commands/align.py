"""`shakercal align`: place a stereo pair in the sensor frame."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, device


def add_align(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "align", parents=[common], help="find where a stereo pair's camera stands in the sensor frame"
    )
    parser.add_argument("alignment", type=Path, metavar="ALIGNMENT.toml", help="file that names the evidence")
    parser.add_argument("-o", "--output", type=Path, metavar="POSE.toml", help="file for the block of rig.toml")
    parser.add_argument("--force", action="store_true", help="overwrite the output that is there")
    parser.add_argument(
        "--allow-outside", action="store_true", help="accept files outside the folder of ALIGNMENT.toml"
    )
    parser.add_argument(
        "--device", type=device, default="auto", metavar="{auto,cpu,cuda}", help="where subsets are tracked"
    )
    parser.set_defaults(action=_act_align)


def _act_align(options: argparse.Namespace) -> int:
    from fusion.align import align_file
    from fusion.progress import progress_bar
    from fusion.settings import Settings

    with progress_bar(enabled=not options.quiet) as progress:
        text = align_file(
            options.alignment,
            options.output,
            Settings(device=options.device),
            force=options.force,
            allow_outside=options.allow_outside,
            progress=progress,
        )
    print(text, end="")
    return EXIT_DONE
