"""Calibration files of other programs, told apart by what they look like."""

from __future__ import annotations

import re
import zipfile
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from photogram.arrays import Notice
from photogram.calibration.foreign import ImportedCalibration, LengthUnit, Stated, build
from photogram.calibration.foreign_dic import is_matchid, read_dice_text, read_dice_xml, read_matchid, read_vic3d
from photogram.calibration.foreign_matlab import read_bouguet, read_mat, read_matlab
from photogram.calibration.foreign_opencv import parse_json, read_kalibr, read_opencv, read_ros

_PROJECT = "project.xml"  # the file inside a .z3d file that holds the calibration
_LARGEST = 64 * 2**20  # bytes of a file or of a zipped part; calibrations have some kB, projects around them some MB
_DEEPEST = 64  # lists within lists: readers follow these by recursion


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of an XML text, all tags and attributes in lower case; entities and deep nesting are refused."""
    if b"<!ENTITY" in content.upper():
        raise ValueError("expected an XML text without entities of its own, found one")
    events, depth = ElementTree.iterparse(BytesIO(content), ("start", "end")), 0
    try:
        for event, _ in events:
            depth += 1 if event == "start" else -1
            if depth > _DEEPEST:
                raise ValueError(f"expected at most {_DEEPEST} elements within each other, found more")
    except ElementTree.ParseError as error:
        raise ValueError(f"expected an XML text, found: {error}") from error
    root: ElementTree.Element = events.root  # type: ignore[attr-defined]
    for element in root.iter():
        element.tag = element.tag.lower()
        for name in list(element.attrib):
            element.attrib[name.lower()] = element.attrib.pop(name)
    return root


def _vic3d_parts(content: bytes) -> ElementTree.Element | None:
    """Return calibration and mask, cut out of the text of a VIC-3D project, as one element; None where they are not."""
    calibration = re.search(rb"<calibration\b.*?</calibration\s*>", content, re.DOTALL | re.IGNORECASE)
    mask = re.search(rb"<polygonmask\b[^<>]*>", content, re.IGNORECASE)
    if calibration is None:
        return None
    size = b"" if mask is None else mask[0].rstrip(b"/>") + b"/>"
    return parse_xml(b'<?xml version="1.0" encoding="ISO-8859-1"?><project>' + calibration[0] + size + b"</project>")


def import_calibration(
    path: str | Path,
    image_size: tuple[int, int] | None = None,
    length_unit: LengthUnit | None = None,
    extrinsics: str | Path | None = None,
    even_radial: bool = False,
) -> ImportedCalibration:
    """Return the stereo pair of another program's calibration file; its content, not its name, tells the format.

    `image_size` (width, height): for files that do not hold it. `length_unit`: for OpenCV's files, which do not say it,
    and against the unit that a format has by habit. `extrinsics`: the second file of OpenCV's sample program, which
    writes intrinsics and extrinsics apart, or of ROS, that of the right camera. `even_radial`: k1 k2 k3 of DICe's text
    belong to r², r⁴, r⁶. `ValueError` names the file and what is wrong in it.

    >>> import json
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> matrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]
    >>> content = {"M1": matrix, "D1": [0] * 5, "M2": matrix, "D2": [0] * 5, "R": np.eye(3).tolist(), "T": [-100, 0, 0]}
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "stereo.json").write_text(json.dumps(content))
    ...     imported = import_calibration(f"{folder}/stereo.json", image_size=(640, 480), length_unit="mm")
    >>> imported.format, imported.rig.right_from_left.translation_m
    ('OpenCV', array([-0.1,  0. ,  0. ]))
    """
    path = Path(path)
    if image_size is not None and min(image_size) < 1:
        raise ValueError(f"image_size: expected a width and a height of at least 1, found {image_size}")
    second = None
    if extrinsics is not None:
        try:
            second = _text(Path(extrinsics).read_bytes().decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            raise ValueError(f"{extrinsics}: expected a text, found other bytes") from error
        except ValueError as error:
            raise ValueError(f"{extrinsics}: {error}") from error
    try:
        return build(_read(path, second, even_radial), image_size, length_unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _content(path: Path) -> bytes:
    """Return a file's content; of a zipped VIC-3D project the one part that matters."""
    if path.stat().st_size > _LARGEST:
        raise ValueError(f"expected a calibration of at most {_LARGEST >> 20} MB, found {path.stat().st_size >> 20} MB")
    if not zipfile.is_zipfile(path):
        return path.read_bytes()
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_PROJECT) as part:
            content = part.read(_LARGEST + 1)
    except KeyError as error:
        raise ValueError(f"expected {_PROJECT} in this zipped file, found none") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(f"expected a zipped file that can be unpacked, found: {error}") from error
    if len(content) > _LARGEST:
        raise ValueError(f"expected {_PROJECT} of at most {_LARGEST >> 20} MB in this zipped file, found a larger one")
    return content


def _text(text: str) -> str:
    """Return a text whose lists and objects are not nested too deep for the readers."""
    marks = np.frombuffer(text.encode("utf-8", errors="replace"), dtype=np.uint8)
    steps = np.isin(marks, list(b"[{")).astype(np.int64) - np.isin(marks, list(b"]}"))
    if len(steps) and np.cumsum(steps).max() > _DEEPEST:
        raise ValueError(f"expected at most {_DEEPEST} lists within each other, found more")
    return text


def _read(path: Path, second: str | None, even_radial: bool) -> Stated:
    """Return what a file of any known format states."""
    content = _content(path)
    if content.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        return read_mat(path)
    text = content.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        stated = _read_xml(content, even_radial)
        return stated if stated is not None else read_opencv(text, second)
    _text(text)
    return _read_json(text, second) if text.lstrip().startswith("{") else _read_lines(text, second, even_radial)


def _read_json(text: str, second: str | None) -> Stated:
    """Return what a JSON file states."""
    values = parse_json(text)
    if "CameraParameters1" in values:
        return read_matlab(values)
    if values.get("format") == 1 and "rotation" in values:
        raise ValueError("expected another program's calibration, found one of this program, ready for use")
    return read_opencv(text, second)


def _read_lines(text: str, second: str | None, even_radial: bool) -> Stated:
    """Return what a YAML file or another text states."""
    if re.search(r"^cam\d+:\s*$", text, re.MULTILINE):
        return read_kalibr(text)
    if re.search(r"^(distortion_model|projection_matrix):", text, re.MULTILINE):
        return read_ros(text, second)
    if text.startswith("%YAML"):
        return read_opencv(text, second)
    if "fc_left" in text:
        return read_bouguet(text)
    return read_matchid(text) if is_matchid(text) else read_dice_text(text, even_radial)


def _read_xml(content: bytes, even_radial: bool) -> Stated | None:
    """Return what an XML file states, None where it is OpenCV's."""
    notices: tuple[Notice, ...] = ()
    try:
        root = parse_xml(content)
    except ValueError:
        parts = _vic3d_parts(content)
        if parts is None:
            raise
        text = "the file is no well-formed XML; its calibration and the size of its pictures are, and are taken"
        root, notices = parts, (Notice("warning", text, "content"),)
    if root.tag == "parameterlist":
        return read_dice_xml(root, even_radial)
    if next(root.iter("camera"), None) is not None and root.tag != "opencv_storage":
        return replace(stated := read_vic3d(root), notices=(*notices, *stated.notices))
    if root.tag != "opencv_storage":
        raise ValueError(f"expected XML of OpenCV, DICe or VIC-3D, found one that begins with <{root.tag}>")
    return None
