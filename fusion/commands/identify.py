"""`shakercal identify`: stiffness, damping and internal mass of the sensor from all recordings of a campaign."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, add_allow_outside, add_results, not_negative, positive


def add_identify(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "identify", parents=[common], help="stiffness, damping and internal mass of the sensor from a whole campaign"
    )
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN", help="folder of a campaign or of one recording")
    add_allow_outside(parser)
    parser.add_argument(
        "--model",
        choices=("auto", "translation", "pitching", "adapter"),
        default="auto",
        help="default: auto, translation, and pitching where a second peak calls for it",
    )
    parser.add_argument(
        "--damping", choices=("common", "each"), default="common", help="one for all recordings, or one for each"
    )
    parser.add_argument(
        "--internal-mass",
        choices=("auto", "free", "stated"),
        default="auto",
        help="default: auto, fitted where two load masses or more tell it from the stiffness, else that of rig.toml",
    )
    parser.add_argument(
        "--band", nargs=2, type=not_negative, metavar=("LOW", "HIGH"), help="lines to fit, in Hz (default: all)"
    )
    parser.add_argument(
        "--load-mass",
        nargs="+",
        type=positive,
        default=(),
        metavar="KG",
        help="masses for which corrections and usable bands are given (default: those of the recordings)",
    )
    parser.add_argument(
        "--permitted",
        type=_share,
        default=0.05,
        metavar="SHARE",
        help="error of the magnitude up to which a band is usable (default: 0.05)",
    )
    add_results(parser, "CAMPAIGN/identify")
    parser.set_defaults(action=_act_identify)


def _share(text: str) -> float:
    """Return a number between 0 and 1."""
    value = positive(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text}")
    return value


def _act_identify(options: argparse.Namespace) -> int:
    from fusion.errors import InputError
    from fusion.identify.run import run_identify
    from fusion.identify.settings import IdentifySettings

    band = None if options.band is None else (options.band[0], options.band[1])
    if band is not None and band[0] >= band[1]:
        found = f"{band[0]:g} and {band[1]:g}"
        raise InputError(options.campaign, "--band", found=found, expected="two frequencies in Hz, the lower first")
    settings = IdentifySettings(
        model=options.model,
        damping=options.damping,
        internal_mass=options.internal_mass,
        band_hz=band,
        load_masses_kg=tuple(options.load_mass),
        permitted=options.permitted,
    )
    run_identify(options.campaign, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
