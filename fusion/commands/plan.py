"""The command `shakercal plan`, and outputs of commands with a figure and a table."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.base import check_new_file
from fusion.commands.options import (
    Parser,
    band,
    command,
    elements,
    exponent,
    frequencies,
    hertz,
    not_negative,
    path,
    positive,
    three_minutes,
    whole,
)
from fusion.errors import CONFLICTING_OPTIONS, InputError

if TYPE_CHECKING:
    from shaker.lines.rate_planner import Sampling

MOST_FRAMES = 1_000_000
MOST_LINES = 200  # of a multisine
OF_NEXT = ("elements", "hours", "minutes")
OF_FREQUENCIES = ("together", "amplitude", "acceleration", "figure", "min_rate")
OF_LINES = ("band", "linear", "peak", "slope")
"""Options that need --next, --frequencies, and --lines."""
OF_CAMERA = ("frames", "max_rate", "rate", "noise", "setup", *OF_LINES, *(n for n in OF_FREQUENCIES if n != "figure"))
"""Options that --next does not use."""


def _plan_options(parser: Parser) -> None:
    text = (
        "excitations in Hz: numbers and ranges FIRST:LAST:COUNT (equal steps) or FIRST:LAST:COUNT:log (equal "
        "ratios), separated by commas"
    )
    excited = parser.add_mutually_exclusive_group()
    excited.add_argument("--frequencies", type=frequencies, metavar="LIST", help=text)
    text = "choose this number of frequencies, for one recording of all of them (a multisine)"
    excited.add_argument("--lines", type=whole(2, MOST_LINES), metavar="N", help=text)
    text = "propose the recordings that lower U of matrix elements most (docs/next-recordings.md)"
    excited.add_argument("--next", type=path, metavar="RESULTS", help=text)
    parser.value("--elements", elements, "LIST", "of --next, as Fz/Fz,My/Fx (output/load; default: the main ones)")
    parser.value("--hours", positive, "H", "available for --next (default: 4)")
    text = "minutes of a new mounting, of more points, of an exchange, for --next (default: 20,15,30)"
    parser.value("--minutes", three_minutes, "M,P,E", text)
    parser.value("--band", band, "LOW:HIGH", "of the frequencies of --lines, Hz, in equal ratios")
    parser.switch("--linear", "frequencies of --lines in equal steps instead")
    parser.value("--peak", positive, "M/S2", "peak acceleration of the multisine (default: 1)")
    text = "exponent p of accelerations of the lines in proportion to f^p (default: 0, equal ones)"
    parser.value("--slope", exponent, "P", text)
    parser.add_argument("--frames", type=whole(4, MOST_FRAMES), help="frames per point")
    rate = parser.add_mutually_exclusive_group()
    rate.add_argument("--max-rate", type=hertz, metavar="HZ", help="highest camera rate to consider")
    rate.add_argument("--rate", type=hertz, metavar="HZ", help="explain the effect of this camera rate instead")
    parser.value("--min-rate", hertz, "HZ", "lowest camera rate (default: half the highest)")
    parser.value("--rate-step", hertz, "HZ", "steps of rates (default: 0.001)", default=1e-3)
    parser.value("--exposure", not_negative, "S", "exposure time (default: 0)", default=0.0)
    parser.value("--harmonics", whole(1, 100), "N", "fitted, 1: fundamental (default: 5)", default=5)
    parser.switch("--together", "all excitations at the same time")
    parser.value("--corner", not_negative, "HZ", "1/f noise equals white noise there (default: 5)", default=5.0)
    text = "relative accuracy of excitation and camera rate (default: 0.0001)"
    parser.value("--tolerance", not_negative, "SHARE", text, default=1e-4)
    parser.value("--noise", positive, "M", "noise of the displacement per frame")
    level = parser.add_mutually_exclusive_group()
    level.add_argument("--amplitude", type=positive, metavar="M", help="displacement amplitude of the excitation")
    level.add_argument("--acceleration", type=positive, metavar="M/S2", help="acceleration amplitude of the excitation")
    parser.value("--settle", not_negative, "S", "time before each point (default: 0)", default=0.0)
    text = "field of view, depth of field, noise and U of a pair or one camera from its data sheet (docs/practice.md)"
    parser.value("--setup", path, "SETUP.toml", text)
    parser.set_defaults(usage_error=parser.error)
    parser.figure_and_table("draw condition over camera rate", "write the plan as a table")


@command(_plan_options, "--frequencies 53.7:1020.3:12 --frames 844 --max-rate 60 --exposure 100e-6")
def plan(options: argparse.Namespace) -> None:
    """Find camera rates with separate aliases of excitation and harmonics."""
    from fusion.planning.plan import MotionSize, Request, make_plan, plan_csv, print_plan
    from shaker.lines.rate_planner import Sampling

    if options.next is not None:
        _plan_next(options)
        return
    _refuse(options, OF_NEXT, "no --next", "--next with it")
    if options.setup is not None:
        from fusion.planning.camera_setup import print_setup, read_setup

        print_setup(read_setup(options.setup))
        if options.frequencies is None:
            return
    required = ("frequencies", "frames") if options.lines is None else ("band", "frames")
    missing = [f"--{name}" for name in required if getattr(options, name) is None]
    if missing:
        options.usage_error(f"the following arguments are required: {', '.join(missing)}")
    if options.rate is None and options.max_rate is None:
        options.usage_error("one of the arguments --max-rate --rate is required")
    for file in filter(None, (options.figure, options.csv)):
        check_new_file(file, force=options.force)
    if options.rate is not None and options.min_rate is not None:
        raise InputError(CONFLICTING_OPTIONS, "--min-rate", found="--rate", expected="--max-rate with it")
    found, expected = ("--frequencies", "--lines") if options.lines is None else ("--lines", "--frequencies")
    _refuse(options, OF_LINES if options.lines is None else OF_FREQUENCIES, found, f"{expected} with it")
    sampling = Sampling(options.frames, options.exposure, options.harmonics, options.corner, options.tolerance)
    if options.lines is not None:
        _plan_multisine(options, sampling)
        return
    limits_hz = options.min_rate or (options.max_rate or 0.0) / 2.0, options.max_rate
    request = Request(
        frequency_hz=options.frequencies,
        sampling=sampling,
        together=options.together,
        rate_hz=options.rate,
        # 20 % to either side of an explained rate
        limits_hz=limits_hz if options.rate is None else (0.8 * options.rate, 1.2 * options.rate),
        rate_step_hz=options.rate_step,
        settle_s=options.settle,
        size=MotionSize(options.noise, options.amplitude, options.acceleration),
    )
    made = make_plan(request)
    if options.figure:
        from fusion.planning.plan_figures import draw_plan

        write_figure(options.figure, partial(draw_plan, made))
    show_table(options, "plan", plan_csv(made), partial(print_plan, made))


def _refuse(options: argparse.Namespace, names: Sequence[str], found: str, expected: str) -> None:
    """Refuse options that the chosen plan would ignore."""
    for name in names:
        if getattr(options, name):
            raise InputError(CONFLICTING_OPTIONS, f"--{name.replace('_', '-')}", found=found, expected=expected)


def _plan_next(options: argparse.Namespace) -> None:
    """Propose the next recordings of a campaign."""
    from fusion.planning.next_recordings import Minutes
    from fusion.planning.next_report import draw_next, next_csv, plan_next, print_next

    _refuse(options, OF_CAMERA, "--next", "--frequencies or --lines with it")
    for file in filter(None, (options.figure, options.csv)):
        check_new_file(file, force=options.force)
    made = plan_next(options.next, options.elements, options.hours or 4.0, Minutes(*(options.minutes or ())))
    if options.figure:
        write_figure(options.figure, partial(draw_next, made))
    show_table(options, "plan", next_csv(made), partial(print_next, made))


def _plan_multisine(options: argparse.Namespace, sampling: Sampling) -> None:
    """Choose the lines of one recording."""
    from fusion.planning.multisine_plan import (
        MultisineRequest,
        make_multisine,
        multisine_csv,
        print_multisine,
        rates_below,
    )

    if not options.band[0] > 0.0:
        raise InputError(CONFLICTING_OPTIONS, "--band", found=f"{options.band[0]:g} Hz", expected="frequencies above 0")
    rates_hz = (options.rate,) if options.rate else rates_below(options.max_rate, options.rate_step)
    shape = options.linear, options.slope or 0.0, options.peak or 1.0
    made = make_multisine(
        MultisineRequest(options.lines, options.band, sampling, rates_hz, *shape, options.settle, options.noise)
    )
    show_table(options, "plan", multisine_csv(made), partial(print_multisine, made))


def write_figure(file: Path, draw: Callable[[str], bytes]) -> None:
    """Write a figure in the format of its file."""
    from fusion.report.atomic_files import write_atomically

    write_atomically(file, draw(file.suffix.lower().removeprefix(".")))


def show_table(options: argparse.Namespace, name: str, text: str, print_text: Callable[[], None]) -> None:
    """Write a table if requested; print its rows as JSON, or a text."""
    from fusion.report.atomic_files import write_atomically

    if options.csv:
        write_atomically(options.csv, text)
    if options.json:
        from fusion.report.folder import command_json
        from fusion.report.table import csv_rows

        print(command_json(name, rows=csv_rows(text)))
    else:
        print_text()
