"""Displacement phasors of a stereo pair's body, with errors common to all its frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion.base import Threads
from fusion.errors import ComputeError
from fusion.estimation.measurement_model import Observation
from fusion.instruments.channel import FittedError
from fusion.instruments.stereo import PATTERN, StereoReading
from fusion.phasors.channel_phasors import expand_lines
from fusion.phasors.deformation import DeflectionShape, ShapePhasors, deflection_shape, shape_phasors
from fusion.phasors.image_effects import THROUGH, displacement, fit_about_mean, image_effects, pattern_reading
from fusion.phasors.phasor_notices import (
    BODY_DISPLACED,
    BODY_LOST,
    LINE_UNOBSERVED,
    LINES_UNRESOLVED,
    NO_RIGID_MOTION,
    PAIR_REJECTED,
    PERIODIC_JITTER,
    SHORT_BEAT,
    TOO_FEW_FRAMES_FOR_STEP,
)
from fusion.phasors.stereo_motion import ImageView, RejectedPair, StereoMotion, resolved_lines
from fusion.phasors.timing import Sight, TimeBase, TimingError, combine_timing_errors
from fusion.recording.transducer import STATIONARY
from photogram.camera import FaceCamera, StereoRig
from photogram.images.noise import NoiseModel
from photogram.images.sequence import GreyImage
from photogram.motion import Deformation, RigidMotion
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import alias_frequency, exposure_gain, nearest_clear_rate, sine_columns
from shaker.sine.normal_equations import sine_amplitudes
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import Stationarity, stationarity
from shaker.sine.solve import SineFit
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from photogram.measure.epipolar import EpipolarCheck

STEP, MIN_FREE_FRAMES = 20.0, 4  # step over noise that is not by chance; frames beyond the unknowns of the lines
ONE_BEAT = 1.1  # periods of a line's alias: over fewer, a slope looks like the line
NO_LINE = "its frame rate resolves no line of the recording"


@dataclass(frozen=True, repr=False)
class StereoResult(Arrays):
    """Motion of one stereo pair's body in the sensor frame.

    `time_s` (F,): exposure middles on the first DAQ's clock. `motion`: from the first frame's pose. `motion_from_mean`:
    referred to the mean pose, the series of `fit` (six components, m and rad) with its `residual` (F, 6). `phasors` (K,
    6): of the body's displacement, corrected for the exposure. `usable` (K,): lines of the recording that this frame
    rate resolves.

    `reference_image` (H, W), `subsets_px` (N, 2): first left image and its subsets, None for points of another program.
    `deflection`: of the points at the usable lines; `shapes`: from all pixels; both None for a single camera, which
    cannot separate depth from stretch. `noise`: of each camera. `sigma_px` (2,): median standard deviation of a
    subset's coordinate, as predicted from the first images and as measured. `subset_zncc` (N,): correlation of each
    subset in the left camera, mean over the frames. `prnu` (cameras, 2): rms of the pixels'
    gains by the fixed pattern, and u. `epipolar`: test of the calibration per frame; its notices are among the
    evaluation's.

    `stationarity`: the six components over blocks of whole beats, without exposure correction. `u_exposure_s`: 0 for a
    stated exposure. `u_rate`: relative, of the frame rate. `surface`: points and their deformation in every frame, some
    frames at a time.
    """

    name: str
    body: str
    time_s: FloatArray
    exposure_s: float
    motion: RigidMotion
    motion_from_mean: RigidMotion
    fit: SineFit
    phasors: Phasors
    residual: FloatArray = field(init=False)
    usable: NDArray[np.bool_]
    reprojection_px: float
    reference_image: GreyImage | None = None
    subsets_px: FloatArray | None = None
    speckle_px: float | None = None
    noise_grey: float | None = None
    median_zncc: float | None = None
    subset_zncc: FloatArray | None = None
    deflection: DeflectionShape | None = None
    shapes: ShapePhasors | None = None
    surface: Iterable[Deformation] | None = None
    noise: tuple[NoiseModel, ...] = ()
    sigma_px: FloatArray | None = None
    prnu: FloatArray | None = None
    epipolar: EpipolarCheck | None = None
    stationarity: Stationarity | None = None
    u_exposure_s: float = 0.0
    u_rate: float = 0.0

    def __post_init__(self) -> None:
        residual = self.fit.residual_of(self.time_s, self.motion_from_mean.pose)
        object.__setattr__(self, "residual", residual)


@dataclass(frozen=True)
class StereoPhasors:
    """Phasors of one stereo pair: its `result`, and its `reading` for the linear model.

    The phasors of the reading, corrected for the exposure, are NaN at lines that this frame rate does not resolve. So
    are its `effects`: of each principal component of the calibration's covariance, and of errors periodic in the pixel.
    """

    result: StereoResult
    reading: StereoReading
    notices: tuple[Notice, ...]


def pairs_phasors(
    base: TimeBase,
    motions: Sequence[StereoMotion],
    lines: LineFrequencies,
    line_errors: Sequence[TimingError],
    strength: FloatArray | None,
) -> tuple[tuple[StereoPhasors, ...], tuple[Notice, ...], tuple[RejectedPair, ...]]:
    """Fit the lines to the motion of every stereo pair.

    Pairs that resolve none are rejected. The notices name rejected lines and pairs; the third result are pairs without
    a possible fit. `line_errors`: errors of the lines. `strength` (K,): acceleration at each line relative to the
    strongest, as far as channels measure it.
    """
    fitted: list[StereoPhasors] = []
    unfitted: list[RejectedPair] = []
    notices: list[Notice] = []
    resolving = []
    for measured in motions:
        where = f"stereo pair {measured.sight.name}"
        usable, aliased = resolved_lines(measured, lines)
        notices += [notice.at(f"{where}, {notice.where}") for notice in aliased]
        if usable.any():
            resolving.append(measured)
        else:
            notices.append(Notice(PAIR_REJECTED, where, reason=NO_LINE))
    with Threads() as crew:
        pending = [crew.submit(0, stereo_phasors, base, one, lines, line_errors, strength) for one in resolving]
        for measured, answer in zip(resolving, pending, strict=True):
            try:
                fitted.append(answer.result().unwrap())
            except ComputeError as error:
                unfitted.append(RejectedPair(measured.sight.name, error))
    return tuple(fitted), tuple(notices), tuple(unfitted)


def stereo_phasors(
    base: TimeBase,
    measured: StereoMotion,
    lines: LineFrequencies,
    line_errors: Sequence[TimingError] = (),
    strength: FloatArray | None = None,
) -> StereoPhasors:
    """Fit the resolved lines to a body's motion about its mean pose.

    Errors of trigger, clocks and lines (`line_errors`) act through that fit: over many beats they turn the phasors,
    over less than one they change every part. So does motion at unresolved lines, with the relative acceleration
    `strength` (K,).
    """
    sight, view, name, exposure = measured.sight, measured.view, measured.sight.name, measured.sight.exposure
    time_s, length_s = sight.time_s, exposure.length_s
    usable, _ = resolved_lines(measured, lines)
    if not usable.any():
        raise ComputeError(NO_RIGID_MOTION, pair=name, reason=NO_LINE)
    frequency_hz = lines.frequency_hz[usable]
    notices = _step(name, time_s, measured.motion.pose[:, :3], frequency_hz)
    measured, from_mean, fit = fit_about_mean(measured, frequency_hz)
    gain = exposure_gain(lines.frequency_hz, length_s)
    errors = [e.effect_on_fit(fit, usable, 2) for e in combine_timing_errors([*base.sight_errors(sight), *line_errors])]
    errors += [] if strength is None else _left_out(measured, fit, lines, usable, gain * strength)
    errors = [error.scaled((1.0 / gain)[:, None]) for error in errors]
    moved, effects, shapes = displacement(measured, fit), dict[str, ComplexArray](), None
    phasors = expand_lines(moved, usable, lines.frequency_hz).scaled((1.0 / gain)[:, None])
    if view is not None and sight.pair.body != STATIONARY:  # effects grow with the observed motion
        effects, of_shapes = image_effects(measured, view, frequency_hz, usable, gain)
        if isinstance(view.rig, StereoRig):
            shapes = shape_phasors(time_s, frequency_hz, view.deformed, length_s, of_shapes, moved, view.phase_rotated)
        notices += _of_pattern(measured, view, lines, usable, moved, effects)
    reading = StereoReading(
        name=name,
        pair=sight.pair,
        phasors=phasors,
        effects=effects,
        clock_uncertainty=base.records[0].entry.clock_uncertainty,
        errors=(*errors, *_row_time_error(measured, phasors), *exposure.errors(lines.frequency_hz)),
        face_m=np.asarray(np.nanmean(next(iter(measured.deformation)).reference_m, axis=0)),
        through_surface=effects.pop(THROUGH, None),
    )
    of_phasors = [*(n for n in fit.notices if n.severity == "warning"), *notices, *(shapes.notices() if shapes else ())]
    of_phasors += _short_notices(lines, usable, time_s, reading)
    of_phasors += _jitter_notices(base, sight, lines, usable, reading)
    steady = np.isin(np.arange(len(time_s)), fit.spikes, invert=True)[:, None]
    result = StereoResult(
        name=name,
        body=sight.pair.body,
        time_s=time_s,
        exposure_s=length_s,
        u_exposure_s=exposure.u_length_s,
        u_rate=float(np.linalg.norm([error.rate for error in base.sight_errors(sight)])),
        motion=measured.motion,
        motion_from_mean=from_mean,
        fit=fit,
        phasors=moved.scaled((1.0 / gain[usable])[:, None]),
        usable=usable,
        reprojection_px=measured.reprojection_px,
        surface=measured.deformation,
        deflection=_deflection(measured, frequency_hz),
        stationarity=stationarity(time_s, np.where(steady, from_mean.pose, np.nan), frequency_hz, MOTION_COMPONENTS),
    )
    result = result if view is None else with_view(replace(result, shapes=shapes), view)
    return StereoPhasors(result, reading, _named(measured, of_phasors))


def _of_pattern(
    measured: StereoMotion,
    view: ImageView,
    lines: LineFrequencies,
    usable: NDArray[np.bool_],
    moved: Phasors,
    effects: Mapping[str, ComplexArray],
) -> Iterator[Notice]:
    """Yield the notices of the sensors' fixed pattern."""
    reading = pattern_reading(measured, view)
    if reading is not None:
        frequency_hz, driven = lines.frequency_hz[usable], np.asarray(lines.multiple[usable] == 1)
        gain = exposure_gain(frequency_hz, measured.sight.exposure.length_s)
        yield from reading.notices((frequency_hz, driven), moved, effects[PATTERN][:, usable] * gain[:, None])


def _named(measured: StereoMotion, of_phasors: Sequence[Notice]) -> tuple[Notice, ...]:
    """Return the notices of motion and phasors with the pair's name."""
    return tuple(
        notice.at(f"stereo pair {measured.sight.name}, {notice.where}") for notice in (*measured.notices, *of_phasors)
    )


def _row_time_error(measured: StereoMotion, phasors: Phasors) -> list[FittedError]:
    """Return the effect of one standard uncertainty of the row time, growing with rows."""
    rotated, pair = None if measured.view is None else measured.view.phase_rotated, measured.sight.pair
    if rotated is None or pair.row_time_uncertainty == 0.0:
        return []
    later = 2j * np.pi * phasors.frequency_hz[:, None] * (np.nan_to_num(phasors.value) @ rotated.row_delay.T)
    name, none = f"stereo {measured.sight.name}: row time", np.zeros((len(later), 1), np.complex128)
    u = pair.row_time_uncertainty
    return [FittedError(name, name, u, "s", none, "rig", additive=u * later)]


def _deflection(measured: StereoMotion, frequency_hz: FloatArray) -> DeflectionShape | None:
    """Return the deformation of the points at the lines, None for a single camera."""
    if measured.view is not None and isinstance(measured.view.rig, FaceCamera):
        return None
    length_s = measured.sight.exposure.length_s
    shape = deflection_shape(measured.points_time_s, frequency_hz, measured.deformation, length_s)
    if measured.view is None or measured.view.phase_rotated is None:
        return shape
    turn = np.exp(-2j * np.pi * np.multiply.outer(frequency_hz, measured.view.phase_rotated.delay_s))
    return replace(shape, value=shape.value * turn[..., None])


def _left_out(
    measured: StereoMotion, fit: SineFit, lines: LineFrequencies, usable: NDArray[np.bool_], strength: FloatArray
) -> list[FittedError]:
    """Return the effects of motion at unresolved lines on the others.

    Twelve unknowns at each, Re and Im. `strength` (K,): acceleration at each line relative to the strongest one, after
    the exposure. With the measured motion at the strongest `usable` line, a translation or rotation in any direction
    may be as large as the largest there.
    """
    seen = np.where(usable, np.nan_to_num(strength), 0.0)
    best = int(np.argmax(seen))
    if not seen[best] > 0.0:
        return []
    time_s, found = measured.sight.time_s, np.array(np.isfinite(measured.motion.pose).all(axis=1))
    found[fit.spikes] = False
    size = np.abs(fit.phasors.value[np.count_nonzero(usable[:best])]).reshape(2, 3).max(axis=1)
    errors = []
    for k in np.flatnonzero(~usable & (np.nan_to_num(strength) > 0.0)):
        frequency = float(lines.frequency_hz[k])
        amplitude = size * strength[k] / strength[best] * (lines.frequency_hz[best] / frequency) ** 2
        u = amplitude / np.sqrt(2.0)  # of any phase
        angle = 2.0 * np.pi * frequency * time_s[found]
        parts = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        _, leak = sine_amplitudes(time_s[found], parts, lines.frequency_hz[usable])
        for c, component in enumerate(MOTION_COMPONENTS):
            for part, response in zip(("Re", "Im"), leak.T, strict=True):
                rest = np.zeros((len(usable), 6), dtype=np.complex128)
                rest[usable, c] = u[c // 3] * response
                label = f"motion at {frequency:.6g} Hz, left out of stereo {measured.sight.name}"
                unit, none = component_units(0)[c], np.zeros((len(usable), 1), np.complex128)
                name = f"{measured.sight.pair.body} at {frequency:.6g} Hz: {component}, {part}"
                errors.append(FittedError(name, label, float(u[c // 3]), unit, none, additive=rest))
    return errors


def _short_notices(
    lines: LineFrequencies, usable: NDArray[np.bool_], time_s: FloatArray, reading: StereoReading
) -> list[Notice]:
    """Return warnings of driven lines that less than a beat makes uncertain beyond noise."""
    fitted = [error for error in reading.errors if isinstance(error, FittedError)]
    interval_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    rate_hz, notices = 1.0 / interval_s, []
    for k in np.flatnonzero(usable & (lines.multiple == 1)):
        frequency = float(lines.frequency_hz[k])
        alias = float(alias_frequency(frequency, rate_hz))
        beats = len(time_s) * interval_s * min(alias, rate_hz / 2.0 - alias)
        value = reading.phasors.value[k]
        c = int(np.argmax(np.abs(value[:3])))
        # A change times this is relative; its real part is that of the amplitude.
        along = np.conj(value[c]) / max(np.abs(value[c]) ** 2, np.finfo(np.float64).tiny)
        noise = float(reading.phasors.u_re[k, c] * np.abs(along))
        shares = {}
        for cause, clock in (("errors of its clock", True), ("motion at lines that it does not resolve", False)):
            of_amplitude = [float((e.additive[k, c] * along).real) for e in fitted if np.any(e.effect) == clock]
            shares[cause] = float(np.linalg.norm(of_amplitude))
        if beats >= ONE_BEAT or float(np.linalg.norm(list(shares.values()))) <= noise:
            continue
        causes = [f"{cause} {100.0 * u:.2g} %" for cause, u in shares.items() if u > noise / 2.0]
        clear = nearest_clear_rate(lines.frequency_hz, rate_hz, len(time_s))
        notices.append(
            Notice(
                SHORT_BEAT,
                f"{frequency:.6g} Hz",
                beats=beats,
                frequency_hz=frequency,
                frames=len(time_s),
                rate_hz=rate_hz,
                causes=", ".join(causes),
                suggestion="" if clear is None else f", such as {clear:.3f} Hz",
            )
        )
    return notices


def _jitter_notices(
    base: TimeBase, sight: Sight, lines: LineFrequencies, usable: NDArray[np.bool_], reading: StereoReading
) -> list[Notice]:
    """Return warnings of scattering trigger edges with a possible effect on a driven line.

    If the effect may exceed the noise. Random scatter appears in the residuals of the lines. Instants late by
    a·cos(2ωt), or any alias of it, turn the motion at ω into a part ωa/2 at -ω, which is the line itself and not
    visible; a is √2 times the scatter.
    """
    _, trigger = base.first_with(sight.exposure.trigger)
    notices = []
    for k in np.flatnonzero(usable & (lines.multiple == 1)) if trigger.jitter_detected else ():
        value = reading.phasors.value[k]
        c = int(np.argmax(np.abs(value[:3])))
        noise = float(max(reading.phasors.u_re[k, c], reading.phasors.u_im[k, c]))
        share = np.sqrt(2.0) * np.pi * float(lines.frequency_hz[k]) * trigger.jitter_s
        if share * np.abs(value[c]) > noise:
            hertz = float(lines.frequency_hz[k])
            notices.append(
                Notice(
                    PERIODIC_JITTER,
                    f"{hertz:.6g} Hz",
                    trigger=sight.exposure.trigger,
                    jitter_us=1e6 * trigger.jitter_s,
                    frequency_hz=hertz,
                    change_percent=100.0 * share,
                )
            )
    return notices


def with_view(result: StereoResult, view: ImageView) -> StereoResult:
    """Add the results of images: first image, subsets, noise, and predicted and measured scatter."""
    sigma_px, first = None, next(iter(view.tracks))
    if view.quality is not None:
        sigma_px = np.array([np.nanmedian([side.predicted_sigma_px for side in view.quality]), view.sigma_px])
    shapes, deflection = result.shapes, result.deflection
    if shapes is not None and deflection is not None:
        shapes = shapes.at_points(view.deformed.shapes, deflection.reference_m)
    return replace(
        result,
        shapes=shapes,
        reference_image=view.reference_image,
        subsets_px=first.left.position_px[0],
        speckle_px=float(np.min(first.speckle_px)),
        noise_grey=float(np.mean(first.noise_grey)),
        median_zncc=view.zncc,
        subset_zncc=view.subset_zncc,
        noise=view.noise or (),
        sigma_px=sigma_px,
        prnu=None if view.pattern is None else view.pattern.prnu,
        epipolar=None if view.epipolar is None else replace(view.epipolar, notices=()),
    )


def _step(name: str, time_s: FloatArray, position_m: FloatArray, frequency_hz: FloatArray) -> list[Notice]:
    """Return a notice if the body is displaced from some frame on.

    It was touched, or matched to another part of its pattern. In addition to the lines, a drift and a parabola, a step
    is fitted at each frame in turn. The best one is significant if it exceeds `STEP` standard deviations of the
    residuals. A step larger than the whole motion raises `ComputeError`.
    """
    seen = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    turn = np.linspace(-1.0, 1.0, len(seen))
    design = np.column_stack([sine_columns(time_s[seen], frequency_hz), turn, turn**2])
    fewest = design.shape[1] + MIN_FREE_FRAMES
    if len(seen) < fewest:
        return [Notice(TOO_FEW_FRAMES_FOR_STEP, "frames", frames=len(seen), needed=fewest)]
    base, _ = np.linalg.qr(design)
    split = np.arange(2, len(seen) - 1)  # first frame behind the step; two on either side

    def behind(values: FloatArray) -> FloatArray:  # sums (S, C) over the frames behind each step
        return np.asarray(np.cumsum(values[::-1], axis=0)[::-1][split])

    left = position_m[seen] - base @ (base.T @ position_m[seen])
    along = behind(base)
    size2 = np.maximum(len(seen) - split - np.sum(along**2, axis=1), 1e-9)
    shift = behind(left) / size2[:, None]
    best = int(np.argmax(np.sum(shift**2, axis=1) * size2))
    later = (np.arange(len(seen)) >= split[best]).astype(np.float64)
    rest = left - np.outer(later - base @ along[best], shift[best])
    noise = float(np.sqrt(np.sum(rest**2) / (len(seen) - design.shape[1] - 1)))
    length = float(np.linalg.norm(shift[best]))
    if length * np.sqrt(size2[best]) <= STEP * noise:
        return []
    values = {"distance_mm": 1e3 * length, "before": seen[split[best] - 1], "after": seen[split[best]]}
    if length > float(np.linalg.norm(np.ptp(position_m[seen] - np.outer(later, shift[best]), axis=0))):
        raise ComputeError(BODY_LOST, f"stereo pair {name}", **values)
    return [Notice(BODY_DISPLACED, f"frame {values['after']}", **values)]


def unresolved_fundamentals(
    seen: Sequence[Observation], lines: LineFrequencies, folded: Sequence[Notice]
) -> tuple[Notice, ...]:
    """Return a notice for each driven line without an instrument.

    Raises if no other driven line is left. `folded`: notices of lines that frame rates do not resolve.
    """
    driven = lines.frequency_hz[lines.multiple == 1]
    lost = [f for f in driven if not any(np.isfinite(o.phasors.value[o.phasors.frequency_hz == f]).any() for o in seen)]
    if len(driven) and len(lost) == len(driven) and (seen or folded):
        listed = " and ".join(f"{f:.6g} Hz" for f in lost)
        rounded = {f"{f:.6g}" for f in lost}  # those of several set-ups differ by their clocks
        of_lost = [notice for notice in folded if f"{notice.values.get('frequency_hz', 0.0):.6g}" in rounded]
        reasons = dict.fromkeys(notice.text.rstrip(".") for notice in of_lost)
        raise ComputeError(LINES_UNRESOLVED, frequencies=listed, reasons=f" ({'; '.join(reasons)})" if reasons else "")
    return tuple(Notice(LINE_UNOBSERVED, f"{f:.6g} Hz", frequency_hz=f) for f in lost)
