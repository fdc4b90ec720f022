"""Groups, data sets and attributes in memory, and their HDF5 file.

HDF5 answers queries as slowly as it writes; therefore results are collected in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

DEFLATE_ABOVE = 512
"""Number of values above which an array is compressed."""
TEXT = h5py.string_dtype()


class Data:
    """Data set of numbers, or of texts as objects, of any shape.

    `scales`: by axis, the data set of the coordinates; `scale`: its name as a coordinate, empty if it is none.
    """

    def __init__(self, values: ArrayLike) -> None:
        values = np.asarray(values)
        self.values = values.astype(TEXT) if values.dtype.kind in "UO" else values
        self.attrs: dict[str, Any] = {}
        self.scales: dict[int, Data] = {}
        self.scale = ""
        self.stored: Any = None

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


def write_tree(file: h5py.Group, top: Group) -> None:
    """Write a group and all its contents into an open, empty file."""
    _write_group(file, top)
    datasets = [data for _, _, data in top.datasets()]
    for data in datasets:
        if data.scale:
            data.stored.make_scale(data.scale)
    for data in datasets:
        for axis, scale in data.scales.items():
            data.stored.dims[axis].attach_scale(scale.stored)


def _write_group(target: h5py.Group, group: Group) -> None:
    """Write the contents of a group into an open HDF5 group."""
    for name, item in group.inside.items():
        if isinstance(item, Group):
            _write_group(target.create_group(name, track_order=item.track_order), item)
            continue
        deflate = item.numbers and item.values.size > DEFLATE_ABOVE
        look: dict[str, Any] = {"compression": 1, "shuffle": True} if deflate else {}
        item.stored = target.create_dataset(name, data=item.values, **look)
        item.stored.attrs.update(item.attrs)
    target.attrs.update(group.attrs)
