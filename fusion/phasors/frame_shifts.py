"""Shifts of a pair's frames by whole frames, by one fit of both cameras.

Each camera alone measures the six components of a body with a known surface. At the times of the frames both must show
one motion, a sum of the lines. Changes of the shift within the record, and a delay of one camera, are found by least
squares.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusion.phasors.phasor_notices import CAMERA_DELAYED
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.notices import Notice

FARTHEST = 5  # frames by which a camera may be late or early
WEAK = 1e-3  # power of a line over that of the strongest one below which it is not used
MOST_LINES, MOST_JUMPS, MOST_SPLITS, MOST_REVERSED, REFINED, ROUNDS = 6, 4, 24, 2, 6, 6
MOST_AT_ONCE = 256  # sequences compared at once, which limits memory
RIDGE = 1e-12  # relative, so that normal equations of frames that do not separate the lines have a solution
MODEL_ERROR = 0.02  # relative to the motion: a change must explain more than such an error of one frame (chosen)
MIN_FREE = 12.0  # degrees of freedom
SUSPICIOUS = 2.0  # residual variance over that of the subsets' scatter above which shifts are tried (chosen)
JUMP_COST = 25.0  # of another shift, in variances of one coordinate (chosen)
EXPLAINS = 0.5  # residual power with shifts over that without, above which none is reported (chosen)
LATE_RAD, LATE_U = 0.01, 5.0
"""Phase between the cameras above which it is reported, and the same in standard uncertainties (chosen)."""
FRAME_PHASE_TOLERANCE = 0.05
"""Largest difference in rad of a lag from whole frames: different frames at either end (chosen)."""
EQUAL = 0.2
"""Relative difference of the motion by two cameras or instruments that no lag explains."""
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


@dataclass(frozen=True)
class ShiftModel:
    """A sum of lines and a drift, seen by one or two cameras.

    Each with an offset of its own. `time_s` (S,), `interval_s`, `frequency_hz` (K,): of frames and lines. `values` (C,
    S, 6): in coordinates with independent errors in every camera. `weight` (C, 6): inverse variances for 1 px. `seen`
    (C, S): frames that count. `basis` (6, 6): the coordinates of a pose p are p·basis.
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
    ) -> ShiftModel:
        """Return the model of one or two cameras."""
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
        """Return the columns (S, P) of a camera: offsets, drift, and lines.

        The second camera is late by `delay_s`.
        """
        later_s = shift * self.interval_s - camera * delay_s
        angle = 2.0 * np.pi * np.outer(self.time_s + later_s, self.frequency_hz)
        drift = (self.time_s - self.time_s.mean()) / np.ptp(self.time_s)
        offsets = np.zeros((len(drift), len(self.values)))
        offsets[:, camera] = 1.0
        return np.hstack([offsets, drift[:, None], np.cos(angle), -np.sin(angle)])

    def fit_delay(self, shifts: IntArray, delay_s: float, *, unsteady: bool = False) -> tuple[FloatArray, float]:
        """Return the amplitudes (P, 6), and the sum of squares that is not explained.

        `unsteady`: amplitudes and phases of the lines change over the record as parabolas.
        """
        count = self.unknowns + unsteady * 4 * len(self.frequency_hz)
        gram, right = np.zeros((6, count, count)), np.zeros((6, count))
        for camera, (values, weight, seen) in enumerate(zip(self.values, self.weight, self.seen, strict=True)):
            columns = self.columns(camera, shifts[camera], delay_s) * seen[:, None]
            if unsteady:
                turn = ((self.time_s - self.time_s.mean()) / np.ptp(self.time_s))[:, None]
                lines = columns[:, len(self.values) + 1 :]
                columns = np.hstack([columns, turn * lines, turn**2 * lines])
            gram += weight[:, None, None] * (columns.T @ columns)
            right += weight[:, None] * (columns.T @ values).T
        gram += RIDGE * np.eye(count) * np.einsum("ipp->ip", gram)[:, None]
        amplitudes = np.linalg.solve(gram, right[..., None])[..., 0]
        return np.asarray(amplitudes.T), self.motion - float(np.sum(amplitudes * right))

    @cached_property
    def delays_s(self) -> FloatArray:
        """Delays to compare: whole frames, and parts of the strongest line's period."""
        if len(self.values) < 2:
            return np.zeros(1)
        whole = self.interval_s * np.array(sorted(range(-FARTHEST, FARTHEST + 1), key=abs))
        parts = (np.arange(PHASES) - PHASES // 2) / PHASES / self.frequency_hz[0]
        return np.concatenate([whole, parts])

    def fit(self, shifts: IntArray) -> tuple[FloatArray, float, float]:
        """Return amplitudes, sum of squares, and delay of the second camera of the best fit."""
        found = [(*self.fit_delay(shifts, float(delay_s)), float(delay_s)) for delay_s in self.delays_s]
        return min(found, key=lambda item: item[1])


def strong_lines(model: ShiftModel) -> FloatArray:
    """Return the lines with most of the motion in the images, the strongest first."""
    power, lines, none = np.zeros(len(model.frequency_hz)), len(model.frequency_hz), np.zeros(1, dtype=np.int64)
    for camera, (values, weight, seen) in enumerate(zip(model.values, model.weight, model.seen, strict=True)):
        rows = seen > 0.0
        parts = np.linalg.lstsq(model.columns(camera, none)[rows], values[rows], rcond=None)[0]
        power += (parts[-2 * lines : -lines] ** 2 + parts[-lines:] ** 2) @ weight
    order = np.argsort(power)[::-1][:MOST_LINES]
    return np.asarray(model.frequency_hz[order[power[order] >= WEAK * power[order[0]]]])


def find_shifts(model: ShiftModel, noise: float) -> IntArray:
    """Return by how many frames (C, S) each frame is later than assumed.

    Compared with the first one of its camera. Positive where frames show the body at later instants, because frames
    before were lost. `noise`: variance of one coordinate, in px², by the scatter of the subsets; the scatter of the
    frames is used if it is larger. Changes, or pairs of opposite ones, of one camera or of all are added where they
    lower the sum of squares most. After each, the best sequence for the amplitudes and the amplitudes for that sequence
    are found in turn. Zeros where all changes together explain less than half of the residual power.
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

    search = _ShiftSearch.of(model)
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
    if power > EXPLAINS * least or _may_be_unsteady(model, found, power):
        return np.zeros_like(found)
    return _smallest(model, found, power + level())


def _may_be_unsteady(model: ShiftModel, found: IntArray, power: float) -> bool:
    """Return whether a motion that changes over the record explains shifts as well."""
    if (found != found[0]).any():
        return False
    none = np.zeros_like(found)
    return model.fit_delay(none, model.fit(none)[2], unsteady=True)[1] * EXPLAINS < power


def _with_one_less(shifts: IntArray) -> Iterator[IntArray]:
    """Yield the shifts (C, S) without each of their changes."""
    for camera, shift in enumerate(shifts):
        for at in np.flatnonzero(np.diff(shift)) + 1:
            other = shifts.copy()
            other[camera, at:] -= shift[at] - shift[at - 1]
            yield np.clip(other, -FARTHEST, FARTHEST)


@dataclass(frozen=True)
class _ShiftSearch:
    """Sums over parts of the record, by which many shifts are compared.

    `splits` (B,): first frames of the parts. `gram` (C, N, B, P, P), `right` (C, N, B, P, 6): products of columns of
    the lines, without a phase between the cameras, for each shift from -FARTHEST on.
    """

    model: ShiftModel
    splits: IntArray
    gram: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, model: ShiftModel) -> _ShiftSearch:
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
        """Yield the best shifts (C, S) with a change more than `shifts`.

        Or with two opposite ones.
        """
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
        some = np.array_split(all_shifts, len(all_shifts) // MOST_AT_ONCE + 1)
        explained = np.concatenate([self.explained(one) for one in some])
        powers = np.where(np.abs(all_shifts).max(axis=(1, 2)) > FARTHEST, np.inf, -explained)
        for index in np.argsort(powers, kind="stable")[:REFINED]:
            counts = np.diff(np.append(self.splits, shifts.shape[1]))
            yield np.clip(shifts + np.repeat(change[index], counts, axis=1), -FARTHEST, FARTHEST)

    def explained(self, shifts: IntArray) -> FloatArray:
        """Return the sums of squares (H,) that shifts (H, C, B) of the parts explain."""
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
            gram += RIDGE * plain * np.einsum("hipp->hip", gram)[:, :, None]
            best = np.maximum(best, np.sum(np.linalg.solve(gram, right[..., None])[..., 0] * right, axis=(1, 2)))
        return best


def _changes(shifts: IntArray) -> int:
    """Return the number of changes of the shifts (C, S).

    A change of all cameras at once counts as one.
    """
    return int(np.count_nonzero(np.diff(shifts, axis=1).any(axis=0)))


def _refined(model: ShiftModel, shifts: IntArray, cost: float) -> tuple[float, IntArray]:
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


def _best_sequence(model: ShiftModel, camera: int, amplitudes: FloatArray, delay_s: float, cost: float) -> IntArray:
    """Return the best shifts (S,) of a camera.

    Of the least sum of squares and costs of changes (Viterbi).
    """
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


def _smallest(model: ShiftModel, shifts: IntArray, most: float) -> IntArray:
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


def lateness(model: ShiftModel, shifts: IntArray, noise: float) -> tuple[int, tuple[Notice, ...]]:
    """Return by how many frames the right camera is late, or a warning.

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
    variance = power / max(model.free, 1.0)
    u = omega * float(np.sqrt(2.0 * variance / curvature))
    unlike = power - SUSPICIOUS * noise * model.free > EQUAL**2 * model.motion
    improvement = model.fit_delay(shifts, 0.0)[1] - power
    if unlike or improvement < LATE_U**2 * variance or abs(phase) <= max(LATE_RAD, LATE_U * u):
        return 0, ()
    most = power + 0.5 * curvature * (max(LATE_U * u, FRAME_PHASE_TOLERANCE) / omega) ** 2
    for count in sorted((n for n in range(-FARTHEST, FARTHEST + 1) if n), key=lambda n: (abs(n), n < 0)):
        distance = abs(np.angle(np.exp(1j * (phase - omega * count * model.interval_s))))
        if distance < abs(phase) / 2.0 and model.fit_delay(shifts, count * model.interval_s)[1] <= most:
            return count, ()
    values = {"phase_mrad": 1e3 * abs(phase), "frequency_hz": model.frequency_hz[0], "u_mrad": 1e3 * u}
    side = "right" if phase > 0.0 else "left"
    return 0, (Notice(CAMERA_DELAYED, "exposure", late=side, delay_us=1e6 * abs(phase) / omega, **values),)
