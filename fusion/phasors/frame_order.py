"""Frames of a pair's cameras against each other and against the trigger: late, lost, and repeated ones.

Each camera alone measures the six components of a body with a known surface. At the times of the frames both must
show one motion, a sum of the lines. A camera whose frames belong to other edges contradicts that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import ComputeError
from fusion.estimation.measurement_model import Observation
from fusion.instruments.stereo import StereoReading
from fusion.phasors.phasor_notices import (
    CAMERA_DELAYED,
    CAMERAS_OUT_OF_STEP,
    FRAMES_OF_OTHER_EDGES,
    FRAMES_OUT_OF_ORDER,
)
from fusion.phasors.stereo_motion import ImageView, RejectedPair, StereoMotion, sensor_from_camera
from fusion.recording.manifest import EdgeRuns
from fusion.recording.transducer import STATIONARY
from photogram.camera import locate
from photogram.direct.surface import PlacedCamera, SeenPoints, project_body_points
from photogram.frame_statistics import spread_choice
from photogram.geometry import RigidTransform
from shaker.sine.aliasing import usable_lines
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.phasors.set_up import MeasuredSetUp

FARTHEST = 5  # frames by which a camera may be late or early
SUBSETS, SEEN_SHARE, MIN_SUBSETS = 200, 0.5, 6
MEDIAN_CHI2_OF_TWO = 2.0 * np.log(2.0)
OUTLIER = 5.0  # robust standard deviations beyond which a subset is ignored
WEAK = 1e-3  # power of a line over that of the strongest one below which it is not used
MOST_LINES, MOST_JUMPS, MOST_SPLITS, MOST_REVERSED, REFINED, ROUNDS = 6, 4, 24, 2, 6, 6
MODEL_ERROR = 0.02  # relative to the motion: a change must explain more than such an error of one frame (chosen)
MIN_FREE = 12.0  # degrees of freedom
SUSPICIOUS = 2.0  # residual variance over that of the subsets' scatter above which shifts are tried (chosen)
JUMP_COST = 25.0  # of another shift, in variances of one coordinate (chosen)
EXPLAINS = 0.5  # residual power with shifts over that without, above which none is reported (chosen)
LATE_RAD, LATE_U = 0.01, 5.0
"""Phase between the cameras above which it is reported, and the same in standard uncertainties (chosen)."""
FRAME_PHASE_TOLERANCE = 0.05
"""Largest difference in rad of a lag from whole frames: different frames at either end (chosen)."""
STRONG = 0.1  # of the largest motion: lines whose phases are compared
EQUAL = 0.2
"""Relative difference of the two cameras' motion that no lag explains."""
PHASES, PHASE_STEP_RAD = 12, 0.05  # tried delays over a period of the strongest line, and step of derivatives


@dataclass(frozen=True)
class CameraSeries:
    """The body's motion by one camera alone, in the S frames with subsets.

    `pose` (S, 6): about the sensor origin, from the mean, in m and rad, NaN for none. `information` (6, 6): of one
    frame, for errors of 1 px of each coordinate. `variance_px2`: of a coordinate, by the scatter of the subsets.
    """

    side: str
    pose: FloatArray
    information: FloatArray
    variance_px2: float


def check_frame_order(measured: StereoMotion, frequency_hz: FloatArray) -> StereoMotion | RejectedPair:
    """Return the motion of a pair whose cameras show one body at the same edges, or the rejected pair.

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
    step = int(np.gcd.reduce(np.diff(sight.edge))) or 1
    interval_s = step * float(np.median(np.diff(sight.time_s) / np.diff(sight.edge)))
    model = _Model.of(cameras, sight.time_s[numbers], interval_s, frequency_hz)
    model = replace(model, frequency_hz=_strong_lines(model))
    noise = max(one.variance_px2 for one in cameras)
    found = find_shifts(model, noise)
    late, notices = lateness(model, found, noise)
    if not late and not found.any():
        return replace(measured, notices=(*measured.notices, *notices))
    shifts = _of_all_frames(model, found, late, numbers, measured)
    sides = [one.side for one in cameras]
    files = sight.files or tuple(np.arange(len(sight.edge)) for _ in sides)
    stated = _first_edges(sides, files, shifts, sight.edge, step)
    if late:
        stated += f" or {_first_edges(sides, files, shifts + late, sight.edge, step)}"
    where, texts = f"stereo pair {sight.name}", {"stated": stated, "alike": _alike(model)}
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


def camera_series(measured: StereoMotion, view: ImageView) -> tuple[CameraSeries, ...]:
    """Return the motion by each camera alone, () where too few subsets are seen by all."""
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
    """Return poses (S, 6) by displacements (S, N, 2) of points, information, and variance in px².

    Two steps with the rates at rest; the second one without outliers.
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


# The cameras against the trigger and each other: the same lines, offsets of their own, and frames that are shifted.


@dataclass(frozen=True)
class _Model:
    """Both cameras' motion as a sum of lines and a drift, seen by each with an offset of its own.

    `time_s` (S,), `interval_s`, `frequency_hz` (K,): of frames and lines. `values` (C, S, 6): in coordinates with
    independent errors in every camera. `weight` (C, 6): inverse variances for 1 px. `seen` (C, S): frames that count.
    `basis` (6, 6): the coordinates of a pose p are p·basis.
    """

    time_s: FloatArray
    interval_s: float
    frequency_hz: FloatArray
    values: FloatArray
    weight: FloatArray
    seen: FloatArray
    basis: FloatArray

    @classmethod
    def of(
        cls, cameras: Sequence[CameraSeries], time_s: FloatArray, interval_s: float, frequency_hz: FloatArray
    ) -> _Model:
        from scipy.linalg import eigh

        total = np.sum([one.information for one in cameras], axis=0)
        shares, basis = eigh(cameras[0].information, total)
        weight = np.array([shares, 1.0 - shares])[: len(cameras)]
        values = np.array([one.pose @ total @ basis for one in cameras])  # basis^T·total·basis = 1
        seen = np.isfinite(values).all(axis=2).astype(np.float64)
        return cls(time_s, interval_s, frequency_hz, np.nan_to_num(values), weight, seen, total @ basis)

    @property
    def unknowns(self) -> int:
        """Number of columns."""
        return len(self.values) + 1 + 2 * len(self.frequency_hz)

    @cached_property
    def motion(self) -> float:
        """Sum of squares of the values."""
        return float(np.sum(self.weight[:, None] * self.seen[..., None] * self.values**2))

    @property
    def free(self) -> float:
        """Degrees of freedom."""
        return 6.0 * float(self.seen.sum() - self.unknowns)

    def columns(self, camera: int, shift: IntArray | int, delay_s: float = 0.0) -> FloatArray:
        """Return the columns (S, P) of a camera: offsets, drift, and lines; the second camera is late by `delay_s`."""
        later_s = shift * self.interval_s - camera * delay_s
        angle = 2.0 * np.pi * np.outer(self.time_s + later_s, self.frequency_hz)
        drift = (self.time_s - self.time_s.mean()) / np.ptp(self.time_s)
        offsets = np.zeros((len(drift), len(self.values)))
        offsets[:, camera] = 1.0
        return np.hstack([offsets, drift[:, None], np.cos(angle), -np.sin(angle)])

    def fit_delay(self, shifts: IntArray, delay_s: float) -> tuple[FloatArray, float]:
        """Return the amplitudes (P, 6) of all columns, and the sum of squares that is not explained."""
        gram, right = np.zeros((6, self.unknowns, self.unknowns)), np.zeros((6, self.unknowns))
        for camera, (values, weight, seen) in enumerate(zip(self.values, self.weight, self.seen, strict=True)):
            columns = self.columns(camera, shifts[camera], delay_s) * seen[:, None]
            gram += weight[:, None, None] * (columns.T @ columns)
            right += weight[:, None] * (columns.T @ values).T
        amplitudes = np.linalg.solve(gram, right[..., None])[..., 0]
        return np.asarray(amplitudes.T), self.motion - float(np.sum(amplitudes * right))

    @cached_property
    def delays_s(self) -> FloatArray:
        """Delays of the second camera to compare: whole frames, and parts of the period of the strongest line."""
        if len(self.values) < 2:
            return np.zeros(1)
        whole = self.interval_s * np.array(sorted(range(-FARTHEST, FARTHEST + 1), key=abs))
        parts = (np.arange(PHASES) - PHASES // 2) / PHASES / self.frequency_hz[0]
        return np.concatenate([whole, parts])

    def fit(self, shifts: IntArray) -> tuple[FloatArray, float, float]:
        """Return amplitudes, sum of squares, and delay of the second camera of the best fit."""
        found = [(*self.fit_delay(shifts, float(delay_s)), float(delay_s)) for delay_s in self.delays_s]
        return min(found, key=lambda item: item[1])


def _strong_lines(model: _Model) -> FloatArray:
    """Return the lines with most of the motion in the images, the strongest first."""
    power, lines, none = np.zeros(len(model.frequency_hz)), len(model.frequency_hz), np.zeros(1, dtype=np.int64)
    for camera, (values, weight, seen) in enumerate(zip(model.values, model.weight, model.seen, strict=True)):
        rows = seen > 0.0
        parts = np.linalg.lstsq(model.columns(camera, none)[rows], values[rows], rcond=None)[0]
        power += (parts[-2 * lines : -lines] ** 2 + parts[-lines:] ** 2) @ weight
    order = np.argsort(power)[::-1][:MOST_LINES]
    return np.asarray(model.frequency_hz[order[power[order] >= WEAK * power[order[0]]]])


def find_shifts(model: _Model, noise: float) -> IntArray:
    """Return by how many frames (C, S) each frame of a camera is later than its time, compared with the first one.

    Positive where frames show the body at later instants, because frames before were lost. `noise`: variance of one
    coordinate, in px², by the scatter of the subsets; the scatter of the frames is used if it is larger. Changes, or
    pairs of opposite ones, of one camera or of all are added where they lower the sum of squares most. After each, the
    best sequence for the amplitudes and the amplitudes for that sequence are found in turn. Zeros where all changes
    together explain less than half of the residual power.
    """
    found = np.zeros(model.seen.shape, dtype=np.int64)
    if model.free < MIN_FREE:
        return found
    least = power = model.fit(found)[1]
    if least <= max(SUSPICIOUS * noise * model.free, LATE_RAD**2 * model.motion):
        return found
    model_error = MODEL_ERROR**2 * model.motion / len(model.time_s)

    def level() -> float:
        return max(JUMP_COST * noise, JUMP_COST * power / model.free, model_error)

    search = _Search.of(model)
    for _ in range(MOST_JUMPS):
        refined = [_refined(model, other, level()) for other in search.best(found)]
        value, other = min(refined, key=lambda item: item[0] + level() * _changes(item[1]))
        if value + level() * _changes(other) >= power + level() * _changes(found):
            break
        power, found = value, other
    while True:  # without changes that others made unnecessary
        fewer = [_refined(model, other, level()) for other in _with_one_less(found)]
        value, other = min(fewer, key=lambda item: item[0] + level() * _changes(item[1]), default=(np.inf, found))
        if value + level() * _changes(other) >= power + level() * _changes(found):
            break
        power, found = value, other
    return _smallest(model, found, power + level()) if power < EXPLAINS * least else np.zeros_like(found)


def _with_one_less(shifts: IntArray) -> Iterator[IntArray]:
    """Yield the shifts (C, S) without each of their changes."""
    for camera, shift in enumerate(shifts):
        for at in np.flatnonzero(np.diff(shift)) + 1:
            other = shifts.copy()
            other[camera, at:] -= shift[at] - shift[at - 1]
            yield np.clip(other, -FARTHEST, FARTHEST)


@dataclass(frozen=True)
class _Search:
    """Sums of the columns' products over parts of the record, by which many sequences of shifts are compared.

    `splits` (B,): first frames of the parts. `gram` (C, N, B, P, P), `right` (C, N, B, P, 6): products of columns of
    the lines, without a phase between the cameras, for each shift from -FARTHEST on.
    """

    model: _Model
    splits: IntArray
    gram: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, model: _Model) -> _Search:
        splits = np.unique(np.linspace(0, len(model.time_s) - 1, MOST_SPLITS).astype(int))
        gram, right = [], []
        for camera, (values, seen) in enumerate(zip(model.values, model.seen, strict=True)):
            for n in range(-FARTHEST, FARTHEST + 1):
                columns = model.columns(camera, n) * seen[:, None]
                gram.append(np.add.reduceat(columns[:, :, None] * columns[:, None], splits))
                right.append(np.add.reduceat(columns[:, :, None] * values[:, None], splits))
        shape = len(model.values), 2 * FARTHEST + 1
        return cls(
            model,
            splits,
            np.reshape(gram, (*shape, *np.shape(gram)[1:])),
            np.reshape(right, (*shape, *np.shape(right)[1:])),
        )

    def best(self, shifts: IntArray) -> Iterator[IntArray]:
        """Yield the best sequences (C, S) with a change more, or two opposite ones, than `shifts`."""
        cameras, parts = len(self.model.values), len(self.splits)
        steps = []
        for group in [*np.eye(cameras, dtype=np.int64), np.ones(cameras, dtype=np.int64)][: 2 * cameras - 1]:
            for first in range(1, parts):
                for last in range(first + 1, parts + 1):
                    for jump in range(-FARTHEST, FARTHEST + 1):
                        if jump and (last == parts or abs(jump) <= MOST_REVERSED):
                            steps.append((group, first, last, jump))
        change = np.zeros((len(steps), cameras, parts), dtype=np.int64)
        for one, (group, first, last, jump) in zip(change, steps, strict=True):
            one[:, first:last] = jump * group[:, None]
        all_shifts = shifts[:, self.splits] + change
        powers = np.where(np.abs(all_shifts).max(axis=(1, 2)) > FARTHEST, np.inf, -self.explained(all_shifts))
        for index in np.argsort(powers, kind="stable")[:REFINED]:
            counts = np.diff(np.append(self.splits, shifts.shape[1]))
            yield np.clip(shifts + np.repeat(change[index], counts, axis=1), -FARTHEST, FARTHEST)

    def explained(self, shifts: IntArray) -> FloatArray:
        """Return the sums of squares (H,) that the lines explain with shifts (H, C, B) of the parts."""
        model, lines = self.model, len(self.model.frequency_hz)
        index, parts = np.clip(shifts + FARTHEST, 0, 2 * FARTHEST), np.arange(shifts.shape[2])
        grams = [of[index[:, c], parts].sum(axis=1) for c, of in enumerate(self.gram)]
        rights = [of[index[:, c], parts].sum(axis=1) for c, of in enumerate(self.right)]
        best, plain = np.zeros(len(shifts)), np.eye(model.unknowns)
        cosines, sines = np.arange(-2 * lines, -lines), np.arange(-lines, 0)
        for delay_s in model.delays_s:
            phase, turn = 2.0 * np.pi * model.frequency_hz * delay_s, plain.copy()
            turn[cosines, cosines] = turn[sines, sines] = np.cos(phase)
            turn[cosines, sines], turn[sines, cosines] = np.sin(phase), -np.sin(phase)
            gram, right = np.zeros((len(shifts), 6, *turn.shape)), np.zeros((len(shifts), 6, len(turn)))
            for by, weight, of_gram, of_right in zip((plain, turn), model.weight, grams, rights, strict=False):
                gram += weight[:, None, None] * (by.T @ of_gram @ by)[:, None]
                right += weight[:, None] * (by.T @ of_right).swapaxes(1, 2)
            best = np.maximum(best, np.sum(np.linalg.solve(gram, right[..., None])[..., 0] * right, axis=(1, 2)))
        return best


def _changes(shifts: IntArray) -> int:
    """Return the number of changes of the shifts (C, S); of all cameras at once it counts as one."""
    return int(np.count_nonzero(np.diff(shifts, axis=1).any(axis=0)))


def _refined(model: _Model, shifts: IntArray, cost: float) -> tuple[float, IntArray]:
    """Return the sum of squares and shifts after amplitudes and sequences are found in turn."""
    amplitudes, power, delay_s = model.fit(shifts)
    for _ in range(ROUNDS):
        sequences = np.array([_best_sequence(model, c, amplitudes, delay_s, cost) for c in range(len(model.values))])
        sequences -= sequences[:, :1]
        better, value, other_s = model.fit(sequences)
        if value + cost * _changes(sequences) >= power + cost * _changes(shifts):
            break
        shifts, amplitudes, power, delay_s = sequences, better, value, other_s
    return power, shifts


def _best_sequence(model: _Model, camera: int, amplitudes: FloatArray, delay_s: float, cost: float) -> IntArray:
    """Return the shifts (S,) of a camera of the least sum of squares and costs of changes (Viterbi)."""
    candidates = np.arange(-FARTHEST, FARTHEST + 1)
    weight, values = model.weight[camera], model.values[camera]
    square = np.array(
        [(values - model.columns(camera, n, delay_s) @ amplitudes) ** 2 @ weight for n in candidates.tolist()]
    )
    square = (square * model.seen[camera]).T
    total, origins = square[0], []
    for now in square[1:]:
        change = int(np.argmin(total))
        jumped = total > total[change] + cost
        origins.append(np.where(jumped, change, np.arange(len(candidates))))
        total = np.minimum(total, total[change] + cost) + now
    path = [int(np.argmin(total))]
    for origin in reversed(origins):
        path.append(int(origin[path[-1]]))
    return np.asarray(candidates[path[::-1]])


def _smallest(model: _Model, shifts: IntArray, most: float) -> IntArray:
    """Return the shifts with the smallest changes that the sum of squares `most` permits."""
    for camera, shift in enumerate(shifts):
        for at in np.flatnonzero(np.diff(shift)) + 1:
            change = int(shift[at] - shift[at - 1])
            for size in sorted(range(-abs(change), abs(change) + 1), key=lambda n: (abs(n), n < 0)):
                other = shifts.copy()
                other[camera, at:] += size - change
                if size == change or model.fit(other)[1] <= most:
                    shifts = other
                    break
    return shifts


def lateness(model: _Model, shifts: IntArray, noise: float) -> tuple[int, tuple[Notice, ...]]:
    """Return by how many frames the right camera is late from the first frame on, and a warning of another delay.

    The delay of the least sum of squares, with its uncertainty by the curvature there. None where the cameras differ by
    more than a delay and `noise`, the variance of one coordinate in px².
    """
    if len(model.values) < 2:
        return 0, ()
    omega = 2.0 * np.pi * float(model.frequency_hz[0])
    _, power, delay_s = model.fit(shifts)
    step_s = PHASE_STEP_RAD / omega
    for _ in range(ROUNDS):
        before, after = (model.fit_delay(shifts, delay_s + side * step_s)[1] for side in (-1, 1))
        curvature = (before - 2.0 * power + after) / step_s**2
        if not curvature > 0.0:
            return 0, ()
        change_s = float(np.clip((before - after) / (2.0 * step_s * curvature), -step_s, step_s))
        delay_s += change_s
        power = model.fit_delay(shifts, delay_s)[1]
        if abs(change_s) < 0.01 * step_s:
            break
    phase = float(np.angle(np.exp(1j * omega * delay_s)))
    u = omega * float(np.sqrt(2.0 * power / max(model.free, 1.0) / curvature))
    unlike = power - SUSPICIOUS * noise * model.free > EQUAL**2 * model.motion
    if unlike or abs(phase) <= max(LATE_RAD, LATE_U * u):
        return 0, ()
    most = power + 0.5 * curvature * (max(LATE_U * u, FRAME_PHASE_TOLERANCE) / omega) ** 2
    for count in sorted((n for n in range(-FARTHEST, FARTHEST + 1) if n), key=lambda n: (abs(n), n < 0)):
        distance = abs(np.angle(np.exp(1j * (phase - omega * count * model.interval_s))))
        if distance < abs(phase) / 2.0 and model.fit_delay(shifts, count * model.interval_s)[1] <= most:
            return count, ()
    values = {"phase_mrad": 1e3 * abs(phase), "frequency_hz": model.frequency_hz[0], "u_mrad": 1e3 * u}
    side = "right" if phase > 0.0 else "left"
    return 0, (Notice(CAMERA_DELAYED, "exposure", late=side, delay_us=1e6 * abs(phase) / omega, **values),)


# A pair against other instruments of its body.


def other_edges(observations: Sequence[Observation], set_ups: Sequence[MeasuredSetUp]) -> Iterator[Notice]:
    """Yield a warning for each pair that agrees with all others of its body if its frames belong to other edges."""
    for index, pair in enumerate(observations):
        geometry = pair.geometry
        others = [one for k, one in enumerate(observations) if k != index and one.body == pair.body]
        if not isinstance(geometry, StereoReading) or pair.body == STATIONARY or not others:
            continue
        for set_up in set_ups:
            entry = next((one for one in set_up.prepared.manifest.images if one.stereo == geometry.name), None)
            sight = next((one.sight for one in set_up.prepared.images if one.sight.name == geometry.name), None)
            if entry is None or sight is None:
                continue
            interval_s = float(np.median(np.diff(sight.time_s) / np.diff(sight.edge)))
            step = int(np.gcd.reduce(np.diff(sight.edge)))
            found = [_edges_later(pair, other, interval_s, step) for other in others]
            if found[0] is not None and found[0][0] and all(one is not None and one[0] == found[0][0] for one in found):
                count, phase, frequency_hz = found[0]
                yield Notice(
                    FRAMES_OF_OTHER_EDGES,
                    f"stereo pair {geometry.name}",
                    others=", ".join(one.title for one in others),
                    count=abs(count),
                    side="later" if count > 0 else "earlier",
                    phase_mrad=1e3 * abs(phase),
                    frequency_hz=frequency_hz,
                    stated=_moved_edges(entry.first_edge, count),
                )
            break


def _edges_later(
    pair: Observation, other: Observation, interval_s: float, step: int
) -> tuple[int, float, float] | None:
    """Return by how many edges a pair's frames are later than assumed if another instrument is right.

    Also the phase in rad by which the pair leads, and the frequency of the line. None where no such number explains the
    difference, or where amplitudes differ.
    """
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
    multiples = {n * by for n in range(-FARTHEST, FARTHEST + 1) for by in (1, step)}
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


def _amount(frames: int) -> str:
    """Return how early (positive) or late frames are, in words."""
    return f"{abs(frames)} frame{'s' if abs(frames) > 1 else ''} {'early' if frames > 0 else 'late'}"


def _describe(side: str, files: IntArray, shift: IntArray) -> str:
    """Return the shifts (F,) of a camera in words."""
    parts = [f"{_amount(int(shift[0]))} from frame {files[0]} on"] if shift[0] else []
    for at in (np.flatnonzero(np.diff(shift)) + 1).tolist():
        parts.append(f"{_amount(int(shift[at])) if shift[at] else 'in time again'} from frame {files[at]} on")
    return f"the {side} camera is " + ", ".join(parts)


def _of_all_frames(model: _Model, shifts: IntArray, late: int, numbers: IntArray, measured: StereoMotion) -> IntArray:
    """Return the shifts (C, F) of all frames by those with subsets, the right camera late from the first frame on.

    Between two frames with subsets the change is where the motion that was fitted to the grey values of both cameras
    is best predicted: in the model's coordinates it is the mean of that of the cameras, by their weights.
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


def _alike(model: _Model) -> str:
    """Return a remark on other shifts that look the same at the lines, or ""."""
    for frames in range(1, 2 * FARTHEST + 1):
        phase = 2.0 * np.pi * model.frequency_hz * frames * model.interval_s
        if np.abs(np.angle(np.exp(1j * phase))).max() < 2.0 * FRAME_PHASE_TOLERANCE:
            return f"; at this frame rate {frames} frames more or less look the same"
    return ""


def _first_edges(sides: Sequence[str], files: Sequence[IntArray], shifts: IntArray, edge: IntArray, step: int) -> str:
    """Return the key `first_edge` that states the shifts (C, F) of the cameras by the numbers of their `files`."""
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
