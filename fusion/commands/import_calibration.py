"""`shakercal import-calibration`: take over another program's calibration."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, size


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
    from fusion.import_calibration import convert_calibration

    source = options.calibration, options.extrinsics
    found = convert_calibration(source, options.output, options.image_size, options.length_unit, options.force)
    print(f"calibration of {found} written: {options.output}")
    return EXIT_DONE
