"""Calibration files of other programs: import of any, recognised by content, and export of some."""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic

from photogram.calibration.calibration_file import write_whole
from photogram.calibration.calibration_notices import COVARIANCE_NOT_EXPORTED, MALFORMED_XML, SKEW_IGNORED
from photogram.calibration.exchange.dic import is_matchid, read_dice_text, read_dice_xml, read_matchid, read_vic3d
from photogram.calibration.exchange.lens import (
    RADIAL,
    SIDES,
    TURN,
    DistortionModel,
    ImportedCalibration,
    LengthUnit,
    NearestCamera,
    StatedCalibration,
    approximation_notice,
    build_rig,
    fit_camera,
    pixel_grid,
)
from photogram.calibration.exchange.posed import (
    is_colmap,
    is_metashape,
    is_mrcal,
    is_toml_of_cameras,
    read_colmap,
    read_metashape,
    read_mrcal,
    read_toml_cameras,
)
from photogram.calibration.exchange.vision import (
    parse_json,
    read_bouguet,
    read_kalibr,
    read_mat,
    read_matlab,
    read_opencv,
    read_ros,
)
from photogram.camera import CAMERA_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

_PROJECT = "project.xml"  # the file inside a .z3d file with the calibration
_LARGEST = 16 * 2**20  # bytes of a file or of a zipped part; calibrations have some kB, projects some MB
_LARGEST_TEXT = 2**20  # of a text that is neither OpenCV's, XML nor JSON: such a file has only a calibration
_DEEPEST = 64  # lists within lists: the readers are recursive
_QUOTED = re.compile(r""" "[^"]*" | '[^'\n]*' """, re.VERBOSE)
_PROGRAMS = (
    "OpenCV, DICe, VIC-3D, MatchID, MATLAB or its toolbox of Bouguet, ROS, Kalibr, COLMAP, mrcal, anipose, caliscope "
    "or Metashape"
)
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
    cameras: tuple[str, str] | None = None,
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
        Second file, of OpenCV's sample program, of ROS or mrcal (right camera) or of COLMAP (images); default None.
    even_radial
        k1 k2 k3 of DICe's text are those of r², r⁴, r⁶; default False.
    distortion_model
        Model of four coefficients of OpenCV's files; default None.
    cameras
        Names of the left and the right one, of files with more than two; default None.

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
        stated = _read(path, _Options(second, even_radial, distortion_model, cameras))
        for name, given, formats in (
            ("extrinsics", second is not None, ("OpenCV", "ROS", "COLMAP", "mrcal")),
            ("even_radial", even_radial, ("DICe",)),
            ("distortion_model", distortion_model is not None, ("OpenCV",)),
            ("cameras", cameras is not None, ("COLMAP", "anipose", "caliscope", "Metashape")),
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


@dataclass(frozen=True)
class _SecondFile:
    """The second file: its path and content."""

    path: Path
    content: bytes

    @property
    def text(self) -> str:
        """Its text, checked for depth."""
        with _one_sentence(self.path):
            try:
                text = self.content.decode("utf-8-sig")
            except UnicodeDecodeError as error:
                raise ValueError("expected a text, found other bytes") from error
            if text.lstrip().startswith("<"):
                parse_xml(self.content)  # checks its depth
                return text
            return _text(text)


@dataclass(frozen=True)
class _Options:
    """Arguments of `import_calibration` for the readers."""

    second: _SecondFile | None
    even_radial: bool
    model: DistortionModel | None
    cameras: tuple[str, str] | None

    @property
    def second_text(self) -> str | None:
        """Text of the second file, None without one."""
        return None if self.second is None else self.second.text


def _second(path: Path) -> _SecondFile:
    """Return the second file."""
    with _one_sentence(path):
        return _SecondFile(path, _content(path))


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


def _read(path: Path, options: _Options) -> StatedCalibration:
    """Return the content of a file of any known format."""
    arrays = _arrays(path) if path.is_file() else None
    if arrays is not None:
        return read_opencv(arrays, options.second_text, options.model)
    content = _content(path)
    if content.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        return read_mat(path)
    if is_colmap(content):
        images = None if options.second is None else options.second.content
        return read_colmap(content, images, options.cameras)
    return _read_text(content, options)


def _read_text(content: bytes, options: _Options) -> StatedCalibration:
    """Return the content of a text of any known format."""
    text = content.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        stated = _read_xml(content, options)
        return stated if stated is not None else read_opencv(text, options.second_text, options.model)
    _text(text)
    if is_mrcal(text):
        return read_mrcal(text, options.second_text)
    if not text.lstrip().startswith("{") and not text.startswith("%YAML") and len(text) > _LARGEST_TEXT:
        raise ValueError(f"expected a text of at most {_LARGEST_TEXT >> 20} MB, found {len(text)} characters")
    if text.lstrip().startswith("{"):
        return _read_json(text, options)
    if is_toml_of_cameras(text):
        return read_toml_cameras(text, options.cameras)
    return _read_lines(text, options)


def _read_json(text: str, options: _Options) -> StatedCalibration:
    """Return the content of a JSON file."""
    values = parse_json(text)
    if "CameraParameters1" in values:
        return read_matlab(values)
    if values.get("format") == 1 and "rotation" in values:
        raise ValueError("expected another program's calibration, found one of this program, which needs no import")
    return read_opencv(text, options.second_text, options.model)


def _read_lines(text: str, options: _Options) -> StatedCalibration:
    """Return the content of a YAML file or another text."""
    if re.search(r"^cam\d+:\s*$", text, re.MULTILINE):
        return read_kalibr(text)
    of_a_pair = text.startswith("%YAML") or re.search(r"^(R|T|rotation|translation)\w*:", text, re.MULTILINE)
    alone = "projection_matrix" if of_a_pair else "distortion_model|projection_matrix"
    if re.search(f"^({alone}):", text, re.MULTILINE):
        return read_ros(text, options.second_text)
    if text.startswith("%YAML"):
        return read_opencv(text, options.second_text, options.model)
    for is_it, read in ((lambda text: "fc_left" in text, read_bouguet), (is_matchid, read_matchid)):
        if is_it(text):
            return read(text)
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    if not lines:
        raise ValueError("the file is empty")
    if re.match(r"---(\s|$)|[^\W\d][\w. -]*:(\s|$)", lines[0]):
        return read_opencv(text, options.second_text, options.model)
    if not any(character.isdigit() for character in lines[0].split("#")[0]):
        raise ValueError(f"expected a calibration of {_PROGRAMS}, found {lines[0][:40]!r}")
    return read_dice_text(text, options.even_radial)


def _read_xml(content: bytes, options: _Options) -> StatedCalibration | None:
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
        return read_dice_xml(root, options.even_radial)
    if is_metashape(root):
        return read_metashape(root, options.cameras)
    if next(root.iter("camera"), None) is not None and root.tag != "opencv_storage":
        return replace(stated := read_vic3d(root), notices=(*notices, *stated.notices))
    if root.tag != "opencv_storage":
        raise ValueError(
            f"expected XML of OpenCV, DICe, VIC-3D or Metashape, found one that begins with <{root.tag[:40]}>"
        )
    return None


# Export: OpenCV's YAML, VIC-3D's XML, MATLAB's JSON.

_FURTHER = ("p1", "p2", "k4", "k5", "k6")
_MATRIX = ("fx", "fy", "cx", "cy", "skew")


def opencv_yaml(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return an OpenCV FileStorage text and notices.

    It has M1 D1 M2 D2 R T, x₂ = R·x₁ + T in m, with all digits. D has five coefficients, or eight if k4 k5 k6 are not
    zero. OpenCV's functions ignore skew.
    """
    import cv2

    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    equal_sizes = np.array_equal(rig.left.size_px, rig.right.size_px)
    for number, camera in enumerate((rig.left, rig.right), start=1):
        for name, length in zip(("image_width", "image_height"), camera.size_px, strict=True):
            if not equal_sizes or number == 1:
                storage.write(name if equal_sizes else f"{name}{number}", int(length))
    storage.write("length_unit", "m")
    for number, camera in enumerate((rig.left, rig.right), start=1):
        storage.write(f"M{number}", camera.matrix)
        storage.write(f"D{number}", camera.distortion[: 8 if camera.distortion[5:].any() else 5].reshape(1, -1))
    storage.write("R", rig.right_from_left.rotation)
    storage.write("T", rig.right_from_left.translation_m.reshape(3, 1))
    skews = [
        Notice(SKEW_IGNORED, f"{side} camera", skew_px=camera.matrix[0, 1])
        for side, camera in zip(SIDES, (rig.left, rig.right), strict=True)
        if camera.matrix[0, 1] != 0
    ]
    return storage.releaseAndGetString(), skews


def vic3d_xml(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return a project text of VIC-3D, lengths in mm, and notices.

    VIC-3D has only k1 k2 k3 and skew. Tangential distortion and k4 k5 k6 are approximated by least squares over the
    image with the available parameters and rotations of the two cameras' frames. The world is the rotated left camera's
    frame.
    """
    if not np.array_equal(rig.left.size_px, rig.right.size_px):
        found = " and ".join("x".join(map(str, camera.size_px)) for camera in (rig.left, rig.right))
        raise ValueError(f"image_size: expected images of one size, as in VIC-3D's projects, found {found}")
    notices: list[Notice] = []
    free = (*_MATRIX, *RADIAL, *TURN)
    left, right = (
        _without(camera, side, _FURTHER, free, notices)
        for side, camera in zip(SIDES, (rig.left, rig.right), strict=True)
    )
    first, second = (RigidTransform(rotation_from_vector(near.turn), np.zeros(3)) for near in (left, right))
    lines = ['<?xml version="1.0" encoding="ISO-8859-1"?>', "<!DOCTYPE vpml>", "<project>", " <calibration>"]
    for index, (near, pose) in enumerate(((left, first), (right, second @ rig.right_from_left))):
        named = dict(zip(CAMERA_PARAMETERS, near.camera.parameters.tolist(), strict=True))
        inner = " ".join(repr(named[name]) for name in ("cx", "cy", "fx", "fy", "skew", *RADIAL))
        outer = " ".join(map(repr, [*_cardan_deg(pose.rotation).tolist(), *(1e3 * pose.translation_m).tolist()]))
        lines.append(f'  <camera id="{index}">{inner}<orientation>{outer}</orientation></camera>')
    width, height = rig.left.size_px
    lines += [" </calibration>", f' <polygonmask width="{width}" height="{height}"/>', "</project>", ""]
    return "\n".join(lines), notices


def matlab_json(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return jsonencode(toStruct(stereoParams)) of a pair, lengths in mm, and notices.

    MATLAB counts pixels from 1, and has k1 k2 k3 p1 p2 and skew; k4 k5 k6 are approximated by these, see `vic3d_xml`.
    """
    notices: list[Notice] = []
    content: dict[str, object] = {}
    free = (*_MATRIX, *RADIAL)
    for number, (side, camera) in enumerate(zip(SIDES, (rig.left, rig.right), strict=True), start=1):
        near = _without(camera, side, _FURTHER[2:], free, notices).camera
        k1, k2, p1, p2, k3 = near.distortion[:5].tolist()
        content[f"CameraParameters{number}"] = {
            "K": (near.matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])).tolist(),
            "RadialDistortion": [k1, k2, k3],
            "TangentialDistortion": [p1, p2],
            "ImageSize": camera.size_px[::-1].tolist(),
            "WorldUnits": "millimeters",
        }
    pose = rig.right_from_left
    content["PoseCamera2"] = {
        "Dimensionality": 3,
        "R": pose.rotation.tolist(),
        "Translation": (1e3 * pose.translation_m).tolist(),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n", notices


FORMATS = {
    ".yml": ("OpenCV", opencv_yaml),
    ".yaml": ("OpenCV", opencv_yaml),
    ".xml": ("VIC-3D", vic3d_xml),
    ".json": ("MATLAB", matlab_json),
}
"""Program and writer of each file suffix."""


def export_calibration(path: str | Path, rig: StereoRig) -> tuple[str, tuple[Notice, ...]]:
    """Write a stereo pair for another program, chosen by the suffix.

    Parameters
    ----------
    path
        File to write; `.yml`, `.yaml`: OpenCV, `.xml`: VIC-3D, `.json`: MATLAB.
    rig
        Stereo pair.

    Returns
    -------
    The program's name and notices.

    Raises
    ------
    ValueError : Unknown suffix, or the program's camera model cannot describe the pair.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> with TemporaryDirectory() as folder:
    ...     export_calibration(f"{folder}/rig.xml", rig)[0]
    'VIC-3D'
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(
            f"{path}: expected a name that ends in {', '.join(FORMATS)}, found {path.suffix or 'no suffix'}"
        )
    program, write = FORMATS[path.suffix.lower()]
    text, notices = write(rig)
    if rig.covariance is not None:
        notices.append(Notice(COVARIANCE_NOT_EXPORTED, "covariance", program=program))
    write_whole(path, text)
    return program, tuple(notices)


def _without(
    camera: Camera, side: str, missing: Sequence[str], free: Sequence[str], notices: list[Notice]
) -> NearestCamera:
    """Return the nearest camera with the parameters `missing` zero, and add a notice."""
    start = camera.parameters
    indices = [CAMERA_PARAMETERS.index(name) for name in missing]
    if not start[indices].any():
        return NearestCamera(camera, np.zeros(3), 0.0, 0.0)
    found = ", ".join(
        f"{name} = {start[index]:.3g}" for name, index in zip(missing, indices, strict=True) if start[index]
    )
    pixel = pixel_grid(camera.size_px)
    start[indices] = 0.0
    near = fit_camera(pixel, camera.undistort(pixel), start, free, camera.size_px)
    notices.append(approximation_notice(f"{side} camera", found, near))
    return near


def _cardan_deg(rotation: FloatArray) -> FloatArray:
    """Return α, β, γ (3,) in degrees of R = R_z(γ)·R_y(β)·R_x(α)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_euler("xyz", degrees=True))
