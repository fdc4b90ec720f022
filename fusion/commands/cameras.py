"""`shakercal cameras`: calibrate a stereo pair."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, not_negative, positive, size


def add_cameras(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("cameras", parents=[common], help="calibrate a stereo pair from target pictures")
    parser.add_argument(
        "pictures",
        nargs="+",
        metavar="PICTURES",
        help="left pictures, then the right ones in the same order; or two folders",
    )
    kinds = ("chessboard", "charuco", "dots", "asymmetric-dots")
    parser.add_argument("--target", required=True, choices=kinds, help="dots: with three ring markers, or give --size")
    parser.add_argument(
        "--spacing",
        required=True,
        type=positive,
        metavar="M",
        help="side of a square, or centre to centre of dots, in m",
    )
    parser.add_argument(
        "--size",
        type=size,
        metavar="9x6",
        help="inner corners (chessboard), squares (charuco) or dots: columns x rows",
    )
    parser.add_argument("--dictionary", metavar="NAME", help="ArUco dictionary such as DICT_4X4_50 (default: found)")
    parser.add_argument(
        "--scale-uncertainty",
        type=not_negative,
        default=0.0,
        metavar="U",
        help="relative standard uncertainty of the spacing, part of the covariance (default: 0, with a warning)",
    )
    parser.add_argument(
        "--shape",
        choices=("auto", "flat", "bowed", "free"),
        default="auto",
        help="target taken as flat, bowed, or with every point's offset estimated (default: auto, flat where it fits)",
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="CALIBRATION", help="file NAME.json to write"
    )
    parser.add_argument("--force", action="store_true", help="replace a calibration that is there")
    parser.set_defaults(action=_act_cameras)


def _act_cameras(options: argparse.Namespace) -> int:
    from fusion.cameras import CameraSettings, run_cameras
    from fusion.errors import InputError
    from fusion.progress import progress_bar
    from photogram.target.view import Target

    try:
        target = Target(options.target, options.spacing, options.size, options.dictionary)
    except ValueError as error:
        raise InputError("shakercal cameras", "--" + str(error).partition(":")[0], str(error), "") from error
    settings = CameraSettings(target, options.shape, options.scale_uncertainty)
    with progress_bar(enabled=not options.quiet) as progress:
        run_cameras(options.pictures, settings, options.output, options.force, progress)
    return EXIT_DONE
