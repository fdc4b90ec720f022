"""The pose that was found, as a block of rig.toml."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from fusion.align.manifest import AlignmentFile
from fusion.align.stills import Pair
from photogram.alignment import Alignment, by_parameters, calibration_steps
from shaker._checks import FloatArray

COVERAGE = 2.0
EVIDENCE = (
    ("point", "point", "points"),
    ("face", "face", "faces"),
    ("target_view", "target view", "target views"),
    ("common_view", "common view", "common views"),
    ("motion", "direction of motion", "directions of motion"),
    ("axis", "rotation axis", "rotation axes"),
)


def pose_text(file: AlignmentFile, found: Alignment, pair: Pair | None) -> str:
    """Return the block in the syntax of rig.toml, with comments on its uncertainty and its origin.

    How the pose answers the pair's calibration is written beside `pose_uncertainty`, which contains it, so that a run,
    in which the same calibration's errors act again, can count them once.
    """
    relative = file.other is not None and file.other.rotation is None
    frame = f"the left camera of {file.other.stereo}" if relative and file.other else "the sensor frame"
    share = None if relative or pair is None else _calibration_share(found, pair)
    u = found.u if share is None else share.u
    held = COVERAGE * np.sqrt(np.diagonal(found.held_covariance))
    comments = [
        f"Pose of the left camera of {file.stereo} in {frame}, from {_origin(file)}.",
        f"U (k = 2): position {_numbers(1e3 * COVERAGE * u[:3])} mm, rotation "
        f"{_numbers(1e3 * COVERAGE * u[3:])} mrad (x, y, z).",
        f"Without the calibration's share: {_numbers(1e3 * held[:3])} mm and {_numbers(1e3 * held[3:])} mrad.",
        f"chi2 = {found.chi2:.3g} with {found.dof} degrees of freedom.",
    ]
    if found.enlargement > 1.0:
        comments.append(f"The evidence does not fit together: U is enlarged by {found.enlargement:.3g}.")
    pose = found.sensor_from_camera
    rows = ",\n  ".join(_list(row) for row in pose.rotation)
    name = file.stereo if file.stereo.replace("_", "").replace("-", "").isalnum() else json.dumps(file.stereo)
    header = f"[relative.{name}]" if relative else f"[stereo.{name}]"
    lines = [*(f"# {comment}" for comment in comments), header, f"rotation = [\n  {rows}]"]
    lines.append(f"translation = {_list(pose.translation_m)}")
    lines.append(f"pose_uncertainty = {_list(u)}")
    if share is not None:
        rows = ",\n  ".join(_list(row) for row in share.by_parameters)
        lines.append(f"pose_by_calibration = [\n  {rows}]")
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, eq=False)
class _Share:
    """How a pose answers the calibration's parameters (6, 24), and its standard uncertainties (6,), all told."""

    by_parameters: FloatArray
    u: FloatArray


def _calibration_share(found: Alignment, pair: Pair) -> _Share | None:
    """Return the calibration's share, None without a covariance.

    The calibration counts as it is stated, also where this evidence would know it better, since a run does the same.
    """
    covered = 0 if pair.rig.covariance is None else len(calibration_steps(pair.rig))
    if not covered:
        return None
    u = np.sqrt(np.diagonal(found.held_covariance) + (found.by_calibration**2).sum(axis=1))
    return _Share(by_parameters(found.by_calibration[:, :covered], pair.steps[:covered]), u)


def _origin(file: AlignmentFile) -> str:
    """Say what evidence the pose comes from."""
    parts = []
    for key, one, many in EVIDENCE:
        count = len(getattr(file, key))
        if count:
            parts.append(f"{count} {one if count == 1 else many}")
    if file.pose is not None:
        parts.append("the pose known before")
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _numbers(values: FloatArray) -> str:
    """Three values with two digits."""
    return " ".join(f"{value:.2g}" for value in values)


def _list(values: FloatArray) -> str:
    """A row of TOML with all digits."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"
