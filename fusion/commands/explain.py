"""The command `explain`: every notice and error by its code, with cause, effect and remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fusion.commands.options import EXIT_DONE, command

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable

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
    from fusion.errors import UNKNOWN_CODE, InputError, declared_by_stage, declared_notices
    from fusion.report.terminal import print_text

    if options.markdown:
        print(notices_page(), end="")
        return EXIT_DONE
    known, titles = (
        declared_notices(),
        {one.code: title for _, found in declared_by_stage() for title, one in found.items()},
    )
    for code in options.codes:
        if code.upper() not in known:
            raise InputError(UNKNOWN_CODE, "explain", code, first=next(iter(known)), last=next(reversed(known)))
    for code in options.codes:
        for line in explanation(titles[code.upper()], known[code.upper()]):
            print_text(line)
    if not options.codes:
        for notice in known.values():
            print_text(f"{notice.code} {notice.severity:7} {titles[notice.code]}")
    return EXIT_DONE


def explanation(title: str, notice: DeclaredNotice) -> Iterable[str]:
    """Yield the parts of a notice, one line each."""
    yield f"{notice.code} ({notice.severity}): {title}"
    parts = (
        ("sentence", notice.template),
        ("effect", notice.effect),
        ("possible size", notice.possible_size),
        ("remedy", notice.remedy),
    )
    for name, text in parts:
        if text:
            yield f"  {name}: {text}"
    if notice.link:
        yield f"  more: docs/{notice.link}"
    if notice.severity != "error" and not notice.acknowledgeable:
        yield "  cannot be acknowledged in a manifest"


def notices_page() -> str:
    """Return the page `docs/notices.md`: every stage with its notices, cause, effect and remedy."""
    from fusion.errors import declared_by_stage

    lines = [HEAD]
    for title, notices in declared_by_stage():
        lines += [f"## {title}", "", "| code | severity | notice | effect | remedy |", "|---|---|---|---|---|"]
        for heading, one in notices.items():
            kind = one.severity if one.acknowledgeable or one.severity == "error" else "warning, cannot be acknowledged"
            size = f" Possible size: {one.possible_size}" if one.possible_size else ""
            more = f" [More]({one.link})." if one.link else ""
            cells = (
                one.code,
                kind,
                f"**{heading}.** {one.template}",
                f"{one.effect}{size}".strip(),
                f"{one.remedy}{more}".strip(),
            )
            lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


COMMANDS = (explain,)
