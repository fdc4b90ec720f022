"""Trial evaluation: findings of `run` on short records, contradictions, and mistakes that explain them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from fusion.base import Settings, no_progress
from fusion.errors import ComputeError, InputError
from fusion.estimation.fuse import Acceleration
from fusion.estimation.instrument_consistency import (
    Consistency,
    exchanged_channels,
    find_suspicions,
    likely_mistake,
    without_readings,
)
from fusion.estimation.least_squares import FusionSolution, FusionSystem, build_system, solve
from fusion.estimation.measurement_model import SCALE, Observation
from fusion.instruments.channel import ChannelGeometry
from fusion.instruments.stereo import StereoReading
from fusion.phasors.phasor_notices import FRAMES_OF_OTHER_EDGES
from fusion.phasors.set_up import MeasuredSetUp, PreparedSetUp, measure_set_ups
from fusion.phasors.set_up_merging import join_set_ups
from fusion.phasors.stereo_motion import PreparedImages
from fusion.planning.look.finding import Finding, refusal_findings
from fusion.planning.look.look_notices import (
    CONTRADICTORY_READINGS,
    EXPLAINED_CONTRADICTION,
    INDISTINCT_SENSITIVITY,
    OTHER_DIRECTION_DRIVEN,
)
from fusion.recording.load import Manifest
from fusion.recording.placement import main_direction, measuring_point
from fusion.recording.plausibility_notices import LOAD_HANGS
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_set_ups
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES, OUTPUT_LAGS, UNOBSERVED_MOTION_LARGE
from photogram.frame_statistics import spread_choice
from photogram.geometry import skew, vector_from_rotation
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shaker.sine.phasor import derivative_factor
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

EXPLAINS = 0.01
"""Largest remaining share of chi-square if a mistake explains a contradiction."""
AGREEMENT = 0.03
"""Largest relative distance of a reading from the prediction of another direction or quantity."""
STATED = 0.9
"""Cosine to the stated direction from which an axis is the stated one."""
TRIED = 4
"""Number of best poses and edges, by a linear comparison, for a complete comparison."""
LATEST = 3
"""Largest shift of frames in trigger edges."""


def find_contradictions(
    fused: Sequence[Acceleration], observations: Sequence[Observation], set_ups: Sequence[MeasuredSetUp]
) -> Iterator[Finding]:
    """Yield for each body the contradictory readings, with mistakes that would explain them."""
    for acceleration in fused:
        blamed = [test for test in acceleration.consistency if test.suspect or test.left_out]
        if not blamed:
            continue
        on_body = [one for one in observations if one.body == acceleration.body]
        gross = any(test.left_out for test in blamed) or any(one.gross for one in acceleration.explanations)
        causes = list(dict.fromkeys(_causes(acceleration, blamed, on_body, set_ups))) if gross else []
        readings = " or ".join(map(_reading, blamed[:3])) + (f" or {len(blamed) - 3} more" if blamed[3:] else "")
        where = f"instruments of the {acceleration.body}"
        notice = Notice(CONTRADICTORY_READINGS, where, readings=readings)
        if causes:
            notice = Notice(EXPLAINED_CONTRADICTION, where, readings=readings, causes=", or ".join(causes))
        yield Finding("FIX MANIFEST" if causes or acceleration.disputed is not None else "CHECK", notice)


def _reading(test: Consistency) -> str:
    """Return the ratio of readings to the prediction of the others, in words."""
    if not np.isfinite(test.ratio):
        return (
            f"{test.instrument} contradicts the others by {number_text(test.normalised_deviation)} "
            f"standard uncertainties"
        )
    rotation = (
        f", with a phase of {number_text(np.angle(test.ratio))} rad" if abs(np.angle(test.ratio)) > AGREEMENT else ""
    )
    return f"{test.instrument} reads {number_text(abs(test.ratio), 4)} times the prediction of the others{rotation}"


def _causes(
    acceleration: Acceleration,
    blamed: Sequence[Consistency],
    observations: Sequence[Observation],
    set_ups: Sequence[MeasuredSetUp],
) -> Iterator[str]:
    """Yield mistakes that explain a contradiction: simple ones, otherwise a pair's pose or edge."""
    system = build_system(observations, acceleration.unobserved_limits)
    first = solve(system)
    plain = list(_plain(acceleration, blamed, system, first))
    yield from plain
    names = {test.instrument for test in blamed}
    for index, one in enumerate(observations):
        if not plain and isinstance(one.geometry, StereoReading) and one.title in names:
            yield from _of_pair(one.geometry, index, system, first, set_ups)


def _plain(
    acceleration: Acceleration, blamed: Sequence[Consistency], system: FusionSystem, first: FusionSolution
) -> Iterator[str]:
    """Yield scale factors, exchanged channels, other quantities and directions of channels."""
    for test in blamed:
        name, whole, _ = test.instrument.partition(" as a whole")
        indices = [index for index, one in enumerate(system.observations) if whole and one.title == name]
        rows = np.flatnonzero(np.isin(system.observation, indices) if whole else _of_member(system, name))
        mistake = likely_mistake(test.ratio) if np.isfinite(test.ratio) else ""
        if mistake:
            readings = system.readings.copy()
            readings[rows] /= test.ratio.real
            if solve(replace(system, readings=readings)).chi2 < EXPLAINS * first.chi2:
                yield f"{mistake} ({test.instrument})"
        others = build_system(without_readings(system, rows), acceleration.unobserved_limits)
        value = np.nan_to_num(np.where(others.observed, solve(others).acceleration, np.nan))
        for index in np.unique(system.observation[rows]).tolist():
            yield from _of_channels(system.observations[index], np.unique(system.channel[rows]), value, test.instrument)
    for a, b in exchanged_channels(system, first, find_suspicions(system, first)):
        yield f"{a} and {b} were exchanged"


def _of_channels(one: Observation, channels: IntArray, value: ComplexArray, name: str) -> Iterator[str]:
    """Yield another quantity of channels, or direction of one, that agrees with the prediction.

    The strongest line is compared. `value` (K, 6): the acceleration without these channels.
    """
    geometry, line = one.geometry, int(np.argmax(np.linalg.norm(value / SCALE, axis=1)))
    if not isinstance(geometry, ChannelGeometry) or not len(channels):
        return
    frequency_hz = one.phasors.frequency_hz[line : line + 1]
    reading, predicted = one.phasors.value[line, channels], one.design[line, channels] @ value[line]
    for order in (-2, -1, 1, 2):
        other = complex(derivative_factor(frequency_hz, order)[0]) * predicted
        if np.all(np.abs(reading - other) < AGREEMENT * np.abs(reading)):
            yield f"{name} measured another quantity than {geometry.transducer.quantity}"
    entry = geometry.entries[channels[0]]
    for direction in np.vstack([np.eye(3), -np.eye(3)]) if len(channels) == 1 else ():
        along = geometry.transducer.geometry(measuring_point(entry), direction)
        row = geometry.transducer.rows(along, frequency_hz, geometry.gravity_mps2)[0]
        stated = abs(float(np.asarray(main_direction(entry)) @ direction)) > STATED
        if not stated and abs(row @ value[line] - reading[0]) < AGREEMENT * abs(reading[0]):
            yield f"the direction of {name} were ({', '.join(f'{number_text(x, 6)}' for x in direction)})"


def _of_member(system: FusionSystem, name: str) -> BoolArray:
    """Return the rows (N,) of a channel or stereo pair."""
    return np.asarray(system.member == (system.member_names.index(name) if name in system.member_names else -1))


def _of_pair(
    reading: StereoReading, index: int, system: FusionSystem, first: FusionSolution, set_ups: Sequence[MeasuredSetUp]
) -> Iterator[str]:
    """Yield the pose, or the trigger edge, with which a pair agrees best."""
    rows, tried = np.flatnonzero(system.observation == index), list[tuple[float, str, StereoReading]]()
    where, imaginary = (system.line[rows], system.channel[rows]), np.isin(rows, system.pairs[:, 1])
    for text, factor in (*_poses(reading), *_edges(reading, set_ups)):
        phasors = reading.phasors.combined(factor, reading.phasors.channels, reading.phasors.unit)
        effects = {name: np.einsum("kij,pkj->pki", factor, effect) for name, effect in reading.effects.items()}
        readings = system.readings.copy()
        readings[rows] = np.where(imaginary, phasors.value[where].imag, phasors.value[where].real)
        chi2 = float(readings @ first.projector @ readings)
        tried.append((chi2, text, replace(reading, phasors=phasors, effects=effects)))
    others = system.observations
    best, best_cause = EXPLAINS * first.chi2, ""
    for _, text, other in sorted(tried, key=lambda item: item[0])[:TRIED]:
        chi2 = solve(
            build_system([*others[:index], other.observation(), *others[index + 1 :]], system.unobserved_motion)
        ).chi2
        if chi2 < best:
            best, best_cause = chi2, text
    if best_cause:
        yield best_cause


def _poses(reading: StereoReading) -> Iterator[tuple[str, ComplexArray]]:
    """Yield other poses of a pair, the inverse first, and their transforms (K, 6, 6)."""
    rotation, translation = np.array(reading.pair.rotation), np.array(reading.pair.translation)
    key = f"stereo.{reading.name}.rotation"
    yield f"{key} were stated from sensor to camera", _moved(reading, rotation.T, translation)
    yield (
        f"{key} and translation were stated from sensor to camera",
        _moved(reading, rotation.T, -rotation.T @ translation),
    )
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.diag(signs)[:, order]
        if np.linalg.det(turn) > 0.0 and np.trace(turn) < 3.0:
            vector = vector_from_rotation(turn)
            angle = float(np.linalg.norm(vector))
            axis = ", ".join(number_text(x, 2) for x in vector / angle)
            text = f"{key} were turned by {np.degrees(angle):.0f}° about ({axis}) of the sensor's axes"
            yield text, _moved(reading, turn @ rotation, turn @ translation)


def _moved(reading: StereoReading, rotation: FloatArray, translation: FloatArray) -> ComplexArray:
    """Return the transforms (K, 6, 6) of displacement phasors to another camera pose.

    A point at x by the stated pose is at T·x by the other, T = other · stated⁻¹. The origin of the other one is at
    T⁻¹·0 by the stated pose.
    """
    stated = np.array(reading.pair.rotation)
    turn = rotation @ stated.T
    origin = stated @ (rotation.T @ -translation) + np.array(reading.pair.translation)
    matrix = np.block([[turn, -turn @ skew(origin)], [np.zeros((3, 3)), turn]])
    return np.broadcast_to(matrix, (len(reading.phasors.value), 6, 6)).astype(np.complex128)


def _edges(reading: StereoReading, set_ups: Sequence[MeasuredSetUp]) -> Iterator[tuple[str, ComplexArray]]:
    """Yield other trigger edges for the frames of a pair."""
    sights = [
        (one, images.sight) for one in set_ups for images in one.prepared.images if images.sight.name == reading.name
    ]
    for one, sight in sights[:1]:
        period_s = one.prepared.base.first_with(sight.exposure.trigger)[1].period_s
        for late in (n for n in range(-LATEST, LATEST + 1) if n):
            turn = np.exp(-2j * np.pi * reading.phasors.frequency_hz * late * period_s)
            side = f"{abs(late)} edge{'s' if abs(late) > 1 else ''} {'later' if late > 0 else 'earlier'}"
            yield f"the frames of {reading.name} belonged to trigger edges {side}", turn[:, None, None] * np.eye(6)


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
    files = tuple(of[chosen] for of in images.sight.files) or tuple(chosen for _ in images.cameras)
    sight = replace(images.sight, time_s=images.sight.time_s[chosen], edge=images.sight.edge[chosen], files=files)
    cameras = tuple(camera.select(chosen) for camera in images.cameras)
    return replace(images, sight=sight, cameras=cameras, copied=images.copied[chosen])


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
        if notice.values.get("mistake_explains") or notice.code in (
            NO_RESULT_AT_LINES.code,
            FRAMES_OF_OTHER_EDGES.code,
        ):
            yield Finding("FIX MANIFEST", notice)
        elif (notice.severity == "warning" and not assumed) or (doubted and notice.where.endswith(".toml")):
            yield Finding("CHECK", notice)
        elif notice.severity == "warning" or doubted:
            yield Finding("KEEP", notice)


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
    component, result = evaluation.stated_component, evaluation.element or evaluation.sensitivity
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
