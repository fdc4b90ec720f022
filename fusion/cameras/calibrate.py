"""Calibration from images of a target (`shakercal cameras`), import and export.

`shakercal import-calibration` converts calibrations of other programs into this program's file, `export-calibration`
the reverse.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fusion.base import ProgressCallback, check_new_file, natural_key, no_progress, versions
from fusion.cameras.camera_notices import IMAGE_LISTS, OUTPUT_SUFFIX, TOO_FEW_IMAGES
from fusion.cameras.camera_quantities import axes_angle_rad, baseline_m
from fusion.cameras.camera_report import render_camera_report
from fusion.errors import InputError, as_input_error
from fusion.report.atomic_files import report_write_errors, write_atomically
from fusion.report.folder import Provenance, hash_files
from fusion.report.terminal import print_text
from photogram.calibration.bundle import ShapeKind
from photogram.calibration.calibration_file import read_calibration, write_calibration, write_camera
from photogram.calibration.calibration_result import Calibration, KnownLength, Rejection, scale_to_length
from photogram.calibration.exchange.exchange_files import export_calibration, import_calibration
from photogram.calibration.initial_bundle import FEWEST_VIEWS, LensKind, ViewPair, number_partial, whole_views
from photogram.calibration.session import calibrate_pair
from photogram.images.image_files import read_image
from photogram.images.sequence import GreyImage
from photogram.images.tiff import read_orientations, tag_notices
from photogram.targets.charuco import dictionary_of, marker_count
from photogram.targets.find_target import find_target
from photogram.targets.target_view import Target, TargetNotFound, TargetView
from shakercal._common.digits import number_text, quantity_text
from shakercal._common.notices import Notice

log = logging.getLogger("shakercal")
IMAGE_FILE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a calibration: target, geometry and lens model, scale.

    `scale_u` is the relative standard uncertainty of the spacing, `known_length` an independently measured length.
    `boards`: numbers of the first markers of several boards like the target, empty for one board.
    """

    target: Target
    shape: ShapeKind | Literal["auto"] = "auto"
    scale_u: float = 0.0
    lens: LensKind | Literal["auto"] = "auto"
    known_length: KnownLength | None = None
    boards: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Refuse boards that share markers, and common deviations of their points."""
        if len(self.boards) > 1 and self.shape not in ("auto", "flat"):
            expected = "flat for several boards, whose points deviate each in its own way"
            raise ValueError(f"shape: expected {expected}, found {self.shape}")
        marked = sorted(self.targets, key=lambda target: target.first_id or 0)
        for one, other in itertools.pairwise(marked):
            last = (one.first_id or 0) + marker_count(one) - 1
            if (other.first_id or 0) <= last:
                found = f"{other.first_id}, of a board that ends with {last}"
                raise ValueError(f"first_id: expected numbers of boards without common markers, found {found}")

    @property
    def targets(self) -> tuple[Target, ...]:
        """The target of each board."""
        return tuple(replace(self.target, first_id=board) for board in self.boards) or (self.target,)


def calibrate_cameras(
    left: Sequence[Path],
    right: Sequence[Path] | None,
    settings: CameraSettings,
    progress: ProgressCallback = no_progress,
) -> Calibration:
    """Return the calibrated pair from the images of both cameras, in the same order.

    With `right` None the result is a single camera. Images that cannot be read or have no usable target are rejected
    with the reason. Raises `InputError` if the remaining ones do not determine a calibration.
    """
    images = [*left, *(right or [])]
    views: list[list[TargetView | None]] = []
    failed: list[Rejection] = []
    find = partial(_find, [_alternatives(target, images[0]) for target in settings.targets])
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as workers:
        for path, outcomes in zip(images, workers.map(find, images), strict=True):
            views.append([view if isinstance(view, TargetView) else None for view in outcomes])
            seen = [view for view in views[-1] if view is not None]
            failed += [
                Rejection(view.name, view.lost, view.loss_reasons) for view in seen if view.lost and not view.is_partial
            ]
            failed += [] if seen else [Rejection(str(path), 0, "; ".join(dict.fromkeys(map(str, outcomes))))]
            progress("find target", len(views), len(images))
    pairs: list[ViewPair] = [(view, None) for seen in views for view in seen]
    if right is not None:
        both = zip(views[: len(left)], views[len(left) :], strict=True)
        pairs = [pair for seen in both for pair in zip(*seen, strict=True)]
    whole = [whole_views(pair) for pair in pairs]
    parts = [view for pair in pairs for view in pair if view is not None and view.is_partial]
    unnumbered = [Rejection(view.name, 0, view.loss_reasons) for view in parts]
    sides = [("left ", left)] + ([("right ", right)] if right is not None else [])
    for (side, paths), column in zip(sides, zip(*whole, strict=True), strict=False):
        usable = sum(view is not None for view in column)
        if usable < FEWEST_VIEWS:
            reasons = (
                "; ".join(f"{Path(item.name).name}: {item.reason}" for item in (*failed, *unnumbered))
                or "no image failed"
            )
            found = f"{usable} usable of {len(paths)} {side if right is not None else ''}images ({reasons})"
            expected = f"at least {FEWEST_VIEWS} of each camera"
            raise InputError(TOO_FEW_IMAGES, _folder(paths), found=found, expected=expected)
    progress("adjust", 0, 1)
    shape = "flat" if len(settings.boards) > 1 and settings.shape == "auto" else settings.shape
    with as_input_error(_folder(images)):
        calibrate = partial(
            calibrate_pair, target=settings.target, shape=shape, scale_u=settings.scale_u, lens=settings.lens
        )
        calibration = calibrate(whole)
        if parts:
            numbered = [number_partial(calibration.rig, settings.target, *pair) for pair in pairs]
            names = {view.name for pair in numbered for view in pair if view is not None}
            failed += [rejection for rejection in unnumbered if rejection.name not in names]
            calibration = calibrate(numbered) if any(view.name in names for view in parts) else calibration
    if settings.known_length is not None:
        with as_input_error(_folder(images), "--known-length"):
            calibration = scale_to_length(calibration, settings.known_length)
    progress("adjust", 1, 1)
    notices = (*tag_notices(read_orientations(images)), *calibration.notices)
    return replace(calibration, rejections=(*failed, *calibration.rejections), notices=notices)


def split_images(arguments: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """Return left and right images of the arguments.

    Each of two arguments is a folder, a pattern or a file; more are split into halves.
    """
    parts = [_expanded(argument) for argument in arguments]
    if len(parts) == 2:
        left, right = parts
    else:
        every = [path for part in parts for path in part]
        left, right = every[: len(every) // 2], every[len(every) // 2 :]
    if len(left) != len(right):
        found, expected = f"{len(left)} and {len(right)}", "equal numbers of left and right images"
        raise InputError(IMAGE_LISTS, _folder([*left, *right]), found=found, expected=expected)
    twice = sorted(path for path in set(left) if path in right)
    if twice:
        raise InputError(IMAGE_LISTS, twice[0], found="one image for both", expected="one image for each camera")
    return left, right


def print_calibration(calibration: Calibration, output: Path, page: Path) -> None:
    """Print the results with U (k = 2) and the output files."""
    pairs = sum(view.left is not None and view.right is not None for view in calibration.views)
    rms = calibration.rms_sides_px
    baseline, angle = baseline_m(calibration.rig), axes_angle_rad(calibration.rig)
    distances = [float(np.linalg.norm(view.left_from_target.translation_m)) for view in calibration.views]
    print(_of_poses(calibration, pairs, "pairs"), end=", ")
    print(f"rms {calibration.rms_px:.3f} px (left {rms[0]:.3f}, right {rms[1]:.3f})")
    print(f"target {number_text(min(distances))} to {number_text(max(distances))} m from the left camera")
    print(f"baseline {quantity_text(1e3 * baseline.value, 2e3 * baseline.u, 'mm')}", end=", ")
    print(f"axes at {quantity_text(np.degrees(angle.value), np.degrees(2 * angle.u), '°')} (U: k = 2)")
    for item in calibration.parameters:
        if item.name.endswith((".fx", ".fy")):
            print(f"{item.name} {quantity_text(item.value, 2 * item.u, 'px')}")
    _print_remarks(calibration)
    print(f"calibration: {output}")
    print(f"report: {page}")


def _of_poses(calibration: Calibration, count: int, kind: str) -> str:
    """Return the number of views, with that of different poses if it is smaller."""
    poses = calibration.pose_count()
    return f"{count} {kind}" + (f" of {poses} poses" if poses < len(calibration.views) else "")


def run_cameras(
    arguments: Sequence[str], settings: CameraSettings, output: Path, force: bool, progress: ProgressCallback
) -> None:
    """Calibrate from the named images, write calibration and page, print the summary."""
    started, page = time.monotonic(), output.with_suffix(".html")
    _check_suffix(output)
    for path in (output, page):
        check_new_file(path, force=force)
    left, right = split_images(arguments)
    inputs = hash_files([*left, *right], _folder([*left, *right]))
    calibration = calibrate_cameras(left, right, settings, progress)
    used: dict[str, str | float | int] = {
        **{name: str(value) for name, value in asdict(settings.target).items() if value is not None},
        "shape": str(settings.shape),
        "lens": str(settings.lens),
        "scale_uncertainty": settings.scale_u,
    }
    if settings.boards:
        used["first_id"] = ",".join(map(str, settings.boards))
    if settings.known_length is not None:
        used["known_length"] = " ".join(str(value) for value in asdict(settings.known_length).values())
    provenance = Provenance(inputs.hashes, used, versions(), (output.name, page.name))
    text = render_camera_report(calibration, output.stem, provenance, time.monotonic() - started)
    inputs.check()
    with report_write_errors(output):
        write_calibration(output, calibration.rig, calibration.rms_px)
    write_atomically(page, text)
    print_calibration(calibration, output, page)


def run_camera(
    arguments: Sequence[str], settings: CameraSettings, output: Path, force: bool, progress: ProgressCallback
) -> None:
    """Calibrate a single camera from the named images, write its file, print the summary."""
    _check_suffix(output)
    check_new_file(output, force=force)
    images = [path for part in arguments for path in _expanded(part)]
    inputs = hash_files(images, _folder(images))
    calibration = calibrate_cameras(images, None, settings, progress)
    inputs.check()
    with report_write_errors(output):
        write_camera(output, calibration)
    print(f"{_of_poses(calibration, len(calibration.views), 'views')}, rms {calibration.rms_px:.3f} px (U: k = 2)")
    for item in calibration.parameters:
        print(f"{item.name.removeprefix('left.')} {quantity_text(item.value, 2 * item.u, item.unit)}")
    _print_remarks(calibration)
    print(f"calibration: {output}")


def _check_suffix(output: Path) -> None:
    """Refuse another name than one of a JSON file."""
    if output.suffix != ".json":
        found = output.suffix or "no suffix"
        raise InputError(OUTPUT_SUFFIX, output, found=found, expected="a name that ends in .json")


def _print_remarks(calibration: Calibration) -> None:
    """Print the rejected images and the notices."""
    seen = [image for view in calibration.views for image in (view.left, view.right) if image]
    points = {image.name: len(image.used) for image in seen}
    every = calibration.target.points
    of = "" if every is None else f" of {every}"
    print(f"points found: {min(points.values())} to {max(points.values())}{of} in an image")
    for dropped in calibration.rejections:
        whole = f" of {points[dropped.name]}" if dropped.name in points else ""  # of an image that is used
        what = f"{dropped.points}{whole} points rejected, " if dropped.points else "rejected: "
        print_text(f"{dropped.name}: {what}{dropped.reason}")
    for notice in calibration.notices:
        print_text(f"{notice.severity} {notice.code} {notice.where}: {notice.text}")


def _alternatives(target: Target, first: Path) -> tuple[Target, ...]:
    """Return the forms of a target to search for; the last is the stated one.

    The dictionary of a board's markers takes longer to find than the board; it is that of the first image.
    """
    if target.kind == "charuco" and target.dictionary is None and target.size is not None:
        with suppress(OSError, ValueError):
            dictionary = dictionary_of(read_image(first)[0], target)
            if dictionary is not None:
                return replace(target, dictionary=dictionary), target
    return (target,)


def _find(boards: Sequence[Sequence[Target]], path: Path) -> list[TargetView | str]:
    """Return the view of each board in one image, or the reason of the failure."""
    if not path.exists():
        raise InputError(IMAGE_LISTS, path, found="no such file", expected="an image")
    try:
        image, full_scale = read_image(path)
    except (OSError, ValueError) as error:
        return [str(error).removeprefix(f"{path}: ")] * len(boards)
    names = [str(path) if len(boards) == 1 else f"{path}, board {targets[-1].first_id}" for targets in boards]
    with as_input_error(path):
        return [_find_one(image, targets, name, full_scale) for targets, name in zip(boards, names, strict=True)]


def _find_one(image: GreyImage, targets: Sequence[Target], name: str, full_scale: int) -> TargetView | str:
    """Return the first target that is found, or the reason of the last failure."""
    why = ""
    for target in targets:
        try:
            return find_target(image, target, name, full_scale, partial=True)
        except TargetNotFound as error:
            why = str(error)
    return why


def _expanded(argument: str) -> list[Path]:
    """Return the images of a path, folder or pattern, in natural order."""
    path = Path(argument)
    if path.is_dir():
        names = [entry for entry in path.iterdir() if entry.suffix.lower() in IMAGE_FILE_SUFFIXES]
    elif path.exists() or not any(sign in argument for sign in "*?["):
        return [path]
    else:
        names = [entry for entry in path.parent.glob(path.name) if entry.is_file()]
    if not names:
        expected = f"files {', '.join(IMAGE_FILE_SUFFIXES)}"
        raise InputError(IMAGE_LISTS, path, found="no images", expected=expected)
    return sorted(names, key=lambda entry: natural_key(entry.name))


def _folder(images: Sequence[Path]) -> Path:
    """Return the common folder of all images."""
    return Path(os.path.commonpath([path.absolute().parent for path in images]))


def convert_calibration(path: Path, output: Path, force: bool = False, **stated: Any) -> str:
    """Write another program's calibration to `output` and return its format.

    `stated` are arguments of `import_calibration`. Notes are logged as well as warnings: they state how the file was
    interpreted.
    """
    check_new_file(output, force=force)
    try:
        imported = import_calibration(path, **stated)
    except OSError as error:
        raise InputError.from_exception(error, path) from error
    except ValueError as error:
        names = "|".join(stated)
        text = re.sub(rf": ({names}): ", lambda found: f": --{found[1].replace('_', '-')}: ", str(error), count=1)
        raise InputError.from_exception(ValueError(text), path) from error
    with as_input_error(output), report_write_errors(output):
        write_calibration(output, imported.rig)
    log_each_notice(imported.notices)
    return imported.format


def export_calibration_file(path: Path, output: Path, force: bool = False) -> str:
    """Write a calibration for the program of the output's suffix, and return its name."""
    check_new_file(output, force=force)
    with as_input_error(path):
        rig = read_calibration(path)
    with as_input_error(output), report_write_errors(output):
        program, notices = export_calibration(output, rig)
    log_each_notice(notices)
    return program


def log_each_notice(notices: Sequence[Notice]) -> None:
    """Log every notice: these commands have no page that shows the notes."""
    for notice in notices:
        level = logging.WARNING if notice.severity == "warning" else logging.INFO
        log.log(level, "%s %s: %s", notice.code, notice.where, notice.text)
