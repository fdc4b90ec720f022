"""From the results of sine recordings to load over base acceleration: further points of the transfer functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from fusion.body import COMPONENTS
from fusion.drive import between_recordings
from fusion.estimate import real_design
from fusion.identify.campaign import EvaluatedSines
from fusion.identify.measured import Prepared, component_of, drive_of, inertia_errors, rigid_load
from fusion.provenance import RESULT_FILE
from fusion.read_results import read_uncertainty
from fusion.uncertainty import Uncertainty
from shaker._checks import ComplexArray
from shaker.models.measured import MeasuredTransfer, RelativeError, Sight
from shaker.signals.phasor import Phasors

_ORIGIN_OF_MOTION = "fused"
AXES = np.eye(3)
"""Unit vectors of the translations; of a rig that is turned, sines add no points."""


def sine_transfers(
    items: Sequence[EvaluatedSines], names: Mapping[Path, str], band_hz: tuple[float, float] | None
) -> tuple[Prepared, ...]:
    """Return load over base along the drive where both were measured, recordings of one load and mounting as one curve.

    `names`: those that tell recordings apart, by the path of their manifest.
    """
    groups: dict[tuple[object, ...], list[Prepared]] = {}
    for item in items:
        found = _transfer(item, names[item.manifest.path], band_hz)
        if found is not None:
            key = (found.mass_matrix.tobytes(), found.drive.tobytes(), item.manifest.mounting, found.clock)
            groups.setdefault(key, []).append(Prepared(item.manifest, found))
    joined = [_joined(group) for group in groups.values()]
    several = len({item.measured.name for item in joined}) < len(joined)
    return tuple(_by_mounting(item) if several else item for item in joined)


def _joined(group: Sequence[Prepared]) -> Prepared:
    """Return the lines of several recordings as one curve, ascending in frequency; equal names are one unknown."""
    records = [item.measured for item in group]
    first = records[0]
    frequency = np.concatenate([record.ratio.frequency_hz for record in records])
    order = np.argsort(frequency, kind="stable")
    ratio = Phasors(
        frequency_hz=frequency[order],
        value=np.concatenate([record.ratio.value for record in records])[order],
        covariance=np.concatenate([record.ratio.covariance for record in records])[order],
        channels=first.ratio.channels,
        unit=first.ratio.unit,
        dof=np.concatenate([record.ratio.dof for record in records])[order],
    )
    names = dict.fromkeys(error.name for record in records for error in record.errors)
    errors = tuple(RelativeError(name, np.concatenate([_error(r, name) for r in records])[order]) for name in names)
    steps = f"{len(order)} steps of sines, {group[0].manifest.rig.name}"
    return Prepared(group[0].manifest, replace(first, name=steps, ratio=ratio, errors=errors))


def _by_mounting(item: Prepared) -> Prepared:
    """Curve with the mounting in its name."""
    name = f"{item.measured.name}, mounting {item.manifest.mounting}"
    return replace(item, measured=replace(item.measured, name=name))


def _error(record: MeasuredTransfer, name: str) -> ComplexArray:
    """Return what a cause does to the lines of one recording, nothing where it does not know it."""
    found = (error.relative for error in record.errors if error.name == name)
    return next(found, np.zeros(record.ratio.value.shape, dtype=np.complex128))


def relative_errors(uncertainty: Uncertainty, value: ComplexArray) -> tuple[RelativeError, ...]:
    """Return the named unknowns of values (K, C) as complex relative deviations for one standard uncertainty."""
    count = value.shape[1]
    return tuple(
        RelativeError(influence.name, (influence.effect[:, :count] + 1j * influence.effect[:, count:]) / value)
        for influence in uncertainty.influences
        if np.any(influence.effect != 0.0)
    )


def _transfer(item: EvaluatedSines, name: str, band_hz: tuple[float, float] | None) -> MeasuredTransfer | None:
    """Return load over base acceleration along the drive at the driven lines, None where one is not known."""
    manifest = item.manifest
    drive = drive_of(manifest)
    component = component_of(drive)
    if manifest.rig.load is None or component >= len(AXES):
        return None
    with h5py.File(item.results / RESULT_FILE, "r") as file:
        groups = [f"accelerations/{body}-{_ORIGIN_OF_MOTION}" for body in ("load", "base")]
        if any(group not in file for group in groups):
            return None
        frequency = file["lines/frequency_hz"][()]
        driven = file["lines/multiple"][()] == 1
        values = [file[group]["phasors/value"][()][:, component] for group in groups]
        parts = [read_uncertainty(file[group]["uncertainty"]).at([component]) for group in groups]
    chosen = driven & np.isfinite(values[0]) & np.isfinite(values[1])
    if band_hz is not None:
        chosen &= (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    if not np.any(chosen):
        return None
    ratio, whole = _quotient([value[chosen] for value in values], [_at_lines(part, chosen) for part in parts])
    whole = between_recordings(whole, name, manifest.mounting)
    body = rigid_load(manifest)
    along = Sight(np.zeros(3), AXES[component])
    clock = manifest.daq[0] if manifest.daq else None
    return MeasuredTransfer(
        name=name,
        ratio=Phasors(
            frequency_hz=frequency[chosen],
            value=ratio[:, None],
            covariance=np.sum([part.covariance for part in whole.random], axis=0),
            channels=(f"load {COMPONENTS[component]}",),
            unit=("1",),
            dof=whole.dof()[:, 0],
        ),
        tops=(along,),
        base=along,
        drive=drive,
        mass_matrix=body.mass_matrix,
        errors=relative_errors(whole, ratio[:, None]),
        inertia_errors=inertia_errors(manifest, body),
        clock=f"clock of {clock.name}" if clock else f"clock of {name}",
        u_clock=clock.clock_uncertainty if clock else 0.0,
    )


def _at_lines(uncertainty: Uncertainty, chosen: NDArray[np.bool_]) -> Uncertainty:
    """Uncertainty of the values at some lines."""
    random = tuple(
        replace(part, covariance=part.covariance[chosen], dof=None if part.dof is None else part.dof[chosen])
        for part in uncertainty.random
    )
    return Uncertainty(random, tuple(i.acting(i.effect[chosen]) for i in uncertainty.influences))


def _quotient(values: Sequence[ComplexArray], parts: Sequence[Uncertainty]) -> tuple[ComplexArray, Uncertainty]:
    """Return the first values (K,) over the second and the uncertainty of that; what both share acts on both."""
    top, base = values
    ratio = top / base
    above = parts[0].transformed(real_design((1.0 / base)[:, None, None]))
    below = parts[1].transformed(real_design((-ratio / base)[:, None, None]))
    relabelled = tuple(replace(part, label=f"base: {part.label}") for part in below.random)
    return ratio, above.plus(replace(below, random=relabelled))
