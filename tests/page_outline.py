"""What a page of HTML holds: its tags as they nest, identifiers, addresses and text."""

from __future__ import annotations

import re
from html.parser import HTMLParser

from page_numbers import number_faults

VOID = {"meta", "img", "br", "link", "hr", "input"}


class Outline(HTMLParser):
    """Tags as they nest, identifiers, addresses, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.ids += [name] if (name := found.get("id")) else []
        self.addresses += [found[key] or "" for key in ("src", "href") if key in found]
        assert tag != "script" or set(found) <= {"type", "id"}, "a program from elsewhere"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text.append(data)


def outline(page: str) -> Outline:
    """Return the outline of a page in which every tag is closed."""
    parser = Outline()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def self_contained(page: str) -> Outline:
    """Return the outline of a page that asks for nothing outside: its figures are in it, its anchors exist.

    Its numbers are printed by the one rule.
    """
    found = outline(page)
    assert page.startswith("<!doctype html>")
    assert len(found.ids) == len(set(found.ids))
    anchors = {address[1:] for address in found.addresses if address.startswith("#")}
    assert anchors <= set(found.ids)
    others = [address for address in found.addresses if not address.startswith("#")]
    assert all(address.startswith("data:image/svg+xml") for address in others)
    faults = number_faults(page)
    assert not faults, "\n".join(faults)
    assert not re.search(r"url\((?!%23)|@import", re.sub(r"(?s)<script.*?</script>", "", page))
    return found
