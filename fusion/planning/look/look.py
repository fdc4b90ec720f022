"""`shakercal look`: verdict on a recording from its data and a few of its images."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from fusion.base import FileIdentity
from fusion.errors import ComputeError, InputError
from fusion.phasors.set_up import PreparedSetUp, prepare_set_ups
from fusion.phasors.stereo_motion import read_rig
from fusion.planning.check import inspect_recording, read_for_command
from fusion.planning.look.data_checks import (
    LineStrength,
    PairPrecision,
    examine_beat,
    examine_camera,
    examine_channels,
    examine_pair,
    examine_trigger,
    fit_trigger_channel,
    pattern_cost,
)
from fusion.planning.look.finding import (
    LEVEL_OF,
    VERDICTS,
    Finding,
    Level,
    Verdict,
    problem_finding,
    refusal_findings,
    worst_verdict,
)
from fusion.planning.look.look_notices import (
    AIM_MISSED,
    CAMERAS_DIFFER_IN_FRAMES,
    FIRST_EDGE_UNSTATED,
    INCOMPLETE_RECORDING,
    LOOK_MISSING_EDGES,
    REMARK,
)
from fusion.planning.look.trial_evaluation import notice_findings, trial_findings
from fusion.recording.daq_records import DaqRecord, FileCache
from fusion.recording.excitation import KINDS
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.manifest import Images
from fusion.recording.placement import main_direction
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.values import SensorOfCamera
from fusion.report.atomic_files import write_atomically
from fusion.report.terminal import print_text, stdout_console
from fusion.sensitivity.moving_body import moving_parts
from photogram.camera import StereoRig
from photogram.images.sensor_pattern import stated_pattern
from shaker.timebase.trigger import TriggerFit
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

COLOURS = {"good": "GREEN", "look": "YELLOW", "wrong": "RED"}
VERDICT_TEXTS: dict[Verdict, str] = {
    "KEEP": "this recording has no problem",
    "CHECK": "read the findings before the load is removed",
    "FIX MANIFEST": "a statement of recording.toml or rig.toml contradicts the data",
    "REPEAT": "record again: these data cannot give a good result",
}
K2 = 2.0
WATCHED_S = 2.0  # interval of the check for changed files, and of the writing of the page
MISSED = 5  # intervals without a new page, after which the page says that the process has ended
THREADS = 2  # for images, in addition to the one for channels


@dataclass(frozen=True)
class ExpectedUncertainty:
    """Expected U (k = 2) of a sensitivity's magnitude, relative, with its shares."""

    frequency_hz: float
    channel: str
    U: float
    shares: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Look:
    """Result of a look: findings, the worst first, and the expected uncertainty.

    Attributes
    ----------
    name, path : Of the recording.
    findings : Verdict, location and text of each finding.
    expected : Expected uncertainties, line by line.

    Examples
    --------
    >>> from fusion import Look, look
    >>> found = look("sample_images/demo/Fz-0080")
    >>> isinstance(found, Look), found.verdict, found.level
    (True, 'KEEP', 'good')
    """

    name: str
    path: Path
    findings: tuple[Finding, ...]
    expected: tuple[ExpectedUncertainty, ...]

    @property
    def verdict(self) -> Verdict:
        """Worst verdict of all findings: KEEP, CHECK, FIX MANIFEST or REPEAT."""
        return worst_verdict(self.findings)

    @property
    def level(self) -> Level:
        """Colour of the verdict: good, look (yellow) or wrong (red)."""
        return LEVEL_OF[self.verdict]


def look(recording: str | Path, aim: float | None = None, *, allow_outside: bool = False) -> Look:
    """Assess a recording from its channels, some images of every camera, and a trial evaluation.

    Parameters
    ----------
    recording
        The recording: its recording.toml, or the folder of it.
    aim
        Target relative expanded uncertainty (k = 2); default None.
    allow_outside
        Whether files outside the recording's folder are allowed; default False.

    Returns
    -------
    Findings and expected uncertainty. Files that cannot be read are findings.

    Raises
    ------
    InputError : The manifest has errors.

    Examples
    --------
    >>> from fusion import look
    >>> look("sample_images/demo/Fz-0080", aim=1e-4).findings[0].text  # doctest: +ELLIPSIS
    'U (k = 2) of Fz per Fz at 80 Hz will be about 0.07... %, more than the target of 0.01 %.'
    """
    manifest, already = load_manifest(recording, allow_outside=allow_outside), FileCache()
    problems, set_ups = _open_recording(manifest, already)
    records = {(one.where, record.entry.name): record for one in set_ups for record in one.base.records}
    findings: list[Finding] = []
    expected: list[ExpectedUncertainty] = []
    for where, block in manifest.set_ups:
        found, strengths, pairs = _look_at(block, where, already, records)
        prefix = where.rstrip(".") + " " if len(manifest.set_ups) > 1 else ""
        findings += [item.at(prefix + item.where) for item in found]
        expected += _expected(block, strengths, pairs)
    if set_ups and worst_verdict(findings) != "REPEAT":
        problems += trial_findings(manifest, set_ups)
    reported = " ".join(finding.text for finding in findings)
    findings += (finding for finding in problems if finding.text.rpartition(": ")[2] not in reported)
    for item in expected:
        if aim is not None and aim < item.U:
            percent = {"expected_percent": 100 * item.U, "aim_percent": 100 * aim}
            notice = Notice(AIM_MISSED, "", channel=item.channel, frequency_hz=item.frequency_hz, **percent)
            findings.append(Finding("CHECK", notice))
    findings.sort(key=lambda finding: -VERDICTS.index(finding.verdict))
    return Look(manifest.name, manifest.path, tuple(findings), tuple(expected))


def _open_recording(manifest: Manifest, already: FileCache) -> tuple[list[Finding], tuple[PreparedSetUp, ...]]:
    """Open a recording as its command does.

    Returned are the errors of that command, and the opened set-ups of `run`.
    """
    report, kind = inspect_recording(manifest, already), KINDS[manifest.excitation.kind]
    if report.problems:
        return [problem_finding(text) for text in report.problems], ()
    if kind.commands[0] != "run":
        problems, notices = read_for_command(manifest, already)
        findings = [problem_finding(text) for text in problems]
        if kind.remarks is None:  # otherwise these notices are among the remarks
            notices = [*manifest.notices, *notices]
        else:
            remarks = [text for text in report.remarks if text not in kind.command_remark]
            findings += [Finding("CHECK", Notice(REMARK, "", remark=text)) for text in remarks]
        return [*findings, *notice_findings(notices)], ()
    try:
        return [], prepare_set_ups(manifest, already)
    except (InputError, ComputeError) as error:
        return refusal_findings(error), ()


def _look_at(
    block: Manifest, where: str, already: FileCache, records: Mapping[tuple[str, str], DaqRecord]
) -> tuple[list[Finding], list[LineStrength], dict[str, tuple[PairPrecision, int]]]:
    """Return findings, driven lines by channel, and pairs of a block.

    A pair has its number of frames. Images are examined in parallel with the channels: the image libraries release the
    interpreter.
    """
    found: list[Finding] = []
    strengths: list[LineStrength] = []
    triggers: dict[str, TriggerFit] = {}
    pairs = {}
    with ThreadPoolExecutor(THREADS) as threads:
        image_jobs = [threads.submit(_look_at_images, block, images, already) for images in block.images]
        for daq in block.daq:
            raw = already.channels.get((where, daq.name), {})
            if not raw:  # `inspect_recording` reports problems of the file
                continue
            slowest_hz = block.excitation.slowest_hz
            record = records.get((where, daq.name)) or DaqRecord(daq, raw, 0.0, slowest_hz=slowest_hz)
            channel_findings, strong = examine_channels(block, record)
            found += channel_findings
            strengths += strong
            for entry in daq.channel:
                if entry.quantity == "trigger" and np.ptp(raw[entry.name].samples) > 0.0:
                    fit = fit_trigger_channel(record, entry)
                    found += examine_trigger(f"{daq.name}.{entry.name}", fit)
                    if isinstance(fit, TriggerFit):
                        triggers.setdefault(entry.name, fit)
        lines = block.excitation.frequencies or ()
        if any(finding.verdict == "FIX MANIFEST" for finding in found):  # other lines were driven
            lines = tuple({strength.frequency_hz for strength in strengths})
        for images, seen in zip(block.images, image_jobs, strict=True):
            channel_findings, pair, frames = seen.result()
            found += channel_findings
            if frames and images.trigger in triggers:
                found += _edges(lines, images, triggers[images.trigger], frames)
            if pair is not None:
                pairs[images.stereo] = pair, frames
    return found, strengths, pairs


def _look_at_images(
    block: Manifest, images: Images, already: FileCache
) -> tuple[list[Finding], PairPrecision | None, int]:
    """Return findings and precision of a pair and its number of frames.

    A single camera has no precision.
    """
    where, pair = images.stereo, block.rig.stereo[images.stereo]
    try:
        sequences = [already.images[paths, images.bit_depth] for _, paths in images.cameras]
        rig = read_rig(pair, sequences)
        named = zip(images.cameras, sequences, strict=True)
        looks = [examine_camera(f"{where} {side}", sequence) for (side, _), sequence in named]
    except KeyError:  # `inspect_recording` reports problems of the files
        return [], None, 0
    except (OSError, ValueError, InputError) as error:
        return refusal_findings(error, where), None, 0
    found = [finding for camera_findings, _ in looks for finding in camera_findings]
    counts, seen_by = [len(sequence) for sequence in sequences], [seen for _, seen in looks if seen is not None]
    if counts[0] != counts[-1] and not isinstance(images.first_edge, dict):
        found.append(Finding("REPEAT", Notice(CAMERAS_DIFFER_IN_FRAMES, where, left=counts[0], right=counts[1])))
    stated = [entry or SensorOfCamera() for entry in (pair.left, pair.right)][: len(seen_by)]
    if len(seen_by) == len(looks) and not any(one.dark or one.flat for one in stated):
        known = [stated_pattern(one.prnu, one.dsnu) for one in stated]
        found += pattern_cost(where, seen_by, known, sequences[0].full_scale)
    if not isinstance(rig, StereoRig) or len(seen_by) < len(looks):
        return found, None, counts[0]
    left, right = seen_by
    camera_findings, seen = examine_pair(where, rig, left, right)
    return found + camera_findings, seen, counts[0]


def _edges(lines: Sequence[float], images: Images, trigger: TriggerFit, frames: int) -> Iterator[Finding]:
    """Yield contradictions between frames and edges, and aliases of the driven lines."""
    where, first = images.stereo, images.first_edge
    if not isinstance(first, dict) and trigger.edges < frames + (first or 0):
        yield Finding("REPEAT", Notice(LOOK_MISSING_EDGES, where, frames=frames, edges=trigger.edges))
    elif trigger.edges > frames and images.first_edge is None:
        yield Finding("FIX MANIFEST", Notice(FIRST_EDGE_UNSTATED, where, frames=frames, edges=trigger.edges))
    yield from examine_beat(where, lines, trigger, frames)


def _expected(
    block: Manifest, strengths: list[LineStrength], pairs: dict[str, tuple[PairPrecision, int]]
) -> Iterator[ExpectedUncertainty]:
    """Yield the expected uncertainty of the driven component's sensitivity, line by line.

    Relative variances: of the output (noise and scale), of all moving masses, and of the driven acceleration.
    Instruments are weighted by their inverse variance. Lines are those of `plan`'s formula, u = √(2/F)·σ for F
    frames. Poses, positions and directions are omitted: small angles have little effect along the driven direction.
    """
    driven, moving = np.asarray(block.excitation.direction or ()), moving_parts(block.rig, block.part)
    if len(driven) != 3 or not moving:
        return
    component = ("Fx", "Fy", "Fz")[int(np.argmax(np.abs(driven)))]
    for frequency in block.excitation.frequencies or ():
        at_line = [item for item in strengths if item.frequency_hz == frequency]
        output = next((item for item in at_line if item.entry.channel == component), None)
        seen = [item for item in at_line if item.entry.quantity in TRANSDUCERS and item.entry.body == "load"]
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
        shares = {
            "acceleration": 1 / sum(shared.values()),
            "output": output.u_relative**2 + output.entry.scale_uncertainty**2 + output.entry.individual_uncertainty**2,
            "mass": sum(part.u_mass_kg**2 for part in moving) / sum(part.mass_kg for part in moving) ** 2,
        }
        U = K2 * float(np.sqrt(sum(shares.values())))
        named_shares = tuple((name, K2 * float(np.sqrt(variance))) for name, variance in shares.items())
        yield ExpectedUncertainty(frequency, f"{component} per {component}", U, named_shares)


def _displacement_m(item: LineStrength, driven: np.ndarray) -> float:
    """Return the driven displacement of a channel's amplitude, m."""
    order = {"displacement": 0, "velocity": 1, "acceleration": 2}.get(item.entry.quantity, 0)
    along = abs(float(np.asarray(main_direction(item.entry)) @ driven))
    return item.amplitude / along / (2 * np.pi * item.frequency_hz) ** order


# Output for the operator at the shaker.


def print_look(found: Look) -> None:
    """Print the colour, the findings, and the expected uncertainty."""
    from rich.padding import Padding
    from rich.text import Text

    console = stdout_console()
    colour = COLOURS[found.level]
    banner = Text(
        f"{colour}   {found.name}\n{found.verdict}: {VERDICT_TEXTS[found.verdict]}",
        style=f"bold black on {colour.lower()}",
    )
    console.print(
        Padding(banner, (1, 4), style=f"black on {colour.lower()}", expand=False) if console.is_terminal else banner
    )
    for finding in found.findings:
        location = " ".join(filter(None, (finding.code, f"{finding.where}:" if finding.where else "")))
        label = "note" if finding.verdict == "KEEP" else finding.verdict
        print_text(f"  {label}: {location} {finding.text}")
    for item in found.expected:
        shares = ", ".join(f"{name} {number_text(100 * share, 2)} %" for name, share in item.shares)
        text = (
            f"expected U (k = 2) of {item.channel} at {item.frequency_hz:.6g} Hz: about {100 * item.U:.2g} % ({shares})"
        )
        print_text(f"  {text}")


@dataclass(frozen=True)
class LiveHeading:
    """Heading of a live page: `word`, `lines` below it, and whether the aim is reached."""

    word: str
    lines: tuple[str, ...]
    reached: bool


def look_page(
    found: Sequence[Look],
    reload_s: float | None,
    looked_s: float | None = None,
    *,
    busy: bool = False,
    live: LiveHeading | None = None,
) -> str:
    """Return a page whose colour and word can be read from two metres.

    `reload_s`: interval of its writing and reloading, None without. The page turns grey when it is older than some of
    these. `looked_s`: time of the look, by default now. `busy`: changed files are being examined. `live`: heading of a
    live evaluation in place of the verdict.
    """
    from fusion.report.folder import render_page

    verdict = worst_verdict([finding for one in found for finding in one.findings])
    written_s = time.time()
    looked_s = written_s if looked_s is None else looked_s
    values: dict[str, Any] = {
        "looks": found,
        "verdict": verdict,
        "level": LEVEL_OF[verdict],
        "colours": COLOURS,
        "said": VERDICT_TEXTS,
    }
    values |= {"reload_s": reload_s, "busy": busy, "live": live, "written_ms": round(1e3 * written_s)}
    values |= {"limit_ms": round(1e3 * MISSED * (reload_s or 0.0)), "looked_at": _clock(looked_s)}
    values["written_at"] = _clock(written_s)
    return render_page("look.html", values)


def _clock(time_s: float) -> str:
    """Return the local time of day, such as 13:05:07."""
    return time.strftime("%H:%M:%S", time.localtime(time_s))


class WatchedPage:
    """The page of a watched folder, written again at every interval while the process runs.

    A page that is no longer renewed shows that the process has ended.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._found: tuple[Look, ...] = ()
        self._looked_s = time.time()
        self._busy = True
        self._live: LiveHeading | None = None
        self._ended, self._lock = Event(), Lock()
        self._thread = Thread(target=self._renew, daemon=True)

    def __enter__(self) -> WatchedPage:
        self._write()
        self._thread.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._ended.set()
        self._thread.join()
        if self._live is not None and reason[0] is None:  # the last state, which does not become old
            write_atomically(self.path, look_page((), None, self._looked_s, live=self._live))

    def begin(self) -> None:
        """Show that changed files are being examined."""
        with self._lock:
            self._busy, self._looked_s = True, time.time()
        self._write()

    def show(self, found: Sequence[Look]) -> None:
        """Show the looks that are complete."""
        with self._lock:
            self._busy, self._found, self._looked_s = False, tuple(found), time.time()
        self._write()

    def show_live(self, heading: LiveHeading) -> None:
        """Show the state of a live evaluation."""
        with self._lock:
            self._live, self._looked_s = heading, time.time()
        self._write()

    def _write(self) -> None:
        with self._lock:
            page = look_page(self._found, WATCHED_S, self._looked_s, busy=self._busy, live=self._live)
            write_atomically(self.path, page)

    def _renew(self) -> None:
        while not self._ended.wait(WATCHED_S):
            with suppress(OSError):  # a full or absent disk: the page turns grey until it is back
                self._write()


def run_look(path: Path, aim: float | None, page: Path | None, *, watch: bool, allow_outside: bool) -> Level:
    """Print and write the look at a recording or campaign; with `watch` after every change."""
    if not watch:
        found = []
        for recording in find_recordings(path):
            found.append(_one(recording, aim, watch=False, allow_outside=allow_outside))
            print_look(found[-1])
        if page is not None:
            write_atomically(page, look_page(found, None))
        return LEVEL_OF[worst_verdict([finding for item in found for finding in item.findings])]
    with nullcontext() if page is None else WatchedPage(page) as shown:
        before: object = None
        while True:
            recordings = find_recordings(path)
            state = _state(recordings)
            if state != before:
                found = []
                if shown is not None:
                    shown.begin()
                for recording in recordings:
                    found.append(_one(recording, aim, watch=True, allow_outside=allow_outside))
                    print_look(found[-1])
                if shown is not None:
                    shown.show(found)
            before = state
            time.sleep(WATCHED_S)


def _one(recording: Path, aim: float | None, *, watch: bool, allow_outside: bool) -> Look:
    """Return the look at a recording; with `watch` an incomplete one is a finding."""
    try:
        return look(recording, aim, allow_outside=allow_outside)
    except InputError as error:
        if not watch:
            raise
        incomplete = Finding("REPEAT", Notice(INCOMPLETE_RECORDING, "", reason=str(error)))
        return Look(recording.parent.name, recording, (incomplete,), ())


def _state(recordings: list[Path]) -> object:
    """Return the identities of all files of some recordings, to detect changes."""
    paths = [path for recording in recordings for path in (recording.parent, *recording.parent.iterdir())]
    return {path: FileIdentity.of(path) for path in paths if not path.name.startswith(".")}
