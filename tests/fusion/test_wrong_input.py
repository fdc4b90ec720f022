"""Wrong input: one sentence with file and key, exit status 2, nothing written, and no time lost on tracking."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from fusion.base import ComputeError, InputError
from fusion.cli import main
from fusion.commands.options import EXIT_INPUT
from fusion.phasors import stereo_motion

NAME = "Fz-0080"
RIG, RECORDING = "rig.toml", f"{NAME}/recording.toml"
VIBROMETER, BRIDGE, RESPONSE = f"{NAME}/vibrometer.h5", f"{NAME}/bridge.h5", f"{NAME}/bridge-response.csv"
CALIBRATION = "calibration/base.json"
Break = Callable[[Path], object]


@pytest.fixture
def campaign(tmp_path: Path, demo_recording: Path) -> Path:
    """A copy of the demo campaign; files are links to the original ones until a test replaces them."""
    return Path(shutil.copytree(demo_recording, tmp_path / "campaign", copy_function=_link))


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _replace(path: Path, content: bytes) -> None:
    """Write a file anew, so that the original behind the link stays as it is."""
    path.unlink()
    path.write_bytes(content)


def _drop(file: str) -> Break:
    return lambda campaign: (campaign / file).unlink()


def _text(file: str, old: str, new: str) -> Break:
    def break_it(campaign: Path) -> None:
        text = (campaign / file).read_text(encoding="utf-8")
        assert old in text
        _replace(campaign / file, text.replace(old, new, 1).encode())

    return break_it


def _bytes(file: str, content: bytes) -> Break:
    return lambda campaign: _replace(campaign / file, content)


def _cut(file: str, share: float) -> Break:
    def break_it(campaign: Path) -> None:
        content = (campaign / file).read_bytes()
        _replace(campaign / file, content[: int(share * len(content))])

    return break_it


def _pixels(file: str, change: Callable[[Any], Any]) -> Break:
    def break_it(campaign: Path) -> None:
        image = change(tifffile.imread(campaign / file))
        (campaign / file).unlink()
        tifffile.imwrite(campaign / file, image)

    return break_it


def _channel(file: str, name: str, change: Callable[[Any], Any]) -> Break:
    def break_it(campaign: Path) -> None:
        _replace(campaign / file, (campaign / file).read_bytes())
        with h5py.File(campaign / file, "a") as daq:
            samples, attributes = change(daq[name][()]), dict(daq[name].attrs)
            del daq[name]
            daq[name] = samples
            daq[name].attrs.update(attributes)

    return break_it


def _each(*breaks: Break) -> Break:
    def break_it(campaign: Path) -> None:
        for one in breaks:
            one(campaign)

    return break_it


def _saturate(image: Any) -> Any:
    image[60:140, 80:200] = 1023
    return image


def _with_nan(samples: Any) -> Any:
    values = samples.astype(np.float64)
    values[777] = np.nan
    return values


def _twenty_edges(samples: Any) -> Any:
    rising = np.flatnonzero((samples[1:] > 2.5) & (samples[:-1] < 2.5))
    samples[rising[20] - 5 :] = samples[0]
    return samples


def _stretched_rotation(campaign: Path) -> None:
    calibration = json.loads((campaign / CALIBRATION).read_text())
    calibration["rotation"][0][0] *= 1.1
    _replace(campaign / CALIBRATION, json.dumps(calibration).encode())


def _without_bridge_trigger(campaign: Path) -> None:
    text = (campaign / RECORDING).read_text()
    images = text.index("[[images]]")
    _replace(campaign / RECORDING, (text[: text.rindex("[[daq.channel]]", 0, images)] + text[images:]).encode())


def _outside(campaign: Path) -> None:
    (campaign.parent / "secret.csv").write_text("frequency_hz\n")
    _text(RECORDING, '"bridge-response.csv"', '"../../secret.csv"')(campaign)


def _linked_outside(campaign: Path) -> None:
    shutil.copyfile(campaign / BRIDGE, campaign.parent / "elsewhere.h5")
    (campaign / BRIDGE).unlink()
    (campaign / BRIDGE).symlink_to(campaign.parent / "elsewhere.h5")


def _two_frames(campaign: Path) -> None:
    for image in campaign.glob(f"{NAME}/top-*/*.tif"):
        if int(image.stem) > 1:
            image.unlink()


CHIRP = ('frequencies = [80.0]\nharmonics = "auto"', "band = [10.0, 100.0]\nperiod = 1.0")
UNREADABLE_TDMS = _each(
    _text(RECORDING, '"bridge.h5"', '"bridge.tdms"'),
    lambda campaign: (campaign / NAME / "bridge.tdms").write_bytes(b"TDSm" + bytes(range(200)) * 20),
)

# what is broken, how, the file to be named, what else the sentence must hold
CASES: list[tuple[str, Break, str, tuple[str, ...]]] = [
    ("missing DAQ file", _drop(BRIDGE), RECORDING, ("daq.bridge.file", "bridge.h5", "an existing file")),
    (
        "missing images",
        _each(*(_drop(f"{NAME}/top-right/{frame:04d}.tif") for frame in range(24))),
        RECORDING,
        ("images.top.right", "top-right/*.tif", "at least one file"),
    ),
    (
        "truncated TIFF",
        _cut(f"{NAME}/top-left/0011.tif", 0.5),
        RECORDING,
        ("images.top.left", " top-left/0011.tif: truncated"),
    ),
    (
        "TIFF without its end",
        _cut(f"{NAME}/base-right/0000.tif", 0.001),
        RECORDING,
        ("images.base.right", " base-right/0000.tif: not a readable TIFF file"),
    ),
    (
        "damaged first image",
        _bytes(f"{NAME}/base-left/0000.tif", b"no image at all"),
        RECORDING,
        ("images.base.left", " base-left/0000.tif: not a readable TIFF file"),
    ),
    (
        "image of another size",
        _pixels(f"{NAME}/top-right/0005.tif", lambda image: image[:, :300]),
        RECORDING,
        ("images.top.right", " top-right/0005.tif: expected 304 x 240 px, found 300 x 240"),
    ),
    (
        "colour image",
        _pixels(f"{NAME}/top-right/0005.tif", lambda image: np.stack([image] * 3, axis=-1)),
        RECORDING,
        ("images.top.right", " top-right/0005.tif: expected a grey image"),
    ),
    (
        "grey values above the bit depth",
        _pixels(f"{NAME}/top-left/0000.tif", lambda image: image * 16),
        RECORDING,
        ("images.top.left", " top-left/0000.tif: expected grey values up to 1023"),
    ),
    (
        "saturated image",
        _pixels(f"{NAME}/top-right/0000.tif", _saturate),
        RECORDING,
        ("images.top.right", " top-right/0000.tif: expected an image that is not saturated", "%"),
    ),
    (
        "left and right image counts differ",
        _drop(f"{NAME}/top-right/0023.tif"),
        RECORDING,
        ("images.top.right", "found 24 left and 23 right"),
    ),
    ("two frames", _two_frames, RECORDING, ("images.top", "at least 3", "found 2")),
    (
        "fewer edges than frames",
        _each(*(_channel(file, "camera_trigger", _twenty_edges) for file in (VIBROMETER, BRIDGE))),
        RECORDING,
        ("images.top.trigger", "at least 24 edges in camera_trigger for 24 frames, found 20"),
    ),
    (
        "more edges than frames",
        _each(*(_drop(f"{NAME}/{side}/0023.tif") for side in ("top-left", "top-right"))),
        RECORDING,
        ("images.top.first_edge", "23 frames", "24 edges"),
    ),
    (
        "trigger without pulses",
        _channel(VIBROMETER, "camera_trigger", np.zeros_like),
        VIBROMETER,
        ("camera_trigger: expected a level that the signal crosses",),
    ),
    (
        "clock without shared trigger",
        _without_bridge_trigger,
        RECORDING,
        ("daq.bridge.channel", "a trigger channel of the same name as in block vibrometer"),
    ),
    (
        "trigger of another period",
        _channel(BRIDGE, "camera_trigger", lambda samples: np.repeat(samples, 2)[: len(samples)]),
        RECORDING,
        ("daq.bridge.channel.camera_trigger", "expected the trigger period of the base clock"),
    ),
    ("path outside the campaign", _outside, RECORDING, ("daq.bridge.channel.Fx.response", "../../secret.csv")),
    ("link out of the campaign", _linked_outside, RECORDING, ("daq.bridge.file", "elsewhere.h5")),
    (
        "unknown key",
        _text(RECORDING, "scale_uncertainty", "scale_uncertanty"),
        RECORDING,
        ("daq.vibrometer.channel.velocity_1.scale_uncertanty", 'probably "scale_uncertainty"'),
    ),
    (
        "wrong type",
        _text(RIG, "exposure = 6e-05", 'exposure = "60 us"'),
        RIG,
        ("stereo.top.exposure", "a number", '"60 us"'),
    ),
    ("no TOML", _text(RECORDING, "format = 1", "format = "), RECORDING, ("TOML", "line 1")),
    ("NaN in a channel", _channel(BRIDGE, "Fz", _with_nan), BRIDGE, ("Fz: expected finite samples", "sample 777")),
    (
        "channel that never changes",
        _channel(VIBROMETER, "velocity_2", np.zeros_like),
        VIBROMETER,
        ("velocity_2: expected samples that change, found 0 throughout",),
    ),
    (
        "channel of a few samples",
        _channel(BRIDGE, "Fz", lambda samples: samples[:5]),
        BRIDGE,
        ("Fz: expected more than", "complete samples, found 5"),
    ),
    (
        "channel absent from the file",
        _text(RECORDING, 'name = "velocity_3"', 'name = "velocity_9"'),
        RECORDING,
        ("daq.vibrometer.file", " vibrometer.h5: expected a channel", '"velocity_9"', '"velocity_3"'),
    ),
    (
        "corrupt HDF5",
        _bytes(BRIDGE, b"no HDF5" * 99),
        RECORDING,
        ("daq.bridge.file", " bridge.h5: expected a readable .h5 file"),
    ),
    ("truncated HDF5", _cut(BRIDGE, 0.5), RECORDING, ("daq.bridge.file", " bridge.h5: expected a readable .h5 file")),
    (
        "corrupt TDMS",
        UNREADABLE_TDMS,
        RECORDING,
        ("daq.bridge.file", " bridge.tdms: expected"),
    ),
    (
        "no calibration",
        _text(RIG, 'calibration = "calibration/base.json"\n', ""),
        RIG,
        ("stereo.base.calibration", "no calibration"),
    ),
    ("missing calibration file", _drop(CALIBRATION), RIG, ("stereo.base.calibration", "base.json")),
    (
        "calibration of another image size",
        _text(CALIBRATION, "304", "640"),
        CALIBRATION,
        ("image_size", "[304, 240]", "[640, 240]"),
    ),
    ("calibration that is no rotation", _stretched_rotation, CALIBRATION, (": rotation: expected an orthonormal",)),
    ("calibration that is no JSON", _bytes(CALIBRATION, b'{"format": 1,'), CALIBRATION, ("JSON",)),
    ("calibration that is nested without end", _bytes(CALIBRATION, b"[" * 100_000), CALIBRATION, ("JSON",)),
    ("zero mass", _text(RIG, "mass = 2.4063", "mass = 0.0"), RIG, ("load.mass", "above 0")),
    (
        "non-symmetric inertia",
        _text(RIG, "[[0.00193, 0.0, 0.0]", "[[0.00193, 0.001, 0.0]"),
        RIG,
        ("load.inertia", "a symmetric matrix", "0.001"),
    ),
    (
        "excitation of another command",
        _each(_text(RECORDING, '"sine"', '"chirp"'), _text(RECORDING, *CHIRP)),
        RECORDING,
        ("excitation.kind", "sine", "chirp"),
    ),
    (
        "frequency not present",
        _text(RECORDING, "frequencies = [80.0]", "frequencies = [95.0]"),
        RECORDING,
        ("excitation.frequencies", "expected 95 Hz to stand out of the spectrum", "vibrometer.h5"),
    ),
    ("response without a column", _text(RESPONSE, "phase_rad", "phase"), RESPONSE, ("phase_rad", "this column")),
    ("response with a text", _text(RESPONSE, "\n0.0,", "\nzero,"), RESPONSE, ("frequency_hz", '"zero" in line 2')),
    ("response with NaN", _text(RESPONSE, "\n0.0,", "\nnan,"), RESPONSE, ("frequency_hz", '"nan" in line 2')),
    ("response of too few columns", _bytes(RESPONSE, b"frequency_hz\n0\n"), RESPONSE, ("magnitude", "this column")),
    ("response that is no text", _bytes(RESPONSE, bytes(range(256))), RESPONSE, ("UTF-8",)),
    (
        "response that ends below a line",
        _bytes(RESPONSE, b"frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad\n0,1,0,0,0\n90,1,0,0,0\n"),
        RESPONSE,
        ("frequency_hz", "a range that contains 160 Hz", "0 to 90 Hz"),
    ),
]


@pytest.fixture
def no_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mistake that can be seen in the files must not cost the user the time of tracking."""

    def refuse(*_: object) -> None:
        raise AssertionError("the mistake should have been seen before tracking")

    monkeypatch.setattr(stereo_motion, "measure_body", refuse)


def _state(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Everything in a folder with size and times, to see whether anything was touched."""
    return {
        path.relative_to(folder).as_posix(): (path.lstat().st_size, path.lstat().st_mtime_ns, path.lstat().st_ino)
        for path in sorted(folder.rglob("*"))
    }


def _refused(arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command, check all that holds for every wrong input, and return the sentence."""
    before = _state(folder)
    status = main(arguments)
    told = capsys.readouterr()
    assert status == EXIT_INPUT, told.err
    assert _state(folder) == before
    assert told.out == ""
    assert told.err.startswith("shakercal: ")
    assert told.err.count("\n") == 1, told.err
    assert "Traceback" not in told.err
    return told.err.strip()


@pytest.mark.usefixtures("no_tracking")
@pytest.mark.parametrize(("break_it", "file", "parts"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_one_sentence_names_file_and_key(break_it, file, parts, campaign, capsys):
    break_it(campaign)
    arguments = ["run", str(campaign / NAME), "-o", str(campaign.parent / "out")]
    told = _refused(arguments, campaign.parent, capsys)
    assert told.startswith(f"shakercal: {campaign / file}: ")
    for part in parts:
        assert part in told
    assert told.count("expected") <= 1
    assert told.count(str(campaign / file)) == 1


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_pixels(f"{NAME}/top-right/0002.tif", _saturate), "expected an image that is not saturated"),
        (_pixels(f"{NAME}/top-right/0002.tif", lambda image: image * 16), "expected grey values up to 1023"),
    ],
)
def test_images_that_are_wrong_later_in_the_series(change, sentence, campaign, capsys, monkeypatch):
    """Pixels are seen when the tracker reads them, hence a tracker that does nothing else."""

    def read_all(images: tuple[Any, Any], *_: object) -> None:
        left, right = images
        for frame in range(len(left)):
            left.read(frame), right.read(frame)

    monkeypatch.setattr(stereo_motion, "measure_body", read_all)
    change(campaign)
    told = _refused(["run", str(campaign / NAME)], campaign, capsys)
    assert told.startswith(f"shakercal: {campaign / RECORDING}: images.top: top-right/0002.tif: {sentence}")


def test_no_recording(tmp_path, capsys):
    told = _refused(["run", str(tmp_path / "absent")], tmp_path, capsys)
    assert told.startswith(f"shakercal: {tmp_path / 'absent'}: expected a recording folder")


def test_folder_without_a_recording(tmp_path, capsys):
    told = _refused(["run", str(tmp_path)], tmp_path, capsys)
    assert told.startswith(f"shakercal: {tmp_path}: expected recording.toml in this folder")


@pytest.mark.usefixtures("no_tracking")
def test_results_never_go_among_other_files(campaign, capsys):
    out = campaign.parent / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    told = _refused(["run", str(campaign / NAME), "-o", str(out)], campaign.parent, capsys)
    assert told.startswith(f"shakercal: {out}: expected an empty folder for the results (--force")


@pytest.mark.usefixtures("no_tracking")
@pytest.mark.parametrize("place", ["thesis.txt", "thesis.txt/results"])
def test_results_need_a_folder(place, campaign, capsys):
    (campaign.parent / "thesis.txt").write_text("mine")
    told = _refused(["run", str(campaign / NAME), "-o", str(campaign.parent / place)], campaign.parent, capsys)
    assert told.startswith(f"shakercal: {campaign.parent / place}: expected a")
    assert "found a file" in told


SAMPLE = InputError(Path("rig.toml"), "stereo.top.rotation", found="2", expected="a rotation")


def test_the_sentence_names_file_key_expectation_and_finding():
    assert str(SAMPLE) == "rig.toml: stereo.top.rotation: expected a rotation, found 2"


def test_without_key_the_file_is_meant():
    assert (
        str(InputError("a.tif", "", found="3 bytes", expected="an image")) == "a.tif: expected an image, found 3 bytes"
    )


@pytest.mark.parametrize(("more", "told"), [(1, "(1 more problem in"), (2, "(2 more problems in")])
def test_further_problems_are_counted(more, told):
    assert told in str(InputError("a", "b", "c", "d", more=more))


def test_lines_of_a_reader_become_one_sentence():
    assert str(InputError("a", "b", found="x\n  y", expected="z")) == "a: b: expected z, found x y"


@pytest.mark.parametrize("error", [SAMPLE, ComputeError("no line found")])
def test_errors_can_be_sent_between_processes(error):
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert str(back) == str(error)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("{folder}/top/0003.tif: truncated"), "{file}: images.top: top/0003.tif: truncated"),
        (ValueError("{file}: rotation: expected a, found b"), "{file}: images.top: rotation: expected a, found b"),
        (ValueError("nominal_hz: expected a, found b"), "{file}: images.top: expected a, found b"),
        (ValueError("a.tif: expected a, found b"), "{file}: images.top: a.tif: expected a, found b"),
        (PermissionError(13, "Permission denied", "{folder}/a.h5"), "{file}: images.top: a.h5: Permission denied"),
        (OSError("closed"), "{file}: images.top: closed"),
    ],
)
def test_what_a_reader_says_is_told_once(error, told, tmp_path):
    names = {"folder": str(tmp_path), "file": str(tmp_path / "recording.toml")}
    filled = type(error)(*(part.format(**names) if isinstance(part, str) else part for part in error.args))
    if isinstance(error, OSError) and error.filename is not None:
        filled = PermissionError(13, "Permission denied", error.filename.format(**names))
    assert str(InputError.told_by(filled, Path(names["file"]), "images.top")) == told.format(**names)
