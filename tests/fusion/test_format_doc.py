"""docs/recording-format.md and the models say the same: every key, whether it is required, its default."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry, Daq, Excitation, Images, PointFiles, RecordingFile, Take
from fusion.recording.rig import Administration, Environment, Load, Part, Rig, Sensor, Stereo
from photogram.calibration.file import read_calibration

DOC = (Path(__file__).resolve().parents[2] / "docs" / "recording-format.md").read_text(encoding="utf-8")
MODELS: dict[str, type[BaseModel]] = {
    "Top level of rig.toml": Rig,
    "`[sensor]`": Sensor,
    "`[load]`": Load,
    "`[[part]]`, in rig.toml or recording.toml": Part,
    "`[environment]`": Environment,
    "`[stereo.NAME]`": Stereo,
    "`[administration]`": Administration,
    "Top level of recording.toml": RecordingFile,
    "`[excitation]`": Excitation,
    "`[[daq]]`": Daq,
    "`[[daq.channel]]`": ChannelEntry,
    "`[[images]]`": Images,
    "`[[points]]`": PointFiles,
    "`[[take]]`": Take,
}


def _tables() -> dict[str, dict[str, str]]:
    """Title -> key -> second column of every table of the section on keys."""
    section = DOC[DOC.index("## Every key") : DOC.index("## What a run leaves")]
    parts = re.split(r"^### (.*)$", section, flags=re.MULTILINE)[1:]
    rows = re.compile(r"^\| `(\w+)` \| (.*?) \|", re.MULTILINE)
    return {title: dict(rows.findall(text)) for title, text in zip(parts[::2], parts[1::2], strict=True)}


def _told(model: type[BaseModel], key: str) -> str:
    """What the document's second column has to say about a key of a model."""
    field = model.model_fields[key]
    if key in getattr(model, "INHERITED", ()):
        return "as the pair"
    if field.is_required():
        return "required"
    default: Any = field.get_default(call_default_factory=True)
    if default is None:
        return "optional"
    if isinstance(default, str | bool | int | float):
        return f"`{json.dumps(default)}`" if isinstance(default, str | bool) else f"{default:g}"
    assert not np.any(default)
    if len(default) == 0:
        return "none"
    return "0" if "uncertainty" in key and key != "pose_uncertainty" else "zeros"


def test_every_block_has_a_table() -> None:
    assert list(_tables()) == list(MODELS)


@pytest.mark.parametrize("title", list(MODELS))
def test_the_table_of_a_block_is_its_model(title: str) -> None:
    model = MODELS[title]
    assert _tables()[title] == {key: _told(model, key) for key in model.model_fields}


def test_every_toml_example_is_toml_that_loads(make_campaign: Callable[..., Path]) -> None:
    examples = re.findall(r"^```toml\n(.*?)^```", DOC, re.DOTALL | re.MULTILINE)
    rig, recording, chain = (tomllib.loads(text) for text in examples)
    assert len(chain["element"]) == 3  # tests/fusion/test_response.py reads it
    manifest = load_manifest(make_campaign())
    given = {key: value for key, value in rig["stereo"]["top"].items() if key != "calibration"}
    loaded = manifest.rig.stereo["top"].model_dump(mode="json", include=set(given))
    assert loaded == given
    assert [daq["name"] for daq in recording["daq"]] == [daq.name for daq in manifest.daq]


def test_the_calibration_example_is_a_calibration(make_campaign: Callable[..., Path]) -> None:
    calibration = load_manifest(make_campaign()).rig.stereo["top"].calibration
    assert calibration is not None
    rig = read_calibration(calibration)
    np.testing.assert_array_equal(rig.right_from_left.translation_m, [-0.15, 0, 0])
