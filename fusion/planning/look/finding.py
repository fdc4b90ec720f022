"""Findings of a look, and the verdict: KEEP, CHECK, FIX MANIFEST or REPEAT."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from fusion.errors import InputError

Verdict = Literal["KEEP", "CHECK", "FIX MANIFEST", "REPEAT"]
VERDICTS: tuple[Verdict, ...] = ("KEEP", "CHECK", "FIX MANIFEST", "REPEAT")
"""The mildest first: a manifest can be mended when the load is gone, a recording cannot be repeated then."""
Level = Literal["good", "look", "wrong"]
LEVELS: tuple[Level, ...] = ("good", "look", "wrong")
LEVEL_OF: dict[Verdict, Level] = {"KEEP": "good", "CHECK": "look", "FIX MANIFEST": "wrong", "REPEAT": "wrong"}


MENDED = (".toml", ".json")
"""Suffixes of files that state something and can be corrected: manifests and calibrations."""


ASKED = re.compile(r"(?:; (?:give|state|correct) \w+|\(bit depth \d+\)|: frequency_hz: expected a range)")
"""Words of a refusal by which a statement is what lacks: a key, the bit depth of images, the range of a response."""


@dataclass(frozen=True)
class Finding:
    """A notice about a recording, with the `verdict` that follows from it."""

    verdict: Verdict
    where: str
    text: str

    @property
    def level(self) -> Level:
        """Colour of the verdict: good, look (yellow) or wrong (red)."""
        return LEVEL_OF[self.verdict]


def refusal_finding(error: Exception, where: str = "") -> Finding:
    """Return the finding of an error by `run` or a reader.

    If data contradict a statement of a manifest, the manifest has to be corrected. If a file cannot be read, or the
    data give no result, the recording has to be repeated.
    """
    verdict: Verdict = "REPEAT"
    if ASKED.search(str(error)):
        verdict = "FIX MANIFEST"
    elif isinstance(error, InputError):
        read = re.search(r"(^|\.)(images|points|daq)\.", error.key) and "expected" not in error.values
        verdict = "REPEAT" if read or error.file.suffix not in MENDED else "FIX MANIFEST"
    elif ".toml" in str(error):
        verdict = "FIX MANIFEST"
    return Finding(verdict, where, shorten(str(error)))


def problem_finding(text: str) -> Finding:
    """Return the finding of a problem that `check` reports."""
    block, told = re.fullmatch(r"(?:(?:take\S+ )?(daq|images|points) ([^:]+): )?(.*)", text, re.DOTALL).groups()[1:]  # type: ignore[union-attr]
    mistaken = block is None or ("expected" in told and "truncated" not in told)
    return Finding("FIX MANIFEST" if mistaken else "REPEAT", block or "", shorten(told))


def shorten(text: str) -> str:
    """Return a reader's text in one line, with the file's name only."""
    text = " ".join(text.split())
    path, colon, rest = text.partition(": ")
    return f"{path.rpartition('/')[2]}: {rest}" if colon and "/" in path else text


def worst_verdict(findings: tuple[Finding, ...] | list[Finding]) -> Verdict:
    """Return the worst verdict of some findings, KEEP of none."""
    return max((finding.verdict for finding in findings), key=VERDICTS.index, default="KEEP")
