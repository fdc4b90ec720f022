"""`shakercal validate`: its references can be made again without the program, and what is wrong is found."""

from __future__ import annotations

import ast
import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import validation_references

from fusion.cli import main
from fusion.planning.validation import validation_run as validation
from fusion.planning.validation.validation_run import CASES

KNOWN: dict[str, Any] = json.loads(validation.REFERENCES.read_text(encoding="utf-8"))


def test_references_are_made_again_by_a_script_that_knows_nothing_of_the_program():
    tree = ast.parse(Path(validation_references.__file__).read_text(encoding="utf-8"))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {name.split(".")[0] for name in imported} & {"photogram", "shaker", "fusion"}
    pytest.importorskip("mpmath")
    made = validation_references.references()
    assert list(made) == list(KNOWN) == list(CASES)
    for name, case in made.items():
        assert case["expected"].keys() == KNOWN[name]["expected"].keys()
        for quantity, told in case["expected"].items():
            known = KNOWN[name]["expected"][quantity]
            assert abs(told["value"] - known["value"]) <= 0.01 * known["tolerance"], quantity
            assert told["tolerance"] == pytest.approx(known["tolerance"], rel=1e-6)
            assert told["unit"] == known["unit"]
        for key, value in case["inputs"].items():
            stored = KNOWN[name]["inputs"][key]
            if (
                isinstance(value, list)
                and not isinstance(np.ravel(np.array(value, dtype=object))[0], str)
                and key != "rounding"
            ):
                assert np.allclose(value, stored, rtol=1e-12, atol=0.0), key
            else:
                assert value == stored, key


def test_package_data_stay_small():
    assert sum(path.stat().st_size for path in validation.REFERENCES.parent.glob("*.json")) < 1_000_000


def test_this_installation_passes_and_leaves_a_file_and_a_page(tmp_path, capsys):
    folder = tmp_path / "validation"
    assert main(["validate", "-o", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "passed" in printed
    told = json.loads((folder / "validation.json").read_text())
    assert told["passed"] is True
    assert [case["name"] for case in told["cases"]] == list(CASES)
    assert all(abs(q["found"] - q["expected"]) <= q["tolerance"] for case in told["cases"] for q in case["quantities"])
    assert len(told["installation"]["sha256"]) == 64
    assert told["installation"]["sha256"] in printed.replace("\n", "")
    assert {"shakercal", "python", "numpy", "scipy", "platform"} <= told["installation"]["versions"].keys()
    page = (folder / "validation.html").read_text()
    assert "Software validation" in page
    assert "left x of point 4" in page
    assert main(["validate", "-o", str(folder)]) == 2
    assert "--force" in capsys.readouterr().err


def test_a_deviation_beyond_its_tolerance_and_a_case_that_fails_are_told(tmp_path, monkeypatch, capsys):
    found = validation.validate()
    assert all(case.worst < 0.5 for case in found.cases)
    wrong = copy.deepcopy(KNOWN)
    shifted = wrong["matrix"]["expected"]["re Fz/Fz"]
    shifted["value"] += 1.01 * shifted["tolerance"]

    def broken(inputs: object) -> dict[str, float]:
        raise ArithmeticError("nothing converges")

    monkeypatch.setitem(CASES, "step", broken)
    monkeypatch.setitem(CASES, "sines", lambda inputs: {})
    found = validation.validate(wrong)
    assert [case.name for case in found.cases if not case.passed] == ["sines", "step", "matrix"]
    assert not found.passed
    assert [q.quantity for q in found.cases[6].quantities if not q.passed] == ["re Fz/Fz"]
    assert math.isnan(found.cases[0].quantities[0].found)
    told = json.loads(validation.validation_json(found))
    assert told["cases"][4]["failure"].startswith("ArithmeticError: ")
    assert told["cases"][0]["quantities"][0]["found"] is None
    assert "nothing converges" in validation.render_validation(found)
    assert main(["validate"]) == 1
    assert "FAILED" in capsys.readouterr().out


def test_files_that_are_not_those_of_the_package_fail(monkeypatch):
    monkeypatch.setattr(validation, "CASES", {})
    monkeypatch.setattr(validation, "_recorded", lambda root: iter([("shaker/labels.py", "another")]))
    found = validation.validate()
    assert found.installation.verdict == "changed"
    assert "shaker/labels.py" in found.installation.changed
    assert not found.passed
