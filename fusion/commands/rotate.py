"""`shakercal rotate`: internal mass and load mass from the sensor turned on an indexing head."""

from __future__ import annotations

import argparse

from fusion.commands.values import EXIT_DONE, Commands, add_recordings, add_results


def add_rotate(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "rotate", parents=[common], help="internal mass and load mass from the sensor turned about a horizontal axis"
    )
    add_recordings(parser)
    add_results(parser, "folder rotate in the campaign or in the only recording, else beside rig.toml")
    parser.set_defaults(action=_act_rotate)


def _act_rotate(options: argparse.Namespace) -> int:
    from fusion.rotate.run import run_rotate

    run_rotate(options.recordings, options.output, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
