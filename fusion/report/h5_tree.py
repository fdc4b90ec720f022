"""HDF5 groups, data sets and attributes in memory, which are written in one pass.

Results have thousands of them, and each query of HDF5 takes as long as writing it. The file is the same as that of
h5py's `create_dataset`, `attrs` and `make_scale`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, lru_cache
from itertools import count
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5p, h5r, h5s, h5t
from numpy.typing import ArrayLike, NDArray

DEFLATE_ABOVE, WORTH_IT = 512, 0.75
"""An array with more numbers is compressed if a sample shrinks to this share of its bytes (measured trade-off)."""
SAMPLE_BYTES, CHUNK_BYTES = 1 << 15, 1 << 20
"""Size of that sample, and of a chunk: HDF5's default chunk cache is 1 MiB."""
TEXT = h5py.string_dtype()
LISTS = h5py.vlen_dtype(h5py.ref_dtype)
REFERENCE = np.dtype([("dataset", h5py.ref_dtype), ("dimension", np.uint32)], align=True)
"""Type by which axes and scales refer to each other (HDF5 dimension scale specification)."""


class Data:
    """Data set of numbers, or of texts as objects, of any shape.

    `stored`: False if only the length of an axis is needed. `scales`: by axis, the data set of the coordinates.
    `scale`: name as a coordinate, empty if it is none; `axes`: the data sets and axes that it describes.
    """

    def __init__(self, values: ArrayLike, *, stored: bool = True) -> None:
        values = np.asarray(values)
        self.values = values.astype(TEXT) if values.dtype.kind in "UO" else values
        self.stored = stored
        self.attrs: dict[str, Any] = {}
        self.scales: dict[int, Data] = {}
        self.scale, self.axes = "", list[tuple[Data, int]]()
        self.id: Any = None

    def attach(self, axis: int, scale: Data) -> None:
        """Use another data set as the coordinates of an axis."""
        self.scales[axis] = scale
        scale.axes.append((self, axis))

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of its axes."""
        return self.values.shape

    @property
    def numbers(self) -> bool:
        """Whether its values are numbers or booleans."""
        return self.values.dtype.kind != "O"


class Group:
    """Group in memory with the interface of h5py's group; `track_order` keeps the order of creation."""

    def __init__(self, parent: Group | None = None, name: str = "/", *, track_order: bool = True) -> None:
        self.name, self.track_order = name, track_order
        self.parent = parent if parent is not None else self
        self.top: Group = parent.top if parent is not None else self
        self.inside: dict[str, Data | Group] = {}
        self.attrs: dict[str, Any] = {}

    def get(self, path: str) -> Any:
        """Return the item at a path below this group, None if there is none."""
        found: Any = self
        for name in path.split("/"):
            found = found.inside.get(name) if isinstance(found, Group) else None
        return found

    def __contains__(self, path: str) -> bool:
        return self.get(path) is not None

    def __getitem__(self, path: str) -> Any:
        found = self.get(path)
        if found is None:
            raise KeyError(path)
        return found

    def __setitem__(self, name: str, values: ArrayLike) -> None:
        self.put(name, Data(values))

    def put(self, name: str, item: Any) -> Any:
        """Add a new data set or group and return it."""
        if name in self.inside:
            raise ValueError(f"{self.name}: {name}: expected a name that is free, found it taken")
        self.inside[name] = item
        return item

    def create_group(self, path: str, *, track_order: bool = False) -> Group:
        """Create a group and the missing groups above it."""
        name, _, below = path.partition("/")
        inner: Any = self.inside.get(name) if below else None
        if inner is None:
            order = self.track_order if below else track_order
            inner = self.put(name, Group(self, f"{self.name.rstrip('/')}/{name}", track_order=order))
        made: Group = inner.create_group(below, track_order=track_order) if below else inner
        return made

    def free_name(self, text: str) -> str:
        """Return an unused name for a user's text, without path characters."""
        name = text.replace("/", "_")
        name = name if name.strip(".") else "_" * max(1, len(name))
        candidates = (name if number == 1 else f"{name} ({number})" for number in count(1))
        return next(candidate for candidate in candidates if candidate not in self.inside)

    def require_group(self, path: str) -> Group:
        """Return the group at a path; create it if it is missing."""
        return found if isinstance(found := self.get(path), Group) else self.create_group(path)

    def datasets(self) -> Iterator[tuple[str, Group, Data]]:
        """Yield every data set with its path and its group."""
        for name, item in self.inside.items():
            if isinstance(item, Group):
                yield from item.datasets()
            else:
                yield f"{self.name.rstrip('/')}/{name}", self, item


# Written.


def write_tree(file: Any, top: Group) -> None:
    """Write a group and all its contents into an open, empty file of this identifier."""
    _write_group(file, top)
    for _, _, data in top.datasets():
        if data.scales:
            named = [data.scales.get(axis) for axis in range(len(data.shape))]
            lists = np.empty(len(named), dtype=LISTS)
            for axis, scale in enumerate(named):
                lists[axis] = np.array([] if scale is None else [_reference(scale)], dtype=h5py.ref_dtype)
            _write_attribute(data.id, "DIMENSION_LIST", lists, "references")
        if data.axes:
            belongs = [(_reference(other), axis) for other, axis in data.axes]
            _write_attribute(data.id, "REFERENCE_LIST", np.array(belongs, dtype=REFERENCE))


def _reference(data: Data) -> Any:
    return h5r.create(data.id, b".", h5r.OBJECT)


def _write_group(parent: Any, group: Group) -> None:
    """Write the contents of a group into an open HDF5 group."""
    for name, item in group.inside.items():
        if isinstance(item, Group):
            link, kind = _link_kind(name.isascii()), _group_kind(item.track_order)
            _write_group(h5g.create(parent, name.encode(), link, kind), item)
            continue
        item.id = _write_data(parent, name, item)
        for key, value in item.attrs.items():
            _write_attribute(item.id, key, value)
        if item.scale:
            for key, text in (("CLASS", "DIMENSION_SCALE"), ("NAME", item.scale)):
                _write_attribute(item.id, key, np.bytes_(text.encode()))
    for key, value in group.attrs.items():
        _write_attribute(parent, key, value)


def _write_data(parent: Any, name: str, data: Data) -> Any:
    """Write a new data set into an open HDF5 group and return its identifier."""
    values, stored = np.asarray(data.values, order="C"), _plain()
    rows, parts = _deflated(values) if data.numbers and values.size > DEFLATE_ABOVE else (0, [])
    if parts:
        stored = stored.copy()
        stored.set_chunk((rows, *values.shape[1:]))
        stored.set_shuffle()
        stored.set_deflate(1)
    kind, space, link = _types(values.dtype)[0], _space(values.shape), _link_kind(name.isascii())
    made = h5d.create(parent, name.encode(), kind, space, stored, link)
    for number, part in enumerate(parts):
        made.write_direct_chunk((number * rows, *(0,) * (values.ndim - 1)), part)
    if data.stored and not parts:
        made.write(h5s.ALL, h5s.ALL, values)
    return made


def _deflated(values: NDArray[Any]) -> tuple[int, list[bytes]]:
    """Return an array in compressed chunks and their number of rows.

    No chunks if compression gains too little.
    """
    from photogram.images.tiff import deflate  # which has the faster of two programs for it

    def deflated(part: NDArray[Any]) -> bytes:
        shuffled = np.ascontiguousarray(part.reshape(-1).view(np.uint8).reshape(-1, values.itemsize).T)
        return bytes(deflate.compress(shuffled, 1))

    sample = values.reshape(-1)[: SAMPLE_BYTES // values.itemsize]
    if len(deflated(sample)) > WORTH_IT * sample.nbytes:
        return 0, []
    rows = max(1, min(len(values), CHUNK_BYTES * len(values) // values.nbytes))
    whole = np.zeros((-len(values) % rows, *values.shape[1:]), values.dtype)  # padding of the last chunk
    parts = [values[first : first + rows] for first in range(0, len(values), rows)]
    if len(whole):
        parts[-1] = np.concatenate([parts[-1], whole])
    return rows, list(map(deflated, parts))


def _write_attribute(holder: Any, name: str, value: Any, kind: str = "") -> None:
    """Write a text, a number or an array as a new attribute."""
    values = np.asarray(value, dtype=TEXT if isinstance(value, str) else None, order="C")
    in_file, in_memory = _types(values.dtype, kind)
    made = h5a.create(holder, name.encode(), in_file, _space(values.shape))
    made.write(values, mtype=in_memory)


@cache
def _plain() -> Any:
    """Return the creation properties of a data set, without its time of creation."""
    kind = h5p.create(h5p.DATASET_CREATE)
    kind.set_obj_track_times(False)
    kind.set_attr_creation_order(0)
    return kind


@cache
def _group_kind(track_order: bool) -> Any:
    """Return the creation properties of a group, without its time of creation."""
    kind, order = h5p.create(h5p.GROUP_CREATE), h5p.CRT_ORDER_TRACKED | h5p.CRT_ORDER_INDEXED
    kind.set_obj_track_times(False)
    if track_order:
        kind.set_link_creation_order(order)
        kind.set_attr_creation_order(order)
    return kind


@cache
def _link_kind(plain: bool) -> Any:
    """Return the creation properties of a link; names other than ASCII are UTF-8."""
    kind = h5p.create(h5p.LINK_CREATE)
    kind.set_char_encoding(h5t.CSET_ASCII if plain else h5t.CSET_UTF8)
    return kind


@lru_cache(1000)
def _space(shape: tuple[int, ...]) -> Any:
    """Return the HDF5 data space of a shape."""
    return h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR)


@cache
def _types(kind: np.dtype[Any], of: str = "") -> tuple[Any, Any]:
    """Return the types of values in the file and in memory.

    Objects are texts, or references if `of` is given; bytes end with a zero. numpy's metadata of object types are
    ignored by its comparison.
    """
    if kind.kind == "S":
        ended = h5t.C_S1.copy()
        ended.set_size(kind.itemsize + 1)
        return ended, h5t.py_create(kind)
    if kind.kind == "O":
        kind = LISTS if of else TEXT
    return h5t.py_create(kind, logical=True), h5t.py_create(kind)
