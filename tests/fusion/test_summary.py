"""What the command prints of a sensitivity: U with its own coverage factor, and no phase of what may be zero."""

from __future__ import annotations

import csv
import io

import pytest
from evaluation_factory import make_evaluation
from rich.console import Console

from fusion.campaign.run import sensitivity_table
from fusion.estimation.uncertainty import coverage_factor
from fusion.report.csv_files import SENSITIVITY_FILE, result_tables, row_element, sensitivity_element


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    return list(
        csv.DictReader(io.StringIO(result_tables(make_evaluation(tmp_path_factory.mktemp("a")))[SENSITIVITY_FILE]))
    )


def test_a_row_reads_back_as_the_element_it_was_made_of(rows, tmp_path):
    found = make_evaluation(tmp_path).sensitivity
    assert row_element(rows[2]) == sensitivity_element(found, 0, 2, 2)


def test_printed_values(rows):
    few = rows[2] | {"dof": "4.0"}
    weak = rows[0] | {"re": "1e-11", "im": "0.0", "u_re": "2e-11", "u_im": "1e-11", "r": "0.0", "dof": "inf"}
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(sensitivity_table([rows[2], few, weak]))
    text = console.export_text()
    assert "(1.9720 ± 0.0019)e-7" in text
    expanded = coverage_factor(4.0) * float(few["u_magnitude"]) * 1e7
    assert f"(1.9720 ± {expanded:.4f})e-7" in text
    assert "2.78" in text
    assert "(region ± 4.9, ± 2.4)e-11" in text
    assert "not distinguishable from 0" in text
    assert "2.45" in text
