"""Checks of channels, triggers and a few images, alone and against the manifest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.phasors.channel_phasors import describe_folds, folding
from fusion.planning.look.finding import Finding, Verdict
from fusion.planning.look.look_notices import (
    ALIASED_HARMONIC,
    ALIASED_LINES,
    CALIBRATION_CONTRADICTED,
    CAMERA_OUT_OF_FOCUS,
    CAMERAS_EXCHANGED,
    DARK_FRAMES,
    DARK_IMAGES,
    DRIVEN_LINE_MISSING,
    EPIPOLAR_OFFSET,
    FEW_COMMON_FEATURES,
    IRREGULAR_EDGES,
    LOOK_CONSTANT_CHANNEL,
    LOOK_TRIGGER_JITTER,
    LOW_CONTRAST,
    MAINS_PICKUP,
    NO_PERIODIC_TRIGGER,
    NO_SPECKLE,
    OTHER_LINE_DRIVEN,
    OVEREXPOSED,
    PATTERN_COST,
    REPEATING_PATTERN,
    SIGNAL_DEFECT,
    SIGNAL_DRIFT,
    SPECKLE_SIZE,
)
from fusion.planning.look.problem_pictures import mark_image, mark_signal
from fusion.recording.daq_records import DaqRecord
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Daq
from fusion.recording.placement import main_direction
from fusion.recording.transducer import TRANSDUCERS
from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.images.sensor_pattern import SensorPattern
from photogram.images.sequence import GreyImage, ImageSequence, clip_level, missing_pattern_reason
from photogram.subsets.search import match_features
from photogram.subsets.texture import (
    place_subsets,
    radius_from_speckle_px,
    repeat_distance_px,
    speckle_size,
    textured_area,
)
from shaker.io.channel import RawChannel
from shaker.io.condition import FEWEST_STEPS, Defect, converter_step
from shaker.lines.detection import Survey, survey_lines
from shaker.sine.aliasing import alias_frequency, nearest_clear_rate, separation_bins
from shaker.timebase.trigger import TriggerFit
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

LOOKED_AT = 1 << 16  # samples in which lines are searched for
FEWEST = 64  # least number of samples for a search of lines
DRIFTS, MAINS = 0.2, 0.05  # limits relative to the amplitude of the driven line
DRIVEN_SHARE = 0.7  # cosine between driven direction and channel from which the line must be visible
CLOSE_BINS, LOST_BINS = 1.0, 0.5  # distance of lines that disturb each other; that cannot be resolved


@dataclass(frozen=True)
class LineStrength:
    """A driven line in a channel: amplitude in SI and relative u by noise."""

    entry: ChannelEntry
    frequency_hz: float
    amplitude: float
    u_relative: float


def examine_channels(manifest: Manifest, record: DaqRecord) -> tuple[list[Finding], list[LineStrength]]:
    """Return the findings of a recorder's channels, and the amplitudes of the driven lines."""
    daq, raw = record.entry, record.raw
    found: list[Finding] = []
    strengths: list[LineStrength] = []
    groups: dict[tuple[float, int], list[ChannelEntry]] = {}
    for entry in daq.channel:
        channel = raw[entry.name]
        where = f"{daq.name}.{entry.name}"
        if not np.isfinite(channel.samples).any():
            found.append(Finding("REPEAT", Notice(SIGNAL_DEFECT, where, defect="no sample is a finite number")))
        elif np.ptp(channel.samples[np.isfinite(channel.samples)]) == 0.0:
            constant = Notice(LOOK_CONSTANT_CHANNEL, where, value=float(channel.samples[0]), unit=channel.unit)
            found.append(Finding("REPEAT", constant))
        elif entry.quantity != "trigger":
            defects = record.defects(entry)
            for defect in defects:
                text = defect.text(record.time_s(entry.name), channel.unit)
                found.append(Finding("REPEAT", Notice(SIGNAL_DEFECT, where, defect=text), mark_signal(channel, defect)))
            # Only the evaluation finds lines at stamped times, and in a record with gaps.
            if channel.stamp_s is None and not defects and np.isfinite(channel.samples).all():
                groups.setdefault((channel.sample_rate_hz, len(channel.samples)), []).append(entry)
    for (rate_hz, samples), entries in groups.items():
        if samples < FEWEST:
            found.append(Finding("REPEAT", Notice(SIGNAL_DEFECT, daq.name, defect=f"only {samples} samples")))
            continue
        folds = folding(manifest.excitation.frequencies or (), rate_hz, samples)
        if folds and not all(entry.response for entry in entries):
            notice = Notice(ALIASED_HARMONIC, daq.name, lines=describe_folds(folds), rate_hz=rate_hz)
            found.append(Finding("CHECK", notice))
        for finding, strength in _lines(manifest, daq, entries, raw):
            found += finding
            strengths += strength
    return found, strengths


def _lines(
    manifest: Manifest, daq: Daq, entries: Sequence[ChannelEntry], raw: Mapping[str, RawChannel]
) -> Iterator[tuple[list[Finding], list[LineStrength]]]:
    """Yield findings and driven lines of channels with equal sampling, channel by channel."""
    nominal = manifest.excitation.frequencies or ()
    rate_hz, samples = raw[entries[0].name].sample_rate_hz, len(raw[entries[0].name].samples)
    values = np.stack([raw[entry.name].samples[:LOOKED_AT] for entry in entries], axis=1)
    length = len(values)
    survey = survey_lines(values - values.mean(axis=0), rate_hz, [f for f in nominal if f < rate_hz / 2])
    alias = alias_frequency(np.array(nominal), rate_hz) if nominal else np.empty(0)
    near = [int(np.argmin(np.abs(survey.frequency_hz - a))) if len(survey.frequency_hz) else -1 for a in alias]
    bins = rate_hz / length
    near = [
        i if i >= 0 and abs(survey.frequency_hz[i] - a) < 1e-2 * a + 3 * bins else -1
        for i, a in zip(near, alias, strict=True)
    ]
    for c, entry in enumerate(entries):
        where, found, strengths = f"{daq.name}.{entry.name}", list[Finding](), list[LineStrength]()
        for frequency, i in zip(nominal, near, strict=True):
            amplitude = float(survey.amplitude[i, c]) if i >= 0 else np.nan
            if np.isfinite(amplitude):
                u = float(survey.u_amplitude[i, c]) / amplitude * np.sqrt(length / samples)
                strengths.append(LineStrength(entry, frequency, abs(entry.scale) * amplitude, u))
            elif _must_see(manifest, entry):
                found.append(_missing_line(where, frequency, survey, c))
        strongest = max((s.amplitude / abs(entry.scale) for s in strengths), default=0.0)
        if strongest > 0.0:
            found += _drift_and_steps(where, raw[entry.name], strongest, driven=_must_see(manifest, entry))
            mains = [
                (float(survey.amplitude[i, c]), survey.frequency_hz[i], origin)
                for i, origin in enumerate(survey.origin)
                if origin.kind == "mains" and np.isfinite(survey.amplitude[i, c])
            ]
            if mains and max(mains)[0] > MAINS * strongest:
                share_percent = 100 * max(mains)[0] / strongest
                notice = Notice(MAINS_PICKUP, where, frequency_hz=max(mains)[1], share_percent=share_percent)
                found.append(Finding("CHECK", notice))
        yield found, strengths


def _missing_line(where: str, frequency_hz: float, survey: Survey, c: int) -> Finding:
    """Return a missing driven line, with the line in its place.

    Another line in its place is a mistake of the manifest.
    """
    driven = [
        (float(survey.amplitude[i, c]), float(survey.frequency_hz[i]))
        for i, origin in enumerate(survey.origin)
        if origin.kind != "mains" and np.isfinite(survey.amplitude[i, c])
    ]
    if not driven:
        return Finding("REPEAT", Notice(DRIVEN_LINE_MISSING, where, frequency_hz=frequency_hz))
    notice = Notice(OTHER_LINE_DRIVEN, where, frequency_hz=frequency_hz, found_hz=max(driven)[1])
    return Finding("FIX MANIFEST", notice)


def _drift_and_steps(where: str, channel: RawChannel, amplitude: float, *, driven: bool) -> Iterator[Finding]:
    """Yield drift, and a signal of few converter steps."""
    tenth = max(len(channel.samples) // 10, 1)
    drift = abs(float(np.mean(channel.samples[-tenth:]) - np.mean(channel.samples[:tenth])))
    if drift > DRIFTS * amplitude:
        sizes = {"drift": drift, "share_percent": 100 * drift / amplitude}
        yield Finding("CHECK", Notice(SIGNAL_DRIFT, where, unit=channel.unit, **sizes), mark_signal(channel))
    step = converter_step(channel.samples) if driven else 0.0
    if step > 0.0 and amplitude < FEWEST_STEPS * step:
        coarse = Defect("steps", np.zeros((0, 2), dtype=np.int64), (), step, amplitude / step)
        yield Finding("CHECK", Notice(SIGNAL_DEFECT, where, defect=coarse.text(channel.time_s, channel.unit)))


def _must_see(manifest: Manifest, entry: ChannelEntry) -> bool:
    """Return whether a channel measures the driven direction."""
    driven = np.asarray(manifest.excitation.direction or ())
    if len(driven) != 3:
        return False
    if entry.quantity == "output":
        names = ("Fx", "Fy", "Fz")
        return entry.channel in names and abs(float(driven[names.index(entry.channel)])) > DRIVEN_SHARE
    aimed = entry.quantity in TRANSDUCERS and not TRANSDUCERS[entry.quantity].rotational
    return aimed and abs(float(np.asarray(main_direction(entry)) @ driven)) > DRIVEN_SHARE


# Triggers, and aliases of the driven lines.


def fit_trigger_channel(record: DaqRecord, entry: ChannelEntry) -> TriggerFit | str:
    """Return the periodic model of a trigger channel, or the reason without one."""
    try:
        return record.fit_trigger(entry)
    except ValueError as error:
        return str(error).partition(": ")[2] or str(error)


def examine_trigger(where: str, fit: TriggerFit | str) -> Iterator[Finding]:
    """Yield the errors of a trigger's edges."""
    if isinstance(fit, str):
        yield Finding("REPEAT", Notice(NO_PERIODIC_TRIGGER, where, reason=fit))
        return
    if fit.missing:
        numbers = ", ".join(map(str, fit.missing[:5])) + (" …" if len(fit.missing) > 5 else "")
        lost = Notice(IRREGULAR_EDGES, where, count=len(fit.missing), edges=fit.edges, kind=f"lost (number {numbers})")
        yield Finding("REPEAT", lost)
    if fit.doubled or fit.spurious:
        count, kind = fit.doubled + fit.spurious, "doubled or stray"
        yield Finding("CHECK", Notice(IRREGULAR_EDGES, where, count=count, edges=fit.edges, kind=kind))
    if fit.jitter_detected:
        yield Finding("CHECK", Notice(LOOK_TRIGGER_JITTER, where, jitter_us=1e6 * fit.jitter_s))


def examine_beat(where: str, frequencies_hz: Sequence[float], fit: TriggerFit, frames: int) -> Iterator[Finding]:
    """Yield driven lines that the camera rate aliases onto each other or onto zero."""
    rate_hz = 1.0 / fit.period_s
    lines = np.array(sorted(frequencies_hz), dtype=np.float64)
    bins = separation_bins(lines, rate_hz, frames) if len(lines) else np.inf
    if bins < CLOSE_BINS:
        clear = nearest_clear_rate(lines, rate_hz, frames)
        advice = f", such as {number_text(clear, 6)} frames/s" if clear is not None else ""
        aliases = zip(lines, alias_frequency(lines, rate_hz), strict=True)
        driven = (
            "driven lines (" + ", ".join(f"{number_text(f, 6)} Hz at {number_text(a)} Hz" for f, a in aliases) + ")"
        )
        notice = Notice(ALIASED_LINES, where, lines=driven, advice=advice, rate_hz=rate_hz, distance_bins=bins)
        yield Finding("REPEAT" if bins < LOST_BINS else "CHECK", notice)
    elif 0 < len(lines) <= 5:
        harmonics: FloatArray = np.outer(lines, (1.0, 2.0, 3.0)).ravel()
        bins = separation_bins(harmonics, rate_hz, frames)
        if bins < CLOSE_BINS:
            text = "driven lines and their harmonics up to the third"
            notice = Notice(ALIASED_LINES, where, lines=text, advice="", rate_hz=rate_hz, distance_bins=bins)
            yield Finding("CHECK", notice)


FRAMES = 8  # of each camera
EVERY = 4  # pixel in a direction, of frames beyond the first
LEVELS = 200  # grey values of a dark image with a pattern: the stated bit depth may be too large
DARK, BLACK = 0.1, 0.3  # brightest pixel over full scale; brightness over that of the first frame
SATURATED, MUCH_SATURATED = 0.002, 0.02  # share of the body's pixels
MIN_CONTRAST = 0.03  # standard deviation over full scale
FINE_PX, COARSE_PX, MAX_SPECKLE_RATIO = (
    2.5,
    7.5,
    1.5,
)  # limits of the speckle size (iDICs: 3 to 5 px); of its ratio between two cameras
SMALL_AREA = 0.02  # share of the image
LARGEST_PX = 400  # side of the images in which features are matched
FEATURES = 2000  # of each image
INLIER_PX, OFF_PX, FAR_OFF_PX = 3.0, 0.3, 1.0  # epipolar distance of a match; median for a warning; for an error
FEWEST_MATCHES, FEWEST_ON_LINES = 20, 0.2  # matches for a check; least share of them on their epipolar lines
NOTABLE_PATTERN = 5e-4  # relative shortening of small motions by a usual fixed pattern
DARK_CODES = (DARK_IMAGES.code, DARK_FRAMES.code)


@dataclass(frozen=True)
class CameraExamination:
    """First frame of a camera: textured area, speckle size, subsets, noise of their positions."""

    image: GreyImage
    area: BoolArray
    speckle_px: float
    points_px: FloatArray
    radius_px: int
    sigma_px: float


def examine_camera(where: str, images: ImageSequence) -> tuple[list[Finding], CameraExamination | None]:
    """Return the findings of some frames of a camera, and its examination.

    The latter is None if the first frame is unusable.
    """
    chosen = sorted({round(i * (len(images) - 1) / (FRAMES - 1)) for i in range(FRAMES)})
    first = images.read(chosen[0])
    others = {i: images.read(i)[::EVERY, ::EVERY] for i in chosen[1:]}
    found = [Finding("CHECK", notice.at(where)) for notice in images.notices if notice.severity == "warning"]
    blank = missing_pattern_reason(first, images.full_scale)
    if blank:
        return [
            *found,
            Finding("REPEAT", Notice(NO_SPECKLE, where, reason=blank), mark_image(first, "first frame")),
        ], None
    found += _brightness(where, first, others, images.full_scale)
    area = textured_area(first)
    if any(finding.verdict == "REPEAT" and finding.code in DARK_CODES for finding in found):
        return found, None
    inside = first[area]
    if area.mean() < SMALL_AREA or len(inside) < 1000:
        reason = (
            f"only {np.count_nonzero(area)} pixels, {number_text(100 * area.mean(), 2)} % of the image, have texture"
        )
        picture = mark_image(first, "first frame, outlined: texture", area)
        found.append(Finding("REPEAT", Notice(NO_SPECKLE, where, reason=reason), picture))
        return found, None
    clipped = clip_level(first)
    limit = images.full_scale if clipped is None else clipped
    full = float(np.mean(inside >= limit))
    if full > SATURATED:
        verdict: Verdict = "REPEAT" if full > MUCH_SATURATED else "CHECK"
        levels = {"level": limit, "full_scale": images.full_scale}
        picture = mark_image(first, "first frame, red: saturated pixels", area & (first >= limit), filled=True)
        found.append(Finding(verdict, Notice(OVEREXPOSED, where, share_percent=100 * full, **levels), picture))
    if float(inside.std()) < MIN_CONTRAST * images.full_scale:
        share = 100 * float(inside.std()) / images.full_scale
        picture = mark_image(first, "first frame as recorded, outlined: low contrast", area, full=images.full_scale)
        found.append(Finding("CHECK", Notice(LOW_CONTRAST, where, share_percent=share), picture))
    speckle = speckle_size(first, area)
    if not FINE_PX <= speckle <= COARSE_PX:
        picture = mark_image(first, "first frame, outlined: this speckle", area)
        found.append(Finding("CHECK", Notice(SPECKLE_SIZE, where, size_px=speckle), picture))
    radius = radius_from_speckle_px(speckle)
    points = place_subsets(area, radius, 2 * radius + 1)
    return found, CameraExamination(first, area, speckle, points, radius, _sigma_px(first, area, radius))


def _brightness(where: str, first: GreyImage, others: dict[int, GreyImage], full_scale: int) -> Iterator[Finding]:
    """Yield dark frames."""
    if float(first.max()) < DARK * full_scale:
        verdict: Verdict = "REPEAT" if first.max() < LEVELS else "CHECK"
        picture = mark_image(first, "first frame as recorded", full=full_scale)
        yield Finding(verdict, Notice(DARK_IMAGES, where, brightest=int(first.max()), full_scale=full_scale), picture)
        return
    level = float(np.mean(first[::EVERY, ::EVERY]))
    black = [i for i, image in others.items() if float(np.mean(image)) < BLACK * level]
    if black:
        counts = {"dark": len(black), "examined": len(others) + 1, "example": black[0]}
        picture = mark_image(others[black[0]], f"frame {black[0]} as recorded", full=full_scale)
        yield Finding("REPEAT", Notice(DARK_FRAMES, where, **counts), picture)


def _noise_grey(image: GreyImage) -> float:
    """Return the standard deviation of the noise of an image (H, W), from second differences.

    By Immerkær's operator, which suppresses planes (Computer Vision and Image Understanding 64 (1996)
    300), in the tenth of the image with the smallest values.
    """
    grey = image.astype(np.float64)
    rough = np.abs(
        grey[:-2, :-2] + grey[2:, 2:] + grey[:-2, 2:] + grey[2:, :-2]
        - 2 * (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]) + 4 * grey[1:-1, 1:-1]
    )  # fmt: skip
    tiles = rough[: rough.shape[0] // 16 * 16, : rough.shape[1] // 16 * 16]
    means = tiles.reshape(tiles.shape[0] // 16, 16, -1, 16).mean(axis=(1, 3))
    return float(np.sqrt(np.pi / 2) / 6 * np.quantile(means, 0.1))


def _sigma_px(image: GreyImage, area: BoolArray, radius_px: int) -> float:
    """Return the position noise of a subset in px: √2·σ/√Σf_x²."""
    slope = np.gradient(image.astype(np.float64), axis=1)
    energy = float(np.mean(slope[area] ** 2)) * (2 * radius_px + 1) ** 2
    return float(np.sqrt(2.0) * _noise_grey(image) / np.sqrt(max(energy, 1e-300)))


def pattern_cost(
    where: str, seen: Sequence[CameraExamination], patterns: Sequence[SensorPattern], full_scale: int
) -> Iterator[Finding]:
    """Yield by how much the sensors' fixed pattern may shorten small motions.

    The share γ·v/mean(f_x²) of the pattern's slopes in those of the image, with the pattern's variance v.
    """
    from photogram.bspline import grey_gradients, slope_noise_gain, spline_of_image

    costs = []
    for one, pattern in zip(seen, patterns, strict=True):
        inside = one.image[one.area].astype(np.float64)
        slopes = [part[one.area] for part in grey_gradients(spline_of_image(one.image))]
        fixed = slope_noise_gain() * float(np.mean(pattern.variance(inside**2, full_scale)))
        texture = float(np.mean(np.square(slopes))) - slope_noise_gain() * _noise_grey(one.image) ** 2
        low, high = np.quantile(inside, (0.05, 0.95))
        costs.append((fixed / max(texture, fixed), float((high - low) / (high + low)), pattern.prnu))
    shortening, contrast, prnu = max(costs)
    if shortening > NOTABLE_PATTERN:
        values = {"contrast": contrast, "prnu_percent": 100.0 * prnu, "shortening_percent": 100.0 * shortening}
        yield Finding("KEEP", Notice(PATTERN_COST, where, **values))


@dataclass(frozen=True)
class PairPrecision:
    """Precision of a pair: covariance (3, 3) in m² of the body's mean displacement.

    It is that between two frames, in the camera frame.
    """

    covariance_m2: FloatArray


def examine_pair(
    where: str, rig: StereoRig, left: CameraExamination, right: CameraExamination
) -> tuple[list[Finding], PairPrecision | None]:
    """Return the findings of a pair's first frames: epipolar residuals and repetition."""
    found = []
    if max(left.speckle_px, right.speckle_px) > MAX_SPECKLE_RATIO * min(left.speckle_px, right.speckle_px):
        side = "left" if left.speckle_px > right.speckle_px else "right"
        sizes = {"left_px": left.speckle_px, "right_px": right.speckle_px}
        blurred = left if side == "left" else right
        picture = mark_image(blurred.image, f"first frame of the {side} camera, outlined: coarse speckle", blurred.area)
        found.append(Finding("CHECK", Notice(CAMERA_OUT_OF_FOCUS, where, side=side, **sizes), picture))
    period = repeat_distance_px(left.image, left.points_px, left.radius_px)
    if np.isfinite(period):
        picture = mark_image(left.image, "first frame of the left camera, outlined: repeating foil", left.area)
        found.append(Finding("CHECK", Notice(REPEATING_PATTERN, where, period_px=period), picture))
    matches = _matches(left.image, right.image)
    if len(matches[0]) < FEWEST_MATCHES:
        found.append(Finding("CHECK", Notice(FEW_COMMON_FEATURES, where, count=len(matches[0]))))
        return found, None
    straight, swapped = (np.abs(epipolar_residual(rig, *order)[0]) for order in (matches, matches[::-1]))
    share, other = (float(np.mean(residual < INLIER_PX)) for residual in (straight, swapped))
    if other > 0.5 and np.median(swapped) < np.median(straight) / 3.0:
        found.append(Finding("FIX MANIFEST", Notice(CAMERAS_EXCHANGED, where)))
        return found, None
    if share < FEWEST_ON_LINES:
        notice = Notice(CALIBRATION_CONTRADICTED, where, share_percent=100 * share, count=len(matches[0]))
        found.append(Finding("FIX MANIFEST", notice))
        return found, None
    near = straight < INLIER_PX
    off = float(np.median(straight[near]))
    if off > OFF_PX:
        verdict: Verdict = "FIX MANIFEST" if off > FAR_OFF_PX else "CHECK"
        found.append(Finding(verdict, Notice(EPIPOLAR_OFFSET, where, offset_px=off)))
    sigma = [np.eye(2) * camera.sigma_px**2 for camera in (left, right)]
    points = triangulate(rig, matches[0][None, near], matches[1][None, near], *sigma)
    finite = np.isfinite(points.covariance_m2[0]).all(axis=(1, 2))
    if not finite.any() or not len(left.points_px):
        return found, None
    # Every displacement has the noise of two frames.
    return found, PairPrecision(2.0 * np.median(points.covariance_m2[0][finite], axis=0) / len(left.points_px))


def _matches(left: GreyImage, right: GreyImage) -> tuple[FloatArray, FloatArray]:
    """Return features (M, 2) in both images; large images are reduced first."""
    import cv2

    factor = max(1.0, max(left.shape) / LARGEST_PX)
    seen: list[NDArray[Any]] = [left, right]
    if factor > 1.0:
        size = (round(left.shape[1] / factor), round(left.shape[0] / factor))
        seen = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in seen]
    first, second = match_features(seen[0], seen[1], FEATURES)
    return (first + 0.5) * factor - 0.5, (second + 0.5) * factor - 0.5
