"""The path on one page: from a recording folder to the complex sensitivity."""

from __future__ import annotations

import time

from fusion.analyse import Inputs, analyse
from fusion.channels import channel_results, find_channel_lines
from fusion.drift import drift_notices, drifts
from fusion.errors import InputError
from fusion.evaluation import Evaluation
from fusion.manifest import Manifest
from fusion.notices import AnyNotice, Notice
from fusion.provenance import versions
from fusion.readings import channel_readings, observations, unseen_fundamentals
from fusion.records import read_daqs
from fusion.settings import ProgressCallback, Settings, no_progress
from fusion.stereo_motion import measure_images, measure_points, motion_lines, open_images
from fusion.stereo_phasors import pairs_phasors
from fusion.timing import TimeBase, tie_daqs

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
    found = analyse(Inputs.of(manifest, lines, seen, readings))
    notices = [*_clock_notices(base), *lines.notices, *folded, *unseen]
    notices += [notice for channel in channels for notice in channel.notices]
    notices += [notice for item in stereo for notice in item.notices]
    notices += drift_notices(drifts(channels, [item.result for item in stereo], lines, base.results()))
    notices += found.notices
    return Evaluation(
        manifest=manifest,
        lines=lines,
        clocks=base.results(),
        channels=channels,
        stereo=tuple(item.result for item in stereo),
        accelerations=found.accelerations,
        load=found.load.phasors if found.load else None,
        sensitivity=found.sensitivity,
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


def _clock_notices(base: TimeBase) -> list[AnyNotice]:
    """Return the remarks of triggers and clock ties, naming their block."""
    found = [(daq, notice) for (daq, _), fit in base.triggers.items() for notice in fit.notices]
    found += [(daq, notice) for daq, tie in base.ties.items() if tie is not None for notice in tie.notices]
    return [Notice(notice.severity, f"{daq}: {notice.text}", daq) for daq, notice in found]
