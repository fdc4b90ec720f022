"""The command `shakercal`. Heavy modules are imported by the sub-command that needs them."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence

from fusion.commands.cameras import add_align, add_cameras, add_import_calibration
from fusion.commands.measure import add_check, add_lines, add_plan, add_run, add_simulate, add_transfer
from fusion.commands.options import EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED
from fusion.commands.sensor import (
    add_compensate,
    add_decouple,
    add_elastomer,
    add_identify,
    add_load,
    add_rotate,
    add_step,
)

log = logging.getLogger("shakercal")
COMMANDS = (
    add_run,
    add_check,
    add_cameras,
    add_import_calibration,
    add_align,
    add_simulate,
    add_plan,
    add_lines,
    add_transfer,
    add_rotate,
    add_identify,
    add_step,
    add_load,
    add_compensate,
    add_decouple,
    add_elastomer,
)
"""In the order in which the help lists them."""


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
    from fusion.base import ComputeError, InputError, is_interruption, told

    if is_interruption(error) or not isinstance(error, Exception):
        return EXIT_INTERRUPTED, "interrupted; nothing half-written was left behind", True
    if isinstance(error, InputError):
        return EXIT_INPUT, str(error), True
    return EXIT_FAILED, str(told(error)), isinstance(error, ComputeError)


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
    for add in COMMANDS:
        add(commands, common)
    return parser


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
