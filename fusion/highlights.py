"""What a reader wants first: the driven component, the output that belongs to it, and the strongest line."""

from __future__ import annotations

import numpy as np

from fusion.evaluation import Evaluation
from fusion.fuse import Acceleration
from fusion.sensitivity import driven_component as driven_load

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
LOAD_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def driven_component(evaluation: Evaluation) -> int:
    """Place of the driven component among x, y, z, rx, ry, rz.

    The largest element of the excitation's direction, forces and moments in shares of the rated loads; where none is
    stated, the translation that moves most.
    """
    direction, sensor = evaluation.manifest.excitation.direction, evaluation.manifest.rig.sensor
    if direction is not None:
        return driven_load(direction, None if sensor is None else sensor.capacity)
    sizes = [np.abs(result.phasors.value[:, :3]) for result in evaluation.accelerations]
    moves = np.nan_to_num(np.concatenate(sizes)) if sizes else np.zeros((1, 3))
    return int(np.argmax(moves.max(axis=0)))


def driven_channel(evaluation: Evaluation) -> int:
    """Place of the sensor output that belongs to the driven component.

    The largest static sensitivity decides where one is given, else the largest ratio at the main line.
    """
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    component = driven_component(evaluation)
    static = static_sensitivity(evaluation)
    sizes = np.abs(found.value[main_line(evaluation), :, component] if static is None else static[:, component])
    usable = np.where(found.observed[:, component] & np.isfinite(sizes), sizes, -1.0)
    return int(np.argmax(usable))


def driven_element(evaluation: Evaluation) -> int:
    """Place of the driven channel and component among the elements of the sensitivity."""
    found = evaluation.sensitivity
    if found is None:
        raise ValueError("evaluation: expected a sensitivity, found none")
    return found.elements.index((driven_channel(evaluation), driven_component(evaluation)))


def main_line(evaluation: Evaluation) -> int:
    """Place of the strongest line: the largest driven fused acceleration of the load, else the first line."""
    result = acceleration(evaluation, "load", "fused") or next(iter(evaluation.accelerations), None)
    if result is None:
        return 0
    driven = np.abs(result.phasors.value[:, driven_component(evaluation)])
    return int(np.nanargmax(driven)) if np.isfinite(driven).any() else 0


def acceleration(evaluation: Evaluation, body: str, source: str) -> Acceleration | None:
    """Acceleration of one body from one source, None where there is none."""
    for result in evaluation.accelerations:
        if (result.body, result.source) == (body, source):
            return result
    return None


def bodies(evaluation: Evaluation) -> list[str]:
    """Bodies whose acceleration was determined, in order of appearance."""
    return list(dict.fromkeys(result.body for result in evaluation.accelerations))


def by_source(evaluation: Evaluation, body: str) -> list[Acceleration]:
    """Results of one body, fused first; only the fused one where it rests on a single instrument."""
    results = [result for result in evaluation.accelerations if result.body == body]
    fused = acceleration(evaluation, body, "fused")
    return [fused] if fused is not None and len(fused.instruments) < 2 and len(results) < 3 else results


def static_sensitivity(evaluation: Evaluation) -> np.typing.NDArray[np.float64] | None:
    """Static sensitivity (C, 6) of the outputs evaluated, None where the rig states none."""
    sensor, found = evaluation.manifest.rig.sensor, evaluation.sensitivity
    if sensor is None or found is None or sensor.static_sensitivity is None:
        return None
    rows = [list(sensor.channels).index(name) for name in found.channels]
    return np.asarray(sensor.static_sensitivity, dtype=np.float64)[rows]


def static_value(evaluation: Evaluation, channel: int, component: int) -> float | None:
    """One element of the static sensitivity, None where it is not stated or zero."""
    static = static_sensitivity(evaluation)
    return float(static[channel, component]) if static is not None and static[channel, component] != 0.0 else None
