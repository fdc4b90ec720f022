"""MATLAB files of version 5, checked before SciPy reads them.

SciPy's reader in C trusts the tags: it uses types of data as indices, numbers of cells as sizes, and follows nested
cells by recursion. Wrong tags terminate the process. Here the same bytes are parsed in the same order (MathWorks,
"MAT-File Format", version 5), and no data are stored.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from inspect import signature
from pathlib import Path
from typing import Any, BinaryIO

_NUMBERS = frozenset((*range(1, 8), 9, 12, 13, 16, 17, 18))  # types of data: integers, floating point, text
_INT32, _UINT32, _MATRIX, _COMPRESSED = 5, 6, 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17  # classes of arrays
_PLAIN = range(6, 16)  # classes of arrays of numbers
_DEEPEST = 64  # cells and structs inside one another
_LETTER = 8  # bytes in memory for each byte of text
_BLOCK = 1 << 20  # bytes that are read at once


def load_mat(path: Path, **options: Any) -> dict[str, Any]:
    """Return what `scipy.io.loadmat` reads from a checked file; sparse matrices as sparse arrays.

    SciPy before 1.17 has no such choice, 1.18 warns where it is not made.
    """
    from scipy.io import loadmat

    choice = {"spmatrix": False} if "spmatrix" in signature(loadmat).parameters else {}
    content: dict[str, Any] = loadmat(path, **choice, **options)
    return content


def check_mat5(path: Path, most_bytes: int, most_arrays: int) -> None:
    """Raise `ValueError` where a file of version 5 is damaged, or too large once inflated.

    Files of other versions pass: they are read, or refused, by other functions.
    """
    with path.open("rb") as file:
        head, size = file.read(128), path.stat().st_size
        if len(head) < 128 or 0 in head[:4] or head[124 + (head[126:127] == b"I")] != 1:
            return
        parser = _VariableParser(path, "<" if head[126:] == b"IM" else ">", most_bytes, most_arrays)
        while len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{parser.order}II", tag)
            end = file.tell() + length
            if kind not in (_MATRIX, _COMPRESSED) or not 0 < length <= size - file.tell():
                raise parser.wrong("a variable within the file", f"type {kind} with {length} bytes")
            try:
                parser.variable(file, length, kind == _COMPRESSED)
            except zlib.error as error:
                raise parser.wrong("a compressed variable", f"a damaged one ({error})") from error
            file.seek(end)


class _VariableParser:
    """Parser of one variable after the other, in the order of SciPy's reader."""

    def __init__(self, path: Path, order: str, most_bytes: int, most_arrays: int) -> None:
        self.path, self.order = path, order
        self.most_bytes, self.left_bytes = most_bytes, most_bytes
        self.most_arrays, self.left_arrays = most_arrays, most_arrays

    def wrong(self, expected: str, found: str) -> ValueError:
        """Return the error of what is expected and found."""
        return ValueError(f"{self.path}: expected {expected}, found {found}")

    def variable(self, file: BinaryIO, length: int, compressed: bool) -> None:
        """Parse a variable of the file, inflated where it is compressed."""
        self.stream, self.seeks, self.at = file, not compressed, 0
        if compressed:
            self.stream = io.BufferedReader(_InflatedStream(file, length), _BLOCK)
            kind, length = self._words(8)
            if kind != _MATRIX:
                raise self.wrong("a compressed array", f"type {kind}")
        self._array(self.at + length, 0)

    def _take(self, size: int, end: int) -> bytes:
        self._count_bytes(size, end)
        data = self.stream.read(size)
        if len(data) < size:
            raise self.wrong("a complete variable", "a shorter one")
        return data

    def _count_bytes(self, size: int, end: int) -> None:
        """Count bytes that are read now."""
        self.at += size
        self.left_bytes -= size
        if self.at > end:
            raise self.wrong("data within their variable", f"{self.at - end} bytes beyond it")
        self._check_size()

    def _check_size(self) -> None:
        if self.left_bytes < 0:
            most = f"{self.most_bytes / 1e6:.0f} MB of samples"
            raise ValueError(f"{self.path}: its variables: expected at most {most}, found more")

    def _skip(self, size: int, end: int) -> None:
        if self.seeks:
            self._count_bytes(size, end)
            self.stream.seek(size, io.SEEK_CUR)
        while not self.seeks and size > 0:
            size -= len(self._take(min(size, _BLOCK), end))

    def _words(self, end: int) -> tuple[int, int]:
        first, second = struct.unpack(f"{self.order}II", self._take(8, end))
        return first, second

    def _element(self, end: int, first_bytes: int = 0) -> tuple[int, int, bytes]:
        """Parse an element of data; return its type, its size and its first bytes."""
        tag = self._take(8, end)
        kind, size = struct.unpack(f"{self.order}II", tag)
        small = kind >> 16
        if small:
            kind, size = kind & 0xFFFF, small
        if kind not in _NUMBERS or small > 4:
            raise self.wrong("data of a type that MATLAB has", f"type {kind} with {size} bytes")
        if small:
            return kind, size, tag[4 : 4 + size][:first_bytes]
        data = self._take(min(size, first_bytes), end)
        self._skip(size - len(data), end)
        over = -size % 8
        self.at += over  # missing after the last element of some variables
        self.stream.seek(over, io.SEEK_CUR) if self.seeks else self.stream.read(over)
        return kind, size, data

    def _array(self, end: int, depth: int) -> None:
        """Parse the content of an array: flags, shape, name, and the data of its class."""
        self.left_arrays -= 1
        if self.left_arrays < 0:
            raise self.wrong(f"at most {self.most_arrays} cells and structs", "more")
        flags = struct.unpack(f"{self.order}I", self._take(16, end)[8:12])[0]
        array_class, parts = flags & 0xFF, 1 + (flags >> 11 & 1)  # of complex numbers real ones and imaginary ones
        if array_class == _OPAQUE:
            for _ in range(3):
                self._element(end)
            return self._arrays(1, end, depth)
        count = self._count(end)
        self._element(end)  # its name
        if array_class in _PLAIN or array_class == _SPARSE:
            for _ in range(parts + 2 * (array_class == _SPARSE)):
                self._element(end)
        elif array_class == _CHAR:
            size = max(self._element(end)[1], count)
            self.left_bytes -= _LETTER * size
            self._check_size()
        elif array_class == _CELL:
            self._arrays(count, end, depth)
        elif array_class == _FUNCTION:
            self._arrays(1, end, depth)
        elif array_class in (_STRUCT, _OBJECT):
            if array_class == _OBJECT:
                self._element(end)  # the name of its class
            fields = self._fields(end)
            if not fields and count > self.left_arrays:
                raise self.wrong(f"at most {self.most_arrays} cells and structs", "more")
            self._arrays(count * fields, end, depth)
        else:
            raise self.wrong("a class of arrays that MATLAB has", f"class {array_class}")
        return None

    def _count(self, end: int) -> int:
        """Parse the shape of an array and return its number of elements."""
        kind, size, data = self._element(end, 128)
        shape = struct.unpack(f"{self.order}{len(data) // 4}i", data[: len(data) // 4 * 4])
        if kind not in (_INT32, _UINT32) or size != len(data) or min(shape, default=0) < 0:
            raise self.wrong("the shape of an array", f"{size} bytes of type {kind}")
        return math.prod(shape)

    def _fields(self, end: int) -> int:
        """Parse the names of a struct's fields and return their number."""
        _, size, data = self._element(end, 4)
        length = struct.unpack(f"{self.order}i", data)[0] if size == 4 else 0
        _, size, _ = self._element(end)
        if length < 1 or size // length > self.left_arrays or size // length > 4096:
            raise self.wrong("a struct with names of its fields", f"{size} bytes of them, {length} each")
        return size // length

    def _arrays(self, count: int, end: int, depth: int) -> None:
        """Parse the arrays within an array."""
        if depth >= _DEEPEST:
            raise self.wrong(f"at most {_DEEPEST} cells and structs inside one another", "more")
        if count > (end - self.at) // 8:
            raise self.wrong("as many cells as a variable's length allows", f"{count} in {end - self.at} bytes")
        for _ in range(count):
            kind, size = self._words(end)
            if kind != _MATRIX:
                raise self.wrong("an array in a cell or field", f"type {kind}")
            if size:
                self._array(min(self.at + size, end), depth + 1)


class _InflatedStream(io.RawIOBase):
    """Content of a compressed variable of a file, as a stream."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self._left, self._inflate = file, length, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer as far as the content allows."""
        view = memoryview(buffer)
        while not self._inflate.eof:
            raw = self._inflate.unconsumed_tail
            if not raw:
                raw = self._file.read(min(self._left, _BLOCK))
                self._left -= len(raw)
            data = self._inflate.decompress(raw, len(view))
            view[: len(data)] = data
            if data or not raw:
                return len(data)
        return 0
