"""Stereo pairs from pictures of a target (`shakercal cameras`) or from calibrations of other programs.

`shakercal import-calibration` turns those into a calibration file of this one.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from fusion.base import InputError, ProgressCallback, as_input_error, check_new_file, no_progress, versions, write_whole
from fusion.cameras.quantities import axes_angle_rad, baseline_m
from fusion.cameras.report import render_camera_report
from fusion.recording.values import natural_key
from fusion.report.folder import Provenance, hash_files
from fusion.report.table import plain
from photogram.calibration.bundle import ShapeKind
from photogram.calibration.file import write_calibration
from photogram.calibration.foreign import LengthUnit
from photogram.calibration.foreign_formats import import_calibration
from photogram.calibration.result import Calibration, Dropped
from photogram.calibration.session import calibrate_pair
from photogram.calibration.start import FEWEST_VIEWS, Pair
from photogram.images.files import read_picture
from photogram.targets.view import Target, TargetNotFound, TargetView, find_target

log = logging.getLogger("shakercal")
PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")


@dataclass(frozen=True)
class CameraSettings:
    """What a user may choose: the target, how its shape is taken, and the relative uncertainty of its spacing."""

    target: Target
    shape: ShapeKind | Literal["auto"] = "auto"
    scale_u: float = 0.0


def calibrate_cameras(
    left: Sequence[Path], right: Sequence[Path], settings: CameraSettings, progress: ProgressCallback = no_progress
) -> Calibration:
    """Return the calibrated pair from the pictures of both cameras, in one order.

    A picture without a usable target is left out and named among what was dropped, with the reason. Raises
    `InputError` where what remains does not allow a calibration.
    """
    pictures = [*left, *right]
    views: list[TargetView | None] = []
    failed: list[Dropped] = []
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as workers:
        for path, view in zip(pictures, workers.map(partial(_find, settings.target), pictures), strict=True):
            views.append(view if isinstance(view, TargetView) else None)
            if isinstance(view, TargetView) and view.lost:
                failed.append(Dropped(str(path), view.lost, view.lost_why))
            failed += [Dropped(str(path), 0, str(view))] if isinstance(view, TargetNotFound) else []
            progress("find target", len(views), len(pictures))
    pairs: list[Pair] = list(zip(views[: len(left)], views[len(left) :], strict=True))
    for side, paths, seen in zip(("left", "right"), (left, right), zip(*pairs, strict=True), strict=True):
        usable = sum(view is not None for view in seen)
        if usable < FEWEST_VIEWS:
            reasons = "; ".join(f"{Path(item.name).name}: {item.reason}" for item in failed) or "no picture failed"
            found = f"{usable} usable of {len(paths)} {side} pictures ({reasons})"
            raise InputError(_folder(paths), "", found=found, expected=f"at least {FEWEST_VIEWS} of each camera")
    progress("adjust", 0, 1)
    with as_input_error(_folder(pictures)):
        calibration = calibrate_pair(pairs, settings.target, settings.shape, settings.scale_u)
    progress("adjust", 1, 1)
    return replace(calibration, dropped=(*failed, *calibration.dropped))


def split_pictures(arguments: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """Return left and right pictures: of two arguments each a folder, a pattern or a file; of more, half and half."""
    parts = [_expanded(argument) for argument in arguments]
    if len(parts) == 2:
        left, right = parts
    else:
        every = [path for part in parts for path in part]
        left, right = every[: len(every) // 2], every[len(every) // 2 :]
    if len(left) != len(right):
        expected = "as many left pictures as right ones, the left ones first"
        raise InputError(_folder([*left, *right]), "", found=f"{len(left)} and {len(right)}", expected=expected)
    twice = sorted(path for path in set(left) if path in right)
    if twice:
        raise InputError(twice[0], "", found="a picture given for both cameras", expected="one for each")
    return left, right


def print_calibration(calibration: Calibration, output: Path, page: Path) -> None:
    """Print what was found, U at k = 2, and where it lies."""
    pairs = sum(view.left is not None and view.right is not None for view in calibration.views)
    rms = calibration.rms_sides_px
    baseline, angle = baseline_m(calibration.rig), axes_angle_rad(calibration.rig)
    print(f"{pairs} pairs, rms {calibration.rms_px:.3f} px (left {rms[0]:.3f}, right {rms[1]:.3f})")
    print(f"baseline {plain(1e3 * baseline.value, 2e3 * baseline.u)} mm", end=", ")
    print(f"axes at {plain(np.degrees(angle.value), np.degrees(2 * angle.u))} deg (U: k = 2)")
    for item in calibration.parameters:
        if item.name.endswith((".fx", ".fy")):
            print(f"{item.name} {plain(item.value, 2 * item.u)} px")
    for dropped in calibration.dropped:
        what = f"{dropped.points} points left out, " if dropped.points else "left out: "
        print(f"{dropped.name}: {what}{dropped.reason}")
    for notice in calibration.notices:
        print(f"{notice.severity}: {notice.text}")
    print(f"calibration: {output}")
    print(f"report: {page}")


def run_cameras(
    arguments: Sequence[str], settings: CameraSettings, output: Path, force: bool, progress: ProgressCallback
) -> None:
    """Calibrate from the pictures that the arguments name, write calibration and page, print the summary."""
    started, page = time.monotonic(), output.with_suffix(".html")
    if output.suffix != ".json":
        raise InputError(output, "", found=output.suffix or "no suffix", expected="a name that ends in .json")
    for path in (output, page):
        check_new_file(path, force=force)
    left, right = split_pictures(arguments)
    calibration = calibrate_cameras(left, right, settings, progress)
    used: dict[str, str | float | int] = {
        **{name: str(value) for name, value in asdict(settings.target).items() if value is not None},
        "shape": str(settings.shape),
        "scale_uncertainty": settings.scale_u,
    }
    pictures = [*left, *right]
    hashes = hash_files(pictures, _folder(pictures))
    provenance = Provenance(hashes, used, versions(), (output.name, page.name))
    text = render_camera_report(calibration, output.stem, provenance, time.monotonic() - started)
    write_calibration(output, calibration.rig, calibration.rms_px)
    write_whole(page, text)
    print_calibration(calibration, output, page)


def _find(target: Target, path: Path) -> TargetView | TargetNotFound:
    """Return the target in one picture, or why there is none."""
    with as_input_error(path):
        image, full_scale = read_picture(path)
        try:
            return find_target(image, target, str(path), full_scale)
        except TargetNotFound as error:
            return error


def _expanded(argument: str) -> list[Path]:
    """Return the pictures that a path, a folder or a pattern names, in natural order."""
    path = Path(argument)
    if path.is_dir():
        names = [entry for entry in path.iterdir() if entry.suffix.lower() in PICTURE_SUFFIXES]
    elif path.exists() or not any(sign in argument for sign in "*?["):
        return [path]
    else:
        names = [entry for entry in path.parent.glob(path.name) if entry.is_file()]
    if not names:
        raise InputError(path, "", found="no pictures", expected=f"files {', '.join(PICTURE_SUFFIXES)}")
    return sorted(names, key=lambda entry: natural_key(entry.name))


def _folder(pictures: Sequence[Path]) -> Path:
    """Return the folder that all pictures have in common."""
    return Path(os.path.commonpath([path.absolute().parent for path in pictures]))


def convert_calibration(
    source: tuple[Path, Path | None],
    output: Path,
    image_size: tuple[int, int] | None,
    length_unit: LengthUnit | None,
    force: bool = False,
) -> str:
    """Write the calibration of `source` (file, extrinsics apart from it or None) to `output` and return the format.

    What the user should know is logged, also the remarks that are no warnings: they say how the file was understood.
    """
    check_new_file(output, force=force)
    path, extrinsics = source
    try:
        imported = import_calibration(path, image_size, length_unit, extrinsics)
    except OSError as error:
        raise InputError.told_by(error, path) from error
    except ValueError as error:
        told = str(error).replace(": image_size: ", ": --image-size: ").replace(": length_unit: ", ": --length-unit: ")
        raise InputError.told_by(ValueError(told), path) from error
    with as_input_error(output):
        write_calibration(output, imported.rig)
    for notice in imported.notices:
        level = logging.WARNING if notice.severity == "warning" else logging.INFO
        log.log(level, "%s: %s", notice.where, notice.text)
    return imported.format
