"""What `run` will say of a recording: the same evaluation, with a few frames of every stereo pair."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.base import AnyNotice, ComputeError, InputError, Settings, no_progress
from fusion.estimation.fuse import Acceleration
from fusion.phasors.setup import OpenSetUp, SetUp, measure_set_ups
from fusion.phasors.setups import join_set_ups
from fusion.phasors.stereo_motion import OpenImages
from fusion.planning.look.causes import contradictions
from fusion.planning.look.finding import Finding, refusal
from fusion.recording.load import Manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.evaluate import evaluate_set_ups
from fusion.sensitivity.ratio import driven_component
from photogram.arrays import spread_choice
from photogram.images.sequence import ImageSequence
from shaker.arrays import IntArray
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS

FOLLOWED, IN_A_ROW = 24, 8
"""Frames of a pair that are followed, so many of them the first ones, from which the others are predicted."""
AWAY, FAR_AWAY = 0.7, 0.3
"""Share of the motion along what is driven, below which the direction is doubted or wrong."""


def rehearse(manifest: Manifest, opened: Sequence[OpenSetUp]) -> list[Finding]:
    """Evaluate an opened recording as `run` does, few frames of each pair, and return what speaks against it."""
    try:
        set_ups = measure_set_ups([_thinned(one) for one in opened], Settings(), no_progress)
        evaluation = evaluate_set_ups(manifest, set_ups, Settings())
    except (InputError, ComputeError) as error:
        return [refusal(error)]
    return [*_of_evaluation(evaluation, set_ups)]


def _thinned(opened: OpenSetUp) -> OpenSetUp:
    """Return a set-up with few frames of every pair."""
    return replace(opened, images=tuple(_few_frames(images) for images in opened.images))


def _few_frames(images: OpenImages) -> OpenImages:
    """Return the images of a pair with the first frames and some of the others, spread over the record in no period.

    Lines that all frames tell apart do not fold onto each other in these.
    """
    count = len(images.left)
    if count <= FOLLOWED:
        return images
    numbers = np.arange(count)
    share = (FOLLOWED - IN_A_ROW) / (count - IN_A_ROW)
    chosen = np.flatnonzero((numbers < IN_A_ROW) | spread_choice(numbers, share))
    sight = replace(images.sight, time_s=images.sight.time_s[chosen])
    return replace(images, sight=sight, cameras=tuple(_frames_of(camera, chosen) for camera in images.cameras))


def _frames_of(images: ImageSequence, chosen: IntArray) -> ImageSequence:
    names, time_s = tuple(images.names[i] for i in chosen), images.time_s
    reader = images.reader
    return replace(
        images,
        names=names,
        reader=lambda place: reader(int(chosen[place])),
        time_s=None if time_s is None else time_s[chosen],
    )


def _of_evaluation(evaluation: Evaluation, set_ups: Sequence[SetUp]) -> Iterator[Finding]:
    """Yield contradictions with their likely causes, a missing result with its reason, then every other doubt."""
    fused = [acceleration for acceleration in evaluation.accelerations if acceleration.source == "fused"]
    gravity = evaluation.manifest.rig.surroundings.free_fall_mps2[0]
    found = list(contradictions(fused, join_set_ups(set_ups).observed(gravity), set_ups))
    found += _direction(evaluation, fused)
    found += _missing(evaluation, fused)
    yield from found
    explained = {notice for acceleration in fused for notice in acceleration.notices} if found else set()
    if any("no value" in finding.text for finding in found):
        explained |= set(evaluation.sensitivity.notices if evaluation.sensitivity else ())
        explained |= set(evaluation.load.notices if evaluation.load else ())
    yield from doubted(notice for notice in evaluation.notices if notice not in explained)


def doubted(notices: Iterable[AnyNotice]) -> Iterator[Finding]:
    """Yield what follows from warnings, and from questions: those of a manifest are to be answered.

    What is assumed of motion that no instrument observes is in U, and a note.
    """
    for notice in notices:
        question, assumed = "?" in notice.text, notice.text.startswith("nothing measures ")
        if notice.where == "sensitivity" and ("as if " in notice.text or "exchanged" in notice.text):
            yield Finding("FIX MANIFEST", notice.where, notice.text)
        elif (notice.severity == "warning" and not assumed) or (question and notice.where.endswith(".toml")):
            yield Finding("CHECK", notice.where, notice.text)
        elif notice.severity == "warning" or question:
            yield Finding("KEEP", notice.where, notice.text)


def _driven(evaluation: Evaluation) -> int | None:
    """Return the load component (0 to 5) that is driven, None where no direction is stated."""
    direction, sensor = evaluation.manifest.excitation.direction, evaluation.manifest.rig.sensor
    return None if direction is None else driven_component(direction, None if sensor is None else sensor.capacity)


def _direction(evaluation: Evaluation, fused: Sequence[Acceleration]) -> Iterator[Finding]:
    """Yield that the load moves along another axis than the one stated as driven."""
    direction = evaluation.manifest.excitation.direction
    load = next((one for one in fused if one.body == "load"), fused[0] if fused else None)
    if direction is None or len(direction) != 3 or load is None or load.disputed is not None:
        return
    for line in np.flatnonzero(evaluation.lines.multiple == 1).tolist():
        motion = np.nan_to_num(load.phasors.value[line, :3])
        size = float(np.linalg.norm(motion))
        share = abs(complex(motion @ np.asarray(direction))) / size if size > 0.0 else 1.0
        if share < AWAY:
            most = int(np.argmax(np.abs(motion)))
            text = (
                f"the {load.body} moves along {MOTION_COMPONENTS[most]} at {load.phasors.frequency_hz[line]:.6g} Hz, "
                f"with {100.0 * share:.2g} % of its motion along excitation.direction = {list(direction)}"
            )
            yield Finding("FIX MANIFEST" if share < FAR_AWAY else "CHECK", "excitation.direction", text)


def _missing(evaluation: Evaluation, fused: Sequence[Acceleration]) -> Iterator[Finding]:
    """Yield that `run` will give no value of what is driven, line by line, and why."""
    component, rig = _driven(evaluation), evaluation.manifest.rig
    load = next((one for one in fused if one.body == "load"), None)
    if component is None:
        return
    driven = LOAD_COMPONENTS[component]
    for line in np.flatnonzero(evaluation.lines.multiple == 1).tolist():
        given = _given(evaluation, fused, component, line)
        if given:
            continue
        if load is None:
            why = "no instrument of the load sees this line"
        elif load.disputed is not None and load.disputed[line, component]:
            why = "instruments contradict each other"
        elif not load.observed[line, component]:
            why = f"no instrument of the load observes {MOTION_COMPONENTS[component]}"
        elif rig.sensor is not None and evaluation.outputs is None:
            why = "no channel is an output of the sensor"
        else:
            why = "it cannot be distinguished from zero"
        text = f"run will give no value of {driven} at {evaluation.lines.frequency_hz[line]:.6g} Hz: {why}"
        yield Finding("FIX MANIFEST", "", text)


def _given(evaluation: Evaluation, fused: Sequence[Acceleration], component: int, line: int) -> bool:
    """Whether the driven sensitivity, or where there is no sensor the driven motion, has a value at a line."""
    rig, result = evaluation.manifest.rig, evaluation.element or evaluation.sensitivity
    if rig.sensor is None or rig.load is None:
        return any(bool(one.observed[line, component]) for one in fused)
    if result is None:
        return False
    own = [place for place, (_, driven) in enumerate(result.elements) if driven == component]
    sizes = [abs(complex(result.value[line, result.elements[place][0], component])) for place in own]
    if not own or not np.isfinite(sizes).any():
        return False
    largest = result.polar[line][own[int(np.nanargmax(sizes))]]
    return largest is not None and not largest.region.holds_zero
