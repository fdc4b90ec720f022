"""What a stated static sensitivity, the sign of a result, its size and its triggers say of the manifest."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
from bench_factory import ACCELERATION, FORCE_OUTPUT, Bench, write_bench
from support import block, channel, evaluated

from fusion.phasors.phasor_notices import INVERTED_TRIGGER
from fusion.planning.look.look import look
from fusion.recording.recording_notices import CONVERTER_CODES, OUTPUT_EXCEEDS_SUPPLY
from fusion.sensitivity.sensitivity_notices import OUTPUT_CONTRADICTS, OUTPUT_OPPOSES_LOAD
from shakercal._common.notices import Notice

STATIC = [[0.0, 0.0, 2e-6, 0.0, 0.0, 0.0]]
ACC = Bench(ACCELERATION, "m/s^2", keys={"scale": 1.0, "scale_uncertainty": 1e-3})


def warned(folder) -> list[Notice]:
    return [notice for notice in evaluated(folder).notices if notice.severity == "warning"]


@pytest.mark.parametrize("more", [{}, {"cross_talk": 0.02, "capacity": [1e3, 1e3, 1e3, 1e2, 1e2, 1e2]}])
@pytest.mark.parametrize(
    ("acc", "output", "factor"),
    [
        (ACC, FORCE_OUTPUT, None),
        (replace(ACC, keys={**ACC.keys, "direction": [0.0, 0.0, -1.0]}), FORCE_OUTPUT, "sign"),
        (replace(ACC, phasor=0.01 * ACCELERATION), FORCE_OUTPUT, "100"),
        (ACC, replace(FORCE_OUTPUT, phasor=1.2 * FORCE_OUTPUT.phasor), None),
    ],
)
def test_a_main_element_far_from_its_static_value_is_named(tmp_path, more, acc, output, factor):
    """Also of a sensor of which no cross-talk is stated, so that there is no matrix to compare outputs with."""
    found = warned(write_bench(tmp_path, {"acc": acc, "Fz": output}, sensor={"static_sensitivity": STATIC, **more}))
    contradictions = [notice for notice in found if notice.code == OUTPUT_CONTRADICTS.code]
    assert [factor in notice.values["outputs"] for notice in contradictions] == ([] if factor is None else [True])


@pytest.mark.parametrize(
    ("acc", "output", "declared", "values"),
    [
        (replace(ACC, keys={**ACC.keys, "direction": [0.0, 0.0, -1.0]}), FORCE_OUTPUT, OUTPUT_OPPOSES_LOAD,
         {"output": "Fz", "phase_rad": pytest.approx(np.pi - 0.05, abs=1e-3)}),
        *((replace(ACC, unit=unit), FORCE_OUTPUT, CONVERTER_CODES,
           {"key": "daq.daq.channel.acc.scale", "unit": unit, "quantity_unit": "m/s^2"}) for unit in ("counts", "LSB")),
        (ACC, replace(FORCE_OUTPUT, phasor=2.5 * ACCELERATION), OUTPUT_EXCEEDS_SUPPLY,
         {"key": "daq.daq.channel.Fz.scale", "amplitude": pytest.approx(125.0, rel=1e-4)}),
    ],
)  # fmt: skip
def test_without_a_static_value_sign_codes_and_size_are_reported(tmp_path, acc, output, declared, values):
    folder = write_bench(tmp_path, {"acc": acc, "Fz": output})
    (notice,) = (notice for notice in warned(folder) if notice.code == declared.code)
    assert notice.values == values
    assert look(folder).level != "good"


@pytest.mark.parametrize("inverted", [False, True])
def test_a_trigger_that_is_inverted_in_one_block_is_named(tmp_path, inverted):
    folder = write_bench(tmp_path, {"acc": ACC, "Fz": FORCE_OUTPUT})
    text = (folder / "recording.toml").read_text(encoding="utf-8")
    with h5py.File(folder / "daq.h5", "a") as first, h5py.File(folder / "other.h5", "w") as other:
        first["sync"] = ((np.arange(10_000) / 10e3 + 1e-4) % 0.02 < 0.003).astype(float)
        other.attrs["sample_rate"] = 9973.0
        time = np.arange(10_000) / 9973.0
        other["sync"] = (((time + 1e-4) % 0.02 < 0.003) ^ inverted).astype(float)
        other["U"] = np.cos(2.0 * np.pi * 106.25 * time)
    text += channel("sync", "trigger") + block("[daq]", name="other", file="other.h5", first_edge=0)
    text += channel("sync", "trigger") + channel("U", "voltage")
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    assert any(notice.code == INVERTED_TRIGGER.code for notice in warned(folder)) == inverted
