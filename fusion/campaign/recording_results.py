"""Results of recordings, read from their folders for a campaign."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import date as Date
from functools import partial
from pathlib import Path

import h5py

from fusion.campaign.campaign_notices import NO_RECORDING_RESULTS
from fusion.campaign.excited_line import ExcitedLine, Knowledge, excited_lines, identity
from fusion.errors import InputError
from fusion.instruments.channel import Outputs
from fusion.phasors.timing import EdgeGrid
from fusion.report.folder import RESULT_FILE, RESULT_FORMAT, Provenance, provenance_of
from fusion.report.h5 import open_results, read_evidence, read_notices, read_uncertainty
from fusion.report.report_notices import OTHER_FORMAT
from fusion.sensitivity.analyse import REPEATS
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensitivity.load_phasors import LoadResult
from fusion.sensitivity.ratio import StatedMatrix
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

FUSED = "accelerations/load-fused"
READ = ("excitation", "sensor", "lines", "load", "outputs", FUSED, "clocks", "notices", "evidence", "provenance")
"""Groups of a recording's results that a campaign reads."""


@dataclass(frozen=True)
class SensorFacts:
    """The tested sensor: channels, unit, rated loads and static sensitivity as stated.

    `capacity` (6,) in N and N.m; `static` (all channels, 6) in unit/N and unit/(N.m) with the relative standard
    uncertainty `u_static`; `cross_talk` and `u_cross_talk` over the rated output (`StatedMatrix`).
    """

    name: str
    serial: str
    channels: tuple[str, ...]
    unit: str
    sense: str
    capacity: FloatArray | None
    static: FloatArray | None
    u_static: float
    cross_talk: float | None = None
    u_cross_talk: float | None = None

    @property
    def stated_matrix(self) -> StatedMatrix:
        """Stated information on the matrix."""
        return StatedMatrix(
            self.channels, self.capacity, self.static, self.u_static, self.cross_talk, self.u_cross_talk
        )

    def static_of(self, channels: Sequence[str]) -> FloatArray | None:
        """Return the static sensitivity of some outputs, None if it is not stated."""
        return None if self.static is None else self.static[[self.channels.index(channel) for channel in channels]]


@dataclass(frozen=True)
class RecordingResults:
    """Results of one recording, read from its folder.

    `kind`, `direction`, `frequencies`: of the excitation as stated. `excited_lines`: its driven lines with load and
    outputs; empty without a load, an output or a stated direction. `notices`: those of its report. `date`,
    `simulated`: as stated. `evidence`: its unknowns that certificates and files state. `knowledge`: returns the
    estimate of its unknowns by its readings; None without a load or if its instruments contradict each other.
    """

    folder: str
    name: str
    mounting: str
    rig: str
    kind: str
    direction: tuple[float, ...]
    frequencies: tuple[float, ...]
    sensor: SensorFacts | None
    excited_lines: tuple[ExcitedLine, ...]
    notices: tuple[Notice, ...]
    origin: Provenance
    date: Date | None = None
    evidence: tuple[InputEvidence, ...] = ()
    knowledge: Callable[[], Knowledge] | None = None
    simulated: bool = False

    @property
    def joint_notices(self) -> tuple[Notice, ...]:
        """Notices that remain true in a campaign; single repeats are judged by the campaign."""
        return tuple(notice for notice in self.notices if notice.where != REPEATS)


def read_recorded(folder: str | Path) -> RecordingResults:
    """Return the results of one recording as a campaign needs them.

    Parameters
    ----------
    folder : str or Path
        Folder of the results.

    Returns
    -------
    RecordingResults
        Sensor, driven lines with uncertainties, notices and provenance.

    Raises
    ------
    InputError
        The folder has no results, or they are damaged or of another format.

    Examples
    --------
    >>> from fusion import read_recorded
    >>> recorded = read_recorded("sample_images/demo/Fz-0080/results")  # doctest: +SKIP
    """
    folder = Path(folder)
    if not (folder / RESULT_FILE).is_file():
        raise InputError(NO_RECORDING_RESULTS, folder / RESULT_FILE)
    with open_results(folder / RESULT_FILE, *READ) as file:
        if file.attrs["format"] != RESULT_FORMAT:
            found = f"format {file.attrs['format']}"
            raise InputError(OTHER_FORMAT, folder / RESULT_FILE, found=found, expected=str(RESULT_FORMAT))
        driven = file["excitation"]
        return RecordingResults(
            folder=folder.name,
            name=str(file.attrs["recording"]),
            mounting=str(file.attrs["mounting"]),
            rig=str(file.attrs["rig"]),
            kind=str(driven.attrs["kind"]),
            direction=_numbers(driven, "direction"),
            frequencies=_numbers(driven, "frequencies"),
            sensor=_sensor(file["sensor"]) if "sensor" in file else None,
            excited_lines=_drives(file),
            notices=read_notices(file),
            origin=provenance_of(file),
            date=Date.fromisoformat(file.attrs["date"]) if "date" in file.attrs else None,
            simulated=bool(file.attrs.get("simulated", False)),
            evidence=read_evidence(file),
            knowledge=_knowledge(file),
        )


def _drives(file: h5py.File) -> tuple[ExcitedLine, ...]:
    """Return the driven lines from load and outputs with their uncertainty."""
    direction = _numbers(file["excitation"], "direction")
    if "load" not in file or "outputs" not in file or not direction:
        return ()
    lines, load, inner = file["lines"], file["load"], file["outputs/phasors"]
    phasors = Phasors(
        frequency_hz=inner["frequency_hz"][()],
        value=inner["value"][()],
        covariance=inner["covariance"][()],
        channels=_texts(inner, "channels"),
        unit=_texts(inner, "unit"),
        dof=inner["dof"][()],
    )
    wrench = LoadResult(
        load["frequency_hz"][()], load["value"][()], read_uncertainty(load["uncertainty"]), load["observed"][()], ()
    )
    outputs = Outputs(phasors, read_uncertainty(file["outputs/uncertainty"]))
    names = str(file.attrs["recording"]), str(file.attrs["mounting"])
    driven = excited_lines(*names, direction, lines["nominal_hz"][()], lines["multiple"][()], wrench, outputs)
    return tuple(replace(drive, grids=_grids(file)) for drive in driven)


def _knowledge(file: h5py.File) -> Callable[[], Knowledge] | None:
    """Return a callable for the estimate of the shared unknowns by the readings."""
    fused = file.get(FUSED, {})
    if "load" not in file or "posterior" not in fused:
        return None
    both = _texts(file["load"], "both") if "both" in file["load"] else ()
    numbers = (fused[name][()] for name in ("unknowns/estimate", "posterior", "products"))
    knowledge = Knowledge.of(read_uncertainty(fused["uncertainty"]).influences, both, *numbers)
    return partial(identity, knowledge)


def _grids(file: h5py.File) -> tuple[EdgeGrid, ...]:
    """Return the positions of trigger edges of every block with a trigger.

    None if one block has no position.
    """
    clocks = [clock for clock in [*file.get("clocks", {}).values()] if "trigger" in clock]
    found = [clock["grid"].attrs for clock in clocks if "grid" in clock]
    if len(found) < len(clocks):
        return ()
    return tuple(EdgeGrid(**{field.name: float(attrs[field.name]) for field in fields(EdgeGrid)}) for attrs in found)


def _sensor(group: h5py.Group) -> SensorFacts:
    return SensorFacts(
        name=str(group.attrs["name"]),
        serial=str(group.attrs["serial"]),
        channels=_texts(group, "channels"),
        unit=str(group.attrs["unit"]),
        sense=str(group.attrs["sense"]),
        capacity=group["capacity"][()] if "capacity" in group else None,
        static=group["static_sensitivity"][()] if "static_sensitivity" in group else None,
        u_static=float(group.attrs["static_sensitivity_uncertainty"]),
        cross_talk=_number(group, "cross_talk"),
        u_cross_talk=_number(group, "cross_talk_uncertainty"),
    )


def _number(group: h5py.Group, name: str) -> float | None:
    """Return a number, None if it is missing."""
    return float(group.attrs[name]) if name in group.attrs else None


def _numbers(group: h5py.Group, name: str) -> tuple[float, ...]:
    """Return a list of numbers, empty if it is missing."""
    return tuple(group[name][()].tolist()) if name in group else ()


def _texts(group: h5py.Group, name: str) -> tuple[str, ...]:
    """Return a list of texts, each interned for all recordings."""
    return tuple(map(sys.intern, group[name].asstr()[()].tolist()))
