"""`shakercal look`: is this recording worth keeping; a traffic light from its data and a few of its pictures."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.base import Identity, InputError
from fusion.instruments.transducer import TRANSDUCERS, main_direction
from fusion.phasors.stereo_motion import read_rig
from fusion.planning.look.pictures import PairLook, look_at_camera, look_at_pair
from fusion.planning.look.signals import (
    LEVELS,
    Finding,
    Level,
    Strength,
    look_at_beat,
    look_at_channels,
    look_at_trigger,
    trigger_of,
)
from fusion.recording.files import recorded_channels
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.manifest import Images
from fusion.report.files import write_whole
from fusion.report.terminal import say, stdout_console
from photogram.camera import StereoRig
from photogram.images.files import open_sequence
from shaker.timebase.trigger import TriggerFit

COLOURS = {"good": "GREEN", "look": "YELLOW", "wrong": "RED"}
SAID = {
    "good": "nothing speaks against this recording",
    "look": "look at what is below before the load comes down",
    "wrong": "record again: this cannot give a good result",
}
K2 = 2.0
WATCHED_S = 2.0
THREADS = 2


@dataclass(frozen=True)
class Expected:
    """The expanded uncertainty (k = 2) to expect of a sensitivity's magnitude, relative, and what it comes from."""

    frequency_hz: float
    channel: str
    U: float
    shares: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Look:
    """What a first look at a recording has found, the worst first, and the uncertainty that its result can have.

    >>> from fusion import Look, look
    >>> found = look("sample_images/demo/Fz-0080")
    >>> isinstance(found, Look), found.level
    (True, 'good')
    """

    name: str
    path: Path
    findings: tuple[Finding, ...]
    expected: tuple[Expected, ...]

    @property
    def level(self) -> Level:
        """Return the worst of all findings: good, look (yellow) or wrong (red)."""
        return max((finding.level for finding in self.findings), key=LEVELS.index, default="good")


def look(recording: str | Path, aim: float | None = None, *, allow_outside: bool = False) -> Look:
    """Look at a recording without following an image: every channel, some pictures of every camera.

    `aim`: relative expanded uncertainty (k = 2) that the result shall have. What cannot be read is a finding, too; only
    a manifest with mistakes raises `InputError`.

    >>> from fusion import look
    >>> [finding.text for finding in look("sample_images/demo/Fz-0080", aim=1e-4).findings]  # doctest: +ELLIPSIS
    ['U (k = 2) of Fz per Fz at 80 Hz will be about 0.07... %, more than the 0.01 % aimed at']
    """
    manifest = load_manifest(recording, allow_outside=allow_outside)
    findings: list[Finding] = []
    expected: list[Expected] = []
    for where, block in manifest.set_ups:
        found, strengths, pairs = _look_at(block)
        prefix = where.rstrip(".") + " " if len(manifest.set_ups) > 1 else ""
        findings += [Finding(item.level, prefix + item.where, item.text) for item in found]
        expected += _expected(block, strengths, pairs)
    for item in expected:
        if aim is not None and aim < item.U:
            text = f"will be about {100 * item.U:.2g} %, more than the {100 * aim:.2g} % aimed at"
            findings.append(Finding("look", "", f"U (k = 2) of {item.channel} at {item.frequency_hz:g} Hz {text}"))
    findings.sort(key=lambda finding: -LEVELS.index(finding.level))
    return Look(manifest.name, manifest.path, tuple(findings), tuple(expected))


def _look_at(block: Manifest) -> tuple[list[Finding], list[Strength], dict[str, tuple[PairLook, int]]]:
    """Look at what was recorded at once: findings, driven lines by channel, pairs with their number of frames.

    Pictures are looked at beside the channels: the libraries that decode and filter them let other threads work.
    """
    found: list[Finding] = []
    strengths: list[Strength] = []
    triggers: dict[str, TriggerFit] = {}
    pairs = {}
    with ThreadPoolExecutor(THREADS) as threads:
        pictures = [threads.submit(_look_at_images, block, images) for images in block.images]
        for daq in block.daq:
            try:
                raw = recorded_channels(block, daq)
            except (OSError, ValueError, InputError) as error:
                found.append(Finding("wrong", daq.name, _short(error)))
                continue
            own, strong = look_at_channels(block, daq, raw)
            found += own
            strengths += strong
            for entry in daq.channel:
                if entry.quantity == "trigger" and np.ptp(raw[entry.name].samples) > 0.0:
                    fit = trigger_of(entry, raw[entry.name])
                    found += look_at_trigger(f"{daq.name}.{entry.name}", fit)
                    if isinstance(fit, TriggerFit):
                        triggers.setdefault(entry.name, fit)
        for images, seen in zip(block.images, pictures, strict=True):
            own, pair, frames = seen.result()
            found += own
            if frames and images.trigger in triggers:
                found += _edges(block, images, triggers[images.trigger], frames)
            if pair is not None:
                pairs[images.stereo] = pair, frames
    return found, strengths, pairs


def _look_at_images(block: Manifest, images: Images) -> tuple[list[Finding], PairLook | None, int]:
    """Look at the pictures of a stereo pair, and count its frames; of a camera alone there is nothing to compare."""
    where, pair = images.stereo, block.rig.stereo[images.stereo]
    try:
        sequences = [open_sequence(paths, images.bit_depth) for _, paths in images.cameras]
        rig = read_rig(pair, sequences)
        named = zip(images.cameras, sequences, strict=True)
        looks = [look_at_camera(f"{where} {side}", sequence) for (side, _), sequence in named]
    except (OSError, ValueError, InputError) as error:
        return [Finding("wrong", where, _short(error))], None, 0
    found = [finding for own, _ in looks for finding in own]
    counts, seen_by = [len(sequence) for sequence in sequences], [seen for _, seen in looks if seen is not None]
    if counts[0] != counts[-1]:
        found.append(Finding("wrong", where, f"{counts[0]} frames left and {counts[1]} right"))
    if not isinstance(rig, StereoRig) or len(seen_by) < len(looks):
        return found, None, counts[0]
    left, right = seen_by
    own, seen = look_at_pair(where, rig, left, right)
    return found + own, seen, counts[0]


def _edges(block: Manifest, images: Images, trigger: TriggerFit, frames: int) -> Iterator[Finding]:
    """Yield where frames and edges do not fit each other, and what the cameras' rate does to the driven lines."""
    where = images.stereo
    if trigger.edges < frames + (images.first_edge or 0):
        yield Finding("wrong", where, f"{frames} frames and only {trigger.edges} trigger edges")
    elif trigger.edges > frames and images.first_edge is None:
        text = f"{frames} frames and {trigger.edges} trigger edges: first_edge must say which are the frames'"
        yield Finding("wrong", where, text)
    yield from look_at_beat(where, block.excitation.frequencies or (), trigger, frames)


def _short(error: Exception) -> str:
    """Return what a reader says, without the folders."""
    text = " ".join(str(error).split())
    path, colon, rest = text.partition(": ")
    return f"{Path(path).name}: {rest}" if colon and "/" in path else text


def _expected(block: Manifest, strengths: list[Strength], pairs: dict[str, tuple[PairLook, int]]) -> Iterator[Expected]:
    """Yield the uncertainty to expect of the driven component's sensitivity, line by line.

    Relative variances: of the output (its noise and scale), of the load mass, and of the driven acceleration, for which
    instruments count by the inverse of theirs. Lines of `plan`'s formula, u = √(2/F)·σ for F frames. Poses, places and
    directions are left out: a few per cent of a degree matter little along what is driven.
    """
    driven, load = np.asarray(block.excitation.direction or ()), block.rig.load
    if len(driven) != 3 or load is None:
        return
    component = ("Fx", "Fy", "Fz")[int(np.argmax(np.abs(driven)))]
    for frequency in block.excitation.frequencies or ():
        here = [item for item in strengths if item.frequency_hz == frequency]
        output = next((item for item in here if item.entry.channel == component), None)
        seen = [item for item in here if item.entry.quantity in TRANSDUCERS and item.entry.body == "load"]
        aimed = [item for item in seen if abs(float(np.asarray(main_direction(item.entry)) @ driven)) > 0.5]
        amplitudes = [_displacement_m(item, driven) for item in aimed]
        motion = [
            item.u_relative**2 + item.entry.scale_uncertainty**2 + item.entry.individual_uncertainty**2
            for item in aimed
        ]
        shared = {
            item.entry.common or item.entry.name: 1 / variance for item, variance in zip(aimed, motion, strict=True)
        }
        if amplitudes:
            for name, (pair, frames) in pairs.items():
                stated = block.rig.stereo[name]
                if stated.body != "load":
                    continue
                axis = np.asarray(stated.rotation).T @ driven
                u_m = np.sqrt(2.0 / frames * float(axis @ pair.covariance_m2 @ axis))
                shared[f"stereo {name}"] = 1 / (
                    (u_m / float(np.median(amplitudes))) ** 2 + (stated.scale_uncertainty or 0.0) ** 2
                )
        if output is None or not shared:
            continue
        whole = sum(part.true_mass for part in block.part if part.body == "load") + load.true_mass
        shares = {
            "acceleration": 1 / sum(shared.values()),
            "output": output.u_relative**2 + output.entry.scale_uncertainty**2 + output.entry.individual_uncertainty**2,
            "mass": (load.mass_uncertainty / whole) ** 2,
        }
        U = K2 * float(np.sqrt(sum(shares.values())))
        told = tuple((name, K2 * float(np.sqrt(variance))) for name, variance in shares.items())
        yield Expected(frequency, f"{component} per {component}", U, told)


def _displacement_m(item: Strength, driven: np.ndarray) -> float:
    """Return the displacement along what is driven that a channel's amplitude means, m."""
    order = {"displacement": 0, "velocity": 1, "acceleration": 2}.get(item.entry.quantity, 0)
    along = abs(float(np.asarray(main_direction(item.entry)) @ driven))
    return item.amplitude / along / (2 * np.pi * item.frequency_hz) ** order


# What a person at the shaker sees.


def print_look(found: Look) -> None:
    """Print the light, then every finding, then the uncertainty to expect."""
    from rich.padding import Padding
    from rich.text import Text

    console = stdout_console()
    colour = COLOURS[found.level]
    banner = Text(f"{colour}   {found.name}\n{SAID[found.level]}", style=f"bold black on {colour.lower()}")
    console.print(
        Padding(banner, (1, 4), style=f"black on {colour.lower()}", expand=False) if console.is_terminal else banner
    )
    for finding in found.findings:
        where = f"{finding.where}: " if finding.where else ""
        say(f"  {COLOURS[finding.level].lower()}: {where}{finding.text}")
    for item in found.expected:
        shares = ", ".join(f"{name} {100 * share:.2g} %" for name, share in item.shares)
        text = (
            f"U (k = 2) to expect of {item.channel} at {item.frequency_hz:g} Hz: about {100 * item.U:.2g} % ({shares})"
        )
        say(f"  {text}")


def look_page(found: list[Look], reload_s: float | None) -> str:
    """Return a page whose colour is read from two metres; `reload_s`: how often it loads itself again."""
    from fusion.report.folder import render_page

    worst = max((look.level for look in found), key=LEVELS.index, default="good")
    values = {"looks": found, "worst": worst, "colours": COLOURS, "said": SAID, "reload_s": reload_s}
    return render_page("look.html", values)


def run_look(path: Path, aim: float | None, page: Path | None, *, watch: bool, allow_outside: bool) -> Level:
    """Look at a recording, or at each of a campaign, print and write what is seen; again whenever files change."""
    before: object = None
    while True:
        recordings = find_recordings(path)
        state = _state(recordings)
        if state != before:
            found = []
            for recording in recordings:
                found.append(_one(recording, aim, watch=watch, allow_outside=allow_outside))
                print_look(found[-1])
            if page is not None:
                write_whole(page, look_page(found, WATCHED_S if watch else None))
        if not watch:
            return max((item.level for item in found), key=LEVELS.index)
        before = state
        time.sleep(WATCHED_S)


def _one(recording: Path, aim: float | None, *, watch: bool, allow_outside: bool) -> Look:
    """Look at a recording; while it is watched, what is not yet there is a finding."""
    try:
        return look(recording, aim, allow_outside=allow_outside)
    except InputError as error:
        if not watch:
            raise
        return Look(recording.parent.name, recording, (Finding("wrong", "", f"not complete yet: {error}"),), ())


def _state(recordings: list[Path]) -> object:
    """Return what tells that a file of some recordings, or of a folder of theirs, has changed."""
    places = [place for recording in recordings for place in (recording.parent, *recording.parent.iterdir())]
    return {place: Identity.of(place) for place in places if not place.name.startswith(".")}
