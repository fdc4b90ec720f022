"""`shakercal decouple`: one model of all outputs over all loads, and a filter against cross-talk."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, add_allow_outside, add_results, positive


def add_decouple(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "decouple",
        parents=[common],
        help="model of all outputs over all loads from releases; filter against cross-talk",
    )
    parser.add_argument(
        "campaign", type=Path, metavar="CAMPAIGN", help="folder with recordings of releases of all loads"
    )
    add_allow_outside(parser)
    parser.add_argument(
        "--frequency",
        type=positive,
        metavar="HZ",
        help="wanted frequency behind the filter (default: half the lowest mode's)",
    )
    parser.add_argument(
        "--damping",
        type=_damping,
        default=0.6,
        metavar="Z",
        help="wanted damping ratio, between 0 and 1 (default: 0.6)",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the models drawn for U (default: 1)")
    add_results(parser, "folder decouple in the campaign")
    parser.set_defaults(action=_act_decouple)


def _damping(text: str) -> float:
    """Return a damping ratio of an oscillator."""
    value = float(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text}")
    return value


def _act_decouple(options: argparse.Namespace) -> int:
    from fusion.decouple.result import DecoupleSettings
    from fusion.decouple.run import run_decouple

    settings = DecoupleSettings(options.frequency, options.damping, options.seed)
    run_decouple(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
