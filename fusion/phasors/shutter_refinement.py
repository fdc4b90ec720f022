"""Refined motion of pairs with a rolling shutter or long exposures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.base import Threads
from fusion.phasors.image_effects import displacement, fit_about_mean
from fusion.phasors.phasor_notices import COARSE_ROWS, MOTION_BLUR, ROLLING_SHUTTER, SHUTTER_NOT_CONVERGED
from fusion.phasors.stereo_motion import PhaseRotated, PreparedImages, StereoMotion, motion_from_tracks, resolved_lines
from photogram.measure.body import TrackedSubsets, body_motion
from photogram.measure.exposure_motion import (
    WIDEST_CELL,
    ExposureCorrection,
    ExposureMotion,
    prepare_exposure_correction,
    row_delay_s,
)
from photogram.measure.follow import FollowedFrame, iterate_blocks
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import exposure_gain
from shaker.sine.normal_equations import SineSums
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

FINEST_RAD_PX = 0.7  # typical wave number of grey values of speckle
BLUR_COUNTS = 1e-5  # relative bias by blur above which it is corrected
CLOSE, MOST_LOOKS = 3e-4, 6  # relative change of the motion at convergence, and most iterations
NOTABLE_CHANGE = 3e-3  # largest final change without a notice


def refine_rolling_shutter(
    measured: StereoMotion, images: Sequence[PreparedImages], lines: LineFrequencies
) -> StereoMotion:
    """Return the motion of a pair with all rows at one instant.

    Blur is accounted for. The same object is returned if all rows are exposed at once, and too briefly to blur the
    motion.
    """
    view, pair, exposure_s = measured.view, measured.sight.pair, measured.sight.exposure.length_s
    usable, _ = resolved_lines(measured, lines)
    if view is None or not isinstance(view.tracks, TrackedSubsets) or not usable.any():
        return measured
    frequency_hz, first = lines.frequency_hz[usable], view.tracks
    phasors = _of_subsets(measured, first, frequency_hz)
    blurs = _blur_bias(first, frequency_hz, phasors, exposure_s) > BLUR_COUNTS
    if not (any(pair.row_time) or blurs):
        return measured
    (prepared,) = (item for item in images if item.sight.name == measured.sight.name)
    prepared = replace(prepared, sight=measured.sight)
    frames = [frame for block in iterate_blocks(first.scene, first.blocks) for frame in block]
    found, last, left = measured, None, np.inf
    for _ in range(MOST_LOOKS):
        swing = ExposureMotion(frequency_hz, phasors, measured.sight.time_s, exposure_s, pair.row_time, bool(blurs))
        found = _look(prepared, prepare_exposure_correction(first.scene, swing), frames)
        _, _, fit = fit_about_mean(found, frequency_hz)
        answer = displacement(found, fit).value / exposure_gain(frequency_hz, exposure_s)[:, None]
        change = answer - phasors
        left = float(np.linalg.norm(change[:, :3]) / np.linalg.norm(answer[:, :3]))
        if left < CLOSE:
            break
        phasors, last = _nearer(answer, change, last), (answer, change)
    bias = _blur_bias(first, frequency_hz, phasors, exposure_s)
    return replace(found, notices=(*found.notices, *_shutter_notices(found, swing, bias, left)))


def _shutter_notices(measured: StereoMotion, swing: ExposureMotion, bias: float, left: float) -> Iterator[Notice]:
    """Yield the effects of motion during exposures, and whether the fit did not converge."""
    rotated = None if measured.view is None else measured.view.phase_rotated
    fastest_hz = float(swing.frequency_hz.max())
    if rotated is not None:
        across_s = float(np.nanmax(rotated.delay_s) - np.nanmin(rotated.delay_s))
        angle = 360.0 * fastest_hz * across_s
        yield Notice(ROLLING_SHUTTER, "row_time", duration_ms=1e3 * across_s, frequency_hz=fastest_hz, angle=angle)
        if rotated.side_px > WIDEST_CELL / swing.per_row:
            periods = rotated.side_px * swing.per_row
            yield Notice(COARSE_ROWS, "row_time", periods=periods, frequency_hz=fastest_hz)
    if bias > BLUR_COUNTS:
        yield Notice(MOTION_BLUR, "exposure", exposure_ms=1e3 * swing.exposure_s, bias_percent=100.0 * bias)
    if left > NOTABLE_CHANGE:
        yield Notice(SHUTTER_NOT_CONVERGED, "exposure", change_percent=100.0 * left)


def _nearer(answer: ComplexArray, change: ComplexArray, last: tuple[ComplexArray, ComplexArray] | None) -> ComplexArray:
    """Return an improved motion from two iterations (Anderson 1965, J. ACM 12, 547)."""
    if last is None:
        return answer
    step = change - last[1]
    share = np.vdot(step[:, :3], change[:, :3]).real / np.vdot(step[:, :3], step[:, :3]).real
    return np.asarray(answer - share * (answer - last[0]))


def _look(prepared: PreparedImages, correction: ExposureCorrection, frames: Sequence[FollowedFrame]) -> StereoMotion:
    """Return the motion of a pair by correcting every frame after the first."""
    correction = correction.with_noise(1, frames[1])
    with Threads() as crew:
        pending = [crew.submit(0, correction.correct_frame, number, frames[number]) for number in range(1, len(frames))]
        looked = [answer.result().unwrap() for answer in pending]
    body = body_motion(correction.scene, [tuple(frame for frame, _ in looked)])
    seen, swing = motion_from_tracks(prepared, body), correction.swing
    if not swing.rolling_shutter:
        return seen
    response, of_motion = correction.responses
    pose = np.full((len(frames), *of_motion.shape[:2]), np.nan, np.complex128)
    for number, (_, rotated) in enumerate(looked, 1):
        if rotated is not None:
            pose[number] = rotated
    blurred = swing.phasors * exposure_gain(swing.frequency_hz, swing.exposure_s)[:, None]
    reference_motion = np.einsum("kij,kj->ki", of_motion[:, :, :6], blurred)
    side_px = correction.scene.views[0].cells.side_px
    assert seen.view is not None
    if seen.view.pattern is not None:
        pose[..., :6] += np.einsum("kij,fj->fki", response[:, :6, :6], seen.view.pattern.correction)
    rotated = PhaseRotated(pose, response, reference_motion, correction.row_lag, correction.delay_s, side_px)
    return replace(seen, view=replace(seen.view, phase_rotated=rotated))


def _of_subsets(measured: StereoMotion, tracked: TrackedSubsets, frequency_hz: FloatArray) -> ComplexArray:
    """Return the motion (K, 6) from positions of subsets by rows, by least squares."""
    sums, scene = None, tracked.scene
    for block in tracked:
        both = np.concatenate([one.position_px for one in block.cameras], axis=2)
        sums = SineSums(measured.points_time_s, frequency_hz, np.nan_to_num(both[0])) if sums is None else sums
        sums.add(both)
    assert sums is not None
    mean, value, _ = sums.solve(1)
    side_px, phasors = 2 * scene.settings.radius_px + 1, []
    for k, hertz in enumerate(frequency_hz.tolist()):
        shown, rates = list[ComplexArray](), list[FloatArray]()
        for side, (seen, row_s) in enumerate(zip(scene.seen, measured.sight.pair.row_time, strict=False)):
            delay_s = row_delay_s(row_s, mean[:, 2 * side + 1], int(scene.images[side].size_px[1]))
            loss = np.sinc(hertz * measured.sight.exposure.length_s) * np.sinc(hertz * row_s * side_px)
            shown.append(value[k, :, 2 * side : 2 * side + 2] * np.exp(-2j * np.pi * hertz * delay_s)[:, None] / loss)
            rates.append(seen.rates)
        positions, design = np.concatenate(shown), np.concatenate(rates)
        finite = np.isfinite(positions).all(axis=1) & np.isfinite(design).all(axis=(1, 2))
        phasors.append(np.linalg.lstsq(design[finite].reshape(-1, 6), positions[finite].ravel(), rcond=None)[0])
    return np.array(phasors)


def _blur_bias(tracked: TrackedSubsets, frequency_hz: FloatArray, phasors: ComplexArray, exposure_s: float) -> float:
    """Return the approximate relative bias of a motion by its blur.

    If it is fitted to sharp grey values. A wave of grey exp(jkx) averaged over the path of a sine of amplitude a shifts
    in phase by the third moment of the path, a³ω⁴T⁴·sin²·cos/120. This is k²a²(ωT)⁴/2880 of the amplitude at the line,
    and the same at three times its frequency.
    """
    rates = np.concatenate([seen.rates for seen in tracked.scene.seen])
    amplitude = np.linalg.norm(np.einsum("nij,kj->nki", rates, phasors), axis=2)
    path = np.nanmedian(amplitude, axis=0) * FINEST_RAD_PX * (2.0 * np.pi * frequency_hz * exposure_s) ** 2
    return float(np.max(path**2)) / 2880.0
