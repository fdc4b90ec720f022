"""Live evaluation: acceleration by the cameras alone, while frames arrive.

Frames are tracked in small blocks by the functions of `run`. Their times are those of the camera's nominal rate, until
the recorder's file states the trigger.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import LocalResult, Settings, Threads
from fusion.errors import ComputeError, InputError, as_input_error
from fusion.phasors.set_up import PreparedSetUp, fit_motions
from fusion.phasors.stereo_motion import PreparedImages, StereoMotion, motion_from_tracks, motion_lines, prepare_images
from fusion.phasors.timing import TimeBase, frame_sight
from fusion.phasors.tracked_blocks import prepare_scene, track_block
from fusion.planning.look.look_notices import LIVE_NOT_POSSIBLE
from fusion.recording.daq_records import DaqRecord, FileCache
from fusion.recording.load import Manifest, find_single_recording, load_manifest
from fusion.recording.manifest import Images
from fusion.recording.toml import read_toml
from fusion.sensitivity.recording_evaluation import evaluate_set_ups
from photogram.frame_statistics import spread_choice
from photogram.images.sequence import FrameNumbers, GreyImage, ImageSequence, full_scale_of
from photogram.measure.body import body_motion
from photogram.measure.follow import BodyScene, FollowedBlock, FollowedFrame, sine_terms
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import CAPTURE, nearest_clear_rate, separation_bins, usable_lines
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel
from shaker.timebase.trigger import PulseWidth, nominal_trigger
from shakercal._common.arrays import FloatArray, IntArray

START_FRAMES = 8  # from which a body is prepared
BLOCK_FRAMES = 32  # tracked by one thread: a compromise of latency and of starts without a prediction
ALL_SUBSETS, SUBSET_SHARE, MOST_SUBSET_FRAMES = 24, 0.125, 64
"""First frames with subsets, share of the later ones, and their largest number, which limits memory and time."""
MOST_HARMONICS = 3  # that predict a motion, in addition to its fundamental
CLEAR = 6.0  # standard uncertainties of an amplitude that is certainly a line
RATE_UNCERTAINTY = 1e-4
"""Relative standard uncertainty of a camera's nominal rate: that of a common quartz with its ageing."""
MOST_BEAT_FRAMES = 100_000
"""Frames within which a beat is expected; a longer one is none."""
IN_MEMORY = "live"
"""Name of the block that states the camera's clock."""


@dataclass(frozen=True)
class LiveFrame:
    """Frame of a stereo pair: name, frame number, and an image (H, W) per camera.

    Numbers count the camera's triggers: missing ones are lost frames.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion import LiveFrame
    >>> LiveFrame("top", 0, (np.zeros((4, 6), np.uint8), np.zeros((4, 6), np.uint8))).number
    0
    """

    pair: str
    number: int
    images: tuple[GreyImage, ...]


@dataclass(frozen=True)
class LiveValue:
    """Amplitude of a component of a body's acceleration, preliminary, in m/s² or rad/s².

    `U`: expanded (95 %). `u_noise`, `u_rest`: relative standard uncertainties, by noise of the frames and others.
    `driven`: whether it is the component along the stated excitation.
    """

    body: str
    component: str
    unit: str
    frequency_hz: float
    amplitude: float
    U: float
    k: float
    u_noise: float
    u_rest: float
    driven: bool

    @property
    def U_percent(self) -> float:
        """Expanded uncertainty relative to the amplitude, in %."""
        return 100.0 * self.U / self.amplitude


@dataclass(frozen=True)
class LiveState:
    """Preliminary result of the frames so far.

    Attributes
    ----------
    frames : tracked frames of each pair.
    beats : duration in beats of the aliases of the lines; below 1 they are not resolved.
    values : amplitudes, () while they are not resolved.
    reason : why there are no values, else "".

    Examples
    --------
    >>> from fusion import LiveState
    >>> LiveState({"top": 4}, 0.3, (), "not yet resolved").driven is None
    True
    """

    frames: dict[str, int]
    beats: float
    values: tuple[LiveValue, ...]
    reason: str = ""

    @property
    def driven(self) -> LiveValue | None:
        """Driven amplitude with the smallest relative U, of the load if it has one."""
        driven = [value for value in self.values if value.driven]
        return min(driven, key=lambda value: (value.body != "load", value.U_percent), default=None)

    def reaches(self, until: float | None) -> bool:
        """Return whether the driven amplitude has the relative U of an aim."""
        return until is not None and self.driven is not None and self.driven.U_percent <= 100.0 * until

    def frames_to(self, aim_percent: float) -> float:
        """Return the predicted number of frames to reach the aim, infinite if never.

        The noise part decreases with 1/√frames, the others do not.
        """
        value = self.driven
        if value is None:
            return float("nan")
        allowed = (aim_percent / 100.0 / value.k) ** 2 - value.u_rest**2
        count = max(self.frames.values())
        return float(np.ceil(count * value.u_noise**2 / allowed)) if allowed > 0.0 else float("inf")


class NominalClock(DaqRecord):
    """Clock of a camera without a recorder: edges at its nominal rate."""

    def pulse_width(self, trigger: str) -> PulseWidth:
        """Raise `ValueError`: no pulse is recorded."""
        raise ValueError(f"{trigger}: expected the pulses of a recorder, found the camera's nominal rate only")


@dataclass
class _LivePair:
    """Stereo pair: waiting frames, body, blocks being tracked, and tracked frames."""

    entry: Images
    waiting: list[LiveFrame] = field(default_factory=list)
    images: PreparedImages | None = None
    scene: BodyScene | None = None
    pending: deque[tuple[list[int], Future[LocalResult]]] = field(default_factory=deque)
    number: list[int] = field(default_factory=list)
    followed: list[FollowedFrame] = field(default_factory=list)
    last: int | None = None
    submitted: int = 0
    subset_frames: int = 0

    def collect(self, most: int | None) -> None:
        """Add finished blocks in order; wait until at most `most` are pending (None: never)."""
        while self.pending and (self.pending[0][1].done() or (most is not None and len(self.pending) > most)):
            numbers, block = self.pending.popleft()
            self.add(numbers, block.result().unwrap())

    def add(self, numbers: Sequence[int], block: FollowedBlock) -> None:
        """Add tracked frames; subsets of at most `MOST_SUBSET_FRAMES` are remaining."""
        for number, (found, fit) in zip(numbers, block, strict=True):
            keep = found is not None and self.subset_frames < MOST_SUBSET_FRAMES
            self.subset_frames += keep
            slim = fit if fit is None or keep else replace(fit, scores=fit.scores[:0])
            self.number.append(number)
            self.followed.append((found if keep else None, slim))


class LiveEvaluation:
    """Preliminary evaluation of a recording whose frames are added one by one.

    Parameters
    ----------
    recording : folder of the recording, or its recording.toml. Its image files and recorder files need not exist.
    rate_hz : nominal rate of the frame numbers.

    Examples
    --------
    >>> from fusion import LiveEvaluation, LiveFrame
    >>> from photogram import read_image
    >>> folder = "sample_images/demo/Fz-0080"
    >>> with LiveEvaluation(folder, 38.345) as evaluation:
    ...     for number in range(24):
    ...         images = [read_image(f"{folder}/top-{side}/{number:04d}.tif")[0] for side in ("left", "right")]
    ...         evaluation.add(LiveFrame("top", number, tuple(images)))
    ...     state = evaluation.state()
    >>> f"{state.driven.component} {state.driven.amplitude:.1f} {state.driven.unit}"
    'z 81.9 m/s^2'
    """

    def __init__(self, recording: str | Path, rate_hz: float, *, allow_outside: bool = False) -> None:
        self.manifest, self.rate_hz = _cameras_only(find_single_recording(recording), allow_outside), rate_hz
        self.lines_hz = np.array(self.manifest.excitation.frequencies or ())
        self.settings = Settings()
        self._pairs = {entry.stereo: _LivePair(entry) for entry in self.manifest.images}
        self._threads = Threads()
        self._state = LiveState(dict.fromkeys(self._pairs, 0), 0.0, (), "no frames yet")

    def __enter__(self) -> LiveEvaluation:
        return self

    def __exit__(self, *reason: object) -> None:
        self._threads.__exit__()

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of the stereo pairs."""
        return tuple(self._pairs)

    def add(self, frame: LiveFrame) -> None:
        """Add the next frame of a pair; wait while many blocks are being tracked.

        Raises `InputError` or `ComputeError` where the first frames do not show the body; these are then discarded.
        """
        pair = self._pairs[frame.pair]
        if pair.last is not None and frame.number <= pair.last:
            raise ValueError(f"frame.number: expected more than {pair.last}, found {frame.number}")
        pair.waiting.append(frame)
        pair.last = frame.number
        if len(pair.waiting) >= (START_FRAMES if pair.scene is None else BLOCK_FRAMES):
            self._submit(pair)

    def flush(self) -> None:
        """Track the frames that wait for a full block."""
        for pair in self._pairs.values():
            if pair.waiting and pair.scene is not None:
                self._submit(pair)

    def _submit(self, pair: _LivePair) -> None:
        frames, pair.waiting = pair.waiting, []
        numbers = [frame.number for frame in frames]
        if pair.scene is None or pair.images is None:
            base = self._base(numbers[-1] - numbers[0])
            pair.images = prepare_images(self.manifest, base, pair.entry, _opened(pair.entry, frames))
            with as_input_error(*pair.images.sight.where):
                pair.scene = prepare_scene(pair.images, self.settings, None)
            lead = 1 + len(pair.scene.lead)
            pair.number, pair.submitted = numbers[:lead], lead
            frames, numbers = frames[lead:], numbers[lead:]
        pair.collect(self._threads.size)
        scene = self._scene_of(pair, frames)
        pair.submitted += len(frames)
        pair.pending.append((numbers, self._threads.submit(0, track_block, scene, range(len(frames)), "cpu")))

    def _scene_of(self, pair: _LivePair, frames: Sequence[LiveFrame]) -> BodyScene:
        """Return the scene of a block of frames, which begins with its frame 0."""
        assert pair.scene is not None
        assert pair.images is not None
        names = tuple(f"{pair.entry.stereo} {frame.number}" for frame in frames)
        cameras = tuple(
            replace(camera, names=names, reader=partial(_image_of, frames, side), numbers=None, glimpse=None)
            for side, camera in enumerate(pair.images.cameras)
        )
        count = pair.submitted + np.arange(len(frames))
        searched = (count < ALL_SUBSETS) | (
            spread_choice(count, SUBSET_SHARE) & (pair.subset_frames < MOST_SUBSET_FRAMES)
        )
        time_s = np.array([frame.number - pair.number[0] for frame in frames]) / self.rate_hz
        multiples = np.outer(np.arange(1, 2 + MOST_HARMONICS), self.lines_hz).ravel()
        body = replace(pair.scene.body, terms=sine_terms(time_s, multiples))
        return replace(pair.scene, images=cameras, body=body, subset_frames=np.asarray(searched))

    def _base(self, last: int) -> TimeBase:
        """Return the nominal time base from edge 0 to beyond the last one."""
        daq = self.manifest.daq[0]
        record = NominalClock(daq, {}, 0.0)
        trigger = nominal_trigger(last + 2, 1.0 / self.rate_hz)
        return TimeBase((record,), {(daq.name, entry.name): trigger for entry in daq.channel}, {daq.name: None})

    def state(self, pending: int | None = 0) -> LiveState:
        """Evaluate the tracked frames.

        Waits until at most `pending` blocks of a pair are being tracked: with 0 for all frames that were added, with
        None for none.
        """
        return self.snapshot(pending)()

    def snapshot(self, pending: int | None = 0) -> Callable[[], LiveState]:
        """Return the evaluation of the tracked frames as a function for another thread."""
        if pending == 0:
            self.flush()
        for pair in self._pairs.values():
            pair.collect(pending)
        frames = {name: len(pair.number) if pair.followed else 0 for name, pair in self._pairs.items()}
        ready = [
            replace(pair, number=[*pair.number], followed=[*pair.followed])
            for pair in self._pairs.values()
            if pair.followed
        ]
        return partial(self._evaluated, frames, ready)

    def _evaluated(self, frames: dict[str, int], ready: Sequence[_LivePair]) -> LiveState:
        if frames == self._state.frames or not ready:
            return self._state
        self._state = self._state_of(frames, ready)
        return self._state

    def _state_of(self, frames: dict[str, int], ready: Sequence[_LivePair]) -> LiveState:
        count = min(pair.number[-1] - pair.number[0] + 1 for pair in ready)
        beats = separation_bins(self.lines_hz, self.rate_hz, count)
        if beats < 1.0:
            return LiveState(frames, beats, (), self._unresolved(beats, count))
        try:
            return LiveState(frames, beats, tuple(self._values(ready)))
        except (InputError, ComputeError) as error:
            return LiveState(frames, beats, (), f"{error.code} {error.sentence}")

    def _unresolved(self, beats: float, count: int) -> str:
        """Return why lines are not resolved, and what would resolve them."""
        if beats * MOST_BEAT_FRAMES > count:
            return f"not yet resolved: {beats:.2g} of a beat, {int(np.ceil(count / beats))} frames show one"
        better = nearest_clear_rate(self.lines_hz, self.rate_hz, MOST_BEAT_FRAMES)
        advice = "" if better is None else f"; {better:.6g} frames/s would"
        listed = ", ".join(f"{line:g}" for line in self.lines_hz)
        return f"{self.rate_hz:.6g} frames/s do not resolve {listed} Hz, whose alias has no beat{advice}"

    def _values(self, pairs: Sequence[_LivePair]) -> Iterator[LiveValue]:
        """Yield the amplitudes of all bodies by the evaluation of `run`."""
        first = min(pair.number[0] for pair in pairs)
        base = self._base(max(pair.number[-1] for pair in pairs) - first)
        motions = [self._motion(pair, base, np.array(pair.number) - first) for pair in pairs]
        lines = _lines(self.manifest, base, motions, self.lines_hz)
        measured = fit_motions(PreparedSetUp("", "", self.manifest, base, (), (), lines), motions)
        evaluation = evaluate_set_ups(self.manifest, [measured], self.settings)
        for found in (one for one in evaluation.accelerations if one.source == "fused"):
            relative = found.uncertainty.relative_to(found.phasors.value)
            fitted = [np.einsum("ki,kj->kij", one.effect, one.effect) for one in relative.influences if one.type == "A"]
            noise2 = np.sum([*(part.covariance for part in relative.random), *fitted], axis=0)
            whole2 = relative.covariance
            for line, frequency in enumerate(found.phasors.frequency_hz.tolist()):
                for c, polar in enumerate(found.polar[line]):
                    if polar is not None:
                        noise, whole = float(noise2[line, c, c]), float(whole2[line, c, c])
                        yield LiveValue(
                            found.body,
                            MOTION_COMPONENTS[c],
                            component_units(2)[c],
                            frequency,
                            polar.magnitude,
                            polar.expanded_magnitude,
                            polar.k,
                            float(np.sqrt(noise)),
                            float(np.sqrt(max(whole - noise, 0.0))),
                            c == evaluation.stated_component and bool(evaluation.lines.multiple[line] == 1),
                        )

    def _motion(self, pair: _LivePair, base: TimeBase, edges: IntArray) -> StereoMotion:
        """Return the motion of a pair's body in its tracked frames."""
        assert pair.scene is not None
        assert pair.images is not None
        timed = frame_sight(self.manifest, base, pair.images.entry, edges - edges[0], 1, int(edges[0]))
        sight = replace(pair.images.sight, time_s=timed.time_s, edge=timed.edge)
        body = body_motion(pair.scene, [tuple(pair.followed)])
        return motion_from_tracks(replace(pair.images, sight=sight), body)


def live(
    recording: str | Path, frames: Iterable[LiveFrame], rate_hz: float, until: float | None = None
) -> Iterator[LiveState]:
    """Evaluate frames of a camera while they arrive, by the cameras alone.

    Parameters
    ----------
    recording : str or Path
        Folder of the recording, or its recording.toml.
    frames : iterable of LiveFrame
        Frames of all pairs, of each pair in ascending order.
    rate_hz : float
        Nominal rate of the frame numbers in Hz.
    until : float, optional
        Relative expanded uncertainty (95 %) of the driven acceleration at which to stop; default None.

    Yields
    ------
    LiveState
        After every 32 frames of a pair, and once after all.

    Examples
    --------
    >>> from fusion import LiveFrame, live
    >>> from photogram import read_image
    >>> folder = "sample_images/demo/Fz-0080"
    >>> def camera():  # in place of the software of a camera
    ...     for number in range(24):
    ...         images = [read_image(f"{folder}/top-{side}/{number:04d}.tif")[0] for side in ("left", "right")]
    ...         yield LiveFrame("top", number, tuple(images))
    >>> *_, last = live(folder, camera(), rate_hz=38.345)
    >>> last.driven.U_percent < 1.0
    True
    """
    with LiveEvaluation(recording, rate_hz) as evaluation:
        for count, frame in enumerate(frames, 1):
            evaluation.add(frame)
            if count % (BLOCK_FRAMES * len(evaluation.pairs)) == 0:
                state = evaluation.state(pending=1)
                yield state
                if state.reaches(until):
                    return
        yield evaluation.state()


def _lines(
    manifest: Manifest, base: TimeBase, motions: Sequence[StereoMotion], nominal_hz: FloatArray
) -> LineFrequencies:
    """Return the lines in the motion.

    Where few frames show no floor of noise next to a low alias, they are the stated ones with their harmonics, refined.
    """
    try:
        return motion_lines(manifest, base, motions)[0]
    except (InputError, ComputeError):
        shown = max(motions, key=lambda motion: len(motion.sight.time_s))
        good = np.isfinite(shown.motion.pose).all(axis=1)
        time_s, pose = shown.sight.time_s[good], shown.motion.pose[good]
        multiple, label = np.divmod(np.arange((1 + MOST_HARMONICS) * len(nominal_hz)), len(nominal_hz))
        start_hz = (multiple + 1) * nominal_hz[label]
        usable, _ = usable_lines(time_s, start_hz)
        chosen = np.flatnonzero(usable)[np.argsort(start_hz[usable])]
        model = SineModel(free=tuple(label[chosen].tolist()))
        fit = fit_sines(time_s, pose, start_hz[chosen], MOTION_COMPONENTS, component_units(0), model=model)
        found_hz, size = fit.phasors.frequency_hz, np.abs(fit.phasors.value)
        off_hz = np.abs(found_hz - start_hz[chosen]) - CAPTURE * start_hz[chosen]
        clear = (size > CLEAR * np.hypot(fit.phasors.u_re, fit.phasors.u_im)).any(axis=1)
        if np.any(off_hz > 1.0 / np.ptp(time_s)) or np.any(~clear & (multiple[chosen] == 0)):
            raise
        names = tuple("stated" for _ in chosen)
        return LineFrequencies(found_hz, fit.u_frequency_hz, nominal_hz[label[chosen]], multiple[chosen] + 1, names, ())


# The recording without its recorders, and series of frames in memory.


def _cameras_only(path: Path, allow_outside: bool) -> Manifest:
    """Return a recording with its images only, on the clock of the camera.

    Image files and recorder files need not exist.
    """
    text = dict(read_toml(path))
    blocks = text.get("images")
    if text.get("take") or not isinstance(blocks, list) or not blocks:
        found = "[[take]] blocks" if text.get("take") else "no [[images]]"
        raise InputError(LIVE_NOT_POSSIBLE, path, "images", found=found, expected="[[images]] of one set-up")
    with tempfile.TemporaryDirectory() as folder:
        names = [block.get("trigger") for block in blocks if isinstance(block, dict)]
        triggers = {name for name in names if isinstance(name, str)} or {IN_MEMORY}  # the block without is refused
        channels = [{"name": name, "quantity": "trigger"} for name in triggers]
        clock: dict[str, Any] = {"name": IN_MEMORY, "clock_uncertainty": RATE_UNCERTAINTY, "channel": channels}
        text |= {"daq": [clock | {"file": _placeholder(folder, "clock")}], "points": []}
        text["images"] = [
            _in_memory(block, folder, number) if isinstance(block, dict) else block
            for number, block in enumerate(blocks)
        ]
        manifest = load_manifest(path, allow_outside=True, text=text)
    if not allow_outside and not path.parent.resolve().is_relative_to(manifest.root):
        load_manifest(path)  # raises the refusal
    manifest.check_command("run")
    if manifest.is_broadband:
        found, expected = manifest.excitation.kind, "sines or a multisine"
        raise InputError(LIVE_NOT_POSSIBLE, path, "excitation.kind", found=found, expected=expected)
    for name, pair in manifest.rig.stereo.items():
        if any(pair.row_time) and any(entry.stereo == name for entry in manifest.images):
            found, expected = "a rolling shutter", "rows that are exposed at once"
            raise InputError(
                LIVE_NOT_POSSIBLE, manifest.rig_path, f"stereo.{name}.row_time", found=found, expected=expected
            )
    return manifest


def _placeholder(folder: str, name: str) -> str:
    """Return an empty file, by which a manifest names images in memory."""
    file = Path(folder, f"{name}.csv")
    file.touch()
    return file.as_posix()


def _in_memory(block: dict[str, Any], folder: str, number: int) -> dict[str, Any]:
    """Return an [[images]] block with files in memory, and an edge per frame number."""
    remaining = {
        key: value for key, value in block.items() if key not in ("displaced_left", "displaced_right", "edge_step")
    }
    files = {side: _placeholder(folder, f"{number}-{side}") for side in ("left", "right") if side in block}
    return remaining | files | {"first_edge": 0}


def _opened(entry: Images, frames: Sequence[LiveFrame]) -> FileCache:
    """Return the first frames of an entry, as if their files were open."""
    cache, numbers = FileCache(), np.array([frame.number for frame in frames])
    counted = FrameNumbers(numbers - numbers[0], str(numbers[0]), str(numbers[-1]))
    names = tuple(f"{entry.stereo} {number}" for number in numbers)
    for side, (_, paths) in enumerate(entry.cameras):
        first = frames[0].images[side]
        bits = 8 * first.dtype.itemsize
        cache.images[paths, entry.bit_depth] = ImageSequence(
            names,
            (first.shape[1], first.shape[0]),
            full_scale_of(Path(names[0]), bits, entry.bit_depth),
            partial(_image_of, frames, side),
            numbers=counted,
            glimpse=partial(_bytes_of, frames, side),
        )
    return cache


def _image_of(frames: Sequence[LiveFrame], side: int, index: int) -> GreyImage:
    return frames[index].images[side]


def _bytes_of(frames: Sequence[LiveFrame], side: int, index: int) -> bytes:
    return frames[index].images[side][-8:].tobytes()
