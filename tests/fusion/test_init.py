"""`shakercal init`: drafted manifests, filled in as a laboratory would, against those that were there before."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import wavfile
from support import DOCS, draft_example, examples, folder_contents, refusals, rows, write_daq

from fusion import draft
from fusion.cli import main
from fusion.errors import InputError
from fusion.phasors.timing import tie_daqs
from fusion.planning.check import check
from fusion.planning.draft.channel_guess import guess_channel, guess_recorders
from fusion.planning.draft.init import example, run_init
from fusion.planning.draft.inventory import FoundChannel, survey_folder
from fusion.planning.planning_notices import MANIFEST_EXISTS, NO_RECORDED_FILES
from fusion.recording.daq_records import read_set_ups
from fusion.recording.load import find_recordings, load_manifest
from fusion.recording.recording_notices import INVALID_SYNTAX, INVALID_VALUE, MISSING_FILE, VALUE_OUT_OF_RANGE
from fusion.recording.toml import to_toml
from fusion.simulate import simulate

MANIFESTS = ("rig.toml", "recording.toml")
TOLD = {"name", "serial"}  # what a thing is called


@pytest.fixture
def refused(capsys):
    return refusals(capsys)


def stripped(source: Path, folder: Path) -> Path:
    """Copy a campaign without its manifests and results."""
    ignore = shutil.ignore_patterns("*.toml", "truth.json", "results")
    return Path(shutil.copytree(source, folder, ignore=ignore))


def expanded(recording: Any) -> Any:
    """A recording whose channels state the defaults of their block."""
    for block in recording.get("daq", []):
        defaults = block.pop("defaults", {})
        block["channel"] = [
            entry
            if entry["quantity"] == "trigger"
            else {**entry, **{k: v for k, v in defaults.items() if k not in entry}}
            for entry in block["channel"]
        ]
    return recording


def filled(drafted: Any, original: Any, text: str, place: str = "") -> Any:
    """Fill in what a draft asks for, and what it only offers, from the original; all else must be as it is there."""
    if isinstance(original, dict):
        assert isinstance(drafted, dict), place
        assert set(drafted) <= set(original), f"{place} has keys that nobody needs"
        made = {}
        for key, value in original.items():
            if key in drafted:
                made[key] = filled(drafted[key], value, text, f"{place}.{key}")
                continue
            offered = f"# {key} = " in text or f"# [{key}" in text or f"# [[{key}]]" in text
            assert offered, f"{place}.{key} is not offered"
            made[key] = value
        return made
    if isinstance(original, list) and original and isinstance(original[0], dict):
        keys = [key for key in ("file", "stereo", "name") if key in original[0]][:1]
        assert [item[key] for item in drafted for key in keys] == [item[key] for item in original for key in keys], (
            place
        )
        return [filled(a, b, text, f"{place}[]") for a, b in zip(drafted, original, strict=True)]
    if drafted != "?" and place.rpartition(".")[2] not in TOLD:
        assert drafted == pytest.approx(original) if isinstance(original, float) else drafted == original, place
    return original


def drafted_recording(folder: Path) -> Any:
    """The only recording.toml that is drafted in a folder."""
    (text,) = (text for path, text in draft(folder).files.items() if path.name == "recording.toml")
    return tomllib.loads(text)


def fill(folder: Path, source: Path) -> None:
    """Fill in every manifest of a folder from that of another one."""
    for path in [folder / "rig.toml", *(entry for entry in sorted(folder.glob("*/recording.toml")))]:
        text = path.read_text(encoding="utf-8")
        original = tomllib.loads((source / path.relative_to(folder)).read_text(encoding="utf-8"))
        path.write_text(to_toml(filled(expanded(tomllib.loads(text)), original, text, path.name)), encoding="utf-8")


def test_the_demo_drafted_and_filled_in_is_the_demo(tmp_path, demo_recording, capsys):
    source = demo_recording
    folder = stripped(source, tmp_path / "demo")
    assert main(["init", str(folder)]) == 0
    asked = int(capsys.readouterr().out.split(" values are left")[0].rpartition("\n")[2])
    # Four channels of motion, two pairs, the sensor and its load: nothing else is asked for.
    assert asked == 4 * 4 + 2 * 3 + 2 + 4
    assert main(["check", str(folder)]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == asked
    assert all('"?"' in line for line in told)
    assert "recording.toml: daq.vibrometer.channel.velocity_1.point: " in told[0]
    fill(folder, source)
    assert main(["check", str(folder)]) == 0
    for name in (MANIFESTS[0], f"Fz-0080/{MANIFESTS[1]}"):
        assert tomllib.loads((folder / name).read_text()) == tomllib.loads((source / name).read_text())


@pytest.mark.slow
def test_a_drafted_demo_has_the_demos_numbers(tmp_path, demo_recording):
    folder = stripped(demo_recording, tmp_path / "demo")
    run_init(folder)
    fill(folder, demo_recording)
    for place, out in ((folder, "own"), (demo_recording, "first")):
        assert main(["run", str(place), "-o", str(tmp_path / out), "-q"]) == 0
    for name in ("sensitivity.csv", "acceleration.csv", "load.csv"):
        assert rows(tmp_path / "own" / name) == rows(tmp_path / "first" / name)


def test_a_camera_without_a_partner_is_drafted_as_one_alone_before_a_face(tmp_path, demo_recording, capsys):
    """The left camera of a pair, whose file is there, three photographs, and a pair of unlike numbers of frames."""
    folder = stripped(demo_recording, tmp_path / "demo")
    recording = folder / "Fz-0080"
    shutil.rmtree(recording / "top-right")
    (recording / "photographs").mkdir()
    for picture in sorted((recording / "base-right").iterdir())[:3]:
        shutil.copy(picture, recording / "photographs" / f"rig{picture.name}")
        picture.unlink()
    drafted = draft(folder)
    rig = tomllib.loads(drafted.files[folder / "rig.toml"])["stereo"]
    assert {name: block["calibration"] for name, block in rig.items()} == {"top": "calibration/top.json"}
    assert rig["top"]["surface"] == dict.fromkeys(("point", "normal", "distance_uncertainty", "tilt_uncertainty"), "?")
    text = drafted.files[recording / "recording.toml"]
    (images,) = tomllib.loads(text)["images"]
    assert images == {"stereo": "top", "left": "top-left/*.tif", "trigger": "camera_trigger"}
    left_out = text.partition("# Left out:")[2]
    assert re.search(r"# base-left/\*\.tif: 24 frames .*base-right/\*\.tif .*21 frames", left_out)
    assert re.search(r"# photographs/rig\*\.tif: 3 frames of 304 x 240 px", left_out)
    # Filled in, it is a recording that can be evaluated.
    run_init(folder)
    original = tomllib.loads((demo_recording / "rig.toml").read_text())
    stated = original["stereo"]["top"] | {"surface": {"point": [0, 0, 0.07], "normal": [0, 0, 1]}}
    stated["surface"] |= {"distance_uncertainty": 2e-4, "tilt_uncertainty": 1e-3}
    original["stereo"] = {"top": stated}
    for name, whole in (("rig.toml", original), ("Fz-0080/recording.toml", _without_images(demo_recording))):
        text = (folder / name).read_text()
        (folder / name).write_text(to_toml(filled(expanded(tomllib.loads(text)), whole, text, name)))
    assert main(["check", str(folder)]) == 0
    assert re.search("stereo top .*camera", capsys.readouterr().out)


def _without_images(source: Path) -> Any:
    """The recording with the left camera of the load alone."""
    whole = tomllib.loads((source / "Fz-0080" / "recording.toml").read_text())
    whole["images"] = [{k: v for k, v in block.items() if k != "right"} for block in whole["images"]][:1]
    return whole


def _one_laser(folder: Path) -> None:
    """A laser, a bridge and the trigger of a stereo pair."""
    place = folder / "Mx-0050"
    time_s = np.arange(20_000) / 10e3
    sine = np.sin(2 * np.pi * 50.0 * time_s)
    trigger = 5.0 * ((time_s - 0.0123) % (1 / 13.7) < 2e-3)
    noise = np.random.default_rng(1).normal(size=(2, len(time_s))) * 1e-3
    for side in ("left", "right"):
        shutil.copytree(Path("sample_images/demo/Fz-0080") / f"top-{side}", place / f"cam-{side}")
    shutil.copy("sample_images/demo/calibration/top.json", folder / "pair.json")
    write_daq(place / "a.h5", 10e3, {"laser": sine + noise[0], "Mx": sine + noise[1], "ai7": trigger})
    with h5py.File(place / "a.h5", "a") as file:
        file["Mx"].attrs["unit"] = "mV/V"


def test_a_recording_of_one_laser_and_one_pair_asks_for_less_than_15_values(tmp_path):
    _one_laser(tmp_path)
    drafted = draft(tmp_path)
    text = drafted.files[tmp_path / "Mx-0050" / "recording.toml"]
    recording = tomllib.loads(text)
    assert drafted.unfilled < 15
    assert recording["excitation"]["direction"] == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    assert recording["excitation"]["frequencies"] == [50.0]
    laser, output, trigger = recording["daq"][0]["channel"]
    assert (laser["quantity"], laser["body"], laser["scale"]) == ("velocity", "load", "?")
    assert (output["quantity"], output["channel"]) == ("output", "Mx")
    assert (trigger["name"], trigger["quantity"]) == ("ai7", "trigger")
    assert recording["images"] == [
        {
            "stereo": "pair",
            "left": "cam-left/*.tif",
            "right": "cam-right/*.tif",
            "trigger": "ai7",
            "first_edge": "?",  # 27 edges for 24 frames
        }
    ]
    rig = tomllib.loads(drafted.files[tmp_path / "rig.toml"])
    assert rig["stereo"]["pair"]["calibration"] == "pair.json"


@pytest.mark.parametrize("preset", ["sweep", "matrix"])
def test_presets_drafted_and_filled_in_are_what_they_were(tmp_path, preset):
    source, folder = tmp_path / "source", tmp_path / "drafted"
    one = simulate(source, preset, 1, recordings=1)
    stripped(one, folder / one.name)
    run_init(folder)
    for name in ("rig.toml", f"{one.name}/recording.toml"):
        path, text = folder / name, (folder / name).read_text(encoding="utf-8")
        rig = sorted(source.glob("rig*.toml"))[0] if name == "rig.toml" else source / name
        original = tomllib.loads(rig.read_text(encoding="utf-8"))
        original["rig"] = "../rig.toml" if "rig" in original else None
        original = {key: value for key, value in original.items() if value is not None}
        path.write_text(to_toml(filled(expanded(tomllib.loads(text)), original, text, name)), encoding="utf-8")
    assert check(load_manifest(folder / one.name)).problems == ()


def test_a_recording_like_another_asks_for_nothing(tmp_path, demo_recording, capsys):
    folder = tmp_path / "demo"
    shutil.copytree(demo_recording, folder, ignore=shutil.ignore_patterns("results"))
    other = folder / "Fz-0081"
    stripped(folder / "Fz-0080", other)
    assert main(["init", str(other), "--from", str(folder / "Fz-0080")]) == 0
    assert '"?"' not in capsys.readouterr().out
    own, first = (tomllib.loads((place / "recording.toml").read_text()) for place in (other, folder / "Fz-0080"))
    assert own == {**first, "name": "Fz-0081"}
    assert check(load_manifest(other)).problems == ()
    # A file of another name that has all channels takes the place of the first one's.
    (other / "recording.toml").unlink()
    (other / "bridge.h5").rename(other / "amplifier.h5")
    (other / "bridge-response.csv").unlink()
    run_init(other, folder / "Fz-0080")
    bridge = tomllib.loads((other / "recording.toml").read_text())["daq"][1]
    assert bridge["file"] == "amplifier.h5"
    assert bridge["channel"][0]["response"] == "../Fz-0080/bridge-response.csv"


def test_recorders_that_call_the_trigger_otherwise_are_tied(tmp_path):
    # A WAVE file numbers its channels; its clock is fast by 20 ppm.
    fast, rate_hz = 1.00002, 8000
    place = tmp_path / "Fz"
    place.mkdir()

    def record(rate: float, seconds: float, delay_s: float) -> tuple[np.ndarray, np.ndarray]:
        time_s = np.arange(int(rate * seconds)) / rate + delay_s
        return np.sin(2 * np.pi * 80 * time_s), ((time_s - 0.3123) % (1 / 11.31) < 5e-3) * (
            abs(time_s - 3.0) < 2.0
        ) * 1.0

    sine, trigger = record(10e3, 6.0, 0.0)
    write_daq(place / "vibrometer.h5", 10e3, {"velocity": sine, "camera_trigger": trigger})
    sine, trigger = record(rate_hz * fast, 6.0, 0.0)
    wavfile.write(place / "bridge.wav", rate_hz, np.stack([sine, trigger], axis=1).astype(np.float32))
    drafted = draft(tmp_path)
    recording = tomllib.loads(drafted.files[place / "recording.toml"])
    wave = recording["daq"][1]
    assert [(entry["name"], entry.get("in_file")) for entry in wave["channel"]] == [
        ("1", None),
        ("camera_trigger", "2"),
    ]
    wave["channel"][0] |= {"name": "Fz", "in_file": "1", "quantity": "output", "channel": "Fz", "scale": 1.0}
    recording["daq"][0]["channel"][0] |= {"point": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0], "scale": 1.0}
    recording["daq"][0]["channel"][0] |= {"scale_uncertainty": 1e-3}
    (place / "recording.toml").write_text(to_toml(recording))
    sensor = {"name": "s", "channels": ["Fz"], "unit": "V", "sense": "on_load", "internal_mass": 0.1}
    (tmp_path / "rig.toml").write_text(to_toml({"format": 1, "name": "rig", "sensor": sensor}))
    manifest = load_manifest(place)
    assert check(manifest).problems == ()
    base = tie_daqs(manifest, read_set_ups(manifest)[0].records)
    tie = base.ties["bridge"]
    assert tie.rate == pytest.approx(1 / fast, abs=3e-6)


HUM = {
    # what else a recorder has: name, level of hum in V, largest value of a release that rings
    "on the trigger": ("camera_trigger", 9e-5, 0.05),
    "on a channel of no name": ("ai5", 9e-5, 0.5),
    "on the trigger alone": ("trigger", 9e-5, 0.0),
}


@pytest.mark.parametrize("case", HUM)
def test_hum_is_no_excitation(tmp_path, case):
    name, hum, size = HUM[case]
    time_s, rng = np.arange(20_000) / 10e3, np.random.default_rng(3)
    release = size * np.exp(-np.maximum(time_s - 0.3, 0.0) * 40.0) * (time_s > 0.3)
    signals = {"Fz": release + 1e-6 * rng.normal(size=20_000)} if size else {"acc": 1e-3 * rng.normal(size=20_000)}
    signals[name] = hum * np.sin(2 * np.pi * 50.04 * time_s) + 1e-6 * rng.normal(size=20_000)
    write_daq(tmp_path / "a.h5", 10e3, signals)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        for channel in signals:
            file[channel].attrs["unit"] = "V"
    excitation = drafted_recording(tmp_path)["excitation"]
    assert excitation["kind"] == "?"
    assert "frequencies" not in excitation


NAMES = ["acc x", "Fz", "camera_trigger"]
LISTED = {
    "data set": lambda file: file.create_dataset("names", data=NAMES),
    "data set of bytes": lambda file: file.create_dataset("channel_names", data=np.array(NAMES, "S20")),
    "data set of another name": lambda file: file.create_dataset("Kanal", data=np.array([NAMES], "S20")),
    "attribute of the table": lambda file: file["data"].attrs.update(channels=NAMES),
    "attribute of the file": lambda file: file.attrs.update(ChannelNames=NAMES),
    "one text": lambda file: file["data"].attrs.update(labels=", ".join(NAMES)),
}


@pytest.mark.parametrize(("case", "across"), [*((case, False) for case in LISTED), ("data set", True)])
def test_names_beside_a_table_of_channels_are_used(tmp_path, case, across):
    time_s = np.arange(4000) / 1e3
    table = np.stack([np.sin(2 * np.pi * 80 * time_s), np.cos(2 * np.pi * 80 * time_s), 5.0 * (time_s % 0.0731 < 5e-3)])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["sample_rate"] = 1e3
        file["data"] = table if across else table.T
        LISTED[case](file)
    channels = drafted_recording(tmp_path)["daq"][0]["channel"]
    found = {entry["in_file"]: (entry["name"], entry["quantity"]) for entry in channels}
    assert found == {
        "data/1": ("acc x", "acceleration"),
        "data/2": ("Fz", "output"),
        "data/3": ("camera_trigger", "trigger"),
    }


@pytest.mark.parametrize("names", [NAMES[:2], ["a", "a", "b"], ["", "b", "c"]])
def test_a_list_that_does_not_fit_the_table_is_not_used(tmp_path, names):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["sample_rate"] = 1e3
        file["data"] = np.random.default_rng(1).normal(size=(4000, 3))
        file["names"] = names
    channels = drafted_recording(tmp_path)["daq"][0]["channel"]
    assert [entry["name"] for entry in channels] == ["data/1", "data/2", "data/3"]


GUESSED = [
    ("ai0", "m/s", "velocity", 1.0),
    ("ai0", "mm/s", "velocity", 1e-3),
    ("ai0", "g", "acceleration", 9.80665),
    ("ai0", "m/s²", "acceleration", 1.0),
    ("ai0", "µm", "displacement", 1e-6),
    ("ai0", "°/s", "angular_velocity", np.pi / 180),
    ("Fz", "mV/V", "output", 1e-3),
    ("Fz", "N", "output", 1.0),
    ("Fz", "V", "output", 1.0),
    ("group/Mx", "", "output", None),
    ("force gauge", "Pounds", "force", 4.4482216152605),
    ("PSV velocity", "V", "velocity", None),
    ("ACC-3", "V", "acceleration", None),
    ("ai0", "V", "?", None),
]


@pytest.mark.parametrize(("name", "unit", "quantity", "scale"), GUESSED)
def test_what_names_and_units_suggest(name, unit, quantity, scale):
    made = guess_channel(FoundChannel(name, unit, 1e3, 100, -1.0, 1.0, None))
    assert made.quantity == quantity
    assert made.scale == (None if scale is None else pytest.approx(scale))


CAMERAS = [
    ("left/{}.tif right/{}.tif", {"pair": ("left/*.tif", "right/*.tif")}),
    ("img_{}_0.tif img_{}_1.tif", {"pair": ("img_*_0.tif", "img_*_1.tif")}),
    ("cam1_{}.tif cam2_{}.tif", {"pair": ("cam1_*.tif", "cam2_*.tif")}),
    (
        "base_L_{}.tif base_R_{}.tif top_L_{}.tif top_R_{}.tif",
        {"base": ("base_L_*.tif", "base_R_*.tif"), "top": ("top_L_*.tif", "top_R_*.tif")},
    ),
    ("table/a{}.tif table/b{}.tif", {"table": ("table/a*.tif", "table/b*.tif")}),
    ("left/{}.tif other/{}.tif", {}),
]


@pytest.mark.parametrize(("names", "pairs"), CAMERAS)
def test_cameras_become_pairs_by_their_names(tmp_path, names, pairs, demo_recording):
    picture = demo_recording / "Fz-0080" / "top-left" / "0000.tif"
    for name in names.split():
        for frame in range(3):
            path = tmp_path / name.format(frame)
            path.parent.mkdir(exist_ok=True)
            shutil.copy(picture, path)
    found = survey_folder(tmp_path).camera_systems
    assert {pair.name: (pair.left.pattern, pair.right.pattern) for pair in found} == pairs


def test_the_blocks_of_the_document_are_the_example(tmp_path):
    """Joined in their order, the examples of the document are both files, without their empty lines."""
    blocks = examples((DOCS / "recording-format.md").read_text(encoding="utf-8"))
    for text in example(tmp_path).files.values():
        found = [line for block in blocks if block in text for line in block.splitlines() if line]
        assert found == [line for line in text.splitlines() if line]
    assert main(["init", str(tmp_path / "new"), "--example"]) == 0
    written = (tmp_path / "new" / "Fz-0106.25" / "recording.toml").read_text(encoding="utf-8")
    assert written == draft_example("recording.toml")


def test_a_folder_without_manifest_leads_to_init(tmp_path, refused):
    _one_laser(tmp_path)
    assert f"shakercal init {tmp_path} " in refused("run", tmp_path)
    file = tmp_path / "Mx-0050" / "a.h5"
    assert f"shakercal init {file.parent} " in refused("check", file)
    assert f"shakercal init {file.parent} " in refused("run", file)


@pytest.mark.parametrize(
    ("recorded", "files", "options", "declared", "where"),
    [
        (False, {}, [], NO_RECORDED_FILES, ""),
        (False, {"notes.txt": "hello"}, [], NO_RECORDED_FILES, ""),
        (True, {"recording.toml": "format = 1"}, [], MANIFEST_EXISTS, ""),
        (True, {"Mx-0050/recording.toml": "format = 1"}, [], MANIFEST_EXISTS, ""),
        (True, {"rig.toml": "format = "}, [], INVALID_SYNTAX, "rig.toml"),
        (True, {}, ["--from", "nowhere"], MISSING_FILE, "recording.toml"),
    ],
)
def test_what_cannot_be_drafted_is_one_sentence_and_changes_nothing(
    tmp_path, refused, recorded, files, options, declared, where
):
    if recorded:
        _one_laser(tmp_path)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    before = folder_contents(tmp_path)
    told = refused("init", tmp_path, *options)
    assert told.startswith(f"shakercal: {declared.code} ")
    assert f"{Path(options[-1]) / where if options else tmp_path / where}: " in told
    assert folder_contents(tmp_path) == before


def test_a_folder_of_which_nothing_can_be_read_gets_no_draft(tmp_path, refused):
    (tmp_path / "broken.tdms").write_bytes(b"TDSx" * 20)
    assert f"{tmp_path}: " in refused("init", tmp_path)
    assert "broken.tdms" in refused("init", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["broken.tdms"]


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n", b"CDF\x01" * 200])
def test_files_that_cannot_be_read_are_left_out_by_name(tmp_path, content):
    _one_laser(tmp_path)
    (tmp_path / "Mx-0050" / "broken.h5").write_bytes(content)
    (tmp_path / "Mx-0050" / 'a "quoted" # name.csv').write_text("a;b\n1;2\n")
    (tmp_path / "Mx-0050" / "scan.svd").write_bytes(b"\0")
    drafted = draft(tmp_path)
    text = drafted.files[tmp_path / "Mx-0050" / "recording.toml"]
    assert [line.startswith("cannot be read: Mx-0050/") for line in drafted.found] == [True] * 3 + [False]
    assert "1 recorder file with 3 channels" in drafted.found[-1]
    tomllib.loads(text)
    left = text[text.index("# Cannot be read:") : text.index("format = 1")]
    assert "# broken.h5: " in left
    assert '# a "quoted" # name.csv: ' in left
    assert "# scan.svd: " in left


def test_mistakes_of_both_files_are_told_at_once(tmp_path, demo_recording, capsys):
    folder = tmp_path / "demo"
    shutil.copytree(demo_recording, folder, ignore=shutil.ignore_patterns("results"))
    for name, changes in {
        "rig.toml": [("mass = 2.4063", "mass = -1.0"), ("bit_depth = 10", "bit_depth = 30")],
        "Fz-0080/recording.toml": [('kind = "sine"', 'kind = "sin"'), ("scale = 0.1\n", "scale = 0\n")],
    }.items():
        text = (folder / name).read_text()
        for old, new in changes:
            text = text.replace(old, new, 1)
        (folder / name).write_text(text)
    assert main(["check", str(folder)]) == 2
    told = capsys.readouterr().err.splitlines()
    mistakes = {
        ("rig.toml", "load.mass"): (VALUE_OUT_OF_RANGE, "-1.0"),
        ("rig.toml", "stereo.top.bit_depth"): (VALUE_OUT_OF_RANGE, "30"),
        ("Fz-0080/recording.toml", "excitation.kind"): (INVALID_VALUE, '"sin"'),
        ("Fz-0080/recording.toml", "daq.vibrometer.channel.velocity_1.scale"): (VALUE_OUT_OF_RANGE, "0"),
    }
    assert len(told) == len(mistakes)
    for (name, key), (declared, value) in mistakes.items():
        start = f"{declared.code} {folder / name}: {key}: "
        (line,) = (line for line in told if start in line)
        assert value in line.partition(start)[2]
    with pytest.raises(InputError, match=r"load.mass: .* \(3 .*recording.toml\)"):
        load_manifest(find_recordings(folder)[0])


def test_pulses_of_one_rate_have_one_name(tmp_path):
    time_s = np.arange(20_000) / 10e3
    for name, channel in (("a", "ai1"), ("b", "sync out")):
        pulses = 3.0 * ((time_s - 0.02) % (1 / 20.5) < 1e-3)
        write_daq(tmp_path / f"{name}.h5", 10e3, {channel: pulses, "other": 3.0 * (time_s % (1 / 31.0) < 1e-3)})
    names = [[item.name for item in recorder.channels] for recorder in guess_recorders(survey_folder(tmp_path).daqs)]
    assert names == 2 * [["other", "sync out"]]
