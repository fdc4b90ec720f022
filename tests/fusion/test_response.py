"""Response files: tables and chains of elements, and what is said of those that cannot be used."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from fusion.base import InputError
from fusion.recording.check import check
from fusion.recording.files import Element, read_chain, read_response
from fusion.recording.load import load_manifest

FREQUENCY = np.array([100.0, 1000.0, 4000.0])
DOC = (Path(__file__).resolve().parents[2] / "docs" / "recording-format.md").read_text(encoding="utf-8")


def _chain(folder: Path, *elements: str) -> Path:
    path = folder / "chain.toml"
    path.write_text("".join(f"[[element]]\n{element}\n" for element in elements), encoding="utf-8")
    return path


def test_the_example_of_the_format_is_a_chain(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text(re.findall(r"^```toml\n(.*?)^```", DOC, re.DOTALL | re.MULTILINE)[2], encoding="utf-8")
    response = read_response(path, FREQUENCY)
    assert len(read_chain(path).element) == 3
    b, a = signal.butter(4, 2.0 * np.pi * 10e3, analog=True)
    s = 2j * np.pi * FREQUENCY
    amplifier = s / ((s + 6.283) * (s + 628319.0))
    at = 2j * np.pi * 160.0
    amplifier = amplifier / abs(at / ((at + 6.283) * (at + 628319.0)))
    ratio = FREQUENCY / 32e3
    expected = amplifier * signal.freqs(b, a, 2.0 * np.pi * FREQUENCY)[1] * np.exp(-s * 8e-6)
    np.testing.assert_allclose(response.value, expected / (1.0 - ratio**2 + 0.04j * ratio), rtol=1e-9)
    assert {"gain of charge amplifier", "delay of anti-alias filter"} <= set(response.causes)


def test_the_format_lists_every_key_of_an_element() -> None:
    section = DOC[DOC.index("| key of `[[element]]`") : DOC.index("## Every key")]
    told = [line.split("`")[1] for line in section.splitlines()[2:] if line.startswith("| `")]
    assert told == list(Element.model_fields)


@pytest.mark.parametrize(
    ("element", "key", "words"),
    [
        ("filter = 'butterworth'\norder = 4", "element[1].corner", "this key, required for filter"),
        ("filter = 'butterworth'\ncorner = 1e3", "element[1].order", "required"),
        ("filter = 'cauer'\norder = 4\ncorner = 1e3", "element[1].filter", "'butterworth', 'bessel' or 'resonance'"),
        ("filter = 'bessel'\norder = 40\ncorner = 1e3", "element[1].order", "at most 12"),
        ("filter = 'resonance'\ncorner = 1e3", "element[1].damping", "required"),
        ("filter = 'resonance'\ncorner = 1e3\ndamping = 0.1\norder = 3", "element[1].order", "order 2"),
        ("filter = 'bessel'\norder = 4\ncorner = 1e3\npoles = [[-1, 0]]", "element[1].poles", "no such key"),
        ("corner = 1e3", "element[1].corner", "no such key for an element without filter"),
        ("poles = [[-1, 2]]", "element[1].poles", "conjugate"),
        ("poles = [[1, 0]]", "element[1].poles", "at most 0"),
        ("poles = [1, 0]", "element[1].poles", "2 rows of 2 numbers"),
        ("poles = 3", "element[1].poles", "rows of 2 numbers"),
        ("gain = 0.0", "element[1].gain", "other than 0"),
        ("gain = nan", "element[1].gain", "finite"),
        ("gian = 1.0", "element[1].gian", 'probably "gain"'),
        ("gain_uncertainty = -1", "element[1].gain_uncertainty", "at least 0"),
        ("zeros = [[0, 0]]\ngain_at = 0.0", "element", "other than a zero or a pole"),
        ("gain = ", "", "TOML"),
    ],
)
def test_a_wrong_element_is_one_sentence_with_its_key(tmp_path: Path, element: str, key: str, words: str) -> None:
    path = _chain(tmp_path, element)
    with pytest.raises(InputError) as caught:
        read_response(path, FREQUENCY)
    assert caught.value.file == path
    assert caught.value.key == key
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_chain_without_elements_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.toml"
    path.write_text("format = 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="element: expected this key"):
        read_chain(path)


@pytest.mark.parametrize("column", ["u_magnitude", "u_phase_rad"])
def test_negative_uncertainties_are_refused(tmp_path: Path, column: str) -> None:
    names = "frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad"
    row = ",".join("-1" if name == column else "1" for name in names.split(","))
    path = tmp_path / "table.csv"
    path.write_text(f"{names}\n{row}\n", encoding="utf-8")
    with pytest.raises(InputError, match=f"{column}: expected no negative values, found -1"):
        read_response(path, np.array([1.0]))


def test_check_says_which_response_cannot_be_read(make_campaign: Callable[..., Path]) -> None:
    folder = make_campaign()
    (folder / "bridge-response.csv").write_text("frequency_hz,magnitude\n1,1\n", encoding="utf-8")
    problems = check(load_manifest(folder)).problems
    assert any("bridge-response.csv: phase_rad: expected this column" in problem for problem in problems)
