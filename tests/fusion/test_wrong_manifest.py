"""Wrong input at the manifest: every mistake is one sentence with file and key."""

from __future__ import annotations

import copy
import os
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import AT_ORIGIN, block, channel, recording_head

from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.recording.manifest import RecordingFile, RigContext
from fusion.recording.recording_notices import (
    CONTRADICTING_VALUES,
    FRAMES_DO_NOT_MATCH,
    IMPOSSIBLE_MASS_PROPERTIES,
    INVALID_SYNTAX,
    INVALID_VALUE,
    KEY_NOT_APPLICABLE,
    MISSING_FILE,
    MISSING_KEY,
    PATH_NOT_ALLOWED,
    REFERENCE_CHANNEL_REQUIRED,
    REPEATED_NAME,
    UNKNOWN_KEY,
    UNKNOWN_NAME,
    VALUE_OUT_OF_RANGE,
    WRONG_ENCODING,
    WRONG_VALUE_TYPE,
)
from fusion.recording.rig import Rig
from fusion.recording.toml import validate
from fusion.recording.values import PathScope
from shakercal._common.notices import DeclaredNotice

Campaign = Callable[..., Path]
RIG, RECORDING = "rig.toml", "recording.toml"
EYE = "rotation = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]"
INERTIA = "inertia = [[0.0360, 0.0, 0.0], [0.0, 0.0360, 0.0], [0.0, 0.0, 0.0310]]"
POINT = "point = [0.030, 0.0, 0.040]"
ROD = """[[load.elastic]]
name = "rod"
shape = "rod"
length = 0.15
diameter = 0.02
diameter_uncertainty = 0.001
young_modulus = 2e11
young_modulus_uncertainty = 4e9
density = 7850.0"""

CASES = [
    # file, old text, new text, key, declaration, part of the value found
    (RIG, "mass = 6.9605", "mass = 0.0", "load.mass", VALUE_OUT_OF_RANGE, "0"),
    (RIG, "mass = 6.9605", 'mass = "6.96"', "load.mass", WRONG_VALUE_TYPE, "6.96"),
    (RIG, "mass = 6.9605", "mass = true", "load.mass", WRONG_VALUE_TYPE, "true"),
    (RIG, "mass = 6.9605", "mass = nan", "load.mass", WRONG_VALUE_TYPE, "nan"),
    (RIG, "mass = 6.9605", "mas = 6.9605", "load.mas", UNKNOWN_KEY, ""),
    (RIG, "mass_uncertainty = 0.0010", "mass_uncertainty = -1.0", "load.mass_uncertainty", VALUE_OUT_OF_RANGE, "-1"),
    (RIG, "mass = 6.9605", 'mass = 6.9605\nmass_kind = "conventional"', "load.density", MISSING_KEY, ""),
    (
        RIG,
        INERTIA,
        INERTIA.replace("[0.0360, 0.0,", "[0.0360, 0.001,"),
        "load.inertia",
        IMPOSSIBLE_MASS_PROPERTIES,
        "0.001",
    ),
    (RIG, INERTIA, INERTIA.replace("0.0310", "0.0810"), "load.inertia", IMPOSSIBLE_MASS_PROPERTIES, "0.081"),
    (RIG, INERTIA, INERTIA.replace("0.0310", "-0.0310"), "load.inertia", IMPOSSIBLE_MASS_PROPERTIES, "-0.031"),
    (RIG, INERTIA, "inertia = [0.036, 0.036, 0.031]", "load.inertia", WRONG_VALUE_TYPE, "0.036"),
    (RIG, INERTIA + "   # about the centre of mass\n", "", "load.inertia", MISSING_KEY, ""),
    (RIG, "centre_of_mass = [0.0, 0.0, 0.010]", "centre_of_mass = [0.0, 0.010]", "part.", WRONG_VALUE_TYPE, "2"),
    (RIG, "mass = 0.412", "mass = 0", 'part."adapter plate".mass', VALUE_OUT_OF_RANGE, "0"),
    (RIG, 'body = "load"\nmass = 0.412', 'body = "Load"\nmass = 0.412', "part.", INVALID_VALUE, "Load"),
    (RIG, "internal_mass = 0.769", "internal_mass = [0.769]", "sensor.internal_mass", WRONG_VALUE_TYPE, ""),
    (RIG, 'sense = "on_load"', 'sense = "up"', "sensor.sense", INVALID_VALUE, "up"),
    (RIG, '"Fx", "Fy", "Fz"', '"Fx", "Fx", "Fz"', "sensor.channels", REPEATED_NAME, "Fx"),
    (RIG, "[2000.0, 2000.0,", "[2000.0,", "sensor.capacity", WRONG_VALUE_TYPE, "5"),
    (
        RIG,
        "internal_mass = 0.769",
        "internal_mass = 0.769\ncross_talk = -0.02",
        "sensor.cross_talk",
        VALUE_OUT_OF_RANGE,
        "-0.02",
    ),
    (RIG, "capacity = [2000.0, 2000.0,", "cross_talk = 0.02 # [", "sensor.capacity", MISSING_KEY, ""),
    (RIG, "  [5.1e-7, 0.0, 0.0, 0.0, 0.0, 0.0],\n", "", "sensor.static_sensitivity", CONTRADICTING_VALUES, "5"),
    (RIG, "-9.8125", "-98.1", "environment.gravity", VALUE_OUT_OF_RANGE, "98.1"),
    (RIG, "temperature = 23.0", "temperature = 296.15", "environment.temperature", VALUE_OUT_OF_RANGE, "296.15"),
    (
        RIG,
        "gravity = [0.0, 0.0, -9.8125]",
        "down = [0, 0, -1]",
        "environment.latitude",
        MISSING_KEY,
        "",
    ),
    (
        RIG,
        "[[part]]",
        f"{ROD}".replace("4e9", "2e11") + "\n[[part]]",
        "rod.young_modulus_uncertainty",
        VALUE_OUT_OF_RANGE,
        "2e+11",
    ),
    (
        RIG,
        "[[part]]",
        f"{ROD}".replace("4e9", "-4e9") + "\n[[part]]",
        "rod.young_modulus_uncertainty",
        VALUE_OUT_OF_RANGE,
        "-4000000000",
    ),
    (
        RIG,
        "[[part]]",
        f"{ROD}\nfrequencies_uncertainty = 2\n[[part]]",
        "rod.frequencies_uncertainty",
        VALUE_OUT_OF_RANGE,
        "2",
    ),
    (RIG, "[[part]]", f"{ROD}\ninner_diameter = 0.019\n[[part]]", "rod.inner_diameter", CONTRADICTING_VALUES, "0.019"),
    (RIG, EYE, EYE.replace("-1.0]]", "-1.001]]"), "stereo.top.rotation", INVALID_VALUE, "0.002"),
    (RIG, EYE, EYE.replace("-1.0]]", "1.0]]"), "stereo.top.rotation", INVALID_VALUE, "-1"),
    (RIG, "[1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]", "1e-4", "stereo.top.pose_uncertainty", WRONG_VALUE_TYPE, "0.0001"),
    (RIG, "[1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]", "[1e-4]", "stereo.top.pose_uncertainty", WRONG_VALUE_TYPE, "1"),
    (RIG, "scale_uncertainty = 2e-4 ", "#", "stereo.top.scale_uncertainty", MISSING_KEY, ""),
    (RIG, 'calibration = "calibration/top.json"', "", "stereo.top.calibration", MISSING_KEY, ""),
    (RIG, "calibration/top.json", "calibration/no.json", "stereo.top.calibration", MISSING_FILE, "no.json"),
    (RIG, "bit_depth = 12", "bit_depth = 12.0", "stereo.top.bit_depth", WRONG_VALUE_TYPE, "12.0"),
    (RIG, "bit_depth = 12", "bit_depth = 17", "stereo.top.bit_depth", VALUE_OUT_OF_RANGE, "17"),
    (RIG, "exposure = 40e-6", "exposre = 40e-6", "stereo.top.exposre", UNKNOWN_KEY, ""),
    (RIG, "exposure = 40e-6", 'exposure = "pulses"', "stereo.top.exposure", INVALID_VALUE, "pulses"),
    (RIG, "exposure = 40e-6", "exposure = -1e-6", "stereo.top.exposure", INVALID_VALUE, "-1e-06"),
    (RIG, "exposure = 40e-6", "exposure = nan", "stereo.top.exposure", INVALID_VALUE, "nan"),
    (RIG, "exposure = 40e-6", "exposure = true", "stereo.top.exposure", INVALID_VALUE, "true"),
    (RIG, "exposure = 40e-6", "exposure = 4e-5\nrow_time = 10", "top.row_time", VALUE_OUT_OF_RANGE, "10"),
    (RIG, "exposure = 40e-6", "exposure = 4e-5\nrow_time = [1e-5]", "top.row_time", WRONG_VALUE_TYPE, "1"),
    (RIG, "format = 1", "format = 2", "format", INVALID_VALUE, "2"),
    (RIG, "format = 1", "format = ", "", INVALID_SYNTAX, "1"),
    (RIG, "[sensor]", "[snsor]", "snsor", UNKNOWN_KEY, ""),
    (RECORDING, '"../rig.toml"', '"../rg.toml"', "rig", MISSING_FILE, "rg.toml"),
    (RECORDING, 'kind = "sine"', 'kind = "sinus"', "excitation.kind", INVALID_VALUE, "sinus"),
    (RECORDING, "[0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0]", "excitation.direction", INVALID_VALUE, ""),
    (RECORDING, "[0.0, 0.0, 1.0]", "[0.0, 1.0]", "excitation.direction", WRONG_VALUE_TYPE, "2"),
    (RECORDING, "[106.25]", "[]", "excitation.frequencies", WRONG_VALUE_TYPE, "0"),
    (RECORDING, "[106.25]", "[-106.25]", "excitation.frequencies", VALUE_OUT_OF_RANGE, "-106.25"),
    (RECORDING, "[106.25]", '["106.25"]', "excitation.frequencies", WRONG_VALUE_TYPE, "106.25"),
    (RECORDING, "frequencies = [106.25]", "", "excitation.frequencies", MISSING_KEY, ""),
    (RECORDING, 'harmonics = "auto"', 'harmonics = "all"', "excitation.harmonics", INVALID_VALUE, "all"),
    (RECORDING, 'harmonics = "auto"', "harmonics = [2, 0]", "excitation.harmonics", INVALID_VALUE, "0"),
    (RECORDING, 'harmonics = "auto"', "band = [1, 2]", "excitation.band", KEY_NOT_APPLICABLE, "2"),
    (RECORDING, "first_edge = 0 ", 'exposure = "strobe" ', "images.top.exposure", INVALID_VALUE, "strobe"),
    (RECORDING, '"vibrometer.h5"', '"vibro.h5"', "daq.vibrometer.file", MISSING_FILE, "vibro.h5"),
    (RECORDING, '"vibrometer.h5"', '"../../vibro.h5"', "daq.vibrometer.file", PATH_NOT_ALLOWED, "../../vibro.h5"),
    (RECORDING, '"vibrometer.h5"', '"/etc/passwd"', "daq.vibrometer.file", PATH_NOT_ALLOWED, "/etc/passwd"),
    (RECORDING, '"vibrometer.h5"', "'a\\b.h5'", "daq.vibrometer.file", PATH_NOT_ALLOWED, "a\\b.h5"),
    (RECORDING, '"vibrometer.h5"', '"recording.toml"', "daq.vibrometer.file", INVALID_VALUE, "recording.toml"),
    (RECORDING, 'name = "bridge"', 'name = "vibrometer"', "daq", REPEATED_NAME, "vibrometer"),
    (RECORDING, 'quantity = "velocity"', 'quantity = "speed"', "channel.velocity.quantity", INVALID_VALUE, "speed"),
    (
        RECORDING,
        POINT,
        'point = [0.010, -0.005, 0.62]\nhead = "psv"',
        "channel.velocity.point",
        CONTRADICTING_VALUES,
        "",
    ),
    (RECORDING, POINT, f'{POINT}\nhead = "pvs"', "channel.velocity.head", UNKNOWN_NAME, "psv"),
    (RECORDING, POINT, "", "daq.vibrometer.channel.velocity.point", MISSING_KEY, ""),
    (RECORDING, "scale = 0.125", "scale = 0", "channel.velocity.scale", VALUE_OUT_OF_RANGE, "0"),
    (RECORDING, "threshold = 2.5", "scale = 2.5", "channel.camera_trigger.scale", KEY_NOT_APPLICABLE, "2.5"),
    (RECORDING, 'channel = "Fz"', 'channel = "Fw"', "daq.bridge.channel.Fz.channel", UNKNOWN_NAME, "Fw"),
    (RECORDING, 'channel = "Fz"', "", "daq.bridge.channel.Fz.channel", MISSING_KEY, ""),
    (RECORDING, "bridge-response.csv", "no.csv", "daq.bridge.channel.Fz.response", MISSING_FILE, "no.csv"),
    (RECORDING, 'stereo = "top"', 'stereo = "tip"', "images.tip.stereo", UNKNOWN_NAME, "top, base"),
    (RECORDING, "top-left/*.tif", "top-left/*.png", "images.top.left", MISSING_FILE, "*.png"),
    (RECORDING, "top-left/*.tif", "**/*.tif", "images.top.left", PATH_NOT_ALLOWED, "**"),
    (
        RECORDING,
        "top-left/*.tif",
        "top-left/000[01].tif",
        "images.top.right",
        FRAMES_DO_NOT_MATCH,
        "2 left and 3 right",
    ),
    (RECORDING, "top-right/*.tif", "top-left/*.tif", "images.top.right", FRAMES_DO_NOT_MATCH, ""),
    (RECORDING, 'trigger = "camera_trigger"\nfirst', 'trigger = "x"\nfirst', "images.top.trigger", UNKNOWN_NAME, "x"),
    (RECORDING, "first_edge = 0", "first_edge = -1", "images.top.first_edge", VALUE_OUT_OF_RANGE, "-1"),
    (RECORDING, "first_edge = 0", "first_edge = 1.5", "images.top.first_edge", WRONG_VALUE_TYPE, "1.5"),
    (RECORDING, "first_edge = 0", "first_edge = {top = 1}", "images.top.first_edge", WRONG_VALUE_TYPE, "table"),
    (RECORDING, "first_edge = 0", "first_edge = [[1, 6]]", "images.top.first_edge", WRONG_VALUE_TYPE, "list of 1"),
    (RECORDING, "first_edge = 0", "first_edge = [[0, 6], 9]", "images.top.first_edge", WRONG_VALUE_TYPE, "list of 2"),
    (RECORDING, "first_edge = 0", "first_edge = [[0, 6], [0, 7]]", "images.top.first_edge", WRONG_VALUE_TYPE, "list"),
    (RECORDING, "first_edge = 0", "first_edge = {left = 1}", "images.top.first_edge", CONTRADICTING_VALUES, "left"),
    (RECORDING, '"x", "y", "z"]', '"x", "y"]', "points.base.columns", INVALID_VALUE, "id_x"),
    (RECORDING, '"id_x", "id_y"', '"id_x", "yid"', "points.base.columns", INVALID_VALUE, "yid"),
    (RECORDING, '"status", "status", "status"', '"_", "_", "_"', "points.base.columns", CONTRADICTING_VALUES, "id_x"),
    (
        RECORDING,
        "scale = 1e-3                            #",
        "scale = 0 #",
        "points.base.scale",
        VALUE_OUT_OF_RANGE,
        "0",
    ),
    (RECORDING, 'stereo = "base"', 'stereo = "top"', "images.top.stereo", REPEATED_NAME, "top"),
]


def _refused(folder: Path, file: str, key: str, declared: DeclaredNotice, found: str = "") -> InputError:
    """Assert that the manifest is refused in one sentence about a key of a file, and return the error."""
    with pytest.raises(InputError) as caught:
        load_manifest(folder)
    error, text = caught.value, str(caught.value)
    assert (error.file.name, error.code) == (file, declared.code), text
    assert key in error.key, text
    assert found in str(error.values["found"]), text
    assert "\n" not in text
    assert text.startswith(f"{declared.code} {error.file}")
    return error


@pytest.mark.parametrize(("file", "old", "new", "key", "declared", "found"), CASES)
def test_a_mistake_is_one_sentence(make_campaign, file, old, new, key, declared, found):
    _refused(make_campaign(replace=((file, old, new),)), file, key, declared, found)


def test_every_mistake_of_a_file_is_reported(make_campaign):
    folder = make_campaign(replace=((RIG, "mass = 6.9605", "mass = 0.0"), (RIG, "mass = 0.412", "mass = -1")))
    error = _refused(folder, RIG, "load.mass", VALUE_OUT_OF_RANGE, "0.0")
    assert [one.key for one in error.each] == ["load.mass", 'part."adapter plate".mass']


@pytest.mark.parametrize(
    ("key", "declared", "changes"),
    [
        ("band", INVALID_VALUE, (('kind = "sine"', 'kind = "chirp"'), ('harmonics = "auto"', "band = [900.0, 60.0]"))),
        ("frame_rate", VALUE_OUT_OF_RANGE, (('trigger = "camera_trigger"\nfirst_edge = 0', "frame_rate = -1.0"),)),
    ],
)
def test_a_wrong_value_causes_no_second_error(make_campaign, key, declared, changes):
    error = _refused(make_campaign(replace=[(RECORDING, *change) for change in changes]), RECORDING, key, declared)
    assert len(error.each) == 1


def test_a_covariance_makes_the_scale_uncertainty_optional(make_campaign):
    folder = make_campaign(replace=((RIG, "scale_uncertainty = 2e-4 ", "#"),))
    calibration = folder.parent / "calibration" / "top.json"
    calibration.write_text('{"covariance": {"parameters": [], "matrix": []}}', encoding="utf-8")
    assert load_manifest(folder).rig.stereo["top"].scale_uncertainty is None
    calibration.write_text("{", encoding="utf-8")
    _refused(folder, "top.json", "", INVALID_SYNTAX)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_that_leaves_the_campaign_is_refused(make_campaign, tmp_path):
    folder = make_campaign()
    (tmp_path / "elsewhere.h5").write_bytes(b"")
    (folder / "vibrometer.h5").unlink()
    (folder / "vibrometer.h5").symlink_to(tmp_path / "elsewhere.h5")
    _refused(folder, RECORDING, "daq.vibrometer.file", PATH_NOT_ALLOWED)
    assert load_manifest(folder, allow_outside=True)


def test_a_rig_in_a_sibling_folder_is_refused(make_campaign, tmp_path):
    folder = make_campaign(replace=((RECORDING, '"../rig.toml"', '"../other/rig.toml"'),))
    (folder.parent / "other").mkdir()
    (folder.parent / "rig.toml").rename(folder.parent / "other" / "rig.toml")
    _refused(folder, RECORDING, "rig", PATH_NOT_ALLOWED)
    _refused(tmp_path, RECORDING, "", MISSING_FILE)


@pytest.mark.parametrize(
    ("content", "declared"),
    [
        (b"\xff\xfe", WRONG_ENCODING),
        (b"a = " + b"9" * 5000, INVALID_SYNTAX),
        (b"a = " + b"[" * 5000, INVALID_SYNTAX),
        (b"a = 1\na = 2\n", INVALID_SYNTAX),
        (b"[[part]]\n[part]\n", INVALID_SYNTAX),
    ],
)
def test_invalid_toml_is_one_sentence(make_campaign, content, declared):
    folder = make_campaign()
    (folder / RECORDING).write_bytes(content)
    _refused(folder, RECORDING, "", declared)


@pytest.mark.parametrize("section", ["sensor", "load", "stereo", "environment", "part"])
def test_a_section_of_the_wrong_kind_is_one_sentence(make_campaign, section):
    _refused(make_campaign(rig=f'format = 1\nname = "x"\n{section} = 3\n'), RIG, section, WRONG_VALUE_TYPE, "3")


def test_an_output_needs_a_sensor(make_campaign, format_examples):
    text = format_examples["rig"]
    without = text[: text.index("[sensor]")] + text[text.index("[load]") :]
    recording = format_examples["recording"].split("[[points]]")[0]
    error = _refused(make_campaign(rig=without, recording=recording), RIG, "sensor", MISSING_KEY)
    assert "Fz" in error.values["expected"]


HIDDEN = [
    # Both of two mistakes are named, though one of them hides the other from the models.
    ((RIG, "mass = 0.412", "mass = 0"), (RECORDING, 'channel = "Fz"', 'channel = "Fw"')),
    (
        (RIG, "exposure = 40e-6", "exposure = -1"),
        (RECORDING, 'trigger = "camera_trigger"\nfirst', 'trigger = "x"\nfirst'),
    ),
    ((RECORDING, "[106.25]", "[]"), (RECORDING, 'stereo = "top"', 'stereo = "tip"')),
    ((RECORDING, "scale = 0.125", "scale = 0"), (RECORDING, POINT, f'{POINT}\nhead = "pvs"')),
    ((RIG, "format = 1", "format = "), (RECORDING, 'harmonics = "auto"', 'harmonics = "all"')),
    ((RECORDING, '"../rig.toml"', '"../rg.toml"'), (RECORDING, 'quantity = "velocity"', 'quantity = "speed"')),
]


@pytest.mark.parametrize(("first", "second"), HIDDEN)
def test_a_mistake_hides_no_other(make_campaign, first, second):
    def keys(*changes: tuple[str, str, str]) -> set[tuple[str, str]]:
        with pytest.raises(InputError) as caught:
            load_manifest(make_campaign(replace=changes))
        return {(one.file.name, one.key) for one in caught.value.each}

    assert keys(first, second) == keys(first) | keys(second)


TAKE = block("[take]") + block("[take.daq]", name="scan", file="vibrometer.h5")
TAKE += channel("velocity", "velocity", "take.", body="load", **AT_ORIGIN)
TAKE += channel("drive", "voltage", "take.", reference=True)
HEAD = recording_head("scan", 100.0).partition("[[daq]]")[0]


def test_takes_share_one_reference(make_campaign):
    assert len(load_manifest(make_campaign(recording=HEAD + TAKE + TAKE)).take) == 2
    for takes, key, declared in (
        (TAKE + TAKE.replace("reference = true", ""), "take[2].daq", REFERENCE_CHANNEL_REQUIRED),
        (
            TAKE.replace('"load"', '"load"\nreference = true'),
            "take[1].daq.scan.channel.drive.reference",
            REFERENCE_CHANNEL_REQUIRED,
        ),
        ("", "daq", MISSING_KEY),
    ):
        _refused(make_campaign(recording=HEAD + takes), RECORDING, key, declared)


KINDS = {
    "multisine": "direction = [0, 0, 1]\nband = [10, 1000]\nperiod = 1.0\nsettle_periods = 2",
    "chirp": "direction = [0, 0, 1]\nband = [10, 1000]\nresponse = ['velocity']\nreference = ['drive']",
    "noise": "direction = [0, 0, 1]",
    "impact": "direction = [0, 0, 1, 0, 0, 0]",
    "step": "component = 'Fz'\nstep_amplitude = -12.0\nforce = 'drive'\nonset = 0.1\nrelease = 'fishing line'",
    "rotation": "file = 'bridge-response.csv'\nangle_unit = 'deg'\naxis = [1, 0, 0]\nzero_gravity = [0, 0, -1]\n"
    "with_load = true",
}


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_of_excitation_has_its_keys_and_names_recorded_channels(make_campaign, kind):
    head = HEAD[: HEAD.index("kind")] + f'kind = "{kind}"\n{KINDS[kind]}\n'
    assert load_manifest(make_campaign(recording=head + TAKE)).excitation.kind == kind
    key = KINDS[kind].split(" ", maxsplit=1)[0]
    lacking = head.replace(KINDS[kind].splitlines()[0], "")
    _refused(make_campaign(recording=lacking + TAKE), RECORDING, f"excitation.{key}", MISSING_KEY)
    named = {"chirp": "reference", "step": "force"}
    if kind in named:
        other = make_campaign(recording=head.replace("'drive'", "'x'") + TAKE)
        _refused(other, RECORDING, f"excitation.{named[kind]}", UNKNOWN_NAME)


LEAF = st.one_of(
    st.none(), st.booleans(), st.integers(), st.just(10**400), st.floats(), st.text(max_size=8), st.dates(), st.times()
)
JUNK = st.recursive(
    LEAF, lambda inner: st.lists(inner, max_size=7) | st.dictionaries(st.text(max_size=4), inner), max_leaves=12
)


def _places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Key paths of all values below a TOML value."""
    steps = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, child in steps for place in ((*here, key), *_places(child, (*here, key)))]


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), junk=JUNK)
def test_any_value_anywhere_is_accepted_or_an_input_error(make_campaign, data, junk):
    folder = make_campaign()
    rig = load_manifest(folder).rig
    file, model = data.draw(st.sampled_from([(folder.parent / RIG, Rig), (folder / RECORDING, RecordingFile)]))
    text = copy.deepcopy(tomllib.loads(file.read_text(encoding="utf-8")))
    *way, last = data.draw(st.sampled_from(_places(text)))
    table: Any = text
    for step in way:
        table = table[step]
    table[last] = junk
    scope = PathScope(file.parent.resolve(), folder.parent.resolve())
    with suppress(InputError):
        validate(model, text, file, RigContext(scope, rig.stereo))
