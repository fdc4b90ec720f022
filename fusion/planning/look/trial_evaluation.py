"""Trial evaluation of a recording with a few frames of every pair."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.base import Settings, no_progress
from fusion.errors import ComputeError, InputError
from fusion.estimation.fuse import Acceleration
from fusion.phasors.set_up import MeasuredSetUp, PreparedSetUp, measure_set_ups
from fusion.phasors.set_up_merging import join_set_ups
from fusion.phasors.stereo_motion import PreparedImages
from fusion.planning.look.causes import find_contradictions
from fusion.planning.look.finding import Finding, refusal_findings
from fusion.planning.look.look_notices import INDISTINCT_SENSITIVITY, OTHER_DIRECTION_DRIVEN
from fusion.recording.load import Manifest
from fusion.recording.plausibility_notices import LOAD_HANGS
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import driven_component
from fusion.sensitivity.recording_evaluation import evaluate_set_ups
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES, OUTPUT_LAGS, UNOBSERVED_MOTION_LARGE
from photogram.frame_statistics import spread_choice
from photogram.images.sequence import ImageSequence
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shakercal._common.arrays import IntArray
from shakercal._common.notices import Notice

FOLLOWED, IN_A_ROW = 24, 8
"""Tracked frames of a pair, and the number of consecutive ones, from which the others are predicted."""
DOUBTFUL_SHARE, WRONG_SHARE = 0.7, 0.3
"""Share of the motion along the stated direction, below which the direction is doubtful or wrong."""

QUESTIONABLE_CODES = (LOAD_HANGS.code, OUTPUT_LAGS.code)
"""Notes on unusual statements of a manifest, which a person has to check."""


def trial_findings(manifest: Manifest, set_ups: Sequence[PreparedSetUp]) -> list[Finding]:
    """Evaluate an opened recording as `run` does, with few frames, and return the findings."""
    try:
        measured = measure_set_ups([_with_few_frames(one) for one in set_ups], Settings(), no_progress)
        evaluation = evaluate_set_ups(manifest, measured, Settings())
    except (InputError, ComputeError) as error:
        return refusal_findings(error)
    return [*_of_evaluation(evaluation, measured)]


def _with_few_frames(set_up: PreparedSetUp) -> PreparedSetUp:
    """Return a set-up with few frames of every pair."""
    return replace(set_up, images=tuple(_few_frames(images) for images in set_up.images))


def _few_frames(images: PreparedImages) -> PreparedImages:
    """Return the first frames of a pair and some others, spread without a period.

    Lines that all frames resolve are not aliased onto each other in these.
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
        reader=lambda index: reader(int(chosen[index])),
        time_s=None if time_s is None else time_s[chosen],
    )


def _of_evaluation(evaluation: Evaluation, set_ups: Sequence[MeasuredSetUp]) -> Iterator[Finding]:
    """Yield contradictions with likely causes, a missing result with its reason, then others."""
    fused = [acceleration for acceleration in evaluation.accelerations if acceleration.source == "fused"]
    gravity = evaluation.manifest.rig.surroundings.free_fall_mps2[0]
    found = list(find_contradictions(fused, join_set_ups(set_ups).observed(gravity), set_ups))
    found += _direction(evaluation, fused)
    found += _indistinct(evaluation)
    yield from found
    explained = {notice for acceleration in fused for notice in acceleration.notices} if found else set()
    if any(notice.code == NO_RESULT_AT_LINES.code for notice in evaluation.notices):
        explained |= set(evaluation.sensitivity.notices if evaluation.sensitivity else ())
        explained |= set(evaluation.load.notices if evaluation.load else ())
    yield from notice_findings(notice for notice in evaluation.notices if notice not in explained)


def notice_findings(notices: Iterable[Notice]) -> Iterator[Finding]:
    """Yield the findings of notices.

    The assumed limit of motion without an instrument is included in U: its warning is only a note here.
    """
    for notice in notices:
        doubted, assumed = notice.code in QUESTIONABLE_CODES, notice.code == UNOBSERVED_MOTION_LARGE.code
        if notice.values.get("mistake_explains") or notice.code == NO_RESULT_AT_LINES.code:
            yield Finding("FIX MANIFEST", notice)
        elif (notice.severity == "warning" and not assumed) or (doubted and notice.where.endswith(".toml")):
            yield Finding("CHECK", notice)
        elif notice.severity == "warning" or doubted:
            yield Finding("KEEP", notice)


def _driven(evaluation: Evaluation) -> int | None:
    """Return the driven load component (0 to 5), None without a stated direction."""
    direction, sensor = evaluation.manifest.excitation.direction, evaluation.manifest.rig.sensor
    return None if direction is None else driven_component(direction, None if sensor is None else sensor.capacity)


def _direction(evaluation: Evaluation, fused: Sequence[Acceleration]) -> Iterator[Finding]:
    """Yield a motion of the load along another axis than the stated one."""
    direction = evaluation.manifest.excitation.direction
    load = next((one for one in fused if one.body == "load"), fused[0] if fused else None)
    if direction is None or len(direction) != 3 or load is None or load.disputed is not None:
        return
    for line in np.flatnonzero(evaluation.lines.multiple == 1).tolist():
        motion = np.nan_to_num(load.phasors.value[line, :3])
        size = float(np.linalg.norm(motion))
        share = abs(complex(motion @ np.asarray(direction))) / size if size > 0.0 else 1.0
        if share < DOUBTFUL_SHARE:
            most = int(np.argmax(np.abs(motion)))
            axis, stated = MOTION_COMPONENTS[most], str(list(direction))
            numbers = {"frequency_hz": float(load.phasors.frequency_hz[line]), "share_percent": 100.0 * share}
            notice = Notice(
                OTHER_DIRECTION_DRIVEN, "excitation.direction", body=load.body, axis=axis, direction=stated, **numbers
            )
            yield Finding("FIX MANIFEST" if share < WRONG_SHARE else "CHECK", notice)


def _indistinct(evaluation: Evaluation) -> Iterator[Finding]:
    """Yield driven sensitivities that are not significantly different from zero, line by line."""
    component, result = _driven(evaluation), evaluation.element or evaluation.sensitivity
    driven_elements = (
        [] if result is None else [e for e, (_, driven) in enumerate(result.elements) if driven == component]
    )
    if result is None or not driven_elements:
        return
    for line in np.flatnonzero(evaluation.lines.multiple == 1).tolist():
        sizes = np.abs(
            [
                result.value[line, result.elements[element][0], result.elements[element][1]]
                for element in driven_elements
            ]
        )
        main = result.polar[line][driven_elements[int(np.argmax(np.nan_to_num(sizes)))]]
        if main is not None and main.region.holds_zero:
            load = LOAD_COMPONENTS[result.elements[driven_elements[0]][1]]
            frequency_hz = float(evaluation.lines.frequency_hz[line])
            notice = Notice(INDISTINCT_SENSITIVITY, "sensitivity", component=load, frequency_hz=frequency_hz)
            yield Finding("CHECK", notice)
