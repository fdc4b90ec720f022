"""Errors of a pair's phasors by its sensors' fixed pattern, and their notices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from photogram.images.image_notices import PATTERN_CONTRADICTED, PATTERN_CORRECTED, PATTERN_UNKNOWN
from photogram.measure.body import TrackedSubsets
from photogram.measure.fixed_pattern import FixedPattern, cell_phasors
from photogram.measure.follow import sine_terms
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice
from shakercal._common.propagation import covariance_root

MIN_FREE_FRAMES = 4  # beyond the unknowns, to tell noise from what repeats with the motion
SHARED_SIGMAS = 2.0  # standard deviations beyond chance, from which whole columns or rows of cells err together
COMPONENTS = 6
CONTRADICTION = 3.0  # standard uncertainties by which a measured pattern exceeds a stated one
OPEN_SHARE = 0.5  # of what was uncertain before, from which the frames do not show the size of a pattern
NOTABLE_SHARE = 0.5  # correction over the noise, above which there is a notice


@dataclass(frozen=True, eq=False, repr=False)
class PatternReading(Arrays, shapes="time_s F; pose F 6; amplitude F S"):
    """A body tracked through F frames whose sensors have a fixed pattern.

    `amplitude`: of its deformation in the shapes that were fitted.
    """

    time_s: FloatArray
    pose: FloatArray
    amplitude: FloatArray
    pattern: FixedPattern
    tracks: TrackedSubsets

    def effects(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return changes (P, K, 6) of the phasors by independent unknowns of the fixed pattern.

        First those of its size in each camera (`FixedPattern.change`). Then what repeats with the motion in single
        cells, by chance to either side: the covariance of the cells' phasors, less that of noise, adds over all cells
        (a cluster for each cell; Liang and Zeger 1986, Biometrika 73, 13). Where whole columns or rows of cells err
        together, these are the clusters.
        """
        sizes = [self._phasors(step, frequency_hz) for step in np.moveaxis(self.pattern.change, 1, 0)]
        return np.concatenate([np.array(sizes), self._cell_effects(frequency_hz)])

    def _phasors(self, series: FloatArray, frequency_hz: FloatArray) -> ComplexArray:
        """Return the phasors (K, 6) of changes (F, 6) of the poses."""
        seen = np.isfinite(self.pose).all(axis=1)
        columns = sine_terms(self.time_s[seen], frequency_hz)
        found = np.linalg.lstsq(columns, series[seen], rcond=None)[0]
        return np.asarray(found[1::2] - 1j * found[2::2])

    def _cell_effects(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return changes (P, K, 6) by single cells, each at one line."""
        frames, lines, estimate = self.tracks.residual_frames, len(frequency_hz), self.pattern.estimate
        if len(frames) < 1 + 2 * lines + MIN_FREE_FRAMES:
            return np.empty((0, lines, COMPONENTS), np.complex128)
        columns = sine_terms(self.time_s[frames], frequency_hz)
        scores, noise = cell_phasors(self.tracks.fits(), columns)
        change = (scores - self._of_shapes(columns)) @ estimate.T
        noise = np.asarray(estimate @ noise.sum(axis=0) @ estimate.T)
        spread, effects = np.linalg.inv(columns.T @ columns), list[ComplexArray]()
        groups = [np.arange(change.shape[1]), *_cell_lines(self.tracks)]
        motion = self._phasors(self.pose, frequency_hz)
        for k in range(lines):
            parts = slice(1 + 2 * k, 3 + 2 * k)
            both, along = np.concatenate(list(change[parts]), axis=1), np.hstack([motion[k].real, -motion[k].imag])
            by_noise = np.kron(spread[parts, parts], noise)
            for root in covariance_root(_beyond_noise(both, groups, by_noise, along)).T:
                effect = np.zeros((lines, COMPONENTS), np.complex128)
                effect[k] = root[:COMPONENTS] - 1j * root[COMPONENTS:]
                effects.append(effect)
        return np.array(effects).reshape(-1, lines, COMPONENTS)

    def _of_shapes(self, columns: FloatArray) -> FloatArray:
        """Return the slopes (T, C, 6) that a deformation leaves in the cells."""
        amplitude = np.nan_to_num(self.amplitude[self.tracks.residual_frames])
        parts = np.linalg.lstsq(columns, amplitude, rcond=None)[0]
        cells = np.concatenate([one.information[:, :COMPONENTS] for one in self.tracks.scene.views])
        whole = cells.sum(axis=0)
        share = np.linalg.solve(whole[:, :COMPONENTS], whole[:, COMPONENTS:])
        left = cells[:, :, COMPONENTS:] - cells[:, :, :COMPONENTS] @ share
        return np.asarray(np.einsum("cps,ts->tcp", left, -parts))

    def notices(self, lines: tuple[FloatArray, BoolArray], phasors: Phasors, effects: ComplexArray) -> Iterator[Notice]:
        """Yield notices of contradicted statements and of the largest effect.

        `lines`: frequencies (K,), and whether they are driven. An effect is large beside the noise of the phasors.
        """
        pattern, (frequency_hz, driven) = self.pattern, lines
        both = zip(("left", "right"), pattern.patterns, pattern.variance.tolist(), strict=False)
        for camera, known, (size, u) in both:
            if known.known and size > 1.0 + CONTRADICTION * np.hypot(known.variance_uncertainty, u):
                ratio = float(np.sqrt(size))
                yield Notice(PATTERN_CONTRADICTED, f"{camera} camera", camera=camera, ratio=ratio, u=u / (2.0 * ratio))
        if not driven.any():
            return
        correction = np.abs(self._phasors(pattern.correction, frequency_hz))
        value, noise = np.abs(phasors.value), np.hypot(phasors.u_re, phasors.u_im)
        u, of_size = (_root_sum(some) for some in (effects, effects[: pattern.change.shape[1]]))
        main, each = np.argmax(value[:, :3], axis=1), np.arange(len(frequency_hz))
        k = int(np.argmax(np.where(driven, (np.maximum(correction, u) / noise)[each, main], 0.0)))
        at = k, main[k]
        values = {
            "frequency_hz": float(frequency_hz[k]),
            "motion_px": self._motion_px,
            "u_percent": 100.0 * float(u[at] / value[at]),
        }
        prior = np.array([one.variance_uncertainty for one in pattern.patterns])
        if of_size[at] > noise[at] and np.any(pattern.variance[:, 1] > OPEN_SHARE * prior):
            yield Notice(PATTERN_UNKNOWN, f"{frequency_hz[k]:.6g} Hz", **values)
        elif correction[at] > NOTABLE_SHARE * noise[at]:
            values |= {"prnu_percent": 100.0 * float(pattern.prnu[:, 0].max())}
            values |= {"correction_percent": 100.0 * float(correction[at] / value[at])}
            yield Notice(PATTERN_CORRECTED, f"{frequency_hz[k]:.6g} Hz", **values)

    @property
    def _motion_px(self) -> float:
        """The rms motion of the body in the images."""
        pose = self.pose[np.isfinite(self.pose).all(axis=1)]
        moved = pose - pose.mean(axis=0)
        rates = [np.nanmean(one.rates, axis=0) for one in self.tracks.scene.seen]
        return float(np.sqrt(np.mean([np.sum((moved @ rate.T) ** 2, axis=1) for rate in rates])))


def _root_sum(effects: ComplexArray) -> FloatArray:
    """Return the root of the sum of squares (K, 6) of effects (P, K, 6)."""
    return np.asarray(np.sqrt(np.sum(np.abs(effects) ** 2, axis=0)))


def _cell_lines(tracks: TrackedSubsets) -> Iterator[IntArray]:
    """Yield the columns (C,) of the cells in their cameras, then their rows."""
    for axis in range(2):
        numbers, start = list[IntArray](), 0
        for view in tracks.scene.views:
            place = np.rint(view.cells.centre_px[:, axis] / view.cells.side_px)
            numbers.append(start + np.unique(place, return_inverse=True)[1].astype(np.int64))
            start = int(numbers[-1].max(initial=start)) + 1
        yield np.concatenate(numbers)


def _beyond_noise(change: FloatArray, groups: list[IntArray], noise: FloatArray, motion: FloatArray) -> FloatArray:
    """Return the covariance (12, 12) of a sum of changes (C, 12) beyond noise.

    By what is common to a group of cells: `groups` are the group (C,) of every cell, first each cell alone, then
    columns and rows of cells. These count where their sums scatter along the `motion` (12,) by more than those of the
    cells, as chance explains in one case of forty.
    """
    direction = np.linalg.lstsq(noise, motion, rcond=None)[0]
    alone, *others = (_scatter(change, group) for group in groups)
    total = alone - noise
    for group, shared in zip(groups[1:], others, strict=True):
        chance = SHARED_SIGMAS * np.sqrt(2.0 / (1 + int(group.max(initial=0))))
        if direction @ shared @ direction > (1.0 + chance) * (direction @ alone @ direction):
            total = total + shared - alone
    return np.asarray((total + total.T) / 2.0)


def _scatter(change: FloatArray, group: IntArray) -> FloatArray:
    """Return the sum of squares (12, 12) of the groups' sums."""
    sums = np.zeros((1 + int(group.max(initial=0)), change.shape[1]))
    np.add.at(sums, group, change)
    return np.asarray(sums.T @ sums)
