"""A rotation test: recordings of a sensor on an indexing head to masses."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from fusion.base import InputError, rounded, versions
from fusion.recording.load import Manifest
from fusion.sensor.rotate.masses import Campaign, quantities, repeats
from fusion.sensor.rotate.readings import (
    Quantity,
    Repeats,
    RotationEvaluation,
    RotationRecording,
    air_density,
    load_bodies,
    local_gravity,
    read_rotation,
    table_path,
    turned,
)
from shaker.arrays import Notice
from shaker.static_rotation.harmonics import Known
from shaker.static_rotation.masses import ROWS, SensorOutputs, Turned, WeightFit, fit_weights

TURNED_AWAY_RAD, TILTED_RAD = np.radians(10.0), np.radians(1.0)
"""Zero angle and tilt of the axis above which the user is told."""


def evaluate_rotation(name: str, manifests: Sequence[Manifest], input_hashes: dict[str, str]) -> RotationEvaluation:
    """Return what recordings of one sensor on the head weigh: tables → harmonics → weights → masses.

    Raises `InputError` for what the user can mend in the files.

    >>> import tempfile
    >>> from fusion import evaluate_rotation, load_for_command, simulate_preset
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     manifests = load_for_command([simulate_preset(f"{folder}/turned", "rotation", seed=1)], "rotate")
    ...     evaluation = evaluate_rotation("turned", manifests, {})
    >>> evaluation.name, len(evaluation.recordings)
    ('turned', 2)
    """
    started = time.monotonic()
    _check_together(manifests)
    gravity, air = local_gravity(manifests[0]), air_density(manifests[0])
    recordings, outputs, notices = _read(manifests)
    records = tuple(turned(recording) for recording in recordings)
    u_angle = max(manifest.excitation.angle_uncertainty for manifest in manifests)
    weights = fit_weights(records, outputs, u_angle)
    campaign = Campaign(recordings, records, weights, gravity, air)
    found, again = quantities(campaign), repeats(campaign)
    notices += [*_of_surroundings(manifests[0], gravity, outputs), *_of_mounting(recordings)]
    notices += [*_of_repeats(again), *_of_fit(weights, records), *_of_result(found)]
    return RotationEvaluation(
        name=name,
        recordings=recordings,
        outputs=outputs,
        gravity=gravity,
        air=air,
        weights=weights,
        quantities=found,
        repeats=again,
        notices=tuple(dict.fromkeys(notices)),
        settings={"gravity": gravity.source, "air_density": air.source},
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _check_together(manifests: Sequence[Manifest]) -> None:
    """Recordings that are compared share a rig."""
    for manifest in manifests:
        manifest.check_command("rotate")
        if manifest.rig_path.resolve() != manifests[0].rig_path.resolve():
            expected = f"{manifests[0].rig_path}, the rig of {manifests[0].folder.name}"
            raise InputError(manifest.path, "rig", found=str(manifest.rig_path), expected=expected)


def _read(
    manifests: Sequence[Manifest],
) -> tuple[tuple[RotationRecording, ...], SensorOutputs, list[Notice]]:
    """All recordings, which must hold the same channels."""
    read = [read_rotation(manifest) for manifest in manifests]
    first, outputs, _ = read[0]
    for recording, _, _ in read[1:]:
        if recording.fit.channels != first.fit.channels or recording.unit != first.unit:
            told = [
                ", ".join(f"{c} {u}".strip() for c, u in zip(r.fit.channels, r.unit, strict=True))
                for r in (recording, first)
            ]
            raise InputError(
                table_path(recording.manifest), "", found=told[0], expected=f"{told[1]}, the channels of {first.name}"
            )
    return tuple(item[0] for item in read), outputs, [notice for *_, told in read for notice in told]


def _of_surroundings(manifest: Manifest, gravity: Known, outputs: SensorOutputs) -> list[Notice]:
    """What of gravity, air and calibration had to be assumed."""
    found = []
    value = rounded(gravity.value, 2.0 * gravity.u)
    environment = manifest.rig.environment
    if environment is None or environment.gravity is None:
        text = f"local gravity is not stated: ({value.value} ± {value.expanded}) m/s² (k = 2), {gravity.source}"
        found.append(Notice("info", text, "gravity"))
    elif gravity.u == 0.0:
        found.append(Notice("info", "gravity counts as exact, since gravity_uncertainty is not stated", "gravity"))
    if not outputs.u.any():
        text = (
            "no uncertainty of the calibration matrix is stated (static_sensitivity_uncertainty): U contains the "
            "scatter of the readings, but not the scale of the sensor"
        )
        found.append(Notice("warning", text, "sensor"))
    for body in load_bodies(manifest):
        if body.u_volume_m3kg > 0.0:
            text = f"density of {body.name} not stated: its buoyancy is that of something between aluminium and steel"
            found.append(Notice("info", text, "load"))
    return found


def _of_mounting(recordings: Sequence[RotationRecording]) -> list[Notice]:
    """What a missing recording leaves open."""
    kinds = {recording.with_load for recording in recordings}
    stated = bool(load_bodies(recordings[0].manifest))
    if kinds == {False}:
        return [Notice("info", "no recording with load: internal mass only", "recordings")]
    if kinds == {True} and stated:
        text = "no recording without load: the internal mass is what the weighed load leaves of the weight"
        return [Notice("info", text, "recordings")]
    if kinds == {True}:
        text = "neither a recording without load nor a weighed load: weights only, which hold load and internal mass"
        return [Notice("warning", text, "recordings")]
    return [] if stated else [Notice("info", "no [load] in rig.toml: nothing to compare the load mass with", "load")]


def _of_repeats(again: Sequence[Repeats]) -> list[Notice]:
    """Where repeats tell nothing of mounting anew."""
    return [
        Notice(
            "info",
            f"{len(state.recordings)} recordings {state.state} are of one mounting: what mounting anew changes is not "
            "in U",
            "repeats",
        )
        for state in again
        if not state.between_dof
    ]


def _of_fit(weights: WeightFit, records: Sequence[Turned]) -> list[Notice]:
    """What the fit says of the head and of the channels."""
    found = []
    for r, record in enumerate(records):
        row = weights.value[ROWS * r : ROWS * (r + 1)]
        zero, tilt = float(row[4]), float(np.hypot(row[5], row[6]))
        if abs(zero) > np.pi / 2.0:
            text = (
                f"gravity at angle 0 lies {np.degrees(zero):.1f}° from its stated direction: sense of the sensor or "
                "zero_gravity may be the wrong way round; masses and centres do not depend on it"
            )
            found.append(Notice("warning", text, record.name))
        elif abs(zero) > TURNED_AWAY_RAD:
            text = f"gravity at angle 0 lies {np.degrees(zero):.1f}° from its stated direction, which is taken off"
            found.append(Notice("info", text, record.name))
        if tilt > TILTED_RAD and tilt > 3.0 * float(np.sqrt(weights.covariance[ROWS * r + 5, ROWS * r + 5])):
            text = f"the force along the axis turns with the head as if that were {np.degrees(tilt):.2f}° from the axis"
            found.append(Notice("info", f"{text} stated, or by cross-talk of the sensor", record.name))
    if weights.departure > 0.0:
        text = (
            "a weight turned about the axis does not explain all channels within their noise and the stated "
            f"calibration: every first harmonic is taken to be uncertain by {100.0 * weights.departure:.2g} % of the "
            "weight more, by which they disagree"
        )
        found.append(Notice("warning", text, "channels"))
    return found


def _of_result(found: Sequence[Quantity]) -> list[Notice]:
    """Whether the load weighs what was weighed."""
    told = []
    for quantity in found:
        if quantity.name == "load_mass_normalised_deviation" and abs(quantity.value) > 1.0:
            text = (
                f"the load mass by {quantity.component} and the weighed mass differ by {abs(quantity.value):.2f} "
                "times the U of their difference"
            )
            told.append(Notice("warning", text, "load"))
    return told
