"""`shakercal load`: resonance over load mass, load limits, from releases with several loads or a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, add_allow_outside, add_results, not_negative, positive


def add_load(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "load", parents=[common], help="stiffness, resonance over load mass and load limits from releases with loads"
    )
    parser.add_argument(
        "recordings", type=Path, nargs="*", metavar="RECORDING", help="folder of a campaign, or of step recordings"
    )
    add_allow_outside(parser)
    parser.add_argument(
        "--frequencies",
        type=Path,
        metavar="TABLE",
        help="in place of recordings: CSV with load_mass_kg, frequency_hz and, if known, u_frequency_hz, second_hz, "
        "u_load_mass_kg",
    )
    parser.add_argument("--moving-mass", type=positive, metavar="KG", help="of the sensor, with --frequencies")
    parser.add_argument(
        "--moving-mass-uncertainty", type=not_negative, default=0.0, metavar="KG", help="standard uncertainty (0)"
    )
    parser.add_argument(
        "--load-mass",
        type=positive,
        nargs="+",
        default=[],
        metavar="KG",
        help="foretell resonance and bands with these loads, such as a gripper or a hand (kg; of moments kg m^2)",
    )
    parser.add_argument(
        "--permitted", type=_percent, default=0.05, metavar="PERCENT", help="error up to which loads are permitted (5)"
    )
    parser.add_argument(
        "--wanted", type=positive, nargs="+", default=[], metavar="HZ", help="largest load for these resonances"
    )
    add_results(parser, "folder load in the campaign, in the only recording, or beside rig.toml or TABLE")
    parser.set_defaults(action=_act_load, refuse=parser.error)


def _act_load(options: argparse.Namespace) -> int:
    from fusion.load_series.run import run_loads, run_table
    from fusion.load_series.settings import LoadSettings

    _check(options)
    table = options.frequencies is not None
    moving = (options.moving_mass, options.moving_mass_uncertainty) if table else None
    settings = LoadSettings(options.permitted, tuple(options.wanted), tuple(options.load_mass), moving)
    if table:
        run_table(options.frequencies, options.output, settings, force=options.force)
    else:
        run_loads(
            options.recordings, options.output, settings, force=options.force, allow_outside=options.allow_outside
        )
    return EXIT_DONE


def _check(options: argparse.Namespace) -> None:
    """Refuse recordings and a table at once, neither, and a table without the mass that its resonances belong to."""
    table = options.frequencies is not None
    if table == bool(options.recordings):
        options.refuse("expected either recordings or --frequencies TABLE")
    if table and options.moving_mass is None:
        options.refuse("--frequencies needs --moving-mass: resonances tell stiffness only over mass")
    if not table and options.moving_mass is not None:
        options.refuse("--moving-mass is for --frequencies: of recordings rig.toml states sensor.internal_mass")


def _percent(text: str) -> float:
    """Return a percentage above 0 and below 100 as a share."""
    value = positive(text)
    if value >= 100.0:
        raise argparse.ArgumentTypeError(f"expected less than 100 %, found {text}")
    return value / 100.0
