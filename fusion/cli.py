"""The command `shakercal`. Heavy modules are imported by the sub-command that needs them."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence

from fusion.base import PROGRAM, __version__
from fusion.commands import measure, sensor
from fusion.commands.options import EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED, Parser

log = logging.getLogger("shakercal")


COMMANDS = (*measure.COMMANDS, *sensor.COMMANDS)
"""In the order in which the help lists them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status (0 done, 1 not computable, 2 bad input, 130 interrupted).

    Every failure becomes one sentence on stderr.
    """
    options = _parser().parse_args(arguments)
    _set_up_log(options)
    try:
        return options.act(options) or EXIT_DONE
    except (Exception, KeyboardInterrupt) as error:
        from fusion.base import ComputeError, InputError, is_interruption, told

        if is_interruption(error) or not isinstance(error, Exception):
            log.error("interrupted; nothing half-written was left behind")
            return EXIT_INTERRUPTED
        failure = told(error)
        log.error("%s", " ".join(str(failure).split()))
        if not isinstance(error, InputError | ComputeError):
            log.debug("traceback", exc_info=True)
        return EXIT_INPUT if isinstance(failure, InputError) else EXIT_FAILED


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


def _parser() -> Parser:
    parser = Parser(
        prog="shakercal",
        description="From a shaker recording to the dynamic sensitivity of a multi-component force and moment sensor.",
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    common = Parser(add_help=False)
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="tell more on stderr")
    loudness.add_argument("-q", "--quiet", action="store_true", help="warnings and errors only, no progress bar")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in COMMANDS:
        own = commands.add_parser(command.name, parents=[common], help=command.help)
        command.options(own)
        own.set_defaults(act=command.act)
    return parser


if __name__ == "__main__":
    sys.exit(main())
