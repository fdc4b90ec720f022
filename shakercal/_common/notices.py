"""Notices of results: declared once with a code, raised with the values of the case."""

from __future__ import annotations

import json
import math
import re
import string
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

Severity = Literal["error", "warning", "note"]
"""`error`: refused. `warning`: the result may be wrong or U incomplete. `note`: good to know."""
Value = str | int | float | bool


def plain_value(value: Any) -> Value:
    """Return a value as Python's text, number or truth value."""
    return value.item() if hasattr(value, "item") else value  # type: ignore[no-any-return]


WITH_UNCERTAINTY = re.compile(r"\{(\w+):\.?\d*g\} ± \{(\w+):\.?\d*g\}(?=( [\w{µ%])?)")
"""Fields of a value and its uncertainty in a template, and the beginning of a unit that follows."""


class _Formatter(string.Formatter):
    """`str.format` with typographic minus signs, powers of ten and spaces before %."""

    def format_field(self, value: Any, format_spec: str) -> str:
        from shakercal._common.digits import number_text, python_typeset  # imported late: a module less in every chain

        general = re.fullmatch(r"\.?(\d*)g", format_spec)
        if general and not isinstance(value, str):
            return number_text(float(value), int(general[1] or 6))
        text = format(value, format_spec)
        text = text if isinstance(value, str) else python_typeset(text)
        return f"{text[:-1]} %" if format_spec.endswith("%") else text


def fill_template(template: str, values: Mapping[str, Value]) -> str:
    """Return a template with its values, which end where their uncertainty does."""
    from shakercal._common.digits import round_to_uncertainty

    def with_uncertainty(found: re.Match[str]) -> str:
        text = round_to_uncertainty(float(values[found[1]]), float(values[found[2]])).text
        return f"({text})" if found[3] and not text.startswith("(") else text

    return _Formatter().vformat(WITH_UNCERTAINTY.sub(with_uncertainty, template), (), values)


@dataclass(frozen=True)
class DeclaredNotice:
    """A kind of notice or error, declared once next to the stage that raises it.

    Attributes
    ----------
    code : `SC-` and three digits; it never changes its meaning.
    severity : `error`, `warning` or `note`.
    template : one sentence that states what was found, with the fields of `str.format`.
    effect : what it does to the result; may use the same fields.
    remedy : what the user can do; may use the same fields.
    link : page of the documentation, with its heading, such as `tracking.md#lost-subsets`.
    possible_size : of an influence that no recording of a kind can assess: how large it may be. Pages list such notes
        in the table "Not assessed".
    acknowledgeable : whether a manifest may acknowledge it; False where it must stop a certificate.

    Examples
    --------
    >>> from shakercal._common.notices import DeclaredNotice, Notice
    >>> LOST = DeclaredNotice("SC-999", "warning", "{lost} of {total} subsets are lost.", remedy="Reduce the motion.")
    >>> Notice(LOST, "camera left", lost=3, total=40).text
    '3 of 40 subsets are lost.'
    """

    code: str
    severity: Severity
    template: str
    effect: str = ""
    remedy: str = ""
    link: str = ""
    possible_size: str = ""
    acknowledgeable: bool = True

    @property
    def can_be_acknowledged(self) -> bool:
        """Whether a manifest may acknowledge it: a warning or note that no certificate depends on."""
        return self.acknowledgeable and self.severity != "error"


@dataclass(frozen=True, init=False)
class Notice:
    """A declared notice that occurred: what was found, where, and the numbers of the case.

    Attributes
    ----------
    code, severity : those of the declaration.
    where : the channel, camera, file or stage that it concerns.
    text, effect, remedy, possible_size : the texts of the declaration with the values of the case.
    acknowledged : of a notice that a manifest acknowledges: the reason, the name and the date; else empty.
    values : the values by name; numbers in the unit that the name ends with.
    """

    code: str
    severity: Severity
    text: str
    where: str
    effect: str
    remedy: str
    possible_size: str
    acknowledged: str
    values: Mapping[str, Value] = field(hash=False)

    def __init__(self, declared: DeclaredNotice, where: str = "", /, **values: Value) -> None:
        values = {name: plain_value(value) for name, value in values.items()}
        set_field = object.__setattr__
        set_field(self, "code", declared.code)
        set_field(self, "severity", declared.severity)
        set_field(self, "text", fill_template(declared.template, values))
        set_field(self, "where", where)
        set_field(self, "effect", fill_template(declared.effect, values))
        set_field(self, "remedy", fill_template(declared.remedy, values))
        set_field(self, "possible_size", fill_template(declared.possible_size, values))
        set_field(self, "acknowledged", "")
        set_field(self, "values", values)

    @classmethod
    def from_row(cls, row: Mapping[str, str]) -> Notice:
        """Return the notice that `as_row` describes; of an older file, one without a code.

        Raises
        ------
        ValueError
            If the severity is unknown, or the values are no JSON object of numbers and texts.
        """
        severity: Any = {"info": "note"}.get(row["severity"], row["severity"])
        if severity not in get_args(Severity):
            raise ValueError(f"notices/severity: expected one of {', '.join(get_args(Severity))}, found {severity}")
        values = json.loads(row.get("values", "{}"))
        if not isinstance(values, dict) or not all(isinstance(v, int | float | str | None) for v in values.values()):
            raise ValueError("notices/values: expected a JSON object of numbers and texts")
        notice = cls(DeclaredNotice(row.get("code", ""), severity, ""), row["where"])
        for name in ("text", "effect", "remedy", "possible_size", "acknowledged"):
            object.__setattr__(notice, name, row.get(name, ""))
        object.__setattr__(notice, "values", values)
        return notice

    def as_dict(self) -> dict[str, Any]:
        """Return every field for JSON; values that are not finite are None."""
        values = self.values.items()
        finite = {name: value if isinstance(value, str) or math.isfinite(value) else None for name, value in values}
        return {**{one.name: getattr(self, one.name) for one in fields(self)}, "values": finite}

    def as_row(self) -> dict[str, str]:
        """Return every field as text; the values as one JSON object."""
        row = self.as_dict()
        return {**row, "values": json.dumps(row["values"], ensure_ascii=False)}

    def at(self, where: str) -> Notice:
        """Return the same notice of another place."""
        return self._with("where", where)

    def acknowledge(self, reason: str) -> Notice:
        """Return the notice as acknowledged; without a reason unchanged."""
        return self._with("acknowledged", reason) if reason else self

    def _with(self, name: str, value: str) -> Notice:
        notice = object.__new__(Notice)
        for one in fields(self):
            object.__setattr__(notice, one.name, getattr(self, one.name))
        object.__setattr__(notice, name, value)
        return notice

    @property
    def explanation(self) -> str:
        """The sentence with its effect and remedy."""
        return " ".join(text for text in (self.text, self.effect, self.remedy) if text)

    @property
    def is_listed(self) -> bool:
        """Whether it is neither acknowledged nor an influence outside U, which have tables."""
        return not self.acknowledged and not self.possible_size


# The notices of one result, and of several recordings.


def warnings_first(notices: Iterable[Notice]) -> list[Notice]:
    """Return every notice once, warnings first; one of several places names them all."""
    places: dict[Notice, dict[str, None]] = {}
    for notice in notices:
        places.setdefault(notice.at(""), {})[notice.where] = None
    once = [notice.at(", ".join(filter(None, where))) for notice, where in places.items()]
    return sorted(once, key=lambda notice: notice.severity != "warning")


NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?: × 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?")
"""A number in a notice; digits within a name, such as that of a channel, do not count."""


class GatheredNotice(Notice):
    """A notice of several recordings, with the ranges of its numbers.

    `recordings`: names of all that it concerns, `everywhere`: whether these are all there are of several; `each`: every
    notice with the recordings that state it. It is acknowledged if all of these are.
    """

    recordings: tuple[str, ...]
    everywhere: bool
    each: tuple[tuple[Notice, tuple[str, ...]], ...]

    def __init__(self, each: Sequence[tuple[Notice, tuple[str, ...]]], total: int) -> None:
        first, names = each[0][0], dict.fromkeys(name for _, stating in each for name in stating)
        acknowledged = first.acknowledged if all(notice.acknowledged for notice, _ in each) else ""
        known = {
            **{one.name: getattr(first, one.name) for one in fields(Notice)},
            "text": _in_ranges([notice.text for notice, _ in each]),
            "acknowledged": acknowledged,
            "recordings": tuple(names),
            "everywhere": len(names) == total > 1,
            "each": tuple(each),
        }
        for name, value in known.items():
            object.__setattr__(self, name, value)

    @property
    def concerned(self) -> str:
        """Return the names of all recordings that it concerns."""
        return f"all {len(self.recordings)} recordings" if self.everywhere else ", ".join(self.recordings)


def gather(groups: Sequence[tuple[str, Iterable[Notice]]]) -> list[GatheredNotice]:
    """Return the notices of named recordings, each once: warnings first, then those of most recordings."""
    found: dict[tuple[object, ...], dict[Notice, dict[str, None]]] = {}
    for name, notices in groups:
        for notice in notices:
            key = notice.code, notice.severity, notice.where, *NUMBER.split(notice.text)
            found.setdefault(key, {}).setdefault(notice, {})[name] = None
    gathered = [
        GatheredNotice([(notice, tuple(stating)) for notice, stating in members.items()], len(groups))
        for members in found.values()
    ]
    return sorted(gathered, key=lambda notice: (notice.severity != "warning", -len(notice.recordings)))


def _in_ranges(texts: Sequence[str]) -> str:
    """Return one text of several, with the smallest and largest of every number."""
    from shakercal._common.digits import python_number

    words, columns = NUMBER.split(texts[0]), zip(*(NUMBER.findall(text) for text in texts), strict=True)
    ranges = []
    for numbers in columns:
        ordered = sorted(set(numbers), key=python_number)
        ranges.append(ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}")
    return "".join(part for pair in zip(words, [*ranges, ""], strict=True) for part in pair)
