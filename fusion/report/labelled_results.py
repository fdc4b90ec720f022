"""Results as labelled arrays with units and covariances, for NumPy, pandas and xarray."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.report.folder import RESULT_FILE, RESULT_FORMAT
from fusion.report.h5 import open_results, read_numbers, read_uncertainty
from fusion.report.report_notices import INCOMPLETE_RESULTS, NO_RESULTS, OTHER_FORMAT
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, sensitivity_unit
from shakercal._common.arrays import ComplexArray

CAMPAIGN_FILE = "campaign.h5"
READ = ("sensor", "sensitivity", "element", "accelerations", "load", "curves", "matrices")
"""Groups of a file that are read."""


@dataclass(frozen=True, repr=False)
class Results:
    """Results of a recording or campaign as labelled arrays.

    Attributes
    ----------
    name : name of the recording or campaign.
    path : the file that was read.
    sensitivity : ratios of a recording, or None.
    element : elements of the sensor, or None.
    acceleration : by `BODY-SOURCE`.
    load : load of a recording, or None.
    curve : curves of a campaign, one for each kind and driven component, including that of the matrix.
    matrix : matrices of a campaign, one for each frequency, 6C elements channel by channel.
    """

    name: str
    path: Path
    sensitivity: LabelledPhasors | None
    element: LabelledPhasors | None
    acceleration: dict[str, LabelledPhasors]
    load: LabelledPhasors | None
    curve: tuple[LabelledPhasors, ...]
    matrix: tuple[LabelledPhasors, ...]

    def __repr__(self) -> str:
        single = [found for found in (self.sensitivity, self.element, self.load) if found is not None]
        found = [*single, *self.acceleration.values(), *self.curve, *self.matrix]
        return "\n  ".join(
            [f"Results of {self.name}:", *map(repr, found)] if found else [f"Results of {self.name}: none"]
        )


def read_results(path: str | Path) -> Results:
    """Return the results of a run as labelled arrays with units.

    Parameters
    ----------
    path : str or Path
        Folder of results, or its `result.h5` or `campaign.h5`.

    Returns
    -------
    Results
        Sensitivity, elements, accelerations and load of a recording; curves and matrices of a campaign.

    Raises
    ------
    InputError
        The path has no results, or they are damaged, incomplete or of another format.

    Examples
    --------
    >>> from fusion import read_results
    >>> results = read_results("results/Fz-0080")  # doctest: +SKIP
    >>> results.load  # doctest: +SKIP
    load: 6 elements at 3 lines from 80 to 240 Hz in N, N.m
    >>> results.sensitivity.of("Fz", "Fz")  # doctest: +SKIP
    >>> results.sensitivity.to_dataframe()  # doctest: +SKIP
    """
    path = Path(path)
    files = [path] if path.is_file() else [path / name for name in (CAMPAIGN_FILE, RESULT_FILE)]
    file = next((file for file in files if file.is_file() and h5py.is_hdf5(file)), None)
    if file is None:
        raise InputError(NO_RESULTS, path, expected=f"{RESULT_FILE} or {CAMPAIGN_FILE}")
    with open_results(file, *READ) as content:
        if content.attrs.get("format") != RESULT_FORMAT or not {"recording", "campaign"} & set(content.attrs):
            found = f"format {content.attrs['format']}" if "format" in content.attrs else "another file"
            raise InputError(OTHER_FORMAT, file, found=found, expected=str(RESULT_FORMAT))
        try:
            return _results(content, file)
        except KeyError as error:
            raise InputError(INCOMPLETE_RESULTS, file, reason=str(error.args[0])) from error


def _results(file: h5py.File, path: Path) -> Results:
    curves, matrices = file.get("curves", {}), file.get("matrices", {})
    return Results(
        name=str(file.attrs.get("recording", file.attrs.get("campaign"))),
        path=path,
        sensitivity=_sensitivity(file["sensitivity"]) if "sensitivity" in file else None,
        element=_sensitivity(file["element"]) if "element" in file else None,
        acceleration={name: _motion(name, group) for name, group in [*file.get("accelerations", {}).items()]},
        load=_load(file["load"]) if "load" in file else None,
        curve=tuple(_curve(group) for group in _groups(curves)),
        matrix=tuple(_matrix(group) for group in _groups(matrices)),
    )


def _groups(parent: Any) -> Iterator[h5py.Group]:
    """Return the groups of a list in order."""
    return (group for group in [*parent.values()] if isinstance(group, h5py.Group)) if len(parent) else iter(())


def _texts(group: h5py.Group, name: str) -> tuple[str, ...]:
    return tuple(group[name].asstr()[()].tolist())


def _labelled(
    name: str, group: h5py.Group, value: ComplexArray, labels: Sequence[tuple[str, str, str]], kind: Sequence[str]
) -> LabelledPhasors:
    """Return the values of a group with their uncertainty.

    `labels`: channel, component and unit of each element.
    """
    channel, component, unit = zip(*labels, strict=True) if labels else ((), (), ())
    datasets: list[Any] = [group.get("frequency_hz"), group.get("phasors/frequency_hz")]
    found = next((read_numbers(dataset) for dataset in datasets if dataset is not None), None)
    frequency = np.array([group.attrs["frequency_hz"]]) if found is None else found
    uncertainty = read_uncertainty(group["uncertainty"])
    return LabelledPhasors(name, frequency, value, channel, component, unit, uncertainty, tuple(kind))


def _sensitivity(group: h5py.Group) -> LabelledPhasors:
    channels, elements = _texts(group, "channels"), read_numbers(group["elements"], "iu").tolist()
    unit = str(group.attrs["unit"])
    labels = [(channels[c], LOAD_COMPONENTS[j], sensitivity_unit(unit, LOAD_COMPONENTS[j])) for c, j in elements]
    value = read_numbers(group["value"], "c")[:, [c for c, _ in elements], [j for _, j in elements]]
    return _labelled(group.name.strip("/"), group, value, labels, _texts(group, "kind"))


def _curve(group: h5py.Group) -> LabelledPhasors:
    channels, unit, kind = _texts(group, "channels"), _output_unit(group), str(group.attrs["kind"])
    pairs = [(channels[c], LOAD_COMPONENTS[j]) for c, j in read_numbers(group["elements"], "iu").tolist()]
    labels = [(channel, component, sensitivity_unit(unit, component)) for channel, component in pairs]
    return _labelled(
        f"curve ({kind})", group, read_numbers(group["value"], "c"), labels, [kind] * len(group["frequency_hz"])
    )


def _motion(name: str, group: h5py.Group) -> LabelledPhasors:
    inner, body = group["phasors"], str(group.attrs["body"])
    labels = [(body, *pair) for pair in zip(_texts(inner, "channels"), _texts(inner, "unit"), strict=True)]
    return _labelled(
        f"acceleration {name}", group, read_numbers(inner["value"], "c"), labels, ["phasor"] * len(inner["value"])
    )


def _load(group: h5py.Group) -> LabelledPhasors:
    value = np.where(group["observed"][()], read_numbers(group["value"], "c"), complex(np.nan, np.nan))
    labels = [("load", *pair) for pair in zip(LOAD_COMPONENTS, LOAD_UNITS, strict=True)]
    return _labelled("load", group, value, labels, ["phasor"] * len(value))


def _matrix(group: h5py.Group) -> LabelledPhasors:
    unit = _output_unit(group)
    pairs = [(channel, component) for channel in _texts(group, "channels") for component in LOAD_COMPONENTS]
    labels = [(*pair, sensitivity_unit(unit, pair[1])) for pair in pairs]
    return _labelled("matrix", group, read_numbers(group["value"], "c").reshape(1, -1), labels, ["matrix"])


def _output_unit(group: h5py.Group) -> str:
    return str(group.file["sensor"].attrs["unit"]) if "sensor" in group.file else ""
