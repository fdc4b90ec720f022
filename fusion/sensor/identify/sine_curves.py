"""Load over base motion from the results of sine recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from fusion.campaign.excited_line import with_campaign_names
from fusion.estimation.uncertainty import Uncertainty
from fusion.recording.load import Manifest
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results, read_uncertainty
from fusion.sensitivity.moving_body import inertia_errors, rigid_load
from fusion.sensor.identify.identification_inputs import (
    EvaluatedSines,
    FlexibleLoad,
    PreparedTransfer,
    component_of,
    drive_of,
)
from shaker.identification.measured_curves import CurveError, MeasuredTransfer, Placement
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import ComplexArray


def sine_transfers(
    items: Sequence[EvaluatedSines],
    names: Mapping[Path, str],
    starts: Mapping[str, str],
    band_hz: tuple[float, float] | None,
) -> tuple[PreparedTransfer, ...]:
    """Return load over base along the drive, of recordings of sines.

    Recordings of one load and mounting are one curve. `names`: unique names of the recordings by the path of their
    manifest. `starts`: names of their starts, if several recordings have a common start.
    """
    groups: dict[tuple[object, ...], list[PreparedTransfer]] = {}
    for item in items:
        name = names[item.manifest.path]
        measured = _transfer(item, name, starts.get(name, name), band_hz)
        if measured is not None:
            load = measured.mass_matrix.tobytes(), str(item.manifest.rig.load)
            key = (*load, measured.drive.tobytes(), item.manifest.mounting, measured.clock)
            groups.setdefault(key, []).append(PreparedTransfer(item.manifest, measured))
    curves = [(group[0].manifest, _bent(group[0].manifest, _joined(group))) for group in groups.values()]
    if len({measured.name for _, measured in curves}) < len(curves):
        curves = [(m, replace(one, name=f"{one.name}, mounting {m.mounting}")) for m, one in curves]
    return tuple(PreparedTransfer(manifest, measured) for manifest, measured in curves)


def _bent(manifest: Manifest, measured: MeasuredTransfer) -> MeasuredTransfer:
    """Return a curve with the elastic properties of its load."""
    bent = FlexibleLoad.of(manifest, measured.ratio.frequency_hz)
    return measured if bent is None else replace(measured, bending=bent.bending(measured.tops, manifest.mounting))


PER_LINE = ("frequency_hz", "value", "covariance", "dof")
"""Fields of a ratio that have an entry for every line."""


def _joined(group: Sequence[PreparedTransfer]) -> MeasuredTransfer:
    """Return the lines of several recordings as one curve, ascending in frequency.

    Equal names of errors are one unknown.
    """
    records = [item.measured for item in group]
    ratios = [record.ratio for record in records]
    order = np.argsort(np.concatenate([ratio.frequency_hz for ratio in ratios]), kind="stable")
    parts: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in ratios])[order] for name in PER_LINE}
    ratio = replace(ratios[0], **parts)
    by_name = [{error.name: error.relative for error in record.errors} for record in records]
    zeros = [np.zeros(one.value.shape, dtype=np.complex128) for one in ratios]

    def relative(name: str) -> ComplexArray:
        return np.concatenate([found.get(name, zero) for found, zero in zip(by_name, zeros, strict=True)])[order]

    joined = tuple(CurveError(name, relative(name)) for name in dict.fromkeys(chain(*by_name)))
    steps = f"{len(order)} steps of sines, {group[0].manifest.rig.name}"
    return replace(records[0], name=steps, ratio=ratio, errors=joined)


def relative_errors(uncertainty: Uncertainty, value: ComplexArray) -> tuple[CurveError, ...]:
    """Return named unknowns of values (K, C) as complex relative deviations for one standard uncertainty."""
    count = value.shape[1]
    return tuple(
        CurveError(influence.name, (influence.effect[:, :count] + 1j * influence.effect[:, count:]) / value)
        for influence in uncertainty.influences
        if np.any(influence.effect != 0.0)
    )


def _transfer(
    item: EvaluatedSines, name: str, start: str, band_hz: tuple[float, float] | None
) -> MeasuredTransfer | None:
    """Return load over base acceleration along the drive at the driven lines, None without both."""
    manifest = item.manifest
    drive = drive_of(manifest)
    component = component_of(drive)
    if manifest.rig.load is None or component >= 3:  # of a rig that is turned, sines add no points
        return None
    with open_results(item.results / RESULT_FILE) as file:
        groups = ["accelerations/load-fused", "accelerations/base-fused"]
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
    # common errors of load and base act on both
    base = values[1][chosen]
    ratio = values[0][chosen] / base
    below = parts[1].at_lines(chosen).scaled((-ratio / base)[:, None])
    relabelled = tuple(replace(part, label=f"base: {part.label}") for part in below.random)
    whole = parts[0].at_lines(chosen).scaled((1.0 / base)[:, None]).plus(replace(below, random=relabelled))
    whole = with_campaign_names(whole, name, manifest.mounting, start)
    body = rigid_load(manifest)
    along = Placement(np.zeros(3), np.eye(3)[component])
    clock = manifest.daq[0] if manifest.daq else None
    return MeasuredTransfer(
        name=name,
        ratio=Phasors(
            frequency_hz=frequency[chosen],
            value=ratio[:, None],
            covariance=np.sum([part.covariance for part in whole.random], axis=0),
            channels=(f"load {MOTION_COMPONENTS[component]}",),
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
