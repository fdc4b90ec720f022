"""Commands for cameras: calibration, import and export of calibrations, pose of a pair, acceptance test.

Each command has a function for its options, and one for its action, which imports heavy modules. Its docstring is its
help.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from fusion.base import Settings
from fusion.commands.options import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    command,
    in_metres,
    length,
    path,
    share,
    size,
    whole_numbers,
)
from fusion.errors import INVALID_OPTION, LENGTH_UNIT_REQUIRED, InputError
from fusion.report.terminal import progress_bar


def _cameras_options(parser: Parser) -> None:
    text = "left images, then the right ones in the same order; or two folders"
    parser.add_argument("images", nargs="+", metavar="IMAGES", help=text)
    kinds = ("chessboard", "charuco", "aprilgrid", "dots", "asymmetric-dots")
    parser.add_argument("--target", required=True, choices=kinds, help="dots: with three ring markers, or give --size")
    text = "side of a square or a tag, or centre to centre of dots: in m, or with its unit, such as 7mm"
    parser.value("--spacing", length, "LENGTH", text, required=True)
    parser.value(
        "--size", size, "9x6", "inner corners (chessboard), squares (charuco), tags (aprilgrid) or dots: columns x rows"
    )
    parser.value("--dictionary", str, "NAME", "ArUco dictionary such as DICT_4X4_50 (default: found)")
    text = "gap between two tags of an AprilGrid over the side of a tag (Kalibr's tagSpacing), such as 0.3"
    parser.value("--tag-spacing", float, "RATIO", text)
    text = "number of a board's first marker (default: 0, no other board in view); 0,44 for several boards"
    parser.value("--first-id", whole_numbers, "N", text)
    text = "relative standard uncertainty of the spacing, part of the covariance (default: 0, with a warning)"
    parser.value("--scale-uncertainty", share, "U", text, default=0.0)
    text = "flat or bowed target, or an estimated offset of every point (default: auto, flat if it fits)"
    parser.choice("--shape", ("auto", "flat", "bowed", "free"), text)
    text = "OpenCV's five coefficients, or the rational model with k4 k5 k6 (default: auto, five if they suffice)"
    parser.choice("--lens", ("auto", "polynomial", "rational"), text)
    parser.switch("--mono", "one camera: all images belong to it; parameters and covariance, without a page")
    text = (
        "a separately measured length: two points column,row of the target or two images; m, or with units such as mm"
    )
    parser.add_argument("--known-length", nargs=4, metavar=("FROM", "TO", "LENGTH", "U"), help=text)
    parser.add_argument(
        "-o", "--output", required=True, type=path, metavar="CALIBRATION", help="file NAME.json to write"
    )
    parser.switch("--force", "replace an existing calibration")


@command(
    _cameras_options, "left right --target chessboard --size 9x6 --spacing 0.005 --scale-uncertainty 1e-4 -o top.json"
)
def cameras(options: argparse.Namespace) -> None:
    """Calibrate a stereo pair from target images."""
    from fusion.cameras.calibrate import CameraSettings, run_camera, run_cameras
    from photogram.calibration.calibration_result import KnownLength
    from photogram.targets.target_view import Target

    try:
        boards = options.first_id or ()
        first = boards[0] if boards else None
        target = Target(options.target, options.spacing.m, options.size, options.dictionary, options.tag_spacing, first)
        settings = CameraSettings(target, options.shape, options.scale_uncertainty, options.lens, boards=boards)
    except ValueError as error:
        key, _, sentence = str(error).partition(": ")
        option = f"--{key.removesuffix('_m').replace('_', '-')}"
        raise InputError(INVALID_OPTION, "shakercal cameras", option, reason=sentence) from error
    if not options.spacing.unit and not target.is_likely:
        spacing = f"{options.spacing.m:g}"
        found = f"{spacing} m, of a target {target.length_m:.3g} m long"
        expected = f"a unit with the number: {spacing}mm or {spacing}m"
        raise InputError(LENGTH_UNIT_REQUIRED, "shakercal cameras", "--spacing", found=found, expected=expected)
    if options.known_length is not None:
        try:
            start, end, *words = options.known_length
            known = KnownLength.from_words(start, end, *map(in_metres, words))
            settings = replace(settings, known_length=known)
        except ValueError as error:
            raise InputError(INVALID_OPTION, "shakercal cameras", "--known-length", reason=str(error)) from error
    with progress_bar(enabled=not options.quiet) as progress:
        run = run_camera if options.mono else run_cameras
        run(options.images, settings, options.output, options.force, progress)


def _import_calibration_options(parser: Parser) -> None:
    parser.value("calibration", path, "FILE", "the other program's file")
    parser.add_argument("-o", "--output", type=path, required=True, metavar="JSON", help="calibration file to write")
    text = "second file: OpenCV's R and T if separate, right camera of ROS or mrcal, COLMAP's images"
    parser.value("--extrinsics", path, "FILE", text)
    text = (
        "left and right camera of a file with more than two: their names, of COLMAP and Metashape those of two images"
    )
    parser.add_argument("--cameras", nargs=2, metavar=("LEFT", "RIGHT"), help=text)
    parser.value("--image-size", size, "2448x2048", "width x height, if the file has none")
    text = "of the file's lengths, if it does not state it"
    parser.add_argument("--length-unit", choices=("m", "mm", "cm", "um", "in"), help=text)
    text = "model of OpenCV's four coefficients, if the file does not state it: k1 k2 p1 p2, or a fisheye lens"
    parser.add_argument("--distortion-model", choices=("plumb_bob", "fisheye"), help=text)
    text = "k1 k2 k3 of DICe's text belong to r^2, r^4, r^6, as in OpenCV and VIC-3D"
    parser.switch("--even-radial", text)
    parser.switch("--force", "overwrite an existing calibration file")


@command(_import_calibration_options, "calibration.xml -o top.json")
def import_calibration(options: argparse.Namespace) -> None:
    """Import a calibration of OpenCV, DICe, VIC-3D, MatchID, MATLAB, ROS, Kalibr and others."""
    from fusion.cameras.calibrate import convert_calibration

    names = ("image_size", "length_unit", "extrinsics", "even_radial", "distortion_model")
    stated = {name: getattr(options, name) for name in names}
    stated["cameras"] = tuple(options.cameras) if options.cameras else None
    kind = convert_calibration(options.calibration, options.output, options.force, **stated)
    print(f"calibration of {kind} written: {options.output}")


def _export_calibration_options(parser: Parser) -> None:
    parser.value("calibration", path, "CALIBRATION", "file NAME.json of this program")
    text = "file to write: .yml for OpenCV, .xml for VIC-3D, .json for MATLAB"
    parser.add_argument("-o", "--output", type=path, required=True, metavar="FILE", help=text)
    parser.switch("--force", "overwrite an existing file")


@command(_export_calibration_options, "top.json -o top.xml")
def export_calibration(options: argparse.Namespace) -> None:
    """Write a calibration for OpenCV, VIC-3D or MATLAB."""
    from fusion.cameras.calibrate import export_calibration_file

    program = export_calibration_file(options.calibration, options.output, options.force)
    print(f"calibration for {program} written: {options.output}")


def _align_options(parser: Parser) -> None:
    parser.value("alignment", path, "ALIGNMENT.toml", "file that names the evidence")
    parser.add_argument("-o", "--output", type=path, metavar="POSE.toml", help="file for the block of rig.toml")
    parser.switch("--force", "overwrite an existing output")
    parser.allow_outside("ALIGNMENT.toml")
    parser.device("where subsets are tracked")


@command(_align_options, "alignment.toml -o pose.toml")
def align(options: argparse.Namespace) -> None:
    """Determine the pose of a stereo pair in the sensor frame."""
    from fusion.cameras.align import align_file
    from photogram.device import resolve_device

    with progress_bar(enabled=not options.quiet) as progress:
        text = align_file(
            options.alignment,
            options.output,
            Settings(device=resolve_device(options.device)),
            force=options.force,
            allow_outside=options.allow_outside,
            progress=progress,
        )
    print(text, end="")


def _accept_options(parser: Parser) -> None:
    parser.value("acceptance", path, "FOLDER", "folder with acceptance.toml, or that file")
    parser.allow_outside("acceptance.toml")
    parser.results("FOLDER/accept")
    parser.json()


@command(_accept_options, "acceptance")
def accept(options: argparse.Namespace) -> int:
    """Test whether a stereo rig measures correctly: at rest, and moved by known steps."""
    from fusion.cameras.accept.acceptance_report import run_acceptance

    with progress_bar(enabled=not options.quiet and not options.json) as progress:
        failed = run_acceptance(
            options.acceptance,
            options.output,
            force=options.force,
            allow_outside=options.allow_outside,
            progress=progress,
        )
    return EXIT_FAILED if failed else EXIT_DONE


COMMANDS = (cameras, import_calibration, export_calibration, align, accept)
