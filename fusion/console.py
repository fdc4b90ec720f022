"""Where tables and sentences for the user go: a terminal of its own width, a pipe of 120 columns."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

PIPE_WIDTH = 120


def stdout_console() -> Console:
    """Return a console on stdout that prints text as it is."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False, markup=False)
