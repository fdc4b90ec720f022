"""Wrong input at the manifest: every mistake is one sentence with file and key."""

from __future__ import annotations

import copy
import os
import re
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from contracts import refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import AT_ORIGIN, block, channel, recording_head

from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.recording.manifest import RecordingFile
from fusion.recording.rig import Rig
from fusion.recording.toml import validate
from fusion.recording.values import Context, PathScope

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
    # file, old text, new text, key, expected, found
    (RIG, "mass = 6.9605", "mass = 0.0", "load.mass", "above 0", "0"),
    (RIG, "mass = 6.9605", 'mass = "6.96"', "load.mass", "a number", '"6.96"'),
    (RIG, "mass = 6.9605", "mass = true", "load.mass", "a number", "true"),
    (RIG, "mass = 6.9605", "mass = nan", "load.mass", "finite", "nan"),
    (RIG, "mass = 6.9605", "mas = 6.9605", "load.mas", 'probably "mass"', "unknown key"),
    (RIG, "mass_uncertainty = 0.0010", "mass_uncertainty = -1.0", "load.mass_uncertainty", "at least 0", "-1"),
    (RIG, "mass = 6.9605", 'mass = 6.9605\nmass_kind = "conventional"', "load.density", "density", "nothing"),
    (RIG, INERTIA, INERTIA.replace("[0.0360, 0.0,", "[0.0360, 0.001,"), "load.inertia", "symmetric", "0.001"),
    (RIG, INERTIA, INERTIA.replace("0.0310", "0.0810"), "load.inertia", "sum of the others", "0.081"),
    (RIG, INERTIA, INERTIA.replace("0.0310", "-0.0310"), "load.inertia", "positive principal", "-0.031"),
    (RIG, INERTIA, "inertia = [0.036, 0.036, 0.031]", "load.inertia", "3 rows of 3 numbers", "0.036"),
    (RIG, INERTIA + "   # about the centre of mass\n", "", "load.inertia", "required", "nothing"),
    (RIG, "centre_of_mass = [0.0, 0.0, 0.010]", "centre_of_mass = [0.0, 0.010]", "part.", "3 numbers", "2 elements"),
    (RIG, "mass = 0.412", "mass = 0", 'part."adapter plate".mass', "above 0", "0"),
    (RIG, 'body = "load"\nmass = 0.412', 'body = "Load"\nmass = 0.412', "part.", "'load' or 'base'", '"Load"'),
    (RIG, "internal_mass = 0.769", "internal_mass = [0.769]", "sensor.internal_mass", "a number", "list"),
    (RIG, 'sense = "on_load"', 'sense = "up"', "sensor.sense", "'on_load' or 'on_sensor'", '"up"'),
    (RIG, '"Fx", "Fy", "Fz"', '"Fx", "Fx", "Fz"', "sensor.channels", "different names", '"Fx" twice'),
    (RIG, "[2000.0, 2000.0,", "[2000.0,", "sensor.capacity", "6 numbers", "5 elements"),
    (
        RIG,
        "internal_mass = 0.769",
        "internal_mass = 0.769\ncross_talk = -0.02",
        "sensor.cross_talk",
        "above 0",
        "-0.02",
    ),
    (RIG, "capacity = [2000.0, 2000.0,", "cross_talk = 0.02 # [", "sensor.capacity", "six rated loads", "nothing"),
    (RIG, "  [5.1e-7, 0.0, 0.0, 0.0, 0.0, 0.0],\n", "", "sensor.static_sensitivity", "6 rows", "5 rows"),
    (RIG, "-9.8125", "-98.1", "environment.gravity", "m/s^2", "98.1"),
    (RIG, "temperature = 23.0", "temperature = 296.15", "environment.temperature", "at most 200", "296.15"),
    (
        RIG,
        "gravity = [0.0, 0.0, -9.8125]",
        "down = [0, 0, -1]",
        "environment.latitude",
        "gravity along down",
        "nothing",
    ),
    (
        RIG,
        "[[part]]",
        f"{ROD}".replace("4e9", "2e11") + "\n[[part]]",
        "rod.young_modulus_uncertainty",
        "less than",
        "2e+11",
    ),
    (
        RIG,
        "[[part]]",
        f"{ROD}".replace("4e9", "-4e9") + "\n[[part]]",
        "rod.young_modulus_uncertainty",
        "at least 0",
        "-4000000000",
    ),
    (RIG, "[[part]]", f"{ROD}\nfrequencies_uncertainty = 2\n[[part]]", "rod.frequencies_uncertainty", "below 1", "2"),
    (RIG, "[[part]]", f"{ROD}\ninner_diameter = 0.019\n[[part]]", "rod.inner_diameter", "by more than either", "0.019"),
    (RIG, EYE, EYE.replace("-1.0]]", "-1.001]]"), "stereo.top.rotation", "orthonormal", "0.002"),
    (RIG, EYE, EYE.replace("-1.0]]", "1.0]]"), "stereo.top.rotation", "determinant +1", "mirror"),
    (RIG, "[1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]", "1e-4", "stereo.top.pose_uncertainty", "6 numbers", "0.0001"),
    (RIG, "[1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4]", "[1e-4]", "stereo.top.pose_uncertainty", "6 numbers", "1 elements"),
    (RIG, "scale_uncertainty = 2e-4 ", "#", "stereo.top.scale_uncertainty", "uncertainty of all lengths", "nothing"),
    (RIG, 'calibration = "calibration/top.json"', "", "stereo.top.calibration", "images of top", "no calibration"),
    (RIG, "calibration/top.json", "calibration/no.json", "stereo.top.calibration", "an existing file", "no.json"),
    (RIG, "bit_depth = 12", "bit_depth = 12.0", "stereo.top.bit_depth", "a whole number", "12.0"),
    (RIG, "bit_depth = 12", "bit_depth = 17", "stereo.top.bit_depth", "at most 16", "17"),
    (RIG, "exposure = 40e-6", "exposre = 40e-6", "stereo.top.exposre", 'probably "exposure"', "unknown key"),
    (RIG, "exposure = 40e-6", 'exposure = "pulses"', "stereo.top.exposure", 'at least 0, or "pulse"', '"pulses"'),
    (RIG, "exposure = 40e-6", "exposure = -1e-6", "stereo.top.exposure", "at least 0", "-1e-06"),
    (RIG, "exposure = 40e-6", "exposure = nan", "stereo.top.exposure", "at least 0", "nan"),
    (RIG, "exposure = 40e-6", "exposure = true", "stereo.top.exposure", "a number", "true"),
    (RIG, "exposure = 40e-6", "exposure = 4e-5\nrow_time = 10", "top.row_time", "0.001 s", "10 (1e-05 s if"),
    (RIG, "exposure = 40e-6", "exposure = 4e-5\nrow_time = [1e-5]", "top.row_time", "or 2 numbers", "1 elements"),
    (RIG, "format = 1", "format = 2", "format", "1", "2"),
    (RIG, "format = 1", "format = ", "", "TOML", "line 1"),
    (RIG, "[sensor]", "[snsor]", "snsor", 'probably "sensor"', "unknown key"),
    (RECORDING, '"../rig.toml"', '"../rg.toml"', "rig", "an existing file", "rg.toml"),
    (RECORDING, 'kind = "sine"', 'kind = "sinus"', "excitation.kind", "'sine'", '"sinus"'),
    (RECORDING, "[0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0]", "excitation.direction", "a direction", "zero vector"),
    (RECORDING, "[0.0, 0.0, 1.0]", "[0.0, 1.0]", "excitation.direction", "3 numbers, or 6", "2 elements"),
    (RECORDING, "[106.25]", "[]", "excitation.frequencies", "a list of frequencies", "a list of 0"),
    (RECORDING, "[106.25]", "[-106.25]", "excitation.frequencies", "above 0", "-106.25"),
    (RECORDING, "[106.25]", '["106.25"]', "excitation.frequencies", "numbers", '"106.25"'),
    (RECORDING, "frequencies = [106.25]", "", "excitation.frequencies", "required", "nothing"),
    (RECORDING, 'harmonics = "auto"', 'harmonics = "all"', "excitation.harmonics", '"auto"', '"all"'),
    (RECORDING, 'harmonics = "auto"', "harmonics = [2, 0]", "excitation.harmonics", "multiples", "0"),
    (RECORDING, 'harmonics = "auto"', "band = [1, 2]", "excitation.band", 'no such key for kind = "sine"', "list of 2"),
    (RECORDING, "first_edge = 0 ", 'exposure = "strobe" ', "images.top.exposure", 'or "pulse"', '"strobe"'),
    (RECORDING, '"vibrometer.h5"', '"vibro.h5"', "daq.vibrometer.file", "an existing file", "vibro.h5"),
    (RECORDING, '"vibrometer.h5"', '"../../vibro.h5"', "daq.vibrometer.file", "inside the folder", "../../vibro.h5"),
    (RECORDING, '"vibrometer.h5"', '"/etc/passwd"', "daq.vibrometer.file", "relative", "/etc/passwd"),
    (RECORDING, '"vibrometer.h5"', "'a\\b.h5'", "daq.vibrometer.file", "'/' between its parts", "a\\b.h5"),
    (RECORDING, '"vibrometer.h5"', '"recording.toml"', "daq.vibrometer.file", "ends in one of .h5", "recording.toml"),
    (RECORDING, 'name = "bridge"', 'name = "vibrometer"', "daq", "different names", '"vibrometer" twice'),
    (RECORDING, 'quantity = "velocity"', 'quantity = "speed"', "channel.velocity.quantity", "'velocity'", '"speed"'),
    (
        RECORDING,
        POINT,
        'point = [0.010, -0.005, 0.62]\nhead = "psv"',
        "channel.velocity.point",
        "than the mirror",
        "same",
    ),
    (RECORDING, POINT, f'{POINT}\nhead = "pvs"', "channel.velocity.head", "name of a head of rig.toml", "psv"),
    (RECORDING, POINT, "", "daq.vibrometer.channel.velocity.point", "required for quantity", "nothing"),
    (RECORDING, "scale = 0.125", "scale = 0", "channel.velocity.scale", "other than 0", "0"),
    (RECORDING, "threshold = 2.5", "scale = 2.5", "channel.camera_trigger.scale", "no such key", "2.5"),
    (RECORDING, 'channel = "Fz"', 'channel = "Fw"', "daq.bridge.channel.Fz.channel", "Fx, Fy, Fz", '"Fw"'),
    (RECORDING, 'channel = "Fz"', "", "daq.bridge.channel.Fz.channel", "required", "nothing"),
    (RECORDING, "bridge-response.csv", "no.csv", "daq.bridge.channel.Fz.response", "an existing file", "no.csv"),
    (RECORDING, 'stereo = "top"', 'stereo = "tip"', "images.tip.stereo", "stereo pair of rig.toml", "top, base"),
    (RECORDING, "top-left/*.tif", "top-left/*.png", "images.top.left", "at least one file", "*.png"),
    (RECORDING, "top-left/*.tif", "**/*.tif", "images.top.left", "one folder", "**"),
    (RECORDING, "top-left/*.tif", "top-left/000[01].tif", "images.top.right", "as many", "2 left and 3 right"),
    (RECORDING, "top-right/*.tif", "top-left/*.tif", "images.top.right", "other images", "the same files"),
    (RECORDING, 'trigger = "camera_trigger"\nfirst', 'trigger = "x"\nfirst', "images.top.trigger", "trigger", '"x"'),
    (RECORDING, "first_edge = 0", "first_edge = -1", "images.top.first_edge", "at least 0", "-1"),
    (RECORDING, '"x", "y", "z"]', '"x", "y"]', "points.base.columns", "x, y, z", "id_x"),
    (RECORDING, '"id_x", "id_y"', '"id_x", "yid"', "points.base.columns", "columns of", '"yid"'),
    (RECORDING, '"status", "status", "status"', '"_", "_", "_"', "points.base.columns", "status", "id_x"),
    (RECORDING, "scale = 1e-3                            #", "scale = 0 #", "points.base.scale", "above 0", "0"),
    (RECORDING, 'stereo = "base"', 'stereo = "top"', "images.top.stereo", "one images or points block", "two blocks"),
]


def _refused(folder: Path, file: str, key: str, expected: str, found: str) -> None:
    """Assert that the manifest is refused in one sentence of these parts."""
    with pytest.raises(InputError) as caught:
        load_manifest(folder)
    error, text = caught.value, str(caught.value)
    assert error.file.name == file
    assert key in error.key, text
    assert expected in error.expected, text
    assert found in error.found, text
    assert "\n" not in text
    assert text.startswith(str(error.file))


def _not_loaded(told: str, folder: Path) -> None:
    refused(told, load_manifest, folder, error=InputError)


@pytest.mark.parametrize(("file", "old", "new", "key", "expected", "found"), CASES)
def test_a_mistake_is_one_sentence(make_campaign, file, old, new, key, expected, found):
    _refused(make_campaign(replace=((file, old, new),)), file, key, expected, found)


def test_the_sentence_reads_as_promised(make_campaign):
    folder = make_campaign(replace=((RIG, "mass = 6.9605", "mass = 0.0"), (RIG, "mass = 0.412", "mass = -1")))
    told = f"{folder.parent / RIG}: load.mass: expected a number above 0, found 0.0 (1 more problem in this file)"
    _not_loaded(re.escape(told), folder)


def test_a_covariance_makes_the_scale_uncertainty_optional(make_campaign):
    folder = make_campaign(replace=((RIG, "scale_uncertainty = 2e-4 ", "#"),))
    calibration = folder.parent / "calibration" / "top.json"
    calibration.write_text('{"covariance": {"parameters": [], "matrix": []}}', encoding="utf-8")
    assert load_manifest(folder).rig.stereo["top"].scale_uncertainty is None
    calibration.write_text("{", encoding="utf-8")
    _not_loaded(r"top\.json: expected JSON", folder)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_that_leaves_the_campaign_is_refused(make_campaign, tmp_path):
    folder = make_campaign()
    (tmp_path / "elsewhere.h5").write_bytes(b"")
    (folder / "vibrometer.h5").unlink()
    (folder / "vibrometer.h5").symlink_to(tmp_path / "elsewhere.h5")
    _not_loaded(r"daq\.vibrometer\.file: expected a path inside the folder", folder)
    assert load_manifest(folder, allow_outside=True)


def test_a_rig_beside_the_recording_is_refused(make_campaign, tmp_path):
    folder = make_campaign(replace=((RECORDING, '"../rig.toml"', '"../other/rig.toml"'),))
    (folder.parent / "other").mkdir()
    (folder.parent / "rig.toml").rename(folder.parent / "other" / "rig.toml")
    _not_loaded(r"rig: expected a rig\.toml in a folder above the recording", folder)
    _not_loaded(r"recording\.toml: expected an existing file", tmp_path)


@pytest.mark.parametrize(
    "content", [b"\xff\xfe", b"a = " + b"9" * 5000, b"a = " + b"[" * 5000, b"a = 1\na = 2\n", b"[[part]]\n[part]\n"]
)
def test_what_is_not_toml_is_one_sentence(make_campaign, content):
    folder = make_campaign()
    (folder / RECORDING).write_bytes(content)
    _refused(folder, RECORDING, "", "", "")


@pytest.mark.parametrize("section", ["sensor", "load", "stereo", "environment", "part"])
def test_a_section_of_the_wrong_kind_is_one_sentence(make_campaign, section):
    _refused(make_campaign(rig=f'format = 1\nname = "x"\n{section} = 3\n'), RIG, section, "", "3")


def test_an_output_needs_a_sensor(make_campaign, format_examples):
    text = format_examples["rig"]
    without = text[: text.index("[sensor]")] + text[text.index("[load]") :]
    recording = format_examples["recording"].split("[[points]]")[0]
    told = r"rig\.toml: sensor: expected the \[sensor\] whose output Fz"
    _not_loaded(told, make_campaign(rig=without, recording=recording))


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
    for takes, told in (
        (TAKE + TAKE.replace("reference = true", ""), r"take\[2\]\.daq: expected one channel with reference = true"),
        (
            TAKE.replace('"load"', '"load"\nreference = true'),
            r"take\[1\]\.daq\.scan\.channel\.drive\.reference: expected one channel",
        ),
        ("", "daq: expected at least one"),
    ):
        _not_loaded(told, make_campaign(recording=HEAD + takes))


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
    _not_loaded(f"excitation.{key}: expected this key, required for kind", make_campaign(recording=lacking + TAKE))
    named = {"chirp": "reference", "step": "force"}
    if kind in named:
        other = make_campaign(recording=head.replace("'drive'", "'x'") + TAKE)
        _not_loaded(rf"excitation\.{named[kind]}: expected the name of a recorded channel", other)


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
        validate(model, text, file, Context(scope, rig.stereo))
