"""Universal files that the program writes, read back by pyuff and by the reader."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyuff
from contracts import refused

from shaker.io.universal import UniversalFunction, UniversalShape, read_universal_functions, read_universal_shapes
from shaker.io.universal_write import universal_function, universal_nodes, universal_shape, universal_units

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open

UNEVEN = np.array([53.700012345678, 106.25, 310.0004893314857])
EVEN = 200.0 + 0.5 * np.arange(17)
RATE_HZ = 51_234.567
TITLES = ("output Fz over load Fz", "campaign", "NONE", "NONE", "NONE")


def function(x: np.ndarray, kind: str = "frequency response", seed: int = 1) -> UniversalFunction:
    rng = np.random.default_rng(seed)
    value = rng.standard_normal(len(x)) * 1e-7
    if kind != "time response":
        return UniversalFunction(
            "Fz/Fz", kind, x, value + 1j * value[::-1], "Hz", "(V/V)/(N)", "4", "1-RZ", TITLES
        )  # fmt: skip
    return UniversalFunction("velocity_1", kind, x, value, "s", "m/s", "3+Z", "0", TITLES)


def read(path: Path, content: bytes) -> list[dict[str, Any]]:
    path.write_bytes(universal_units() + content)
    return pyuff.UFF(str(path)).read_sets()[1:]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("x", [UNEVEN, EVEN, np.arange(3000) / RATE_HZ], ids=["uneven", "even", "time"])
def test_functions_come_back_with_their_numbers_and_headers(tmp_path, x, binary):
    written = function(x, "frequency response" if x[0] > 0 else "time response")
    (seen,) = read(tmp_path / "a.uff", universal_function(written, binary=binary))
    (function_read,) = read_universal_functions(tmp_path / "a.uff")
    digits = {"rtol": 0.0, "atol": 0.0} if binary else {"rtol": 1e-12, "atol": 1e-20}
    for value in (seen["data"], function_read.value):
        np.testing.assert_allclose(value, written.value, **digits)
    coarse = 1e-5 if not binary and x is UNEVEN else 0.0
    for abscissa in (seen["x"], function_read.abscissa):
        np.testing.assert_allclose(abscissa, x, rtol=max(coarse, 1e-12), atol=0.0 if x[0] > 0 else 0.01 / RATE_HZ)
    assert (function_read.name, function_read.unit, function_read.response, function_read.reference) == (
        written.name, written.unit, written.response, "0" if written.reference == "0" else "1-RZ",
    )  # fmt: skip
    assert function_read.titles[:2] == TITLES[:2]
    assert (seen["rsp_node"], seen["ref_dir"]) == ((3, 0) if written.kind == "time response" else (4, -6))
    assert seen["ordinate_axis_units_lab"].strip() == ("m/s" if written.kind == "time response" else "V/V")
    assert seen["func_type"] == (1 if written.kind == "time response" else 4)


def test_nodes_and_shapes_come_back(tmp_path):
    node, position_m = (
        np.array([1, 7, 12]),
        np.array([[0.0, 0.0, 0.0], [0.123456789012345, -0.5, 1e-9], [1.0, 2.0, 3.0]]),
    )
    value = np.random.default_rng(2).standard_normal((3, 6)).astype(complex)
    mode = UniversalShape(node, value, "normal mode", "displacement", 310.25, 0.02, np.nan, ("mode 1",))
    response = replace(mode, value=value[:, :3] * (1 + 2j), analysis="frequency response", damping_ratio=np.nan)
    content = universal_nodes(node, position_m) + universal_shape(mode, 1) + universal_shape(response, 2)
    nodes, first, second = read(tmp_path / "b.uff", content)
    assert nodes["type"] == 2411
    np.testing.assert_array_equal(nodes["node_nums"], node)
    np.testing.assert_array_equal(np.stack([nodes["x"], nodes["y"], nodes["z"]], axis=1), position_m)
    np.testing.assert_allclose(np.stack([first[f"r{i}"] for i in range(1, 7)], axis=1), value.real, rtol=1e-5)
    assert (first["freq"], first["modal_damp_vis"]) == (310.25, 0.02)
    np.testing.assert_allclose(np.stack([second[f"r{i}"] for i in (1, 2, 3)], axis=1), response.value, rtol=1e-5)
    back = read_universal_shapes(tmp_path / "b.uff")
    assert [shape.analysis for shape in back] == ["normal mode", "frequency response"]
    assert (back[0].frequency_hz, back[0].damping_ratio) == (310.25, 0.02)
    np.testing.assert_allclose(back[0].value, value, rtol=1e-5)
    np.testing.assert_allclose(back[1].value, response.value, rtol=1e-5)


def test_unsupported_content_is_refused_and_texts_fit_their_fields(tmp_path):
    refused("^response, reference: .*top", universal_function, replace(function(EVEN), response="top"))
    shape = UniversalShape(np.array([1]), np.zeros((1, 2), complex), "normal mode", "displacement", 1.0, 0.0, 0.0, ())
    refused("^shape: ", universal_shape, shape, 1)
    long = replace(function(EVEN), titles=("Kraftaufnehmer Größe 7 " + "x" * 90,), name="a name of many letters")
    (seen,) = read(tmp_path / "c.uff", universal_function(long))
    assert seen["id1"].startswith("Kraftaufnehmer Gr??e 7 x")
    assert seen["rsp_ent_name"].strip() == "a name of"
