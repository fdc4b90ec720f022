"""Force part of the static matrix from the weight of a known load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.sensor.rotate.rotation_readings import RotationQuantity, RotationRecording, WeighedBody
from shaker.labels import LOAD_COMPONENTS
from shaker.static_rotation.harmonics import SourcedValue
from shaker.static_rotation.masses import HYSTERESIS_SOURCE
from shaker.static_rotation.weight_model import (
    CROSS,
    FORCES,
    RotationRecord,
    SensorOutputs,
    hysteresis_share,
)
from shakercal._common.arrays import BoolArray, FloatArray

AXES_OF_SPACE = 3
Cause = tuple[str, float, FloatArray]
"""Name, degrees of freedom and variance (C, 3) of a contribution."""


def force_sensitivity(
    recordings: Sequence[RotationRecording],
    records: Sequence[RotationRecord],
    outputs: SensorOutputs,
    load: Sequence[WeighedBody],
    surroundings: tuple[SourcedValue, SourcedValue],
    tilts: FloatArray,
) -> Iterator[RotationQuantity]:
    """Yield output per force of every channel, by the weighed load.

    Output per direction of gravity changes by W·(S_F + S_M·[c ×]), weight W and centre c of the load. `surroundings`:
    gravity and density of the air. `tilts` (R, 3): fitted rotations of the sensor's axes, which are the standard
    uncertainty of the stated ones where no other is stated.
    """
    states = [[r for r, each in enumerate(recordings) if each.with_load == loaded] for loaded in (False, True)]
    if not all(states) or not load or any(len(each.direction) < AXES_OF_SPACE or each.head for each in records):
        return
    means = [np.mean([records[r].response.T @ records[r].direction for r in state], axis=0) for state in states]
    change = outputs.sense * (means[1] - means[0])
    weight, relative = _weight(load, *surroundings)
    moment, centre, u_centre = outputs.sensitivity[:, FORCES:], *_centre(load)
    lever = np.tensordot(centre, CROSS, (0, 1))
    value = change / weight - moment @ lever
    causes = [*_of_readings(recordings, records, states, weight, outputs.forces)]
    causes += [(name, np.inf, (share * change / weight) ** 2) for name, share in relative]
    for axis, u in enumerate(u_centre):
        causes.append(("stated centre of mass", np.inf, (u * moment @ CROSS[:, axis]) ** 2))
    causes.append(("calibration matrix", np.inf, outputs.u[:, FORCES:] ** 2 @ lever**2))
    stated = [record.u_frame if record.frame_stated else np.abs(tilts[r]) for r, record in enumerate(records)]
    for axis, u in enumerate(np.max(stated, axis=0)):
        causes.append(("rotation of the sensor on the flange", np.inf, (u * change @ CROSS[:, axis] / weight) ** 2))
    yield from _quantities(recordings[0], value, causes)


def _weight(
    load: Sequence[WeighedBody], gravity: SourcedValue, air: SourcedValue
) -> tuple[float, list[tuple[str, float]]]:
    """Return the weight of the load in air, N, and its relative u by cause."""
    mass, volume = np.array([body.mass_kg for body in load]), np.array([body.volume_m3kg for body in load])
    weight = gravity.value * float(np.sum(mass * (1.0 - air.value * volume)))
    u_mass = float(np.linalg.norm([body.u_mass_kg for body in load]))
    u_volume = float(np.linalg.norm([body.mass_kg * body.u_volume_m3kg for body in load]))
    return weight, [
        ("weighed mass", gravity.value * u_mass / weight),
        ("local gravity", gravity.u / gravity.value),
        ("air density", gravity.value * float(mass @ volume) * air.u / weight),
        ("density of the load", gravity.value * air.value * u_volume / weight),
    ]


def _centre(load: Sequence[WeighedBody]) -> tuple[FloatArray, FloatArray]:
    """Return the stated centre (3,) of the load, and its standard uncertainty (3,)."""
    share = np.array([body.mass_kg for body in load]) / sum(body.mass_kg for body in load)
    centres, u = np.array([body.centre_m for body in load]), np.array([body.u_centre_m for body in load])
    return share @ centres, np.sqrt(share**2 @ u**2)


def _of_readings(
    recordings: Sequence[RotationRecording],
    records: Sequence[RotationRecord],
    states: Sequence[Sequence[int]],
    weight: float,
    forces: BoolArray,
) -> Iterator[Cause]:
    """Yield noise and stated errors of the readings, and hysteresis, on output per force."""
    for state in states:
        for r in state:
            record, size = records[r], records[r].response.size
            axes = record.direction / (weight * len(state))

            def variance(covariance: FloatArray, size: int = size, axes: FloatArray = axes) -> FloatArray:
                kinds = covariance[:size, :size].reshape(len(axes), -1, len(axes), size // len(axes))
                return np.asarray(np.einsum("kclc,kx,lx->cx", kinds, axes, axes))

            yield f"noise of {recordings[r].name}", record.dof, variance(record.covariance)
            for cause in record.stated:
                yield cause.name, np.inf, variance(cause.effect @ cause.effect.T)
            shares = [hysteresis_share(records, record, kind) * kind for kind in (forces, ~forces)]
            yield HYSTERESIS_SOURCE, np.inf, ((record.response * sum(shares)).T @ axes) ** 2 / 3.0


def _quantities(recording: RotationRecording, value: FloatArray, causes: Sequence[Cause]) -> Iterator[RotationQuantity]:
    """Yield the elements with their budgets, and degrees of freedom by Welch and Satterthwaite."""
    for c, channel in enumerate(recording.fit.channels):
        for j, force in enumerate(LOAD_COMPONENTS[:FORCES]):
            budget = dict[str, float]()
            for name, _, variance in causes:
                budget[name] = budget.get(name, 0.0) + float(variance[c, j])
            total = sum(budget.values())
            fourth = sum(float(variance[c, j]) ** 2 / dof for _, dof, variance in causes)
            named = {name: float(np.sqrt(each)) for name, each in budget.items() if each > 0.0}
            label, unit = f"output of {channel} per force", f"{recording.unit[c]}/N"
            head = (unit, "force_sensitivity", label, f"{channel}/{force}", "")
            dof = total**2 / fourth if fourth > 0.0 else np.inf
            yield RotationQuantity(float(value[c, j]), float(np.sqrt(total)), dof, *head, named)
