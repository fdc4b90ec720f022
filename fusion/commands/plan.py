"""`shakercal plan`: which camera rates suit the frequencies of a calibration."""

from __future__ import annotations

import argparse
from pathlib import Path

from fusion.commands.values import EXIT_DONE, Commands, count, figure, not_negative, positive

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
    from fusion.output import check_new_file, write_whole
    from fusion.plan import Request, Size, make_plan, plan_csv
    from fusion.plan_tables import print_plan
    from shaker.signals.plan.point import Sampling

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
        from fusion.plots.plan import draw_plan

        write_whole(options.figure, draw_plan(plan, options.figure.suffix.lower().removeprefix(".")))
    print_plan(plan)
    return EXIT_DONE


def _limits(options: argparse.Namespace) -> tuple[float, float]:
    """Return the range of rates to look at; a fifth either way where one is explained."""
    if options.rate is None:
        return options.min_rate or options.max_rate / 2.0, options.max_rate
    if options.min_rate is not None:
        from fusion.errors import InputError

        raise InputError("--min-rate", "", found="--rate", expected="--max-rate beside it")
    return 0.8 * options.rate, 1.2 * options.rate
