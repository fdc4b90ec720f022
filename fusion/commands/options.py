"""Common parts of commands: parser, argument types, exit statuses; without heavy imports."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

from fusion.base import FEWEST_DRAWS, MOST_DRAWS, is_address

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")
EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED, EXIT_CLOSED = 0, 1, 2, 130, 141
LONGEST, LONGEST_MESSAGE = 4096, 500  # characters of a path, and of an error message
DECIMALS = 6  # of frequencies within a range, in Hz
MOST_LINES = 1000  # excitations of a plan
MOST_OF_SIZE = 100_000  # columns or rows, of targets and images
Value = TypeVar("Value", int, float)


class Parser(argparse.ArgumentParser):
    """A parser with methods for common options."""

    def error(self, message: str) -> NoReturn:
        """Print an error of the arguments, control characters by number, and exit."""
        shown = "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in message)
        super().error(shown if len(shown) <= LONGEST_MESSAGE else f"{shown[:LONGEST_MESSAGE]}…")

    def value(self, flag: str, kind: Callable[[str], Any], metavar: Any, text: str, **more: Any) -> None:
        """Add an option or argument with a value, its type `kind`."""
        self.add_argument(flag, type=kind, metavar=metavar, help=text, **more)

    def choice(self, flag: str, choices: Sequence[str], text: str) -> None:
        """Add a choice, by default the first."""
        self.add_argument(flag, choices=choices, default=choices[0], help=text)

    def switch(self, flag: str, text: str) -> None:
        """Add an option without a value."""
        self.add_argument(flag, action="store_true", help=text)

    def recording(self) -> None:
        """Add the recording or campaign of a command."""
        self.value("recording", path, "RECORDING", "folder of a recording or of a campaign")
        self.allow_outside()

    def recordings(self, others: str = "") -> None:
        """Add the recordings that a command evaluates together; `others`: further inputs in the help."""
        text = f"folder of a campaign, or of recordings of one rig{others}"
        self.value("recordings", path, "RECORDING", text, nargs="+")
        self.allow_outside()

    def allow_outside(self, file: str = "rig.toml") -> None:
        """Add the permission to read files anywhere."""
        self.switch("--allow-outside", f"accept files outside the folder of {file}")

    def results(self, default: str) -> None:
        """Add result folder and permission to overwrite; `default`: description of the default."""
        self.add_argument("-o", "--output", type=path, metavar="RESULTS", help=f"result folder (default: {default})")
        self.switch("--force", "overwrite existing results")
        self.pdf()

    def pdf(self) -> None:
        """Add the summary as a PDF file."""
        self.value("--pdf", pdf, "FILE.pdf", "write the summary of the page, too, printed by a browser of this machine")

    def figure_and_table(self, figure_text: str, table_text: str) -> None:
        """Add a figure and a table as additional outputs."""
        self.value("--figure", figure, "FILE", f"{figure_text} (.png, .svg, .pdf)")
        self.value("--csv", path, "FILE", table_text)
        self.switch("--force", "overwrite existing files")
        self.json()

    def json(self) -> None:
        """Add output as JSON."""
        self.switch("--json", "print the main results, notices and paths as JSON instead, and nothing else on stdout")

    def device(self, text: str) -> None:
        """Add the device for tracking."""
        self.value("--device", device, "{auto,cpu,cuda}", text, default="auto")


@dataclass(frozen=True)
class CliCommand:
    """A sub-command: help, example, function for options, function for the action.

    The action returns the exit status; None is success.
    """

    name: str
    help: str
    example: str
    options: Callable[[Parser], None]
    act: Callable[[argparse.Namespace], int | None]


def command(
    options: Callable[[Parser], None], example: str
) -> Callable[[Callable[[argparse.Namespace], int | None]], CliCommand]:
    """Return a decorator that makes a command from a function's name and docstring.

    `options`: adds its options. `example`: text after `shakercal` and its name.
    """

    def made(act: Callable[[argparse.Namespace], int | None]) -> CliCommand:
        text, name = str(act.__doc__), act.__name__.replace("_", "-")
        return CliCommand(name, text[0].lower() + text[1:].rstrip("."), f"shakercal {name} {example}", options, act)

    return made


def _number(convert: Callable[[str], Value], accepts: Callable[[Value], bool], expected: str) -> Callable[[str], Value]:
    """Return an argument type: an accepted number, else an error with the expectation."""

    def check(text: str) -> Value:
        try:
            value = convert(text)
            if accepts(value):
                return value
        except ValueError:
            pass
        shown = text if len(text) <= 60 and text.isprintable() else ascii(text)[:60]
        raise argparse.ArgumentTypeError(f"expected {expected}, found {shown}")

    return check


SMALLEST, LARGEST = 1e-30, 1e30
"""Range of the size of numbers other than 0, as in manifests (`fusion.recording.values`)."""
positive = _number(float, lambda value: SMALLEST <= value <= LARGEST, f"a number above 0, at most {LARGEST:g}")
not_negative = _number(
    float, lambda value: value == 0 or SMALLEST <= value <= LARGEST, f"a number of at least 0, at most {LARGEST:g}"
)
hertz = _number(float, lambda value: 1e-6 <= value <= 1e8, "a frequency in Hz above 0, at most 1e8")
METRES = {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}


class Length(NamedTuple):
    """A length in m, and its written unit, "" for none."""

    m: float
    unit: str


def length(text: str) -> Length:
    """Return a length above 0, in m by default."""
    number, unit = re.fullmatch(r"(.*?)\s*([a-zµ]*)", text, re.DOTALL).groups()  # type: ignore[union-attr]
    if unit not in METRES:
        raise argparse.ArgumentTypeError(f"expected a length such as 7e-3 (m) or 7mm, found {ascii(text)[:60]}")
    return Length(positive(number) * METRES[unit], unit)


def in_metres(text: str) -> str:
    """Return a length as text in m, other texts unchanged."""
    found = re.fullmatch(r"(.*?)\s*([a-zµ]+)", text)
    try:
        return repr(float(found[1]) * METRES[found[2]]) if found else text
    except (KeyError, ValueError):
        return text


share = _number(float, lambda value: value == 0 or SMALLEST <= value < 1, "a number of at least 0, below 1")
between_0_and_1 = _number(float, lambda value: 0 < value < 1, "a number between 0 and 1")


def whole(minimum: int, maximum: int) -> Callable[[str], int]:
    """Return the argument type of a whole number between two limits, inclusive."""
    return _number(int, lambda value: minimum <= value <= maximum, f"a whole number from {minimum} to {maximum}")


count = whole(1, 1000)
seed = whole(0, 2**63 - 1)
radius = _number(int, lambda value: 4 <= value <= 100, "4 to 100 pixels")
exponent = _number(float, lambda value: -4 <= value <= 4, "an exponent from -4 to 4")
draws = _number(int, lambda value: FEWEST_DRAWS <= value <= MOST_DRAWS, f"{FEWEST_DRAWS} to {MOST_DRAWS} draws")


def percent(text: str) -> float:
    """Return a percentage above 0 and below 100 as a share."""
    value = positive(text)
    if value >= 100.0:
        raise argparse.ArgumentTypeError(f"expected less than 100 %, found {text}")
    return value / 100.0


def path(text: str) -> Path:
    """Return a path that exists or can be created."""
    shown = ascii(text)[1:-1][:60]
    if not text.strip() or not text.isprintable() or len(text) > LONGEST:
        raise argparse.ArgumentTypeError(f"expected a path, found {shown or 'an empty text'}")
    try:
        target = Path(text).resolve()
        if target.is_symlink():  # only circular links remain, of which Python 3.13 does not complain
            raise RuntimeError
        if target.exists() and not (target.is_file() or target.is_dir()):
            raise argparse.ArgumentTypeError(f"expected a file or folder, found a device or pipe at {shown}")
    except (OSError, RuntimeError) as error:  # circular links raise the latter before Python 3.13
        reason = error.strerror if isinstance(error, OSError) else "circular links"
        raise argparse.ArgumentTypeError(f"expected a path, found {shown}: {reason}") from error
    return Path(text)


def path_or_address(text: str) -> Path | str:
    """Return a path, or the address of an object store as text."""
    return text if is_address(text) and text.isprintable() and len(text) <= LONGEST else path(text)


def size(text: str) -> tuple[int, int]:
    """Return columns and rows of a text such as 9x6."""
    columns, cross, rows = text.lower().partition("x")
    if not (cross and columns.isdecimal() and rows.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected columns x rows such as 9x6, found {ascii(text)[:60]}")
    if not all(len(part) <= 6 and 1 <= int(part) <= MOST_OF_SIZE for part in (columns, rows)):
        raise argparse.ArgumentTypeError(f"expected columns and rows from 1 to {MOST_OF_SIZE}, found {text[:40]}")
    return int(columns), int(rows)


def whole_numbers(text: str) -> tuple[int, ...]:
    """Return the whole numbers of a text such as 0,44."""
    parts = text.split(",")
    if not all(part.isdecimal() and len(part) <= 6 for part in parts):
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 0 or 0,44, found {ascii(text)[:60]}")
    return tuple(int(part) for part in parts)


def band(text: str) -> tuple[float, float]:
    """Return the two frequencies of a text such as 10:2000."""
    low, colon, high = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"expected two frequencies such as 10:2000, found {ascii(text)[:60]}")
    limits = not_negative(low), positive(high)
    if limits[0] >= limits[1]:
        raise argparse.ArgumentTypeError(f"expected the lower frequency first, found {text}")
    return limits


def elements(text: str) -> tuple[tuple[str, str], ...]:
    """Return the outputs and loads of a text such as Fz/Fz,My/Fx."""
    pairs = [part.strip().partition("/") for part in text.split(",")]
    if not all(channel and load for channel, _, load in pairs):
        raise argparse.ArgumentTypeError(f"expected elements such as Fz/Fz,My/Fx, found {ascii(text)[:60]}")
    found = tuple((channel, load) for channel, _, load in pairs)
    repeated = next((pair for i, pair in enumerate(found) if pair in found[:i]), None)
    if repeated is not None:
        raise argparse.ArgumentTypeError(f"expected every element once, found {'/'.join(repeated)[:60]} twice")
    return found


def three_minutes(text: str) -> tuple[float, ...]:
    """Return the three durations of a text such as 20,15,30."""
    found = tuple(positive(part) for part in text.split(","))
    if len(found) != 3:
        raise argparse.ArgumentTypeError(f"expected three numbers such as 20,15,30, found {ascii(text)[:60]}")
    return found


def _named(*suffixes: str) -> Callable[[str], Path]:
    """Return the argument type of a file whose name has one of some suffixes."""

    def check(text: str) -> Path:
        file = path(text)
        if file.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"expected a name that ends in {', '.join(suffixes)}, found {text}")
        return file

    return check


page, pdf, database, figure = _named(".html"), _named(".pdf"), _named(".parquet"), _named(*FIGURE_SUFFIXES)


def device(choice: str) -> str:
    """Return an available device; "auto" is resolved later."""
    if choice == "auto":
        return choice
    from photogram.device import resolve_device

    try:
        return resolve_device(choice)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("device: ")) from error


def frequencies(text: str) -> tuple[float, ...]:
    """Return the frequencies of a text such as 53.7,106.25 or 53.7:1020.3:12, in the order given."""
    found: list[float] = []
    for item in text.split(","):
        found += _range(item.strip())
        if len(found) > MOST_LINES:
            raise argparse.ArgumentTypeError(f"expected at most {MOST_LINES} frequencies, found {len(found)} or more")
    repeated = next((value for i, value in enumerate(found) if value in found[:i]), None)
    if repeated is not None:
        raise argparse.ArgumentTypeError(f"expected every frequency once, found {repeated:g} Hz twice")
    return tuple(found)


def _range(text: str) -> list[float]:
    """Return the frequencies of one number or range."""
    shown = (text if text.isprintable() else ascii(text))[:60] or "an empty text"
    wrong = argparse.ArgumentTypeError(f"expected frequencies such as 106.25 or 53.7:1020.3:12, found {shown}")
    parts = text.split(":")
    logarithmic = len(parts) == 4 and parts[3] == "log"
    if len(parts) not in (1, 3) and not logarithmic:
        raise wrong
    try:
        first, last = hertz(parts[0]), hertz(parts[1] if len(parts) > 1 else parts[0])
        number = int(parts[2]) if len(parts) > 1 else 1
    except (ValueError, argparse.ArgumentTypeError):
        raise wrong from None
    if number < 1 or (number == 1) != (first == last):
        raise argparse.ArgumentTypeError(f"expected a count of at least 2 between two frequencies, found {shown}")
    if number > MOST_LINES:
        raise argparse.ArgumentTypeError(f"expected a count of at most {MOST_LINES}, found {shown}")
    shares = [i / max(number - 1, 1) for i in range(number)]
    if logarithmic:
        return [round(first * (last / first) ** share, DECIMALS) for share in shares]
    return [round(first + (last - first) * share, DECIMALS) for share in shares]
