"""The path on one page: from a recording folder to the complex sensitivity."""

from __future__ import annotations

import time
from collections.abc import Sequence

from fusion.channels import channel_results, find_channel_lines
from fusion.drift import drift_notices, drifts
from fusion.errors import ComputeError, InputError
from fusion.evaluation import Evaluation
from fusion.fuse import Acceleration, fuse_sources
from fusion.load import LoadResult, load_phasors
from fusion.manifest import Manifest
from fusion.notices import AnyNotice, Notice
from fusion.observe import Observation, Reading
from fusion.provenance import versions
from fusion.readings import channel_readings, gravity, load_body, observations, unseen_fundamentals
from fusion.records import read_daqs
from fusion.sensitivity import Sensitivity, sensitivity_ratio
from fusion.settings import ProgressCallback, Settings, no_progress
from fusion.stereo_motion import measure_images, measure_points, motion_lines, open_images
from fusion.stereo_phasors import pairs_phasors
from fusion.timing import TimeBase, tie_daqs
from shaker.signals.frequencies import Lines

EVALUATED_KINDS = ("sine", "multisine")


def evaluate_recording(
    manifest: Manifest,
    settings: Settings,
    input_hashes: dict[str, str],
    progress: ProgressCallback = no_progress,
) -> Evaluation:
    """Evaluate one sinusoidal recording: files → phasors → acceleration of load and base → load → sensitivity.

    `input_hashes` (file → SHA-256) are carried into the result. Raises `InputError` for what the user can mend in the
    files, `ComputeError` for what these files do not allow.
    """
    started = time.monotonic()
    _check_kind(manifest)
    base = tie_daqs(manifest, read_daqs(manifest))
    opened = [open_images(manifest, base, entry) for entry in manifest.images]
    points = [measure_points(manifest, base, entry) for entry in manifest.points]
    lines = find_channel_lines(manifest, base)
    channels = () if lines is None else channel_results(manifest, base, lines)
    motions = (*(measure_images(manifest, images, settings, progress) for images in opened), *points)
    if lines is None:  # all channels are triggers
        lines = motion_lines(manifest, base, motions)
    stereo, folded = pairs_phasors(motions, lines)
    readings = channel_readings(base, channels)
    seen = observations(manifest, base, readings, stereo, lines)
    unseen = unseen_fundamentals(seen, lines, folded)
    accelerations = _fuse_bodies(seen)
    load = _load(manifest, accelerations)
    sensitivity = _sensitivity(manifest, lines, readings, load)
    notices = [*_clock_notices(base), *lines.notices, *folded, *unseen]
    notices += [notice for channel in channels for notice in channel.notices]
    notices += [notice for item in stereo for notice in item.notices]
    notices += drift_notices(drifts(channels, [item.result for item in stereo], lines, base.results()))
    notices += [notice for a in accelerations if a.source == "fused" for notice in a.notices]
    notices += [notice for result in (load, sensitivity) if result is not None for notice in result.notices]
    return Evaluation(
        manifest=manifest,
        lines=lines,
        clocks=base.results(),
        channels=channels,
        stereo=tuple(item.result for item in stereo),
        accelerations=accelerations,
        load=load.phasors if load else None,
        sensitivity=sensitivity,
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _check_kind(manifest: Manifest) -> None:
    """Refuse recordings that this command does not evaluate."""
    kind = manifest.excitation.kind
    if kind not in EVALUATED_KINDS:
        other = " (shakercal transfer takes this one)" if kind in ("chirp", "noise", "impact") else ""
        expected = f"{' or '.join(EVALUATED_KINDS)}, the kinds that shakercal run evaluates{other}"
        raise InputError(manifest.path, "excitation.kind", found=kind, expected=expected)
    if manifest.take:
        expected = "no [[take]] blocks, since shakercal run evaluates what was recorded at once"
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)}", expected=expected)


def _fuse_bodies(seen: Sequence[Observation]) -> tuple[Acceleration, ...]:
    """Return load and base acceleration, fused and by source; a body that nobody observes is left out."""
    bodies = [body for body in ("load", "base") if any(observation.body == body for observation in seen)]
    if not bodies:
        raise ComputeError("no channel or camera of this recording measures a motion; add one to recording.toml")
    return tuple(acceleration for body in bodies for acceleration in fuse_sources(seen, body))


def _load(manifest: Manifest, accelerations: Sequence[Acceleration]) -> LoadResult | None:
    """Return the load on the sensor, None where the rig states no load mass or nobody observed the load's motion."""
    body = load_body(manifest)
    fused = next((a for a in accelerations if a.body == "load" and a.source == "fused"), None)
    if body is None or fused is None:
        return None
    sensor = manifest.rig.sensor
    return load_phasors(fused, body, gravity(manifest), "on_load" if sensor is None else sensor.sense)


def _sensitivity(
    manifest: Manifest, lines: Lines, readings: Sequence[Reading], load: LoadResult | None
) -> Sensitivity | None:
    """Return output over load of the driven component, None where there are no outputs or there is no load."""
    sensor = manifest.rig.sensor
    outputs = [reading for reading in readings if reading.entry.quantity == "output"]
    if sensor is None or load is None or not outputs:
        return None
    outputs.sort(key=lambda reading: sensor.channels.index(str(reading.entry.channel)))
    direction = manifest.excitation.direction
    if direction is None:
        return None
    return sensitivity_ratio(outputs, load, direction, lines.multiple, sensor.unit, sensor.capacity)


def _clock_notices(base: TimeBase) -> list[AnyNotice]:
    """Return the remarks of triggers and clock ties, naming their block."""
    found = [(daq, notice) for (daq, _), fit in base.triggers.items() for notice in fit.notices]
    found += [(daq, notice) for daq, tie in base.ties.items() if tie is not None for notice in tie.notices]
    return [Notice(notice.severity, f"{daq}: {notice.text}", daq) for daq, notice in found]
