"""Wrong input: one sentence with file and key, exit status 2, nothing written, and no time lost on tracking."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from cluster_factory import InlineExecutor
from support import RefusedCommand, evaluated

from fusion.cli import main
from fusion.commands.options import EXIT_INPUT
from fusion.errors import ComputeError, InputError
from fusion.phasors.phasor_notices import PAIR_REJECTED
from fusion.recording.load import load_manifest
from fusion.recording.recording_notices import (
    CONSTANT_CHANNEL,
    INVALID_RESPONSE_VALUE,
    INVALID_VALUE,
    MISSING_RESPONSE_COLUMN,
    NO_RECORDING,
    NON_FINITE_SAMPLES,
    RESPONSE_RANGE_TOO_SMALL,
    UNKNOWN_KEY,
    UNREADABLE_DAQ_FILE,
    VALUE_OUT_OF_RANGE,
    WRONG_ENCODING,
    WRONG_EXCITATION_KIND,
)
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate import simulate
from photogram.measure import follow

NAME = "Fz-0080"
RIG, RECORDING = "rig.toml", f"{NAME}/recording.toml"
VIBROMETER, BRIDGE, RESPONSE = f"{NAME}/vibrometer.h5", f"{NAME}/bridge.h5", f"{NAME}/bridge-response.csv"
CALIBRATION = "calibration/base.json"
Break = Callable[[Path], object]


@pytest.fixture
def campaign(tmp_path: Path, demo_recording: Path) -> Path:
    """A copy of the demo campaign; files are links to the original ones until a test replaces them."""

    def link(source: str, target: str) -> None:
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)

    return Path(shutil.copytree(demo_recording, tmp_path / "campaign", copy_function=link))


def _replace(path: Path, content: bytes) -> None:
    """Write a file anew, so that the original behind the link stays as it is."""
    path.unlink()
    path.write_bytes(content)


def _file(campaign: Path, name: str) -> Path:
    """A file of the campaign, or of its recording."""
    return campaign / name if (campaign / name).exists() else campaign / NAME / name


def _drop(*files: str) -> Break:
    return lambda campaign: [_file(campaign, file).unlink() for file in files]


def _content(file: str, change: Callable[[bytes], bytes]) -> Break:
    return lambda campaign: _replace(path := _file(campaign, file), change(path.read_bytes()))


def _bytes(file: str, content: bytes) -> Break:
    return _content(file, lambda _: content)


def _cut(file: str, share: float) -> Break:
    return _content(file, lambda content: content[: int(share * len(content))])


def _text(file: str, old: str, new: str) -> Break:
    def change(content: bytes) -> bytes:
        assert old.encode() in content
        return content.replace(old.encode(), new.encode(), 1)

    return _content(file, change)


def _pixels(file: str, change: Callable[[Any], Any]) -> Break:
    def break_it(campaign: Path) -> None:
        path = _file(campaign, file)
        image = change(tifffile.imread(path))
        path.unlink()
        tifffile.imwrite(path, image)

    return break_it


def _channel(file: str, name: str, change: Callable[[Any], Any]) -> Break:
    def break_it(campaign: Path) -> None:
        path = _file(campaign, file)
        _replace(path, path.read_bytes())
        with h5py.File(path, "a") as daq:
            samples, attributes = change(daq[name][()]), dict(daq[name].attrs)
            del daq[name]
            daq[name] = samples
            daq[name].attrs.update(attributes)

    return break_it


def _each(*breaks: Break) -> Break:
    return lambda campaign: [one(campaign) for one in breaks]


def _saturate(image: Any) -> Any:
    image[60:140, 80:200] = 1023
    return image


def _with_nan(samples: Any) -> Any:
    values = samples.astype(np.float64)
    values[777] = np.nan
    return values


def _mostly_nan(samples: Any) -> Any:
    values = samples.astype(np.float64)
    values[2000:17_000] = np.nan
    return values


def _twenty_edges(samples: Any) -> Any:
    rising = np.flatnonzero((samples[1:] > 2.5) & (samples[:-1] < 2.5))
    samples[rising[20] - 5 :] = samples[0]
    return samples


def _stretched_rotation(content: bytes) -> bytes:
    calibration = json.loads(content)
    calibration["rotation"][0][0] *= 1.1
    return json.dumps(calibration).encode()


def _without_last_channel(content: bytes) -> bytes:
    images = content.index(b"[[images]]")
    return content[: content.rindex(b"[[daq.channel]]", 0, images)] + content[images:]


STEP = (
    'direction = [0.0, 0.0, 1.0]\nfrequencies = [80.0]\nharmonics = "auto"',
    'component = "Fz"\nstep_amplitude = 1.0',
)
UNREADABLE_TDMS = _each(
    _text(RECORDING, '"bridge.h5"', '"bridge.tdms"'),
    lambda campaign: (campaign / NAME / "bridge.tdms").write_bytes(b"TDSm" + bytes(range(200)) * 20),
)
ENDS_AT_90_HZ = b"frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad\n0,1,0,0,0\n90,1,0,0,0\n"
TRIGGER = "camera_trigger"
BUT_TWO = [f"top-{side}/{frame:04d}.tif" for side in ("left", "right") for frame in range(2, 24)]

# File to be named: case: change, and parts of the sentence: key, files, numbers, code. Mistakes of the manifest alone
# are tested in test_wrong_manifest.py.
WRONG: dict[str, dict[str, tuple[Break, *tuple[str, ...]]]] = {
    RECORDING: {
        "truncated TIFF": (_cut("top-left/0011.tif", 0.5), "images.top.left", " top-left/0011.tif: "),
        "TIFF without its end": (
            _cut("base-right/0000.tif", 0.001), "images.base.right", " base-right/0000.tif: ",
        ),
        "damaged first image": (
            _bytes("base-left/0000.tif", b"no image"), "images.base.left", " base-left/0000.tif: ",
        ),
        "image of another size": (
            _pixels("top-right/0005.tif", lambda image: image[:, :300]),
            "images.top.right", " top-right/0005.tif: ", "304 x 240", "300 x 240",
        ),
        "colour image": (
            _pixels("top-right/0005.tif", lambda image: np.stack([image] * 3, axis=-1)),
            "images.top.right", " top-right/0005.tif: ",
        ),
        "grey values above the bit depth": (
            _pixels("top-left/0000.tif", lambda image: image * 16),
            "images.top.left", " top-left/0000.tif: ", "1023",
        ),
        "saturated image": (
            _pixels("top-right/0000.tif", _saturate),
            "images.top.right", " top-right/0000.tif: ", "%",
        ),
        "two frames": (_drop(*BUT_TWO), "images.top", "3", "2"),
        "fewer edges than frames": (
            _each(*(_channel(file, TRIGGER, _twenty_edges) for file in (VIBROMETER, BRIDGE))),
            "images.top.trigger", "24", "20", "camera_trigger",
        ),
        "more edges than frames": (
            _drop("top-left/0023.tif", "top-right/0023.tif"), "images.top.first_edge", "23", "24",
        ),
        "clock without shared trigger": (
            _content(RECORDING, _without_last_channel),
            "daq.bridge.channel", "vibrometer",
        ),
        "trigger of another period": (
            _channel(BRIDGE, TRIGGER, lambda samples: np.repeat(samples, 2)[: len(samples)]),
            "daq.bridge.channel.camera_trigger",
        ),
        "unknown key": (
            _text(RECORDING, "scale_uncertainty", "scale_uncertanty"),
            "daq.vibrometer.channel.velocity_1.scale_uncertanty", '"scale_uncertainty"', UNKNOWN_KEY.code,
        ),
        "channel absent from the file": (
            _text(RECORDING, 'name = "velocity_3"', 'name = "velocity_9"'),
            "daq.vibrometer.file", " vibrometer.h5: ", UNREADABLE_DAQ_FILE.code, '"velocity_9"', '"velocity_3"',
        ),
        "corrupt HDF5": (
            _bytes(BRIDGE, b"no HDF5" * 99), "daq.bridge.file", " bridge.h5: ", UNREADABLE_DAQ_FILE.code,
        ),
        "truncated HDF5": (_cut(BRIDGE, 0.5), "daq.bridge.file", " bridge.h5: ", UNREADABLE_DAQ_FILE.code),
        "corrupt TDMS": (UNREADABLE_TDMS, "daq.bridge.file", " bridge.tdms: ", UNREADABLE_DAQ_FILE.code),
        "excitation of another command": (
            _each(_text(RECORDING, '"sine"', '"step"'), _text(RECORDING, *STEP)),
            "excitation.kind", "sine", "step", WRONG_EXCITATION_KIND.code,
        ),
        "frequency not present": (
            _text(RECORDING, "frequencies = [80.0]", "frequencies = [95.0]"),
            "excitation.frequencies", "95 Hz", "vibrometer.h5",
        ),
    },
    RIG: {"zero mass": (_text(RIG, "mass = 2.4063", "mass = 0.0"), "load.mass", VALUE_OUT_OF_RANGE.code)},
    VIBROMETER: {
        "trigger without pulses": (
            _channel(VIBROMETER, TRIGGER, np.zeros_like), "camera_trigger: ",
        ),
        "channel that never changes": (
            _channel(VIBROMETER, "velocity_2", np.zeros_like),
            "velocity_2: ", CONSTANT_CHANNEL.code,
        ),
    },
    BRIDGE: {
        "NaN in a trigger": (
            _channel(BRIDGE, "camera_trigger", _with_nan), "camera_trigger: ", "777", NON_FINITE_SAMPLES.code,
        ),
        "NaN in most of a channel": (
            _channel(BRIDGE, "Fz", _mostly_nan), "Fz: ", "25 %", "15000 of 19000",
        ),
        "channel of a few samples": (
            _channel(BRIDGE, "Fz", lambda samples: samples[:5]), "Fz: ", "5",
        ),
    },
    CALIBRATION: {
        "another image size": (_text(CALIBRATION, "304", "640"), "image_size", "[304, 240]", "[640, 240]"),
        "no rotation": (_content(CALIBRATION, _stretched_rotation), ": rotation: "),
        "no JSON": (_bytes(CALIBRATION, b'{"format": 1,'), "JSON"),
        "nested without end": (_bytes(CALIBRATION, b"[" * 100_000), "JSON"),
    },
    RESPONSE: {
        "without a column": (_text(RESPONSE, "phase_rad", "phase"), "phase_rad", MISSING_RESPONSE_COLUMN.code),
        "with a text": (
            _text(RESPONSE, "\n0.0,", "\nzero,"), "frequency_hz", '"zero"', "line 2", INVALID_RESPONSE_VALUE.code,
        ),
        "with NaN": (
            _text(RESPONSE, "\n0.0,", "\nnan,"), "frequency_hz", '"nan"', "line 2", INVALID_RESPONSE_VALUE.code,
        ),
        "too few columns": (_bytes(RESPONSE, b"frequency_hz\n0\n"), "magnitude", MISSING_RESPONSE_COLUMN.code),
        "no text": (_bytes(RESPONSE, bytes(range(256))), WRONG_ENCODING.code),
        "ends below a line": (
            _bytes(RESPONSE, ENDS_AT_90_HZ), "frequency_hz", "160 Hz", "0 to 90 Hz", RESPONSE_RANGE_TOO_SMALL.code,
        ),
    },
}  # fmt: skip


@pytest.fixture
def no_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mistake that can be seen in the files must not cost the user the time of tracking."""
    monkeypatch.delattr(follow, "prepare_body")


@pytest.fixture
def untouched(refused: RefusedCommand, tmp_path: Path) -> RefusedCommand:
    """Run a command that refuses its input and changes no file, and return its sentence."""

    def state() -> list[tuple[Path, int, int, int]]:
        # A released lock changes only the time of its folder.
        every = [(p, p.lstat()) for p in sorted(tmp_path.rglob("*"))]
        return [(p, s.st_size, 0 if p.is_dir() else s.st_mtime_ns, s.st_ino) for p, s in every]

    def run(*arguments: object, status: int = EXIT_INPUT) -> str:
        before = state()
        sentence = refused(*arguments, status=status)
        assert state() == before
        return sentence

    return run


@pytest.mark.usefixtures("no_tracking")
@pytest.mark.parametrize(("file", "case"), [(file, case) for file, cases in WRONG.items() for case in cases])
def test_one_sentence_names_file_and_key(file, case, campaign, untouched):
    break_it, *parts = WRONG[file][case]
    break_it(campaign)
    sentence = untouched("run", campaign / NAME, "-o", campaign.parent / "out")
    assert re.match(rf"shakercal: SC-\d{{3}} {re.escape(str(campaign / file))}: ", sentence)
    for part in parts:
        assert part in sentence
    assert sentence.count(str(campaign / file)) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("file", "case"), [(file, case) for file, cases in WRONG.items() for case in cases])
def test_check_refuses_what_a_run_refuses(file, case, campaign, capsys):
    WRONG[file][case][0](campaign)
    assert main(["check", str(campaign / NAME)]) == EXIT_INPUT
    printed = capsys.readouterr()
    assert Path(file).name in printed.out + printed.err


@pytest.mark.parametrize(("change", "part"), [(_saturate, "%"), (lambda image: image * 16, "1023")])
def test_images_that_are_wrong_later_in_the_series(change, part, campaign, untouched, monkeypatch):
    """Pixels are seen when the tracker reads them, hence a tracker that does nothing else."""

    def read_all(images: tuple[Any, Any], *_: object, **__: object) -> None:
        for frame in range(len(images[0])):
            for side in images:
                side.read(frame)

    monkeypatch.setattr(follow, "prepare_body", read_all)
    _pixels("top-right/0002.tif", change)(campaign)
    sentence = untouched("run", campaign / NAME)
    assert f" {campaign / RECORDING}: images.top: top-right/0002.tif: " in sentence
    assert part in sentence


# An error of a single stereo pair does not end the run: the pair is excluded by name.

BLIND = [_pixels(f"{pair}-right/0000.tif", lambda image: np.full_like(image, 300)) for pair in ("top", "base")]
WITHOUT_IMAGES = _content(RECORDING, lambda content: content[: content.index(b"[[images]]")])
MOTION_CHANNEL = rb'\[\[daq\.channel\]\]\n(?:(?!\n\[)[\s\S])*?quantity = "(?:velocity|acceleration)"[\s\S]*?(?=\n\[)'
WITHOUT_MOTION = _content(RECORDING, lambda content: re.sub(MOTION_CHANNEL, b"", content))


def _left_out(found, pattern):
    """Assert that both pairs are excluded by a warning whose text has a pattern."""
    notices = {n.where.split()[-1]: n for n in found.notices if n.code == PAIR_REJECTED.code}
    assert set(notices) == {"top", "base"}
    for notice in notices.values():
        assert re.search(pattern, notice.text)
    assert found.stereo == ()


def test_pairs_without_a_body_are_excluded_and_the_others_evaluated(campaign):
    """As if their pictures had not been recorded, to the last bit; by an executor too."""
    _each(*BLIND)(campaign)
    manifest = load_manifest(campaign / NAME)
    found = [evaluate_recording(manifest, executor=crew) for crew in (None, InlineExecutor())]
    WITHOUT_IMAGES(campaign)
    alone = evaluate_recording(load_manifest(campaign / NAME))
    for each in found:
        _left_out(each, r"\w+-right/0000\.tif")
        np.testing.assert_array_equal(each.load.value, alone.load.value)
        np.testing.assert_array_equal(each.load.uncertainty.covariance, alone.load.uncertainty.covariance)


def test_a_pair_without_a_body_is_wrong_input_if_it_is_the_only_motion_instrument(campaign, untouched):
    _each(*BLIND, WITHOUT_MOTION)(campaign)
    assert f" {campaign / RECORDING}: images.top: " in untouched("run", campaign / NAME)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["foil that repeats", "body lost after the first frame"])
def test_a_pair_without_a_position_of_its_body_is_excluded_by_name(case, campaign, tmp_path):
    if case == "foil that repeats":
        _left_out(evaluated(simulate(tmp_path / "foil", "demo", 3, violate=("foil-repeats",))), r"0\.\d+ m.*0\.\d+ m")
        return
    for pair in ("top", "base"):
        for frame in range(1, 24):
            _pixels(f"{pair}-right/{frame:04d}.tif", lambda image: np.full_like(image, 300))(campaign)
    _left_out(evaluated(campaign / NAME), "3.*2.*24")


def test_no_recording(tmp_path, untouched):
    absent = tmp_path / "absent"
    assert untouched("run", absent).startswith(f"shakercal: {NO_RECORDING.code} {absent}: ")
    assert untouched("run", tmp_path).startswith(f"shakercal: {NO_RECORDING.code} {tmp_path}: ")


@pytest.mark.usefixtures("no_tracking")
def test_results_never_go_among_other_files(campaign, untouched):
    out, file = campaign.parent / "out", campaign.parent / "out" / "thesis.txt"
    out.mkdir()
    file.write_text("mine")
    for path in (out, file, file / "results"):
        assert f" {path}: " in untouched("run", campaign / NAME, "-o", path)


SAMPLE = InputError(INVALID_VALUE, Path("rig.toml"), "stereo.top.rotation", found="2", expected="a rotation")


def test_the_sentence_names_file_key_expectation_and_finding():
    assert str(SAMPLE) == f"{INVALID_VALUE.code} rig.toml: stereo.top.rotation: expected a rotation, found 2"
    error = InputError(INVALID_VALUE, "a.tif", found="3\n  bytes", expected="an image")
    assert str(error) == f"{INVALID_VALUE.code} a.tif: expected an image, found 3 bytes"
    other = InputError(INVALID_VALUE, "recording.toml", "b", found="c", expected="d")
    assert "(1 more " in str(InputError.together([SAMPLE, SAMPLE]))
    assert re.search(r"\(2 more .*recording\.toml\)", str(InputError.together([SAMPLE, SAMPLE, other])))


@pytest.mark.parametrize("error", [SAMPLE, ComputeError(UNREADABLE_DAQ_FILE, reason="no line")])
def test_errors_can_be_sent_between_processes(error):
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert str(back) == str(error)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (lambda at: ValueError(f"{at}/top/0003.tif: truncated"), "top/0003.tif: truncated"),
        (lambda at: ValueError(f"{at}/recording.toml: rotation: expected a, found b"), "rotation: expected a, found b"),
        (lambda _: ValueError("nominal_hz: expected a, found b"), "expected a, found b"),
        (lambda _: ValueError("a.tif: expected a, found b"), "a.tif: expected a, found b"),
        (lambda at: PermissionError(13, "Permission denied", f"{at}/a.h5"), "a.h5: Permission denied"),
        (lambda _: OSError("closed"), "closed"),
    ],
)
def test_the_reason_of_a_reader_is_reported_once(error, reason, tmp_path):
    file = tmp_path / "recording.toml"
    refused = InputError.from_exception(error(tmp_path), file, "images.top")
    assert str(refused) == f"{refused.code} {file}: images.top: {reason}"
