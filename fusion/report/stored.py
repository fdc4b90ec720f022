"""Data sets and attributes of HDF5 files: results have thousands, so each is made with the few calls that it needs.

What readers find is what h5py's `create_dataset` and `attrs` would have made, to the byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5p, h5s, h5t
from numpy.typing import NDArray


@cache
def _plain() -> Any:
    """How a data set is stored that is not compressed: without the time when it was made."""
    kind = h5p.create(h5p.DATASET_CREATE)
    kind.set_obj_track_times(False)
    kind.set_attr_creation_order(0)
    return kind


@cache
def _text_type() -> tuple[Any, Any]:
    """Texts of any length as UTF-8: in the file, and in memory."""
    kind = h5py.string_dtype()
    return h5t.py_create(kind, logical=True), h5t.py_create(kind)


@cache
def _one() -> Any:
    """Room for one value."""
    return h5s.create(h5s.SCALAR)


@cache
def _number_type(kind: np.dtype[Any]) -> Any:
    return h5t.py_create(kind, logical=True)


def put_array(group: h5py.Group, name: str, values: NDArray[Any]) -> Any:
    """Write an array of numbers as a new data set of a group, and return its identifier."""
    values = np.asarray(values, order="C")
    space = h5s.create_simple(values.shape)
    made = h5d.create(group.id, name.encode(), _number_type(values.dtype), space, _plain())
    made.write(h5s.ALL, h5s.ALL, values)
    return made


def put_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> Any:
    """Write texts (N,) as a new data set of a group, and return its identifier."""
    values = np.array(texts, dtype=object).view(h5py.string_dtype())
    made = h5d.create(group.id, name.encode(), _text_type()[0], h5s.create_simple(values.shape), _plain())
    made.write(h5s.ALL, h5s.ALL, values)
    return made


def put_axis(group: h5py.Group, name: str, length: int) -> Any:
    """Make a new data set that is nothing but the length of an axis, and return its identifier."""
    return h5d.create(group.id, name.encode(), h5t.IEEE_F32BE, h5s.create_simple((length,)), _plain())


def put_text(holder: Any, name: str, text: str) -> None:
    """Write a text as a new attribute of what has this identifier."""
    kept, given = _text_type()
    value = np.array(text, dtype=object).view(h5py.string_dtype())
    h5a.create(holder, name.encode(), kept, _one()).write(value, mtype=given)
