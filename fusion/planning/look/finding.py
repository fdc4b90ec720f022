"""What a look finds, and the verdict that follows: KEEP, CHECK, FIX MANIFEST or REPEAT."""

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
    """A fact about a recording: the `verdict` it leads to, the channel, camera or key it is about, the text."""

    verdict: Verdict
    where: str
    text: str

    @property
    def level(self) -> Level:
        """Return the colour of the verdict: good, look (yellow) or wrong (red)."""
        return LEVEL_OF[self.verdict]


def refusal_finding(error: Exception, where: str = "") -> Finding:
    """Return the finding of a refusal by `run` or a reader.

    A statement of a manifest that data contradict is to be mended there. A file that cannot be read, and data that
    allow no result, are to be recorded again.
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
    """Return the finding of a problem that `check` names: of a file, or of what a manifest says of it."""
    block, told = re.fullmatch(r"(?:(?:take\S+ )?(daq|images|points) ([^:]+): )?(.*)", text, re.DOTALL).groups()[1:]  # type: ignore[union-attr]
    mistaken = block is None or ("expected" in told and "truncated" not in told)
    return Finding("FIX MANIFEST" if mistaken else "REPEAT", block or "", shorten(told))


def shorten(text: str) -> str:
    """Return what a reader says in one line, its file without folders."""
    text = " ".join(text.split())
    path, colon, rest = text.partition(": ")
    return f"{path.rpartition('/')[2]}: {rest}" if colon and "/" in path else text


def worst_verdict(findings: tuple[Finding, ...] | list[Finding]) -> Verdict:
    """Return the worst verdict of some findings, KEEP of none."""
    return max((finding.verdict for finding in findings), key=VERDICTS.index, default="KEEP")
