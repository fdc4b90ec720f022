"""Late, lost and repeated frames of a pair's cameras, and interlaced rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fusion.base import count_text
from fusion.errors import ComputeError
from fusion.estimation.measurement_model import Observation
from fusion.instruments.stereo import StereoReading
from fusion.phasors.frame_shifts import (
    EQUAL,
    FARTHEST,
    FRAME_PHASE_TOLERANCE,
    CameraSeries,
    ShiftModel,
    find_shifts,
    lateness,
    strong_lines,
)
from fusion.phasors.phasor_notices import (
    CAMERAS_OUT_OF_STEP,
    FRAMES_OF_OTHER_EDGES,
    FRAMES_OUT_OF_ORDER,
    ROWS_INTERLACED,
)
from fusion.phasors.stereo_motion import ImageView, PreparedImages, RejectedPair, StereoMotion, sensor_from_camera
from fusion.phasors.timing import Sight
from fusion.recording.manifest import EdgeRuns
from fusion.recording.transducer import STATIONARY
from photogram.camera import locate
from photogram.direct.surface import PlacedCamera, SeenPoints, project_body_points
from photogram.frame_statistics import spread_choice
from photogram.geometry import RigidTransform
from photogram.images.rows import parity_displacement
from photogram.motion import MEDIAN_CHI2_OF_TWO
from shaker.sine.aliasing import usable_lines
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.notices import Notice

SUBSETS, SEEN_SHARE, MIN_SUBSETS = 200, 0.5, 6
OUTLIER = 5.0  # robust standard deviations beyond which a subset is ignored
MOST_ROW_FRAMES, FEWEST_ROW_FRAMES, ROWS_PX = 10, 6, 192  # frames compared, and size of the part of an image
ROWS_DIFFER, ROWS_SHARE = 3.0, 0.05
"""Distance of odd from even rows over that of columns, and over the motion, if rows are interlaced (chosen)."""
STRONG = 0.1  # of the largest motion: lines whose phases are compared


def check_frame_order(measured: StereoMotion, frequency_hz: FloatArray) -> StereoMotion | RejectedPair:
    """Return the motion, or the rejected pair where frames belong to other edges.

    A delay of a camera by a part of a frame is a warning of the motion.
    """
    sight, view = measured.sight, measured.view
    frequency_hz = frequency_hz[usable_lines(sight.time_s, frequency_hz)[0]]
    if view is None or sight.pair.body == STATIONARY or not len(frequency_hz):
        return measured
    cameras = camera_series(measured, view)
    numbers = np.arange(len(sight.time_s)) if measured.subset_frames is None else np.flatnonzero(measured.subset_frames)
    if not cameras or len(numbers) != len(cameras[0].pose):
        return measured
    step = _step(sight)
    interval_s = step * float(np.median(np.diff(sight.time_s) / np.diff(sight.edge)))
    model = ShiftModel.of(cameras, sight.time_s[numbers], interval_s, frequency_hz)
    model = replace(model, frequency_hz=strong_lines(model))
    noise = max(one.variance_px2 for one in cameras)
    found = find_shifts(model, noise)
    late, notices = lateness(model, found, noise)
    if not late and not found.any():
        return replace(measured, notices=(*measured.notices, *notices)) if notices else measured
    shifts = _of_all_frames(model, found, late, numbers, measured)
    sides = [one.side for one in cameras]
    files = sight.files or tuple(np.arange(len(sight.edge)) for _ in sides)
    stated = _first_edges(sides, files, shifts, sight.edge, step)
    if late:
        stated += f" or {_first_edges(sides, files, shifts + late, sight.edge, step)}"
    where, texts = f"stereo pair {sight.name}", {"stated": stated, "alike": _remark_on_period(model)}
    if not found.any():
        slow, fast = ("right", "left") if late > 0 else ("left", "right")
        delay_ms = 1e3 * abs(late) * interval_s
        error = ComputeError(
            CAMERAS_OUT_OF_STEP, where, late=slow, early=fast, frames=abs(late), delay_ms=delay_ms, **texts
        )
    else:
        of_sides = zip(sides, files, shifts, strict=True)
        changes = "; ".join(_describe(side, of, shift) for side, of, shift in of_sides if shift.any())
        error = ComputeError(FRAMES_OUT_OF_ORDER, where, changes=changes, **texts)
    return RejectedPair(sight.name, error)


def _step(sight: Sight) -> int:
    """Return the number of edges from one frame to the next."""
    return int(np.gcd.reduce(np.diff(sight.edge)))


def camera_series(measured: StereoMotion, view: ImageView) -> tuple[CameraSeries, ...]:
    """Return the motion by each camera alone.

    () where too few subsets are seen by all.
    """
    blocks: list[list[FloatArray]] = []
    chosen: IntArray | None = None
    for block in view.tracks:
        both = [camera.position_px for camera in block.cameras]
        if chosen is None:
            count = both[0].shape[1]
            chosen = np.flatnonzero(spread_choice(np.arange(count), min(1.0, SUBSETS / count)))
        blocks.append([position[:, chosen] for position in both])
    if not blocks:
        return ()
    positions = [np.concatenate(side) for side in zip(*blocks, strict=True)]
    seen = np.all([np.isfinite(side[..., 0]).mean(axis=0) >= SEEN_SHARE for side in positions], axis=0)
    if np.count_nonzero(seen) < MIN_SUBSETS:
        return ()
    positions = [side[:, seen] for side in positions]
    means = [np.nanmean(side, axis=0) for side in positions]
    from_camera = sensor_from_camera(measured.sight.pair)
    points = from_camera.apply(locate(view.rig, [mean[None] for mean in means]).position_m[0])
    placed = np.isfinite(points).all(axis=1)
    if np.count_nonzero(placed) < MIN_SUBSETS:
        return ()
    series = []
    sides = zip(("left", "right"), view.rig.camera_poses, positions, means, strict=False)
    for side, (camera, from_left), position, mean in sides:
        shown = project_body_points(PlacedCamera(camera, from_left @ from_camera.inverse()), points[placed])
        series.append(CameraSeries(side, *_poses(shown, position[:, placed] - mean[placed])))
    return tuple(series)


def _poses(seen: SeenPoints, moved_px: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return poses (S, 6) by displacements (S, N, 2) of points.

    Also their information, and the variance of a coordinate in px². Two steps with the rates at rest; the second one
    without outliers.
    """
    pose, weight = np.zeros((len(moved_px), 6)), np.asarray(np.isfinite(moved_px).all(axis=2))
    outer = np.einsum("nai,naj->nij", seen.rates, seen.rates)
    for _ in range(2):
        placed = [seen.camera.project(RigidTransform.from_pose(one).apply(seen.points_m)) for one in pose]
        left = np.where(weight[..., None], moved_px - (np.array(placed) - seen.rest_px), 0.0)
        information = np.einsum("fn,nij->fij", weight, outer)
        enough = weight.sum(axis=1) >= MIN_SUBSETS
        right = np.einsum("fn,nai,fna->fi", weight, seen.rates, left)[enough]
        step = np.zeros_like(pose)
        step[enough] = np.linalg.solve(information[enough], right[..., None])[..., 0]
        pose = pose + step
        distance = np.linalg.norm(left - np.einsum("nai,fi->fna", seen.rates, step), axis=2)
        median = _median(distance, weight)
        weight = weight & (distance <= OUTLIER * median[:, None])
    pose[~enough] = np.nan
    variance = float(np.median(median[np.isfinite(median)] ** 2)) / MEDIAN_CHI2_OF_TWO
    return pose, np.asarray(information[enough].mean(axis=0)), variance


def _median(values: FloatArray, weight: np.ndarray) -> FloatArray:
    """Return medians (S,) of the counted values of each frame, infinite without any."""
    return np.array([np.median(one[some]) if some.any() else np.inf for one, some in zip(values, weight, strict=True)])


# Rows of one camera against each other.


def check_rows(measured: StereoMotion, images: PreparedImages) -> StereoMotion | RejectedPair:
    """Return the motion, or the rejected pair where a camera is interlaced.

    Of some frames, the part of the images around the middle of the body is compared with the first one. Columns, which
    are always exposed together, show how far rows differ by chance.
    """
    view, name = measured.view, measured.sight.name
    numbers = np.arange(len(measured.sight.time_s))
    numbers = numbers if measured.subset_frames is None else numbers[measured.subset_frames]
    if view is None or len(numbers) < FEWEST_ROW_FRAMES:
        return measured
    some = np.unique(np.linspace(1, len(numbers) - 1, MOST_ROW_FRAMES).astype(int))
    sides = zip(("left", "right"), images.cameras, _median_positions(view), strict=False)
    for side, sequence, (middle, low, high) in sides:
        centre, half = 0.5 * (low + high), np.minimum(0.5 * (high - low), ROWS_PX / 2)
        (left, top), (right, bottom) = np.rint([centre - half, centre + half]).astype(int).tolist()
        part, moved = (slice(max(top, 0), bottom), slice(max(left, 0), right)), middle[some] - middle[0]
        first = sequence.read(0)[part]
        pairs = [
            parity_displacement(first, sequence.read(int(numbers[at]))[part], by)
            for at, by in zip(some.tolist(), np.nan_to_num(moved), strict=True)
        ]
        rows, columns = np.moveaxis(np.array(pairs), 1, 0)
        seen = np.isfinite(np.hstack([rows, columns, moved])).all(axis=1)
        if np.count_nonzero(seen) < FEWEST_ROW_FRAMES - 1:
            continue
        apart, control, motion = (
            float(np.sqrt(np.mean(np.sum((one[seen] - one[seen].mean(axis=0)) ** 2, axis=1))))
            for one in (rows, columns, moved)
        )
        if apart > max(ROWS_DIFFER * control, ROWS_SHARE * motion):
            where = f"stereo pair {name}"
            error = ComputeError(ROWS_INTERLACED, where, side=side, distance_px=apart, moved_px=motion)
            return RejectedPair(name, error)
    return measured


def _median_positions(view: ImageView) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return the subsets' median positions (S, 2) in each camera.

    Also the limits (2,) of the first ones.
    """
    medians: list[list[FloatArray]] = []
    limits: list[FloatArray] = []
    for block in view.tracks:
        medians.append([np.nanmedian(camera.position_px, axis=1) for camera in block.cameras])
        limits = limits or [np.nanquantile(one.position_px[0], [0.1, 0.9], axis=0) for one in block.cameras]
    sides = zip(zip(*medians, strict=True), limits, strict=True)
    return [(np.concatenate(of_side), low, high) for of_side, (low, high) in sides]


# A pair against other instruments of its body.


def other_edges(
    observations: Sequence[Observation], sights: Mapping[str, tuple[Sight, int | dict[str, EdgeRuns] | None]]
) -> Iterator[Notice]:
    """Yield a warning for each pair whose frames belong to other edges.

    With these it agrees with all other instruments of its body. `sights`: of each pair, with its stated `first_edge`.
    """
    for index, pair in enumerate(observations):
        geometry = pair.geometry
        others = [one for k, one in enumerate(observations) if k != index and one.body == pair.body]
        if not isinstance(geometry, StereoReading) or geometry.name not in sights or not others:
            continue
        sight, first_edge = sights[geometry.name]
        found = [_edges_later(pair, other, sight) for other in others]
        if found[0] is None or not found[0][0] or any(one is None or one[0] != found[0][0] for one in found):
            continue
        count, phase, frequency_hz = found[0]
        yield Notice(
            FRAMES_OF_OTHER_EDGES,
            f"stereo pair {geometry.name}",
            instruments=", ".join(one.title for one in others),
            count=abs(count),
            side="later" if count > 0 else "earlier",
            phase_mrad=1e3 * abs(phase),
            frequency_hz=frequency_hz,
            stated=_moved_edges(first_edge, count),
        )


def _edges_later(pair: Observation, other: Observation, sight: Sight) -> tuple[int, float, float] | None:
    """Return by how many edges a pair's frames are later than assumed.

    If another instrument is right. Also the phase in rad by which the pair leads, and the frequency of the line. None
    where no such number explains the difference, or where amplitudes differ.
    """
    interval_s = float(np.median(np.diff(sight.time_s) / np.diff(sight.edge)))
    phases, sizes, frequency_hz = [], [], pair.phasors.frequency_hz
    for k in range(len(frequency_hz)):
        reading, rows = other.phasors.value[k], other.design[k]
        motion = pair.phasors.value[k]
        seen = np.isfinite(reading)
        if not np.isfinite(motion).all() or not seen.any():
            phases.append(0.0)
            sizes.append(0.0)
            continue
        predicted = (rows @ np.linalg.lstsq(pair.design[k], motion, rcond=None)[0])[seen]
        product = complex(np.vdot(reading[seen], predicted))
        size = float(np.vdot(predicted, predicted).real)
        equal = abs(product) > (1.0 - EQUAL) * max(size, float(np.vdot(reading[seen], reading[seen]).real))
        phases.append(float(np.angle(product)))
        sizes.append(np.sqrt(size) if equal else 0.0)
    best = int(np.argmax(sizes))
    if not sizes[best] > 0.0:
        return None
    used = [k for k, size in enumerate(sizes) if size > STRONG * sizes[best]]
    multiples = {n * by for n in range(-FARTHEST, FARTHEST + 1) for by in (1, _step(sight))}
    for count in sorted(multiples, key=lambda n: (abs(n), n < 0)):
        turns = [phases[k] - 2.0 * np.pi * float(frequency_hz[k]) * count * interval_s for k in used]
        limit = min(FRAME_PHASE_TOLERANCE, max(abs(phases[k]) for k in used) / 2.0) if count else FRAME_PHASE_TOLERANCE
        if np.abs(np.angle(np.exp(1j * np.array(turns)))).max() < limit:
            return count, phases[best], float(frequency_hz[best])
    return None


def _moved_edges(first_edge: int | dict[str, EdgeRuns] | None, count: int) -> str:
    """Return the key `first_edge` with edges later by `count`."""
    if not isinstance(first_edge, dict):
        return f"first_edge = {(first_edge or 0) + count}"
    runs = {side: [[frame, edge + count] for frame, edge in of_side] for side, of_side in first_edge.items()}
    return _key({side: str(of_side) if len(of_side) > 1 else str(of_side[0][1]) for side, of_side in runs.items()})


# What is found, in words and as the key that states it.


def _describe(side: str, files: IntArray, shift: IntArray) -> str:
    """Return the shifts of a camera in words.

    `shift` (F,): frames by which its files show later edges than assumed.
    """
    parts = list[str]()
    if shift[0]:
        parts.append(f"is {_frames(int(shift[0]))} {'ahead' if shift[0] > 0 else 'behind'} from frame {files[0]} on")
    jumps = np.diff(shift)
    for at in np.flatnonzero(jumps).tolist():
        event = "lost" if jumps[at] > 0 else "repeated"
        parts.append(f"{event} {_frames(int(jumps[at]))} before frame {files[at + 1]} ({_state(int(shift[at + 1]))})")
    return f"the {side} camera " + ", ".join(parts)


def _state(shift: int) -> str:
    """Return a shift of a camera's files, in words."""
    return f"then {_frames(shift)} {'ahead' if shift > 0 else 'behind'}" if shift else "then in time"


def _frames(count: int) -> str:
    """Return a number of frames in words, without its sign."""
    return count_text(abs(count), "frame")


def _of_all_frames(
    model: ShiftModel, shifts: IntArray, late: int, numbers: IntArray, measured: StereoMotion
) -> IntArray:
    """Return the shifts (C, F) of all frames by those with subsets.

    The right camera is `late` from the first frame on. Between two frames with subsets the change is where the motion
    that was fitted to the grey values of both cameras is best predicted: in the model's coordinates it is the mean of
    that of the cameras, by their weights.
    """
    late_by = np.array([0, late])[: len(shifts)]
    amplitudes = model.fit_delay(shifts, late * model.interval_s)[0]
    frames, lines = np.arange(len(measured.sight.time_s)), slice(len(shifts), None)
    every = shifts[:, np.clip(np.searchsorted(numbers, frames, side="right") - 1, 0, None)]
    around = replace(model, time_s=measured.sight.time_s)

    def predicted(some: IntArray) -> FloatArray:
        parts = [around.columns(c, of, late_by[c] * model.interval_s)[:, lines] for c, of in enumerate(some)]
        return np.asarray(sum(w * (part @ amplitudes[lines]) for w, part in zip(model.weight, parts, strict=True)))

    seen = measured.motion.pose @ model.basis
    offset = np.nanmedian((seen - predicted(every))[numbers], axis=0)
    for camera in range(len(shifts)):
        for at in np.flatnonzero(np.diff(shifts[camera])) + 1:
            between, tried = range(int(numbers[at - 1]) + 1, int(numbers[at]) + 1), []
            for begin in between:
                other = every.copy()
                other[camera, begin : numbers[at]] = shifts[camera, at]
                rest = (seen - offset - predicted(other))[between.start : between.stop - 1]
                tried.append((float(np.nansum(rest**2)), begin, other))
            every = min(tried, key=lambda item: item[:2])[2]
    return np.asarray(every - late_by[:, None])


def _remark_on_period(model: ShiftModel) -> str:
    """Return a remark on other shifts that look the same at the lines, or ""."""
    for frames in range(1, 2 * FARTHEST + 1):
        phase = 2.0 * np.pi * model.frequency_hz * frames * model.interval_s
        if np.abs(np.angle(np.exp(1j * phase))).max() < 2.0 * FRAME_PHASE_TOLERANCE:
            return f"; at this frame rate {frames} frames more or less look the same"
    return ""


def _first_edges(sides: Sequence[str], files: Sequence[IntArray], shifts: IntArray, edge: IntArray, step: int) -> str:
    """Return the key `first_edge` that states the shifts (C, F) of the cameras.

    `files`: numbers (F,) of the frames in each camera.
    """
    texts = {}
    for side, of_camera, shift in zip(sides, files, shifts, strict=True):
        begin = edge + step * (shift - of_camera)  # edge of file 0 if all edges follow each other
        at = [0, *(np.flatnonzero(np.diff(begin)) + 1).tolist()]
        runs = [[int(of_camera[k]), int(begin[k] + step * of_camera[k])] for k in at]
        runs[0] = [0, int(begin[0])]
        texts[side] = str(runs) if len(runs) > 1 else str(runs[0][1])
    return _key(texts)


def _key(texts: dict[str, str]) -> str:
    """Return the key `first_edge` of the values for each camera."""
    if len(set(texts.values())) == 1:
        return f"first_edge = {next(iter(texts.values()))}"
    return f"first_edge = {{ {', '.join(f'{side} = {text}' for side, text in texts.items())} }}"
