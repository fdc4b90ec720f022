"""`shakercal look --live`: from arriving files to lines of the terminal, and the final evaluation."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from fusion.base import FileIdentity, cleanup_on_signal, count_text
from fusion.errors import ComputeError, InputError
from fusion.planning.look.live import BLOCK_FRAMES, LiveEvaluation, LiveState
from fusion.planning.look.live_folder import FolderFrames, FrameCounts, recorder_files
from fusion.planning.look.look import LiveHeading, WatchedPage
from fusion.recording.load import find_single_recording, load_manifest
from fusion.report.tables import main_result, result_name
from fusion.report.terminal import print_text, printable
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, component_units, sensitivity_unit
from shakercal._common.digits import number_text, quantity_text

POLL_S = 0.05  # interval of the listing of the folders
MIN_UPDATE_S, EVALUATION_SHARE = 1.0, 0.25  # between evaluations, and largest share of the time that they take
IDLE_S = 3.0  # without new frames, after which the recording has ended


@dataclass(frozen=True)
class LiveOptions:
    """Options: nominal rate, aim (relative, 95 %), page, and kind of output."""

    rate_hz: float
    until: float | None = None
    page: Path | None = None
    json: bool = False
    quiet: bool = False
    allow_outside: bool = False


@dataclass
class LiveOutput:
    """Output of states: a renewed line on a terminal, else lines or JSON; the page."""

    options: LiveOptions
    page: WatchedPage | None
    last: str = ""
    open_line: bool = field(default=False, init=False)

    def state(self, state: LiveState, counts: FrameCounts, behind: int) -> bool:
        """Show a state if it is new; return whether the aim is reached."""
        self._show(state, counts, behind)
        if reached := state.reaches(self.options.until):
            self.line(f"Aim of {_percent(100 * (self.options.until or 0))} reached: stop recording.", "reached")
        return reached

    def _show(self, state: LiveState, counts: FrameCounts, behind: int) -> None:
        text = describe_state(state, self.options.until, counts, behind / self.options.rate_hz)
        if self.page is not None:
            self.page.show_live(_heading(state, self.options.until, text))
        if text == self.last:
            return
        self.last = text
        if self.options.json:
            values = [asdict(value) for value in state.values]
            self.json("live", frames=state.frames, beats=state.beats, reason=state.reason, values=values,
                      behind=behind, **asdict(counts))  # fmt: skip
        elif sys.stdout.isatty() and not self.options.quiet:
            width = shutil.get_terminal_size().columns - 1
            stream = getattr(sys.stdout, "stream", sys.stdout)  # which does not escape the carriage return
            stream.write("\r" + printable(text)[:width].ljust(width))
            sys.stdout.flush()
            self.open_line = True
        else:
            print_text(text)
            sys.stdout.flush()

    def json(self, event: str, **content: Any) -> None:
        """Print an event as one line of JSON."""
        print(json.dumps({"event": event, **content}, ensure_ascii=False), flush=True)

    def line(self, text: str, event: str = "message", **content: Any) -> None:
        """Print a sentence on a line of its own."""
        self.close()
        if self.options.json:
            self.json(event, text=text, **content)
        else:
            print_text(text)
            sys.stdout.flush()

    def close(self) -> None:
        """End the renewed line."""
        if self.open_line:
            self.open_line = False
            sys.stdout.write("\n")
            sys.stdout.flush()


def run_live(path: Path, options: LiveOptions) -> bool:
    """Show the uncertainty of an arriving recording until it is small enough or complete.

    Returns whether the aim is reached, True without one.
    """
    recording = find_single_recording(path)
    begun = _begin(recording, options)
    with nullcontext() if options.page is None else WatchedPage(options.page) as page:
        output = LiveOutput(options, page)
        with cleanup_on_signal(output.close):
            while (reached := _follow(recording, *begun, options, output)) is None:
                output.line("The folder was emptied: the evaluation begins anew.", "restart")
                begun = _begin(recording, options)
            return reached


def _begin(recording: Path, options: LiveOptions) -> tuple[FolderFrames, LiveEvaluation]:
    """Return folders and evaluation of a recording, or refuse it before a page is written."""
    recorder_files(recording)
    frames = FolderFrames(recording)
    return frames, LiveEvaluation(recording, options.rate_hz, allow_outside=options.allow_outside)


def _follow(
    recording: Path, frames: FolderFrames, evaluation: LiveEvaluation, options: LiveOptions, output: LiveOutput
) -> bool | None:
    """Follow a series; return whether the aim is reached, None for an emptied folder."""
    last_s, due_s, tried = time.monotonic(), 0.0, object()
    begun_s, job = 0.0, None
    with evaluation, ThreadPoolExecutor(1) as worker:
        while not frames.emptied:
            new = frames.take(BLOCK_FRAMES)
            for frame in new:
                try:
                    evaluation.add(frame)
                except (InputError, ComputeError) as error:
                    output.line(f"{frame.pair}: {error} The next frames are used instead.", "refused")
            now = time.monotonic()
            last_s = now if new or frames.growing else last_s
            if now - last_s > MIN_UPDATE_S:
                evaluation.flush()
            if job is None and now >= due_s:
                begun_s, job = now, worker.submit(evaluation.snapshot(None))
            if job is not None and job.done():
                state, job = job.result(), None
                due_s = now + max(MIN_UPDATE_S, (now - begun_s) / EVALUATION_SHARE)
                if output.state(state, frames.counts, frames.behind):
                    return True
            if now - last_s > IDLE_S and (files := _identities(recording)) not in (None, tried):
                tried = files
                if output.state(evaluation.state(), frames.counts, frames.behind):
                    return True
                if (reached := _final(recording, options, output)) is not None:
                    return reached
            if not new:
                time.sleep(POLL_S)
    return None


def _identities(recording: Path) -> object:
    """Return the identities of manifest and recorders' files, None while one is incomplete."""
    files = [recording, *recorder_files(recording)]
    before = [FileIdentity.of(path) for path in files]
    if len(files) == 1 or None in before:
        return None
    time.sleep(POLL_S)
    return before if before == [FileIdentity.of(path) for path in files] else None


def _final(recording: Path, options: LiveOptions, output: LiveOutput) -> bool | None:
    """Print the evaluation of the complete recording; None where it is not possible yet."""
    output.line("The recorder's files are there: evaluation with tied clocks.", "final")
    try:
        evaluation = evaluate_recording(load_manifest(recording, allow_outside=options.allow_outside))
    except (InputError, ComputeError) as error:
        output.line(f"{error} Waiting for changed files.", "refused")
        return None
    results = list(_final_results(evaluation))
    for name, value, U, unit in results:
        text = f"  {name}: {quantity_text(value, U, unit)}, U = {_percent(100 * U / value)}"
        output.line(text, "result", name=name, value=value, U=U, unit=unit)
    warnings = sum(notice.severity == "warning" for notice in evaluation.notices)
    output.line(f"  {count_text(warnings, 'warning')}; shakercal run writes results and notices.", "warnings")
    reached = options.until is None or any(options.until * value >= U for _, value, U, _ in results[:1])
    if output.page is not None and results:
        lines = tuple(f"{name}: {quantity_text(value, U, unit)}" for name, value, U, unit in results)
        _, value, U, _ = results[0]
        output.page.show_live(LiveHeading(f"U {_percent(100 * U / value)}", lines, reached))
    return reached


def _final_results(evaluation: Evaluation) -> Iterator[tuple[str, float, float, str]]:
    """Yield name, amplitude, U and unit of the driven acceleration and of the driven sensitivities."""
    driven = evaluation.stated_component
    if driven is None:
        return
    main = main_result(evaluation)
    for line, frequency in enumerate(evaluation.lines.frequency_hz.tolist()):
        if evaluation.lines.multiple[line] != 1:
            continue
        for found in (one for one in evaluation.accelerations if one.source == "fused"):
            if (polar := found.polar[line][driven]) is not None:
                name = f"{found.body} {MOTION_COMPONENTS[driven]} at {frequency:.6g} Hz"
                yield name, polar.magnitude, polar.expanded_magnitude, component_units(2)[driven]
        if main is None:
            continue
        result, index = main
        if (polar := result.polar[line][index]) is not None:
            channel, load = result.channels[result.elements[index][0]], LOAD_COMPONENTS[driven]
            name = result_name(result.kind[line], channel, load, main=True)
            quantity = f"sensitivity {name}" if result is evaluation.element else name
            unit = sensitivity_unit(result.unit, load)
            yield f"{quantity} at {frequency:.6g} Hz", polar.magnitude, polar.expanded_magnitude, unit


# Texts of a state.


def _percent(value: float) -> str:
    return f"{number_text(value, 2)} %"


def describe_state(state: LiveState, until: float | None, counts: FrameCounts, behind_s: float) -> str:
    """Return a state in one line: frames, amplitude with U, prediction, and losses."""
    parts = [", ".join(f"{name} {count}" for name, count in state.frames.items()) + " frames"]
    value = state.driven
    if value is None:
        parts.append(state.reason or "no acceleration along `excitation.direction`")
    else:
        size = quantity_text(value.amplitude, value.U, value.unit)
        place = f"{value.body} {value.component} {value.frequency_hz:.6g} Hz"
        parts.append(f"{place}: {size}, U = {_percent(value.U_percent)} (preliminary, clocks not tied)")
        if until is not None:
            parts.append(_describe_aim(state, 100 * until))
    losses = [f"{count} {name}" for name, count in asdict(counts).items() if count]
    if behind_s >= 1.0:
        losses.append(f"{behind_s:.1f} s behind")
    return " · ".join(filter(None, [*parts, ", ".join(losses)]))


def _describe_aim(state: LiveState, aim_percent: float) -> str:
    """Return when U will be the aim."""
    needed, aim = state.frames_to(aim_percent), f"{number_text(aim_percent, 2)} %"
    if math.isinf(needed):
        floor = 100 * state.driven.k * state.driven.u_rest if state.driven else math.nan
        return f"{aim} not within reach: {_percent(floor)} remain without noise"
    return f"{aim} at about {needed:.0f} frames" if needed > max(state.frames.values()) else f"{aim} reached"


def _heading(state: LiveState, until: float | None, text: str) -> LiveHeading:
    """Return the heading of the page: U, or that lines are not resolved yet."""
    reached, value = state.reaches(until), state.driven
    word = "ENOUGH" if reached else "WAIT" if value is None else f"U {_percent(value.U_percent)}"
    return LiveHeading(word, tuple(text.split(" · ")), reached)
