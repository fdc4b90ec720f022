"""The summary of a page as a PDF file, printed by a browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from fusion.base import check_new_file
from fusion.errors import ComputeError, InputError
from fusion.report.atomic_files import report_write_errors, write_atomically
from fusion.report.report_notices import NO_BROWSER, NOT_PRINTED
from fusion.report.terminal import AS_JSON

BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "microsoft-edge-stable", "msedge", "brave-browser"),
)
"""Names of browsers that print without a window, all of one family."""
PLACES = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
)
WINDOWS_PLACES = (r"Google\Chrome\Application\chrome.exe", r"Microsoft\Edge\Application\msedge.exe")
SUMMARY = "#summary"
"""Part of the address of a page with which only its summary is printed (templates/report.css)."""
LONGEST_S = 120.0
"""Largest duration of printing (chosen)."""


class Requested(NamedTuple):
    """The PDF file that a command shall write, and the browser for it."""

    file: Path
    browser: str


_REQUESTED: ContextVar[Requested | None] = ContextVar("requested", default=None)


def request_pdf(file: Path | None, *, force: bool) -> None:
    """Set the PDF file of a command.

    Raises `InputError` if it exists, or without a browser.
    """
    if file is not None:
        check_new_file(file, force=force)
    _REQUESTED.set(None if file is None else Requested(file, find_browser()))


def find_browser() -> str:
    """Return the path of a browser that prints without a window.

    Raises `InputError` if there is none.
    """
    named = (shutil.which(name) for name in BROWSERS)
    folders = [os.environ[name] for name in ("PROGRAMFILES", "PROGRAMFILES(X86)", "LOCALAPPDATA") if name in os.environ]
    places = [*PLACES, *(str(Path(folder) / place) for folder in folders for place in WINDOWS_PLACES)]
    found = next(filter(None, named), None) or next((place for place in places if Path(place).is_file()), None)
    if found is None:
        raise InputError(NO_BROWSER, "--pdf", names=", ".join(BROWSERS))
    return found


def write_requested_pdf(page: Path) -> None:
    """Write the summary of a page to the PDF file of the command, if any."""
    requested = _REQUESTED.get()
    if requested is None:
        return
    content = print_summary(page, requested.browser, requested.file.absolute().parent)
    write_atomically(requested.file, content)
    if not AS_JSON.get():
        print(f"summary: {requested.file}")


def print_summary(page: Path, browser: str, place: Path) -> bytes:
    """Return the summary of a page as the content of a PDF file.

    `place`: folder for temporary files, since a browser in a sandbox may not see those of the system. The browser has a
    new profile, so that one with a window may be open.
    """
    with (
        report_write_errors(page),
        TemporaryDirectory(prefix="summary-", dir=place, ignore_cleanup_errors=True) as folder,
    ):
        made = Path(folder) / "summary.pdf"
        arguments = [
            *("--headless", "--disable-gpu", "--no-first-run", "--no-default-browser-check"),
            *("--no-pdf-header-footer", f"--user-data-dir={folder}"),
            *(["--no-sandbox"] if sys.platform != "win32" and os.geteuid() == 0 else []),  # it refuses to start as root
            *(f"--print-to-pdf={made}", page.absolute().as_uri() + SUMMARY),
        ]
        try:
            ended = subprocess.run([browser, *arguments], capture_output=True, timeout=LONGEST_S, check=False)
            reason = f"exit status {ended.returncode}"
        except subprocess.TimeoutExpired:
            reason = f"no result after {LONGEST_S:g} s"
        content = made.read_bytes() if made.is_file() else b""
        if not content.startswith(b"%PDF"):
            raise ComputeError(NOT_PRINTED, browser=browser, reason=reason)
        return content
