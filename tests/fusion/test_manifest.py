"""Manifests of recording folders, compared with the document of the format."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from support import DOCS, documented_keys, draft_example, example_with, examples, key_tables

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.environment import Environment
from fusion.recording.excitation import KINDS, ExcitationEntry
from fusion.recording.instruments import ChannelDefaults, Instrument
from fusion.recording.load import find_recordings, load_manifest
from fusion.recording.manifest import ChannelEntry, Daq, Images, PointFiles, RecordingFile, ResponseColumns, Take
from fusion.recording.recording_notices import (
    CERTIFICATE_EXPIRED,
    INVALID_UNCERTAINTY_STATEMENT,
    KEY_NOT_APPLICABLE,
    NO_RECORDING,
    UNKNOWN_KEY,
)
from fusion.recording.rig import (
    Elastic,
    ElasticMode,
    InstrumentHead,
    ModelChange,
    ModelChanges,
    Rig,
    RigAdministration,
    RigLoad,
    RigPart,
    Sensor,
    Shaker,
    Stereo,
    TemperatureChange,
)
from fusion.recording.toml import expand_statements, uncertain_inputs
from fusion.recording.values import SensorOfCamera, SurfacePlane
from photogram.calibration.calibration_file import read_calibration

Campaign = Callable[..., Path]


def sized(most: float, least: float = 1e-30) -> st.SearchStrategy[float]:
    """Numbers of either sign and of any size that a manifest may hold."""
    return st.floats(-most, most).filter(lambda value: value == 0.0 or abs(value) >= least)


FINITE = sized(100.0)
SMALL = st.floats(0.0, 3.0).filter(lambda value: value == 0.0 or value >= 1e-30)


def test_the_example_of_the_format_loads_with_its_values(make_campaign):
    folder = make_campaign()
    manifest = load_manifest(folder)
    assert manifest.name == "Fz 106.25 Hz"
    assert manifest.excitation.frequencies == (106.25,)
    assert manifest.rig.load.mass == 6.9605
    assert manifest.rig.load.centre_of_mass_uncertainty == (1e-4, 1e-4, 1e-4)
    assert [daq.name for daq in manifest.daq] == ["vibrometer", "bridge"]
    assert manifest.daq[0].file == (folder / "vibrometer.h5").resolve()
    assert manifest.daq[0].channel[0].point_uncertainty == (1e-3,) * 3
    assert manifest.part == manifest.rig.part
    assert manifest.root == folder.parent.resolve()
    assert manifest == load_manifest(folder / "recording.toml")
    assert [file.name for file in manifest.points[0].files] == ["result_B1.txt", "result_B2.txt", "result_B10.txt"]
    present = {path.resolve() for path in folder.parent.rglob("*") if path.is_file()}
    assert sorted(manifest.files) == sorted(present)
    with pytest.raises(ValueError, match="frozen"):
        manifest.rig.stereo["top"].delay = 1.0


OWN = 'right = "top-right/*.tif"'


@pytest.mark.parametrize(
    ("change", "of_pair", "of_frames"),
    [
        (("rig.toml", "", ""), 40e-6, (40e-6, 0.0, 1e-6, 12)),
        (
            ("recording.toml", OWN, f"{OWN}\nexposure = 10e-6\ndelay = 5e-6\nbit_depth = 10"),
            40e-6,
            (10e-6, 5e-6, 1e-6, 10),
        ),
        (("rig.toml", "exposure = 40e-6", 'exposure = "pulse"'), "pulse", ("pulse", 0.0, 1e-6, 12)),
        (("recording.toml", OWN, f'{OWN}\nexposure = "pulse"'), 40e-6, ("pulse", 0.0, 1e-6, 12)),
    ],
)
def test_frames_take_the_exposure_of_their_pair_unless_they_override_it(make_campaign, change, of_pair, of_frames):
    manifest = load_manifest(make_campaign(replace=(change,)))
    own = manifest.images[0]
    assert manifest.rig.stereo["top"].exposure == of_pair
    assert (own.exposure, own.delay, own.delay_uncertainty, own.bit_depth) == of_frames


def test_globs_do_not_recurse_and_match_case(make_campaign):
    folder = make_campaign()
    for name in ("top-left/deeper/0009.tif", "top-left/0003.TIF", "top-left/.0004.tif"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    assert len(load_manifest(folder).images[0].left) == 3


@pytest.mark.parametrize(("file", "outside"), [("run[1].h5", False), ("../../elsewhere.h5", True)])
def test_a_path_may_look_like_a_pattern_or_lead_outside_on_request(make_campaign, file, outside):
    folder = make_campaign(replace=(("recording.toml", '"vibrometer.h5"', f'"{file}"'),))
    (folder / file).write_bytes(b"")
    assert load_manifest(folder, allow_outside=outside).daq[0].file == (folder / file).resolve()


def test_mraw_belongs_to_the_input_files(make_campaign):
    changes = (("recording.toml", "top-left/*.tif", "left.cih"), ("recording.toml", "top-right/*.tif", "right.cih"))
    folder = make_campaign(replace=changes)
    for name in ("left.cih", "left.mraw", "right.cih", "right.mraw"):
        (folder / name).write_bytes(b"")
    manifest = load_manifest(folder)
    assert len(manifest.images[0].left) == 1
    assert {"left.mraw", "right.mraw"} <= {file.name for file in manifest.files}


def test_a_campaign_lists_its_recordings_in_natural_order(tmp_path):
    for name in ("Fz-100", "Fz-20", "notes"):
        (tmp_path / name).mkdir()
        if name != "notes":
            (tmp_path / name / "recording.toml").write_text("", encoding="utf-8")
    assert [path.parent.name for path in find_recordings(tmp_path)] == ["Fz-20", "Fz-100"]
    assert find_recordings(tmp_path / "Fz-20") == [tmp_path / "Fz-20" / "recording.toml"]
    for name in ("notes", "absent"):
        with pytest.raises(InputError) as caught:
            find_recordings(tmp_path / name)
        assert (caught.value.code, caught.value.file) == (NO_RECORDING.code, tmp_path / name)


def test_directions_become_unit_vectors():
    entry = ChannelEntry(name="a", quantity="acceleration", body="load", point=(0, 0, 0), direction=(0, 3.0, 4.0))
    np.testing.assert_allclose(entry.direction or (), (0, 0.6, 0.8), rtol=1e-15)


def test_conventional_mass_is_converted_by_the_definition_of_oiml_d28():
    """A conventional mass balances the weight of 8000 kg/m^3 in air of 1.2 kg/m^3."""
    load = RigLoad(
        mass=2.0, mass_kind="conventional", density=2700.0, centre_of_mass=(0, 0, 0), inertia=np.zeros((3, 3)).tolist()
    )
    pull_of_load = load.true_mass * (1 - 1.2 / 2700.0)
    assert pull_of_load == pytest.approx(2.0 * (1 - 1.2 / 8000.0), rel=1e-15)
    assert load.model_copy(update={"mass_kind": "true"}).true_mass == 2.0


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    translation=st.tuples(FINITE, FINITE, FINITE),
    spread=st.tuples(*[SMALL] * 6),
    exposure=SMALL,
    scale=FINITE.filter(bool),
    mass=st.floats(0.01, 20.0),
)
def test_numbers_come_back_bit_for_bit(make_campaign, translation, spread, exposure, scale, mass):
    changes = (
        ("rig.toml", "translation = [0.0, 0.0, 0.30]", f"translation = {list(translation)}"),
        ("rig.toml", "pose_uncertainty = [1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]", f"pose_uncertainty = {list(spread)}"),
        ("rig.toml", "exposure = 40e-6", f"exposure = {exposure!r}"),
        ("rig.toml", "mass = 6.9605", f"mass = {mass!r}"),
        ("recording.toml", "scale = 0.125", f"scale = {scale!r}"),
    )
    manifest = load_manifest(make_campaign(replace=changes))
    pair = manifest.rig.stereo["top"]
    assert (pair.translation, pair.pose_uncertainty) == (translation, spread)
    assert (manifest.images[0].exposure, manifest.daq[0].channel[0].scale) == (exposure, scale)
    assert manifest.rig.load.mass == mass


DOC = (DOCS / "recording-format.md").read_text(encoding="utf-8")
MODELS: dict[str, type[BaseModel]] = {
    "Top level of rig.toml": Rig,
    "`[sensor]`": Sensor,
    "`[load]`": RigLoad,
    "`[[part]]`, in rig.toml or recording.toml": RigPart,
    "`[environment]`": Environment,
    "`[stereo.NAME]`": Stereo,
    "`[stereo.NAME.left]` and `[stereo.NAME.right]`": SensorOfCamera,
    "`[stereo.NAME.surface]`": SurfacePlane,
    "`[head.NAME]`": InstrumentHead,
    "`[shaker]`, in rig.toml or recording.toml": Shaker,
    "`[model]`": ModelChanges,
    "`[model.mounting]`, `[model.load]`, `[model.structure]`": ModelChange,
    "`[model.temperature]`": TemperatureChange,
    "`[administration]`": RigAdministration,
    "Top level of recording.toml": RecordingFile,
    "`[[acknowledged]]`": Acknowledgement,
    "`[excitation]`": ExcitationEntry,
    "`[[daq]]`": Daq,
    "`[[daq.channel]]`": ChannelEntry,
    "`response_columns` of a channel": ResponseColumns,
    "`[instrument.NAME]` of instruments.toml": Instrument,
    "`[[images]]`": Images,
    "`[[points]]`": PointFiles,
    "`[[take]]`": Take,
    "`[[load.elastic]]`": Elastic,
    "`[[load.elastic.mode]]`": ElasticMode,
}
"""In the order of recording-format.md, then of elastic.md."""


def test_every_block_has_a_table_that_is_its_model():
    tables = key_tables(DOC[DOC.index("## Every key") : DOC.index("## Response files")])
    elastic = (DOCS / "elastic.md").read_text(encoding="utf-8")
    tables |= key_tables(elastic[elastic.index("## Keys") :])
    assert tables.pop("`[daq.defaults]`") == {}
    expected = documented_keys(MODELS)
    library = expected["`[instrument.NAME]` of instruments.toml"]
    for key in ChannelDefaults.model_fields:
        del library[key]
    assert tables == expected
    assert list(tables) == list(MODELS)
    section = DOC[DOC.index("### `[daq.defaults]`") : DOC.index("### `[[daq.channel]]`")]
    assert re.findall(r"`(\w+)`", section[section.index("Its keys are") :]) == list(ChannelDefaults.model_fields)


def test_every_toml_example_is_toml_that_loads(make_campaign):
    every = [tomllib.loads(text) for text in examples(DOC)]
    rig, recording = (tomllib.loads(draft_example(name)) for name in ("rig.toml", "recording.toml"))
    (columns,) = (channel for text in every for channel in _channels(text) if "response_columns" in channel)
    assert ResponseColumns(**columns["response_columns"]).k == 2.0
    (elastic,) = (text["load"]["elastic"][0] for text in every if "elastic" in text.get("load", {}))
    assert Elastic(**elastic).shape == "rod"
    (acknowledged,) = (text["acknowledged"][0] for text in every if "acknowledged" in text)
    assert Acknowledgement(**acknowledged).code == "SC-485"
    (surface,) = (pair["surface"] for text in every for pair in text.get("stereo", {}).values() if "surface" in pair)
    assert SurfacePlane(**surface).normal == (0.0, 1.0, 0.0)
    (camera,) = (pair["left"] for text in every for pair in text.get("stereo", {}).values() if "left" in pair)
    assert camera.keys() <= SensorOfCamera.model_fields.keys()
    (take,) = (text["take"][0] for text in every if "take" in text)
    channels = [ChannelEntry(**channel) for channel in take["daq"][0]["channel"]]
    assert [channel.reference for channel in channels] == [False, True]
    manifest = load_manifest(make_campaign())
    pair = manifest.rig.stereo["top"]
    given = {key: value for key, value in rig["stereo"]["top"].items() if key != "calibration"}
    assert pair.model_dump(mode="json", include=set(given)) == given
    assert [daq["name"] for daq in recording["daq"]] == [daq.name for daq in manifest.daq]
    certified = tomllib.loads(example_with("recording-format.md", "U = "))
    assert uncertain_inputs(certified, Path("rig.toml"))[0].u == manifest.rig.load.mass_uncertainty
    np.testing.assert_array_equal(read_calibration(pair.calibration).right_from_left.translation_m, [-0.15, 0, 0])


def _channels(text):
    """Channels of an example, which may begin at `[[daq.channel]]`."""
    blocks = text.get("daq", [])
    return [channel for daq in (blocks if isinstance(blocks, list) else [blocks]) for channel in daq.get("channel", [])]


def test_the_minimal_recording_of_the_document_gives_the_printed_result(tmp_path, capsys):
    """Laser and output of a sensor of 7·10⁻⁷ (V/V)/N at 80 Hz, as the document prints it: U and all digits."""
    rig, recording = examples(DOC)[:2]
    folder = tmp_path / "Fz-0080"
    folder.mkdir()
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    (folder / "recording.toml").write_text(recording, encoding="utf-8")
    time_s, noise = np.arange(20000) / 5000.0, np.random.default_rng(1)
    phase, acceleration = 2.0 * np.pi * 80.0 * time_s, 20.0
    velocity = acceleration / (2.0 * np.pi * 80.0) * np.sin(phase) + 2e-5 * noise.normal(size=20000)
    force = -(2.4063 + 0.214) * acceleration * np.cos(phase)
    output = 1e3 * 7e-7 * force + 1e-5 * noise.normal(size=20000)
    lines = [f"{t:.4f},{v:.6f},{o:.6f}" for t, v, o in zip(time_s, velocity, output, strict=True)]
    head = examples(DOC, "text")[0].splitlines()
    assert head[1:] == lines[: len(head) - 1]
    (folder / "recorder.csv").write_text("\n".join((head[0], *lines, "")), encoding="utf-8")
    assert main(["run", str(tmp_path), "-o", str(tmp_path / "out"), "-q"]) == 0
    (row,) = (line for line in DOC.splitlines() if line.startswith("│ 80.0000"))
    assert "(7.000 ± 0.012) × 10⁻⁷" in row
    assert row in capsys.readouterr().out


@pytest.mark.parametrize(
    ("key", "choices"), [("kind", KINDS), ("quantity", ChannelEntry.model_fields["quantity"].annotation.__args__)]
)
def test_the_document_names_every_kind_of_excitation_and_of_channel(key, choices):
    row = next(line for line in DOC.splitlines() if line.startswith(f"| `{key}` | required |"))
    assert set(row.rsplit("|", 2)[1].split()) == {f"`{choice}`" for choice in choices}


CASES = (
    # U/k, absolute and relative; half-widths over their divisors; relative keys; ν = 4: t = 2.776445 (JCGM 100, G.2)
    ({"mass": {"value": 5.0, "U": 0.002, "k": 2}}, {"mass": 5.0, "mass_uncertainty": 0.001}),
    ({"mass": {"value": 5.0, "U_relative": 4e-4, "k": 2}}, {"mass": 5.0, "mass_uncertainty": 0.001}),
    ({"scale": {"value": -0.5, "U": 0.001, "k": 2}}, {"scale": -0.5, "scale_uncertainty": 0.001}),
    (
        {"delay": {"value": 0.0, "U": 3e-6, "distribution": "uniform"}},
        {"delay": 0.0, "delay_uncertainty": 1.7320508e-6},
    ),
    ({"point_uncertainty": {"U": [2e-3, 4e-3, 0.0], "k": 2}}, {"point_uncertainty": [1e-3, 2e-3, 0.0]}),
    ({"mass": {"value": 5.0, "U": 2.776445, "k": 2.776445, "dof": 4}}, {"mass": 5.0, "mass_uncertainty": 1.416579}),
    # at an _uncertainty key: relative to the value, or unchanged if the key is relative
    ({"mass": 5.0, "mass_uncertainty": {"U_relative": 4e-4, "k": 2}}, {"mass": 5.0, "mass_uncertainty": 0.001}),
    ({"scale": 0.5, "scale_uncertainty": {"U_relative": 4e-4, "k": 2}}, {"scale": 0.5, "scale_uncertainty": 2e-4}),
    # the frequency of a mode is in Hz, and so is its uncertainty; that of a chain's poles is relative
    ({"frequency": {"value": 620.0, "U": 12.0, "k": 2}}, {"frequency": 620.0, "frequency_uncertainty": 6.0}),
    ({"frequency": {"value": 620.0, "U_relative": 0.02, "k": 2}}, {"frequency": 620.0, "frequency_uncertainty": 6.2}),
    ({"frequency_uncertainty": {"U_relative": 0.02, "k": 2}}, {"frequency_uncertainty": 0.01}),
    ({"step_amplitude": {"value": -50.0, "U": 0.5, "k": 2}}, {"step_amplitude": -50.0, "step_uncertainty": 0.005}),
)


@pytest.mark.parametrize(("table", "expected"), CASES)
def test_a_certificate_gives_value_and_standard_uncertainty(table, expected):
    values, (statement,) = expand_statements({"daq": [{"name": "a", **table}], "stereo": {"U": {}}}, Path("rig.toml"))
    own = {key: value for key, value in values["daq"][0].items() if key != "name"}
    assert own.keys() == expected.keys()
    for key, value in own.items():
        np.testing.assert_allclose(value, expected[key], rtol=1e-6)
    (key,) = (key for key, item in table.items() if isinstance(item, dict))
    assert statement.key == f"daq.a.{key}"


@pytest.mark.parametrize(
    ("line", "key", "declared"),
    [
        ("mass = { value = 6.9605, U = 0.002 }", "load.mass.k", INVALID_UNCERTAINTY_STATEMENT),
        (
            "mass = { value = 6.9605, U = 0.002, U_relative = 1e-3, k = 2 }",
            "load.mass.U",
            INVALID_UNCERTAINTY_STATEMENT,
        ),
        ("mass = { U = 0.002, k = 2 }", "load.mass.value", INVALID_UNCERTAINTY_STATEMENT),
        ("mass = { value = 6.9605, U = -1, k = 2 }", "load.mass.U", INVALID_UNCERTAINTY_STATEMENT),
        (
            "mass_uncertainty = { U_relative = 1e-3, k = 2 }",
            "load.mass_uncertainty.U_relative",
            INVALID_UNCERTAINTY_STATEMENT,
        ),
        (
            "mass = { value = 6.9605, U = 1, k = 2, date = 2026-03-02, valid_until = 2025-03-02 }",
            "load.mass.valid_until",
            INVALID_UNCERTAINTY_STATEMENT,
        ),
        ("mass = { value = 6.9605, U = 0.002, k = 2, from = 1 }", "load.mass.from", UNKNOWN_KEY),
        (
            "mass = { value = 6.9605, U = 1, k = 2, distribution = 'uniform' }",
            "load.mass.k",
            INVALID_UNCERTAINTY_STATEMENT,
        ),
        ("mass = { value = 6.9605, U = 1, k = 2 }\nmass_uncertainty = 1", "load.mass_uncertainty", KEY_NOT_APPLICABLE),
    ],
)
def test_an_incomplete_or_contradicting_certificate_is_refused(make_campaign, line, key, declared):
    changed = ("rig.toml", "mass = 6.9605", f"{line}\n#")
    folder = make_campaign(replace=(("rig.toml", "mass_uncertainty = 0.0010\n", ""), changed))
    with pytest.raises(InputError) as caught:
        load_manifest(folder)
    assert (caught.value.code, caught.value.key) == (declared.code, key)


def test_a_certificate_in_a_rig_is_used_listed_and_may_expire(make_campaign):
    stated = 'mass = { value = 6.9605, U = 0.002, k = 2, certificate = "M-117", valid_until = 2027-01-31 }\n#'
    day = ("recording.toml", 'rig = "../rig.toml"', 'rig = "../rig.toml"\ndate = 2027-02-01\noperator = "me"')
    folder = make_campaign(
        replace=(("rig.toml", "mass = 6.9605", stated), ("rig.toml", "mass_uncertainty = 0.0010\n", ""), day)
    )
    manifest = load_manifest(folder)
    assert (manifest.rig.load.mass, manifest.rig.load.mass_uncertainty) == (6.9605, 0.001)
    assert (manifest.operator, str(manifest.date)) == ("me", "2027-02-01")
    keys = [item.key for item in manifest.inputs]
    assert {"load.mass", "load.centre_of_mass", "stereo.top.pose", "daq.vibrometer.channel.velocity.scale"} <= set(keys)
    (notice,) = manifest.expiry_notices
    assert notice.code == CERTIFICATE_EXPIRED.code
    assert (notice.values["key"], notice.values["day"]) == ("load.mass", "2027-02-01")
    assert "M-117" in notice.values["source"]
    assert "2027-01-31" in notice.values["source"]


def test_a_recording_has_surroundings_of_its_own_and_gravity_follows_from_the_place(make_campaign):
    """PTB's gravity in Brunswick: 9.812526 m/s² at 52.2966° and 80 m, to the 5·10⁻⁵ of normal gravity."""
    of_the_place = "latitude = 52.2966\nheight = 80.0\ndown = [0.0, 0.0, -2.0]\n"
    rig = ("rig.toml", "gravity = [0.0, 0.0, -9.8125]           # points down\n", of_the_place)
    own = ("recording.toml", "[excitation]", "[environment]\npressure = 99000.0\ntemperature = 21.5\n\n[excitation]")
    around = load_manifest(make_campaign(replace=(rig, own))).rig.surroundings
    assert (around.temperature, around.pressure, around.air_density, around.latitude) == (21.5, 99000.0, 1.19, 52.2966)
    gravity, u = around.free_fall_mps2
    assert gravity[:2] == (0.0, 0.0)
    assert abs(gravity[2] + 9.812526) < 2.0 * u[2]
    # Keys that belong together may stand in either file; a table of one may replace a number of the other.
    halves = (
        (
            "rig.toml",
            "temperature = 23.0",
            "height = 80.0\nsensor_temperature = 20.0\nsensor_temperature_uncertainty = 1.0\n#",
        ),
        (
            "recording.toml",
            "[excitation]",
            "[environment]\nlatitude = 52.0\nsensor_temperature = { value = 24.0, U = 0.4, k = 2 }\n\n[excitation]",
        ),
    )
    manifest = load_manifest(make_campaign(replace=halves))
    around = manifest.rig.surroundings
    assert (around.height, around.latitude) == (80.0, 52.0)
    assert (around.sensor_temperature, around.sensor_temperature_uncertainty) == (24.0, 0.2)
    assert [item.u for item in manifest.inputs if item.key == "environment.sensor_temperature"] == [0.2]
    down = ("recording.toml", "[excitation]", "[environment]\ndown = [0.0, 0.0, -1.0]\n\n[excitation]")
    with pytest.raises(InputError) as caught:
        load_manifest(make_campaign(replace=(down,)))
    assert (caught.value.code, caught.value.key) == (KEY_NOT_APPLICABLE.code, "environment.down")
