"""The page of the published comparison: its arithmetic is what the formulas give, its pictures exist."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "nitsche2018.md"


@pytest.fixture(scope="module")
def paper() -> ModuleType:
    path = ROOT / "benchmarks" / "published_paper.py"
    spec = importlib.util.spec_from_file_location("published_paper", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_formulas_give_the_published_values(paper: ModuleType) -> None:
    assert paper.acceleration(106.2495, 0.4277e-3) == pytest.approx(190.6131, abs=1e-4)
    assert paper.acceleration(424.9472, 0.0040e-3) == pytest.approx(28.5161, abs=1e-4)
    assert paper.spring(1477.35, 4.236) == pytest.approx(4.313e8, rel=2e-4)
    assert paper.spring(1092.97, 8.798) == pytest.approx(4.512e8, rel=2e-4)
    magnitude, phase = paper.lag(1000.0, 50e-6)[0], paper.lag(800.0, 50e-6)[1]
    assert magnitude == pytest.approx(0.953, abs=2e-3)
    assert phase == pytest.approx(-0.25, abs=5e-3)


def test_the_page_holds_that_arithmetic(paper: ModuleType) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert "\n".join(paper.table()) in text


def test_every_part_of_the_page_is_filled_and_every_picture_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name in ("table 1", "agreement", "figure 14", "arithmetic"):
        (content,) = re.findall(f"<!-- {name} -->(.*?)<!-- end of {name} -->", text, re.DOTALL)
        assert content.count("|") > 20
    pictures = re.findall(r"\((images/[^)]*)\)", text)
    assert len(pictures) == 5
    for picture in pictures:
        assert (PAGE.parent / picture).read_bytes().startswith(b"\x89PNG")
