"""The page of the published comparison: its tables are filled, its pictures exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "nitsche2018.md"


def test_every_part_of_the_page_is_filled_and_every_picture_there():
    text = PAGE.read_text(encoding="utf-8")
    for name in ("table 1", "agreement", "figure 14"):
        (content,) = re.findall(f"<!-- {name} -->(.*?)<!-- end of {name} -->", text, re.DOTALL)
        assert content.count("|") > 20
    pictures = re.findall(r"\((images/[^)]*)\)", text)
    assert len(pictures) == 5
    for picture in pictures:
        assert (PAGE.parent / picture).read_bytes().startswith(b"\x89PNG")
