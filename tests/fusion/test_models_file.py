"""models.json holds models to the last bit, and says what cannot be read."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.base import InputError
from fusion.sensor.models_file import MODELS_FILE, ModelEntry, ModelsFile, models_text, read_models
from shaker.lti.modal import ModalModel

SIZES = st.tuples(st.integers(1, 3), st.integers(0, 2))


def random_model(modes: int, reals: int, rng: np.random.Generator) -> ModalModel:
    """A stable model with a full covariance."""
    half = rng.standard_normal((4 * modes + 2 * reals,) * 2)
    return ModalModel(
        frequency_hz=100.0 * np.cumsum(1.0 + rng.random(modes)),
        damping_ratio=rng.uniform(1e-4, 0.9, modes),
        residue=rng.standard_normal(modes) + 1j * rng.standard_normal(modes),
        real_hz=1e3 * np.cumsum(1.0 + rng.random(reals)),
        real_residue=rng.standard_normal(reals),
        covariance=half @ half.T,
    )


def entry(model: ModalModel, channel: str = "Fz", component: str = "Fz") -> ModelEntry:
    """One entry of a file."""
    return ModelEntry(channel, component, "V/V", "pencil", model, 1e5, 3.3e-7, "a, b", 2.0)


@settings(max_examples=40, deadline=None)
@given(SIZES, st.integers(0, 2**32 - 1))
def test_a_model_comes_back_to_the_last_bit(sizes: tuple[int, int], seed: int) -> None:
    model = random_model(*sizes, np.random.default_rng(seed))
    file = ModelsFile("campaign µ", "sensor", "7", (entry(model), entry(model, "Fx")))
    with TemporaryDirectory() as folder:
        (Path(folder) / MODELS_FILE).write_text(models_text(file), encoding="utf-8")
        back = read_models(Path(folder))
    assert (back.name, back.sensor, back.serial) == ("campaign µ", "sensor", "7")
    found = back["Fz", "Fz"]
    assert np.array_equal(found.model.vector, model.vector)
    assert found.model.covariance is not None
    assert np.array_equal(found.model.covariance, np.asarray(model.covariance))
    assert (found.unit, found.method, found.sample_rate_hz, found.noise) == ("V/V", "pencil", 1e5, 3.3e-7)
    assert (found.recording, found.dof) == ("a, b", 2.0)


def test_a_file_knows_its_models() -> None:
    model = random_model(1, 0, np.random.default_rng(1))
    file = ModelsFile("c", "", "", (entry(model), entry(model, "Fx")))
    assert ("Fx", "Fz") in file
    assert ("Fx", "Fx") not in file
    assert [one.channel for one in file.driven] == ["Fz"]
    with pytest.raises(ValueError, match="expected one of Fz for Fz, Fx for Fz, found Mx for Mx"):
        file["Mx", "Mx"]


def test_poles_zeros_and_gain_for_other_programs_are_those_of_the_model() -> None:
    model = random_model(2, 1, np.random.default_rng(3))
    item = json.loads(models_text(ModelsFile("c", "", "", (entry(model),))))["models"][0]
    zeros, poles = (np.array([complex(*root) for root in item[name]]) for name in ("zeros", "poles"))
    s = 2j * np.pi * np.array([0.0, 37.0, 210.0, 900.0])
    by_roots = item["gain"] * np.prod(s[:, None] - zeros, axis=1) / np.prod(s[:, None] - poles, axis=1)
    assert by_roots == pytest.approx(model.response(s.imag / (2 * np.pi)), rel=1e-8)
    assert item["static_gain"] == model.static_gain


def without(*keys: Any) -> dict[str, Any]:
    """A good file with something taken out."""
    model = random_model(1, 1, np.random.default_rng(2))
    content: dict[str, Any] = json.loads(models_text(ModelsFile("c", "", "", (entry(model),))))
    place: Any = content
    for key in keys[:-1]:
        place = place[key]
    del place[keys[-1]]
    return content


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (without("models"), "no key 'models'"),
        (without("models", 0, "modes", 0, "damping_ratio"), "no key 'damping_ratio'"),
        ({**without("name"), "format": 2, "name": "c"}, "expected format 1"),
        (without("models", 0, "covariance", 0), r"covariance: expected an array of shape \(6, 6\)"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, content: dict[str, Any], told: str) -> None:
    path = tmp_path / MODELS_FILE
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match=told) as caught:
        read_models(path)
    assert caught.value.file == path


def test_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"models\.json: expected a file that can be read"):
        read_models(tmp_path)
