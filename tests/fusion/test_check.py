"""What `check` says of a recording, and what is said of response files."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from support import AT_ORIGIN, DOCS, block, channel, edit, example_with, recording_head, write_daq

from fusion.cli import main
from fusion.errors import InputError
from fusion.instruments.channel import ChainUncertainty, ChannelReading, observe_channels
from fusion.planning.check import ASSUMED_EXACT, NOT_FUSED, check, observable_components
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.placement import measuring_point, unit_direction
from fusion.recording.response import ChainElement, read_chain, read_response
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensor.model_notices import CONTRADICTORY_MOVING_MASS
from fusion.simulate import simulate
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import Phasors

Campaign = Callable[..., Path]


def geometric_row(quantity: str, **place: tuple[float, ...]) -> np.ndarray:
    entry = ChannelEntry(name="a", quantity=quantity, body="load", **place)
    return TRANSDUCERS[quantity].geometry(measuring_point(entry), unit_direction(entry))


@pytest.mark.parametrize(
    ("instruments", "seen"),
    [
        ([((0, 0, 0.5), (0, 0, 1))], "z"),
        ([((0.03, 0, 0.04), (0, 0, 1))], ""),
        ([((0.03, 0, 0), (0, 0, 1)), ((-0.03, 0, 0), (0, 0, 1)), ((0, 0.03, 0), (0, 0, 1))], "z rx ry"),
    ],
)
def test_what_axes_see_by_themselves_and_that_gyroscopes_see_rotation(instruments, seen):
    rows = [geometric_row("acceleration", point=point, direction=direction) for point, direction in instruments]
    assert [MOTION_COMPONENTS[i] for i in np.flatnonzero(observable_components(np.array(rows)))] == seen.split()
    assert geometric_row("angular_velocity", direction=(0, 2, 0)).tolist() == [0, 0, 0, 0, 1, 0]


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 7), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_observable_means_that_no_unseen_motion_moves_it(seed, count, scale):
    """Independent definition: component i is determined if every motion that no instrument sees leaves it at zero."""
    rng = np.random.default_rng(seed)
    points, directions = rng.integers(-2, 3, (count, 3)) * scale, rng.integers(-1, 2, (count, 3))
    keep = directions.any(axis=1)
    rows = np.hstack([directions, np.cross(points, directions)])[keep].astype(float)
    if len(rows) == 0:
        return
    scaled = rows / np.repeat([1.0, scale], 3)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    unseen = vectors[:, values < 1e-9 * max(values.max(), 1.0)]
    assert observable_components(rows).tolist() == (np.abs(unseen).max(axis=1, initial=0.0) < 1e-6).tolist()


@pytest.fixture
def recording(make_campaign: Campaign) -> Path:
    """The campaign of the format's example with readable images and one readable DAQ file."""
    folder = make_campaign()
    image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    for path in folder.glob("top-*/*.tif"):
        tifffile.imwrite(path, image)
    write_daq(folder / "vibrometer.h5", 51200.0, dict.fromkeys(("velocity", "camera_trigger"), np.zeros(1000)))
    return folder


def test_a_recording_is_described(recording):
    text = str(check(load_manifest(recording)))
    for words in (
        "3 frames of 64 x 48 px",
        "1000 samples at 51200 Hz",
        "load: stereo top: x y z rx ry rz",
        "load: laser: ",
        "base: stereo base: x y z rx ry rz",
        "load mass: 6.9605 kg, adapter plate 0.412 kg",
    ):
        assert words in text


def test_what_cannot_be_read_is_wrong(recording):
    (recording / "top-left" / "0001.tif").write_bytes(b"II*\0")
    (recording / "bridge-response.csv").write_text("frequency_hz,magnitude\n1,1\n", encoding="utf-8")
    with h5py.File(recording / "vibrometer.h5", "a") as file:
        file["velocity"][3] = np.nan
    rig = recording.parent / "rig.toml"
    modes = block("[load.elastic]", name="plate", shape="modes")
    modes += block("[load.elastic.mode]", frequency=900.0, participation=[0.0, 0, 1, 0, 0, 0])
    for name in ("top", "base"):
        (recording.parent / f"calibration/{name}.json").write_text('{"format": 1}', encoding="utf-8")
    modes += "displacement = { velocity = [0.0, 0.0, 1.0] }\n\n[[part]]"
    rig.write_text(rig.read_text(encoding="utf-8").replace("[[part]]", modes, 1), encoding="utf-8")
    problems = "\n".join(check(load_manifest(recording)).problems)
    for words in (
        "rig.toml: load.elastic.plate.mode.displacement: ",
        "0001.tif",
        "top.json: image_size: ",
        "bridge.tdms",
        "result_B1.txt",
        "bridge-response.csv: phase_rad: ",
    ):
        assert words in problems


def test_a_period_that_the_record_does_not_hold_is_wrong(tmp_path):
    simulate(tmp_path / "chirp", "chirp", 1)
    folder = tmp_path / "chirp" / "chirp"
    assert not check(load_manifest(folder)).problems
    edit(folder / "recording.toml", "period = 1.0", "period = 100.0")
    (told,) = check(load_manifest(folder)).problems
    assert re.search(r"recording\.toml: excitation\.period: .* 2 .* 6 s", told)


def test_rigs_of_one_campaign_say_the_same_of_its_sensor(tmp_path, capsys):
    folder = tmp_path / "loads"
    simulate(folder, "loads", 1)
    for entry in sorted(folder.glob("step-*"))[2:]:
        shutil.rmtree(entry)
    assert main(["check", str(folder)]) == 0
    first, rig = sorted(folder.glob("rig-*.toml"))[:2]
    for key, stated, other in (("internal_mass", "0.24", "0.25"), ("internal_mass_uncertainty", "5e-05", "0.01")):
        old, new = (f"{key} = {value}" for value in (stated, other))
        edit(rig, old, new)
        capsys.readouterr()
        assert main(["check", str(folder)]) == 2
        told = capsys.readouterr().err
        start = f"{CONTRADICTORY_MOVING_MASS.code} {rig}: sensor.{key}: "
        assert start in told
        shown = first.name, stated.replace("5e-05", "5 × 10⁻⁵"), other
        assert all(value in told.partition(start)[2] for value in shown)
        assert main(["load", str(folder), "-o", str(tmp_path / "out"), "-q"]) == 2
        edit(rig, new, old)


LASER_ONLY = (
    recording_head("laser only", 100.0, direction=[0.0, 1.0, 0.0]).replace('"daq', '"vibrometer')
    + channel("velocity", "velocity", body="load", **AT_ORIGIN)
    + block("[daq]", name="drive", file="bridge.tdms")
    + channel("amplifier", "voltage")
)


def test_the_rig_is_told_once_per_campaign(make_campaign, capsys):
    folder = make_campaign()
    for number in (2, 3):
        shutil.copytree(folder, folder.parent / f"again-{number}")
    edit(folder / "recording.toml", "scale = 0.125", "scale = 0")
    edit(folder.parent / "rig.toml", "temperature = 23.0", "temperature = 300.0")
    edit(folder.parent / "rig.toml", "mass = 6.9605", "mass = -1.0")
    assert main(["check", str(folder.parent)]) == 2
    told = capsys.readouterr().err
    assert [told.count(key) for key in ("environment.temperature", "load.mass", "velocity.scale")] == [1, 1, 1]


def test_what_will_be_missing_is_remarked(make_campaign):
    folder = make_campaign(rig='format = 1\nname = "bare"\n', recording=LASER_ONLY)
    remarks = check(load_manifest(folder)).remarks
    for text in (
        "load: .* x y rx ry rz$",
        "^base ",
        "load: .* Fy$",
        r"rig\.toml .*\[load\]",
        r"rig\.toml .*\[sensor\]",
        "rig\\.toml .*gravity",
        f"channel velocity .*: {ASSUMED_EXACT}$",
        "daq drive .*trigger",
    ):
        assert any(re.search(text, remark) for remark in remarks), text


TWO_LASERS = (
    recording_head("two lasers").replace('"daq', '"vibrometer')
    + channel("velocity", "velocity", body="load", **AT_ORIGIN)
    + channel("second", "velocity", body="load", **AT_ORIGIN)
)
TABLE = "frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad\n50,1,0,{u},{u}\n200,1,0,{u},{u}\n"


@pytest.mark.parametrize(
    ("keys", "u", "effect"),
    [
        ("", 0.0, (ASSUMED_EXACT, ASSUMED_EXACT)),  # no instrument states anything: both are used
        ('response = "table.csv"', 0.002, (None, NOT_FUSED)),
        ('response = "table.csv"', 0.0, (ASSUMED_EXACT, ASSUMED_EXACT)),
        ("individual_uncertainty = 0.002", 0.0, (None, NOT_FUSED)),
        ("direction_uncertainty = 0.002", 0.0, (ASSUMED_EXACT, NOT_FUSED)),
    ],
)
def test_what_is_said_of_an_unstated_scale_is_what_the_fusion_does(make_campaign, keys, u, effect):
    """The remark against `fuse`: which of two lasers its observations count as stated."""
    text = TWO_LASERS.replace('name = "velocity"', f'name = "velocity"\n{keys}', 1)
    folder = make_campaign(rig='format = 1\nname = "bare"\n', recording=text)
    (folder / "table.csv").write_text(TABLE.format(u=u), encoding="utf-8")
    manifest = load_manifest(folder)
    remarks = [remark.partition(": ") for remark in check(manifest).remarks if remark.startswith("channel ")]
    named = [(name, one) for name, one in zip(("velocity", "second"), effect, strict=True) if one]
    assert [(remark[0].split()[1], remark[2]) for remark in remarks] == named
    lines = np.array([106.25])
    phasors = Phasors(lines, np.ones((1, 1), complex), np.eye(2)[None] * 1e-12, ("a",), ("m/s",), np.full(1, 50.0))
    readings = []
    for entry in manifest.daq[0].channel:
        response = None if entry.response is None else read_response(entry.response, lines)
        chain = ChainUncertainty() if response is None else ChainUncertainty(response.u_magnitude, response.u_phase_rad)
        readings.append(ChannelReading(entry, replace(phasors, channels=(entry.name,)), chain))
    stated = [observation.stated for observation in observe_channels(readings)]
    used = stated if any(stated) else [True, True]
    assert used == [one != NOT_FUSED for one in effect]


FREQUENCY = np.array([100.0, 1000.0, 4000.0])
DOC = (DOCS / "files.md").read_text(encoding="utf-8")


def test_the_example_of_the_format_is_a_chain_and_every_key_of_an_element_is_listed(tmp_path):
    path = tmp_path / "chain.toml"
    path.write_text(example_with("files.md", "[[element]]"), encoding="utf-8")
    response = read_response(path, FREQUENCY)
    assert len(read_chain(path).element) == 3
    b, a = signal.butter(4, 2.0 * np.pi * 10e3, analog=True)
    s = 2j * np.pi * FREQUENCY
    amplifier = s / ((s + 6.283) * (s + 628319.0))
    at = 2j * np.pi * 160.0
    amplifier = amplifier / abs(at / ((at + 6.283) * (at + 628319.0)))
    ratio = FREQUENCY / 32e3
    expected = amplifier * signal.freqs(b, a, 2.0 * np.pi * FREQUENCY)[1] * np.exp(-s * 8e-6)
    np.testing.assert_allclose(response.value, expected / (1.0 - ratio**2 + 0.04j * ratio), rtol=1e-9)
    assert {"gain of charge amplifier", "delay of anti-alias filter"} <= set(response.causes)
    section = DOC[DOC.index("| key of `[[element]]`") : DOC.index("## Digital calibration certificates")]
    told = [line.split("`")[1] for line in section.splitlines()[2:] if line.startswith("| `")]
    assert told == list(ChainElement.model_fields)


@pytest.mark.parametrize(
    ("element", "key", "words"),
    [
        ("filter = 'butterworth'\norder = 4", "element[1].corner", "filter"),
        ("filter = 'butterworth'\ncorner = 1e3", "element[1].order", "required"),
        ("filter = 'cauer'\norder = 4\ncorner = 1e3", "element[1].filter", "'bessel'"),
        ("filter = 'bessel'\norder = 40\ncorner = 1e3", "element[1].order", "12"),
        ("filter = 'resonance'\ncorner = 1e3", "element[1].damping", "required"),
        ("filter = 'resonance'\ncorner = 1e3\ndamping = 0.1\norder = 3", "element[1].order", "order 2"),
        ("filter = 'bessel'\norder = 4\ncorner = 1e3\npoles = [[-1, 0]]", "element[1].poles", "poles"),
        ("corner = 1e3", "element[1].corner", "filter"),
        ("poles = [[-1, 2]]", "element[1].poles", "conjugate"),
        ("poles = [[1, 0]]", "element[1].poles", " 0"),
        ("poles = [1, 0]", "element[1].poles", " 2 "),
        ("poles = 3", "element[1].poles", " 2 "),
        ("gain = 0.0", "element[1].gain", " 0"),
        ("gain = nan", "element[1].gain", "finite"),
        ("gian = 1.0", "element[1].gian", ' "gain"'),
        ("gain_uncertainty = -1", "element[1].gain_uncertainty", " 0"),
        ("zeros = [[0, 0]]\ngain_at = 0.0", "element", "pole"),
        ("gain = ", "", "TOML"),
        (None, "element", "element"),
    ],
)
def test_a_wrong_element_is_one_sentence_with_its_key(tmp_path, element, key, words):
    path = tmp_path / "chain.toml"
    path.write_text("format = 1\n" if element is None else f"[[element]]\n{element}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_response(path, FREQUENCY)
    assert (caught.value.file, caught.value.key) == (path, key)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("column", "row"), [("u_magnitude", "1,1,1,-1,1"), ("u_phase_rad", "1,1,1,1,-1")])
def test_negative_uncertainties_are_refused(tmp_path, column, row):
    path = tmp_path / "table.csv"
    path.write_text(f"frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad\n{row}\n", encoding="utf-8")
    refused(f"{column}: .*-1", read_response, path, np.array([1.0]), error=InputError)
