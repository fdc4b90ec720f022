"""Command-line arguments, and their types, that several sub-commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

from fusion.base import FEWEST_DRAWS, MOST_DRAWS

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

FIGURE_SUFFIXES = (".png", ".svg", ".pdf")
EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Add the recording or campaign a command works on."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder of a recording or of a campaign")
    add_allow_outside(parser)


def add_recordings(parser: argparse.ArgumentParser) -> None:
    """Add the recordings that a command evaluates together."""
    text = "folder of a campaign, or of recordings of one rig"
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING", help=text)
    add_allow_outside(parser)


def add_allow_outside(parser: argparse.ArgumentParser) -> None:
    """Add the leave to read files anywhere."""
    parser.add_argument("--allow-outside", action="store_true", help="accept files outside the folder of rig.toml")


def add_results(parser: argparse.ArgumentParser, default: str) -> None:
    """Add where a command writes its results, and the leave to overwrite; `default`: where without the option."""
    text = f"result folder (default: {default})"
    parser.add_argument("-o", "--output", type=Path, metavar="RESULTS", help=text)
    parser.add_argument("--force", action="store_true", help="overwrite result files that are there")


def positive(text: str) -> float:
    """Return a number above 0."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text}")
    return value


def not_negative(text: str) -> float:
    """Return a number of at least 0."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number of at least 0, found {text}")
    return value


def count(text: str) -> int:
    """Return a whole number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, found {value}")
    return value


def size(text: str) -> tuple[int, int]:
    """Return columns and rows of a text such as 9x6."""
    columns, cross, rows = text.lower().partition("x")
    if not (cross and columns.isdigit() and rows.isdigit()):
        raise argparse.ArgumentTypeError(f"expected columns x rows such as 9x6, found {text}")
    return int(columns), int(rows)


def figure(text: str) -> Path:
    """Return the path of a figure of a known format."""
    path = Path(text)
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        raise argparse.ArgumentTypeError(f"expected a name that ends in {', '.join(FIGURE_SUFFIXES)}, found {text}")
    return path


def radius(text: str) -> int:
    """Return the half-width of a subset in pixels."""
    value = int(text)
    if not 4 <= value <= 100:
        raise argparse.ArgumentTypeError(f"expected 4 to 100 pixels, found {value}")
    return value


def device(choice: str) -> str:
    """Return the processor chosen, checked to be there."""
    from photogram.subsets.track import resolve_device

    try:
        return resolve_device(choice)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("device: ")) from error


def seed(text: str) -> int:
    """Return the seed of a random generator."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, found {value}")
    return value


def draws(text: str) -> int:
    """Return a number of Monte Carlo draws."""
    value = int(text)
    if not FEWEST_DRAWS <= value <= MOST_DRAWS:
        raise argparse.ArgumentTypeError(f"expected {FEWEST_DRAWS} to {MOST_DRAWS} draws, found {value}")
    return value
