"""The command `shakercal`. Heavy modules are imported by the sub-command that needs them."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130

log = logging.getLogger("shakercal")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status (0 done, 1 not computable, 2 bad input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    _set_up_log(options)
    return _guarded(options)


class _ToStderr(logging.Handler):
    """Writes to what stderr is at the moment: a progress bar redirects it while it is drawn."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


def _set_up_log(options: argparse.Namespace) -> None:
    """Send the program's own messages to stderr; those of libraries, warnings included, only with -v."""
    handler = _ToStderr()
    handler.setFormatter(logging.Formatter("shakercal: %(message)s"))
    log.handlers, log.propagate = [handler], False
    log.setLevel(logging.WARNING if options.quiet else logging.DEBUG if options.verbose else logging.INFO)
    logging.getLogger().handlers = [handler if options.verbose else logging.NullHandler()]
    logging.captureWarnings(True)


def _guarded(options: argparse.Namespace) -> int:
    """Run the chosen sub-command; every failure becomes one sentence on stderr and an exit status."""
    try:
        return int(options.action(options))
    except (Exception, KeyboardInterrupt) as error:
        status, sentence, expected = _verdict(error)
        log.error("%s", " ".join(sentence.split()))
        if not expected:
            log.debug("traceback", exc_info=True)
        return status


def _verdict(error: BaseException) -> tuple[int, str, bool]:
    """Exit status and sentence for a failure, and whether it is one that the program expects."""
    from fusion.errors import ComputeError, InputError

    if isinstance(error, InputError):
        return EXIT_INPUT, str(error), True
    if isinstance(error, ComputeError):
        return EXIT_FAILED, str(error), True
    cause = error.__cause__ or error.__context__  # compiled code wraps an interruption into an error of its own
    if isinstance(error, KeyboardInterrupt) or isinstance(cause, KeyboardInterrupt):
        return EXIT_INTERRUPTED, "interrupted; nothing half-written was left behind", True
    if isinstance(error, OSError):
        return EXIT_FAILED, f"the system refused to read or write ({error})", False
    return EXIT_FAILED, f"internal error ({type(error).__name__}: {error}); please report it, -v shows where", False


def _run(options: argparse.Namespace) -> int:
    from fusion.campaign import exit_status, run_path
    from fusion.progress import progress_bar
    from fusion.settings import Settings
    from fusion.summary import print_outcomes

    settings = Settings(subset_radius_px=options.subset_radius, device=options.device)
    with progress_bar(enabled=not options.quiet) as progress:
        outcomes = run_path(
            options.recording,
            options.output,
            settings,
            force=options.force,
            allow_outside=options.allow_outside,
            progress=progress,
        )
    print_outcomes(outcomes)
    return exit_status(outcomes)


def _check(options: argparse.Namespace) -> int:
    from fusion.check import check
    from fusion.errors import InputError
    from fusion.manifest import find_recordings, load_manifest

    status = EXIT_DONE
    for recording in find_recordings(options.recording):
        try:
            report = check(load_manifest(recording, allow_outside=options.allow_outside))
        except InputError as error:
            log.error("%s", error)
            status = EXIT_INPUT
            continue
        print(report)
        status = EXIT_INPUT if report.problems else status
    return status


def _simulate(options: argparse.Namespace) -> int:
    from fusion.errors import InputError
    from fusion.progress import progress_bar
    from fusion.simulate import simulate, simulate_targets

    if options.out.exists() and not options.force:
        expected = "a new folder (--force replaces an earlier simulation)"
        raise InputError(options.out, "", found="a file or folder of this name", expected=expected)
    with progress_bar(enabled=not options.quiet) as progress:
        if options.preset == "targets":
            print(f"simulated pictures of a target: {simulate_targets(options.out, options.seed, progress)}")
            return EXIT_DONE
        folder = simulate(options.out, options.preset, options.seed, progress)
    print(f"simulated recording: {folder}")
    return EXIT_DONE


def _cameras(options: argparse.Namespace) -> int:
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


def _align(options: argparse.Namespace) -> int:
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


def _import_calibration(options: argparse.Namespace) -> int:
    from fusion.import_calibration import convert_calibration

    source = options.calibration, options.extrinsics
    found = convert_calibration(source, options.output, options.image_size, options.length_unit, options.force)
    print(f"calibration of {found} written: {options.output}")
    return EXIT_DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="shakercal",
        description="From a shaker recording to the dynamic sensitivity of a multi-component force and moment sensor.",
    )
    parser.add_argument("--version", action=_Version)
    common = argparse.ArgumentParser(add_help=False)
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="tell more on stderr")
    loudness.add_argument("-q", "--quiet", action="store_true", help="warnings and errors only, no progress bar")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    run = commands.add_parser("run", parents=[common], help="evaluate one recording or a campaign of several")
    _add_recording(run)
    run.add_argument("-o", "--output", type=Path, metavar="RESULTS", help="result folder (default: RECORDING/results)")
    run.add_argument("--force", action="store_true", help="compute again and overwrite result files that are there")
    run.add_argument(
        "--subset-radius",
        type=_radius,
        metavar="PX",
        help="half-width of the subsets (default: from the speckle size in the images, 10 px for speckle of 4 to 5 px)",
    )
    run.add_argument(
        "--device",
        type=_device,
        default="auto",
        metavar="{auto,cpu,cuda}",
        help="where subsets are tracked (default: auto, a GPU where torch finds one)",
    )
    run.set_defaults(action=_run)

    check = commands.add_parser("check", parents=[common], help="say what a recording holds; compute nothing")
    _add_recording(check)
    check.set_defaults(action=_check)

    _add_cameras(commands.add_parser("cameras", parents=[common], help="calibrate a stereo pair from target pictures"))

    imports = "take over a calibration of OpenCV, DICe, VIC-3D, MATLAB or Bouguet's toolbox"
    _add_import(commands.add_parser("import-calibration", parents=[common], help=imports))

    aligns = "find where a stereo pair's camera stands in the sensor frame"
    _add_align(commands.add_parser("align", parents=[common], help=aligns))

    simulate = commands.add_parser("simulate", parents=[common], help="write a simulated recording with its truth")
    simulate.add_argument("out", type=Path, metavar="OUT", help="campaign folder to create")
    simulate.add_argument(
        "--preset",
        choices=("demo", "nitsche2018", "targets"),
        default="demo",
        help="which rig (default: demo); targets: a camera calibration",
    )
    simulate.add_argument("--seed", type=_seed, default=1, help="seed of every random draw (default: 1)")
    simulate.add_argument("--force", action="store_true", help="overwrite a simulation that is there")
    simulate.set_defaults(action=_simulate)
    return parser


def _add_recording(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder of a recording or of a campaign")
    parser.add_argument("--allow-outside", action="store_true", help="accept files outside the folder of rig.toml")


def _add_import(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", type=Path, metavar="FILE", help="the other program's file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="JSON", help="calibration file to write")
    parser.add_argument("--extrinsics", type=Path, metavar="FILE", help="second file, where OpenCV's R and T are apart")
    parser.add_argument("--image-size", type=_size, metavar="2448x2048", help="width x height, if the file has none")
    parser.add_argument("--length-unit", choices=("m", "mm"), help="of the file's lengths, where it does not say it")
    parser.add_argument("--force", action="store_true", help="overwrite a calibration file that is there")
    parser.set_defaults(action=_import_calibration)


def _add_align(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("alignment", type=Path, metavar="ALIGNMENT.toml", help="file that names the evidence")
    parser.add_argument("-o", "--output", type=Path, metavar="POSE.toml", help="file for the block of rig.toml")
    parser.add_argument("--force", action="store_true", help="overwrite the output that is there")
    parser.add_argument(
        "--allow-outside", action="store_true", help="accept files outside the folder of ALIGNMENT.toml"
    )
    parser.add_argument(
        "--device", type=_device, default="auto", metavar="{auto,cpu,cuda}", help="where subsets are tracked"
    )
    parser.set_defaults(action=_align)


def _add_cameras(parser: argparse.ArgumentParser) -> None:
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
        type=_positive,
        metavar="M",
        help="side of a square, or centre to centre of dots, in m",
    )
    parser.add_argument(
        "--size",
        type=_size,
        metavar="9x6",
        help="inner corners (chessboard), squares (charuco) or dots: columns x rows",
    )
    parser.add_argument("--dictionary", metavar="NAME", help="ArUco dictionary such as DICT_4X4_50 (default: found)")
    parser.add_argument(
        "--scale-uncertainty",
        type=_not_negative,
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
    parser.set_defaults(action=_cameras)


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text}")
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number of at least 0, found {text}")
    return value


def _size(text: str) -> tuple[int, int]:
    columns, cross, rows = text.lower().partition("x")
    if not (cross and columns.isdigit() and rows.isdigit()):
        raise argparse.ArgumentTypeError(f"expected columns x rows such as 9x6, found {text}")
    return int(columns), int(rows)


def _radius(text: str) -> int:
    value = int(text)
    if not 4 <= value <= 100:
        raise argparse.ArgumentTypeError(f"expected 4 to 100 pixels, found {value}")
    return value


def _device(choice: str) -> str:
    from photogram.device import resolve_device

    try:
        return resolve_device(choice)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("device: ")) from error


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, found {value}")
    return value


class _Version(argparse.Action):
    """Print the installed version, looked up only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"shakercal {version('shakercal')}")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
