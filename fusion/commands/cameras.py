"""The commands that calibrate cameras: cameras, import-calibration, align."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.options import EXIT_DONE, Commands, device, not_negative, positive, size

# `shakercal cameras`: calibrate a stereo pair.


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
    from fusion.base import InputError, progress_bar
    from fusion.cameras.calibrate import CameraSettings, run_cameras
    from photogram.targets.view import Target

    try:
        target = Target(options.target, options.spacing, options.size, options.dictionary)
    except ValueError as error:
        raise InputError("shakercal cameras", "--" + str(error).partition(":")[0], str(error), "") from error
    settings = CameraSettings(target, options.shape, options.scale_uncertainty)
    with progress_bar(enabled=not options.quiet) as progress:
        run_cameras(options.pictures, settings, options.output, options.force, progress)
    return EXIT_DONE


# `shakercal import-calibration`: take over another program's calibration.


def add_import_calibration(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "import-calibration",
        parents=[common],
        help="take over a calibration of OpenCV, DICe, VIC-3D, MATLAB or Bouguet's toolbox",
    )
    parser.add_argument("calibration", type=Path, metavar="FILE", help="the other program's file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="JSON", help="calibration file to write")
    parser.add_argument("--extrinsics", type=Path, metavar="FILE", help="second file, where OpenCV's R and T are apart")
    parser.add_argument("--image-size", type=size, metavar="2448x2048", help="width x height, if the file has none")
    parser.add_argument("--length-unit", choices=("m", "mm"), help="of the file's lengths, where it does not say it")
    parser.add_argument("--force", action="store_true", help="overwrite a calibration file that is there")
    parser.set_defaults(action=_act_import_calibration)


def _act_import_calibration(options: argparse.Namespace) -> int:
    from fusion.cameras.calibrate import convert_calibration

    source = options.calibration, options.extrinsics
    found = convert_calibration(source, options.output, options.image_size, options.length_unit, options.force)
    print(f"calibration of {found} written: {options.output}")
    return EXIT_DONE


# `shakercal align`: place a stereo pair in the sensor frame.


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
    from fusion.base import Settings, progress_bar
    from fusion.cameras.align import align_file

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
