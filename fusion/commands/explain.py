"""The command `explain`: every notice and error by its code, with cause, effect and remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fusion.commands.options import EXIT_DONE, command

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from fusion.commands.options import Parser
    from shakercal._common.notices import DeclaredNotice

HEAD = """# Notices and errors

Every notice and every error of the program has a code. The terminal shows code, place and one sentence;
`shakercal explain CODE` adds effect and remedy. This page lists all of them and is made by
`shakercal explain --markdown`. Names in braces are the values of a case; they are fields of `--json` and `result.h5`.

- **error**: the input is refused, or a result could not be computed. Nothing is written.
- **warning**: a result may be wrong, or its U incomplete.
- **note**: good to know. A note with a possible size is an influence that a recording cannot assess; pages list these
  in the table "Not assessed".

A laboratory acknowledges a warning or note in `recording.toml` with `[[acknowledged]]` (see
[the manifest](recording-format.md)), unless it says *cannot be acknowledged*.
"""


def _explain_options(parser: Parser) -> None:
    parser.add_argument("codes", nargs="*", metavar="CODE", help="codes to explain, such as SC-203 (default: list all)")
    parser.switch("--markdown", "all of them as a page of documentation")


@command(_explain_options, "SC-953")
def explain(options: argparse.Namespace) -> int:
    """Explain notices and errors by their codes: cause, effect, remedy."""
    from fusion.errors import UNKNOWN_CODE, InputError, declared_notices
    from fusion.report.terminal import print_text

    if options.markdown:
        print(notices_page(), end="")
        return EXIT_DONE
    declared = declared_notices()
    codes = [code.upper() for code in options.codes]
    for code in codes:
        if code not in declared:
            raise InputError(UNKNOWN_CODE, "explain", code, first=next(iter(declared)), last=next(reversed(declared)))
    if not codes:
        for code, (title, notice) in declared.items():
            print_text(f"{code} {notice.severity:7} {title}")
    for code in codes:
        for line in explanation(*declared[code]):
            print_text(line)
    return EXIT_DONE


def explanation(title: str, notice: DeclaredNotice) -> Iterator[str]:
    """Yield the parts of a notice, one line each."""
    yield f"{notice.code} ({notice.severity}): {title}"
    parts = {"sentence": notice.template, "effect": notice.effect, "possible size": notice.possible_size}
    parts |= {"remedy": notice.remedy, "more": notice.link and f"docs/{notice.link}"}
    yield from (f"  {name}: {text}" for name, text in parts.items() if text)
    if not notice.can_be_acknowledged and notice.severity != "error":
        yield "  cannot be acknowledged in a manifest"


def notices_page() -> str:
    """Return the page `docs/notices.md`: every stage with its notices, cause, effect and remedy."""
    from fusion.errors import declared_by_stage

    lines = [HEAD]
    for title, notices in declared_by_stage():
        lines += [f"## {title}", "", "| code | severity | notice | effect | remedy |", "|---|---|---|---|---|"]
        for heading, one in notices.items():
            fixed = "" if one.can_be_acknowledged or one.severity == "error" else ", cannot be acknowledged"
            size = f" Possible size: {one.possible_size}" if one.possible_size else ""
            more = f" [More]({one.link})." if one.link else ""
            cells = (
                one.code,
                f"{one.severity}{fixed}",
                f"**{heading}.** {one.template}",
                f"{one.effect}{size}".strip(),
                f"{one.remedy}{more}".strip(),
            )
            lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


COMMANDS = (explain,)
