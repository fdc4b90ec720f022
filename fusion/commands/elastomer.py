"""`shakercal elastomer`: stiffness and modes of a cross-beam element from its geometry."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, add_results


def add_elastomer(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "elastomer", parents=[common], help="stiffness and modes of a cross-beam element from its geometry"
    )
    parser.add_argument(
        "geometry", type=Path, metavar="GEOMETRY.toml", help="what the element is, or a folder with elastomer.toml"
    )
    parser.add_argument(
        "--solid",
        action="store_true",
        help='also model it as an elastic solid on meshes that get finer (needs pip install "shakercal[solid]")',
    )
    add_results(parser, "folder elastomer beside the file")
    parser.set_defaults(action=_act_elastomer)


def _act_elastomer(options: argparse.Namespace) -> int:
    from fusion.elastomer.run import run_elastomer
    from fusion.progress import progress_bar

    with progress_bar(enabled=not options.quiet) as progress:
        run_elastomer(options.geometry, options.output, solid=options.solid, force=options.force, progress=progress)
    return EXIT_DONE
