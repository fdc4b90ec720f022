"""Single numbers of a certificate: those of rotate, identify and step."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from fusion.errors import InputError
from fusion.recording.toml import read_rows
from fusion.report.folder import Provenance, provenance_of
from fusion.report.h5 import open_results, read_notices
from fusion.report.table import capitalise
from fusion.sensor import result_notices as declared
from shaker.identification.sensitivity import LABELS as CHAIN_LABELS
from shaker.lti.indices import LABELS
from shakercal._common.notices import Notice

# Single numbers, from the tables of rotate, identify and step.


LARGEST_TABLE = 20_000_000  # bytes


@dataclass(frozen=True)
class CertifiedNumber:
    """A number of a certificate: name, type of quantity, value, U, k and unit."""

    name: str
    kind: str
    value: float
    expanded: float
    k: float
    unit: str


@dataclass(frozen=True)
class NumberList:
    """One list of a certificate: numbers of a component, or masses of a rotation test."""

    name: str
    numbers: tuple[CertifiedNumber, ...]


@dataclass(frozen=True)
class CertifiedCommand:
    """A command with certified numbers: its files, and title and method of its certificate."""

    table: str
    file: str
    title: str
    method: str


CERTIFIED_COMMANDS: Mapping[str, CertifiedCommand] = {
    "rotate": CertifiedCommand(
        "rotation.csv", "rotation.h5", "Masses and centres of mass",
        "The item with its load is rotated in gravity on an indexing head and read at rest. Masses and centres of mass "
        "follow from the change of its outputs with the orientation.",
    ),
    "identify": CertifiedCommand(
        "parameters.csv", "identify.h5", "Mechanical parameters",
        "The frequency responses of the item on a shaker are measured under several loads. Springs, dampers and masses "
        "of a model are identified from all of them together.",
    ),
    "step": CertifiedCommand(
        "indices.csv", "step.h5", "Dynamic indices",
        "A known static load on the item is released suddenly. Gain, frequencies and damping ratios follow from a "
        "model of its response.",
    ),
}  # fmt: skip
QUANTITY_TYPES = {
    "stiffness": "Stiffness of the sensor's spring",
    "dampingCoefficient": "Coefficient of the sensor's viscous damper",
    "dampingRatio": "Damping ratio of a mode",
    "mass": "Mass",
    "centreOfMass": "Coordinate of a centre of mass in the sensor frame",
    "timeConstant": "Time constant of the sensor or its measuring chain",
    "frequency": "Natural or resonance frequency, or limit of a frequency band",
    "staticSensitivity": "Output per force or moment that does not change",
    "duration": "Rise or settling time of the step response",
    "inertia": "Moment of inertia",
    "index": "Another index of a dynamic response, or parameter of its model",
}
"""Types of quantities with their description, without prefix."""
BEGINNINGS = {
    "stiffness": "stiffness", "damping_ratio": "dampingRatio", "damping": "dampingCoefficient",
    "internal_mass": "mass", "load_mass": "mass", "internal_centre_of_mass": "centreOfMass",
    "load_centre_of_mass": "centreOfMass", "lag": "timeConstant", "frequency": "frequency",
    "usable_band": "frequency", "internal_inertia": "inertia", "sensitivity": "staticSensitivity",
    "spring_time": "timeConstant", "delay": "timeConstant", "static_gain": "staticSensitivity",
    "read_static_gain": "staticSensitivity",
}  # fmt: skip
"""Types of numbers by the beginning of their names; a longer beginning precedes a shorter one."""
CERTIFIED_BY_ROTATION = ("internal_mass", "internal_centre_of_mass", "load_mass", "load_centre_of_mass")
"""Numbers of a rotation test; its differences and deviations are checks."""


def find_results_folder(folder: Path, results: Path | None) -> Path:
    """Return the folder of results: as given, else that of `run`, else of another command."""
    if results is not None:
        return results
    candidates = (folder / name for name in ("results", *CERTIFIED_COMMANDS))
    return next((path for path in candidates if path.is_dir()), folder / "results")


def find_command(folder: Path) -> str | None:
    """Return the command that wrote numbers to a folder, None without one."""
    return next((command for command, source in CERTIFIED_COMMANDS.items() if (folder / source.file).is_file()), None)


def read_certified_numbers(folder: Path, command: str, *, least_k: float) -> tuple[NumberList, ...]:
    """Return the numbers of a command's table by list, with the table's k or `least_k`."""
    file = folder / CERTIFIED_COMMANDS[command].table
    _, rows = read_rows(file, LARGEST_TABLE, f"the table of shakercal {command}")
    lists: dict[str, list[CertifiedNumber]] = {}
    for line, row in enumerate(rows, 2):
        try:
            where, name = _list_and_name(command, row)
            if not name:
                continue
            value, u, table_k = (float(row[column]) for column in ("value", "u", "k"))
            factor, unit = max(table_k, least_k), row["unit"]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                declared.DAMAGED_RESULT_TABLE, file, f"line {line}", command=command, reason=str(error)
            ) from error
        if np.isfinite([value, u, factor]).all() and u > 0.0:
            named = _words(name, command), _kind(name, unit)
            lists.setdefault(where, []).append(CertifiedNumber(*named, value, factor * u, factor, unit))
    if not lists:
        expected = f"a number with an uncertainty in the results of shakercal {command}"
        raise InputError(declared.NO_CERTIFIABLE_RESULT, file, expected=expected)
    return tuple(NumberList(where, tuple(found)) for where, found in lists.items())


def _list_and_name(command: str, row: Mapping[str, str]) -> tuple[str, str]:
    """Return list and name of a row; the name is empty if not certified."""
    name, component = row["name"], row["component"].lstrip("'")
    if command == "rotate":
        axis = f" {component}" if component in "xyz" else ""
        is_certified = name in CERTIFIED_BY_ROTATION and row["recording"] == "all" and (axis or component == "joint")
        where = "Masses and centres of mass of the item and its load"
        return where, f"{name}{axis}" if is_certified else ""
    if command == "identify":
        return f"Mechanics along {component}", "" if "stated beforehand" in row["method"] else name
    is_driven = row["channel"] == component
    return f"Response of {row['channel']} to a step of {component}", name if is_driven else ""


def _words(name: str, command: str) -> str:
    """Return the printed name of a number."""
    labels = {"step": LABELS, "identify": CHAIN_LABELS}.get(command, {})
    text = labels.get(name, name.replace("read_static_gain", "static gain as read from the records"))
    text = re.sub("^(?=b/k)", "ratio ", re.sub("^lag_", "b/k, ", text))
    return capitalise(text.replace("usable_band", "usable up to").replace("_", " "))


def _kind(name: str, unit: str) -> str:
    """Return the type of a number: by its name, else by its unit."""
    by_name = next((kind for beginning, kind in BEGINNINGS.items() if name.startswith(beginning)), "")
    return by_name or {"Hz": "frequency", "s": "duration"}.get(unit, "index")


def select_recordings(recordings: Sequence[Path], folder: Path, command: str) -> list[Path]:
    """Return the recordings behind the numbers of a folder, all if none is named."""
    inputs = [f"/{name}" for name in read_results_origin(folder, command)[0].input_hashes]
    names = {path: f"/{path.resolve().parent.name}/{path.name}" for path in recordings}
    behind = [path for path, end in names.items() if any(end.endswith(name) or name.endswith(end) for name in inputs)]
    return behind or list(recordings)


def read_results_origin(folder: Path, command: str) -> tuple[Provenance, tuple[Notice, ...], tuple[str, ...]]:
    """Return provenance, notices and coverage of the results in a folder."""
    with open_results(folder / CERTIFIED_COMMANDS[command].file) as file:
        return provenance_of(file), read_notices(file), tuple(_scopes(file))


def _scopes(file: h5py.File) -> Iterator[str]:
    """Yield the coverage of U of every component."""
    named: dict[tuple[str, str], list[str]] = {}
    for name, group in [*file.items()]:
        if group.attrs.get("scope"):
            named.setdefault((group.attrs["scope"], group.attrs.get("outside", "")), []).append(name)
    for (scope, outside), names in named.items():
        excluded = f" and does not include {outside}" if outside else ""
        yield f"{', '.join(names)}: U applies {scope}{excluded}."


def quantity_types(lists: Sequence[NumberList]) -> dict[str, str]:
    """Return the types of quantities of the numbers, with descriptions."""
    used = dict.fromkeys(figure.kind for one in lists for figure in one.numbers)
    return {kind: QUANTITY_TYPES[kind] for kind in used}
