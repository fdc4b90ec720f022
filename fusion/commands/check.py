"""`shakercal check`: say what a recording holds."""

from __future__ import annotations

import argparse
import logging

from fusion.commands.values import EXIT_DONE, EXIT_INPUT, Commands, add_recording

log = logging.getLogger("shakercal")


def add_check(commands: Commands, common: argparse.ArgumentParser) -> None:
    """Add the command's parser."""
    parser = commands.add_parser("check", parents=[common], help="say what a recording holds; compute nothing")
    add_recording(parser)
    parser.set_defaults(action=_act_check)


def _act_check(options: argparse.Namespace) -> int:
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
