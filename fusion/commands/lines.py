"""`shakercal lines`: which lines a file or a recording holds, and why."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.commands.values import EXIT_DONE, Commands, add_allow_outside, figure, not_negative, positive

if TYPE_CHECKING:
    from fusion.manifest import Manifest


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
    from fusion.line_tables import print_lines
    from fusion.lines import lines_csv, lines_of_file, lines_of_recording
    from fusion.output import check_new_file, write_whole

    for path in filter(None, (options.figure, options.csv)):
        check_new_file(path, force=options.force)
    if options.source.is_dir() or options.source.suffix.lower() == ".toml":
        lists = [lines_of_recording(manifest) for manifest in _manifests(options)]
    else:
        lists = lines_of_file(options.source, options.channel, options.sample_rate, options.band)
    if options.csv:
        write_whole(options.csv, lines_csv(lists))
    if options.figure:
        from fusion.plots.lines import draw_lines

        write_whole(options.figure, draw_lines(lists, options.figure.suffix.lower().removeprefix(".")))
    print_lines(lists)
    return EXIT_DONE


def _manifests(options: argparse.Namespace) -> list[Manifest]:
    """Load the recordings of a folder; only one fits a table or figure, and none takes a file's options."""
    from fusion.errors import InputError
    from fusion.manifest import find_recordings, load_manifest

    for name in ("channel", "sample_rate", "band"):
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise InputError(options.source, "", found=option, expected="no such option, recording.toml states it")
    found = find_recordings(options.source)
    if len(found) > 1 and (options.csv or options.figure):
        expected = "one recording for --csv and --figure"
        raise InputError(options.source, "", found=f"{len(found)} recordings", expected=expected)
    return [load_manifest(recording, allow_outside=options.allow_outside) for recording in found]
