"""The command `shakercal align`: where a stereo pair's left camera stands in the sensor frame."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from fusion.align.manifest import AlignmentFile, read_alignment
from fusion.align.recordings import moving_evidence
from fusion.align.stills import Pair, known_pose, read_pair, still_evidence
from fusion.align.text import pose_text
from fusion.errors import ComputeError
from fusion.output import check_new_file, write_whole
from fusion.settings import ProgressCallback, Settings, no_progress
from photogram.alignment import Alignment, align

log = logging.getLogger("shakercal")

__all__ = ["align_cameras", "align_file"]


def align_file(
    path: Path,
    output: Path | None,
    settings: Settings,
    *,
    force: bool = False,
    allow_outside: bool = False,
    progress: ProgressCallback = no_progress,
) -> str:
    """Return the block of rig.toml that alignment.toml leads to, and write it to `output` where one is given."""
    if output is not None:
        check_new_file(output, force=force)
    file = read_alignment(path, allow_outside)
    found, pair = align_cameras(path, file, settings, allow_outside=allow_outside, progress=progress)
    text = pose_text(file, found, pair)
    if output is not None:
        write_whole(output, text)
    return text


def align_cameras(
    path: Path,
    file: AlignmentFile,
    settings: Settings,
    *,
    allow_outside: bool = False,
    progress: ProgressCallback = no_progress,
) -> tuple[Alignment, Pair | None]:
    """Return the pose of the left camera from all evidence that alignment.toml names, and the pair with its errors.

    Remarks go to the log.
    """
    pair = None if file.calibration is None else read_pair(path, file.calibration, file.scale_uncertainty)
    evidence = [] if pair is None else still_evidence(path, file, pair)
    moving = moving_evidence(path, file, pair, settings, progress, allow_outside)
    evidence += moving.evidence
    start = None
    if file.pose is not None:
        known = (np.array(file.pose.rotation), np.array(file.pose.translation), np.array(file.pose.pose_uncertainty))
        evidence.append(known_pose(*known))
    elif not (file.target_view or file.common_view):
        start = moving.stated
    try:
        found = align(evidence, start)
    except ValueError as error:
        raise ComputeError(f"{path}: {error}".replace("start: ", "").replace("evidence: ", "")) from error
    for notice in (*moving.notices, *found.notices):
        log.log(logging.WARNING if notice.severity == "warning" else logging.INFO, "%s", notice.text)
    return found, pair
