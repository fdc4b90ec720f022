"""result.h5 written and read back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import count
from pathlib import Path, PurePath
from typing import Any, cast, get_args

import h5py
import numpy as np

from fusion.base import InputError
from fusion.campaign.repeats import Drive, line_drives
from fusion.estimation.uncertainty import Contribution, Influence, Kind, Scope, Uncertainty
from fusion.recording.load import Manifest
from fusion.report.provenance import RESULT_FILE, Provenance, read_provenance, write_provenance
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.load import LoadResult, Outputs
from shaker.arrays import FloatArray, Notice
from shaker.sine.phasor import Phasors

# result.h5: the whole evaluation, every covariance written out; the groups and names are those of the data classes.


FORMAT = 2
COMPRESS_ABOVE = 512
LEFT_OUT = {"manifest", "reference_image", "settings", "versions", "input_hashes"}
"""Fields that are in the inputs, or stand in the group `provenance`."""
SENSOR_FIELDS = (
    "name",
    "serial",
    "channels",
    "unit",
    "sense",
    "capacity",
    "static_sensitivity",
    "static_sensitivity_uncertainty",
)
INFLUENCE_TEXTS = ("name", "label", "unit", "scope", "type")


def write_h5(path: Path, evaluation: Evaluation, files: Sequence[str]) -> None:
    """Write the evaluation and its provenance to a new HDF5 file; `files` are the names of all result files."""
    origin = Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(files))
    with h5py.File(path, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["recording"] = evaluation.manifest.name
        file.attrs["rig"] = evaluation.manifest.rig.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, origin)
        _write_subject(file, evaluation.manifest)
        write_fields(file, evaluation)


def _write_subject(file: h5py.File, manifest: Manifest) -> None:
    """Write what was driven, how it was mounted, and which sensor was tested: what a campaign has to know."""
    file.attrs["mounting"] = manifest.mounting
    driven = file.create_group("excitation")
    for name in ("kind", "direction", "frequencies"):
        write_value(driven, name, getattr(manifest.excitation, name))
    if manifest.rig.sensor is not None:
        sensor = file.create_group("sensor")
        for name in SENSOR_FIELDS:
            write_value(sensor, name, getattr(manifest.rig.sensor, name))


def write_fields(group: h5py.Group, item: Any) -> None:
    """Write every field of a data class into a group: groups and names are those of the classes."""
    for field in fields(item):
        if field.name not in LEFT_OUT:
            write_value(group, field.name, getattr(item, field.name))


def write_value(group: h5py.Group, name: str, value: Any) -> None:
    """Write one value: data classes and mappings as groups, arrays and tuples as datasets, scalars as attributes."""
    if value is None:
        return
    if isinstance(value, Uncertainty):
        write_uncertainty(group.create_group(name, track_order=True), value)
    elif is_dataclass(value):
        write_fields(group.create_group(name, track_order=True), value)
    elif isinstance(value, Mapping):
        inner = group.create_group(name, track_order=True)
        for key, entry in value.items():
            write_value(inner, str(key), entry)
    elif isinstance(value, np.ndarray):
        _write_array(group, name, value)
    elif isinstance(value, tuple | list):
        _write_sequence(group, name, value)
    else:
        group.attrs[name] = value.as_posix() if isinstance(value, PurePath) else value


def _write_sequence(group: h5py.Group, name: str, items: Sequence[Any]) -> None:
    """Write data classes as groups or as a table, lists of texts numbered, the rest as one dataset."""
    if items and all(_is_row(item) and type(item) is type(items[0]) for item in items):
        inner = group.create_group(name, track_order=True)
        for field in fields(items[0]):
            _write_sequence(inner, field.name, [getattr(item, field.name) for item in items])
    elif any(is_dataclass(item) for item in items):
        inner = group.create_group(name, track_order=True)
        for number, item in enumerate(items):
            write_value(inner, _free_name(inner, _label(item, number)), item)
    elif any(isinstance(item, tuple | list) and any(isinstance(inner, str) for inner in item) for item in items):
        inner = group.create_group(name, track_order=True)
        for number, item in enumerate(items):
            _write_sequence(inner, f"{number:03d}", item)
    elif all(isinstance(item, str) for item in items):
        group.create_dataset(name, data=np.array(items, dtype=object), dtype=h5py.string_dtype())
    else:
        _write_array(group, name, np.asarray(items))


def _is_row(item: Any) -> bool:
    """Whether an item is a data class of texts and numbers only: a row of a table with one dataset per field."""
    return is_dataclass(item) and all(
        isinstance(getattr(item, field.name), str | int | float | complex) for field in fields(item)
    )


def _label(item: Any, number: int) -> str:
    """Name of one entry of a list: its own where it has one, else its place."""
    if hasattr(item, "body") and hasattr(item, "source"):
        return f"{item.body}-{item.source}"
    own = [getattr(item, key) for key in ("daq", "name") if isinstance(getattr(item, key, None), str)]
    own = own or [getattr(item, key) for key in ("label", "instrument") if isinstance(getattr(item, key, None), str)]
    return "-".join(own) if own else f"{number:03d}"


def write_uncertainty(group: h5py.Group, uncertainty: Uncertainty) -> None:
    """Write an uncertainty into a group, so that `fusion.report.h5.read_uncertainty` returns it to the last bit.

    `random/LABEL`: covariance (K, 2C, 2C) and dof (K,) of each random contribution; `name`, `label`, `u`, `unit`,
    `scope`, `type` (E,) and `effect` (E, K, 2C) of the influences; `covariance` (K, 2C, 2C): of everything together.
    """
    random = group.create_group("random", track_order=True)
    for part in uncertainty.random:
        _write_contribution(random.create_group(_free_name(random, part.label)), part)
    for field in INFLUENCE_TEXTS:
        texts = [getattr(influence, field) for influence in uncertainty.influences]
        group.create_dataset(field, data=np.array(texts, dtype=object), dtype=h5py.string_dtype())
    group.create_dataset("u", data=np.array([influence.u for influence in uncertainty.influences], dtype=np.float64))
    shape = (0, *uncertainty.random[0].covariance.shape[:2])
    effects = [influence.effect for influence in uncertainty.influences]
    _write_array(group, "effect", np.stack(effects) if effects else np.zeros(shape))
    _write_array(group, "covariance", uncertainty.covariance)


def _write_contribution(group: h5py.Group, part: Contribution) -> None:
    """Write one random contribution."""
    group.attrs["label"] = part.label
    group.attrs["type"] = part.type
    _write_array(group, "covariance", part.covariance)
    if part.dof is not None:
        group.create_dataset("dof", data=part.dof)


def _free_name(group: h5py.Group, label: str) -> str:
    """Name of a group that no other has: the label without the separator of paths, numbered where it is taken."""
    name = label.replace("/", "_")
    candidates = (name if number == 1 else f"{name} ({number})" for number in count(1))
    return next(candidate for candidate in candidates if candidate not in group)


def _write_array(group: h5py.Group, name: str, array: np.typing.NDArray[Any]) -> None:
    """Write an array, compressed where that is worth it."""
    if array.size > COMPRESS_ABOVE:
        group.create_dataset(name, data=array, compression="gzip", compression_opts=4, shuffle=True)
    else:
        group.create_dataset(name, data=array)


# Result files read back: what a campaign needs of every recording, exactly as it was evaluated.


@dataclass(frozen=True)
class SensorFacts:
    """The sensor that was tested: `channels`, their `unit`, rated loads and static sensitivity where they are stated.

    `capacity` (6,) in N and N.m; `static` (all channels, 6) in unit/N and unit/(N.m) with the relative standard
    uncertainty `u_static`.
    """

    name: str
    serial: str
    channels: tuple[str, ...]
    unit: str
    sense: str
    capacity: FloatArray | None
    static: FloatArray | None
    u_static: float


@dataclass(frozen=True)
class Recorded:
    """One recording's results, read from its folder.

    `kind`, `direction`, `frequencies` of the excitation as they were stated; `drives`: its driven lines with load and
    outputs, none where there was no load, no output or no stated direction; `notices` of its own report.
    """

    folder: str
    name: str
    mounting: str
    rig: str
    kind: str
    direction: tuple[float, ...]
    frequencies: tuple[float, ...]
    sensor: SensorFacts | None
    drives: tuple[Drive, ...]
    notices: tuple[Notice, ...]
    origin: Provenance


def read_drives(folder: Path) -> tuple[Drive, ...]:
    """Return the driven lines of the recording whose results lie in `folder`, to the last bit those of `drives_of`."""
    return read_recorded(folder).drives


def read_recorded(folder: Path) -> Recorded:
    """Return what a campaign needs of the recording whose results lie in `folder`."""
    origin = read_provenance(folder)
    if origin is None:
        raise InputError(folder / RESULT_FILE, "", found="no results", expected="the results of a recording")
    with h5py.File(folder / RESULT_FILE, "r") as file:
        if file.attrs["format"] != FORMAT:
            found, expected = f"format {file.attrs['format']}", f"format {FORMAT}; --force evaluates the recording anew"
            raise InputError(folder / RESULT_FILE, "", found=found, expected=expected)
        driven = file["excitation"]
        return Recorded(
            folder=folder.name,
            name=str(file.attrs["recording"]),
            mounting=str(file.attrs["mounting"]),
            rig=str(file.attrs["rig"]),
            kind=str(driven.attrs["kind"]),
            direction=_numbers(driven, "direction"),
            frequencies=_numbers(driven, "frequencies"),
            sensor=_sensor(file["sensor"]) if "sensor" in file else None,
            drives=_drives(file),
            notices=_notices(file),
            origin=origin,
        )


def read_uncertainty(group: h5py.Group) -> Uncertainty:
    """Return the `Uncertainty` that `fusion.report.h5.write_uncertainty` put into a group, to the last bit."""
    random = tuple(_read_contribution(part) for part in group["random"].values())
    texts = {field: group[field].asstr()[()] for field in ("name", "label", "unit", "scope", "type")}
    u, effect = group["u"][()], group["effect"][()]
    return Uncertainty(random, tuple(_influence(texts, e, float(u[e]), effect[e]) for e in range(len(u))))


def _drives(file: h5py.File) -> tuple[Drive, ...]:
    """The driven lines, from load and outputs as they were stored."""
    direction = _numbers(file["excitation"], "direction")
    if "load" not in file or "outputs" not in file or not direction:
        return ()
    lines = file["lines"]
    return line_drives(
        str(file.attrs["recording"]),
        str(file.attrs["mounting"]),
        direction,
        lines["nominal_hz"][()],
        lines["multiple"][()],
        _load(file["load"]),
        _outputs(file["outputs"]),
    )


def _load(group: h5py.Group) -> LoadResult:
    """The load with its whole uncertainty; its notices stand among those of the recording."""
    uncertainty = read_uncertainty(group["uncertainty"])
    return LoadResult(group["frequency_hz"][()], group["value"][()], uncertainty, group["observed"][()], ())


def _outputs(group: h5py.Group) -> Outputs:
    """The outputs with their whole uncertainty."""
    inner = group["phasors"]
    phasors = Phasors(
        frequency_hz=inner["frequency_hz"][()],
        value=inner["value"][()],
        covariance=inner["covariance"][()],
        channels=tuple(inner["channels"].asstr()[()].tolist()),
        unit=tuple(inner["unit"].asstr()[()].tolist()),
        dof=inner["dof"][()],
    )
    return Outputs(phasors, read_uncertainty(group["uncertainty"]))


def _sensor(group: h5py.Group) -> SensorFacts:
    """What is stored of the sensor."""
    return SensorFacts(
        name=str(group.attrs["name"]),
        serial=str(group.attrs["serial"]),
        channels=tuple(group["channels"].asstr()[()].tolist()),
        unit=str(group.attrs["unit"]),
        sense=str(group.attrs["sense"]),
        capacity=group["capacity"][()] if "capacity" in group else None,
        static=group["static_sensitivity"][()] if "static_sensitivity" in group else None,
        u_static=float(group.attrs["static_sensitivity_uncertainty"]),
    )


def _notices(file: h5py.File) -> tuple[Notice, ...]:
    """Notices of the recording."""
    group = file["notices"]
    if not isinstance(group, h5py.Group):
        return ()
    columns = [group[name].asstr()[()].tolist() for name in ("severity", "text", "where")]
    return tuple(Notice(*row) for row in zip(*columns, strict=True))


def _numbers(group: h5py.Group, name: str) -> tuple[float, ...]:
    """A list of numbers, empty where it is not stored."""
    return tuple(group[name][()].tolist()) if name in group else ()


def _read_contribution(group: h5py.Group) -> Contribution:
    """One random contribution."""
    dof = group["dof"][()] if "dof" in group else None
    return Contribution(str(group.attrs["label"]), _kind(group.attrs["type"]), group["covariance"][()], dof)


def _influence(texts: Mapping[str, Any], place: int, u: float, effect: FloatArray) -> Influence:
    """One influence from its place in the packed arrays."""
    scope = texts["scope"][place]
    if scope not in get_args(Scope):
        raise ValueError(f"scope: expected one of {get_args(Scope)}, found {scope!r}")
    return Influence(
        name=texts["name"][place],
        label=texts["label"][place],
        u=u,
        unit=texts["unit"][place],
        effect=effect,
        scope=cast("Scope", scope),
        type=_kind(texts["type"][place]),
    )


def _kind(text: object) -> Kind:
    """Type A or B of an evaluation."""
    if text not in get_args(Kind):
        raise ValueError(f"type: expected one of {get_args(Kind)}, found {text!r}")
    return cast("Kind", text)
