"""Photron high-speed video: the header .cih (text) or .cihx (XML) beside the raw frames in .mraw."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

XML_KEYS = {
    "Total Frame": "frameInfo/totalFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "File Format": "imageFileInfo/fileFormat",
}


@dataclass(frozen=True)
class MrawVideo:
    """Frames of one .mraw file: `stored_bits` per pixel in the file (8, 12 or 16), `bits` that carry the grey value.

    `side` says where the grey value stands in 16 stored bits: "lower" as a plain number, "higher" shifted up.
    """

    path: Path
    frames: int
    size_px: tuple[int, int]
    stored_bits: int
    bits: int
    side: Literal["lower", "higher"]

    def read(self, index: int) -> NDArray[np.uint8 | np.uint16]:
        """Frame `index` as (H,W), grey values in the lower bits."""
        width, height = self.size_px
        count = width * height * self.stored_bits // 8
        raw = np.fromfile(self.path, np.uint8, count=count, offset=index * count)
        if len(raw) < count:
            raise ValueError(f"{self.path}: frame {index} is cut off, expected {count} bytes, found {len(raw)}")
        if self.stored_bits == 8:
            return raw.reshape(height, width)
        if self.stored_bits == 12:
            return unpack_12_bit(raw).reshape(height, width)
        values = raw.view("<u2").astype(np.uint16).reshape(height, width)
        return values >> np.uint16(16 - self.bits) if self.side == "higher" else values


def unpack_12_bit(raw: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Grey values of pairs of pixels packed into three bytes, the most significant bits first."""
    first, middle, last = raw.reshape(-1, 3).astype(np.uint16).T
    return np.column_stack(((first << 4) | (middle >> 4), ((middle & 15) << 8) | last)).ravel()


def open_mraw(header: Path) -> MrawVideo:
    """Read the header .cih or .cihx and check that the .mraw beside it holds the frames it announces."""
    if not header.is_file():
        raise FileNotFoundError(f"{header}: no such file")
    entries = _xml_entries(header) if header.suffix.lower() == ".cihx" else _text_entries(header)
    stored_bits = _integer(entries, "Color Bit", header)
    colour, layout = entries.get("Color Type", "Mono"), entries.get("File Format", "MRaw")
    if colour.lower() != "mono" or layout.lower() != "mraw":
        raise ValueError(f"{header}: expected monochrome MRaw frames, found {colour!r} and {layout!r}")
    if stored_bits not in (8, 12, 16):
        raise ValueError(f"{header}: Color Bit: expected 8, 12 or 16, found {stored_bits}")
    side = entries.get("EffectiveBit Side", "Lower").lower()
    if side not in ("lower", "higher"):
        raise ValueError(f"{header}: EffectiveBit Side: expected Lower or Higher, found {side!r}")
    video = MrawVideo(
        path=_raw_file(header),
        frames=_integer(entries, "Total Frame", header),
        size_px=(_integer(entries, "Image Width", header), _integer(entries, "Image Height", header)),
        stored_bits=stored_bits,
        bits=min(16, _integer(entries, "EffectiveBit Depth", header)) if stored_bits == 16 else stored_bits,
        side="higher" if side == "higher" else "lower",
    )
    _check_length(video)
    return video


def _text_entries(header: Path) -> dict[str, str]:
    """The `key : value` lines of a .cih file."""
    lines = header.read_text(encoding="utf-8", errors="replace").splitlines()
    pairs = (line.partition(":") for line in lines if ":" in line)
    return {key.strip(): value.strip() for key, _, value in pairs}


def _xml_entries(header: Path) -> dict[str, str]:
    """The entries of a .cihx file under their .cih names; the XML stands between other lines."""
    text = header.read_text(encoding="utf-8", errors="replace")
    start, end = text.find("<cih>"), text.rfind("</cih>")
    try:
        root = ElementTree.fromstring(text[start : end + len("</cih>")] if start >= 0 else "")
    except ElementTree.ParseError as error:
        raise ValueError(f"{header}: expected a <cih> element ({error})") from error
    found = {key: root.findtext(place) for key, place in XML_KEYS.items()}
    return {key: value.strip() for key, value in found.items() if value is not None}


def _integer(entries: dict[str, str], key: str, header: Path) -> int:
    """The positive whole number under `key`."""
    text = entries.get(key, "nothing")
    if not text.isdigit() or int(text) < 1:
        raise ValueError(f"{header}: {key}: expected a positive whole number, found {text}")
    return int(text)


def _raw_file(header: Path) -> Path:
    """The .mraw file beside the header."""
    for suffix in (".mraw", ".MRAW"):
        if (path := header.with_suffix(suffix)).is_file():
            return path
    raise FileNotFoundError(f"{header.with_suffix('.mraw')}: no such file beside {header.name}")


def _check_length(video: MrawVideo) -> None:
    """Refuse a file that is shorter than its header says."""
    expected = video.frames * video.size_px[0] * video.size_px[1] * video.stored_bits // 8
    found = video.path.stat().st_size
    if found < expected:
        raise ValueError(f"{video.path}: truncated, expected {expected} bytes for {video.frames} frames, found {found}")
