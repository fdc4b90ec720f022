"""Errors of a pair's phasors by the fixed pattern of its cameras' sensors, and their notices."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.phasors.stereo_motion import ImageView, StereoMotion
from photogram.images.image_notices import PATTERN_CONTRADICTED, PATTERN_CORRECTED, PATTERN_UNKNOWN
from photogram.measure.body import TrackedSubsets
from photogram.measure.fixed_pattern import FixedPattern, cell_phasors
from photogram.measure.follow import sine_terms
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice
from shakercal._common.propagation import covariance_root

MIN_FREE_FRAMES = 4  # beyond the unknowns, to tell noise from what repeats with the motion
SHARED_SIGMAS = 3.0  # standard deviations beyond chance, from which whole columns or rows of cells err together
COMPONENTS = 6
CONTRADICTION = 3.0  # standard uncertainties by which a measured pattern exceeds a stated one
NOTABLE_SHARE = 0.5  # correction or its standard uncertainty, over that of noise, above which there is a notice


def pattern_effects(measured: StereoMotion, view: ImageView, frequency_hz: FloatArray) -> ComplexArray:
    """Return changes (P, K, 6) of the phasors by independent unknowns of the fixed pattern.

    First those of its size in each camera (`FixedPattern.change`). Then what repeats with the motion in single cells,
    by chance to either side: the covariance of the cells' phasors, less that of noise, adds over all cells (a cluster
    for each cell; Liang and Zeger 1986, Biometrika 73, 13). Where whole columns or rows of cells err together, these
    are the clusters.
    """
    pattern = view.pattern
    if pattern is None or not isinstance(view.tracks, TrackedSubsets):
        return np.empty((0, len(frequency_hz), COMPONENTS), np.complex128)
    sizes = [_phasors(measured, step, frequency_hz) for step in np.moveaxis(pattern.change, 1, 0)]
    return np.concatenate([np.array(sizes), _cell_effects(measured, view, view.tracks, pattern, frequency_hz)])


def _phasors(measured: StereoMotion, series: FloatArray, frequency_hz: FloatArray) -> ComplexArray:
    """Return the phasors (K, 6) of changes (F, 6) of the poses."""
    seen = np.isfinite(measured.motion.pose).all(axis=1)
    columns = sine_terms(measured.sight.time_s[seen], frequency_hz)
    found = np.linalg.lstsq(columns, series[seen], rcond=None)[0]
    return np.asarray(found[1::2] - 1j * found[2::2])


def _cell_effects(
    measured: StereoMotion, view: ImageView, tracks: TrackedSubsets, pattern: FixedPattern, frequency_hz: FloatArray
) -> ComplexArray:
    """Return changes (P, K, 6) by the fixed pattern of single cells, each at one line."""
    frames, lines = tracks.residual_frames, len(frequency_hz)
    if len(frames) < 1 + 2 * lines + MIN_FREE_FRAMES:
        return np.empty((0, lines, COMPONENTS), np.complex128)
    columns = sine_terms(measured.sight.time_s[frames], frequency_hz)
    scores, noise = cell_phasors(tracks.fits(), columns)
    scores = scores - _of_shapes(view, tracks, columns)
    change = scores @ pattern.estimate.T
    noise = np.asarray(pattern.estimate @ noise.sum(axis=0) @ pattern.estimate.T)
    spread, effects = np.linalg.inv(columns.T @ columns), list[ComplexArray]()
    groups = [np.arange(change.shape[1]), *_cell_lines(tracks)]
    for k in range(lines):
        parts = slice(1 + 2 * k, 3 + 2 * k)
        both = np.concatenate(list(change[parts]), axis=1)
        by_noise = np.kron(spread[parts, parts], noise)
        for root in covariance_root(_beyond_noise(both, groups, by_noise)).T:
            effect = np.zeros((lines, COMPONENTS), np.complex128)
            effect[k] = root[:COMPONENTS] - 1j * root[COMPONENTS:]
            effects.append(effect)
    return np.array(effects).reshape(-1, lines, COMPONENTS)


def _of_shapes(view: ImageView, tracks: TrackedSubsets, columns: FloatArray) -> FloatArray:
    """Return the cells' slopes (T, C, 6) that a deformation in the fitted shapes leaves after the rigid motion."""
    amplitude = np.nan_to_num(view.deformed.amplitude[tracks.residual_frames])
    parts = np.linalg.lstsq(columns, amplitude, rcond=None)[0]
    cells = np.concatenate([one.information[:, :COMPONENTS] for one in tracks.scene.views])
    whole = cells.sum(axis=0)
    share = np.linalg.solve(whole[:, :COMPONENTS], whole[:, COMPONENTS:])
    left = cells[:, :, COMPONENTS:] - cells[:, :, :COMPONENTS] @ share
    return np.asarray(np.einsum("cps,ts->tcp", left, -parts))


def _cell_lines(tracks: TrackedSubsets) -> Iterator[IntArray]:
    """Yield the number (C,) of each cell's column of cells in its camera, then that of its row."""
    for axis in range(2):
        numbers, start = list[IntArray](), 0
        for view in tracks.scene.views:
            place = np.rint(view.cells.centre_px[:, axis] / view.cells.side_px)
            numbers.append(start + np.unique(place, return_inverse=True)[1].astype(np.int64))
            start = int(numbers[-1].max(initial=start)) + 1
        yield np.concatenate(numbers)


def _beyond_noise(change: FloatArray, groups: list[IntArray], noise: FloatArray) -> FloatArray:
    """Return the covariance (12, 12) of the sum of the cells' changes (C, 12) by what is common to a group of cells.

    `groups`: the group (C,) of every cell, each its own first, then columns and rows of cells, which count where their
    sums scatter more than those of the cells.
    """
    scale = np.linalg.pinv(noise)
    alone, *others = (_scatter(change, group) for group in groups)
    extent, total = float(np.sum(scale * alone)), alone - noise
    for group, shared in zip(groups[1:], others, strict=True):
        chance = SHARED_SIGMAS * np.sqrt(2.0 / (change.shape[1] * (1 + group.max(initial=0))))
        if np.sum(scale * shared) > (1.0 + chance) * extent:
            total = total + shared - alone
    return np.asarray((total + total.T) / 2.0)


def _scatter(change: FloatArray, group: IntArray) -> FloatArray:
    """Return the sum of squares (12, 12) of the groups' sums."""
    sums = np.zeros((1 + int(group.max(initial=0)), change.shape[1]))
    np.add.at(sums, group, change)
    return np.asarray(sums.T @ sums)


def pattern_notices(
    measured: StereoMotion,
    view: ImageView,
    lines: tuple[FloatArray, BoolArray],
    phasors: Phasors,
    effects: ComplexArray,
) -> Iterator[Notice]:
    """Yield notices of patterns that differ from what is stated, and of the driven line with the largest effect.

    `lines`: frequencies (K,), and whether they are driven. An effect is large beside the noise of the phasors (K, 6).
    """
    pattern, (frequency_hz, driven) = view.pattern, lines
    if pattern is None or not len(effects):
        return
    for camera, known, (size, u) in zip(("left", "right"), pattern.patterns, pattern.variance.tolist(), strict=False):
        if known.known and size > 1.0 + CONTRADICTION * np.hypot(known.variance_uncertainty, u):
            ratio = float(np.sqrt(size))
            yield Notice(PATTERN_CONTRADICTED, f"{camera} camera", camera=camera, ratio=ratio, u=u / (2.0 * ratio))
    if not driven.any():
        return
    correction = np.abs(_phasors(measured, pattern.correction, frequency_hz))
    value, noise = np.abs(phasors.value), np.hypot(phasors.u_re, phasors.u_im)
    u, u_size = (np.sqrt(np.sum(np.abs(some) ** 2, axis=0)) for some in (effects, effects[: pattern.change.shape[1]]))
    main, each = np.argmax(value[:, :3], axis=1), np.arange(len(frequency_hz))
    k = int(np.argmax(np.where(driven, (np.maximum(correction, u) / noise)[each, main], 0.0)))
    size, u_whole, of_size, of_noise, whole = (float(one[k, main[k]]) for one in (correction, u, u_size, noise, value))
    values = {
        "frequency_hz": float(frequency_hz[k]),
        "motion_px": _motion_px(measured, view),
        "u_percent": 100.0 * u_whole / whole,
    }
    where = f"{frequency_hz[k]:.6g} Hz"
    if of_size > of_noise:
        yield Notice(PATTERN_UNKNOWN, where, **values)
    elif max(size, u_whole) > NOTABLE_SHARE * of_noise:
        prnu = np.array([one.prnu for one in pattern.patterns]) * np.sqrt(np.maximum(pattern.variance[:, 0], 0.0))
        percent = {"prnu_percent": 100.0 * float(prnu.max()), "correction_percent": 100.0 * size / whole}
        yield Notice(PATTERN_CORRECTED, where, **percent, **values)


def _motion_px(measured: StereoMotion, view: ImageView) -> float:
    """Return the rms motion of the body in the images, px."""
    assert isinstance(view.tracks, TrackedSubsets)
    pose = measured.motion.pose[np.isfinite(measured.motion.pose).all(axis=1)]
    moved = pose - pose.mean(axis=0)
    rates = [np.nanmean(one.rates, axis=0) for one in view.tracks.scene.seen]
    return float(np.sqrt(np.mean([np.sum((moved @ rate.T) ** 2, axis=1) for rate in rates])))
