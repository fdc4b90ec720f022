"""Findings of a look, and the verdict: KEEP, CHECK, FIX MANIFEST or REPEAT."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Literal

from fusion.errors import ComputeError, InputError
from fusion.phasors.phasor_notices import NO_INSTRUMENT
from fusion.planning.look.look_notices import FILE_PROBLEM
from fusion.planning.look.problem_pictures import ProblemPicture
from fusion.recording.recording_notices import RESPONSE_RANGE_TOO_SMALL
from fusion.sensitivity.sensitivity_notices import POSITION_UNSTATED
from shakercal._common.notices import Notice

Verdict = Literal["KEEP", "CHECK", "FIX MANIFEST", "REPEAT"]
VERDICTS: tuple[Verdict, ...] = ("KEEP", "CHECK", "FIX MANIFEST", "REPEAT")
"""The mildest first: a manifest can be corrected after the load is removed, a recording cannot be repeated."""
Level = Literal["good", "look", "wrong"]
LEVELS: tuple[Level, ...] = ("good", "look", "wrong")
LEVEL_OF: dict[Verdict, Level] = {"KEEP": "good", "CHECK": "look", "FIX MANIFEST": "wrong", "REPEAT": "wrong"}


CORRECTABLE = (".toml", ".json")
"""Suffixes of files with statements that can be corrected: manifests and calibrations."""

CODED = re.compile(r"(SC-\d{3} |)(.*)")
"""A text with the code of an error at its beginning."""

STATED_KEYS = re.compile(r"; (?:give|state|correct) \w+|\(bit depth \d+\)")
"""A reader's `ValueError`, which has no code, that asks for a key: its name, or the bit depth."""


@dataclass(frozen=True)
class Finding:
    """A notice about a recording with its `verdict`, and a picture of the problem."""

    verdict: Verdict
    notice: Notice
    picture: ProblemPicture | None = field(default=None, compare=False)

    @property
    def code(self) -> str:
        """Code of the notice."""
        return self.notice.code

    @property
    def where(self) -> str:
        """Channel, camera or key that it concerns."""
        return self.notice.where

    @property
    def text(self) -> str:
        """The fact, in one sentence."""
        return self.notice.text

    @property
    def level(self) -> Level:
        """Colour of the verdict: good, look (yellow) or wrong (red)."""
        return LEVEL_OF[self.verdict]

    def at(self, where: str) -> Finding:
        """Return the same finding about another channel, camera or key."""
        return replace(self, notice=self.notice.at(where))


def refusal_findings(error: Exception, where: str = "") -> list[Finding]:
    """Return the findings of an error by `run` or a reader.

    Each mistake in the input is a finding.

    If data contradict a statement of a manifest, the manifest has to be corrected. If a file cannot be read, or the
    data give no result, the recording has to be repeated.
    """
    if isinstance(error, InputError):
        return [Finding(_input_verdict(one), _error_notice(one, where)) for one in error.each]
    text = shorten(str(error))
    needs_key = STATED_KEYS.search(text) is not None or ".toml" in text
    if isinstance(error, ComputeError):
        needs_key = needs_key or _lacks_statement(error)
        location = ": ".join(filter(None, (where, error.where)))
        return [Finding("FIX MANIFEST" if needs_key else "REPEAT", Notice(error.declared, location, **error.values))]
    notice = Notice(FILE_PROBLEM, where, reason=text)
    return [Finding("FIX MANIFEST" if needs_key else "REPEAT", notice)]


def _lacks_statement(error: ComputeError) -> bool:
    """Whether the manifest omits a position or every instrument."""
    no_instrument = error.code == NO_INSTRUMENT.code and not error.values["reason"]
    return no_instrument or error.code == POSITION_UNSTATED.code


def _input_verdict(error: InputError) -> Verdict:
    """Return REPEAT for refused data, FIX MANIFEST for a statement to correct."""
    if error.code == RESPONSE_RANGE_TOO_SMALL.code or STATED_KEYS.search(str(error)):
        return "FIX MANIFEST"
    recorded = re.search(r"(^|\.)(images|points|daq)\.", error.key) and "expected" not in error.values
    return "REPEAT" if recorded or error.file.suffix not in CORRECTABLE else "FIX MANIFEST"


def _error_notice(error: InputError, where: str) -> Notice:
    """Return a mistake as a notice about its file and key."""
    return Notice(error.declared, ": ".join(filter(None, (where, error.file.name, error.key))), **error.values)


def problem_finding(text: str) -> Finding:
    """Return the finding of a problem that `check` reports."""
    pattern = r"(?:(?:take\S+ )?(daq|images|points) ([^:]+): )?(.*)"
    block, reason = re.fullmatch(pattern, text, re.DOTALL).groups()[1:]  # type: ignore[union-attr]
    mistaken = block is None or ("expected" in reason and "truncated" not in reason)
    return Finding("FIX MANIFEST" if mistaken else "REPEAT", Notice(FILE_PROBLEM, block or "", reason=shorten(reason)))


def shorten(text: str) -> str:
    """Return a reader's text in one line, with the file's name only."""
    code, text = CODED.fullmatch(" ".join(text.split())).groups()  # type: ignore[union-attr]
    path, colon, rest = text.partition(": ")
    return f"{code}{path.rpartition('/')[2]}: {rest}" if colon and "/" in path else f"{code}{text}"


def worst_verdict(findings: tuple[Finding, ...] | list[Finding]) -> Verdict:
    """Return the worst verdict of some findings, KEEP of none."""
    return max((finding.verdict for finding in findings), key=VERDICTS.index, default="KEEP")
