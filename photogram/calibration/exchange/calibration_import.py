"""Import of other programs' calibration files, recognised by their content."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic

from photogram.calibration.exchange.dic import is_matchid, read_dice_text, read_dice_xml, read_matchid, read_vic3d
from photogram.calibration.exchange.exchange_notices import MALFORMED_XML
from photogram.calibration.exchange.lens import (
    DistortionModel,
    ImportedCalibration,
    LengthUnit,
    StatedCalibration,
    build_rig,
)
from photogram.calibration.exchange.matlab import read_bouguet, read_mat, read_matlab
from photogram.calibration.exchange.opencv import parse_json, read_kalibr, read_opencv, read_ros
from shakercal._common.notices import Notice

_PROJECT = "project.xml"  # the file inside a .z3d file with the calibration
_LARGEST = 16 * 2**20  # bytes of a file or of a zipped part; calibrations have some kB, projects some MB
_LARGEST_TEXT = 2**20  # of a text that is neither OpenCV's, XML nor JSON: such a file has only a calibration
_DEEPEST = 64  # lists within lists: the readers are recursive
_QUOTED = re.compile(r""" "[^"]*" | '[^'\n]*' """, re.VERBOSE)
_PROGRAMS = "OpenCV, DICe, VIC-3D, MatchID, MATLAB or its toolbox of Bouguet, ROS, Kalibr"
_MOST_ARRAYS, _LONGEST_ARRAY = 1000, 2000  # in a file of NumPy; elements of an array that is read
_LONGEST_SENTENCE = 400  # of an error, which may quote the file


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of an XML text, tags and attributes in lower case.

    Entities and deep nesting are refused.
    """
    if b"<!ENTITY" in content.upper():
        raise ValueError("expected an XML text without entities, found one")
    events, depth = ElementTree.iterparse(BytesIO(content), ("start", "end")), 0
    try:
        for event, _ in events:
            depth += 1 if event == "start" else -1
            if depth > _DEEPEST:
                raise ValueError(f"expected at most {_DEEPEST} elements within each other, found more")
    except (ElementTree.ParseError, LookupError) as error:  # LookupError: an unknown encoding
        raise ValueError(f"expected an XML text, found: {error}") from error
    root: ElementTree.Element = events.root  # type: ignore[attr-defined]
    for element in root.iter():
        element.tag = element.tag.lower()
        for name in list(element.attrib):
            element.attrib[name.lower()] = element.attrib.pop(name)
    return root


def _vic3d_parts(content: bytes) -> ElementTree.Element | None:
    """Return calibration and mask from the text of a VIC-3D project, None if absent."""
    begin = re.search(rb"<calibration\b", content, re.IGNORECASE)
    end = begin and re.compile(rb"</calibration\s*>", re.IGNORECASE).search(content, begin.start())
    mask = re.search(rb"<polygonmask\b[^<>]*>", content, re.IGNORECASE)
    if begin is None or end is None:
        return None
    size = b"" if mask is None else mask[0].rstrip(b"/>") + b"/>"
    calibration = content[begin.start() : end.end()]
    return parse_xml(b'<?xml version="1.0" encoding="ISO-8859-1"?><project>' + calibration + size + b"</project>")


def import_calibration(
    path: str | Path,
    image_size: tuple[int, int] | None = None,
    length_unit: LengthUnit | None = None,
    extrinsics: str | Path | None = None,
    even_radial: bool = False,
    distortion_model: DistortionModel | None = None,
) -> ImportedCalibration:
    """Import the stereo pair of another program's calibration file.

    Parameters
    ----------
    path
        File; its content, not its name, determines the format.
    image_size
        (width, height) in px, for files without it; default None.
    length_unit
        Unit of lengths, for OpenCV's files, and instead of the usual unit of a format; default None.
    extrinsics
        Second file, of OpenCV's sample program or of ROS (right camera); default None.
    even_radial
        k1 k2 k3 of DICe's text are those of r², r⁴, r⁶; default False.
    distortion_model
        Model of four coefficients of OpenCV's files; default None.

    Returns
    -------
    The pair, the format and notices.

    Raises
    ------
    ValueError : Names the file and the error in it, or an argument without effect on such a file.

    Examples
    --------
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
    with _one_sentence(path), np.errstate(all="ignore"):  # extreme numbers: their results are checked
        second = None if extrinsics is None else _second(Path(extrinsics))
        stated = _read(path, second, even_radial, distortion_model)
        for name, given, formats in (
            ("extrinsics", second is not None, ("OpenCV", "ROS")),
            ("even_radial", even_radial, ("DICe",)),
            ("distortion_model", distortion_model is not None, ("OpenCV",)),
        ):
            if given and stated.format not in formats:
                raise ValueError(f"{name}: expected a file of {' or '.join(formats)}, found one of {stated.format}")
        return build_rig(stated, image_size, length_unit)


@contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """Raise `ValueError` in one sentence that names the file and quotes little of it."""
    try:
        yield
    except (ValueError, RecursionError, OverflowError, MemoryError) as error:
        if isinstance(error, np.linalg.LinAlgError):
            text = "expected rotations, found a matrix that has no inverse"
        elif isinstance(error, RecursionError):
            text = f"expected at most {_DEEPEST} lists within each other, found more"
        elif isinstance(error, ValueError):
            text = " ".join(str(error).split())
        else:
            text = "expected numbers of a calibration, found one too large"
        text = text if len(text) <= _LONGEST_SENTENCE else text[:_LONGEST_SENTENCE] + " …"
        raise ValueError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from error


def _second(path: Path) -> str:
    """Return the text of the second file."""
    with _one_sentence(path):
        content = _content(path)
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError("expected a text, found other bytes") from error
        if text.lstrip().startswith("<"):
            parse_xml(content)  # checks its depth
            return text
        return _text(text)


@contextmanager
def _unpacking() -> Iterator[None]:
    """Raise `ValueError` for a zipped file that cannot be unpacked."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"expected a zipped file that can be unpacked, found: {error}") from error


def _content(path: Path) -> bytes:
    """Return a file's content; of a zipped VIC-3D project the calibration part."""
    if path.exists() and not path.is_file():
        raise ValueError("expected a file, found a folder or a device")
    if path.stat().st_size > _LARGEST:
        raise ValueError(f"expected a calibration of at most {_LARGEST >> 20} MB, found {path.stat().st_size >> 20} MB")
    if not zipfile.is_zipfile(path):
        return path.read_bytes()
    with _unpacking(), zipfile.ZipFile(path) as archive:
        if _PROJECT not in archive.namelist():
            raise ValueError(f"expected {_PROJECT} in this zipped file, or only arrays of NumPy, found neither")
        with archive.open(_PROJECT) as part:
            content = part.read(_LARGEST + 1)
    if len(content) > _LARGEST:
        raise ValueError(f"expected {_PROJECT} of at most {_LARGEST >> 20} MB in this zipped file, found a larger one")
    return content


def _text(text: str) -> str:
    """Return a text unless its lists and objects are nested too deeply."""
    bare = _QUOTED.sub("", re.sub(r"\\.", "", text, flags=re.DOTALL))
    marks = np.frombuffer(bare.encode("utf-8", errors="replace"), dtype=np.uint8)
    steps = np.isin(marks, list(b"[{")).astype(np.int64) - np.isin(marks, list(b"]}"))
    height = np.concatenate([[0], np.cumsum(steps)])
    if (height - np.minimum.accumulate(height)).max() > _DEEPEST:
        raise ValueError(f"expected at most {_DEEPEST} lists within each other, found more")
    return text


def _arrays(path: Path) -> dict[str, Any] | None:
    """Return the arrays of a `numpy.savez` file by name, None of another file."""
    if not zipfile.is_zipfile(path):
        return None
    with _unpacking(), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if not members or not all(member.filename.endswith(".npy") for member in members):
            return None
        if len(members) > _MOST_ARRAYS or sum(member.file_size for member in members) > _LARGEST:
            raise ValueError(f"expected arrays of at most {_LARGEST >> 20} MB, {_MOST_ARRAYS} of them, found more")
        return {member.filename[:-4]: _array(member.filename, archive.read(member)) for member in members}


def _array(name: str, content: bytes) -> Any:
    """Return an array of a .npy file as lists, None for a long one."""
    stream = BytesIO(content)
    try:
        read = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}[read_magic(stream)]
        shape, by_columns, dtype = read(stream)
        if dtype.hasobject or dtype.kind not in "fiubU":
            raise ValueError(f"numbers and texts, found {dtype}")
        array = np.frombuffer(content[stream.tell() :], dtype).reshape(shape, order="F" if by_columns else "C")
    except (ValueError, KeyError, SyntaxError, EOFError) as error:
        raise ValueError(f"{name}: expected an array that can be read, found: {error}") from error
    return array.tolist() if array.size <= _LONGEST_ARRAY else None


def _read(path: Path, second: str | None, even_radial: bool, model: DistortionModel | None) -> StatedCalibration:
    """Return the content of a file of any known format."""
    arrays = _arrays(path) if path.is_file() else None
    if arrays is not None:
        return read_opencv(arrays, second, model)
    content = _content(path)
    if content.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        return read_mat(path)
    text = content.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        stated = _read_xml(content, even_radial)
        return stated if stated is not None else read_opencv(text, second, model)
    _text(text)
    if not text.lstrip().startswith("{") and not text.startswith("%YAML") and len(text) > _LARGEST_TEXT:
        raise ValueError(f"expected a text of at most {_LARGEST_TEXT >> 20} MB, found {len(text)} characters")
    if text.lstrip().startswith("{"):
        return _read_json(text, second, model)
    return _read_lines(text, second, even_radial, model)


def _read_json(text: str, second: str | None, model: DistortionModel | None) -> StatedCalibration:
    """Return the content of a JSON file."""
    values = parse_json(text)
    if "CameraParameters1" in values:
        return read_matlab(values)
    if values.get("format") == 1 and "rotation" in values:
        raise ValueError("expected another program's calibration, found one of this program, which needs no import")
    return read_opencv(text, second, model)


def _read_lines(text: str, second: str | None, even_radial: bool, model: DistortionModel | None) -> StatedCalibration:
    """Return the content of a YAML file or another text."""
    if re.search(r"^cam\d+:\s*$", text, re.MULTILINE):
        return read_kalibr(text)
    of_a_pair = text.startswith("%YAML") or re.search(r"^(R|T|rotation|translation)\w*:", text, re.MULTILINE)
    alone = "projection_matrix" if of_a_pair else "distortion_model|projection_matrix"
    if re.search(f"^({alone}):", text, re.MULTILINE):
        return read_ros(text, second)
    if text.startswith("%YAML"):
        return read_opencv(text, second, model)
    for is_it, read in ((lambda text: "fc_left" in text, read_bouguet), (is_matchid, read_matchid)):
        if is_it(text):
            return read(text)
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    if not lines:
        raise ValueError("the file is empty")
    if re.match(r"---(\s|$)|[^\W\d][\w. -]*:(\s|$)", lines[0]):
        return read_opencv(text, second, model)
    if not any(character.isdigit() for character in lines[0].split("#")[0]):
        raise ValueError(f"expected a calibration of {_PROGRAMS}, found {lines[0][:40]!r}")
    return read_dice_text(text, even_radial)


def _read_xml(content: bytes, even_radial: bool) -> StatedCalibration | None:
    """Return the content of an XML file, None if it is OpenCV's."""
    notices: tuple[Notice, ...] = ()
    try:
        root = parse_xml(content)
    except ValueError:
        parts = _vic3d_parts(content)
        if parts is None:
            raise
        root, notices = parts, (Notice(MALFORMED_XML, "content"),)
    if root.tag == "parameterlist":
        return read_dice_xml(root, even_radial)
    if next(root.iter("camera"), None) is not None and root.tag != "opencv_storage":
        return replace(stated := read_vic3d(root), notices=(*notices, *stated.notices))
    if root.tag != "opencv_storage":
        raise ValueError(f"expected XML of OpenCV, DICe or VIC-3D, found one that begins with <{root.tag[:40]}>")
    return None
