"""The command `shakercal`; its sub-commands import heavy modules."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator, Sequence

    from fusion.commands.options import CliCommand, Parser

ENDING = ("SIGINT", "SIGTERM", "SIGHUP")
MIN_ADDRESSES = 1_000_000_000
"""Bytes: a run without images uses 870 MB of addresses before it reads data."""
GARBAGE_THRESHOLD = 20_000
"""New objects between searches for cycles; with Python's default of 700 they take a tenth of the start."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    0 done, 1 not computable, 2 wrong input, 130 interrupted (128 + number of the signal), 141 closed output. Every
    failure becomes one sentence on stderr.
    """
    gc.set_threshold(GARBAGE_THRESHOLD, 50, 100)
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)  # no search for cycles at the end, which takes a third of a second
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: more threads wait for each other
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # its warnings would precede those of the program
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would search all packages for them
    with _ended_by_signals(), _terminals():
        given = sys.argv[1:] if arguments is None else arguments
        parser = _parser(given[:1])
        if "_ARGCOMPLETE" in os.environ:  # completion by the shell
            import argcomplete

            argcomplete.autocomplete(parser)
        if not given:
            parser.print_help(sys.stderr)
            return 2
        options = parser.parse_args(given)
        _set_up_log(options)
        return _act(options)


def commands() -> tuple[CliCommand, ...]:
    """Return the sub-commands in the order in which the help lists them."""
    from fusion.commands import cameras, measure, sensor

    return (*measure.COMMANDS, *cameras.COMMANDS, *sensor.COMMANDS, measure.explain)


def _act(options: argparse.Namespace) -> int:
    """Run a sub-command, report its failure, and return the exit status."""
    import logging

    from fusion.commands.options import EXIT_CLOSED, EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED
    from fusion.errors import ComputeError, InputError, as_user_error, is_interruption
    from fusion.report.terminal import AS_JSON

    log = logging.getLogger("shakercal")
    AS_JSON.set(getattr(options, "json", False))
    try:
        _check_memory()
        if hasattr(options, "pdf"):
            from fusion.report.summary_pdf import request_pdf

            request_pdf(options.pdf, force=options.force)
        status: int = options.act(options) or EXIT_DONE
        sys.stdout.flush()
        if "shakercal._common.kernels" in sys.modules:
            from shakercal._common.kernels import cache_failure_reason

            if reason := cache_failure_reason(other_processes=getattr(options, "workers", 1) != 1):
                log.info("compiled functions are not cached (%s): every run compiles them again", reason)
        return status
    except (Exception, KeyboardInterrupt) as error:
        if is_interruption(error) or not isinstance(error, Exception):
            log.error("interrupted; nothing half-written was left behind")
            return EXIT_INTERRUPTED
        unwritten = _unwritten()
        if isinstance(error, BrokenPipeError) or isinstance(unwritten, BrokenPipeError):
            return EXIT_CLOSED
        if unwritten is not None:
            log.error("the output could not be written: %s", unwritten.strerror)
            return EXIT_FAILED
        failure = as_user_error(error)
        log.error("%s", " ".join(f"{failure} (shakercal explain {failure.code})".split()))
        if not isinstance(error, InputError | ComputeError):
            log.debug("traceback", exc_info=True)
        return EXIT_INPUT if isinstance(failure, InputError) else EXIT_FAILED


def _check_memory() -> None:
    """Refuse a small limit of the address space, with which libraries exit or hang."""
    if sys.platform != "win32":
        import resource

        from fusion.errors import ADDRESS_SPACE_TOO_SMALL, ComputeError

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < MIN_ADDRESSES:
            raise ComputeError(ADDRESS_SPACE_TOO_SMALL, expected_mb=MIN_ADDRESSES / 1e6, found_mb=limit / 1e6)


def _unwritten() -> OSError | None:
    """Return the error of stdout, None if there is none; its remaining content is discarded."""
    try:
        sys.stdout.flush()
    except OSError as error:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error
    return None


# Signals and terminals.


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Clean up after signals; ignored ones, as in background jobs, stay ignored."""
    before = {}
    with suppress(ValueError):  # outside the main thread
        for number in (getattr(signal, name) for name in ENDING if hasattr(signal, name)):
            if signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, _end) or signal.SIG_DFL
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, _: object) -> None:
    """End the process with its clean-up, if there is any."""
    end = getattr(sys.modules.get("fusion.base"), "end_process", None)
    if end is not None:
        end(number)
        return
    os.write(2, f"shakercal: ended by {signal.Signals(number).name}\n".encode())
    os._exit(128 + number)


@contextmanager
def _terminals() -> Iterator[None]:
    """Make stdout and stderr accept every text, and replace missing ones."""
    from fusion.report.terminal import Terminal

    before = sys.stdout, sys.stderr
    nowhere = open(os.devnull, "w")  # noqa: SIM115  (open while the process may print)
    sys.stdout, sys.stderr = (Terminal(stream or nowhere) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        nowhere.close()


def _set_up_log(options: argparse.Namespace) -> None:
    """Send messages to stderr; those of libraries, warnings included, only with -v."""
    import logging

    from fusion.report.terminal import printable, wrapped

    class ToStderr(logging.Handler):
        """Handler for the current stderr, which a progress bar redirects."""

        def emit(self, record: logging.LogRecord) -> None:
            text = printable(self.format(record))
            print(text if record.exc_info else wrapped(text, sys.stderr), file=sys.stderr)

    handler, log = ToStderr(), logging.getLogger("shakercal")
    handler.setFormatter(logging.Formatter("shakercal: %(message)s"))
    log.handlers, log.propagate = [handler], False
    log.setLevel(logging.WARNING if options.quiet else logging.DEBUG if options.verbose else logging.INFO)
    logging.getLogger().handlers = [handler if options.verbose else logging.NullHandler()]
    logging.captureWarnings(True)


def _completion() -> type[argparse.Action]:
    """Return the option that prints the completion code of a shell."""
    import argparse

    class Completion(argparse.Action):
        def __call__(self, parser: argparse.ArgumentParser, _: object, shell: object, option: object = None) -> None:
            import argcomplete

            print(argcomplete.shellcode([parser.prog], shell=str(shell)))
            parser.exit()

    return Completion


def _parser(first: Sequence[str] = ()) -> Parser:
    """Return the parser, of one command if that is the `first` argument (faster)."""
    from fusion.base import PROGRAM, __version__
    from fusion.commands.options import Parser

    parser = Parser(
        prog="shakercal",
        description="From a shaker recording to the dynamic sensitivity of a multi-component force and moment sensor.",
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    text = "print code for the start-up file of a shell that completes commands and options"
    parser.add_argument("--completion", choices=("bash", "zsh", "fish"), action=_completion(), help=text)
    common = Parser(add_help=False)
    loudness = common.add_mutually_exclusive_group()
    loudness.add_argument("-v", "--verbose", action="store_true", help="print more on stderr")
    loudness.add_argument("-q", "--quiet", action="store_true", help="warnings and errors only, no progress bar")
    every = commands()
    names = [command.name for command in every]
    if first and first[0] not in names and not first[0].startswith("-"):
        from difflib import get_close_matches

        near = get_close_matches(first[0], names, 1)
        parser.error(
            f"expected a command, found {first[0] or 'an empty text'}{f'; did you mean {near[0]}?' if near else ''}"
        )
    parsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in [one for one in every if one.name in first] or every:
        summary = f"{command.help[0].upper()}{command.help[1:]}."
        epilog = f"example: {command.example}"
        sub_parser = parsers.add_parser(
            command.name, parents=[common], help=command.help, description=summary, epilog=epilog
        )
        command.options(sub_parser)
        sub_parser.set_defaults(act=command.act)
    return parser


if __name__ == "__main__":
    sys.exit(main())
