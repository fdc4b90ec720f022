"""Data classes and uncertainties in HDF5 files; groups and names are those of the classes.

Results are collected in memory as `Group` and `Data`, described as a whole, and then written. `items()` and `values()`
of h5py hold its lock while they are iterated: a loop that an error leaves would block other threads. Take a list first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, get_args

import h5py
import numpy as np
from h5py import h5d, h5o

from fusion.errors import InputError
from fusion.estimation.uncertainty import Contribution, Distribution, Influence, Kind, Scope, Uncertainty
from fusion.report.dataset_descriptions import describe
from fusion.report.h5_tree import TEXT, Group, write_tree
from fusion.report.report_notices import DAMAGED_RESULTS, OTHER_STRUCTURE, RESULTS_TOO_LARGE
from shaker.io.channel import check_inside, check_links, full_name, open_hdf5
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.sensitivity.input_evidence import InputEvidence

LEFT_OUT = {"manifest", "reference_image", "surface", "settings", "versions", "input_hashes"}
"""Fields that the inputs contain, or that the group `provenance` contains."""
EVIDENCE = "evidence"
"""Group of the unknowns that certificates and files state."""
INFLUENCE_TEXTS = ("name", "label", "unit", "scope", "type", "distribution")
INFLUENCE_NUMBERS = ("u", "dof")


# Files.


def h5_content(fill: Callable[[Any], None], *, in_order: bool = True) -> bytes:
    """Return the bytes of an HDF5 file that `fill` writes in memory.

    Equal input gives equal bytes. `in_order` (results): `fill` gets a `Group`; the file keeps the order of the groups
    and describes every data set. Otherwise `fill` gets h5py's file.
    """
    with h5py.File("in memory", "w", driver="core", backing_store=False, track_order=in_order) as file:
        if in_order:
            top = Group()
            fill(top)
            describe(top)
            write_tree(file, top)
        else:
            fill(file)
        file.flush()
        return bytes(file.id.get_file_image())


@contextmanager
def open_results(path: Path, *only: str) -> Iterator[h5py.File]:
    """Open the results of an earlier run.

    Raise `InputError` if they are damaged or link to other files.

    `only`: groups that will be read; only these are checked. A campaign reads a tenth of the data of each recording.
    """
    try:
        with open_hdf5(path, links=bool(only)) as file:
            for name in only:
                _check_group(path, file, name.split("/"))
            if not only:
                _check_all(path, file)
            yield file
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split()).removeprefix(f"{path}: ")
        raise InputError(DAMAGED_RESULTS, path, reason=reason) from error
    except MemoryError as error:
        raise InputError(RESULTS_TOO_LARGE, path) from error
    except (AttributeError, TypeError, IndexError) as error:  # a group where numbers should be, or the other way round
        raise InputError(OTHER_STRUCTURE, path) from error


def _check_all(path: Path, group: h5py.Group) -> None:
    """Refuse results with data sets whose samples are in other files."""

    def check(name: bytes, what: Any) -> None:
        if what.type == h5o.TYPE_DATASET:
            made = h5o.open(group.id, name).get_create_plist()
            if made.get_layout() == h5d.VIRTUAL or made.get_external_count():
                check_inside(path, full_name(group, name), group[name])

    h5o.visit(group.id, check, info=True)


def _check_group(path: Path, group: h5py.Group, names: Sequence[str]) -> None:
    """Refuse results if a group, or anything below it, is in another file."""
    for name in names:
        link = group.get(name, getlink=True)
        if link is None:
            return
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f'{path}: "{name}": expected samples in this file, found a link')
        group = group[name]
    if isinstance(group, h5py.Dataset):  # an empty list
        check_inside(path, "/".join(names), group)
    else:
        check_links(path, group, soft=False)
        _check_all(path, group)


def write_fields(group: Group, item: Any) -> None:
    """Write every field of a data class into a group.

    The name of a data set is `dataset` of the field's metadata, by default that of the field.
    """
    for field in fields(item):
        if field.name not in LEFT_OUT:
            write_value(group, field.metadata.get("dataset", field.name), getattr(item, field.name))


def write_value(group: Group, name: str, value: Any) -> None:
    """Write one value into a group.

    Data classes and mappings become groups, arrays and tuples data sets, scalars attributes.
    """
    if value is None:
        return
    if isinstance(value, Uncertainty):
        write_uncertainty(group.create_group(name, track_order=True), value)
    elif is_dataclass(value):
        write_fields(group.create_group(name, track_order=True), value)
    elif isinstance(value, Mapping):
        inner = group.create_group(name, track_order=True)
        for key, entry in value.items():
            free = inner.free_name(str(key))
            write_value(inner, free, entry)
            if free in inner and free != key:
                inner[free].attrs.setdefault("label", str(key))
    elif isinstance(value, np.ndarray):
        group[name] = value
    elif isinstance(value, tuple | list):
        _write_sequence(group, name, value)
    else:
        group.attrs[name] = value.as_posix() if isinstance(value, PurePath) else value


def _write_sequence(group: Group, name: str, items: Sequence[Any]) -> None:
    """Write a list of items.

    Data classes become groups or a table, lists of texts are numbered, others are one data set.
    """
    if items and all(isinstance(item, Notice) for item in items):
        inner = group.create_group(name, track_order=True)
        rows = [item.as_row() for item in items]
        for column in rows[0]:
            _write_sequence(inner, column, [row[column] for row in rows])
    elif items and all(_is_row(item) and type(item) is type(items[0]) for item in items):
        inner = group.create_group(name, track_order=True)
        for field in fields(items[0]):
            _write_sequence(inner, field.name, [getattr(item, field.name) for item in items])
    elif any(is_dataclass(item) for item in items):
        inner = group.create_group(name, track_order=True)
        for number, item in enumerate(items):
            write_value(inner, inner.free_name(_label(item, number)), item)
    elif any(isinstance(item, tuple | list) and any(isinstance(inner, str) for inner in item) for item in items):
        inner = group.create_group(name, track_order=True)
        for number, item in enumerate(items):
            _write_sequence(inner, f"{number:03d}", item)
    elif all(isinstance(item, str) for item in items):
        group[name] = np.array(items, dtype=TEXT)
    else:
        group[name] = np.asarray(items)


def _is_row(item: Any) -> bool:
    """Return whether an item is a data class of texts and numbers only."""
    return is_dataclass(item) and all(
        isinstance(getattr(item, field.name), str | int | float | complex) for field in fields(item)
    )


def _label(item: Any, number: int) -> str:
    """Return the name of a list entry, or its number if it has no name."""
    if hasattr(item, "body") and hasattr(item, "source"):
        return f"{item.body}-{item.source}"
    names = [getattr(item, key) for key in ("daq", "name") if isinstance(getattr(item, key, None), str)]
    others = (getattr(item, key, None) for key in ("label", "instrument"))
    names = names or [name for name in others if isinstance(name, str)]
    return "-".join(names) if names else f"{number:03d}"


def write_uncertainty(group: Group, uncertainty: Uncertainty) -> None:
    """Write an uncertainty into a group so that `read_uncertainty` returns it bit by bit.

    `random/LABEL`: covariance (K, 2C, 2C) and dof (K,) of each random contribution; `name`, `label`, `u`, `unit`,
    `scope`, `type`, `distribution`, `dof` (E,) and `effect` (E, K, 2C) of the influences; `covariance` (K, 2C, 2C):
    total.
    """
    random = group.create_group("random", track_order=True)
    for part in uncertainty.random:
        contribution = random.create_group(random.free_name(part.label))
        contribution.attrs["label"] = part.label
        contribution.attrs["type"] = part.type
        contribution["covariance"] = part.covariance
        if part.dof is not None:
            contribution["dof"] = part.dof
    for field in INFLUENCE_TEXTS:
        group[field] = np.array([getattr(influence, field) for influence in uncertainty.influences], dtype=TEXT)
    for field in INFLUENCE_NUMBERS:
        numbers = [getattr(influence, field) for influence in uncertainty.influences]
        group[field] = np.array(numbers, dtype=np.float64)
    shape = (0, *uncertainty.random[0].covariance.shape[:2])
    effects = [influence.effect for influence in uncertainty.influences]
    group["effect"] = np.stack(effects) if effects else np.zeros(shape)
    group["covariance"] = uncertainty.covariance


def read_uncertainty(group: h5py.Group) -> Uncertainty:
    """Return the `Uncertainty` that `write_uncertainty` wrote into a group."""
    random = []
    for part in [*group["random"].values()]:
        dof = read_numbers(part["dof"]) if "dof" in part else None
        kind = _choice("type", part.attrs["type"], Kind)
        random.append(Contribution(str(part.attrs["label"]), kind, read_numbers(part["covariance"]), dof))
    # Thousands of recordings have the same names.
    *columns, shapes = [list(map(sys.intern, group[field].asstr()[()].tolist())) for field in INFLUENCE_TEXTS]
    u = read_numbers(group["u"])
    numbers = u, read_numbers(group["dof"]) if "dof" in group else np.full(len(u), np.inf)
    if np.isnan(numbers[1]).any():
        raise ValueError(f"{group.name}/dof: expected numbers, found nan")
    influences = []
    rows = zip(*columns, *numbers, read_numbers(group["effect"]), shapes, strict=True)
    for name, label, unit, scope, kind, u, dof, effect, shape in rows:
        kinds = _choice("scope", scope, Scope), _choice("type", kind, Kind)
        fields_of = *kinds, float(dof), _choice("distribution", shape, Distribution)
        influences.append(Influence(name, label, float(u), unit, effect, *fields_of))
    return Uncertainty(tuple(random), tuple(influences))


def read_numbers(stored: h5py.Dataset, kinds: str = "fiu") -> Any:
    """Return the numbers of a data set whose numpy kind is one of `kinds`."""
    if stored.dtype.kind not in kinds:
        raise ValueError(f"{stored.name}: expected numbers of kind {kinds}, found {stored.dtype}")
    return stored[()]


def read_notices(file: h5py.File) -> tuple[Notice, ...]:
    """Return the notices of open results, empty if there are none."""
    group = file.get("notices", {})
    names = [one.name for one in fields(Notice) if one.name in group] if len(group) else []
    columns = [group[name].asstr()[()].tolist() for name in names]
    return tuple(Notice.from_row(dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True))


def read_evidence(file: h5py.File) -> tuple[InputEvidence, ...]:
    """Return the unknowns of open results that certificates and files state.

    Empty if there are none.
    """
    from fusion.sensitivity.input_evidence import InputEvidence

    if EVIDENCE not in file:
        return ()
    group = file[EVIDENCE]
    numbers = ("value", "u")
    columns = (
        group[field.name][()].tolist() if field.name in numbers else group[field.name].asstr()[()].tolist()
        for field in fields(InputEvidence)
        if field.name in group or field.name != "valid_until"  # results of earlier versions
    )
    return tuple(InputEvidence(*row) for row in zip(*columns, strict=True))


def _choice(what: str, text: object, choices: Any) -> Any:
    """Return a text that is one of the choices."""
    if text not in get_args(choices):
        raise ValueError(f"{what}: expected one of {get_args(choices)}, found {text!r}")
    return text
