"""The path on one page: from a recording folder to the complex sensitivity."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.channels import channel_results, find_channel_lines
from fusion.errors import ComputeError, InputError
from fusion.evaluation import ChannelResult, Evaluation
from fusion.fuse import Acceleration, fuse
from fusion.manifest import Manifest
from fusion.notices import AnyNotice
from fusion.observe import Observation, observe_channels, observe_stereo
from fusion.provenance import versions
from fusion.records import read_daqs
from fusion.sensitivity import LoadResult, Sensitivity, load_phasors, sensitivity_ratio
from fusion.settings import ProgressCallback, Settings, no_progress
from fusion.stereo_motion import StereoMotion, StereoPhasors, measure_images, measure_points, stereo_phasors
from fusion.timing import TimeBase, tie_daqs
from shaker.signals.frequencies import Lines

EVALUATED_KINDS = ("sine", "multisine")
SOURCES = ("photogrammetry", "vibrometer", "accelerometer")


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
    motions = _measure_motions(manifest, base, settings, progress)
    lines = find_channel_lines(manifest, base) or _motion_lines(manifest, motions)
    channels = channel_results(manifest, base, lines)
    stereo = tuple(stereo_phasors(motion, lines) for motion in motions)
    accelerations = _fuse_bodies(_observe(manifest, channels, stereo))
    load = _load(manifest, accelerations)
    sensitivity = _sensitivity(manifest, lines, channels, load)
    return Evaluation(
        manifest=manifest,
        lines=lines,
        clocks=base.results(),
        channels=channels,
        stereo=tuple(item.result for item in stereo),
        accelerations=accelerations,
        load=load.phasors if load else None,
        sensitivity=sensitivity,
        notices=_notices(base, lines, stereo, accelerations, load, sensitivity),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )
