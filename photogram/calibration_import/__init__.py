"""Calibrations of other programs → `StereoRig`: OpenCV, DICe, VIC-3D, MATLAB, Bouguet's toolbox."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

from photogram.calibration_import.build import Found, ImportedCalibration, LengthUnit, build
from photogram.calibration_import.dice import read_dice_text, read_dice_xml
from photogram.calibration_import.matlab import read_bouguet, read_matlab
from photogram.calibration_import.opencv import read_opencv
from photogram.calibration_import.vic3d import PROJECT, read_vic3d
from photogram.calibration_import.xml_text import parse_xml

__all__ = ["ImportedCalibration", "LengthUnit", "import_calibration"]


def import_calibration(
    path: Path,
    image_size: tuple[int, int] | None = None,
    length_unit: LengthUnit | None = None,
    extrinsics: Path | None = None,
) -> ImportedCalibration:
    """Return the stereo pair of another program's calibration file; its content, not its name, tells the format.

    `image_size` (width, height): for files that do not hold it. `length_unit`: for OpenCV's files, which do not say it,
    and against the unit that a format has by habit. `extrinsics`: the second file of OpenCV's sample program, which
    writes intrinsics and extrinsics apart. `ValueError` names the file and what is wrong in it.
    """
    path = Path(path)
    if image_size is not None and min(image_size) < 1:
        raise ValueError(f"image_size: expected a width and a height of at least 1, found {image_size}")
    second = None if extrinsics is None else _decoded(extrinsics, Path(extrinsics).read_bytes())
    try:
        return build(_found(_content(path), second), image_size, length_unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _content(path: Path) -> bytes:
    """Return a file's content; of a zipped VIC-3D project the one part that matters."""
    if not zipfile.is_zipfile(path):
        return path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        try:
            return archive.read(PROJECT)
        except KeyError as error:
            raise ValueError(f"expected {PROJECT} in this zipped file, found none") from error


def _decoded(path: Path, content: bytes) -> str:
    """Return the text of a file."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected a text, found other bytes") from error


def _found(content: bytes, extrinsics: str | None) -> Found:
    """Return what a file of any known format holds."""
    text = content.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        return _found_in_xml(content, text, extrinsics)
    if text.lstrip().startswith("{"):
        return _found_in_json(text, extrinsics)
    if text.startswith("%YAML"):
        return read_opencv(text, extrinsics)
    if "fc_left" in text:
        return read_bouguet(text)
    return read_dice_text(text)


def _found_in_xml(content: bytes, text: str, extrinsics: str | None) -> Found:
    """Return what an XML text of OpenCV, DICe or VIC-3D holds."""
    root = parse_xml(content)
    if root.tag == "opencv_storage":
        return read_opencv(text, extrinsics)
    if root.tag == "parameterlist":
        return read_dice_xml(root)
    if next(root.iter("camera"), None) is not None:
        return read_vic3d(root)
    raise ValueError(f"expected XML of OpenCV, DICe or VIC-3D, found one that begins with <{root.tag}>")


def _found_in_json(text: str, extrinsics: str | None) -> Found:
    """Return what a JSON text of MATLAB or OpenCV holds."""
    try:
        content = json.loads(text)
    except ValueError as error:
        raise ValueError(f"expected a JSON text, found: {error}") from error
    if "CameraParameters1" in content:
        return read_matlab(text)
    if content.get("format") == 1 and "rotation" in content:
        raise ValueError("expected another program's calibration, found one of this program, ready for use")
    return read_opencv(text, extrinsics)
