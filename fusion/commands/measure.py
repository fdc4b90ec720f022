"""The commands from a camera rate to the sensitivity: plan, simulate, check, lines, run, transfer."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.base import DEFAULT_SEED, FEWEST_DRAWS, MOST_DRAWS
from fusion.commands.options import (
    EXIT_DONE,
    EXIT_INPUT,
    Commands,
    add_allow_outside,
    add_recording,
    add_results,
    count,
    device,
    draws,
    figure,
    not_negative,
    positive,
    radius,
    seed,
)

if TYPE_CHECKING:
    from fusion.recording.load import Manifest


# `shakercal plan`: which camera rates suit the frequencies of a calibration.


DECIMALS = 6  # of frequencies within a range, in Hz


def add_plan(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "plan", parents=[common], help="find camera rates at which excitation and harmonics fold to separate places"
    )
    parser.add_argument(
        "--frequencies",
        type=frequencies,
        required=True,
        metavar="LIST",
        help="excitations in Hz: numbers and ranges FIRST:LAST:COUNT (equal steps) or FIRST:LAST:COUNT:log (equal "
        "ratios), with commas between them",
    )
    parser.add_argument("--frames", type=count, required=True, help="frames per point")
    rate = parser.add_mutually_exclusive_group(required=True)
    rate.add_argument("--max-rate", type=positive, metavar="HZ", help="fastest camera rate to look for")
    rate.add_argument("--rate", type=positive, metavar="HZ", help="explain what this camera rate does instead")
    parser.add_argument(
        "--min-rate", type=positive, metavar="HZ", help="slowest camera rate (default: half the fastest)"
    )
    parser.add_argument(
        "--rate-step", type=positive, default=1e-3, metavar="HZ", help="steps of rates (default: 0.001)"
    )
    parser.add_argument("--exposure", type=not_negative, default=0.0, metavar="S", help="exposure time (default: 0)")
    parser.add_argument("--harmonics", type=count, default=5, metavar="N", help="fitted, 1: fundamental (default: 5)")
    parser.add_argument("--together", action="store_true", help="all excitations at the same time")
    parser.add_argument(
        "--corner", type=not_negative, default=5.0, metavar="HZ", help="1/f noise is white noise there (default: 5)"
    )
    parser.add_argument(
        "--tolerance",
        type=not_negative,
        default=1e-4,
        metavar="SHARE",
        help="relative accuracy of excitation and camera rate (default: 0.0001)",
    )
    parser.add_argument("--noise", type=positive, metavar="M", help="noise of the displacement per frame")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--amplitude", type=positive, metavar="M", help="displacement amplitude of the excitation")
    size.add_argument("--acceleration", type=positive, metavar="M/S2", help="its acceleration amplitude instead")
    parser.add_argument(
        "--settle", type=not_negative, default=0.0, metavar="S", help="time before each point (default: 0)"
    )
    parser.add_argument(
        "--figure", type=figure, metavar="FILE", help="draw condition over camera rate (.png, .svg, .pdf)"
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the plan as a table")
    parser.add_argument("--force", action="store_true", help="overwrite files that are there")
    parser.set_defaults(action=_act_plan)


def frequencies(text: str) -> tuple[float, ...]:
    """Return the frequencies of a text such as 53.7,106.25 or 53.7:1020.3:12, in the order given."""
    found = [value for item in text.split(",") for value in _item(item.strip())]
    repeated = next((value for i, value in enumerate(found) if value in found[:i]), None)
    if repeated is not None:
        raise argparse.ArgumentTypeError(f"expected every frequency once, found {repeated:g} Hz twice")
    return tuple(found)


def _item(text: str) -> list[float]:
    """Return the frequencies of one number or range."""
    wrong = argparse.ArgumentTypeError(
        f"expected frequencies such as 106.25 or 53.7:1020.3:12, found {text or 'nothing'}"
    )
    parts = text.split(":")
    logarithmic = len(parts) == 4 and parts[3] == "log"
    if len(parts) not in (1, 3) and not logarithmic:
        raise wrong
    try:
        first, last = positive(parts[0]), positive(parts[1] if len(parts) > 1 else parts[0])
        number = int(parts[2]) if len(parts) > 1 else 1
    except ValueError:
        raise wrong from None
    if number < 1 or (number == 1) != (first == last):
        raise argparse.ArgumentTypeError(f"expected a count of at least 2 between two frequencies, found {text}")
    shares = [i / max(number - 1, 1) for i in range(number)]
    if logarithmic:
        return [round(first * (last / first) ** share, DECIMALS) for share in shares]
    return [round(first + (last - first) * share, DECIMALS) for share in shares]


def _act_plan(options: argparse.Namespace) -> int:
    from fusion.base import check_new_file, write_whole
    from fusion.planning.plan import Request, Size, make_plan, plan_csv
    from fusion.planning.plan_report import print_plan
    from shaker.lines.rate_planner import Sampling

    for path in filter(None, (options.figure, options.csv)):
        check_new_file(path, force=options.force)
    request = Request(
        frequency_hz=options.frequencies,
        sampling=Sampling(options.frames, options.exposure, options.harmonics, options.corner, options.tolerance),
        together=options.together,
        rate_hz=options.rate,
        limits_hz=_limits(options),
        rate_step_hz=options.rate_step,
        settle_s=options.settle,
        size=Size(options.noise, options.amplitude, options.acceleration),
    )
    plan = make_plan(request)
    if options.csv:
        write_whole(options.csv, plan_csv(plan))
    if options.figure:
        from fusion.planning.figures import draw_plan

        write_whole(options.figure, draw_plan(plan, options.figure.suffix.lower().removeprefix(".")))
    print_plan(plan)
    return EXIT_DONE


def _limits(options: argparse.Namespace) -> tuple[float, float]:
    """Return the range of rates to look at; a fifth either way where one is explained."""
    if options.rate is None:
        return options.min_rate or options.max_rate / 2.0, options.max_rate
    if options.min_rate is not None:
        from fusion.base import InputError

        raise InputError("--min-rate", "", found="--rate", expected="--max-rate beside it")
    return 0.8 * options.rate, 1.2 * options.rate


# `shakercal simulate`: recordings with known truth.


def add_simulate(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    from fusion.simulate import PRESETS

    parser = commands.add_parser("simulate", parents=[common], help="write a simulated recording with its truth")
    parser.add_argument("out", type=Path, metavar="OUT", help="campaign folder to create")
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        default="demo",
        help="which rig (default: demo); sweep, matrix: campaigns for a curve over frequency and for the 6x6; "
        "targets: a camera calibration; chirp: a recording for shakercal transfer; masses, pitching: campaigns of two "
        "loads for shakercal identify; rotation: a campaign for shakercal rotate; steps: one for shakercal step; "
        "loads: one for shakercal load; elastomer: a geometry for shakercal elastomer",
    )
    parser.add_argument("--seed", type=seed, default=1, help="seed of every random draw (default: 1)")
    parser.add_argument("--force", action="store_true", help="overwrite a simulation that is there")
    parser.set_defaults(action=_act_simulate)


def _act_simulate(options: argparse.Namespace) -> int:
    from fusion.base import InputError, progress_bar
    from fusion.simulate import simulate

    if options.out.exists() and not options.force:
        expected = "a new folder (--force replaces an earlier simulation)"
        raise InputError(options.out, "", found="a file or folder of this name", expected=expected)
    with progress_bar(enabled=not options.quiet) as progress:
        written = simulate(options.out, options.preset, options.seed, progress)
    count = len(list(options.out.glob("*/recording.toml")))
    kind = "recording" if count == 1 else "campaign" if count else "element" if written.is_file() else "pictures"
    print(f"simulated {kind}: {written}" + (f", {count} recordings" if kind == "campaign" else ""))
    return EXIT_DONE


# `shakercal check`: say what a recording holds.


log = logging.getLogger("shakercal")


def add_check(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("check", parents=[common], help="say what a recording holds; compute nothing")
    add_recording(parser)
    parser.set_defaults(action=_act_check)


def _act_check(options: argparse.Namespace) -> int:
    from fusion.base import InputError
    from fusion.recording.check import check
    from fusion.recording.load import find_recordings, load_manifest

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


# `shakercal lines`: which lines a file or a recording holds, and why.


def add_lines(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("lines", parents=[common], help="list every line of a file or recording, and why")
    parser.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="DAQ file, a recording (its folder or recording.toml), or a campaign of several",
    )
    parser.add_argument(
        "--channel", action="append", metavar="NAME", help="channel of the file, may be repeated (default: all)"
    )
    parser.add_argument("--sample-rate", type=positive, metavar="HZ", help="of a file that states none")
    parser.add_argument("--band", type=band, metavar="LOW:HIGH", help="list lines of the file between these, in Hz")
    parser.add_argument("--figure", type=figure, metavar="FILE", help="draw spectrum and floor (.png, .svg, .pdf)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the list as a table")
    parser.add_argument("--force", action="store_true", help="overwrite files that are there")
    add_allow_outside(parser)
    parser.set_defaults(action=_act_lines)


def band(text: str) -> tuple[float, float]:
    """Return the two frequencies of a text such as 10:2000."""
    low, colon, high = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"expected two frequencies such as 10:2000, found {text}")
    found = not_negative(low), positive(high)
    if found[0] >= found[1]:
        raise argparse.ArgumentTypeError(f"expected the lower frequency first, found {text}")
    return found


def _act_lines(options: argparse.Namespace) -> int:
    from fusion.base import check_new_file, write_whole
    from fusion.planning.lines import lines_csv, lines_of_file, lines_of_recording, print_lines

    for path in filter(None, (options.figure, options.csv)):
        check_new_file(path, force=options.force)
    if options.source.is_dir() or options.source.suffix.lower() == ".toml":
        lists = [lines_of_recording(manifest) for manifest in _manifests(options)]
    else:
        lists = lines_of_file(options.source, options.channel, options.sample_rate, options.band)
    if options.csv:
        write_whole(options.csv, lines_csv(lists))
    if options.figure:
        from fusion.planning.figures import draw_lines

        write_whole(options.figure, draw_lines(lists, options.figure.suffix.lower().removeprefix(".")))
    print_lines(lists)
    return EXIT_DONE


def _manifests(options: argparse.Namespace) -> list[Manifest]:
    """Load the recordings of a folder; only one fits a table or figure, and none takes a file's options."""
    from fusion.base import InputError
    from fusion.recording.load import find_recordings, load_manifest

    for name in ("channel", "sample_rate", "band"):
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise InputError(options.source, "", found=option, expected="no such option, recording.toml states it")
    found = find_recordings(options.source)
    if len(found) > 1 and (options.csv or options.figure):
        expected = "one recording for --csv and --figure"
        raise InputError(options.source, "", found=f"{len(found)} recordings", expected=expected)
    return [load_manifest(recording, allow_outside=options.allow_outside) for recording in found]


# `shakercal run`: evaluate recordings.


def add_run(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("run", parents=[common], help="evaluate one recording or a campaign of several")
    add_recording(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="RESULTS", help="folder of the results (default: RECORDING/results)"
    )
    parser.add_argument("--force", action="store_true", help="compute again and overwrite result files that are there")
    parser.add_argument(
        "--subset-radius",
        type=radius,
        metavar="PX",
        help="half-width of the subsets (default: from the speckle size in the images, 10 px for speckle of 4 to 5 px)",
    )
    parser.add_argument(
        "--device",
        type=device,
        default="auto",
        metavar="{auto,cpu,cuda}",
        help="where subsets are tracked (default: auto, a GPU where torch finds one)",
    )
    parser.add_argument(
        "--monte-carlo",
        type=draws,
        default=0,
        metavar="N",
        help="check the uncertainties with N draws of everything uncertain "
        f"({FEWEST_DRAWS} to {MOST_DRAWS}; 100000 are good for two digits of U; default: none)",
    )
    parser.add_argument(
        "--seed", type=seed, default=DEFAULT_SEED, metavar="S", help=f"of these draws (default: {DEFAULT_SEED})"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=count,
        default=1,
        metavar="N",
        help="processes that share the work on this machine (default: 1); results are the same to the last digit",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="have the work done by the Dask cluster whose scheduler is at ADDRESS, such as tcp://10.0.0.1:8786: its "
        'workers see the same files by the same paths (needs pip install "shakercal[cluster]")',
    )
    parser.set_defaults(action=_act_run)


def _act_run(options: argparse.Namespace) -> int:
    from fusion.base import Settings, progress_bar
    from fusion.campaign.run import exit_status, is_campaign, print_campaign, print_outcomes, run_path

    settings = Settings(
        subset_radius_px=options.subset_radius,
        device=options.device,
        monte_carlo=options.monte_carlo,
        seed=options.seed,
    )
    with progress_bar(enabled=not options.quiet) as progress:
        outcomes = run_path(
            options.recording,
            options.output,
            settings,
            force=options.force,
            allow_outside=options.allow_outside,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=progress,
        )
    (print_campaign if is_campaign(options.recording) else print_outcomes)(outcomes)
    return exit_status(outcomes)


# `shakercal transfer`: transfer functions of chirps, multisines, noise and blows.


def add_transfer(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser(
        "transfer", parents=[common], help="transfer functions and resonances from a chirp, multisine, noise or blows"
    )
    add_recording(parser)
    parser.add_argument(
        "--estimator",
        choices=("auto", "periodic", "local", "H1", "H2", "Hv"),
        default="auto",
        help="default: auto, the ratio of means over periods where a period is stated, of noise local polynomials, of "
        "blows what the coherence advises",
    )
    parser.add_argument(
        "--resolution",
        type=positive,
        metavar="HZ",
        help="line spacing where no period is stated (default: 16 segments side by side; of blows: 1 Hz)",
    )
    parser.add_argument(
        "--quantity",
        choices=("displacement", "velocity", "acceleration"),
        help="turn every motion into this quantity (default: as it was measured)",
    )
    add_results(parser, "RECORDING/transfer")
    parser.set_defaults(action=_act_transfer)


def _act_transfer(options: argparse.Namespace) -> int:
    from fusion.sensor.transfer.records import TransferSettings
    from fusion.sensor.transfer.report import run_transfer

    settings = TransferSettings(options.estimator, options.resolution, options.quantity)
    run_transfer(options.recording, options.output, settings, force=options.force, allow_outside=options.allow_outside)
    return EXIT_DONE
