"""Notices that a laboratory acknowledges in a manifest: `[[acknowledged]]` with code, reason, name and date."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import date as Date
from typing import Annotated

from pydantic import AfterValidator

from fusion.errors import declared_notices
from fusion.recording.values import ManifestBlock, Text, refusal
from shakercal._common.notices import Notice


def _acknowledgeable(code: str) -> str:
    """Return the code of a warning or note that may be acknowledged."""
    if code not in declared_notices():
        raise refusal("a code that `shakercal explain` lists", code)
    declared = declared_notices()[code][1]
    if not declared.can_be_acknowledged:
        raise refusal("the code of a notice that can be acknowledged", f"{code} ({declared.severity})")
    return code


class Acknowledgement(ManifestBlock):
    """One acknowledged kind of notice, with reason, name and date."""

    code: Annotated[Text, AfterValidator(_acknowledgeable)]
    reason: Text
    by: Text
    date: Date


def acknowledge(notices: Iterable[Notice], acknowledgements: Sequence[Acknowledgement]) -> tuple[Notice, ...]:
    """Return notices, each acknowledged one with the reason, the name and the date."""
    texts = {one.code: f"{one.reason} ({one.by}, {one.date})" for one in acknowledgements}
    return tuple(notice.acknowledge(texts.get(notice.code, "")) for notice in notices)
