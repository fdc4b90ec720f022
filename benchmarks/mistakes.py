"""Whether the program asks back where a manifest has a mistake that a laboratory plausibly makes.

    python benchmarks/mistakes.py [--blind] [--only NAME ...] [--rig demo|uniaxial] [--write docs/assumptions-tables.md]

Each mistake is put into the manifests of the demo and of a light uniaxial recording of the simulator, which are right
otherwise; `check` and `run` see them as a user's. What either says that it does not say of the right manifests counts
if it has the words that name the suspicion. `--blind`: a list whose words were written down before it was tried; where
nothing is said of one, by how much of its U the main sensitivity is off. Some three minutes on one core each.
"""

from __future__ import annotations

import argparse
import copy
import json
import re
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from marked import existing_file, write_marked
from violations import RIGS, opening, preset_of

from fusion.base import Settings
from fusion.errors import ComputeError, InputError
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.toml import to_toml
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.sines import driven, rendered_run, write_run
from fusion.simulate.world import Draws, make_world

Text = dict[str, Any]
DEMO = Path(__file__).resolve().parent.parent / "sample_images" / "demo"
RIG_NAMES = ("demo", "uniaxial")
HEAD = "| mistake | demo | uniaxial | notice |\n|---|---|---|---|"
NAMED = ("disagree", "rejected", "contradict")
"""Words of a warning that names instruments or channels but not the cause: the mistake is noticed, no more."""
SEED = 11


@dataclass(frozen=True)
class Mistake:
    """One mistake: what it does to rig, recording and their folder; words of which the question has one."""

    name: str
    make: Callable[[Text, Text, Path], None]
    words: tuple[str, ...]
    rigs: tuple[str, ...] = RIG_NAMES


def _times(value: Any, factor: float) -> Any:
    return [_times(item, factor) for item in value] if isinstance(value, list) else value * factor


def _rig(table: str, key: str, factor: float) -> Callable[[Text, Text, Path], None]:
    """Multiply a value of a table of rig.toml."""

    def make(rig: Text, _: Text, __: Path) -> None:
        rig[table][key] = _times(rig[table][key], factor)

    return make


def _every_channel(change: Callable[[Text], object], quantity: str, most: int | None = None) -> Any:
    """Do something to all channels of a quantity, or to the first ones."""

    def make(_: Text, recording: Text, __: Path) -> None:
        own = [c for daq in recording["daq"] for c in daq["channel"] if c["quantity"] == quantity]
        for channel in own[:most]:
            change(channel)

    return make


def _channels(key: str, change: Callable[[Any], Any], quantity: str, first: bool = False) -> Any:
    """Change a key of all channels of a quantity, or of the first."""
    return _every_channel(lambda c: c.update({key: change(c.get(key))}), quantity, 1 if first else None)


def _exchanged(quantity: str, names: tuple[str, str]) -> Callable[[Text, Text, Path], None]:
    """Exchange the names of two channels in their file."""

    def make(_: Text, recording: Text, __: Path) -> None:
        own = {c["name"]: c for daq in recording["daq"] for c in daq["channel"] if c["quantity"] == quantity}
        for name, other in (names, names[::-1]):
            own[name]["in_file"] = other

    return make


def _main_output(key: str, change: Callable[[Any], Any]) -> Callable[[Text, Text, Path], None]:
    """Change a key of the channel of output Fz."""

    def make(_: Text, recording: Text, __: Path) -> None:
        (own,) = [c for daq in recording["daq"] for c in daq["channel"] if c.get("channel") == "Fz"]
        own[key] = change(own.get(key))

    return make


def _pairs(key: str, change: Callable[[Any], Any]) -> Callable[[Text, Text, Path], None]:
    """Change a key of the first stereo pair."""

    def make(rig: Text, _: Text, __: Path) -> None:
        pair = next(iter(rig["stereo"].values()))
        pair[key] = change(pair.get(key))

    return make


def _calibration(change: Callable[[Text], None]) -> Callable[[Text, Text, Path], None]:
    """Change the calibration of the first stereo pair."""

    def make(rig: Text, _: Text, folder: Path) -> None:
        file = folder / next(iter(rig["stereo"].values()))["calibration"]
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))

    return make


def _focal(factor: float) -> Callable[[Text], None]:
    def change(content: Text) -> None:
        for side in ("left", "right"):
            for place in (0, 1):
                content[side]["matrix"][place][place] *= factor

    return change


def _base_line(content: Text) -> None:
    content["translation"] = _times(content["translation"], 1000.0)


def _rate(factor: float) -> Callable[[Text, Text, Path], None]:
    """State another sampling rate of the first DAQ file."""

    def make(_: Text, recording: Text, folder: Path) -> None:
        file = next(folder.glob("*/recording.toml")).parent / recording["daq"][0]["file"]
        with h5py.File(file, "r+") as stored:
            for own in (stored, *stored.values()):
                if "sample_rate" in own.attrs:
                    own.attrs["sample_rate"] = own.attrs["sample_rate"] * factor

    return make


def _no_response(_: Text, recording: Text, __: Path) -> None:
    for daq in recording["daq"]:
        for channel in daq["channel"]:
            if channel["quantity"] == "output":
                for key in ("response", "delay_uncertainty", "delay"):
                    channel.pop(key, None)


def _degrees_in_response(_: Text, recording: Text, folder: Path) -> None:
    """Write the phases of the amplifier's table in degrees."""
    names = {c.get("response") for daq in recording["daq"] for c in daq["channel"]} - {None}
    place = next(folder.glob("*/recording.toml")).parent
    for file in (place / name for name in names):
        head, *rows = file.read_text().splitlines()
        column = head.split(",").index("phase_rad")
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[column] = f"{np.degrees(float(row[column])):.9g}"
        file.write_text("\n".join([head, *(",".join(row) for row in cells)]) + "\n")


def _set(table: str, key: str, value: Any) -> Callable[[Text, Text, Path], None]:
    def make(rig: Text, recording: Text, _: Path) -> None:
        (recording if table == "excitation" else rig)[table][key] = value

    return make


def _sense(rig: Text, _: Text, __: Path) -> None:
    rig["sensor"]["sense"] = {"on_load": "on_sensor", "on_sensor": "on_load"}[rig["sensor"]["sense"]]


def _clockwise(rig: Text, _: Text, __: Path) -> None:
    """State the rotation of the first pair from sensor to camera."""
    pair = next(iter(rig["stereo"].values()))
    pair["rotation"] = [list(row) for row in zip(*pair["rotation"], strict=True)]


def _negative(value: list[float]) -> list[float]:
    return [-element for element in value]


MISTAKES = (
    Mistake("mass of the load in g", _rig("load", "mass", 1e3), ("load.mass",)),
    Mistake("mass of the load in t", _rig("load", "mass", 1e-3), ("load.mass", "load.inertia")),
    Mistake("mass inside the sensor in g", _rig("sensor", "internal_mass", 1e3), ("sensor.internal_mass",)),
    Mistake("inertia of the load in kg mm²", _rig("load", "inertia", 1e6), ("load.inertia",)),
    Mistake("inertia of the load in kg cm²", _rig("load", "inertia", 1e4), ("load.inertia",)),
    Mistake("inertia of the load in g m²", _rig("load", "inertia", 1e-3), ("load.mass", "load.inertia")),
    Mistake(
        "centre of mass of the load in mm", _rig("load", "centre_of_mass", 1e3), ("load.centre_of_mass",), ("demo",)
    ),
    Mistake(
        "centre of mass of the load in cm", _rig("load", "centre_of_mass", 1e2), ("load.centre_of_mass",), ("demo",)
    ),
    Mistake("laser points in mm", _channels("point", lambda v: _times(v, 1e3), "velocity"), (".point",)),
    Mistake("laser points in cm", _channels("point", lambda v: _times(v, 1e2), "velocity"), (".point",)),
    Mistake("rated loads in kN", _rig("sensor", "capacity", 1e-3), ("sensor.capacity",)),
    Mistake("static sensitivity per kN", _rig("sensor", "static_sensitivity", 1e3), ("sensor.static_sensitivity",)),
    Mistake("static sensitivity in mV/V", _rig("sensor", "static_sensitivity", 1e3), ("sensor.static_sensitivity",)),
    Mistake(
        "outputs in mV/V stated as V/V", _channels("scale", lambda v: 1e3 * v, "output"), ("load.mass", "scale, delay")
    ),
    Mistake("sense of the outputs reversed", _sense, ("sensor.sense", "sign")),
    Mistake("output Fz reversed", _main_output("scale", lambda v: -v), ("sign",)),
    Mistake("outputs Fx and Fz exchanged", _exchanged("output", ("Fx", "Fz")), ("exchanged",)),
    Mistake("first laser reversed", _channels("direction", _negative, "velocity", True), ("sign",)),
    Mistake("two lasers exchanged", _exchanged("velocity", ("velocity_1", "velocity_2")), ("exchanged",)),
    Mistake("velocity in mm/s", _channels("scale", lambda v: 1e3 * v, "velocity"), ("thousand",)),
    Mistake("acceleration in g", _channels("scale", lambda v: v / 9.80665, "acceleration"), ("values in g",)),
    Mistake("gravity points up", _rig("environment", "gravity", -1.0), ("gravity",)),
    Mistake("gravity in g", _rig("environment", "gravity", 1 / 9.8113), ("environment.gravity",)),
    Mistake("temperature in K", _set("environment", "temperature", 296.15), ("environment.temperature",)),
    Mistake("angle of beams in degrees", _channels("direction_uncertainty", np.degrees, "velocity"), ("direction_u",)),
    Mistake("u of a scale in per cent", _channels("scale_uncertainty", lambda v: 1e2 * v, "velocity"), ("scale_u",)),
    Mistake("delay of an output in ms", _main_output("delay", lambda _: 0.12), (".delay", "delay or response")),
    Mistake("delay of an output in µs", _main_output("delay", lambda _: 120.0), (".delay",)),
    Mistake("response of the amplifier missing", _no_response, ("response of its measuring chain",)),
    Mistake("phases of a response in degrees", _degrees_in_response, ("delay or response",), ("demo",)),
    Mistake("frequency in kHz", _set("excitation", "frequencies", [0.08]), ("excitation.frequencies",)),
    Mistake("frequency in rad/s", _set("excitation", "frequencies", [502.65]), ("excitation.frequencies",)),
    Mistake("sampling rate in kHz", _rate(1e-3), ("sampling rates",)),
    Mistake("sampling rate a tenth too high", _rate(1.1), ("sampling rates",)),
    Mistake("exposure in ms", _pairs("exposure", lambda v: 1e3 * v), ("exposure",)),
    Mistake("exposure in µs", _pairs("exposure", lambda v: 1e6 * v), ("exposure",)),
    Mistake("place of a pair in mm", _pairs("translation", lambda v: _times(v, 1e3)), (".translation",)),
    Mistake("rotation of a pair from sensor to camera", _clockwise, (".rotation",)),
    Mistake("focal length in mm", _calibration(_focal(0.01)), ("focal", "matrix", ".json"), ("demo",)),
    Mistake("focal length of another lens", _calibration(_focal(1.4)), ("focal", "matrix", ".json"), ("demo",)),
    Mistake("base line of a pair in mm", _calibration(_base_line), ("m apart",), ("demo",)),
)


# A second list, written down before any of it was tried.


def _part_forgotten(rig: Text, _: Text, __: Path) -> None:
    del rig["part"]


def _part_twice(rig: Text, _: Text, __: Path) -> None:
    rig["load"]["mass"] += rig["part"][0]["mass"]


def _about_the_origin(rig: Text, _: Text, __: Path) -> None:
    """State the load's inertia about the sensor's origin."""
    load = rig["load"]
    centre = np.array(load["centre_of_mass"])
    steiner = load["mass"] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    load["inertia"] = (np.array(load["inertia"]) + steiner).tolist()


def _axes_of_inertia(rig: Text, _: Text, __: Path) -> None:
    rig["load"]["inertia"] = np.array(rig["load"]["inertia"])[::-1, ::-1].tolist()


def _moved(table: str, key: str, shift: Sequence[float]) -> Callable[[Text, Text, Path], None]:
    def make(rig: Text, _: Text, __: Path) -> None:
        rig[table][key] = (np.array(rig[table][key]) + shift).tolist()

    return make


def _calibrations_exchanged(rig: Text, _: Text, __: Path) -> None:
    top, base = rig["stereo"]["top"], rig["stereo"]["base"]
    top["calibration"], base["calibration"] = base["calibration"], top["calibration"]


def _cameras_exchanged(_: Text, recording: Text, __: Path) -> None:
    for pair in recording["images"]:
        pair["left"], pair["right"] = pair["right"], pair["left"]


def _bodies_of_pairs(_: Text, recording: Text, __: Path) -> None:
    first, second = recording["images"]
    for side in ("left", "right"):
        first[side], second[side] = second[side], first[side]


def _falling(_: Text, recording: Text, __: Path) -> None:
    for daq in recording["daq"]:
        for channel in daq["channel"]:
            if channel["quantity"] == "trigger":
                channel["edge"] = "falling"


def _at_the_end(rig: Text, _: Text, __: Path) -> None:
    """Take the trigger for the end of the exposure."""
    for pair in rig["stereo"].values():
        pair["delay"] = -pair["exposure"]


def _quarter_turn(rig: Text, _: Text, __: Path) -> None:
    pair = rig["stereo"]["top"]
    pair["rotation"] = (np.array(pair["rotation"]) @ [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).tolist()


def _place_in_sensor_frame(rig: Text, _: Text, __: Path) -> None:
    pair = rig["stereo"]["top"]
    pair["translation"] = (-np.array(pair["rotation"]).T @ pair["translation"]).tolist()


def _frames_gone(side: str, first: bool) -> Callable[[Text, Text, Path], None]:
    """Lose the first (or last) frame of one camera, and the last (first) one of the other, or five of both."""

    def make(_: Text, __: Text, folder: Path) -> None:
        place = next(folder.glob("*/recording.toml")).parent
        for name in ("top-left", "top-right"):
            files = sorted((place / name).glob("*.tif"))
            gone = files[:5] if side == "both" else files[:1] if (name == side) == first else files[-1:]
            for file in gone:
                file.unlink()

    return make


def _per_millimetre(rig: Text, _: Text, __: Path) -> None:
    matrix = np.array(rig["sensor"]["static_sensitivity"])
    matrix[:, 3:] /= 1e3
    rig["sensor"]["static_sensitivity"] = matrix.tolist()


def _transposed(rig: Text, _: Text, __: Path) -> None:
    rig["sensor"]["static_sensitivity"] = np.array(rig["sensor"]["static_sensitivity"]).T.tolist()


def _decimal_comma(_: Text, __: Text, folder: Path) -> None:
    file = next(folder.glob("*/bridge-response.csv"))
    file.write_text(file.read_text().replace(".", ","))


BLIND = (
    Mistake("adapter plate forgotten", _part_forgotten, ("mass", "part"), ("demo",)),
    Mistake("adapter plate weighed with the load, and stated again", _part_twice, ("mass", "part"), ("demo",)),
    Mistake("mass of another load, 5 % more", _rig("load", "mass", 1.05), ("mass",)),
    Mistake("centre of mass from the load's lower face", _moved("load", "centre_of_mass", [0, 0, -0.012]), ("centre",)),
    Mistake("centre of mass of opposite sign", _rig("load", "centre_of_mass", -1.0), ("centre", "gravity"), ("demo",)),
    Mistake("inertia about the sensor's origin", _about_the_origin, ("inertia",)),
    Mistake("axes of the inertia exchanged", _axes_of_inertia, ("inertia",)),
    Mistake("mass inside the sensor left at 0", _set("sensor", "internal_mass", 0.0), ("internal_mass",)),
    Mistake(
        "x and y of laser points exchanged", _channels("point", lambda p: [p[1], p[0], p[2]], "velocity"), ("point",)
    ),
    Mistake(
        "height of laser points from the table",
        _channels("point", lambda p: [*p[:2], p[2] + 0.04], "velocity"),
        ("point",),
    ),
    Mistake("all lasers reversed", _channels("direction", _negative, "velocity"), ("direction", "sign")),
    Mistake(
        "all lasers in the next range",
        _channels("scale", lambda v: 2 * v, "velocity"),
        ("scale", "range", "twice", "factor"),
    ),
    Mistake(
        "velocity taken for displacement",
        _every_channel(lambda c: c.update(quantity="displacement"), "velocity"),
        ("quantity", "displacement"),
    ),
    Mistake(
        "one laser said to look at the base",
        _every_channel(lambda c: c.update(body="base"), "velocity", 1),
        ("velocity_1",),
    ),
    Mistake(
        "accelerometer of the base said to be on the load",
        _every_channel(lambda c: c.update(body="load"), "acceleration"),
        ("base_acceleration",),
    ),
    Mistake(
        "scale of the accelerometer upside down",
        _channels("scale", lambda v: 1 / v, "acceleration"),
        ("scale", "base_acceleration"),
    ),
    Mistake(
        "rms for peak in the accelerometer's scale",
        _channels("scale", lambda v: v / np.sqrt(2), "acceleration"),
        ("scale", "rms"),
    ),
    Mistake("calibrations of two pairs exchanged", _calibrations_exchanged, ("calibration",), ("demo",)),
    Mistake("left and right cameras exchanged", _cameras_exchanged, ("exchanged", "left and right"), ("demo",)),
    Mistake("pictures of the two pairs exchanged", _bodies_of_pairs, ("images", "top", "body"), ("demo",)),
    Mistake("other edge of the camera trigger", _falling, ("edge", "trigger"), ("demo",)),
    Mistake("trigger taken for the end of the exposure", _at_the_end, ("delay", "exposure"), ("demo",)),
    Mistake("pair turned by a right angle about z", _quarter_turn, ("rotation",), ("demo",)),
    Mistake("place of the cameras for that of the sensor", _place_in_sensor_frame, ("translation",), ("demo",)),
    Mistake("five frames of a pair not copied", _frames_gone("both", True), ("frames", "edges"), ("demo",)),
    Mistake("one camera a frame late", _frames_gone("top-left", True), ("frame",), ("demo",)),
    Mistake("gravity along y", _set("environment", "gravity", [0.0, -9.8113, 0.0]), ("gravity",)),
    Mistake("outputs Fx and Fy exchanged", _exchanged("output", ("Fx", "Fy")), ("exchanged",)),
    Mistake("moments of the static sensitivity per N mm", _per_millimetre, ("static_sensitivity",)),
    Mistake("static sensitivity transposed", _transposed, ("static",)),
    Mistake(
        "outputs in V, supply of 5 V forgotten", _channels("scale", lambda v: 5 * v, "output"), ("static", "scale")
    ),
    Mistake("12 bits of 10", _pairs("bit_depth", lambda _: 12), ("bit",), ("demo",)),
    Mistake("half the driven frequency", _set("excitation", "frequencies", [40.0]), ("frequenc",)),
    Mistake("axis of the shaker along x", _set("excitation", "direction", [1.0, 0.0, 0.0]), ("direction",)),
    Mistake("commas in the response table", _decimal_comma, ("bridge-response.csv",), ("demo",)),
)


def right(rig: str, folder: Path) -> Path:
    """Write a recording without mistakes; return its campaign."""
    if rig == "demo":
        shutil.copytree(DEMO, folder / rig)
        return folder / rig
    motion = np.array([[0.24, 0.18, 60.0, 1.3, 2.0, 1.2], [0.01, 0.01, 0.24, 0.05, 0.05, 0.05]])
    phases = np.exp(2j * np.pi * np.random.default_rng(SEED).uniform(size=motion.shape))
    preset = replace(driven(preset_of(RIGS["axial"]), "Fz", 106.25, motion * phases), name="uniaxial")
    draws = Draws(SEED, True)
    (folder / rig).mkdir()
    write_run(folder / rig, rendered_run(preset), make_world(preset, draws, 30e-9), draws)
    return folder / rig


@dataclass(frozen=True)
class Told:
    """What `check` and `run` say of a recording, and its main sensitivity (magnitude, U), None where there is none."""

    texts: tuple[str, ...]
    main: tuple[float, float] | None = None


def said(campaign: Path) -> Told:
    """Return what `check` and `run` say of a campaign's only recording."""
    recording = next(campaign.glob("*/recording.toml")).parent
    try:
        manifest = load_manifest(recording)
        report = check(manifest)
        told = [*report.remarks, *report.problems]
        found = evaluate_recording(manifest, Settings())
        told += [f"{n.where}: {n.explanation} [{n.code}]" for n in found.notices]
    except (InputError, ComputeError) as error:
        return Told((str(error),))
    own, place = found.sensitivity, (2, 2)
    if own is None or place not in own.elements:
        return Told(tuple(told))
    n, value = own.elements.index(place), complex(own.value[0, 2, 2])
    turn = np.array([value.real, value.imag]) / abs(value)
    both = [n, n + len(own.elements)]
    u = float(np.sqrt(turn @ own.uncertainty.covariance[0][np.ix_(both, both)] @ turn))
    return Told(tuple(told), (abs(value), 2 * u))


def asked(mistake: Mistake, campaign: Path, usual: Sequence[str]) -> tuple[list[str], list[str], Told]:
    """Return the questions asked of a campaign with a mistake, all that is said and none of `usual`, and all."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(shutil.copytree(campaign, Path(scratch) / "campaign"))
        files = folder / "rig.toml", next(folder.glob("*/recording.toml"))
        rig, recording = (tomllib.loads(file.read_text()) for file in files)
        own = copy.deepcopy(rig), copy.deepcopy(recording)
        mistake.make(*own, folder)
        for file, text in zip(files, own, strict=True):
            file.write_text(to_toml(text))
        known = {opening(text) for text in usual}
        told = said(folder)
        new = [text.replace(f"{folder}/", "") for text in told.texts if opening(text) not in known]
    return [text for text in new if any(word in text for word in mistake.words)], new, told


def notice_of(text: str) -> str:
    """Return code and place of a message."""
    code = re.search(r"SC-\d+", text)
    place = re.match(r"(?:SC-\d+ )?(?:[\w./-]+\.toml: )?([\w./-]+):", text)
    return f"{code.group() if code else ''} {f'`{place.group(1)}`' if place else ''}".strip()


def silent(told: Told, usual: Told) -> str:
    """Say what a mistake of which nothing is said does to the main sensitivity."""
    if told.main is None or usual.main is None:
        return "silent, no result"
    off = (told.main[0] - usual.main[0]) / usual.main[1]
    return f"silent, {off:+.1f} U" if abs(off) <= 1 else f"**silent, {off:+.1f} U**"


def main(argv: Sequence[str] | None = None) -> int:
    """Try every mistake; print the table, and write it where told."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--rig", choices=RIG_NAMES)
    parser.add_argument("--blind", action="store_true", help="the second list, whose words were chosen beforehand")
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args(argv)
    lines = [HEAD]
    with tempfile.TemporaryDirectory() as scratch:
        rigs = {rig: right(rig, Path(scratch)) for rig in RIG_NAMES if options.rig in (None, rig)}
        usual = {rig: said(campaign) for rig, campaign in rigs.items()}
        for mistake in (
            m for m in (BLIND if options.blind else MISTAKES) if not options.only or m.name in options.only
        ):
            cells, quoted = [], ""
            for rig in RIG_NAMES:
                if rig not in rigs or rig not in mistake.rigs:
                    cells.append("–")
                    continue
                found, new, told = asked(mistake, rigs[rig], usual[rig].texts)
                named = any(word in text for text in new for word in NAMED)
                cells.append("named" if found else "noticed" if named else silent(told, usual[rig]))
                quoted = quoted or next((text for text in found if "SC-" in text), next(iter(found), ""))
                if not found:
                    print(f"{mistake.name} ({rig}): " + " ## ".join(text[:230] for text in new), file=sys.stderr)
            lines.append(f"| {mistake.name} | {' | '.join(cells)} | {notice_of(quoted)} |")
            print(lines[-1], flush=True)
    if options.write is not None:
        write_marked(options.write, {"blind mistakes" if options.blind else "mistakes": "\n".join(lines)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
