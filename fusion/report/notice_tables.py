"""Notices on pages: the list, the acknowledged ones, and influences that are not assessed."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from markupsafe import Markup, escape

from fusion.report.table import Table
from shakercal._common.notices import Notice, warnings_first


def notice_frame(notices: Iterable[Notice]) -> dict[str, Any]:
    """Return the notices of a page, and tables of acknowledged and of not assessed ones."""
    every = warnings_first(notices)
    seen = [one for one in every if one.acknowledged]
    assumed = [one for one in every if one.possible_size and not one.acknowledged]
    heads = ("code", "where", "notice", "reason (by, date)"), ("code", "influence", "where", "size", "how to assess it")
    rows = [(_named(one), one.where, code_html(one.text), one.acknowledged) for one in seen]
    sized = [(_named(one), *map(code_html, (one.text, one.where, one.possible_size, one.remedy))) for one in assumed]
    return {
        "notices": [one for one in every if one.is_listed],
        "acknowledged": Table("Acknowledged", heads[0], "llll", tuple(rows)) if seen else None,
        "not_assessed": Table("Influences outside U", heads[1], "lllll", tuple(sized)) if assumed else None,
    }


def code_html(text: str) -> Markup:
    """Return a text with its `code` marked for pages."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _named(notice: Notice) -> Markup:
    """Return the code of a notice, which stays on one line."""
    return Markup('<span class="code">{}</span>').format(notice.code)
